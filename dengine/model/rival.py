"""A rival method inside the same loop: anything with `fit, add, count, predict_interval, decide`."""

from __future__ import annotations

import copy
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import SettingError, shortened
from ..records import Action, Reason
from ..reducers.base import Floats, Ints, StopRule
from .base import Embedding, EngineModel, Model, Prediction


def as_engine_model(model: Model) -> EngineModel:
    """A model as the engine drives it: our own as it is, a rival adapted. SettingError for what is no model."""
    if isinstance(model, EngineModel):
        return model
    if isinstance(model, type) or not isinstance(model, Model):
        raise SettingError(f"Expected a model with fit, add, count, predict_interval and decide, got {model!r}.")
    return RivalAdapter(model)


class RivalAdapter(EngineModel):
    """Makes an `EngineModel` of a rival. It decides by its own rule, and it is trained on a deep copy."""

    keeps_references = False

    def __init__(self, model: Model) -> None:
        self.model = model

    @property
    def user_model(self) -> Any:
        """The rival itself."""
        return self.model

    @property
    def name(self) -> str:
        """Its class."""
        return type(self.model).__name__

    @property
    def description(self) -> str:
        """Its class: its settings are its author's affair."""
        return type(self.model).__qualname__

    def train(
        self,
        X: ArrayLike,
        y: ArrayLike,
        *,
        hashes: Ints | None = None,
        stop: StopRule | None = None,
        numbers: Ints | None = None,
    ) -> Self:
        """Train the rival; it sets its own stop."""
        self.model.fit(X, y)
        return self

    def predict_one(self, x: NDArray[np.float32], hash_: int = 0) -> Prediction:
        """The rival's own decision on one trace (C, T), with its evidence; it knows nothing of parts."""
        X = x[None]
        (lower,), (upper,) = self.model.predict_interval(X)
        (n_success,), (n_failure,) = self.model.count(X)
        action = Action(self.model.decide(X)[0])
        reason = Reason.UNCERTAIN if action is Action.VERIFY else Reason.CERTAIN
        counts = _whole(n_success), _whole(n_failure)
        return Prediction(action, float(lower), float(upper), *counts, None, reason)

    def reference_point(self, x: NDArray[np.float32], hash_: int, embedding: Embedding | None = None) -> Floats:
        """The trace itself: a rival keeps what it likes of it."""
        return x

    def add_reference(self, point: Floats, y: int, hash_: int, number: int = 0) -> None:
        """Hand one labelled trace over."""
        self.model.add(point, y)

    def successor(self) -> RivalAdapter:
        """A deep copy, to train while this one answers."""
        return RivalAdapter(copy.deepcopy(self.model))


def _whole(count: Any) -> int:
    """A rival's count as an integer; ValueError for one that is not whole."""
    whole = int(count)
    if whole != count:
        raise ValueError(f"Expected a whole number of labels, got {shortened(count)}.")
    return whole
