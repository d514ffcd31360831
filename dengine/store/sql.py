"""The store in a database: SQLite in a file, or PostgreSQL by URL for a fleet.

    store = SqlStore("engine.db", cell_id="cell-7")
    store = SqlStore("postgresql+psycopg://user:password@host/database", cell_id="cell-7")

What a returned call promises, given a disk that keeps what it synced: all that is put is committed, but for
`put_decision`: its row is queued, and committed within about 50 ms by a writer thread, by `flush`, or in the same
transaction as the next label, whichever comes first.
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
from . import sql_queries as ask
from .checks import as_channels, as_hash, as_part, as_text, check_import, check_parts, check_state, duplicate_id
from .records import (
    STATUS_EVENTS,
    AddedPoints,
    DecidedTrace,
    Event,
    Evidence,
    Labelled,
    ModelVersion,
    NewLabel,
    Outcomes,
    StoredDecision,
    checked_label,
    count_outcomes,
    imported_labels,
    refuse_repeats,
    stack,
    stored_decision,
    summary,
)
from .sql_fleet import ProductShare
from .sql_queue import SqlDatabase
from .sql_rows import chunks, label_row, read_decision, read_evidence, unpack, version_row
from .sql_tables import EVENT, LABEL, RESERVED, SETTING, VERSION


class SqlStore(ProductShare):
    """The contract of `Store` in a database.

    url : a file (SQLite), or a SQLAlchemy URL of SQLite or PostgreSQL.
    cell_id : whose rows these are; several cells share one database without seeing each other.
    clock : the time in seconds that rows are stamped with.
    product : what the cell makes; cells of one product share labels and versions. None: as a known cell has it, or
        nothing is shared.

    SQLite runs in WAL mode with synchronous=FULL; WAL needs a local disk, not a network drive. Two processes may
    open one cell: label numbers stay unique and increasing. Their labels then mix, and neither engine learns of
    the other's until it is opened anew, so give every running engine a cell_id of its own.

    A write that fails leaves its decisions in the queue; it is tried again every second and by each following
    `flush` or report, which raises `StoreError` if it fails again. `status()["write_failures"]` counts failures.
    The queue holds 64 MB of traces; beyond that `put_decision` writes them itself, or says that it cannot.
    """

    def __init__(
        self, url: str, cell_id: str = "cell", clock: Callable[[], float] = time.time, product: str | None = None
    ) -> None:
        """Open or create the store, and start its writer thread."""
        if not cell_id:
            raise StoreError("Expected a cell_id that names the cell, got an empty one; use for example 'cell'.")
        self.cell_id = cell_id
        self._clock = clock
        self._database = SqlDatabase(str(url), cell_id, product)

    # Settings

    def settings(self) -> dict[str, str]:
        """What `save_settings` was given; {} for a new store."""
        query = sa.select(SETTING).where(SETTING.c.cell_id == self.cell_id, SETTING.c.key.not_in(RESERVED))
        return {row.key: row.value for row in self._read(query)}

    def save_settings(self, settings: Mapping[str, str]) -> None:
        """Replace the settings by these."""
        for key in sorted(settings.keys() & set(RESERVED)):
            raise StoreError(f"Expected settings of the engine, got {key!r}, which is the store's; rename it.")
        rows = [{"cell_id": self.cell_id, "key": key, "value": value} for key, value in settings.items()]
        mine = (SETTING.c.cell_id == self.cell_id) & SETTING.c.key.not_in(RESERVED)

        def replace(connection: sa.Connection) -> None:
            self._refuse_disagreement(connection, settings)
            connection.execute(sa.delete(SETTING).where(mine))
            if rows:
                connection.execute(sa.insert(SETTING), rows)

        self._database.write(replace)

    # Decisions

    def put_decision(
        self,
        decision: Decision,
        trace: NDArray[np.float32],
        content_hash: int,
        quarantined: bool,
        part: str | None = None,
    ) -> None:
        """Queue a decision and its trace for the writer thread."""
        values, hash_, number = as_channels(trace), as_hash(content_hash), as_part(part)
        self._database.put(DecidedTrace(decision, values, hash_, bool(quarantined), self._clock(), number))

    def flush(self) -> None:
        """Return when every decision so far is committed."""
        self._database.flush()

    def get_decision(self, decision_id: str) -> StoredDecision | None:
        """Return the decision with its trace, queued ones included; None where it is unknown."""
        item = self._database.queued(decision_id)
        if item is not None:
            return stored_decision(item)
        rows = self._read(ask.decision_query(self.cell_id, decision_id))
        return read_decision(rows[0]) if rows else None

    # Labels

    def put_label(
        self,
        decision_id: str,
        success: bool,
        source: Source,
        model_version: int,
        point: NDArray[np.float32] | None,
        *,
        silent: int = 0,
    ) -> int:
        """Commit a label, in one transaction with its decision where that still waits; returns its number."""
        return int(self.put_labels([NewLabel(decision_id, success, source, model_version, point, silent)])[0])

    def put_labels(self, labels: Sequence[NewLabel]) -> NDArray[np.int64]:
        """Commit labels in one transaction, all or none, with decisions that still wait; returns their numbers."""
        given, now = [checked_label(label) for label in labels], self._clock()

        def add(connection: sa.Connection) -> NDArray[np.int64]:
            first = self._database.next_number(connection, LABEL.c.seq)
            held = self._held_of(connection, given)
            for part in chunks(range(len(given))):
                rows = [label_row(self.cell_id, given[i], first + i, now, *held[given[i].decision_id]) for i in part]
                connection.execute(sa.insert(LABEL), rows)
            return np.arange(first, first + len(given), dtype=np.int64)

        return self._database.write(add)

    def _held_of(self, connection: sa.Connection, labels: Sequence[NewLabel]) -> dict[str, tuple[int, bool]]:
        """Return what labels repeat of their decisions; a ReportError where one is unknown, or labelled already."""
        parts = chunks([label.decision_id for label in labels])
        found = [row for part in parts for row in connection.execute(ask.held_query(self.cell_id, part))]
        held = {row.id: (row.content_hash, row.quarantined) for row in found}
        refuse_repeats(labels, held, {row.id: (row.success, Source(row.source)) for row in found if row.source is not None})
        return held

    def put_labelled(
        self,
        decisions: Sequence[Decision],
        traces: NDArray[np.float32],
        hashes: NDArray[np.int64],
        labels: NDArray[np.int8],
        source: Source,
        parts: Sequence[str | None] | None = None,
    ) -> NDArray[np.int64]:
        """Import labelled traces in one transaction, all or none; returns their sequence numbers."""
        traces, now = check_import(decisions, traces, hashes, labels), self._clock()
        numbers, given = check_parts(parts, len(decisions)), imported_labels(decisions, labels, source)
        for decision in decisions:
            if self._database.queued(decision.id) is not None:
                raise duplicate_id(decision.id)

        def load(connection: sa.Connection) -> NDArray[np.int64]:
            first = self._database.next_number(connection, LABEL.c.seq)
            self._refuse_known(connection, [decision.id for decision in decisions])
            for part in chunks(range(len(decisions))):
                items = [DecidedTrace(decisions[i], traces[i], as_hash(hashes[i]), False, now, numbers[i]) for i in part]
                self._database.insert(connection, items)
                rows = [label_row(self.cell_id, given[i], first + i, now, as_hash(hashes[i]), False) for i in part]
                connection.execute(sa.insert(LABEL), rows)
            return np.arange(first, first + len(decisions), dtype=np.int64)

        return self._database.write(load)

    def _refuse_known(self, connection: sa.Connection, ids: Sequence[str]) -> None:
        for part in chunks(ids):
            known = connection.execute(ask.held_query(self.cell_id, part)).first()
            if known is not None:
                raise duplicate_id(known.id)

    def labelled(self, limit: int | None = None) -> Labelled:
        """Return the newest `limit` labelled traces, oldest first; read along the index `label_training`."""
        with self._database.transaction(write=False) as connection:
            return self._with_traces(connection, self._newest_labels(connection, limit)[::-1])

    def points_since(self, seq: int, model_version: int) -> AddedPoints:
        """Return the points of `model_version` that came with labels after `seq`."""
        rows = self._read(ask.points_query(self.cell_id, int(seq), int(model_version)))
        seqs = np.array([row.seq for row in rows], dtype=np.int64)
        return AddedPoints(seqs, stack([unpack(row.point) for row in rows], (0, 0)))

    def evidence_since(self, seq: int) -> Evidence:
        """Return what became of this cell's decisions whose labels came after `seq`, without the quarantined ones.

        A product's other cells are left out: a level that their streams certify says nothing certain of this one's, and
        a watch that counts them would notice too late that this cell has changed.
        """
        return read_evidence(self._read(ask.evidence_query(self.cell_id, int(seq))))

    def unreported_accepts(self) -> list[str]:
        """Return the ids of accepted decisions without a label, oldest first; what is queued is written first."""
        self.flush()
        with self._database.transaction(write=False) as connection:
            return list(connection.execute(ask.unreported_query(self.cell_id, connection.dialect.name)).scalars())

    def silent_total(self) -> int:
        """Return how many accepted parts went on unheard of, over all labels but the quarantined ones."""
        return int(self._read(ask.silent_query(self.cell_id))[0][0])

    def outcomes(self) -> Outcomes:
        """Count what became of what the model was certain of; what is queued is written first."""
        self.flush()
        return count_outcomes(tuple(row) for row in self._read(ask.outcome_query(self.cell_id)))

    def _read(self, query: sa.Select[Any]) -> Sequence[Any]:
        with self._database.transaction(write=False) as connection:
            return connection.execute(query).all()

    # Model versions

    def put_version(self, report: RetrainReport, last_seq: int, state: Mapping[str, NDArray[Any]] | None) -> int:
        """Commit a retrain; a dropped candidate has no state. Returns the version's number."""
        row = version_row(self.cell_id, report, int(last_seq), self._clock(), check_state(report, state))

        def record(connection: sa.Connection) -> int:
            retrain = self._database.next_number(connection, VERSION.c.retrain)
            number = self._database.scope.next_version(connection, report)
            connection.execute(sa.insert(VERSION), row | {"retrain": retrain, "version": number})
            return number

        return self._database.write(record)

    def last_version(self) -> ModelVersion | None:
        """Return the newest accepted version."""
        rows = self._read(ask.version_query(self._database.scope))
        return self._with_own_rule(rows[0]) if rows else None

    def retrains(self) -> list[RetrainReport]:
        """Return every retrain, oldest first."""
        return [RetrainReport(*row) for row in self._read(ask.retrain_query(self._database.scope))]

    # Events

    def put_event(self, kind: str, text: str) -> None:
        """Commit what happened to the cell's log."""
        row = {"cell_id": self.cell_id, "time": self._clock(), "kind": as_text(kind), "text": as_text(text)}

        def log(connection: sa.Connection) -> None:
            number = self._database.next_number(connection, EVENT.c.number)
            connection.execute(sa.insert(EVENT), row | {"number": number})

        self._database.write(log)

    def events(self, limit: int | None = None) -> list[Event]:
        """Return the newest `limit` events, oldest first."""
        return [Event(*row) for row in self._read(ask.event_query(self.cell_id, limit))[::-1]]

    # Overview

    def status(self) -> dict[str, Any]:
        """Count decisions, labels and versions, and show the newest events; what is queued is written first."""
        self.flush()
        kinds, sources = self._read(ask.kind_query(self.cell_id)), self._read(ask.source_query(self.cell_id))
        return summary(
            self.cell_id,
            [(row[0], row[1], row[2], row[3]) for row in kinds],
            {row.source: row.n for row in sources},
            self.retrains(),
            (min((row.first for row in kinds), default=None), max((row.last for row in kinds), default=None)),
            max((row.last for row in sources), default=None),
            self.events(STATUS_EVENTS),
            self._database.failures,
        ) | ({} if self.product is None else {"product": self.product})

    def close(self) -> None:
        """Flush, stop the writer and disconnect; if the flush fails the store stays open, so close it again later."""
        self._database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
