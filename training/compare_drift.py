"""A cell that changes, decided on by dengine and by the paper's recipe: bad parts let pass, and how soon it is noticed.

    python training/compare_drift.py --cycles 3000 --n-jobs 2 --out out/drift

Each scenario of the simulated cell is simulated once and kept below --out; every method then decides on the same parts in
the same order, at (alpha, LB) = (0.1, 90 %): dengine (conv, the pooled guarantee, novelty, safe mode), local (conv under
the paper's rule, with novelty), paper-conv (without), and paper-umap (the paper's recipe, but that it retrains every 300
labels instead of 50: a fit takes seconds). Every bad part that is accepted stops the system. Wear grows from the first
cycle on, the others change half way.

Writes drift.csv, a row a scenario and method, and drift.png. Two numbers with a stroke between are of the two halves.
bad/1000: bad parts accepted for 1,000 parts passed on, checked or not. alarm: cycles from the change until all is verified;
lasts: cycles until that ended. saved: against verifying every part, what stops and good parts sent back cost taken off.
dengine's guarantee is pooled, and it takes accepted parts that no stop follows for good; that of the others is local, and
they know stops alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import options, tell
from joblib import Parallel, delayed
from matplotlib.figure import Figure

from dengine import Policy, Recipe
from dengine.cells.simulation.conditions import CellParameters, find_scenario
from dengine.experiments.figures import LIMIT, RECIPES, SMALL, blank, finish, numbers, save, sliding_mean
from dengine.experiments.metrics import Costs
from dengine.experiments.replay import Replay, replay

WINDOW = 100  # cycles
CHANGES = {"wear": "wear begins to grow", "variant": "the new variant comes", "bias_jump": "the offset jumps"}
POLICY = Policy(alpha=0.1, lower_bound=0.9)
CONV = replace(Recipe.load("conv"), policy=POLICY)
METHODS = {
    "dengine": CONV.with_policy(guarantee="pooled", stops="all"),  # novelty and safe mode with it
    "local": CONV,
    "paper-conv": replace(CONV, novelty=0.0),
    "paper-umap": replace(Recipe.load("paper"), policy=POLICY, novelty=0.0, retrain_every=300),
}
CELL = CellParameters()
COSTS = Costs(CELL.verify_s, CELL.stop_s, CELL.cycle_s + CELL.verify_s)


class Run(NamedTuple):
    """One method over one scenario's stream."""

    scenario: str
    method: str
    log: Replay


def stream(scenario: str, cycles: int, seed: int, n_jobs: int, folder: Path) -> Path:
    """The scenario's labelled traces, simulated where they are not there yet."""
    path = folder / f"{scenario}_{cycles}_{seed}.npz"
    if not path.is_file():
        from dengine.cells.simulation.generate import save_insertions, simulate

        save_insertions(path, simulate(cycles, seed, scenario, n_jobs), seed, scenario)
    return path


def play(scenario: str, method: str, path: Path, seed: int) -> Run:
    """One method from the first part on, in the order of the cycles."""
    return Run(scenario, method, replay(path, METHODS[method], seed, shuffle=False))


def row_of(run: Run) -> dict[str, Any]:
    """What happened, in numbers."""
    log, n = run.log, len(run.log)
    alarm, back = alarm_and_back(log.safe_mode, (first_change(run.scenario, n) or 1) - 1)
    begins = log.safe_mode & ~np.concatenate([[False], log.safe_mode[:-1]])
    total, halves = log.stretch(), (slice(0, n // 2), slice(n // 2, n))
    return {
        "scenario": run.scenario,
        "method": run.method,
        "accepted": total["accepted"],
        "bad": total["false_positive"],
        "bad/1000": " / ".join(f"{escapes(log, half):.1f}" for half in halves),
        "verified": " / ".join(f"{log.verified[half].mean():.0%}" for half in halves),
        "novel": " / ".join(str(log.novel[half].sum()) for half in halves),
        "alarms": " / ".join(str(begins[half].sum()) for half in halves),
        "alarm": "-" if alarm is None else str(alarm),
        "lasts": "-" if alarm is None else str(back or "open"),
        "saved_s": COSTS.saved(total["accepted"] + total["rejected"], total["stops"], total["false_negative"]),
    }


def first_change(name: str, cycles: int) -> int | None:
    """The number, from 1, of the first cycle that is not as at the beginning; None where nothing changes."""
    change = find_scenario(name)
    return next((i + 1 for i in range(cycles) if change(CELL, i, cycles) != CELL), None)


def escapes(log: Replay, part: slice) -> float:
    """Bad parts accepted per 1,000 parts that were passed on, checked or not; NaN where none was."""
    bad = int(log.false_positive[part].sum())
    passed = int(log.finished[part].sum()) + bad
    return 1000.0 * bad / passed if passed else float("nan")


def alarm_and_back(safe_mode: np.ndarray, change: int) -> tuple[int | None, int | None]:
    """Cycles from the change, an index, until safe mode is on, and from then until it is off again; None: never."""
    on = np.flatnonzero(safe_mode[change:])
    if not len(on):
        return None, None
    off = np.flatnonzero(~safe_mode[change + on[0] :])
    return int(on[0]) + 1, int(off[0]) if len(off) else None


def picture(runs: Sequence[Run]) -> Figure:
    """A column a scenario: verified share above, shaded in safe mode, and bad parts accepted so far; a colour a method."""
    scenarios = list(dict.fromkeys(run.scenario for run in runs))
    title = "Simulated cell that changes: what is still checked, and what slips through"
    figure = blank(max(7.0, 4.4 * len(scenarios)), 6.4, title)
    grid = figure.subplots(2, len(scenarios), sharex=True, sharey="row", squeeze=False)
    colours = dict(zip(METHODS, RECIPES, strict=False))
    for run in runs:
        top, bottom = grid[:, scenarios.index(run.scenario)]
        colour, log, x = colours[run.method], run.log, numbers(len(run.log))
        top.plot(x, 100 * sliding_mean(log.verified, WINDOW), color=colour, label=run.method)
        top.fill_between(x, 0, 104, where=log.safe_mode, step="pre", color=colour, alpha=0.15, linewidth=0)
        bottom.step(x, np.cumsum(log.false_positive), where="post", color=colour)
    for (top, bottom), scenario in zip(grid.T, scenarios, strict=True):
        if (change := first_change(scenario, max(len(run.log) for run in runs))) is not None:
            for axes in (top, bottom):
                axes.axvline(change, **LIMIT)
            top.text(change, 1.01, CHANGES[scenario], transform=top.get_xaxis_transform(), fontsize=SMALL, va="bottom")
        top.set_title(scenario, pad=18)
        finish(top, legend=0, ylim=(0, 104))
        finish(bottom, legend=0, xlabel="cycle", ylim=(0, None))
    grid[0, 0].set_ylabel(f"verified, last {WINDOW} [%]")
    grid[1, 0].set_ylabel("bad parts accepted so far")
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return figure


def main() -> None:
    """Parse, simulate, replay, draw, print."""
    parser = options(__doc__, n_jobs=2, out=Path("out/drift"))
    parser.add_argument("--cycles", type=int, default=3000, help="parts in each stream")
    parser.add_argument("--scenarios", default=",".join(CHANGES), help="with commas between; all that change by default")
    parser.add_argument("--methods", default=",".join(METHODS), help="likewise")
    parser.add_argument("--seed", type=int, default=100, help="of the cell and of the engines")
    args = parser.parse_args()
    methods, scenarios = args.methods.split(","), args.scenarios.split(",")
    if unknown := {*methods, *scenarios} - {*METHODS, *CHANGES}:
        parser.error(f"known are {', '.join(METHODS)}, and {', '.join(CHANGES)}; not {', '.join(sorted(unknown))}")
    streams = {s: stream(s, args.cycles, args.seed, args.n_jobs, args.out / "streams") for s in scenarios}
    tasks = [(scenario, method) for method in reversed(methods) for scenario in scenarios]  # the slow ones first
    played = Parallel(n_jobs=args.n_jobs)(delayed(play)(s, m, streams[s], args.seed) for s, m in tasks)
    runs = sorted(played, key=lambda run: (scenarios.index(run.scenario), methods.index(run.method)))
    tell([row_of(run) for run in runs], "simulated cell, (alpha, LB) = (0.1, 90 %)", args.out / "drift.csv", width=150)
    save(picture(runs), args.out / "drift.png", dpi=80, force=True)


if __name__ == "__main__":
    main()
