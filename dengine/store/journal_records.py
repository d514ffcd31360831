"""What a journal's records say: decisions with their traces, labels and events, to bytes and back. No pickle."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ..errors import StoreError
from ..records import Action, Decision, Reason, Source
from .records import DecidedTrace, NewLabel

LENGTH = struct.Struct("<I")  # of the JSON text, before it; a trace's samples follow it


@dataclass(frozen=True, slots=True)
class LateLabel:
    """A label that the store has not taken yet; time : when it was reported, in seconds."""

    label: NewLabel
    time: float


@dataclass(frozen=True, slots=True)
class LateEvent:
    """An event that the store has not taken yet."""

    kind: str
    text: str
    time: float


Record = DecidedTrace | LateLabel | LateEvent


def to_bytes(record: Record) -> bytes:
    """Return a record as a journal keeps it."""
    if isinstance(record, DecidedTrace):
        about = {
            "kind": "decision",
            "decision": asdict(record.decision),
            "shape": record.trace.shape,
            "content_hash": record.content_hash,
            "quarantined": record.quarantined,
            "time": record.time,
            "part": record.part,
        }
        return _framed(about, record.trace.astype("<f4", copy=False).tobytes())
    if isinstance(record, LateLabel):
        point = record.label.point
        said = {
            name: getattr(record.label, name) for name in ("decision_id", "success", "source", "model_version", "silent")
        }
        return _framed({"kind": "label", "time": record.time, "point": None if point is None else point.tolist()} | said)
    return _framed({"kind": "event", "event": record.kind, "text": record.text, "time": record.time})


def from_bytes(blob: bytes) -> Record:
    """Read what `to_bytes` wrote; StoreError for anything else, which its sum says was written so."""
    try:
        (length,) = LENGTH.unpack_from(blob)
        text_end = LENGTH.size + length
        about = json.loads(blob[LENGTH.size : text_end])
        return _READERS[about["kind"]](about, blob[text_end:])
    except (struct.error, ValueError, KeyError, TypeError, AttributeError) as error:
        raise StoreError(
            f"Expected a record of a journal, got what cannot be read ({error}); "
            "open the store with the dengine that wrote it."
        ) from error


def _framed(about: dict[str, Any], rest: bytes = b"") -> bytes:
    text = json.dumps(about, default=float).encode()
    return LENGTH.pack(len(text)) + text + rest


def _decision(about: dict[str, Any], samples: bytes) -> DecidedTrace:
    said = about["decision"]
    embedding = None if said["embedding"] is None else tuple(tuple(point) for point in said["embedding"])
    kinds = {"action": Action(said["action"]), "predicted": Action(said["predicted"]), "reason": Reason(said["reason"])}
    decision = Decision(**(said | kinds | {"embedding": embedding}))
    trace = np.frombuffer(samples, dtype="<f4").astype(np.float32).reshape(about["shape"])
    return DecidedTrace(decision, trace, about["content_hash"], about["quarantined"], about["time"], about["part"])


def _label(about: dict[str, Any], rest: bytes) -> LateLabel:
    point = None if about["point"] is None else np.array(about["point"], dtype=np.float32)
    source, version = Source(about["source"]), about["model_version"]
    return LateLabel(
        NewLabel(about["decision_id"], about["success"], source, version, point, about["silent"]), about["time"]
    )


def _event(about: dict[str, Any], rest: bytes) -> LateEvent:
    return LateEvent(about["event"], about["text"], about["time"])


_READERS: dict[str, Callable[[dict[str, Any], bytes], Record]] = {"decision": _decision, "label": _label, "event": _event}
