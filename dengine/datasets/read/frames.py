"""Read JSON, Parquet tables, NumPy archives, UCR's `.ts` files and DataFrames as a `Table`.

Nested objects become columns with dots in their names: `{"curve": {"force": [1, 2]}}` has the
column `curve.force`. A list of pairs under `points` has the columns `points.0` and `points.1`. A
list of objects has a column for each of their keys.
"""

import io
import json
from collections.abc import Mapping
from itertools import chain
from typing import Any

import numpy as np

from ...errors import instead, shortened
from ...files import read_archive, read_errors
from ..description import TextForm, flat
from ..table import Cells, Table, UnreadableError
from .text import to_utf8

ITEMS = (list, np.ndarray)
Columns = dict[str, Cells]
Rows = list[tuple[int, Mapping[str, Any]]]  # the line of each, and its cells by column


def read_objects(content: bytes, source: str, form: TextForm, has_lines: bool) -> Table:
    """Return the table of a JSON file, with a row for each object.

    `content` may hold one object, a list of objects, or (with `has_lines`) these in each line, with
    empty lines between them. Keys of nested objects are joined by dots. A cell may be a list; it is
    None if the object lacks the key. `source` is the file's name in errors; of `form`, how texts
    are written, only the encoding is used. Raises UnreadableError if the file is not in this
    encoding, or the text is no JSON, or holds anything but objects, or nothing, and LookupError for
    an encoding that Python does not know.
    """
    text = to_utf8(content, form.encoding).decode()
    rows: Rows = []
    for number, line in enumerate(text.split("\n"), 1) if has_lines else [(0, text)]:
        try:
            value = json.loads(line.strip() or "[]")
        except (ValueError, RecursionError) as error:
            do = "" if has_lines else '; if each line is an object, state format="jsonl"'
            raise UnreadableError(f"Expected JSON: {error}{do}", number) from error
        for item in value if isinstance(value, list) else [value]:
            if not isinstance(item, Mapping):
                raise UnreadableError(f"Expected an object of JSON, got {shortened(item)}", number)
            rows.append((number, flat(item)))
    return _table_of(source, rows, "objects of JSON")


def _table_of(source: str, rows: Rows, wanted: str) -> Table:
    """Return a table of rows; without rows raise UnreadableError, which says what was `wanted`.

    `rows` are pairs of a row's line and its cells by column. A cell is None if its row lacks the
    column. `source` is the name of the file.
    """
    if not rows:
        raise UnreadableError(f"Expected {wanted}, got none")
    lines, cells = zip(*rows, strict=True)
    columns = {
        name: as_cells([row.get(name) for row in cells]) for name in dict.fromkeys(chain(*cells))
    }
    return Table(source, columns, np.array(lines))


def columns_of(prefix: str, value: Any) -> Columns:
    """Return a value of JSON or NumPy as columns by name; a scalar becomes a column with one cell.

    A list of scalars becomes one column, a mapping has a column for each key, and a list of
    mappings one for each key of the first of them. An array or list of lists (C, n) with C <= n, or
    (n, C) with C < n, has a column for each of its C channels. Nested values are treated in the
    same way; an empty list is a column without cells, an empty mapping none. Raises UnreadableError
    if a list whose first item is a list or mapping has an item of another kind, a mapping without a
    key of the first, or lists of different lengths, or if the first of its mappings has a list.

    prefix : the name of the value; a dot and the key, or the channel from 0, are appended. Without
    a name, "", a column is called by the key alone.
    """
    if isinstance(value, np.ndarray) and value.dtype == object:
        value = value.tolist()
    with instead(
        UnreadableError,
        f"Expected items of one form in {prefix}",
        LookupError,
        TypeError,
        ValueError,
    ):
        nested = _turned(value)
    if nested is None:
        return {prefix: as_cells(value if isinstance(value, ITEMS) else [value])}
    columns: Columns = {}
    for name, item in nested.items():
        columns |= columns_of(f"{prefix}.{name}" if prefix else str(name), item)
    return columns


def _turned(value: Any) -> Mapping[Any, Any] | None:
    """Return a list of mappings as one mapping of lists by key, a list of lists as one by channel.

    Keys that the first mapping lacks are left out. The shorter axis of a list of lists is the
    channels (of equal ones the first), which are numbered from 0. A NumPy array counts as a list. A
    mapping is returned as it is, and None for any other value, also an empty list. Raises
    LookupError, TypeError or ValueError if a mapping lacks a key of the first, an item is of
    another kind, lists in a list differ in length, or the first mapping has a list.
    """
    if isinstance(value, Mapping):
        return value
    first = value[0] if isinstance(value, ITEMS) and len(value) else None
    if isinstance(first, Mapping):
        columns = {key: [item[key] for item in value] for key in first}
        if any(isinstance(cell, ITEMS) for cell in first.values()):
            raise ValueError("lists within them, see 'Recordings that dengine does not read'")
        return columns
    if not isinstance(first, ITEMS):
        return None
    x = np.array(value, dtype=object)
    return dict(enumerate(x if len(x) <= x.shape[1] else x.swapaxes(0, 1)))


def as_cells(values: Any) -> Cells:
    """Return values as an array (n,): of numbers if all are int or float, otherwise of objects.

    An array is returned as it is. True, False and numbers of NumPy's own types count as objects;
    without values the array is of floats.
    """
    if isinstance(values, np.ndarray) or {*map(type, values)} <= {int, float}:
        return np.asarray(values)
    cells = np.empty(len(values), dtype=object)
    cells[:] = values
    return cells


def read_frame(frame: Any, source: str) -> Table:
    """Return the table of a DataFrame, whose index is a column, or several.

    An index without a name, of one level and not of times, is left out; one of times becomes the
    column `index`. `source` is the table's name in errors. Names of columns become texts, which
    must differ: this is not checked. Rows are numbered from 1. Raises ValueError if the index is
    named like a column.
    """
    is_plain = frame.index.names == [None] and frame.index.dtype.kind not in "mM"
    frame = frame.reset_index(drop=is_plain)
    columns = {}
    for name, cells in frame.items():
        has_na = cells.hasnans and not isinstance(cells.dtype, np.dtype)  # pandas' own NA
        columns[str(name)] = cells.to_numpy(object, na_value=None) if has_na else cells.to_numpy()
    return Table(source, columns, np.arange(1, len(frame) + 1))


def read_parquet(content: bytes, source: str) -> Table:
    """Return the table of a Parquet file.

    `content` has its bytes, and `source` is its name in errors. An index that pandas stored in it
    becomes a column, or several; a plain one without a name is left out (see `read_frame`). Raises
    DataError if it is no Parquet file or is damaged, or if pyarrow is not installed.
    """
    with read_errors(source, "a Parquet file", "pyarrow", "files"):
        import pandas as pd

        return read_frame(pd.read_parquet(io.BytesIO(content)), source)


def read_npz(content: bytes, source: str, has_all: bool) -> Table:
    """Return the table of a NumPy archive, which holds one part, or all parts if `has_all`.

    A part is a workpiece. For one part, axes of length 1 are dropped; then an array (n,) becomes a
    column, and an array (C, n), or (n, C) with C < n, a column for each channel. For all parts,
    each array is a column whose cell i is its item i, and there are as many rows as the array with
    most numbers has items; an array with more or fewer items stays as it is. `content` has the
    bytes of the archive, and `source` is its name in errors. Raises DataError if it is no archive,
    is damaged, has Python objects or needs too much memory (`read_archive`), and UnreadableError if
    it has no array.
    """
    arrays, _ = read_archive(content, name=source)
    if not arrays:
        raise UnreadableError("Expected arrays, got none")
    columns = {k: np.atleast_1d(x if has_all else np.squeeze(x)) for k, x in arrays.items()}
    if not has_all:
        return Table(source, columns_of("", columns))
    return Table(source, columns, range(1, len(max(columns.values(), key=np.size)) + 1))


def read_ts(content: bytes, source: str, form: TextForm) -> Table:
    """Return the table of a `.ts` file of the UCR archive, with a row for each series.

    Channels are the columns `0`, `1`, ..., whose cells are lists of texts; the class is the column
    `class`, always the text behind the last colon of the line. A series with fewer channels than
    others has None for each that is missing. `content` has the bytes of the file, `source` is its
    name in errors, and of `form`, how texts are written, only the encoding is used. Raises
    UnreadableError if the file is not in this encoding, or has no series below a line `@data`, and
    LookupError for an encoding that Python does not know.

    References
    ----------
    Middlehurst et al. (2024), aeon: a Python toolkit for learning from time series, JMLR 25(289).
    """
    text = to_utf8(content, form.encoding).decode()
    rows: Rows = []
    is_data = False
    for number, line in enumerate(map(str.strip, text.split("\n")), 1):
        if is_data and line:
            *series, label = line.split(":")
            channels = {str(c): cells.split(",") for c, cells in enumerate(series)}
            rows.append((number, {**channels, "class": label}))
        is_data |= line.lower() == "@data"
    return _table_of(source, rows, "series below a line @data")
