"""The times of samples, exactly as `[time]` says, and the check that none is missing."""

import re

import numpy as np

from ...errors import DataError, instead
from ...records import Floats
from ..description import Clock, TextForm
from ..table import Table, UnreadableError
from ..units import TIME_UNITS, bare

ISO = "iso"
DAY = TIME_UNITS["d"]
RATE_TOLERANCE = 0.03  # by which the rate of a recording's own times may differ from the stated one


def is_dated(unit: str) -> bool:
    """Return whether a clock's column has dates or times of day, not numbers.

    `unit` is its format in `[time]`: `iso` or a form with percent signs.
    """
    return unit == ISO or "%" in unit


def has_day(unit: str) -> bool:
    """Return whether the cells of a clock's column tell at least a day, a month or a year.

    `unit` is its format in `[time]`: `iso`, or a form with a sign like `%d` or `%Y`.
    """
    return unit == ISO or re.search("%[dDjeyYxcmbB]", unit) is not None


def scale_of(unit: str) -> float:
    """Return how many seconds a unit of time has: 0.001 for `ms`, 1e-6 for `0.001 ms`.

    The units are s, sec, ms, us, µs, ns, min, h and d; a decimal number may stand before a unit.
    Raises DataError for any other text.
    """
    match = re.fullmatch(r"(\d+\.?\d*|\.\d+)?\s*([^\d.]+)", unit.strip())
    if not match or match[2] not in TIME_UNITS:
        raise DataError(
            f"Expected time.format to be a unit of time of {', '.join(TIME_UNITS)}, {ISO}, or a "
            f"form like %d.%m.%Y, got {unit!r}."
        )
    return float(match[1] or 1) * TIME_UNITS[match[2]]


def times_of(table: Table, clock: Clock, form: TextForm) -> Floats:
    """Return the time of each row in seconds from the zero of the clock: the sum over its columns.

    The zero is 1970 (UTC) for dates, and midnight for times of day. A float64 rounds a date to 0.24
    microseconds.

    If times of day fall from one row to the next by more than half a day, midnight has passed,
    unless one of the clock's formats has the date. If a counter falls by more than half of
    `clock.wrap`, the value at which it begins again, it began again at 0; with a `wrap` of 0 times
    may fall.

    Parameters
    ----------
    table : Table
        The rows of a recording.
    clock : Clock
        The section `[time]` of the description of the files, with as many formats as columns and a
        known time zone (`check_forms`). A format is a unit, `iso` (ISO 8601) or a pattern like
        `%H:%M:%S`. The times in the columns are added up; a column of one cell holds for all rows.
        A column of datetimes is read as `iso`, whatever its format; whether times of day in another
        column have a date beside them is told by the stated formats alone. Dates without a time
        zone are in `zone`, or UTC if that is "". Without columns and formats there is one time, 0.
    form : TextForm
        The section `[text]`: how numbers are written.

    Returns
    -------
    seconds : array of float64, shape (rows,)
        Shape (1,) if there is no column, or if each has but one cell.

    Raises
    ------
    UnreadableError
        If a column is missing, empty or of another length, or a cell is no time of the stated form
        (a missing number, too), or is a time that exists twice or not at all when clocks are
        changed, or if the cells of a column have several offsets from UTC.
    DataError
        If a format is no unit of time.
    """
    seconds: Floats = np.zeros(1)
    for name, unit in zip(clock.column, clock.format, strict=True):
        cells = table.column(name)
        if not len(cells):
            raise UnreadableError("Expected times, got none", column=name)
        unit = ISO if cells.dtype.kind == "M" else unit
        if is_dated(unit):
            values = _dates(table, name, unit, clock)
            period = 0.0 if any(map(has_day, (unit, *clock.format))) else DAY
        else:
            own = bare(table.units.get(name, ""))  # in the file's row of units
            scale = scale_of(own if own in TIME_UNITS else unit)
            values = table.numbers(name, form) * scale
            table.refuse(np.isnan(values), "a time", name)
            period = clock.wrap * scale
        if len({1, len(seconds), len(values)}) > 2:
            raise UnreadableError(f"Expected {len(seconds)} times, got {len(values)}", column=name)
        begins_again = np.diff(values, prepend=values[0]) < -period / 2
        seconds = seconds + (values + np.cumsum(begins_again) * period)
    return seconds


def _dates(table: Table, name: str, unit: str, clock: Clock) -> Floats:
    """Return the times in a column of dates or times of day.

    They are in seconds since 1970 (UTC), or since midnight if the cells have no date. `unit` is the
    form of the cells, "iso" or like "%d.%m.%Y"; a comma is read as a point, and the fraction of a
    second may lack. Dates without a time zone are in `clock.zone`, or UTC if that is empty; times
    in the hour that comes twice when clocks are set back need rows from both, in order. Raises
    UnreadableError if there is no column `name`, if one of its cells does not have the form, or is
    a time that exists twice or not at all when clocks are changed, or if the cells have several
    offsets from UTC.
    """
    import pandas as pd

    texts = pd.Series(table.column(name)).astype(str).str.strip().str.replace(",", ".")
    form = "ISO8601" if unit == ISO else unit.replace(",", ".")
    with instead(
        UnreadableError, f"Expected times of the form {unit}", ValueError, AttributeError, re.error
    ):
        times = pd.to_datetime(texts, format=form, errors="coerce")
        if times.isna().any():  # the fraction may lack in whole seconds
            whole = form.replace(".%f", "")
            times = times.fillna(pd.to_datetime(texts, format=whole, errors="coerce"))
        if times.dt.tz is None:
            times = times.dt.tz_localize((has_day(unit) and clock.zone) or "UTC", ambiguous="infer")
    table.refuse(times.isna().to_numpy(), f"a time of the form {unit}", name)
    zero = pd.Timestamp("1970-01-01" if has_day(unit) else "1900-01-01", tz="UTC")
    return np.asarray((times - zero).dt.total_seconds())


def check_steps(seconds: Floats, clock: Clock, table: Table) -> None:
    """Raise UnreadableError unless the times rise without a gap, at the stated rate within 3 %.

    `seconds`, shape (rows,), has the times of the rows of `table`, at least one. No step from one
    to the next may be longer than `clock.gap` steps of the stated rate, `clock.rate_hz`, or
    `clock.gap` mean steps if none is stated. With `clock.gap` 0 steps may have any length, and up
    to half of them may be 0. With another `clock.gap` equal times are refused. The number of steps
    may differ by at most 3 % from the rate times the time from first to last; without a rate any
    will do. A single time passes.
    """
    steps = np.diff(seconds)
    rate = clock.rate_hz
    column = " + ".join(clock.column)
    n = len(steps)
    span = seconds[-1] - seconds[0]
    most = clock.gap / rate if rate else clock.gap * span / max(n, 1)
    is_bad = steps <= 0 if clock.gap or 2 * (steps > 0).sum() < n else steps < 0
    is_bad |= steps > (most or np.inf)
    if is_bad.any():
        row = int(is_bad.argmax()) + 1
        raise UnreadableError(
            f"Expected a later time, by at most time.gap steps, which are {most:.6g} s, got "
            f"{steps[row - 1]:.4g} s before row {row + 1}",
            table.line(row),
            column,
        )
    if abs(rate * span - n) > RATE_TOLERANCE * rate * span and rate:
        raise UnreadableError(
            f"Expected {rate:g} Hz as time.rate_hz says, its times give {n / span:.5g} Hz",
            column=column,
        )
