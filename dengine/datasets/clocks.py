"""Which column of a recording is its clock, what its times are, and the rate that they tell.

A clock is known by its name (`traces.is_time_column`), or by its values: times of day, or seconds since 1970. Any
other column that rises steadily may be one, or a path: it is offered, and a person says so.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import excerpt, listed
from ..traces import is_time_column
from . import units
from .dataset import UnreadableError

if TYPE_CHECKING:
    import pandas as pd

NOTHING = ("", "nan", "na", "n/a", "null", "none", "-nan", "<na>")  # a cell without a number: kept as NaN
GAP = 5.0  # median steps: a pause that a late message does not explain
UNEVEN = 0.1  # steps: what is less off even times is read as even
LATE = 1.5  # median steps: up to here a step is usual
SLOW = 0.5  # seconds: no recorder of forces steps so slowly; a clock without a unit counts thousandths, or less
RATES = (1.0, 1e6)  # hertz that are believed
SPANS = (1e-3, 3600.0)  # seconds that a recording is believed to last
DAY = 86400.0
EXCEL_DAYS = (2e4, 8e4)  # since 1900: the years 1954 to 2119
EPOCHS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3), (1e9, 1.0))  # from this number on, the seconds of one
LATEST = 5e9  # seconds since 1970: the year 2128
TELLING = 200  # rows that tell whether a column rises
STEADY = 0.9  # of the steps of a column that rises steadily, each within a half of their median
SECONDS = {"s": 1.0, "sec": 1.0, "secs": 1.0, "second": 1.0, "seconds": 1.0, "sekunden": 1.0}
SECONDS |= dict.fromkeys(("ms", "msec", "msecs", "millis", "millisec", "milliseconds"), 0.001)
SECONDS |= dict.fromkeys(("us", "µs", "μs", "usec", "usecs", "micros", "microseconds"), 1e-06)
SECONDS |= dict.fromkeys(("ns", "nsec", "nsecs", "nanos", "nanosec", "nanoseconds"), 1e-09)
SECONDS |= {"min": 60.0, "h": 3600.0, "d": DAY, "days": DAY}
STATED = re.compile(r"[\[({</]\s*(?P<n>\d*[.,]?\d+)?\s*(?P<unit>[a-zµμ]+)\s*[\])}>]?\s*$|\bin (?P<such>[a-zµμ]+)$")
DAY_FIRST = re.compile(r"^(\d\d?)\.(\d\d?)\.(\d{4})")  # a German day
SLASHED_DAY = re.compile(r"^(\d\d?)/(\d\d?)/(\d{4})")
OF_DAY = re.compile(r"\d{1,2}:\d{2}(:\d{2})?(\.\d+)?")
DAY_FORM = r"\d{4}-?\d\d-?\d\d|\d{4}/\d\d?/\d\d?|\d\d?[./]\d\d?[./]\d{2,4}"
TIME_FORM = r"\d{1,2}:?\d\d(:?\d\d([.,]\d+)?)?\s*(Z|UTC|AM|PM|[+\-−]\d\d(:?\d\d)?)?"
STAMP = re.compile(rf"({DAY_FORM})([T ]\s*{TIME_FORM})?|\d{{1,2}}:\d\d(:\d\d)?([.,]\d+)?", re.IGNORECASE)


class Clock(NamedTuple):
    """A recording's clock.

    name : of its column.  seconds : (n,) since the first row; NaN where a cell tells none.  said : what people should
    know of it, "" where its name and its unit say all.
    """

    name: str
    seconds: NDArray[np.float64]
    said: str


def floats(cells: pd.Series) -> tuple[NDArray[np.float64], list[int]]:
    """(n,) numbers, NaN where a cell says nothing; and under which index a cell holds what is no number."""
    import pandas as pd

    if pd.api.types.is_numeric_dtype(cells):
        return cells.to_numpy(dtype=np.float64, na_value=np.nan), []
    values = np.full(len(cells), np.nan)
    wrong = []
    for i, (index, cell) in enumerate(cells.items()):
        try:
            values[i] = float(cell)
        except (TypeError, ValueError, OverflowError):
            if str(cell).strip().lower() not in NOTHING:
                wrong.append(index)
    return values, wrong


def place_of_clock(frame: pd.DataFrame, time: str | None = None) -> int | None:
    """Where the clock's column is; None where none is known. time : its name, as somebody stated it."""
    names = [str(name) for name in frame.columns]
    head = frame.iloc[:TELLING]
    if time is not None:
        places = [i for i, name in enumerate(names) if name == time]
        places = places or [i for i, name in enumerate(names) if units.split(name)[0] == units.split(time)[0]]
        if not places:
            raise UnreadableError(f"Expected a column {time} of times, found {listed(names)}")
        return places[0]
    if places := [i for i, name in enumerate(names) if is_time_column(name)]:
        return max(places, key=lambda i: _rising_share(head.iloc[:, i]))  # a date beside the time of day does not
    return next((i for i in range(len(names)) if _is_clock(head.iloc[:, i], names[i])), None)


def rising(frame: pd.DataFrame) -> list[int]:
    """Where columns rise steadily: each may be the clock, or how far the tool has gone."""
    head = frame.iloc[:TELLING]
    return [i for i in range(frame.shape[1]) if is_rising(floats(head.iloc[:, i])[0])]


def _rising_share(cells: pd.Series) -> float:
    """The share of a column's steps that rise."""
    times, odd = floats(cells)
    steps = np.diff(_stamps(cells)[0] if 2 * len(odd) >= len(cells) else times)
    return float((steps > 0).mean()) if len(steps) else 0.0


def is_rising(times: NDArray[np.float64]) -> bool:
    """Whether numbers rise steadily, from each to the next by about as much."""
    steps = np.diff(times)
    if len(steps) < 2 or not (steps > 0).all():
        return False
    middle = float(np.median(steps))
    return bool((np.abs(steps - middle) <= middle / 2).mean() >= STEADY)


def _is_clock(cells: pd.Series, name: str) -> bool:
    """Whether a column is a clock by its values: times as text, times since 1970, or an unnamed column that rises
    steadily by other steps than 1.
    """
    times, odd = floats(cells)
    if len(cells) < 3:
        return False
    if 2 * len(odd) >= len(cells):
        return bool(STAMP.fullmatch(str(cells.iloc[0]).strip())) and _rising_share(cells) == 1.0
    if not is_rising(times):
        return False
    counted = bool((np.diff(times) == 1).all())
    unnamed = name == "" or name == "index" or re.fullmatch(r"Unnamed: \d+", name) is not None
    return (unnamed and not counted) or _unix_time_unit(times) is not None


def _unix_time_unit(times: NDArray[np.float64]) -> float | None:
    """The seconds of one, where numbers are times since 1970."""
    for least, unit in EPOCHS:
        if least <= np.abs(times[0]) and np.abs(times[0]) * unit < LATEST:
            return unit
    return None


def clock_of(frame: pd.DataFrame, time: str | None = None, units_row: Sequence[str] = ()) -> Clock | None:
    """The clock of a table's rows; None where none is known.

    time : its column, where it was stated.  units_row : the units of all columns, where a row says them.
    UnreadableError where a cell of it tells no time.
    """
    place = place_of_clock(frame, time)
    if place is None or len(frame) < 2:
        return None
    column = frame.iloc[:, place]
    name = str(frame.columns[place])
    seconds = _parts_of_seconds(frame, name)
    odd = list[int]()
    said = ""
    if seconds is None:
        seconds, odd, said = seconds_of(column, name, units_row[place] if units_row else "")
    if odd:
        wanted = "in seconds or as 2026-03-01T12:00:00.002"
        got = excerpt(str(column[odd[0]]))
        what = f"Expected a time in column {name}, {wanted}, got {got}; a stated rate (rate_hz) needs none"
        raise UnreadableError(what, odd[0])
    if time is None and not is_time_column(name):
        known = f"Column {name or place + 1} is taken as the clock by its values"
        said = f"{known}; {said}" if said else known
    return Clock(name, seconds, said)


def _parts_of_seconds(frame: pd.DataFrame, name: str) -> NDArray[np.float64] | None:
    """Of the two columns of a ROS stamp, `stamp.secs` and `stamp.nsecs`, the time that they are together."""
    match = re.fullmatch(r"(.*?)(n?(?:ano)?)(secs?)", name)
    if match is None:
        return None
    known = {str(column): i for i, column in enumerate(frame.columns)}
    whole = next((known[n] for n in (f"{match[1]}secs", f"{match[1]}sec") if n in known), None)
    part = next(
        (known[n] for n in (f"{match[1]}{k}" for k in ("nsecs", "nsec", "nanosec", "nanosecs")) if n in known), None
    )
    if whole is None or part is None:
        return None
    seconds, odd = floats(frame.iloc[:, whole])
    nanos, wrong = floats(frame.iloc[:, part])
    return None if odd or wrong else (seconds - seconds[0]) + (nanos - nanos[0]) * 1e-9


def seconds_of(column: pd.Series, name: str, unit: str = "") -> tuple[NDArray[np.float64], list[int], str]:
    """(n,) seconds since the first of a column's times; which cells tell none; and what was taken for granted."""
    import pandas as pd

    if not pd.api.types.is_datetime64_any_dtype(column):
        times, odd = floats(column)
        if 2 * len(odd) < max(len(times), 1):
            scale, said = _scale(times, name, unit)
            known = np.flatnonzero(~np.isnan(times))
            start = times[known[0]] if len(known) else 0.0
            return (times - start) * scale, odd, said
    seconds, missing = _stamps(column)
    return seconds, column.index[missing].tolist(), ""


def _stamps(column: pd.Series) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(n,) seconds since the first of times as text: ISO 8601, days as 02.03.2026 or 3/2/2026, or times of day."""
    import pandas as pd

    if pd.api.types.is_datetime64_any_dtype(column):
        stamps = pd.to_datetime(column, utc=True)
    elif pd.api.types.is_timedelta64_dtype(column):
        stamps = column
    else:
        text = column.astype(str).str.strip().str.upper().str.replace(",", ".").str.replace("−", "-")
        text = text.str.replace(r"\s*UTC$", "Z", regex=True).str.replace(r"\s+", " ", regex=True)
        if text.str.fullmatch(OF_DAY).mean() > 0.5:
            text = text.where(text.str.count(":") > 1, "00:" + text)
            stamps = pd.to_timedelta(text, errors="coerce")
        else:
            text = text.str.replace(DAY_FIRST, lambda m: f"{m[3]}-{m[2]:0>2}-{m[1]:0>2}", regex=True)
            parts = text.str.extract(SLASHED_DAY).astype(float)
            first, second = (1, 2) if (parts[0] > 12).any() else (2, 1)  # the day, in Europe; the month, in America
            text = text.str.replace(SLASHED_DAY, lambda m: f"{m[3]}-{m[second]:0>2}-{m[first]:0>2}", regex=True)
            text = text.str.replace(r" (\d):", r" 0\1:", regex=True)
            form = "mixed" if text.str.contains(r"\b[AP]M$").any() else "ISO8601"
            stamps = pd.to_datetime(text, errors="coerce", format=form, utc=True)
    missing = stamps.isna().to_numpy()
    first_known = stamps[~missing]
    start = first_known.iloc[0] if len(first_known) else None
    if start is None:
        return np.full(len(column), np.nan), missing
    delta = stamps - start
    return delta.dt.total_seconds().to_numpy(dtype=np.float64), missing


def _scale(times: NDArray[np.float64], name: str, unit: str) -> tuple[float, str]:
    """Seconds in one of a clock: as its name or the row of units says, else so that its steps are a recorder's."""
    stated = _stated(name, unit)
    if stated is not None:
        return stated, ""
    known = times[~np.isnan(times)]
    if len(known) < 2:
        return 1.0, ""
    since_1970 = _unix_time_unit(known)
    if since_1970 is not None:
        return since_1970, ""
    step = float(np.median(np.abs(np.diff(known))))
    low, high = EXCEL_DAYS
    if low < known[0] < high and 0 < step * DAY < 1.0:
        return DAY, f"The clock {name} is read as days, as Excel counts them"
    scale = next((scale for scale in (1.0, 1e-3, 1e-6) if step * scale < SLOW), 1e-9)
    words = {1.0: "seconds", 1e-3: "milliseconds", 1e-6: "microseconds", 1e-9: "nanoseconds"}
    sure = scale == 1.0 and 0 < step < SLOW / 10
    said = f"The clock {name} names no unit and is read as {words[scale]}; rate_hz=... states another rate"
    return scale, "" if sure else said


def _stated(name: str, unit: str) -> float | None:
    """Seconds in one by a clock's unit: of the row of units, in brackets, or at the end of its name; None: it says none."""
    for text in (f"({unit.strip('[](){} ')})" if unit else "", name):
        match = STATED.search(text.strip().lower())
        known = None if match is None else SECONDS.get(match["unit"] or match["such"])
        if match is not None and known is not None:
            return known * float((match["n"] or "1").replace(",", "."))
    words = re.findall(r"[A-Z]?[a-zµμ]+|[A-Z]+", name)
    last = words[-1].lower() if words else ""
    return SECONDS.get(last) if last not in ("d", "h", "min", "days") else None


def rate_of(clock: Clock, lines: pd.Index) -> float:
    """Samples a second, to four digits, by a clock's usual step.

    UnreadableError where a time is missing, turns back or jumps, and where the rate or the duration cannot be believed.
    lines : of the file, one a time.
    """
    steps = np.diff(clock.seconds)
    backwards = np.flatnonzero(~(steps > 0))
    if len(backwards):
        what = "Expected a later time than that of the row before, or a stated rate (rate_hz)"
        raise UnreadableError(what, lines[int(backwards[0]) + 1])
    step = float(np.median(steps))
    gaps = np.flatnonzero(steps > GAP * step)
    if len(gaps):
        what = f"Expected a step of {step:.3g} s in time, got a gap of {steps[gaps[0]]:.3g} s"
        raise UnreadableError(what, lines[int(gaps[0]) + 1])
    usual = float(steps[steps <= LATE * step].mean())  # a clock of whole milliseconds steps 4, 4, 5
    rate = 1.0 / (step if abs(usual - step) < 0.005 * step else usual)
    span = float(clock.seconds[-1])
    if not (RATES[0] <= rate <= RATES[1] and SPANS[0] <= span <= SPANS[1]):
        wanted = f"{RATES[0]:g} Hz to {RATES[1] / 1e6:g} MHz over {1e3 * SPANS[0]:g} ms to {SPANS[1] / 3600:g} h"
        got = f"{rate:.4g} Hz over {span:.3g} s"
        do = "state the rate, rate_hz=..., or write its unit into the header, as in time [ms]"
        raise UnreadableError(f"Expected a clock of {wanted}, column {clock.name} tells {got}; {do}")
    return float(f"{rate:.4g}")


def evenly(values: NDArray[np.float32], clock: Clock) -> NDArray[np.float32]:
    """(C, T) values put on even times from the first to the last of a clock; as they are where it is even already."""
    times = clock.seconds
    even = np.linspace(times[0], times[-1], len(times))
    if np.abs(times - even).max() < UNEVEN * (even[1] - even[0]):
        return values
    return np.stack([np.interp(even, times, row) for row in values]).astype(np.float32)
