"""The process in which a served engine retrains: another one, so that no decision waits for Python's lock.

torch sends each tensor through shared memory of its own: a hundred of them hold Python's lock for tens of milliseconds, in
which nothing is answered. Here a call and its result go as plain bytes, pickled in the executor's own thread; arrays, the
most of it, through a file in memory, which is written and read without the lock.
"""

from __future__ import annotations

import ctypes
import logging
import multiprocessing
import os
import pickle
import signal
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

# The last is Ctrl-Break of Windows.
ENDING = [each for each in signal.Signals if each.name in ("SIGINT", "SIGTERM", "SIGBREAK")]
log = logging.getLogger("dengine")
NICE = 10  # decisions first, where cores are scarce
DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of linux/prctl.h
T = TypeVar("T")


class RetrainingProcess(ProcessPoolExecutor):
    """An executor of one process, started anew and not forked: this one has threads, and a fork would have their locks.

    It ends with the thread that made it, also when that one's process is killed, and imports what a retrain needs at once.
    """

    def __init__(self) -> None:
        super().__init__(1, multiprocessing.get_context("spawn"), _end_with_parent)
        others = set(multiprocessing.active_children())
        with _signals_blocked():
            self.submit(_warm_up).add_done_callback(partial(_tell_ready, time.monotonic()))
        (self._process,) = set(multiprocessing.active_children()) - others

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Call a function there, after what was submitted before; BrokenExecutor where the process has ended."""
        return super().submit(_call, _Plain((fn, args, kwargs)))  # type: ignore[arg-type]  # it arrives as what it holds

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the process, whatever it is at: a retrain that was worth waiting for, its engine has waited for."""
        self._process.kill()
        super().shutdown(wait, cancel_futures=cancel_futures)


@contextmanager
def _signals_blocked() -> Iterator[None]:
    """What is started meanwhile never hears the signals to the whole group: its parent ends it in time."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows: `_end_with_parent` ignores them there
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Plain:
    """Arrives on the other side as what it holds, as long as it lives here."""

    def __init__(self, what: Any) -> None:
        self._what = what

    def __reduce__(self) -> tuple[Any, ...]:
        if not hasattr(os, "memfd_create"):
            return pickle.loads, (pickle.dumps(self._what, 5),)
        arrays: list[pickle.PickleBuffer] = []
        pickled = pickle.dumps(self._what, 5, buffer_callback=arrays.append)
        descriptor = os.memfd_create("dengine")
        weakref.finalize(self, os.close, descriptor)
        with open(descriptor, "wb", closefd=False) as file:
            sizes = [file.write(each.raw()) for each in arrays]
        return _arrived, (pickled, f"/proc/{os.getpid()}/fd/{descriptor}", sizes)


def _arrived(pickled: bytes, path: str, sizes: list[int]) -> Any:
    arrays = [np.empty(size, np.uint8) for size in sizes]
    with Path(path).open("rb") as file:
        if [file.readinto(each.data) for each in arrays] != sizes:
            raise EOFError("Expected all arrays of a retrain, got fewer bytes.")
    return pickle.loads(pickled, buffers=arrays)


_SENT: list[_Plain] = []  # the newest result: it lives until the next, and is read long before


def _call(call: tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]) -> _Plain:
    fn, args, kwargs = call
    _SENT[:] = [_Plain(fn(*args, **kwargs))]
    return _SENT[0]


def _end_with_parent() -> None:
    """In that process, first of all: have it end when its parent does, be it at work in C++."""
    parent = multiprocessing.parent_process()
    assert parent is not None  # it was spawned
    for number in () if hasattr(signal, "pthread_sigmask") else ENDING:
        signal.signal(number, signal.SIG_IGN)
    if hasattr(os, "sched_setaffinity"):  # Linux
        ctypes.CDLL(None).prctl(DEATH_SIGNAL, signal.SIGKILL)
        if os.getppid() != parent.pid:  # it was killed before that
            os._exit(1)
        cores = sorted(os.sched_getaffinity(0))
        if len(cores) > 1:  # one is left to decisions alone, not the same one by every server of a machine
            os.sched_setaffinity(0, {*cores} - {cores[parent.pid % len(cores)]})
    else:
        threading.Thread(target=lambda: (wait([parent.sentinel]), os._exit(1)), daemon=True).start()
    if hasattr(os, "nice"):
        os.nice(NICE)


def _tell_ready(began: float, started: Future[None]) -> None:
    if not started.cancelled() and started.exception() is None:
        log.info("ready to retrain, in a process of its own, after %.1f s", time.monotonic() - began)


def _warm_up() -> None:
    """Import torch and its optimisers, before the first retrain."""
    from ..reducers.torch_reducer import warm_optimizer

    warm_optimizer()
