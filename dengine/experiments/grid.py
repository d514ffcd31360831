"""Repeated replays over recipes, alphas, lower bounds and intervals: the paper's grid.

>>> run_grid("insertion", ["conv", "umap"], alphas=[0.1], lower_bounds=[0.9], repeats=30)
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..datasets import load_dataset
from ..recipe import RECIPES, Recipe
from .replay import Replay, replay

if TYPE_CHECKING:
    import pandas as pd


def iterate_replays(
    dataset: Any, tasks: Iterable[tuple[Any, int]], cycles: int | None = None, *, n_jobs: int = 1, **options: Any
) -> Iterator[Replay]:
    """The replay of each (recipe, seed), in that order, each as soon as it is done: what was finished can be kept.

    options : as in `replay`. joblib runs them, with the backend that the caller picked (`joblib.parallel_config`).
    """
    from joblib import Parallel, delayed

    data = load_dataset(dataset)
    replays: Iterator[Replay] = Parallel(n_jobs=n_jobs, return_as="generator")(
        delayed(replay)(data, Recipe.load(recipe), seed, cycles, **options) for recipe, seed in tasks
    )
    yield from replays


def run_replays(
    dataset: Any,
    recipes: Sequence[Any],
    seeds: Iterable[int],
    cycles: int | None = None,
    *,
    n_jobs: int = 1,
    on_done: Callable[[Replay], None] | None = None,
    **options: Any,
) -> list[Replay]:
    """Every recipe under every seed, in parallel; a list in that order. n_jobs, options : as in `iterate_replays`."""
    tasks = list(itertools.product([Recipe.load(r) for r in recipes], seeds))
    results = []
    for result in iterate_replays(dataset, tasks, cycles, n_jobs=n_jobs, **options):
        results.append(result)
        if on_done is not None:
            on_done(result)
    return results


def run_grid(
    dataset: Any,
    recipes: Sequence[Any],
    alphas: Sequence[float] = (0.5, 0.1, 0.05),
    lower_bounds: Sequence[float] = (0.8, 0.9, 0.95),
    intervals: Sequence[str] = ("wilson",),
    repeats: int = 30,
    n_jobs: int = -1,
    *,
    first_seed: int = 0,
    cycles: int | None = None,
    on_done: Callable[[Replay], None] | None = None,
) -> pd.DataFrame:
    """A row a replay (see `Replay.summary`), over recipes x intervals x alphas x lower_bounds x seeds.

    The column `recipe` is a recipe's name as it was asked for, so that two of one reducer stay apart.

    Source: the paper's experiments, 30 shuffled repeats of a 3 x 3 grid. Timings are honest only with n_jobs=1.
    """
    import pandas as pd

    conditions = list(itertools.product(recipes, intervals, alphas, lower_bounds))
    variants = [
        Recipe.load(recipe).with_policy(interval=interval, alpha=alpha, lower_bound=bound)
        for recipe, interval, alpha, bound in conditions
    ]
    seeds = range(first_seed, first_seed + repeats)
    replays = run_replays(dataset, variants, seeds, cycles, n_jobs=n_jobs, on_done=on_done)
    names = [name_of(recipe) for recipe, *_ in conditions for _ in seeds]
    return pd.DataFrame([r.summary() | {"recipe": name} for r, name in zip(replays, names, strict=True)])


def name_of(recipe: Any) -> str:
    """What to call a recipe in a table: the name or the file that was asked for, else its reducer."""
    if isinstance(recipe, str | os.PathLike) and (str(recipe) in RECIPES or Path(recipe).is_file()):
        return Path(recipe).stem
    return Recipe.load(recipe).name
