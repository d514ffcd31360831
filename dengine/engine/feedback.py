"""What becomes of parts: labels on their way to the store, the rule, the references and the next retrain.

With `Policy(stops="all")` a bad part stops the system before the next decision, so that one confirms an accepted part: the
rule is told, the trace becomes a reference, and its label, CONFIRMED, is stored with the next report, before the next
retrain, or when 100 wait. With "some" it is counted as unobserved, which is no success.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress

from ..errors import StoreError
from ..records import Action, Source, source_of
from ..store.outbox import Outbox
from ..store.records import SAFE_MODE_BEGAN, SAFE_MODE_ENDED, NewLabel, StoredDecision, already_reported
from .settings import SettingsInForce
from .versions import ModelVersions, Point

log = logging.getLogger("dengine")


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
        self._silent = 0
        self._mode = ""
        self._untrue = False  # whether the rule was told what did not happen
        versions.store_waiting = self.store_all
        versions.journal_cleared = self.journal_cleared

    @property
    def _stops_all(self) -> bool:
        return self.settings.now.recipe.policy.stops == "all"

    def resume(self) -> None:
        """Go on from the store: what was accepted and not reported."""
        self._mode = self.safe_mode
        store = self.outbox.store
        ids = store.unreported_accepts(self.settings.now.policy_since)
        if not self._stops_all:
            self._silent = len(ids) - store.silent_total(self.settings.now.policy_since)
            return
        for id_ in ids:
            known = store.get_decision(id_)
            if known is not None:
                self._went_on[id_] = known

    @property
    def safe_mode(self) -> str:
        """Why everything is verified at present; "" where it is not."""
        return self.versions.newest.safe_mode

    def settle(self) -> None:
        """The next trace comes: accepted parts of which nothing was heard went on."""
        self.arrive()
        if not self._went_on:
            return
        while self._went_on:
            known = self._went_on.pop(next(iter(self._went_on)))
            if self._stops_all:
                label, point = self._label(known, True, Source.CONFIRMED)
                self._learn(known, label, point)
                self._waiting.append((known, label))
            else:
                self._silent += 1
        if len(self._waiting) >= 100:  # so many confirmed parts wait for a report
            self.store_waiting(secure=False)
        self.announce()

    def decided(self, known: StoredDecision) -> None:
        """A part was decided on."""
        if known.decision.action is Action.ACCEPT:
            self._went_on[known.decision.id] = known

    def report(self, known: StoredDecision, success: bool) -> None:
        """Take in a report; it is in the journal before anything else changes."""
        id_ = known.decision.id
        self.arrive()
        if self._arrived_late.get(id_) is success:
            return
        source = source_of(id_, known.decision.action, known.decision.audit, success)
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
                label, point = self._label(known, success, source, int(self._was_silent(known)))
            self.outbox.labels([(known, label)])
        except Exception as error:
            self._waiting += late  # it still waits as it did
            if label is not None and isinstance(error, StoreError):
                self._doubtful[id_], self._silent = (known, label, point), 0
            raise
        self._doubtful.pop(id_, None)
        self._take_in(known, label, point, bool(late))
        if late:
            with suppress(StoreError):  # then it is told anew when the store is back
                self.outbox.drain()
        self.arrive()
        self.announce()

    def _take_in(self, known: StoredDecision, label: NewLabel, point: Point | None, untrue: bool) -> None:
        """Learn what is in the journal."""
        self._went_on.pop(known.decision.id, None)
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
        if self._untrue and self.outbox.drained and not self.outbox.fault:
            try:
                self.versions.tell_anew()
                self._untrue = False
            except StoreError:
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

    def _was_silent(self, known: StoredDecision) -> bool:
        """Whether an accepted part was counted among the silent ones before its label came."""
        counted = known.decision.action is Action.ACCEPT and known.decision.id not in self._went_on and not self._stops_all
        return counted and known.decision.model_version >= self.settings.now.policy_since

    def _label(self, known: StoredDecision, success: bool, source: Source, less: int = 0) -> tuple[NewLabel, Point | None]:
        point = None if known.quarantined else self.versions.reference_point(known)
        stored = point if self.versions.newest.keeps_references else None
        silent = 0 if known.quarantined else self._silent - less
        return NewLabel(known.decision.id, success, source, self.versions.version, stored, silent), point

    def _learn(self, known: StoredDecision, label: NewLabel, point: Point | None) -> None:
        self._silent = 0
        self.versions.learn(known, label.success, point, label.silent)

    def begin_policy(self) -> None:
        """Go on under another policy. What was accepted under the last one and not heard of stays unheard of."""
        self._went_on.clear()
        self._silent = 0

    def announce(self, safe_again: str = "fresh evidence keeps the tolerance") -> None:
        """Record that safe mode began or ended, and tell; last of all, for either may fail and must cost no label."""
        now = self.safe_mode
        if now == self._mode:
            return
        self._mode = now
        try:
            self.outbox.event(SAFE_MODE_BEGAN if now else SAFE_MODE_ENDED, now or safe_again)
            if self.on_safe_mode is not None:
                self.on_safe_mode(now)
        except Exception:
            log.exception("safe mode %s, and that could not be told", f"began: {now}" if now else "ended")
