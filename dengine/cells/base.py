"""`Cell`, the protocol of everything that `DataEngine.run` can drive, and its check."""

from inspect import getattr_static
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..errors import SettingError
from ..records import Outcome

METHODS = ("insert", "verify", "proceed", "reject")


@runtime_checkable
class Cell(Protocol):
    """A robot cell. After each `insert` the engine calls exactly one of the other three, once."""

    def insert(self) -> NDArray[np.floating]:
        """Pick a part and insert it; return the recorded trace, (T,) or (channels, T)."""

    def verify(self) -> bool:
        """Run the expensive verification of the inserted part; return whether it is good."""

    def proceed(self) -> Outcome:
        """Go on without the verification; return what became known of the part."""

    def reject(self) -> None:
        """Send the part back to the bin."""


def check_cell(cell: Any) -> None:
    """Raise SettingError for an object without a method of `Cell`, before a run and not in it."""
    # Static look-up first: a cell may react to the reading of its attributes.
    missing = [
        name
        for name in METHODS
        if getattr_static(cell, name, None) is None and not callable(getattr(cell, name, None))
    ]
    if missing:
        raise SettingError(
            f"Expected a cell with the methods {', '.join(METHODS)}, "
            f"got {type(cell).__name__} without {' and '.join(missing)}; add them."
        )
