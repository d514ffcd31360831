"""`JournalledStore`: the way of a running cell's engine to its store. It composes a `Recorder`,
which appends decisions, labels and events to the local journal, a `Drainer`, which copies them from
there into the database, and a `DecisionIndex`, by which decisions are found in memory. Recorder and
drainer have a thread each; a third thread reads the ids of all decisions once.

So no call of the engine waits longer than the store's time limit (`SqlStore.wait`), even where the
disk or the database does not answer. `lag` is how far the database is behind.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future, wait
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING

from ..errors import NotTakenError, StoreError, log
from ..records import Arrays, RetrainReport
from .draining import Drainer
from .journal import HEADER
from .lookup import DecisionIndex
from .outbox import Outbox
from .recording import RETRY_SECONDS, Recorder
from .records import CHUNK, DATA_LOST, LabelNumbers, NewLabel, StoredDecision, T
from .views import HistoryFilter

if TYPE_CHECKING:
    from .sql import SqlStore

NO_LIMIT = 1e9  # seconds: never reached
# Opening waits so long for SQLite's check; that of a large store goes on beside.
CHECK_SECONDS = 0.1
COMMIT_SECONDS = 2.0  # beyond the time limit, for a commit under way: it may still succeed
CLOSE_SECONDS = 5.0  # the longest that closing waits


class JournalledStore(Outbox):
    """An outbox with a journal between the engine and the database; it owns the robot cell.

    Opening copies what an earlier process left in the journal into the database, checks the store's
    integrity, and starts three threads, which `close` ends. Any thread may record and look up.

    Parameters
    ----------
    store : SqlStore
        `close` closes it.
    window : int
        Number of newest labels whose integrity is checked.
    patient : bool, default False
        Wait without a time limit, as a replay does that must repeat exactly.

    Raises
    ------
    StoreError
        If another engine owns the cell, or the database cannot take what the journal holds, or
        database or journal cannot be used.
    OSError
        If the disk fails while the journal's records are copied to the database.
    """

    def __init__(self, store: SqlStore, window: int, patient: bool = False) -> None:
        super().__init__(store, window, NO_LIMIT if patient else store.wait)
        self._unrecorded: set[str] = set()  # ids that were answered without recording a decision
        journal = self._journal = store.claim_cell()
        self._index = DecisionIndex()
        self._recorder = Recorder(journal, store.clock, self.limit)
        self._changed = self._recorder.changed  # guards all of it
        self._drainer = Drainer(store, self._recorder, self._index)
        try:
            self._compare_with_ledger()  # before anything is drained
            self._drain_leftovers()
            self._continue_numbers()
            store.database.on_entry = self._drainer.save_newest_entry
            self._drainer.save_newest_entry()
            self._begin_check()
        except BaseException:
            journal.close()
            raise
        self._recorder.start(kept=store)
        # Only now: a check of the pages that takes long uses the store as well, and needs them.
        self._drainer.start()
        threading.Thread(target=self._load_ids, name="dengine-ids", daemon=True).start()

    def _compare_with_ledger(self) -> None:
        """Check that the store's ledger has the entries that the journal and its head name.

        The ledger is the store's hash chain, the journal the local file that gets each record
        first, and the head a small file beside it. If an entry is missing, the store was cut off or
        restored from an older copy: an event DATA_LOST (an alarm) is stored, and all records of the
        journal will be copied to the database again. Otherwise an event that is no alarm is stored
        if the journal or its head is new or damaged though the store is not new. Either is logged
        as an error. Raise StoreError only if the database cannot be read or written.
        """
        journal = self._journal
        database = self.store.database
        missing = [entry for entry in journal.entries if not database.has_entry(*entry)]
        if missing:
            self._drainer.report(
                DATA_LOST,
                f"the ledger lacks entry {missing[0][0]}, which this cell's journal knows: the "
                "store was cut off, or restored from a copy; labels may be missing.",
            )
            journal.drained_to = HEADER  # the journal may still hold some of them
        elif len(journal.entries) < 2 and database.newest_entry is not None:
            self._drainer.report(
                "journal",
                f"the journal {journal.path}, or its head beside it, is new here, and the store is "
                "not: whether the store was cut off, or labels are elsewhere, is unknown; bring "
                "the old files here, or copy a store by `dengine backup` and `dengine restore`.",
            )

    def _drain_leftovers(self) -> None:
        """Copy to the database what an earlier process left in the journal, and clear the journal.

        The journal is the local file that gets each record first. If records are damaged or missing
        in it, an event DATA_LOST is stored, which is an alarm until a person acknowledges it, and
        an error is logged. In place of a record that the store refuses an event is stored, a "dead
        letter", and an error is logged, too. Raise StoreError if the database fails, or a record
        cannot be decoded, for example that of another release, and OSError if the journal cannot be
        read; the records that were not copied then stay in the journal. Raise StoreError, too, if
        the journal cannot be cleared.
        """
        since = ""
        for item in self.store.decisions.select(HistoryFilter(), limit=1):
            since = f" They came after decision {item.decision.id} of {item.when:%F %T} UTC."
        undrained = self._journal.decode_undrained()
        while records := list(islice(undrained, CHUNK)):
            self.store.apply_records(records)
        if self._journal.loss:
            self._drainer.report(DATA_LOST, self._journal.loss + since)
        self._journal.clear()

    def _begin_check(self) -> None:
        """Compare what the engine reads from the store with its ledger, and log a difference.

        The ledger is the store's hash chain. The first difference is put into `integrity_error`,
        and while this is set, every part is verified. SQLite's own check of the file, without the
        tables of traces and events, runs in a thread; if it fails, its error counts as a
        difference. It is waited for only CHECK_SECONDS (0.1 s); later it may still set
        `integrity_error`. Raise StoreError if the database cannot be read.
        """
        check = threading.Thread(
            target=lambda: self._note_integrity(self.store.database.check_pages()), daemon=True
        )
        check.start()
        self.check_integrity()
        check.join(CHECK_SECONDS)

    # State

    @property
    def verify_all_reason(self) -> str:
        """Why every part must be verified: `integrity_error`, or why the disk takes no records.

        "" if neither. A database that does not answer is no such reason.
        """
        return self.integrity_error or self._recorder.fault

    @property
    def fault(self) -> str:
        """What is wrong with journal or database at present: `integrity_error`, or why one fails.

        Also that the database is too far behind (`Drainer.fault`). "" if nothing is wrong.
        """
        return self.integrity_error or self._drainer.fault

    @property
    def lag(self) -> float:
        """Age in seconds of the oldest record that the database lacks; 0.0 if it lacks none."""
        return self._drainer.lag

    @property
    def is_drained(self) -> bool:
        """Whether the database has every record."""
        return self._drainer.is_drained

    # What the engine records

    def record_decision(self, item: StoredDecision) -> StoredDecision:
        """Record a decision in memory, return a copy with its number; a thread writes it to disk.

        The number is the cell's next one. If one of the newest 1,000 decisions has this id, that
        decision is returned, and nothing is recorded. That an older decision has the id is not
        checked. `find_decision` finds the new decision at once.
        """
        id_ = item.decision.id
        with self._changed:
            first = self._index.recent.get(id_)
            if first is not None:
                return first
            self._unrecorded.discard(id_)
            self.n_decisions += 1
            item = replace(item, number=self.n_decisions)
            self._index.add(self._recorder.record(item))
        return item

    def replace_decision(self, item: StoredDecision) -> StoredDecision:
        """Record a decision in the place of an earlier one that is not on disk yet, and return it.

        Both have the same id. What is recorded and returned is a copy of `item` with time, trace
        and row number of the earlier decision. If the earlier one is on disk by now, nothing is
        recorded, and the earlier one is returned. Raise KeyError for an id that is not in memory.
        """
        id_ = item.decision.id
        with self._changed:
            first, _ = self._index.find(id_)
            if first is None:
                raise KeyError(id_)
            if not self._index.is_unsynced(id_):
                return first
            item = replace(item, time=first.time, trace=first.trace, number=first.number)
            self._index.add(self._recorder.record(item))
        return item

    def record_labels(self, labels: Iterable[tuple[StoredDecision, NewLabel]]) -> None:
        """Record copies of labels in memory, for a thread to write to the journal.

        `labels` holds pairs of a decision and its label. Each copy gets the present time, and the
        content hash and time of its decision. That a decision has a label already is not checked.
        """
        with self._changed:
            for item, label in labels:
                self._index.add(self._recorder.record(self._completed(item, label)))

    def record_event(self, kind: str, text: str) -> None:
        """Record an event with the present time in memory; a thread writes it to disk."""
        self._recorder.record_event(kind, text)

    def sync(self, seconds: float | None = None) -> None:
        """Have all records so far written to the disk, and wait for it, at most `seconds`.

        None: `limit` seconds. If all are there, this returns at once. Raise NotTakenError if that
        takes longer, or a write fails meanwhile; the thread tries to write the records again.
        """
        self._recorder.sync(seconds)

    def drain(self) -> None:
        """Have all records so far copied to the database, and wait for it, at most `limit` seconds.

        Raise StoreError if that takes longer, or the disk or the database has a fault; the records
        are copied later.
        """
        self._drainer.drain()

    def request_label_drain(self) -> bool:
        """Return whether the database still lacks a label; if so, have all records copied there.

        Threads do this at once, and are not waited for. If the database lacks only decisions or
        events, nothing is done, and the result is False.
        """
        with self._changed:
            if self._index.has_undrained_labels:
                self._drainer.request()
            return self._index.has_undrained_labels

    def pop_label_numbers(self) -> LabelNumbers:
        """Return (decision id, label number) of each label that was drained since the last call.

        They are in the order in which they were drained. A report that repeats a stored label has
        the number of that label, and a label that became a dead letter has no pair. Without a
        product the list is empty.
        """
        return self._drainer.pop_label_numbers()

    # What the engine asks

    def find_decision(self, decision_id: str, unsynced: bool = False) -> StoredDecision | None:
        """Return a decision with its label from memory or database, or None if unknown.

        A label that is not on disk yet is left out, unless `unsynced` is True. A label from memory
        comes without number and time. Raise StoreError if the database must be asked (the decision
        is not in memory, and its id may be that of an older one), and it or the journal (the local
        file that gets each record first) has a fault, or there is no answer within `limit` seconds.
        Also if the stored trace is damaged or cannot be read. Raise it also for an id whose last
        decision was not recorded, because the id could not be looked up.
        """
        with self._changed:
            if decision_id in self._unrecorded:
                raise StoreError(
                    f"Expected a decision that is recorded, got {decision_id!r}, which could "
                    "not be looked up, and was "
                    "verified unrecorded; decide on the part again."
                )
            item, label = self._index.find(decision_id, unsynced)
        if item is None and not self._index.is_new(decision_id):
            item = self.call_store(lambda: self.store.decisions.get(decision_id))
        if item is not None and label is not None:
            item = item.with_label(label)
        return item

    def find_earlier(self, decision_id: str) -> StoredDecision | None:
        """Return the decision that an id already has, or None for a new id.

        The decision has its label if the label is on disk. Raise StoreError if the id cannot be
        looked up, or its stored trace is damaged. After such an error `find_decision` raises
        StoreError for this id too, until a decision is recorded for it or this method is called
        again without an error.
        """
        with self._changed:
            self._unrecorded.discard(decision_id)
        try:
            return None if self._index.is_new(decision_id) else self.find_decision(decision_id)
        except StoreError:
            self._unrecorded.add(decision_id)
            raise

    def load_ids(self) -> None:
        """Read the ids of all decisions from the database, and keep their hashes in memory.

        By these a new id is recognized without the database. Loading takes about a second for a
        million ids, without a time limit; other calls to this object may go on meanwhile. Once all
        are loaded, another call does nothing. Raise StoreError if the database cannot be read.
        """
        if self._index.has_all_ids:
            return
        for ids in self.store.decisions.ids():
            with self._changed:
                self._index.add_ids(ids)
        self._index.has_all_ids = True

    def _load_ids(self) -> None:
        """Load the ids of all decisions (`load_ids`), and try again a second after each failure.

        It ends when that succeeds or this object is closed. Until then each id that is not in
        memory is looked up in the database.
        """
        while not self._closed:
            try:
                self.load_ids()
                return
            except StoreError:
                with self._changed:
                    self._changed.wait_for(lambda: self._closed, RETRY_SECONDS)

    def evict_decision(self, decision_id: str) -> None:
        """Drop a decision from the newest in memory, so that it is read from the database again.

        A decision or label that the database lacks stays in memory. An unknown id changes nothing.
        """
        with self._changed:
            self._index.recent.pop(decision_id, None)

    def call_store(self, call: Callable[[], T]) -> T:
        """Make a call in the thread that uses the database, and return its result.

        Before the call, the thread copies the records that are on disk to the database. Raise what
        the call raises, and StoreError if the store has a fault (the call is then not made) or
        takes longer than `limit` seconds (`wait_for_result`).
        """
        return self.wait_for_result(self._drainer.submit(call))

    def store_version(
        self, report: RetrainReport, last_seq: int, state: Arrays | None
    ) -> Future[int]:
        """Have the thread that uses the database commit a retrain (`VersionTable.put`).

        It is not waited for: return a future of the version's number, for `wait_for_result`, which
        also raises what the commit raises. The arrays are not copied here, so do not change them
        until then. Raise StoreError if the store has a fault; nothing is committed then.
        """
        return self._drainer.submit(lambda: self.store.versions.put(report, last_seq, state))

    def wait_for_result(self, future: Future[T]) -> T:
        """Wait for a submitted call, like a commit of `store_version`; return its result.

        Raise what the call raised. The time limit includes the wait for the calls before it. Raise
        StoreError if it takes longer than `limit` seconds. It is then cancelled, so that it commits
        nothing. A call that is already committing cannot be cancelled, and gets COMMIT_SECONDS
        (2 s) more; if StoreError is raised after these, the call may still have committed, or do so
        later.
        """
        if not wait([future], self.limit).done and not future.cancel():
            wait([future], COMMIT_SECONDS)
        if future.cancelled() or not future.done():
            raise StoreError(f"no answer from the store within {self.limit:g} s.")
        return future.result()

    def close(self) -> None:
        """Copy the recorded decisions, labels and events to the database; close store and journal.

        The journal is the local file that gets each record first. The threads are ended, too. This
        takes seconds at most; but an object made with `patient` first waits without a time limit
        for the disk and the database, unless they fail. Records that the database does not take
        stay in the journal, which is logged, and the next engine copies them. Records that the disk
        does not take are given up, and an error is logged; no call has said that they are on disk.
        If the disk hangs, store and journal stay open, and no other engine can use the robot cell
        until the process ends. A second call does nothing, nor does a call in a forked process.
        """
        if not self.is_usable:
            return
        try:
            self.flush()
        except NotTakenError as error:
            log.error("closed without the newest records, which no report acknowledged: %s", error)
        # A sync that is under way hangs: nothing that waits for the disk would end.
        seconds = 0.0 if self._recorder.is_syncing else CLOSE_SECONDS
        with suppress(StoreError):
            self._drainer.drain(seconds)
        with self._changed:
            self._closed = True
        # Each thread first tries once to write the records that wait for it.
        has_recorder_ended = self._recorder.stop(seconds)
        if self._drainer.stop(seconds) and has_recorder_ended and self.is_drained:
            self.store.close()
            return
        log.warning(
            "the store was left, its journal %s holds what it lacks: %s",
            self._journal.path,
            self.fault,
        )
        if seconds:  # else the disk hangs: both stay open until the process ends
            # Another engine can own the cell; a lease ends when its connection is closed.
            self.store.database.close(waiting=False)
            self._journal.close(waiting=False)
