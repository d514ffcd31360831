"""One cell for a long time on SQLite: memory, file and versions must not grow without bound.

    python training/benchmark_endurance.py --cycles 50000 --out out/

An engine decides on bundled traces with fresh sensor noise and is told of every part that it verifies. After each 10,000
cycles the process's memory (RSS), the file with its log, and the versions in it are written down. Memory should be flat
after the first 10,000; the file grows by the traces, 4 kB each, and by the versions that its policy keeps.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from dengine import Action, DataEngine, Dataset, Recipe, load_dataset
from dengine.cli.output import duration, size

FLAT = 0.05  # growth of memory after the first mark that still counts as flat


def memory() -> int:
    """Bytes that the process holds in memory at present (Linux)."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")


def stored(path: Path) -> int:
    """Bytes of a SQLite file and of its log."""
    return sum(each.stat().st_size for each in path.parent.glob(f"{path.name}*"))


def states(engine: DataEngine) -> int:
    """Versions whose arrays the store still holds."""
    with engine.store._database.transaction(write=False) as connection:
        return int(connection.exec_driver_sql("SELECT count(state) FROM model_version").scalar_one())


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
                        "states": states(engine),
                        "decide_p99_s": float(np.quantile(decide, 0.99)),
                        "report_p99_s": float(np.quantile(report, 0.99)) if report else float("nan"),
                    }
                )
                decide, report = [], []
    return rows


def show(rows: list[dict[str, Any]], out: Path) -> None:
    """Table on the screen, CSV and picture in `out`."""
    out.mkdir(parents=True, exist_ok=True)
    frame = pd.DataFrame(rows)
    frame.to_csv(out / "benchmark_endurance.csv", index=False)
    heads = ("cycles", "time", "memory", "file", "labels", "versions", "with arrays", "decide, p99", "report, p99")
    table = Table(*heads, title="One cell on SQLite")
    for row in rows:
        counted = (f"{row[key]:,}" for key in ("labels", "versions", "states"))
        p99 = ("-" if np.isnan(row[key]) else duration(row[key]) for key in ("decide_p99_s", "report_p99_s"))
        known = (f"{row['cycles']:,}", duration(row["seconds"]), size(row["memory"]), size(row["file"]))
        table.add_row(*known, *counted, *p99)
    console = Console(width=120)
    console.print(table)
    growth = rows[-1]["memory"] / rows[0]["memory"] - 1.0
    said = "flat" if growth <= FLAT else "not flat"
    console.print(f"Memory after {rows[0]['cycles']:,} cycles to the end: {100 * growth:+.1f} %, {said}.", highlight=False)
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    axes.plot(frame["cycles"], frame["memory"] / 1e6, "o-", label="memory (MB)")
    axes.plot(frame["cycles"], frame["file"] / 1e6, "s--", label="file (MB)")
    axes.set(xlabel="cycles", ylabel="MB", ylim=(0, None), title="One cell on SQLite")
    axes.legend()
    figure.savefig(out / "benchmark_endurance.png", dpi=150)


def main() -> None:
    """Parse, run, show."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cycles", type=int, default=50_000, help="parts, one a cycle")
    parser.add_argument("--every", type=int, default=10_000, help="cycles between two marks")
    parser.add_argument("--recipe", default="conv", help="a recipe's name or TOML file, or module:Class")
    parser.add_argument("--data", default="insertion", help="a bundled set, or an .npz file with X and y")
    parser.add_argument("--samples", type=int, help="use the first so many samples of each trace; all by default")
    parser.add_argument("--folder", type=Path, help="where the file is made; a temporary one by default")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the CSV and the picture")
    args = parser.parse_args()
    recipe = Recipe.load(args.recipe).with_policy(alpha=0.1, lower_bound=0.9)
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        data = load_dataset(args.data, args.samples)
        show(endure(data, recipe, args.cycles, args.every, Path(folder) / "cell.db"), args.out)


if __name__ == "__main__":
    main()
