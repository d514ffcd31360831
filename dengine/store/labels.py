"""`LabelTable`: the labels of a store's cell and of its product, with their traces for training,
and as outcomes for a decision rule. `SqlStore` has one.
"""

from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import sqlalchemy as sa

from ..errors import StoreError, listed
from ..records import Reason, Source
from .cell_table import CellTable
from .connections import Database
from .decisions import DecisionTable
from .events import EventTable
from .ledger import is_intact
from .queries import (
    AUDIT_COLUMNS,
    LABEL_OF_DECISION,
    TRACE_OF_LABEL,
    TRAINS,
    Scope,
    corrected_label,
)
from .records import (
    CHUNK,
    FORGOTTEN,
    LabelledTraces,
    OutcomeRecord,
    from_row,
    overdue_outcomes,
    unpack,
)
from .schema import DECISION, LABEL, TRACE, Query
from .views import PastLabel


class LabelTable(CellTable):
    """Reads labels.

    `with_traces` and `past` leave out what is not as it was stored, and an event says so.

    Parameters
    ----------
    database : Database
    decisions : DecisionTable
    events : EventTable
        Takes an event about what was left out.
    """

    def __init__(self, database: Database, decisions: DecisionTable, events: EventTable) -> None:
        super().__init__(database)
        self._decisions = decisions
        self._events = events

    def newest(self) -> int:
        """Return the number of the newest label of the robot cell or its product; 0 before the
        first.
        """
        with self._database.reading() as connection:
            return self._scope.newest(connection, LABEL.c.seq)

    def with_traces(
        self,
        limit: int | None = None,
        *,
        first: int = 1,
        last: int | None = None,
        corrected_to: int | None = None,
        cell_only: bool = False,
    ) -> LabelledTraces:
        """Return labelled traces for training, with corrected labels, oldest first.

        The labels are those of this robot cell, or of its product (robot cells that share labels
        and versions). Forgotten labels, which a person has withdrawn, are left out, and so are
        labels of quarantined traces, which are stored but never used in training. A label whose
        trace is missing or not as it was stored is left out, too. An event (a row of the store's
        log) then has the ids of the decisions concerned, eight at most, and the number of the
        others. It is not written if the store has the same event already, and it is logged instead
        if the store cannot be written.

        Parameters
        ----------
        limit : int or None
            Number of newest labels, from `first` to `last`, that are read. Labels whose trace is
            damaged count; forgotten labels and labels of quarantined traces do not. None: all.
        first, last : int, optional
            Numbers of the first and the last label, both included.
        corrected_to : int or None
            Only corrections (changes of labels) whose own number is at most this one are applied,
            so that labels are as they stood then. None: all.
        cell_only : bool, default False
            Leave out the labels of the product's other robot cells.

        Returns
        -------
        LabelledTraces
            Numbers of the labels, traces, labels (1 or 0) and content hashes (64-bit hashes of the
            parts' numbers, or of the traces of parts without one), as arrays; empty if there are
            none.

        Raises
        ------
        StoreError
            If the traces have different shapes, or a label is not 0 or 1; other damage of a label
            is not noticed here. If the database fails.
        """
        scope = Scope(self._database.cell_id) if cell_only else self._scope
        label = corrected_label(corrected_to)
        query = (
            sa.select(
                *TRACE.c,
                *LABEL.c["seq", "content_hash"],
                label.label("success"),
                LABEL.c.decision_id.label("labelled_id"),
            )
            .select_from(LABEL.outerjoin(TRACE, TRACE_OF_LABEL))
            .where(
                scope.shared(LABEL.c.cell_id),
                TRAINS,
                label != FORGOTTEN,
                LABEL.c.seq >= int(first),
            )
            .order_by(LABEL.c.seq.desc())
            .limit(limit)
        )
        query = query if last is None else query.where(LABEL.c.seq <= last)
        kept = []
        traces = []
        damaged = []
        with self._database.reading() as connection:
            for row in self._read_newest(connection, query, limit, last):
                if row.success not in (0, 1):
                    raise StoreError(
                        "Expected labels that are True or False, found another: the store is "
                        "damaged; restore a copy."
                    )
                if is_intact(TRACE, row):
                    kept.append((row.seq, row.success, row.content_hash))
                    traces.append(unpack(row.data).reshape(row.channels, row.samples))
                else:
                    damaged.append(row.labelled_id)
        self._record_left_out(damaged[::-1], "trace")
        shapes = sorted({trace.shape for trace in traces})
        if len(shapes) > 1:
            raise StoreError(
                f"Expected one shape in a cell's store, found {shapes}; give each kind its own "
                "cell_id."
            )
        seq, labels, hashes = np.array(kept[::-1], dtype=np.int64).reshape(-1, 3).T.copy()
        stacked = np.stack(traces[::-1]) if traces else np.zeros((0, 0, 0), np.float32)
        return LabelledTraces(seq, stacked, labels.astype(np.int8), hashes)

    def _read_newest(
        self, connection: sa.Connection, query: Query, limit: int | None, last: int | None
    ) -> Iterable[Any]:
        """Run a query for the newest `limit` labels up to number `last`; return rows, newest first.

        `query` must have this limit (None: no limit), order and condition already. It is run on all
        labels, and its rows are fetched while the caller goes through them, which the caller must
        do within the transaction of `connection`. In a product (robot cells that share labels and
        trained models) a query with a limit is first run on the labels with the 2 * `limit` highest
        numbers up to `last`, because the database would sort all labels of the product otherwise.
        If these give `limit` rows, or if there are no labels before them, their rows are returned
        as a list instead.
        """
        if self._scope.product is not None and limit is not None:
            newest = self._scope.newest(connection, LABEL.c.seq)
            newest = min(newest, last or newest)
            rows = connection.execute(query.where(LABEL.c.seq > newest - 2 * limit)).all()
            if len(rows) == limit or newest <= 2 * limit:
                return rows
        # In a product: here more than half are quarantined or forgotten.
        return connection.execute(query.execution_options(yield_per=CHUNK))

    def past(self, after: int, upto: int | None = None) -> list[PastLabel]:
        """Return this cell's labels as they were recorded, oldest first.

        Labels of quarantined traces (stored, but never used in training) are included, and so are
        forgotten ones, which a person has withdrawn. Labels that are not as they were stored are
        left out. One event (a row of the store's log) with the ids of their decisions, eight at
        most, and the number of the others is written to the store, unless the robot cell has the
        same event already; it is logged instead if the store cannot be written. A label without its
        decision is left out, too, without an event. Whether decisions are as they were stored is
        not checked.

        Parameters
        ----------
        after : int
            Only labels after this number.
        upto : int or None
            Number of the last label; None: all.

        Returns
        -------
        list of PastLabel
            Each label with the bounds of the success probability that its decision had, and what
            else a decision rule, which learns from labels, is updated with. Corrections, which
            change labels later, are not applied.

        Raises
        ------
        StoreError
            For a stored value that cannot be read, and if the database fails.
        """
        query = (
            sa.select(*LABEL.c, *DECISION.c["lower", "upper", "reason"], *AUDIT_COLUMNS)
            .select_from(LABEL.join(DECISION, LABEL_OF_DECISION))
            .where(self._own(LABEL), LABEL.c.seq > int(after))
            .order_by(LABEL.c.seq)
        )
        rows = self._read(query if upto is None else query.where(LABEL.c.seq <= upto))
        damaged = {row.decision_id for row in rows if not is_intact(LABEL, row)}
        self._record_left_out(sorted(damaged), "label")
        return [
            from_row(PastLabel, row._mapping, novel=row.reason == Reason.NOVEL)
            for row in rows
            if row.decision_id not in damaged
        ]

    def outcomes_since(
        self, seq: int, since_version: int = 0, overdue_to: int = 0
    ) -> list[OutcomeRecord]:
        """Return the outcomes that update a decision rule, with corrected labels, oldest first.

        A decision rule turns the bounds of a part's success probability into an action, and learns
        from outcomes. Left out are forgotten labels (withdrawn by a person), labels without their
        decision, labels of quarantined traces (stored, but never used in training), and labels of
        rejected parts (`Source.INSPECTION`), because somebody chooses which of these parts come
        back. Only this cell's labels count: labels of other robot cells are no evidence for this
        one, and a drift detector (a running test for too many wrong decisions) that counts them
        would notice too late that this cell has changed. Whether labels and decisions are as they
        were stored is not checked here.

        Parameters
        ----------
        seq : int
            Outcomes of labels after this number.
        since_version : int, default 0
            Only of decisions by this version of the model or a later one, overdue checks included.
        overdue_to : int, default 0
            Up to this decision number a check (action VERIFY) without a label is overdue, and its
            decision counts as wrong until its label comes; 0: none is. Overdue checks are included
            whatever `seq` is, but not those of quarantined traces. Each adds an outcome "failure"
            if the lower bound of its decision is above 0, and an outcome "success" if the upper
            bound is below 1 (`overdue_outcomes`). These outcomes stand where the running engine
            updated the rule with them: before the first returned label that came when this check
            was overdue already, else at the end. A label that does not record what was overdue
            stands behind all overdue checks up to its own decision.

        Returns
        -------
        list of OutcomeRecord
            For each label its number, the bounds of the decision, the label, whether the trace was
            novel (unlike all labelled traces), the number of accepted parts without a report since
            the label before, what the model alone would have done, and the probability with which
            the part was to be checked (0 if no check was asked for). `overdue_outcomes` says what
            an overdue check has in their place.
        """
        label = corrected_label()
        # A label that does not know came right after its decision, as most do.
        known_overdue = sa.func.coalesce(LABEL.c.overdue_to, DECISION.c.number)
        rows = self._read(
            sa.select(
                LABEL.c.seq,
                *DECISION.c["lower", "upper"],
                label == 1,
                DECISION.c.reason == Reason.NOVEL.value,
                LABEL.c.silent,
                *AUDIT_COLUMNS,
                known_overdue,
            )
            .select_from(LABEL.join(DECISION, LABEL_OF_DECISION))
            .where(
                self._own(LABEL),
                TRAINS,
                LABEL.c.seq > int(seq),
                LABEL.c.source != Source.INSPECTION.value,
                label != FORGOTTEN,
                DECISION.c.model_version >= since_version,
            )
            .order_by(LABEL.c.seq)
        )
        pending = self._decisions.pending(since_version) if overdue_to else []
        overdue = deque(item for item in pending if item.number <= overdue_to)
        outcomes: list[OutcomeRecord] = []
        for *values, last_overdue in rows:
            while overdue and overdue[0].number <= last_overdue:
                outcomes += overdue_outcomes(overdue.popleft().decision)
            outcomes.append(OutcomeRecord(*values))
        for item in overdue:
            outcomes += overdue_outcomes(item.decision)
        return outcomes

    def unreported_total(self, since_version: int = 0) -> int:
        """Return how many accepted parts before the cell's newest label had no report.

        Each label stores, as `silent`, the number of such parts since the label before it, less 1
        if its own part was counted, by this label or an earlier one; so it may be -1. The sum over
        the cell's labels is returned, with forgotten ones (withdrawn by a person), and without
        labels of quarantined traces (stored, but never used in training).

        Parameters
        ----------
        since_version : int, default 0
            Only labels that came while this version of the model or a later one was in force.

        Returns
        -------
        int
        """
        query = sa.select(sa.func.sum(LABEL.c.silent)).where(
            self._own(LABEL), TRAINS, LABEL.c.model_version >= since_version
        )
        return int(self._read(query)[0][0] or 0)

    def _record_left_out(self, damaged: Sequence[str], part: str) -> None:
        """Write an event (a row of the store's log): some traces or labels were left out.

        `damaged` has the ids of their decisions, of which the event names eight and counts the
        others; `part` says what is damaged, "trace" or "label". Nothing is written without ids, or
        if the robot cell has the same event already. If the store cannot be written, this is logged
        instead.
        """
        if damaged:
            self._events.record_damage(
                f"left out, since the {part} is not as it was stored: "
                f"decision {listed(damaged)}; see dengine verify"
            )
