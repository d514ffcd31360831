"""The journal beside a store: what a store could not take, kept on the local disk until it can.

A file of records, each with its length and CRC-32, after a header that names the owner. The file is locked as long as an
engine owns the cell, and its space is reserved beforehand, so that a full disk has room for some hours of labels.

What a journal's records say: decisions with their traces, labels and events, to bytes and back. No pickle.
"""

from __future__ import annotations

import fcntl
import json
import os
import socket
import struct
import weakref
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import StoreError
from ..records import Action, Decision, Reason, Source
from .records import NewLabel, StoredDecision

LENGTH = struct.Struct("<I")  # of the JSON text, before it; a trace's samples follow it


class JournalError(StoreError):
    """The journal's own file cannot be written or read, whatever becomes of the store."""


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


Record = StoredDecision | LateLabel | LateEvent


def to_bytes(record: Record) -> bytes:
    """Return a record as a journal keeps it."""
    if isinstance(record, StoredDecision):
        about = {
            "kind": "decision",
            "decision": asdict(record.decision),
            "shape": record.trace.shape,
            "content_hash": record.content_hash,
            "quarantined": record.quarantined,
            "time": record.time,
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
        raise JournalError(
            f"Expected a record of a journal, got what cannot be read ({error}); "
            "open the store with the dengine that wrote it."
        ) from error


def _framed(about: dict[str, Any], rest: bytes = b"") -> bytes:
    text = json.dumps(about, default=float).encode()
    return LENGTH.pack(len(text)) + text + rest


def _decision(about: dict[str, Any], samples: bytes) -> StoredDecision:
    said = about["decision"]
    embedding = None if said["embedding"] is None else tuple(tuple(point) for point in said["embedding"])
    kinds = {"action": Action(said["action"]), "predicted": Action(said["predicted"]), "reason": Reason(said["reason"])}
    decision = Decision(**(said | kinds | {"embedding": embedding}))
    trace = np.frombuffer(samples, dtype="<f4").astype(np.float32).reshape(about["shape"])
    return StoredDecision(decision, trace, about["content_hash"], about["quarantined"], about["time"])


def _label(about: dict[str, Any], rest: bytes) -> LateLabel:
    point = None if about["point"] is None else np.array(about["point"], dtype=np.float32)
    source, version = Source(about["source"]), about["model_version"]
    return LateLabel(
        NewLabel(about["decision_id"], about["success"], source, version, point, about["silent"]), about["time"]
    )


def _event(about: dict[str, Any], rest: bytes) -> LateEvent:
    return LateEvent(about["event"], about["text"], about["time"])


_READERS: dict[str, Callable[[dict[str, Any], bytes], Record]] = {"decision": _decision, "label": _label, "event": _event}


RESERVE = 8 << 20  # bytes: 1,800 traces of 1000 samples, two and a half hours of cells that verify every part
HEADER = 256  # bytes: what this file is, and who owns it
MAGIC = b"dengine journal 1\n"
FRAME = struct.Struct("<II")  # of a record: length, CRC-32
SYNC = getattr(os, "fdatasync", os.fsync)  # not every system has the quicker one


class Journal:
    """An owned, locked journal.

    path : of the file, which is made; a link is refused.
    dropped : bytes of an unfinished record at the end, which a killed process left; they were never acknowledged.
    damaged : offsets of records before the end that are not as they were written; the others are read all the same.

    Raises StoreError where another process, or another engine of this one, owns it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._fd = _locked(path)
        self.damaged: list[int] = []
        try:
            self._end, self.dropped = self._scan()
            os.ftruncate(self._fd, self._end)
            os.pwrite(self._fd, _header(), 0)
            self._reserve()
            os.fsync(self._fd)
        except OSError as error:
            os.close(self._fd)
            raise _unusable(path, error) from error
        except StoreError:
            os.close(self._fd)
            raise
        _OPEN.add(self)

    @property
    def end(self) -> int:
        """Offset behind the last record."""
        return self._end

    @property
    def open(self) -> bool:
        """Whether it was not closed."""
        return self._fd >= 0

    @property
    def empty(self) -> bool:
        """Whether nothing waits."""
        return self._end == HEADER

    def append(self, records: Sequence[bytes]) -> list[int]:
        """Add records; they survive a killed process and lost power once this returns. Returns their offsets."""
        offsets, framed = [], bytearray()
        for record in records:
            offsets.append(self._end + len(framed))
            framed += FRAME.pack(len(record), zlib.crc32(record)) + record
        try:
            written = os.pwrite(self._fd, framed, self._end)
            if written < len(framed):
                raise OSError(f"only {written} of {len(framed)} bytes were written")
            SYNC(self._fd)
        except OSError as error:
            raise _unusable(self.path, error) from error
        self._end += len(framed)
        return offsets

    def read(self, offset: int) -> bytes:
        """Return the record at an offset that `append` gave."""
        length, crc = FRAME.unpack(os.pread(self._fd, FRAME.size, offset))
        record = os.pread(self._fd, length, offset + FRAME.size)
        if zlib.crc32(record) != crc:
            raise JournalError(f"Expected the record that was written to {self.path} at byte {offset}, found another.")
        return record

    def records(self, begin: int = HEADER) -> Iterator[tuple[int, bytes]]:
        """Return the records from an offset on, each with the offset behind it."""
        while begin < self._end:
            if begin in self.damaged:
                begin = self._behind(begin)
                continue
            record = self.read(begin)
            begin += FRAME.size + len(record)
            yield begin, record

    def clear(self) -> None:
        """Forget all records; the store holds them now."""
        os.ftruncate(self._fd, HEADER)
        self._end, self.damaged = HEADER, []
        self._reserve()
        os.fsync(self._fd)

    def close(self) -> None:
        """Give the cell free; an empty journal goes, one that holds something stays for the next engine."""
        if not self.open:
            return
        if self.empty:
            self.path.unlink(missing_ok=True)
        else:
            os.ftruncate(self._fd, self._end)
        self.let_go()

    def let_go(self) -> None:
        """Close the file and no more: in a forked child, which owns nothing."""
        if self.open:
            os.close(self._fd)
            self._fd = -1

    def _scan(self) -> tuple[int, int]:
        """Return where the last whole record ends, and how many bytes of an unfinished one follow."""
        size = os.fstat(self._fd).st_size
        if size == 0:
            return HEADER, 0
        if os.pread(self._fd, len(MAGIC), 0) != MAGIC:
            raise StoreError(f"Expected a journal of dengine, found another file: {self.path}; move it away.")
        begin = HEADER
        while (whole := self._is_whole(begin)) or self._is_whole(self._behind(begin)):  # no process leaves one behind it
            self.damaged += [] if whole else [begin]
            begin = self._behind(begin)
        left = os.pread(self._fd, size - begin, begin) if size > begin else b""
        return begin, len(left.rstrip(b"\0"))

    def _behind(self, offset: int) -> int:
        """Return the offset behind a record, by what it says of its length; the same where no record begins."""
        frame = os.pread(self._fd, FRAME.size, offset)
        length = FRAME.unpack(frame)[0] if len(frame) == FRAME.size else 0
        return offset + FRAME.size + length if length else offset

    def _is_whole(self, offset: int) -> bool:
        """Whether a record at an offset is there as it was written."""
        left = os.fstat(self._fd).st_size - offset - FRAME.size
        if left <= 0:
            return False
        length, crc = FRAME.unpack(os.pread(self._fd, FRAME.size, offset))
        return bool(0 < length <= left and zlib.crc32(os.pread(self._fd, length, offset + FRAME.size)) == crc)

    def _reserve(self) -> None:
        try:
            os.posix_fallocate(self._fd, 0, HEADER + RESERVE)
        except (AttributeError, OSError):  # no room, or no way to reserve it: then without, as far as it goes
            os.ftruncate(self._fd, max(self._end, HEADER))


_OPEN: weakref.WeakSet[Journal] = weakref.WeakSet()


def _let_all_go() -> None:
    for journal in list(_OPEN):
        journal.let_go()


os.register_at_fork(after_in_child=_let_all_go)  # or a worker that outlives its engine would keep the cell


def _locked(path: Path) -> int:
    """Open and lock a file that is still the one at its path once the lock is held."""
    while True:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        except OSError as error:
            raise _unusable(path, error) from error
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(fd), path.lstat()):
                return fd
        except BlockingIOError as error:
            owner = os.pread(fd, HEADER, 0)[len(MAGIC) :].rstrip(b"\0").decode("utf-8", "replace")
            os.close(fd)
            raise owned_by(owner or "another engine", str(path)) from error
        except FileNotFoundError:
            pass  # its owner went, and took the file along, between the opening and the lock: once more
        os.close(fd)


def _header() -> bytes:
    return (MAGIC + owner().encode("utf-8", "replace"))[:HEADER].ljust(HEADER, b"\0")


def owner() -> str:
    """Return who this process is, for the one that finds the cell taken."""
    return f"process {os.getpid()} on {socket.gethostname()}"


def owned_by(holder: str, name: str) -> StoreError:
    """Return the error for a second engine on a cell."""
    return StoreError(
        f"Expected a cell that no other engine runs on, but {holder} owns {name}; "
        "close that engine first, or give this one a cell_id of its own."
    )


def _unusable(path: Path, error: OSError) -> JournalError:
    return JournalError(f"Could not use the journal {path}: {error}; free some space there, or make its folder writable.")
