"""What every exported file has, TorchScript or ONNX: description, checksum and signature.
`torchscript` and `onnx` write and read their files through the functions here: `prepare_export`
checks and builds the module, `describe` and `write_export` write, `read_checked` and `metadata_of`
read, and `make_key` makes the key that signs.

    dengine export --make-key cell.key
    dengine export engine.db --out model.ts --key cell.key  # model.ts, .ts.sha256, .ts.sig
    python -c 'from dengine import load_exported; load_exported("model.ts", key="cell.key")'

The checksum guards against damage, not against an adversary: whoever can change the file can change
the sum. The signature says who made the file before a byte of it is run. It is HMAC-SHA256 (FIPS
198-1) with a secret that both sides have, so whoever can check one can make one. Keep the key's
file where only the exporter and the controller can read it. An earlier file signed with the same
key is as valid as the newest one.
"""

import hashlib
import hmac
import io
import json
import os
import re
import secrets
import time
import zipfile
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch

from .. import __version__
from ..decision import member_rules
from ..decision.decider import DecisionConditions
from ..decision.intervals import SCALAR_BOUNDS
from ..decision.members import SAFE_MODES
from ..decision.policy import RULES
from ..decision.scripting import reason_of
from ..engine.engine import DataEngine
from ..errors import ExportError, instead
from ..files import UNREADABLE, FilePath, check_output, read_key, write_output
from ..model.base import N_EXAMPLES, NOT_TRAINED, Exportable
from ..model.neighbours import ModelPrediction, compare_points
from ..records import ACTIONS, REASONS, TraceSpec
from .decision import FIELDS, DecisionModule

PREFIX = "hmac-sha256:"
SCHEMA = 2
METADATA = "dengine.json"
SHA256 = re.compile(r"[0-9a-f]{64}")
SUM_BYTES = 2**16

Metadata = dict[str, Any]  # what an exported file says of itself, by name


def make_key(path: FilePath) -> Path:
    """Write a new random key, 64 hexadecimal digits, to a new file that only its owner can read.

    A line break follows the key, and the file is flushed to the disk. Its folder must exist.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ExportError
        If there is a file already, because models may be signed with it, or it cannot be written; a
        file that was begun then stays.
    """
    target = Path(path)
    with (
        instead(
            ExportError,
            f"Cannot write {target}",
            OSError,
            do="name a new file in a folder that is writable; files may be signed with an old key",
        ),
        open(target, "x", encoding="ascii", opener=partial(os.open, mode=0o600)) as file,
    ):
        file.write(secrets.token_hex(32) + "\n")
        file.flush()
        os.fsync(file.fileno())
    return target


def signature(content: bytes, key: FilePath) -> str:
    """Return the signature of a content with the secret in a key's file: "hmac-sha256:HEX".

    Line breaks at the end of the file do not belong to the secret. Raises ExportError for a file
    that cannot be read, or whose secret has less than 16 bytes.
    """
    return PREFIX + hmac.new(read_key(key, ExportError), content, hashlib.sha256).hexdigest()


def sibling_path(path: FilePath, suffix: str) -> Path:
    """Return the path of a file's checksum (sha256), signature (sig) or head (head), PATH.SUFFIX.

    The suffix is appended: model.ts gets model.ts.sha256. No file is looked at.
    """
    return Path(f"{os.fspath(path)}.{suffix}")


def prepare_export(
    engine_or_model: Any, trace: TraceSpec | None, path: FilePath, force: bool
) -> tuple[Exportable, DecisionModule]:
    """Check that an engine or a model can be exported, and build its decision module.

    No file is written; but for an engine labelled traces are read, and each damaged one is noted as
    an event in the store. The module shares the references (embedded labelled traces, which it
    counts near a new trace) and the decision rule with the model, so what one learns the other
    knows. The decider in it, the module that decides on one trace, is compiled by TorchScript
    already; the module itself is not.

    Parameters
    ----------
    engine_or_model : DataEngine or ModelPrediction
    trace : TraceSpec or None
        The `TraceSpec` (shape, rate and units of the traces) of the file, if it is not the engine's
        or the model's own. It must have the shape of the model's traces.
    path : path-like
        Where the file will be written.
    force : bool
        Whether it may replace a file.

    Returns
    -------
    source : Exportable
        The model with its `TraceSpec`, rate of audits (checks of parts that it is certain of) and
        force limits of the operator.
    module : DecisionModule
        Decides on traces and learns their outcomes; the content of a TorchScript file.

    Raises
    ------
    ExportError
        For a baseline (a model that the user handed in); before the first training; for a `trace`
        of another shape; for a rule, an interval or a reducer that TorchScript cannot compile or
        run; if the compiled decision and the reducer map one of up to eight labelled traces to
        different points (`compare_points`); if the rule is stale, because an update of it failed;
        and if the store was changed from outside.
    SettingError
        If the engine's force limits do not fit `trace`.
    OutputError
        If one of the files (`path`, its checksum, its signature) must not be written; this is
        checked first.
    StoreError
        If the engine's store cannot be read.
    OSError
        If the source text of the reducer's module, which TorchScript compiles, cannot be found.
    """
    _check_outputs(path, force)
    source = exportable(engine_or_model, trace)
    model = source.model
    encoder = model.spaces.module()
    if not model.rule.scriptable:
        raise ExportError(
            f"{type(model.rule).__name__} with the interval {model.rule.interval!r} does not "
            f"compile to TorchScript; use {' or '.join(SCALAR_BOUNDS)}, and a rule that does."
        )
    if model.rule_is_stale:
        raise ExportError(
            "The rule has missed what became of a part; open the engine's store again, then export."
        )
    if encoder is None:
        raise ExportError(f"{model.name} cannot be exported, for {model.spaces.why_no_module_}.")
    conditions = DecisionConditions(
        source.trace, source.force_limits, source.audit_rate, source.seed
    )
    examples = source.examples
    # (n, K, d), without the decider
    points = model.spaces.embed(examples) / model.scale[:, None] if len(examples) else examples
    try:
        decider = model.build_decider(conditions)
        defect = compare_points(decider, examples, points)
    except (RuntimeError, torch.jit.Error, torch.jit.frontend.FrontendError) as error:
        defect = f"it does not run as TorchScript, {reason_of(error)}"
    if defect:
        raise ExportError(f"{model.name} cannot be exported: {defect}.")
    return source, DecisionModule(source.trace, decider, model.n_spaces, source.stops_all)


def exportable(engine_or_model: Any, trace: TraceSpec | None) -> Exportable:
    """Return the model that decides at present, with the engine's settings, for an exporter.

    `engine_or_model` is a `DataEngine` or a `ModelPrediction`. Of an engine the result has the rate
    of audits (checks of parts that the model is certain of), the seed of their draw, whether an
    accepted part counts as good if nothing is reported until the next decision (`stops_all`), the
    operator's force limits, the version, the recipe (all settings), up to eight labelled traces,
    and a function that records events; of a model alone, which has none of these, it has some of
    the traces it was trained on. The model is not copied, and goes on learning. `trace` replaces
    the `TraceSpec` (shape, rate and units of the traces) of the engine or the model. Raises
    ExportError before the first training, for a baseline (a model that the user handed in), and if
    the engine's store was changed from outside; StoreError if it cannot be read. A damaged trace is
    left out, and noted as an event in the store.
    """
    engine = engine_or_model if isinstance(engine_or_model, DataEngine) else None
    model = engine_or_model if engine is None else engine.model
    if engine is not None and engine.state.integrity_error:
        raise ExportError(
            f"Expected a store as it was written, to export from: {engine.state.integrity_error}"
        )
    if model is not None and not isinstance(model, ModelPrediction):
        raise ExportError(
            f"Expected a DataEngine or a ModelPrediction to export, got {type(model).__name__}; a "
            "baseline stays in Python."
        )
    if model is None or not hasattr(model, "trace_shape"):
        raise ExportError(NOT_TRAINED)
    if engine is None:
        return Exportable(model, trace or model.trace_spec, model.examples)
    return Exportable(
        model,
        trace or engine.trace or model.trace_spec,
        engine.store.labels.with_traces(N_EXAMPLES).traces,
        audit_rate=engine.policy.audited_share,
        seed=engine.seed,
        stops_all=engine.policy.stops == "all",
        force_limits=engine.policy.limits,
        model_version=engine.version,
        recipe=engine.recipe.to_toml(),
        note=engine._outbox.record_event,  # it waits for no database
    )


def describe(source: Exportable) -> Metadata:
    """Return the description that is written into the file, as a dict for JSON.

    `source` is what the file is made from. The dict has the schema (the version of its keys), the
    versions of dengine, torch and the model, the time, the `TraceSpec` (shape, rate and units of
    the traces), the policy (with a user's rule as `module:Class`), the factor of the limit beyond
    which a trace counts as novel, the numbers of embedding spaces and of coordinates, the
    references (labelled points: their number, their largest number and their SHA-256), the order of
    the fields of a decision, of actions, reasons and safe modes (states after an alarm, in which
    parts are verified), the audit rate (share of parts that are checked although the model is
    certain), the seed and the recipe (all settings). `metadata_of` reads it without loading the
    model.
    """
    model = source.model
    index = model.index
    rule = type(model.rule)
    guarantee = f"{rule.__module__}:{rule.__qualname__}"
    if getattr(member_rules, rule.__name__, None) is rule:
        guarantee = next(name for name, rules in RULES.items() if rule.__name__ in rules.values())
    return {
        "schema": SCHEMA,
        "dengine": __version__,
        "torch": torch.__version__,
        "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "trace": asdict(source.trace),
        "alpha": model.classifier.alpha,
        "lower_bound": model.classifier.lower_bound,
        "interval": model.classifier.interval,
        "guarantee": guarantee,
        "stops": "all" if source.stops_all else "some",
        "novelty": model.novelty,
        "spaces": model.n_spaces,
        "dim": index.dim,
        "capacity": index.capacity,
        "references": len(index),
        "references_sha256": index.digest(),
        "fields": FIELDS,
        "actions": ACTIONS,
        "reasons": REASONS,
        "safe_modes": SAFE_MODES,
        "model_version": source.model_version,
        "recipe": source.recipe,
        "audit_rate": source.audit_rate,
        "seed": source.seed,
    }


def write_export(
    path: FilePath,
    content: bytes,
    force: bool = False,
    key: FilePath | None = None,
    source: Exportable | None = None,
) -> Path:
    """Write a file, its checksum (PATH.sha256) and, with a key, its signature (PATH.sig).

    The folder must exist. Each file is put in place by a rename. If the process is killed between
    two renames, the file may be refused as damaged until it is exported again. Before anything is
    written, the export is recorded as an event of the engine, so the event may be there without the
    file.

    Parameters
    ----------
    path : path-like
        The file to write.
    content : bytes
        What it shall hold.
    force : bool, default False
        Whether it may replace a file. If so, and without a key, the signature of the replaced file
        is removed at the end.
    key : path-like, optional
        File of the key to sign with.
    source : Exportable, optional
        Its `note` records checksum and model version as an event. No event is recorded without
        `source`, or if its `note` is None. What `note` raises is raised here, before a file is
        written: StoreError, if an engine that only reads cannot write the event.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    OutputError
        If a file must not or cannot be written; files that were written before it stay.
    ExportError
        If the key cannot be read, or has fewer than 16 bytes; nothing is written then.
    OSError
        If an old signature cannot be removed.
    """
    target = Path(path)
    digest = hashlib.sha256(content).hexdigest()
    files = {target: content, sibling_path(target, "sha256"): f"{digest}  {target.name}\n".encode()}
    if key is not None:
        files[sibling_path(target, "sig")] = f"{signature(content, key)}  {target.name}\n".encode()
    _check_outputs(target, force)
    if source is not None and source.note is not None:
        source.note("export", f"{digest} {target.name}, version {source.model_version}")
    for file, data in files.items():
        write_output(file, data, force)
    if key is None and force:
        sibling_path(target, "sig").unlink(missing_ok=True)
    return target


def _check_outputs(path: FilePath, force: bool) -> None:
    """Raise OutputError unless the file, its checksum and its signature may be written.

    With `force` they may replace files. The signature is checked even if there is no key.
    """
    for file in (path, sibling_path(path, "sha256"), sibling_path(path, "sig")):
        check_output(file, force)


def read_checked(path: Path, key: FilePath | None = None) -> bytes:
    """Return the content of a file after checking its checksum and, with a key, its signature.

    libtorch itself does not notice flipped bits.

    Raises
    ------
    ExportError
        If the file or its checksum is missing or unreadable, or the content does not have the sum
        in PATH.sha256. With a key also if the key or the signature is missing or unreadable, the
        key has fewer than 16 bytes, or the content was not signed with this key.
    """
    content = _read(path)
    expected = _first_word(sibling_path(path, "sha256"))
    if not SHA256.fullmatch(expected):
        raise ExportError(
            f"{path}.sha256 holds no SHA-256 sum of {path.name}; copy it again together with "
            f"{path.name}."
        )
    digest = hashlib.sha256(content).hexdigest()
    if digest != expected:
        raise ExportError(
            f"{path} is damaged or truncated: its SHA-256 is {digest[:12]}…, expected "
            f"{expected[:12]}…; copy it again."
        )
    if key is not None:
        signed = signature(content, key)
        file = sibling_path(path, "sig")
        if not file.exists():
            raise ExportError(
                f"A key was given, and {path} is not signed: {file} is missing; export it anew "
                "with it."
            )
        if not hmac.compare_digest(_first_word(file).encode(), signed.encode()):
            raise ExportError(
                f"{path} has no signature by the key in {key}: it was changed, or signed with "
                "another one."
            )
    return content


def _first_word(path: Path) -> str:
    """Return the text before the first space of a file, a sum or a signature; "" if it begins with
    a space or is empty. Bytes that are not UTF-8 are replaced. Raises ExportError if the file is
    missing or cannot be read.
    """
    content = _read(path, SUM_BYTES)
    return content.decode("utf-8", errors="replace").partition(" ")[0].strip()


def _read(path: Path, most: int = -1) -> bytes:
    """Return a file's content, or its first `most` bytes; -1 stands for all.

    Raises ExportError if it is missing or cannot be read.
    """
    with (
        instead(
            ExportError,
            f"{path} cannot be read",
            OSError,
            ValueError,
            do="an export is a file and its .sha256, copied together",
        ),
        path.open("rb") as file,
    ):
        return file.read(most)


def metadata_of(content: bytes, path: Path) -> Metadata:
    """Return the description inside the content of a TorchScript file, a zip archive.

    No code of the file is run, and `path` is not read. Raises ExportError, which names `path`, if
    the content is no such archive, or has no description that can be read, or one with another
    schema (version of its keys).
    """
    with (
        instead(
            ExportError, f"{path} is not a dengine export, it holds no {METADATA}", *UNREADABLE
        ),
        zipfile.ZipFile(io.BytesIO(content)) as archive,
    ):
        names = (name for name in archive.namelist() if name.endswith(f"extra/{METADATA}"))
        return check_schema(json.loads(archive.read(next(names, METADATA))), path)


def check_schema(metadata: Any, path: Path) -> Metadata:
    """Return `metadata`, the description of an exported file, if it has the present schema, 2.

    The schema is the version of its keys (`SCHEMA`). Raises ExportError, which names `path`, if it
    has another schema or is not a dict.
    """
    fields = metadata if isinstance(metadata, dict) else {}
    if fields.get("schema") != SCHEMA:
        raise ExportError(
            f"{path} has schema {fields.get('schema')}, written by dengine "
            f"{fields.get('dengine', 'of an unknown version')}; this one reads schema {SCHEMA}: "
            "export it anew, or load it with the dengine that wrote it."
        )
    return fields
