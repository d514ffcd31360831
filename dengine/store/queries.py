"""Whose rows a query is about, a cell's own or those of all cells of its product, and what several queries are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import sqlalchemy as sa

from ..errors import StoreError
from ..records import ACTIONS, Action, Reason
from .records import FORGOTTEN
from .schema import CORRECTION, DECISION, EVENT, LABEL, PRODUCT_KEY, RESERVED, SCHEMA_KEY, SETTING, VERSION
from .views import LABELS, HistoryFilter

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

    def cells(self, connection: sa.Connection) -> list[str]:
        """The cells whose rows it shares, its own first."""
        peers = connection.execute(cells_of(self.product or "")).scalars()
        return [self.cell_id, *(cell for cell in peers if cell != self.cell_id)]

    def first_label(self, connection: sa.Connection, window: int) -> int:
        """Number of a label; the newest `window` labels that train are that one and later ones."""
        if self.product is not None:  # by their numbers, or all would be read to be sorted
            return (connection.execute(newest_of(self.product, LABEL.c.seq)).scalar() or 0) + 1 - 2 * window
        train = (LABEL.c.cell_id == self.cell_id) & (LABEL.c.quarantined == sa.false())
        query = sa.select(LABEL.c.seq).where(train).order_by(LABEL.c.seq.desc()).limit(1).offset(window - 1)
        return connection.execute(query).scalar() or 1

    def next_number(self, connection: sa.Connection, column: sa.Column[Any]) -> int:
        """Lock the product or the cell, then number the next row of a table."""
        self.lock_cell(connection)  # always before the product, as the ledger does: else two would wait for each other
        if self.product is None or column.table in (DECISION, EVENT):
            newest: Any = sa.select(sa.func.max(column)).where(column.table.c.cell_id == self.cell_id)
        else:
            lock_product(connection, self.product)
            newest = newest_of(self.product, column)
        return (connection.execute(newest).scalar() or 0) + 1

    def next_version(self, connection: sa.Connection, version: int, accepted: bool) -> int:
        """The number of a version that was trained, under the lock of `next_number`: a peer's may have come before."""
        if self.product is None or not accepted:
            return version
        newest = newest_of(self.product, VERSION.c.version, VERSION.c.accepted == sa.true())
        return max(version, (connection.execute(newest).scalar() or 0) + 1)

    def lock_cell(self, connection: sa.Connection) -> None:
        """Hold the cell until the transaction ends: two processes may write to it."""
        if connection.dialect.name == "postgresql":  # SQLite's BEGIN IMMEDIATE did it already
            mine = (SETTING.c.cell_id == self.cell_id) & (SETTING.c.key == SCHEMA_KEY)
            connection.execute(sa.select(SETTING.c.key).where(mine).with_for_update())


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
    table, peer = column.table, cells_of(product).subquery()
    order = VERSION.c.retrain if table is VERSION else column  # the index's own order, in which versions increase too
    query = sa.select(column).where(table.c.cell_id == peer.c.cell_id, *more)
    each = query.order_by(order.desc()).limit(1).correlate(peer).scalar_subquery()
    return sa.select(sa.func.max(each)).select_from(peer)


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


LABEL_OF_DECISION = (LABEL.c.cell_id == DECISION.c.cell_id) & (LABEL.c.decision_id == DECISION.c.id)
WITH_LABELS = DECISION.outerjoin(LABEL, LABEL_OF_DECISION)


def _corrected(corrected_to: int | None = None) -> sa.ColumnElement[int | None]:
    """What the newest correction of a label says: 0, 1 or FORGOTTEN, NULL where there is none; along `correction_of`.

    corrected_to : number of the last correction that counts; None: all do.
    """
    says = sa.func.coalesce(sa.cast(CORRECTION.c.success, sa.Integer), sa.literal_column(str(FORGOTTEN)))
    query = sa.select(says).where(CORRECTION.c.cell_id == LABEL.c.cell_id, CORRECTION.c.decision_id == LABEL.c.decision_id)
    query = query if corrected_to is None else query.where(CORRECTION.c.number <= corrected_to)
    return query.order_by(CORRECTION.c.number.desc()).limit(1).correlate(LABEL).scalar_subquery()


def counted(corrected_to: int | None = None) -> sa.ColumnElement[int | None]:
    """A label as it counts: 0, 1 or FORGOTTEN, NULL where a decision has none."""
    return sa.func.coalesce(_corrected(corrected_to), sa.cast(LABEL.c.success, sa.Integer))


def how_looked() -> tuple[sa.ColumnElement[int], sa.ColumnElement[float]]:
    """What the model alone would have done, as a position in `ACTIONS`, and `Decision.looked`."""
    positions = {action.value: position for position, action in enumerate(ACTIONS)}
    asked = sa.case((DECISION.c.action == Action.VERIFY.value, DECISION.c.propensity), else_=0.0)
    return sa.case(positions, value=DECISION.c.predicted).label("predicted"), asked.label("looked")


def remembered(corrected_to: int | None = None) -> sa.ColumnElement[bool]:
    """Whether a label was not forgotten."""
    return sa.func.coalesce(_corrected(corrected_to), 0) != FORGOTTEN


def since(table: sa.Table, version: int) -> sa.ColumnElement[bool]:
    """Rows by model versions from this one on."""
    return sa.true() if version <= 0 else table.c.model_version >= int(version)


SAID: sa.ColumnElement[int | None] = sa.func.nullif(counted(), FORGOTTEN)  # as it counts now; NULL: none, or forgotten


def past_query(cell_id: str) -> sa.Select[Any]:
    """Decisions with their labels, without traces; the columns of `read_decision`."""
    labels = (SAID.label("success"), LABEL.c.source, LABEL.c.seq.label("label_seq"), LABEL.c.time.label("label_time"))
    return sa.select(*DECISION.c, *labels).select_from(WITH_LABELS).where(DECISION.c.cell_id == cell_id)


def held_query(cell_id: str, ids: Sequence[str]) -> sa.Select[Any]:
    """What labels repeat of these decisions, and the labels that they have already."""
    label = (LABEL.c.success, LABEL.c.source, LABEL.c.seq, counted().label("counted"))
    query = sa.select(*DECISION.c["id", "content_hash", "quarantined", "time"], *label).select_from(WITH_LABELS)
    return query.where(DECISION.c.cell_id == cell_id, DECISION.c.id.in_(ids))


def training_query(scope: Scope, corrected_to: int | None = None) -> sa.Select[Any]:
    """The labels that train, without their traces; along the index `label_training`."""
    query = sa.select(LABEL.c.seq, counted(corrected_to).label("success"), *LABEL.c["content_hash", "decision_id"])
    return query.where(scope.shared(LABEL.c.cell_id), LABEL.c.quarantined == sa.false(), remembered(corrected_to))


def decisions_query(cell_id: str, where: HistoryFilter, beyond: str | None, newest: bool) -> sa.Select[Any]:
    """Decisions that are meant, the newest or the oldest first; beyond : only those before, or after, that id."""
    number = DECISION.c.number
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
        one = DECISION.alias("beyond")
        there = sa.select(one.c.number).where(one.c.cell_id == cell_id, one.c.id == beyond).scalar_subquery()
        meant.append(number < there if newest else number > there)
    return past_query(cell_id).where(*meant).order_by(number.desc() if newest else number)


def n_decisions(cell_id: str) -> sa.ScalarSelect[int]:
    """Number of a cell's newest decision."""
    every = DECISION.alias("every")
    return sa.select(sa.func.max(every.c.number)).where(every.c.cell_id == cell_id).scalar_subquery()


def tally_query(cell_id: str, last: int | None, since_version: int, within: int | None) -> sa.Select[Any]:
    """The newest decisions, all where it is None, by versions from that one on, counted by their kinds.

    within : `aged` are those after which as many came.
    """
    columns = ("cell_id", "id", "time", "action", "predicted", "reason", "audit", "quarantined")
    aged = sa.false() if within is None else n_decisions(cell_id) - DECISION.c.number >= within
    newest = sa.select(*DECISION.c[columns], aged.label("aged"))
    newest = newest.where(DECISION.c.cell_id == cell_id, since(DECISION, since_version))
    if last is not None:
        newest = newest.order_by(DECISION.c.number.desc()).limit(last)
    some = newest.subquery("newest")
    of = (LABEL.c.cell_id == some.c.cell_id) & (LABEL.c.decision_id == some.c.id)
    kind = (*some.c["action", "predicted", "reason", "audit", "quarantined", "aged"], SAID.label("success"), LABEL.c.source)
    least, most = sa.func.min, sa.func.max
    times = least(some.c.time).label("first"), most(some.c.time).label("last"), most(LABEL.c.time).label("last_label")
    return sa.select(*kind, sa.func.count().label("n"), *times).select_from(some.outerjoin(LABEL, of)).group_by(*kind)


def stretches_query(cell_id: str, length: int, seconds: float = 0.0, start: float = 0.0, batch: int = 0) -> sa.Select[Any]:
    """All decisions counted in stretches of one length, oldest first; the columns of `Stretch`.

    batch : by so many first characters of the parts' numbers instead; seconds : or by so many of time, from `start` on.
    """
    number = sa.func.row_number().over(order_by=DECISION.c.number) - 1
    columns = (*DECISION.c["cell_id", "id", "time", "action", "reason", "part"], number.label("number"))
    every = sa.select(*columns).where(DECISION.c.cell_id == cell_id).subquery("every")
    of = (LABEL.c.cell_id == every.c.cell_id) & (LABEL.c.decision_id == every.c.id)
    accepted = every.c.action == Action.ACCEPT.value
    verified, novel = every.c.action == Action.VERIFY.value, every.c.reason == Reason.NOVEL.value
    which = (verified, novel, accepted, accepted & (SAID == 0))
    counts: list[sa.ColumnElement[Any]] = [sa.func.sum(sa.case((each, 1), else_=0)) for each in which]
    query = sa.select(*[sa.func.count(), sa.func.max(every.c.time), *counts]).select_from(every.outerjoin(LABEL, of))
    name = sa.func.substr(every.c.part, 1, batch) if batch else sa.null()
    timed = sa.func.floor((every.c.time - start) / seconds) if seconds else every.c.number - every.c.number % length
    return query.add_columns(name).group_by(name if batch else timed).order_by(sa.func.max(every.c.number))
