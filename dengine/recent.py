"""The newest decisions of a cell, and their labels: what a report finds without asking the store."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import replace

from .store.checks import already_reported
from .store.records import NewLabel, StoredDecision

MOST = 1_000


class RecentDecisions:
    """The newest decisions, at most `MOST`."""

    def __init__(self) -> None:
        self._known: OrderedDict[str, StoredDecision] = OrderedDict()

    def add(self, known: StoredDecision) -> None:
        """One more; the oldest goes where there are too many."""
        self._known[known.id] = known
        if len(self._known) > MOST:
            self._known.popitem(last=False)

    def find(self, decision_id: str) -> StoredDecision | None:
        """A decision with its label; None where it is not among the newest."""
        return self._known.get(decision_id)

    def label(self, labels: Sequence[NewLabel]) -> None:
        """These labels were taken in."""
        for label in labels:
            if (known := self._known.get(label.decision_id)) is not None:
                self._known[label.decision_id] = replace(known, success=label.success, source=label.source)

    def refuse_repeats(self, labels: Sequence[NewLabel]) -> None:
        """ReportError where one of these decisions has a label already."""
        for label in labels:
            known = self._known.get(label.decision_id)
            if known is not None and known.success is not None and known.source is not None:
                raise already_reported(known.id, (known.success, known.source), (label.success, label.source))

    def forget(self, decision_id: str) -> None:
        """What was known of this one is no longer so."""
        self._known.pop(decision_id, None)
