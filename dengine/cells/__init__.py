"""Cells that an engine drives: the contract, a recording played back, a simulated cell, and a UR robot's."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .._lazy import lazy_names

if TYPE_CHECKING:
    from .base import Cell
    from .replay import ReplayCell
    from .simulation.cell import SimulatedCell
    from .ur.cell import UrCell
    from .ur.controller import FakeController
    from .ur.recorder import RtdeRecorder

_WHERE = {
    "base": ("Cell",),
    "replay": ("ReplayCell",),
    "simulation.cell": ("SimulatedCell",),
    "ur.cell": ("UrCell",),
    "ur.controller": ("FakeController",),
    "ur.recorder": ("RtdeRecorder",),
}

__all__ = [
    "Cell",
    "FakeController",
    "ReplayCell",
    "RtdeRecorder",
    "SimulatedCell",
    "UrCell",
]

__getattr__, __dir__ = lazy_names(__name__, _WHERE)
