"""The radius-neighbour classifier with a confidence bound: `WilsonRadiusClassifier`, a scikit-learn
estimator. `ModelPrediction` takes one for its settings (radius, error level, lower bound, interval,
capacity); on its own it classifies points of any embedding.
"""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, validate_data

from ..records import ACTIONS, Floats, Ints
from .neighbours import RadiusNeighbours
from .policy import Policy, check_radius
from .references import RadiusIndex
from .rule import DecisionRule


# scikit-learn ships no types
@dataclass(eq=False, repr=False)
class WilsonRadiusClassifier(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
    """Classifier that counts labels within a radius and bounds the success probability.

    The larger of two classes is the success (1 of 0 and 1). `predict` never abstains, and without
    neighbours the probability is 0.5; only `decide` abstains.

    Parameters
    ----------
    radius : float, default 0.3
        Radius around a query, in units of the embedding, surface included.
    alpha, lower_bound, interval
        As of `Policy`.
    capacity : int, default 10000
        Largest number of references; the oldest leave first, whatever their label.

    References
    ----------
    The paper's sections "Radius Neighbors Classifier" and "Confidence Prediction". With a uniform
    kernel it is the Wilson score kernel density classifier of Iversen et al. (2025).
    """

    radius: float = 0.3
    alpha: float = 0.05
    lower_bound: float = 0.95
    interval: str = "wilson"
    capacity: int = 10_000

    def fit(self, Z: ArrayLike, y: ArrayLike) -> Self:
        """Make these embeddings the references (labelled points), in place of all earlier ones.

        It sets `classes_`, the sorted classes, `index_`, which holds the references, and
        `neighbours_`, the module that counts the references around a point and decides. Of two
        classes the last is the success. A single class is the failure if it is 0, False or -1, and
        otherwise the success.

        Parameters
        ----------
        Z : array, shape (n, d)
            Embeddings. If there are more than `capacity` rows, the last ones stay.
        y : array, shape (n,)
            Labels of at most two classes.

        Returns
        -------
        self

        Raises
        ------
        ValueError
            For more than two classes, and for arrays that scikit-learn refuses.
        TypeError
            If Z is sparse.
        SettingError
            For `radius`, `alpha`, `lower_bound` or `interval` out of its range; `capacity` is not
            checked.
        """
        points, labels = validate_data(self, Z, y)
        self.classes_ = classes_of(labels)
        self.index_ = RadiusIndex(points.shape[1], self.capacity)
        self.neighbours_ = self.neighbours_over(self.index_)
        success = labels == self.classes_[-1]
        if len(self.classes_) == 1 and self.classes_[0] in (0, False, -1):
            success = ~success  # a lone class of zeros is all failures
        self.index_.add(points, success)
        return self

    def count(self, Z: ArrayLike) -> tuple[Ints, Ints]:
        """Count the labels within the radius of each row; NotFittedError before `fit`.

        Parameters
        ----------
        Z : array, shape (n, d)

        Returns
        -------
        n_success, n_failure : array of int64, shape (n,)
        """
        n_success, n_failure = self._decisions(Z)[:, 3:].astype(np.int64).T
        return n_success, n_failure

    def predict_interval(self, Z: ArrayLike) -> tuple[Floats, Floats]:
        """Bound the success probability of each row of Z (n, d); NotFittedError before `fit`.

        Returns
        -------
        lower, upper : array of float64, shape (n,)
            (0, 1) without neighbours.
        """
        lower, upper = self._decisions(Z)[:, 1:3].T
        return lower, upper

    def decide(self, Z: ArrayLike) -> NDArray[Any]:
        """Return an `Action` for each row of Z (n, d), shape (n,); VERIFY without neighbours.

        It is ACCEPT if lower >= `lower_bound`, otherwise REJECT if upper <= 1 - `lower_bound`.
        Raises NotFittedError before `fit`.
        """
        return np.array(
            [ACTIONS[int(position)] for position in self._decisions(Z)[:, 0]], dtype=object
        )

    def predict_proba(self, Z: ArrayLike) -> Floats:
        """Return the observed rates of both classes within the radius; NotFittedError before `fit`.

        Parameters
        ----------
        Z : array, shape (n, d)
            Points; ValueError if scikit-learn refuses them, TypeError if they are sparse.

        Returns
        -------
        array of float64, shape (n, 2)
            Rate of failure, rate of success, in the order of `classes_`; 0.5 each if no label is
            within the radius. If `classes_` has one class, the array is all ones, of shape (n, 1).
        """
        n_success, n_failure = self.count(Z)
        n = n_success + n_failure
        if len(self.classes_) == 1:
            return np.ones((len(n_success), 1))
        rate = np.where(n > 0, n_success / np.maximum(n, 1), 0.5)
        return np.stack([1.0 - rate, rate], axis=1)

    def predict(self, Z: ArrayLike) -> NDArray[Any]:
        """Return the more frequent class within the radius for each row of Z (n, d), shape (n,).

        On a tie, and without neighbours, it is the first of two classes, the failure. If `fit` got
        a single class, it is always this class. Raises NotFittedError before `fit`.
        """
        rates = self.predict_proba(Z)
        return np.asarray(self.classes_[rates.argmax(axis=1)])

    def policy(self) -> Policy:
        """Return the policy of these settings; SettingError if one of them is out of range.

        It has alpha, lower bound and interval, and else the defaults, so the guarantee "local".
        The radius, which is no part of it, is checked as well.
        """
        check_radius(self.radius)
        return Policy(self.alpha, self.lower_bound, self.interval)

    def neighbours_over(
        self, index: RadiusIndex, rule: DecisionRule | None = None, scored: bool = False
    ) -> RadiusNeighbours:
        """Make the module that decides over the points of an index by these settings.

        It shares the index and the rule, so later points and outcomes count. Raises SettingError if
        a setting is out of range and no rule is given.

        Parameters
        ----------
        index : RadiusIndex
        rule : DecisionRule, optional
            None: the policy's own.
        scored : bool, default False
            Whether the first axis is a probability of success. A rule that only sorts takes it for
            its score.

        Returns
        -------
        RadiusNeighbours
        """
        rule = rule or self.policy().rule()
        return RadiusNeighbours(index, rule, self.radius, scored and rule.sorts)

    def _decisions(self, Z: ArrayLike) -> Floats:
        """Decide on each row of Z (n, d), by the labels within the radius.

        Returns float64 (n, 5), with the columns `ActionCode` (0 verify, 1 accept, 2 reject), lower,
        upper (bound on the success probability), n_success and n_failure (labels within the
        radius). The action is accept if lower >= `lower_bound`, otherwise reject if upper <= 1 -
        `lower_bound`, otherwise verify. Raises NotFittedError before `fit`, and ValueError for
        arrays that scikit-learn refuses (TypeError for sparse ones).
        """
        check_is_fitted(self)
        embeddings = torch.from_numpy(
            np.array(validate_data(self, Z, reset=False), dtype=np.float32)
        )
        with torch.inference_mode():
            rows = [self.neighbours_(z[None, :]) for z in embeddings]
        return np.array(rows, dtype=np.float64).reshape(-1, 5)

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.classifier_tags.multi_class = False
        return tags


def classes_of(y: ArrayLike) -> NDArray[Any]:
    """Return the sorted distinct labels in `y`, two at most, as an array.

    Raises
    ------
    ValueError
        For more than two classes and for continuous labels, in the words that scikit-learn's checks
        of estimators expect.
    """
    check_classification_targets(y)
    classes = np.unique(y)
    if len(classes) > 2:
        raise ValueError(
            "Only binary classification is supported. The type of the target is multiclass: "
            f"expected two classes, 1 = success and 0 = failure, got {len(classes)}."
        )
    return classes
