"""CSV files in the dialects that people's tools write, read by pandas; and the rate that a column of times tells."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..traces import is_time
from .dataset import Fault, UnreadableError

if TYPE_CHECKING:
    import pandas as pd

LARGEST = 256 * 2**20  # bytes of one text file
NOTHING = ("", "nan", "na", "n/a", "null", "none", "-nan")  # a cell without a number: kept as NaN
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|[+-]?inf(inity)?", re.IGNORECASE)
DECIMAL = re.compile(r"^([+-]?\d*),(\d+(?:[eE][+-]?\d+)?)$")
GAP = 5.0  # median steps: a pause that a late message does not explain
SLOW = 0.5  # seconds: no recorder of forces steps so slowly; a clock without a unit counts thousandths, or less
UNITS = {"ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}


def is_number(word: str) -> bool:
    """Whether a cell holds a number, or says that it holds none."""
    return word.lower() in NOTHING or NUMBER.fullmatch(word) is not None


def header_of(line: str) -> tuple[list[str], str]:
    """The columns' names in a file's first line, and its delimiter, the one of , ; and tab that it has most of."""
    delimiter = max(",;\t", key=line.count)
    names = [word.strip().strip('"') for word in _words(line.replace("\0", ""), delimiter)]
    while names and not names[-1]:  # a delimiter at its end
        names.pop()
    return names, delimiter


def _words(line: str, delimiter: str) -> list[str]:
    if '"' not in line:
        return line.split(delimiter)
    try:
        return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    except csv.Error as error:  # a field of megabytes
        raise UnreadableError(f"Expected separated values, got a line of {len(line)} characters: {error}") from error


@dataclass(slots=True)
class Table:
    """The rows of a CSV file as text. lines : where each stands in the file.  widest : columns, empty ones at the end too.

    faults : rows of too few or too many columns, which are left out.
    """

    header: list[str]
    delimiter: str
    rows: list[str]
    lines: list[int]
    faults: list[Fault]
    widest: int

    def frame(self, columns: Iterable[int] | None = None, as_text: bool = False) -> pd.DataFrame:
        """The columns at these places, under their places; of numbers where all of a column are, else of text."""
        import pandas as pd

        used = sorted(set(range(len(self.header)) if columns is None else columns))
        comma = self.delimiter != "," and any("," in row for row in self.rows)  # as a German Excel writes numbers
        how: dict[str, Any] = {"sep": self.delimiter, "decimal": "," if comma else ".", "skipinitialspace": True}
        how |= {"header": None, "names": range(self.widest), "usecols": used, "index_col": False}
        how |= {"dtype": str, "keep_default_na": False} if as_text else {"float_precision": "round_trip"}
        try:
            frame = pd.read_csv(io.StringIO("\n".join(self.rows)), low_memory=False, **how)
        except (ValueError, OverflowError, pd.errors.ParserError) as error:
            raise UnreadableError(f"It cannot be read as CSV: {' '.join(str(error).split())}") from error
        for place in used if comma and not as_text else ():
            if not pd.api.types.is_numeric_dtype(frame[place]):  # one cell is no number, and all came as text
                frame[place] = frame[place].astype("str").str.replace(DECIMAL, r"\1.\2", regex=True)
        return frame


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
    table = Table(header, delimiter, [], [], [], len(header))
    for number, row in below:
        words = _words(row, delimiter)
        if len(words) >= len(header) and not any(word.strip() for word in words[len(header) :]):
            table.rows.append(row)
            table.lines.append(number)
            table.widest = max(table.widest, len(words))
        else:
            table.faults.append(Fault(path.name, number, f"Expected {len(header)} columns, got {len(words)}"))
    return table


def numbers(frame: pd.DataFrame) -> tuple[NDArray[np.float32], dict[int, str]]:
    """(n, columns), NaN where a cell says nothing; and what is wrong with each row that holds what is no number."""
    import pandas as pd

    block, wrong = np.empty(frame.shape), dict[int, str]()
    for i, name in enumerate(frame.columns):
        cells = frame.iloc[:, i]
        found = cells if pd.api.types.is_numeric_dtype(cells) else pd.to_numeric(cells, errors="coerce")
        block[:, i] = found.to_numpy(dtype=np.float64, na_value=np.nan)
        if found is not cells:
            for place in np.flatnonzero((found.isna() & cells.notna()).to_numpy()).tolist():
                word = str(cells.iloc[place])
                if word.strip().lower() not in NOTHING:
                    wrong.setdefault(place, f"Expected a number in column {name}, got {word[:20]!r}")
    with np.errstate(over="ignore"):  # beyond float32 becomes an infinity, which the engine finds
        return block.astype(np.float32), wrong


def read_recording(path: Path, channels: Sequence[str], timed: bool) -> tuple[NDArray[np.float32], float | None]:
    """One file's channels (C, T), and its rate by its timestamps, if timed; UnreadableError names the line at fault.

    An empty cell, or one that says nan, is a NaN: the engine finds it, and the part is verified.
    """
    table = read_table(path)
    places = [place_of(name, table.header) for name in channels]
    for fault in table.faults[:1]:
        raise UnreadableError(fault.what, fault.line)
    if not table.rows:
        raise UnreadableError("Expected samples below the header, found none", 1)
    clock = next((i for i, name in enumerate(table.header) if is_time(name)), None) if timed else None
    frame = table.frame([*places, *([] if clock is None else [clock])])
    values, wrong = numbers(frame[places].set_axis([table.header[i] for i in places], axis=1))
    if wrong:
        raise UnreadableError(wrong[min(wrong)], table.lines[min(wrong)])
    rate = None if clock is None else rate_of(seconds_of(frame[clock], table.header[clock]))
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

    if pd.api.types.is_numeric_dtype(column):
        times = column.to_numpy(dtype=np.float64)
        return np.asarray((times - times[0]) * _unit_of(times, name))
    words = column.astype(str).str.strip()
    odd = ~words.map(is_number).to_numpy(dtype=np.bool_)
    stamps = pd.to_datetime(column, errors="coerce", format="ISO8601", utc=True)
    bad = np.flatnonzero(odd if 2 * odd.sum() < len(odd) else stamps.isna())
    if len(bad):
        raise UnreadableError(
            f"Expected a time in column {name}, in seconds or as 2026-03-01T12:00:00.002, got {words.iloc[bad[0]][:30]!r}; "
            "a stated rate (rate_hz) leaves times unread",
            int(bad[0]) + 2,
        )
    return np.asarray((stamps - stamps.iloc[0]).dt.total_seconds(), dtype=np.float64)


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
