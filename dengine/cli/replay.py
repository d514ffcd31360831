"""`dengine replay`, `compare` and `costs`: recorded streams through fresh engines.

Ctrl-C keeps what was finished.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..errors import SettingError, percent
from .options import (
    ALPHA,
    LOWER_BOUND,
    DataChoice,
    Known,
    Listed,
    Naming,
    OutFolder,
    RecipeChoice,
    data_options,
    example,
    gathered,
    json_option,
    keep_option,
    n_jobs_option,
    names_of,
    out_option,
    policy_options,
    recipe_options,
    seed_option,
    short_name,
)
from .output import duration, end_interrupted, figures, progress, refusals_last, show, write_json

if TYPE_CHECKING:
    import pandas as pd

    from ..datasets import Dataset
    from ..experiments.costs import CostCurve, PolicyCost
    from ..experiments.grid import Task
    from ..experiments.metrics import ErrorRate
    from ..experiments.replay import Contender, Replay

ANSWERS_WITHIN = "5 s"  # what a scheduler has for it, before it counts as not there
FEEDBACKS = {"stops": False, "confirmed": True}


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


def _played(dataset: Dataset, tasks: Sequence[Task], stream: Stream, quiet: bool) -> Finished:
    """Play every task; on Ctrl-C what was finished until then."""
    from ..experiments.grid import iterate_replays

    done: dict[int, Replay] = {}
    found, begin = 0, time.perf_counter()
    cycles = len(tasks) * (stream.cycles or len(dataset))
    with _cluster(stream, dataset) as n_jobs, progress(f"replaying {dataset.name}", cycles, quiet) as advance:
        # A callback cannot travel to other processes: there the bar moves a replay at a time.
        on_cycle = (lambda cycle: advance(1)) if n_jobs == 1 else None
        try:
            for i, one, kept in iterate_replays(dataset, tasks, n_jobs=n_jobs, keep=stream.keep, on_cycle=on_cycle):
                done[i], found = one, found + kept
                if on_cycle is None or kept:
                    advance(len(one))
        except KeyboardInterrupt:
            pass  # what is missing says so
    return Finished([done[i] for i in sorted(done)], len(tasks), found, time.perf_counter() - begin)


@contextmanager
def _cluster(stream: Stream, dataset: Dataset) -> Iterator[int]:
    """n_jobs: replays go to a dask cluster where a scheduler is named, else to processes of this machine."""
    if stream.scheduler is None:
        yield stream.n_jobs
        return
    if find_spec("distributed") is None:
        raise SettingError('Expected dask for --scheduler, it is not installed: pip install "dengine[dask]".')
    from distributed import Client
    from joblib import parallel_config

    connect: Any = Client  # untyped
    try:
        connected = connect(stream.scheduler, timeout=ANSWERS_WITHIN)
    except (OSError, ValueError, MemoryError) as error:  # the last: what answered there speaks another language
        raise SettingError(
            f"Expected --scheduler to be the address of a running dask scheduler, as tcp://host:8786, got "
            f"{stream.scheduler!r}: {error}"
        ) from error
    with connected as client, parallel_config("dask", client=client, scatter=[dataset]):
        yield -1


def _stream(repeats: int | None, in_order: bool, seed: int, **how: Any) -> Stream:
    if in_order and repeats not in (None, 1):
        raise click.UsageError("--in-order plays the one stream once; leave --repeats out.")
    return Stream(range(seed, seed + (1 if in_order else repeats or 30)), shuffle=not in_order, **how)


stream_options = gathered(
    "stream",
    _stream,
    {
        "repeats": click.option(
            "--repeats", type=click.IntRange(1), help="Shuffled replays of each recipe.  [default: 30]"
        ),
        "seed": seed_option,
        "cycles": click.option(
            "--cycles", type=click.IntRange(1), help="Only so many parts of each stream.  [default: all]"
        ),
        "in_order": click.option("--in-order", is_flag=True, help="Play the stream once, as recorded, drift and all."),
        "n_jobs": n_jobs_option(1, "Replays at a time, each in a process; -1: one a core. Timings are honest with 1 only."),
        "keep": keep_option,
        "scheduler": click.option("--scheduler", metavar="ADDRESS", help="Play on a dask cluster, as tcp://host:8786."),
    },
)


@click.command(
    epilog=example("dengine replay --data insertion --reducer conv --alpha 0.1 --lower-bound 0.9 --repeats 3 --out out/")
)
@data_options()
@recipe_options
@click.option("--confirm", is_flag=True, help="Accepted good parts are known to be fine afterwards.")
@stream_options
@out_option
@json_option
def replay(
    choice: RecipeChoice, confirm: bool, source: DataChoice, stream: Stream, out: OutFolder | None, as_json: bool
) -> None:
    """Replay a recorded stream, shuffled, through fresh engines.

    Ctrl-C shows the replays that were finished.
    """
    from ..experiments.replay import Contender

    contender = Contender(choice.name, choice.load())
    _replay("replay", [contender], {"confirms": [confirm]}, source, stream, out, as_json)


LISTS = {
    "alphas": click.option("--alphas", type=Listed(ALPHA), metavar="LIST", help="As in 0.5,0.1,0.05."),
    "lower_bounds": click.option("--lower-bounds", type=Listed(LOWER_BOUND), metavar="LIST", help="As in 0.8,0.9,0.95."),
    "intervals": click.option(
        "--intervals", type=Listed(Known("interval")), cls=Naming, metavar="LIST", help="Of {interval}."
    ),
    "guarantees": click.option(
        "--guarantees",
        type=Listed(Known("guarantee", own=True)),
        cls=Naming,
        metavar="LIST",
        help="Of {guarantee}, module:Class of your own.",
    ),
}


@click.command(epilog=example("dengine compare --data insertion --reducers conv,pca --repeats 2 --out out/"))
@data_options()
@click.option(
    "--reducers",
    "asked",
    cls=Naming,
    metavar="NAMES",
    default="conv,umap,pca",
    show_default=True,
    type=Listed(click.STRING),
    help="With commas between, of {reducer}, TOML files, module:Class of your own; and rivals: {rival}.",
)
@policy_options
@click.option("--paper", is_flag=True, help="The paper's whole grid: 3 alphas, 3 lower bounds, 2 intervals.")
@gathered("lists", lambda **lists: {name: values for name, values in lists.items() if values}, LISTS)
@click.option(
    "--feedback",
    type=Listed(click.Choice(list(FEEDBACKS))),
    default="stops",
    show_default=True,
    metavar="LIST",
    help=f"What is known of accepted parts, of {','.join(FEEDBACKS)}: their stops alone, or of good ones too.",
)
@stream_options
@out_option
@json_option
def compare(
    asked: Sequence[str],
    settings: Mapping[str, Any],
    paper: bool,
    lists: Mapping[str, Any],
    feedback: Sequence[str],
    source: DataChoice,
    stream: Stream,
    out: OutFolder | None,
    as_json: bool,
) -> None:
    """Replay the same streams through several methods.

    Reducers and rivals, under one policy or a grid of them. UMAP takes a minute a replay. Ctrl-C shows the replays that
    were finished.
    """
    if len({short_name(one) for one in asked}) < len(asked):
        raise click.UsageError(f"--reducers needs a name of its own for each, got {', '.join(map(short_name, asked))}.")
    grid: dict[str, Any] = {}
    if paper:
        from ..experiments.paper import GRID

        grid |= GRID
    grid |= lists
    _must_be_listed(settings, grid)
    grid["confirms"] = [FEEDBACKS[name] for name in feedback]
    choice = RecipeChoice(settings=settings)
    _replay("compare", [_contender(name, choice) for name in asked], grid, source, stream, out, as_json)


def _must_be_listed(settings: Mapping[str, Any], lists: Iterable[str]) -> None:
    """UsageError for one value of a setting of which a list is tried."""
    for name in settings:
        if f"{name}s" in lists:
            flag = name.replace("_", "-")
            raise click.UsageError(f"--{flag} names one value, here it is asked for: name those to be tried, --{flag}s.")


def _contender(asked: str, choice: RecipeChoice) -> Contender:
    """A rival by its name, else a recipe; with the settings that were given."""
    from ..experiments.replay import Contender

    if asked in names_of("rival"):
        return replace(Contender.load(asked), recipe=choice.load())
    return Contender(short_name(asked), choice.load(asked))


def _replay(
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
    finished = _played(dataset, tasks, stream, as_json)
    if finished.replays:
        _report(verb, finished, dataset, stream, out, as_json)
    if finished.interrupted:
        kept = "the table shows those" if finished.replays else "there is nothing to show"
        end_interrupted(f"Interrupted: {len(finished.replays)} of {len(tasks)} replays were finished; {kept}.")


def _report(verb: str, finished: Finished, dataset: Dataset, stream: Stream, out: OutFolder | None, as_json: bool) -> None:
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
    frame = frame_of(replays)
    dropped = frame.assign(dropped=[sum(not each.accepted for each in one.retrains) for one in replays])
    sums = dropped.groupby(CONDITION, sort=False)["dropped"].sum()
    rows = [
        row | {"promise_kept": promise_kept(row), "retrains_dropped": int(n)}
        for row, n in zip(pool(frame, replays), sums, strict=True)
    ]
    by_name = _grouped(replays, lambda each: each.name)
    title = _title(dataset.name, by_name, not stream.shuffle)
    with refusals_last() as attempt:
        files = [] if out is None else attempt(lambda: out.listed(_save(frame, replays, title, out)))
        found = _findings(frame)
        if as_json:
            about = {"verb": verb, "data": dataset.name, "in_order": not stream.shuffle, "faults": dataset.faults}
            costs = _replay_costs(finished) | {"found": finished.found}
            about |= {"interrupted": finished.interrupted, "findings": found, "costs": costs, "files": files}
            write_json(about | {"rows": rows})
            return
        show(pooled_table(rows, title), *promise_lines(rows))
        for name, some in by_name.items():
            show(f"{name}: {retrain_line([each for one in some for each in one.retrains])}{encoder_line(some)}")
        show(*finding_lines(found), _cost_line(finished), *(f"Wrote {path}" for path in files))


def _grouped(replays: Sequence[Replay], key: Callable[[Replay], str]) -> dict[str, list[Replay]]:
    groups: dict[str, list[Replay]] = {}
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


def _varies(frame: pd.DataFrame, *names: str) -> bool:
    return any(len(frame[name].unique()) > 1 for name in names)


def _is_grid(frame: pd.DataFrame) -> bool:
    return _varies(frame, "interval", "alpha", "lower_bound")


def _findings(frame: pd.DataFrame) -> list[Any]:
    """The paper's findings, where a grid was played under one guarantee and one feedback."""
    from ..experiments.paper import findings

    return findings(frame) if _is_grid(frame) and not _varies(frame, "guarantee", "stops", "confirm") else []


def _save(frame: pd.DataFrame, replays: Sequence[Replay], title: str, out: OutFolder) -> list[Path]:
    from ..experiments.figures import curves, embedding_map, grid_figure, save
    from ..experiments.paper import grid_lines
    from ..experiments.tables import write_csv
    from ..files import write_output

    files = [write_csv(frame, out.path / "replays.csv", out.force)]
    pictures: dict[str, Any] = {}
    if _is_grid(frame):
        page = "\n".join(grid_lines(frame)) + "\n"
        files.append(write_output(out.path / "tables.md", page.encode("utf-8"), out.force, make_folder=True))
        grids = _grouped(replays, lambda each: _row_name(each, frame, "interval"))
        pictures |= {f"grid_{name}": lambda some=some, name=name: grid_figure(some, name) for name, some in grids.items()}
    else:
        by_row = _grouped(replays, lambda each: _row_name(each, frame))
        pictures["curves"] = lambda: curves(by_row, title)
    for name, (one, *_) in _grouped(replays, lambda each: each.name).items():
        if one.embedded:
            said = f"{name}, newest parts of one replay (seed {one.seed})"
            pictures[f"map_{name}"] = lambda one=one, said=said: embedding_map(one, title=said)
    for name, draw in pictures.items():
        safe = re.sub(r"[^\w.=-]+", "_", name)
        files.append(save(draw(), out.path / f"{safe}.png", force=out.force))
    return files


def _row_name(replay: Replay, frame: pd.DataFrame, *more: str) -> str:
    """The contender, and in which of the columns that vary it differs from its other rows."""
    policy = replay.recipe.policy
    known = "good ones confirmed" if replay.confirm else "stops alone"
    said = {"guarantee": policy.guarantee, "stops": policy.stops, "confirm": known, "interval": policy.interval}
    return ", ".join([replay.name, *(word for name, word in said.items() if name in more or _varies(frame, name))])


def _replay_costs(finished: Finished) -> dict[str, float]:
    return {"seconds": finished.seconds, "core_seconds": sum(each.seconds for each in finished.replays)}


def _cost_line(finished: Finished) -> str:
    seconds, core = (duration(each) for each in _replay_costs(finished).values())
    several = "" if len(finished.replays) == 1 else "s"
    kept = f"; {finished.found} were there from an earlier run" if finished.found else ""
    return f"{len(finished.replays)} replay{several}, {core} of one core's time, in {seconds}{kept}."


CAPTION = (
    "cost: of a part, the mean over shuffles of {cycles} parts, {reporting} of them; below it what it would be with the "
    "errors at the ends of their 95 % intervals. LB all: everything is verified. late: over the last third of a shuffle, "
    "once something was learned. verified: share of the parts that were checked. bad of accepted, good of rejected: over "
    "these shuffles; below them their intervals. The choice, >, was the cheapest in the other half of the shuffles, so its "
    "figures here are not those that it was picked for. All shuffles play the same parts: parts that were recorded later "
    "are the clean test."
)
COST = click.FloatRange(0.0)
PRICES = {
    "check": click.option("--check", type=COST, default=5.0, show_default=True, help="What one verification costs."),
    "escape": click.option(
        "--escape", type=COST, required=True, help="What a bad part costs that is accepted: a stop, or worse."
    ),
    "false_reject": click.option(
        "--false-reject", type=COST, required=True, help="What a good part costs that is sent back."
    ),
}


@click.command(
    epilog=example("dengine costs --data insertion --reducer pca --cycles 200 --repeats 2 --escape 120 --false-reject 30")
)
@data_options()
@gathered("prices", dict, PRICES)
@click.option("--unit", default="s", show_default=True, help="Of these costs, for people: s, EUR, ...")
@recipe_options
@click.option("--alphas", type=Listed(ALPHA), metavar="LIST", help="To be tried.  [default: 0.5,0.1,0.05]")
@click.option("--lower-bounds", type=Listed(LOWER_BOUND), metavar="LIST", help="To be tried.  [default: 0.8 to 0.99]")
@click.option(
    "--repeats", type=click.IntRange(2), default=10, show_default=True, help="Shuffles of each policy; half choose."
)
@seed_option
@click.option("--cycles", type=click.IntRange(1), help="Only so many parts of each shuffle.  [default: all]")
@n_jobs_option(-1, "Replays at a time, each in a process; -1: one a core.")
@keep_option
@out_option
@json_option
def costs(
    choice: RecipeChoice,
    prices: dict[str, float],
    unit: str,
    alphas: Sequence[float] | None,
    lower_bounds: Sequence[float] | None,
    source: DataChoice,
    repeats: int,
    seed: int,
    cycles: int | None,
    n_jobs: int,
    keep: Path | None,
    out: OutFolder | None,
    as_json: bool,
) -> None:
    """Say which alpha and LB pay.

    What a part of your recordings costs under each, and where everything is verified. All costs are in one unit, as
    seconds of production or money. Ctrl-C shows the curve of the shuffles that every policy has finished.
    """
    _must_be_listed(choice.settings, ("alphas", "lower_bounds"))
    from ..experiments.costs import ALPHAS, LOWER_BOUNDS, cost_tasks, curve_of
    from ..experiments.metrics import Costs
    from ..experiments.replay import Contender

    priced = Costs(**prices)
    stream = Stream(range(seed, seed + repeats), cycles, n_jobs=n_jobs, keep=keep)
    tried: dict[str, Any] = {"alphas": alphas or ALPHAS, "lower_bounds": lower_bounds or LOWER_BOUNDS}
    tasks = cost_tasks(Contender(choice.name, choice.load()), seeds=stream.seeds, cycles=cycles, **tried)
    finished = _played(source.load(quiet=as_json), tasks, stream, as_json)
    seeds = [each.seed for each in finished.replays]
    if finished.interrupted and sum(seeds.count(seed) == len(tasks) / repeats for seed in set(seeds)) < 2:
        end_interrupted("Interrupted: fewer than two shuffles were finished under every policy; there is nothing to show.")
    _report_costs(curve_of(finished.replays, priced), unit, finished.interrupted, out, as_json)
    if finished.interrupted:
        done = len(finished.replays)
        end_interrupted(f"Interrupted: {done} of {len(tasks)} replays were finished; the shuffles that all have are shown.")


def _report_costs(curve: CostCurve, unit: str, interrupted: bool, out: OutFolder | None, as_json: bool) -> None:
    with refusals_last() as attempt:
        files = [] if out is None else attempt(lambda: out.listed(_save_costs(curve, unit, out)))
        if as_json:
            about = {"verb": "costs", "data": curve.dataset, "unit": unit, "interrupted": interrupted}
            names = ("recipe", "verdict", "policy", "sentence", "baseline", "costs", "cycles", "choosing", "reporting")
            said = {name: getattr(curve, name) for name in names}
            write_json(about | said | {"rows": curve.to_frame().to_dict("records"), "files": files})
            return
        title = f"{curve.recipe} on {curve.dataset}: what a part costs, in {unit}, by alpha and LB"
        every = f"{curve.baseline:.3g}"
        first = ("" if curve.policy else ">", "-", "all", every, every, "100 %", "-", "-")
        rows = [dict(zip(COST_COLUMNS, first, strict=True)), *(_cost_cells(row, curve) for row in curve.rows)]
        show(figures(title, rows, CAPTION.format(reporting=curve.reporting, cycles=curve.cycles)))
        show(curve.sentence, *(f"Wrote {path}" for path in files))


def _save_costs(curve: CostCurve, unit: str, out: OutFolder) -> list[Path]:
    from ..experiments.figures import cost_picture, save
    from ..experiments.tables import write_csv

    table = write_csv(curve.to_frame(), out.path / "costs.csv", out.force)
    return [table, save(cost_picture(curve, unit=unit), out.path / "costs.png", force=out.force)]


COST_COLUMNS = ("", "alpha", "LB", "cost", "late", "verified", "bad of\naccepted", "good of\nrejected")


def _cost_cells(row: PolicyCost, curve: CostCurve) -> dict[str, str]:
    cells = (
        ">" if row.policy == curve.policy else "",
        f"{row.policy.alpha:g}",
        percent(row.policy.lower_bound, "g"),
        f"{row.cost:.3g}" + (f"\n{row.lower:.3g} to {row.upper:.3g}" if row.certain else ""),
        f"{row.late:.3g}",
        percent(row.verified, ".0f"),
        _wrong(row.bad),
        _wrong(row.good),
    )
    return dict(zip(COST_COLUMNS, cells, strict=True))


def _wrong(error: ErrorRate) -> str:
    if not error.decided:
        return "-"
    return f"{error.wrong} of {error.decided}\n{100 * error.lower:.2g} to {percent(error.upper, '.2g')}"
