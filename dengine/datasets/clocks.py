"""The clock of a recording: which column it is, its times in seconds, and the sampling rate.

A column is the clock by its name (`traces.is_time_column`), or by its values: times of day, or
counts since an epoch. Any other column that rises steadily may be a clock or a path; users are told
of it, and name it themselves. Text files, tables and DataFrames all ask `clock_of` and `rate_of`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import excerpt, listed
from ..traces import is_time_column
from . import units
from .dataset import UnreadableError

if TYPE_CHECKING:
    import pandas as pd

EMPTY_CELLS = ("", "nan", "na", "n/a", "null", "none", "-nan", "<na>")  # become NaN
MILLISECONDS = ("ms", "msec", "millitm", "millisecond", "milliseconds")
NO_CLOCK = "none"  # what the user states as the clock of recordings whose times are wrong
MAX_GAP = 5.0  # median steps: a longer pause is no late message
EVEN_TOLERANCE = 0.1  # steps: times that are less off even ones are read as even
WRONG_RATE = 1.2  # times longer or shorter than by the clock: then the stated rate is wrong
MAX_LOST = 4  # samples on end that are interpolated: a longer gap may hold the peak
MAX_MISSING = 0.03  # of the rows of a recording whose samples are taken as even
LONG_STEP = 3.0  # median steps: a message of a regular clock comes less late
MIN_LONG = 3  # such steps at least, where values are stored on a change
LATE_STEP = 1.5  # median steps: up to here a step is a usual one
SLOWEST_STEP = 0.5  # seconds: a clock without a unit whose steps are longer counts milliseconds
RATES = (1.0, 1e6)  # hertz that are plausible
SPANS = (1e-3, 3600.0)  # plausible durations of a recording, in seconds
DAY = units.SECONDS["d"]
HOUR = units.SECONDS["h"]
HALF_DAY = 12  # hours
WINCC_DAYS = 1e-6  # days in a count of WinCC's Time_ms
EXCEL_DAYS = (2e4, 8e4)  # since 1900: the years 1954 to 2119
# Counts since an epoch: the seconds in one, and the seconds from the epoch to 1970. Those of 100 ns
# are Windows' FILETIME, since 1601, and .NET's ticks, since year 1.
EPOCHS = (
    *((1.0, 0.0), (1e-3, 0.0), (1e-6, 0.0), (1e-9, 0.0)),
    *((1e-7, 11_644_473_600.0), (1e-7, 62_135_596_800.0)),
)
# What the sampling rate is called above a header, as a column, or as an array of an archive: the
# words of the name in lower case. Some are rates of samples only in hertz, or of something else.
RATE_NAME = re.compile(
    r"fs|f_s|f_?(sample|sampling|abtast)|samples_(per_)?s(ec|econd)?"
    r"|(.*_)?(samples?|sampling|abtast|mess|acq|acquisition|daq|erfassungs|aufzeichnungs)_?"
    r"(rate|freq|frequency|frequenz)"
    r"|(.*_)?(rate|freq|frequency|fréquence|frequence|frecuencia|frequenza)_(d|de|di|of)_"
    r"(samples?|sampling|[ée]chantillonnage|muestreo|campionamento)"
)
IN_HERTZ = re.compile(
    r"(.*_)?(samples?|sampling|abtast|(scan|log|logging|record|recording)_?rate)|(data_?)?rate|sr"
)
UNSURE_RATE = re.compile(r"(data_?)?rate|sr|frequency|frequenz|freq")
# What the time from sample to sample is called, without blanks and marks.
STEP_NAMES = (
    *("dt", "deltat", "timestep", "timestampstep", "sampletime", "sampleinterval", "sampleperiod"),
    *(
        "deltax",
        "samplinginterval",
        "samplingtime",
        "samplingperiod",
        "abtastzeit",
        "abtastintervall",
        "sample",
        "sampling",
        "samplestep",
    ),
)
# A line above a header that states one of these: Sample rate: 500 Hz, dt [ms];2, # fs = 500
RATE_LINE = re.compile(
    r"[#%\s\"']*(?P<name>[^\W\d][^\d:;=,|\[(]*?)\s*([\[(](?P<bracketed>\w+)[\])])?[\"']?"
    r"\s*:?[:;=,\t|\s]\s*[\"']?(?P<number>\d+([.,]\d+)?(e[+-]?\d+)?)"
    r"([;,|\t]+\s*(?P=number))*[\s;,|\"'\[(]*(?P<unit>[a-zµμ]*)[\s;,|\"'\])]*",
    re.IGNORECASE,
)
HERTZ = {"hz": 1.0, "khz": 1e3, "mhz": 1e6}
COUNTER_BITS = (16, 32)  # of the counters that start anew when they are full
PLAUSIBLE_DATES = (946_684_800.0, 4_102_444_800.0)  # since 1970: the years 2000 to 2100
LEAST_DATE = 1e16  # a larger count since a start would be of months, even in nanoseconds
LARGEST_EXACT = 2.0**53  # float64 rounds larger whole numbers
HEAD = 200  # rows by which it is found whether a column rises
STEADY = 0.9  # of the steps of a steady column are within half of their median
STATED_UNIT = re.compile(
    r"[\[({</]\s*(?P<n>\d*[.,]?\d+)?\s*(?P<unit>[a-zµμ]+)\s*[\])}>]?\s*$|\bin (?P<such>[a-zµμ]+)$"
)
# The beginnings of the months' names in English, German, French, Italian and Spanish.
MONTHS = (
    *("jan gen ene", "feb fév fev", "mar mär mae mrz", "apr avr abr", "may mai mag"),
    *("jun juin giu", "jul juil lug", "aug aoû aou ago", "sep set", "oct okt ott"),
    *("nov", "dec dez dic déc"),
)
MONTH = f"(?:{'|'.join(' '.join(MONTHS).split())})[^\\W\\d_]{{0,6}}\\.?"
# Dates as 11.03.2024 or 11.03.24, 11-Mar-24 or 11. März 2024, and Mar 11, 2024.
DAY_FIRST = tuple(
    re.compile(form, re.IGNORECASE)
    for form in (
        r"^(?P<day>\d\d?)\.(?P<month>\d\d?)\.(?P<year>\d{4}|\d\d(?!\d))",
        rf"^(?P<day>\d\d?)[-./ ]+(?P<month>{MONTH})[-./, ]+(?P<year>\d{{4}}|\d\d(?!\d))",
        rf"^(?P<month>{MONTH}) (?P<day>\d\d?)[.,]? (?P<year>\d{{4}})",
    )
)
SLASHED_DATE = re.compile(r"^(\d\d?)/(\d\d?)/(\d{4})")
ANY_ORDER = "dates, day or month first"  # the form of a clock where nothing tells which it is
SUMMER_TIME = "where summer time ends"  # in the form of a clock that goes back an hour there
TIME_OF_DAY = re.compile(r"\d{1,2}:\d{2}(:\d{2})?(\.\d+)?")
WORD_DATE = (
    rf"\d\d?[-./ ]+(?i:{MONTH})[-./, ]+(?:\d\d){{1,2}}|(?i:{MONTH}) \d\d?[.,]? \d{{4}}"  # 11-Mar-24
)
DATE_FORM = rf"\d{{4}}-?\d\d-?\d\d|\d{{4}}/\d\d?/\d\d?|\d\d?[./]\d\d?[./]\d{{2,4}}|{WORD_DATE}"
TIME_FORM = r"\d{1,2}:?\d\d(:?\d\d([.,]\d+)?)?\s*(Z|UTC|AM|PM|[+\-−]\d\d(:?\d\d)?)?"
# Two columns of which one is the date of the other's time of day.
DATE = re.compile(
    r"(19|20)\d\d([-/.]?)[01]?\d\2[0-3]?\d|[0-3]?\d[./-][01]?\d[./-](19|20)?\d\d|" + WORD_DATE
)
DAY_TIME = re.compile(r"\d{1,2}:\d\d:\d\d(?P<fraction>[.,]\d+)?( ?[AaPp][Mm])?")
WHOLE_SECONDS = re.compile(rf"({DATE_FORM})[T ]\d{{1,2}}:\d\d:\d\d")
TIMESTAMP = re.compile(
    rf"({DATE_FORM})([T ]\s*{TIME_FORM})?|\d{{1,2}}:\d\d(:\d\d)?([.,]\d+)?", re.IGNORECASE
)


class Clock(NamedTuple):
    """The clock of a recording.

    name : str
        Its column.
    seconds : array of float64, shape (n,)
        Since the first row; NaN where a cell states no time.
    note : str
        What was assumed and users should know; "" where name and unit say it all.
    form : str
        Its unit or form in words, as "ms" or "dates".
    is_continued : bool
        Whether it counts from 0 again, and its times go on there.
    """

    name: str
    seconds: NDArray[np.float64]
    note: str
    form: str
    is_continued: bool = False


def floats(cells: pd.Series) -> tuple[NDArray[np.float64], list[int]]:
    """Return the numbers of a column, shape (n,), and the index label of each cell that is none.

    These and empty cells are NaN; empty cells are not listed.
    """
    import pandas as pd

    if pd.api.types.is_numeric_dtype(cells):
        return cells.to_numpy(dtype=np.float64, na_value=np.nan), []
    values = np.full(len(cells), np.nan)
    wrong = []
    for i, (index, cell) in enumerate(cells.items()):
        try:
            values[i] = float(cell)
        except (TypeError, ValueError, OverflowError):
            if str(cell).strip().lower() not in EMPTY_CELLS:
                wrong.append(index)
    return values, wrong


def join_date_and_time(frame: pd.DataFrame) -> str:
    """Join a column of dates and one of times of day, in place, in a table of texts.

    Both columns get date and time. A column of milliseconds from 0 to 999, as of `MILLISECONDS`, is
    added to times without a fraction, also to those that have their date in one cell, and gets the
    same. The columns stay as they are if the time passes midnight but the date stays, as that of
    the first row. Returns the name of the column of dates, "" if none is joined.
    """
    import pandas as pd

    if len(frame) < 2:
        return ""
    ends = frame.iloc[[0, -1]].astype(str)
    first, last = ends.to_numpy().astype(str)  # pandas would parse each expression for each column
    cells = list(enumerate(zip(first, last, strict=True)))
    dates = [i for i, pair in cells if all(re.fullmatch(DATE, cell) for cell in pair)]
    times = [i for i, pair in cells if all(re.fullmatch(DAY_TIME, cell) for cell in pair)]
    stamps = [i for i, pair in cells if all(WHOLE_SECONDS.fullmatch(cell) for cell in pair)]
    places = [*dates, *times]
    if len(dates) == len(times) == 1:
        date = frame.iloc[:, dates[0]]
        time = frame.iloc[:, times[0]]
        hours = pd.to_numeric(time.str.partition(":")[0], errors="coerce")
        if ((hours.diff() <= -HALF_DAY) & (date == date.shift())).any():
            return ""
        joined = date + " " + time
    elif len(stamps) == 1 and not places:
        places = stamps
        joined = frame.iloc[:, stamps[0]]
    else:
        return ""
    names = [str(name).lower() for name in frame.columns]
    milliseconds = [i for i, name in enumerate(names) if name in MILLISECONDS][:1]
    has_fraction = joined.iloc[[0, -1]].str.contains(r":\d\d[.,]").any()
    for place in () if has_fraction else milliseconds:
        fraction = frame.iloc[:, place].astype(str)
        if fraction.str.fullmatch(r"\d{1,3}").all():
            joined = joined + "." + fraction.str.zfill(3)
            places = [*places, place]
    for place in places:
        frame.isetitem(place, joined)
    return str(frame.columns[dates[0]]) if dates else ""


def place_of_clock(frame: pd.DataFrame, time: str | None = None) -> int | None:
    """Return the position of the time column; None if there is none.

    Of the columns that have a usual name and are not empty, it is the one whose values rise most
    often; without such a name, it is the first whose values are times.

    time : the name that the user stated, or "none" if the user stated that there is no time column.
    Raises UnreadableError if no column has that name.
    """
    names = [str(name) for name in frame.columns]
    if time == NO_CLOCK and time not in names:
        return None
    head = frame.iloc[:HEAD]
    if time is not None:
        places = units.find_columns(time, names)
        if not places:
            raise UnreadableError(f"Expected a column {time} of times, found {listed(names)}")
        return places[0]
    times = [i for i, name in enumerate(names) if is_time_column(name)]
    if places := [i for i in times if (frame.iloc[:, i].fillna("") != "").any()]:
        # Of a date and a time of day, only the latter rises.
        return max(places, key=lambda i: _rising_share(head.iloc[:, i]))
    return next((i for i in range(len(names)) if _is_clock(head.iloc[:, i], names[i])), None)


def rising_columns(frame: pd.DataFrame) -> list[int]:
    """Return the positions of columns that rise steadily, by their first 200 rows.

    Such a column may be a clock, or the tool's path.
    """
    head = frame.iloc[:HEAD]
    return [i for i in range(frame.shape[1]) if is_rising(floats(head.iloc[:, i])[0])]


def _rising_share(cells: pd.Series) -> float:
    """Return the share of a column's steps that rise, of numbers or times; 0 without steps."""
    times, wrong = floats(cells)
    steps = np.diff(_parse_timestamps(cells)[0] if 2 * len(wrong) >= len(cells) else times)
    return float((steps > 0).mean()) if len(steps) else 0.0


def is_rising(times: NDArray[np.float64]) -> bool:
    """Return whether numbers rise steadily.

    They do if every step is positive, and at least 90 % of the steps differ from the median step by
    at most half of it. False for fewer than three numbers.
    """
    steps = np.diff(times)
    if len(steps) < 2 or not (steps > 0).all():
        return False
    median = float(np.median(steps))
    return bool((np.abs(steps - median) <= median / 2).mean() >= STEADY)


def _is_clock(cells: pd.Series, name: str) -> bool:
    """Return whether a column is a clock by its values.

    It is if it holds times as text that rise, or rising times since an epoch, or if it has no name
    and rises steadily by steps other than 1. False for fewer than three rows.
    """
    times, wrong = floats(cells)
    if len(cells) < 3:
        return False
    if 2 * len(wrong) >= len(cells):
        is_time = TIMESTAMP.fullmatch(str(cells.iloc[0]).strip()) is not None
        return is_time and _rising_share(cells) == 1.0
    if not is_rising(times):
        return False
    is_counter = bool((np.diff(times) == 1).all())
    is_unnamed = name in ("", "index") or re.fullmatch(r"Unnamed: \d+", name) is not None
    return (is_unnamed and not is_counter) or _epoch_of(times) is not None


def _epoch_of(times: NDArray[np.float64]) -> tuple[float, float] | None:
    """Return the item of `EPOCHS` that numbers count by; None if they count since no epoch.

    They do if the first one then is a date from 2000 to 2100, which at most one epoch makes of a
    number.
    """
    earliest, latest = PLAUSIBLE_DATES
    for unit, before_1970 in EPOCHS:
        if earliest <= times[0] * unit - before_1970 < latest:
            return unit, before_1970
    return None


def _elapsed(column: pd.Series, times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the counts of a clock since its first, shape (n,); NaN where there is none.

    Counts that float64 would round are subtracted as they are written.

    times : the column as float64.
    """
    rows = np.flatnonzero(~np.isnan(times))
    if not len(rows):
        return times
    first = int(rows[0])
    if abs(times[first]) > LARGEST_EXACT and column.dtype.kind not in "fc":
        cells = column.to_numpy(dtype=object)
        elapsed = np.full(len(times), np.nan)
        try:
            start = Decimal(str(cells[first]))
            elapsed[rows] = [float(Decimal(str(cells[i])) - start) for i in rows]
            return elapsed
        except InvalidOperation:  # what Python's float reads and Decimal does not
            pass
    since_first: NDArray[np.float64] = times - times[first]
    return since_first


def clock_of(
    frame: pd.DataFrame, time: str | None = None, units_row: Sequence[str] = ()
) -> Clock | None:
    """Find the clock of a table whose rows are samples.

    Parameters
    ----------
    frame : DataFrame, n rows
    time : str, optional
        The clock's column, if the user stated it.
    units_row : sequence of str
        Unit of each column, if the file has a row of units.

    Returns
    -------
    Clock or None
        None if no clock is known, or there are fewer than two rows.

    Raises
    ------
    UnreadableError
        If a cell of the clock is no time (an empty one among numbers is NaN), the stated column is
        not there, or its counts can be of no unit.
    """
    place = place_of_clock(frame, time)
    if place is None or len(frame) < 2:
        return None
    column = frame.iloc[:, place]
    name = str(frame.columns[place])
    seconds = _join_seconds(frame, name)
    wrong = list[int]()
    note = ""
    form = "seconds and nanoseconds"
    if seconds is None:
        unit = units_row[place] if units_row else ""
        seconds, wrong, note, form = seconds_of(column, name, unit)
    if wrong:
        wanted = f"a time in column {name}, in seconds or as 2026-03-01T12:00:00.002"
        actual = excerpt(str(column[wrong[0]]))
        do = f"time={NO_CLOCK!r} and a stated rate (rate_hz) need none"
        if 2 * len(wrong) < len(frame):
            do = "leave such rows out of the file if they are no samples"
        raise UnreadableError(f"Expected {wanted}, got {actual}; {do}", wrong[0])
    if time is None and not is_time_column(name):
        form = f"{form}, column {place + 1} by its values"
    goes_back = bool((np.diff(floats(column)[0]) < 0).any())
    return Clock(name, seconds, note, form, goes_back and not (np.diff(seconds) < 0).any())


def _join_seconds(frame: pd.DataFrame, name: str) -> NDArray[np.float64] | None:
    """Return the seconds since the first row of a ROS stamp in two columns.

    Such are `stamp.secs` and `stamp.nsecs`. None if the column `name` is not one of two such
    columns, or a cell of them is no number.
    """
    import pandas as pd

    match = re.fullmatch(r"(.*?)(n?(?:ano)?)secs?", name)
    if match is None:
        return None
    columns = {str(name).removesuffix("s"): frame[name] for name in frame.columns}
    whole = columns.get(f"{match[1]}sec")
    part = columns.get(f"{match[1]}nsec", columns.get(f"{match[1]}nanosec"))
    if not (isinstance(whole, pd.Series) and isinstance(part, pd.Series)):
        return None
    seconds, wrong_seconds = floats(whole)
    nanoseconds, wrong_nanoseconds = floats(part)
    if wrong_seconds or wrong_nanoseconds:
        return None
    result: NDArray[np.float64] = (seconds - seconds[0]) + (nanoseconds - nanoseconds[0]) * 1e-9
    return result


def seconds_of(
    column: pd.Series, name: str, unit: str = ""
) -> tuple[NDArray[np.float64], list[int], str, str]:
    """Convert a column of times to seconds.

    Parameters
    ----------
    column : Series of n numbers, timestamps or texts
    name : str
        Name of the column, which may state a unit.
    unit : str
        Unit from a row of units; "" if there is none.

    Returns
    -------
    seconds : array of float64, shape (n,)
        Since the first known time; NaN where a cell states none.
    wrong : list of int
        Index of each cell that states no time, but not of empty ones among numbers.
    note : str
        What was assumed of the unit, for the user; "" for nothing.
    form : str
        As in `Clock`.

    Raises
    ------
    UnreadableError
        For counts without a unit that are too large for a duration and give no plausible date.
    """
    import pandas as pd

    if not pd.api.types.is_datetime64_any_dtype(column):
        times, wrong = floats(column)
        if 2 * len(wrong) < max(len(times), 1):
            scale, note = _seconds_per_count(times, name, unit)
            unit = next((u for u, s in units.SECONDS.items() if s == scale), f"{scale:g} s")
            return _continue_counter(_elapsed(column, times) * scale, scale), wrong, note, unit
    seconds, missing, fall = _parse_timestamps(column)
    form = "dates" if holds_dates(column) else "times of day"
    text = column.astype(str).str.strip()
    if text.str.match(SLASHED_DATE).all():
        order = _date_order(text)
        form = f"dates, {order} first" if order else ANY_ORDER
    if fall:
        form = f"{form}, an hour later from line {column.index[fall]} on, {SUMMER_TIME}"
    return seconds, column.index[missing].tolist(), "", form


def holds_dates(column: pd.Series) -> bool:
    """Return whether a column of times states dates, so that times of several parts compare.

    Of numbers the first known one tells it, of texts most of them.
    """
    import pandas as pd

    if pd.api.types.is_datetime64_any_dtype(column):
        return True
    times, wrong = floats(column)
    if 2 * len(wrong) < max(len(times), 1):
        times = times[~np.isnan(times)]
        return bool(len(times)) and _epoch_of(times) is not None
    text = column.astype(str).str.strip()
    return bool(text.str.match(DATE_FORM).mean() > 0.5)


def start_of(column: pd.Series) -> float | None:
    """Return the first time of a clock that holds dates, in seconds since 1970; None for others.

    None also for 3/2/2026, in which the month may be the first or the second number. A first text
    that is no time gives NaN.
    """
    import pandas as pd

    if not len(column) or not holds_dates(column):
        return None
    times, wrong = floats(column)
    if pd.api.types.is_datetime64_any_dtype(column) or 2 * len(wrong) >= len(times):
        text = str(column.iloc[0]).strip()
        if SLASHED_DATE.match(text):
            return None
        seconds, *_ = _parse_timestamps(pd.Series(["1970-01-01T00:00:00Z", text]))
        return float(seconds[1])
    epoch = _epoch_of(times)
    return None if epoch is None else float(times[0]) * epoch[0] - epoch[1]


def times_of(column: pd.Series) -> tuple[NDArray[np.float64], bool]:
    """Return the times that a column of texts or numbers states, in any order, and since when.

    Returns
    -------
    times : array of float64, shape (n,)
        In seconds; NaN where a cell states none. Those of dates without a zone are in UTC.
    since_1970 : bool
        Whether they count since 1970; else since a start that is not known. Times of day are NaN.

    Raises
    ------
    UnreadableError
        If dates as 3/2/2026 may have the day or the month first.
    """
    import pandas as pd

    times, wrong = floats(column.astype(str).str.replace(r"^(\d+),(\d+)$", r"\1.\2", regex=True))
    is_time = ~np.isnan(times)
    if 2 * len(wrong) < len(times) and is_time.any():
        epoch = _epoch_of(times[is_time])
        if epoch is not None:
            return times * epoch[0] - epoch[1], True
        return times * (_stated_unit(str(column.name), "") or 1.0), False
    text = column.astype(str).str.strip()
    if text.str.match(SLASHED_DATE).any() and not _date_order(text):
        wanted = f"dates in {column.name} that tell day and month, as 2026-03-01"
        raise UnreadableError(f"Expected {wanted}, got {text.iloc[0]}")
    if text.str.fullmatch(TIME_OF_DAY).mean() > 0.5:
        return np.full(len(text), np.nan), True
    seconds, *_ = _parse_timestamps(pd.concat([pd.Series(["1970-01-01T00:00:00Z"]), text]))
    return seconds[1:], True


def _parse_timestamps(
    column: pd.Series,
) -> tuple[NDArray[np.float64], NDArray[np.bool_], int]:
    """Return seconds since the first time of a column, shape (n,), and which cells are no time.

    The third value is the row from which on an hour is added, because summer time ends there; 0 for
    none. Times are ISO 8601, dates as 02.03.2026, 2-Mar-26 or 3/2/2026 with or without a time, or
    times of day. Of 3/2/2026 the first number is the month, unless `_date_order` says that it is
    the day.
    """
    import pandas as pd

    is_local = False
    if pd.api.types.is_datetime64_any_dtype(column):
        stamps = pd.to_datetime(column, utc=True)
        is_local = column.dt.tz is None
    elif pd.api.types.is_timedelta64_dtype(column):
        stamps = column
    else:
        text = column.astype(str).str.strip().str.upper()
        as_written = text
        text = text.str.replace(",", ".").str.replace("−", "-")
        text = text.str.replace(r"\s*UTC$", "Z", regex=True).str.replace(r"\s+", " ", regex=True)
        if text.str.fullmatch(TIME_OF_DAY).mean() > 0.5:
            text = text.where(text.str.count(":") > 1, "00:" + text)
            stamps = pd.to_timedelta(text, errors="coerce")
        else:
            for date_form in DAY_FIRST:
                text = text.str.replace(date_form, _iso_date, regex=True)
            day, month = (1, 2) if _date_order(as_written) == "day" else (2, 1)
            text = text.str.replace(
                SLASHED_DATE, lambda m: f"{m[3]}-{m[month]:0>2}-{m[day]:0>2}", regex=True
            )
            text = text.str.replace(r" (\d):", r" 0\1:", regex=True)
            is_local = not text.str.contains(r"[T ]\d.*[Z+\-]").any()
            form = "mixed" if text.str.contains(r"\b[AP]M$").any() else "ISO8601"
            stamps = pd.to_datetime(text, errors="coerce", format=form, utc=True)
    missing = stamps.isna().to_numpy()
    valid = stamps[~missing]
    if not len(valid):
        return np.full(len(column), np.nan), missing, 0
    elapsed = (stamps - valid.iloc[0]).dt.total_seconds().to_numpy(dtype=np.float64)
    if stamps.dtype.kind == "m":
        return _unwrap(elapsed, DAY), missing, 0
    fall = _end_of_summer_time(stamps) if is_local else 0
    is_later = np.arange(len(elapsed)) >= (fall or len(elapsed))
    return elapsed + HOUR * is_later, missing, fall


def _end_of_summer_time(stamps: pd.Series) -> int:
    """Return the row at which local times, which rise elsewhere, go back as summer time ends.

    They do within one hour of a Sunday's night in April, October or November. 0 for no such row.
    """
    falls = np.flatnonzero((stamps.diff() < np.timedelta64(0)).to_numpy())
    if len(falls) != 1:
        return 0
    before = stamps.iloc[falls[0] - 1]
    after = stamps.iloc[falls[0]]
    is_night = before.month in (4, 10, 11) and before.day_name() == "Sunday" and before.hour < 4
    return int(falls[0]) if is_night and before.floor("h") == after.floor("h") else 0


def _iso_date(match: re.Match[str]) -> str:
    """Return a date as 2024-03-11; a year of two digits is one since 2000."""
    word = match["month"].lower()
    months = {begin: n for n, begins in enumerate(MONTHS, start=1) for begin in begins.split()}
    month = next((n for begin, n in months.items() if word.startswith(begin)), word)
    century = "20" if len(match["year"]) == 2 else ""
    return f"{century}{match['year']}-{month:0>2}-{match['day']:0>2}"


def _date_order(text: pd.Series) -> str:
    """Return what comes first in dates as 3/2/2026, "day" or "month"; "" if nothing tells it.

    A number beyond 12 is a day. Of two readings that one is right in which the dates do not go
    back, or else that which spans fewer days. At last a decimal comma in the times tells the day.
    """
    parts = text.str.extract(SLASHED_DATE).astype(float)
    if (parts[[0, 1]] > 12).any(axis=None):
        return "month" if (parts[1] > 12).any() else "day"
    days = [372 * parts[2] + 31 * parts[month] + parts[1 - month] for month in (0, 1)]
    goes_back = [reading.diff().min() < 0 for reading in days]
    spans = [reading.max() - reading.min() for reading in days]
    for month_first, day_first in (goes_back, spans):
        if month_first != day_first:
            return "day" if month_first > day_first else "month"
    return "day" if text.str.contains(r":\d+,\d").any() else ""


def _continue_counter(seconds: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    """Return the times, shape (n,), of a clock that may count from 0 again within a recording.

    It does so after 2**16 or 2**32 counts, or a day; there the times go on. They are returned
    unchanged if they would still go back anywhere, as rows in any order do.

    scale : seconds in one count.
    """
    for period in (*(2.0**bits * scale for bits in COUNTER_BITS), DAY):
        unwrapped = _unwrap(seconds, period)
        if not (np.diff(unwrapped) < 0).any():
            return unwrapped
    return seconds


def _unwrap(seconds: NDArray[np.float64], period: float) -> NDArray[np.float64]:
    """Return times, shape (n,), with a period added from each row on at which the clock wraps.

    It wraps where a step is negative, but step + period lies between -1/2 and 5 median forward
    steps. No wrap is found at a NaN; the rows behind it keep the periods that were added before.
    """
    steps = np.diff(seconds, prepend=seconds[:1])
    forward = steps[steps > 0]
    usual = float(np.median(forward)) if len(forward) else 0.0
    ahead = steps + period
    is_anew = (steps < 0) & (ahead > -usual / 2) & (ahead <= MAX_GAP * usual)
    return seconds + period * np.cumsum(is_anew)


def _seconds_per_count(times: NDArray[np.float64], name: str, unit: str) -> tuple[float, str]:
    """Return the seconds in one count of a clock, and a note for the user if that was assumed.

    Its name or the row of units states them; else they follow from its values. Raises
    UnreadableError for counts that are too large for a duration and give no plausible date.
    """
    low, high = EXCEL_DAYS
    first = float(times[~np.isnan(times)][0]) if (~np.isnan(times)).any() else 0.0
    if name.lower() == "time_ms" and low < first * WINCC_DAYS < high:
        return DAY * WINCC_DAYS, f"The clock {name} is read as millionths of days, as WinCC counts"
    stated = _stated_unit(name, unit)
    if stated is not None:
        return stated, ""
    times = times[~np.isnan(times)]
    if len(times) < 2:
        return 1.0, ""
    epoch = _epoch_of(times)
    if epoch is not None:
        return epoch[0], ""
    if abs(times[0]) >= LEAST_DATE:
        wanted = f"dates from 2000 to 2100 in the clock {name}"
        epochs = "since 1970, as a FILETIME or as .NET ticks"
        do = "write its unit into the header, as in time [ns]"
        raise UnreadableError(f"Expected {wanted}, {times[0]:.4g} is none {epochs}; {do}")
    step = float(np.median(np.abs(np.diff(times))))
    if low < times[0] < high and 0 < step * DAY < 1.0:
        return DAY, f"The clock {name} is read as days, as Excel counts them"
    scale = next((scale for scale in (1.0, 1e-3, 1e-6) if step * scale < SLOWEST_STEP), 1e-9)
    if scale == 1.0 and 0 < step < SLOWEST_STEP / 10:
        return scale, ""
    words = {1.0: "seconds", 1e-3: "milliseconds", 1e-6: "microseconds", 1e-9: "nanoseconds"}
    assumed = f"The clock {name} names no unit and is read as {words[scale]}"
    return scale, f"{assumed}; rate_hz=... states another rate"


def _stated_unit(name: str, unit: str) -> float | None:
    """Return the seconds in one unit of a clock, as the row of units or its name states it.

    A number before the unit counts: 0.01 for [10 ms]. In a name the unit stands in brackets, behind
    a slash or at the end; None if there is none.
    """
    for text in (f"({unit.strip('[](){} ')})" if unit else "", name):
        match = STATED_UNIT.search(text.strip().lower())
        seconds = None if match is None else units.seconds_in(match["unit"] or match["such"])
        if match is not None and seconds is not None:
            return seconds * float((match["n"] or "1").replace(",", "."))
    words = re.findall(r"[A-Z]?[a-zµμ]+|[A-Z]+", name)
    last = words[-1].lower() if words else ""
    return units.seconds_in(last) if last not in ("d", "h", "min", "days") else None


def rate_of(clock: Clock, lines: pd.Index) -> float:
    """Return the sampling rate in hertz, to four digits, by a clock's usual step.

    That is the median step, or the mean of the steps that are not late, if these have two lengths,
    as those of a clock of whole milliseconds, or their mean differs from it by 0.5 % or more.

    Parameters
    ----------
    clock : Clock
    lines : Index
        Line in the file of each time, for errors.

    Raises
    ------
    UnreadableError
        If a time is missing, not later than the one before, or follows a gap; and if the rate or
        the duration is not plausible.
    """
    steps = np.diff(clock.seconds)
    backwards = np.flatnonzero(~(steps > 0))
    if len(backwards):
        wanted = "a later time than that of the row before, or a stated rate (rate_hz)"
        raise UnreadableError(f"Expected {wanted}", lines[int(backwards[0]) + 1])
    step = float(np.median(steps))
    gaps = np.flatnonzero(steps > MAX_GAP * step)
    if len(gaps):
        raise _gap_error(clock, step, steps[gaps[0]], lines[int(gaps[0]) + 1])
    # A clock of whole milliseconds steps 4, 4, 5: its mean step tells the rate.
    in_time = steps[steps <= LATE_STEP * step]
    mean = float(in_time.mean())
    is_rounded = len(np.unique(in_time.round(9))) == 2
    rate = 1.0 / (mean if is_rounded or abs(mean - step) >= 0.005 * step else step)
    span = float(clock.seconds[-1])
    if not (RATES[0] <= rate <= RATES[1] and SPANS[0] <= span <= SPANS[1]):
        rates = f"{RATES[0]:g} Hz to {RATES[1] / 1e6:g} MHz"
        wanted = f"{rates} over {1e3 * SPANS[0]:g} ms to {SPANS[1] / 3600:g} h"
        actual = f"{rate:.4g} Hz over {span:.3g} s"
        do = "state the rate, rate_hz=..., or write its unit into the header, as in time [ms]"
        message = f"Expected a clock of {wanted}, column {clock.name} tells {actual}; {do}"
        raise UnreadableError(message)
    return float(f"{rate:.4g}")


def stated_rate(name: str, number: float, unit: str = "") -> tuple[float, bool] | None:
    """Return the sampling rate in hertz that a name and a number state, and whether it is sure.

    The rate is 0.0 if it cannot be told, as for an unknown unit. None if the name is none of a rate
    or of a time between samples, or if that time is not above 0.

    The unit may end the name, as in dt_ms. A rate without a unit is in hertz. A time between
    samples without one may be in seconds if it is below 1, which is not sure; LabVIEW's delta_x
    surely is. A frequency is not sure, unless its unit ends the name.
    """
    words = "_".join(units.words_in(name)).replace("_k_hz", "_khz").replace("_m_hz", "_mhz")
    bare, _, last = words.rpartition("_")
    is_in_name = not unit and RATE_NAME.fullmatch(words) is None
    is_in_name = is_in_name and (last in HERTZ or units.seconds_in(last) is not None)
    if is_in_name:
        words, unit = bare, last
    unit = unit.lower()
    hertz = HERTZ.get(unit or "hz", 0.0)
    if RATE_NAME.fullmatch(words) or (unit in HERTZ and IN_HERTZ.fullmatch(words)):
        return number * hertz, True
    if UNSURE_RATE.fullmatch(words):
        return number * hertz, is_in_name and hertz > 0
    if words.replace("_", "") not in STEP_NAMES or number <= 0:
        return None
    if not unit and words != "delta_x":  # LabVIEW's is in seconds
        return (1.0 / number if number < 1 else 0.0), False
    second = units.seconds_in(unit or "s") or 0.0
    return (1.0 / (number * second) if second else 0.0), True


def is_rate_column(name: str) -> bool:
    """Return whether a column surely states a rate of samples, by its name; `fs` may be a force."""
    stated = stated_rate(name, 1.0)
    return stated is not None and stated[1] and "".join(units.words_in(name)) != "fs"


def rate_in_cell(name: str, cell: object) -> float | None:
    """Return the rate in hertz that a cell of a column states, as 500 of `Sample Rate (Hz)`."""
    return rate_in_preamble(f"{name.rpartition('.')[2]}: {cell}")[0]


def rate_of_scalar(name: str, value: NDArray[Any]) -> float | None:
    """Return the rate in hertz that an array of one number states by its name; None for none.

    A rate without a unit is in hertz, a time from sample to sample in seconds.
    """
    is_number = value.size == 1 and value.dtype.kind in "iuf"
    stated = stated_rate(name, float(value.reshape(()))) if is_number else None
    return stated[0] if stated and stated[0] > 0 else None


def rate_in_preamble(text: str) -> tuple[float | None, str]:
    """Return the sampling rate in hertz that a line of the text above a header states, and a note.

    The line is a name with a number, as `stated_rate` reads them: `fs = 500`, `dt [ms];2`. Lines
    whose rate is not from 1 Hz to 1 MHz are passed over. The rate is rounded to four digits; None
    if no line states one. Then the note offers a line that may state it, as `Rate: 5` or
    `Frequency: 500 Hz`; "" for none.
    """
    offer = ""
    for match in filter(None, map(RATE_LINE.fullmatch, text.splitlines())):
        number = float(match["number"].replace(",", "."))
        stated = stated_rate(match["name"], number, match["bracketed"] or match["unit"])
        rate, is_sure = stated or (0.0, True)
        if is_sure and RATES[0] <= rate <= RATES[1]:
            return float(f"{rate:.4g}"), ""
        if not is_sure:
            do = f"rate_hz={rate:.4g}" if rate else "state it, rate_hz=..."
            offer = f"A line says {match[0].strip()!r}: if that is of the samples, {do}"
    return None, offer


def check_rows(clock: Clock, lines: pd.Index, time: str | None = None) -> None:
    """Raise UnreadableError if rows are missing or out of order by their clock.

    The check is made also if the user states another rate. It allows a coarse clock, and rows that
    come late if the next ones come the sooner. Rows without a time are passed over, and a clock
    with fewer than two steps forwards is not checked.

    Parameters
    ----------
    clock : Clock
    lines : Index
        Line in the file of each time, for errors.
    time : str, optional
        The clock's column, if the user stated it; it changes only what the error advises.

    Raises
    ------
    UnreadableError
        If the clock goes back by more than five median forward steps. Also if a step is longer than
        five, and more than four steps are missing in the whole recording.
    """
    rows = np.flatnonzero(~np.isnan(clock.seconds))
    steps = np.diff(clock.seconds[rows])
    forward = steps[steps > 0]
    if len(forward) < 2:
        return
    usual = float(np.median(forward))
    backwards = np.flatnonzero(steps < -MAX_GAP * usual)
    if len(backwards):
        i = int(backwards[0])
        wanted = f"a later time in column {clock.name} than that of the row before"
        actual = f"{-steps[i]:.3g} s earlier"
        in_order = f"time={clock.name!r} puts rows in the order of their times, if all differ; "
        do = (
            f"{'' if time else in_order}"
            f"time={NO_CLOCK!r} with a stated rate (rate_hz) leaves them as they are; "
            "rows that are no samples, as zeros behind the last one, are to be deleted"
        )
        raise UnreadableError(f"Expected {wanted}, got {actual}; {do}", lines[rows[i + 1]])
    gaps = np.flatnonzero(steps > MAX_GAP * usual)
    # After a late row others come sooner, so that none are missing.
    missing = float(forward.sum()) - len(forward) * usual
    if len(gaps) and missing > (MAX_GAP - 1) * usual:
        raise _gap_error(clock, usual, steps[gaps[0]], lines[rows[gaps[0] + 1]])


def shows_lost_rows(clock: Clock) -> bool:
    """Return whether a clock would show it if rows were lost, or is too coarse.

    It is too coarse if half of its steps or more are 0; a step from or to an empty cell counts as
    one of 0. The clock has two rows or more.
    """
    return bool((np.abs(np.diff(clock.seconds)) > 0).mean() > 0.5)


def lost_rows_text(clock: Clock) -> str:
    """Return a text for the reading: would a clock show lost rows? They are not looked for here."""
    if shows_lost_rows(clock):
        return f"lost rows would be seen in column {clock.name}"
    return f"column {clock.name} is too coarse to show lost rows"


def same_time_text(values: NDArray[np.float32], clock: Clock, lines: pd.Index) -> str:
    """Return a text that names the first two lines of one time, with their values (C, T); else "".

    lines : line in the file of each time.
    """
    first_of = dict[float, int]()
    for i, time in enumerate(clock.seconds.tolist()):
        if first_of.setdefault(time, i) != i:
            pair = [first_of[time], i]
            cells = " and ".join(listed(f"{x:.6g}" for x in values[:, j]) for j in pair)
            return f"; lines {lines[pair[0]]} and {lines[i]} have the same time, and {cells}"
    return ""


def rate_contradiction(clock: Clock, rate_hz: float) -> str:
    """Return a note if the duration by a stated rate is not that by a clock, else "".

    It is not if one is more than 1.2 times the other, after the clock's span was allowed an error
    of one median step. A clock whose unit was assumed contradicts nothing.
    """
    steps = np.diff(clock.seconds[~np.isnan(clock.seconds)])
    forward = steps[steps > 0]
    if not len(forward) or clock.note:
        return ""
    span = float(forward.sum())
    resolution = float(np.median(forward))
    duration = len(clock.seconds) / rate_hz
    is_near = span - resolution <= WRONG_RATE * duration
    if is_near and duration <= WRONG_RATE * (span + resolution):
        return ""
    return f"Column {clock.name} contradicts the stated rate of {rate_hz:g} Hz: check it"


def _gap_error(clock: Clock, usual: float, gap: float, line: int) -> UnreadableError:
    """Return the error for a step of `gap` s in time before a line, where others are `usual` s.

    If the steps vary all along, it proposes a rate by the shortest tenth of them.
    """
    message = f"Expected a step of {usual:.3g} s in time, got a gap of {gap:.3g} s"
    if varies_all_along(clock):
        rate = float(f"{1.0 / np.quantile(np.diff(clock.seconds), 0.1):.2g}")
        do = f"fit='resample' with rate_hz={rate:g} puts them at even times"
        why = "steps vary all along, as of values stored when they change"
        message = f"{message}; {why}: {do}"
    return UnreadableError(message, line)


def varies_all_along(clock: Clock) -> bool:
    """Return whether the steps of a clock vary all along, as where values are stored when they
    change.

    They do if all are positive, at least three are longer than three median steps, and more than
    a tenth of the times that four steps take are off their median by more than half. So a regular
    clock with a hole, or whose messages come early and late, does not vary. False for a recording
    outside 1 ms to 1 h.
    """
    steps = np.diff(clock.seconds)
    is_plausible = bool((steps > 0).all()) and SPANS[0] <= steps.sum() <= SPANS[1]
    if not is_plausible or (steps > LONG_STEP * np.median(steps)).sum() < MIN_LONG:
        return False
    spans = clock.seconds[4:] - clock.seconds[:-4]
    usual = np.median(spans)
    return bool((np.abs(spans - usual) <= usual / 2).mean() < STEADY)


def in_order_of_time(
    rows: pd.DataFrame, clock: Clock, time: str | None
) -> tuple[NDArray[np.int64], Clock]:
    """Return the positions of rows in the order of their times, and the clock in that order.

    The order stays as it is if two times are equal or one is not known. It also stays if the clock
    goes far back, unless the user names it or it holds dates.

    time : the clock's column, if the user stated it.
    """
    order = np.argsort(clock.seconds, kind="stable")
    seconds = clock.seconds[order]
    place = list(map(str, rows.columns)).index(clock.name)
    steps = np.diff(clock.seconds)
    usual = np.median(steps[steps > 0]) if (steps > 0).any() else 0.0
    is_trusted = (
        time is not None
        or holds_dates(rows.iloc[:, place])
        or bool((steps > -MAX_GAP * usual).all())  # no counter that starts anew
    )
    if not is_trusted or not (np.diff(seconds) > 0).all():
        return np.arange(len(rows)), clock
    return order, clock._replace(seconds=seconds - seconds[0])


def check_even(clock: Clock, rate_hz: float) -> int:
    """Return how many rows are missing for one at each even time from the first time to the last.

    At most as many as its long steps skip, and 0 if there are more rows than that.

    Raises UnreadableError if the number of rows is more than 3 % and one row off: samples would
    stand at wrong times.

    clock : of n rows. rate_hz : by its usual step.
    """
    n = len(clock.seconds)
    n_even = round(float(clock.seconds[-1] - clock.seconds[0]) * rate_hz) + 1
    missing = n_even - n
    steps = np.diff(clock.seconds) * rate_hz
    n_skipped = int((np.rint(steps[steps > LATE_STEP]) - 1).sum())
    if abs(missing) > MAX_MISSING * n_even + 1:
        wanted = f"{n_even} rows at {rate_hz:g} Hz from the first time to the last"
        do = "fit='resample' puts all at even times by their own"
        raise UnreadableError(f"Expected {wanted}, got {n}; {do}")
    return max(min(missing, n_skipped), 0)


def resample_evenly(
    values: NDArray[np.float32], clock: Clock, rate_hz: float
) -> NDArray[np.float32]:
    """Interpolate samples (C, T) at even times between the first and the last of a clock, linearly.

    Returns the same array if the times are even already.
    """
    times = clock.seconds
    even = np.linspace(times[0], times[-1], len(times))
    if np.abs(times - even).max() < EVEN_TOLERANCE * (even[1] - even[0]):
        return values
    even = np.arange(round(float(times[-1] - times[0]) * rate_hz) + 1) / rate_hz + times[0]
    return np.stack([np.interp(even, times, row) for row in values]).astype(np.float32)
