"""A cell's journal: the write-ahead log on the local disk, from which the store is filled. The
class `Journal` is one locked file: a header, then the records (decisions, labels, events) in the
order in which they were written. `encode_record` and `decode_record` convert a record to bytes and
back; other functions return a journal's path, read the records that its store has not taken, and
describe the process that owns a cell. `Outbox` writes the journal while a cell runs; backup and
verification read it.

Each record has its length, its CRC-32, and a digest over itself and the record before, so that a
changed record and a missing one are both noticed. The header names the process that owns the cell,
the records that the store holds (their number, and the offset up to which they stand), and the
newest entry of the cell's ledger that the store held: a store that was cut off or restored from an
older copy lacks that entry.

A small file beside the journal, its head, repeats the entry, and names the newest synced record
(number and digest). It is written before a record is acknowledged: a journal that lacks the record
has lost its end. The head is synced later than the journal, by the thread that drains: after a
power failure it may be older than the journal, never newer.
"""

import hashlib
import json
import os
import re
import socket
import struct
import sys
import threading
import urllib.parse
import zlib
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import blake2b
from pathlib import Path
from typing import Any

from ..errors import StoreError, instead
from ..records import Decision
from .owned_file import OwnedFile, open_plain, sync
from .records import (
    EntryName,
    Event,
    NewLabel,
    StoredDecision,
    decision_row,
    from_row,
    pack,
    to_row,
    unpack,
)

# Length of a record's JSON text, before it; the samples of a trace or point follow it.
LENGTH = struct.Struct("<I")
# Bytes: 1,800 traces of 1000 samples, or 2.5 hours of a cell that verifies every part.
RESERVE = 8 << 20
HEADER = 256  # bytes of the header, and of the head; the first record begins there
MAGIC = b"dengine journal 2\n"
MARK = b"\x89rec"  # where a record begins, to find the next one behind a damaged length
IGNORES_CASE = sys.platform in ("win32", "darwin")  # of names in its usual file systems
FRAME = struct.Struct("<4sII16s")  # before a record: mark, length, CRC-32, digest
DAMAGES = (
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    OverflowError,
)  # of reading a damaged header or head

Record = StoredDecision | NewLabel | Event
Fields = dict[str, Any]  # of a header or head, by name


def encode_record(record: Record) -> bytes:
    """Return a record (decision, label or event) as bytes.

    They are the length of a JSON text, this text with the record's kind and fields, and the float32
    values of a decision's trace or of a label's `point`, the embedding of the trace. The number
    and the label of a decision are left out, and so is what stands before each record in a journal:
    a mark (four bytes by which it is found), length, checksum and digest.
    """
    if isinstance(record, StoredDecision):
        row = decision_row(record) | {"shape": record.trace.shape}
        samples = pack(record.trace)
    else:
        row = to_row(record)
        samples = row.pop("point", None) or b""
    text = json.dumps([type(record).__name__, row]).encode()
    return LENGTH.pack(len(text)) + text + samples


def decode_record(blob: bytes) -> Record:
    """Return the record that `encode_record` wrote; raise StoreError for bytes that have no record.

    A decision has number 0 and no label. Bytes that were changed and can still be decoded are not
    noticed here; the journal compares their CRC-32.
    """
    with instead(
        StoreError,
        "Expected a record of a journal, got what cannot be read",
        struct.error,
        *DAMAGES,
        do="open the store with the dengine that wrote it",
    ):
        (length,) = LENGTH.unpack_from(blob)
        samples = blob[LENGTH.size + length :]
        kind, row = json.loads(blob[LENGTH.size : LENGTH.size + length])
        if kind == StoredDecision.__name__:
            return from_row(
                StoredDecision,
                row,
                decision=from_row(Decision, row),
                trace=unpack(samples).reshape(row["shape"]),
            )
        if kind == NewLabel.__name__:
            return from_row(NewLabel, row, point=unpack(samples) if samples else None)
        return from_row(Event, row)


@dataclass
class Head:
    """What the head, the small file beside a journal, says.

    The default values stand for a head that is missing or damaged.

    Attributes
    ----------
    newest : (int, str) or None
        Number and digest of the newest ledger entry of the store; None: no entry yet.
    n_drained : int
        Number of the last record that the store holds: 1, 2, ... in a journal.
    n_synced : int
        Number of the newest record that is synced in the journal.
    digest : str
        Of that record, hexadecimal.
    time : float
        When it was written, in seconds since 1970.
    """

    newest: EntryName | None = None
    n_drained: int = 0
    n_synced: int = 0
    digest: str = ""
    time: float = 0.0


class Journal:
    """An open journal file. One thread appends; any thread may read.

    Opening reads all records that the store does not hold yet, and checks them. If `owning`, an
    unfinished record at the end is cut off, the header is written and disk space is reserved.

    Parameters
    ----------
    path : Path
        The file; if `owning`, it is created with its folder if need be. A symbolic link is refused.
    owning : bool, default True
        Lock the file and write to it. False: read what is in it now, whoever owns it.

    Attributes
    ----------
    end : int
        Offset behind the last record, in bytes.
    drained_to : int
        Offset up to which the store holds the records; set by the outbox.
    head : Head
        What the head is to say next; the outbox sets `n_drained`.
    entries : list of (int, str)
        Number and digest of the ledger entries that header and head named at the opening: two, or
        fewer if one of them is missing, new or damaged.
    loss : str
        Which acknowledged records are missing or not as they were written, in words; "" if none is.
        The others are read all the same.

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
        self.loss = ""
        self.head = read_head(path)
        self.entries: list[EntryName] = []
        # Guards what header and head hold: two threads write them.
        self._describing = threading.RLock()
        self._owning = owning
        self._file = _open_file(path, owning)
        try:
            with _os_errors(self.path):
                self._scan()
                if owning:
                    self._file.truncate(self.end)
                    self._write_header()
                    self.reserve()
        except StoreError:
            self._file.close()
            raise

    @property
    def is_drained(self) -> bool:
        """Whether the store holds all records."""
        return self.drained_to >= self.end

    def append(self, records: Sequence[bytes], time: float) -> list[int]:
        """Append encoded records behind the last one, and return when they are synced to the disk.

        The head, a small file beside the journal, then names the newest of them; it is not synced,
        and if it cannot be written, that is ignored. After an error the journal's end is where it
        was before, and the same records can be appended again.

        Parameters
        ----------
        records : sequence of bytes
            Each in the form that `encode_record` returns.
        time : float
            The present time, in seconds since 1970.

        Returns
        -------
        list of int
            The offset of each record in bytes, for `is_intact`.

        Raises
        ------
        LostJournalError
            If the open file is no longer the one at its path, so that nobody would read it.
        StoreError
            If the disk fails, or the system refuses to look whether the file is still at its path.
        """
        offsets = []
        framed = bytearray()
        digest = bytes.fromhex(self.head.digest)
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
        with self._describing:
            self.end += len(framed)
            self.head.n_synced += len(records)
            self.head.time = time
            self.head.digest = digest.hex()
            self._write_head()
        return offsets

    def sync_head(self) -> None:
        """Sync the head to the disk, which may take as long as a sync of the journal.

        A failure is ignored: after a power failure the head is then older than the journal.
        """
        with (
            suppress(OSError),
            os.fdopen(open_plain(head_path(self.path), os.O_WRONLY), "wb") as file,
        ):
            sync(file.fileno())

    def is_intact(self, offset: int) -> bool:
        """Return whether a record, whose CRC-32 fits, begins at an offset that `append` returned.

        False, too, if the disk cannot be read.
        """
        with suppress(OSError):
            return self._read_record(offset) is not None
        return False

    def undrained_records(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield (offset, end, encoded record) of the records from `drained_to` on, oldest first.

        `drained_to` is the offset up to which the store has taken the records, so it lacks the
        others; but if the journal's header, in which this offset is kept, is older than the store,
        as after a crash, the store has some of them. A record takes the bytes of the file from
        `offset` to before `end`. Damaged records are skipped: the search goes on at the next mark
        (`MARK`, four bytes with which each record begins), and the digest that chains a record to
        the one before is not checked. Raise OSError, and no StoreError, if the disk cannot be read.
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

    def decode_undrained(self) -> Iterator[Record]:
        """Yield the records that the store lacks, oldest first, without replaced decisions.

        Records are decisions, labels and events. If several decisions have one id, the last
        replaces the others. Damaged records are left out; the attribute `loss` says so. The file is
        read twice, so that it need not fit into memory. Raise StoreError, before the first record
        is yielded, for an intact record that cannot be decoded, like that of another release of
        dengine, and OSError if the disk cannot be read.
        """
        newest: dict[str, int] = {}  # where the newest decision of an id stands
        for offset, _, blob in self.undrained_records():
            record = decode_record(blob)
            if isinstance(record, StoredDecision):
                newest[record.decision.id] = offset
        for offset, _, blob in self.undrained_records():
            record = decode_record(blob)
            # An id may be unknown: an engine may have written the file anew meanwhile.
            if (
                not isinstance(record, StoredDecision)
                or newest.get(record.decision.id, offset) == offset
            ):
                yield record

    def save_newest_entry(self, newest: EntryName | None) -> None:
        """Write to header and head the newest ledger entry, and which records the store holds.

        The header is the beginning of the journal, the head a small file beside it. The ledger is
        the store's hash chain, and `newest` is number and digest of its newest entry; None: there
        is none yet. Nothing is synced: an older header is harmless, since the store ignores a
        record that it is given twice. The attribute `head` keeps the entry, also if it cannot be
        written. Raise StoreError if the header cannot be written; a failure of the head is ignored.
        """
        with self._describing, _os_errors(self.path):
            self.head.newest = newest
            self._write_header()
            self._write_head()

    def _write_head(self) -> None:
        """Write the attribute `head` to the small file beside the journal, without a sync.

        It names the newest entry of the ledger (the store's hash chain), the last record that the
        store holds and the newest one that is synced in the journal (`Head`). The file is created
        if need be. A failure is ignored: an older head is harmless. The caller holds the lock
        `_describing`.
        """
        with (
            suppress(OSError),
            os.fdopen(open_plain(head_path(self.path), os.O_WRONLY | os.O_CREAT), "wb") as file,
        ):
            file.write(_pack_fields(vars(self.head)).ljust(HEADER))

    def clear(self) -> None:
        """Remove all records; the caller has made sure that the store holds them.

        The file is synced first, or a power failure might leave it cut off, but with an older
        header, which says that the store lacks records. It is cut off behind its header, which is
        written anew and says that the store holds all. Then disk space is reserved for new records
        (`reserve`; none on a full disk) and synced. The head, the small file beside the journal, is
        not written. Raise StoreError if the file cannot be written.
        """
        self.reserve()  # syncs, so that no disk keeps the cut without the header
        with self._describing, _os_errors(self.path):
            self._file.truncate(HEADER)
            self.drained_to = HEADER
            self.head.n_drained = self.head.n_synced
            self.end = HEADER
            self._write_header()
        self.reserve()

    def reserve(self) -> None:
        """Reserve disk space for at least RESERVE bytes (8 MiB) of records, and sync that.

        On a full disk nothing is reserved, and no error raised; StoreError if the sync fails.
        """
        with _os_errors(self.path):
            self._file.reserve(HEADER + RESERVE)

    def recreate(self) -> None:
        """Create a new file at the path of a journal that was deleted, moved or replaced.

        The records that the store lacks are copied to the same offsets from the lost file, which is
        still open and is then closed. If another file is at the path by now, it is used: its header
        and the bytes at these offsets are written over, and those behind them are cut off. Raise
        StoreError if it cannot be written, or another engine has locked it, or the lost file cannot
        be read or was cut off before the store had its records; the journal then still uses the
        lost one.
        """
        lost = self._file
        self._file = _open_file(self.path)
        try:
            with _os_errors(self.path):
                if lost.size < self.end and not self.is_drained:
                    raise OSError("the lost file was cut off, too")
                self._file.write(
                    lost.read(self.end - self.drained_to, self.drained_to), self.drained_to
                )
                self._file.truncate(self.end)  # no records of another file behind ours
                self._write_header()
                self.reserve()
        except StoreError:
            lost, self._file = self._file, lost
            raise
        finally:
            lost.close()

    def close(self, waiting: bool = True) -> None:
        """Cut off the reserved space, and the records if the store has all; close and unlock it.

        With `waiting=False` the file is not synced, and the records stay even if the store has all.

        The header stays in the file, so that the next engine can compare it with the ledger (the
        store's hash chain). A journal that was opened for reading is only closed, and so is a
        journal whose disk fails: nothing is raised. A second call does nothing.
        """
        if self._owning and not self._file.closed:
            with suppress(OSError):
                if self.is_drained and waiting:
                    self._file.sync()  # the header, or a disk might keep the cut without it
                    self.end = HEADER
                self._file.truncate(self.end)
        self._file.close()

    def _write_header(self) -> None:
        """Write the header, the first 256 bytes: the text MAGIC, then JSON, padded with zeros.

        The JSON has this process as the owner, the number of the records in the journal (a log on
        the local disk) that the store has, the offset behind them, number and digest of the newest
        entry of the ledger (the store's hash chain), and a CRC-32 of these fields. Nothing is
        synced. Raise OSError if it cannot be written.
        """
        fields = {
            "owner": describe_process()[:60],
            "drained": self.drained_to,
            "newest": self.head.newest,
            "n_drained": self.head.n_drained,
        }
        self._file.write((MAGIC + _pack_fields(fields)).ljust(HEADER, b"\0"), 0)

    def _scan(self) -> None:
        """Read the header and all records that the store lacks; set the journal's attributes.

        The attribute `head`, read before from the small file beside the journal, names the newest
        record that was synced; if this is not found, records are missing. With a damaged header the
        store counts as lacking every record, and `head` is not compared. A damaged header, and
        records that are damaged or missing, are described in `loss`, and not raised. An unfinished
        record at the end is left out. Nothing is written. Raise StoreError if the file is no
        journal, and OSError if it cannot be read. An empty file is a journal without records.
        """
        head = self.head
        fields: Fields = {"newest": None, "n_drained": head.n_drained}
        damaged = 0
        if self._file.size:
            header = self._file.read(HEADER, 0)
            if not header.startswith(MAGIC):
                raise StoreError(
                    f"Expected a journal of dengine, found another file: {self.path}; move it away."
                )
            try:
                fields = _parse_header(header)
                self.drained_to = int(fields["drained"])
            except DAMAGES:  # all of it is drained again, which is harmless
                damaged = 1
                head = Head()
        self.end = max(self._file.size, HEADER)
        self.drained_to = min(max(self.drained_to, HEADER), self.end)
        self.entries = [entry for entry in (self.head.newest, fields["newest"]) if entry]
        # The first record's digest is not checked: those before it may be gone.
        digests: list[bytes] = []
        begin = self.drained_to
        for offset, end, record in self.undrained_records():
            digest: bytes = FRAME.unpack(self._file.read(FRAME.size, offset))[3]
            follows = not digests or digest == _chain_digest(digests[-1], record)
            damaged += offset > begin or not follows
            digests.append(digest)
            begin = end
        self.end = begin  # behind it is at most a record that was never acknowledged
        n_drained = fields["n_drained"]
        n_known = n_drained + len(set(digests))  # a record may be there twice
        is_newest_missing = n_known < head.n_synced or bytes.fromhex(head.digest) not in digests
        if head.n_synced > n_drained and is_newest_missing:
            self.loss = (
                f"{max(1, head.n_synced - n_known)} records (decisions, labels or events) are "
                "missing from the journal, though they were on disk; the newest is of "
                f"{datetime.fromtimestamp(head.time, UTC):%Y-%m-%d %H:%M:%S} UTC."
            )
        elif damaged:
            self.loss = (
                f"the journal was not as it was written in {damaged} places, which were left out."
            )
        newest = digests[-1].hex() if digests else head.digest
        self.head = Head(
            fields["newest"], n_drained, max(head.n_synced, n_known), newest, head.time
        )

    def _read_record(self, offset: int) -> bytes | None:
        """Return the encoded record at an offset, without what stands before it in the file.

        That is a mark, the length, the CRC-32 and a digest, which is not checked here. Return None
        if no record begins there, or if it is cut off or its CRC-32 differs. Raise OSError if the
        disk cannot be read.
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
    """Return a context manager that raises StoreError for an OSError, with path and advice.

    The advice is about writing the journal, or if `owning` is False about reading it.
    """
    do = "read it as the user that its cell runs as"
    if owning:
        do = "free some space there, or make its folder writable"
    return instead(StoreError, f"Could not use the journal {path}", OSError, do=do)


def _open_file(path: Path, owning: bool = True) -> OwnedFile:
    """Open a journal's file: locked, for writing, and created if need be; or only for reading.

    If `owning` is False, it is only read, not locked, and must exist; otherwise its folder is
    created, too, if need be. Raise StoreError if the system refuses, for a symbolic link, or if
    another engine has locked it; the message then names that engine's process, if the header can be
    read.
    """
    with _os_errors(path, owning):
        try:
            return OwnedFile(path, owning)
        except BlockingIOError as error:
            try:
                with path.open("rb") as file:
                    owner = _parse_header(file.read(HEADER))["owner"]
            except (OSError, *DAMAGES):
                owner = "another engine"
            raise owned_error(owner, str(path)) from error


def journal_path(url: Any, cell_id: str) -> Path:
    """Return the path of a cell's journal, whether the file exists or not.

    The journal is the local file that gets each record of a robot cell first.

    Parameters
    ----------
    url : sqlalchemy.URL
        The store.
    cell_id : str
        Each character but ASCII letters, digits and `_.-~` is escaped, as in a URL (a blank is
        %20), and also capital letters if the system's file names ignore case.

    Returns
    -------
    Path
        For an SQLite file STORE.CELL.journal beside it: its name, links resolved, and the escaped
        `cell_id`. For a server CELL.DIGEST.journal in the folder dengine of the user's state folder
        (`XDG_STATE_HOME`, or ~/.local/state), with the first 60 characters of the escaped
        `cell_id`, and 12 hexadecimal digits of a digest of the server with its port, the database
        and `cell_id`.
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
    """Return the path of the file of an SQLite URL, absolute, links resolved.

    So one file has one path, and one owner, whatever name it was opened by.
    """
    return Path(str(url.database)).resolve()


def head_path(journal: Path) -> Path:
    """Return the path of the head, the small file beside a journal: its name with ".head" added."""
    return journal.with_name(f"{journal.name}.head")


def read_undrained(path: Path) -> tuple[list[Record], Journal]:
    """Return the records of a journal that its store has not taken, and the journal, closed.

    The records are decisions, labels and events, without decisions that a later one replaces
    (`Journal.decode_undrained`); the journal's attribute `loss` says which are missing or damaged.
    Nothing is locked or changed, so an engine may be using the journal. Raise StoreError if the
    file cannot be opened or is no journal, and for an intact record that cannot be decoded, like
    that of another release of dengine. If the disk fails later, while the records are read, OSError
    is raised.
    """
    journal = Journal(path, owning=False)
    try:
        return list(journal.decode_undrained()), journal
    finally:
        journal.close()


def read_head(journal: Path) -> Head:
    """Return the content of the head beside a journal; an empty one if it is missing or damaged.

    The same is returned if the file cannot be read, or has fields that `Head` does not have.
    """
    with suppress(OSError, *DAMAGES):
        return Head(**_unpack_fields(head_path(journal).read_bytes()))
    return Head()


def _parse_header(header: bytes) -> Fields:
    """Return the fields of a header by name; raise one of the types in DAMAGES if it is damaged.

    A header without `n_drained`, of an earlier release, gets 0.
    """
    return {"n_drained": 0} | _unpack_fields(header[len(MAGIC) :])


def _pack_fields(fields: Fields) -> bytes:
    """Return fields as JSON that ends with their CRC-32, for `_unpack_fields`."""
    text = json.dumps(fields).encode()
    return b'%s, "crc": %d}' % (text[:-1], zlib.crc32(text))


def _unpack_fields(content: bytes) -> Fields:
    """Return the fields of a journal's header or head; raise one of DAMAGES if it is damaged.

    The head is a small file beside the journal. The fields are a dict by name. DAMAGES are
    ValueError, LookupError, TypeError, AttributeError and, for a number like 1e999, OverflowError.
    The field "newest", which names the newest entry of the ledger (the store's hash chain, with an
    entry for each transaction), becomes a pair (number, digest) or None; a list in place of the
    fields is taken for this field alone. The CRC-32 is compared only if there is one: headers of
    earlier releases have none.
    """
    fields = json.loads(content.rstrip(b"\0 "))
    if isinstance(fields, list):
        fields = {"newest": fields}
    crc = fields.pop("crc", None)
    if crc not in (None, zlib.crc32(json.dumps(fields).encode())):
        raise ValueError("the checksum differs")
    number, digest = fields["newest"] or (0, "")
    fields["newest"] = (int(number), str(digest)) if digest else None
    return dict(fields)


def forked_error(pid: int, name: str) -> StoreError:
    """Return the StoreError for a process that uses what another process opened before a fork.

    `pid` is the process that opened it, and `name` says what it is, for the message.
    """
    return StoreError(
        f"Expected the process that opened {name}, {pid}, got its fork {os.getpid()}; open it "
        "after the fork, in the process that uses it."
    )


def describe_process() -> str:
    """Return this process's number and host in words, "process N on HOST".

    It is stored, so that another process that finds the robot cell owned can name its owner. A
    letter beyond ASCII becomes `?`.
    """
    host = socket.gethostname().encode("ascii", "replace").decode()  # a header has no more room
    return f"process {os.getpid()} on {host}"


def owned_error(owner: str, name: str) -> StoreError:
    """Return the StoreError for an engine whose robot cell another engine owns.

    A robot cell is a robot with its sensor and its check; one engine at a time owns it. `owner`
    describes the other engine's process, and `name` what it owns; the message has both.
    """
    return StoreError(
        f"Expected a cell that no other engine runs on, but {owner} owns {name}; close that engine "
        "first, ask its page or its HTTP where it is served, or give this one a cell_id of its own."
    )
