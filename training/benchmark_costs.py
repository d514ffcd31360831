"""Measure whether `dengine costs` chooses a policy that is cheap on parts that come later.

    python training/benchmark_costs.py --out out/costs/ --n-jobs 2

Three generated sets have known failure probabilities. Of each, 600 recordings are searched by three
price triples, ten times with other recordings. Then an engine that has learned these recordings
plays 10,000 further parts, with a retrain every 200 labels, and each candidate decides on its
scores. A decision costs what it is expected to cost by the part's failure probability: the check,
or an escape or a false reject times the probability that it is one.

A run that was interrupted continues: each finished row stands in `costs.csv`. The table says, for
each set and price triple, how much dearer than the best candidate the chosen policy is, in per cent
of the check, and of the runs with the verdict "pays" how many are below checking everything.
"""

import argparse
import csv
from collections.abc import Sequence
from dataclasses import fields, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray

from dengine import Dataset, Policy, Replay, replay
from dengine.experiments.costs import find_policy, policy_name
from dengine.experiments.grid import play_tasks
from dengine.experiments.metrics import Costs
from dengine.experiments.replay import Contender, replay_policy

SAMPLES = 200
N_RECORDINGS = 600
PRICES = {"dear": (0.5, 200.0, 5.0), "paper": (5.0, 120.0, 47.5), "cheap": (1.0, 20.0, 10.0)}
COLUMNS = (
    "set", "prices", "run", "verdict", "chosen", "cost", "best", "best_cost", "check",
    "n_candidates",
)  # fmt: skip
# By name: how steeply the failure probability rises with the defect, the size of the defect at
# which it is one half, and the noise that hides the defect.
SETS = {"clear": (12.0, 1.5, 0.05), "graded": (3.0, 1.8, 0.05), "hidden": (6.0, 1.2, 0.6)}


def make_set(name: str, n: int, seed: int) -> tuple[Dataset, NDArray[np.float64]]:
    """Return n recordings of a set, and the failure probability of each, (n,).

    A recording is a ramp of force with a hump, whose height is the defect, a normal variable, and
    noise.
    """
    steepness, half, noise = SETS[name]
    rng = np.random.default_rng([seed, *name.encode()])
    defect = rng.standard_normal(n)
    failure = 1.0 / (1.0 + np.exp(-steepness * (defect - half)))
    time = np.linspace(0.0, 1.0, SAMPLES)
    hump = np.exp(-(((time - 0.4) / 0.05) ** 2))
    gain = 1.0 + 0.05 * rng.standard_normal((n, 1))
    seen = defect[:, None] + noise * rng.standard_normal((n, 1))
    X = 10.0 * gain * time + seen * hump + 0.2 * rng.standard_normal((n, SAMPLES))
    y = (rng.random(n) >= failure).astype(np.int8)
    return Dataset(X=X.astype(np.float32), y=y, name=name), failure


def from_part(scores: Replay, first: int) -> Replay:
    """Return a replay without its first cycles."""
    values = {field.name: getattr(scores, field.name) for field in fields(scores)}
    later: dict[str, Any] = {
        name: v[first:] for name, v in values.items() if isinstance(v, np.ndarray)
    }
    return replace(scores, **later)


def expected_cost(decided: Replay, failure: NDArray[np.float64], costs: Costs) -> float:
    """Return what a part is expected to cost by its failure probability, the mean."""
    accepted = decided.accepted
    rejected = decided.rejected
    each = np.where(accepted, costs.escape * failure, costs.check)
    return float(np.where(rejected, costs.false_reject * (1.0 - failure), each).mean())


def run_one(name: str, run: int, n_later: int, names: Sequence[str]) -> list[dict[str, Any]]:
    """Search one set of recordings by some price triples; return a row for each."""
    data, failure = make_set(name, N_RECORDINGS + n_later, run)
    rows = slice(0, N_RECORDINGS)
    recordings = replace(data, X=data.X[rows], y=data.y[rows])
    contender = Contender.load("rocket")
    recipe = contender.recipe.with_settings(retrain_every=200).with_policy(shadow=True)
    shadow = replace(contender, recipe=recipe)
    scores = from_part(replay(data, shadow, run, shuffle=False), N_RECORDINGS)
    later = failure[N_RECORDINGS:]
    played: dict[Any, Replay] = {}  # the shared streams are the same for all prices

    def play(tasks: Any) -> list[Replay]:
        missing = [task for task in tasks if key_of(task) not in played]
        for task, result in zip(missing, play_tasks(recordings, missing), strict=True):
            played[key_of(task)] = result
        return [played[key_of(task)] for task in tasks]

    def key_of(task: Any) -> tuple[Policy, int]:
        return task.contender.recipe.policy, task.seed

    result = []
    for prices in names:
        costs = Costs(*PRICES[prices])
        player = contender.with_policy(stops="all")
        curve = find_policy(recordings, player, costs, play)
        assert curve is not None  # all was played
        policies = [row.policy for row in (*curve.rows, *curve.left_behind)]
        by_name = {"check everything": costs.check}
        for policy in policies:
            decided = replay_policy(scores, policy)
            by_name[policy_name(policy)] = expected_cost(decided, later, costs)
        best = min(by_name, key=lambda item: by_name[item])
        chosen = "check everything" if curve.policy is None else policy_name(curve.policy)
        values = (
            name, prices, run, curve.verdict, chosen, by_name[chosen], best, by_name[best],
            costs.check, len(policies),
        )  # fmt: skip
        result.append(dict(zip(COLUMNS, values, strict=True)))
    return result


def print_table(rows: Sequence[dict[str, Any]]) -> None:
    """Print a line for each set and price triple, and one for all."""
    print(
        f"{'set':8} {'prices':8} {'runs':>4} {'above the best':>15} {'pays':>5} {'below check':>12}"
    )

    def line(name: str, prices: str, group: Sequence[dict[str, Any]]) -> None:
        regrets = [
            100 * (float(row["cost"]) - float(row["best_cost"])) / float(row["check"])
            for row in group
        ]
        pays = [row for row in group if row["verdict"] == "pays"]
        below = sum(float(row["cost"]) < float(row["check"]) for row in pays)
        print(
            f"{name:8} {prices:8} {len(group):4} {np.mean(regrets):13.1f} % {len(pays):5} "
            f"{below:5} of {len(pays)}"
        )

    for name, prices in product(SETS, PRICES):
        group = [row for row in rows if (row["set"], row["prices"]) == (name, prices)]
        if group:
            line(name, prices, group)
    if rows:
        line("all", "", rows)


def main() -> None:
    """Play what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/costs"))
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--parts", type=int, default=10_000)
    parser.add_argument("--n-jobs", type=int, default=1)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "costs.csv"
    rows: list[dict[str, Any]] = []
    if path.is_file():
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    done = {(row["set"], int(row["run"])) for row in rows}
    missing = [key for key in product(range(options.runs), SETS) if key[::-1] not in done]
    parallel = Parallel(n_jobs=options.n_jobs, return_as="generator_unordered")
    tasks = (delayed(run_one)(name, run, options.parts, list(PRICES)) for run, name in missing)
    for new in parallel(tasks):
        is_first = not path.is_file()
        with path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS)
            if is_first:
                writer.writeheader()
            writer.writerows(new)
        rows += new
        print(f"{new[0]['set']}, run {new[0]['run']}: {len(rows)} rows", flush=True)
    print_table(rows)


if __name__ == "__main__":
    main()
