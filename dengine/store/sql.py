"""The store in a database: SQLite in a file, or PostgreSQL by URL for a fleet.

    store = SqlStore("engine.db", cell_id="cell-7")
    store = SqlStore("postgresql+psycopg://user:password@host/database", cell_id="cell-7")

What a returned call promises, given a disk that keeps what it synced: all that is put is committed, but for `put_decision`:
its row is queued, and committed within about 50 ms by a writer thread, by `flush`, or together with the next label.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import sqlalchemy as sa
from numpy.typing import NDArray

from ..errors import StoreError
from ..records import Decision, Source
from . import sql_queries as ask
from .checks import as_hash, check_import, check_parts, duplicate_id
from .counting import count_outcomes, summary
from .intake import check_decision, decided_trace
from .kept_versions import KEEP, check_keep
from .records import (
    STATUS_EVENTS,
    AddedPoints,
    DecidedTrace,
    Evidence,
    NewLabel,
    Outcomes,
    StoredDecision,
    checked_label,
    imported_labels,
    refuse_repeats,
    stack,
    stored_decision,
)
from .sql_history import SqlHistory, replacing
from .sql_owning import SqlOwning, checked_wait
from .sql_queue import SqlDatabase
from .sql_rows import chunks, label_row, read_decision, read_evidence, unpack
from .sql_tables import LABEL, RESERVED, SETTING
from .sql_traces import SqlTraces, check_trace
from .sql_views import SqlViews

if TYPE_CHECKING:
    from .history import HistoryReport


class SqlStore(SqlOwning, SqlHistory, SqlTraces, SqlViews):
    """The contract of `Store` in a database.

    url : a file (SQLite), or a SQLAlchemy URL of SQLite or PostgreSQL.
    cell_id : whose rows these are; several cells share one database without seeing each other.
    clock : the time in seconds that rows are stamped with.
    product : what the cell makes; cells of one product share labels and versions. None: as a known cell has it, or
        nothing is shared.
    wait : seconds that a cell's engine waits for the database at most; what takes longer goes to the journal beside it.
        None: as the environment's DENGINE_STORE_WAIT says, or 0.4.
    keep_versions : newest model versions that keep their states, beside the first and a few older ones (`keeps_state`);
        None: all keep them. A retrain itself stays listed for ever.

    SQLite runs in WAL mode with synchronous=FULL; WAL needs a local disk, not a network drive. Two processes may open one
    cell: label numbers stay unique and increasing. Engines own their cell (`own`): a second one is refused.

    A write that fails leaves its decisions in the queue; it is tried again every second and by each following
    `flush` or report, which raises `StoreError` if it fails again. `status()["write_failures"]` counts failures.
    The queue holds 64 MB of traces; beyond that `put_decision` writes them itself, or says that it cannot.
    """

    def __init__(
        self,
        url: str,
        cell_id: str = "cell",
        clock: Callable[[], float] = time.time,
        *,
        product: str | None = None,
        wait: float | None = None,
        keep_versions: int | None = KEEP,
    ) -> None:
        """Open or create the store, and start its writer thread."""
        if not cell_id:
            raise StoreError("Expected a cell_id that names the cell, got an empty one; use for example 'cell'.")
        self.cell_id = cell_id
        self.keep_versions = check_keep(keep_versions)
        self._clock, self.wait = clock, checked_wait(wait)
        self._database = SqlDatabase(str(url), cell_id, clock, product)

    def settings(self) -> dict[str, str]:
        """What `save_settings` was given; {} for a new store."""
        query = sa.select(SETTING).where(SETTING.c.cell_id == self.cell_id, SETTING.c.key.not_in(RESERVED))
        return {row.key: row.value for row in self._read(query)}

    def save_settings(self, settings: Mapping[str, str]) -> None:
        """Replace the settings by these."""
        replace = replacing(self.cell_id, settings)

        def save(connection: sa.Connection) -> None:
            self._refuse_disagreement(connection, settings)
            replace(connection)

        self._database.write(save)

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
        self._database.put(decided_trace(decision, trace, content_hash, quarantined, self._clock(), part))

    def flush(self) -> None:
        """Return when every decision so far is committed."""
        self._database.flush()

    def get_decision(self, decision_id: str) -> StoredDecision | None:
        """Return the decision with its trace, queued ones included; None where it is unknown.

        StoreError where the trace is not as it was stored.
        """
        item = self._database.queued(decision_id)
        if item is not None:
            return stored_decision(item)
        rows = self._read(ask.decision_query(self.cell_id, decision_id))
        if not rows:
            return None
        check_trace(rows[0], self._database.name)
        return read_decision(rows[0])

    def decision_ids(self) -> list[str]:
        """Return the ids of every decision, in any order; what is queued is written first."""
        self.flush()
        with self._database.transaction(write=False) as connection:
            return list(connection.execute(ask.ids_query(self.cell_id)).scalars())

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
            check_decision(decision)
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

    def points_since(self, seq: int, model_version: int) -> AddedPoints:
        """Return the points of `model_version` that came with labels after `seq`."""
        rows = self._read(ask.points_query(self.cell_id, int(seq), int(model_version)))
        seqs = np.array([row.seq for row in rows], dtype=np.int64)
        return AddedPoints(seqs, stack([unpack(row.point) for row in rows], (0, 0)))

    def evidence_since(self, seq: int, since_version: int = 0) -> Evidence:
        """Return what became of this cell's decisions whose labels came after `seq`, without the quarantined and forgotten.

        A product's other cells are left out: a level that their streams certify says nothing certain of this one's, and
        a watch that counts them would notice too late that this cell has changed.
        """
        return read_evidence(self._read(ask.evidence_query(self.cell_id, int(seq), int(since_version))))

    def unreported_accepts(self, since_version: int = 0) -> list[str]:
        """Return the ids of accepted decisions without a label, oldest first; what is queued is written first."""
        self.flush()
        query = partial(ask.unreported_query, self.cell_id, since=int(since_version))
        with self._database.transaction(write=False) as connection:
            return list(connection.execute(query(connection.dialect.name)).scalars())

    def silent_total(self, since_version: int = 0) -> int:
        """Return how many accepted parts went on unheard of, over all labels but the quarantined ones."""
        return int(self._read(ask.silent_query(self.cell_id, int(since_version)))[0][0])

    def outcomes(self, since_version: int = 0) -> Outcomes:
        """Count what became of what the model was certain of; what is queued is written first."""
        self.flush()
        return count_outcomes(tuple(row) for row in self._read(ask.outcome_query(self.cell_id, int(since_version))))

    # Overview

    def verify(self, expect: str | None = None) -> HistoryReport:
        """Check this cell's history against its ledger; what is queued is written first. See `verify_history`."""
        from .history import verify_history

        self.flush()
        return verify_history(self._database.url.render_as_string(hide_password=False), self.cell_id, expect)

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
            self._corrected(),
        ) | ({} if self.product is None else {"product": self.product})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
