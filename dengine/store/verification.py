"""Checks whether a store's history is as it was written: rows against sums, entries against rows.
`verify_history` reads every row of every cell, with a `CellCheck` for each, and returns a
`HistoryReport` that lists the faults. `dengine verify` uses it.

    report = verify_history("engine.db")
    report.ok, report.faults, report.cells[0].digest      # keep the digest elsewhere, for `expect`

An intact chain means that nothing in it was changed, added or removed since it was written. Two
things it cannot show by itself: that the newest entries were cut off, for which a digest that was
kept elsewhere is passed as `expect`; and that somebody with the right to write made the whole
history anew, which a keyed ledger shows, or again a digest from elsewhere.
"""

import re
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import sqlalchemy as sa

from ..errors import StoreError
from .connections import reading, run_integrity_check
from .journal import journal_path, read_head, read_undrained
from .ledger import (
    START,
    check_key,
    entry_digest,
    ledger_key,
    parse_object,
    row_sum,
    rows_digest,
    state_sum,
)
from .records import CHUNK, LOSS_REMEDY, EntryName, Row, open_losses
from .schema import (
    CHAINED,
    DECISION,
    EVENT,
    LABEL,
    LEDGER,
    METADATA,
    SCHEMA_KEY,
    SETTING,
    TRACE,
    VERSION,
    read_setting,
    read_settings,
)

# The column of each chained table that, with the cell, identifies a row.
KEY = {
    name: next(c.name for c in table.primary_key if c.name != "cell_id")
    for name, table in CHAINED.items()
}
# A row in memory: its ledger entry, and its sum as it is stored.
ROW_SUM = struct.Struct("<q32s")
SUMS = np.dtype([("entry", "<i8"), ("sum", "V32")])  # the same
# A row of the first table needs one of the second.
REQUIRED = ((DECISION, TRACE), (TRACE, DECISION), (LABEL, DECISION))
CUT_OFF = (
    "is not there, though the cell's journal knows it: the history was cut off, or put back from a "
    "copy"
)
SHOWN = 20  # missing entries that are named one by one


@dataclass(frozen=True, slots=True)
class HistoryFault:
    """Something wrong in a store's history.

    Attributes
    ----------
    cell_id : str
    table : str
    key : str
        Which row of the table, as far as is known.
    problem : str
        In words, to follow the key.
    """

    cell_id: str
    table: str
    key: str
    problem: str


@dataclass(frozen=True, slots=True)
class CellHistory:
    """The history of one robot cell.

    Attributes
    ----------
    cell_id : str
    entries : int
        Number of entries of its ledger.
    rows : int
        Number of its rows in the tables whose rows the ledger's hashes cover.
    digest : str
        Of the newest entry, hexadecimal; "" without one.
    waiting : int or None
        Number of records in its journal that the store has not taken. None: it has no journal that
        can be read, so it is unknown what that held, and whether newest entries were cut off.
    """

    cell_id: str
    entries: int
    rows: int
    digest: str
    waiting: int | None


@dataclass(frozen=True, slots=True)
class HistoryReport:
    """The result of `verify_history`.

    Attributes
    ----------
    cells : tuple of CellHistory
    faults : tuple of HistoryFault
        Empty if everything is as it was written.
    """

    cells: tuple[CellHistory, ...]
    faults: tuple[HistoryFault, ...]

    @property
    def ok(self) -> bool:
        """Whether there are no faults."""
        return not self.faults


def verify_history(
    url: str,
    cell_id: str | None = None,
    expect: str | None = None,
    on_rows: Callable[[int], None] | None = None,
) -> HistoryReport:
    """Check every row of a store's history; no row is changed, and engines may run meanwhile.

    What is wrong is returned as faults, not raised: a row or setting that was changed, added or
    removed; a changed or missing entry of a ledger (a robot cell's hash chain), also an entry that
    the cell's journal (its log on disk) names and the store lacks; a decision without its trace, or
    a trace or label without its decision; a table that cannot be read to its end (the cell's
    decisions, traces and labels are then not compared); a damaged SQLite file; damaged or missing
    records of a journal; a cell that no engine has opened; lost data that nobody has acknowledged
    (an event says so); and an `expect` that no entry of the checked cells has. At most 20 missing
    ledger entries of a cell, and 100 findings of SQLite, are returned. A journal that is missing or
    cannot be read is no fault: `waiting` of the cell is None then. A change of the setting
    `product`, by which cells share what they learn, is not noticed. The SQLite file of a store that
    was not in WAL mode is set to it. Takes 40 bytes of memory per row of all cells, the same again
    for the rows of the cell at hand, and the memory of its ledger entries.

    Parameters
    ----------
    url : str
        A file or URL.
    cell_id : str or None
        The cell; None: all cells.
    expect : str or None
        A digest that an earlier check returned, or its first 8 digits or more; the history must
        contain it. Capital letters and blanks around it do not matter.
    on_rows : callable, optional
        Called with the number of rows that were just read, for a progress bar: after each 500, and
        at the end of each cell with the rest, which may be 0.

    Returns
    -------
    HistoryReport
        For each cell the numbers of ledger entries, rows and records in its journal that the store
        lacks, and the digest of the newest entry; and the faults of all cells.

    Raises
    ------
    StoreError
        For what is no store of the present schema, for an unknown cell, for an `expect` that is no
        digest, and for a ledger with another key than the one that DENGINE_LEDGER_KEY names. If the
        key's file cannot be read or has fewer than 16 bytes, if the database cannot be reached, or
        if the disk fails while a journal is read. Also in place of a ValueError, TypeError,
        OverflowError or OSError that `on_rows` raises.
    """
    expected = "" if expect is None else expect.strip().lower()
    if expect is not None and not re.fullmatch("[0-9a-f]{8,64}", expected):
        raise StoreError(
            f"Expected a digest of 64 hexadecimal digits, or its first 8 or more, got {expect!r}."
        )
    with reading(str(url)) as connection:
        journals = {
            name: _inspect_journal(journal_path(connection.engine.url, name))
            for name in _selected_cells(connection, cell_id)
        }
    with reading(str(url)) as connection:  # a later snapshot: it has what the journals knew
        pages = run_integrity_check(connection) if connection.dialect.name == "sqlite" else []
        faults = [HistoryFault("", "file", "", finding) for finding in pages]
        cells = []
        digests: list[str] = []
        for name, (entries, waiting, loss) in journals.items():
            check = CellCheck(connection, name, on_rows)
            check_key(connection, name, check.key)
            faults += check.run(entries, loss)
            newest = "".join(check.digests[-1:])
            cells.append(CellHistory(name, len(check.digests), check.rows, newest, waiting))
            digests += check.digests
    if expected and not any(digest.startswith(expected) for digest in digests):
        faults.append(
            HistoryFault(
                cell_id or "",
                LEDGER.name,
                f"digest {expected}",
                "is in no entry: the history was cut off before it, or made anew",
            )
        )
    return HistoryReport(tuple(cells), tuple(faults))


def _inspect_journal(path: Path) -> tuple[list[EntryName], int | None, str]:
    """Read a journal; nothing is raised if it is missing or damaged.

    A journal is the log on a robot cell's disk, its head a small file beside it, and the ledger the
    hash chain of the cell's store. Return three values: the ledger entries (number and digest) that
    journal and head name; the number of records that the store has not taken; and in words which
    records are damaged or missing, "" if none is. If there is no journal, or it cannot be read,
    they are the entry that the head names (none if it names none), None and "". If the disk fails
    while the records are read, OSError is raised.
    """
    with suppress(StoreError):  # it is missing, damaged, or another user's
        records, journal = read_undrained(path)
        return journal.entries, len(records), journal.loss
    newest = read_head(path).newest
    return [newest] if newest else [], None, ""


def _selected_cells(connection: sa.Connection, cell_id: str | None) -> list[str]:
    """Return `cell_id` in a list, or if it is None the ids of all robot cells in any table, sorted.

    Raise StoreError for a cell that no table has. A table that cannot be read to its end is left
    out.
    """
    names: set[str] = set()
    for table in METADATA.tables.values():
        # A damaged table is left out, and PostgreSQL reads on from the savepoint.
        with suppress(sa.exc.DatabaseError), connection.begin_nested():
            names |= {
                str(cell)
                for cell in connection.execute(sa.select(table.c.cell_id).distinct()).scalars()
            }
    cells = sorted(names)
    if cell_id is not None and cell_id not in cells:
        raise StoreError(
            f"Expected a cell of the store ({', '.join(cells) or 'none'}), got {cell_id!r}; "
            "name one of them."
        )
    return cells if cell_id is None else [cell_id]


class CellCheck:
    """The check of one cell's history; `run` makes it, once.

    To make a `CellCheck` reads the ledger's key from the file that DENGINE_LEDGER_KEY names, and
    raises StoreError if that cannot be read.

    Parameters
    ----------
    connection : sqlalchemy.Connection
    cell_id : str
    on_rows : callable or None
        Called with the number of rows that were just read.

    Attributes
    ----------
    key : bytes
        Key of the ledger that the environment names, b"" without one.
    digests : list of str
        Of the ledger's entries, oldest first, hexadecimal; filled by `run`.
    rows : int
        Number of rows read so far.
    """

    def __init__(
        self, connection: sa.Connection, cell_id: str, on_rows: Callable[[int], None] | None
    ) -> None:
        self.connection = connection
        self.cell_id = cell_id
        self._on_rows = on_rows or (lambda n_rows: None)
        self.key = ledger_key()
        self.digests: list[str] = []
        self.rows = 0
        self._sums = {table: bytearray() for table in CHAINED}
        self._is_unreadable = False

    def run(self, entries: Sequence[EntryName], loss: str) -> list[HistoryFault]:
        """Check all rows of the robot cell; return what is wrong, table by table, [] if nothing is.

        The rows of the tables that the ledger (the cell's hash chain) covers come first, then the
        ledger's entries, the settings, events about lost data that nobody has acknowledged, and
        whether decisions, traces and labels belong together. At the end comes the journal, the log
        on the cell's disk: `loss` says what is damaged in it, "" if nothing is, and `entries` are
        the ledger entries that it names. Damage is a fault, and so is each of these entries that
        the ledger lacks.

        Fill `digests`, the digests of the ledger's entries, and `rows`, the number of rows read,
        and call `on_rows` with the number of rows just read. A database error is a fault, too, and
        not raised; after one, it is not checked whether decisions, traces and labels belong
        together. If the ledger itself cannot be read, all of `entries` count as lacking.
        """
        checks = [
            *((table, self._check_rows(table)) for table in CHAINED),
            (LEDGER.name, self._check_ledger()),
            (SETTING.name, self._check_settings()),
            (EVENT.name, self._check_losses()),
            *((table.name, self._check_pairs(table, required)) for table, required in REQUIRED),
        ]
        faults: list[HistoryFault] = []
        for table, check in checks:
            try:
                with self.connection.begin_nested():  # after an error PostgreSQL reads on from here
                    faults.extend(check)  # faults before an error stay
            except sa.exc.DatabaseError as error:
                self._is_unreadable = True
                faults.append(self._fault(table, "", f"cannot be read to its end: {error.orig}"))
        if loss:
            faults.append(
                self._fault(
                    "journal", "", f"is damaged: {loss} The next engine records that as an alarm"
                )
            )
        faults += [
            self._fault(LEDGER.name, f"entry {number}", CUT_OFF)
            for number, digest in sorted(set(entries))
            if digest not in self.digests
        ]
        self._on_rows(self.rows % CHUNK)
        return faults

    def _fault(self, table: str, key: object, problem: str) -> HistoryFault:
        """Return a fault of this robot cell."""
        return HistoryFault(self.cell_id, table, str(key), problem)

    def _read_raw(self, table: str) -> Iterator[Row]:
        """Yield the cell's rows of a table as dicts, with values as the driver returns them.

        They are in no order. SQLAlchemy converts nothing, so that damaged values can be read, too.
        Its DatabaseError is raised, also after some rows, if the table cannot be read to its end.
        """
        # SQLAlchemy knows no types here, so it converts none.
        query = sa.text(f'SELECT * FROM "{table}" WHERE cell_id = :cell')
        for row in self.connection.execute(
            query.execution_options(yield_per=CHUNK), {"cell": self.cell_id}
        ):
            yield row._asdict()

    def _check_rows(self, table: str) -> Iterator[HistoryFault]:
        """Yield a fault for each row of a table that was changed or is not in the ledger.

        The ledger is the store's hash chain, with an entry for each transaction. A row that names
        no entry is not in the ledger: something beside dengine wrote it. A row was changed if its
        values do not fit its stored checksum. The state of a version (its stored arrays) has a
        checksum of its own, and a fault of its own; a state that was deleted is no fault. Raise
        SQLAlchemy's DatabaseError, also after some faults, if the table cannot be read to its end.

        The stored checksums of every row with an entry, also of a changed one, are kept for
        `_check_ledger`. Each row adds 1 to `rows`. After every 500th row (CHUNK) `on_rows` is
        called with 500; `run` calls it once more with the number of the rows that are left.
        """
        for row in self._read_raw(table):
            self.rows += 1
            if self.rows % CHUNK == 0:
                self._on_rows(CHUNK)
            key = row[KEY[table]]
            entry = row["entry"]
            stored = row["sum"]
            if not isinstance(entry, int) or entry < 1:
                yield self._fault(table, key, "is not chained: something beside dengine wrote it")
                continue
            if row_sum(table, row) != stored:
                yield self._fault(table, key, "was changed")
            if (
                table == VERSION.name
                and row["state"] is not None
                and state_sum(_bytes(row["state"])) != row["state_sum"]
            ):
                yield self._fault(table, key, "its state was changed")
            self._sums[table] += ROW_SUM.pack(entry, _bytes(stored))

    def _check_ledger(self) -> Iterator[HistoryFault]:
        """Yield a fault for each ledger entry that was changed or is missing; fill `digests`.

        The ledger is the store's hash chain, with an entry for each transaction. `digests` gets the
        digest of each entry, hexadecimal, oldest first. An entry must fit the digest of the entry
        before, and the checksums of its rows as they are stored: that a row does not fit its
        checksum is a fault of its own. All rows must be checked first (`_check_rows`). After an
        entry that was changed, only this entry is a fault; the entry behind a missing one is a
        fault, too. Only the first 20 missing entries are yielded; those behind the newest that an
        entry or a row names cannot be noticed. Raise SQLAlchemy's DatabaseError if the ledger
        cannot be read to its end.
        """
        sums = {}
        for table, packed in self._sums.items():
            rows = np.frombuffer(packed, SUMS)
            sums[table] = rows[np.argsort(rows["entry"])]
        numbers: set[int] = set()
        previous = {START}
        for row in sorted(self._read_raw(LEDGER.name), key=lambda row: _integer(row["number"])):
            number = _integer(row["number"])
            of_entry = {}
            for table, rows in sums.items():
                begin, end = np.searchsorted(rows["entry"], (number, number + 1))
                if begin < end:
                    of_entry[table] = rows["sum"][begin:end].tolist()
            head = row | {"digest": None}
            # After an entry that was changed, its digest as stored and as computed are both
            # accepted as the one before: only that entry is a fault.
            computed = {entry_digest(digest, head, self.key) for digest in previous}
            digest = _bytes(row["digest"])
            if digest not in computed or _bytes(row["rows"]) != rows_digest(of_entry):
                yield self._fault(
                    LEDGER.name, f"entry {row['number']}", _entry_fault(row["added"], of_entry)
                )
            previous = {digest, *computed}
            self.digests.append(digest.hex())
            numbers.add(number)
        newest = max(
            [0, *numbers, *(int(rows["entry"][-1]) for rows in sums.values() if len(rows))]
        )
        missing = (number for number in range(1, newest + 1) if number not in numbers)
        for number in islice(missing, SHOWN):
            yield self._fault(LEDGER.name, f"entry {number}", "is missing")

    def _check_settings(self) -> Iterator[HistoryFault]:
        """Yield a fault for each setting that was changed, or is only in the table or the ledger.

        The ledger, the store's hash chain, has a copy of the cell's settings, but not of those that
        the store itself keeps (`RESERVED`), so a change of these is no fault here. A damaged or
        missing copy counts as empty. If the setting with the version of the tables is missing (no
        engine has opened the robot cell), that is a fault, too. Raise SQLAlchemy's DatabaseError if
        a table cannot be read.
        """
        stored = read_settings(self.connection, self.cell_id)
        copies = (
            sa.select(LEDGER.c.settings)
            .where(LEDGER.c.cell_id == self.cell_id, LEDGER.c.settings.is_not(None))
            .order_by(LEDGER.c.number.desc())
        )
        # An entry that was changed is found by the chain.
        chained = parse_object(self.connection.execute(copies.limit(1)).scalar())
        for key in sorted(stored.keys() | chained.keys(), key=str):  # a damaged key may be bytes
            if key not in chained:
                yield self._fault(SETTING.name, key, "is not chained")
            elif key not in stored:
                yield self._fault(SETTING.name, key, "is missing")
            elif stored[key] != chained[key]:
                yield self._fault(SETTING.name, key, "was changed")
        if read_setting(self.connection, self.cell_id, SCHEMA_KEY) is None:
            yield self._fault(
                SETTING.name, SCHEMA_KEY, "is missing: no engine has opened this cell"
            )

    def _check_losses(self) -> Iterator[HistoryFault]:
        """Yield a fault for each event that says that data was lost and is not acknowledged."""
        query = sa.select(EVENT).where(EVENT.c.cell_id == self.cell_id).order_by(EVENT.c.number)
        for event in open_losses(self.connection.execute(query)):
            yield self._fault(EVENT.name, event.number, f"says: {event.text} {LOSS_REMEDY}")

    def _check_pairs(self, table: sa.Table, required: sa.Table) -> Iterator[HistoryFault]:
        """Yield a fault for each row of the cell in `table` whose decision id `required` lacks.

        Of `required`, too, only rows of the robot cell count. The table that the fault names is
        `required`. If an earlier check of the cell ended with a database error, nothing is read or
        yielded. Raise SQLAlchemy's DatabaseError if a table cannot be read.
        """
        if self._is_unreadable:  # everything that could not be read would be missing
            return
        keys, required_keys = (
            sa.select(part.c[KEY[part.name]]).where(part.c.cell_id == self.cell_id)
            for part in (table, required)
        )
        for id_ in self.connection.execute(sa.except_(keys, required_keys)).scalars():
            yield self._fault(required.name, id_, f"is missing: a row of {table.name} is there")


def _entry_fault(added: Any, sums: Mapping[str, list[bytes]]) -> str:
    """Return in words why a ledger entry does not fit its rows.

    The ledger is the store's hash chain, with an entry for each transaction. If the numbers of rows
    by table differ, the text names both; else it says that the entry or its rows were changed.
    `added` is the entry's column of that name: JSON with the number of rows that were added to each
    table; if it is damaged, all are 0. `sums` has the checksums of the rows that are there, by
    table.
    """
    counts = Counter[str](parse_object(added))
    present = Counter({table: len(rows) for table, rows in sums.items()})
    missing = "; ".join(
        f"{counts[name]} of {name}, {present[name]} found"
        for name in sorted({*counts, *present})
        if counts[name] != present[name]
    )
    return f"chained {missing}" if missing else "was changed, or rows that it chains were"


def _bytes(value: Any) -> bytes:
    """Return a binary column's value as bytes, b"" if it is something else."""
    return bytes(value) if isinstance(value, bytes | bytearray | memoryview) else b""


def _integer(value: Any) -> int:
    """Return an integer column's value, -1 if it is something else."""
    return value if isinstance(value, int) else -1
