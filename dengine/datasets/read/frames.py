"""Read JSON, Parquet tables, NumPy archives, UCR's `.ts` files and DataFrames as a `Table`.

Nested objects become columns with dots in their names: `{"curve": {"force": [1, 2]}}` has the
column `curve.force`, a list of pairs under `points` the columns `points.0` and `points.1`, and a
list of objects the columns of their keys.
"""

import io
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ...errors import listed, shortened
from ...files import read_archive, read_errors
from ..description import TextForm
from ..table import Cells, Table, UnreadableError
from .text import to_utf8

MOST_CHANNELS = 16  # a list of so few lists has a channel in each, a longer one a sample
Columns = dict[str, Cells]
DAMAGES = (ValueError, RecursionError)


def read_objects(content: bytes, source: str, form: TextForm) -> list[Table]:
    """Return a table for each object of a JSON file: one, a list of them, or one a line."""
    text = to_utf8(content, form.encoding).decode()
    try:
        found = json.loads(text)
        rows = [(0, value) for value in (found if isinstance(found, list) else [found])]
    except DAMAGES:
        rows = [(i, _parse(line, i)) for i, line in enumerate(text.split("\n"), 1) if line.strip()]
    for line, value in rows or [(0, "")]:
        if not isinstance(value, Mapping):
            raise UnreadableError(f"Expected an object of JSON, got {shortened(value)}", line)
    return [Table(source, columns_of("", value), [line]) for line, value in rows]


def _parse(line: str, number: int) -> Any:
    """Return the object in a line of JSON; raise UnreadableError for another text."""
    try:
        return json.loads(line)
    except DAMAGES as error:
        raise UnreadableError(f"Expected JSON: {error}", number) from error


def columns_of(prefix: str, value: Any) -> Columns:
    """Return the columns of a nested object, each with its cells; a scalar is a column of one."""
    value = value.tolist() if isinstance(value, np.ndarray) else value
    items = value if isinstance(value, list) else [value]
    first = items[0] if items else None
    nested: Mapping[Any, Any]
    if isinstance(value, Mapping):
        nested = value
    elif isinstance(first, Mapping | list | np.ndarray):
        nested = _turned(prefix, items, first)
    else:
        return {prefix: as_cells(items)}
    stem = f"{prefix}." if prefix else ""
    return _flat(columns_of(f"{stem}{name}", item) for name, item in nested.items())


def _turned(prefix: str, items: Sequence[Any], first: Any) -> Mapping[Any, Any]:
    """Return the lists of a list of objects by their keys, or of lists by their places."""
    forms = {len(item) if isinstance(item, type(first)) else -1 for item in items}
    if len(forms) > 1:
        message = f"Expected lists or objects of one length in {prefix}, got others"
        raise UnreadableError(message, column=prefix)
    if isinstance(first, Mapping):
        return {name: [item.get(name) for item in items] for name in first}
    is_wide = len(items) <= MOST_CHANNELS
    return dict(enumerate(map(list, items if is_wide else zip(*items, strict=True))))


def _flat(columns: Iterable[Columns]) -> Columns:
    """Return all columns of some."""
    return {name: cells for some in columns for name, cells in some.items()}


def as_cells(values: Sequence[Any]) -> Cells:
    """Return values as an array (n,) of numbers if all are numbers, else of objects."""
    if {*map(type, values)} <= {int, float} and all(abs(value) < 2**62 for value in values):
        return np.array(values)
    cells = np.empty(len(values), dtype=object)
    cells[:] = values
    return cells


def join(tables: Sequence[Table]) -> Table:
    """Return one table of tables with a row each, in the columns of the first."""
    columns = {
        name: as_cells([next(iter(table.columns.get(name, ())), None) for table in tables])
        for name in tables[0].columns
    }
    return Table(tables[0].source, columns, [table.line(0) for table in tables])


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
    return Table(source, _flat(_array_columns(k, np.squeeze(x)) for k, x in arrays.items()), [])


def _array_columns(name: str, x: Cells) -> Columns:
    """Return the columns of an array of one part, a scalar, (n,), (C, n) or (n, C)."""
    if x.ndim < 2:
        return {name: np.atleast_1d(x)}
    rows = x if len(x) <= x.shape[1] else np.swapaxes(x, 0, 1)
    return _flat(_array_columns(f"{name}.{i}", row) for i, row in enumerate(rows))


def part_tables(content: bytes, source: str, channel: str = "") -> list[Table]:
    """Return a table for each part of an archive whose arrays hold all parts.

    Parts are the first axis of the channel's array, or of the largest without one. Arrays of
    another first axis hold for all parts.
    """
    arrays, _ = read_archive(content, name=source)
    stem = channel if channel in arrays else channel.rpartition(".")[0]
    if not channel:
        stem = max(arrays, key=lambda name: arrays[name].size, default="")
    n = len(np.atleast_1d(arrays.get(stem, [])))
    if not n:
        raise UnreadableError(f"Expected an array {channel}, got {listed(arrays)}", column=channel)
    tables = []
    for i in range(n):
        of_part = {name: x[i] if x.ndim and len(x) == n else x for name, x in arrays.items()}
        columns = _flat(_array_columns(name, x) for name, x in of_part.items())
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
