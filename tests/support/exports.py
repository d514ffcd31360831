"""Engines and models to be exported, and traces of every kind for what was exported of them."""

import zlib
from dataclasses import fields
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dengine import (
    DataEngine,
    Dataset,
    ForceLimits,
    ModelPrediction,
    Policy,
    Recipe,
    TraceSpec,
    WilsonRadiusClassifier,
)
from tests.support.driving import learn

# Looked for, not imported: that would take every worker seconds.
NEEDED = ("onnx", "onnxruntime", "onnxscript")
NEEDS_ONNX = pytest.mark.skipif(not all(map(find_spec, NEEDED)), reason=f"needs {NEEDED}")
SAMPLES, LIMIT = 100, 500.0
FORCE_LIMITS = (
    ForceLimits(0.02, 0.06, high=5.0),
    ForceLimits(0.1, 0.15, low=-20.0, high=22.5, reject=True),
)
OF_POLICY = {field.name for field in fields(Policy)}


def recipe(**settings: Any) -> Recipe:
    """pca at (0.1, 90 %), which retrains when it is told to; settings of the policy too."""
    policy = {"alpha": 0.1, "lower_bound": 0.9} | {
        name: settings.pop(name) for name in OF_POLICY & settings.keys()
    }
    return Recipe(
        **{"reducer": "pca", "policy": Policy(**policy), "retrain_every": 10**6, "window": 2000}
        | settings
    )


def trained(
    data: Dataset, store: Path | None = None, trace: TraceSpec | None = None, **settings: Any
) -> DataEngine:
    """An engine that saw every label and retrained on all of them."""
    spec = trace or TraceSpec(data.X.shape[-1], rate_hz=500.0, limit=LIMIT)
    engine = DataEngine(recipe=recipe(**settings), store=store, trace=spec, seed=3, replaying=True)
    learn(engine, data, range(len(data)))
    engine.retrain()
    return engine


def fitted(data: Dataset, reducer: Any = "pca", **settings: Any) -> ModelPrediction:
    """A model of all labels, as a script makes it."""
    classifier = WilsonRadiusClassifier(**{"alpha": 0.1, "lower_bound": 0.9} | settings)
    return ModelPrediction(reducer, classifier).fit(data.X, data.y)


def cell_journal(*lines: str | bytes, head: str = "# dengine 4 0123") -> bytes:
    """A cell program's journal of these lines, each with the checksum over all so far."""
    crc, text = zlib.crc32(head.encode()), head.encode() + b"\n"
    for line in (item.encode() if isinstance(item, str) else item for item in lines):
        crc = zlib.crc32(line, crc)
        text += b"%s,%08x\n" % (line, crc)
    return text


def bad_traces(x: np.ndarray) -> list[np.ndarray]:
    """Not finite, dead and saturated, each in more than one way."""
    nan, inf, both, beyond = x.copy(), x.copy(), x.copy(), x.copy()
    nan[3], inf[5], both[7], both[8], beyond[0] = np.nan, -np.inf, np.inf, np.nan, 1e30
    return [nan, inf, both, beyond, np.full_like(x, 2.5), np.zeros_like(x), np.full_like(x, np.nan)]


def wild_traces(traces: np.ndarray) -> np.ndarray:
    """(n + 207, T): known ones, random ones of every size, and bad ones."""
    rng = np.random.default_rng(5)
    wild = rng.normal(size=(200, traces.shape[1])) * 10.0 ** rng.uniform(-3, 6, (200, 1))
    return np.concatenate([traces, wild, np.array(bad_traces(traces[0]))]).astype(np.float32)


def row(decision: Any) -> tuple[Any, ...]:
    """What an engine and an exported file must agree on."""
    names = ("action", "reason", "lower", "upper", "n_success", "n_failure")
    return tuple(getattr(decision, name) for name in names)
