"""Cut one long recording into parts, by a trigger or by a listing with starts and ends."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from ..dataset import Fault
from ..description import Clock, Description
from ..table import Table, UnreadableError
from ..triggers import StartFinder, as_trigger
from .clock import column_times, times_of
from .places import listing_table
from .split import Parts

KEY = "window"  # column of the key of a window in the table of its part
EPOCH = 1e8  # seconds: smaller times of a listing count from the start of the recording
TOLERANCE = 1e-5  # seconds: float64 rounds dates to less
Floats = NDArray[np.float64]


def cut(
    table: Table, name: str, description: Description, base: Path, faults: list[Fault]
) -> Parts:
    """Yield each part of a recording: its source, the path that names it, and its table.

    A part that begins in a gap, or whose window has no samples, is put into `faults`. Raises
    DataError if a key is missing, or no part is found.
    """
    windows = description.windows
    if not description.time.column:
        raise DataError(f"Expected time.column, the clock of {name}, which is one long recording.")
    seconds, start = times_of(table, description.time, description.text)
    find = _triggered if windows.trigger else _listed
    n = 0
    for key, rows, fault in find(table, seconds + start, description, base):
        n += 1
        if fault:
            faults.append(Fault(f"{name}, {key}", 0, fault))
        else:
            part = table.take(rows)
            columns = {**part.columns, KEY: np.array([key], dtype=object)}
            yield f"{name}, {key}", f"{name}/{key}", Table(name, columns, part.lines, table.units)
    if not n:
        what = windows.trigger or windows.listing
        raise DataError(f"Expected parts by {what} in {name}, found none; see [windows].")


def _triggered(table: Table, times: Floats, description: Description, base: Path) -> Any:
    """Yield the number, rows and fault of each part that a trigger begins."""
    samples, rate = description.traces.samples, description.time.rate_hz
    if not samples or not rate:
        raise DataError("Expected traces.samples and time.rate_hz, by which a trigger cuts.")
    trigger = as_trigger(description.windows.trigger)
    signals = {signal: table.numbers(signal, description.text) for signal in trigger.signals}
    finder = StartFinder(1 / rate, trigger.quiet_s)
    number, free = 0, 0
    for i, is_on in enumerate(trigger.active(signals).tolist()):
        start = finder.feed(float(times[i]), is_on)
        if start is not None and i >= free:
            number += 1
            free = i + samples
            fault = "" if start.seen else "Expected its first sample, which fell into a gap"
            yield str(number), slice(i, free), fault


def _listed(table: Table, times: Floats, description: Description, base: Path) -> Any:
    """Yield the key, rows and fault of each window of a listing, in the order of their starts."""
    about, form = description.windows, description.text
    columns = (about.key, about.start, about.end)
    if not all(columns):
        raise DataError("Expected windows.key, windows.start and windows.end, three columns.")
    try:
        listing = listing_table(base / about.listing, columns, form)
        clock = Clock(zone=description.time.zone)
        bounds = []
        for name in columns[1:]:
            relative, first = column_times(listing, name, about.format, clock, form)
            bounds.append(relative + first)
    except UnreadableError as error:
        raise DataError(f"{error}, line {error.line} of {about.listing}.") from error
    begins, ends = bounds
    if ends.max() < EPOCH <= times[0]:
        begins, ends = begins + times[0], ends + times[0]
    keys = listing.words(about.key)
    latest = -np.inf
    for i in np.argsort(begins, kind="stable"):
        inside = np.flatnonzero((times >= begins[i] - TOLERANCE) & (times < ends[i] - TOLERANCE))
        step = 1.5 / description.time.rate_hz if description.time.rate_hz else 0.0
        fault = "" if len(inside) else "Expected samples in its window, found none"
        if begins[i] < latest - TOLERANCE:
            fault = "Expected windows apart, it overlaps the one before"
        elif begins[i] < times[0] - step or ends[i] > times[-1] + step:
            fault = "Expected a window in the recording, it begins before it or ends after it"
        latest = max(latest, ends[i])
        yield str(keys[i]), slice(inside[0], inside[-1] + 1) if len(inside) else (), fault


def label_events(parts: Parts, topic: str, events: Any, column: str) -> Parts:
    """Yield parts with the label that a topic gave: its first message after each began.

    events : the messages of the topic. column : of the times of the log, in nanoseconds.
    """
    found = list(parts)
    times = np.array([time for time, _ in events])
    begins = [int(table.columns[column][0]) for *_, table in found]
    for (source, path, table), begin, following in zip(
        found, begins, [*begins[1:], 2**63], strict=False
    ):
        places = np.flatnonzero((times >= begin) & (times < following))
        word = [events[places[0]][1]] if len(places) else []
        columns = {**table.columns, topic: np.array(word, dtype=object)}
        yield source, path, Table(table.source, columns, table.lines, table.units)
