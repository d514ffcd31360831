"""A store that never makes the cell wait: every call has a time limit, and what a store cannot take waits in its journal.

Where the store fails or does not answer in time, decisions and labels go to the journal beside it, which survives a killed
process; a thread tries the store every second, and plays the journal back. A store without a journal is called directly.
"""

from __future__ import annotations

import logging
import os
import queue
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from enum import Enum, auto
from hashlib import blake2b
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import StoreError
from ..records import RetrainReport
from .base import Store
from .journal import HEADER, RESERVE, Journal, JournalError, LateEvent, LateLabel, Record, from_bytes, to_bytes
from .records import NewLabel, StoredDecision, already_reported

T = TypeVar("T")
Committing = Callable[[Callable[[], bool]], AbstractContextManager[None]]


class SlowStoreError(StoreError):
    """The store did not answer in time."""


class Fault(Enum):
    """Why a store cannot be written."""

    STORE = auto()
    SLOW = auto()  # it did not answer in time
    RETURNING = auto()  # it is there again, and is to take what its journal holds
    JOURNAL = auto()  # the journal cannot be written either

    @classmethod
    def of(cls, error: Exception) -> Fault:
        """The kind of what a store, or its journal, raised."""
        kinds = ((JournalError, cls.JOURNAL), (SlowStoreError, cls.SLOW))
        return next((kind for raised, kind in kinds if isinstance(error, raised)), cls.STORE)


class Asked(Generic[T]):
    """A call on its way: given up before its commit begins, it writes nothing; afterwards it can't be given up any more.

    wait : seconds from now on that its result is waited for; None: as long as it takes.
    more : seconds beyond them for a commit that is under way by then, for it may succeed.
    lasting : it is made to its end, whether somebody waits for it or not.
    then : called once its result was taken.
    """

    def __init__(
        self,
        work: Callable[[], T],
        wait: float | None = None,
        more: float = 0.0,
        lasting: bool = False,
        then: Callable[[], object] = lambda: None,
    ) -> None:
        self._work, self._wait, self._more, self._then = work, wait, more, then
        self._began = time.monotonic()
        self._future: Future[T] = Future()  # runs from the moment of its commit on; until then it can be cancelled
        if lasting:
            self._future.set_running_or_notify_cancel()

    def run(self, committing: Committing) -> None:
        """Make the call, unless it was given up; what it raises is raised where its result is asked for."""
        if self._future.cancelled():
            return
        try:
            with committing(self._wanted):
                result = self._work()
        except BaseException as error:
            if self._wanted():
                self._future.set_exception(error)
        else:
            if self._wanted():
                self._future.set_result(result)

    @property
    def due(self) -> bool:
        """Whether its result is there, or is not waited for any longer."""
        return self._future.done() or (self._wait is not None and time.monotonic() - self._began >= self._wait)

    def result(self) -> T:
        """Return what the call returned. StoreError where it takes longer than it is waited for: then it is given up."""
        left = None if self._wait is None else max(0.0, self._began + self._wait - time.monotonic())
        result = self._result(left, self._more)
        self._then()
        return result

    def _result(self, wait: float | None, more: float) -> T:
        try:
            return self._future.result(wait)
        except TimeoutError as error:
            if self._future.done():  # the call's own
                raise
            late = error
        if not self._future.cancel() and more > 0.0:
            return self._result(more, 0.0)
        raise SlowStoreError(f"no answer from the store within {self._wait:g} s.") from late

    def _wanted(self) -> bool:
        future = self._future
        return future.running() or (not future.cancelled() and future.set_running_or_notify_cancel())


WAITING = 10_000  # decisions in memory, before they go to the journal while the store is away
CHUNK = 500  # of a journal's records in one transaction


class Backlog:
    """Decisions and labels on their way to a store; used by the cell's thread and by the one that asks the store."""

    def __init__(self, store: Store, journal: Journal) -> None:
        self.store = store
        self.journal = journal
        self.lock = threading.RLock()
        self._unsafe: dict[str, StoredDecision] = {}  # not known to be committed, and not in the journal
        self._offsets: dict[str, int] = {}  # of decisions in the journal
        self._labels: dict[str, NewLabel] = {}  # in the journal, by decision
        self._arrived: list[tuple[str, int]] = []
        self._played = HEADER  # offset up to which the store holds the journal

    @property
    def unsafe(self) -> list[str]:
        """Ids of decisions that are not known to be on the disk."""
        with self.lock:
            return list(self._unsafe)

    def add(self, item: StoredDecision) -> None:
        """A decision was handed to the store, or waits for it."""
        with self.lock:
            self._unsafe[item.decision.id] = item

    def committed(self, names: Sequence[str]) -> None:
        """These decisions are in the store."""
        with self.lock:
            for name in names:
                self._unsafe.pop(name, None)

    def find(self, decision_id: str) -> StoredDecision | None:
        """A decision that is in the journal, with its label."""
        with self.lock:
            offset, label = self._offsets.get(decision_id), self._labels.get(decision_id)
            item = None if offset is None else from_bytes(self.journal.read(offset))
        if not isinstance(item, StoredDecision):
            return None
        return item if label is None else replace(item, success=label.success, source=label.source)

    def write(self, records: Sequence[Record]) -> None:
        """Put records into the journal, after all decisions that are not safe yet; StoreError where that fails."""
        with self.lock:
            decisions = list(self._unsafe.values())
            if not decisions and not records:
                return
            offsets = self.journal.append([to_bytes(record) for record in [*decisions, *records]])
            names = [item.decision.id for item in decisions]
            self._offsets |= dict(zip(names, offsets, strict=False))
            self._labels |= {late.label.decision_id: late.label for late in records if isinstance(late, LateLabel)}
            self.committed(names)

    def write_beyond(self, n: int) -> None:
        """Put decisions into the journal where more than n wait in memory."""
        if len(self._unsafe) > n:
            self.write([])

    def take_arrived(self) -> list[tuple[str, int]]:
        """The numbers of labels, by decision, that were played back since this was last asked."""
        if not self._arrived:
            return []
        with self.lock:
            arrived, self._arrived = self._arrived, []
        return arrived

    def play_back(self) -> list[str]:
        """Have the store take a piece of what waits; returns what it refused, in words. StoreError where it is away."""
        with self.lock:
            batch, end = self._next()
        arrived, refused = self.store.play_back(batch) if batch else ([], [])
        with self.lock:
            self._arrived += arrived
            self._played = end
            self.committed([record.decision.id for record in batch if isinstance(record, StoredDecision)])
        return refused

    def stored_upto(self, end: int) -> None:
        """The store holds what the journal held up to this offset; what is all stored is cleared."""
        with self.lock:
            self._played = max(self._played, end)
            self.cleared()

    def cleared(self) -> bool:
        """Empty the journal once the store has all of it; whether nothing is left to be played back."""
        with self.lock:
            if self._played < self.journal.end or self._unsafe:
                return False
            if not self.journal.empty:
                self.journal.clear()
            self._played, self._offsets, self._labels = HEADER, {}, {}
            return True

    def _next(self) -> tuple[list[Record], int]:
        batch: list[Record] = []
        end = self._played
        for behind, blob in self.journal.records(end):
            batch.append(from_bytes(blob))
            end = behind
            if len(batch) == CHUNK:
                return batch, end
        return batch + list(self._unsafe.values()), end  # the last of them never went to the journal


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
            if (first := self._known.get(known.decision.id)) is not None:
                return first
            self._known[known.decision.id] = known
            if self._taken is not None:
                self._taken.add(known.decision.id)
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
                raise already_reported(known.decision.id, (known.success, known.source), (label.success, label.source))

    def forget(self, decision_id: str) -> None:
        """What was known of this one is no longer so."""
        self._known.pop(decision_id, None)


log = logging.getLogger("dengine")
GRACE = 2.0  # seconds in which a store may be slow before its cell verifies everything
BEAT = 1.0  # seconds between two tries, and between two looks at whether the store is there
CLOSE = 5.0  # seconds that closing may take


class Outbox:
    """What an engine asks of its store while the cell runs.

    owning : claim the cell; else the store is read and nothing more.
    patient : wait as long as it takes: a replay that repeats exactly never looks at the clock.
    fault : why the store cannot be written at present; "" where it can.
    """

    def __init__(self, store: Store, owning: bool = True, patient: bool = False) -> None:
        self.store = store
        self.fault = ""
        self._kind = Fault.STORE
        self._fault_began = 0.0
        self._beat_began: float | None = None
        self.recent = RecentDecisions()
        self._pid = os.getpid()
        self._closed, self._reading, self._patient = False, not owning, patient
        self._jobs: queue.SimpleQueue[Asked[Any] | None] = queue.SimpleQueue()
        self._backlog: Backlog | None = None
        self._grace = GRACE
        if owning and (journal := store.own()) is not None:
            self._grace = max(GRACE, store.wait or 0.0)
            self._backlog = Backlog(store, journal)
            self._begin(self._backlog)

    def _begin(self, backlog: Backlog) -> None:
        damaged = len(backlog.journal.damaged)
        try:
            self._play_back(backlog)
            if backlog.journal.dropped:
                text = f"{backlog.journal.dropped} bytes at its end were dropped: a process was killed as it wrote them"
                self.store.put_event("journal", text)
            if damaged:
                self.store.put_event("journal", f"{damaged} records that are not as they were written were left out")
        except BaseException:
            backlog.journal.close()
            raise
        backlog.take_arrived()  # what is resumed from the store knows them
        self._thread = threading.Thread(target=self._serve, args=(backlog,), name="dengine-outbox", daemon=True)
        self._thread.start()

    @property
    def away(self) -> str:
        """Why the cell verifies everything; "" where it need not.

        A store on a server may be away while the journal on this machine takes everything: then the cell goes on deciding.
        """
        if not self.fault or self._backlog is None or (self._backlog.store.remote and self._kind is not Fault.JOURNAL):
            return ""
        slow = self._kind in (Fault.SLOW, Fault.RETURNING) and time.monotonic() - self._fault_began < self._grace
        return "" if slow else self.fault

    @property
    def usable(self) -> bool:
        """Whether this is the process that opened it, and it was not closed."""
        return os.getpid() == self._pid and not self._closed

    def check(self) -> None:
        """Raise a StoreError after closing, for reading, and in a fork, whose ids would mix with its parent's."""
        if os.getpid() != self._pid:
            raise StoreError(
                f"Expected the process that opened the engine, {self._pid}, got its fork {os.getpid()}; "
                "open the engine after the fork, in the process that uses it."
            )
        if self._closed:
            raise StoreError("Expected an open engine, got one after close(); open it again.")
        if self._reading:
            raise StoreError("Expected an engine that owns its cell, got one that was opened for reading; open it without.")

    # What the engine asks

    def decided(self, item: StoredDecision) -> None:
        """Take a decision and its trace without waiting."""
        self.check()
        if (backlog := self._backlog) is None:
            self.store.put_decision(item.decision, item.trace, item.content_hash, item.quarantined)
            return
        self._look_at_the_beat()
        fault, kind = self.fault, self._kind
        try:
            if not fault:
                self.store.put_decision(item.decision, item.trace, item.content_hash, item.quarantined)
        except StoreError as error:
            fault, kind = str(error), Fault.of(error)
        with backlog.lock:  # what is here when the fault ends is played back
            backlog.add(replace(item, time=time.time()))
            if fault:
                self._note(fault, kind)
                self._spill(backlog)

    def find(self, decision_id: str) -> StoredDecision | None:
        """Return a decision; None where it is unknown. StoreError where it can't be looked up, for the store is away."""
        if self._backlog is None:
            return self.store.get_decision(decision_id)
        known = self.recent.find(decision_id)
        if known is None and ((known := self._backlog.find(decision_id)) is None or not (known.source or self.fault)):
            known = self.ask(lambda: self.store.get_decision(decision_id)) or known  # its label may be there alone
        return known

    def labels(self, labels: Sequence[NewLabel]) -> NDArray[np.int64]:
        """Commit labels; returns their numbers, 0 for those that wait in the journal. ReportError as `Store.put_labels`."""
        now = time.time()
        self.recent.refuse_repeats(labels)
        late = [LateLabel(label, now) for label in labels]
        numbers = self._store(lambda: self.store.put_labels(labels), late)
        self.recent.label(labels)
        return np.zeros(len(labels), dtype=np.int64) if numbers is None else numbers

    def version(self, report: RetrainReport, last_seq: int, state: Mapping[str, NDArray[Any]] | None) -> Asked[int | None]:
        """Begin to commit a retrain; the result, or a StoreError, is the version's number, where the store says it."""
        return self._begin_commit(lambda: self.store.put_version(report, last_seq, state), GRACE)

    def event(self, kind: str, text: str) -> None:
        """Record what happened, in the journal where the store is away."""
        self._store(lambda: self.store.put_event(kind, text), [LateEvent(kind, text, time.time())])

    def flush(self) -> None:
        """Return when all that is known so far is on the disk: in the store, or in its journal."""
        self._store(self.store.flush, [])

    def secure(self) -> None:
        """Return when all that was decided so far is on the disk: in the journal, which is quicker than the store."""
        if self._backlog is None:
            self.store.flush()
        else:
            self._spill(self._backlog, beyond=0)

    def arrived(self) -> list[tuple[str, int]]:
        """The numbers of labels, by their decisions, that waited in the journal until now; each once."""
        return [] if self._backlog is None else self._backlog.take_arrived()

    def forget(self, decision_id: str) -> None:
        """Look a decision up in the store the next time: what was known of it here is no longer so."""
        self.recent.forget(decision_id)

    def ask(self, work: Callable[[], T]) -> T:
        """Call the store with the time limit; StoreError where it is away."""
        return work() if self._backlog is None else self._put(work).result()

    def _put(self, work: Callable[[], T], more: float = 0.0, then: Callable[[], object] = lambda: None) -> Asked[T]:
        assert self._backlog is not None  # the callers asked; for the type checker
        if self.fault:
            raise StoreError(f"The store is away: {self.fault} Labels wait in its journal; try this again when it is back.")
        wait = None if self._patient else self._backlog.store.wait
        self._jobs.put(asked := Asked(work, wait, more, then=then))
        return asked

    def close(self) -> None:
        """Write everything, to the journal what the store does not take, and let it go within seconds; once."""
        if not self.usable:
            return
        if (backlog := self._backlog) is None:
            self.store.close()
            self._closed = True
            return
        self.flush()
        self._closed = True
        self._jobs.put(closing := Asked(lambda: self._let_store_go(backlog), CLOSE, lasting=True))
        self._jobs.put(None)
        try:
            closing.result()
            self._thread.join()
        except StoreError as error:
            log.warning("the store was left, its journal %s holds what it lacks: %s", backlog.journal.path, error)
            backlog.store.let_go()  # else its writer, and its lease on the cell, would outlive the engine
        backlog.journal.close()

    # Limits, and the journal

    def _store(self, work: Callable[[], T], late: Sequence[Record]) -> T | None:
        """Commit, or put what is to be committed into the journal; then None. StoreError where both fail."""
        if not self.fault or self._backlog is None:
            try:
                return self._begin_commit(work).result()
            except StoreError as error:
                if self._backlog is None:
                    raise
                self._note(str(error), Fault.of(error))
        with self._backlog.lock:
            try:
                self._backlog.write(late)
            except StoreError as error:
                self._note(str(error), Fault.of(error))
                raise
            if not self.fault:
                self._note("it is there again, and is to take what its journal holds.", Fault.RETURNING)
        self._jobs.put(Asked(lambda: None))  # so that the store is tried now, not at the next beat
        return None

    def _begin_commit(self, work: Callable[[], T], more: float = 0.0) -> Asked[T]:
        """Begin to call the store; where that succeeds, all decisions before it are committed as well."""
        if self._backlog is None:
            done = Asked(work)
            done.run(lambda wanted: nullcontext())
            return done
        backlog, before = self._backlog, self._backlog.unsafe
        return self._put(work, more, lambda: backlog.committed(before))

    def _note(self, fault: str, kind: Fault) -> None:
        if not self.fault:
            self._fault_began = time.monotonic()
            log.warning("labels wait in the journal beside the store: %s", fault)
        self.fault, self._kind = fault, kind

    def _look_at_the_beat(self) -> None:
        began = self._beat_began
        if not self.fault and began is not None and time.monotonic() - began > self._grace and not self._patient:
            self._note(f"no answer from the store for {self._grace:g} s.", Fault.SLOW)

    def _spill(self, backlog: Backlog, beyond: int = WAITING) -> None:
        try:
            backlog.write_beyond(beyond)
        except StoreError as error:  # they wait in memory
            self._note(str(error), Fault.of(error))

    # The outbox's thread

    def _serve(self, backlog: Backlog) -> None:
        while backlog.journal.open:
            try:
                job = self._jobs.get(timeout=BEAT)
            except queue.Empty:
                self._beat(backlog)
                continue
            if job is None:
                return
            job.run(backlog.store.committing)
            if self.fault or backlog.journal.end > RESERVE:  # a cell that never pauses would fill the disk
                self._beat(backlog)

    def _beat(self, backlog: Backlog) -> None:
        """Look whether the store is there; where it was not, and now is, play the journal back."""
        with backlog.lock:
            before, end, well = backlog.unsafe, backlog.journal.end, not self.fault
        if well and not before and backlog.journal.empty:
            return
        self._beat_began = time.monotonic()
        try:
            self.store.flush()
            if self.fault:
                self._play_back(backlog)
            backlog.committed(before)
            if well:  # what the journal held then are decisions, which the store was given as well
                backlog.stored_upto(end)
        except Exception as error:  # whatever it is, the cell goes on, and this thread too
            self._note(str(error), Fault.of(error))
        finally:
            self._beat_began = None

    def _let_store_go(self, backlog: Backlog) -> None:
        self._beat(backlog)
        self.store.close()

    def _play_back(self, backlog: Backlog) -> None:
        while True:
            for text in backlog.play_back():
                self.store.put_event("set aside", text)
                log.error("set aside: %s", text)
            with backlog.lock:  # nothing goes to the journal between the look and the word that it need not
                if backlog.cleared():
                    self.fault = ""
                    return
