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
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from .asking import Asked
from .backlog import WAITING, Backlog, OwnedStore
from .errors import StoreError
from .recent import RecentDecisions
from .records import RetrainReport
from .store.base import Store
from .store.journal import RESERVE
from .store.journal_records import LateEvent, LateLabel, Record
from .store.records import DecidedTrace, NewLabel, StoredDecision

log = logging.getLogger("dengine")
GRACE = 2.0  # seconds in which a store may be slow before its cell verifies everything
BEAT = 1.0  # seconds between two tries, and between two looks at whether the store is there
CLOSE = 5.0  # seconds that closing may take
BACK = "it is there again, and is to take what its journal holds."

T = TypeVar("T")


class Keeper:
    """What an engine asks of its store while the cell runs.

    owning : claim the cell; else the store is read and nothing more.
    patient : wait as long as it takes: a replay that repeats exactly never looks at the clock.
    fault : why the store cannot be written at present; "" where it can.
    """

    def __init__(self, store: Store, owning: bool = True, patient: bool = False) -> None:
        self.store = store
        self.fault = ""
        self._fault_began = 0.0
        self._beat_began: float | None = None
        self.recent = RecentDecisions()
        self._pid = os.getpid()
        self._closed, self._reading, self._patient = False, not owning, patient
        self._jobs: queue.SimpleQueue[Asked[Any] | None] = queue.SimpleQueue()
        self._backlog: Backlog | None = None
        self._grace = GRACE
        if owning and isinstance(store, OwnedStore):
            self._grace = max(GRACE, store.wait)
            self._backlog = Backlog(store, store.own())
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
        self._thread = threading.Thread(target=self._serve, args=(backlog,), name="dengine-keeper", daemon=True)
        self._thread.start()

    @property
    def away(self) -> str:
        """Why the cell verifies everything; "" where it need not.

        A store on a server may be away while the journal on this machine takes everything: then the cell goes on deciding.
        """
        if not self.fault or self._backlog is None or (self._backlog.store.remote and "journal" not in self.fault):
            return ""
        slow = self.fault.startswith(("no answer", BACK)) and time.monotonic() - self._fault_began < self._grace
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

    def decided(self, item: DecidedTrace) -> None:
        """Take a decision and its trace without waiting."""
        self.check()
        if (backlog := self._backlog) is None:
            self.store.put_decision(item.decision, item.trace, item.content_hash, item.quarantined, item.part)
            return
        self._look_at_the_beat()
        fault = self.fault
        try:
            if not fault:
                self.store.put_decision(item.decision, item.trace, item.content_hash, item.quarantined, item.part)
        except StoreError as error:
            fault = str(error)
        with backlog.lock:  # what is here when the fault ends is played back
            backlog.add(replace(item, time=time.time()))
            if fault:
                self._note(fault)
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
                self._note(str(error))
        with self._backlog.lock:
            try:
                self._backlog.write(late)
            except StoreError as error:
                self._note(str(error))
                raise
            self._note(self.fault or BACK)
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

    def _note(self, fault: str) -> None:
        if not self.fault:
            self._fault_began = time.monotonic()
            log.warning("labels wait in the journal beside the store: %s", fault)
        self.fault = fault

    def _look_at_the_beat(self) -> None:
        began = self._beat_began
        if not self.fault and began is not None and time.monotonic() - began > self._grace and not self._patient:
            self._note(f"no answer from the store for {self._grace:g} s.")

    def _spill(self, backlog: Backlog, beyond: int = WAITING) -> None:
        try:
            backlog.write_beyond(beyond)
        except StoreError as error:  # they wait in memory
            self._note(str(error))

    # The keeper's thread

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
            self._note(str(error))
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
