"""`Feedback` collects the outcomes of decided parts: it updates the decision rule and the
references with them, and turns them into stored labels. `engine.DataEngine` calls it for each
decision, `learner.Learner` for each report.

With `Policy(stops="all")` a bad part stops the system before the next decision, so the next
decision confirms an accepted part: the rule is updated, the trace becomes a reference, and its
label, CONFIRMED, is recorded. A line stop that comes later takes the confirmation back as a
correction. With "some" the part counts as unreported, which is no success.
"""

from collections import OrderedDict
from collections.abc import Callable
from enum import Enum

from ..errors import log
from ..records import Action, Source, source_of
from ..store.records import (
    LATE_STOP,
    SAFE_MODE_BEGAN,
    SAFE_MODE_ENDED,
    NewLabel,
    StoredDecision,
    already_reported,
)
from .live_model import LiveModel

# Called with the reason when a safe mode begins, and with "" when it ends.
SafeModeListener = Callable[[str], object] | None


class Remedy(Enum):
    """What must be done, once the store has every label, after a wrong label was learned."""

    REBUILD_RULE = "rebuild the rule"
    CORRECT = "apply the stored correction, and rebuild the rule"


class Feedback:
    """Takes in the outcomes of decided parts, in the thread that uses the engine.

    Parameters
    ----------
    live : LiveModel
        Learns from the labels, and its outbox takes them. Its window takes each label that is
        recorded; in a product, whose robot cells share labels, `fleet.Peers` reads them from the
        store instead. Its settings say whether an accepted part without a report is confirmed by
        the next decision, and since which version.
    on_safe_mode : callable or None
        Called with the reason when a safe mode begins and with "" when it ends, after that was
        recorded.

    Attributes
    ----------
    new_labels : int
        Labels since the last retrain began; each counts as soon as it is learned. In a product
        these are the cell's own, and those of peers that came after the version in force was
        trained, and before this cell put it in force or opened the store.
    remedy : Remedy or None
        What must be done after a wrong label was learned, as soon as the store has every label;
        `learner.Learner` does it.
    """

    def __init__(self, live: LiveModel, on_safe_mode: SafeModeListener) -> None:
        self._outbox = live.outbox
        self._live = live
        self._settings = live.settings
        self._on_safe_mode = on_safe_mode
        self.new_labels = 0
        self.remedy: Remedy | None = None
        # In a product: labels that the store has not numbered, by decision, with the provisional
        # numbers of their references.
        self._provisional: dict[str, int] = {}
        # Accepted parts without an outcome yet.
        self._unreported: OrderedDict[str, StoredDecision] = OrderedDict()
        # Reports that were learned and are not known to be on disk.
        self._unsynced: dict[str, bool] = {}
        # Decisions whose check was asked for, not reported and not overdue, oldest first.
        self._awaiting_check: OrderedDict[str, StoredDecision] = OrderedDict()
        # Accepted parts that went on without an outcome since the last label.
        self._n_unreported = 0
        self._safe_mode = ""

    @property
    def _stops_all(self) -> bool:
        """Whether the next decision confirms an unreported part, by `Policy(stops="all")`."""
        return self._settings.now.recipe.policy.stops == "all"

    def resume(self) -> None:
        """Restore checks without a report, and accepted parts without an outcome, from the store.

        The model in force and its decision rule must be restored before. Left out are overdue
        checks (without a report for `Policy.label_within` decisions or more), checks from before
        the present rule began, and accepted parts from before the present policy. With
        `stops="all"`, under which every bad accepted part is reported in time, the accepted parts
        are kept, so that the next trace confirms them as good. With "some" they are only counted,
        as unreported since the last label. A safe mode that the rule is in already (parts are
        verified until new outcomes are good) is not announced again, by no event and no call of the
        user's function `on_safe_mode`. Raises StoreError if the store cannot be read, or with
        `stops="all"` the trace of such a part is damaged.
        """
        self._safe_mode = self._live.newest.safe_mode
        store = self._outbox.store
        for stored in store.decisions.pending(self._settings.now.evidence.since):
            if stored.number > self._live.overdue_to:
                self._awaiting_check[stored.decision.id] = stored
        policy_since = self._settings.now.policy_since
        ids = store.decisions.unreported_accepts(policy_since)
        if not self._stops_all:
            self._n_unreported = len(ids) - store.labels.unreported_total(policy_since)
            return
        for id_ in ids:
            accepted = store.decisions.get(id_)
            if accepted is not None:
                self._unreported[id_] = accepted

    def record_decision(self, stored: StoredDecision) -> None:
        """Note a new decision: a VERIFY waits for its check, an ACCEPT for the outcome of the part.

        A VERIFY of a trace with a fault, like a NaN, is not noted, nor is a REJECT. The decision
        rule counts each check that has become overdue (no report within `Policy.label_within` later
        decisions) as a wrong decision (`_count_overdue`).
        """
        decision = stored.decision
        if decision.action is Action.VERIFY and not stored.quarantined:
            self._awaiting_check[decision.id] = stored
        self._count_overdue()
        if decision.action is Action.ACCEPT:
            self._unreported[decision.id] = stored

    def confirm_unreported(self) -> None:
        """Confirm or count the accepted parts without an outcome, because the next trace has come.

        With `Policy(stops="all")`, under which a bad part would have stopped the line, each part
        counts as good: the decision rule and the references (labelled points that new traces are
        compared with) learn it now, and its label, CONFIRMED, is recorded without waiting for the
        disk, counts as new, and enters the training window (the newest labelled traces); in a
        product (robot cells that share labels) it enters it later, from the store. An exception of
        rule or model is logged, not raised; after one of the rule every part is verified. A part
        from before the present rule began does not update the rule. With "some" the parts are only
        counted, and nothing is learned. Either way they wait for an outcome no longer.
        """
        while self._unreported:
            _, stored = self._unreported.popitem(last=False)
            if self._stops_all:
                self._learn_and_record(stored, True, Source.CONFIRMED)
            else:
                self._n_unreported += 1

    def take_in(self, stored: StoredDecision, success: bool) -> None:
        """Learn a reported label and record it, without waiting for the disk.

        `stored` is the decision with the label that it has so far, on disk or not, if any. If the
        same report comes again before its label is known to be on disk (`note_synced`), nothing is
        done. If the decision has a label already, ReportError is raised, with one exception: an
        accepted part that was confirmed as good, by a report or by the next decision
        (`Policy(stops="all")`), may be reported as bad, because it stopped the line. Such a line
        stop is recorded, and must be learned later, as a correction. The attribute `remedy` says
        so, and also if the decision rule must be rebuilt, because it had counted the check as
        overdue; neither is done here. An exception of rule or model is logged, not raised.

        A label that is learned counts as new and enters the training window (the newest labelled
        traces); in a product (robot cells that share labels and versions) it enters the window
        later, from the store. The label of a trace with a fault, like a NaN, is only recorded. The
        part waits for an outcome or a check no longer.
        """
        id_ = stored.decision.id
        if self._unsynced.get(id_) is not success:
            self._take_in_new(stored, success)
        self._unsynced[id_] = success

    def note_synced(self, decision_id: str) -> None:
        """Note that the label of this decision is on disk: another report is now an error.

        `take_in` must have taken it; else KeyError is raised.
        """
        del self._unsynced[decision_id]

    def _take_in_new(self, stored: StoredDecision, success: bool) -> None:
        """Learn a label that is no repetition of an earlier report, and record it.

        `stored` is the decision with the label that it has so far. If a report or the next decision
        had confirmed an accepted part as good (CONFIRMED), the report that it was bad and stopped
        the line is recorded but not learned yet, and `remedy`, which says what must be done later,
        is set to CORRECT: apply the correction, and rebuild the decision rule. It is set to
        REBUILD_RULE, unless it is set already, if the rule had counted the part's check as overdue
        (not reported in time), and so as wrong. Raises ReportError for any other report on a
        decision with a label; then nothing is changed.
        """
        decision = stored.decision
        source = source_of(decision, success)
        if stored.source is not None:
            earlier = (stored.success, stored.source)
            reported = (success, source)
            if (earlier, reported) != LATE_STOP:
                raise already_reported(decision.id, earlier, reported)
            self.remedy = Remedy.CORRECT
            self._outbox.record_labels(
                [(stored, NewLabel(decision.id, False, source, self._live.version, None))]
            )
            return
        self._learn_and_record(stored, success, source)
        self._unreported.pop(decision.id, None)
        self._awaiting_check.pop(decision.id, None)
        if self._live.clear_overdue(decision.id):
            self.remedy = self.remedy or Remedy.REBUILD_RULE

    def _learn_and_record(self, stored: StoredDecision, success: bool, source: Source) -> None:
        """Update decision rule and references with the outcome of a part, and record its label.

        References are labelled points that new traces are compared with. `source` says where the
        label comes from. A trace with a fault, like a NaN, updates neither. An exception of the
        model or the rule is logged and not raised; if the rule raised, it is stale (every part is
        then verified). The label of a rejected part that was inspected becomes a reference and does
        not update the rule: which parts are inspected is somebody's choice, and no sample. Every
        other label of a trace without a fault also tells the rule how many accepted parts went on
        unreported since the last label, and this count begins again at 0, even if the decision is
        from before the present rule began and so does not update it. A part that was counted among
        them is subtracted from the number that its own label tells, which may make it -1.

        The outbox, through which the engine writes to its store, gives the label its next number
        and records it. The label of a trace without a fault counts as new and enters the training
        window (the newest labelled traces); in a product (robot cells that share labels and
        versions) it is read into that from the store, later.
        """
        decision = stored.decision
        number = self._outbox.number_label()
        point = None
        n_unreported = None  # the rule is not updated
        if not stored.quarantined:  # an unusable trace teaches nothing
            if source is not Source.INSPECTION:
                # The part was counted itself if the next trace came before its outcome.
                was_counted = (
                    decision.action is Action.ACCEPT
                    and not self._stops_all
                    and decision.model_version >= self._settings.now.policy_since
                    and decision.id not in self._unreported
                )
                n_unreported = self._n_unreported - was_counted
                self._n_unreported = 0
            point = self._live.learn(stored, success, number, n_unreported)
        label = NewLabel(
            decision.id,
            success,
            source,
            self._live.version,
            point,
            n_unreported or 0,
            overdue_to=self._live.overdue_to,
            seq=number,
        )
        self._outbox.record_labels([(stored, label)])
        if stored.quarantined:
            return
        self.new_labels += 1
        if number > 0:
            self._live.window.add(stored.trace, int(success), stored.content_hash, number)
        else:
            self._provisional[decision.id] = number

    def number_labels(self) -> None:
        """In a product, give this cell's references the numbers that the store gave their labels.

        A product is several robot cells whose labels have one sequence of numbers in the store;
        references are labelled points that new traces are compared with. With or without a product,
        the decision rule first counts each overdue check (no report within `Policy.label_within`
        later decisions) as a wrong decision; if this fails, it is logged, and the rule is stale
        (every part is then verified). The store is not asked: the outbox, which records labels,
        keeps the numbers of those that it has written to the store, and gives each number once.
        Labels of traces with a fault, like a NaN, are passed over, and without a model in force no
        reference changes. Nothing is raised.
        """
        self._count_overdue()
        if not self._provisional:
            return
        for id_, number in self._outbox.pop_label_numbers():
            provisional = self._provisional.pop(id_, None)  # None: of a trace with a fault
            if provisional is not None and self._live.answering is not None:
                self._live.answering.renumber_reference(provisional, number)

    def count_new_labels(self, after: int) -> None:
        """Set `new_labels` to the number of labels in the training window that came after this one.

        `after` is the sequence number of a label; labels with a larger number count.
        """
        self.new_labels = self._live.window.count_newer(after)

    def give_labels_back(self, n_labels: int) -> None:
        """Count the labels of a dropped retrain as new again, so that the next one comes soon."""
        self.new_labels += n_labels

    def _count_overdue(self) -> None:
        """Update the decision rule as with a wrong decision for each check that became overdue.

        A check is overdue if `Policy.label_within` or more decisions followed, and it has no report
        yet. Each is examined once (`LiveModel.count_overdue`): its id goes to `LiveModel.overdue`,
        and it updates the rule as a failure if its lower bound is above 0, and as a success if its
        upper bound is below 1; so it may update it twice. The bounds are those of the success
        probability. A decision with the bound (0, 1), which says nothing, or from before the
        present rule began, is not counted. A failed update is logged, and the rule is stale (every
        part is then verified). `LiveModel.overdue_to` becomes the newest number that was examined;
        nothing changes if that is not larger than before.
        """
        overdue_to = self._outbox.n_decisions - self._settings.now.recipe.policy.label_within
        if overdue_to <= self._live.overdue_to:
            return
        pending = self._awaiting_check
        while pending and next(iter(pending.values())).number <= overdue_to:
            _, stored = pending.popitem(last=False)
            self._live.count_overdue(stored.decision)
        self._live.mark_examined_to(overdue_to)

    def begin_policy(self) -> None:
        """Drop the accepted parts that wait for an outcome, because another policy begins.

        The count of unreported parts begins again at 0. Pending checks stay.
        """
        self._unreported.clear()
        self._n_unreported = 0

    def announce_safe_mode(self, reason_ended: str = "fresh evidence keeps the tolerance") -> None:
        """Record and announce that a safe mode began or ended since the last call; else do nothing.

        In a safe mode, which begins after an alarm of the decision rule, parts are verified until
        new outcomes are good. An event (a row in the store's log) is recorded, then the user's
        function `on_safe_mode` is called. It gets the reason of a safe mode that began, or "" if it
        ended; then the event says `reason_ended` (in its default, the tolerance is the share of
        wrong decisions that the policy allows). If another alarm changes the reason of a safe mode,
        it is announced once more, as one that began. What changed and changed back between two
        calls is not announced. If the event cannot be recorded, the user's function is not called.
        This, like an exception of the function, is logged, and nothing is tried again. Callers do
        this only after labels are stored, so that such a failure costs no label.
        """
        safe_mode = self._live.newest.safe_mode
        if safe_mode == self._safe_mode:
            return
        self._safe_mode = safe_mode
        try:
            self._outbox.record_event(
                SAFE_MODE_BEGAN if safe_mode else SAFE_MODE_ENDED, safe_mode or reason_ended
            )
            if self._on_safe_mode is not None:
                self._on_safe_mode(safe_mode)
        except Exception:
            change = f"began: {safe_mode}" if safe_mode else "ended"
            log.exception("safe mode %s, and that could not be announced", change)
