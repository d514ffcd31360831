"""One insertion cut out of a stream of samples: where it begins, and each sample at the place that its time gives it.

Nothing is filled in. What a timestamp leaves out is a NaN at its place, so that whoever decides finds it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NEAR = 1.5  # steps: to the next sample, when none is missing
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
