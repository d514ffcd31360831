"""A call of a store, made in the keeper's thread, that whoever waits for it may give up."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from contextlib import AbstractContextManager
from typing import Generic, TypeVar

from .errors import StoreError

T = TypeVar("T")
Committing = Callable[[Callable[[], bool]], AbstractContextManager[None]]


class Asked(Generic[T]):
    """A call on its way: given up before its commit begins, it writes nothing; afterwards it can't be given up any more.

    lasting : it is made to its end, whether somebody waits for it or not.
    """

    def __init__(self, work: Callable[[], T], lasting: bool = False) -> None:
        self._work = work
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

    def result(self, wait: float | None, more: float = 0.0) -> T:
        """Return what the call returned. StoreError where it takes longer than so many seconds: then it is given up.

        more : seconds to wait for a commit that is under way by then, for it may succeed.
        """
        try:
            return self._future.result(wait)
        except TimeoutError as error:
            if self._future.done():  # the call's own
                raise
            late = error
        if not self._future.cancel() and more > 0.0:
            return self.result(more)
        raise StoreError(f"no answer from the store within {wait:g} s.") from late

    def _wanted(self) -> bool:
        future = self._future
        return future.running() or (not future.cancelled() and future.set_running_or_notify_cancel())
