"""An exported file, whatever its format: what it is made from, what it says of itself, its checksum and its signature.

    dengine export --make-key cell.key
    dengine export engine.db --out model.ts --key cell.key          # model.ts.sha256 and model.ts.sig beside it
    load_exported("model.ts", key="cell.key")

The checksum guards against damage, not against an adversary: whoever can change the file can change the sum. The signature
says who made it, before a byte of it is run: HMAC-SHA256 (FIPS 198-1) with a secret that both sides have, so whoever can
check one can make one. Keep the key's file where only the exporter and the controller read it. An earlier file that was
signed with the same key is as valid as the newest one.
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
from pathlib import Path
from typing import Any

import torch

from .. import __version__
from ..decision import member_rules
from ..decision.code import is_code_changed
from ..decision.decider import DecisionConditions
from ..decision.intervals import SCALAR_BOUNDS
from ..decision.members import SAFE_MODES
from ..decision.policy import RULES
from ..engine.engine import DataEngine, core_of
from ..errors import ExportError, instead
from ..files import UNREADABLE, check_output, read_key, write_output
from ..model.base import Exportable
from ..records import Action, Reason, TraceSpec
from .decision import FIELDS, DecisionModule

PREFIX = "hmac-sha256:"
SCHEMA = 2
METADATA = "dengine.json"
SHA256 = re.compile(r"[0-9a-f]{64}")
SUM_BYTES = 2**16

KeyFile = str | os.PathLike[str]


def make_key(path: KeyFile) -> Path:
    """Write a new random key, 64 hexadecimal digits, to a file that is not there yet and that only its owner reads.

    ExportError where there is a file already: models were signed with it.
    """
    target = Path(path)
    try:
        with os.fdopen(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="ascii") as file:
            file.write(secrets.token_hex(32) + "\n")
            file.flush()
            os.fsync(file.fileno())
    except FileExistsError as error:
        raise ExportError(f"{target} is there already, and files may be signed with it; name a new one.") from error
    except OSError as error:
        said = f"Cannot write {target}: {error.strerror}; choose a folder that exists and is writable."
        raise ExportError(said) from error
    return target


def signature(content: bytes, key: KeyFile) -> str:
    """What a signature's line begins with, by the secret in a key's file; ExportError for what is too short to be one."""
    return PREFIX + hmac.new(read_key(key, ExportError), content, hashlib.sha256).hexdigest()


def beside(path: str | os.PathLike[str], suffix: str) -> Path:
    """Where a file's checksum (sha256, as `sha256sum --check` reads it) or its signature (sig) lies."""
    return Path(f"{os.fspath(path)}.{suffix}")


def prepared(
    engine_or_model: Any, trace: TraceSpec | None, path: str | os.PathLike[str], force: bool
) -> tuple[Exportable, DecisionModule]:
    """What an exporter starts from, and its decision as one eager module.

    ExportError for a baseline, before the first training, and where a part of the decision does not compile; OutputError
    where `path` must not be written: before the work of an export.
    """
    _check_outputs(path, force)
    if isinstance(engine_or_model, DataEngine):
        engine_or_model = core_of(engine_or_model)
    try:
        source: Exportable = engine_or_model.exported(trace)
    except AttributeError as error:
        got = type(engine_or_model).__name__
        wanted = "Expected a DataEngine or a ModelPrediction to export"
        raise ExportError(f"{wanted}, got {got}; a baseline stays in Python.") from error
    model = source.model
    if not model.rule.scriptable:
        rule = f"{type(model.rule).__name__} with the interval {model.rule.interval!r}"
        do = f"use {' or '.join(SCALAR_BOUNDS)}, and a rule that does"
        raise ExportError(f"{rule} does not compile to TorchScript; {do}.")
    changed = [each for each in (model.rule, model.spaces.module()) if each is not None and is_code_changed(each)]
    if changed:
        named = type(changed[0]).__name__
        raise ExportError(f"The code of {named} was changed after it was compiled; start Python anew, then export.")
    if model.rule_is_stale:
        raise ExportError("The rule has missed what became of a part; open the engine's store again, then export.")
    if model.spaces.module() is None:
        raise ExportError(
            f"{model.name} cannot be exported, for it has no module: give it `module()`, which returns the embedding "
            "as an nn.Module (see `Reducer.module`)."
        )
    conditions = DecisionConditions(source.trace, source.windows, source.audit_rate, source.seed)
    shape = (model.n_spaces, model.index.dim)
    decider = model.decider(conditions)
    return source, DecisionModule(source.trace, decider, shape, source.stops_all)


def describe(source: Exportable) -> dict[str, Any]:
    """What the file says of itself, readable without loading it."""
    model, index, rule = source.model, source.model.index, type(source.model.rule)
    ours = getattr(member_rules, rule.__name__, None) is rule
    named = next((name for name, rules in RULES.items() if ours and rule.__name__ in rules.values()), "")
    return {
        "schema": SCHEMA,
        "dengine": __version__,
        "torch": torch.__version__,
        "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "trace": asdict(source.trace),
        "alpha": model.classifier.alpha,
        "lower_bound": model.classifier.lower_bound,
        "interval": model.classifier.interval,
        "guarantee": named or f"{rule.__module__}:{rule.__qualname__}",
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
        "safe_modes": list(SAFE_MODES),
        "model_version": source.model_version,
        "recipe": source.recipe,
        "audit_rate": source.audit_rate,
        "seed": source.seed,
    }


def write_export(
    path: str | os.PathLike[str],
    content: bytes,
    force: bool = False,
    key: KeyFile | None = None,
    source: Exportable | None = None,
) -> Path:
    """Write a file, its checksum, and with a key its signature; note it in the store that the engine remembers in.

    OutputError where they must not or cannot be written. A file, its sum and its signature are renames of their own:
    where a kill comes between, the file is refused as damaged until it is exported again.
    """
    target, digest = Path(path), hashlib.sha256(content).hexdigest()
    written = {target: content, beside(target, "sha256"): f"{digest}  {target.name}\n".encode()}
    if key is not None:
        written[beside(target, "sig")] = f"{signature(content, key)}  {target.name}\n".encode()
    _check_outputs(target, force)
    if source is not None and source.note is not None:
        source.note("export", f"{digest} {target.name}, version {source.model_version}")
    for each, what in written.items():
        write_output(each, what, force)
    if key is None and force:
        beside(target, "sig").unlink(missing_ok=True)  # of the file that was replaced
    return target


def _check_outputs(path: str | os.PathLike[str], force: bool) -> None:
    for each in (Path(path), beside(path, "sha256"), beside(path, "sig")):
        check_output(each, force)


def read_metadata(path: str | os.PathLike[str], *, key: KeyFile | None = None) -> dict[str, Any]:
    """What a file says of itself, after checking its sum, and its signature by a key, and without loading its code."""
    return metadata_of(checked_bytes(Path(path), key), Path(path))


def checked_bytes(path: Path, key: KeyFile | None = None) -> bytes:
    """A file's content; ExportError unless its sum is as its sum file says, and, with a key, it was signed with this key.

    libtorch itself does not notice flipped bits.
    """
    _read(path, most=0)  # of the two it is the file itself that is named where both are missing
    expected = _first_word(_read(beside(path, "sha256"), SUM_BYTES))
    if not SHA256.fullmatch(expected):
        raise ExportError(f"{path}.sha256 holds no SHA-256 sum of {path.name}; copy it again together with {path.name}.")
    content = _read(path)
    found = hashlib.sha256(content).hexdigest()
    if found != expected:
        known = f"its SHA-256 is {found[:12]}…, expected {expected[:12]}…"
        raise ExportError(f"{path} is damaged or truncated: {known}; copy it again.")
    if key is not None:
        signed = signature(content, key)
        if not (file := beside(path, "sig")).exists():
            raise ExportError(f"A key was given, and {path} is not signed: {file} is missing; export it anew with it.")
        if not hmac.compare_digest(_first_word(_read(file, SUM_BYTES)).encode(), signed.encode()):
            raise ExportError(f"{path} has no signature by the key in {key}: it was changed, or signed with another one.")
    return content


def _first_word(content: bytes) -> str:
    """Of a sum's or a signature's line; the file's name follows it."""
    return (content.decode("utf-8", errors="replace").split() or [""])[0]


def _read(path: Path, most: int = -1) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(most)
    except FileNotFoundError as error:
        raise ExportError(f"{error.filename} is missing; an export is a file and its .sha256, copied together.") from error
    except (OSError, ValueError) as error:
        raise ExportError(f"{path} cannot be read: {error}.") from error


def metadata_of(content: bytes, path: Path) -> dict[str, Any]:
    """What the content of a TorchScript file says of itself."""
    said = f"{path} is not a dengine export, it holds no {METADATA}"
    with instead(ExportError, said, *UNREADABLE), zipfile.ZipFile(io.BytesIO(content)) as archive:
        name = next((n for n in archive.namelist() if n.endswith(f"extra/{METADATA}")), METADATA)
        return checked_schema(json.loads(archive.read(name)), path)


def checked_schema(metadata: Any, path: Path) -> dict[str, Any]:
    """A description of the present schema; ExportError for another."""
    known = metadata if isinstance(metadata, dict) else {}
    if known.get("schema") != SCHEMA:
        wrote = f"schema {known.get('schema')}, written by dengine {known.get('dengine', 'of an unknown version')}"
        do = "export it anew, or load it with the dengine that wrote it"
        raise ExportError(f"{path} has {wrote}; this one reads schema {SCHEMA}: {do}.")
    return known
