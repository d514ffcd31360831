"""k nearest neighbours that all agree: the authors' own predecessor."""

from __future__ import annotations

import numpy as np

from .base import Floats, Judgement, Labels, Rival, Traces, chosen, whole
from .features import References


class AgreeingNeighbours(Rival):
    """Accept where all k nearest labelled traces are successes, reject where all are failures, verify otherwise.

    k : how many have to agree. The distance is Euclidean between the force traces as they are, all channels in a row.

    The share of agreeing neighbours bounds nothing: alpha and LB have no effect, and k takes the place of a threshold.
    Every label counts from the next part on. `predict_interval` gives the share of successes twice; it is no bound.
    Source: Duan et al. (2025), as the paper's section "Related Work" describes it.
    """

    def __init__(self, alpha: float, lower_bound: float, seed: int = 0, *, k: int = 10) -> None:
        super().__init__(alpha, lower_bound, seed)
        self.k = whole("k", k)

    def _learn(self, X: Traces, good: Labels) -> bool:
        self._references = References(_rows(X), good)
        return len(good) >= self.k

    def _take(self, X: Traces, good: bool) -> None:
        self._references.add(_rows(X), good)

    def _judge(self, X: Traces) -> Judgement:
        from scipy.spatial.distance import cdist

        distances = cdist(_rows(X), self._references.points, "sqeuclidean")  # (n, references)
        nearest = np.argpartition(distances, self.k - 1, axis=1)[:, : self.k]
        n_success = self._references.good[nearest].sum(axis=1)
        share = n_success / self.k
        action = chosen(n_success == self.k, n_success == 0)
        return Judgement(action, share, share, n_success, self.k - n_success)


def _rows(X: Traces) -> Floats:
    return X.reshape(len(X), -1).astype(np.float64)
