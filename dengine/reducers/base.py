"""What every reducer is to the engine: K embedding spaces, of which space k never saw a label of fold k.

A reducer is a scikit-learn transformer: `fit(X, y=None)`, `transform(X) -> (n, d)`. `in_spaces` gives any of them the
face that the model prediction works with (`Spaces`): one that uses no labels has one space, one that does is
cross-fitted, and one that cross-fits by itself (`ConvReducer`) is taken as it is.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, TransformerMixin, clone
from sklearn.utils import get_tags

from ..errors import SettingError
from ..folds import content_fold

if TYPE_CHECKING:
    from torch import nn

__all__ = ["CrossFitted", "OneSpace", "Spaces", "StopRule", "content_fold", "in_spaces", "uses_labels"]

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]
State = dict[str, NDArray[Any]]


@dataclass
class StopRule:
    """When an iterative fit must stop; asked before each step.

    deadline : reading of `clock` after which no step may begin; None: time decides nothing, so that a seed repeats exactly.
    max_steps : steps at most; None: no limit.
    asked_at : reading of `clock` when last asked; after the fit, the end of its last step.
    """

    deadline: float | None = None
    max_steps: int | None = None
    clock: Callable[[], float] = time.perf_counter
    asked_at: float | None = None

    def exhausted(self, step: int) -> bool:
        """Whether step number `step`, from 0, may no longer begin."""
        self.asked_at = self.clock()
        if self.max_steps is not None and step >= self.max_steps:
            return True
        return self.deadline is not None and self.asked_at >= self.deadline


class Spaces(Protocol):
    """A reducer as the model prediction sees it: K spaces, fold k's references living in space k."""

    @property
    def n_spaces(self) -> int:
        """K; 1 for a reducer that uses no labels."""
        ...

    @property
    def natural_scale(self) -> bool:
        """Whether the embedding has a unit of its own, a probability say, that must not be scaled away."""
        ...

    def fit(self, X: Floats, y: Ints, folds: Ints, stop: StopRule | None = None) -> Self:
        """Fit on traces (n, C, T), labels (n,) and folds (n,); space k uses no label of fold k."""
        ...

    def embed(self, X: Floats) -> Floats:
        """(n, C, T) -> (n, K, d), every trace in every space."""
        ...

    def embed_own(self, X: Floats, folds: Ints) -> Floats:
        """(n, C, T) -> (n, d), row i in space folds[i]: where references live."""
        ...

    def embed_fitted(self, X: Floats, folds: Ints) -> Floats:
        """`embed_own` of the very traces that were fitted, where the fit already placed them."""
        ...

    def module(self) -> nn.Module | None:
        """The embedding as a scriptable module, (B, C, T) -> (B, K, d); None where there is none."""
        ...

    def get_state(self) -> State | None:
        """Plain arrays that `set_state` restores bit for bit; None where only a refit can."""
        ...

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        """Restore what `get_state` gave."""
        ...

    @property
    def report(self) -> FitReport:
        """What the last fit says of itself."""
        ...


@dataclass(frozen=True, slots=True)
class FitReport:
    """What an iterative fit says of itself: steps taken, and a held-out loss that no counted label chose (NaN: none)."""

    n_steps: int = 0
    holdout_loss: float = float("nan")
    note: str = ""


def uses_labels(reducer: Any) -> bool:
    """Whether `fit` uses labels: scikit-learn's `target_tags.required`. A reducer without the tag is given none."""
    return bool(get_tags(reducer).target_tags.required)


def in_spaces(reducer: Any, folds: int) -> Spaces:
    """The reducer with the face of `Spaces`, cross-fitted by `folds` clones where it uses labels.

    A reducer that uses no labels is never handed any, so its one space is honest by construction.
    """
    if hasattr(reducer, "embed_own"):
        spaces: Spaces = reducer if isinstance(reducer, CrossFitted | OneSpace) else _Native(reducer)
        return spaces
    return CrossFitted(reducer, folds) if uses_labels(reducer) else OneSpace(reducer)


class OneSpace:
    """A label-free transformer: one space serves every fold."""

    n_spaces = 1

    def __init__(self, reducer: Any) -> None:
        self.reducer = reducer

    @property
    def natural_scale(self) -> bool:
        """What the reducer says; an embedding without a word on it is scaled."""
        return bool(getattr(self.reducer, "natural_scale", False))

    def fit(self, X: Floats, y: Ints | None = None, folds: Ints | None = None, stop: StopRule | None = None) -> Self:
        """Fit on the traces alone."""
        self.reducer.fit(_as_expected(self.reducer, X))
        return self

    def embed(self, X: Floats) -> Floats:
        """(n, C, T) -> (n, 1, d)."""
        return _float32(self.reducer.transform(_as_expected(self.reducer, X)))[:, None, :]

    def embed_own(self, X: Floats, folds: Ints) -> Floats:
        """(n, C, T) -> (n, d)."""
        return self.embed(X)[:, 0]

    def embed_fitted(self, X: Floats, folds: Ints) -> Floats:
        """(n, C, T) -> (n, d): UMAP's fit has placed its training traces, a transform would place them anew, slowly."""
        placed = getattr(self.reducer, "embedding_", None)
        return self.embed_own(X, folds) if placed is None else _float32(placed)

    def transform(self, X: Floats) -> Floats:
        """(n, C, T) -> (n, d)."""
        return self.embed(X)[:, 0]

    def module(self) -> nn.Module | None:
        """The reducer's module, where it has one."""
        return self.reducer.module() if hasattr(self.reducer, "module") else None

    def get_state(self) -> State | None:
        """The reducer's arrays, where it gives them."""
        return self.reducer.get_state() if hasattr(self.reducer, "get_state") else None

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        """Restore the reducer's arrays."""
        self.reducer.set_state(state)
        return self

    @property
    def report(self) -> FitReport:
        """What the reducer says of its last fit."""
        return _report(self.reducer)


class _Native(OneSpace):
    """A reducer that cross-fits by itself."""

    @property
    def n_spaces(self) -> int:  # type: ignore[override]  # a constant for one space, a parameter here
        """The reducer's own number of folds."""
        return int(self.reducer.n_spaces)

    def fit(self, X: Floats, y: Ints | None = None, folds: Ints | None = None, stop: StopRule | None = None) -> Self:
        """Fit all spaces at once."""
        self.reducer.fit(X, y, folds=folds, stop=stop)
        return self

    def embed(self, X: Floats) -> Floats:
        """(n, C, T) -> (n, K, d)."""
        return _float32(self.reducer.embed(X))

    def embed_own(self, X: Floats, folds: Ints) -> Floats:
        """(n, C, T) -> (n, d)."""
        return _float32(self.reducer.embed_own(X, folds))

    def embed_fitted(self, X: Floats, folds: Ints) -> Floats:
        """(n, C, T) -> (n, d), from what the fit computed where the reducer kept it."""
        fitted = getattr(self.reducer, "embed_fitted", self.reducer.embed_own)
        return _float32(fitted(X, folds))

    def transform(self, X: Floats) -> Floats:
        """(n, C, T) -> (n, d)."""
        return _float32(self.reducer.transform(X))


class CrossFitted(TransformerMixin, BaseEstimator):  # type: ignore[misc]  # scikit-learn ships no types
    """Any label-using transformer, K times: clone k is fitted on every trace outside fold k.

    reducer : the transformer; it is cloned, never fitted itself.
    folds : K, 2 or more.
    """

    def __init__(self, reducer: Any, folds: int = 2) -> None:
        self.reducer = reducer
        self.folds = folds

    @property
    def natural_scale(self) -> bool:
        """What the reducer says of its clones."""
        return bool(getattr(self.reducer, "natural_scale", False))

    @property
    def n_spaces(self) -> int:
        """K."""
        return int(self.folds)

    def fit(self, X: Floats, y: Ints | None = None, folds: Ints | None = None, stop: StopRule | None = None) -> Self:
        """Fit the K clones; SettingError where one of them would see a single class."""
        if self.folds < 2:
            raise SettingError(f"Expected folds >= 2 for a reducer that uses labels, got {self.folds}.")
        if y is None:
            raise SettingError(f"{type(self.reducer).__name__} uses labels: expected y, got None.")
        folds = content_fold(X, self.folds) if folds is None else folds
        self.clones_ = [clone(self.reducer) for _ in range(self.folds)]
        for k, outside in self._outside(folds):
            # Fold k never trains clone k, or its labels would count themselves.
            if len(np.unique(y[outside])) < 2:
                raise SettingError(f"Expected both classes outside fold {k}, got {int(outside.sum())} traces of one.")
            self.clones_[k].fit(_as_expected(self.reducer, X[outside]), y[outside])
        return self

    def _outside(self, folds: Ints) -> Iterator[tuple[int, NDArray[np.bool_]]]:
        return ((k, folds != k) for k in range(self.folds))

    def embed(self, X: Floats) -> Floats:
        """(n, C, T) -> (n, K, d)."""
        flat = _as_expected(self.reducer, X)
        return np.stack([_float32(c.transform(flat)) for c in self.clones_], axis=1)

    def embed_own(self, X: Floats, folds: Ints) -> Floats:
        """(n, C, T) -> (n, d), row i by clone folds[i]."""
        return np.asarray(self.embed(X)[np.arange(len(X)), folds])

    def embed_fitted(self, X: Floats, folds: Ints) -> Floats:
        """(n, C, T) -> (n, d), as `embed_own`."""
        return self.embed_own(X, folds)

    def transform(self, X: Floats) -> Floats:
        """(n, C, T) -> (n, d): the mean over the K spaces, for pictures; never counted in."""
        return np.asarray(self.embed(X).mean(axis=1))

    def module(self) -> None:
        """None: K arbitrary transformers have no common module."""
        return

    def get_state(self) -> None:
        """None: restored by a refit."""
        return

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        """Never called: there is no state to restore."""
        raise NotImplementedError("CrossFitted is restored by a refit.")

    @property
    def report(self) -> FitReport:
        """Closed-form as far as anybody knows."""
        return FitReport()


def _as_expected(reducer: Any, X: Floats) -> Floats:
    """Traces as a transformer takes them: ours take (n, C, T), scikit-learn's take rows."""
    return X if getattr(reducer, "takes_traces", False) else X.reshape(len(X), -1)


def _float32(Z: Any) -> Floats:
    return np.ascontiguousarray(Z, dtype=np.float32)


def _report(reducer: Any) -> FitReport:
    steps, loss = getattr(reducer, "n_steps_", 0), getattr(reducer, "holdout_loss_", float("nan"))
    return FitReport(int(steps), float(loss), str(getattr(reducer, "note_", "")))
