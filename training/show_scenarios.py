"""Each scenario of the simulated cell in one picture: what changes in the force, and what the engine does about it.

    python training/show_scenarios.py --cycles 800 --n-jobs 2 --out docs/scenarios.png

Every scenario is one live run from the first part, the same engine, the same seed. Also prints what happened by quarters.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from dengine import DataEngine, Recipe, SimulatedCell
from dengine.cells.simulation.conditions import RATE_HZ, SCENARIOS, first_change
from dengine.experiments.figures import BAD, GOOD, LIMIT, SMALL, draw_errors, draw_verified, plain, save
from dengine.experiments.replay import Replay, watch

WINDOW = 100  # cycles
CHANGES = {"wear": "wear begins to grow", "variant": "the new variant comes", "bias_jump": "the offset jumps"}


@dataclass(frozen=True)
class Run:
    """One scenario's traces (n, T) and what the engine did."""

    scenario: str
    traces: np.ndarray
    log: Replay


def run(scenario: str, cycles: int, recipe: Recipe, seed: int) -> Run:
    """One live run from the first part."""
    cell, traces = SimulatedCell(scenario=scenario, seed=seed, cycles=cycles), []
    engine = DataEngine.from_recipe(recipe, seed=seed, replaying=True)
    log = watch(engine, cell, cycles, on_cycle=lambda cycle: traces.append(cell.last.trace))
    return Run(scenario, np.stack(traces), log)


def draw_force(axes: Axes, one: Run) -> None:
    """Median trace of good and bad parts, first quarter dotted, last quarter solid."""
    n = len(one.log)
    time_s = np.arange(one.traces.shape[1]) / RATE_HZ
    for when, part, style in (("first quarter", slice(n // 4), ":"), ("last quarter", slice(n - n // 4, n), "-")):
        for label, name, colour in ((1.0, "good", GOOD), (0.0, "bad", BAD)):
            mine = one.traces[part][one.log.truth[part] == label]
            if len(mine):
                axes.plot(time_s, np.median(mine, axis=0), style, color=colour, label=f"{name} parts, {when}")
    axes.set(title=one.scenario, xlabel="time [s]")


def draw_change(top: Axes, bottom: Axes, one: Run) -> None:
    """The moment from which on the cell is another one, in both panels."""
    cycle = first_change(one.scenario, len(one.log))
    if cycle is None:
        return
    for axes in (top, bottom):
        axes.axvline(cycle, **LIMIT)
    top.text(cycle, 1.01, CHANGES[one.scenario], transform=top.get_xaxis_transform(), fontsize=SMALL, va="bottom")


def picture(runs: list[Run]) -> Figure:
    """A column a scenario: force, verified share, errors."""
    figure = Figure(figsize=(4 * len(runs), 9), layout="constrained")
    grid = figure.subplots(3, len(runs), sharey="row", squeeze=False)
    for (force, verified, errors), one in zip(grid.T, runs, strict=True):
        draw_force(force, one)
        draw_verified(verified, one.log.verified, WINDOW)
        draw_errors(errors, one.log.false_positive, one.log.false_negative)
        draw_change(verified, errors, one)
        errors.set(xlabel="cycle")
    for axes in grid.flat:
        plain(axes)
    names = ("simulated z-force [N]", f"verified, last {WINDOW} [%]", "errors so far [parts]")
    for axes, name in zip(grid[:, 0], names, strict=True):
        axes.set_ylabel(name)
    handles = [each for axes in (grid[0, 0], grid[2, 0]) for each in axes.get_legend_handles_labels()[0]]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    figure.suptitle("Simulated cell: what changes in the force, and what the engine does")
    return figure


def table_of(runs: list[Run]) -> Table:
    """What happened, a row a quarter."""
    table = Table("scenario", "cycles", "verified", "accepted", "bad ones", "rejected", "good ones", title="simulated")
    for one in runs:
        for row in one.log.stretches(4):
            counts = (row[name] for name in ("accepted", "false_positive", "rejected", "false_negative"))
            cycles = f"{row['first_cycle']} to {row['last_cycle']}"
            table.add_row(one.scenario, cycles, f"{row['verified_share']:.0%}", *map(str, counts))
    return table


def main() -> None:
    """Parse, run, draw, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cycles", type=int, default=800, help="parts in each run (default: 800)")
    parser.add_argument("--recipe", default="conv", help="a recipe's name or TOML file (default: conv)")
    parser.add_argument("--seed", type=int, default=0, help="of the cell and of the engine (default: 0)")
    parser.add_argument("--n-jobs", type=int, default=2, help="scenarios at a time (default: 2)")
    parser.add_argument(
        "--out", type=Path, default=Path("docs/scenarios.png"), help="the picture to write (default: docs/scenarios.png)"
    )
    args = parser.parse_args()
    recipe = Recipe.load(args.recipe).with_policy(alpha=0.1, lower_bound=0.9)
    runs = Parallel(n_jobs=args.n_jobs)(delayed(run)(s, args.cycles, recipe, args.seed) for s in SCENARIOS)
    Console(width=120).print(table_of(runs))
    save(picture(runs), args.out, dpi=80, force=True)


if __name__ == "__main__":
    main()
