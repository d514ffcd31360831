"""Play the replays behind the results: every reducer and baseline on eight sets of parts.

    python training/evidence.py --screw screw_driving.npz  # a file of make_screw_driving.py
    python training/evidence.py --only conv --n-jobs 2     # methods left out keep their rows
    python training/evidence.py --cluster tcp://host:8786  # on the workers of a dask cluster
    python training/evidence.py --tables-only --out out    # only write the page again

Beside the methods (`METHODS`) it plays the paper's 18 combinations of interval, alpha and LB, and
variants of conv that show what each promise costs. It says first what is left to do and how long
that takes. Finished replays are kept in --keep, so that an interrupted run continues.

Replays are played shuffle by shuffle. After each shuffle it writes into OUT/evidence: replays.csv
(one row per replay, with the commit of dengine that played it), and from it the tables and figures
of `evidence_page`. The seed of a shuffle sets the order of a recorded set, and generates the parts
of the others, so all methods see the same parts in the same order.
"""

import argparse
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import joblib
import numpy as np
import pandas as pd
import torch
from common import options
from evidence_page import CONDITION, LABELS_PER_POINT, METHODS, POLICIES, VARIANTS, write_results
from evidence_sets import GENERATORS, SETS, load_set
from published import PUBLISHED

import dengine
from dengine import Dataset, Replay
from dengine.experiments.grid import PAPER_GRID, KeptReplays, Task, iterate_replays
from dengine.experiments.replay import Contender
from dengine.experiments.tables import write_csv
from dengine.reducers import ConvReducer, RocketReducer
from dengine.reducers.base import StopRule

# Seconds of a core that a replay takes, for the estimate at the start.
SECONDS = {
    "conv": 11,
    "rocket": 2,
    "umap": 2,
    "umap-learn": 18,
    "pca": 2,
    "knn": 1,
    "wskde": 2,
    "gp": 7,
    "minirocket": 9,
}
# How many shuffles are played; slow methods have fewer.
N_SHUFFLES = dict.fromkeys(METHODS, 30) | {"gp": 10, "minirocket": 10, "umap-learn": 5}
N_GRID_SHUFFLES = 10  # of the paper's combinations
GRID_METHODS = ("conv", "umap")
N_VARIANT_SHUFFLES = 10
VARIANT_SETS = ("insertion", "screw driving")
PROMISES = "promises"  # the word for the variants of conv in --only
# Columns of `Replay.summary` that replays.csv has beside `CONDITION`.
SUMMARY = [
    "seed",
    "cycles",
    "certain",
    "first_certain",
    "accepted",
    "rejected",
    "false_positive",
    "false_negative",
    "net_s",
]


class DishonestRocket(RocketReducer):
    """rocket with heads that all learn from the labels of every fold."""

    def training_masks(self, folds: np.ndarray) -> np.ndarray:
        """Return a mask (K, n) that leaves no label out."""
        return np.ones_like(super().training_masks(folds))


class DishonestReducer(ConvReducer):
    """conv with copies that all learn from the labels of every fold, which are then counted.

    For comparison only: it shows what honest counting costs.
    """

    def _build(self, channels: int, samples: int, average: int, seed: int | None = None) -> None:
        super()._build(channels, samples, average, seed)
        self.rocket_ = DishonestRocket(**self.rocket_.get_params())

    def fit_loop(
        self, x: torch.Tensor, y: torch.Tensor, folds: np.ndarray, stop: StopRule, steps: int
    ) -> None:
        """Train every copy on all labels, by hiding from it which fold they are in."""
        super().fit_loop(x, y, np.full_like(folds, -1), stop, steps)


def make_variants() -> list[Contender]:
    """Return the `VARIANTS` of conv at the first of `POLICIES`."""
    local = Contender.load("conv").recipe
    every_stop = local.with_policy(stops="all")
    pooled = local.with_policy(stops="all", guarantee="pooled")
    recipes = (
        replace(local, novelty=0.0),
        every_stop,
        replace(every_stop, reducer=DishonestReducer(), params={}),
        pooled,
        pooled.with_policy(audit_rate=0.02),
        pooled.with_policy(audit_rate=0.1),
    )
    alpha, lower_bound = POLICIES[0]
    return [
        Contender(name, recipe.with_policy(alpha=alpha, lower_bound=lower_bound))
        for name, recipe in zip(VARIANTS, recipes, strict=True)
    ]


class Condition(NamedTuple):
    """A method with a policy."""

    method: str
    interval: str
    alpha: float
    lower_bound: float

    def contender(self) -> Contender:
        """Return who plays the replay."""
        path = PUBLISHED.get(self.method)
        contender = Contender.load("knn" if path else self.method)
        if path:  # in the loop of any baseline
            contender = replace(contender, name=self.method, baseline=path)
        return contender.with_policy(
            interval=self.interval, alpha=self.alpha, lower_bound=self.lower_bound
        )


class Shuffle(NamedTuple):
    """The parts of a set for one seed, and the replays of them.

    Attributes
    ----------
    seed : int
    set_name : str
    data : Dataset
    tasks : list of Task
    """

    seed: int
    set_name: str
    data: Dataset
    tasks: list[Task]


@dataclass(frozen=True)
class Plan:
    """What is played.

    Parameters
    ----------
    seeds : range
        One shuffle of each set for each seed.
    sets : list of str
        Names in `SETS`.
    methods : list of str
        Names in `METHODS`, or "promises" for the variants of conv.
    n_policies : int
        How many of the `POLICIES`. Only with all of them the paper's combinations are played.
    max_cycles : int
        Longest replay.
    screw_driving : Path or None
        File of the set `screw driving`.
    """

    seeds: range
    sets: list[str]
    methods: list[str]
    n_policies: int
    max_cycles: int
    screw_driving: Path | None

    def iterate_shuffles(self) -> Iterator[Shuffle]:
        """Load or generate each set for each seed, and yield it with its replays."""
        for index, seed in enumerate(self.seeds):
            for set_name in self.sets:
                data = load_set(set_name, seed, self.screw_driving)
                cycles = None if self.max_cycles >= len(data) else self.max_cycles
                is_shuffled = set_name not in GENERATORS
                tasks = [
                    Task(contender, seed, cycles, is_shuffled)
                    for contender in self.contenders(set_name, index)
                ]
                yield Shuffle(seed, set_name, data, tasks)

    def contenders(self, set_name: str, index: int) -> list[Contender]:
        """Return all that play the shuffle of this index, from 0, of a set."""
        conditions = [
            Condition(method, "wilson", *policy)
            for method, policy in product(METHODS, POLICIES[: self.n_policies])
            if index < N_SHUFFLES[method]
        ]
        has_all_policies = self.n_policies == len(POLICIES)
        if set_name == "insertion" and has_all_policies and index < N_GRID_SHUFFLES:
            grid = product(
                GRID_METHODS,
                *(PAPER_GRID[name] for name in ("intervals", "alphas", "lower_bounds")),
            )
            conditions += [Condition(*settings) for settings in grid]
        contenders = [
            condition.contender()
            for condition in dict.fromkeys(conditions)  # some are in the grid too
            if condition.method in self.methods
        ]
        has_variants = set_name in VARIANT_SETS and index < N_VARIANT_SHUFFLES
        if has_variants and PROMISES in self.methods:
            contenders += make_variants()
        return contenders


def replay_row(set_name: str, replay: Replay, commit: str) -> dict[str, Any]:
    """Return a replay's row of replays.csv.

    Its column `bought` has the cycles, from 1, at which every `LABELS_PER_POINT`-th label was
    there, as text.
    """
    summary = {"set": set_name} | replay.summary()
    cycles = np.flatnonzero(replay.verified)[LABELS_PER_POINT - 1 :: LABELS_PER_POINT] + 1
    row = {column: summary[column] for column in [*CONDITION, *SUMMARY]}
    return row | {"bought": " ".join(map(str, cycles)), "commit": commit}


def merge_replays(old: pd.DataFrame, new: pd.DataFrame) -> pd.DataFrame:
    """Return the old rows with the new ones, sorted.

    If a condition was played again by another commit, all its old rows are left out, so that no
    mean is over two commits. Of two rows of one seed the new one stays.
    """
    replayed = new[[*CONDITION, "commit"]].drop_duplicates()
    matched = old.merge(replayed, on=CONDITION, how="left", suffixes=("", "_new"))
    is_replaced = matched["commit_new"].notna() & (matched["commit_new"] != matched["commit"])
    rows = pd.concat([old[~is_replaced.to_numpy()], new])
    rows = rows.drop_duplicates([*CONDITION, "seed"], keep="last")
    positions = {name: i for i, name in enumerate([*SETS, *METHODS])}

    def sort_key(column: pd.Series) -> pd.Series:
        return column.map(positions) if column.name in ("set", "recipe") else column

    return rows.sort_values([*CONDITION, "seed"], key=sort_key)


def read_replays(path: Path) -> pd.DataFrame:
    """Return the rows of replays.csv; none if the file is missing."""
    if not path.exists():
        return pd.DataFrame(columns=[*CONDITION, "seed", "commit"])
    return pd.read_csv(path, dtype={"bought": str, "commit": str})


def last_commit() -> str:
    """Return the last commit that changed the imported dengine, with a + if it differs from it."""
    folder = Path(dengine.__file__).parent

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()

    commit = git("log", "-1", "--format=%h", ".") or "unknown"
    return commit + "+" if git("status", "--porcelain", ".") else commit


def print_cost(plan: Plan, keep: Path, n_jobs: int) -> None:
    """Print how many replays are not in `keep` yet, and how long they take.

    It makes the folder `keep` if that is missing.
    """
    remaining = list[str]()
    for shuffle in plan.iterate_shuffles():
        kept = KeptReplays(keep, shuffle.data)
        missing = [task for task in shuffle.tasks if not kept.path(task).is_file()]
        remaining += [task.contender.name for task in missing]
    seconds = sum(SECONDS.get(name, SECONDS["conv"]) for name in remaining)
    n_at_once = joblib.effective_n_jobs(n_jobs)  # on a cluster: its cores
    hours = seconds / 3600.0 / n_at_once
    print(
        f"{len(remaining)} replays are left, about {hours:.1f} hours at {n_at_once} at a time.",
        flush=True,
    )


def play(plan: Plan, folder: Path, keep: Path, n_jobs: int) -> None:
    """Play all shuffles; after each seed, write the results of all seeds so far."""
    path = folder / "replays.csv"
    commit = last_commit()
    old = read_replays(path)
    rows = list[dict[str, Any]]()
    for shuffle in plan.iterate_shuffles():
        replays = iterate_replays(shuffle.data, shuffle.tasks, n_jobs=n_jobs, keep=keep)
        rows += [replay_row(shuffle.set_name, played.replay, commit) for played in replays]
        is_last_set = shuffle.set_name == plan.sets[-1]
        if is_last_set and rows:
            merged = merge_replays(old, pd.DataFrame(rows))
            write_csv(merged, path, force=True)
            write_results(merged, folder)
            now = datetime.now(UTC)
            print(f"{now:%H:%M:%S} seed {shuffle.seed}: {len(rows)} replays", flush=True)


@contextmanager
def use_cluster(address: str | None) -> Iterator[None]:
    """Let joblib send its work to the workers of a dask cluster; None: stay on this machine.

    A replay whose worker dies is played again by another one. Finished replays are kept on this
    machine. The workers need the same versions of dengine and its libraries.
    """
    if address is None:
        yield
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise SystemExit(f"--cluster needs dengine[dask]; install it ({error}).") from error
    try:
        client = Client(address)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise SystemExit(
            f"Expected the address of a dask scheduler, as tcp://host:8786, got {address} "
            f"({error}); start one with: dask scheduler"
        ) from error
    with client, joblib.parallel_config("dask", client=client):
        yield


def parse_arguments() -> argparse.Namespace:
    """Parse the command line; `sets` and `only` of the result are lists."""
    parser = options(__doc__, seeds="100:130", n_jobs=2, keep=Path("out/evidence"), out=Path("out"))
    parser.add_argument("--screw", type=Path, help="the screw-driving set, an .npz file")
    parser.add_argument("--sets", default=",".join(SETS), help="names with commas; all by default")
    parser.add_argument(
        "--only",
        default=",".join([*METHODS, PROMISES]),
        help=f"reducers and baselines with commas; '{PROMISES}' for the variants of conv",
    )
    parser.add_argument("--cycles", type=int, default=1503, help="of a replay, at most")
    parser.add_argument(
        "--cells",
        type=int,
        default=len(POLICIES),
        help="policies: 1 plays (0.1, 90 %%) alone, without the paper's combinations",
    )
    parser.add_argument(
        "--cluster", metavar="ADDRESS", help="scheduler of a dask cluster that plays the replays"
    )
    parser.add_argument(
        "--tables-only",
        action="store_true",
        help="play nothing: write tables and figures from the replays.csv in OUT/evidence",
    )
    arguments = parser.parse_args()
    arguments.sets = arguments.sets.split(",")
    arguments.only = arguments.only.split(",")
    choices = {"--sets": (arguments.sets, SETS), "--only": (arguments.only, [*METHODS, PROMISES])}
    for option, (names, known_names) in choices.items():
        if unknown := [name for name in names if name not in known_names]:
            expected = ", ".join(known_names)
            parser.error(f"expected names of {expected} for {option}, got {', '.join(unknown)}")
    return arguments


def main() -> None:
    """Parse the command line, print the cost, play the replays, write the results."""
    arguments = parse_arguments()
    folder = arguments.out / "evidence"
    if arguments.tables_only:
        replays = read_replays(folder / "replays.csv")
        if replays.empty:
            raise SystemExit(f"Expected replays in {folder / 'replays.csv'}, got none; play them.")
        write_results(replays, folder)
        print(f"Wrote {folder / 'index.md'} from {len(replays)} replays.")
        return
    if "screw driving" in arguments.sets and arguments.screw is None:
        arguments.sets.remove("screw driving")
        print(
            "Without screw driving: make it by training/make_screw_driving.py from its public "
            "source, and give SCREW=FILE."
        )
    plan = Plan(
        seeds=arguments.seeds,
        sets=arguments.sets,
        methods=arguments.only,
        n_policies=arguments.cells,
        max_cycles=arguments.cycles,
        screw_driving=arguments.screw,
    )
    with use_cluster(arguments.cluster):
        print_cost(plan, arguments.keep, arguments.n_jobs)
        play(plan, folder, arguments.keep, arguments.n_jobs)


if __name__ == "__main__":
    main()
