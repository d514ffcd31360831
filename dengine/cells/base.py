"""What the engine drives: a cell that inserts, verifies, proceeds and rejects."""

from inspect import getattr_static
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..errors import SettingError
from ..records import Outcome

METHODS = ("insert", "verify", "proceed", "reject")


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


def must_be_cell(cell: Any) -> None:
    """SettingError for what lacks a method of a `Cell`: it would fail in the middle of a run."""
    # Looked up statically: a cell may count what is asked of it.
    lacks = [
        name for name in METHODS if getattr_static(cell, name, None) is None and not callable(getattr(cell, name, None))
    ]
    if lacks:
        got = f"{type(cell).__name__} without {' and '.join(lacks)}"
        raise SettingError(f"Expected a cell with the methods {', '.join(METHODS)}, got {got}; give it what it lacks.")
