"""`dengine replay` and `dengine compare`: recorded streams through fresh engines."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .options import (
    RecipeChoice,
    data_options,
    example,
    json_option,
    out_option,
    policy_options,
    read,
    recipe_options,
    seed_option,
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
        click.option(
            "--n-jobs", type=int, default=1, show_default=True, help="Replays at a time; timings are honest with 1 only."
        ),
        click.option("--confirm", is_flag=True, help="Accepted good parts are known to be fine afterwards."),
        click.option("--in-order", is_flag=True, help="Play the stream once, as recorded, drift and all."),
        click.option("--cycles", type=click.IntRange(1), help="Only so many cycles of each stream.  [default: all]"),
        seed_option,
        click.option("--repeats", type=click.IntRange(1), help="Shuffled replays a recipe.  [default: 30]"),
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
    """Replay a recorded stream through fresh engines, shuffled anew each time."""
    _replay("replay", {choice.name: choice.load()}, **options)


@click.command(epilog=example("dengine compare --data insertion --reducers conv,umap,pca --repeats 2 --out out/"))
@data_options()
@click.option("--reducers", default="conv,umap,pca", show_default=True, help="Names or recipe files, with commas between.")
@policy_options
@stream_options
def compare(reducers: str, alpha: float | None, lower_bound: float | None, **options: Any) -> None:
    """Replay the same streams through several reducers or recipes."""
    names = [name.strip() for name in reducers.split(",") if name.strip()]
    if not names:
        raise click.UsageError("--reducers names none; give at least one, as in conv,pca.")
    policy = RecipeChoice(None, None, alpha, lower_bound)
    _replay("compare", {_short(name): policy.load(name) for name in names}, **options)


def _short(name: str) -> str:
    return Path(name).stem if name.endswith(".toml") else name


def _replay(
    verb: str,
    recipes: dict[str, Recipe],
    data: str,
    samples: int | None,
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
    repeats = 1 if in_order else repeats or 30
    dataset = read(data, samples)
    total = repeats * len(recipes) * (cycles or len(dataset))
    with progress(f"replaying {dataset.name}", total, as_json) as advance:
        replays = _run(dataset, recipes, range(seed, seed + repeats), cycles, n_jobs, advance, not in_order, confirm)
    _report(verb, dict(zip(recipes, _parts(replays, repeats), strict=True)), dataset.name, in_order, out, as_json)


def _run(
    dataset: Dataset,
    recipes: dict[str, Recipe],
    seeds: range,
    cycles: int | None,
    n_jobs: int,
    advance: Any,
    shuffle: bool,
    confirm: bool,
) -> list[Replay]:
    from ..experiments.grid import run_replays

    # A bar cannot travel to other processes: there it moves a replay at a time.
    ticks: dict[str, Any] = (
        {"on_cycle": lambda done: advance(1)} if n_jobs == 1 else {"on_done": lambda r: advance(len(r.action))}
    )
    return run_replays(
        dataset, list(recipes.values()), seeds, cycles, n_jobs=n_jobs, shuffle=shuffle, confirm=confirm, **ticks
    )


def _parts(replays: list[Replay], size: int) -> list[list[Replay]]:
    return [replays[i : i + size] for i in range(0, len(replays), size)]


def _report(
    verb: str, by_recipe: dict[str, list[Replay]], data: str, in_order: bool, out: Path | None, as_json: bool
) -> None:
    from ..experiments.tables import frame_of, pool, pooled_table, promise_kept, promise_line, retrain_line

    named = [(name, each) for name, replays in by_recipe.items() for each in replays]
    frame = frame_of([each for _, each in named], [name for name, _ in named])
    rows = [row | {"promise_kept": promise_kept(row)} for row in pool(frame)]
    files = _save(frame, by_recipe, _title(data, by_recipe, in_order), out) if out is not None else []
    retrains = {name: [r for each in replays for r in each.retrains] for name, replays in by_recipe.items()}
    if as_json:
        dropped = {name: sum(not r.accepted for r in reports) for name, reports in retrains.items()}
        rows = [row | {"retrains_dropped": dropped[row["recipe"]]} for row in rows]
        write_json({"verb": verb, "data": data, "in_order": in_order, "rows": rows, "files": files})
        return
    show(pooled_table(rows, _title(data, by_recipe, in_order)))
    show(*(promise_line(row) for row in rows))
    show(*(f"{name}: {retrain_line(reports)}" for name, reports in retrains.items()))
    show(*(f"Wrote {path}" for path in files))


def _title(data: str, by_recipe: dict[str, list[Replay]], in_order: bool) -> str:
    first = next(iter(by_recipe.values()))
    order = "in recorded order" if in_order else "shuffled"
    how = f"{order}, {len(first)} replay{'s' if len(first) > 1 else ''} of {len(first[0].action)} cycles"
    source = "simulated insertions" if data == "insertion" else data
    return f"{', '.join(by_recipe)} on {source}, {how}"


def _save(frame: Any, by_recipe: dict[str, list[Replay]], title: str, out: Path) -> list[Path]:
    from ..experiments.figures import curves, embedding_map, save
    from ..experiments.tables import write_csv

    files = [write_csv(frame, out / "replays.csv"), save(curves(by_recipe, title), out / "curves.png")]
    for name, replays in by_recipe.items():
        picture = embedding_map(replays[0], title=f"{name}, newest parts of one replay (seed {replays[0].seed})")
        files.append(save(picture, out / f"map_{name}.png"))
    return files
