"""A retrain inside its time budget: the data it sees, the candidate, the gate."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import DengineError
from .foreign import ForeignModel
from .prediction import ModelPrediction
from .reducers.base import FitReport, StopRule
from .store import Labelled

AnyModel = ModelPrediction | ForeignModel
WORSE = 1.5  # a held-out loss this many times the answering version's drops the candidate


class Window:
    """The newest `capacity` labelled traces, in memory, blind to labels. Work on it does not grow with the store."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.total = 0
        self._traces: NDArray[np.float32] | None = None
        self._labels = np.zeros(0, dtype=np.int8)
        self._hashes = np.zeros(0, dtype=np.int64)
        self._seq = np.zeros(0, dtype=np.int64)

    def __len__(self) -> int:
        return min(self.total, self.capacity)

    @property
    def newest_seq(self) -> int:
        """Sequence number of the newest label; 0 before the first."""
        return int(self._seq[(self.total - 1) % self.capacity]) if self.total else 0

    def add(self, trace: NDArray[np.float32], label: int, hash_: int, seq: int) -> None:
        """Take in one labelled trace (C, T); on a full window it takes the oldest one's place."""
        self._grow(trace)
        assert self._traces is not None  # for the type checker: _grow made it
        slot = self.total % self.capacity
        self._traces[slot], self._labels[slot], self._hashes[slot], self._seq[slot] = trace, label, hash_, seq
        self.total += 1

    def extend(self, labelled: Labelled) -> None:
        """Take in many, oldest first."""
        for row in zip(labelled.traces, labelled.labels, labelled.hashes, labelled.seq, strict=True):
            self.add(row[0], int(row[1]), int(row[2]), int(row[3]))

    def snapshot(self) -> Labelled:
        """What is held, oldest first. Nobody writes to these arrays afterwards."""
        n, first = len(self), self.total % self.capacity if self.total > self.capacity else 0
        order = (np.arange(n) + first) % self.capacity
        traces = np.zeros((0, 1, 1), dtype=np.float32) if self._traces is None else self._traces[order]
        return Labelled(self._seq[order], traces, self._labels[order], self._hashes[order])

    def _grow(self, trace: NDArray[np.float32]) -> None:
        # Doubled as needed: a full window of 10,000 x 1000 samples is 40 MB, and most cells start with none.
        room = 0 if self._traces is None else len(self._traces)
        if self.total < room or room == self.capacity:
            return
        size = min(self.capacity, max(64, 2 * room))
        grown = np.zeros((size, *trace.shape), dtype=np.float32)
        if self._traces is not None:
            grown[:room] = self._traces
        self._traces = grown
        self._labels = np.concatenate([self._labels, np.zeros(size - room, dtype=np.int8)])
        self._hashes, self._seq = (
            np.concatenate([a, np.zeros(size - room, dtype=np.int64)]) for a in (self._hashes, self._seq)
        )


@dataclass(frozen=True)
class Limits:
    """What a retrain may use.

    budget : seconds of wall time for the whole; None: no clock is read.
    max_steps : optimiser steps; None: no limit.
    reserve : seconds kept for what follows the last step: re-embedding, scripting, the swap.
    """

    budget: float | None = None
    max_steps: int | None = None
    reserve: float = 0.0


@dataclass(frozen=True)
class Candidate:
    """The outcome of a training: a model to swap in, or the reason why not.

    seconds : of the whole.  tail : of what followed the reducer's fit, the next retrain's reserve.
    """

    model: AnyModel | None
    reason: str
    n_steps: int
    seconds: float
    tail: float


def train_candidate(successor: AnyModel, previous: FitReport, data: Labelled, limits: Limits) -> Candidate:
    """Train a successor on the data; a plain function of plain arguments, so that any executor can run it."""
    begin = time.perf_counter()
    deadline = None if limits.budget is None else begin + max(0.0, limits.budget - limits.reserve)
    stop = StopRule(deadline, limits.max_steps)
    try:
        successor.fit(data.traces, data.labels, hashes=data.hashes, stop=stop)
        reason = gate(successor, previous)
    except DengineError as error:
        reason = f"dropped: {error}"
    except Exception as error:  # no exception inside a model reaches the cell: it is recorded
        reason = f"dropped: {type(error).__name__}: {str(error).splitlines()[0]}"
    end = time.perf_counter()
    accepted = reason == "accepted"
    tail = end - (stop.asked_at or begin)
    return Candidate(successor if accepted else None, reason, successor.report.n_steps, end - begin, tail)


def gate(candidate: AnyModel, previous: FitReport) -> str:
    """Say accepted, or why a candidate is dropped; reads held-out losses that no counted label chose."""
    loss, before = candidate.report.holdout_loss, previous.holdout_loss
    if isinstance(candidate, ModelPrediction) and not np.isfinite(candidate.index.ring.points.numpy()).all():
        return "dropped: the embedding of a reference is not finite"
    if loss > WORSE * before:  # false for the NaN of a reducer that reports none
        return f"dropped: held-out loss {loss:.3f}, more than {WORSE:g} times the answering version's {before:.3f}"
    return "accepted"
