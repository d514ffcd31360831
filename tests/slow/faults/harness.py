"""A small cell under test: it notes what was acknowledged and how long it waited, and is looked at
afterwards.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from dengine import Action, DataEngine, Dataset, Policy, Recipe, RetrainReport, load_dataset
from dengine.store import SqlStore
from dengine.store.journal import HEADER

RECIPE = Recipe("pca", radius=0.5, retrain_every=40, policy=Policy(alpha=0.1, lower_bound=0.9))
WAIT = 1.0  # seconds that the engine may wait for a disk that others use too
PROBE = 20  # traces by whose decisions two engines are compared
PATIENCE = 60.0  # seconds for a store to come back


@dataclass
class Outcome:
    """What became of one kind of fault.

    labels : acknowledged.  lost : of these, not stored as they were acknowledged.  wrong :
    decisions that a reopened engine makes otherwise, and faults that were not noticed.  raised :
    exceptions that reached the cell.  longest : wait for a decision or a report that set off no
    retrain, in seconds.  versions : swapped in between kills. told : the first of what went wrong,
    in words.
    """

    injected: int = 0
    labels: int = 0
    lost: int = 0
    wrong: int = 0
    raised: int = 0
    longest: float = 0.0
    versions: int = 0
    told: list[str] = field(default_factory=list)

    def tell(self, error: BaseException) -> None:
        """An exception reached the cell."""
        self.raised += 1
        self.told.append(f"{type(error).__name__}: {error}"[:200])

    def must(self, held: bool, what: str) -> None:
        """Whether a fault was met as it should be."""
        if not held:
            self.wrong += 1
            self.told.append(what)


@cache
def stream() -> Dataset:
    """The bundled insertions, every fifth sample: small enough that a trial takes seconds."""
    data = load_dataset("insertion")
    return Dataset(np.ascontiguousarray(data.X[:, ::5]), data.y)


@dataclass(frozen=True)
class Place:
    """Where a trial's store is: a file, or a URL and a cell of its own."""

    url: str
    cell: str = "cell"
    wait: float = WAIT

    def store(self) -> SqlStore:
        """Open it."""
        return SqlStore(self.url, self.cell, wait=self.wait)


class Cell:
    """An engine that is driven by hand, so that what it raises and how long it takes is seen."""

    def __init__(
        self, place: Place, outcome: Outcome, window: int = RECIPE.window, **options: Any
    ) -> None:
        self.place, self.outcome = place, outcome
        self.engine = DataEngine(
            recipe=replace(RECIPE, window=window), store=place.store(), **options
        )
        self.acknowledged: dict[str, bool] = {}
        self.next = 0

    def play(self, n: int) -> None:
        """So many parts; what raises is counted, and the cell goes on."""
        data = stream()
        for i in range(self.next, self.next + n):
            self._part(data.X[i % len(data)], bool(data.y[i % len(data)]))
        self.next += n

    def _part(self, x: Any, good: bool) -> None:
        try:
            decision = self.timed(lambda: self.engine.decide(x))
            bad_accept = decision.action is Action.ACCEPT and not good
            if decision.action is Action.VERIFY or bad_accept:
                self.timed(lambda: self.engine.report(decision.id, good))
                self.acknowledged[decision.id] = good
        except Exception as error:  # whatever reaches the cell is what is counted here
            self.outcome.tell(error)

    def timed(self, work: Callable[[], Any]) -> Any:
        """Do this, and see how long it takes."""
        begin, result = time.perf_counter(), None
        try:
            result = work()
        finally:
            if not isinstance(
                result, RetrainReport
            ):  # a retrain takes its own time, which is no wait
                self.outcome.longest = max(self.outcome.longest, time.perf_counter() - begin)
        return result

    def until_back(self) -> None:
        """Wait until the store is there again, and holds what its journal held."""
        end = time.monotonic() + PATIENCE
        while (fault := self.engine.state.store_fault) and time.monotonic() < end:
            time.sleep(0.02)
        self.outcome.must(not fault, fault)

    def finish(self) -> None:
        """Close, open again, and compare: labels with what was acknowledged, decisions with those
        of the engine before.
        """
        before = bounds(self.engine)
        self.engine.close()
        with DataEngine.open(self.place.store()) as again:
            self.outcome.labels += len(self.acknowledged)
            self.outcome.lost += missing(again.store, self.acknowledged)
            self.outcome.wrong += sum(a != b for a, b in zip(before, bounds(again), strict=True))
        if "://" not in self.place.url:
            (journal,) = Path(self.place.url).parent.glob(f"{Path(self.place.url).name}.*.journal")
            self.outcome.must(
                journal.stat().st_size == HEADER, "the journal holds what the store has"
            )


def bounds(engine: DataEngine) -> list[tuple[Any, ...]]:
    """What an engine says of the probe."""
    seen = [engine.decide(x) for x in stream().X[-PROBE:]]
    return [
        (d.action, d.lower, d.upper, d.n_success, d.n_failure, d.embedding, d.model_version)
        for d in seen
    ]


def missing(store: SqlStore, acknowledged: dict[str, bool]) -> int:
    """How many labels a store does not hold as they were acknowledged."""
    result = {name: store.decisions.get(name) for name in acknowledged}
    return sum(
        item is None or item.success is not acknowledged[name] for name, item in result.items()
    )
