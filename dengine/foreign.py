"""A rival method inside the same loop: anything with `fit, add, count, predict_interval, decide`."""

from __future__ import annotations

import copy
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .prediction import Judgement, Model
from .records import Action
from .reducers.base import FitReport, Floats, Ints, State, StopRule


class ForeignModel:
    """Gives a `Model` the face of `ModelPrediction` that the engine drives. It is retrained on a deep copy."""

    report = FitReport()

    def __init__(self, model: Model) -> None:
        self.model = model

    def fit(self, X: Floats, y: ArrayLike, *, hashes: Ints | None = None, stop: StopRule | None = None) -> Self:
        """Train the model; it sets its own stop."""
        self.model.fit(X, y)
        return self

    def judge(self, x: NDArray[np.float32]) -> Judgement:
        """The model's own decision on one trace (C, T), with its evidence."""
        X = x[None]
        (lower,), (upper,) = self.model.predict_interval(X)
        (n_success,), (n_failure,) = self.model.count(X)
        action = Action(self.model.decide(X)[0])
        return Judgement(action, float(lower), float(upper), int(n_success), int(n_failure), None)

    def place(self, x: NDArray[np.float32], hash_: int) -> Floats:
        """The trace itself: a foreign model keeps what it likes of it."""
        return x

    def hold(self, point: Floats, y: int, hash_: int) -> None:
        """Hand one labelled trace over."""
        self.model.add(point, y)

    def successor(self) -> ForeignModel:
        """A deep copy, to train while this one answers."""
        return ForeignModel(copy.deepcopy(self.model))

    def get_state(self) -> State:
        """Nothing: a foreign model is restored by a refit."""
        return {}
