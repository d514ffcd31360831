"""The engine's only way to its store while a cell runs: the class `Outbox`, with a journal in
between. Decisions, labels and events are appended to the local journal, and from there copied
("drained") into the store's database. One thread writes and syncs the journal; another drains it
and runs the calls that the engine makes to the store; a third reads the ids of all decisions once,
into a `BloomFilter`, by which a new id is recognized.

So no call of the engine waits longer than the store's time limit (`SqlStore.wait`), even where the
disk or the database does not answer. `Outbox.lag` is how far the store is behind. A store without a
journal (in memory, or opened for reading) is called directly.
"""

from __future__ import annotations

import logging
import math
import os
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, wait
from contextlib import contextmanager, suppress
from dataclasses import replace
from hashlib import blake2b
from itertools import islice
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import NotTakenError, StoreError, listed
from .journal import (
    HEADER,
    Journal,
    LostJournalError,
    Record,
    decode_record,
    encode_record,
    forked_error,
)
from .records import DATA_LOST, LOSS_REMEDY, Event, NewLabel, StoredDecision, as_text
from .views import HistoryFilter

if TYPE_CHECKING:
    from .sql import SqlStore

log = logging.getLogger("dengine")
T = TypeVar("T")
NO_LIMIT = 1e9  # seconds: never reached
BATCH_SECONDS = 0.05  # a record waits so long for others before they are written together
DRAIN_SECONDS = 0.25  # synced records wait so long for others before they are drained together
LOCK_SECONDS = 0.001  # a wait for the lock that counts as none
RETRY_SECONDS = 1.0  # between two attempts after a failure
CHECK_SECONDS = (
    0.1  # opening waits so long for SQLite's check; that of a large store goes on beside
)
LAG_SECONDS = 1.0  # a larger lag is a fault of the store
COMMIT_SECONDS = 2.0  # beyond the time limit, for a commit under way: it may still succeed
CLOSE_SECONDS = 5.0  # the longest that closing waits
DRAIN_CHUNK = 500  # records that the store takes in one transaction
N_RECENT = 1_000  # newest decisions kept in memory
MAX_UNWRITTEN = 10_000  # records in memory while the disk hangs; later decisions are not recorded


class BloomFilter:
    """A set of decision ids in 2 MB, however many: it may report an id that was never added.

    It never misses an id that was added. At a million ids, one new id in 500 is reported.

    Parameters
    ----------
    ids : iterable of str
        The first ids.

    Attributes
    ----------
    complete : bool
        Whether every id of the store was added; set by the owner of the filter.

    References
    ----------
    Bloom (1970), CACM 13(7).
    """

    def __init__(self, ids: Iterable[str] = ()) -> None:
        self._bytes = np.zeros(2**21, dtype=np.uint8)
        self.complete = False
        self.add(*ids)

    def add(self, *ids: str) -> None:
        """Add ids."""
        byte, bit = self._bit_positions(ids)
        np.bitwise_or.at(self._bytes, byte, bit)

    def may_contain(self, decision_id: str) -> bool:
        """Return False if the id was never added, True if it was or (rarely) if it was not."""
        byte, bit = self._bit_positions([decision_id])
        return bool((self._bytes[byte] & bit).all())

    def _bit_positions(self, ids: Iterable[str]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the four bits of each id, each as an index of a byte and a byte with one bit set.

        Both arrays have four entries per id; the second has dtype uint8.
        """
        digests = (
            blake2b(id_.encode("utf-8", "surrogatepass"), digest_size=16).digest() for id_ in ids
        )
        positions = np.frombuffer(b"".join(digests), dtype="<u4") % (8 * len(self._bytes))
        return positions >> 3, np.left_shift(1, positions & 7, dtype=np.uint8, casting="unsafe")


class Outbox:
    """Records what the engine decides, and asks the store for it, within a time limit.

    Every `record_*` method returns at once; `sync` waits for the disk, `drain` for the store.
    Opening copies what an earlier process left in the journal into the store, checks the store's
    integrity, and starts three threads, which `close` ends.

    Parameters
    ----------
    store : SqlStore
        Where the records end. `close` closes it.
    window : int
        Number of newest labels that the engine reads, and whose integrity is therefore checked.
    owning : bool, default True
        Claim the cell, so that no other engine can write to it. False: only read.
    patient : bool, default False
        Wait without a time limit, as a replay does that must repeat exactly.

    Attributes
    ----------
    limit : float
        Seconds that a call waits at most.
    n_decisions : int
        Number of the newest recorded decision.
    integrity_error : str
        What in the store is not as it was written, so that every part must be verified; "" if
        nothing is.

    Raises
    ------
    StoreError
        Where another engine owns the cell, or the store cannot take what the journal holds.
    """

    def __init__(
        self, store: SqlStore, window: int, owning: bool = True, patient: bool = False
    ) -> None:
        self.store = store
        self._window = window
        self.limit = NO_LIMIT if patient or store.wait is None else store.wait
        self._reading = not owning
        self._pid = os.getpid()
        self._closed = False
        self._changed = threading.Condition(threading.RLock())  # guards everything below
        self._recent: OrderedDict[str, StoredDecision] = OrderedDict()  # newest decisions, by id
        self._known_ids: BloomFilter | None = None
        self._unrecorded: set[str] = set()  # ids that were answered without recording a decision
        self._label_numbers: list[tuple[str, int]] = []  # given by the store, not yet collected
        # Not drained: decisions, or their offsets once they are in the journal; and labels, each
        # with its position among all records.
        self._decisions: dict[str, StoredDecision | int] = {}
        self._labels: dict[str, tuple[NewLabel, int]] = {}
        self._times: deque[float] = deque()  # when each undrained record was appended
        self._unwritten: deque[Record] = deque()
        # Synced and not drained, in order: offset and end in the journal, and the id of a decision,
        # or "" and a copy of another record.
        self._undrained: deque[tuple[int, int, str, Record | None]] = deque()
        # Numbers of records so far, and up to which of them somebody waits for a sync or a drain.
        self._appended = self._synced = self._drained = 0
        self._to_sync = self._to_drain = 0
        self._n_failed_syncs = 0
        self.n_decisions = 0
        self._calls: deque[tuple[Future[Any], Callable[[], Any]]] = deque()
        self._sync_began = math.inf
        self._journal_error = ""
        self._store_error = ""
        self.integrity_error = ""
        self._threads: list[threading.Thread] = []  # writes the journal, drains it, loads the ids
        self._journal = store.claim_cell() if owning else None
        if self._journal is not None:
            self._start(self._journal)
        elif store.wait is not None:
            self._set_integrity_error(store.database.check_pages())
            self.check_integrity()
        else:
            self.n_decisions = store.n_decisions()

    def _start(self, journal: Journal) -> None:
        """Drain what an earlier process left in the journal, check the store, start the threads.

        Damage in the journal, or records that it lacks, become an event, which is an alarm. The
        journal is emptied, and space reserved in it. From now on every use of the store drains the
        journal first. The check by SQLite is waited for only CHECK_SECONDS and goes on in a thread.
        What a check finds is not raised: it becomes `integrity_error`. On any other error the
        journal is closed, and the error raised.
        """
        try:
            self._compare_with_ledger(journal)  # before anything is drained
            newest = self.store.decisions(HistoryFilter(), limit=1)
            since = "".join(
                f" They came after decision {item.decision.id} of {item.when:%F %T} UTC."
                for item in newest
            )
            for offset, end, blob in journal.undrained_records():
                record = decode_record(blob)
                self._appended += 1
                self._times.append(time.monotonic())
                if isinstance(record, StoredDecision):
                    # A later decision of the same id replaces an earlier one.
                    self._decisions[record.decision.id] = record
                self._mark_synced(record, offset, end)
            while not self.is_drained:
                self._drain_chunk(journal)
            if journal.loss:
                self._log_event(DATA_LOST, journal.loss + since)
            elif journal.dropped:
                self._log_event(
                    "journal",
                    f"{journal.dropped} bytes at its end were dropped: a process was killed as it "
                    "wrote them",
                )
            journal.clear()
            self.n_decisions = self.store.n_decisions()
            self.store.database.on_entry = self._save_newest_entry
            self._save_newest_entry()
            check = threading.Thread(
                target=lambda: self._set_integrity_error(self.store.database.check_pages()),
                daemon=True,
            )
            check.start()
            self.check_integrity()
            check.join(CHECK_SECONDS)
        except BaseException:
            journal.close()
            raise
        self._label_numbers.clear()  # an engine that resumes reads these labels from the store
        loops = {
            "journal": self._write_loop,
            "store": self._drain_loop,
            "ids": self._load_ids_loop,
        }
        for name, loop in loops.items():
            thread = threading.Thread(
                target=loop, args=(journal,), name=f"dengine-{name}", daemon=True
            )
            self._threads.append(thread)
            thread.start()
        # Only now: a check of the pages that takes long uses the store as well, and needs them.
        self.store.before_use = self._drain_before_use

    def _compare_with_ledger(self, journal: Journal) -> None:
        """Check that the store's ledger has the entries that the journal and its head name.

        If one is missing, the store was cut off or restored from an older copy: an event is stored,
        and the journal is set to be drained from its beginning. An event is also stored if the
        journal or its head is new though the store is not.
        """
        database = self.store.database
        if missing := [entry for entry in journal.entries if not database.has_entry(*entry)]:
            self._log_event(
                DATA_LOST,
                f"the ledger lacks entry {missing[0][0]}, which this cell's journal knows: the "
                "store was cut off, or restored from a copy; labels may be missing.",
            )
            journal.drained_to = HEADER  # the journal may still hold some of them
        elif len(journal.entries) < 2 and database.newest_entry is not None:
            self._log_event(
                "journal",
                f"the journal {journal.path}, or its head beside it, is new here, and the store is "
                "not: whether the store was cut off, or labels are elsewhere, is unknown; bring "
                "the old files here, or copy a store by `dengine backup` and `dengine restore`.",
            )

    def check_integrity(self, since: int | None = None) -> None:
        """Compare what the engine reads from the store with the ledger; set `integrity_error`.

        The first error stays; nothing is returned. A store in memory is not checked.

        Parameters
        ----------
        since : int or None
            Labels after this number are checked; None: the newest `window`.
        """
        if self.store.wait is not None:
            self._set_integrity_error(self.store.database.check_integrity(self._window, since))

    def _set_integrity_error(self, error: str) -> None:
        """Keep and log an integrity error, if it is the first; "" changes nothing."""
        if error and not self.integrity_error:
            self.integrity_error = (
                f"{error}; see `dengine verify`, and restore the store from a copy."
            )
            log.error("every part is verified: %s", self.integrity_error)

    def _log_event(self, kind: str, text: str) -> None:
        """Log an error, and commit it to the store as an event, directly and not by the journal."""
        log.error("%s: %s%s", kind, text, f" {LOSS_REMEDY}" if kind == DATA_LOST else "")
        self.store.put_event(kind, text)

    def _save_newest_entry(self) -> None:
        """Write the ledger's newest entry to the journal's header and its head; errors are ignored.

        By it a store that was cut off is recognized at the next start.
        """
        with self._changed, suppress(StoreError):  # a broken journal is reported by its next record
            if self._journal is not None:
                self._journal.save_newest_entry(self.store.database.newest_entry)

    # State

    @property
    def verify_all_reason(self) -> str:
        """Why every part must be verified.

        An integrity error, or a journal that cannot be written; "" if neither.
        """
        return self.integrity_error or self._journal_fault

    @property
    def _journal_fault(self) -> str:
        """Why the journal cannot be written: its last error, or a sync that exceeds `limit`.

        "" if it can.
        """
        seconds = time.monotonic() - self._sync_began
        if self._journal_error or seconds <= self.limit:
            return self._journal_error
        return f"the disk has not answered for {seconds:.1f} s."

    @property
    def lag(self) -> float:
        """Age in seconds of the oldest record that is not drained; 0.0 if all are."""
        with self._changed:
            return time.monotonic() - self._times[0] if self._times else 0.0

    @property
    def fault(self) -> str:
        """What is wrong with the store or the journal at present; "" if nothing is."""
        return self.integrity_error or self._unavailable_reason

    @property
    def _unavailable_reason(self) -> str:
        """Why the store cannot be written or read at present; "" if it can.

        This is a fault of the journal, the last error of the store, or a lag above both `limit` and
        LAG_SECONDS.
        """
        lag = self.lag
        fault = self._journal_fault or self._store_error
        if fault or lag <= max(LAG_SECONDS, self.limit):
            return fault
        return f"no answer from the store for {lag:.1f} s."

    @property
    def is_usable(self) -> bool:
        """Whether this is the process that opened it, and it is not closed."""
        return os.getpid() == self._pid and not self._closed

    def check_usable(self) -> None:
        """Raise a StoreError if the outbox is closed, for reading only, or of a parent process."""
        if os.getpid() != self._pid:
            raise forked_error(self._pid, "the engine")
        if self._closed:
            raise StoreError("Expected an open engine, got one after close(); open it again.")
        if self._reading:
            raise StoreError(
                "Expected an engine that owns its cell, got one that was opened for reading; "
                "open it without."
            )

    @contextmanager
    def try_lock(self) -> Iterator[bool]:
        """Context manager that tries to take the outbox's lock, and gives whether that succeeded.

        It waits at most a millisecond, and the block runs in either case. While the block holds the
        lock, the threads of the outbox wait, and so do calls from other threads. The lock is
        released after the block.
        """
        locked = self._changed.acquire(
            timeout=LOCK_SECONDS
        )  # a thread that only looks has it for an instant
        try:
            yield locked
        finally:
            if locked:
                self._changed.release()

    # What the engine records

    def record_decision(self, item: StoredDecision) -> StoredDecision:
        """Record a new decision without waiting for disk or store; callable from any thread.

        Parameters
        ----------
        item : StoredDecision
            The decision with its trace.

        Returns
        -------
        StoredDecision
            The same with its number. If the id already has a decision in memory, that one, and
            nothing is recorded. If MAX_UNWRITTEN records wait since the disk hangs, `item` as it
            came, with number 0: it is not recorded, and `find_decision` raises StoreError for its
            id.
        """
        id_ = item.decision.id
        with self._changed:
            if (first := self._recent.get(id_)) is not None:
                return first
            self._unrecorded.discard(id_)
            if len(self._unwritten) >= MAX_UNWRITTEN:
                self._unrecorded.add(id_)
            else:
                self.n_decisions += 1
                item = replace(item, number=self.n_decisions)
                self._append([item])
        return item

    def replace_decision(self, item: StoredDecision) -> StoredDecision:
        """Replace a recorded decision that was not returned to the caller yet, under the same id.

        Time, trace and number stay those of the first decision.

        Returns
        -------
        StoredDecision
            The new decision; or the first one, unchanged, if that is in the journal or the store
            by now.

        Raises
        ------
        KeyError
            If no decision with this id is in memory.
        """
        with self._changed:
            first = self._recent[item.decision.id]
            if not isinstance(self._decisions.get(item.decision.id), StoredDecision):
                return first
            item = replace(item, time=first.time, trace=first.trace, number=first.number)
            self._append([item])
        return item

    def record_labels(self, labels: Iterable[tuple[StoredDecision, NewLabel]]) -> None:
        """Record labels of decisions without waiting; the labels that are passed are not changed.

        Each gets the present time, and the hash and the time of its decision. `pop_label_numbers`
        later returns the numbers that they get in the store.

        Parameters
        ----------
        labels : iterable of (StoredDecision, NewLabel)
            Each label with its decision.
        """
        now = self.store.clock
        with self._changed:
            self._append(
                [
                    replace(label, time=now(), content_hash=item.content_hash, decided=item.time)
                    for item, label in labels
                ]
            )

    def record_event(self, kind: str, text: str) -> None:
        """Record an event with the present time, without waiting.

        Parameters
        ----------
        kind : str
            In a word.
        text : str
            For people.
        """
        with self._changed:
            self._append([Event(0, self.store.clock(), as_text(kind), as_text(text))])

    def _append(self, records: Sequence[Record]) -> None:
        """Add records in memory, in their order, and wake the thread that writes the journal.

        The caller holds the lock. Without a journal the store takes the records here, before this
        returns; if it raises StoreError, nothing is added.
        """
        numbers = self.store.apply_records(records) if self._journal is None else []
        for record in records:
            self._appended += 1
            if isinstance(record, StoredDecision):
                self._recent[record.decision.id] = record
                self._decisions[record.decision.id] = record
                if self._known_ids is not None:
                    self._known_ids.add(record.decision.id)
                if len(self._recent) > N_RECENT:
                    self._recent.popitem(last=False)
            elif isinstance(record, NewLabel):
                self._labels[record.decision_id] = record, self._appended
        if self._journal is None:
            self._synced = self._drained = self._appended
            self._remove_drained(records, numbers)
        else:
            self._times += [time.monotonic()] * len(records)
            if not self._unwritten:  # else the thread is awake already
                self._changed.notify_all()
            self._unwritten += records

    def _remove_drained(
        self, records: Sequence[Record], numbers: Sequence[tuple[str, int]]
    ) -> None:
        """Drop stored records from memory; keep their labels' `numbers` for `pop_label_numbers`.

        Decisions among the newest N_RECENT stay in memory, now with their labels.
        """
        self._label_numbers += numbers
        for record in records:
            if isinstance(record, StoredDecision):
                self._decisions.pop(record.decision.id, None)
            elif isinstance(record, NewLabel):
                self._labels.pop(record.decision_id, None)
                if (item := self._recent.get(record.decision_id)) is not None:
                    item = replace(item, success=record.success, source=record.source)
                    self._recent[record.decision_id] = item

    def sync(self, seconds: float | None = None) -> None:
        """Wait until everything that was recorded so far is in the journal and synced to the disk.

        Parameters
        ----------
        seconds : float or None
            The longest to wait; None: `limit`.

        Raises
        ------
        NotTakenError
            If that takes too long, or fails. Recording the same again is harmless.
        """
        limit = self.limit if seconds is None else seconds
        with self._changed:
            place = self._appended
            self._to_sync = place
            n_failed = self._n_failed_syncs
            self._changed.notify_all()
            self._changed.wait_for(
                lambda: self._synced >= place or self._n_failed_syncs > n_failed, limit
            )
            if self._synced < place:
                reason = self._journal_error or f"the disk gave no answer within {limit:g} s."
                raise NotTakenError(
                    f"The record may not be on disk: {reason} "
                    "Report the same again; once the disk answers it is taken, and counts once."
                )

    # What the engine asks

    def find_decision(self, decision_id: str, unsynced: bool = False) -> StoredDecision | None:
        """Return a decision with its label, from memory, the journal or the store.

        A decision is found as soon as it is recorded. The store is asked only if the id may be
        there, and only for `limit` seconds.

        Parameters
        ----------
        decision_id : str
        unsynced : bool, default False
            Include a label that is recorded and not yet on disk; else the decision comes without
            it.

        Returns
        -------
        StoredDecision or None
            None if no decision has this id.

        Raises
        ------
        StoreError
            If the store is needed and unavailable, and if the id was answered without recording a
            decision.
        """
        with self._changed:
            if decision_id in self._unrecorded:
                raise StoreError(
                    f"Expected a decision that is recorded, got {decision_id!r}, which could "
                    "not be looked up, and was "
                    "verified unrecorded; decide on the part again."
                )
            entry: Any = self._recent.get(decision_id) or self._decisions.get(decision_id)
            if isinstance(entry, int) and self._journal is not None:
                entry = decode_record(self._journal.read(entry))
            item: StoredDecision | None = entry
            label, place = self._labels.get(decision_id, (None, 0))
            label = label if unsynced or place <= self._synced else None
        if item is None and not self._is_new(decision_id):
            item = self.call_store(lambda: self.store.get_decision(decision_id))
        if item is not None and label is not None:
            item = replace(item, success=label.success, source=label.source)
        return item

    def find_earlier(self, decision_id: str) -> StoredDecision | None:
        """Return the decision that an id already has, or None if the id is new.

        It comes with its label if that is on disk.

        Raises
        ------
        StoreError
            If that cannot be looked up. The id is then remembered as answered but unrecorded: until
            a decision is recorded for it, `find_decision` raises StoreError.
        """
        with self._changed:
            self._unrecorded.discard(decision_id)
        try:
            return None if self._is_new(decision_id) else self.find_decision(decision_id)
        except StoreError:
            self._unrecorded.add(decision_id)
            raise

    def _load_ids_loop(self, journal: Journal) -> None:
        """Run `load_ids` until it succeeds or the outbox is closed; pause after each failure.

        Until then every new id is looked up in the store.
        """
        while not self._closed:
            try:
                self.load_ids()
                break
            except StoreError:
                with self._changed:
                    self._changed.wait_for(lambda: self._closed, RETRY_SECONDS)

    def load_ids(self) -> None:
        """Read the ids of all decisions from the store into a Bloom filter in memory.

        Afterwards a new id is recognized without the store, and another call does nothing. It takes
        about a second for a million ids. Raise StoreError if the store cannot be read; another call
        then tries again.
        """
        with self._changed:
            if self._known_ids is None:
                self._known_ids = BloomFilter([*self._recent, *self._decisions])
            known_ids = self._known_ids
        for ids in () if known_ids.complete else self.store.decision_ids():
            with self._changed:
                known_ids.add(*ids)
        known_ids.complete = True

    def _is_new(self, decision_id: str) -> bool:
        """Return whether an id certainly has no decision; False if it may have one.

        Until all ids are loaded, False for every id.
        """
        known_ids = self._known_ids
        return (
            known_ids is not None and known_ids.complete and not known_ids.may_contain(decision_id)
        )

    def evict_decision(self, decision_id: str) -> None:
        """Drop a decision from memory, since it was corrected in the store.

        The next `find_decision` reads it there.
        """
        self._recent.pop(decision_id, None)

    def pop_label_numbers(self) -> list[tuple[str, int]]:
        """Return (decision id, label number) of the labels that were stored since the last call.

        They are in the order in which they were stored. Each is returned once.
        """
        with self._changed:
            numbers = self._label_numbers
            self._label_numbers = []
        return numbers

    @property
    def is_drained(self) -> bool:
        """Whether the store has taken every record."""
        return self._drained == self._appended

    def request_label_drain(self) -> bool:
        """If any label is not drained, ask the threads to drain everything now; do not wait.

        Return whether any label is not drained.
        """
        with self._changed:
            if self._labels:
                self._to_sync = self._to_drain = self._appended
                self._changed.notify_all()
            return bool(self._labels)

    def drain(self) -> None:
        """Wait until the store has taken everything recorded so far, at most `limit` seconds.

        Raises
        ------
        StoreError
            If the store is unavailable, or takes too long; it then counts as unavailable until it
            responds. The records stay in the journal, and are drained later.
        """
        with self._changed:
            if self.is_drained:
                return
            place = self._appended
            self._to_sync = self._to_drain = place
            self._changed.notify_all()
            if not self._changed.wait_for(
                lambda: self._drained >= place or bool(self._unavailable_reason), self.limit
            ):
                self._store_error = f"no answer from the store within {self.limit:g} s."
            if self._drained < place:
                raise self._unavailable()

    def _unavailable(self) -> StoreError:
        """Return the StoreError for a store that cannot be reached now, with the reason."""
        return StoreError(
            f"The store is unavailable: {self._unavailable_reason} Labels wait in its journal; "
            "try this again when it is back."
        )

    def flush(self, seconds: float | None = None) -> None:
        """Wait until every record is on disk, and then in the store unless that is unavailable.

        Each of the two waits is limited.

        Parameters
        ----------
        seconds : float or None
            The longest to wait for the disk; None: `limit`. The store is waited for `limit`
            seconds.

        Raises
        ------
        NotTakenError
            As of `sync`. That the store is unavailable is no error.
        """
        self.sync(seconds)
        with suppress(StoreError):
            self.drain()

    def call_store(self, call: Callable[[], T]) -> T:
        """Have the store's thread run `call`, and return its result within `limit` seconds.

        Raise StoreError if the store is unavailable or takes too long, and whatever `call` raises.
        """
        return self.wait_for_result(self.submit(call))

    def wait_for_result(self, future: Future[T]) -> T:
        """Wait for a submitted call; return its result, or raise what it raised.

        Raises
        ------
        StoreError
            If it takes longer than `limit`. The call is then cancelled, so that it commits nothing.
            A call that is already committing is waited for COMMIT_SECONDS more; if StoreError is
            raised after these, it may still have committed, or do so later.
        """
        if not wait([future], self.limit).done and not future.cancel():
            wait([future], COMMIT_SECONDS)
        if future.cancelled() or not future.done():
            raise StoreError(f"no answer from the store within {self.limit:g} s.")
        return future.result()

    def submit(self, call: Callable[[], T]) -> Future[T]:
        """Have the store's thread run a call, and return without waiting for it.

        Records that are on disk by then are drained before, if the store takes them. Without a
        journal there is no such thread: the call runs here, before this returns, and what it raises
        is raised here.

        Returns
        -------
        Future
            Of the call's result, for `wait_for_result`.

        Raises
        ------
        StoreError
            If the store is unavailable.
        """
        future: Future[T] = Future()
        if self._journal is None:
            future.set_result(call())
            return future
        with self._changed:
            if self._unavailable_reason:
                raise self._unavailable()
            self._calls.append((future, call))
            self._changed.notify_all()
        return future

    def _drain_before_use(self) -> None:
        """Drain before the store is used directly, so that its user sees every record.

        It waits at most `limit` seconds. If the store is unavailable, nothing is raised here. In
        the thread that drains, and after `close`, it does nothing.
        """
        if not self._closed and threading.current_thread() is not self._threads[1]:
            with suppress(StoreError):
                self.drain()

    def close(self) -> None:
        """Drain, stop the threads, close store and journal, within seconds unless `patient`.

        What the store does not take stays in the journal, and the next engine drains it. What the
        disk does not take is given up, and an error is logged: whoever waited for that was told so.
        A second call does nothing, nor does one in a forked process.
        """
        if not self.is_usable:
            return
        try:
            self.flush()
        except NotTakenError as error:
            log.error("closed without the newest records, which no report acknowledged: %s", error)
        # A sync that is under way hangs: nothing that waits for the disk would end.
        seconds = CLOSE_SECONDS if math.isinf(self._sync_began) else 0.0
        with self._changed:
            self._changed.wait_for(
                lambda: self.is_drained or bool(self._journal_fault or self._store_error), seconds
            )
            self._closed = True
            self._changed.notify_all()
        for thread in self._threads[:2]:
            thread.join(seconds)
        if self.is_drained and not any(thread.is_alive() for thread in self._threads[:2]):
            self.store.close()
        elif self._journal is not None:
            log.warning(
                "the store was left, its journal %s holds what it lacks: %s",
                self._journal.path,
                self.fault,
            )
            if seconds:
                # Its lease on the cell would outlive the engine.
                self.store.database.close(waiting=False)
                self._journal.close(waiting=False)

    # The thread that writes the journal

    def _write_loop(self, journal: Journal) -> None:
        """Write and sync new records in batches until closed: the journal's thread runs it.

        After an error, which is kept for `fault`, it wakes those who wait in `sync`, and tries the
        same records again a second later.
        """
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._unwritten or self._closed)
                self._changed.wait_for(
                    lambda: self._to_sync > self._synced or self._closed, BATCH_SECONDS
                )
                if not (batch := list(self._unwritten)):
                    return
                self._sync_began = time.monotonic()
            try:
                self._write_batch(journal, batch)
            except Exception as error:  # whatever it is, the cell goes on, and this thread too
                with self._changed:
                    self._journal_error = str(error)
                    self._n_failed_syncs += 1
                    self._sync_began = math.inf
                    self._changed.notify_all()
                    if self._closed:
                        return
                    self._changed.wait(RETRY_SECONDS)

    def _write_batch(self, journal: Journal, batch: Sequence[Record]) -> None:
        """Append records to the journal, sync it, and mark them as synced.

        A journal above 8 MB is cleared first if the store takes its records within BATCH_SECONDS. A
        journal whose file was lost is created again, and an event is recorded. Raise StoreError if
        the disk fails; the records then stay unwritten.
        """
        if journal.end > 8 << 20:
            with self._changed:  # a cell that never pauses would fill the disk
                self._to_drain = max(self._to_drain, self._synced)
                self._changed.notify_all()
                is_drained = self._changed.wait_for(lambda: journal.is_drained, BATCH_SECONDS)
            if is_drained:  # without the lock: a disk that hangs would hang the cell
                journal.clear()
        blobs = [encode_record(record) for record in batch]
        try:
            offsets = journal.append(blobs, self.store.clock())
        except LostJournalError as error:
            log.error("%s It is created again with what the store lacks.", error)
            with self._changed:  # nobody reads it or writes its header meanwhile
                journal.recreate()
            offsets = journal.append(blobs, self.store.clock())
            self.record_event(
                "journal", f"{error} It was created again with what the store lacked."
            )
        with self._changed:
            ends = [*offsets[1:], journal.end]
            for record, offset, end in zip(batch, offsets, ends, strict=True):
                self._unwritten.popleft()
                self._mark_synced(record, offset, end)
            self._journal_error = ""
            self._sync_began = math.inf
            self._changed.notify_all()

    def _mark_synced(self, record: Record, offset: int, end: int) -> None:
        """Count a record as synced, and note where it is in the journal; the caller has the lock.

        Of a decision only the offset stays in memory, and nothing if it was replaced meanwhile.
        """
        self._synced += 1
        id_ = ""
        if isinstance(record, StoredDecision):
            id_ = record.decision.id
            if self._decisions.get(id_) is record:
                self._decisions[id_] = offset
        self._undrained.append((offset, end, id_, None if id_ else record))

    # The thread that drains the journal into the store

    def _drain_loop(self, journal: Journal) -> None:
        """Drain synced records and run submitted calls until closed: the store's thread runs it.

        Before a call everything synced is drained, if the store takes it; the call runs in either
        case. An error of the store is logged once and kept for `fault`; a second later the store is
        tried again.
        """
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._calls or self._drained < self._synced or self._closed
                )
                self._changed.wait_for(
                    lambda: self._calls or self._to_drain > self._drained or self._closed,
                    DRAIN_SECONDS,
                )
                call = self._calls.popleft() if self._calls else None
            try:
                if self._drained < self._synced:
                    journal.sync_head()
                while self._drained < self._synced:
                    self._drain_chunk(journal)
                self._store_error = ""
            except Exception as error:  # whatever it is, the cell goes on, and this thread too
                if not self._store_error:
                    log.warning("labels wait in the journal beside the store: %s", error)
                with self._changed:
                    self._store_error = str(error)
                    self._changed.notify_all()
            if call is not None:
                self._run_call(*call)
            with self._changed:
                if (
                    self._closed
                    and (self._store_error or self._drained == self._synced)
                    and not self._calls
                ):
                    return
                if self._store_error:
                    self._changed.wait_for(lambda: self._calls or self._closed, RETRY_SECONDS)

    def _drain_chunk(self, journal: Journal) -> None:
        """Have the store commit the oldest synced records, at most DRAIN_CHUNK, in one transaction.

        Decisions that were replaced are left out. A record that is damaged on disk is taken from
        memory; after the records an event is committed, which names the decisions that are not in
        memory any more and so are lost. Journal, counters and memory are updated. Raise StoreError
        if the store refuses records or event; nothing is updated then, and the next call commits
        the same records again.
        """
        records: list[Record] = []
        damaged: list[str] = []
        with self._changed:
            chunk = list(islice(self._undrained, DRAIN_CHUNK))
        for offset, _, id_, copy in chunk:
            if self._decisions.get(id_, offset) != offset:
                continue  # it was replaced
            try:
                records.append(decode_record(journal.read(offset)))
            except StoreError:
                record = copy or self._recent.get(id_)
                damaged.append("" if record else id_)
                if record is not None:
                    records.append(record)
        numbers = self.store.apply_records(records)
        if damaged:
            self._log_event(
                DATA_LOST if any(damaged) else "journal",
                f"{len(damaged)} records of the journal were damaged on disk and are stored from "
                f"memory; decisions that are lost: {listed(filter(None, damaged)) or 'none'}.",
            )
        with self._changed:
            journal.drained_to = chunk[-1][1]
            journal.head.n_drained += len(chunk)
            self._save_newest_entry()
            self._remove_drained(records, numbers)
            for _ in chunk:
                self._times.popleft()
                self._undrained.popleft()
            for id_ in damaged:
                self._decisions.pop(id_, None)
            self._drained += len(chunk)
            self._changed.notify_all()

    def _run_call(self, future: Future[Any], call: Callable[[], Any]) -> None:
        """Run a submitted call; set the future's result or exception. Nothing is raised here.

        A call that was cancelled before is not run. One that is cancelled while it runs is rolled
        back; once it has begun to commit it cannot be cancelled.
        """

        def is_wanted() -> bool:
            """Return whether the future was not cancelled; from then on it cannot be."""
            return future.running() or (
                not future.cancelled() and future.set_running_or_notify_cancel()
            )

        if future.cancelled():
            return
        try:
            with self.store.database.commit_if(is_wanted):
                result = call()
        except BaseException as error:
            if is_wanted():
                future.set_exception(error)
        else:
            if is_wanted():
                future.set_result(result)
