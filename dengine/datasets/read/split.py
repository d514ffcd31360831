"""Split what a file holds into one table for each part, by its layout."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

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
OBJECTS = {"json": frames.read_objects, "jsonl": frames.read_objects, "ts": frames.read_ts}
TABLES = {"parquet": frames.read_parquet, "npz": frames.read_npz}


def tables_of(content: bytes, name: str, description: Description) -> list[Table]:
    """Return the tables of a file: of JSON and `.ts` files one for each object or series.

    Raises UnreadableError or DataError if it is no file of the described format.
    """
    kind, layout, form = description.format, description.layout, description.text
    if (kind, layout) == ("npz", "npz"):
        return frames.part_tables(content, name, description.channels[0].column)
    if kind in OBJECTS:
        return OBJECTS[kind](content, name, form)
    if kind in TABLES:
        return [TABLES[kind](content, name)]
    keep_damaged = layout in ("long", "wide")
    return [read_text(content, name, form, *column_kinds(description), keep_damaged)]


def column_kinds(description: Description) -> tuple[Test, Test]:
    """Return two functions of a column's name: whether its cells are numbers, and whether words."""
    clock = dict(zip(description.time.column, description.time.format, strict=False))
    dated = {name for name, form in clock.items() if is_dated(form)}
    sources = (description.label, *description.check)
    words = dated | {*description.part.column, *description.rows}
    words |= {source.column for source in sources if not source.listing}
    words |= {description.order} - {"name", "time"}
    numbers = {*clock, *signals_of(description)} - dated
    patterns = [pattern_of(channel.column) for channel in description.channels]

    def is_number(name: str) -> bool:
        return name in numbers or any(pattern.fullmatch(name) for pattern in patterns)

    return is_number, words.__contains__


def signals_of(description: Description) -> Sequence[str]:
    """Return the signals of the trigger that cuts a long recording."""
    trigger = description.windows.trigger
    return as_trigger(trigger).signals if trigger else ()


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
    layout = description.layout
    if layout == "long":
        table = tables[0] if len(tables) == 1 else frames.join(tables)
        yield from _split_rows(table, name, description, faults)
    elif layout == "columns":
        yield from _split_columns(tables[0], name, description)
    elif layout == "wide" and description.format not in OBJECTS:
        yield from _split_wide(tables[0], name, description, faults)
    else:
        for i, table in enumerate(tables, 1):
            row = table.line(0) if len(table.lines) == 1 else i
            yield f"{name}, row {row or i}" if len(tables) > 1 else name, name, table


def _split_rows(table: Table, name: str, description: Description, faults: list[Fault]) -> Parts:
    """Yield the rows of each part, by the words in its columns."""
    import pandas as pd

    words = [table.words(column) for column in description.part.column]
    if not words:
        raise DataError("Expected part.column, the column that tells the parts apart.")
    keys = [*map("\x1f".join, zip(*words, strict=True))] if len(words) > 1 else words[0]
    codes, _ = pd.factorize(np.asarray(keys, dtype=object))
    damage = _damaged_parts(table, codes)
    order = np.argsort(codes, kind="stable")
    ends = np.searchsorted(codes[order], np.arange(codes.max() + 2)).tolist()
    for code, (begin, end) in enumerate(pairwise(ends)):
        rows = order[begin:end]
        if not len(rows):  # that of damaged rows
            continue
        source = f"{name}, {' '.join(str(word[rows[0]]) for word in words)}"
        is_whole = rows[-1] - rows[0] < len(rows)
        if code in damage:
            faults.append(Fault(source, damage[code], table.damage[damage[code]]))
        elif is_whole or description.time.sort:
            yield source, name, table.take(slice(rows[0], rows[-1] + 1) if is_whole else rows)
        else:
            line = table.line(int(rows[np.argmax(np.diff(rows) > 1) + 1]))
            message = "Expected the rows of a part together, others stand between them"
            faults.append(Fault(source, line, message, description.part.column[0]))


def _damaged_parts(table: Table, codes: Cells) -> dict[int, int]:
    """Return the line of a damaged row for each part that may have lost it; set its code to -1.

    These are the parts of the rows before and behind it.
    """
    if not table.damage:
        return {}
    codes[np.isin(table.lines, [*table.damage])] = -1
    rows = np.flatnonzero(codes == -1)[::-1].tolist()  # the first one of a part is named
    near = ((code, row) for row in rows for code in codes[max(row - 1, 0) : row + 2].tolist())
    return {code: table.line(row) for code, row in near}


def _split_wide(table: Table, name: str, description: Description, faults: list[Fault]) -> Parts:
    """Yield each row."""
    keys = [channel.column for channel in description.channels if ANY in channel.column]
    found = {key: [*filter(pattern_of(key, NUMBER).fullmatch, table.columns)] for key in keys}
    groups = {key: sorted(names, key=natural_key) for key, names in found.items() if names}
    cells = {key: np.stack([*map(table.column, names)], axis=1) for key, names in groups.items()}
    units = {key: table.units.get(names[0], "") for key, names in groups.items()}
    units = {**table.units, **units}
    others = {*table.columns}.difference(*groups.values())
    for i, line in enumerate(table.lines):
        source = f"{name}, row {line}"
        if line in table.damage:
            faults.append(Fault(source, line, table.damage[line]))
            continue
        columns = {key: without_empty_end(rows[i]) for key, rows in cells.items()}
        for column in filter(lambda name: len(table.columns[name]), others):
            columns |= frames.columns_of(column, table.columns[column][i])
        row = replace(table, columns=columns, lines=[line], units=units, origin=groups)
        yield source, name, row


def _split_columns(table: Table, name: str, description: Description) -> Parts:
    """Yield each column that the channel's pattern matches, with the clock beside it."""
    channel = description.channels[0].column
    shared = {*description.time.column, *description.rows} & {*table.columns}
    for column in filter(pattern_of(channel).fullmatch, table.columns):
        if column not in shared:
            samples = without_empty_end(table.columns[column])
            n = len(samples)
            columns = {key: table.columns[key][:n] for key in shared} | {channel: samples}
            units = {**table.units, channel: table.units.get(column, "")}
            origin = {channel: [column] * n}
            part = replace(
                table, columns=columns, lines=table.lines[:n], units=units, origin=origin
            )
            yield f"{name}, column {column}", column, part


def without_empty_end(cells: Cells) -> Cells:
    """Return cells without those at the end that are empty or NaN."""
    n = len(cells)
    while n and as_word(cells[n - 1]) in ("", "NaN", "nan"):
        n -= 1
    return cells[:n]
