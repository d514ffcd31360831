"""Insertions, cut out of a stream of samples: where each begins, and each sample at the place that its time gives it.

Nothing is filled in. What a timestamp leaves out is a NaN at its place, so that whoever decides finds it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .triggers import Active

NEAR = 1.5  # steps: to the next sample, when none is missing
AHEAD = 100  # messages: a burst of so many that come late is no gap
SPAN = 100  # messages that the step is measured over, where single steps do not tell it
ODD = 0.3  # of a step: so far off what they come to, single steps are of bursts
Times = NDArray[np.float64]
Gaps = tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class Placed:
    """A window of a stream. trace : (C, T) float32, NaN where no sample came.  missing, repeated : samples.

    gaps : (first, length) of each stretch without samples.
    """

    trace: NDArray[np.float32]
    missing: int
    repeated: int
    gaps: Gaps


@dataclass(frozen=True, slots=True)
class Start:
    """Where an insertion begins. time : seconds.  seen : its first sample came; False: at `time`, or later in a gap."""

    time: float
    seen: bool = True


class StartFinder:
    """Finds where a trigger goes on, sample by sample. step : seconds from one to the next.  quiet_s : off before that."""

    def __init__(self, step: float, quiet_s: float = 0.0) -> None:
        self.step, self.quiet_s = step, quiet_s
        self.forget()

    def forget(self) -> None:
        """Begin anew: what is on at the first sample began before it, and is no start."""
        self._off_since: float | None = None
        self._last_off = 0.0

    def feed(self, time: float, active: bool) -> Start | None:
        """Where an insertion begins, if this sample shows it.

        Where samples are missing just before this one, it may have begun in any of them: then no sample's place in its
        trace is known.
        """
        if not active:
            self._off_since = time if self._off_since is None else self._off_since
            self._last_off = time
            return None
        began, self._off_since = self._off_since, None
        if began is None or time - began < self.quiet_s - self.step / 2:
            return None
        seen = time - self._last_off < NEAR * self.step
        return Start(time) if seen else Start(self._last_off + self.step, seen=False)


def place(times: Sequence[float], values: NDArray[np.float64], start: float, samples: int, step: float) -> Placed:
    """The samples from `start` on, each where its time puts it. times : (n,) seconds, increasing.  values : (n, C)."""
    trace = np.full((values.shape[1], samples), np.nan, dtype=np.float32)
    at = np.rint((np.asarray(times, dtype=np.float64) - start) / step).astype(np.int64)
    inside = (at >= 0) & (at < samples)
    places, first = np.unique(at[inside], return_index=True)
    with np.errstate(over="ignore"):  # beyond float32 becomes an infinity, which is found and reported as one
        trace[:, places] = values[inside][first].T
    there = np.zeros(samples, dtype=np.bool_)
    there[places] = True
    return Placed(trace, samples - len(places), int(inside.sum()) - len(places), gaps_of(there))


def gaps_of(there: NDArray[np.bool_]) -> Gaps:
    """(first, length) of each stretch that is not there."""
    edges = np.flatnonzero(np.diff(np.concatenate([[True], there, [True]]).astype(np.int8)))
    return tuple((int(a), int(b - a)) for a, b in zip(edges[::2], edges[1::2], strict=True))


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
