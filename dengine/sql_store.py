"""The store in a database: SQLite in a file, or PostgreSQL by URL for a fleet.

    store = SqlStore("engine.db", cell_id="cell-7")
    store = SqlStore("postgresql+psycopg://user:password@host/database", cell_id="cell-7")

What a returned call promises, given a disk that keeps what it synced: `put_label`, `put_labelled`, `put_version`
and `save_settings` are committed. `put_decision` is not: its row is queued, and committed within about 50 ms by a
writer thread, by `flush`, or in the same transaction as the next label, whichever comes first.
"""

from __future__ import annotations

import atexit
import io
import json
import sqlite3
import threading
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import numpy as np
import sqlalchemy as sa
from numpy.typing import NDArray

from dengine.errors import StoreError
from dengine.records import Action, Decision, Reason, RetrainReport, Source
from dengine.store import (
    AddedPoints,
    Labelled,
    ModelVersion,
    StoredDecision,
    already_reported,
    as_channels,
    as_hash,
    as_point,
    check_import,
    check_state,
    duplicate_id,
    mixed_shapes,
    stack,
    stored_decision,
    summary,
    unknown_decision,
)

SCHEMA = "1"  # of the tables below; a change of them is a new number
SCHEMA_KEY = "schema_version"  # a row of `setting` for every cell, which also serves as the cell's lock
LINGER = 0.05  # seconds that a decision waits for company before it is committed
RETRY = 1.0  # seconds before the writer tries again after a failure
BUSY = 10.0  # seconds to wait for another process that writes to the same SQLite file
QUEUE_BYTES = 64 << 20  # of traces that may wait in memory
CHUNK = 500  # rows sent or fetched at a time

T = TypeVar("T")

_metadata = sa.MetaData()
_setting = sa.Table(
    "setting",
    _metadata,
    sa.Column("cell_id", sa.String, primary_key=True),
    sa.Column("key", sa.String, primary_key=True),
    sa.Column("value", sa.String, nullable=False),
)
_decision = sa.Table(
    "decision",
    _metadata,
    sa.Column("cell_id", sa.String, primary_key=True),
    sa.Column("id", sa.String, primary_key=True),
    sa.Column("time", sa.Double, nullable=False),
    sa.Column("action", sa.String, nullable=False),
    sa.Column("predicted", sa.String, nullable=False),
    sa.Column("lower", sa.Double),
    sa.Column("upper", sa.Double),
    sa.Column("n_success", sa.BigInteger, nullable=False),
    sa.Column("n_failure", sa.BigInteger, nullable=False),
    sa.Column("embedding", sa.Text),  # JSON, (K, d)
    sa.Column("model_version", sa.BigInteger, nullable=False),
    sa.Column("reason", sa.String, nullable=False),
    sa.Column("audit", sa.Boolean, nullable=False),
    sa.Column("propensity", sa.Double),
    sa.Column("content_hash", sa.BigInteger, nullable=False),
    sa.Column("quarantined", sa.Boolean, nullable=False),
)
_trace = sa.Table(  # apart from `decision`, so that counting decisions does not read traces
    "trace",
    _metadata,
    sa.Column("cell_id", sa.String, primary_key=True),
    sa.Column("decision_id", sa.String, primary_key=True),
    sa.Column("channels", sa.Integer, nullable=False),
    sa.Column("samples", sa.Integer, nullable=False),
    sa.Column("data", sa.LargeBinary, nullable=False),  # float32, little-endian, (channels, samples)
)
_label = sa.Table(
    "label",
    _metadata,
    sa.Column("cell_id", sa.String, primary_key=True),
    sa.Column("decision_id", sa.String, primary_key=True),
    sa.Column("seq", sa.BigInteger, nullable=False),
    sa.Column("time", sa.Double, nullable=False),
    sa.Column("success", sa.Boolean, nullable=False),
    sa.Column("source", sa.String, nullable=False),
    sa.Column("model_version", sa.BigInteger, nullable=False),  # whose space `point` lives in
    sa.Column("point", sa.LargeBinary),  # float32, little-endian, (d,)
    sa.Column("content_hash", sa.BigInteger, nullable=False),  # this and the next repeat `decision`, for the index
    sa.Column("quarantined", sa.Boolean, nullable=False),
    sa.UniqueConstraint("cell_id", "seq", name="label_seq"),
    sa.Index("label_training", "cell_id", "quarantined", "seq"),
)
_version = sa.Table(  # every retrain, dropped candidates included
    "model_version",
    _metadata,
    sa.Column("cell_id", sa.String, primary_key=True),
    sa.Column("retrain", sa.BigInteger, primary_key=True, autoincrement=False),  # 1, 2, ... in each cell
    sa.Column("version", sa.BigInteger, nullable=False),
    sa.Column("time", sa.Double, nullable=False),
    sa.Column("seconds", sa.Double, nullable=False),
    sa.Column("n_traces", sa.BigInteger, nullable=False),
    sa.Column("n_steps", sa.BigInteger, nullable=False),
    sa.Column("accepted", sa.Boolean, nullable=False),
    sa.Column("reason", sa.Text, nullable=False),
    sa.Column("last_seq", sa.BigInteger, nullable=False),
    sa.Column("state", sa.LargeBinary),  # npz without pickles
    sa.Index("version_accepted", "cell_id", "accepted", "retrain"),
)


@dataclass(frozen=True, slots=True)
class _Queued:
    """A decision on its way to the disk."""

    decision: Decision
    trace: NDArray[np.float32]
    content_hash: int
    quarantined: bool
    time: float


class SqlStore:
    """The contract of `Store` in a database.

    url : a file (SQLite), or a SQLAlchemy URL of SQLite or PostgreSQL.
    cell_id : whose rows these are; several cells share one database without seeing each other.
    clock : the time in seconds that rows are stamped with.

    SQLite runs in WAL mode with synchronous=FULL; WAL needs a local disk, not a network drive. Two processes may
    open one cell: label numbers stay unique and increasing. Their labels then mix, and neither engine learns of
    the other's until it is opened anew, so give every running engine a cell_id of its own.

    A write that fails leaves its decisions in the queue; it is tried again every second and by each following
    `flush` or report, which raises `StoreError` if it fails again. `status()["write_failures"]` counts failures.
    The queue holds 64 MB of traces; beyond that `put_decision` writes them itself, or says that it cannot.
    """

    def __init__(self, url: str, cell_id: str = "cell", clock: Callable[[], float] = time.time) -> None:
        """Open or create the store, and start its writer thread."""
        if not cell_id:
            raise StoreError("Expected a cell_id that names the cell, got an empty one; use for example 'cell'.")
        self.cell_id = cell_id
        self._clock = clock
        self._engine = _make_engine(str(url))
        self._name = self._engine.url.render_as_string(hide_password=True)
        self._queue: dict[str, _Queued] = {}
        self._queue_bytes = 0
        self._failures = 0
        self._doubtful = False  # the last write failed, and may have been committed all the same
        self._clash: StoreError | None = None
        self._closed = False
        self._lock = threading.Condition()  # guards the queue
        self._writing = threading.RLock()  # one write transaction at a time in this process
        self._stop = threading.Event()
        self._open()
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
            self._failures += write
            self._doubtful |= write
            raise StoreError(
                f"Could not {doing} {self._name}: {getattr(error, 'orig', None) or error}. {_advice(error)} "
                f"{len(self._queue)} decisions wait in memory; the next flush or report writes them."
            ) from error

    @contextmanager
    def _transaction(self, write: bool) -> Iterator[sa.Connection]:
        if self._closed:
            raise StoreError(f"Expected an open store, got {self._name} after close(); open it again.")
        with self._told("write to" if write else "read", write), self._engine.connect() as plain:
            connection = plain.execution_options(dengine_write=write)
            with connection.begin():
                yield connection

    def _write(self, work: Callable[[sa.Connection], T]) -> T:
        """Commit the queued decisions and `work` in one transaction."""
        with self._writing:
            with self._lock:
                batch = list(self._queue.values())
            with self._transaction(write=True) as connection:
                self._insert(connection, self._not_yet_stored(connection, batch) if self._doubtful else batch)
                result = work(connection)
            self._doubtful = False
            self._forget(batch)
            return result

    def _forget(self, batch: Sequence[_Queued]) -> None:
        with self._lock:
            for item in batch:
                del self._queue[item.decision.id]
                self._queue_bytes -= item.trace.nbytes

    def _not_yet_stored(self, connection: sa.Connection, batch: Sequence[_Queued]) -> list[_Queued]:
        """After a failure: leave out what was committed although the answer got lost, and ids that were taken."""
        columns = (_decision.c.id, _decision.c.content_hash, _decision.c.action, _decision.c.time)
        query = sa.select(*columns).where(_decision.c.cell_id == self.cell_id)
        stored: dict[str, tuple[int, str, float]] = {}
        for part in _chunks([item.decision.id for item in batch]):
            stored |= {
                row[0]: (row[1], row[2], row[3]) for row in connection.execute(query.where(_decision.c.id.in_(part)))
            }
        for item in batch:
            same = (item.content_hash, item.decision.action.value, item.time)
            if stored.get(item.decision.id, same) != same:
                self._clash = duplicate_id(item.decision.id)  # raised by the next flush; the queue must go on
        return [item for item in batch if item.decision.id not in stored]

    def _insert(self, connection: sa.Connection, batch: Sequence[_Queued]) -> None:
        for part in _chunks(batch):
            connection.execute(sa.insert(_decision), [self._decision_row(item) for item in part])
            connection.execute(sa.insert(_trace), [self._trace_row(item) for item in part])

    def _decision_row(self, item: _Queued) -> dict[str, Any]:
        decision = item.decision
        return {
            "cell_id": self.cell_id,
            "id": decision.id,
            "time": item.time,
            "action": decision.action.value,
            "predicted": decision.predicted.value,
            "lower": float(decision.lower),
            "upper": float(decision.upper),
            "n_success": int(decision.n_success),
            "n_failure": int(decision.n_failure),
            "embedding": None if decision.embedding is None else json.dumps(decision.embedding, default=float),
            "model_version": int(decision.model_version),
            "reason": decision.reason.value,
            "audit": bool(decision.audit),
            "propensity": float(decision.propensity),
            "content_hash": item.content_hash,
            "quarantined": item.quarantined,
        }

    def _trace_row(self, item: _Queued) -> dict[str, Any]:
        channels, samples = item.trace.shape
        return {
            "cell_id": self.cell_id,
            "decision_id": item.decision.id,
            "channels": channels,
            "samples": samples,
            "data": _pack(item.trace),
        }

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
            self._write(_nothing)
        except StoreError:
            return False
        return True

    # Opening and closing

    def _open(self) -> None:
        try:
            with self._told("open"), self._engine.connect() as plain:
                connection = plain.execution_options(dengine_write=True)
                with connection.begin():
                    self._prepare(connection)
        except StoreError:
            self._engine.dispose()
            raise

    def _prepare(self, connection: sa.Connection) -> None:
        """Create the tables in an empty database, or check that they are ours."""
        if connection.dialect.name == "postgresql":  # two cells may create the tables at the same moment
            connection.execute(sa.text("SELECT pg_advisory_xact_lock(7236482514)"))
        found, ours = set(sa.inspect(connection).get_table_names()), set(_metadata.tables)
        # A file belongs to one program; a PostgreSQL database may hold other tables beside ours.
        if found & ours or (found and connection.dialect.name == "sqlite"):
            self._check_schema(connection, found)
        else:
            _metadata.create_all(connection)
        row = {"cell_id": self.cell_id, "key": SCHEMA_KEY, "value": SCHEMA}
        if connection.execute(self._of_cell(_setting).where(_setting.c.key == SCHEMA_KEY)).first() is None:
            connection.execute(sa.insert(_setting), row)

    def _check_schema(self, connection: sa.Connection, found: set[str]) -> None:
        held = "tables of another program: " + ", ".join(sorted(found))
        columns = {c["name"] for c in sa.inspect(connection).get_columns("setting")} if "setting" in found else set()
        if columns == set(_setting.c.keys()):
            # The one query over all cells: the tables are theirs in common.
            query = sa.select(_setting.c.value).where(_setting.c.key == SCHEMA_KEY).distinct()
            held = "schema " + (", ".join(sorted(connection.execute(query).scalars())) or "unknown")
        if held != f"schema {SCHEMA}":
            raise StoreError(
                f"Expected a dengine store of schema {SCHEMA}, found {held} in {self._name}; "
                "open it with the dengine that wrote it, or name a new file or database."
            )

    def flush(self) -> None:
        """Return when every decision so far is committed."""
        self._write(_nothing)
        clash, self._clash = self._clash, None
        if clash is not None:
            raise clash

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

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # Settings

    def settings(self) -> dict[str, str]:
        """What `save_settings` was given; {} for a new store."""
        query = self._of_cell(_setting).where(_setting.c.key != SCHEMA_KEY)
        with self._transaction(write=False) as connection:
            return {row.key: row.value for row in connection.execute(query)}

    def save_settings(self, settings: Mapping[str, str]) -> None:
        """Replace the settings by these."""
        if SCHEMA_KEY in settings:
            raise StoreError(f"Expected settings of the engine, got {SCHEMA_KEY!r}, which is the store's; rename it.")
        rows = [{"cell_id": self.cell_id, "key": key, "value": value} for key, value in settings.items()]
        mine = (_setting.c.cell_id == self.cell_id) & (_setting.c.key != SCHEMA_KEY)

        def replace(connection: sa.Connection) -> None:
            connection.execute(sa.delete(_setting).where(mine))
            if rows:
                connection.execute(sa.insert(_setting), rows)

        self._write(replace)

    # Decisions

    def put_decision(
        self, decision: Decision, trace: NDArray[np.float32], content_hash: int, quarantined: bool
    ) -> None:
        """Queue a decision and its trace for the writer thread."""
        item = _Queued(decision, as_channels(trace), as_hash(content_hash), bool(quarantined), self._clock())
        if self._closed:
            raise StoreError(f"Expected an open store, got {self._name} after close(); open it again.")
        if self._queue_bytes > QUEUE_BYTES:
            self._write(_nothing)
        with self._lock:
            if decision.id in self._queue:
                raise duplicate_id(decision.id)
            self._queue[decision.id] = item
            self._queue_bytes += item.trace.nbytes
            self._lock.notify()

    def get_decision(self, decision_id: str) -> StoredDecision | None:
        """Return the decision with its trace, queued ones included; None where it is unknown."""
        with self._lock:
            item = self._queue.get(decision_id)
        if item is not None:
            return stored_decision(item.decision, item.trace, item.content_hash, item.quarantined)
        with self._transaction(write=False) as connection:
            row = connection.execute(self._decision_query(decision_id)).first()
        return None if row is None else _read_decision(row)

    def _decision_query(self, decision_id: str) -> sa.Select[Any]:
        mine = (_decision.c.cell_id == self.cell_id) & (_decision.c.id == decision_id)
        traces = (_trace.c.cell_id == _decision.c.cell_id) & (_trace.c.decision_id == _decision.c.id)
        labels = (_label.c.cell_id == _decision.c.cell_id) & (_label.c.decision_id == _decision.c.id)
        held = _trace.c["channels", "samples", "data"]
        columns = (*_decision.c, *held, _label.c.success, _label.c.source)
        joined = _decision.join(_trace, traces).outerjoin(_label, labels)
        return sa.select(*columns).select_from(joined).where(mine)

    # Labels

    def put_label(
        self, decision_id: str, success: bool, source: Source, model_version: int, point: NDArray[np.float32] | None
    ) -> int:
        """Commit a label, in one transaction with its decision where that still waits; returns its number."""
        copy = as_point(point)
        row = {
            "cell_id": self.cell_id,
            "decision_id": decision_id,
            "time": self._clock(),
            "success": bool(success),
            "source": source.value,
            "model_version": int(model_version),
            "point": None if copy is None else _pack(copy),
        }

        def label(connection: sa.Connection) -> int:
            seq = self._next_seq(connection)
            held = self._held_of(connection, decision_id, bool(success), source)
            connection.execute(sa.insert(_label), row | held | {"seq": seq})
            return seq

        return self._write(label)

    def _held_of(self, connection: sa.Connection, decision_id: str, success: bool, source: Source) -> dict[str, Any]:
        """Return what a label repeats of its decision; a ReportError where there is none, or a label already."""
        labels = (_label.c.cell_id == _decision.c.cell_id) & (_label.c.decision_id == _decision.c.id)
        columns = _decision.c["content_hash", "quarantined"]
        query = sa.select(*columns, _label.c.success, _label.c.source).select_from(_decision.outerjoin(_label, labels))
        mine = (_decision.c.cell_id == self.cell_id) & (_decision.c.id == decision_id)
        found = connection.execute(query.where(mine)).first()
        if found is None:
            raise unknown_decision(decision_id)
        if found.source is not None:
            raise already_reported(decision_id, (found.success, Source(found.source)), (success, source))
        return {"content_hash": found.content_hash, "quarantined": found.quarantined}

    def _next_seq(self, connection: sa.Connection) -> int:
        """Lock the cell (PostgreSQL; SQLite's BEGIN IMMEDIATE did it already), then number its next label."""
        connection.execute(self._of_cell(_setting).where(_setting.c.key == SCHEMA_KEY).with_for_update())
        newest = sa.select(sa.func.max(_label.c.seq)).where(_label.c.cell_id == self.cell_id)
        return (connection.execute(newest).scalar() or 0) + 1

    def put_labelled(
        self,
        decisions: Sequence[Decision],
        traces: NDArray[np.float32],
        hashes: NDArray[np.int64],
        labels: NDArray[np.int8],
        source: Source,
    ) -> NDArray[np.int64]:
        """Import labelled traces in one transaction, all or none; returns their sequence numbers."""
        traces, now = check_import(decisions, traces, hashes, labels), self._clock()
        with self._lock:
            queued = next((decision.id for decision in decisions if decision.id in self._queue), None)
        if queued is not None:
            raise duplicate_id(queued)

        def load(connection: sa.Connection) -> NDArray[np.int64]:
            first = self._next_seq(connection)
            self._refuse_known(connection, [decision.id for decision in decisions])
            for part in _chunks(range(len(decisions))):
                items = [_Queued(decisions[i], traces[i], as_hash(hashes[i]), False, now) for i in part]
                self._insert(connection, items)
                rows = [
                    self._import_row(item, first + i, bool(labels[i]), source)
                    for i, item in zip(part, items, strict=True)
                ]
                connection.execute(sa.insert(_label), rows)
            return np.arange(first, first + len(decisions), dtype=np.int64)

        return self._write(load)

    def _refuse_known(self, connection: sa.Connection, ids: Sequence[str]) -> None:
        query = sa.select(_decision.c.id).where(_decision.c.cell_id == self.cell_id)
        for part in _chunks(ids):
            known = connection.execute(query.where(_decision.c.id.in_(part))).scalar()
            if known is not None:
                raise duplicate_id(known)

    def _import_row(self, item: _Queued, seq: int, success: bool, source: Source) -> dict[str, Any]:
        return {
            "cell_id": self.cell_id,
            "decision_id": item.decision.id,
            "seq": seq,
            "time": item.time,
            "success": success,
            "source": source.value,
            "model_version": int(item.decision.model_version),
            "point": None,
            "content_hash": item.content_hash,
            "quarantined": False,
        }

    def labelled(self, limit: int | None = None) -> Labelled:
        """Return the newest `limit` labelled traces, oldest first; read along the index `label_training`."""
        with self._transaction(write=False) as connection:
            newest = connection.execute(self._newest(limit)).all()[::-1]
            traces = self._read_traces(connection, [row.seq for row in newest])
        return Labelled(
            seq=np.array([row.seq for row in newest], dtype=np.int64),
            traces=traces,
            labels=np.array([row.success for row in newest], dtype=np.int8),
            hashes=np.array([row.content_hash for row in newest], dtype=np.int64),
        )

    def _newest(self, limit: int | None) -> sa.Select[Any]:
        columns = _label.c["seq", "success", "content_hash"]
        query = sa.select(*columns).where(_label.c.cell_id == self.cell_id, _label.c.quarantined == sa.false())
        return query.order_by(_label.c.seq.desc()).limit(limit)

    def _read_traces(self, connection: sa.Connection, seqs: Sequence[int]) -> NDArray[np.float32]:
        """Read the traces of labels `seqs` (increasing, none left out between) as (n, C, T), streamed."""
        if not seqs:
            return np.zeros((0, 0, 0), dtype=np.float32)
        rows = iter(connection.execute(self._trace_query(seqs[0], seqs[-1]).execution_options(yield_per=CHUNK)))
        first = _unpack_trace(next(rows))
        traces = np.empty((len(seqs), *first.shape), dtype=np.float32)
        traces[0] = first
        for i, row in enumerate(rows, start=1):
            if (row.channels, row.samples) != first.shape:
                raise mixed_shapes({first.shape, (row.channels, row.samples)})
            traces[i] = _unpack_trace(row)
        return traces

    def _trace_query(self, first: int, last: int) -> sa.Select[Any]:
        same = (_trace.c.cell_id == _label.c.cell_id) & (_trace.c.decision_id == _label.c.decision_id)
        columns = _trace.c["channels", "samples", "data"]
        query = sa.select(*columns).select_from(_label.join(_trace, same))
        mine = (_label.c.cell_id == self.cell_id) & (_label.c.quarantined == sa.false())
        return query.where(mine, _label.c.seq.between(first, last)).order_by(_label.c.seq)

    def points_since(self, seq: int, model_version: int) -> AddedPoints:
        """Return the points of `model_version` that came with labels after `seq`."""
        columns = _label.c["seq", "point", "success", "content_hash"]
        query = sa.select(*columns).where(_label.c.cell_id == self.cell_id, _label.c.seq > int(seq))
        query = query.where(_label.c.model_version == int(model_version), _label.c.point.is_not(None))
        with self._transaction(write=False) as connection:
            rows = connection.execute(query.order_by(_label.c.seq)).all()
        return AddedPoints(
            seq=np.array([row.seq for row in rows], dtype=np.int64),
            points=stack([_unpack(row.point) for row in rows], (0, 0)),
            labels=np.array([row.success for row in rows], dtype=np.int8),
            hashes=np.array([row.content_hash for row in rows], dtype=np.int64),
        )

    # Model versions

    def put_version(self, report: RetrainReport, last_seq: int, state: Mapping[str, NDArray[Any]] | None) -> None:
        """Commit a retrain; a dropped candidate has no state."""
        copies = check_state(report, state)
        row = {
            "cell_id": self.cell_id,
            "version": int(report.version),
            "time": self._clock(),
            "seconds": float(report.seconds),
            "n_traces": int(report.n_traces),
            "n_steps": int(report.n_steps),
            "accepted": bool(report.accepted),
            "reason": report.reason,
            "last_seq": int(last_seq),
            "state": None if copies is None else _to_npz(copies),
        }

        def record(connection: sa.Connection) -> None:
            self._next_seq(connection)  # for its lock
            newest = sa.select(sa.func.max(_version.c.retrain)).where(_version.c.cell_id == self.cell_id)
            retrain = (connection.execute(newest).scalar() or 0) + 1
            connection.execute(sa.insert(_version), row | {"retrain": retrain})

        self._write(record)

    def last_version(self) -> ModelVersion | None:
        """Return the newest accepted version."""
        query = sa.select(*_version.c["version", "last_seq", "state"])
        query = query.where(_version.c.cell_id == self.cell_id, _version.c.accepted == sa.true())
        with self._transaction(write=False) as connection:
            row = connection.execute(query.order_by(_version.c.retrain.desc()).limit(1)).first()
        return None if row is None else ModelVersion(row.version, row.last_seq, _from_npz(row.state, self._name))

    def retrains(self) -> list[RetrainReport]:
        """Return every retrain, oldest first."""
        names = ("version", "seconds", "n_traces", "n_steps", "accepted", "reason")
        query = sa.select(*(_version.c[name] for name in names)).where(_version.c.cell_id == self.cell_id)
        with self._transaction(write=False) as connection:
            return [RetrainReport(*row) for row in connection.execute(query.order_by(_version.c.retrain))]

    # Overview

    def status(self) -> dict[str, Any]:
        """Count decisions, labels and versions; what is queued is written first."""
        self.flush()
        kind = _decision.c["action", "reason", "quarantined"]
        kinds = sa.select(*kind, sa.func.count()).where(_decision.c.cell_id == self.cell_id).group_by(*kind)
        sources = sa.select(_label.c.source, sa.func.count()).where(_label.c.cell_id == self.cell_id)
        times = sa.select(sa.func.min(_decision.c.time), sa.func.max(_decision.c.time))
        with self._transaction(write=False) as connection:
            counted = [(row[0], row[1], row[2], row[3]) for row in connection.execute(kinds)]
            labels = {row[0]: row[1] for row in connection.execute(sources.group_by(_label.c.source))}
            first, last = connection.execute(times.where(_decision.c.cell_id == self.cell_id)).one()
        return summary(self.cell_id, counted, labels, self.retrains(), (first, last), self._failures)

    def _of_cell(self, table: sa.Table) -> sa.Select[Any]:
        return sa.select(table).where(table.c.cell_id == self.cell_id)


def _nothing(connection: sa.Connection) -> None:
    """Write the queue and no more."""


def _make_engine(url: str) -> sa.Engine:
    """Return an engine for a file or URL; refuses what this store was never tested on."""
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
            return sa.create_engine(parsed, pool_pre_ping=True)
        engine = sa.create_engine(parsed, connect_args={"timeout": BUSY})
    except (sa.exc.ArgumentError, ImportError, ValueError) as error:
        raise StoreError(
            f"Expected a file or a database URL that can be used here, got {url.split('@')[-1]!r}: {error}. "
            "For PostgreSQL: pip install 'dengine[postgres]'."
        ) from error
    sa.event.listen(engine, "connect", _set_pragmas)
    sa.event.listen(engine, "begin", _begin)
    return engine


def _set_pragmas(connection: Any, record: Any) -> None:
    connection.isolation_level = None  # `_begin` says when a transaction starts, not the driver
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = FULL")  # a returned commit survives lost power; NORMAL would not


def _begin(connection: sa.Connection) -> None:
    # busy_timeout does not cover a read that turns into a write, so a writer takes its lock at once.
    write = connection.get_execution_options().get("dengine_write", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")


def _advice(error: BaseException) -> str:
    """Say what to do about a database error, as far as its text tells."""
    said = str(error).lower()
    for text, advice in (
        ("not a database", "The file is something else; name a new file, or a store that dengine wrote."),
        ("unable to open", "Create the directory, or name one that can be written."),
        ("readonly", "Make the file and its directory writable."),
        ("full", "Free some space on the disk."),
        ("locked", "Another process holds the database; close it, or wait."),
        ("malformed", "The file is damaged; restore it from a copy."),
    ):
        if text in said:
            return advice
    return "Check that the database is there and can be written."


def _chunks(rows: Sequence[T]) -> Iterator[Sequence[T]]:
    return (rows[start : start + CHUNK] for start in range(0, len(rows), CHUNK))


def _pack(values: NDArray[np.float32]) -> bytes:
    return values.astype("<f4", copy=False).tobytes()


def _unpack(blob: bytes) -> NDArray[np.float32]:
    return np.frombuffer(blob, dtype="<f4").astype(np.float32)


def _unpack_trace(row: Any) -> NDArray[np.float32]:
    return _unpack(row.data).reshape(row.channels, row.samples)


def _read_decision(row: Any) -> StoredDecision:
    return StoredDecision(
        id=row.id,
        action=Action(row.action),
        predicted=Action(row.predicted),
        audit=row.audit,
        reason=Reason(row.reason),
        model_version=row.model_version,
        trace=_unpack(row.data).reshape(row.channels, row.samples),
        content_hash=row.content_hash,
        quarantined=row.quarantined,
        success=row.success,
        source=None if row.source is None else Source(row.source),
    )


def _to_npz(state: Mapping[str, NDArray[Any]]) -> bytes:
    """Return arrays as an npz file; written member by member, since `np.savez` reserves the name `file`."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, values in state.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                np.lib.format.write_array(member, values, allow_pickle=False)
    return buffer.getvalue()


def _from_npz(blob: bytes, name: str) -> dict[str, NDArray[Any]]:
    """Read what `_to_npz` wrote; a pickle in it is refused."""
    try:
        with np.load(io.BytesIO(blob), allow_pickle=False) as archive:
            return {key: archive[key] for key in archive.files}
    except (ValueError, OSError, zipfile.BadZipFile) as error:
        raise StoreError(f"Expected a version of plain arrays in {name}: {error}; restore it from a copy.") from error
