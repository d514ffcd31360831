"""From records to rows and back: decisions, traces and labels, and arrays as bytes.

The tables of a store in a database; every row belongs to a cell. A change of them is a new SCHEMA.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
import sqlalchemy as sa
from numpy.typing import NDArray

from ..errors import DataError, StoreError
from ..files import read_archive
from ..records import Action, Reason, RetrainReport, Source
from .records import DecidedTrace, Event, Evidence, NewLabel, StoredDecision, as_label

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


CHUNK = 500  # rows sent or fetched at a time

T = TypeVar("T")


def decision_row(cell_id: str, item: DecidedTrace) -> dict[str, Any]:
    """Return the row of the table `decision`."""
    decision = item.decision
    return {
        "cell_id": cell_id,
        "id": decision.id,
        "time": item.time,
        "action": decision.action.value,
        "predicted": decision.predicted.value,
        "lower": float(decision.lower),
        "upper": float(decision.upper),
        "n_success": int(decision.n_success),
        "n_failure": int(decision.n_failure),
        "embedding": None if decision.embedding is None else json.dumps(decision.embedding, default=float),
        "model_version": int(decision.model_version),
        "reason": decision.reason.value,
        "audit": bool(decision.audit),
        "propensity": float(decision.propensity),
        "content_hash": item.content_hash,
        "quarantined": item.quarantined,
        "part": item.part,
    }


def trace_row(cell_id: str, item: DecidedTrace) -> dict[str, Any]:
    """Return the row of the table `trace`."""
    channels, samples = item.trace.shape
    return {
        "cell_id": cell_id,
        "decision_id": item.decision.id,
        "channels": channels,
        "samples": samples,
        "data": pack(item.trace),
    }


def label_row(cell_id: str, label: NewLabel, seq: int, time: float, content_hash: int, quarantined: bool) -> dict[str, Any]:
    """Return the row of the table `label`; the last two are those of its decision."""
    return {
        "cell_id": cell_id,
        "decision_id": label.decision_id,
        "seq": seq,
        "time": time,
        "success": label.success,
        "source": label.source.value,
        "model_version": label.model_version,
        "point": None if label.point is None else pack(label.point),
        "content_hash": content_hash,
        "quarantined": quarantined,
        "silent": label.silent,
    }


def version_row(
    cell_id: str, report: RetrainReport, last_seq: int, time: float, state: Mapping[str, NDArray[Any]] | None
) -> dict[str, Any]:
    """Return the row of the table `model_version`, without the number of the retrain."""
    return {
        "cell_id": cell_id,
        "version": int(report.version),
        "time": time,
        "seconds": float(report.seconds),
        "n_traces": int(report.n_traces),
        "n_steps": int(report.n_steps),
        "accepted": bool(report.accepted),
        "reason": report.reason,
        "last_seq": last_seq,
        "state": None if state is None else to_npz(state),
    }


def event_row(
    cell_id: str, number: int, time: float, kind: str, text: str, data: Mapping[str, Any] | None = None, author: str = ""
) -> dict[str, Any]:
    """Return the row of the table `event`, whole: a default that the database fills in would not be in the row's sum."""
    said = None if data is None else json.dumps(data)
    row = {"cell_id": cell_id, "number": number, "time": time, "kind": kind, "text": text}
    return row | {"data": said, "author": author}


def read_decision(row: Any) -> StoredDecision:
    """Read a row of `decision` joined with its trace, and with its label where it has one."""
    return StoredDecision(
        id=row.id,
        action=Action(row.action),
        predicted=Action(row.predicted),
        audit=row.audit,
        reason=Reason(row.reason),
        lower=row.lower,
        upper=row.upper,
        embedding=None if row.embedding is None else tuple(tuple(point) for point in json.loads(row.embedding)),
        model_version=row.model_version,
        trace=unpack_trace(row),
        content_hash=row.content_hash,
        quarantined=row.quarantined,
        success=as_label(row.success),
        source=None if row.source is None else Source(row.source),
        n_success=row.n_success,
        n_failure=row.n_failure,
        propensity=row.propensity,
        part=row.part,
    )


def read_event(row: Any) -> Event:
    """Read a row of `event`."""
    return Event(row.number, row.time, row.kind, row.text, None if row.data is None else json.loads(row.data), row.author)


def read_evidence(rows: Sequence[Any]) -> Evidence:
    """Read rows of `label` joined with the bounds and the reason of their decisions."""
    return Evidence(
        seq=np.array([row.seq for row in rows], dtype=np.int64),
        lower=np.array([row.lower for row in rows], dtype=np.float64),
        upper=np.array([row.upper for row in rows], dtype=np.float64),
        success=np.array([row.success for row in rows], dtype=bool),
        novel=np.array([row.reason == Reason.NOVEL for row in rows], dtype=bool),
        silent=np.array([row.silent for row in rows], dtype=np.int64),
    )


def chunks(rows: Sequence[T]) -> Iterator[Sequence[T]]:
    """Return the rows in parts of at most CHUNK."""
    return (rows[start : start + CHUNK] for start in range(0, len(rows), CHUNK))


def pack(values: NDArray[np.float32]) -> bytes:
    """Return the values as little-endian float32, without their shape."""
    return values.astype("<f4", copy=False).tobytes()


def unpack(blob: bytes) -> NDArray[np.float32]:
    """Read what `pack` wrote, flat."""
    return np.frombuffer(blob, dtype="<f4").astype(np.float32)


def unpack_trace(row: Any) -> NDArray[np.float32]:
    """Return the (C, T) trace of a row with `channels`, `samples` and `data`."""
    return unpack(row.data).reshape(row.channels, row.samples)


def to_npz(state: Mapping[str, NDArray[Any]]) -> bytes:
    """Return arrays as an npz file; written member by member, since `np.savez` reserves the name `file`."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, values in state.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                np.save(member, values, allow_pickle=False)
    return buffer.getvalue()


def from_npz(blob: bytes, name: str) -> dict[str, NDArray[Any]]:
    """Read what `to_npz` wrote; a pickle in it is refused."""
    try:
        return read_archive(blob, name=f"a version in {name}")[0]
    except DataError as error:
        raise StoreError(f"{error} It is no version of plain arrays: restore {name} from a copy.") from error
