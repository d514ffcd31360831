"""Connections and transactions of one cell: their errors in words, the file watched, the lease, and no use in a fork."""

from __future__ import annotations

import os
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import sqlalchemy as sa

from ..errors import DengineError, StoreError
from .sql_engine import WatchedFile, advice, make_engine
from .sql_ledger import LedgerEntry, chain_writes
from .sql_scope import Scope, join_product
from .sql_tables import prepare_tables

OF_A_ROW = (sa.exc.IntegrityError, sa.exc.DataError, OverflowError, ValueError, TypeError)  # the database itself is well


class SqlConnections:
    """An open database, prepared for a cell.

    url : a file (SQLite), or a SQLAlchemy URL of SQLite or PostgreSQL.
    clock : the time in seconds that entries of the ledger are stamped with.
    scope : the cell and its product.
    name : the URL without its password, for errors.
    failures : how many writes failed so far.
    """

    def __init__(self, url: str, cell_id: str, clock: Callable[[], float] = time.time, product: str | None = None) -> None:
        self.cell_id = cell_id
        self.failures = 0
        self._clock = clock
        self._engine = make_engine(url)
        chain_writes(self._engine)
        self.name = self._engine.url.render_as_string(hide_password=True)
        self._doubtful = False  # the last write failed, and may have been committed all the same
        self._closed = False
        self._pid = os.getpid()
        self._writing = threading.RLock()  # one write transaction at a time in this process
        self._asked = threading.local()  # of each thread, what says whether its commit is wanted still
        self._lease: Callable[[sa.Connection], None] | None = None  # taken again on each new connection that writes
        self._leased: sa.Connection | None = None
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
            self._doubtful |= write
            raise StoreError(
                f"Could not {doing} {self.name}: {getattr(error, 'orig', None) or error}. {advice(error)}{self._waiting()}"
            ) from error

    def _waiting(self) -> str:
        """Say what waits for the next write."""
        return ""

    @contextmanager
    def transaction(self, write: bool) -> Iterator[sa.Connection]:
        """Begin a transaction that is committed at its end, or rolled back by an error."""
        self._check_open()
        with self._told("write to" if write else "read", write), self._connected(write) as plain:
            entry = self._entry() if write else None
            connection = plain.execution_options(dengine_write=write, dengine_entry=entry)
            with connection.begin():
                if write:
                    self._file.check()
                yield connection
                if entry is not None:
                    entry.append(connection)  # chains what the transaction added
                if write and not getattr(self._asked, "wanted", _always)():
                    raise StoreError(f"Could not write to {self.name} in time, and was given up; nothing was written.")
            if write:
                self._file.check()  # nobody is told that a file holds what went into another one

    @contextmanager
    def committing(self, wanted: Callable[[], bool]) -> Iterator[None]:
        """Ask before each commit of this thread whether it is wanted still, for nobody may wait for it any more."""
        self._asked.wanted = wanted
        try:
            yield
        finally:
            del self._asked.wanted

    def _entry(self) -> LedgerEntry:
        return LedgerEntry(self.cell_id, self._clock)

    @contextmanager
    def _connected(self, write: bool) -> Iterator[sa.Connection]:
        """A connection of the pool; a leased cell writes through the one connection that holds its lease."""
        if not write or self._lease is None:
            with self._engine.connect() as connection:
                yield connection
            return
        if self._leased is None:
            self._leased = self._engine.connect()
        try:
            if not self._leased.info.get("leased"):
                self._lease(self._leased)
                self._leased.commit()
                self._leased.info["leased"] = True
            yield self._leased
        except (sa.exc.SQLAlchemyError, StoreError):
            self._let_lease_go()
            raise

    def lease(self, take: Callable[[sa.Connection], None]) -> None:
        """Write from now on through one connection, on which a lease was taken; what `take` raises propagates."""
        with self._writing:
            self._lease = take
            try:
                with self.transaction(write=True):
                    pass
            except StoreError:
                self._lease = None
                raise

    def disconnect(self) -> None:
        """Let the lease and all connections go."""
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


def _always() -> bool:
    return True
