"""What choosing does to a cost curve's figures: policies that were chosen on some parts, tried on others.

    python training/check_cost_choice.py --data insertion --parts 300 --repeats 10 --n-jobs 2

The data are cut, shuffled, into disjoint sets of so many parts. On each a curve is made and a policy chosen, as
`dengine costs` does, with either half of the shuffles choosing; what that policy costs elsewhere is its mean over the
replays of all other sets, which played no role in the choice. Writes cost_choice.csv to --out.

expected, reported, elsewhere : cost a part of the cheapest policy.  taken : elsewhere, by the policy that was chosen, or by
verifying everything where none was.  best : by the policy that is best elsewhere.  pays, may pay : choices that say so.
above, below : of these, how often `elsewhere` was above or below the interval.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from common import options

from dengine import Dataset, Policy, Replay, load_dataset
from dengine.experiments.costs import ALPHAS, LOWER_BOUNDS, cost_a_part, cost_tasks, curve_of
from dengine.experiments.grid import play_tasks
from dengine.experiments.metrics import Costs
from dengine.experiments.tables import write_csv


def disjoint(data: Dataset, parts: int, seed: int = 0) -> list[Dataset]:
    """Sets of so many parts each, none of which is in two of them."""
    order = np.random.default_rng(seed).permutation(len(data))
    found = [order[i : i + parts] for i in range(0, len(data) - parts + 1, parts)]
    return [Dataset(data.X[some], data.y[some], f"{data.name} {i + 1}", data.rate_hz) for i, some in enumerate(found)]


def choices(sets: Sequence[Sequence[Replay]], costs: Costs) -> Iterator[dict[str, Any]]:
    """A row for each set and each half of its shuffles that chooses."""
    for i, here in enumerate(sets):
        there = [one for j, others in enumerate(sets) if j != i for one in others]
        elsewhere = {policy: mean_cost(there, policy, costs) for policy in {one.recipe.policy for one in there}}
        for swapped in (False, True):
            last = max(one.seed for one in here)
            curve = curve_of([replace(one, seed=last - one.seed) for one in here] if swapped else here, costs)
            row, policy = curve.cheapest, curve.policy
            told = {"check": costs.check, "escape": costs.escape, "false_reject": costs.false_reject, "set": i}
            said = {"verdict": curve.verdict, "alpha": row.policy.alpha, "lower_bound": row.policy.lower_bound}
            cost = {"expected": row.chosen_by, "reported": row.cost, "elsewhere": elsewhere[row.policy]}
            missed = {"above": elsewhere[row.policy] > row.upper, "below": elsewhere[row.policy] < row.lower}
            missed = {name: policy is not None and miss for name, miss in missed.items()}
            taken = costs.check if policy is None else elsewhere[policy]
            yield told | said | cost | missed | {"taken": taken, "best": min(costs.check, *elsewhere.values())}


def mean_cost(replays: Sequence[Replay], policy: Policy, costs: Costs) -> float:
    """Of a part, over all shuffles under one policy."""
    return float(np.mean([cost_a_part(one, costs) for one in replays if one.recipe.policy == policy]))


def main() -> None:
    """Parse, play, print, write."""
    parser = options(__doc__, data="insertion", samples=None, recipe="pca", n_jobs=2, out=Path("out"))
    parser.add_argument("--parts", type=int, default=300, help="of each set")
    parser.add_argument("--repeats", type=int, default=10, help="shuffles of each set and policy")
    parser.add_argument("--escapes", default="30,60,120,300,600", help="costs of a bad part accepted, each a row")
    parser.add_argument("--check", type=float, default=5.0, help="cost of a check")
    parser.add_argument("--false-reject", type=float, default=47.5, help="cost of a good part rejected")
    args = parser.parse_args()
    tasks = cost_tasks(args.recipe, ALPHAS, LOWER_BOUNDS, range(args.repeats))
    cut = disjoint(load_dataset(args.data, args.samples), args.parts)
    sets = [play_tasks(each, tasks, n_jobs=args.n_jobs) for each in cut]
    prices = [Costs(args.check, float(escape), args.false_reject) for escape in args.escapes.split(",")]
    table = pd.DataFrame([row for costs in prices for row in choices(sets, costs)])
    write_csv(table, args.out / "cost_choice.csv", force=True)
    shown = table.groupby("escape")[["expected", "reported", "elsewhere", "taken", "best"]].mean().round(2)
    for verdict in ("pays", "may pay"):
        shown[verdict] = (table.verdict == verdict).groupby(table.escape).sum()
    of = f"{len(sets)} sets of {args.parts} parts, {args.repeats} shuffles, {2 * len(sets)} choices"
    print(f"{args.data}, {args.recipe}: {of}")
    print(shown.join(table.groupby("escape")[["above", "below"]].sum()).to_string())


if __name__ == "__main__":
    main()
