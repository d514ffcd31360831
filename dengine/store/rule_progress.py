"""How far the decision rule of a stored version was updated. A rule is updated with the outcome of
one part after another. `read_rule_progress` returns a `RuleProgress`: which outcomes the stored
rule already includes, so that none is counted twice and none is missed. It is called when an engine
resumes, and by `history.past_versions.load_rule`, which needs no engine.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from .records import ModelVersion, overdue_outcomes

if TYPE_CHECKING:
    from .sql import SqlStore


@dataclass(frozen=True, slots=True)
class RuleProgress:
    """Which outcomes a stored rule includes.

    Attributes
    ----------
    last_seq : int
        Number of the newest label that the rule includes. 0: the rule must be rebuilt from all
        outcomes, since a label was corrected meanwhile, a check is overdue (it counts as wrong
        until its label comes), the stored state is incomplete, or the version was made under an
        earlier policy or by another robot cell of the product.
    overdue_to : int
        Up to this decision number a check without a label is overdue; 0: none is.
    overdue_ids : frozenset of str
        Ids of the decisions whose overdue checks the rule includes as errors.
    """

    last_seq: int
    overdue_to: int
    overdue_ids: frozenset[str]


def read_rule_progress(
    store: SqlStore,
    version: ModelVersion | None,
    since_version: int,
    within: int,
    policy_since: int,
) -> RuleProgress:
    """Read from the store how far the decision rule of a version was updated.

    A decision rule turns bounds of the success probability into an action, and is updated with the
    outcome of one part after another. A version is a trained model with the state of its rule.
    Records that were not copied to the database yet are written first, if the database takes them
    in time; nothing else is written. Raises StoreError if the database fails.

    Parameters
    ----------
    store : SqlStore
    version : ModelVersion or None
        The newest version; None if there is none, or if its model cannot be restored.
    since_version : int
        The rule counts only decisions made by this version or a later one.
    within : int
        Number of later decisions after which a check, which a decision VERIFY asks for, is overdue
        if it has no label. A check that the version or a stored label counted as overdue stays so,
        whatever `within` is.
    policy_since : int
        The version with which the present policy (the tolerated error probability and so on) came
        into force. If the newest decision is by an earlier version, no further check becomes
        overdue by `within`.

    Returns
    -------
    RuleProgress
        `last_seq` is the number of the newest label that the rule includes. It is 0 if there is no
        version, or if the rule must be rebuilt from all outcomes: `overdue_ids` is not empty, a
        label was corrected meanwhile, the stored rule is incomplete, or the version is earlier than
        `since_version` or of another robot cell. Up to the decision number `overdue_to` a check
        without a label is overdue. `overdue_ids` are the ids of these decisions, but only of those
        by `since_version` or a later version, and with a lower bound above 0 or an upper one below
        1 (`overdue_outcomes`).
    """
    state = {} if version is None else version.state
    overdue_to = max(
        store.decisions.overdue_to(within, policy_since), int(state.get("overdue_to", 0))
    )
    pending = store.decisions.pending(since_version) if overdue_to > 0 else []
    overdue_ids = frozenset(
        item.decision.id
        for item in pending
        if item.number <= overdue_to and overdue_outcomes(item.decision)
    )
    if version is None:
        return RuleProgress(0, overdue_to, overdue_ids)
    # 0: a peer's, which knows nothing of this cell
    last_seq = int(state.get("rule_last_seq", version.last_seq))
    is_incomplete = not state.keys().isdisjoint(("rule_is_stale", "includes_overdue"))
    corrections = store.corrections.after(int(state.get("corrected_to", 0)))
    must_rebuild = overdue_ids or is_incomplete or version.version < since_version or corrections
    return RuleProgress(0 if must_rebuild else last_seq, overdue_to, overdue_ids)
