"""What becomes of parts: labels on their way to the store, the rule, the references and the next retrain.

With `Policy(stops="all")` a bad part stops the system before the next decision, so that one confirms an accepted part: the
rule is told, the trace becomes a reference, and its label, CONFIRMED, is stored with the next report, before the next
retrain, or when 100 wait. With "some" it is counted as unobserved, which is no success.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from ..errors import StoreError
from ..records import Action, Source, source_of
from ..store.outbox import Outbox
from ..store.records import SAFE_MODE_BEGAN, SAFE_MODE_ENDED, NewLabel, StoredDecision
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
        self._in_journal: dict[str, tuple[StoredDecision, bool]] = {}  # labels without a number yet
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
            try:
                self.store_waiting()
            except StoreError:  # they still wait, in memory; no decision fails for it
                log.exception("confirmed parts could not be stored")
        self.announce()

    def decided(self, known: StoredDecision) -> None:
        """A part was decided on."""
        if known.decision.action is Action.ACCEPT:
            self._went_on[known.decision.id] = known

    def report(self, known: StoredDecision, success: bool) -> None:
        """Take in a report; it is stored before anything else changes."""
        source = source_of(known.decision.id, known.decision.action, known.decision.audit, success)
        late = [each for each in self._waiting if each[0].decision.id == known.decision.id]  # it was taken for confirmed
        self._waiting = [each for each in self._waiting if each[0].decision.id != known.decision.id]
        try:
            self.store_waiting()
            label, point = self._label(known, success, source, int(self._was_silent(known)))
            (seq,) = self.outbox.labels([label])
        except Exception:
            self._waiting += late  # nothing was stored: it still waits as it did
            raise
        self._went_on.pop(known.decision.id, None)
        if known.quarantined:
            return
        if late:
            self.versions.unlearn(known)
        self._learn(known, label, point)
        self._keep(known, success, int(seq))
        self._untrue |= bool(late)
        self.arrive()
        self.announce()

    def arrive(self) -> None:
        """Do what had to wait for the store: labels that it has taken by now train, and the rule is told the truth."""
        for id_, seq in self.outbox.arrived():
            known, success = self._in_journal.pop(id_, (None, False))
            if known is not None:
                self.versions.keep(known, success, seq)
        if self._untrue and not self.outbox.fault:
            try:
                self.versions.tell_anew()
                self._untrue = False
            except StoreError:
                log.exception("the rule is told anew when the store is back")

    def _keep(self, known: StoredDecision, success: bool, seq: int) -> None:
        """Give a label to the next retrain, once it has its number."""
        if seq:
            self.versions.keep(known, success, seq)
        else:
            self._in_journal[known.decision.id] = known, success

    def store_waiting(self) -> None:
        """Commit the labels of confirmed parts, and give them to the next retrain."""
        if not self._waiting:
            return
        seqs = self.outbox.labels([label for _, label in self._waiting])
        waiting, self._waiting = self._waiting, []
        for (known, _), seq in zip(waiting, seqs, strict=True):
            self._keep(known, True, int(seq))

    def store_all(self) -> None:
        """Have every label in the store; StoreError while some wait in its journal."""
        self.store_waiting()
        self.journal_cleared()

    def journal_cleared(self) -> None:
        """StoreError while a label of this cell waits in the journal: of a product's news one may be that very label."""
        self.arrive()
        if self._in_journal:
            raise StoreError(f"{len(self._in_journal)} labels wait in the journal until the store is back.")

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
