"""Measure the exported file, and check that it decides as the engine does.

    python training/benchmark_export.py --reducer conv --cell build/cpp/dengine-cell --out out/

Run it on an idle machine. It measures the latency on one thread in Python, in the C++ program and
in onnxruntime, the first call after loading, and the size of the file. It compares the decisions on
every trace of the data set and on random ones, including bad ones and audits. The exit code is 1 if
a decision in Python or C++ differs.
"""

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import options, print_table, wall_time
from numpy.typing import NDArray
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
Floats = NDArray[np.float64]


class Outcome(NamedTuple):
    """What of a decision must be the same everywhere; the bounds up to `BOUND_TOLERANCE`."""

    action: str
    reason: str
    n_success: int
    n_failure: int
    lower: float
    upper: float

    @classmethod
    def of(cls, decision: Any) -> "Outcome":
        """Return the outcome of a decision of an engine, an exported file or onnxruntime."""
        return cls(*(getattr(decision, name) for name in cls._fields))

    def differs(self, other: "Outcome") -> bool:
        """Return whether another outcome is not the same."""
        distances = np.abs(np.subtract(self[4:], other[4:]))
        return self[:4] != other[:4] or bool(distances.max() > BOUND_TOLERANCE)


def table_row(quantity: str, value: float, unit: str = "", target: str = "") -> Row:
    """Return one row of the table, with the value as a whole number."""
    return {"what": quantity, "value": round(float(value)), "unit": unit, "target": target}


def difference_row(
    name: str, outcomes: Iterable[Outcome], expected: Iterable[Outcome], target: str = "0"
) -> Row:
    """Return the row that counts the outcomes that differ from the expected ones."""
    n_different = sum(a.differs(b) for a, b in zip(outcomes, expected, strict=True))
    return table_row(f"{name} differs in", n_different, target=target)


def latency_rows(name: str, latencies: Floats, targets: tuple[str, str] = ("", "")) -> list[Row]:
    """Return the rows of the median and the 99th percentile of latencies in microseconds."""
    return [
        table_row(f"{name}, p{percent}", float(np.percentile(latencies, percent)), "µs", target)
        for percent, target in zip((50, 99), targets, strict=True)
    ]


def train(data: Dataset, recipe: Recipe) -> DataEngine:
    """Return an engine that has every trace of a data set as a reference, and audits."""
    store = SqlStore()
    import_labelled(store, data, recipe.with_policy(audit_rate=AUDIT_RATE))
    engine = DataEngine.open(store)
    engine.retrain()
    return engine


def random_traces(data: Dataset, n: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return traces (n, C, T): mixtures of two recorded ones, noise of every size, and bad ones.

    One in ten is bad: it has values that are not finite, or is constant.
    """
    X = as_traces(data.X)
    first = X[rng.integers(len(X), size=n)]
    second = X[rng.integers(len(X), size=n)]
    share = rng.random((n, 1, 1)).astype(np.float32)
    traces = share * first + (1.0 - share) * second
    traces = traces + rng.normal(0.0, 0.5, first.shape).astype(np.float32)
    is_noise = rng.random(n) < 0.3
    n_noise = int(is_noise.sum())
    noise = rng.normal(size=(n_noise, *X.shape[1:]))
    size = 10.0 ** rng.uniform(-3, 6, (n_noise, 1, 1))
    traces[is_noise] = (noise * size).astype(np.float32)
    for value in (np.nan, np.inf, -np.inf):
        traces[rng.random(n) < 0.025, 0, int(rng.integers(X.shape[2]))] = value
    traces[rng.random(n) < 0.025] = 1.5
    return traces


def time_calls(decide: Callable[[Any], Any], X: np.ndarray, calls: int) -> Floats:
    """Return the wall time of each call in microseconds, shape (calls,)."""
    return 1e6 * np.array([wall_time(decide, X[i % len(X)])[0] for i in range(calls)])


class CellProgramRun(NamedTuple):
    """What the C++ program decided on each trace, and how many microseconds each call took."""

    outcomes: list[Outcome]
    latencies: Floats


def run_cell_program(program: Path, file: Path, X: np.ndarray) -> CellProgramRun:
    """Let the C++ program decide on traces (n, C, T) with an exported file."""
    lines = ["decide " + ",".join(f"{value:.9g}" for value in trace.ravel()) for trace in X]
    commands = "".join(f"{line}\n" for line in lines)
    process = subprocess.run(
        [program, file], input=commands, capture_output=True, check=True, text=True
    )
    outcomes = []
    latencies = []
    for line in process.stdout.splitlines():
        _, action, reason, lower, upper, n_success, n_failure, *rest = line.split(",")
        bounds = (float(lower), float(upper))
        outcomes.append(Outcome(action, reason, int(n_success), int(n_failure), *bounds))
        latencies.append(float(rest[-1]))
    return CellProgramRun(outcomes, np.array(latencies))


def measure(arguments: argparse.Namespace, folder: Path) -> list[Row]:
    """Export a trained engine into a folder, and return every row of the table."""
    data = load_dataset(arguments.data)
    engine = train(data, Recipe.load(arguments.reducer))
    recorded = as_traces(data.X)
    drawn = random_traces(data, arguments.random, np.random.default_rng(1))
    X = np.concatenate([recorded, drawn])
    decisions = [engine.decide(trace) for trace in track(X, description="engine")]
    expected = list(map(Outcome.of, decisions))
    file = export_torchscript(engine, folder / "model.ts")
    exported = load_exported(file)
    first_call = time_calls(exported.decide, recorded, 1)[0]
    n_certain = sum(decision.predicted is not Action.VERIFY for decision in decisions)
    rows = [
        table_row("file size", file.stat().st_size / 1e3, "kB", "< 1 MB"),
        table_row("decisions compared", len(X)),
        table_row("of them certain", n_certain),
        table_row("of them audits", sum(decision.audit for decision in decisions)),
        difference_row("Python", map(Outcome.of, map(exported.decide, X)), expected),
        table_row("first call after loading", first_call, "µs", "<= 1 ms"),
    ]
    latencies = time_calls(exported.decide, recorded, arguments.calls)
    rows += latency_rows("Python", latencies, ("<= 150 µs", "<= 500 µs"))
    if arguments.cell is not None:
        outcomes = run_cell_program(arguments.cell, file, X).outcomes
        rows.append(difference_row("C++", outcomes, expected))
        timed = recorded[np.arange(arguments.calls) % len(recorded)]
        latencies = run_cell_program(arguments.cell, file, timed).latencies
        rows += latency_rows("C++", latencies, ("<= 120 µs", "<= 400 µs"))
    if arguments.onnx:
        rows += measure_onnx(engine, recorded, drawn, arguments.calls, folder)
    return rows


def measure_onnx(
    engine: DataEngine, recorded: np.ndarray, drawn: np.ndarray, calls: int, folder: Path
) -> list[Row]:
    """Return the rows of onnxruntime, which is compared with an exported model without audits.

    Only new traces are compared: a reference that is decided on counts itself in ONNX.
    """
    onnx_file = export_onnx(engine.model, folder / "model.onnx", trace=engine.trace)
    plain_file = export_torchscript(engine.model, folder / "plain.ts", trace=engine.trace)
    runtime = load_onnx(onnx_file)
    outcomes = map(Outcome.of, map(runtime.decide, drawn))
    expected = map(Outcome.of, map(load_exported(plain_file).decide, drawn))
    latencies = time_calls(runtime.decide, recorded, calls)
    difference = difference_row("onnxruntime", outcomes, expected, target="")
    return [difference, *latency_rows("onnxruntime", latencies)]


def main() -> None:
    """Measure, print the table and write it; exit with 1 if a decision differs."""
    parser = options(__doc__, data="insertion", out=Path("out"))
    parser.add_argument("--reducer", default="conv", help="a recipe's name or TOML file")
    parser.add_argument(
        "--random", type=int, default=10_000, help="random traces to compare beside the data set's"
    )
    parser.add_argument("--calls", type=int, default=5000, help="calls timed")
    parser.add_argument(
        "--cell", type=Path, help="the built C++ program; without it C++ is left out"
    )
    parser.add_argument(
        "--no-onnx", dest="onnx", action="store_false", help="leave onnxruntime out"
    )
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(arguments, Path(folder))
    title = f"Exported decision: {arguments.reducer} on {arguments.data}"
    print_table(rows, title, arguments.out / "benchmark_export.csv", width=100)
    sys.exit(any(row["target"] == "0" and row["value"] > 0 for row in rows))


if __name__ == "__main__":
    main()
