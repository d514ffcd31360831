"""How a retrain grows with the store: it must not.

    python training/benchmark_scale.py --sizes 1503,10000,100000,1000000 --out out/

Fills SQLite stores with labelled traces (the bundled ones, each with fresh sensor noise; 4 GB at a million), opens an
engine on each, and times opening, retraining, reporting and deciding. A retrain is timed by the wall clock around the
whole `engine.retrain()`: from taking the data until the new version is committed to the store, so that the commit counts
against the budget of 0.45 s too (`RetrainReport.seconds` ends where the version answers).

UMAP's fit stands beside it up to --umap-most traces. What certainty costs: the same fresh parts judged by models whose
window is smaller and larger.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from common import POLICY, options
from rich.console import Console
from rich.progress import track
from rich.table import Table

from dengine import (
    Action,
    DataEngine,
    Dataset,
    Decision,
    ModelPrediction,
    Reason,
    Recipe,
    Source,
    load_dataset,
    make_reducer,
)
from dengine.cli.output import duration, size
from dengine.experiments.tables import write_csv
from dengine.folds import content_hash
from dengine.traces import as_traces

CHUNK = 5000


def noisy(data: Dataset, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Labelled traces (n, C, T): bundled ones with 0.2 units of fresh sensor noise."""
    rows = rng.integers(len(data), size=n)
    X = as_traces(data.X[rows])
    return X + rng.normal(0.0, 0.2, X.shape).astype(np.float32), data.y[rows]


def fill(engine: DataEngine, data: Dataset, n: int) -> None:
    """Put n labelled traces into the engine's store, in bulk."""
    rng = np.random.default_rng(0)
    engine.decide(noisy(data, 1, rng)[0][0])  # the first trace sets the contract
    for start in track(range(0, n, CHUNK), description=f"{n:,} traces"):
        X, y = noisy(data, min(CHUNK, n - start), rng)
        decisions = [_verified(f"import-{start + i}") for i in range(len(X))]
        engine.store.put_labelled(decisions, X, content_hash(X), y, Source.VERIFICATION)


def _verified(name: str) -> Decision:
    return Decision(name, Action.VERIFY, Action.VERIFY, 0.0, 1.0, 0, 0, None, 0, Reason.NO_MODEL, False, 1.0)


def wall_time(call: Callable[..., Any], *given: Any) -> tuple[float, Any]:
    """Seconds until a call returns, and what it returns."""
    begin = time.perf_counter()
    found = call(*given)
    return time.perf_counter() - begin, found


def measure_store(data: Dataset, recipe: Recipe, n: int, repeats: int, folder: Path) -> dict[str, Any]:
    """Times of one store of n labelled traces, in seconds."""
    path = folder / f"{n}.db"
    with DataEngine.from_recipe(recipe, store=path) as engine:
        fill(engine, data, n)
    opened, engine = wall_time(DataEngine.open, path)
    retrains = [wall_time(engine.retrain)[0] for _ in range(repeats)]
    decide, report = [], []
    for x in noisy(data, 300, np.random.default_rng(1))[0]:
        seconds, decision = wall_time(engine.decide, x)
        decide.append(seconds)
        if decision.action is Action.VERIFY:
            report.append(wall_time(engine.report, decision.id, True)[0])
    engine.close()
    size = path.stat().st_size / 1e9
    path.unlink()
    return {
        "traces": n,
        "store_gb": size,
        "open_s": opened,
        "retrain_p50_s": np.median(retrains),
        "retrain_max_s": np.max(retrains),
        "decide_p50_ms": 1e3 * np.median(decide),
        "decide_p99_ms": 1e3 * np.quantile(decide, 0.99),
        "report_p50_ms": 1e3 * np.median(report) if report else np.nan,
    }


def measure_umap(data: Dataset, sizes: list[int]) -> dict[int, float]:
    """UMAP's fit, in seconds, by number of traces; a first one compiles."""
    if not sizes:
        return {}
    rng = np.random.default_rng(0)
    make_reducer("umap").fit(noisy(data, 200, rng)[0].reshape(200, -1))
    return {n: wall_time(make_reducer("umap").fit, noisy(data, n, rng)[0].reshape(n, -1))[0] for n in sizes}


def measure_certainty(data: Dataset, recipe: Recipe, windows: list[int], seed: int = 0) -> list[dict[str, Any]]:
    """Certain share and error of fresh parts by models trained on ever larger windows of one long stream.

    Reference parts and fresh parts come from disjoint halves of the data.
    """
    order = np.random.default_rng(seed).permutation(len(data))
    half = len(data) // 2
    known = Dataset(data.X[order[:half]], data.y[order[:half]])
    fresh = Dataset(data.X[order[half:]], data.y[order[half:]])
    X, y = noisy(known, max(windows), np.random.default_rng(seed))
    rows = []
    for n in windows:
        model = ModelPrediction.from_recipe(recipe, seed).fit(X[-n:], y[-n:])
        actions = model.decide(fresh.X)
        accepted = actions == Action.ACCEPT
        wrong = (accepted & (fresh.y == 0)) | ((actions == Action.REJECT) & (fresh.y == 1))
        certain = actions != Action.VERIFY
        share = wrong.sum() / certain.sum() if certain.any() else np.nan
        rows.append({"window": n, "certain_fraction": certain.mean(), "accepted": accepted.sum(), "wrong_fraction": share})
    return rows


HEADINGS = {
    "store_gb": "store",
    "open_s": "opening",
    "retrain_p50_s": "retrain, median",
    "retrain_max_s": "retrain, worst",
    "umap_fit_s": "UMAP's fit",
    "decide_p50_ms": "decide, p50",
    "decide_p99_ms": "decide, p99",
    "report_p50_ms": "report, p50",
    "certain_fraction": "certain",
    "wrong_fraction": "wrong, of certain",
}


def written(name: str, value: float) -> str:
    """A cell of a table as a person writes it; the unit is in the column's name."""
    if np.isnan(value):
        return "-"
    for ending, write in (
        ("_gb", lambda v: size(1e9 * v)),
        ("_ms", lambda v: duration(v / 1e3)),
        ("_s", duration),
        ("_fraction", lambda v: f"{100 * v:.1f} %"),
    ):
        if name.endswith(ending):
            return write(value)
    return f"{value:,}"


def main() -> None:
    """Parse, measure, print, write."""
    parser = options(__doc__, data="insertion", samples=None, recipe="conv", folder=None, out=Path("out"))
    parser.add_argument("--sizes", default="1503,10000,100000,1000000", help="labelled traces in a store; 4 kB each")
    parser.add_argument("--umap-most", type=int, default=4000, help="UMAP is fitted on stores of at most so many traces")
    parser.add_argument("--windows", default="1000,2500,5000,10000,20000", help="references of the models of fresh parts")
    parser.add_argument("--repeats", type=int, default=5, help="retrains at each size")
    args = parser.parse_args()
    data, recipe = load_dataset(args.data, args.samples), Recipe.load(args.recipe).with_policy(**POLICY)
    sizes = [int(n) for n in args.sizes.split(",")]
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        stores = pd.DataFrame([measure_store(data, recipe, n, args.repeats, Path(folder)) for n in sizes])
    umap = measure_umap(data, [n for n in sizes if n <= args.umap_most])
    stores["umap_fit_s"] = stores["traces"].map(umap).astype(float)
    certainty = pd.DataFrame(measure_certainty(data, recipe, [int(n) for n in args.windows.split(",")]))
    for frame, name, title in (
        (stores, "benchmark_scale", "Times against store size"),
        (certainty, "benchmark_scale_certainty", "Certainty against window"),
    ):
        write_csv(frame, args.out / f"{name}.csv", force=True)
        table = Table(*(HEADINGS.get(column, column) for column in frame.columns), title=title)
        for values in frame.itertuples(index=False):
            table.add_row(*(written(column, value) for column, value in zip(frame.columns, values, strict=True)))
        Console(width=120).print(table)


if __name__ == "__main__":
    main()
