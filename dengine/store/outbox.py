"""The one way into a store while a cell runs: decisions, labels and events go to a journal first, and from there into it.

One thread writes and syncs the journal, another has the store take what is synced, and asks it what the engine wants to
know. No call waits longer than the store's `wait`. How far the store lags behind is a number, `lag`: a store that is away
and one that is slow are the same to the cell. Without a journal (in memory, for reading) the store is called directly.
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

from ..errors import NotTakenError, StoreError
from .journal import HEADER, Journal, LostJournalError, Record, forked, from_bytes, to_bytes
from .records import Event, NewLabel, StoredDecision, as_text

if TYPE_CHECKING:
    from .sql import SqlStore

log = logging.getLogger("dengine")
T = TypeVar("T")
PATIENT = 1e9  # seconds: nobody waits so long
LINGER, DRAIN = 0.05, 0.25  # seconds that a decision waits for company before it is written, and before the store takes it
BRIEF = 0.001  # seconds that are no waiting
BEAT = 1.0  # seconds between two tries of what failed
CHECK = 0.1  # seconds that opening waits for SQLite's own check; of a larger store, that is done while the cell runs
LATE = 1.0  # seconds of lag that are a fault of the store
COMMIT = 2.0  # seconds beyond `wait` for a commit that is under way by then, for it may succeed
CLOSE = 5.0  # seconds that closing may take
CHUNK = 500  # records that the store takes at once
MOST = 1_000  # of the newest decisions, which are known without asking
UNWRITTEN = 10_000  # records in memory while the disk does not answer; later decisions are verified, and not recorded


class TakenIds:
    """Ids that decisions have, in 2 MB however many: a Bloom filter.

    It may take a new id for a taken one, never the reverse: one in 500 of new ids at a million taken ones.
    complete : whether all were added.
    Source: Bloom (1970), CACM 13(7).
    """

    def __init__(self, ids: Iterable[str] = ()) -> None:
        self._bytes, self.complete = np.zeros(2**21, dtype=np.uint8), False
        self.add(*ids)

    def add(self, *ids: str) -> None:
        """These are taken."""
        byte, bit = self._places(ids)
        np.bitwise_or.at(self._bytes, byte, bit)

    def may_hold(self, decision_id: str) -> bool:
        """False: it is not taken."""
        byte, bit = self._places([decision_id])
        return bool((self._bytes[byte] & bit).all())

    def _places(self, ids: Iterable[str]) -> tuple[NDArray[Any], NDArray[Any]]:
        digests = (blake2b(each.encode("utf-8", "surrogatepass"), digest_size=16).digest() for each in ids)
        places = np.frombuffer(b"".join(digests), dtype="<u4") % (8 * len(self._bytes))  # four of each
        return places >> 3, np.left_shift(1, places & 7, dtype=np.uint8, casting="unsafe")


class Outbox:
    """What an engine tells and asks its store while the cell runs.

    window : newest labels that are read, and so held to the ledger.
    owning : claim the cell; else the store is read and nothing more.
    patient : wait as long as it takes: a replay that repeats exactly never looks at the clock.
    """

    def __init__(self, store: SqlStore, window: int, owning: bool = True, patient: bool = False) -> None:
        self.store, self._window = store, window
        self.limit = PATIENT if patient or store.wait is None else store.wait
        self._reading, self._pid, self._closed = not owning, os.getpid(), False
        self._changed = threading.Condition(threading.RLock())  # guards all that follows
        self._recent: OrderedDict[str, StoredDecision] = OrderedDict()
        self._taken: TakenIds | None = None
        self._unrecorded: set[str] = set()  # ids that were answered, and are recorded under no decision of theirs
        self._arrived: list[tuple[str, int]] = []
        # Of what is not drained: the decisions, each by its offset once it is in the journal; labels with their places.
        self._decisions: dict[str, StoredDecision | int] = {}
        self._labels: dict[str, tuple[NewLabel, int]] = {}
        self._times: deque[float] = deque()  # when each record was appended
        self._unwritten: deque[Record] = deque()
        self._appended = self._synced = self._drained = 0  # how many records so far
        self._to_sync = self._to_drain = 0  # places that somebody waits for
        self._tries = 0  # to sync, that failed
        self.n_decisions = 0  # number of the newest decision that was recorded
        self._jobs: deque[tuple[Future[Any], Callable[[], Any]]] = deque()
        self._sync_began = math.inf
        self._stuck = self._away = self.doubt = ""  # why the journal, why the store, took nothing; what is not as written
        self._threads: list[threading.Thread] = []  # one writes, one drains, one learns
        self._journal = store.own() if owning else None
        if self._journal is not None:
            self._begin(self._journal)
        elif store.wait is not None:
            self._doubt_it(store.database.damage())
            self.hold_to_ledger()
        else:
            self.n_decisions = store.n_decisions()

    def _begin(self, journal: Journal) -> None:
        """Have the store take what an earlier process left, and begin."""
        try:
            # Before the store takes anything.
            known, database = [each for each in (journal.newest, journal.head) if each is not None], self.store.database
            if lacking := [each for each in known if not database.holds_entry(*each)]:
                text = f"the ledger lacks entry {lacking[0][0]}, which this cell's journal knows: the store was cut off"
                self._note("lost", f"{text}, or put back from a copy; labels may be missing")
                journal.drained = HEADER  # it may hold some of them still
            elif len(known) < 2 and database.newest is not None:
                text = f"the journal {journal.path}, or its head beside it, is new here, and the store is not"
                self._note("journal", f"{text}: whether the store was cut off, or labels wait elsewhere, is not known")
            for at, _, blob in journal.records():
                self._appended, self._synced = self._appended + 1, self._synced + 1
                self._times.append(time.monotonic())
                if isinstance(record := from_bytes(blob), StoredDecision):
                    self._decisions[record.decision.id] = at  # a later one of an id is in the place of an earlier one
            while not self.drained:
                self._take(journal)
            if journal.dropped:
                text = f"{journal.dropped} bytes at its end were dropped: a process was killed as it wrote them"
                self._note("journal", text)
            if journal.damaged:
                self._note("journal", f"{journal.damaged} records that are not as they were written were left out")
            journal.clear()
            journal.reserve()
            self.n_decisions = self.store.n_decisions()
            self.store.database.on_entry = self._mark
            self._mark()
            check = threading.Thread(target=lambda: self._doubt_it(self.store.database.damage()), daemon=True)
            check.start()
            self.hold_to_ledger()
            check.join(CHECK)
        except BaseException:
            journal.close()
            raise
        self._arrived.clear()  # what is resumed from the store knows them
        self.store.before_use = self._settle
        works = {"journal": self._keep_writing, "store": self._keep_draining, "ids": self._keep_learning}
        for name, work in works.items():
            self._threads.append(threading.Thread(target=work, args=(journal,), name=f"dengine-{name}", daemon=True))
            self._threads[-1].start()

    def hold_to_ledger(self, since: int | None = None) -> None:
        """Look whether what is read from the store is as its ledger has it; where it is not, everything is verified.

        since : labels after that number are read; None: the newest `window`.
        """
        if self.store.wait is not None:
            self._doubt_it(self.store.database.doubt(self._window, since))

    def _doubt_it(self, said: str) -> None:
        if said and not self.doubt:
            self.doubt = f"{said}; see `dengine verify`, and restore the store from a copy."
            log.error("every part is verified: %s", self.doubt)

    def _note(self, kind: str, text: str) -> None:
        log.error("%s: %s", kind, text)
        self.store.put_event(kind, text)

    def _mark(self) -> None:
        """Note the ledger's newest entry in the journal, a drained one or not: a store that was cut off is told by that."""
        with self._changed, suppress(StoreError):  # what is wrong with the journal, its next record tells
            if self._journal is not None:
                self._journal.mark(self.store.database.newest)

    # How it is doing

    @property
    def away(self) -> str:
        """Why the cell verifies everything: what is in force was changed, or the journal takes nothing; "" else."""
        return self.doubt or self._hung

    @property
    def _hung(self) -> str:
        seconds = time.monotonic() - self._sync_began
        return self._stuck or (f"the disk has not answered for {seconds:.1f} s." if seconds > self.limit else "")

    @property
    def lag(self) -> float:
        """Age in seconds of the oldest record that the store has not taken; 0.0 where it has all."""
        with self._changed:
            return time.monotonic() - self._times[0] if self._times else 0.0

    @property
    def fault(self) -> str:
        """What is wrong with the store, or with the journal, at present; "" where nothing is."""
        return self.doubt or self._blocked

    @property
    def _blocked(self) -> str:
        """Why the store cannot be written, or asked, at present."""
        late = f"no answer from the store for {self.lag:.1f} s." if self.lag > max(LATE, self.limit) else ""
        return self._hung or self._away or late

    @property
    def usable(self) -> bool:
        """Whether this is the process that opened it, and it was not closed."""
        return os.getpid() == self._pid and not self._closed

    def check(self) -> None:
        """Raise a StoreError after closing, for reading, and in a fork, whose ids would mix with its parent's."""
        if os.getpid() != self._pid:
            raise forked(self._pid, "the engine")
        if self._closed:
            raise StoreError("Expected an open engine, got one after close(); open it again.")
        if self._reading:
            raise StoreError("Expected an engine that owns its cell, got one that was opened for reading; open it without.")

    @contextmanager
    def unless_held(self) -> Iterator[bool]:
        """Whether it can be told something without waiting for its threads, which wait until the block ends."""
        held = self._changed.acquire(timeout=BRIEF)  # whoever looks what is new there, has it for an instant
        try:
            yield held
        finally:
            if held:
                self._changed.release()

    # What the engine tells

    def decided(self, made: StoredDecision) -> StoredDecision:
        """Record a decision, as the engine makes it, without waiting, in any thread; returns the first one of its id.

        It has its number, or 0 where it is not recorded.
        """
        id_ = made.decision.id
        with self._changed:
            if (first := self._recent.get(id_)) is not None:
                return first
            self._unrecorded.discard(id_)
            if len(self._unwritten) >= UNWRITTEN:
                self._unrecorded.add(id_)
            else:
                self.n_decisions += 1
                made = replace(made, number=self.n_decisions)
                self._append([made])
        return made

    def amend(self, item: StoredDecision) -> StoredDecision:
        """Put a decision in the place of its id's, which nobody was told; returns that one if it is on the disk by now."""
        with self._changed:
            first = self._recent[item.decision.id]
            if not isinstance(self._decisions.get(item.decision.id), StoredDecision):
                return first
            made = replace(item, time=first.time, trace=first.trace, number=first.number)
            self._append([made])
        return made

    def labels(self, labels: Iterable[tuple[StoredDecision, NewLabel]]) -> None:
        """Record labels of decisions, without waiting. Their numbers come with `arrived`."""
        now = self.store.clock
        with self._changed:
            self._append(
                [replace(label, time=now(), content_hash=of.content_hash, decided=of.time) for of, label in labels]
            )

    def event(self, kind: str, text: str) -> None:
        """Record what happened, without waiting."""
        with self._changed:
            self._append([Event(0, self.store.clock(), as_text(kind), as_text(text))])

    def _append(self, records: Sequence[Record]) -> None:
        """Take records, and know of them."""
        arrived = self.store.take(records) if self._journal is None else []
        for record in records:
            self._appended += 1
            if isinstance(record, StoredDecision):
                self._recent[record.decision.id] = self._decisions[record.decision.id] = record
                if self._taken is not None:
                    self._taken.add(record.decision.id)
                if len(self._recent) > MOST:
                    self._recent.popitem(last=False)
            elif isinstance(record, NewLabel):
                self._labels[record.decision_id] = record, self._appended
        if self._journal is None:
            self._synced = self._drained = self._appended
            self._was_taken(records, arrived)
        else:
            self._times += [time.monotonic()] * len(records)
            if not self._unwritten:  # else whoever writes knows of some
                self._changed.notify_all()
            self._unwritten += records

    def _was_taken(self, records: Sequence[Record], arrived: Sequence[tuple[str, int]]) -> None:
        """The store has these, and gave their labels numbers."""
        self._arrived += arrived
        for record in records:
            if isinstance(record, StoredDecision):
                self._decisions.pop(record.decision.id, None)
            elif isinstance(record, NewLabel):
                self._labels.pop(record.decision_id, None)
                if (known := self._recent.get(record.decision_id)) is not None:
                    self._recent[record.decision_id] = replace(known, success=record.success, source=record.source)

    def secure(self, seconds: float | None = None) -> None:
        """Return when all that was told is on the disk. NotTakenError where that takes too long, or fails.

        seconds : to wait at most; None: the limit.
        """
        limit = self.limit if seconds is None else seconds
        with self._changed:
            self._to_sync, tries = (place := self._appended), self._tries
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._synced >= place or self._tries > tries, limit)
            if self._synced < place:
                why = self._stuck or f"the disk gave no answer within {limit:g} s."
                raise NotTakenError(
                    f"What was told is not known to be taken: {why} "
                    "Say the same again; once the disk is well it is taken, and counts once."
                )

    # What the engine asks

    def find(self, decision_id: str, told: bool = False) -> StoredDecision | None:
        """Return a decision; None where it is unknown. StoreError where it can't be looked up, for the store is away.

        told : with its label as soon as that was told; else once it is on the disk.
        """
        with self._changed:
            if decision_id in self._unrecorded:
                raise StoreError(
                    f"Expected a decision that is recorded, got {decision_id!r}, which could not be looked up, and was "
                    "verified unrecorded; decide on the part again."
                )
            held: Any = self._recent.get(decision_id) or self._decisions.get(decision_id)
            if isinstance(held, int) and self._journal is not None:
                held = from_bytes(self._journal.read(held))
            known: StoredDecision | None = held
            label, place = self._labels.get(decision_id, (None, 0))
            label = label if told or place <= self._synced else None
        if known is None and not self._is_new(decision_id):
            known = self.ask(lambda: self.store.get_decision(decision_id))
        if known is not None and label is not None:
            known = replace(known, success=label.success, source=label.source)
        return known

    def decided_before(self, decision_id: str) -> StoredDecision | None:
        """The decision that an id has; None: it is new. StoreError where that is not known: it stays unrecorded."""
        with self._changed:
            self._unrecorded.discard(decision_id)
        try:
            return None if self._is_new(decision_id) else self.find(decision_id)
        except StoreError:
            self._unrecorded.add(decision_id)
            raise

    def _keep_learning(self, journal: Journal) -> None:
        """Learn which ids are taken, when the store is there: meanwhile ids are looked up one by one."""
        while not self._closed:
            try:
                self.know()
                break
            except StoreError:
                with self._changed:
                    self._changed.wait_for(lambda: self._closed, BEAT)

    def know(self) -> None:
        """Learn which ids are taken by now, a second for a million, so that in an outage new ones are known to be new."""
        with self._changed:
            taken = self._taken = self._taken or TakenIds([*self._recent, *self._decisions])
        for ids in () if taken.complete else self.store.decision_ids():
            with self._changed:
                taken.add(*ids)
        taken.complete = True

    def _is_new(self, decision_id: str) -> bool:
        """Whether an id is taken for certain by no decision; False where that is not known."""
        return self._taken is not None and self._taken.complete and not self._taken.may_hold(decision_id)

    def forget(self, decision_id: str) -> None:
        """Look a decision up in the store the next time: what was known of it here is no longer so."""
        self._recent.pop(decision_id, None)

    def arrived(self) -> list[tuple[str, int]]:
        """The numbers that the store has given labels, by their decisions; each once."""
        with self._changed:
            arrived, self._arrived = self._arrived, []
        return arrived

    @property
    def drained(self) -> bool:
        """Whether the store has all that was told."""
        return self._drained == self._appended

    def lacks_labels(self) -> bool:
        """Whether the store lacks labels that were told; then it takes what there is at once, and nobody waits for it."""
        with self._changed:
            if self._labels:
                self._to_sync = self._to_drain = self._appended
                self._changed.notify_all()
            return bool(self._labels)

    def drain(self) -> None:
        """Return when the store has all that was told so far. StoreError where it is away, or takes too long."""
        with self._changed:
            if self.drained:
                return
            self._to_sync = self._to_drain = place = self._appended
            self._changed.notify_all()
            if not self._changed.wait_for(lambda: self._drained >= place or bool(self._blocked), self.limit):
                self._away = f"no answer from the store within {self.limit:g} s."
            if self._drained < place:
                raise self._is_away()

    def _is_away(self) -> StoreError:
        return StoreError(f"The store is away: {self._blocked} Labels wait in its journal; try this again when it is back.")

    def flush(self, seconds: float | None = None) -> None:
        """Return when all that is known so far is in the store, or, where that is away, on the disk: see `secure`."""
        self.secure(seconds)
        with suppress(StoreError):
            self.drain()

    def ask(self, work: Callable[[], T]) -> T:
        """Call the store with the time limit; StoreError where it is away."""
        return self.result(self.begin(work))

    def result(self, future: Future[T]) -> T:
        """What a call to the store returned. StoreError where it takes too long: it is given up, unless it commits."""
        if not wait([future], self.limit).done and not future.cancel():
            wait([future], COMMIT)
        if future.cancelled() or not future.done():
            raise StoreError(f"no answer from the store within {self.limit:g} s.")
        return future.result()

    def begin(self, work: Callable[[], T]) -> Future[T]:
        """Begin to call the store; `result` ends it."""
        future: Future[T] = Future()
        if self._journal is None:
            future.set_result(work())
            return future
        with self._changed:
            if self._blocked:
                raise self._is_away()
            self._jobs.append((future, work))
            self._changed.notify_all()
        return future

    def _settle(self) -> None:
        """Who uses the store itself sees all that was told."""
        if not self._closed and threading.current_thread() is not self._threads[1]:
            with suppress(StoreError):
                self.drain()

    def close(self) -> None:
        """Write everything, to the journal what the store does not take, and let it go within seconds; once."""
        if not self.usable:
            return
        self.flush()
        with self._changed:
            self._changed.wait_for(lambda: self.drained or bool(self._away), CLOSE)
            self._closed = True
            self._changed.notify_all()
        for thread in self._threads[:2]:
            thread.join(CLOSE)
        if self.drained and not any(thread.is_alive() for thread in self._threads[:2]):
            self.store.close()
        elif self._journal is not None:
            log.warning("the store was left, its journal %s holds what it lacks: %s", self._journal.path, self.fault)
            self.store.database.close(waiting=False)  # else its lease on the cell would outlive the engine
            self._journal.close()

    # The thread that writes the journal

    def _keep_writing(self, journal: Journal) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._unwritten or self._closed)
                self._changed.wait_for(lambda: self._to_sync > self._synced or self._closed, LINGER)
                if not (batch := list(self._unwritten)):
                    return
                self._sync_began = time.monotonic()
            try:
                self._write(journal, batch)
            except Exception as error:  # whatever it is, the cell goes on, and this thread too
                with self._changed:
                    self._stuck, self._tries, self._sync_began = str(error), self._tries + 1, math.inf
                    self._changed.notify_all()
                    if self._closed:
                        return
                    self._changed.wait(BEAT)

    def _write(self, journal: Journal, batch: Sequence[Record]) -> None:
        if journal.end > 8 << 20:
            with self._changed:  # a cell that never pauses would fill the disk
                self._to_drain = max(self._to_drain, self._synced)
                self._changed.notify_all()
                if empty := self._changed.wait_for(lambda: journal.empty, LINGER):
                    journal.clear()
            if empty:
                journal.reserve()  # without the lock: a disk that hangs would hang the cell
        blobs = [to_bytes(record) for record in batch]
        try:
            offsets = journal.append(blobs)
        except LostJournalError as error:
            log.error("%s It is made anew with what the store lacks.", error)
            with self._changed:  # nobody reads or marks it meanwhile
                journal.remake()
            offsets = journal.append(blobs)
            self.event("journal", f"{error} It was made anew with what the store lacked.")
        with self._changed:
            for record, at in zip(batch, offsets, strict=True):
                self._unwritten.popleft()
                if isinstance(record, StoredDecision) and self._decisions.get(record.decision.id) is record:
                    self._decisions[record.decision.id] = at
            self._synced += len(batch)
            self._stuck, self._sync_began = "", math.inf
            self._changed.notify_all()

    # The thread that drains it into the store

    def _keep_draining(self, journal: Journal) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._jobs or self._drained < self._synced or self._closed)
                self._changed.wait_for(lambda: self._jobs or self._to_drain > self._drained or self._closed, DRAIN)
                job = self._jobs.popleft() if self._jobs else None
            try:
                while self._drained < self._synced:
                    self._take(journal)
                self._away = ""
            except Exception as error:  # whatever it is, the cell goes on, and this thread too
                if not self._away:
                    log.warning("labels wait in the journal beside the store: %s", error)
                with self._changed:
                    self._away = str(error)
                    self._changed.notify_all()
            if job is not None:
                self._run(*job)
            with self._changed:
                if self._closed and (self._away or self._drained == self._synced) and not self._jobs:
                    return
                if self._away:
                    self._changed.wait_for(lambda: self._jobs or self._closed, BEAT)

    def _take(self, journal: Journal) -> None:
        """Have the store take a piece of what is synced."""
        with self._changed:
            n = min(CHUNK, self._synced - self._drained)
        found = [(at, end, from_bytes(blob)) for at, end, blob in islice(journal.records(), n)]
        with self._changed:  # without the decisions that another one is in the place of
            records = [
                record
                for at, _, record in found
                if not isinstance(record, StoredDecision) or self._decisions.get(record.decision.id) == at
            ]
        arrived = self.store.take(records)
        with self._changed:
            journal.drained = found[-1][1]
            self._mark()
            self._was_taken(records, arrived)
            for _ in range(n):
                self._times.popleft()
            self._drained += n
            self._changed.notify_all()

    def _run(self, future: Future[Any], work: Callable[[], Any]) -> None:
        """Make a call, unless it was given up; what it raises is raised where its result is asked for."""

        def wanted() -> bool:
            return future.running() or (not future.cancelled() and future.set_running_or_notify_cancel())

        if future.cancelled():
            return
        try:
            with self.store.database.committing(wanted):
                result = work()
        except BaseException as error:
            if wanted():
                future.set_exception(error)
        else:
            if wanted():
                future.set_result(result)
