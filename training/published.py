"""Published methods that dengine is compared with on the page of results: kernel densities with
Wilson's interval, a Gaussian process, and MiniRocket with a threshold of guaranteed risk.
`Contender` and `make_baseline` take them by the paths in `PUBLISHED`.
"""

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dengine.decision.intervals import normal_quantile, wilson_interval
from dengine.errors import SettingError, expect
from dengine.experiments.baselines import Baseline, BaselinePrediction, LabelledPoints
from dengine.records import Floats, is_number, is_whole

Labels = NDArray[np.bool_]
Traces = NDArray[np.float32]

# Bandwidths to choose among, in standard deviations of a component.
BANDWIDTHS = (0.03, 0.05, 0.08, 0.12, 0.2, 0.3, 0.5, 0.8)
MOST_CHOOSING = 1000  # traces that the bandwidth is chosen on: the work grows with their square
DIMENSIONS = 2
MOST_TRAINED = 500  # traces to train a Gaussian process on: the work grows with their cube


class ScaledComponents:
    """The first principal components of traces, scaled.

    Parameters
    ----------
    n_components : int
    whiten : bool
        Scale each component to unit variance. False divides all by the standard deviation of the
        first one, so that they keep their proportions.
    seed : int
    """

    def __init__(self, n_components: int, *, whiten: bool, seed: int) -> None:
        from dengine.reducers.pca import PcaReducer

        self.whiten = whiten
        self._pca = PcaReducer(n_components=n_components, random_state=seed)

    def fit(self, X: Traces) -> Floats | None:
        """Find the principal components of traces (n, C, T), as rows of C * T, and their scale.

        Returns
        -------
        Z : array, shape (n, n_components), or None
            The scaled components of these traces. None if there are `n_components` traces or fewer,
            or fewer samples in a trace (C * T) than components; components and scale then stay as
            they were.
        """
        try:
            components = np.asarray(self._pca.fit(X).transform(X), dtype=np.float64)
        except SettingError:
            return None
        deviation = components.std(axis=0)
        scale = deviation if self.whiten else np.full_like(deviation, deviation[0])
        self._scale = np.where(scale > 0.0, scale, 1.0)
        return np.asarray(components / self._scale)

    def transform(self, X: Traces) -> Floats:
        """Return the scaled components (n, d) of traces (n, C, T)."""
        return np.asarray(self._pca.transform(X) / self._scale, dtype=np.float64)


@dataclass(eq=False, kw_only=True)
class WilsonKernelDensity(Baseline):
    """Kernel-weighted counts of successes and failures, Wilson's interval, and the paper's rule.

    With weights w_i = exp(-|z - z_i|^2 / (2 h^2)) the success rate is m = sum w_i y_i / sum w_i,
    and the number of trials n = sum K_H(z - z_i) |H| / R(K), where K is the normal density and
    R(K) = (4 pi)^(-d/2): here 2 sum w_i. n is no count: a kernel wider than the data counts every
    label twice. So the bound holds only where the kernel is narrow and many labels lie within it.

    Our reading of the source: two principal components, and the likelihood of Wilson's centre,
    which one wrong neighbour does not send to 0.

    Parameters
    ----------
    bandwidth : float or None, default None
        h, in standard deviations of each principal component. None chooses among `BANDWIDTHS` at
        each training, by the leave-one-out likelihood of the labels.

    References
    ----------
    Iversen, Duan and Hagelskjær (2026), "Estimation of Confidence Bounds in Binary Classification
    using Wilson Score Kernel Density Estimation", arXiv:2602.20947; n and H as in
    github.com/SDU-Robotics/wilson-score-kde.
    """

    title = "Wilson-score kernel density"

    bandwidth: float | None = None

    def __post_init__(self) -> None:
        value = self.bandwidth
        is_valid = value is None or (is_number(value) and 0.0 < value < math.inf)
        expect(is_valid, "bandwidth to be a number above 0", value)
        self._components = ScaledComponents(DIMENSIONS, whiten=True, seed=self.seed)

    def _fit(self, X: Traces, good: Labels) -> bool:
        """Find the components and the bandwidth; return False if there are too few traces.

        All traces become references. If no bandwidth was given, it is chosen by the labels of the
        newest 1,000 traces.
        """
        Z = self._components.fit(X)
        if Z is None:
            return False
        self._references = LabelledPoints(Z, good)
        newest = LabelledPoints(Z[-MOST_CHOOSING:], good[-MOST_CHOOSING:])
        self.bandwidth_ = self.bandwidth or choose_bandwidth(newest, self.policy.alpha)
        return True

    def _add(self, X: Traces, good: bool) -> None:
        self._references.add(self._components.transform(X), good)

    def _predict(self, X: Traces) -> BaselinePrediction:
        """Return Wilson's interval of the kernel-weighted counts, and these counts, rounded."""
        distances = self._references.squared_distances(self._components.transform(X))
        counts = kernel_counts(distances, self._references.good, self.bandwidth_)
        lower, upper = wilson_interval(*counts, self.policy.alpha)
        rounded = (np.rint(count).astype(np.int64) for count in counts)
        return BaselinePrediction(lower, upper, *rounded)


def kernel_counts(distances: Floats, good: Labels, bandwidth: float) -> tuple[Floats, Floats]:
    """Sum the kernel weights of successes and of failures around each query, in two dimensions.

    A reference at squared distance D weighs 2 exp(-D / (2 bandwidth**2)).

    Parameters
    ----------
    distances : array, shape (n, m)
        Squared distances of n queries to m references.
    good : array of bool, shape (m,)
        Whether each reference is a success.
    bandwidth : float

    Returns
    -------
    n_success, n_failure : array of float, shape (n,)
        Not whole numbers.
    """
    weights = np.exp(-0.5 * distances / bandwidth**2) * 2.0 ** (DIMENSIONS / 2)
    return weights @ good, weights @ ~good


def choose_bandwidth(references: LabelledPoints, alpha: float) -> float:
    """Return the bandwidth among `BANDWIDTHS` under which the references' labels are most likely.

    The probability of each label is computed from the other labels, as the centre of Wilson's
    interval at error level `alpha`.
    """
    z = normal_quantile(alpha)
    distances = references.squared_distances(references.points)
    np.fill_diagonal(distances, np.inf)

    def log_likelihood(bandwidth: float) -> float:
        """Return the sum over the references of their labels' leave-one-out log-probability."""
        n_success, n_failure = kernel_counts(distances, references.good, bandwidth)
        rate = (n_success + z * z / 2.0) / (n_success + n_failure + z * z)
        return float(np.log(np.where(references.good, rate, 1.0 - rate)).sum())

    return max(BANDWIDTHS, key=log_likelihood)


@dataclass(eq=False, kw_only=True)
class GaussianProcess(Baseline):
    """scikit-learn's Gaussian-process classifier on principal components, and the paper's rule.

    The latent function f at a trace has mean m and variance v under Laplace's approximation; the
    interval of the success probability is sigmoid(m -+ z sqrt(v)), with z the 1 - alpha/2 normal
    quantile. It is a credible interval: it holds under the prior, a scaled squared exponential of
    one length scale. The method is trained on the newest 500 labels only, because of its cost. It
    needs scikit-learn 1.7, which gives the latent mean and variance.

    Parameters
    ----------
    n_components : int, default 5
        Principal components, which keep their proportions.
    amplitude : float, default 3.0
        Largest standard deviation that the prior of the latent function may have, above 1, in
        logits; 3 is a success rate of 5 to 95 %. The marginal likelihood drives it up where classes
        part well; then the interval stays wide even amid hundreds of successes.

    References
    ----------
    Rasmussen and Williams (2006), "Gaussian Processes for Machine Learning", Algorithms 3.1, 3.2.
    """

    title = "Gaussian process"

    n_components: int = 5
    amplitude: float = 3.0

    def __post_init__(self) -> None:
        is_valid = is_number(self.amplitude) and 1.0 < self.amplitude < math.inf
        expect(is_valid, "amplitude above 1", self.amplitude)
        self._components = ScaledComponents(self.n_components, whiten=False, seed=self.seed)

    def _fit(self, X: Traces, good: Labels) -> bool:
        """Train on the newest 500 labels; return whether this was done.

        It is not if they are of one class, or no more than `n_components`; the earlier fit stays.
        """
        from sklearn.gaussian_process import GaussianProcessClassifier
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel

        labels = good[-MOST_TRAINED:]
        if len(np.unique(labels)) < 2:
            return False
        Z = self._components.fit(X[-MOST_TRAINED:])
        if Z is None:
            return False
        kernel = ConstantKernel(1.0, (0.1, self.amplitude**2)) * RBF(0.5, (0.01, 10.0))
        classifier = GaussianProcessClassifier(kernel, random_state=self.seed)
        with warnings.catch_warnings():
            # It warns of an optimum at the limit of the amplitude, which is there on purpose.
            warnings.filterwarnings("ignore", message="The optimal value found")
            self._classifier = classifier.fit(Z, labels)
        return True

    def _predict(self, X: Traces) -> BaselinePrediction:
        """Return the credible interval of the success probability; no labels are counted."""
        from scipy.special import expit

        Z = self._components.transform(X)
        mean, variance = self._classifier.latent_mean_and_variance(Z)
        half = normal_quantile(self.policy.alpha) * np.sqrt(np.maximum(variance, 0.0))
        return BaselinePrediction(expit(mean - half), expit(mean + half))


def risk_bound(n_wrong: int, n: int, delta: float) -> float:
    """Return the largest risk at which n_wrong errors or fewer in n have probability delta.

    The paper's B*, the inversion of the binomial tail. It is 1 if all n are wrong, or n is 0.

    References
    ----------
    Geifman and El-Yaniv (2017), "Selective classification for deep neural networks", NIPS 30,
    Algorithm 1.
    """
    from scipy.special import betaincinv

    return 1.0 if n_wrong >= n else float(betaincinv(n_wrong + 1.0, n - n_wrong, 1.0 - delta))


def guaranteed_threshold(confidence: Floats, wrong: Labels, risk: float, delta: float) -> float:
    """Find the lowest confidence above which a classifier errs with at most the given risk.

    If these traces and the later ones are independent draws from one distribution, then with
    probability 1 - delta the share of errors at or above the threshold is at most `risk`.
    ceil(log2 m) thresholds, at least one, are tried by bisection, each with an equal share of
    delta.

    Parameters
    ----------
    confidence : array of float, shape (m,)
        Of traces that the classifier was not trained on.
    wrong : array of bool, shape (m,)
        Whether it errs on each.
    risk : float
        Share of errors that is tolerated.
    delta : float
        Probability with which the guarantee may fail.

    Returns
    -------
    threshold : float
        One of `confidence`; infinity if none that was tried can be guaranteed, or for m = 0.
    """
    if not len(confidence):
        return math.inf
    ordered = np.sort(confidence)
    threshold = math.inf
    n_looks = max(1, math.ceil(math.log2(len(ordered))))
    # Ranks, as in the paper.
    low = 1
    high = len(ordered)
    for _ in range(n_looks):
        rank = math.ceil((low + high) / 2)
        beyond = confidence >= ordered[rank - 1]
        if risk_bound(int(wrong[beyond].sum()), int(beyond.sum()), delta / n_looks) < risk:
            high = rank
            threshold = float(ordered[rank - 1])
        else:
            low = rank
    return threshold


@dataclass(eq=False, kw_only=True)
class RocketSelective(Baseline):
    """MiniRocket (aeon), logistic regression, and SGR's threshold on each side, with delta = alpha.

    For each training and each side by itself: with probability 1 - alpha over the held-out labels
    at most 1 - LB of what is decided on that side is wrong, for parts like those that were held
    out. In the loop these were verified or stopped. Of good parts beyond the threshold that are not
    confirmed only the bad ones return, which errs on the safe side for accepting; of rejected parts
    nothing returns. Nothing is learned between two trainings, and `predict_interval` gives the
    classifier's probability twice.

    Parameters
    ----------
    n_kernels : int, default 10000
        Of MiniRocket, 84 at least.
    holdout : float, default 0.5
        Share of the labels that choose the thresholds and train nothing; drawn again at each
        training.
    C : float, default 0.01
        Inverse strength of the logistic regression's penalty, as in scikit-learn; features are
        standardised.

    References
    ----------
    Dempster, Schmidt and Webb (2021), "MiniRocket", KDD; Geifman and El-Yaniv (2017), NIPS 30,
    Algorithm 1.
    """

    title = "MiniRocket, logistic, SGR"

    n_kernels: int = 10_000
    holdout: float = 0.5
    C: float = 0.01

    def __post_init__(self) -> None:
        from aeon.transformations.collection.convolution_based import MiniRocket
        from sklearn.linear_model import LogisticRegression
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler

        is_share = is_number(self.holdout) and 0.0 < self.holdout < 1.0
        expect(is_share, "holdout to be a number above 0 and below 1", self.holdout)
        is_count = is_whole(self.n_kernels, 84, 2**31)
        expect(is_count, "n_kernels to be an integer of at least 84", self.n_kernels)
        features = MiniRocket(n_kernels=self.n_kernels, random_state=self.seed)
        # Compiles the features here, so that no training is timed with that.
        features.fit_transform(np.eye(20, dtype=np.float32)[:, None, :])
        regression = LogisticRegression(C=self.C, max_iter=1000)
        self._classifier: Any = make_pipeline(features, StandardScaler(), regression)

    def _fit(self, X: Traces, good: Labels) -> bool:
        """Train on some labels and set `thresholds` by the others; return whether it trained.

        It needs both classes among the labels to train on, and at least one other label. If no
        threshold can be guaranteed for accepting, or for rejecting, an infinite one is set, so that
        no part is decided that way.
        """
        order = np.random.default_rng(self.seed).permutation(len(X))
        n_held_out = round(self.holdout * len(X))
        train = np.sort(order[n_held_out:])
        held_out = np.sort(order[:n_held_out])
        if len(np.unique(good[train])) < 2 or not len(held_out):
            return False
        self._classifier.fit(X[train], good[train])
        p = self._predict(X[held_out]).lower
        labels = good[held_out]
        self.thresholds = (self._threshold(p, labels), 1.0 - self._threshold(1.0 - p, ~labels))
        return True

    def _predict(self, X: Traces) -> BaselinePrediction:
        p = np.asarray(self._classifier.predict_proba(X)[:, 1], dtype=np.float64)
        return BaselinePrediction(p, p)

    def _threshold(self, p: Floats, right: Labels) -> float:
        """Return the probability of one side from which on that side is decided.

        Infinity if none is guaranteed. Only traces with a probability above one half are
        considered.

        Parameters
        ----------
        p : array, shape (m,)
            Probability of that side, of traces that were held out.
        right : array of bool, shape (m,)
            Whether that side is right.
        """
        called = p > 0.5
        risk = 1.0 - self.policy.lower_bound
        return guaranteed_threshold(p[called], ~right[called], risk, self.policy.alpha)


METHODS: dict[str, type[Baseline]] = {
    "wskde": WilsonKernelDensity,
    "gp": GaussianProcess,
    "minirocket": RocketSelective,
}
PUBLISHED = {name: f"{__name__}:{kind.__name__}" for name, kind in METHODS.items()}
