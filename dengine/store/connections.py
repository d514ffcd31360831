"""A database that one cell writes to: engine, transactions, the lease on the cell, and what goes in.

A deleted file, a fork, and a row that the database refuses are each met here.
"""

import hashlib
import logging
import os
import shutil
import sqlite3
import threading
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import sqlalchemy as sa

from ..errors import DengineError, StoreError, expect
from .journal import Record, describe_process, forked_error, owned_error, sqlite_file
from .ledger import LedgerEntry, chain_writes, doubt_of, ledger_key, must_have_key, newest_entry
from .queries import WITH_LABELS, WITH_TRACES, Scope, counted, join_product
from .records import FORGOTTEN, LATE_STOP, Event, NewLabel, StoredDecision, as_text, chunks, decision_row, to_row, trace_row
from .schema import CELL, CORRECTION, DECISION, EVENT, LABEL, LEDGER, TRACE, check_schema, hold, prepare_tables

log = logging.getLogger("dengine")
T = TypeVar("T")

# Of a server that answers no more, libpq says so after some seconds, not hours.
PATIENCE = {"connect_timeout": 5, "tcp_user_timeout": 10000}
PATIENCE |= {"keepalives_idle": 5, "keepalives_interval": 2, "keepalives_count": 3}
READ = ("setting", "correction", "model_version", "label", "decision", "ledger")  # a damaged trace is noticed as it is read
BUSY = 10.0  # seconds to wait for another process that writes to the same SQLite file


def make_engine(url: str | None) -> sa.Engine:
    """Return an engine for a file or URL, None: SQLite in memory; refuses what this store was never tested on."""
    if url is None:
        one = {"poolclass": sa.pool.StaticPool, "connect_args": {"check_same_thread": False}}
        return _sqlite(sa.create_engine("sqlite://", **one))
    expect(as_text(url) == url, "a file or a database URL of UTF-8 without a NUL", url, "rename it", StoreError)
    try:
        parsed = sa.make_url(url) if "://" in url else sa.URL.create("sqlite", database=str(Path(url)))
        if parsed.drivername in ("postgres", "postgresql"):
            parsed = parsed.set(drivername="postgresql+psycopg")
        backend = parsed.get_backend_name()
        keeps = backend == "postgresql" or (backend == "sqlite" and parsed.database not in (None, "", ":memory:"))
        wanted, do = "a file, an SQLite file URL or a PostgreSQL URL", "for a store that forgets use store=None"
        expect(keeps, wanted, parsed.render_as_string(), do, StoreError)
        if backend == "postgresql":
            return sa.create_engine(parsed, pool_pre_ping=True, connect_args=PATIENCE)
        return _sqlite(sa.create_engine(parsed, connect_args={"timeout": BUSY}))
    except (sa.exc.ArgumentError, ImportError, ValueError) as error:
        if isinstance(error, ValueError) and "@" in url:  # what it quotes, and takes for a port, may be half of a password
            raise _unusable(url, "it cannot be read; write @, : and / in a password as %40, %3A and %2F") from None
        raise _unusable(url, f"{error}") from error


def _sqlite(engine: sa.Engine) -> sa.Engine:
    sa.event.listen(engine, "do_connect", _connect)
    sa.event.listen(engine, "connect", _set_pragmas)
    sa.event.listen(engine, "begin", _begin)
    return engine


def _unusable(url: str, said: str) -> StoreError:
    got = f"{url.split('@')[-1]!r}: {said}. For PostgreSQL: pip install 'dengine[postgres]'"
    return StoreError(f"Expected a file or a database URL that can be used here, got {got}.")


class CopyConnection(sqlite3.Connection):
    """A connection to a copy of a file; the copy is deleted with it."""


def _connect(dialect: Any, record: Any, arguments: Sequence[Any], options: Mapping[str, Any]) -> Any:
    """Connect to a file; open one as immutable if neither it nor its folder can be written.

    If a `-wal` lies beside such a file without a `-shm`, both are copied to a temporary folder: SQLite has to create the
    `-shm` to read them.
    """
    name = str(arguments[0])
    file, log, shared = Path(name), Path(f"{name}-wal"), Path(f"{name}-shm")
    if options.get("uri") or not file.is_file():
        return dialect.connect(*arguments, **options)
    if log.exists() or os.access(file, os.W_OK):
        connection = dialect.connect(*arguments, **options)
        try:
            connection.execute("SELECT name FROM sqlite_master").fetchone()
        except (sqlite3.Error, UnicodeDecodeError) as error:
            if not _is_unwritable(error) or shared.exists():
                return connection  # what is wrong is said as it is used
            connection.close()
        else:
            return connection
    if not log.exists():
        return dialect.connect(f"{file.absolute().as_uri()}?immutable=1", uri=True, **options)
    folder = TemporaryDirectory(prefix="dengine-", ignore_cleanup_errors=True)
    for each in (file, log):
        shutil.copyfile(each, Path(folder.name) / each.name)
    copy = dialect.connect(str(Path(folder.name) / file.name), factory=CopyConnection, **options)
    weakref.finalize(copy, folder.cleanup)
    return copy


def _is_unwritable(error: Exception) -> bool:
    """Whether SQLite says that it cannot write to a file, or make one beside it."""
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF  # an extended one says more in its higher bits
    return code in (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN)


def _set_pragmas(connection: Any, record: Any) -> None:
    connection.isolation_level = None  # `_begin` says when a transaction starts, not the driver
    try:
        tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master")}
        if not tables or {"setting", "decision"} <= tables:  # another program's file is refused, and left as it is
            connection.execute("PRAGMA journal_mode = WAL")
    except sqlite3.OperationalError as error:
        if not _is_unwritable(error):  # else it stays in the mode that it has, and is read
            raise
    except UnicodeDecodeError as error:  # SQLite quotes a damaged table's name in what it says
        raise sqlite3.DatabaseError("the database is malformed") from error
    connection.execute("PRAGMA synchronous = FULL")  # a returned commit survives lost power; NORMAL would not


def _begin(connection: sa.Connection) -> None:
    # busy_timeout does not cover a read that turns into a write, so a writer takes its lock at once.
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
}  # what to do, by what a database says
OF_A_ROW = (sa.exc.IntegrityError, sa.exc.DataError, OverflowError, ValueError, TypeError)  # the database itself is well


@contextmanager
def _told(doing: str, name: str) -> Iterator[None]:
    """Turn what a database of this name raises into a StoreError that says what to do."""
    try:
        yield
    except DengineError:
        raise
    except (sa.exc.SQLAlchemyError, sqlite3.Error, OSError, *OF_A_ROW) as error:
        advice = next(do for text, do in ADVICE.items() if text in str(error).lower())
        raise StoreError(f"Could not {doing} {name}: {getattr(error, 'orig', None) or error}. {advice}") from error


@contextmanager
def reading(url: str) -> Iterator[sa.Connection]:
    """Connect to a store of the present schema, and see it as it is now. StoreError where there is none."""
    engine = make_engine(url)
    name = engine.url.render_as_string(hide_password=True)
    sqlite = engine.dialect.name == "sqlite"
    options = {} if sqlite else {"isolation_level": "REPEATABLE READ", "postgresql_readonly": True}
    try:
        file = str(engine.url.database)
        if sqlite and not (Path(file).is_file() or file.startswith("file:")):  # the latter is an URI of SQLite's own
            do = "make a DataEngine with it, or let `dengine train` or `dengine run` make one"
            raise StoreError(f"Expected a store that an engine has used, found no file {file}; {do}.")
        with _told("read", name), engine.connect() as connection:  # rolled back at its end: there is nothing to commit
            connection.execution_options(**options)
            if sqlite:  # a text of which a byte was damaged is read too, so that it can be named
                plain: Any = connection.connection.driver_connection
                plain.text_factory = lambda text: text.decode("utf-8", "backslashreplace")
            check_schema(connection, name)
            yield connection
    finally:
        engine.dispose()


def integrity(connection: sa.Connection, table: str = "") -> list[str]:
    """What SQLite finds wrong in its file, or in one table and its indexes; nothing where all is well."""
    try:
        lines = connection.execute(sa.text(f"PRAGMA integrity_check({table})" if table else "PRAGMA integrity_check"))
        return [str(line) for line in lines.scalars() if line != "ok"]
    except sa.exc.DatabaseError as error:
        return [str(error.orig)]


class Database:
    """An open database, prepared for a cell; one thread writes at a time.

    url : a file (SQLite), or a SQLAlchemy URL of SQLite or PostgreSQL; None: SQLite in memory.
    clock : the time in seconds that entries of the ledger are stamped with.
    scope : the cell and its product.  name : the URL without its password.
    before_use : called before each transaction, so that it sees what is on its way into the database.
    newest : number and digest of the newest entry of the ledger, as far as this process knows; None: there is none.
    on_entry : called once a transaction that added one is committed.
    """

    def __init__(
        self, url: str | None, cell_id: str, clock: Callable[[], float], product: str | None, before_use: Callable[[], None]
    ) -> None:
        self.cell_id = cell_id
        self._before_use = before_use
        self._clock = clock
        self._closed = False
        self._pid = os.getpid()
        self._writing = threading.RLock()  # one write transaction at a time in this process
        self._asked = threading.local()  # of each thread, what says whether its commit is wanted still
        self._key = b"" if url is None else ledger_key()
        self.newest_entry: tuple[int, str] | None = None
        self.on_entry: Callable[[], object] = lambda: None
        self._engine = self._writer = make_engine(url)
        chain_writes(self._engine)
        self.url = self._engine.url  # its password included
        self.name = self.url.render_as_string(hide_password=True)
        self.scope = self._open(product)
        file = sqlite_file(self.url) if self.url.get_backend_name() == "sqlite" else None
        self._file = file if file is not None and file.is_file() else None  # None: in memory, or a server
        self._opened = None if self._file is None else self._file.stat()

    def _open(self, product: str | None) -> Scope:
        try:
            with _told("open", self.name), self._engine.connect() as plain:
                connection = plain.execution_options(dengine_write=True)
                with connection.begin():
                    prepare_tables(connection, self.cell_id, self.name)
                    must_have_key(connection, self.cell_id, self._key, begin=True)
                    if (last := newest_entry(connection, self.cell_id)) is not None:
                        self.newest_entry = last.number, last.digest.hex()
                    return Scope(self.cell_id, join_product(connection, self.cell_id, product))
        except StoreError:
            self._engine.dispose()
            raise

    @contextmanager
    def reading(self) -> Iterator[sa.Connection]:
        """Begin a transaction that reads."""
        self.check_open()
        self._before_use()
        with _told("read", self.name), self._engine.begin() as connection:
            yield connection

    @contextmanager
    def _transaction(self) -> Iterator[sa.Connection]:
        """Begin a transaction that holds the cell, is chained and committed at its end, or rolled back by an error."""
        with _told("write to", self.name), self._writer.connect() as connection:
            connection.execution_options(dengine_write=True)
            with connection.begin():
                self._check_file()
                hold(connection, CELL, self.cell_id)
                entry = LedgerEntry(connection, self.cell_id, self._key)
                yield connection.execution_options(dengine_entry=entry)
                newest = entry.append(self._clock)
                if not getattr(self._asked, "wanted", lambda: True)():
                    raise StoreError(f"Could not write to {self.name} in time, and was given up; nothing was written.")
            self._check_file()  # nobody is told that a file holds what went into another one
            if newest is not None:
                self.newest_entry = newest
                self.on_entry()

    def _check_file(self) -> None:
        """Raise an OSError where the file is not the one that was opened, which still takes writes, for nobody."""
        if self._file is None or self._opened is None:
            return
        with suppress(OSError):
            if os.path.samestat(self._file.stat(), self._opened):
                return
        raise FileNotFoundError("the file was deleted, moved or replaced while it was open")

    @contextmanager
    def commit_if(self, wanted: Callable[[], bool]) -> Iterator[None]:
        self._asked.wanted = wanted
        try:
            yield
        finally:
            del self._asked.wanted

    def has_entry(self, number: int, digest: str) -> bool:
        mine = (LEDGER.c.cell_id == self.cell_id) & (LEDGER.c.number == number)
        return [row.digest.hex() for row in self.read(sa.select(LEDGER.c.digest).where(mine))] == [digest]

    def check_integrity(self, window: int, since: int | None = None) -> str:
        """What is read of this cell and its product that is not as the ledgers have it, in words; "" where all is.

        window : so many of the newest labels are read.  since : those after that number alone; None: the window.
        """
        with self.reading() as connection:
            first = self.scope.first_label(connection, window) if since is None else since + 1
            for cell in self.scope.cells(connection):
                if said := doubt_of(connection, cell, self._key, first):
                    return said if cell == self.cell_id else f"of cell {cell!r} {said}"
        return ""

    def check_pages(self) -> str:
        """What SQLite finds wrong in a table that is read, or in its indexes, in words; "" where nothing is."""
        for name in READ if self._file is not None else ():
            try:
                with self.reading() as connection:
                    if said := integrity(connection, name):
                        return f"of the table {name} SQLite says: {said[0]}"
            except StoreError as error:
                return f"{error}"
        return ""

    def check_writable(self) -> None:
        """Raise a StoreError where SQLite can read its file, and no more."""
        self.write(lambda connection: connection.exec_driver_sql("UPDATE setting SET value = value WHERE 0"))

    def acquire_lease(self) -> None:
        """Write from now on through one connection that holds the cell; StoreError where another engine has it."""
        said = PATIENCE | {"application_name": f"dengine {describe_process()}"[:63]}  # so that others are told who it is
        self._writer = sa.create_engine(self.url, pool_pre_ping=True, pool_size=1, max_overflow=0, connect_args=said)
        chain_writes(self._writer)
        sa.event.listen(self._writer, "connect", self._take_lease)
        try:
            self.write(lambda connection: None)
        except StoreError:
            self._writer.dispose()
            self._writer = self._engine
            raise

    def _take_lease(self, connection: Any, record: Any) -> None:
        """Lock the cell for as long as this PostgreSQL connection lives."""
        digest = hashlib.sha256(b"dengine " + self.cell_id.encode()).digest()
        key = int.from_bytes(digest[:8], "big", signed=True)
        taken = connection.execute("SELECT pg_try_advisory_lock(%s)", [key]).fetchone()[0]
        asked = (
            "SELECT a.application_name FROM pg_locks l JOIN pg_stat_activity a USING (pid) WHERE l.locktype = 'advisory' "
            "AND (l.classid::bigint << 32) + l.objid::bigint = %s AND l.objsubid = 1 AND l.granted"
        )
        holder = None if taken else connection.execute(asked, [key]).fetchone()
        connection.commit()
        if not taken:
            connection.close()
            raise owned_error(holder[0] if holder else "another engine", f"cell {self.cell_id!r} of {self.name}")

    def check_open(self) -> None:
        """StoreError after closing, and in a fork."""
        if self._closed:
            raise StoreError(f"Expected an open store, got {self.name} after close(); open it again.")
        if os.getpid() != self._pid:
            raise forked_error(self._pid, self.name)

    def write(self, work: Callable[[sa.Connection], T], settled: bool = True) -> T:
        """Commit what `work` adds, in one transaction; settled : after what is on its way into the database."""
        self.check_open()
        if settled:
            self._before_use()  # not while others are kept from writing
        with self._writing:
            try:
                with self._transaction() as connection:
                    return work(connection)
            finally:
                if self._closed:  # meanwhile: `close` did not wait
                    self._disconnect()

    def read(self, query: sa.Select[Any]) -> Sequence[Any]:
        """Return the rows of a query."""
        with self.reading() as connection:
            return connection.execute(query).all()

    def close(self, waiting: bool = True) -> None:
        """Disconnect; waiting : for a write that is under way."""
        self._closed = True
        if self._writing.acquire(blocking=waiting):
            self._disconnect()
            self._writing.release()

    def _disconnect(self) -> None:
        self._writer.dispose()
        self._engine.dispose()

    # What goes in

    def insert(self, connection: sa.Connection, column: sa.Column[Any], rows: Sequence[Mapping[str, Any]]) -> range:
        """Add the cell's rows, numbered in this column of their table; returns the numbers."""
        if not rows:
            return range(0)
        first = self.scope.next_number(connection, column)
        named = [{**row, "cell_id": self.cell_id, column.name: i} for i, row in enumerate(rows, first)]
        connection.execute(sa.insert(column.table), named)
        return range(first, first + len(rows))

    def correct(self, connection: sa.Connection, rows: Sequence[Mapping[str, Any]]) -> None:
        newest = self.scope.next_number(connection, LABEL.c.seq) - 1
        self.insert(connection, CORRECTION.c.number, [{**row, "newest_seq": newest} for row in rows])

    def held(self, connection: sa.Connection, ids: Sequence[str]) -> dict[str, Any]:
        """What is stored of decisions, as labels repeat it, and of the labels that they have, by id."""
        label = (LABEL.c.success, LABEL.c.source, LABEL.c.seq, counted().label("counted"))
        query = sa.select(*DECISION.c["id", "content_hash", "quarantined", "time"], *label).select_from(WITH_LABELS)
        return self._by_id(connection, query, ids)

    def _by_id(self, connection: sa.Connection, query: sa.Select[Any], ids: Sequence[str]) -> dict[str, Any]:
        query = query.where(DECISION.c.cell_id == self.cell_id)
        return {row.id: row for part in chunks(ids) for row in connection.execute(query.where(DECISION.c.id.in_(part)))}

    def apply_records(self, records: Sequence[Record]) -> list[tuple[str, int]]:
        """Commit what a journal held, as `SqlStore.apply_records`."""
        try:
            return self.write(lambda connection: self._take(connection, records))
        except StoreError as error:
            if not isinstance(error.__cause__, OF_A_ROW):
                raise
            if len(records) > 1:  # one of them is what the database refuses
                half = len(records) // 2
                return self.apply_records(records[:half]) + self.apply_records(records[half:])
            text = f"{_named(records[0])}, which the database refused: {error.__cause__}"
        self.write(lambda connection: self.insert(connection, EVENT.c.number, [to_row(self._set_aside(text))]))
        return []

    def _take(self, connection: sa.Connection, records: Sequence[Record]) -> list[tuple[str, int]]:
        """Insert what is not there yet; what is there must be the same, or it becomes a dead letter."""
        events = self._new_events(connection, [each for each in records if isinstance(each, Event)])
        events += self._take_decisions(connection, [each for each in records if isinstance(each, StoredDecision)])
        labels = [each for each in records if isinstance(each, NewLabel)]
        held = self.held(connection, [each.decision_id for each in labels])
        fresh, well, late = dict[str, NewLabel](), list[str](), list[str]()
        for each in labels:
            name, row = each.decision_id, held.get(each.decision_id)
            if row is None or (row.content_hash, row.time) != (each.content_hash, each.decided):
                lacks = "which the store does not hold" if row is None else "of which the store holds another decision"
                events.append(self._set_aside(f"{_named(each)}, {lacks}"))
                continue
            first = fresh.setdefault(name, each) if row.seq is None else row
            said, now = (first.success, first.source), (each.success, each.source)
            stopped = (said, now) == LATE_STOP and row.counted != FORGOTTEN
            if said == now or stopped:
                well.append(name)
                late += [name] * (stopped and row.counted != 0)  # else the store has it
            else:
                events.append(self._set_aside(f"a second label: {_named(each)}, which has one"))
        rows = [to_row(each) | {"quarantined": held[each.decision_id].quarantined} for each in fresh.values()]
        numbers = {name: row.seq for name, row in held.items()}
        numbers |= zip(fresh, self.insert(connection, LABEL.c.seq, rows), strict=True)
        self.insert(connection, EVENT.c.number, [to_row(each) for each in events])
        if late:
            self._take_back(connection, list(dict.fromkeys(late)))
        return [(name, numbers[name]) for name in dict.fromkeys(well)]

    def _take_back(self, connection: sa.Connection, names: Sequence[str]) -> None:
        """Parts that were confirmed stopped the system: their labels are corrected, with an event each."""
        now, text = float(self._clock()), "counts as a failure, was a success: its stop came after its confirmation"
        events = [to_row(Event(0, now, "late stop", f"decision {as_text(name)} {text}")) for name in names]
        numbers = self.insert(connection, EVENT.c.number, events)
        said = {"author": "", "time": now, "success": False, "was": True}
        self.correct(connection, [said | {"event": i, "decision_id": name} for i, name in zip(numbers, names, strict=True)])

    def _take_decisions(self, connection: sa.Connection, decisions: Sequence[StoredDecision]) -> list[Event]:
        """Insert the new ones; returns what is to be said of those whose id has another decision."""
        query = sa.select(*DECISION.c, *TRACE.c["decision_id", "channels", "samples", "data"]).select_from(WITH_TRACES)
        stored = self._by_id(connection, query, [each.decision.id for each in decisions])
        new = [each for each in decisions if each.decision.id not in stored]
        self.insert(connection, DECISION.c.number, [decision_row(each) for each in new])
        if new:
            connection.execute(sa.insert(TRACE), [{"cell_id": self.cell_id} | trace_row(each) for each in new])
        events = []
        for each in decisions:
            if (row := stored.get(each.decision.id)) is not None:
                given = decision_row(each) | trace_row(each)
                if other := ", ".join(name for name, value in given.items() if row._mapping[name] != value):
                    events.append(self._set_aside(f"{_named(each)}, of which the store holds another: {other} differ"))
        return events

    def _new_events(self, connection: sa.Connection, events: Sequence[Event]) -> list[Event]:
        if not events:
            return []
        query = sa.select(EVENT.c.time, EVENT.c.kind, EVENT.c.text).where(EVENT.c.cell_id == self.cell_id)
        stored = {tuple(row) for row in connection.execute(query.where(EVENT.c.time.in_([each.time for each in events])))}
        return [each for each in events if (each.time, each.kind, each.text) not in stored]

    def _set_aside(self, text: str) -> Event:
        log.error("dead letter: %s", text)
        return Event(0, self._clock(), "dead letter", as_text(text))


def _named(record: Record) -> str:
    if isinstance(record, Event):
        return f"an event, {record.text!r}"
    if isinstance(record, StoredDecision):
        return f"a decision, {record.decision.id!r}"
    said = "success" if record.success else "failure"
    return f"a label, {said} from {record.source.value}, on {record.decision_id!r}"
