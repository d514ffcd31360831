"""What rivals share: the policy's numbers, one look a trace, caution where nothing was learned, and features."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...decision.policy import Policy
from ...errors import SettingError
from ...records import ACTIONS, Action, is_number, is_whole
from ...traces import as_traces

Floats = NDArray[np.float64]
Counts = NDArray[np.int64]
Labels = NDArray[np.bool_]
Traces = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Judgement:
    """What a rival says of n traces; (n,) each. action : of `Action`.  The rest : the evidence, as in `Decision`."""

    action: NDArray[Any]
    lower: Floats
    upper: Floats
    n_success: Counts
    n_failure: Counts

    @classmethod
    def without_counts(cls, action: NDArray[Any], lower: Floats, upper: Floats) -> Judgement:
        """Of a method that counts nothing."""
        return cls(action, lower, upper, *np.zeros((2, len(lower)), dtype=np.int64))


class Rival(ABC):
    """A method of somebody else's behind the five methods of `Model`.

    alpha, lower_bound : as in `Policy`; numbers of the rival here, and it says what it makes of them.
    seed : of all that it draws; the same seed and the same labels give the same decisions.

    A subclass gives `_learn` and `_judge`, and `_take` where it learns between two trainings. Where a training cannot be
    done, on labels of one class or on too few, every part is verified until the next one.

    title : for a table.  needs : the library beyond what dengine needs.
    bound : what bound its decisions keep; "" where it has none, and its threshold is swept.
    tries : four sets of parameters, as many as ours, to choose among on other seeds than those reported.  chosen : which.
    """

    title: ClassVar[str]
    bound: ClassVar[str] = ""
    needs: ClassVar[str] = ""
    tries: ClassVar[tuple[Mapping[str, Any], ...]] = ({},) * 4
    chosen: ClassVar[int] = 0

    def __init__(self, alpha: float, lower_bound: float, seed: int = 0) -> None:
        self.policy = Policy(alpha, lower_bound)
        self.seed = seed
        self.ready = False
        self._last: tuple[bytes, Judgement] | None = None  # the engine asks three things in turn about one trace

    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Train anew on labelled traces X (n, C, T), y (n,) of 1 = success and 0 = failure."""
        traces, good = as_traces(X), np.asarray(y) == 1
        self._last = None
        self.ready = bool(good.any() and not good.all()) and self._learn(traces, good)
        return self

    def add(self, x: ArrayLike, y: Any) -> Self:
        """Take in one labelled trace (C, T), where the method learns between two trainings and has been trained."""
        self._last = None
        if self.ready:
            self._take(as_traces(np.asarray(x)[None]), bool(y == 1))
        return self

    def count(self, X: ArrayLike) -> tuple[Counts, Counts]:
        """(n_success, n_failure), each (n,), behind each prediction; zeros of a method that counts nothing."""
        found = self.judge(X)
        return found.n_success, found.n_failure

    def predict_interval(self, X: ArrayLike) -> tuple[Floats, Floats]:
        """(lower, upper), each (n,), of the success probability; the same number twice where there is only a point."""
        found = self.judge(X)
        return found.lower, found.upper

    def decide(self, X: ArrayLike) -> NDArray[Any]:
        """(n,) an `Action` for each trace of X (n, C, T)."""
        return self.judge(X).action

    def judge(self, X: ArrayLike) -> Judgement:
        """All that it says of the traces X (n, C, T), computed once for the same traces."""
        traces = as_traces(X)
        key = traces.tobytes()
        if self._last is None or self._last[0] != key:
            self._last = key, self._judge(traces) if self.ready else same_action(len(traces), Action.VERIFY)
        return self._last[1]

    @abstractmethod
    def _learn(self, X: Traces, good: Labels) -> bool:
        """Train on traces (n, C, T) and labels (n,) of both classes; False where they are too few."""

    @abstractmethod
    def _judge(self, X: Traces) -> Judgement:
        """What is said of traces (n, C, T), after a training."""

    def _take(self, X: Traces, good: bool) -> None:  # noqa: B027  # a default: the next training learns it
        """Learn one trace (1, C, T)."""


class ThresholdRival(Rival):
    """A rival that accepts from one success probability on, and rejects up to another; without them it decides nothing."""

    def __init__(self, alpha: float, lower_bound: float, seed: int = 0) -> None:
        super().__init__(alpha, lower_bound, seed)
        self.accept_at, self.reject_at = np.inf, -np.inf

    @abstractmethod
    def _probability(self, X: Traces) -> Floats:
        """(n,) success probabilities, as the method believes, of traces (n, C, T), after a training."""

    def _judge(self, X: Traces) -> Judgement:
        p = self._probability(X)
        return Judgement.without_counts(actions_of(p >= self.accept_at, p <= self.reject_at), p, p)


def actions_of(accept: Labels, reject: Labels) -> NDArray[Any]:
    """(n,) of `Action`: from what to accept and what to reject, each (n,); VERIFY for the rest."""
    position = np.where(accept, ACTIONS.index(Action.ACCEPT), np.where(reject, ACTIONS.index(Action.REJECT), 0))
    return np.array([ACTIONS[i] for i in position], dtype=object)


def same_action(n: int, action: Action) -> Judgement:
    """One action for n traces, without any evidence."""
    return Judgement.without_counts(np.array([action] * n, dtype=object), np.zeros(n), np.ones(n))


def positive(name: str, value: Any, *, below: float = np.inf) -> Any:
    """The value, where it is a number above 0 and below a limit; SettingError else."""
    if not (is_number(value) and 0 < value < below):
        limit = "" if below == np.inf else f" and below {below:g}"
        raise SettingError(f"Expected {name} to be a number above 0{limit}, got {value!r}.")
    return value


def whole(name: str, value: Any, least: int = 1) -> int:
    """The value, where it is an integer of at least `least`; SettingError else."""
    if not is_whole(value, least, 2**31):
        raise SettingError(f"Expected {name} to be an integer of at least {least}, got {value!r}.")
    return int(value)


class Components:
    """The first principal components of traces, scaled.

    whiten : each to unit variance; otherwise all by the first one's deviation, so that they keep their proportions.
    """

    def __init__(self, n_components: int, *, whiten: bool, seed: int) -> None:
        from ...reducers.pca import PcaReducer

        self.n_components, self.whiten = n_components, whiten
        self._pca = PcaReducer(n_components=n_components, random_state=seed)

    def fit(self, X: Traces) -> Floats | None:
        """Find the components of traces (n, C, T); returns these traces as (n, d), None where they are too few."""
        if len(X) <= self.n_components or X[0].size < self.n_components:
            return None
        placed = np.asarray(self._pca.fit(X).transform(X), dtype=np.float64)
        deviation = placed.std(axis=0)
        scale = deviation if self.whiten else np.full_like(deviation, deviation[0])
        self._scale = np.where(scale > 0.0, scale, 1.0)
        return np.asarray(placed / self._scale)

    def transform(self, X: Traces) -> Floats:
        """(n, C, T) -> (n, d)."""
        return np.asarray(self._pca.transform(X) / self._scale, dtype=np.float64)


def segment_means(X: Traces, segments: int) -> Floats:
    """(n, C, T) -> (n, C * segments): means of stretches of about equal length, at most T of them."""
    n, channels, samples = X.shape
    starts = np.unique(np.linspace(0, samples, min(segments, samples), endpoint=False).astype(int))
    sums = np.add.reduceat(X.astype(np.float64), starts, axis=2)
    return np.asarray((sums / np.diff(np.append(starts, samples))).reshape(n, channels * len(starts)))


@dataclass
class References:
    """Labelled points (n, d), to which more can be added."""

    points: Floats
    good: Labels

    def add(self, point: Floats, good: bool) -> None:
        """One more point (1, d)."""
        self.points, self.good = np.concatenate([self.points, point]), np.append(self.good, good)


def squared_distances(Z: Floats, points: Floats) -> Floats:
    """(n, d) and (m, d) -> (n, m)."""
    from scipy.spatial.distance import cdist

    return np.asarray(cdist(Z, points, "sqeuclidean"))
