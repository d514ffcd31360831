"""What a data set is, before anything is learned from it: its size, its labels, its faults, its repeats, its drift.

survey(load_dataset("cell_3/", channel="FZ_Base"))
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..datasets import Dataset, Fault
from ..folds import content_hash, own_hash
from ..model.neighbours import NEWEST, near_repeats
from ..traces import as_traces

TENTHS = 10


@dataclass(frozen=True, slots=True)
class Spread:
    """Of lengths or rates."""

    low: float
    median: float
    high: float


@dataclass(frozen=True, slots=True)
class Drift:
    """How one quantity goes with the recorded order.

    rho, p : Spearman's rank correlation with the position, and the probability of one as far from 0 without drift, both
    NaN where the quantity never changes.  tenths : its mean in each tenth of the stream, NaN where there is none.
    Source: Spearman (1904), American Journal of Psychology 15(1). The p-value is of one quantity looked at alone.
    """

    name: str
    rho: float
    p: float
    tenths: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Survey:
    """What is known of a data set.

    traces, channels, names, samples, seconds, rate_hz, unit, fit : its form.  lengths, rates : as recorded, where known.
    good, bad : labels.  faults : what was left out.  not_finite, constant : traces that the engine will verify and never
    learn from.  duplicates : traces equal to an earlier one, sample by sample; contradicting : of these, with another
    label.  near_repeats : of the newest `looked_at` that can be learned from, traces much nearer to another part's than
    parts are to each other.  parts : how many there are; None where they are not known.
    drift : of the label's share of good ones, and of each channel's mean.
    """

    name: str
    traces: int
    channels: int
    names: tuple[str, ...]
    samples: int
    seconds: float
    rate_hz: float
    unit: str
    fit: str
    lengths: Spread | None
    rates: Spread | None
    good: int
    bad: int
    faults: tuple[Fault, ...]
    not_finite: int
    constant: int
    duplicates: int
    contradicting: int
    near_repeats: int
    looked_at: int
    parts: int | None
    drift: tuple[Drift, ...]


def survey(data: Dataset) -> Survey:
    """Look at all of a data set once; no label is used but to be counted."""
    X = as_traces(data.X)
    finite = np.isfinite(X).all(axis=(1, 2))
    constant = finite & (X.min(axis=(1, 2)) == X.max(axis=(1, 2)))
    usable, hashes = finite & ~constant, content_hash(X)
    parts: list[str | None] = [None] * len(data) if data.part is None else data.part.tolist()
    own = np.array([own_hash(*each) for each in zip(hashes.tolist(), parts, strict=True)], dtype=np.int64)
    duplicates, contradicting = _duplicates(hashes[usable], data.y[usable])
    good = int(data.y.sum())
    return Survey(
        name=data.name,
        traces=len(data),
        channels=X.shape[1],
        names=data.channels,
        samples=X.shape[2],
        seconds=X.shape[2] / data.rate_hz,
        rate_hz=data.rate_hz,
        unit=data.unit,
        fit=data.fit,
        lengths=_spread(data.lengths),
        rates=_spread(data.rates),
        good=good,
        bad=len(data) - good,
        faults=data.faults,
        not_finite=int((~finite).sum()),
        constant=int(constant.sum()),
        duplicates=duplicates,
        contradicting=contradicting,
        near_repeats=near_repeats(X[usable], own[usable]),
        looked_at=min(int(usable.sum()), NEWEST),
        parts=None if data.part is None else len(set(parts)),
        drift=_drifts(data, X, usable),
    )


def levels(X: NDArray[np.float32]) -> NDArray[np.float64]:
    """(n, C, T) -> (n, C): each channel's mean over the trace."""
    means: NDArray[np.float64] = X.mean(axis=2, dtype=np.float64)
    return means


def _spread(values: NDArray[Any] | None) -> Spread | None:
    known = np.empty(0) if values is None else values[np.isfinite(values)]
    return Spread(*(float(f(known)) for f in (np.min, np.median, np.max))) if len(known) else None


def _duplicates(hashes: NDArray[np.int64], y: NDArray[np.int8]) -> tuple[int, int]:
    first: dict[int, int] = {}
    again = [(first.setdefault(hash_, label), label) for hash_, label in zip(hashes.tolist(), y.tolist(), strict=True)]
    return len(again) - len(first), sum(before != label for before, label in again)


def _drifts(data: Dataset, X: NDArray[np.float32], usable: NDArray[np.bool_]) -> tuple[Drift, ...]:
    names = data.channels or tuple(f"channel {i + 1}" for i in range(X.shape[1]))
    means = np.where(usable[:, None], levels(np.where(np.isfinite(X), X, 0)), np.nan).T
    return (_drift("good", data.y.astype(np.float64)), *(_drift(*each) for each in zip(names, means, strict=True)))


def _drift(name: str, values: NDArray[np.float64]) -> Drift:
    """Of (n,) values in recorded order; NaN ones are left out."""
    from scipy.stats import spearmanr

    place, known = np.arange(len(values)), np.isfinite(values)
    varies = known.sum() > 2 and len(np.unique(values[known])) > 1
    rho, p = spearmanr(place[known], values[known]) if varies else (np.nan, np.nan)
    blocks = [block[np.isfinite(block)] for block in np.array_split(values, TENTHS)]
    return Drift(name, float(rho), float(p), tuple(float(block.mean()) if len(block) else np.nan for block in blocks))
