"""Why a decision came out so, in sentences; how its bound came out, and what another action would have needed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..decision.policy import RULES, Policy
from ..decision.rule import NOBODY, DecisionRule
from ..recipe import Recipe
from ..records import Action, Decision, Reason, TraceSpec
from ..store.records import StoredDecision

MOST = 20_000  # more labels in a ball than that are not thought of
BOUNDED = (Reason.CERTAIN, Reason.UNCERTAIN, Reason.AUDIT, Reason.SAFE_MODE)
DID = {Action.ACCEPT: "accepted", Action.REJECT: "rejected", Action.VERIFY: "verified"}


@dataclass(frozen=True, slots=True)
class Novelty:
    """Squared distance to the nearest reference over its limit, in level and in texture: above 1 it is novel."""

    level: float
    texture: float

    @property
    def is_novel(self) -> bool:
        """Whether either is beyond its limit."""
        return not max(self.level, self.texture) <= 1.0


@dataclass(frozen=True, slots=True)
class Bound:
    """A bound, and what it was held against.

    interval, alpha : by which it was made.  n_success, n_failure, lower, upper : as recorded.
    ball : which references were counted, in words.
    accept_at, reject_at : accepted where lower >= accept_at, rejected where upper <= reject_at; None where nothing was
        let pass on that side, or where it is not known.
    level : what set these two, in words.
    successes_needed, failures_needed : more labels of this kind, and none of the other, that would have been accepted, or
        rejected; 0 where it was; None where no number would do.
    repeats : whether the recorded bound is what the settings give for the recorded counts.
    """

    interval: str
    alpha: float
    n_success: int
    n_failure: int
    lower: float
    upper: float
    ball: str
    accept_at: float | None
    reject_at: float | None
    level: str
    successes_needed: int | None
    failures_needed: int | None
    repeats: bool


@dataclass(frozen=True)
class Circumstances:
    """What is known of the moment of a decision.

    model : what a model that was handed in is called.  rule : as it stood, None where that is not kept.
    coin : where the audits' coin fell, in [0, 1).  safe_mode : why everything was verified, "" where it was not.
    """

    recipe: Recipe = field(default_factory=Recipe)
    spec: TraceSpec = field(default_factory=lambda: TraceSpec(1))
    model: str | None = None
    rule: DecisionRule | None = None
    novelty: Novelty | None = None
    coin: float = 1.0
    safe_mode: str = ""


def bound_of(made: Decision, found: Circumstances) -> Bound | None:
    """How a decision's bound came out; None where none was asked for: of bad and novel traces, and before any model."""
    if made.reason not in BOUNDED or _was_lost(made):
        return None
    policy = found.recipe.policy
    accept_at, reject_at, level = _thresholds(found)
    lower, upper = policy.bound(made.n_success, made.n_failure)
    return Bound(
        interval=policy.interval,
        alpha=policy.alpha,
        n_success=made.n_success,
        n_failure=made.n_failure,
        lower=made.lower,
        upper=made.upper,
        ball=_ball(made, found),
        accept_at=accept_at,
        reject_at=reject_at,
        level=level,
        successes_needed=None if accept_at is None else _needed(policy, made, accept_at, 1),
        failures_needed=None if reject_at is None else _needed(policy, made, reject_at, 0),
        repeats=found.model is not None or bool(np.allclose((lower, upper), (made.lower, made.upper), atol=1e-6)),
    )


def _was_lost(made: Decision) -> bool:
    """Whether the row was made from a stop whose decision was lost: an accept on no evidence."""
    return (made.reason, made.action, made.lower, made.upper) == (Reason.CERTAIN, Action.ACCEPT, 0.0, 1.0)


def _thresholds(found: Circumstances) -> tuple[float | None, float | None, str]:
    policy, rule = found.recipe.policy, found.rule
    if found.model is not None and rule is None:
        return None, None, f"{found.model} decides by its own rule"
    if policy.guarantee not in RULES:
        return None, None, f"{policy.guarantee} decides by its own rule"
    if policy.guarantee == "local" and not found.safe_mode:
        return policy.lower_bound, 1.0 - policy.lower_bound, "LB, of the ball around the part"
    if rule is None or rule.evidence is None:
        return None, None, "the levels that held then are not kept"
    accept_at, reject_at = (float(level) for level in rule.evidence.open)
    held = "the lowest level that held then" if policy.guarantee == "pooled" else "what held in safe mode"
    return accept_at if accept_at < NOBODY else None, 1.0 - reject_at if reject_at < NOBODY else None, held


def _ball(made: Decision, found: Circumstances) -> str:
    recipe = found.recipe
    if found.model is not None and found.rule is None:
        return "as the model counts them"
    if recipe.fraction is None:
        return f"within the radius {recipe.radius:g}"
    narrow = recipe.reject_fraction if made.predicted is Action.REJECT else None
    return f"among the nearest {100 * (narrow or recipe.fraction):g} % of the references"


def _needed(policy: Policy, made: Decision, threshold: float, success: int) -> int | None:
    more = np.arange(MOST + 1)
    lower, upper = policy.bound(made.n_success + success * more, made.n_failure + (1 - success) * more)
    enough = np.flatnonzero(lower >= threshold if success else upper <= threshold)
    return int(enough[0]) if len(enough) else None


def verdict(past: StoredDecision, bound: Bound | None, found: Circumstances) -> Iterator[str]:
    """The sentences: what was done and why, how the bound came out, and what became of the part."""
    made = past.decision
    yield _why(made, past.trace, found)
    if bound is not None:
        yield from _bound_sentences(made, bound, found)
    if found.novelty is not None and made.reason is not Reason.NOVEL:
        yield f"It is not novel: {_scores(found.novelty)}."
    source = "" if past.source is None else f" ({past.source.value})"
    known = past.success is not None
    yield f"The part turned out {past.label}{source}." if known else "Nothing was reported of the part."


def _why(made: Decision, trace: NDArray[np.float32], found: Circumstances) -> str:
    did = DID[made.action].capitalize()
    if _was_lost(made):
        return f"{did}: the row was made from a stop whose decision was lost; on what evidence is not known."
    said = {
        "would": DID[made.predicted],
        "coin": found.coin,
        "rate": made.propensity,
        "n": int((~np.isfinite(trace)).sum()),
        "size": trace.size,
        "first": float(trace.flat[0]),
        "unit": found.spec.unit,
        "saturation": _saturation(trace, found.spec),
        "score": "" if found.novelty is None else f": {_scores(found.novelty)}",
        "mode": found.safe_mode or "its reason is not kept",
    }
    return did + WHY[made.reason].format(**said)


WHY = {
    Reason.CERTAIN: ": the bound meets the policy.",
    Reason.UNCERTAIN: ": the bound does not meet the policy.",
    Reason.NO_MODEL: ": no model had been trained yet, so every part was.",
    Reason.AUDIT: (
        " as an audit: the model alone would have {would} it. The audits' coin fell on {coin:.4f}, below the audit rate "
        "{rate:g}; it is a function of the trace and the seed."
    ),
    Reason.NOT_FINITE: ": {n} of {size} samples are NaN or infinite; a trace that was cut or padded too far is.",
    Reason.CONSTANT: ": every sample is {first:g} {unit}: a dead sensor.",
    Reason.SATURATED: ": {saturation}",
    Reason.MODEL_ERROR: ": the model raised an error, which the log of that time tells.",
    Reason.NOVEL: ": unlike all that was learned from{score}. What its neighbours say does not count then.",
    Reason.SAFE_MODE: " in safe mode, in which every part is: {mode}.",
    Reason.NO_STORE: (
        ": the store could not be written then, so the model was not asked; decision and label waited in its journal."
    ),
    Reason.LATE: ": whoever asked could wait no longer for the answer, and verified, so the model was not asked.",
}


def _saturation(trace: NDArray[np.float32], spec: TraceSpec) -> str:
    if spec.limit is None:
        return "the trace touched the sensor's range."
    touching = np.argwhere(np.abs(trace) >= spec.limit)
    if not len(touching):
        return f"the trace touched the sensor's range, which is now {spec.limit:g} {spec.unit}."
    channel, sample = (int(i) for i in touching[np.argmin(touching[:, 1])])
    return (
        f"{len(touching)} samples touch the sensor's range of {spec.limit:g} {spec.unit}, first after "
        f"{sample / spec.rate_hz:.3f} s (channel {channel + 1})."
    )


def _scores(novelty: Novelty) -> str:
    return f"in level {novelty.level:.2f} times the limit, in texture {novelty.texture:.2f} times the limit"


def _bound_sentences(made: Decision, bound: Bound, found: Circumstances) -> Iterator[str]:
    n, reach = bound.n_success + bound.n_failure, f"{bound.lower:.3f} to {bound.upper:.3f}"
    if found.model is not None and found.rule is None:
        yield f"{found.model} gives {bound.n_success} successes, {bound.n_failure} failures, bound {reach}."
        return
    counted = f"{bound.n_success} of {n} labels {bound.ball} are successes" if n else f"No label {bound.ball}"
    name = bound.interval.replace("_", "-").capitalize()
    yield f"{counted}; {name} at alpha {bound.alpha:g} bounds the success rate by {reach}."
    if bound.accept_at is None and bound.reject_at is None:
        why = found.safe_mode or (bound.level if found.rule is None else "no level of evidence held yet")
        yield f"Nothing could pass, whatever the bound: {why}."
        return
    if made.predicted is not Action.REJECT:
        yield _side("accept", f"lower must be at least {{:.4g}} ({bound.level}); it is {bound.lower:.3f}", bound)
    if made.predicted is not Action.ACCEPT:
        yield _side("reject", f"upper must be at most {{:.4g}} ({bound.level}); it is {bound.upper:.3f}", bound)


def _side(action: str, must: str, bound: Bound) -> str:
    """What one action would have needed."""
    ways = {
        "accept": (bound.accept_at, bound.successes_needed, "success", "successes", "failure"),
        "reject": (bound.reject_at, bound.failures_needed, "failure", "failures", "success"),
    }
    threshold, needed, one, many, other = ways[action]
    if threshold is None:
        return f"To {action}: no level held, so nothing could be {action}ed."
    more = "no number of labels" if needed is None else f"{needed} more {one if needed == 1 else many} and no {other}"
    return f"To {action}, {must.format(threshold)}" + (", enough." if needed == 0 else f": {more} would do.")
