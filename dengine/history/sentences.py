"""The reason of a decision, in sentences and as a bound with its threshold.

`explain_in_words` writes the sentences, `bound_of` returns the `Bound`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from ..decision.intervals import SORTING_GUARANTEES, interval_error_level
from ..decision.members import CLOSED
from ..decision.policy import RULES
from ..errors import outward
from ..recipe import Recipe
from ..records import Action, Decision, Reason, TraceArray, TraceSpec
from ..store.records import StoredDecision
from ..traces import LARGEST, WITHIN_LIMITS, ForceLimitsGate
from .past_versions import Novelty, Thresholds

# Reasons of decisions for which the model was asked, so that there are bounds.
BOUNDED = (Reason.CERTAIN, Reason.UNCERTAIN, Reason.AUDIT, Reason.SAFE_MODE)
DID = {Action.ACCEPT: "accepted", Action.REJECT: "rejected", Action.VERIFY: "verified"}


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
        Accepted if lower >= accept_threshold. None if nothing could be accepted, or if unknown.
    reject_threshold : float or None
        Rejected if upper <= reject_threshold. None if nothing could be rejected, or if unknown.
    origin : str
        Where the thresholds come from, in words.
    """

    n_success: int
    n_failure: int
    lower: float
    upper: float
    accept_threshold: float | None
    reject_threshold: float | None
    origin: str


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
    thresholds : (float, float) or None
        As in `PastVersion`; None if they are not kept.
    novelty : Novelty or None
        As in `Explanation`.
    safe_mode : str
        Why the safe mode had begun; "" outside safe mode.
    """

    recipe: Recipe
    spec: TraceSpec
    model: str | None
    thresholds: Thresholds | None
    novelty: Novelty | None
    safe_mode: str

    @property
    def baseline(self) -> str:
        """Name of a handed-in model whose thresholds are not known, which is taken to decide by its
        own method; "" for any other model.
        """
        return (self.model or "") if self.thresholds is None else ""


def bound_of(decision: Decision, circumstances: Circumstances) -> Bound | None:
    """Return a decision's bounds with the thresholds that they had to reach.

    They bound the success probability. The result also has the counts of good and bad labels
    nearby, and says in words where the thresholds come from. A threshold is None if it is unknown,
    or if nothing could reach it. `circumstances` are the settings of the engine, and the thresholds
    of its rule, at the decision. Returns None if no bound was computed: for every reason of a
    decision but CERTAIN, UNCERTAIN, AUDIT and SAFE_MODE.
    """
    if decision.reason not in BOUNDED:
        return None
    return Bound(
        decision.n_success,
        decision.n_failure,
        decision.lower,
        decision.upper,
        *_find_thresholds(circumstances),
    )


def _find_thresholds(circumstances: Circumstances) -> tuple[float | None, float | None, str]:
    """Return accept threshold (of lower), reject threshold (of upper), and their origin in words.

    `circumstances` are the settings of the engine, and the thresholds of its rule, at a decision. A
    part was accepted if the lower bound of its success probability was >= the first, rejected if
    the upper one was <= the second. Under the guarantee (the rule that decides) "local" they are LB
    (`Policy.lower_bound`) and 1 - LB, unless the decision was made in a safe mode (after an alarm)
    whose reason is kept; else those of the model version's rule at that time. Both are None if they
    are unknown: they are not kept, a user's rule decided, or a model that the user handed in
    decided by its own method. Otherwise the first is None if nothing could be accepted, the second
    if nothing could be rejected; both may be.
    """
    policy = circumstances.recipe.policy
    if circumstances.baseline or policy.guarantee not in RULES:
        return None, None, f"{circumstances.baseline or policy.guarantee} decides by its own rule"
    if policy.guarantee == "local" and not circumstances.safe_mode:
        return policy.lower_bound, 1.0 - policy.lower_bound, "LB, of the neighbourhood of the part"
    if circumstances.thresholds is None:
        return None, None, "the thresholds of that time are not kept"
    accept_score, reject_score = circumstances.thresholds
    origin = "what held in safe mode"
    if policy.guarantee in SORTING_GUARANTEES:
        origin = "the lowest level that held then"
    accept_threshold = accept_score if accept_score < CLOSED else None
    reject_threshold = 1.0 - reject_score if reject_score < CLOSED else None
    return accept_threshold, reject_threshold, origin


def explain_in_words(
    item: StoredDecision, bound: Bound | None, circumstances: Circumstances
) -> Iterator[str]:
    """Yield the sentences that explain a decision: its reason, its bounds, its outcome.

    `circumstances` are the settings and the state of the engine at the decision. If `bound`, which
    `bound_of` returns, is None, the sentences on the bounds of the success probability are left
    out. The last sentence is on the label (good or bad) as corrected by now; without a label, or if
    a person withdrew it, it says that nothing was reported. `item` must have its trace. Raises
    SettingError for a part outside the force limits (an operator's limits of the signal) if one of
    these limits does not fit the trace.
    """
    decision = item.decision
    yield DID[decision.action].capitalize() + _explain_reason(decision, item.trace, circumstances)
    if bound is not None:
        yield from _bound_sentences(decision, bound, circumstances)
    if item.success is None:
        yield "Nothing was reported of the part."
    else:
        yield f"The part turned out {item.label} ({item.source})."


def _explain_reason(decision: Decision, trace: TraceArray, circumstances: Circumstances) -> str:
    """Return the reason of a decision, as text that follows "Accepted", "Rejected" or "Verified".

    Verified is a part that was sent to the check. `circumstances` are the settings and the state of
    the engine at the decision. If the reason is a force limit (an operator's limit of the signal)
    or a safe mode (after an alarm about wrong decisions or novel traces, parts are checked until
    outcomes allow decisions again), the text names the limit that the trace leaves, or the alarm,
    or says that it is not known. Raises SettingError for a part outside the force limits if one of
    these limits does not fit the trace.
    """
    if decision.reason is Reason.OUTSIDE:
        x = torch.from_numpy(trace)
        left = [
            str(limits)
            for limits in circumstances.recipe.policy.force_limits
            if ForceLimitsGate([limits], circumstances.spec)(x) != WITHIN_LIMITS
        ]
        names = " and ".join(left) or "which is not known"
        return f": it leaves the operator's force limits, {names}, whatever the model says."
    n_bad = (~np.isfinite(trace)).sum()
    novelty = "" if circumstances.novelty is None else f": {circumstances.novelty}"
    alarm = circumstances.safe_mode or "its reason is not kept"
    return {
        Reason.CERTAIN: ": the bound meets the policy.",
        Reason.UNCERTAIN: ": the bound does not meet the policy.",
        Reason.NO_MODEL: ": no model had been trained yet, so every part was verified.",
        Reason.AUDIT: f" as an audit: the model alone would have {DID[decision.predicted]} it.",
        Reason.NOT_FINITE: f": {n_bad} of {trace.size} samples are NaN or infinite.",
        Reason.CONSTANT: ": every sample has the same value: a dead sensor.",
        Reason.SATURATED: ": the trace touched the sensor's range.",
        Reason.TOO_LARGE: (
            f": a sample is beyond {LARGEST:g}, where nothing can be computed from it."
        ),
        Reason.MODEL_ERROR: ": the model raised an error; see the log of that time.",
        Reason.NOVEL: (
            f": unlike all traces that were learned from{novelty}. "
            "The labels of its neighbours do not count then."
        ),
        Reason.SAFE_MODE: f" in safe mode, which began after an alarm: {alarm}.",
        Reason.NO_STORE: (
            ": the disk or the store did not respond in time, so the decision could not be "
            "recorded, or its id could not be looked up, and the model was not asked."
        ),
        Reason.LATE: ": the caller timed out and verified the part, so the model was not asked.",
    }[decision.reason]


def _bound_sentences(
    decision: Decision, bound: Bound, circumstances: Circumstances
) -> Iterator[str]:
    """Yield the sentences on the labels near a trace, on the bounds, and on their thresholds.

    They are the bounds of the success rate near the trace. `circumstances` are the settings of the
    engine at the decision. If nothing could be accepted or rejected, or the thresholds are unknown,
    the sentences say so. For a model that the user handed in and that decides by its own method
    there is one sentence, with its counts and bounds. Under the guarantees (rules that decide)
    "pooled" and "cost" two equal bounds are given as one number, the mean of the success
    probabilities that the reducer's classifiers give, one in each embedding space. An interval is
    rounded outward to three decimals.
    """
    n = decision.n_success + decision.n_failure
    interval = "{:.3f} to {:.3f}".format(*outward(decision.lower, decision.upper, 3))
    if circumstances.baseline:
        counts = f"{decision.n_success} successes, {decision.n_failure} failures"
        yield f"{circumstances.baseline} gives {counts}, bound {interval}."
        return
    policy = circumstances.recipe.policy
    within = f"within the radius {circumstances.recipe.radius:g}"
    counts = (
        f"{decision.n_success} of {n} labels {within} are successes" if n else f"No label {within}"
    )
    if policy.guarantee in SORTING_GUARANTEES and decision.lower == decision.upper:
        yield (
            f"{counts}; the heads give it {decision.lower:.6g}, the mean of what each says "
            "of its success."
        )
    else:
        name = policy.interval.replace("_", "-").capitalize()
        error_level = interval_error_level(policy.alpha, policy.guarantee)
        yield f"{counts}; {name} at alpha {error_level:g} bounds the success rate by {interval}."
    if bound.accept_threshold is None and bound.reject_threshold is None:
        why = circumstances.safe_mode
        if not why and circumstances.thresholds is not None and policy.guarantee in RULES:
            why = "no level of evidence held yet"
        yield (
            f"Nothing could pass, whatever the bound: {why}."
            if why
            else f"What it had to reach: {bound.origin}."
        )
        return
    for action, condition, threshold in (
        ("accept", "lower must be at least", bound.accept_threshold),
        ("reject", "upper must be at most", bound.reject_threshold),
    ):
        if threshold is None:
            yield f"To {action}: no level held, so nothing could be {action}ed."
        else:
            yield f"To {action}, {condition} {threshold:.6g} ({bound.origin})."
