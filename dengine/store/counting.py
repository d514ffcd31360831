"""What a store counts: what became of decisions, and its status."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ..records import Action, Reason, RetrainReport, Source
from .records import FORGOTTEN, Event, Outcomes


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
    corrected: Mapping[str, int] | None = None,
) -> dict[str, Any]:
    """Return the status of a store from its counts; kinds : (action, reason, quarantined, how many).

    events : the newest STATUS_EVENTS.  corrected : decisions whose newest correction is a label, and "forgotten" ones.
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
        "corrected": (corrected or {}).get("corrected", 0),
        "forgotten": (corrected or {}).get("forgotten", 0),
        "retrains": len(retrains),
        "versions": len(versions),
        "last_version": versions[-1] if versions else None,
        "first_time": times[0],
        "last_time": times[1],
        "last_label_time": last_label_time,
        "events": [{"kind": event.kind, "text": event.text, "time": event.time} for event in events],
        "write_failures": write_failures,
    }
