"""What honesty, novelty, audits, parts and the guarantee each cost: certain decisions of the same shuffled runs.

    python training/compare_costs.py --data insertion --seeds 100:130
    python training/compare_costs.py --data screw_driving.npz --samples 400 --part workpiece --seeds 100:130

All with conv, and every stop known (`stops="all"`). "Dishonest" trains every head on all labels, its own fold's too: what
honest counting costs is what that seems to gain. Writes costs.csv to --out.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from common import POLICY, options
from joblib import Parallel, delayed

from dengine import Dataset, Policy, Recipe, load_dataset, replay
from dengine.experiments.tables import write_csv
from dengine.reducers import ConvReducer
from dengine.reducers.heads import CrossFittedScores, FeatureEmbedding


class DishonestScores(CrossFittedScores):
    """Every head is trained on every fold's labels, which are then counted in it: for comparison only."""

    def _head(self, k: int, g: torch.Tensor, y: torch.Tensor, outside: torch.Tensor, l2: float) -> Any:
        return super()._head(k, g, y, torch.ones_like(outside), l2)


class DishonestReducer(ConvReducer):
    """conv with such heads."""

    def _build(self, channels: int, samples: int) -> None:
        super()._build(channels, samples)
        features = self.net_.features
        heads = DishonestScores(features.n_out, self.folds, self.n_components)
        self.net_ = FeatureEmbedding(features, heads).eval()


def rows(data: Dataset, alpha: float, lower_bound: float) -> dict[str, tuple[Dataset, Recipe]]:
    """The configurations, by name: what is played, and by which recipe."""
    plain = replace(data, part=None)
    paper = Policy(alpha, lower_bound)
    known = replace(paper, stops="all")
    pooled = replace(known, guarantee="pooled")
    bare = replace(Recipe.load("conv"), novelty=0.0)
    full = Recipe.load("conv")
    found = {
        "the paper's rule, stops alone known": (plain, replace(bare, policy=paper)),
        "silence confirms": (plain, replace(bare, policy=known)),
        "the same, dishonest": (plain, replace(bare, reducer=DishonestReducer(), policy=known)),
        "novelty": (plain, replace(full, policy=known)),
        "novelty, pooled": (plain, replace(full, policy=pooled)),
        "novelty, pooled, 2 % audits": (plain, replace(full, policy=replace(pooled, audit_rate=0.02))),
        "novelty, pooled, 10 % audits": (plain, replace(full, policy=replace(pooled, audit_rate=0.1))),
    }
    if data.part is not None:
        found |= {
            "novelty, parts named": (data, replace(full, policy=known)),
            "novelty, pooled, parts named": (data, replace(full, policy=pooled)),
        }
    return found


def play(name: str, data: Dataset, recipe: Recipe, seed: int, cycles: int) -> dict[str, Any]:
    """One replay as a row."""
    return replay(data, recipe, seed=seed, cycles=cycles).summary() | {"row": name, "seed": seed}


def main() -> None:
    """Parse, play, print, write."""
    parser = options(
        __doc__, data="insertion", samples=None, **POLICY, seeds="100:130", cycles=1503, n_jobs=2, out=Path("out")
    )
    parser.add_argument("--part", default="part", help="name of the array of parts' numbers in the file")
    args = parser.parse_args()
    data = load_dataset(args.data, args.samples, args.part)
    cycles, level = min(args.cycles, len(data)), f"({args.alpha:g}, {100 * args.lower_bound:g} %)"
    configurations = rows(data, args.alpha, args.lower_bound)
    tasks = [(name, *how, seed, cycles) for name, how in configurations.items() for seed in args.seeds]
    table = pd.DataFrame(Parallel(n_jobs=args.n_jobs)(delayed(play)(*task) for task in tasks))
    write_csv(table, args.out / "costs.csv", force=True)
    counts = ["certain", "accepted", "rejected", "false_positive", "false_negative", "novel"]
    shown = table.groupby("row", sort=False)[counts].mean()
    shown["bad of accepted"] = 100.0 * shown.pop("false_positive") / shown["accepted"]
    shown["good of rejected"] = 100.0 * shown.pop("false_negative") / shown["rejected"]
    print(f"{data.name}, {level}, means of {table.seed.nunique()} runs of {cycles} cycles")
    print(shown.round(1).to_string())


if __name__ == "__main__":
    main()
