"""The tables of a store in a database; their columns are the fields of the records that they hold."""

from enum import StrEnum
from typing import Any

import numpy as np
import sqlalchemy as sa

from ..errors import StoreError
from ..records import Decision, RetrainReport
from .records import OF_DECISION, Correction, Event, NewLabel, StoredDecision, columns

SCHEMA = "1"
SCHEMA_KEY = "schema_version"  # a row of `setting` for every cell
PRODUCT_KEY = "product"  # a row of `setting` for every cell that shares what it learns
LEDGER_KEY = "ledger_key"  # a row of `setting` for every cell whose ledger is keyed: what tells its key from others
TABLES, PRODUCT, CELL = range(7236482514, 7236482517)  # what is held; the numbers are nobody else's
RESERVED = (SCHEMA_KEY, PRODUCT_KEY, LEDGER_KEY)  # rows of `setting` that are the store's own

METADATA = sa.MetaData()
KINDS: dict[type, Any] = {
    str: sa.String,
    int: sa.BigInteger,
    float: sa.Double,
    bool: sa.Boolean,
    tuple: sa.Text,
    dict: sa.Text,
    np.ndarray: sa.LargeBinary,  # float32, little-endian
}


def _columns(record: type, *names: str, key: str = "") -> list[sa.Column[Any]]:
    """Columns of a record's fields, of all or of these; key : the one that is of the primary key."""
    known = {name: each for name, each in columns(record).items() if not names or name in names}
    kinds = {name: sa.String if issubclass(kind, StrEnum) else KINDS[kind] for name, (kind, _) in known.items()}
    return [
        sa.Column(name, kinds[name], nullable=optional, primary_key=name == key, autoincrement=False)
        for name, (_, optional) in known.items()
    ]


def _table(name: str, *parts: Any) -> sa.Table:
    """A table of a cell's rows, each with its entry in the cell's ledger and its SHA-256 (`row_sum`)."""
    cell, entry = sa.Column("cell_id", sa.String, primary_key=True), sa.Column("entry", sa.BigInteger)
    return sa.Table(name, METADATA, cell, *parts, entry, sa.Column("sum", sa.LargeBinary))


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
    sa.Column("number", sa.BigInteger, nullable=False),  # 1, 2, ... in each cell, in their order: a clock may be set back
    sa.Index("decision_number", "cell_id", "number", unique=True),
    sa.Index("decision_time", "cell_id", "time"),
)
TRACE = _table(  # apart from `decision`, so that counting decisions does not read traces
    "trace",
    sa.Column("decision_id", sa.String, primary_key=True),
    sa.Column("channels", sa.Integer, nullable=False),
    sa.Column("samples", sa.Integer, nullable=False),
    sa.Column("data", sa.LargeBinary, nullable=False),  # float32, little-endian, (channels, samples)
)
LABEL = _table(
    "label",
    *_columns(NewLabel, key="decision_id"),
    sa.Column("seq", sa.BigInteger, nullable=False),
    *_columns(StoredDecision, "quarantined"),  # as of `decision`, for the index
    sa.UniqueConstraint("cell_id", "seq", name="label_seq"),
    sa.Index("label_training", "cell_id", "quarantined", "seq"),
)
VERSION = _table(  # every retrain, dropped candidates included
    "model_version",
    sa.Column("retrain", sa.BigInteger, primary_key=True, autoincrement=False),  # 1, 2, ... in each cell, or product
    sa.Column("time", sa.Double, nullable=False),
    *_columns(RetrainReport),
    sa.Column("last_seq", sa.BigInteger, nullable=False),
    sa.Column("state", sa.LargeBinary),  # npz without pickles; NULL where it was thinned out
    sa.Column("state_sum", sa.LargeBinary),  # SHA-256 of the state, which stays where the state goes
    sa.Index("version_accepted", "cell_id", "accepted", "retrain"),
)
EVENT = _table("event", *_columns(Event, key="number"))
CORRECTION = _table(  # later words on labels; the newest of a decision counts
    "correction",
    *_columns(Correction, *(name for name in columns(Correction) if name != "seq"), key="number"),
    sa.Index("correction_of", "cell_id", "decision_id", "number"),
)
CHAINED = {table.name: table for table in (DECISION, TRACE, LABEL, VERSION, EVENT, CORRECTION)}  # rows the ledger chains
ADDED = {LABEL.c.overdue_to}  # columns that came after the first schema
LEDGER = sa.Table(  # an entry for every transaction that added rows or changed settings
    "ledger",
    METADATA,
    sa.Column("cell_id", sa.String, primary_key=True),
    sa.Column("number", sa.BigInteger, primary_key=True, autoincrement=False),  # 1, 2, ... in each cell
    sa.Column("time", sa.Double, nullable=False),
    sa.Column("added", sa.Text, nullable=False),  # JSON: how many rows of each table
    sa.Column("rows", sa.LargeBinary, nullable=False),  # of these rows' sums: `rows_digest`
    sa.Column("held", sa.Text, nullable=False),  # JSON: the chain of all rows so far of each table that is in force
    sa.Column("settings", sa.Text),  # JSON: all settings, where they changed
    sa.Column("digest", sa.LargeBinary, nullable=False),  # over the entry before and this one: `entry_digest`
)


def hold(connection: sa.Connection, kind: int, name: str = "") -> None:
    """Hold the tables, then a cell, then a product until the transaction ends, so that numbers are committed in order."""
    if connection.dialect.name == "postgresql":  # SQLite's BEGIN IMMEDIATE did it already
        lock = sa.text("SELECT pg_advisory_xact_lock(hashtextextended(:name, :kind))")
        connection.execute(lock, {"name": name, "kind": kind})


def prepare_tables(connection: sa.Connection, cell_id: str, name: str) -> None:
    """Create the tables in an empty database, or check that they are ours; enter the cell.

    name : of the database, for the error.
    """
    hold(connection, TABLES)  # two cells may create them at the same moment
    found = set(sa.inspect(connection).get_table_names())
    # A file belongs to one program; a PostgreSQL database may hold other tables beside ours.
    if found & set(METADATA.tables) or (found and connection.dialect.name == "sqlite"):
        _add_columns(connection)
        check_schema(connection, name)
    else:
        METADATA.create_all(connection)
    entered = sa.select(SETTING).where(SETTING.c.cell_id == cell_id, SETTING.c.key == SCHEMA_KEY)
    if connection.execute(entered).first() is None:
        connection.execute(sa.insert(SETTING), {"cell_id": cell_id, "key": SCHEMA_KEY, "value": SCHEMA})


def _add_columns(connection: sa.Connection) -> None:
    """Add the columns that an earlier dengine did not write; they are empty in its rows, whose sums leave them out."""
    inspector = sa.inspect(connection)
    for column in ADDED:
        table = column.table.name
        names = {each["name"] for each in inspector.get_columns(table)} if inspector.has_table(table) else set()
        if names >= {"cell_id", "sum"} and column.name not in names:
            kind = column.type.compile(connection.dialect)
            connection.execute(sa.text(f'ALTER TABLE "{table}" ADD COLUMN "{column.name}" {kind}'))


def check_schema(connection: sa.Connection, name: str) -> None:
    """StoreError for a database that holds no store, or one of another schema, or a store that lacks columns."""
    inspector = sa.inspect(connection)
    found = {
        table: {column["name"] for column in inspector.get_columns(table)} if table in METADATA.tables else set()
        for table in inspector.get_table_names()
    }
    if found.get(SETTING.name) != set(SETTING.c.keys()):
        held = f"tables of another program: {', '.join(sorted(found))}" if found else "no tables"
    else:
        query = sa.select(SETTING.c.value).where(SETTING.c.key == SCHEMA_KEY).distinct()  # the one query over all cells
        held = "schema " + (", ".join(sorted(connection.execute(query).scalars())) or "unknown")
    if held != f"schema {SCHEMA}":
        do = "open it with the dengine that wrote it, or name a new file or database"
        if not found:
            do = "a plain copy of a store that is in use lacks what it holds: make it by `dengine backup`"
        raise StoreError(f"Expected a dengine store of schema {SCHEMA}, found {held} in {name}; {do}.")
    for table in METADATA.tables.values():
        wanted = {column.name for column in table.c if column not in ADDED}
        if missing := wanted - found.get(table.name, set()):
            raise StoreError(f"Expected columns {sorted(missing)} of {table.name} in {name}; restore it from a copy.")
