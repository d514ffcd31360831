"""Explains why a decision came out as it did, from what its store keeps. `explain` returns an
`Explanation`: sentences, the bounds with their thresholds (`Bound`), the nearest references
(`Neighbour`), the novelty scores, and the envelope of the successes (`Envelope`).
`load_past_version` restores a model version as it was at a decision, `load_rule` the present
decision rule. `DataEngine.explain`, `dengine explain` and the web page use this.

    for sentence in explain(store, "0123456789ab-412").sentences: ...

Counts, bounds, action and reason are shown as they were recorded. The neighbours, the novelty
scores and the thresholds of a guarantee were not recorded: they are computed again from the version
that decided, if the store keeps its state. That needs no reducer, since the store has each
version's references, the embedding of each trace, and the time of each label.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..decision.intervals import SORTING_GUARANTEES, interval_error_level
from ..decision.member_rules import MemberRule
from ..decision.members import CLOSED
from ..decision.novelty import NoveltyGate
from ..decision.policy import RULES, Policy
from ..decision.references import RadiusIndex
from ..decision.rule import DecisionRule
from ..decision.scripting import arrays_with_prefix, restore
from ..errors import ReportConflictError, StoreError, UnknownDecisionError, shortened
from ..folds import COIN_BITS, audit_salt, content_hash, fold_of, toss
from ..recipe import Recipe
from ..records import Action, Decision, Reason, Source, TraceSpec, stored_trace_spec
from ..representation import to_html
from ..store.records import (
    SAFE_MODE_BEGAN,
    ModelVersion,
    OutcomeRecord,
    StoredDecision,
    VersionError,
    unknown_decision,
)
from ..store.rule_progress import read_rule_progress
from ..store.views import HistoryFilter, PastLabel
from ..traces import LARGEST, ForceLimitsGate

if TYPE_CHECKING:
    from ..store.sql import SqlStore

MAX_LABELS = 100_000  # read after a version at most, for a cell that never retrains again
# Accepted where lower >= the first, rejected where 1 - upper >= the second.
Thresholds = tuple[float, float]


@dataclass(frozen=True)
class PastVersion:
    """A model version as it was at a moment in the past.

    Attributes
    ----------
    index : RadiusIndex
        Its references.
    labels : list of PastLabel or None
        The label of each reference, in the order of the index; None if it is unknown.
    thresholds : (float, float) or None
        That a decision had to reach: accepted where lower >= the first, rejected where 1 - upper >=
        the second. None if they are not kept.
    last_seq : int
        Number of the newest label that it could know.
    novelty : Novelty or None
        Of the trace that it found novel; None for any other.
    """

    index: RadiusIndex
    labels: list[PastLabel | None]
    thresholds: Thresholds | None
    last_seq: int
    novelty: Novelty | None


def load_past_version(
    store: SqlStore, version: int, recipe: Recipe, item: StoredDecision | None
) -> PastVersion | None:
    """Load a model version from the store as it was when a decision was made.

    Its references and its rule include this cell's labels that had come by then, as they were
    reported: later corrections are not applied.

    Parameters
    ----------
    store : SqlStore
    version : int
    recipe : Recipe
        Of that moment.
    item : StoredDecision or None
        The decision, with its trace; None: the version with all labels that came until the next
        one.

    Returns
    -------
    PastVersion or None
        None if there is no such version, or its references are damaged or not kept, as of a
        baseline.
    """
    try:
        stored = store.load_version(version)
    except VersionError:
        return None
    if "points" not in stored.state:  # a baseline keeps no references
        return None
    later_retrains = [
        retrain.last_seq
        for retrain in store.versions(cell_only=True)
        if retrain.report.accepted and retrain.report.version > version
    ]
    last = min([*later_retrains[:1], stored.last_seq + MAX_LABELS])
    later = store.past_labels(stored.last_seq, last)
    if item is not None:
        stops_all = recipe.policy.stops == "all"
        later = [label for label in later if _was_known(label, item, stops_all)]
    before = store.past_labels(int(stored.state["trained_on"][0]) - 1, stored.last_seq)
    by_number = {label.seq: label for label in (*before, *later) if not label.quarantined}
    added = [label for label in later if label.model_version == version]
    index = _restore_index(stored, added, recipe)
    return PastVersion(
        index=index,
        labels=[by_number.get(number) for number in index.column("numbers").tolist()],
        thresholds=_restore_thresholds(stored, later, recipe.policy),
        last_seq=max(by_number, default=stored.last_seq),
        novelty=_score_novelty(stored, item),
    )


def _was_known(label: PastLabel, item: StoredDecision, stops_all: bool) -> bool:
    """Return whether the engine knew a label when it made the decision `item`; never its own label.

    A label is known from its time on. Under `stops="all"` a label from silence is known from the
    next decision on, before it is stored.
    """
    if stops_all and label.source is Source.CONFIRMED:
        return label.decided < item.time
    return label.time <= item.time and label.decision_id != item.decision.id


def _restore_index(stored: ModelVersion, added: list[PastLabel], recipe: Recipe) -> RadiusIndex:
    """Return the index of a stored version's references, with the labels `added` later.

    A label without a point is left out; any other replaces the oldest reference of a full index.
    """
    n = stored.state["points"].shape[1]
    spaces = len(stored.state["scale"])
    is_full = int(stored.state["total"]) > n
    index = RadiusIndex.from_state(stored.state, n if is_full else max(n, recipe.window))
    for label in added:
        if label.point is not None:
            fold = int(fold_of(np.array([label.content_hash], dtype=np.int64), spaces)[0])
            point = torch.from_numpy(label.point)
            index.add_one(point, float(label.success), fold, label.content_hash, label.seq)
    return index


def _score_novelty(stored: ModelVersion, item: StoredDecision | None) -> Novelty | None:
    """Compute the novelty scores of a decision that was novel, with its version's gate.

    None for any other decision, and if the gate cannot be restored.
    """
    if item is None or item.decision.reason is not Reason.NOVEL:
        return None
    gate = NoveltyGate(*(int(n) for n in stored.state["trace_shape"]))
    gate.disabled = False
    try:
        restore(gate, arrays_with_prefix(stored.state, "novelty."))
    except StoreError:  # the gate of another version of dengine
        return None
    with torch.inference_mode():
        return Novelty(*gate.scores(torch.from_numpy(item.trace)).tolist())


def _restore_rule(stored: ModelVersion, policy: Policy) -> DecisionRule | None:
    """Return the decision rule of a policy with the state that a version stored.

    None if the state lacks what the rule has learned, has another rule than the policy's, or was
    stored while stale, and if the rule is a class of the user's that is not imported. A rule that
    learns nothing needs no state.
    """
    if policy.guarantee not in RULES and policy.guarantee.partition(":")[0] not in sys.modules:
        # Nothing is imported because a store names it; a running engine has imported it.
        return None
    rule = policy.rule()
    try:
        restore(rule, arrays_with_prefix(stored.state, "rule."))
    except StoreError:
        return None
    return rule


def _restore_thresholds(
    stored: ModelVersion, later: list[PastLabel], policy: Policy
) -> Thresholds | None:
    """Return the thresholds of a version's rule after it was updated with later labels.

    They are (accept, reject): a part was accepted where lower >= the first, rejected where 1 -
    upper >= the second. Labels of quarantined traces and of inspected rejects do not update the
    rule. The rule "local" with stops="some" learns nothing: both are the policy's lower bound.
    Otherwise None if the state is not kept, or the rule has no such thresholds.
    """
    has_state = bool(arrays_with_prefix(stored.state, "rule."))
    if (policy.guarantee, policy.stops) == ("local", "some") and not has_state:
        return policy.lower_bound, policy.lower_bound  # the paper's rule learns nothing
    rule = _restore_rule(stored, policy)
    if not isinstance(rule, MemberRule):
        return None
    for label in later:
        if not label.quarantined and label.source is not Source.INSPECTION:
            _update_rule(rule, label)
    return float(rule.evidence.thresholds[0]), float(rule.evidence.thresholds[1])


def load_rule(store: SqlStore, policy: Policy) -> DecisionRule | None:
    """Return the decision rule as it is now: the stored rule, updated with all outcomes since.

    Where the stored rule cannot be continued (`RuleProgress.last_seq` is 0, for example after a
    correction or by an overdue check), it is rebuilt from all outcomes. The store does not change.

    Parameters
    ----------
    store : SqlStore
    policy : Policy

    Returns
    -------
    DecisionRule or None
        None before the first version, and if its rule cannot be restored from what is stored: its
        state is not kept (a peer's never is) or is stale, or its class is not imported.
    """
    stored = store.last_version()
    settings = store.settings()
    if stored is None or (rule := _restore_rule(stored, policy)) is None:
        return None
    since = int(settings.get("evidence_since", 0))
    began_in = int(settings.get("began_in", 0))
    policy_since = int(settings.get("policy_since", 0))
    progress = read_rule_progress(store, stored, since, policy.label_within, policy_since)
    if not progress.last_seq:  # rebuilt from all outcomes, as when an engine is opened
        rule = rule.clone()
        rule.start_in_safe_mode(began_in)
    for outcome in store.outcomes_since(progress.last_seq, since, progress.overdue_to):
        _update_rule(rule, outcome)
    return rule


def _update_rule(rule: DecisionRule, outcome: PastLabel | OutcomeRecord) -> None:
    """Update a rule, in place, with one part's outcome and the unreported accepts before it."""
    rule.observe(outcome.silent, outcome.novel)
    rule.update(
        outcome.lower,
        outcome.upper,
        outcome.success,
        outcome.predicted,
        outcome.inclusion_probability,
    )


# The envelope is a picture for people and no test: one sample in twenty of an ordinary success lies
# outside, by construction.

CENTRAL = 0.95  # share of the successes that the band contains at each sample
MIN_SUCCESSES = 20  # the band of fewer would be their outermost values
MIN_WIDTH = 0.05  # of a channel's median width: where all successes agree, noise is no large excess
MAX_ENVELOPE_LABELS = 1000  # newest labels, whose successes make the band


@dataclass(frozen=True, slots=True)
class Excess:
    """A piece of one channel of a trace that lies outside the envelope, on one side.

    Attributes
    ----------
    channel : int
        From 0.
    from_s, to_s : float
        Times of its first and last sample, in seconds.
    above : bool
        Whether it lies above the band.
    widths : float
        Largest distance from the band, in widths of the band there.
    """

    channel: int
    from_s: float
    to_s: float
    above: bool
    widths: float


@dataclass(frozen=True, slots=True)
class Envelope:
    """The band in which known successes lie, and where one trace leaves it.

    Attributes
    ----------
    n : int
        Number of successes.
    low, median, high : array of float32, shape (C, T)
        The band's lower edge, middle and upper edge, in the trace's unit.
    outside : float
        Share of the trace's samples that lie outside.
    usual : float
        95 % of the successes have a smaller share outside.
    not_finite : int
        Samples of the trace that are NaN or infinite; they count neither way.
    excesses : tuple of Excess
        Where the trace leaves the band, the largest first.
    """

    n: int
    low: NDArray[np.float32] = field(metadata={"apart": True})
    median: NDArray[np.float32] = field(metadata={"apart": True})
    high: NDArray[np.float32] = field(metadata={"apart": True})
    outside: float
    usual: float
    not_finite: int
    excesses: tuple[Excess, ...]


def envelope_of(
    successes: NDArray[np.float32], trace: NDArray[np.float32], rate_hz: float
) -> Envelope | None:
    """Compute the envelope of successes, and where a trace leaves it.

    At each sample the envelope contains the middle 95 % of the successes.

    Parameters
    ----------
    successes : array of float32, shape (n, C, T)
    trace : array of float32, shape (C, T)
        Its NaN and infinite samples are left out.
    rate_hz : float
        Sampling rate.

    Returns
    -------
    Envelope or None
        None for fewer than 20 successes, or if their shape is not the trace's.
    """
    if len(successes) < MIN_SUCCESSES or successes.shape[1:] != trace.shape:
        return None
    tail = (1.0 - CENTRAL) / 2.0
    low, median, high = np.quantile(successes, (tail, 0.5, 1.0 - tail), axis=0).astype(np.float32)
    finite = np.isfinite(trace)
    width = (high - low).astype(np.float64)
    width = np.maximum(width, MIN_WIDTH * np.median(width, axis=1, keepdims=True) + 1e-9)
    x = np.where(finite, trace, low).astype(np.float64)
    below = np.where(x < low, (x - low) / width, 0.0)
    excess = np.where(x > high, (x - high) / width, below)  # (C, T), in widths
    return Envelope(
        n=len(successes),
        low=low,
        median=median,
        high=high,
        outside=float((excess != 0.0).sum() / max(1, finite.sum())),
        usual=float(np.quantile(((successes < low) | (successes > high)).mean(axis=(1, 2)), 0.95)),
        not_finite=int((~finite).sum()),
        excesses=tuple(sorted(_find_excesses(excess, rate_hz), key=lambda piece: -piece.widths)),
    )


def _find_excesses(excess: NDArray[np.float64], rate_hz: float) -> Iterator[Excess]:
    """Yield the pieces of the excess (C, T) that are above 0, or below 0, throughout.

    They come channel by channel, in the order of time. The excess is in widths of the band:
    positive above it, negative below it, 0 inside.
    """
    for channel, row in enumerate(excess):
        side = np.sign(row)
        # Where a piece begins or ends.
        edges = np.flatnonzero(np.diff(side, prepend=0.0, append=0.0))
        for first, end in pairwise(edges.tolist()):
            if side[first]:
                widths = float(np.abs(row[first:end]).max())
                above = bool(side[first] > 0)
                yield Excess(channel, first / rate_hz, (end - 1) / rate_hz, above, widths)


# The evidence of one decision

MAX_NEEDED = 20_000  # more labels within the radius than that are not considered
BOUNDED = (Reason.CERTAIN, Reason.UNCERTAIN, Reason.AUDIT, Reason.SAFE_MODE)
DID = {Action.ACCEPT: "accepted", Action.REJECT: "rejected", Action.VERIFY: "verified"}


@dataclass(frozen=True, slots=True)
class Novelty:
    """How novel a trace was, in four respects.

    Each is the squared distance to the nearest reference over its limit; a trace with one above 1
    is novel.
    """

    level: float
    texture: float
    distortion: float
    gaps: float

    def __str__(self) -> str:
        rest = f"texture {self.texture:.2f}, distortion {self.distortion:.2f}, gaps {self.gaps:.2f}"
        return f"in level {self.level:.2f} times the limit, {rest}"


@dataclass(frozen=True, slots=True)
class Bound:
    """The bounds of a decision and the thresholds that they had to reach.

    Attributes
    ----------
    n_success, n_failure : int
        Labels within the radius, as recorded.
    lower, upper : float
        Bounds of the success rate, as recorded.
    accept_threshold : float or None
        Accepted where lower >= accept_threshold. None if nothing could be accepted, or unknown.
    reject_threshold : float or None
        Rejected where upper <= reject_threshold. None if nothing could be rejected, or unknown.
    origin : str
        Where the thresholds come from, in words.
    successes_needed : int or None
        So many more successes within the radius, and no failure, would have made it accepted; 0 if
        it reached the threshold, None if no number would do.
    failures_needed : int or None
        The same of failures, for a reject.
    """

    n_success: int
    n_failure: int
    lower: float
    upper: float
    accept_threshold: float | None
    reject_threshold: float | None
    origin: str
    successes_needed: int | None
    failures_needed: int | None


@dataclass(frozen=True)
class Circumstances:
    """What a decision is explained by: the engine's settings and state at that moment.

    Attributes
    ----------
    recipe : Recipe
        With the policy of that moment.
    spec : TraceSpec
    model : str or None
        Name of a model that was handed in; None: the recipe describes the model.
    seed : int
        Of the engine.
    thresholds : (float, float) or None
        As in `PastVersion`; None if they are not kept.
    novelty : Novelty or None
        As in `Explanation`.
    safe_mode : str
        Why everything was verified; "" outside safe mode.
    """

    recipe: Recipe
    spec: TraceSpec
    model: str | None = None
    seed: int = 0
    thresholds: Thresholds | None = None
    novelty: Novelty | None = None
    safe_mode: str = ""

    @property
    def baseline(self) -> str:
        """Name of a handed-in model that decides by its own method; "" for any other model."""
        return self.model if self.model is not None and self.thresholds is None else ""


def bound_of(decision: Decision, circumstances: Circumstances) -> Bound | None:
    """Return a decision's bounds with their thresholds and what more evidence it would have needed.

    Returns None if no bound was computed: for every reason but CERTAIN, UNCERTAIN, AUDIT and
    SAFE_MODE, and for a decision that was lost.
    """
    if decision.reason not in BOUNDED or _was_lost(decision):
        return None
    policy = circumstances.recipe.policy
    accept_threshold, reject_threshold, origin = _find_thresholds(circumstances)
    return Bound(
        n_success=decision.n_success,
        n_failure=decision.n_failure,
        lower=decision.lower,
        upper=decision.upper,
        accept_threshold=accept_threshold,
        reject_threshold=reject_threshold,
        origin=origin,
        successes_needed=_count_needed(policy, decision, accept_threshold, 1),
        failures_needed=_count_needed(policy, decision, reject_threshold, 0),
    )


def _was_lost(decision: Decision) -> bool:
    """Return whether a decision was lost, and recorded again when its part stopped the line.

    Such a decision is an accept with the bounds 0 and 1.
    """
    fields = (decision.reason, decision.action, decision.lower, decision.upper)
    return fields == (Reason.CERTAIN, Action.ACCEPT, 0.0, 1.0)


def _find_thresholds(circumstances: Circumstances) -> tuple[float | None, float | None, str]:
    """Return accept threshold (of lower), reject threshold (of upper), and their origin in words.

    A part was accepted where lower >= the first, rejected where upper <= the second. A threshold is
    None if it is unknown, or if nothing could pass on that side.
    """
    policy = circumstances.recipe.policy
    if circumstances.baseline or policy.guarantee not in RULES:
        return None, None, f"{circumstances.baseline or policy.guarantee} decides by its own rule"
    if policy.guarantee == "local" and not circumstances.safe_mode:
        return policy.lower_bound, 1.0 - policy.lower_bound, "LB, of the neighbourhood of the part"
    if circumstances.thresholds is None:
        return None, None, "the thresholds of that time are not kept"
    accept_score, reject_score = circumstances.thresholds
    sorts = policy.guarantee in SORTING_GUARANTEES
    origin = "the lowest level that held then" if sorts else "what held in safe mode"
    accept_threshold = accept_score if accept_score < CLOSED else None
    reject_threshold = 1.0 - reject_score if reject_score < CLOSED else None
    return accept_threshold, reject_threshold, origin


def is_score(policy: Policy, decision: Decision) -> bool:
    """Return whether a decision's `lower` and `upper` are one score of the heads, and no interval.

    The heads are the reducer's classifiers; their score is a probability of success. It is so under
    the guarantees "pooled" and "cost", where lower equals upper.
    """
    return policy.guarantee in SORTING_GUARANTEES and decision.lower == decision.upper


def _count_needed(
    policy: Policy, decision: Decision, threshold: float | None, success: int
) -> int | None:
    """Return how many more labels of one kind within the radius would have reached a threshold.

    `success` is 1 for successes and `lower`, 0 for failures and `upper`. 0 if the threshold was
    reached; None if no number up to MAX_NEEDED would do, if there is no threshold, and if it was
    missed by a score, which does not depend on counts.
    """
    if threshold is None:
        return None
    if is_score(policy, decision):  # it does not depend on counts
        is_reached = decision.lower >= threshold if success else decision.upper <= threshold
        return 0 if is_reached else None
    more = np.arange(MAX_NEEDED + 1)
    n_success = decision.n_success + success * more
    n_failure = decision.n_failure + (1 - success) * more
    lower, upper = policy.bound(n_success, n_failure)
    enough = np.flatnonzero(lower >= threshold if success else upper <= threshold)
    return int(enough[0]) if len(enough) else None


def _explain_in_words(
    item: StoredDecision, bound: Bound | None, circumstances: Circumstances
) -> Iterator[str]:
    """Yield the sentences that explain a decision: its reason, its bounds, its outcome.

    Without a bound the sentences on bounds are left out.
    """
    decision = item.decision
    reason = (
        ": the decision was lost, and recorded again from its line stop; its evidence is unknown."
    )
    if not _was_lost(decision):
        reason = WHY[decision.reason](decision, item.trace, circumstances)
    yield DID[decision.action].capitalize() + reason
    if bound is not None:
        yield from _bound_sentences(decision, bound, circumstances)
    if item.success is None:
        yield "Nothing was reported of the part."
    else:
        source = "" if item.source is None else f" ({item.source.value})"
        yield f"The part turned out {item.label}{source}."


def _explain_audit(
    decision: Decision, trace: NDArray[np.float32], circumstances: Circumstances
) -> str:
    """Return the rest of the sentence on an audit: what the model alone would have done, the coin.

    The coin is computed again from the trace and the engine's seed.
    """
    (coin,) = toss(content_hash(trace[None]), audit_salt(circumstances.seed)).tolist()
    alone = f" as an audit: the model alone would have {DID[decision.predicted]} it"
    coin_fell = (
        f"The audits' coin fell on {coin / 2**COIN_BITS:.4f}, below the audit rate "
        f"{decision.propensity:g}"
    )
    return f"{alone}. {coin_fell}; it is a function of the trace and the seed."


def _explain_saturated(
    decision: Decision, trace: NDArray[np.float32], circumstances: Circumstances
) -> str:
    """Return the rest of the sentence on a saturated trace.

    It has the number of samples that touch the sensor's range, and the time in seconds and the
    channel of the first.
    """
    spec = circumstances.spec
    touching: NDArray[Any] = np.zeros((0, 2))
    if spec.limit is not None:
        touching = np.argwhere(np.abs(trace) >= spec.limit)
    if not len(touching):
        return ": the trace touched the sensor's range."
    channel, sample = (int(i) for i in touching[np.argmin(touching[:, 1])])
    first = f"first after {sample / spec.rate_hz:.3f} s (channel {channel + 1})"
    return (
        f": {len(touching)} samples touch the sensor's range of {spec.limit:g} "
        f"{spec.units[channel]}, {first}."
    )


def _explain_not_finite(
    decision: Decision, trace: NDArray[np.float32], circumstances: Circumstances
) -> str:
    """Return the rest of the sentence on a trace with NaN or infinity, with their number."""
    n = int((~np.isfinite(trace)).sum())
    return (
        f": {n} of {trace.size} samples are NaN or infinite; a trace that was cut or padded "
        "too far is."
    )


def _explain_outside(
    decision: Decision, trace: NDArray[np.float32], circumstances: Circumstances
) -> str:
    """Return the rest of the sentence on a trace outside an operator's limits: which it leaves."""
    x = torch.from_numpy(trace)
    windows = circumstances.recipe.policy.windows
    left = [str(limits) for limits in windows if ForceLimitsGate([limits], circumstances.spec)(x)]
    return (
        f": it leaves an operator's window, {' and '.join(left) or 'which is not known'}, "
        "whatever the model says."
    )


# For each reason the rest of the sentence that begins with what was done.
WHY: dict[Reason, Callable[[Decision, NDArray[np.float32], Circumstances], str]] = {
    Reason.CERTAIN: lambda *_: ": the bound meets the policy.",
    Reason.UNCERTAIN: lambda *_: ": the bound does not meet the policy.",
    Reason.NO_MODEL: lambda *_: ": no model had been trained yet, so every part was verified.",
    Reason.AUDIT: _explain_audit,
    Reason.NOT_FINITE: _explain_not_finite,
    Reason.CONSTANT: lambda decision, trace, circumstances: (
        f": every sample is {trace.flat[0]:g} {circumstances.spec.units[0]}: a dead sensor."
    ),
    Reason.SATURATED: _explain_saturated,
    Reason.TOO_LARGE: lambda decision, trace, circumstances: (
        f": a sample of {np.abs(trace).max():g} "
        f"{circumstances.spec.units[np.abs(trace).max(axis=1).argmax()]}; beyond "
        f"{LARGEST:g} nothing can be computed from it."
    ),
    Reason.MODEL_ERROR: lambda *_: ": the model raised an error; see the log of that time.",
    Reason.NOVEL: lambda decision, trace, circumstances: (
        ": unlike all traces that were learned "
        f"from{'' if circumstances.novelty is None else f': {circumstances.novelty}'}. "
        "The labels of its neighbours do not count then."
    ),
    Reason.SAFE_MODE: lambda decision, trace, circumstances: (
        " in safe mode, in which every part is verified: "
        f"{circumstances.safe_mode or 'its reason is not kept'}."
    ),
    Reason.NO_STORE: lambda *_: (
        ": the disk or the store did not respond in time, so the decision could not be recorded, "
        "or its id could not be looked up, and the model was not asked."
    ),
    Reason.LATE: lambda *_: (
        ": the caller timed out and verified the part, so the model was not asked."
    ),
    Reason.OUTSIDE: _explain_outside,
}


def _bound_sentences(
    decision: Decision, bound: Bound, circumstances: Circumstances
) -> Iterator[str]:
    """Yield the sentences on a decision's evidence, its bounds, and what it would have needed.

    The last is said of the action that the model alone would have done; if that is to verify, of
    the action that needed fewer labels. If nothing could pass, or the thresholds are unknown, it
    says so instead. For a model that decides by its own method there is one sentence, with its
    counts and bounds.
    """
    n = decision.n_success + decision.n_failure
    interval = f"{decision.lower:.3f} to {decision.upper:.3f}"
    if circumstances.baseline:
        counts = f"{decision.n_success} successes, {decision.n_failure} failures"
        yield f"{circumstances.baseline} gives {counts}, bound {interval}."
        return
    policy = circumstances.recipe.policy
    within = f"within the radius {circumstances.recipe.radius:g}"
    counts = (
        f"{decision.n_success} of {n} labels {within} are successes" if n else f"No label {within}"
    )
    if is_score(policy, decision):
        yield (
            f"{counts}; the heads give it {decision.lower:.3f}, the mean of what each says "
            "of its success."
        )
    else:
        name = policy.interval.replace("_", "-").capitalize()
        error_level = interval_error_level(policy.alpha, policy.guarantee)
        yield f"{counts}; {name} at alpha {error_level:g} bounds the success rate by {interval}."
    if bound.accept_threshold is None and bound.reject_threshold is None:
        why = circumstances.safe_mode
        if not why and circumstances.thresholds is not None:
            why = "no level of evidence held yet"
        yield (
            f"Nothing could pass, whatever the bound: {why}."
            if why
            else f"What it had to reach: {bound.origin}."
        )
        return
    # An uncertain decision is explained by the action that it was nearer to.
    successes = MAX_NEEDED + 1 if bound.successes_needed is None else bound.successes_needed
    failures = MAX_NEEDED + 1 if bound.failures_needed is None else bound.failures_needed
    is_uncertain = decision.predicted is Action.VERIFY
    if decision.predicted is Action.ACCEPT or (is_uncertain and successes <= failures):
        condition = f"lower must be at least {{:.4g}} ({bound.origin}); it is {decision.lower:.3f}"
        kinds = ("success", "successes", "failure")
        yield _needed_sentence(
            "accept", condition, bound.accept_threshold, bound.successes_needed, kinds
        )
    else:
        condition = f"upper must be at most {{:.4g}} ({bound.origin}); it is {decision.upper:.3f}"
        kinds = ("failure", "failures", "success")
        yield _needed_sentence(
            "reject", condition, bound.reject_threshold, bound.failures_needed, kinds
        )


def _needed_sentence(
    action: str,
    condition: str,
    threshold: float | None,
    needed: int | None,
    kinds: tuple[str, str, str],
) -> str:
    """Return the sentence on what an accept or a reject would have needed.

    Parameters
    ----------
    action : {"accept", "reject"}
    condition : str
        What had to hold, with a field {} for the threshold.
    threshold : float or None
        None: nothing could pass.
    needed : int or None
        Number of labels that were missing; 0: it was enough, None: no number would do.
    kinds : (str, str, str)
        The word for one label of the kind that is needed, for several, and for one of the other
        kind.
    """
    if threshold is None:
        return f"To {action}: no level held, so nothing could be {action}ed."
    if needed == 0:
        return f"To {action}, {condition.format(threshold)}, enough."
    single, several, other = kinds
    more = "no number of labels"
    if needed is not None:
        more = f"{needed} more {single if needed == 1 else several} and no {other}"
    return f"To {action}, {condition.format(threshold)}: {more} would do."


@dataclass(frozen=True)
class Neighbourhood:
    """The references around a trace.

    Attributes
    ----------
    distances : array of float64, shape (n,)
        To every reference, in the order of the index; infinite to those of the trace's own part.
    radius : float
    n_success, n_failure : int
        Labels within the radius, counted again.
    """

    distances: NDArray[np.float64]
    radius: float
    n_success: int
    n_failure: int


@dataclass(frozen=True, slots=True)
class Neighbour:
    """A reference near the trace.

    Attributes
    ----------
    decision_id, part : str or None
        Of the decision behind it; None if unknown.
    success : bool
        Its label.
    source : Source or None
        Of the label.
    distance : float
        In units of the scaled embedding.
    space : int
        The fold in whose embedding it lies.
    inside : bool
        Whether it lies within the radius.
    trace : array of float32, shape (C, T), or None
        None if unknown.
    """

    decision_id: str | None
    part: str | None
    success: bool
    source: Source | None
    distance: float
    space: int
    inside: bool
    trace: NDArray[np.float32] | None = field(metadata={"apart": True})


@dataclass(frozen=True, slots=True, repr=False)
class Explanation:
    """A decision and its evidence.

    Attributes
    ----------
    decision : StoredDecision
        As recorded, with its label.
    trace : array of float32, shape (C, T)
    spec : TraceSpec
    sentences : tuple of str
        Why the decision came out as it did.
    notes : tuple of str
        On what was computed again.
    bound : Bound or None
        The bounds and thresholds; None if no bound was computed.
    novelty : Novelty or None
        How novel a novel trace is; None for any other, and if that is not kept.
    neighbours : tuple of Neighbour
        The nearest references of the version that decided, nearest first; empty if it is not kept.
    radius : float or None
        None if there is no neighbourhood.
    envelope : Envelope or None
        The band of the known successes; None while there are too few.
    policy : Policy
        That was in force when the decision was made.
    """

    decision: StoredDecision
    trace: NDArray[np.float32] = field(metadata={"apart": True})
    spec: TraceSpec
    sentences: tuple[str, ...]
    notes: tuple[str, ...]
    bound: Bound | None
    novelty: Novelty | None
    neighbours: tuple[Neighbour, ...]
    radius: float | None
    envelope: Envelope | None
    policy: Policy

    def __repr__(self) -> str:
        decision = self.decision.decision
        result = f"{decision.action.value}, {decision.reason.value}"
        return f"<Explanation of {decision.id}: {result}, {len(self.neighbours)} neighbours>"

    _repr_html_ = to_html


def find_decision_id(store: SqlStore, part: str) -> str:
    """Return the id of the decision on a part.

    If a part was decided on again after rejects, the rejects do not count, unless all are rejects.
    Only the newest 20 decisions on the part are looked at.

    Parameters
    ----------
    store : SqlStore
    part : str
        The part's number; or a decision's id, which is returned if no part has this number.

    Returns
    -------
    str

    Raises
    ------
    UnknownDecisionError
        If there is none.
    ReportConflictError
        If there are several; the message has their ids.
    """
    decisions = store.decisions(HistoryFilter(part=part), 20)
    not_rejected = [item for item in decisions if item.decision.action is not Action.REJECT]
    matches = not_rejected or decisions
    if not matches and (item := store.get_decision(part, trace=False)) is not None:
        matches = [item]
    if not matches:
        actual = f"{shortened(part)}, which is unknown; `dengine history STORE` lists them"
        raise UnknownDecisionError(
            f"Expected the number of a part that was decided on, or a decision's id, got {actual}."
        )
    if len(matches) > 1:
        ids = ", ".join(item.decision.id for item in reversed(matches))
        raise ReportConflictError(
            f"Expected one decision of that part, there are {len(matches)}; name its id: {ids}."
        )
    return matches[0].decision.id


def explain(store: SqlStore, decision_id: str, neighbours: int = 10) -> Explanation:
    """Explain one decision from what its store keeps; nothing is trained or embedded.

    If a label or a trace of a success is damaged, it is left out, and an event is written to the
    store.

    Parameters
    ----------
    store : SqlStore
    decision_id : str
        Its id, or its part's number as `find_decision_id` takes it.
    neighbours : int, default 10
        Number of nearest references at most.

    Returns
    -------
    Explanation

    Raises
    ------
    ReportError
        For a decision that the store does not hold, and for a part with several decisions.
    StoreError
        For a store that no engine has used, and for a damaged trace of the decision or of a
        neighbour.
    """
    settings = store.settings()
    if "recipe" not in settings:
        raise StoreError(
            "Expected a store that an engine has used, this one is empty; make a DataEngine "
            "with it."
        )
    item = store.get_decision(decision_id) or store.get_decision(
        find_decision_id(store, decision_id)
    )
    if item is None:
        raise unknown_decision(decision_id)
    decision = item.decision
    recipe = Recipe.from_store(settings)
    change = store.policy_change_after(decision.id)
    if change is not None and change.data is not None:  # the policy that was in force then
        recipe = replace(recipe, policy=Policy.from_values(change.data["old"]))
    channels, samples = item.trace.shape
    version = None
    if decision.model_version:
        version = load_past_version(store, decision.model_version, recipe, item)
    circumstances = Circumstances(
        recipe=recipe,
        spec=stored_trace_spec(settings) or TraceSpec(samples=samples, channels=channels),
        model=settings.get("model"),
        seed=int(settings.get("seed", "0")),
        thresholds=None if version is None else version.thresholds,
        novelty=None if version is None else version.novelty,
        safe_mode=_find_safe_mode(store, item),
    )
    neighbourhood = _find_neighbourhood(item, version, recipe)
    bound = bound_of(decision, circumstances)
    return Explanation(
        decision=item,
        trace=item.trace,
        spec=circumstances.spec,
        sentences=tuple(_explain_in_words(item, bound, circumstances)),
        notes=tuple(_note_sentences(item, neighbourhood, bound, circumstances)),
        bound=bound,
        novelty=circumstances.novelty,
        neighbours=tuple(_find_neighbours(store, neighbourhood, version, neighbours)),
        radius=None if neighbourhood is None else neighbourhood.radius,
        envelope=_find_envelope(store, item, version, circumstances.spec),
        policy=recipe.policy,
    )


def _find_safe_mode(store: SqlStore, item: StoredDecision) -> str:
    """Return why safe mode had begun when a decision was made in it; "" for any other decision.

    It is the text of the last such event before the decision, "" if there is none.
    """
    if item.decision.reason is not Reason.SAFE_MODE:
        return ""
    began = (
        event.text
        for event in reversed(store.events())
        if event.kind == SAFE_MODE_BEGAN and event.time <= item.time
    )
    return next(began, "")


def _find_neighbourhood(
    item: StoredDecision, version: PastVersion | None, recipe: Recipe
) -> Neighbourhood | None:
    """Measure the distances from a decision's embedding to the references of a version.

    Return them with the successes and failures within the radius, counted again. References of the
    decision's own part are infinitely far. None if the trace was not embedded, or the version is
    not kept.
    """
    embedding = item.decision.embedding  # (K, d)
    if version is None or embedding is None:
        return None
    query = torch.tensor(embedding, dtype=torch.float32)
    squared = version.index.squared_distances(query, item.content_hash)
    counts = version.index.count_near(squared, recipe.radius)
    return Neighbourhood(np.sqrt(squared.double().numpy()), recipe.radius, *counts)


def _find_neighbours(
    store: SqlStore, neighbourhood: Neighbourhood | None, version: PastVersion | None, n: int
) -> Iterator[Neighbour]:
    """Yield the nearest references of other parts, at most `n`, with their traces, nearest first.

    Nothing without a neighbourhood or version. What is not known of a reference is None. Raise
    StoreError for a damaged trace.
    """
    if neighbourhood is None or version is None:
        return
    index = version.index
    distances = neighbourhood.distances
    for slot in np.argsort(distances, kind="stable")[:n]:
        if not np.isfinite(distances[slot]):
            return
        label = version.labels[slot]
        decision_id = None if label is None else label.decision_id
        stored = None if decision_id is None else store.get_decision(decision_id)
        yield Neighbour(
            decision_id=decision_id,
            part=None if stored is None else stored.decision.part,
            success=bool(index.column("labels")[slot]),
            source=None if label is None else label.source,
            distance=float(distances[slot]),
            space=int(index.column("spaces")[slot]),
            inside=bool(distances[slot] <= neighbourhood.radius),
            trace=None if stored is None else stored.trace,
        )


def _find_envelope(
    store: SqlStore, item: StoredDecision, version: PastVersion | None, spec: TraceSpec
) -> Envelope | None:
    """Return the envelope of the successes among the newest labels that the version could know.

    Labels are as corrected by now. Traces of the decision's own part or content are left out.
    Without a version, or if these successes are too few, the newest labels known now are taken;
    None if these are too few, too, or of another shape.
    """
    for last in (None if version is None else version.last_seq, None):
        labelled = store.labelled(MAX_ENVELOPE_LABELS, last=last)
        is_other_success = (labelled.labels == 1) & (labelled.hashes != item.content_hash)
        envelope = envelope_of(labelled.traces[is_other_success], item.trace, spec.rate_hz)
        if envelope is not None:
            return envelope
    return None


def _note_sentences(
    item: StoredDecision,
    neighbourhood: Neighbourhood | None,
    bound: Bound | None,
    circumstances: Circumstances,
) -> Iterator[str]:
    """Yield sentences on what was computed again, and where it differs from what was recorded.

    If no neighbours are shown, a sentence says why.
    """
    decision = item.decision
    policy = circumstances.recipe.policy
    if item.quarantined:
        yield (
            "The trace is quarantined: it was not embedded, is never trained on, and has no "
            "neighbours."
        )
    elif neighbourhood is None:
        why = f"version {decision.model_version}, which answered, is not kept any more"
        if decision.embedding is None:
            why = "the trace was not embedded"
        yield f"No neighbours are shown: {why}."
    else:
        recorded = (decision.n_success, decision.n_failure)
        again = (neighbourhood.n_success, neighbourhood.n_failure)
        yield (
            f"Neighbours: the references of version {decision.model_version}, which "
            "answered, as they stood then."
        )
        if decision.reason not in (Reason.NOVEL, Reason.OUTSIDE) and again != recorded:
            counts = (
                f"{again[0]} successes and {again[1]} failures; recorded were "
                f"{recorded[0]} and {recorded[1]}"
            )
            why = "a label was corrected since, or came while this part was being decided on"
            yield f"Counted again, the neighbourhood holds {counts}: {why}."
    if bound is not None and circumstances.model is None and not is_score(policy, decision):
        interval = policy.bound(decision.n_success, decision.n_failure)
        if not np.allclose(interval, (decision.lower, decision.upper), atol=1e-6):
            yield (
                "By the store's present settings these counts give another bound; the "
                "recorded one is shown."
            )
