"""`SqlStore`, an engine's memory in a database: SQLite in a file, or PostgreSQL for a fleet. The
class reads and writes the settings, decisions, labelled traces, outcomes, model versions, events
and corrections of one cell; the engine, the history and the command line use it.

    store = SqlStore("engine.db", cell_id="cell-7")
    store = SqlStore("postgresql+psycopg://user:password@host/database", cell_id="cell-7")

When a call that writes returns, its rows are committed, and survive a power failure if the disk
keeps what it synced. The decisions and labels of a running engine do not come in by these calls:
they go into the journal first, and from there, by `apply_records`, into the database.
"""

import logging
import math
import os
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from typing import Any

import numpy as np
import sqlalchemy as sa
from numpy.typing import NDArray

from ..errors import StoreError, expect, instead, listed
from ..records import Action, Reason, RetrainReport, Source
from .connections import Database
from .journal import Journal, Record, journal_path
from .ledger import is_intact, read_settings, state_sum
from .peers import check_peer_settings
from .queries import (
    CORRECTION_OF_LABEL,
    LABEL_OF_DECISION,
    SOURCE,
    SUCCESS,
    TRACE_OF_DECISION,
    TRAINS,
    WITH_LABELS,
    Scope,
    audit_columns,
    corrected_label,
    n_decisions,
    past_query,
    stretches_query,
    training_query,
)
from .records import (
    ACKNOWLEDGED,
    CHUNK,
    FORGOTTEN,
    KEEP,
    POLICY_CHANGED,
    SHADOW_CHANGED,
    Change,
    Correction,
    Event,
    LabelledTraces,
    ModelVersion,
    OutcomeRecord,
    ProductNews,
    StoredDecision,
    StoredVersion,
    VersionError,
    as_data,
    as_text,
    check_state,
    from_npz,
    from_row,
    keeps_state,
    nothing_to_correct,
    open_losses,
    overdue_outcomes,
    read_decision,
    to_npz,
    to_row,
    unknown_decision,
    unpack,
    without_rule,
)
from .schema import (
    CORRECTION,
    DECISION,
    EVENT,
    LABEL,
    PRODUCT,
    RESERVED,
    SETTING,
    TRACE,
    VERSION,
    lock,
)
from .views import LABELS, DecisionGroup, HistoryFilter, PastLabel, Stretch, Tally

log = logging.getLogger("dengine")
WAIT = 0.4  # seconds that an engine waits for its disk and for the database
# Of the environment: seconds for all stores that are given none.
WAIT_VARIABLE = "DENGINE_STORE_WAIT"


class SqlStore(AbstractContextManager["SqlStore"]):
    """An engine's memory in a database: settings, decisions, labels, versions, events of one cell.

    Parameters
    ----------
    url : str or None
        A file (SQLite), or an SQLAlchemy URL of SQLite or PostgreSQL. None: SQLite in memory, for
        replays and trials; such a store stays open after `close`, and is used by one thread at a
        time.
    cell_id : str, default "cell"
        Whose rows these are. Several cells share one database without seeing each other.
    clock : callable
        Returns the time, in seconds since 1970, with which rows are stamped.
    product : str or None
        What the cell makes. None: as the store says of a known cell; a new one shares nothing.
        Cells of one product share labelled traces for training, versions and corrections
        (`labelled`, `last_version`, `versions`, `retrains`, `corrections`) and their numbers.
        Decisions and their outcomes stay the cell's own.
    wait : float or None
        Seconds that an engine waits for the disk and the database at most. None: the environment's
        DENGINE_STORE_WAIT, or 0.4.
    keep_versions : int or None
        Number of newest model versions that keep their states, beside the first and a few older
        ones (`keeps_state`). None: all. A retrain itself stays listed for ever.

    Attributes
    ----------
    database : Database

    Raises
    ------
    StoreError
        For a setting that is not valid, and as of `Database`. Every method raises it if the
        database fails.

    Notes
    -----
    SQLite runs in WAL mode with synchronous=FULL; WAL needs a local disk, no network drive. Two
    processes may open one cell, and the numbers of labels stay unique and increasing. An engine
    owns its cell (`claim_cell`): a second engine is refused.
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
        expect(
            bool(cell_id),
            "a cell_id that names the cell",
            cell_id,
            "use for example 'cell'",
            StoreError,
        )
        self.cell_id = cell_id
        is_valid = keep_versions is None or (type(keep_versions) is int and keep_versions >= 2)
        expect(
            is_valid,
            "keep_versions of 2 or more, or None for all",
            keep_versions,
            f"leave it at {KEEP}",
            StoreError,
        )
        self.keep_versions = keep_versions
        self.wait = _checked_wait(wait)
        self.clock = clock
        self.database = Database(url if url is None else str(url), cell_id, clock, product)
        self._read = self.database.read
        self._scope = self.database.scope
        self.product = self._scope.product
        self._journal: Journal | None = None

    def _own(self, table: sa.FromClause) -> sa.ColumnElement[bool]:
        """Return the SQL condition that a row of a table is this cell's."""
        return table.c.cell_id == self.cell_id

    # Settings

    def settings(self) -> dict[str, str]:
        """Return the settings that were saved last, by key; {} for a new store."""
        with self.database.reading() as connection:
            return read_settings(connection, self.cell_id)

    def save_settings(self, settings: Mapping[str, str]) -> None:
        """Commit new settings in the place of all present ones.

        Raise SettingError if a peer's contradict them, and StoreError for a key that the store
        itself keeps (`RESERVED`); then nothing is changed.
        """
        self.database.write(lambda connection: self._replace_settings(connection, settings))

    def _replace_settings(self, connection: sa.Connection, settings: Mapping[str, str]) -> None:
        """Replace the engine's settings of the cell in a transaction; the store's own stay.

        Raise StoreError for a setting that is the store's own (`RESERVED`), and SettingError if a
        peer of the product would embed traces differently. The product stays locked until the
        commit.
        """
        for key in sorted(settings.keys() & set(RESERVED)):
            raise StoreError(
                f"Expected settings of the engine, got {key!r}, which is the store's; rename it."
            )
        if self.product is not None:
            lock(connection, PRODUCT, self.product)
            for name, peer_settings in self._read_peers(connection).items():
                check_peer_settings(settings, peer_settings, name, self.product)
        is_replaced = self._own(SETTING) & SETTING.c.key.not_in(RESERVED)
        connection.execute(sa.delete(SETTING).where(is_replaced))
        rows = [
            {"cell_id": self.cell_id, "key": key, "value": value} for key, value in settings.items()
        ]
        if rows:
            connection.execute(sa.insert(SETTING), rows)

    def peers_settings(self) -> dict[str, dict[str, str]]:
        """Return the settings of the product's other cells, by cell; {} without a product.

        A cell without settings is left out.
        """
        with self.database.reading() as connection:
            return self._read_peers(connection)

    def _read_peers(self, connection: sa.Connection) -> dict[str, dict[str, str]]:
        """Return the settings of the product's other cells, by cell, of those that have some."""
        peers = self._scope.cells(connection)[1:]
        return {name: settings for name in peers if (settings := read_settings(connection, name))}

    # Decisions

    def flush(self) -> None:
        """Wait until the outbox's records are in the database, at most its time limit.

        Nothing is raised if the database does not answer; StoreError only if the store is closed.
        """
        self.database.check_open()
        self.database.before_use()

    def get_decision(self, decision_id: str, trace: bool = True) -> StoredDecision | None:
        """Return a decision with its label after corrections.

        Parameters
        ----------
        decision_id : str
        trace : bool, default True
            Read its trace, too. False: its trace has shape (0, 0).

        Returns
        -------
        StoredDecision or None
            None for an unknown id.

        Raises
        ------
        StoreError
            If the trace is not as it was stored.
        """
        query = past_query(self.cell_id).where(DECISION.c.id == decision_id)
        rows = self._read(
            query.add_columns(*TRACE.c).outerjoin(TRACE, TRACE_OF_DECISION) if trace else query
        )
        if not rows:
            return None
        if trace and not is_intact(TRACE, rows[0][-len(TRACE.c) :]):
            where = f"as it was stored in {self.database.name}, its bytes have changed"
            do = "see `dengine verify`, and restore the store from a copy"
            raise StoreError(f"Expected the trace of decision {decision_id!r} {where}; {do}.")
        return read_decision(rows[0])

    def decision_ids(self) -> Iterator[Sequence[str]]:
        """Yield the ids of all decisions of the cell, in any order, in lists of at most CHUNK.

        A read transaction stays open meanwhile.
        """
        query = sa.select(DECISION.c.id).where(self._own(DECISION))
        with self.database.reading() as connection:
            yield from (
                connection.execute(query.execution_options(yield_per=CHUNK)).scalars().partitions()
            )

    # Training

    def labelled(
        self,
        limit: int | None = None,
        *,
        first: int = 1,
        last: int | None = None,
        corrected_to: int | None = None,
        cell_only: bool = False,
    ) -> LabelledTraces:
        """Return labelled traces for training, with corrected labels, oldest first.

        Forgotten labels and quarantined traces are left out. So is a trace that is not as it was
        stored, and an event with its decision's id is written to the store.

        Parameters
        ----------
        limit : int or None
            Number of newest labels, damaged ones included; None: all.
        first, last : int, optional
            Numbers of the first and the last label, both included.
        corrected_to : int or None
            Number of the last correction that is applied, for labels as they stood then; None: all.
        cell_only : bool, default False
            Leave out those of the product's other cells.

        Returns
        -------
        LabelledTraces

        Raises
        ------
        StoreError
            If the traces have different shapes, or a label is not 0 or 1; other damage of a label
            is not noticed here.
        """
        scope = Scope(self.cell_id) if cell_only else self._scope
        query = training_query(scope, corrected_to).order_by(LABEL.c.seq.desc()).limit(limit)
        query = query if first <= 1 else query.where(LABEL.c.seq >= int(first))
        query = query if last is None else query.where(LABEL.c.seq <= last)
        with self.database.reading() as connection:
            rows = self._read_newest(connection, query, limit, last)[::-1]
            labelled, damaged = self._with_traces(connection, rows, scope)
        self._record_left_out(damaged, "trace")
        return labelled

    def _read_newest(
        self, connection: sa.Connection, query: sa.Select[Any], limit: int | None, last: int | None
    ) -> Sequence[Any]:
        """Run a query for the newest `limit` labels up to number `last`; return rows, newest first.

        The query itself has this limit, order and condition. Of a product only labels with high
        numbers are read at first, or all would be sorted; if these are too few, the query runs over
        all.
        """
        if self.product is not None and limit is not None:
            newest = self._scope.newest(connection, LABEL.c.seq)
            newest = newest if last is None else min(newest, last)
            rows = connection.execute(query.where(LABEL.c.seq > newest - 2 * limit)).all()
            if len(rows) == limit or newest <= 2 * limit:
                return rows
        return connection.execute(query).all()  # here more than half are quarantined or forgotten

    def news_since(self, seq: int, limit: int) -> ProductNews:
        """Return what the cells of the product, this one included, stored after label number `seq`.

        Only labels that train are returned, none that was forgotten or of a quarantined trace, with
        the numbers of the newest version and correction. A trace that is not as it was stored is
        left out, and an event is written to the store.

        Parameters
        ----------
        seq : int
        limit : int
            Number of labels at most; the oldest are returned.

        Returns
        -------
        ProductNews

        Raises
        ------
        StoreError
            If the traces have different shapes, or a label is not 0 or 1; other damage of a label
            is not noticed here.
        """
        query = (
            training_query(self._scope)
            .where(LABEL.c.seq > int(seq))
            .order_by(LABEL.c.seq)
            .limit(limit)
        )
        with self.database.reading() as connection:
            labelled, damaged = self._with_traces(
                connection, connection.execute(query).all(), self._scope
            )
            version = self._scope.newest_version(connection)
            correction = self._scope.newest(connection, CORRECTION.c.number)
        self._record_left_out(damaged, "trace")
        return ProductNews(labelled, version, correction)

    def _with_traces(
        self, connection: sa.Connection, rows: Sequence[Any], scope: Scope
    ) -> tuple[LabelledTraces, list[str]]:
        """Read the traces of label rows, which are sorted by number, oldest first.

        Return the labelled traces in this order, and the ids of decisions whose traces are missing
        or not as they were stored; these are left out. Raise StoreError if traces have different
        shapes, or a label is not 0 or 1.
        """
        labels = {row.seq: row for row in rows}  # the forgotten are not among them
        traces: dict[int, NDArray[np.float32]] = {}
        is_of_label = (TRACE.c.cell_id == LABEL.c.cell_id) & (
            TRACE.c.decision_id == LABEL.c.decision_id
        )
        query = sa.select(*TRACE.c, LABEL.c.seq).select_from(LABEL.join(TRACE, is_of_label))
        query = query.where(scope.shared(LABEL.c.cell_id), TRAINS)
        first, last = (rows[0].seq, rows[-1].seq) if rows else (1, 0)
        query = query.where(LABEL.c.seq.between(first, last)).order_by(LABEL.c.seq)
        for row in connection.execute(query.execution_options(yield_per=CHUNK)):
            if row.seq in labels and is_intact(TRACE, row):
                traces[row.seq] = unpack(row.data).reshape(row.channels, row.samples)
        shapes = sorted({trace.shape for trace in traces.values()})
        if len(shapes) > 1:
            raise StoreError(
                f"Expected one shape in a cell's store, found {shapes}; give each kind its own "
                "cell_id."
            )
        if not all(row.success in (0, 1) for row in rows):
            raise StoreError(
                "Expected labels that are True or False, found another: the store is damaged; "
                "restore a copy."
            )
        kept = [labels[seq] for seq in traces]
        labelled = LabelledTraces(
            seq=np.array([row.seq for row in kept], dtype=np.int64),
            traces=np.stack([*traces.values()]) if traces else np.zeros((0, 0, 0), np.float32),
            labels=np.array([row.success for row in kept], dtype=np.int8),
            hashes=np.array([row.content_hash for row in kept], dtype=np.int64),
        )
        return labelled, [row.decision_id for row in rows if row.seq not in traces]

    def _record_left_out(self, damaged: Sequence[str], part: str) -> None:
        """Record as damage that the trace or label of some decisions was left out.

        `damaged` has the decisions' ids, and `part` is "trace" or "label". Nothing happens without
        decisions.
        """
        if damaged:
            names = f"decision {listed(damaged)}; see dengine verify"
            self._record_damage(f"left out, since the {part} is not as it was stored: {names}")

    # Outcomes

    def outcomes_since(
        self, seq: int, since_version: int = 0, overdue_to: int = 0
    ) -> list[OutcomeRecord]:
        """Return the outcomes with which a rule is updated, as corrected, in the labels' order.

        Left out are labels of rejected parts, since which of them come back is somebody's choice
        (`Source.INSPECTION`), forgotten labels, and those of quarantined traces. Only this cell's
        labels count, since those of other cells are no evidence for this one, and a detector of
        drift that counts them would notice too late that this cell has changed.

        Parameters
        ----------
        seq : int
            Outcomes of labels after this number.
        since_version : int, default 0
            Only of decisions by this version or a later one.
        overdue_to : int, default 0
            Up to this decision number a check without a label is overdue; 0: none is. An overdue
            check adds none, one or two outcomes (`overdue_outcomes`), whatever `seq` is. They are
            inserted where the running engine updated the rule with them; every later label stores
            that position.

        Returns
        -------
        list of OutcomeRecord
        """
        label = corrected_label()
        novel = DECISION.c.reason == Reason.NOVEL.value
        fields = (
            LABEL.c.seq,
            *DECISION.c["lower", "upper"],
            label == 1,
            novel,
            LABEL.c.silent,
            *audit_columns(),
        )
        # A label that does not know came right after its decision, as most do.
        known_overdue = sa.func.coalesce(LABEL.c.overdue_to, DECISION.c.number)
        query = sa.select(*fields, known_overdue).select_from(
            LABEL.join(DECISION, LABEL_OF_DECISION)
        )
        query = query.where(
            self._own(LABEL),
            TRAINS,
            LABEL.c.seq > int(seq),
            LABEL.c.source != Source.INSPECTION.value,
        )
        query = query.where(label != FORGOTTEN, DECISION.c.model_version >= since_version)
        rows = self._read(query.order_by(LABEL.c.seq))
        overdue: deque[StoredDecision] = deque()
        if overdue_to:
            pending = self.pending_decisions(since_version)
            overdue.extend(item for item in pending if item.number <= overdue_to)
        outcomes: list[OutcomeRecord] = []
        for *values, last_overdue in rows:
            while overdue and overdue[0].number <= last_overdue:
                outcomes += overdue_outcomes(overdue.popleft().decision)
            outcomes.append(OutcomeRecord(*values))
        for item in overdue:
            outcomes += overdue_outcomes(item.decision)
        return outcomes

    def unreported_accepts(self, since_version: int = 0) -> list[str]:
        """Return the ids of accepted decisions without a label, oldest first.

        Parameters
        ----------
        since_version : int, default 0
            Only decisions by this version or a later one.

        Returns
        -------
        list of str
            Those of quarantined traces are left out.
        """
        return [
            row.id
            for row in self._read(
                self._unlabelled_query(Action.ACCEPT, since_version, DECISION.c.id)
            )
        ]

    def pending_decisions(self, since_version: int = 0) -> list[StoredDecision]:
        """Return the decisions that asked for a check and have no label, oldest first.

        Parameters
        ----------
        since_version : int, default 0
            Only decisions by this version or a later one.

        Returns
        -------
        list of StoredDecision
            Without their traces; those of quarantined traces are left out.
        """
        return [
            read_decision(row)
            for row in self._read(self._unlabelled_query(Action.VERIFY, since_version, *DECISION.c))
        ]

    def overdue_to(self, within: int, since_version: int = 0) -> int:
        """Return the number of the newest decision that is old enough for its check to be overdue.

        A decision with this or a lower number that asked for a check and has no label is overdue.
        The number is that of the newest decision minus `within`, or the one that a label recorded,
        if that is larger; 0 if nothing can be overdue yet.

        Parameters
        ----------
        within : int
            Number of later decisions after which a check is overdue.
        since_version : int, default 0
            The first version since `within` is in force; if the newest decision is by an earlier
            one, only what the labels recorded counts.

        Returns
        -------
        int
        """
        newest = sa.select(DECISION.c.number, DECISION.c.model_version).where(self._own(DECISION))
        last = self._read(newest.order_by(DECISION.c.number.desc()).limit(1))
        of_labels = sa.select(sa.func.max(LABEL.c.overdue_to)).where(self._own(LABEL))
        by_labels = self._read(of_labels)[0][0] or 0
        is_in_force = bool(last) and last[0].model_version >= since_version
        return max(by_labels, last[0].number - within) if is_in_force else by_labels

    def n_decisions(self) -> int:
        """Return the number of the cell's newest decision; 0 before the first."""
        return self._read(sa.select(n_decisions(self.cell_id)))[0][0] or 0

    def newest_label(self) -> int:
        """Return the number of the newest label of the cell or its product; 0 before the first."""
        with self.database.reading() as connection:
            return self._scope.newest(connection, LABEL.c.seq)

    def _unlabelled_query(
        self, action: Action, since_version: int, *columns: Any
    ) -> sa.Select[Any]:
        """Return the query for the cell's decisions of an action that have no label, oldest first.

        Those of quarantined traces, and those by a version before `since_version`, are left out.
        """
        query = (
            sa.select(*columns)
            .select_from(WITH_LABELS)
            .where(DECISION.c.action == action.value, LABEL.c.seq.is_(None))
        )
        query = query.where(self._own(DECISION), DECISION.c.quarantined == sa.false())
        return query.where(DECISION.c.model_version >= since_version).order_by(DECISION.c.number)

    def silent_total(self, since_version: int = 0) -> int:
        """Return how many accepted parts went on without a report, as the cell's labels count them.

        Parameters
        ----------
        since_version : int, default 0
            Only labels that came under this version or a later one.

        Returns
        -------
        int
            The sum of `silent`; labels of quarantined traces are left out.
        """
        query = sa.select(sa.func.coalesce(sa.func.sum(LABEL.c.silent), 0))
        query = query.where(self._own(LABEL), TRAINS, LABEL.c.model_version >= since_version)
        return int(self._read(query)[0][0])

    def status(self, tally: Tally | None = None) -> dict[str, Any]:
        """Return counts of all decisions and labels of the cell.

        Parameters
        ----------
        tally : Tally or None
            Of all decisions of the cell, if it has been read already; None: it is read.

        Returns
        -------
        dict
            decisions, quarantined, labels: numbers; corrected, forgotten: numbers of decisions
            whose label was corrected or forgotten; actions, reasons, sources: dicts of numbers by
            value, 0 included. Forgotten labels are not among labels and sources.
        """
        tally = tally or self.tally()
        actions = tally.by("action")
        reasons = tally.by("reason")
        sources: Counter[Any] = Counter()
        for group in tally.groups:
            sources[group.source] += group.n if group.success is not None else 0
        forgotten = tally.by("label")["forgotten"]
        query = sa.select(sa.func.count(CORRECTION.c.decision_id.distinct()))
        corrected = self._read(query.where(self._own(CORRECTION)))[0][0]
        return {
            "decisions": tally.count(),
            "actions": {action.value: actions[action] for action in Action},
            "reasons": {reason.value: reasons[reason] for reason in Reason},
            "quarantined": tally.by("quarantined")[True],
            "labels": sources.total(),
            "sources": {source.value: sources[source] for source in Source},
            "corrected": corrected - forgotten,
            "forgotten": forgotten,
        }

    # Model versions

    def put_version(
        self,
        report: RetrainReport,
        last_seq: int,
        state: Mapping[str, NDArray[Any]] | None,
        time: float | None = None,
    ) -> int:
        """Commit a retrain, and delete the states of older versions that are no longer kept.

        Parameters
        ----------
        report : RetrainReport
        last_seq : int
            Number of the newest label that the retrain knew of.
        state : mapping of str to array, or None
            The version's arrays; None for a dropped candidate.
        time : float or None
            When the retrain ended, in seconds since 1970; None: now.

        Returns
        -------
        int
            The version's number. It is the report's, unless this one is accepted and a peer of the
            product stored a version meanwhile: then the next.

        Raises
        ------
        StoreError
            For an accepted version without arrays, for an array of Python objects, and if the
            database fails.
        """
        row = self._version_row(report, last_seq, state, self.clock() if time is None else time)
        return self.database.write(lambda connection: self._insert_version(connection, row))

    def _version_row(
        self,
        report: RetrainReport,
        last_seq: int,
        state: Mapping[str, NDArray[Any]] | None,
        now: float,
    ) -> dict[str, Any]:
        """Return the row of a retrain for the table `model_version`, its arrays packed as npz.

        `state` is None, or the arrays by name; `now` is in seconds since 1970. Raise StoreError for
        an accepted version without arrays, and for an array of Python objects.
        """
        arrays = check_state(report, state)
        blob = None if arrays is None else to_npz(arrays)
        return {
            "time": now,
            "last_seq": int(last_seq),
            "state": blob,
            "state_sum": state_sum(blob),
        } | to_row(report)

    def _insert_version(self, connection: sa.Connection, row: dict[str, Any]) -> int:
        """Insert the row of a retrain; return its version's number.

        For an accepted version this is the next number if a peer of the product has taken the given
        one; and states that `keeps_state` does not keep are deleted.
        """
        number: int = row["version"]
        if self.product is not None and row["accepted"]:  # a peer's may have been stored before
            lock(connection, PRODUCT, self.product)
            number = max(number, self._scope.newest_version(connection) + 1)
        if row["accepted"]:
            with_state = connection.execute(
                self._accepted_query().where(VERSION.c.state.is_not(None))
            ).all()
            dropped = [
                stored.retrain
                for stored in with_state
                if not keeps_state(stored.version, number, self.keep_versions)
            ]
            if dropped:
                is_dropped = self._scope.shared(VERSION.c.cell_id) & VERSION.c.retrain.in_(dropped)
                connection.execute(sa.update(VERSION).where(is_dropped).values(state=None))
        # Afterwards, so that the new state takes the room of those.
        self.database.insert(connection, VERSION.c.retrain, [row | {"version": number}])
        return number

    def _accepted_query(self) -> sa.Select[Any]:
        """Return the query for the accepted versions of the cell or its product, newest first.

        Its columns are retrain, version, and `kept`, whether the state is kept.
        """
        query = sa.select(
            *VERSION.c["retrain", "version"], VERSION.c.state.is_not(None).label("kept")
        )
        query = query.where(self._scope.shared(VERSION.c.cell_id), VERSION.c.accepted == sa.true())
        return query.order_by(VERSION.c.retrain.desc())

    def last_version(self) -> ModelVersion | None:
        """Return the newest accepted version of the cell or its product, with its arrays.

        For a damaged one an event is written to the store, and the one before it is returned.

        Returns
        -------
        ModelVersion or None
            None before the first, and if all that are kept are damaged. A peer's version is
            returned without the state of its rule.
        """
        for i, row in enumerate(self._read(self._accepted_query())):
            if not row.kept and i > 0:
                continue  # its state was deleted, which the newest's never is
            try:
                return self._load_retrain(row.retrain)
            except VersionError as error:
                self._record_damage(f"{error} The accepted version before it answers.")
        return None

    def load_version(self, version: int) -> ModelVersion:
        """Return an accepted version of the cell or its product, with its arrays.

        Parameters
        ----------
        version : int

        Returns
        -------
        ModelVersion
            A peer's version is returned without the state of its rule.

        Raises
        ------
        VersionError
            If there is no such accepted version, if its state is not kept (the error names the
            versions whose states are), or if it is damaged.
        """
        retrains = {
            row.version: row.retrain
            for row in reversed(self._read(self._accepted_query()))
            if row.kept
        }
        if version not in retrains:
            others = ", ".join(map(str, retrains)) or "none"
            raise VersionError(
                f"Expected a held version, got {version}, which is not kept; load one of "
                f"these: {others}."
            )
        return self._load_retrain(retrains[version])

    def _load_retrain(self, retrain: int) -> ModelVersion:
        """Return the version of a retrain with its arrays.

        A peer's version is returned without the state of its rule, and with a `rule_last_seq` of 0.
        Raise VersionError if the state is missing or damaged.
        """
        query = sa.select(*VERSION.c["cell_id", "version", "last_seq", "state", "state_sum"])
        is_retrain = self._scope.shared(VERSION.c.cell_id) & (VERSION.c.retrain == retrain)
        row = self._read(query.where(is_retrain))[0]
        if row.state is None or (
            row.state_sum is not None and state_sum(row.state) != row.state_sum
        ):
            where = f"as it was stored in {self.database.name}, its bytes have changed"
            raise VersionError(
                f"Expected the state of version {row.version} {where}; restore the store from "
                "a copy."
            )
        with instead(VersionError, f"Version {row.version} cannot be read", StoreError):
            state = from_npz(row.state, self.database.name)
        if row.cell_id != self.cell_id:  # a peer's outcomes are no evidence for this cell
            state = without_rule(state) | {"rule_last_seq": np.array(0)}
        return ModelVersion(row.version, row.last_seq, state)

    def versions(self, cell_only: bool = False) -> list[StoredVersion]:
        """Return every retrain of the cell or its product, dropped ones included, oldest first.

        Their arrays are not read.

        Parameters
        ----------
        cell_only : bool, default False
            Leave out those of the product's other cells.

        Returns
        -------
        list of StoredVersion
        """
        kept = VERSION.c.state.is_not(None).label("kept")
        n_bytes = sa.func.coalesce(sa.func.length(VERSION.c.state), 0).label("n_bytes")
        columns = (column for column in VERSION.c if column.name != "state")
        query = sa.select(*columns, VERSION.c.retrain.label("number"), n_bytes, kept)
        scope = Scope(self.cell_id) if cell_only else self._scope
        rows = self._read(query.where(scope.shared(VERSION.c.cell_id)).order_by(VERSION.c.retrain))
        return [
            from_row(StoredVersion, row._mapping, report=from_row(RetrainReport, row._mapping))
            for row in rows
        ]

    def retrains(self) -> list[RetrainReport]:
        """Return the report of every retrain of the cell or its product, oldest first."""
        return [version.report for version in self.versions()]

    # Events and corrections

    def put_event(
        self, kind: str, text: str, data: Mapping[str, Any] | None = None, author: str = ""
    ) -> None:
        """Commit an event with the present time.

        Parameters
        ----------
        kind, text, data, author
            As in `Event`.

        Raises
        ------
        StoreError
            For data that JSON does not have, and if the database fails.
        """
        self.apply_change(Change(kind, text, data, author))

    def _record_damage(self, text: str) -> None:
        """Commit an event of kind "damaged", unless the cell has one with this text.

        If the store cannot be written, the text is logged instead, and nothing raised.
        """
        query = sa.select(EVENT.c.number).where(self._own(EVENT))
        query = query.where(EVENT.c.kind == "damaged", EVENT.c.text == as_text(text))
        if not self._read(query.limit(1)):
            try:
                self.put_event("damaged", text)
            except StoreError as error:  # a store that can only be read is read all the same
                log.warning("%s (%s)", text, error)

    def acknowledge_losses(self, author: str = "") -> None:
        """End the alarm about lost data by an event; without an alarm nothing is written.

        Parameters
        ----------
        author : str

        Raises
        ------
        StoreError
            If the database fails.
        """
        if losses := open_losses(self.events()):
            self.put_event(ACKNOWLEDGED, f"{len(losses)} losses of data", author=author)

    def events(self, limit: int | None = None) -> list[Event]:
        """Return the newest events of the cell, oldest first.

        Parameters
        ----------
        limit : int or None
            Number of events; None: all.

        Returns
        -------
        list of Event
        """
        query = (
            sa.select(EVENT).where(self._own(EVENT)).order_by(EVENT.c.number.desc()).limit(limit)
        )
        return [from_row(Event, row._mapping) for row in self._read(query)[::-1]]

    def policy_change_after(self, decision_id: str) -> Event | None:
        """Return the event of the first change of the policy or the shadow mode after a decision.

        Parameters
        ----------
        decision_id : str

        Returns
        -------
        Event or None
            None if there was no change, or there is no such decision. The order is the ledger's,
            whatever the clock said.
        """
        is_decision = self._own(DECISION) & (DECISION.c.id == decision_id)
        decided = sa.select(DECISION.c.entry).where(is_decision).scalar_subquery()
        kinds = EVENT.c.kind.in_((POLICY_CHANGED, SHADOW_CHANGED)) & EVENT.c.data.is_not(None)
        query = sa.select(EVENT).where(self._own(EVENT), kinds, EVENT.c.entry > decided)
        rows = self._read(query.order_by(EVENT.c.number).limit(1))
        return from_row(Event, rows[0]._mapping) if rows else None

    def apply_change(self, change: Change) -> int:
        """Commit a person's change and its event in one transaction; return the event's number.

        The change may correct or forget labels, store a version, and replace the settings. If one
        part fails, nothing is written.

        Raises
        ------
        ReportError
            For a decision that is unknown or has no label.
        SettingError
            If a peer's settings contradict the new ones.
        StoreError
            For data that JSON does not have, for a setting that is the store's own, for a version
            without arrays, if a peer of the product stored a version meanwhile, and if the database
            fails.
        """
        now = float(self.clock())
        author = as_text(change.author)
        event = Event(
            0, now, as_text(change.kind), as_text(change.text), as_data(change.data), author
        )
        version = None if change.version is None else self._version_row(*change.version, now)

        def add_rows(connection: sa.Connection) -> int:
            """Insert the event and everything that it changes; return the event's number."""
            labels = self._labels_to_correct(connection, change.decisions)
            number = self.database.insert_corrections(connection, event, change.success, labels)
            if version is not None:
                stored = self._insert_version(connection, version)
                if stored != version["version"]:
                    expected = f"version {version['version']} to be the next"
                    raise StoreError(
                        f"Expected {expected}, a peer of the product stored {stored - 1} "
                        "meanwhile; try it again."
                    )
            if change.settings is not None:
                self._replace_settings(connection, change.settings)
            return number

        return self.database.write(add_rows)

    def _labels_to_correct(
        self, connection: sa.Connection, ids: Sequence[str]
    ) -> dict[str, bool | None]:
        """Return the present label of each of these decisions; None if it was forgotten.

        Raise ReportError for a decision that is unknown or has no label.
        """
        stored = self.database.stored_labels(connection, ids)
        for id_ in ids:
            if id_ not in stored:
                raise unknown_decision(id_)
            if stored[id_].corrected is None:
                raise nothing_to_correct(id_)
        labels = {0: False, 1: True, FORGOTTEN: None}
        return {id_: labels[stored[id_].corrected] for id_ in ids}

    def corrections(self, after: int = 0) -> list[Correction]:
        """Return corrections of labels, oldest first, also those that a later one replaced.

        Parameters
        ----------
        after : int, default 0
            Only those after this number.

        Returns
        -------
        list of Correction
            Of all cells of the product.
        """
        query = sa.select(*CORRECTION.c, LABEL.c.seq).select_from(
            CORRECTION.join(LABEL, CORRECTION_OF_LABEL)
        )
        query = query.where(
            self._scope.shared(CORRECTION.c.cell_id), CORRECTION.c.number > int(after)
        )
        return [
            from_row(Correction, row._mapping)
            for row in self._read(query.order_by(CORRECTION.c.number))
        ]

    # History

    def decisions(
        self, where: HistoryFilter, limit: int, start_after: str | None = None, newest: bool = True
    ) -> list[StoredDecision]:
        """Return the newest `limit` decisions of a selection, or the oldest; always oldest first.

        They are in the order in which they were made, whatever the clock said.

        Parameters
        ----------
        where : HistoryFilter
        limit : int
        start_after : str or None
            Id of a decision, for the next page: only decisions before it are returned; with
            `newest=False` only those after it.
        newest : bool, default True
            False: the oldest.

        Returns
        -------
        list of StoredDecision
            With corrected labels, without their traces. Empty for an unknown `start_after`.
        """
        conditions = [
            column == str(value)
            for column in DECISION.c["action", "predicted", "reason", "part"]
            if (value := getattr(where, column.name)) is not None
        ]
        if where.label is not None:
            label = LABELS[where.label]
            conditions.append(SUCCESS.is_(None) if label is None else SUCCESS.in_([int(label)]))
        if where.since is not None:
            conditions.append(DECISION.c.time >= where.since)
        if where.until is not None:
            conditions.append(DECISION.c.time < where.until)
        number = DECISION.c.number
        if start_after is not None:
            other = DECISION.alias("other")
            is_other = self._own(other) & (other.c.id == start_after)
            limit_number = sa.select(other.c.number).where(is_other).scalar_subquery()
            conditions.append(number < limit_number if newest else number > limit_number)
        query = (
            past_query(self.cell_id)
            .where(*conditions)
            .order_by(number.desc() if newest else number)
        )
        rows = self._read(query.limit(limit))
        return [read_decision(row) for row in (rows[::-1] if newest else rows)]

    def past_labels(self, after: int, upto: int | None = None) -> list[PastLabel]:
        """Return this cell's labels as they were recorded, oldest first.

        Labels of quarantined traces are included. A label that is not as it was stored is left out,
        and an event with its decision's id is written to the store.

        Parameters
        ----------
        after : int
            Only labels after this number.
        upto : int or None
            Number of the last label; None: all.

        Returns
        -------
        list of PastLabel
            Corrections are not applied.
        """
        query = sa.select(*LABEL.c, *DECISION.c["lower", "upper", "reason"], *audit_columns())
        query = query.select_from(LABEL.join(DECISION, LABEL_OF_DECISION))
        query = query.where(self._own(LABEL), LABEL.c.seq > int(after)).order_by(LABEL.c.seq)
        rows = self._read(query if upto is None else query.where(LABEL.c.seq <= upto))
        damaged = {row.decision_id for row in rows if not is_intact(LABEL, row)}
        self._record_left_out(sorted(damaged), "label")
        rows = [row for row in rows if row.decision_id not in damaged]
        return [from_row(PastLabel, row._mapping, novel=row.reason == Reason.NOVEL) for row in rows]

    def tally(
        self, last: int | None = None, since_version: int = 0, within: int | None = None
    ) -> Tally:
        """Count the cell's decisions in groups of equal action, reason, corrected label and so on.

        Parameters
        ----------
        last : int or None
            Number of newest decisions that are counted; None: all.
        since_version : int, default 0
            Only decisions by this version or a later one.
        within : int or None
            Number of later decisions after which a check without a label is overdue; None: none is.

        Returns
        -------
        Tally
            With the groups in no order.
        """
        newest = n_decisions(self.cell_id)
        aged = (sa.false() if within is None else newest - DECISION.c.number >= within).label(
            "aged"
        )
        columns = DECISION.c["action", "predicted", "reason", "audit", "quarantined"]
        group = (
            *columns,
            aged,
            SUCCESS.label("success"),
            SOURCE.label("source"),
            sa.func.count().label("n"),
        )
        times = (
            sa.func.min(DECISION.c.time),
            sa.func.max(DECISION.c.time),
            sa.func.max(LABEL.c.time),
        )
        query = (
            sa.select(*group, *times)
            .select_from(WITH_LABELS)
            .group_by(*columns, "aged", SUCCESS, SOURCE)
        )
        query = query.where(self._own(DECISION), DECISION.c.model_version >= since_version)
        rows = self._read(query if last is None else query.where(DECISION.c.number > newest - last))
        first, latest, label = (
            [row[i] for row in rows if row[i] is not None] for i in (-3, -2, -1)
        )
        groups = tuple(from_row(DecisionGroup, row._mapping) for row in rows)
        return Tally(
            groups, min(first, default=None), max(latest, default=None), max(label, default=None)
        )

    def stretches(self, n: int = 1, **by: Any) -> list[Stretch]:
        """Count the cell's decisions in at most `n` stretches of equal length, oldest first.

        The newest may be shorter.

        Parameters
        ----------
        n : int
            Without effect on stretches of time and on batches.
        **by
            For periods of time `seconds`, their length, and `start`, when one begins; for batches
            `batch`, the length or the separators of a batch's name in the parts' numbers. As in
            `stretches_query`.

        Returns
        -------
        list of Stretch
        """
        length = max(1, -(-self.n_decisions() // n))
        rows = self._read(stretches_query(self.cell_id, length, **by))
        return [Stretch(*row) for row in rows]

    # The one engine that owns the cell

    def claim_cell(self) -> Journal:
        """Claim the cell for this engine, and open its journal; `close` gives both up.

        Returns
        -------
        Journal

        Raises
        ------
        StoreError
            If another engine owns the cell, or the store cannot be written.
        """
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
        """Commit records of a journal, in one transaction unless the database refuses a record.

        A record that is stored already and is the same counts as taken. A line stop of a part that
        silence had confirmed corrects its label. Another decision with the same id, a label without
        its decision, or any other second label becomes an event, "dead letter": which one is right
        is never guessed. A record that the database refuses becomes one, too.

        Returns
        -------
        list of (str, int)
            Decision id and number of each label, also of one stored before; none of a dead letter.

        Raises
        ------
        StoreError
            If the database fails.
        """
        return self.database.apply_records(records)

    def close(self) -> None:
        """Disconnect from the database, and free the cell; a store in memory stays open."""
        if not self.database.is_in_memory:
            self.database.close()
        if self._journal is not None:
            self._journal.close()

    def __exit__(self, *exception: object) -> None:
        self.close()


def _checked_wait(wait: float | None) -> float:
    """Return a store's time limit in seconds; StoreError if it is not above 0, or infinite.

    It is the argument, else the environment's DENGINE_STORE_WAIT, else 0.4.
    """
    value = (os.environ.get(WAIT_VARIABLE) or WAIT) if wait is None else wait
    seconds = math.nan
    with suppress(ValueError):
        seconds = float(value)
    wanted = f"{WAIT_VARIABLE if wait is None else 'a wait'} above 0 seconds"
    expect(0.0 < seconds < math.inf, wanted, value, f"{WAIT} is the default", StoreError)
    return seconds
