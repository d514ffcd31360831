"""Plays recordings through the service in place of a robot, for `dengine serve --demo`: `playing`.

For each recorded part it does what a robot's program does: insert, ask for a decision, report the
outcome.
"""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import numpy as np

from ..cells.replay import ReplayCell
from ..errors import log
from ..records import Action, Outcome
from .service import CellService

N_FAST = 150  # parts that are played without a pause, so that a model is soon ready
SECONDS = 1.0  # from one part to the next, after those
CHECK_SHARE = 0.4  # of a cycle, after which the result of a verification is there
POLL_SECONDS = 0.05  # between two looks at whether a retrain has ended
POLICY = {"alpha": 0.1, "lower_bound": 0.9, "audit_rate": 0.05}


@asynccontextmanager
async def playing(service: CellService, data: Any, seed: int) -> AsyncIterator[None]:
    """Play recordings through the service in random order, in a task beside the `async with` block.

    The task plays each recording once, in place of a robot: it asks for a decision on each part,
    and reports the recorded result of parts that are to be checked (VERIFY), and of accepted bad
    parts, which stop the line. The first 150 parts (`N_FAST`) wait only for retrains that are under
    way; later parts come once a second. The task is cancelled when the block ends. Its errors are
    logged (see `drive`).

    Parameters
    ----------
    service : CellService
        It decides, and gets the results.
    data : object
        Anything that `load_dataset` takes.
    seed : int
        Seed of the random order.

    Raises
    ------
    DataError, SettingError, ValueError, StoreError
        If the recordings cannot be read (see `load_dataset`).
    """
    cell = ReplayCell(data)
    cell.order = np.random.default_rng(seed).permutation(len(cell.data))
    task = asyncio.create_task(drive(service, cell))
    try:
        yield
    finally:
        task.cancel()
        await asyncio.wait([task])


async def drive(service: CellService, cell: ReplayCell) -> None:
    """Insert every part of a data set once, ask for a decision, and report the outcome.

    `cell` plays the recorded parts, in the order of `cell.order`, from its first part on; parts
    have the numbers "0001", "0002" and so on. The recorded result is reported for parts that are to
    be checked (VERIFY), and for accepted parts that are bad, which stop the line. The first 150
    parts (`N_FAST`) come without a pause, but a retrain that is under way is waited for; later
    parts come once a second, and their report after 40 % of this time. An accepted good part and a
    rejected part get no report. A log line says when all parts were played. An exception, also the
    one of a service whose queue is full, is logged and ends the demonstration, not the server;
    nothing is raised, except if the task is cancelled.
    """
    loop = asyncio.get_running_loop()
    next_start = loop.time()
    try:
        for cycle in range(len(cell.order)):
            seconds = 0.0 if cycle < N_FAST else SECONDS
            next_start = max(next_start + seconds, loop.time())
            decision = (await service.decide(cell.insert(), part=f"{cycle + 1:04d}")).decision
            await asyncio.sleep(seconds * CHECK_SHARE)
            stopped = decision.action is Action.ACCEPT and cell.proceed() is Outcome.STOPPED
            if decision.action is Action.VERIFY or stopped:
                await service.report(decision.id, cell.verify())
            await asyncio.sleep(next_start - loop.time())
            while cycle < N_FAST and service.engine.state.is_retraining:
                await asyncio.sleep(POLL_SECONDS)
        log.info("all parts of the recording are through; the page stays until Ctrl-C")
    except Exception:
        log.exception("the demonstration stopped")
