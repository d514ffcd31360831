"""The range in which most successes lie at each sample, and where a trace leaves it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..records import TraceArray

CENTRAL = 0.95  # share of the successes that the band contains at each sample
MIN_SUCCESSES = 20  # the band of fewer would be their outermost values
MIN_WIDTH = 0.05  # of a channel's median width: where all successes agree, noise is no large excess


@dataclass(frozen=True, slots=True)
class Excess:
    """A piece of one channel of a trace that lies outside the envelope, on one side.

    Attributes
    ----------
    channel : int
        From 0.
    above : bool
        Whether it lies above the band.
    widths : float
        Largest distance from the band, in widths of the band there.
    first, last : int
        Its first and last sample, from 0.
    """

    channel: int
    above: bool
    widths: float
    first: int
    last: int


@dataclass(frozen=True, slots=True)
class Envelope:
    """The band in which known successes lie, and where one trace leaves it.

    Attributes
    ----------
    n : int
        Number of successes.
    low, median, high : array of float32, shape (C, T)
        The band's lower edge, middle and upper edge, in the trace's unit.
    outside : float
        Share of the trace's samples that lie outside.
    usual : float
        95 % of the successes have a smaller share outside.
    not_finite : int
        Samples of the trace that are NaN or infinite; they count neither way.
    excesses : tuple of Excess
        Where the trace leaves the band, the largest first.
    """

    n: int
    low: TraceArray = field(metadata={"apart": True})
    median: TraceArray = field(metadata={"apart": True})
    high: TraceArray = field(metadata={"apart": True})
    outside: float
    usual: float
    not_finite: int
    excesses: tuple[Excess, ...]


def envelope_of(successes: TraceArray, trace: TraceArray) -> Envelope | None:
    """Compute the envelope of successes, and where a trace leaves it.

    At each sample the envelope contains the middle 95 % of the successes. A distance from it is
    measured in its width there, or in a twentieth of the channel's median width if that is more.

    Parameters
    ----------
    successes : array of float32, shape (n, C, T)
    trace : array of float32, shape (C, T)
        Its NaN and infinite samples are left out.

    Returns
    -------
    Envelope or None
        None for fewer than 20 successes, or if their shape is not the trace's.
    """
    if len(successes) < MIN_SUCCESSES or successes.shape[1:] != trace.shape:
        return None
    tail = (1.0 - CENTRAL) / 2.0
    low, median, high = np.quantile(successes, (tail, 0.5, 1.0 - tail), axis=0).astype(np.float32)
    finite = np.isfinite(trace)
    width = (high - low).astype(np.float64)
    width = np.maximum(width, MIN_WIDTH * np.median(width, axis=1, keepdims=True) + 1e-9)
    x = np.where(finite, trace, low).astype(np.float64)
    below = np.where(x < low, (x - low) / width, 0.0)
    excess = np.where(x > high, (x - high) / width, below)  # (C, T), in widths
    return Envelope(
        n=len(successes),
        low=low,
        median=median,
        high=high,
        outside=float((excess != 0.0).sum() / max(1, finite.sum())),
        usual=float(np.quantile(((successes < low) | (successes > high)).mean(axis=(1, 2)), 0.95)),
        not_finite=int((~finite).sum()),
        excesses=tuple(sorted(_find_excesses(excess), key=lambda piece: -piece.widths)),
    )


def _find_excesses(excess: NDArray[np.float64]) -> Iterator[Excess]:
    """Yield the pieces of the excess (C, T) that are above 0, or below 0, throughout.

    They come channel by channel, in the order of time. The excess is in widths of the band:
    positive above it, negative below it, 0 inside.
    """
    for channel, row in enumerate(excess):
        side = np.sign(row)
        # Where a piece begins or ends.
        edges = np.flatnonzero(np.diff(side, prepend=0.0, append=0.0))
        for first, end in pairwise(edges.tolist()):
            if side[first]:
                widths = float(np.abs(row[first:end]).max())
                above = bool(side[first] > 0)
                yield Excess(channel, above, widths, first, end - 1)
