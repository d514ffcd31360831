"""What a store has not taken yet: decisions in memory, and what its journal holds until it can be played back."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Protocol, runtime_checkable

from .store.base import Store
from .store.journal import HEADER, Journal
from .store.journal_records import LateLabel, Record, from_bytes, to_bytes
from .store.records import DecidedTrace, NewLabel, StoredDecision, stored_decision

WAITING = 10_000  # decisions in memory, before they go to the journal while the store is away
CHUNK = 500  # of a journal's records in one transaction


@runtime_checkable
class OwnedStore(Store, Protocol):
    """A store that one engine owns at a time, and that has a journal.

    wait : seconds that its engine waits for it at most.
    """

    wait: float

    @property
    def remote(self) -> bool:
        """Whether it is on a server, which may be away while this machine's disk is well."""

    def committing(self, wanted: Callable[[], bool]) -> AbstractContextManager[None]:
        """Within this, in this thread, a transaction that is not wanted any more when it would commit is rolled back."""

    def own(self) -> Journal:
        """Claim the cell; StoreError where another engine has it."""

    def let_go(self) -> None:
        """Stop and disconnect without writing or waiting: the journal holds what is missing."""

    def play_back(self, records: Sequence[Record]) -> tuple[list[tuple[str, int]], list[str]]:
        """Write what a journal held; labels' numbers by decision, and what was refused."""


class Backlog:
    """Decisions and labels on their way to a store; used by the cell's thread and by the one that asks the store."""

    def __init__(self, store: OwnedStore, journal: Journal) -> None:
        self.store = store
        self.journal = journal
        self.lock = threading.RLock()
        self._unsafe: dict[str, DecidedTrace] = {}  # not known to be committed, and not in the journal
        self._offsets: dict[str, int] = {}  # of decisions in the journal
        self._labels: dict[str, NewLabel] = {}  # in the journal, by decision
        self._arrived: list[tuple[str, int]] = []
        self._played = HEADER  # offset up to which the store holds the journal

    @property
    def unsafe(self) -> list[str]:
        """Ids of decisions that are not known to be on the disk."""
        with self.lock:
            return list(self._unsafe)

    def add(self, item: DecidedTrace) -> None:
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
        if not isinstance(item, DecidedTrace):
            return None
        return stored_decision(item) if label is None else stored_decision(item, label.success, label.source)

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
            self.committed([record.decision.id for record in batch if isinstance(record, DecidedTrace)])
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
