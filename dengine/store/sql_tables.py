"""The tables of a store in a database; every row belongs to a cell. A change of them is a new SCHEMA."""

from __future__ import annotations

import sqlalchemy as sa

from ..errors import StoreError

SCHEMA = "3"
SCHEMA_KEY = "schema_version"  # a row of `setting` for every cell, which also serves as the cell's lock
PRODUCT_KEY = "product"  # a row of `setting` for every cell that shares what it learns
OWNER_KEY = "owner"  # a row of `setting` for every cell that an engine drives, where the store keeps one
RESERVED = (SCHEMA_KEY, PRODUCT_KEY, OWNER_KEY)  # rows of `setting` that are the store's own

METADATA = sa.MetaData()


def _chained() -> tuple[sa.Column[int], sa.Column[bytes]]:
    """Where a row stands in the cell's ledger, and its SHA-256 (`chain.row_sum`); since schema 3. NULL: not chained."""
    return sa.Column("entry", sa.BigInteger), sa.Column("sum", sa.LargeBinary)


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
    *_chained(),
)
HISTORY = sa.Index("decision_time", *DECISION.c["cell_id", "time", "id"])  # made where it is missing: no change of schema
TRACE = sa.Table(  # apart from `decision`, so that counting decisions does not read traces
    "trace",
    METADATA,
    sa.Column("cell_id", sa.String, primary_key=True),
    sa.Column("decision_id", sa.String, primary_key=True),
    sa.Column("channels", sa.Integer, nullable=False),
    sa.Column("samples", sa.Integer, nullable=False),
    sa.Column("data", sa.LargeBinary, nullable=False),  # float32, little-endian, (channels, samples)
    *_chained(),
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
    *_chained(),
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
    sa.Column("state", sa.LargeBinary),  # npz without pickles; NULL where it was thinned out
    *_chained(),
    sa.Column("state_sum", sa.LargeBinary),  # SHA-256 of the state, which stays where the state goes; since schema 3
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
    sa.Column("data", sa.Text),  # JSON; this and the next since schema 3
    sa.Column("author", sa.String, nullable=False, server_default=sa.text("''")),
    *_chained(),
)
CORRECTION = sa.Table(  # later words on labels; the newest of a decision counts; since schema 3
    "correction",
    METADATA,
    sa.Column("cell_id", sa.String, primary_key=True),
    sa.Column("number", sa.BigInteger, primary_key=True, autoincrement=False),  # 1, 2, ... in each cell
    sa.Column("time", sa.Double, nullable=False),
    sa.Column("decision_id", sa.String, nullable=False),
    sa.Column("success", sa.Boolean),  # NULL: forgotten
    sa.Column("was", sa.Boolean),  # until then; NULL likewise
    sa.Column("author", sa.String, nullable=False),
    sa.Column("event", sa.BigInteger, nullable=False),
    sa.Column("newest_seq", sa.BigInteger, nullable=False),  # of the cell's labels at that moment
    *_chained(),
    sa.Index("correction_of", "cell_id", "decision_id", "number"),
)

CHAINED = {table.name: table for table in (DECISION, TRACE, LABEL, VERSION, EVENT, CORRECTION)}  # rows the ledger chains
LEDGER = sa.Table(  # since schema 3: an entry for every transaction that added rows or changed settings
    "ledger",
    METADATA,
    sa.Column("cell_id", sa.String, primary_key=True),
    sa.Column("number", sa.BigInteger, primary_key=True, autoincrement=False),  # 1, 2, ... in each cell
    sa.Column("time", sa.Double, nullable=False),
    sa.Column("added", sa.Text, nullable=False),  # JSON: how many rows of each table
    sa.Column("settings", sa.Text),  # JSON: all settings, where they changed
    sa.Column("digest", sa.LargeBinary, nullable=False),  # SHA-256 over the one before and this entry's rows
)
MIGRATION = sa.Table(  # Alembic's: how far the tables are brought up to date
    "dengine_migration",
    METADATA,
    sa.Column("version_num", sa.String(32), nullable=False),
    sa.PrimaryKeyConstraint("version_num", name="dengine_migration_pkc"),
)

EARLIER = {"schema 1": "1", "schema 2": "2"}
NEW = {"schema 2": {CORRECTION.name, LEDGER.name, MIGRATION.name}}  # tables that later schemas have
NEW["schema 1"] = {EVENT.name} | NEW["schema 2"]


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
        connection.execute(sa.insert(MIGRATION), {"version_num": revision(SCHEMA)})
    HISTORY.create(connection, checkfirst=True)
    entered = sa.select(SETTING).where(SETTING.c.cell_id == cell_id, SETTING.c.key == SCHEMA_KEY)
    if connection.execute(entered).first() is None:
        connection.execute(sa.insert(SETTING), {"cell_id": cell_id, "key": SCHEMA_KEY, "value": SCHEMA})


def revision(schema: str) -> str:
    """Return what Alembic calls a schema."""
    return f"{int(schema):04}"


def _bring_up_to_date(connection: sa.Connection, found: set[str], name: str) -> None:
    """Change tables of an earlier schema to the present one, for all cells at once; refuse any other."""
    held = held_schema(connection, found)
    if held in EARLIER:
        from .migrations import migrate  # Alembic takes its time: only where there is something to change

        migrate(connection, revision(EARLIER[held]), revision(SCHEMA))
        connection.execute(sa.update(SETTING).where(SETTING.c.key == SCHEMA_KEY).values(value=SCHEMA))
    elif held != f"schema {SCHEMA}":
        raise StoreError(
            f"Expected a dengine store of schema {SCHEMA}, found {held} in {name}; "
            "open it with the dengine that wrote it, or name a new file or database."
        )


def held_schema(connection: sa.Connection, found: set[str]) -> str:
    """Say what a database holds: the schema of the tables that its cells have in common, or another program's."""
    columns = {c["name"] for c in sa.inspect(connection).get_columns("setting")} if "setting" in found else set()
    if columns != set(SETTING.c.keys()):
        return "tables of another program: " + ", ".join(sorted(found))
    query = sa.select(SETTING.c.value).where(SETTING.c.key == SCHEMA_KEY).distinct()  # the one query over all cells
    schema = "schema " + (", ".join(sorted(connection.execute(query).scalars())) or "unknown")
    beside = sorted(found & NEW.get(schema, set()))  # it had none such
    return f"{schema} and a table {beside[0]!r} of another program" if beside else schema
