"""What becomes of parts: labels on their way to the store, the rule, the references and the next retrain.

With `Policy(stops="all")` a bad part stops the system before the next decision, so that one confirms an accepted part: the
rule is told, the trace becomes a reference, and its label, CONFIRMED, is stored with the next report, before the next
retrain, or when 100 wait. A stop that comes later takes that back, in the store as a correction. With "some" it is counted
as unobserved, which is no success.
"""

import logging
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress

from ..errors import StoreError
from ..records import Action, Reason, Source, source_of
from ..store.outbox import Outbox
from ..store.records import LATE_STOP, SAFE_MODE_BEGAN, SAFE_MODE_ENDED, NewLabel, StoredDecision, already_reported
from .settings import SettingsInForce
from .versions import ModelVersions

log = logging.getLogger("dengine")
RECENT = 50  # decisions that the share of novel ones fades over
NEARLY_ALL = 0.8  # of them, and somebody should look
ALL_NOVEL = "nearly every trace is novel: the sensor or the parts have changed, or parts come twice without numbers (part=)"


class Feedback:
    """Takes in what became of decided parts.

    settings : whether silence until the next decision confirms an accepted part, and since which version.
    on_safe_mode : called with the reason, "" where it ends, when the safe mode begins or ends; it is recorded before.
    """

    def __init__(
        self,
        outbox: Outbox,
        versions: ModelVersions,
        settings: SettingsInForce,
        on_safe_mode: Callable[[str], object] | None = None,
    ) -> None:
        self.outbox, self.versions, self.settings = outbox, versions, settings
        self.on_safe_mode = on_safe_mode
        self._went_on: OrderedDict[str, StoredDecision] = OrderedDict()  # accepted, nothing heard of them yet
        self._waiting: dict[str, tuple[StoredDecision, NewLabel]] = {}  # confirmed, not on their way into the store
        self._unsynced: dict[str, bool] = {}  # learned, and not known to be on the disk
        # Decisions that asked for a check of which nothing was reported and which is not overdue, oldest first.
        self._owed: OrderedDict[str, StoredDecision] = OrderedDict()
        self._unobserved = 0
        self._mode = ""
        self.remedy: Callable[[], None] | None = None  # where what the rule was told, or what is stored, did not happen
        self._novel, self._told_novel = 0.0, False  # share of the recent decisions, and whether that it is large was told
        versions.store_waiting = self.store_all
        versions.journal_cleared = self.journal_cleared

    @property
    def _stops_all(self) -> bool:
        return self.settings.now.recipe.policy.stops == "all"

    def resume(self) -> None:
        """Go on from the store: what was accepted and not reported."""
        self._mode = self.versions.newest.safe_mode
        store = self.outbox.store
        for owed in store.pending_decisions(self.settings.now.evidence.since):
            if owed.number > self.versions.overdue_to:
                self._owed[owed.decision.id] = owed
        ids = store.unreported_accepts(self.settings.now.policy_since)
        if not self._stops_all:
            self._unobserved = len(ids) - store.silent_total(self.settings.now.policy_since)
            return
        for id_ in ids:
            known = store.get_decision(id_)
            if known is not None:
                self._went_on[id_] = known

    def settle(self) -> None:
        """The next trace comes: accepted parts of which nothing was heard went on."""
        self.arrive()
        if not self._went_on:
            return
        while self._went_on:
            _, known = self._went_on.popitem(last=False)
            if self._stops_all:
                self._waiting[known.decision.id] = known, self._learn(known, True, Source.CONFIRMED)
            else:
                self._unobserved += 1
        if len(self._waiting) >= 100:  # so many confirmed parts wait for a report
            self.store_waiting()

    def _count_overdue(self) -> None:
        """A check that was not reported in time counts as a wrong decision."""
        overdue_to = self.outbox.n_decisions - self.settings.now.recipe.policy.label_within
        while self._owed and next(iter(self._owed.values())).number <= overdue_to:
            self.versions.owe(self._owed.popitem(last=False)[1].decision)
        self.versions.overdue_to = max(overdue_to, self.versions.overdue_to)

    def decided(self, known: StoredDecision) -> None:
        """A part was decided on."""
        if known.decision.action is Action.VERIFY and not known.quarantined and known.number:
            self._owed[known.decision.id] = known
        self._count_overdue()
        if known.decision.action is Action.ACCEPT:
            self._went_on[known.decision.id] = known
        self._novel += ((known.decision.reason is Reason.NOVEL) - self._novel) / RECENT
        if self._novel > NEARLY_ALL and not self._told_novel:
            self.outbox.record_event("novelty", ALL_NOVEL)
        self._told_novel = self._novel > (0.5 if self._told_novel else NEARLY_ALL)

    def report(self, known: StoredDecision, success: bool) -> None:
        """Take in a report, and return once it is on the disk; NotTakenError where it is not."""
        id_, untrue = known.decision.id, False
        self.arrive()
        if self._unsynced.get(id_) is not success:  # else it is said again, and learned already
            untrue = self._take_in(known, success)
        self._unsynced[id_] = success
        self.outbox.sync()
        del self._unsynced[id_]
        if untrue:
            with suppress(StoreError):  # then it is put right when the store is back
                self.outbox.drain()
        self.arrive()
        self.announce()

    def _take_in(self, known: StoredDecision, success: bool) -> bool:
        """Learn a label, which goes into the journal; whether the part was taken for confirmed until now, and was not."""
        made = known.decision
        source = source_of(made.action, made.audit, success)
        if known.source is not None:
            stands, now = (bool(known.success), known.source), (success, source)
            if (stands, now) != LATE_STOP:
                raise already_reported(made.id, stands, now)
            self.store_waiting()
            self.remedy = self.versions.take_back
            self.outbox.record_labels([(known, NewLabel(made.id, False, source, self.versions.version, None))])
            return True
        untrue = self._waiting.pop(made.id, None) is not None
        self.store_waiting()
        if untrue:
            self.versions.unlearn(known)
        label = self._learn(known, success, source)
        self.outbox.record_labels([(known, label)])
        self._went_on.pop(made.id, None)
        self._owed.pop(made.id, None)
        if untrue or made.id in self.versions.overdue:
            self.versions.overdue.discard(made.id)
            self.remedy = self.remedy or self.versions.tell_anew
        return untrue

    def arrive(self) -> None:
        """Do what had to wait for the store: labels that it has numbered train, and the rule is told the truth."""
        self._count_overdue()
        for id_, seq in self.outbox.pop_label_numbers():
            self.versions.keep(id_, seq)
        if self.remedy and self.outbox.is_drained and not self.outbox.fault:
            if self._waiting:  # else the rule would forget them
                self.store_waiting()
            else:
                self._put_right(self.remedy)

    def _put_right(self, remedy: Callable[[], None]) -> None:
        """Tell the rule the truth, and let references and the next retrain know of what was taken back."""
        self.remedy = None
        try:
            remedy()
        except StoreError:
            self.remedy = remedy
            log.exception("the rule is told anew when the store is back")

    def store_waiting(self) -> None:
        """Put the labels of confirmed parts into the journal, without waiting."""
        if self._waiting:
            self.outbox.record_labels(self._waiting.values())
            self._waiting.clear()
            self.arrive()

    def store_all(self) -> None:
        """Have every label in the store, and its number; StoreError where the store is away."""
        self.store_waiting()
        self.journal_cleared()

    def journal_cleared(self) -> None:
        """The same for what is in the journal: of a product's news one may be that very label."""
        if self.outbox.request_label_drain():
            self.outbox.drain()
        self.arrive()

    def _learn(self, known: StoredDecision, success: bool, source: Source) -> NewLabel:
        """Tell rule and references what became of a part; returns its label.

        The rule is not told of a rejected part: which of them come back is somebody's choice, and no sample.
        """
        made, version, point, silent = known.decision, self.versions.version, None, 0
        if source is Source.INSPECTION:
            if not known.quarantined:
                point = self.versions.learn(known, success, None)
        elif not known.quarantined:
            counted = made.action is Action.ACCEPT and made.id not in self._went_on and not self._stops_all
            # It was counted among the unobserved before its label came.
            silent = self._unobserved - (counted and made.model_version >= self.settings.now.policy_since)
            self._unobserved = 0
            point = self.versions.learn(known, success, silent)
        return NewLabel(made.id, success, source, version, point, silent, overdue_to=self.versions.overdue_to)

    def begin_policy(self) -> None:
        """Go on under another policy. What was accepted under the last one and not heard of stays unheard of."""
        self._went_on.clear()
        self._unobserved = 0

    def announce(self, safe_again: str = "fresh evidence keeps the tolerance") -> None:
        """Record that safe mode began or ended, and tell; last of all, for either may fail and must cost no label."""
        now = self.versions.newest.safe_mode
        if now == self._mode:
            return
        self._mode = now
        try:
            self.outbox.record_event(SAFE_MODE_BEGAN if now else SAFE_MODE_ENDED, now or safe_again)
            if self.on_safe_mode is not None:
                self.on_safe_mode(now)
        except Exception:
            log.exception("safe mode %s, and that could not be told", f"began: {now}" if now else "ended")
