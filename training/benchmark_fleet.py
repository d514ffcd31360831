"""Measure many cells on one database, or one cell for a long time.

    python training/benchmark_fleet.py --cells 16 --minutes 5 --out out/
    python training/benchmark_fleet.py --cells 1 --cycles 50000 --out out/

and, with a throw-away PostgreSQL server:

    . .ci/postgres.sh
    python training/benchmark_fleet.py --pause 0.5 --faults --store "$DENGINE_TEST_POSTGRES"

Without --store the database is a SQLite file. Each cell is a process with its own engine. It writes
its number and the cycle into the first samples of every trace, and remembers every label that was
acknowledged. At the end everything is read back. The script counts labels that were lost or are
wrong, traces in another cell's rows, and traces of another product among those that an engine
learned from.

At each fifth of the run a cell measures its memory (RSS), its SQLite file, the write-ahead log and
the cell's journal. Memory should stay the same once the window of labels is full (soon, with
--window 2000), and log and journal should stay small. The file grows by 4 kB per trace and by the
model versions that are kept.

--faults freezes the server's processes for 20 s after a quarter of the time, and kills and restarts
the server after a half. This needs the user who runs the server, or root.
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
from dengine.errors import NotTakenError
from dengine.experiments.tables import write_csv
from dengine.store.journal import journal_path

MARK_STEP_N = 1.0 / 16.0  # force per unit of a digit: exact in float32, small beside an insertion
N_DIGITS = 5  # of a mark: the cell, and the cycle in base 100
N_MEASUREMENTS = 5  # of a cell's memory and files
FROZEN_SECONDS = 20.0
DOWN_SECONDS = 10.0
STORED_WITHIN_SECONDS = 120.0  # the end of a run waits so long for an unavailable store
START_BARRIER: Any = None  # of a cell's process: all cells begin together
Times = defaultdict[str, list[float]]  # name of a call -> its wall times in seconds


@dataclass(frozen=True)
class Plan:
    """What the cells do.

    Parameters
    ----------
    url : str
        Of the database, or the path of a SQLite file.
    tag : str
        Part of the names of cells and products, so that runs on one database do not mix.
    cells : int
    seconds : float
        How long they run.
    cycles : int
        How many cycles they run, instead of seconds; 0: run for seconds.
    pause : float
        Seconds between two cycles.
    products : int
        Number of products, which the cells make in turn; 0: no cell shares anything.
    recipe : Recipe
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
        """Return the product that a cell makes, None if the cells share nothing."""
        return f"product-{cell % self.products}-{self.tag}" if self.products else None

    def store(self, cell: int) -> SqlStore:
        """Open the store with a cell's rows."""
        return SqlStore(self.url, f"cell-{cell}-{self.tag}", product=self.product(cell))

    def done_share(self, cycle: int, seconds: float) -> float:
        """Return which share of the run is done, from 0 to 1."""
        return cycle / self.cycles if self.cycles else seconds / self.seconds


@dataclass(frozen=True)
class CellRun:
    """What a cell remembers of its run.

    Attributes
    ----------
    cell : int
    version : int
        Of its model at the end.
    certain : int
        Decisions without a check.
    sent : dict
        Decision id -> its cycle and the label that was acknowledged.
    seconds : Times
    n_foreign : int
        Traces of another product among those that the engine learned from.
    measurements : list of dict
        As `measure_growth` returns them.
    """

    cell: int
    version: int
    certain: int
    sent: dict[str, tuple[int, bool]]
    seconds: Times
    n_foreign: int
    measurements: list[dict[str, Any]]


def mark_trace(trace: np.ndarray, cell: int, cycle: int) -> np.ndarray:
    """Return a copy of a trace (T,), float32, with the cell and the cycle in its first samples."""
    digits = [cell, *(cycle // 100**power % 100 for power in range(N_DIGITS - 1))]
    marked = trace.astype(np.float32, copy=True)
    marked[:N_DIGITS] = np.array(digits, dtype=np.float32) * MARK_STEP_N
    return marked


def read_mark(trace: np.ndarray) -> tuple[int, int]:
    """Return the cell and the cycle that a trace (C, T) was marked with."""
    cell, *digits = (int(value) for value in np.rint(trace[0, :N_DIGITS] / MARK_STEP_N))
    return cell, sum(digit * 100**power for power, digit in enumerate(digits))


def measure_growth(plan: Plan, cell: int, seconds: float, cycles: int) -> dict[str, Any]:
    """Measure the memory of this process (Linux) and the sizes of the cell's files.

    Returns
    -------
    row : dict
        time_s, cycles, memory_bytes, file_bytes, log_bytes and journal_bytes; 0 without a file.
    """
    resident_pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    url = sa.make_url(plan.url if "://" in plan.url else f"sqlite:///{plan.url}")
    files = {
        "file": Path(plan.url),
        "log": Path(f"{plan.url}-wal"),
        "journal": journal_path(url, f"cell-{cell}-{plan.tag}"),
    }
    row: dict[str, Any] = {"time_s": seconds, "cycles": cycles}
    row["memory_bytes"] = resident_pages * os.sysconf("SC_PAGE_SIZE")
    for name, path in files.items():
        row[f"{name}_bytes"] = path.stat().st_size if path.is_file() else 0
    return row


def report_until_taken(engine: DataEngine, decision_id: str, good: bool) -> RetrainReport | None:
    """Report a label until it is acknowledged, because the disk is shared; return the retrain."""
    while True:
        with suppress(NotTakenError):
            return engine.report(decision_id, good)


def run_cell(plan: Plan, data: Dataset, cell: int) -> dict[str, Any]:
    """Run one cell, in its own process, on marked traces of the data set with fresh noise.

    Returns the fields of its `CellRun`: a class of a script may not be found by another process.
    """
    rng = np.random.default_rng(cell)
    measurements: list[dict[str, Any]] = []
    sent: dict[str, tuple[int, bool]] = {}
    seconds = Times(list)
    certain = 0
    with DataEngine.open_or_create(plan.store(cell), recipe=plan.recipe) as engine:
        START_BARRIER.wait()
        begin = time.perf_counter()
        for cycle in count():
            elapsed = time.perf_counter() - begin
            if plan.done_share(cycle, elapsed) >= (len(measurements) + 1) / N_MEASUREMENTS:
                measurements.append(measure_growth(plan, cell, elapsed, cycle))
                if len(measurements) == N_MEASUREMENTS:
                    break
            X, y = noisy(data, 1, rng)
            good = bool(y[0])
            duration, decision = wall_time(engine.decide, mark_trace(X[0, 0], cell, cycle))
            seconds["decide"].append(duration)
            if decision.action is Action.VERIFY:
                duration, retrain = wall_time(report_until_taken, engine, decision.id, good)
                seconds["report" if retrain is None else "report that retrains"].append(duration)
                sent[decision.id] = (cycle, good)
            else:
                certain += 1
            duration, _ = wall_time(engine.poll)
            seconds["settle, with news of peers"].append(duration)
            time.sleep(plan.pause)
        flush_within(engine, STORED_WITHIN_SECONDS)
        n_foreign = 0
        if plan.products:
            learned = engine.store.labels.with_traces().traces
            products = [plan.product(read_mark(trace)[0]) for trace in learned]
            n_foreign = sum(product != plan.product(cell) for product in products)
        return {
            "cell": cell,
            "version": engine.version,
            "certain": certain,
            "sent": sent,
            "seconds": seconds,
            "n_foreign": n_foreign,
            "measurements": measurements,
        }


def flush_within(engine: DataEngine, seconds: float) -> None:
    """Flush the engine; try again while its store is unavailable, at most for these seconds.

    Returns also if the store is still unavailable at the end.
    """
    deadline = time.monotonic() + seconds
    engine.flush()
    while engine.state.store_fault and time.monotonic() < deadline:
        time.sleep(0.1)
        engine.flush()


def break_server(url: str, seconds: float) -> None:
    """Freeze a PostgreSQL server for a while, continue it, then kill it and start it again.

    Prints each step, and returns when the server is started.

    Parameters
    ----------
    url : str
        Of the server.
    seconds : float
        Length of the whole run: it is frozen after a quarter and killed after a half.
    """
    engine = sa.create_engine(url)
    with engine.connect() as connection:
        folder = Path(connection.execute(sa.text("SHOW data_directory")).scalar_one())
    engine.dispose()
    pid_file = folder / "postmaster.pid"
    first_pid = pid_file.read_text().split()[0]
    command = shlex.split((folder / "postmaster.opts").read_text())
    steps = (
        (seconds / 4, signal.SIGSTOP),
        (FROZEN_SECONDS, signal.SIGCONT),
        (seconds / 4 - FROZEN_SECONDS, signal.SIGKILL),
    )
    for pause, signal_number in steps:
        time.sleep(pause)
        children = Path(f"/proc/{first_pid}/task/{first_pid}/children").read_text().split()
        pids = [first_pid, *children]
        print(f"{signal_number.name} to the {len(pids)} processes of the server", flush=True)
        for pid in pids:
            os.kill(int(pid), signal_number)
    time.sleep(DOWN_SECONDS)
    pid_file.unlink(missing_ok=True)
    is_owner = os.getuid() == folder.stat().st_uid
    as_owner = [] if is_owner else ["runuser", "-u", folder.owner(), "--"]
    subprocess.Popen(
        [*as_owner, *command],
        cwd=folder.parent,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    print("started again", flush=True)


def _share_barrier(barrier: Any) -> None:
    """Give a cell's process the barrier at which all cells begin."""
    global START_BARRIER
    START_BARRIER = barrier


def run_cells(plan: Plan, data: Dataset) -> list[CellRun]:
    """Run all cells at once, each in a process, and return what they remember."""
    context = multiprocessing.get_context("spawn")
    barrier = context.Barrier(plan.cells)
    with ProcessPoolExecutor(plan.cells, context, _share_barrier, (barrier,)) as pool:
        runs = pool.map(partial(run_cell, plan, data), range(plan.cells))
        return [CellRun(**fields) for fields in runs]


def check_rows(plan: Plan, run: CellRun) -> dict[str, Any]:
    """Compare a cell's rows in the store with what the cell remembers.

    Returns
    -------
    row : dict
        cell, version, certain, and counts: labels sent, stored, lost (not in the store) and wrong,
        and mixed, the traces that belong to another cell or product.
    """
    lost = 0
    wrong = 0
    mixed = run.n_foreign
    with plan.store(run.cell) as store:
        stored = store.decisions.counts()["labels"]
        for decision_id, (cycle, good) in run.sent.items():
            record = store.decisions.get(decision_id)
            if record is None:
                lost += 1
                continue
            lost += record.success is None
            wrong += record.success is (not good)
            mixed += read_mark(record.trace) != (run.cell, cycle)
        learned = store.labels.with_traces(cell_only=True).traces
        mixed += sum(read_mark(trace)[0] != run.cell for trace in learned)
    return {
        "cell": run.cell,
        "version": run.version,
        "certain": run.certain,
        "sent": len(run.sent),
        "stored": stored,
        "lost": lost,
        "wrong": wrong,
        "mixed": mixed,
    }


def show_results(plan: Plan, runs: list[CellRun], out: Path) -> bool:
    """Print tables, write them as CSV, over earlier files, and return whether all is well.

    That is so if the store has as many labels as were sent, and none is lost, wrong or mixed.
    """
    seconds = Times(list)
    for run in runs:
        for name, durations in run.seconds.items():
            seconds[name] += durations
    rows = [{"call": name, **quantiles(durations)} for name, durations in seconds.items()]
    run_seconds = max(run.measurements[-1]["time_s"] for run in runs)
    database = "PostgreSQL" if plan.url.startswith("postgres") else "SQLite"
    title = f"{plan.cells} cells on one {database}, {run_seconds:.0f} s"
    print_table(rows, title, out / "benchmark_fleet.csv")
    growth = runs[0].measurements
    print_table(growth, "How the first cell grows", out / "benchmark_fleet_growth.csv")
    cells = pd.DataFrame([check_rows(plan, run) for run in runs])
    write_csv(cells, out / "benchmark_fleet_cells.csv", force=True)
    total = cells.sum()
    versions = ", ".join(map(str, cells.version))
    print(
        f"{rows[0]['n'] / run_seconds:.0f} decisions a second. "
        f"Labels sent {total.sent:,}, stored {total.stored:,}, lost {total.lost}, "
        f"wrong {total.wrong}; traces mixed {total.mixed}. Versions {versions}."
    )
    return bool(total.sent == total.stored and not (total.lost or total.wrong or total.mixed))


def main() -> None:
    """Run the cells, check their rows, print and write the tables; exit with 1 at a fault."""
    parser = options(__doc__, data="insertion", samples=None, recipe="pca", out=Path("out"))
    parser.add_argument("--cells", type=int, default=16, help="processes with an engine each")
    parser.add_argument(
        "--minutes", type=float, default=5.0, help="how long they run, once all engines are open"
    )
    parser.add_argument(
        "--cycles", type=int, default=0, help="cycles of each cell, instead of minutes"
    )
    parser.add_argument(
        "--faults", action="store_true", help="freeze and kill the PostgreSQL server"
    )
    parser.add_argument(
        "--store", help="a PostgreSQL or SQLite URL, or a file; a temporary SQLite file by default"
    )
    parser.add_argument(
        "--products", type=int, default=2, help="among the cells; 0: no cell shares anything"
    )
    parser.add_argument(
        "--window", type=int, default=10_000, help="labels that a cell holds in memory"
    )
    parser.add_argument(
        "--pause", type=float, default=0.0, help="seconds between two cycles of a cell"
    )
    arguments = parser.parse_args()
    recipe = Recipe.load(arguments.recipe).with_policy(**POLICY)
    data = load_dataset(arguments.data, samples=arguments.samples)
    with tempfile.TemporaryDirectory() as folder:
        plan = Plan(
            url=arguments.store or str(Path(folder) / "fleet.db"),
            tag=uuid.uuid4().hex[:8],
            cells=arguments.cells,
            seconds=60.0 * arguments.minutes,
            cycles=arguments.cycles,
            pause=arguments.pause,
            products=arguments.products,
            recipe=replace(recipe, window=arguments.window),
        )
        if arguments.faults:
            faults = threading.Thread(
                target=break_server, args=(plan.url, plan.seconds), daemon=True
            )
            faults.start()
        if not show_results(plan, run_cells(plan, data), arguments.out):
            raise SystemExit("Labels were lost, wrong or mixed.")


if __name__ == "__main__":
    main()
