"""Any scikit-learn transformer as a reducer: label-free ones as they are, label-using ones cross-fitted.

>>> as_reducer(PCA(2), folds=5)                          # LabelFree: never handed a label, one space
>>> as_reducer(LinearDiscriminantAnalysis(), folds=5)    # CrossFitted: five clones, five spaces
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import clone
from sklearn.utils import get_tags
from sklearn.utils.validation import check_is_fitted

from ..errors import SettingError
from ..folds import content_fold
from .base import Floats, Ints, Reducer, StopRule, as_points, as_rows, binary_labels, one_class_outside


def uses_labels(transformer: Any) -> bool:
    """Whether `fit` uses labels: scikit-learn's `target_tags.required`. A transformer without the tag is given none."""
    return bool(get_tags(transformer).target_tags.required)


def as_reducer(transformer: Any, folds: int) -> Reducer:
    """The transformer as a `Reducer`, cross-fitted by `folds` clones where it uses labels and has but one space.

    A transformer that uses no labels is never handed any, so its one space is honest by construction.
    """
    if isinstance(transformer, Reducer) and (transformer.n_spaces > 1 or not transformer.uses_labels):
        return transformer
    return CrossFitted(transformer, folds) if uses_labels(transformer) else LabelFree(transformer)


class _Wrapping(Reducer):
    """A reducer that hands traces on to a transformer of somebody else's."""

    reducer: Any
    dim_: int

    @property
    def own_unit(self) -> bool:  # type: ignore[override]  # a constant of a kind; here the wrapped one's
        """What a wrapped `Reducer` says; a transformer has no word on it and is scaled."""
        return self.reducer.own_unit if isinstance(self.reducer, Reducer) else False

    def handed(self, X: Floats) -> Any:
        """Traces (n, C, T) as the transformer takes them: ours as they are, scikit-learn's as rows."""
        return X if isinstance(self.reducer, Reducer) else as_rows(X)

    @property
    def _n_features_out(self) -> int:
        check_is_fitted(self)
        return self.dim_


class LabelFree(_Wrapping):
    """A transformer that uses no labels: one space serves every fold.

    reducer : the transformer; `fit` works on a clone, `reducer_`.
    """

    def __init__(self, reducer: Any) -> None:
        self.reducer = reducer

    def fit(self, X: ArrayLike, y: ArrayLike | None = None) -> Self:
        traces = self.check_traces(X, reset=True)
        self.reducer_ = clone(self.reducer).fit(self.handed(traces))
        self.dim_ = as_points(self.reducer_.transform(self.handed(traces[:1]))).shape[1]
        return self

    def transform(self, X: ArrayLike) -> Floats:
        handed = self.handed(self.check_traces(X))
        return as_points(self.reducer_.transform(handed))


class CrossFitted(_Wrapping):
    """Any label-using transformer, K times: clone k is fitted on every trace outside fold k.

    reducer : the transformer; it is cloned, never fitted itself.
    folds : K, 2 or more. A trace's fold is an integer hash of its content (see `folds.py`).
    """

    uses_labels = True

    def __init__(self, reducer: Any, folds: int = 2) -> None:
        self.reducer = reducer
        self.folds = folds

    @property
    def n_spaces(self) -> int:
        return int(self.folds)

    def fit(self, X: ArrayLike, y: ArrayLike | None = None, *, folds: Ints | None = None) -> Self:
        """Fit the K clones; SettingError where one of them would see a single class.

        folds : (n,) of the traces; None: by their content.
        """
        if self.folds < 2:
            raise SettingError(f"Expected folds >= 2 for a reducer that uses labels, got {self.folds}.")
        traces = self.check_traces(X, reset=True)
        labels = binary_labels(y, len(traces), type(self.reducer).__name__)
        folds = content_fold(traces, self.folds) if folds is None else folds
        self.clones_ = [clone(self.reducer) for _ in range(self.folds)]
        for k in range(self.folds):
            outside = folds != k
            # Fold k never trains clone k, or its labels would count themselves.
            classes = len(np.unique(labels[outside]))
            if classes < 2:
                raise one_class_outside(k, int(outside.sum()), classes)
            self.clones_[k].fit(self.handed(traces[outside]), labels[outside])
        self.dim_ = self.embed(traces[:1]).shape[2]
        return self

    def train(self, X: Floats, y: Ints, folds: Ints, stop: StopRule | None = None) -> Floats:
        return self.fit(X, y, folds=folds).embed_own(X, folds)

    def embed(self, X: Floats) -> Floats:
        handed = self.handed(self.check_traces(X))
        return np.stack([as_points(each.transform(handed)) for each in self.clones_], axis=1)
