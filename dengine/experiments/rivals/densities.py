"""Gaussian-process classification, decided by a credible bound on the success probability.

Wilson-score kernel density classification: the paper's classifier with a Gaussian kernel in place of a ball.
"""

from __future__ import annotations

import warnings

import numpy as np

from ...decision.intervals import normal_quantile, wilson_interval
from ...errors import SettingError
from .base import Counts, Floats, Judgement, Labels, Rival, Traces, positive, whole
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


NEWEST_OF_GAUSSIAN_PROCESS = 500  # traces to train on: the work of a training grows with their cube


class GaussianProcess(Rival):
    """scikit-learn's Gaussian-process classifier on principal components; the paper's rule on its credible interval.

    n_components : principal components, which keep their proportions.
    amplitude : the largest deviation that the prior of the latent function may have, above 1, in logits. The marginal
        likelihood drives it up where classes part well; then the interval stays wide even amid hundreds of successes.

    The latent function f at a trace has mean m and variance v under Laplace's approximation; the interval of the success
    probability is sigmoid(m -+ z sqrt(v)), z the 1 - alpha/2 normal quantile as with Wilson. It is a credible interval: it
    holds under the prior, a scaled squared exponential of one length scale, both chosen by the marginal likelihood.
    Trained on the newest 500 labels only, because of its cost; nothing is learned between two trainings.
    Source: Rasmussen and Williams (2006), "Gaussian Processes for Machine Learning", Algorithms 3.1 and 3.2.
    Raises SettingError for a scikit-learn before 1.7, which does not tell the latent mean and variance.
    """

    def __init__(
        self, alpha: float, lower_bound: float, seed: int = 0, *, n_components: int = 2, amplitude: float = 3.0
    ) -> None:
        from sklearn.gaussian_process import GaussianProcessClassifier

        super().__init__(alpha, lower_bound, seed)
        if not hasattr(GaussianProcessClassifier, "latent_mean_and_variance"):
            raise SettingError("The rival gp needs scikit-learn 1.7 or newer; pip install -U scikit-learn.")
        self.n_components = whole("n_components", n_components)
        if positive("amplitude", amplitude) <= 1.0:
            raise SettingError(f"Expected amplitude above 1, got {amplitude!r}; 3 is a success rate of 5 to 95 %.")
        self.amplitude = float(amplitude)
        self._components = Components(n_components, whiten=False, seed=seed)

    def _learn(self, X: Traces, good: Labels) -> bool:
        from sklearn.gaussian_process import GaussianProcessClassifier
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel

        newest, labels = X[-NEWEST_OF_GAUSSIAN_PROCESS:], good[-NEWEST_OF_GAUSSIAN_PROCESS:]
        if not self._components.can_fit(newest) or len(np.unique(labels)) < 2:
            return False
        kernel = ConstantKernel(1.0, (0.1, self.amplitude**2)) * RBF(0.5, (0.01, 10.0))
        classifier = GaussianProcessClassifier(kernel, random_state=self.seed)
        with warnings.catch_warnings():  # it warns of an optimum at a limit, and the limit is meant
            warnings.filterwarnings("ignore", message="The optimal value found")
            self._classifier = classifier.fit(self._components.fit(newest), labels)
        return True

    def _judge(self, X: Traces) -> Judgement:
        mean, variance = self._classifier.latent_mean_and_variance(self._components.transform(X))
        lower, upper = credible_interval(mean, variance, self.policy.alpha)
        return Judgement.without_counts(self.policy.actions(lower, upper), lower, upper)


def credible_interval(mean: Floats, variance: Floats, alpha: float) -> tuple[Floats, Floats]:
    """(lower, upper), each (n,), of a probability whose logit is normal with this mean and variance."""
    from scipy.special import expit

    half = normal_quantile(alpha) * np.sqrt(np.maximum(variance, 0.0))
    return np.asarray(expit(mean - half)), np.asarray(expit(mean + half))
