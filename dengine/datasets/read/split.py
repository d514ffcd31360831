"""Split what a file holds into one table for each part, by its layout."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain

import numpy as np

from ...errors import DataError, instead
from ..description import ANY, ORDERS, Description, Strings
from ..table import Cells, Table, UnreadableError, as_word
from ..triggers import as_trigger
from . import frames
from .clock import is_dated
from .text import read_text

NUMBERED = r"(\d+(?:\.\d+)?(?:e-?\d+)?)"  # for which `*` stands in a wide table: `F*` is not `Fmax`
OBJECTS = ("json", "jsonl", "ts")


def table_of(content: bytes, name: str, description: Description) -> Table:
    """Return the table of a file in the format of the description.

    Any other format than `ts`, `json`, `jsonl`, `parquet` and `npz` is read as text. The layout of
    the description says how files hold parts. An .npz file is read as all parts, row by row, if it
    is `npz`, `wide` or `long`, otherwise as one part. `content` has the bytes of the file, and
    `name` is its name in errors. Raises UnreadableError or DataError if the file does not have this
    format, and DataError without pyarrow for a Parquet file. Raises LookupError for an encoding
    that Python does not know.
    """
    kind = description.format
    form = description.text
    if kind == "ts":
        return frames.read_ts(content, name, form)
    if kind in OBJECTS:
        return frames.read_objects(content, name, form, kind == "jsonl")
    if kind == "parquet":
        return frames.read_parquet(content, name)
    if kind == "npz":
        return frames.read_npz(content, name, description.layout in ("npz", "wide", "long"))
    return read_text(content, name, form, word_columns(description))


def word_columns(description: Description) -> set[str]:
    """Return the columns whose cells are read as words (texts), also if they are channels, too.

    The description says how recordings are read. The columns are those that it names for dates,
    times of day, part numbers, labels and the order of the parts (`order`), and those whose words
    tell which rows are samples (`[rows]`). The set also has "" if `[label]` or a `[[check]]`,
    another source of labels, names no column.
    """
    clock = description.time
    words = {name for name, form in zip(clock.column, clock.format, strict=False) if is_dated(form)}
    words.update(description.part.column, description.rows, {description.order} - ORDERS)
    return words.union(source.column for source in description.labels)


def signals_of(description: Description) -> Strings:
    """Return the columns that the trigger reads, which cuts a long recording; none without one.

    Raises SettingError for a malformed trigger.
    """
    trigger = description.windows.trigger
    return as_trigger(trigger).signals if trigger else ()


def verdicts_of(description: Description) -> set[str]:
    """Return the topics of a bag that hold labels, of `[label]` and `[[check]]`; empty without."""
    return {source.topic for source in description.labels} - {""}


def pattern_of(column: str, any_text: str = ".*") -> re.Pattern[str]:
    """Return the pattern of a channel's columns, in which `*` stands for any text.

    `any_text` is the regular expression that replaces each `*`. The pattern is for `fullmatch`.
    """
    return re.compile(any_text.join(map(re.escape, column.split(ANY))), re.DOTALL)


def split(table: Table, description: Description) -> Iterator[Table]:
    """Yield the table of each part of a file, by the layout of the description.

    A part is a workpiece, and the layout says how files hold parts. `long`: the rows with the same
    words in `part.column` are a part; they must stand together, unless `time.sort` is set.
    `columns`: each column that matches the first channel is a part. `wide`, `npz`, and a file of
    the formats json, jsonl and ts with one row, or with a list of two or more items in its first
    row: each row is a part; its samples are the list in a cell, or the cells of the columns that
    match the channel, like `x*`, with a number for its `*`, in the order of these numbers.
    Otherwise the file is one part.

    In such numbered columns and in the layout `columns`, empty cells at the end are no samples. The
    `damage` of a table lists errors, for example rows with a wrong number of cells. A part has
    damage if its row is damaged, or if a list of lists or mappings in it has items of different
    keys, kinds or lengths. In `long` damaged rows are in no part; a part has damage if one stands
    between its first and last row or directly beside these, or if rows of other parts stand between
    its own without `time.sort`. In `columns` and for a whole file, all damage of the file counts.
    Raises DataError if `part.column` of the layout `long` is not stated, is not in the table or has
    lists as cells, UnreadableError if the numbered columns of one channel differ in length, and
    RuntimeError for the layout `columns` without a channel.
    """
    table = replace(table, path=table.source)
    layout = description.layout
    if layout == "long":
        yield from _split_rows(table, description)
    elif layout == "columns":
        yield from _split_columns(table, description)
    elif layout in ("wide", "npz") or (
        description.format in OBJECTS and (len(table.lines) == 1 or longest_list(table) > 1)
    ):
        yield from _split_wide(table, description)
    else:
        yield table


def longest_list(table: Table) -> int:
    """Return the most items of a list or array among the first cells of the columns.

    Of a list of lists all items count. 0 if none of these cells is a list with items.
    """
    return max(
        (
            len(cell) * np.size(cell[0])
            for column in table.columns.values()
            for cell in column[:1]
            if isinstance(cell, frames.ITEMS) and len(cell)
        ),
        default=0,
    )


def _split_rows(table: Table, description: Description) -> Iterator[Table]:
    """Yield a table for each part: the rows that have equal words in the columns `part.column`.

    The parts come in the order of their first rows, and the words stand in each table's `source`. A
    row with a wrong number of cells is in no part. A part has `damage` (errors for which it is left
    out) if such a row stands between its first and its last row, or directly before or behind
    these. It also has damage if rows of other parts stand between its own and `time.sort` is not
    set. Raises DataError if `part.column` is not stated, or a column of it is not in the table or
    has lists as cells.
    """
    import pandas as pd

    columns = description.part.column
    if not columns:
        raise DataError("Expected part.column, the column that tells the parts apart.")
    damaged = np.searchsorted(table.lines, [error.line for error in table.damage])
    kept = np.delete(np.arange(len(table.lines)), damaged)
    keys = [table.words(column)[kept] for column in columns]
    for key, group in pd.Series(kept).groupby(keys, sort=False):
        rows = group.to_numpy()
        is_beside = (damaged >= rows[0] - 1) & (damaged <= rows[-1] + 1)
        damage = [table.damage[i] for i in np.flatnonzero(is_beside)]
        breaks = rows[1:][np.diff(rows) > 1]
        if len(breaks) and not description.time.sort:
            damage.append(
                UnreadableError(
                    "Expected the rows of a part together, others stand between them",
                    table.line(breaks[0]),
                    columns[0],
                )
            )
        yield replace(table.take(rows), source=f"{table.source}, {' '.join(key)}", damage=damage)


def _split_wide(table: Table, description: Description) -> Iterator[Table]:
    """Yield the table of each row, which is a part.

    A channel or clock like `x*` gets its samples from several columns (`_join_numbered`), without
    empty cells at the end. Any other cell becomes a column of one cell, or, if it is a list or
    mapping, one column or several (`frames.columns_of`); a column without a cell for each row is in
    every part as a whole, and an empty one in none. A part has `damage` (errors for which it is
    left out) if its row had a wrong number of cells. If a list of lists or mappings in it has items
    that are not all alike, that is its only damage, and it has no columns; a list that begins with
    a number or text may be mixed. Raises UnreadableError if the columns of one `x*` differ in
    length.
    """
    table = _join_numbered(table, description)
    n = len(table.lines)
    for i, line in enumerate(table.lines):
        row = {name: c[i] if len(c) == n else c for name, c in table.columns.items()}
        damage = [error for error in table.damage if error.line == line]
        try:
            columns = frames.columns_of("", row)
        except UnreadableError as error:
            columns = {}
            damage = [error]
        for key in table.origin.keys() & columns.keys():
            columns[key] = without_empty_end(columns[key])
        yield replace(
            table,
            source=f"{table.source}, row {line or i + 1}" if n > 1 else table.source,
            columns=columns,
            lines=[line],
            damage=damage,
        )


def _join_numbered(table: Table, description: Description) -> Table:
    """Return a table in which the columns of a channel or clock like `x*` are one, of arrays.

    These are the columns in which a number stands for the `*`, in the order of these numbers
    (`origin`); the unit is that of the first of them. They, and columns without cells, are left
    out. Raises UnreadableError if the columns of one `x*` differ in length.
    """
    origin = dict[str, Strings]()
    units = {**table.units}
    columns = {name: column for name, column in table.columns.items() if len(column)}
    for key in (*description.channels, *description.time.column):
        if ANY in key and (names := [m[0] for m in match_numbered(key, table.columns)]):
            origin[key] = names
            units[key] = units.get(names[0], "")
            with instead(UnreadableError, f"Expected columns of one length in {key}", ValueError):
                columns[key] = np.stack([*map(table.column, names)], axis=1)
    for name in chain(*origin.values()):
        columns.pop(name, None)
    return replace(table, columns=columns, units=units, origin=origin)


def match_numbered(key: str, columns: Iterable[str]) -> list[re.Match[str]]:
    """Return a match for each column that fits `key`, sorted by the numbers in it.

    Each `*` in `key` stands for a number without a sign, and is a group of the match. `F_0.002`
    comes before `F_0.1`. Without `*` only the column `key` fits.
    """
    return sorted(
        filter(None, map(pattern_of(key, NUMBERED).fullmatch, columns)),
        key=lambda match: [*map(float, match.groups())],
    )


def _split_columns(table: Table, description: Description) -> Iterator[Table]:
    """Yield for each column that matches the first channel a table, which is a part.

    The channel's name may have a `*` for any text; without a channel RuntimeError is raised. The
    columns of times, and those whose words tell which rows are samples (`[rows]`), are in each
    table, too, and are no parts; other columns are in none. In its table the column has the
    channel's name, and `path` is its own name. Rows below the last cell of the part that is not
    empty or NaN are left out. `damage` of the file, like rows with a wrong number of cells, is
    damage of each part.
    """
    channel = next(iter(description.channels))
    shared = {*description.time.column, *description.rows}
    beside = {key: cells for key, cells in table.columns.items() if key in shared}
    for column in filter(pattern_of(channel).fullmatch, table.columns):
        if column not in shared:
            samples = without_empty_end(table.columns[column])
            yield replace(
                table,
                source=f"{table.source}, column {column}",
                path=column,
                columns={**beside, channel: samples},
                units={**table.units, channel: table.units.get(column, "")},
                origin={channel: [column] * len(samples)},
            ).take(slice(len(samples)))


def without_empty_end(cells: Cells) -> Cells:
    """Return the cells of a column, shape (n,), without those at the end that are empty or NaN.

    None and blanks are empty, and the texts "NaN" and "nan" are NaN. All other cells stay, also
    empty ones between them.
    """
    n = len(cells)
    while n and as_word(cells[n - 1]) in ("", "NaN", "nan"):
        n -= 1
    return cells[:n]
