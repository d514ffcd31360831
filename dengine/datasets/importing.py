"""Importing labelled recordings into a store, as if an engine had verified each of them.

    report = import_labelled("engine.db", "recorded.npz", recipe="conv")
    DataEngine.open("engine.db").retrain()

A trace is imported once: its id comes from its content. Traces that a cell recorded itself have
other ids. `export.cell_journal` imports the journals of exported cells by `import_parts`.
"""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch

from ..decision.policy import Policy
from ..engine.decide import as_part, verify_decision
from ..engine.engine import DataEngine
from ..engine.settings import agreed_trace_spec
from ..errors import StoreError, TraceError, expect
from ..folds import content_hash, trace_hash
from ..recipe import Recipe
from ..records import (
    REASONS,
    Action,
    Decision,
    Reason,
    TraceArray,
    TraceSpec,
    as_success,
    source_of,
    stored_trace_spec,
)
from ..store.opening import LONG_WAIT, opening
from ..store.records import NewLabel, StoredDecision
from ..traces import TraceGate, as_traces
from .dataset import Dataset, Progress
from .description import Description
from .loading import description_of, load_dataset, own_reader

if TYPE_CHECKING:
    from ..store.opening import StoreLike
    from ..store.sql import SqlStore

CHUNK = 500  # traces committed together
RATE_TOLERANCE = 0.02  # relative error of rates that are measured from timestamps


def in_form_of(store: "StoreLike", description: Description) -> Description:
    """Return a description with the trace length of a store, for recordings to be imported into it.

    The description says how the recordings are read. In the result `traces.samples` is the number
    of samples in the store's `TraceSpec` (the shape and rate of its traces), and `traces.lengths`,
    which says what happens to recordings of another length, is its `fit` unless that is "strict".
    Traces of another length would have other hashes, so those that the store has would be imported
    again. The description is returned as it is if the store is new, cannot be opened, or has no
    readable `TraceSpec`. `store` is a path or URL, or an open store, which stays open.
    """
    try:
        with opening(store, must_exist=True) as opened:
            spec = stored_trace_spec(opened.settings.read())
    except StoreError:
        return description  # a new store; another error comes again when it is opened to be written
    if opened is not store:
        opened.close()
    if spec is None:
        return description
    lengths = {} if spec.fit == "strict" else {"traces.lengths": spec.fit}
    return description.with_values({"traces.samples": spec.samples, **lengths})


def check_agreement(data: Dataset, trace_spec: TraceSpec) -> None:
    """Raise TraceError if a data set does not agree with `trace_spec`, that of a store.

    If both rates are known, they must be the same within 2 % of the higher one; if both have
    channel names, these must be the same in the same order. Traces of recordings, whose original
    lengths are in `data.lengths`, must have the store's number of samples. For them, too, `fit`
    (what happens to traces of another length) must be "resample" both in the store and in the data
    set, or in neither. The number of channels, the units and the range of the sensor (`limit`) are
    not compared. Raises SettingError if no `TraceSpec` can be made of the data set (`data.spec`).
    """
    spec = data.spec
    fits_agree = (spec.fit == "resample") == (trace_spec.fit == "resample")
    expect(
        data.lengths is None or (spec.samples == trace_spec.samples and fits_agree),
        f"recordings brought to {trace_spec.samples} samples by {trace_spec.fit}",
        (spec.samples, spec.fit),
        "state these in [traces], or what is known would count again",
        TraceError,
    )
    rates = (trace_spec.rate_hz, spec.rate_hz)
    expect(
        None in rates or math.isclose(*rates, rel_tol=RATE_TOLERANCE),  # type: ignore[arg-type]
        f"traces at {rates[0]} Hz",
        rates[1],
        "resample them",
        TraceError,
    )
    names = trace_spec.columns
    expect(
        spec.columns in ((), names) or not names,
        f"the channels {', '.join(names)}",
        spec.columns,
        error=TraceError,
    )


@dataclass(frozen=True, slots=True)
class ImportReport:
    """How many labels of a data set, or of a cell's journal, an import stored.

    Parameters
    ----------
    imported : int
        Labels that were stored and train.
    quarantined : int
        Labels of traces with a fault, which are stored but never train.
    repeated : int
        Labels that the store had already, also of parts whose label was withdrawn.
    resumed : bool
        Whether the store existed before.
    cut : int
        Bytes of a journal's unfinished last line, which were left out.
    contradicted : int
        Labels that contradict the stored label of their part, and were left out.
    set_aside : str
        A sentence on what of a journal was set aside; "" if nothing was.
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
    on_traces: Progress | None = None,
    allow_import: bool = False,
) -> ImportReport:
    """Put every labelled trace of a data set into a store, in order; nothing is trained.

    The traces are stored in chunks, each in one transaction: if an import is interrupted, the same
    call continues it. Traces are recognised by their samples: as many equal traces as the store has
    from earlier imports are not stored again; those that a robot cell recorded itself do not count.

    Parameters
    ----------
    store : path, URL or store
        A new store, which is created, or a used store. A store object stays open, and so does the
        engine that this call makes on it; but if the engine cannot be made, the store object may be
        closed.
    dataset : object
        Anything `load_dataset` takes. Recordings that are read by a description are brought to the
        length of the store's traces.
    recipe, seed : optional
        Settings (a `Recipe`, a name like "conv", or a TOML file) and random seed of the engine of a
        new store; by default those of another robot cell in the database that makes the same
        product, or else recipe conv and seed 0. A used store has its own recipe and seed; other
        values raise SettingError.
    on_traces : callable, optional
        Called after each chunk with its number of traces, also those that the store had already.
    allow_import : bool
        Whether a user's own classes, like a reducer, that a used store names may be imported; if
        not, such a store raises ImportRefusedError, a SettingError.

    Returns
    -------
    ImportReport
        How many labels were stored, or stored with a faulty trace and never used in training
        (quarantined), how many the store had already, and how many were left out because they
        contradict a stored label.

    Raises
    ------
    TraceError
        If the traces do not agree with those of the store, or a part's number is empty, longer than
        200 characters or has characters that do not print. A store that was new exists then.
    DataError
        If the data set cannot be read, see `load_dataset`; then no store is created.
    SettingError
        If the recipe is wrong, recipe or seed are not those of a used store, or `windows.trigger`
        of the description, the condition at which long recordings are cut, is malformed.
    StoreError
        If the store cannot be opened or written, or another engine runs on it; chunks before the
        error stay.
    """
    description = None
    if own_reader(dataset) is None:
        description = in_form_of(store, description_of(dataset))
    data = load_dataset(dataset, description)
    with opening(store, wait=LONG_WAIT) as opened:
        engine = DataEngine.open_or_create(
            opened,
            seed,
            recipe=recipe,
            trace=agreed_trace_spec(opened, data.spec),
            allow_import=allow_import,
        )
    try:
        trace_spec = engine.trace or data.spec
        check_agreement(data, trace_spec)
        traces = as_traces(data.X, trace_spec)
        parts = [
            *zip(_verifying_decisions(traces, data), traces, map(as_success, data.y), strict=True)
        ]
        report = import_parts(engine.store, parts, trace_spec, engine.policy, on_traces)
    finally:
        if opened is not store:
            engine.close()
    return replace(report, resumed=engine.resumed)


def import_parts(
    store: "SqlStore",
    parts: Sequence[tuple[Decision, TraceArray, bool | None]],
    trace_spec: TraceSpec,
    policy: Policy,
    on_traces: Progress | None = None,
) -> ImportReport:
    """Store parts with their decisions and labels, in chunks of 500.

    Each chunk is one transaction; if storing one raises StoreError, those before stay. If the store
    has a label for a decision, also one that was withdrawn, nothing is changed: the new label is
    counted as contradicted if it differs from one that counts, and otherwise as repeated. A
    decision that it has without a label stays as it is, too, and gets only the label. New rows have
    the time of the import. A trace with a fault (like a NaN, or a value at the limit of the sensor)
    is stored but never used in training, and its decision gets the fault as its reason. If
    `policy.stops` is "some" (a missing report on an accepted part says nothing), each label also
    stores the number of accepted parts without a report since the label before, or since the last
    change of the policy; the label of a trace with a fault stores 0, and the next label counts
    these parts.

    Parameters
    ----------
    store : SqlStore
    parts : sequence of (Decision, array of float32 of shape (C, T), bool or None)
        The decision, the trace and the label of each part; None if there is no report. A part
        whose label came later may stand in the sequence a second time, with the label.
    trace_spec : TraceSpec
        Shape of the traces, and the range of the sensor, by which faults are found.
    policy : Policy
        The policy under which the decisions were made. Each stored decision gets its propensity,
        the probability of a check, from it; `Decision.propensity` is not read.
    on_traces : callable, optional
        Called with the number of parts of each chunk after it was stored.

    Returns
    -------
    ImportReport
        It counts labels, not parts: those that were stored, stored with a faulty trace
        (quarantined), known already and contradicted. `resumed` is True, whatever the store was.

    Raises
    ------
    StoreError
        If the store cannot be read or written.
    """
    gate = TraceGate(trace_spec.channels * trace_spec.samples)
    limit = trace_spec.limit or math.inf
    counts: Any = Counter(imported=0, quarantined=0, repeated=0)
    # The accepted parts without a report since the last label that counted them, or since the last
    # change of the policy. Otherwise the next decision confirms an accepted part.
    counts_unreported = policy.stops == "some"
    n_unreported = 0
    if counts_unreported:
        since = int(store.settings.read().get("policy_since", 0))
        n_unreported = len(store.decisions.unreported_accepts(since))
        n_unreported -= store.labels.unreported_total(since)
    for start in range(0, len(parts), CHUNK):
        chunk = parts[start : start + CHUNK]
        new: dict[str, StoredDecision] = {}
        labels: dict[str, NewLabel] = {}
        for decision, trace, label in chunk:
            id_ = decision.id
            earlier = new.get(id_) or store.decisions.get(id_)
            if outcome := _outcome(labels.get(id_) or earlier, label):
                counts[outcome] += label is not None
                continue
            stored = earlier
            if stored is None:
                stored = new[id_] = _as_stored(
                    decision, trace, gate(torch.from_numpy(trace), limit), policy, store.clock()
                )
            if decision.action is Action.ACCEPT:
                # A decision that was stored without a label was counted as unreported.
                n_unreported += counts_unreported * ((label is None) - (earlier is not None))
            if label is not None:
                n_since = n_unreported * (not stored.quarantined)
                n_unreported -= n_since
                labels[id_] = NewLabel(
                    id_,
                    label,
                    source_of(decision, label),
                    0,
                    None,
                    n_since,
                    store.clock(),
                    stored.content_hash,
                    stored.time,
                )
                counts["quarantined" if stored.quarantined else "imported"] += 1
        store.apply_records([*new.values(), *labels.values()])
        if on_traces is not None:
            on_traces(len(chunk))
    return ImportReport(**counts, resumed=True)


def _outcome(reported: NewLabel | StoredDecision | None, label: bool | None) -> str:
    """Return "repeated" or "contradicted" for a label of a part that has one; "" if it has none.

    A label that was withdrawn cannot be contradicted.
    """
    if reported is None or reported.source is None:  # a forgotten one has a label
        return ""
    return "repeated" if reported.success in (label, None) else "contradicted"


def _as_stored(
    decision: Decision, trace: TraceArray, checked: tuple[int, int], policy: Policy, time: float
) -> StoredDecision:
    """Return a record of a decision and a copy of its trace (C, T), without storing it.

    Its propensity, the probability of a check, is 1 if the model alone would have checked the part.
    If the model would have accepted or rejected it, this is the policy's audit rate, the share of
    such parts that are checked at random, and 1 in shadow mode, in which every part is checked.
    `checked` is what a `TraceGate` returned for the trace: its fault, a position in `REASONS` (0 if
    it has none), and its content hash, which the record has if the part has no number; otherwise it
    has the hash of the number. A fault becomes the reason of the decision, and the record is marked
    as quarantined (never used in training). `time` is that of the decision, seconds since 1970.
    """
    fault, content = checked
    return StoredDecision(
        replace(
            decision,
            reason=REASONS[fault] if fault else decision.reason,
            propensity=1.0 if decision.predicted is Action.VERIFY else policy.audited_share,
        ),
        trace.copy(),
        trace_hash(content, decision.part),
        bool(fault),
        time,
    )


def _verifying_decisions(traces: TraceArray, data: Dataset) -> Iterator[Decision]:
    """Yield a VERIFY decision, made without a model, for each of the traces (n, C, T).

    VERIFY has the part checked. The id of a decision is made of the hash of the trace's content and
    a counter of equal traces, so that the same data set gives the same ids. The parts' numbers are
    `data.part`. Raises TraceError for a part's number that is empty, has more than 200 characters,
    or has characters that do not print; the decisions before it are yielded.
    """
    n_equal = Counter[int]()
    for i, hash_ in enumerate(content_hash(traces).tolist()):
        yield verify_decision(
            f"import-{hash_ & (2**64 - 1):016x}-{n_equal[hash_]}",
            None if data.part is None else as_part(data.part.item(i)),
            0,
            Reason.NO_MODEL,
        )
        n_equal[hash_] += 1
