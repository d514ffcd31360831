"""What people look back on: past labels, retrains, counts of decisions and what became of them, and a store's status."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import StoreError
from ..records import Action, Reason, RetrainReport, Source
from .records import FORGOTTEN, Event, Outcomes, StoredDecision


def count_outcomes(kinds: Iterable[tuple[str, str, bool, int | None, int]]) -> Outcomes:
    """Count outcomes; kinds : (action, predicted, audit, label, FORGOTTEN or None, how many)."""
    done: Counter[tuple[str, int | None]] = Counter()  # by action and label
    audited: Counter[tuple[str, int | None]] = Counter()  # audits, by prediction and label
    for action, predicted, audit, success, n in kinds:
        done[action, success] += n
        audited[predicted, success] += n if audit else 0
    accept, reject = Action.ACCEPT.value, Action.REJECT.value
    return Outcomes(
        accepted=sum(done[accept, label] for label in (None, False, True, FORGOTTEN)),
        stops=done[accept, False],
        confirmed=done[accept, True],
        audited_accepts=audited[accept, False] + audited[accept, True],
        audited_accepts_bad=audited[accept, False],
        rejected=sum(done[reject, label] for label in (None, False, True, FORGOTTEN)),
        audited_rejects=audited[reject, False] + audited[reject, True],
        audited_rejects_good=audited[reject, True],
        forgotten_accepts=done[accept, FORGOTTEN],
        forgotten_audited_accepts=audited[accept, FORGOTTEN],
        forgotten_audited_rejects=audited[reject, FORGOTTEN],
    )


def summary(
    cell_id: str,
    kinds: Sequence[tuple[str, str, bool, int]],
    sources: Mapping[str, int],
    retrains: Sequence[RetrainReport],
    times: tuple[float | None, float | None],
    last_label_time: float | None,
    events: Sequence[Event],
    write_failures: int = 0,
    *,
    corrected: int,
    forgotten: int,
) -> dict[str, Any]:
    """Return the status of a store from its counts; kinds : (action, reason, quarantined, how many).

    events : the newest STATUS_EVENTS.  corrected, forgotten : decisions whose newest correction is a label, or none.
    """
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
        "corrected": corrected,
        "forgotten": forgotten,
        "retrains": len(retrains),
        "versions": len(versions),
        "last_version": versions[-1] if versions else None,
        "first_time": times[0],
        "last_time": times[1],
        "last_label_time": last_label_time,
        "events": [{"kind": event.kind, "text": event.text, "time": event.time} for event in events],
        "write_failures": write_failures,
    }


LABELS: dict[str, bool | None] = {"good": True, "bad": False, "none": None}


@dataclass(frozen=True, slots=True)
class HistoryFilter:
    """Which decisions are meant; None: all.

    predicted : what the model alone would have done.  part : its number.
    label : good, bad or none.  since, until : times in seconds, the first included, the last not.
    Raises StoreError for a label that is none of these.
    """

    action: Action | None = None
    reason: Reason | None = None
    label: str | None = None
    since: float | None = None
    until: float | None = None
    predicted: Action | None = None
    part: str | None = None

    def __post_init__(self) -> None:
        if self.label is not None and self.label not in LABELS:
            raise StoreError(f"Expected label to be one of {', '.join(LABELS)}, got {self.label!r}.")

    def takes(self, past: StoredDecision) -> bool:
        """Whether a decision is meant."""
        return (
            (self.action is None or past.decision.action is self.action)
            and (self.reason is None or past.decision.reason is self.reason)
            and (self.label is None or past.label == self.label)
            and (self.since is None or past.time >= self.since)
            and (self.until is None or past.time < self.until)
            and (self.predicted is None or past.decision.predicted is self.predicted)
            and (self.part is None or past.decision.part == self.part)
        )


@dataclass(frozen=True, slots=True)
class PastLabel:
    """A label as it was recorded, and of its decision what a rule was told; fields as in `NewLabel` and `Evidence`.

    seq, time : its number, and when it came.  decided : when its decision was made.
    point : (d,), None where there is none or none was asked for.
    """

    seq: int
    time: float
    decision_id: str
    success: bool
    source: Source
    model_version: int
    content_hash: int
    quarantined: bool
    silent: int
    point: NDArray[np.float32] | None
    decided: float
    lower: float
    upper: float
    novel: bool


@dataclass(frozen=True, slots=True)
class Kind:
    """How many decisions of one kind there are; fields as in `StoredDecision`."""

    action: Action
    predicted: Action
    reason: Reason
    audit: bool
    quarantined: bool
    success: bool | None
    n: int


@dataclass(frozen=True, slots=True)
class Tally:
    """Counted decisions.  first, last : times of the oldest and the newest of them; None where there is none."""

    kinds: tuple[Kind, ...]
    first: float | None
    last: float | None

    def count(self, takes: Callable[[Kind], bool] = lambda kind: True) -> int:
        """How many decisions there are of the kinds that are meant; of all by default."""
        return sum(kind.n for kind in self.kinds if takes(kind))

    @property
    def outcomes(self) -> Outcomes:
        """What became of what the model was certain of."""
        return count_outcomes((k.action, k.predicted, k.audit, k.success, k.n) for k in self.kinds)


@dataclass(frozen=True, slots=True)
class Stretch:
    """Consecutive decisions.  n : of them.  last : time of the newest.

    verified, novel : decided so.  accepted, bad : went on without a check, and of these are known to be bad.
    """

    n: int
    last: float
    verified: int
    novel: int
    accepted: int
    bad: int


def stretch_of(decisions: Sequence[StoredDecision]) -> Stretch:
    """Count consecutive decisions."""
    accepted = [past for past in decisions if past.decision.action is Action.ACCEPT]
    return Stretch(
        n=len(decisions),
        last=decisions[-1].time,
        verified=sum(past.decision.action is Action.VERIFY for past in decisions),
        novel=sum(past.decision.reason is Reason.NOVEL for past in decisions),
        accepted=len(accepted),
        bad=sum(past.success is False for past in accepted),
    )


def tally_of(decisions: Iterable[StoredDecision]) -> Tally:
    """Count decisions, oldest first."""
    each = list(decisions)
    kinds = Counter(
        (
            past.decision.action,
            past.decision.predicted,
            past.decision.reason,
            past.decision.audit,
            past.quarantined,
            past.success,
        )
        for past in each
    )
    times = (each[0].time, each[-1].time) if each else (None, None)
    return Tally(tuple(Kind(*kind, n) for kind, n in kinds.items()), *times)
