"""The store in a database: SQLite in a file, or PostgreSQL by URL for a fleet.

    store = SqlStore("engine.db", cell_id="cell-7")
    store = SqlStore("postgresql+psycopg://user:password@host/database", cell_id="cell-7")

What a returned call promises, given a disk that keeps what it synced: all that is put is committed. An engine does not put
what it decides: that goes into a journal first, and from there, by `take`, into the database.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

import numpy as np
import sqlalchemy as sa
from numpy.typing import NDArray

from ..errors import StoreError, shortened
from ..records import Action, Decision, Reason, RetrainReport, Source
from .base import Store
from .connections import Database
from .journal import Journal, Record, TakenLabel, journal_path
from .ledger import is_sound, state_sum
from .peers import must_agree
from .queries import (
    LABEL_OF_DECISION,
    WITH_LABELS,
    Scope,
    cells_of,
    counted,
    decisions_query,
    lock_product,
    newest_of,
    past_query,
    remembered,
    stretches_query,
    tally_query,
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
    as_label,
    as_text,
    check_state,
    checked_decision,
    checked_label,
    duplicate_id,
    from_row,
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
    read_decision,
    to_npz,
)
from .views import HistoryFilter, Kind, PastLabel, Stretch, Tally, count_outcomes, summary

if TYPE_CHECKING:
    from .verification import HistoryReport

WAIT = 0.4  # seconds that an engine waits for its disk and for the database
WAIT_VARIABLE = "DENGINE_STORE_WAIT"  # of the environment: other seconds for all stores that are given none
NAMED = 20  # decisions that an event names
REPORT = ("version", "seconds", "n_traces", "n_steps", "accepted", "reason")  # the fields of a `RetrainReport`


class SqlStore(Store):
    """The contract of `Store` in a database.

    url : a file (SQLite), or a SQLAlchemy URL of SQLite or PostgreSQL.
    cell_id : whose rows these are; several cells share one database without seeing each other.
    clock : the time in seconds that rows are stamped with.
    product : what the cell makes; cells of one product share labels and versions. None: as a known cell has it, or
        nothing is shared.
    wait : seconds that a cell's engine waits for its disk, and for the database, at most. None: as the environment's
        DENGINE_STORE_WAIT says, or 0.4.
    keep_versions : newest model versions that keep their states, beside the first and a few older ones (`keeps_state`);
        None: all keep them. A retrain itself stays listed for ever.

    SQLite runs in WAL mode with synchronous=FULL; WAL needs a local disk, not a network drive. Two processes may open one
    cell: label numbers stay unique and increasing. Engines own their cell (`own`): a second one is refused.
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
        """Open or create the store."""
        if not cell_id:
            raise StoreError("Expected a cell_id that names the cell, got an empty one; use for example 'cell'.")
        self.cell_id = cell_id
        if keep_versions is not None and (type(keep_versions) is not int or keep_versions < 2):
            raise StoreError(
                f"Expected keep_versions of 2 or more, or None for all, got {keep_versions!r}; leave it at {KEEP}."
            )
        self.keep_versions = keep_versions
        self.wait: float | None = _checked_wait(wait)
        self.clock = clock
        self.before_use: Callable[[], None] = lambda: None
        self._database = Database(str(url), cell_id, clock, product, lambda: self.before_use())
        self._read, self._scope = self._database.read, self._database.scope
        self.product = self._scope.product
        self._remote = self._database.url.get_backend_name() != "sqlite"
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
        item = checked_decision(decision, trace, content_hash, quarantined, self.clock())

        def add(connection: sa.Connection) -> None:
            if self._database.held(connection, [decision.id]):
                raise duplicate_id(decision.id)
            self._database.insert(connection, [item])

        self._database.write(add)

    def flush(self) -> None:
        self._database.check_open()
        self.before_use()

    def get_decision(self, decision_id: str, trace: bool = True) -> StoredDecision | None:
        if not trace:
            rows = self._read(past_query(self.cell_id).where(DECISION.c.id == decision_id))
            return read_decision(rows[0]) if rows else None
        same = (TRACE.c.cell_id == DECISION.c.cell_id) & (TRACE.c.decision_id == DECISION.c.id)
        stored = (TRACE.c.entry.label("trace_entry"), TRACE.c.sum.label("trace_sum"))
        query = past_query(self.cell_id).add_columns(*TRACE.c["channels", "samples", "data"], *stored)
        rows = self._read(query.join(TRACE, same).where(DECISION.c.id == decision_id))
        if not rows:
            return None
        row = rows[0]
        values = {"cell_id": row.cell_id, "decision_id": row.id, "channels": row.channels, "samples": row.samples}
        if not is_sound(TRACE.name, values | {"data": row.data, "entry": row.trace_entry, "sum": row.trace_sum}):
            raise StoreError(
                f"Expected the trace of decision {row.id!r} as it was stored in {self._database.name}, its bytes have "
                "changed; see `dengine verify`, and restore the store from a copy."
            )
        return read_decision(row)

    def decision_ids(self) -> list[str]:
        return [row.id for row in self._read(sa.select(DECISION.c.id).where(DECISION.c.cell_id == self.cell_id))]

    # Labels

    def put_labels(self, labels: Sequence[NewLabel]) -> NDArray[np.int64]:
        given, now = [checked_label(label) for label in labels], self.clock()

        def add(connection: sa.Connection) -> list[int]:
            held = self._database.held(connection, [label.decision_id for label in given])
            said = {name: (row.success, Source(row.source)) for name, row in held.items() if row.source is not None}
            refuse_repeats(given, held, said)
            taken = [TakenLabel(each, now, 0, 0.0) for each in given]
            return self._database.insert_labels(connection, taken, held)

        return np.array(self._database.write(add), dtype=np.int64)

    # Training

    def labelled(
        self,
        limit: int | None = None,
        *,
        first: int = 1,
        last: int | None = None,
        corrected_to: int | None = None,
        own: bool = False,
    ) -> Labelled:
        scope = Scope(self.cell_id) if own else self._scope
        query = training_query(scope, corrected_to).order_by(LABEL.c.seq.desc()).limit(limit)
        query = query if first <= 1 else query.where(LABEL.c.seq >= int(first))
        query = query if last is None else query.where(LABEL.c.seq <= last)
        with self._database.transaction(write=False) as connection:
            rows = self._newest(connection, query, limit, last)[::-1]
            found, damaged = self._with_traces(connection, rows, scope)
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
            if row.seq not in at or not is_sound(TRACE.name, dict(zip(TRACE.c.keys(), row, strict=False))):
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
        mine = (DECISION.c.cell_id == self.cell_id) & (DECISION.c.quarantined == sa.false()) & LABEL.c.seq.is_(None)
        query = sa.select(DECISION.c.id).select_from(WITH_LABELS).where(mine, DECISION.c.action == Action.ACCEPT.value)
        # In the order of insertion, whatever the clock said: rows never change. PostgreSQL may fill an earlier page again.
        names = ("decision.entry", "decision.ctid") if self._remote else ("decision.rowid",)
        inserted = query.where(_since(DECISION, since_version)).order_by(*map(sa.literal_column, names))
        return [row.id for row in self._read(inserted)]

    def silent_total(self, since_version: int = 0) -> int:
        query = sa.select(sa.func.coalesce(sa.func.sum(LABEL.c.silent), 0))
        mine = (LABEL.c.cell_id == self.cell_id) & (LABEL.c.quarantined == sa.false())
        return int(self._read(query.where(mine, _since(LABEL, since_version)))[0][0])

    def outcomes(self, since_version: int = 0) -> Outcomes:
        kind = (*DECISION.c["action", "predicted", "audit"], counted().label("success"))
        certain = ((DECISION.c.action != Action.VERIFY.value) | DECISION.c.audit) & _since(DECISION, since_version)
        mine = DECISION.c.cell_id == self.cell_id
        each = sa.select(*kind).select_from(WITH_LABELS).where(mine, certain).subquery()
        rows = self._read(sa.select(*each.c, sa.func.count()).group_by(*each.c))
        return count_outcomes(tuple(row) for row in rows)

    def status(self) -> dict[str, Any]:
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
        row = self._version_row(report, last_seq, state, self.clock())
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

    def versions(self, own: bool = False) -> list[StoredVersion]:
        size = sa.func.length(VERSION.c.state).label("size")
        columns = (*VERSION.c["retrain", "time", "last_seq"], size, *VERSION.c[REPORT])
        mine = VERSION.c.cell_id == self.cell_id if own else self._scope.shared(VERSION.c.cell_id)
        rows = self._read(sa.select(*columns).where(mine).order_by(VERSION.c.retrain))
        return [
            StoredVersion(row.retrain, row.time, row.last_seq, RetrainReport(*row[4:]), row.size or 0, row.size is not None)
            for row in rows
        ]

    # Events and corrections

    def _note(self, kind: str, text: str) -> None:
        """Commit an event, unless one of these very words is there."""
        said = (EVENT.c.cell_id == self.cell_id) & (EVENT.c.kind == as_text(kind)) & (EVENT.c.text == as_text(text))
        if not self._read(sa.select(EVENT.c.number).where(said).limit(1)):
            self.put_event(kind, text)

    def events(self, limit: int | None = None) -> list[Event]:
        query = sa.select(EVENT).where(EVENT.c.cell_id == self.cell_id).order_by(EVENT.c.number.desc()).limit(limit)
        return [from_row(Event, row._mapping) for row in self._read(query)[::-1]]

    def record(self, change: Change) -> int:
        now, author = self.clock(), as_text(change.author)
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
        held = self._database.held(connection, change.decisions)
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
        rows = self._read(decisions_query(self.cell_id, where, beyond, newest).limit(limit))
        return [read_decision(row) for row in (rows[::-1] if newest else rows)]

    def past_labels(self, after: int, upto: int | None = None, points: bool = False) -> list[PastLabel]:
        of_label = [column for column in LABEL.c if column.name != "point"]
        point = LABEL.c.point if points else sa.null().label("point")
        decided = (DECISION.c.time.label("decided"), *DECISION.c["lower", "upper", "reason"])
        query = sa.select(*of_label, point, *decided).select_from(LABEL.join(DECISION, LABEL_OF_DECISION))
        query = query.where(LABEL.c.cell_id == self.cell_id, LABEL.c.seq > int(after)).order_by(LABEL.c.seq)
        rows = self._read(query if upto is None else query.where(LABEL.c.seq <= upto))
        return [from_row(PastLabel, row._mapping, novel=row.reason == Reason.NOVEL) for row in rows]

    def tally(self, last: int | None = None) -> Tally:
        rows = self._read(tally_query(self.cell_id, last))
        kinds = tuple(from_row(Kind, row._mapping) for row in rows)
        return Tally(kinds, min((r.first for r in rows), default=None), max((r.last for r in rows), default=None))

    def stretches(self, n: int) -> list[Stretch]:
        every = self._read(sa.select(sa.func.count()).where(DECISION.c.cell_id == self.cell_id))[0][0]
        rows = self._read(stretches_query(self.cell_id, max(1, -(-int(every) // n))))
        return [Stretch(int(row[0]), float(row[1]), *(int(each) for each in row[2:])) for row in rows]

    def verify(self, expect: str | None = None) -> HistoryReport:
        """Check this cell's history against its ledger. See `verify_history`."""
        from .verification import verify_history

        return verify_history(self._database.url.render_as_string(hide_password=False), self.cell_id, expect)

    # The one engine that owns the cell

    def own(self) -> Journal:
        journal = Journal(journal_path(self._database.url, self.cell_id))
        try:
            if self._remote:
                self._database.lease()
        except StoreError:
            journal.close()
            raise
        self._journal = journal
        return journal

    def newest_entry(self) -> tuple[int, str] | None:
        return self._database.newest_entry()

    def holds_entry(self, number: int, digest: str) -> bool:
        return self._database.holds_entry(number, digest)

    def doubt(self) -> str:
        return self._database.doubt()

    def take(self, records: Sequence[Record]) -> list[tuple[str, int]]:
        return self._database.take(records)

    def committing(self, wanted: Callable[[], bool]) -> AbstractContextManager[None]:
        return self._database.committing(wanted)

    def let_go(self) -> None:
        self._database.close(waiting=False)

    def close(self) -> None:
        self._database.close()
        if self._journal is not None:
            self._journal.close()


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


def _since(table: sa.Table, version: int) -> sa.ColumnElement[bool]:
    """Rows by model versions from this one on."""
    return sa.true() if version <= 0 else table.c.model_version >= int(version)
