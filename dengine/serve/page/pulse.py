"""The page's pulse: what changed is told to whoever watches, at a pace that people follow and decisions do not feel."""

from __future__ import annotations

import asyncio
import json
import uuid
from collections.abc import AsyncIterator

from ..service import CellService

SETTLED = 0.15  # seconds after a change until it is told: the store's writer lets a decision wait for 0.05
AGAIN = 1.0  # seconds after the last change until it is told once more: a disk may be slow
RETRY = 1000  # ms after which a browser that was cut off tries again
TICK = 5.0  # seconds of quiet, after which a watcher is told that the line still stands


class Pulse:
    """Counts changes.  number : of them so far.  boot : of this process, so that a page knows a new one."""

    def __init__(self, service: CellService) -> None:
        self.number, self.boot = 0, uuid.uuid4().hex
        self._service = service
        self._task: asyncio.Task[None] | None = None
        self._turn = asyncio.Event()
        self._over = False
        self._coming: asyncio.TimerHandle | None = None

    def begin(self) -> None:
        """Follow the service in the running loop; again does nothing."""
        loop = asyncio.get_running_loop()
        if self._task is None or self._task.get_loop() is not loop:
            self._turn = asyncio.Event()
            self._task = loop.create_task(self._follow())

    def advance(self) -> None:
        """Something changed; in the loop's thread."""
        self.number += 1
        turn, self._turn = self._turn, asyncio.Event()
        turn.set()

    def advance_in(self, seconds: float) -> None:
        """`advance` then, once, whoever else asks for it meanwhile."""
        if self._coming is None or self._coming.cancelled() or self._coming.when() < asyncio.get_running_loop().time():
            self._coming = asyncio.get_running_loop().call_later(seconds, self.advance)

    async def _follow(self) -> None:
        loop, later = asyncio.get_running_loop(), None
        async for _ in self._service.changes():
            await asyncio.sleep(SETTLED)
            self.advance()
            if later is not None:
                later.cancel()
            later = loop.call_later(AGAIN, self.advance)
        self._over = True
        self.advance()

    async def events(self) -> AsyncIterator[dict[str, str | int]]:
        """What a watcher is told: which process this is, then every change, and in quiet that the line still stands."""
        self.begin()
        yield {"event": "hello", "data": json.dumps({"boot": self.boot}), "retry": RETRY}
        known = self.number
        while not self._over:
            turn = self._turn
            if self.number == known:
                try:
                    await asyncio.wait_for(turn.wait(), TICK)
                except TimeoutError:
                    yield {"event": "tick", "data": str(self.number)}
                    continue
            known = self.number
            yield {"event": "changed", "data": str(known)}
