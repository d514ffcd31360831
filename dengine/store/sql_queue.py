"""A database that one cell writes to: transactions, the queue of decisions, and the thread that writes it."""

from __future__ import annotations

import atexit
import sqlite3
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import sqlalchemy as sa

from ..errors import StoreError
from .checks import duplicate_id
from .records import DecidedTrace
from .sql_engine import advice, make_engine
from .sql_rows import chunks, decision_row, trace_row
from .sql_scope import Scope, join_product
from .sql_tables import DECISION, TRACE, prepare_tables

LINGER = 0.05  # seconds that a decision waits for company before it is committed
RETRY = 1.0  # seconds before the writer tries again after a failure
QUEUE_BYTES = 64 << 20  # of traces that may wait in memory

T = TypeVar("T")


class SqlDatabase:
    """An open database, and the decisions on their way to it.

    url : a file (SQLite), or a SQLAlchemy URL of SQLite or PostgreSQL.
    cell_id : whose decisions these are.
    scope : the cell and its product.
    name : the URL without its password, for errors.
    failures : how many writes failed so far.
    """

    def __init__(self, url: str, cell_id: str, product: str | None = None) -> None:
        """Open or create the database, and start its writer thread."""
        self.cell_id = cell_id
        self.failures = 0
        self._engine = make_engine(url)
        self.name = self._engine.url.render_as_string(hide_password=True)
        self._queue: dict[str, DecidedTrace] = {}
        self._queue_bytes = 0
        self._doubtful = False  # the last write failed, and may have been committed all the same
        self._clash: StoreError | None = None
        self._closed = False
        self._lock = threading.Condition()  # guards the queue
        self._writing = threading.RLock()  # one write transaction at a time in this process
        self._stop = threading.Event()
        self.scope = self._open(product)
        self._writer = threading.Thread(target=self._write_queue, name=f"dengine-store-{cell_id}", daemon=True)
        self._writer.start()
        atexit.register(self._close_at_exit)

    # Transactions

    @contextmanager
    def _told(self, doing: str, write: bool = False) -> Iterator[None]:
        """Turn what a database raises into a StoreError that says what to do."""
        try:
            yield
        except (sa.exc.SQLAlchemyError, sqlite3.Error, OSError) as error:
            self.failures += write
            self._doubtful |= write
            raise StoreError(
                f"Could not {doing} {self.name}: {getattr(error, 'orig', None) or error}. {advice(error)}{self._waiting()}"
            ) from error

    def _waiting(self) -> str:
        n = len(self._queue)
        return f" {n} decisions wait in memory; the next flush or report writes them." if n else ""

    @contextmanager
    def transaction(self, write: bool) -> Iterator[sa.Connection]:
        """Begin a transaction that is committed at its end, or rolled back by an error."""
        self._check_open()
        with self._told("write to" if write else "read", write), self._engine.connect() as plain:
            connection = plain.execution_options(dengine_write=write)
            with connection.begin():
                yield connection

    def write(self, work: Callable[[sa.Connection], T]) -> T:
        """Commit the queued decisions and `work` in one transaction."""
        with self._writing:
            with self._lock:
                batch = list(self._queue.values())
            with self.transaction(write=True) as connection:
                self.insert(connection, self._not_yet_stored(connection, batch) if self._doubtful else batch)
                result = work(connection)
            self._doubtful = False
            self._forget(batch)
            return result

    def next_number(self, connection: sa.Connection, column: sa.Column[Any]) -> int:
        """Lock the cell, or its product, then number the next row of a table."""
        return self.scope.next_number(connection, column)

    # The queue

    def put(self, item: DecidedTrace) -> None:
        """Queue a decision for the writer thread; where the queue is full, write it first."""
        self._check_open()
        if self._queue_bytes > QUEUE_BYTES:
            self.write(_nothing)
        with self._lock:
            if item.decision.id in self._queue:
                raise duplicate_id(item.decision.id)
            self._queue[item.decision.id] = item
            self._queue_bytes += item.trace.nbytes
            self._lock.notify()

    def queued(self, decision_id: str) -> DecidedTrace | None:
        """Return a decision that still waits; None where it was written or is unknown."""
        with self._lock:
            return self._queue.get(decision_id)

    def insert(self, connection: sa.Connection, batch: Sequence[DecidedTrace]) -> None:
        """Add decisions and their traces in a transaction that is under way."""
        for part in chunks(batch):
            connection.execute(sa.insert(DECISION), [decision_row(self.cell_id, item) for item in part])
            connection.execute(sa.insert(TRACE), [trace_row(self.cell_id, item) for item in part])

    def _forget(self, batch: Sequence[DecidedTrace]) -> None:
        with self._lock:
            for item in batch:
                del self._queue[item.decision.id]
                self._queue_bytes -= item.trace.nbytes

    def _not_yet_stored(self, connection: sa.Connection, batch: Sequence[DecidedTrace]) -> list[DecidedTrace]:
        """After a failure: leave out what was committed although the answer got lost, and ids that were taken."""
        columns = (DECISION.c.id, DECISION.c.content_hash, DECISION.c.action, DECISION.c.time)
        query = sa.select(*columns).where(DECISION.c.cell_id == self.cell_id)
        stored: dict[str, tuple[int, str, float]] = {}
        for part in chunks([item.decision.id for item in batch]):
            stored |= {row[0]: (row[1], row[2], row[3]) for row in connection.execute(query.where(DECISION.c.id.in_(part)))}
        for item in batch:
            same = (item.content_hash, item.decision.action.value, item.time)
            if stored.get(item.decision.id, same) != same:
                self._clash = duplicate_id(item.decision.id)  # raised by the next flush; the queue must go on
        return [item for item in batch if item.decision.id not in stored]

    def flush(self) -> None:
        """Return when every decision so far is committed."""
        self.write(_nothing)
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
                self._try_queue()

    def _try_queue(self) -> bool:
        """Write the queue; a failure is counted, keeps the queue, and is raised by the next flush or report."""
        try:
            self.write(_nothing)
        except StoreError:
            return False
        return True

    # Opening and closing

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

    def _check_open(self) -> None:
        if self._closed:
            raise StoreError(f"Expected an open store, got {self.name} after close(); open it again.")

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
        self._engine.dispose()
        atexit.unregister(self._close_at_exit)

    def _close_at_exit(self) -> None:
        """Write what a program that forgot to close has queued."""
        self.close()


def _nothing(connection: sa.Connection) -> None:
    """Write the queue and no more."""
