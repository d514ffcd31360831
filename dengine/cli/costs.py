"""`dengine costs`: which alpha and LB pay, by the user's own costs and recordings."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .options import (
    ALPHA,
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
    recipe_options,
    seed_option,
)
from .output import end_interrupted, refusals_last, show, write_json
from .replay import Finished, Stream, play

if TYPE_CHECKING:
    from rich.table import Table

    from ..experiments.costs import CostCurve, PolicyCost
    from ..experiments.metrics import ErrorRate

COST = click.FloatRange(0.0)
CAPTION = (
    "cost: of a part, the mean over shuffles of {cycles} parts, {reporting} of them; below it what it would be with the "
    "errors at the ends of their 95 % intervals. LB all: everything is verified. late: over the last third of a shuffle, "
    "once something was learned. verified: share of the parts that were checked. bad of accepted, good of rejected: over "
    "these shuffles; below them their intervals. The choice, >, was the cheapest in the other half of the shuffles, so its "
    "figures here are not those that it was picked for. All shuffles play the same parts: parts that were recorded later "
    "are the clean test."
)


def price_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """What things cost, handed on as one dict, `prices`, and the unit."""

    @wraps(command)
    def priced(check: float, escape: float, false_reject: float, **others: Any) -> Any:
        return command(prices={"check": check, "escape": escape, "false_reject": false_reject}, **others)

    decorated: Callable[..., Any] = priced
    for option in (
        click.option("--unit", default="s", show_default=True, help="Of these costs, for people: s, EUR, ..."),
        click.option("--false-reject", type=COST, required=True, help="What a good part costs that is sent back."),
        click.option(
            "--escape", type=COST, required=True, help="What a bad part costs that is accepted: a stop, or worse."
        ),
        click.option("--check", type=COST, default=5.0, show_default=True, help="What one verification costs."),
    ):
        decorated = option(decorated)
    return decorated


def curve_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Which policies are tried, as `lists`, and how their replays are played, as one `Stream`."""

    @wraps(command)
    def streamed(
        alphas: Any,
        lower_bounds: Any,
        repeats: int,
        seed: int,
        cycles: int | None,
        n_jobs: int,
        keep: Path | None,
        **others: Any,
    ) -> Any:
        given = {"alphas": alphas, "lower_bounds": lower_bounds}
        stream = Stream(range(seed, seed + repeats), cycles, n_jobs=n_jobs, keep=keep)
        return command(lists={name: values for name, values in given.items() if values}, stream=stream, **others)

    decorated: Callable[..., Any] = streamed
    for option in (
        click.option(
            "--keep",
            type=click.Path(file_okay=False, path_type=Path),
            metavar="FOLDER",
            help="Finished replays are kept here, and not played again: other costs are then answered at once.",
        ),
        n_jobs_option(-1, "Replays at a time, each in a process; -1: one a core."),
        click.option("--cycles", type=click.IntRange(1), help="Only so many parts of each shuffle.  [default: all]"),
        seed_option,
        click.option(
            "--repeats", type=click.IntRange(2), default=10, show_default=True, help="Shuffles of each policy; half choose."
        ),
        click.option(
            "--lower-bounds",
            type=Listed(LOWER_BOUND),
            metavar="LIST",
            help="To be tried.  [default: 0.8,0.9,0.95,0.98,0.99]",
        ),
        click.option("--alphas", type=Listed(ALPHA), metavar="LIST", help="To be tried.  [default: 0.5,0.1,0.05]"),
    ):
        decorated = option(decorated)
    return decorated


@click.command(
    epilog=example("dengine costs --data insertion --reducer pca --cycles 200 --repeats 2 --escape 120 --false-reject 30")
)
@data_options()
@price_options
@recipe_options
@curve_options
@out_option
@json_option
def costs(
    choice: RecipeChoice,
    prices: dict[str, float],
    unit: str,
    lists: dict[str, Any],
    source: DataChoice,
    stream: Stream,
    out: OutFolder | None,
    as_json: bool,
) -> None:
    """Say which alpha and LB pay.

    What a part of your recordings costs under each, and where everything is verified. All costs are in one unit, as
    seconds of production or money. Ctrl-C shows the curve of the shuffles that every policy has finished.
    """
    for name in ("alpha", "lower_bound"):
        if name in choice.settings:
            flag = name.replace("_", "-")
            raise click.UsageError(f"--{flag} names one value, here it is asked for: name those to be tried, --{flag}s.")
    from ..experiments.costs import ALPHAS, LOWER_BOUNDS, cost_tasks, curve_of
    from ..experiments.metrics import Costs
    from ..experiments.replay import Contender

    priced = Costs(**prices)
    tried: dict[str, Any] = {"alphas": ALPHAS, "lower_bounds": LOWER_BOUNDS} | lists
    tasks = cost_tasks(Contender(choice.name, choice.load()), seeds=stream.seeds, cycles=stream.cycles, **tried)
    finished = play(source.load(quiet=as_json), tasks, stream, as_json)
    if finished.interrupted and not _complete(finished, len(tried["alphas"]) * len(tried["lower_bounds"])):
        end_interrupted("Interrupted: fewer than two shuffles were finished under every policy; there is nothing to show.")
    _report(curve_of(finished.replays, priced), unit, finished.interrupted, out, as_json)
    if finished.interrupted:
        done = len(finished.replays)
        end_interrupted(f"Interrupted: {done} of {len(tasks)} replays were finished; the shuffles that all have are shown.")


def _complete(finished: Finished, policies: int) -> bool:
    """Whether two shuffles were played under every policy."""
    seeds = [each.seed for each in finished.replays]
    return sum(seeds.count(seed) == policies for seed in set(seeds)) >= 2


def _report(curve: CostCurve, unit: str, interrupted: bool, out: OutFolder | None, as_json: bool) -> None:
    with refusals_last() as attempt:
        files = [] if out is None else attempt(lambda: out.listed(_save(curve, unit, out)))
        if as_json:
            about = {
                "verb": "costs",
                "data": curve.dataset,
                "recipe": curve.recipe,
                "unit": unit,
                "interrupted": interrupted,
            }
            said = {
                "verdict": curve.verdict,
                "policy": curve.policy,
                "sentence": curve.sentence,
                "baseline": curve.baseline,
            }
            counts = {name: getattr(curve, name) for name in ("costs", "cycles", "choosing", "reporting")}
            write_json(about | said | counts | {"rows": curve.to_frame().to_dict("records"), "files": files})
            return
        show(_table(curve, unit))
        show(curve.sentence, *(f"Wrote {path}" for path in files))


def _save(curve: CostCurve, unit: str, out: OutFolder) -> list[Path]:
    from ..experiments.figures import cost_picture, save
    from ..experiments.tables import write_csv

    table = write_csv(curve.to_frame(), out.path / "costs.csv", out.force)
    return [table, save(cost_picture(curve, unit=unit), out.path / "costs.png", force=out.force)]


def _table(curve: CostCurve, unit: str) -> Table:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    look: dict[str, Any] = {"box": SIMPLE_HEAD, "title_justify": "left", "caption_justify": "left"}
    said = CAPTION.format(reporting=curve.reporting, cycles=curve.cycles)
    title = f"\n{curve.recipe} on {curve.dataset}: what a part costs, in {unit}, by alpha and LB\n"
    table = Table(title=title, caption=f"\n{said}\n", pad_edge=False, show_edge=False, **look)
    for name in ("", "alpha", "LB", "cost", "late", "verified", "bad of\naccepted", "good of\nrejected"):
        table.add_column(name, justify="right", no_wrap=True)
    chosen, every = "" if curve.policy else ">", f"{curve.baseline:.3g}"
    table.add_row(chosen, "-", "all", every, every, "100 %", "-", "-")
    for row in curve.rows:
        table.add_row(">" if row.policy == curve.policy else "", *_cells(row))
    return table


def _cells(row: PolicyCost) -> list[str]:
    return [
        f"{row.policy.alpha:g}",
        f"{100 * row.policy.lower_bound:g} %",
        f"{row.cost:.3g}" + (f"\n{row.lower:.3g} to {row.upper:.3g}" if row.certain else ""),
        f"{row.late:.3g}",
        f"{100 * row.verified:.0f} %",
        _wrong(row.bad),
        _wrong(row.good),
    ]


def _wrong(error: ErrorRate) -> str:
    if not error.decided:
        return "-"
    return f"{error.wrong} of {error.decided}\n{100 * error.lower:.2g} to {100 * error.upper:.2g} %"
