"""Methods that dengine is compared with, in the same loop; each decides by its own rule: nearest
neighbours, kernel densities, a Gaussian process, MiniRocket, always verify, never verify. `replay`
and `run_grid` make them by name, and an engine takes one as `model`.

>>> DataEngine(model=make_baseline("knn", Policy(alpha=0.1, lower_bound=0.9), seed=0))

Without a bound: always verify, never verify, and k neighbours that agree. With a bound of their
own: kernel densities, a Gaussian process, and thresholds with a guaranteed risk. `BASELINES` has
them by name; the settings of a baseline are the keyword-only fields of its class.
"""

import math
import warnings
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, fields
from importlib.util import find_spec
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..decision.intervals import normal_quantile, wilson_interval
from ..decision.policy import Policy
from ..errors import SettingError, expect
from ..records import ACTIONS, Floats, Ints, is_number, is_whole
from ..traces import as_traces

Counts = Ints
Labels = NDArray[np.bool_]
Traces = NDArray[np.float32]

# Bandwidths to choose among, in standard deviations of a component.
BANDWIDTHS = (0.03, 0.05, 0.08, 0.12, 0.2, 0.3, 0.5, 0.8)
MOST_CHOOSING = 1000  # traces that the bandwidth is chosen on: the work grows with their square
DIMENSIONS = 2
MOST_TRAINED = 500  # traces to train a Gaussian process on: the work grows with their cube


class BaselinePrediction(NamedTuple):
    """What a baseline says of n traces, as in `Decision`; the counts are 0 if it counts nothing.

    Attributes
    ----------
    lower, upper : array of float64, shape (n,)
        Interval of the success probability.
    n_success, n_failure : array of int64, shape (n,), or 0
        Labels behind it.
    """

    lower: Floats
    upper: Floats
    n_success: Counts | int = 0
    n_failure: Counts | int = 0


@dataclass(eq=False)
class Baseline(ABC):
    """A published method behind the five methods of `Model`.

    A subclass implements `_fit` and `_predict`, and `_add` if it learns between two trainings.
    Until a training succeeds, on enough labels of both classes, every part is verified.

    Parameters
    ----------
    policy : Policy
        Its alpha and lower_bound; the class says what it makes of them.
    seed : int, default 0
        Of everything drawn; the same seed and the same labels give the same decisions.

    Attributes
    ----------
    thresholds : (float, float) or None
        Lower bound from which on a part is accepted, and upper bound up to which it is rejected.
        None: LB and 1 - LB.
    is_trained : bool
    title : str
        For tables.
    library : str
        What it needs beyond dengine's dependencies.
    """

    title: ClassVar[str]
    library: ClassVar[str] = ""

    policy: Policy
    seed: int = 0
    thresholds: tuple[float, float] | None = field(default=None, init=False)
    is_trained: bool = field(default=False, init=False)
    # The engine asks three times about the same trace: its shape and bytes, and the prediction.
    _last: tuple[Any, BaselinePrediction] | None = field(default=None, init=False)

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Train from scratch and return self.

        If the labels are of one class, or too few for the method, the baseline is untrained
        afterwards, and every part is verified.

        Parameters
        ----------
        X : array, shape (n, C, T)
            Traces.
        y : array, shape (n,)
            1 is success, any other value failure.
        """
        traces = as_traces(X)
        good = np.asarray(y) == 1
        self._last = None
        self.is_trained = bool(good.any() and not good.all()) and self._fit(traces, good)
        return self

    def add(self, x: ArrayLike, y: Any) -> Self:
        """Learn one trace (C, T) with its label, 1 for success, and return self.

        Nothing is learned before a training has succeeded, or if the method learns only in `fit`.
        """
        self._last = None
        if self.is_trained:
            self._add(as_traces(np.asarray(x)[None]), bool(y == 1))
        return self

    def count(self, X: ArrayLike) -> tuple[Counts, Counts]:
        """Return (n_success, n_failure), each (n,): the labels behind each prediction.

        They are 0 if the method counts none.
        """
        prediction = self.predict(X)
        zeros = np.zeros(len(prediction.lower), dtype=np.int64)
        return zeros + prediction.n_success, zeros + prediction.n_failure

    def predict_interval(self, X: ArrayLike) -> tuple[Floats, Floats]:
        """Return (lower, upper), each (n,), of the success probability.

        They are equal if the method has no interval, and 0 and 1 before a training has succeeded.
        """
        prediction = self.predict(X)
        return prediction.lower, prediction.upper

    def decide(self, X: ArrayLike) -> NDArray[Any]:
        """Return an `Action` for each trace of X (n, C, T), as an array of objects, shape (n,).

        It is ACCEPT if the lower bound is at least the accept threshold, REJECT if the upper bound
        is at most the reject threshold, and otherwise VERIFY. `thresholds` has both; if it is None,
        they are LB and 1 - LB.
        """
        from ..decision.rule import action_of

        default = (self.policy.lower_bound, 1.0 - self.policy.lower_bound)
        accept_threshold, reject_threshold = self.thresholds or default
        lower, upper, *_ = self.predict(X)
        numbers = (
            action_of(float(low), float(high), accept_threshold, reject_threshold)
            for low, high in zip(lower, upper, strict=True)
        )
        return np.array([ACTIONS[number] for number in numbers], dtype=object)

    def predict(self, X: ArrayLike) -> BaselinePrediction:
        """Return bounds of the success probability, and counts of labels, for traces X (n, C, T).

        The last result is cached: it is returned again for the same traces until the next `fit` or
        `add`. Before a training has succeeded, all bounds are 0 and 1. A baseline that counts no
        labels returns the integer 0, and no array, for both counts; so does an untrained one.
        """
        traces = as_traces(X)
        key = traces.shape, traces.tobytes()
        if self._last is None or self._last[0] != key:
            prediction = (
                self._predict(traces)
                if self.is_trained
                else BaselinePrediction(np.zeros(len(traces)), np.ones(len(traces)))
            )
            self._last = (key, prediction)
        return self._last[1]

    @abstractmethod
    def _fit(self, X: Traces, good: Labels) -> bool:
        """Train on traces (n, C, T), labels (n,) of both classes; return False if too few."""

    @abstractmethod
    def _predict(self, X: Traces) -> BaselinePrediction:
        """Return the prediction for traces (n, C, T), after a training."""

    def _add(self, X: Traces, good: bool) -> None:  # noqa: B027  # default: nothing
        """Learn one trace (1, C, T) between two trainings."""


class Constant(Baseline):
    """The same prediction for every part, after the first retrain."""

    lower: ClassVar[float]

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Learn nothing, count as trained from now on, and return self.

        Labels of one class, or none, are enough.
        """
        self._last = None
        self.is_trained = True
        return self

    def _fit(self, X: Traces, good: Labels) -> bool:
        return True

    def _predict(self, X: Traces) -> BaselinePrediction:
        return BaselinePrediction(np.full(len(X), self.lower), np.ones(len(X)))


class AlwaysVerify(Constant):
    """Verify every part: the cell without dengine. No error, and nothing saved."""

    title = "always verify"
    lower = 0.0


class NeverVerify(Constant):
    """Accept every part: every check is saved, and every bad part stops the line."""

    title = "never verify"
    lower = 1.0


@dataclass
class LabelledPoints:
    """Points (n, d) with labels (n,), to which more can be added."""

    points: Floats
    good: Labels

    def add(self, point: Floats, good: bool) -> None:
        """Append one point (1, d) with its label."""
        self.points = np.concatenate([self.points, point])
        self.good = np.append(self.good, good)

    def squared_distances(self, Z: Floats) -> Floats:
        """Return the squared Euclidean distances (n, m) from Z (n, d) to the m points."""
        from scipy.spatial.distance import cdist

        return np.asarray(cdist(Z, self.points, "sqeuclidean"))


@dataclass(eq=False, kw_only=True)
class AgreeingNeighbours(Baseline):
    """Accept if all k nearest labelled traces are successes, reject if all are failures.

    Distances are Euclidean between the raw traces, with all channels in one row. alpha and LB have
    no effect: k takes the place of a threshold. Every label counts from the next part on.
    `predict_interval` gives the share of successes twice.

    Parameters
    ----------
    k : int, default 5
        Chosen among 5, 10, 20 and 40, on other seeds than those reported, as are the defaults of
        the other methods, each among four.

    References
    ----------
    Duan et al. (2025), as the paper's section "Related Work" describes it.
    """

    title = "k-NN, all k agree"

    k: int = 5

    def __post_init__(self) -> None:
        expect(is_whole(self.k, 1, 2**31), "k to be an integer of at least 1", self.k)
        self.thresholds = (1.0, 0.0)

    def _fit(self, X: Traces, good: Labels) -> bool:
        self._references = LabelledPoints(_rows(X), good)
        return len(good) >= self.k

    def _add(self, X: Traces, good: bool) -> None:
        self._references.add(_rows(X), good)

    def _predict(self, X: Traces) -> BaselinePrediction:
        """Return the share of successes among the k nearest as both bounds, with their counts."""
        distances = self._references.squared_distances(_rows(X))
        nearest = np.argpartition(distances, self.k - 1, axis=1)[:, : self.k]
        n_success = self._references.good[nearest].sum(axis=1)
        share = n_success / self.k
        return BaselinePrediction(share, share, n_success, self.k - n_success)


def _rows(X: Traces) -> Floats:
    """Return traces (n, C, T) as rows (n, C * T) of float64."""
    return X.reshape(len(X), -1).astype(np.float64)


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
        from ..reducers.pca import PcaReducer

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
    library = "aeon"

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


# The library of a baseline is imported when it is made.
BASELINES: dict[str, type[Baseline]] = {
    "knn": AgreeingNeighbours,
    "wskde": WilsonKernelDensity,
    "gp": GaussianProcess,
    "minirocket": RocketSelective,
    "always": AlwaysVerify,
    "never": NeverVerify,
}


def make_baseline(name: str, policy: Policy, seed: int = 0, **params: Any) -> Baseline:
    """Make an untrained baseline for `DataEngine(model=...)`.

    Its library is imported and compiled here, so that no training is timed with that; for
    "minirocket" this takes a minute the first time.

    Parameters
    ----------
    name : str
        A name in `BASELINES`.
    policy : Policy
        Its alpha and lower_bound are the baseline's; the rest belongs to the engine.
    seed : int, default 0
        Of everything drawn.
    **params
        The baseline's own settings; those left out have the defaults of its class.

    Raises
    ------
    SettingError
        An unknown name or parameter, a value out of range, or a library that is not installed.
        `n_components` and `C` are checked only by the training.
    """
    require_baseline(name)
    kind = BASELINES[name]
    names = [item.name for item in fields(kind) if item.kw_only]
    if unknown := ", ".join(sorted(set(params) - set(names))):
        parameters = ", ".join(names) or "none"
        raise SettingError(f"The baseline {name} has no parameter {unknown}; it has {parameters}.")
    return kind(policy, seed, **params)


def require_baseline(name: str) -> None:
    """Raise SettingError if there is no baseline of this name, or its library is not installed."""
    expect(name in BASELINES, f"a baseline among {', '.join(BASELINES)}", name)
    library = BASELINES[name].library
    if library and find_spec(library) is None:
        raise SettingError(
            f"The baseline {name} needs {library}, which is missing; "
            'pip install "dengine[baselines]".'
        )
