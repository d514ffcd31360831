"""CSV files in the dialects that people's tools write; and the rate that a column of times tells."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..traces import is_time
from .dataset import Fault, UnreadableError

if TYPE_CHECKING:
    import pandas as pd

Timed = tuple[NDArray[np.float32], float | None]  # (C, T), and hertz where there are timestamps
LARGEST = 128 * 2**20  # bytes of one text file
NOTHING = ("", "nan", "na", "n/a", "null", "none", "-nan", "<na>")  # a cell without a number: kept as NaN
DECIMAL = re.compile(r"(?<![^\s;\"])([+-]?\d*),(\d+(?:[eE][+-]?\d+)?)(?![^\s;\"])")  # a whole cell
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|nan", re.IGNORECASE)
UNIT = re.compile(r"\[.*\]|\(.*\)|[kmµu]?[sNVAgm]|ns|Nm|N[·*.]m|bar|Hz|rad|°C?|%|-")  # a cell of a row of units
DAY_FIRST = re.compile(r"^(\d\d)\.(\d\d)\.(\d{4})")  # a German day
GAP = 5.0  # median steps: a pause that a late message does not explain
SLOW = 0.5  # seconds: no recorder of forces steps so slowly; a clock without a unit counts thousandths, or less
UNITS = {"ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}


def cells_of(text: str) -> dict[int, list[str]]:
    """Line number -> cells, of the lines that are not blank; UnreadableError for a line of megabytes.

    The delimiter is the tab or ; of which most lines have as many, or else the one of , ; and tab that the first line has
    most of. Where it is not the comma, a comma is a decimal's, as a German Excel writes numbers.
    """
    lines = {i: line for i, line in enumerate(text.splitlines(), start=1) if line.strip()}
    delimiter = max(",;\t", key=next(iter(lines.values()), "").count)
    for each in "\t;":
        n, times = next(iter(Counter(line.count(each) for line in lines.values()).most_common(1)), (0, 0))
        delimiter = each if n and 2 * times > len(lines) else delimiter
    if delimiter != ",":
        lines = {i: DECIMAL.sub(r"\1.\2", line) for i, line in lines.items()}
    try:
        rows = {i: next(csv.reader([line], delimiter=delimiter, skipinitialspace=True)) for i, line in lines.items()}
    except csv.Error as error:
        raise UnreadableError(f"Expected separated values, got others: {error}") from error
    return _from_header(list(rows), [[word.strip() for word in row] for row in rows.values()])


def _from_header(lines: list[int], rows: list[list[str]]) -> dict[int, list[str]]:
    """Line number -> cells from the header on, without what a recorder writes above it, and without a row of units.

    A row of data has numbers in most columns that have them in the last rows. A first line that may be the header is one,
    if only one other line is above the data: that is damaged data. UnreadableError where there is none.
    """
    numbers: Callable[[list[str]], frozenset[int]]
    numbers = lambda row: frozenset(i for i, word in enumerate(row) if NUMBER.fullmatch(word))  # noqa: E731
    usual = Counter(map(numbers, rows[1:][-20:])).most_common(1)
    data = next((k for k, row in enumerate(rows) for some, _ in usual if 2 * len(numbers(row) & some) > len(some)), 0)
    units = [all(map(UNIT.fullmatch, row)) for row in rows[:data]]
    header = max(data - 1 - (data > 1 and units[-1]), 0)
    if header == 1 and len(rows[0]) >= len(rows[data]) and not units[0]:
        header = data = 0
    for row in rows[header : header + 1]:  # whole numbers may be names
        if 2 * len(numbers(row)) > len(row) and not all(row[i].isdecimal() for i in numbers(row)):
            raise UnreadableError("Expected a header, its first line is of numbers; write one above, as in time,FZ", 1)
    return {i: rows[k] for k, i in enumerate(lines) if k == header or k >= max(data, 1)}


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


def read_table(path: Path, encodings: Counter[str] | None = None) -> tuple[pd.DataFrame, list[Fault]]:
    """A CSV file's cells as text, each row under the number of its line; rows of too few or too many cells are faults.

    encodings : counts what is not UTF-8.  UnreadableError for a file that is empty or too large.
    """
    import pandas as pd

    size = path.stat().st_size
    if size > LARGEST:
        raise UnreadableError(f"Expected at most {LARGEST // 2**20} MB, got {size // 2**20} MB; split it, or write Parquet")
    text, encoding = decoded(path.read_bytes())
    rows = cells_of(text)
    if encodings is not None and encoding != "utf-8-sig":
        encodings[encoding] += 1
    if not rows:
        raise UnreadableError("Expected a header and rows, it is empty")
    header = rows.pop(min(rows))
    while header and not header[-1]:  # a delimiter at its end
        header.pop()
    if not header:
        raise UnreadableError("Expected a header, the first line names no column", 1)
    n = len(header)
    whole = {i: row[:n] for i, row in rows.items() if len(row) >= n and not any(row[n:])}
    faults = [Fault(path.name, i, f"Expected {n} columns, got {len(row)}") for i, row in rows.items() if i not in whole]
    return pd.DataFrame(list(whole.values()), index=list(whole), columns=header, dtype=object), faults


def floats(cells: pd.Series) -> tuple[NDArray[np.float64], list[int]]:
    """(n,) numbers, NaN where a cell says nothing; and under which index a cell holds what is no number."""
    import pandas as pd

    if pd.api.types.is_numeric_dtype(cells):
        return cells.to_numpy(dtype=np.float64, na_value=np.nan), []
    values, wrong = np.full(len(cells), np.nan), []
    for i, (index, cell) in enumerate(cells.items()):
        try:
            values[i] = float(cell)
        except (TypeError, ValueError, OverflowError):
            if str(cell).strip().lower() not in NOTHING:
                wrong.append(index)
    return values, wrong


def numbers(frame: pd.DataFrame) -> tuple[NDArray[np.float32], dict[int, str]]:
    """(n, columns), NaN where a cell says nothing; and what is wrong with each row that holds what is no number."""
    block, wrong = np.empty(frame.shape), dict[int, str]()
    for i, name in enumerate(frame.columns):
        block[:, i], odd = floats(cells := frame.iloc[:, i])
        for index in odd:
            wrong.setdefault(index, f"Expected a number in column {name}, got {str(cells[index])[:20]!r}")
    with np.errstate(over="ignore"):  # beyond float32 becomes an infinity, which the engine finds
        return block.astype(np.float32), wrong


def read_recording(path: Path, channels: Sequence[str], timed: bool, encodings: Counter[str]) -> Timed:
    """One file's channels (C, T), and its rate by its timestamps, if timed; UnreadableError names the line at fault."""
    frame, faults = read_table(path, encodings)
    places = [place_of(name, list(frame.columns)) for name in channels]
    if faults:
        raise UnreadableError(faults[0].what, faults[0].line)
    if frame.empty:
        raise UnreadableError("Expected samples below the header, found none", 1)
    return recording_of(frame, places, timed)


def recording_of(rows: pd.DataFrame, places: Sequence[int], timed: bool, time: str | None = None) -> Timed:
    """Rows, a sample each, as (C, T), and their rate, if timed, as `rate_of`. places : of the channels' columns.

    An empty cell, or one that says nan, is a NaN: the engine finds it, and the part is verified.
    """
    values, wrong = numbers(rows.iloc[:, places])
    if wrong:
        raise UnreadableError(wrong[min(wrong)], min(wrong))
    return np.ascontiguousarray(values.T), rate_of(rows, time) if timed else None


def place_of(name: str, header: Sequence[str]) -> int:
    """Where a header has a name, in any case if it is not there as it is written; UnreadableError for none, or several."""
    places = [i for i, word in enumerate(header) if word == name]
    places = places or [i for i, word in enumerate(header) if word.lower() == name.lower()]
    if len(places) != 1:
        have = ", ".join(header)[:100]
        raise UnreadableError(f"Expected a column {name}, got {'it twice or more in ' if places else ''}{have}", 1)
    return places[0]


def rate_of(frame: pd.DataFrame, time: str | None = None) -> float | None:
    """Samples a second, to four digits, by the median step of a table's timestamps; None where it has none.

    Timestamps are numbers, in the unit that name or steps tell, or times of day as text.  time : their column, where its
    name does not say so. UnreadableError where one is missing, turns back or jumps.
    """
    import pandas as pd

    place = next((i for i, name in enumerate(frame.columns) if name == time or (not time and is_time(str(name)))), None)
    if place is None or len(frame) < 2:
        return None
    column = frame.iloc[:, place]
    times, odd = floats(column)
    unit = _unit_of(times, str(column.name))
    if 2 * len(odd) >= len(times):
        said = column.astype(str).str.replace(DAY_FIRST, r"\3-\2-\1", regex=True).str.replace(",", ".")
        stamps = pd.to_datetime(said, errors="coerce", format="ISO8601", utc=True)
        odd, unit = stamps.index[stamps.isna()].tolist(), 1.0
        times = (stamps - stamps.iloc[0]).dt.total_seconds().to_numpy(dtype=np.float64)
    if odd:
        wanted, got = "in seconds or as 2026-03-01T12:00:00.002", str(column[odd[0]])[:30]
        what = f"Expected a time in column {column.name}, {wanted}, got {got!r}; a stated rate (rate_hz) needs none"
        raise UnreadableError(what, odd[0])
    steps = np.diff((times - times[0]) * unit)
    for where in np.flatnonzero(~(steps > 0))[:1].tolist():
        what = "Expected a later time than that of the row before, or a stated rate (rate_hz)"
        raise UnreadableError(what, column.index[where + 1])
    step = float(np.median(steps))
    for where in np.flatnonzero(steps > GAP * step)[:1].tolist():
        what = f"Expected a step of {step:.3g} s in time, got a gap of {steps[where]:.3g} s"
        raise UnreadableError(what, column.index[where + 1])
    return float(f"{1.0 / step:.4g}")


def _unit_of(times: NDArray[np.float64], name: str) -> float:
    """Seconds in one of a clock: by its name, or so that its steps are a recorder's."""
    ending = re.search(r"[_ \[(](ms|us|µs|ns)[\])]?$", name.lower())
    if ending:
        return UNITS[ending[1]]
    step = float(np.median(np.diff(times)))
    return next((unit for unit in (1.0, 1e-3, 1e-6) if step * unit < SLOW), 1e-9)
