"""Methods that dengine is compared with, in the same loop; each decides by its own rule: nearest
neighbours that agree, always verify, never verify. `replay` and `run_grid` make them by name, and
an engine takes one as `model`.

>>> DataEngine(model=make_baseline("knn", Policy(alpha=0.1, lower_bound=0.9), seed=0))

None of them has a bound. `BASELINES` has them by name; the settings of a baseline are the
keyword-only fields of its class. A method of your own is a subclass of `Baseline`.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..decision.policy import Policy
from ..errors import SettingError, expect
from ..imports import import_class
from ..records import Action, Floats, Ints, TraceArray, is_whole
from ..traces import as_traces

Labels = NDArray[np.bool_]


class BaselinePrediction(NamedTuple):
    """What a baseline says of n traces, as in `Decision`; the counts are 0 if it counts nothing.

    Attributes
    ----------
    lower, upper : array of float64, shape (n,)
        Interval of the success probability.
    n_success, n_failure : array of int64, shape (n,), or 0
        Labels behind it.
    """

    lower: Floats
    upper: Floats
    n_success: Ints | int = 0
    n_failure: Ints | int = 0


@dataclass(eq=False)
class Baseline(ABC):
    """A published method behind the five methods of `Model`.

    A subclass implements `_fit` and `_predict`, and `_add` if it learns between two trainings.
    Until a training succeeds, on enough labels of both classes, every part is verified.

    Parameters
    ----------
    policy : Policy
        Its alpha and lower_bound; the class says what it makes of them.
    seed : int, default 0
        Of everything drawn; the same seed and the same labels give the same decisions.

    Attributes
    ----------
    thresholds : (float, float) or None
        Lower bound from which on a part is accepted, and upper bound up to which it is rejected.
        None: LB and 1 - LB.
    is_trained : bool
    title : str
        For tables.
    """

    title: ClassVar[str]

    policy: Policy
    seed: int = 0
    thresholds: tuple[float, float] | None = field(default=None, init=False)
    is_trained: bool = field(default=False, init=False)
    # The engine asks three times about the same trace: its shape and bytes, and the prediction.
    _last: tuple[Any, BaselinePrediction] | None = field(default=None, init=False)

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Train from scratch and return self; the attribute `is_trained` says whether that worked.

        If the labels are of one class, or too few for the method, the baseline is untrained
        afterwards, and `decide` lets every part be checked (VERIFY).

        Parameters
        ----------
        X : array, shape (n, C, T)
            Traces; (n, T) for one channel.
        y : array, shape (n,)
            1 is success, any other value failure. It is not checked that there are n labels.

        Raises
        ------
        TraceError
            If X has neither shape, or has values that are no real numbers. NaN, infinities and
            traces of another length than before are taken.
        """
        traces = as_traces(X)
        good = np.asarray(y) == 1
        self._last = None
        self.is_trained = bool(good.any() and not good.all()) and self._fit(traces, good)
        return self

    def add(self, x: ArrayLike, y: Any) -> Self:
        """Learn one trace `x` (C, T) with its label `y`, 1 for success, and return self.

        Any other label is a failure. Nothing is learned or checked while `is_trained` is False;
        nothing is learned if the method learns only in `fit`. The prediction that `predict` cached
        is dropped. A trace (T,) has one channel. Raises TraceError for values that are no trace,
        and ValueError for channels of different lengths. It is not checked here that the trace is
        as long as those of the training.
        """
        self._last = None
        if self.is_trained:
            self._add(as_traces(np.asarray(x)[None]), bool(y == 1))
        return self

    def count(self, X: ArrayLike) -> tuple[Ints, Ints]:
        """Return (n_success, n_failure), each (n,): the labels behind each prediction.

        They are 0 if the method counts none. Raises TraceError like `predict`.
        """
        prediction = self.predict(X)
        zeros = np.zeros(len(prediction.lower), dtype=np.int64)
        return zeros + prediction.n_success, zeros + prediction.n_failure

    def predict_interval(self, X: ArrayLike) -> tuple[Floats, Floats]:
        """Return (lower, upper), each (n,), of the success probability.

        They are equal if the method has no interval, and 0 and 1 before a training has succeeded.
        Raises TraceError like `predict`.
        """
        prediction = self.predict(X)
        return prediction.lower, prediction.upper

    def decide(self, X: ArrayLike) -> NDArray[Any]:
        """Return an `Action` for each trace of X (n, C, T), as an array of objects, shape (n,).

        It is ACCEPT if the lower bound of the success probability is at least the accept threshold,
        REJECT if the upper bound is at most the reject threshold, and otherwise VERIFY (check the
        part). If both hold, it is ACCEPT. The attribute `thresholds` has both thresholds; if it is
        None, they are `policy.lower_bound` and 1 - `policy.lower_bound`. Raises TraceError like
        `predict`.
        """
        default = (self.policy.lower_bound, 1.0 - self.policy.lower_bound)
        accept_threshold, reject_threshold = self.thresholds or default
        lower, upper = self.predict_interval(X)
        actions = np.full(len(lower), Action.VERIFY, dtype=object)
        actions[upper <= reject_threshold] = Action.REJECT
        actions[lower >= accept_threshold] = Action.ACCEPT
        return actions

    def predict(self, X: ArrayLike) -> BaselinePrediction:
        """Return bounds of the success probability, and counts of labels, for traces X (n, C, T).

        The last result is cached: the same object is returned again for the same traces until the
        next `fit` or `add`, so do not change it. While `is_trained` is False, all lower bounds are
        0 and all upper bounds 1. The counts `n_success` and `n_failure` are the numbers of good and
        bad labelled traces behind each prediction. A baseline that counts none returns the integer
        0, and no array, for both; so does an untrained one. Traces (n, T) have one channel. Raises
        TraceError if X has neither shape, or has values that are no real numbers; NaN and
        infinities pass. It is not checked here that the traces are as long as those of the
        training.
        """
        traces = as_traces(X)
        key = traces.shape, traces.tobytes()
        if self._last is None or self._last[0] != key:
            prediction = (
                self._predict(traces)
                if self.is_trained
                else BaselinePrediction(np.zeros(len(traces)), np.ones(len(traces)))
            )
            self._last = (key, prediction)
        return self._last[1]

    @abstractmethod
    def _fit(self, X: TraceArray, good: Labels) -> bool:
        """Train from scratch on traces (n, C, T) and labels (n,) of both classes, True for success.

        Return whether the labels were enough; if not, every part is verified.
        """

    @abstractmethod
    def _predict(self, X: TraceArray) -> BaselinePrediction:
        """Return the prediction for traces (n, C, T); called only after a successful training."""

    def _add(self, X: TraceArray, good: bool) -> None:  # noqa: B027  # default: nothing
        """Learn one trace (1, C, T) between two trainings; the default does nothing."""


class Constant(Baseline):
    """The same prediction for every part, after the first retrain.

    Before it every part is verified. A subclass sets `lower`; the upper bound is 1.
    """

    lower: ClassVar[float]

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Learn nothing, count as trained from now on, and return self.

        X and y are not read, so labels of one class, or none, are enough.
        """
        self._last = None
        self.is_trained = True
        return self

    def _fit(self, X: TraceArray, good: Labels) -> bool:
        return True

    def _predict(self, X: TraceArray) -> BaselinePrediction:
        return BaselinePrediction(np.full(len(X), self.lower), np.ones(len(X)))


class AlwaysVerify(Constant):
    """Verify every part: the robot cell without dengine. No error, and nothing saved."""

    title = "always verify"
    lower = 0.0


class NeverVerify(Constant):
    """Accept every part: every check is saved, and every bad part stops the line."""

    title = "never verify"
    lower = 1.0


@dataclass
class LabelledPoints:
    """Points, float64 (m, d), with labels, bool (m,), to which more can be added."""

    points: Floats
    good: Labels

    def add(self, point: Floats, good: bool) -> None:
        """Append one point (1, d) with its label; both arrays are replaced by longer copies."""
        self.points = np.concatenate([self.points, point])
        self.good = np.append(self.good, good)

    def squared_distances(self, Z: Floats) -> Floats:
        """Return the squared Euclidean distances (n, m) from Z (n, d) to the m points."""
        from scipy.spatial.distance import cdist

        return np.asarray(cdist(Z, self.points, "sqeuclidean"))


@dataclass(eq=False, kw_only=True)
class AgreeingNeighbours(Baseline):
    """Accept if all k nearest labelled traces are successes, reject if all are failures.

    Distances are Euclidean between the raw traces, with all channels in one row. alpha and LB have
    no effect: k takes the place of a threshold. Every label counts from the next part on.
    `predict_interval` gives the share of successes twice.

    Parameters
    ----------
    k : int, default 5
        Chosen among 5, 10, 20 and 40, on other seeds than those reported, as are the defaults of
        the other methods, each among four.

    References
    ----------
    Duan et al. (2025), as the paper's section "Related Work" describes it.
    """

    title = "k-NN, all k agree"

    k: int = 5

    def __post_init__(self) -> None:
        expect(is_whole(self.k, 1, 2**31), "k to be an integer of at least 1", self.k)
        self.thresholds = (1.0, 0.0)

    def _fit(self, X: TraceArray, good: Labels) -> bool:
        """Keep all labelled traces (n, C, T); return whether there are at least `k`."""
        self._references = LabelledPoints(_rows(X), good)
        return len(good) >= self.k

    def _add(self, X: TraceArray, good: bool) -> None:
        self._references.add(_rows(X), good)

    def _predict(self, X: TraceArray) -> BaselinePrediction:
        """Return the share of successes among the k nearest labelled traces as both bounds.

        The bounds are those of the success probability, the counts the numbers of successes and
        failures among the k. Of traces at the same distance any may be taken. X has shape (n, C,
        T), and all four arrays (n,).
        """
        distances = self._references.squared_distances(_rows(X))
        nearest = np.argpartition(distances, self.k - 1, axis=1)[:, : self.k]
        n_success = self._references.good[nearest].sum(axis=1)
        share = n_success / self.k
        return BaselinePrediction(share, share, n_success, self.k - n_success)


def _rows(X: TraceArray) -> Floats:
    """Return traces (n, C, T) as rows (n, C * T) of float64."""
    return X.reshape(len(X), -1).astype(np.float64)


BASELINES: dict[str, type[Baseline]] = {
    "knn": AgreeingNeighbours,
    "always": AlwaysVerify,
    "never": NeverVerify,
}


def make_baseline(name: str, policy: Policy, seed: int = 0, **params: Any) -> Baseline:
    """Make an untrained baseline, a method to compare with, for `DataEngine(model=...)`.

    Parameters
    ----------
    name : str
        A name in `BASELINES` ("knn", "always", "never"), or `module:Class` of a subclass of
        `Baseline`, which is imported.
    policy : Policy
        Its alpha (error level) and lower_bound (least success probability of an accepted part) are
        the baseline's; the other fields belong to the engine.
    seed : int, default 0
        Of everything that is drawn at random.
    **params
        The baseline's own settings, the keyword-only fields of its dataclass; those left out have
        their defaults.

    Raises
    ------
    SettingError
        An unknown name or parameter, a value out of range, or a class that cannot be imported or is
        no `Baseline`. Other errors of a user's constructor pass unchanged.
    """
    kind = baseline_class(name)
    names = [item.name for item in fields(kind) if item.kw_only]
    if unknown := ", ".join(sorted(params.keys() - names)):
        raise SettingError(
            f"The baseline {name} has no parameter {unknown}; it has {', '.join(names) or 'none'}."
        )
    return kind(policy, seed, **params)


def baseline_class(name: str) -> type[Baseline]:
    """Return the class of a baseline by its name in `BASELINES`, or import it from `module:Class`.

    A baseline is a method to compare with; `BASELINES` has "knn", "always" and "never". A name with
    a colon is always imported, which runs the module's code. Raises SettingError for an unknown
    name, a class that cannot be imported, or a class that is no subclass of `Baseline`.
    """
    kind = import_class(name) if ":" in name else BASELINES.get(name, object)
    if not issubclass(kind, Baseline):
        raise SettingError(
            f"Expected a baseline among {', '.join(BASELINES)}, or module:Class of one, got {name}."
        )
    return kind
