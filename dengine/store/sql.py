"""The store in a database: SQLite in a file, or PostgreSQL by URL for a fleet.

    store = SqlStore("engine.db", cell_id="cell-7")
    store = SqlStore("postgresql+psycopg://user:password@host/database", cell_id="cell-7")

What a returned call promises, given a disk that keeps what it synced: all that is put is committed, but for `put_decision`:
its row is queued, and committed within about 50 ms by a writer thread, by `flush`, or together with the next label.
"""

from __future__ import annotations

import hashlib
import math
import os
import time
import urllib.parse
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import sqlalchemy as sa
from numpy.typing import NDArray

from ..errors import StoreError, shortened
from ..records import Action, Decision, Reason, RetrainReport, Source
from .connections import Database
from .journal import Journal, LateEvent, LateLabel, Record
from .ledger import row_sum, state_sum
from .peers import must_agree
from .queries import (
    LABEL_OF_DECISION,
    SAID,
    WITH_LABELS,
    Scope,
    cells_of,
    counted,
    held_query,
    lock_product,
    newest_of,
    past_query,
    remembered,
    training_query,
)
from .records import (
    KEEP,
    STATUS_EVENTS,
    AddedPoints,
    Change,
    Correction,
    Event,
    Evidence,
    Key,
    Labelled,
    ModelVersion,
    NewLabel,
    News,
    Outcomes,
    StoredDecision,
    StoredVersion,
    VersionError,
    as_data,
    as_hash,
    as_label,
    as_text,
    check_decision,
    check_import,
    check_state,
    checked_decision,
    checked_label,
    duplicate_id,
    from_row,
    imported_labels,
    keeps_state,
    mixed_shapes,
    not_kept,
    nothing_to_correct,
    refuse_repeats,
    to_row,
    unknown_decision,
    unpack,
    without_rule,
)
from .schema import (
    CHUNK,
    CORRECTION,
    DECISION,
    EVENT,
    LABEL,
    RESERVED,
    SETTING,
    TRACE,
    VERSION,
    chunks,
    from_npz,
    label_row,
    read_decision,
    to_npz,
)
from .views import LABELS, HistoryFilter, Kind, PastLabel, PastRetrain, Stretch, Tally, count_outcomes, summary

if TYPE_CHECKING:
    from .verification import HistoryReport

WAIT = 0.4  # seconds that an engine waits for the database
WAIT_VARIABLE = "DENGINE_STORE_WAIT"  # of the environment: other seconds for all stores that are given none
NAMED = 20  # decisions that an event names
INSERTED = {"sqlite": "decision.rowid", "postgresql": "decision.ctid"}  # in the order of insertion: rows never change
IN_TIME = (DECISION.c.time, DECISION.c.id)
REPORT = ("version", "seconds", "n_traces", "n_steps", "accepted", "reason")  # the fields of a `RetrainReport`


class SqlStore:
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
        if keep_versions is not None and (type(keep_versions) is not int or keep_versions < 2):
            raise StoreError(
                f"Expected keep_versions of 2 or more, or None for all, got {keep_versions!r}; leave it at {KEEP}."
            )
        self.keep_versions = keep_versions
        self.wait: float | None = _checked_wait(wait)
        self._clock = clock
        self._database = Database(str(url), cell_id, clock, product)
        self._read, self._look, self._scope = self._database.read, self._database.look, self._database.scope
        self.product = self._scope.product
        self.remote = self._database.url.get_backend_name() != "sqlite"
        self._journal: Journal | None = None

    # Settings

    def settings(self) -> dict[str, str]:
        query = sa.select(SETTING).where(SETTING.c.cell_id == self.cell_id, SETTING.c.key.not_in(RESERVED))
        return {row.key: row.value for row in self._read(query)}

    def save_settings(self, settings: Mapping[str, str]) -> None:
        self._database.write(lambda connection: self._settle(connection, settings))

    def _settle(self, connection: sa.Connection, settings: Mapping[str, str]) -> None:
        """Replace the settings. SettingError where a peer embeds otherwise: the product stays locked until the commit."""
        for key in sorted(settings.keys() & set(RESERVED)):
            raise StoreError(f"Expected settings of the engine, got {key!r}, which is the store's; rename it.")
        if self.product is not None:
            self._scope.lock_cell(connection)
            lock_product(connection, self.product)
            for name, theirs in self._peers_of(connection, self.product).items():
                must_agree(settings, theirs, name, self.product)
        mine = (SETTING.c.cell_id == self.cell_id) & SETTING.c.key.not_in(RESERVED)
        connection.execute(sa.delete(SETTING).where(mine))
        rows = [{"cell_id": self.cell_id, "key": key, "value": value} for key, value in settings.items()]
        if rows:
            connection.execute(sa.insert(SETTING), rows)

    def peers_settings(self) -> dict[str, dict[str, str]]:
        if self.product is None:
            return {}
        with self._database.transaction(write=False) as connection:
            return self._peers_of(connection, self.product)

    def _peers_of(self, connection: sa.Connection, product: str) -> dict[str, dict[str, str]]:
        query = sa.select(SETTING).where(SETTING.c.cell_id.in_(cells_of(product)), SETTING.c.cell_id != self.cell_id)
        found: dict[str, dict[str, str]] = {}
        for row in connection.execute(query.where(SETTING.c.key.not_in(RESERVED)).order_by(SETTING.c.cell_id)):
            found.setdefault(row.cell_id, {})[row.key] = row.value
        return found

    # Decisions

    def put_decision(self, decision: Decision, trace: NDArray[np.float32], content_hash: int, quarantined: bool) -> None:
        self._database.put(checked_decision(decision, trace, content_hash, quarantined, self._clock()))

    def flush(self) -> None:
        self._database.flush()

    def get_decision(self, decision_id: str) -> StoredDecision | None:
        item = self._database.queued(decision_id)
        if item is not None:
            return replace(item, trace=item.trace.copy())
        same = (TRACE.c.cell_id == DECISION.c.cell_id) & (TRACE.c.decision_id == DECISION.c.id)
        stored = (TRACE.c.entry.label("trace_entry"), TRACE.c.sum.label("trace_sum"))
        query = past_query(self.cell_id).add_columns(*TRACE.c["channels", "samples", "data"], *stored)
        rows = self._read(query.join(TRACE, same).where(DECISION.c.id == decision_id))
        if not rows:
            return None
        row = rows[0]
        values = {"cell_id": row.cell_id, "decision_id": row.id, "channels": row.channels, "samples": row.samples}
        if not _is_sound(values | {"data": row.data, "entry": row.trace_entry, "sum": row.trace_sum}):
            raise StoreError(
                f"Expected the trace of decision {row.id!r} as it was stored in {self._database.name}, its bytes have "
                "changed; see `dengine verify`, and restore the store from a copy."
            )
        return read_decision(row)

    def decision_ids(self) -> list[str]:
        self.flush()
        return [row.id for row in self._read(sa.select(DECISION.c.id).where(DECISION.c.cell_id == self.cell_id))]

    # Labels

    def put_label(
        self, decision_id: str, success: bool, source: Source, model_version: int, point: NDArray[np.float32] | None,
        *, silent: int = 0,
    ) -> int:  # fmt: skip
        return int(self.put_labels([NewLabel(decision_id, success, source, model_version, point, silent)])[0])

    def put_labels(self, labels: Sequence[NewLabel]) -> NDArray[np.int64]:
        given, now = [checked_label(label) for label in labels], self._clock()

        def add(connection: sa.Connection) -> NDArray[np.int64]:
            first = self._scope.next_number(connection, LABEL.c.seq)
            held = self._held(connection, [label.decision_id for label in given])
            said = {name: (row.success, Source(row.source)) for name, row in held.items() if row.source is not None}
            refuse_repeats(given, held, said)
            of = [(held[label.decision_id].content_hash, held[label.decision_id].quarantined) for label in given]
            return self._add_labels(connection, first, given, of, now)

        return self._database.write(add)

    def _held(self, connection: sa.Connection, ids: Sequence[str]) -> dict[str, Any]:
        """What is stored of decisions and their labels, by id; the cell is locked by then."""
        return {row.id: row for part in chunks(ids) for row in connection.execute(held_query(self.cell_id, part))}

    def _add_labels(
        self, connection: sa.Connection, first: int, labels: Sequence[NewLabel], of: Sequence[tuple[int, bool]], now: float
    ) -> NDArray[np.int64]:
        """Insert labels from number `first` on; of : content hash and quarantine of their decisions."""
        for part in chunks(range(len(labels))):
            rows = [label_row(self.cell_id, labels[i], first + i, now, *of[i]) for i in part]
            connection.execute(sa.insert(LABEL), rows)
        return np.arange(first, first + len(labels), dtype=np.int64)

    def put_labelled(
        self,
        decisions: Sequence[Decision],
        traces: NDArray[np.float32],
        hashes: NDArray[np.int64],
        labels: NDArray[np.int8],
        source: Source,
    ) -> NDArray[np.int64]:
        traces, now = check_import(decisions, traces, hashes, labels), self._clock()
        given, of = imported_labels(decisions, labels, source), [(as_hash(each), False) for each in hashes]
        for decision in decisions:
            check_decision(decision)
            if self._database.queued(decision.id) is not None:
                raise duplicate_id(decision.id)

        def load(connection: sa.Connection) -> NDArray[np.int64]:
            first = self._scope.next_number(connection, LABEL.c.seq)
            for name in self._held(connection, [decision.id for decision in decisions]):
                raise duplicate_id(name)
            for part in chunks(range(len(decisions))):
                items = [StoredDecision(decisions[i], traces[i], *of[i], now) for i in part]
                self._database.insert(connection, items)
            return self._add_labels(connection, first, given, of, now)

        return self._database.write(load)

    # Training

    def labelled(
        self, limit: int | None = None, *, first: int = 1, last: int | None = None, corrected_to: int | None = None
    ) -> Labelled:
        query = training_query(self._scope, corrected_to).order_by(LABEL.c.seq.desc()).limit(limit)
        query = query if first <= 1 else query.where(LABEL.c.seq >= int(first))
        query = query if last is None else query.where(LABEL.c.seq <= last)
        with self._database.transaction(write=False) as connection:
            rows = self._newest(connection, query, limit, last)[::-1]
            found, damaged = self._with_traces(connection, rows, self._scope)
        return self._told_of(damaged, found)

    def _newest(
        self, connection: sa.Connection, query: sa.Select[Any], limit: int | None, last: int | None
    ) -> Sequence[Any]:
        """The newest labels, newest first. Of a product: by their numbers, or all would be read to be sorted."""
        if self.product is not None and limit is not None:
            newest = connection.execute(newest_of(self.product, LABEL.c.seq)).scalar() or 0
            newest = newest if last is None else min(newest, last)
            rows = connection.execute(query.where(LABEL.c.seq > newest - 2 * limit)).all()
            if len(rows) == limit or newest <= 2 * limit:
                return rows
        return connection.execute(query).all()  # more than every second is quarantined or forgotten

    def own_labelled(self) -> Labelled:
        own = Scope(self.cell_id)
        with self._database.transaction(write=False) as connection:
            rows = connection.execute(training_query(own).order_by(LABEL.c.seq)).all()
            found, damaged = self._with_traces(connection, rows, own)
        return self._told_of(damaged, found)

    def news_since(self, seq: int, limit: int) -> News:
        query = training_query(self._scope).where(LABEL.c.seq > int(seq)).order_by(LABEL.c.seq).limit(limit)
        with self._database.transaction(write=False) as connection:
            found, damaged = self._with_traces(connection, connection.execute(query).all(), self._scope)
            version = correction = 0
            if self.product is not None:
                accepted = newest_of(self.product, VERSION.c.version, VERSION.c.accepted == sa.true())
                version = connection.execute(accepted).scalar() or 0
                correction = connection.execute(newest_of(self.product, CORRECTION.c.number)).scalar() or 0
        return News(self._told_of(damaged, found), version, correction)

    def _with_traces(self, connection: sa.Connection, rows: Sequence[Any], scope: Scope) -> tuple[Labelled, list[str]]:
        """Labels, oldest first, with their traces, read one by one; and the decisions whose traces have changed."""
        at = {row.seq: i for i, row in enumerate(rows)}  # the forgotten are not among them
        traces, kept = np.zeros((0, 0, 0), dtype=np.float32), np.zeros(len(rows), dtype=bool)
        same = (TRACE.c.cell_id == LABEL.c.cell_id) & (TRACE.c.decision_id == LABEL.c.decision_id)
        query = sa.select(*TRACE.c, LABEL.c.seq).select_from(LABEL.join(TRACE, same)).order_by(LABEL.c.seq)
        query = query.where(scope.shared(LABEL.c.cell_id), LABEL.c.quarantined == sa.false())
        query = query.where(LABEL.c.seq.between(*((rows[0].seq, rows[-1].seq) if rows else (1, 0))))
        for row in connection.execute(query.execution_options(yield_per=CHUNK)):
            if row.seq not in at or not _is_sound(dict(zip(TRACE.c.keys(), row, strict=False))):
                continue
            if not kept.any():
                traces = np.empty((len(rows), row.channels, row.samples), dtype=np.float32)
            if (row.channels, row.samples) != traces.shape[1:]:
                raise mixed_shapes({traces.shape[1:], (row.channels, row.samples)})
            traces[at[row.seq]], kept[at[row.seq]] = unpack(row.data).reshape(row.channels, row.samples), True
        labels = [row.success for row in rows]
        if not all(label in (0, 1) for label in labels):
            raise StoreError("Expected labels that are True or False, found another: the store is damaged; restore a copy.")
        found = Labelled(
            seq=np.array([row.seq for row in rows], dtype=np.int64)[kept],
            traces=traces if kept.all() else traces[kept[: len(traces)]],
            labels=np.array(labels, dtype=np.int8)[kept],
            hashes=np.array([row.content_hash for row in rows], dtype=np.int64)[kept],
        )
        return found, [rows[i].decision_id for i in np.flatnonzero(~kept)]

    def _told_of(self, damaged: Sequence[str], found: Labelled) -> Labelled:
        """What was read, once its transaction is over: damage is an event."""
        if damaged:
            more = f" and {len(damaged) - NAMED} more" if len(damaged) > NAMED else ""
            what = f"decision {', '.join(damaged[:NAMED])}{more}; see dengine verify"
            self._note("damaged", f"left out of training, since the trace is not as it was stored: {what}")
        return found

    def points_since(self, seq: int, model_version: int) -> AddedPoints:
        mine = (LABEL.c.cell_id == self.cell_id) & (LABEL.c.seq > int(seq)) & LABEL.c.point.is_not(None)
        query = sa.select(*LABEL.c["seq", "point"]).where(mine, LABEL.c.model_version == int(model_version))
        return AddedPoints.of((row.seq, unpack(row.point)) for row in self._read(query.order_by(LABEL.c.seq)))

    # What became of decisions

    def evidence_since(self, seq: int, since_version: int = 0) -> Evidence:
        """Of this cell alone.

        A level that other cells' streams certify says nothing certain of this one's, and a watch that counts them would
        notice too late that this cell has changed.
        """
        of = (LABEL.c.seq, *DECISION.c["lower", "upper"], counted(), DECISION.c.reason, LABEL.c.silent)
        mine = (LABEL.c.cell_id == self.cell_id) & (LABEL.c.quarantined == sa.false()) & (LABEL.c.seq > int(seq))
        query = sa.select(*of).select_from(LABEL.join(DECISION, LABEL_OF_DECISION)).where(mine, remembered())
        rows = self._read(query.where(_since(DECISION, since_version)).order_by(LABEL.c.seq))
        return Evidence.of((*row[:4], row.reason == Reason.NOVEL, row.silent) for row in rows)

    def unreported_accepts(self, since_version: int = 0) -> list[str]:
        self.flush()
        mine = (DECISION.c.cell_id == self.cell_id) & (DECISION.c.quarantined == sa.false()) & LABEL.c.seq.is_(None)
        query = sa.select(DECISION.c.id).select_from(WITH_LABELS).where(mine, DECISION.c.action == Action.ACCEPT.value)
        inserted: sa.ColumnElement[Any] = sa.literal_column(INSERTED["postgresql" if self.remote else "sqlite"])
        return [row.id for row in self._read(query.where(_since(DECISION, since_version)).order_by(IN_TIME[0], inserted))]

    def silent_total(self, since_version: int = 0) -> int:
        query = sa.select(sa.func.coalesce(sa.func.sum(LABEL.c.silent), 0))
        mine = (LABEL.c.cell_id == self.cell_id) & (LABEL.c.quarantined == sa.false())
        return int(self._read(query.where(mine, _since(LABEL, since_version)))[0][0])

    def outcomes(self, since_version: int = 0) -> Outcomes:
        self.flush()
        kind = (*DECISION.c["action", "predicted", "audit"], counted().label("success"))
        certain = ((DECISION.c.action != Action.VERIFY.value) | DECISION.c.audit) & _since(DECISION, since_version)
        mine = DECISION.c.cell_id == self.cell_id
        each = sa.select(*kind).select_from(WITH_LABELS).where(mine, certain).subquery()
        rows = self._read(sa.select(*each.c, sa.func.count()).group_by(*each.c))
        return count_outcomes(tuple(row) for row in rows)

    def status(self) -> dict[str, Any]:
        self.flush()
        kind = DECISION.c["action", "reason", "quarantined"]
        times = (sa.func.min(DECISION.c.time).label("first"), sa.func.max(DECISION.c.time).label("last"))
        query = sa.select(*kind, sa.func.count(), *times).where(DECISION.c.cell_id == self.cell_id)
        kinds = self._read(query.group_by(*kind))
        query = sa.select(LABEL.c.source, sa.func.count().label("n"), sa.func.max(LABEL.c.time).label("last"))
        sources = self._read(query.where(LABEL.c.cell_id == self.cell_id, remembered()).group_by(LABEL.c.source))
        later = CORRECTION.alias("later")
        newer = (later.c.cell_id == CORRECTION.c.cell_id) & (later.c.decision_id == CORRECTION.c.decision_id)
        newest = ~sa.exists().where(newer, later.c.number > CORRECTION.c.number)
        query = sa.select(CORRECTION.c.success, sa.func.count()).where(CORRECTION.c.cell_id == self.cell_id, newest)
        said = self._read(query.group_by(CORRECTION.c.success))
        return summary(
            self.cell_id,
            [(row[0], row[1], row[2], row[3]) for row in kinds],
            {row.source: row.n for row in sources},
            self.retrains(),
            (min((row.first for row in kinds), default=None), max((row.last for row in kinds), default=None)),
            max((row.last for row in sources), default=None),
            self.events(STATUS_EVENTS),
            self._database.failures,
            corrected=sum(n for success, n in said if success is not None),
            forgotten=sum(n for success, n in said if success is None),
        ) | ({} if self.product is None else {"product": self.product})

    # Model versions

    def put_version(self, report: RetrainReport, last_seq: int, state: Mapping[str, NDArray[Any]] | None) -> int:
        row = self._version_row(report, last_seq, state, self._clock())
        return self._database.write(lambda connection: self._add_version(connection, row))

    def _version_row(
        self, report: RetrainReport, last_seq: int, state: Mapping[str, NDArray[Any]] | None, now: float
    ) -> dict[str, Any]:
        arrays = check_state(report, state)
        held = {"cell_id": self.cell_id, "time": now, "last_seq": int(last_seq)}
        return held | {"state": None if arrays is None else to_npz(arrays)} | to_row(report)

    def _add_version(self, connection: sa.Connection, row: dict[str, Any]) -> int:
        """Insert a version, and let go of states that `keeps_state` does not keep; returns its number."""
        retrain = self._scope.next_number(connection, VERSION.c.retrain)
        number = self._scope.next_version(connection, row["version"], row["accepted"])
        connection.execute(sa.insert(VERSION), row | {"retrain": retrain, "version": number})
        if row["accepted"]:
            held = connection.execute(self._accepted().where(VERSION.c.state.is_not(None))).all()
            gone = [each.retrain for each in held if not keeps_state(each.version, number, self.keep_versions)]
            mine = self._scope.shared(VERSION.c.cell_id) & VERSION.c.retrain.in_(gone)
            if gone:
                connection.execute(sa.update(VERSION).where(mine).values(state=None))
        return number

    def _accepted(self) -> sa.Select[Any]:
        """The accepted versions, newest first, and whether each has its state."""
        query = sa.select(*VERSION.c["retrain", "version"], VERSION.c.state.is_not(None).label("kept"))
        query = query.where(self._scope.shared(VERSION.c.cell_id), VERSION.c.accepted == sa.true())
        return query.order_by(VERSION.c.retrain.desc())

    def last_version(self) -> ModelVersion | None:
        for i, row in enumerate(self._read(self._accepted())):
            if not row.kept and i > 0:
                continue  # thinned out, which the newest never is
            try:
                return self._loaded(row.retrain)
            except VersionError as error:
                self._note("damaged", f"{error} The accepted version before it answers.")
        return None

    def load_version(self, version: int) -> ModelVersion:
        held = {row.version: row.retrain for row in reversed(self._read(self._accepted())) if row.kept}
        if version not in held:
            raise not_kept(version, held)
        return self._loaded(held[version])

    def _loaded(self, retrain: int) -> ModelVersion:
        query = sa.select(*VERSION.c["cell_id", "version", "last_seq", "state", "state_sum"])
        mine = self._scope.shared(VERSION.c.cell_id) & (VERSION.c.retrain == retrain)
        row = self._read(query.where(mine))[0]
        if row.state is None or (row.state_sum is not None and state_sum(row.state) != row.state_sum):
            raise VersionError(
                f"Expected the state of version {row.version} as it was stored in {self._database.name}, "
                "its bytes have changed; restore the store from a copy."
            )
        try:
            state = from_npz(row.state, self._database.name)
        except StoreError as error:
            raise VersionError(str(error)) from error
        if row.cell_id != self.cell_id:  # what a peer's parts taught its rule says nothing certain of this cell
            state = without_rule(state) | {"told_to": np.array(0)}
        return ModelVersion(row.version, row.last_seq, state)

    def versions(self) -> list[StoredVersion]:
        size = sa.func.length(VERSION.c.state)
        query = sa.select(*VERSION.c["version", "time", "accepted", "reason"], size)
        rows = self._read(query.where(self._scope.shared(VERSION.c.cell_id)).order_by(VERSION.c.retrain))
        return [StoredVersion(row[0], row[1], row[2], row[3], row[4] or 0, row[4] is not None) for row in rows]

    def retrains(self) -> list[RetrainReport]:
        query = sa.select(*VERSION.c[REPORT]).where(self._scope.shared(VERSION.c.cell_id))
        return [RetrainReport(*row) for row in self._read(query.order_by(VERSION.c.retrain))]

    # Events and corrections

    def put_event(self, kind: str, text: str, data: Mapping[str, Any] | None = None, author: str = "") -> None:
        self.record(Change(kind, text, data, author))

    def _note(self, kind: str, text: str) -> None:
        """Commit an event, unless one of these very words is there."""
        said = (EVENT.c.cell_id == self.cell_id) & (EVENT.c.kind == as_text(kind)) & (EVENT.c.text == as_text(text))
        if not self._read(sa.select(EVENT.c.number).where(said).limit(1)):
            self.put_event(kind, text)

    def events(self, limit: int | None = None) -> list[Event]:
        query = sa.select(EVENT).where(EVENT.c.cell_id == self.cell_id).order_by(EVENT.c.number.desc()).limit(limit)
        return [from_row(Event, row._mapping) for row in self._read(query)[::-1]]

    def record(self, change: Change) -> int:
        now, author = self._clock(), as_text(change.author)
        said = Event(0, now, as_text(change.kind), as_text(change.text), as_data(change.data), author)
        version = None if change.version is None else self._version_row(*change.version, now)

        def add(connection: sa.Connection) -> int:
            number = self._scope.next_number(connection, EVENT.c.number)
            connection.execute(sa.insert(EVENT), {"cell_id": self.cell_id} | to_row(said) | {"number": number})
            if change.decisions:
                self._correct(connection, change, {"author": author, "event": number, "time": now})
            if version is not None and (stored := self._add_version(connection, version)) != version["version"]:
                raise StoreError(
                    f"Expected version {version['version']} to be the next, a sister of the product stored {stored - 1} "
                    "meanwhile; try it again."
                )
            if change.settings is not None:
                self._settle(connection, change.settings)
            return number

        return self._database.write(add)

    def _correct(self, connection: sa.Connection, change: Change, event: Mapping[str, Any]) -> None:
        held = self._held(connection, change.decisions)
        for name in change.decisions:
            if name not in held:
                raise unknown_decision(name)
            if held[name].counted is None:
                raise nothing_to_correct(name)
        first = self._scope.next_number(connection, CORRECTION.c.number)
        newest = self._scope.next_number(connection, LABEL.c.seq) - 1
        said = {**event, "cell_id": self.cell_id, "success": change.success, "newest_seq": newest}
        rows = [
            said | {"number": number, "decision_id": name, "was": as_label(held[name].counted)}
            for number, name in enumerate(change.decisions, first)
        ]
        for part in chunks(rows):
            connection.execute(sa.insert(CORRECTION), part)

    def corrections(self, after: int = 0) -> list[Correction]:
        own = ("number", "time", "decision_id", "success", "was", "author", "event", "newest_seq")
        same = (LABEL.c.cell_id == CORRECTION.c.cell_id) & (LABEL.c.decision_id == CORRECTION.c.decision_id)
        query = sa.select(*CORRECTION.c[own], LABEL.c.seq).select_from(CORRECTION.join(LABEL, same))
        query = query.where(self._scope.shared(CORRECTION.c.cell_id), CORRECTION.c.number > int(after))
        return [Correction(*row) for row in self._read(query.order_by(CORRECTION.c.number))]

    # Looking back

    def decisions(
        self, where: HistoryFilter, limit: int, beyond: Key | None = None, newest: bool = True
    ) -> list[StoredDecision]:
        of = ((DECISION.c.action, where.action), (DECISION.c.predicted, where.predicted), (DECISION.c.reason, where.reason))
        meant = [column == wanted.value for column, wanted in of if wanted is not None]
        if where.part is not None:
            meant.append(DECISION.c.part == where.part)
        if where.label is not None:
            label = LABELS[where.label]
            meant.append(SAID.is_(None) if label is None else SAID.in_([int(label)]))
        if where.since is not None:
            meant.append(DECISION.c.time >= where.since)
        if where.until is not None:
            meant.append(DECISION.c.time < where.until)
        if beyond is not None:
            here, there = sa.tuple_(*IN_TIME), sa.tuple_(sa.literal(beyond[0], sa.Double), sa.literal(beyond[1]))
            meant.append(here < there if newest else here > there)
        order = [column.desc() if newest else column for column in IN_TIME]
        rows = self._look(past_query(self.cell_id).where(*meant).order_by(*order).limit(limit))
        return [read_decision(row) for row in (rows[::-1] if newest else rows)]

    def past_decision(self, decision_id: str) -> StoredDecision | None:
        rows = self._look(past_query(self.cell_id).where(DECISION.c.id == decision_id))
        return read_decision(rows[0]) if rows else None

    def past_labels(self, after: int, upto: int | None = None, points: bool = False) -> list[PastLabel]:
        of_label = [column for column in LABEL.c if column.name != "point"]
        point = LABEL.c.point if points else sa.null().label("point")
        decided = (DECISION.c.time.label("decided"), *DECISION.c["lower", "upper", "reason"])
        query = sa.select(*of_label, point, *decided).select_from(LABEL.join(DECISION, LABEL_OF_DECISION))
        query = query.where(LABEL.c.cell_id == self.cell_id, LABEL.c.seq > int(after)).order_by(LABEL.c.seq)
        rows = self._look(query if upto is None else query.where(LABEL.c.seq <= upto))
        return [from_row(PastLabel, row._mapping, novel=row.reason == Reason.NOVEL) for row in rows]

    def past_retrains(self) -> list[PastRetrain]:
        query = sa.select(*VERSION.c["retrain", "time", "last_seq"], *VERSION.c[REPORT])
        rows = self._look(query.where(VERSION.c.cell_id == self.cell_id).order_by(VERSION.c.retrain))
        return [PastRetrain(row[0], row[1], row[2], RetrainReport(*row[3:])) for row in rows]

    def tally(self, last: int | None = None) -> Tally:
        columns = ("cell_id", "id", "time", "action", "predicted", "reason", "audit", "quarantined")
        newest = sa.select(*DECISION.c[columns]).where(DECISION.c.cell_id == self.cell_id)
        if last is not None:
            newest = newest.order_by(*(column.desc() for column in IN_TIME)).limit(last)
        some = newest.subquery("newest")
        of = (LABEL.c.cell_id == some.c.cell_id) & (LABEL.c.decision_id == some.c.id)
        kind = (*some.c["action", "predicted", "reason", "audit", "quarantined"], SAID.label("success"))
        times = (sa.func.min(some.c.time).label("first"), sa.func.max(some.c.time).label("last"))
        query = sa.select(*kind, sa.func.count().label("n"), *times).select_from(some.outerjoin(LABEL, of))
        rows = self._look(query.group_by(*kind))
        kinds = tuple(from_row(Kind, row._mapping) for row in rows)
        return Tally(kinds, min((r.first for r in rows), default=None), max((r.last for r in rows), default=None))

    def stretches(self, n: int) -> list[Stretch]:
        mine = DECISION.c.cell_id == self.cell_id
        length = max(1, -(-int(self._look(sa.select(sa.func.count()).where(mine))[0][0]) // n))
        number = sa.func.row_number().over(order_by=IN_TIME) - 1
        columns = (*DECISION.c["cell_id", "id", "time", "action", "reason"], number.label("number"))
        every = sa.select(*columns).where(mine).subquery("every")
        of = (LABEL.c.cell_id == every.c.cell_id) & (LABEL.c.decision_id == every.c.id)
        accepted = every.c.action == Action.ACCEPT.value
        verified, novel = every.c.action == Action.VERIFY.value, every.c.reason == Reason.NOVEL.value
        which = (verified, novel, accepted, accepted & (SAID == 0))
        counts: list[sa.ColumnElement[Any]] = [sa.func.sum(sa.case((each, 1), else_=0)) for each in which]
        query = sa.select(*[sa.func.count(), sa.func.max(every.c.time), *counts]).select_from(every.outerjoin(LABEL, of))
        stretch = every.c.number - every.c.number % length
        rows = self._look(query.group_by(stretch).order_by(stretch))
        return [Stretch(int(row[0]), float(row[1]), *(int(each) for each in row[2:])) for row in rows]

    def verify(self, expect: str | None = None) -> HistoryReport:
        """Check this cell's history against its ledger; what is queued is written first. See `verify_history`."""
        from .verification import verify_history

        self.flush()
        return verify_history(self._database.url.render_as_string(hide_password=False), self.cell_id, expect)

    # The one engine that owns the cell

    def committing(self, wanted: Callable[[], bool]) -> AbstractContextManager[None]:
        return self._database.committing(wanted)

    def own(self) -> Journal:
        journal = Journal(_journal_path(self._database.url, self.cell_id))
        try:
            if self.remote:
                self._database.lease()
        except StoreError:
            journal.close()
            raise
        self._journal = journal
        return journal

    def play_back(self, records: Sequence[Record]) -> tuple[list[tuple[str, int]], list[str]]:
        def write(connection: sa.Connection) -> tuple[list[tuple[str, int]], list[str]]:
            decisions = [record for record in records if isinstance(record, StoredDecision)]
            self._database.insert_new(connection, decisions)
            number = self._scope.next_number(connection, EVENT.c.number)
            for late in (record for record in records if isinstance(record, LateEvent)):
                same = (EVENT.c.cell_id == self.cell_id) & (EVENT.c.time == late.time) & (EVENT.c.kind == late.kind)
                held = connection.execute(sa.select(EVENT.c.number).where(same, EVENT.c.text == late.text)).first()
                if held is None:
                    row = to_row(Event(number, late.time, late.kind, late.text))
                    connection.execute(sa.insert(EVENT), {"cell_id": self.cell_id} | row)
                    number += 1
            return self._play_labels(connection, [record for record in records if isinstance(record, LateLabel)])

        return self._database.write(write)

    def _play_labels(
        self, connection: sa.Connection, labels: Sequence[LateLabel]
    ) -> tuple[list[tuple[str, int]], list[str]]:
        number = self._scope.next_number(connection, LABEL.c.seq)
        held = self._held(connection, [late.label.decision_id for late in labels])
        numbers = {name: row.seq for name, row in held.items() if row.seq is not None}
        said: dict[str, tuple[bool, str]] = {name: (held[name].success, held[name].source) for name in numbers}
        arrived: list[tuple[str, int]] = []
        refused: list[str] = []
        for late in labels:
            name, now = late.label.decision_id, (late.label.success, late.label.source.value)
            if name not in held:
                refused.append(f"a label on {name!r}, which the store does not hold: {_words(*now)}")
            elif said.setdefault(name, now) != now:
                refused.append(f"a second label on {name!r}: {_words(*now)} after {_words(*said[name])}")
            else:
                if name not in numbers:  # what is stored already was written, and its answer lost
                    of = (held[name].content_hash, held[name].quarantined)
                    connection.execute(sa.insert(LABEL), label_row(self.cell_id, late.label, number, late.time, *of))
                    numbers[name], number = number, number + 1
                arrived.append((name, numbers[name]))
        return arrived, refused

    def let_go(self) -> None:
        self._database.let_go()

    def close(self) -> None:
        """Flush, stop the writer and disconnect; if the flush fails the store stays open, so close it again later."""
        self._database.close()
        if self._journal is not None:
            self._journal.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def _checked_wait(wait: float | None) -> float:
    said = os.environ.get(WAIT_VARIABLE) if wait is None else None
    name = "a wait" if said is None else WAIT_VARIABLE
    try:
        seconds = float(said) if said else WAIT if wait is None else wait
    except ValueError:
        seconds = math.nan
    if not 0.0 < seconds < math.inf:
        raise StoreError(f"Expected {name} above 0 seconds, got {shortened(said or wait)}; {WAIT} is the default.")
    return seconds


def _journal_path(url: sa.URL, cell_id: str) -> Path:
    """Return where a cell's journal lies: beside an SQLite file, else in the user's folder of state, `XDG_STATE_HOME`."""
    name = urllib.parse.quote(cell_id, safe="")
    if url.get_backend_name() == "sqlite":
        return Path(f"{Path(str(url.database)).absolute()}.{name}.journal")
    state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "dengine"
    where = hashlib.sha256(f"{url.host}:{url.port}/{url.database}/{cell_id}".encode()).hexdigest()[:12]
    return state / f"{name[:60]}.{where}.journal"


def _is_sound(row: dict[str, Any]) -> bool:
    """Whether a row of `trace` is as it was stored; one that an earlier dengine wrote has no sum, and passes."""
    return row["sum"] is None or row_sum(TRACE.name, row) == row["sum"]


def _since(table: sa.Table, version: int) -> sa.ColumnElement[bool]:
    """Rows by model versions from this one on."""
    return sa.true() if version <= 0 else table.c.model_version >= int(version)


def _words(success: bool, source: str) -> str:
    return f"{'success' if success else 'failure'} from {source}"
