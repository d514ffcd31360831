"""`DecisionTable`: the decisions of a store's cell, one by one, in selections and counted.
`SqlStore` has one; the engine reads it when it resumes, the status and the history are computed
from it.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import sqlalchemy as sa

from ..errors import StoreError
from ..records import Action, Reason, Source
from .cell_table import CellTable
from .ledger import is_intact
from .queries import (
    SOURCE,
    SUCCESS,
    TRACE_OF_DECISION,
    WITH_LABELS,
)
from .records import CHUNK, StoredDecision, from_row, read_decision
from .schema import CORRECTION, DECISION, LABEL, TRACE, Query
from .views import LABELS, DecisionGroup, HistoryFilter, Stretch, Tally


class DecisionTable(CellTable):
    """Reads the decisions of a robot cell, with their labels after corrections.

    It takes what `CellTable` takes. Every method raises StoreError if the database fails; `get`,
    `select`, `pending`, `tally` and `counts` also for a stored value that cannot be read.
    """

    def get(self, decision_id: str, trace: bool = True) -> StoredDecision | None:
        """Return a decision with its label after corrections.

        Parameters
        ----------
        decision_id : str
        trace : bool, default True
            Read its trace, too. False: its trace has shape (0, 0).

        Returns
        -------
        StoredDecision or None
            None for an unknown id, also for the id of another cell's decision. If the part was
            confirmed as good without a check, and its label was corrected to bad, the label's
            source is `Source.STOP`, as if the part had stopped the line.

        Raises
        ------
        StoreError
            If the trace is missing, or not as it was stored; it is checked only if it is read. Also
            for another stored value that cannot be read, and if the database fails.
        """
        query = self._past_query().where(DECISION.c.id == decision_id)
        rows = self._read(
            query.add_columns(*TRACE.c).outerjoin(TRACE, TRACE_OF_DECISION) if trace else query
        )
        if not rows:
            return None
        if trace and not is_intact(TRACE, rows[0][-len(TRACE.c) :]):
            raise StoreError(
                f"Expected the trace of decision {decision_id!r} as it was stored in "
                f"{self._database.name}, its bytes have changed; see `dengine verify`, and restore "
                "the store from a copy."
            )
        return read_decision(rows[0])

    def ids(self) -> Iterator[Sequence[str]]:
        """Yield the ids of all decisions of the robot cell, in any order, in lists of at most 500.

        A read transaction stays open until the last list, or until the iterator is closed. Raise
        StoreError, also between two lists, if the database fails.
        """
        query = sa.select(DECISION.c.id).where(self._own(DECISION))
        with self._database.reading() as connection:
            yield from (
                connection.execute(query.execution_options(yield_per=CHUNK)).scalars().partitions()
            )

    def newest_number(self) -> int:
        """Return the number of the cell's newest decision; 0 before the first."""
        return self._read(sa.select(self._n_decisions()))[0][0] or 0

    def select(
        self, where: HistoryFilter, limit: int, start_after: str | None = None, newest: bool = True
    ) -> list[StoredDecision]:
        """Return the newest `limit` decisions of a selection, or its oldest `limit`.

        The list is oldest first in both cases: by the order in which the decisions were made,
        whatever the clock said.

        Parameters
        ----------
        where : HistoryFilter
            The selection: a decision must have the values of all fields that are not None (action,
            what the model alone would have done, reason, label, part), and its time must lie from
            `since` to before `until`.
        limit : int
            Number of decisions at most.
        start_after : str or None
            Id of a decision, for the next page: only decisions before it are returned; with
            `newest=False` only those after it. It need not be in the selection.
        newest : bool, default True
            False: the oldest.

        Returns
        -------
        list of StoredDecision
            With corrected labels, without their traces. Empty for an unknown `start_after`.

        Raises
        ------
        StoreError
            For a stored value that cannot be read, and if the database fails.
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
            query = sa.select(number).where(self._own(DECISION), DECISION.c.id == start_after)
            start = query.correlate(None).scalar_subquery()
            conditions.append(number < start if newest else number > start)
        rows = self._read(
            self._past_query()
            .where(*conditions)
            .order_by(number.desc() if newest else number)
            .limit(limit)
        )
        return [read_decision(row) for row in (rows[::-1] if newest else rows)]

    def unreported_accepts(self, since_version: int = 0) -> list[str]:
        """Return the ids of the robot cell's accepted decisions without a label, oldest first.

        Parameters
        ----------
        since_version : int, default 0
            Only decisions by this model version or a later one.

        Returns
        -------
        list of str
            Decisions on quarantined traces (stored, but never used in training) are left out. A
            label that a person withdrew counts as a label here.
        """
        return [
            row.id
            for row in self._read(
                self._unlabelled_query(Action.ACCEPT, since_version, DECISION.c.id)
            )
        ]

    def pending(self, since_version: int = 0) -> list[StoredDecision]:
        """Return the robot cell's decisions with action VERIFY that have no label, oldest first.

        Accepted decisions are not among them, see `unreported_accepts`.

        Parameters
        ----------
        since_version : int, default 0
            Only decisions by this model version or a later one.

        Returns
        -------
        list of StoredDecision
            Without their traces. Decisions on quarantined traces (stored, but never used in
            training) are left out. A label that a person withdrew counts as a label here.
        """
        return [
            read_decision(row)
            for row in self._read(self._unlabelled_query(Action.VERIFY, since_version, *DECISION.c))
        ]

    def _past_query(self) -> Query:
        """Return the query for the cell's decisions with their corrected labels; it is not run.

        `read_decision` reads its rows: all columns of a decision, and of its label success (None if
        a person has withdrawn it), source (where it came from), number and time. The source is
        "stop" (the accepted part was bad and stopped the line) if it was "confirmed" (the part
        counted as good) and the label was corrected to bad. Decisions without a label are included;
        traces are not. The rows are in no order.
        """
        return (
            sa.select(
                *DECISION.c,
                SUCCESS,
                SOURCE,
                LABEL.c.seq.label("label_seq"),
                LABEL.c.time.label("label_time"),
            )
            .select_from(WITH_LABELS)
            .where(self._own(DECISION))
        )

    def _n_decisions(self) -> sa.ScalarSelect[int]:
        """Return the scalar subquery for the number of the cell's newest decision, NULL if none.

        Decisions are numbered 1, 2, ... in each robot cell, so this is also how many there are. The
        query is not run.
        """
        return (
            sa.select(sa.func.max(DECISION.c.number))
            .where(self._own(DECISION))
            .correlate(None)
            .scalar_subquery()
        )

    def _unlabelled_query(self, action: Action, since_version: int, *columns: Any) -> Query:
        """Return the query for the cell's decisions of an action that have no label, oldest first.

        A forgotten label (which a person withdrew) is a label here. Decisions on quarantined traces
        (stored, but never used in training), and by a model version before `since_version`, are
        left out. `columns` are those that the query selects.
        """
        return (
            sa.select(*columns)
            .select_from(WITH_LABELS)
            .where(
                DECISION.c.action == action.value,
                LABEL.c.seq.is_(None),
                self._own(DECISION),
                DECISION.c.quarantined == sa.false(),
                DECISION.c.model_version >= since_version,
            )
            .order_by(DECISION.c.number)
        )

    def overdue_to(self, within: int, since_version: int = 0) -> int:
        """Return the number up to which decisions are old enough for their checks to be overdue.

        Decisions are numbered 1, 2, ... in each robot cell. A check is overdue if a decision with
        this or a lower number asked for it and has no label. The number returned is the larger of
        two. One is the number of the newest decision minus `within`. The other is the largest such
        number that is stored with a label: with each label the number is stored that was valid when
        the decision rule learned it. So a check that was overdue then stays so, whatever `within`
        is now. The result is 0 if nothing can be overdue yet.

        Parameters
        ----------
        within : int
            A check is overdue once so many or more decisions have followed its own.
        since_version : int, default 0
            The number of the model version (trained model) with which `within` came into force. If
            the newest decision is by an earlier version, or there is none, only the numbers that
            are stored with labels count.

        Returns
        -------
        int
        """
        number = DECISION.c.number
        newest = self._read(
            sa.select(number).where(
                self._own(DECISION),
                number == self._n_decisions(),
                DECISION.c.model_version >= since_version,
            )
        )
        of_labels = self._read(sa.select(sa.func.max(LABEL.c.overdue_to)).where(self._own(LABEL)))
        numbers: list[int] = [of_labels[0][0] or 0, *(row.number - within for row in newest)]
        return max(numbers)

    def tally(
        self, last: int | None = None, since_version: int = 0, within: int | None = None
    ) -> Tally:
        """Count the cell's decisions in groups.

        The decisions of a group are equal in action, in the action that the model alone would have
        taken, in the reason, in whether the part was audited (checked at random although the model
        was certain), in whether the trace is quarantined (never used in training), in the corrected
        label and its source, and in whether they are so old that a check without a label would be
        overdue (whatever their action).

        Parameters
        ----------
        last : int or None
            Number of newest decisions that are counted; None: all.
        since_version : int, default 0
            Only those of them by this model version or a later one.
        within : int or None
            A check without a label is overdue once so many or more decisions have followed its own;
            None: none is.

        Returns
        -------
        Tally
            The groups, in no order, with the number of decisions in each; the smallest and the
            largest time of these decisions, None without any.

        Raises
        ------
        StoreError
            For a stored value that cannot be read, and if the database fails.
        """
        newest = self._n_decisions()
        columns = DECISION.c["action", "predicted", "reason", "audit", "quarantined"]
        query = (
            sa.select(
                *columns,
                (sa.false() if within is None else newest - DECISION.c.number >= within).label(
                    "aged"
                ),
                SUCCESS,
                SOURCE,
                sa.func.count().label("n"),
                sa.func.min(DECISION.c.time).label("first"),
                sa.func.max(DECISION.c.time).label("last"),
            )
            .select_from(WITH_LABELS)
            .group_by(*columns, "aged", SUCCESS, SOURCE)
            .where(self._own(DECISION), DECISION.c.model_version >= since_version)
        )
        rows = self._read(query if last is None else query.where(DECISION.c.number > newest - last))
        return Tally(
            groups=tuple(from_row(DecisionGroup, row._mapping) for row in rows),
            first=min((row.first for row in rows), default=None),
            last=max((row.last for row in rows), default=None),
        )

    def stretches(self, n: int = 1, seconds: float = 0.0, start: float = 0.0) -> list[Stretch]:
        """Count the cell's decisions in stretches of equal length, oldest first.

        A stretch is a run of consecutive decisions, or a period of time. The newest stretch may be
        shorter. A period of time without decisions has no stretch.

        Parameters
        ----------
        n : int, default 1
            Number of stretches of decisions at most, 1 or more; without effect on periods of time.
        seconds : float, default 0.0
            Length of a period of time; 0.0: the stretches are runs of decisions.
        start : float, default 0.0
            A time, in seconds since 1970, at which a period begins; earlier decisions count, too.

        Returns
        -------
        list of Stretch
            Sorted by their newest decision; [] without decisions. Each has the number of decisions,
            the time of the newest, and how many of them are verified, verified because the trace is
            novel (unlike those of the training), accepted, accepted but bad by the label after
            corrections, rejected by the model, and decided by an operator's limits.
        """
        if seconds:
            stretch: sa.ColumnElement[Any] = sa.func.floor((DECISION.c.time - start) / seconds)
        else:
            length = max(1, -(-self.newest_number() // n))
            stretch = (DECISION.c.number - 1) // length
        verified, accepted, rejected = (DECISION.c.action == action.value for action in Action)
        novel, outside = (
            DECISION.c.reason == reason.value for reason in (Reason.NOVEL, Reason.OUTSIDE)
        )
        false_accepted = accepted & (SUCCESS == 0)
        # In the order of the fields of `Stretch`.
        conditions = (verified, novel, accepted, false_accepted, rejected & ~outside, outside)
        counts: list[sa.ColumnElement[Any]] = [
            sa.func.sum(sa.case((condition, 1), else_=0)) for condition in conditions
        ]
        rows = self._read(
            sa.select(sa.func.count(), sa.func.max(DECISION.c.time), *counts)
            .select_from(WITH_LABELS)
            .where(self._own(DECISION))
            .group_by(stretch)
            .order_by(sa.func.max(DECISION.c.number))
        )
        return [Stretch(*row) for row in rows]

    def counts(self, tally: Tally | None = None) -> dict[str, Any]:
        """Return counts of all decisions and labels of the robot cell.

        Parameters
        ----------
        tally : Tally or None
            All decisions, counted in groups: what the method `tally` returned, if it was called
            already; None: it is called here.

        Returns
        -------
        dict
            decisions, labels: their numbers, without labels that are forgotten (withdrawn by a
            person); quarantined: number of decisions whose trace is kept out of training;
            corrected: number of decisions whose label was ever corrected or forgotten, and is not
            forgotten now; forgotten: number of those whose label is forgotten now; actions,
            reasons: numbers of decisions for each action and reason; sources: numbers of labels for
            each source, like a check or a line stop, without forgotten ones. These three are dicts
            that include values with 0.
        """
        tally = tally or self.tally()
        actions = tally.by("action")
        reasons = tally.by("reason")
        sources: Counter[Any] = Counter()
        for group in tally.groups:
            if group.success is not None:
                sources[group.source] += group.n
        forgotten = tally.by("label")["forgotten"]
        corrected = self._read(
            sa.select(sa.func.count(CORRECTION.c.decision_id.distinct())).where(
                self._own(CORRECTION)
            )
        )[0][0]
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
