"""The model that answers, and how a new version takes its place."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .errors import StoreError
from .keeping import Keeper
from .model.base import EngineModel, Told
from .pending import HUNG
from .records import Reason, RetrainReport
from .resuming import resume, tell_all
from .retraining import Retrainer, Trained
from .store.records import StoredDecision

log = logging.getLogger("dengine")

Point = NDArray[np.float32]


class ModelVersions:
    """The versions of one engine's model: at most one answers, at most one is being trained.

    template : untrained; what the first version is trained from.
    answering : the model that answers; None before the first retrain.  version : its number, from 1; 0 before.
    new_labels : since the last retrain began.
    keeper : asks the store.
    store_waiting : stores what the rule was told of and the store not yet, StoreError where it cannot; called before any
        training or swap, since a version is stored after all that its rule was told of.
    """

    def __init__(self, template: EngineModel, retrainer: Retrainer, keeper: Keeper, clock: Callable[[], float]) -> None:
        self.template = template
        self.retrainer = retrainer
        self.keeper = keeper
        self.clock = clock
        self.answering: EngineModel | None = None
        self.version, self.new_labels = 0, 0
        self.store_waiting: Callable[[], None] = _nothing_waits
        self._news: RetrainReport | None = None

    @property
    def newest(self) -> EngineModel:
        """The model that answers, or the untrained one."""
        return self.answering or self.template

    def resume(self) -> None:
        """Go on from the store."""
        resumed = resume(self.keeper.store, self.template, self.retrainer.window)
        self.answering, self.version, self.new_labels = resumed.model, resumed.version, resumed.new_labels

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
        self.new_labels += 1

    def keep(self, known: StoredDecision, success: bool, seq: int) -> None:
        """Give a label that is stored to the next retrain."""
        self.retrainer.window.add(known.trace, int(success), known.content_hash, seq)

    def tell_anew(self) -> None:
        """Tell the rule everything again: what it was told was not what happened. StoreError where the store is away."""
        tell_all(self.newest, self.keeper.ask(lambda: self.keeper.store.evidence_since(0)))

    def retrain(self) -> RetrainReport:
        """Train and swap, in line."""
        self.collect(HUNG)
        self.store_waiting()
        self.new_labels = 0
        return self._swap(self.retrainer.train(self.newest))

    def work(self, retrain_every: int) -> RetrainReport | None:
        """Do what is due between two cycles: a retrain after so many labels, else a slice of the encoder's training.

        While the store is away nothing is retrained: a version answers only once it is stored.
        """
        if self.new_labels >= retrain_every and self._ready():
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

    def start_retrain(self) -> RetrainReport | None:
        """Train beside the cell where there is an executor, unless it is at it; else in line."""
        self.collect()
        if self.retrainer.busy:
            return None
        if self.retrainer.executor is not None:
            self.store_waiting()
            if self.retrainer.start(self.newest):
                self.new_labels = 0
                return None
        return self.retrain()

    def collect(self, wait: float = 0.0) -> None:
        """Swap in what an executor has finished, within so many seconds."""
        trained = self.retrainer.collect(wait)
        if trained is not None:
            self._swap(trained)

    def _swap(self, trained: Trained) -> RetrainReport:
        model, seq, reason = trained.candidate.model, trained.seq, trained.candidate.reason
        report = RetrainReport(self.version, 0.0, len(seq), trained.candidate.n_steps, False, reason)
        try:
            self.store_waiting()
            report = self._store(report, trained)
        except (
            StoreError
        ) as error:  # a version that is not stored would be gone with the process, and its decisions with it
            return self._not_stored(report, error)
        if model is not None:
            self.answering, self.version = model, report.version  # one reference is swapped
        self._news = report
        return report

    def _store(self, report: RetrainReport, trained: Trained) -> RetrainReport:
        model, seq, state = trained.candidate.model, trained.seq, None
        if model is not None:
            model.prepare_safely(self.newest)
            self.retrainer.window.catch_up(model, int(seq[-1]))  # labels that came in meanwhile are in the new version
            report = replace(report, version=self.version + 1, accepted=True)
            state = model.get_state() | {"trained_on": seq}
        # Until the version could answer; storing it comes on top.
        report = replace(report, seconds=self.clock() - trained.begin)
        self.keeper.version(report, self.retrainer.window.newest_seq, state)
        return report

    def _not_stored(self, report: RetrainReport, error: StoreError) -> RetrainReport:
        """Drop a version with its reason; its labels are as many new ones, so that the next retrain is soon."""
        log.warning("a retrain was dropped, for it could not be stored: %s", error)
        self.new_labels += report.n_traces
        self._news = replace(report, reason=f"dropped: not stored: {error}")
        return self._news

    def take_news(self) -> RetrainReport | None:
        """The newest retrain, once."""
        news, self._news = self._news, None
        return news


def _nothing_waits() -> None:
    """No label waits for the store."""
