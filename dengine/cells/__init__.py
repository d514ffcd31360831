"""Cells that an engine drives: the contract, a recording played back, and a simulated cell."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .._lazy import lazy_names

if TYPE_CHECKING:
    from .base import Cell
    from .replay import ReplayCell
    from .simulation.cell import SimulatedCell

_WHERE = {
    "base": ("Cell",),
    "replay": ("ReplayCell",),
    "simulation.cell": ("SimulatedCell",),
}

__all__ = [
    "Cell",
    "ReplayCell",
    "SimulatedCell",
]

__getattr__, __dir__ = lazy_names(__name__, _WHERE)
