"""The tables of a store's database, for SQLAlchemy; how they are created, checked and locked. They
are `setting`, `decision`, `trace`, `label`, `model_version`, `event`, `correction` and `ledger`.
Their columns are the fields of the records that they hold (see records.py), and every row belongs
to a cell, `cell_id`. `Database` and the queries use them.
"""

from enum import StrEnum
from typing import Any

import numpy as np
import sqlalchemy as sa

from ..errors import StoreError
from ..records import Decision, RetrainReport
from .records import OF_DECISION, Correction, Event, NewLabel, Settings, StoredDecision, columns

SCHEMA = "1"
# Keys of rows of `setting` that the store itself keeps.
SCHEMA_KEY = "schema_version"  # for every cell
PRODUCT_KEY = "product"  # for every cell that shares what it learns
# For every cell whose ledger is keyed: a tag by which the key is recognized.
LEDGER_KEY = "ledger_key"
RESERVED = (SCHEMA_KEY, PRODUCT_KEY, LEDGER_KEY)
# Kinds of locks, as numbers that no other program uses.
TABLES, PRODUCT, CELL = range(7236482514, 7236482517)

Query = sa.Select[Any]
METADATA = sa.MetaData()
COLUMN_TYPES: dict[type, Any] = {
    str: sa.String,
    int: sa.BigInteger,
    float: sa.Double,
    bool: sa.Boolean,
    tuple: sa.Text,
    dict: sa.Text,
    np.ndarray: sa.LargeBinary,  # float32, little-endian
}


def _columns(record: type, *names: str, key: str = "") -> list[sa.Column[Any]]:
    """Return new SQLAlchemy columns for the fields of a record class: for all, or only for `names`.

    A record class is a dataclass whose objects are stored as rows. A field that may be None becomes
    a column that may be NULL. `key` names the field that is part of the primary key.
    """
    return [
        sa.Column(
            name,
            sa.String if issubclass(type_, StrEnum) else COLUMN_TYPES[type_],
            nullable=optional,
            primary_key=name == key,
        )
        for name, (type_, optional) in columns(record).items()
        if not names or name in names
    ]


def _table(name: str, *parts: Any) -> sa.Table:
    """Return a new table of a robot cell's rows, with the columns and indexes `parts`.

    Added are the columns `cell_id`, part of the primary key; `entry`, the number of the row's entry
    in the ledger (the cell's hash chain); and `sum`, the row's checksum (from `row_sum`). The table
    is entered into METADATA, so that it is created in a new database.
    """
    return sa.Table(
        name,
        METADATA,
        sa.Column("cell_id", sa.String, primary_key=True),
        *parts,
        sa.Column("entry", sa.BigInteger),
        sa.Column("sum", sa.LargeBinary),
    )


SETTING = sa.Table(
    "setting",
    METADATA,
    sa.Column("cell_id", sa.String, primary_key=True),
    sa.Column("key", sa.String, primary_key=True),
    sa.Column("value", sa.String, nullable=False),
)
DECISION = _table(
    "decision",
    *_columns(Decision, key="id"),
    *_columns(StoredDecision, *OF_DECISION),
    # 1, 2, ... in each cell: a clock may be set back
    sa.Column("number", sa.BigInteger, nullable=False),
    sa.Index("decision_number", "cell_id", "number", unique=True),
    sa.Index("decision_time", "cell_id", "time"),
)
TRACE = _table(  # apart from `decision`, so that counting decisions does not read traces
    "trace",
    sa.Column("decision_id", sa.String, primary_key=True),
    sa.Column("channels", sa.Integer, nullable=False),
    sa.Column("samples", sa.Integer, nullable=False),
    # Float32, little-endian, (channels, samples).
    sa.Column("data", sa.LargeBinary, nullable=False),
)
LABEL = _table(
    "label",
    *_columns(NewLabel, key="decision_id"),
    *_columns(StoredDecision, "quarantined"),  # a copy of the decision's, for the index
    sa.UniqueConstraint("cell_id", "seq", name="label_seq"),
    sa.Index("label_training", "cell_id", "quarantined", "seq"),
)
VERSION = _table(  # every retrain, dropped candidates included
    "model_version",
    # 1, 2, ... in each cell, or product
    sa.Column("retrain", sa.BigInteger, primary_key=True),
    sa.Column("time", sa.Double, nullable=False),
    *_columns(RetrainReport),
    sa.Column("last_seq", sa.BigInteger, nullable=False),
    sa.Column("state", sa.LargeBinary),  # npz without pickles; NULL if it was deleted
    # SHA-256 of the state, which stays when the state is deleted
    sa.Column("state_sum", sa.LargeBinary),
    sa.Index("version_accepted", "cell_id", "accepted", "retrain"),
)
EVENT = _table("event", *_columns(Event, key="number"))
CORRECTION = _table(  # the newest of a decision counts
    "correction",
    # Number and hash are the label's.
    *_columns(Correction, *columns(Correction).keys() - {"seq", "content_hash"}, key="number"),
    sa.Index("correction_of", "cell_id", "decision_id", "number"),
)
# Tables whose rows the ledger chains.
CHAINED = {table.name: table for table in (DECISION, TRACE, LABEL, VERSION, EVENT, CORRECTION)}

ADDED = {LABEL.c.overdue_to}  # columns that were added after the first schema
LEDGER = sa.Table(  # an entry for every transaction that added rows or changed settings
    "ledger",
    METADATA,
    sa.Column("cell_id", sa.String, primary_key=True),
    # 1, 2, ... in each cell
    sa.Column("number", sa.BigInteger, primary_key=True),
    sa.Column("time", sa.Double, nullable=False),
    sa.Column("added", sa.Text, nullable=False),  # JSON: number of added rows by table
    sa.Column("rows", sa.LargeBinary, nullable=False),  # digest of these rows' sums: `rows_digest`
    # JSON: the chain over all rows so far of each table in IN_FORCE
    sa.Column("chains", sa.Text, nullable=False),
    sa.Column("settings", sa.Text),  # JSON: all settings, if they changed
    # Over the entry before and this one: `entry_digest`.
    sa.Column("digest", sa.LargeBinary, nullable=False),
)


def lock(connection: sa.Connection, kind: int, name: str = "") -> None:
    """Lock the tables (TABLES), or a robot cell or product by name, until the transaction ends.

    It waits until another transaction gives the lock up. Numbers are then committed in their order.
    To avoid a deadlock take several locks in the order TABLES, PRODUCT, CELL. With SQLite it does
    nothing, since a write transaction already locks the whole file.
    """
    if connection.dialect.name == "postgresql":  # SQLite's BEGIN IMMEDIATE did it already
        statement = sa.text("SELECT pg_advisory_xact_lock(hashtextextended(:name, :kind))")
        connection.execute(statement, {"name": name, "kind": kind})


def prepare_tables(connection: sa.Connection, cell_id: str, name: str) -> None:
    """Create the tables in an empty database, or check that they are those of a store.

    In PostgreSQL the tables of other programs may stand beside them. Columns that later versions of
    dengine added (`ADDED`) are added to the tables of an older store. A new robot cell gets a row
    in the table `setting`, with the version of the schema. The tables are locked until the
    transaction ends, and nothing is committed.

    Parameters
    ----------
    connection : sqlalchemy.Connection
        In a write transaction.
    cell_id : str
    name : str
        Name of the database, for the error.

    Raises
    ------
    StoreError
        For an SQLite file of another program, for another version of the schema, if a table, or a
        column that is not in `ADDED`, is missing, and if there are the tables of a store, but no
        cell.
    """
    lock(connection, TABLES)  # two cells may create them at the same moment
    tables = sa.inspect(connection).get_table_names()
    # A file belongs to one program; a PostgreSQL database may hold other tables beside ours.
    if METADATA.tables.keys() & tables or (tables and connection.dialect.name == "sqlite"):
        _add_columns(connection)
        check_schema(connection, name)
    else:
        METADATA.create_all(connection)
    if read_setting(connection, cell_id, SCHEMA_KEY) is None:
        insert_settings(connection, cell_id, {SCHEMA_KEY: SCHEMA})


def read_settings(connection: sa.Connection, cell_id: str) -> dict[str, str]:
    """Return a cell's settings, by key, without those that the store itself keeps (`RESERVED`).

    {} for an unknown robot cell.
    """
    query = sa.select(SETTING.c.key, SETTING.c.value).where(
        SETTING.c.cell_id == cell_id, SETTING.c.key.not_in(RESERVED)
    )
    return {row.key: row.value for row in connection.execute(query)}


def read_cells(connection: sa.Connection) -> list[str]:
    """Return the names of all robot cells that have used the store, sorted."""
    return sorted(connection.execute(sa.select(SETTING.c.cell_id).distinct()).scalars())


def read_setting(connection: sa.Connection, cell_id: str, key: str) -> str | None:
    """Return a setting of a robot cell, also one that the store itself keeps; None if there is
    none.
    """
    query = sa.select(SETTING.c.value).where(SETTING.c.cell_id == cell_id, SETTING.c.key == key)
    return connection.execute(query).scalar()


def insert_settings(connection: sa.Connection, cell_id: str, settings: Settings) -> None:
    """Insert settings that a robot cell does not have yet, if any; nothing is committed.

    A setting that the cell has already raises SQLAlchemy's IntegrityError.
    """
    rows = [{"cell_id": cell_id, "key": key, "value": value} for key, value in settings.items()]
    if rows:
        connection.execute(sa.insert(SETTING), rows)


def _stored_columns(connection: sa.Connection, table: str) -> set[str]:
    """Return the names of a table's columns in the database; an empty set without the table."""
    inspector = sa.inspect(connection)
    if not inspector.has_table(table):
        return set()
    return {column["name"] for column in inspector.get_columns(table)}


def _add_columns(connection: sa.Connection) -> None:
    """Add to a store's tables the columns that an earlier dengine did not have (those in `ADDED`).

    They are NULL in its rows. A table that has them, or is no table of a store, is not changed.
    """
    for column in ADDED:
        table = column.table.name
        names = _stored_columns(connection, table)
        if names >= {"cell_id", "sum"} and column.name not in names:
            type_ = column.type.compile(connection.dialect)
            connection.exec_driver_sql(f'ALTER TABLE "{table}" ADD COLUMN "{column.name}" {type_}')


def check_schema(connection: sa.Connection, name: str) -> None:
    """Raise a StoreError unless a database holds a store of this schema with all columns.

    The schema has a version, which each cell's settings name; a store without any robot cell is
    refused, too. Columns that a later dengine added to the schema (ADDED) may be missing, and
    others may be there. `name` is the name of the database, for the error.
    """
    is_complete = all(
        {column.name for column in table.c if column not in ADDED}
        <= _stored_columns(connection, table.name)
        for table in METADATA.tables.values()
    )
    schemas: list[str] = []
    if is_complete:
        # The one query over all cells.
        query = sa.select(SETTING.c.value).where(SETTING.c.key == SCHEMA_KEY).distinct()
        schemas = sorted(connection.execute(query).scalars())
    if schemas != [SCHEMA]:
        found = f"schema {', '.join(schemas) or 'unknown'}" if is_complete else "other tables"
        raise StoreError(
            f"Expected a dengine store of schema {SCHEMA} with all its columns, found {found} in "
            f"{name}; open it with the dengine that wrote it, restore a copy that `dengine backup` "
            "made, or name a new file or database."
        )
