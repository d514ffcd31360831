"""dengine: a data engine that lets a robot cell start on the slow check and earn its way off it.

Public names are imported when they are first used, so that `import dengine` costs next to nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ._lazy import lazy_names

__version__ = "0.7.0"

if TYPE_CHECKING:
    from .cells.base import Cell
    from .cells.replay import ReplayCell
    from .cells.simulation.cell import SimulatedCell
    from .datasets import Dataset, load_dataset
    from .decision.bounds import INTERVALS, binomial_interval, clopper_pearson_interval, jeffreys_interval, wilson_interval
    from .decision.classifier import WilsonRadiusClassifier
    from .decision.policy import Policy
    from .decision.rule import DecisionRule
    from .engine import DataEngine
    from .errors import DengineError, TraceError
    from .experiments.grid import run_grid
    from .experiments.replay import Replay, replay
    from .export.torchscript import export_torchscript, load_exported
    from .model.prediction import ModelPrediction
    from .recipe import Recipe
    from .records import Action, Cycle, Decision, Outcome, Reason, RetrainReport, Source, TraceSpec
    from .reducers import REDUCERS, make_reducer
    from .reducers.base import Reducer
    from .reducers.conv import ConvReducer
    from .reducers.cross_fitting import CrossFitted
    from .reducers.pca import PcaReducer
    from .reducers.rocket import RocketReducer
    from .reducers.umap import UmapReducer
    from .store.base import open_store
    from .store.memory import MemoryStore
    from .store.sql import SqlStore

_WHERE = {
    "cells.base": ("Cell",),
    "cells.replay": ("ReplayCell",),
    "cells.simulation.cell": ("SimulatedCell",),
    "datasets": (
        "Dataset",
        "load_dataset",
    ),
    "decision.bounds": (
        "INTERVALS",
        "binomial_interval",
        "clopper_pearson_interval",
        "jeffreys_interval",
        "wilson_interval",
    ),
    "decision.classifier": ("WilsonRadiusClassifier",),
    "decision.policy": ("Policy",),
    "decision.rule": ("DecisionRule",),
    "engine": ("DataEngine",),
    "errors": (
        "DengineError",
        "TraceError",
    ),
    "experiments.grid": ("run_grid",),
    "experiments.replay": (
        "Replay",
        "replay",
    ),
    "export.torchscript": (
        "export_torchscript",
        "load_exported",
    ),
    "model.prediction": ("ModelPrediction",),
    "recipe": ("Recipe",),
    "records": (
        "Action",
        "Cycle",
        "Decision",
        "Outcome",
        "Reason",
        "RetrainReport",
        "Source",
        "TraceSpec",
    ),
    "reducers": (
        "REDUCERS",
        "make_reducer",
    ),
    "reducers.base": ("Reducer",),
    "reducers.conv": ("ConvReducer",),
    "reducers.cross_fitting": ("CrossFitted",),
    "reducers.pca": ("PcaReducer",),
    "reducers.rocket": ("RocketReducer",),
    "reducers.umap": ("UmapReducer",),
    "store.base": ("open_store",),
    "store.memory": ("MemoryStore",),
    "store.sql": ("SqlStore",),
}

__all__ = [
    "INTERVALS",
    "REDUCERS",
    "Action",
    "Cell",
    "ConvReducer",
    "CrossFitted",
    "Cycle",
    "DataEngine",
    "Dataset",
    "Decision",
    "DecisionRule",
    "DengineError",
    "MemoryStore",
    "ModelPrediction",
    "Outcome",
    "PcaReducer",
    "Policy",
    "Reason",
    "Recipe",
    "Reducer",
    "Replay",
    "ReplayCell",
    "RetrainReport",
    "RocketReducer",
    "SimulatedCell",
    "Source",
    "SqlStore",
    "TraceError",
    "TraceSpec",
    "UmapReducer",
    "WilsonRadiusClassifier",
    "binomial_interval",
    "clopper_pearson_interval",
    "export_torchscript",
    "jeffreys_interval",
    "load_dataset",
    "load_exported",
    "make_reducer",
    "open_store",
    "replay",
    "run_grid",
    "wilson_interval",
]

__getattr__, __dir__ = lazy_names(__name__, _WHERE)
