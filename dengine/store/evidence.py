"""What the rule of a stored version was told, and what an engine that goes on from it has to tell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from .records import ModelVersion, overdue_evidence

if TYPE_CHECKING:
    from .sql import SqlStore


@dataclass(frozen=True, slots=True)
class RulePast:
    """What a rule was told until its engine ended.

    told_to : number of the newest label that the rule in the version's state knows. 0 means that it must be told
        everything again: a label was corrected since, a check is overdue (it counts as wrong until its label comes), the
        state is incomplete, or the version is of an earlier policy or a peer's.
    overdue_to : number of the newest decision whose check was overdue.  overdue : ids of those that the rule was told of.
    """

    told_to: int
    overdue_to: int
    overdue: frozenset[str]


def rule_past(
    store: SqlStore, version: ModelVersion | None, since_version: int, within: int, policy_since: int
) -> RulePast:
    """Read what the rule in force was told.

    Parameters
    ----------
    store : SqlStore
    version : ModelVersion or None
        The newest one; None before the first.
    since_version : int
        The rule is told of decisions by versions from this one on.
    within, policy_since : int
        Decisions after which a check is overdue, and the first version that counted so.

    Returns
    -------
    RulePast
    """
    state = {} if version is None else version.state
    overdue_to = max(store.overdue_to(within, policy_since), int(state.get("overdue_to", 0)))
    owed = store.owed(since_version) if overdue_to > 0 else []
    told = [each.decision for each in owed if each.number <= overdue_to and overdue_evidence(each.decision)]
    overdue = frozenset(decision.id for decision in told)
    if version is None:
        return RulePast(0, overdue_to, overdue)
    told_to = int(state.get("told_to", version.last_seq))  # 0: a peer's, who knows nothing of this cell
    must_retell = bool(overdue) or not state.keys().isdisjoint(("untold", "owed")) or version.version < since_version
    corrected = bool(store.corrections(int(state.get("corrected_to", 0))))
    return RulePast(0 if must_retell or corrected else told_to, overdue_to, overdue)
