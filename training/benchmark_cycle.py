"""How long a cycle takes: retraining and deciding, with UMAP beside it, in one run.

    python training/benchmark_cycle.py --replays 30 --out out/

Run it on an idle machine. Prints a table with the median and the worst case of each quantity, and writes it to --out.
"""

from __future__ import annotations

import time
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from common import POLICY, options
from rich.console import Console
from rich.table import Table

from dengine import DataEngine, Dataset, Recipe, ReplayCell, load_dataset, make_reducer, replay
from dengine.cli.output import duration
from dengine.experiments.tables import write_csv
from dengine.traces import as_traces

BUDGET = 0.45
WARM_UP = 0.07  # share of the cycles beside a retrain that are not timed


def measure(data: Dataset, recipe: Recipe, replays: int, repeats: int, umap_repeats: int) -> list[dict[str, Any]]:
    """Every quantity, a row each."""
    played = [replay(data, recipe, seed) for seed in range(replays)]
    retrains = np.array([each.seconds for one in played for each in one.retrains])
    engine = filled_engine(data, recipe)
    whole = np.array([engine.retrain().seconds for _ in range(repeats)])  # as the last one of a long run sees it
    rows = [
        row(f"retrain, all of {replays} replays", retrains, BUDGET),
        row(f"retrain on {len(data)} traces", whole, BUDGET),
    ]
    decide = decide_times(filled_engine(data, recipe), data)
    rows.append(row("decide", decide))
    spawned = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
    for name, executor in (("thread", ThreadPoolExecutor(1)), ("process", spawned)):
        seconds, swapping = beside(data, recipe, executor)
        rows += [row(f"decide, retraining in a {name}", seconds), row(f"decide and swap, {name}", swapping)]
    if umap_repeats:
        fit, transform = umap_times(data, umap_repeats)
        rows += [
            row(f"UMAP fit on {len(data)} traces", fit),
            row("UMAP single transform", transform),
            ratio("UMAP fit / retrain", fit, whole, 6.0),
            ratio("UMAP single transform / decide", transform, decide, 15.0),
        ]
    return rows


def filled_engine(data: Dataset, recipe: Recipe, executor: Executor | None = None) -> DataEngine:
    """An engine that has verified the whole set: every trace a reference of the model that answers."""
    engine = DataEngine.from_recipe(recipe, executor=executor)
    for trace, label in zip(data.X, data.y, strict=True):
        decision = engine.decide(trace)
        if decision.action != "reject":
            engine.report(decision.id, bool(label))
    engine.retrain()
    return engine


def decide_times(engine: DataEngine, data: Dataset, times: int = 3) -> np.ndarray:
    """Wall time of each decision, over the set, `times` times."""
    seconds = []
    for trace in np.concatenate([data.X] * times):
        begin = time.perf_counter()
        engine.decide(trace)
        seconds.append(time.perf_counter() - begin)
    return np.array(seconds)


def beside(data: Dataset, recipe: Recipe, executor: Executor) -> tuple[np.ndarray, np.ndarray]:
    """Wall time of the decisions made while retrains run in the executor, and of those that also swap a version in."""
    engine = filled_engine(data, recipe, executor)
    seconds, swapping, cell = [], [], ReplayCell(data)
    with executor:
        for i in range(len(data)):
            if not engine.retraining:
                engine.start_retrain()
            trace, version = cell.insert(), engine.version
            begin = time.perf_counter()
            engine.decide(trace)
            if i > WARM_UP * len(data):  # the pool starts its worker on the first
                (seconds if engine.version == version else swapping).append(time.perf_counter() - begin)
            time.sleep(0.002)  # a cell does other things between two parts
        engine.close()
    return np.array(seconds), np.array(swapping)


def umap_times(data: Dataset, repeats: int) -> tuple[np.ndarray, np.ndarray]:
    """UMAP's fit on the whole set and its transform of one trace, after a fit that compiles."""
    X = as_traces(data.X).reshape(len(data), -1)
    make_reducer("umap").fit(X[:200])
    fits, reducer = [], make_reducer("umap")
    for _ in range(repeats):
        begin = time.perf_counter()
        reducer.fit(X)
        fits.append(time.perf_counter() - begin)
    reducer.transform(X[:1])
    singles = []
    for x in X[:200]:
        begin = time.perf_counter()
        reducer.transform(x[None])
        singles.append(time.perf_counter() - begin)
    return np.array(fits), np.array(singles)


def row(name: str, seconds: np.ndarray, target: float | None = None) -> dict[str, Any]:
    """One line of the table, in milliseconds; NaN where it never happened, as a swap within few cycles."""
    p50, p99, worst = 1e3 * np.quantile(seconds, [0.5, 0.99, 1.0]) if len(seconds) else np.full(3, np.nan)
    limit = None if target is None else 1e3 * target
    return {"what": name, "n": len(seconds), "median": p50, "p99": p99, "worst": worst, "target": limit, "unit": "ms"}


def ratio(name: str, slow: np.ndarray, fast: np.ndarray, target: float) -> dict[str, Any]:
    """A ratio of medians, and at its worst: the fastest of the slow against the slowest of the fast."""
    middle = worst = np.nan
    if len(slow) and len(fast):
        middle, worst = np.median(slow) / np.median(fast), slow.min() / fast.max()
    return {"what": name, "n": len(slow), "median": middle, "p99": np.nan, "worst": worst, "target": target, "unit": "x"}


def written(value: float | None, unit: str) -> str:
    """A cell of the table as a person writes it."""
    if value is None or np.isnan(value):
        return ""
    return duration(value / 1e3) if unit == "ms" else f"{value:.0f} {unit}"


def main() -> None:
    """Parse, measure, print, write."""
    parser = options(__doc__, data="insertion", samples=None, recipe="conv", out=Path("out"))
    parser.add_argument("--replays", type=int, default=30, help="shuffled replays whose retrains are timed")
    parser.add_argument("--repeats", type=int, default=10, help="warm retrains on the whole set")
    parser.add_argument("--umap-repeats", type=int, default=3, help="fits of UMAP on the whole set, some seconds each")
    args = parser.parse_args()
    recipe = Recipe.load(args.recipe).with_policy(**POLICY)
    rows = measure(load_dataset(args.data, args.samples), recipe, args.replays, args.repeats, args.umap_repeats)
    write_csv(pd.DataFrame(rows), args.out / "benchmark_cycle.csv", force=True)
    table = Table("what", "n", "median", "p99", "worst", "target", title="A cycle's times")
    for r in rows:
        numbers = (written(r[key], r["unit"]) for key in ("median", "p99", "worst", "target"))
        table.add_row(r["what"], str(r["n"]), *numbers)
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
