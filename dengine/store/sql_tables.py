"""The tables of a store in a database; every row belongs to a cell. A change of them is a new SCHEMA."""

from __future__ import annotations

import sqlalchemy as sa

from ..errors import StoreError

SCHEMA = "2"
SCHEMA_KEY = "schema_version"  # a row of `setting` for every cell, which also serves as the cell's lock
PRODUCT_KEY = "product"  # a row of `setting` for every cell that shares what it learns
OWNER_KEY = "owner"  # a row of `setting` for every cell that an engine drives, where the store keeps one
RESERVED = (SCHEMA_KEY, PRODUCT_KEY, OWNER_KEY)  # rows of `setting` that are the store's own

METADATA = sa.MetaData()
SETTING = sa.Table(
    "setting",
    METADATA,
    sa.Column("cell_id", sa.String, primary_key=True),
    sa.Column("key", sa.String, primary_key=True),
    sa.Column("value", sa.String, nullable=False),
)
DECISION = sa.Table(
    "decision",
    METADATA,
    sa.Column("cell_id", sa.String, primary_key=True),
    sa.Column("id", sa.String, primary_key=True),
    sa.Column("time", sa.Double, nullable=False),
    sa.Column("action", sa.String, nullable=False),
    sa.Column("predicted", sa.String, nullable=False),
    sa.Column("lower", sa.Double),
    sa.Column("upper", sa.Double),
    sa.Column("n_success", sa.BigInteger, nullable=False),
    sa.Column("n_failure", sa.BigInteger, nullable=False),
    sa.Column("embedding", sa.Text),  # JSON, (K, d)
    sa.Column("model_version", sa.BigInteger, nullable=False),
    sa.Column("reason", sa.String, nullable=False),
    sa.Column("audit", sa.Boolean, nullable=False),
    sa.Column("propensity", sa.Double),
    # Of the trace's content, or of its part's number where one is given: it deals the fold, and who may vote once.
    sa.Column("content_hash", sa.BigInteger, nullable=False),
    sa.Column("quarantined", sa.Boolean, nullable=False),
    sa.Column("part", sa.String),  # serial number of the part that the trace was recorded on; since schema 2
)
TRACE = sa.Table(  # apart from `decision`, so that counting decisions does not read traces
    "trace",
    METADATA,
    sa.Column("cell_id", sa.String, primary_key=True),
    sa.Column("decision_id", sa.String, primary_key=True),
    sa.Column("channels", sa.Integer, nullable=False),
    sa.Column("samples", sa.Integer, nullable=False),
    sa.Column("data", sa.LargeBinary, nullable=False),  # float32, little-endian, (channels, samples)
)
LABEL = sa.Table(
    "label",
    METADATA,
    sa.Column("cell_id", sa.String, primary_key=True),
    sa.Column("decision_id", sa.String, primary_key=True),
    sa.Column("seq", sa.BigInteger, nullable=False),
    sa.Column("time", sa.Double, nullable=False),
    sa.Column("success", sa.Boolean, nullable=False),
    sa.Column("source", sa.String, nullable=False),
    sa.Column("model_version", sa.BigInteger, nullable=False),  # whose space `point` lives in
    sa.Column("point", sa.LargeBinary),  # float32, little-endian, (d,)
    sa.Column("content_hash", sa.BigInteger, nullable=False),  # this and the next repeat `decision`, for the index
    sa.Column("quarantined", sa.Boolean, nullable=False),
    # Accepted parts of which nothing was heard since the previous label; since schema 2.
    sa.Column("silent", sa.BigInteger, nullable=False, server_default=sa.text("0")),
    sa.UniqueConstraint("cell_id", "seq", name="label_seq"),
    sa.Index("label_training", "cell_id", "quarantined", "seq"),
)
VERSION = sa.Table(  # every retrain, dropped candidates included
    "model_version",
    METADATA,
    sa.Column("cell_id", sa.String, primary_key=True),
    sa.Column("retrain", sa.BigInteger, primary_key=True, autoincrement=False),  # 1, 2, ... in each cell, or product
    sa.Column("version", sa.BigInteger, nullable=False),
    sa.Column("time", sa.Double, nullable=False),
    sa.Column("seconds", sa.Double, nullable=False),
    sa.Column("n_traces", sa.BigInteger, nullable=False),
    sa.Column("n_steps", sa.BigInteger, nullable=False),
    sa.Column("accepted", sa.Boolean, nullable=False),
    sa.Column("reason", sa.Text, nullable=False),
    sa.Column("last_seq", sa.BigInteger, nullable=False),
    sa.Column("state", sa.LargeBinary),  # npz without pickles
    sa.Index("version_accepted", "cell_id", "accepted", "retrain"),
)
EVENT = sa.Table(  # since schema 2
    "event",
    METADATA,
    sa.Column("cell_id", sa.String, primary_key=True),
    sa.Column("number", sa.BigInteger, primary_key=True, autoincrement=False),  # 1, 2, ... in each cell
    sa.Column("time", sa.Double, nullable=False),
    sa.Column("kind", sa.String, nullable=False),
    sa.Column("text", sa.Text, nullable=False),
)


def prepare_tables(connection: sa.Connection, cell_id: str, name: str) -> None:
    """Create the tables in an empty database, or check that they are ours and bring them up to date; enter the cell.

    name : of the database, for the error.
    """
    if connection.dialect.name == "postgresql":  # two cells may create or change the tables at the same moment
        connection.execute(sa.text("SELECT pg_advisory_xact_lock(7236482514)"))
    found, ours = set(sa.inspect(connection).get_table_names()), set(METADATA.tables)
    # A file belongs to one program; a PostgreSQL database may hold other tables beside ours.
    if found & ours or (found and connection.dialect.name == "sqlite"):
        _bring_up_to_date(connection, found, name)
    else:
        METADATA.create_all(connection)
    entered = sa.select(SETTING).where(SETTING.c.cell_id == cell_id, SETTING.c.key == SCHEMA_KEY)
    if connection.execute(entered).first() is None:
        connection.execute(sa.insert(SETTING), {"cell_id": cell_id, "key": SCHEMA_KEY, "value": SCHEMA})


def _bring_up_to_date(connection: sa.Connection, found: set[str], name: str) -> None:
    """Change tables of schema 1 to the present one, for all cells at once; refuse any other."""
    held = _held(connection, found)
    if held == "schema 1":
        for column in (DECISION.c.part, LABEL.c.silent):
            new = sa.schema.CreateColumn(column).compile(dialect=connection.dialect)
            connection.exec_driver_sql(f"ALTER TABLE {column.table.name} ADD COLUMN {new}")
        EVENT.create(connection)
        connection.execute(sa.update(SETTING).where(SETTING.c.key == SCHEMA_KEY).values(value=SCHEMA))
    elif held != f"schema {SCHEMA}":
        raise StoreError(
            f"Expected a dengine store of schema {SCHEMA}, found {held} in {name}; "
            "open it with the dengine that wrote it, or name a new file or database."
        )


def _held(connection: sa.Connection, found: set[str]) -> str:
    """Say what a database holds: the schema of the tables that its cells have in common, or another program's."""
    columns = {c["name"] for c in sa.inspect(connection).get_columns("setting")} if "setting" in found else set()
    if columns != set(SETTING.c.keys()):
        return "tables of another program: " + ", ".join(sorted(found))
    query = sa.select(SETTING.c.value).where(SETTING.c.key == SCHEMA_KEY).distinct()  # the one query over all cells
    schema = "schema " + (", ".join(sorted(connection.execute(query).scalars())) or "unknown")
    beside = schema == "schema 1" and EVENT.name in found  # schema 1 had none
    return f"{schema} and a table {EVENT.name!r} of another program" if beside else schema
