"""How long a cycle takes: retraining and deciding, with umap-learn beside it, in one run.

    python training/benchmark_cycle.py --replays 30 --out out/

Run it on an idle machine. Prints a table with the median and the worst case of each quantity, and writes it to --out.
"""

import os
import time
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from common import POLICY, options, print_table, quantiles, wall_time

from dengine import DataEngine, Dataset, Recipe, ReplayCell, load_dataset, make_reducer, replay
from dengine.engine.engine import core_of, frozen_objects, uncollected
from dengine.engine.trainer import LATE
from dengine.traces import as_traces

BUDGET = 0.45
WARM_UP = 0.07  # share of the cycles beside a retrain that are not timed


def measure(
    data: Dataset, recipe: Recipe, replays: int, repeats: int, umap_repeats: int
) -> list[dict[str, Any]]:
    """Every quantity, a row each."""
    # An engine that replays loads torch's optimiser before it begins; a cell has loaded it long before its first retrain.
    DataEngine(recipe=recipe, replaying=True)
    # By the clock, as a live cell: a replay of a recipe takes every step.
    played = [replay(data, DataEngine(recipe=recipe, seed=seed), seed) for seed in range(replays)]
    whole = [LATE not in each.reason for one in played for each in one.retrains]
    print(f"All steps were taken in {sum(whole)} of {len(whole)} retrains of the replays.")
    unhurried = [replay(data, recipe, seed) for seed in range(replays)]
    certain = [sum(int((~each.verified).sum()) for each in some) for some in (played, unhurried)]
    print(f"{certain[0]} decisions were certain; without a clock {certain[1]}.")
    engine = filled_engine(data, recipe)
    found = {
        f"retrain, all of {replays} replays": [
            each.seconds for one in played for each in one.retrains
        ],
        f"retrain on {len(data)} traces": [
            engine.retrain().seconds for _ in range(repeats)
        ],  # as a long run's last
    }
    engine = filled_engine(data, recipe)
    with frozen_objects(), uncollected():  # as `DataEngine.run` has it
        found["decide"] = [wall_time(engine.decide, trace)[0] for _ in range(3) for trace in data.X]
    spawned = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
    for name, executor in (("thread", ThreadPoolExecutor(1)), ("process", spawned)):
        found[f"decide, retraining in a {name}"], found[f"decide and swap, {name}"] = beside(
            data, recipe, executor
        )
    if umap_repeats:
        X = as_traces(data.X).reshape(len(data), -1)
        make_reducer("umap-learn").fit(X[:200])  # compiles
        reducer = make_reducer("umap-learn")
        found[f"umap-learn fit on {len(data)} traces"] = [
            wall_time(reducer.fit, X)[0] for _ in range(umap_repeats)
        ]
        reducer.transform(X[:1])
        found["umap-learn single transform"] = [
            wall_time(reducer.transform, x[None])[0] for x in X[:200]
        ]
    return [
        {
            "what": name,
            **quantiles(seconds),
            "target_s": BUDGET if name.startswith("retrain") else None,
        }
        for name, seconds in found.items()
    ]


def burn() -> None:
    """Keep a core busy."""
    while True:
        pass


@contextmanager
def busy_cores() -> Iterator[None]:
    """Another process burns on each core until the block ends."""
    burning = [
        get_context("spawn").Process(target=burn, daemon=True) for _ in range(os.cpu_count() or 1)
    ]
    for each in burning:
        each.start()
    try:
        yield
    finally:
        for each in burning:
            each.terminate()


def filled_engine(data: Dataset, recipe: Recipe, executor: Executor | None = None) -> DataEngine:
    """An engine that has verified the whole set: every trace a reference of the model that answers."""
    engine = DataEngine(recipe=recipe, executor=executor)
    for trace, label in zip(data.X, data.y, strict=True):
        decision = engine.decide(trace)
        if decision.action != "reject":
            engine.report(decision.id, bool(label))
    engine.retrain()
    return engine


def beside(data: Dataset, recipe: Recipe, executor: Executor) -> tuple[list[float], list[float]]:
    """Wall time of the decisions made while retrains run in the executor, and of those that also swap a version in."""
    engine, cell = filled_engine(data, recipe, executor), ReplayCell(data)
    seconds: list[float] = []
    swapping: list[float] = []
    with executor:
        for i in range(len(data)):
            if not core_of(engine).is_retraining:
                core_of(engine).start_retrain()
            version, (took, _) = engine.version, wall_time(engine.decide, cell.insert())
            if i > WARM_UP * len(data):  # the pool starts its worker on the first
                (seconds if engine.version == version else swapping).append(took)
            time.sleep(0.002)  # a cell does other things between two parts
        engine.close()
    return seconds, swapping


def main() -> None:
    """Parse, measure, print, write."""
    parser = options(__doc__, data="insertion", samples=None, recipe="conv", out=Path("out"))
    parser.add_argument(
        "--replays", type=int, default=30, help="shuffled replays whose retrains are timed"
    )
    parser.add_argument("--repeats", type=int, default=10, help="warm retrains on the whole set")
    parser.add_argument("--burn", action="store_true", help="beside a process that burns each core")
    parser.add_argument(
        "--umap-repeats", type=int, default=3, help="fits of umap-learn on the whole set"
    )
    args = parser.parse_args()
    recipe = Recipe.load(args.recipe).with_policy(**POLICY)
    with busy_cores() if args.burn else nullcontext():
        rows = measure(
            load_dataset(args.data, args.samples),
            recipe,
            args.replays,
            args.repeats,
            args.umap_repeats,
        )
    print_table(rows, "A cycle's times", args.out / "benchmark_cycle.csv")


if __name__ == "__main__":
    main()
