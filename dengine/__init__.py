"""dengine: a data engine that lets a robot cell start on the slow check and earn its way off it.

Public names are imported when they are first used, so that `import dengine` costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from .bounds import (
        INTERVALS,
        binomial_interval,
        clopper_pearson_interval,
        jeffreys_interval,
        wilson_interval,
    )
    from .cells.base import Cell
    from .cells.replay import ReplayCell
    from .cells.simulated import SimulatedCell
    from .classifier import WilsonRadiusClassifier
    from .datasets import Dataset, load_dataset
    from .engine import DataEngine
    from .errors import DengineError, TraceError
    from .experiments.grid import run_grid
    from .experiments.replay import Replay, replay
    from .export import export_torchscript
    from .exported import load_exported
    from .policy import Policy
    from .prediction import ModelPrediction
    from .recipe import Recipe
    from .records import Action, Cycle, Decision, Outcome, Reason, RetrainReport, Source, TraceSpec
    from .reducers import REDUCERS, make_reducer
    from .reducers.base import CrossFitted

_WHERE = {
    "bounds": (
        "INTERVALS",
        "binomial_interval",
        "clopper_pearson_interval",
        "jeffreys_interval",
        "wilson_interval",
    ),
    "cells.base": ("Cell",),
    "cells.replay": ("ReplayCell",),
    "cells.simulated": ("SimulatedCell",),
    "classifier": ("WilsonRadiusClassifier",),
    "datasets": ("Dataset", "load_dataset"),
    "engine": ("DataEngine",),
    "errors": ("DengineError", "TraceError"),
    "export": ("export_torchscript",),
    "exported": ("load_exported",),
    "experiments.grid": ("run_grid",),
    "experiments.replay": ("Replay", "replay"),
    "policy": ("Policy",),
    "prediction": ("ModelPrediction",),
    "recipe": ("Recipe",),
    "records": ("Action", "Cycle", "Decision", "Outcome", "Reason", "RetrainReport", "Source", "TraceSpec"),
    "reducers": ("REDUCERS", "make_reducer"),
    "reducers.base": ("CrossFitted",),
}
_MODULE_OF = {name: module for module, names in _WHERE.items() for name in names}

__all__ = [
    "INTERVALS",
    "REDUCERS",
    "Action",
    "Cell",
    "CrossFitted",
    "Cycle",
    "DataEngine",
    "Dataset",
    "Decision",
    "DengineError",
    "ModelPrediction",
    "Outcome",
    "Policy",
    "Reason",
    "Recipe",
    "Replay",
    "ReplayCell",
    "RetrainReport",
    "SimulatedCell",
    "Source",
    "TraceError",
    "TraceSpec",
    "WilsonRadiusClassifier",
    "binomial_interval",
    "clopper_pearson_interval",
    "export_torchscript",
    "jeffreys_interval",
    "load_dataset",
    "load_exported",
    "make_reducer",
    "replay",
    "run_grid",
    "wilson_interval",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'dengine' has no attribute {name!r}")
    value = getattr(import_module(f".{_MODULE_OF[name]}", __name__), name)
    globals()[name] = value  # found once, plain from then on
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
