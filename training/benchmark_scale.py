"""Measure how a retrain depends on the size of the store: it must not.

    python training/benchmark_scale.py --sizes 1503,10000,100000,1000000 --out out/

Fills SQLite stores with labelled traces: the bundled ones, each with fresh sensor noise; 4 GB for a
million. It opens an engine on each store, and times opening, retraining, reporting and deciding.
Opening includes what an engine prepares in a thread before its first retrain.
The time of a retrain is that of the whole `engine.retrain()`, from reading the data until the new
version is committed to the store. So the commit counts against the budget of 0.45 s too, while
`RetrainReport.seconds` ends when the new version decides.
"""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from common import POLICY, noisy, options, print_table, wall_time
from rich.progress import track

from dengine import Action, DataEngine, Dataset, Reason, Recipe, Source, load_dataset
from dengine.engine.decide import verify_decision
from dengine.folds import content_hash
from dengine.store.records import NewLabel, StoredDecision

CHUNK = 5000  # traces that are written at once
N_DECISIONS = 300  # timed


def fill_store(engine: DataEngine, data: Dataset, n: int) -> None:
    """Write n labelled traces into the engine's store, in chunks.

    The engine first decides on one more trace, which sets the shape of all.
    """
    rng = np.random.default_rng(0)
    engine.decide(noisy(data, 1, rng)[0][0])  # the first trace sets the form of all
    for start in track(range(0, n, CHUNK), description=f"{n:,} traces"):
        X, y = noisy(data, min(CHUNK, n - start), rng)
        records: list[Any] = []
        hashes = content_hash(X)
        for i, (trace, label, hash_) in enumerate(zip(X, y, hashes, strict=True), start):
            decision = verify_decision(f"import-{i}", None, 0, Reason.NO_MODEL)
            trace = np.array(trace, np.float32, ndmin=2)
            records.append(StoredDecision(decision, trace, hash_, False, 0.0))
            records.append(
                NewLabel(decision.id, bool(label), Source.VERIFICATION, 0, None, content_hash=hash_)
            )
        engine.store.apply_records(records)


def measure_store(
    data: Dataset, recipe: Recipe, n: int, repeats: int, folder: Path
) -> dict[str, Any]:
    """Fill a store with n labelled traces; return its size and the times on it, in seconds."""
    path = folder / f"{n}.db"
    with DataEngine(recipe=recipe, store=path) as engine:
        fill_store(engine, data, n)
    opening, engine = wall_time(DataEngine.open, path)
    retrains = [wall_time(engine.retrain)[0] for _ in range(repeats)]
    decides = []
    reports = [np.nan]  # there may be none
    for trace in noisy(data, N_DECISIONS, np.random.default_rng(1))[0]:
        seconds, decision = wall_time(engine.decide, trace)
        decides.append(seconds)
        if decision.action is Action.VERIFY:
            reports.append(wall_time(engine.report, decision.id, True)[0])
    engine.close()
    return {
        "traces": n,
        "store_bytes": path.stat().st_size,
        "opening_s": opening,
        "retrain_p50_s": np.median(retrains),
        "retrain_max_s": np.max(retrains),
        "decide_p50_s": np.median(decides),
        "decide_p99_s": np.quantile(decides, 0.99),
        "report_p50_s": np.nanmedian(reports),
    }


def main() -> None:
    """Measure a store of each size, print the table and write it."""
    parser = options(
        __doc__, data="insertion", samples=None, recipe="conv", folder=None, out=Path("out")
    )
    parser.add_argument(
        "--sizes", default="1503,10000,100000,1000000", help="labelled traces in a store; 4 kB each"
    )
    parser.add_argument("--repeats", type=int, default=5, help="retrains at each size")
    arguments = parser.parse_args()
    data = load_dataset(arguments.data, samples=arguments.samples)
    recipe = Recipe.load(arguments.recipe).with_policy(**POLICY)
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        rows = [
            measure_store(data, recipe, int(size), arguments.repeats, Path(folder))
            for size in arguments.sizes.split(",")
        ]
    print_table(rows, "Times against store size", arguments.out / "benchmark_scale.csv")


if __name__ == "__main__":
    main()
