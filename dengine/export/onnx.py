"""The decision as ONNX, for the day that TorchScript is gone or a controller runs onnxruntime.

    >>> export_onnx(engine, "model.onnx")          # model.onnx and model.onnx.sha256
    >>> load_onnx("model.onnx").decide(trace)

A pure-tensor twin of the decision that TorchScript carries, checked against it when it is written. What ONNX cannot
carry: references that grow and rules that learn, so nothing is learned in the cell; hashes, so there are no audits, no
votes of parts that came again, and a reference that is asked about itself counts itself.
"""

import json
import logging
import os
import warnings
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from ..decision.intervals import ARRAY_LIMITS
from ..decision.neighbours import CERTAIN, UNCERTAIN
from ..decision.rule import DecisionRule
from ..errors import ExportError, instead
from ..model.base import Exportable
from ..model.neighbours import NOVEL
from ..records import ACTIONS, REASONS, TraceSpec
from ..traces import CONSTANT, LARGEST, NOT_FINITE, SATURATED, TOO_LARGE, as_trace, as_traces
from .bundle import METADATA, KeyFile, checked_bytes, checked_schema, describe, prepared, write_export
from .decision import FIELDS
from .torchscript import TOLERANCE, ExportedDecision, golden_trace

NEEDED = ("onnx", "onnxruntime", "onnxscript")
FAR = 1e9  # where an empty slot waits: no ball reaches it
OPSET = 18
CHECKED = 64  # random traces that the file is held against before it is kept
BOUND_TOLERANCE = 1e-6
EDGE = 2  # another runtime adds in another order: a reference on the ball's very surface may fall on either side


def export_onnx(
    engine_or_model: Any,
    path: str | os.PathLike[str],
    *,
    trace: TraceSpec | None = None,
    key: KeyFile | None = None,
    force: bool = False,
) -> Path:
    """Write `path` and `path`.sha256: the decision of a `DataEngine` or a fitted `ModelPrediction` as ONNX.

    key : a key's file (`make_key`); the signature comes beside the file, as `path`.sig.
    Raises ExportError where the engine audits, its rule learns, a part came again, nothing was trained yet, the reducer or
    the interval has no module, a package is missing, or onnxruntime does not decide as the model does; OutputError where
    `path` cannot be written. force : as of `export_torchscript`.
    """
    onnx = _package("onnx")
    source, _ = prepared(engine_or_model, trace, path, force)
    _refuse_what_changes(source)
    metadata = describe(source) | {"format": "onnx", "learns": False}
    program = _to_onnx(Twin(source).eval(), source.trace)
    x = golden_trace(source.trace)
    found = OnnxModel(program.SerializeToString(), metadata).decide(x)
    golden = {"trace": x.tolist(), "embedding": found.embedding.tolist()}
    onnx.helper.set_model_props(program, {METADATA: json.dumps(metadata | {"golden": golden})})
    content = program.SerializeToString()
    _check(OnnxModel(content, metadata), source.model, source.trace)
    return write_export(path, content, force, key, source)


def load_onnx(path: str | os.PathLike[str], *, key: KeyFile | None = None) -> "OnnxModel":
    """Check the sum, load into onnxruntime on one thread, warm up; ExportError for what must not be used.

    key : the key's file that it was signed with; it is checked first. None: no signature is asked for.
    """
    onnx = _package("onnx")
    target = Path(path)
    content = checked_bytes(target, key)
    said = f"{target} is not a dengine export in ONNX, it holds no {METADATA}"
    with instead(ExportError, said, Exception):  # protobuf's own errors have no common base
        properties = {p.key: p.value for p in onnx.load_from_string(content).metadata_props}
        metadata = json.loads(properties[METADATA])
    return OnnxModel(content, checked_schema(metadata, target))


def _refuse_what_changes(source: Exportable) -> None:
    rule, repeats = type(source.model.rule), int(source.model.index.repeats)
    # One of the user's own as well: the twin knows the paper's alone.
    learns = f"{rule.__name__}, a rule that learns; export torchscript, or set guarantee = 'local' and stops = 'some'"
    audits = "audits, its integers are not the content hash's; export torchscript, or set audit_rate = 0"
    votes = f"votes: {repeats} of the references are of parts that were there already; export torchscript"
    kept = (source.audit_rate > 0.0, rule is not DecisionRule, repeats > 0, len(source.windows) > 0)
    for what, held in zip((audits, learns, votes, "an operator's windows; export torchscript"), kept, strict=True):
        if held:
            raise ExportError(f"ONNX carries no {what}.")


class OnnxModel:
    """An ONNX decision in onnxruntime; the face of `ExportedModel` without `learn` and `save`."""

    def __init__(self, content: bytes, metadata: dict[str, Any]) -> None:
        runtime = _package("onnxruntime")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        self.session = runtime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        self.metadata = metadata
        self.trace = TraceSpec(**metadata["trace"])
        warm = np.linspace(-1.0, 1.0, self.trace.channels * self.trace.samples)
        self.decide(warm.reshape(self.trace.channels, self.trace.samples))

    def decide(self, trace: ArrayLike) -> ExportedDecision:
        """Decide on one trace, (T,) or (C, T); TraceError for a wrong shape."""
        found = self.session.run(None, {"trace": as_trace(trace, self.trace)})
        action, reason, lower, upper, n_success, n_failure, z = found
        whole = int(n_success), int(n_failure)
        return ExportedDecision(ACTIONS[int(action)], REASONS[int(reason)], float(lower), float(upper), *whole, z)

    def decide_many(self, X: ArrayLike) -> list[ExportedDecision]:
        """Decide on each trace of (n, T) or (n, C, T)."""
        return [self.decide(x) for x in as_traces(X, self.trace)]


class Twin(nn.Module):
    """The decision without a branch: trace (C, T) float32 -> the tensors named in `FIELDS`. References do not change."""

    def __init__(self, source: Exportable) -> None:
        super().__init__()
        model, index, limit = source.model, source.model.index, source.trace.limit
        self.rule: DecisionRule = model.rule
        self.radius = float(model.classifier.radius)
        self.limit = float("inf") if limit is None else limit
        self.encoder = model.spaces.module()
        self.novelty = model.gate
        self.register_buffer("scale", torch.from_numpy(model.scale)[:, None])
        # A reference of space k stands far away in every other space: one subtraction, no gathering.
        places = np.full((model.n_spaces, index.dim, len(index)), FAR, dtype=np.float32)
        places[index.column("spaces"), :, np.arange(len(index))] = index.column("points")
        self.register_buffer("places", torch.from_numpy(places))
        self.register_buffer("success", torch.from_numpy(index.column("labels").astype(np.int64)))

    def forward(self, trace: Tensor) -> tuple[Tensor, ...]:
        """(C, T) float32 -> action, reason, lower, upper, n_success, n_failure, embedding (K, d)."""
        low, high = trace.min(), trace.max()
        finite = (trace.abs() < float("inf")).all()
        highest = torch.maximum(high, -low)
        saturated = torch.where(highest >= self.limit, SATURATED, torch.where(highest > LARGEST, TOO_LARGE, 0))
        fault = torch.where(finite, torch.where(low == high, CONSTANT, saturated), NOT_FINITE)  # as of `TraceGate`
        good = fault == 0
        x = torch.where(good, trace, torch.zeros_like(trace))
        z = self.encoder(x.unsqueeze(0))[0] / self.scale  # (K, d)
        usual = (self.novelty.scores(x) <= 1.0).all()  # what overflowed to NaN is not
        known = good & usual
        distances = (self.places - z[:, :, None]).square().sum(1).amin(0)  # (n,): in its own space it is nearest
        action, lower, upper, n_success, n_failure = self.counted(distances)
        verify, empty = torch.zeros_like(action), torch.zeros_like(lower)
        action = torch.where(known, action, verify)
        certain = torch.where(usual, torch.where(action == 0, UNCERTAIN, CERTAIN), NOVEL)
        return (
            action,
            torch.where(good, certain, fault),
            torch.where(known, lower, empty),
            torch.where(known, upper, empty + 1.0),
            torch.where(known, n_success, verify),
            torch.where(known, n_failure, verify),
            torch.where(good, z, float("nan")),
        )

    def counted(self, distances: Tensor) -> tuple[Tensor, ...]:
        """action, lower, upper, n_success, n_failure of (n,) squared distances, as of `RadiusNeighbours`."""
        inside = distances <= self.radius * self.radius
        n_success = (inside & (self.success == 1)).to(torch.int64).sum()
        n_failure = (inside & (self.success == 0)).to(torch.int64).sum()
        lower, upper = ARRAY_LIMITS[self.rule.interval](torch, n_success.double(), n_failure.double(), self.rule.z)
        accepts, rejects = lower >= self.rule.accept_threshold, upper <= self.rule.reject_threshold
        return torch.where(accepts, 1, torch.where(rejects, 2, 0)), lower, upper, n_success, n_failure


def _to_onnx(twin: Twin, spec: TraceSpec) -> Any:
    """By way of torch.export, which does not need TorchScript; silent on every package that it could use and need not."""
    example = (torch.linspace(-1.0, 1.0, spec.channels * spec.samples).reshape(spec.channels, spec.samples),)
    options: dict[str, Any] = {"dynamo": True, "opset_version": OPSET, "verbose": False}
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            program = torch.onnx.export(twin, example, input_names=["trace"], output_names=list(FIELDS), **options)
    finally:
        logging.disable(level)
    if program is None:
        raise ExportError("torch gave no ONNX program; export torchscript instead.")
    return program.model_proto


def _check(found: OnnxModel, model: Any, spec: TraceSpec) -> None:
    """Hold the file against the model that answers, on random traces of every size."""
    rng = np.random.default_rng(0)
    shape = (CHECKED, spec.channels, spec.samples)
    X = (rng.normal(size=shape) * 10.0 ** rng.uniform(-2, 2, (CHECKED, 1, 1))).astype(np.float32)
    X = X if spec.limit is None else np.clip(X, -0.9 * spec.limit, 0.9 * spec.limit)
    for one, known in zip(found.decide_many(X), model.predict_many(X), strict=True):
        near = np.allclose(one.embedding, known.embedding, rtol=TOLERANCE, atol=TOLERANCE)
        moved = abs(one.n_success - known.n_success) + abs(one.n_failure - known.n_failure)
        apart = abs(one.lower - known.lower) + abs(one.upper - known.upper)
        if not near or moved > EDGE or (moved == 0 and (one.action != known.action or apart > BOUND_TOLERANCE)):
            raise ExportError(f"onnxruntime does not decide as the model does: {one} for {known}; export torchscript.")


def _package(name: str) -> ModuleType:
    missing = [needed for needed in NEEDED if find_spec(needed) is None]
    if missing:
        raise ExportError(f"ONNX needs {', '.join(missing)}; pip install dengine[onnx].")
    return import_module(name)
