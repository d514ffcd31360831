"""`Drainer`: copies ("drains") the synced records of a cell's journal into its database, and makes
the engine's calls to the database, in a thread of its own. So no call of the engine waits longer
than a time limit, even where the database does not answer. `JournalledStore` has one.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from itertools import chain, islice
from typing import TYPE_CHECKING, Any

from ..errors import StoreError, log
from .lookup import DecisionIndex
from .recording import RETRY_SECONDS, Recorder
from .records import CHUNK, DATA_LOST, LOSS_REMEDY, LabelNumbers, T

if TYPE_CHECKING:
    from .sql import SqlStore

DRAIN_SECONDS = 0.25  # synced records wait so long for others before they are drained together
LAG_SECONDS = 1.0  # a larger lag is a fault of the store
Call = tuple[Future[Any], Callable[[], Any]]  # what the thread is to call, and its result


class Drainer:
    """Commits to a database the records that a `Recorder` has written to the journal.

    `start` starts its thread, and `stop` ends it.

    Parameters
    ----------
    store : SqlStore
    recorder : Recorder
        Its limit holds for `drain` as well.
    index : DecisionIndex
        Records that the database has are removed from it.

    Attributes
    ----------
    n_drained : int
        Number of records that the database has, of those recorded since the opening.
    """

    def __init__(
        self,
        store: SqlStore,
        recorder: Recorder,
        index: DecisionIndex,
    ) -> None:
        self.n_drained = 0
        self._store = store
        self._journal = recorder.journal
        self._recorder = recorder
        self._index = index
        self._changed = recorder.changed
        self._wanted = 0  # up to this record somebody waits for the database
        self._error = ""
        self._label_numbers: LabelNumbers = []  # of a product, not yet collected
        self._calls: deque[Call] = deque()
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="dengine-store", daemon=True)

    @property
    def is_drained(self) -> bool:
        """Whether the database has every record."""
        return self.n_drained == self._recorder.n_recorded

    @property
    def lag(self) -> float:
        """Age in seconds of the oldest record that the database lacks; 0.0 if none."""
        with self._changed:
            oldest = next(chain(self._recorder.synced, self._recorder.unwritten), None)
        return 0.0 if oldest is None else time.monotonic() - oldest.time

    @property
    def fault(self) -> str:
        """Why the store cannot be written or read at present; "" if it can.

        Records are written to the journal, a local file, and copied from there to the database. The
        first of these is given: why the journal cannot be written; the last error of the copying or
        timeout of `drain`, until the copying succeeds again; that the oldest record has waited for
        the database longer than `limit` (the seconds that a call waits at most) and than
        LAG_SECONDS (1 s).
        """
        fault = self._recorder.fault or self._error
        lag = self.lag
        if fault or lag <= max(LAG_SECONDS, self._recorder.limit):
            return fault
        return f"no answer from the store for {lag:.1f} s."

    def request(self) -> None:
        """Ask that all records so far be written to the journal's disk and the database at once.

        It does not wait, and says nothing of the result. Later records may go with them.
        """
        with self._changed:
            self._wanted = self._recorder.n_recorded
            self._recorder.request_sync()

    def drain(self, seconds: float | None = None) -> None:
        """Have everything recorded so far copied to the database, and wait for it.

        If the database has everything, nothing is done. Raise StoreError if this takes longer than
        `seconds` (None: `limit`), or as soon as there is a `fault`, which is a reason why the store
        cannot be used now; the copying is requested even so. The records then stay in the journal
        (a local file), or in memory if the disk fails, and are copied later. After a timeout there
        is a `fault` until the database takes records again.
        """
        limit = self._recorder.limit if seconds is None else seconds
        with self._changed:
            if self.is_drained:
                return
            self.request()
            place = self._wanted
            if not self._changed.wait_for(
                lambda: self.n_drained >= place or bool(self.fault), limit
            ):
                self._error = f"no answer from the store within {limit:g} s."
            if self.n_drained < place:
                raise self._unavailable()

    def _unavailable(self) -> StoreError:
        """Return the StoreError for a store that cannot be reached now; it names the `fault`."""
        return StoreError(
            f"The store is unavailable: {self.fault} Labels wait in its journal; "
            "try this again when it is back."
        )

    def pop_label_numbers(self) -> LabelNumbers:
        """Return (decision id, label number) of each label that was drained since the last call.

        To drain a label is to copy it from the journal, a local file, to the database. Labels are
        numbered in the database. The pairs are in the order in which the labels were drained. A
        report that repeats a stored label has the number of that label. A late stop (a report that
        an accepted part was bad, after it had counted as good) has the number of the label that it
        corrects. There is no pair for a dead letter (a label that the database did not take, and
        that became an event), or for a label that an earlier process left in the journal. Without a
        product (robot cells that share labels and versions) the list is empty.
        """
        with self._changed:
            numbers = self._label_numbers
            self._label_numbers = []
        return numbers

    def submit(self, call: Callable[[], T]) -> Future[T]:
        """Have this object's thread, which uses the database, make a call; do not wait for it.

        The calls are made one after another, in their order. Before a call, the thread copies the
        records that are on disk in the journal (a local file) to the database. If this fails, the
        call is made nevertheless.

        Returns
        -------
        Future
            Of the call's result, for `JournalledStore.wait_for_result`.

        Raises
        ------
        StoreError
            If the store cannot be used now (there is a `fault`); the call is then not made. A call
            that is submitted after the thread has ended is not made either, without an error here.
        """
        future: Future[T] = Future()
        with self._changed:
            if self.fault:
                raise self._unavailable()
            self._calls.append((future, call))
            self._changed.notify_all()
        return future

    def start(self) -> None:
        """Start the thread, and have it drain before anybody else uses the store.

        From then on the database's `before_use` is this object's.
        """
        self._thread.start()
        self._store.database.before_use = self._drain_before_use

    def stop(self, seconds: float) -> bool:
        """End the thread, wait for it, and return whether it ended within these seconds.

        Before it ends, the thread copies the records that are on disk in the journal (a local file)
        to the database, unless the database fails, and makes the calls that were submitted. If it
        does not end in time, it goes on. It must have been started.
        """
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def _drain_before_use(self) -> None:
        """Copy the journal's records to the database before somebody reads or writes there.

        `Database` calls this, so that all records are seen. It waits at most `limit` seconds. If
        the store is unavailable, nothing is raised here. In the thread that does the copying, and
        once `stop` was called, it does nothing.
        """
        if not self._stopped and threading.current_thread() is not self._thread:
            with suppress(StoreError):
                self.drain()

    def _run(self) -> None:
        """Copy the records that are on disk in the journal to the database; make submitted calls.

        The journal is a local file that gets each record first.

        The thread runs this until `stop` is called. Before a call all of these records are copied;
        if this fails, the call is made nevertheless. Any error of the copying is kept for `fault`
        (why the store cannot be used now), until it succeeds again. It is logged only if neither an
        earlier error nor a timeout of `drain` is kept there. The database is tried again about a
        second later, or sooner if there is a call. Once stopped, the thread ends when all submitted
        calls are made, and the records are copied or the copying has failed.
        """
        while True:
            call = self._wait_for_work()
            try:
                self._drain_synced()
            except Exception as error:  # whatever it is, the cell goes on, and this thread too
                with self._changed:
                    if not self._error:
                        log.warning("labels wait in the journal beside the store: %s", error)
                    self._error = str(error)
                    self._changed.notify_all()
            if call is not None:
                self._make_call(*call)
            with self._changed:
                has_ended = self._error or not self._recorder.synced
                if self._stopped and has_ended and not self._calls:
                    return
                if self._error:
                    self._changed.wait_for(lambda: self._calls or self._stopped, RETRY_SECONDS)

    def _wait_for_work(self) -> Call | None:
        """Wait until there is a call, `stop` was called, or it is time to drain records.

        To drain records is to copy them from the journal, a local file, to the database. Return the
        oldest submitted call, which leaves the queue, or None if there is none. Records are drained
        DRAIN_SECONDS (0.25 s) after the first of them came, or at once if somebody waits for the
        database, the journal is so long that it is to be cleared, or `stop` was called.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._calls or self._recorder.synced or self._stopped)
            self._changed.wait_for(
                lambda: (
                    self._calls
                    or self._stopped
                    or self._wanted > self.n_drained
                    or self._recorder.needs_drain
                ),
                DRAIN_SECONDS,
            )
            return self._calls.popleft() if self._calls else None

    def _drain_synced(self) -> None:
        """Copy all records that are now on disk in the journal (a local file) to the database.

        They go in chunks of at most CHUNK (500) records, see `_drain_chunk`. A decision that a
        later record replaces is left out. Later records go with them only if they still fit into
        the last chunk. The journal's head, the small file beside it, is synced first; a failure of
        that is ignored. At the end, or at once if there are no records, the last error, which
        `fault` shows, is cleared. Raise StoreError if the database fails: chunks that were
        committed stay, and the last error is kept.
        """
        synced_to = self._recorder.n_synced
        if self.n_drained < synced_to:
            self._journal.sync_head()
        while self.n_drained < synced_to:
            self._drain_chunk()
        self._error = ""

    def _drain_chunk(self) -> None:
        """Commit the oldest records that are on disk in the journal, at most CHUNK (500).

        The journal is a local file that gets each record (decision, label or event) first; at least
        one must wait there. A decision is left out if a later record with the same id replaces it.
        In place of a record that contradicts the store, or that the database refuses, an event is
        stored (a dead letter), and the record counts as drained (copied). The records are committed
        as they are in memory; that some of them are damaged on disk, or cannot be read there, is
        noted by an event, which is also logged.

        Then the journal's header notes that the database has the records (if it cannot be written,
        that is ignored), `n_drained` counts them, and they leave the queue of the recorder and,
        except for the newest decisions, the `DecisionIndex`, by which decisions are found in
        memory. In a product (robot cells that share labels and versions) the numbers of their
        labels are kept for `pop_label_numbers`. Raise StoreError if the database fails; nothing of
        this is done then, and the next call commits the same records again, of which some may be
        stored already.
        """
        with self._changed:
            chunk = list(islice(self._recorder.synced, CHUNK))
        entries = [entry for entry in chunk if not self._index.is_replaced(entry)]
        n_damaged = sum(not self._journal.is_intact(entry.offset) for entry in entries)
        numbers = self._store.apply_records([entry.record for entry in entries])
        if n_damaged:
            self.report(
                "journal",
                f"{n_damaged} records of the journal were damaged on disk and are stored from "
                "memory.",
            )
        with self._changed:
            self._journal.drained_to = chunk[-1].end
            self._journal.head.n_drained += len(chunk)
            self.save_newest_entry()
            if self._store.product is not None:
                self._label_numbers += numbers
            for entry in chunk:
                self._recorder.synced.popleft()
                self._index.remove_drained(entry)
            self.n_drained += len(chunk)
            self._changed.notify_all()

    def report(self, kind: str, text: str) -> None:
        """Log an error, and commit it to the store as an event, directly and not by the journal.

        Raise StoreError if the database fails.
        """
        log.error("%s: %s%s", kind, text, f" {LOSS_REMEDY}" if kind == DATA_LOST else "")
        self._store.events.put(kind, text)

    def save_newest_entry(self) -> None:
        """Write the ledger's newest entry to the journal's header and its head; errors are ignored.

        The next engine compares the store's ledger with it, to find out whether the store was cut
        off.
        """
        with self._changed, suppress(StoreError):  # a broken journal is reported by its next record
            self._journal.save_newest_entry(self._store.database.newest_entry)

    def _make_call(self, future: Future[Any], call: Callable[[], Any]) -> None:
        """Make a submitted call; set the future's result or exception. Nothing is raised here.

        A call whose future was cancelled before is not made. If the future is cancelled while the
        call runs, its transaction is rolled back, and its result or exception is lost; from its
        first commit on, it cannot be cancelled.
        """

        def is_wanted() -> bool:
            """Return whether the future was not cancelled; from then on it cannot be."""
            return future.running() or (
                not future.cancelled() and future.set_running_or_notify_cancel()
            )

        if future.cancelled():
            return
        try:
            with self._store.database.commit_if(is_wanted):
                result = call()
        except BaseException as error:
            if is_wanted():
                future.set_exception(error)
        else:
            if is_wanted():
                future.set_result(result)
