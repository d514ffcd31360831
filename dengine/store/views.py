"""What people look back on: past labels, and counts of decisions and of what became of them."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SettingError, expect, shortened
from ..records import Action, Reason, Source
from .records import Outcomes

KINDS = {"action": Action, "predicted": Action, "reason": Reason}
LABELS: dict[str, bool | None] = {"good": True, "bad": False, "none": None}


@dataclass(frozen=True, slots=True)
class HistoryFilter:
    """Which decisions are meant; None: all.

    action, reason : an `Action` and a `Reason`, or their values.  label : good, bad or none.  part : its number.
    predicted : an `Action` or its value: what the model alone would have done, as in an audit or in the shadow mode.
    since, until : times in seconds since 1970; the first included, the last not.
    Raises SettingError for a value that is none of these.
    """

    action: Action | None = None
    reason: Reason | None = None
    label: str | None = None
    since: float | None = None
    until: float | None = None
    predicted: Action | None = None
    part: str | None = None

    def __post_init__(self) -> None:
        for name, kind in KINDS.items():
            try:
                if (value := getattr(self, name)) is not None:
                    object.__setattr__(self, name, kind(value))
            except ValueError:
                known = ", ".join(kind)
                raise SettingError(f"Expected {name} to be one of {known}, got {shortened(value)}.") from None
        expect(self.label is None or self.label in LABELS, f"label to be one of {', '.join(LABELS)}", self.label)


@dataclass(frozen=True, slots=True)
class PastLabel:
    """A label as it was recorded, and of its decision what a rule was told; fields as in `NewLabel` and `OutcomeRecord`."""

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
    predicted: int
    inclusion_probability: float


@dataclass(frozen=True, slots=True)
class DecisionGroup:
    """How many decisions of one kind there are; fields as in `StoredDecision`.

    aged : so many came after them that a check that they asked for is overdue.
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
    def is_false_reject(self) -> bool:
        """Whether the model rejected parts that were found good."""
        return self.action is Action.REJECT and self.reason is not Reason.OUTSIDE and self.label == "good"

    @property
    def label(self) -> str:
        """good, bad, forgotten, overdue or none."""
        if self.source is not None:
            return "forgotten" if self.success is None else "good" if self.success else "bad"
        return "overdue" if self.aged and self.action is Action.VERIFY and not self.quarantined else "none"


@dataclass(frozen=True, slots=True)
class Tally:
    """Counted decisions.

    first, last : times of the oldest and the newest.  last_label : when the newest label came.  None: there is none.
    """

    kinds: tuple[DecisionGroup, ...]
    first: float | None
    last: float | None
    last_label: float | None = None

    def count(self, takes: Callable[[DecisionGroup], bool] = lambda kind: True) -> int:
        """How many decisions there are of the kinds that are meant; of all by default."""
        return sum(kind.n for kind in self.groups if takes(kind))

    def by(self, field: str) -> Counter[Any]:
        """How many decisions there are of each value of a field of `DecisionGroup`."""
        found: Counter[Any] = Counter()
        for kind in self.groups:
            found[getattr(kind, field)] += kind.n
        return found

    @property
    def outcomes(self) -> Outcomes:
        """What became of what the model was certain of."""
        done, audited = Counter[tuple[Action, str]](), Counter[tuple[Action, str]]()
        for kind in self.groups:
            done[kind.action, kind.label] += kind.n
            audited[kind.predicted, kind.label] += kind.n if kind.audit else 0
        actions, accept, reject = self.by("action"), Action.ACCEPT, Action.REJECT
        return Outcomes(
            accepted=actions[accept],
            false_accepts=done[accept, "bad"],
            confirmed=done[accept, "good"],
            audited_accepts=audited[accept, "bad"] + audited[accept, "good"],
            audited_accepts_bad=audited[accept, "bad"],
            rejected=actions[reject] - self.count(lambda kind: (kind.action, kind.reason) == (reject, Reason.OUTSIDE)),
            audited_rejects=audited[reject, "bad"] + audited[reject, "good"],
            audited_rejects_good=audited[reject, "good"],
            false_rejects=sum(kind.n for kind in self.groups if kind.is_false_reject),
            forgotten_accepts=done[accept, "forgotten"],
            forgotten_audited_accepts=audited[accept, "forgotten"],
            forgotten_audited_rejects=audited[reject, "forgotten"],
            overdue_audited_accepts=audited[accept, "overdue"],
            overdue_audited_rejects=audited[reject, "overdue"],
        )


@dataclass(frozen=True, slots=True)
class Stretch:
    """Consecutive decisions, or those of a batch.  n : of them.  last : time of the newest.  batch : its name.

    verified, novel, outside : decided so.  accepted, rejected : by the model, without a check.  bad : accepted, known so.
    """

    n: int
    last: float
    verified: int
    novel: int
    accepted: int
    bad: int
    rejected: int
    outside: int
    batch: str | None = None
