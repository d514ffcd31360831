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
from common import POLICY, noisy, options, quantiles, tell, wall_time

from dengine import Action, DataEngine, Dataset, Recipe, load_dataset

FLAT = 0.05  # growth of memory after the first mark that still counts as flat


def memory() -> int:
    """Bytes that the process holds in memory at present (Linux)."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")


def states(path: Path) -> int:
    """Versions whose arrays the store still holds."""
    with closing(sqlite3.connect(path)) as connection:
        return int(connection.execute("SELECT count(state) FROM model_version").fetchone()[0])


def endure(data: Dataset, recipe: Recipe, cycles: int, every: int, path: Path) -> list[dict[str, Any]]:
    """A row after each `every` cycles."""
    rng, rows = np.random.default_rng(0), list[dict[str, Any]]()
    taken: dict[str, list[float]] = {"decide": [], "report": []}
    with DataEngine.from_recipe(recipe, store=path) as engine:
        begin = time.perf_counter()
        for cycle in range(1, cycles + 1):
            (x,), (good,) = noisy(data, 1, rng)
            seconds, decision = wall_time(engine.decide, x)
            taken["decide"].append(seconds)
            if decision.action is Action.VERIFY:
                taken["report"].append(wall_time(engine.report, decision.id, bool(good))[0])
            if cycle % every == 0 or cycle == cycles:
                engine.flush()
                known, file = engine.store.status(), sum(each.stat().st_size for each in path.parent.glob(f"{path.name}*"))
                row = {"cycles": cycle, "time_s": time.perf_counter() - begin, "memory_bytes": memory(), "file_bytes": file}
                row |= {name: known[name] for name in ("labels", "versions")} | {"with_arrays": states(path)}
                rows.append(row | {f"{name},_p99_s": quantiles(each)["p99_s"] for name, each in taken.items()})
                taken = {name: [] for name in taken}
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
    tell(rows, "One cell on SQLite", args.out / "benchmark_endurance.csv")
    growth = rows[-1]["memory_bytes"] / rows[0]["memory_bytes"] - 1.0
    said = "flat" if growth <= FLAT else "not flat"
    print(f"Memory after {rows[0]['cycles']:,} cycles to the end: {100 * growth:+.1f} %, {said}.")


if __name__ == "__main__":
    main()
