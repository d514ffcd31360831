"""One cell for a long time on SQLite: memory, file and versions must not grow without bound.

    python training/benchmark_endurance.py --cycles 50000 --out out/

An engine decides on bundled traces with fresh sensor noise and is told of every part that it verifies. After each 10,000
cycles the process's memory (RSS), the file with its log, and the versions in it are written down. Memory should be flat
after the first 10,000; the file grows by the traces, 4 kB each, and by the versions that its policy keeps.
"""

from __future__ import annotations

import os
import sqlite3
import tempfile
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from common import POLICY, options
from rich.console import Console
from rich.table import Table

from dengine import Action, DataEngine, Dataset, Recipe, load_dataset
from dengine.cli.output import duration, size
from dengine.experiments.tables import write_csv

FLAT = 0.05  # growth of memory after the first mark that still counts as flat


def memory() -> int:
    """Bytes that the process holds in memory at present (Linux)."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")


def stored(path: Path) -> int:
    """Bytes of a SQLite file and of its log."""
    return sum(each.stat().st_size for each in path.parent.glob(f"{path.name}*"))


def states(path: Path) -> int:
    """Versions whose arrays the store still holds."""
    with closing(sqlite3.connect(path)) as connection:
        return int(connection.execute("SELECT count(state) FROM model_version").fetchone()[0])


def endure(data: Dataset, recipe: Recipe, cycles: int, every: int, path: Path) -> list[dict[str, Any]]:
    """A row after each `every` cycles."""
    rng, rows, decide, report = np.random.default_rng(0), [], [], []
    with DataEngine.from_recipe(recipe, store=path) as engine:
        begin = time.perf_counter()
        for cycle in range(1, cycles + 1):
            i = int(rng.integers(len(data)))
            x = (data.X[i] + rng.normal(0.0, 0.2, data.X[i].shape)).astype(np.float32)
            decide.append(-time.perf_counter())
            decision = engine.decide(x)
            decide[-1] += time.perf_counter()
            if decision.action is Action.VERIFY:
                report.append(-time.perf_counter())
                engine.report(decision.id, bool(data.y[i]))
                report[-1] += time.perf_counter()
            if cycle % every == 0 or cycle == cycles:
                engine.flush()
                known = engine.store.status()
                rows.append(
                    {
                        "cycles": cycle,
                        "seconds": time.perf_counter() - begin,
                        "memory": memory(),
                        "file": stored(path),
                        "labels": known["labels"],
                        "versions": known["versions"],
                        "states": states(path),
                        "decide_p99_s": float(np.quantile(decide, 0.99)),
                        "report_p99_s": float(np.quantile(report, 0.99)) if report else float("nan"),
                    }
                )
                decide, report = [], []
    return rows


def main() -> None:
    """Parse, run, print, write."""
    parser = options(__doc__, data="insertion", samples=None, recipe="conv", folder=None, out=Path("out"))
    parser.add_argument("--cycles", type=int, default=50_000, help="parts, one a cycle")
    parser.add_argument("--every", type=int, default=10_000, help="cycles between two marks")
    args = parser.parse_args()
    recipe, data = Recipe.load(args.recipe).with_policy(**POLICY), load_dataset(args.data, args.samples)
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        rows = endure(data, recipe, args.cycles, args.every, Path(folder) / "cell.db")
    write_csv(pd.DataFrame(rows), args.out / "benchmark_endurance.csv", force=True)
    heads = ("cycles", "time", "memory", "file", "labels", "versions", "with arrays", "decide, p99", "report, p99")
    table = Table(*heads, title="One cell on SQLite")
    for row in rows:
        counted = (f"{row[key]:,}" for key in ("labels", "versions", "states"))
        p99 = ("-" if np.isnan(row[key]) else duration(row[key]) for key in ("decide_p99_s", "report_p99_s"))
        known = (f"{row['cycles']:,}", duration(row["seconds"]), size(row["memory"]), size(row["file"]))
        table.add_row(*known, *counted, *p99)
    console, growth = Console(width=120), rows[-1]["memory"] / rows[0]["memory"] - 1.0
    console.print(table)
    said = "flat" if growth <= FLAT else "not flat"
    console.print(f"Memory after {rows[0]['cycles']:,} cycles to the end: {100 * growth:+.1f} %, {said}.", highlight=False)


if __name__ == "__main__":
    main()
