"""A version on its way in: it learns the labels that came during its training, is stored, and then answers.

Where it was trained beside the cell, the cell goes on meanwhile: all of this is done in steps that no part waits for.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .asking import Asked
from .model.base import EngineModel
from .records import RetrainReport
from .references import References
from .retraining import Trained
from .window import Window

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
