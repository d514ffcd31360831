"""The status of an engine and the history of its decisions, read from its store without traces.
`status` returns a `Status` (counts, error estimates, certificate, alarm), `history` iterates over
decisions, `as_frame` makes a DataFrame of them, `read_course` returns counts over time for a
picture. `DataEngine.status` and `history`, the command line, the web page and the servers show
them.

    report = status(store)
    report.newest.verified_share, report.ever.bad_accepts.upper, report.alarm
    for item in history(store, last=50, action="accept", label="bad"): ...
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import takewhile
from typing import TYPE_CHECKING, Any

from ..decision.certificate import Certificate
from ..decision.intervals import wilson_interval
from ..decision.policy import Policy
from ..errors import StoreError, expect
from ..recipe import Recipe
from ..records import (
    REPEATS,
    REPEATS_MEANING,
    TRAINED,
    Action,
    Decision,
    Reason,
    RetrainReport,
    TraceSpec,
    stored_trace_spec,
)
from ..representation import to_jsonable
from ..store.records import (
    LOSS_REMEDY,
    SAFE_MODE_BEGAN,
    SAFE_MODE_ENDED,
    Event,
    Outcomes,
    StoredDecision,
    StoredVersion,
    open_losses,
)
from ..store.views import HistoryFilter, Stretch, Tally

if TYPE_CHECKING:
    import pandas as pd

    from ..store.sql import SqlStore

PAGE_SIZE = 500  # decisions read at a time
MAX_LAST = 10**9  # decisions that can be asked for
Counts = dict[str, int]  # by name
NEWEST = 500  # decisions that `Status.newest` counts
MAX_DROPPED = 3  # dropped retrains in a row that are an alarm: the first may lack labels
MAX_SINCE_ALARM = 10_000  # decisions that are counted
N_EVENTS = 5  # newest events that a status shows


@dataclass(frozen=True, slots=True)
class ErrorEstimate:
    """The share of parts about which the model was certain and wrong, as far as it is known.

    Attributes
    ----------
    n : int
        Parts about which the model was certain.
    n_known : int
        Those of them whose outcomes the estimate rests on.
    n_wrong : int
        Those of these about which it was wrong.
    basis : str
        Where the outcomes come from: "every outcome", "audits", "checks" (in shadow mode), or "" if
        none is known.
    lower, upper : float
        Wilson interval of the share of wrong ones, which holds for a single look and not at all
        times together; 0 and 1 if nothing is known.
    tolerance : float
        The share that the policy allows: 1 - LB, or what the prices of the guarantee "cost" give.
    verdict : {"kept", "broken", "open"}
        Whether the interval is below the tolerance, above it, or contains it.
    """

    n: int
    n_known: int
    n_wrong: int
    basis: str
    lower: float
    upper: float
    tolerance: float
    verdict: str


@dataclass(frozen=True, slots=True)
class Span:
    """Counts over consecutive decisions and the retrains meanwhile.

    Attributes
    ----------
    decisions : int
    first, last : float or None
        Times of the oldest and the newest decision, in seconds since 1970; None without decisions.
    verified : int
        Decided VERIFY.
    audits, novel, safe_mode, errors, quarantined : int
        Verified for these reasons.
    outside : int
        Outside an operator's limits, and verified or rejected without the model.
    accepted, rejected : int
        By the model, without a check.
    false_accepts : int
        Accepted parts that are known to be bad.
    false_rejects : int
        Rejected parts that somebody inspected and found good.
    would_accept, would_reject : ErrorEstimate
        How often the model would have been wrong, by the audited parts alone (in shadow mode these
        are all parts about which it was certain), at 95 %, whatever the policy's alpha.
    bad_accepts : ErrorEstimate
        Of the parts that the model accepted, and those that it would have accepted if they had not
        been audited, at the policy's alpha. Its `n` is 0 if none was accepted, like in shadow mode.
    unlabelled : int
        Verified parts without a label, a forgotten one included.
    retrains : int
    dropped : dict of str to int
        Reasons of dropped retrains, and how often each.
    verified_share, novel_share : float or None
        Shares of the decisions; None without decisions.
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
    would_accept: ErrorEstimate
    would_reject: ErrorEstimate
    bad_accepts: ErrorEstimate
    unlabelled: int
    retrains: int
    dropped: Counts
    verified_share: float | None
    novel_share: float | None


@dataclass(frozen=True, slots=True)
class Watch:
    """How close each detector of drift is to an alarm, and a safe mode to its end.

    Attributes
    ----------
    recovery : str
        In safe mode a text: how many parts since the alarm count as evidence, and after about how
        many more parts safe mode ends, if everything goes on as it has since the alarm. "" outside
        safe mode. If novel traces began the safe mode, the evidence is that for accepting.
    accepts, rejects, novelty : float
        From 0 to 1; at 1 the alarm begins safe mode. All are 0 in a safe mode that novel traces
        began.
    """

    recovery: str
    accepts: float
    rejects: float
    novelty: float


@dataclass(frozen=True, slots=True)
class Status:
    """The status of an engine. Times are in seconds since 1970.

    Attributes
    ----------
    cell : str
    product : str or None
    settings : dict of str to str
        As stored.
    recipe : Recipe
    trace : TraceSpec or None
        None before the first trace.
    model : str or None
        Name of a model that was handed in; None: the recipe describes the model.
    version : int
        Number of the version in force; 0 before the first.
    shadow : bool
        Whether every part is verified and the model only observes.
    pinned : int
        Number of the version that a rollback put in force, while no automatic retrain replaces it;
        0: none is pinned.
    safe_mode : str
        Why the safe mode began; "" outside safe mode.
    safe_mode_time : float or None
        When safe mode last began or ended; None: never.
    new_labels : int
        Labels since the newest retrain, even if that was dropped; `recipe.retrain_every` of them
        start the next.
    last : int
        Largest number of decisions that `newest` counts.
    newest, ever : Span
        The newest decisions, and all decisions.
    unreported : int
        Accepted parts without a label, a forgotten one included; see `ever.unlabelled` for
        verified ones.
    actions, reasons, sources : dict of str to int
        Decisions by action and by reason, labels by source.
    labels, corrected, forgotten : int
        Labels that count; labels that were corrected or forgotten.
    certificate : Certificate
    retrains : tuple of StoredVersion
        Of this robot cell, oldest first.
    events : tuple of Event
        The newest, oldest first.
    watch : Watch or None
        None if nothing is watched, or it was not asked for.
    loss : str
        What data was lost and what to do, until somebody acknowledges it; "" if nothing was.
    store_fault : str
        Of a running engine: what is wrong with the store; "" if nothing is.
    retraining : bool
        Of a running engine: whether a retrain is under way.
    store_lag : float
        Of a running engine: age in seconds of the oldest record that is in the journal and not yet
        in the store.
    """

    cell: str
    product: str | None
    settings: dict[str, str]
    recipe: Recipe
    trace: TraceSpec | None
    model: str | None
    version: int
    pinned: int
    shadow: bool
    safe_mode: str
    safe_mode_time: float | None
    new_labels: int
    last: int
    newest: Span
    ever: Span
    unreported: int
    actions: Counts
    reasons: Counts
    labels: int
    sources: Counts
    corrected: int
    forgotten: int
    certificate: Certificate
    retrains: tuple[StoredVersion, ...]
    events: tuple[Event, ...]
    watch: Watch | None
    loss: str = ""
    store_fault: str = ""
    retraining: bool = False
    store_lag: float = 0.0

    @property
    def alarm(self) -> str:
        """The most urgent thing that somebody should look at, in a sentence; "" if there is none.

        The first of these that applies: a fault of the store, lost data, safe mode (after an alarm
        parts are checked until outcomes allow decisions again), too many bad parts among the
        accepted, too many good parts among the rejected, the last 3 or more retrains dropped (their
        models were not put in force), many traces that nearly repeat another (as the reason of the
        newest accepted training says), in shadow mode (every part is checked) too many bad parts
        among those that the model would have accepted, mostly novel traces (unlike all training
        traces), mostly parts outside the force limits (an operator's limits of the signal), any
        part for which the model raised an exception. "Too many" means that the confidence interval
        of their share lies above the tolerance, the share that the policy allows: at the policy's
        alpha for accepted parts (`bad_accepts`), at 95 % for the others, where a rejected part of
        unknown outcome counts as bad. "Mostly" means more than half. Parts are counted over the
        newest decisions alone (`newest`).
        """
        newest = self.newest
        accepts = newest.bad_accepts
        would_accept = newest.would_accept
        rejects = _estimate_error(
            newest.rejected, newest.false_rejects, self.recipe.policy.tolerances[1]
        )
        reports = [retrain.report for retrain in self.retrains]
        dropped = takewhile(lambda report: not report.accepted, reversed(reports))
        failing = retrain_fault([report.reason for report in dropped][::-1], self.version)
        trained = [report.reason for report in reports if report.reason.startswith(TRAINED)]
        repeats = re.search(rf"[^;:]* {REPEATS}", "".join(trained[-1:]))
        alarms = (
            (self.store_fault, f"The store cannot be written: {self.store_fault}"),
            (self.loss, self.loss),
            (self.safe_mode, f"Safe mode: {self.safe_mode}"),
            (
                accepts.verdict == "broken",
                f"More accepted parts are bad than the tolerance of {accepts.tolerance:.1%} "
                "allows.",
            ),
            (
                newest.false_rejects and rejects.verdict == "broken",
                f"{newest.false_rejects} of the {rejects.n} newest rejected parts were good: "
                f"more than {rejects.tolerance:.1%}.",
            ),
            (failing, failing),
            (repeats, f"{repeats and repeats[0].strip()}. {REPEATS_MEANING}"),
            (
                self.shadow and would_accept.verdict == "broken",
                f"It would break the tolerance of {would_accept.tolerance:.1%}.",
            ),
            (
                2 * newest.novel > newest.decisions,
                f"{newest.novel} of the newest traces are novel.",
            ),
            (
                2 * newest.outside > newest.decisions,
                f"{newest.outside} of the newest parts leave the force limits.",
            ),
            (newest.errors, f"The model failed on {newest.errors} of the newest decisions."),
        )
        return next((text for is_raised, text in alarms if is_raised), "")


def retrain_fault(dropped: Sequence[str], version: int) -> str:
    """Return an alarm in words if the last 3 or more retrains were dropped, else "".

    A retrain is dropped if its model is not put in force. The alarm has the reason of the last one,
    and says if there is no version yet, so that nothing is decided without a check.

    Parameters
    ----------
    dropped : sequence of str
        Reasons of the retrains that were dropped since the last one that was put in force, oldest
        first.
    version : int
        Number of the model version in force; 0 before the first.

    Returns
    -------
    str
    """
    if len(dropped) < MAX_DROPPED:
        return ""
    last = f"the last was {dropped[-1].rstrip('.')}."
    if not version:
        return f"No retrain was accepted yet, so nothing is decided; {last}"
    return f"The last {len(dropped)} retrains were dropped, so nothing new is learned; {last}"


def status(store: SqlStore, last: int = NEWEST, watching: bool = False) -> Status:
    """Read the status of an engine from its store.

    A label since the newest retrain that is damaged (not as it was stored) is left out, and an
    event is written to the store's log. The arrays of the newest model version are read for
    `Status.watch`, and also if this version was not trained, but made by a rollback (an earlier
    version was put in force again and pinned), by a release (the pinned version may be replaced
    again) or by a change of policy. If they are damaged, an event is written, too, and those of the
    version before it are taken.

    Parameters
    ----------
    store : SqlStore
    last : int, default 500
        Number of newest decisions that `Status.newest` counts.
    watching : bool, default False
        Whether `Status.watch` is computed, too: how close each detector of drift is to an alarm. It
        is None without detectors. The guarantee (the rule that decides) "local" has none with
        stops="some" (bad accepted parts may go unreported); no arrays are read for it then.

    Returns
    -------
    Status
        Counts, settings, certificate (upper bounds on the shares of wrong decisions), retrains,
        newest events and more; see its attributes. Its `store_fault` is "", `retraining` False and
        `store_lag` 0.0: only a running engine knows them.

    Raises
    ------
    StoreError
        For a store that no engine has used, for a damaged `TraceSpec`, a recipe that lacks settings
        or another stored value that cannot be read, and if the database fails.
    SettingError
        For a stored recipe that cannot be read; with `watching` also if an object of the user's
        class of decision rule cannot be made. An error of the rule's constructor other than
        TypeError, and any error of its `observe` or `update`, is raised as it is.
    ValueError
        For a stored setting that must be a number and is none.
    """
    settings = store.settings.read()
    if "recipe" not in settings:
        raise StoreError(
            f"Expected a store that an engine has used, cell {store.cell_id!r} of this one is "
            "empty."
        )
    recipe = Recipe.from_store(settings)
    policy = recipe.policy
    within = policy.label_within
    tally = store.decisions.tally(within=within)  # seconds, in a store of a million decisions
    counts = store.decisions.counts(tally)
    outcomes = tally.outcomes
    events = store.events.newest()
    losses = [event.text for event in open_losses(events)]
    mode = next(
        (item for item in reversed(events) if item.kind in (SAFE_MODE_BEGAN, SAFE_MODE_ENDED)),
        None,
    )
    began = mode if mode is not None and mode.kind == SAFE_MODE_BEGAN else None
    retrains = store.versions.all(cell_only=True)
    last_seq = retrains[-1].last_seq if retrains else 0
    accepted = [report for report in store.versions.retrains() if report.accepted]
    since = int(settings.get("policy_since", 0))
    in_force = store.decisions.tally(since_version=since, within=within) if since else tally
    return Status(
        cell=store.cell_id,
        product=store.product,
        settings=settings,
        recipe=recipe,
        trace=stored_trace_spec(settings),
        model=settings.get("model"),
        version=accepted[-1].version if accepted else 0,
        pinned=_read_pinned(store, accepted),
        shadow=policy.shadow,
        safe_mode="" if began is None else began.text,
        safe_mode_time=None if mode is None else mode.time,
        new_labels=sum(not label.quarantined for label in store.labels.past(last_seq)),
        last=last,
        newest=_count_span(store.decisions.tally(last), retrains, policy),
        ever=_count_span(tally, retrains, policy),
        unreported=outcomes.accepted - outcomes.false_accepts - outcomes.confirmed,
        certificate=policy.certificate(in_force.outcomes),
        retrains=tuple(retrains),
        events=tuple(events[-N_EVENTS:]),
        watch=read_watch(store, recipe, began) if watching else None,
        loss=" ".join(["Data was lost:", *losses, LOSS_REMEDY]) if losses else "",
        **{name: counts[name] for name in COUNTED},
    )


def _read_pinned(store: SqlStore, accepted: list[RetrainReport]) -> int:
    """Return the number of the earlier version that a rollback put in force again, else 0.

    Such a version is pinned: no automatic retrain replaces it until it is released. Its number
    stands among the arrays of the newest version. `accepted` holds the reports of all versions that
    were put in force, oldest first. If the newest of them was trained, nothing is pinned, and no
    arrays are read. If the arrays of the newest version are damaged (not as they were stored), an
    event is written to the store's log, and those of the version before count.
    """
    if not accepted or accepted[-1].reason.startswith(TRAINED):  # spares reading its arrays
        return 0
    version = store.versions.newest()
    return 0 if version is None else int(version.state.get("pinned", 0))


COUNTED = ("actions", "reasons", "labels", "sources", "corrected", "forgotten")


def _count_span(tally: Tally, retrains: list[StoredVersion], policy: Policy) -> Span:
    """Return the counts over a tally's decisions, and over the retrains since the first decision.

    Without decisions no retrain counts. A `Tally` holds how many decisions have each combination of
    properties, like action and reason; `retrains` are all retrains of the robot cell.
    `would_accept` and `would_reject` estimate how often the model would have been wrong, from parts
    about which it was certain, but which were checked all the same (audits). Their intervals are at
    95 %, whatever the policy's alpha. Their `basis` is "audits", or "checks" if the present policy
    has no audit rate (as in shadow mode, in which every part is checked), or "" if no outcome is
    known.
    """
    outcomes = tally.outcomes
    first = tally.first
    n = tally.count()
    reasons = tally.by("reason")
    reports = [
        retrain.report for retrain in retrains if first is not None and retrain.time >= first
    ]
    verified = tally.by("action")[Action.VERIFY]
    basis = "audits" if policy.audit_rate else "checks"
    accept_tolerance, reject_tolerance = policy.tolerances
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
        would_accept=_estimate_error(
            outcomes.audited_accepts, outcomes.audited_accepts_bad, accept_tolerance, basis=basis
        ),
        would_reject=_estimate_error(
            outcomes.audited_rejects, outcomes.audited_rejects_good, reject_tolerance, basis=basis
        ),
        bad_accepts=bad_accepts(outcomes, policy),
        unlabelled=sum(
            group.n
            for group in tally.groups
            if group.action is Action.VERIFY and group.success is None
        ),
        retrains=len(reports),
        dropped=dict(Counter(report.reason for report in reports if not report.accepted)),
        verified_share=verified / n if n else None,
        novel_share=reasons[Reason.NOVEL] / n if n else None,
    )


def _estimate_error(
    n_known: int,
    n_wrong: int,
    tolerance: float,
    alpha: float = 0.05,
    n: int | None = None,
    basis: str = "audits",
) -> ErrorEstimate:
    """Estimate the share of wrong decisions from `n_wrong` wrong ones among `n_known` ones.

    `n_known` is the number of parts whose outcomes are known, and `n` that of all parts, by default
    `n_known`; `n` is only passed on. The bounds are the two-sided Wilson interval at error level
    `alpha`, and the verdict says whether this interval is below `tolerance`, the share that is
    allowed ("kept"), above ("broken"), or neither ("open"). `basis` says in a word where the
    outcomes come from. If `n_known` is 0, the bounds are 0 and 1, and the basis is "", and the
    verdict is "open" for any tolerance below 1.
    """
    low, high = wilson_interval(n_known - n_wrong, n_wrong, alpha)
    lower = 1.0 - high
    upper = 1.0 - low
    return ErrorEstimate(
        n=n_known if n is None else n,
        n_known=n_known,
        n_wrong=n_wrong,
        basis=basis if n_known else "",
        lower=lower,
        upper=upper,
        tolerance=tolerance,
        verdict=_verdict(lower, upper, tolerance),
    )


def _verdict(lower: float, upper: float, tolerance: float) -> str:
    """Return "kept" if the interval is below the tolerance, "broken" if above, else "open".

    An upper end equal to the tolerance is below it; a lower end equal to it is not above it.
    """
    if upper <= tolerance:
        return "kept"
    return "broken" if lower > tolerance else "open"


def bad_accepts(outcomes: Outcomes, policy: Policy) -> ErrorEstimate:
    """Estimate the share of bad parts among those that the model would have accepted.

    These are the accepted parts, and the audited parts (drawn at random and checked, although the
    model was certain) that have a label and would have been accepted; `n` counts both. A label that
    a person withdrew does not count. If the outcomes of all accepted parts are known, the estimate
    rests on these outcomes. Under `stops="all"` (every bad accepted part stops the line and is
    reported) one known outcome is enough; accepted parts without a report are then left out.
    Otherwise the estimate rests on the audits, because their draw does not depend on the outcome.
    Line stops, the accepted parts that are known to be bad, then move the interval: its lower end
    is at least the one that follows if all other accepted parts were good, and its upper end at
    least the share of line stops among the accepted parts.

    Parameters
    ----------
    outcomes : Outcomes
        Counts of accepted and audited parts by label.
    policy : Policy

    Returns
    -------
    ErrorEstimate
        Share, interval at the policy's alpha, and verdict: whether the interval is below the
        tolerance ("kept"), above ("broken") or neither ("open"). If no part was accepted, like in
        shadow mode (every part is checked), its `n` is 0, even if parts were audited; see
        `Span.would_accept` then.
    """
    tolerance = policy.tolerances[0]
    if not outcomes.accepted:
        return _estimate_error(0, 0, tolerance, policy.alpha)
    n = outcomes.accepted + outcomes.audited_accepts
    reported = outcomes.false_accepts + outcomes.confirmed
    if reported and (policy.stops == "all" or outcomes.accepted == reported):
        return _estimate_error(
            reported, outcomes.false_accepts, tolerance, policy.alpha, n, "every outcome"
        )
    audited = _estimate_error(
        outcomes.audited_accepts, outcomes.audited_accepts_bad, tolerance, policy.alpha, n
    )
    stops = _estimate_error(outcomes.accepted, outcomes.false_accepts, tolerance, policy.alpha)
    lower = max(audited.lower, stops.lower)
    upper = max(audited.upper, outcomes.false_accepts / outcomes.accepted)
    return replace(audited, lower=lower, upper=upper, verdict=_verdict(lower, upper, tolerance))


def read_watch(store: SqlStore, recipe: Recipe, began: Event | None) -> Watch | None:
    """Return how close the drift detectors are to an alarm, and a safe mode to its end.

    A drift detector is a running test for more wrong decisions than allowed (`accepts`, `rejects`),
    or for many novel traces (`novelty`). Its alarm begins a safe mode, in which parts are checked
    until new outcomes allow decisions again. Both are read from the present decision rule, which
    `load_rule` returns. None if it returns None, and if the rule has no drift detectors: that of
    the guarantee "local" with stops="some", and a user's rule that is no `MemberRule`, the base
    class of the rules with drift detectors. The three values grow from 0 to 1, the alarm. In a safe
    mode that novel traces began, all three are 0.

    The text `recovery` says how many parts since the alarm (10,001 are counted at most) count as
    evidence, for how many of these accepting (rejecting, after an alarm about rejected parts) would
    have been wrong, and after about how many more parts the safe mode ends; or that the evidence is
    enough, or that the safe mode does not end, if it would take more than 10,000 more parts. It is
    "" outside safe mode. `began` is the event at which the safe mode began; without it `recovery`
    is "". The rule can be in a safe mode of which there is no event yet, or never will be, because
    the engine was killed in between. Raises what `load_rule` and a user's rule raise, and may write
    an event to the store as `load_rule` does.
    """
    from ..decision.member_rules import MemberRule  # torch
    from .past_versions import load_rule

    policy = recipe.policy
    if (policy.guarantee, policy.stops) == ("local", "some"):
        return None
    rule = load_rule(store, policy)
    if not isinstance(rule, MemberRule):
        return None
    evidence = rule.evidence
    safe_mode = rule.safe_mode()
    recovery = ""
    if safe_mode and began is not None:
        side = (safe_mode - 1) % 2
        n, n_wrong = evidence.member_counts_since_alarm[side].sum(0).tolist()
        # With the part that raised the alarm.
        n_parts = 1 + len(store.decisions.select(HistoryFilter(since=began.time), MAX_SINCE_ALARM))
        n_more = evidence.members_to_recovery(side) * n_parts / (n + 1)
        end = f"if this goes on, safe mode ends after about {n_more:.0f} more parts"
        if n_more <= 0.0:
            end = "this is enough: safe mode ends when few of the newest are wrong or novel"
        elif n_more > MAX_SINCE_ALARM:
            end = "if this goes on, safe mode does not end"
        recovery = (
            f"{n} of {n_parts} parts since the alarm count as evidence, "
            f"{n_wrong} of them wrong; {end}"
        )
    sums = zip(evidence.detector_sums.tolist(), evidence.alarm_limits, strict=True)
    return Watch(recovery, *(max(0.0, total / limit) * (safe_mode != 3) for total, limit in sums))


@dataclass(frozen=True, slots=True)
class Course:
    """The course of a store over time, from which the web page draws its picture.

    Attributes
    ----------
    stretches : list of Stretch
        Counts over consecutive decisions, oldest first.
    retrains : list of StoredVersion
        Of this robot cell.
    """

    stretches: list[Stretch]
    retrains: list[StoredVersion]


MAX_STRETCHES = 120  # of a picture
MIN_STRETCH = 20  # decisions of a stretch: a share of fewer jumps


def read_course(store: SqlStore, **by: float) -> Course:
    """Read the course of a store: counts over time, and retrains.

    A stretch is a number of consecutive decisions that are counted together.

    Parameters
    ----------
    store : SqlStore
    **by
        For stretches that are periods of time: their length `seconds`, and `start`, a time in
        seconds since 1970 at which one begins (there may be earlier ones); only the newest 120 with
        decisions are returned. Without them all decisions of the robot cell are split into at most
        120 stretches of equal number, at least 20 each; the newest may have fewer.

    Returns
    -------
    Course
        For each stretch, oldest first, how many decisions it has, and how many of these were
        verified, accepted, rejected and so on; and all retrains of this cell, also those before the
        first stretch.
    """
    n = max(1, min(MAX_STRETCHES, store.decisions.newest_number() // MIN_STRETCH))
    return Course(
        stretches=store.decisions.stretches(n, **by)[-MAX_STRETCHES:],
        retrains=store.versions.all(cell_only=True),
    )


def history(store: SqlStore, last: int | None = None, **where: Any) -> Iterator[StoredDecision]:
    """Iterate over the decisions of a store, oldest first, without their traces.

    Parameters
    ----------
    store : SqlStore
    last : int or None
        Number of newest decisions of the selection; all of these are read by this call. None: all
        decisions of the selection, which are read in pages during the iteration.
    **where
        The selection: action, reason (why it was decided so), label, since and until (seconds since
        1970, `until` excluded), predicted (the action that the model alone would have taken) or
        part (its number), the fields of `HistoryFilter`. A decision must fit all that are given.

    Returns
    -------
    iterator of StoredDecision

    Raises
    ------
    SettingError
        For an action, reason, label or predicted action that does not exist, and for a `last` below
        1 or from 10 ** 9 on. Other values are not checked.
    TypeError
        For a name that is no field.
    StoreError
        For a stored value that cannot be read, and if the database fails; if `last` is None, during
        the iteration.
    """
    expect(
        last is None or 1 <= last < MAX_LAST,
        f"last to be 1 or more, below {MAX_LAST:,}",
        last,
        "leave it out for all decisions",
    )
    selection = HistoryFilter(**where)
    if last is None:
        return iterate_decisions(store, selection, newest_first=False)
    return iter(store.decisions.select(selection, last))


def iterate_decisions(
    store: SqlStore,
    where: HistoryFilter,
    page_size: int = PAGE_SIZE,
    start_after: str | None = None,
    newest_first: bool = True,
) -> Iterator[StoredDecision]:
    """Iterate over the decisions of a selection, reading a page of the store at a time.

    Parameters
    ----------
    store : SqlStore
    where : HistoryFilter
        The selection: a decision must have the values of all fields that are not None, and its time
        must lie from `since` to before `until`.
    page_size : int, default 500
        Decisions read at a time.
    start_after : str or None
        Id of a decision: the iteration starts with the next decision in its direction. If the robot
        cell has no decision of this id, nothing is yielded. None: it starts with the newest or
        oldest.
    newest_first : bool, default True
        False: oldest first. Decisions that are made during the iteration are then yielded, too.

    Yields
    ------
    StoredDecision
        With its corrected label, without its trace.

    Raises
    ------
    StoreError
        For a stored value that cannot be read, and if the database fails.
    """
    while page := store.decisions.select(where, page_size, start_after, newest_first):
        if newest_first:
            page.reverse()
        yield from page
        start_after = page[-1].decision.id


def as_frame(decisions: Iterable[StoredDecision]) -> pd.DataFrame:
    """Return decisions as a DataFrame, in their order.

    Parameters
    ----------
    decisions : iterable of StoredDecision

    Returns
    -------
    pandas.DataFrame
        A row for each decision, indexed by its id; without decisions it has these columns and no
        row. The columns are the other fields of `Decision` without the embedding, `time` in UTC,
        and `label`, which is "good", "bad" or None, if there is none or a person withdrew it; a
        corrected label is shown as corrected. Actions and reasons are texts.
    """
    import pandas as pd

    rows = [
        to_jsonable(item) | {"label": None if item.success is None else item.label}
        for item in decisions
    ]
    names = [field.name for field in fields(Decision) if field.name != "embedding"]
    frame = pd.DataFrame(rows, columns=[*names, "time", "label"])
    return frame.assign(time=pd.to_datetime(frame["time"], unit="s", utc=True)).set_index("id")
