"""What a store asks its database.

Whose rows a query is about: a cell's own, or those of all cells of its product.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import sqlalchemy as sa

from ..errors import StoreError
from ..records import Action
from .records import FORGOTTEN
from .schema import CORRECTION, DECISION, EVENT, LABEL, PRODUCT_KEY, RESERVED, SCHEMA_KEY, SETTING, TRACE, VERSION

PRODUCT_LOCKS = 7236482515  # seed of the locks' numbers, so that they are nobody else's


@dataclass(frozen=True)
class Scope:
    """A cell, and its product, if it has one.

    What is learned belongs to the product: labels as traces to train on, and versions. One sequence numbers each over all
    of the product's cells. What was decided, and what became of it, belongs to the cell.
    """

    cell_id: str
    product: str | None = None

    def shared(self, column: sa.Column[Any]) -> sa.ColumnElement[bool]:
        """Whether a row belongs to what this cell shares, by the row's cell_id; without a product its own rows."""
        return column == self.cell_id if self.product is None else column.in_(cells_of(self.product))

    def next_number(self, connection: sa.Connection, column: sa.Column[Any]) -> int:
        """Lock the product or the cell, then number the next row of a table."""
        self.lock_cell(connection)  # always before the product, as the ledger does: else two would wait for each other
        if self.product is None or column.table is EVENT:
            newest: Any = sa.select(sa.func.max(column)).where(column.table.c.cell_id == self.cell_id)
        else:
            lock_product(connection, self.product)
            newest = newest_of(self.product, column)
        return (connection.execute(newest).scalar() or 0) + 1

    def next_version(self, connection: sa.Connection, version: int, accepted: bool) -> int:
        """The number of a version that was trained, under the lock of `next_number`: a sister's may have come before."""
        if self.product is None or not accepted:
            return version
        newest = newest_of(self.product, VERSION.c.version, VERSION.c.accepted == sa.true())
        return max(version, (connection.execute(newest).scalar() or 0) + 1)

    def lock_cell(self, connection: sa.Connection) -> None:
        # PostgreSQL; SQLite's BEGIN IMMEDIATE did it already.
        mine = (SETTING.c.cell_id == self.cell_id) & (SETTING.c.key == SCHEMA_KEY)
        connection.execute(sa.select(SETTING).where(mine).with_for_update())


def lock_product(connection: sa.Connection, product: str) -> None:
    """Hold a product until the transaction ends, so that its numbers are committed in their order."""
    if connection.dialect.name == "postgresql":  # SQLite's BEGIN IMMEDIATE did it already
        lock = sa.text("SELECT pg_advisory_xact_lock(hashtextextended(:product, :seed))")
        connection.execute(lock, {"product": product, "seed": PRODUCT_LOCKS})


def cells_of(product: str) -> sa.Select[Any]:
    """The cells of a product."""
    return sa.select(SETTING.c.cell_id).where(SETTING.c.key == PRODUCT_KEY, SETTING.c.value == product)


@lru_cache(maxsize=100)  # of a few products and columns: to write the statement takes longer than to answer it
def newest_of(product: str, column: sa.Column[Any], *more: sa.ColumnElement[bool]) -> sa.Select[Any]:
    """The largest number in a column over a product's cells: a step down the index for each, of however many rows."""
    table, sister = column.table, cells_of(product).subquery()
    order = VERSION.c.retrain if table is VERSION else column  # the index's own order, in which versions increase too
    query = sa.select(column).where(table.c.cell_id == sister.c.cell_id, *more)
    each = query.order_by(order.desc()).limit(1).correlate(sister).scalar_subquery()
    return sa.select(sa.func.max(each)).select_from(sister)


def join_product(connection: sa.Connection, cell_id: str, product: str | None) -> str | None:
    """The product of a cell; a new cell enters the one that is named.

    Raises StoreError for a cell of another product, and for one that has worked without: its labels have other numbers.
    """
    mine = SETTING.c.cell_id == cell_id
    query = sa.select(SETTING.c.value).where(mine, SETTING.c.key == PRODUCT_KEY)
    held: str | None = connection.execute(query).scalar()
    if product is None or held == product:
        return held
    if held is not None:
        raise StoreError(
            f"Expected product {held!r} of cell {cell_id!r}, got {product!r}; leave it out, or name another cell."
        )
    if not product.strip() or not product.isprintable():
        raise StoreError(f"Expected a product's name of printable characters, got {product!r}.")
    settings = connection.execute(sa.select(SETTING.c.key).where(mine, SETTING.c.key.not_in(RESERVED))).first()
    label = connection.execute(sa.select(LABEL.c.seq).where(LABEL.c.cell_id == cell_id).limit(1)).first()
    if settings is not None or label is not None:
        raise StoreError(
            f"Expected a new cell for product {product!r}, got {cell_id!r}, which has worked without a product; "
            "name a new cell, and bring its labels over by an import."
        )
    lock_product(connection, product)
    connection.execute(sa.insert(SETTING), {"cell_id": cell_id, "key": PRODUCT_KEY, "value": product})
    return product


Query = sa.Select[Any]

INSERTED = {"sqlite": "decision.rowid", "postgresql": "decision.ctid"}  # in the order of insertion: rows never change
LABEL_OF_DECISION = (LABEL.c.cell_id == DECISION.c.cell_id) & (LABEL.c.decision_id == DECISION.c.id)
WITH_LABELS = DECISION.outerjoin(LABEL, LABEL_OF_DECISION)


def corrected(corrected_to: int | None = None) -> sa.ColumnElement[int | None]:
    """What the newest correction of a label says: 0, 1 or FORGOTTEN, NULL where there is none; along `correction_of`.

    corrected_to : number of the last correction that counts; None: all do.
    """
    says = sa.func.coalesce(sa.cast(CORRECTION.c.success, sa.Integer), sa.literal_column(str(FORGOTTEN)))
    query = sa.select(says).where(CORRECTION.c.cell_id == LABEL.c.cell_id, CORRECTION.c.decision_id == LABEL.c.decision_id)
    query = query if corrected_to is None else query.where(CORRECTION.c.number <= corrected_to)
    return query.order_by(CORRECTION.c.number.desc()).limit(1).correlate(LABEL).scalar_subquery()


def counted(corrected_to: int | None = None) -> sa.ColumnElement[int | None]:
    """A label as it counts: 0, 1 or FORGOTTEN, NULL where a decision has none."""
    return sa.func.coalesce(corrected(corrected_to), sa.cast(LABEL.c.success, sa.Integer))


def remembered(corrected_to: int | None = None) -> sa.ColumnElement[bool]:
    """Whether a label was not forgotten."""
    return sa.func.coalesce(corrected(corrected_to), 0) != FORGOTTEN


SAID: sa.ColumnElement[int | None] = sa.func.nullif(
    counted(), FORGOTTEN
)  # a label as it counts now: 0, 1, NULL where there is none, or is forgotten


def past_query(cell_id: str) -> Query:
    """Decisions with their labels, without traces; the columns of `read_decision`."""
    labels = (SAID.label("success"), LABEL.c.source, LABEL.c.seq.label("label_seq"), LABEL.c.time.label("label_time"))
    return sa.select(*DECISION.c, *labels).select_from(WITH_LABELS).where(DECISION.c.cell_id == cell_id)


def decision_query(cell_id: str, decision_id: str) -> Query:
    """A decision with its trace, and with its label where it has one."""
    same = (TRACE.c.cell_id == DECISION.c.cell_id) & (TRACE.c.decision_id == DECISION.c.id)
    stored = (TRACE.c.entry.label("trace_entry"), TRACE.c.sum.label("trace_sum"))
    query = past_query(cell_id).add_columns(*TRACE.c["channels", "samples", "data"], *stored)
    return query.join(TRACE, same).where(DECISION.c.id == decision_id)


def ids_query(cell_id: str) -> Query:
    """The ids of every decision."""
    return sa.select(DECISION.c.id).where(DECISION.c.cell_id == cell_id)


def held_query(cell_id: str, ids: Sequence[str]) -> Query:
    """What labels repeat of these decisions, and the labels that they have already."""
    columns = (
        *DECISION.c["id", "content_hash", "quarantined"],
        LABEL.c.success,
        LABEL.c.source,
        counted().label("counted"),
    )
    return sa.select(*columns).select_from(WITH_LABELS).where(DECISION.c.cell_id == cell_id, DECISION.c.id.in_(ids))


def newest_query(
    scope: Scope, limit: int | None, first: int = 1, last: int | None = None, corrected_to: int | None = None
) -> Query:
    """The newest labels that train, newest first, without their traces; along the index `label_training`.

    first, last : sequence numbers between which they lie.  corrected_to : as in `corrected`.
    """
    success = counted(corrected_to).label("success")
    query = sa.select(LABEL.c.seq, success, *LABEL.c["content_hash", "decision_id"])
    query = query.where(scope.shared(LABEL.c.cell_id), LABEL.c.quarantined == sa.false(), remembered(corrected_to))
    query = query if first <= 1 else query.where(LABEL.c.seq >= first)
    query = query if last is None else query.where(LABEL.c.seq <= last)
    return query.order_by(LABEL.c.seq.desc()).limit(limit)


def trace_query(scope: Scope, first: int, last: int) -> Query:
    """The traces of the labels `first` to `last`, the forgotten too, oldest first."""
    same = (TRACE.c.cell_id == LABEL.c.cell_id) & (TRACE.c.decision_id == LABEL.c.decision_id)
    query = sa.select(*TRACE.c, LABEL.c.seq).select_from(LABEL.join(TRACE, same))
    mine = scope.shared(LABEL.c.cell_id) & (LABEL.c.quarantined == sa.false())
    return query.where(mine, LABEL.c.seq.between(first, last)).order_by(LABEL.c.seq)


def news_query(scope: Scope, seq: int, limit: int) -> Query:
    """The first labels after `seq` that train, oldest first, without their traces."""
    mine = scope.shared(LABEL.c.cell_id) & (LABEL.c.quarantined == sa.false()) & (LABEL.c.seq > seq) & remembered()
    query = sa.select(LABEL.c.seq, counted().label("success"), *LABEL.c["content_hash", "decision_id"])
    return query.where(mine).order_by(LABEL.c.seq).limit(limit)


def points_query(cell_id: str, seq: int, model_version: int) -> Query:
    """The points of a version that came with labels after `seq`, oldest first."""
    query = sa.select(*LABEL.c["seq", "point"]).where(LABEL.c.cell_id == cell_id, LABEL.c.seq > seq)
    query = query.where(LABEL.c.model_version == model_version, LABEL.c.point.is_not(None))
    return query.order_by(LABEL.c.seq)


def evidence_query(cell_id: str, seq: int, since: int = 0) -> Query:
    """The bounds of decisions, by versions from `since` on, whose labels came after `seq`, oldest first."""
    label = (LABEL.c.seq, counted().label("success"), LABEL.c.silent)
    query = sa.select(*label, *DECISION.c["lower", "upper", "reason"])
    mine = (LABEL.c.cell_id == cell_id) & (LABEL.c.quarantined == sa.false()) & (LABEL.c.seq > seq)
    mine = mine & remembered() & _by_versions_from(since, DECISION)
    return query.select_from(LABEL.join(DECISION, LABEL_OF_DECISION)).where(mine).order_by(LABEL.c.seq)


def _by_versions_from(since: int, table: sa.Table) -> sa.ColumnElement[bool]:
    return sa.true() if since <= 0 else table.c.model_version >= since


def unreported_query(cell_id: str, dialect: str, since: int = 0) -> Query:
    """The ids of accepted decisions without a label, oldest first; among those of one time in the order of insertion."""
    mine = (DECISION.c.cell_id == cell_id) & (DECISION.c.quarantined == sa.false()) & LABEL.c.seq.is_(None)
    mine = mine & _by_versions_from(since, DECISION)
    query = sa.select(DECISION.c.id).select_from(WITH_LABELS).where(mine, DECISION.c.action == Action.ACCEPT.value)
    return query.order_by(DECISION.c.time, sa.literal_column(INSERTED[dialect]))


def silent_query(cell_id: str, since: int = 0) -> Query:
    """How many accepted parts went on unheard of, by all labels that train."""
    query = sa.select(sa.func.coalesce(sa.func.sum(LABEL.c.silent), 0))
    mine = (LABEL.c.cell_id == cell_id) & (LABEL.c.quarantined == sa.false())
    return query.where(mine, _by_versions_from(since, LABEL))


def outcome_query(cell_id: str, since: int = 0) -> Query:
    """How many decisions that the model was certain of, by action, prediction, audit and label."""
    kind = (*DECISION.c["action", "predicted", "audit"], counted().label("success"))
    certain = ((DECISION.c.action != Action.VERIFY.value) | DECISION.c.audit) & _by_versions_from(since, DECISION)
    each = sa.select(*kind).select_from(WITH_LABELS).where(DECISION.c.cell_id == cell_id, certain).subquery()
    return sa.select(*each.c, sa.func.count()).group_by(*each.c)


def kind_query(cell_id: str) -> Query:
    """How many decisions, by action, reason and quarantine; and the times of the first and the last."""
    kind = DECISION.c["action", "reason", "quarantined"]
    times = (sa.func.min(DECISION.c.time).label("first"), sa.func.max(DECISION.c.time).label("last"))
    return sa.select(*kind, sa.func.count(), *times).where(DECISION.c.cell_id == cell_id).group_by(*kind)


def source_query(cell_id: str) -> Query:
    """How many labels that were not forgotten, by source; and the time of the last."""
    query = sa.select(LABEL.c.source, sa.func.count().label("n"), sa.func.max(LABEL.c.time).label("last"))
    return query.where(LABEL.c.cell_id == cell_id, remembered()).group_by(LABEL.c.source)


def version_query(scope: Scope, retrain: int) -> Query:
    """An accepted version with its state."""
    query = sa.select(*VERSION.c["cell_id", "version", "last_seq", "state", "state_sum"])
    return query.where(scope.shared(VERSION.c.cell_id), VERSION.c.retrain == retrain)


def accepted_query(scope: Scope) -> Query:
    """The accepted versions, newest first, and whether each has its state."""
    query = sa.select(*VERSION.c["retrain", "version"], VERSION.c.state.is_not(None).label("kept"))
    query = query.where(scope.shared(VERSION.c.cell_id), VERSION.c.accepted == sa.true())
    return query.order_by(VERSION.c.retrain.desc())


def held_states_query(scope: Scope) -> Query:
    """The accepted versions that have their states."""
    query = sa.select(*VERSION.c["retrain", "version"])
    return query.where(scope.shared(VERSION.c.cell_id), VERSION.c.accepted == sa.true(), VERSION.c.state.is_not(None))


def versions_query(scope: Scope) -> Query:
    """Every retrain, oldest first, with the size of its state, NULL where it has none."""
    size = sa.func.length(VERSION.c.state).label("n_bytes")
    query = sa.select(*VERSION.c["version", "time", "accepted", "reason"], size)
    return query.where(scope.shared(VERSION.c.cell_id)).order_by(VERSION.c.retrain)


def retrain_query(scope: Scope) -> Query:
    """Every retrain, oldest first, with the fields of `RetrainReport`."""
    query = sa.select(*VERSION.c["version", "seconds", "n_traces", "n_steps", "accepted", "reason"])
    return query.where(scope.shared(VERSION.c.cell_id)).order_by(VERSION.c.retrain)


def event_query(cell_id: str, limit: int | None) -> Query:
    """The newest events, newest first, with the fields of `Event`."""
    columns = EVENT.c["number", "time", "kind", "text", "data", "author"]
    return sa.select(*columns).where(EVENT.c.cell_id == cell_id).order_by(EVENT.c.number.desc()).limit(limit)


def correction_query(scope: Scope, after: int) -> Query:
    """The corrections after number `after`, oldest first, with the fields of `Correction`."""
    own = ("number", "time", "decision_id", "success", "was", "author", "event", "newest_seq")
    same = (LABEL.c.cell_id == CORRECTION.c.cell_id) & (LABEL.c.decision_id == CORRECTION.c.decision_id)
    query = sa.select(*CORRECTION.c[own], LABEL.c.seq).select_from(CORRECTION.join(LABEL, same))
    return query.where(scope.shared(CORRECTION.c.cell_id), CORRECTION.c.number > after).order_by(CORRECTION.c.number)


def corrected_query(cell_id: str) -> Query:
    """What the newest correction of each corrected decision says, NULL where it is forgotten, and how many say so."""
    later = CORRECTION.alias("later")
    newer = (later.c.cell_id == CORRECTION.c.cell_id) & (later.c.decision_id == CORRECTION.c.decision_id)
    newest = ~sa.exists().where(newer, later.c.number > CORRECTION.c.number)
    query = sa.select(CORRECTION.c.success, sa.func.count()).where(CORRECTION.c.cell_id == cell_id, newest)
    return query.group_by(CORRECTION.c.success)


def said_query(cell_id: str, kind: str, text: str) -> Query:
    """Whether an event of these words is there."""
    said = (EVENT.c.cell_id == cell_id) & (EVENT.c.kind == kind) & (EVENT.c.text == text)
    return sa.select(EVENT.c.number).where(said).limit(1)
