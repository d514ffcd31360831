"""The model that answers, and how a new version takes its place.

A version on its way in: it learns the labels that came during its training, is stored, and then answers.

Where it was trained beside the cell, the cell goes on meanwhile: all of this is done in steps that no part waits for.

The version that answers, and what it learns from one label after the other.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..decision.policy import Policy
from ..errors import StoreError
from ..model.base import EngineModel, Told
from ..records import Reason, RetrainReport
from ..reducers.base import State
from ..store.base import Store, is_shared
from ..store.outbox import Asked, Keeper
from ..store.peers import without_rule
from ..store.records import Change, StoredDecision
from .peers import Fleet
from .resume import Origin, References, Telling, change, join_since, refit, resume, tell_all
from .trainer import HUNG, Retrainer, Trained, Window

STEP = 0.001  # seconds of learning at once: some labels


class Incoming:
    """What was trained, until it answers.

    previous : the model that answers, whose rule goes on.  version : its number.
    references : the labels behind the references.  report : what is known of it so far.  storing : its commit, once begun.
    """

    def __init__(self, trained: Trained, previous: EngineModel, version: int, clock: Callable[[], float]) -> None:
        candidate = trained.candidate
        self.model, self.seq, self.references = candidate.model, trained.seq, References(trained.seq)
        if self.model is not None:
            self.model.prepare_safely(previous)
        self.report = RetrainReport(version, 0.0, len(trained.seq), candidate.n_steps, False, candidate.reason)
        self.storing: Asked[int | None] | None = None
        self.seconds = clock() - trained.begin  # of work on it: the cell's own, in between, is not counted
        self._clock = clock
        self._seen: set[int] = set()

    def learn(self, window: Window, seconds: float = np.inf) -> bool:
        """Make labels that came during its training references, no longer than that; whether it has all."""
        missing = [] if self.model is None else self._missing(window)
        if not missing:
            return True
        begin = self._clock()
        while missing and self._clock() - begin < seconds:
            self._learn_one(missing.pop(0), window)
        self.seconds += self._clock() - begin
        return not missing

    def _missing(self, window: Window) -> list[int]:
        return [seq for seq in window.newer(int(self.seq[-1])).tolist() if seq not in self._seen]

    def _learn_one(self, seq: int, window: Window) -> None:
        assert self.model is not None  # the caller asked; for the type checker
        trace, label, hash_ = window.row(seq)
        if self.model.add_safely(self.model.place_safely(trace, hash_), label, hash_):
            self.references.add(seq)
        self._seen.add(seq)


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


class ModelVersions(CurrentVersion):
    """The versions of one engine's model: at most one answers, at most one is being trained."""

    def __init__(
        self,
        template: EngineModel,
        retrainer: Retrainer,
        keeper: Keeper,
        clock: Callable[[], float],
        telling: Telling = TELL_ALL,
    ) -> None:
        super().__init__(template, retrainer, keeper, clock, telling)
        self._incoming: Incoming | None = None
        if is_shared(keeper.store):
            self.fleet = Fleet(keeper.store, self)

    def correct(self, own: bool = True) -> None:
        """Learn what the store's newest corrections say: references, window and rule, before the next decision.

        What keeps references of its own, a rival, is trained anew at once; by the cell that corrected.
        """
        window = self.retrainer.window
        last = None if self.fleet is None else window.newest_seq  # what sisters stored since comes as their news
        window.refill(self.store.labelled(window.capacity, last=last))
        done = self.newest.keeps_references or self.answering is None
        for each in self.store.corrections(self._corrected_to):
            if self.answering is not None:
                done &= change(self.answering, self._references, self.store, each)
            self._corrected_to = each.number
        if self.fleet is None:
            self.new_labels = window.after(0 if self._origin is None else self._origin.counts_from)
        else:
            self.fleet.recount()
        self.tell_anew()
        if own and not done:
            self.retrain()

    def roll_back(self, number: int, event: Change) -> RetrainReport:
        """Let an earlier version answer again, as a new one, with what came since among its references."""
        begin, version = self.clock(), self.store.load_version(number)
        state = without_rule(version.state)  # which goes on
        model, origin = self.template.successor(), Origin.from_state(version.state)
        if not model.keeps_references:
            # A rival cannot take a label back: it learns from the same traces as they are labelled now.
            origin = replace(origin, corrected_to=self._corrected_to)
        if model.needs_refit(state) and not refit(model, self.store, origin):
            raise StoreError(
                f"Expected the traces that version {number} was fitted on as they were stored, some have changed; "
                "see `dengine verify`, and restore the store from a copy."
            )
        model.set_state(state)
        model.prepare_safely(self.newest)
        references, _ = join_since(model, self.store, version, self.retrainer.window)
        origin = replace(origin, counts_from=self.retrainer.window.newest_seq)
        n = len(origin.seq)
        report = RetrainReport(self.next_number, self.clock() - begin, n, 0, True, f"rolled back to version {number}")
        self._record(event, report, model, references, origin)
        self.new_labels = 0
        if self.fleet is not None:
            self.fleet.begin_counting()
        return report

    def set_policy(self, policy: Policy | None, telling: Telling, event: Change) -> None:
        """Go on under another policy, as a new version of the same model; None: only what the engine looks at changed.

        telling : what its rule is to be told.
        """
        template, model = self.template, self.answering
        if policy is not None:
            template = template.under(policy)
            template.begin_safely_in(telling.began_in)
            if model is not None:
                model = model.under(policy)
                model.prepare_safely(template)
        if model is None or self._origin is None:
            self.store.record(event)
        else:
            reason = "another policy, the same model"
            report = RetrainReport(self.next_number, 0.0, len(self._origin.seq), 0, True, reason)
            self._record(event, report, model, self._references, self._origin)
        self.template, self.telling = template, telling

    def _record(
        self, event: Change, report: RetrainReport, model: EngineModel, references: References, origin: Origin
    ) -> None:
        """Store a version together with what a person did; then it answers."""
        state = self._state(model, references, origin)
        self.store.record(replace(event, version=(report, self.retrainer.window.newest_seq, state)))
        self.answering, self.version, self._news = model, report.version, report
        self._newest = report.version
        self._references, self._origin = references, origin

    def _state(self, model: EngineModel, references: References, origin: Origin) -> State:
        own = {"references": references.seqs()} if model.keeps_references else {}
        own |= {} if self.fleet is None else {"told_to": np.array(self.fleet.told_to)}
        return model.get_state() | origin.to_state() | own | {"corrected_to": np.array(self._corrected_to)}

    def retrain(self) -> RetrainReport:
        """Train and swap, in line."""
        self.collect(HUNG)
        self._begin()
        self._take(self.retrainer.train(self.newest))
        self._advance(to_the_end=True)
        assert self._news is not None  # nothing came in between; for the type checker
        return self._news

    def _begin(self) -> None:
        self.store_waiting()
        if self.fleet is not None:
            self.fleet.begin()
        self.new_labels = 0

    def _due(self, retrain_every: int) -> bool:
        return self.new_labels >= retrain_every if self.fleet is None else self.fleet.due(retrain_every)

    def work(self, retrain_every: int) -> RetrainReport | None:
        """Do what is due between two cycles: a retrain after so many labels, else a slice of the encoder's training.

        While the store is away nothing is retrained: a version answers only once it is stored.
        """
        if self._due(retrain_every) and self._ready():
            return self.start_retrain()
        if self.answering is not None:
            self.retrainer.improve(self.answering)
        return None

    def _ready(self) -> bool:
        try:
            self.store_waiting()
        except StoreError:  # told by the keeper; the labels wait in its journal
            return False
        return not self.keeper.fault

    @property
    def swapping(self) -> bool:
        """Whether a version that was trained beside the cell is on its way in."""
        return self._incoming is not None

    @property
    def busy(self) -> bool:
        """Whether a retrain is under way beside the cell, or its version on its way in."""
        return self.retrainer.busy or self.swapping

    def start_retrain(self) -> RetrainReport | None:
        """Train beside the cell where there is an executor, unless it is at it; else in line."""
        self.collect()
        if self.busy:
            return None
        if self.retrainer.executor is not None:
            self._begin()
            if self.retrainer.start(self.newest):
                return None
        return self.retrain()

    def collect(self, wait: float = 0.0, to_the_end: bool = False) -> None:
        """Bring in what an executor has finished: a step further, or to the end, as where it is waited for."""
        to_the_end |= wait > 0.0 or self.fleet is not None  # sisters' versions and corrections do not come in between
        trained = self.retrainer.collect(wait)
        if trained is not None:
            self._take(trained)
        if self._incoming is not None and (to_the_end or trained is None):  # to take it was a step
            self._advance(to_the_end)

    def _take(self, trained: Trained) -> None:
        self._incoming = Incoming(trained, self.newest, self.version, self.clock)

    def _advance(self, to_the_end: bool) -> None:
        """Bring the version on its way in a step further. One that cannot be stored is dropped."""
        incoming, window = self._incoming, self.retrainer.window
        assert incoming is not None  # the caller asked; for the type checker
        try:
            if incoming.storing is None:
                if not incoming.learn(window, np.inf if to_the_end else STEP):
                    return
                self.store_waiting()
                incoming.learn(window)
                incoming.storing = self._store(incoming)
            if not to_the_end and not incoming.storing.due:
                return
            number = incoming.storing.result()
        except StoreError as error:  # a version that is not stored would be gone with the process
            self._incoming = None
            self._not_stored(incoming.report, error)
            return
        try:
            self.store_waiting()  # what was confirmed since is to be among its references
        except StoreError as error:
            log.warning("version %d is stored, and answers once the labels since are: %s", incoming.report.version, error)
            return
        incoming.learn(window)
        self._incoming = None
        self._swap(incoming, number)

    def _store(self, incoming: Incoming) -> Asked[int | None]:
        model, state = incoming.model, None
        incoming.report = replace(incoming.report, seconds=incoming.seconds)  # storing it comes on top
        if model is not None:
            incoming.report = replace(incoming.report, version=self.next_number, accepted=True)
            state = self._state(model, incoming.references, self._origin_of(incoming))
        return self.keeper.version(incoming.report, self.retrainer.window.newest_seq, state)

    def _origin_of(self, incoming: Incoming) -> Origin:
        return Origin(incoming.seq, self._corrected_to, int(incoming.seq[-1]))

    def _swap(self, incoming: Incoming, number: int | None) -> None:
        report, model = incoming.report, incoming.model
        report = replace(report, version=report.version if number is None else number)  # one without products has no other
        if model is not None:
            model.untold = model.untold or self.newest.untold
            self._newest = report.version
            self.answering, self.version = model, report.version  # one reference is swapped
            self._references, self._origin = incoming.references, self._origin_of(incoming)
            if self.fleet is not None:
                self.fleet.swapped(model)
        self._news = report

    def _not_stored(self, report: RetrainReport, error: StoreError) -> None:
        """Drop a version with its reason; its labels are as many new ones, so that the next retrain is soon."""
        log.warning("a retrain was dropped, for it could not be stored: %s", error)
        self.new_labels += report.n_traces
        self._news = replace(report, version=self.version, accepted=False, reason=f"dropped: not stored: {error}")

    def take_news(self) -> RetrainReport | None:
        """The newest retrain, once."""
        news, self._news = self._news, None
        return news
