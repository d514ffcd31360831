"""What happened while an engine drove a live cell, cycle by cycle.

log = watch(DataEngine(), SimulatedCell(cycles=600), cycles=600)
log.stretches(6)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cells.base import Cell
from ..engine import DataEngine
from ..records import Action, Cycle, RetrainReport


@dataclass(frozen=True)
class RunLog:
    """One run of a cell.

    action : (n,) str, the engine's.  stopped : (n,) bool, the system stopped on an accepted part.
    truth : (n,) float, 1 good, 0 bad, NaN where the cell does not tell: real ones tell only what was verified.
    clock_s : (n,) seconds of production when the cycle was done; None for a cell without a clock.
    """

    action: NDArray[np.str_]
    truth: NDArray[np.float64]
    stopped: NDArray[np.bool_]
    clock_s: NDArray[np.float64] | None
    retrains: tuple[RetrainReport, ...]

    def __len__(self) -> int:
        return len(self.action)

    @property
    def verified(self) -> NDArray[np.bool_]:
        """(n,) the part was checked."""
        return np.asarray(self.action == Action.VERIFY)

    @property
    def false_positive(self) -> NDArray[np.bool_]:
        """(n,) accepted and bad, as far as the truth is known."""
        return np.asarray((self.action == Action.ACCEPT) & (self.truth == 0.0))

    @property
    def false_negative(self) -> NDArray[np.bool_]:
        """(n,) rejected and good, as far as the truth is known."""
        return np.asarray((self.action == Action.REJECT) & (self.truth == 1.0))

    @property
    def finished(self) -> NDArray[np.bool_]:
        """(n,) a good part was passed on."""
        return np.asarray((self.action != Action.REJECT) & (self.truth == 1.0))

    def summary(self, part: slice = slice(None)) -> dict[str, Any]:
        """Counts over all cycles, or a stretch of them; parts an hour where there is a clock."""
        action = self.action[part]
        first = part.start or 0
        return {
            "first_cycle": first + 1,
            "last_cycle": first + len(action),
            "verified_share": float(self.verified[part].mean()) if len(action) else float("nan"),
            "verified": int(self.verified[part].sum()),
            "accepted": int((action == Action.ACCEPT).sum()),
            "rejected": int((action == Action.REJECT).sum()),
            "false_positive": int(self.false_positive[part].sum()),
            "false_negative": int(self.false_negative[part].sum()),
            "stops": int(self.stopped[part].sum()),
            "parts_per_hour": self._parts_per_hour(part),
        }

    def stretches(self, n: int) -> list[dict[str, Any]]:
        """The run cut into at most n stretches of about equal length, each as in `summary`."""
        edges = np.unique(np.linspace(0, len(self), n + 1).round().astype(int)).tolist()
        return [self.summary(slice(a, b)) for a, b in pairwise(edges)]

    def _parts_per_hour(self, part: slice) -> float | None:
        if self.clock_s is None or not len(self):
            return None
        begin, end = part.indices(len(self))[:2]
        seconds = self.clock_s[end - 1] - (self.clock_s[begin - 1] if begin else 0.0)
        return float(3600.0 * self.finished[part].sum() / seconds) if seconds > 0 else None


def watch(engine: DataEngine, cell: Cell, cycles: int, on_cycle: Callable[[Cycle], None] | None = None) -> RunLog:
    """Drive a cell and keep what figures and tables need. `truth` and `clock` are read off a cell that has them."""
    action, truth, stopped, clock, retrains = [], [], [], [], []
    for cycle in engine.run(cell, cycles):
        action.append(str(cycle.decision.action))
        truth.append(_truth(cell, cycle))
        stopped.append(cycle.outcome == "stopped")
        clock.append(getattr(cell, "clock", None))
        if cycle.retrain is not None:
            retrains.append(cycle.retrain)
        if on_cycle is not None:
            on_cycle(cycle)
    return RunLog(
        action=np.array(action),
        truth=np.array(truth, dtype=np.float64),
        stopped=np.array(stopped, dtype=bool),
        clock_s=None if None in clock else np.array(clock, dtype=np.float64),
        retrains=tuple(retrains),
    )


def _truth(cell: Cell, cycle: Cycle) -> float:
    known = getattr(cell, "truth", cycle.success)
    return float("nan") if known is None else float(known)
