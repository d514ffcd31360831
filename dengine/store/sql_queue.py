"""A database that one cell writes to: the queue of decisions, the thread that writes it, and rows set aside."""

from __future__ import annotations

import atexit
import logging
import os
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import sqlalchemy as sa

from ..errors import StoreError
from .checks import as_text, duplicate_id
from .records import DecidedTrace
from .sql_connections import OF_A_ROW, SqlConnections
from .sql_rows import chunks, decision_row, event_row, trace_row
from .sql_tables import DECISION, EVENT, TRACE

log = logging.getLogger("dengine")
LINGER = 0.05  # seconds that a decision waits for company before it is committed
RETRY = 1.0  # seconds before the writer tries again after a failure
QUEUE_BYTES = 64 << 20  # of traces that may wait in memory

T = TypeVar("T")


class SqlDatabase(SqlConnections):
    """An open database, and the decisions on their way to it."""

    def __init__(self, url: str, cell_id: str, clock: Callable[[], float] = time.time, product: str | None = None) -> None:
        """Open or create the database, and start its writer thread."""
        self._queue: dict[str, DecidedTrace] = {}
        super().__init__(url, cell_id, clock, product)
        self._queue_bytes = 0
        self._clash: StoreError | None = None
        self._lock = threading.Condition()  # guards the queue
        self._stop = threading.Event()
        self._left = False  # let go without writing
        self._writer = threading.Thread(target=self._write_queue, name=f"dengine-store-{cell_id}", daemon=True)
        self._writer.start()
        atexit.register(self._close_at_exit)

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

    def _commit(self, work: Callable[[sa.Connection], T], batch: Sequence[DecidedTrace]) -> T:
        with self.transaction(write=True) as connection:
            self.insert(connection, self._not_yet_stored(connection, batch) if self._doubtful else batch)
            result = work(connection)
        self._doubtful = False
        self._forget(batch)
        return result

    def _unstorable(self, batch: Sequence[DecidedTrace]) -> dict[str, str]:
        """Return which rows the database refuses for what they hold, each with the reason; nothing is written."""
        refused: dict[str, str] = {}
        with self._told("write to"), self._connected(write=True) as plain:
            connection = plain.execution_options(dengine_write=True, dengine_entry=self._entry())
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
            first = self.next_number(connection, EVENT.c.number)
            for number, (name, reason) in enumerate(refused.items(), first):
                text = as_text(f"a decision that the database refused, {name!r}: {reason}")
                connection.execute(sa.insert(EVENT), event_row(self.cell_id, number, now, "set aside", text))
                log.error("%s", text)

        self._commit(record, [])

    def next_number(self, connection: sa.Connection, column: sa.Column[Any]) -> int:
        """Lock the cell, and its product, then number the next row of a table."""
        return self.scope.next_number(connection, column)

    def _waiting(self) -> str:
        n = len(self._queue)
        return f" {n} decisions wait in memory; the next flush or report writes them." if n else ""

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

    def insert_new(self, connection: sa.Connection, batch: Sequence[DecidedTrace]) -> None:
        """Add those decisions of a batch that are not stored yet."""
        stored = self._stored(connection, batch)
        self.insert(connection, [item for item in batch if item.decision.id not in stored])

    def _forget(self, batch: Sequence[DecidedTrace]) -> None:
        with self._lock:
            for item in batch:
                if self._queue.pop(item.decision.id, None) is None:
                    continue
                self._queue_bytes -= item.trace.nbytes

    def _not_yet_stored(self, connection: sa.Connection, batch: Sequence[DecidedTrace]) -> list[DecidedTrace]:
        """After a failure: leave out what was committed although the answer got lost, and ids that were taken."""
        stored = self._stored(connection, batch)
        for item in batch:
            same = (item.content_hash, item.decision.action.value, item.time)
            if stored.get(item.decision.id, same) != same:
                self._clash = duplicate_id(item.decision.id)  # raised by the next flush; the queue must go on
        return [item for item in batch if item.decision.id not in stored]

    def _stored(self, connection: sa.Connection, batch: Sequence[DecidedTrace]) -> dict[str, tuple[int, str, float]]:
        columns = (DECISION.c.id, DECISION.c.content_hash, DECISION.c.action, DECISION.c.time)
        query = sa.select(*columns).where(DECISION.c.cell_id == self.cell_id)
        parts = chunks([item.decision.id for item in batch])
        rows = [row for part in parts for row in connection.execute(query.where(DECISION.c.id.in_(part)))]
        return {row.id: (row.content_hash, row.action, row.time) for row in rows}

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
        if self._left:
            with self._writing:  # not under the hands of a write that still waits for the database
                self.disconnect()

    def _try_queue(self) -> bool:
        """Write the queue; a failure is counted, keeps the queue, and is raised by the next flush or report."""
        try:
            self.write(_nothing)
        except StoreError:
            return False
        return True

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
        self.disconnect()
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


def _nothing(connection: sa.Connection) -> None:
    """Write the queue and no more."""
