"""Many cells on one database, or one for long: how fast they are, whether anything is lost, mixed, or grows without bound.

    python training/benchmark_fleet.py --cells 16 --minutes 5 --out out/
    python training/benchmark_fleet.py --cells 1 --cycles 50000 --out out/
    bash -c '. .ci/postgres.sh && python training/benchmark_fleet.py --pause 0.5 --faults --store "$DENGINE_TEST_POSTGRES"'

The last line starts a throw-away PostgreSQL server; without --store the database is a SQLite file. Each cell is a
process with an engine of its own. Every trace carries its cell and its cycle in its first samples, and every label that
was acknowledged is remembered. Afterwards all of it is read back: labels sent and stored, traces that stand in another
cell's rows, and traces of another product among those that an engine learned from. At each fifth of the time, or of the
cycles, a cell notes its memory (RSS), its SQLite file, that one's write-ahead log and the cell's journal: memory should be
flat once the window of labels is full (--window 2000: soon), log and journal bounded; the file grows by the traces, 4 kB
each, and the versions that are kept.
--faults freezes the server's processes for 20 s after a quarter of the time, and kills and restarts it after a half; that
is for the user who runs the server, or root.
"""

import multiprocessing
import os
import shlex
import signal
import subprocess
import tempfile
import threading
import time
import uuid
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import sqlalchemy as sa
from common import POLICY, noisy, options, print_table, quantiles, wall_time

from dengine import Action, DataEngine, Dataset, Recipe, RetrainReport, SqlStore, load_dataset
from dengine.engine.engine import core_of
from dengine.errors import NotTakenError
from dengine.experiments.tables import write_csv
from dengine.store.journal import journal_path

STEP = 1.0 / 16.0  # N a digit of a mark: exact in float32, and small beside an insertion
DIGITS = 5  # of a mark: the cell, and the cycle in base 100
MARKS = 5  # looks at a cell's memory
FROZEN, DOWN = 20.0, 10.0  # seconds that the server is
BACK = 120.0  # seconds within which all is to be stored at the end
READY: Any = None  # of a cell's process: the barrier at which all begin
Worked = dict[str, Any]


@dataclass(frozen=True)
class Plan:
    """What every cell is told.

    seconds : of running.  cycles : in the place of these, where there are any.  pause : seconds between two cycles.
    products : 0: nobody shares.
    """

    url: str
    tag: str
    cells: int
    seconds: float
    cycles: int
    pause: float
    products: int
    recipe: Recipe

    def product(self, cell: int) -> str | None:
        """What a cell makes."""
        return f"product-{cell % self.products}-{self.tag}" if self.products else None

    def store(self, cell: int) -> SqlStore:
        """A cell's rows."""
        return SqlStore(self.url, f"cell-{cell}-{self.tag}", product=self.product(cell))


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


def grown(plan: Plan, cell: int, begin: float, cycles: int) -> dict[str, Any]:
    """What a cell's process holds in memory at present (Linux), and its files."""
    memory = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf(
        "SC_PAGE_SIZE"
    )
    url = sa.make_url(plan.url if "://" in plan.url else f"sqlite:///{plan.url}")
    journal = journal_path(url, f"cell-{cell}-{plan.tag}")
    named = {"memory": memory} | {
        name: file.stat().st_size if file.is_file() else 0
        for name, file in (
            ("file", Path(plan.url)),
            ("log", Path(f"{plan.url}-wal")),
            ("journal", journal),
        )
    }
    took = time.perf_counter() - begin
    return {"time_s": took, "cycles": cycles} | {
        f"{name}_bytes": size for name, size in named.items()
    }


def told(engine: DataEngine, decision_id: str, good: bool) -> RetrainReport | None:
    """Report a label, and say the same again where it is not known to be taken: the disk is shared."""
    while True:
        with suppress(NotTakenError):
            return engine.report(decision_id, good)


def work(plan: Plan, data: Dataset, cell: int) -> Worked:
    """One cell, in a process of its own, on marked bundled traces with fresh sensor noise.

    sent : by decision, its cycle and the label that was acknowledged.  others : traces of other products among the learned.
    marks : of `grown`.
    """
    marks: list[dict[str, Any]] = []
    rng, sent, seconds, certain = (
        np.random.default_rng(cell),
        {},
        defaultdict[str, list[float]](list),
        0,
    )
    with DataEngine.open_or_create(plan.store(cell), recipe=plan.recipe) as engine:
        READY.wait()
        begin = time.perf_counter()
        for cycle in count():
            done = (
                cycle / plan.cycles if plan.cycles else (time.perf_counter() - begin) / plan.seconds
            )
            if done >= (len(marks) + 1) / MARKS:
                marks.append(grown(plan, cell, begin, cycle))
                if len(marks) == MARKS:
                    break
            X, y = noisy(data, 1, rng)
            took, decision = wall_time(engine.decide, mark(X[0, 0], cell, cycle))
            seconds["decide"].append(took)
            certain += decision.action is not Action.VERIFY
            if decision.action is Action.VERIFY:
                took, retrain = wall_time(told, engine, decision.id, bool(y[0]))
                seconds["report" if retrain is None else "report that retrains"].append(took)
                sent[decision.id] = cycle, bool(y[0])
            seconds["settle, with news of peers"].append(
                wall_time(core_of(engine).process_retrains)[0]
            )
            time.sleep(plan.pause)
        until = time.monotonic() + BACK
        engine.flush()
        while core_of(engine).store_fault and time.monotonic() < until:
            time.sleep(0.1)
            engine.flush()
        seen = engine.store.labelled().traces if plan.products else ()
        others = sum(plan.product(read_mark(x)[0]) != plan.product(cell) for x in seen)
        about = {"cell": cell, "version": engine.version, "certain": certain}
    return about | {"sent": sent, "seconds": seconds, "others": others, "marks": marks}


def break_server(url: str, seconds: float) -> None:
    """Freeze a PostgreSQL server for a while, go on, then kill it and start it anew."""
    engine = sa.create_engine(url)
    with engine.connect() as connection:
        folder = Path(connection.execute(sa.text("SHOW data_directory")).scalar_one())
    engine.dispose()
    pid = folder / "postmaster.pid"
    first, command = (
        pid.read_text().split()[0],
        shlex.split((folder / "postmaster.opts").read_text()),
    )
    steps = (
        (seconds / 4, signal.SIGSTOP),
        (FROZEN, signal.SIGCONT),
        (seconds / 4 - FROZEN, signal.SIGKILL),
    )
    for pause, number in steps:
        time.sleep(pause)
        processes = [first, *Path(f"/proc/{first}/task/{first}/children").read_text().split()]
        print(f"{number.name} to the {len(processes)} processes of the server", flush=True)
        for process in processes:
            os.kill(int(process), number)
    time.sleep(DOWN)
    pid.unlink(missing_ok=True)
    owner = ["runuser", "-u", folder.owner(), "--"] if os.getuid() != folder.stat().st_uid else []
    subprocess.Popen(
        [*owner, *command], cwd=folder.parent, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    print("started again", flush=True)


def _share(ready: Any) -> None:
    global READY
    READY = ready


def run(plan: Plan, data: Dataset) -> list[Worked]:
    """All cells at once."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(plan.cells, context, _share, (context.Barrier(plan.cells),)) as pool:
        return list(pool.map(partial(work, plan, data), range(plan.cells)))


def check(plan: Plan, worked: Worked) -> dict[str, Any]:
    """A cell's rows against what it was told."""
    sent, cell, lost, wrong, mixed = worked["sent"], worked["cell"], 0, 0, worked["others"]
    with plan.store(cell) as store:
        stored = store.status()["labels"]
        for id_, (cycle, good) in sent.items():
            known = store.get_decision(id_)
            lost += known is None or known.success is None
            wrong += known is not None and known.success is (not good)
            mixed += known is not None and read_mark(known.trace) != (cell, cycle)
        mixed += sum(read_mark(x)[0] != cell for x in store.labelled(cell_only=True).traces)
    about = {name: worked[name] for name in ("cell", "version", "certain")} | {"sent": len(sent)}
    return about | {"stored": stored, "lost": lost, "wrong": wrong, "mixed": mixed}


def show(plan: Plan, worked: list[Worked], out: Path) -> bool:
    """Tables on the screen and as CSV; whether nothing was lost, wrong or mixed."""
    kind, taken = (
        "PostgreSQL" if plan.url.startswith("postgres") else "SQLite",
        defaultdict[str, list[float]](list),
    )
    for each in worked:
        for name, seconds in each["seconds"].items():
            taken[name] += seconds
    rows = [{"call": name, **quantiles(seconds)} for name, seconds in taken.items()]
    took = max(each["marks"][-1]["time_s"] for each in worked)
    print_table(
        rows, f"{plan.cells} cells on one {kind}, {took:.0f} s", out / "benchmark_fleet.csv"
    )
    print_table(worked[0]["marks"], "How the first cell grows", out / "benchmark_fleet_growth.csv")
    counted = pd.DataFrame([check(plan, each) for each in worked])
    write_csv(counted, out / "benchmark_fleet_cells.csv", force=True)
    total = counted.sum()
    print(
        f"{rows[0]['n'] / took:.0f} decisions a second. Labels sent {total.sent:,}, stored {total.stored:,}, lost "
        f"{total.lost}, wrong {total.wrong}; traces mixed {total.mixed}. Versions {', '.join(map(str, counted.version))}."
    )
    return bool(total.sent == total.stored and not (total.lost or total.wrong or total.mixed))


def main() -> None:
    """Parse, run, check, show."""
    parser = options(__doc__, data="insertion", samples=None, recipe="pca", out=Path("out"))
    parser.add_argument(
        "--cells", type=int, default=16, help="processes, each with an engine of its own"
    )
    parser.add_argument(
        "--minutes", type=float, default=5.0, help="of running, once all engines are open"
    )
    parser.add_argument(
        "--cycles", type=int, default=0, help="so many of each cell, in the place of minutes"
    )
    parser.add_argument(
        "--faults", action="store_true", help="freeze the PostgreSQL server, and kill it"
    )
    parser.add_argument(
        "--store", help="a PostgreSQL or SQLite URL, or a file; a temporary SQLite file by default"
    )
    parser.add_argument(
        "--products",
        type=int,
        default=2,
        help="so many among the cells; 0: no cell shares anything",
    )
    parser.add_argument(
        "--window", type=int, default=10_000, help="labels that a cell holds in memory"
    )
    parser.add_argument(
        "--pause", type=float, default=0.0, help="seconds between two cycles of a cell"
    )
    args = parser.parse_args()
    recipe = replace(Recipe.load(args.recipe).with_policy(**POLICY), window=args.window)
    data = load_dataset(args.data, args.samples)
    with tempfile.TemporaryDirectory() as folder:
        url = args.store or str(Path(folder) / "fleet.db")
        how = args.cells, 60.0 * args.minutes, args.cycles, args.pause, args.products
        plan = Plan(url, uuid.uuid4().hex[:8], *how, recipe)
        if args.faults:
            threading.Thread(target=break_server, args=(url, plan.seconds), daemon=True).start()
        if not show(plan, run(plan, data), args.out):
            raise SystemExit("Labels were lost, wrong or mixed.")


if __name__ == "__main__":
    main()
