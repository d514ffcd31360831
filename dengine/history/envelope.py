"""The range in which most successes lie at each sample, and how much of a trace leaves it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..records import TraceArray

CENTRAL = 0.95  # share of the successes that the band contains at each sample
MIN_SUCCESSES = 20  # the band of fewer would be their outermost values


@dataclass(frozen=True, slots=True)
class Envelope:
    """The band in which known successes lie, and how much of one trace lies outside.

    Attributes
    ----------
    n : int
        Number of successes.
    low, median, high : array of float32, shape (C, T)
        The band's lower edge, middle and upper edge, in the trace's unit.
    outside : float
        Share of the trace's samples that lie outside.
    """

    n: int
    low: TraceArray = field(metadata={"apart": True})
    median: TraceArray = field(metadata={"apart": True})
    high: TraceArray = field(metadata={"apart": True})
    outside: float


def envelope_of(successes: TraceArray, trace: TraceArray) -> Envelope | None:
    """Compute the envelope of good parts' traces, and the share of a trace's samples outside.

    At each sample the envelope contains the middle 95 % of the good parts.

    Parameters
    ----------
    successes : array of float32, shape (n, C, T)
        Traces of good parts: n parts, C channels, T samples.
    trace : array of float32, shape (C, T)
        The trace that is compared with them. A NaN counts as inside.

    Returns
    -------
    Envelope or None
        n, and at each sample lower edge, median and upper edge (quantiles 0.025, 0.5 and 0.975,
        linearly interpolated), and the share of the trace's samples outside, of all channels
        together; a sample at an edge is inside. Where a success is NaN, the edges are NaN, and the
        sample counts as inside. None for fewer than 20 successes, or if their shape is not the
        trace's.
    """
    if len(successes) < MIN_SUCCESSES or successes.shape[1:] != trace.shape:
        return None
    tail = (1.0 - CENTRAL) / 2.0
    low, median, high = np.quantile(successes, (tail, 0.5, 1.0 - tail), axis=0).astype(np.float32)
    return Envelope(
        n=len(successes),
        low=low,
        median=median,
        high=high,
        outside=float(((trace < low) | (trace > high)).mean()),
    )
