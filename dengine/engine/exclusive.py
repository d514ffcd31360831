"""`ExclusiveUse`: the block that each call of an engine which decides or learns runs in."""

import signal
import threading
from types import FrameType
from typing import Any

from ..errors import StoreError


class ExclusiveUse:
    """A reentrant block that one thread enters at a time, and that SIGINT does not interrupt.

    Entering it while another thread is inside raises StoreError at once. A SIGINT that comes
    meanwhile is handled when the block ends, so that a label is stored and counted, or neither.
    Several are handled like one, and an exception of the handler is raised from the block. This
    holds in the main thread, for a handler that is a Python function; in other cases the handling
    of SIGINT is not changed.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._handlers: list[Any] = []  # of SIGINT before each block, of blocks within one another
        self._delayed: list[tuple[int, FrameType | None]] = []

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            raise StoreError(
                "Expected an engine that one thread uses, got a call while another thread "
                "is in one; use it in one thread."
            )
        try:
            # Python delivers signals to the main thread alone. An ignored signal interrupts
            # nothing, nor does one that C code handles.
            is_main = threading.current_thread() is threading.main_thread()
            handler = signal.getsignal(signal.SIGINT) if is_main else None
            if callable(handler):
                signal.signal(signal.SIGINT, self._delay)
        except BaseException:
            self._lock.release()
            raise
        self._handlers.append(handler)

    def _delay(self, number: int, frame: FrameType | None) -> None:
        """Remember a SIGINT; `__exit__` passes the first to the handler set before the block."""
        self._delayed.append((number, frame))

    def __exit__(self, *exception: object) -> None:
        handler = self._handlers.pop()
        try:
            if callable(handler):
                signal.signal(signal.SIGINT, handler)
                delayed = self._delayed
                self._delayed = []
                if delayed:
                    handler(*delayed[0])
        finally:
            self._lock.release()
