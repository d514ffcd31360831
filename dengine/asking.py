"""A call of a store, made in the keeper's thread, that whoever waits for it may give up."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import AbstractContextManager
from typing import Generic, TypeVar

from .errors import StoreError

T = TypeVar("T")
Committing = Callable[[Callable[[], bool]], AbstractContextManager[None]]


class Asked(Generic[T]):
    """A call on its way: given up before its commit begins, it writes nothing; afterwards it can't be given up any more.

    wait : seconds from now on that its result is waited for; None: as long as it takes.
    more : seconds beyond them for a commit that is under way by then, for it may succeed.
    lasting : it is made to its end, whether somebody waits for it or not.
    then : called once its result was taken.
    """

    def __init__(
        self,
        work: Callable[[], T],
        wait: float | None = None,
        more: float = 0.0,
        lasting: bool = False,
        then: Callable[[], object] = lambda: None,
    ) -> None:
        self._work, self._wait, self._more, self._then = work, wait, more, then
        self._began = time.monotonic()
        self._future: Future[T] = Future()  # runs from the moment of its commit on; until then it can be cancelled
        if lasting:
            self._future.set_running_or_notify_cancel()

    def run(self, committing: Committing) -> None:
        """Make the call, unless it was given up; what it raises is raised where its result is asked for."""
        if self._future.cancelled():
            return
        try:
            with committing(self._wanted):
                result = self._work()
        except BaseException as error:
            if self._wanted():
                self._future.set_exception(error)
        else:
            if self._wanted():
                self._future.set_result(result)

    @property
    def due(self) -> bool:
        """Whether its result is there, or is not waited for any longer."""
        return self._future.done() or (self._wait is not None and time.monotonic() - self._began >= self._wait)

    def result(self) -> T:
        """Return what the call returned. StoreError where it takes longer than it is waited for: then it is given up."""
        left = None if self._wait is None else max(0.0, self._began + self._wait - time.monotonic())
        result = self._result(left, self._more)
        self._then()
        return result

    def _result(self, wait: float | None, more: float) -> T:
        try:
            return self._future.result(wait)
        except TimeoutError as error:
            if self._future.done():  # the call's own
                raise
            late = error
        if not self._future.cancel() and more > 0.0:
            return self._result(more, 0.0)
        raise StoreError(f"no answer from the store within {self._wait:g} s.") from late

    def _wanted(self) -> bool:
        future = self._future
        return future.running() or (not future.cancelled() and future.set_running_or_notify_cancel())
