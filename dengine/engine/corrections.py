"""`Corrections`: with it people correct a label, forget labels, go back to an earlier version and
release it, or set another policy. The methods of `DataEngine` that do this call it.

    engine.correct(decision.id, success=False, author="kim")
    engine.rollback(3)

Each change is an event that is kept for ever. Nothing is overwritten: a correction is a later row,
an earlier version is put in force again as a new version, and a decision stays as it was decided.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ..decision.members import SAFE_MODES
from ..decision.policy import Policy
from ..errors import ReportError, capitalized, expect, listed
from ..records import as_success, is_whole
from ..store.records import (
    LABEL_TEXTS,
    POLICY_CHANGED,
    Change,
    StoredDecision,
    nothing_to_correct,
    unknown_decision,
)
from ..traces import check_rate
from .learner import Learner
from .settings import BASELINE_SETTINGS, EvidenceWindow, refuse_idle

# Settings of a policy that make its rule, or that its evidence is measured by.
SCORING = ("alpha", "lower_bound", "interval", "guarantee", "stops", "prices")


@dataclass(frozen=True, slots=True)
class Changed:
    """What `correct`, `forget`, `rollback`, `release` or `set_policy` did.

    Attributes
    ----------
    kind : str
        "correct", "forget", "rollback", "release" or "policy".
    text : str
        A sentence for people.
    event : int or None
        Number of the recorded event; None if nothing changed, because all was so already.
    version : int
        Number of the version in force.
    """

    kind: str
    text: str
    event: int | None
    version: int


class Corrections:
    """Carries out corrections in the store and in what the engine has learned.

    Every method checks its arguments, and then finishes what is under way: it stores the labels
    that wait for the store, and reads what peers have stored. So it waits for the store, and raises
    StoreError if the store does not answer; `DataEngine` also raises it while another thread uses
    the engine. A training that is under way in an executor is discarded, and another one begins
    afterwards, except after a rollback. Nothing of this is done for a policy that is in force
    already. A change of labels and a rollback also check the store against its ledger; a difference
    sets the outbox's `integrity_error`, after which every part is verified.

    Parameters
    ----------
    learner : Learner
    """

    def __init__(self, learner: Learner) -> None:
        self._learner = learner
        self._live = learner.live
        self._store = learner.live.outbox.store

    def correct(self, decision_id: str, success: bool, author: str = "") -> Changed:
        """Correct a wrong label, or let a forgotten one count again, from the next decision on.

        The references (labelled points that new traces are compared with), the next retrain, the
        decision rule and the certificate (bounds on the wrong decisions) take the label as
        corrected. The trace keeps its fold (the group whose labels one of the cross-fitted encoders
        never sees), and the label as it was reported stays in the store. A baseline (a model that
        the user handed in), which cannot take a label back, is retrained before this returns; if it
        is pinned (put in force by `rollback`, so that no retrain replaces it), it is fitted again
        as a new version.

        First the labels that wait are stored, and what other cells of the product (robot cells that
        share labels and versions) stored is taken in. A training under way in the executor is
        discarded, and begins again, even if nothing changes; one that is done is put in force or
        dropped. If the label changes, the store is checked against its ledger (its hash chain);
        after a difference every part is verified. If a safe mode (after an alarm, parts are
        verified until new outcomes are good) begins or ends by the change, an event (a row in the
        store's log) is recorded, and `on_safe_mode`, the user's function, is called. Without an
        executor the call also waits until the features for the next training are computed, if that
        starts from another model because labels were forgotten (withdrawn).

        Parameters
        ----------
        decision_id : str
        success : bool
            The right label. If this label counts already, nothing changes.
        author : str
            Who says so, for the event.

        Returns
        -------
        Changed
            Its `event` is None if nothing changed.

        Raises
        ------
        ReportError
            For an unknown decision, for a decision without a label, and for a `success` that is no
            label.
        StoreError
            If the store does not answer, the decision's trace is damaged, another cell of the
            product stores a version meanwhile and a pinned baseline is to be fitted again, or the
            engine is closed, was opened for reading or before a fork. A change that was stored
            before the error stays stored.
        Exception
            What a baseline raises as it is copied for a retrain or, if it is pinned, fitted again;
            the change is stored then.
        """
        label = as_success(success)
        (stored,) = self._find_labelled([decision_id])
        id_ = stored.decision.id
        if stored.success is label:
            return self._as_unchanged(
                "correct", f"Decision {id_} counts as a {LABEL_TEXTS[label]} already"
            )
        before = "forgotten" if stored.success is None else f"a {LABEL_TEXTS[stored.success]}"
        text = f"decision {id_} counts as a {LABEL_TEXTS[label]}, was {before}"
        return self._change_labels(
            Change(
                "correct",
                text,
                {"decisions": {id_: {"was": stored.success, "now": label}}},
                author,
                (id_,),
                label,
            )
        )

    def forget(self, *decision_ids: str, author: str = "", reason: str = "") -> Changed:
        """Leave labels out of all that is learned and counted, from the next decision on.

        `correct` brings a forgotten label back. Traces, and labels as they were reported, stay in
        the store, and so do the versions that were trained with them. The version in force goes on,
        without references (labelled points) from these labels, until the next retrain, which starts
        from weights that never saw them. If a rollback pinned this version (so that no retrain
        replaces it), and it was trained with one of these labels, or one is older than all labels
        of its training (an earlier version may have learned it), it is released: it is stored as a
        new version, which retrains may replace, before the labels are forgotten. A baseline (a
        model that the user handed in) is retrained before this returns; if it stays pinned, it is
        fitted again as a new version.

        First the labels that wait are stored, and what other cells of the product (robot cells that
        share labels and versions) stored is taken in. A training under way in the executor is
        discarded, and begins again, even if nothing changes; one that is done is put in force or
        dropped. If labels change, the store is checked against its ledger (its hash chain); after a
        difference every part is verified. If a safe mode (after an alarm, parts are verified until
        new outcomes are good) begins or ends by the change, an event (a row in the store's log) is
        recorded, and `on_safe_mode`, the user's function, is called. Without an executor the call
        also waits until the features for the next training are computed, if that starts from
        another model now.

        A guarantee assumes that the choice of what is forgotten does not depend on the label. The
        certificate (bounds on the wrong decisions) counts a forgotten outcome of a part that the
        model would accept or reject as wrong, so that forgetting earns nothing.

        Parameters
        ----------
        *decision_ids : str
            Labels that are forgotten already stay as they are.
        author, reason : str
            Who forgets them, and why, for the event.

        Returns
        -------
        Changed
            Its `event` is None if nothing changed.

        Raises
        ------
        ReportError
            For an unknown decision, for a decision without a label, and if no id is given; then no
            label is forgotten.
        StoreError
            If the store does not answer, the trace of a decision is damaged, another cell of the
            product stores a version meanwhile and a pinned one is to be released or fitted again,
            or the engine is closed, was opened for reading or before a fork. A change that was
            stored before the error stays stored.
        Exception
            What a baseline raises as it is copied for a retrain or, if it is pinned, fitted again;
            the change is stored then.
        """
        if not decision_ids:
            raise ReportError(
                "Expected the ids of decisions to forget, got none; name at least one."
            )
        decisions = self._find_labelled(dict.fromkeys(decision_ids))
        forgotten = [stored for stored in decisions if stored.success is not None]
        labels = {stored.decision.id: stored.success for stored in forgotten}
        if not labels:
            return self._as_unchanged(
                "forget",
                f"{_labels_are([stored.decision.id for stored in decisions])} forgotten already",
            )
        text = f"{_labels_are(list(labels))} forgotten" + (f": {reason}" if reason else "")
        data = {
            "decisions": {id_: {"was": label, "now": None} for id_, label in labels.items()},
            "reason": reason,
        }
        live = self._live
        if live.pinned and any(
            live.trained_on.has_seen(stored.label_seq or 0) for stored in forgotten
        ):
            text += f"; version {live.version}, which learned from this, is pinned no more"
            self._learner.release(author)
        return self._change_labels(Change("forget", text, data, author, tuple(labels)))

    def release(self, author: str = "") -> Changed:
        """Let retrains replace again the version that `rollback` pinned (kept in force).

        First a trained version is put in force or dropped, labels are stored, and what other cells
        of the product (robot cells that share labels and versions) stored is taken in; a training
        under way in the executor is discarded, and begins again. If no version is pinned, nothing
        more happens. Otherwise the same model goes on, stored as a new version. Labels that came
        while it was pinned count for the next retrain, which may be due at once. If a safe mode
        (after an alarm, parts are verified until new outcomes are good) began or ended meanwhile,
        an event (a row in the store's log) is recorded, and `on_safe_mode`, the user's function, is
        called.

        Parameters
        ----------
        author : str
            For the record.

        Returns
        -------
        Changed
            Its `event` is None if no version was pinned.

        Raises
        ------
        StoreError
            If the store does not answer, another cell of the product stores a version meanwhile, or
            the engine is closed, was opened for reading or before a fork. A change that was stored
            before the error stays stored.
        """
        self._learner.bring_up_to_date()
        if not self._live.pinned:
            return self._as_unchanged("release", "No version is pinned")
        return self._finish_change(self._learner.release(author))

    def rollback(self, version: int, author: str = "") -> Changed:
        """Put an earlier version in force again, as a new version with a new number, and pin it.

        Its references (labelled points that new traces are compared with) include the labels that
        came since, up to the size of the training window (the newest labelled traces), with all
        corrections. The decision rule in force goes on. While the version is pinned, new labels are
        stored and counted and become its references, but no automatic retrain replaces it. It stays
        pinned until `release`, a retrain that somebody asks for, or `forget` of a label that it was
        trained with or that is older than all of these; the next retrain then starts from this
        version, unless it saw a forgotten label.

        First the labels that wait are stored, and what other cells of the product (robot cells that
        share labels and versions) stored is taken in. A training under way in the executor is
        discarded, even if nothing changes, and no other one begins, unless this raises; a training
        that is done is put in force or dropped first. If something changes, the store is checked
        against its ledger (its hash chain); after a difference every part is verified. If a safe
        mode (after an alarm, parts are verified until new outcomes are good) began or ended
        meanwhile, an event (a row in the store's log) is recorded, and `on_safe_mode`, the user's
        function, is called. Without an executor the call also waits until the features for the next
        training are computed, if that starts from another model.

        A reducer like umap-learn, of which not the fit but only the numbers of its traces are
        stored, is fitted again on the traces of the earlier version, with the labels that they had
        then. A baseline (a model that the user handed in) is fitted on the same traces, with the
        labels as they count now.

        Parameters
        ----------
        version : int
            Number of the earlier version. If it is the version in force, this is stored as a new
            version, too, and pinned. If a version is pinned, and this is its number or the number
            that it had before, nothing changes.
        author : str
            For the record.

        Returns
        -------
        Changed
            Its `event` is None if nothing changed.

        Raises
        ------
        SettingError
            If `version` is no whole number.
        StoreError
            If the version is not kept (the message names those that are), if traces that it must be
            fitted on are damaged, if this dengine cannot restore it, if the store does not answer,
            if another cell of the product stores a version meanwhile, or if the engine is closed,
            was opened for reading or before a fork.
        Exception
            What a model that must be fitted again raises; for the stored arrays of another reducer
            in rare cases KeyError, ValueError or NotImplementedError.
        """
        expect(
            is_whole(version, -(2**63), 2**63 - 1),
            "the number of a version",
            version,
            "`store.versions.retrains()` lists them",
        )
        self._learner.bring_up_to_date()
        before = self._live.version
        pinned = self._live.pinned
        if pinned and version in (before, pinned):
            return self._as_unchanged("rollback", f"Version {version} is pinned already")
        new = self._live.next_version
        text = f"version {version} answers again, as version {new} after {before}, and is pinned"
        event = Change("rollback", text, {"to": int(version), "was": before, "now": new}, author)
        self._learner.roll_back(int(version), event)
        return self._finish_change(event)

    def set_policy(self, policy: Policy, author: str = "") -> Changed:
        """Decide by another policy from the next decision on.

        The policy is stored. A trained model goes on under it as a new version, with a new number;
        before the first training no version is made. Earlier decisions keep their bounds. First the
        labels that wait are stored, and what other cells of the product (robot cells that share
        labels and versions) stored is taken in. A training under way in the executor is discarded,
        and begins again; one that is done is put in force or dropped.

        The decision rule turns bounds into actions, and may learn from outcomes. It starts anew if
        the policy's alpha, lower_bound, interval, guarantee, stops or prices change. Under the
        guarantees "pooled" and "cost", and a user's subclasses of their rules, with stops="some" it
        also starts anew if the audit rate (the share of certain decisions, accepts and rejects,
        that are checked all the same) changes. A new rule is updated only with decisions from now
        on, because a tolerance that was chosen after the data was seen cannot be tested on that
        data, and old bounds have another scale.
        `certificate`, which bounds the probabilities that an accept or a reject is wrong, counts
        the decisions since the last change of the policy, whatever changed. If somebody chooses the
        best of the certificates of m policies, the error probability of that certificate is up to
        m alpha.

        A model that the user handed in keeps its own rule, whatever changes.

        A safe mode (after an alarm, parts are verified until new outcomes are good) goes on, but
        ends now if the new rule has none. If it ends so, or if a safe mode began or ended
        meanwhile, an event (a row in the store's log) is recorded, and `on_safe_mode`, the user's
        function, is called. With stops="all" (every bad accepted part is reported before the next
        decision) a decision confirms the accepted parts before it as good; but parts that were
        accepted before the change are not confirmed, and their outcomes can still be reported. With
        `Policy(shadow=True)`, the shadow mode, every part is verified, as an audit if the model
        would accept or reject it: `Decision.predicted` says what the model would have done, and all
        outcomes are learned from as always. The shadow mode stays on when the engine is opened
        again.

        Parameters
        ----------
        policy : Policy
            The whole policy. If it equals the policy in force, nothing changes, and nothing is
            waited for or discarded.
        author : str
            For the record.

        Returns
        -------
        Changed
            Its `event` is None if nothing changed.

        Raises
        ------
        SettingError
            If `policy` is no Policy. If its force limits (an operator's limits of the signal) do
            not fit the traces, or are in seconds while the rate of the traces is unknown. If the
            class of its guarantee cannot be imported or made. If a model was handed in, and a
            setting changes other than audit_rate, stops, label_within, force_limits and shadow. If
            the recipe (the stored settings) of another cell of the product cannot be read.
        StoreError
            If the store does not answer, another cell of the product stores a version meanwhile, or
            the engine is closed, was opened for reading or before a fork.
        Exception
            What the constructor of a user's rule raises, except TypeError.
        """
        expect(
            isinstance(policy, Policy),
            "a Policy",
            policy,
            "for example Policy(alpha=0.05, lower_bound=0.95)",
        )
        live = self._live
        present = live.settings.now
        check_rate(policy.force_limits, present.trace)
        old_policy = present.recipe.policy
        old_values = old_policy.to_values()
        new_values = policy.to_values()
        changes = {name: value for name, value in new_values.items() if value != old_values[name]}
        if not changes:
            return self._as_unchanged("policy", "The policy is in force already")
        is_baseline = present.model is not None  # it keeps its rule
        if is_baseline:
            refuse_idle(sorted(changes.keys() - BASELINE_SETTINGS))
        self._learner.bring_up_to_date()
        starts_anew = not is_baseline and (
            changes.keys() & SCORING
            # Audits count by the inclusion probability, so pooled evidence must be of one rate.
            or policy.rule().extra_arguments != old_policy.rule().extra_arguments
        )
        since = live.next_version
        evidence = present.evidence
        if starts_anew:
            evidence = EvidenceWindow(since, SAFE_MODES.index(live.newest.safe_mode))
        settings = replace(
            present,
            recipe=replace(present.recipe, policy=policy),
            policy_since=since,
            evidence=evidence,
        )
        steps = [f"{name} {old_values[name]} -> {value}" for name, value in changes.items()]
        event = Change(
            POLICY_CHANGED,
            f"the policy's {', '.join(steps)}",
            {"old": old_values, "new": new_values},
            author,
            settings=settings.to_store(),
        )
        self._learner.set_policy(policy if starts_anew else None, evidence, event)
        live.settings.change(settings)
        self._learner.feedback.begin_policy()
        return self._finish_change(
            event, reason_ended="the rule of the new policy has no safe mode"
        )

    def _find_labelled(self, decision_ids: Iterable[Any]) -> list[StoredDecision]:
        """Finish what is under way, then return the decisions with these ids.

        A trained version is put in force or dropped, and a training that is not done is discarded
        and begins again later; labels that wait are stored, and what other robot cells stored is
        taken in. The decisions are in the order of the ids. `success` of a decision is None if its
        label was forgotten (withdrawn). Raises ReportError for an unknown id, and for a decision
        that never had a label. Raises StoreError if the engine is closed, only reads or was opened
        before a fork, if the store does not answer, and if a trace is damaged.
        """
        self._learner.bring_up_to_date()
        decisions = []
        for id_ in decision_ids:
            stored = self._store.decisions.get(id_) if isinstance(id_, str) else None
            if stored is None:
                raise unknown_decision(id_)
            if stored.source is None:
                raise nothing_to_correct(id_)
            decisions.append(stored)
        return decisions

    def _change_labels(self, change: Change) -> Changed:
        """Store a change of labels, and apply it to all that was learned; return what was done.

        It is applied to the references (labelled points that new traces are compared with), the
        training window (the newest labelled traces) and the decision rule. The outbox, which
        records decisions, drops the changed ones from its memory, and will read them from the
        store. A model that cannot change its references is retrained, in this thread, or, if it is
        pinned (kept in force by a rollback), fitted again as a new version. The store is checked
        against its ledger (its hash chain); a difference sets the outbox's `integrity_error`, after
        which every part is verified. If a safe mode (after an alarm, parts are verified until new
        outcomes are good) begins or ends by this, an event (a row in the store's log) is recorded,
        and `on_safe_mode`, the user's function, is called.

        Raises StoreError if the store does not answer, or if another robot cell that shares the
        model stores a version while a pinned model is fitted again, and what a model raises as it
        is copied for a retrain or, if it is pinned, fitted again; a change that is stored by then
        is applied with the next one, or when the store is opened again.
        """
        number = self._store.corrections.apply(change)
        for id_ in change.decisions:
            self._live.outbox.evict_decision(id_)
        self._learner.apply_corrections()  # which may add an event: a model is trained anew
        return self._finish_change(change, number)

    def _finish_change(
        self,
        change: Change,
        number: int | None = None,
        reason_ended: str = "the corrected outcomes keep the tolerance",
    ) -> Changed:
        """Return what a stored change did; also announce a safe mode that it began or ended.

        A safe mode is a time after an alarm in which parts are verified until new outcomes are
        good. `number` is that of the change's event, its row in the store's log; None means that it
        is the newest event there. The announcement is another event and a call of `on_safe_mode`,
        the user's function; if it fails, that is logged. `reason_ended` is the reason that is
        recorded if a safe mode ended. Raises StoreError if the store must be asked for the number
        and does not answer.
        """
        if number is None:
            number = self._store.events.newest(1)[0].number
        self._learner.feedback.announce_safe_mode(reason_ended)
        return Changed(change.kind, capitalized(f"{change.text}."), number, self._live.version)

    def _as_unchanged(self, kind: str, text: str) -> Changed:
        """Return a `Changed` for a request that was fulfilled already; no event is recorded."""
        return Changed(kind, capitalized(f"{text}; nothing changed."), None, self._live.version)


def _labels_are(ids: Sequence[str]) -> str:
    """Return the beginning of a sentence on the labels of these decisions, up to its verb."""
    return f"the labels of {listed(ids)} are" if len(ids) > 1 else f"the label of {ids[0]} is"
