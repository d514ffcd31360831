"""`Reducer`, the base class of everything that embeds traces, and the adapters `LabelFree` and
`CrossFitted` for scikit-learn's transformers, which `as_reducer` chooses. The file also holds
`StopRule` and `FitReport`, what a training is given and gives back, and the checks of labels, folds
and seeds that all reducers share.

A reducer of your own is a subclass with `fit` and `transform`; all else has defaults, and
`dengine.testing.check_reducer` checks it. Any scikit-learn transformer works as well: `as_reducer`
wraps one that needs no labels in `LabelFree`, and one that uses labels in `CrossFitted`.

    >>> as_reducer(PCA(2), folds=5)                          # LabelFree: one space
    >>> as_reducer(LinearDiscriminantAnalysis(), folds=5)    # CrossFitted: five clones, five spaces

An embedding has K spaces. A label may be counted for a query only in a space that was fitted
without that label. So references of fold k live in space k, which is fitted without the labels of
fold k. A reducer that uses no labels has one space.
"""

import time
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, ClassNamePrefixFeaturesOutMixin, TransformerMixin, clone
from sklearn.utils import ClassifierTags, check_random_state, get_tags
from sklearn.utils.validation import (
    assert_all_finite,
    check_array,
    check_is_fitted,
    column_or_1d,
    validate_data,
)
from torch import Tensor, nn

from ..decision.classifier import classes_of
from ..errors import SettingError, TraceError, expect, instead
from ..folds import content_fold
from ..records import Arrays, State, is_whole
from ..records import Ints as Ints

Floats = NDArray[np.float32]
OUTLIER_DISTANCE = 50.0  # times the median distance from the median point
OUTLIER_SHARE = 0.05  # more points than this share are not outliers
NO_ROWS: Floats = np.zeros((0, 0), np.float32)
SMALLEST = 1e-12  # that the largest sample must reach
SAME_POINTS = 1e-3  # by which points of one trace may differ: between machines, compiled, restored


@dataclass
class StopRule:
    """When an iterative fit stops: after a number of steps, at a deadline, or both.

    Attributes
    ----------
    deadline : float, optional
        Value of `clock` after which no further step begins. None: no deadline, so that a fit
        repeats exactly for a seed.
    max_steps : int, optional
        Largest number of steps. None: no limit.
    clock : callable, default `time.perf_counter`
        Returns the present time in seconds.
    late : bool
        Whether the deadline, and not the number of steps, ended the fit.
    last_step : float or None
        When the last step of a fit with a deadline began; None before the first step.
    """

    deadline: float | None = None
    max_steps: int | None = None
    clock: Callable[[], float] = time.perf_counter
    late: bool = False
    last_step: float | None = None

    def exhausted(self, step: int, min_steps: int = 0) -> bool:
        """Return whether step number `step` of a fit, counted from 0, may not begin any more.

        That is so once `max_steps` steps were taken, or once the deadline is reached and at least
        `min_steps` steps were taken. With a deadline, `late` becomes True if the deadline is the
        reason; if the step may begin, `late` becomes False and `last_step` the present time. If
        `max_steps` is the reason, neither is changed.
        """
        if self.max_steps is not None and step >= self.max_steps:
            return True
        if self.deadline is None:
            return False
        now = self.clock()
        self.late = now >= self.deadline and step >= min_steps
        if not self.late:
            self.last_step = now
        return self.late


@dataclass(frozen=True, slots=True)
class FitReport:
    """What a fit reports.

    Attributes
    ----------
    n_steps : int
        Optimiser steps that it took.
    note : str
        One line for the operator; "" if there is nothing to say.
    n_steps_left : int
        Steps that are missing until training is complete. If there are some, an engine without a
        product retrains again without waiting for new labels.
    """

    n_steps: int = 0
    note: str = ""
    n_steps_left: int = 0


class Reducer(ClassNamePrefixFeaturesOutMixin, TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Base class of reducers: a scikit-learn transformer from traces to points.

    Attributes
    ----------
    uses_labels : bool, default False
        Whether `fit` reads `y`. A reducer that does, and has a single space, is cross-fitted by
        `as_reducer`.
    scores : bool, default False
        Whether the first coordinate is the predicted probability of success.
    own_unit : bool, default False
        Whether the embedding has a unit, a probability for example. It is then not scaled.
    min_traces : int, default 1
        Number of labelled traces that an engine collects before the first training.
    default_radius : float, default 0.3
        Radius of the neighbourhood whose labels count, if a recipe names none. Unless `own_unit`
        is True, the embedding is first scaled to a root mean square radius of 1.
    default_retrain_every : int, default 50
        New labels between two retrains, if a recipe names none.
    why_no_module_ : str or None
        Why `module` returns None, for the error of an export; None if that is not known yet.
    """

    uses_labels = False
    scores = False
    own_unit = False
    min_traces = 1
    default_radius = 0.3
    default_retrain_every = 50
    why_no_module_: str | None = (
        "it has no module: give it `module()`, which returns the embedding as an nn.Module (see "
        "`Reducer.module`)"
    )

    @abstractmethod
    def fit(self, X: ArrayLike, y: ArrayLike | None = None) -> Self:
        """Fit anew and discard earlier fits. Engines call `train`, which may continue the last fit.

        Parameters
        ----------
        X : array of float, shape (n, T) or (n, C, T)
            Traces.
        y : array, shape (n,), optional
            Labels of two classes; the one that sorts last is success. Only read if `uses_labels`.

        Returns
        -------
        self
        """

    def transform(self, X: ArrayLike) -> Floats:
        """Embed each trace as one point, the mean over all embedding spaces, for pictures.

        A reducer that trains with labels has several embedding spaces, one for each fold of the
        labels. Decisions use `embed`, which gives a point in each space. A subclass defines this
        method or `embed`. Traces are embedded one by one, as in a cell, since in a batch the last
        bits of a result depend on the other traces.

        Parameters
        ----------
        X : array of float, shape (n, T) or (n, C, T)

        Returns
        -------
        array of float32, shape (n, d)

        Raises
        ------
        NotFittedError
            Before a fit.
        ValueError
            If a value is not finite, or the traces have another shape than in `fit`.
        TypeError
            If X is sparse.
        """
        traces = self.check_traces(X)
        return np.concatenate(
            [self.embed(traces[i : i + 1]).mean(axis=1) for i in range(max(1, len(traces)))]
        )

    @property
    def n_spaces(self) -> int:
        """Return K, the number of embedding spaces; 1 by default. It is known before a fit."""
        return 1

    def train(
        self,
        X: Floats,
        y: Ints,
        folds: Ints,
        stop: StopRule | None = None,
        numbers: Ints | None = None,
    ) -> Floats:
        """Train for an engine, and return the embedding of the traces as references.

        The default calls `fit`, which starts anew. `stop` and `numbers` have no effect then, and
        `folds` only says in which space each returned point lies: a subclass with several spaces
        must give it to its fit. A subclass may also go on from its last training.

        Parameters
        ----------
        X : array of float32, shape (n, C, T)
            Traces.
        y : array of int64, shape (n,)
            Labels: 1 success, 0 failure.
        folds : array of int64, shape (n,)
            Permanent fold of each trace. Space k must not depend on the labels of fold k.
        stop : StopRule, optional
            Asked before each step of an iterative fit. None: until the fit is complete.
        numbers : array of int64, shape (n,), optional
            Increasing numbers of the labels. A number belongs to the same trace in every
            training, so that earlier results can be reused. None: all traces are new.

        Returns
        -------
        array of float32, shape (n, d)
            Row i lies in space ``folds[i]``, where the trace is a reference.
        """
        self.fit(X, y if self.uses_labels else None)
        return self.embed_references(X, folds)

    def untrained_module(self, X: Floats) -> Any:
        """Return a module like the one that `module` returns after training on X (n, C, T).

        Its attribute `dim` is the number of coordinates; its weights do not matter. None, the
        default, if the module is not known before training. X is only read. The engine compiles
        this module ahead of the first training, which then has less to do.
        """

    def warm_up(self) -> None:  # a default: nothing to load
        """Import what the first training needs. An engine calls it before each training.

        The default does nothing.
        """

    def precompute(self, X: Floats, numbers: Ints | None = None) -> None:
        """Compute now, and keep, what the next `train` needs of traces X (n, C, T) without labels.

        `numbers` are the numbers of the labels, by which `train` finds the results again. The
        default does nothing.
        """

    def embed(self, X: Floats) -> Floats:
        """Embed traces (n, C, T) in every space; return float32 (n, K, d).

        Space k is fitted without the labels of fold k. By default there is one space, in which a
        trace lies where `transform` puts it; it raises what `transform` raises.
        """
        return as_points(self.transform(X))[:, None, :]

    def embed_references(self, X: Floats, folds: Ints) -> Floats:
        """Embed traces (n, C, T) as references: float32 (n, d), row i in space ``folds[i]``.

        If there is a single space, every row lies in it.
        """
        return points_in_fold_space(self.embed(X), folds)

    def module(self) -> nn.Module | None:
        """Return the embedding as a module that TorchScript can compile, (B, C, T) -> (B, K, d).

        None, the default, if the reducer has no module: it embeds in Python and cannot be exported.
        """
        return None

    def get_state(self) -> State | None:
        """Return arrays from which `set_state` restores the reducer bit for bit.

        None, the default, if the reducer can only be restored by fitting it again. The
        constructor's parameters are not among them.
        """
        return None

    def restore_shape(self, state: Arrays) -> tuple[int, int]:
        """Read the shape of traces from the array "shape" of a state; return it, (C, T).

        It sets `trace_shape_` and scikit-learn's `n_features_in_`. Raises KeyError if the state has
        no such array.
        """
        channels, samples = map(int, state["shape"])
        self.trace_shape_ = (channels, samples)
        self.n_features_in_ = channels * samples
        return channels, samples

    def set_state(self, state: Arrays) -> Self:
        """Restore what `get_state` returned and return self; the parameters must be the same.

        The default raises NotImplementedError.
        """
        raise NotImplementedError(
            f"{type(self).__name__} gives no state, so it is restored by a refit."
        )

    @property
    def report(self) -> FitReport:
        """Return the report of the last fit; by default one with 0 steps and no note."""
        return FitReport()

    def check_traces(self, X: Any, *, reset: bool = False) -> Floats:
        """Check traces and return them as float32 (n, C, T); traces (n, T) get C = 1.

        Parameters
        ----------
        X : array or DataFrame, shape (n, T) or (n, C, T)
        reset : bool, default False
            Whether these traces set the shape that later ones must have, as in `fit`:
            `trace_shape_`, and scikit-learn's `n_features_in_` and, for a DataFrame whose columns
            have names, `feature_names_in_`. At least one trace is then needed.

        Returns
        -------
        array of float32, shape (n, C, T)
            Writeable; the memory of X itself if X is a writeable, contiguous float32 array.

        Raises
        ------
        NotFittedError
            Without `reset`, before a fit.
        ValueError
            If a value is not a number, or not finite in float32. If X is a single trace (T,), a
            table without columns, or a table or array (n, T) with other columns than in `fit`. With
            `reset`, if there is no trace.
        TypeError
            If X is sparse, or has an object that is neither a real number nor a text, like a dict.
        TraceError
            If X has more than three dimensions, or (n, C, T) no channels or no samples. If X has
            another number of channels or samples than in `fit`. With `reset`, if no absolute value
            reaches 1e-12 but not all samples are 0, because float32 hardly holds their squares.
        """
        if not reset:
            check_is_fitted(self)
        # Writeable, since torch warns of an array that it could not write to.
        x: Floats = check_array(
            X,
            dtype=np.float32,
            order="C",
            allow_nd=True,
            force_writeable=True,
            ensure_min_samples=int(reset),
            estimator=self,
            input_name="X",
        )
        if x.ndim > 3 or 0 in x.shape[1:]:
            raise TraceError(
                "Expected traces (n, samples) or (n, channels, samples) with samples, "
                f"got shape {x.shape}."
            )
        is_table = x.ndim == 2
        traces = x[:, None, :] if is_table else x
        shape = traces.shape[1:]
        if reset or is_table:  # only a table's columns have names and a number to compare
            validate_data(
                self, X if is_table else as_rows(traces), reset=reset, skip_check_array=True
            )
        if reset:
            largest = float(max(traces.max(), -traces.min()))
            expect(
                largest >= SMALLEST or largest == 0.0,
                f"samples of {SMALLEST} at least",
                largest,
                "check the sensor, or use a smaller unit",
                TraceError,
            )
            self.trace_shape_ = shape
        elif shape != self.trace_shape_:
            expected = "{} channels x {} samples".format(*self.trace_shape_)
            actual = "{} channels x {} samples".format(*shape)
            raise TraceError(
                f"Expected traces of {expected}, as in fit, got {actual}; resample, or fit anew."
            )
        return traces

    @property
    def _n_features_out(self) -> int:  # scikit-learn's name, for get_feature_names_out
        """Return d, by embedding a trace of zeros; NotFittedError before a fit."""
        check_is_fitted(self)
        return int(self.transform(np.zeros((1, *self.trace_shape_))).shape[1])

    def __sklearn_tags__(self) -> Any:
        """Return scikit-learn's tags: labels of two classes are needed if `uses_labels`, and the
        output is float32.
        """
        tags = super().__sklearn_tags__()
        tags.target_tags.required = self.uses_labels
        if self.uses_labels:
            # No classifier, but its labels are of two classes.
            tags.classifier_tags = ClassifierTags(multi_class=False)
        tags.transformer_tags.preserves_dtype = ["float32"]
        return tags


def as_points(Z: Any) -> Floats:
    """Return an embedding (n, d) as a contiguous float32 array; the same array if it is one.

    Raises SettingError unless it has two axes.
    """
    points: Floats = np.ascontiguousarray(Z, dtype=np.float32)
    expect(points.ndim == 2, "transform to give points (n, d)", points.shape)
    return points


def as_rows(traces: Floats) -> Floats:
    """Flatten traces (n, C, T) to (n, C * T), a view if they are contiguous; n may be 0."""
    n, channels, samples = traces.shape
    return traces.reshape(n, channels * samples)


@torch.inference_mode()
def embed_in_chunks(module: Callable[[Tensor], Tensor], x: Tensor, size: int) -> Floats:
    """Embed the rows of x (n, ...) by a module, `size` rows at a time: float32 (n, K, d).

    No gradients are kept. If n is 0, the module is called once, with no rows. It is called in the
    mode that it is in (training or evaluation), and must return float32 (rows, K, d) on the CPU.
    """
    return torch.cat([module(chunk) for chunk in torch.split(x, size)]).numpy()


class RowCache:
    """Rows computed from traces, each found again by the number of its trace's label in the store.

    Parameters
    ----------
    numbers : array of int64, shape (n,), or None
        Label numbers of the rows, strictly increasing; None: the cache is empty.
    rows : array of float32, shape (n, p)
        An array, since it is pickled at less cost than a tensor.
    """

    def __init__(self, numbers: Ints | None = None, rows: Floats = NO_ROWS) -> None:
        self.numbers = numbers
        self._rows = rows

    def update(self, numbers: Ints | None, compute: Callable[[Any], Floats]) -> Floats:
        """Return the rows of the labels `numbers`, float32 (m, p), and keep them and no others.

        A row holds values computed from a label's trace, so that they need not be computed again.
        ``compute(index)`` returns the rows that the cache lacks; `index`, a mask (m,) or a slice of
        all, selects them. `numbers` (m,), at least one, strictly increase and are never -1, which
        is not checked. `numbers` and the result are kept without a copy: do not change them. If
        `numbers` is None, all rows are computed, and the cache is neither read nor changed.
        """
        if numbers is None:
            return compute(slice(None))
        if self.numbers is None:
            self._rows = compute(slice(None))
        else:
            positions = np.searchsorted(self.numbers, numbers)
            is_new = np.append(self.numbers, -1)[positions] != numbers
            positions[is_new] = len(self._rows) + np.arange(is_new.sum())
            # Without new ones nothing is copied: `precompute` has computed them before a retrain.
            rows = np.concatenate([self._rows, compute(is_new)]) if is_new.any() else self._rows
            # A slice copies nothing; it is enough unless a trace in between has left.
            is_slice = (np.diff(positions) == 1).all()
            self._rows = rows[positions[0] : positions[-1] + 1] if is_slice else rows[positions]
        self.numbers = numbers
        return self._rows


def points_in_fold_space(Z: Floats, folds: Ints) -> Floats:
    """Return the points (n, d) of an embedding (n, K, d): point i in space ``folds[i]``.

    If there is a single space, all points are in it, and `folds` is not read. The result is a
    contiguous copy.
    """
    return np.ascontiguousarray(Z[np.arange(len(Z)), folds if Z.shape[1] > 1 else 0])


def space_scale(points: Floats, folds: Ints, n_spaces: int) -> Floats:
    """Return the scale of each embedding space: the root mean square radius of its points.

    The points of a space are divided by its scale, so that distances mean the same in all. The
    radius is the distance from their mean. Space k has the points of fold k, one of K groups of
    traces. Outliers are left out, since a single outlier could make the scale so large that all
    other scaled points nearly coincide. A point is an outlier if its distance from the median point
    (the median of each coordinate) is more than 50 times the median of these distances; such a
    distance is the largest absolute difference of a coordinate. If there are several outliers, and
    they are more than 5 % of the fold's points, none is left out.

    Parameters
    ----------
    points : array of float32, shape (n, d)
        Row i lies in space ``folds[i]``.
    folds : array of int64, shape (n,)
        Fold of each point, which is also its space.
    n_spaces : int
        K.

    Returns
    -------
    array of float32, shape (K,)
        1 for a fold without points, or if the root mean square radius is not finite or not above
        rounding errors, about 1e-6 of the largest coordinate.
    """
    scale = np.ones(n_spaces, dtype=np.float32)
    for k in range(n_spaces):
        inside = points[folds == k]
        if not len(inside):
            continue
        distances = np.abs(inside - np.median(inside, axis=0)).max(axis=1)
        is_near = distances <= OUTLIER_DISTANCE * np.median(distances)
        if (~is_near).sum() <= max(1.0, OUTLIER_SHARE * len(inside)):
            inside = inside[is_near]
        if len(inside):
            rms = float(np.sqrt(((inside - inside.mean(axis=0)) ** 2).sum(axis=1).mean()))
            # The mean of equal points may differ from them by rounding.
            rounding = 1e-12 + 1e-6 * float(np.abs(inside).max())
            if np.isfinite(rms) and rms > rounding:
                scale[k] = rms
    return scale


def binary_labels(y: Any, n: int, name: str) -> Ints:
    """Return labels of two classes as int64 (n,): 1 for the class that sorts last, else 0.

    Labels of 0 and 1 stay as they are, also if only one of them occurs. A single class that is
    neither 0 nor 1 becomes 1. A column (n, 1) is accepted with a warning.

    Parameters
    ----------
    y : array, shape (n,)
    n : int
        Number of traces.
    name : str
        Name of the reducer, for the message of an error.

    Returns
    -------
    array of int64, shape (n,)

    Raises
    ------
    SettingError
        If `y` is None, or its labels are of more than two classes, continuous, not finite, not
        in one column, or not n in number.
    """
    if y is None:
        raise SettingError(
            f"{name} uses labels: requires y to be passed, but the target y is None."
        )
    try:
        labels = np.asarray(column_or_1d(y, warn=True))
        assert_all_finite(labels, input_name="y")
        classes = classes_of(labels)
    except (
        ValueError
    ) as error:  # scikit-learn's words for one that is continuous, not finite or not one column
        raise SettingError(str(error)) from error
    if len(labels) != n:
        raise SettingError(
            f"Expected a label for each of {n} traces, "
            f"got inconsistent numbers of samples: {len(labels)}."
        )
    if np.isin(classes, (0, 1)).all():
        return labels.astype(np.int64)
    return np.asarray(labels == classes[-1], dtype=np.int64)


def folds_of(traces: Floats, n_folds: int, folds: Any) -> Ints:
    """Return the folds of traces (n, C, T), int64 (n,): those given, or by a hash of each trace.

    A fold is a group of traces for cross-fitting. Given folds are cast to int64, so decimals are
    cut off. Raises SettingError unless there is a fold for each trace, and each is from 0 to
    n_folds - 1, and raises what NumPy raises for folds that are no numbers. A fold may have no
    trace.
    """
    if folds is None:
        return content_fold(traces, n_folds)
    given = np.asarray(folds, dtype=np.int64)
    expect(
        given.shape == (len(traces),) and set(range(n_folds)).issuperset(given),
        f"{len(traces)} folds from 0 to {n_folds - 1}",
        given,
    )
    return given


def check_classes(labels: Ints, masks: NDArray[np.bool_]) -> None:
    """Raise SettingError unless, for each fold, the labels (n,) outside it have both classes.

    A fold is one of K groups of traces for cross-fitting. Row k of `masks`, bool (K, n), tells
    which labels are outside fold k. The message asks for more labels, and names the first fold
    outside which a class is missing. If no label is outside this fold, it says instead that all
    traces are the same, which puts them into one fold, and asks to check the sensor and the unit of
    measurement.
    """
    for fold, outside in enumerate(masks):
        n_classes = len(np.unique(labels[outside]))
        problem = (
            f"{outside.sum()} traces of {n_classes} class; collect more labels before the first fit"
        )
        if n_classes == 0:
            problem = (
                "0 traces: all are in one fold, since they are the same to 1/65536 of their unit; "
                "check the sensor and the unit"
            )
        if n_classes < 2:
            raise SettingError(f"Expected both classes outside fold {fold}, got {problem}.")


def draw_seed(random_state: Any) -> int:
    """Return a seed for NumPy and torch from scikit-learn's `random_state`.

    An integer from 0 to 2**32 - 1 is the seed itself. A RandomState draws the seed, so it gives
    another seed at each call; None stands for NumPy's global generator. Raises SettingError for
    anything else.
    """
    with instead(
        SettingError, "Expected random_state None, an integer from 0 or a RandomState", ValueError
    ):
        drawn = check_random_state(random_state)
    is_seed = isinstance(random_state, int | np.integer)
    return int(random_state if is_seed else drawn.randint(2**31 - 1))


def check_integers(reducer: Any, **ranges: tuple[int, int]) -> None:
    """Raise SettingError unless each of these parameters is an integer in its range.

    Each parameter is an attribute of `reducer`. A range holds the smallest and the largest value,
    both allowed. True, False and floats are no integers.
    """
    for name, (least, most) in ranges.items():
        value = getattr(reducer, name)
        expect(is_whole(value, least, most), f"{name} from {least} to {most}, an integer", value)


def uses_labels(transformer: Any) -> bool:
    """Return whether a transformer's `fit` needs labels, by its tag `target_tags.required`.

    It may be fitted or not. Raises AttributeError for an object without scikit-learn's tags.
    """
    return bool(get_tags(transformer).target_tags.required)


def as_reducer(transformer: Any, folds: int) -> Reducer:
    """Return a scikit-learn transformer as a `Reducer`, which embeds traces.

    A `Reducer` that has several embedding spaces, or uses no labels, is returned as it is. Another
    transformer whose tag says that it needs labels (`uses_labels`) is wrapped in `CrossFitted`,
    which fits `folds` clones, each without the labels of one fold of the traces, and so has a space
    for each fold. A transformer without that tag is wrapped in `LabelFree` and never gets labels,
    so it has a single space. The wrapper holds the transformer itself and fits clones of it.
    Nothing is fitted here. Raises AttributeError for a transformer without scikit-learn's tags,
    which `BaseEstimator` has.
    """
    if isinstance(transformer, Reducer) and (
        transformer.n_spaces > 1 or not transformer.uses_labels
    ):
        return transformer
    return CrossFitted(transformer, folds) if uses_labels(transformer) else LabelFree(transformer)


@dataclass(eq=False, repr=False)
class _Wrapping(Reducer):
    """A reducer that wraps a transformer, its parameter `reducer`."""

    reducer: Any

    @property
    def own_unit(self) -> bool:  # type: ignore[override]  # elsewhere a constant of the class
        """Return `own_unit` of the wrapped `Reducer`; False for another transformer."""
        return bool(getattr(self.reducer, "own_unit", False))

    def as_input(self, X: Floats) -> Any:
        """Return traces (n, C, T) as the wrapped transformer takes them.

        A `Reducer` takes them as they are. Another transformer takes rows (n, C * T), in a copy
        that it may change.
        """
        return X if isinstance(self.reducer, Reducer) else as_rows(X).copy()


class LabelFree(_Wrapping):
    """Wraps a transformer that uses no labels: one space for all folds.

    Parameters
    ----------
    reducer : transformer
        It is not fitted itself; `fit` fits a clone of it, `reducer_`.
    """

    def fit(self, X: ArrayLike, y: ArrayLike | None = None) -> Self:
        """Fit a clone of the transformer, `reducer_`, on traces X; labels are ignored.

        X has the shape (n, T) or (n, C, T); a transformer that is no Reducer gets it as rows
        (n, C * T). Returns self. `trace_shape_` and `n_features_in_` are set, too. Raises what
        `check_traces` and the transformer raise.
        """
        self.reducer_ = clone(self.reducer).fit(self.as_input(self.check_traces(X, reset=True)))
        return self

    def transform(self, X: ArrayLike) -> Floats:
        """Embed traces (n, T) or (n, C, T) by `reducer_`, all in one call: float32 (n, d).

        Raises what `check_traces` and the transformer raise.
        """
        inputs = self.as_input(self.check_traces(X))
        return as_points(self.reducer_.transform(inputs))


@dataclass(eq=False, repr=False)
class CrossFitted(_Wrapping):
    """Wraps a transformer that uses labels: clone k is fitted on all traces outside fold k.

    Parameters
    ----------
    reducer : transformer
        It is not fitted itself; `fit` fits K clones of it, `clones_`.
    folds : int, default 2
        K, at least 2. The fold of a trace follows from a hash of its content; see `folds.py`.
    """

    uses_labels = True

    folds: int = 2

    @property
    def n_spaces(self) -> int:
        """Return K, the parameter `folds`; it is known before a fit."""
        return int(self.folds)

    def fit(self, X: ArrayLike, y: ArrayLike | None = None, *, folds: Ints | None = None) -> Self:
        """Fit clone k on the traces outside fold k, for every k, and replace `clones_`.

        A fold is one of K groups of traces. `trace_shape_` and `n_features_in_` are set, too. If a
        fit raises, `clones_` may already hold clones that are not fitted.

        Parameters
        ----------
        X : array of float, shape (n, T) or (n, C, T)
            Clones that are no `Reducer` get it as rows (n, C * T).
        y : array, shape (n,)
            Labels of two classes; the clones get 1 for the one that sorts last, else 0.
        folds : array of int64, shape (n,), optional
            Fold of each trace, 0 to K - 1. None: by a hash of its content.

        Returns
        -------
        self

        Raises
        ------
        SettingError
            If K is below 2, the labels are missing or not of two classes, folds do not fit the
            traces, or the traces outside a fold have a single class.
        TraceError, ValueError, TypeError
            If X has another shape, has no trace or is sparse, if a value is not finite, or if no
            absolute value reaches 1e-12 but not all samples are 0 (`check_traces`). Errors of the
            clones are raised as they are.
        """
        expect(self.folds >= 2, "folds >= 2 for a reducer that uses labels", self.folds)
        traces = self.check_traces(X, reset=True)
        labels = binary_labels(y, len(traces), type(self.reducer).__name__)
        folds = folds_of(traces, self.folds, folds)
        self.clones_ = [clone(self.reducer) for _ in range(self.folds)]
        masks = folds != np.arange(self.folds)[:, None]
        check_classes(labels, masks)
        # Clone k never sees the labels of fold k: they are counted in its space.
        for fitted, outside in zip(self.clones_, masks, strict=True):
            fitted.fit(self.as_input(traces[outside]), labels[outside])
        return self

    def train(self, X: Floats, y: Ints, folds: Ints, *_: object, **__: object) -> Floats:
        """Fit all clones anew, by the given folds, and return the points, float32 (n, d).

        Row i lies in space ``folds[i]``. `stop` and `numbers` have no effect. Raises what `fit`
        raises.
        """
        return self.fit(X, y, folds=folds).embed_references(X, folds)

    def embed(self, X: Floats) -> Floats:
        """Embed traces (n, T) or (n, C, T) by each clone: float32 (n, K, d), space k by clone k.

        Each clone gets all traces in one call. Raises what `check_traces` and the clones raise.
        """
        inputs = self.as_input(self.check_traces(X))
        return np.stack([as_points(fitted.transform(inputs)) for fitted in self.clones_], axis=1)
