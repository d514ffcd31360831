"""Loading an exported file: checked before it is loaded, named after, ready at the first call."""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from .errors import ExportError
from .export import METADATA, SCHEMA, save, sum_file, write_checked
from .records import Action, Reason, TraceSpec
from .traces import as_trace, as_traces

WARM_UP = 3
TOLERANCE = 1e-4  # of a scaled embedding: another processor may add in another order
ACTIONS, REASONS = tuple(Action), tuple(Reason)


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
        return write_checked(Path(path), lambda partial: save(self.module, partial, metadata))


def read_metadata(path: str | os.PathLike[str]) -> dict[str, Any]:
    """What a file says of itself, after checking its sum and without loading its code."""
    return _metadata(checked_bytes(Path(path)), Path(path))


def load_exported(path: str | os.PathLike[str]) -> ExportedModel:
    """Check, load, warm up. Uses one torch thread, steadier by far at these sizes.

    Raises ExportError, before anything is loaded, for a file that is missing, damaged, truncated, foreign or newer, and
    after loading where this machine does not reproduce the golden embedding.
    """
    target = Path(path)
    content = checked_bytes(target)
    metadata = _metadata(content, target)
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


def checked_bytes(path: Path) -> bytes:
    """A file's content; ExportError unless its sum is right. libtorch itself does not notice flipped bits."""
    try:
        content = path.read_bytes()
        words = sum_file(path).read_text(encoding="ascii").split()
    except FileNotFoundError as error:
        raise ExportError(f"{error.filename} is missing; an export is a file and its .sha256, copied together.") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ExportError(f"{path} or its .sha256 cannot be read: {error}.") from error
    if not words or len(words[0]) != 64:
        raise ExportError(f"{sum_file(path)} holds no SHA-256 sum; copy it again together with {path.name}.")
    found = hashlib.sha256(content).hexdigest()
    if found != words[0]:
        raise ExportError(
            f"{path} is damaged or truncated: its SHA-256 is {found[:12]}…, expected {words[0][:12]}…; copy it again."
        )
    return content


def _metadata(content: bytes, path: Path) -> dict[str, Any]:
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


def _check_golden(model: ExportedModel, path: Path) -> None:
    golden = model.metadata["golden"]
    trace, expected = np.array(golden["trace"], dtype=np.float32), np.array(golden["embedding"], dtype=np.float32)
    for _ in range(WARM_UP):
        found = model.decide(trace).embedding
    if found.shape != expected.shape or not np.allclose(found, expected, atol=TOLERANCE, rtol=TOLERANCE):
        raise ExportError(f"{path} loads, but this machine does not reproduce its golden embedding; export it anew here.")
