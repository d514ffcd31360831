"""What becomes of parts: labels on their way to the store, the rule, the references and the next retrain.

Nothing is known of an accepted part while it goes on. With `Policy(stops="all")` a bad one stops the system before the next
decision, so that one confirms it: the rule is told, the trace becomes a reference, and its label, CONFIRMED, is stored
with the next report, before the next retrain, or when `BATCH` wait, so that no decision waits for the disk. With "some"
it is counted as silent, which is no success; the watch of the safe mode is told how many there were.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from .deciding import source_of
from .errors import ReportError
from .records import Action, Source
from .store.base import Store
from .store.records import DecidedTrace, NewLabel, StoredDecision, stored_decision
from .versions import ModelVersions, Point

log = logging.getLogger("dengine")
BATCH = 100  # confirmed parts that wait for a report, before a decision stores them


class Feedback:
    """Takes in what became of decided parts.

    stops_all : whether silence until the next decision confirms an accepted part.
    on_safe_mode : called with the reason, "" where it ends, when the safe mode begins or ends; it is recorded before.
    """

    def __init__(
        self, store: Store, versions: ModelVersions, stops_all: bool, on_safe_mode: Callable[[str], object] | None = None
    ) -> None:
        self.store, self.versions, self.stops_all = store, versions, stops_all
        self.on_safe_mode = on_safe_mode
        self._went_on: dict[str, StoredDecision] = {}  # accepted, nothing heard of them yet
        self._waiting: list[tuple[StoredDecision, NewLabel]] = []  # confirmed, not stored
        self._silent = 0
        self._mode = ""
        versions.store_waiting = self.store_waiting

    def resume(self) -> None:
        """Go on from the store: what was accepted and not reported."""
        self._mode = self.safe_mode
        ids = self.store.unreported_accepts()
        if not self.stops_all:
            self._silent = len(ids) - self.store.silent_total()
            return
        for id_ in ids:
            known = self.store.get_decision(id_)
            if known is not None:
                self._went_on[id_] = known

    @property
    def safe_mode(self) -> str:
        """Why everything is verified at present; "" where it is not."""
        return self.versions.newest.safe_mode

    def settle(self) -> None:
        """The next trace comes: accepted parts of which nothing was heard went on."""
        if not self._went_on:
            return
        while self._went_on:
            known = self._went_on.pop(next(iter(self._went_on)))
            if self.stops_all:
                label, point = self._label(known, True, Source.CONFIRMED)
                self._learn(known, label, point)
                self._waiting.append((known, label))
            else:
                self._silent += 1
        if len(self._waiting) >= BATCH:
            self.store_waiting()
        self._announce()

    def decided(self, item: DecidedTrace) -> None:
        """A part was decided on."""
        if item.decision.action is Action.ACCEPT:
            self._went_on[item.decision.id] = stored_decision(item)

    def report(self, known: StoredDecision, success: bool) -> None:
        """Take in a report; it is stored before anything else changes."""
        source = source_of(known.id, known.action, known.audit, success)
        late = [each for each in self._waiting if each[0].id == known.id]  # it was taken for confirmed
        self._waiting = [each for each in self._waiting if each[0].id != known.id]
        try:
            self.store_waiting()
            label, point = self._label(known, success, source, int(self._was_silent(known)))
            (seq,) = self.store.put_labels([label])
        except Exception:
            self._waiting += late  # nothing was stored: it still waits as it did
            raise
        self._went_on.pop(known.id, None)
        if known.quarantined:
            return
        self._learn(known, label, point)
        self.versions.keep(known, success, int(seq))
        if late:  # its success stays among the references until the next retrain
            self.versions.tell_anew()
        self._announce()

    def store_waiting(self) -> None:
        """Commit the labels of confirmed parts, and give them to the next retrain."""
        if not self._waiting:
            return
        seqs = self.store.put_labels([label for _, label in self._waiting])
        waiting, self._waiting = self._waiting, []
        for (known, _), seq in zip(waiting, seqs, strict=True):
            self.versions.keep(known, True, int(seq))

    def _was_silent(self, known: StoredDecision) -> bool:
        """Whether an accepted part was counted among the silent ones before its label came."""
        return known.action is Action.ACCEPT and known.id not in self._went_on and not self.stops_all

    def _label(self, known: StoredDecision, success: bool, source: Source, less: int = 0) -> tuple[NewLabel, Point | None]:
        point = None if known.quarantined else self.versions.reference_point(known)
        stored = point if self.versions.newest.keeps_references else None
        silent = 0 if known.quarantined else self._silent - less
        return NewLabel(known.id, success, source, self.versions.version, stored, silent), point

    def _learn(self, known: StoredDecision, label: NewLabel, point: Point | None) -> None:
        self._silent = 0
        self.versions.learn(known, label.success, point, label.silent)

    def _announce(self) -> None:
        """Record that safe mode began or ended, and tell; last of all, for either may fail and must cost no label."""
        now = self.safe_mode
        if now == self._mode:
            return
        self._mode = now
        try:
            self.store.put_event("safe mode", now or "ended: fresh evidence keeps the tolerance")
            if self.on_safe_mode is not None:
                self.on_safe_mode(now)
        except Exception:
            log.exception("safe mode %s, and that could not be told", f"began: {now}" if now else "ended")


def unknown_stop(decision_id: str) -> ReportError:
    """What is said of a report on a decision that is not known."""
    return ReportError(
        f"Expected the id of a decision of this cell, got {decision_id!r}, which is unknown; "
        "a system stop whose decision was lost can be reported with its trace."
    )
