"""What the page reads: one look at a time, and no more often than something changes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

from ...recipe import Recipe
from ...store.base import Store
from ..service import CellService
from .pulse import Pulse

MOST = 64  # looks that are kept
REST = 10.0  # a look that took a second is not taken anew for so many: reading a large store is not to be felt
LONGEST = 30.0  # seconds of rest

T = TypeVar("T")


class Looking:
    """Looks at the store of a service; several readers of one view cost one look.

    Reading shares the interpreter with the engine's thread, so that looks go one after the other, and few are made.
    """

    def __init__(self, service: CellService, pulse: Pulse) -> None:
        self.service, self.pulse = service, pulse
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
        if rest > 0.0 and self._kept.get(view, (None,))[0] != self.pulse.number:
            self.pulse.advance_in(rest)  # what was found is old by now: whoever watches is told when it is looked at anew
        return found

    def look_anew(self) -> None:
        """Let the next look be fresh, however long it takes: somebody did something."""
        self._rests.clear()
        self.pulse.advance()

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

    def _look(self, view: Hashable, read: Callable[[Looking], T], longest: float) -> T:
        with self._lock:
            begin, known = time.monotonic(), self._kept.get(view)
            if known is not None and begin < self._rests.get(view, 0.0):
                found: T = known[1]
                return found
            fresh = self.kept(view, self.pulse.number, lambda: read(self))
            end = time.monotonic()
            self._rests = {each: until for each, until in self._rests.items() if until > end}
            self._rests[view] = end + min(longest, REST * (end - begin))
            return fresh
