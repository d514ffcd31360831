"""A rival method inside the same loop: anything with `fit, add, count, predict_interval, decide`."""

from __future__ import annotations

import copy
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ..errors import SettingError, shortened
from ..records import Action, Reason
from ..reducers.base import Floats
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
        self.model = self.user_model = model
        self.name, self.description = type(model).__name__, type(model).__qualname__  # its settings are its author's affair

    def train(self, X: NDArray[np.float32], y: NDArray[Any], *_: object, **__: object) -> Self:
        self.model.fit(X, y)
        return self

    def predict_one(self, x: NDArray[np.float32], hash_: int = 0) -> Prediction:
        """The rival's own decision on one trace (C, T), with its evidence; it knows nothing of parts."""
        X = x[None]
        (lower,), (upper,) = self.model.predict_interval(X)
        (n_success,), (n_failure,) = self.model.count(X)
        action = Action(self.model.decide(X)[0])
        reason = Reason.UNCERTAIN if action is Action.VERIFY else Reason.CERTAIN
        counts = int(n_success), int(n_failure)
        if counts != (n_success, n_failure):
            raise ValueError(f"Expected whole numbers of labels, got {shortened((n_success, n_failure))}.")
        return Prediction(action, float(lower), float(upper), *counts, None, reason)

    def reference_point(self, x: NDArray[np.float32], hash_: int, embedding: Embedding | None = None) -> Floats:
        return x

    def add_reference(self, point: Floats, y: int, hash_: int, number: int = 0) -> None:
        self.model.add(point, y)

    def successor(self) -> RivalAdapter:
        return RivalAdapter(copy.deepcopy(self.model))
