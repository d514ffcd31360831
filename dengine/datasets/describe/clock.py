"""Which columns are the clock, in which form, and at which rate they tick."""

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import pairwise

import numpy as np

from ...errors import listed
from ..checks import LEAST_RATE_HZ, MOST_RATE_HZ
from ..description import UNKNOWN, Clock, TextForm
from ..read.clock import UNITS, scale_of, times_of
from ..table import Table, UnreadableError
from .cells import Column, Floats, Notes, Tables, Values

NAME = re.compile(
    r"time|zeit|stamp|clock|temps|tiempo|tempo|hora|heure|millis|milli?tm|micros|elapsed|epoch"
    r"|(^|\.)(t|ms|s|us|ns|sec|secs|seconds|date|datum|uhr|x_value|ticks)$|^t[ _/\[(]"
    r"|tijd|czas|时间|時間|時刻|시간",
    re.IGNORECASE,
)
UNNAMED = re.compile(r"c0|column1")  # the first column without a name
# Two columns beside each other that are whole seconds and nanoseconds.
SECONDS = re.compile(r"(?i)(^|[^n])secs?(onds?)?$")
NANOSECONDS = re.compile(r"(?i)(^|[^a-z])n(ano)?_?se|nsecs?$")
FRACTIONS = re.compile(r"(?i)^milli|^ms$|^micro")
UNIT_IN_NAME = re.compile(
    r"(?:[\[(/_ ]|in )\s*((?:[\d.,]+ ?)?(?:s|ms|us|µs|ns|min|h|sec))\s*[\])]?$"
)
NAMED_UNITS = (
    (NANOSECONDS, "ns"),
    (re.compile(r"(?i)^milli|^ms$|(?-i:[a-z]Ms$)"), "ms"),
    (re.compile(r"(?i)^micros"), "us"),
    (SECONDS, "s"),
)
# Counts since some day: their unit, the seconds from that day to 1970, and what they are called.
EPOCHS = (
    *((unit, 0, f"{unit} since 1970") for unit in ("s", "ms", "us", "ns")),
    ("d", 2_209_161_600, "days since 1900, as spreadsheets count them"),
    ("0.1 us", 11_644_473_600, "0.1 us since 1601"),
    ("0.1 us", 62_135_596_800, "0.1 us since the year 1"),
)
YEARS = (946_684_800, 2_524_608_000)  # seconds since 1970 of the years 2000 to 2050
SLOWEST_STEP = 0.04  # of numbers that are taken for seconds because they are small
GAP = 1.5
FEW = 0.1  # of the recordings that may have a gap
COARSE = 0.05  # of the steps that are 0
ROUNDING = 0.005
Columns = Mapping[str, Column]


def describe_clock(columns: Columns, notes: Notes, stated: Sequence[str] = ()) -> Values:
    """Return the columns of the clock, and their forms; neither if there is none.

    stated : the columns, if they are known.
    """
    names = [*stated] or clock_columns(columns, notes)
    clock = [columns[name] for name in names if name in columns]
    texts = [c for c in columns.values() if NAME.search(c.name) and c.odd and not c.fixed]
    if not clock and texts and not texts[0].time_forms:
        text = f"{texts[0].name} has cells of no known form, like {listed([*texts[0].odd][:3])}:"
        notes["time.column"] = f"{text} state time.format or text.drop, or time.column=[]"
        return {"time.column": UNKNOWN}
    if not clock:
        notes["time.rate_hz"] = "unknown, for no clock was found; state it if you know it"
        return {}
    formats = [form_of(column, notes, len(clock) == 1) for column in clock]
    values: Values = {"time.column": names, "time.format": formats}
    is_dated = "since" in notes.get("time.format", "") or any(c.tells_day for c in clock)
    return values | ({"order": "time"} if is_dated and UNKNOWN not in formats else {})


def clock_columns(columns: Columns, notes: Notes) -> list[str]:
    """Return the columns of the clock: seconds and nanoseconds, a date and a time, or one column.

    Without a name of a clock, a column of times is one, and so is a first column that has no name
    and rises by equal steps other than 1.
    """
    for first, second in pairwise(columns):
        if SECONDS.search(first) and NANOSECONDS.search(second):
            return [first, second]
    kinds = defaultdict[str, list[str]](list)
    for name, column in columns.items():
        kinds[_kind_of(column)].append(name)
    fractions = kinds["fraction"][:1]
    rising = [name for name in fractions if is_rising(columns[name])]
    clocks = kinds["moment"] or kinds["time"] or kinds["number"] or rising
    notes |= {"time.column": f"one of {listed(clocks)}"} if len(clocks) > 1 else {}
    if kinds["moment"] or kinds["time"]:
        return [*([] if kinds["moment"] else kinds["day"][:1]), *clocks[:1], *fractions]
    return (clocks or kinds["unnamed"])[:1]


def _kind_of(column: Column) -> str:
    """Return what a column tells of the times of samples; "" for nothing."""
    day, time = column.tells_day, column.tells_time
    if not NAME.search(column.name):
        is_clock = time or (UNNAMED.fullmatch(column.name) and is_even(column))
        return "unnamed" if is_clock else ""
    if column.time_forms:
        kind = {(True, True): "moment", (True, False): "day", (False, True): "time"}
        return "" if time and column.fixed else kind.get((day, time), "")
    if FRACTIONS.search(column.name):
        return "fraction"
    return "number" if is_rising(column) else ""


def is_rising(column: Column) -> bool:
    """Return whether numbers rise in most recordings, and fall at most as a counter that wraps."""
    votes = list[bool]()
    for values in column.numbers:
        steps = np.diff(values)
        n_back = int((steps < 0).sum())
        votes.append(bool((steps > 0).any()) and n_back <= max(1, len(steps) // 50))
    return sum(votes) > len(votes) / 2


def is_even(column: Column) -> bool:
    """Return whether numbers rise by equal steps other than 1, as a clock without a name does."""
    for values in column.numbers:
        steps = np.diff(values)
        usual = float(np.median(steps))
        if usual <= 0 or np.ptp(steps) > 0.1 * usual or usual == 1:
            return False
    return bool(column.numbers)


def form_of(column: Column, notes: Notes, is_alone: bool) -> str:
    """Return the unit or form of a column of times; `?` where several fit.

    Dates of one day read the same whether the day or the month comes first, if another column tells
    the time; of several days, or with the time, they do not.
    """
    forms = column.time_forms
    if len(forms) > 1:
        notes["time.format"] = f"{listed(forms)}: the cells prove neither"
        return UNKNOWN if is_alone or len(column.counts) > 1 else forms[0]
    if forms:
        return forms[0]
    named = [unit for pattern, unit in NAMED_UNITS if pattern.search(column.name)]
    match = UNIT_IN_NAME.search(column.name)
    for unit in (column.unit, match[1].replace(",", ".") if match else "", *named):
        if re.sub(r"^[\d.]+ ?", "", unit) in UNITS:
            return unit.replace("sec", "s")
    if not column.numbers:
        notes["time.format"] = "no form of times that is known fits"
        return UNKNOWN
    return _unit_by_size(column, notes)


def _unit_by_size(column: Column, notes: Notes) -> str:
    """Return the unit of a column of numbers, by the size of its numbers and steps."""
    first = float(min(values[0] for values in column.numbers))
    steps = np.concatenate([np.diff(values) for values in column.numbers])
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    for unit, zero, title in EPOCHS:
        scale = scale_of(unit)
        is_date = YEARS[0] <= first * scale - zero <= YEARS[1]
        if is_date and is_rate(step * scale):
            notes["time.format"] = f"{title}, by the size of the numbers"
            return unit
    if 0 < step <= SLOWEST_STEP:
        notes["time.format"] = f"seconds, for steps of {step:.6g}; the unit is not stated"
        return "s"
    rates = {unit: 1 / (step * UNITS[unit]) for unit in ("s", "ms", "us", "ns") if step}
    possible = {unit: rate for unit, rate in rates.items() if is_rate(1 / rate)}
    text = ", ".join(f"{unit} ({rate:.6g} Hz)" for unit, rate in possible.items())
    notes["time.format"] = f"steps of {step:.6g}, the unit is not stated: {text}"
    return UNKNOWN


def is_rate(step: float) -> bool:
    """Return whether a step in seconds is of a rate that forces are recorded at."""
    return step > 0 and LEAST_RATE_HZ <= 1 / step <= MOST_RATE_HZ


def describe_rate(tables: Tables, clock: Clock, form: TextForm, notes: Notes) -> Values:
    """Return the rate of a clock, the longest step that is allowed, and what else it needs."""
    recordings = [steps for table in tables if len(steps := _steps(table, clock, form))]
    forward = [rising for steps in recordings if len(rising := steps[steps >= 0])]
    if not forward:
        notes["time.rate_hz"] = "the times do not rise"
        return {"time.rate_hz": UNKNOWN}
    usual = float(np.median([np.median(steps) for steps in forward]))
    mean = float(np.median([steps.mean() for steps in forward]))
    values: Values = {}
    n_back = sum((steps < 0).any() for steps in recordings)
    if n_back > FEW * len(recordings) and not clock.wrap:
        text = f"times fall in {n_back} of {len(recordings)} recordings: does the counter begin"
        values["time.wrap"] = UNKNOWN
        notes["time.wrap"] = f"{text} again (state time.wrap), or are rows in another order "
        notes["time.wrap"] += "(time.wrap=0 and time.sort=true)?"
    elif sum((steps == 0).mean() > COARSE for steps in forward) > len(recordings) / 2:
        usual = mean
        values["time.gap"] = 0.0
        notes["time.gap"] = "the clock is coarser than the samples, so its steps are not checked"
    else:
        if is_uneven(forward):
            usual = mean
            values["traces.lengths"] = "resample"
            notes["traces.lengths"] = "the samples are not taken at even times"
        values |= _describe_gaps(forward, usual, notes)
    if is_rate(usual):
        return {**values, "time.rate_hz": round_rate(1 / usual)}
    notes["time.rate_hz"] = f"steps of {usual:.6g} s are of no force: is time.format right?"
    return {**values, "time.rate_hz": UNKNOWN}


def _steps(table: Table, clock: Clock, form: TextForm) -> Floats:
    """Return the seconds between the samples of a recording; none if its times are damaged."""
    with suppress(UnreadableError):
        return np.diff(times_of(table, clock, form)[0])
    return np.empty(0)


def is_uneven(recordings: Sequence[Floats]) -> bool:
    """Return whether samples of many recordings stand more than half a step from even times."""
    n = 0
    for steps in recordings:
        even = steps.mean() * np.arange(1, len(steps) + 1)
        n += bool(np.abs(np.cumsum(steps) - even).max() > steps.mean() / 2)
    return n > FEW * len(recordings) + 1


def _describe_gaps(recordings: Sequence[Floats], usual: float, notes: Notes) -> Values:
    """Return the longest step that is allowed: `?` if many recordings have longer ones."""
    longest = [float(steps.max()) / usual if usual else 0.0 for steps in recordings]
    n_long = sum(ratio > GAP for ratio in longest)
    text = f"{n_long} of {len(longest)} recordings have steps of more than {GAP:g} usual ones"
    if n_long > FEW * len(longest) + 1:
        notes["time.gap"] = f"{text}, the longest {max(longest):.3g}; how long may one be?"
        return {"time.gap": UNKNOWN}
    notes |= {"time.gap": f"{text}: they are faults"} if n_long else {}
    return {}


def round_rate(rate: float) -> float:
    """Return a rate rounded to three digits if that changes it by less than 0.5 %, else to six."""
    rounded = float(f"{rate:.3g}")
    return rounded if abs(rounded - rate) < ROUNDING * rate else float(f"{rate:.6g}")
