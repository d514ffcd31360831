"""A cell's journal: where each decision, label and event is written first, on the local disk, before it is in the store.

A locked file of records behind a header. Each record has its length, its CRC-32, and a digest over the record before it, so
that a changed and a missing one are both noticed. The header says who owns the cell, up to where the store holds the
records, and the newest entry of its ledger: a store that was cut off, or put back from a copy, does not hold that one. A
small file beside it, its head, knows that entry too, for where the journal went with the store.
"""

import hashlib
import json
import os
import re
import socket
import struct
import sys
import urllib.parse
import urllib.request
import zlib
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from hashlib import blake2b
from pathlib import Path
from typing import Any

from ..errors import StoreError, instead
from ..records import Decision
from .owned_file import OwnedFile, open_plain
from .records import OF_DECISION, Event, NewLabel, StoredDecision, from_row, pack, to_row, unpack

LENGTH = struct.Struct("<I")  # of a record's JSON text, before it; the samples of a trace or a point follow it
RESERVE = 8 << 20  # bytes: 1,800 traces of 1000 samples, two and a half hours of cells that verify every part
HEADER = 256  # bytes: what this file is, who owns it, and what the store holds of it
MAGIC = b"dengine journal 2\n"
MARK = b"\x89rec"  # where a record begins, to find the next one behind a damaged length
IGNORES_CASE = sys.platform in ("win32", "darwin")  # of names in its usual file systems
FRAME = struct.Struct("<4sII16s")  # before a record: mark, length, CRC-32, digest

Record = StoredDecision | NewLabel | Event


def to_bytes(record: Record) -> bytes:
    """Return a record as a journal keeps it: its row in JSON, and the samples of its trace or point."""
    if isinstance(record, StoredDecision):
        row = to_row(record.decision) | to_row(record, *OF_DECISION) | {"shape": record.trace.shape}
        samples = pack(record.trace)
    else:
        row = to_row(record)
        samples = row.pop("point", None) or b""
    text = json.dumps([type(record).__name__, row]).encode()
    return LENGTH.pack(len(text)) + text + samples


def from_bytes(blob: bytes) -> Record:
    """Read what `to_bytes` wrote; StoreError for anything else."""
    do = "open the store with the dengine that wrote it"
    kinds = (struct.error, ValueError, KeyError, TypeError, AttributeError)
    with instead(StoreError, "Expected a record of a journal, got what cannot be read", *kinds, do=do):
        (length,) = LENGTH.unpack_from(blob)
        rest = blob[LENGTH.size + length :]
        kind, row = json.loads(blob[LENGTH.size : LENGTH.size + length])
        if kind == StoredDecision.__name__:
            trace = unpack(rest).reshape(row["shape"])
            return from_row(StoredDecision, row, decision=from_row(Decision, row), trace=trace)
        if kind == NewLabel.__name__:
            return from_row(NewLabel, row, point=unpack(rest) if rest else None)
        return from_row(Event, row)


class Journal:
    """An owned, locked journal; one thread appends, and any may read.

    path : of the file, which is made; a link is refused.
    owning : whether to lock it; else what is in it now is read, whoever owns it, and nothing is written.
    end : offset behind the last record.
    drained : offset up to which the store holds the records.
    newest : number and digest of the newest entry of the ledger that was known; None: none yet.  head : as the head has it.
    dropped : bytes of an unfinished record at the end, which a killed process left; they were never acknowledged.
    damaged : records that are not as they were written, or are missing; the others are read all the same.

    Raises StoreError where another process, or another engine of this one, owns it.
    """

    def __init__(self, path: Path, owning: bool = True) -> None:
        self.path = path
        self.drained, self.end, self.dropped, self.damaged = HEADER, HEADER, 0, 0
        self.newest: tuple[int, str] | None = None
        self.head = _head(path)
        self._digest = bytes(16)
        self._owning, self._file = owning, _opened(path, owning)
        try:
            with _using(self.path):
                self._scan()
                if owning:
                    self._file.truncate(self.end)
                    self._begin()
        except StoreError:
            self._file.close()
            raise

    @property
    def empty(self) -> bool:
        """Whether the store holds all of it."""
        return self.drained >= self.end

    def append(self, records: Sequence[bytes]) -> list[int]:
        """Add records; they survive a killed process and lost power once this returns. Returns their offsets.

        LostJournalError where the file is no longer the one at its path: what was written there, nobody will read.
        """
        offsets, framed, digest = [], bytearray(), self._digest
        for record in records:
            offsets.append(self.end + len(framed))
            digest = _digest(digest, record)
            framed += FRAME.pack(MARK, len(record), zlib.crc32(record), digest) + record
        with _using(self.path):
            self._file.write(framed, self.end)
            self._file.sync()
        if not self._file.in_place():
            raise LostJournalError(f"The journal {self.path} was deleted, moved or replaced while it was open; leave it.")
        self.end, self._digest = self.end + len(framed), digest
        return offsets

    def read(self, offset: int) -> bytes:
        """Return the record at an offset that `append` gave."""
        if (record := self._record(offset)) is None:
            raise StoreError(f"Expected the record that was written to {self.path} at byte {offset}, found another.")
        return record

    def records(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield the whole records that are not drained: where each begins and ends, and the record."""
        begin = self.drained
        while begin < self.end:
            if (record := self._record(begin)) is not None:
                at, begin = begin, begin + FRAME.size + len(record)
                yield at, begin, record
                continue
            block = self._file.read(1 << 20, begin + 1)  # the next one stands behind the damaged one
            at = block.find(MARK)
            if at < 0 and len(block) < 1 << 20:
                return
            begin += 1 + (at if at >= 0 else len(block) - len(MARK))

    def mark(self, newest: tuple[int, str] | None) -> None:
        """Note what the store holds by now; without a sync, for to give it a record twice is harmless."""
        self.newest = newest
        with _using(self.path):
            self._file.write(self._header(), 0)
        if newest is None:
            return
        path = head_path(self.path)
        # An older head is no harm.
        with suppress(OSError), os.fdopen(open_plain(path, os.O_WRONLY | os.O_CREAT), "wb") as head:
            head.write(json.dumps(newest).ljust(HEADER).encode())

    def clear(self) -> None:
        """Forget all records; the store holds them now. `reserve` then makes room, on the disk, for others."""
        with _using(self.path):
            self._file.truncate(HEADER)
            self.drained = self.end = HEADER
            self._digest, self.damaged = bytes(16), 0
            self._file.write(self._header(), 0)

    def reserve(self) -> None:
        """Reserve room, and return once that is on the disk."""
        with _using(self.path):
            self._file.reserve(HEADER + RESERVE)

    def remake(self) -> None:
        """Make the lost file anew, with what is not drained where it was."""
        lost, self._file = self._file, _opened(self.path)
        try:
            with _using(self.path):
                self._file.write(lost.read(self.end - self.drained, self.drained), self.drained)
                self._begin()
        except StoreError:
            lost, self._file = self._file, lost
            raise
        finally:
            lost.close()

    def close(self) -> None:
        """Give the cell free. The file stays: what it knows of the ledger is compared by the next engine."""
        if self._owning and not self._file.closed:
            with _using(self.path):
                self._file.truncate(HEADER if self.empty else self.end)
        self._file.close()

    def _header(self) -> bytes:
        known = json.dumps({"owner": owner()[:80], "drained": self.drained, "newest": self.newest})
        return (MAGIC + known.encode()).ljust(HEADER, b"\0")

    def _begin(self) -> None:
        """Write the header, and reserve room."""
        self._file.write(self._header(), 0)
        self.reserve()

    def _scan(self) -> None:
        """Find the end, and what is damaged on the way; all from where the store has the records."""
        size = self._file.size
        if size == 0:
            return
        head = self._file.read(HEADER, 0)
        if not head.startswith(MAGIC):
            raise StoreError(f"Expected a journal of dengine, found another file: {self.path}; move it away.")
        try:
            self.drained, self.newest, _ = _known(head)
        except (ValueError, KeyError, TypeError):  # all of it is drained again, which is harmless
            self.damaged += 1
        before: bytes | None = None  # of the first nothing is known: those before it may be gone
        begin = self.drained = min(max(self.drained, HEADER), size)
        self.end = size
        for at, end, record in self.records():
            digest: bytes = FRAME.unpack(self._file.read(FRAME.size, at))[3]
            follows = before is None or digest == _digest(before, record)
            self.damaged += at > begin or not follows
            before, begin = digest, end
        left = self._file.read(size - begin, begin)
        self.end, self.dropped, self._digest = begin, len(left.rstrip(b"\0")), before or bytes(16)

    def _record(self, offset: int) -> bytes | None:
        """The record at an offset; None where it is not as it was written."""
        frame = self._file.read(FRAME.size, offset)
        if len(frame) < FRAME.size or not frame.startswith(MARK):
            return None
        _, length, crc, _ = FRAME.unpack(frame)
        if length > self._file.size - offset - FRAME.size:
            return None
        record = self._file.read(length, offset + FRAME.size)
        return record if zlib.crc32(record) == crc else None


class LostJournalError(StoreError):
    """The journal's file is not at its path any more."""


def _digest(before: bytes, record: bytes) -> bytes:
    return blake2b(before + record, digest_size=16).digest()


def _using(path: Path, owning: bool = True) -> AbstractContextManager[None]:
    do = "free some space there, or make its folder writable"
    do = do if owning else "read it as the user that its cell runs as"
    return instead(StoreError, f"Could not use the journal {path}", OSError, do=do)


def _opened(path: Path, owning: bool = True) -> OwnedFile:
    """Open a journal's file; StoreError that names its owner, where another engine has it."""
    with _using(path, owning):
        try:
            return OwnedFile(path, owning)
        except BlockingIOError as error:
            try:
                with path.open("rb") as file:
                    holder = _known(file.read(HEADER))[2]
            except (OSError, ValueError, KeyError, TypeError):
                holder = "another engine"
            raise owned_by(holder, str(path)) from error


def journal_path(url: Any, cell_id: str) -> Path:
    """Where a cell's journal lies: beside an SQLite file, else in the user's folder of state, `XDG_STATE_HOME`."""
    name = urllib.parse.quote(cell_id, safe="")
    if IGNORES_CASE:  # or cell A and cell a would have one journal
        name = re.sub("(?<!%)(?<!%[0-9A-F])[A-Z]", lambda letter: f"%{ord(letter[0]):X}", name)
    if url.get_backend_name() == "sqlite":
        return Path(f"{sqlite_file(url)}.{name}.journal")
    state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "dengine"
    where = hashlib.sha256(f"{url.host}:{url.port}/{url.database}/{cell_id}".encode()).hexdigest()[:12]
    return state / f"{name[:60]}.{where}.journal"


def sqlite_file(url: Any) -> Path:
    """The file of an SQLite database, by whatever link or URI of SQLite's own it is named: one file has one owner."""
    named = str(url.database)
    of_uri = named.startswith("file:")
    return Path(urllib.request.url2pathname(urllib.parse.urlsplit(named).path) if of_uri else named).resolve()


def head_path(journal: Path) -> Path:
    return journal.with_name(f"{journal.name}.head")


def newest_known(path: Path) -> set[tuple[int, str]]:
    """Numbers and digests of the ledger's newest entry that a journal and its head know, whoever owns them."""
    found = {_head(path)}
    with suppress(OSError, ValueError, KeyError, TypeError), path.open("rb") as file:
        found.add(_known(file.read(HEADER))[1])
    return {each for each in found if each is not None}


def waiting_records(path: Path) -> list[Record]:
    """Return what a journal holds that its store has not taken, whoever owns it.

    If several decisions share an id, only the last is returned.
    """
    journal = Journal(path, owning=False)
    try:
        records = [from_bytes(blob) for _, _, blob in journal.records()]
    finally:
        journal.close()
    newest = {each.decision.id: each for each in records if isinstance(each, StoredDecision)}
    return [each for each in records if not isinstance(each, StoredDecision) or newest[each.decision.id] is each]


def _head(journal: Path) -> tuple[int, str] | None:
    with suppress(OSError, ValueError, TypeError):
        number, digest = json.loads(head_path(journal).read_bytes())
        return int(number), str(digest)
    return None


def _known(head: bytes) -> tuple[int, tuple[int, str] | None, str]:
    """What a header says: the offset up to which the store has the records, its newest entry, the owner."""
    known = json.loads(head[len(MAGIC) :].rstrip(b"\0"))
    newest = known["newest"]
    return int(known["drained"]), None if newest is None else (int(newest[0]), str(newest[1])), str(known["owner"])


def forked(pid: int, name: str) -> StoreError:
    """Return the error for a fork of the process that opened what this names."""
    got, do = f"its fork {os.getpid()}", "open it after the fork, in the process that uses it"
    return StoreError(f"Expected the process that opened {name}, {pid}, got {got}; {do}.")


def owner() -> str:
    """Return who this process is, for the one that finds the cell taken."""
    return f"process {os.getpid()} on {socket.gethostname()}"


def owned_by(holder: str, name: str) -> StoreError:
    """Return the error for a second engine on a cell."""
    do = "close that engine first, ask its page or its HTTP where it is served, or give this one a cell_id of its own"
    return StoreError(f"Expected a cell that no other engine runs on, but {holder} owns {name}; {do}.")
