"""Faults of processes: an executor that dies or hangs, Ctrl-C at any moment, a fork."""

from __future__ import annotations

import os
import signal
import time
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from typing import Any

import numpy as np

from dengine.engine import trainer
from dengine.errors import StoreError

from .harness import Cell, Outcome, Place, stream


class Hung(Executor):
    """Takes work and never does it."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Return what is never done."""
        return Future()


def killed_executor(outcome: Outcome, place: Place) -> None:
    """The process that retrains killed."""
    with ProcessPoolExecutor(1) as pool:
        cell = Cell(place, outcome, executor=pool)
        pool.submit(abs, 1).result()
        for worker in list(pool._processes):
            os.kill(worker, signal.SIGKILL)
            outcome.injected += 1
        cell.play(200)
        outcome.must(cell.engine.version > 0, "there was never another version")
        cell.options.clear()
        cell.finish()


def hung_executor(outcome: Outcome, place: Place) -> None:
    """An executor that never finishes; its deadline, a minute, is a second here."""
    before, trainer.HUNG = trainer.HUNG, 1.0
    try:
        cell = Cell(place, outcome, executor=Hung())
        outcome.injected += 1
        cell.play(60)
        time.sleep(1.1)
        cell.play(100)
        outcome.must(cell.engine.version > 0, "there was never another version")
        cell.options.clear()
        cell.finish()
    finally:
        trainer.HUNG = before


def interrupted(outcome: Outcome, place: Place) -> None:
    """Ctrl-C at a random moment of a decision, a report or a retrain."""
    cell, rng, armed = Cell(place, outcome), np.random.default_rng(0), False

    def interrupt(*_: object) -> None:
        nonlocal armed
        if armed:
            armed = False
            signal.raise_signal(signal.SIGINT)

    before = signal.signal(signal.SIGALRM, interrupt)
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
    for _ in range(300):
        try:
            armed = True
            signal.setitimer(signal.ITIMER_REAL, float(rng.uniform(1e-4, 0.02)))
            cell.play(1)
            armed = False
        except KeyboardInterrupt:
            outcome.injected += 1
            cell.next += 1
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    signal.signal(signal.SIGALRM, before)
    signal.signal(signal.SIGINT, handler)
    outcome.must(outcome.injected > 0, "nothing was interrupted")
    cell.finish()


def forked(outcome: Outcome, place: Place) -> None:
    """A fork of the engine's process that decides and reports on."""
    cell = Cell(place, outcome)
    for _ in range(5):
        cell.play(25)
        outcome.injected += 1
        pid = os.fork()
        if not pid:
            try:
                cell.engine.decide(stream().X[0])
            except StoreError:
                os._exit(0)
            os._exit(1)
        outcome.must(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0, "a fork could decide")
    cell.finish()


ON_SQLITE = (killed_executor, hung_executor, interrupted, forked)
