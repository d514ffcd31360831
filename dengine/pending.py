"""A retrain in an executor, which may die or hang: neither stops the cell."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future
from typing import Any, Generic, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

log = logging.getLogger("dengine")
HUNG = 60.0  # seconds after which work in the executor is given up

T = TypeVar("T")


class Pending(Generic[T]):
    """Work in an executor.

    seq : the labels that it was given.
    gave_up : whether the executor is of no more use. It is the caller's, and cannot be made anew here: what follows is done
        in line.
    """

    def __init__(self, future: Future[T], seq: NDArray[np.int64]) -> None:
        self.seq = seq
        self.gave_up = False
        self._future = future
        self._began = time.monotonic()

    @classmethod
    def submit(
        cls, executor: Executor, work: Callable[..., T], args: tuple[Any, ...], seq: NDArray[np.int64]
    ) -> Self | None:
        """Begin; None where the executor takes no more work, for it is broken or shut down."""
        try:
            return cls(executor.submit(work, *args), seq)
        except RuntimeError as error:
            log.error("the executor takes no more work, retrains are in line from now on: %s", error)
            return None

    def due(self, wait: float) -> bool:
        """Whether a result may be asked for: it is there, or worth so many seconds, or will not come."""
        return self._future.done() or wait > 0.0 or self._left() <= 0.0

    def result(self, wait: float) -> T:
        """Return it within so many seconds. Raises what the work raised, RuntimeError where it died or is not done."""
        try:
            return self._future.result(timeout=max(0.0, min(wait, self._left())))
        except BrokenExecutor as error:
            self.gave_up = True
            raise RuntimeError(f"{type(error).__name__}: {error} Retrains are in line from now on.") from error
        except TimeoutError as error:
            if self._future.done():  # the work's own
                raise
            self.gave_up = True
            self._future.cancel()
            seconds = time.monotonic() - self._began
            raise RuntimeError(
                f"not done after {seconds:.0f} s in the executor. Retrains are in line from now on."
            ) from error

    def _left(self) -> float:
        return self._began + HUNG - time.monotonic()
