"""Which labels the references of a model came from, oldest first, so that a correction finds its reference."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray


class References:
    """The labels behind a model's references, in the order in which they joined: the newest of them are what it holds.

    A label is known by its sequence number, or by its decision's id while it waits for the store.
    """

    def __init__(self, seqs: Iterable[int] = ()) -> None:
        self._labels: list[int | str] = [int(seq) for seq in seqs]

    def add(self, label: int | str) -> None:
        """One more reference, the newest."""
        self._labels.append(label)

    def number(self, decision_id: str, seq: int) -> None:
        """The newest one of this decision has its number now."""
        age = self.age(decision_id)
        if age is not None:
            self._labels[-age] = seq

    def age(self, label: int | str) -> int | None:
        """The place of a label's reference counted from the newest, which is 1; None where there is none."""
        return next((age for age, held in enumerate(reversed(self._labels), 1) if held == label), None)

    def remove(self, age: int) -> None:
        """The reference of this age is gone."""
        del self._labels[-age]

    def seqs(self) -> NDArray[np.int64]:
        """(n,) sequence numbers, once none waits for the store."""
        return np.array([held for held in self._labels if not isinstance(held, str)], dtype=np.int64)
