"""What a data set is, before anything is learned from it: its size, its labels, its faults, its repeats, its drift.

survey(load_dataset("cell_3/", channel="FZ_Base"))
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..datasets import Dataset, Fault
from ..folds import content_hash, trace_hash
from ..model.neighbours import NEWEST, near_repeats
from ..traces import LARGEST, as_traces


@dataclass(frozen=True, slots=True)
class Spread:
    """Of lengths or rates."""

    low: float
    median: float
    high: float


@dataclass(frozen=True, slots=True)
class Drift:
    """How one quantity goes with the recorded order.

    rho, p : Spearman's rank correlation with the position, and the probability of one as far from 0 without drift, of this
    quantity alone; NaN where it never changes.  tenths : its mean in each tenth of the stream, NaN where there is none.
    Source: Spearman (1904), American Journal of Psychology 15(1).
    """

    name: str
    rho: float
    p: float
    tenths: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Survey:
    """What is known of a data set.

    seconds, rate_hz, lengths, rates : as recorded, None where not known.  faults : what was left out.
    not_finite, constant, too_large : traces that the engine verifies and never learns from.
    not_finite_in : files, or rows, of those that are not finite.
    duplicates : traces equal to an earlier one, sample by sample; contradicting : of these, with another label.
    near_repeats : of the newest `looked_at` that can be learned from, traces much nearer to another part's than parts are
    to each other.  parts : how many, where known.  unlabelled : left out, since nobody has checked them yet.
    drift : of the share of good labels, and of each channel's mean; empty where the order does not say what came first.
    """

    name: str
    traces: int
    channels: int
    names: tuple[str, ...]
    samples: int
    seconds: float | None
    rate_hz: float | None
    unit: str
    fit: str
    lengths: Spread | None
    rates: Spread | None
    good: int
    bad: int
    unlabelled: int
    faults: tuple[Fault, ...]
    not_finite: int
    not_finite_in: tuple[str, ...]
    constant: int
    too_large: int
    duplicates: int
    contradicting: int
    near_repeats: int
    looked_at: int
    parts: int | None
    drift: tuple[Drift, ...]


def survey(data: Dataset) -> Survey:
    """Look at all of a data set once; no label is used but to be counted."""
    X, good = as_traces(data.X), int(data.y.sum())
    finite = np.isfinite(X).all(axis=(1, 2))
    constant = finite & (X.min(axis=(1, 2)) == X.max(axis=(1, 2)))
    too_large = finite & ~constant & (np.abs(X).max(axis=(1, 2)) > LARGEST)
    usable, hashes = finite & ~constant & ~too_large, content_hash(X)
    parts: list[str | None] = [None] * len(data) if data.part is None else data.part.tolist()
    own = np.array([trace_hash(*each) for each in zip(hashes.tolist(), parts, strict=True)], dtype=np.int64)
    first: dict[int, int] = {}  # the label of each content's first trace
    labels = zip(hashes[usable].tolist(), data.y[usable].tolist(), strict=True)
    again = [(first.setdefault(content, label), label) for content, label in labels]
    names = data.channels or tuple(f"channel {i + 1}" for i in range(X.shape[1]))
    means = np.where(usable[:, None], levels(np.where(usable[:, None, None], X, 0)), np.nan).T
    quantities = zip(("good", *names), [data.y.astype(np.float64), *means], strict=True)
    return Survey(
        **{name: getattr(data, name) for name in ("name", "rate_hz", "unit", "fit", "unlabelled", "faults")},
        **dict(zip(("traces", "channels", "samples"), X.shape, strict=True)),
        names=data.channels,
        seconds=None if data.rate_hz is None else X.shape[2] / data.rate_hz,
        lengths=_spread(data.lengths),
        rates=_spread(data.rates),
        good=good,
        bad=len(data) - good,
        not_finite=int((~finite).sum()),
        not_finite_in=() if data.source is None else tuple(data.source[~finite].tolist()),
        constant=int(constant.sum()),
        too_large=int(too_large.sum()),
        duplicates=len(again) - len(first),
        contradicting=sum(before != label for before, label in again),
        near_repeats=near_repeats(X[usable], own[usable]),
        looked_at=min(int(usable.sum()), NEWEST),
        parts=None if data.part is None else len(set(parts)),
        drift=tuple(_drift(*each) for each in quantities) if data.ordered else (),
    )


def levels(X: NDArray[np.float32]) -> NDArray[np.float64]:
    """(n, C, T) -> (n, C): each channel's mean over the trace."""
    return np.asarray(X.mean(axis=2, dtype=np.float64))


def _spread(values: NDArray[Any] | None) -> Spread | None:
    known = np.empty(0) if values is None else values[np.isfinite(values)]
    return Spread(*np.quantile(known, (0.0, 0.5, 1.0)).tolist()) if len(known) else None


def _drift(name: str, values: NDArray[np.float64]) -> Drift:
    """Of (n,) values in recorded order; NaN ones are left out."""
    from scipy.stats import spearmanr

    place, known = np.arange(len(values)), np.isfinite(values)
    varies = known.sum() > 2 and len(np.unique(values[known])) > 1
    rho, p = spearmanr(place[known], values[known]) if varies else (np.nan, np.nan)
    tenths = [block[np.isfinite(block)] for block in np.array_split(values, 10)]
    return Drift(name, float(rho), float(p), tuple(float(block.mean()) if len(block) else np.nan for block in tenths))
