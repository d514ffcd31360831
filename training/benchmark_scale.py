"""How a retrain grows with the store: it must not.

    python training/benchmark_scale.py --sizes 1503,10000,100000,1000000 --out out/

Fills SQLite stores with labelled traces (the bundled ones, each with fresh sensor noise; 4 GB at a million), opens an
engine on each, and times opening, retraining, reporting and deciding. A retrain is timed by the wall clock around the
whole `engine.retrain()`: from taking the data until the new version is committed to the store, so that the commit counts
against the budget of 0.45 s too (`RetrainReport.seconds` ends where the version answers).
"""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from common import POLICY, noisy, options, print_table, wall_time
from rich.progress import track

from dengine import Action, DataEngine, Dataset, Decision, Reason, Recipe, Source, load_dataset
from dengine.folds import content_hash
from dengine.store.records import NewLabel, StoredDecision

CHUNK = 5000


def fill(engine: DataEngine, data: Dataset, n: int) -> None:
    """Put n labelled traces into the engine's store, in bulk."""
    rng = np.random.default_rng(0)
    engine.decide(noisy(data, 1, rng)[0][0])  # the first trace sets the contract
    for start in track(range(0, n, CHUNK), description=f"{n:,} traces"):
        X, y = noisy(data, min(CHUNK, n - start), rng)
        records: list[Any] = []
        for i, (x, good, hash_) in enumerate(zip(X, y, content_hash(X), strict=True), start):
            trace = np.array(x, np.float32, ndmin=2)
            records.append(StoredDecision(_verified(f"import-{i}"), trace, hash_, False, 0.0))
            records.append(
                NewLabel(
                    f"import-{i}", bool(good), Source.VERIFICATION, 0, None, content_hash=hash_
                )
            )
        engine.store.apply_records(records)


def _verified(name: str) -> Decision:
    return Decision(
        name, Action.VERIFY, Action.VERIFY, 0.0, 1.0, 0, 0, None, 0, Reason.NO_MODEL, False, 1.0
    )


def measure_store(
    data: Dataset, recipe: Recipe, n: int, repeats: int, folder: Path
) -> dict[str, Any]:
    """Times of one store of n labelled traces, in seconds."""
    path = folder / f"{n}.db"
    with DataEngine(recipe=recipe, store=path) as engine:
        fill(engine, data, n)
    opened, engine = wall_time(DataEngine.open, path)
    retrains = [wall_time(engine.retrain)[0] for _ in range(repeats)]
    decide, report = [], [np.nan]  # there may be none
    for x in noisy(data, 300, np.random.default_rng(1))[0]:
        seconds, decision = wall_time(engine.decide, x)
        decide.append(seconds)
        if decision.action is Action.VERIFY:
            report.append(wall_time(engine.report, decision.id, True)[0])
    engine.close()
    took = {"opening": opened, "retrain_p50": np.median(retrains), "retrain_max": np.max(retrains)}
    took |= {
        "decide_p50": np.median(decide),
        "decide_p99": np.quantile(decide, 0.99),
        "report_p50": np.nanmedian(report),
    }
    return {"traces": n, "store_bytes": path.stat().st_size} | {
        f"{name}_s": seconds for name, seconds in took.items()
    }


def main() -> None:
    """Parse, measure, print, write."""
    parser = options(
        __doc__, data="insertion", samples=None, recipe="conv", folder=None, out=Path("out")
    )
    parser.add_argument(
        "--sizes", default="1503,10000,100000,1000000", help="labelled traces in a store; 4 kB each"
    )
    parser.add_argument("--repeats", type=int, default=5, help="retrains at each size")
    args = parser.parse_args()
    data, recipe = (
        load_dataset(args.data, args.samples),
        Recipe.load(args.recipe).with_policy(**POLICY),
    )
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        stores = [
            measure_store(data, recipe, int(n), args.repeats, Path(folder))
            for n in args.sizes.split(",")
        ]
    print_table(stores, "Times against store size", args.out / "benchmark_scale.csv")


if __name__ == "__main__":
    main()
