"""MiniRocket features of aeon, logistic regression, and thresholds with a guaranteed selective risk."""

from __future__ import annotations

from typing import Any

import numpy as np

from .base import Floats, Labels, ThresholdRival, Traces, positive, whole
from .selective import guaranteed_threshold, held_out

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
