"""Playing what was asked for, with a bar that says how long it will take; Ctrl-C keeps what was finished."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import SettingError
from .output import duration, progress

if TYPE_CHECKING:
    from ..datasets import Dataset
    from ..experiments.costs import Forecast
    from ..experiments.kept import Task
    from ..experiments.replay import Replay

ANSWERS_WITHIN = "5 s"  # what a scheduler has for it, before it counts as not there


@dataclass(frozen=True)
class Stream:
    """How streams are played: by which seeds, how many cycles, shuffled or as recorded; and where.

    n_jobs : replays at a time.  keep : folder of finished ones.  scheduler : address of a dask cluster.
    """

    seeds: range
    cycles: int | None = None
    shuffle: bool = True
    n_jobs: int = 1
    keep: Path | None = None
    scheduler: str | None = None


@dataclass(frozen=True)
class Finished:
    """The replays that were finished, in the order in which they were asked for.

    asked : how many were asked for.  found : how many had been kept from an earlier run.  seconds : wall time.
    """

    replays: Sequence[Replay]
    asked: int
    found: int
    seconds: float

    @property
    def interrupted(self) -> bool:
        """Whether some are missing."""
        return len(self.replays) < self.asked


def play(dataset: Dataset, tasks: Sequence[Task], stream: Stream, quiet: bool) -> Finished:
    """Play every task; on Ctrl-C what was finished until then."""
    from ..experiments.costs import Forecast
    from ..experiments.grid import iterate_replays

    done: dict[int, Replay] = {}
    found, begin = 0, time.perf_counter()
    with _cluster(stream, dataset) as (n_jobs, workers):
        forecast = Forecast([task.contender.name for task in tasks], workers)
        cycles = len(tasks) * (stream.cycles or len(dataset))
        with progress(f"replaying {dataset.name}", cycles, quiet, lambda: _left(forecast)) as advance:
            # A callback cannot travel to other processes: there the bar moves a replay at a time.
            on_cycle = (lambda cycle: advance(1)) if n_jobs == 1 else None
            try:
                for i, one, kept in iterate_replays(dataset, tasks, n_jobs=n_jobs, keep=stream.keep, on_cycle=on_cycle):
                    done[i], found = one, found + kept
                    forecast.done(tasks[i].contender.name, one.seconds)
                    if on_cycle is None or kept:
                        advance(len(one))
            except KeyboardInterrupt:
                pass  # what is missing says so
    return Finished([done[i] for i in sorted(done)], len(tasks), found, time.perf_counter() - begin)


def _left(forecast: Forecast) -> str:
    """What the bar says of the time to come."""
    known = forecast.left()
    if known is None:
        return "time left: known after the first replay"
    seconds, more = known
    return f"about {duration(seconds)} left" + (", and kinds that none has ended of" if more else "")


@contextmanager
def _cluster(stream: Stream, dataset: Dataset) -> Iterator[tuple[int, int]]:
    """(n_jobs, workers): replays go to a dask cluster where a scheduler is named, else to processes of this machine."""
    from joblib import effective_n_jobs, parallel_config

    if stream.scheduler is None:
        yield stream.n_jobs, effective_n_jobs(stream.n_jobs)
        return
    if find_spec("distributed") is None:
        raise SettingError('Expected dask for --scheduler, it is not installed: pip install "dengine[dask]".')
    from distributed import Client

    connect: Any = Client  # untyped
    try:
        connected = connect(stream.scheduler, timeout=ANSWERS_WITHIN)
    except (OSError, ValueError, MemoryError) as error:  # the last: what answered there speaks another language
        raise SettingError(
            f"Expected --scheduler to be the address of a running dask scheduler, as tcp://host:8786, got "
            f"{stream.scheduler!r}: {error}"
        ) from error
    with connected as client, parallel_config("dask", client=client, scatter=[dataset]):
        yield -1, max(1, sum(client.nthreads().values()))
