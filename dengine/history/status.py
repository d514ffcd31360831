"""How an engine is doing, and the decisions of its past, read from its store; no trace is read.

found = status(store)
found.newest.verified_share, found.ever.bad_accepts.upper, found.alarm
for past in history(store, last=50, action="accept", label="bad"): ...
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import islice
from typing import TYPE_CHECKING, Any

from ..decision.certificate import Certificate
from ..decision.intervals import wilson_interval
from ..decision.policy import Policy
from ..errors import StoreError, expect
from ..recipe import Recipe
from ..records import Action, Decision, Reason, TraceSpec, stored_trace_spec
from ..representation import to_html
from ..store.records import SAFE_MODE_BEGAN, SAFE_MODE_ENDED, Event, Outcomes, StoredDecision, StoredVersion
from ..store.views import HistoryFilter, Stretch, Tally

if TYPE_CHECKING:
    import pandas as pd

    from ..store.sql import SqlStore

PAGE, MOST = 500, 10**9  # decisions read at a time, and that can be asked for
NEWEST = 500  # decisions that are looked at apart
FAILING = 3  # retrains in a row that were dropped: the first may come before there are enough labels
EVENTS = 5  # newest ones that a status shows


@dataclass(frozen=True, slots=True)
class Judged:
    """Parts that the model was certain of, and how many of them it was wrong about, as far as that is known.

    n : parts.  known : those of them that the claim rests on.  wrong : of these.
    by : what tells: "every outcome", "audits", "checks", as of the shadow mode, or "" where nothing does.
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
    outside : left an operator's window, and were verified or rejected without the model.
    verified : decided so, of which audits, novel, safe_mode, errors and quarantined were for these reasons.
    accepted, rejected : by the model, without a check.  false_accepts : of the accepted, those known to be bad.
    false_rejects : of the rejected, those that were looked at and found good.
    bad_accepts : parts that it let pass, and would have but for an audit, by the policy's alpha; of
        no part where none passed, as in the shadow mode.
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
    outside: int
    safe_mode: int
    errors: int
    quarantined: int
    accepted: int
    rejected: int
    false_accepts: int
    false_rejects: int
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


@dataclass(frozen=True, slots=True, repr=False)
class Status:
    """How an engine is doing; times in seconds since 1970.

    model : what a model that was handed in is called; None: the recipe describes it.
    version : of the model that answers; 0 before the first retrain.
    safe_mode : why everything is verified, "" where it is not.  safe_mode_time : when it began or ended, None: never.
    new_labels : since the newest retrain, of `recipe.retrain_every` that set one off.
    newest, ever : the newest `last` decisions, and all.
    unreported : accepted parts whose fate was never reported; of verified ones `ever.unlabelled` tells.
    sources : labels by their source.  corrected, forgotten : labels that were put right.
    events : the newest, oldest first.  watch : None where nothing is watched, or it was not asked for.
    store_fault, retraining : of a running engine, which alone knows, as of
    store_lag : the age in seconds of the oldest record that the store has not taken from the journal.
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
    certificate: Certificate
    retrains: tuple[StoredVersion, ...]
    events: tuple[Event, ...]
    watch: Watch | None
    store_fault: str = ""
    retraining: bool = False
    store_lag: float = 0.0

    _repr_html_ = to_html

    def __repr__(self) -> str:
        n = self.ever
        at = f"{self.cell}: version {self.version}, {n.decisions} decision{'' if n.decisions == 1 else 's'}"
        return f"<Status of {at}, {n.verified} verified, {n.accepted} accepted, {n.false_accepts} known bad, {n.rejected} rejected>"

    @property
    def alarm(self) -> str:
        """What somebody should look at, the worst first; "" where there is nothing."""
        accepts = self.newest.bad_accepts
        errors = self.newest.errors
        false_rejects = self.newest.false_rejects
        rejects = _judged(self.newest.rejected, false_rejects, self.recipe.policy.tolerances[1])
        found_good = (
            f"{false_rejects} of the {rejects.n} newest rejected parts were good: more than {rejects.tolerance:.1%}."
        )
        would_accept = self.newest.would_accept
        reports = [retrain.report for retrain in self.retrains]
        newest_accepted = max((i for i, report in enumerate(reports, 1) if report.accepted), default=0)
        failing = retrain_fault([report.reason for report in reports[newest_accepted:]], self.version)
        broken = f"More accepted parts are bad than the tolerance of {accepts.tolerance:.1%} allows."
        would_break = f"It would break the tolerance of {would_accept.tolerance:.1%}."
        alarms = (
            (self.store_fault, f"The store cannot be written: {self.store_fault}"),
            (self.safe_mode, f"Safe mode: {self.safe_mode}"),
            (accepts.verdict == "broken", broken),
            (false_rejects and rejects.verdict == "broken", found_good),
            (failing, failing),
            (self.shadow and would_accept.verdict == "broken", would_break),
            (2 * self.newest.novel > self.newest.decisions, f"{self.newest.novel} of the newest traces are novel."),
            (2 * self.newest.outside > self.newest.decisions, f"{self.newest.outside} of the newest parts leave a window."),
            (errors, f"The model failed on {errors} of the newest decisions."),
        )
        return next((text for wrong, text in alarms if wrong), "")


def retrain_fault(dropped: Sequence[str], version: int) -> str:
    """Return what somebody should look at where retrains are dropped again and again, else "".

    Parameters
    ----------
    dropped : sequence of str
        Reasons of the retrains that were dropped since the last one that was accepted.
    version : int
        Of the model that answers; 0 before the first.
    """
    if len(dropped) < FAILING:
        return ""
    last = f"the last was {dropped[-1].rstrip('.')}."
    if not version:
        return f"No retrain was accepted yet, so nothing is decided; {last}"
    return f"The last {len(dropped)} retrains were dropped, so nothing new is learned; {last}"


def status(store: SqlStore, last: int = NEWEST, watching: bool = False) -> Status:
    """How the engine of a store is doing; last : the newest so many decisions are looked at apart.

    watching : read how far the safe mode's detectors are, too, which takes the newest version's arrays.
    StoreError for a store that no engine has used.
    """
    settings = store.settings()
    if "recipe" not in settings:
        raise StoreError(f"Expected a store that an engine has used, cell {store.cell_id!r} of this one is empty.")
    recipe, counts, retrains = Recipe.from_store(settings), store.status(), store.versions(cell_only=True)
    every, policy, events = store.tally(), recipe.policy, store.events()
    mode = next((event for event in reversed(events) if event.kind in MODES), None)
    outcomes, since = every.outcomes, int(settings.get("policy_since", 0))
    return Status(
        cell=store.cell_id,
        product=store.product,
        settings=settings,
        recipe=recipe,
        trace=stored_trace_spec(settings),
        model=settings.get("model"),
        version=next((each.version for each in reversed(store.retrains()) if each.accepted), 0),
        shadow=policy.shadow,
        safe_mode=mode.text if mode is not None and mode.kind == SAFE_MODE_BEGAN else "",
        safe_mode_time=None if mode is None else mode.time,
        new_labels=sum(not each.quarantined for each in store.past_labels(retrains[-1].last_seq if retrains else 0)),
        last=last,
        newest=_span(store.tally(last), retrains, policy),
        ever=_span(every, retrains, policy),
        unreported=outcomes.accepted - outcomes.false_accepts - outcomes.confirmed,
        certificate=policy.certificate(store.tally(since_version=since, within=policy.label_within).outcomes),
        retrains=tuple(retrains),
        events=tuple(events[-EVENTS:]),
        watch=watch(store, recipe) if watching else None,
        **{name: counts[name] for name in COUNTED},
    )


MODES = (SAFE_MODE_BEGAN, SAFE_MODE_ENDED)
COUNTED = ("actions", "reasons", "labels", "sources", "corrected", "forgotten")


def _span(tally: Tally, retrains: list[StoredVersion], policy: Policy) -> Span:
    outcomes, first, n, reasons = tally.outcomes, tally.first, tally.count(), tally.by("reason")
    here = [each.report for each in retrains if first is not None and each.time >= first]
    verified = tally.by("action")[Action.VERIFY]
    by = "audits" if policy.audit_rate else "checks"
    accepts = (outcomes.audited_accepts, outcomes.audited_accepts_bad, policy.tolerances[0])
    rejects = (outcomes.audited_rejects, outcomes.audited_rejects_good, policy.tolerances[1])
    return Span(
        decisions=n,
        first=first,
        last=tally.last,
        verified=verified,
        audits=reasons[Reason.AUDIT],
        novel=reasons[Reason.NOVEL],
        outside=reasons[Reason.OUTSIDE],
        safe_mode=reasons[Reason.SAFE_MODE],
        errors=reasons[Reason.MODEL_ERROR],
        quarantined=tally.by("quarantined")[True],
        accepted=outcomes.accepted,
        rejected=outcomes.rejected,
        false_accepts=outcomes.false_accepts,
        false_rejects=outcomes.false_rejects,
        would_accept=_judged(*accepts, by=by),
        would_reject=_judged(*rejects, by=by),
        bad_accepts=bad_accepts(outcomes, policy),
        unlabelled=tally.count(lambda group: group.action is Action.VERIFY and group.success is None),
        retrains=len(here),
        dropped=dict(Counter(report.reason for report in here if not report.accepted)),
        verified_share=verified / n if n else None,
        novel_share=reasons[Reason.NOVEL] / n if n else None,
    )


def _judged(known: int, wrong: int, most: float, alpha: float = 0.05, n: int | None = None, by: str = "audits") -> Judged:
    low, high = wilson_interval(known - wrong, wrong, alpha)
    lower, upper = 1.0 - high, 1.0 - low
    by = by if known else ""
    return Judged(known if n is None else n, known, wrong, by, lower, upper, most, _verdict(lower, upper, most))


def _verdict(lower: float, upper: float, tolerance: float) -> str:
    return "kept" if upper <= tolerance else "broken" if lower > tolerance else "open"


def bad_accepts(outcomes: Outcomes, policy: Policy) -> Judged:
    """How many of the parts that the model let pass were bad: by every outcome where all are known, else by audits.

    Under `stops="all"` a part whose silence is not over is left out. Audits speak for all: their coin knows no outcome.
    Stops are known beside them: the lower end is at least that of the stops if all others were good, the upper their share.
    Where no part passed nothing is said of what did: `would_accept` counts those of the shadow mode.
    """
    if not outcomes.accepted:
        return _judged(0, 0, policy.tolerances[0], policy.alpha)
    n, heard = outcomes.accepted + outcomes.audited_accepts, outcomes.false_accepts + outcomes.confirmed
    if heard and (policy.stops == "all" or outcomes.accepted == heard):
        return _judged(heard, outcomes.false_accepts, policy.tolerances[0], policy.alpha, n, "every outcome")
    said = _judged(outcomes.audited_accepts, outcomes.audited_accepts_bad, policy.tolerances[0], policy.alpha, n)
    quiet = outcomes.accepted - outcomes.false_accepts
    lower = max(said.lower, 1.0 - wilson_interval(quiet, outcomes.false_accepts, policy.alpha)[1])
    upper = max(said.upper, outcomes.false_accepts / max(1, outcomes.accepted))
    return replace(said, lower=lower, upper=upper, verdict=_verdict(lower, upper, said.tolerance))


def watch(store: SqlStore, recipe: Recipe) -> Watch | None:
    """What the rule that answers knows of drift; None where it watches nothing, or that is not kept."""
    from ..decision.member_rules import MemberRule  # torch
    from .explain import rule_now

    if recipe.policy.guarantee == "local" and recipe.policy.stops != "all":
        return None
    rule = rule_now(store, recipe.policy)
    if not isinstance(rule, MemberRule):
        return None
    limits, mode = rule.evidence.alarm_limits, rule.safe_mode()
    sums = [0.0 if mode == 3 else each for each in rule.evidence.detector_sums.tolist()]
    return Watch(*(max(0.0, each / limit) for each, limit in zip(sums, limits, strict=True)))


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


def course(store: SqlStore, recipe: Recipe, last: int, **by: Any) -> Course:
    """Read what a picture is drawn from; by : as of `SqlStore.stretches`, of which the newest are drawn."""
    modes = [event for event in store.events() if event.kind in MODES]
    stretches = store.stretches(max(1, min(STRETCHES, store.tally().count() // FEWEST)), **by)[-STRETCHES:]
    return Course(stretches, store.versions(cell_only=True), modes, recipe.policy.tolerances[0], last)


def history(store: SqlStore, last: int | None = None, **where: Any) -> Iterator[StoredDecision]:
    """The decisions of a store, newest last, one after the other as they are read.

    last : the newest so many of those that are meant; None: all.  where : which are meant, as `HistoryFilter` takes it.
    Raises SettingError for a value that is none of these.
    """
    whole = last is None or 1 <= last < MOST
    expect(whole, f"last to be 1 or more, below {MOST:,}", last, "leave it out for all decisions")
    meant = HistoryFilter(**where)
    if last is None:
        return paged(store, meant, newest=False)
    return iter([*islice(paged(store, meant, min(PAGE, last)), last)][::-1])


def paged(
    store: SqlStore, where: HistoryFilter, page: int = PAGE, beyond: str | None = None, newest: bool = True
) -> Iterator[StoredDecision]:
    """The decisions that are meant, newest (or oldest) first, so many read at a time; beyond : the one of this id."""
    while found := store.decisions(where, page, beyond, newest):
        found = found[::-1] if newest else found
        yield from found
        beyond = found[-1].decision.id


def as_frame(decisions: Iterable[StoredDecision]) -> pd.DataFrame:
    """A row a decision, by its id: what was decided, when, as a datetime in UTC, on what evidence, and the label."""
    import pandas as pd

    found = list(decisions)
    names = [each.name for each in fields(Decision) if each.name != "embedding"]
    rows = pd.DataFrame([[getattr(each.decision, name) for name in names] for each in found], columns=names)
    rows.insert(1, "time", pd.to_datetime([each.time for each in found], unit="s", utc=True))
    return rows.assign(label=[each.label if each.success is not None else None for each in found]).set_index("id")


def beside(
    store: SqlStore, since: float | None = None, until: float | None = None
) -> dict[str, list[StoredVersion | Event]]:
    """What happened beside the decisions, retrains and events, oldest first, between two times in seconds; None: any."""
    first, end = since or float("-inf"), float("inf") if until is None else until
    past: dict[str, list[Any]] = {"retrains": store.versions(cell_only=True), "events": store.events()}
    return {name: [each for each in happened if first <= each.time < end] for name, happened in past.items()}
