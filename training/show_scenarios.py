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

from dengine import DataEngine, Outcome, Recipe, SimulatedCell
from dengine.cells.simulation.parameters import RATE_HZ
from dengine.cells.simulation.scenarios import SCENARIOS
from dengine.experiments.live import RunLog, watch

COLOURS = {1.0: "#0072B2", 0.0: "#D55E00"}  # good, bad


class Recorded:
    """A cell that keeps every trace it gave."""

    def __init__(self, cell: SimulatedCell) -> None:
        self.cell = cell
        self.traces: list[np.ndarray] = []

    @property
    def truth(self) -> bool:
        return self.cell.truth

    @property
    def clock(self) -> float:
        return self.cell.clock

    def insert(self) -> np.ndarray:
        self.traces.append(np.asarray(self.cell.insert()))
        return self.traces[-1]

    def verify(self) -> bool:
        return self.cell.verify()

    def proceed(self) -> Outcome:
        return self.cell.proceed()

    def reject(self) -> None:
        self.cell.reject()


@dataclass(frozen=True)
class Run:
    """One scenario's traces (n, T) and what the engine did."""

    scenario: str
    traces: np.ndarray
    log: RunLog


def run(scenario: str, cycles: int, recipe: Recipe, seed: int) -> Run:
    """One live run from the first part."""
    cell = Recorded(SimulatedCell(scenario=scenario, seed=seed, cycles=cycles))
    log = watch(DataEngine.from_recipe(recipe, seed=seed, replaying=True), cell, cycles)
    return Run(scenario, np.stack(cell.traces), log)


def draw_force(axes: Axes, one: Run) -> None:
    """Median trace of good and bad parts, first quarter dotted, last quarter solid."""
    n = len(one.log)
    time_s = np.arange(one.traces.shape[1]) / RATE_HZ
    for when, part, style in (("first quarter", slice(n // 4), ":"), ("last quarter", slice(n - n // 4, n), "-")):
        for label, name in ((1.0, "good"), (0.0, "bad")):
            mine = one.traces[part][one.log.truth[part] == label]
            axes.plot(time_s, np.median(mine, axis=0), style, color=COLOURS[label], label=f"{name}, {when}")
    axes.set(title=one.scenario, xlabel="time (s)")


def draw_engine(top: Axes, bottom: Axes, one: Run, window: int = 100) -> None:
    """Share of verified parts over the last `window` cycles; wrong decisions so far."""
    kernel = np.ones(window) / window
    cycle = np.arange(window, len(one.log) + 1)
    top.plot(cycle, 100 * np.convolve(one.log.verified, kernel, "valid"), color="0.2")
    top.set(ylim=(0, 105))
    bottom.plot(np.cumsum(one.log.false_positive), color=COLOURS[0.0], label="bad part accepted")
    bottom.plot(np.cumsum(one.log.false_negative), "--", color=COLOURS[1.0], label="good part rejected")
    bottom.set(xlabel="cycle")


def picture(runs: list[Run]) -> Figure:
    """A column a scenario: force, verified share, errors."""
    figure = Figure(figsize=(4 * len(runs), 8), layout="constrained")
    grid = figure.subplots(3, len(runs), sharey="row", squeeze=False)
    for column, one in enumerate(runs):
        draw_force(grid[0, column], one)
        draw_engine(grid[1, column], grid[2, column], one)
    for axes, name in zip(
        grid[:, 0], ("simulated z-force (N)", "verified, last 100 (%)", "errors so far (parts)"), strict=True
    ):
        axes.set_ylabel(name)
    grid[0, 0].legend(fontsize=8)
    grid[2, 0].legend(fontsize=8)
    figure.suptitle("Simulated cell: what changes in the force, and what the engine does")
    return figure


def main() -> None:
    """Parse, run, draw, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cycles", type=int, default=800)
    parser.add_argument("--recipe", default="conv")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--n-jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("docs/scenarios.png"))
    args = parser.parse_args()
    recipe = Recipe.load(args.recipe).with_policy(alpha=0.1, lower_bound=0.9)
    runs = Parallel(n_jobs=args.n_jobs)(delayed(run)(s, args.cycles, recipe, args.seed) for s in SCENARIOS)
    table = Table("scenario", "cycles", "verified", "accepted", "bad ones", "rejected", "good ones", title="simulated")
    for one in runs:
        for row in one.log.stretches(4):
            table.add_row(
                one.scenario,
                f"{row['first_cycle']} to {row['last_cycle']}",
                f"{row['verified_share']:.0%}",
                str(row["accepted"]),
                str(row["false_positive"]),
                str(row["rejected"]),
                str(row["false_negative"]),
            )
    Console(width=120).print(table)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    picture(runs).savefig(args.out, dpi=80)


if __name__ == "__main__":
    main()
