"""A store that never makes the cell wait: every call has a time limit, and what a store cannot take waits in its journal.

Where the store fails or does not answer in time, decisions and labels go to the journal beside it (`store.journal`), which
survives a killed process; a thread tries the store every second, and plays the journal back once it is there again. Then
`arrived` gives the numbers of the labels. A store without a journal, such as one in memory, is called directly.
"""

from __future__ import annotations

import logging
import os
import queue
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from .errors import StoreError
from .records import RetrainReport
from .store.base import Store
from .store.checks import already_reported
from .store.journal import HEADER, Journal
from .store.journal_records import LateEvent, LateLabel, Record, from_bytes, to_bytes
from .store.records import DecidedTrace, NewLabel, StoredDecision, stored_decision

log = logging.getLogger("dengine")
GRACE = 2.0  # seconds in which a store may be slow before its cell verifies everything
BEAT = 1.0  # seconds between two tries, and between two looks at whether the store is there
CLOSE = 5.0  # seconds that closing may take
RECENT = 1_000  # decisions that a report finds without asking the store
WAITING = 10_000  # decisions in memory before they go to the journal, while the store is away
CHUNK = 500  # of a journal's records in one transaction

T = TypeVar("T")


@runtime_checkable
class OwnedStore(Store, Protocol):
    """A store that one engine owns at a time, and that has a journal."""

    wait: float

    @property
    def remote(self) -> bool:
        """Whether it is on a server, which may be away while this machine's disk is well."""

    def own(self) -> Journal:
        """Claim the cell; StoreError where another engine has it."""

    def play_back(self, records: Sequence[Record]) -> tuple[list[tuple[str, int]], list[str]]:
        """Write what a journal held; labels' numbers by decision, and what was refused."""


class _Job:
    """A call on the keeper's thread."""

    def __init__(self, work: Callable[[], Any]) -> None:
        self.work = work
        self.done = threading.Event()
        self.result: Any = None
        self.error: BaseException | None = None

    def run(self) -> None:
        try:
            self.result = self.work()
        except BaseException as error:  # it is raised where the result is asked for
            self.error = error
        self.done.set()


class Keeper:
    """What an engine asks of its store while the cell runs.

    owning : whether to claim the cell; else the store is read and nothing more.
    patient : wait as long as it takes, for a replay that repeats exactly never looks at the clock.
    fault : why the store cannot be written at present; "" where it can.
    """

    def __init__(self, store: Store, owning: bool = True, patient: bool = False) -> None:
        self.store = store
        self.fault = ""
        self._recent: OrderedDict[str, StoredDecision] = OrderedDict()
        self._unsafe: OrderedDict[str, DecidedTrace] = OrderedDict()  # not known to be committed, nor in the journal
        self._written: dict[str, int] = {}  # decisions in the journal: their offsets
        self._labelled: dict[str, NewLabel] = {}  # labels in the journal
        self._arrived: list[tuple[str, int]] = []
        self._fault_began = 0.0
        self._played = 0  # offset up to which the store holds the journal
        self._beat_began: float | None = None
        self._pid = os.getpid()
        self._lock = threading.RLock()  # guards all of these
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._closed, self._reading = False, not owning
        self._owned = store if owning and isinstance(store, OwnedStore) else None
        self._wait = None if patient or self._owned is None else self._owned.wait
        self.journal = None if self._owned is None else self._owned.own()
        self._thread: threading.Thread | None = None
        if self.journal is not None:
            self._begin(self.journal)

    def _begin(self, journal: Journal) -> None:
        try:
            self._play_back(journal)
            if journal.dropped:
                self.store.put_event(
                    "journal", f"{journal.dropped} bytes of an unfinished record were dropped: a killed process"
                )
        except BaseException:
            journal.close()
            raise
        self._arrived.clear()  # what is resumed from the store knows them
        self._thread = threading.Thread(target=self._serve, name="dengine-keeper", daemon=True)
        self._thread.start()

    @property
    def away(self) -> str:
        """Why the cell verifies everything; "" where it need not.

        A store on a server may be away while the journal holds everything: then each cell goes on deciding.
        """
        if not self.fault or self._owned is None or (self._owned.remote and "journal" not in self.fault):
            return ""
        slow = self.fault.startswith("no answer") and time.monotonic() - self._fault_began < GRACE
        return "" if slow else self.fault

    # What the engine asks

    def decided(self, item: DecidedTrace) -> None:
        """Take a decision and its trace without waiting; whatever the store does, the cell goes on."""
        self.check()
        name = item.decision.id
        self._recent[name] = stored_decision(item)
        if len(self._recent) > RECENT:
            self._recent.popitem(last=False)
        if self._owned is None:
            self.store.put_decision(item.decision, item.trace, item.content_hash, item.quarantined, item.part)
            return
        with self._lock:
            self._unsafe[name] = replace(item, time=time.time())
            self._look_at_the_beat()
            if self.fault:
                self._spill()
                return
        try:
            self.store.put_decision(item.decision, item.trace, item.content_hash, item.quarantined, item.part)
        except StoreError as error:
            self._note(str(error))

    def find(self, decision_id: str) -> StoredDecision | None:
        """Return a decision; None where it is unknown. StoreError where it can't be looked up, for the store is away."""
        if self.journal is None:
            return self.store.get_decision(decision_id)
        with self._lock:
            if decision_id in self._written and decision_id not in self._recent:
                item = from_bytes(self.journal.read(self._written[decision_id]))
                assert isinstance(item, DecidedTrace)  # the offset is of a decision; for the type checker
                said = self._labelled.get(decision_id)
                return stored_decision(item) if said is None else stored_decision(item, said.success, said.source)
        return self._recent.get(decision_id) or self._ask(lambda: self.store.get_decision(decision_id))

    def labels(self, labels: Sequence[NewLabel]) -> NDArray[np.int64]:
        """Commit labels; returns their numbers, 0 for those that wait in the journal. ReportError as `Store.put_labels`."""
        self.check()
        if self.journal is None:
            return self.store.put_labels(labels)
        if not self.fault:
            try:
                numbers = self._commit(lambda: self.store.put_labels(labels))
                self._remember(labels)
                return numbers
            except StoreError as error:
                self._note(str(error))
        self._refuse_repeats(labels)
        now = time.time()
        self._write([LateLabel(label, now) for label in labels])
        self._remember(labels)
        with self._lock:
            self._labelled |= {label.decision_id: label for label in labels}
        return np.zeros(len(labels), dtype=np.int64)

    def version(self, report: RetrainReport, last_seq: int, state: Mapping[str, NDArray[Any]] | None) -> None:
        """Commit a retrain; StoreError where the store does not take it now."""
        self._commit(lambda: self.store.put_version(report, last_seq, state))

    def event(self, kind: str, text: str) -> None:
        """Record what happened, in the journal where the store is away."""
        if not self.fault or self.journal is None:
            try:
                self._commit(lambda: self.store.put_event(kind, text))
                return
            except StoreError as error:
                if self.journal is None:
                    raise
                self._note(str(error))
        self._write([LateEvent(kind, text, time.time())])

    def flush(self) -> None:
        """Return when all that is known so far is on the disk: in the store, or in its journal."""
        if not self.fault or self.journal is None:
            try:
                self._commit(self.store.flush)
                return
            except StoreError as error:
                if self.journal is None:
                    raise
                self._note(str(error))
        self._write([])

    def arrived(self) -> list[tuple[str, int]]:
        """The numbers of labels, by their decisions, that waited in the journal until now; each once."""
        if not self._arrived:
            return []
        with self._lock:
            arrived, self._arrived = self._arrived, []
        return arrived

    def forget(self, decision_id: str) -> None:
        """Look a decision up in the store the next time: what is known of it here is no longer so."""
        self._recent.pop(decision_id, None)

    def ask(self, work: Callable[[], T]) -> T:
        """Call the store with the time limit; StoreError where it is away."""
        return self._ask(work)

    def close(self) -> None:
        """Write everything, and let the store go: within seconds, whatever the store does; what it can't take stays in
        the journal, for the next engine.
        """
        if not self.usable:
            return
        if self.journal is None or self._thread is None:
            self.store.close()
            self._closed = True
            return
        self.flush()
        self._closed = True
        closing = _Job(self.store.close)
        self._jobs.put(closing)
        self._jobs.put(None)
        if not closing.done.wait(CLOSE) or closing.error is not None:
            log.warning("the store was left, %s holds what it lacks: %s", self.journal.path, closing.error or self.fault)
        else:
            self._thread.join()
        self.journal.close()

    @property
    def usable(self) -> bool:
        """Whether this is the process that opened it, and it was not closed."""
        return os.getpid() == self._pid and not self._closed

    def check(self) -> None:
        """Raise a StoreError in a fork of the process that made this engine, whose ids and labels would mix, after
        closing, and where the store was opened for reading.
        """
        if self._closed:
            raise StoreError("Expected an open engine, got one after close(); open it again.")
        if self._reading:
            raise StoreError("Expected an engine that owns its cell, got one that was opened for reading; open it without.")
        if os.getpid() != self._pid:
            raise StoreError(
                f"Expected the process that opened the engine, {self._pid}, got its fork {os.getpid()}; "
                "open the engine after the fork, in the process that uses it."
            )

    # Limits, and the journal

    def _look_at_the_beat(self) -> None:
        began, wait = self._beat_began, self._wait
        if not self.fault and began is not None and wait is not None and time.monotonic() - began > wait:
            self._note(no_answer(wait))

    def _ask(self, work: Callable[[], T]) -> T:
        if self._owned is None:
            return work()
        if self.fault:
            raise StoreError(f"The store is away: {self.fault} Labels wait in its journal; try this again when it is back.")
        job = _Job(work)
        self._jobs.put(job)
        if not job.done.wait(self._wait):
            raise StoreError(no_answer(self._wait or 0.0))
        if job.error is not None:
            raise job.error
        result: T = job.result
        return result

    def _commit(self, work: Callable[[], T]) -> T:
        """Call the store; where that succeeds, all decisions before it are committed as well."""
        with self._lock:
            before = list(self._unsafe)
        result = self._ask(work)
        self._settled(before)
        return result

    def _settled(self, names: Sequence[str]) -> None:
        with self._lock:
            for name in names:
                self._unsafe.pop(name, None)

    def _note(self, fault: str) -> None:
        with self._lock:
            if not self.fault:
                self._fault_began = time.monotonic()
                log.warning("labels wait in the journal %s: %s", self.journal and self.journal.path, fault)
            self.fault = fault

    def _spill(self) -> None:
        if len(self._unsafe) > WAITING:
            try:
                self._write([])
            except StoreError as error:
                self._note(f"{error}")

    def _write(self, records: Sequence[Record]) -> None:
        """Append decisions that are not known to be committed, then records, to the journal; StoreError where it fails."""
        assert self.journal is not None  # the callers asked; for the type checker
        with self._lock:
            decisions = list(self._unsafe.values())
            if not decisions and not records:
                return
            offsets = self.journal.append([to_bytes(record) for record in [*decisions, *records]])
            names = [item.decision.id for item in decisions]
            self._written |= dict(zip(names, offsets, strict=False))
            self._settled(names)

    def _refuse_repeats(self, labels: Sequence[NewLabel]) -> None:
        for label in labels:
            known = self._recent.get(label.decision_id)
            if known is not None and known.success is not None and known.source is not None:
                raise already_reported(known.id, (known.success, known.source), (label.success, label.source))

    def _remember(self, labels: Sequence[NewLabel]) -> None:
        for label in labels:
            known = self._recent.get(label.decision_id)
            if known is not None:
                self._recent[label.decision_id] = replace(known, success=label.success, source=label.source)

    # The keeper's thread

    def _serve(self) -> None:
        while self.journal is not None and self.journal.open:
            try:
                job = self._jobs.get(timeout=BEAT)
            except queue.Empty:
                self._beat()
                continue
            if job is None:
                return
            job.run()
            if self.fault:
                self._beat()

    def _beat(self) -> None:
        """Look whether the store is there; where it was not, and now is, play the journal back."""
        assert self.journal is not None  # only then there is a thread; for the type checker
        with self._lock:
            before = list(self._unsafe)
        if not (before or self.fault):
            return
        self._beat_began = time.monotonic()
        try:
            self.store.flush()
            if self.fault:
                self._play_back(self.journal)
            self._settled(before)
        except Exception as error:  # whatever it is, the cell goes on, and this thread too
            self._note(str(error))
        finally:
            self._beat_began = None

    def _play_back(self, journal: Journal) -> None:
        begin = max(self._played, HEADER)
        while True:
            batch: list[Record] = []
            with self._lock:
                for end, blob in journal.records(begin):
                    batch.append(from_bytes(blob))
                    begin = end
                    if len(batch) == CHUNK:
                        break
                if not batch and self._unsafe:  # of the time without the store, and not in the journal
                    batch += self._unsafe.values()
                if not batch:
                    journal.clear()
                    self._played, self._written, self._labelled = 0, {}, {}
                    if self.fault:
                        log.warning("the store is back; its journal was played back")
                    self.fault = ""
                    return
            assert self._owned is not None  # whose journal it is; for the type checker
            arrived, refused = self._owned.play_back(batch)
            for text in refused:
                self.store.put_event("set aside", text)
                log.error("set aside: %s", text)
            with self._lock:
                self._arrived += arrived
                self._played = begin
            self._settled([record.decision.id for record in batch if isinstance(record, DecidedTrace)])


def no_answer(wait: float) -> str:
    """Say that the store is slow, or frozen: what is told of no answer may yet come."""
    return f"no answer from the store within {wait:g} s."
