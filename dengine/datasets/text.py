"""Text files of numbers in the dialects that people's tools write: .csv, .tsv, .txt and .dat."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import excerpt, listed
from . import units
from .clocks import NOTHING, STAMP, clock_of, evenly, floats, is_rising, rate_of, rising
from .dataset import Asked, Fault, UnreadableError
from .numerals import as_python, is_numeral

if TYPE_CHECKING:
    import pandas as pd

SUFFIXES = (".csv", ".tsv", ".txt", ".dat")
LARGEST = 128 * 2**20  # bytes of one text file
BEGINS = re.compile(r"\s*[+-]?\d*\.?\d*(?:(?<=\d)[eE][+-]?\d+)?")  # what of a cell is a number
DELIMITERS = ("\t", ";", "|", ",", " ", "")  # in the order in which equals are taken; " ": any blanks; "": one column
SAMPLED = 30  # lines, from the end, that tell the delimiter, and
CELLS = 40  # cells of each
WORD = re.compile(r'"((?:[^"]|"")*)"|([^ \t"]+(?: +[\[(][^\])]*[\])])?)')  # between blanks; a unit goes with its name
COMMENTS = ("comment", "comments", "kommentar", "remark")
HINT = re.compile(r'"?sep=(.)"?', re.IGNORECASE)  # Excel's first line
UNIT = re.compile(r"\[.*\]|\(.*\)|°C?|%|-|[\d.,]+ ?[mµun]?s|")  # a cell of a row of units, beside what `units` knows


class Timed(NamedTuple):
    """One recording's values. trace : (C, T).  rate_hz : by its timestamps.  units : a channel each, "" where unknown."""

    trace: NDArray[np.float32]
    rate_hz: float | None = None
    units: tuple[str, ...] = ()


class Cells(NamedTuple):
    """A text's cells. line : of the header.  units : a column each, "" where none.  rows : by the numbers of lines."""

    header: list[str]
    line: int
    units: list[str]
    rows: dict[int, list[str]]
    delimiter: str


class Sheet(NamedTuple):
    """A table of texts, whose index are the numbers of its lines, and what was wrong with other lines."""

    frame: pd.DataFrame
    faults: list[Fault]
    line: int
    units: list[str]
    decimal: str  # the mark, where its cells tell it; else ""


def cells_of(text: str, columns: Sequence[str] = ()) -> Cells:
    """The cells of the lines that are not blank; UnreadableError for a line of megabytes, or where no header is.

    columns : their names, where the file has no header, or another one.
    """
    lines = {i: line for i, line in enumerate(text.splitlines(), start=1) if line.strip()}
    hint = HINT.fullmatch(next(iter(lines.values()), "").strip())
    if hint:
        del lines[min(lines)]
    try:
        delimiter = hint[1] if hint else _delimiter(list(lines.values()))
        rows = {i: _split(line, delimiter) for i, line in lines.items()}
    except csv.Error as error:
        raise UnreadableError(f"Expected separated values, got others: {error}") from error
    return _from_header(rows, delimiter, list(columns))


def _split(line: str, delimiter: str) -> list[str]:
    if delimiter in ("", " "):
        words = [quoted.replace('""', '"') or plain for quoted, plain in WORD.findall(line)]
        return words if delimiter else [line.strip().strip("\"'")]
    return [word.strip().strip("'") for word in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))]


def _delimiter(lines: Sequence[str]) -> str:
    """What parts the most cells into numbers and times, as many in each line and in the header."""
    few = [units.LEADING.sub("", line) for line in lines[-SAMPLED:]]
    top = [units.LEADING.sub("", line) for line in lines[:-1][:100]]

    def score(delimiter: str) -> float:
        rows = [_split(line, delimiter) for line in few]
        width, times = Counter(map(len, rows)).most_common(1)[0]
        if width == 1 and delimiter:
            return 0.0
        named = width if rows[0][-1:] != [""] else width - 1  # a delimiter at the end of the data alone
        cells = [cell for row in rows if len(row) == width for cell in row[:CELLS]]
        values = sum(map(_is_value, cells))
        heads = (
            row for row in (_without_trailing_empty(_split(line, delimiter)) for line in top) if len(row) in (named, width)
        )
        headed = any(2 * sum(map(_is_value, row[:CELLS])) <= min(len(row), CELLS) for row in heads)
        return values / len(cells) * times / len(rows) * (1.0 if headed else 0.5)

    scores = {delimiter: score(delimiter) for delimiter in DELIMITERS} if lines else {"": 0.0}
    best = max(scores.values())
    if best > 0:
        return next(delimiter for delimiter in DELIMITERS if scores[delimiter] > 0.98 * best)
    counts = {each: Counter(len(_split(line, each)) for line in few).most_common(1) for each in "\t;|," if few}
    return next((each for each, found in counts.items() if found[0][0] > 1), ",")


def _is_value(cell: str) -> bool:
    return is_numeral(cell) or STAMP.fullmatch(cell) is not None or cell.lower() in NOTHING


def _without_trailing_empty(row: list[str]) -> list[str]:
    """A row without the empty cells at its end."""
    n = len(row)
    while n and not row[n - 1]:
        n -= 1
    return row[:n]


def _is_unit(cell: str) -> bool:
    return UNIT.fullmatch(cell) is not None or units.parse(cell) is not None


def _from_header(lines: dict[int, list[str]], delimiter: str, columns: list[str]) -> Cells:
    """The cells from the header on, without what a recorder writes above it; and the row of units below it.

    A row is data if it has numbers in most of the columns that are numeric in the last 20 rows. If two lines stand above
    the data and the first can be the header, it is the header, and the second is a damaged row. UnreadableError where
    there is no header.
    """
    places = list(lines)
    rows = list(lines.values())
    usual = Counter(map(_numeric_columns, (rows if columns else rows[1:])[-20:])).most_common(1)
    numeric = usual[0][0] if usual else frozenset()
    data = next((k for k, row in enumerate(rows) if 2 * len(_numeric_columns(row) & numeric) > len(numeric)), 0)
    above = [_without_mark(row, delimiter) for row in rows[: max(data, 1)]]
    in_units = [any(row) and all(map(_is_unit, row)) for row in above]
    header = max(data - 1 - (data > 1 and in_units[-1]), 0)
    if header == 1 and len(rows[0]) >= len(rows[data]) and not in_units[0]:
        header = data = 0
    units_row = above[header + 1] if header + 1 < data else []
    if columns:
        data_rows = dict(zip(places[data:], rows[data:], strict=True))
        return Cells(columns, 0, _stripped(units_row, len(columns)), data_rows, delimiter)
    names = above[header] if above else []
    numbered = _numeric_columns(names)
    # Whole numbers may be names.
    if 2 * len(numbered) > len(names) and not all(names[i].isdecimal() for i in numbered):
        advice = _columns_advice(rows)
        raise UnreadableError(f"Expected a header, its first line is of numbers; {advice}", places[header])
    first = max(data, 1)
    data_rows = dict(zip(places[first:], rows[first:], strict=True))
    if names[-1:] and names[-1].lower() in COMMENTS and all(len(row) < len(names) for row in data_rows.values()):
        names = names[:-1]  # LabVIEW's, of which its rows say nothing
    return Cells(names, places[header] if places else 0, _stripped(units_row, len(names)), data_rows, delimiter)


def _numeric_columns(row: list[str]) -> frozenset[int]:
    """Where a row has numbers, or nan."""
    return frozenset(i for i, word in enumerate(row) if is_numeral(word) or word.lower() == "nan")


def _without_mark(row: list[str], delimiter: str) -> list[str]:
    """A header without the # or % by which another program takes it for a comment."""
    first = units.LEADING.sub("", row[0])
    return row[1:] if not first and delimiter == " " else [first, *row[1:]]  # `# time fx` has a word too many


def _stripped(units_row: list[str], n: int) -> list[str]:
    """A row of units as n units, one for each column, without brackets."""
    return [cell.strip("[](){} ") for cell in units_row][:n] + [""] * (n - len(units_row))


def _columns_advice(rows: list[list[str]]) -> str:
    """How to name the columns of a file without a header."""
    some = [row for row in rows[:200] if len(row) == len(rows[0])]
    try:
        first = [float(row[0].replace(",", ".")) for row in some]
    except ValueError:
        first = []
    names = ["time" if not i and is_rising(np.array(first)) else f"c{i}" for i in range(len(rows[0]))]
    return f"write one above, or name its {len(names)} columns, columns={','.join(names)[:200]!r}"


def decoded(raw: bytes) -> tuple[str, str]:
    """A file's text, and what it is encoded as: UTF-8, UTF-16 by its mark or its zeros, else Windows-1252 or Latin-1."""
    begin, tries = raw[:400], ["utf-8-sig", "Windows-1252"]
    if begin[:2] in (b"\xff\xfe", b"\xfe\xff"):
        tries = ["UTF-16"]
    elif b"\0" in begin:
        tries = ["UTF-16-LE" if begin[1::2].count(0) > begin[::2].count(0) else "UTF-16-BE"]
    for encoding in tries:
        with suppress(UnicodeDecodeError):
            return raw.decode(encoding), encoding
    return raw.decode("latin-1"), "Latin-1"


def read_table(
    path: Path, asked: Asked | None = None, notes: Counter[str] | None = None, decimal: str | None = None
) -> Sheet:
    """A text file's cells, each row under the number of its line; rows of too few or too many cells are faults.

    asked : how its numbers and columns are written, as somebody stated it; None: numbers stay as they are written.
    notes : counts what people should know.  decimal : the mark of the other files, where the file's own cells tell none.
    UnreadableError for a file that is empty or too large, or whose number format is not known.
    """
    import pandas as pd

    size = path.stat().st_size
    if size > LARGEST:
        raise UnreadableError(f"Expected at most {LARGEST // 2**20} MB, got {size // 2**20} MB; split it, or write Parquet")
    text, encoding = decoded(path.read_bytes())
    cells = cells_of(text, () if asked is None else asked.columns)
    if notes is not None and encoding != "utf-8-sig":
        notes[f"Text is read as {encoding}, not UTF-8"] += 1
    if not cells.header:
        raise UnreadableError("Expected a header and rows, it is empty")
    header = _without_trailing_empty(cells.header)  # a delimiter at its end
    if not header:
        raise UnreadableError("Expected a header, the first line names no column", cells.line)
    n = len(header)
    whole = {i: row[:n] for i, row in cells.rows.items() if len(row) >= n and not any(row[n:])}
    wrong = {i: f"Expected {n} columns, got {len(row)}" for i, row in cells.rows.items() if i not in whole}
    frame = pd.DataFrame(list(whole.values()), index=list(whole), columns=header, dtype=object)
    mark = ""
    if asked is not None:
        mark, odd = as_python(frame, cells.delimiter, asked.decimal or decimal, asked.thousands)
        wrong |= odd
    faults = [Fault(path.name, i, what) for i, what in sorted(wrong.items())]
    return Sheet(frame.drop(index=[i for i in wrong if i in whole]), faults, cells.line, cells.units[:n], mark)


def numbers(frame: pd.DataFrame) -> tuple[NDArray[np.float32], dict[int, str]]:
    """(n, columns), NaN where a cell says nothing; and what is wrong with each row that holds what is no number."""
    block, wrong = np.empty(frame.shape), dict[int, str]()
    for i, name in enumerate(frame.columns):
        block[:, i], odd = floats(cells := frame.iloc[:, i])
        for index in odd:
            cell = str(cells[index])
            said = excerpt(cell, BEGINS.match(cell).end())  # type: ignore[union-attr]  # it matches nothing, too
            wrong.setdefault(index, f"Expected a number in column {name}, got {said}")
    with np.errstate(over="ignore"):  # beyond float32 becomes an infinity, which the engine finds
        return block.astype(np.float32), wrong


def read_recording(
    path: Path, channels: Sequence[str], asked: Asked, notes: Counter[str], decimal: str | None = None
) -> Timed:
    """One file's channels (C, T), and its rate by its timestamps; UnreadableError names the line at fault.

    notes, decimal : as of `read_table`.
    """
    frame, faults, line, units_row, _ = read_table(path, asked, notes, decimal)
    places = [place_of(name, list(frame.columns), line) for name in channels]
    if faults:
        raise UnreadableError(faults[0].what, faults[0].line)
    if frame.empty:
        raise UnreadableError("Expected samples below the header, found none", line)
    of_channels = tuple(units_row[i] or units.split(str(frame.columns[i]))[1] for i in places)
    return recording_of(frame, places, asked, notes, units_row)._replace(units=of_channels)


def recording_of(
    rows: pd.DataFrame, places: Sequence[int], asked: Asked, notes: Counter[str], units_row: Sequence[str] = ()
) -> Timed:
    """Rows, a sample each, as (C, T), and their rate, unless it was stated. places : of the channels' columns.

    An empty cell, or one that says nan, is a NaN: the engine finds it, and the part is verified.
    units_row : the units of all columns.  With `fit="resample"` the samples are put on even times by the clock.
    """
    values, wrong = numbers(rows.iloc[:, places])
    if wrong:
        raise UnreadableError(wrong[min(wrong)], min(wrong))
    trace = np.ascontiguousarray(values.T)
    clock = None if asked.rate_hz is not None else clock_of(rows, asked.time, units_row)
    if clock is None:
        known = set(range(rows.shape[1])) if asked.rate_hz is not None else set(places)
        offered = [str(rows.columns[i]) for i in rising(rows) if i not in known]
        for name in offered[:1]:
            notes[f"No clock is known; column {name} rises steadily: time={name!r} if it is one"] += 1
        return Timed(trace)
    rate = rate_of(clock, rows.index)
    if clock.said:
        notes[clock.said] += 1
    return Timed(evenly(trace, clock) if asked.fit == "resample" else trace, rate)


def place_of(name: str, header: Sequence[str], line: int = 1) -> int:
    """Where a header has a name, as it is, in any case, or without its unit; UnreadableError for none, or several."""
    bare = units.split(name)[0].lower()
    for same in (
        lambda word: word == name,
        lambda word: word.lower() == name.lower(),
        lambda word: units.split(word)[0].lower() == bare,
    ):
        places = [i for i, word in enumerate(header) if same(word)]
        if places:
            break
    have = listed(header)
    if not places:
        raise UnreadableError(f"Expected a column {name}, got {have}", line)
    if len(places) > 1:
        anew = ",".join(f"{word}_{i}" if word in header[:i] else word for i, word in enumerate(header))
        do = f"name them anew, columns={anew!r}"
        raise UnreadableError(f"Expected a column {name}, got it twice or more in {have}; {do}", line)
    return places[0]
