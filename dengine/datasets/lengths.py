"""Recordings of whatever length into one block of traces, honestly: what cannot be fitted is a fault, not made up."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ..errors import DataError
from ..records import FITS
from ..traces import fits, fitted
from .dataset import Asked, Dataset, Fault, make_dataset


class Recorded(NamedTuple):
    """One recording as it was read. trace : (C, T) float32.  rate_hz : by its own timestamps, where it has any."""

    trace: NDArray[np.float32]
    label: int
    source: str
    part: str | None
    rate_hz: float | None


@dataclass
class Collected:
    """Recordings, in order, and what could not be read."""

    name: str
    channels: tuple[str, ...]
    faults: list[Fault]
    read: list[Recorded] = field(default_factory=list)

    def leave_out(self, why: Mapping[int, str]) -> None:
        """Make faults of those at these places."""
        self.faults.extend(Fault(self.read[i].source, 0, what) for i, what in why.items())
        self.read = [each for i, each in enumerate(self.read) if i not in why]


def as_dataset(found: Collected, asked: Asked) -> Dataset:
    """One data set of all that can be fitted; DataError where nothing can."""
    _must_have_some(found)
    lengths = np.array([each.trace.shape[1] for each in found.read], dtype=np.int64)
    fit, samples = form_of(lengths, asked.fit, asked.samples)
    stretch = samples / float(np.median(lengths)) if fit == "resample" else 1.0
    unfit = [i for i, have in enumerate(lengths.tolist()) if not _fits(have, samples, fit)]
    found.leave_out({i: f"Expected {_wanted(samples, fit)}, got {lengths[i]}" for i in unfit})
    _must_have_some(found)
    block = np.stack([_fitted(each.trace, samples, fit) for each in found.read])
    rates = np.array([np.nan if each.rate_hz is None else each.rate_hz for each in found.read])
    timed = np.isfinite(rates).any()
    rate = asked.rate_hz or (float(np.nanmedian(rates)) if timed else 500.0)
    # A recording without a part's number is of a part of its own.
    parts = [each.source if each.part is None else each.part for each in found.read]
    about: dict[str, Any] = {
        "part": np.array(parts) if any(each.part is not None for each in found.read) else None,
        "faults": tuple(found.faults),
        "channels": found.channels,
        "unit": unit_of(found.channels),
        "source": np.array([each.source for each in found.read]),
        "lengths": np.delete(lengths, unfit),
        "rates": rates if timed else None,
    }
    X = block[:, 0] if block.shape[1] == 1 else block
    return make_dataset(
        X, [each.label for each in found.read], name=found.name, rate_hz=float(f"{rate * stretch:.4g}"), fit=fit, **about
    )


def unit_of(channels: Sequence[str]) -> str:
    """For people: newtons, newton metres by the names that UR cells give torques, or both."""
    units = {"N·m" if re.match(r"(mu?|t)[xyz](_|$)", name.lower()) else "N" for name in channels} or {"N"}
    return units.pop() if len(units) == 1 else "mixed units"


def form_of(lengths: NDArray[np.int64], fit: str | None, samples: int | None) -> tuple[str, int]:
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
        choose = "choose fit='pad', 'cut' or 'resample'"
        raise DataError(f"Expected recordings of one length, got {low} to {high} samples; {choose}.")
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
    if not found.read and not found.faults:
        raise DataError(f"Expected at least one trace in {found.name}, got none.")
    if not found.read:
        few = "; ".join(map(str, found.faults[:3]))
        raise DataError(f"Expected recordings that can be read in {found.name}, found none of {len(found.faults)}: {few}.")


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
