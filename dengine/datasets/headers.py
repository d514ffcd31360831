"""The header of a text file: which line names the columns, which one states their units, and where
the data begin. `cells.split_cells` calls `find_header`.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from ..traces import is_time_column
from . import units
from .clocks import EMPTY_CELLS, TIMESTAMP, is_rising
from .dataset import UnreadableError
from .numerals import is_numeral

MIN_TIMES = 8  # in a header that names samples by their times, beside other columns
FIELD_MARK = re.compile(r"\s*[:;=\t,|]\s*")  # the first of them stands before the value
COMMENT_COLUMNS = ("comment", "comments", "kommentar", "remark")
COUNTER_NAME = re.compile(
    r"(sample|index|idx|no|nr|n|i|row|point|count|number|nummer|zeile|messpunkt|punkt)"
    r"([se]|er|[ _-]?(no|nr|id|idx|number|\d{1,3}))?\.?",
    re.IGNORECASE,
)
SETTING = re.compile(r"(?:.*\W)?\d[\d.,]* ?k?Hz|")  # SR: 400 Hz, in a line that is no header
# A cell of a row of units, beside the units that `units.parse` knows.
UNIT_CELL = re.compile(r"\[.*\]|\(.*\)|°C?|%|-|[\d.,]+ ?[mµun]?s|[\d.,]+ ?k?Hz|")
NUMBER_AND_UNIT = re.compile(
    r"(?P<number>(?:[-+−] *)?\d[\d.,]*([eE][-+]?\d+)?) *(?P<unit>[^\W\d][^\d:,;]*)"
)
# How a row of units states times of day: hh:mm:ss, HH:MM:SS.fff or mm:ss,0.
TIME_FORMAT = re.compile(r"(h{1,2}:)?m{1,2}:s{1,2}([.,:](f+|s+|m+|z+|x+|0+))?", re.IGNORECASE)


class TextCells(NamedTuple):
    """The cells of a text.

    header : list of str
        Names of the columns.
    line : int
        Line of the header, from 1.
    units : list of str
        Unit of each column, "" where the row of units states none.
    rows : dict of int to list of str
        The data rows by their line, without remarks, as a line //END or the header again.
    delimiter : str
    fields : dict of str to str
        What lines above the header and below the samples state, as `Result;OK` or `# Operator: A`.
    n_remarks : int
        Number of the lines that were left out below the header, or of all if it is not known.
    blocks : dict of int to str
        The lines of the header where it comes again, and the first, each with the time X0 that
        LabVIEW states above it, else ""; empty for one block.
    notes : tuple of str
        What users should know.
    """

    header: list[str]
    line: int
    units: list[str]
    rows: dict[int, list[str]]
    delimiter: str
    fields: dict[str, str]
    n_remarks: int = 0
    blocks: Mapping[int, str] = {}
    notes: tuple[str, ...] = ()


def ends_in_comment(names: Sequence[str]) -> bool:
    """Return whether the last name of a header is that of a column of comments."""
    return bool(names) and names[-1].lower() in COMMENT_COLUMNS


def has_unit(cell: str) -> bool:
    """Return whether a cell is a number with a known unit, as 56.5 N."""
    match = NUMBER_AND_UNIT.fullmatch(cell)
    return match is not None and units.parse(match["unit"]) is not None


def is_value(cell: str) -> bool:
    """Return whether a cell is a number, a time, or empty."""
    is_number = is_numeral(cell)
    return is_number or TIMESTAMP.fullmatch(cell) is not None or cell.lower() in EMPTY_CELLS


def without_trailing_empty(row: list[str]) -> list[str]:
    """Return a row without the empty cells ("") at its end."""
    n = len(row)
    while n and not row[n - 1]:
        n -= 1
    return row[:n]


def _is_unit(cell: str) -> bool:
    """Return whether a cell may stand in a row of units; empty ones may."""
    is_form = UNIT_CELL.fullmatch(cell) is not None or TIME_FORMAT.fullmatch(cell) is not None
    return is_form or units.parse(units.spelling(cell)) is not None


def find_header(
    rows_by_line: dict[int, list[str]],
    delimiter: str,
    columns: list[str],
    channels: Sequence[str],
) -> TextCells:
    """Find the header, the row of units and the data among the rows of a text.

    What stands above the header is left out. Of several lines that may be the header, it is that
    with the stated channels, else that above a row of units. If two lines stand above the data and
    the first can be the header, it is the header, and the second is a damaged row; a first line in
    which a name occurs twice, as of groups of columns, or that states a field, cannot be. In a
    header of evenly rising times, as that of a wide table, these are replaced by 0, 1, 2, ...
    Raises UnreadableError for numbers without a header if no `columns` are given; without rows the
    header is empty.
    """
    lines = list(rows_by_line)
    rows = list(rows_by_line.values())
    if not columns and (last := _header_at_end(rows, channels)) is not None:
        return TextCells(rows[last], lines[last], [""] * len(rows[last]), {}, delimiter, {})
    last_rows = (rows if columns else rows[1:])[-20:]
    usual = Counter(map(numeric_columns, last_rows)).most_common(1)
    numeric = usual[0][0] if usual else frozenset()
    data = _first_data(rows, last_rows, numeric)
    above = [_without_comment_mark(row, delimiter) for row in rows[: max(data, 1)]]
    above[-1:] = _without_names_among_units(above[-2:], numeric)
    is_units = [any(row) and all(map(_is_unit, row)) for row in above]
    header = max(data - 1 - (data > 1 and is_units[-1]), 0)
    titles = _titles_above_columns(above, len(rows[data])) if header > 1 else None
    chosen = _header_among(above, is_units, rows[data : data + 1], channels, titles)
    if chosen is not None:
        header = chosen
    elif header == 1 and len(rows[0]) >= len(rows[data]):
        if not (is_units[0] or _is_no_header(*rows[:2], *above[:2])):
            header = data = 0
    elif titles is not None and not (titles == header and is_units[-1]):
        header = data = titles
    if not columns and above and numeric_columns(above[header]):
        header, data = _true_header(above, is_units, header, data)
    below = range(header + 1, min(data, len(above)))
    units_row = next((above[i] for i in below if is_units[i]), [])
    line = 0
    names = columns
    if columns and data:
        units_row = _units_of_columns(above, is_units, len(columns))
    if not columns:
        header, names, units_row = _names_in(above, header, units_row, rows[data : data + 2])
        line = lines[header] if lines else 0
        names = _without_times(names, rows, line)
        data = max(data, 1)
    data_rows = dict(zip(lines[data:], rows[data:], strict=True))
    n_narrower = sum(len(row) < len(names) for row in data_rows.values())
    if ends_in_comment(names) and 2 * n_narrower > len(data_rows):
        names = names[:-1]  # LabVIEW's, which most of its rows leave out
        data_rows = {i: row[: len(names)] for i, row in data_rows.items()}
    return TextCells(names, line, pad_units(units_row, len(names)), data_rows, delimiter, {})


def _header_at_end(rows: Sequence[list[str]], channels: Sequence[str]) -> int | None:
    """Return the position of the header of a text without data; None if it has none such.

    The header is the last row, or the last but one above a row of units. It names all of
    `channels`, has no numbers, and is the only such row. At least one row stands above it. None if
    `channels` is empty.
    """

    def is_header(row: list[str]) -> bool:
        named = all(units.find_columns(name, row) for name in channels)
        return named and not numeric_columns(row)

    n_rows = len(rows) - (len(rows) > 1 and all(map(_is_unit, rows[-1])))  # without that of units
    is_last = n_rows > 1 and bool(channels) and is_header(rows[n_rows - 1])
    return n_rows - 1 if is_last and not any(map(is_header, rows[: n_rows - 1])) else None


def _header_among(
    above: list[list[str]],
    is_units: list[bool],
    first: list[list[str]],
    channels: Sequence[str],
    titles: int | None,
) -> int | None:
    """Return the position of the header if lines that are neither units nor data stand below it.

    It is the last line with the stated channels, below which no numbers stand. Without any, and
    without `titles`, it is the line above the last row of units, as catman writes it above
    "Kanal 1" and "SR: 400 Hz", or above such a line of rates. Else the result is None.

    first : the first row of data, if there is any.
    """
    widths = {len(without_trailing_empty(row)) for row in (*above[-1:], *first)}
    numbers = [i for i, row in enumerate(above) if numeric_columns(row)]
    below_numbers = range(max(numbers, default=-1) + 1, len(above))
    names = []
    for i in below_numbers:
        words = without_trailing_empty(above[i])
        if len(words) in widths and all(words) and not is_units[i]:
            names.append(i)
    if channels:
        for i in reversed(names):
            if all(units.find_columns(name, above[i]) for name in channels):
                return i
    if titles is not None or not above or (is_units[-1] and not _is_setting(above[-1])):
        return None
    for i in reversed(below_numbers):
        stated = pad_units(above[i], len(above[i]))
        if is_units[i] and i - 1 in names and any(map(units.parse, stated)):
            return i - 1
    plain = [i for i in names if not _is_setting(above[i])]
    return max(plain, default=None) if _is_setting(above[-1]) else None


def _is_setting(row: Sequence[str]) -> bool:
    """Return whether all cells of a row state a rate, as "SR: 400 Hz" or 400 Hz, or are empty."""
    return any(row) and all(map(SETTING.fullmatch, row))


def _units_of_columns(above: list[list[str]], is_units: list[bool], n: int) -> list[str]:
    """Return the units that the lines above the data state for n columns that the user names.

    They are in a row of units, or in the names of a header that is not used.
    """
    for row, is_row_of_units in zip(reversed(above), reversed(is_units), strict=True):
        stated = row if is_row_of_units else [units.split(name)[1] for name in row]
        if len(without_trailing_empty(row)) == n and any(map(units.parse, pad_units(stated, n))):
            return stated
    return []


def _first_data(rows: list[list[str]], last_rows: list[list[str]], numeric: Collection[int]) -> int:
    """Return the index of the first row of data; 0 also if there is none.

    A row is data if it has numbers in most of the columns that are numeric in the last rows, a
    digit in a time column if these have one (`CH,,0001,0002` has none), and is no wider than these.
    """
    width = max(map(len, last_rows), default=0)
    clocks = _columns_of_times(last_rows) - set(numeric)
    for k, row in enumerate(rows):
        is_timed = any(any(map(str.isdigit, row[i])) for i in clocks if i < len(row))
        is_numeric = 2 * len(numeric_columns(row) & set(numeric)) > len(numeric)
        if is_numeric and len(row) <= width and (is_timed or not clocks):
            return k
    return 0


def _columns_of_times(rows: Sequence[Sequence[str]]) -> set[int]:
    """Return the positions of the columns that have two digits or more in every row."""
    n = min(map(len, rows), default=0)
    return {i for i in range(n) if all(sum(map(str.isdigit, row[i])) > 1 for row in rows)}


def _is_no_header(
    first_row: list[str], second_row: list[str], first: list[str], second: list[str]
) -> bool:
    """Return whether the second of two lines above the data is the header, and the first is none.

    The first is a remark, names groups of columns, or states a field.

    first, second : the lines without a comment mark.
    """
    is_comment = units.COMMENT_MARK.match(first_row[0]) is not None
    groups = list(filter(None, first_row))
    has_groups = len(set(groups)) < len(groups)
    has_groups |= len(groups) < len(second) > len({*second}) and all(second)
    is_remark = is_comment and not numeric_columns(second_row)
    return has_groups or is_remark or _is_field_above(first, second)


def _is_field_above(first: list[str], second: list[str]) -> bool:
    """Return whether the first of two lines is a title or a field, as `Result;OK`, above a header.

    Then the second is of names alone, and has more clocks and units than the first, or this has a
    value, or is but one cell.
    """
    words = without_trailing_empty(first)
    names = without_trailing_empty(second)
    is_field = len(words) == 1 or any(map(is_value, words[1:]))
    is_field |= _n_measured(names) > _n_measured(words)
    has_mark = len(words) == 1 and len(FIELD_MARK.split(words[0])) > 1
    return is_field and (len(names) > 1 or has_mark) and not any(map(is_value, names))


def _without_names_among_units(last: list[list[str]], numeric: Collection[int]) -> list[list[str]]:
    """Return the last row above the data, with units alone if it states those of the row above it.

    Graphtec's second row has units for most columns of numbers, and beside them names again, as
    `NO.,Time,ms,N,A1234` below `Number,Date&Time,ms,CH1,Alarm`. Any other row stays as it is.

    last : the last two rows above the data, or fewer.
    numeric : positions of the columns of numbers.
    """
    if len(last) < 2 or len(last[0]) != len(last[1]):
        return last[-1:]
    names, words = last
    measured = [i for i in numeric if i < len(words) and not COUNTER_NAME.fullmatch(names[i])]
    n_units = sum(words[i] != "" and _is_unit(words[i]) for i in measured)
    are_names = all(names) and len({*names}) == len(names) and not any(map(is_value, names))
    is_more = n_units > sum(_is_unit(names[i]) for i in measured)
    if are_names and is_more and 2 * n_units > len(measured):
        return [[word if _is_unit(word) else "" for word in words]]
    return [words]


def _n_measured(names: Sequence[str]) -> int:
    """Return how many names of a row are those of clocks, or state a unit."""
    return sum(is_time_column(name) or units.split(name)[1] != "" for name in names)


def _names_in(
    above: list[list[str]], header: int, units_row: list[str], first: Sequence[Sequence[str]]
) -> tuple[int, list[str], list[str]]:
    """Return the position of the header above the data, the names in it, and the units.

    TwinCAT Scope writes two columns for each channel: the first, its clock, is named "Time" here.
    Its unit is ms if its first step is the stated SampleTime[ms].
    In other files with a row of groups above the header, a name that occurs twice gets the name of
    its group before it, except that of a clock.
    """
    names = above[header] if above else []
    if pairs := [row for row in above if _are_pairs(row)]:
        by_key = {row[0].lower(): row for row in reversed(pairs)}
        names = [name if i % 2 else "Time" for i, name in enumerate(pairs[0])]
        units_row = [unit if i % 2 else "" for i, unit in enumerate(by_key.get("unit", []))]
        units_row += [""] * (len(names) - len(units_row))
        steps = by_key.get("sampletime[ms]", [])
        for i in range(1, min(map(len, (names, steps, *first))), 2):
            with suppress(ValueError):
                times = [float(row[i - 1].replace(",", ".")) for row in first]
                is_confirmed = bool(np.isclose(times[-1] - times[0], float(steps[i])))
                units_row[i - 1] = "ms" if is_confirmed else ""
        return above.index(pairs[0]), names, units_row
    groups = above[header - 1] if header else []
    if len(groups) == len(names) > len({*names}):
        filled = [""]
        for group in groups:
            filled.append(group or filled[-1])
        names = [
            f"{group} {name}".strip()
            if names.count(name) > 1 and not is_time_column(name)
            else name
            for group, name in zip(filled[1:], names, strict=True)
        ]
    return header, names, units_row


def _without_times(names: list[str], rows: list[list[str]], line: int) -> list[str]:
    """Return the names of a header, of which evenly rising times are replaced by 0, 1, 2, ...

    Whole numbers may be names, and stay. Raises UnreadableError, with the header's line, if most of
    the names are other numbers, or times and numbers are in the same columns as in the row below:
    then there is no header.

    rows : all rows of the text, for advice.
    """
    numbered = numeric_columns(names)
    if all(names[i].isdecimal() for i in numbered):
        return names
    is_even = MIN_TIMES <= len(numbered) < len(names)
    if is_even and _are_even(names[i] for i in sorted(numbered)):
        numbers = itertools.count()
        return [str(next(numbers)) if i in numbered else name for i, name in enumerate(names)]
    below = next((row for row in rows if row != names), [])
    # A time and a number, as in the row below it: the header is samples.
    is_like_below = numbered == numeric_columns(below)
    is_like_below = is_like_below and bool(_columns_of_times([names, below]) - numbered)
    if is_like_below or 2 * len(numbered) > sum(map(bool, names)):
        message = f"Expected a header, its first line is of numbers; {_columns_advice(rows)}"
        raise UnreadableError(message, line)
    return names


def _are_pairs(row: Sequence[str]) -> bool:
    """Return whether a row has one word before a name of each channel, as `Name fx Name fz`.

    So TwinCAT Scope writes it: in the rows of samples a time stands before each value.
    """
    return len(row) > 2 and len(row) % 2 == 0 and row[0] != "" and len({*row[::2]}) == 1


def _titles_above_columns(above: Sequence[Sequence[str]], n: int) -> int | None:
    """Return how many rows of titles stand above those that tell something of each of n columns.

    Such rows, two or more, stand above the data in a table with a column for each part. The first
    must tell the columns apart. None for any other table.
    """
    is_full = [all(row[1:]) and len(row) == n for row in above]
    titles = max((i for i, is_row_full in enumerate(is_full, 1) if not is_row_full), default=0)
    if n <= MIN_TIMES or titles > len(above) - 2 or len({*above[titles]}) < n:
        return None
    return titles


def _true_header(
    above: list[list[str]], is_units: list[bool], header: int, data: int
) -> tuple[int, int]:
    """Return the positions of the header and of the first row of data.

    A row in which some cells are numbers, and one above it of as many names, is damaged data.

    above, is_units : the rows above the data, and whether they are of units.
    header, data : the positions found so far, which are returned where no such row is.
    """
    row = above[header]
    if len(numeric_columns(row)) == len(row):
        return header, data
    for i, names in enumerate(above[:header]):
        if len(names) == len(row) and all(names) and not numeric_columns(names):
            return i, i + 1 + is_units[i + 1]
    return header, data


def _are_even(cells: Iterable[str]) -> bool:
    """Return whether numbers as texts rise by steps that are equal to 1 %."""
    try:
        numbers = [float(cell.replace(",", ".")) for cell in cells]
    except ValueError:  # as 1.234,5, which is no time
        return False
    steps = np.diff(numbers)
    return bool(steps[0] > 0) and bool(np.ptp(steps) < 0.01 * steps[0])


def numeric_columns(row: Sequence[str]) -> frozenset[int]:
    """Return the positions at which a row has numbers, or nan."""
    return frozenset(i for i, cell in enumerate(row) if is_numeral(cell) or cell.lower() == "nan")


def _without_comment_mark(row: list[str], delimiter: str) -> list[str]:
    """Return a header without the # or % by which another program takes it for a comment."""
    first = units.COMMENT_MARK.sub("", row[0])
    if not first and delimiter == " ":
        return row[1:]  # in `# time fx` the mark is a word of its own
    return [first, *row[1:]]


def pad_units(units_row: list[str], n: int) -> list[str]:
    """Return a row of units without brackets, as n units, "" for each that is missing."""
    plain = [units.spelling(cell.strip("[](){} ")) for cell in units_row[:n]]
    return plain + [""] * (n - len(plain))


def _columns_advice(rows: list[list[str]]) -> str:
    """Return advice, for an error, on how to name the columns of a file without a header."""
    n = len(rows[0])
    complete = [row for row in rows[:200] if len(row) == n]
    first = [row[0].replace(",", ".") for row in complete]
    names = [f"c{i}" for i in range(n)]
    if n > MIN_TIMES:  # as a wide table
        is_labelled = {row[-1] for row in complete} == {"0", "1"}
        names = [f"c0..c{n - 2}", "label"] if is_labelled else [f"c0..c{n - 1}"]
    with suppress(ValueError):
        if is_rising(np.array(first, dtype=np.float64)):
            names[0] = names[0].replace("c0..", "time,c1..") if n > MIN_TIMES else "time"
    return f"write one above, or name its {n} columns, columns={','.join(names)!r}"
