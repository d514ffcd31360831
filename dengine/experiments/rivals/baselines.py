"""Rivals without a bound: verify always or never, k neighbours that agree, a stream learner."""

from __future__ import annotations

from hashlib import blake2b
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from ...errors import SettingError
from ...records import Action
from .base import (
    Floats,
    Judgement,
    Labels,
    References,
    Rival,
    ThresholdRival,
    Traces,
    actions_of,
    same_action,
    segment_means,
    squared_distances,
    whole,
)


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
