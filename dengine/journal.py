"""A cell program's journal back into a store: what it learned on its own, one line a trace.

    >>> import_journal("engine.db", "cell.csv").imported

A line is `label,sample,sample,...`, several channels one after the other; lines that begin with # are comments.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from .datasets import Dataset
from .errors import DataError, StoreError
from .importing import ImportReport, import_labelled
from .records import TraceSpec
from .store import open_store


def read_journal(path: str | os.PathLike[str], spec: TraceSpec) -> Dataset:
    """The labelled traces of a journal, in order; DataError names the first line that does not fit the contract."""
    expected = 1 + spec.channels * spec.samples
    rows: list[list[float]] = []
    for number, line in enumerate(Path(path).read_text(encoding="utf-8").splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            row = [float(word) for word in line.split(",")]
        except ValueError as error:
            raise DataError(f"Line {number} of {path} is no row of numbers: {error}.") from error
        if len(row) != expected or row[0] not in (0.0, 1.0):
            raise DataError(
                f"Expected a label of 1 or 0 and {expected - 1} samples in line {number} of {path}, "
                f"got {line.split(',')[0][:20]!r} and {len(row) - 1}; a last line that was cut can be removed."
            )
        rows.append(row)
    if not rows:
        raise DataError(f"{path} holds no labels yet.")
    table = np.array(rows)
    with np.errstate(over="ignore"):
        X = table[:, 1:].astype(np.float32).reshape(len(rows), spec.channels, spec.samples)
    return Dataset(X, table[:, 0].astype(np.int8), Path(path).name, spec.rate_hz, spec.unit)


def import_journal(
    store: str | os.PathLike[str], path: str | os.PathLike[str], on_traces: Callable[[int], None] | None = None
) -> ImportReport:
    """Put a journal's labels into the store of an engine, each once, however often its journal is imported."""
    opened = open_store(store)
    try:
        settings = opened.settings()
        if "trace" not in settings:
            raise StoreError(
                f"Expected the store that the cell's model was exported from, {store} knows no trace contract."
            )
        return import_labelled(opened, read_journal(path, TraceSpec(**json.loads(settings["trace"]))), on_traces=on_traces)
    finally:
        opened.close()
