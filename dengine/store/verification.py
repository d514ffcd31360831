"""Whether a store's history is what was written: every row against its sum, every entry of the ledger against its rows.

    report = verify_history("engine.db")
    report.ok, report.faults, report.cells[0].digest      # keep the digest elsewhere: `expect` asks for it again

A chain that is whole says that nothing in it was changed, added or removed since it was written, but for its newest
entries: those can be cut off without a trace in the store, which is what `expect` is for. Nor can it tell a history that
somebody with the right to write has made anew from its beginning; a digest that was kept elsewhere does.
"""

from __future__ import annotations

import json
import sqlite3
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import sqlalchemy as sa

from ..errors import StoreError
from .connections import advice, make_engine
from .journal import journal_path, newest_known
from .ledger import START, entry_digest, held_settings, row_sum, state_sum
from .schema import (
    CHAINED,
    DECISION,
    EVENT,
    LABEL,
    LEDGER,
    METADATA,
    PRODUCT_KEY,
    SCHEMA_KEY,
    SETTING,
    TRACE,
    VERSION,
    check_schema,
)

TABLES = METADATA.tables
CHUNK = 500  # rows fetched at a time


@contextmanager
def snapshot(url: str) -> Iterator[sa.Connection]:
    """Connect to a store of the present schema, and see it as it is now. StoreError where there is none."""
    engine = make_engine(url)
    name = engine.url.render_as_string(hide_password=True)
    sqlite = engine.dialect.name == "sqlite"
    if sqlite and not Path(str(engine.url.database)).is_file():
        engine.dispose()
        raise StoreError(f"Expected a store that an engine has used, found no file {engine.url.database}; name another.")
    if sqlite:
        sa.event.listen(engine, "connect", _take_any_text)
    options = {} if sqlite else {"isolation_level": "REPEATABLE READ", "postgresql_readonly": True}
    try:
        with engine.connect() as connection:  # rolled back at its end: there is nothing to commit
            connection.execution_options(**options)
            check_schema(connection, name)
            yield connection
    except (sa.exc.SQLAlchemyError, sqlite3.Error, OSError, UnicodeDecodeError) as error:  # the last of damaged names
        raise StoreError(f"Could not read {name}: {getattr(error, 'orig', None) or error}. {advice(error)}") from error
    finally:
        engine.dispose()


def _take_any_text(connection: Any, record: Any) -> None:
    """Read a text of which a byte was damaged too, so that it can be named."""
    connection.text_factory = lambda text: text.decode("utf-8", "backslashreplace")


def cells_of(connection: sa.Connection) -> list[str]:
    """Return the cells that any table names, in order; of a table that is damaged nothing is asked."""
    cells: set[str] = set()
    for table in TABLES.values():
        with _damage_aside(connection):
            cells |= {str(cell) for cell in connection.execute(sa.select(table.c.cell_id).distinct()).scalars()}
    return sorted(cells)


@contextmanager
def _damage_aside(connection: sa.Connection) -> Iterator[None]:
    """Go on after a table of a file that cannot be read; on PostgreSQL the whole transaction is over then."""
    try:
        yield
    except sa.exc.DatabaseError:
        if connection.dialect.name != "sqlite":
            raise


def chosen_cells(connection: sa.Connection, cell_id: str | None) -> list[str]:
    """Return the cells that are asked for, None: all. StoreError for one that the store does not know."""
    cells = cells_of(connection)
    if cell_id is not None and cell_id not in cells:
        raise StoreError(f"Expected a cell of the store ({', '.join(cells) or 'none'}), got {cell_id!r}; name one of them.")
    return cells if cell_id is None else [cell_id]


def raw_rows(connection: sa.Connection, table: str, cell_id: str) -> Iterator[dict[str, Any]]:
    """Yield a cell's rows of a table as the database holds them, without what SQLAlchemy makes of them."""
    found = connection.execute(  # text: no type is known, none is converted
        sa.text(f'SELECT * FROM "{table}" WHERE cell_id = :cell').execution_options(yield_per=CHUNK), {"cell": cell_id}
    )
    for row in found:
        yield dict(row._mapping)


def count_rows(url: str, cell_id: str | None = None) -> int:
    """Return how many rows a store holds, of one cell or of all; those of a damaged table are not counted."""
    n = 0
    with snapshot(url) as connection:
        chosen_cells(connection, cell_id)
        for table in TABLES.values():
            query = sa.select(sa.func.count()).select_from(table)
            with _damage_aside(connection):
                n += connection.execute(query if cell_id is None else query.where(table.c.cell_id == cell_id)).scalar_one()
    return n


SUM = 32  # bytes
KEY = {name: next(c.name for c in table.primary_key if c.name != "cell_id") for name, table in CHAINED.items()}
NUMBER = {name: key for name, key in KEY.items() if isinstance(CHAINED[name].c[key].type, sa.BigInteger)}
NUMBER |= {LABEL.name: LABEL.c.seq.name}  # columns that count 1, 2, ... in each cell, or over its product, without a gap
OWN = (EVENT.name,)  # counted in each cell in any case
NEEDS = ((DECISION, TRACE), (TRACE, DECISION), (LABEL, DECISION))  # a row of the first has one of the second
SHOWN = 20  # numbers of missing rows that are named one by one


@dataclass(frozen=True, slots=True)
class HistoryFault:
    """What is wrong in a store's history; key : which row of the table, as far as is known."""

    cell_id: str
    table: str
    key: str
    what: str


@dataclass(frozen=True, slots=True)
class CellHistory:
    """A cell's history: entries of its ledger, rows that they chain, and the newest digest, "" without an entry."""

    cell_id: str
    entries: int
    rows: int
    digest: str


class RowSums:
    """Sums of a table's rows, by the entry that each is of: 40 bytes a row."""

    def __init__(self) -> None:
        self._entries = array("q")
        self._sums = bytearray()
        self._now: dict[int, bytes] = {}  # of rows that do not give their sum
        self._order: Any = None
        self._sorted: Any = None

    def add(self, entry: int, stored: bytes, now: bytes) -> None:
        """Take in a row."""
        if stored != now:
            self._now[len(self._entries)] = now
        self._entries.append(entry)
        self._sums += stored[:SUM].ljust(SUM, b"\0")

    def of(self, entry: int) -> tuple[list[bytes], list[bytes]]:
        """The sums of the rows of an entry: as they stand there, and as they come out now."""
        if self._order is None:
            entries = np.array(self._entries, dtype=np.int64)
            self._order = np.argsort(entries, kind="stable")
            self._sorted = entries[self._order]
        first, last = np.searchsorted(self._sorted, [entry, entry + 1])
        rows = self._order[first:last].tolist()
        stored = [bytes(self._sums[SUM * i : SUM * (i + 1)]) for i in rows]
        return stored, [self._now.get(i, sum_) for i, sum_ in zip(rows, stored, strict=True)]

    def beyond(self, known: Iterable[int]) -> list[int]:
        """Entries that rows name and the ledger does not hold."""
        return sorted(set(np.unique(np.array(self._entries, dtype=np.int64)).tolist()) - set(known))


class CellCheck:
    """The check of one cell.

    digests : of its entries, oldest first, in hexadecimal, once it ran.
    """

    def __init__(self, connection: sa.Connection, cell_id: str, on_rows: Callable[[int], None]) -> None:
        self.connection, self.cell_id, self.on_rows = connection, cell_id, on_rows
        self.digests: list[str] = []
        self._rows = 0
        self._sums = {table: RowSums() for table in CHAINED}
        self._unread: list[str] = []

    def history(self) -> CellHistory:
        """What there is."""
        return CellHistory(self.cell_id, len(self.digests), self._rows, self.digests[-1] if self.digests else "")

    def run(self) -> list[HistoryFault]:
        """Read everything, and say what is wrong."""
        faults = [fault for table in CHAINED for fault in self._guarded(table, self._check_rows(table))]
        faults += self._guarded(LEDGER.name, self._check_ledger())
        faults += self._guarded(SETTING.name, self._check_entered())
        if not self._unread:  # else all that could not be read would be missing
            faults += [fault for pair in NEEDS for fault in self._guarded(pair[0].name, self._check_pairs(*pair))]
        return faults

    def _guarded(self, table: str, faults: Iterator[HistoryFault]) -> Iterator[HistoryFault]:
        try:
            yield from faults
        except sa.exc.DatabaseError as error:
            self._unread.append(table)
            yield self._fault(table, "", f"cannot be read to its end: {error.orig}")

    def _fault(self, table: str, key: object, what: str) -> HistoryFault:
        return HistoryFault(self.cell_id, table, str(key), what)

    def _check_rows(self, table: str) -> Iterator[HistoryFault]:
        numbers: list[Any] = []
        for n, row in enumerate(raw_rows(self.connection, table, self.cell_id), start=1):
            yield from self._check_row(table, row)
            if table in NUMBER:
                numbers.append(row[NUMBER[table]])
            if n % CHUNK == 0:
                self.on_rows(CHUNK)
        if table in OWN or not self._of_a_product():
            yield from self._gaps(table, NUMBER.get(table, ""), numbers)

    def _of_a_product(self) -> bool:
        """Whether sisters have the numbers between: then the ledger's entries alone tell what is missing."""
        mine = (SETTING.c.cell_id == self.cell_id) & (SETTING.c.key == PRODUCT_KEY)
        return self.connection.execute(sa.select(SETTING.c.key).where(mine)).first() is not None

    def _check_row(self, table: str, row: Mapping[str, Any]) -> Iterator[HistoryFault]:
        self._rows += 1
        key, entry, stored = row[KEY[table]], row["entry"], row["sum"]
        if entry is None and stored is None:
            yield self._fault(table, key, "is not chained: something beside dengine wrote it, or an older dengine")
            return
        now = row_sum(table, row)
        if now != stored:
            yield self._fault(table, key, "was changed")
        if table == VERSION.name and row["state"] is not None and state_sum(_bytes(row["state"])) != row["state_sum"]:
            yield self._fault(table, key, "its state was changed")
        if isinstance(entry, int):
            self._sums[table].add(entry, _bytes(stored), now)

    def _gaps(self, table: str, column: str, numbers: list[Any]) -> Iterator[HistoryFault]:
        held = {number for number in numbers if isinstance(number, int)}
        missing = sorted(set(range(1, max(held, default=0) + 1)) - held) if len(held) < max(held, default=0) else []
        for number in missing[:SHOWN]:
            yield self._fault(table, f"{column} {number}", "is missing")
        if len(missing) > SHOWN:
            yield self._fault(table, f"{column} {missing[SHOWN]} to {missing[-1]}", "are missing, or some of them")

    def _check_pairs(self, having: sa.Table, needed: sa.Table) -> Iterator[HistoryFault]:
        key, other = having.c[KEY[having.name]], needed.c[KEY[needed.name]]
        both = having.outerjoin(needed, (needed.c.cell_id == having.c.cell_id) & (other == key))
        query = sa.select(key).select_from(both).where(having.c.cell_id == self.cell_id, other.is_(None))
        for id_ in self.connection.execute(query).scalars():
            yield self._fault(needed.name, id_, f"is missing: a row of {having.name} is there")

    def _check_ledger(self) -> Iterator[HistoryFault]:
        rows = sorted(raw_rows(self.connection, LEDGER.name, self.cell_id), key=lambda row: _integer(row["number"]))
        previous, settings = {START}, None
        for row in rows:
            head = {name: value for name, value in row.items() if name != "digest"}
            sums = {table: each.of(_integer(row["number"])) for table, each in self._sums.items()}
            stored, now = ({table: both[i] for table, both in sums.items() if both[i]} for i in (0, 1))
            # After an entry that was changed the chain goes on from what it said, or from what it should have said.
            told, found = _bytes(row["digest"]), {entry_digest(p, head, s) for p in previous for s in (stored, now)}
            if told not in found:
                yield self._fault(LEDGER.name, f"entry {row['number']}", _entry_fault(row["added"], now))
            previous = {told, entry_digest(min(previous), head, now)}
            settings = row if row["settings"] is not None else settings
            self.digests.append(told.hex())
        numbers = [row["number"] for row in rows]
        yield from self._gaps(LEDGER.name, "entry", numbers)
        for table, each in self._sums.items():
            for entry in each.beyond(number for number in numbers if isinstance(number, int))[:SHOWN]:
                yield self._fault(table, f"entry {entry}", "the ledger does not hold the entry that rows are of")
        yield from self._check_settings(settings)

    def _check_settings(self, newest: Mapping[str, Any] | None) -> Iterator[HistoryFault]:
        held = held_settings(self.connection, self.cell_id)
        try:
            chained = {} if newest is None else json.loads(newest["settings"])
        except (TypeError, ValueError):
            chained = {}  # the entry itself was named
        for key in sorted(held.keys() | chained.keys(), key=str):
            if key not in chained:
                yield self._fault(SETTING.name, key, "is not chained")
            elif key not in held:
                yield self._fault(SETTING.name, key, "is missing")
            elif held[key] != chained[key]:
                yield self._fault(SETTING.name, key, "was changed")

    def _check_entered(self) -> Iterator[HistoryFault]:
        mine = (SETTING.c.cell_id == self.cell_id) & (SETTING.c.key == SCHEMA_KEY)
        if self.connection.execute(sa.select(SETTING.c.key).where(mine)).first() is None:
            yield self._fault(SETTING.name, SCHEMA_KEY, "is missing: no engine has opened this cell")


def _entry_fault(added: Any, found: Mapping[str, list[bytes]]) -> str:
    """Say why an entry's digest does not come out."""
    try:
        counts = dict(json.loads(added))
    except (TypeError, ValueError):
        counts = {}
    differing = [
        f"{counts.get(table, 0)} of {table}, {len(found.get(table, ()))} found"
        for table in sorted(counts.keys() | found.keys())
        if counts.get(table, 0) != len(found.get(table, ()))
    ]
    return "chained " + "; ".join(differing) if differing else "was changed, or rows that it chains were"


def _bytes(value: Any) -> bytes:
    return bytes(value) if isinstance(value, bytes | bytearray | memoryview) else b""


def _integer(value: Any) -> int:
    return value if isinstance(value, int) else -1


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
    Takes about 50 bytes of memory a row. Raises StoreError for what is no store of the present schema.
    """
    wanted = _hexadecimal(expect)
    with snapshot(str(url)) as connection:
        faults = list(_pages(connection))
        checks = [CellCheck(connection, cell, on_rows or (lambda n: None)) for cell in chosen_cells(connection, cell_id)]
        for check in checks:
            faults += check.run()
            known = newest_known(journal_path(connection.engine.url, check.cell_id))
            if known is not None and known[1] not in check.digests:
                what = "is not there, though the cell's journal knows it: the history was cut off, or put back from a copy"
                faults.append(HistoryFault(check.cell_id, LEDGER.name, f"entry {known[0]}", what))
    if wanted and not any(digest.startswith(wanted) for check in checks for digest in check.digests):
        what = "is in no entry: the history was cut off before it, or made anew"
        faults.append(HistoryFault(cell_id or "", "ledger", f"digest {wanted}", what))
    return HistoryReport(tuple(check.history() for check in checks), tuple(faults))


def _hexadecimal(digest: str | None) -> str:
    wanted = "" if digest is None else digest.strip().lower()
    if digest is not None and (not 8 <= len(wanted) <= 64 or set(wanted) - set("0123456789abcdef")):
        raise StoreError(f"Expected a digest of 64 hexadecimal digits, or its first 8 or more, got {digest!r}.")
    return wanted


def _pages(connection: sa.Connection) -> Iterator[HistoryFault]:
    """What SQLite itself finds wrong in its file."""
    if connection.dialect.name != "sqlite":
        return
    try:
        said = [str(line) for line in connection.execute(sa.text("PRAGMA integrity_check")).scalars()]
    except sa.exc.DatabaseError as error:
        said = [str(error.orig)]
    yield from (HistoryFault("", "file", "", line) for line in said if line != "ok")
