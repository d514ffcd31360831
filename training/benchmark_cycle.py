"""Measure how long a retrain and a decision take, with umap-learn beside them, in one run.

    python training/benchmark_cycle.py --replays 30 --out out/

Run it on an idle machine. It prints a table with the median and the worst case of each quantity,
and writes it to --out.
"""

import os
import time
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

from common import POLICY, options, print_table, quantiles, wall_time

from dengine import DataEngine, Dataset, Recipe, ReplayCell, load_dataset, make_reducer, replay
from dengine.engine.garbage import frozen_objects, uncollected
from dengine.engine.trainer import LATE
from dengine.traces import as_traces

BUDGET = 0.45  # of a retrain, in seconds
WARM_UP = 0.07  # share of the cycles beside a retrain that are not timed
PAUSE_SECONDS = 0.002  # a cell does other things between two parts

Times = dict[str, list[float]]  # quantity -> wall times in seconds


def measure(
    data: Dataset, recipe: Recipe, replays: int, repeats: int, umap_repeats: int
) -> list[dict[str, Any]]:
    """Measure every quantity; return a row of the table for each.

    It also prints what `time_replays` found.

    Parameters
    ----------
    data : Dataset
    recipe : Recipe
    replays : int
        Shuffled replays whose retrains are timed.
    repeats : int
        Warm retrains on the whole set.
    umap_repeats : int
        Fits of umap-learn; 0 leaves umap-learn out.
    """
    times = time_replays(data, recipe, replays)
    engine = filled_engine(data, recipe)
    times[f"retrain on {len(data)} traces"] = [engine.retrain().seconds for _ in range(repeats)]
    engine = filled_engine(data, recipe)
    with frozen_objects(), uncollected():  # as `DataEngine.run` has it
        times["decide"] = [wall_time(engine.decide, trace)[0] for _ in range(3) for trace in data.X]
    process = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
    for name, executor in (("thread", ThreadPoolExecutor(1)), ("process", process)):
        concurrent = time_beside_retrains(data, recipe, executor)
        times[f"decide, retraining in a {name}"] = concurrent.decisions
        times[f"decide and swap, {name}"] = concurrent.swaps
    if umap_repeats:
        times |= time_umap_learn(data, umap_repeats)
    rows = []
    for name, seconds in times.items():
        target = BUDGET if name.startswith("retrain") else None
        rows.append({"what": name, **quantiles(seconds), "target_s": target})
    return rows


def time_replays(data: Dataset, recipe: Recipe, n_replays: int) -> Times:
    """Play shuffled replays by the clock, as a live cell does; return the times of their retrains.

    Prints how many retrains had time for all steps, and the certain decisions with and without the
    clock: a replay of a recipe takes every step.
    """
    # An engine that replays loads PyTorch's optimizers when it is made. A live cell has loaded them
    # long before its first retrain.
    DataEngine(recipe=recipe, replaying=True)
    timed = [replay(data, DataEngine(recipe=recipe, seed=seed), seed) for seed in range(n_replays)]
    untimed = [replay(data, recipe, seed) for seed in range(n_replays)]
    reports = [report for played in timed for report in played.retrains]
    n_complete = sum(LATE not in report.reason for report in reports)
    print(f"All steps were taken in {n_complete} of {len(reports)} retrains of the replays.")
    certain = sum(int((~played.verified).sum()) for played in timed)
    certain_untimed = sum(int((~played.verified).sum()) for played in untimed)
    print(f"{certain} decisions were certain; without a clock {certain_untimed}.")
    return {f"retrain, all of {n_replays} replays": [report.seconds for report in reports]}


def time_umap_learn(data: Dataset, repeats: int) -> Times:
    """Return the times of umap-learn, for a fit on the whole set and for a single trace."""
    X = as_traces(data.X).reshape(len(data), -1)
    make_reducer("umap-learn").fit(X[:200])  # compiles
    reducer = make_reducer("umap-learn")
    fits = [wall_time(reducer.fit, X)[0] for _ in range(repeats)]
    reducer.transform(X[:1])
    transforms = [wall_time(reducer.transform, trace[None])[0] for trace in X[:200]]
    return {
        f"umap-learn fit on {len(data)} traces": fits,
        "umap-learn single transform": transforms,
    }


def burn() -> None:
    """Keep a core busy until the process is ended."""
    while True:
        pass


@contextmanager
def busy_cores() -> Iterator[None]:
    """Keep each core busy with another process until the block ends."""
    context = get_context("spawn")
    processes = [context.Process(target=burn, daemon=True) for _ in range(os.cpu_count() or 1)]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        for process in processes:
            process.terminate()


def filled_engine(data: Dataset, recipe: Recipe, executor: Executor | None = None) -> DataEngine:
    """Return an engine that has learned every label of a set, and retrained."""
    engine = DataEngine(recipe=recipe, executor=executor)
    for trace, label in zip(data.X, data.y, strict=True):
        engine.report(engine.decide(trace).id, bool(label))
    engine.retrain()
    return engine


class ConcurrentTimes(NamedTuple):
    """Wall times in seconds of decisions beside retrains.

    Attributes
    ----------
    decisions : list of float
        Of those that left the engine's version as it was.
    swaps : list of float
        Of those that also swapped a new version in.
    """

    decisions: list[float]
    swaps: list[float]


def time_beside_retrains(data: Dataset, recipe: Recipe, executor: Executor) -> ConcurrentTimes:
    """Time one decision on each trace, while retrains run all the time in an executor.

    The executor is shut down at the end.
    """
    engine = filled_engine(data, recipe, executor)
    cell = ReplayCell(data)
    times = ConcurrentTimes([], [])
    with executor:
        for i in range(len(data)):
            if not engine.state.is_retraining:
                engine.retrain(wait=False)
            version = engine.version
            trace = cell.insert()
            seconds, _ = wall_time(engine.decide, trace)
            if i > WARM_UP * len(data):  # the pool starts its worker on the first
                is_swap = engine.version != version
                (times.swaps if is_swap else times.decisions).append(seconds)
            time.sleep(PAUSE_SECONDS)
        engine.close()
    return times


def main() -> None:
    """Measure, print the table and write it."""
    parser = options(__doc__, data="insertion", samples=None, recipe="conv", out=Path("out"))
    parser.add_argument(
        "--replays", type=int, default=30, help="shuffled replays whose retrains are timed"
    )
    parser.add_argument("--repeats", type=int, default=10, help="warm retrains on the whole set")
    parser.add_argument("--burn", action="store_true", help="keep each core busy meanwhile")
    parser.add_argument(
        "--umap-repeats", type=int, default=3, help="fits of umap-learn on the whole set"
    )
    arguments = parser.parse_args()
    recipe = Recipe.load(arguments.recipe).with_policy(**POLICY)
    data = load_dataset(arguments.data, samples=arguments.samples)
    with busy_cores() if arguments.burn else nullcontext():
        rows = measure(data, recipe, arguments.replays, arguments.repeats, arguments.umap_repeats)
    print_table(rows, "A cycle's times", arguments.out / "benchmark_cycle.csv")


if __name__ == "__main__":
    main()
