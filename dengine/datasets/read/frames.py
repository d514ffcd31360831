"""Read JSON, Parquet tables, NumPy archives, UCR's `.ts` files and DataFrames as a `Table`.

Nested objects become columns with dots in their names: `{"curve": {"force": [1, 2]}}` has the
column `curve.force`, a list of pairs under `points` the columns `points.0` and `points.1`, and a
list of objects the columns of their keys.
"""

import io
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import listed, shortened
from ...files import read_archive, read_errors
from ..description import TextForm
from ..table import Table, UnreadableError
from .text import to_utf8

MOST_CHANNELS = 16  # a list of so few lists has a channel in each, a longer one a sample
Columns = dict[str, NDArray[Any]]


def read_objects(content: bytes, source: str, form: TextForm) -> list[Table]:
    """Return a table for each object of a JSON file: one, a list of them, or one a line."""
    text = to_utf8(content, form.encoding).decode()
    try:
        found = json.loads(text)
        rows = [(0, value) for value in (found if isinstance(found, list) else [found])]
    except (json.JSONDecodeError, RecursionError):
        rows = [(i, _parse(line, i)) for i, line in enumerate(text.split("\n"), 1) if line.strip()]
    for line, value in rows:
        if not isinstance(value, Mapping):
            raise UnreadableError(f"Expected an object of JSON, got {shortened(value)}", line)
    return [Table(source, columns_of("", value), [line]) for line, value in rows]


def _parse(line: str, number: int) -> Any:
    """Return the object in a line of JSON; raise UnreadableError for another text."""
    try:
        return json.loads(line)
    except (json.JSONDecodeError, RecursionError) as error:
        raise UnreadableError(f"Expected JSON: {error}", number) from error


def columns_of(prefix: str, value: Any) -> Columns:
    """Return the columns of a nested object, each with its cells; a scalar is a column of one."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        items = value.items()
        pairs = [(f"{prefix}.{name}" if prefix else str(name), item) for name, item in items]
    elif isinstance(value, list) and value and isinstance(value[0], Mapping):
        pairs = [(f"{prefix}.{name}", [item.get(name) for item in value]) for name in value[0]]
    elif isinstance(value, list) and value and isinstance(value[0], list | np.ndarray):
        rows = value if len(value) <= MOST_CHANNELS else list(zip(*value, strict=False))
        pairs = [(f"{prefix}.{i}", list(row)) for i, row in enumerate(rows)]
    else:
        return {prefix: as_cells(value if isinstance(value, list) else [value])}
    return {key: cells for name, item in pairs for key, cells in columns_of(name, item).items()}


def as_cells(values: Sequence[Any]) -> NDArray[Any]:
    """Return values as an array (n,) of numbers if all are numbers, else of objects."""
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        return np.array(values, dtype=None if all(abs(v) < 2**62 for v in values) else np.float64)
    cells = np.empty(len(values), dtype=object)
    cells[:] = values
    return cells


def join(tables: Sequence[Table]) -> Table:
    """Return one table of tables with a row each, in the columns of the first."""
    first = tables[0]
    columns = {
        name: as_cells([next(iter(t.columns.get(name, ())), None) for t in tables])
        for name in first.columns
    }
    return Table(first.source, columns, [table.line(0) for table in tables])


def read_frame(frame: Any, source: str) -> Table:
    """Return the table of a DataFrame, whose index is a column if it has a name."""
    frame = frame.reset_index() if frame.index.name is not None else frame
    columns = {str(name): frame[name].to_numpy() for name in frame.columns}
    columns = {name: c.astype(object) if c.dtype.kind in "US" else c for name, c in columns.items()}
    return Table(source, columns, range(1, len(frame) + 1))


def read_parquet(content: bytes, source: str) -> Table:
    """Return the table of a Parquet file; raise DataError if it is none."""
    with read_errors(source, "a Parquet file", "pyarrow", "files"):
        import pandas as pd

        return read_frame(pd.read_parquet(io.BytesIO(content)), source)


def read_npz(content: bytes, source: str) -> Table:
    """Return the table of a NumPy archive of one part: a column for each array.

    An array (C, n), or (n, C) with C < n, has the columns `NAME.0`, `NAME.1`, ...
    """
    arrays, _ = read_archive(content, name=source)
    columns: Columns = {}
    for name, x in arrays.items():
        columns |= _array_columns(name, np.squeeze(x))
    return Table(source, columns, [])


def _array_columns(name: str, x: NDArray[Any]) -> Columns:
    """Return the columns of an array of one part, a scalar, (n,), (C, n) or (n, C)."""
    if x.ndim < 2:
        return {name: np.atleast_1d(x)}
    return {f"{name}.{i}": row for i, row in enumerate(x if len(x) <= x.shape[1] else x.T)}


def part_tables(content: bytes, source: str, channel: str = "") -> list[Table]:
    """Return a table for each part of an archive whose arrays hold all parts.

    Parts are the first axis of the channel's array, or of the largest without one. Arrays of
    another first axis hold for all parts.
    """
    arrays, _ = read_archive(content, name=source)
    stem = channel if channel in arrays else channel.rpartition(".")[0]
    if not channel:
        stem = max(arrays, key=lambda name: arrays[name].size, default="")
    if stem not in arrays or not arrays[stem].ndim:
        raise UnreadableError(f"Expected an array {channel}, got {listed(arrays)}", column=channel)
    n = len(arrays[stem])
    tables = []
    for i in range(n):
        columns: Columns = {}
        for name, x in arrays.items():
            columns |= _array_columns(name, x[i] if x.ndim and len(x) == n else x)
        tables.append(Table(source, columns, []))
    return tables


def read_ts(content: bytes, source: str, form: TextForm) -> list[Table]:
    """Return a table for each series of a `.ts` file of the UCR archive.

    Channels are the columns `0`, `1`, ..., the class is the column `class`.

    References
    ----------
    Middlehurst et al. (2024), aeon: a Python toolkit for learning from time series, JMLR 25(289).
    """
    lines = to_utf8(content, form.encoding).decode().split("\n")
    begin = next((i for i, line in enumerate(lines, 1) if line.strip().lower() == "@data"), 0)
    if not begin:
        raise UnreadableError("Expected series below a line @data, got none")
    tables = []
    for number, line in enumerate(lines[begin:], begin + 1):
        *channels, label = line.strip().split(":")
        if channels:
            cells = {str(i): as_cells(text.split(",")) for i, text in enumerate(channels)}
            tables.append(Table(source, cells | {"class": as_cells([label])}, [number]))
    return tables
