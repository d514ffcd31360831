"""Read JSON, Parquet tables, NumPy archives, UCR's `.ts` files and DataFrames as a `Table`.

Nested objects become columns with dots in their names: `{"curve": {"force": [1, 2]}}` has the
column `curve.force`, a list of pairs under `points` the columns `points.0` and `points.1`, and a
list of objects the columns of their keys.
"""

import io
import json
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import shortened
from ...files import read_archive, read_errors
from ..description import TextForm
from ..table import Table, UnreadableError
from .text import to_utf8

MOST_CHANNELS = 16  # a list of so few lists has a channel in each, a longer one a sample


def read_objects(content: bytes, source: str, form: TextForm) -> list[Table]:
    """Return a table for each object of a JSON file: one, a list of them, or one a line."""
    text = to_utf8(content, form.encoding).decode()
    try:
        found = json.loads(text)
        objects = found if isinstance(found, list) else [found]
        lines = [0] * len(objects)
    except json.JSONDecodeError as whole:
        objects, lines = [], []
        for number, line in enumerate(text.split("\n"), 1):
            try:
                objects += [json.loads(line)] if line.strip() else []
                lines += [number] if line.strip() else []
            except json.JSONDecodeError as error:
                first = number == 1
                place = whole.lineno if first else number
                why = whole.msg if first else error.msg
                raise UnreadableError(f"Expected JSON: {why}", place) from error
    except RecursionError as error:
        raise UnreadableError("Expected JSON that is nested less deeply") from error
    tables = []
    for line, value in zip(lines, objects, strict=True):
        if not isinstance(value, Mapping):
            raise UnreadableError(f"Expected an object of JSON, got {shortened(value)}", line)
        tables.append(Table(source, dict(_flatten("", value)), [line]))
    return tables


def _flatten(prefix: str, value: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the columns of a nested object, each with its cells; a scalar is a column of one."""
    if isinstance(value, Mapping):
        for name, item in value.items():
            yield from _flatten(f"{prefix}.{name}" if prefix else str(name), item)
    elif isinstance(value, list) and value and isinstance(value[0], Mapping):
        for name in value[0]:
            cells = [item.get(name) if isinstance(item, Mapping) else None for item in value]
            yield from _flatten(f"{prefix}.{name}", cells)
    elif isinstance(value, list) and value and isinstance(value[0], list):
        by_channel = len(value) <= MOST_CHANNELS
        n = len(value) if by_channel else len(value[0])
        for i in range(n):
            cells = value[i] if by_channel else [row[i] if i < len(row) else None for row in value]
            yield f"{prefix}.{i}", _cells(cells)
    else:
        yield prefix, _cells(value if isinstance(value, list) else [value])


def _cells(values: Any) -> NDArray[Any]:
    """Return values as an array (n,) of numbers if all are numbers, else of objects."""
    try:
        cells = np.asarray(values)
    except (ValueError, OverflowError):
        cells = np.empty(0)
    if cells.ndim == 1 and cells.dtype.kind in "iufM" and len(cells) == len(values):
        return cells
    cells = np.empty(len(values), dtype=object)
    cells[:] = values
    return cells


def read_frame(frame: Any, source: str) -> Table:
    """Return the table of a DataFrame, whose index is a column if it has a name."""
    if frame.index.name is not None:
        frame = frame.reset_index()
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
    columns = dict[str, NDArray[Any]]()
    for name, x in arrays.items():
        x = np.atleast_1d(np.squeeze(x))
        if x.ndim == 1:
            columns[name] = x
            continue
        if x.ndim > 2:
            continue
        channels = x if x.shape[0] <= x.shape[1] else x.T
        columns |= {f"{name}.{i}": channel for i, channel in enumerate(channels)}
    return Table(source, columns, [])


def read_ts(content: bytes, source: str, form: TextForm) -> list[Table]:
    """Return a table for each series of a `.ts` file of the UCR archive.

    Channels are the columns `0`, `1`, ..., the class is the column `class`. `?` is a lost sample.

    References
    ----------
    Middlehurst et al. (2024), aeon: a Python toolkit for learning from time series, JMLR 25(289).
    """
    tables = []
    begun = False
    for number, line in enumerate(to_utf8(content, form.encoding).decode().split("\n"), 1):
        if not begun or not line.strip():
            begun = begun or line.strip().lower() == "@data"
            continue
        *channels, label = line.strip().split(":")
        columns = {"class": np.array([label], dtype=object)}
        for i, channel in enumerate(channels):
            columns[str(i)] = np.array([cell.strip() for cell in channel.split(",")], dtype=object)
        tables.append(Table(source, columns, [number]))
    if not tables:
        raise UnreadableError("Expected series below a line @data, got none")
    return tables


def rows_of(table: Table) -> Iterator[Table]:
    """Yield a table for each row of a table whose cells may be lists or objects."""
    for i in range(len(table.lines)):
        cells = {name: column[i] for name, column in table.columns.items()}
        columns = dict[str, NDArray[Any]]()
        for name, cell in cells.items():
            if isinstance(cell, np.ndarray) and cell.dtype.kind != "O":
                columns[name] = cell
            else:
                value = cell.tolist() if isinstance(cell, np.ndarray) else cell
                columns |= dict(_flatten(name, value))
        yield Table(table.source, columns, [table.line(i)])


def part_tables(arrays: Mapping[str, NDArray[Any]], n: int, source: str) -> list[Table]:
    """Return a table for each of n parts, which arrays hold along their first axis.

    An array (n, C, T) has the columns `NAME.0`, `NAME.1`, ...; one of another first axis holds for
    all parts.
    """
    tables = []
    for i in range(n):
        columns = dict[str, NDArray[Any]]()
        for name, x in arrays.items():
            of_part = x[i] if x.ndim and len(x) == n else x
            if of_part.ndim == 2:
                columns |= {f"{name}.{c}": of_part[c] for c in range(len(of_part))}
            else:
                columns[name] = np.atleast_1d(of_part)
        tables.append(Table(source, columns, []))
    return tables
