"""Split what a file holds into one table for each part, by its layout."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from ...errors import DataError
from ..dataset import Fault
from ..description import ANY, Description
from ..table import Cells, Table, as_word
from ..triggers import as_trigger
from . import frames
from .clock import is_dated
from .files import natural_key
from .text import Test, read_text

Parts = Iterator[tuple[str, str, Table]]  # the source, the path by which it is named, the table
NUMBER = r"\d[\d.]*"  # for which `*` stands in a wide table: `F*` is not `Fmax`
OBJECTS = ("json", "jsonl", "ts")


def tables_of(content: bytes, name: str, description: Description) -> list[Table]:
    """Return the tables of a file: of JSON and `.ts` files one for each object or series.

    Raises UnreadableError or DataError if it is no file of the described format.
    """
    kind, layout, form = description.format, description.layout, description.text
    if kind == "ts":
        return frames.read_ts(content, name, form)
    if kind in OBJECTS:
        return frames.read_objects(content, name, form, kind == "jsonl")
    if kind == "parquet":
        return [frames.read_parquet(content, name)]
    if kind == "npz" and layout == "npz":
        return frames.part_tables(content, name)
    if kind == "npz":
        return [frames.read_npz(content, name)]
    keep_damaged = layout in ("long", "wide")
    return [read_text(content, name, form, *column_kinds(description), keep_damaged)]


def column_kinds(description: Description) -> tuple[Test, Test]:
    """Return two functions of a column's name: whether its cells are numbers, and whether words."""
    clock = zip(description.time.column, description.time.format, strict=False)
    dated = {name for name, form in clock if is_dated(form)}
    order = {description.order} - {"name", "time"}
    words = dated.union(description.part.column, description.rows, order)
    words |= {source.column for source in (description.label, *description.check)}
    numbers = {*description.time.column, *signals_of(description)} - words
    patterns = [pattern_of(channel.column) for channel in description.channels]

    def is_number(name: str) -> bool:
        return name in numbers or any(pattern.fullmatch(name) for pattern in patterns)

    return is_number, words.__contains__


def signals_of(description: Description) -> Sequence[str]:
    """Return the signals of the trigger that cuts a long recording."""
    trigger = description.windows.trigger
    return as_trigger(trigger).signals if trigger else ()


def verdicts_of(description: Description) -> set[str]:
    """Return the topics of a bag that have labels."""
    return {source.topic for source in (description.label, *description.check)} - {""}


def pattern_of(column: str, any_text: str = ".*") -> re.Pattern[str]:
    """Return the pattern of a channel's columns, in which `*` stands for any text."""
    return re.compile(any_text.join(map(re.escape, column.split(ANY))), re.DOTALL)


def split(
    tables: Sequence[Table], name: str, description: Description, faults: list[Fault]
) -> Parts:
    """Yield each part of a file: its source, the path or column that names it, and its table.

    `long`: the rows of a part must stand together, unless they are sorted by time; others are put
    into `faults`. `wide`: the cells of the columns that a channel's pattern matches, in the order
    of their numbers, are its samples, or the list in its cell. `columns`: so is each column. Cells
    that are empty at the end are no samples.
    """
    layout, table = description.layout, tables[0]
    if layout == "long":
        table = frames.join(tables) if len(tables) > 1 else table
        yield from _split_rows(table, name, description, faults)
    elif layout == "columns":
        yield from _split_columns(table, name, description)
    elif layout == "wide" and description.format not in OBJECTS:
        yield from _split_wide(table, name, description, faults)
    else:
        for i, table in enumerate(tables, 1):
            row = f", row {table.line(0) or i}" if len(tables) > 1 else ""
            yield f"{name}{row}", name, table


def _split_rows(table: Table, name: str, description: Description, faults: list[Fault]) -> Parts:
    """Yield the rows of each part, by the words in its columns.

    A part is a fault if a row of another number of cells stands within it or beside it.
    """
    import pandas as pd

    columns = [*description.part.column]
    if not columns:
        raise DataError("Expected part.column, the column that tells the parts apart.")
    damaged = np.searchsorted(table.lines, [*table.damage]).tolist() if table.damage else []
    kept = np.delete(np.arange(len(table.lines)), damaged)
    keys = [table.words(column)[kept] for column in columns]
    for key, group in pd.Series(kept).groupby(keys, sort=False):
        rows = group.to_numpy()
        source = f"{name}, {' '.join(key)}"
        first = int(rows[0])
        last = int(rows[-1])
        is_whole = last - first < len(rows)
        near = [row for row in damaged if first - 1 <= row <= last + 1]
        if near:
            line = table.line(near[0])
            faults.append(Fault(source, line, table.damage[line]))
        elif is_whole or description.time.sort:
            part = table.take(slice(first, last + 1) if is_whole else rows)
            yield source, name, replace(part, damage={})
        else:
            line = table.line(int(rows[np.argmax(np.diff(rows) > 1) + 1]))
            message = "Expected the rows of a part together, others stand between them"
            faults.append(Fault(source, line, message, columns[0]))


def _split_wide(table: Table, name: str, description: Description, faults: list[Fault]) -> Parts:
    """Yield each row."""
    groups: dict[str, list[str]] = {}
    for key in [channel.column for channel in description.channels if ANY in channel.column]:
        names = sorted(filter(pattern_of(key, NUMBER).fullmatch, table.columns), key=natural_key)
        if names:
            groups[key] = names
    cells = {key: np.stack([*map(table.column, names)], axis=1) for key, names in groups.items()}
    used = {*chain(*groups.values())}
    others = {column: c for column, c in table.columns.items() if len(c) and column not in used}
    for i, line in enumerate(table.lines):
        source = f"{name}, row {line}"
        if line in table.damage:
            faults.append(Fault(source, line, table.damage[line]))
            continue
        columns: frames.Columns = {}
        for column, values in others.items():
            columns |= frames.columns_of(column, values[i])
        part = replace(table, columns=columns, lines=[line], damage={})
        samples = {key: without_empty_end(rows[i]) for key, rows in cells.items()}
        yield source, name, _with_samples(part, samples, groups)


def _split_columns(table: Table, name: str, description: Description) -> Parts:
    """Yield each column that the channel's pattern matches, with the clock beside it."""
    channel = description.channels[0].column
    shared = {*description.time.column, *description.rows}
    beside = {key: cells for key, cells in table.columns.items() if key in shared}
    for column in filter(pattern_of(channel).fullmatch, table.columns):
        if column not in shared:
            samples = without_empty_end(table.columns[column])
            part = replace(table, columns=beside).take(slice(0, len(samples)))
            origin = {channel: [column] * len(table.lines)}
            yield (
                f"{name}, column {column}",
                column,
                _with_samples(part, {channel: samples}, origin),
            )


def _with_samples(
    table: Table, samples: frames.Columns, origin: Mapping[str, Sequence[str]]
) -> Table:
    """Return a table with the samples of channels, which stood in other columns."""
    units = {key: table.units.get(names[0], "") for key, names in origin.items() if names}
    columns = {**table.columns, **samples}
    return replace(table, columns=columns, units={**table.units, **units}, origin=origin)


def without_empty_end(cells: Cells) -> Cells:
    """Return cells without those at the end that are empty or NaN."""
    n = len(cells)
    while n and as_word(cells[n - 1]) in ("", "NaN", "nan"):
        n -= 1
    return cells[:n]
