"""`DecisionIndex`: the decisions that an engine can look up without its database. It holds the
newest ones and those that the database lacks, and recognizes a new id by the hashes of all ids.
`JournalledStore` has one.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

from .recording import Entry
from .records import NewLabel, StoredDecision

N_RECENT = 1_000  # newest decisions kept in memory


class DecisionIndex:
    """Finds decisions and labels by id in memory, without the database.

    It holds the newest decisions, every record that is not drained (copied to the database), and
    the hashes of all ids, which tell ids that are certainly new. A million hashes take about 70 MB
    of memory.

    It has no lock: whoever shares it between threads holds one.

    Attributes
    ----------
    recent : dict of str to StoredDecision
        The newest N_RECENT decisions by id, with those labels that are drained.
    has_all_ids : bool
        Whether all ids of the database were added.
    """

    def __init__(self) -> None:
        self.recent: OrderedDict[str, StoredDecision] = OrderedDict()
        # Not drained, by decision: the newest record of the decision, and of its label.
        self._decisions: dict[str, Entry] = {}
        self._labels: dict[str, Entry] = {}
        self._hashes: set[int] = set()  # of all ids; they take less memory than the ids
        self.has_all_ids = False

    def add(self, entry: Entry) -> None:
        """Add a decision or label that was just recorded; an event, without an id, changes nothing.

        `entry` holds this record, and says whether it is on disk. The record replaces an earlier
        decision with the same id, or an earlier label of the same decision. A decision enters
        `recent`, the newest decisions by id, and the oldest leaves it if there are then more than
        N_RECENT (1,000). A decision that replaces one in `recent` keeps its place in the order, and
        any other is the newest. `find` finds a decision that left `recent` until the database has
        it.
        """
        record = entry.record
        if isinstance(record, StoredDecision):
            id_ = record.decision.id
            self.recent[id_] = record
            self._decisions[id_] = entry
            self._hashes.add(hash(id_))
            if len(self.recent) > N_RECENT:
                self.recent.popitem(last=False)
        elif isinstance(record, NewLabel):
            self._labels[record.decision_id] = entry

    def is_replaced(self, entry: Entry) -> bool:
        """Return whether a later record of the same decision replaces this one.

        `entry` holds a record that was not copied to the database yet. False for a label or an
        event.
        """
        record = entry.record
        return (
            isinstance(record, StoredDecision)
            and self._decisions.get(record.decision.id) is not entry
        )

    def remove_drained(self, entry: Entry) -> None:
        """Remove a record from those that wait for the database, which has it now.

        `entry` holds the record. The newest N_RECENT decisions (1,000) stay in memory, in `recent`.
        If the record is a label, and its decision is there, that is replaced by a copy with the
        label, without the label's number and time; a later label of the decision is not removed. An
        event (a row of the store's log) changes nothing, nor does a decision if another with the
        same id was added after it. Raise KeyError for a label if no label of its decision waits for
        the database.
        """
        record = entry.record
        if isinstance(record, StoredDecision) and not self.is_replaced(entry):
            del self._decisions[record.decision.id]
        elif isinstance(record, NewLabel):
            id_ = record.decision_id
            if self._labels[id_] is entry:  # else a later label of the decision waits
                del self._labels[id_]
            item = self.recent.get(id_)
            if item is not None:
                self.recent[id_] = item.with_label(record)

    def find(
        self, decision_id: str, unsynced: bool = False
    ) -> tuple[StoredDecision | None, NewLabel | None]:
        """Return a decision and its label, as far as they are in memory.

        Returns
        -------
        decision : StoredDecision or None
            One of the newest N_RECENT decisions (1,000), or of those that the database lacks;
            otherwise None. One of the newest has its label, if the database got the label while the
            decision was among the newest.
        label : NewLabel or None
            The label of the decision, if the database lacks it. None if there is none, or if it is
            not on disk yet and `unsynced` is False.
        """
        item: Any = self.recent.get(decision_id)
        entry = self._decisions.get(decision_id)
        if item is None and entry is not None:
            item = entry.record
        label: Any = None
        entry = self._labels.get(decision_id)
        if entry is not None and (unsynced or entry.is_synced):
            label = entry.record
        return item, label

    def is_unsynced(self, decision_id: str) -> bool:
        """Return whether a decision was recorded, and is not synced in the journal yet.

        False for an unknown id, and for a decision that the database has.
        """
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
        """Add the hashes of ids of decisions that the database has; `is_new` is False for them."""
        self._hashes.update(map(hash, ids))
