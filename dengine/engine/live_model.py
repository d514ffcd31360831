"""`LiveModel`: the model in force, and how its references and its rule learn from outcomes.
Outcomes come from `feedback.Feedback`; `learner.Learner` says which version is put in force, and
when.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from ..decision.policy import Policy
from ..model.base import EngineModel
from ..records import ACTIONS, Decision, Reason, State
from ..store.outbox import Outbox
from ..store.records import (
    Correction,
    OutcomeRecord,
    StoredDecision,
    overdue_outcomes,
)
from ..store.rule_progress import read_rule_progress
from .guard import NO_REFERENCE, NOT_READY, RULE_MISSED, guarded
from .resume import ChangedTracesError, add_labels_since, apply_correction, restore_model
from .settings import EvidenceWindow, SettingsInForce
from .trainer import TrainedOn, TrainingWindow


class LiveModel:
    """The model in force, with its decision rule and its references.

    Only the thread that uses the engine changes it; other threads may read its attributes.

    Parameters
    ----------
    template : EngineModel
        Untrained; the first version is trained from it, and its rule is updated until then.
    window : TrainingWindow
        Of the labels that the next version is trained on.
    outbox : Outbox
        Through which the engine uses its store.
    settings : SettingsInForce
        Which decisions the rule in force is updated with, and when a check is overdue.

    Attributes
    ----------
    answering : EngineModel or None
        The model in force; None before the first retrain.
    version : int
        Number of the version in force, from 1; 0 before the first retrain.
    newest_version : int
        Largest number that a version ever had; after damage an earlier version may be in force.
    trained_on : TrainedOn
        Labels that the version in force was trained on.
    lacks_steps : bool
        Whether the training of the version in force made some of its steps and not all of them.
    corrected_to : int
        Number of the newest correction that the references have.
    overdue : set of str
        Decisions that the rule counts as wrong because their checks are overdue.
    overdue_to : int
        Number of the newest decision that was examined for an overdue check.
    """

    def __init__(
        self,
        template: EngineModel,
        window: TrainingWindow,
        outbox: Outbox,
        settings: SettingsInForce,
    ) -> None:
        self.template = template
        self.window = window
        self.outbox = outbox
        self.settings = settings
        self.answering: EngineModel | None = None
        self.version = 0
        self.newest_version = 0
        self.trained_on = TrainedOn()
        self.lacks_steps = False
        self.corrected_to = 0
        self.overdue: set[str] = set()
        self.overdue_to = 0

    @property
    def evidence(self) -> EvidenceWindow:
        """Which decisions the rule in force is updated with."""
        return self.settings.now.evidence

    @property
    def newest(self) -> EngineModel:
        """The model in force, or the template before the first retrain."""
        return self.answering or self.template

    @property
    def pinned(self) -> int:
        """Number of the earlier version that a rollback put in force again and pinned; 0: none."""
        return self.trained_on.pinned

    @property
    def next_version(self) -> int:
        """Number of the next version."""
        return self.newest_version + 1

    def resume(self, newest_version: int) -> None:
        """Restore the newest stored version and learn the outcomes that came after it.

        A version is a trained model with its references (embedded labelled traces, which it counts
        near a new trace) and its decision rule, which turns the bounds of a success probability
        into an action and is updated with the outcomes of parts. If the newest is damaged, the
        newest intact one before it is taken. The restored version decides from now on: it is in
        force. A model like umap-learn, of which not the fit but only the numbers of its traces are
        stored, is trained on these traces again; any other is restored bit for bit. Without a
        version, or if one of those traces is damaged or missing, no model is in force, and the rule
        of the untrained model is updated with the stored outcomes since the rule began.

        Labels that came after the version was stored become references; in a product (several robot
        cells that share labels) only the labels of this cell do. Corrections since then, which
        change or withdraw a label, are applied (`add_labels_since`). The rule is updated with the
        outcomes that it lacks. It is rebuilt from all outcomes if the stored rule cannot be
        continued (`RuleProgress.last_seq` is 0), for example because a label was corrected, a check
        is overdue (not reported within `label_within` decisions), or the version is from before the
        present rule, which a change of the policy began.

        The outcomes that update the rule, and the labels of a repeated training, are checked
        against the store's ledger (its hash chain). A difference sets `integrity_error` of the
        outbox, which records decisions and labels; after that every part is verified. A damaged
        trace is noted as an event in the store's log. An exception as the model is made ready, or
        as the rule or the references learn, is logged; after an exception of the rule every part is
        verified, too. The attributes `overdue` and `overdue_to` (which checks are overdue) and
        `corrected_to` (the newest correction that was applied) are restored.

        Parameters
        ----------
        newest_version : int
            Largest number that a version ever had.

        Raises
        ------
        StoreError
            If the store cannot be read, or this dengine cannot restore the model (in rare cases
            KeyError, ValueError or NotImplementedError).
        Exception
            What a model raises that must be trained again.
        """
        store = self.outbox.store
        settings = self.settings.now
        since = settings.evidence.since
        self.newest_version = newest_version
        version = store.versions.newest()
        model = None
        if version is not None:
            trained_on = TrainedOn.from_state(version.state)
            # A later version may be damaged: what an earlier one's rule learned under another
            # policy is left out.
            with suppress(ChangedTracesError):
                model = restore_model(
                    self.outbox,
                    self.template,
                    version,
                    trained_on,
                    with_rule=version.version >= since,
                )
        past = read_rule_progress(
            store,
            None if model is None else version,
            since,
            settings.recipe.policy.label_within,
            settings.policy_since,
        )
        self.overdue = set(past.overdue_ids)
        self.overdue_to = past.overdue_to
        if version is None or model is None:
            self._start_rule(self._read_outcomes(0))
            self.corrected_to = store.corrections.newest_number()
            return
        self.swap_in(model, version.version, trained_on)
        guarded(NOT_READY, model.prepare, self.template)
        self.corrected_to = add_labels_since(model, store, version, self.window.capacity)
        outcomes = self._read_outcomes(past.last_seq)
        if past.last_seq:
            self._update_rule(outcomes)
        else:
            self._start_rule(outcomes)

    def swap_in(self, model: EngineModel, version: int, trained_on: TrainedOn) -> None:
        """Put a model in force, as the version of this number; nothing is stored.

        In force means that it decides from now on. `trained_on` names the labels of its training.
        The attributes `answering` (the model in force), `version`, `newest_version` (unless it is
        larger already), `trained_on` and `lacks_steps` (whether the training made some of its
        optimiser steps, and not all) are set. The caller must hand the present decision rule over
        to the model (`EngineModel.prepare`), before or after this call.
        """
        self.answering = model
        self.version = version
        self.newest_version = max(version, self.newest_version)
        self.trained_on = trained_on
        report = model.report
        self.lacks_steps = report.n_steps > 0 and report.n_steps_left > 0

    def learn(
        self, stored: StoredDecision, success: bool, number: int, n_unreported: int | None
    ) -> NDArray[np.float32] | None:
        """Update the rule with an outcome, and make the trace a reference of the model in force.

        The decision rule turns the bounds of a success probability into an action. A reference is
        an embedded labelled trace, which the model in force (the model that decides now) counts
        near a new trace. `stored` is the decision with its trace, `success` the label (True: good),
        and `number` the label's number. `n_unreported` is the number of accepted parts without an
        outcome since the previous update. If it is None, or the decision is from before the present
        rule began (for example by a change of the policy), the rule is not updated. An exception of
        the rule or the model is logged; if the rule raised, it is stale, and every part is verified
        from then on. A baseline (a model that the user handed in) learns the trace in its own way.

        Returns the reference point, float32 of shape (d,), to be stored with the label; None if
        there is none: before the first retrain, after a failure, and for a baseline.
        """
        decision = stored.decision
        if n_unreported is not None and decision.model_version >= self.evidence.since:
            guarded(
                RULE_MISSED,
                self.newest.update_rule,
                decision.lower,
                decision.upper,
                success,
                decision.reason is Reason.NOVEL,
                n_unreported,
                ACTIONS.index(decision.predicted),
                decision.inclusion_probability,
            )
        model = self.answering
        if model is None:
            return None
        # An embedding that this very version computed for the decision is not computed again.
        point = guarded(
            NO_REFERENCE,
            model.add_reference,
            stored.trace,
            int(success),
            stored.content_hash,
            number,
            embedding=decision.embedding if decision.model_version == self.version else None,
        )
        return point if model.keeps_references else None

    def count_overdue(self, decision: Decision) -> None:
        """Update the decision rule as if a decision was wrong, because its check is overdue.

        A check is overdue if it was not reported within a number of later decisions, which the
        caller counts. If `lower`, the lower bound of the decision's success probability, is above
        0, the rule learns a failure; if `upper` is below 1, it learns a success; if both hold, it
        learns both (`overdue_outcomes`). The decision's id is then put into the set `overdue`. A
        failed update is logged, and the rule is stale then: every part is verified. A decision with
        the bounds 0 and 1, which say nothing, or from before the present rule began (for example by
        a change of the policy), changes nothing.
        """
        if decision.model_version < self.evidence.since:  # of an earlier policy, as in `learn`
            return
        outcomes = overdue_outcomes(decision)
        if outcomes:
            self.overdue.add(decision.id)
        self._update_rule(outcomes)

    def mark_examined_to(self, number: int) -> None:
        """Note that decisions up to this number, a larger one, were examined for overdue checks."""
        self.overdue_to = number

    def clear_overdue(self, decision_id: str) -> bool:
        """Stop counting a decision as overdue, because its check was reported.

        The decision leaves the set `overdue`. Returns whether it was in it. If True, the caller
        must have the rule rebuilt, because the rule has counted the decision as wrong.
        """
        was_overdue = decision_id in self.overdue
        self.overdue.discard(decision_id)
        return was_overdue

    def rebuild_rule(self) -> None:
        """Reset the rule, and update it with the stored outcomes of decisions since it began.

        The decision rule, which turns the bounds of a success probability into an action, is that
        of the model in force (the model that decides now), or of the untrained model before the
        first retrain. The outcomes are this cell's labels with their corrections
        (`LabelTable.outcomes_since`). Left out are labels that were withdrawn, labels of traces
        with a fault, and labels of rejected parts that somebody inspected. A check that is overdue
        (not reported in time) counts as a wrong decision. Labels that are not in the store yet are
        lost to the rule: store them before. The attribute `evidence` says since which model version
        decisions count (`since`), and in which safe mode the rule begins (`began_in`); in a safe
        mode every part is verified after an alarm, until new outcomes allow decisions. A rule that
        never learns is only reset.

        An update that fails here is logged and makes the rule stale: every part is then verified
        until the engine is opened again, or a change of the policy begins a new rule. A rule that
        was stale before stays so. The store's ledger (its hash chain) is not checked here. Raises
        StoreError, and changes nothing, if the store is unavailable.
        """
        outcomes = self.outbox.call_store(
            lambda: self.outbox.store.labels.outcomes_since(0, self.evidence.since, self.overdue_to)
        )
        self._start_rule(outcomes)

    def _start_rule(self, outcomes: Sequence[OutcomeRecord]) -> None:
        """Reset the rule, and update it with these outcomes (`_update_rule`).

        It starts in the safe mode that `evidence` names (`began_in`).
        """
        self.newest.reset_rule(self.evidence.began_in)
        self._update_rule(outcomes)

    def _update_rule(self, outcomes: Sequence[OutcomeRecord]) -> None:
        """Update the rule, if it can learn, with outcomes in the order of their labels.

        It is the rule of the model in force, or of the untrained model. An update that fails is
        logged, and the rule is stale then: every part is verified; the updates after it are made
        all the same.
        """
        if self.newest.rule_learns:
            for outcome in outcomes:
                guarded(RULE_MISSED, self.newest.update_rule, *outcome[1:])

    def _read_outcomes(self, after: int) -> list[OutcomeRecord]:
        """Return the stored outcomes of labels after this number, checked against the ledger.

        They are this cell's, of decisions since the present decision rule began, for example by a
        change of the policy (`LabelTable.outcomes_since` says which labels do not count). All
        overdue checks (not reported in time) are among them, as wrong decisions, whatever `after`
        is. The ledger is the store's hash chain. If the labels do not fit it,
        `outbox.integrity_error` is set, after which every part is verified; the outcomes are
        returned all the same. For a rule that never learns nothing is read or checked, and the list
        is empty. Raises StoreError if the store cannot be read.
        """
        if not self.newest.rule_learns:
            return []
        self.outbox.check_integrity(after)
        return self.outbox.store.labels.outcomes_since(after, self.evidence.since, self.overdue_to)

    def apply_corrections(self, corrections: Sequence[Correction]) -> bool:
        """Apply the store's newest corrections to the references of the model in force.

        References are the embedded labelled traces that the model in force (the model that decides
        now) counts near a new trace; a correction changes or withdraws a label. `corrections` must
        be all with a number above the attribute `corrected_to`, in their order. `corrected_to` is
        set to the number of the last correction that was applied, also if this raises; without any
        it stays. The decision rule, which learned from the labels, too, is not changed here, but by
        `rebuild_rule`.

        Returns True if every correction was applied, and before the first retrain. Returns False if
        the model must be trained again: always for a baseline (a model that the user handed in),
        and if the model cannot change a reference; the other references are changed all the same.
        The caller must retrain then, because each correction is applied only once. An error of the
        model as it takes a reference again is logged, and the result does not tell of it; if the
        trace is damaged, an event in the store's log says so. Raises StoreError if the store is
        unavailable; the corrections before the one that failed stay applied.
        """
        is_done = self.newest.keeps_references or self.answering is None
        for correction in corrections:
            if self.answering is not None:
                is_done &= apply_correction(self.answering, self.outbox.store, correction)
            self.corrected_to = correction.number
        return is_done

    def with_policy(
        self, policy: Policy, evidence: EvidenceWindow
    ) -> tuple[EngineModel, EngineModel | None]:
        """Return copies of the untrained model and the model in force, under another policy.

        A policy has the settings of the decision rule, which turns the bounds of a success
        probability into an action. The two copies have one rule, made by `policy`, which has
        learned nothing. `evidence` says from which version on decisions update the rule, and in
        which safe mode it starts; only the latter, `began_in`, is used here: 0 is none; in any
        other every part is verified until new outcomes allow decisions. The second copy is None
        before the first retrain; it shares the references (the embedded labelled traces) of the
        model in force, which decides now. If it cannot be made ready to predict, that is logged. A
        baseline (a model that the user handed in), which has no such rule, is returned itself.
        Neither copy is put in force. Raises what `Policy.rule` raises, such as SettingError if the
        rule cannot be made.
        """
        template = self.template.with_policy(policy)
        template.reset_rule(evidence.began_in)
        if self.answering is None:
            return template, None
        model = self.answering.with_policy(policy)
        guarded(NOT_READY, model.prepare, template)
        return template, model

    def change_template(self, template: EngineModel) -> None:
        """Go on with another untrained model, from which the first version is trained."""
        self.template = template

    def get_state(self, model: EngineModel, trained_on: TrainedOn) -> State:
        """Return the arrays by name with which the store can restore a model as a version.

        They hold the model with its references (labelled points) and its decision rule (of a
        baseline, a model that the user handed in, nothing), all fields of `trained_on` (which
        labels it was trained on), the number of the newest correction of a label that is applied,
        and the number of the newest decision that was examined for an overdue check (not reported
        in time). If the rule is stale, because it missed an update, the array `rule_is_stale` takes
        its place. If an overdue check counts, there is the array `includes_overdue`: an engine that
        opens the store then rebuilds the rule, and does not take the stored one. Some arrays are
        views.
        """
        state = (
            model.get_state()
            | trained_on.to_state()
            | {
                "corrected_to": np.array(self.corrected_to),
                "overdue_to": np.array(self.overdue_to),
            }
        )
        if self.overdue:
            # An engine that opens the store rebuilds the rule.
            state["includes_overdue"] = np.array(True)
        return state
