"""Where an engine remembers: the `Store` protocol, and `open_store`, which opens what a user names.

    store = open_store("engine.db")      # SqlStore; `open_store(None)` is a MemoryStore, which forgets

The database behind `SqlStore` lives in `sql.py`, so that importing this module costs numpy and no more.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..errors import StoreError
from ..records import Decision, RetrainReport, Source
from .journal import Journal, Record
from .memory import MemoryStore
from .records import (
    AddedPoints,
    CellAddress,
    Change,
    Correction,
    Event,
    Evidence,
    Key,
    Labelled,
    ModelVersion,
    NewLabel,
    News,
    Outcomes,
    StoredDecision,
    StoredVersion,
)
from .views import HistoryFilter, PastLabel, PastRetrain, Stretch, Tally

UNHURRIED = 10.0  # seconds to wait for a store where no cell waits, as its wait


@runtime_checkable
class Store(Protocol):
    """What an engine needs of its memory. Everything belongs to one cell, `cell_id`.

    product : what the cell makes; None: it shares nothing. Else labels as traces to train on, and versions, are those of
        all the product's cells: `labelled`, `last_version`, `versions`, `retrains`, `corrections`, and the numbers that
        `put_labels` and `put_version` give. What became of decisions stays the cell's own.
    wait : seconds that its engine waits for it at most; None: it answers at once, and has no journal.
    remote : whether it is on a server, which may be away while this machine's disk is well.
    """

    cell_id: str
    product: str | None
    wait: float | None
    remote: bool

    def settings(self) -> dict[str, str]:
        """What `save_settings` was given; {} for a new store."""

    def save_settings(self, settings: Mapping[str, str]) -> None:
        """Replace the settings by these."""

    def peers_settings(self) -> dict[str, dict[str, str]]:
        """Return the settings of the product's other cells, by cell."""

    def put_decision(self, decision: Decision, trace: NDArray[np.float32], content_hash: int, quarantined: bool) -> None:
        """Take a decision and its trace, (C, T) or (T,), without waiting for the disk.

        content_hash : of the trace's content, or of its part's number where one is given.
        """

    def flush(self) -> None:
        """Return when every decision so far is committed."""

    def get_decision(self, decision_id: str) -> StoredDecision | None:
        """Return the decision with its trace, queued ones included; None where it is unknown or forgotten.

        StoreError where the trace is not as it was stored.
        """

    def decision_ids(self) -> list[str]:
        """Return the ids of every decision, in any order."""

    def put_label(
        self, decision_id: str, success: bool, source: Source, model_version: int, point: NDArray[np.float32] | None,
        *, silent: int = 0,
    ) -> int:  # fmt: skip
        """Commit a label, with its decision, before returning its sequence number 1, 2, ...: one of `put_labels`."""

    def put_labels(self, labels: Sequence[NewLabel]) -> NDArray[np.int64]:
        """Commit labels, with their decisions, all or none; returns their sequence numbers, in the order given.

        Raises ReportError for an unknown decision, or for a second label of one.
        """

    def put_labelled(
        self,
        decisions: Sequence[Decision],
        traces: NDArray[np.float32],
        hashes: NDArray[np.int64],
        labels: NDArray[np.int8],
        source: Source,
    ) -> NDArray[np.int64]:
        """Import labelled traces, all or none; returns their sequence numbers."""

    def labelled(
        self, limit: int | None = None, *, first: int = 1, last: int | None = None, corrected_to: int | None = None
    ) -> Labelled:
        """Return the newest `limit` labelled traces, all where it is None, with their labels as they count.

        first, last : sequence numbers between which they lie.
        corrected_to : number of the last correction that counts, for labels as they stood then; None: all do.
        A trace that is not as it was stored is left out; an event names its decision.
        """

    def own_labelled(self) -> Labelled:
        """Return this cell's own labelled traces, all of them, oldest first."""

    def news_since(self, seq: int, limit: int) -> News:
        """Return the labels after `seq`, at most `limit`, and the numbers of the newest version and correction."""

    def points_since(self, seq: int, model_version: int) -> AddedPoints:
        """Return the points of `model_version` that came with labels after `seq`."""

    def evidence_since(self, seq: int, since_version: int = 0) -> Evidence:
        """Return what became of the decisions whose labels came after `seq`, without the quarantined and the forgotten.

        since_version : leave out, here and below, what an earlier model version decided.
        """

    def unreported_accepts(self, since_version: int = 0) -> list[str]:
        """Return the ids of accepted decisions without a label, oldest first, without the quarantined ones."""

    def silent_total(self, since_version: int = 0) -> int:
        """Return how many accepted parts went on unheard of: `silent` over all labels but the quarantined ones."""

    def outcomes(self, since_version: int = 0) -> Outcomes:
        """Count what became of what the model was certain of."""

    def status(self) -> dict[str, Any]:
        """Count decisions, labels and versions; show the newest events."""

    def put_version(self, report: RetrainReport, last_seq: int, state: Mapping[str, NDArray[Any]] | None) -> int:
        """Record a retrain; a dropped candidate has no state. Returns the version's number.

        That is the report's, but where cells share versions and a peer's was stored meanwhile: then the next.
        """

    def last_version(self) -> ModelVersion | None:
        """Return the newest accepted version; of a damaged one an event tells, and the one before it is returned."""

    def load_version(self, version: int) -> ModelVersion:
        """Return an accepted version by its number. VersionError, naming those that can be loaded, where it cannot."""

    def versions(self) -> list[StoredVersion]:
        """Return every retrain, oldest first: its number, time, reason, and whether its state is kept."""

    def retrains(self) -> list[RetrainReport]:
        """Return every retrain, oldest first."""

    def put_event(self, kind: str, text: str, data: Mapping[str, Any] | None = None, author: str = "") -> None:
        """Commit what happened, in a word and for people to read, to the cell's log.

        data : the same for machines, as JSON has it.  author : who did it; "" for the engine itself.
        """

    def events(self, limit: int | None = None) -> list[Event]:
        """Return the newest `limit` events, all where it is None; oldest first."""

    def record(self, change: Change) -> int:
        """Commit what a person changed, all or none, together with its event; returns the event's number.

        Raises ReportError for a decision that is unknown or has no label.
        """

    def corrections(self, after: int = 0) -> list[Correction]:
        """Return the corrections after number `after`, oldest first."""

    def decisions(
        self, where: HistoryFilter, limit: int, beyond: Key | None = None, newest: bool = True
    ) -> list[StoredDecision]:
        """Return the newest (or oldest) `limit` decisions that are meant, oldest first, queued ones included.

        beyond : only those before (or after) this one: the next page.
        """

    def past_decision(self, decision_id: str) -> StoredDecision | None:
        """Return one decision without its trace; None where it is unknown or forgotten."""

    def past_labels(self, after: int, upto: int | None = None, points: bool = False) -> list[PastLabel]:
        """Return the labels after number `after`, up to `upto`, oldest first; points : with them."""

    def past_retrains(self) -> list[PastRetrain]:
        """Return every retrain of this cell, oldest first."""

    def tally(self, last: int | None = None) -> Tally:
        """Count the newest `last` decisions, all where it is None."""

    def stretches(self, n: int) -> list[Stretch]:
        """Cut all decisions into `n` stretches of one length at most, oldest first; the newest may be shorter."""

    def own(self) -> Journal | None:
        """Claim the cell for one engine; its journal, None where there is none. StoreError where another engine has it."""

    def committing(self, wanted: Callable[[], bool]) -> AbstractContextManager[None]:
        """Roll back this thread's transactions that are not wanted any more before their commit."""

    def play_back(self, records: Sequence[Record]) -> tuple[list[tuple[str, int]], list[str]]:
        """Write what a journal held, in one transaction; what is stored already counts as written.

        Returns the numbers of the labels by their decisions, and what could not be written, in words.
        """

    def let_go(self) -> None:
        """Stop and disconnect without writing or waiting: the journal holds what is missing."""

    def close(self) -> None:
        """Flush and let go."""


def open_store(
    store: str | os.PathLike[str] | Store | None, *, must_exist: bool = False, wait: float | None = None
) -> Store:
    """Return the store that a user named: nothing (memory), a file or URL (database), or a store as it is.

    A file or URL may say whose rows it means, and what that cell makes: `address`.
    must_exist : a file or a cell that is not there is a StoreError; by default it is made.
    wait : as `SqlStore` takes it; `UNHURRIED` where no cell waits.
    """
    if store is None:
        return MemoryStore()
    if isinstance(store, str | os.PathLike):
        if must_exist:
            must_be_there(store)
        cell_id, product = (store.cell_id, store.product) if isinstance(store, CellAddress) else ("cell", None)
        from .peers import must_have_cell  # SQLAlchemy is imported where it is used
        from .sql import SqlStore

        if must_exist:
            must_have_cell(os.fspath(store), cell_id)
        return SqlStore(os.fspath(store), cell_id, product=product, wait=wait)
    if not isinstance(store, Store):
        raise StoreError(f"Expected None, a file, a URL or a Store, got {type(store).__name__}; see `Store`.")
    return store


def must_be_there(store: str | os.PathLike[str]) -> None:
    """StoreError for a file that is not there; of a database behind a URL nothing is asked."""
    if "://" not in str(store) and not Path(store).is_file():
        raise StoreError(
            f"Expected a store that an engine has used, found no file {store}; "
            "make a DataEngine with it, or let `dengine train` or `dengine run` make one."
        )


@contextmanager
def opening(
    store: str | os.PathLike[str] | Store | None, *, must_exist: bool = False, wait: float | None = None
) -> Iterator[Store]:
    """`open_store`; where what follows fails, a store that was opened here is closed again."""
    opened = open_store(store, must_exist=must_exist, wait=wait)
    try:
        yield opened
    except BaseException:
        if opened is not store:
            opened.close()
        raise
