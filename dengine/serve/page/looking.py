"""What the page reads, one look at a time and no more often than something changes; and what it is told of changes."""

from __future__ import annotations

import asyncio
import json
import threading
import time
import uuid
from collections.abc import AsyncIterator, Callable, Hashable
from typing import Any, TypeVar

from ...recipe import Recipe
from ...store.base import Store
from ..service import CellService

T = TypeVar("T")
SETTLED = 0.15  # seconds after a change until it is told: the store's writer lets a decision wait for 0.05
AGAIN = 1.0  # seconds after the last change until it is told once more: a disk may be slow
RETRY = 1000  # ms after which a browser that was cut off tries again
TICK = 5.0  # seconds of quiet, after which a watcher is told that the line still stands
MOST = 64  # looks that are kept
REST, LONGEST = 10.0, 30.0  # a look that took a second is not taken anew for so many: it is not to be felt; and at most


class ChangeFeed:
    """Counts changes.  number : of them so far.  boot : of this process, so that a page knows a new one."""

    def __init__(self, service: CellService) -> None:
        self.number, self.boot = 0, uuid.uuid4().hex
        self._service, self._over = service, False
        self._task: asyncio.Task[None] | None = None
        self._turn = asyncio.Event()
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
        loop = asyncio.get_running_loop()
        if self._coming is None or self._coming.cancelled() or self._coming.when() < loop.time():
            self._coming = loop.call_later(seconds, self.advance)

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


class Looking:
    """Looks at the store of a service; several readers of one view cost one look.

    Reading shares the interpreter with the engine's thread, so that looks go one after the other, and few are made.
    """

    def __init__(self, service: CellService, feed: ChangeFeed) -> None:
        self.service, self.feed = service, feed
        self._lock = threading.Lock()
        self._kept: dict[Hashable, tuple[Hashable, Any]] = {}
        self._rests: dict[Hashable, float] = {}  # until when, by a view

    @property
    def store(self) -> Store:
        """Of the service, by its own connection."""
        return self.service.reading

    @property
    def recipe(self) -> Recipe:
        """Every setting as it is in force."""
        return self.service.engine.recipe

    async def look(self, view: Hashable, read: Callable[[Looking], T], longest: float = LONGEST) -> T:
        """What `read` finds, in another thread; as it was found before where nothing has changed since.

        longest : seconds that the view may rest after a look that took long, and be as old.
        """
        found = await self.service.read(lambda store: self._look(view, read, longest))
        rest = self._rests.get(view, 0.0) - time.monotonic()
        if rest > 0.0 and self._kept.get(view, (None,))[0] != self.feed.number:
            self.feed.advance_in(rest)  # what was found is old by now: whoever watches is told when it is looked at anew
        return found

    def look_anew(self) -> None:
        """Let the next look be fresh, however long it takes: somebody did something."""
        self._rests.clear()
        self.feed.advance()

    def kept(self, what: Hashable, fits: Hashable, read: Callable[[], T]) -> T:
        """What `read` finds, or found when `fits` was the same: for what changes less often than the decisions."""
        if what not in self._kept or self._kept[what][0] != fits:
            fresh = read()
            while len(self._kept) >= MOST:
                del self._kept[next(iter(self._kept))]
            self._kept[what] = fits, fresh
        found: T = self._kept[what][1]
        return found

    def _look(self, view: Hashable, read: Callable[[Looking], T], longest: float) -> T:
        with self._lock:
            begin = time.monotonic()
            rests = view in self._kept and begin < self._rests.get(view, 0.0)
            found = self.kept(view, self._kept[view][0] if rests else self.feed.number, lambda: read(self))
            if not rests:
                end = time.monotonic()
                self._rests = {each: until for each, until in self._rests.items() if until > end}
                self._rests[view] = end + min(longest, REST * (end - begin))
            return found
