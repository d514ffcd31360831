"""An exported file, whatever its format: what it is made from, what it says of itself, and its checksum.

The checksum guards against damage, not against an adversary: whoever can change the file can change the sum. What does is a
signature, by `key`.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import time
import zipfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from .. import __version__
from ..decision.policy import RULES
from ..decision.rule import SAFE_MODE, SCALAR_BOUNDS
from ..errors import ExportError
from ..model.base import Exportable
from ..records import Action, Reason, TraceSpec
from .module import FIELDS, DecisionModule
from .signing import (
    KeyFile,
    check_signature,
    earlier_signatures,
    listed,
    read_key,
    signature,
    signature_file,
    write_signatures,
)

SCHEMA = 2  # 1, until 0.2: no parts, no stops, no rule that learns
METADATA = "dengine.json"
SCRIPTABLE = "conv, pca or rocket"


def source_of(engine_or_model: Any, trace: TraceSpec | None) -> Exportable:
    """What an exporter starts from; ExportError for a rival, and before the first training."""
    try:
        exported = engine_or_model.exported
    except AttributeError as error:
        raise ExportError(
            f"Expected a DataEngine or a ModelPrediction to export, got {type(engine_or_model).__name__}; "
            "a rival method stays in Python."
        ) from error
    source: Exportable = exported(trace)
    return source


def decision_module(source: Exportable) -> DecisionModule:
    """The decision of a fitted model as one eager module; ExportError where a part of it does not compile."""
    model = source.model
    if not model.rule.scriptable:
        raise ExportError(
            f"{type(model.rule).__name__} with the interval {model.rule.interval!r} does not compile to TorchScript; "
            f"use {' or '.join(SCALAR_BOUNDS)}, and a rule that does."
        )
    if model.untold:
        raise ExportError("The rule has missed what became of a part; open the engine's store again, then export.")
    predictor = model.predictor
    if model.spaces.module() is None:
        raise ExportError(f"{model.name} cannot be scripted: it has no module; use {SCRIPTABLE} instead.")
    size = model.n_spaces, model.index.dim
    return DecisionModule(source.trace, predictor, *size, source.audit_rate, source.seed, source.stops_all)


def describe(source: Exportable) -> dict[str, Any]:
    """What the file says of itself, readable without loading it."""
    model, index = source.model, source.model.index
    return {
        "schema": SCHEMA,
        "dengine": __version__,
        "torch": torch.__version__,
        "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "trace": asdict(source.trace),
        "alpha": model.classifier.alpha,
        "lower_bound": model.classifier.lower_bound,
        "interval": model.classifier.interval,
        "guarantee": _guarantee_of(model.rule),
        "stops": "all" if source.stops_all else "some",
        "novelty": model.novelty,
        "spaces": model.n_spaces,
        "dim": index.dim,
        "capacity": index.capacity,
        "references": len(index),
        "references_sha256": index.digest(),
        "fields": list(FIELDS),
        "actions": [str(a) for a in Action],
        "reasons": [str(r) for r in Reason],
        "safe_modes": list(SAFE_MODE),
        "model_version": source.model_version,
        "recipe": source.recipe,
        "audit_rate": source.audit_rate,
        "seed": source.seed,
    }


def _guarantee_of(rule: Any) -> str:
    """What `Policy.guarantee` calls a rule of this class."""
    own = f"{type(rule).__module__}:{type(rule).__qualname__}"
    return next((name for name, rules in RULES.items() if own in rules.values()), own)


def write_export(
    target: Path, write: Callable[[Path], None], key: KeyFile | None, source: Exportable | None = None
) -> Path:
    """`write_checked`, signed with a key, and noted in the store that the engine remembers in.

    The new signature stands beside the earlier one until the file is replaced, so that one of them always fits.
    """
    secret = None if key is None else read_key(key)
    earlier = earlier_signatures(target)
    signed: list[str] = []

    def whole(partial: Path) -> None:
        write(partial)
        content = partial.read_bytes()
        if secret is not None:
            signed.append(signature(content, secret))
            write_signatures(target, [*earlier[-1:], *signed])
        if source is not None and source.note is not None:
            source.note("export", f"{hashlib.sha256(content).hexdigest()} {target.name}, version {source.model_version}")

    written = write_checked(target, whole)
    if signed:
        write_signatures(target, signed)
    elif earlier:
        signature_file(target).unlink(missing_ok=True)  # of the file that was replaced
    return written


def write_checked(target: Path, write: Callable[[Path], None]) -> Path:
    """Write a file beside its name, sum it, and move both into place, so that a killed export leaves no half file."""
    partial = target.with_name(target.name + ".partial")
    try:
        partial.touch()  # torch names an unwritable place in words of its own
        write(partial)
        digest = hashlib.sha256(partial.read_bytes()).hexdigest()
        sum_file(target).write_text(f"{digest}  {target.name}\n", encoding="utf-8")
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


def read_metadata(path: str | os.PathLike[str], *, key: KeyFile | None = None) -> dict[str, Any]:
    """What a file says of itself, after checking its sum, and its signature by a key, and without loading its code."""
    return metadata_of(checked_bytes(Path(path), key), Path(path))


def checked_bytes(path: Path, key: KeyFile | None = None) -> bytes:
    """A file's content; ExportError unless its sum is right, and, with a key, its signature.

    libtorch itself does not notice flipped bits. The sum file has two lines while a file is being replaced.
    """
    try:
        content = path.read_bytes()
        if key is not None:
            check_signature(path, content, key)
        sums = [each for each in listed(sum_file(path).read_text(encoding="utf-8"), path.name) if len(each) == 64]
    except FileNotFoundError as error:
        raise ExportError(f"{error.filename} is missing; an export is a file and its .sha256, copied together.") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ExportError(f"{path} or its .sha256 cannot be read: {error}.") from error
    if not sums:
        raise ExportError(f"{sum_file(path)} holds no SHA-256 sum of {path.name}; copy it again together with {path.name}.")
    found = hashlib.sha256(content).hexdigest()
    if found not in sums:
        raise ExportError(
            f"{path} is damaged or truncated: its SHA-256 is {found[:12]}…, expected {sums[-1][:12]}…; copy it again."
        )
    return content


def metadata_of(content: bytes, path: Path) -> dict[str, Any]:
    """What the content of a TorchScript file says of itself."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            name = next(n for n in archive.namelist() if n.endswith(f"extra/{METADATA}"))
            metadata = json.loads(archive.read(name))
    except (zipfile.BadZipFile, StopIteration, ValueError) as error:
        raise ExportError(f"{path} is not a dengine export: it holds no {METADATA}.") from error
    return checked_schema(metadata, path)


def checked_schema(metadata: Any, path: Path) -> dict[str, Any]:
    """A description that this version can read; ExportError for a newer one."""
    schema = metadata.get("schema") if isinstance(metadata, dict) else None
    if not isinstance(schema, int) or schema > SCHEMA:
        made_by = metadata.get("dengine", "an unknown version") if isinstance(metadata, dict) else "something else"
        raise ExportError(
            f"{path} has schema {schema}, written by dengine {made_by}; this one reads up to {SCHEMA}: upgrade it."
        )
    return dict(metadata)
