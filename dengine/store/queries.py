"""Whose rows a query is about, a cell's own or those of all cells of its product, and what several queries are made of."""

from dataclasses import dataclass
from functools import lru_cache, reduce
from typing import Any

import sqlalchemy as sa

from ..errors import StoreError, expect
from ..records import ACTIONS, Action, Reason
from .records import FORGOTTEN
from .schema import CORRECTION, DECISION, EVENT, LABEL, PRODUCT, PRODUCT_KEY, RESERVED, SETTING, TRACE, VERSION, hold


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
        """The cells whose rows it shares, its own first, the others by name."""
        peers = connection.execute(cells_of(self.product or "").order_by(SETTING.c.cell_id)).scalars()
        return [self.cell_id, *(cell for cell in peers if cell != self.cell_id)]

    def first_label(self, connection: sa.Connection, window: int) -> int:
        """Number of a label; the newest `window` labels that train are that one and later ones."""
        if self.product is not None:  # by their numbers, or all would be read to be sorted
            return self.newest(connection, LABEL.c.seq) + 1 - 2 * window
        train = (LABEL.c.cell_id == self.cell_id) & (LABEL.c.quarantined == sa.false())
        query = sa.select(LABEL.c.seq).where(train).order_by(LABEL.c.seq.desc()).limit(1).offset(window - 1)
        return connection.execute(query).scalar() or 1

    def next_number(self, connection: sa.Connection, column: sa.Column[Any]) -> int:
        """Number the next row of a table, as nobody else does until the transaction ends: the product is locked."""
        if self.product is None or column.table in (DECISION, EVENT):
            return Scope(self.cell_id).newest(connection, column) + 1
        hold(connection, PRODUCT, self.product)
        return self.newest(connection, column) + 1

    def newest(self, connection: sa.Connection, column: sa.Column[Any], *more: sa.ColumnElement[bool]) -> int:
        """The largest number in a column of what it shares; 0: there is none."""
        if self.product is not None:
            return connection.execute(newest_of(self.product, column, *more)).scalar() or 0
        mine = column.table.c.cell_id == self.cell_id
        return connection.execute(sa.select(sa.func.max(column)).where(mine, *more)).scalar() or 0

    def newest_version(self, connection: sa.Connection) -> int:
        """Number of the newest accepted version; 0 before the first."""
        return self.newest(connection, VERSION.c.version, VERSION.c.accepted == sa.true())


def cells_of(product: str) -> sa.Select[Any]:
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
    expect(held is None, f"product {held!r} of cell {cell_id!r}", product, "leave it out, or name another cell", StoreError)
    named = bool(product.strip()) and product.isprintable()
    expect(named, "a product's name of printable characters", product, error=StoreError)
    settings = connection.execute(sa.select(SETTING.c.key).where(mine, SETTING.c.key.not_in(RESERVED))).first()
    label = connection.execute(sa.select(LABEL.c.seq).where(LABEL.c.cell_id == cell_id).limit(1)).first()
    do = "it has worked without a product: name a new cell, and bring its labels over by an import"
    expect(settings is None and label is None, f"a new cell for product {product!r}", cell_id, do, StoreError)
    hold(connection, PRODUCT, product)
    connection.execute(sa.insert(SETTING), {"cell_id": cell_id, "key": PRODUCT_KEY, "value": product})
    return product


LABEL_OF_DECISION = (LABEL.c.cell_id == DECISION.c.cell_id) & (LABEL.c.decision_id == DECISION.c.id)
WITH_LABELS = DECISION.outerjoin(LABEL, LABEL_OF_DECISION)
TRACE_OF_DECISION = (TRACE.c.cell_id == DECISION.c.cell_id) & (TRACE.c.decision_id == DECISION.c.id)
WITH_TRACES = DECISION.outerjoin(TRACE, TRACE_OF_DECISION)


def counted(corrected_to: int | None = None) -> sa.ColumnElement[int | None]:
    """A label as it counts, by its newest correction, along `correction_of`: 0, 1 or FORGOTTEN, NULL where there is none.

    corrected_to : number of the last correction that counts; None: all do.
    """
    says = sa.func.coalesce(sa.cast(CORRECTION.c.success, sa.Integer), sa.literal_column(str(FORGOTTEN)))
    query = sa.select(says).where(CORRECTION.c.cell_id == LABEL.c.cell_id, CORRECTION.c.decision_id == LABEL.c.decision_id)
    query = query if corrected_to is None else query.where(CORRECTION.c.number <= corrected_to)
    newest = query.order_by(CORRECTION.c.number.desc()).limit(1).correlate(LABEL).scalar_subquery()
    return sa.func.coalesce(newest, sa.cast(LABEL.c.success, sa.Integer))


def audit_columns() -> tuple[sa.ColumnElement[int], sa.ColumnElement[float]]:
    """What the model alone would have done, as a position in `ACTIONS`, and `Decision.inclusion_probability`."""
    positions = {action.value: position for position, action in enumerate(ACTIONS)}
    asked = sa.case((DECISION.c.action == Action.VERIFY.value, DECISION.c.propensity), else_=0.0)
    return sa.case(positions, value=DECISION.c.predicted).label("predicted"), asked.label("inclusion_probability")


SAID: sa.ColumnElement[int | None] = sa.func.nullif(counted(), FORGOTTEN)  # as it counts now; NULL: none, or forgotten


# Where a label comes from, as it counts now: an accepted part that was confirmed, and is known to be
# bad, is one of a stop, which came late.
_CONFIRMED: sa.ColumnElement[str] = sa.literal_column("'confirmed'")
_STOP: sa.ColumnElement[str] = sa.literal_column("'stop'")
_BAD: sa.ColumnElement[int] = sa.literal_column("0")
SOURCE: sa.ColumnElement[str | None] = sa.case(
    ((LABEL.c.source == _CONFIRMED) & (counted() == _BAD), _STOP), else_=LABEL.c.source
)


def past_query(cell_id: str) -> sa.Select[Any]:
    """Decisions with their labels, without traces; the columns of `read_decision`."""
    labels = (
        SAID.label("success"),
        SOURCE.label("source"),
        LABEL.c.seq.label("label_seq"),
        LABEL.c.time.label("label_time"),
    )
    return sa.select(*DECISION.c, *labels).select_from(WITH_LABELS).where(DECISION.c.cell_id == cell_id)


def training_query(scope: Scope, corrected_to: int | None = None) -> sa.Select[Any]:
    """The labels that train, without their traces; along the index `label_training`."""
    label = counted(corrected_to)
    query = sa.select(LABEL.c.seq, label.label("success"), *LABEL.c["content_hash", "decision_id"])
    return query.where(scope.shared(LABEL.c.cell_id), LABEL.c.quarantined == sa.false(), label != FORGOTTEN)


def n_decisions(cell_id: str) -> sa.ScalarSelect[int]:
    """Number of a cell's newest decision."""
    every = DECISION.alias("every")
    return sa.select(sa.func.max(every.c.number)).where(every.c.cell_id == cell_id).scalar_subquery()


def stretches_query(cell_id: str, length: int, seconds: float = 0.0, start: float = 0.0, batch: str = "") -> sa.Select[Any]:
    """All decisions counted in stretches of one length, oldest first; the columns of `Stretch`.

    batch : by the beginnings of parts' numbers instead, "5" characters, or up to the last of "-/".  seconds : or of time.
    """
    number = sa.func.row_number().over(order_by=DECISION.c.number) - 1
    columns = (*DECISION.c["cell_id", "id", "time", "action", "reason", "part"], number.label("number"))
    every = sa.select(*columns).where(DECISION.c.cell_id == cell_id).subquery("every")
    of = (LABEL.c.cell_id == every.c.cell_id) & (LABEL.c.decision_id == every.c.id)
    verified, accepted, rejected = (every.c.action == action.value for action in Action)
    novel, outside = (every.c.reason == reason.value for reason in (Reason.NOVEL, Reason.OUTSIDE))
    which = (verified, novel, accepted, accepted & (SAID == 0), rejected & ~outside, outside)
    counts: list[sa.ColumnElement[Any]] = [sa.func.sum(sa.case((each, 1), else_=0)) for each in which]
    query = sa.select(*[sa.func.count(), sa.func.max(every.c.time), *counts]).select_from(every.outerjoin(LABEL, of))
    part: Any = every.c.part
    others = reduce(lambda text, each: sa.func.replace(text, each, ""), batch, part)
    name = sa.func.substr(part, 1, int(batch)) if batch.isdecimal() else sa.func.rtrim(part, others) if batch else sa.null()
    timed = sa.func.floor((every.c.time - start) / seconds) if seconds else every.c.number - every.c.number % length
    return query.add_columns(name).group_by(name if batch else timed).order_by(sa.func.max(every.c.number))
