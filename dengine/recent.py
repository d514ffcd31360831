"""The newest decisions of a cell, and their labels: what a report finds without asking the store."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from hashlib import blake2b

from .store.checks import already_reported
from .store.records import NewLabel, StoredDecision

MOST = 1_000


class TakenIds:
    """Ids that decisions have, in 2 MB however many: a Bloom filter.

    It may take a new id for a taken one, never the reverse: one in 500 of new ids at a million taken ones.
    Source: Bloom (1970), CACM 13(7).
    """

    BITS, HASHES = 2**24, 4

    def __init__(self, ids: Iterable[str] = ()) -> None:
        self._bits = bytearray(self.BITS // 8)
        for each in ids:
            self.add(each)

    def add(self, decision_id: str) -> None:
        """One more is taken."""
        for place in self._places(decision_id):
            self._bits[place >> 3] |= 1 << (place & 7)

    def may_hold(self, decision_id: str) -> bool:
        """False: it is not taken."""
        return all(self._bits[place >> 3] >> (place & 7) & 1 for place in self._places(decision_id))

    def _places(self, decision_id: str) -> list[int]:
        digest = blake2b(decision_id.encode("utf-8", "surrogatepass"), digest_size=4 * self.HASHES).digest()
        return [int.from_bytes(digest[i : i + 4], "little") % self.BITS for i in range(0, len(digest), 4)]


class RecentDecisions:
    """The newest decisions, at most `MOST`."""

    def __init__(self) -> None:
        self._known: OrderedDict[str, StoredDecision] = OrderedDict()
        self._taken: TakenIds | None = None
        self._adding = threading.Lock()

    def add(self, known: StoredDecision) -> StoredDecision:
        """One more, in any thread; the oldest goes where there are too many. Returns the one that has its id: the first."""
        with self._adding:
            if (first := self._known.get(known.id)) is not None:
                return first
            self._known[known.id] = known
            if self._taken is not None:
                self._taken.add(known.id)
            if len(self._known) > MOST:
                self._known.popitem(last=False)
        return known

    def know(self, ids: Iterable[str]) -> None:
        """Learn which ids are taken by now."""
        self._taken = TakenIds(ids)

    def is_new(self, decision_id: str) -> bool:
        """Whether an id is taken for certain by no decision; False where that is not known."""
        return self._taken is not None and not self._taken.may_hold(decision_id)

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
