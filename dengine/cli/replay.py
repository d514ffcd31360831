"""What is shown and written of finished replays: the pooled table, the promise, the paper's form, pictures, costs.

Playing what was asked for, with a bar that says how long it will take; Ctrl-C keeps what was finished.

`dengine replay` and `dengine compare`: recorded streams through fresh engines.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import wraps
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..errors import SettingError
from .options import (
    ALPHA,
    GUARANTEE,
    LOWER_BOUND,
    DataChoice,
    Listed,
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
from .output import duration, end_interrupted, progress, refusals_last, show, write_json

if TYPE_CHECKING:
    import pandas as pd

    from ..datasets import Dataset
    from ..experiments.costs import Forecast
    from ..experiments.grid import Task
    from ..experiments.replay import Contender, Replay

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


MANY_CORES = 1000


def report(verb: str, finished: Finished, dataset: Dataset, stream: Stream, out: OutFolder | None, as_json: bool) -> None:
    """Print the tables, or one JSON document; write CSV, tables and pictures to `out`."""
    from ..experiments.paper import finding_lines
    from ..experiments.tables import (
        CONDITION,
        encoder_line,
        frame_of,
        pool,
        pooled_table,
        promise_kept,
        promise_lines,
        retrain_line,
    )

    replays = finished.replays
    by_name = _grouped(replays, lambda each: each.name)
    frame = frame_of(replays)
    rows = [row | {"promise_kept": promise_kept(row)} for row in pool(frame, replays)]
    title = _title(dataset.name, by_name, not stream.shuffle)
    with refusals_last() as attempt:
        files = [] if out is None else attempt(lambda: out.listed(_save(frame, replays, title, out)))
        retrains = {name: [r for each in some for r in each.retrains] for name, some in by_name.items()}
        found = _findings(frame)
        if as_json:
            dropped = [sum(not r.accepted for r in each.retrains) for each in replays]
            sums = frame.assign(dropped=dropped).groupby(CONDITION, sort=False)["dropped"].sum()
            rows = [row | {"retrains_dropped": int(n)} for row, n in zip(rows, sums, strict=True)]
            about = {
                "verb": verb,
                "data": dataset.name,
                "in_order": not stream.shuffle,
                "interrupted": finished.interrupted,
            }
            about |= {"faults": dataset.faults}
            costs = _costs(finished) | {"found": finished.found}
            write_json(about | {"rows": rows, "findings": found, "costs": costs, "files": files})
            return
        show(pooled_table(rows, title))
        show(*promise_lines(rows))
        show(*(f"{name}: {retrain_line(reports)}{encoder_line(by_name[name])}" for name, reports in retrains.items()))
        show(*finding_lines(found))
        show(_cost_line(finished))
        show(*(f"Wrote {path}" for path in files))


def _grouped(replays: Sequence[Replay], key: Any) -> dict[Any, list[Replay]]:
    groups: dict[Any, list[Replay]] = {}
    for each in replays:
        groups.setdefault(key(each), []).append(each)
    return groups


def _title(data: str, by_name: Mapping[str, list[Replay]], in_order: bool) -> str:
    each = sorted({len({replay.seed for replay in replays}) for replays in by_name.values()})
    cycles = len(next(iter(by_name.values()))[0])
    order = "in recorded order" if in_order else "shuffled"
    how = f"{order}, {' or '.join(map(str, each))} replay{'s' if each[-1] > 1 else ''} of {cycles} cycles"
    source = "simulated insertions" if data == "insertion" else data
    return f"{', '.join(by_name)} on {source}, {how}"


def _is_grid(frame: pd.DataFrame) -> bool:
    return any(_varies(frame, name) for name in ("interval", "alpha", "lower_bound"))


def _varies(frame: pd.DataFrame, name: str) -> bool:
    return len(frame[name].unique()) > 1


def _findings(frame: pd.DataFrame) -> list[Any]:
    """The paper's findings, where a grid was played under one guarantee and one feedback."""
    from ..experiments.paper import findings

    alike = not any(_varies(frame, name) for name in ("guarantee", "stops", "confirm"))
    return findings(frame) if alike and _is_grid(frame) else []


def _save(frame: pd.DataFrame, replays: Sequence[Replay], title: str, out: OutFolder) -> list[Path]:
    from ..experiments.figures import curves, embedding_map, save
    from ..experiments.tables import write_csv

    files = [write_csv(frame, out.path / "replays.csv", out.force)]
    if _is_grid(frame):
        files += _save_grid(frame, replays, out)
    else:
        by_row = _grouped(replays, lambda each: _row_name(each, frame))
        files.append(save(curves(by_row, title), out.path / "curves.png", force=out.force))
    for name, some in _grouped(replays, lambda each: each.name).items():
        if some[0].embedded:
            picture = embedding_map(some[0], title=f"{name}, newest parts of one replay (seed {some[0].seed})")
            files.append(save(picture, out.path / f"map_{_slug(name)}.png", force=out.force))
    return files


def _save_grid(frame: pd.DataFrame, replays: Sequence[Replay], out: OutFolder) -> list[Path]:
    from ..experiments.figures import grid_figure, save
    from ..experiments.paper import grid_lines
    from ..files import write_output

    page = "\n".join(grid_lines(frame)) + "\n"
    files = [write_output(out.path / "tables.md", page.encode("utf-8"), out.force, make_folder=True)]
    for name, some in _grouped(replays, lambda each: _row_name(each, frame, "interval")).items():
        files.append(save(grid_figure(some, name), out.path / f"grid_{_slug(name)}.png", force=out.force))
    return files


def _row_name(replay: Replay, frame: pd.DataFrame, *more: str) -> str:
    """The contender, and in which of the columns that vary it differs from its other rows."""
    policy = replay.recipe.policy
    known = "good ones confirmed" if replay.confirm else "stops alone"
    said = {"guarantee": policy.guarantee, "stops": policy.stops, "confirm": known, "interval": policy.interval}
    return ", ".join([replay.name, *(word for name, word in said.items() if name in more or _varies(frame, name))])


def _slug(name: str) -> str:
    return re.sub(r"[^\w.=-]+", "_", name)


def _costs(finished: Finished) -> dict[str, float]:
    from ..experiments.costs import makespan

    seconds = [each.seconds for each in finished.replays]
    alone = {f"on_{MANY_CORES}_cores_s": makespan(seconds, MANY_CORES)}
    return {"seconds": finished.seconds, "core_seconds": sum(seconds)} | alone


def _cost_line(finished: Finished) -> str:
    costs = _costs(finished)
    many = "" if len(finished.replays) == 1 else "s"
    kept = f"; {finished.found} were there from an earlier run" if finished.found else ""
    return (
        f"{len(finished.replays)} replay{many}, {duration(costs['core_seconds'])} of one core's time, in "
        f"{duration(costs['seconds'])}{kept}. {MANY_CORES:,} cores would take "
        f"{duration(costs[f'on_{MANY_CORES}_cores_s'])}, their start left out."
    )


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
    from ..experiments.replay import Contender

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
    from ..experiments.replay import Contender
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
