"""Records for looking back on a store: filters, past labels, and counts of decisions by outcome.
`HistoryFilter` selects decisions; `PastLabel`, `Tally` (counts in `DecisionGroup`s) and `Stretch`
are what `SqlStore.labels.past`, `tally` and `stretches` return. The status, the history and the
explanations are computed from them.
"""

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import expect
from ..records import ACTIONS, REASONS, Action, Reason, Source
from .records import LABEL_WORDS, Outcomes

LABELS = {word: success for success, word in LABEL_WORDS.items()}
OPTIONS: dict[str, Collection[str]] = {
    "action": ACTIONS,
    "predicted": ACTIONS,
    "reason": REASONS,
    "label": LABELS,
}


@dataclass(frozen=True, slots=True)
class HistoryFilter:
    """A selection of decisions; a field that is None selects all.

    Attributes
    ----------
    action : Action or str, optional
    reason : Reason or str, optional
    label : {"good", "bad", "none"}, optional
        After corrections; "none" also if it was forgotten.
    since, until : float, optional
        Seconds since 1970; `since` is included, `until` is not.
    predicted : Action or str, optional
        What the model alone would have done, as in an audit or in shadow mode.
    part : str, optional
        The part's number.

    Raises
    ------
    SettingError
        For an action, predicted action, reason or label that does not exist. The other fields are
        not checked.
    """

    action: str | None = None
    reason: str | None = None
    label: str | None = None
    since: float | None = None
    until: float | None = None
    predicted: str | None = None
    part: str | None = None

    def __post_init__(self) -> None:
        """Raise SettingError for an action, predicted, reason or label that is not in OPTIONS."""
        for name, options in OPTIONS.items():
            value = getattr(self, name)
            expect(
                value is None or value in options,
                f"{name} to be one of {', '.join(options)}",
                value,
            )


@dataclass(frozen=True, slots=True)
class PastLabel:
    """A label as it was recorded, with what a rule was updated with.

    The fields up to `point` are those of `NewLabel` and of the label's row, the others those of
    `OutcomeRecord`.
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
    lower: float
    upper: float
    novel: bool
    predicted: int
    inclusion_probability: float


@dataclass(frozen=True, slots=True)
class DecisionGroup:
    """A group of decisions that are equal in all these fields, and their number.

    Attributes
    ----------
    action, predicted, reason, audit, quarantined, success, source
        As in `Decision` and `StoredDecision`.
    aged : bool
        So many decisions came after them that a check without a label is overdue.
    n : int
        Number of decisions in the group.
    """

    action: Action
    predicted: Action
    reason: Reason
    audit: bool
    quarantined: bool
    aged: bool
    success: bool | None
    source: Source | None
    n: int

    @property
    def label(self) -> str:
        """The corrected label in a word: good, bad, forgotten, overdue or none.

        "good" and "bad" are the label after corrections. "forgotten": there is a label, but a
        correction withdrew it. "overdue": a check was asked for, there is no label, and so many
        decisions followed that the check is overdue (`aged`; it is False if the decisions were
        counted without `within`, the number of later decisions that makes a check overdue). "none":
        there is no label, and no check is overdue. A check of a quarantined trace (stored, but
        never used in training) is never overdue.
        """
        if self.source is not None and self.success is None:
            return "forgotten"
        is_overdue = (
            self.source is None
            and self.aged
            and self.action is Action.VERIFY
            and not self.quarantined
        )
        return "overdue" if is_overdue else LABEL_WORDS[self.success]


@dataclass(frozen=True, slots=True)
class Tally:
    """Decisions counted in groups.

    Attributes
    ----------
    groups : tuple of DecisionGroup
    first, last : float or None
        Times of the oldest and the newest decision, in seconds since 1970; None without decisions.
    """

    groups: tuple[DecisionGroup, ...]
    first: float | None
    last: float | None

    def count(self) -> int:
        """Return the number of decisions in all groups."""
        return sum(group.n for group in self.groups)

    def by(self, field: str) -> Counter[Any]:
        """Return the number of decisions for each value of a field of `DecisionGroup`.

        The decisions of a group are equal in all its fields. `field` is the name of a field or
        property, like "action" or "label". A value that no decision has counts 0, as always in a
        `Counter`.
        """
        counts: Counter[Any] = Counter()
        for group in self.groups:
            counts[getattr(group, field)] += group.n
        return counts

    @property
    def outcomes(self) -> Outcomes:
        """Counts of parts by action and corrected label, for a certificate (a bound on errors).

        `accepted` and `rejected` count all parts with this action, whatever the label. Accepted
        parts with the label good are `confirmed`, those with the label bad `false_accepts`, those
        with the label forgotten (withdrawn) `forgotten_accepts`, and rejected parts with the label
        good `false_rejects`. An audited part (checked, though the
        model would have accepted or rejected it) is counted by what the model alone would have
        done, in the fields of audits alone and not among the accepted and rejected parts:
        `audited_accepts` and `audited_rejects` are the audits with the label good or bad,
        `audited_accepts_bad` and `audited_rejects_good` the wrong ones of these. Audits with the
        label forgotten or overdue (not reported in time) have fields of their own, and audits with
        the label none (not reported) are in no field. A part that an operator's limits rejected
        (`Reason.OUTSIDE`) is not counted as rejected or false reject.
        """
        actions = Counter[Action]()
        by_action = Counter[tuple[Action, str]]()
        audited = Counter[tuple[Action, str]]()  # by what the model alone would have done
        accept = Action.ACCEPT
        reject = Action.REJECT
        for group in self.groups:
            audited[group.predicted, group.label] += group.n if group.audit else 0
            if (group.action, group.reason) != (reject, Reason.OUTSIDE):
                actions[group.action] += group.n
                by_action[group.action, group.label] += group.n
        return Outcomes(
            accepted=actions[accept],
            false_accepts=by_action[accept, "bad"],
            confirmed=by_action[accept, "good"],
            audited_accepts=audited[accept, "bad"] + audited[accept, "good"],
            audited_accepts_bad=audited[accept, "bad"],
            rejected=actions[reject],
            audited_rejects=audited[reject, "bad"] + audited[reject, "good"],
            audited_rejects_good=audited[reject, "good"],
            false_rejects=by_action[reject, "good"],
            forgotten_accepts=by_action[accept, "forgotten"],
            forgotten_audited_accepts=audited[accept, "forgotten"],
            forgotten_audited_rejects=audited[reject, "forgotten"],
            overdue_audited_accepts=audited[accept, "overdue"],
            overdue_audited_rejects=audited[reject, "overdue"],
        )


@dataclass(frozen=True, slots=True)
class Stretch:
    """Counts over consecutive decisions, or over a period of time.

    Attributes
    ----------
    n : int
        Number of decisions.
    last : float
        Time of the newest, in seconds since 1970.
    verified, novel : int
        Decided VERIFY; decided with `Reason.NOVEL`.
    accepted, rejected : int
        By the model, without a check.
    false_accepts : int
        Accepted parts that are known to be bad.
    outside : int
        Decided by an operator's limits.
    """

    n: int
    last: float
    verified: int
    novel: int
    accepted: int
    false_accepts: int
    rejected: int
    outside: int
