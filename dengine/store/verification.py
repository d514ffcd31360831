"""Whether a store's history is what was written: every row against its sum, every entry of the ledger against its rows.

    report = verify_history("engine.db")
    report.ok, report.faults, report.cells[0].digest      # keep the digest elsewhere: `expect` asks for it again

A chain that is whole says that nothing in it was changed, added or removed since it was written, but for its newest
entries: those can be cut off without a trace in the store, which is what `expect` is for. Nor can it tell a history that
somebody with the right to write has made anew from its beginning; a keyed ledger does, or a digest from elsewhere.
"""

import json
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import sqlalchemy as sa

from ..errors import StoreError
from .connections import integrity, reading
from .journal import journal_path, read_newest_entries, read_undrained
from .ledger import START, entry_digest, ledger_key, must_have_key, row_sum, rows_digest, settings_faults, state_sum
from .records import CHUNK
from .schema import CHAINED, DECISION, LABEL, LEDGER, METADATA, SCHEMA_KEY, SETTING, TRACE, VERSION

KEY = {name: next(c.name for c in table.primary_key if c.name != "cell_id") for name, table in CHAINED.items()}
KEPT = struct.Struct("<q32s32s")  # of a row in memory: its entry, and its sum as it stands there and as it comes out now
SUMS = np.dtype([("entry", "<i8"), ("stored", "V32"), ("now", "V32")])
NEEDS = ((DECISION, TRACE), (TRACE, DECISION), (LABEL, DECISION))  # a row of the first has one of the second
SHOWN = 20  # entries that are missing which are named one by one


@dataclass(frozen=True, slots=True)
class HistoryFault:
    """What is wrong in a store's history; key : which row of the table, as far as is known."""

    cell_id: str
    table: str
    key: str
    what: str


@dataclass(frozen=True, slots=True)
class CellHistory:
    """A cell's history: entries of its ledger, rows that they chain, and the newest digest, "" without one.

    waiting : decisions, labels and events that its journal holds and the store has not taken; None: no journal
        of it is there that can be read: what it held, and whether newest entries were cut off, is not known.
    """

    cell_id: str
    entries: int
    rows: int
    digest: str
    waiting: int | None = None


@dataclass(frozen=True, slots=True)
class HistoryReport:
    """What `verify_history` found; faults : nothing where all is as it was written."""

    cells: tuple[CellHistory, ...]
    faults: tuple[HistoryFault, ...]

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.faults


def verify_history(
    url: str, cell_id: str | None = None, expect: str | None = None, on_rows: Callable[[int], None] | None = None
) -> HistoryReport:
    """Check a store, of one cell or of all; nothing is written, and engines may go on meanwhile.

    url : a file or URL.  expect : a digest that an earlier check gave, or its first 8 digits or more: the history must
    hold it still.  on_rows : called with the number of rows that were just read.
    Takes about 80 bytes of memory a row. Raises StoreError for what is no store of the present schema, and for a ledger
    that was not begun with the key that DENGINE_LEDGER_KEY names.
    """
    wanted = "" if expect is None else expect.strip().lower()
    if expect is not None and (not 8 <= len(wanted) <= 64 or set(wanted) - set("0123456789abcdef")):
        raise StoreError(f"Expected a digest of 64 hexadecimal digits, or its first 8 or more, got {expect!r}.")
    with reading(str(url)) as connection:
        names = _chosen_cells(connection, cell_id)
        journals = {name: journal_path(connection.engine.url, name) for name in names}
        known = {name: read_newest_entries(path) for name, path in journals.items()}
        waiting = {name: _count_waiting(path) for name, path in journals.items()}
    with reading(str(url)) as connection:  # anew: what the journals knew is in the store as it is now
        pages = integrity(connection) if connection.dialect.name == "sqlite" else []
        faults = [HistoryFault("", "file", "", said) for said in pages]
        checks = [CellCheck(connection, name, on_rows) for name in names]
        for check in checks:
            must_have_key(connection, check.cell_id, check.key)
            faults += check.run()
            lacking = [number for number, digest in known[check.cell_id] if digest not in check.digests]
            what = "is not there, though the cell's journal knows it: the history was cut off, or put back from a copy"
            faults += [HistoryFault(check.cell_id, LEDGER.name, f"entry {number}", what) for number in lacking]
    if wanted and not any(digest.startswith(wanted) for check in checks for digest in check.digests):
        what = "is in no entry: the history was cut off before it, or made anew"
        faults.append(HistoryFault(cell_id or "", LEDGER.name, f"digest {wanted}", what))
    cells = (
        CellHistory(each.cell_id, len(each.digests), each.rows, "".join(each.digests[-1:]), waiting[each.cell_id])
        for each in checks
    )
    return HistoryReport(tuple(cells), tuple(faults))


def _count_waiting(journal: Path) -> int | None:
    with suppress(StoreError):  # it is damaged, or another user's
        return len(read_undrained(journal)) if journal.exists() else None
    return None


def _chosen_cells(connection: sa.Connection, cell_id: str | None) -> list[str]:
    """The cells that are asked for, None: all that any table names; StoreError for one that the store does not know."""
    found: set[str] = set()
    for table in METADATA.tables.values():
        with suppress(sa.exc.DatabaseError):  # damaged: of that table nothing is asked
            found |= {str(cell) for cell in connection.execute(sa.select(table.c.cell_id).distinct()).scalars()}
    cells = sorted(found)
    if cell_id is not None and cell_id not in cells:
        raise StoreError(f"Expected a cell of the store ({', '.join(cells) or 'none'}), got {cell_id!r}; name one of them.")
    return cells if cell_id is None else [cell_id]


class CellCheck:
    """The check of one cell.

    digests : of its entries, oldest first, in hexadecimal, once it ran.  rows : that were read.
    """

    def __init__(self, connection: sa.Connection, cell_id: str, on_rows: Callable[[int], None] | None) -> None:
        self.connection, self.cell_id, self.on_rows, self.key = connection, cell_id, on_rows, ledger_key()
        self.digests: list[str] = []
        self._sums = {table: bytearray() for table in CHAINED}
        self.rows, self._unread = 0, False

    def run(self) -> list[HistoryFault]:
        """Read everything, and say what is wrong."""
        faults = [fault for table in CHAINED for fault in self._guarded(table, self._check_rows(table))]
        faults += self._guarded(LEDGER.name, self._check_ledger())
        faults += self._guarded(SETTING.name, self._check_settings())
        if not self._unread:  # else all that could not be read would be missing
            faults += [fault for pair in NEEDS for fault in self._guarded(pair[0].name, self._check_pairs(*pair))]
        return faults

    def _guarded(self, table: str, faults: Iterator[HistoryFault]) -> Iterator[HistoryFault]:
        try:
            yield from faults
        except sa.exc.DatabaseError as error:
            self._unread = True
            yield self._fault(table, "", f"cannot be read to its end: {error.orig}")

    def _fault(self, table: str, key: object, what: str) -> HistoryFault:
        return HistoryFault(self.cell_id, table, str(key), what)

    def _raw(self, table: str) -> Iterator[dict[str, Any]]:
        """The cell's rows of a table as the database holds them, without what SQLAlchemy makes of them."""
        query = sa.text(f'SELECT * FROM "{table}" WHERE cell_id = :cell')  # no type is known, none is converted
        for row in self.connection.execute(query.execution_options(yield_per=CHUNK), {"cell": self.cell_id}):
            yield dict(row._mapping)

    def _check_rows(self, table: str) -> Iterator[HistoryFault]:
        for row in self._raw(table):
            self.rows += 1
            if self.on_rows is not None and self.rows % CHUNK == 0:
                self.on_rows(CHUNK)
            key, entry, stored = row[KEY[table]], row["entry"], row["sum"]
            if entry is None and stored is None:
                yield self._fault(table, key, "is not chained: something beside dengine wrote it")
                continue
            now = row_sum(table, row)
            if now != stored:
                yield self._fault(table, key, "was changed")
            if table == VERSION.name and row["state"] is not None and state_sum(_bytes(row["state"])) != row["state_sum"]:
                yield self._fault(table, key, "its state was changed")
            if isinstance(entry, int):
                self._sums[table] += KEPT.pack(entry, _bytes(stored), now)

    def _check_ledger(self) -> Iterator[HistoryFault]:
        """Hold every entry to the one before and to its rows; one that lacks rows says how many of which table."""
        sums = {table: np.frombuffer(kept, SUMS) for table, kept in self._sums.items()}
        sums = {table: each[np.argsort(each["entry"], kind="stable")] for table, each in sums.items()}
        held, previous = set[int](), {START}
        for row in sorted(self._raw(LEDGER.name), key=lambda row: _integer(row["number"])):
            number = _integer(row["number"])
            mine = {t: each[slice(*np.searchsorted(each["entry"], (number, number + 1)))] for t, each in sums.items()}
            head = {name: value for name, value in row.items() if name != "digest"}
            stored, now = ({t: each[of].tolist() for t, each in mine.items() if len(each)} for of in ("stored", "now"))
            # After an entry that was changed the chain goes on from what it said, or from what it should have said.
            found, told = {entry_digest(each, head, self.key) for each in previous}, _bytes(row["digest"])
            if told not in found or _bytes(row["rows"]) not in (rows_digest(stored), rows_digest(now)):
                yield self._fault(LEDGER.name, f"entry {row['number']}", _entry_fault(row["added"], now))
            previous = {told, *found}
            self.digests.append(told.hex())
            held.add(number)
        newest = max([0, *held, *(int(each["entry"][-1]) for each in sums.values() if len(each))])
        for number in islice((n for n in range(1, newest + 1) if n not in held), SHOWN):
            yield self._fault(LEDGER.name, f"entry {number}", "is missing")

    def _check_settings(self) -> Iterator[HistoryFault]:
        for key, what in settings_faults(self.connection, self.cell_id).items():
            yield self._fault(SETTING.name, key, what)
        mine = (SETTING.c.cell_id == self.cell_id) & (SETTING.c.key == SCHEMA_KEY)
        if self.connection.execute(sa.select(SETTING.c.key).where(mine)).first() is None:
            yield self._fault(SETTING.name, SCHEMA_KEY, "is missing: no engine has opened this cell")

    def _check_pairs(self, having: sa.Table, needed: sa.Table) -> Iterator[HistoryFault]:
        key, other = having.c[KEY[having.name]], needed.c[KEY[needed.name]]
        both = having.outerjoin(needed, (needed.c.cell_id == having.c.cell_id) & (other == key))
        query = sa.select(key).select_from(both).where(having.c.cell_id == self.cell_id, other.is_(None))
        for id_ in self.connection.execute(query).scalars():
            yield self._fault(needed.name, id_, f"is missing: a row of {having.name} is there")


def _entry_fault(added: Any, found: Mapping[str, list[bytes]]) -> str:
    """Say why an entry's digest does not come out."""
    counts: dict[str, int] = {}
    with suppress(TypeError, ValueError):
        counts = dict(json.loads(added))
    there = {table: len(sums) for table, sums in found.items()}
    other = [name for name in sorted(counts.keys() | there.keys()) if counts.get(name, 0) != there.get(name, 0)]
    lacking = "; ".join(f"{counts.get(name, 0)} of {name}, {there.get(name, 0)} found" for name in other)
    return f"chained {lacking}" if lacking else "was changed, or rows that it chains were"


def _bytes(value: Any) -> bytes:
    return bytes(value) if isinstance(value, bytes | bytearray | memoryview) else b""


def _integer(value: Any) -> int:
    return value if isinstance(value, int) else -1
