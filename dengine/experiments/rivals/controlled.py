"""MAPIE's risk control over a logistic regression: learn, then test each threshold."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from ...errors import SettingError
from .base import Floats, Labels, ThresholdRival, Traces, positive, whole
from .features import segment_means
from .selective import held_out

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
