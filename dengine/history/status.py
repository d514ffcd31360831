"""How an engine is doing, by its store: over its newest decisions, and since its birth.

    doing = standing(store, recipe, last=500)
    doing.newest.verified / doing.newest.decisions, doing.ever.bad_accepts.upper

Counted by the store: no trace is read.

The decisions of a store, as they were recorded, and what happened between them.

    for past in history(store, last=50, action="accept", label="bad"):
        print(past.id, past.lower, past.reason)

Read page by page along the time of the decisions, without their traces.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from itertools import chain
from typing import TypeVar

from ..decision.intervals import wilson_interval
from ..decision.policy import Policy
from ..errors import SettingError
from ..recipe import Recipe
from ..records import Action, Reason
from ..store.base import Store
from ..store.records import Event, Outcomes
from ..store.views import LABELS, HistoryFilter, Key, PastDecision, PastRetrain, Stretch, Tally

PAGE = 500  # decisions read at a time

Happened = PastDecision | PastRetrain | Event
Name = TypeVar("Name", bound=StrEnum)


def history(
    store: Store,
    last: int | None = None,
    action: Action | str | None = None,
    reason: Reason | str | None = None,
    label: str | None = None,
    since: float | None = None,
    until: float | None = None,
    predicted: Action | str | None = None,
) -> Iterator[PastDecision]:
    """The decisions of a store, newest last, one after the other as they are read.

    last : the newest so many of those that are meant; None: all.
    action, reason : an `Action` and a `Reason`, or their values.  label : good, bad or none.
    predicted : an `Action` or its value: what the model alone would have done, as in an audit or in the shadow mode.
    since, until : times in seconds since 1970; the first included, the last not.
    Raises SettingError for a value that is none of these.
    """
    if last is not None and last < 1:
        raise SettingError(f"Expected last to be 1 or more, got {last!r}; leave it out for all decisions.")
    if label is not None and label not in LABELS:
        raise SettingError(f"Expected label to be one of {', '.join(LABELS)}, got {label!r}.")
    where = HistoryFilter(_named(Action, action), _named(Reason, reason), label, since, until, _named(Action, predicted))
    return _forward(store, where) if last is None else iter(_newest(store, where, last))


def _named(kind: type[Name], value: Name | str | None) -> Name | None:
    try:
        return None if value is None else kind(value)
    except ValueError:
        known = ", ".join(kind)
        raise SettingError(f"Expected {kind.__name__.lower()} to be one of {known}, got {value!r}.") from None


def _forward(store: Store, where: HistoryFilter) -> Iterator[PastDecision]:
    beyond: Key | None = None
    while page := store.decisions(where, PAGE, beyond, newest=False):
        yield from page
        beyond = page[-1].key


def _newest(store: Store, where: HistoryFilter, last: int) -> list[PastDecision]:
    pages: list[list[PastDecision]] = []
    beyond: Key | None = None
    left = last
    while left and (page := store.decisions(where, min(PAGE, left), beyond)):
        pages.append(page)
        beyond, left = page[0].key, left - len(page)
    return list(chain.from_iterable(reversed(pages)))


@dataclass(frozen=True, slots=True)
class Beside:
    """What happened beside the decisions, oldest first."""

    retrains: tuple[PastRetrain, ...]
    events: tuple[Event, ...]


def beside(store: Store, since: float | None = None, until: float | None = None) -> Beside:
    """The retrains and events of a store between two times in seconds; None: from its beginning, to now."""

    def meant(time: float) -> bool:
        return (since is None or time >= since) and (until is None or time < until)

    retrains = tuple(each for each in store.past_retrains() if meant(each.time))
    return Beside(retrains, tuple(each for each in store.events() if meant(each.time)))


def interleaved(decisions: list[PastDecision], others: Beside) -> Iterator[Happened]:
    """All of it in the order in which it happened; what has the same time keeps that order too."""
    return heapq.merge(others.retrains, others.events, decisions, key=lambda each: each.time)


STRETCHES = 120  # of a picture
FEWEST = 20  # decisions of a stretch: a share of fewer jumps


@dataclass(frozen=True, slots=True)
class BadAccepts:
    """How many parts that the model let pass were bad, as far as that is known.

    n : parts it would have let pass, audited ones included.  known : those of them that the claim rests on.
    bad : of these.  stops : bad accepted parts, whatever the claim rests on.
    by : what tells: "every outcome", "audits", or "" where only stops do, and nothing can be bounded from above.
    lower, upper : Wilson interval of their share at the policy's alpha, at one look; 0 and 1 where nothing is known.
    tolerance : 1 - LB.
    """

    n: int
    known: int
    bad: int
    stops: int
    by: str
    lower: float
    upper: float
    tolerance: float

    @property
    def verdict(self) -> str:
        """kept, broken, or open, as far as the interval goes; it speaks of this one look."""
        return _verdict(self.lower, self.upper, self.tolerance)


def _verdict(lower: float, upper: float, tolerance: float) -> str:
    if upper <= tolerance:
        return "kept"
    return "broken" if lower > tolerance else "open"


@dataclass(frozen=True, slots=True)
class WouldHave:
    """What the model would have done with parts that were checked all the same: audits, in the shadow mode every one.

    n : checked parts that it would have accepted, or rejected.  wrong : of these, those that it was wrong about.
    lower, upper : 95 % Wilson interval of the share of wrong ones, at one look; 0 and 1 where n is 0. Not at the policy's
        alpha: at 0.5 that would be an even bet, and somebody decides by this whether the model may.
    tolerance : 1 - LB.
    """

    n: int
    wrong: int
    lower: float
    upper: float
    tolerance: float

    @property
    def verdict(self) -> str:
        """kept, broken, or open, as in `BadAccepts`."""
        return _verdict(self.lower, self.upper, self.tolerance)


@dataclass(frozen=True, slots=True)
class Span:
    """Consecutive decisions, and what happened meanwhile.

    first, last : times of the oldest and the newest; None where there is none.
    verified : decided so, of which audits, novel, safe_mode, errors and quarantined were for these reasons.
    accepted, rejected : went on without a check.  rejected_good : audited parts that it would have rejected, and were good.
    would_accept, would_reject : what audits say: those that were bad, or good, are the wrong ones.
    unlabelled : verified, of which no result was reported.
    retrains : all.  dropped : reasons of those that were dropped, with how often.
    """

    decisions: int
    first: float | None
    last: float | None
    verified: int
    audits: int
    novel: int
    safe_mode: int
    errors: int
    quarantined: int
    accepted: int
    rejected: int
    audited_rejects: int
    rejected_good: int
    would_accept: WouldHave
    would_reject: WouldHave
    bad_accepts: BadAccepts
    unlabelled: int
    retrains: int
    dropped: dict[str, int]

    def share(self, some: int) -> float | None:
        """Of all decisions; None where there is none."""
        return some / self.decisions if self.decisions else None


@dataclass(frozen=True, slots=True)
class Waiting:
    """Labels on their way: new ones since the newest retrain, of `retrain_every` that set one off; verified parts whose
    result, and accepted ones whose fate, was never reported.
    """

    new_labels: int
    retrain_every: int
    verified: int
    accepted: int


@dataclass(frozen=True, slots=True)
class Standing:
    """How an engine is doing: over its newest decisions, and since its birth."""

    newest: Span
    ever: Span
    waiting: Waiting


def standing(store: Store, recipe: Recipe, last: int = 500) -> Standing:
    """How the engine of a store is doing; last : the newest so many decisions that are looked at apart."""
    retrains, policy = store.past_retrains(), recipe.policy
    every = store.tally()
    newest, ever = _span(store.tally(last), retrains, policy), _span(every, retrains, policy)
    new_labels = sum(not each.quarantined for each in store.past_labels(retrains[-1].last_seq if retrains else 0))
    unheard = every.outcomes.accepted - every.outcomes.stops - every.outcomes.confirmed
    return Standing(newest, ever, Waiting(new_labels, recipe.retrain_every, ever.unlabelled, unheard))


def _span(tally: Tally, retrains: list[PastRetrain], policy: Policy) -> Span:
    outcomes, first = tally.outcomes, tally.first
    here = [each.report for each in retrains if first is not None and each.time >= first]

    def reason(*reasons: Reason) -> int:
        return tally.count(lambda kind: kind.reason in reasons)

    return Span(
        decisions=tally.count(),
        first=first,
        last=tally.last,
        verified=tally.count(lambda kind: kind.action is Action.VERIFY),
        audits=reason(Reason.AUDIT),
        novel=reason(Reason.NOVEL),
        safe_mode=reason(Reason.SAFE_MODE),
        errors=reason(Reason.MODEL_ERROR),
        quarantined=tally.count(lambda kind: kind.quarantined),
        accepted=outcomes.accepted,
        rejected=outcomes.rejected,
        audited_rejects=outcomes.audited_rejects,
        rejected_good=outcomes.audited_rejects_good,
        would_accept=_would_have(outcomes.audited_accepts, outcomes.audited_accepts_bad, policy),
        would_reject=_would_have(outcomes.audited_rejects, outcomes.audited_rejects_good, policy),
        bad_accepts=bad_accepts(outcomes, policy),
        unlabelled=tally.count(lambda kind: kind.action is Action.VERIFY and kind.success is None),
        retrains=len(here),
        dropped=dict(Counter(report.reason for report in here if not report.accepted)),
    )


def _would_have(n: int, wrong: int, policy: Policy) -> WouldHave:
    low, high = wilson_interval(n - wrong, wrong, 0.05)
    return WouldHave(n, wrong, 1.0 - high, 1.0 - low, 1.0 - policy.lower_bound)


def bad_accepts(outcomes: Outcomes, policy: Policy) -> BadAccepts:
    """How many of the parts that the model let pass were bad: by every outcome where all are known, else by audits.

    Under `stops="all"` a part whose silence is not over is left out. Audits speak for all: their coin knows no outcome.
    """
    heard = outcomes.stops + outcomes.confirmed
    every = policy.stops == "all" or 0 < outcomes.accepted == heard
    by = "every outcome" if every and heard else "audits" if outcomes.audited_accepts else ""
    known, bad = {
        "every outcome": (heard, outcomes.stops),
        "audits": (outcomes.audited_accepts, outcomes.audited_accepts_bad),
        "": (0, 0),
    }[by]
    low, high = wilson_interval(known - bad, bad, policy.alpha)
    n = outcomes.accepted + outcomes.audited_accepts
    return BadAccepts(n, known, bad, outcomes.stops, by, 1.0 - high, 1.0 - low, 1.0 - policy.lower_bound)


@dataclass(frozen=True, slots=True)
class Course:
    """What a picture of a store is drawn from: consecutive decisions, retrains and events; last : looked at apart."""

    stretches: list[Stretch]
    retrains: list[PastRetrain]
    modes: list[Event]
    tolerance: float
    last: int


def course(store: Store, recipe: Recipe, last: int) -> Course:
    """Read what a picture is drawn from."""
    modes = [event for event in store.events() if event.kind == "safe mode"]
    n = max(1, min(STRETCHES, store.tally().count() // FEWEST))
    return Course(store.stretches(n), store.past_retrains(), modes, 1.0 - recipe.policy.lower_bound, last)


@dataclass(frozen=True, slots=True)
class Watch:
    """How far each detector of the safe mode is on its way to an alarm, from 0 to 1: accepts, rejects, novelty."""

    accepts: float
    rejects: float
    novelty: float


def watch(store: Store, recipe: Recipe) -> Watch | None:
    """What the rule that answers knows of drift; None where it watches nothing, or that is not kept."""
    from ..decision.rule import WatchedRule
    from .explain import rule_now  # torch

    if recipe.policy.guarantee == "local" and recipe.policy.stops != "all":
        return None
    rule = rule_now(store, recipe.policy)
    if not isinstance(rule, WatchedRule):
        return None
    accepts, rejects, novelty = (max(0.0, capital / rule.alarm_at) for capital in rule.watch.tolist())
    return Watch(accepts, rejects, novelty)
