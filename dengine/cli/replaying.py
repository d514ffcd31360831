"""`dengine replay` and `dengine compare`: recorded streams through fresh engines."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .interrupting import end_interrupted
from .listing import Listed
from .options import (
    ALPHA,
    GUARANTEE,
    LOWER_BOUND,
    DataChoice,
    OutFolder,
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
from .playing import Stream, play
from .reporting import report

if TYPE_CHECKING:
    from ..experiments.contenders import Contender


def stream_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """What both verbs ask of their replays, handed on as one `Stream`."""

    @wraps(command)
    def streamed(
        repeats: int | None,
        seed: int,
        cycles: int | None,
        in_order: bool,
        n_jobs: int,
        keep: Path | None,
        scheduler: str | None,
        **others: Any,
    ) -> Any:
        if in_order and repeats not in (None, 1):
            raise click.UsageError("--in-order plays the one stream once; leave --repeats out.")
        seeds = range(seed, seed + (1 if in_order else repeats or 30))
        return command(stream=Stream(seeds, cycles, not in_order, n_jobs, keep, scheduler), **others)

    decorated: Callable[..., Any] = streamed
    for option in (
        json_option,
        out_option,
        click.option("--scheduler", metavar="ADDRESS", help="Play on a dask cluster, as tcp://host:8786."),
        click.option(
            "--keep",
            type=click.Path(file_okay=False, path_type=Path),
            metavar="FOLDER",
            help="Finished replays are kept here, and not played again: an interrupted run goes on.",
        ),
        n_jobs_option(1, "Replays at a time, each in a process; -1: one a core. Timings are honest with 1 only."),
        click.option("--in-order", is_flag=True, help="Play the stream once, as recorded, drift and all."),
        click.option("--cycles", type=click.IntRange(1), help="Only so many parts of each stream.  [default: all]"),
        seed_option,
        click.option("--repeats", type=click.IntRange(1), help="Shuffled replays of each recipe.  [default: 30]"),
    ):
        decorated = option(decorated)
    return decorated


@click.command(
    epilog=example("dengine replay --data insertion --reducer conv --alpha 0.1 --lower-bound 0.9 --repeats 3 --out out/")
)
@data_options()
@recipe_options
@click.option("--confirm", is_flag=True, help="Accepted good parts are known to be fine afterwards.")
@stream_options
def replay(
    choice: RecipeChoice, confirm: bool, source: DataChoice, stream: Stream, out: OutFolder | None, as_json: bool
) -> None:
    """Replay a recorded stream, shuffled, through fresh engines.

    Ctrl-C shows the replays that were finished.
    """
    from ..experiments.contenders import Contender

    contender = Contender(choice.name, choice.load())
    _play("replay", [contender], {"confirms": [confirm]}, source, stream, out, as_json)


FEEDBACKS = {"stops": False, "confirmed": True}


def grid_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Lists of settings that were given, handed on as `grid`, as `grid_tasks` takes them; `--paper` is the paper's own."""

    @wraps(command)
    def gridded(paper: bool, feedback: tuple[str, ...], settings: Mapping[str, Any], **others: Any) -> Any:
        lists = {name: others.pop(name) for name in ("alphas", "lower_bounds", "intervals", "guarantees")}
        for many, one in (("alphas", "alpha"), ("lower_bounds", "lower_bound"), ("guarantees", "guarantee")):
            if (lists[many] or (paper and many != "guarantees")) and one in settings:
                flag = one.replace("_", "-")
                raise click.UsageError(f"--{flag} names one value; leave it out beside --paper or --{flag}s.")
        grid = {name: values for name, values in lists.items() if values}
        if paper:
            from ..experiments.paper import GRID

            grid = GRID | grid
        grid["confirms"] = [FEEDBACKS[name] for name in feedback]
        return command(grid=grid, settings=settings, **others)

    decorated: Callable[..., Any] = gridded
    for option in (
        click.option(
            "--feedback",
            type=Listed(click.Choice(list(FEEDBACKS))),
            default="stops",
            show_default=True,
            metavar="LIST",
            help=f"What is known of accepted parts, of {','.join(FEEDBACKS)}: their stops alone, or of good ones too.",
        ),
        click.option("--guarantees", type=Listed(GUARANTEE), metavar="LIST", help="local,pooled."),
        click.option("--intervals", type=Listed(click.STRING), metavar="LIST", help="As in wilson,binomial."),
        click.option("--lower-bounds", type=Listed(LOWER_BOUND), metavar="LIST", help="As in 0.8,0.9,0.95."),
        click.option("--alphas", type=Listed(ALPHA), metavar="LIST", help="As in 0.5,0.1,0.05."),
        click.option("--paper", is_flag=True, help="The paper's whole grid: 3 alphas, 3 lower bounds, 2 intervals."),
    ):
        decorated = option(decorated)
    return decorated


@click.command(epilog=example("dengine compare --data insertion --reducers conv,pca --repeats 2 --out out/"))
@data_options()
@click.option(
    "--reducers",
    metavar="NAMES",
    default="conv,umap,pca",
    show_default=True,
    help="With commas between: conv, umap, pca, rocket, TOML files, module:Class of your own; and rivals: knn, wskde, "
    "gp, minirocket, mapie, river, always, never.",
)
@policy_options
@grid_options
@stream_options
def compare(
    reducers: str,
    settings: Mapping[str, Any],
    grid: Mapping[str, Any],
    source: DataChoice,
    stream: Stream,
    out: OutFolder | None,
    as_json: bool,
) -> None:
    """Replay the same streams through several methods.

    Reducers and rivals, under one policy or a grid of them. UMAP takes a minute a replay. Ctrl-C shows the replays that
    were finished.
    """
    asked = [name.strip() for name in reducers.split(",") if name.strip()]
    if not asked:
        raise click.UsageError("--reducers names none; give at least one, as in conv,pca.")
    choice = RecipeChoice(settings=settings)
    _play("compare", [_contender(name, choice) for name in _distinct(asked)], grid, source, stream, out, as_json)


def _distinct(asked: list[str]) -> list[str]:
    if len({short_name(one) for one in asked}) < len(asked):
        raise click.UsageError(f"--reducers needs a name of its own for each, got {', '.join(map(short_name, asked))}.")
    return asked


def _contender(asked: str, choice: RecipeChoice) -> Contender:
    """A rival by its name, else a recipe; with the settings that were given."""
    from ..experiments.contenders import Contender
    from ..experiments.rivals import RIVALS

    if asked in RIVALS:
        return replace(Contender.load(asked), recipe=choice.load())
    return Contender(short_name(asked), choice.load(asked))


def _play(
    verb: str,
    who: Sequence[Contender],
    grid: Mapping[str, Any],
    source: DataChoice,
    stream: Stream,
    out: OutFolder | None,
    as_json: bool,
) -> None:
    from ..experiments.grid import grid_tasks

    dataset = source.load(quiet=as_json)
    tasks = grid_tasks(who, seeds=stream.seeds, cycles=stream.cycles, shuffle=stream.shuffle, **grid)
    finished = play(dataset, tasks, stream, as_json)
    if finished.replays:
        report(verb, finished, dataset, stream, out, as_json)
    if finished.interrupted:
        kept = "the table shows those" if finished.replays else "there is nothing to show"
        end_interrupted(f"Interrupted: {len(finished.replays)} of {len(tasks)} replays were finished; {kept}.")
