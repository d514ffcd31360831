"""`Cell`, the protocol of everything that `DataEngine.run` can drive: four methods, insert, verify,
proceed and reject. `check_cell` refuses an object that lacks one of them.
"""

from inspect import getattr_static
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..errors import SettingError
from ..records import Outcome

METHODS = ("insert", "verify", "proceed", "reject")


@runtime_checkable
class Cell(Protocol):
    """A robot cell. After each `insert` the engine calls exactly one of the other three, once.

    A cell may have an attribute `part`, the number of the newest part, and an attribute `spec`, the
    `TraceSpec` of its traces.
    """

    def insert(self) -> NDArray[np.floating]:
        """Pick a part and insert it; return the recorded trace, (T,) or (channels, T).

        An exception of any of the four methods ends the engine's run and reaches its caller.
        """

    def verify(self) -> bool:
        """Run the expensive verification of the inserted part; return whether it is good."""

    def proceed(self) -> Outcome:
        """Go on without the verification.

        Returns
        -------
        Outcome
            What became known of the part: STOPPED (it was bad and stopped the line), CONFIRMED (it
            is good) or UNKNOWN.
        """

    def reject(self) -> None:
        """Send the part back to the bin."""


def check_cell(cell: Any) -> None:
    """Raise SettingError for an object that lacks a method of `Cell`; no method is called.

    The methods are insert, verify, proceed and reject; the message names the missing ones. An
    attribute that `inspect.getattr_static` finds counts as a method unless it is None; it is not
    read, so that no code of the robot cell runs. An attribute that is not found in this way is read
    and must be callable.
    """
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
