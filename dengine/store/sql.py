"""The store in a database: SQLite in a file, or PostgreSQL by URL for a fleet.

    store = SqlStore("engine.db", cell_id="cell-7")
    store = SqlStore("postgresql+psycopg://user:password@host/database", cell_id="cell-7")

What a returned call promises, given a disk that keeps what it synced: all that is put is committed. An engine does not put
what it decides: that goes into a journal first, and from there, by `apply_records`, into the database.
"""

import math
import os
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import sqlalchemy as sa
from numpy.typing import NDArray

from ..errors import StoreError, expect, instead, listed, shortened
from ..records import Action, Reason, RetrainReport, Source
from .connections import Database
from .journal import Journal, Record, journal_path
from .ledger import held_settings, is_sound, state_sum
from .peers import must_agree
from .queries import (
    LABEL_OF_DECISION,
    SAID,
    SOURCE,
    TRACE_OF_DECISION,
    WITH_LABELS,
    Scope,
    audit_columns,
    counted,
    n_decisions,
    past_query,
    stretches_query,
    training_query,
)
from .records import (
    CHUNK,
    FORGOTTEN,
    KEEP,
    POLICY_CHANGED,
    SHADOW_CHANGED,
    Change,
    Correction,
    Event,
    Labelled,
    ModelVersion,
    NewLabel,
    News,
    OutcomeRecord,
    StoredDecision,
    StoredVersion,
    VersionError,
    as_data,
    as_text,
    check_state,
    chunks,
    from_npz,
    from_row,
    keeps_state,
    nothing_to_correct,
    overdue_outcomes,
    read_decision,
    to_npz,
    to_row,
    unknown_decision,
    unpack,
    without_rule,
)
from .schema import CORRECTION, DECISION, EVENT, LABEL, PRODUCT, RESERVED, SETTING, TRACE, VERSION, hold
from .views import LABELS, DecisionGroup, HistoryFilter, PastLabel, Stretch, Tally

WAIT = 0.4  # seconds that an engine waits for its disk and for the database
WAIT_VARIABLE = "DENGINE_STORE_WAIT"  # of the environment: other seconds for all stores that are given none
MOST_TRAINED = 40  # versions that wait in memory, some half a megabyte each: a replay of 1,503 parts has fewer


class SqlStore(AbstractContextManager["SqlStore"]):
    """What an engine needs of its memory, in a database. Everything belongs to one cell.

    url : a file (SQLite), or a SQLAlchemy URL of SQLite or PostgreSQL. None: SQLite in memory, for replays and trials.
    cell_id : whose rows these are; several cells share one database without seeing each other.
    clock : the time in seconds that rows are stamped with.
    product : what the cell makes. None: as a known cell has it, or it shares nothing. Else labels as traces to train on,
        and versions, are those of all its cells: `labelled`, `last_version`, `versions`, `retrains`, `corrections`,
        and the numbers of both. What became of decisions stays the cell's own.
    wait : seconds that a cell's engine waits for its disk, and for the database, at most. None: as the environment's
        DENGINE_STORE_WAIT says, or 0.4.
    keep_versions : newest model versions that keep their states, beside the first and a few older ones (`keeps_state`);
        None: all keep them. A retrain itself stays listed for ever.

    SQLite runs in WAL mode with synchronous=FULL; WAL needs a local disk, not a network drive. Two processes may open one
    cell: label numbers stay unique and increasing. Engines own their cell (`claim_cell`): a second one is refused.
    before_use : called before each use of it but `apply_records`, so that it sees what is on its way into it.
    In memory it has no journal, nobody owns it, `close` leaves it as it is, and one thread at a time may use it.
    """

    def __init__(
        self,
        url: str | None = None,
        cell_id: str = "cell",
        clock: Callable[[], float] = time.time,
        *,
        product: str | None = None,
        wait: float | None = None,
        keep_versions: int | None = KEEP,
    ) -> None:
        expect(bool(cell_id), "a cell_id that names the cell", cell_id, "use for example 'cell'", StoreError)
        self.cell_id = cell_id
        whole = keep_versions is None or (type(keep_versions) is int and keep_versions >= 2)
        expect(whole, "keep_versions of 2 or more, or None for all", keep_versions, f"leave it at {KEEP}", StoreError)
        self.keep_versions = keep_versions
        self.wait = None if url is None else _checked_wait(wait)
        self.clock = clock
        self.before_use: Callable[[], None] = self._write_waiting
        self._waiting: list[Record] = []  # in memory: taken, and not written yet
        self._trained: list[tuple[Any, ...]] = []  # in memory: versions, the same
        self._held: dict[str, bool] = {}  # in memory: all decisions, and whether they have labels
        self._labels = 0  # in memory: number of the newest one
        self.database = Database(url if url is None else str(url), cell_id, clock, product, lambda: self.before_use())
        self._read, self._scope = self.database.read, self.database.scope
        self.product = self._scope.product
        self._journal: Journal | None = None

    # Settings

    def settings(self) -> dict[str, str]:
        """What `save_settings` was given; {} for a new store."""
        with self.database.reading() as connection:
            return held_settings(connection, self.cell_id)

    def save_settings(self, settings: Mapping[str, str]) -> None:
        """Replace the settings by these."""
        self.database.write(lambda connection: self._settle(connection, settings))

    def _settle(self, connection: sa.Connection, settings: Mapping[str, str]) -> None:
        """Replace the settings. SettingError where a peer embeds otherwise: the product stays locked until the commit."""
        for key in sorted(settings.keys() & set(RESERVED)):
            raise StoreError(f"Expected settings of the engine, got {key!r}, which is the store's; rename it.")
        if self.product is not None:
            hold(connection, PRODUCT, self.product)
            for name, theirs in self._peers_of(connection).items():
                must_agree(settings, theirs, name, self.product)
        mine = (SETTING.c.cell_id == self.cell_id) & SETTING.c.key.not_in(RESERVED)
        connection.execute(sa.delete(SETTING).where(mine))
        rows = [{"cell_id": self.cell_id, "key": key, "value": value} for key, value in settings.items()]
        if rows:
            connection.execute(sa.insert(SETTING), rows)

    def peers_settings(self) -> dict[str, dict[str, str]]:
        """Return the settings of the product's other cells, by cell."""
        with self.database.reading() as connection:
            return self._peers_of(connection)

    def _peers_of(self, connection: sa.Connection) -> dict[str, dict[str, str]]:
        peers = self._scope.cells(connection)[1:]
        return {name: held for name in peers if (held := held_settings(connection, name))}

    # Decisions

    def flush(self) -> None:
        """Return when all that is on its way into it is there, as far as it comes in time."""
        self.database.check_open()
        self.before_use()

    def get_decision(self, decision_id: str, trace: bool = True) -> StoredDecision | None:
        """Return the decision; None where it is unknown.

        trace : with it; StoreError where it is not as it was stored.
        """
        query = past_query(self.cell_id).where(DECISION.c.id == decision_id)
        rows = self._read(query.add_columns(*TRACE.c).outerjoin(TRACE, TRACE_OF_DECISION) if trace else query)
        if not rows:
            return None
        if trace and not is_sound(TRACE.name, dict(zip(TRACE.c.keys(), rows[0][-len(TRACE.c) :], strict=True))):
            where = f"as it was stored in {self.database.name}, its bytes have changed"
            do = "see `dengine verify`, and restore the store from a copy"
            raise StoreError(f"Expected the trace of decision {decision_id!r} {where}; {do}.")
        return read_decision(rows[0])

    def decision_ids(self) -> Iterator[Sequence[str]]:
        """Yield the ids of every decision, in any order and in pieces, so that others have their turns."""
        query = sa.select(DECISION.c.id).where(DECISION.c.cell_id == self.cell_id)
        with self.database.reading() as connection:
            yield from connection.execute(query.execution_options(yield_per=CHUNK)).scalars().partitions()

    # Training

    def labelled(
        self,
        limit: int | None = None,
        *,
        first: int = 1,
        last: int | None = None,
        corrected_to: int | None = None,
        cell_only: bool = False,
    ) -> Labelled:
        """Return the newest `limit` labelled traces, all where it is None, with their labels as they count.

        first, last : sequence numbers between which they lie.
        corrected_to : number of the last correction that counts, for labels as they stood then; None: all do.
        cell_only : of this cell alone, where others share its product.
        A trace that is not as it was stored is left out; an event names its decision.
        """
        scope = Scope(self.cell_id) if cell_only else self._scope
        query = training_query(scope, corrected_to).order_by(LABEL.c.seq.desc()).limit(limit)
        query = query if first <= 1 else query.where(LABEL.c.seq >= int(first))
        query = query if last is None else query.where(LABEL.c.seq <= last)
        with self.database.reading() as connection:
            rows = self._newest(connection, query, limit, last)[::-1]
            found, damaged = self._with_traces(connection, rows, scope)
        self._tell_of(damaged, "trace")
        return found

    def _newest(
        self, connection: sa.Connection, query: sa.Select[Any], limit: int | None, last: int | None
    ) -> Sequence[Any]:
        """The newest labels, newest first. Of a product: by their numbers, or all would be read to be sorted."""
        if self.product is not None and limit is not None:
            newest = self._scope.newest(connection, LABEL.c.seq)
            newest = newest if last is None else min(newest, last)
            rows = connection.execute(query.where(LABEL.c.seq > newest - 2 * limit)).all()
            if len(rows) == limit or newest <= 2 * limit:
                return rows
        return connection.execute(query).all()  # more than every second is quarantined or forgotten

    def news_since(self, seq: int, limit: int) -> News:
        """Return the labels after `seq`, at most `limit`, and the numbers of the newest version and correction."""
        query = training_query(self._scope).where(LABEL.c.seq > int(seq)).order_by(LABEL.c.seq).limit(limit)
        with self.database.reading() as connection:
            found, damaged = self._with_traces(connection, connection.execute(query).all(), self._scope)
            version = self._scope.newest_version(connection)
            correction = self._scope.newest(connection, CORRECTION.c.number)
        self._tell_of(damaged, "trace")
        return News(found, version, correction)

    def _with_traces(self, connection: sa.Connection, rows: Sequence[Any], scope: Scope) -> tuple[Labelled, list[str]]:
        """Labels, oldest first, with their traces, read one by one; and the decisions whose traces have changed."""
        at = {row.seq: i for i, row in enumerate(rows)}  # the forgotten are not among them
        traces, kept = np.zeros((0, 0, 0), dtype=np.float32), np.zeros(len(rows), dtype=bool)
        same = (TRACE.c.cell_id == LABEL.c.cell_id) & (TRACE.c.decision_id == LABEL.c.decision_id)
        query = sa.select(*TRACE.c, LABEL.c.seq).select_from(LABEL.join(TRACE, same)).order_by(LABEL.c.seq)
        query = query.where(scope.shared(LABEL.c.cell_id), LABEL.c.quarantined == sa.false())
        query = query.where(LABEL.c.seq.between(*((rows[0].seq, rows[-1].seq) if rows else (1, 0))))
        names = TRACE.c.keys()
        for *values, seq in connection.execute(query.execution_options(yield_per=CHUNK)):
            row = dict(zip(names, values, strict=True))
            if seq not in at or not is_sound(TRACE.name, row):
                continue
            shape = row["channels"], row["samples"]
            if not len(traces):
                traces = np.empty((len(rows), *shape), dtype=np.float32)
            if shape != traces.shape[1:]:
                shapes = sorted({traces.shape[1:], shape})
                raise StoreError(f"Expected one shape in a cell's store, found {shapes}; give each kind its own cell_id.")
            traces[at[seq]], kept[at[seq]] = unpack(row["data"]).reshape(shape), True
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

    def _tell_of(self, damaged: Sequence[str], what: str) -> None:
        """Damage that was read is an event, once that transaction is over."""
        if damaged:
            named = f"decision {listed(damaged)}; see dengine verify"
            self._note("damaged", f"left out, since the {what} is not as it was stored: {named}")

    # What became of decisions

    def outcomes_since(self, seq: int, since_version: int = 0, overdue_to: int = 0) -> list[OutcomeRecord]:
        """Return what a rule is told of the labels after number `seq`, in their order, of this cell alone.

        It is not told of rejected parts, of which those come back that somebody chose.
        overdue_to : number of the newest decision whose check is overdue. Overdue checks are inserted where the running
            engine told the rule of them; every later label stores that position.
        Only this cell's labels count: evidence from other cells certifies nothing here, and a watch that counts it would
        notice too late that this cell has changed.
        """
        label = counted()
        novel = DECISION.c.reason == Reason.NOVEL.value
        of = (LABEL.c.seq, *DECISION.c["lower", "upper"], label == 1, novel, LABEL.c.silent, *audit_columns())
        # A label that does not know came right after its decision, as most do.
        known_overdue = sa.func.coalesce(LABEL.c.overdue_to, DECISION.c.number)
        mine = (LABEL.c.cell_id == self.cell_id) & (LABEL.c.quarantined == sa.false()) & (LABEL.c.seq > int(seq))
        mine &= LABEL.c.source != Source.INSPECTION.value
        query = sa.select(*of, known_overdue).select_from(LABEL.join(DECISION, LABEL_OF_DECISION))
        query = query.where(mine, label != FORGOTTEN, DECISION.c.model_version >= since_version)
        rows = self._read(query.order_by(LABEL.c.seq))
        overdue = deque(each for each in self.pending_decisions(since_version) if each.number <= overdue_to) if overdue_to else deque()
        told: list[OutcomeRecord] = []
        for *values, known in rows:
            while overdue and overdue[0].number <= known:
                told += overdue_outcomes(overdue.popleft().decision)
            told.append(OutcomeRecord(*values))
        return told + [each for owed in overdue for each in overdue_outcomes(owed.decision)]

    def unreported_accepts(self, since_version: int = 0) -> list[str]:
        """Return the ids of accepted decisions without a label, oldest first, without the quarantined ones."""
        return [row.id for row in self._read(self._unheard_of(Action.ACCEPT, since_version, DECISION.c.id))]

    def pending_decisions(self, since_version: int = 0) -> list[StoredDecision]:
        """Return the decisions whose checks were not reported, oldest first."""
        return [read_decision(row) for row in self._read(self._unheard_of(Action.VERIFY, since_version, *DECISION.c))]

    def overdue_to(self, within: int, since_version: int = 0) -> int:
        """Return the number of the newest decision whose check is overdue, as far as the labels and the decisions tell.

        within : decisions after which it is.  since_version : the first version since `within` is in force.
        """
        newest = sa.select(DECISION.c.number, DECISION.c.model_version).where(DECISION.c.cell_id == self.cell_id)
        last = self._read(newest.order_by(DECISION.c.number.desc()).limit(1))
        of_labels = sa.select(sa.func.max(LABEL.c.overdue_to)).where(LABEL.c.cell_id == self.cell_id)
        known = self._read(of_labels)[0][0] or 0
        counted_since = bool(last) and last[0].model_version >= since_version
        return max(known, last[0].number - within) if counted_since else known

    def n_decisions(self) -> int:
        """Return the number of the newest decision; 0 before the first."""
        return self._read(sa.select(n_decisions(self.cell_id)))[0][0] or 0

    def _unheard_of(self, action: Action, since_version: int, *columns: Any) -> sa.Select[Any]:
        query = sa.select(*columns).select_from(WITH_LABELS).where(DECISION.c.action == action.value, LABEL.c.seq.is_(None))
        query = query.where(DECISION.c.cell_id == self.cell_id, DECISION.c.quarantined == sa.false())
        return query.where(DECISION.c.model_version >= since_version).order_by(DECISION.c.number)

    def silent_total(self, since_version: int = 0) -> int:
        """Return how many accepted parts went on unheard of: `silent` over all labels but the quarantined ones."""
        query = sa.select(sa.func.coalesce(sa.func.sum(LABEL.c.silent), 0))
        mine = (LABEL.c.cell_id == self.cell_id) & (LABEL.c.quarantined == sa.false())
        return int(self._read(query.where(mine, LABEL.c.model_version >= since_version))[0][0])

    def status(self) -> dict[str, Any]:
        """Count decisions and labels, by what they are. Of retrains tells `versions`, of events `events`."""
        every = self.tally()
        actions, reasons = every.by("action"), every.by("reason")
        sources: Counter[Any] = Counter()
        for group in every.groups:
            sources[group.source] += group.n if group.success is not None else 0
        forgotten = every.by("label")["forgotten"]
        corrected = sa.select(sa.func.count(CORRECTION.c.decision_id.distinct()))
        return {
            "decisions": every.count(),
            "actions": {action.value: actions[action] for action in Action},
            "reasons": {reason.value: reasons[reason] for reason in Reason},
            "quarantined": every.by("quarantined")[True],
            "labels": sources.total(),
            "sources": {source.value: sources[source] for source in Source},
            "corrected": self._read(corrected.where(CORRECTION.c.cell_id == self.cell_id))[0][0] - forgotten,
            "forgotten": forgotten,
        }

    # Model versions

    def put_version(self, report: RetrainReport, last_seq: int, state: Mapping[str, NDArray[Any]] | None) -> int:
        """Record a retrain; a dropped candidate has no state. Returns the version's number.

        That is the report's, but where cells share versions and a peer's was stored meanwhile: then the next.
        """
        given = report, last_seq, check_state(report, state), float(self.clock())
        if self.wait is None and self.product is None:
            self._trained.append(given)
            if len(self._trained) == MOST_TRAINED:
                self._write_trained()
            return report.version
        return self._put_trained(*given)

    def _put_trained(self, *given: Any) -> int:
        row = self._version_row(*given)
        return self.database.write(lambda connection: self._add_version(connection, row), settled=False)

    def _write_trained(self) -> None:
        trained, self._trained = self._trained, []
        for given in trained:
            self._put_trained(*given)

    def _version_row(
        self, report: RetrainReport, last_seq: int, state: Mapping[str, NDArray[Any]] | None, now: float
    ) -> dict[str, Any]:
        arrays = check_state(report, state)
        blob = None if arrays is None else to_npz(arrays)
        return {"time": now, "last_seq": int(last_seq), "state": blob, "state_sum": state_sum(blob)} | to_row(report)

    def _add_version(self, connection: sa.Connection, row: dict[str, Any]) -> int:
        """Insert a version, and let go of states that `keeps_state` does not keep; returns its number."""
        number: int = row["version"]
        if self.product is not None and row["accepted"]:  # a peer's may have come before
            hold(connection, PRODUCT, self.product)
            number = max(number, self._scope.newest_version(connection) + 1)
        self.database.insert(connection, VERSION.c.retrain, [row | {"version": number}])
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
        """Return the newest accepted version; of a damaged one an event tells, and the one before it is returned."""
        for i, row in enumerate(self._read(self._accepted())):
            if not row.kept and i > 0:
                continue  # thinned out, which the newest never is
            try:
                return self._loaded(row.retrain)
            except VersionError as error:
                self._note("damaged", f"{error} The accepted version before it answers.")
        return None

    def load_version(self, version: int) -> ModelVersion:
        """Return an accepted version by its number. VersionError, naming those that can be loaded, where it cannot."""
        held = {row.version: row.retrain for row in reversed(self._read(self._accepted())) if row.kept}
        if version not in held:
            others = ", ".join(map(str, held)) or "none"
            raise VersionError(f"Expected a held version, got {version}, which is not kept; load one of these: {others}.")
        return self._loaded(held[version])

    def _loaded(self, retrain: int) -> ModelVersion:
        query = sa.select(*VERSION.c["cell_id", "version", "last_seq", "state", "state_sum"])
        mine = self._scope.shared(VERSION.c.cell_id) & (VERSION.c.retrain == retrain)
        row = self._read(query.where(mine))[0]
        if row.state is None or (row.state_sum is not None and state_sum(row.state) != row.state_sum):
            where = f"as it was stored in {self.database.name}, its bytes have changed"
            raise VersionError(f"Expected the state of version {row.version} {where}; restore the store from a copy.")
        with instead(VersionError, f"Version {row.version} cannot be read", StoreError):
            state = from_npz(row.state, self.database.name)
        if row.cell_id != self.cell_id:  # what a peer's parts taught its rule says nothing certain of this cell
            state = without_rule(state) | {"rule_last_seq": np.array(0)}
        return ModelVersion(row.version, row.last_seq, state)

    def versions(self, cell_only: bool = False) -> list[StoredVersion]:
        """Return every retrain, oldest first: its number, time, report, and whether its state is kept.

        cell_only : this cell's alone.
        """
        kept = VERSION.c.state.is_not(None).label("kept")
        n_bytes = sa.func.coalesce(sa.func.length(VERSION.c.state), 0).label("n_bytes")
        query = sa.select(*(c for c in VERSION.c if c.name != "state"), VERSION.c.retrain.label("number"), n_bytes, kept)
        scope = Scope(self.cell_id) if cell_only else self._scope
        rows = self._read(query.where(scope.shared(VERSION.c.cell_id)).order_by(VERSION.c.retrain))
        return [from_row(StoredVersion, row._mapping, report=from_row(RetrainReport, row._mapping)) for row in rows]

    def retrains(self) -> list[RetrainReport]:
        """Return every retrain, oldest first."""
        return [each.report for each in self.versions()]

    # Events and corrections

    def put_event(self, kind: str, text: str, data: Mapping[str, Any] | None = None, author: str = "") -> None:
        """Commit what happened, in a word and for people to read, to the cell's log.

        data : the same for machines, as JSON has it.  author : who did it; "" for the engine itself.
        """
        self.record(Change(kind, text, data, author))

    def _note(self, kind: str, text: str) -> None:
        """Commit an event, unless one of these very words is there."""
        said = (EVENT.c.cell_id == self.cell_id) & (EVENT.c.kind == as_text(kind)) & (EVENT.c.text == as_text(text))
        if not self._read(sa.select(EVENT.c.number).where(said).limit(1)):
            self.put_event(kind, text)

    def events(self, limit: int | None = None) -> list[Event]:
        """Return the newest `limit` events, all where it is None; oldest first."""
        query = sa.select(EVENT).where(EVENT.c.cell_id == self.cell_id).order_by(EVENT.c.number.desc()).limit(limit)
        return [from_row(Event, row._mapping) for row in self._read(query)[::-1]]

    def policy_change_after(self, decision_id: str) -> Event | None:
        """Return the first change of the policy after a decision, whatever the clock said; None: there was none."""
        mine = (DECISION.c.cell_id == self.cell_id) & (DECISION.c.id == decision_id)
        decided = sa.select(DECISION.c.entry).where(mine).scalar_subquery()  # entries of the ledger are in their order
        kinds = EVENT.c.kind.in_((POLICY_CHANGED, SHADOW_CHANGED)) & EVENT.c.data.is_not(None)
        query = sa.select(EVENT).where(EVENT.c.cell_id == self.cell_id, kinds, EVENT.c.entry > decided)
        rows = self._read(query.order_by(EVENT.c.number).limit(1))
        return from_row(Event, rows[0]._mapping) if rows else None

    def record(self, change: Change) -> int:
        """Commit what a person changed, all or none, together with its event; returns the event's number.

        Raises ReportError for a decision that is unknown or has no label.
        """
        now, author = float(self.clock()), as_text(change.author)
        said = Event(0, now, as_text(change.kind), as_text(change.text), as_data(change.data), author)
        version = None if change.version is None else self._version_row(*change.version, now)

        def add(connection: sa.Connection) -> int:
            (number,) = self.database.insert(connection, EVENT.c.number, [to_row(said)])
            if change.decisions:
                self._correct(connection, change, {"author": author, "event": number, "time": now})
            if version is not None and (stored := self._add_version(connection, version)) != version["version"]:
                wanted = f"version {version['version']} to be the next"
                raise StoreError(f"Expected {wanted}, a peer of the product stored {stored - 1} meanwhile; try it again.")
            if change.settings is not None:
                self._settle(connection, change.settings)
            return number

        return self.database.write(add)

    def _correct(self, connection: sa.Connection, change: Change, event: Mapping[str, Any]) -> None:
        held = self.database.held(connection, change.decisions)
        for name in change.decisions:
            if name not in held:
                raise unknown_decision(name)
            if held[name].counted is None:
                raise nothing_to_correct(name)
        counts = {0: False, 1: True, FORGOTTEN: None}
        was = {name: counts[held[name].counted] for name in change.decisions}
        said = {**event, "success": change.success}
        self.database.correct(connection, [said | {"decision_id": name, "was": label} for name, label in was.items()])

    def corrections(self, after: int = 0) -> list[Correction]:
        """Return the corrections after number `after`, oldest first."""
        same = (LABEL.c.cell_id == CORRECTION.c.cell_id) & (LABEL.c.decision_id == CORRECTION.c.decision_id)
        query = sa.select(*CORRECTION.c, LABEL.c.seq).select_from(CORRECTION.join(LABEL, same))
        query = query.where(self._scope.shared(CORRECTION.c.cell_id), CORRECTION.c.number > int(after))
        return [from_row(Correction, row._mapping) for row in self._read(query.order_by(CORRECTION.c.number))]

    # Looking back

    def decisions(
        self, where: HistoryFilter, limit: int, beyond: str | None = None, newest: bool = True
    ) -> list[StoredDecision]:
        """Return the newest (or oldest) `limit` decisions that are meant, oldest first.

        beyond : only those before (or after) the one of this id: the next page. Their order is that of the decisions,
        whatever the clock said.
        """
        asked = ((column, getattr(where, column.name)) for column in DECISION.c["action", "predicted", "reason", "part"])
        meant = [column == str(wanted) for column, wanted in asked if wanted is not None]
        if where.label is not None:
            label = LABELS[where.label]
            meant.append(SAID.is_(None) if label is None else SAID.in_([int(label)]))
        if where.since is not None:
            meant.append(DECISION.c.time >= where.since)
        if where.until is not None:
            meant.append(DECISION.c.time < where.until)
        number = DECISION.c.number
        if beyond is not None:
            one = DECISION.alias("beyond")
            there = sa.select(one.c.number).where(one.c.cell_id == self.cell_id, one.c.id == beyond).scalar_subquery()
            meant.append(number < there if newest else number > there)
        query = past_query(self.cell_id).where(*meant).order_by(number.desc() if newest else number)
        rows = self._read(query.limit(limit))
        return [read_decision(row) for row in (rows[::-1] if newest else rows)]

    def past_labels(self, after: int, upto: int | None = None) -> list[PastLabel]:
        """Return the labels after number `after`, up to `upto`, oldest first.

        One that is not as it was stored is left out; an event names its decision.
        """
        query = sa.select(*LABEL.c, *DECISION.c["lower", "upper", "reason"], *audit_columns())
        query = query.select_from(LABEL.join(DECISION, LABEL_OF_DECISION))
        query = query.where(LABEL.c.cell_id == self.cell_id, LABEL.c.seq > int(after)).order_by(LABEL.c.seq)
        rows = self._read(query if upto is None else query.where(LABEL.c.seq <= upto))
        names = LABEL.c.keys()
        damaged = {row.decision_id for row in rows if not is_sound(LABEL.name, dict(zip(names, row, strict=False)))}
        self._tell_of(sorted(damaged), "label")
        rows = [row for row in rows if row.decision_id not in damaged]
        return [from_row(PastLabel, row._mapping, novel=row.reason == Reason.NOVEL) for row in rows]

    def tally(self, last: int | None = None, since_version: int = 0, within: int | None = None) -> Tally:
        """Count the newest `last` decisions, all where it is None; since_version : by versions from that one on.

        within : decisions after which one that asked for a check, and got none, is overdue; None: none is.
        """
        newest = n_decisions(self.cell_id)
        aged = (sa.false() if within is None else newest - DECISION.c.number >= within).label("aged")
        columns = DECISION.c["action", "predicted", "reason", "audit", "quarantined"]
        kind = (*columns, aged, SAID.label("success"), SOURCE.label("source"), sa.func.count().label("n"))
        times = sa.func.min(DECISION.c.time), sa.func.max(DECISION.c.time), sa.func.max(LABEL.c.time)
        query = sa.select(*kind, *times).select_from(WITH_LABELS).group_by(*columns, "aged", SAID, SOURCE)
        query = query.where(DECISION.c.cell_id == self.cell_id, DECISION.c.model_version >= since_version)
        rows = self._read(query if last is None else query.where(DECISION.c.number > newest - last))
        first, latest, label = ([row[i] for row in rows if row[i] is not None] for i in (-3, -2, -1))
        groups = tuple(from_row(DecisionGroup, row._mapping) for row in rows)
        return Tally(groups, min(first, default=None), max(latest, default=None), max(label, default=None))

    def stretches(self, n: int = 1, **by: Any) -> list[Stretch]:
        """Cut all decisions into `n` stretches of one length at most, oldest first; the newest may be shorter.

        by : of time, or of batches, instead: as of `stretches_query`.
        """
        every = self._read(sa.select(sa.func.count()).where(DECISION.c.cell_id == self.cell_id))[0][0]
        rows = self._read(stretches_query(self.cell_id, max(1, -(-int(every) // n)), **by))
        return [Stretch(*row) for row in rows]

    # The one engine that owns the cell

    def claim_cell(self) -> Journal | None:
        """Claim the cell for one engine; its journal, None where there is none. StoreError where another engine has it."""
        if self.wait is None:
            return None
        in_file = self.database.url.get_backend_name() == "sqlite"
        if in_file:
            self.database.check_writable()
        journal = Journal(journal_path(self.database.url, self.cell_id))
        try:
            if not in_file:
                self.database.acquire_lease()
        except StoreError:
            journal.close()
            raise
        self._journal = journal
        return journal

    def apply_records(self, records: Sequence[Record]) -> list[tuple[str, int]]:
        """Commit what a journal holds, all or none; returns the numbers of its labels by their decisions.

        What is there already, and is the same, counts as taken. Another decision of the same id, a label on that, or a
        second label becomes an event, "dead letter": it is never guessed which one is right.
        """
        if self.wait is not None:
            return self.database.apply_records(records)
        numbers: list[tuple[str, int]] = []
        for each in records:
            if isinstance(each, StoredDecision) and each.decision.id not in self._held:
                self._held[each.decision.id] = False
            elif isinstance(each, NewLabel) and self._held.get(each.decision_id) is False:
                numbers.append((each.decision_id, self._labels + len(numbers) + 1))  # nobody else gives any
                self._held[each.decision_id] = True
            elif not isinstance(each, Event):  # what is there already, or contradicts it
                numbers = self.database.apply_records(records)
                self._held |= dict.fromkeys((name for name, _ in numbers), True)
                break
        else:
            self._waiting += records
        for _, number in numbers:
            self._labels = max(self._labels, number)
        return numbers

    def _write_waiting(self) -> None:
        """Write what was taken in memory: a replay, which reads nothing, never does."""
        self._write_trained()
        waiting, self._waiting = self._waiting, []
        for part in chunks(waiting):
            self.database.apply_records(part)

    def close(self) -> None:
        """Disconnect."""
        if self.wait is not None:  # what is in memory lives as long as its store
            self.database.close()
        if self._journal is not None:
            self._journal.close()

    def __exit__(self, *exception: object) -> None:
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
