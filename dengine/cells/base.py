"""What the engine drives: a cell that inserts, verifies, proceeds and rejects."""

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..records import Outcome


@runtime_checkable
class Cell(Protocol):
    """A robot cell as the engine sees it. After each `insert`, exactly one of the other three is called, once."""

    def insert(self) -> NDArray[np.floating]:
        """Pick a part, insert it, return the recorded trace: (T,) or (channels, T)."""

    def verify(self) -> bool:
        """Run the expensive verification of what was just inserted: True for a success."""

    def proceed(self) -> Outcome:
        """Go on without the verification; say what became of the part, where that is known."""

    def reject(self) -> None:
        """Send the part back to the bin."""
