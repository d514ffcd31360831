"""Which columns are the clock, in which form, and at which rate the samples follow each other."""

import math
import re
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from ...errors import listed
from ...records import Floats
from ..checks import check_forms
from ..dataset import LEAST_RATE_HZ, MOST_RATE_HZ, Faults
from ..description import ANY, UNKNOWN, TextForm, as_option
from ..read.clock import check_steps, has_day, scale_of, times_of
from ..read.files import caught
from ..table import Table
from ..units import TIME_UNITS, UNITS
from .columns import FORCES, Column, Proposal, Tables

CLOCK_NAME = re.compile(
    r"time|zeit|stamp|clock|temps|tiempo|tempo|hora|heure|millis|milli?tm|micros|elapsed|epoch"
    r"|(^|\.)(t|ms|us|ns|sec|secs|seconds|date|datum|uhr|x_value)$|^t[ _/\[(]|tick_?count"
    r"|^tm$|(^|[._ ])([mun]sec|tick|(\w+_)?ts)s?($|[._ ])"
    r"|((?<![a-z])[\[(]|[\[(][mun\u00b5])s(ec)?[\])]"
    r"|tijd|czas|时间|時間|時刻|시간",
    re.IGNORECASE,
)
COUNTER_NAME = re.compile(r"(?i)(index|row|sample|n|i|punkt|point|count|nr|no|line)s?")
UNIT_IN_NAME = re.compile(
    r"(?:[\[(_]|(?<![\d.])[/ ]|\.\.|\bin )\s*"  # behind a number it is arithmetic, like 1/10 ms
    r"((?:[\d.,]+ ?)?(?:s|ms|us|µs|ns|min|h|[mun]?sec))\s*[\])_.]?$"
)
# Names that are a unit. Whole seconds and nanoseconds may stand in two columns beside each other.
NAMED_UNIT = re.compile(
    r"(?i)(?P<ns>(?:^|[^a-z])n(?:ano)?_?se|nsecs?$)|(?P<ms>^milli|millis|^ms$|(?-i:[a-z]Ms$))"
    r"|(?P<us>micros)|(?P<s>(?:^|[^a-z])secs?(?:onds?)?$)"
)
# Counts since some day: their unit, and the seconds from that day to 1970.
# Spreadsheets count days since 1900, and WinCC a millionth of them.
EPOCHS = {"s": 0, "ms": 0, "us": 0, "ns": 0, "d": 2_209_161_600, "0.0864 s": 2_209_161_600}
GUESSES = ("s", "ms", "us", "ns", "min", "d", "0.1 us")  # of a unit that nothing states
YEARS = (946_684_800, 2_524_608_000)  # seconds since 1970 of the years 2000 to 2050
# Steps between these are taken for seconds: larger ones may be milliseconds of a rate up to 50 kHz,
# and smaller ones minutes.
SECONDS = (2e-4, 0.019)
EVEN = 0.01  # by which equal steps may differ, as a share of them
FEW = 0.1  # of the recordings that may have a gap, and of the steps that may fall
SHORT = 0.01  # of the recordings that may end before `traces.samples`, with `resample`
ANSWERS = (  # to a clock that the reader would refuse
    "state the longest time.gap (0: any; with traces.lengths=resample if the clock jitters), or "
    "time.wrap of a counter that begins again, another time.column, or none, [], and time.rate_hz"
)


def propose_clock(p: Proposal) -> None:
    """Find the column of times and its form, and set `time.column` and `time.format` in `p`.

    `p` is the description so far; only columns without a use in it are looked at. `time.column`
    becomes the only column that may tell the time (`is_clock`), by its cells or its name or, if no
    column has these, by its unit. It is set
    to `?` (the user must answer), with a note, if others may be it, too, or a part of it
    (`names_of_clocks`), or if only such others may; if there are none, it stays empty. Stated
    columns are kept; only their forms are found. Of a column that is set, `time.format`, its unit
    or a pattern like `%H:%M:%S`, may be `?` (`form_of`). Raises SettingError for a malformed
    `windows.trigger`, the condition at which long recordings are cut.
    """
    clocks = likely_clocks(p.unused)
    if "time.column" not in p.stated:
        names = names_of_clocks(p, clocks)
    else:
        names = []
        clocks = [p.columns[name] for name in p.description.time.column]
    if clocks and len(names) < 2:
        p.put("time.column", [column.name for column in clocks])
        forms = [form_of(column, p) for column in clocks]
        p.put("time.format", forms)
        if UNKNOWN in forms and len(forms) > 1:
            p.notes["time.format"] += (
                f"; state all, with a form for ?: {as_option('time.format', forms)}"
            )
    elif names:
        p.put(
            "time.column",
            UNKNOWN,
            f"of {listed(names)}: one, several that are added (a date, a time, ms), as in "
            f"{as_option('time.column', names[:2])}, or []: none; "
            "with time.sort=true if the rows of a part are not in the order of time",
        )


def likely_clocks(columns: Sequence[Column]) -> list[Column]:
    """Return the columns that may be a clock (`is_clock`) by cells or name or, if none is, by unit.

    Raises UnreadableError if cells are lists.
    """
    clocks = [*filter(is_clock, columns)]
    return [c for c in clocks if c.forms or CLOCK_NAME.search(c.name)] or clocks


def names_of_clocks(p: Proposal, clocks: Sequence[Column]) -> list[str]:
    """Return the names of the columns without a use that may be the clock, or a part of it.

    `clocks` are the columns that may tell the time (`is_clock`). The result has these and, unless
    their cells tell the day, those that may be a part of a clock (`is_coarse`). If no column may
    tell the time, it has all columns without a use if the files name none (`c0`, ...), or if one is
    named `s`, which may be seconds or the tool's position; otherwise those that may count the
    samples (`is_counter`). `p` is the description so far. Raises SettingError for a malformed
    `windows.trigger`, and UnreadableError if cells are lists.
    """
    if clocks:
        has_days = any(has_day(form) for column in clocks for form in column.forms)
        return [c.name for c in p.unused if c in clocks or (is_coarse(c) and not has_days)]
    names = [column.name for column in p.unused]
    if "c0" in p.description.text.names or "s" in names:  # no names; s may be the stroke
        return names
    return [column.name for column in filter(is_counter, p.unused)]


def is_coarse(column: Column) -> bool:
    """Return whether a column may be a part of a clock, like a date, or whole seconds.

    It has dates or times of day, or is named like a clock and has one word in each recording, but
    not the same in all. Raises UnreadableError if cells are lists.
    """
    return bool(column.forms or (CLOCK_NAME.search(column.name) and len({*column.fixed}) > 1))


def is_clock(column: Column) -> bool:
    """Return whether a column may hold the times of the samples.

    The result is True for dates and times of day that change within a recording. It is also True
    for a column that is named like a clock (`time`, `stamp`, `t`, ...), if not all its cells are
    numbers and they change within a recording. A column of numbers must rise; it needs a unit of
    time, or the name of a clock and no unit of another quantity, like N. Numbers that change count
    as rising if they fall in at most 10 % of the steps, like a counter that begins again, or in at
    least 90 %, if the newest row is the first. Raises UnreadableError if cells are lists.
    """
    is_named = CLOCK_NAME.search(column.name)
    if column.forms or (is_named and column.odd):
        return not column.fixed
    unit_fits = column.unit not in UNITS if is_named else column.unit in TIME_UNITS
    if not unit_fits or column.odd or not column.usual_step:
        return False
    falls = (column.steps < 0).mean()
    return bool(min(falls, 1 - falls) <= FEW)


def is_counter(column: Column) -> bool:
    """Return whether a column that is no clock by `is_clock` may tell the time all the same.

    A mere numbering of the rows does not. The steps from row to row (`Column.steps`) decide. For a
    column that is named like a clock the result is True if any step is not 0. For one that is named
    like a counter (`index`, `sample`, `n`, ...) it is True if any step differs by more than 1 %
    from the median step, or if the median is negative. For any other column it is True if no step
    differs so and the median is neither 0 nor 1; but it is False if the column is named like a
    force, has a unit of a quantity that is not time, or is named like `x*`, the samples of a table
    with a part in each row.
    """
    if CLOCK_NAME.search(column.name):
        return bool(column.usual_step)
    steps = column.steps
    usual = float(np.median(steps)) if len(steps) else 0.0
    is_even = are_even(steps, usual)
    if COUNTER_NAME.fullmatch(column.name):
        return usual < 0 or not is_even
    is_channel = column.unit in UNITS or any(name.search(column.name) for name in FORCES)
    return is_even and usual not in (0, 1) and not is_channel and ANY not in column.name


def are_even(steps: Floats, usual: float) -> bool:
    """Return whether no step differs from the usual one by more than 1 %; True without steps."""
    return np.allclose(steps, usual, rtol=EVEN, atol=0.0)


def epoch_of(column: Column) -> str:
    """Return the unit in which a column of times counts from a known day; "" if it does not.

    In this unit the first number is a time in the years 2000 to 2049, counted from 1970, or in days
    from 1900 as spreadsheets count, and the usual step (`Column.usual_step`) is that of a rate of
    1 Hz to 1 MHz. Of several such units the first in `EPOCHS`, which has those that are tried, is
    returned.
    """
    for unit, zero in EPOCHS.items():
        scale = scale_of(unit)
        if is_rate(column.usual_step * scale) and (
            YEARS[0] <= np.concatenate(column.numbers)[0] * scale - zero <= YEARS[1]
        ):
            return unit
    return ""


def form_of(column: Column, p: Proposal) -> str:
    """Return the unit or the form of a column of times; `?` if none is certain.

    A form is a pattern of dates or times of day, like `%d.%m.%Y`; it comes first, and it is `?` if
    several fit, so that day and month can be confused. If the cells are numbers, the first unit of
    time among these is returned: the unit that the file states for the column, the unit that dates
    of today prove (`epoch_of`), the unit in the name, like `ms` of `t [ms]`, `t_ms` or `millis`, or
    `0.1 ms` of `t in 0.1 ms`, and what the size of the steps proves (`_unit_by_size`). A note on
    `time.format` in `p`, the description so far, says why the result is `?`, or that only the size
    of the steps says s.
    """
    forms = column.forms
    if len(forms) > 1:
        p.notes["time.format"] = f"{listed(forms)}: the cells prove neither"
        return UNKNOWN
    if forms:
        return forms[0]
    units = [column.unit, epoch_of(column)]
    if match := UNIT_IN_NAME.search(column.name):
        units.append(match[1].replace(",", "."))
    elif match := NAMED_UNIT.search(column.name):
        units.append(str(match.lastgroup))
    for unit in units:
        unit = re.sub("sec$", "s", unit)
        if unit.lstrip("0123456789. ") in TIME_UNITS:
            return unit
    return _unit_by_size(column, p)


def _unit_by_size(column: Column, p: Proposal) -> str:
    """Return the unit of time that the steps in a column prove; `?`, with a note, if none.

    If the usual step (`Column.usual_step`) is 0.0002 to 0.019, the unit is s, and a note on
    `time.format` in `p`, the description so far, says so. Otherwise it is `?`, and the note lists
    units with the rates that they give. It is `?`, too, if the column has no numbers that change;
    the note then asks for the form of its cells.
    """
    step = column.usual_step
    if not step:
        p.notes["time.format"] = (
            f"no form of times that is known fits {listed([*column.odd][:3])}: state it, or "
            "time.column=[] and time.rate_hz, or text.drop"
        )
        return UNKNOWN
    if SECONDS[0] <= step <= SECONDS[1]:
        p.notes["time.format"] = f"seconds, for steps of {step:.6g}; the unit is not stated"
        return "s"
    rates = [f"{unit} ({1 / step / scale_of(unit):.6g} Hz)" for unit in GUESSES]
    p.notes["time.format"] = f"steps of {step:.6g}, the unit is not stated: {', '.join(rates)}"
    return UNKNOWN


def is_rate(step: float) -> bool:
    """Return whether a step in seconds is of a rate of 1 Hz to 1 MHz, both included."""
    return 1 / MOST_RATE_HZ <= step <= 1 / LEAST_RATE_HZ


def propose_rate(p: Proposal, tables: Tables) -> None:
    """Set `time.rate_hz` in `p`, from the median over the recordings of the mean step of time.

    `p` is the description so far; stated keys stay, and without a column of times nothing is set.
    `tables` has the samples of each recording. With `time.sort` the times of each are sorted first.
    Steps below 0 are left out of the mean, and the rate is rounded to five digits. It is `?` (the
    user must answer), with a note, if it is not between 1 Hz and 1 MHz, like that of times that
    only fall; then `time.gap`, the longest step that is allowed, is not looked at. Otherwise
    `check_steps` checks the times, by the rate and the gap that the description has by then. If it
    refuses more recordings than 10 % plus one, `time.gap` is set to `?`, with a note on the first.
    If recordings of another length are stated to be resampled (`traces.lengths`), `traces.samples`
    becomes the number of samples for which 99 % of the recordings last; longer ones lose their end
    when they are read. `order` may follow from the times, also if the rate is `?`
    (`_order_by_times`). Recordings whose times cannot be read are skipped. Raises DataError if a
    stated format is no form or unit of times, or if a setting in `[time]` is wrong (see
    `check_forms`).
    """
    clock = p.description.time
    check_forms(clock, TextForm())  # the marks in numbers may be ? by now
    if not clock.column:
        return
    clocks = list[tuple[Table, Floats]]()
    unread: Faults = []
    for table in tables:
        with caught(unread, table.source):
            seconds = times_of(table, clock, p.description.text)
            clocks.append((table, np.sort(seconds) if clock.sort else seconds))
    spans = [(seconds[0], seconds[-1]) for _, seconds in clocks]
    _order_by_times(p, spans)
    steps = [np.diff(seconds) for _, seconds in clocks]
    means = [s[s >= 0].mean() for s in steps if (s >= 0).any()]
    usual = float(np.median(means or 0.0))
    if not is_rate(usual):
        # Without any step, a fault says more: the first reading error stands in its place.
        why = [*unread * (not means), f"steps of {usual:.6g} s are of no force"][0]
        p.put(
            "time.rate_hz",
            UNKNOWN,
            f"{why}: is time.format right? If the newest row is the first, state time.sort=true. A "
            "footer is left out with text.drop, the words that it begins with. Below 1 Hz or above "
            "1 MHz: time.column=[]",
        )
        return
    p.put("time.rate_hz", float(f"{1 / usual:.5g}"))
    if p.description.traces.lengths == "resample":
        n_steps = np.quantile(np.diff(spans), SHORT) * p.description.time.rate_hz
        p.put("traces.samples", math.ceil(n_steps - EVEN) + 1)
    faults: Faults = []
    for table, seconds in clocks:
        with caught(faults, table.source):
            check_steps(seconds, p.description.time, table)  # with the rate
    if len(faults) > FEW * len(clocks) + 1:
        p.put(
            "time.gap",
            UNKNOWN,
            f"{len(faults)} of {len(clocks)} recordings have such times: {faults[0]}; {ANSWERS}",
        )


def _order_by_times(p: Proposal, spans: Sequence[tuple[float, float]]) -> None:
    """Set `order` in `p` to `time` if the recordings have dates, to `?` if times contradict it.

    They have dates if all start after 1999 (UTC). If they do not, but no two of them overlap or
    touch in time, so that one clock runs on through all, and `spans` is not sorted, `order` is `?`
    (the user must answer), with a note. Otherwise, and if it is stated, `order` stays.

    spans : the first and the last time of each recording, in seconds, in their order so far.
    """
    ordered = sorted(spans)
    if min(spans, default=(0.0,))[0] > YEARS[0]:
        p.put("order", "time")
    elif spans != ordered and all(a[1] < b[0] for a, b in pairwise(ordered)):
        p.put(
            "order",
            UNKNOWN,
            "time, or name: one clock runs on through all recordings, and has another order",
        )
