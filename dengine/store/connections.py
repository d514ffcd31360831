"""A database that one cell writes to: engine, transactions, the lease on the cell, and what goes in.

A deleted file, a fork, and a row that the database refuses are each met here.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import sqlite3
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import sqlalchemy as sa

from ..errors import DengineError, StoreError, shortened
from .journal import Record, TakenLabel, owned_by, owner
from .ledger import LedgerEntry, chain_writes, held_settings, is_sound
from .queries import Scope, held_query, join_product
from .records import Event, StoredDecision, as_text, pack, to_row
from .schema import (
    CORRECTION,
    DECISION,
    EVENT,
    LABEL,
    LEDGER,
    TRACE,
    chunks,
    decision_row,
    label_row,
    prepare_tables,
    trace_row,
)

log = logging.getLogger("dengine")
T = TypeVar("T")

# Of a server that answers no more, libpq says so after some seconds, not hours.
PATIENCE = {
    "connect_timeout": 5,
    "keepalives_idle": 5,
    "keepalives_interval": 2,
    "keepalives_count": 3,
    "tcp_user_timeout": 10000,
}
IN_FORCE = 10_000  # newest labels that are held to their sums when an engine opens the store
BUSY = 10.0  # seconds to wait for another process that writes to the same SQLite file


def make_engine(url: str) -> sa.Engine:
    """Return an engine for a file or URL; refuses what this store was never tested on."""
    if as_text(url) != url:
        raise StoreError(
            f"Expected a file or a database URL of UTF-8 characters without a NUL, got {shortened(url)}; rename it."
        )
    try:
        parsed = sa.make_url(url) if "://" in url else sa.URL.create("sqlite", database=str(Path(url)))
        if parsed.drivername in ("postgres", "postgresql"):
            parsed = parsed.set(drivername="postgresql+psycopg")
        backend = parsed.get_backend_name()
        forgets = backend == "sqlite" and parsed.database in (None, "", ":memory:")
        if forgets or backend not in ("sqlite", "postgresql"):
            raise StoreError(
                f"Expected a file, an SQLite file URL or a PostgreSQL URL, got {parsed.render_as_string()}; "
                "for a store that forgets use store=None."
            )
        if backend == "postgresql":
            return sa.create_engine(parsed, pool_pre_ping=True, connect_args=PATIENCE)
        engine = sa.create_engine(parsed, connect_args={"timeout": BUSY})
    except (sa.exc.ArgumentError, ImportError) as error:
        raise _unusable(url, f"{error}") from error
    except ValueError as error:
        if "@" not in url:
            raise _unusable(url, f"{error}") from error
        # What it quotes, and takes for a port, may be half of a password.
        raise _unusable(url, "it cannot be read; write @, : and / in a password as %40, %3A and %2F") from None
    sa.event.listen(engine, "connect", _set_pragmas)
    sa.event.listen(engine, "begin", _begin)
    return engine


class WatchedFile:
    """The file of an SQLite database, by device and inode: a deleted or replaced one still takes writes, for nobody."""

    def __init__(self, url: sa.URL) -> None:
        self.path = Path(str(url.database)) if url.get_backend_name() == "sqlite" else None
        if self.path is not None and not self.path.is_file():
            self.path = None  # named by an URI of SQLite's own
        self._opened = None if self.path is None else self.path.stat()

    def check(self) -> None:
        """Raise an OSError where the file at the path is no longer the one that was opened."""
        if self.path is None or self._opened is None:
            return
        try:
            same = os.path.samestat(self.path.stat(), self._opened)
        except OSError:
            same = False
        if not same:
            raise FileNotFoundError("the file was deleted, moved or replaced while it was open")


def _unusable(url: str, said: str) -> StoreError:
    return StoreError(
        f"Expected a file or a database URL that can be used here, got {url.split('@')[-1]!r}: {said}. "
        "For PostgreSQL: pip install 'dengine[postgres]'."
    )


def _set_pragmas(connection: Any, record: Any) -> None:
    connection.isolation_level = None  # `_begin` says when a transaction starts, not the driver
    try:
        tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master")}
        if not tables or {"setting", "decision"} <= tables:  # another program's file is refused, and left as it is
            connection.execute("PRAGMA journal_mode = WAL")
    except UnicodeDecodeError as error:  # SQLite quotes a damaged table's name in what it says
        raise sqlite3.DatabaseError("the database is malformed") from error
    connection.execute("PRAGMA synchronous = FULL")  # a returned commit survives lost power; NORMAL would not


def _begin(connection: sa.Connection) -> None:
    # busy_timeout does not cover a read that turns into a write, so a writer takes its lock at once.
    write = connection.get_execution_options().get("dengine_write", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")


def advice(error: BaseException) -> str:
    """Say what to do about a database error, as far as its text tells."""
    said = str(error).lower()
    for text, what_to_do in (
        ("not a database", "The file is something else; name a new file, or a store that dengine wrote."),
        ("unable to open", "Create the directory, or name one that can be written."),
        ("readonly", "Make the file and its directory writable."),
        ("full", "Free some space on the disk."),
        ("locked", "Another process holds the database; close it, or wait."),
        ("while it was open", "Put it back, or close this store and open the new one."),
        ("malformed", "The file is damaged; restore it from a copy."),
    ):
        if text in said:
            return what_to_do
    return "Check that the database is there and can be written."


OF_A_ROW = (sa.exc.IntegrityError, sa.exc.DataError, OverflowError, ValueError, TypeError)  # the database itself is well


class Database:
    """An open database, prepared for a cell; one thread writes at a time.

    url : a file (SQLite), or a SQLAlchemy URL of SQLite or PostgreSQL.
    clock : the time in seconds that entries of the ledger are stamped with.
    scope : the cell and its product.  name : the URL without its password.  failures : how many writes failed so far.
    before_use : called before each transaction, so that it sees what is on its way into the database.
    """

    def __init__(
        self, url: str, cell_id: str, clock: Callable[[], float], product: str | None, before_use: Callable[[], None]
    ) -> None:
        self.cell_id = cell_id
        self.failures = 0
        self._newest: tuple[int, str] | None = None  # entry of the ledger
        self._before_use = before_use
        self._clock = clock
        self._closed = False
        self._pid = os.getpid()
        self._writing = threading.RLock()  # one write transaction at a time in this process
        self._asked = threading.local()  # of each thread, what says whether its commit is wanted still
        self._leasing = False  # a lease is taken on each new connection that writes
        self._leased: sa.Connection | None = None
        self._engine = make_engine(url)
        chain_writes(self._engine)
        self.name = self._engine.url.render_as_string(hide_password=True)
        self.scope = self._open(product)
        self._file = WatchedFile(self._engine.url)

    @property
    def url(self) -> sa.URL:
        """Of the database, its password included."""
        return self._engine.url

    def _open(self, product: str | None) -> Scope:
        try:
            with self._told("open"), self._engine.connect() as plain:
                connection = plain.execution_options(dengine_write=True)
                with connection.begin():
                    prepare_tables(connection, self.cell_id, self.name)
                    return Scope(self.cell_id, join_product(connection, self.cell_id, product))
        except StoreError:
            self._engine.dispose()
            raise

    @contextmanager
    def _told(self, doing: str, write: bool = False) -> Iterator[None]:
        """Turn what a database raises into a StoreError that says what to do."""
        try:
            yield
        except DengineError:
            raise
        except (sa.exc.SQLAlchemyError, sqlite3.Error, OSError, *OF_A_ROW) as error:
            self.failures += write
            raise StoreError(
                f"Could not {doing} {self.name}: {getattr(error, 'orig', None) or error}. {advice(error)}"
            ) from error

    @contextmanager
    def transaction(self, write: bool) -> Iterator[sa.Connection]:
        """Begin a transaction that is committed at its end, or rolled back by an error."""
        self.check_open()
        if not write:
            self._before_use()
        with self._told("write to" if write else "read", write), self._connected(write) as plain:
            entry = LedgerEntry(self.scope, self._clock) if write else None
            connection = plain.execution_options(dengine_write=write, dengine_entry=entry)
            with connection.begin():
                if write:
                    self._file.check()
                yield connection
                newest = None if entry is None else entry.append(connection)  # chains what the transaction added
                if write and not getattr(self._asked, "wanted", lambda: True)():
                    raise StoreError(f"Could not write to {self.name} in time, and was given up; nothing was written.")
            self._newest = newest or self._newest
            if write:
                self._file.check()  # nobody is told that a file holds what went into another one

    @contextmanager
    def committing(self, wanted: Callable[[], bool]) -> Iterator[None]:
        self._asked.wanted = wanted
        try:
            yield
        finally:
            del self._asked.wanted

    @contextmanager
    def _connected(self, write: bool) -> Iterator[sa.Connection]:
        """A connection of the pool; a leased cell writes through the one connection that holds its lease."""
        if not write or not self._leasing:
            with self._engine.connect() as connection:
                yield connection
            return
        if self._leased is None:
            self._leased = self._engine.connect()
        try:
            if not self._leased.info.get("leased"):
                self._take_lease(self._leased)
                self._leased.commit()
                self._leased.info["leased"] = True
            yield self._leased
        except (sa.exc.SQLAlchemyError, StoreError):
            self._let_lease_go()
            raise
        if self._closed:  # meanwhile: `close` did not wait
            self._disconnect()

    def newest_entry(self) -> tuple[int, str] | None:
        """Number and digest of the newest entry of the ledger that is known here; None where there is none."""
        if self._newest is None:
            mine = sa.select(LEDGER.c.number, LEDGER.c.digest).where(LEDGER.c.cell_id == self.cell_id)
            for row in self.read(mine.order_by(LEDGER.c.number.desc()).limit(1)):
                self._newest = row.number, row.digest.hex()
        return self._newest

    def holds_entry(self, number: int, digest: str) -> bool:
        """Whether the ledger has that entry."""
        mine = (LEDGER.c.cell_id == self.cell_id) & (LEDGER.c.number == number)
        return [row.digest.hex() for row in self.read(sa.select(LEDGER.c.digest).where(mine))] == [digest]

    def doubt(self) -> str:
        """What of settings, labels and corrections is not as the ledger has it, in words; "" where nothing is."""
        newest = sa.select(LEDGER.c.settings).where(LEDGER.c.cell_id == self.cell_id, LEDGER.c.settings.is_not(None))
        chained = self.read(newest.order_by(LEDGER.c.number.desc()).limit(1))
        with self.transaction(write=False) as connection:
            held = held_settings(connection, self.cell_id)
        if chained and json.loads(chained[0].settings) != held:
            return "the settings are not those of the ledger"
        labels = sa.select(LABEL).where(LABEL.c.cell_id == self.cell_id).order_by(LABEL.c.seq.desc()).limit(IN_FORCE)
        corrections = sa.select(CORRECTION).where(CORRECTION.c.cell_id == self.cell_id)
        for table, query in ((LABEL, labels), (CORRECTION, corrections)):
            for row in self.read(query):
                if not is_sound(table.name, dict(zip(table.c.keys(), row, strict=True))):
                    return f"the {table.name} of decision {row.decision_id!r} is not as it was written"
        return ""

    def lease(self) -> None:
        """Write from now on through one connection that holds the cell; StoreError where another engine has it."""
        self._leasing = True
        try:
            self.write(lambda connection: None)
        except StoreError:
            self._leasing = False
            raise

    def _take_lease(self, connection: sa.Connection) -> None:
        """Lock the cell for as long as this PostgreSQL connection lives."""
        connection.execute(
            sa.text("SELECT set_config('application_name', :who, false)"), {"who": f"dengine {owner()}"[:63]}
        )
        digest = hashlib.sha256(b"dengine " + self.cell_id.encode()).digest()
        key = {"key": int.from_bytes(digest[:8], "big", signed=True)}
        if connection.execute(sa.text("SELECT pg_try_advisory_lock(:key)"), key).scalar():
            return
        asked = sa.text(
            "SELECT a.application_name FROM pg_locks l JOIN pg_stat_activity a USING (pid) WHERE l.locktype = 'advisory' "
            "AND (l.classid::bigint << 32) + l.objid::bigint = :key AND l.objsubid = 1 AND l.granted"
        )
        holder = connection.execute(asked, key).scalar()
        raise owned_by(str(holder or "another engine"), f"cell {self.cell_id!r} of {self.name}")

    def _let_lease_go(self) -> None:
        connection, self._leased = self._leased, None
        if connection is not None:
            connection.invalidate()  # back in the pool its session would keep the lease
            connection.close()

    def check_open(self) -> None:
        """StoreError after closing, and in a fork."""
        if self._closed:
            raise StoreError(f"Expected an open store, got {self.name} after close(); open it again.")
        if os.getpid() != self._pid:
            raise StoreError(
                f"Expected the process that opened {self.name}, {self._pid}, got its fork {os.getpid()}; "
                "open the store after the fork, in the process that uses it."
            )

    def write(self, work: Callable[[sa.Connection], T]) -> T:
        """Commit what `work` adds, in one transaction."""
        self.check_open()
        self._before_use()  # not while others are kept from writing
        with self._writing, self.transaction(write=True) as connection:
            return work(connection)

    def read(self, query: sa.Select[Any]) -> Sequence[Any]:
        """Return the rows of a query."""
        with self.transaction(write=False) as connection:
            return connection.execute(query).all()

    def close(self, waiting: bool = True) -> None:
        """Disconnect; waiting : for a write that is under way."""
        if self._closed:
            return
        self._closed = True
        if self._writing.acquire(blocking=waiting):
            try:
                self._disconnect()
            finally:
                self._writing.release()

    def _disconnect(self) -> None:
        self._let_lease_go()
        self._engine.dispose()

    # What goes in

    def held(self, connection: sa.Connection, ids: Sequence[str]) -> dict[str, Any]:
        """What is stored of decisions and their labels, by id, once the cell is locked."""
        self.scope.lock_cell(connection)
        return {row.id: row for part in chunks(ids) for row in connection.execute(held_query(self.cell_id, part))}

    def insert(self, connection: sa.Connection, decisions: Sequence[StoredDecision]) -> None:
        """Add decisions and their traces."""
        for part in chunks(decisions):
            connection.execute(sa.insert(DECISION), [decision_row(self.cell_id, item) for item in part])
            connection.execute(sa.insert(TRACE), [trace_row(self.cell_id, item) for item in part])

    def insert_labels(self, connection: sa.Connection, labels: Sequence[TakenLabel], held: Mapping[str, Any]) -> list[int]:
        """Add labels of held decisions; returns their numbers."""
        first = self.scope.next_number(connection, LABEL.c.seq)
        for part in chunks(range(len(labels))):
            rows = [label_row(self.cell_id, labels[i], first + i, held[labels[i].label.decision_id]) for i in part]
            connection.execute(sa.insert(LABEL), rows)
        return list(range(first, first + len(labels)))

    def take(self, records: Sequence[Record]) -> list[tuple[str, int]]:
        """Commit what a journal held, as `Store.take`."""
        try:
            return self.write(lambda connection: self._take(connection, records))
        except StoreError as error:
            if not isinstance(error.__cause__, OF_A_ROW):
                raise
            if len(records) > 1:  # one of them is what the database refuses
                half = len(records) // 2
                return self.take(records[:half]) + self.take(records[half:])
            text = f"{_named(records[0])}, which the database refused: {error.__cause__}"
        self.write(lambda connection: self._insert_events(connection, [self._set_aside(text)]))
        return []

    def _take(self, connection: sa.Connection, records: Sequence[Record]) -> list[tuple[str, int]]:
        """Insert what is not there yet; what is there must be the same, or it becomes a dead letter."""
        events = [each for each in records if isinstance(each, Event)]
        if events:
            events = self._new_events(connection, events)
        events += self._take_decisions(connection, [each for each in records if isinstance(each, StoredDecision)])
        labels = [each for each in records if isinstance(each, TakenLabel)]
        held = self.held(connection, [each.label.decision_id for each in labels])
        numbers = {name: row.seq for name, row in held.items() if row.seq is not None}
        said = {name: (held[name].success, held[name].source) for name in numbers}
        fresh: dict[str, TakenLabel] = {}
        well: list[str] = []
        for each in labels:
            name, now = each.label.decision_id, (each.label.success, each.label.source.value)
            if name not in held:
                events.append(self._set_aside(f"{_named(each)}, which the store does not hold"))
            elif (held[name].content_hash, held[name].time) != (each.content_hash, each.decided):
                events.append(self._set_aside(f"{_named(each)}, of which the store holds another decision"))
            elif said.setdefault(name, now) != now:
                events.append(self._set_aside(f"a second label: {_named(each)}, which has one"))
            else:
                well.append(name)
                if name not in numbers:
                    fresh.setdefault(name, each)
        if fresh:
            numbers |= zip(fresh, self.insert_labels(connection, list(fresh.values()), held), strict=True)
        self._insert_events(connection, events)
        return [(name, numbers[name]) for name in dict.fromkeys(well)]

    def _take_decisions(self, connection: sa.Connection, decisions: Sequence[StoredDecision]) -> list[Event]:
        """Insert the new ones; returns what is to be said of those whose id has another decision."""
        same = (TRACE.c.cell_id == DECISION.c.cell_id) & (TRACE.c.decision_id == DECISION.c.id)
        query = sa.select(*DECISION.c, TRACE.c.data).select_from(DECISION.outerjoin(TRACE, same))
        query = query.where(DECISION.c.cell_id == self.cell_id)
        stored: dict[str, Any] = {}
        for part in chunks([each.decision.id for each in decisions]):
            stored |= {row.id: row._mapping for row in connection.execute(query.where(DECISION.c.id.in_(part)))}
        self.insert(connection, [each for each in decisions if each.decision.id not in stored])
        events = []
        for each in decisions:
            if (row := stored.get(each.decision.id)) is not None:
                given = decision_row(self.cell_id, each) | {"data": pack(each.trace)}
                if other := ", ".join(name for name, value in given.items() if row[name] != value):
                    events.append(self._set_aside(f"{_named(each)}, of which the store holds another: {other} differ"))
        return events

    def _new_events(self, connection: sa.Connection, events: Sequence[Event]) -> list[Event]:
        query = sa.select(EVENT.c.time, EVENT.c.kind, EVENT.c.text).where(EVENT.c.cell_id == self.cell_id)
        stored = {tuple(row) for row in connection.execute(query.where(EVENT.c.time.in_([each.time for each in events])))}
        return [each for each in events if (each.time, each.kind, each.text) not in stored]

    def _insert_events(self, connection: sa.Connection, events: Sequence[Event]) -> None:
        if events:
            first = self.scope.next_number(connection, EVENT.c.number)
            rows = [to_row(each) | {"cell_id": self.cell_id, "number": i} for i, each in enumerate(events, first)]
            connection.execute(sa.insert(EVENT), rows)

    def _set_aside(self, text: str) -> Event:
        log.error("dead letter: %s", text)
        return Event(0, self._clock(), "dead letter", as_text(text))


def _named(record: Record) -> str:
    if isinstance(record, Event):
        return f"an event, {record.text!r}"
    if isinstance(record, StoredDecision):
        return f"a decision, {record.decision.id!r}"
    said = "success" if record.label.success else "failure"
    return f"a label, {said} from {record.label.source.value}, on {record.label.decision_id!r}"
