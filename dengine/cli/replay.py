"""`dengine replay`, `compare` and `costs`: recorded streams through fresh engines.

Ctrl-C keeps what was finished.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click
from click.core import ParameterSource

from ..errors import percent
from . import options
from .options import ALPHA, COUNT, LOWER_BOUND, OWN, RULE, DataChoice, Known, Listed, RecipeChoice, short_name, verb
from .output import Out, end_interrupted, explain_option, explained, progress, tell, written

if TYPE_CHECKING:
    import pandas as pd

    from ..datasets import Dataset
    from ..experiments.costs import PolicyCost
    from ..experiments.grid import Task
    from ..experiments.metrics import ErrorRate
    from ..experiments.replay import Contender, Replay

FEEDBACKS = {"stops": False, "confirmed": True}
VARIED = ("interval", "alpha", "lower_bound")  # in a grid, as the paper's


@dataclass(frozen=True)
class Stream:
    """How streams are played, and what a check takes.

    seeds, cycles, shuffle : as in `grid_tasks`.  n_jobs, keep : as in `iterate_replays`.
    """

    seeds: range
    cycles: int | None = None
    shuffle: bool = True
    n_jobs: int = 1
    keep: Path | None = None
    check_seconds: float = 5.0


class Finished(NamedTuple):
    """The replays that were finished, in their tasks' order.  interrupted : how many, where some are missing.

    costs : wall time and one core's, in seconds; and how many had been kept from an earlier run.
    """

    replays: list[Replay]
    interrupted: str
    costs: dict[str, float]


def _played(dataset: Dataset, tasks: Sequence[Task], stream: Stream) -> Finished:
    """Play every task; on Ctrl-C what was finished until then."""
    from ..experiments.grid import iterate_replays

    done: dict[int, Replay] = {}
    found, begin = 0, time.perf_counter()
    with progress(f"replaying {dataset.name}", len(tasks) * (stream.cycles or len(dataset))) as advance:
        # A callback cannot travel to other processes: there the bar moves a replay at a time.
        on_cycle = (lambda cycle: advance(1)) if stream.n_jobs == 1 else None
        with suppress(KeyboardInterrupt):  # what is missing says so
            for i, one, kept in iterate_replays(dataset, tasks, n_jobs=stream.n_jobs, keep=stream.keep, on_cycle=on_cycle):
                done[i], found = one, found + kept
                advance(len(one) if on_cycle is None or kept else 0)
    some = f"Interrupted: {len(done)} of {len(tasks)} replays were finished" if len(done) < len(tasks) else ""
    core = sum(each.seconds for each in done.values())
    costs = {"seconds": time.perf_counter() - begin, "core_seconds": core, "found": found}
    return Finished([done[i] for i in sorted(done)], some, costs)


def stream_options(repeats: int, least: int, n_jobs: int, text: str) -> Callable[[Any], Any]:
    """How streams are played, handed on as one `Stream`."""

    def stream(repeats: int, in_order: bool, seed: int, **how: Any) -> Stream:
        if in_order and click.get_current_context().get_parameter_source("repeats") is not ParameterSource.DEFAULT:
            raise click.UsageError("--in-order plays the one stream once; leave --repeats out.")
        return Stream(range(seed, seed + (1 if in_order else repeats)), shuffle=not in_order, **how)

    shuffles = click.option("--repeats", type=click.IntRange(least), default=repeats, show_default=True, help=text)
    return options.gathered(
        "stream",
        stream,
        {
            "repeats": shuffles,
            "seed": options.seed_option,
            "cycles": click.option("--cycles", type=COUNT, help="Only so many parts of each stream.  [default: all]"),
            "in_order": click.option("--in-order", is_flag=True, help="Play the stream once, as recorded, drift and all."),
            "n_jobs": options.n_jobs_option(n_jobs, "Replays at a time; -1: one a core. Timings are honest with 1 only."),
            "keep": click.option("--keep", type=options.FOLDER, metavar="FOLDER", help=KEEP),
            "check_seconds": options.check_option,
        },
    )


KEEP = "Finished replays are kept here, and not played again: an interrupted run goes on, other costs come at once."
SHUFFLES = "Shuffled replays of each recipe."
LISTS = {
    "alphas": click.option("--alphas", type=Listed(ALPHA), help="To be tried, as in 0.5,0.1,0.05."),
    "lower_bounds": click.option("--lower-bounds", type=Listed(LOWER_BOUND), help="To be tried, as in 0.8,0.9,0.95."),
}
POLICIES = LISTS | {
    "intervals": click.option("--intervals", type=Listed(Known("interval")), help="To be tried."),
    "guarantees": click.option("--guarantees", type=Listed(Known("guarantee", RULE)), help="To be tried."),
}


@verb("dengine replay --data insertion --reducer conv --alpha 0.1 --lower-bound 0.9 --repeats 3 --out out/")
@options.data_options()
@options.recipe_options
@click.option("--confirm", is_flag=True, help="Accepted good parts are known to be fine afterwards.")
@stream_options(30, 1, 1, SHUFFLES)
@explain_option
@options.out_option
def replay(choice: RecipeChoice, confirm: bool, **played: Any) -> None:
    """Replay a recorded stream, shuffled, through fresh engines.

    Ctrl-C shows the replays that were finished.
    """
    _replay([choice.contender()], {"confirms": [confirm]}, **played)


@verb("dengine compare --data insertion --reducers conv,pca --repeats 2 --out out/")
@options.data_options()
@click.option(
    "--reducers",
    "asked",
    default="conv,umap,pca",
    show_default=True,
    type=Listed(Known("method", OWN)),
    help="With commas between; those that are not dengine's are baselines in the same loop.",
)
@options.policy_options
@click.option("--paper", is_flag=True, help="The paper's whole grid: 3 alphas, 3 lower bounds, 2 intervals.")
@options.gathered("lists", options.given, POLICIES)
@click.option(
    "--feedback",
    type=Listed(click.Choice(list(FEEDBACKS))),
    default="stops",
    show_default=True,
    metavar="LIST",
    help=f"What is known of accepted parts, of {','.join(FEEDBACKS)}: their stops alone, or of good ones too.",
)
@stream_options(30, 1, 1, SHUFFLES)
@explain_option
@options.out_option
def compare(
    asked: Sequence[str],
    settings: Mapping[str, Any],
    paper: bool,
    lists: Mapping[str, Any],
    feedback: Sequence[str],
    **played: Any,
) -> None:
    """Replay the same streams through several methods.

    Reducers and baselines, under one policy or a grid of them. umap-learn takes much longer than the others. Ctrl-C
    shows the replays that were finished.
    """
    if len({short_name(one) for one in asked}) < len(asked):
        raise click.UsageError(f"--reducers needs a name of its own for each, got {', '.join(map(short_name, asked))}.")
    from ..experiments.paper import GRID

    grid: dict[str, Any] = {**(GRID if paper else {}), **lists}
    _must_be_listed(settings, grid)
    who = [RecipeChoice(one, settings).contender() for one in asked]
    _replay(who, grid | {"confirms": [FEEDBACKS[name] for name in feedback]}, **played)


def _must_be_listed(settings: Mapping[str, Any], lists: Iterable[str]) -> None:
    """UsageError for one value of a setting of which a list is tried."""
    for name in settings:
        if f"{name}s" in lists:
            flag = name.replace("_", "-")
            raise click.UsageError(f"--{flag} names one value, here it is asked for: name those to be tried, --{flag}s.")


def _replay(who: Sequence[Contender], grid: Mapping[str, Any], source: DataChoice, stream: Stream, out: Out | None) -> None:
    """Play, and tell what was finished: tables, or one JSON document; CSV, tables and pictures in `out`."""
    from ..experiments import tables
    from ..experiments.grid import grid_tasks
    from ..experiments.paper import findings

    dataset = source.load()
    tasks = grid_tasks(who, seeds=stream.seeds, cycles=stream.cycles, shuffle=stream.shuffle, **grid)
    finished = _played(dataset, tasks, stream)
    if not (replays := finished.replays):
        end_interrupted(f"{finished.interrupted}; there is nothing to show.")
    frame = tables.frame_of(replays, stream.check_seconds)
    rows = tables.pool(frame, replays)
    by_name = _grouped(replays, lambda each: each.name)
    title = _title(dataset.name, by_name, not stream.shuffle)
    # The paper's findings are of a grid under one guarantee and one feedback.
    found = findings(frame) if _varies(frame, *VARIED) and not _varies(frame, "guarantee", "stops", "confirm") else []
    record = {"data": dataset.name, "in_order": not stream.shuffle, "faults": dataset.faults, "rows": rows}
    record |= {"interrupted": bool(finished.interrupted), "findings": found, "costs": finished.costs}
    lines = [tables.pooled_table(rows, title, explained(tables.LEGEND)), *tables.promise_lines(rows)]
    for name, some in by_name.items():
        retrains = [each for one in some for each in one.retrains]
        lines.append(f"{name}: {tables.retrain_line(retrains)}")
    took, core, kept = (written(name, finished.costs[name]) for name in ("seconds", "core_seconds", "found"))
    again = f"; {kept} of them were kept from before" if finished.costs["found"] else ""
    lines += [*found, f"{len(replays)} replay{'' if len(replays) == 1 else 's'} in {took}, {core} of one core{again}."]
    tell(record, *lines, out=out, made=lambda: dict(_made(frame, replays, title)))
    if finished.interrupted:
        end_interrupted(f"{finished.interrupted}; the table shows those.")


def _grouped(replays: Sequence[Replay], key: Callable[[Replay], str]) -> dict[str, list[Replay]]:
    groups: dict[str, list[Replay]] = {}
    for each in replays:
        groups.setdefault(key(each), []).append(each)
    return groups


def _title(data: str, by_name: Mapping[str, list[Replay]], in_order: bool) -> str:
    each = sorted({len({replay.seed for replay in replays}) for replays in by_name.values()})
    cycles, order = len(next(iter(by_name.values()))[0]), "in recorded order" if in_order else "shuffled"
    how = f"{order}, {' or '.join(map(str, each))} replay{'s' if each[-1] > 1 else ''} of {cycles} cycles"
    return f"{', '.join(by_name)} on {'simulated insertions' if data == 'insertion' else data}, {how}"


def _varies(frame: pd.DataFrame, *names: str) -> bool:
    return any(len(frame[name].unique()) > 1 for name in names)


def _made(frame: pd.DataFrame, replays: Sequence[Replay], title: str) -> Iterator[tuple[str, Any]]:
    import numpy as np

    from ..experiments.figures import curves, embedding_map, grid_figure
    from ..experiments.paper import grid_lines

    yield "replays.csv", frame
    if _varies(frame, *VARIED):
        yield "tables.md", "\n".join(grid_lines(frame)) + "\n"
        for name, some in _grouped(replays, lambda each: _row_name(each, frame, "interval")).items():
            yield _file_name(f"grid_{name}"), grid_figure(some, name)
    else:
        yield "curves.png", curves(_grouped(replays, lambda each: _row_name(each, frame)), title)
    for name, (one, *_) in _grouped(replays, lambda each: each.name).items():
        if not np.isnan(one.position).all():  # baselines embed nothing
            said = f"{name}, newest parts of one replay (seed {one.seed})"
            yield _file_name(f"map_{name}"), embedding_map(one, title=said)


def _file_name(title: str) -> str:
    return re.sub(r"[^\w.=-]+", "_", title) + ".png"


def _row_name(replay: Replay, frame: pd.DataFrame, *more: str) -> str:
    """The contender, and in which of the columns that vary it differs from its other rows."""
    policy = replay.recipe.policy
    known = "good ones confirmed" if replay.confirm else "stops alone"
    said = {"guarantee": policy.guarantee, "stops": policy.stops, "confirm": known, "interval": policy.interval}
    return ", ".join([replay.name, *(word for name, word in said.items() if name in more or _varies(frame, name))])


CAPTION = (
    "cost: of a part, the mean over shuffles of {cycles} parts, {reporting} of them; below it what it would be with the "
    "errors at the ends of their 95 % intervals. LB all: everything is verified. late: over the last third of a shuffle, "
    "once something was learned. verified: share of the parts that were checked. bad of accepted, good of rejected: over "
    "these shuffles; below them their intervals. The choice, >, was the cheapest in the other half of the shuffles, so its "
    "figures here are not those that it was picked for. All shuffles play the same parts: parts that were recorded later "
    "are the clean test."
)
COLUMNS = ("", "alpha", "LB", "cost", "late", "verified", "bad of\naccepted", "good of\nrejected")
SAID = ("recipe", "verdict", "policy", "sentence", "costs", "cycles", "choosing", "reporting")
_COST = click.FloatRange(0.0)
_ESCAPE = "What a bad part costs that is accepted: a stop, or worse."
PRICES = {
    "check": click.option("--check", type=_COST, default=5.0, show_default=True, help="What one verification costs."),
    "escape": click.option("--escape", type=_COST, required=True, help=_ESCAPE),
    "false_reject": click.option("--false-reject", type=_COST, required=True, help="What a good part costs, sent back."),
}


@verb("dengine costs --data insertion --reducer pca --cycles 200 --repeats 2 --escape 120 --false-reject 30")
@options.data_options()
@options.gathered("paid", dict, PRICES)
@click.option("--cost-unit", default="s", show_default=True, help="Of these costs, for people: s, EUR, ...")
@options.recipe_options
@options.gathered("lists", options.given, LISTS)
@stream_options(10, 2, -1, "Shuffles of each policy; half choose.")
@explain_option
@options.out_option
def costs(
    choice: RecipeChoice,
    paid: dict[str, float],
    cost_unit: str,
    lists: Mapping[str, Any],
    source: DataChoice,
    stream: Stream,
    out: Out | None,
) -> None:
    """Say which alpha and LB pay.

    What a part of your recordings costs under each, where everything is verified, and, with --stops all or audits, where
    parts pass by these costs (--guarantee cost). All costs are in one unit, as seconds of production or money. Ctrl-C shows
    the curve of the shuffles that every policy has finished.
    """
    _must_be_listed(choice.settings, ("alphas", "lower_bounds"))
    from ..experiments.costs import ALPHAS, LOWER_BOUNDS, curve_of, priced_tasks
    from ..experiments.figures import cost_picture
    from ..experiments.metrics import Costs
    from ..experiments.tables import figures

    priced, tried = Costs(**paid), {"alphas": ALPHAS, "lower_bounds": LOWER_BOUNDS} | dict(lists)
    tasks = priced_tasks(choice.contender(), priced, **tried, seeds=stream.seeds, cycles=stream.cycles)
    finished = _played(source.load(), tasks, stream)
    seeds = [each.seed for each in finished.replays]
    if finished.interrupted and sum(seeds.count(seed) == len(tasks) / len(stream.seeds) for seed in set(seeds)) < 2:
        end_interrupted("Interrupted: fewer than two shuffles were finished under every policy; there is nothing to show.")
    curve = curve_of(finished.replays, priced)
    frame, every = curve.to_frame(), f"{curve.costs.check:.3g}"
    first = ("" if curve.policy else ">", "-", "all", every, every, "100 %", "-", "-")
    cells = [first, *(_cells(row, row.policy == curve.policy) for row in curve.rows)]
    tell(
        {"data": curve.dataset, "unit": cost_unit, "interrupted": bool(finished.interrupted)}
        | {name: getattr(curve, name) for name in SAID}
        | {"rows": frame.to_dict("records")},
        figures(
            f"{curve.recipe} on {curve.dataset}: what a part costs, in {cost_unit}, by alpha and LB",
            [dict(zip(COLUMNS, each, strict=True)) for each in cells],
            explained(CAPTION.format(reporting=curve.reporting, cycles=curve.cycles)),
        ),
        curve.sentence,
        out=out,
        made=lambda: {"costs.csv": frame, "costs.png": cost_picture(curve, unit=cost_unit)},
    )
    if finished.interrupted:
        end_interrupted(f"{finished.interrupted}; the shuffles that all have are shown.")


def _cells(row: PolicyCost, chosen: bool) -> tuple[str, ...]:
    numbers = (f"{row.policy.alpha:g}", percent(row.policy.lower_bound, "g"))
    numbers = ("by cost", "-") if row.policy.guarantee == "cost" else numbers
    cost = f"{row.cost:.3g}" + (f"\n{row.lower:.3g} to {row.upper:.3g}" if row.certain else "")
    shares = (percent(row.verified, ".0f"), _wrong(row.bad), _wrong(row.good))
    return (">" if chosen else "", *numbers, cost, f"{row.late:.3g}", *shares)


def _wrong(error: ErrorRate) -> str:
    if not error.decided:
        return "-"
    return f"{error.wrong} of {error.decided}\n{100 * error.lower:.2g} to {percent(error.upper, '.2g')}"
