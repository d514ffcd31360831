"""What the page reads: one look at a time, in a worker thread, and no more often than something changes."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

from ...recipe import Recipe
from ...store.base import Store
from ..service import CellService
from .pulse import Pulse

MOST = 64  # looks that are kept

T = TypeVar("T")


class Looking:
    """Looks at the store of a service; several readers of one view cost one look.

    Reading shares the interpreter with the engine's thread, so that looks go one after the other, and few are made.
    """

    def __init__(self, service: CellService, pulse: Pulse) -> None:
        self.service, self.pulse = service, pulse
        self._lock = threading.Lock()
        self._kept: dict[Hashable, tuple[Hashable, Any]] = {}

    @property
    def store(self) -> Store:
        """Of the service, by its own connection."""
        return self.service.reading

    @property
    def recipe(self) -> Recipe:
        """Every setting as it is in force."""
        return self.service.engine.recipe

    async def look(self, view: Hashable, read: Callable[[Looking], T]) -> T:
        """What `read` finds, in a worker thread; as it was found before where nothing has changed since.

        An engine that remembers in memory is read in its own thread: its store has one thread only.
        """
        if self.store is self.service.engine.store:
            return await self.service.ask(lambda engine: self._look(view, read))
        return await asyncio.to_thread(self._look, view, read)

    def kept(self, what: Hashable, fits: Hashable, read: Callable[[], T]) -> T:
        """What `read` finds, or found when `fits` was the same: for what changes less often than the decisions."""
        known = self._kept.get(what)
        if known is not None and known[0] == fits:
            found: T = known[1]
            return found
        fresh = read()
        while len(self._kept) >= MOST:
            del self._kept[next(iter(self._kept))]
        self._kept[what] = (fits, fresh)
        return fresh

    def _look(self, view: Hashable, read: Callable[[Looking], T]) -> T:
        with self._lock:
            return self.kept(view, self.pulse.number, lambda: read(self))
