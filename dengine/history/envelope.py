"""Where a trace leaves the band that most of the known successes lie in.

    >>> found = envelope_of(successes, trace, rate_hz=500.0)
    >>> found.largest
    Excess(channel=0, first=412, last=430, from_s=0.824, to_s=0.86, above=True, widths=1.7)

A picture for people, not a test: one sample in twenty of an ordinary success lies outside, by the way the band is made.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

CENTRAL = 0.95  # of the successes, at each sample, that the band holds
FEWEST = 20  # successes: the band of fewer is what the outermost of them happen to be
NARROWEST = 0.05  # of a channel's median width: where all successes agree, the noise of a sensor is no excess of a hundred


@dataclass(frozen=True, slots=True)
class Excess:
    """A piece of one channel that lies outside on one side: samples `first` to `last`, both outside.

    from_s, to_s : their times in seconds.  above : whether it lies above the band.
    widths : the largest distance from the band, in widths that the band has there.
    """

    channel: int
    first: int
    last: int
    from_s: float
    to_s: float
    above: bool
    widths: float


@dataclass(frozen=True, slots=True)
class Envelope:
    """The band of the known successes, and where one trace leaves it.

    n : successes.  low, median, high : (C, T), the band's edges and its middle, in the trace's unit.
    outside : share of the trace's samples that lie outside.  usual : below which that share lies for 95 % of the successes.
    not_finite : samples of the trace that are NaN or infinite, and lie nowhere.
    excesses : where it leaves the band, in order of channel and time.
    """

    n: int
    low: NDArray[np.float32] = field(metadata={"apart": True})
    median: NDArray[np.float32] = field(metadata={"apart": True})
    high: NDArray[np.float32] = field(metadata={"apart": True})
    outside: float
    usual: float
    not_finite: int
    excesses: tuple[Excess, ...]

    @property
    def largest(self) -> Excess | None:
        """The excess that goes farthest, in widths of the band; None where there is none."""
        return max(self.excesses, key=lambda each: each.widths, default=None)


def envelope_of(successes: NDArray[np.float32], trace: NDArray[np.float32], rate_hz: float) -> Envelope | None:
    """The band of successes (n, C, T) and where a trace (C, T) leaves it; None: they are too few, or of another shape."""
    if len(successes) < FEWEST or successes.shape[1:] != trace.shape:
        return None
    tail = (1.0 - CENTRAL) / 2.0
    low, median, high = np.quantile(successes, (tail, 0.5, 1.0 - tail), axis=0).astype(np.float32)
    finite = np.isfinite(trace)
    beyond = _beyond(trace, low, high)
    of_successes = ((successes < low) | (successes > high)).mean(axis=(1, 2))
    return Envelope(
        n=len(successes),
        low=low,
        median=median,
        high=high,
        outside=float((beyond != 0.0).sum() / max(1, finite.sum())),
        usual=float(np.quantile(of_successes, 0.95)),
        not_finite=int((~finite).sum()),
        excesses=_excesses(beyond, rate_hz),
    )


def _beyond(trace: NDArray[np.float32], low: NDArray[np.float32], high: NDArray[np.float32]) -> NDArray[np.float64]:
    """(C, T) how far each sample lies above (positive) or below the band, in widths; 0 inside and where not finite."""
    width = (high - low).astype(np.float64)
    width = np.maximum(width, NARROWEST * np.median(width, axis=1, keepdims=True) + 1e-9)
    x = np.where(np.isfinite(trace), trace, low).astype(np.float64)
    return np.where(x > high, (x - high) / width, np.where(x < low, (x - low) / width, 0.0))


def _excesses(beyond: NDArray[np.float64], rate_hz: float) -> tuple[Excess, ...]:
    found = []
    for channel, row in enumerate(beyond):
        side = np.sign(row)
        edges = np.flatnonzero(np.diff(side, prepend=0.0, append=0.0))  # where a piece of one side begins or ends
        for first, end in pairwise(edges):
            if side[first]:
                times = (float(first / rate_hz), float((end - 1) / rate_hz))
                widest = float(np.abs(row[first:end]).max())
                found.append(Excess(channel, int(first), int(end) - 1, *times, bool(side[first] > 0), widest))
    return tuple(found)
