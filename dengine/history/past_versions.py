"""Restores a model version as it was at a decision, `load_past_version`, and the present decision
rule, `load_rule`, from a store and without an engine.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from ..decision.member_rules import MemberRule
from ..decision.novelty import NoveltyGate
from ..decision.policy import RULES, Policy
from ..decision.references import RadiusIndex
from ..decision.rule import DecisionRule
from ..decision.scripting import arrays_with_prefix, restore
from ..errors import StoreError, VersionError
from ..folds import fold_of
from ..recipe import Recipe
from ..records import Reason, Source
from ..store.records import ModelVersion, OutcomeRecord, StoredDecision
from ..store.rule_progress import read_rule_progress
from ..store.views import PastLabel

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
        Accept threshold and reject threshold of that moment. A part was accepted if lower >= the
        first, rejected if 1 - upper >= the second. None if they are not kept.
    last_seq : int
        Number of the newest label that had come by then.
    novelty : Novelty or None
        Of the decision's trace, if the version found it novel; else None.
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

    Its references (labelled points) and its decision rule include this robot cell's labels that had
    come by then, as they were reported: later corrections are not applied. Of the labels that came
    after the version was trained, only those that came before the next version of this cell was
    stored, and at most MAX_LABELS (100,000), are read; they become references if this version was
    in force when they came. A label that is damaged (not as it was stored) is left out, and an
    event is written to the store's log.

    Parameters
    ----------
    store : SqlStore
    version : int
        Number of the version.
    recipe : Recipe
        The recipe (the settings of the engine) of that moment.
    item : StoredDecision or None
        The decision, with its trace. None: the version with all labels that came before the next
        version of this cell was stored.

    Returns
    -------
    PastVersion or None
        The references with their labels (None for a label of another cell or a damaged one), the
        thresholds of the rule (None if they are not kept), and how novel (unlike the training
        traces) the trace of the decision was (None if the reason of the decision is another one, or
        the limits are not kept). The result is None if no such version was put in force, if its
        stored arrays are damaged or no longer kept, or if it has no references (a model that the
        user handed in).

    Raises
    ------
    StoreError
        If the store cannot be read.
    SettingError
        If an object of the user's class of decision rule cannot be made. An error of its
        constructor other than TypeError, and what its `observe` and `update` raise, is raised as it
        is.
    """
    try:
        stored = store.versions.load(version)
    except VersionError:
        return None
    if "points" not in stored.state:  # a baseline keeps no references
        return None
    later_retrains = [
        retrain.last_seq
        for retrain in store.versions.all(cell_only=True)
        if retrain.report.accepted and retrain.report.version > version
    ]
    last = min([*later_retrains[:1], stored.last_seq + MAX_LABELS])
    later = store.labels.past(stored.last_seq, last)
    if item is not None:
        later = [
            label
            for label in later
            if label.time <= item.time and label.decision_id != item.decision.id
        ]
    before = store.labels.past(int(stored.state["trained_on"][0]) - 1, stored.last_seq)
    by_number = {label.seq: label for label in (*before, *later) if not label.quarantined}
    index = _restore_index(stored, later, recipe)
    return PastVersion(
        index=index,
        labels=[by_number.get(number) for number in index.column("numbers").tolist()],
        thresholds=_restore_thresholds(stored, later, recipe.policy),
        last_seq=max(by_number, default=stored.last_seq),
        novelty=_score_novelty(stored, item),
    )


def _restore_index(stored: ModelVersion, later: list[PastLabel], recipe: Recipe) -> RadiusIndex:
    """Return the index of a stored version's references, with the `later` labels of its decisions.

    References are labelled points. A label without a point (the embedding of its trace), or of
    another version's decision, is left out. The index counts as full if the version had replaced
    its oldest references for lack of room; each added reference then replaces the oldest. Otherwise
    there is room for `recipe.window` references, but at least for the stored ones, after which the
    oldest are replaced, too. A reference lies in the embedding space of its fold, a group that
    follows from the label's `content_hash`: the hash of the part's number, or of the trace if it
    has none.
    """
    n = stored.state["points"].shape[1]
    spaces = len(stored.state["scale"])
    is_full = int(stored.state["total"]) > n
    index = RadiusIndex.from_state(stored.state, n if is_full else max(n, recipe.window))
    for label in later:
        if label.model_version == stored.version and label.point is not None:
            index.add_one(
                torch.from_numpy(label.point),
                float(label.success),
                int(fold_of(label.content_hash, spaces)),
                label.content_hash,
                label.seq,
            )
    return index


def _score_novelty(stored: ModelVersion, item: StoredDecision | None) -> Novelty | None:
    """Compute how novel the trace of a decision was, by its version's `NoveltyGate`.

    The gate calls a trace novel by its distance from the traces of the training, in four respects
    (level, texture, distortion, gaps). The result has for each the squared distance divided by its
    limit; for a novel trace at least one is above 1, or NaN because a feature overflowed. Returns
    None without a decision, if the decision's reason is not `Reason.NOVEL`, and if the gate cannot
    be restored, because it was switched off or is of another release of dengine.
    """
    if item is None or item.decision.reason is not Reason.NOVEL:
        return None
    gate = NoveltyGate(*stored.state["trace_shape"].tolist())
    gate.disabled = False
    try:
        restore(gate, arrays_with_prefix(stored.state, "novelty."))
    except StoreError:  # the gate of another version of dengine
        return None
    with torch.inference_mode():
        return Novelty(*gate.scores(torch.from_numpy(item.trace)).tolist())


def _restore_rule(stored: ModelVersion, policy: Policy) -> DecisionRule | None:
    """Return the decision rule of a policy with the state that a version stored.

    The state is what the rule had learned, stored as arrays. It fits if they have the names and
    shapes of the rule's arrays; whether it was stored under the same policy is not checked. Returns
    None if the version has no state that fits: it stored another rule or none (it is a version of
    another robot cell, or a model that the user handed in), or its rule was stale (it had missed an
    update). Also None if the rule is a user's class whose module is not imported yet, since nothing
    is imported here. A rule that learns nothing needs no state. Raises SettingError if an object of
    the user's class cannot be made; an error of its constructor other than TypeError is raised as
    it is.
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

    They are (accept, reject), for the bounds lower and upper of the success probability: a part was
    accepted if lower >= the first, rejected if 1 - upper >= the second; if both held, a
    `MemberRule` (a rule that learns) had it verified. Labels of quarantined traces (never used in
    training) and of rejected parts that somebody inspected do not update the rule, nor do checks
    without a report, which an engine counts as wrong when they are overdue. The rule of the
    guarantee "local" (a guarantee is what is promised about decisions) with stops="some" (not every
    bad accepted part is reported) learns nothing, so both thresholds are the policy's lower bound;
    but if the version stored the state of another rule, the result is None. Of any other rule the
    result is None if `_restore_rule` returns None (the version stored no state that fits the rule,
    or a user's rule is not imported), or if the rule is no `MemberRule`: only rules of this class
    have thresholds. Raises what `_restore_rule` raises, and what a user's rule raises in an update.
    """
    is_local = (policy.guarantee, policy.stops) == ("local", "some")
    if is_local and not arrays_with_prefix(stored.state, "rule."):
        return policy.lower_bound, policy.lower_bound  # the paper's rule learns nothing
    rule = _restore_rule(stored, policy)
    if not isinstance(rule, MemberRule):
        return None
    for label in later:
        if not label.quarantined and label.source is not Source.INSPECTION:
            _update_rule(rule, label)
    accept_threshold, reject_threshold = rule.evidence.thresholds.tolist()
    return accept_threshold, reject_threshold


def load_rule(store: SqlStore, policy: Policy) -> DecisionRule | None:
    """Return the present decision rule: the stored rule, updated with all outcomes since.

    The rule is stored with each model version. If a label was corrected or a check is overdue (not
    reported in time), the stored rule cannot be continued, and a fresh one is updated with all
    outcomes since the rule last started anew, for example at a change of the policy (for all such
    cases see `RuleProgress.last_seq`). The updates may begin or end a safe mode of the returned
    rule (after an alarm parts are checked until outcomes allow decisions again); a fresh rule
    starts in the safe mode, if any, in which it started then (`EvidenceWindow.began_in`). Nothing
    is written to the store, except records that wait to be written, and an event in its log if the
    arrays of a version are damaged; then the version before it is taken. The checksums of the
    store's rows are not checked.

    Parameters
    ----------
    store : SqlStore
    policy : Policy

    Returns
    -------
    DecisionRule or None
        None if there is no version, or none whose arrays are kept and intact, and if a user's class
        of rule is not imported. Also None if the newest version has no arrays with the names and
        shapes of the rule's: another robot cell that shares the versions made it, it is a model
        that the user handed in, it was made under a policy whose rule has other arrays, or the rule
        was stale (it had missed an update). A rule that learns nothing, like that of a policy with
        guarantee="local" (a promise on each part's neighbourhood) and stops="some" (not every bad
        accepted part is reported), has no arrays: another cell's version will do for it, and it is
        never stale.

    Raises
    ------
    StoreError
        If the store cannot be read.
    SettingError
        If an object of the user's class of rule cannot be made. An error of its constructor
        other than TypeError, and what its `observe` and `update` raise, is raised as it is.
    ValueError
        For a stored setting that must be a number and is none.
    """
    stored = store.versions.newest()
    settings = store.settings.read()
    if stored is None or (rule := _restore_rule(stored, policy)) is None:
        return None
    since, began_in, policy_since = (
        int(settings.get(name, 0)) for name in ("evidence_since", "began_in", "policy_since")
    )
    progress = read_rule_progress(store, stored, since, policy.label_within, policy_since)
    if not progress.last_seq:  # rebuilt from all outcomes, as when an engine is opened
        rule = rule.clone()
        rule.start_in_safe_mode(began_in)
    for outcome in store.labels.outcomes_since(progress.last_seq, since, progress.overdue_to):
        _update_rule(rule, outcome)
    return rule


def _update_rule(rule: DecisionRule, outcome: PastLabel | OutcomeRecord) -> None:
    """Update a rule, in place, with the outcome of one part.

    First `observe` gets `outcome.silent`, the number of accepted parts since the previous label of
    which nothing was reported, and whether the trace of this part was novel (unlike all training
    traces). Then `update` gets the bounds of the success probability, the label, the action that
    the model alone would have taken, and the probability with which the outcome would be asked for.
    A safe mode of the rule, in which parts are checked until outcomes allow decisions again, may
    begin or end. What a user's rule raises is raised.
    """
    rule.observe(outcome.silent, outcome.novel)
    rule.update(
        outcome.lower,
        outcome.upper,
        outcome.success,
        outcome.predicted,
        outcome.inclusion_probability,
    )


@dataclass(frozen=True, slots=True)
class Novelty:
    """How novel a trace was, in four respects: level, texture, distortion and gaps.

    Texture is how rough the signals are, distortion what a faulty sensor or clock would do. Each
    number is the squared distance to the nearest reference, divided by its limit. A trace is novel
    if any of the four is above 1.
    """

    level: float
    texture: float
    distortion: float
    gaps: float

    def __str__(self) -> str:
        return (
            f"in level {self.level:.2f} times the limit, texture {self.texture:.2f}, distortion "
            f"{self.distortion:.2f}, gaps {self.gaps:.2f}"
        )
