"""A cell without a robot: a `Cell` that is driven through the service, as a robot's program would, at a speed to watch.

await drive(service, ReplayCell("insertion"), Pace(before=150, a_second=1.0))
"""

from __future__ import annotations

import asyncio
import uuid
from dataclasses import dataclass

from ..cells.base import Cell
from ..errors import BusyError
from ..records import Action, Outcome
from .service import CellService

CHECK = 0.4  # of a cycle, after which a verified part's result is there
READY = 0.05  # seconds between two looks at whether a retrain is done


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast parts come.

    before : parts that come as fast as they can, but for retrains: no model would be ready before all were verified.
    a_second : parts a second, after these.
    """

    before: int
    a_second: float


async def drive(service: CellService, cell: Cell, pace: Pace, cycles: int) -> int:
    """Insert so many parts, ask what to do with each, and report what became of it; returns how many were decided on."""
    loop, run, decided = asyncio.get_running_loop(), uuid.uuid4().hex[:8], 0
    due = loop.time()
    for cycle in range(cycles):
        trace = await asyncio.to_thread(cell.insert)
        seconds = 0.0 if cycle < pace.before else 1.0 / pace.a_second
        due = max(due + seconds, loop.time())
        try:
            answer = await service.decide(trace, f"{run}-{cycle + 1}", f"{cycle + 1:04d}")
        except BusyError:  # as a robot does: the part is verified, and nothing is known of it
            cell.verify()
            continue
        decided += 1
        await asyncio.sleep(seconds * CHECK)
        success = await asyncio.to_thread(_dealt_with, cell, answer.decision.action)
        if success is not None:
            await service.report(answer.decision.id, success)
        await asyncio.sleep(due - loop.time())
        while cycle < pace.before and service.engine.retraining:
            await asyncio.sleep(READY)
    return decided


def _dealt_with(cell: Cell, action: Action) -> bool | None:
    """Do what was decided; returns what is known of the part then, None for nothing."""
    if action is Action.VERIFY:
        return cell.verify()
    if action is Action.REJECT:
        cell.reject()
        return None
    return {Outcome.STOPPED: False, Outcome.CONFIRMED: True, Outcome.UNKNOWN: None}[cell.proceed()]
