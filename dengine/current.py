"""The version that answers, and what it learns from one label after the other."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .fleet import Fleet
from .keeping import Keeper
from .model.base import EngineModel, Told
from .records import Reason, RetrainReport
from .references import References
from .resuming import Origin, Telling, resume, tell_all
from .retraining import Retrainer
from .store.base import Store
from .store.records import StoredDecision

log = logging.getLogger("dengine")

Point = NDArray[np.float32]
TELL_ALL = Telling()


class CurrentVersion:
    """The version of an engine's model that answers; `ModelVersions` is the rest of it.

    template : untrained; what the first version is trained from.
    answering : the model that answers; None before the first retrain.  version : its number, from 1; 0 before.
    new_labels : since the last retrain began.
    keeper : asks the store.
    journal_cleared : StoreError while labels of this cell wait in the journal.
    store_waiting : stores what the rule was told of and the store not yet, StoreError where it cannot; called before any
        training or swap, since a version is stored after all that its rule was told of.
    """

    def __init__(
        self,
        template: EngineModel,
        retrainer: Retrainer,
        keeper: Keeper,
        clock: Callable[[], float],
        telling: Telling = TELL_ALL,
    ) -> None:
        self.template = template
        self.telling = telling
        self.retrainer = retrainer
        self.keeper = keeper
        self.clock = clock
        self.answering: EngineModel | None = None
        self.version, self.new_labels = 0, 0
        self.store_waiting: Callable[[], None] = _nothing_waits
        self.journal_cleared: Callable[[], None] = _nothing_waits
        self._references, self._corrected_to = References(), 0
        self._origin: Origin | None = None
        self._newest = 0  # number that a version ever had; after damage an earlier one may answer
        self.fleet: Fleet | None = None
        self._news: RetrainReport | None = None

    @property
    def store(self) -> Store:
        """What the keeper keeps; asked without a time limit, so not while the cell waits."""
        return self.keeper.store

    @property
    def next_number(self) -> int:
        """What the next version will be called."""
        return self._newest + 1

    @property
    def newest(self) -> EngineModel:
        """The model that answers, or the untrained one."""
        return self.answering or self.template

    def resume(self) -> None:
        """Go on from the store."""
        resumed = resume(self.store, self.template, self.retrainer.window, self.telling)
        self.answering, self.version, self.new_labels = resumed.model, resumed.version, resumed.new_labels
        self._references, self._origin = resumed.references, resumed.origin
        self._corrected_to = resumed.corrected_to
        self._newest = max((report.version for report in self.store.retrains()), default=0)
        if self.fleet is not None:
            self.fleet.resume()

    def join(self) -> None:
        """Start a new cell on what the others of its product learned; without a product there is nothing."""
        if self.fleet is not None:
            self.resume()

    def take_over(self, model: EngineModel, number: int, references: References, origin: Origin) -> None:
        """Let a sister's version answer."""
        self.answering, self.version, self._newest = model, number, max(number, self._newest)
        self._references, self._origin = references, origin

    @property
    def corrected_to(self) -> int:
        """The newest correction that is known here."""
        return self._corrected_to

    @property
    def references(self) -> References:
        """The labels behind the references of the model that answers."""
        return self._references

    def reference_point(self, known: StoredDecision) -> Point | None:
        """Where a decided trace lies as a reference of the version that answers; None without one, and where it fails."""
        if self.answering is None:
            return None
        # What this very version embedded when it decided need not be embedded again.
        embedding = known.embedding if known.model_version == self.version else None
        return self.answering.place_safely(known.trace, known.content_hash, embedding)

    def learn(self, known: StoredDecision, success: bool, point: Point | None, silent: int) -> None:
        """Take in what became of a part: tell the rule, and make the trace a reference."""
        novel = known.reason is Reason.NOVEL
        if known.model_version >= self.telling.since:
            self.newest.tell_safely(Told(known.lower, known.upper, success, novel, silent))
        if self.newest.add_safely(point, int(success), known.content_hash):
            self._references.add(known.id)
        self.new_labels += self.fleet is None  # a product's labels are counted in their order, when they are kept

    def unlearn(self, known: StoredDecision) -> None:
        """Take out the reference of a part whose label waits for the store: it was not what happened."""
        age = self._references.age(known.id)
        if age is not None:
            self.newest.change_reference(age, known.content_hash, None)
            self._references.remove(age)

    def keep(self, known: StoredDecision, success: bool, seq: int) -> None:
        """Give a label that is stored to the next retrain."""
        self._references.number(known.id, seq)
        if self.fleet is not None:
            self.fleet.keep(known.trace, int(success), known.content_hash, seq)
            return
        self.retrainer.window.add(known.trace, int(success), known.content_hash, seq)

    def tell_anew(self) -> None:
        """Tell the rule everything again: what it was told was not what happened. StoreError where the store is away."""
        known = self.keeper.ask(lambda: self.store.evidence_since(0, self.telling.since))
        tell_all(self.newest, known, self.telling)


def _nothing_waits() -> None:
    """No label waits for the store."""
