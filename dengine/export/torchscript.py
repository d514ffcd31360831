"""One file for the cell controller: the engine's whole decision as TorchScript, with a checksum beside it.

>>> export_torchscript(engine, "model.ts")     # model.ts and model.ts.sha256
>>> load_exported("model.ts").decide(trace)    # checked before it is loaded, ready at the first call
"""

from __future__ import annotations

import io
import json
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from ..decision.rule import script
from ..errors import ExportError
from ..records import ACTIONS, REASONS, Action, Reason, TraceSpec
from ..traces import as_trace, as_traces
from .file import METADATA, checked_bytes, decision_module, describe, metadata_of, source_of, write_checked

WARM_UP = 3
TOLERANCE = 1e-4  # of a scaled embedding: another processor may add in another order


def export_torchscript(engine_or_model: Any, path: str | os.PathLike[str], *, trace: TraceSpec | None = None) -> Path:
    """Write `path` and `path`.sha256: a `DataEngine`'s decision, or a fitted `ModelPrediction`'s (without audits).

    trace : the trace contract, for a `ModelPrediction` whose traces have another rate or limit than `TraceSpec`'s.
    Raises ExportError where nothing was trained yet, or the reducer, the interval or the rule cannot be scripted.
    """
    source = source_of(engine_or_model, trace)
    try:
        frozen = torch.jit.freeze(script(decision_module(source).eval()), preserved_attrs=["decide", "learn"])
    except RuntimeError as error:
        raise ExportError(f"The decision does not compile to TorchScript: {str(error).splitlines()[0]}") from error
    metadata = describe(source) | {"golden": _golden(frozen, source.trace)}
    return write_checked(Path(path), lambda partial: _save(frozen, partial, metadata))


def _save(module: Any, path: Path, metadata: dict[str, Any]) -> None:
    """One file with its description inside."""
    torch.jit.save(module, str(path), _extra_files={METADATA: json.dumps(metadata).encode()})


def _golden(module: Any, spec: TraceSpec) -> dict[str, Any]:
    """A trace and its embedding, for the loader to check that this machine computes the same."""
    x = np.sin(np.arange(spec.channels * spec.samples, dtype=np.float32) / 7.0).reshape(spec.channels, spec.samples)
    if spec.limit is not None:
        x = x * np.float32(0.5 * spec.limit)
    with torch.inference_mode():
        embedding = module.decide(torch.from_numpy(x))[6]
    return {"trace": x.tolist(), "embedding": embedding.tolist()}


class ExportedDecision(NamedTuple):
    """What an exported file says of one trace; fields as in `Decision`, the embedding (K, d)."""

    action: Action
    reason: Reason
    lower: float
    upper: float
    n_success: int
    n_failure: int
    embedding: NDArray[np.float32]


class ExportedModel:
    """An exported decision in Python. `metadata` is what the file says of itself."""

    def __init__(self, module: Any, metadata: dict[str, Any]) -> None:
        self.module = module
        self.metadata = metadata
        self.trace = TraceSpec(**metadata["trace"])
        self._decide = module.decide

    def decide(self, trace: ArrayLike) -> ExportedDecision:
        """Decide on one trace, (T,) or (C, T); TraceError for a wrong shape."""
        x = torch.from_numpy(as_trace(trace, self.trace))
        with torch.inference_mode():
            action, reason, lower, upper, n_success, n_failure, z = self._decide(x)
        return ExportedDecision(ACTIONS[action], REASONS[reason], lower, upper, n_success, n_failure, z.numpy())

    def decide_many(self, X: ArrayLike) -> list[ExportedDecision]:
        """Decide on each trace of (n, T) or (n, C, T)."""
        return [self.decide(x) for x in as_traces(X, self.trace)]

    def learn(self, trace: ArrayLike, success: bool) -> int:
        """Make a verified trace a reference; returns how many are held. A faulty trace is not learned from."""
        with torch.inference_mode():
            held: int = self.module.learn(torch.from_numpy(as_trace(trace, self.trace)), bool(success))
        self.metadata["references"] = held
        return held

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write what was learned to a file of the same kind, with its checksum."""
        metadata = self.metadata | {"references_sha256": None}  # of the references as first exported, no longer true
        return write_checked(Path(path), lambda partial: _save(self.module, partial, metadata))


def load_exported(path: str | os.PathLike[str]) -> ExportedModel:
    """Check, load, warm up. Uses one torch thread, steadier by far at these sizes.

    Raises ExportError, before anything is loaded, for a file that is missing, damaged, truncated, foreign or newer, and
    after loading where this machine does not reproduce the golden embedding.
    """
    target = Path(path)
    content = checked_bytes(target)
    metadata = metadata_of(content, target)
    torch.set_num_threads(1)
    try:
        module = torch.jit.load(io.BytesIO(content), map_location="cpu").eval()  # type: ignore[no-untyped-call]
    except RuntimeError as error:
        raise ExportError(
            f"{target} has its checksum but is no loadable TorchScript: {str(error).splitlines()[0]}."
        ) from error
    try:
        model = ExportedModel(module, metadata)
        _check_golden(model, target)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ExportError(f"{target} is not a dengine export: its description does not fit its module: {error}.") from error
    return model


def _check_golden(model: ExportedModel, path: Path) -> None:
    golden = model.metadata["golden"]
    trace, expected = np.array(golden["trace"], dtype=np.float32), np.array(golden["embedding"], dtype=np.float32)
    for _ in range(WARM_UP):
        found = model.decide(trace).embedding
    if found.shape != expected.shape or not np.allclose(found, expected, atol=TOLERANCE, rtol=TOLERANCE):
        raise ExportError(f"{path} loads, but this machine does not reproduce its golden embedding; export it anew here.")
