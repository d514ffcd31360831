"""Labelled recordings, put into a store as if an engine had verified each of them.

    report = import_labelled("engine.db", "recorded.npz", recipe="conv")
    DataEngine.open("engine.db").retrain()

A trace is imported once: its id comes from its content. Traces that a cell recorded itself have other ids.
"""

import math
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..decision.policy import Policy
from ..engine.decide import as_part
from ..engine.engine import DataEngine, core_of
from ..errors import StoreError, TraceError
from ..folds import content_hash, trace_hash
from ..recipe import Recipe
from ..records import (
    REASONS,
    Action,
    Decision,
    Reason,
    TraceSpec,
    as_success,
    source_of,
    stored_trace_spec,
)
from ..store.opening import UNHURRIED, opening
from ..store.records import NewLabel, StoredDecision
from ..traces import TraceGate, as_traces
from . import Dataset, load_dataset
from .loading import TABLES

if TYPE_CHECKING:
    from ..store.opening import StoreLike
    from ..store.sql import SqlStore

CHUNK = 500  # traces committed together
RATE = 0.02  # as near as rates that are measured from timestamps come to each other


def form_in(store: "StoreLike", source: Any) -> dict[str, Any]:
    """The `samples` and `fit` that give recordings the form of those in a store; empty for a new store, or other sources.

    Files that are added change the median that lengths are padded to: all others would come out changed, and count again.
    """
    if not isinstance(source, str | os.PathLike) or not (
        Path(source).is_dir() or Path(source).suffix.lower() in TABLES
    ):
        return {}
    try:
        with opening(store, must_exist=True) as opened:
            agreed = stored_trace_spec(opened.settings())
            if opened is not store:
                opened.close()
    except StoreError:
        return {}  # a new one; what else is wrong is found when it is opened to write
    return (
        {}
        if agreed is None
        else {"samples": agreed.samples, "fit": None if agreed.fit == "strict" else agreed.fit}
    )


def must_agree(data: Dataset, agreed: TraceSpec) -> None:
    """TraceError where a data set has another rate or other channels, or was brought to its length in another way."""
    spec = data.spec
    stretched = spec.fit != agreed.fit and "resample" in (spec.fit, agreed.fit)
    if data.lengths is not None and (stretched or spec.samples != agreed.samples):
        do = f"load it with samples={agreed.samples}, fit={agreed.fit!r}, or what is known would count again"
        wanted = f"recordings brought to {agreed.samples} samples by {agreed.fit}"
        raise TraceError(
            f"Expected {wanted}, {data.name} was to {spec.samples} by {spec.fit}; {do}."
        )
    if data.rate_hz is not None and not math.isclose(agreed.rate_hz, spec.rate_hz, rel_tol=RATE):
        raise TraceError(
            f"Expected traces at {agreed.rate_hz:g} Hz, {data.name} has {spec.rate_hz:g} Hz; resample it."
        )
    if data.channels and agreed.columns and data.channels != agreed.columns:
        raise TraceError(
            f"Expected the channels {', '.join(agreed.columns)}, got {', '.join(data.channels)}."
        )


@dataclass(frozen=True, slots=True)
class ImportReport:
    """What became of a data set's traces: taken in, taken in but kept from training, or known from an earlier import.

    cut : bytes of a journal's last line that was not finished, and was left out.
    contradicted : labels that say the opposite of what an earlier import took in, and were left out.
    aside : what of a journal was set aside, in a sentence; "" where nothing was.
    """

    imported: int
    quarantined: int
    known: int
    resumed: bool
    cut: int = 0
    contradicted: int = 0
    aside: str = ""


def import_labelled(
    store: "StoreLike",
    dataset: Any,
    recipe: Recipe | str | None = None,
    seed: int | None = None,
    on_traces: Callable[[int], None] | None = None,
    allow_import: bool = False,
) -> ImportReport:
    """Put every labelled trace of a data set into a new or a used store, in order, in chunks that are all or none.

    An import that was interrupted goes on where it stopped, and the same file twice counts no label twice.

    dataset : anything `load_dataset` takes.
    recipe, seed : of a new store's engine, conv and 0 by default; a used store has its own, and others are a SettingError.
    on_traces : called with the number of traces that were just dealt with.  allow_import : as for `DataEngine.open`.
    Raises TraceError where the traces break the contract that the store's engine agreed on.
    """
    data = load_dataset(dataset, **form_in(store, dataset))
    engine = DataEngine.open_or_create(
        store, seed, wait=UNHURRIED, recipe=recipe, allow_import=allow_import
    )
    try:
        agreed = core_of(engine).set_trace_spec(data.spec)
        must_agree(data, agreed)
        traces = as_traces(data.X, agreed)
        parts = list(zip(_verified(traces, data), traces, map(as_success, data.y), strict=True))
        report = import_parts(engine.store, parts, agreed, engine.policy, on_traces)
    finally:
        if isinstance(store, str | os.PathLike):
            engine.close()
    return replace(report, resumed=engine.resumed)


def import_parts(
    store: "SqlStore",
    parts: Sequence[tuple[Decision, NDArray[np.float32], bool | None]],
    spec: TraceSpec,
    policy: Policy,
    on_traces: Callable[[int], None] | None = None,
) -> ImportReport:
    """Put parts, each with its decision, its trace (C, T) and its label, None where nothing was heard of it, into a store.

    A part has a second row where its label came later. The report counts labels.
    """
    gate, counts, silent = TraceGate(spec), Counter[str](), 0
    if counts_silence := policy.stops == "some":
        since = int(store.settings().get("policy_since", 0))
        silent = len(store.unreported_accepts(since)) - store.silent_total(since)
    for start in range(0, len(parts), CHUNK):
        made: dict[str, StoredDecision] = {}
        labels: list[NewLabel] = []
        for decision, trace, label in parts[start : start + CHUNK]:
            fault, hash_ = gate(torch.from_numpy(trace))
            held = made.get(decision.id) or store.get_decision(decision.id)
            if held is not None and held.source is not None:  # a forgotten one has a label too
                if label is not None:
                    counts["known" if label == held.success else "contradicted"] += 1
                continue
            if (known := held) is None:
                propensity = 1.0 if decision.predicted is Action.VERIFY else policy.audited_share
                reason = (
                    REASONS[fault] if fault else decision.reason
                )  # a bad one is kept, but never given to training
                new = replace(decision, reason=reason, propensity=propensity)
                known = StoredDecision(new, trace.copy(), trace_hash(hash_, decision.part), bool(fault), store.clock())
                made[decision.id] = known
            if (
                counts_silence and decision.action is Action.ACCEPT
            ):  # one held without a label was counted as silent
                silent += (label is None) - (held is not None)
            if label is not None:
                source = source_of(decision.action, decision.audit, label)
                of = decision.id, label, source, 0, None, 0 if fault else silent
                labels.append(NewLabel(*of, store.clock(), known.content_hash, known.time))
                silent = silent if fault else 0
                counts["quarantined" if fault else "imported"] += 1
        store.apply_records([*made.values(), *labels])
        if on_traces is not None:
            on_traces(min(CHUNK, len(parts) - start))
    taken = counts["imported"], counts["quarantined"], counts["known"]
    return ImportReport(*taken, resumed=True, contradicted=counts["contradicted"])


def _verified(traces: NDArray[np.float32], data: Dataset) -> Iterator[Decision]:
    """For each of the traces (n, C, T) the decision that verified it."""
    times = Counter[int]()
    parts = (
        [None] * len(data) if data.part is None else [as_part(part) for part in data.part.tolist()]
    )
    for hash_, part in zip(content_hash(traces).tolist(), parts, strict=True):
        id_ = f"import-{hash_ & (2**64 - 1):016x}-{times[hash_]}"  # equal traces within one file are events of their own
        times[hash_] += 1
        nothing = (0.0, 1.0, 0, 0, None, 0)
        yield Decision(
            id_, Action.VERIFY, Action.VERIFY, *nothing, Reason.NO_MODEL, False, 1.0, part
        )
