"""A survey of a data set before anything is learned from it: counts, faults and repeats.
`dengine data` prints it.

    survey_dataset(load_dataset("cell_3/"))
"""

from dataclasses import dataclass

import numpy as np

from ..datasets import Dataset, Fault
from ..folds import content_hash, trace_hash
from ..model.neighbours import NEWEST, near_repeats
from ..traces import LARGEST, as_traces


@dataclass(frozen=True, slots=True)
class Spread:
    """The smallest, median and largest of the lengths of a data set's recordings."""

    low: float
    median: float
    high: float


@dataclass(frozen=True, slots=True)
class Survey:
    """What is known of a data set.

    Attributes
    ----------
    name : str
    traces, channels, samples : int
        The shape of the traces.
    names : tuple of str
        Of the channels, if they have any.
    seconds, rate_hz : float or None
        Duration of a trace, and samples per second; None if not known.
    unit, fit : str
    lengths : Spread or None
        Samples of the recordings; None if not known.
    good, bad : int
        Labels.
    unlabelled : int
        Recordings left out because nobody has checked the part yet.
    faults : tuple of Fault
        Recordings left out because they could not be read.
    not_finite, constant, too_large : int
        Traces that the engine verifies and never learns from.
    not_finite_in : tuple of str
        Files, or rows, of those that are not finite.
    duplicates : int
        Usable traces that equal an earlier one, by `content_hash`.
    near_repeats, looked_at : int
        The first counts, among the newest `looked_at` usable traces, at most 500, those that are
        much nearer to another part's trace than parts are to each other. It is 0 for fewer than 100
        traces.
    parts : int or None
        Different parts; None if their numbers are not known.
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
    good: int
    bad: int
    unlabelled: int
    faults: tuple[Fault, ...]
    not_finite: int
    not_finite_in: tuple[str, ...]
    constant: int
    too_large: int
    duplicates: int
    near_repeats: int
    looked_at: int
    parts: int | None


def survey_dataset(data: Dataset) -> Survey:
    """Count the traces, labels, faults and repeats of a data set.

    Faults are recordings that could not be read. Repeats are counted among the usable traces, which
    are finite, not constant, and without a sample beyond 1e18: those that equal an earlier one,
    and, of the newest 500, those that nearly repeat the trace of another part (`near_repeats`).
    Nothing is trained, and the data set is not changed.

    Parameters
    ----------
    data : Dataset

    Returns
    -------
    survey : Survey
    """
    X = as_traces(data.X)
    n_good = int(data.y.sum())
    finite = np.isfinite(X).all(axis=(1, 2))
    constant = finite & (X.min(axis=(1, 2)) == X.max(axis=(1, 2)))
    too_large = finite & ~constant & (np.abs(X).max(axis=(1, 2)) > LARGEST)
    usable = finite & ~constant & ~too_large
    n_usable = int(usable.sum())
    parts: list[str | None] = [None] * len(data) if data.part is None else data.part.tolist()
    hashes = content_hash(X)
    part_hashes = np.array(
        [trace_hash(content, part) for content, part in zip(hashes.tolist(), parts, strict=True)],
        dtype=np.int64,
    )
    lengths = None
    if data.lengths is not None and len(data.lengths):
        lengths = Spread(*np.quantile(data.lengths, (0.0, 0.5, 1.0)).tolist())
    return Survey(
        **{
            name: getattr(data, name)
            for name in ("name", "rate_hz", "unit", "fit", "unlabelled", "faults")
        },
        **dict(zip(("traces", "channels", "samples"), X.shape, strict=True)),
        names=data.channels,
        seconds=None if data.rate_hz is None else X.shape[2] / data.rate_hz,
        lengths=lengths,
        good=n_good,
        bad=len(data) - n_good,
        not_finite=int((~finite).sum()),
        not_finite_in=() if data.source is None else tuple(data.source[~finite].tolist()),
        constant=int(constant.sum()),
        too_large=int(too_large.sum()),
        duplicates=n_usable - len(np.unique(hashes[usable])),
        near_repeats=near_repeats(X[usable], part_hashes[usable]),
        looked_at=min(n_usable, NEWEST),
        parts=None if data.part is None else len(set(parts)),
    )
