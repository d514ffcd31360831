"""Compare this checkout with another revision in one interleaved run.

    python training/benchmark_against.py c01287f --rounds 20

It times decisions, reports and retrains. Each revision runs in a process of its own, and both stay
alive: in each round one does 300 decisions, then the other, and so on, so that whatever disturbs
the machine disturbs both. Run it on idle cores. It prints the median, the 99th percentile and the
worst time of each quantity for both, and two ratios here / there: the median over the rounds of
the ratio of the medians, and the ratio of the 99th percentiles over all rounds.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from types import TracebackType
from typing import IO, Self

import numpy as np

REPO = Path(__file__).resolve().parents[1]
# How often each quantity is measured in a round.
BLOCKS = {"decide": 300, "report": 100, "retrain": 1}
# The measurement, run in each revision. It uses only names that every revision has. It prints the
# seconds of the first retrain; then it answers each line, a quantity and a number, with seconds.
MEASUREMENT = """
import gc, json, sys, tempfile, time
import numpy as np
from dengine import DataEngine, Policy, load_dataset

data = load_dataset("insertion")

def trace(k):
    return data.X[k % len(data.X)] + np.float32(0.01 * (1 + k // len(data.X)))

def seconds_of(call, *arguments):
    begin = time.perf_counter()
    call(*arguments)
    return time.perf_counter() - begin

policy = Policy(alpha=0.1, lower_bound=0.9)
engine = DataEngine("conv", policy=policy, retrain_every=10**6, budget=30.0)
for x, y in zip(data.X, data.y):
    decision = engine.decide(x)
    engine.report(decision.id, bool(y))
print(json.dumps([seconds_of(engine.retrain)]), flush=True)
engine.retrain()
gc.collect()
gc.freeze()
gc.disable()  # as in a loop that must not wait
with tempfile.TemporaryDirectory() as folder:
    # Each label is on the disk when `report` returns; nothing else starts a retrain.
    stored = DataEngine("pca", store=folder + "/engine.db", retrain_every=10**6)
    n = 0
    for line in sys.stdin:
        quantity, number = line.split()
        seconds = []
        for k in range(n, n + int(number)):
            if quantity == "decide":
                seconds.append(seconds_of(engine.decide, trace(k)))
            elif quantity == "report":
                decision = stored.decide(trace(k))
                label = bool(data.y[k % len(data.y)])
                seconds.append(seconds_of(stored.report, decision.id, label))
            else:
                seconds.append(seconds_of(engine.retrain))
        n += int(number)
        print(json.dumps(seconds), flush=True)
    stored.close()
"""


class Revision:
    """A process that measures the dengine of one folder; a context manager.

    Parameters
    ----------
    root : Path
        The folder that has `dengine` in it.
    """

    def __init__(self, root: Path) -> None:
        environment = os.environ | {"PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [sys.executable, "-c", MEASUREMENT],
            env=environment,
            cwd=root,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.first_retrain = self._read()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._pipe(self._process.stdin).close()
        self._process.wait()

    @staticmethod
    def _pipe(pipe: IO[str] | None) -> IO[str]:
        """Return a pipe of the process, which is there, because the process was started with it."""
        assert pipe is not None
        return pipe

    def _read(self) -> list[float]:
        """Return the seconds of the next answer; SystemExit if the process has failed."""
        line = self._pipe(self._process.stdout).readline()
        if not line:
            raise SystemExit("A revision failed; its error is above.")
        seconds: list[float] = json.loads(line)
        return seconds

    def measure(self, quantity: str) -> list[float]:
        """Measure one block of a quantity of `BLOCKS`; return the seconds of each call."""
        stdin = self._pipe(self._process.stdin)
        stdin.write(f"{quantity} {BLOCKS[quantity]}\n")
        stdin.flush()
        return self._read()


def check_out(revision: str, folder: Path) -> None:
    """Write the dengine of a revision into a folder; this checkout stays as it is."""
    command = ["git", "archive", revision, "dengine"]
    archive = subprocess.run(command, cwd=REPO, capture_output=True, check=True).stdout
    subprocess.run(["tar", "-x", "-C", str(folder)], input=archive, check=True)


def table_row(quantity: str, blocks: tuple[list[list[float]], list[list[float]]]) -> str:
    """Return a line of the table from the seconds of each round, here and there."""
    columns = []
    tails = []
    for rounds in blocks:
        milliseconds = 1000 * np.concatenate(rounds)
        median, tail = np.quantile(milliseconds, [0.5, 0.99])
        tails.append(tail)
        columns.append(f"{median:9.3f} {tail:9.3f} {milliseconds.max():9.3f}")
    ratio = statistics.median(
        statistics.median(here) / statistics.median(there)
        for here, there in zip(*blocks, strict=True)
    )
    return f"{quantity:<14} {columns[0]} {columns[1]} {ratio:7.2f} {tails[0] / tails[1]:7.2f}"


def main() -> None:
    """Measure both revisions in turn, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("revision", help="what to compare with: a commit, a tag or a branch")
    parser.add_argument("--rounds", type=int, default=20)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        check_out(arguments.revision, Path(folder))
        with Revision(REPO) as here, Revision(Path(folder)) as there:
            revisions = (here, there)
            blocks: dict[str, tuple[list[list[float]], list[list[float]]]] = {
                "first retrain": ([here.first_retrain], [there.first_retrain])
            }
            for quantity in BLOCKS:
                blocks[quantity] = ([], [])
                for number in range(arguments.rounds):
                    for i in (0, 1) if number % 2 else (1, 0):  # each begins in every other round
                        blocks[quantity][i].append(revisions[i].measure(quantity))
    name = arguments.revision[:9]
    print(
        f"{'milliseconds':<14} {'here':>9} {'p99':>9} {'worst':>9} {name:>9} {'p99':>9} "
        f"{'worst':>9} {'ratio':>7} {'of p99':>7}"
    )
    for quantity, both in blocks.items():
        print(table_row(quantity, both))


if __name__ == "__main__":
    main()
