"""What becomes of parts: labels on their way to the store, the rule, the references and the next retrain.

With `Policy(stops="all")` a bad part stops the system before the next decision, so that one confirms an accepted part: the
rule is told, the trace becomes a reference, and its label, CONFIRMED, is stored with the next report, before the next
retrain, or when 100 wait. A stop that comes later takes that back, in the store as a correction. With "some" it is counted
as unobserved, which is no success.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress

from ..errors import StoreError
from ..records import Action, Decision, Reason, Source, source_of
from ..store.outbox import Outbox
from ..store.records import SAFE_MODE_BEGAN, SAFE_MODE_ENDED, NewLabel, StoredDecision, already_reported
from .settings import SettingsInForce
from .versions import ModelVersions, Point

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
        self._went_on: dict[str, StoredDecision] = {}  # accepted, nothing heard of them yet
        self._waiting: list[tuple[StoredDecision, NewLabel]] = []  # confirmed, not stored
        self._numberless: dict[str, tuple[StoredDecision, bool]] = {}  # learned, and not numbered by the store yet
        self._doubtful: dict[str, tuple[StoredDecision, NewLabel, Point | None]] = {}  # not known to be taken
        self._arrived_late: dict[str, bool] = {}  # of those, which were
        # Decisions that asked for a check of which nothing was reported, each behind its number.
        self._owed: dict[str, tuple[int, Decision]] = {}
        self._decisions = 0
        self._unobserved = 0
        self._mode = ""
        self._untrue = False  # whether the rule was told what did not happen
        self._taken_back = False  # whether a confirmation that was stored did not happen
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
        for owing, since in store.owed(self.settings.now.evidence.since):
            self._owed[owing.decision.id] = -since, owing.decision
        self._count_overdue()
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
        self._count_overdue()
        if not self._went_on:
            return
        while self._went_on:
            known = self._went_on.pop(next(iter(self._went_on)))
            if self._stops_all:
                label, point = self._label(known, True, Source.CONFIRMED)
                self._learn(known, label, point)
                self._waiting.append((known, label))
            else:
                self._unobserved += 1
        if len(self._waiting) >= 100:  # so many confirmed parts wait for a report
            self.store_waiting(secure=False)
        self.announce()

    def _count_overdue(self) -> None:
        """A check that was not reported in time counts as a wrong decision."""
        latest = self._decisions - self.settings.now.recipe.policy.label_within
        while self._owed and next(iter(self._owed.values()))[0] <= latest:
            self.versions.owe(self._owed.pop(next(iter(self._owed)))[1])

    def decided(self, known: StoredDecision) -> None:
        """A part was decided on."""
        self._decisions += 1
        if known.decision.action is Action.VERIFY and not known.quarantined:
            self._owed[known.decision.id] = self._decisions, known.decision
        if known.decision.action is Action.ACCEPT:
            self._went_on[known.decision.id] = known
        self._novel += ((known.decision.reason is Reason.NOVEL) - self._novel) / RECENT
        if self._novel > NEARLY_ALL and not self._told_novel:
            self.outbox.event("novelty", ALL_NOVEL)
        self._told_novel = self._novel > (0.5 if self._told_novel else NEARLY_ALL)

    def report(self, known: StoredDecision, success: bool) -> None:
        """Take in a report; it is in the journal before anything else changes."""
        id_ = known.decision.id
        confirmed = known.source is Source.CONFIRMED or id_ in self._numberless
        self.arrive()
        if self._arrived_late.get(id_) is success:
            return
        source = source_of(id_, known.decision.action, known.decision.audit, success)
        if confirmed and source is Source.STOP:
            self._take_back(known)
            return
        late = [each for each in self._waiting if each[0].decision.id == id_]  # it was taken for confirmed
        self._waiting = [each for each in self._waiting if each[0].decision.id != id_]
        label: NewLabel | None = None
        try:
            self.store_waiting()
            if id_ in self._doubtful:
                known, label, point = self._doubtful[id_]
                if label.success is not success:
                    raise already_reported(id_, (label.success, label.source), (success, source))
            else:
                label, point = self._label(known, success, source, int(self._was_unobserved(known)))
            self.outbox.labels([(known, label)])
        except Exception as error:
            self._waiting += late  # it still waits as it did
            if label is not None and isinstance(error, StoreError):
                self._doubtful[id_], self._unobserved = (known, label, point), 0
            raise
        self._doubtful.pop(id_, None)
        self._take_in(known, label, point, bool(late))
        if late:
            with suppress(StoreError):  # then it is told anew when the store is back
                self.outbox.drain()
        self.arrive()
        self.announce()

    def _take_back(self, known: StoredDecision) -> None:
        """A part stopped the system after its confirmation went into the journal: what that taught is put right."""
        label = NewLabel(known.decision.id, False, Source.STOP, self.versions.version, None)
        self.store_waiting()
        self._taken_back = True  # even where it is not known to be taken
        self.outbox.labels([(known, label)])
        with suppress(StoreError):  # then it is put right when the store is back
            self.outbox.drain()
        self.arrive()
        self.announce()

    def _take_in(self, known: StoredDecision, label: NewLabel, point: Point | None, untrue: bool) -> None:
        """Learn what is in the journal."""
        self._went_on.pop(known.decision.id, None)
        self._owed.pop(known.decision.id, None)
        self._untrue |= self.versions.overdue.pop(known.decision.id, None) is not None
        if known.quarantined:
            return
        if untrue:
            self.versions.unlearn(known)
        self._learn(known, label, point)
        self._numberless[known.decision.id] = known, label.success
        self._untrue |= untrue

    def arrive(self) -> None:
        """Do what had to wait for the store: labels that it has numbered train, and the rule is told the truth."""
        for id_, seq in self.outbox.arrived():
            if id_ in self._doubtful:  # it was taken after all, among later ones
                known, label, point = self._doubtful.pop(id_)
                self._take_in(known, label, point, False)
                self._arrived_late[id_], self._untrue = label.success, True
            if id_ in self._numberless:
                self.versions.keep(*self._numberless.pop(id_), seq)
        if (self._untrue or self._taken_back) and self.outbox.drained and not self.outbox.fault:
            if self._waiting:  # else the rule would forget them
                self.store_waiting(secure=False)
            else:
                self._put_right()

    def _put_right(self) -> None:
        """Tell the rule the truth, and let references and the next retrain know of what was taken back."""
        untrue, taken_back, self._untrue, self._taken_back = self._untrue, self._taken_back, False, False
        try:
            self.versions.take_back() if taken_back else self.versions.tell_anew()
        except StoreError:
            self._untrue, self._taken_back = untrue, taken_back
            log.exception("the rule is told anew when the store is back")

    def store_waiting(self, secure: bool = True) -> None:
        """Put the labels of confirmed parts into the journal; secure : wait until they are on the disk."""
        if not self._waiting:
            return
        self.outbox.labels(self._waiting, secure)
        self._numberless |= {known.decision.id: (known, True) for known, _ in self._waiting}
        self._waiting = []
        self.arrive()

    def store_all(self) -> None:
        """Have every label in the store, and its number; StoreError where the store is away."""
        self.store_waiting()
        self.journal_cleared()

    def journal_cleared(self) -> None:
        """The same for what is in the journal: of a product's news one may be that very label."""
        self.outbox.drain()
        self.arrive()

    def _was_unobserved(self, known: StoredDecision) -> bool:
        """Whether an accepted part was counted among the unobserved before its label came."""
        counted = known.decision.action is Action.ACCEPT and known.decision.id not in self._went_on and not self._stops_all
        return counted and known.decision.model_version >= self.settings.now.policy_since

    def _label(self, known: StoredDecision, success: bool, source: Source, less: int = 0) -> tuple[NewLabel, Point | None]:
        point = None if known.quarantined else self.versions.reference_point(known)
        stored = point if self.versions.newest.keeps_references else None
        unobserved = 0 if known.quarantined else self._unobserved - less
        return NewLabel(known.decision.id, success, source, self.versions.version, stored, unobserved), point

    def _learn(self, known: StoredDecision, label: NewLabel, point: Point | None) -> None:
        self._unobserved = 0
        self.versions.learn(known, label.success, point, label.silent)

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
            self.outbox.event(SAFE_MODE_BEGAN if now else SAFE_MODE_ENDED, now or safe_again)
            if self.on_safe_mode is not None:
                self.on_safe_mode(now)
        except Exception:
            log.exception("safe mode %s, and that could not be told", f"began: {now}" if now else "ended")
