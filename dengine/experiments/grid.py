"""Grids of replays over recipes, intervals, alphas and lower bounds, on one machine or a cluster.
`run_grid` plays one and returns a table; `dengine compare` and `dengine costs` play theirs by
`grid_tasks` and `iterate_replays`.

>>> run_grid("insertion", ["conv", "umap"], alphas=[0.1], lower_bounds=[0.9], repeats=3, keep="out")

joblib runs the replays with the caller's backend: `joblib.parallel_config(backend="dask")` uses a
cluster. `KeptReplays` keeps finished replays on disk, so that an interrupted grid continues.
"""

import hashlib
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
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
from ..files import FilePath, read_archive, read_errors, write_output
from ..recipe import without_none
from ..records import RetrainReport
from ..reducers import reducer_class
from .baselines import baseline_class
from .replay import Contender, Replay, replay
from .tables import frame_of

if TYPE_CHECKING:
    import pandas as pd

PAPER_GRID: dict[str, tuple[Any, ...]] = {  # of the paper's experiments
    "alphas": (0.5, 0.1, 0.05),
    "lower_bounds": (0.8, 0.9, 0.95),
    "intervals": ("wilson", "binomial"),
}
KEPT_VALUES = ("dataset", "seed", "confirm", "seconds")  # of a kept replay, beside its arrays
LIBRARIES = ("numpy", "scipy", "torch", "scikit-learn", "umap-learn", "numba", "aeon")


@dataclass(frozen=True)
class Task:
    """One replay to be played; the data set is named beside it.

    Parameters
    ----------
    contender : Contender
        Who plays.
    seed : int
        Of the shuffle and of the engine.
    cycles : int or None, default None
        How many; None plays the whole data set.
    shuffle : bool, default True
        False plays the recorded order.
    """

    contender: Contender
    seed: int
    cycles: int | None = None
    shuffle: bool = True


class KeptReplays:
    """A folder of finished replays of one data set, created if it is missing.

    A replay's file is named by a hash of everything that its decisions depend on: traces and
    labels, all settings, the seed, the source of dengine and of the user's own reducer, and the
    versions of the libraries that compute. Nothing is unpickled.

    Parameters
    ----------
    folder : path
    data : Dataset

    Raises
    ------
    OSError
        If the folder cannot be made.
    """

    def __init__(self, folder: FilePath, data: Dataset) -> None:
        from joblib import hash as digest

        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self._data_digest = digest((data.name, data.X, data.y, data.part, data.rate_hz))

    def path(self, task: Task) -> Path:
        """Return the path of the file of a task's replay in the folder, whether or not it exists.

        A task is a replay to be played. The name of the file is a hash of what the decisions depend
        on: data, settings, seed, the versions of Python and of `LIBRARIES` (those that compute,
        like torch), the source code of dengine, and the files that define the reducer's classes and
        functions. Other files of the user's are not in it, for example one with a base class, a
        decision rule or a baseline. A reducer that is a `module:Class` is imported.

        Raises
        ------
        SettingError
            The reducer holds an object that cannot be hashed, such as a lambda, or its class
            cannot be imported or is no scikit-learn transformer.
        """
        from joblib import hash as digest

        contender = task.contender
        reducer = contender.recipe.reducer
        if isinstance(reducer, str):
            code = [reducer_class(reducer)]
        else:
            code = _classes_and_functions(reducer)
        sources = [_source_of(item) for item in code]
        settings = (
            task.seed,
            task.cycles,
            task.shuffle,
            contender.baseline,
            contender.recipe.to_toml(),
            # A transformer with everything that it holds: arrays and functions too.
            reducer,
        )
        try:
            name = digest((self._data_digest, _digest_of_source(), sources, settings))
        except (PicklingError, TypeError, AttributeError) as error:
            raise SettingError(
                "Expected a reducer that can be told apart from others, to keep its replays; "
                f"{contender.name} holds something without a name in a module, such as a lambda "
                f"({error}): define it in a module, or leave keep out."
            ) from error
        return self.folder / f"{name}.npz"

    def get(self, task: Task) -> Replay | None:
        """Read the replay of a task from the folder and return it; None if there is none.

        None is also returned if its file is damaged or cannot be read. A task is a replay to be
        played, in which recorded parts are decided on as in a robot cell. The replay gets the name
        and recipe of the task's contender, who plays it (dengine with a recipe, or a baseline).
        Raises SettingError as `path` does, for example for a reducer (it maps traces to points)
        that cannot be hashed.
        """
        path = self.path(task)
        try:
            with read_errors(path, "a kept replay"):
                arrays: dict[str, Any] = read_archive(path)[0]
                values = json.loads(str(arrays.pop("about")))
                retrains = tuple(RetrainReport(**report) for report in values.pop("retrains"))
                return Replay(
                    **arrays,
                    **values,
                    name=task.contender.name,
                    recipe=task.contender.recipe,
                    retrains=retrains,
                )
        except DataError:
            return None

    def put(self, task: Task, replay: Replay) -> None:
        """Write the finished replay of a task into the folder, replacing an earlier file of it.

        A task is a replay to be played. The file is compressed, and is written as a whole or not at
        all. The name and the recipe of the replay are not written, since `get` takes them from the
        task. Raises OutputError if the file cannot be written, and SettingError as `path` does, for
        example for a reducer that cannot be hashed.
        """
        values: dict[str, Any] = {name: getattr(replay, name) for name in KEPT_VALUES}
        values["retrains"] = [asdict(report) for report in replay.retrains]
        arrays: dict[str, Any] = {
            name: value for name, value in vars(replay).items() if isinstance(value, np.ndarray)
        }
        buffer = BytesIO()
        np.savez_compressed(buffer, about=np.array(json.dumps(values)), **arrays)
        write_output(self.path(task), buffer.getvalue(), force=True)


@cache
def _digest_of_source() -> str:
    """Return a hash of dengine's Python files and of library versions, as hexadecimal text.

    The versions are those of Python (only its first two numbers) and of `LIBRARIES`, those that
    compute, like numpy and torch; libraries that are not installed are left out. The hash is
    computed once in a process.
    """
    versions = {
        distribution.metadata["Name"]: distribution.version
        for name in LIBRARIES
        for distribution in distributions(name=name)
    }
    digest = hashlib.sha256(f"{sys.version_info[:2]} {versions}".encode())
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


@cache  # a file that changes while a grid is played is not what was imported
def _source_of(class_or_function: Any) -> str:
    """Return the text of the source file of a class or function; "" if there is no readable file.

    It is read once in a process for each class or function; later changes are not seen.
    """
    try:
        return Path(getsourcefile(class_or_function) or "").read_text(encoding="utf-8")
    except (OSError, TypeError, UnicodeDecodeError):
        return ""


def _classes_and_functions(reducer: Any) -> list[Any]:
    """Return the classes and functions whose code a scikit-learn transformer runs, without repeats.

    These are the class of `reducer`, the transformer, the classes of the estimators among its
    parameters (all objects with a method `fit`, also those nested in others), and the functions
    among its parameters.
    """
    params = reducer.get_params(deep=True).values()
    classes = (type(param) for param in params if hasattr(param, "fit"))
    functions = (param for param in params if isfunction(param))
    return list(dict.fromkeys([type(reducer), *classes, *functions]))


def load_contenders(recipes: Sequence[Any]) -> list[Contender]:
    """Return a list of contenders, each loaded from anything that `Contender.load` takes.

    A contender plays a stream of parts: it is dengine with a recipe (all settings of an engine), or
    a baseline (a method to compare with), under a name. If `recipes` is one text, it gives one
    contender.

    Raises
    ------
    SettingError
        One of them cannot be loaded, or two have the same name and policy (settings of decisions),
        so that no table could tell them apart.
    """
    recipes = [recipes] if isinstance(recipes, str) else recipes
    contenders = [Contender.load(recipe) for recipe in recipes]
    keys = [(contender.name, contender.recipe.policy) for contender in contenders]
    repeated = next((name for name, policy in keys if keys.count((name, policy)) > 1), None)
    expect(
        repeated is None,
        "a name of its own for each",
        repeated,
        "tell them apart by Contender(name, recipe)",
    )
    return contenders


class PlayedReplay(NamedTuple):
    """A finished replay.

    Attributes
    ----------
    position : int
        Of its task among the tasks, from 0.
    replay : Replay
    kept : bool
        Whether it was read from the folder of finished replays, and not played now.
    """

    position: int
    replay: Replay
    kept: bool


def iterate_replays(
    dataset: Any,
    tasks: Sequence[Task],
    *,
    n_jobs: int = 1,
    keep: FilePath | None = None,
    on_cycle: Any = None,
) -> Iterator[PlayedReplay]:
    """Play tasks, each a replay to be played, and yield each replay as soon as it is finished.

    A replay plays the parts of a data set, one in each cycle, through a fresh engine (`replay`).
    Replays that an earlier run kept in the folder `keep` come first. The other tasks are begun seed
    by seed, so that the replays that an interrupted run has finished can be compared; they are
    yielded in the order in which they end. Nothing is read, played or raised before the first
    `next`.

    Parameters
    ----------
    dataset : object
        Anything `load_dataset` takes.
    tasks : sequence of Task
        Each with its contender (dengine with a recipe, or a baseline), seed and number of cycles.
    n_jobs : int, default 1
        Replays at a time, as joblib counts them. Timings are right with 1 alone. 1 plays in this
        thread, which then has one torch thread.
    keep : path or None, default None
        Folder of finished replays, made if it is missing. A replay in it is not played again if
        data, settings, seed, libraries and the code of dengine and of the reducer are the same
        (`KeptReplays.path`), unless its file is damaged; others are added as they end. Other code
        of yours, like that of a baseline, is not compared.
    on_cycle : callable or None, default None
        Called after each cycle with the number of finished cycles of its replay. It is not called
        if `n_jobs` is not 1, because a callback cannot travel to other processes.

    Yields
    ------
    played : PlayedReplay
        The replay, the position of its task among `tasks`, and whether it was read from `keep`.

    Raises
    ------
    SettingError
        A baseline that cannot be found or imported: this is raised after the kept replays were
        yielded, and before anything is played. A replay that cannot be played, see `replay`. With
        `keep` also for a reducer that cannot be hashed or imported, before any replay is yielded.
    DataError, ValueError
        A data set that cannot be read, see `load_dataset`.
    StoreError
        A store, given as the data set, that cannot be opened or read.
    OutputError
        With `keep`, a replay that cannot be written.
    OSError
        If the folder `keep` cannot be made.
    """
    from joblib import Parallel, delayed

    data = load_dataset(dataset)
    kept_replays = None if keep is None else KeptReplays(keep, data)
    finished = {}
    if kept_replays is not None:
        for i, task in enumerate(tasks):
            kept = kept_replays.get(task)
            if kept is not None:
                finished[i] = PlayedReplay(i, kept, True)
    yield from finished.values()
    all_by_seed = sorted(range(len(tasks)), key=lambda i: tasks[i].seed)
    missing = [i for i in all_by_seed if i not in finished]
    for name in sorted({tasks[i].contender.baseline or "" for i in missing} - {""}):
        baseline_class(name)
    for played in Parallel(n_jobs=n_jobs, return_as="generator_unordered")(
        delayed(_play)(data, i, tasks[i], on_cycle if n_jobs == 1 else None) for i in missing
    ):
        if kept_replays is not None:
            kept_replays.put(tasks[played.position], played.replay)
        yield played


def _play(data: Dataset, i: int, task: Task, on_cycle: Any) -> PlayedReplay:
    """Play one task, a replay of the data set to be played, in this process or a joblib worker.

    `i` is the position of the task among all tasks. `on_cycle` is called after each cycle (one
    part) with the number of finished ones; None: nothing is called. Raises what `replay` raises.
    """
    played = replay(
        data,
        task.contender,
        task.seed,
        task.cycles,
        shuffle=task.shuffle,
        on_cycle=on_cycle,
    )
    return PlayedReplay(i, played, False)


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
    keep: FilePath | None = None,
) -> "pd.DataFrame":
    """Replay a data set over recipes x intervals x alphas x lower bounds x seeds.

    Of an accepted part the engine only learns whether it stopped the line, as in the paper.

    Parameters
    ----------
    dataset : object
        Anything `load_dataset` takes.
    recipes : str or sequence
        A name, or a list of what `replay` takes, baselines included.
    alphas, lower_bounds : sequence of float
        Settings of the policy to try.
    intervals : sequence of str, default ("wilson",)
        Names of confidence intervals to try: "wilson" or "binomial".
    repeats : int, default 30
        Shuffles; the seeds count from 0.
    n_jobs : int, default -1
        Replays at a time, as joblib counts them; -1 is one for each core. Timings are right with 1
        alone.
    cycles : int or None, default None
        Parts of each replay; None plays all.
    keep : path or None, default None
        Folder of finished replays, made if it is missing, by which an interrupted grid continues.

    Returns
    -------
    frame : DataFrame
        A row for each replay in the order of `grid_tasks`, see `Replay.summary`.

    Raises
    ------
    SettingError, DataError, StoreError
        As `grid_tasks` and `iterate_replays`; OutputError and OSError only with `keep`.

    References
    ----------
    The paper's experiments: 30 shuffled repeats of a 3 x 3 grid.
    """
    tasks = grid_tasks(recipes, alphas, lower_bounds, intervals, range(repeats), cycles=cycles)
    return frame_of(play_tasks(dataset, tasks, n_jobs=n_jobs, keep=keep))


def grid_tasks(
    recipes: Sequence[Any],
    alphas: Sequence[float | None] = (None,),
    lower_bounds: Sequence[float | None] = (None,),
    intervals: Sequence[str | None] = (None,),
    seeds: Iterable[int] = (0,),
    cycles: int | None = None,
    shuffle: bool = True,
) -> list[Task]:
    """Return every combination of settings as a task, a replay to be played; seeds vary fastest.

    Parameters
    ----------
    recipes : str or sequence
        Recipes or names of baselines (methods to compare with), as `load_contenders` takes them.
    alphas, lower_bounds, intervals : sequence
        Settings of the policy; None leaves one to the recipe.
    seeds : iterable of int
    cycles : int or None, default None
        Parts of each replay; None plays all.
    shuffle : bool, default True
        Of all replays; False plays the recorded order.

    Returns
    -------
    tasks : list of Task
        Ordered by contender (a recipe or baseline as loaded), interval, alpha, lower bound and
        seed.

    Raises
    ------
    SettingError
        A recipe cannot be loaded, the class of its reducer cannot be imported, two have the same
        name and policy, or a setting is out of range. Names and policies are compared as loaded,
        before `alphas` and the others replace settings.
    """
    seeds = list(seeds)
    names = ("interval", "alpha", "lower_bound")
    tasks = []
    for contender, *settings in product(load_contenders(recipes), intervals, alphas, lower_bounds):
        changes = without_none(dict(zip(names, settings, strict=True)))
        changed = contender.with_policy(**changes)
        tasks += [Task(changed, seed, cycles, shuffle) for seed in seeds]
    return tasks


def play_tasks(
    dataset: Any, tasks: Sequence[Task], *, n_jobs: int = 1, keep: FilePath | None = None
) -> list[Replay]:
    """Play all tasks like `iterate_replays`; return their replays in the order of the tasks.

    Replays in the folder `keep` are read instead of played, and the others are added to it. Raises
    what `iterate_replays` raises; then nothing is returned, but finished replays stay in `keep`.
    """
    played = sorted(iterate_replays(dataset, tasks, n_jobs=n_jobs, keep=keep))
    return [item.replay for item in played]
