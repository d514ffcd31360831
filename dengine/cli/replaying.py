"""`dengine replay` and `dengine compare`: recorded streams through fresh engines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .interrupting import end_interrupted
from .options import (
    DataChoice,
    RecipeChoice,
    data_options,
    example,
    json_option,
    n_jobs_option,
    out_option,
    policy_options,
    recipe_options,
    seed_option,
    short_name,
)
from .output import progress, show, write_json

if TYPE_CHECKING:
    from ..datasets import Dataset
    from ..experiments.replay import Replay
    from ..recipe import Recipe


def stream_options(command: Any) -> Any:
    """What both verbs ask of a replay."""
    for option in (
        json_option,
        out_option,
        n_jobs_option(1, "Replays at a time, each in a process; -1: one a core. Timings are honest with 1 only."),
        click.option("--confirm", is_flag=True, help="Accepted good parts are known to be fine afterwards."),
        click.option("--in-order", is_flag=True, help="Play the stream once, as recorded, drift and all."),
        click.option("--cycles", type=click.IntRange(1), help="Only so many parts of each stream.  [default: all]"),
        seed_option,
        click.option("--repeats", type=click.IntRange(1), help="Shuffled replays of each recipe.  [default: 30]"),
    ):
        command = option(command)
    return command


@click.command(
    epilog=example("dengine replay --data insertion --reducer conv --alpha 0.1 --lower-bound 0.9 --repeats 3 --out out/")
)
@data_options()
@recipe_options
@stream_options
def replay(choice: RecipeChoice, **options: Any) -> None:
    """Replay a recorded stream, shuffled, through fresh engines.

    Ctrl-C shows the replays that were finished.
    """
    _replay("replay", {choice.name: choice.load()}, **options)


@click.command(epilog=example("dengine compare --data insertion --reducers conv,pca --repeats 2 --out out/"))
@data_options()
@click.option(
    "--reducers",
    metavar="NAMES",
    default="conv,umap,pca",
    show_default=True,
    help="With commas between: conv, umap, pca, rocket, TOML files, module:Class of your own.",
)
@policy_options
@stream_options
def compare(reducers: str, settings: Mapping[str, Any], **options: Any) -> None:
    """Replay the same streams through several reducers.

    UMAP takes a minute a replay. Ctrl-C shows the replays that were finished.
    """
    asked = [name.strip() for name in reducers.split(",") if name.strip()]
    if not asked:
        raise click.UsageError("--reducers names none; give at least one, as in conv,pca.")
    choice = RecipeChoice(settings=settings)
    _replay("compare", {name: choice.load(one) for name, one in _names(asked).items()}, **options)


def _names(asked: list[str]) -> dict[str, str]:
    """What to call each in tables and file names -> what was asked for."""
    names = {short_name(one): one for one in asked}
    if len(names) < len(asked):
        raise click.UsageError(f"--reducers needs a name of its own for each, got {', '.join(map(short_name, asked))}.")
    return names


@dataclass(frozen=True)
class Finished:
    """The replays that were finished, by recipe, and how many were asked for."""

    by_recipe: Mapping[str, list[Replay]]
    asked: int

    def __len__(self) -> int:
        return sum(len(replays) for replays in self.by_recipe.values())

    @property
    def interrupted(self) -> bool:
        """Whether some are missing."""
        return len(self) < self.asked


def _replay(
    verb: str,
    recipes: dict[str, Recipe],
    source: DataChoice,
    repeats: int | None,
    seed: int,
    cycles: int | None,
    in_order: bool,
    confirm: bool,
    n_jobs: int,
    out: Path | None,
    as_json: bool,
) -> None:
    if in_order and repeats not in (None, 1):
        raise click.UsageError("--in-order plays the one stream once; leave --repeats out.")
    seeds = range(seed, seed + (1 if in_order else repeats or 30))
    dataset = source.load()
    with progress(f"replaying {dataset.name}", len(seeds) * len(recipes) * (cycles or len(dataset)), as_json) as advance:
        finished = _run(dataset, recipes, seeds, cycles, n_jobs, advance, not in_order, confirm)
    if len(finished):
        _report(verb, finished, dataset.name, in_order, out, as_json)
    if finished.interrupted:
        kept = "the table shows those" if len(finished) else "there is nothing to show"
        end_interrupted(f"Interrupted: {len(finished)} of {finished.asked} replays were finished; {kept}.")


def _run(
    dataset: Dataset,
    recipes: dict[str, Recipe],
    seeds: range,
    cycles: int | None,
    n_jobs: int,
    advance: Any,
    shuffle: bool,
    confirm: bool,
) -> Finished:
    from ..experiments.grid import iterate_replays

    # Seed by seed: what an interrupted comparison has finished can be compared.
    tasks = [(name, seed) for seed in seeds for name in recipes]
    finished: dict[str, list[Replay]] = {name: [] for name in recipes}
    # A bar cannot travel to other processes: there it moves a replay at a time.
    ticks: dict[str, Any] = {"on_cycle": lambda done: advance(1)} if n_jobs == 1 else {}
    pairs = [(recipes[name], seed) for name, seed in tasks]
    replays = iterate_replays(dataset, pairs, cycles, n_jobs=n_jobs, shuffle=shuffle, confirm=confirm, **ticks)
    try:
        for (name, _), one in zip(tasks, replays, strict=True):
            finished[name].append(one)
            if not ticks:
                advance(len(one.action))
    except KeyboardInterrupt:
        pass  # what is missing says so
    return Finished({name: some for name, some in finished.items() if some}, len(tasks))


def _report(verb: str, finished: Finished, data: str, in_order: bool, out: Path | None, as_json: bool) -> None:
    from ..experiments.tables import frame_of, pool, pooled_table, promise_kept, promise_line, retrain_line

    by_recipe = finished.by_recipe
    named = [(name, each) for name, replays in by_recipe.items() for each in replays]
    frame = frame_of([each for _, each in named], [name for name, _ in named])
    rows = [row | {"promise_kept": promise_kept(row)} for row in pool(frame)]
    title = _title(data, by_recipe, in_order)
    files = _save(frame, by_recipe, title, out) if out is not None else []
    retrains = {name: [r for each in replays for r in each.retrains] for name, replays in by_recipe.items()}
    if as_json:
        dropped = {name: sum(not r.accepted for r in reports) for name, reports in retrains.items()}
        rows = [row | {"retrains_dropped": dropped[row["recipe"]]} for row in rows]
        about = {"verb": verb, "data": data, "in_order": in_order, "interrupted": finished.interrupted}
        write_json(about | {"rows": rows, "files": files})
        return
    show(pooled_table(rows, title))
    show(*(promise_line(row) for row in rows))
    show(*(f"{name}: {retrain_line(reports)}" for name, reports in retrains.items()))
    show(*(f"Wrote {path}" for path in files))


def _title(data: str, by_recipe: Mapping[str, list[Replay]], in_order: bool) -> str:
    each = sorted({len(replays) for replays in by_recipe.values()})
    cycles = len(next(iter(by_recipe.values()))[0].action)
    order = "in recorded order" if in_order else "shuffled"
    how = f"{order}, {' or '.join(map(str, each))} replay{'s' if each[-1] > 1 else ''} of {cycles} cycles"
    source = "simulated insertions" if data == "insertion" else data
    return f"{', '.join(by_recipe)} on {source}, {how}"


def _save(frame: Any, by_recipe: Mapping[str, list[Replay]], title: str, out: Path) -> list[Path]:
    from ..experiments.figures import curves, embedding_map, save
    from ..experiments.tables import write_csv

    files = [write_csv(frame, out / "replays.csv"), save(curves(by_recipe, title), out / "curves.png")]
    for name, replays in by_recipe.items():
        picture = embedding_map(replays[0], title=f"{name}, newest parts of one replay (seed {replays[0].seed})")
        files.append(save(picture, out / f"map_{name}.png"))
    return files
