"""CSV files in the dialects that people's tools write; and the rate that a column of times tells."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..traces import is_time
from .dataset import Fault, UnreadableError

if TYPE_CHECKING:
    import pandas as pd

LARGEST = 128 * 2**20  # bytes of one text file
NOTHING = ("", "nan", "na", "n/a", "null", "none", "-nan", "<na>")  # a cell without a number: kept as NaN
DECIMAL = re.compile(r"([+-]?\d*),(\d+(?:[eE][+-]?\d+)?)")
GAP = 5.0  # median steps: a pause that a late message does not explain
SLOW = 0.5  # seconds: no recorder of forces steps so slowly; a clock without a unit counts thousandths, or less
UNITS = {"ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}


def header_of(line: str) -> tuple[list[str], str]:
    """The columns' names in a file's first line, and its delimiter, the one of , ; and tab that it has most of."""
    delimiter = max(",;\t", key=line.count)
    names = [word.strip('"') for word in _words(line.replace("\0", ""), delimiter)]
    while names and not names[-1]:  # a delimiter at its end
        names.pop()
    return names, delimiter


def _words(line: str, delimiter: str) -> list[str]:
    """A line's cells; where it is not the comma that parts them, it is a decimal's, as a German Excel writes numbers."""
    try:
        quoted = '"' in line
        words = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True)) if quoted else line.split(delimiter)
    except csv.Error as error:  # a field of megabytes
        raise UnreadableError(f"Expected separated values, got a line of {len(line)} characters: {error}") from error
    if delimiter != "," and "," in line:
        return [DECIMAL.sub(r"\1.\2", word) if DECIMAL.fullmatch(word.strip()) else word.strip() for word in words]
    return [word.strip() for word in words]


@dataclass(slots=True)
class Table:
    """The cells of a CSV file, as text. lines : where each row stands in the file.

    faults : rows of too few or too many columns, which are left out.
    """

    header: list[str]
    rows: list[list[str]]
    lines: list[int]
    faults: list[Fault]


def read_table(path: Path) -> Table:
    """A CSV file; UnreadableError for one that is empty, too large, or not UTF-8."""
    size = path.stat().st_size
    if size > LARGEST:
        raise UnreadableError(f"Expected at most {LARGEST // 2**20} MB, got {size // 2**20} MB; split it, or write Parquet")
    raw = path.read_bytes()
    if not raw.strip():
        raise UnreadableError("Expected a header and rows, it is empty")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        byte = f"0x{raw[error.start]:02x}"
        raise UnreadableError(f"Expected UTF-8 text, got the byte {byte}; save it as UTF-8", line) from None
    (_, head), *below = [(number, line) for number, line in enumerate(text.splitlines(), start=1) if line.strip()]
    header, delimiter = header_of(head)
    if not header:
        raise UnreadableError("Expected a header, the first line names no column", 1)
    table, n = Table(header, [], [], []), len(header)
    for number, row in below:
        words = _words(row, delimiter)
        if len(words) >= n and not any(words[n:]):
            table.rows.append(words[:n])
            table.lines.append(number)
        else:
            table.faults.append(Fault(path.name, number, f"Expected {n} columns, got {len(words)}"))
    return table


def floats(cells: pd.Series) -> tuple[NDArray[np.float64], list[int]]:
    """(n,) numbers, NaN where a cell says nothing; and the places of those that hold what is no number."""
    import pandas as pd

    if pd.api.types.is_numeric_dtype(cells):
        return cells.to_numpy(dtype=np.float64, na_value=np.nan), []
    values, wrong = np.full(len(cells), np.nan), []
    for i, cell in enumerate(cells.tolist()):
        try:
            values[i] = float(cell)
        except (TypeError, ValueError):
            if str(cell).strip().lower() not in NOTHING:
                wrong.append(i)
    return values, wrong


def numbers(frame: pd.DataFrame) -> tuple[NDArray[np.float32], dict[int, str]]:
    """(n, columns), NaN where a cell says nothing; and what is wrong with each row that holds what is no number."""
    block, wrong = np.empty(frame.shape), dict[int, str]()
    for i, name in enumerate(frame.columns):
        block[:, i], places = floats(frame.iloc[:, i])
        for place in places:
            wrong.setdefault(place, f"Expected a number in column {name}, got {str(frame.iloc[place, i])[:20]!r}")
    with np.errstate(over="ignore"):  # beyond float32 becomes an infinity, which the engine finds
        return block.astype(np.float32), wrong


def read_recording(path: Path, channels: Sequence[str], timed: bool) -> tuple[NDArray[np.float32], float | None]:
    """One file's channels (C, T), and its rate by its timestamps, if timed; UnreadableError names the line at fault.

    An empty cell, or one that says nan, is a NaN: the engine finds it, and the part is verified.
    """
    import pandas as pd

    table = read_table(path)
    places = [place_of(name, table.header) for name in channels]
    for fault in table.faults[:1]:
        raise UnreadableError(fault.what, fault.line)
    if not table.rows:
        raise UnreadableError("Expected samples below the header, found none", 1)
    values, wrong = numbers(pd.DataFrame({table.header[i]: [row[i] for row in table.rows] for i in places}))
    if wrong:
        raise UnreadableError(wrong[min(wrong)], table.lines[min(wrong)])
    clock = next((i for i, name in enumerate(table.header) if is_time(name)), None) if timed else None
    times = None if clock is None else pd.Series([row[clock] for row in table.rows], dtype=object)
    rate = None if clock is None else rate_of(seconds_of(times, table.header[clock]))
    return np.ascontiguousarray(values.T), rate


def place_of(name: str, header: Sequence[str]) -> int:
    """Where a header has a name, in any case if it is not there as it is written; UnreadableError for none, or several."""
    places = [i for i, word in enumerate(header) if word == name]
    places = places or [i for i, word in enumerate(header) if word.lower() == name.lower()]
    if len(places) != 1:
        have = ", ".join(header)[:100]
        raise UnreadableError(f"Expected a column {name}, got {'it twice or more in ' if places else ''}{have}", 1)
    return places[0]


def seconds_of(column: Any, name: str) -> NDArray[np.float64]:
    """Timestamps as seconds from the first: numbers, in the unit that name or steps tell, or times of day as text."""
    import pandas as pd

    times, odd = floats(column)
    unit = _unit_of(times, name)
    if 2 * len(odd) >= len(times):
        stamps = pd.to_datetime(column, errors="coerce", format="ISO8601", utc=True)
        odd, unit = np.flatnonzero(stamps.isna()).tolist(), 1.0
        times = (stamps - stamps.iloc[0]).dt.total_seconds().to_numpy(dtype=np.float64)
    if odd:
        wanted, got = "in seconds or as 2026-03-01T12:00:00.002", str(column.iloc[odd[0]])[:30]
        what = f"Expected a time in column {name}, {wanted}, got {got!r}; a stated rate (rate_hz) leaves times unread"
        raise UnreadableError(what, odd[0] + 2)
    return np.asarray((times - times[0]) * unit)


def _unit_of(times: NDArray[np.float64], name: str) -> float:
    """Seconds in one of a clock: by its name, or so that its steps are a recorder's."""
    ending = re.search(r"[_ \[(](ms|us|µs|ns)[\])]?$", name.lower())
    if ending:
        return UNITS[ending[1]]
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    return next((unit for unit in (1.0, 1e-3, 1e-6) if step * unit < SLOW), 1e-9)


def rate_of(seconds: NDArray[np.float64]) -> float | None:
    """Samples a second, to four digits, by the median step; UnreadableError where time is missing, turns back or jumps."""
    steps = np.diff(seconds)
    if not len(steps):
        return None
    for where in np.flatnonzero(~(steps > 0))[:1].tolist():
        raise UnreadableError("Expected a later time than that of the row before, or a stated rate (rate_hz)", where + 3)
    step = float(np.median(steps))
    for where in np.flatnonzero(steps > GAP * step)[:1].tolist():
        raise UnreadableError(f"Expected a step of {step:.3g} s in time, got a gap of {steps[where]:.3g} s", where + 3)
    return float(f"{1.0 / step:.4g}")
