"""What the engine drives: the contracts, our own prediction by reducer and radius neighbours, and a rival's adapter."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .._lazy import lazy_names

if TYPE_CHECKING:
    from .base import EngineModel, Model, Prediction
    from .prediction import ModelPrediction
    from .rival import RivalAdapter

_WHERE = {
    "base": (
        "EngineModel",
        "Model",
        "Prediction",
    ),
    "prediction": ("ModelPrediction",),
    "rival": ("RivalAdapter",),
}

__all__ = [
    "EngineModel",
    "Model",
    "ModelPrediction",
    "Prediction",
    "RivalAdapter",
]

__getattr__, __dir__ = lazy_names(__name__, _WHERE)
