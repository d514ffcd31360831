"""Building blocks of the store's SQL queries: which cells' rows are meant, joins, corrected labels.
A query is about one cell's rows or about those of all cells of its product (`Scope`). Most
functions return SQLAlchemy queries and columns and run nothing; `join_product` enters a new cell
into a product. `SqlStore` and `Database` compose their statements from them.
"""

from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from ..errors import StoreError, expect
from ..records import ACTIONS, Action
from .records import FORGOTTEN
from .schema import (
    CORRECTION,
    DECISION,
    EVENT,
    LABEL,
    PRODUCT,
    PRODUCT_KEY,
    SETTING,
    TRACE,
    VERSION,
    Query,
    insert_settings,
    lock,
    read_setting,
    read_settings,
)


@dataclass(frozen=True)
class Scope:
    """A robot cell and its product, if it has one.

    What is learned is shared by a product: labelled traces for training, model versions, and
    corrections. Each is numbered in one sequence over all cells of the product. Decisions and their
    outcomes belong to the cell alone.
    """

    cell_id: str
    product: str | None = None

    def shared(self, column: sa.Column[Any]) -> sa.ColumnElement[bool]:
        """Return the SQL condition that a row's robot cell (`column`) is this one or of its
        product.
        """
        return (
            column == self.cell_id if self.product is None else column.in_(cells_of(self.product))
        )

    def cells(self, connection: sa.Connection) -> list[str]:
        """Return the id of this robot cell first, then those of its product's other cells, sorted.

        A product is robot cells that share labels and versions. Without a product: this cell alone.
        """
        peers = connection.execute(
            cells_of(self.product or "").order_by(SETTING.c.cell_id)
        ).scalars()
        return [self.cell_id, *(cell for cell in peers if cell != self.cell_id)]

    def first_label(self, connection: sa.Connection, window: int) -> int:
        """Return a label number such that the newest `window` training labels are at or after it.

        Labels are numbered in the order in which they came; training labels are those of traces
        that are not quarantined (kept out of training). 1 if there are fewer than `window`. For a
        product (robot cells that share labels and versions) the labels are not read, and the number
        is an estimate, the newest number + 1 - 2 * `window`: it may be below 1, and is too high if
        more than half of the newest labels are no training labels.
        """
        if self.product is not None:  # by their numbers, or all would be read to be sorted
            return self.newest(connection, LABEL.c.seq) + 1 - 2 * window
        query = (
            sa.select(LABEL.c.seq)
            .where(LABEL.c.cell_id == self.cell_id, TRAINS)
            .order_by(LABEL.c.seq.desc())
            .limit(1)
            .offset(window - 1)
        )
        return connection.execute(query).scalar() or 1

    def next_number(self, connection: sa.Connection, column: sa.Column[Any]) -> int:
        """Return the number of the next row of a table; nobody else gets it before the commit.

        `column` is the table's column of numbers, and `connection` is in a write transaction that
        has locked the robot cell. The number is one more than the largest so far. If the cell has a
        product (robot cells that share labels and versions), decisions and events are numbered by
        cell, all other rows by product, and for these this call locks the product until the
        transaction ends. Without a product all rows are numbered by cell.
        """
        if self.product is None or column.table in (DECISION, EVENT):
            return Scope(self.cell_id).newest(connection, column) + 1
        lock(connection, PRODUCT, self.product)
        return self.newest(connection, column) + 1

    def newest(
        self, connection: sa.Connection, column: sa.Column[Any], *conditions: sa.ColumnElement[bool]
    ) -> int:
        """Return the largest number in a column over the cell's rows.

        `column` has a table's row numbers. If the robot cell has a product (robot cells that share
        labels and versions), the rows of all its cells count; in the table of versions each cell's
        newest retrain that fulfils the conditions counts then, so `column` must increase with the
        table's column `retrain`. With `conditions`, only over the rows that fulfil them all. 0 if
        there is none.
        """
        table = column.table
        if self.product is None:
            query = sa.select(sa.func.max(column)).where(
                table.c.cell_id == self.cell_id, *conditions
            )
        else:
            peer = cells_of(self.product).subquery()
            # For each cell the database reads the index from its end, one row if the conditions
            # hold there. The index of versions is that of their retrains.
            order = VERSION.c.retrain if table is VERSION else column
            of_peer = sa.select(column).where(table.c.cell_id == peer.c.cell_id, *conditions)
            newest = of_peer.order_by(order.desc()).limit(1).correlate(peer).scalar_subquery()
            query = sa.select(sa.func.max(newest)).select_from(peer)
        return connection.execute(query).scalar() or 0

    def newest_version(self, connection: sa.Connection) -> int:
        """Return the number of the newest version that was put in force; 0 before the first.

        If the robot cell has a product, the versions of all cells of the product count.
        """
        return self.newest(connection, VERSION.c.version, VERSION.c.accepted == sa.true())


def cells_of(product: str) -> Query:
    """Return the query for the ids of a product's robot cells, in no order; it is not run."""
    return sa.select(SETTING.c.cell_id).where(
        SETTING.c.key == PRODUCT_KEY, SETTING.c.value == product
    )


def join_product(connection: sa.Connection, cell_id: str, product: str | None) -> str | None:
    """Return a cell's product, or None; make a new robot cell a cell of `product`.

    Cells of one product share labels and trained models. A new cell gets a row in the table
    `setting`, and the product is locked until the transaction ends; nothing is committed. If the
    cell has this product already, nothing is changed.

    Parameters
    ----------
    connection : sqlalchemy.Connection
        In a write transaction.
    cell_id : str
    product : str or None
        What the cell makes. None: what the store says, and nothing is written.

    Raises
    ------
    StoreError
        If the cell has another product. For a cell without a product, if the name is blank or not
        printable, and if the cell has labels already, or settings other than those that the store
        itself keeps (`RESERVED`), because its labels were numbered without those of the other
        cells.
    """
    stored = read_setting(connection, cell_id, PRODUCT_KEY)
    if product is None or stored == product:
        return stored
    expect(
        stored is None,
        f"product {stored!r} of cell {cell_id!r}",
        product,
        "leave it out, or name another cell",
        StoreError,
    )
    expect(
        bool(product.strip()) and product.isprintable(),
        "a product's name of printable characters",
        product,
        error=StoreError,
    )
    has_labels = Scope(cell_id).newest(connection, LABEL.c.seq) > 0
    expect(
        not (has_labels or read_settings(connection, cell_id)),
        f"a new cell for product {product!r}",
        cell_id,
        "it has worked without a product: name a new cell, and bring its labels over by an import",
        StoreError,
    )
    lock(connection, PRODUCT, product)
    insert_settings(connection, cell_id, {PRODUCT_KEY: product})
    return product


LABEL_OF_DECISION = (LABEL.c.cell_id == DECISION.c.cell_id) & (LABEL.c.decision_id == DECISION.c.id)
TRAINS = LABEL.c.quarantined == sa.false()
CORRECTION_OF_LABEL = (CORRECTION.c.cell_id == LABEL.c.cell_id) & (
    CORRECTION.c.decision_id == LABEL.c.decision_id
)
WITH_LABELS = DECISION.outerjoin(LABEL, LABEL_OF_DECISION)
TRACE_OF_LABEL = (TRACE.c.cell_id == LABEL.c.cell_id) & (TRACE.c.decision_id == LABEL.c.decision_id)
TRACE_OF_DECISION = (TRACE.c.cell_id == DECISION.c.cell_id) & (TRACE.c.decision_id == DECISION.c.id)
WITH_TRACES = DECISION.outerjoin(TRACE, TRACE_OF_DECISION)


def corrected_label(corrected_to: int | None = None) -> sa.ColumnElement[int | None]:
    """Return the SQL column of a label after corrections: 0, 1 or FORGOTTEN (2).

    FORGOTTEN is a label that a person has withdrawn; without a label the column is NULL. The newest
    correction of a label counts. The query that uses the column must have the table `label`.

    Parameters
    ----------
    corrected_to : int or None
        Only corrections up to this number are applied; None: all are.
    """
    value = sa.func.coalesce(
        sa.cast(CORRECTION.c.success, sa.Integer), sa.literal_column(str(FORGOTTEN))
    )
    query = sa.select(value).where(CORRECTION_OF_LABEL)  # along the index `correction_of`
    query = query if corrected_to is None else query.where(CORRECTION.c.number <= corrected_to)
    newest = query.order_by(CORRECTION.c.number.desc()).limit(1).correlate(LABEL).scalar_subquery()
    return sa.func.coalesce(newest, sa.cast(LABEL.c.success, sa.Integer))


# Two columns of a decision, by which a decision rule tells audits (checks of parts that the model
# would have decided without a check) from other checks. `predicted` is what the model alone would
# have done, as an `ActionCode`: 0 verify, 1 accept, 2 reject. `inclusion_probability` is
# `Decision.propensity`, the probability with which the part was to be verified (checked), if the
# action is VERIFY, else 0.
AUDIT_COLUMNS = (
    sa.case(
        {action.value: position for position, action in enumerate(ACTIONS)},
        value=DECISION.c.predicted,
    ).label("predicted"),
    sa.case((DECISION.c.action == Action.VERIFY.value, DECISION.c.propensity), else_=0.0).label(
        "inclusion_probability"
    ),
)

# The label after corrections: 0 or 1; NULL if there is none, or it was forgotten.
SUCCESS: sa.Label[int | None] = sa.func.nullif(corrected_label(), FORGOTTEN).label("success")

# Where a label comes from, after corrections: an accepted part that silence confirmed, and that is
# known to be bad, is one of a stop, which came late.
SOURCE: sa.Label[str | None] = sa.case(
    (
        (LABEL.c.source == sa.literal_column("'confirmed'"))
        & (corrected_label() == sa.literal_column("0")),
        sa.literal_column("'stop'"),
    ),
    else_=LABEL.c.source,
).label("source")
