"""Text files of numbers in the dialects that people's tools write: .csv, .tsv, .txt, .dat, .lvm.

`read_table` reads a file as a table of texts in which numbers are written as Python writes them;
`parse_numbers` converts them.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import excerpt, listed
from ..traces import is_time_column
from . import units
from .cells import SAMPLED_CELLS, split_cells
from .clocks import (
    DATE_FORM,
    MONTHS,
    floats,
    join_date_and_time,
    rate_in_preamble,
)
from .containers import as_texts, read_content, read_frame
from .curves import write_curves
from .dataset import Fault, LoadOptions, UnreadableError
from .encodings import decode
from .headers import NUMBER_AND_UNIT, TextCells, is_value, without_trailing_empty
from .numerals import is_numeral, write_as_python
from .scales import lines_of_factors

if TYPE_CHECKING:
    import pandas as pd

SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".lvm")
NUMBER_PREFIX = re.compile(r"\s*[+-]?\d*\.?\d*(?:(?<=\d)[eE][+-]?\d+)?")  # of a damaged number
RATE_ABOVE = "none, a line above the header states the rate"
# What stands where there is no number, as Bad Input, #N/A or C's 1.#QNAN: it has no digit, or a
# word before its first one, but for a code in brackets. A damaged number, as 12x5, is none.
STATUS = re.compile(r"\s*(?:\D+|\D*[^\W\d]{2}.*|\[-?\d+\] *[^\W\d]{2}.*|-?1\.#[A-Z]+)")
# What a spreadsheet makes of numbers, in its language: 01. Mrz of 1.3, Mrz 75 of 3.75.
MONTH_WORD = (
    rf"(?:{'|'.join(' '.join(MONTHS).split())}|mrt|maa|maj|sty|lut|kwi|cze|lip|sie|wrz|paz|paź"
    r"|lis|gru)[^\W\d_]{0,2}\.?"
)
SPREADSHEET_DATE = re.compile(
    rf"\s*(?:\d\d?[-./ ]+{MONTH_WORD}(?:[-./ ]+\d{{2,4}})?|{MONTH_WORD}[-./ ]+\d{{2,4}}"
    rf"|\d\d?月(?:\d\d?日)?|(?:{DATE_FORM})(?:[T ]\d\d?:\d\d(?::\d\d)?)?)\s*",
    re.IGNORECASE,
)
# Two numbers with decimals or more, as where they fill columns of fixed width.
TOUCHING = re.compile(r"([+-]?\d+[.,]\d+([eE][+-]\d+)?){2,}")
MOST = 0.8  # of a column's cells are numbers: the others are lost samples


class TextTable(NamedTuple):
    """A text file as a table.

    frame : DataFrame
        Its index is the line of each row.
    faults : list of Fault
        What is wrong with lines that were left out.
    line : int
        Line of the header, from 1.
    units : list of str
        Unit of each column, "" where unknown.
    decimal : str
        The decimal mark that its cells prove, "" where they prove none.
    numbers : str
        As in `Reading`.
    fields : mapping of str to str
        As in `TextCells`.
    n_remarks : int
    blocks : mapping of int to str
        Both as in `TextCells`.
    rate_hz : float, optional
        That a line above the header states, or of a wide table whose samples have times.
    offer : str
        A note on a line above the header that may state the rate; "" for none.
    clock : str
        What tells the rate, as in `Reading`.
    notes : tuple of str
        What users should know, as of units that were converted.
    cut_line : int
        Line of the last row if it is cut off, which is among the faults; 0 for none.
    factors : mapping of str to float
        Of the lines above the samples, as in `Recording`.
    preamble : str
        The lines above the samples, with the header.
    column_of : mapping of int to str
        The column of the file that each row was, if rows and columns were exchanged.
    wrong : mapping of int to UnreadableError
        What is wrong in such a row, with the line of the file.
    date : str
        The column of dates to which times of day were joined; "" for none.
    """

    frame: pd.DataFrame
    faults: list[Fault]
    line: int
    units: list[str]
    decimal: str
    numbers: str = ""
    fields: Mapping[str, str] = {}
    n_remarks: int = 0
    blocks: Mapping[int, str] = {}
    rate_hz: float | None = None
    offer: str = ""
    clock: str = RATE_ABOVE
    notes: tuple[str, ...] = ()
    cut_line: int = 0
    factors: Mapping[str, float] = {}
    preamble: str = ""
    column_of: Mapping[int, str] = {}
    wrong: Mapping[int, UnreadableError] = {}
    date: str = ""


def read_table(
    path: Path,
    options: LoadOptions,
    decimal: str | None = None,
    *,
    as_text: bool = False,
) -> TextTable:
    """Read a text file as a table of texts, in which numbers are written as Python writes them.

    A Parquet or JSON file is read as the table that it holds.

    Parameters
    ----------
    path : Path
    options : LoadOptions
        How its text, numbers and columns are written, where the user stated it.
    decimal : str, optional
        Decimal mark, as of the other files of a folder, that is taken if the user stated none.
        None: as the cells prove.
    as_text : bool, default False
        Whether numbers stay texts as they are written; those of Parquet and JSON become texts.

    Returns
    -------
    TextTable
        Rows of too few or too many cells, or with numbers in another format, are left out, and are
        among its faults.

    Raises
    ------
    UnreadableError
        If the file is empty, cut off or too large, is no text or cannot be decoded, has no header,
        or its number format is undecided, or if it is no table in Parquet or JSON.
    """
    import pandas as pd

    if (stored := read_frame(path)) is not None:
        frame, odd_lines = stored
        faults = [Fault(path.name, i, message) for i, message in odd_lines.items()]
        table = TextTable(
            with_part(as_texts(frame) if as_text else frame, options), faults, 0, [], ""
        )
        last = max(odd_lines, default=0)
        return table._replace(cut_line=last) if last > max(frame.index) else table
    text, encoding = decode(read_content(path), options.encoding)
    cells = split_cells(text, options.columns, options.channels)
    if not cells.header:
        raise UnreadableError("Expected a header and rows, it is empty")
    header = without_trailing_empty(cells.header)  # a delimiter at its end
    if not header:
        raise UnreadableError("Expected a header, the first line names no column", cells.line)
    n = len(header)
    rows = _pad_rows(cells.rows, n)
    complete = {i: row[:n] for i, row in rows.items() if len(row) >= n and not any(row[n:])}
    wrong = {
        i: f"Expected {n} columns, got {len(row)}: {listed(row)}{_touching_text(row)}"
        for i, row in cells.rows.items()
        if i not in complete
    }
    cut_line = _find_cut_row(text, cells, complete, wrong)
    frame = with_part(
        pd.DataFrame(list(complete.values()), list(complete), header, dtype=object), options
    )
    mark = numbers = date = ""
    notes = cells.notes
    if not as_text:
        write_curves(frame)
        cell_units = _take_units_off(frame, options)
        mark, group, odd_cells = write_as_python(
            frame, cells.delimiter, options.decimal or decimal, options.thousands
        )
        wrong |= odd_cells
        units_text, unit_notes = _convert_cells(frame, cell_units, cells.units)
        parts = (
            f"decimal mark {mark!r}" if mark else "whole numbers",
            f"thousands mark {group!r}" if group else "",
            f"{cells.delimiter!r} between cells" if cells.delimiter else "",
            "" if encoding == "utf-8-sig" else encoding,
            units_text,
        )
        numbers = ", ".join(filter(None, parts))
        notes += unit_notes
        date = join_date_and_time(frame)
    faults = [Fault(path.name, i, message) for i, message in sorted(wrong.items())]
    frame = frame.drop(index=[i for i in wrong if i in complete])
    column_units = cells.units[:n]
    begin = min(cells.rows, default=1)
    preamble = _lines_above(text, begin)
    _add_stated_units(column_units, header, _lines_above(text, cells.line or begin))
    about = (cells.fields, cells.n_remarks, cells.blocks, *rate_in_preamble(preamble), RATE_ABOVE)
    first = (frame, faults, cells.line, column_units, mark, numbers)
    return TextTable(
        *first, *about, notes, cut_line, lines_of_factors(preamble), preamble, date=date
    )


def with_part(frame: pd.DataFrame, options: LoadOptions) -> pd.DataFrame:
    """Return a table with a last column `options.part` that joins the columns it lists.

    The columns "day,number" give parts as `2024-03-12_7`. The time of day of a date is dropped.
    Slashes become dashes, as a listing takes them for folders. If a cell is empty the part is "",
    and if it is missing, so is the part. The table is returned unchanged if it has such a column,
    if a column to be joined is missing, or if two columns have one name.
    """
    if options.part in frame or not options.has_part(frame) or not frame.columns.is_unique:
        return frame
    pieces = frame[list(options.part_columns[1:])]
    texts = as_texts(pieces).apply(days_in).replace("/", "-", regex=True)
    joined = texts.iloc[:, 0]
    for name in texts.columns[1:]:
        joined = joined + "_" + texts[name]
    joined = joined.mask((texts == "").any(axis=1), "").mask(pieces.isna().any(axis=1))
    return frame.assign(**{options.part: joined})


def days_in(cells: pd.Series) -> pd.Series:
    """Return the days of a column of dates with times of day; others stay as they are."""
    return cells.astype(str).replace(rf"^({DATE_FORM})[T ]+\d.*$", r"\1", regex=True)


def _lines_above(text: str, line: int) -> str:
    """Return the lines of a text above a line, from 1; "" for line 0."""
    return "\n".join(text.splitlines()[: max(line - 1, 0)])


def _add_stated_units(column_units: list[str], header: Sequence[str], preamble: str) -> None:
    """Set the units that the text above a header states, in place, for columns without one."""
    without = [
        i
        for i, name in enumerate(header)
        if not (column_units[i] or units.split(name)[1] or is_time_column(name))
    ]
    stated = units.stated_in_preamble(preamble, header, without)
    for i, unit in zip(without, stated, strict=True):
        column_units[i] = unit


def _pad_rows(rows: dict[int, list[str]], n: int) -> dict[int, list[str]]:
    """Return rows of cells, with empty cells up to the n of the header where these are left out.

    They are left out if all rows of the usual number of cells end in an empty one.
    """
    width, _ = Counter(map(len, rows.values())).most_common(1)[0] if rows else (n, 0)
    if width >= n or any(row[-1] for row in rows.values() if len(row) == width):
        return rows
    padding = [""] * (n - width)
    return {i: row + padding if len(row) == width else row for i, row in rows.items()}


def _take_units_off(frame: pd.DataFrame, options: LoadOptions) -> dict[int, list[str]]:
    """Remove the units in a table's cells, as of `56.5 N`, in place.

    A column is changed if 80 % of its filled cells are a number with a known unit. A unit that no
    blank parts from the number counts only in a column with decimals: 0001A is a part's number.
    Returns, by the position of the column, the unit of each cell in its usual spelling, "" for one
    without. Raises UnreadableError, with the line, if the units of a column are of several
    dimensions, or a fifth of the numbers has a unit and others have none. The columns of parts and
    labels, and those that are not among the stated channels, are then left as they are.
    """
    cell_units = dict[int, list[str]]()
    for i, name in enumerate(frame.columns):
        cells = frame.iloc[:, i].tolist()
        sample = cells[:: max(1, len(cells) // SAMPLED_CELLS)]
        if not any(map(NUMBER_AND_UNIT.fullmatch, sample)):
            continue
        matches = [NUMBER_AND_UNIT.fullmatch(cell) for cell in cells]
        column = [units.spelling(match["unit"].strip()) if match else "" for match in matches]
        column = [unit if units.parse(unit) else "" for unit in column]
        has_decimals = any(
            unit and set(".,") & {*cell} for unit, cell in zip(column, cells, strict=True)
        )
        if not has_decimals:
            column = [unit if " " in cell else "" for unit, cell in zip(column, cells, strict=True)]
        n_filled = sum(map(bool, cells))
        is_bare = [not unit and is_numeral(cell) for unit, cell in zip(column, cells, strict=True)]
        n_units = sum(map(bool, column))
        if n_units < (1 - MOST) * n_filled or n_units + sum(is_bare) < MOST * n_filled:
            continue
        lines = dict(zip(reversed(column), reversed(frame.index), strict=True))  # the first of each
        lines.pop("", None)
        stated = sorted(lines, key=lines.__getitem__)
        dimensions = {parsed[0] for parsed in map(units.parse, stated) if parsed}
        if len(dimensions) > 1 or any(is_bare):
            is_channel = not options.channels or units.find_columns(name, options.channels)
            if name in (options.part, options.label) or not is_channel:
                continue
            other = next((u for u in stated if units.factor(u, stated[0]) is None), "no unit")
            line = lines.get(other) or frame.index[is_bare.index(True)]
            first = f"{stated[0]} in line {lines[stated[0]]}"
            wanted = f"units of one quantity in the cells of {name}, got {other}, and {first}"
            do = "export the column in one unit, or name another channel (channel)"
            raise UnreadableError(f"Expected {wanted}; {do}", int(line))
        cell_units[i] = column
        numbers = [
            match["number"] if unit and match else cell
            for match, unit, cell in zip(matches, column, cells, strict=True)
        ]
        frame.isetitem(i, numbers)
    return cell_units


def _convert_cells(
    frame: pd.DataFrame, cell_units: Mapping[int, Sequence[str]], column_units: list[str]
) -> tuple[str, tuple[str, ...]]:
    """Convert cells to one unit for each column, in place, and set that in `column_units`.

    If the column has several units, the numbers are converted to the unit without a prefix: N for N
    and kN. Returns a text for the reading that names the units, "" if no cell has one, and a note
    on each column that was converted.

    cell_units : from `_take_units_off`.
    """
    texts = []
    notes = []
    for i, cells in cell_units.items():
        name = frame.columns[i]
        stated = list(dict.fromkeys(filter(None, cells)))
        column_units[i] = stated[0]
        if len(stated) > 1:
            dimension, _ = units.parse(stated[0]) or ("", 1.0)  # each parses: it was taken off
            column_units[i] = dimension
            factors = {unit: units.factor(unit, dimension) or 1.0 for unit in stated}
            numbers, _ = floats(frame.iloc[:, i])
            scaled = [
                str(number * factors[unit]) if unit else cell
                for number, unit, cell in zip(numbers, cells, frame.iloc[:, i], strict=True)
            ]
            frame.isetitem(i, scaled)
            notes.append(
                f"Column {name} has {listed(stated)} in its cells: all are {dimension} now"
            )
        texts.append(f"units {listed(stated)} in the cells of {name}")
    return ", ".join(texts), tuple(notes)


def _touching_text(row: Sequence[str]) -> str:
    """Return a text for an error on the first cell of a row in which numbers touch, or ""."""
    for cell in row:
        if TOUCHING.fullmatch(cell) and not is_value(cell):
            return f"; numbers touch in {cell}: export with a mark between the columns"
    return ""


def _find_cut_row(
    text: str, cells: TextCells, complete: Mapping[int, Sequence[str]], wrong: dict[int, str]
) -> int:
    """Return the line of the last row if it is cut off, by its cells or its last cell; else 0.

    complete : rows with all cells. wrong : what is wrong in others, to which the last may be added.
    """
    last = max(cells.rows, default=0)
    if text[-1:] != "\n" and last in complete and _is_last_cell_cut(list(complete.values())):
        wrong[last] = "Expected a last cell as those above, it is cut off"
    is_cut = last in wrong and len(cells.rows[last]) <= len(cells.header) and len(complete) > 1
    return last if is_cut else 0


def _is_last_cell_cut(rows: Sequence[Sequence[str]]) -> bool:
    """Return whether the last cell of rows is but the beginning of the word above it, or has fewer
    decimals than all above, as many each.

    False for fewer than three rows.
    """
    cells = [row[-1] for row in rows]
    if len(cells) > 2 and not any(map(str.isdigit, cells[-2])) and cells[-1] not in cells[:-1]:
        return cells[-2].startswith(cells[-1])
    decimals = [len(cell.replace(",", ".").partition(".")[2]) for cell in cells]
    return len(decimals) > 2 and len(set(decimals[:-1])) == 1 and decimals[-1] < decimals[0]


def is_mostly_numbers(cells: pd.Series) -> bool:
    """Return whether at least 80 % of a column's filled cells are numbers, or all are empty."""
    numbers, wrong = floats(cells)
    n_numbers = int((~np.isnan(numbers)).sum())
    return not wrong or n_numbers >= MOST * (n_numbers + len(wrong))


def parse_numbers(
    frame: pd.DataFrame,
) -> tuple[NDArray[np.float32], dict[int, str], dict[int, str]]:
    """Convert a table to numbers.

    Returns
    -------
    values : array of float32, shape (n, columns)
        Empty cells and those that are no numbers are NaN.
    wrong : dict of int to str
        A message for the index of each row that has a cell that is no number. It counts the dates
        that a spreadsheet made of numbers.
    lost : dict of int to str
        The cell of those rows in which all such cells are a `STATUS`.
    """
    values = np.empty(frame.shape)
    wrong = dict[int, str]()
    lost = dict[int, str]()
    damaged = set[int]()
    dates = Counter[int]()
    for i, name in enumerate(frame.columns):
        cells = frame.iloc[:, i]
        values[:, i], odd = floats(cells)
        for index in odd:
            cell = str(cells[index])
            prefix = NUMBER_PREFIX.match(cell)  # always matches: it may be empty
            actual = excerpt(cell, prefix.end() if prefix else 0)
            message = f"Expected a number in column {name}, got {actual}"
            is_date = SPREADSHEET_DATE.fullmatch(cell) is not None
            if NUMBER_AND_UNIT.fullmatch(cell) and not is_date:
                message = f"{message}; export plain numbers, without units"
            message += "" if is_date else _touching_text([cell])
            wrong.setdefault(index, message)
            if is_date:
                dates[index] += 1
                damaged.add(index)
            elif STATUS.fullmatch(cell):
                lost.setdefault(index, cell.strip())
            else:
                damaged.add(index)
    turned = "a spreadsheet turned numbers such as 1.3 into dates"
    for index in dates:
        count = f"{dates.total()} of {values.size} cells are dates"
        more = f", {turned}; export again, without opening it in one"
        more = more if dates.total() < values.size else ""
        wrong[index] = f"{wrong[index]}: {count}{more}"
    with np.errstate(over="ignore"):  # what overflows becomes an infinity, which the engine finds
        numbers = values.astype(np.float32)
    return numbers, wrong, {i: cell for i, cell in lost.items() if i not in damaged}
