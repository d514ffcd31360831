"""Split what a file holds into one table for each part, by its layout."""

import re
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from ..dataset import Fault
from ..description import ANY, Description
from ..table import Table, as_word
from ..triggers import as_trigger
from . import frames
from .files import natural_key
from .text import read_text

NUMBER = r"\d[\d.]*"  # for which `*` stands in a wide table: `F*` is not `Fmax`
Parts = Iterator[tuple[str, str, Table]]  # the source, the path by which it is named, the table


def tables_of(content: bytes, name: str, description: Description) -> list[Table]:
    """Return the tables of a file: of JSON and `.ts` files one for each object or series.

    Raises UnreadableError or DataError if it is no file of the described format.
    """
    kind = description.format
    if kind in ("json", "jsonl"):
        return frames.read_objects(content, name, description.text)
    if kind == "ts":
        return frames.read_ts(content, name, description.text)
    if kind == "parquet":
        return [frames.read_parquet(content, name)]
    if kind == "npz" and description.layout == "npz":
        return frames.part_tables(content, name, description.channels[0].column)
    if kind == "npz":
        return [frames.read_npz(content, name)]
    numeric, words = column_kinds(description)
    return [read_text(content, name, description.text, numeric, words)]


def column_kinds(description: Description) -> tuple[Any, Any]:
    """Return two functions of a column's name: whether its cells are numbers, and whether words."""
    clock = dict(zip(description.time.column, description.time.format, strict=False))
    dated = {name for name, form in clock.items() if form == "iso" or "%" in form}
    sources = (description.label, *description.check)
    words = dated | {*description.part.column, *description.rows}
    words |= {source.column for source in sources if not source.listing}
    words |= {description.order} - {"name", "time"}
    patterns = [pattern_of(channel.column) for channel in description.channels]
    numbers = {*clock} - dated
    if description.windows.trigger:
        numbers |= {*as_trigger(description.windows.trigger).signals}
    is_number = lambda name: name in numbers or any(p.fullmatch(name) for p in patterns)  # noqa: E731
    return is_number, words.__contains__


def pattern_of(column: str, any_text: str = ".*") -> re.Pattern[str]:
    """Return the pattern of a channel's columns, in which `*` stands for any text."""
    return re.compile(any_text.join(map(re.escape, column.split(ANY))))


def split(
    tables: Sequence[Table], name: str, description: Description, faults: list[Fault]
) -> Parts:
    """Yield each part of a file: its source, the path or column that names it, and its table.

    `long`: the rows of a part must stand together, unless they are sorted by time; others are put
    into `faults`. `wide`: the cells of the columns that a channel's pattern matches, in the order
    of their numbers, are its samples, or the list in its cell. `columns`: so is each column. Cells
    that are empty at the end are no samples.
    """
    if description.layout == "long":
        yield from _split_rows(_joined(tables), name, description, faults)
    elif description.layout == "columns":
        yield from _split_columns(tables[0], name, description)
    elif description.layout == "wide" and len(tables) == 1 and len(tables[0].lines) > 1:
        yield from _split_wide(tables[0], name, description)
    else:
        for i, table in enumerate(tables, 1):
            row = table.line(0) if len(table.lines) == 1 else i
            yield (f"{name}, row {row or i}" if len(tables) > 1 else name), name, table


def _joined(tables: Sequence[Table]) -> Table:
    """Return the only table, or one table of many with a row each."""
    return tables[0] if len(tables) == 1 else frames.join(tables)


def _split_rows(table: Table, name: str, description: Description, faults: list[Fault]) -> Parts:
    """Yield the rows of each part, by the words in its columns."""
    import pandas as pd

    words = [table.words(column) for column in description.part.column]
    if not words:
        raise DataError("Expected part.column, the column that tells the parts apart.")
    keys = words[0] if len(words) == 1 else pd.MultiIndex.from_arrays(words)
    codes, _ = pd.factorize(keys)
    order = np.argsort(codes, kind="stable")
    ends = np.searchsorted(codes[order], np.arange(codes.max() + 2))
    for rows in (order[begin:end] for begin, end in zip(ends, ends[1:], strict=False)):
        source = f"{name}, {' '.join(str(word[rows[0]]) for word in words)}"
        if rows[-1] - rows[0] < len(rows):
            yield source, name, table.take(slice(rows[0], rows[-1] + 1))
        elif description.time.sort:
            yield source, name, table.take(rows)
        else:
            line = table.line(int(rows[np.argmax(np.diff(rows) > 1) + 1]))
            message = "Expected the rows of a part together, others stand between them"
            faults.append(Fault(source, line, message, description.part.column[0]))


def _split_wide(table: Table, name: str, description: Description) -> Parts:
    """Yield each row."""
    names = [channel.column for channel in description.channels if ANY in channel.column]
    patterns = {name: pattern_of(name, NUMBER) for name in names}
    groups = {
        pattern: sorted(filter(matcher.fullmatch, table.columns), key=natural_key)
        for pattern, matcher in patterns.items()
    }
    cells = {
        key: np.stack([table.columns[c] for c in names], axis=1)
        for key, names in groups.items()
        if names
    }
    units = {key: table.units.get(names[0], "") for key, names in groups.items() if names}
    used = {column for names in groups.values() for column in names}
    others = [name for name, cells in table.columns.items() if name not in used and len(cells)]
    for i, line in enumerate(table.lines):
        columns = {key: without_empty_end(rows[i]) for key, rows in cells.items()}
        for column in others:
            columns |= frames.columns_of(column, table.columns[column][i])
        yield f"{name}, row {line}", name, Table(name, columns, [line], {**table.units, **units})


def _split_columns(table: Table, name: str, description: Description) -> Parts:
    """Yield each column that the channel's pattern matches, with the clock beside it."""
    channel = description.channels[0].column
    clock = {*description.time.column}
    for column, cells in table.columns.items():
        if column not in clock and pattern_of(channel).fullmatch(column):
            kept = without_empty_end(cells)
            columns = {key: table.columns[key][: len(kept)] for key in clock} | {channel: kept}
            units = table.units | {channel: table.units.get(column, "")}
            yield (
                f"{name}, column {column}",
                column,
                Table(name, columns, table.lines[: len(kept)], units),
            )


def without_empty_end(cells: NDArray[Any]) -> NDArray[Any]:
    """Return cells without those at the end that are empty or NaN."""
    n = len(cells)
    while n and as_word(cells[n - 1]) in ("", "NaN", "nan"):
        n -= 1
    return cells[:n]
