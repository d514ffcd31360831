"""Which columns are the clock, in which form, and at which rate the samples follow each other."""

import re
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import pairwise

import numpy as np

from ...errors import listed
from ..checks import LEAST_RATE_HZ, MOST_RATE_HZ
from ..description import UNKNOWN
from ..read.clock import ISO, UNITS, has_day, scale_of, times_of
from ..table import UnreadableError
from .columns import Column, Floats, Proposal, Tables

NAME = re.compile(
    r"time|zeit|stamp|clock|temps|tiempo|tempo|hora|heure|millis|milli?tm|micros|elapsed|epoch"
    r"|(^|\.)(t|ms|s|us|ns|sec|secs|seconds|date|datum|uhr|x_value|ticks)$|^t[ _/\[(]"
    r"|tijd|czas|时间|時間|時刻|시간",
    re.IGNORECASE,
)
FRACTIONS = re.compile(r"(?i)^milli|^ms$|^micro")
UNIT_IN_NAME = re.compile(
    r"(?:[\[(/_ ]|in )\s*((?:[\d.,]+ ?)?(?:s|ms|us|µs|ns|min|h|sec))\s*[\])]?$"
)
# Names that are a unit. Whole seconds and nanoseconds may stand in two columns beside each other.
NAMED_UNIT = re.compile(
    r"(?i)(?P<ns>(?:^|[^a-z])n(?:ano)?_?se|nsecs?$)|(?P<ms>^milli|^ms$|(?-i:[a-z]Ms$))"
    r"|(?P<us>^micros)|(?P<s>(?:^|[^n])secs?(?:onds?)?$)"
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
FEW = 0.1  # of the recordings that may have a gap, and of the steps that may fall
ROUNDING = 0.005


def propose_clock(p: Proposal) -> None:
    """Find the columns of the clock, and their forms, and set them in `p`.

    If there is none, `time.column` is set to `?`, with a note, where a column that is named like a
    clock has cells of no known form, or where no header names the columns; else only a note says
    that the rate is unknown.
    """
    names = p.description.time.column
    clock = [p.columns[name] for name in names if name in p.columns] or find_clock(p)
    odd = [c for c in p.columns.values() if NAME.search(c.name) and c.odd and not c.fixed]
    if clock:
        p.put("time.column", [column.name for column in clock])
        p.put("time.format", [form_of(column, p, len(clock) == 1) for column in clock])
    elif odd:
        text = f"{odd[0].name} has cells of no known form, like {listed([*odd[0].odd][:3])}"
        p.put("time.column", UNKNOWN, f"{text}: state time.format or text.drop, or time.column=[]")
    elif "c0" in p.description.text.names:
        text = f"no header names one: of {listed(p.columns)}, or time.column=[] for none"
        p.put("time.column", UNKNOWN, text)
    else:
        p.notes["time.rate_hz"] = "unknown, for no clock was found; state it if you know it"


def find_clock(p: Proposal) -> list[Column]:
    """Return the columns of the clock: one, seconds and nanoseconds, or a date and a time.

    If there are several candidates, the first is taken, and a note in `p` lists them all. The list
    is empty if there is none.
    """
    for first, second in pairwise(p.columns.values()):
        if _unit_in(first.name) == "s" and _unit_in(second.name) == "ns":
            return [first, second]
    kinds = defaultdict[str, list[Column]](list)
    for column in p.columns.values():
        kinds[_kind_of(column)].append(column)
    times = kinds["moment"] or kinds["time"]
    clocks = times or kinds["number"] or kinds["fraction"][:1]
    if len(clocks) > 1:
        p.notes["time.column"] = f"one of {listed(column.name for column in clocks)}"
    days = [] if kinds["moment"] else kinds["day"][:1]
    return [*days, times[0], *kinds["fraction"][:1]] if times else clocks[:1]


def _kind_of(column: Column) -> str:
    """Return what a column tells of the times of samples; "" for nothing.

    `moment` is a date with its time, and `time` a time of day, both only if they change within a
    recording. `day` is a date, `number` a number that rises, and `fraction` the part of a second
    beside a time.
    """
    if column.forms:
        if column.forms[0] != ISO and "%S" not in column.forms[0]:
            return "day"
        kind = "moment" if has_day(column.forms[0]) else "time"
        return "" if column.fixed else kind
    if FRACTIONS.search(column.name):
        return "fraction"
    return "number" if NAME.search(column.name) and is_rising(column) else ""


def is_rising(column: Column) -> bool:
    """Return whether the cells are numbers that rise, and fall in at most 10 % of the steps.

    A counter that begins again may fall so.
    """
    steps = column.steps
    return bool((steps > 0).any() and (steps < 0).sum() <= FEW * len(steps))


def form_of(column: Column, p: Proposal, is_alone: bool) -> str:
    """Return the unit or form of a column of times; `?` where several fit or none is proved.

    A note in `p` says why it is `?`, or which size of numbers proves the unit. Dates of one day
    read the same whether the day or the month comes first, if another column tells the time; of
    several days, or with the time, they do not.
    """
    forms = column.forms
    if len(forms) > 1 and (is_alone or not column.fixed):
        p.notes["time.format"] = f"{listed(forms)}: the cells prove neither"
        return UNKNOWN
    for unit in (*forms, column.unit, _unit_in(column.name)):
        if unit in forms or unit.lstrip("0123456789. ") in UNITS:
            return unit.replace("sec", "s")
    unit, p.notes["time.format"] = _unit_by_size(column)
    return unit


def _unit_in(name: str) -> str:
    """Return the unit of times that a column's name has, `t [ms]`, or is, `millis`; "" for none."""
    if match := UNIT_IN_NAME.search(name):
        return match[1].replace(",", ".")
    match = NAMED_UNIT.search(name)
    return (match and match.lastgroup) or ""


def _unit_by_size(column: Column) -> tuple[str, str]:
    """Return the unit of numbers, by their size and their steps, and a note on what proves it.

    The unit is `?` if nothing does; the note then has the units that are possible.
    """
    rising = column.steps[column.steps > 0]
    if not len(rising):
        return UNKNOWN, "no form of times that is known fits"
    first = float(column.numbers[0][0])
    step = float(np.median(rising))
    for unit, zero, title in EPOCHS:
        scale = scale_of(unit)
        if YEARS[0] <= first * scale - zero <= YEARS[1] and is_rate(step * scale):
            return unit, f"{title}, by the size of the numbers"
    if step <= SLOWEST_STEP:
        return "s", f"seconds, for steps of {step:.6g}; the unit is not stated"
    steps = {unit: step * UNITS[unit] for unit in ("s", "ms", "us", "ns")}
    rates = ", ".join(f"{unit} ({1 / s:.6g} Hz)" for unit, s in steps.items() if is_rate(s))
    return UNKNOWN, f"steps of {step:.6g}, the unit is not stated: {rates}"


def is_rate(step: float) -> bool:
    """Return whether a step in seconds is of a rate that forces are recorded at, 1 Hz to 1 MHz."""
    return step > 0 and LEAST_RATE_HZ <= 1 / step <= MOST_RATE_HZ


def propose_rate(p: Proposal, tables: Tables) -> None:
    """Set the rate of the clock in `p`, by the median of the mean steps of recordings.

    It is `?` if no force is recorded at such a rate. If times repeat, fall, leave gaps or are not
    even in more than 10 % of the recordings, the key that says what this means is set to `?`, with
    a note; see `QUESTIONS`. If all times are dates after the year 2000, the order is set to `time`.
    Recordings whose times cannot be read are passed over.
    """
    recordings, starts = list[Floats](), list[float]()
    for table in tables:
        with suppress(UnreadableError):
            seconds, start = times_of(table, p.description.time, p.description.text)
            starts.append(start)
            recordings += [np.diff(seconds)] if len(seconds) > 1 else []
    means = [steps[steps >= 0].mean() for steps in recordings if (steps >= 0).any()]
    usual = float(np.median(means or 0.0))
    for key, is_odd, text in QUESTIONS:
        n = sum(is_odd(steps, usual) for steps in recordings)
        if n > FEW * len(recordings) + 1:
            p.put(key, UNKNOWN, f"{n} of {len(recordings)} recordings have {text}")
    rate = round_rate(1 / usual) if is_rate(usual) else UNKNOWN
    text = f"steps of {usual:.6g} s are of no force: is time.format right?"
    p.put("time.rate_hz", rate, text if rate == UNKNOWN else "")
    if min(starts, default=0.0) > YEARS[0]:
        p.put("order", "time")


def is_uneven(steps: Floats, usual: float) -> bool:
    """Return whether samples stand more than half a step from even times; not if times fall."""
    even = steps.mean() * np.arange(1, len(steps) + 1)
    return bool((steps >= 0).all() and np.abs(np.cumsum(steps) - even).max() > steps.mean() / 2)


# What is asked about a clock if many recordings have such steps, whose usual one is known.
QUESTIONS: Sequence[tuple[str, Callable[[Floats, float], bool], str]] = (
    (
        "time.column",
        lambda steps, usual: usual > 0 and np.median(steps) == 0,
        "times that repeat, as whole seconds do: state a finer clock, or none by time.column=[], "
        "and time.rate_hz",
    ),
    (
        "time.wrap",
        lambda steps, _: bool((steps < 0).any()),
        "times that fall: does the counter begin again (state time.wrap), or are rows in another "
        "order (time.wrap=0 and time.sort=true)?",
    ),
    (
        "time.gap",
        lambda steps, usual: bool(steps.min() >= 0 and steps.max() > GAP * usual),
        f"steps of more than {GAP:g} usual ones: how many usual steps may one be? 0: any",
    ),
    ("traces.lengths", is_uneven, "no even times: resample, or strict to take them as even"),
)


def round_rate(rate: float) -> float:
    """Return a rate rounded to three digits if that changes it by less than 0.5 %, else to six."""
    rounded = float(f"{rate:.3g}")
    return rounded if abs(rounded - rate) < ROUNDING * rate else float(f"{rate:.6g}")
