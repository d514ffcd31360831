"""What the exported file costs, and that it decides as the engine does; run it on an idle machine.

    python training/benchmark_export.py --data insertion --reducer conv --cell build/cpp/dengine-cell --out out/

Latency on one thread (Python, the C++ cell program, onnxruntime beside them), the first call after loading, file size;
parity over every trace of the data set and random ones, bad ones and audits among them. Ends with exit code 1 where a
decision differs.
"""

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from common import options, print_table, wall_time
from rich.progress import track

from dengine import DataEngine, Dataset, Recipe, export_torchscript, load_dataset, load_exported
from dengine.datasets.importing import import_labelled
from dengine.export.onnx import export_onnx, load_onnx
from dengine.records import Action
from dengine.store import SqlStore
from dengine.traces import as_traces

BOUND_TOLERANCE = 1e-6
AUDIT_RATE = 0.1


Row = dict[str, Any]


def finding(what: str, value: float, unit: str = "", target: str = "") -> Row:
    """One row of the table."""
    return {"what": what, "value": round(float(value)), "unit": unit, "target": target}


def train(data: Dataset, recipe: Recipe, **policy: Any) -> DataEngine:
    """An engine that has every trace of a data set as a reference, and audits."""
    store = SqlStore()
    import_labelled(store, data, recipe.with_policy(audit_rate=AUDIT_RATE, **policy))
    engine = DataEngine.open(store)
    engine.retrain()
    return engine


def random_traces(data: Dataset, n: int, rng: np.random.Generator) -> np.ndarray:
    """(n, C, T): noise of every size, mixtures of recorded traces, and one bad one in ten."""
    X = as_traces(data.X)
    one, two = X[rng.integers(len(X), size=n)], X[rng.integers(len(X), size=n)]
    share = rng.random((n, 1, 1)).astype(np.float32)
    out = share * one + (1.0 - share) * two + rng.normal(0.0, 0.5, one.shape).astype(np.float32)
    wild = rng.random(n) < 0.3
    noise = rng.normal(size=(int(wild.sum()), *X.shape[1:])) * 10.0 ** rng.uniform(
        -3, 6, (int(wild.sum()), 1, 1)
    )
    out[wild] = noise.astype(np.float32)
    for value in (np.nan, np.inf, -np.inf):
        out[rng.random(n) < 0.025, 0, int(rng.integers(X.shape[2]))] = value
    out[rng.random(n) < 0.025] = 1.5
    return out


def told(decision: Any) -> list[Any]:
    """Of a decision what must be the same everywhere."""
    exact = [decision.action, decision.reason, decision.n_success, decision.n_failure]
    return [*exact, decision.lower, decision.upper]


def differing(found: list[Any], expected: list[Any]) -> int:
    """Decisions (action, reason, counts, bounds) that differ: the bounds by more than the tolerance."""
    pairs = zip(found, map(told, expected), strict=True)
    return sum(
        a[:4] != b[:4] or np.abs(np.subtract(a[4:], b[4:])).max() > BOUND_TOLERANCE
        for a, b in pairs
    )


def microseconds(decide: Callable[[Any], Any], X: np.ndarray, calls: int) -> np.ndarray:
    """(calls,) wall time of each call."""
    return 1e6 * np.array([wall_time(decide, X[i % len(X)])[0] for i in range(calls)])


def quantiles(name: str, taken: np.ndarray, targets: tuple[str, str] = ("", "")) -> list[Row]:
    """Median and 99th percentile."""
    return [
        finding(f"{name}, p{p}", np.percentile(taken, p), "µs", t)
        for p, t in zip((50, 99), targets, strict=True)
    ]


def ask(cell: Path, file: Path, X: np.ndarray) -> tuple[list[list[Any]], np.ndarray]:
    """What the C++ program decides, and the microseconds of each call."""
    said = "".join("decide " + ",".join(f"{value:.9g}" for value in x.ravel()) + "\n" for x in X)
    done = subprocess.run([cell, file], input=said, capture_output=True, check=True, text=True)
    lines = [line.split(",")[1:] for line in done.stdout.splitlines()]
    found = [[w[0], w[1], int(w[4]), int(w[5]), float(w[2]), float(w[3])] for w in lines]
    return found, np.array([float(w[-1]) for w in lines])


def measure(args: argparse.Namespace, folder: Path) -> list[Row]:
    """Every row of the table."""
    data, rng = load_dataset(args.data), np.random.default_rng(1)
    engine = train(data, Recipe.load(args.reducer))
    X, known = (
        np.concatenate([as_traces(data.X), random_traces(data, args.random, rng)]),
        as_traces(data.X),
    )
    expected = [engine.decide(x) for x in track(X, description="engine")]
    file = export_torchscript(engine, folder / "model.ts")
    exported = load_exported(file)
    first = microseconds(exported.decide, known, 1)[0]
    rows = [
        finding("file size", file.stat().st_size / 1e3, "kB", "< 1 MB"),
        finding("decisions compared", len(X), ""),
        finding("of them certain", sum(d.predicted is not Action.VERIFY for d in expected), ""),
        finding("of them audits", sum(d.audit for d in expected)),
        finding(
            "Python differs in",
            differing(list(map(told, exported.decide_many(X))), expected),
            "",
            "0",
        ),
        finding("first call after loading", first, "µs", "<= 1 ms"),
        *quantiles(
            "Python", microseconds(exported.decide, known, args.calls), ("<= 150 µs", "<= 500 µs")
        ),
    ]
    if args.cell is not None:
        wrong = differing(ask(args.cell, file, X)[0], expected)
        _, taken = ask(args.cell, file, known[np.arange(args.calls) % len(known)])
        rows += [
            finding("C++ differs in", wrong, "", "0"),
            *quantiles("C++", taken, ("<= 120 µs", "<= 400 µs")),
        ]
    if args.onnx:
        runtime = load_onnx(export_onnx(engine.model, folder / "model.onnx", trace=engine.trace))
        model = load_exported(
            export_torchscript(engine.model, folder / "plain.ts", trace=engine.trace)
        )
        new = X[len(known) :]  # a reference that is asked about itself has a vote in ONNX
        found = list(map(told, runtime.decide_many(new)))
        rows.append(finding("onnxruntime differs in", differing(found, model.decide_many(new))))
        rows += quantiles("onnxruntime", microseconds(runtime.decide, known, args.calls))
    return rows


def main() -> None:
    """Parse, measure, print."""
    parser = options(__doc__, data="insertion", out=Path("out"))
    parser.add_argument("--reducer", default="conv", help="a recipe's name or TOML file")
    parser.add_argument(
        "--random",
        type=int,
        default=10_000,
        help="random traces compared beside the data set's own",
    )
    parser.add_argument("--calls", type=int, default=5000, help="calls timed")
    parser.add_argument(
        "--cell", type=Path, help="the built C++ program; without it C++ is left out"
    )
    parser.add_argument(
        "--no-onnx", dest="onnx", action="store_false", help="leave onnxruntime out"
    )
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(args, Path(folder))
    print_table(
        rows,
        f"Exported decision: {args.reducer} on {args.data}",
        args.out / "benchmark_export.csv",
        width=100,
    )
    sys.exit(any(row["target"] == "0" and row["value"] > 0 for row in rows))


if __name__ == "__main__":
    main()
