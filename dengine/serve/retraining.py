"""`RetrainingProcess`, an executor with one process that can be started again, in which the engine
of `dengine serve` retrains.

In a process of its own a retrain never holds the lock of the interpreter that answers decisions.
Calls and results are pickled in the executor's thread into a file in memory (`memfd_create`), and
their arrays are written and read without that lock. `torch.multiprocessing` would pass each tensor
through shared memory of its own, which holds the lock for tens of milliseconds.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import pickle
import signal
import threading
import weakref
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from multiprocessing.connection import wait
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path
from typing import Any, TypeVar

# Signals that ask a process to end; SIGBREAK is Ctrl-Break on Windows.
END_SIGNALS = [
    number for number in signal.Signals if number.name in ("SIGINT", "SIGTERM", "SIGBREAK")
]
NICENESS = 10  # decisions go first if cores are scarce
PR_SET_PDEATHSIG = 1  # linux/prctl.h: send a signal when the parent ends
T = TypeVar("T")


class RetrainingProcess(Executor):
    """An executor with one spawned process that imports torch at once.

    The process ends with the thread that started it, even if that thread's process is killed. It
    is spawned, since a forked process would inherit locks that other threads hold.

    Attributes
    ----------
    ready : Future
        Done when the process can work; it fails if the process ends before.
    """

    ready: Future[None]

    def __init__(self) -> None:
        self._start()

    def _start(self) -> None:
        """Start a process that imports the modules that a retrain needs, and do not wait for it.

        `ready` is set to a new future, which is done when the modules are imported, and fails if
        they cannot be or the process ends before. Raises OSError if the process cannot be started.
        """
        context = _Spawning()
        self._pool = ProcessPoolExecutor(1, context, _prepare_process)
        self.ready = self._pool.submit(_warm_up)
        self._process = context.process

    def restart(self) -> None:
        """Kill the process, also at work, and start another; raises OSError if that fails.

        Calls that are not done fail. It returns before the new process is ready, for which `ready`
        is a new future.
        """
        self.shutdown(wait=False)
        self._start()

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Queue a call of a picklable function, which runs in the process after earlier calls.

        Returns the future of its result. Wait for it before you submit two more calls: the end of
        the second closes the file that holds the result. An exception of the call, or an argument
        or result that cannot be pickled, is the future's. Raises BrokenExecutor if the process has
        ended, and RuntimeError after `shutdown`.
        """
        call = _SharedPickle((fn, args, kwargs))
        return self._pool.submit(_call, call)  # type: ignore[arg-type]  # arrives as the tuple

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Kill the process at once, also during a retrain, whose future then fails.

        An engine waits for its retrain before this. With `wait` it returns when the executor's
        thread has ended. Later calls of `submit` raise RuntimeError, unless `restart` starts
        another process. `cancel_futures` is as in `Executor.shutdown`.
        """
        self._process.kill()
        self._pool.shutdown(wait, cancel_futures=cancel_futures)


class _Spawning(SpawnContext):
    """Makes the processes of a pool, and keeps the newest as `process`.

    Other threads may start processes, too, so `multiprocessing.active_children` does not tell.
    """

    def Process(self, **options: Any) -> SpawnProcess:  # type: ignore[override]  # noqa: N802
        """Return a new process, which is not started; the pool calls this."""
        self.process = SpawnProcess(**options)
        return self.process


class _SharedPickle:
    """Pickles a value into a file in memory, if the system has `memfd_create`.

    Unpickling this object gives the value. The file exists as long as this object, so keep the
    object until the other process has unpickled it.
    """

    def __init__(self, value: Any) -> None:
        self._value = value

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the function that unpickles the value, and its arguments; pickle calls this.

        The value is pickled now, into a new file, which is closed when this object is deleted. If
        the system has no `memfd_create`, it is pickled into bytes.
        """
        if not hasattr(os, "memfd_create"):
            return pickle.loads, (pickle.dumps(self._value),)
        descriptor = os.memfd_create("dengine")
        weakref.finalize(self, os.close, descriptor)
        # Of an array, pickle's protocol 5 writes and reads the memory itself, with no lock held.
        with open(descriptor, "wb", closefd=False) as file:
            pickle.dump(self._value, file, protocol=5)
        return _unpickle, (f"/proc/{os.getpid()}/fd/{descriptor}",)


def _unpickle(path: str) -> Any:
    """Return the value that a `_SharedPickle` of the other process wrote to the file at `path`.

    Raises OSError if the file is gone, because the object or its process has ended.
    """
    with Path(path).open("rb") as file:
        return pickle.load(file)


_NEWEST_RESULTS: deque[_SharedPickle] = deque(maxlen=2)  # a discarded one, and the next


def _call(call: tuple[Any, ...]) -> _SharedPickle:
    """Call a function, in the retraining process, and return its result for pickling.

    `call` is the function, its arguments and its keyword arguments. The result is kept until two
    more calls end; before that the server's process must have read it. Raises what the function
    raises.
    """
    fn, args, kwargs = call
    _NEWEST_RESULTS.append(_SharedPickle(fn(*args, **kwargs)))
    return _NEWEST_RESULTS[-1]


def _prepare_process() -> None:
    """Set up the retraining process; this runs in it before anything else.

    From now on Linux kills the process when the thread that started it ends, even during a call
    into C++; on another system it ends when its parent process ends. It ends at once, with exit
    code 1, if its parent has ended already. If the system has the functions for it, the process has
    a lower priority and, of several cores, does not run on one, which is left to the decisions of
    the server. It ignores the signals that ask a process to end (`END_SIGNALS`, like SIGINT):
    Ctrl-C reaches all processes of a terminal, but the server itself ends this process.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None  # it was spawned
    for number in END_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    if hasattr(os, "sched_setaffinity"):  # Linux
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent.pid:  # the parent ended before that
            os._exit(1)
        cores = sorted(os.sched_getaffinity(0))
        if len(cores) > 1:  # servers on the same machine leave out different cores
            os.sched_setaffinity(0, {*cores} - {cores[parent.pid % len(cores)]})
    else:
        threading.Thread(target=lambda: (wait([parent.sentinel]), os._exit(1)), daemon=True).start()
    if hasattr(os, "nice"):
        os.nice(NICENESS)


def _warm_up() -> None:
    """Import torch and take one step of its optimiser in this process, so that the first retrain
    need not wait for what torch imports then.
    """
    from ..reducers.torch_reducer import warm_optimizer

    warm_optimizer()
