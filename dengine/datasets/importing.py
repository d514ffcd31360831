"""Recorded traces with labels, put into a store as if an engine had verified each of them.

    report = import_labelled("engine.db", "recorded.npz", recipe="conv")
    DataEngine.open("engine.db").retrain()
    report = import_journal("engine.db", "cell.csv")       # what a cell program learned on its own

A trace is imported once: its id comes from its content, so an import that was interrupted goes on where it stopped, and
the same file twice counts no label twice. Traces that a cell recorded itself have other ids and are not recognised.

The form in which a store has its recordings, for those that come later.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..decision.policy import Policy
from ..engine.decide import source_of
from ..engine.engine import DataEngine
from ..errors import DataError, StoreError, TraceError
from ..export.cell_journal import Journal, JournalLine, read_journal
from ..folds import content_hash, own_hash
from ..recipe import Recipe
from ..records import REASONS, Action, Decision, Reason, RetrainReport, Source, TraceSpec, trace_in
from ..store.base import UNHURRIED, NewLabel, Store, opening
from ..store.outbox import OwnedStore
from ..traces import TraceGate, as_traces
from . import Dataset, load_dataset
from .loading import TABLES

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


EXPORTED = "export"  # the kind of the events that note a model's sum
CHUNK = 500  # traces committed together


@dataclass(frozen=True, slots=True)
class ImportReport:
    """What became of a data set's traces: taken in, taken in but kept from training, or known from an earlier import.

    cut : bytes of a journal's last line that was not finished, and was left out.
    contradicted : labels that say the opposite of what an earlier import took in, and were left out.
    """

    imported: int
    quarantined: int
    known: int
    resumed: bool
    cut: int = 0
    contradicted: int = 0


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
    data = load_dataset(dataset, **form_in(store, dataset))
    spec = data.spec
    engine = DataEngine.open_or_create(store, seed, wait=UNHURRIED, recipe=recipe)
    try:
        agreed = engine.agree_on(spec)
        must_agree(data, agreed)
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


def import_journal(
    store: str | os.PathLike[str] | Store,
    path: str | os.PathLike[str],
    on_traces: Callable[[int], None] | None = None,
    any_model: bool = False,
) -> ImportReport:
    """Put what a cell learned into the store of its engine, each part once, however often its journal is imported.

    Parts keep their numbers, the bounds that they were decided by and the sources of their labels, so that the rule and the
    certificate count them as the engine's own. The report counts labels.
    any_model : take a journal of a model that the store has not noted as exported from it.
    Raises DataError, before anything is stored, for a journal that is damaged, or of a model of another store; StoreError
    while an engine runs on the cell.
    """
    with opening(store, must_exist=True) as opened:
        if isinstance(opened, OwnedStore):
            opened.own()  # an engine that runs would never learn of these labels
        known = opened.settings()
        spec = trace_in(known)
        if spec is None or "recipe" not in known:
            raise StoreError(
                f"Expected the store that the cell's model was exported from, {store} knows no trace contract."
            )
        policy = Recipe.from_toml(known["recipe"]).policy
        journal = read_journal(path, spec)
        if not any_model:
            _must_be_of(opened, journal, path)
        lines = _with_known_outcomes(journal, policy.stops)
        report = _import_lines(opened, lines, spec, policy, on_traces)
    opened.close()
    return replace(report, cut=journal.cut)


def _must_be_of(store: Store, journal: Journal, path: str | os.PathLike[str]) -> None:
    """DataError where a journal's model was not exported from the store. Earlier forms are of exports not noted always."""
    exports = {event.text.split()[0] for event in store.events() if event.kind == EXPORTED}
    if journal.version > 2 and exports and journal.sum not in exports:
        raise DataError(
            f"Expected a journal of a model that was exported from this store, {path} belongs to {journal.sum[:12]}…, "
            "which is none of its exports; name the store that it came from, or say --any-model if it is right."
        )


def _with_known_outcomes(journal: Journal, stops: str) -> list[JournalLine]:
    """Where all stops are reported, the next decision confirmed an accepted part, unless its stop came late.

    Of the last part nothing is known yet.
    """
    if stops == "some":
        return journal.lines
    late = {line.id: line.label for line in journal.lines if line.late}
    waits = [line for line in journal.lines if line.label is None][-1:] if journal.waits else []
    return [
        replace(line, label=True) if line.label is None else line
        for line in journal.lines
        if not any(line is each for each in waits) and not _is_elsewhere(line, late.get(line.id) if line.id else None)
    ]


def _is_elsewhere(line: JournalLine, late: bool | None) -> bool:
    """Whether another line brings an accepted part's label: the late one its stop, the first one its confirmation."""
    return line.action is Action.ACCEPT and late is not None and line.late == late


def _import_lines(
    store: Store, lines: list[JournalLine], spec: TraceSpec, policy: Policy, on_traces: Callable[[int], None] | None
) -> ImportReport:
    gate, counts = TraceGate(spec), Counter[str]()
    looks = [gate(torch.from_numpy(line.trace)) for line in lines]
    made = _ids(np.array([hash_ for _, hash_ in looks], dtype=np.int64))
    ids = [line.id or id_ for line, id_ in zip(lines, made, strict=True)]
    counts_silence = policy.stops == "some"
    since = int(store.settings().get("policy_since", 0))
    silent = len(store.unreported_accepts(since)) - store.silent_total(since) if counts_silence else 0
    for start in range(0, len(lines), CHUNK):
        labels: list[NewLabel] = []
        for i in range(start, min(start + CHUNK, len(lines))):
            line, (fault, hash_), held = lines[i], looks[i], store.get_decision(ids[i])
            if held is None:
                decision = _decided(ids[i], line, fault, policy.audit_rate)
                store.put_decision(decision, line.trace, own_hash(hash_, line.part), bool(fault), line.part)
            elif held.source is not None:  # a forgotten one has a label too
                if line.label is not None:
                    counts["known" if line.label == held.success else "contradicted"] += 1
                continue
            if counts_silence and line.action is Action.ACCEPT:  # one that was held without a label was counted as silent
                silent += (line.label is None) - (held is not None)
            if line.label is not None:
                source = source_of(ids[i], line.action, line.reason is Reason.AUDIT, line.label)
                labels.append(NewLabel(ids[i], line.label, source, 0, None, 0 if fault else silent))
                silent = silent if fault else 0
                counts["quarantined" if fault else "imported"] += 1
        if labels:
            store.put_labels(labels)
        if on_traces is not None:
            on_traces(min(CHUNK, len(lines) - start))
    store.flush()
    return ImportReport(
        counts["imported"], counts["quarantined"], counts["known"], True, contradicted=counts["contradicted"]
    )


def _decided(id_: str, line: JournalLine, fault: int, audit_rate: float) -> Decision:
    audit, reason = line.reason is Reason.AUDIT, REASONS[fault] if fault else line.reason
    counted = line.lower, line.upper, line.n_success, line.n_failure
    propensity = 1.0 if line.predicted is Action.VERIFY else audit_rate
    return Decision(id_, line.action, line.predicted, *counted, None, 0, reason, audit, propensity, line.part)


Part = tuple[NDArray[np.float32], NDArray[np.int8], NDArray[np.int64], list[str], list[str | None]]


def _chunks(traces: NDArray[np.float32], data: Dataset) -> Iterator[Part]:
    hashes = content_hash(traces)
    ids = _ids(hashes)
    for start in range(0, len(data), CHUNK):
        part = slice(start, start + CHUNK)
        numbers = [None] * len(ids[part]) if data.part is None else data.part[part].tolist()
        yield traces[part], data.y[part], hashes[part], ids[part], numbers


def _ids(hashes: NDArray[np.int64]) -> list[str]:
    ids, times = [], Counter[int]()
    for hash_ in hashes.tolist():  # equal traces within one file are events of their own
        ids.append(f"import-{hash_ & (2**64 - 1):016x}-{times[hash_]}")
        times[hash_] += 1
    return ids


def _import_chunk(
    store: Store,
    traces: NDArray[np.float32],
    labels: NDArray[np.int8],
    hashes: NDArray[np.int64],
    ids: list[str],
    parts: list[str | None],
    spec: TraceSpec,
    on_traces: Callable[[int], None] | None,
) -> tuple[int, int, int]:
    gate = TraceGate(spec)
    own = np.array([own_hash(*each) for each in zip(hashes.tolist(), parts, strict=True)], dtype=np.int64)
    new = [i for i, id_ in enumerate(ids) if store.get_decision(id_) is None]
    faults = {i: gate(torch.from_numpy(traces[i]))[0] for i in new}
    good = [i for i in new if not faults[i]]
    if good:
        decisions = [_verified(ids[i], Reason.NO_MODEL, parts[i]) for i in good]
        numbers = [parts[i] for i in good]
        store.put_labelled(decisions, traces[good], own[good], labels[good], Source.VERIFICATION, numbers)
    bad = [i for i in new if faults[i]]
    for i in bad:  # kept, but never given to training
        decision = _verified(ids[i], REASONS[faults[i]], parts[i])
        store.put_decision(decision, traces[i], int(own[i]), quarantined=True, part=parts[i])
        store.put_label(ids[i], bool(labels[i]), Source.VERIFICATION, 0, None)
    if on_traces is not None:
        on_traces(len(ids))
    return len(good), len(bad), len(ids) - len(new)


def _verified(id_: str, reason: Reason, part: str | None) -> Decision:
    return Decision(id_, Action.VERIFY, Action.VERIFY, 0.0, 1.0, 0, 0, None, 0, reason, False, 1.0, part)
