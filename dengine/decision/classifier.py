"""The radius-neighbour classifier with a confidence bound, as a scikit-learn estimator over embeddings."""

from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, validate_data

from ..records import ACTIONS
from .neighbours import RadiusNeighbours
from .policy import Policy, check_radius
from .references import Counts, RadiusIndex
from .rule import DecisionRule


class WilsonRadiusClassifier(ClassifierMixin, BaseEstimator):  # type: ignore[misc]  # scikit-learn ships no types
    """Counts labels around a query and bounds its success probability.

    radius : of the ball around a query, in the units of the embedding, surface included.
    alpha, lower_bound, interval : as in `Policy`.
    capacity : references held at most; the oldest leave first, blind to labels.

    The larger of two classes is the success (1 of 0 and 1). `predict` never abstains, an empty ball has probability 0.5;
    only `decide` does. Source: the paper's sections "Radius Neighbors Classifier" and "Confidence Prediction"; with a
    uniform kernel it is the Wilson score kernel density classifier of Iversen et al. (2025).
    """

    def __init__(
        self,
        radius: float = 0.3,
        alpha: float = 0.05,
        lower_bound: float = 0.95,
        interval: str = "wilson",
        capacity: int = 10_000,
    ) -> None:
        self.radius = radius
        self.alpha = alpha
        self.lower_bound = lower_bound
        self.interval = interval
        self.capacity = capacity

    def fit(self, Z: ArrayLike, y: ArrayLike) -> Self:
        """Forget everything, then hold embeddings Z (n, d) with labels y (n,) of at most two classes."""
        Z, y = validate_data(self, Z, y)
        self.classes_ = classes_of(y)
        self._start(np.asarray(Z).shape[1])
        return self._add(Z, y)

    def partial_fit(self, Z: ArrayLike, y: ArrayLike, classes: ArrayLike | None = None) -> Self:
        """Add embeddings Z (n, d) with labels y (n,) to what is held. `classes` names both, on the first call."""
        first = "index_" not in vars(self)
        Z, y = validate_data(self, Z, y, reset=first)
        if first:
            self.classes_ = classes_of(y if classes is None else classes)
            self._start(np.asarray(Z).shape[1])
        unknown = np.setdiff1d(np.asarray(y), self.classes_)
        if len(unknown):
            raise ValueError(f"Expected labels among {self.classes_}, got {unknown}; name all classes on the first call.")
        return self._add(Z, y)

    def count(self, Z: ArrayLike) -> Counts:
        """(n_success, n_failure), each (n,) int64: labels in the ball that decides for each row of Z (n, d)."""
        n_success, n_failure = self._ask(Z)[:, 3:].astype(np.int64).T
        return n_success, n_failure

    def predict_interval(self, Z: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(lower, upper), each (n,): the bound on the success probability around each row of Z (n, d)."""
        lower, upper = self._ask(Z)[:, 1:3].T
        return lower, upper

    def decide(self, Z: ArrayLike) -> NDArray[Any]:
        """(n,) array of `Action`; an empty ball always verifies."""
        return np.array([ACTIONS[int(a)] for a in self._ask(Z)[:, 0]], dtype=object)

    def predict_proba(self, Z: ArrayLike) -> NDArray[np.float64]:
        """(n, 2) observed rates of failure and success in the ball; 0.5 where it is empty. (n, 1) ones for one class."""
        n_success, n_failure = self.count(Z)
        if len(self.classes_) == 1:
            return np.ones((len(n_success), 1))
        rate = np.where(n_success + n_failure > 0, n_success / np.maximum(n_success + n_failure, 1), 0.5)
        return np.stack([1.0 - rate, rate], axis=1)

    def predict(self, Z: ArrayLike) -> NDArray[Any]:
        """(n,) the more frequent class in the ball; never abstains."""
        rates = self.predict_proba(Z)
        return np.asarray(self.classes_[rates.argmax(axis=1)])

    def policy(self) -> Policy:
        """The user's numbers among the settings; SettingError where one of all is out of range."""
        check_radius(self.radius)
        return Policy(self.alpha, self.lower_bound, self.interval)

    def neighbours_over(
        self, index: RadiusIndex, rule: DecisionRule | None = None, scored: bool = False
    ) -> RadiusNeighbours:
        """What decides over the points of `index`, by these settings; `rule` in place of the policy's own.

        scored : whether the first axis is a probability of success, which a rule that only sorts takes for its score.
        """
        rule = rule or self.policy().rule()
        return RadiusNeighbours(index, rule, self.radius, scored and rule.sorts)

    def _start(self, dim: int) -> None:
        self.index_ = RadiusIndex(dim, self.capacity)
        self.neighbours_ = self.neighbours_over(self.index_)

    def _add(self, Z: Any, y: Any) -> Self:
        success = np.asarray(y) == self.classes_[-1]
        if len(self.classes_) == 1 and self.classes_[0] in (0, False, -1):
            success = ~success  # a lone class of zeros is all failures
        self.index_.add(Z, success)
        return self

    def _ask(self, Z: ArrayLike) -> NDArray[np.float64]:
        check_is_fitted(self)
        Z = torch.from_numpy(np.array(validate_data(self, Z, reset=False), dtype=np.float32))
        with torch.inference_mode():
            return np.array([self.neighbours_(z[None, :]) for z in Z], dtype=np.float64).reshape(-1, 5)

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.classifier_tags.multi_class = False
        return tags


def classes_of(y: ArrayLike) -> NDArray[Any]:
    """The classes among labels, two at most; ValueError in scikit-learn's words for more, and for continuous labels."""
    check_classification_targets(y)
    classes = np.unique(np.asarray(y))
    if len(classes) > 2:
        said = "Only binary classification is supported. The type of the target is multiclass"
        raise ValueError(f"{said}: expected two classes, 1 = success and 0 = failure, got {len(classes)}.")
    return classes
