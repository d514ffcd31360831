"""A cell without a robot: the bundled recordings, decided on through the service as a robot's program would."""

import asyncio
import logging
import uuid
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import numpy as np

from ..cells.replay import ReplayCell
from ..errors import BusyError
from ..records import Action, Outcome
from .service import CellService

log = logging.getLogger("dengine")
BEFORE = 150  # parts that come at once, but for retrains: no model would be ready before all were verified
CHECK = 0.4  # of a cycle, after which a verified part's result is there
READY = 0.05  # seconds between two looks at whether a retrain is done
POLICY = {"alpha": 0.1, "lower_bound": 0.9, "audit_rate": 0.05}


@asynccontextmanager
async def playing(service: CellService, data: Any = "insertion", speed: float = 1.0, seed: int = 0) -> AsyncIterator[None]:
    """Play recordings in a drawn order, beside a server.  speed : parts a second after the first `BEFORE`."""
    cell = ReplayCell(data)
    cell.order = np.random.default_rng(seed).permutation(len(cell.data))
    driving = asyncio.create_task(drive(service, cell, speed))
    yield
    driving.cancel()
    await asyncio.wait([driving])


async def drive(service: CellService, cell: ReplayCell, speed: float) -> None:
    """Insert every part of a recording, ask what to do with it, and report what became of it."""
    loop, run = asyncio.get_running_loop(), uuid.uuid4().hex[:8]
    due = loop.time()
    try:
        for cycle in range(len(cell.order)):
            seconds = 0.0 if cycle < BEFORE else 1.0 / speed
            due = max(due + seconds, loop.time())
            trace, name = cell.insert(), f"{run}-{cycle + 1}"
            try:
                action = (await service.decide(trace, name, f"{cycle + 1:04d}")).decision.action
            except BusyError:  # as a robot does: the part is verified, and nothing is known of it
                continue
            await asyncio.sleep(seconds * CHECK)
            stopped = action is Action.ACCEPT and cell.proceed() is Outcome.STOPPED
            if action is Action.VERIFY or stopped:
                await service.report(name, cell.verify())
            await asyncio.sleep(due - loop.time())
            while cycle < BEFORE and service.core.is_retraining:
                await asyncio.sleep(READY)
        log.info("all parts of the recording are through; the page stays until Ctrl-C")
    except Exception:
        log.exception("the demonstration stopped")
