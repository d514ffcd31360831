"""A trained version that does not answer yet: it catches up on labels and is stored first.

`learner.Learner` takes a candidate through these steps, either to the end or one short step between
two cycles.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace

import numpy as np

from ..model.base import EngineModel
from ..records import RetrainReport
from .guard import GuardedModel
from .trainer import Trained, TrainedOn, TrainingWindow

PATIENCE = (
    20  # steps that a candidate waits for the labels' numbers before it asks the store for them
)


class Candidate:
    """The outcome of a training, until it answers or is dropped.

    Parameters
    ----------
    trained : Trained
    previous : EngineModel
        The model that answers meanwhile; its rule is taken over.
    version : int
        Of the previous model, for the report of a training that was dropped.
    clock : callable
        Seconds, of any origin.

    Attributes
    ----------
    model : EngineModel or None
        None where the training was dropped: then only the report is stored.
    report : RetrainReport
    trained_on : TrainedOn or None
        Set by `accept`.
    storing : Future or None
        The commit of the version, once it has begun; it returns the version's number in the store.
    """

    def __init__(
        self, trained: Trained, previous: EngineModel, version: int, clock: Callable[[], float]
    ) -> None:
        self.model = trained.model
        self.report = RetrainReport(
            version, 0.0, len(trained.seq), trained.n_steps, False, trained.reason
        )
        self.trained_on: TrainedOn | None = None
        self.storing: Future[int] | None = None
        self._clock = clock
        self._seq = trained.seq
        self._learned_to = int(trained.seq[-1]) if len(trained.seq) else 0
        self._patience = PATIENCE
        self._store_until = np.inf  # by `time.monotonic`
        if self.model is not None:
            GuardedModel(self.model).prepare(previous)
        # Of work on it; the cell's own work in between is not counted.
        self._seconds = clock() - trained.begin

    def catch_up(self, window: TrainingWindow, seconds: float = np.inf) -> bool:
        """Make labels that came since the training references, for at most so many seconds.

        Returns whether the candidate has all labels of the window now.
        """
        if self.model is None:
            return True
        missing = window.newer(self._learned_to)
        if not missing:
            return True
        guarded = GuardedModel(self.model)
        begin = self._clock()
        while missing and self._clock() - begin < seconds:
            seq = missing.pop(0)
            trace, label, hash_ = window.row(seq)
            guarded.add_reference(trace, label, hash_, seq)
            self._learned_to = seq
        self._seconds += self._clock() - begin
        return not missing

    def lose_patience(self) -> bool:
        """Count a step of waiting for the labels' numbers; returns whether there were too many."""
        self._patience -= 1
        return self._patience <= 0

    def accept(self, version: int, corrected_to: int) -> RetrainReport:
        """Complete the report, and where there is a model, accept it as the version of this number.

        `corrected_to` is the newest correction that its labels had. Returns the report, which the
        store keeps.
        """
        self.report = replace(self.report, seconds=self._seconds)  # storing it comes on top
        if self.model is not None:
            self.report = replace(self.report, version=version, accepted=True)
            self.trained_on = TrainedOn(self._seq, corrected_to, int(self._seq[-1]))
        return self.report

    def begin_storing(self, storing: Future[int], seconds: float) -> None:
        """Note that the version's commit has begun, and how many seconds it may take to begin."""
        self.storing = storing
        self._store_until = time.monotonic() + seconds

    def may_go_on_storing(self) -> bool:
        """Return whether the commit is under way, or has time left to begin."""
        storing = self.storing
        if storing is None or storing.done():
            return False
        return storing.running() or time.monotonic() < self._store_until

    def number(self, version: int) -> None:
        """Take the number that the store gave the version; 0 keeps the number that it has.

        The two differ where a peer's version was stored first.
        """
        self.report = replace(self.report, version=version or self.report.version)
