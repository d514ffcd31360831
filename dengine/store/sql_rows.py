"""From records to rows and back: decisions, traces and labels, and arrays as bytes."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..archives import read_archive
from ..errors import DataError, StoreError
from ..records import Action, Reason, RetrainReport, Source
from .records import DecidedTrace, Event, Evidence, NewLabel, StoredDecision, as_label

CHUNK = 500  # rows sent or fetched at a time

T = TypeVar("T")


def decision_row(cell_id: str, item: DecidedTrace) -> dict[str, Any]:
    """Return the row of the table `decision`."""
    decision = item.decision
    return {
        "cell_id": cell_id,
        "id": decision.id,
        "time": item.time,
        "action": decision.action.value,
        "predicted": decision.predicted.value,
        "lower": float(decision.lower),
        "upper": float(decision.upper),
        "n_success": int(decision.n_success),
        "n_failure": int(decision.n_failure),
        "embedding": None if decision.embedding is None else json.dumps(decision.embedding, default=float),
        "model_version": int(decision.model_version),
        "reason": decision.reason.value,
        "audit": bool(decision.audit),
        "propensity": float(decision.propensity),
        "content_hash": item.content_hash,
        "quarantined": item.quarantined,
        "part": item.part,
    }


def trace_row(cell_id: str, item: DecidedTrace) -> dict[str, Any]:
    """Return the row of the table `trace`."""
    channels, samples = item.trace.shape
    return {
        "cell_id": cell_id,
        "decision_id": item.decision.id,
        "channels": channels,
        "samples": samples,
        "data": pack(item.trace),
    }


def label_row(cell_id: str, label: NewLabel, seq: int, time: float, content_hash: int, quarantined: bool) -> dict[str, Any]:
    """Return the row of the table `label`; the last two are those of its decision."""
    return {
        "cell_id": cell_id,
        "decision_id": label.decision_id,
        "seq": seq,
        "time": time,
        "success": label.success,
        "source": label.source.value,
        "model_version": label.model_version,
        "point": None if label.point is None else pack(label.point),
        "content_hash": content_hash,
        "quarantined": quarantined,
        "silent": label.silent,
    }


def version_row(
    cell_id: str, report: RetrainReport, last_seq: int, time: float, state: Mapping[str, NDArray[Any]] | None
) -> dict[str, Any]:
    """Return the row of the table `model_version`, without the number of the retrain."""
    return {
        "cell_id": cell_id,
        "version": int(report.version),
        "time": time,
        "seconds": float(report.seconds),
        "n_traces": int(report.n_traces),
        "n_steps": int(report.n_steps),
        "accepted": bool(report.accepted),
        "reason": report.reason,
        "last_seq": last_seq,
        "state": None if state is None else to_npz(state),
    }


def event_row(
    cell_id: str, number: int, time: float, kind: str, text: str, data: Mapping[str, Any] | None = None, author: str = ""
) -> dict[str, Any]:
    """Return the row of the table `event`, whole: a default that the database fills in would not be in the row's sum."""
    said = None if data is None else json.dumps(data)
    row = {"cell_id": cell_id, "number": number, "time": time, "kind": kind, "text": text}
    return row | {"data": said, "author": author}


def read_decision(row: Any) -> StoredDecision:
    """Read a row of `decision` joined with its trace, and with its label where it has one."""
    return StoredDecision(
        id=row.id,
        action=Action(row.action),
        predicted=Action(row.predicted),
        audit=row.audit,
        reason=Reason(row.reason),
        lower=row.lower,
        upper=row.upper,
        embedding=None if row.embedding is None else tuple(tuple(point) for point in json.loads(row.embedding)),
        model_version=row.model_version,
        trace=unpack_trace(row),
        content_hash=row.content_hash,
        quarantined=row.quarantined,
        success=as_label(row.success),
        source=None if row.source is None else Source(row.source),
        n_success=row.n_success,
        n_failure=row.n_failure,
        propensity=row.propensity,
        part=row.part,
    )


def read_event(row: Any) -> Event:
    """Read a row of `event`."""
    return Event(row.number, row.time, row.kind, row.text, None if row.data is None else json.loads(row.data), row.author)


def read_evidence(rows: Sequence[Any]) -> Evidence:
    """Read rows of `label` joined with the bounds and the reason of their decisions."""
    return Evidence(
        seq=np.array([row.seq for row in rows], dtype=np.int64),
        lower=np.array([row.lower for row in rows], dtype=np.float64),
        upper=np.array([row.upper for row in rows], dtype=np.float64),
        success=np.array([row.success for row in rows], dtype=bool),
        novel=np.array([row.reason == Reason.NOVEL for row in rows], dtype=bool),
        silent=np.array([row.silent for row in rows], dtype=np.int64),
    )


def chunks(rows: Sequence[T]) -> Iterator[Sequence[T]]:
    """Return the rows in parts of at most CHUNK."""
    return (rows[start : start + CHUNK] for start in range(0, len(rows), CHUNK))


def pack(values: NDArray[np.float32]) -> bytes:
    """Return the values as little-endian float32, without their shape."""
    return values.astype("<f4", copy=False).tobytes()


def unpack(blob: bytes) -> NDArray[np.float32]:
    """Read what `pack` wrote, flat."""
    return np.frombuffer(blob, dtype="<f4").astype(np.float32)


def unpack_trace(row: Any) -> NDArray[np.float32]:
    """Return the (C, T) trace of a row with `channels`, `samples` and `data`."""
    return unpack(row.data).reshape(row.channels, row.samples)


def to_npz(state: Mapping[str, NDArray[Any]]) -> bytes:
    """Return arrays as an npz file; written member by member, since `np.savez` reserves the name `file`."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, values in state.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                np.save(member, values, allow_pickle=False)
    return buffer.getvalue()


def from_npz(blob: bytes, name: str) -> dict[str, NDArray[Any]]:
    """Read what `to_npz` wrote; a pickle in it is refused."""
    try:
        return read_archive(blob, name=f"a version in {name}")[0]
    except DataError as error:
        raise StoreError(f"{error} It is no version of plain arrays: restore {name} from a copy.") from error
