"""The process in which a served engine retrains: another one, so that no decision waits for Python's lock."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing.connection import wait

NICE = 10  # decisions first, where cores are scarce


@contextmanager
def retraining_process() -> Iterator[Executor]:
    """An executor of one process, started anew and not forked: this one has threads, and a fork would have their locks.

    It ends with this process, also when this one is killed.
    """
    others = set(multiprocessing.active_children())  # are not ours to end
    pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _begin)
    pool.submit(_warm)
    try:
        yield pool
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        # A retrain that was worth waiting for, its engine has waited for.
        for process in set(multiprocessing.active_children()) - others:
            process.kill()
            process.join()


def _begin() -> None:
    for name in ("SIGINT", "SIGTERM"):  # sent to the whole group; its parent says when it is time to end
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    with suppress(AttributeError, OSError):  # there is none on Windows
        os.nice(NICE)
    threading.Thread(target=_end_with_parent, name="dengine-parent", daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _warm() -> None:
    """Import what a retrain needs, before the first one."""
    from .. import engine as engine
