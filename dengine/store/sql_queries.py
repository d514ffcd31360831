"""What a store asks its database."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import sqlalchemy as sa

from ..records import Action
from .sql_scope import Scope, newest_of
from .sql_tables import DECISION, EVENT, LABEL, TRACE, VERSION

Query = sa.Select[Any]

INSERTED = {"sqlite": "decision.rowid", "postgresql": "decision.ctid"}  # in the order of insertion: rows never change
LABEL_OF_DECISION = (LABEL.c.cell_id == DECISION.c.cell_id) & (LABEL.c.decision_id == DECISION.c.id)
WITH_LABELS = DECISION.outerjoin(LABEL, LABEL_OF_DECISION)


def decision_query(cell_id: str, decision_id: str) -> Query:
    """A decision with its trace, and with its label where it has one."""
    mine = (DECISION.c.cell_id == cell_id) & (DECISION.c.id == decision_id)
    traces = (TRACE.c.cell_id == DECISION.c.cell_id) & (TRACE.c.decision_id == DECISION.c.id)
    columns = (*DECISION.c, *TRACE.c["channels", "samples", "data"], LABEL.c.success, LABEL.c.source)
    return sa.select(*columns).select_from(DECISION.join(TRACE, traces).outerjoin(LABEL, LABEL_OF_DECISION)).where(mine)


def held_query(cell_id: str, ids: Sequence[str]) -> Query:
    """What labels repeat of these decisions, and the labels that they have already."""
    columns = (*DECISION.c["id", "content_hash", "quarantined"], LABEL.c.success, LABEL.c.source)
    return sa.select(*columns).select_from(WITH_LABELS).where(DECISION.c.cell_id == cell_id, DECISION.c.id.in_(ids))


def newest_query(scope: Scope, limit: int | None) -> Query:
    """The newest labels that train, newest first, without their traces; along the index `label_training`."""
    query = sa.select(*LABEL.c["seq", "success", "content_hash"])
    query = query.where(scope.shared(LABEL.c.cell_id), LABEL.c.quarantined == sa.false())
    return query.order_by(LABEL.c.seq.desc()).limit(limit)


def trace_query(scope: Scope, first: int, last: int) -> Query:
    """The traces of the labels `first` to `last` that train, oldest first."""
    same = (TRACE.c.cell_id == LABEL.c.cell_id) & (TRACE.c.decision_id == LABEL.c.decision_id)
    query = sa.select(*TRACE.c["channels", "samples", "data"]).select_from(LABEL.join(TRACE, same))
    mine = scope.shared(LABEL.c.cell_id) & (LABEL.c.quarantined == sa.false())
    return query.where(mine, LABEL.c.seq.between(first, last)).order_by(LABEL.c.seq)


def news_query(scope: Scope, seq: int, limit: int) -> Query:
    """The first labels after `seq` that train, oldest first, without their traces."""
    mine = scope.shared(LABEL.c.cell_id) & (LABEL.c.quarantined == sa.false()) & (LABEL.c.seq > seq)
    return sa.select(*LABEL.c["seq", "success", "content_hash"]).where(mine).order_by(LABEL.c.seq).limit(limit)


def points_query(cell_id: str, seq: int, model_version: int) -> Query:
    """The points of a version that came with labels after `seq`, oldest first."""
    query = sa.select(*LABEL.c["seq", "point"]).where(LABEL.c.cell_id == cell_id, LABEL.c.seq > seq)
    query = query.where(LABEL.c.model_version == model_version, LABEL.c.point.is_not(None))
    return query.order_by(LABEL.c.seq)


def evidence_query(cell_id: str, seq: int) -> Query:
    """The bounds of decisions whose labels came after `seq`, with those labels, oldest first."""
    query = sa.select(*LABEL.c["seq", "success", "silent"], *DECISION.c["lower", "upper", "reason"])
    mine = (LABEL.c.cell_id == cell_id) & (LABEL.c.quarantined == sa.false()) & (LABEL.c.seq > seq)
    return query.select_from(LABEL.join(DECISION, LABEL_OF_DECISION)).where(mine).order_by(LABEL.c.seq)


def unreported_query(cell_id: str, dialect: str) -> Query:
    """The ids of accepted decisions without a label, oldest first; among those of one time in the order of insertion."""
    mine = (DECISION.c.cell_id == cell_id) & (DECISION.c.quarantined == sa.false()) & LABEL.c.seq.is_(None)
    query = sa.select(DECISION.c.id).select_from(WITH_LABELS).where(mine, DECISION.c.action == Action.ACCEPT.value)
    return query.order_by(DECISION.c.time, sa.literal_column(INSERTED[dialect]))


def silent_query(cell_id: str) -> Query:
    """How many accepted parts went on unheard of, by all labels that train."""
    query = sa.select(sa.func.coalesce(sa.func.sum(LABEL.c.silent), 0))
    return query.where(LABEL.c.cell_id == cell_id, LABEL.c.quarantined == sa.false())


def outcome_query(cell_id: str) -> Query:
    """How many decisions that the model was certain of, by action, prediction, audit and label."""
    kind = (*DECISION.c["action", "predicted", "audit"], LABEL.c.success)
    certain = (DECISION.c.action != Action.VERIFY.value) | DECISION.c.audit
    query = sa.select(*kind, sa.func.count()).select_from(WITH_LABELS)
    return query.where(DECISION.c.cell_id == cell_id, certain).group_by(*kind)


def kind_query(cell_id: str) -> Query:
    """How many decisions, by action, reason and quarantine; and the times of the first and the last."""
    kind = DECISION.c["action", "reason", "quarantined"]
    times = (sa.func.min(DECISION.c.time).label("first"), sa.func.max(DECISION.c.time).label("last"))
    return sa.select(*kind, sa.func.count(), *times).where(DECISION.c.cell_id == cell_id).group_by(*kind)


def source_query(cell_id: str) -> Query:
    """How many labels, by source; and the time of the last."""
    query = sa.select(LABEL.c.source, sa.func.count().label("n"), sa.func.max(LABEL.c.time).label("last"))
    return query.where(LABEL.c.cell_id == cell_id).group_by(LABEL.c.source)


def version_query(scope: Scope) -> Query:
    """The newest accepted version."""
    query = sa.select(*VERSION.c["cell_id", "version", "last_seq", "state"])
    query = query.where(scope.shared(VERSION.c.cell_id), VERSION.c.accepted == sa.true())
    if scope.product is not None:  # by its number, or the arrays of all versions would be read to be sorted
        newest = newest_of(scope.product, VERSION.c.retrain, VERSION.c.accepted == sa.true())
        query = query.where(VERSION.c.retrain == newest.scalar_subquery())
    return query.order_by(VERSION.c.retrain.desc()).limit(1)


def retrain_query(scope: Scope) -> Query:
    """Every retrain, oldest first, with the fields of `RetrainReport`."""
    query = sa.select(*VERSION.c["version", "seconds", "n_traces", "n_steps", "accepted", "reason"])
    return query.where(scope.shared(VERSION.c.cell_id)).order_by(VERSION.c.retrain)


def event_query(cell_id: str, limit: int | None) -> Query:
    """The newest events, newest first, with the fields of `Event`."""
    query = sa.select(*EVENT.c["number", "time", "kind", "text"]).where(EVENT.c.cell_id == cell_id)
    return query.order_by(EVENT.c.number.desc()).limit(limit)
