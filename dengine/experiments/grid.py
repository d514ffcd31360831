"""Repeated replays over recipes, intervals, alphas and lower bounds, on two cores or on a cluster: the paper's grid.

>>> run_grid("insertion", ["conv", "umap"], alphas=[0.1], lower_bounds=[0.9], repeats=30, keep="out/kept")

joblib runs the replays, with the backend that the caller picked: `joblib.parallel_config(backend="dask")` is a cluster.
Finished replays are kept on disk under a hash of all that their decisions depend on: traces and labels, every setting, the
seed, dengine's own source, and the libraries that compute. Nothing is unpickled; an unreadable file is no replay.
"""

import hashlib
import json
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cache
from importlib.metadata import distributions
from inspect import getsourcefile, isfunction
from io import BytesIO
from itertools import product
from pathlib import Path
from pickle import PicklingError
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..datasets import Dataset, load_dataset
from ..errors import DataError, SettingError, expect
from ..files import read_archive, read_errors, write_output
from ..records import RetrainReport
from ..reducers import reducer_class
from .baselines import require
from .replay import Contender, Replay, replay
from .tables import frame_of

if TYPE_CHECKING:
    import pandas as pd

Folder = str | os.PathLike[str]
LIBRARIES = ("numpy", "scipy", "torch", "scikit-learn", "umap-learn", "numba", "aeon")


@dataclass(frozen=True)
class Task:
    """One replay to be played: who, which shuffle, how many cycles, and what is known of accepted parts."""

    contender: Contender
    seed: int
    cycles: int | None = None
    shuffle: bool = True
    confirm: bool = False


class KeptReplays:
    """A folder of finished replays of one data set; made if need be."""

    def __init__(self, folder: Folder, data: Dataset) -> None:
        from joblib import hash as digest

        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self._digest, self._of_data = digest, digest((data.name, data.X, data.y, data.part, data.rate_hz))

    def path(self, task: Task) -> Path:
        """Where the replay of a task is kept: a hash of all that its decisions depend on, a reducer's own files among it.

        SettingError for a reducer that cannot be told apart from others.
        """
        who, own = task.contender, task.contender.recipe.reducer
        parts = [reducer_class(own)] if isinstance(own, str) else _parts_of(own)
        how: tuple[Any, ...] = (task.seed, task.cycles, task.shuffle, task.confirm)
        how += (who.baseline, dict(who.params), who.recipe.to_toml(), own)
        try:  # a transformer with all that it holds: arrays and functions too, which its description only names
            said = self._digest((self._of_data, _digest_of_source(), [_source_of(part) for part in parts], how))
        except (PicklingError, TypeError, AttributeError) as error:
            got = f"{who.name} holds what has no name in a module, as a lambda ({error})"
            wanted = "a reducer that can be told apart from others, to keep its replays"
            raise SettingError(f"Expected {wanted}; {got}: define it there, or leave keep out.") from error
        return self.folder / f"{said}.npz"

    def get(self, task: Task) -> Replay | None:
        """The replay, under the contender's present name; None where it is not there, or damaged."""
        path = self.path(task)
        try:
            with read_errors(path, "a kept replay"):
                arrays: dict[str, Any] = read_archive(path)[0]
                about = json.loads(str(arrays.pop("about")))
                retrains = tuple(RetrainReport(**each) for each in about.pop("retrains"))
                return Replay(**arrays, **about, name=task.contender.name, recipe=task.contender.recipe, retrains=retrains)
        except DataError:
            return None

    def put(self, task: Task, replay: Replay) -> None:
        """Keep a finished replay: the whole file or none, whatever happens meanwhile."""
        values = {each.name: getattr(replay, each.name) for each in fields(replay) if each.name not in ("name", "recipe")}
        arrays: dict[str, Any] = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
        about = {name: value for name, value in values.items() if name not in arrays}
        about["retrains"] = [asdict(each) for each in replay.retrains]
        buffer = BytesIO()
        np.savez_compressed(buffer, about=np.array(json.dumps(about)), **arrays)
        write_output(self.path(task), buffer.getvalue(), force=True)


@cache
def _digest_of_source() -> str:
    """Of dengine's own source, and of the versions of Python and of the libraries that compute."""
    held = {each.metadata["Name"]: each.version for name in LIBRARIES for each in distributions(name=name)}
    digest = hashlib.sha256(f"{sys.version_info[:2]} {held}".encode())
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


@cache  # a file that changes while a grid is played is not what was imported
def _source_of(part: Any) -> str:
    try:
        return Path(getsourcefile(part) or "").read_text(encoding="utf-8")
    except (OSError, TypeError, UnicodeDecodeError):
        return ""  # typed at a prompt, or compiled


def _parts_of(reducer: Any) -> list[Any]:
    """The classes of a transformer and of the estimators that it is made of, and its functions."""
    held = reducer.get_params(deep=True).values()
    kinds = [type(part) for part in [reducer, *(each for each in held if hasattr(each, "fit"))]]
    return list(dict.fromkeys([*kinds, *(each for each in held if isfunction(each))]))


def contenders(asked: Sequence[Any]) -> list[Contender]:
    """Each as `Contender.load` takes it. SettingError for two of one name and policy, which no table could tell apart."""
    loaded = [Contender.load(one) for one in ([asked] if isinstance(asked, str) else asked)]
    known = [(one.name, one.recipe.policy) for one in loaded]
    twice = next((name for name, policy in known if known.count((name, policy)) > 1), None)
    expect(twice is None, "a name of its own for each", twice, "tell them apart by Contender(name, recipe)")
    return loaded


class Played(NamedTuple):
    """A finished replay. position : of its task.  kept : whether it was there from an earlier run."""

    position: int
    replay: Replay
    kept: bool


def iterate_replays(
    dataset: Any, tasks: Sequence[Task], *, n_jobs: int = 1, keep: Folder | None = None, on_cycle: Any = None
) -> Iterator[Played]:
    """Each task's replay as soon as it is done, played seed by seed: what an interrupted run has finished can be compared.

    n_jobs : replays at a time, as joblib counts; times are honest with 1 alone.
    keep : folder of finished replays: those that are there are not played again, the others are kept as they end.
    on_cycle : as in `replay`, where n_jobs is 1: a callback does not travel.
    SettingError, before anything is played, where a baseline's library is missing.
    """
    from joblib import Parallel, delayed

    data = load_dataset(dataset)
    kept = None if keep is None else KeptReplays(keep, data)
    found = {i: one for i, task in enumerate(tasks) if kept and (one := kept.get(task)) is not None}
    yield from (Played(i, one, True) for i, one in found.items())
    left = sorted((i for i in range(len(tasks)) if i not in found), key=lambda i: tasks[i].seed)
    for name in sorted({tasks[i].contender.baseline or "" for i in left} - {""}):
        require(name)  # now, and not when the others have been played
    parallel, told = Parallel(n_jobs=n_jobs, return_as="generator_unordered"), on_cycle if n_jobs == 1 else None
    for i, one in parallel(delayed(_play)(data, i, tasks[i], told) for i in left):
        if kept is not None:
            kept.put(tasks[i], one)
        yield Played(i, one, False)


def _play(data: Dataset, i: int, task: Task, on_cycle: Any) -> tuple[int, Replay]:
    how: dict[str, Any] = {"shuffle": task.shuffle, "confirm": task.confirm, "on_cycle": on_cycle}
    return i, replay(data, task.contender, task.seed, task.cycles, **how)


def run_grid(
    dataset: Any,
    recipes: Sequence[Any],
    alphas: Sequence[float] = (0.5, 0.1, 0.05),
    lower_bounds: Sequence[float] = (0.8, 0.9, 0.95),
    intervals: Sequence[str] = ("wilson",),
    repeats: int = 30,
    n_jobs: int = -1,
    *,
    cycles: int | None = None,
    keep: Folder | None = None,
) -> "pd.DataFrame":
    """A row a replay (see `Replay.summary`), over recipes x intervals x alphas x lower_bounds x seeds from 0 on.

    recipes : a name, or a list of what `replay` takes, baselines too.  keep : folder by which an interrupted grid goes on.
    Only stops are known of accepted parts, as in the paper.
    Source: the paper's experiments, 30 shuffled repeats of a 3 x 3 grid. Timings are honest only with n_jobs=1.
    """
    tasks = grid_tasks(recipes, alphas, lower_bounds, intervals, range(repeats), cycles=cycles)
    return frame_of(play_tasks(dataset, tasks, n_jobs=n_jobs, keep=keep))


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
    seeds = list(seeds)
    names = ("interval", "alpha", "lower_bound", "guarantee")
    tasks = []
    for who, *asked, confirm in product(contenders(recipes), intervals, alphas, lower_bounds, guarantees, confirms):
        changes = {name: value for name, value in zip(names, asked, strict=True) if value is not None}
        tasks += [Task(who.with_policy(**changes), seed, cycles, shuffle, confirm) for seed in seeds]
    return tasks


def play_tasks(dataset: Any, tasks: Sequence[Task], *, n_jobs: int = 1, keep: Folder | None = None) -> list[Replay]:
    """Each task's replay, in the tasks' order; the rest as in `iterate_replays`."""
    found = {each.position: each.replay for each in iterate_replays(dataset, tasks, n_jobs=n_jobs, keep=keep)}
    return [found[i] for i in range(len(tasks))]
