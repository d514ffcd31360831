"""One long recording of many insertions, cut into them by a trigger: each a trace, or a fault that says why it is none."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .cutting import StartFinder, place
from .triggers import Active

AHEAD = 100  # messages: a burst of so many that come late is no gap
SPAN = 100  # messages that the step is measured over, where single steps do not tell it
ODD = 0.3  # of a step: so far off what they come to, single steps are of bursts
Times = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Insertion:
    """One, cut out of a stream. trace : (C, T) float32.  first : its first message.  fault : why it is no trace, if any."""

    trace: NDArray[np.float32]
    first: int
    fault: str


def usual_step(times: Times) -> float:
    """Seconds between two messages, as it is for most of a stream, be it in bursts."""
    span, single = min(SPAN, len(times) - 1), float(np.median(np.diff(times)))
    many = float(np.median((times[span:] - times[:-span]) / span))
    return single if abs(single - many) < ODD * many else many


def slots(times: Times, step: float) -> NDArray[np.int64]:
    """(n,) the place of each message, in steps: a message that came late keeps its own, one that is lost leaves one.

    After a lost message all others are later by a step, for good; after a late one they are not. So the least lateness of
    the messages that follow tells lost from late.
    """
    n = len(times)
    late = times - times[0] - step * np.arange(n)
    ahead = np.concatenate([late, np.full(AHEAD - 1, np.inf)])
    least = np.lib.stride_tricks.sliding_window_view(ahead, AHEAD).min(axis=1)
    lost = np.maximum(np.rint(np.diff(least, prepend=least[:1]) / step), 0)
    return np.asarray(np.arange(n) + np.cumsum(lost), dtype=np.int64)


def cut_stream(
    times: Times, values: NDArray[np.float64], active: Active, samples: int, quiet_s: float, rate_hz: float | None
) -> Iterator[Insertion]:
    """Every insertion of a stream, in turn. times, active : (n,).  values : (n, C).

    rate_hz : stated; then the times only say when an insertion was, and no message counts as lost.
    """
    step = 1.0 / rate_hz if rate_hz else usual_step(times)
    at = np.arange(len(times)) if rate_hz else slots(times, step)
    finder, free = StartFinder(1.0, quiet_s / step), 0.0
    for i, (slot, on) in enumerate(zip(at.tolist(), active.tolist(), strict=True)):
        start = finder.feed(float(slot), on)
        if start is None or start.time < free:
            continue
        free = start.time + samples
        stop = int(np.searchsorted(at, free))
        placed = place(at[i:stop].tolist(), values[i:stop], start.time, samples, 1.0)
        back = np.flatnonzero(np.diff(times[i:stop]) <= 0)
        fault = ""
        if not start.seen:
            fault = "Expected the message that it begins with, that one fell into a gap"
        elif len(back) and not rate_hz:
            fault = f"Expected later times from message to message, sample {int(back[0]) + 1} is not later"
        elif placed.missing:
            fault = (
                f"Expected a message each {step:.3g} s, {placed.missing} of {samples} are missing, the first at sample "
                f"{placed.gaps[0][0]}"
            )
        yield Insertion(placed.trace, i, fault)
