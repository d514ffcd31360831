"""How long a cycle takes: retraining and deciding, with UMAP beside it, in one run.

    python training/benchmark_cycle.py --replays 30 --out out/

Run it on an idle machine. Prints a table with the median and the worst case of each quantity, writes benchmark_cycle.csv
and benchmark_cycle.png (latencies of deciding) to --out.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from dengine import DataEngine, Dataset, Recipe, ReplayCell, load_dataset, make_reducer, replay
from dengine.cli.output import duration
from dengine.traces import as_traces

BUDGET = 0.45
WARM_UP = 0.07  # share of the cycles beside a retrain that are not timed


def measure(data: Dataset, args: argparse.Namespace) -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
    """Every quantity, in seconds, and the latencies behind those that are shown as a distribution."""
    recipe = Recipe.load(args.recipe).with_policy(alpha=0.1, lower_bound=0.9)
    played = [replay(data, recipe, seed) for seed in range(args.replays)]
    retrains, slices = (
        np.concatenate([one.retrain_seconds for one in played]),
        np.array([one.slice_max_s for one in played]),
    )
    whole = retrain_on_all(data, recipe, args.repeats)
    deciding = {"decide": decide_times(filled_engine(data, recipe), data)}
    swaps = {}
    for name, executor in (
        ("thread", ThreadPoolExecutor(1)),
        ("process", ProcessPoolExecutor(1, mp_context=get_context("spawn"))),
    ):
        deciding[f"decide, retraining in a {name}"], swaps[f"decide and swap, {name}"] = beside(data, recipe, executor)
    rows = [
        row(f"retrain, all of {args.replays} replays", retrains, BUDGET),
        row("the longest slice of the encoder's training in each", slices, BUDGET),
        row(f"retrain on {len(data)} traces", whole, BUDGET),
        *(row(name, seconds) for name, seconds in (deciding | swaps).items()),
    ]
    if args.umap_repeats:
        umap_fit, umap_transform = umap_times(data, args.umap_repeats)
        rows += [
            row(f"UMAP fit on {len(data)} traces", umap_fit),
            row("UMAP single transform", umap_transform),
            ratio("UMAP fit / retrain", umap_fit, whole, 6.0),
            ratio("UMAP single transform / decide", umap_transform, deciding["decide"], 15.0),
        ]
        deciding["UMAP single transform"] = umap_transform
    return rows, deciding


def retrain_on_all(data: Dataset, recipe: Recipe, repeats: int) -> np.ndarray:
    """Warm retrains on the whole set, as the last one of a long run sees it."""
    engine = filled_engine(data, recipe)
    return np.array([engine.retrain().seconds for _ in range(repeats)])


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


def show(rows: list[dict[str, Any]], deciding: dict[str, np.ndarray], out: Path) -> None:
    """Table on the screen, CSV and picture in `out`."""
    out.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(rows).to_csv(out / "benchmark_cycle.csv", index=False)
    table = Table("what", "n", "median", "p99", "worst", "target", title="A cycle's times")
    for r in rows:
        numbers = (written(r[key], r["unit"]) for key in ("median", "p99", "worst", "target"))
        table.add_row(r["what"], str(r["n"]), *numbers)
    Console(width=110).print(table)
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.subplots()
    for name, seconds in deciding.items():
        if len(seconds):
            axes.ecdf(1e3 * seconds, label=name)
    axes.set(xscale="log", xlabel="wall time of one call (ms)", ylabel="share of calls", title="Deciding on one trace")
    axes.legend()
    figure.savefig(out / "benchmark_cycle.png", dpi=150)


def main() -> None:
    """Parse, measure, show."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default="insertion", help="a bundled set, or an .npz file with X and y")
    parser.add_argument("--samples", type=int, help="use the first so many samples of each trace; all by default")
    parser.add_argument("--recipe", default="conv", help="a recipe's name or TOML file, or module:Class")
    parser.add_argument("--replays", type=int, default=30, help="shuffled replays whose retrains are timed")
    parser.add_argument("--repeats", type=int, default=10, help="warm retrains on the whole set")
    parser.add_argument(
        "--umap-repeats", type=int, default=3, help="fits of UMAP on the whole set, some seconds each; 0: none"
    )
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the CSV and the picture")
    args = parser.parse_args()
    data = load_dataset(args.data, args.samples)
    show(*measure(data, args), args.out)


if __name__ == "__main__":
    main()
