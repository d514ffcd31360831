"""Recorded traces with labels, put into a store as if an engine had verified each of them.

    report = import_labelled("engine.db", "recorded.npz", recipe="conv")
    DataEngine.open("engine.db").retrain()
    report = import_journal("engine.db", "cell.csv")       # what a cell program learned on its own

A trace is imported once: its id comes from its content, so an import that was interrupted goes on where it stopped, and
the same file twice counts no label twice. Traces that a cell recorded itself have other ids and are not recognised.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .datasets import Dataset, load_dataset
from .deciding import source_of
from .decision.policy import Policy
from .engine import DataEngine
from .errors import DataError, StoreError
from .folds import content_hash, own_hash
from .forms import form_in, must_agree
from .recipe import Recipe
from .records import REASONS, Action, Decision, Reason, RetrainReport, Source, TraceSpec
from .settings import trace_in
from .store.base import NewLabel, Store, opening
from .traces import TraceGate, as_trace, as_traces

CHUNK = 500  # traces committed together
LABELS = {"1": True, "0": False}


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
    data = load_dataset(dataset, **form_in(store, dataset))
    spec = data.spec
    engine = DataEngine.open_or_create(store, seed, recipe=recipe)
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


@dataclass(frozen=True, slots=True)
class JournalLine:
    """A part in a cell program's journal: its trace (C, T), its label, and what was decided on it, as in `Decision`.

    label : None where nothing was heard of an accepted part.
    """

    trace: NDArray[np.float32]
    label: bool | None
    part: str | None = None
    action: Action = Action.VERIFY
    predicted: Action = Action.VERIFY
    reason: Reason = Reason.NO_MODEL
    lower: float = 0.0
    upper: float = 1.0
    n_success: int = 0
    n_failure: int = 0


def read_journal(path: str | os.PathLike[str], spec: TraceSpec) -> list[JournalLine]:
    """The lines of a cell program's journal, in order.

    A line is `label,part,action,predicted,reason,lower,upper,n_success,n_failure,sample,sample,...`, several channels one
    after the other, where the first line begins with `# dengine 2`, and `label,sample,sample,...`, of verified parts,
    where it does not. Lines that begin with # are comments. DataError names the first line that does not fit.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"Cannot read the journal {path}: {error}; copy it again from the cell.") from error
    read = _read_line if text.startswith("# dengine 2 ") else _read_first_form
    found = [
        read(line.split(","), spec, f"line {number} of {path}")
        for number, line in enumerate(text.split("\n"), start=1)
        if line.strip() and not line.startswith("#")
    ]
    if not found:
        raise DataError(f"{path} holds no labels yet.")
    return found


def _read_line(words: list[str], spec: TraceSpec, where: str) -> JournalLine:
    trace = _read_trace(words[9:], spec, where)
    label, part, *decided = words[:9]
    try:
        action, predicted = Action(decided[0]), Action(decided[1])
        bound = float(decided[3]), float(decided[4]), int(decided[5]), int(decided[6])
        reason = Reason(decided[2])
    except ValueError as error:
        raise DataError(f"The decision in {where} cannot be read: {error}.") from error
    silent = label == "" and action is Action.ACCEPT
    if action is Action.REJECT or not (silent or label in LABELS):
        raise DataError(f"Expected a verified part with a label of 1 or 0, or an accepted one, in {where}, got {label!r}.")
    return JournalLine(trace, LABELS.get(label), part or None, action, predicted, reason, *bound)


def _read_first_form(words: list[str], spec: TraceSpec, where: str) -> JournalLine:
    trace = _read_trace(words[1:], spec, where)
    if words[0] not in LABELS:
        raise DataError(f"Expected a label of 1 or 0 in {where}, got {words[0][:20]!r}.")
    return JournalLine(trace, LABELS[words[0]])


def _read_trace(words: list[str], spec: TraceSpec, where: str) -> NDArray[np.float32]:
    expected = spec.channels * spec.samples
    if len(words) != expected and (spec.fit == "strict" or len(words) % spec.channels):
        raise DataError(
            f"Expected {expected} samples in {where}, got {len(words)}; a last line that was cut can be removed."
        )
    try:
        with np.errstate(over="ignore"):
            values = np.array([float(word) for word in words]).astype(np.float32)
    except ValueError as error:
        raise DataError(f"The samples in {where} are no row of numbers: {error}.") from error
    return as_trace(values.reshape(spec.channels, -1), spec)


def import_journal(
    store: str | os.PathLike[str], path: str | os.PathLike[str], on_traces: Callable[[int], None] | None = None
) -> ImportReport:
    """Put what a cell learned into the store of its engine, each part once, however often its journal is imported.

    Parts keep their numbers, the bounds that they were decided by and the sources of their labels, so that the rule and the
    certificate count them as the engine's own. The report counts labels.
    """
    with opening(store, must_exist=True) as opened:
        known = opened.settings()
        spec = trace_in(known)
        if spec is None or "recipe" not in known:
            raise StoreError(
                f"Expected the store that the cell's model was exported from, {store} knows no trace contract."
            )
        policy = Recipe.from_toml(known["recipe"]).policy
        lines = _with_known_outcomes(read_journal(path, spec), policy.stops)
        report = _import_lines(opened, lines, spec, policy, on_traces)
    opened.close()
    return report


def _with_known_outcomes(lines: list[JournalLine], stops: str) -> list[JournalLine]:
    """Where all stops are reported, the next decision confirmed an accepted part; of the last one nothing is known yet."""
    if stops == "some":
        return lines
    known = lines if lines[-1].label is not None else lines[:-1]
    return [replace(line, label=True) if line.label is None else line for line in known]


def _import_lines(
    store: Store, lines: list[JournalLine], spec: TraceSpec, policy: Policy, on_traces: Callable[[int], None] | None
) -> ImportReport:
    gate, counts = TraceGate(spec), Counter[str]()
    looks = [gate(torch.from_numpy(line.trace)) for line in lines]
    ids = _ids(np.array([hash_ for _, hash_ in looks], dtype=np.int64))
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
                counts["known"] += 1
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
    return ImportReport(counts["imported"], counts["quarantined"], counts["known"], True)


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
