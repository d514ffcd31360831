"""Importing labelled recordings into a store, as if an engine had verified each of them.

    report = import_labelled("engine.db", "recorded.npz", recipe="conv")
    DataEngine.open("engine.db").retrain()

A trace is imported once: its id comes from its content. Traces that a cell recorded itself have
other ids. `export.cell_journal` imports the journals of exported cells by `import_parts`.
"""

import math
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..decision.policy import Policy
from ..engine.decide import as_part, verify_decision
from ..engine.engine import DataEngine
from ..engine.settings import agreed_trace_spec
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
from ..store.opening import LONG_WAIT, opening
from ..store.records import NewLabel, StoredDecision
from ..traces import TraceGate, as_traces
from . import Dataset, load_dataset
from .description import Description
from .loading import description_of, own_reader

if TYPE_CHECKING:
    from ..store.opening import StoreLike
    from ..store.sql import SqlStore

CHUNK = 500  # traces committed together
RATE_TOLERANCE = 0.02  # relative error of rates that are measured from timestamps


def in_form_of(store: "StoreLike", description: Description) -> Description:
    """Return a description by which recordings get the form of the traces in a store.

    Otherwise all would count again if they came out in another length. For a new store it is
    returned as it is. The store is read, and closed if it was given by its address.
    """
    try:
        with opening(store, must_exist=True) as opened:
            trace_spec = stored_trace_spec(opened.settings())
            if opened is not store:
                opened.close()
    except StoreError:
        return (
            description  # a new store; any other error comes again when it is opened to be written
        )
    if trace_spec is None:
        return description
    stated: dict[str, Any] = {"traces.samples": trace_spec.samples}
    if trace_spec.fit != "strict":
        stated["traces.lengths"] = trace_spec.fit
    return description.with_values(stated)


def check_agreement(data: Dataset, trace_spec: TraceSpec) -> None:
    """Raise TraceError if a data set does not agree with the `TraceSpec` of a store.

    Its rate must be the same within 2 %, and its channels the same in the same order, where both
    are known. Recordings that were brought to one length must have the store's length, and be
    resampled if and only if the store's traces are.
    """
    data_spec = data.spec
    is_other_fit = data_spec.fit != trace_spec.fit and "resample" in (data_spec.fit, trace_spec.fit)
    if data.lengths is not None and (is_other_fit or data_spec.samples != trace_spec.samples):
        wanted = f"recordings brought to {trace_spec.samples} samples by {trace_spec.fit}"
        actual = f"{data.name} was to {data_spec.samples} by {data_spec.fit}"
        do = f"load it with samples={trace_spec.samples}, fit={trace_spec.fit!r}"
        raise TraceError(f"Expected {wanted}, {actual}; {do}, or what is known would count again.")
    rate = trace_spec.rate_hz or data.rate_hz
    if rate and data.rate_hz and not math.isclose(rate, data.rate_hz, rel_tol=RATE_TOLERANCE):
        actual = f"{data.name} has {data.rate_hz:g} Hz"
        raise TraceError(f"Expected traces at {rate:g} Hz, {actual}; resample it.")
    if data.channels and trace_spec.columns and data.channels != trace_spec.columns:
        wanted = ", ".join(trace_spec.columns)
        raise TraceError(f"Expected the channels {wanted}, got {', '.join(data.channels)}.")


@dataclass(frozen=True, slots=True)
class ImportReport:
    """How many labels of a data set, or of a cell's journal, an import took.

    Parameters
    ----------
    imported : int
        Labels that train.
    quarantined : int
        Labels of traces with a fault, which are stored but never train.
    repeated : int
        Labels that an earlier import took.
    resumed : bool
        Whether the store existed before.
    cut : int
        Bytes of a journal's last line that was not finished, and was left out.
    contradicted : int
        Labels that contradict those of an earlier import, and were left out.
    set_aside : str
        What of a journal was set aside, in a sentence; "" if nothing was.
    """

    imported: int
    quarantined: int
    repeated: int
    resumed: bool
    cut: int = 0
    contradicted: int = 0
    set_aside: str = ""


def import_labelled(
    store: "StoreLike",
    dataset: Any,
    recipe: Recipe | str | None = None,
    seed: int | None = None,
    on_traces: Callable[[int], None] | None = None,
    allow_import: bool = False,
) -> ImportReport:
    """Put every labelled trace of a data set into a store, in order; nothing is trained.

    Chunks of them are stored all or none: an import that was interrupted continues where it
    stopped. The same file twice counts no label twice.

    Parameters
    ----------
    store : path, URL or store
        A new store, which is created, or a used one. A store object stays open.
    dataset : object
        Anything `load_dataset` takes. Described recordings get the form of the store's traces.
    recipe, seed : optional
        Of a new store's engine, by default conv and 0. A used store has its own; others are a
        SettingError.
    on_traces : callable, optional
        Called with the number of traces that were just imported.
    allow_import : bool
        Whether classes of the user that a used store names may be imported.

    Returns
    -------
    ImportReport

    Raises
    ------
    TraceError
        If the traces do not agree with those of the store.
    """
    description = None
    if own_reader(dataset) is None:
        description = in_form_of(store, description_of(dataset, None))
    data = load_dataset(dataset, description)
    with opening(store, wait=LONG_WAIT) as opened:
        agreed = agreed_trace_spec(opened, data.spec)
        engine = DataEngine.open_or_create(
            opened, seed, recipe=recipe, trace=agreed, allow_import=allow_import
        )
    try:
        trace_spec = engine.trace or data.spec
        check_agreement(data, trace_spec)
        traces = as_traces(data.X, trace_spec)
        decisions = _verifying_decisions(traces, data)
        parts = list(zip(decisions, traces, map(as_success, data.y), strict=True))
        report = import_parts(engine.store, parts, trace_spec, engine.policy, on_traces)
    finally:
        if isinstance(store, str | os.PathLike):
            engine.close()
    return replace(report, resumed=engine.resumed)


def import_parts(
    store: "SqlStore",
    parts: Sequence[tuple[Decision, NDArray[np.float32], bool | None]],
    trace_spec: TraceSpec,
    policy: Policy,
    on_traces: Callable[[int], None] | None = None,
) -> ImportReport:
    """Put parts with their decisions into a store, in chunks that are stored all or none.

    A decision whose id has a label in the store stays as it is, and its label here is counted as
    repeated or contradicted. A trace with a fault is stored, with the fault as its decision's
    reason, but never trains.

    Parameters
    ----------
    store : SqlStore
    parts : sequence of (Decision, array of float32 of shape (C, T), bool or None)
        The decision, the trace and the label of each; None if nothing was heard of the part. A part
        whose label came later has a second row.
    trace_spec : TraceSpec
        Of the traces.
    policy : Policy
        Under which the decisions were made. It sets the propensity of each stored decision; the one
        that was passed is ignored.
    on_traces : callable, optional
        Called with the number of parts of each chunk.

    Returns
    -------
    ImportReport
        It counts labels; `resumed` is True.
    """
    gate = TraceGate(trace_spec)
    counts = Counter[str]()
    counts_silence = policy.stops == "some"
    n_silent = _count_silent(store, policy)
    for start in range(0, len(parts), CHUNK):
        new: dict[str, StoredDecision] = {}
        labels: list[NewLabel] = []
        for decision, trace, label in parts[start : start + CHUNK]:
            fault, hash_of_content = gate(torch.from_numpy(trace))
            earlier = new.get(decision.id) or store.get_decision(decision.id)
            if earlier is not None and earlier.source is not None:  # a forgotten one has a label
                counts[_repeat_of(label, earlier)] += 1
                continue
            stored = earlier
            if stored is None:
                stored = _as_stored(decision, trace, fault, hash_of_content, policy, store.clock())
                new[decision.id] = stored
            if counts_silence and decision.action is Action.ACCEPT:
                # A decision that was stored without a label was counted as silent.
                n_silent += (label is None) - (earlier is not None)
            if label is None:
                continue
            silent = 0
            if not fault:
                silent = n_silent
                n_silent = 0
            labels.append(
                NewLabel(
                    decision.id,
                    label,
                    source_of(decision.action, decision.audit, label),
                    model_version=0,
                    point=None,
                    silent=silent,
                    time=store.clock(),
                    content_hash=stored.content_hash,
                    decided=stored.time,
                )
            )
            counts["quarantined" if fault else "imported"] += 1
        store.apply_records([*new.values(), *labels])
        if on_traces is not None:
            on_traces(min(CHUNK, len(parts) - start))
    return ImportReport(
        counts["imported"],
        counts["quarantined"],
        counts["repeated"],
        resumed=True,
        contradicted=counts["contradicted"],
    )


def _count_silent(store: "SqlStore", policy: Policy) -> int:
    """Return how many accepted parts there are since the last label of which nothing was heard.

    If silence confirms a part, there is none.
    """
    if policy.stops != "some":
        return 0
    since = int(store.settings().get("policy_since", 0))
    return len(store.unreported_accepts(since)) - store.silent_total(since)


def _repeat_of(label: bool | None, earlier: StoredDecision) -> str:
    """Return what the label of a part that has one in the store counts as; "" without a label."""
    if label is None:
        return ""
    return "repeated" if label == earlier.success else "contradicted"


def _as_stored(
    decision: Decision,
    trace: NDArray[np.float32],
    fault: int,
    hash_of_content: int,
    policy: Policy,
    time: float,
) -> StoredDecision:
    """Return the record of a decision; a trace with a fault never trains, and is its reason.

    fault : position in `REASONS`, 0 for none.
    """
    is_certain = decision.predicted is not Action.VERIFY
    propensity = policy.audited_share if is_certain else 1.0
    reason = REASONS[fault] if fault else decision.reason
    made = replace(decision, reason=reason, propensity=propensity)
    part_hash = trace_hash(hash_of_content, decision.part)
    return StoredDecision(made, trace.copy(), part_hash, bool(fault), time)


def _verifying_decisions(traces: NDArray[np.float32], data: Dataset) -> Iterator[Decision]:
    """Yield for each trace, of shape (n, C, T), the decision to verify it without a model.

    Its id is made of the trace's content; equal traces of one data set have different ids.
    """
    n_equal = Counter[int]()
    parts: list[str | None] = [None] * len(data)
    if data.part is not None:
        parts = [as_part(part) for part in data.part.tolist()]
    for hash_, part in zip(content_hash(traces).tolist(), parts, strict=True):
        decision_id = f"import-{hash_ & (2**64 - 1):016x}-{n_equal[hash_]}"
        yield verify_decision(decision_id, part, 0, Reason.NO_MODEL)
        n_equal[hash_] += 1
