"""What replays cost: how long the rest will take, and what more cores would do.

forecast = Forecast(["conv", "umap", "conv", "umap"], workers=2)
forecast.done("conv", 5.1)
forecast.left()                            # (seconds, whether that is only a lower end)
makespan(costs, workers=1000)
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterable, Sequence


class Forecast:
    """An estimate of the time that is left, from what replays of each kind took so far.

    kinds : of every replay to be played, which share a cost: the recipe.  workers : how many are played at a time.
    """

    def __init__(self, kinds: Sequence[str], workers: int) -> None:
        self.waiting = Counter(kinds)
        self.workers = max(1, workers)
        self.took: dict[str, list[float]] = {}

    def done(self, kind: str, seconds: float) -> None:
        """One replay of this kind has ended, after so many seconds."""
        self.waiting[kind] -= 1
        self.took.setdefault(kind, []).append(seconds)

    def left(self) -> tuple[float, bool] | None:
        """Seconds that are left, and whether kinds of unknown cost come on top; None where nothing is known yet."""
        known = {kind: sum(took) / len(took) for kind, took in self.took.items()}
        if not known:
            return None
        seconds = sum(n * known[kind] for kind, n in self.waiting.items() if kind in known)
        unknown = any(n > 0 for kind, n in self.waiting.items() if kind not in known)
        return seconds / min(self.workers, max(1, self.waiting.total())), unknown


def makespan(costs: Iterable[float], workers: int) -> float:
    """Seconds until all is done, when each worker that is free takes the longest job that is left.

    costs : seconds of each job. Source: Graham (1969), SIAM J. Applied Mathematics 17(2): at most 4/3 of the best there is.
    """
    busy_until = [0.0] * max(1, workers)
    for cost in sorted(costs, reverse=True):
        heapq.heapreplace(busy_until, busy_until[0] + cost)
    return max(busy_until)
