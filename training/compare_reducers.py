"""Reducers against each other, with as many tries for each: settings chosen on some seeds, reported on others.

    python training/compare_reducers.py choose --data insertion --reducers conv,umap,pca,rocket --out out/
    python training/compare_reducers.py report --data insertion --reducers conv,umap,pca,rocket --out out/

`choose` replays every try of TRIES on seeds 0 to 9 at alpha 0.1, LB 90 %, and names the one with the most certain
decisions among those whose pooled precision and NPV meet LB. `report` replays the recipes as they are, on seeds 100 to
129, at both policies.
Both write a row a replay to a CSV, appending, so that a long run can be done in parts.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import pandas as pd
from rich.console import Console
from rich.table import Table

from dengine import Recipe, load_dataset
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
    """Mean counts a replay, and rates over all replays together."""
    groups = rows.groupby(["recipe", "what"], sort=False)
    table = groups[["certain", "accepted", "rejected", "false_positive", "false_negative"]].mean()
    table["precision"] = 1.0 - table["false_positive"] / table["accepted"]
    table["npv"] = 1.0 - table["false_negative"] / table["rejected"]
    table["retrain_max_s"] = groups["retrain_max_s"].max()
    table["replays"] = groups.size()
    return table.reset_index()


def chosen(table: pd.DataFrame, lower_bound: float) -> pd.DataFrame:
    """Of each reducer the try with the most certain decisions among those that keep the promise."""
    kept = table[(table["precision"].fillna(1.0) >= lower_bound) & (table["npv"].fillna(1.0) >= lower_bound)]
    return kept.loc[kept.groupby("recipe", sort=False)["certain"].idxmax()]


def show(table: pd.DataFrame, title: str) -> None:
    """The table on the screen."""
    rich = Table(*table.columns, title=title)
    for values in table.itertuples(index=False):
        rich.add_row(*(f"{v:.4g}" if isinstance(v, float) else str(v) for v in values))
    Console(width=160).print(rich)


def main() -> None:
    """Parse, replay, show."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("do", choices=["choose", "report"])
    parser.add_argument("--data", default="insertion")
    parser.add_argument("--samples", type=int)
    parser.add_argument("--cycles", type=int, default=1503)
    parser.add_argument("--reducers", default="conv,umap,pca")
    parser.add_argument("--policies", default="0.1:0.9,0.05:0.95", help="alpha:LB, for report")
    parser.add_argument("--seeds", help="first:last, instead of 0:10 or 100:130")
    parser.add_argument("--n-jobs", type=int, default=-1)
    parser.add_argument("--out", type=Path, default=Path("out"))
    args = parser.parse_args()
    first, last = map(int, (args.seeds or ("0:10" if args.do == "choose" else "100:130")).split(":"))
    policies = [tuple(map(float, pair.split(":"))) for pair in args.policies.split(",")]
    data = load_dataset(args.data, args.samples)
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
        show(chosen(table, 0.9), "chosen")


if __name__ == "__main__":
    main()
