"""`ProbabilityReducer`, the base class of `TorchReducer` and `RocketReducer`. The first coordinate
of their embedding is the probability of success by a model. Each of K spaces has a copy of this
model, and copy k is trained without the labels of fold k.
"""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, Self

from numpy.typing import ArrayLike
from sklearn.base import clone
from torch import nn

from ..errors import expect
from .base import Floats, Ints, Reducer, binary_labels, folds_of

MIN_TRACES = 20  # of the first training


@dataclass(eq=False, repr=False, kw_only=True)
class ProbabilityReducer(Reducer):
    """Embed traces by a cross-fitted probability of success.

    Parameters
    ----------
    n_components : {1, 2}, default 2
        1 leaves the second axis out.
    folds : int, default 5
        K, the number of folds, and so of spaces.
    random_state : int, RandomState or None, default 0
        Seed of what is drawn.

    Attributes
    ----------
    is_initialized_ : bool
        Whether the model is built for the shape of the traces, and has scales, and kernels or
        weights, so that it embeds. No label is needed for that.
    """

    uses_labels = True
    scores = True
    own_unit = True
    min_traces = MIN_TRACES
    default_radius = 0.07  # of a probability: seven in a hundred, never rescaled
    is_initialized_ = False

    n_components: int = 2
    folds: int = 5
    random_state: Any = 0

    @property
    def n_spaces(self) -> int:
        """Return K, the parameter `folds`; it is known before a fit."""
        return int(self.folds)

    def fit(self, X: ArrayLike, y: ArrayLike | None = None, *, folds: Ints | None = None) -> Self:
        """Build the model anew and train it; earlier trainings are discarded.

        The model predicts the probability of success. It has K copies, one for each fold (one of K
        fixed groups of traces, where K is the parameter `folds` of the constructor), and copy k is
        trained without the labels of fold k. If `fit` raises an error, earlier trainings may be
        lost already, for example if the labels of a `RocketReducer` are of one class. Unlike
        `train` it takes fewer than 20 traces, too.

        Parameters
        ----------
        X : array of float, shape (n, T) or (n, C, T)
        y : array, shape (n,)
            Labels of two classes; the class that sorts last is success. The subclass `TorchReducer`
            trains on a single class, too.
        folds : array of int64, shape (n,), optional
            Fold of each trace, 0 to K - 1. None: a hash of the trace's content chooses it.

        Returns
        -------
        self

        Raises
        ------
        SettingError
            If a parameter is out of its range, y is None or has more than two classes, there is not
            one label and one fold for each trace, a fold is not from 0 to K - 1, or a trace has a
            single sample. `TorchReducer` also: if its network does not give (B, features), its
            checkpoint (stored weights to start from) cannot be used, or fewer than two traces lie
            outside a fold. `RocketReducer` also: if the traces outside a fold have a single class.
        TraceError, ValueError, TypeError
            If X is not of one of these shapes or sparse, a value is not finite, or all samples are
            below 1e-12 but not all are 0 (`check_traces`).
        """
        traces = self.check_traces(X, reset=True)
        labels = binary_labels(y, len(traces), type(self).__name__)
        folds = folds_of(traces, self.folds, folds)
        self._initialize(traces)
        self._fit(traces, labels, folds)
        return self

    def untrained_module(self, X: Floats) -> nn.Module | None:
        """Return a module that can be compiled before the training on traces X (n, C, T).

        It embeds traces like the module after the training; only the weights differ, which can be
        loaded later. If the reducer is initialised (its model is built for a shape of traces), it
        is what `module` returns, and X is not looked at. Otherwise a clone is initialised for X,
        and its module is returned; this reducer stays as it is, and the errors of `check_traces`
        and `_initialize` are raised. None if TorchScript cannot compile the module, which is logged
        once.
        """
        if self.is_initialized_:
            return self.module()
        untrained: Self = clone(self)
        untrained._initialize(untrained.check_traces(X, reset=True))
        return untrained.module()

    def _check_and_initialize(self, X: Floats) -> Floats:
        """Check traces, initialise the model if need be, and return the traces as (n, C, T).

        The model is initialised if it was not built yet; these traces then set the shape that later
        traces must have, and the scales of the channels. No label is read. In this case
        SettingError is raised for fewer than 20 traces, and what `_initialize` raises, such as
        SettingError for a parameter out of its range. The errors of `check_traces` are raised in
        both cases.
        """
        if not self.is_initialized_:
            expect(
                len(X) >= MIN_TRACES,
                f"at least {MIN_TRACES} traces",
                len(X),
                "verify more parts first",
            )
            self._initialize(self.check_traces(X, reset=True))
        return self.check_traces(X)

    @abstractmethod
    def _initialize(self, traces: Floats) -> None:
        """Build the model for traces (n, C, T), and set `is_initialized_`; no label is read.

        Earlier trainings are discarded. Raises SettingError for a parameter out of its range, or
        fewer than 2 samples.
        """

    @abstractmethod
    def _fit(self, traces: Floats, labels: Ints, folds: Ints) -> None:
        """Train the model that was just built, on traces (n, C, T), labels (n,) and folds (n,)."""
