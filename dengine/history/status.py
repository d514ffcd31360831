"""How an engine is doing, and the decisions of its past, read from its store; no trace is read.

found = status(store)
found.newest.verified_share, found.ever.bad_accepts.upper, found.alarm
for past in history(store, last=50, action="accept", label="bad"): ...
"""

from __future__ import annotations

import heapq
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, TypeVar

from ..decision.certificate import Certificate
from ..decision.intervals import wilson_interval
from ..decision.policy import Policy
from ..errors import SettingError, StoreError
from ..recipe import Recipe
from ..records import Action, Reason, TraceSpec, trace_in
from ..store.base import Store
from ..store.records import SAFE_MODE_BEGAN, SAFE_MODE_ENDED, Event, Key, Outcomes, StoredDecision, StoredVersion
from ..store.views import LABELS, HistoryFilter, Stretch, Tally

PAGE = 500  # decisions read at a time
NEWEST = 500  # decisions that are looked at apart
RECENT = 200  # labels that the share of novel traces is told of
EVENTS = 5  # newest ones that a status shows

Name = TypeVar("Name", bound=StrEnum)


@dataclass(frozen=True, slots=True)
class Judged:
    """Parts that the model was certain of, and how many of them it was wrong about, as far as that is known.

    n : parts.  known : those of them that the claim rests on.  wrong : of these.
    by : what tells: "every outcome", "audits", or "" where nothing does.
    lower, upper : Wilson interval of the share of wrong ones, at one look; 0 and 1 where nothing is known.
    tolerance : 1 - LB.  verdict : kept, broken or open, as far as the interval goes.
    """

    n: int
    known: int
    wrong: int
    by: str
    lower: float
    upper: float
    tolerance: float
    verdict: str


@dataclass(frozen=True, slots=True)
class Span:
    """Consecutive decisions, and what happened meanwhile.

    first, last : times of the oldest and the newest; None where there is none.
    verified : decided so, of which audits, novel, safe_mode, errors and quarantined were for these reasons.
    accepted, rejected : went on without a check.  stops : of the accepted, those known to be bad.
    rejected_good : audited parts that the model would have rejected, and were good.
    bad_accepts : parts that it let pass or would have, by the policy's alpha.
    would_accept, would_reject : by audits alone, in the shadow mode every part; at 95 %, whatever the policy's alpha.
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
    stops: int
    audited_rejects: int
    rejected_good: int
    would_accept: Judged
    would_reject: Judged
    bad_accepts: Judged
    unlabelled: int
    retrains: int
    dropped: dict[str, int]
    verified_share: float | None
    novel_share: float | None


@dataclass(frozen=True, slots=True)
class Watch:
    """How far each detector of the safe mode is on its way to an alarm, from 0 to 1."""

    accepts: float
    rejects: float
    novelty: float


@dataclass(frozen=True, slots=True)
class Status:
    """How an engine is doing; times in seconds since 1970.

    model : what a model that was handed in is called; None: the recipe describes it.
    version : of the model that answers; 0 before the first retrain.
    safe_mode : why everything is verified, "" where it is not.  safe_mode_time : when it began or ended, None: never.
    new_labels : since the newest retrain, of `recipe.retrain_every` that set one off.
    newest, ever : the newest `last` decisions, and all.
    unreported : accepted parts whose fate was never reported; of verified ones `ever.unlabelled` tells.
    sources : labels by their source.  corrected, forgotten : labels that were put right.
    recent, recent_novel : parts that the newest labels tell of, and those of them that were novel.
    events : the newest, oldest first.  watch : None where nothing is watched, or it was not asked for.
    store_fault, retraining : of a running engine, which alone knows.
    """

    cell: str
    product: str | None
    settings: dict[str, str]
    recipe: Recipe
    trace: TraceSpec | None
    model: str | None
    version: int
    shadow: bool
    safe_mode: str
    safe_mode_time: float | None
    new_labels: int
    last: int
    newest: Span
    ever: Span
    unreported: int
    actions: dict[str, int]
    reasons: dict[str, int]
    labels: int
    sources: dict[str, int]
    corrected: int
    forgotten: int
    last_label_time: float | None
    recent: int
    recent_novel: int
    certificate: Certificate
    retrains: tuple[StoredVersion, ...]
    events: tuple[Event, ...]
    write_failures: int
    watch: Watch | None
    store_fault: str = ""
    retraining: bool = False

    @property
    def alarm(self) -> str:
        """What somebody should look at, the worst first; "" where there is nothing."""
        accepts, errors = self.newest.bad_accepts, self.newest.errors
        alarms = (
            (self.store_fault, f"The store cannot be written: {self.store_fault}"),
            (self.safe_mode, f"Safe mode: {self.safe_mode}"),
            (
                accepts.verdict == "broken",
                f"More accepted parts are bad than the tolerance of {accepts.tolerance:.1%} allows.",
            ),
            (errors, f"The model failed on {errors} of the newest decisions."),
        )
        return next((text for wrong, text in alarms if wrong), "")


def status(store: Store, last: int = NEWEST, watching: bool = False) -> Status:
    """How the engine of a store is doing; last : the newest so many decisions are looked at apart.

    watching : read how far the safe mode's detectors are, too, which takes the newest version's arrays.
    StoreError for a store that no engine has used.
    """
    settings = store.settings()
    if "recipe" not in settings:
        raise StoreError(f"Expected a store that an engine has used, cell {store.cell_id!r} of this one is empty.")
    recipe, counts, retrains = Recipe.from_toml(settings["recipe"]), store.status(), store.versions(own=True)
    every, policy, events = store.tally(), recipe.policy, store.events()
    mode = next((event for event in reversed(events) if event.kind in MODES), None)
    # Labels are numbered from 1, or over a whole product.
    recent = store.evidence_since(counts["labels"] - RECENT if store.product is None else 0)
    outcomes, silent = every.outcomes, recent.silent[-RECENT:]
    return Status(
        cell=store.cell_id,
        product=counts.get("product"),
        settings=settings,
        recipe=recipe,
        trace=trace_in(settings),
        model=settings.get("model"),
        version=counts["last_version"] or 0,
        shadow=policy.shadow,
        safe_mode=mode.text if mode is not None and mode.kind == SAFE_MODE_BEGAN else "",
        safe_mode_time=None if mode is None else mode.time,
        new_labels=sum(not each.quarantined for each in store.past_labels(retrains[-1].last_seq if retrains else 0)),
        last=last,
        newest=_span(store.tally(last), retrains, policy),
        ever=_span(every, retrains, policy),
        unreported=outcomes.accepted - outcomes.stops - outcomes.confirmed,
        recent=len(silent) + int(silent.sum()),
        recent_novel=int(recent.novel[-RECENT:].sum()),
        certificate=policy.certificate(store.outcomes(int(settings.get("policy_since", 0)))),
        retrains=tuple(retrains),
        events=tuple(events[-EVENTS:]),
        watch=watch(store, recipe) if watching else None,
        **{name: counts[name] for name in COUNTED},
    )


MODES = (SAFE_MODE_BEGAN, SAFE_MODE_ENDED)
COUNTED = ("actions", "reasons", "labels", "sources", "corrected", "forgotten", "last_label_time", "write_failures")


def _span(tally: Tally, retrains: list[StoredVersion], policy: Policy) -> Span:
    outcomes, first, n = tally.outcomes, tally.first, tally.count()
    here = [each.report for each in retrains if first is not None and each.time >= first]
    reasons: Counter[Reason] = Counter()
    for kind in tally.kinds:
        reasons[kind.reason] += kind.n
    verified = tally.count(lambda kind: kind.action is Action.VERIFY)
    return Span(
        decisions=n,
        first=first,
        last=tally.last,
        verified=verified,
        audits=reasons[Reason.AUDIT],
        novel=reasons[Reason.NOVEL],
        safe_mode=reasons[Reason.SAFE_MODE],
        errors=reasons[Reason.MODEL_ERROR],
        quarantined=tally.count(lambda kind: kind.quarantined),
        accepted=outcomes.accepted,
        rejected=outcomes.rejected,
        stops=outcomes.stops,
        audited_rejects=outcomes.audited_rejects,
        rejected_good=outcomes.audited_rejects_good,
        would_accept=_judged(outcomes.audited_accepts, outcomes.audited_accepts_bad, policy),
        would_reject=_judged(outcomes.audited_rejects, outcomes.audited_rejects_good, policy),
        bad_accepts=bad_accepts(outcomes, policy),
        unlabelled=tally.count(lambda kind: kind.action is Action.VERIFY and kind.success is None),
        retrains=len(here),
        dropped=dict(Counter(report.reason for report in here if not report.accepted)),
        verified_share=verified / n if n else None,
        novel_share=reasons[Reason.NOVEL] / n if n else None,
    )


def _judged(
    known: int, wrong: int, policy: Policy, alpha: float = 0.05, n: int | None = None, by: str = "audits"
) -> Judged:
    low, high = wilson_interval(known - wrong, wrong, alpha)
    lower, upper, tolerance = 1.0 - high, 1.0 - low, 1.0 - policy.lower_bound
    verdict = "kept" if upper <= tolerance else "broken" if lower > tolerance else "open"
    return Judged(known if n is None else n, known, wrong, by if known else "", lower, upper, tolerance, verdict)


def bad_accepts(outcomes: Outcomes, policy: Policy) -> Judged:
    """How many of the parts that the model let pass were bad: by every outcome where all are known, else by audits.

    Under `stops="all"` a part whose silence is not over is left out. Audits speak for all: their coin knows no outcome.
    """
    n, heard = outcomes.accepted + outcomes.audited_accepts, outcomes.stops + outcomes.confirmed
    if heard and (policy.stops == "all" or outcomes.accepted == heard):
        return _judged(heard, outcomes.stops, policy, policy.alpha, n, "every outcome")
    return _judged(outcomes.audited_accepts, outcomes.audited_accepts_bad, policy, policy.alpha, n)


def watch(store: Store, recipe: Recipe) -> Watch | None:
    """What the rule that answers knows of drift; None where it watches nothing, or that is not kept."""
    from .explain import rule_now  # torch

    if recipe.policy.guarantee == "local" and recipe.policy.stops != "all":
        return None
    rule = rule_now(store, recipe.policy)
    if rule is None or rule.evidence is None:
        return None
    accepts, rejects, novelty = (max(0.0, capital / rule.evidence.alarm_at) for capital in rule.evidence.watch.tolist())
    return Watch(accepts, rejects, novelty)


@dataclass(frozen=True, slots=True)
class Course:
    """What a picture of a store is drawn from: consecutive decisions, retrains and events; last : looked at apart.

    modes : the events that began or ended the safe mode, oldest first.
    """

    stretches: list[Stretch]
    retrains: list[StoredVersion]
    modes: list[Event]
    tolerance: float
    last: int


STRETCHES = 120  # of a picture
FEWEST = 20  # decisions of a stretch: a share of fewer jumps


def course(store: Store, recipe: Recipe, last: int) -> Course:
    """Read what a picture is drawn from."""
    modes = [event for event in store.events() if event.kind in MODES]
    n = max(1, min(STRETCHES, store.tally().count() // FEWEST))
    return Course(store.stretches(n), store.versions(own=True), modes, 1.0 - recipe.policy.lower_bound, last)


def history(
    store: Store,
    last: int | None = None,
    action: Action | str | None = None,
    reason: Reason | str | None = None,
    label: str | None = None,
    since: float | None = None,
    until: float | None = None,
    predicted: Action | str | None = None,
) -> Iterator[StoredDecision]:
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
    return _forward(store, where) if last is None else _newest(store, where, last)


def _named(kind: type[Name], value: Name | str | None) -> Name | None:
    try:
        return None if value is None else kind(value)
    except ValueError:
        known = ", ".join(kind)
        raise SettingError(f"Expected {kind.__name__.lower()} to be one of {known}, got {value!r}.") from None


def _forward(store: Store, where: HistoryFilter) -> Iterator[StoredDecision]:
    beyond: Key | None = None
    while page := store.decisions(where, PAGE, beyond, newest=False):
        yield from page
        beyond = page[-1].key


def _newest(store: Store, where: HistoryFilter, last: int) -> Iterator[StoredDecision]:
    found: deque[StoredDecision] = deque()
    beyond: Key | None = None
    while len(found) < last and (page := store.decisions(where, min(PAGE, last - len(found)), beyond)):
        found.extendleft(reversed(page))
        beyond = page[0].key
    return iter(found)


def beside(store: Store, since: float | None = None, until: float | None = None) -> dict[str, list[StoredVersion | Event]]:
    """What happened beside the decisions, retrains and events, oldest first, between two times in seconds; None: any."""
    first, end = since or float("-inf"), float("inf") if until is None else until
    past: dict[str, list[Any]] = {"retrains": store.versions(own=True), "events": store.events()}
    return {name: [each for each in happened if first <= each.time < end] for name, happened in past.items()}


def interleaved(
    decisions: list[StoredDecision], others: Mapping[str, list[StoredVersion | Event]]
) -> Iterator[StoredDecision | StoredVersion | Event]:
    """All of it in the order in which it happened; what has the same time keeps that order too."""
    return heapq.merge(*others.values(), decisions, key=lambda each: each.time)
