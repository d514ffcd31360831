"""How a retrain grows with the store: it must not.

    python training/benchmark_scale.py --sizes 1503,10000,100000,1000000 --out out/

Fills SQLite stores with labelled traces (the bundled ones, each with fresh sensor noise; 4 GB at a million), opens an
engine on each, and times opening, retraining, reporting and deciding. A retrain is timed by the wall clock around the
whole `engine.retrain()`: from taking the data until the new version is committed to the store, so that the commit counts
against the budget of 0.45 s too (`RetrainReport.seconds` ends where the version answers).

What certainty costs: the same fresh parts judged by models whose window is smaller and larger.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from common import POLICY, noisy, options, tell, wall_time
from rich.progress import track

from dengine import Action, DataEngine, Dataset, Decision, ModelPrediction, Reason, Recipe, load_dataset
from dengine.folds import content_hash
from dengine.store.journal import labelled
from dengine.store.records import checked_decision

CHUNK = 5000


def fill(engine: DataEngine, data: Dataset, n: int) -> None:
    """Put n labelled traces into the engine's store, in bulk."""
    rng = np.random.default_rng(0)
    engine.decide(noisy(data, 1, rng)[0][0])  # the first trace sets the contract
    for start in track(range(0, n, CHUNK), description=f"{n:,} traces"):
        X, y = noisy(data, min(CHUNK, n - start), rng)
        records: list[Any] = []
        for i, (x, good, hash_) in enumerate(zip(X, y, content_hash(X), strict=True), start):
            records += labelled(checked_decision(_verified(f"import-{i}"), x, hash_, False, 0.0), good)
        engine.store.take(records)


def _verified(name: str) -> Decision:
    return Decision(name, Action.VERIFY, Action.VERIFY, 0.0, 1.0, 0, 0, None, 0, Reason.NO_MODEL, False, 1.0)


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
    size = path.stat().st_size
    path.unlink()
    return {
        "traces": n,
        "store_bytes": size,
        "opening_s": opened,
        "retrain_p50_s": np.median(retrains),
        "retrain_max_s": np.max(retrains),
        "decide_p50_s": np.median(decide),
        "decide_p99_s": np.quantile(decide, 0.99),
        "report_p50_s": np.median(report) if report else np.nan,
    }


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
        row = {"window": n, "certain_share": certain.mean(), "accepted": accepted.sum(), "wrong_of_certain_share": share}
        rows.append(row)
    return rows


def main() -> None:
    """Parse, measure, print, write."""
    parser = options(__doc__, data="insertion", samples=None, recipe="conv", folder=None, out=Path("out"))
    parser.add_argument("--sizes", default="1503,10000,100000,1000000", help="labelled traces in a store; 4 kB each")
    parser.add_argument("--windows", default="1000,2500,5000,10000,20000", help="references of the models of fresh parts")
    parser.add_argument("--repeats", type=int, default=5, help="retrains at each size")
    args = parser.parse_args()
    data, recipe = load_dataset(args.data, args.samples), Recipe.load(args.recipe).with_policy(**POLICY)
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        stores = [measure_store(data, recipe, int(n), args.repeats, Path(folder)) for n in args.sizes.split(",")]
    tell(stores, "Times against store size", args.out / "benchmark_scale.csv")
    certainty = measure_certainty(data, recipe, [int(n) for n in args.windows.split(",")])
    tell(certainty, "Certainty against window", args.out / "benchmark_scale_certainty.csv")


if __name__ == "__main__":
    main()
