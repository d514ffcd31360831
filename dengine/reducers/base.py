"""What a reducer is: trace -> embedding, and everything that the model asks of one.

A reducer of one's own is a subclass with `fit` and `transform`; the rest has defaults. `dengine.testing.check_reducer` runs
the contract on it. Any scikit-learn transformer works as well: label-free ones as they are, label-using ones cross-fitted.

    >>> as_reducer(PCA(2), folds=5)                          # LabelFree: never handed a label, one space
    >>> as_reducer(LinearDiscriminantAnalysis(), folds=5)    # CrossFitted: five clones, five spaces

Embeddings have K spaces: a label may be counted for a query only in a space that never saw that label, so fold k's
references live in space k, which was fitted without fold k's labels. A reducer that uses no labels has one space.
"""

import time
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, ClassNamePrefixFeaturesOutMixin, TransformerMixin, clone
from sklearn.utils import ClassifierTags, get_tags
from sklearn.utils.validation import assert_all_finite, check_array, check_is_fitted, column_or_1d, validate_data

from ..decision.classifier import classes_of
from ..errors import SettingError, TraceError, expect
from ..folds import content_fold

if TYPE_CHECKING:
    from torch import nn

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]
State = dict[str, NDArray[Any]]
FAR_OUT, FEW = 50.0, 0.05  # times the median distance from the middle, and the share of such points


@dataclass
class StopRule:
    """When an iterative fit must stop; asked before each step.

    deadline : reading of `clock` after which no step may begin; None: time decides nothing, so that a seed repeats exactly.
    late : whether the deadline ended the fit.
    """

    deadline: float | None = None
    max_steps: int | None = None
    clock: Callable[[], float] = time.perf_counter
    late: bool = False

    def exhausted(self, step: int, least: int = 0) -> bool:
        """Whether step number `step`, from 0, may no longer begin; the first `least` may, after the deadline too."""
        if self.max_steps is not None and step >= self.max_steps:
            return True
        self.late = self.deadline is not None and self.clock() >= self.deadline and step >= least
        return self.late


@dataclass(frozen=True, slots=True)
class FitReport:
    """What a fit reports.

    n_steps : optimiser steps that it took.  note : one line for the operator.
    n_steps_left : steps that are missing until training is complete; the engine then retrains after every cycle.
    """

    n_steps: int = 0
    note: str = ""
    n_steps_left: int = 0


class Reducer(ClassNamePrefixFeaturesOutMixin, TransformerMixin, BaseEstimator):  # type: ignore[misc]  # scikit-learn ships no types
    """A scikit-learn transformer of traces, (n, T) or (n, C, T), into points (n, d), and the model's view of it.

    uses_labels : whether `fit` reads `y`. One that does, and does not cross-fit by itself, is cross-fitted from outside.
    scores : whether the first axis is the predicted probability of success.
    own_unit : whether the embedding has a unit of its own, a probability say, that must not be scaled away.
    min_traces : how many labelled traces the first training in an engine waits for.
    default_radius : radius of the ball whose labels count, where a recipe names none. The embedding is scaled to a root
        mean square radius of 1 first, unless it has a unit of its own.
    default_retrain_every : new labels between two retrains, where a recipe names none.
    """

    uses_labels = False
    scores = False
    own_unit = False
    min_traces = 1
    default_radius = 0.3
    default_retrain_every = 50

    @abstractmethod
    def fit(self, X: ArrayLike, y: ArrayLike | None = None) -> Self:
        """Fit on traces (n, T) or (n, C, T) and, where labels are used, y (n,), the larger value being the success.

        Starts afresh: what an earlier fit learned is forgotten. `train` is the engine's way, which may go on from it.
        """

    def transform(self, X: ArrayLike) -> Floats:
        """(n, T) or (n, C, T) -> (n, d); of several spaces their mean, for pictures, never counted in.

        Give this or `embed`. Each trace alone, as a cell decides: in a batch its last bits depend on what is beside it.
        """
        traces = self.check_traces(X)
        return np.concatenate([self.embed(traces[i : i + 1]).mean(axis=1) for i in range(max(1, len(traces)))])

    @property
    def n_spaces(self) -> int:
        """K, embedding spaces."""
        return 1

    def train(self, X: Floats, y: Ints, folds: Ints, stop: StopRule | None = None, numbers: Ints | None = None) -> Floats:
        """Fit for an engine, from where an earlier training ended if the kind can; returns the traces' own places (n, d).

        X : (n, C, T).  y : (n,) 1 success, 0 failure.  folds : (n,) permanent folds; space k uses no label of fold k.
        stop : asked before each step of a fit that has steps; None: until done.
        numbers : (n,) of the labels, increasing: the same number is the same trace in every training; None: all are new.
        Row i of the result lies in space folds[i], where it will live as a reference.
        """
        self.fit(X, y if self.uses_labels else None)
        return self.embed_own(X, folds)

    def blank(self, X: Floats) -> Any:
        """A module as `module` will give after `train` on X (n, C, T), its dimension `dim`; None: that is not known."""

    def warm_up(self) -> None:  # a default: nothing to load
        """Load what the first training would load; an engine calls it in a thread when it starts."""

    def look_ahead(self, X: Floats, numbers: Ints | None = None) -> None:
        """Do now what `train` on X (n, C, T) with labels of these numbers would begin with, as far as no label is read."""

    def embed(self, X: Floats) -> Floats:
        """(n, C, T) -> (n, K, d) float32, every trace in every space."""
        return as_points(self.transform(X))[:, None, :]

    def embed_own(self, X: Floats, folds: Ints) -> Floats:
        """(n, C, T) -> (n, d), row i in space folds[i]."""
        return own_places(self.embed(X), folds)

    def module(self) -> "nn.Module | None":
        """The embedding as a module that TorchScript compiles, (B, C, T) -> (B, K, d); None: it stays in Python."""
        return None

    def get_state(self) -> State | None:
        """Plain arrays that `set_state` restores bit for bit; None where only a refit can."""
        return None

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        """Become what `get_state` was taken from; the parameters must be the same."""
        raise NotImplementedError(f"{type(self).__name__} gives no state, so it is restored by a refit.")

    @property
    def report(self) -> FitReport:
        """What the last fit says of itself."""
        return FitReport()

    def check_traces(self, X: Any, *, reset: bool = False) -> Floats:
        """Traces (n, T) or (n, C, T), arrays or data frames, as (n, C, T) float32; ValueError for a NaN or another shape.

        reset : whether these traces set the shape that later ones must have, as in `fit`.
        """
        if not reset:
            check_is_fitted(self)
        said = {"ensure_min_samples": int(reset), "estimator": self, "input_name": "X"}
        # Writeable, since torch warns of an array that it could not write to.
        x = np.asarray(check_array(X, dtype=np.float32, order="C", allow_nd=True, force_writeable=True, **said))
        if x.ndim > 3 or 0 in x.shape[1:]:
            raise TraceError(f"Expected traces (n, samples) or (n, channels, samples) with samples, got shape {x.shape}.")
        traces = x[:, None, :] if x.ndim == 2 else x
        if reset or x.ndim == 2:  # only a table's columns have names and a number to compare
            validate_data(self, X if x.ndim == 2 else as_rows(traces), reset=reset, skip_check_array=True)
        if reset:
            self.trace_shape_ = traces.shape[1:]
        elif traces.shape[1:] != self.trace_shape_:
            wanted, got = ("{} channels x {} samples".format(*shape) for shape in (self.trace_shape_, traces.shape[1:]))
            raise TraceError(f"Expected traces of {wanted}, as in fit, got {got}; resample, or fit anew.")
        return traces

    @property
    def _n_features_out(self) -> int:  # scikit-learn's name, for get_feature_names_out
        check_is_fitted(self)
        return int(self.get_params(deep=False)["n_components"])

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.target_tags.required = self.uses_labels
        if self.uses_labels:
            tags.classifier_tags = ClassifierTags(multi_class=False)  # no classifier, but its labels are of two classes
        tags.transformer_tags.preserves_dtype = ["float32"]
        return tags


def as_points(Z: Any) -> Floats:
    """An embedding (n, d) as float32."""
    return np.ascontiguousarray(Z, dtype=np.float32)


def as_rows(traces: Floats) -> Floats:
    """(n, C, T) -> (n, C * T), of no traces as well."""
    n, channels, samples = traces.shape
    return traces.reshape(n, channels * samples)


def own_places(Z: Floats, folds: Ints) -> Floats:
    """(n, K, d) -> (n, d), row i of space folds[i]; of one space, all of it."""
    own = np.asarray(folds) if Z.shape[1] > 1 else np.zeros(len(Z), dtype=np.int64)
    return np.ascontiguousarray(Z[np.arange(len(Z)), own])


def space_scale(points: Floats, folds: Ints, n_spaces: int) -> Floats:
    """(K,) root mean square radius of each fold's points in its own space; 1 where a fold is empty or has no spread.

    A few points that lie absurdly far out are left out: one of them would draw all others together.
    """
    scale = np.ones(n_spaces, dtype=np.float32)
    for k in range(n_spaces):
        own = points[folds == k]
        if len(own):
            distances = np.abs(own - np.median(own, axis=0)).max(axis=1)
            near = distances <= FAR_OUT * np.median(distances)
            own = own[near] if (~near).sum() <= max(1.0, FEW * len(own)) else own
        rms = float(np.sqrt(((own - own.mean(axis=0)) ** 2).sum(axis=1).mean())) if len(own) else 0.0
        scale[k] = rms if np.isfinite(rms) and rms > 1e-12 else 1.0
    return scale


def binary_labels(y: Any, n: int, name: str) -> Ints:
    """Labels (n,) of two classes as 1, the larger one, and 0; those of 0 and 1 as they are. SettingError for others."""
    if y is None:
        raise SettingError(f"{name} uses labels: requires y to be passed, but the target y is None.")
    try:
        labels = column_or_1d(y, warn=True)
        assert_all_finite(labels, input_name="y")
        classes = classes_of(labels)
    except ValueError as error:  # scikit-learn's words for one that is continuous, not finite or not one column
        raise SettingError(str(error)) from error
    labels = np.asarray(labels)
    if len(labels) != n:
        raise SettingError(f"Expected a label for each of {n} traces, got inconsistent numbers of samples: {len(labels)}.")
    if np.isin(classes, (0, 1)).all():
        return labels.astype(np.int64)
    return np.asarray(labels == classes[-1], dtype=np.int64)


def folds_of(traces: Floats, n_folds: int, folds: Any = None) -> Ints:
    """Return the folds (n,) of traces (n, C, T): those given, or by the traces' content.

    Raises SettingError unless there is one from 0 to n_folds - 1 for each trace.
    """
    if folds is None:
        return content_fold(traces, n_folds)
    given = np.asarray(folds, dtype=np.int64)
    within = given.shape == (len(traces),) and given.min() >= 0 and given.max() < n_folds
    expect(within, f"{len(traces)} folds from 0 to {n_folds - 1}", given)
    return given


def one_class_outside(fold: int, n: int, classes: int) -> SettingError:
    """What is said where clone or head `fold` would learn from n traces of fewer than two classes."""
    got = f"{n} traces of {classes} class; collect more labels before the first fit."
    if n == 0:
        got = "0 traces: all share one fold, the same to 1/65536 of their unit; look at the sensor, or the unit."
    return SettingError(f"Expected both classes outside fold {fold}, got {got}")


def seed_of(random_state: Any) -> int | None:
    """scikit-learn's `random_state` (None, an integer or a RandomState) as a seed for NumPy's and torch's generators."""
    if random_state is None:
        return None
    if isinstance(random_state, int | np.integer):
        return int(random_state)
    if isinstance(random_state, np.random.RandomState):
        return int(random_state.randint(2**31 - 1))
    raise SettingError(f"Expected random_state None, an integer or a RandomState, got {random_state!r}.")


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


@dataclass(eq=False, repr=False)
class _Wrapping(Reducer):
    """A reducer that hands traces on to a transformer of somebody else's."""

    reducer: Any

    @property
    def own_unit(self) -> bool:  # type: ignore[override]  # a constant of a kind; here the wrapped one's
        """What a wrapped `Reducer` says; a transformer has no word on it and is scaled."""
        return self.reducer.own_unit if isinstance(self.reducer, Reducer) else False

    def handed(self, X: Floats) -> Any:
        """Traces (n, C, T) as the transformer takes them: ours as they are, scikit-learn's as rows."""
        return X if isinstance(self.reducer, Reducer) else as_rows(X).copy()  # which a transformer may write to

    @property
    def _n_features_out(self) -> int:
        check_is_fitted(self)
        return int(self.dim_)


class LabelFree(_Wrapping):
    """A transformer that uses no labels: one space serves every fold.

    reducer : the transformer; `fit` works on a clone, `reducer_`.
    """

    def fit(self, X: ArrayLike, y: ArrayLike | None = None) -> Self:
        traces = self.check_traces(X, reset=True)
        self.reducer_ = clone(self.reducer).fit(self.handed(traces))
        self.dim_ = as_points(self.reducer_.transform(self.handed(traces[:1]))).shape[1]
        return self

    def transform(self, X: ArrayLike) -> Floats:
        handed = self.handed(self.check_traces(X))
        return as_points(self.reducer_.transform(handed))


@dataclass(eq=False, repr=False)
class CrossFitted(_Wrapping):
    """Any label-using transformer, K times: clone k is fitted on every trace outside fold k.

    reducer : the transformer; it is cloned, never fitted itself.
    folds : K, 2 or more. A trace's fold is an integer hash of its content (see `folds.py`).
    """

    uses_labels = True

    folds: int = 2

    @property
    def n_spaces(self) -> int:
        return int(self.folds)

    def fit(self, X: ArrayLike, y: ArrayLike | None = None, *, folds: Ints | None = None) -> Self:
        """Fit the K clones; SettingError where one of them would see a single class.

        folds : (n,) of the traces; None: by their content.
        """
        expect(self.folds >= 2, "folds >= 2 for a reducer that uses labels", self.folds)
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

    def train(self, X: Floats, y: Ints, folds: Ints, stop: StopRule | None = None, numbers: Ints | None = None) -> Floats:
        return self.fit(X, y, folds=folds).embed_own(X, folds)

    def embed(self, X: Floats) -> Floats:
        handed = self.handed(self.check_traces(X))
        return np.stack([as_points(each.transform(handed)) for each in self.clones_], axis=1)
