"""Reducers against each other, with as many tries for each: settings chosen on some seeds, reported on others.

    python training/compare_reducers.py choose --data insertion --reducers conv,umap,pca,rocket --out out/
    python training/compare_reducers.py report --data insertion --reducers conv,umap,pca,rocket --out out/

`choose` replays every try of TRIES on seeds 0 to 9 at alpha 0.1, LB 90 %, and names the one with the most certain
decisions among those whose pooled precision and NPV meet LB. `report` replays the recipes as they are, on seeds 100 to
129, at both policies.
Both write a row a replay to a CSV, appending, so that a long run can be done in parts; of a replay that was done twice the
newer row counts.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from dengine import Recipe, load_dataset
from dengine.cli.output import duration
from dengine.experiments.grid import run_replays

# The same number of tries for each reducer: its radius, the one setting that every reducer has.
TRIES: dict[str, tuple[float, ...]] = {
    "conv": (0.03, 0.05, 0.07, 0.1),
    "umap": (0.2, 0.3, 0.4, 0.6),
    "pca": (0.1, 0.2, 0.3, 0.4),
    "rocket": (0.03, 0.05, 0.07, 0.1),
}


def tries(reducer: str) -> dict[str, Recipe]:
    """Every try of a reducer, by what was tried."""
    base = Recipe.load(reducer).with_policy(alpha=0.1, lower_bound=0.9)
    return {f"radius {r:g}": replace(base, radius=r) for r in TRIES[reducer]}


def replays(data: object, recipes: dict[str, Recipe], seeds: range, args: argparse.Namespace) -> pd.DataFrame:
    """A row a replay; `what` says which try or policy."""
    frames = []
    for what, recipe in recipes.items():
        results = run_replays(data, [recipe], seeds, args.cycles, n_jobs=args.n_jobs)
        frames.append(pd.DataFrame([{"what": what} | r.summary() for r in results]))
    return pd.concat(frames, ignore_index=True)


def pooled(rows: pd.DataFrame) -> pd.DataFrame:
    """Mean counts a replay, and rates over all replays together; replays of another length stand apart."""
    rows = rows.drop_duplicates(["recipe", "what", "cycles", "seed"], keep="last")
    groups = rows.groupby(["recipe", "what", "cycles"], sort=False)
    table = groups[["certain", "accepted", "rejected", "false_positive", "false_negative"]].mean()
    table["precision"] = 1.0 - table["false_positive"] / table["accepted"]
    table["npv"] = 1.0 - table["false_negative"] / table["rejected"]
    table["retrain_max_s"] = groups["retrain_max_s"].max()
    table["replays"] = groups.size()
    return table.reset_index()


def chosen(table: pd.DataFrame, lower_bound: float) -> pd.DataFrame:
    """Of each reducer the try with the most certain decisions among those that keep the promise."""
    table = table[table["certain"] > 0]
    kept = table[(table["precision"].fillna(1.0) >= lower_bound) & (table["npv"].fillna(1.0) >= lower_bound)]
    return kept.loc[kept.groupby("recipe", sort=False)["certain"].idxmax()]


def show(table: pd.DataFrame, title: str) -> None:
    """The table on the screen."""
    rich = Table(*(HEADINGS.get(name, name) for name in table.columns), title=title)
    for values in table.itertuples(index=False):
        rich.add_row(*(written(name, value) for name, value in zip(table.columns, values, strict=True)))
    Console(width=130).print(rich)


HEADINGS = {"false_positive": "FP", "false_negative": "FN", "npv": "NPV", "retrain_max_s": "worst retrain"}


def written(name: str, value: object) -> str:
    """A cell of the table as a person writes it."""
    if not isinstance(value, float):
        return str(value)
    if np.isnan(value):
        return "-"
    share = name in ("precision", "npv")
    return duration(value) if name == "retrain_max_s" else f"{100 * value:.1f} %" if share else f"{value:.4g}"


def main() -> None:
    """Parse, replay, show."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("do", choices=["choose", "report"], help="try settings, or report the recipes as they are")
    parser.add_argument("--data", default="insertion", help="a bundled set, or an .npz file with X and y")
    parser.add_argument("--samples", type=int, help="use the first so many samples of each trace; all by default")
    parser.add_argument("--cycles", type=int, default=1503, help="cycles of a replay, at most as many as there are traces")
    parser.add_argument("--reducers", default="conv,umap,pca", help="with commas between; report takes TOML files too")
    parser.add_argument("--policies", default="0.1:0.9,0.05:0.95", help="alpha:LB with commas between, for report")
    parser.add_argument("--seeds", help="first:last, the last one left out, instead of 0:10 or 100:130")
    parser.add_argument("--n-jobs", type=int, default=-1, help="replays at a time; -1: one a core")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the CSV")
    args = parser.parse_args()
    first, last = map(int, (args.seeds or ("0:10" if args.do == "choose" else "100:130")).split(":"))
    policies = [tuple(map(float, pair.split(":"))) for pair in args.policies.split(",")]
    unknown = set(args.reducers.split(",")) - set(TRIES)
    if args.do == "choose" and unknown:
        parser.error(f"choose has tries of {', '.join(TRIES)}, none of {', '.join(sorted(unknown))}; add them to TRIES")
    data = load_dataset(args.data, args.samples)
    args.cycles = min(args.cycles, len(data))
    args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / f"{args.do}_{data.name}.csv"
    for reducer in args.reducers.split(","):
        recipes = tries(reducer) if args.do == "choose" else {
            f"alpha {a}, LB {b}": Recipe.load(reducer).with_policy(alpha=a, lower_bound=b) for a, b in policies
        }  # fmt: skip
        rows = replays(data, recipes, range(first, last), args)
        rows.to_csv(path, mode="a", header=not path.exists(), index=False)
    table = pooled(pd.read_csv(path))
    show(table, f"{args.do}: {data.name}, mean counts a replay, pooled rates")
    if args.do == "choose":
        best = chosen(table, 0.9)
        show(best, "chosen") if len(best) else print("Chosen: none; no try was certain of anything and kept its promise.")


if __name__ == "__main__":
    main()
