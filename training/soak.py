"""Run a served cell for 50,000 cycles: does its memory stay flat, and is every label kept?

    python training/soak.py --out out                  # some 25 minutes on two idle cores
    python training/soak.py --cycles 5000 --window 1000

Starts `dengine serve` with a SQLite store and retrains in a process of its own, and plays a robot:
each trace is a recorded one with fresh noise, each part that the engine verifies is reported, and
so is each bad part that it accepted (a line stop). Audits bring further labels, so that the window
is full before the end. Meanwhile the page is asked for as a browser would. At the end the store is
opened again and compared with what was acknowledged. Writes OUT/soak.csv, one row per stretch of
cycles, and prints the totals.
"""

import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from benchmark_serve import Connection, Server
from common import POLICY, noisy, options, print_table, quantiles, wall_time

from dengine import Dataset, Recipe, load_dataset, open_store

BUDGET = 0.45  # seconds of a retrain
PATIENCE = 60.0  # seconds for which a request is repeated


@dataclass
class Stretch:
    """What was measured during some consecutive cycles; times in seconds."""

    decide: list[float] = field(default_factory=list)
    report: list[float] = field(default_factory=list)
    page: list[float] = field(default_factory=list)
    actions: dict[str, int] = field(default_factory=lambda: {"accept": 0, "reject": 0, "verify": 0})
    line_stops: int = 0
    repeated: int = 0  # requests that were sent again, because the disk did not answer in time

    def row(self, cycle: int, labels: int, memory: dict[str, int]) -> dict[str, Any]:
        """Return a row of the table: cycle is the last one, labels those acknowledged so far."""
        decide = quantiles(self.decide)
        report = quantiles(self.report)
        page = quantiles(self.page)
        return {
            "cycle": cycle,
            "labels": labels,
            **self.actions,
            "line_stops": self.line_stops,
            "repeated": self.repeated,
            "decide_p50_s": decide["p50_s"],
            "decide_p99_s": decide["p99_s"],
            "decide_worst_s": decide["worst_s"],
            "report_p99_s": report["p99_s"],
            "page_worst_s": page["worst_s"],
            **memory,
        }


def resident_memory(process: int) -> dict[str, int]:
    """Return the resident memory in bytes: of a process, and of all its descendants together.

    The keys are `server_bytes` and `trainer_bytes`.
    Memory that processes share is counted once in each of them.
    """
    parents: dict[int, int] = {}
    resident: dict[int, int] = {}
    for path in Path("/proc").glob("[0-9]*/status"):
        try:
            lines = path.read_text().splitlines()
        except OSError:  # it ended meanwhile
            continue
        fields = dict(line.split(":", 1) for line in lines if ":" in line)
        number = int(path.parent.name)
        parents[number] = int(fields["PPid"])
        resident[number] = 1024 * int(fields.get("VmRSS", "0 kB").split()[0])
    children = 0
    for number in parents:
        ancestor = parents[number]
        while ancestor in parents and ancestor != process:
            ancestor = parents[ancestor]
        if ancestor == process:
            children += resident[number]
    return {"server_bytes": resident[process], "trainer_bytes": children}


class Soak:
    """A robot that works at a served cell, and counts what it was told.

    Parameters
    ----------
    server : Server
        The cell.
    data : Dataset
        Recorded traces with labels.
    pace : float
        Seconds between two cycles.
    every : int
        Cycles of a stretch, after which the memory is read.
    """

    def __init__(self, server: Server, data: Dataset, pace: float, every: int) -> None:
        self.server = server
        self.data = data
        self.pace = pace
        self.every = every
        self.web = Connection(server.port)
        self.acknowledged: dict[str, bool] = {}  # label by decision id
        self.rows: list[dict[str, Any]] = []

    def run(self, cycles: int) -> None:
        """Play the cycles; append a row per stretch and print it on standard error."""
        rng = np.random.default_rng(0)
        for start in range(0, cycles, self.every):
            traces, labels = noisy(self.data, min(self.every, cycles - start), rng)
            stretch = Stretch()
            for i, (trace, label) in enumerate(zip(traces, labels, strict=True), start):
                self._play_cycle(f"part-{i}", trace[0], bool(label), stretch)
                if i % 100 == 0:
                    self._read_page(stretch)
            memory = resident_memory(self.server.process.pid)
            row = stretch.row(start + len(labels), len(self.acknowledged), memory)
            self.rows.append(row)
            print(row, file=sys.stderr, flush=True)

    def _play_cycle(self, part: str, trace: np.ndarray, good: bool, stretch: Stretch) -> None:
        """Ask for a decision, and report the label where the cell would learn it.

        Adds times and counts to `stretch`, and a reported label to `acknowledged`.
        """
        seconds, decision = wall_time(
            self._send_until_answered, stretch, self.web.decide, trace, part
        )
        stretch.decide.append(seconds)
        stretch.actions[decision["action"]] += 1
        is_line_stop = decision["action"] == "accept" and not good
        stretch.line_stops += is_line_stop
        if is_line_stop or decision["action"] == "verify":
            seconds, _ = wall_time(
                self._send_until_answered, stretch, self.web.report, decision["id"], good
            )
            stretch.report.append(seconds)
            self.acknowledged[decision["id"]] = good
        time.sleep(self.pace)

    def _send_until_answered(
        self, stretch: Stretch, request: Callable[..., dict[str, Any]], *arguments: Any
    ) -> dict[str, Any]:
        """Send a request, again at once while the status is 503, and return the answer.

        503 means that the store is busy, or that the disk did not answer in time. Each repetition
        is counted in `stretch.repeated`. Raises RuntimeError for any other status, and for 503
        after a minute.
        """
        deadline = time.monotonic() + PATIENCE
        while True:
            try:
                return request(*arguments)
            except RuntimeError as error:
                if ": 503 " not in str(error) or time.monotonic() > deadline:
                    raise
            stretch.repeated += 1

    def _read_page(self, stretch: Stretch) -> None:
        """Ask for what the page shows; raise RuntimeError unless it is answered."""
        seconds, _ = wall_time(self.web.request, "/status")
        stretch.page.append(seconds)


def compare_with_store(path: Path, acknowledged: dict[str, bool]) -> dict[str, Any]:
    """Open the store again; return counts of lost and wrong labels, and the times of retrains.

    Parameters
    ----------
    path : Path
        The store of a cell that has ended.
    acknowledged : dict of str to bool
        By decision id, each label that the cell acknowledged.
    """
    store = open_store(path, must_exist=True)
    try:
        stored = {label.decision_id: label.success for label in store.labels.past(0)}
        reports = store.versions.retrains()
    finally:
        store.close()
    seconds = [report.seconds for report in reports if report.accepted]
    return {
        "acknowledged": len(acknowledged),
        "lost": sum(name not in stored for name in acknowledged),
        "wrong": sum(stored.get(name, good) != good for name, good in acknowledged.items()),
        "retrains": len(reports),
        "dropped": sum(not report.accepted for report in reports),
        "retrain_p50_s": quantiles(seconds)["p50_s"],
        "retrain_p99_s": quantiles(seconds)["p99_s"],
        "retrain_worst_s": quantiles(seconds)["worst_s"],
        "too_long": sum(value > BUDGET for value in seconds),
    }


def main() -> None:
    """Parse, run the cell, compare, print, write."""
    parser = options(
        __doc__, data="insertion", samples=None, recipe="conv", folder=None, out=Path("out")
    )
    parser.add_argument("--cycles", type=int, default=50_000, help="parts")
    parser.add_argument("--window", type=int, default=10_000, help="labels that train a version")
    parser.add_argument(
        "--audit-rate", type=float, default=0.25, help="share of the certain parts that are checked"
    )
    parser.add_argument("--pace", type=float, default=0.02, help="seconds between two cycles")
    parser.add_argument("--every", type=int, default=1000, help="cycles of a row")
    args = parser.parse_args()
    data = load_dataset(args.data, samples=args.samples)
    with tempfile.TemporaryDirectory(dir=args.folder) as name:
        folder = Path(name)
        recipe = Recipe.load(args.recipe).with_settings(window=args.window)
        recipe = recipe.with_policy(**POLICY, audit_rate=args.audit_rate)
        (folder / "recipe.toml").write_text(recipe.to_toml(), encoding="utf-8")
        server = Server(folder, "--recipe", "recipe.toml")
        soak = Soak(server, data, args.pace, args.every)
        try:
            soak.run(args.cycles)
        finally:
            server.end()
        totals = compare_with_store(folder / "cell.db", soak.acknowledged)
    print_table(soak.rows, "A served cell", args.out / "soak.csv", width=180)
    print_table([totals], "Labels and retrains", args.out / "soak_totals.csv", width=150)


if __name__ == "__main__":
    main()
