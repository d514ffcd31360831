"""Which columns are the clock, in which form, and at which rate they tick."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import listed
from ..checks import LEAST_RATE_HZ, MOST_RATE_HZ
from ..description import UNKNOWN, Clock, TextForm
from ..read.clock import ISO, UNITS, column_times, times_of
from ..table import Table, UnreadableError
from ..units import bare

NAME = re.compile(
    r"time|zeit|stamp|clock|temps|tiempo|tempo|hora|millis|milli?tm|elapsed|时间|時間|時刻"
    r"|^(t|ms|s|us|ns|sec|secs|seconds|date|datum|uhr|x_value|ticks)$|^t[ _/\[(]",
    re.IGNORECASE,
)
FORMS = (
    ISO,
    *("%d.%m.%Y %H:%M:%S.%f", "%d.%m.%Y %H:%M:%S", "%Y/%m/%d %H:%M:%S.%f", "%Y/%m/%d %H:%M:%S"),
    *("%m/%d/%Y %H:%M:%S.%f", "%m/%d/%Y %H:%M:%S", "%d/%m/%Y %H:%M:%S.%f", "%d/%m/%Y %H:%M:%S"),
    *("%m/%d/%Y %I:%M:%S.%f %p", "%m/%d/%Y %I:%M:%S %p", "%H:%M:%S.%f", "%H:%M:%S", "%H:%M:%S:%f"),
    *("%d.%m.%Y", "%Y/%m/%d", "%m/%d/%Y", "%d/%m/%Y", "%Y-%m-%d"),
)
# Seconds since 1970 of the years 2000 to 2050.
YEARS = (946_684_800, 2_524_608_000)
EXCEL_DAYS = (36_526, 54_789)  # the same years
UNIT_IN_NAME = re.compile(
    r"(?:[\[(/_ ]|in )\s*((?:[\d.]+ ?)?(?:s|ms|us|µs|ns|min|h|sec))\s*[\])]?$"
)
MILLIS = re.compile(r"^milli|^ms$", re.IGNORECASE)
GAP = 1.5
RATE_ROUNDING = 0.005
FEW = 0.1  # of the recordings that may have a gap


def describe_clock(
    views: Sequence[Table], form: TextForm, stated: Mapping[str, Any], notes: dict[str, str]
) -> tuple[dict[str, Any], set[str]]:
    """Return the keys of `[time]`, and the columns that tell times, the clock's or others.

    Parameters
    ----------
    views : sequence of Table
        One for each recording that was looked at.
    form : TextForm
    stated : mapping
        Keys that the user stated.
    notes : dict
        Gets the evidence.
    """
    named = [name for name in views[0].columns if NAME.search(name)]
    if "time.column" in stated:
        columns = [*np.atleast_1d(stated["time.column"]).tolist()]
        columns = [name for name in columns if name]
    else:
        columns = choose_columns(views, form, named, notes)
    others = {name for name in named if _is_rising(views, name, form)}
    if not columns:
        if "time.rate_hz" not in stated:
            notes["time.rate_hz"] = "unknown, for no clock was found; state it if you know it"
        return {}, others
    formats = stated.get("time.format")
    formats = (
        [*np.atleast_1d(formats)]
        if formats
        else [form_of(views, name, form, notes) for name in columns]
    )
    values: dict[str, Any] = {"time.column": columns, "time.format": formats}
    if UNKNOWN not in formats:
        clock = Clock(column=tuple(columns), format=tuple(formats))
        clock = replace(clock, zone=stated.get("time.zone", ""), wrap=stated.get("time.wrap", 0.0))
        values |= describe_rate(views, clock, form, notes)
    return values, {*columns, *others}


def choose_columns(
    views: Sequence[Table], form: TextForm, named: Sequence[str], notes: dict[str, str]
) -> list[str]:
    """Return the columns of the clock: seconds and nanoseconds, a date and a time, or one column."""
    names = [*views[0].columns]
    for first, second in zip(names, names[1:], strict=False):
        is_pair = re.search(r"(^|[._])secs?(onds)?$", first) and re.search(r"n(ano)?se", second)
        if is_pair or (re.search(r"secs?$", first) and second.endswith("nsecs")):
            return [first, second]
    dates = [name for name in named if _text_form(views, name) not in ("", None)]
    numbers = [name for name in named if name not in dates and _is_rising(views, name, form)]
    whole = [
        name
        for name in dates
        if _has_time(_text_form(views, name)) and _has_date(_text_form(views, name))
    ]
    days = [name for name in dates if not _has_time(_text_form(views, name))]
    of_day = [name for name in dates if name not in (*whole, *days)]
    if whole[:1] or of_day[:1]:
        if len(whole) > 1:
            notes["time.column"] = f"one of {listed(whole)}"
        columns = whole[:1] or [*days[:1], *of_day[:1]]
        parts = [n for n in named if n not in dates and re.search("milli|^ms$|micro", n, re.I)]
        return [*columns, *([] if numbers and not parts else parts[:1])]
    if not numbers:
        unnamed = [name for name in names if name not in named]
        texts = [name for name in unnamed if _has_time(_text_form(views, name))]
        even = [name for name in names[:1] if name in unnamed and _is_even(views, name, form)]
        return texts[:1] or even
    if len(numbers) > 1:
        notes["time.column"] = f"one of {listed(numbers)}"
    return numbers[:1]


def _has_date(form: str) -> bool:
    """Return whether a form of times has a date."""
    return form == ISO or "%Y" in form


def _has_time(form: str) -> bool:
    """Return whether a form of times has a time of day."""
    return form == ISO or "%S" in form


def _text_form(views: Sequence[Table], name: str) -> str:
    """Return the first form of dates and times that fits all cells looked at; "" for none."""
    forms = _text_forms(views, name)
    return forms[0] if forms else ""


def _text_forms(views: Sequence[Table], name: str) -> list[str]:
    """Return all forms of dates and times that fit the cells of a column."""
    import pandas as pd

    cells = [view.columns[name] for view in views if name in view.columns]
    if not cells:
        return []
    if cells[0].dtype.kind == "M":
        return [ISO]
    if cells[0].dtype.kind != "O":
        return []
    texts = (
        pd.Series(np.concatenate([column[:20] for column in cells[:20]])).astype(str).str.strip()
    )
    if not texts.str.contains(r"^\d+[:\-./T]\d+[:\-./T]\d", regex=True).all():
        return []
    texts = texts.str.replace(",", ".", regex=False)
    found = []
    for form in FORMS:
        pandas_form = "ISO8601" if form == ISO else form
        times = pd.to_datetime(texts, format=pandas_form, errors="coerce", utc=True)
        if not times.isna().any():
            found.append(form)
    return found


def _numbers(view: Table, name: str, form: TextForm) -> NDArray[np.float64] | None:
    """Return a column as numbers; None if it is none."""
    if view.columns[name].dtype.kind in "SUMb":
        return None
    try:
        return view.numbers(name, form)
    except UnreadableError:
        return None


def _is_rising(views: Sequence[Table], name: str, form: TextForm) -> bool:
    """Return whether a column of numbers never falls in most recordings, and rises.

    A counter that wraps falls once or twice.
    """
    votes = []
    for view in views:
        values = _numbers(view, name, form) if name in view.columns else None
        if values is None or len(values) < 2:
            votes.append(False)
            continue
        steps = np.diff(values)
        n_back = int((steps < 0).sum())
        votes.append(bool((steps > 0).any()) and (n_back == 0 or n_back <= len(steps) // 50))
    return sum(votes) > len(votes) / 2


def _is_even(views: Sequence[Table], name: str, form: TextForm) -> bool:
    """Return whether a column rises by equal steps other than 1, as a clock without a name does."""
    for view in views:
        values = _numbers(view, name, form)
        if values is None or len(values) < 8:
            return False
        steps = np.diff(values)
        usual = float(np.median(steps))
        if usual <= 0 or np.ptp(steps) > 0.1 * usual or usual == 1:
            return False
    return True


def form_of(views: Sequence[Table], name: str, form: TextForm, notes: dict[str, str]) -> str:
    """Return the unit or form of a column of times; `?` where several fit."""
    forms = _text_forms(views, name)
    if forms:
        if len(forms) > 1 and forms[0] != ISO:
            notes["time.format"] = f"{forms[0]} or {listed(forms[1:])}: the cells prove neither"
        return forms[0]
    stated = bare(views[0].units.get(name, ""))
    match = UNIT_IN_NAME.search(name)
    unit = stated if _is_time_unit(stated) else (match[1] if match else "")
    if _is_time_unit(unit):
        return unit.replace("sec", "s") if unit == "sec" else unit
    if MILLIS.search(name):
        return "ms"
    lows = [v for view in views if (v := _numbers(view, name, form)) is not None and len(v) > 1]
    if not lows:
        return UNKNOWN
    first = float(min(values[0] for values in lows))
    for unit in ("s", "ms", "us", "ns"):
        if YEARS[0] <= first * UNITS[unit] <= YEARS[1]:
            notes["time.format"] = "seconds since 1970, by the size of the numbers"
            notes["time.format"] = notes["time.format"].replace("seconds", unit)
            return unit
    step = float(np.median(np.concatenate([np.diff(values) for values in lows])))
    if EXCEL_DAYS[0] <= first <= EXCEL_DAYS[1] and step < 1e-4:
        notes["time.format"] = "days, as spreadsheets count them, by the size of the numbers"
        return "d"
    if 0 < step < 0.5:
        notes["time.format"] = f"seconds, for steps of {step:.6g}; the unit is not stated"
        return "s"
    candidates = [u for u in ("s", "ms", "us", "ns") if _is_possible(step * UNITS[u])]
    rates = ", ".join(f"{u} ({1 / (step * UNITS[u]):.6g} Hz)" for u in candidates)
    notes["time.format"] = f"steps of {step:.6g}, the unit is not stated: {rates}"
    return candidates[0] if len(candidates) == 1 else UNKNOWN


def _is_time_unit(unit: str) -> bool:
    """Return whether a text is a unit of time, perhaps behind a number."""
    return re.sub(r"^[\d.]+ ?", "", unit) in UNITS


def _is_possible(step: float) -> bool:
    """Return whether a step in seconds is of a rate that forces are recorded at."""
    return step > 0 and LEAST_RATE_HZ <= 1 / step <= MOST_RATE_HZ


def describe_rate(
    views: Sequence[Table], clock: Clock, form: TextForm, notes: dict[str, str]
) -> dict[str, Any]:
    """Return the rate of a clock, the longest step that is allowed, and what else it needs."""
    all_steps = []
    for view in views:
        try:
            seconds, _ = times_of(view, clock, form)
        except UnreadableError:
            continue
        if len(seconds) > 1:
            all_steps.append(np.diff(seconds))
    if not all_steps:
        return {"time.rate_hz": UNKNOWN}
    values: dict[str, Any] = {}
    n_back = sum(bool((steps < 0).any()) for steps in all_steps)
    if n_back > FEW * len(all_steps) and not clock.wrap:
        notes["time.wrap"] = (
            f"times fall in {n_back} of {len(all_steps)} recordings: does the counter"
        )
        notes["time.wrap"] += (
            " begin again (state time.wrap), or are rows in another order (time.sort)?"
        )
        values["time.wrap"] = UNKNOWN
    forward = [steps[steps >= 0] for steps in all_steps]
    usual = float(np.median([np.median(steps) for steps in forward if len(steps)]))
    n_coarse = sum(bool((steps == 0).mean() > 0.05) for steps in forward)
    if usual <= 0 or n_coarse > len(all_steps) / 2:
        usual = float(np.median([steps.mean() for steps in forward]))
        values["time.gap"] = 0.0
        notes["time.gap"] = "the clock is coarser than the samples, so its steps are not checked"
    elif usual > 0:
        values |= _describe_gaps(forward, usual, notes)
    if usual <= 0:
        return {"time.rate_hz": UNKNOWN}
    rate = 1 / usual
    if "traces.lengths" in values:
        rate = float(np.median([1 / steps.mean() for steps in forward]))
    if not _is_possible(1 / rate):
        notes["time.rate_hz"] = f"{rate:.6g} Hz is no rate of forces: is time.format right?"
        return {**values, "time.rate_hz": UNKNOWN}
    return {**values, "time.rate_hz": round_rate(rate)}


def _describe_gaps(
    forward: Sequence[NDArray[np.float64]], usual: float, notes: dict[str, str]
) -> dict[str, Any]:
    """Return the keys for a clock with long steps in many recordings; none for a few."""
    longest = [float(steps.max(initial=0)) / usual for steps in forward]
    n_long = sum(ratio > GAP for ratio in longest)
    if n_long == 0:
        return {}
    text = f"{n_long} of {len(longest)} recordings have steps of more than {GAP:g} usual ones"
    if n_long <= FEW * len(longest) + 1:
        notes["time.gap"] = f"{text}: they are faults"
        return {}
    notes["time.gap"] = f"{text}, the longest {max(longest):.3g}; how long may one be?"
    return {"time.gap": UNKNOWN, "traces.lengths": "resample"}


def round_rate(rate: float) -> float:
    """Return a rate rounded to three digits if that changes it by less than 0.5 %, else to six."""
    rounded = float(f"{rate:.3g}")
    return rounded if abs(rounded - rate) < RATE_ROUNDING * rate else float(f"{rate:.6g}")


__all__ = ["column_times", "describe_clock", "round_rate"]
