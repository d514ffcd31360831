"""A retrain inside its time budget: the data it sees, the candidate, the gate."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .errors import DengineError, SettingError
from .prediction import ModelPrediction
from .reducers.base import StopRule
from .store import Labelled
from .window import AnyModel, Window

log = logging.getLogger("dengine")
SWAP_SECONDS = 0.05  # kept for labels that came in meanwhile, the swap, the commit
MARGIN = 1.2  # the tail grows a little with each retrain
ACCEPTED = "accepted"


@dataclass(frozen=True)
class Limits:
    """What a retrain may use.

    budget : seconds of wall time for the whole; None: no clock is read.
    max_steps : optimiser steps; None: no limit.
    reserve : seconds kept for what follows the last step: re-embedding, scripting, the swap. The default serves until
        a tail was measured.
    """

    budget: float | None = None
    max_steps: int | None = None
    reserve: float = 0.25


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


@dataclass(frozen=True)
class Trained:
    """A candidate, the labels it was trained on, and when that began."""

    candidate: Candidate
    seq: NDArray[np.int64]
    begin: float
    clock: Callable[[], float]

    def elapsed(self) -> float:
        """Seconds since the data were taken, without the time a finished candidate waited for the cell."""
        return self.clock() - self.begin


class Retrainer:
    """Trains candidates on a window, in line or beside the cell, and keeps time for what follows the last step."""

    def __init__(
        self, window: Window, limits: Limits, executor: Executor | None, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self.window = window
        self.limits = limits
        self.executor = executor
        self.clock = clock
        self._pending: tuple[Future[Candidate], NDArray[np.int64]] | None = None

    @property
    def busy(self) -> bool:
        """Whether a retrain is under way beside the cell, or waits to be swapped in."""
        return self._pending is not None

    def train(self, answering: AnyModel) -> Trained:
        """Train in line."""
        begin = self.clock()
        data = self.window.snapshot()
        return self._note(Trained(train_candidate(*self._order(answering, data)), data.seq, begin, self.clock))

    def start(self, answering: AnyModel) -> None:
        """Train beside the cell."""
        assert self.executor is not None  # the caller asked; for the type checker
        data = self.window.snapshot()
        self._pending = (self.executor.submit(_train_beside, *self._order(answering, data)), data.seq)

    def finished(self, wait: bool = False) -> Trained | None:
        """What was trained beside the cell, once it is done."""
        if self._pending is None or not (wait or self._pending[0].done()):
            return None
        (future, seq), self._pending = self._pending, None
        try:
            candidate = future.result()
        except Exception as error:  # the worker died: recorded, and the old version goes on answering
            log.exception("a retrain in the executor failed")
            candidate = Candidate(None, _dropped(error), 0, 0.0, 0.0)
        return self._note(Trained(candidate, seq, self.clock() - candidate.seconds, self.clock))

    def _order(self, answering: AnyModel, data: Labelled) -> tuple[AnyModel, Labelled, Limits]:
        return answering.successor(), data, self.limits

    def _note(self, trained: Trained) -> Trained:
        if trained.candidate.model is not None:
            self.limits = replace(self.limits, reserve=SWAP_SECONDS + MARGIN * trained.candidate.tail)
        return trained


def _train_beside(*order: Any) -> Candidate:
    torch.set_num_threads(1)  # per thread, and first thing in each
    return train_candidate(*order)


def _dropped(error: Exception) -> str:
    lines = str(error).splitlines() or [""]
    return f"dropped: {type(error).__name__}: {lines[0]}"


def train_candidate(successor: AnyModel, data: Labelled, limits: Limits) -> Candidate:
    """Train a successor on the data; a plain function of plain arguments, so that any executor can run it."""
    begin = time.perf_counter()
    deadline = None if limits.budget is None else begin + max(0.0, limits.budget - limits.reserve)
    stop = StopRule(deadline, limits.max_steps)
    try:
        if not len(data.seq):
            raise SettingError("there is no labelled trace yet; report one first")
        successor.fit(data.traces, data.labels, hashes=data.hashes, stop=stop)
        reason = gate(successor)
    except DengineError as error:
        reason = f"dropped: {error}"
    except Exception as error:  # no exception inside a model reaches the cell: it is recorded
        reason = _dropped(error)
    end = time.perf_counter()
    accepted = reason.startswith(ACCEPTED)
    tail = end - (stop.asked_at or begin)
    return Candidate(successor if accepted else None, reason, successor.report.n_steps, end - begin, tail)


def gate(candidate: AnyModel) -> str:
    """Say accepted, with what the fit has to tell, or why the candidate is dropped; reads no label.

    A gate on held-out loss belongs to each head, inside the reducer: here it would let fold k's labels choose encoder k.
    """
    if isinstance(candidate, ModelPrediction) and not np.isfinite(candidate.index.ring.points.numpy()).all():
        return "dropped: the embedding of a reference is not finite"
    return f"{ACCEPTED}; {candidate.report.note}" if candidate.report.note else ACCEPTED
