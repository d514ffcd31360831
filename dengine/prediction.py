"""The model prediction: reducer, references and bound together, with honest counting.

A label may be counted for a query only in an embedding that never saw that label. So the reducer spans K spaces, fold k's
references live in space k, a query is embedded in all K, and its counts are summed.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from .classifier import WilsonRadiusClassifier
from .core import Answering, Core, EmbeddedCore, build_core
from .folds import content_hash, fold_of
from .neighbors import Counts, RadiusIndex
from .records import Action
from .reducers import make_reducer
from .reducers.base import FitReport, Floats, Ints, Spaces, State, StopRule, in_spaces
from .traces import as_traces

ACTIONS = tuple(Action)
WARM_UP = 3  # TorchScript's first calls compile; a cell should not wait for that


@dataclass(frozen=True, slots=True)
class Judgement:
    """What a model says of one trace; fields as in `Decision`."""

    action: Action
    lower: float
    upper: float
    n_success: int
    n_failure: int
    embedding: tuple[tuple[float, ...], ...] | None


@runtime_checkable
class Model(Protocol):
    """All that the engine needs of a model. X is (n, C, T) float32, y (n,) of 1 = success and 0 = failure."""

    def fit(self, X: Any, y: Any) -> Any:
        """Train anew on labelled traces."""
        ...

    def add(self, x: Any, y: Any) -> Any:
        """Take in one labelled trace (C, T) between two trainings."""
        ...

    def count(self, X: Any) -> tuple[Any, Any]:
        """(n_success, n_failure) behind each judgement."""
        ...

    def predict_interval(self, X: Any) -> tuple[Any, Any]:
        """(lower, upper) of each success probability."""
        ...

    def decide(self, X: Any) -> Any:
        """An `Action` for each trace."""
        ...


class ModelPrediction:
    """Reducer + references + bound, from traces.

    reducer : a name in `REDUCERS`, or any scikit-learn transformer.
    classifier : a `WilsonRadiusClassifier` holding radius and policy; it is cloned, never fitted itself.
    folds : K, for a label-using transformer that does not cross-fit by itself.

    Embeddings are scaled space by space to a root mean square radius of 1, so that one `radius` means the same in every
    reducer; the scale of space k comes from fold k's traces, whose labels that space never saw. One whose axis has a
    unit of its own (`natural_scale`) is left as it is: where probabilities hardly differ, they are not to be spread.
    """

    def __init__(self, reducer: Any = "conv", classifier: WilsonRadiusClassifier | None = None, folds: int = 2) -> None:
        self.reducer = make_reducer(reducer) if isinstance(reducer, str) else reducer
        self.classifier = classifier or WilsonRadiusClassifier()
        self.folds = folds
        self.spaces: Spaces = in_spaces(copy.deepcopy(self.reducer), folds)
        self._answering: Answering | None = None

    @property
    def n_spaces(self) -> int:
        """K, embedding spaces."""
        return self.spaces.n_spaces

    @property
    def report(self) -> FitReport:
        """What the last fit says of itself."""
        return self.spaces.report

    def fit(self, X: ArrayLike, y: ArrayLike, *, hashes: Ints | None = None, stop: StopRule | None = None) -> Self:
        """Train the reducer, warm where it can be, and make every trace a reference.

        X : (n, T) or (n, C, T); y : (n,) 1 = success, 0 = failure; hashes : (n,) content hashes where they are known.
        Raises SettingError where the reducer cannot be trained on this (one class only, too few traces).
        """
        X, y = as_traces(X), np.asarray(y, dtype=np.int64)
        hashes = content_hash(X) if hashes is None else hashes
        folds = fold_of(hashes, self.n_spaces)
        self.trace_shape = X.shape[1:]
        self.spaces.fit(X, y, folds, stop)
        points = self.spaces.embed_fitted(X, folds)
        own_unit = self.spaces.natural_scale
        self.scale = np.ones(self.n_spaces, np.float32) if own_unit else _scale(points, folds, self.n_spaces)
        self.index = RadiusIndex(points.shape[1], self.classifier.capacity)
        self.index.add(points / self.scale[folds, None], y, folds)
        self._answering = None  # built by `ready`, or when it is asked
        return self

    def ready(self, like: ModelPrediction | None = None) -> Self:
        """Build the module that answers, the one that an export saves; from an earlier model's, where they are alike."""
        mould = None if like is None else like._answering
        judge = self.classifier.new_judge(self.index)
        self._answering = build_core(self.spaces, self.scale, judge, mould)
        if self._answering.structure is not None and (mould is None or mould.structure != self._answering.structure):
            for _ in range(WARM_UP):
                self.judge(np.zeros(self.trace_shape, dtype=np.float32))
        return self

    def add(self, x: ArrayLike, y: ArrayLike) -> Self:
        """Take in one labelled trace, (T,) or (C, T), as a reference."""
        X = as_traces(np.asarray(x)[None])
        hash_ = int(content_hash(X)[0])
        self.hold(self.place(X[0], hash_), int(np.asarray(y)), hash_)
        return self

    def place(self, x: NDArray[np.float32], hash_: int) -> Floats:
        """(C, T) -> (d,): where the trace would live as a reference, in its own fold's space."""
        with torch.inference_mode():
            return np.asarray(self.core.embed(torch.from_numpy(x))[self._fold(hash_)].numpy())

    def hold(self, point: Floats, y: int, hash_: int) -> None:
        """Make a placed trace a reference; the oldest one leaves where the block is full."""
        self.index.add(point[None], np.array([y]), np.array([self._fold(hash_)]))

    def _fold(self, hash_: int) -> int:
        return int(fold_of(np.array([hash_], dtype=np.int64), self.n_spaces)[0])

    @property
    def core(self) -> Core | EmbeddedCore:
        """The module that answers, built where it is not yet; ValueError where nothing was fitted."""
        if not hasattr(self, "index"):
            raise ValueError("Expected a fitted model; call fit(X, y) first.")
        answering = self._answering or self.ready()._answering
        assert answering is not None  # ready made it; for the type checker
        return answering.core

    def judge(self, x: NDArray[np.float32]) -> Judgement:
        """The whole judgement on one trace (C, T)."""
        with torch.inference_mode():
            action, lower, upper, n_success, n_failure, z = self.core(torch.from_numpy(x))
        embedding = tuple(tuple(row) for row in z.tolist())
        return Judgement(ACTIONS[action], lower, upper, n_success, n_failure, embedding)

    def judge_many(self, X: ArrayLike) -> list[Judgement]:
        """The judgement on each trace of (n, T) or (n, C, T)."""
        return [self.judge(x) for x in as_traces(X)]

    def count(self, X: ArrayLike) -> Counts:
        """(n_success, n_failure), each (n,): labels in the balls around each trace, summed over the K spaces."""
        judged = self.judge_many(X)
        return np.array([j.n_success for j in judged], dtype=np.int64), np.array([j.n_failure for j in judged], np.int64)

    def predict_interval(self, X: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(lower, upper), each (n,): the bound on each trace's success probability."""
        judged = self.judge_many(X)
        return np.array([j.lower for j in judged]), np.array([j.upper for j in judged])

    def decide(self, X: ArrayLike) -> NDArray[Any]:
        """(n,) array of `Action`."""
        return np.array([j.action for j in self.judge_many(X)], dtype=object)

    def successor(self) -> ModelPrediction:
        """A model to train next, warm from this one; nothing mutable is shared, so this one goes on answering."""
        new = ModelPrediction(self.reducer, self.classifier, self.folds)
        new.spaces = copy.deepcopy(self.spaces)
        return new

    def get_state(self) -> State:
        """Plain arrays: references always, the reducer's own where it has any (then key "reducer" names are present)."""
        ring = self.index.ring
        n = ring.size()
        state = {
            "trace_shape": np.array(self.trace_shape),
            "scale": self.scale,
            "points": ring.points[:, :n].numpy().copy(),
            "labels": ring.labels[1, :n].numpy().astype(np.int8),
            "spaces": ring.spaces[:n].numpy().copy(),
            "total": ring.total.numpy().copy(),
        }
        own = self.spaces.get_state()
        return state if own is None else state | {f"reducer.{name}": value for name, value in own.items()}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        """Restore references, and the reducer unless it was refitted, so that decisions repeat bit for bit."""
        own = {name.removeprefix("reducer."): v for name, v in state.items() if name.startswith("reducer.")}
        if own:
            self.spaces.set_state(own)
        self.trace_shape = tuple(int(n) for n in state["trace_shape"])
        self.scale = np.asarray(state["scale"])
        self.index = RadiusIndex(len(state["points"]), self.classifier.capacity)
        ring, n = self.index.ring, state["points"].shape[1]
        ring.points[:, :n] = torch.from_numpy(np.array(state["points"]))
        ring.labels[1, :n] = torch.from_numpy(np.array(state["labels"], dtype=np.float32))
        ring.spaces[:n] = torch.from_numpy(np.array(state["spaces"]))
        ring.total.fill_(int(state["total"]))
        self._answering = None
        return self

    def __getstate__(self) -> dict[str, Any]:
        # A scripted module does not travel between processes; the receiver builds its own.
        return self.__dict__ | {"_answering": None}


def _scale(points: Floats, folds: Ints, n_spaces: int) -> Floats:
    """(K,) root mean square radius of each fold's points in its own space; 1 where a fold is empty or has no spread."""
    scale = np.ones(n_spaces, dtype=np.float32)
    for k in range(n_spaces):
        own = points[folds == k]
        rms = float(np.sqrt(((own - own.mean(axis=0)) ** 2).sum(axis=1).mean())) if len(own) else 0.0
        scale[k] = rms if np.isfinite(rms) and rms > 1e-12 else 1.0
    return scale
