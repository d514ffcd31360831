"""Baseline methods for the same loop, by name; each decides by its own rule, on the same traces and the same feedback.

>>> DataEngine(recipe="conv", model=make_baseline("knn", Policy(alpha=0.1, lower_bound=0.9), seed=0))

Without a bound: always, never, k neighbours that agree. With one of their own: kernel densities, a Gaussian process, and
thresholds with a guaranteed risk. A baseline's settings are the keyword-only fields of its class.
"""

import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from importlib.util import find_spec
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..decision.intervals import normal_quantile, wilson_interval
from ..decision.policy import Policy
from ..errors import SettingError, expect
from ..records import ACTIONS, is_number, is_whole
from ..traces import as_traces

Floats = NDArray[np.float64]
Counts = NDArray[np.int64]
Labels = NDArray[np.bool_]
Traces = NDArray[np.float32]

BANDWIDTHS = (0.03, 0.05, 0.08, 0.12, 0.2, 0.3, 0.5, 0.8)  # to choose among, in deviations of a component
MOST_CHOOSING = 1000  # traces that the bandwidth is chosen on: the work grows with their square
DIMENSIONS = 2
MOST_TRAINED = 500  # traces to train a Gaussian process on: the work grows with their cube


class Judgement(NamedTuple):
    """What a baseline says of n traces; (n,) each, as in `Decision`; 0 where a method counts nothing."""

    lower: Floats
    upper: Floats
    n_success: Counts | int = 0
    n_failure: Counts | int = 0


@dataclass(eq=False)
class Baseline(ABC):
    """A method of somebody else's behind the five methods of `Model`.

    policy : its alpha and lower_bound are numbers of the baseline here, and it says what it makes of them.
    seed : of all that it draws; the same seed and the same labels give the same decisions.

    A subclass gives `_learn` and `_judge`, and `_take` where it learns between two trainings. Where a training cannot be
    done, on labels of one class or on too few, every part is verified until the next one.

    limits : from which lower bound on it accepts, and up to which upper one it rejects; None: LB and 1 - LB.

    title : for a table.  needs : the library beyond what dengine needs.
    bound : what bound its decisions keep; "" where it has none, and its threshold is swept.
    tries : four sets of parameters, as many as ours, to choose among on other seeds than those reported.  chosen : which.
    """

    title: ClassVar[str]
    bound: ClassVar[str] = ""
    needs: ClassVar[str] = ""
    tries: ClassVar[tuple[Mapping[str, Any], ...]] = ({},) * 4
    chosen: ClassVar[int] = 0

    policy: Policy
    seed: int = 0
    limits: tuple[float, float] | None = field(default=None, init=False)
    ready: bool = field(default=False, init=False)
    _last: tuple[bytes, Judgement] | None = field(default=None, init=False)  # the engine asks thrice about one trace

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Train anew on labelled traces X (n, C, T), y (n,) of 1 = success and 0 = failure."""
        traces, good = as_traces(X), np.asarray(y) == 1
        self._last = None
        self.ready = bool(good.any() and not good.all()) and self._learn(traces, good)
        return self

    def add(self, x: ArrayLike, y: Any) -> Self:
        """Take in one labelled trace (C, T), where the method learns between two trainings and has been trained."""
        self._last = None
        if self.ready:
            self._take(as_traces(np.asarray(x)[None]), bool(y == 1))
        return self

    def count(self, X: ArrayLike) -> tuple[Counts, Counts]:
        """(n_success, n_failure), each (n,), behind each prediction; zeros of a method that counts nothing."""
        found = self.judge(X)
        none = np.zeros(len(found.lower), dtype=np.int64)
        return none + found.n_success, none + found.n_failure

    def predict_interval(self, X: ArrayLike) -> tuple[Floats, Floats]:
        """(lower, upper), each (n,), of the success probability; the same number twice where there is only a point."""
        found = self.judge(X)
        return found.lower, found.upper

    def decide(self, X: ArrayLike) -> NDArray[Any]:
        """(n,) an `Action` for each trace of X (n, C, T)."""
        from ..decision.rule import action_of

        lower, upper, *_ = self.judge(X)
        accept_threshold, reject_threshold = self.limits or (self.policy.lower_bound, 1.0 - self.policy.lower_bound)
        found = (
            action_of(float(a), float(b), accept_threshold, reject_threshold) for a, b in zip(lower, upper, strict=True)
        )
        return np.array([ACTIONS[i] for i in found], dtype=object)

    def judge(self, X: ArrayLike) -> Judgement:
        """All that it says of the traces X (n, C, T), computed once for the same traces."""
        traces = as_traces(X)
        key = traces.tobytes()
        if self._last is None or self._last[0] != key:
            unknown = Judgement(np.zeros(len(traces)), np.ones(len(traces)))
            self._last = key, self._judge(traces) if self.ready else unknown
        return self._last[1]

    @abstractmethod
    def _learn(self, X: Traces, good: Labels) -> bool:
        """Train on traces (n, C, T) and labels (n,) of both classes; False where they are too few."""

    @abstractmethod
    def _judge(self, X: Traces) -> Judgement:
        """What is said of traces (n, C, T), after a training."""

    def _take(self, X: Traces, good: bool) -> None:  # noqa: B027  # a default: the next training learns it
        """Learn one trace (1, C, T)."""


class Constant(Baseline):
    """The same for every part; before the first retrain every part is verified all the same."""

    lower: ClassVar[float]

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Nothing to learn: labels of one class are as good as any."""
        self._last, self.ready = None, True
        return self

    def _learn(self, X: Traces, good: Labels) -> bool:
        return True

    def _judge(self, X: Traces) -> Judgement:
        return Judgement(np.full(len(X), self.lower), np.ones(len(X)))


class AlwaysVerify(Constant):
    """The cell as it is: no error, and nothing saved."""

    title = "always verify"
    bound = "no error: every part is verified"
    lower = 0.0


class NeverVerify(Constant):
    """All is saved, and every bad part stops the system."""

    title = "never verify"
    lower = 1.0


@dataclass
class References:
    """Labelled points (n, d), to which more can be added."""

    points: Floats
    good: Labels

    def add(self, point: Floats, good: bool) -> None:
        """One more point (1, d)."""
        self.points, self.good = np.concatenate([self.points, point]), np.append(self.good, good)

    def squared_distances(self, Z: Floats) -> Floats:
        """(n, d) -> (n, references)."""
        from scipy.spatial.distance import cdist

        return np.asarray(cdist(Z, self.points, "sqeuclidean"))


@dataclass(eq=False, kw_only=True)
class AgreeingNeighbours(Baseline):
    """Accept where all k nearest labelled traces are successes, reject where all are failures, verify otherwise.

    Distances are Euclidean between the traces as they are, all channels in a row. alpha and LB have no effect: k takes the
    place of a threshold. Every label counts from the next part on. `predict_interval` gives the share of successes twice.
    Source: Duan et al. (2025), as the paper's section "Related Work" describes it.
    """

    title = "k-NN, all k agree"
    tries = ({"k": 5}, {"k": 10}, {"k": 20}, {"k": 40})

    k: int = 10

    def __post_init__(self) -> None:
        expect(is_whole(self.k, 1, 2**31), "k to be an integer of at least 1", self.k)
        self.limits = (1.0, 0.0)

    def _learn(self, X: Traces, good: Labels) -> bool:
        self._references = References(_rows(X), good)
        return len(good) >= self.k

    def _take(self, X: Traces, good: bool) -> None:
        self._references.add(_rows(X), good)

    def _judge(self, X: Traces) -> Judgement:
        distances = self._references.squared_distances(_rows(X))
        nearest = np.argpartition(distances, self.k - 1, axis=1)[:, : self.k]
        n_success = self._references.good[nearest].sum(axis=1)
        share = n_success / self.k
        return Judgement(share, share, n_success, self.k - n_success)


def _rows(X: Traces) -> Floats:
    return X.reshape(len(X), -1).astype(np.float64)


class Components:
    """The first principal components of traces, scaled.

    whiten : each to unit variance; otherwise all by the first one's deviation, so that they keep their proportions.
    """

    def __init__(self, n_components: int, *, whiten: bool, seed: int) -> None:
        from ..reducers.pca import PcaReducer

        self.whiten, self._pca = whiten, PcaReducer(n_components=n_components, random_state=seed)

    def fit(self, X: Traces) -> Floats | None:
        """Find the components of traces (n, C, T); returns these traces as (n, d), None where they are too few."""
        try:
            placed = np.asarray(self._pca.fit(X).transform(X), dtype=np.float64)
        except SettingError:
            return None
        deviation = placed.std(axis=0)
        scale = deviation if self.whiten else np.full_like(deviation, deviation[0])
        self._scale = np.where(scale > 0.0, scale, 1.0)
        return np.asarray(placed / self._scale)

    def transform(self, X: Traces) -> Floats:
        """(n, C, T) -> (n, d)."""
        return np.asarray(self._pca.transform(X) / self._scale, dtype=np.float64)


@dataclass(eq=False, kw_only=True)
class WilsonKernelDensity(Baseline):
    """Kernel-weighted counts of successes and failures, Wilson's interval, and the paper's rule.

    bandwidth : h, in deviations of each principal component; None: chosen at each training, among `BANDWIDTHS`, by the
        leave-one-out likelihood of the labels.

    With weights w_i = exp(-|z - z_i|^2 / (2 h^2)) the success rate is m = sum w_i y_i / sum w_i, and the number of trials
    n = sum K_H(z - z_i) |H| / R(K), K the normal density, R(K) = (4 pi)^(-d/2): here 2 sum w_i. It is no count: a kernel
    wider than the data counts every label twice. So the bound holds only where it is narrow and many labels lie within.

    Source: Iversen, Duan and Hagelskjær (2026), "Estimation of Confidence Bounds in Binary Classification using Wilson
    Score Kernel Density Estimation", arXiv:2602.20947; n and H as in github.com/SDU-Robotics/wilson-score-kde. Our reading:
    two principal components, and the likelihood of Wilson's centre, which no lone wrong neighbour sends to 0.
    """

    title = "Wilson-score kernel density"
    bound = "Wilson interval of kernel-weighted counts, at one look"
    tries = ({"bandwidth": None}, {"bandwidth": 0.1}, {"bandwidth": 0.2}, {"bandwidth": 0.4})

    bandwidth: float | None = None

    def __post_init__(self) -> None:
        known = self.bandwidth is None or (is_number(self.bandwidth) and 0.0 < self.bandwidth < math.inf)
        expect(known, "bandwidth to be a number above 0", self.bandwidth)
        self._components = Components(DIMENSIONS, whiten=True, seed=self.seed)

    def _learn(self, X: Traces, good: Labels) -> bool:
        if (Z := self._components.fit(X)) is None:
            return False
        self._references = References(Z, good)
        some = References(Z[-MOST_CHOOSING:], good[-MOST_CHOOSING:])
        self.bandwidth_ = self.bandwidth or chosen_bandwidth(some, self.policy.alpha)
        return True

    def _take(self, X: Traces, good: bool) -> None:
        self._references.add(self._components.transform(X), good)

    def _judge(self, X: Traces) -> Judgement:
        distances = self._references.squared_distances(self._components.transform(X))
        n_success, n_failure = kernel_counts(distances, self._references.good, self.bandwidth_)
        lower, upper = wilson_interval(n_success, n_failure, self.policy.alpha)
        whole_numbers = (np.rint(n).astype(np.int64) for n in (n_success, n_failure))
        return Judgement(lower, upper, *whole_numbers)


def kernel_counts(distances: Floats, good: Labels, bandwidth: float) -> tuple[Floats, Floats]:
    """(n_success, n_failure), each (n,), no whole numbers: from squared distances (n, m) in two dimensions, labels (m,)."""
    weights = np.exp(-0.5 * distances / bandwidth**2) * 2.0 ** (DIMENSIONS / 2)
    return weights @ good, weights @ ~good


def chosen_bandwidth(known: References, alpha: float) -> float:
    """The bandwidth among `BANDWIDTHS` under which the references' labels are most likely, each left out in turn."""
    distances, z = known.squared_distances(known.points), normal_quantile(alpha)
    np.fill_diagonal(distances, np.inf)

    def log_likelihood(bandwidth: float) -> float:
        n_success, n_failure = kernel_counts(distances, known.good, bandwidth)
        rate = (n_success + z * z / 2.0) / (n_success + n_failure + z * z)
        return float(np.log(np.where(known.good, rate, 1.0 - rate)).sum())

    return max(BANDWIDTHS, key=log_likelihood)


@dataclass(eq=False, kw_only=True)
class GaussianProcess(Baseline):
    """scikit-learn's Gaussian-process classifier on principal components; the paper's rule on its credible interval.

    n_components : principal components, which keep their proportions.
    amplitude : the largest deviation that the prior of the latent function may have, above 1, in logits; 3 is a success
        rate of 5 to 95 %. The marginal likelihood drives it up where classes part well; then the interval stays wide even
        amid hundreds of successes.

    The latent function f at a trace has mean m and variance v under Laplace's approximation; the interval of the success
    probability is sigmoid(m -+ z sqrt(v)), z the 1 - alpha/2 normal quantile. It is a credible interval: it holds under the
    prior, a scaled squared exponential of one length scale. Trained on the newest 500 labels only, because of its cost.
    It needs scikit-learn 1.7, which tells the latent mean and variance.
    Source: Rasmussen and Williams (2006), "Gaussian Processes for Machine Learning", Algorithms 3.1 and 3.2.
    """

    title = "Gaussian process"
    bound = "credible interval under the prior, at one look"
    tries = (
        {"n_components": 2, "amplitude": 2.0},
        {"n_components": 2, "amplitude": 3.0},
        {"n_components": 5, "amplitude": 3.0},
        {"n_components": 2, "amplitude": 10.0},
    )
    chosen = 2

    n_components: int = 2
    amplitude: float = 3.0

    def __post_init__(self) -> None:
        expect(is_number(self.amplitude) and 1.0 < self.amplitude < math.inf, "amplitude above 1", self.amplitude)
        self._components = Components(self.n_components, whiten=False, seed=self.seed)

    def _learn(self, X: Traces, good: Labels) -> bool:
        from sklearn.gaussian_process import GaussianProcessClassifier
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel

        newest, labels = X[-MOST_TRAINED:], good[-MOST_TRAINED:]
        if len(np.unique(labels)) < 2 or (Z := self._components.fit(newest)) is None:
            return False
        kernel = ConstantKernel(1.0, (0.1, self.amplitude**2)) * RBF(0.5, (0.01, 10.0))
        classifier = GaussianProcessClassifier(kernel, random_state=self.seed)
        with warnings.catch_warnings():  # it warns of an optimum at a limit, and the limit is meant
            warnings.filterwarnings("ignore", message="The optimal value found")
            self._classifier = classifier.fit(Z, labels)
        return True

    def _judge(self, X: Traces) -> Judgement:
        from scipy.special import expit

        mean, variance = self._classifier.latent_mean_and_variance(self._components.transform(X))
        half = normal_quantile(self.policy.alpha) * np.sqrt(np.maximum(variance, 0.0))
        return Judgement(np.asarray(expit(mean - half)), np.asarray(expit(mean + half)))


def risk_bound(n_wrong: int, n: int, delta: float) -> float:
    """The largest risk under which n_wrong or fewer errors in n have a probability of at least delta.

    The paper's B*, the inversion of the binomial tail. 1 where nothing was seen.
    Source: Geifman and El-Yaniv (2017), "Selective classification for deep neural networks", NIPS 30, Algorithm 1.
    """
    from scipy.special import betaincinv

    return 1.0 if n_wrong >= n else float(betaincinv(n_wrong + 1.0, n - n_wrong, 1.0 - delta))


def guaranteed_threshold(confidence: Floats, wrong: Labels, risk: float, delta: float) -> float:
    """The confidence from which on a classifier errs with at most `risk`; infinity where no threshold can be vouched for.

    confidence, wrong : (m,) of traces that the classifier was not trained on, and whether it errs on each.
    With probability 1 - delta over these traces the risk beyond the threshold is at most `risk`, if they are independent
    draws from what will be decided: ceil(log2 m) thresholds are looked at, each with its share of delta.
    """
    ordered = np.sort(confidence)
    m, found = len(ordered), math.inf
    looks = max(1, math.ceil(math.log2(max(m, 1))))
    low, high = 1, m  # ranks, as in the paper
    for _ in range(looks if m else 0):
        rank = math.ceil((low + high) / 2)
        beyond = confidence >= ordered[rank - 1]
        if risk_bound(int(wrong[beyond].sum()), int(beyond.sum()), delta / looks) < risk:
            high, found = rank, float(ordered[rank - 1])
        else:
            low = rank
    return found


@dataclass(eq=False, kw_only=True)
class RocketSelective(Baseline):
    """MiniRocket (aeon), logistic regression, and SGR's threshold on each side, with delta = alpha.

    n_kernels : of MiniRocket, 84 at least; aeon's default.
    holdout : share of the labels that choose the thresholds and train nothing; drawn anew at each training.
    C : inverse strength of the logistic regression's penalty, as in scikit-learn; features are standardised.

    For each training and each side by itself: with probability 1 - alpha over the held-out labels at most 1 - LB of what is
    decided on that side is wrong, for parts like those that were held out. In the loop these were verified or stopped:
    of good parts beyond the threshold that are not confirmed only the bad ones return, which errs on the safe side for
    accepting; of rejected parts nothing returns. Nothing is learned between two trainings, and `predict_interval` gives the
    classifier's probability twice.
    Sources: Dempster, Schmidt and Webb (2021), "MiniRocket", KDD; Geifman and El-Yaniv (2017), NIPS 30, Algorithm 1.
    """

    title = "MiniRocket, logistic, SGR"
    bound = "SGR risk bound, each side and each training by itself"
    tries = tuple({"C": C, "holdout": holdout} for holdout in (0.5, 0.3) for C in (0.001, 0.01))
    chosen = 1
    needs = "aeon"

    n_kernels: int = 10_000
    holdout: float = 0.5
    C: float = 0.001

    def __post_init__(self) -> None:
        from aeon.transformations.collection.convolution_based import MiniRocket
        from sklearn.linear_model import LogisticRegression
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler

        known = is_number(self.holdout) and 0.0 < self.holdout < 1.0
        expect(known, "holdout to be a number above 0 and below 1", self.holdout)
        expect(is_whole(self.n_kernels, 84, 2**31), "n_kernels to be an integer of at least 84", self.n_kernels)
        features = MiniRocket(n_kernels=self.n_kernels, random_state=self.seed)
        features.fit_transform(np.eye(20, dtype=np.float32)[:, None, :])  # compiled here
        self._classifier: Any = make_pipeline(features, StandardScaler(), LogisticRegression(C=self.C, max_iter=1000))

    def _learn(self, X: Traces, good: Labels) -> bool:
        order, size = np.random.default_rng(self.seed).permutation(len(X)), round(self.holdout * len(X))
        train, rest = np.sort(order[size:]), np.sort(order[:size])  # at random, and blind to labels
        if len(np.unique(good[train])) < 2 or not len(rest):
            return False
        self._classifier.fit(X[train], good[train])
        p = self._judge(X[rest]).lower
        self.limits = (self._threshold(p, good[rest]), 1.0 - self._threshold(1.0 - p, ~good[rest]))
        return True

    def _judge(self, X: Traces) -> Judgement:
        p = np.asarray(self._classifier.predict_proba(X)[:, 1], dtype=np.float64)
        return Judgement(p, p)

    def _threshold(self, p: Floats, right: Labels) -> float:
        """From which p (m,) on a side is decided, with `right` (m,); infinity where nothing can be vouched for."""
        called = p > 0.5
        return guaranteed_threshold(p[called], ~right[called], 1.0 - self.policy.lower_bound, self.policy.alpha)


BASELINES: dict[str, type[Baseline]] = {  # their libraries are imported where they are made
    "knn": AgreeingNeighbours,
    "wskde": WilsonKernelDensity,
    "gp": GaussianProcess,
    "minirocket": RocketSelective,
    "always": AlwaysVerify,
    "never": NeverVerify,
}


def make_baseline(name: str, policy: Policy, seed: int = 0, **params: Any) -> Baseline:
    """A baseline by its name in `BASELINES`, untrained, for `DataEngine(model=...)`.

    policy : its alpha and lower_bound are the baseline's; what it has beside them belongs to the engine.
    seed : of all that it draws.  params : its own settings; those left out have the class's defaults.
    Its library is imported and compiled here, so that no training is timed with that: aeon takes a minute at first.
    SettingError for an unknown name, an unknown parameter, a value out of range, or a library that is missing.
    """
    require(name)
    known = [each.name for each in fields(BASELINES[name]) if each.kw_only]
    if unknown := ", ".join(sorted(set(params) - set(known))):
        raise SettingError(f"The baseline {name} has no parameter {unknown}; it has {', '.join(known) or 'none'}.")
    return BASELINES[name](policy, seed, **params)


def require(name: str) -> None:
    """SettingError where there is no baseline of this name, or the library that it is made with is missing."""
    expect(name in BASELINES, f"a baseline among {', '.join(BASELINES)}", name)
    needs = BASELINES[name].needs
    if needs and find_spec(needs) is None:
        raise SettingError(f'The baseline {name} needs {needs}, which is missing; pip install "dengine[baselines]".')
