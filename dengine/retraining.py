"""A retrain inside its time budget: the candidate, the gate, the swap's reserve."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from .errors import DengineError, SettingError
from .model.base import EngineModel
from .pending import Pending
from .reducers.base import StopRule
from .store.records import Labelled
from .window import Window

log = logging.getLogger("dengine")
SWAP_SECONDS = 0.05  # kept for labels that came in meanwhile, the swap, the commit
MARGIN = 1.2  # the tail grows a little with each retrain
SLICE_SECONDS = 0.2  # that the encoder trains between two cycles
STEP_SECONDS = 0.01  # of one step of the encoder's training, as a replay counts it
MOST_SECONDS = 2.0  # that it may have saved up: in the executor all of it at once
DRAWN = 1024  # traces that a slice trains on

Clock = Callable[[], float]


@dataclass(frozen=True)
class Limits:
    """What a retrain may use.

    budget : seconds of wall time for the whole; None: time decides nothing.
    max_steps : optimiser steps; None: as many as the reducer's own settings say.
    reserve : seconds kept for what follows the last step: re-embedding, compiling, the swap. The default serves until
        a tail was measured.
    """

    budget: float | None = None
    max_steps: int | None = None
    reserve: float = 0.3


@dataclass(frozen=True)
class Slice:
    """What one run of the encoder's training may use: seconds by the clock, or steps where a seed must repeat exactly."""

    seconds: float | None
    steps: int | None

    def stop(self, clock: Clock) -> StopRule:
        """The rule, from now on."""
        return StopRule(None if self.seconds is None else clock() + self.seconds, self.steps, clock)


class EncoderTime:
    """The time in which the encoder may train: so much a cycle on average, saved up and taken in slices.

    per_cycle : seconds.
    in_steps : whether a step counts as `STEP_SECONDS`, whatever it took.
    steps : taken so far.  seconds : that they counted as.  longest : seconds by the clock of the longest slice in line.
    """

    def __init__(self, per_cycle: float, in_steps: bool) -> None:
        self.per_cycle, self.in_steps = per_cycle, in_steps
        self.saved = 0.0
        self.steps, self.seconds, self.longest = 0, 0.0, 0.0

    def earn(self) -> None:
        """A cycle has begun."""
        self.saved = min(self.saved + self.per_cycle, max(MOST_SECONDS, self.per_cycle))

    def take(self, least: float = 0.0, most: float = MOST_SECONDS) -> Slice | None:
        """Up to `most` seconds of what is saved up, where it is `least` at least; None: nothing is due."""
        seconds = min(self.saved, most)
        if seconds <= 0.0 or self.saved < least:
            return None
        if self.in_steps:
            return Slice(None, steps) if (steps := round(seconds / STEP_SECONDS)) else None
        return Slice(seconds, None)

    def spend(self, steps: int, seconds: float) -> None:
        """Account for steps that took so long."""
        counted = steps * STEP_SECONDS if self.in_steps else seconds
        # What trained nothing, having nothing to train or failing at it, is not asked again at every cycle.
        self.saved = max(0.0, self.saved - counted) if steps else 0.0
        self.steps, self.seconds = self.steps + steps, self.seconds + counted


@dataclass(frozen=True)
class Candidate:
    """The outcome of a training.

    model : to swap in; None: dropped.  reason : why, in words.
    seconds : of the whole.  tail : of what followed the last step, the next retrain's reserve.
    encoder_steps, encoder_seconds : that the encoder trained before, beside the cell.
    """

    model: EngineModel | None
    reason: str
    n_steps: int
    seconds: float
    tail: float
    encoder_steps: int = 0
    encoder_seconds: float = 0.0


@dataclass(frozen=True)
class Trained:
    """A candidate, the labels it was trained on, and when that began by the retrainer's clock."""

    candidate: Candidate
    seq: NDArray[np.int64]
    begin: float


class Retrainer:
    """Trains candidates on a window, in line or beside the cell, and keeps time for what follows the last step.

    clock : seconds, of any origin; with a process executor it must pickle, as `time.perf_counter` does.
    encoder_time : in which the encoder may train; None: it never does.
    """

    def __init__(
        self,
        window: Window,
        limits: Limits,
        executor: Executor | None,
        clock: Clock = time.perf_counter,
        encoder_time: EncoderTime | None = None,
    ) -> None:
        self.encoder_time = encoder_time or EncoderTime(0.0, in_steps=True)
        self.window = window
        self.limits = limits
        self.executor = executor
        self.clock = clock
        self._pending: Pending[Candidate] | None = None

    @property
    def busy(self) -> bool:
        """Whether a retrain is under way beside the cell, or waits to be swapped in."""
        return self._pending is not None

    def improve(self, current: EngineModel) -> None:
        """Train the current model's encoder for a slice, in line, where one is due."""
        piece = self.encoder_time.take(SLICE_SECONDS, SLICE_SECONDS)
        if piece is None or self.executor is not None or not len(self.window):
            return
        begin = self.clock()
        steps = current.improve_safely(*self.window.draw(DRAWN), piece.stop(self.clock))
        seconds = self.clock() - begin
        self.encoder_time.spend(steps, seconds)
        self.encoder_time.longest = max(self.encoder_time.longest, seconds)

    def train(self, current: EngineModel) -> Trained:
        """Train a successor of the current model, in line."""
        begin, data = self.clock(), self.window.snapshot()
        candidate = train_candidate(current.successor(), data, self.limits, self.clock)
        return self._note(Trained(candidate, data.seq, begin))

    def start(self, current: EngineModel) -> bool:
        """Train a successor of the current model beside the cell; False where the executor takes no more work."""
        assert self.executor is not None  # the caller asked; for the type checker
        data, piece = self.window.snapshot(), self.encoder_time.take()
        work = (current.successor(), data, self.limits, self.clock, piece)
        self._pending = Pending.submit(self.executor, _train_beside, work, data.seq)
        self.executor = self.executor if self.busy else None
        return self.busy

    def collect(self, wait: float = 0.0) -> Trained | None:
        """What was trained beside the cell, once it is done, or after `wait` seconds: what is not done then is dropped."""
        pending = self._pending
        if pending is None or not pending.due(wait):
            return None
        self._pending = None
        try:
            candidate = pending.result(wait)
        except Exception as error:  # recorded, and the old version goes on answering
            log.error("a retrain in the executor failed: %s", error, exc_info=not pending.gave_up)
            candidate = Candidate(None, _dropped(error), 0, 0.0, 0.0)
            self.executor = None if pending.gave_up else self.executor
        self.encoder_time.spend(candidate.encoder_steps, candidate.encoder_seconds)
        return self._note(Trained(candidate, pending.seq, self.clock() - candidate.seconds))

    def _note(self, trained: Trained) -> Trained:
        if trained.candidate.model is not None:
            self.limits = replace(self.limits, reserve=SWAP_SECONDS + MARGIN * trained.candidate.tail)
        return trained


def _train_beside(successor: EngineModel, data: Labelled, limits: Limits, clock: Clock, piece: Slice | None) -> Candidate:
    torch.set_num_threads(1)  # per thread, and first thing in each
    begin, steps = clock(), 0
    if piece is not None and len(data.seq):
        steps = successor.improve_safely(data.traces, data.hashes, piece.stop(clock))
    seconds = clock() - begin
    return replace(train_candidate(successor, data, limits, clock), encoder_steps=steps, encoder_seconds=seconds)


def train_candidate(successor: EngineModel, data: Labelled, limits: Limits, clock: Clock) -> Candidate:
    """Train a successor on the data; a plain function of plain arguments, so that any executor can run it.

    The gate reads no label. One on held-out loss belongs to each head, inside the reducer: here it would let fold k's
    labels choose encoder k.
    """
    begin = clock()
    deadline = None if limits.budget is None else begin + max(0.0, limits.budget - limits.reserve)
    stop = StopRule(deadline, limits.max_steps, clock)
    n_steps, reason = 0, ""
    try:
        if not len(data.seq):
            raise SettingError("there is no labelled trace yet; report one first")
        report = successor.train(data.traces, data.labels, hashes=data.hashes, stop=stop).report
        n_steps, defect = report.n_steps, successor.defect()
        model = None if defect else successor
        reason = f"dropped: {defect}" if defect else "; ".join(filter(None, ("accepted", report.note)))
    except DengineError as error:
        model, reason = None, f"dropped: {error}"
    except Exception as error:  # no exception inside a model reaches the cell: it is recorded
        model, reason = None, _dropped(error)
    end = clock()
    return Candidate(model, reason, n_steps, end - begin, end - (stop.asked_at or begin))


def _dropped(error: Exception) -> str:
    lines = str(error).splitlines() or [""]
    return f"dropped: {type(error).__name__}: {lines[0]}"
