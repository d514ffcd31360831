"""Checks on a description before anything is read, and on the recordings that were read.

Equal samples under two labels are a fault, and so is each repeat; `tolerance_note` compares a
policy with the share of bad parts.
"""

import codecs
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, listed, percent
from ..folds import content_hash
from .dataset import LEAST_RATE_HZ, MOST_RATE_HZ, Dataset, Fault
from .description import Description
from .table import Recording

__all__ = [
    "LEAST_RATE_HZ",
    "MOST_RATE_HZ",
    "Fitted",
    "check_description",
    "finished_notes",
    "tolerance_note",
    "without_repeats",
]
Fitted = tuple[Recording, NDArray[np.float32]]


def check_description(description: Description) -> None:
    """Raise DataError unless recordings can be read by a description."""
    text, clock, rate_hz = description.text, description.time, description.time.rate_hz
    if open_keys := description.open_keys:
        raise DataError(f"Expected a description without ?, still open: {listed(open_keys)}.")
    encoding, zone = "", None
    with suppress(LookupError):
        encoding = codecs.lookup(text.encoding).name
    with suppress(LookupError, ValueError, OSError):
        zone = ZoneInfo(clock.zone or "UTC")
    wanted = {
        "traces.samples, the samples of each trace": description.traces.samples > 0,
        "a rate of 1 Hz to 1 MHz in time.rate_hz": (
            not rate_hz or LEAST_RATE_HZ <= rate_hz <= MOST_RATE_HZ
        ),
        "time.column, since the order is time": clock.column or description.order != "time",
        "one limit for all channels": len({c.limit for c in description.channels}) == 1,
        f"an encoding in text.encoding, got {text.encoding!r}": encoding,
        f"one character in text.delimiter, got {text.delimiter!r}": len(text.delimiter) == 1,
        f"one character in text.decimal, got {text.decimal!r}": len(text.decimal) == 1,
        "text.data, the line of the first samples, of 1 or more": text.data > 0,
        f"a time zone in time.zone, got {clock.zone!r}": zone,
        f"a format for each of {len(clock.column)} columns in [time]": (
            not clock.column or len(clock.format) == len(clock.column)
        ),
    }
    for what, is_stated in wanted.items():
        if not is_stated:
            raise DataError(f"Expected {what}.")


def without_repeats(fitted: Sequence[Fitted]) -> tuple[list[Fitted], list[Fault]]:
    """Return the recordings without repeats of others, and the faults of those left out.

    Of equal traces (C, T) with one label the first is kept; if their labels differ, none is.
    Constant traces are no repeats, since a dead sensor gives the same whatever the part.
    """
    groups = defaultdict(list)
    traces = [trace for _, trace in fitted]
    for i, hash_ in enumerate(content_hash(np.stack(traces)).tolist() if traces else ()):
        samples = traces[i][np.isfinite(traces[i])]
        if (samples != samples[:1]).any():
            groups[hash_].append(i)
    messages = dict[int, str]()
    for group in groups.values():
        first, *others = [fitted[i][0] for i in group]
        is_one = all(other.label == first.label for other in others)
        near = [first] * len(others) if is_one else [others[0], *[first] * len(others)]
        for i, other in zip(group[is_one:], near, strict=True):
            messages[i] = _repeat(other, fitted[i][0], is_one)
    kept = [item for i, item in enumerate(fitted) if i not in messages]
    return kept, [Fault(fitted[i][0].source, 0, text) for i, text in sorted(messages.items())]


def _repeat(first: Recording, other: Recording, is_one: bool) -> str:
    """Return the message for a recording that repeats another one, with the same label or not."""
    if not is_one:
        return f"Expected one label for equal samples, {first.source} has another one"
    part = f" of another part, {first.part}" if other.part != first.part else ""
    return f"Expected other samples than those of {first.source}{part}, it repeats them"


def finished_notes(traces: NDArray[np.float32], sources: Sequence[str]) -> list[str]:
    """Return a note on the traces (n, C, T) in which samples are lost, if there are any."""
    n_lost = (~np.isfinite(traces)).sum(axis=(1, 2))
    rows = np.flatnonzero(n_lost)
    names = listed(sources[row] for row in rows)
    text = f"{n_lost.sum()} samples are lost, in {len(rows)} of {len(traces)} recordings: {names}."
    return [text] if len(rows) else []


def tolerance_note(data: Dataset, lower_bound: float) -> str:
    """Return why a policy's tolerance says nothing about these parts; "" if it does.

    So it is if at most so many parts are bad as the policy tolerates among the accepted ones.
    """
    share = 1 - float(data.y.mean())
    tolerance = 1 - lower_bound
    if share > tolerance:
        return ""
    return (
        f"{percent(share)} of the parts are bad, and LB {percent(lower_bound, '.4g')} tolerates "
        f"{percent(tolerance, '.4g')} among the accepted ones: accepting every part would meet it. "
        f"Choose a higher lower bound."
    )
