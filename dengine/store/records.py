"""What a store is given and what it hands back: decisions, labels, traces, points, versions, events and counts."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..labels import as_id, as_success
from ..records import Action, Decision, Reason, RetrainReport, Source
from .checks import already_reported, as_point, as_silent, mixed_shapes, unknown_decision

STATUS_EVENTS = 5  # newest ones that a status shows
FORGOTTEN = 2  # beside 0 and 1: a label that takes no part any more


@dataclass(frozen=True, slots=True)
class DecidedTrace:
    """A decision on its way into a store.

    trace : (C, T) float32, a copy.  time : of the decision, in seconds.
    content_hash : signed 64 bit, of the trace's content, or of its part's number where one is given.
    part : serial number of the part that the trace was recorded on.
    """

    decision: Decision
    trace: NDArray[np.float32]
    content_hash: int
    quarantined: bool
    time: float
    part: str | None = None


@dataclass(frozen=True, slots=True)
class NewLabel:
    """A label on its way into a store.

    point : (d,) where the trace joined the references of `model_version`; None where it did not.
    silent : accepted parts that went on since the previous label, and of which nothing was heard.
    """

    decision_id: str
    success: bool
    source: Source
    model_version: int
    point: NDArray[np.float32] | None
    silent: int = 0


@dataclass(frozen=True, slots=True)
class StoredDecision:
    """What a report needs to know of a decision; fields as in `Decision`.

    trace : (C, T) float32.
    content_hash : signed 64 bit, of the trace's content, or of its part's number where one is given. It deals the
        permanent fold, and says who may vote once: equal traces share it, or the traces of one part.
    quarantined : kept, but never given to training.
    success, source : the label as it counts, if one was reported: of a corrected one the newest correction's, of a
        forgotten one None, beside the source that it had.
    part : serial number of the part that the trace was recorded on, where one was given.
    """

    id: str
    action: Action
    predicted: Action
    audit: bool
    reason: Reason
    lower: float
    upper: float
    embedding: tuple[tuple[float, ...], ...] | None
    model_version: int
    trace: NDArray[np.float32]
    content_hash: int
    quarantined: bool
    success: bool | None
    source: Source | None
    n_success: int
    n_failure: int
    propensity: float
    part: str | None = None


@dataclass(frozen=True, slots=True)
class Labelled:
    """Labelled traces without the quarantined ones, oldest label first.

    seq : (n,) label sequence numbers, increasing.
    traces : (n, C, T); (0, 0, 0) where there is none.
    labels : (n,) 1 success, 0 failure.
    hashes : (n,) content hashes: of the trace's content, or of its part's number where one is given.
    """

    seq: NDArray[np.int64]
    traces: NDArray[np.float32]
    labels: NDArray[np.int8]
    hashes: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class AddedPoints:
    """References added to a model version after its swap, in label order; points : (n, d), (0, 0) if there is none."""

    seq: NDArray[np.int64]
    points: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Evidence:
    """What became of decisions, in label order.

    lower, upper : (n,) the bound each was decided by.
    success : (n,) its label.
    novel : (n,) whether it was decided as unlike all that was learned from, `Reason.NOVEL`.
    silent : (n,) accepted parts of which nothing was heard between the previous label and this one.
    """

    seq: NDArray[np.int64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    success: NDArray[np.bool_]
    novel: NDArray[np.bool_]
    silent: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Outcomes:
    """What became of what the model was certain of, counted over all of a cell's store, quarantined ones included.

    accepted, rejected : decisions with that action.
    stops, confirmed : labels of the accepted, False and True; of the others nothing was heard.
    audited_accepts, audited_rejects : labelled audits of what the model would have accepted, and rejected.
    audited_accepts_bad : of these, label False.
    audited_rejects_good : of these, label True.
    forgotten_accepts, forgotten_audited_accepts, forgotten_audited_rejects : those whose label was forgotten, which are in
        none of the counts of labels above.
    """

    accepted: int
    stops: int
    confirmed: int
    audited_accepts: int
    audited_accepts_bad: int
    rejected: int
    audited_rejects: int
    audited_rejects_good: int
    forgotten_accepts: int = 0
    forgotten_audited_accepts: int = 0
    forgotten_audited_rejects: int = 0


@dataclass(frozen=True, slots=True)
class Event:
    """What happened to an engine, for people; number : 1, 2, ... in each cell.  time : in seconds.

    data : the same for machines, as JSON has it; None where there is none.  author : who did it; "" for the engine itself.
    """

    number: int
    time: float
    kind: str
    text: str
    data: dict[str, Any] | None = None
    author: str = ""


@dataclass(frozen=True, slots=True)
class Change:
    """What a person changed, on its way into a store: one event, and what it changes, all or none.

    kind, text, data, author : of the event.
    decisions : whose labels are corrected to `success`, None for a forgotten one.
    version : the retrain's report, its newest label, its state, of a version that takes the present one's place.
    settings : in the place of the present ones; None leaves these.
    """

    kind: str
    text: str
    data: Mapping[str, Any] | None = None
    author: str = ""
    decisions: Sequence[str] = ()
    success: bool | None = None
    version: tuple[RetrainReport, int, Mapping[str, NDArray[Any]]] | None = None
    settings: Mapping[str, str] | None = None


@dataclass(frozen=True, slots=True)
class Correction:
    """A later word on a label. Nothing is overwritten: the newest one of a decision counts.

    number : 1, 2, ... in each cell.  time : in seconds.
    success : the label from now on; None: it is forgotten, and takes no part in anything that is learned or counted.
    was : the label until then, None likewise.
    author : who said so.  event : number of its event.  newest_seq : number of the cell's newest label at that moment.
    seq : number of the label that it corrects.
    """

    number: int
    time: float
    decision_id: str
    success: bool | None
    was: bool | None
    author: str
    event: int
    newest_seq: int
    seq: int


@dataclass(frozen=True, slots=True)
class ModelVersion:
    """A model that was swapped in.

    last_seq : newest label that its references hold.
    state : weights, references, training ids: plain arrays by name.
    """

    version: int
    last_seq: int
    state: dict[str, NDArray[Any]]


def stored_decision(item: DecidedTrace, success: bool | None = None, source: Source | None = None) -> StoredDecision:
    """Return what a report needs, with a trace of its own."""
    decision = item.decision
    return StoredDecision(
        id=decision.id,
        action=decision.action,
        predicted=decision.predicted,
        audit=decision.audit,
        reason=decision.reason,
        lower=decision.lower,
        upper=decision.upper,
        embedding=decision.embedding,
        model_version=decision.model_version,
        trace=item.trace.copy(),
        content_hash=item.content_hash,
        quarantined=item.quarantined,
        success=success,
        source=source,
        n_success=decision.n_success,
        n_failure=decision.n_failure,
        propensity=decision.propensity,
        part=item.part,
    )


def checked_label(label: NewLabel) -> NewLabel:
    """Return a label in the store's own types, with a point of its own."""
    return NewLabel(
        decision_id=as_id(label.decision_id),
        success=as_success(label.success),
        source=label.source,
        model_version=int(label.model_version),
        point=as_point(label.point),
        silent=as_silent(label.silent),
    )


def imported_labels(decisions: Sequence[Decision], labels: NDArray[np.int8], source: Source) -> list[NewLabel]:
    """Return the labels that decisions of an import come with."""
    pairs = zip(decisions, map(as_success, labels), strict=True)
    return [NewLabel(decision.id, success, source, int(decision.model_version), None) for decision, success in pairs]


def refuse_repeats(
    labels: Sequence[NewLabel], known: Collection[str], said: Mapping[str, tuple[bool, Source]], hint: str = ""
) -> None:
    """Raise a ReportError for the first label whose decision is not `known`, or was reported: in `said`, or before it."""
    reported = dict(said)
    for label in labels:
        if label.decision_id not in known:
            raise unknown_decision(label.decision_id, hint)
        first, now = reported.get(label.decision_id), (label.success, label.source)
        if first is not None:
            raise already_reported(label.decision_id, first, now)
        reported[label.decision_id] = now


def stack(rows: Sequence[NDArray[np.float32]], empty: tuple[int, ...]) -> NDArray[np.float32]:
    """Return rows of one shape as one array; none of them as `empty`."""
    if not rows:
        return np.zeros(empty, dtype=np.float32)
    shapes = {row.shape for row in rows}
    if len(shapes) > 1:
        raise mixed_shapes(shapes)
    return np.stack(rows)


def as_label(counted: int | None) -> bool | None:
    """Return a label as it counts; None where there is none, or where it is forgotten."""
    return None if counted in (None, FORGOTTEN) else bool(counted)
