"""Export to ONNX, for controllers that run onnxruntime: `export_onnx` writes and checks a file,
`load_onnx` reads it and returns an `OnnxModel`, which decides in Python. `OnnxDecision` is the
module that is exported.

    >>> export_onnx(engine, "model.onnx")          # model.onnx and model.onnx.sha256
    >>> load_onnx("model.onnx").decide(trace)

An ONNX program of torch.export has neither branches nor state, so `OnnxDecision` repeats what
`Decider` and `RadiusNeighbours` do with tensors; the interval's formula is shared. `export_onnx`
checks each file against the model before it keeps it, and `tests/e2e/test_onnx.py` holds the two to
one another. ONNX cannot carry references that grow or rules that learn, so nothing is learned in
the cell. It has no hashes either, so there are no audits and no votes of parts that came again, and
a reference that is asked about itself counts itself.
"""

import json
import logging
import warnings
from importlib.util import find_spec
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from ..decision.intervals import ARRAY_LIMITS
from ..decision.neighbours import CERTAIN, UNCERTAIN
from ..decision.rule import DecisionRule
from ..errors import ExportError, instead
from ..files import FilePath
from ..model.base import Exportable
from ..model.neighbours import NOVEL, is_close
from ..records import ACTIONS, REASONS, TraceSpec
from ..traces import CONSTANT, LARGEST, NOT_FINITE, SATURATED, TOO_LARGE, as_trace
from .bundle import (
    METADATA,
    Metadata,
    check_schema,
    describe,
    prepare_export,
    read_checked,
    write_export,
)
from .decision import FIELDS
from .torchscript import TOLERANCE, ExportedDecision, golden_answer, golden_trace

NEEDED = ("onnx", "onnxruntime", "onnxscript")
FAR = 1e9  # a coordinate that no radius reaches
OPSET = 18
NOT_COUNTED = (0, 0.0, 1.0, 0, 0)  # action, bound and labels of a faulty or a novel trace
N_CHECKED = 64  # random traces that a file is checked on before it is kept
BOUND_TOLERANCE = 1e-6
# References whose distance is the radius may fall on either side: runtimes add in another order.
N_AT_EDGE = 2
NUMBERS = attrgetter("lower", "upper", "n_success", "n_failure")


def export_onnx(
    engine_or_model: Any,
    path: FilePath,
    *,
    trace: TraceSpec | None = None,
    key: FilePath | None = None,
    force: bool = False,
) -> Path:
    """Write the decision of an engine, or of a fitted model, as ONNX, with its checksum beside it.

    The file is written only if onnxruntime decides on random traces as the model does. For an
    engine, the export is recorded in the log of its store, before the file is written. Up to eight
    labelled traces are read from the store, to compare embeddings; a damaged trace (not as it was
    stored) is left out, which is logged in the store, too. While torch makes the program, Python's
    warnings, and log messages up to level WARNING, are off in the whole process.

    Parameters
    ----------
    engine_or_model : DataEngine or ModelPrediction
    path : path-like
        The checksum is written beside it, as PATH.sha256.
    trace : TraceSpec, optional
        What the traces look like. Needed for a `ModelPrediction` whose traces have another sampling
        rate or sensor limit than the defaults of `TraceSpec`. Its shape must be that of the model's
        traces. None: the engine's `TraceSpec`, or the shape of the model's traces.
    key : path-like, optional
        File of a key (`make_key`); the signature is written beside the file, as PATH.sig.
    force : bool, default False
        Whether to replace an existing file; never a database, a folder or a link. Without a key,
        the signature of a replaced file is removed.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ExportError
        If the engine audits (checks some parts at random although the model is certain) or is in
        shadow mode (checks every part), has force limits (an operator's limits of the signal) or a
        decision rule that learns (any but that of the guarantee "local" with stops "some"), or if a
        part is among the references (labelled points) more than once; the message names all of
        these that apply. Also if nothing was trained yet; for a baseline (a model that was handed
        in to the engine); if `trace` has another shape than the model's traces; if the reducer, the
        confidence interval or the rule cannot be exported; if the compiled decision and the reducer
        give a trace different embeddings; if the rule is stale, because an update of it failed; if
        the store was changed from outside (its rows do not fit their checksums); if the key cannot
        be read or has fewer than 16 bytes; if a package is missing; and if onnxruntime does not
        decide like the model. Other errors of torch and onnxruntime are raised as they are.
    SettingError
        If the engine's force limits do not fit `trace`.
    OutputError
        If a file exists, without `force`, or cannot be written.
    StoreError
        If the engine's store cannot be read, or the export cannot be recorded in it.
    OSError
        If the source text of the reducer's module cannot be found, or an old signature cannot be
        removed.
    """
    _require_packages()
    import onnx

    source, _ = prepare_export(engine_or_model, trace, path, force)
    _refuse_unsupported(source)
    metadata = describe(source) | {"format": "onnx", "learns": False}
    program = _to_onnx(OnnxDecision(source).eval(), source.trace)
    onnx_model = OnnxModel(program.SerializeToString(), metadata)
    _check_decisions(onnx_model, source.model, source.trace)
    x = golden_trace(source.trace)
    metadata["golden"] = golden_answer(x, onnx_model.decide(x).embedding)
    onnx.helper.set_model_props(program, {METADATA: json.dumps(metadata)})
    return write_export(path, program.SerializeToString(), force, key, source)


def load_onnx(path: FilePath, *, key: FilePath | None = None) -> "OnnxModel":
    """Check an ONNX file, load it into onnxruntime on one thread, and decide once, to warm it up.

    Unlike `load_exported` it does not compare the embedding of a test trace with the one in the
    file.

    Parameters
    ----------
    path : path-like
    key : path-like, optional
        File of the key that it was signed with; the signature is checked after the checksum and
        before the program is parsed. None: no signature is asked for.

    Returns
    -------
    OnnxModel

    Raises
    ------
    ExportError
        For a file that is missing, has no checksum beside it (PATH.sha256), is damaged or not
        signed with the key, a key that cannot be read or has fewer than 16 bytes, a file that is no
        ONNX export, has another schema (version of its description) or is refused by onnxruntime,
        and if a package for ONNX is missing.
    """
    _require_packages()
    import onnx

    target = Path(path)
    content = read_checked(target, key)
    with instead(
        ExportError, f"{target} is not a dengine export in ONNX, it holds no {METADATA}", Exception
    ):  # protobuf's errors have no common base
        properties = {p.key: p.value for p in onnx.load_from_string(content).metadata_props}
        metadata = json.loads(properties[METADATA])
    with instead(ExportError, f"onnxruntime cannot run {target}", Exception):
        return OnnxModel(content, check_schema(metadata, target))


def _refuse_unsupported(source: Exportable) -> None:
    """Raise ExportError if the decision needs something that ONNX cannot carry, and name it all.

    `source` is the model with its settings. ONNX cannot carry audits (random checks of parts about
    which the model is certain), shadow mode (every part is checked), a decision rule other than
    that of the guarantee "local" with stops "some", which learns nothing (also a user's own rule),
    a part that is among the references (labelled points) more than once, and force limits (an
    operator's limits of the signal).
    """
    rule = type(source.model.rule)  # a user's own as well: `OnnxDecision` knows the paper's alone
    n_repeats = int(source.model.index.repeats)
    needed = {
        "audits or shadow mode (set audit_rate = 0, shadow = false)": source.audit_rate > 0.0,
        f"{rule.__name__}, a rule that learns (set guarantee = 'local' and stops = 'some')": (
            rule is not DecisionRule
        ),
        f"votes of parts that came again ({n_repeats} references)": n_repeats > 0,
        "an operator's force limits": bool(source.force_limits),
    }
    problems = "; nor ".join(name for name, is_needed in needed.items() if is_needed)
    if problems:
        raise ExportError(f"ONNX carries no {problems}. Export torchscript instead.")


class OnnxModel:
    """An ONNX decision in onnxruntime; its `decide` takes no part, and it learns nothing.

    Parameters
    ----------
    content : bytes
        The ONNX program.
    metadata : dict
        The file's description of itself.

    Raises
    ------
    ExportError
        If a package for ONNX is missing.
    Exception
        What onnxruntime raises for a program that it cannot run.
    """

    def __init__(self, content: bytes, metadata: Metadata) -> None:
        _require_packages()
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        self.session = onnxruntime.InferenceSession(
            content, options, providers=["CPUExecutionProvider"]
        )
        self.metadata = metadata
        self.trace = TraceSpec(**metadata["trace"])
        self.decide(golden_trace(self.trace))  # warms it up

    def decide(self, trace: ArrayLike) -> ExportedDecision:
        """Decide on one trace, (T,) or (C, T), and keep nothing of it.

        Returns action, reason, the bound on the success probability (lower, upper), the numbers of
        good and bad labels nearby (n_success, n_failure) and the embedding (K, d), a point in each
        of K spaces. Another T is cut, padded or resampled, or refused, as `TraceSpec.fit` says. A
        faulty trace (NaN, infinite, constant, too large or at the sensor's limit), or a novel
        trace, which is unlike all traces of the training, gets the action VERIFY (the part needs
        the slow check), with the bound (0, 1) and no labels, and its reason says so; the embedding
        of a faulty trace is NaN. Raises TraceError for a wrong shape, a T that is refused, and
        values that are no real numbers.
        """
        action, reason, *counted, z = self.session.run(None, {"trace": as_trace(trace, self.trace)})
        return ExportedDecision._make(
            (ACTIONS[action], REASONS[reason], *(value.item() for value in counted), z)
        )


class OnnxDecision(nn.Module):
    """The decision without a branch, in tensors; the references do not change.

    It has a copy of the model's references.

    Parameters
    ----------
    source : Exportable
        Of the paper's rule, without audits and force limits.
    """

    def __init__(self, source: Exportable) -> None:
        super().__init__()
        model = source.model
        index = model.index
        self.rule: DecisionRule = model.rule
        self.radius = float(model.classifier.radius)
        self.limit = source.trace.limit or float("inf")
        self.encoder = model.spaces.module()
        self.novelty = model.gate
        self.register_buffer("scale", torch.from_numpy(model.scale)[:, None])
        # A reference of space k is far away in every other space: one subtraction, no gathering.
        points = np.full((model.n_spaces, index.dim, len(index)), FAR, dtype=np.float32)
        points[index.column("spaces"), :, np.arange(len(index))] = index.column("points")
        self.register_buffer("points", torch.from_numpy(points))
        self.register_buffer("labels", torch.from_numpy(index.column("labels").astype(np.int64)))

    def forward(self, trace: Tensor) -> tuple[Tensor, ...]:
        """Decide on one trace (C, T) of float32; return a tuple of seven tensors.

        They are action (0 verify, which asks for the slow check, 1 accept, 2 reject), reason
        (position in `Reason`), the bound on the success probability (lower, upper), the numbers of
        good and bad labels nearby (n_success, n_failure) and embedding. They have no dimension,
        except the embedding (K, d), a point in each of K spaces, which is NaN for a faulty trace. A
        faulty trace (see `fault`) or a novel one (unlike all training traces) is verified, with the
        bound (0, 1) and no labels.
        """
        fault = self.fault(trace)
        is_sound = fault == 0
        x = torch.where(is_sound, trace, torch.zeros_like(trace))
        z = self.encoder(x.unsqueeze(0))[0] / self.scale  # (K, d)
        is_usual = (self.novelty.scores(x) <= 1.0).all()  # False for what overflowed to NaN
        is_counted = is_sound & is_usual
        # (n,): a reference is nearest in its own space
        distances = (self.points - z[:, :, None]).square().sum(1).amin(0)
        action, *numbers = [
            torch.where(is_counted, value, otherwise)
            for value, otherwise in zip(self.count(distances), NOT_COUNTED, strict=True)
        ]
        certainty = torch.where(action == 0, UNCERTAIN, CERTAIN)
        reason = torch.where(is_usual, certainty, NOVEL)
        return (
            action,
            torch.where(is_sound, reason, fault),
            *numbers,
            torch.where(is_sound, z, float("nan")),
        )

    def fault(self, trace: Tensor) -> Tensor:
        """Return the position in `Reason` of what is wrong with a trace, () int64; 0 if nothing is.

        `Reason` lists the faults of a trace and the other reasons of decisions. Only the first
        fault that applies is returned, in this order: a sample is not finite, all samples are
        equal, a sample is at or beyond ±`self.limit` (the range of the sensor; infinity if none is
        stated), a sample is too large (beyond ±1e18). The result is the same as that of
        `TraceGate`, which an engine uses.
        """
        low = trace.min()
        high = trace.max()
        is_finite = (trace.abs() < float("inf")).all()
        highest = torch.maximum(high, -low)
        fault = torch.where(highest > LARGEST, TOO_LARGE, 0)
        fault = torch.where(highest >= self.limit, SATURATED, fault)
        fault = torch.where(low == high, CONSTANT, fault)
        return torch.where(is_finite, fault, NOT_FINITE)

    def count(self, distances: Tensor) -> tuple[Tensor, ...]:
        """Count the labels within the radius; return action, lower, upper, n_success, n_failure.

        `distances` are the squared distances to the references (labelled points), (n,). The results
        are tensors without a dimension. `lower` and `upper` are the ends of the rule's confidence
        interval of the success probability. The action follows from them by the `DecisionRule`: 1
        accept if lower reaches the rule's accept threshold, else 2 reject if upper is at most its
        reject threshold, else 0 verify. A reference at the radius counts.
        """
        is_inside = distances <= self.radius * self.radius
        n_success = (is_inside & (self.labels == 1)).sum()
        n_failure = (is_inside & (self.labels == 0)).sum()
        lower, upper = ARRAY_LIMITS[self.rule.interval](
            torch, n_success.double(), n_failure.double(), self.rule.z
        )
        rejects = torch.where(upper <= self.rule.reject_threshold, 2, 0)
        action = torch.where(lower >= self.rule.accept_threshold, 1, rejects)
        return action, lower, upper, n_success, n_failure


def _to_onnx(decision: OnnxDecision, spec: TraceSpec) -> Any:
    """Return the ONNX program of a decision on traces like `spec`, a protobuf `ModelProto`.

    torch.export makes it, without TorchScript. Meanwhile Python's warnings, and log messages up to
    level WARNING, are off in the whole process, because torch reports optional packages that are
    missing. Raises ExportError if torch makes no program, for example because ONNX has no operator
    for a layer of the user's network.
    """
    example = (torch.from_numpy(golden_trace(spec)),)
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            program: Any = torch.onnx.export(
                decision,
                example,
                input_names=["trace"],
                output_names=FIELDS,
                dynamo=True,
                opset_version=OPSET,
                verbose=False,
            )
            return program.model_proto
    except Exception as error:
        cause: BaseException = error
        while cause.__cause__ is not None:  # the innermost one names the layer
            cause = cause.__cause__
        why = str(cause).partition("\n")[0]
        raise ExportError(f"torch makes no ONNX program: {why}; export torchscript.") from error
    finally:
        logging.disable(level)


def _check_decisions(onnx_model: OnnxModel, model: Any, spec: TraceSpec) -> None:
    """Compare an ONNX model with the model that it was made from, on 64 traces of noise.

    The noise has amplitudes from 0.01 to 100, and is clipped at 0.9 times the sensor's limit in
    `spec`, if there is one; it is always the same. Raises ExportError if a coordinate of an
    embedding differs by more than 0.0001 times (1 + the absolute value of the model's coordinate),
    or if the counts of good and bad labels together differ by more than two. If the counts are
    equal, it is also raised if the action differs, or if the differences of the two ends of the
    bound on the success probability add up to more than 1e-6. Counts may differ, since a reference
    (a labelled point) may lie exactly at the radius within which labels count; action and bound are
    then not compared. The reason is never compared.
    """
    rng = np.random.default_rng(0)
    shape = (N_CHECKED, spec.channels, spec.samples)
    scales = 10.0 ** rng.uniform(-2, 2, (N_CHECKED, 1, 1))
    X = (rng.normal(size=shape) * scales).astype(np.float32)
    if spec.limit is not None:
        X = np.clip(X, -0.9 * spec.limit, 0.9 * spec.limit)
    for actual, expected in zip(map(onnx_model.decide, X), model.predict_many(X), strict=True):
        is_near = is_close(actual.embedding, expected.embedding, TOLERANCE)
        differences = np.abs(np.subtract(NUMBERS(actual), NUMBERS(expected)))
        n_moved = differences[2:].sum()
        is_same = actual.action == expected.action and differences.sum() <= BOUND_TOLERANCE
        if not is_near or n_moved > N_AT_EDGE or (n_moved == 0 and not is_same):
            raise ExportError(
                f"onnxruntime does not decide as the model does: {actual} for {expected}; export "
                "torchscript."
            )


def _require_packages() -> None:
    """Raise ExportError, with what to install, if a package for ONNX is missing: onnx, onnxruntime
    or onnxscript. None of them is imported.
    """
    missing = [needed for needed in NEEDED if find_spec(needed) is None]
    if missing:
        raise ExportError(f'ONNX needs {", ".join(missing)}; pip install "dengine[onnx]".')
