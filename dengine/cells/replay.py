"""`ReplayCell`, a recorded data set that an engine drives like a cell: it plays the labelled traces
one after another, and answers a verification with the recorded label. Replays, `dengine run` and
the demonstration of `dengine serve` use it.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..datasets import load_dataset
from ..records import Outcome


class ReplayCell:
    """Plays labelled traces one by one; the expensive verification returns the recorded label.

    An accepted bad part always stops the line. `insert` raises IndexError after the last trace.
    Nothing checks that the other methods follow an `insert`. Making one raises the errors of
    `load_dataset`.

    Parameters
    ----------
    dataset : object
        Anything that `load_dataset` takes.
    order : array of int, optional
        Indices of the traces in the order to play them; None: as recorded.
    confirm : bool, default False
        Whether an accepted good part is confirmed. False: only stops become known, as on most
        lines.

    Attributes
    ----------
    data : Dataset
    spec : TraceSpec
        Of the traces, as far as the data set tells.
    """

    def __init__(
        self, dataset: Any, order: NDArray[np.integer] | None = None, confirm: bool = False
    ) -> None:
        self.data = load_dataset(dataset)
        self.spec = self.data.spec
        self.order = np.arange(len(self.data)) if order is None else np.asarray(order)
        self.confirm = confirm
        self.position = -1

    @property
    def truth(self) -> bool:
        """Whether the newest part is good, by its label.

        Before any `insert` it is that of the last part of the order.
        """
        return bool(self.data.y[self.order[self.position]])

    @property
    def part(self) -> str | None:
        """Number of the newest part (before any `insert`: of the last part of the order).

        None if the data set has no part numbers.
        """
        return None if self.data.part is None else str(self.data.part[self.order[self.position]])

    def insert(self) -> NDArray[np.floating]:
        """Go on to the next recorded trace; return it, (T,) or (channels, T) as in the data set.

        `order`, with which the robot cell was made, says which trace is next. The trace is float32,
        and no copy: it shares its memory with the data set. Raise IndexError after the last one;
        the newest part then stays the last one.
        """
        if self.position + 1 >= len(self.order):
            raise IndexError(f"The recording has {len(self.order)} cycles, and all were played.")
        self.position += 1
        return np.asarray(self.data.X[self.order[self.position]])

    def verify(self) -> bool:
        """Return whether the newest part is good, by its recorded label; nothing changes."""
        return self.truth

    def proceed(self) -> Outcome:
        """Return STOPPED if the newest part is bad; nothing changes.

        For a good one return CONFIRMED if the robot cell was made with `confirm`, and else UNKNOWN.
        """
        if not self.truth:
            return Outcome.STOPPED
        return Outcome.CONFIRMED if self.confirm else Outcome.UNKNOWN

    def reject(self) -> None:
        """Do nothing: the recording goes on with its next part."""
