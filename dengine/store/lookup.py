"""`DecisionIndex`: the decisions that an engine can look up without its database. It holds the
newest ones in memory, knows where in the journal the others are that the database lacks, and
recognizes a new id by the hashes of all ids. `JournalledStore` has one.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

from .journal import Journal, Record, decode_record
from .recording import Entry
from .records import NewLabel, StoredDecision

N_RECENT = 1_000  # newest decisions kept in memory


class DecisionIndex:
    """Finds decisions and labels by id in memory and in the journal, without the database.

    It holds the newest decisions, every record that is not drained, and the hashes of all ids,
    which tell ids that are certainly new. A million hashes take about 70 MB of memory.

    It has no lock: whoever shares it between threads holds one.

    Parameters
    ----------
    journal : Journal
        From which decisions are read that are not in memory any more.

    Attributes
    ----------
    recent : dict of str to StoredDecision
        The newest N_RECENT decisions by id, with those labels that are drained.
    has_all_ids : bool
        Whether all ids of the database were added.
    """

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self.recent: OrderedDict[str, StoredDecision] = OrderedDict()
        # Not drained, by decision: the newest record of the decision, and of its label.
        self._decisions: dict[str, Entry] = {}
        self._labels: dict[str, tuple[NewLabel, Entry]] = {}
        self._hashes: set[int] = set()  # of all ids; they take less memory than the ids
        self.has_all_ids = False

    def add(self, record: Record, entry: Entry) -> None:
        """Add a record that was just recorded; an event, which has no id, changes nothing.

        `entry` says where the record is, in memory or in the journal. It replaces an earlier
        decision of that id, or an earlier label of that decision. If there are more than N_RECENT
        decisions (1,000) in memory, the oldest is dropped from memory.
        """
        if isinstance(record, StoredDecision):
            id_ = record.decision.id
            self.recent[id_] = record
            self._decisions[id_] = entry
            self._hashes.add(hash(id_))
            if len(self.recent) > N_RECENT:
                self.recent.popitem(last=False)
        elif isinstance(record, NewLabel):
            self._labels[record.decision_id] = record, entry

    def is_replaced(self, entry: Entry) -> bool:
        """Return whether a later record of the same decision replaces this undrained one."""
        return bool(entry.decision_id) and self._decisions.get(entry.decision_id) is not entry

    def remove_drained(self, entry: Entry) -> None:
        """Remove a record that the database has now, or that is lost.

        `entry` says which record. The newest N_RECENT decisions (1,000) stay in memory. If the
        record is a label, its decision there is replaced by a copy with the label. Raise KeyError
        for a label that was not added.
        """
        if not self.is_replaced(entry):
            self._decisions.pop(entry.decision_id, None)
        label = entry.record
        if isinstance(label, NewLabel):
            id_ = label.decision_id
            if self._labels[id_][1] is entry:  # else a later label of the decision waits
                del self._labels[id_]
            item = self.recent.get(id_)
            if item is not None:
                self.recent[id_] = item.with_label(label)

    def find(
        self, decision_id: str, unsynced: bool = False
    ) -> tuple[StoredDecision | None, NewLabel | None]:
        """Return a decision and its label, as far as they are in memory or in the journal.

        Returns
        -------
        decision : StoredDecision or None
            From the newest N_RECENT decisions (1,000) in memory, or, if the database lacks it, from
            the records that wait for the disk or from the journal; otherwise None. Among the newest
            it has its label, if the database got the label while it was there.
        label : NewLabel or None
            The label of the decision, if the database lacks it. None if there is none, or if it is
            not on disk yet and `unsynced` is False.

        Raises
        ------
        StoreError
            If the journal is damaged where the decision stands, or cannot be read.
        """
        item = self.recent.get(decision_id)
        entry = self._decisions.get(decision_id)
        if item is None and entry is not None:
            record: Any = entry.record or decode_record(self._journal.read(entry.offset))
            item = record
        label, place = self._labels.get(decision_id, (None, None))
        is_counted = unsynced or (place is not None and place.is_synced)
        return item, label if is_counted else None

    def is_unsynced(self, decision_id: str) -> bool:
        """Return whether a decision was recorded, and is not in the journal yet."""
        entry = self._decisions.get(decision_id)
        return entry is not None and not entry.is_synced

    @property
    def has_undrained_labels(self) -> bool:
        """Whether any label is not drained."""
        return bool(self._labels)

    def is_new(self, decision_id: str) -> bool:
        """Return whether an id certainly has no decision; False if it may have one.

        Until all ids are loaded, False for every id.
        """
        return self.has_all_ids and hash(decision_id) not in self._hashes

    def add_ids(self, ids: Sequence[str]) -> None:
        """Add ids of decisions that the database has."""
        self._hashes.update(map(hash, ids))
