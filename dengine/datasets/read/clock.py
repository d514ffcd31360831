"""The times of samples, exactly as `[time]` says, and the check that none is missing."""

import re
from collections.abc import Sequence
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError, shortened
from ..description import Clock, TextForm
from ..table import Recording, Table, UnreadableError

UNITS = {
    "s": 1.0,
    "sec": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    "µs": 1e-6,
    "ns": 1e-9,
    "min": 60.0,
    "h": 3600.0,
    "d": 86400.0,
}
ISO = "iso"
DAY = 86400.0
RATE_TOLERANCE = 0.03  # by which the rate of a recording's own times may differ from the stated one
DATES = re.compile(r"%[dDjeyYxcmbB]")


def scale_of(unit: str) -> float:
    """Return the seconds of a unit of time, `ms` or `0.001 ms`; DataError for another text."""
    match = re.fullmatch(r"([\d.]*)\s*(\D+)", unit.strip())
    if not match or match[2].strip() not in UNITS:
        wanted = f"a unit of time of {', '.join(UNITS)}, {ISO}, or a form like %d.%m.%Y"
        raise DataError(f"Expected time.format to be {wanted}, got {unit!r}.")
    return float(match[1] or 1) * UNITS[match[2].strip()]


def times_of(table: Table, clock: Clock, form: TextForm) -> tuple[NDArray[np.float64], float]:
    """Return the seconds of each row since the first, shape (rows,), and the time of the first.

    Parameters
    ----------
    table : Table
    clock : Clock
        Its columns are added up.
    form : TextForm
        How numbers are written.

    Raises
    ------
    UnreadableError
        For a cell that is no time of the stated form.
    """
    if len(clock.format) != len(clock.column):
        wanted = f"a format for each of {len(clock.column)} columns in [time]"
        raise DataError(f"Expected {wanted}, got {len(clock.format)}.")
    seconds = np.zeros(1)
    start = 0.0
    for name, unit in zip(clock.column, clock.format, strict=True):
        relative, first = column_times(table, name, unit, clock, form)
        if len(seconds) not in (1, len(relative)) and len(relative) != 1:
            message = f"Expected {len(seconds)} times, got {len(relative)}"
            raise UnreadableError(message, column=name)
        seconds = seconds + relative
        start += first
    return seconds, start


def column_times(
    table: Table, name: str, unit: str, clock: Clock, form: TextForm
) -> tuple[NDArray[np.float64], float]:
    """Return the times of one column since its first, and the first, in seconds."""
    cells = table.column(name)
    if cells.dtype.kind == "M" or unit == ISO or "%" in unit:
        return _dates(table, name, unit, clock)
    scale = scale_of(unit)
    if cells.dtype.kind == "O" and all(_is_whole(cell) for cell in cells.tolist()):
        cells = np.array([int(cell) for cell in cells.tolist()])
    if cells.dtype.kind in "iu":  # too long for a float, as nanoseconds since 1970 are
        values = (cells - cells[:1]).astype(np.float64) * scale
        first = float(cells[0]) * scale if len(cells) else 0.0
    else:
        values = table.numbers(name, form) * scale
        lost = np.flatnonzero(np.isnan(values))
        if len(lost):
            i = int(lost[0])
            raise UnreadableError("Expected a time, got none", table.line(i), name)
        first = float(values[0]) if len(values) else 0.0
        values = values - first
    if clock.wrap:
        turns = np.cumsum(np.diff(values, prepend=0.0) < 0)
        values = values + turns * clock.wrap * scale
    return values, first


def _is_whole(cell: object) -> bool:
    """Return whether a cell is a whole number of at most 18 digits."""
    text = cell.strip() if isinstance(cell, str) else ""
    return len(text) < 19 and text.isascii() and text.lstrip("-").isdigit()


def _dates(table: Table, name: str, unit: str, clock: Clock) -> tuple[NDArray[np.float64], float]:
    """Return the times of a column of dates or times of day.

    A time of day may pass midnight, unless another column tells the day.
    """
    import pandas as pd

    cells = table.column(name)
    form = "ISO8601" if unit == ISO else unit
    is_text = cells.dtype.kind != "M"
    texts = pd.Series(cells)
    if is_text:
        texts = texts.astype(str).str.strip()
        if "%f" in form:
            texts = texts.str.replace(",", ".", regex=False)
    has_date = not is_text or unit == ISO or DATES.search(form) is not None
    try:
        times = pd.to_datetime(texts, format=form if is_text else None, errors="coerce")
        is_aware = getattr(times.dtype, "tz", None) is not None
        if not is_aware and clock.zone and has_date:
            times = times.dt.tz_localize(ZoneInfo(clock.zone), ambiguous="infer")
        elif not is_aware:
            times = times.dt.tz_localize("UTC")
    except ZoneInfoNotFoundError as error:
        raise DataError(f"Expected a time zone in time.zone, got {clock.zone!r}.") from error
    except (ValueError, AttributeError) as error:
        why = " ".join(str(error).split())[:120]
        raise UnreadableError(f"Expected times of the form {unit}: {why}", column=name) from error
    bad = np.flatnonzero(times.isna().to_numpy())
    if len(bad):
        i = int(bad[0])
        message = f"Expected a time of the form {unit}, got {shortened(cells[i])}"
        raise UnreadableError(message, table.line(i), name)
    zero = pd.Timestamp("1970-01-01" if has_date else "1900-01-01", tz="UTC")
    values = ((times - times.iloc[0]) / pd.Timedelta(1, "s")).to_numpy(np.float64)
    if not any(form == ISO or DATES.search(form) for form in clock.format):
        values = values + DAY * np.cumsum(np.diff(values, prepend=0.0) < -DAY / 2)
    return values, float((times.iloc[0] - zero) / pd.Timedelta(1, "s"))


def check_steps(recording: Recording, clock: Clock) -> None:
    """Raise UnreadableError unless the times rise without a gap, at the stated rate within 3 %.

    A rate of 0 stands for any that is even: steps are then compared with their mean.
    """
    seconds = recording.seconds
    if seconds is None or len(seconds) < 2:
        return
    name = " + ".join(clock.column)
    steps = np.diff(seconds)
    usual = 1 / clock.rate_hz if clock.rate_hz else float(seconds[-1] - seconds[0]) / len(steps)
    back = np.flatnonzero(steps < 0 if clock.gap == 0 else steps <= 0)
    if len(back) or usual <= 0:
        i = int(back[0]) + 1 if len(back) else 1
        message = f"Expected a later time than before, got a step of {steps[i - 1]:.6g} s"
        raise UnreadableError(message, _line(recording.lines, i), name)
    if clock.gap and steps.max() > clock.gap * usual:
        i = int(np.argmax(steps > clock.gap * usual)) + 1
        message = f"Expected steps of {usual:.6g} s, got a gap of {steps[i - 1]:.6g} s"
        message += f" before row {i + 1}; see time.gap"
        raise UnreadableError(message, _line(recording.lines, i), name)
    rate = len(steps) / float(seconds[-1] - seconds[0])
    if clock.rate_hz and abs(rate - clock.rate_hz) > RATE_TOLERANCE * clock.rate_hz:
        message = (
            f"Expected {clock.rate_hz:g} Hz as time.rate_hz says, its times give {rate:.5g} Hz"
        )
        raise UnreadableError(message, column=name)


def _line(lines: Sequence[int], row: int) -> int:
    """Return the line of a row; 0 if it is not known."""
    return int(lines[row]) if row < len(lines) else 0
