"""The labelled traces of a store as a data set: what a cell recorded in the shadow mode is replayed as recordings are.

>>> load_dataset("cell.db")
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import DataError
from ..records import trace_in
from ..store.base import open_store
from .dataset import Asked, Dataset, make_dataset
from .lengths import refit


def read_store(path: Path, name: str, asked: Asked) -> Dataset:
    """Every labelled trace, in the order of the labels, as the labels count now; bad and forgotten ones are left out.

    Where everything was verified these are all parts. Where the model decided they are a choice of its own: those that it
    was not certain of, audits, and what became known of accepted ones.
    DataError for a store without a label.
    """
    store = open_store(path, must_exist=True)
    try:
        held, spec = store.labelled(), trace_in(store.settings())
    finally:
        store.close()
    if spec is None or not len(held.labels):
        raise DataError(
            f"Expected a store with labelled traces, {path} has none; record some first, as in the shadow mode."
        )
    again = len(np.unique(held.hashes)) < len(held.hashes)
    about = {"rate_hz": spec.rate_hz, "unit": spec.unit, "channels": tuple(spec.columns), "fit": spec.fit}
    X = held.traces[:, 0] if spec.channels == 1 else held.traces
    # By the hash that is counted with: a part that came again has one vote there too.
    part = held.hashes.astype(np.str_) if again else None
    return refit(make_dataset(X, held.labels, part=part, name=name, **about), asked)
