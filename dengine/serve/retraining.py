"""The process in which a served engine retrains: another one, so that no decision waits for Python's lock."""

from __future__ import annotations

import multiprocessing
import os
import queue
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from .parcels import receive, send

NICE = 10  # decisions first, where cores are scarce
ENDED = "The retraining process has ended."

T = TypeVar("T")


class RetrainingProcess(Executor):
    """An executor of one process, started anew and not forked: this one has threads, and a fork would have their locks.

    It ends with this process, also when this one is killed.
    """

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, other = context.Pipe()
        self._process = context.Process(target=_work, args=(other,), name="dengine-retraining", daemon=True)
        with _unheard():
            self._process.start()
        other.close()
        self._jobs: queue.SimpleQueue[tuple[Future[Any], Any] | None] = queue.SimpleQueue()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="dengine-retraining", daemon=True)
        self._thread.start()

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Call a function there, after what was submitted before; BrokenExecutor where the process has ended."""
        if self._ended:
            raise BrokenExecutor(ENDED)
        future: Future[T] = Future()
        self._jobs.put((future, (fn, args, kwargs)))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the process, whatever it is at: a retrain that was worth waiting for, its engine has waited for."""
        self._ended = True
        self._jobs.put(None)
        self._process.kill()
        self._process.join()
        self._thread.join()  # it finds the other end closed
        self._connection.close()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            future, call = job
            if future.set_running_or_notify_cancel():
                self._answer(future, call)

    def _answer(self, future: Future[Any], call: Any) -> None:
        try:
            send(self._connection, call)
            result, error = receive(self._connection)
        except (EOFError, OSError):
            self._ended = True
            future.set_exception(BrokenExecutor(ENDED))
        except Exception as failure:  # it cannot be pickled
            future.set_exception(failure)
        else:
            future.set_result(result) if error is None else future.set_exception(error)


@contextmanager
def _unheard() -> Iterator[None]:
    """What is started here never hears the signals to the whole group, nor while it begins: its parent ends it in time."""
    resource_tracker.ensure_running()  # whose own start would let them through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def retraining_process() -> Iterator[Executor]:
    """A `RetrainingProcess`, ready for its first retrain soon."""
    with RetrainingProcess() as process:
        process.submit(_warm)
        yield process


# In that process


def _work(connection: Connection) -> None:
    with suppress(AttributeError, OSError):  # there is none on Windows
        os.nice(NICE)
    threading.Thread(target=_end_with_parent, name="dengine-parent", daemon=True).start()
    while True:
        try:
            fn, args, kwargs = receive(connection)
        except EOFError:
            return
        try:
            send(connection, (fn(*args, **kwargs), None))
        except Exception as error:  # raised where it was asked for
            send(connection, (None, RuntimeError(f"{type(error).__name__}: {error}")))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _warm() -> None:
    """Import what a retrain needs, before the first one."""
    from .. import engine as engine
