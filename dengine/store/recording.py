"""`Recorder`: appends what an engine records to its cell's journal, and syncs that to the disk, in
a thread of its own. `draining.Drainer` takes the synced records from it; `JournalledStore` has
both.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import islice

from ..errors import NotTakenError, log
from .journal import Journal, LostJournalError, Record, encode_record
from .records import CHUNK, Clock, new_event

BATCH_SECONDS = 0.05  # a record waits so long for others before they are written together
RETRY_SECONDS = 1.0  # between two attempts after a failure
LONG = 8 << 20  # bytes of a journal that is to be cleared


@dataclass(slots=True, eq=False)
class Entry:
    """A record on its way into the database.

    Attributes
    ----------
    record : StoredDecision, NewLabel or Event
    offset, end : int
        The bytes that it takes in the journal, from `offset` to before `end`; 0 until it is synced.
    time : float
        When it was recorded, by `time.monotonic`.
    """

    record: Record
    offset: int = 0
    end: int = 0
    time: float = field(default_factory=time.monotonic)

    @property
    def is_synced(self) -> bool:
        """Whether it is in the journal, and synced."""
        return self.end > 0


class Recorder:
    """Takes records, and writes them to a journal in batches.

    The records also stay in memory until they are drained, however many they are: about 5 kB for a
    decision with a trace of 1,000 samples.

    `start` starts its thread, and `stop` ends it.

    Parameters
    ----------
    journal : Journal
    clock : callable
        Returns the time, in seconds since 1970.
    limit : float
        Seconds after which a sync counts as a fault.

    Attributes
    ----------
    journal, limit
        As given.
    changed : threading.Condition
        With a reentrant lock. It guards this object, and is notified of every change.
    unwritten, synced : deque of Entry
        Records that are not on disk, and those that are, oldest first; who drains the latter takes
        them out.
    n_recorded, n_synced : int
        Numbers of records since the opening: of all, and of those that are on disk.
    needs_drain : bool
        The journal is long, and is cleared if its records are drained at once.
    """

    def __init__(self, journal: Journal, clock: Clock, limit: float) -> None:
        self.synced: deque[Entry] = deque()
        self.n_recorded = 0
        self.n_synced = 0
        self.needs_drain = False
        self.journal = journal
        self._clock = clock
        self.limit = limit
        self.changed = threading.Condition()
        self.unwritten: deque[Entry] = deque()
        self._wanted = 0  # up to this record somebody waits for a sync
        self._n_failed = 0  # writes
        self._began = math.inf  # the sync under way, by `time.monotonic`
        self._error = ""
        self._stopped = False

    @property
    def fault(self) -> str:
        """Why the journal cannot be written: the last error, or that a sync takes too long.

        The journal is the log on the local disk that gets each record first. A sync takes too long
        if it has not ended after `limit` seconds, an argument of `Recorder`. "" if the journal can
        be written.
        """
        seconds = time.monotonic() - self._began
        if self._error or seconds <= self.limit:
            return self._error
        return f"the disk has not answered for {seconds:.1f} s."

    @property
    def is_syncing(self) -> bool:
        """Whether the thread is writing a batch to the journal, or waits for its sync."""
        return not math.isinf(self._began)

    def record(self, record: Record) -> Entry:
        """Add a record in memory, and wake the thread that writes it to the journal.

        A record is a decision, a label or an event. Return at once its `Entry`, which will say
        where it stands in the journal, a log on the local disk. If the disk answers, the thread
        writes it within about BATCH_SECONDS (0.05 s), together with others; after a failed write it
        tries again up to RETRY_SECONDS (1 s) later. Before `start` and after `stop` the record only
        stays in memory, without an error. There is no limit to the number of records that wait.
        """
        entry = Entry(record)
        with self.changed:
            self.n_recorded += 1
            if not self.unwritten:  # else the thread is awake already
                self.changed.notify_all()
            self.unwritten.append(entry)
        return entry

    def record_event(self, kind: str, text: str) -> None:
        """Add an event with the present time in memory, and wake the thread that writes it."""
        self.record(new_event(kind, text, self._clock()))

    def request_sync(self) -> None:
        """Ask that everything recorded so far be written to the disk at once; do not wait."""
        with self.changed:
            self._wanted = self.n_recorded
            self.changed.notify_all()

    def sync(self, seconds: float | None = None) -> None:
        """Wait until everything recorded so far is on the disk, at most `seconds`.

        None: `limit` seconds, an argument of `Recorder`. If everything is on disk already, this
        returns at once; else the records are written without the usual delay. Raise NotTakenError
        if that takes longer, or a write fails meanwhile. The records are not lost then: the thread,
        unless it was stopped, tries to write them again.
        """
        limit = self.limit if seconds is None else seconds
        with self.changed:
            place = self.n_recorded
            n_failed = self._n_failed
            self.request_sync()
            self.changed.wait_for(
                lambda: self.n_synced >= place or self._n_failed > n_failed, limit
            )
            if self.n_synced < place:
                reason = self._error or f"the disk gave no answer within {limit:g} s."
                raise NotTakenError(
                    f"The record may not be on disk: {reason} "
                    "Report the same again; once the disk answers it is taken, and counts once."
                )

    def start(self, kept: object = None) -> None:
        """Start the thread that writes, and keep an object alive as long as it runs.

        Pass as `kept` the object that owns the SQLite connection. SQLite syncs when it frees a
        connection; if that happened at the end of the process, while the disk hangs, the process
        would never end.
        """
        self._thread = threading.Thread(
            target=self._run, args=(kept,), name="dengine-journal", daemon=True
        )
        self._thread.start()

    def stop(self, seconds: float) -> bool:
        """End the thread, wait for it, and return whether it ended within these seconds.

        Before it ends, the thread writes the records that wait to the journal, a log on the local
        disk. At the first error it ends at once: the records that are left stay unwritten, and
        nothing is raised. If it does not end in time, it goes on. The thread must have been
        started.
        """
        with self.changed:
            self._stopped = True
            self.changed.notify_all()
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def _run(self, kept: object) -> None:
        """Write new records to the journal, a log on disk, and sync it, in batches until stopped.

        The thread runs this; `kept` is only kept alive by it. A batch has the oldest records, at
        most CHUNK (500). It begins BATCH_SECONDS (0.05 s) after there is a record, or at once if
        somebody waits for the disk or the thread is stopped. Before the thread ends, it writes the
        records that wait. After an error, which is kept for `fault` and not logged, it wakes those
        who wait in `sync`, and tries the records again a second later or sooner, unless it was
        stopped: they then stay unwritten.
        """
        while True:
            with self.changed:
                self.changed.wait_for(lambda: self.unwritten or self._stopped)
                self.changed.wait_for(
                    lambda: self._wanted > self.n_synced or self._stopped, BATCH_SECONDS
                )
                batch = list(islice(self.unwritten, CHUNK))  # or a long outage costs ever more
                if not batch:
                    return
                self._began = time.monotonic()
            try:
                self._write(batch)
            except Exception as error:  # whatever it is, the cell goes on, and this thread too
                with self.changed:
                    self._error = str(error)
                    self._n_failed += 1
                    self._began = math.inf
                    self.changed.notify_all()
                    if self._stopped:
                        return
                    self.changed.wait(RETRY_SECONDS)

    def _write(self, batch: Sequence[Entry]) -> None:
        """Append a batch of records to the journal, sync it, and move them to the queue `synced`.

        The journal is the log on the local disk. The records are the oldest of the queue
        `unwritten`, and leave it. Each gets its `offset` and `end`, the last error is cleared, and
        threads that wait for `changed` are woken. A journal of more than 8 MiB is cleared first, if
        the `Drainer` copies its last records to the database within BATCH_SECONDS (0.05 s). If the
        journal's file was deleted, moved or replaced, it is created again, which is logged and
        recorded as an event (a row of the store's log): records that the database lacks are copied
        into it from the lost file, which is still open, and a file that is at its path by now is
        written over. Raise StoreError if the disk fails, if that file cannot be created or is
        locked by another engine, or if the lost file cannot be read or was cut off before the
        database had its records (the journal then still uses the lost file); the entries then stay
        in `unwritten`.
        """
        journal = self.journal
        if journal.end > LONG:  # a cell that never pauses would fill the disk
            with self.changed:
                self.needs_drain = True
                self.changed.notify_all()
                is_drained = self.changed.wait_for(lambda: journal.is_drained, BATCH_SECONDS)
                self.needs_drain = False
            if is_drained:  # without the lock: a disk that hangs would hang the cell
                journal.clear()
        blobs = [encode_record(entry.record) for entry in batch]
        try:
            offsets = journal.append(blobs, self._clock())
        except LostJournalError as error:
            log.error("%s It is created again with what the store lacks.", error)
            with self.changed:  # nobody reads it or writes its header meanwhile
                journal.recreate()
            self.record_event(
                "journal", f"{error} It was created again with what the store lacked."
            )
            offsets = journal.append(blobs, self._clock())
        with self.changed:
            ends = [*offsets[1:], journal.end]
            for entry, offset, end in zip(batch, offsets, ends, strict=True):
                entry.offset = offset
                entry.end = end
                self.synced.append(self.unwritten.popleft())
            self.n_synced += len(batch)
            self._error = ""
            self._began = math.inf
            self.changed.notify_all()
