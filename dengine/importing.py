"""Recorded traces with labels, put into a store as if an engine had verified each of them.

    report = import_labelled("engine.db", "recorded.npz", recipe="conv")
    DataEngine.open("engine.db").retrain()
    report = import_journal("engine.db", "cell.csv")       # what a cell program learned on its own

A trace is imported once: its id comes from its content, so an import that was interrupted goes on where it stopped, and
the same file twice counts no label twice. Traces that a cell recorded itself have other ids and are not recognised.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .datasets import Dataset, load_dataset
from .engine import DataEngine
from .errors import DataError, StoreError, TraceError
from .folds import content_hash
from .recipe import Recipe
from .records import REASONS, Action, Decision, Reason, RetrainReport, Source, TraceSpec
from .store.base import Store, open_store
from .traces import TraceGate, as_traces

CHUNK = 500  # traces committed together


@dataclass(frozen=True, slots=True)
class ImportReport:
    """What became of a data set's traces: taken in, taken in but kept from training, or known from an earlier import."""

    imported: int
    quarantined: int
    known: int
    resumed: bool


def import_labelled(
    store: str | os.PathLike[str] | Store,
    dataset: Any,
    recipe: Recipe | str | None = None,
    seed: int | None = None,
    on_traces: Callable[[int], None] | None = None,
) -> ImportReport:
    """Put every labelled trace of a data set into a new or a used store, in order, in chunks that are all or none.

    dataset : anything `load_dataset` takes.
    recipe, seed : of a new store's engine, conv and 0 by default; a used store has its own, and others are a SettingError.
    on_traces : called with the number of traces that were just dealt with.
    Raises TraceError where the traces break the contract that the store's engine agreed on.
    """
    data = load_dataset(dataset)
    spec = TraceSpec(data.X.shape[-1], data.rate_hz, 1 if data.X.ndim == 2 else data.X.shape[1], data.unit)
    engine = DataEngine.open_or_create(store, seed, recipe=recipe)
    try:
        agreed = engine.agree_on(spec)
        if agreed.rate_hz != spec.rate_hz:
            raise TraceError(f"Expected traces at {agreed.rate_hz:g} Hz, {data.name} has {spec.rate_hz:g} Hz; resample it.")
        traces = as_traces(data.X, agreed)
        counts = [_import_chunk(engine.store, *part, agreed, on_traces) for part in _chunks(traces, data)]
    finally:
        if not isinstance(store, Store):
            engine.close()
    imported, quarantined, known = (sum(column) for column in zip(*counts, strict=True))
    return ImportReport(imported, quarantined, known, engine.resumed)


def train_until_done(
    engine: DataEngine, retrains: int, on_retrain: Callable[[RetrainReport], None] | None = None
) -> list[RetrainReport]:
    """Retrain up to so many times: a reducer that learns in steps goes on from the last one, each within its budget.

    Stops after the first where no steps are taken (UMAP, PCA), and where a candidate was dropped.
    """
    reports: list[RetrainReport] = []
    for _ in range(retrains):
        reports.append(engine.retrain())
        if on_retrain is not None:
            on_retrain(reports[-1])
        if not reports[-1].accepted or reports[-1].n_steps == 0:
            break
    return reports


def read_journal(path: str | os.PathLike[str], spec: TraceSpec) -> Dataset:
    """The labelled traces of a cell program's journal, in order.

    A line is `label,sample,sample,...`, several channels one after the other; lines that begin with # are comments.
    DataError names the first line that does not fit the contract.
    """
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
    opened = open_store(store, must_exist=True)
    try:
        known = opened.settings()
        if "trace" not in known:
            raise StoreError(
                f"Expected the store that the cell's model was exported from, {store} knows no trace contract."
            )
        spec = TraceSpec(**json.loads(known["trace"]))
        return import_labelled(opened, read_journal(path, spec), on_traces=on_traces)
    finally:
        opened.close()


Part = tuple[NDArray[np.float32], NDArray[np.int8], NDArray[np.int64], list[str]]


def _chunks(traces: NDArray[np.float32], data: Dataset) -> Iterator[Part]:
    hashes, times = content_hash(traces), Counter[int]()
    ids = []
    for hash_ in hashes.tolist():  # equal traces within one file are events of their own
        ids.append(f"import-{hash_ & (2**64 - 1):016x}-{times[hash_]}")
        times[hash_] += 1
    for start in range(0, len(data), CHUNK):
        part = slice(start, start + CHUNK)
        yield traces[part], data.y[part], hashes[part], ids[part]


def _import_chunk(
    store: Store,
    traces: NDArray[np.float32],
    labels: NDArray[np.int8],
    hashes: NDArray[np.int64],
    ids: list[str],
    spec: TraceSpec,
    on_traces: Callable[[int], None] | None,
) -> tuple[int, int, int]:
    gate = TraceGate(spec)
    new = [i for i, id_ in enumerate(ids) if store.get_decision(id_) is None]
    faults = {i: gate(torch.from_numpy(traces[i]))[0] for i in new}
    good = [i for i in new if not faults[i]]
    if good:
        decisions = [_verified(ids[i], Reason.NO_MODEL) for i in good]
        store.put_labelled(decisions, traces[good], hashes[good], labels[good], Source.VERIFICATION)
    bad = [i for i in new if faults[i]]
    for i in bad:  # kept, but never given to training
        store.put_decision(_verified(ids[i], REASONS[faults[i]]), traces[i], int(hashes[i]), quarantined=True)
        store.put_label(ids[i], bool(labels[i]), Source.VERIFICATION, 0, None)
    if on_traces is not None:
        on_traces(len(ids))
    return len(good), len(bad), len(ids) - len(new)


def _verified(id_: str, reason: Reason) -> Decision:
    return Decision(id_, Action.VERIFY, Action.VERIFY, 0.0, 1.0, 0, 0, None, 0, reason, False, 1.0)
