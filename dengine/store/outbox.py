"""`Outbox`: what an engine needs of its store while a cell runs, to record and to look up. There
are two: `JournalledStore` for a cell, with a journal on the local disk between engine and database,
and `MemoryStore` for replays and tests, and for an engine that only reads. `opening.open_outbox`
makes the one that fits a store.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

from ..errors import StoreError, log
from ..records import Arrays, RetrainReport
from .journal import forked_error
from .records import LabelNumbers, NewLabel, StoredDecision, T

if TYPE_CHECKING:
    from .sql import SqlStore


class Outbox(ABC):
    """Records what an engine decides and learns, and asks its store for it.

    Every `record_*` method returns at once; `sync` waits for the disk, `drain` until the database
    has taken ("drained") the records. What is not abstract here is as for a store that is always at
    hand: nothing is waited for.

    Parameters
    ----------
    store : SqlStore
        Where the records end.
    window : int
        Number of newest labels that the engine reads, and whose integrity is therefore checked.
    limit : float
        Seconds that a call waits at most.
    reading : bool, default False
        The engine only reads: `check_usable` raises.

    Attributes
    ----------
    n_decisions : int
        Number of the newest recorded decision.
    integrity_error : str
        What in the store is not as it was written, so that every part must be verified; "" if
        nothing is.
    is_thread_safe : bool
        Whether any thread may record and look up decisions while another one uses the engine.
    """

    is_thread_safe = True

    def __init__(self, store: SqlStore, window: int, limit: float, reading: bool = False) -> None:
        self.store = store
        self.limit = limit
        self.n_decisions = 0
        self.integrity_error = ""
        self._newest_label = 0
        self._window = window
        self._reading = reading
        self._pid = os.getpid()
        self._closed = False

    # State

    @property
    def is_usable(self) -> bool:
        """Whether this is the process that opened it, and it is not closed."""
        return os.getpid() == self._pid and not self._closed

    def check_usable(self) -> None:
        """Raise StoreError if the `DataEngine` is closed, only reads, or was opened before a fork.

        To use what was opened before a fork is an error only in the child process. Faults of the
        store, and rows that are not as they were written (`integrity_error`), are not raised.
        """
        if os.getpid() != self._pid:
            raise forked_error(self._pid, "the engine")
        if self._closed:
            raise StoreError("Expected an open engine, got one after close(); open it again.")
        if self._reading:
            raise StoreError(
                "Expected an engine that owns its cell, got one that was opened for reading; "
                "open it without."
            )

    def check_integrity(self, since: int | None = None) -> None:
        """Compare what the engine reads from the store with the ledger; set `integrity_error`.

        A difference is logged, and only the first is kept. Raise StoreError only if the database
        cannot be read.

        Parameters
        ----------
        since : int or None
            Labels after this number are checked; None: the newest `window`.
        """
        self._note_integrity(self.store.database.check_integrity(self._window, since))

    def _note_integrity(self, error: str) -> None:
        """Set `integrity_error` to what in the store is not as it was written, and log it.

        If it is set already, or `error` is "", nothing changes, and nothing is logged. Advice for
        the user is added to the text.

        From then on the engine decides VERIFY (the slow check must measure the part) on every part,
        without asking the model, until the store is opened again.
        """
        if error and not self.integrity_error:
            self.integrity_error = (
                f"{error}; see `dengine verify`, and restore the store from a copy."
            )
            log.error("every part is verified: %s", self.integrity_error)

    @property
    def verify_all_reason(self) -> str:
        """Why every part must be verified: an integrity error, or a journal that cannot be written.

        "" if neither. This default, for an outbox without a journal, is the `integrity_error`.
        """
        return self.integrity_error

    @property
    def fault(self) -> str:
        """What is wrong with the store or the journal at present; "" if nothing is.

        This default, for an outbox without a journal, is the `integrity_error`.
        """
        return self.integrity_error

    @property
    def lag(self) -> float:
        """Age in seconds of the oldest record that the database lacks; 0.0 if none.

        This default, for an outbox without a journal, is always 0.0.
        """
        return 0.0

    @property
    def is_drained(self) -> bool:
        """Whether the database has taken every record.

        This default, for an outbox without a journal, is always True.
        """
        return True

    # What the engine records

    @abstractmethod
    def record_decision(self, item: StoredDecision) -> StoredDecision:
        """Record a new decision without waiting for disk or database.

        Parameters
        ----------
        item : StoredDecision
            The decision with its trace.

        Returns
        -------
        StoredDecision
            A copy of `item` with its number, the cell's next one. If one of the newest 1,000
            decisions of a `JournalledStore` has the same id, that decision is returned, and nothing
            is recorded; a `MemoryStore` does not check this.
        """

    def replace_decision(self, item: StoredDecision) -> StoredDecision:
        """Replace a recorded decision that was not returned to the caller yet, under the same id.

        Time, trace and number stay those of the first decision.

        Returns
        -------
        StoredDecision
            The new decision; or the first decision, unchanged, if it is in the journal or the
            database by now.

        Raises
        ------
        KeyError
            If no decision with this id is in memory. Always for a store in memory, of which no
            decision is late.
        """
        raise KeyError(item.decision.id)

    def number_label(self) -> int:
        """Return the next number for a new label; each call uses up a number.

        The numbers go on from the newest label of the cell's store. In a product they are negative
        and only provisional, since the store numbers the labels of all its cells:
        `pop_label_numbers` says which number a label got.
        """
        self._newest_label += 1 if self.store.product is None else -1
        return self._newest_label

    def _continue_numbers(self) -> None:
        """Go on with the numbers of decisions and labels that the store holds.

        In a product the store numbers the labels, so they are left at 0 here.
        """
        self.n_decisions = self.store.decisions.newest_number()
        if self.store.product is None:
            self._newest_label = self.store.labels.newest()

    @abstractmethod
    def record_labels(self, labels: Iterable[tuple[StoredDecision, NewLabel]]) -> None:
        """Record labels of decisions without waiting; the labels that are passed are not changed.

        Each gets the present time, and the hash and the time of its decision.

        Parameters
        ----------
        labels : iterable of (StoredDecision, NewLabel)
            Each label, with a number of `number_label`, and its decision.
        """

    def _completed(self, item: StoredDecision, label: NewLabel) -> NewLabel:
        """Return a copy of a label with the present time, and its decision's hash and time."""
        return replace(
            label, time=self.store.clock(), content_hash=item.content_hash, decided=item.time
        )

    @abstractmethod
    def record_event(self, kind: str, text: str) -> None:
        """Record an event with the present time, without waiting.

        Parameters
        ----------
        kind : str
            In a word.
        text : str
            For people.
        """

    def sync(self, seconds: float | None = None) -> None:  # noqa: B027  # a default
        """Wait until everything that was recorded so far is on the disk.

        This default, for an outbox without a journal, does nothing.

        Parameters
        ----------
        seconds : float or None
            The longest to wait; None: `limit`.

        Raises
        ------
        NotTakenError
            If that takes too long, or fails; never for a store in memory. Recording the same again
            is harmless.
        """

    def drain(self) -> None:  # noqa: B027  # a default
        """Wait until the database has taken everything recorded so far, at most `limit` seconds.

        This default, for an outbox without a journal, does nothing.

        Raises
        ------
        StoreError
            If the store is unavailable, or takes too long. The records are drained later.
        """

    def flush(self, seconds: float | None = None) -> None:
        """Wait until every record is on disk, and then in the database unless it is unavailable.

        Each of the two waits is limited.

        Parameters
        ----------
        seconds : float or None
            The longest to wait for the disk; None: `limit`. The database is waited for `limit`
            seconds.

        Raises
        ------
        NotTakenError
            As of `sync`. That the store is unavailable is no error.
        """
        self.sync(seconds)
        with suppress(StoreError):
            self.drain()

    def request_label_drain(self) -> bool:
        """If the database lacks a label, ask that all records be copied there now; do not wait.

        Return whether it lacks a label. This default, for an outbox without a journal, only returns
        False.
        """
        return False

    def pop_label_numbers(self) -> LabelNumbers:
        """Return (decision id, label number) of each label that was drained since the last call.

        They are in the order in which they were drained. A report that repeats a stored label has
        the number of that label. A label that the store refused has no pair. Without a product the
        list is empty. This default, for an outbox without a journal, always returns [].
        """
        return []

    # What the engine asks

    @abstractmethod
    def find_decision(self, decision_id: str, unsynced: bool = False) -> StoredDecision | None:
        """Return a decision with its label, from memory or the database.

        A decision is found as soon as it is recorded. The database is asked only if the id may be
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
            If the database is needed and unavailable, and if the stored trace is damaged. Also if
            the last decision for this id was not recorded, because the id could not be looked up.
        """

    def find_earlier(self, decision_id: str) -> StoredDecision | None:
        """Return the decision that an id already has, or None if the id is new.

        It comes with its label if that is on disk. This default, for an outbox without a journal,
        is `find_decision`.

        Raises
        ------
        StoreError
            If the id cannot be looked up. From then on `find_decision` raises StoreError for this
            id too, until a decision is recorded for it or this method has looked it up.
        """
        return self.find_decision(decision_id)

    def load_ids(self) -> None:  # noqa: B027  # a default
        """Load the ids of all decisions, so that a new id is recognized without the database.

        Another call does nothing. Raise StoreError if the database cannot be read. This default,
        for an outbox without a journal, does nothing.
        """

    def evict_decision(self, decision_id: str) -> None:  # noqa: B027  # a default
        """Drop a decision from memory, so that it is read from the database again.

        What the database lacks is not dropped. This default, for an outbox without a journal, does
        nothing.
        """

    def call_store(self, call: Callable[[], T]) -> T:
        """Run a call of the store, and return its result within `limit` seconds.

        Raise StoreError if the store is unavailable or takes too long, and whatever `call` raises.
        This default, for an outbox without a journal, makes the call in this thread and has no time
        limit.
        """
        return call()

    @abstractmethod
    def store_version(
        self, report: RetrainReport, last_seq: int, state: Arrays | None
    ) -> Future[int]:
        """Begin to commit a retrain, and return without waiting.

        Parameters
        ----------
        report, last_seq, state
            As of `VersionTable.put`.

        Returns
        -------
        Future
            Of the version's number, for `wait_for_result`.

        Raises
        ------
        StoreError
            If the store is unavailable.
        """

    def wait_for_result(self, future: Future[T]) -> T:
        """Return the result of a future of `store_version`, or raise what the commit raised.

        This default, for an outbox without a journal, has no time limit.

        Raises
        ------
        StoreError
            If it takes longer than `limit`. The commit is then cancelled. A commit that is already
            under way cannot be cancelled, and gets some seconds more; if StoreError is raised after
            these, the version may still have been committed, or be committed later.
        """
        return future.result()

    @abstractmethod
    def close(self) -> None:
        """Write what can be written within seconds, and let another engine own the robot cell.

        With a journal a second call does nothing, nor does one in a forked process.
        """
