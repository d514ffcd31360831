"""How large the store of a cell grows: a cell of a bundled set runs for some parts, and the bytes
of each table and its indexes are compared with those of the raw traces.

    python training/benchmark_store.py --parts 10000 --out store_size.csv

The traces of the set come again and again, in another order and with noise of 2 % of their spread,
each as a part of its own. What the engine asks to verify is reported.
"""

from __future__ import annotations

import argparse
import sqlite3
import tempfile
from contextlib import closing
from pathlib import Path

import numpy as np
import pandas as pd

from dengine import Action, DataEngine, Policy, SqlStore, load_dataset


def run_cell(file: Path, data: str, reducer: str, parts: int, seed: int) -> int:
    """Let a new cell decide on `parts` parts; return the bytes of their traces."""
    dataset = load_dataset(data)
    rng = np.random.default_rng(seed)
    noise = 0.02 * dataset.X.std()
    order = np.concatenate(
        [rng.permutation(len(dataset)) for _ in range(-(-parts // len(dataset)))]
    )
    n_bytes = 0
    policy = Policy(alpha=0.1, lower_bound=0.9)
    store = SqlStore(str(file), wait=60.0)  # a busy disk changes no figure
    with DataEngine(reducer, policy=policy, store=store) as engine:
        for number, i in enumerate(order[:parts]):
            trace = (dataset.X[i] + rng.normal(0.0, noise, dataset.X[i].shape)).astype(np.float32)
            decision = engine.decide(trace, part=number)
            if decision.action is Action.VERIFY:
                engine.report(decision.id, bool(dataset.y[i]))
            n_bytes += trace.nbytes
    return n_bytes


def read_sizes(file: Path, raw: int) -> pd.DataFrame:
    """Return the bytes of each table with its indexes, of free pages and of the file."""
    query = """
        SELECT schema.tbl_name AS part, sum(stat.pgsize) AS bytes
        FROM dbstat AS stat JOIN sqlite_master AS schema ON schema.name = stat.name
        GROUP BY schema.tbl_name ORDER BY bytes DESC
    """
    with closing(sqlite3.connect(file)) as connection:
        sizes = connection.execute(query).fetchall()
        page, free = (
            connection.execute(f"PRAGMA {name}").fetchone()[0]
            for name in ("page_size", "freelist_count")
        )
    rows = [*sizes, ("free pages", page * free), ("the file", file.stat().st_size)]
    frame = pd.DataFrame([*rows, ("raw traces", raw)], columns=["part", "bytes"])
    return frame.assign(times_raw=(frame["bytes"] / raw).round(3))


def main() -> None:
    """Run a cell, and print where the bytes of its store are."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--data", default="insertion")
    parser.add_argument("--reducer", default="conv")
    parser.add_argument("--parts", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="a CSV file of the table")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "engine.db"
        raw = run_cell(file, arguments.data, arguments.reducer, arguments.parts, arguments.seed)
        sizes = read_sizes(file, raw)
        with DataEngine.open(str(file), reading=True) as engine:
            versions = engine.store.versions.all()
    print(sizes.to_string(index=False))
    print(f"{len(versions)} retrains, {sum(version.kept for version in versions)} states")
    if arguments.out is not None:
        sizes.to_csv(arguments.out, index=False)


if __name__ == "__main__":
    main()
