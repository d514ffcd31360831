"""Why a decision came out as it did: its evidence as it was recorded, and what can be found again around it.

    for sentence in explain(store, "0123456789ab-412").said: ...

What was recorded (counts, bound, action, reason) is shown as it is. Neighbours, the novelty score and the levels of a
guarantee are found again, without a reducer, by the version that answered, where the store keeps it. A store keeps each
version's references, each trace's place, and the time of each label.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING

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
from ..store.records import SAFE_MODE_BEGAN, ModelVersion, OutcomeRecord, StoredDecision, VersionError, unknown_decision
from ..store.rule_progress import read_rule_progress
from ..store.views import HistoryFilter, PastLabel
from ..traces import LARGEST, ForceLimitsGate

if TYPE_CHECKING:
    from ..store.sql import SqlStore

STRIDE = 100_000  # labels after a version at most that are read: a cell that never retrains again
Levels = tuple[float, float]  # accepted where lower >= the first, rejected where 1 - upper >= the second


@dataclass(frozen=True)
class Answering:
    """A version as it stood at a moment.

    index : its references.  behind : the label of each, in the order of its places; None where it is not known.
    levels : that a bound had to reach, None where that is not kept.  last_seq : the newest label that it could know.
    novelty : of the trace that it found novel, None for any other.
    """

    index: RadiusIndex
    behind: list[PastLabel | None]
    levels: Levels | None
    last_seq: int
    novelty: Novelty | None


def as_it_stood(store: SqlStore, version: int, recipe: Recipe, then: StoredDecision | None) -> Answering | None:
    """A version as it stood when a decision was made, or as it stands now; None where the store does not keep it."""
    try:
        stored = store.load_version(version)
    except VersionError:
        return None
    if "points" not in stored.state:  # a baseline keeps nothing
        return None
    reports = ((each.report, each.last_seq) for each in store.versions(cell_only=True))
    retrains = [last_seq for report, last_seq in reports if report.accepted and report.version > version]
    upto = min([*retrains[:1], stored.last_seq + STRIDE])
    later = store.past_labels(stored.last_seq, upto)
    if then is not None:
        later = [label for label in later if _known_at(label, then, recipe.policy.stops == "all")]
    before = store.past_labels(int(stored.state["trained_on"][0]) - 1, stored.last_seq)
    known = {label.seq: label for label in (*before, *later) if not label.quarantined}
    last = max(known, default=stored.last_seq)
    index = _index(stored, [label for label in later if label.model_version == version], recipe)
    behind = [known.get(number) for number in index.held("numbers").tolist()]
    return Answering(index, behind, _levels(stored, later, recipe.policy), last, _novelty(stored, then))


def _known_at(label: PastLabel, then: StoredDecision, stops_all: bool) -> bool:
    """Whether an engine knew of a label when it made a decision: silence confirms a part before it is stored."""
    by_silence = stops_all and label.source is Source.CONFIRMED
    return label.decided < then.time if by_silence else label.time <= then.time and label.decision_id != then.decision.id


def _index(stored: ModelVersion, added: list[PastLabel], recipe: Recipe) -> RadiusIndex:
    n, total, spaces = stored.state["points"].shape[1], int(stored.state["total"]), len(stored.state["scale"])
    index = RadiusIndex.from_state(stored.state, n if total > n else max(n, recipe.window))
    for label in added:
        if label.point is not None:
            fold = int(fold_of(np.array([label.content_hash], dtype=np.int64), spaces)[0])
            index.keep(torch.from_numpy(label.point), float(label.success), fold, label.content_hash, label.seq)
    return index


def _novelty(stored: ModelVersion, then: StoredDecision | None) -> Novelty | None:
    if then is None or then.decision.reason is not Reason.NOVEL:
        return None
    gate = NoveltyGate(*(int(n) for n in stored.state["trace_shape"]))
    gate.asleep = False
    try:
        restore(gate, arrays_with_prefix(stored.state, "novelty."))
    except StoreError:  # the gate of another version of dengine
        return None
    with torch.inference_mode():
        return Novelty(*gate.scores(torch.from_numpy(then.trace)).tolist())


def _restored(stored: ModelVersion, policy: Policy) -> DecisionRule | None:
    """The rule as a version has it; None where it is another one than the policy's, or had missed something."""
    if policy.guarantee not in RULES and policy.guarantee.partition(":")[0] not in sys.modules:
        return None  # nothing is imported because a store says so; an engine that runs here has imported it
    rule = policy.rule()
    try:
        restore(rule, arrays_with_prefix(stored.state, "rule."))
    except StoreError:  # the rule was another one, handed in with its model, or had missed something
        return None
    return rule


def _levels(stored: ModelVersion, told: list[PastLabel], policy: Policy) -> Levels | None:
    if (policy.guarantee, policy.stops) == ("local", "some") and not arrays_with_prefix(stored.state, "rule."):
        return policy.lower_bound, policy.lower_bound  # the paper's rule learns nothing
    if (rule := _restored(stored, policy)) is None or not isinstance(rule, MemberRule):
        return None
    for label in told:
        if not label.quarantined and label.source is not Source.INSPECTION:
            _update(rule, label)
    return float(rule.evidence.thresholds[0]), float(rule.evidence.thresholds[1])


def rule_now(store: SqlStore, policy: Policy) -> DecisionRule | None:
    """The rule as it stands now; None before the first version, and where it is not kept."""
    stored, settings = store.last_version(), store.settings()
    if stored is None or (rule := _restored(stored, policy)) is None:
        return None
    since, began_in, policy_since = (int(settings.get(name, 0)) for name in ("told_since", "began_in", "policy_since"))
    past = read_rule_progress(store, stored, since, policy.label_within, policy_since)
    if not past.last_seq:  # as an engine that is opened
        rule = rule.clone()
        rule.start_in_safe_mode(began_in)
    for evidence in store.outcomes_since(past.last_seq, since, past.overdue_to):
        _update(rule, evidence)
    return rule


def _update(rule: DecisionRule, outcome: PastLabel | OutcomeRecord) -> None:
    """Update a rule with what became of a part."""
    rule.observe(outcome.silent, outcome.novel)
    rule.update(outcome.lower, outcome.upper, outcome.success, outcome.predicted, outcome.inclusion_probability)


# The envelope: a picture for people, not a test. One sample in twenty of an ordinary success lies outside, by its making.

CENTRAL = 0.95  # of the successes, at each sample, that the band holds
FEWEST = 20  # successes: the band of fewer is what the outermost of them happen to be
NARROWEST = 0.05  # of a channel's median width: where all successes agree, the noise of a sensor is no excess of a hundred
SUCCESSES = 1000  # newest labelled traces that it is made of


@dataclass(frozen=True, slots=True)
class Excess:
    """A piece of one channel that lies outside on one side.

    from_s, to_s : times in seconds of its first and its last sample.  above : whether it lies above the band.
    widths : the largest distance from the band, in widths that the band has there.
    """

    channel: int
    from_s: float
    to_s: float
    above: bool
    widths: float


@dataclass(frozen=True, slots=True)
class Envelope:
    """The band of the known successes, and where one trace leaves it.

    n : successes.  low, median, high : (C, T), the band's edges and its middle, in the trace's unit.
    outside : share of the trace's samples that lie outside.  usual : below which that share lies for 95 % of the successes.
    not_finite : samples of the trace that are NaN or infinite, and lie nowhere.
    excesses : where it leaves the band, the farthest first.
    """

    n: int
    low: NDArray[np.float32] = field(metadata={"apart": True})
    median: NDArray[np.float32] = field(metadata={"apart": True})
    high: NDArray[np.float32] = field(metadata={"apart": True})
    outside: float
    usual: float
    not_finite: int
    excesses: tuple[Excess, ...]


def envelope_of(successes: NDArray[np.float32], trace: NDArray[np.float32], rate_hz: float) -> Envelope | None:
    """The band of successes (n, C, T) and where a trace (C, T) leaves it; None: they are too few, or of another shape."""
    if len(successes) < FEWEST or successes.shape[1:] != trace.shape:
        return None
    tail = (1.0 - CENTRAL) / 2.0
    low, median, high = np.quantile(successes, (tail, 0.5, 1.0 - tail), axis=0).astype(np.float32)
    finite = np.isfinite(trace)
    width = (high - low).astype(np.float64)
    width = np.maximum(width, NARROWEST * np.median(width, axis=1, keepdims=True) + 1e-9)
    x = np.where(finite, trace, low).astype(np.float64)
    beyond = np.where(x > high, (x - high) / width, np.where(x < low, (x - low) / width, 0.0))  # (C, T) in widths
    return Envelope(
        n=len(successes),
        low=low,
        median=median,
        high=high,
        outside=float((beyond != 0.0).sum() / max(1, finite.sum())),
        usual=float(np.quantile(((successes < low) | (successes > high)).mean(axis=(1, 2)), 0.95)),
        not_finite=int((~finite).sum()),
        excesses=tuple(sorted(_excesses(beyond, rate_hz), key=lambda each: -each.widths)),
    )


def _excesses(beyond: NDArray[np.float64], rate_hz: float) -> Iterator[Excess]:
    for channel, row in enumerate(beyond):
        side = np.sign(row)
        edges = np.flatnonzero(np.diff(side, prepend=0.0, append=0.0))  # where a piece of one side begins or ends
        for first, end in pairwise(edges.tolist()):
            if side[first]:
                widest = float(np.abs(row[first:end]).max())
                yield Excess(channel, first / rate_hz, (end - 1) / rate_hz, bool(side[first] > 0), widest)


# The evidence of one decision

MOST = 20_000  # more labels in a ball than that are not thought of
BOUNDED = (Reason.CERTAIN, Reason.UNCERTAIN, Reason.AUDIT, Reason.SAFE_MODE)
DID = {Action.ACCEPT: "accepted", Action.REJECT: "rejected", Action.VERIFY: "verified"}


@dataclass(frozen=True, slots=True)
class Novelty:
    """Squared distance to the nearest reference over its limit, in level, texture, distortion, gaps: above 1 is novel."""

    level: float
    texture: float
    distortion: float
    gaps: float

    def __str__(self) -> str:
        rest = f"texture {self.texture:.2f}, distortion {self.distortion:.2f}, gaps {self.gaps:.2f}"
        return f"in level {self.level:.2f} times the limit, {rest}"


@dataclass(frozen=True, slots=True)
class Bound:
    """A bound, and what it was held against.

    n_success, n_failure, lower, upper : as recorded.
    accept_at, reject_at : accepted where lower >= accept_at, rejected where upper <= reject_at; None where nothing was
        let pass on that side, or where it is not known.
    level : what set these two, in words.
    successes_needed, failures_needed : more labels of this kind, and none of the other, that would have been accepted, or
        rejected; 0 where it was; None where no number would do.
    """

    n_success: int
    n_failure: int
    lower: float
    upper: float
    accept_at: float | None
    reject_at: float | None
    level: str
    successes_needed: int | None
    failures_needed: int | None


@dataclass(frozen=True)
class Circumstances:
    """What a decision is explained by: its engine's settings, and what is known of that moment.

    recipe : with the policy of that moment.
    spec : the traces' contract.  model : what a model that was handed in is called.
    levels : that a bound had to reach, None where that is not kept.  novelty : as in `Explanation`.
    safe_mode : why everything was verified, "" where it was not.
    """

    recipe: Recipe
    spec: TraceSpec
    model: str | None = None
    seed: int = 0
    levels: Levels | None = None
    novelty: Novelty | None = None
    safe_mode: str = ""

    @property
    def baseline(self) -> str:
        """The name of a model that counts and decides by its own, "" where the recipe says how."""
        return self.model if self.model is not None and self.levels is None else ""


def bound_of(made: Decision, found: Circumstances) -> Bound | None:
    """How a decision's bound came out; None where none was asked for: of bad and novel traces, and before any model."""
    if made.reason not in BOUNDED or _was_lost(made):
        return None
    accept_at, reject_at, level = _thresholds(found)
    needed = [_needed(found.recipe.policy, made, at, success) for at, success in ((accept_at, 1), (reject_at, 0))]
    return Bound(made.n_success, made.n_failure, made.lower, made.upper, accept_at, reject_at, level, *needed)


def _was_lost(made: Decision) -> bool:
    """Whether the row was made from a stop whose decision was lost: an accept on no evidence."""
    return (made.reason, made.action, made.lower, made.upper) == (Reason.CERTAIN, Action.ACCEPT, 0.0, 1.0)


def _thresholds(found: Circumstances) -> tuple[float | None, float | None, str]:
    policy = found.recipe.policy
    if found.baseline or policy.guarantee not in RULES:
        return None, None, f"{found.baseline or policy.guarantee} decides by its own rule"
    if policy.guarantee == "local" and not found.safe_mode:
        return policy.lower_bound, 1.0 - policy.lower_bound, "LB, of the ball around the part"
    if found.levels is None:
        return None, None, "the levels that held then are not kept"
    accept_at, reject_at = found.levels
    held = "the lowest level that held then" if policy.guarantee in SORTING_GUARANTEES else "what held in safe mode"
    return accept_at if accept_at < CLOSED else None, 1.0 - reject_at if reject_at < CLOSED else None, held


def is_score(policy: Policy, made: Decision) -> bool:
    """Whether a decision was sorted by its heads' score, and not by an interval."""
    return policy.guarantee in SORTING_GUARANTEES and made.lower == made.upper


def _needed(policy: Policy, made: Decision, threshold: float | None, success: int) -> int | None:
    if threshold is None:
        return None
    more = np.arange(MOST + 1)
    if is_score(policy, made):  # no count changes it
        return 0 if (made.lower >= threshold if success else made.upper <= threshold) else None
    counts = made.n_success + success * more, made.n_failure + (1 - success) * more
    lower, upper = policy.bound(*counts)
    enough = np.flatnonzero(lower >= threshold if success else upper <= threshold)
    return int(enough[0]) if len(enough) else None


def _verdict(past: StoredDecision, bound: Bound | None, found: Circumstances) -> Iterator[str]:
    made = past.decision
    lost = ": the row was made from a stop whose decision was lost; on what evidence is not known."
    yield DID[made.action].capitalize() + (lost if _was_lost(made) else WHY[made.reason](made, past.trace, found))
    if bound is not None:
        yield from _bound_sentences(made, bound, found)
    source = "" if past.source is None else f" ({past.source.value})"
    known = past.success is not None
    yield f"The part turned out {past.label}{source}." if known else "Nothing was reported of the part."


def _audit(made: Decision, trace: NDArray[np.float32], found: Circumstances) -> str:
    (coin,) = toss(content_hash(trace[None]), audit_salt(found.seed)).tolist()
    coin_fell = f"The audits' coin fell on {coin / 2**COIN_BITS:.4f}, below the audit rate {made.propensity:g}"
    alone = f" as an audit: the model alone would have {DID[made.predicted]} it"
    return f"{alone}. {coin_fell}; it is a function of the trace and the seed."


def _saturated(made: Decision, trace: NDArray[np.float32], found: Circumstances) -> str:
    spec = found.spec
    touching = np.argwhere(np.abs(trace) >= spec.limit) if spec.limit is not None else np.zeros((0, 2))
    if not len(touching):
        return ": the trace touched the sensor's range."
    channel, sample = (int(i) for i in touching[np.argmin(touching[:, 1])])
    first = f"first after {sample / spec.rate_hz:.3f} s (channel {channel + 1})"
    return f": {len(touching)} samples touch the sensor's range of {spec.limit:g} {spec.units[channel]}, {first}."


def _not_finite(made: Decision, trace: NDArray[np.float32], found: Circumstances) -> str:
    n = int((~np.isfinite(trace)).sum())
    return f": {n} of {trace.size} samples are NaN or infinite; a trace that was cut or padded too far is."


def _outside(made: Decision, trace: NDArray[np.float32], found: Circumstances) -> str:
    x, windows = torch.from_numpy(trace), found.recipe.policy.windows
    left = [str(each) for each in windows if ForceLimitsGate([each], found.spec)(x)]
    return f": it leaves an operator's window, {' and '.join(left) or 'which is not known'}, whatever the model says."


WHY: dict[Reason, Callable[[Decision, NDArray[np.float32], Circumstances], str]] = {
    Reason.CERTAIN: lambda *_: ": the bound meets the policy.",
    Reason.UNCERTAIN: lambda *_: ": the bound does not meet the policy.",
    Reason.NO_MODEL: lambda *_: ": no model had been trained yet, so every part was.",
    Reason.AUDIT: _audit,
    Reason.NOT_FINITE: _not_finite,
    Reason.CONSTANT: lambda made, trace, found: (
        f": every sample is {trace.flat[0]:g} {found.spec.units[0]}: a dead sensor."
    ),
    Reason.SATURATED: _saturated,
    Reason.TOO_LARGE: lambda made, trace, found: (
        f": a sample of {np.abs(trace).max():g} {found.spec.units[np.abs(trace).max(axis=1).argmax()]}; beyond "
        f"{LARGEST:g} nothing can be computed from it."
    ),
    Reason.MODEL_ERROR: lambda *_: ": the model raised an error, which the log of that time tells.",
    Reason.NOVEL: lambda made, trace, found: (
        f": unlike all that was learned from{'' if found.novelty is None else f': {found.novelty}'}. "
        "What its neighbours say does not count then."
    ),
    Reason.SAFE_MODE: lambda made, trace, found: (
        f" in safe mode, in which every part is: {found.safe_mode or 'its reason is not kept'}."
    ),
    Reason.NO_STORE: lambda *_: (
        ": the cell's disk did not take it then, or could not say whether its id was new, so the model was not asked."
    ),
    Reason.LATE: lambda *_: ": whoever asked could wait no longer, and verified, so the model was not asked.",
    Reason.OUTSIDE: _outside,
}


def _bound_sentences(made: Decision, bound: Bound, found: Circumstances) -> Iterator[str]:
    n, reach = made.n_success + made.n_failure, f"{made.lower:.3f} to {made.upper:.3f}"
    if found.baseline:
        yield f"{found.baseline} gives {made.n_success} successes, {made.n_failure} failures, bound {reach}."
        return
    ball, policy = f"within the radius {found.recipe.radius:g}", found.recipe.policy
    counted = f"{made.n_success} of {n} labels {ball} are successes" if n else f"No label {ball}"
    name = policy.interval.replace("_", "-").capitalize()
    if is_score(policy, made):
        yield f"{counted}; the heads give it {made.lower:.3f}, the mean of what each says of its success."
    else:
        error_level = interval_error_level(policy.alpha, policy.guarantee)
        yield f"{counted}; {name} at alpha {error_level:g} bounds the success rate by {reach}."
    if bound.accept_at is None and bound.reject_at is None:
        why = found.safe_mode or ("" if found.levels is None else "no level of evidence held yet")
        yield f"Nothing could pass, whatever the bound: {why}." if why else f"What it had to reach: {bound.level}."
        return
    good, bad = (MOST + 1 if n is None else n for n in (bound.successes_needed, bound.failures_needed))
    # Of what is uncertain the nearer of the two is told.
    if made.predicted is Action.ACCEPT or (made.predicted is Action.VERIFY and good <= bad):
        must = f"lower must be at least {{:.4g}} ({bound.level}); it is {made.lower:.3f}"
        yield _side("accept", must, bound.accept_at, bound.successes_needed, ("success", "successes", "failure"))
    else:
        must = f"upper must be at most {{:.4g}} ({bound.level}); it is {made.upper:.3f}"
        yield _side("reject", must, bound.reject_at, bound.failures_needed, ("failure", "failures", "success"))


def _side(action: str, must: str, threshold: float | None, needed: int | None, kinds: tuple[str, str, str]) -> str:
    """What one action would have needed; kinds : one label of it, many, and one of the other."""
    if threshold is None:
        return f"To {action}: no level held, so nothing could be {action}ed."
    one, many, other = kinds
    more = "no number of labels" if needed is None else f"{needed} more {one if needed == 1 else many} and no {other}"
    return f"To {action}, {must.format(threshold)}" + (", enough." if needed == 0 else f": {more} would do.")


@dataclass(frozen=True)
class Ball:
    """What lies around a trace: (n,) distances to the references, infinite to those of its own part; a ball's votes."""

    distances: NDArray[np.float64]
    radius: float
    n_success: int
    n_failure: int


@dataclass(frozen=True, slots=True)
class Neighbour:
    """A reference near the trace.

    decision_id, part : of the trace behind it, None where that is not known any more.  success : its label.
    source : of that label.  distance : in the unit of the scaled embedding.  space : the fold that it lives in.
    inside : whether it lies in the ball.  trace : (C, T), None where it is not known any more.
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

    decision : as it was recorded.  trace : (C, T), as `spec` says.  label : what became of it is in `decision`.
    said : why, in sentences.  notes : what was found again.
    bound : how the bound came out, and what others it would have needed; None where no bound was asked for.
    novelty : how unlike all references a novel trace is; None for any other, and where that is not known any more.
    neighbours : the nearest references of the version that answered, nearest first; none where it is not kept.
    radius : of the ball, None where none was drawn.
    envelope : the band of the known successes; None while there are too few.
    policy : that was in force when it was made.
    """

    decision: StoredDecision
    trace: NDArray[np.float32] = field(metadata={"apart": True})
    spec: TraceSpec
    said: tuple[str, ...]
    notes: tuple[str, ...]
    bound: Bound | None
    novelty: Novelty | None
    neighbours: tuple[Neighbour, ...]
    radius: float | None
    envelope: Envelope | None
    policy: Policy

    def __repr__(self) -> str:
        made = self.decision.decision
        return f"<Explanation of {made.id}: {made.action.value}, {made.reason.value}, {len(self.neighbours)} neighbours>"

    _repr_html_ = to_html


def of_part(store: SqlStore, part: str) -> str:
    """The id of the one decision of a part, without earlier rejects of it; or the id itself, where no part has it.

    UnknownDecisionError where there is none, ReportConflictError where there are several.
    """
    known = store.decisions(HistoryFilter(part=part), 20)
    found = [each for each in known if each.decision.action is not Action.REJECT] or known  # it was put in again
    found = found or [each for each in [store.get_decision(part, trace=False)] if each is not None]
    if not found:
        got = f"{shortened(part)}, which is unknown; `dengine history STORE` lists them"
        raise UnknownDecisionError(f"Expected the number of a part that was decided on, or a decision's id, got {got}.")
    if len(found) > 1:
        ids = ", ".join(each.decision.id for each in reversed(found))
        raise ReportConflictError(f"Expected one decision of that part, there are {len(found)}; name its id: {ids}.")
    return found[0].decision.id


def explain(store: SqlStore, decision_id: str, neighbours: int = 10) -> Explanation:
    """Explain one decision, by what its store keeps.

    decision_id : its id, or its part's number as `of_part` takes it.
    neighbours : how many of the nearest references to show.
    Raises ReportError for what the store does not hold, StoreError for a store that no engine has used.
    """
    known = store.settings()
    if "recipe" not in known:
        raise StoreError("Expected a store that an engine has used, this one is empty; make a DataEngine with it.")
    past = store.get_decision(decision_id) or store.get_decision(of_part(store, decision_id))
    if past is None:
        raise unknown_decision(decision_id)
    made, trace, recipe = past.decision, past.trace, Recipe.from_store(known)
    changed = store.policy_change_after(decision_id)
    if changed is not None and changed.data is not None:  # the policy that was in force then
        recipe = replace(recipe, policy=Policy.from_values(changed.data["old"]))
    channels, samples = trace.shape
    answering = as_it_stood(store, made.model_version, recipe, past) if made.model_version else None
    found = Circumstances(
        recipe=recipe,
        spec=stored_trace_spec(known) or TraceSpec(samples=samples, channels=channels),
        model=known.get("model"),
        seed=int(known.get("seed", "0")),
        levels=None if answering is None else answering.levels,
        novelty=None if answering is None else answering.novelty,
        safe_mode=_safe_mode(store, past),
    )
    around, bound = _around(past, answering, recipe), bound_of(made, found)
    return Explanation(
        decision=past,
        trace=trace,
        spec=found.spec,
        said=tuple(_verdict(past, bound, found)),
        notes=tuple(_notes(past, around, bound, found)),
        bound=bound,
        novelty=found.novelty,
        neighbours=tuple(_nearest(store, around, answering, neighbours)),
        radius=None if around is None else around.radius,
        envelope=_envelope(store, past, answering, found.spec),
        policy=recipe.policy,
    )


def _safe_mode(store: SqlStore, past: StoredDecision) -> str:
    if past.decision.reason is not Reason.SAFE_MODE:
        return ""
    began = (each.text for each in reversed(store.events()) if each.kind == SAFE_MODE_BEGAN and each.time <= past.time)
    return next(began, "")


def _around(past: StoredDecision, answering: Answering | None, recipe: Recipe) -> Ball | None:
    """The ball that decided; None where nothing placed the trace, or the version is not kept."""
    placed = past.decision.embedding  # (K, d)
    if answering is None or placed is None:
        return None
    squared = answering.index.squared_distances(torch.tensor(placed, dtype=torch.float32), past.content_hash)
    counts = answering.index.count_near(squared, recipe.radius)
    return Ball(np.sqrt(squared.double().numpy()), recipe.radius, *counts)


def _nearest(store: SqlStore, ball: Ball | None, answering: Answering | None, most: int) -> Iterator[Neighbour]:
    if ball is None or answering is None:
        return
    index = answering.index
    for slot in np.argsort(ball.distances, kind="stable")[:most]:
        if not np.isfinite(ball.distances[slot]):
            return
        label = answering.behind[slot]
        id_, source = (None, None) if label is None else (label.decision_id, label.source)
        stored = None if id_ is None else store.get_decision(id_)
        yield Neighbour(
            decision_id=id_,
            part=None if stored is None else stored.decision.part,
            success=bool(index.held("labels")[slot]),
            source=source,
            distance=float(ball.distances[slot]),
            space=int(index.held("spaces")[slot]),
            inside=bool(ball.distances[slot] <= ball.radius),
            trace=None if stored is None else stored.trace,
        )


def _envelope(store: SqlStore, past: StoredDecision, answering: Answering | None, spec: TraceSpec) -> Envelope | None:
    """The band of the successes that were known then; where those were too few, of those known now."""
    for upto in (None if answering is None else answering.last_seq, None):
        labelled = store.labelled(SUCCESSES, last=upto)
        others = (labelled.labels == 1) & (labelled.hashes != past.content_hash)
        if (band := envelope_of(labelled.traces[others], past.trace, spec.rate_hz)) is not None:
            return band
    return None


def _notes(past: StoredDecision, around: Ball | None, bound: Bound | None, found: Circumstances) -> Iterator[str]:
    made, policy = past.decision, found.recipe.policy
    if past.quarantined:
        yield "The trace is quarantined: it was not embedded, is never trained on, and has no neighbours."
    elif around is None:
        gone = f"version {made.model_version}, which answered, is not kept any more"
        yield f"No neighbours are shown: {'nothing placed the trace' if made.embedding is None else gone}."
    else:
        recorded, again = (made.n_success, made.n_failure), (around.n_success, around.n_failure)
        yield f"Neighbours: the references of version {made.model_version}, which answered, as they stood then."
        if made.reason not in (Reason.NOVEL, Reason.OUTSIDE) and again != recorded:
            held = f"{again[0]} successes and {again[1]} failures; recorded were {recorded[0]} and {recorded[1]}"
            why = "a label was corrected since, or came while this part was being decided on"
            yield f"Counted again, the ball holds {held}: {why}."
    if bound is not None and found.model is None and not is_score(policy, made):
        given = policy.bound(made.n_success, made.n_failure)
        if not np.allclose(given, (made.lower, made.upper), atol=1e-6):
            yield "By the store's present settings these counts give another bound; the recorded one is shown."
