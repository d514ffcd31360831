"""Cut one long recording into parts, by a trigger or by a listing with starts and ends."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...errors import DataError
from ...records import Floats
from ..description import Clock, Description
from ..table import Table, UnreadableError
from ..triggers import StartFinder, as_trigger
from .clock import times_of
from .places import in_listing, listing_table
from .split import verdicts_of

EPOCH = 1e8  # seconds: smaller times of a listing count from the start of the recording
TOLERANCE = 1e-5  # seconds: float64 rounds dates to less
Windows = Iterator[tuple[str, slice, str]]  # the key of a part, its rows, and what is wrong


def cut(table: Table, description: Description, base: Path) -> Iterator[Table]:
    """Yield the table of each part of a long recording, as the section `[windows]` says.

    A part is a window of rows, which a trigger, a condition on a signal, begins, or whose start and
    end are in a listing, a file in the folder `base`; with both stated the trigger counts. A
    trigger's window has `traces.samples` rows, or fewer at the end of the recording, which is no
    damage. Windows of a listing come by increasing start, and one without samples has one row. The
    `path` of a part's table is the number of the part from 1, or its key in the listing. A part has
    `damage` (an error for which it is left out) if a trigger begins it in a gap of the times, or if
    a window of the listing has no samples, overlaps an earlier one, or goes beyond the recording.
    For labels in a topic of a ROS bag, that column has all labels from the start of the part to the
    start of the next; different ones may belong to two parts. Raises DataError if `time.column` is
    not stated, if a trigger cuts and the rate is not stated, if no part is found, if the recording
    has damage, or if times, signals, labels or the listing cannot be read, SettingError for a
    malformed trigger, and LookupError for a listing in an encoding that Python does not know.
    """
    import pandas as pd

    name = table.source
    if not description.time.column:
        raise DataError(f"Expected time.column, the clock of {name}, which is one long recording.")
    times = times_of(table.whole(), description.time, description.text)
    if description.windows.trigger:
        windows = [*_triggered(table, times, description)]
    else:
        windows = [*_listed(times, description, base)]
    if not windows:
        raise DataError(f"Expected parts in {name}, found none; see [windows].")
    ends = [*(rows.start for _, rows, _ in windows[1:]), None]
    for (key, rows, fault), end in zip(windows, ends, strict=True):
        part = table.take(rows)
        verdicts = {
            topic: pd.Series(table.column(topic)[rows.start : end]).dropna().to_numpy()
            for topic in verdicts_of(description)
        }
        yield replace(
            part,
            source=f"{name}, {key}",
            path=key,
            columns={**part.columns, **verdicts},
            damage=[UnreadableError(fault)] if fault else [],
        )


def _triggered(table: Table, times: Floats, description: Description) -> Windows:
    """Yield the number, the rows and the fault ("" for none) of each part that a trigger begins.

    A trigger is a condition on a signal, and a fault says why a part is left out. The numbers count
    from 1. Each part has `traces.samples` rows; those of the last may go beyond the table, which is
    no fault here. A part has a fault if it begins in a gap of the times, 1.5 steps of the stated
    rate or more. A start within the previous part is ignored; a trigger that is on at the first
    row, or was off for fewer seconds than its `quiet_s`, is no start. `times`, shape (rows,), are
    in seconds and increase. Raises DataError if the rate is not stated or a signal cannot be read,
    and SettingError for a malformed trigger.
    """
    rate = description.time.rate_hz
    if not rate:
        raise DataError("Expected time.rate_hz, by which a trigger cuts.")
    trigger = as_trigger(description.windows.trigger)
    signals = {signal: table.numbers(signal, description.text) for signal in trigger.signals}
    finder = StartFinder(1 / rate, trigger.quiet_s)
    number = 0
    free = 0  # the first row behind the newest part
    for i, (time, is_on) in enumerate(zip(times, trigger.active(signals), strict=True)):
        start = finder.feed(time, is_on)
        if start is not None and i >= free:
            number += 1
            free = i + description.traces.samples
            fault = "" if start.seen else "Expected its first sample, which fell into a gap"
            yield str(number), slice(i, free), fault


def _listed(times: Floats, description: Description, base: Path) -> Windows:
    """Yield the key, the rows and the fault ("" for none) of each window, by increasing start.

    The listing, a file in the folder `base`, has the key (the part's number), start and end of each
    window. `times`, shape (rows,), are the recording's, in seconds. If they begin at 1e8 s or
    later, like dates, and all ends in the listing are smaller, its times count from the first of
    `times`. The rows are those from the start to before the end (less 1e-5 s, for rounding). A
    window has a fault (why it is left out) if it overlaps an earlier one, has no samples, or goes
    beyond the recording by more than 1.5 steps of the stated rate (without one: at all); one
    without samples gets the first row. Raises DataError if the listing or its times cannot be read,
    and LookupError for an encoding that Python does not know.
    """
    about = description.windows
    with in_listing(about.listing):
        listing = listing_table(base / about.listing, description.text)
        keys = listing.words(about.key)
        clock = Clock(format=(about.format,), zone=description.time.zone)
        begins, ends = (
            times_of(listing, replace(clock, column=(column,)), description.text) - TOLERANCE
            for column in (about.start, about.end)
        )
    zero = times[0] if ends.max() < EPOCH <= times[0] else 0.0
    margin = 1.5 / (description.time.rate_hz or np.inf) + TOLERANCE
    least = times[0] - margin
    for begin, end, key in sorted(zip(begins + zero, ends + zero, keys.tolist(), strict=True)):
        rows = np.flatnonzero((times >= begin) & (times < end))
        fault = ""
        if not len(rows) or begin < least or end > times[-1] + margin:
            fault = (
                "Expected samples in the whole window, it has none, goes beyond the recording or "
                "overlaps the window before"
            )
        least = max(least, end - TOLERANCE)
        yield key, slice(rows[0], rows[-1] + 1) if len(rows) else slice(0, 1), fault
