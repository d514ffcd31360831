"""The labelled traces that train and are counted: the newest ones, in memory."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from .foreign import ForeignModel
from .prediction import ModelPrediction
from .store import Labelled

AnyModel = ModelPrediction | ForeignModel
log = logging.getLogger("dengine")


class Window:
    """The newest `capacity` labelled traces, in memory, blind to labels. Work on it does not grow with the store."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
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
        slot = self.total % self.capacity
        self._traces[slot], self._labels[slot], self._hashes[slot], self._seq[slot] = trace, label, hash_, seq
        self.total += 1

    def extend(self, labelled: Labelled) -> None:
        """Take in many, oldest first."""
        for row in zip(labelled.traces, labelled.labels, labelled.hashes, labelled.seq, strict=True):
            self.add(row[0], int(row[1]), int(row[2]), int(row[3]))

    def snapshot(self) -> Labelled:
        """What is held, oldest first. Nobody writes to these arrays afterwards."""
        n, first = len(self), self.total % self.capacity if self.total > self.capacity else 0
        order = (np.arange(n) + first) % self.capacity
        traces = np.zeros((0, 1, 1), dtype=np.float32) if self._traces is None else self._traces[order]
        return Labelled(self._seq[order], traces, self._labels[order], self._hashes[order])

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

    def catch_up(self, model: AnyModel, last_seq: int) -> None:
        """Make every label after `last_seq` a reference of a model that was trained without it."""
        if self.newest_seq <= last_seq:
            return
        data = self.snapshot()
        for i in np.flatnonzero(data.seq > last_seq):
            hash_ = int(data.hashes[i])
            point = place(model, data.traces[i], hash_)
            if point is not None:
                hold(model, point, int(data.labels[i]), hash_)


def prepare(model: AnyModel, answering: AnyModel | None) -> None:
    """Have a model ready to answer before it is asked; one that fails at it will verify, and say so, on every part."""
    if not isinstance(model, ModelPrediction):
        return
    try:
        model.ready(answering if isinstance(answering, ModelPrediction) else None)
    except Exception:
        log.exception("the model that was trained cannot be made to answer")


def place(model: AnyModel, trace: NDArray[np.float32], hash_: int) -> NDArray[np.float32] | None:
    """Where a trace would live as a reference; None where the model fails on it, which must cost neither cell nor label."""
    try:
        return model.place(trace, hash_)
    except Exception:
        log.exception("the model cannot place a labelled trace; the next version learns it from the store")
        return None


def hold(model: AnyModel, point: NDArray[np.float32], label: int, hash_: int) -> None:
    """Make a placed trace a reference; a model that fails at it goes on without."""
    try:
        model.hold(point, label, hash_)
    except Exception:
        log.exception("the model cannot take a labelled trace; the next version learns it from the store")
