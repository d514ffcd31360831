"""`TrainingWindow` holds the newest labelled traces in memory; `Retrainer` trains a new version on
them within a time budget, in the calling thread or in an executor. `learner.Learner` decides when
to train, and what becomes of the result.

The retrainer trains a successor of the present model, on a snapshot of the window. No failure of a
training or of the executor stops the cell.
"""

import time
from collections import deque
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray

from ..decision.scripting import reason_of
from ..errors import DengineError, SettingError, counted, log
from ..model.base import NO_TRACES, EngineModel
from ..records import TRAINED, Arrays, Ints, State, TraceArray
from ..reducers.base import StopRule
from ..store.records import Clock, LabelledTraces
from .guard import NOT_PRECOMPUTED, guarded

HUNG = 60.0  # seconds after which a training in the executor is given up
# Share of the budget after which no step begins. It is smaller, down to the second, where the work
# after the steps takes longer. A model that lacks a few steps decides a little less often.
STEPS = 0.7
FEWEST_STEPS = 0.3
N_REMEMBERED = 20  # trainings; the next one reserves what the slowest of them took after its steps
LATE = "ended by the clock, before its last step"


class TrainingWindow:
    """The newest labelled traces, in memory, up to a capacity.

    Work on it does not grow with the store.

    The traces lie in one block that is filled from its front and never overwritten, so a snapshot
    is a view of it. When the block is full, the window goes on in another one, which has room for
    half as many rows again, and the old one stays with those who hold a snapshot.

    Parameters
    ----------
    capacity : int
        Number of labelled traces that the window holds at most.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        nothing = _no_numbers()
        self.refill(LabelledTraces(nothing, NO_TRACES, np.zeros(0, np.int8), nothing))

    def refill(self, labelled: LabelledTraces) -> None:
        """Replace the whole window by the newest of these labelled traces.

        They must be ordered by the numbers of their labels. Their arrays become those of the window
        and are not copied. Without any the window is empty.
        """
        self._block: list[NDArray[Any]] = [
            labelled.seq,
            labelled.traces,
            labelled.labels,
            labelled.hashes,
        ]
        # The window is the rows of the block from the first to the end.
        self._end = len(labelled.seq)
        self._first = max(0, self._end - self.capacity)

    def __len__(self) -> int:
        return self._end - self._first

    @property
    def newest_seq(self) -> int:
        """Sequence number of the newest label; 0 if the window is empty."""
        return int(self._block[0][self._end - 1]) if self._end else 0

    def add(self, trace: TraceArray, label: int, hash_: int, seq: int) -> None:
        """Add one labelled trace, shape (channels, samples); a full window loses its oldest one.

        `label` is 1 (good) or 0 (bad), `hash_` a hash of the part's number or of the trace
        (`StoredDecision.content_hash`), and `seq` the label's number, which must be larger than any
        before; this is not checked. All traces must have one shape. The trace is copied.
        """
        if self._end == len(self._block[0]):
            self._enlarge(trace.shape)
        for column, value in zip(self._block, (seq, trace, label, hash_), strict=True):
            column[self._end] = value
        self._end += 1
        self._first = max(self._first, self._end - self.capacity)

    def _enlarge(self, trace_shape: tuple[int, ...]) -> None:
        """Copy the window to the front of new arrays, which have room for half as many rows more.

        At least 64 rows more fit. A row is a labelled trace; `trace_shape` is the shape of one
        trace, which an empty window does not know. The old arrays, of which snapshots may be views,
        are not changed.
        """
        n = len(self)
        shapes = ((), trace_shape, (), ())
        for i, (column, shape) in enumerate(zip(self._block, shapes, strict=True)):
            room = np.empty((max(n // 2, 64), *shape), column.dtype)
            self._block[i] = np.concatenate([column[self._first :].reshape(n, *shape), room])
        self._first = 0
        self._end = n

    def snapshot(self) -> LabelledTraces:
        """Return the labelled traces of the window, oldest first.

        The arrays are views that never change, and are not to be written to.
        """
        return LabelledTraces(*[column[self._first : self._end] for column in self._block])

    def count_newer(self, seq: int) -> int:
        """Return how many labels of the window have a number above this one."""
        numbers = self._block[0][self._first : self._end]
        return len(numbers) - int(np.searchsorted(numbers, seq, "right"))

    def row_after(self, seq: int) -> tuple[int, TraceArray, int, int] | None:
        """Return the first label of the window with a number above this one; None without any.

        It is the label's number, its trace (channels, samples), the label (1 good, 0 bad) and the
        hash that `add` got. The trace is a view, not to be written to.
        """
        i = self._end - self.count_newer(seq)
        if i == self._end:
            return None
        numbers, traces, labels, hashes = self._block
        return int(numbers[i]), traces[i], int(labels[i]), int(hashes[i])


def _no_numbers() -> Ints:
    """Return an empty array of int64: the sequence numbers of the labels, if there are none."""
    return np.zeros(0, dtype=np.int64)


@dataclass(frozen=True)
class TrainedOn:
    """The labels that a version was trained on; by default none, before the first version.

    Attributes
    ----------
    seq : array of int64, shape (n,)
        Their sequence numbers.
    corrected_to : int
        Number of the newest correction that they had.
    counts_from : int
        Only labels with a larger number count as new for the next retrain.
    pinned : int
        Number of the earlier version that a rollback put in force again, and that no automatic
        retrain replaces; 0: the version is not pinned.
    """

    seq: Ints = field(default_factory=_no_numbers)
    corrected_to: int = 0
    counts_from: int = 0
    pinned: int = 0

    def has_seen(self, seq: int) -> bool:
        """Return whether the weights may have learned from the label of this number.

        They have if it is among these labels, or older than all of them: an earlier version had it.
        Without any labels it is False.
        """
        return bool(len(self.seq)) and (seq < self.seq[0] or seq in self.seq)

    def to_state(self) -> State:
        """Return the four attributes as arrays by name, for the store; `from_state` reads them.

        Their names are "trained_on" (`seq`, the numbers of the labels), "trained_as"
        (`corrected_to`, the number of the newest correction of a label that they had),
        "counts_from" (labels with larger numbers are new for the next retrain) and "pinned" (the
        number of the earlier version that a rollback put in force again, else 0).
        """
        return {
            "trained_on": self.seq,
            "trained_as": np.array(self.corrected_to),
            "counts_from": np.array(self.counts_from),
            "pinned": np.array(self.pinned),
        }

    @classmethod
    def from_state(cls, state: Arrays) -> Self:
        """Return the record that `to_state` turned into arrays.

        Without "pinned" this attribute is 0: the version (a trained model) is not one that a
        rollback put in use again. Arrays of other names are ignored. Raises KeyError without
        "trained_on" (the numbers of the labels), "trained_as" (the number of the newest correction
        of a label that they had) or "counts_from" (labels with larger numbers are new for the next
        retrain).
        """
        return cls(
            state["trained_on"],
            int(state["trained_as"]),
            int(state["counts_from"]),
            int(state.get("pinned", 0)),
        )


@dataclass(frozen=True)
class Trained:
    """The outcome of a training.

    Attributes
    ----------
    model : EngineModel or None
        To be put in force; None if the training is dropped.
    reason : str
        Why it is accepted or dropped, in words.
    n_steps : int
        Optimiser steps that were done.
    seconds : float
        Duration of the training.
    last_seconds : float
        Duration of its last step and of all work after that; 0 for a training without steps.
    begin : float
        When work on the retrain began, by the retrainer's clock.
    seq : array of int64, shape (n,)
        Sequence numbers of the labels that it was trained on.
    """

    model: EngineModel | None
    reason: str
    n_steps: int = 0
    seconds: float = 0.0
    last_seconds: float = 0.0
    begin: float = 0.0
    seq: Ints = field(default_factory=_no_numbers)


@runtime_checkable
class RestartableExecutor(Protocol):
    """An executor that takes seconds to start, and can be started again.

    Attributes
    ----------
    ready : Future
        Done when it can work; it fails if that will never be.
    """

    ready: Future[None]

    def restart(self) -> None:
        """End what it works on, and start it anew without waiting; OSError if that fails."""


class Retrainer:
    """Trains successors of a model on the window, in the calling thread or in an executor.

    Parameters
    ----------
    window : TrainingWindow
    budget : float or None
        Seconds of wall time of a retrain; None: no limit.
    max_steps : int or None
        Optimiser steps of a retrain; None: no limit.
    executor : concurrent.futures.Executor or None
        A `RestartableExecutor` that died or hangs is started again. Any other one is set to None
        when it died or takes no more work; one that hangs is used again when it is free.
    clock : callable
        Seconds, of any origin; it must pickle for a process executor.

    Attributes
    ----------
    future : Future or None
        The training under way in the executor.
    """

    def __init__(
        self,
        window: TrainingWindow,
        budget: float | None,
        max_steps: int | None,
        executor: Executor | None,
        clock: Clock = time.perf_counter,
    ) -> None:
        self.window = window
        self.budget = budget
        self.max_steps = max_steps
        self.executor = executor
        self.clock = clock
        self.future: Future[Trained] | None = None
        self._discarded: Future[Trained] | None = None  # may be at work; the next one waits for it
        self._began = 0.0  # when the executor could begin with the training, by `time.monotonic`
        self._seq = _no_numbers()  # of the labels that it was given
        self._last_seconds = deque([0.0], N_REMEMBERED)  # of the newest trainings

    def _step_seconds(self) -> float | None:
        """Return the seconds after which the next training begins no step; None without a budget.

        They are the time budget of a retrain, less the longest time that one of the newest 20
        trainings took for its last optimiser step and the work after it; but at least 30 % and at
        most 70 % of the budget.
        """
        if self.budget is None:
            return None
        seconds = min(STEPS * self.budget, self.budget - max(self._last_seconds))
        return max(FEWEST_STEPS * self.budget, seconds)

    def train(self, current: EngineModel, begin: float) -> Trained:
        """Train a successor of the current model in this thread, and return the outcome.

        The model decides whether a successor starts from the weights of the current model or from
        scratch. It is trained on the training window (the newest labelled traces) as it is now. The
        time budget (the seconds of a retrain), or `max_steps` optimiser steps, may end the training
        early; it is accepted all the same. `begin` is when work on the retrain began, in seconds by
        the clock. It is only put in the outcome; the time budget counts from the start of the
        training. The current model is not changed. If the training fails, the outcome has no model,
        and nothing is raised; but what copying a user's model raises is raised. How long the
        training took for its last step and the work after it is remembered: the longest of the
        newest 20 is reserved in the time budget of the next, but at least 30 % and at most 70 % of
        it. This thread then has one torch thread.
        """
        trained = train_candidate(
            current.successor(),
            self.window.snapshot(),
            self._step_seconds(),
            self.max_steps,
            self.clock,
        )
        self._last_seconds.append(trained.last_seconds)
        return replace(trained, begin=begin)

    def start(self, current: EngineModel) -> bool:
        """Begin to train a successor of the current model in the executor, on the present window.

        The window holds the newest labelled traces. The model decides whether a successor starts
        from the weights of the current model or from scratch. `collect` returns the outcome. No
        other training may be under way, which is not checked; but the executor may still work on a
        training that `discard` gave up, and the new one waits there until that is done.

        Returns False, and begins nothing, if there is no executor, if it refuses work, or if it
        hangs: it is not done with a discarded training after 60 s. An executor that refuses work or
        hangs is started again if it can be. If it cannot be, an executor that refuses work is given
        up, unless it still works on a discarded training. Logged are the first training, if the
        executor's process has imported its modules by then, the refusal, a restart that fails, and
        the giving up. What copying a user's model raises is raised.
        """
        executor = self.executor
        if executor is None:
            return False
        if self._count_seconds_left() <= 0.0 and self._discarded is not None:
            self._replace_executor()
            return False
        data = self.window.snapshot()
        if not self._began:
            log.info("the first retrain begins, on %s", counted(len(data.seq), "label"))
        arguments = (current.successor(), data, self._step_seconds(), self.max_steps, self.clock)
        try:
            self.future = executor.submit(train_candidate, *arguments)
        except RuntimeError as error:
            log.error("the executor takes no work, the retrain is in line: %s", error)
            self._replace_executor()
        self._began = time.monotonic()
        self._seq = data.seq
        return self.future is not None

    def discard(self) -> bool:
        """Give up the training under way, without waiting; return whether there was one.

        Its outcome is lost, also if it is done and was not collected. If the executor has begun
        with it, it goes on working, and the next training begins when it is done.
        """
        future = self.future
        if future is None:
            return False
        self.future = None
        if not future.cancel():
            self._discarded = future
        return True

    @property
    def is_done(self) -> bool:
        """Whether a training in the executor is done, and `collect` returns its outcome."""
        return self.future is not None and self.future.done()

    def _count_seconds_left(self) -> float:
        """Return how many seconds the executor's training has left, before it counts as hung.

        It has 60 s (HUNG) from when the executor could begin with it. This call lets the 60 s begin
        anew, by setting `_began`, while the executor's process still imports modules, and if a
        discarded training (one that `discard` gave up) is done by now; `_discarded` is then set to
        None. At 0 or below the training counts as hung, also if it only waits for a discarded one
        that hangs. If no training was begun, the number means nothing.
        """
        now = time.monotonic()
        executor = self.executor
        if isinstance(executor, RestartableExecutor) and not executor.ready.done():
            self._began = now
        if self._discarded is not None and self._discarded.done():
            self._discarded = None
            self._began = now
        return self._began + HUNG - now

    def collect(self, wait: float = 0.0) -> Trained | None:
        """Return the outcome of the training in the executor, once.

        Returns None if there is none or it is not done. With `wait` above 0 it blocks for at most
        `wait` seconds, and a training that is not done then is given up. Whatever `wait` is, a
        training that hangs (is not done after 60 s), or whose executor died, is given up, too; this
        is logged. The outcome of a training that was given up or failed has no model and says why.
        An executor that died or hangs is started again if it can be. Otherwise retrains run without
        it: from then on if it died, else until it is free. `begin` of the outcome is now minus the
        duration of the training. If it has an outcome, how long it took for its last optimiser step
        and the work after it is remembered: the longest of the newest 20 is reserved in the time
        budget of the next.
        """
        future = self.future
        left = self._count_seconds_left()
        if future is None or not (future.done() or wait > 0.0 or left <= 0.0):
            return None
        with suppress(Exception):  # an error of the training is raised again below
            future.result(timeout=max(0.0, min(wait, left)))
        is_done = future.done()
        try:
            trained = future.result(timeout=0.0)
        except Exception as error:  # the failure is recorded, and the old version goes on answering
            trained = Trained(None, self._give_up(is_done, error), seq=self._seq)
        else:
            self._last_seconds.append(trained.last_seconds)
        self.future = None
        return replace(trained, begin=self.clock() - trained.seconds)

    def _give_up(self, is_done: bool, error: Exception) -> str:
        """Log why a training failed, and return it as the reason of a dropped retrain.

        `error` is what the training, or waiting for it, raised, and `is_done` says whether the
        training was done by then. The reason begins with "dropped: ". If it was not done and its
        executor lives, it is discarded: its result is lost, and it never begins, or goes on until
        it ends if it has begun. An executor that died, or in which a training hangs, is started
        again or taken out of use (`_replace_executor`).
        """
        is_broken = isinstance(error, BrokenExecutor)
        training_raised = is_done and not is_broken
        log.error("a retrain in the executor failed: %s", error, exc_info=training_raised)
        reason = reason_of(error)
        if training_raised:
            return f"dropped: {reason}"
        if not is_broken:
            self.discard()
            reason = f"not done after {time.monotonic() - self._began:.0f} s in the executor."
        if is_broken or self._count_seconds_left() <= 0.0:
            self._replace_executor()
        return f"dropped: RuntimeError: {reason}"

    def _replace_executor(self) -> None:
        """Restart the executor if it is a `RestartableExecutor`; otherwise go on without it.

        The executor is a pool in which retrains run beside the engine; without it they run in the
        engine's own thread. A restart ends what it works on. If it raises OSError, that is logged,
        and the next retrain tries again. Any other executor is set to None, which is logged; but if
        it still works on a discarded training (one that was given up), it is kept, and used again
        once that is done.
        """
        executor = self.executor
        if isinstance(executor, RestartableExecutor):
            try:
                executor.restart()
            except OSError:
                log.exception("retrains are in line until their process can be started again")
        elif self._discarded is None:
            self.executor = None
            log.error("retrains are in line from now on")


def train_candidate(
    successor: EngineModel,
    data: LabelledTraces,
    step_seconds: float | None,
    max_steps: int | None,
    clock: Clock,
) -> Trained:
    """Train a model on labelled traces and return the outcome.

    The outcome has the model, a reason in words, the number of optimiser steps, the duration of the
    training, that of its last step with all work after it (0 without a step or without
    `step_seconds`), and the sequence numbers of the labels. `successor` is the model, which this
    changes in place. No step begins after `step_seconds` seconds or `max_steps` steps (None is no
    limit); only the first training of a model may take a few steps after `step_seconds`. A training
    that reaches a limit ends early and is accepted. Its reason says so if `step_seconds` ended it
    and the model's report has `n_steps_left` above 0. The reason of each accepted training has the
    note (a line for the operator) of that report, if there is one. Any exception, data without
    traces, and a defect of the trained model (`EngineModel.defect`) give an outcome without a
    model, whose reason begins with "dropped: ".

    `clock` returns seconds. The modules that a training imports are loaded first; their time does
    not count, and a failure of this is logged. Sets the present thread to one torch thread. It is a
    plain function, so that any executor can run it.
    """
    torch.set_num_threads(1)  # it holds for the present thread only
    guarded(NOT_PRECOMPUTED, successor.warm_up)
    begin = clock()
    stop = StopRule(None if step_seconds is None else begin + step_seconds, max_steps, clock)
    model: EngineModel | None = None
    n_steps = 0
    try:
        if not len(data.seq):
            raise SettingError("there is no labelled trace yet; report one first")
        report = successor.train(data.traces, data.labels, data.hashes, stop, data.seq).report
        n_steps = report.n_steps
        defect = successor.defect()
        if defect:
            reason = f"dropped: {defect}"
        else:
            model = successor
            remarks = (TRAINED, report.note, LATE if stop.late and report.n_steps_left else "")
            reason = "; ".join(filter(None, remarks))
    except DengineError as error:
        reason = f"dropped: {error}"
    except Exception as error:  # no exception inside a model reaches the cell
        reason = f"dropped: {reason_of(error)}"
    end = clock()
    last_seconds = 0.0 if stop.last_step is None else end - stop.last_step
    return Trained(model, reason, n_steps, end - begin, last_seconds, seq=data.seq)
