"""The store in a database: SQLite in a file, or PostgreSQL by URL for a fleet.

    store = SqlStore("engine.db", cell_id="cell-7")
    store = SqlStore("postgresql+psycopg://user:password@host/database", cell_id="cell-7")

What a returned call promises, given a disk that keeps what it synced: `put_label`, `put_labelled`, `put_version`
and `save_settings` are committed. `put_decision` is not: its row is queued, and committed within about 50 ms by a
writer thread, by `flush`, or in the same transaction as the next label, whichever comes first.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np
import sqlalchemy as sa
from numpy.typing import NDArray

from ..errors import StoreError
from ..records import Decision, RetrainReport, Source
from .checks import (
    already_reported,
    as_channels,
    as_hash,
    as_point,
    check_import,
    check_state,
    duplicate_id,
    mixed_shapes,
    unknown_decision,
)
from .records import (
    AddedPoints,
    DecidedTrace,
    Evidence,
    Labelled,
    ModelVersion,
    StoredDecision,
    stack,
    stored_decision,
    summary,
)
from .sql_queries import decision_query, evidence_query, newest_query, points_query, trace_query
from .sql_queue import SqlDatabase
from .sql_rows import CHUNK, chunks, from_npz, imported_row, pack, read_decision, unpack, unpack_trace, version_row
from .sql_tables import DECISION, LABEL, SCHEMA_KEY, SETTING, VERSION


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
        self._database = SqlDatabase(str(url), cell_id)

    # Settings

    def settings(self) -> dict[str, str]:
        """What `save_settings` was given; {} for a new store."""
        query = self._of_cell(SETTING).where(SETTING.c.key != SCHEMA_KEY)
        return {row.key: row.value for row in self._read(query)}

    def save_settings(self, settings: Mapping[str, str]) -> None:
        """Replace the settings by these."""
        if SCHEMA_KEY in settings:
            raise StoreError(f"Expected settings of the engine, got {SCHEMA_KEY!r}, which is the store's; rename it.")
        rows = [{"cell_id": self.cell_id, "key": key, "value": value} for key, value in settings.items()]
        mine = (SETTING.c.cell_id == self.cell_id) & (SETTING.c.key != SCHEMA_KEY)

        def replace(connection: sa.Connection) -> None:
            connection.execute(sa.delete(SETTING).where(mine))
            if rows:
                connection.execute(sa.insert(SETTING), rows)

        self._database.write(replace)

    # Decisions

    def put_decision(self, decision: Decision, trace: NDArray[np.float32], content_hash: int, quarantined: bool) -> None:
        """Queue a decision and its trace for the writer thread."""
        item = DecidedTrace(decision, as_channels(trace), as_hash(content_hash), bool(quarantined), self._clock())
        self._database.put(item)

    def flush(self) -> None:
        """Return when every decision so far is committed."""
        self._database.flush()

    def get_decision(self, decision_id: str) -> StoredDecision | None:
        """Return the decision with its trace, queued ones included; None where it is unknown."""
        item = self._database.queued(decision_id)
        if item is not None:
            return stored_decision(item)
        rows = self._read(decision_query(self.cell_id, decision_id))
        return read_decision(rows[0]) if rows else None

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
            "point": None if copy is None else pack(copy),
        }

        def label(connection: sa.Connection) -> int:
            seq = self._next_seq(connection)
            held = self._held_of(connection, decision_id, bool(success), source)
            connection.execute(sa.insert(LABEL), row | held | {"seq": seq})
            return seq

        return self._database.write(label)

    def _held_of(self, connection: sa.Connection, decision_id: str, success: bool, source: Source) -> dict[str, Any]:
        """Return what a label repeats of its decision; a ReportError where there is none, or a label already."""
        labels = (LABEL.c.cell_id == DECISION.c.cell_id) & (LABEL.c.decision_id == DECISION.c.id)
        columns = DECISION.c["content_hash", "quarantined"]
        query = sa.select(*columns, LABEL.c.success, LABEL.c.source).select_from(DECISION.outerjoin(LABEL, labels))
        mine = (DECISION.c.cell_id == self.cell_id) & (DECISION.c.id == decision_id)
        found = connection.execute(query.where(mine)).first()
        if found is None:
            raise unknown_decision(decision_id)
        if found.source is not None:
            raise already_reported(decision_id, (found.success, Source(found.source)), (success, source))
        return {"content_hash": found.content_hash, "quarantined": found.quarantined}

    def _next_seq(self, connection: sa.Connection) -> int:
        """Lock the cell (PostgreSQL; SQLite's BEGIN IMMEDIATE did it already), then number its next label."""
        connection.execute(self._of_cell(SETTING).where(SETTING.c.key == SCHEMA_KEY).with_for_update())
        newest = sa.select(sa.func.max(LABEL.c.seq)).where(LABEL.c.cell_id == self.cell_id)
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
        for decision in decisions:
            if self._database.queued(decision.id) is not None:
                raise duplicate_id(decision.id)

        def load(connection: sa.Connection) -> NDArray[np.int64]:
            first = self._next_seq(connection)
            self._refuse_known(connection, [decision.id for decision in decisions])
            for part in chunks(range(len(decisions))):
                items = [DecidedTrace(decisions[i], traces[i], as_hash(hashes[i]), False, now) for i in part]
                self._database.insert(connection, items)
                rows = [
                    imported_row(self.cell_id, item, first + i, bool(labels[i]), source)
                    for i, item in zip(part, items, strict=True)
                ]
                connection.execute(sa.insert(LABEL), rows)
            return np.arange(first, first + len(decisions), dtype=np.int64)

        return self._database.write(load)

    def _refuse_known(self, connection: sa.Connection, ids: Sequence[str]) -> None:
        query = sa.select(DECISION.c.id).where(DECISION.c.cell_id == self.cell_id)
        for part in chunks(ids):
            known = connection.execute(query.where(DECISION.c.id.in_(part))).scalar()
            if known is not None:
                raise duplicate_id(known)

    def labelled(self, limit: int | None = None) -> Labelled:
        """Return the newest `limit` labelled traces, oldest first; read along the index `label_training`."""
        with self._database.transaction(write=False) as connection:
            newest = connection.execute(newest_query(self.cell_id, limit)).all()[::-1]
            traces = self._read_traces(connection, [row.seq for row in newest])
        return Labelled(
            seq=np.array([row.seq for row in newest], dtype=np.int64),
            traces=traces,
            labels=np.array([row.success for row in newest], dtype=np.int8),
            hashes=np.array([row.content_hash for row in newest], dtype=np.int64),
        )

    def _read_traces(self, connection: sa.Connection, seqs: Sequence[int]) -> NDArray[np.float32]:
        """Read the traces of labels `seqs` (increasing, none left out between) as (n, C, T), streamed."""
        if not seqs:
            return np.zeros((0, 0, 0), dtype=np.float32)
        rows = iter(connection.execute(trace_query(self.cell_id, seqs[0], seqs[-1]).execution_options(yield_per=CHUNK)))
        first = unpack_trace(next(rows))
        traces = np.empty((len(seqs), *first.shape), dtype=np.float32)
        traces[0] = first
        for i, row in enumerate(rows, start=1):
            if (row.channels, row.samples) != first.shape:
                raise mixed_shapes({first.shape, (row.channels, row.samples)})
            traces[i] = unpack_trace(row)
        return traces

    def points_since(self, seq: int, model_version: int) -> AddedPoints:
        """Return the points of `model_version` that came with labels after `seq`."""
        rows = self._read(points_query(self.cell_id, int(seq), int(model_version)))
        seqs = np.array([row.seq for row in rows], dtype=np.int64)
        return AddedPoints(seqs, stack([unpack(row.point) for row in rows], (0, 0)))

    def evidence_since(self, seq: int) -> Evidence:
        """Return what became of the decisions whose labels came after `seq`, without the quarantined ones."""
        rows = self._read(evidence_query(self.cell_id, int(seq)))
        return Evidence(
            seq=np.array([row.seq for row in rows], dtype=np.int64),
            lower=np.array([row.lower for row in rows], dtype=np.float64),
            upper=np.array([row.upper for row in rows], dtype=np.float64),
            success=np.array([row.success for row in rows], dtype=bool),
        )

    def _read(self, query: sa.Select[Any]) -> Sequence[Any]:
        with self._database.transaction(write=False) as connection:
            return connection.execute(query).all()

    # Model versions

    def put_version(self, report: RetrainReport, last_seq: int, state: Mapping[str, NDArray[Any]] | None) -> None:
        """Commit a retrain; a dropped candidate has no state."""
        row = version_row(self.cell_id, report, int(last_seq), self._clock(), check_state(report, state))

        def record(connection: sa.Connection) -> None:
            self._next_seq(connection)  # for its lock
            newest = sa.select(sa.func.max(VERSION.c.retrain)).where(VERSION.c.cell_id == self.cell_id)
            retrain = (connection.execute(newest).scalar() or 0) + 1
            connection.execute(sa.insert(VERSION), row | {"retrain": retrain})

        self._database.write(record)

    def last_version(self) -> ModelVersion | None:
        """Return the newest accepted version."""
        query = sa.select(*VERSION.c["version", "last_seq", "state"])
        query = query.where(VERSION.c.cell_id == self.cell_id, VERSION.c.accepted == sa.true())
        rows = self._read(query.order_by(VERSION.c.retrain.desc()).limit(1))
        return (
            ModelVersion(rows[0].version, rows[0].last_seq, from_npz(rows[0].state, self._database.name)) if rows else None
        )

    def retrains(self) -> list[RetrainReport]:
        """Return every retrain, oldest first."""
        names = ("version", "seconds", "n_traces", "n_steps", "accepted", "reason")
        query = sa.select(*(VERSION.c[name] for name in names)).where(VERSION.c.cell_id == self.cell_id)
        return [RetrainReport(*row) for row in self._read(query.order_by(VERSION.c.retrain))]

    # Overview

    def status(self) -> dict[str, Any]:
        """Count decisions, labels and versions; what is queued is written first."""
        self.flush()
        kind = DECISION.c["action", "reason", "quarantined"]
        kinds = sa.select(*kind, sa.func.count()).where(DECISION.c.cell_id == self.cell_id).group_by(*kind)
        sources = sa.select(LABEL.c.source, sa.func.count()).where(LABEL.c.cell_id == self.cell_id)
        times = sa.select(sa.func.min(DECISION.c.time), sa.func.max(DECISION.c.time))
        with self._database.transaction(write=False) as connection:
            counted = [(row[0], row[1], row[2], row[3]) for row in connection.execute(kinds)]
            labels = {row[0]: row[1] for row in connection.execute(sources.group_by(LABEL.c.source))}
            first, last = connection.execute(times.where(DECISION.c.cell_id == self.cell_id)).one()
        return summary(self.cell_id, counted, labels, self.retrains(), (first, last), self._database.failures)

    def _of_cell(self, table: sa.Table) -> sa.Select[Any]:
        return sa.select(table).where(table.c.cell_id == self.cell_id)

    def close(self) -> None:
        """Flush, stop the writer and disconnect; if the flush fails the store stays open, so close it again later."""
        self._database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
