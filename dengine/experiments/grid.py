"""Repeated replays over recipes, intervals, alphas and lower bounds, on two cores or on a cluster: the paper's grid.

>>> run_grid("insertion", ["conv", "umap"], alphas=[0.1], lower_bounds=[0.9], repeats=30, keep="out/kept")

joblib runs the replays, with the backend that the caller picked: `joblib.parallel_config(backend="dask")` sends the same
replays to a cluster, and the same decisions come back.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from ..datasets import Dataset, load_dataset
from .contenders import Contender, contenders
from .kept import KeptReplays, Task
from .replay import Replay, replay
from .rivals import require

if TYPE_CHECKING:
    import pandas as pd

Folder = str | os.PathLike[str]
OnDone = Callable[[Replay], None] | None


class Played(NamedTuple):
    """A finished replay. position : of its task.  kept : whether it was there from an earlier run."""

    position: int
    replay: Replay
    kept: bool


def iterate_replays(
    dataset: Any, tasks: Sequence[Task], *, n_jobs: int = 1, keep: Folder | None = None, on_cycle: Any = None
) -> Iterator[Played]:
    """Each task's replay as soon as it is done.

    Played seed by seed, so that what an interrupted run has finished can be compared; they end in no certain order.

    n_jobs : replays at a time, as joblib counts; times are honest with 1 alone.
    keep : folder of finished replays: those that are there are not played again, the others are kept as they end.
    on_cycle : as in `replay`, where n_jobs is 1: a callback does not travel.
    SettingError, before anything is played, where a rival's library is missing.
    """
    from joblib import Parallel, delayed

    data = load_dataset(dataset)
    kept = None if keep is None else KeptReplays(keep, data)
    found = {i: one for i, task in enumerate(tasks) if kept and (one := kept.get(task)) is not None}
    yield from (Played(i, one, True) for i, one in found.items())
    rivals = {task.contender.rival for i, task in enumerate(tasks) if i not in found}
    for name in sorted(rivals - {None}, key=str):
        require(str(name))  # now, and not when the others have been played
    left = sorted(((i, task) for i, task in enumerate(tasks) if i not in found), key=lambda each: each[1].seed)
    parallel = Parallel(n_jobs=n_jobs, return_as="generator_unordered")
    for i, one in parallel(delayed(_play)(data, i, task, on_cycle if n_jobs == 1 else None) for i, task in left):
        if kept is not None:
            kept.put(tasks[i], one)
        yield Played(i, one, False)


def _play(data: Dataset, i: int, task: Task, on_cycle: Any) -> tuple[int, Replay]:
    options: dict[str, Any] = {"shuffle": task.shuffle, "confirm": task.confirm, "on_cycle": on_cycle}
    return i, replay(data, task.contender, task.seed, task.cycles, **options)


def run_replays(
    dataset: Any,
    recipes: Sequence[Any],
    seeds: Iterable[int],
    cycles: int | None = None,
    *,
    shuffle: bool = True,
    confirm: bool = False,
    n_jobs: int = 1,
    keep: Folder | None = None,
    on_done: OnDone = None,
) -> list[Replay]:
    """Every recipe under every seed, in parallel; a list in that order. The rest as in `replay` and `iterate_replays`."""
    pairs = itertools.product([Contender.load(r) for r in recipes], seeds)
    tasks = [Task(who, seed, cycles, shuffle, confirm) for who, seed in pairs]
    return play_tasks(dataset, tasks, n_jobs=n_jobs, keep=keep, on_done=on_done)


def run_grid(
    dataset: Any,
    recipes: Sequence[Any],
    alphas: Sequence[float] = (0.5, 0.1, 0.05),
    lower_bounds: Sequence[float] = (0.8, 0.9, 0.95),
    intervals: Sequence[str] = ("wilson",),
    repeats: int = 30,
    n_jobs: int = -1,
    *,
    guarantees: Sequence[str | None] = (None,),
    confirms: Sequence[bool] = (False,),
    first_seed: int = 0,
    cycles: int | None = None,
    keep: Folder | None = None,
    on_done: OnDone = None,
) -> pd.DataFrame:
    """A row a replay (see `Replay.summary`), over recipes x intervals x alphas x lower_bounds x seeds.

    recipes : a name, or a list of what `replay` takes, rivals too. The column `recipe` names each; two of one reducer keep
        apart.
    guarantees : "local", "pooled", or None for the recipe's own.
    confirms : whether accepted good parts are confirmed; False is the paper's feedback, stops alone.
    keep : folder of finished replays, by which an interrupted grid goes on.

    Source: the paper's experiments, 30 shuffled repeats of a 3 x 3 grid. Timings are honest only with n_jobs=1.
    """
    import pandas as pd

    tasks = grid_tasks(
        recipes, alphas, lower_bounds, intervals, range(first_seed, first_seed + repeats), guarantees, confirms, cycles
    )
    replays = play_tasks(dataset, tasks, n_jobs=n_jobs, keep=keep, on_done=on_done)
    return pd.DataFrame([one.summary() for one in replays])


def grid_tasks(
    recipes: Sequence[Any],
    alphas: Sequence[float | None] = (None,),
    lower_bounds: Sequence[float | None] = (None,),
    intervals: Sequence[str | None] = (None,),
    seeds: Iterable[int] = (0,),
    guarantees: Sequence[str | None] = (None,),
    confirms: Sequence[bool] = (False,),
    cycles: int | None = None,
    shuffle: bool = True,
) -> list[Task]:
    """Every combination as a task; None leaves a setting to the recipe."""
    conditions = itertools.product(contenders(recipes), intervals, alphas, lower_bounds, guarantees, confirms)
    return [
        Task(_under(who, interval, alpha, bound, guarantee), seed, cycles, shuffle, confirm)
        for (who, interval, alpha, bound, guarantee, confirm), seed in itertools.product(conditions, list(seeds))
    ]


def _under(who: Contender, interval: Any, alpha: Any, bound: Any, guarantee: Any) -> Contender:
    asked = {"interval": interval, "alpha": alpha, "lower_bound": bound, "guarantee": guarantee}
    return who.with_policy(**{name: value for name, value in asked.items() if value is not None})


def play_tasks(
    dataset: Any, tasks: Sequence[Task], *, n_jobs: int = 1, keep: Folder | None = None, on_done: OnDone = None
) -> list[Replay]:
    """Each task's replay, in the tasks' order. on_done : called with each as it ends. The rest as in `iterate_replays`."""
    found: dict[int, Replay] = {}
    for played in iterate_replays(dataset, tasks, n_jobs=n_jobs, keep=keep):
        found[played.position] = played.replay
        if on_done is not None:
            on_done(played.replay)
    return [found[i] for i in range(len(tasks))]
