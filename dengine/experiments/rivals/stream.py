"""An off-the-shelf stream learner: river's adaptive random forest, one trace after the other."""

from __future__ import annotations

from hashlib import blake2b
from typing import Any

import numpy as np

from ...errors import SettingError
from .base import Floats, Labels, ThresholdRival, Traces, whole
from .features import segment_means


class StreamForest(ThresholdRival):
    """Adaptive random forest on segment means; accept from a threshold on its vote, reject from the same on the other side.

    threshold : of the votes' share, in (0.5, 1]. It stands for no bound: alpha and LB have no effect.
    segments : stretches of each channel whose means are the features.
    n_models : trees, as in river.

    It learns each label once, as it comes, and a training adds only what it has not learned yet: a stream learner looks at
    nothing twice, and forgets by its own drift detectors, not by the engine's window. A label that was corrected is learned
    in addition. `predict_interval` gives the votes' share twice; it is no bound.
    Source: Gomes et al. (2017), "Adaptive random forests for evolving data stream classification", Machine Learning 106.
    """

    def __init__(
        self,
        alpha: float,
        lower_bound: float,
        seed: int = 0,
        *,
        threshold: float = 0.95,
        segments: int = 20,
        n_models: int = 10,
    ) -> None:
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
