"""The model that answers, and how a new version takes its place."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .fleet import Fleet
from .model.base import EngineModel, Told
from .records import Reason, RetrainReport
from .resuming import resume, tell_all
from .retraining import Retrainer, Trained
from .store.base import Store
from .store.records import StoredDecision
from .store.shared import is_shared

Point = NDArray[np.float32]


class ModelVersions:
    """The versions of one engine's model: at most one answers, at most one is being trained.

    template : untrained; what the first version is trained from.
    answering : the model that answers; None before the first retrain.  version : its number, from 1; 0 before.
    new_labels : since the last retrain began.
    store_waiting : stores what the rule was told of and the store not yet; called before any training or swap, since a
        version is stored after all that its rule was told of.
    """

    def __init__(self, template: EngineModel, retrainer: Retrainer, store: Store, clock: Callable[[], float]) -> None:
        self.template = template
        self.retrainer = retrainer
        self.store = store
        self.clock = clock
        self.answering: EngineModel | None = None
        self.version, self.new_labels = 0, 0
        self.store_waiting: Callable[[], None] = _nothing_waits
        self.fleet = Fleet(store, self) if is_shared(store) else None
        self._news: RetrainReport | None = None

    @property
    def newest(self) -> EngineModel:
        """The model that answers, or the untrained one."""
        return self.answering or self.template

    def resume(self) -> None:
        """Go on from the store."""
        resumed = resume(self.store, self.template, self.retrainer.window)
        self.answering, self.version, self.new_labels = resumed.model, resumed.version, resumed.new_labels
        if self.fleet is not None:
            self.fleet.resume()

    def join(self) -> None:
        """Start a new cell on what the others of its product learned; without a product there is nothing."""
        if self.fleet is not None:
            self.resume()

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
        self.newest.tell_safely(Told(known.lower, known.upper, success, novel, silent))
        self.newest.add_safely(point, int(success), known.content_hash)
        self.new_labels += self.fleet is None  # a product's labels are counted in their order, when they are kept

    def keep(self, known: StoredDecision, success: bool, seq: int) -> None:
        """Give a label that is stored to the next retrain."""
        if self.fleet is not None:
            self.fleet.keep(known.trace, int(success), known.content_hash, seq)
            return
        self.retrainer.window.add(known.trace, int(success), known.content_hash, seq)

    def tell_anew(self) -> None:
        """Tell the rule everything again: what it was told of a part was not what happened; that counts as one label."""
        self.new_labels -= self.fleet is None
        tell_all(self.newest, self.store)

    def retrain(self) -> RetrainReport:
        """Train and swap, in line."""
        self.collect(wait=True)
        self._begin()
        return self._swap(self.retrainer.train(self.newest))

    def _begin(self) -> None:
        self.store_waiting()
        if self.fleet is not None:
            self.fleet.begin()
        self.new_labels = 0

    def _due(self, retrain_every: int) -> bool:
        return self.new_labels >= retrain_every if self.fleet is None else self.fleet.due(retrain_every)

    def work(self, retrain_every: int) -> RetrainReport | None:
        """Do what is due between two cycles: a retrain after so many labels, else a slice of the encoder's training."""
        if self._due(retrain_every):
            return self.start_retrain()
        if self.answering is not None:
            self.retrainer.improve(self.answering)
        return None

    def start_retrain(self) -> RetrainReport | None:
        """Train beside the cell where there is an executor, unless it is at it; else in line."""
        if self.retrainer.executor is None:
            return self.retrain()
        self.collect()
        if not self.retrainer.busy:
            self._begin()
            self.retrainer.start(self.newest)
        return None

    def collect(self, wait: bool = False) -> None:
        """Swap in what an executor has finished."""
        trained = self.retrainer.collect(wait)
        if trained is not None:
            self.store_waiting()
            self._swap(trained)

    def _swap(self, trained: Trained) -> RetrainReport:
        model, seq = trained.candidate.model, trained.seq
        if model is not None:
            model.prepare_safely(self.newest)
            self.retrainer.window.catch_up(model, int(seq[-1]))  # labels that came in meanwhile are in the new version
            self.answering, self.version = model, self.version + 1  # one reference is swapped
        report = RetrainReport(
            version=self.version,
            seconds=self.clock() - trained.begin,  # until the version answers; storing it comes on top
            n_traces=len(seq),
            n_steps=trained.candidate.n_steps,
            accepted=model is not None,
            reason=trained.candidate.reason,
        )
        state = None if model is None else model.get_state() | {"trained_on": seq}
        if self.fleet is not None:
            report = self.fleet.put_version(report, state)
        else:
            self.store.put_version(report, self.retrainer.window.newest_seq, state)
        self._news = report
        return report

    def take_news(self) -> RetrainReport | None:
        """The newest retrain, once."""
        news, self._news = self._news, None
        return news


def _nothing_waits() -> None:
    """No label waits for the store."""
