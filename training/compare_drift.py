"""A cell that changes, decided on by dengine and by the paper's recipe: bad parts let pass, and how soon it is noticed.

    python training/compare_drift.py --cycles 3000 --n-jobs 2 --out out/drift

Each scenario of the simulated cell is simulated once and kept below --out; every method then decides on the same parts in
the same order, at (alpha, LB) = (0.1, 90 %): dengine (conv, the pooled guarantee, novelty, safe mode), local (conv under
the paper's rule, with novelty), paper-conv (without), and paper-umap (the paper's recipe, but that it retrains every 300
labels instead of 50: a fit takes seconds). Every bad part that is accepted stops the system. Wear grows from the first
cycle on, the others change half way; before and after mean the two halves. Writes drift.csv, a row a scenario and method,
and drift.png.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from common import options, tell
from joblib import Parallel, delayed
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dengine import Policy, Recipe
from dengine.cells.simulation.conditions import CellParameters, find_scenario
from dengine.experiments.figures import LIMIT, RECIPES, SMALL, draw_verified, finish, save
from dengine.experiments.replay import Replay, replay
from dengine.experiments.tables import write_csv

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
    """What happened, in numbers; None where it did not."""
    log, n = run.log, len(run.log)
    alarm, back = alarm_and_back(log.safe_mode, (first_change(run.scenario, n) or 1) - 1)
    halves = {"before": slice(0, n // 2), "after": slice(n // 2, n)}
    begins = log.safe_mode & ~np.concatenate([[False], log.safe_mode[:-1]])
    total = log.stretch(slice(None))
    return {
        "scenario": run.scenario,
        "method": run.method,
        "cycles": n,
        **{name: total[name] for name in ("accepted", "false_positive", "rejected", "false_negative")},
        **{f"escapes_{when}": escapes(log, half) for when, half in halves.items()},
        **{f"verified_{when}": float(log.verified[half].mean()) for when, half in halves.items()},
        **{f"novel_{when}": int(log.novel[half].sum()) for when, half in halves.items()},
        **{f"alarms_{when}": int(begins[half].sum()) for when, half in halves.items()},
        "alarm": alarm,
        "back": back,
        "saved_s": seconds_saved(log),
    }


def first_change(name: str, cycles: int) -> int | None:
    """The number, from 1, of the first cycle that is not as at the beginning; None where nothing changes."""
    as_usual, change = CellParameters(), find_scenario(name)
    return next((i + 1 for i in range(cycles) if change(as_usual, i, cycles) != as_usual), None)


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


def seconds_saved(log: Replay) -> float:
    """Against verifying every part, by the cell's times: checks left out, less stops, less good parts sent back."""
    cell, total = CellParameters(), log.stretch(slice(None))
    lost = cell.stop_s * total["stops"] + (cell.cycle_s + cell.verify_s) * total["false_negative"]
    return cell.verify_s * (total["accepted"] + total["rejected"]) - lost


CAPTION = """Before / after: halves of the run. bad/1000: bad parts accepted for 1,000 parts passed on, checked or
not. alarm: cycles from the change until all is verified; lasts: cycles until that ended. saved: against
verifying every part, what stops and good parts sent back cost taken off. dengine's guarantee is pooled,
and it takes accepted parts that no stop follows for good; that of the others is local, and they know
stops alone."""


def shown(row: dict[str, Any]) -> dict[str, Any]:
    """A row for a screen; what is told of both halves as before / after."""
    lasts = "open" if row["alarm"] and row["back"] is None else row["back"] or "-"
    halves = {
        "bad/1000": ("escapes", ".1f"),
        "verified": ("verified", ".0%"),
        "novel": ("novel", ""),
        "alarms": ("alarms", ""),
    }
    return {
        **{name: row[name] for name in ("scenario", "method", "accepted")},
        "bad": row["false_positive"],
        **{title: f"{row[f'{of}_before']:{form}} / {row[f'{of}_after']:{form}}" for title, (of, form) in halves.items()},
        "alarm": row["alarm"] or "-",
        "lasts": lasts,
        "saved, s": f"{row['saved_s']:.0f}",
    }


def picture(runs: Sequence[Run]) -> Figure:
    """A column a scenario: verified share above, bad parts accepted so far below; a colour a method."""
    scenarios = list(dict.fromkeys(run.scenario for run in runs))
    figure = Figure(figsize=(max(7.0, 4.4 * len(scenarios)), 6.4), layout="constrained")
    grid = figure.subplots(2, len(scenarios), sharex=True, sharey="row", squeeze=False)
    colours = dict(zip(METHODS, RECIPES, strict=False))
    for (top, bottom), scenario in zip(grid.T, scenarios, strict=True):
        for run in (run for run in runs if run.scenario == scenario):
            draw(top, bottom, run, colours[run.method])
        if (change := first_change(scenario, max(len(run.log) for run in runs))) is not None:
            for axes in (top, bottom):
                axes.axvline(change, **LIMIT)
            top.text(change, 1.01, CHANGES[scenario], transform=top.get_xaxis_transform(), fontsize=SMALL, va="bottom")
        top.set_title(scenario, pad=18)
        bottom.set(xlabel="cycle", ylim=(0, None))
    for axes in grid.flat:
        finish(axes, legend=0)
    for axes, name in zip(grid[:, 0], (f"verified, last {WINDOW} [%]", "bad parts accepted so far"), strict=True):
        axes.set_ylabel(name)
    labels: dict[str, object] = {}
    for axes in grid.flat:
        labels |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    columns = 3 if len(scenarios) == 1 else len(labels)
    figure.legend(labels.values(), labels.keys(), loc="outside lower center", ncols=columns, frameon=False)
    figure.suptitle("Simulated cell that changes: what is still checked, and what slips through")
    return figure


def draw(top: Axes, bottom: Axes, run: Run, colour: str) -> None:
    """One method; where its safe mode is on, the upper panel is shaded."""
    log, x = run.log, np.arange(1, len(run.log) + 1)
    draw_verified(top, log.verified, WINDOW, colour, run.method)
    bottom.step(x, np.cumsum(log.false_positive), where="post", color=colour)
    if log.safe_mode.any():
        shade = {"color": colour, "alpha": 0.15, "linewidth": 0, "label": f"{run.method}: safe mode"}
        top.fill_between(x, 0, 104, where=log.safe_mode, step="pre", **shade)


def main() -> None:
    """Parse, simulate, replay, draw, print."""
    parser = options(__doc__, n_jobs=2, out=Path("out/drift"))
    parser.add_argument("--cycles", type=int, default=3000, help="parts in each stream")
    parser.add_argument("--scenarios", default=",".join(CHANGES), help="with commas between; all that change by default")
    parser.add_argument("--methods", default=",".join(METHODS), help="likewise")
    parser.add_argument("--seed", type=int, default=100, help="of the cell and of the engines")
    parser.add_argument("--docs", action="store_true", help="write the picture to docs/drift.png too")
    args = parser.parse_args()
    methods, scenarios = args.methods.split(","), args.scenarios.split(",")
    if unknown := {*methods, *scenarios} - {*METHODS, *CHANGES}:
        parser.error(f"known are {', '.join(METHODS)}, and {', '.join(CHANGES)}; not {', '.join(sorted(unknown))}")
    streams = {s: stream(s, args.cycles, args.seed, args.n_jobs, args.out / "streams") for s in scenarios}
    tasks = [(scenario, method) for method in reversed(methods) for scenario in scenarios]  # the slow ones first
    played = Parallel(n_jobs=args.n_jobs)(delayed(play)(s, m, streams[s], args.seed) for s, m in tasks)
    runs = sorted(played, key=lambda run: (scenarios.index(run.scenario), methods.index(run.method)))
    rows = [row_of(run) for run in runs]
    tell([shown(row) for row in rows], "simulated cell, (alpha, LB) = (0.1, 90 %)", width=150)
    print(CAPTION)
    figure = picture(runs)
    write_csv(pd.DataFrame(rows), args.out / "drift.csv", force=True)
    written = save(figure, args.out / "drift.png", dpi=80, force=True)
    if args.docs:
        Path("docs").mkdir(exist_ok=True)
        shutil.copyfile(written, "docs/drift.png")


if __name__ == "__main__":
    main()
