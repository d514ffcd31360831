"""A model's face towards many traces at once: what the engine asks one by one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..decision.neighbors import Counts
from ..traces import as_traces
from .base import Prediction


class ManyPredictions(ABC):
    """Predictions on many traces, from those on one."""

    @abstractmethod
    def predict_one(self, x: NDArray[np.float32], hash_: int = 0) -> Prediction:
        """What it says of one trace (C, T)."""

    def predict_many(self, X: ArrayLike) -> list[Prediction]:
        """The prediction on each trace of (n, T) or (n, C, T)."""
        return [self.predict_one(x) for x in as_traces(X)]

    def count(self, X: ArrayLike) -> Counts:
        """(n_success, n_failure), each (n,): labels in the balls around each trace, summed over the K spaces."""
        found = self.predict_many(X)
        return np.array([p.n_success for p in found], dtype=np.int64), np.array([p.n_failure for p in found], np.int64)

    def predict_interval(self, X: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(lower, upper), each (n,): the bound on each trace's success probability."""
        found = self.predict_many(X)
        return np.array([p.lower for p in found]), np.array([p.upper for p in found])

    def decide(self, X: ArrayLike) -> NDArray[Any]:
        """(n,) array of `Action`."""
        return np.array([p.action for p in self.predict_many(X)], dtype=object)
