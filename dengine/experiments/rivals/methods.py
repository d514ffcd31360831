"""The published methods: without a bound, always, never, k neighbours that agree, a stream learner; with one of their own,
kernel densities, a Gaussian process, and thresholds with a guaranteed risk.
"""

from __future__ import annotations

import math
import warnings
from abc import abstractmethod
from hashlib import blake2b
from importlib.util import find_spec
from inspect import Parameter, signature
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...decision.intervals import normal_quantile, wilson_interval
from ...decision.policy import Policy
from ...errors import SettingError
from ...records import Action
from .base import (
    Components,
    Floats,
    Judgement,
    Labels,
    References,
    Rival,
    ThresholdRival,
    Traces,
    actions_of,
    positive,
    same_action,
    segment_means,
    squared_distances,
    whole,
)

BANDWIDTHS = (0.03, 0.05, 0.08, 0.12, 0.2, 0.3, 0.5, 0.8)  # to choose among, in deviations of a component
MOST_CHOOSING = 1000  # traces that the bandwidth is chosen on: the work grows with their square
DIMENSIONS = 2
MOST_TRAINED = 500  # traces to train a Gaussian process on: the work grows with their cube
SHORTEST = 9  # samples: the length of MiniRocket's kernels
SEGMENTS = 50
PROCEDURES = ("bonferroni_holm", "fixed_sequence")


class Constant(Rival):
    """The same action for every part; before the first retrain every part is verified all the same."""

    action: ClassVar[Action]

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Nothing to learn: labels of one class are as good as any."""
        self._last, self.ready = None, True
        return self

    def _learn(self, X: Traces, good: Labels) -> bool:
        return True

    def _judge(self, X: Traces) -> Judgement:
        return same_action(len(X), self.action)


class AlwaysVerify(Constant):
    """The cell as it is: no error, and nothing saved."""

    title = "always verify"
    bound = "no error: every part is verified"
    action = Action.VERIFY


class NeverVerify(Constant):
    """All is saved, and every bad part stops the system."""

    title = "never verify"
    bound = ""
    action = Action.ACCEPT


class AgreeingNeighbours(Rival):
    """Accept where all k nearest labelled traces are successes, reject where all are failures, verify otherwise.

    Distances are Euclidean between the traces as they are, all channels in a row. alpha and LB have no effect: k takes the
    place of a threshold. Every label counts from the next part on. `predict_interval` gives the share of successes twice.
    Source: Duan et al. (2025), as the paper's section "Related Work" describes it.
    """

    title = "k-NN, all k agree"
    tries = ({"k": 5}, {"k": 10}, {"k": 20}, {"k": 40})

    def __init__(self, alpha: float, lower_bound: float, seed: int = 0, *, k: int = 10) -> None:
        super().__init__(alpha, lower_bound, seed)
        self.k = whole("k", k)

    def _learn(self, X: Traces, good: Labels) -> bool:
        self._references = References(_rows(X), good)
        return len(good) >= self.k

    def _take(self, X: Traces, good: bool) -> None:
        self._references.add(_rows(X), good)

    def _judge(self, X: Traces) -> Judgement:
        distances = squared_distances(_rows(X), self._references.points)  # (n, references)
        nearest = np.argpartition(distances, self.k - 1, axis=1)[:, : self.k]
        n_success = self._references.good[nearest].sum(axis=1)
        share = n_success / self.k
        action = actions_of(n_success == self.k, n_success == 0)
        return Judgement(action, share, share, n_success, self.k - n_success)


def _rows(X: Traces) -> Floats:
    return X.reshape(len(X), -1).astype(np.float64)


class StreamForest(ThresholdRival):
    """Adaptive random forest on segment means; accept from a threshold on its vote, reject from the same on the other side.

    threshold : of the votes' share, in (0.5, 1]. It stands for no bound: alpha and LB have no effect.
    segments : stretches of each channel whose means are the features.  n_models : trees, as in river.

    It learns each label once, as it comes, and forgets by its own drift detectors, not by the engine's window. A label that
    was corrected is learned in addition. `predict_interval` gives the votes' share twice.
    Source: Gomes et al. (2017), "Adaptive random forests for evolving data stream classification", Machine Learning 106.
    """

    title = "adaptive random forest"
    tries = ({"threshold": 0.8}, {"threshold": 0.9}, {"threshold": 0.95}, {"threshold": 0.99})
    needs = "river"

    def __init__(
        self, alpha: float, lower_bound: float, seed: int = 0, *,
        threshold: float = 0.95, segments: int = 20, n_models: int = 10,
    ) -> None:  # fmt: skip
        from river.forest import ARFClassifier

        super().__init__(alpha, lower_bound, seed)
        if not (isinstance(threshold, int | float) and 0.5 < threshold <= 1.0):
            raise SettingError(f"Expected 0.5 < threshold <= 1, got {threshold!r}; 0.95 asks for 95 % of the votes.")
        self.accept_at, self.reject_at = threshold, 1.0 - threshold
        self.segments = whole("segments", segments)
        self._forest: Any = ARFClassifier(n_models=whole("n_models", n_models), seed=seed)
        self._learned: set[bytes] = set()

    def _learn(self, X: Traces, good: Labels) -> bool:
        for x, label in zip(X, good, strict=True):
            self._take(x[None], bool(label))
        return True

    def _take(self, X: Traces, good: bool) -> None:
        digest = blake2b(X.tobytes() + bytes([good]), digest_size=16).digest()
        if digest not in self._learned:
            self._learned.add(digest)
            self._forest.learn_one(self._named(X)[0], good)

    def _probability(self, X: Traces) -> Floats:
        return np.array([self._forest.predict_proba_one(x).get(True, 0.0) for x in self._named(X)], dtype=np.float64)

    def _named(self, X: Traces) -> list[dict[int, float]]:
        """Each trace's features by number, as river takes them."""
        return [dict(enumerate(row)) for row in segment_means(X, self.segments).tolist()]


class WilsonKernelDensity(Rival):
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

    def __init__(self, alpha: float, lower_bound: float, seed: int = 0, *, bandwidth: float | None = None) -> None:
        super().__init__(alpha, lower_bound, seed)
        self.bandwidth = None if bandwidth is None else float(positive("bandwidth", bandwidth))
        self._components = Components(DIMENSIONS, whiten=True, seed=seed)

    def _learn(self, X: Traces, good: Labels) -> bool:
        if (Z := self._components.fit(X)) is None:
            return False
        self._references = References(Z, good)
        self.bandwidth_ = self.bandwidth or chosen_bandwidth(Z[-MOST_CHOOSING:], good[-MOST_CHOOSING:], self.policy.alpha)
        return True

    def _take(self, X: Traces, good: bool) -> None:
        self._references.add(self._components.transform(X), good)

    def _judge(self, X: Traces) -> Judgement:
        Z, held = self._components.transform(X), self._references
        n_success, n_failure = kernel_counts(squared_distances(Z, held.points), held.good, self.bandwidth_)
        lower, upper = wilson_interval(n_success, n_failure, self.policy.alpha)
        whole_numbers = (np.rint(n).astype(np.int64) for n in (n_success, n_failure))
        return Judgement(self.policy.actions(lower, upper), lower, upper, *whole_numbers)


def kernel_counts(distances: Floats, good: Labels, bandwidth: float) -> tuple[Floats, Floats]:
    """(n_success, n_failure), each (n,), no whole numbers: from squared distances (n, m) in two dimensions, labels (m,)."""
    weights = np.exp(-0.5 * distances / bandwidth**2) * 2.0 ** (DIMENSIONS / 2)
    return weights @ good, weights @ ~good


def chosen_bandwidth(Z: Floats, good: Labels, alpha: float) -> float:
    """The bandwidth among `BANDWIDTHS` under which labels (n,) at Z (n, 2) are most likely, each left out in turn."""
    distances, z = squared_distances(Z, Z), normal_quantile(alpha)
    np.fill_diagonal(distances, np.inf)

    def log_likelihood(bandwidth: float) -> float:
        n_success, n_failure = kernel_counts(distances, good, bandwidth)
        rate = (n_success + z * z / 2.0) / (n_success + n_failure + z * z)
        return float(np.log(np.where(good, rate, 1.0 - rate)).sum())

    return max(BANDWIDTHS, key=log_likelihood)


class GaussianProcess(Rival):
    """scikit-learn's Gaussian-process classifier on principal components; the paper's rule on its credible interval.

    n_components : principal components, which keep their proportions.
    amplitude : the largest deviation that the prior of the latent function may have, above 1, in logits. The marginal
        likelihood drives it up where classes part well; then the interval stays wide even amid hundreds of successes.

    The latent function f at a trace has mean m and variance v under Laplace's approximation; the interval of the success
    probability is sigmoid(m -+ z sqrt(v)), z the 1 - alpha/2 normal quantile. It is a credible interval: it holds under the
    prior, a scaled squared exponential of one length scale. Trained on the newest 500 labels only, because of its cost.
    Source: Rasmussen and Williams (2006), "Gaussian Processes for Machine Learning", Algorithms 3.1 and 3.2.
    Raises SettingError for a scikit-learn before 1.7, which does not tell the latent mean and variance.
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
        lower, upper = np.asarray(expit(mean - half)), np.asarray(expit(mean + half))
        return Judgement.without_counts(self.policy.actions(lower, upper), lower, upper)


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


class HeldOutRival(ThresholdRival):
    """A classifier, and a threshold on each side that labels vouch for on which it was not trained.

    holdout : share of the labels that choose the thresholds and train nothing; drawn anew at each training.

    For each training and each side by itself: with probability 1 - alpha over the held-out labels at most 1 - LB of what is
    decided on that side is wrong, for parts like those that were held out. In the loop these were verified or stopped:
    of good parts beyond the threshold that are not confirmed only the bad ones return, which errs on the safe side for
    accepting; of rejected parts nothing returns. Nothing is learned between two trainings, and `predict_interval` gives the
    classifier's probability twice.
    """

    shortest: ClassVar[int] = 1  # samples

    def __init__(self, alpha: float, lower_bound: float, seed: int, holdout: float, classifier: Any) -> None:
        super().__init__(alpha, lower_bound, seed)
        self.holdout, self._classifier = positive("holdout", holdout, below=1.0), classifier

    def _learn(self, X: Traces, good: Labels) -> bool:
        order, size = np.random.default_rng(self.seed).permutation(len(X)), round(self.holdout * len(X))
        train, rest = np.sort(order[size:]), np.sort(order[:size])  # at random, and blind to labels
        if X.shape[-1] < self.shortest or len(np.unique(good[train])) < 2 or not len(rest):
            return False
        self._classifier.fit(self._features(X[train]), good[train])
        p = self._probability(X[rest])
        self.accept_at = self._threshold(p, good[rest])
        self.reject_at = 1.0 - self._threshold(1.0 - p, ~good[rest])
        return True

    def _probability(self, X: Traces) -> Floats:
        return np.asarray(self._classifier.predict_proba(self._features(X))[:, 1], dtype=np.float64)

    @abstractmethod
    def _features(self, X: Traces) -> NDArray[Any]:
        """Traces (n, C, T) as the classifier takes them."""

    @abstractmethod
    def _threshold(self, p: Floats, right: Labels) -> float:
        """From which p (m,) on a side is decided, with `right` (m,); infinity where nothing can be vouched for."""


class RocketSelective(HeldOutRival):
    """MiniRocket (aeon), logistic regression (scikit-learn), and SGR's threshold on each side, with delta = alpha.

    n_kernels : of MiniRocket, 84 at least; aeon's default.
    C : inverse strength of the regression's penalty, as in scikit-learn; features are standardised.
    Sources: Dempster, Schmidt and Webb (2021), "MiniRocket", KDD; Geifman and El-Yaniv (2017), NIPS 30, Algorithm 1.
    """

    title = "MiniRocket, logistic, SGR"
    bound = "SGR risk bound, each side and each training by itself"
    tries = tuple({"C": C, "holdout": holdout} for holdout in (0.5, 0.3) for C in (0.001, 0.01))
    chosen = 1
    needs = "aeon"
    shortest = SHORTEST

    def __init__(
        self, alpha: float, lower_bound: float, seed: int = 0, *,
        n_kernels: int = 10_000, C: float = 0.001, holdout: float = 0.5,
    ) -> None:  # fmt: skip
        from aeon.transformations.collection.convolution_based import MiniRocket
        from sklearn.linear_model import LogisticRegression
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler

        features = MiniRocket(n_kernels=whole("n_kernels", n_kernels, 84), random_state=seed)
        regression = LogisticRegression(C=positive("C", C), max_iter=1000)
        super().__init__(alpha, lower_bound, seed, holdout, make_pipeline(features, StandardScaler(), regression))
        features.fit_transform(np.eye(2 * SHORTEST, dtype=np.float32)[:, None, :])  # compiled here

    def _features(self, X: Traces) -> Traces:
        return X

    def _threshold(self, p: Floats, right: Labels) -> float:
        called = p > 0.5
        return guaranteed_threshold(p[called], ~right[called], 1.0 - self.policy.lower_bound, self.policy.alpha)


class ControlledRisk(HeldOutRival):
    """Logistic regression on segment means, and the thresholds whose precision MAPIE certifies.

    thresholds : how many probabilities are tested on each side, from 0.95 down to 0.5.
    fwer : how MAPIE pays for testing many: "bonferroni_holm", its default, shares alpha among them; "fixed_sequence" tests
        them in turn at the whole alpha, from the highest on, until one fails.

    Of the thresholds at which `BinaryClassificationController` certifies a precision of LB with confidence 1 - alpha, the
    one with the highest recall decides; to reject, failures are the positive class.
    Source: Angelopoulos, Bates, Candès, Jordan and Lei (2021), "Learn then test", arXiv:2110.01052, in MAPIE
    (Hoeffding-Bentkus p-values).
    """

    title = "logistic, MAPIE risk control"
    bound = "learn-then-test, each side and each training by itself"
    tries = tuple({"thresholds": n, "fwer": fwer} for fwer in PROCEDURES for n in (5, 20))
    chosen = 3
    needs = "mapie"

    def __init__(
        self, alpha: float, lower_bound: float, seed: int = 0, *,
        thresholds: int = 10, fwer: str = "bonferroni_holm", holdout: float = 0.5,
    ) -> None:  # fmt: skip
        from mapie.risk_control import BinaryClassificationController
        from sklearn.linear_model import LogisticRegression
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler

        classifier: Any = make_pipeline(StandardScaler(), LogisticRegression(max_iter=1000))
        super().__init__(alpha, lower_bound, seed, holdout, classifier)
        if fwer not in PROCEDURES:
            raise SettingError(f"Expected fwer {' or '.join(PROCEDURES)}, got {fwer!r}.")
        self.thresholds, self.fwer = whole("thresholds", thresholds), fwer
        self._controller: Any = BinaryClassificationController

    def _features(self, X: Traces) -> Floats:
        return segment_means(X, SEGMENTS)

    def _threshold(self, p: Floats, right: Labels) -> float:
        controller = self._controller(
            predict_function=lambda p: np.stack([1.0 - p, p], axis=1),  # computed before; in a classifier's form
            risk="precision",
            target_level=float(self.policy.lower_bound),
            confidence_level=1.0 - self.policy.alpha,
            list_predict_params=np.linspace(0.95, 0.5, self.thresholds),
            fwer_method=self.fwer,
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that there is no threshold, which the result says
            controller.calibrate(p, right.astype(int))
        best: Any = controller.best_predict_param
        return np.inf if best is None else float(best)


RIVALS: dict[str, type[Rival]] = {  # their libraries are imported where they are made
    "knn": AgreeingNeighbours,
    "wskde": WilsonKernelDensity,
    "gp": GaussianProcess,
    "minirocket": RocketSelective,
    "mapie": ControlledRisk,
    "river": StreamForest,
    "always": AlwaysVerify,
    "never": NeverVerify,
}


def make_rival(name: str, policy: Policy, seed: int = 0, **params: Any) -> Rival:
    """A rival by its name in `RIVALS`, untrained, for `DataEngine(model=...)`.

    policy : its alpha and lower_bound are the rival's; what it has beside them belongs to the engine.
    seed : of all that it draws.  params : its own settings; those left out have the class's defaults.
    Its library is imported and compiled here, so that no training is timed with that: aeon takes a minute at first.
    SettingError for an unknown name, an unknown parameter, a value out of range, or a library that is missing.
    """
    require(name)
    rival = RIVALS[name]
    allowed = [each.name for each in signature(rival).parameters.values() if each.kind is Parameter.KEYWORD_ONLY]
    unknown = sorted(set(params) - set(allowed))
    if unknown:
        raise SettingError(
            f"The rival {name} has no parameter {', '.join(unknown)}; it has {', '.join(allowed) or 'none'}."
        )
    return rival(policy.alpha, policy.lower_bound, seed, **params)


def require(name: str) -> None:
    """SettingError where there is no rival of this name, or the library that it is made with is missing."""
    if name not in RIVALS:
        raise SettingError(f"Expected a rival among {', '.join(RIVALS)}, got {name!r}.")
    needs = RIVALS[name].needs
    if needs and find_spec(needs) is None:
        raise SettingError(f'The rival {name} needs {needs}, which is missing; pip install "dengine[rivals]".')
