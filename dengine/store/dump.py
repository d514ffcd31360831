"""A store's tables as Parquet files, for whoever analyses them: a folder a cell, a file a table.

    dump_store("engine.db", "out")          # out/cell/decision.parquet, out/cell/label.parquet, ...

A decision comes with its trace, float32, as a list of fixed size where all traces of the cell have one shape (channels one
after the other). Versions come without their states, which only dengine can read.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
import sqlalchemy as sa

from ..errors import SettingError, StoreError
from .schema import DECISION, LABEL, TRACE, VERSION
from .verification import CHUNK, TABLES, chosen_cells, snapshot

if TYPE_CHECKING:
    import pyarrow as pa

ABOUT = "dengine_dump.json"  # says what a folder holds, and that it may be replaced by a later dump
LEFT_OUT = {VERSION.c.state}
FLOATS = {TRACE.c.data, LABEL.c.point}  # float32 as bytes
TRACE_OF = (TRACE.c.cell_id == DECISION.c.cell_id) & (TRACE.c.decision_id == DECISION.c.id)


@dataclass(frozen=True, slots=True)
class Dump:
    """What was written; rows : by file, as `cell/label.parquet`."""

    folder: Path
    rows: dict[str, int]


def dump_store(
    url: str, folder: str | os.PathLike[str], cell_id: str | None = None, on_rows: Callable[[int], None] | None = None
) -> Dump:
    """Write every table of one cell, or of all, as it is now; nothing changes in the store, and engines may go on.

    folder : is made, or replaced where it holds an earlier dump and nothing else. It is there as a whole or not at all.
    on_rows : called with the number of rows that were just written.
    Holds some hundred rows at a time. Raises StoreError for what is no store, or a folder of something else, and
    SettingError where pyarrow is not installed.
    """
    try:
        import pyarrow  # noqa: F401 - asked before anything is made
    except ImportError as error:
        raise SettingError('Expected pyarrow for Parquet, it is not installed: pip install "dengine[files]".') from error
    target, rows = Path(folder).absolute(), {}
    _refuse_foreign(target)
    with snapshot(str(url)) as connection, _replacing(target) as made:
        for cell in chosen_cells(connection, cell_id):
            (made / folder_name(cell)).mkdir()
            for columns in _files(connection):
                name = f"{folder_name(cell)}/{columns[0].table.name}.parquet"
                rows[name] = _write(connection, cell, columns, made / name, on_rows or _nobody)
        about = {"written by": "dengine dump", "rows": rows}
        (made / ABOUT).write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
    return Dump(target, rows)


def _nobody(rows: int) -> None:
    """Nobody asks how far it is."""


def folder_name(cell_id: str) -> str:
    """Return a cell's name as a folder may have it: what is no letter, digit, "-", "_" or "." comes as %XX."""
    name = quote(cell_id, safe="")
    return "%2E" + name[1:] if name.startswith(".") else name


def _refuse_foreign(folder: Path) -> None:
    """Raise where a folder holds anything that an earlier dump did not write."""
    if not folder.exists() and not folder.is_symlink():
        return
    plain = folder.is_dir() and not folder.is_symlink()
    held = {str(path.relative_to(folder)) for path in folder.rglob("*") if not path.is_dir()} if plain else {"."}
    try:
        about = json.loads((folder / ABOUT).read_text(encoding="utf-8")) if held else {"rows": {}}
        foreign = held - set(about["rows"]) - {ABOUT}
    except (OSError, ValueError, TypeError, KeyError):
        foreign = held
    if foreign:
        raise StoreError(
            f"Expected a new folder, an empty one or an earlier dump, {folder} holds something else "
            f"({min(foreign)}); name another."
        )


@contextmanager
def _replacing(folder: Path) -> Iterator[Path]:
    """A folder beside the wanted one, which takes its place at the end; gone again where that is not reached."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    made = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        yield made
        made.chmod(0o777 & ~_umask())
        if folder.exists():
            folder.rename(old := made.with_name(made.name + ".old"))
            made.rename(folder)
            shutil.rmtree(old)
        else:
            made.rename(folder)
    except BaseException:
        shutil.rmtree(made, ignore_errors=True)
        raise


def _umask() -> int:
    os.umask(mask := os.umask(0o077))
    return mask


Columns = list[sa.Column[Any]]


def _files(connection: sa.Connection) -> Iterator[Columns]:
    """The columns of each file; the first names its table."""
    for table in TABLES.values():
        if table is DECISION:
            yield [*DECISION.c, *(column for column in TRACE.c if not column.primary_key)]
        elif table is not TRACE:
            yield [column for column in table.c if column not in LEFT_OUT]


def _write(connection: sa.Connection, cell: str, columns: Columns, path: Path, on_rows: Callable[[int], None]) -> int:
    """Write a table of a cell, CHUNK rows at a time; returns how many."""
    import pyarrow as pa
    from pyarrow.parquet import ParquetWriter

    table, size = columns[0].table, _trace_size(connection, cell)
    rows_from = DECISION.outerjoin(TRACE, TRACE_OF) if table is DECISION else table
    query = sa.select(*columns).select_from(rows_from).where(table.c.cell_id == cell).order_by(*table.primary_key)
    schema = pa.schema([(_name(column), _type(column, size)) for column in columns])
    n = 0
    with ParquetWriter(path, schema, compression="zstd") as writer:
        for part in connection.execute(query.execution_options(yield_per=CHUNK)).partitions():
            arrays = [_array(column, values, schema.field(i).type) for i, (column, values) in _across(columns, part)]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
            n += len(part)
            on_rows(len(part))
    return n


def _across(columns: Columns, rows: Any) -> Iterator[tuple[int, tuple[sa.Column[Any], tuple[Any, ...]]]]:
    return enumerate(zip(columns, zip(*rows, strict=True), strict=True))


def _name(column: sa.Column[Any]) -> str:
    return {TRACE.c.data: "trace", TRACE.c.entry: "trace_entry", TRACE.c.sum: "trace_sum"}.get(column, column.name)


def _trace_size(connection: sa.Connection, cell: str) -> int | None:
    """How many numbers every trace of a cell has; None where they differ, or where there is none."""
    shapes = sa.select(TRACE.c.channels, TRACE.c.samples).where(TRACE.c.cell_id == cell).distinct().limit(2)
    found = connection.execute(shapes).all()
    return found[0].channels * found[0].samples if len(found) == 1 else None


def _type(column: sa.Column[Any], size: int | None) -> pa.DataType:
    """What a column is in Parquet."""
    import pyarrow as pa

    if column in FLOATS:
        return pa.list_(pa.float32(), size if column is TRACE.c.data and size is not None else -1)
    kinds = (
        (sa.Boolean, pa.bool_()),
        (sa.Double, pa.float64()),
        (sa.Integer, pa.int64()),
        (sa.String, pa.string()),
        (sa.LargeBinary, pa.binary()),
    )
    return next(arrow for kind, arrow in kinds if isinstance(column.type, kind))


def _array(column: sa.Column[Any], values: tuple[Any, ...], wanted: pa.DataType) -> pa.Array:
    import pyarrow as pa

    if column in FLOATS:
        values = tuple(None if value is None else np.frombuffer(value, dtype="<f4") for value in values)
    return pa.array(values, type=wanted)
