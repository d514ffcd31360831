"""A recorded data set, driven as if it were a cell."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..datasets import load_dataset
from ..records import Outcome


class ReplayCell:
    """Plays labelled traces one by one; the expensive verification looks the label up.

    dataset : anything that `load_dataset` takes.
    order : indices to play, in turn; None: as recorded.
    confirm : whether an accepted good part is known to be fine afterwards; False: only stops are seen, as on most lines.
    An accepted failure always stops the system. Playing past the end raises IndexError.
    """

    def __init__(self, dataset: Any, order: NDArray[np.integer] | None = None, confirm: bool = False) -> None:
        self.data = load_dataset(dataset)
        self.order = np.arange(len(self.data)) if order is None else np.asarray(order)
        self.confirm = confirm
        self.position = -1

    @property
    def truth(self) -> bool:
        """Whether the part just inserted is good."""
        return bool(self.data.y[self.order[self.position]])

    @property
    def part(self) -> str | None:
        """The number of the part just inserted; None where the data set tells none."""
        return None if self.data.part is None else str(self.data.part[self.order[self.position]])

    def insert(self) -> NDArray[np.floating]:
        """The next trace."""
        if self.position + 1 >= len(self.order):
            raise IndexError(f"The recording has {len(self.order)} cycles, and all were played.")
        self.position += 1
        return np.asarray(self.data.X[self.order[self.position]])

    def verify(self) -> bool:
        """The recorded label."""
        return self.truth

    def proceed(self) -> Outcome:
        """STOPPED for a failure; for a good part CONFIRMED or, by default, UNKNOWN."""
        if not self.truth:
            return Outcome.STOPPED
        return Outcome.CONFIRMED if self.confirm else Outcome.UNKNOWN

    def reject(self) -> None:
        """Back to the bin: the recording goes on with its next part."""
