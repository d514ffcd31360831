"""The contract of a store whose cell shares what it learns with the other cells of its product.

Where an engine remembers: the `Store` protocol, and `open_store`, which opens what a user names.

    store = open_store("engine.db")      # SqlStore; `open_store(None)` is a MemoryStore, which forgets

The database behind `SqlStore` lives in `sql.py`, so that importing this module costs numpy and no more.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, TypeGuard, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..errors import StoreError
from ..records import Decision, RetrainReport, Source
from .memory import MemoryStore
from .peers import CellAddress, News
from .records import (
    AddedPoints,
    Change,
    Correction,
    Event,
    Evidence,
    Labelled,
    ModelVersion,
    NewLabel,
    Outcomes,
    StoredDecision,
    StoredVersion,
)
from .views import StoreViews

UNHURRIED = 10.0  # seconds to wait for a store where no cell waits, as its wait

__all__ = [
    "UNHURRIED",
    "AddedPoints",
    "Change",
    "Correction",
    "Event",
    "Evidence",
    "Labelled",
    "MemoryStore",
    "ModelVersion",
    "NewLabel",
    "Outcomes",
    "Store",
    "StoredDecision",
    "StoredVersion",
    "open_store",
]


@runtime_checkable
class Store(StoreViews, Protocol):
    """What an engine needs of its memory. Everything belongs to one cell, `cell_id`."""

    cell_id: str

    def settings(self) -> dict[str, str]:
        """What `save_settings` was given; {} for a new store."""

    def save_settings(self, settings: Mapping[str, str]) -> None:
        """Replace the settings by these."""

    def put_decision(
        self,
        decision: Decision,
        trace: NDArray[np.float32],
        content_hash: int,
        quarantined: bool,
    ) -> None:
        """Take a decision and its trace, (C, T) or (T,), without waiting for the disk.

        content_hash : of the trace's content, or of its part's number where one is given.
        """

    def flush(self) -> None:
        """Return when every decision so far is committed."""

    def get_decision(self, decision_id: str) -> StoredDecision | None:
        """Return the decision with its trace, queued ones included; None where it is unknown."""

    def decision_ids(self) -> list[str]:
        """Return the ids of every decision, in any order."""

    def put_label(
        self,
        decision_id: str,
        success: bool,
        source: Source,
        model_version: int,
        point: NDArray[np.float32] | None,
        *,
        silent: int = 0,
    ) -> int:
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

    def put_version(self, report: RetrainReport, last_seq: int, state: Mapping[str, NDArray[Any]] | None) -> int:
        """Record a retrain; a dropped candidate has no state. Returns the version's number.

        That is the report's, but where cells share versions and a sister's was stored meanwhile: then the next.
        """

    def last_version(self) -> ModelVersion | None:
        """Return the newest accepted version; of a damaged one an event tells, and the one before it is returned."""

    def load_version(self, version: int) -> ModelVersion:
        """Return an accepted version by its number. StoreError, naming those that can be loaded, where it cannot."""

    def versions(self) -> list[StoredVersion]:
        """Return every retrain, oldest first: its number, time, reason, and whether its state is kept."""

    def retrains(self) -> list[RetrainReport]:
        """Return every retrain, oldest first."""

    def labelled(
        self, limit: int | None = None, *, first: int = 1, last: int | None = None, corrected_to: int | None = None
    ) -> Labelled:
        """Return the newest `limit` labelled traces, all where it is None, with their labels as they count.

        first, last : sequence numbers between which they lie.
        corrected_to : number of the last correction that counts, for labels as they stood then; None: all do.
        """

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

    def put_event(self, kind: str, text: str, data: Mapping[str, Any] | None = None, author: str = "") -> None:
        """Commit what happened, in a word and for people to read, to the cell's log.

        data : the same for machines, as JSON has it.  author : who did it; "" for the engine itself.
        """

    def record(self, change: Change) -> int:
        """Commit what a person changed, all or none, together with its event; returns the event's number.

        Raises ReportError for a decision that is unknown or has no label.
        """

    def corrections(self, after: int = 0) -> list[Correction]:
        """Return the corrections after number `after`, oldest first."""

    def events(self, limit: int | None = None) -> list[Event]:
        """Return the newest `limit` events, all where it is None; oldest first."""

    def status(self) -> dict[str, Any]:
        """Count decisions, labels and versions; show the newest events."""

    def close(self) -> None:
        """Flush and let go."""


def open_store(
    store: str | os.PathLike[str] | Store | None, *, must_exist: bool = False, wait: float | None = None
) -> Store:
    """Return the store that a user named: nothing (memory), a file or URL (database), or a store as it is.

    A file or URL may say whose rows it means, and what that cell makes: `fleet.address`.
    must_exist : a file or a cell that is not there is a StoreError; by default it is made.
    wait : as `SqlStore` takes it; `UNHURRIED` where no cell waits.
    """
    if store is None:
        return MemoryStore()
    if isinstance(store, str | os.PathLike):
        if must_exist:
            must_be_there(store)
        from .peers import must_have_cell
        from .sql import SqlStore  # SQLAlchemy is imported where it is used

        cell_id, product = (store.cell_id, store.product) if isinstance(store, CellAddress) else ("cell", None)
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


class SharedStore(Store, Protocol):
    """A `Store` of a cell that has a product.

    Labels as traces to train on, and versions, are then those of all the product's cells: `labelled`, `last_version`,
    `retrains`, and the numbers that `put_labels` and `put_version` give. What became of decisions stays the cell's own.
    """

    product: str | None

    def news_since(self, seq: int, limit: int) -> News:
        """Return labels of the product after `seq`, at most `limit`, and the number of its newest version."""

    def own_labelled(self) -> Labelled:
        """Return this cell's own labelled traces, all of them, oldest first."""

    def sisters_settings(self) -> dict[str, dict[str, str]]:
        """Return the settings of the product's other cells, by cell."""


def is_shared(store: Store) -> TypeGuard[SharedStore]:
    """Whether a store's cell has a product."""
    return getattr(store, "product", None) is not None
