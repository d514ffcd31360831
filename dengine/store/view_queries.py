"""What a database shows to whoever looks back: pages along the index `decision_time`, and counts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import sqlalchemy as sa

from ..records import Action, Reason, RetrainReport, Source
from . import queries as ask
from .connections import SqlDatabase
from .records import Key, StoredDecision, as_label, unpack
from .schema import DECISION, LABEL, VERSION, read_decision
from .views import LABELS, HistoryFilter, Kind, PastLabel, PastRetrain, Stretch, Tally

Query = sa.Select[Any]

OF_LABEL = (
    "seq", "time", "decision_id", "success", "source", "model_version", "content_hash", "quarantined", "silent",
)  # fmt: skip
IN_TIME = (DECISION.c.time, DECISION.c.id)


def page_query(cell_id: str, where: HistoryFilter, limit: int, beyond: Key | None, newest: bool) -> Query:
    """The newest decisions that are meant, newest first, or the oldest ones, oldest first."""
    query = ask.past_query(cell_id).where(*_meant(where)).limit(limit)
    if beyond is not None:
        here, there = sa.tuple_(*IN_TIME), sa.tuple_(sa.literal(beyond[0], sa.Double), sa.literal(beyond[1]))
        query = query.where(here < there if newest else here > there)
    return query.order_by(*(column.desc() if newest else column for column in IN_TIME))


def _meant(where: HistoryFilter) -> list[sa.ColumnElement[bool]]:
    found: list[sa.ColumnElement[bool]] = []
    if where.action is not None:
        found.append(DECISION.c.action == where.action.value)
    if where.predicted is not None:
        found.append(DECISION.c.predicted == where.predicted.value)
    if where.reason is not None:
        found.append(DECISION.c.reason == where.reason.value)
    if where.label is not None:
        meant = LABELS[where.label]
        found.append(ask.SAID.is_(None) if meant is None else ask.SAID.in_([int(meant)]))
    if where.since is not None:
        found.append(DECISION.c.time >= where.since)
    if where.until is not None:
        found.append(DECISION.c.time < where.until)
    return found


def past_label_query(cell_id: str, after: int, upto: int | None, points: bool) -> Query:
    """Labels along their numbers, with what a rule was told of their decisions."""
    decided = (DECISION.c.time.label("decided"), *DECISION.c["lower", "upper", "reason"])
    point = LABEL.c.point if points else sa.null().label("point")
    query: Query = sa.select(*LABEL.c[OF_LABEL], point, *decided).select_from(LABEL.join(DECISION, ask.LABEL_OF_DECISION))
    query = query.where(LABEL.c.cell_id == cell_id, LABEL.c.seq > after).order_by(LABEL.c.seq)
    return query if upto is None else query.where(LABEL.c.seq <= upto)


def tally_query(cell_id: str, last: int | None) -> Query:
    """How many decisions of each kind, with the times of the first and the last, among the newest `last`."""
    columns = ("cell_id", "id", "time", "action", "predicted", "reason", "audit", "quarantined")
    newest = sa.select(*DECISION.c[columns]).where(DECISION.c.cell_id == cell_id)
    if last is not None:
        newest = newest.order_by(*(column.desc() for column in IN_TIME)).limit(last)
    some = newest.subquery("newest")
    of = (LABEL.c.cell_id == some.c.cell_id) & (LABEL.c.decision_id == some.c.id)
    kind = (*some.c["action", "predicted", "reason", "audit", "quarantined"], ask.SAID.label("success"))
    times = (sa.func.min(some.c.time).label("first"), sa.func.max(some.c.time).label("last"))
    query = sa.select(*kind, sa.func.count().label("n"), *times).select_from(some.outerjoin(LABEL, of))
    return query.group_by(*kind)


def stretch_query(cell_id: str, length: int) -> Query:
    """Counts of consecutive decisions, so many at a time, oldest first."""
    number = sa.func.row_number().over(order_by=IN_TIME) - 1
    columns = (*DECISION.c["cell_id", "id", "time", "action", "reason"], number.label("number"))
    every = sa.select(*columns).where(DECISION.c.cell_id == cell_id).subquery("every")
    of = (LABEL.c.cell_id == every.c.cell_id) & (LABEL.c.decision_id == every.c.id)
    accepted = every.c.action == Action.ACCEPT.value
    which = (
        every.c.action == Action.VERIFY.value,
        every.c.reason == Reason.NOVEL.value,
        accepted,
        accepted & (ask.SAID == 0),
    )
    counts: list[sa.ColumnElement[Any]] = [sa.func.sum(sa.case((each, 1), else_=0)) for each in which]
    query = sa.select(*[sa.func.count(), sa.func.max(every.c.time), *counts]).select_from(every.outerjoin(LABEL, of))
    stretch = every.c.number - every.c.number % length
    return query.group_by(stretch).order_by(stretch)


class SqlViews:
    """`StoreViews` in a database, but for versions and traces, which `SqlVersions` and `SqlTraces` read."""

    cell_id: str
    _database: SqlDatabase

    def decisions(
        self, where: HistoryFilter, limit: int, beyond: Key | None = None, newest: bool = True
    ) -> list[StoredDecision]:
        """Return the newest (or oldest) `limit` decisions that are meant, oldest first; read along `decision_time`."""
        rows = self._look(page_query(self.cell_id, where, limit, beyond, newest))
        return [read_decision(row) for row in (rows[::-1] if newest else rows)]

    def past_decision(self, decision_id: str) -> StoredDecision | None:
        """Return one decision; None where it is unknown."""
        rows = self._look(ask.past_query(self.cell_id).where(DECISION.c.id == decision_id))
        return read_decision(rows[0]) if rows else None

    def past_labels(self, after: int, upto: int | None = None, points: bool = False) -> list[PastLabel]:
        """Return the labels after number `after`, up to `upto`, oldest first; points : with them."""
        return [_past_label(row) for row in self._look(past_label_query(self.cell_id, int(after), upto, points))]

    def past_retrains(self) -> list[PastRetrain]:
        """Return every retrain, oldest first."""
        report = VERSION.c["version", "seconds", "n_traces", "n_steps", "accepted", "reason"]
        query = sa.select(*VERSION.c["retrain", "time", "last_seq"], *report).where(VERSION.c.cell_id == self.cell_id)
        return [
            PastRetrain(row[0], row[1], row[2], RetrainReport(*row[3:]))
            for row in self._look(query.order_by(VERSION.c.retrain))
        ]

    def tally(self, last: int | None = None) -> Tally:
        """Count the newest `last` decisions, all where it is None."""
        rows = self._look(tally_query(self.cell_id, last))
        kinds = tuple(Kind(Action(r[0]), Action(r[1]), Reason(r[2]), r[3], r[4], as_label(r[5]), r[6]) for r in rows)
        first, newest = (min((r.first for r in rows), default=None), max((r.last for r in rows), default=None))
        return Tally(kinds, first, newest)

    def stretches(self, n: int) -> list[Stretch]:
        """Cut all decisions into `n` stretches of one length at most, oldest first; one pass over the decisions."""
        counted = self._look(sa.select(sa.func.count()).where(DECISION.c.cell_id == self.cell_id))[0][0]
        rows = self._look(stretch_query(self.cell_id, max(1, -(-int(counted) // n))))
        return [Stretch(int(row[0]), float(row[1]), *(int(each) for each in row[2:])) for row in rows]

    def _look(self, query: Query) -> Sequence[Any]:
        if self._database._queue:  # an empty one needs no lock of a database that a cell writes to
            self._database.flush()
        with self._database.transaction(write=False) as connection:
            return connection.execute(query).all()


def _past_label(row: Any) -> PastLabel:
    return PastLabel(
        seq=row.seq,
        time=row.time,
        decision_id=row.decision_id,
        success=row.success,
        source=Source(row.source),
        model_version=row.model_version,
        content_hash=row.content_hash,
        quarantined=row.quarantined,
        silent=row.silent,
        point=None if row.point is None else unpack(row.point),
        decided=row.decided,
        lower=row.lower,
        upper=row.upper,
        novel=row.reason == Reason.NOVEL,
    )
