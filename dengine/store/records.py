"""What every store hands back: decisions, labelled traces, added points, versions, and the counts of its status."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..records import Action, Decision, Reason, RetrainReport, Source
from .checks import mixed_shapes


@dataclass(frozen=True, slots=True)
class DecidedTrace:
    """A decision on its way into a store.

    trace : (C, T) float32, a copy.  time : of the decision, in seconds.
    """

    decision: Decision
    trace: NDArray[np.float32]
    content_hash: int
    quarantined: bool
    time: float


@dataclass(frozen=True, slots=True)
class StoredDecision:
    """What a report needs to know of a decision; fields as in `Decision`.

    trace : (C, T) float32.
    content_hash : signed 64 bit; equal traces share it.
    quarantined : kept, but never given to training.
    success, source : the label, if one was reported.
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


@dataclass(frozen=True, slots=True)
class Labelled:
    """Labelled traces without the quarantined ones, oldest label first.

    seq : (n,) label sequence numbers, increasing.
    traces : (n, C, T); (0, 0, 0) where there is none.
    labels : (n,) 1 success, 0 failure.
    hashes : (n,) content hashes.
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
    """What became of decisions, in label order: the bound each was decided by, (n,) float64, and its label, (n,) bool."""

    seq: NDArray[np.int64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    success: NDArray[np.bool_]


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
    )


def stack(rows: Sequence[NDArray[np.float32]], empty: tuple[int, ...]) -> NDArray[np.float32]:
    """Return rows of one shape as one array; none of them as `empty`."""
    if not rows:
        return np.zeros(empty, dtype=np.float32)
    shapes = {row.shape for row in rows}
    if len(shapes) > 1:
        raise mixed_shapes(shapes)
    return np.stack(rows)


def summary(
    cell_id: str,
    kinds: Sequence[tuple[str, str, bool, int]],
    sources: Mapping[str, int],
    retrains: Sequence[RetrainReport],
    times: tuple[float | None, float | None],
    write_failures: int = 0,
) -> dict[str, Any]:
    """Return the status of a store from its counts; kinds : (action, reason, quarantined, how many)."""
    actions: Counter[str] = Counter()
    reasons: Counter[str] = Counter()
    for action, reason, _, n in kinds:
        actions[action] += n
        reasons[reason] += n
    versions = [report.version for report in retrains if report.accepted]
    return {
        "cell_id": cell_id,
        "decisions": sum(actions.values()),
        "actions": {action.value: actions[action.value] for action in Action},
        "reasons": {reason.value: reasons[reason.value] for reason in Reason},
        "quarantined": sum(n for _, _, quarantined, n in kinds if quarantined),
        "labels": sum(sources.values()),
        "sources": {source.value: sources.get(source.value, 0) for source in Source},
        "retrains": len(retrains),
        "versions": len(versions),
        "last_version": versions[-1] if versions else None,
        "first_time": times[0],
        "last_time": times[1],
        "write_failures": write_failures,
    }
