"""`MemoryStore`: an engine's way to a store in memory, as replays and tests have it. Records are
kept in lists, and written to SQLite when somebody reads the store: a replay, which reads nothing,
never pays for that. An engine that only reads its store, a file or a server, also uses it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from concurrent.futures import Future
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ..records import Arrays, RetrainReport
from .journal import Record
from .outbox import Outbox
from .records import NewLabel, StoredDecision, check_state, chunks, new_event

if TYPE_CHECKING:
    from .sql import SqlStore

MAX_UNWRITTEN_VERSIONS = 40  # about 1.5 MB each


class MemoryStore(Outbox):
    """An outbox without journal, disk and threads; nothing in it waits or is ever unavailable.

    One thread uses it at a time.

    Parameters
    ----------
    store : SqlStore
    window : int
        Number of newest labels whose integrity is checked.
    reading : bool
        The engine only reads.
    """

    is_thread_safe = False

    def __init__(self, store: SqlStore, window: int, reading: bool) -> None:
        super().__init__(store, window, math.inf, reading)
        self._unwritten: list[Record] = []
        self._versions: list[tuple[Any, ...]] = []  # not written: arguments of `versions.put`
        self._decisions: dict[str, StoredDecision] = {}  # not written, with their labels
        self._note_integrity(store.database.check_pages())
        self.check_integrity()
        self._continue_numbers()
        if not reading:  # another engine may use the store
            store.database.before_use = self._write

    def _write(self) -> None:
        """Write the model versions and the records that wait in memory to the database.

        It is called before each use of the store, when 40 versions wait, and after each event of an
        engine that only reads. The versions are written first, then the records (decisions, labels
        and events). Raise StoreError if the database cannot be written; what was not written by
        then is lost.
        """
        versions = self._versions
        records = self._unwritten
        self._versions = []
        self._unwritten = []
        self._decisions = {}
        for version in versions:
            self.store.versions.put(*version)
        for part in chunks(records):
            self.store.apply_records(part)

    def record_decision(self, item: StoredDecision) -> StoredDecision:
        """Keep a copy of a decision with the robot cell's next number in memory, and return it.

        It reaches the database before that is next read or written. That its id is new is not
        checked.
        """
        self.n_decisions += 1
        item = replace(item, number=self.n_decisions)
        self._unwritten.append(item)
        self._decisions[item.decision.id] = item
        return item

    def record_labels(self, labels: Iterable[tuple[StoredDecision, NewLabel]]) -> None:
        """Keep copies of labels in memory; `labels` holds pairs of a decision and its label.

        Each copy gets the present time, and of its decision the content hash (a hash of the trace
        or of the part's number) and the time. The labels are written to the database when somebody
        uses the store. If the decision is still in memory, a copy of the passed one with the label
        takes its place.
        """
        for item, label in labels:
            label = self._completed(item, label)
            self._unwritten.append(label)
            if label.decision_id in self._decisions:
                self._decisions[label.decision_id] = item.with_label(label)

    def record_event(self, kind: str, text: str) -> None:
        """Keep an event in memory; an engine that only reads commits it to the database at once.

        For that engine StoreError is raised if the database cannot be written.
        """
        self._unwritten.append(new_event(kind, text, self.store.clock()))
        if self._reading:  # nobody may read the store again before it is closed
            self._write()

    def find_decision(self, decision_id: str, unsynced: bool = False) -> StoredDecision | None:
        """Return a decision with its label, from memory or else from the database; None if unknown.

        Before it asks the database, everything that waits in memory is written there. A label
        counts as soon as it is recorded, so `unsynced` has no effect. Raise StoreError if the
        database fails or the stored trace is damaged.
        """
        return self._decisions.get(decision_id) or self.store.decisions.get(decision_id)

    def store_version(
        self, report: RetrainReport, last_seq: int, state: Arrays | None
    ) -> Future[int]:
        """Keep a retrain with copies of its arrays in memory; the future that is returned is done.

        `last_seq` is the number of the newest label that the retrain knew of, and `state` holds the
        arrays by name. The result of the future is the report's version number. The retrain is
        written to the database together with the other records, when somebody uses the store, or
        when 40 retrains wait, because packing its arrays takes as long as many decisions. Raise
        StoreError if `report.accepted` is True (the version is to be put in force) and there are no
        arrays, for an array of Python objects, and if 40 retrains wait and the database cannot be
        written. In this last case all that waited and was not written by then is lost, records
        included.
        """
        self._versions.append((report, last_seq, check_state(report, state), self.store.clock()))
        if len(self._versions) == MAX_UNWRITTEN_VERSIONS:
            self._write()
        future: Future[int] = Future()
        future.set_result(report.version)
        return future

    def close(self) -> None:
        """End the use by this engine; a store in memory stays open, also for another engine.

        A file or server, of which this engine only read, is disconnected.
        """
        self._closed = True
        self.store.close()
