"""What people put right: a wrong label, labels to forget, a version to go back to, another policy.

    engine.correct(decision.id, success=False, author="kim")
    engine.rollback(3)

Each is an event that is kept for ever. Nothing is overwritten: a correction is a later row, an earlier version answers
again as a new one, and what was decided stays as it was decided.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..decision.intervals import SORTING_GUARANTEES
from ..decision.members import SAFE_MODES
from ..decision.policy import Policy
from ..errors import ReportError, SettingError, expect, listed
from ..records import as_success
from ..store.records import (
    POLICY_CHANGED,
    SHADOW_CHANGED,
    Change,
    StoredDecision,
    nothing_to_correct,
    unknown_decision,
)
from .core import EngineCore
from .settings import EvidenceWindow

# What a rule is made of, and its evidence measured by.
SCORING = ("alpha", "lower_bound", "interval", "guarantee", "stops", "prices")
SHADOW = {
    True: "shadow mode: every part is verified from now on",
    False: "the shadow mode ended: the model decides again",
}
SAID = {True: "success", False: "failure"}


@dataclass(frozen=True, slots=True)
class Changed:
    """What a verb that puts something right did.

    kind : "correct", "forget", "rollback", "policy" or "shadow".  text : in words.
    event : number of the event that was recorded; None where everything was as asked already, and nothing changed.
    version : of the model that answers now.
    """

    kind: str
    text: str
    event: int | None
    version: int


class Corrections:
    """Puts things right in a store, and in what an engine has learned."""

    def __init__(self, core: EngineCore) -> None:
        self._core = core
        self._store = core.store

    def correct(self, decision_id: str, success: bool, author: str = "") -> Changed:
        """Say that a label was wrong, or that a forgotten one counts again, from the next decision on.

        References, the next retrain, the rule's evidence and the certificate take the label as corrected; its trace's fold
        stays. A baseline, which cannot take a label back, is trained anew at once. What was reported stays in the store.
        author : who says so, for the record.
        Raises ReportError for an unknown decision, and for one without a label. A label that is so already changes nothing.
        """
        label = as_success(success)
        (known,) = self._to_correct([decision_id])
        if known.success is label:
            return self._unchanged(
                "correct", f"Decision {known.decision.id} counts as a {SAID[label]} already"
            )
        was = "forgotten" if known.success is None else f"a {SAID[known.success]}"
        text = f"decision {known.decision.id} counts as a {SAID[label]}, was {was}"
        data = {"decisions": {known.decision.id: {"was": known.success, "now": label}}}
        return self._correct(Change("correct", text, data, author, (known.decision.id,), label))

    def forget(self, *decision_ids: str, author: str = "", reason: str = "") -> Changed:
        """Leave labels out of all that is learned and counted, from the next decision on; `correct` brings one back.

        Traces, and labels as they were reported, stay in the store; the version that was trained with them goes on until
        the next retrain. A guarantee assumes that what is forgotten is chosen blind to its label; the certificate takes a
        forgotten outcome of what was certain for a wrong decision, so that forgetting earns nothing.
        Raises ReportError for an unknown decision, and for one without a label; then none is forgotten.
        """
        if not decision_ids:
            raise ReportError(
                "Expected the ids of decisions to forget, got none; name at least one."
            )
        known = self._to_correct(list(dict.fromkeys(decision_ids)))
        was = {each.decision.id: each.success for each in known if each.success is not None}
        if not was:
            return self._unchanged(
                "forget", f"{_labels([each.decision.id for each in known])} forgotten already"
            )
        text = f"{_labels(list(was))} forgotten" + (f": {reason}" if reason else "")
        data = {
            "decisions": {id_: {"was": label, "now": None} for id_, label in was.items()},
            "reason": reason,
        }
        return self._correct(Change("forget", text, data, author, tuple(was), None))

    def rollback(self, version: int, author: str = "") -> Changed:
        """Let an earlier version answer again, as a new version, so that the history goes on in one line.

        Labels that came since are among its references, corrections count, and the rule keeps what it was told. The next
        retrain goes on from this version. A reducer that is stored by its traces (umap-learn), and a baseline, are fitted
        again: the first on what it was fitted on, the second on the same traces with the labels as they count now.
        Raises StoreError for a version that is not kept, which names those that are.
        """
        if isinstance(version, bool) or not isinstance(version, int | np.integer):
            raise SettingError(
                f"Expected the number of a version, got {version!r}; `store.retrains()` lists them."
            )
        self._make_ready()
        if version == self._core.live.version and version > 0:
            return self._unchanged("rollback", f"Version {version} answers already")
        before, now = self._core.live.version, self._core.live.next_version
        text = f"version {version} answers again, as version {now} after {before}"
        event = Change("rollback", text, {"to": int(version), "was": before, "now": now}, author)
        self._core.learner.roll_back(int(version), event)
        return self._done(event)

    def set_policy(self, policy: Policy, author: str = "") -> Changed:
        """Decide by another policy from the next decision on; every earlier one keeps the bounds that it was decided by.

        Where anything but the audit rate changes, under "pooled" and "cost" where that does, the rule starts anew, told of
        what is decided from now on: a tolerance chosen after the data was seen is not one of those that alpha was spent
        on, and old bounds are of another scale.
        `certificate` speaks of what is decided since this change; one who may choose among m policies' certificates errs
        with up to m alpha. A safe mode goes on, where the new rule has one, until fresh evidence ends it. A part that was
        accepted before, and of which nothing was heard, stays unobserved.
        In the shadow mode, `Policy(shadow=True)`, each part that the model is certain of is an audit:
        `Decision.predicted` says what it would have done, and all is learned from as ever. It lasts over restarts.
        Raises SettingError for what is no policy, for windows that the traces cannot hold, and, of a model that was handed
        in, for anything but audit_rate, stops, label_within, windows and shadow.
        """
        expect(
            isinstance(policy, Policy),
            "a Policy",
            policy,
            "for example Policy(alpha=0.05, lower_bound=0.95)",
        )
        now = self._core.settings.now
        live = self._core.live
        was, wished = now.recipe.policy.to_values(), policy.to_values()
        new = {name: value for name, value in wished.items() if value != was[name]}
        if not new:
            return self._unchanged("policy", "The policy is in force already")
        own = now.model is not None  # a model that was handed in keeps its rule
        idle = (
            sorted(set(new) - {"audit_rate", "stops", "shadow", "label_within", "windows"})
            if own
            else []
        )
        if idle:
            said = f"so {', '.join(idle)} would have no effect"
            do = "change only audit_rate, stops, label_within, windows and shadow"
            raise SettingError(
                f"A model that was handed in decides by its own numbers, {said}; {do}."
            )
        self._make_ready()
        # An audit weighs as its propensity says, so that the pooled evidence is of one audit rate.
        before = now.recipe.policy.inclusion_probability
        asked = policy.guarantee in SORTING_GUARANTEES and policy.inclusion_probability != before
        anew = not own and (asked or any(name in new for name in SCORING))
        since = 0 if live.answering is None else live.next_version
        evidence = (
            EvidenceWindow(since, SAFE_MODES.index(live.newest.safe_mode)) if anew else now.evidence
        )
        settings = replace(
            now, recipe=replace(now.recipe, policy=policy), policy_since=since, evidence=evidence
        )
        kind, text = (
            POLICY_CHANGED,
            "the policy's "
            + ", ".join(f"{name} {was[name]} -> {value}" for name, value in new.items()),
        )
        if list(new) == ["shadow"]:
            kind, text = SHADOW_CHANGED, SHADOW[policy.shadow]
        event = Change(
            kind, text, {"old": was, "new": wished}, author, settings=settings.to_store()
        )
        self._core.learner.set_policy(policy if anew else None, evidence, event)
        self._core.settings.change(settings)
        self._core.feedback.begin_policy()
        return self._done(event, "the rule of the policy in force has none")

    def _make_ready(self) -> None:
        """Swap in what an executor trains, and store what waits: a correction comes after all that was known before."""
        self._core.outbox.check_usable()
        self._core.learner.make_ready()

    def _to_correct(self, ids: Sequence[Any]) -> list[StoredDecision]:
        self._make_ready()
        found = []
        for each in ids:
            known = self._store.get_decision(each) if isinstance(each, str) else None
            if known is None:
                raise unknown_decision(each)
            if known.source is None:
                raise nothing_to_correct(each)
            found.append(known)
        return found

    def _correct(self, change: Change) -> Changed:
        self._store.apply_change(change)
        for name in change.decisions:
            self._core.outbox.evict_decision(name)
        self._core.learner.apply_corrections()
        return self._done(change)

    def _done(
        self, change: Change, reason_ended: str = "what was told anew keeps the tolerance"
    ) -> Changed:
        number = self._store.events(1)[0].number
        self._core.feedback.announce_safe_mode(reason_ended)
        return Changed(change.kind, _sentence(f"{change.text}."), number, self._core.live.version)

    def _unchanged(self, kind: str, text: str) -> Changed:
        return Changed(kind, _sentence(f"{text}; nothing changed."), None, self._core.live.version)


def _sentence(text: str) -> str:
    return text[0].upper() + text[1:]


def _labels(ids: Sequence[str]) -> str:
    return f"the labels of {listed(ids)} are" if len(ids) > 1 else f"the label of {ids[0]} is"
