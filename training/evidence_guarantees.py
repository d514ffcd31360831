"""Play every guarantee on the eight sets, beside what hindsight could have saved.

    python training/evidence_guarantees.py --screw screw_driving.npz --n-jobs 2
    python training/evidence_guarantees.py --sets insertion,drift --seeds 100:101

Every bad accepted part stops the line and is known (`stops="all"`). It writes guarantees.csv into
OUT/evidence, a row for each replay, from which `evidence_page` makes a table. Two rows of each
shuffle are no replays but limits: in hindsight, with all labels known, parts are accepted and
rejected by the best two thresholds of a score. This is

- for "hindsight, scores of each moment" the score that each part had when it was decided, by the
  replay of the guarantee "cost";
- for "hindsight, final scores" that of a `conv` that was trained beforehand on all labels of the
  set. It is cross-fitted: no part is scored by a copy that saw its label.

Finished replays are kept in --keep, so that an interrupted run continues. Rows of other shuffles
that the same commit wrote stay in the table. Without --screw the set
`screw driving` is left out.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from common import options
from evidence import last_commit
from evidence_page import GUARANTEES, HINDSIGHT
from evidence_sets import GENERATORS, SETS, load_set
from ideal_score import trained_beforehand
from numpy.typing import ArrayLike

from dengine import Dataset, Recipe, Replay
from dengine.experiments.grid import Task, iterate_replays
from dengine.experiments.metrics import Costs
from dengine.experiments.replay import Contender
from dengine.experiments.tables import write_csv
from dengine.traces import as_traces

N_CYCLES = 1503  # of a replay, at most
COSTS = Costs()


def best_side(score: ArrayLike, is_wrong: ArrayLike, price: float) -> tuple[int, int]:
    """Return how many parts the best threshold of one side decides, and how many of them wrongly.

    Parameters
    ----------
    score : array of float, shape (n,)
        Parts with the largest scores are decided; those of one score alike.
    is_wrong : array of bool, shape (n,)
        Whether the decision would be wrong.
    price : float
        Of a wrong decision; a right one saves a check.
    """
    order = np.argsort(-np.asarray(score), kind="stable")
    score = np.asarray(score)[order]
    n_wrong = np.cumsum(np.asarray(is_wrong)[order])
    gain = COSTS.check * np.arange(1, len(score) + 1) - price * n_wrong
    is_threshold = np.append(score[1:] != score[:-1], True)
    best = int(np.where(is_threshold, gain, -np.inf).argmax())
    return (best + 1, int(n_wrong[best])) if gain[best] > 0 else (0, 0)


def hindsight(score: ArrayLike, is_good: ArrayLike) -> dict[str, float]:
    """Return what the best two thresholds of a score (n,) decide and save.

    The keys are those of a replay's summary. `is_good` (n,) has the labels.
    """
    score, is_good = np.asarray(score), np.asarray(is_good, dtype=bool)
    accepted, bad = best_side(score, ~is_good, COSTS.escape)
    rejected, good = best_side(-score, is_good, COSTS.false_reject)
    counts = {"certain": accepted + rejected, "accepted": accepted, "false_positive": bad}
    return counts | {"net_s": COSTS.saved(accepted + rejected, bad, good)}


def longest_run(is_on: ArrayLike) -> int:
    """Return the length of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(is_on, int), [0]])))
    return int(np.max(edges[1::2] - edges[::2], initial=0))


def play_shuffle(data: Dataset, tasks: list[Task], n_jobs: int, keep: Path) -> dict[str, Replay]:
    """Play the tasks of one shuffle; return the replays by the name of their guarantee."""
    played = iterate_replays(data, tasks, n_jobs=n_jobs, keep=keep)
    return {tasks[one.position].contender.name: one.replay for one in played}


def shuffle_rows(data: Dataset, replays: dict[str, Replay]) -> list[dict[str, Any]]:
    """Return a row for each guarantee that was played on a shuffle, and for both limits."""
    rows = []
    for name, replay in replays.items():
        summary = replay.summary()
        counts = {key: summary[key] for key in ("certain", "accepted", "false_positive", "net_s")}
        rows.append({"guarantee": name, **counts, "safe_mode": longest_run(replay.safe_mode)})
    cost = replays["cost"]
    traces = as_traces(data.X)[cost.index]
    # Before the first training a part has no score: it is checked.
    scores = np.where(cost.version > 0, cost.lower, np.nan)
    final = trained_beforehand(data)(traces)
    for name, score in zip(HINDSIGHT, (scores, final), strict=True):
        has_score = np.isfinite(score)
        rows.append({"guarantee": name, **hindsight(score[has_score], cost.truth[has_score])})
    return [{"cycles": len(cost), **row} for row in rows]


def read_rows(path: Path, commit: str, seeds: Sequence[int]) -> list[dict[str, Any]]:
    """Return the rows of a CSV file of `commit`, but those whose seed is in `seeds`.

    Each seed is a shuffle; those in `seeds` are played anew. The list is empty without a file.
    """
    if not path.exists():
        return []
    rows = pd.read_csv(path, dtype={"commit": str})
    kept: list[dict[str, Any]] = rows[rows["commit"] == commit].to_dict("records")
    return [row for row in kept if row["seed"] not in seeds]


def main() -> None:
    """Play the shuffles, and write the table after each."""
    parser = options(__doc__, seeds="100:110", n_jobs=1, keep=Path("out/evidence"), out=Path("out"))
    parser.add_argument("--screw", type=Path, help="the screw-driving set, an .npz file")
    parser.add_argument("--sets", default=",".join(SETS), help="names with commas; all by default")
    parser.add_argument("--recipe", default="conv", help="a recipe's name")
    arguments = parser.parse_args()
    names = [name for name in arguments.sets.split(",") if arguments.screw or "screw" not in name]
    contenders = [
        Contender(name, Recipe.load(arguments.recipe).with_policy(stops="all", **settings))
        for name, settings in GUARANTEES.items()
    ]
    path = arguments.out / "evidence" / "guarantees.csv"
    commit = last_commit()
    rows = read_rows(path, commit, arguments.seeds)
    for seed in arguments.seeds:
        for name in names:
            data = load_set(name, seed, arguments.screw)
            cycles = min(N_CYCLES, len(data))
            tasks = [Task(one, seed, cycles, name not in GENERATORS) for one in contenders]
            replays = play_shuffle(data, tasks, arguments.n_jobs, arguments.keep)
            about = {"set": name, "seed": seed, "commit": commit}
            rows += [about | row for row in shuffle_rows(data, replays)]
            write_csv(pd.DataFrame(rows), path, force=True)
            print(f"seed {seed}: {name}", flush=True)
    means = pd.DataFrame(rows).pivot_table("net_s", "set", "guarantee", sort=False)
    print(means.round().to_string())


if __name__ == "__main__":
    main()
