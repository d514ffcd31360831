"""One recording in one CSV file: its channels, and the rate that its timestamps tell.

Text files of separated values: their delimiter, their header, their lines; and the line that cannot be read.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..traces import is_time
from .dataset import UnreadableError

if TYPE_CHECKING:
    import pandas as pd

LARGEST = 256 * 2**20  # bytes of one text file
NOTHING = {"", "nan", "na", "n/a", "null", "none", "-nan"}  # a cell without a number: kept as NaN
Lines = list[tuple[int, str]]


def read_text(path: Path) -> str:
    """A file's text; UnreadableError for one that is empty, too large, or not UTF-8."""
    size = path.stat().st_size
    if size > LARGEST:
        raise UnreadableError(f"Expected at most {LARGEST // 2**20} MB, got {size // 2**20} MB; split it, or write Parquet")
    raw = path.read_bytes()
    if not raw.strip():
        raise UnreadableError("Expected a header and rows, it is empty")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise UnreadableError(
            f"Expected UTF-8 text, got the byte 0x{raw[error.start]:02x}; save it as UTF-8", line
        ) from error


def read_lines(path: Path) -> tuple[list[str], Lines, str]:
    """A file's header, its other lines with their numbers, without blank ones, and its delimiter."""
    lines = [(number, line) for number, line in enumerate(read_text(path).splitlines(), start=1) if line.strip()]
    delimiter = delimiter_of(lines[0][1] if lines else "")
    names = named_columns(lines[0][1], delimiter) if lines else []
    if not names:
        raise UnreadableError("Expected a header, the first line names no column", 1)
    return names, lines[1:], delimiter


def read_header(path: Path) -> list[str]:
    """The names in a file's first line; none where it has no such line."""
    with path.open("rb") as file:
        line = file.readline(2**20).decode("utf-8-sig", errors="replace")
    try:
        return named_columns(line, delimiter_of(line)) if line.strip() else []
    except UnreadableError:  # said when the whole file is read
        return []


def delimiter_of(line: str) -> str:
    """The one of comma, semicolon and tab that a header has most of."""
    return max(",;\t", key=line.count)


def split_line(line: str, delimiter: str) -> list[str]:
    """Its words, without blanks and quotes around them; a delimiter between quotes is part of a word."""
    try:
        words = next(csv.reader([line.rstrip("\r\n").replace("\0", "")], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error as error:  # a field of megabytes
        raise UnreadableError(f"Expected separated values, got a line of {len(line)} characters: {error}") from error
    return [word.strip().strip('"') for word in words]


def fitting(words: list[str], n: int) -> list[str]:
    """A line's words where they are n, but for empty ones that a comma at its end makes; UnreadableError elsewhere."""
    if len(words) < n or any(words[n:]):
        raise UnreadableError(f"Expected {n} columns, got {len(words)}")
    return words[:n]


def named_columns(line: str, delimiter: str) -> list[str]:
    """A header's names, without the empty ones that a comma at its end makes."""
    names = split_line(line, delimiter)
    while names and not names[-1]:
        names.pop()
    return names


def decimal_of(text: str, delimiter: str) -> str:
    """A comma where the columns are separated otherwise and numbers are written with one, as a German Excel does."""
    return "," if delimiter != "," and "," in text[text.find("\n") :] else "."


def find_fault(text: str, header: Sequence[str], wanted: Sequence[int], delimiter: str, decimal: str) -> None:
    """UnreadableError that names the first line with too few or too many columns, or no number where one is wanted."""
    for number, line in enumerate(text.splitlines()[1:], start=2):
        if not line.strip():
            continue
        try:
            words = fitting(split_line(line, delimiter), len(header))
        except UnreadableError as error:
            raise UnreadableError(error.what, number) from None
        for place in wanted:
            if not is_number(words[place].replace(decimal, ".")):
                raise UnreadableError(f"Expected a number in column {header[place]}, got {words[place][:20]!r}", number)


def is_number(word: str) -> bool:
    """Whether a cell holds a number, or says that it holds none."""
    if word.lower() in NOTHING:
        return True
    try:
        float(word)
    except ValueError:
        return False
    return True


GAP = 5.0  # median steps: a pause that a late message does not explain
EPOCHS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))  # a time of day as a number: above this, in units of so many seconds
SLOW = (
    0.5  # seconds: no recorder of forces steps so slowly, a clock without a unit counts thousandths, or thousandths of them
)
UNITS = {"ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}


@dataclass(frozen=True, slots=True)
class Recording:
    """values : (C, T) float32.  rate_hz : from its timestamps; None where it has none, or they were not asked for."""

    values: NDArray[np.float32]
    rate_hz: float | None


def read_recording(path: Path, channels: Sequence[str], timed: bool) -> Recording:
    """The channels of one file; UnreadableError names the line that cannot be read, for pandas alone would not.

    An empty cell, or one that says nan, is a NaN: the engine finds it, and the part is verified.
    """
    text = read_text(path)
    head = text[: text.find("\n")] if "\n" in text else text
    delimiter = delimiter_of(head)
    header = named_columns(head, delimiter)
    places = [place_of(name, header) for name in channels]
    clock = next((i for i, name in enumerate(header) if is_time(name)), None) if timed else None
    frame = _parse(text, header, places, clock, delimiter)
    if frame.empty:
        raise UnreadableError("Expected samples below the header, found none", 1)
    values = frame[places].to_numpy(dtype=np.float32).T
    rate = None if clock is None else rate_of(seconds_of(frame[clock], header[clock]))
    return Recording(np.ascontiguousarray(values), rate)


def place_of(name: str, header: Sequence[str]) -> int:
    """Where a header has a name, in any case if it is not there as it is written; UnreadableError for none, or several."""
    places = [i for i, word in enumerate(header) if word == name]
    places = places or [i for i, word in enumerate(header) if word.lower() == name.lower()]
    if len(places) != 1:
        listed = ", ".join(header)[:100] or "an empty line"
        raise UnreadableError(f"Expected a column {name}, got {'it twice or more in ' if places else ''}{listed}", 1)
    return places[0]


def _parse(text: str, header: Sequence[str], places: list[int], clock: int | None, delimiter: str) -> pd.DataFrame:
    import pandas as pd

    decimal = decimal_of(text, delimiter)
    body = text.rstrip("\r\n")
    even = body.count(delimiter) == (body.count("\n") + 1) * (len(header) - 1)
    if not even:  # pandas takes a short row for one with empty cells
        find_fault(text, header, places, delimiter, decimal)
    used = sorted({*places, *([] if clock is None else [clock])})
    how: dict[str, Any] = {"header": None, "skiprows": 1, "usecols": used, "sep": delimiter, "decimal": decimal}
    try:
        return pd.read_csv(io.StringIO(text), dtype=dict.fromkeys(places, np.float64), float_precision="round_trip", **how)
    except pd.errors.EmptyDataError:
        raise UnreadableError("Expected samples below the header, found none", 1) from None
    except (ValueError, pd.errors.ParserError) as error:
        find_fault(text, header, places, delimiter, decimal)
        raise UnreadableError(f"It cannot be read as CSV: {' '.join(str(error).split())}") from error


def seconds_of(column: Any, name: str) -> NDArray[np.float64]:
    """Timestamps as seconds from the first: numbers, in the unit that name or size tell, or times of day as text."""
    import pandas as pd

    if pd.api.types.is_numeric_dtype(column):
        times = column.to_numpy(dtype=np.float64)
        ending = re.search(r"[_ \[(](ms|us|µs|ns)[\])]?$", name.lower())
        unit = UNITS[ending[1]] if ending else 0.0
        first: float = np.nan_to_num(times[0])
        unit = unit or next((seconds for above, seconds in EPOCHS if first > above), 0.0) or _unit_of(np.diff(times))
        return np.asarray((times - times[0]) * unit)
    words = column.astype(str).str.strip()
    numbers = [is_number(word) for word in words]
    if 2 * sum(numbers) > len(numbers):
        _refuse_time(words, numbers.index(False) if False in numbers else 0, name)
    stamps = pd.to_datetime(column, errors="coerce", format="ISO8601", utc=True)
    bad = np.flatnonzero(stamps.isna())
    if len(bad):
        _refuse_time(words, int(bad[0]), name)
    return np.asarray((stamps - stamps.iloc[0]).dt.total_seconds(), dtype=np.float64)


def _refuse_time(words: pd.Series, place: int, name: str) -> None:
    what = f"Expected a time in column {name}, in seconds or as 2026-03-01T12:00:00.002, got {words.iloc[place][:30]!r}"
    raise UnreadableError(f"{what}; a stated rate (rate_hz) leaves times unread", place + 2)


def _unit_of(steps: NDArray[np.float64]) -> float:
    """Seconds in one of a clock that names no unit: a second, or the thousandth, ... that makes its steps a recorder's."""
    step = float(np.median(steps)) if len(steps) else 0.0
    return next((unit for unit in (1.0, 1e-3, 1e-6) if step * unit < SLOW), 1e-9)


def rate_of(seconds: NDArray[np.float64]) -> float | None:
    """Samples a second, to four digits, by the median step; UnreadableError where time is missing, turns back or jumps."""
    steps = np.diff(seconds)
    if not len(steps):
        return None
    wrong = np.flatnonzero(~(steps > 0))
    if len(wrong):
        raise UnreadableError(
            "Expected a later time than that of the row before, or a stated rate (rate_hz)", int(wrong[0]) + 3
        )
    step = float(np.median(steps))
    jumps = np.flatnonzero(steps > GAP * step)
    if len(jumps):
        where = int(jumps[0])
        raise UnreadableError(f"Expected a step of {step:.3g} s in time, got a gap of {steps[where]:.3g} s", where + 3)
    return float(f"{1.0 / step:.4g}")
