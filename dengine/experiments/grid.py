"""Repeated replays over recipes, intervals, alphas and lower bounds, on two cores or on a cluster: the paper's grid.

>>> run_grid("insertion", ["conv", "umap"], alphas=[0.1], lower_bounds=[0.9], repeats=30, keep="out/kept")

joblib runs the replays, with the backend that the caller picked: `joblib.parallel_config(backend="dask")` is a cluster.
Finished replays are kept on disk under a hash of all that their decisions depend on: traces and labels, every setting, the
seed, dengine's own source, and the libraries that compute. Nothing is unpickled; an unreadable file is no replay.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from importlib.metadata import distributions
from inspect import getsourcefile, isfunction
from pathlib import Path
from pickle import PicklingError
from typing import TYPE_CHECKING, Any, NamedTuple
from uuid import uuid4

import numpy as np

from ..datasets import Dataset, load_dataset
from ..engine.settings import flat
from ..errors import SettingError
from ..recipe import described
from ..records import RetrainReport
from ..reducers import reducer_class
from .replay import Contender, Replay, replay
from .rivals import require
from .tables import frame_of

if TYPE_CHECKING:
    import pandas as pd

Folder = str | os.PathLike[str]
OnDone = Callable[[Replay], None] | None
TOLD_APART = ("interval", "alpha", "lower_bound", "guarantee", "stops")  # of a policy: columns of their own in every table
LIBRARIES = ("numpy", "scipy", "torch", "scikit-learn", "umap-learn", "numba", "aeon", "mapie", "river")
DAMAGED = (  # what reading a damaged file ends in, by where the damage is
    OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error, RuntimeError
)  # fmt: skip


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
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        digest = hashlib.sha256(f"{data.name} {data.X.shape} {data.rate_hz}".encode())
        for array in (data.X, data.y, data.part):
            digest.update(b"none" if array is None else np.ascontiguousarray(array).tobytes())
        self._of_data = digest.hexdigest()

    def path(self, task: Task) -> Path:
        """Where the replay of a task is kept: a hash of all that its decisions depend on, a reducer's own files among it.

        SettingError for a reducer that cannot be told apart from others.
        """
        who, own = task.contender, task.contender.recipe.reducer
        by_name = isinstance(own, str)
        parts = [reducer_class(own)] if by_name else _parts_of(own)
        handed_in = [] if by_name else [described(own), _digest_of_reducer(own)]
        how = [task.seed, task.cycles, task.shuffle, task.confirm, who.rival, sorted(who.params.items())]
        said = [self._of_data, _digest_of_source(), *map(_source_of, parts), *handed_in, who.recipe.to_toml(), str(how)]
        return self.folder / f"{hashlib.sha256(' | '.join(said).encode()).hexdigest()[:32]}.npz"

    def get(self, task: Task) -> Replay | None:
        """The replay, under the contender's present name; None where it is not there, or damaged."""
        path = self.path(task)
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = dict(file)
            about = json.loads(str(arrays.pop("about")))
            retrains = tuple(RetrainReport(**each) for each in about.pop("retrains"))
            named = about | {"name": task.contender.name, "recipe": task.contender.recipe}
            return Replay(**arrays, **named, retrains=retrains)
        except DAMAGED:
            return None

    def put(self, task: Task, replay: Replay) -> None:
        """Keep a finished replay: the whole file or none, whatever happens meanwhile."""
        values = {each.name: getattr(replay, each.name) for each in fields(replay)}
        arrays: dict[str, Any] = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
        about = {name: value for name, value in values.items() if name not in arrays and name != "recipe"}
        about["retrains"] = [asdict(each) for each in replay.retrains]
        partial = self.folder / f".{uuid4().hex}.partial"
        try:
            with partial.open("xb") as file:
                np.savez_compressed(file, about=np.array(json.dumps(about)), **arrays)
            partial.replace(self.path(task))
        finally:
            partial.unlink(missing_ok=True)


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


def _digest_of_reducer(reducer: Any) -> str:
    """Of all that a transformer holds: arrays and functions too, which its description only names."""
    from joblib import hash as digest

    try:
        return str(digest(reducer))
    except (PicklingError, TypeError, AttributeError) as error:
        raise SettingError(
            f"Expected a reducer that can be told apart from others, to keep its replays; {described(reducer)} holds what "
            f"has no name in a module, as a lambda ({error}); define it in a module, or leave keep out."
        ) from error


def contenders(asked: Sequence[Any]) -> list[Contender]:
    """Each as it was asked for; equal names are followed by the settings in which they differ, but those in `TOLD_APART`.

    SettingError where two are equal; of transformers also where their settings read alike.
    """
    loaded = [Contender.load(one) for one in ([asked] if isinstance(asked, str) else asked)]
    return [_told_apart(one, [other for other in loaded if other.name == one.name and other is not one]) for one in loaded]


def _told_apart(one: Contender, others: Sequence[Contender]) -> Contender:
    """Named by the settings in which it differs from others of its name."""
    own, theirs = _flat(one), [_flat(other) for other in others]
    if (own, one.recipe.policy) in zip(theirs, (other.recipe.policy for other in others), strict=True):
        raise SettingError(
            f"Expected each to be asked for once, got {one.name} twice with the same settings; tell them apart by "
            "Contender(name, recipe)."
        )
    differing = [key for key in own if any(other.get(key) != own[key] for other in theirs)]
    return replace(one, name=" ".join([one.name, *(f"{key}={own[key]}" for key in differing)]))


def _flat(one: Contender) -> dict[str, Any]:
    """Every setting by its name, without those that have columns of their own; a transformer as it reads."""
    plain = {key: value for key, value in flat(one.recipe).items() if key not in (*TOLD_APART, "params")}
    plain["reducer"] = " ".join(str(plain["reducer"]).split())
    return {**plain, **one.recipe.params, **one.params}


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
    SettingError, before anything is played, where a rival's library is missing.
    """
    from joblib import Parallel, delayed

    data = load_dataset(dataset)
    kept = None if keep is None else KeptReplays(keep, data)
    found = {i: one for i, task in enumerate(tasks) if kept and (one := kept.get(task)) is not None}
    yield from (Played(i, one, True) for i, one in found.items())
    left = sorted((i for i in range(len(tasks)) if i not in found), key=lambda i: tasks[i].seed)
    for name in sorted({tasks[i].contender.rival or "" for i in left} - {""}):
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
    guarantees: Sequence[str | None] = (None,),
    confirms: Sequence[bool] = (False,),
    first_seed: int = 0,
    cycles: int | None = None,
    keep: Folder | None = None,
    on_done: OnDone = None,
) -> pd.DataFrame:
    """A row a replay (see `Replay.summary`), over recipes x intervals x alphas x lower_bounds x seeds.

    recipes : a name, or a list of what `replay` takes, rivals too.
    guarantees : "local", "pooled", or None for the recipe's own.  keep : folder by which an interrupted grid goes on.
    confirms : whether accepted good parts are confirmed; False is the paper's feedback, stops alone.
    Source: the paper's experiments, 30 shuffled repeats of a 3 x 3 grid. Timings are honest only with n_jobs=1.
    """
    seeds = range(first_seed, first_seed + repeats)
    tasks = grid_tasks(recipes, alphas, lower_bounds, intervals, seeds, guarantees, confirms, cycles)
    return frame_of(play_tasks(dataset, tasks, n_jobs=n_jobs, keep=keep, on_done=on_done))


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
    for who, *asked, confirm in itertools.product(
        contenders(recipes), intervals, alphas, lower_bounds, guarantees, confirms
    ):
        changes = {name: value for name, value in zip(names, asked, strict=True) if value is not None}
        tasks += [Task(who.with_policy(**changes), seed, cycles, shuffle, confirm) for seed in seeds]
    return tasks


def play_tasks(
    dataset: Any, tasks: Sequence[Task], *, n_jobs: int = 1, keep: Folder | None = None, on_done: OnDone = None
) -> list[Replay]:
    """Each task's replay, in the tasks' order. on_done : called with each as it ends. The rest as in `iterate_replays`."""
    found: dict[int, Replay] = {}
    for i, one, _ in iterate_replays(dataset, tasks, n_jobs=n_jobs, keep=keep):
        found[i] = one
        if on_done is not None:
            on_done(one)
    return [found[i] for i in range(len(tasks))]
