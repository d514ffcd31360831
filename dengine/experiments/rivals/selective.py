"""MAPIE's risk control over a logistic regression: learn, then test each threshold.

Selective classification with a guaranteed risk (SGR): the threshold that a held-out set allows.

Source: Geifman and El-Yaniv (2017), "Selective classification for deep neural networks", NIPS 30, Algorithm 1.

MiniRocket features of aeon, logistic regression, and thresholds with a guaranteed selective risk.
"""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import SettingError
from .base import Floats, Labels, ThresholdRival, Traces, positive, whole
from .features import segment_means


def risk_bound(n_wrong: int, n: int, delta: float) -> float:
    """The largest risk under which n_wrong or fewer errors in n have a probability of at least delta.

    The paper's B*, the inversion of the binomial tail: of all risks above it, seeing so few errors is less likely than
    delta. 1 where nothing was seen.
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


def held_out(n: int, share: float, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Positions of n traces to train on, and to hold out: a share of them, at random and blind to labels."""
    order = np.random.default_rng(seed).permutation(n)
    size = round(share * n)
    return np.sort(order[size:]), np.sort(order[:size])


SHORTEST = 9  # samples: the length of MiniRocket's kernels


class RocketSelective(ThresholdRival):
    """MiniRocket (aeon), logistic regression (scikit-learn), and SGR's threshold on each side.

    n_kernels : of MiniRocket, 84 at least; aeon's default.
    C : inverse strength of the regression's penalty, as in scikit-learn; features are standardised.
    holdout : share of the labels that choose the thresholds, and train nothing; drawn anew at each training.

    Traces that are held out and called successes give the threshold to accept from, with risk 1 - LB and delta = alpha;
    those called failures give the one to reject from. So for each training and each side: with probability 1 - alpha over
    the held-out labels, at most 1 - LB of what is decided on that side is wrong; with 1 - 2 alpha on both sides. That
    is so for one training, and for parts like those that were held out. In the loop there are many trainings, and held-out
    parts are those that were verified or stopped: where good parts beyond the threshold are not confirmed, only the bad
    ones among them return as labels. For accepting that errs on the safe side; of rejected parts nothing returns at all.

    Nothing is learned between two trainings. `predict_interval` gives the regression's probability twice; it is no bound.
    Sources: Dempster, Schmidt and Webb (2021), "MiniRocket", KDD; Geifman and El-Yaniv (2017), NIPS 30, Algorithm 1.
    """

    def __init__(
        self,
        alpha: float,
        lower_bound: float,
        seed: int = 0,
        *,
        n_kernels: int = 10_000,
        C: float = 0.001,
        holdout: float = 0.5,
    ) -> None:
        super().__init__(alpha, lower_bound, seed)
        self._classifier = _pipeline(whole("n_kernels", n_kernels, 84), positive("C", C), seed)
        self.holdout = positive("holdout", holdout, below=1.0)

    def _learn(self, X: Traces, good: Labels) -> bool:
        train, rest = held_out(len(X), self.holdout, self.seed)
        if X.shape[-1] < SHORTEST or len(np.unique(good[train])) < 2:
            return False
        self._classifier.fit(X[train], good[train])
        p = self._probability(X[rest]) if len(rest) else np.empty(0)
        self._set_thresholds(p, good[rest])
        return True

    def _set_thresholds(self, p: Floats, good: Labels) -> None:
        risk, delta = 1.0 - self.policy.lower_bound, self.policy.alpha
        called = p > 0.5
        self.accept_at = guaranteed_threshold(p[called], ~good[called], risk, delta)
        self.reject_at = 1.0 - guaranteed_threshold(1.0 - p[~called], good[~called], risk, delta)

    def _probability(self, X: Traces) -> Floats:
        return np.asarray(self._classifier.predict_proba(X)[:, 1], dtype=np.float64)


def _pipeline(n_kernels: int, C: float, seed: int) -> Any:
    """The classifier, untrained, its features compiled."""
    from aeon.transformations.collection.convolution_based import MiniRocket
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    features = MiniRocket(n_kernels=n_kernels, random_state=seed)
    features.fit_transform(np.eye(2 * SHORTEST, dtype=np.float32)[:, None, :])
    return make_pipeline(features, StandardScaler(), LogisticRegression(C=C, max_iter=1000))


SEGMENTS = 50
PROCEDURES = ("bonferroni_holm", "fixed_sequence")


class ControlledRisk(ThresholdRival):
    """Logistic regression on segment means, and the thresholds whose precision MAPIE certifies.

    thresholds : how many probabilities are tested on each side, from 0.95 down to 0.5.
    fwer : how MAPIE pays for testing many: "bonferroni_holm", its default, shares alpha among them; "fixed_sequence" tests
        them in turn at the whole alpha, from the highest on, until one fails.
    holdout : share of the labels that the tests are made on, and that train nothing; drawn anew at each training.

    Of the thresholds at which `BinaryClassificationController` certifies a precision of LB with confidence 1 - alpha, the
    one with the highest recall accepts; the same with failures as the positive class rejects (its precision is the NPV).
    As with SGR (`rocket.RocketSelective`) that holds for one training, for each side by itself, and for parts like those
    that were held out, which in the loop are the verified and the stopped ones.

    Nothing is learned between two trainings. `predict_interval` gives the regression's probability twice; it is no bound.
    Source: Angelopoulos, Bates, Candès, Jordan and Lei (2021), "Learn then test", arXiv:2110.01052, in MAPIE
    (Hoeffding-Bentkus p-values).
    """

    def __init__(
        self,
        alpha: float,
        lower_bound: float,
        seed: int = 0,
        *,
        thresholds: int = 10,
        fwer: str = "bonferroni_holm",
        holdout: float = 0.5,
    ) -> None:
        from mapie.risk_control import BinaryClassificationController
        from sklearn.linear_model import LogisticRegression
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler

        super().__init__(alpha, lower_bound, seed)
        self._controller: Any = BinaryClassificationController
        self._classifier: Any = make_pipeline(StandardScaler(), LogisticRegression(max_iter=1000))
        self.thresholds = whole("thresholds", thresholds)
        if fwer not in PROCEDURES:
            raise SettingError(f"Expected fwer {' or '.join(PROCEDURES)}, got {fwer!r}.")
        self.fwer = fwer
        self.holdout = positive("holdout", holdout, below=1.0)

    def _learn(self, X: Traces, good: Labels) -> bool:
        train, rest = held_out(len(X), self.holdout, self.seed)
        if len(np.unique(good[train])) < 2 or len(rest) == 0:
            return False
        self._classifier.fit(segment_means(X[train], SEGMENTS), good[train])
        p = self._probability(X[rest])
        self.accept_at = self._certified(p, good[rest])
        self.reject_at = 1.0 - self._certified(1.0 - p, ~good[rest])
        return True

    def _certified(self, p: Floats, positive_class: Labels) -> float:
        """The certified threshold of the highest recall; infinity where there is none. p, positive_class : (m,)."""
        controller = self._controller(
            predict_function=_both_classes,
            risk="precision",
            target_level=float(self.policy.lower_bound),
            confidence_level=1.0 - self.policy.alpha,
            list_predict_params=np.linspace(0.95, 0.5, self.thresholds),
            fwer_method=self.fwer,
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that there is no threshold, which the result says
            controller.calibrate(p, positive_class.astype(int))
        best: Any = controller.best_predict_param
        return np.inf if best is None else float(best)

    def _probability(self, X: Traces) -> Floats:
        return np.asarray(self._classifier.predict_proba(segment_means(X, SEGMENTS))[:, 1], dtype=np.float64)


def _both_classes(p: Floats) -> Floats:
    """(m,) -> (m, 2): probabilities that were computed before, in the form of a classifier's."""
    return np.stack([1.0 - p, p], axis=1)
