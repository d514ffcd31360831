"""Where an engine remembers: the `Store` protocol."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..records import Decision, RetrainReport, Source
from .journal import Journal, Record
from .records import (
    AddedPoints,
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
from .views import HistoryFilter, PastLabel, Stretch, Tally


@runtime_checkable
class Store(Protocol):
    """What an engine needs of its memory. Everything belongs to one cell, `cell_id`.

    product : what the cell makes; None: it shares nothing. Else labels as traces to train on, and versions, are those of
        all the product's cells: `labelled`, `last_version`, `versions`, `retrains`, `corrections`, and the numbers that
        `put_labels` and `put_version` give. What became of decisions stays the cell's own.
    wait : seconds that its engine waits for it at most; None: it answers at once, and has no journal.
    clock : the time in seconds that rows are stamped with.
    before_use : called before each use of it but `take`, so that it sees what is on its way into it.
    """

    cell_id: str
    product: str | None
    wait: float | None
    clock: Callable[[], float]
    before_use: Callable[[], None]

    def settings(self) -> dict[str, str]:
        """What `save_settings` was given; {} for a new store."""

    def save_settings(self, settings: Mapping[str, str]) -> None:
        """Replace the settings by these."""

    def peers_settings(self) -> dict[str, dict[str, str]]:
        """Return the settings of the product's other cells, by cell."""
        return {}

    def put_decision(self, decision: Decision, trace: NDArray[np.float32], content_hash: int, quarantined: bool) -> None:
        """Commit a decision and its trace, (C, T) or (T,).

        content_hash : of the trace's content, or of its part's number where one is given.
        """

    def flush(self) -> None:
        """Return when all that is on its way into it is there, as far as it comes in time."""
        self.before_use()

    def get_decision(self, decision_id: str, trace: bool = True) -> StoredDecision | None:
        """Return the decision; None where it is unknown or forgotten.

        trace : with it; StoreError where it is not as it was stored.
        """

    def decision_ids(self) -> list[str]:
        """Return the ids of every decision, in any order."""

    def put_label(
        self, decision_id: str, success: bool, source: Source, model_version: int, point: NDArray[np.float32] | None,
        *, silent: int = 0,
    ) -> int:  # fmt: skip
        """Commit a label, with its decision, before returning its sequence number 1, 2, ...: one of `put_labels`."""
        return int(self.put_labels([NewLabel(decision_id, success, source, model_version, point, silent)])[0])

    def put_labels(self, labels: Sequence[NewLabel]) -> NDArray[np.int64]:
        """Commit labels, with their decisions, all or none; returns their sequence numbers, in the order given.

        Raises ReportError for an unknown decision, or for a second label of one.
        """

    def labelled(
        self,
        limit: int | None = None,
        *,
        first: int = 1,
        last: int | None = None,
        corrected_to: int | None = None,
        own: bool = False,
    ) -> Labelled:
        """Return the newest `limit` labelled traces, all where it is None, with their labels as they count.

        first, last : sequence numbers between which they lie.
        corrected_to : number of the last correction that counts, for labels as they stood then; None: all do.
        own : of this cell alone, where others share its product.
        A trace that is not as it was stored is left out; an event names its decision.
        """

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

    def versions(self, own: bool = False) -> list[StoredVersion]:
        """Return every retrain, oldest first: its number, time, report, and whether its state is kept.

        own : this cell's alone.
        """

    def retrains(self) -> list[RetrainReport]:
        """Return every retrain, oldest first."""
        return [each.report for each in self.versions()]

    def put_event(self, kind: str, text: str, data: Mapping[str, Any] | None = None, author: str = "") -> None:
        """Commit what happened, in a word and for people to read, to the cell's log.

        data : the same for machines, as JSON has it.  author : who did it; "" for the engine itself.
        """
        self.record(Change(kind, text, data, author))

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
        """Return the newest (or oldest) `limit` decisions that are meant, oldest first.

        beyond : only those before (or after) this one: the next page.
        """

    def past_labels(self, after: int, upto: int | None = None, points: bool = False) -> list[PastLabel]:
        """Return the labels after number `after`, up to `upto`, oldest first; points : with them."""

    def tally(self, last: int | None = None) -> Tally:
        """Count the newest `last` decisions, all where it is None."""

    def stretches(self, n: int) -> list[Stretch]:
        """Cut all decisions into `n` stretches of one length at most, oldest first; the newest may be shorter."""

    def own(self) -> Journal | None:
        """Claim the cell for one engine; its journal, None where there is none. StoreError where another engine has it."""
        return None

    def committing(self, wanted: Callable[[], bool]) -> AbstractContextManager[None]:
        """Roll back this thread's transactions that are not wanted any more before their commit."""
        return nullcontext()

    def take(self, records: Sequence[Record]) -> list[tuple[str, int]]:
        """Commit what a journal holds, all or none; returns the numbers of its labels by their decisions.

        What is there already, and is the same, counts as taken. Another decision of the same id, a label on that, or a
        second label becomes an event, "dead letter": it is never guessed which one is right.
        """

    def doubt(self) -> str:
        """Say what of settings, labels and corrections is not as the ledger has it; "" where nothing is."""
        return ""

    def newest_entry(self) -> tuple[int, str] | None:
        """Return number and digest of the newest entry of its ledger; None where there is none."""
        return None

    def holds_entry(self, number: int, digest: str) -> bool:
        """Whether its ledger has that entry."""
        return False

    def let_go(self) -> None:
        """Disconnect without waiting: the journal holds what is missing."""
        self.close()

    def close(self) -> None:
        """Disconnect."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
