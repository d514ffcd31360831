"""Schema 3: corrections, what events tell machines, and a ledger that chains all rows of a cell.

What was there before the ledger is chained as its first entry.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import Any

import sqlalchemy as sa
from alembic import op

from dengine.store import ledger as chain
from dengine.store.ledger import START, added_text, row_sum, settings_text, state_sum

revision, down_revision = "0003", "0002"

KEYS = {"decision": "id", "trace": "decision_id", "label": "decision_id", "model_version": "retrain", "event": "number"}
CHUNK = 500  # rows held at a time


def upgrade() -> None:
    """Add the columns and the tables, and chain every cell's rows."""
    op.add_column("event", sa.Column("data", sa.Text))
    op.add_column("event", sa.Column("author", sa.String, nullable=False, server_default=sa.text("''")))
    for table in KEYS:
        op.add_column(table, sa.Column("entry", sa.BigInteger))
        op.add_column(table, sa.Column("sum", sa.LargeBinary))
    op.add_column("model_version", sa.Column("state_sum", sa.LargeBinary))
    op.create_table(
        "correction",
        sa.Column("cell_id", sa.String, primary_key=True),
        sa.Column("number", sa.BigInteger, primary_key=True, autoincrement=False),
        sa.Column("time", sa.Double, nullable=False),
        sa.Column("decision_id", sa.String, nullable=False),
        *(sa.Column(name, sa.Boolean) for name in ("success", "was")),
        sa.Column("author", sa.String, nullable=False),
        *(sa.Column(name, sa.BigInteger, nullable=False) for name in ("event", "newest_seq")),
        sa.Column("entry", sa.BigInteger),
        sa.Column("sum", sa.LargeBinary),
    )
    op.create_index("correction_of", "correction", ["cell_id", "decision_id", "number"])
    op.create_index("decision_time", "decision", ["cell_id", "time", "id"], if_not_exists=True)
    op.create_table(
        "ledger",
        sa.Column("cell_id", sa.String, primary_key=True),
        sa.Column("number", sa.BigInteger, primary_key=True, autoincrement=False),
        sa.Column("time", sa.Double, nullable=False),
        sa.Column("added", sa.Text, nullable=False),
        sa.Column("settings", sa.Text),
        sa.Column("digest", sa.LargeBinary, nullable=False),
    )
    connection = op.get_bind()
    for cell in connection.execute(sa.text("SELECT DISTINCT cell_id FROM setting")).scalars().all():
        _chain(connection, cell)


def _chain(connection: sa.Connection, cell: str) -> None:
    """Write the first entry of a cell, over all that it holds."""
    sums = {table: _sum_rows(connection, table, cell) for table in KEYS}
    sums = {table: found for table, found in sums.items() if found}
    query = sa.text("SELECT key, value FROM setting WHERE cell_id = :cell AND key <> 'schema_version'")
    settings = {row.key: row.value for row in connection.execute(query, {"cell": cell})}
    if not (sums or settings):
        return
    head = {"cell_id": cell, "number": 1, "time": time.time(), "added": added_text(sums)}
    head |= {"settings": settings_text(settings)}
    names = ("cell_id", "number", "time", "added", "settings", "digest")
    ledger = sa.table("ledger", *(sa.column(name) for name in names))
    connection.execute(sa.insert(ledger), head | {"digest": chain.entry_digest(START, head, sums)})


def _sum_rows(connection: sa.Connection, table: str, cell: str) -> list[bytes]:
    """Give each row of a cell its entry and its sum."""
    own = "entry = :entry, sum = :sum" + (", state_sum = :state_sum" if table == "model_version" else "")
    change = sa.text(f"UPDATE {table} SET {own} WHERE cell_id = :cell_id AND {KEYS[table]} = :{KEYS[table]}")
    sums = []
    for rows in _parts(connection, table, cell):
        for row in rows:
            row["entry"] = 1
            if table == "model_version":
                row["state_sum"] = state_sum(row["state"])
            row["sum"] = row_sum(table, row)
        names = {"cell_id", KEYS[table], "entry", "sum", *(["state_sum"] if table == "model_version" else [])}
        connection.execute(change, [{name: row[name] for name in names} for row in rows])
        sums += [row["sum"] for row in rows]
    return sums


def _parts(connection: sa.Connection, table: str, cell: str) -> Iterator[Sequence[dict[str, Any]]]:
    """A cell's rows as the database holds them, in the order of their keys, CHUNK at a time."""
    key = KEYS[table]
    first = sa.text(f"SELECT * FROM {table} WHERE cell_id = :cell ORDER BY {key} LIMIT {CHUNK}")
    more = sa.text(f"SELECT * FROM {table} WHERE cell_id = :cell AND {key} > :last ORDER BY {key} LIMIT {CHUNK}")
    rows = [dict(row._mapping) for row in connection.execute(first, {"cell": cell})]
    while rows:
        yield rows
        rows = [dict(row._mapping) for row in connection.execute(more, {"cell": cell, "last": rows[-1][key]})]
