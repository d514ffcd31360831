"""Work for the engine's thread, and whether anybody waits for it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Generic, TypeVar

from ..engine import DataEngine
from ..errors import BusyError

T = TypeVar("T")
CLOSING = "The server is closing: verify the part, and ask again when it is back."


class Job(Generic[T]):
    """Work for the engine's thread. late : nobody waits for its answer any more, and it has not begun."""

    def __init__(self, work: Callable[[DataEngine, bool], T]) -> None:
        self.future: Future[T] = Future()
        self._work = work
        self._lock = threading.Lock()
        self._begun = self._late = False

    def give_up(self) -> bool:
        """Wait no more; False where it has begun, and will be there at once."""
        with self._lock:
            self._late = self._late or not self._begun
            return self._late

    def run(self, engine: DataEngine) -> None:
        """Do it, in the engine's thread; also where whoever asked has gone meanwhile."""
        with self._lock:
            self._begun = True
            wanted = self.future.set_running_or_notify_cancel()
        try:
            result = self._work(engine, self._late or not wanted)
        except BaseException as error:  # whoever asked is told
            if wanted:
                self.future.set_exception(error)
            return
        if wanted:
            self.future.set_result(result)

    def refuse(self) -> None:
        """Do it no more: the engine is closed."""
        if self.future.set_running_or_notify_cancel():
            self.future.set_exception(BusyError(CLOSING))
