"""A cell's journal: the write-ahead log on the local disk, from which the store is filled. The
class `Journal` is one locked file: a header, then the records (decisions, labels, events) in the
order in which they were written. `encode_record` and `decode_record` convert a record to bytes and
back; other functions return a journal's path, read the records that its store has not taken, and
describe the process that owns a cell. `Outbox` writes the journal while a cell runs; backup and
verification read it.

Each record has its length, its CRC-32, and a digest over itself and the record before, so that a
changed record and a missing one are both noticed. The header names the process that owns the cell,
the offset up to which the store holds the records, and the newest entry of the cell's ledger that
the store held: a store that was cut off or restored from an older copy lacks that entry. A small
file beside the journal, its head, repeats the entry, for the case that the journal was lost
together with the store.
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

# Length of a record's JSON text, before it; the samples of a trace or point follow it.
LENGTH = struct.Struct("<I")
# Bytes: 1,800 traces of 1000 samples, or 2.5 hours of a cell that verifies every part.
RESERVE = 8 << 20
HEADER = 256  # bytes of the header; the first record begins there
MAGIC = b"dengine journal 2\n"
MARK = b"\x89rec"  # where a record begins, to find the next one behind a damaged length
IGNORES_CASE = sys.platform in ("win32", "darwin")  # of names in its usual file systems
FRAME = struct.Struct("<4sII16s")  # before a record: mark, length, CRC-32, digest

Record = StoredDecision | NewLabel | Event


def encode_record(record: Record) -> bytes:
    """Return a record (decision, label or event) as bytes, without the journal's frame.

    They are the length of a JSON text, this text with the record's kind and fields, and the float32
    samples of a decision's trace or a label's point.
    """
    if isinstance(record, StoredDecision):
        row = to_row(record.decision) | to_row(record, *OF_DECISION) | {"shape": record.trace.shape}
        samples = pack(record.trace)
    else:
        row = to_row(record)
        samples = row.pop("point", None) or b""
    text = json.dumps([type(record).__name__, row]).encode()
    return LENGTH.pack(len(text)) + text + samples


def decode_record(blob: bytes) -> Record:
    """Return the record that `encode_record` wrote; raise StoreError for other bytes."""
    do = "open the store with the dengine that wrote it"
    errors = (struct.error, ValueError, KeyError, TypeError, AttributeError)
    with instead(
        StoreError, "Expected a record of a journal, got what cannot be read", *errors, do=do
    ):
        (length,) = LENGTH.unpack_from(blob)
        samples = blob[LENGTH.size + length :]
        kind, row = json.loads(blob[LENGTH.size : LENGTH.size + length])
        if kind == StoredDecision.__name__:
            trace = unpack(samples).reshape(row["shape"])
            return from_row(StoredDecision, row, decision=from_row(Decision, row), trace=trace)
        if kind == NewLabel.__name__:
            return from_row(NewLabel, row, point=unpack(samples) if samples else None)
        return from_row(Event, row)


class Journal:
    """An open journal file. One thread appends; any thread may read.

    Opening reads all records that the store does not hold yet, and checks them. If `owning`, an
    unfinished record at the end is cut off, the header is written and disk space is reserved.

    Parameters
    ----------
    path : Path
        The file; it is created if need be. A symbolic link is refused.
    owning : bool, default True
        Lock the file and write to it. False: read what is in it now, whoever owns it.

    Attributes
    ----------
    end : int
        Offset behind the last record, in bytes.
    drained_to : int
        Offset up to which the store holds the records; set by the outbox.
    newest_entry : (int, str) or None
        Number and digest of the newest ledger entry that the header names; None: no entry yet.
    head_entry : (int, str) or None
        The same as the head beside the journal has it.
    dropped : int
        Bytes of an unfinished record at the end, left by a killed process and cut off. That record
        was never acknowledged.
    damaged : int
        Records that are missing or not as they were written. The others are read all the same.

    Raises
    ------
    StoreError
        If another process, or another engine of this one, owns the file, and if the file is no
        journal or cannot be used.
    """

    def __init__(self, path: Path, owning: bool = True) -> None:
        self.path = path
        self.drained_to = HEADER
        self.end = HEADER
        self.dropped = 0
        self.damaged = 0
        self.newest_entry: tuple[int, str] | None = None
        self.head_entry = _read_head(path)
        self._digest = bytes(16)
        self._owning = owning
        self._file = _open_file(path, owning)
        try:
            with _os_errors(self.path):
                self._scan()
                if owning:
                    self._file.truncate(self.end)
                    self._write_header_and_reserve()
        except StoreError:
            self._file.close()
            raise

    @property
    def is_drained(self) -> bool:
        """Whether the store holds all records."""
        return self.drained_to >= self.end

    def append(self, records: Sequence[bytes]) -> list[int]:
        """Append encoded records behind the last one, and return when they are synced to the disk.

        If it fails, the journal's end stays where it was, and the same records can be appended
        again.

        Parameters
        ----------
        records : sequence of bytes
            As `encode_record` returns them.

        Returns
        -------
        list of int
            The offset of each record in bytes, for `read`.

        Raises
        ------
        LostJournalError
            If the open file is no longer the one at its path, so that nobody would read it.
        StoreError
            If the disk fails.
        """
        offsets = []
        framed = bytearray()
        digest = self._digest
        for record in records:
            offsets.append(self.end + len(framed))
            digest = _chain_digest(digest, record)
            framed += FRAME.pack(MARK, len(record), zlib.crc32(record), digest) + record
        with _os_errors(self.path):
            self._file.write(framed, self.end)
            self._file.sync()
        if not self._file.in_place():
            raise LostJournalError(
                f"The journal {self.path} was deleted, moved or replaced while it was open; "
                "leave it."
            )
        self.end += len(framed)
        self._digest = digest
        return offsets

    def read(self, offset: int) -> bytes:
        """Return the encoded record at an offset that `append` returned.

        Raise StoreError if no intact record begins there.
        """
        if (record := self._read_record(offset)) is None:
            raise StoreError(
                f"Expected the record that was written to {self.path} at byte {offset}, found "
                "another."
            )
        return record

    def undrained_records(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield (offset, end, encoded record) of the records that the store lacks, oldest first.

        Damaged records are skipped: the search goes on at the next one.
        """
        begin = self.drained_to
        while begin < self.end:
            if (record := self._read_record(begin)) is not None:
                offset = begin
                begin += FRAME.size + len(record)
                yield offset, begin, record
                continue
            # The next record stands behind the damaged one.
            block = self._file.read(1 << 20, begin + 1)
            mark = block.find(MARK)
            if mark < 0 and len(block) < 1 << 20:
                return
            begin += 1 + (mark if mark >= 0 else len(block) - len(MARK))

    def save_newest_entry(self, newest: tuple[int, str] | None) -> None:
        """Write the newest ledger entry and `drained_to` to the header, the entry also to the head.

        Set `newest_entry`. Nothing is synced: an older header is harmless, since the store ignores
        a record that it is given twice. Raise StoreError if the header cannot be written; a failure
        of the head is ignored. None leaves the head as it is.
        """
        self.newest_entry = newest
        with _os_errors(self.path):
            self._file.write(self._header(), 0)
        if newest is None:
            return
        path = head_path(self.path)
        # An older head is harmless.
        with suppress(OSError), os.fdopen(open_plain(path, os.O_WRONLY | os.O_CREAT), "wb") as head:
            head.write(json.dumps(newest).ljust(HEADER).encode())

    def clear(self) -> None:
        """Remove all records, drained or not; the caller has made sure that the store holds them.

        The file is cut off behind its header, which frees the reserved space: call `reserve`
        afterwards. Raise StoreError if the file cannot be written.
        """
        with _os_errors(self.path):
            self._file.truncate(HEADER)
            self.drained_to = HEADER
            self.end = HEADER
            self._digest = bytes(16)
            self.damaged = 0
            self._file.write(self._header(), 0)

    def reserve(self) -> None:
        """Reserve disk space for at least RESERVE bytes of records, and sync that.

        On a full disk nothing is reserved, and no error raised.
        """
        with _os_errors(self.path):
            self._file.reserve(HEADER + RESERVE)

    def recreate(self) -> None:
        """Create a new file at the path of a journal that was deleted, moved or replaced.

        The records that are not drained are copied from the lost file to the same offsets. Raise
        StoreError if the new file cannot be written; the journal then still uses the lost one.
        """
        lost = self._file
        self._file = _open_file(self.path)
        try:
            with _os_errors(self.path):
                self._file.write(
                    lost.read(self.end - self.drained_to, self.drained_to), self.drained_to
                )
                self._write_header_and_reserve()
        except StoreError:
            lost, self._file = self._file, lost
            raise
        finally:
            lost.close()

    def close(self) -> None:
        """Cut off the reserved space, and the records if all are drained; close, unlock the file.

        The file stays with its header, for the next engine to compare with the ledger. A journal
        that was opened for reading is only closed. Raise StoreError, and leave it open, if the cut
        fails.
        """
        if self._owning and not self._file.closed:
            with _os_errors(self.path):
                self._file.truncate(HEADER if self.is_drained else self.end)
        self._file.close()

    def _header(self) -> bytes:
        """Return the header, HEADER bytes: MAGIC, then JSON, padded with zeros.

        The JSON has this process as the owner, `drained_to` and `newest_entry`.
        """
        fields = {
            "owner": describe_process()[:80],
            "drained": self.drained_to,
            "newest": self.newest_entry,
        }
        return (MAGIC + json.dumps(fields).encode()).ljust(HEADER, b"\0")

    def _write_header_and_reserve(self) -> None:
        """Write the header, and reserve disk space for records."""
        self._file.write(self._header(), 0)
        self.reserve()

    def _scan(self) -> None:
        """Read the header and all undrained records, and set the attributes that describe them.

        These are `drained_to`, `newest_entry`, `end`, `dropped`, `damaged` and the digest of the
        last record. With a damaged header all records count as undrained. Nothing is written. Raise
        StoreError if the file is no journal.
        """
        size = self._file.size
        if size == 0:
            return
        header = self._file.read(HEADER, 0)
        if not header.startswith(MAGIC):
            raise StoreError(
                f"Expected a journal of dengine, found another file: {self.path}; move it away."
            )
        try:
            self.drained_to, self.newest_entry, _ = _parse_header(header)
        except (ValueError, KeyError, TypeError):  # all of it is drained again, which is harmless
            self.damaged += 1
        # The first record is not checked: those before it may be gone.
        previous: bytes | None = None
        self.drained_to = min(max(self.drained_to, HEADER), size)
        begin = self.drained_to
        self.end = size
        for offset, end, record in self.undrained_records():
            digest: bytes = FRAME.unpack(self._file.read(FRAME.size, offset))[3]
            follows = previous is None or digest == _chain_digest(previous, record)
            self.damaged += offset > begin or not follows
            previous = digest
            begin = end
        rest = self._file.read(size - begin, begin)
        self.end = begin
        self.dropped = len(rest.rstrip(b"\0"))
        self._digest = previous or bytes(16)

    def _read_record(self, offset: int) -> bytes | None:
        """Return the encoded record at an offset, without its frame.

        None if no record begins there, or if it is cut off or its CRC-32 differs.
        """
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


def _chain_digest(previous: bytes, record: bytes) -> bytes:
    """Return the digest (BLAKE2b, 16 bytes) over the digest of the record before and a record."""
    return blake2b(previous + record, digest_size=16).digest()


def _os_errors(path: Path, owning: bool = True) -> AbstractContextManager[None]:
    """Context manager that raises StoreError, with the journal's path, for an OSError."""
    do = "free some space there, or make its folder writable"
    do = do if owning else "read it as the user that its cell runs as"
    return instead(StoreError, f"Could not use the journal {path}", OSError, do=do)


def _open_file(path: Path, owning: bool = True) -> OwnedFile:
    """Open a journal's file, and lock it if `owning`; it is then created if need be.

    Raise StoreError if the system refuses, or if another engine has locked it; the message then
    names that engine's process.
    """
    with _os_errors(path, owning):
        try:
            return OwnedFile(path, owning)
        except BlockingIOError as error:
            try:
                with path.open("rb") as file:
                    owner = _parse_header(file.read(HEADER))[2]
            except (OSError, ValueError, KeyError, TypeError):
                owner = "another engine"
            raise owned_error(owner, str(path)) from error


def journal_path(url: Any, cell_id: str) -> Path:
    """Return the path of a cell's journal, whether the file exists or not.

    Parameters
    ----------
    url : sqlalchemy.URL
        The store.
    cell_id : str
        Characters that a file name cannot have are escaped.

    Returns
    -------
    Path
        Beside an SQLite file, STORE.CELL.journal; for a server in the folder dengine of the user's
        state folder (`XDG_STATE_HOME`, or ~/.local/state).
    """
    name = urllib.parse.quote(cell_id, safe="")
    if IGNORES_CASE:  # or cell A and cell a would have one journal
        name = re.sub("(?<!%)(?<!%[0-9A-F])[A-Z]", lambda letter: f"%{ord(letter[0]):X}", name)
    if url.get_backend_name() == "sqlite":
        return Path(f"{sqlite_file(url)}.{name}.journal")
    state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "dengine"
    digest = hashlib.sha256(f"{url.host}:{url.port}/{url.database}/{cell_id}".encode()).hexdigest()[
        :12
    ]
    return state / f"{name[:60]}.{digest}.journal"


def sqlite_file(url: Any) -> Path:
    """Return the path of the file of an SQLite URL or `file:` URI, absolute, links resolved.

    So one file has one path, and one owner, whatever name it was opened by.
    """
    database = str(url.database)
    is_uri = database.startswith("file:")
    return Path(
        urllib.request.url2pathname(urllib.parse.urlsplit(database).path) if is_uri else database
    ).resolve()


def head_path(journal: Path) -> Path:
    """Return the path of the head, the small file beside a journal."""
    return journal.with_name(f"{journal.name}.head")


def read_newest_entries(path: Path) -> set[tuple[int, str]]:
    """Return the ledger entries (number, digest) that a journal's header and its head name.

    They are none, one or two; a file that is missing or damaged names none.
    """
    entries = {_read_head(path)}
    with suppress(OSError, ValueError, KeyError, TypeError), path.open("rb") as file:
        entries.add(_parse_header(file.read(HEADER))[1])
    return {entry for entry in entries if entry is not None}


def read_undrained(path: Path) -> list[Record]:
    """Return the records of a journal that its store has not taken, oldest first, whoever owns it.

    If several decisions share an id, only the last is returned. Damaged records are left out.
    Nothing is locked or changed. Raise StoreError if the file cannot be read or is no journal, and
    for a record that another release of dengine wrote.
    """
    journal = Journal(path, owning=False)
    try:
        records = [decode_record(blob) for _, _, blob in journal.undrained_records()]
    finally:
        journal.close()
    last = {record.decision.id: record for record in records if isinstance(record, StoredDecision)}
    return [
        record
        for record in records
        if not isinstance(record, StoredDecision) or last[record.decision.id] is record
    ]


def _read_head(journal: Path) -> tuple[int, str] | None:
    """Return number and digest of the ledger entry in the head, the small file beside a journal.

    None if the head is missing or damaged, or names no entry.
    """
    with suppress(OSError, ValueError, TypeError):
        number, digest = json.loads(head_path(journal).read_bytes())
        return int(number), str(digest)
    return None


def _parse_header(header: bytes) -> tuple[int, tuple[int, str] | None, str]:
    """Return the fields of a header: drained offset, newest ledger entry or None, owner.

    Raise ValueError, KeyError or TypeError for a damaged header.
    """
    fields = json.loads(header[len(MAGIC) :].rstrip(b"\0"))
    newest = fields["newest"]
    entry = None if newest is None else (int(newest[0]), str(newest[1]))
    return int(fields["drained"]), entry, str(fields["owner"])


def forked_error(pid: int, name: str) -> StoreError:
    """Return the StoreError for a forked process that uses what its parent `pid` opened."""
    actual = f"its fork {os.getpid()}"
    do = "open it after the fork, in the process that uses it"
    return StoreError(f"Expected the process that opened {name}, {pid}, got {actual}; {do}.")


def describe_process() -> str:
    """Return this process's number and host in words, "process N on HOST".

    It is stored, so that another process that finds the cell owned can name its owner.
    """
    return f"process {os.getpid()} on {socket.gethostname()}"


def owned_error(owner: str, name: str) -> StoreError:
    """Return the StoreError for an engine whose cell another engine owns; it names that owner."""
    do = (
        "close that engine first, ask its page or its HTTP where it is served, or give this "
        "one a cell_id of its own"
    )
    return StoreError(
        f"Expected a cell that no other engine runs on, but {owner} owns {name}; {do}."
    )
