"""One file for the cell controller: the engine's whole decision as TorchScript, with a checksum beside it.

    >>> export_torchscript(engine, "model.ts")     # model.ts and model.ts.sha256
    >>> load_exported("model.ts").decide(trace)

The checksum guards against damage, not against an adversary: whoever can change the file can change the sum.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from . import __version__
from .decider import FIELDS, Decider
from .errors import ExportError
from .judge import SCRIPTED_INTERVALS, script
from .prediction import ModelPrediction
from .records import Action, Reason, TraceSpec

if TYPE_CHECKING:
    from .engine import DataEngine

SCHEMA = 1
METADATA = "dengine.json"
SCRIPTABLE = "conv, pca or rocket"


def export_torchscript(engine_or_model: Any, path: str | os.PathLike[str], *, trace: TraceSpec | None = None) -> Path:
    """Write `path` and `path`.sha256: a `DataEngine`'s decision, or a fitted `ModelPrediction`'s (without audits).

    trace : the trace contract, for a `ModelPrediction` whose traces have another rate or limit than `TraceSpec`'s.
    Raises ExportError where nothing was trained yet, or the reducer or the interval cannot be scripted.
    """
    model, spec, context = parts(engine_or_model, trace)
    decider = build_decider(model, spec, context["audit_rate"], context["seed"])
    frozen = torch.jit.freeze(script(decider.eval()), preserved_attrs=["decide", "learn"])
    metadata = describe(model, spec, context) | {"golden": _golden(frozen, spec)}
    target = Path(path)
    return write_checked(target, lambda partial: save(frozen, partial, metadata))


def build_decider(model: ModelPrediction, spec: TraceSpec, audit_rate: float, seed: int) -> Decider:
    """The decision of a fitted model as one eager module; ExportError where a part cannot be scripted."""
    if model.classifier.interval not in SCRIPTED_INTERVALS:
        raise ExportError(
            f"The interval {model.classifier.interval!r} needs special functions that TorchScript has not; "
            f"use {' or '.join(SCRIPTED_INTERVALS)}."
        )
    try:
        core = model.core
    except ValueError as error:
        raise ExportError("Nothing was trained yet; report labels until the first retrain, then export.") from error
    if not isinstance(core, torch.nn.Module):
        name = type(model.reducer).__name__
        raise ExportError(f"{name} cannot be scripted: it has no module; use {SCRIPTABLE} instead.")
    return Decider(spec, core, model.n_spaces, model.index.dim, audit_rate, seed)


def describe(model: ModelPrediction, spec: TraceSpec, context: dict[str, Any]) -> dict[str, Any]:
    """What the file says of itself, readable without loading it."""
    ring = model.index.ring
    held = ring.size()
    digest = hashlib.sha256()
    for array in (ring.points[:, :held], ring.labels[1, :held], ring.spaces[:held]):
        digest.update(np.ascontiguousarray(array.numpy()).tobytes())
    return {
        "schema": SCHEMA,
        "dengine": __version__,
        "torch": torch.__version__,
        "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "trace": asdict(spec),
        "alpha": model.classifier.alpha,
        "lower_bound": model.classifier.lower_bound,
        "interval": model.classifier.interval,
        "spaces": model.n_spaces,
        "dim": model.index.dim,
        "capacity": ring.capacity,
        "references": held,
        "references_sha256": digest.hexdigest(),
        "fields": list(FIELDS),
        "actions": [str(a) for a in Action],
        "reasons": [str(r) for r in Reason],
        **context,
    }


def save(module: Any, path: Path, metadata: dict[str, Any]) -> None:
    """One file with its description inside."""
    torch.jit.save(module, str(path), _extra_files={METADATA: json.dumps(metadata).encode()})


def write_checked(target: Path, write: Callable[[Path], None]) -> Path:
    """Write a file beside its name, sum it, and move both into place, so that a killed export leaves no half file."""
    partial = target.with_name(target.name + ".partial")
    try:
        partial.touch()  # torch names an unwritable place in words of its own
        write(partial)
        digest = hashlib.sha256(partial.read_bytes()).hexdigest()
        sum_file(target).write_text(f"{digest}  {target.name}\n", encoding="ascii")
        partial.replace(target)
    except OSError as error:
        raise ExportError(
            f"Cannot write {target}: {error.strerror}; choose a folder that exists and is writable."
        ) from error
    finally:
        partial.unlink(missing_ok=True)
    return target


def sum_file(path: Path) -> Path:
    """Where the checksum lies, in the form that `sha256sum --check` reads."""
    return path.with_name(path.name + ".sha256")


def parts(thing: DataEngine | ModelPrediction, spec: TraceSpec | None) -> tuple[ModelPrediction, TraceSpec, dict[str, Any]]:
    """What any exporter starts from: the fitted model, its trace contract, and what the file will say of the engine."""
    model = thing if isinstance(thing, ModelPrediction) else thing.model
    if model is None:
        raise ExportError("Nothing was trained yet; report labels until the first retrain, then export.")
    if not isinstance(model, ModelPrediction):
        raise ExportError(
            f"Expected a ModelPrediction to export, got {type(model).__name__}; a foreign model stays in Python."
        )
    if isinstance(thing, ModelPrediction):
        shape = getattr(model, "trace_shape", (1, 0))
        known = spec or TraceSpec(samples=shape[1], channels=shape[0])
        return model, known, {"model_version": 0, "recipe": "", "audit_rate": 0.0, "seed": 0}
    if thing.trace is None:
        raise ExportError("The engine has seen no trace yet, so it knows no trace contract to export.")
    about = {"model_version": thing.version, "recipe": thing.recipe.to_toml(), "seed": thing.seed}
    return model, thing.trace, about | {"audit_rate": thing.policy.audit_rate}


def _golden(module: Any, spec: TraceSpec) -> dict[str, Any]:
    """A trace and its embedding, for the loader to check that this machine computes the same."""
    x = np.sin(np.arange(spec.channels * spec.samples, dtype=np.float32) / 7.0).reshape(spec.channels, spec.samples)
    if spec.limit is not None:
        x = x * np.float32(0.5 * spec.limit)
    with torch.inference_mode():
        embedding = module.decide(torch.from_numpy(x))[6]
    return {"trace": x.tolist(), "embedding": embedding.tolist()}
