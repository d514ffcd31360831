"""Wilson-score kernel density classification: the paper's classifier with a Gaussian kernel in place of a ball."""

from __future__ import annotations

import numpy as np

from ...decision.bounds import normal_quantile, wilson_interval
from .base import Counts, Floats, Judgement, Labels, Rival, Traces, positive
from .features import Components, References

BANDWIDTHS = (0.03, 0.05, 0.08, 0.12, 0.2, 0.3, 0.5, 0.8)  # to choose among, in deviations of a component
NEWEST = 1000  # traces that the bandwidth is chosen on: the work grows with their square
DIMENSIONS = 2


class WilsonKernelDensity(Rival):
    """Kernel-weighted counts of successes and failures, Wilson's interval, and the paper's rule.

    bandwidth : h, in deviations of each principal component; None: chosen at each training, among `BANDWIDTHS`, by the
        leave-one-out likelihood of the labels.

    With weights w_i = exp(-|z - z_i|^2 / (2 h^2)) the success rate is the kernel regression m = sum w_i y_i / sum w_i, and
    the number of trials is n = sum K_H(z - z_i) |H| / R(K), K the normal density and R(K) = (4 pi)^(-d/2) its squared
    integral: n = 2^(d/2) sum w_i, here 2 sum w_i. That is the sample size which the asymptotic variance of kernel
    regression, m (1 - m) R(K) / (N h^d f), stands for, and where traces lie densely it equals Kish's (sum w)^2 / sum w^2.
    It is no count: a lone label at the very place of the query counts as two, and a kernel wider than the data counts
    every label twice. So the method has a bound in form, but only where the kernel is narrow and many labels lie within.

    Source: Iversen, Duan and Hagelskjær (2026), "Estimation of Confidence Bounds in Binary Classification using Wilson
    Score Kernel Density Estimation", arXiv:2602.20947; n, and H in proportion to the root of the covariance, as in the
    authors' public implementation, github.com/SDU-Robotics/wilson-score-kde. Our reading: two principal components as
    features, and the likelihood of Wilson's centre, (n m + z^2 / 2) / (n + z^2), which no lone wrong neighbour sends to 0.
    """

    def __init__(self, alpha: float, lower_bound: float, seed: int = 0, *, bandwidth: float | None = None) -> None:
        super().__init__(alpha, lower_bound, seed)
        self.bandwidth = None if bandwidth is None else float(positive("bandwidth", bandwidth))
        self._components = Components(DIMENSIONS, whiten=True, seed=seed)

    def _learn(self, X: Traces, good: Labels) -> bool:
        if not self._components.can_fit(X):
            return False
        Z = self._components.fit(X)
        self._references = References(Z, good)
        self.bandwidth_ = self.bandwidth or chosen_bandwidth(Z[-NEWEST:], good[-NEWEST:], self.policy.alpha)
        return True

    def _take(self, X: Traces, good: bool) -> None:
        self._references.add(self._components.transform(X), good)

    def _judge(self, X: Traces) -> Judgement:
        Z, held = self._components.transform(X), self._references
        n_success, n_failure = kernel_counts(squared_distances(Z, held.points), held.good, self.bandwidth_)
        lower, upper = wilson_interval(n_success, n_failure, self.policy.alpha)
        return self._by_bound(lower, upper, _rounded(n_success), _rounded(n_failure))


def squared_distances(Z: Floats, points: Floats) -> Floats:
    """(n, d) and (m, d) -> (n, m)."""
    from scipy.spatial.distance import cdist

    return np.asarray(cdist(Z, points, "sqeuclidean"))


def kernel_counts(distances: Floats, good: Labels, bandwidth: float) -> tuple[Floats, Floats]:
    """(n_success, n_failure), each (n,), no whole numbers: from squared distances (n, m) in two dimensions, labels (m,)."""
    weights = np.exp(-0.5 * distances / bandwidth**2) * 2.0 ** (DIMENSIONS / 2)
    return weights @ good, weights @ ~good


def chosen_bandwidth(Z: Floats, good: Labels, alpha: float) -> float:
    """The bandwidth among `BANDWIDTHS` under which labels (n,) at Z (n, 2) are most likely, each left out in turn."""
    distances = squared_distances(Z, Z)
    np.fill_diagonal(distances, np.inf)
    z = normal_quantile(alpha)
    return max(BANDWIDTHS, key=lambda h: _log_likelihood(*kernel_counts(distances, good, h), good, z))


def _log_likelihood(n_success: Floats, n_failure: Floats, good: Labels, z: float) -> float:
    rate = (n_success + z * z / 2.0) / (n_success + n_failure + z * z)
    return float(np.log(np.where(good, rate, 1.0 - rate)).sum())


def _rounded(counts: Floats) -> Counts:
    return np.rint(counts).astype(np.int64)
