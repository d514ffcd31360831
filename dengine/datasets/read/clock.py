"""The times of samples, exactly as `[time]` says, and the check that none is missing."""

import re
from zoneinfo import ZoneInfo

import numpy as np

from ...errors import DataError, instead
from ..description import Clock, TextForm
from ..table import Floats, Recording, Table, UnreadableError

UNITS = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
UNITS |= {"min": 60.0, "h": 3600.0, "d": 86400.0}
ISO = "iso"
DAY = UNITS["d"]
RATE_TOLERANCE = 0.03  # by which the rate of a recording's own times may differ from the stated one
DATES = re.compile(r"%[dDjeyYxcmbB]")
WHOLE = re.compile(r"-?\d{1,18}", re.ASCII)
Times = tuple[Floats, float]  # the seconds of each row since the first, and the time of the first


def is_dated(unit: str) -> bool:
    """Return whether the cells of a clock's column are dates or times of day, not numbers."""
    return unit == ISO or "%" in unit


def has_day(unit: str) -> bool:
    """Return whether the cells of a clock's column tell the day."""
    return unit == ISO or DATES.search(unit) is not None


def scale_of(unit: str) -> float:
    """Return the seconds of a unit of time, `ms` or `0.001 ms`; DataError for another text."""
    match = re.fullmatch(r"(\d*\.?\d*)\s*([^\d.]+)", unit.strip())
    if not match or match[2].strip() not in UNITS:
        wanted = f"a unit of time of {', '.join(UNITS)}, {ISO}, or a form like %d.%m.%Y"
        raise DataError(f"Expected time.format to be {wanted}, got {unit!r}.")
    return float(match[1].strip(".") or 1) * UNITS[match[2].strip()]


def times_of(table: Table, clock: Clock, form: TextForm) -> Times:
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
    seconds: Floats = np.zeros(1)
    start = 0.0
    for name, unit in zip(clock.column, clock.format, strict=True):
        relative, first = column_times(table, name, unit, clock, form)
        if len({1, len(seconds), len(relative)}) > 2:
            message = f"Expected {len(seconds)} times, got {len(relative)}"
            raise UnreadableError(message, column=name)
        seconds, start = seconds + relative, start + first
    return seconds, start


def column_times(table: Table, name: str, unit: str, clock: Clock, form: TextForm) -> Times:
    """Return the times of one column since its first, and the first, in seconds."""
    cells = table.column(name)
    if not len(cells):
        raise UnreadableError("Expected times, got none", column=name)
    if cells.dtype.kind == "M" or is_dated(unit):
        return _dates(table, name, unit, clock)
    scale = scale_of(unit)
    if cells.dtype.kind == "O":
        texts = [str(cell).strip() for cell in cells.tolist()]
        if all(map(WHOLE.fullmatch, texts)):
            cells = np.array([*map(int, texts)])
    if cells.dtype.kind in "iu":  # too long for a float, as nanoseconds since 1970 are
        cells = cells.astype(np.int64)
    else:
        cells = table.numbers(name, form)
        table.refuse(np.isnan(cells), "a time", name)
    values = (cells - cells[0]).astype(np.float64) * scale
    if clock.wrap:
        values = values + np.cumsum(np.diff(values, prepend=0.0) < 0) * clock.wrap * scale
    return values, float(cells[0]) * scale


def _dates(table: Table, name: str, unit: str, clock: Clock) -> Times:
    """Return the times of a column of dates, or times of day, which pass midnight without dates."""
    import pandas as pd

    texts = pd.Series(table.column(name))
    is_date = texts.dtype.kind == "M"
    if not is_date:
        texts = texts.astype(str).str.strip()
        if "%f" in unit:
            texts = texts.str.replace(",", ".", regex=False)
    has_date = is_date or has_day(unit)
    form = None if is_date else "ISO8601" if unit == ISO else unit
    with instead(UnreadableError, f"Expected times of the form {unit}", ValueError, AttributeError):
        times = pd.to_datetime(texts, format=form, errors="coerce")
        if times.dt.tz is None:
            zone = ZoneInfo(clock.zone) if clock.zone and has_date else "UTC"
            times = times.dt.tz_localize(zone, ambiguous="infer")
    table.refuse(times.isna().to_numpy(), f"a time of the form {unit}", name)
    zero = pd.Timestamp("1970-01-01" if has_date else "1900-01-01", tz="UTC")
    values = (times - times.iloc[0]).dt.total_seconds().to_numpy(np.float64)
    if not has_date and not any(map(has_day, clock.format)):
        values = values + DAY * np.cumsum(np.diff(values, prepend=0.0) < -DAY / 2)
    return values, (times.iloc[0] - zero).total_seconds()


def check_steps(recording: Recording, clock: Clock) -> None:
    """Raise UnreadableError unless the times rise without a gap, at the stated rate within 3 %.

    A rate of 0 stands for any that is even: steps are then compared with their mean.
    """
    seconds = recording.seconds
    if seconds is None or len(seconds) < 2:
        return
    steps = np.diff(seconds)
    span = float(seconds[-1] - seconds[0])
    usual = 1 / clock.rate_hz if clock.rate_hz else span / len(steps)
    column = " + ".join(clock.column)
    for is_bad, wanted in (
        (steps < 0 if clock.gap == 0 and span > 0 else steps <= 0, "a later time than before"),
        ((steps > clock.gap * usual) & (clock.gap > 0), f"at most time.gap steps of {usual:.6g} s"),
    ):
        if is_bad.any():
            row = int(is_bad.argmax())
            line = int(recording.lines[row + 1]) if len(recording.lines) else 0
            message = f"Expected {wanted}, got {steps[row]:.6g} s before row {row + 2}"
            raise UnreadableError(message, line, column)
    rate = len(steps) / span
    if clock.rate_hz and abs(rate - clock.rate_hz) > RATE_TOLERANCE * clock.rate_hz:
        message = (
            f"Expected {clock.rate_hz:g} Hz as time.rate_hz says, its times give {rate:.5g} Hz"
        )
        raise UnreadableError(message, column=column)
