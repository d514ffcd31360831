"""The window that a retrain sees: the newest labelled traces, in memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .store.records import Labelled


class Window:
    """The newest `capacity` labelled traces, in memory, blind to labels. Work on it does not grow with the store."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._clear()

    def _clear(self) -> None:
        self.total = 0
        self._traces: NDArray[np.float32] | None = None
        self._labels = np.zeros(0, dtype=np.int8)
        self._hashes = np.zeros(0, dtype=np.int64)
        self._seq = np.zeros(0, dtype=np.int64)

    def __len__(self) -> int:
        return min(self.total, self.capacity)

    @property
    def newest_seq(self) -> int:
        """Sequence number of the newest label; 0 before the first."""
        return int(self._seq[(self.total - 1) % self.capacity]) if self.total else 0

    def add(self, trace: NDArray[np.float32], label: int, hash_: int, seq: int) -> None:
        """Take in one labelled trace (C, T); on a full window it takes the oldest one's place."""
        self._grow(trace)
        assert self._traces is not None  # for the type checker: _grow made it
        if self.total == self.capacity:
            self._traces = self._traces.copy()  # from now on places are taken again: who has a snapshot keeps the old ones
        slot = self.total % self.capacity
        self._traces[slot], self._labels[slot], self._hashes[slot], self._seq[slot] = trace, label, hash_, seq
        self.total += 1

    def extend(self, labelled: Labelled) -> None:
        """Take in many, oldest first."""
        for row in zip(labelled.traces, labelled.labels, labelled.hashes, labelled.seq, strict=True):
            self.add(row[0], int(row[1]), int(row[2]), int(row[3]))

    def refill(self, labelled: Labelled) -> None:
        """Hold these, oldest first, in the place of all that was held."""
        self._clear()
        self.extend(labelled)

    def after(self, seq: int) -> int:
        """How many labels after this one are held."""
        return len(self.newer(seq))

    def draw(self, n: int) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Traces (m, C, T) and hashes (m,) of `n` at most, drawn blind to labels, others at each new label."""
        assert self._traces is not None  # the caller knows of labels; for the type checker
        slots = np.random.default_rng(self.total).permutation(len(self))[:n]
        return self._traces[slots], self._hashes[slots]

    def snapshot(self) -> Labelled:
        """What is held, oldest first. Nobody writes to these arrays afterwards."""
        order = self._order()
        traces = np.zeros((0, 1, 1), dtype=np.float32) if self._traces is None else self._traces
        # Until the window is full no place is written twice: only then they have to be copied.
        traces = traces[: len(order)] if self.total <= self.capacity else traces[order]
        return Labelled(self._seq[order], traces, self._labels[order], self._hashes[order])

    def newer(self, seq: int) -> NDArray[np.int64]:
        """Sequence numbers of the labels after this one, in the order in which they came."""
        held = self._seq[self._order()]
        return held[held > seq]

    def row(self, seq: int) -> tuple[NDArray[np.float32], int, int]:
        """Trace (C, T), label and hash of a label that is held."""
        assert self._traces is not None  # the caller knows of the label; for the type checker
        slot = int(np.flatnonzero(self._seq[: len(self)] == seq)[-1])
        return self._traces[slot], int(self._labels[slot]), int(self._hashes[slot])

    def _order(self) -> NDArray[np.int64]:
        """The places of what is held, oldest first."""
        n, first = len(self), self.total % self.capacity if self.total > self.capacity else 0
        return (np.arange(n) + first) % self.capacity

    def _grow(self, trace: NDArray[np.float32]) -> None:
        # Doubled as needed: a full window of 10,000 x 1000 samples is 40 MB, and most cells start with none.
        room = 0 if self._traces is None else len(self._traces)
        if self.total < room or room == self.capacity:
            return
        size = min(self.capacity, max(64, 2 * room))
        grown = np.zeros((size, *trace.shape), dtype=np.float32)
        if self._traces is not None:
            grown[:room] = self._traces
        self._traces = grown
        self._labels = np.concatenate([self._labels, np.zeros(size - room, dtype=np.int8)])
        self._hashes, self._seq = (
            np.concatenate([a, np.zeros(size - room, dtype=np.int64)]) for a in (self._hashes, self._seq)
        )
