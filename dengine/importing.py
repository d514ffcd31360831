"""Recorded traces with labels, put into a store as if an engine had verified each of them.

    report = import_labelled("engine.db", "recorded.npz", recipe="conv")
    DataEngine.open("engine.db").retrain()

A trace is imported once: its id comes from its content, so an import that was interrupted goes on where it stopped, and
the same file twice counts no label twice. Traces that a cell recorded itself have other ids and are not recognised.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .datasets import Dataset, load_dataset
from .engine import DataEngine
from .errors import SettingError, TraceError
from .folds import content_hash
from .recipe import Recipe
from .records import Action, Decision, Reason, RetrainReport, Source, TraceSpec
from .store import Store, open_store
from .traces import REASONS, TraceGate, as_traces

CHUNK = 500  # traces committed together


@dataclass(frozen=True, slots=True)
class ImportReport:
    """What became of a data set's traces: taken in, taken in but kept from training, or known from an earlier import."""

    imported: int
    quarantined: int
    known: int
    resumed: bool


def open_engine(
    store: str | os.PathLike[str] | Store | None,
    recipe: Recipe | str | None = None,
    seed: int | None = None,
    trace: TraceSpec | None = None,
) -> tuple[DataEngine, bool]:
    """Go on with a store that has been used, or start on a new one; True where it had been used.

    recipe, seed : of a new engine; conv and 0 by default. A used store has its own, and asking it for others is an error.
    """
    opened = open_store(store)
    if not opened.settings():
        return DataEngine.from_recipe(recipe or "conv", opened, seed=seed or 0, trace=trace), False
    engine = DataEngine.open(opened)
    have = _flat(engine.recipe) | {"seed": engine.seed}
    asked = (_flat(Recipe.load(recipe)) if recipe else {}) | ({} if seed is None else {"seed": seed})
    changed = [name for name in asked if asked[name] != have.get(name)]
    if changed:
        engine.close()
        stored, other = (", ".join(f"{name} {values.get(name)}" for name in changed) for values in (have, asked))
        raise SettingError(
            f"Expected the store's own settings ({stored}), got {other}; leave them out or name a new store."
        )
    return engine, True


def _flat(recipe: Recipe) -> dict[str, Any]:
    plain = asdict(recipe)
    policy: dict[str, Any] = plain.pop("policy")
    return plain | policy


def import_labelled(
    store: str | os.PathLike[str] | Store,
    dataset: Any,
    recipe: Recipe | str | None = None,
    seed: int | None = None,
    on_traces: Callable[[int], None] | None = None,
) -> ImportReport:
    """Put every labelled trace of a data set into a new or a used store, in order, in chunks that are all or none.

    dataset : anything `load_dataset` takes.  recipe, seed : as in `open_engine`.
    on_traces : called with the number of traces that were just dealt with.
    Raises TraceError where the traces break the contract that the store's engine agreed on.
    """
    data = load_dataset(dataset)
    spec = TraceSpec(data.X.shape[-1], data.rate_hz, 1 if data.X.ndim == 2 else data.X.shape[1], data.unit)
    engine, resumed = open_engine(store, recipe, seed, spec)
    try:
        agreed = engine.trace or _agree(engine.store, spec)
        if agreed.rate_hz != spec.rate_hz:
            raise TraceError(f"Expected traces at {agreed.rate_hz:g} Hz, {data.name} has {spec.rate_hz:g} Hz; resample it.")
        traces = as_traces(data.X, agreed)
        counts = [_import_chunk(engine.store, *part, agreed, on_traces) for part in _chunks(traces, data)]
    finally:
        if not isinstance(store, Store):
            engine.close()
    imported, quarantined, known = (sum(column) for column in zip(*counts, strict=True))
    return ImportReport(imported, quarantined, known, resumed)


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


def _agree(store: Store, spec: TraceSpec) -> TraceSpec:
    # A used store whose engine never saw a trace: the import's first one sets the contract, as `decide` would have.
    store.save_settings(store.settings() | {"trace": json.dumps(asdict(spec))})
    return spec


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
