"""Connections to a store's database, and the class `Database` through which one cell writes to it.
`make_engine` makes the SQLAlchemy engine for SQLite or PostgreSQL; `reading` opens a store for one
block of reading. `Database` has the transactions, each of which ends with a ledger entry, and the
lock by which one engine owns a cell on a PostgreSQL server. It also notices a deleted file and a
forked process. `SqlStore` and its tables are built on `Database`; backup, verification and the list
of cells use `reading`.
"""

import hashlib
import os
import sqlite3
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from ..errors import DengineError, StoreError, expect
from .journal import describe_process, forked_error, owned_error, sqlite_file
from .ledger import (
    LedgerEntry,
    chain_writes,
    check_key,
    find_integrity_error,
    ledger_key,
    newest_entry,
)
from .queries import Scope, join_product
from .records import Clock, EntryName, Row, T, as_text, chunks
from .schema import CELL, DECISION, LEDGER, Query, check_schema, lock, prepare_tables

# With these, libpq reports a server that has stopped answering after seconds, not hours.
TIMEOUTS = {
    "connect_timeout": 5,
    "tcp_user_timeout": 10000,
    "keepalives_idle": 5,
    "keepalives_interval": 2,
    "keepalives_count": 3,
}
# Tables that are checked when a store is opened; a damaged trace is noticed as it is read.
CHECKED_TABLES = ("setting", "correction", "model_version", "label", "decision", "ledger")
BUSY_SECONDS = 10.0  # wait for another process that writes to the same SQLite file


def make_engine(url: str | None) -> sa.Engine:
    """Return a new SQLAlchemy engine for a store's database; it does not connect yet.

    Its connections to SQLite sync each commit to the disk, and set the file of a store, or an empty
    one, to WAL mode; a file that cannot be written is only read. In memory all threads share one
    connection. Connections to PostgreSQL use psycopg, unless the URL names another driver. SQLite
    waits up to `BUSY_SECONDS` (10 s) for another writer. PostgreSQL has `TIMEOUTS` of 5 to 10 s for
    a server that does not answer, and a pooled connection is tested before use.

    Parameters
    ----------
    url : str or None
        A file (SQLite), or a URL of SQLite or PostgreSQL. None: SQLite in memory.

    Returns
    -------
    sqlalchemy.Engine

    Raises
    ------
    StoreError
        For any other database, for a URL that cannot be read, has a NUL or is not UTF-8, for a URL
        or the name `:memory:` of SQLite in memory, for a file whose name begins with `file:`, which
        SQLite takes for a URI, and if the driver of PostgreSQL is not installed. The message has no
        password.
    """
    if url is None:
        return _with_sqlite_events(
            sa.create_engine(
                "sqlite://", poolclass=sa.pool.StaticPool, connect_args={"check_same_thread": False}
            )
        )
    expect(
        as_text(url) == url,
        "a file or a database URL of UTF-8 without a NUL",
        url,
        "rename it",
        StoreError,
    )
    try:
        parsed = (
            sa.make_url(url) if "://" in url else sa.URL.create("sqlite", database=str(Path(url)))
        )
        if parsed.drivername in ("postgres", "postgresql"):
            parsed = parsed.set(drivername="postgresql+psycopg")
        backend = parsed.get_backend_name()
        # A name `file:` is a URI of SQLite's own, which may mean anything.
        is_file = not (parsed.database or ":memory:").startswith((":memory:", "file:"))
        expect(
            backend == "postgresql" or (backend == "sqlite" and is_file),
            "a file, an SQLite file URL or a PostgreSQL URL",
            parsed.render_as_string(),
            "for a store that forgets use store=None",
            StoreError,
        )
        if backend == "postgresql":
            return sa.create_engine(parsed, pool_pre_ping=True, connect_args=TIMEOUTS)
        return _with_sqlite_events(sa.create_engine(parsed, connect_args={"timeout": BUSY_SECONDS}))
    except (sa.exc.ArgumentError, ImportError, ValueError) as error:
        reason = f"{error}"
        if isinstance(error, ValueError) and "@" in url:
            # The error may quote half of a password, which it took for a port.
            reason = "it cannot be read; write @, : and / in a password as %40, %3A and %2F"
        raise StoreError(
            f"Expected a file or a database URL that can be used here, got "
            f"{url.split('@')[-1]!r}: {reason}. For PostgreSQL: pip install 'dengine[postgres]'."
        ) from None  # the error may have the password


def _with_sqlite_events(engine: sa.Engine) -> sa.Engine:
    """Have an SQLAlchemy engine set up its SQLite connections for a store; return the engine.

    From then on it calls `_connect_sqlite` to connect (a file that cannot be written is opened for
    reading), `_set_pragmas` for each new connection (WAL mode; a commit survives a power failure),
    and `_begin_transaction` for each transaction (one that writes takes the write lock at once).
    """
    sa.event.listen(engine, "do_connect", _connect_sqlite)
    sa.event.listen(engine, "connect", _set_pragmas)
    sa.event.listen(engine, "begin", _begin_transaction)
    return engine


def _connect_sqlite(
    dialect: Any, record: Any, arguments: Sequence[Any], options: Mapping[str, Any]
) -> Any:
    """Return a new SQLite connection; a file that cannot be written is opened for reading.

    SQLAlchemy calls this with its dialect, its own record of the connection, which is not used, and
    the arguments and options for `sqlite3.connect`; the first argument is the file. If the file or
    its folder cannot be written, and the file has no `-wal` beside it, it is opened as immutable:
    it can only be read, and what another process writes meanwhile may be missed. Every other file
    is opened in the driver's own way. A damaged file raises nothing here, but when the connection
    is used; so does a file with a `-wal` for which SQLite can create no `-shm`. Raise sqlite3.Error
    if the file cannot be opened.
    """
    file = Path(str(arguments[0]))
    is_closed = file.is_file() and not Path(f"{file}-wal").exists()
    if is_closed and not (os.access(file, os.W_OK) and os.access(file.parent, os.W_OK)):
        return dialect.connect(f"{file.absolute().as_uri()}?immutable=1", uri=True, **options)
    return dialect.connect(*arguments, **options)


def _set_pragmas(connection: Any, record: Any) -> None:
    """Set a new SQLite connection to synchronous=FULL, so that a commit survives a power failure.

    The file of a store, or an empty one, is set to WAL mode, and an empty one to pages of 16 KiB.
    Another program's file is not changed, and a file that cannot be written keeps its mode. The
    driver begins no transactions by itself any more. `record` is SQLAlchemy's own record of the
    connection, which is not used. Raise sqlite3.DatabaseError for a file that is damaged, locked or
    no database.
    """
    connection.isolation_level = None  # `_begin_transaction` starts transactions, not the driver
    try:
        tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master")}
        # Another program's file is left as it is.
        if not tables or {"setting", "decision"} <= tables:
            # Of a new file: a trace of 600 samples would waste 40 % of a page of 4 KiB.
            connection.execute("PRAGMA page_size = 16384")
            connection.execute("PRAGMA journal_mode = WAL")
    except sqlite3.OperationalError as error:
        primary_code = error.sqlite_errorcode & 0xFF  # without the bits of an extended code
        if primary_code not in (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN):
            raise  # else the file keeps its mode, and is read
    except UnicodeDecodeError as error:  # SQLite's error quotes a damaged table name
        raise sqlite3.DatabaseError("the database is malformed") from error
    # A returned commit survives a power failure; with NORMAL it would not.
    connection.execute("PRAGMA synchronous = FULL")


def _begin_transaction(connection: sa.Connection) -> None:
    """Begin an SQLite transaction; with the option `dengine_write` it takes the write lock at once.

    It then waits for other writers, at most BUSY_SECONDS (10 s; after that SQLite's error is
    raised), which a read transaction that becomes a write would not do. In memory nothing waits.
    """
    write = connection.get_execution_options().get("dengine_write", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")


ADVICE = {
    "not a database": "The file is something else; name a new file, or a store that dengine wrote.",
    "unable to open": "Create the directory, or name one that can be written.",
    "readonly": "Make the file and its directory writable.",
    "full": "Free some space on the disk.",
    "locked": "Another process holds the database; close it, or wait.",
    "while it was open": "Put it back, or close this store and open the new one.",
    "malformed": "The file is damaged; restore it from a copy.",
    "": "Check that the database is there and can be written.",
}  # what to do, by a part of the database's error
# Errors about a row's values, while the database itself is well.
ROW_ERRORS = (sa.exc.IntegrityError, sa.exc.DataError, OverflowError, ValueError, TypeError)


@contextmanager
def _store_errors(verb: str, name: str) -> Iterator[None]:
    """Context manager that turns an error of its block into StoreError.

    It does so for errors of the database, and for OSError, ValueError, TypeError and OverflowError.
    The message is "Could not `verb` `name`", the error, and what to do; `name` is the database.
    dengine's own errors (`DengineError`) and all others pass unchanged.
    """
    try:
        yield
    except DengineError:
        raise
    except (sa.exc.SQLAlchemyError, sqlite3.Error, OSError, *ROW_ERRORS) as error:
        advice = next(do for text, do in ADVICE.items() if text in str(error).lower())
        raise StoreError(
            f"Could not {verb} {name}: {getattr(error, 'orig', None) or error}. {advice}"
        ) from error


@contextmanager
def reading(url: str) -> Iterator[sa.Connection]:
    """Context manager that opens a store for reading; the block sees one snapshot of the database.

    No store is created and no row is changed, and the connection is closed after the block; but the
    file of a store that was not in WAL mode is set to it, and a file of 0 bytes, which is refused,
    becomes an SQLite database without tables. In SQLite, text with damaged bytes is read with
    escapes instead of an error.

    Parameters
    ----------
    url : str
        A file, or a URL of SQLite or PostgreSQL.

    Yields
    ------
    sqlalchemy.Connection

    Raises
    ------
    StoreError
        If there is no file, if it is no store of the present schema (version of the tables), for a
        URL that `make_engine` refuses, and if the database fails. Also in place of a ValueError,
        TypeError, OverflowError or OSError that the block raises, unless it is dengine's own.
    """
    engine = make_engine(url)
    name = engine.url.render_as_string()
    sqlite = engine.dialect.name == "sqlite"
    try:
        file = str(engine.url.database)
        if sqlite and not Path(file).is_file():
            raise StoreError(
                f"Expected a store, or a copy that `dengine backup` made, found no file {file}; "
                "`dengine train`, `dengine run` and DataEngine make a store."
            )
        with _store_errors("read", name), engine.connect() as connection:  # rolled back at the end
            if sqlite:  # read a text with a damaged byte too, so that its row can be named
                plain: Any = connection.connection.driver_connection
                plain.text_factory = lambda text: text.decode("utf-8", "backslashreplace")
            else:
                connection.execution_options(
                    isolation_level="REPEATABLE READ", postgresql_readonly=True
                )
            check_schema(connection, name)
            yield connection
    finally:
        engine.dispose()


def run_integrity_check(connection: sa.Connection, table: str = "") -> list[str]:
    """Run SQLite's integrity check on the whole file, or on one table.

    Return its findings as texts, at most 100, [] if all is well. If the database fails, nothing is
    raised, and the text of its error is the only finding.
    """
    try:
        lines = connection.exec_driver_sql(
            f"PRAGMA integrity_check({table})" if table else "PRAGMA integrity_check"
        )
        return [str(line) for line in lines.scalars() if line != "ok"]
    except sa.exc.DatabaseError as error:
        return [str(error.orig)]


class Database:
    """An open database in which one robot cell reads and writes; one thread writes at a time.

    Parameters
    ----------
    url : str or None
        A file (SQLite), or a URL of SQLite or PostgreSQL; None: SQLite in memory.
    cell_id : str
        The cell; it is entered if it is new. Tables are created in an empty database.
    clock : callable
        Returns the time, in seconds since 1970, for the ledger's entries.
    product : str or None
        What a new cell makes; None: as the store says.

    Attributes
    ----------
    scope : Scope
        The cell and its product.
    url : sqlalchemy.URL
        With its password.
    name : str
        The URL without its password.
    newest_entry : (int, str) or None
        Number and digest of the newest ledger entry that this process knows; None: no entry yet.
    is_in_memory : bool
        Whether it is SQLite in memory.
    before_use : callable
        Called before each read and each write, so that waiting records are written first; set by
        the outbox.
    on_entry : callable
        Called after a transaction that added a ledger entry is committed; set by the outbox.

    Raises
    ------
    StoreError
        For another program's database, another schema, a ledger with another key, another product
        than the cell's, a URL that `make_engine` refuses, or a key file that cannot be read, and if
        the database cannot be opened.
    """

    def __init__(
        self,
        url: str | None,
        cell_id: str,
        clock: Clock,
        product: str | None,
    ) -> None:
        self.cell_id = cell_id
        self.is_in_memory = url is None
        self.before_use: Callable[[], object] = lambda: None
        self.clock = clock
        self._closed = False
        self._pid = os.getpid()
        self._writing = threading.RLock()  # one write transaction at a time in this process
        self._commits = threading.local()  # of each thread: `is_wanted` of `commit_if`
        self._key = b"" if url is None else ledger_key()
        self.newest_entry: EntryName | None = None
        self.on_entry: Callable[[], object] = lambda: None
        self._engine = self._writer = make_engine(url)
        chain_writes(self._engine)
        self.url = self._engine.url  # its password included
        self.name = self.url.render_as_string()
        self.scope = self._open(product)
        # The file with what it was when it was opened. None: in memory, or a server.
        self._file: tuple[Path, os.stat_result] | None = None
        if self.url.get_backend_name() == "sqlite" and not self.is_in_memory:
            file = sqlite_file(self.url)
            if file.is_file():
                self._file = file, file.stat()

    def _open(self, product: str | None) -> Scope:
        """Create or check the tables, add the robot cell if it is new, and set `newest_entry`.

        Columns that an older store lacks are added. `newest_entry` becomes number and digest of the
        newest entry in the cell's ledger (the hash chain over its rows). A new cell gets `product`,
        the name that it has in common with the cells with which it shares labels and models. Its
        ledger begins with the key in the file that the environment variable DENGINE_LEDGER_KEY
        names, or without a key if there is no such variable or the store is in memory. Return the
        cell with its product; it has none if neither the store nor `product` names one. Raise
        StoreError, and disconnect, if the database cannot be opened or is no store of this schema,
        if the ledger of the cell was begun with another key, and if `join_product` refuses the
        product, for example for a cell that has another one.
        """
        try:
            with _store_errors("open", self.name), self._engine.connect() as plain:
                connection = plain.execution_options(dengine_write=True)
                with connection.begin():
                    prepare_tables(connection, self.cell_id, self.name)
                    check_key(connection, self.cell_id, self._key, begin=True)
                    if last := newest_entry(connection, self.cell_id):
                        self.newest_entry = last["number"], last["digest"].hex()
                    return Scope(self.cell_id, join_product(connection, self.cell_id, product))
        except StoreError:
            self._engine.dispose()
            raise

    @contextmanager
    def reading(self) -> Iterator[sa.Connection]:
        """Context manager that opens a read transaction and gives its connection.

        First it calls `before_use`, which writes what the engine has recorded but not written yet,
        so that the block sees it; what the database of a running robot cell does not take in time
        is missing. Raise StoreError if the database fails, is closed or was opened before a fork,
        and in place of a ValueError, TypeError, OverflowError or OSError that the block raises,
        unless it is dengine's own.
        """
        self.check_open()
        self.before_use()
        with _store_errors("read", self.name), self._engine.begin() as connection:
            yield connection

    @contextmanager
    def _transaction(self) -> Iterator[sa.Connection]:
        """Context manager that opens a write transaction of the robot cell; gives the connection.

        The cell is locked, which keeps other transactions from writing rows of the cell until this
        one ends; SQLite locks the whole file.

        After the block an entry for the rows that it added is inserted into the ledger, the cell's
        hash chain, and both are committed. Then `newest_entry` becomes number and digest of this
        entry, and the function `on_entry` is called. If the block added no rows and changed no
        settings, there is no entry. On an error everything is rolled back. Errors of the database,
        and OSError, ValueError, TypeError and OverflowError, become StoreError; dengine's own
        errors and all others pass unchanged.

        StoreError is raised, too, if the function given to `commit_if`, which says whether the
        commit is still wanted, returns False, and if the SQLite file was replaced. If this is
        noticed only after the commit, the rows are in the file that was replaced; and if the
        connection to a server broke during the commit, the server may have the rows.
        """
        with _store_errors("write to", self.name), self._writer.connect() as connection:
            connection.execution_options(dengine_write=True)
            with connection.begin():
                self._check_file()
                lock(connection, CELL, self.cell_id)
                entry = LedgerEntry(connection, self.cell_id, self._key)
                yield connection.execution_options(dengine_entry=entry)
                newest = entry.append(self.clock)
                if not getattr(self._commits, "is_wanted", lambda: True)():
                    raise StoreError(
                        f"Could not write to {self.name} in time, and was given up; nothing "
                        "was written."
                    )
            self._check_file()  # else the rows would be in a file that nobody reads
            if newest is not None:
                self.newest_entry = newest
                self.on_entry()

    def _check_file(self) -> None:
        """Raise FileNotFoundError if the opened SQLite file is no longer the one at its path.

        It is also raised if the path cannot be looked at, for example for lack of permission.
        PostgreSQL and a store in memory are not checked.
        """
        if self._file is None:
            return
        file, opened = self._file
        with suppress(OSError):
            if os.path.samestat(file.stat(), opened):
                return
        raise FileNotFoundError("the file was deleted, moved or replaced while it was open")

    @contextmanager
    def commit_if(self, is_wanted: Callable[[], bool]) -> Iterator[None]:
        """Context manager in which this thread commits a transaction only if `is_wanted()` is true.

        `is_wanted` is called just before each commit of `write`. If it returns False, the
        transaction is rolled back, and `write` raises StoreError. Such blocks must not be nested.
        """
        self._commits.is_wanted = is_wanted
        try:
            yield
        finally:
            del self._commits.is_wanted

    def has_entry(self, number: int, digest: str) -> bool:
        """Return whether the cell's ledger has an entry with this number and hexadecimal digest.

        The ledger is a hash chain over the cell's rows. What the engine has recorded but not
        written yet is written first, if the database takes it in time. Raise StoreError if the
        database fails, is closed or was opened before a fork.
        """
        rows = self.read(
            sa.select(LEDGER.c.digest).where(self.own(LEDGER), LEDGER.c.number == number)
        )
        return [row.digest.hex() for row in rows] == [digest]

    def check_integrity(self, window: int, since: int | None = None) -> str:
        """Compare the rows that an engine reads with the ledgers (hash chains) of their cells.

        These are settings, labels, corrections of labels and model versions of this robot cell and
        the other cells of its product (with which it shares labels and versions). Of the labels
        only the newest are checked, and of each ledger itself only the newest entry. The rest is
        checked in full, except for the arrays of the versions and the settings that the store
        itself keeps (`RESERVED`). A ledger with another key than the one with which the store was
        opened counts as a difference, too. What the engine has recorded but not written yet is
        written first, if the database takes it in time.

        Parameters
        ----------
        window : int
            How many of the newest labels are checked, at least. Labels of quarantined traces (never
            used in training) among them are checked, too, but not counted. In a product the newest
            2 * `window` labels of all its cells together are checked instead, and every label
            counts.
        since : int or None
            If given, the labels after this number are checked instead of the newest `window`.

        Returns
        -------
        str
            The first difference, in words, of this cell or else of another, which is then named; ""
            if there is none.

        Raises
        ------
        StoreError
            If the database cannot be read.
        """
        with self.reading() as connection:
            first = self.scope.first_label(connection, window) if since is None else since + 1
            for cell in self.scope.cells(connection):
                if error := find_integrity_error(connection, cell, self._key, first):
                    return error if cell == self.cell_id else f"of cell {cell!r} {error}"
        return ""

    def check_pages(self) -> str:
        """Run SQLite's integrity check on the tables that engines read, all but traces and events.

        Return its first finding, or the text of the error if the check fails, which also happens
        after `close`; "" if all is well. PostgreSQL and a store in memory are not checked: "". What
        the engine has recorded but not written yet is written first, if the database takes it in
        time.
        """
        for name in CHECKED_TABLES if self._file is not None else ():
            try:
                with self.reading() as connection:
                    if findings := run_integrity_check(connection, name):
                        return f"of the table {name} SQLite says: {findings[0]}"
            except StoreError as error:
                return f"{error}"
        return ""

    def check_writable(self) -> None:
        """Raise a StoreError if the database cannot be written; an update of no row shows this.

        What the engine has recorded but not written yet is written first, if the database takes it
        in time. The update itself adds nothing to the ledger (the hash chain over the rows).
        """
        self.write(
            lambda connection: connection.exec_driver_sql(
                "UPDATE setting SET value = value WHERE 1 = 0"
            )
        )

    def acquire_lease(self) -> None:
        """Lock the robot cell on a PostgreSQL server; write from now on through that connection.

        Only one `DataEngine` at a time has the lock of a cell (the lease). It lasts as long as the
        connection; if that is lost, the next connection locks again, and if another engine has the
        lock by then, `write` raises StoreError. Raise StoreError if another engine has the lock
        now, or the database fails; this `Database` can then still be used, without it.
        """
        # The name is shown to an engine that finds the cell locked.
        self._writer = sa.create_engine(
            self.url,
            pool_pre_ping=True,
            pool_size=1,
            max_overflow=0,
            connect_args=TIMEOUTS | {"application_name": f"dengine {describe_process()}"[:63]},
        )
        chain_writes(self._writer)
        sa.event.listen(self._writer, "connect", self._take_lease)
        try:
            self.write(lambda connection: None)
        except StoreError:
            self._writer.dispose()
            self._writer = self._engine
            raise

    def _take_lease(self, connection: Any, record: Any) -> None:
        """Lock the robot cell (the lease) for a new PostgreSQL connection, until that is closed.

        SQLAlchemy calls this for each new connection, with its own record of the connection, which
        is not used. If another engine has the lock, the connection is closed, and the StoreError
        that is raised names that engine.
        """
        digest = hashlib.sha256(b"dengine " + self.cell_id.encode()).digest()
        key = int.from_bytes(digest[:8], signed=True)
        taken = connection.execute("SELECT pg_try_advisory_lock(%s)", [key]).fetchone()[0]
        connection.commit()
        if taken:
            return
        holder_query = (
            "SELECT a.application_name FROM pg_locks l JOIN pg_stat_activity a USING (pid) WHERE "
            "l.locktype = 'advisory' AND (l.classid::bigint << 32) + l.objid::bigint = %s AND "
            "l.objsubid = 1 AND l.granted"
        )
        holder = connection.execute(holder_query, [key]).fetchone()
        connection.close()
        raise owned_error(
            holder[0] if holder else "another engine", f"cell {self.cell_id!r} of {self.name}"
        )

    def own(self, table: sa.FromClause) -> sa.ColumnElement[bool]:
        """Return the SQL condition that a row of a table is this cell's."""
        return table.c.cell_id == self.cell_id

    def check_open(self) -> None:
        """Raise a StoreError after `close`, and in a process forked after the opening."""
        if self._closed:
            raise StoreError(
                f"Expected an open store, got {self.name} after close(); open it again."
            )
        if os.getpid() != self._pid:
            raise forked_error(self._pid, self.name)

    def write(self, add_rows: Callable[[sa.Connection], T]) -> T:
        """Call `add_rows` in a write transaction, commit it, and return what `add_rows` returned.

        First `before_use` is called, which writes what the engine has recorded but not written yet,
        so that it precedes these rows, if the database takes it in time. The call waits until
        another write transaction of this object has ended, and for the lock of the SQLite file, or
        of the robot cell on a server. If rows were added or settings changed, the commit includes
        an entry for them in the ledger (a hash chain); then `newest_entry` becomes number and
        digest of this entry, and the function `on_entry` is called.

        Parameters
        ----------
        add_rows : callable
            Takes the connection, and adds rows.

        Raises
        ------
        StoreError
            If the database fails, is closed or was opened before a fork, if the function given to
            the method `commit_if` returns False (the caller has given up), and in place of a
            ValueError, TypeError, OverflowError or OSError that `add_rows` raised; dengine's own
            errors and all others pass unchanged. After an error nothing is written, with two
            exceptions: if the SQLite file was replaced meanwhile, the old file may have the rows;
            and if the connection to a server broke during the commit, the server may have them.
        """
        self.check_open()
        self.before_use()  # before the lock is taken: it may write
        with self._writing:
            self.check_open()  # again, since a `close` may have come first
            try:
                with self._transaction() as connection:
                    return add_rows(connection)
            finally:
                if self._closed:  # meanwhile, by a `close` that did not wait
                    self._disconnect()

    def read(self, query: Query) -> Sequence[Any]:
        """Run a query in a read transaction of its own, and return all its rows.

        The records that wait in the outbox are written first, if the database takes them in time.
        Raise StoreError if the database fails, is closed or was opened before a fork.
        """
        with self.reading() as connection:
            return connection.execute(query).all()

    def close(self, waiting: bool = True) -> None:
        """Disconnect from the database; later calls raise StoreError.

        If another thread is writing: with `waiting` this waits until it has finished; without, it
        returns at once, and that thread disconnects when it has finished. SQLite in memory is lost.
        What a `DataEngine` has recorded but not written yet is not written. A second call changes
        nothing.
        """
        self._closed = True
        if self._writing.acquire(blocking=waiting):
            self._disconnect()
            self._writing.release()

    def _disconnect(self) -> None:
        """Close all connections."""
        self._writer.dispose()
        self._engine.dispose()

    # Rows

    def insert(
        self, connection: sa.Connection, column: sa.Column[Any], rows: Sequence[Row]
    ) -> list[int]:
        """Insert rows of this robot cell into a table, each with a number; return these numbers.

        The first row gets the next free number, and each further row the next one. If a row already
        has a number in `column`, it keeps this number if it is larger than the one that it would
        get, and the rows behind it go on from there; a smaller number is replaced.

        Parameters
        ----------
        connection : sqlalchemy.Connection
            In a write transaction.
        column : sqlalchemy.Column
            The table's column that takes the numbers. Decisions and events continue the numbers of
            the cell. Labels, model versions and corrections of labels continue those of all cells
            of its product (which share them), if it has one; the product is then locked until the
            transaction ends.
        rows : sequence of mapping
            Without `cell_id`. They are not changed.

        Returns
        -------
        list of int
            The numbers, in the order of the rows; empty without rows.
        """
        if not rows:
            return []
        number = self.scope.next_number(connection, column)
        numbered = []
        for row in rows:
            number = max(number, row.get(column.name, 0))
            numbered.append({**row, "cell_id": self.cell_id, column.name: number})
            number += 1
        connection.execute(sa.insert(column.table), numbered)
        return [row[column.name] for row in numbered]

    def rows_by_id(
        self, connection: sa.Connection, query: Query, ids: Sequence[str]
    ) -> dict[str, Any]:
        """Run a query over decisions for the given ids of this robot cell; return the rows by id.

        `query` selects from the table `decision`, its column `id` included, and is limited to this
        cell here. It runs once for each CHUNK (500) ids, and not at all without ids. Ids without a
        row are left out.
        """
        query = query.where(self.own(DECISION))
        return {
            row.id: row
            for part in chunks(ids)
            for row in connection.execute(query.where(DECISION.c.id.in_(part)))
        }
