"""Recordings of whatever length into one block of traces, honestly: what cannot be fitted is a fault, not made up."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..errors import DataError
from ..records import FITS
from ..traces import fits, fitted
from .dataset import Asked, Dataset, Fault, make_dataset

Lengths = NDArray[np.int64]


@dataclass
class Collected:
    """Recordings as they were read, in order, and what could not be."""

    name: str
    channels: tuple[str, ...]
    faults: list[Fault]
    traces: list[NDArray[np.float32]] = field(default_factory=list)  # (C, T) each
    labels: list[int] = field(default_factory=list)
    sources: list[str] = field(default_factory=list)
    parts: list[str | None] = field(default_factory=list)
    rates: list[float | None] = field(default_factory=list)

    def add(self, trace: NDArray[np.float32], label: int, source: str, part: str | None, rate_hz: float | None) -> None:
        """One that could be read."""
        for column, value in zip(self._columns(), (trace, label, source, part, rate_hz), strict=True):
            column.append(value)

    def leave_out(self, why: Mapping[int, str]) -> None:
        """Make faults of those at these places."""
        self.faults.extend(Fault(self.sources[i], 0, what) for i, what in why.items())
        for column in self._columns():
            column[:] = [value for i, value in enumerate(column) if i not in why]

    def _columns(self) -> tuple[list, ...]:  # type: ignore[type-arg]  # of five kinds
        return self.traces, self.labels, self.sources, self.parts, self.rates


def as_dataset(found: Collected, asked: Asked) -> Dataset:
    """One data set of all that can be fitted; DataError where nothing can."""
    _must_have_some(found)
    lengths = np.array([x.shape[1] for x in found.traces], dtype=np.int64)
    fit, samples = form_of(lengths, asked.fit, asked.samples)
    stretch = samples / float(np.median(lengths)) if fit == "resample" else 1.0
    unfit = [i for i, have in enumerate(lengths.tolist()) if not _fits(have, samples, fit)]
    found.leave_out({i: f"Expected {_wanted(samples, fit)}, got {lengths[i]}" for i in unfit})
    _must_have_some(found)
    block = np.stack([_fitted(x, samples, fit) for x in found.traces])
    rates = np.array([np.nan if rate is None else rate for rate in found.rates])
    timed = np.isfinite(rates).any()
    rate = asked.rate_hz or (float(np.nanmedian(rates)) if timed else 500.0)
    about = {
        "part": None if all(part is None for part in found.parts) else _numbers(found),
        "faults": tuple(found.faults),
        "channels": found.channels,
        "unit": unit_of(found.channels),
        "source": np.array(found.sources),
        "lengths": np.delete(lengths, unfit),
        "rates": rates if timed else None,
    }
    X = block[:, 0] if block.shape[1] == 1 else block
    return make_dataset(X, found.labels, name=found.name, rate_hz=float(f"{rate * stretch:.4g}"), fit=fit, **about)


def unit_of(channels: Sequence[str]) -> str:
    """For people: newtons, newton metres by the names that UR cells give torques, or both."""
    units = {"N·m" if re.match(r"(mu?|t)[xyz](_|$)", name.lower()) else "N" for name in channels} or {"N"}
    return units.pop() if len(units) == 1 else "mixed units"


def form_of(lengths: Lengths, fit: str | None, samples: int | None) -> tuple[str, int]:
    """The fit and the samples that lengths (n,) are brought to, where they were not both asked for.

    Of one length: strict. With `samples` that all have: cut. Else pad to the median: what was measured stays as it was, at
    its own time, and a live trace that is a little shorter is taken too. Cut goes to the shortest that is not half of the
    others.
    """
    low, high, median = int(lengths.min()), int(lengths.max()), int(np.median(lengths))
    if fit is None:
        alike = low == high and samples in (None, low)
        fit = "strict" if alike else "cut" if samples is not None and samples <= low else "pad"
    if fit == "strict" and low != high:
        raise DataError(
            f"Expected recordings of one length, got {low} to {high} samples; choose fit='pad', 'cut' or 'resample'."
        )
    if fit == "strict" and samples not in (None, low):
        raise DataError(f"Expected {low} samples, as recorded, with fit='strict', got {samples}; choose fit='cut'.")
    if samples is None:
        samples = int(lengths[2 * lengths >= median].min()) if fit == "cut" else median
    return fit, samples


def refit(data: Dataset, asked: Asked) -> Dataset:
    """A data set whose traces have one length already, as it was asked for."""
    rated = data if asked.rate_hz is None else replace(data, rate_hz=asked.rate_hz)
    picked = rated.pick(asked.channels) if asked.channels else rated
    if asked.fit is None or asked.fit == data.fit == "strict":
        return picked if asked.samples is None else picked.cut(asked.samples)
    have = picked.X.shape[-1]
    fit, samples = form_of(np.array([have], dtype=np.int64), asked.fit, asked.samples)
    if not _fits(have, samples, fit):
        raise DataError(f"Expected {_wanted(samples, fit)}, {data.name} has {have}.")
    stretch = samples / have if fit == "resample" else 1.0
    X = picked.X if have == samples else _fitted(picked.X, samples, fit)
    return replace(picked, X=X, fit=fit, rate_hz=picked.rate_hz * stretch)


def _must_have_some(found: Collected) -> None:
    if not found.traces and not found.faults:
        raise DataError(f"Expected at least one trace in {found.name}, got none.")
    if not found.traces:
        few = "; ".join(map(str, found.faults[:3]))
        raise DataError(f"Expected recordings that can be read in {found.name}, found none of {len(found.faults)}: {few}.")


def _numbers(found: Collected) -> NDArray[np.str_]:
    """Parts' numbers; a recording without one is of a part of its own."""
    return np.array([source if part is None else part for source, part in zip(found.sources, found.parts, strict=True)])


def _fits(have: int, samples: int, fit: str) -> bool:
    return fits(have, samples, FITS.index(fit))


def _fitted(x: NDArray[np.float32], samples: int, fit: str) -> NDArray[np.float32]:
    """(..., T) -> (..., samples), by what fits live traces too."""
    if x.shape[-1] == samples:
        return x
    values: NDArray[np.float32] = fitted(torch.from_numpy(np.array(x, order="C")), samples, FITS.index(fit)).numpy()
    return values


def _wanted(samples: int, fit: str) -> str:
    """How long a recording must be."""
    if fit == "cut":
        return f"at least {samples} samples"
    return f"{(samples + 1) // 2} to {2 * samples} samples, to {fit} them to {samples}"
