"""The form in which a store has its recordings, for those that come later."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

from .datasets import Dataset
from .errors import StoreError, TraceError
from .recordings.loading import TABLES
from .records import TraceSpec
from .settings import trace_in
from .store.base import Store, opening

RATE = 0.02  # as near as rates that are measured from timestamps come to each other


def form_in(store: str | os.PathLike[str] | Store, source: Any) -> dict[str, Any]:
    """The `samples` and `fit` with which `load_dataset` gives recordings the form that those in a store have.

    Files that are added change the median that lengths are padded to; without this the others would come out changed, and
    count again. Empty for a new store, and for what has one length.
    """
    if not isinstance(source, str | os.PathLike):
        return {}
    if not (Path(source).is_dir() or Path(source).suffix.lower() in TABLES):
        return {}
    try:
        with opening(store, must_exist=True) as opened:
            agreed = trace_in(opened.settings())
            if opened is not store:
                opened.close()
    except StoreError:
        return {}  # a new one; what else is wrong is found when it is opened to write
    if agreed is None:
        return {}
    return {"samples": agreed.samples, "fit": None if agreed.fit == "strict" else agreed.fit}


def must_agree(data: Dataset, agreed: TraceSpec) -> None:
    """TraceError where a data set has another rate or other channels, or was brought to its length in another way."""
    spec = data.spec
    stretched = spec.fit != agreed.fit and "resample" in (spec.fit, agreed.fit)
    if data.lengths is not None and (stretched or spec.samples != agreed.samples):
        raise TraceError(
            f"Expected recordings brought to {agreed.samples} samples by {agreed.fit}, {data.name} was to {spec.samples} "
            f"by {spec.fit}; load it with samples={agreed.samples}, fit={agreed.fit!r}, or what is known would count again."
        )
    if not math.isclose(agreed.rate_hz, spec.rate_hz, rel_tol=RATE):
        raise TraceError(f"Expected traces at {agreed.rate_hz:g} Hz, {data.name} has {spec.rate_hz:g} Hz; resample it.")
    if data.channels and agreed.columns and data.channels != agreed.columns:
        raise TraceError(f"Expected the channels {', '.join(agreed.columns)}, got {', '.join(data.channels)}.")
