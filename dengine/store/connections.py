"""A database that one cell writes to: engine, transactions, lease on the cell, and the queue of decisions with its writer.

A deleted file, a fork, a lost answer and a row that the database refuses are each met here.
"""

from __future__ import annotations

import atexit
import hashlib
import logging
import os
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import sqlalchemy as sa

from ..errors import DengineError, StoreError, shortened
from .journal import owned_by, owner
from .ledger import LedgerEntry, chain_writes
from .queries import Scope, join_product
from .records import Event, StoredDecision, as_text, duplicate_id, to_row
from .schema import DECISION, EVENT, TRACE, chunks, decision_row, prepare_tables, trace_row

log = logging.getLogger("dengine")
LINGER = 0.05  # seconds that a decision waits for company before it is committed
RETRY = 1.0  # seconds before the writer tries again after a failure
QUEUE_BYTES = 64 << 20  # of traces that may wait in memory

T = TypeVar("T")

# Of a server that answers no more, libpq says so after some seconds, not hours.
PATIENCE = {
    "connect_timeout": 5,
    "keepalives_idle": 5,
    "keepalives_interval": 2,
    "keepalives_count": 3,
    "tcp_user_timeout": 10000,
}
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
    """An open database, prepared for a cell, and the decisions on their way to it.

    url : a file (SQLite), or a SQLAlchemy URL of SQLite or PostgreSQL.
    clock : the time in seconds that entries of the ledger are stamped with.
    scope : the cell and its product.  name : the URL without its password.  failures : how many writes failed so far.
    """

    def __init__(self, url: str, cell_id: str, clock: Callable[[], float] = time.time, product: str | None = None) -> None:
        self.cell_id = cell_id
        self.failures = 0
        self._clock = clock
        self._queue: dict[str, StoredDecision] = {}
        self._queue_bytes = 0
        self._clash: StoreError | None = None
        self._doubtful = False  # the last write failed, and may have been committed all the same
        self._closed = self._left = False  # left: let go without writing
        self._pid = os.getpid()
        self._writing = threading.RLock()  # one write transaction at a time in this process
        self._asked = threading.local()  # of each thread, what says whether its commit is wanted still
        self._leasing = False  # a lease is taken on each new connection that writes
        self._leased: sa.Connection | None = None
        self._lock = threading.Condition()  # guards the queue
        self._stop = threading.Event()
        self._engine = make_engine(url)
        chain_writes(self._engine)
        self.name = self._engine.url.render_as_string(hide_password=True)
        self.scope = self._open(product)
        self._file = WatchedFile(self._engine.url)
        self._writer = threading.Thread(target=self._write_queue, name=f"dengine-store-{cell_id}", daemon=True)
        self._writer.start()
        atexit.register(self._close_at_exit)

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
            self._doubtful |= write
            n = len(self._queue)
            waiting = f" {n} decisions wait in memory; the next flush or report writes them." if n else ""
            raise StoreError(
                f"Could not {doing} {self.name}: {getattr(error, 'orig', None) or error}. {advice(error)}{waiting}"
            ) from error

    @contextmanager
    def transaction(self, write: bool) -> Iterator[sa.Connection]:
        """Begin a transaction that is committed at its end, or rolled back by an error."""
        self._check_open()
        with self._told("write to" if write else "read", write), self._connected(write) as plain:
            entry = LedgerEntry(self.cell_id, self._clock) if write else None
            connection = plain.execution_options(dengine_write=write, dengine_entry=entry)
            with connection.begin():
                if write:
                    self._file.check()
                yield connection
                if entry is not None:
                    entry.append(connection)  # chains what the transaction added
                if write and not getattr(self._asked, "wanted", lambda: True)():
                    raise StoreError(f"Could not write to {self.name} in time, and was given up; nothing was written.")
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

    def lease(self) -> None:
        """Write from now on through one connection that holds the cell; StoreError where another engine has it."""
        with self._writing:
            self._leasing = True
            try:
                with self.transaction(write=True):
                    pass
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

    def _disconnect(self) -> None:
        self._let_lease_go()
        self._engine.dispose()

    def _let_lease_go(self) -> None:
        connection, self._leased = self._leased, None
        if connection is not None:
            connection.invalidate()  # back in the pool its session would keep the lease
            connection.close()

    def _check_open(self) -> None:
        if self._closed:
            raise StoreError(f"Expected an open store, got {self.name} after close(); open it again.")
        if os.getpid() != self._pid:
            raise StoreError(
                f"Expected the process that opened {self.name}, {self._pid}, got its fork {os.getpid()}; "
                "open the store after the fork, in the process that uses it."
            )

    def write(self, work: Callable[[sa.Connection], T]) -> T:
        """Commit the queued decisions and `work` in one transaction."""
        with self._writing:
            with self._lock:
                batch = list(self._queue.values())
            try:
                return self._commit(work, batch)
            except StoreError as error:
                bad = self._unstorable(batch) if isinstance(error.__cause__, OF_A_ROW) else {}
                if not bad:
                    raise
                self._set_aside(bad)
                return self._commit(work, [item for item in batch if item.decision.id not in bad])

    def _commit(self, work: Callable[[sa.Connection], T], batch: Sequence[StoredDecision]) -> T:
        with self.transaction(write=True) as connection:
            self.insert(connection, self._not_yet_stored(connection, batch) if self._doubtful else batch)
            result = work(connection)
        self._doubtful = False
        self._forget(batch)
        return result

    def _unstorable(self, batch: Sequence[StoredDecision]) -> dict[str, str]:
        """Return which rows the database refuses for what they hold, each with the reason; nothing is written."""
        refused: dict[str, str] = {}
        with self._told("write to"), self._connected(write=True) as plain:
            connection = plain.execution_options(dengine_write=True, dengine_entry=LedgerEntry(self.cell_id, self._clock))
            with connection.begin() as tried:
                for item in self._not_yet_stored(connection, batch):
                    try:
                        with connection.begin_nested():
                            self.insert(connection, [item])
                    except OF_A_ROW as error:
                        refused[item.decision.id] = str(getattr(error, "orig", None) or error)
                tried.rollback()
        return refused

    def _set_aside(self, refused: dict[str, str]) -> None:
        """Take rows out of the queue that would keep all others from being written; they become events."""
        now = time.time()
        with self._lock:
            bad = [self._queue[name] for name in refused]
        self._forget(bad)

        def record(connection: sa.Connection) -> None:
            first = self.scope.next_number(connection, EVENT.c.number)
            for number, (name, reason) in enumerate(refused.items(), first):
                text = as_text(f"a decision that the database refused, {name!r}: {reason}")
                row = to_row(Event(number, now, "set aside", text)) | {"cell_id": self.cell_id}
                connection.execute(sa.insert(EVENT), row)
                log.error("%s", text)

        self._commit(record, [])

    # The queue

    def put(self, item: StoredDecision) -> None:
        """Queue a decision for the writer thread; where the queue is full, write it first."""
        self._check_open()
        if self._queue_bytes > QUEUE_BYTES:
            self.write(lambda connection: None)
        with self._lock:
            if item.decision.id in self._queue:
                raise duplicate_id(item.decision.id)
            self._queue[item.decision.id] = item
            self._queue_bytes += item.trace.nbytes
            self._lock.notify()

    def queued(self, decision_id: str) -> StoredDecision | None:
        """Return a decision that still waits; None where it was written or is unknown."""
        with self._lock:
            return self._queue.get(decision_id)

    def insert(self, connection: sa.Connection, batch: Sequence[StoredDecision]) -> None:
        """Add decisions and their traces in a transaction that is under way."""
        for part in chunks(batch):
            connection.execute(sa.insert(DECISION), [decision_row(self.cell_id, item) for item in part])
            connection.execute(sa.insert(TRACE), [trace_row(self.cell_id, item) for item in part])

    def read(self, query: sa.Select[Any]) -> Sequence[Any]:
        """Return the rows of a query."""
        with self.transaction(write=False) as connection:
            return connection.execute(query).all()

    def look(self, query: sa.Select[Any]) -> Sequence[Any]:
        """`read`, once what is queued was written; an empty queue needs no lock of a database that a cell writes to."""
        if self._queue:
            self.flush()
        return self.read(query)

    def insert_new(self, connection: sa.Connection, batch: Sequence[StoredDecision]) -> None:
        """Add those decisions of a batch that are not stored yet."""
        stored = self._stored(connection, batch)
        self.insert(connection, [item for item in batch if item.decision.id not in stored])

    def _forget(self, batch: Sequence[StoredDecision]) -> None:
        with self._lock:
            for item in batch:
                if self._queue.pop(item.decision.id, None) is not None:
                    self._queue_bytes -= item.trace.nbytes

    def _not_yet_stored(self, connection: sa.Connection, batch: Sequence[StoredDecision]) -> list[StoredDecision]:
        """After a failure: leave out what was committed although the answer got lost, and ids that were taken."""
        stored = self._stored(connection, batch)
        for item in batch:
            same = (item.content_hash, item.decision.action.value, item.time)
            if stored.get(item.decision.id, same) != same:
                self._clash = duplicate_id(item.decision.id)  # raised by the next flush; the queue must go on
        return [item for item in batch if item.decision.id not in stored]

    def _stored(self, connection: sa.Connection, batch: Sequence[StoredDecision]) -> dict[str, tuple[int, str, float]]:
        columns = (DECISION.c.id, DECISION.c.content_hash, DECISION.c.action, DECISION.c.time)
        query = sa.select(*columns).where(DECISION.c.cell_id == self.cell_id)
        parts = chunks([item.decision.id for item in batch])
        rows = [row for part in parts for row in connection.execute(query.where(DECISION.c.id.in_(part)))]
        return {row.id: (row.content_hash, row.action, row.time) for row in rows}

    def flush(self) -> None:
        """Return when every decision so far is committed."""
        self.write(lambda connection: None)
        clash, self._clash = self._clash, None
        if clash is not None:
            raise clash

    def _write_queue(self) -> None:
        """Commit queued decisions in batches until the store is closed (the writer thread)."""
        while not self._stop.is_set():
            with self._lock:
                self._lock.wait_for(lambda: self._queue or self._stop.is_set())
            self._stop.wait(RETRY if self._doubtful else LINGER)
            if not self._stop.is_set() and self._queue:
                with suppress(StoreError):  # it is counted, keeps the queue, and is raised by the next flush or report
                    self.write(lambda connection: None)
        if self._left:
            with self._writing:  # not under the hands of a write that still waits for the database
                self._disconnect()

    # Opening and closing

    def close(self) -> None:
        """Flush, stop the writer and disconnect; if the flush fails the store stays open, so close it again later."""
        if self._closed:
            return
        self.flush()
        self._stop.set()
        with self._lock:
            self._lock.notify_all()
        self._writer.join()
        with self._writing:
            self.flush()  # of what other threads put meanwhile
            self._closed = True
        self._disconnect()
        atexit.unregister(self._close_at_exit)

    def let_go(self) -> None:
        """Stop and disconnect without writing or waiting, lease and all; what is queued is kept elsewhere."""
        if self._closed:
            return
        self._closed = self._left = True
        self._stop.set()
        with self._lock:
            self._lock.notify_all()
        atexit.unregister(self._close_at_exit)

    def _close_at_exit(self) -> None:
        """Write what a program that forgot to close has queued; a fork of it has nothing of its own."""
        if os.getpid() != self._pid:
            return
        try:
            self.close()
        except StoreError as error:  # an engine has put into its journal what is missing here
            log.warning("a store was left open at the end of the program: %s", error)
