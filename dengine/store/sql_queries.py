"""What a store asks its database: the queries over several tables."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa

from .sql_tables import DECISION, LABEL, TRACE

Query = sa.Select[Any]


def decision_query(cell_id: str, decision_id: str) -> Query:
    """A decision with its trace, and with its label where it has one."""
    mine = (DECISION.c.cell_id == cell_id) & (DECISION.c.id == decision_id)
    traces = (TRACE.c.cell_id == DECISION.c.cell_id) & (TRACE.c.decision_id == DECISION.c.id)
    labels = (LABEL.c.cell_id == DECISION.c.cell_id) & (LABEL.c.decision_id == DECISION.c.id)
    columns = (*DECISION.c, *TRACE.c["channels", "samples", "data"], LABEL.c.success, LABEL.c.source)
    return sa.select(*columns).select_from(DECISION.join(TRACE, traces).outerjoin(LABEL, labels)).where(mine)


def newest_query(cell_id: str, limit: int | None) -> Query:
    """The newest labels that train, newest first, without their traces; along the index `label_training`."""
    query = sa.select(*LABEL.c["seq", "success", "content_hash"])
    query = query.where(LABEL.c.cell_id == cell_id, LABEL.c.quarantined == sa.false())
    return query.order_by(LABEL.c.seq.desc()).limit(limit)


def trace_query(cell_id: str, first: int, last: int) -> Query:
    """The traces of the labels `first` to `last` that train, oldest first."""
    same = (TRACE.c.cell_id == LABEL.c.cell_id) & (TRACE.c.decision_id == LABEL.c.decision_id)
    query = sa.select(*TRACE.c["channels", "samples", "data"]).select_from(LABEL.join(TRACE, same))
    mine = (LABEL.c.cell_id == cell_id) & (LABEL.c.quarantined == sa.false())
    return query.where(mine, LABEL.c.seq.between(first, last)).order_by(LABEL.c.seq)


def points_query(cell_id: str, seq: int, model_version: int) -> Query:
    """The points of a version that came with labels after `seq`, oldest first."""
    query = sa.select(*LABEL.c["seq", "point"]).where(LABEL.c.cell_id == cell_id, LABEL.c.seq > seq)
    query = query.where(LABEL.c.model_version == model_version, LABEL.c.point.is_not(None))
    return query.order_by(LABEL.c.seq)


def evidence_query(cell_id: str, seq: int) -> Query:
    """The bounds of decisions whose labels came after `seq`, with those labels, oldest first."""
    same = (DECISION.c.cell_id == LABEL.c.cell_id) & (DECISION.c.id == LABEL.c.decision_id)
    query = sa.select(LABEL.c.seq, DECISION.c.lower, DECISION.c.upper, LABEL.c.success)
    mine = (LABEL.c.cell_id == cell_id) & (LABEL.c.quarantined == sa.false()) & (LABEL.c.seq > seq)
    return query.select_from(LABEL.join(DECISION, same)).where(mine).order_by(LABEL.c.seq)
