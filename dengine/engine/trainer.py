"""A retrain inside its time budget, in line or in an executor, which may die or hang: neither stops the cell.

The window that it sees: the newest labelled traces, in memory.
"""

import logging
import time
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor, Executor, Future
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray

from ..errors import DengineError, SettingError
from ..model.base import EngineModel
from ..reducers.base import StopRule
from ..store.records import Labelled

log = logging.getLogger("dengine")
HUNG = 60.0  # seconds after which work in the executor is given up
STEPS = 0.7  # of the budget, after which no step begins: each costs little, and a model that lacks some decides less
LATE = "ended by the clock, before its last step"

Clock = Callable[[], float]


class Window:
    """The newest `capacity` labelled traces, in memory, blind to labels. Work on it does not grow with the store.

    They lie in one block that is filled from its front and never overwritten, so that a snapshot is a view of it. A full
    one is left to those who look at it, and what the window holds goes on in another, half as long again.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._block: list[NDArray[Any]] = []
        self._first = self._end = 0  # what of it is held
        nothing = np.zeros(0, np.int64)
        self.refill(Labelled(nothing, np.zeros((0, 1, 1), np.float32), nothing.astype(np.int8), nothing))

    def __len__(self) -> int:
        return self._end - self._first

    @property
    def newest_seq(self) -> int:
        """Sequence number of the newest label; 0 before the first."""
        return int(self._block[0][self._end - 1]) if self._end else 0

    def add(self, trace: NDArray[np.float32], label: int, hash_: int, seq: int) -> None:
        """Take in one labelled trace (C, T); on a full window the oldest one leaves."""
        row = seq, trace, label, hash_
        if self._end == len(self._block[0]):
            held, n = [each[self._first :] for each in self._block], self._end - self._first
            room = n + max(n // 2, 64)
            shapes: list[tuple[int, ...]] = [(room,), (room, *trace.shape), (room,), (room,)]
            self._block = [np.empty(shape, each.dtype) for shape, each in zip(shapes, held, strict=True)]
            for new, each in zip(self._block, held if n else (), strict=False):
                new[:n] = each
            self._first, self._end = 0, n
        for column, value in zip(self._block, row, strict=True):
            column[self._end] = value
        self._end += 1
        self._first = max(self._first, self._end - self.capacity)

    def refill(self, labelled: Labelled) -> None:
        """Hold these, oldest first, in the place of all that was held."""
        self._block = [labelled.seq, labelled.traces, labelled.labels, labelled.hashes]
        self._end = len(labelled.seq)
        self._first = max(0, self._end - self.capacity)

    def snapshot(self) -> Labelled:
        """What is held, oldest first; it stays as it is, and is not to be written to."""
        return Labelled(*(column[self._first : self._end] for column in self._block))

    def newer(self, seq: int) -> list[int]:
        """Sequence numbers of the labels after this one, in the order in which they came."""
        held = self._block[0][self._first : self._end]
        newer: list[int] = held[np.searchsorted(held, seq, "right") :].tolist()
        return newer

    def row(self, seq: int) -> tuple[NDArray[np.float32], int, int]:
        """Trace (C, T), label and hash of a label that is held."""
        i = int(np.searchsorted(self._block[0][: self._end], seq))
        return self._block[1][i], int(self._block[2][i]), int(self._block[3][i])


@dataclass(frozen=True)
class TrainedOn:
    """What a version was trained on: labels seq (n,), corrected up to corrected_to.

    counts_from : newest label that the next retrain does not wait for.
    """

    seq: NDArray[np.int64]
    corrected_to: int
    counts_from: int

    def to_state(self) -> dict[str, NDArray[Any]]:
        """Plain arrays for the store."""
        numbers = {"trained_as": np.array(self.corrected_to), "counts_from": np.array(self.counts_from)}
        return {"trained_on": self.seq} | numbers

    @classmethod
    def from_state(cls, state: Mapping[str, NDArray[Any]]) -> Self:
        """What `to_state` gave."""
        return cls(state["trained_on"], int(state["trained_as"]), int(state["counts_from"]))


@dataclass(frozen=True)
class Limits:
    """What a retrain may use: seconds of wall time, and optimiser steps; None: no limit."""

    budget: float | None = None
    max_steps: int | None = None


@dataclass(frozen=True)
class Trained:
    """The outcome of a training.

    model : to swap in; None: dropped.  reason : why, in words.
    seconds : of the training.  begin : when work on it began, by the retrainer's clock.
    seq : the labels it was trained on.
    """

    model: EngineModel | None
    reason: str
    n_steps: int = 0
    seconds: float = 0.0
    begin: float = 0.0
    seq: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))


class Retrainer:
    """Trains candidates on a window, in line or beside the cell.

    clock : in seconds; it must pickle for a process executor.
    """

    def __init__(self, window: Window, limits: Limits, executor: Executor | None, clock: Clock = time.perf_counter) -> None:
        self.window, self.limits, self.executor, self.clock = window, limits, executor, clock
        self.future: Future[Trained] | None = None
        self._began = 0.0  # monotonic seconds
        self._seq = np.zeros(0, dtype=np.int64)  # labels that it was given

    def train(self, current: EngineModel, begin: float) -> Trained:
        """Train a successor of the current model, in line; begin : when work on it began."""
        return replace(train_candidate(current.successor(), self.window.snapshot(), self.limits, self.clock), begin=begin)

    def start(self, current: EngineModel) -> bool:
        """Train a successor of the current model beside the cell; False without an executor that takes work."""
        if self.executor is None:
            return False
        data = self.window.snapshot()
        if not self._began:
            log.info("the first retrain begins, on %d labels", len(data.seq))
        try:
            self.future = self.executor.submit(train_candidate, current.successor(), data, self.limits, self.clock)
        except RuntimeError as error:  # it is broken or shut down, and the caller's: it cannot be made anew here
            log.error("the executor takes no more work, retrains are in line from now on: %s", error)
            self.executor = None
        self._began, self._seq = time.monotonic(), data.seq
        return self.future is not None

    def collect(self, wait: float = 0.0) -> Trained | None:
        """What was trained beside the cell, once it is done, or after `wait` seconds: what is not done then is dropped."""
        future, left = self.future, self._began + HUNG - time.monotonic()
        if future is None or not (future.done() or wait > 0.0 or left <= 0.0):
            return None
        self.future = None
        try:
            trained = future.result(timeout=max(0.0, min(wait, left)))
        except Exception as error:  # recorded, and the old version goes on answering
            trained = Trained(None, self._failed(future, error), seq=self._seq)
        return replace(trained, begin=self.clock() - trained.seconds)

    def _failed(self, future: Future[Trained], error: Exception) -> str:
        """Why a training is dropped; an executor that died or hangs is of no more use."""
        own = future.done() and not isinstance(error, BrokenExecutor)
        log.error("a retrain in the executor failed: %s", error, exc_info=own)
        if own:
            return _dropped(error)
        self.executor = None
        future.cancel()
        what = f"{type(error).__name__}: {error}"
        if isinstance(error, TimeoutError):
            what = f"not done after {time.monotonic() - self._began:.0f} s in the executor."
        return f"dropped: RuntimeError: {what} Retrains are in line from now on."


def train_candidate(successor: EngineModel, data: Labelled, limits: Limits, clock: Clock) -> Trained:
    """Train a successor on the data; a plain function, so that any executor can run it.

    The gate reads no label: one on held-out loss would let fold k's labels choose encoder k.
    """
    torch.set_num_threads(1)  # per thread, and first thing in each
    begin = clock()
    deadline = None if limits.budget is None else begin + STEPS * limits.budget
    stop = StopRule(deadline, limits.max_steps, clock)
    n_steps, reason = 0, ""
    try:
        if not len(data.seq):
            raise SettingError("there is no labelled trace yet; report one first")
        report = successor.train(data.traces, data.labels, data.hashes, stop, data.seq).report
        n_steps, defect = report.n_steps, successor.defect()
        model = None if defect else successor
        said = ("accepted", report.note, LATE if stop.late else "")
        reason = f"dropped: {defect}" if defect else "; ".join(filter(None, said))
    except DengineError as error:
        model, reason = None, f"dropped: {error}"
    except Exception as error:  # no exception inside a model reaches the cell: it is recorded
        model, reason = None, _dropped(error)
    return Trained(model, reason, n_steps, clock() - begin, seq=data.seq)


def _dropped(error: Exception) -> str:
    lines = str(error).splitlines() or [""]
    return f"dropped: {type(error).__name__}: {lines[0]}"
