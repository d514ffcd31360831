"""Many cells on one database: how fast they decide and report, and whether anything is lost or mixed.

    python training/benchmark_fleet.py --cells 16 --minutes 5 --out out/
    bash -c '. .ci/postgres.sh && python training/benchmark_fleet.py --store "$DENGINE_TEST_POSTGRES"'

The second line starts a throw-away PostgreSQL server; without --store the database is a SQLite file. Each cell is a
process with an engine of its own. Every trace carries its cell and its cycle in its first samples, and every label that
was acknowledged is remembered. Afterwards all of it is read back: labels sent and stored, traces that stand in another
cell's rows, and traces of another product among those that an engine learned from.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import time
import uuid
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from common import POLICY, noisy, options, quantiles, tell, wall_time

from dengine import Action, DataEngine, Dataset, Recipe, SqlStore, load_dataset
from dengine.experiments.tables import write_csv

STEP = 1.0 / 16.0  # N a digit of a mark: exact in float32, and small beside an insertion
DIGITS = 5  # of a mark: the cell, and the cycle in base 100
CALLS = ("decide", "report", "report that retrains", "settle, with news of peers")


@dataclass(frozen=True)
class Plan:
    """What every cell is told. seconds : of running.  pause : seconds between two cycles.  products : 0: nobody shares."""

    url: str
    tag: str
    cells: int
    seconds: float
    pause: float
    products: int
    recipe: Recipe

    def product(self, cell: int) -> str | None:
        """What a cell makes."""
        return f"product-{cell % self.products}-{self.tag}" if self.products else None

    def store(self, cell: int) -> SqlStore:
        """A cell's rows."""
        return SqlStore(self.url, f"cell-{cell}-{self.tag}", product=self.product(cell))


@dataclass
class Worked:
    """What a cell did. sent : by decision, its cycle and the label that was acknowledged; others' are mixed traces."""

    cell: int
    sent: dict[str, tuple[int, bool]] = field(default_factory=dict)
    seconds: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in CALLS})
    certain: int = 0
    version: int = 0
    others: int = 0


def mark(x: np.ndarray, cell: int, cycle: int) -> np.ndarray:
    """A trace (T,) that says whose it is."""
    digits = [cell, *(cycle // 100**power % 100 for power in range(DIGITS - 1))]
    x = x.astype(np.float32, copy=True)
    x[:DIGITS] = np.array(digits, dtype=np.float32) * STEP
    return x


def read_mark(x: np.ndarray) -> tuple[int, int]:
    """(cell, cycle) of a trace (C, T)."""
    cell, *digits = (int(value) for value in np.rint(x[0, :DIGITS] / STEP))
    return cell, sum(digit * 100**power for power, digit in enumerate(digits))


def stream(data: Dataset, cell: int) -> Iterator[tuple[int, np.ndarray, bool]]:
    """Cycle, marked trace and truth, for ever: bundled traces with fresh sensor noise."""
    rng = np.random.default_rng(cell)
    for cycle in count():
        X, y = noisy(data, 1, rng)
        yield cycle, mark(X[0, 0], cell, cycle), bool(y[0])


def work(plan: Plan, cell: int, data: Dataset, ready: Any, done: Any) -> None:
    """One cell, in a process of its own."""
    worked = Worked(cell)
    with DataEngine.open_or_create(plan.store(cell), recipe=plan.recipe) as engine:
        ready.wait()
        end = time.perf_counter() + plan.seconds
        for cycle, x, good in stream(data, cell):
            if time.perf_counter() >= end:
                break
            one_cycle(engine, worked, cycle, x, good)
            time.sleep(plan.pause)
        engine.flush()
        worked.version = engine.version
        seen = engine.store.labelled().traces
        worked.others = sum(plan.product(read_mark(x)[0]) != plan.product(cell) for x in seen) if plan.products else 0
    done.put(asdict(worked))  # plain: who reads it may have been started in another way


def one_cycle(engine: DataEngine, worked: Worked, cycle: int, x: np.ndarray, good: bool) -> None:
    """Decide, report, settle; each timed."""
    took, decision = wall_time(engine.decide, x)
    worked.seconds["decide"].append(took)
    worked.certain += decision.action is not Action.VERIFY
    if decision.action is Action.VERIFY:
        took, retrain = wall_time(engine.report, decision.id, good)
        worked.seconds["report" if retrain is None else "report that retrains"].append(took)
        worked.sent[decision.id] = cycle, good
    worked.seconds["settle, with news of peers"].append(wall_time(engine.settle)[0])


def run(plan: Plan, data: Dataset) -> list[Worked]:
    """All cells at once."""
    context = multiprocessing.get_context("spawn")
    ready, done = context.Barrier(plan.cells), context.Queue()
    given = [(plan, cell, data, ready, done) for cell in range(plan.cells)]
    processes = [context.Process(target=work, args=each, daemon=True) for each in given]
    for process in processes:
        process.start()
    worked = []
    while len(worked) < plan.cells:
        if any(process.exitcode for process in processes):
            raise SystemExit("A cell ended before its time; see above.")
        if not done.empty():
            worked.append(Worked(**done.get()))
        time.sleep(0.05)
    for process in processes:
        process.join()
    return sorted(worked, key=lambda each: each.cell)


def check(plan: Plan, worked: Worked) -> dict[str, Any]:
    """A cell's rows against what it was told."""
    lost = wrong = mixed = 0
    with plan.store(worked.cell) as store:
        stored = store.status()["labels"]
        for id_, (cycle, good) in worked.sent.items():
            known = store.get_decision(id_)
            lost += known is None or known.success is None
            wrong += known is not None and known.success is not None and known.success != good
            mixed += known is not None and read_mark(known.trace) != (worked.cell, cycle)
        mixed += sum(read_mark(x)[0] != worked.cell for x in store.labelled(own=True).traces)
    about = {"cell": worked.cell, "version": worked.version, "certain": worked.certain, "sent": len(worked.sent)}
    return about | {"stored": stored, "lost": lost, "wrong": wrong, "mixed": mixed + worked.others}


def show(plan: Plan, worked: list[Worked], out: Path) -> bool:
    """Tables on the screen and as CSV; whether nothing was lost, wrong or mixed."""
    kind, taken = "PostgreSQL" if plan.url.startswith("postgres") else "SQLite", {name: list[float]() for name in CALLS}
    for each in worked:
        for name, seconds in each.seconds.items():
            taken[name] += seconds
    rows = [{"call": name, **quantiles(seconds)} for name, seconds in taken.items()]
    tell(rows, f"{plan.cells} cells on one {kind}, {plan.seconds:g} s", out / "benchmark_fleet.csv")
    counted = pd.DataFrame([check(plan, each) for each in worked])
    write_csv(counted, out / "benchmark_fleet_cells.csv", force=True)
    total = counted.sum()
    print(
        f"{rows[0]['n'] / plan.seconds:.0f} decisions a second. Labels sent {total.sent:,}, stored {total.stored:,}, lost "
        f"{total.lost}, wrong {total.wrong}; traces mixed {total.mixed}. Versions {', '.join(map(str, counted.version))}."
    )
    return bool(total.sent == total.stored and not (total.lost or total.wrong or total.mixed))


def main() -> None:
    """Parse, run, check, show."""
    parser = options(__doc__, data="insertion", samples=None, recipe="pca", out=Path("out"))
    parser.add_argument("--cells", type=int, default=16, help="processes, each with an engine of its own")
    parser.add_argument("--minutes", type=float, default=5.0, help="of running, once all engines are open")
    parser.add_argument("--store", help="a PostgreSQL or SQLite URL, or a file; a temporary SQLite file by default")
    parser.add_argument("--products", type=int, default=2, help="so many among the cells; 0: no cell shares anything")
    parser.add_argument("--pause", type=float, default=0.0, help="seconds between two cycles of a cell")
    args = parser.parse_args()
    recipe, data = Recipe.load(args.recipe).with_policy(**POLICY), load_dataset(args.data, args.samples)
    with tempfile.TemporaryDirectory() as folder:
        url = args.store or str(Path(folder) / "fleet.db")
        how = args.cells, 60.0 * args.minutes, args.pause, args.products
        plan = Plan(url, uuid.uuid4().hex[:8], *how, recipe)
        if not show(plan, run(plan, data), args.out):
            raise SystemExit("Labels were lost, wrong or mixed.")


if __name__ == "__main__":
    main()
