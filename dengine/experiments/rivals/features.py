"""What rivals look at in place of a thousand samples: a few principal components, or means of segments; no labels."""

from __future__ import annotations

import numpy as np

from ...reducers.pca import PcaReducer
from .base import Floats, Labels, Traces


class Components:
    """The first principal components of traces, scaled.

    n_components : how many.
    whiten : each to unit variance; otherwise all by the first one's deviation, so that they keep their proportions.
    """

    def __init__(self, n_components: int, *, whiten: bool, seed: int) -> None:
        self.n_components, self.whiten = n_components, whiten
        self._pca = PcaReducer(n_components=n_components, random_state=seed)

    def can_fit(self, X: Traces) -> bool:
        """Whether traces (n, C, T) are enough."""
        return len(X) > self.n_components and X[0].size >= self.n_components

    def fit(self, X: Traces) -> Floats:
        """Find the components of traces (n, C, T); returns these traces as (n, d)."""
        placed = self._place(self._pca.fit(X), X)
        deviation = placed.std(axis=0)
        scale = deviation if self.whiten else np.full_like(deviation, deviation[0])
        self._scale = np.where(scale > 0.0, scale, 1.0)
        return np.asarray(placed / self._scale)

    def transform(self, X: Traces) -> Floats:
        """(n, C, T) -> (n, d)."""
        return np.asarray(self._place(self._pca, X) / self._scale)

    @staticmethod
    def _place(pca: PcaReducer, X: Traces) -> Floats:
        return np.asarray(pca.transform(X), dtype=np.float64)


def segment_means(X: Traces, segments: int) -> Floats:
    """(n, C, T) -> (n, C * segments): means of stretches of about equal length, at most T of them."""
    n, channels, samples = X.shape
    starts = np.unique(np.linspace(0, samples, min(segments, samples), endpoint=False).astype(int))
    lengths = np.diff(np.append(starts, samples))
    sums = np.add.reduceat(X.astype(np.float64), starts, axis=2)
    return np.asarray((sums / lengths).reshape(n, channels * len(starts)))


class References:
    """Labelled points (n, d) to which one more can be added at little cost."""

    def __init__(self, points: Floats, good: Labels) -> None:
        self._points, self._good, self._size = points.copy(), good.copy(), len(good)

    def __len__(self) -> int:
        return self._size

    @property
    def points(self) -> Floats:
        """(n, d)."""
        return self._points[: self._size]

    @property
    def good(self) -> Labels:
        """(n,)."""
        return self._good[: self._size]

    def add(self, point: Floats, good: bool) -> None:
        """One more point (1, d); the room doubles when it is used up."""
        if self._size == len(self._good):
            self._points = np.concatenate([self._points, np.empty_like(self._points)])
            self._good = np.concatenate([self._good, np.empty_like(self._good)])
        self._points[self._size], self._good[self._size] = point[0], good
        self._size += 1
