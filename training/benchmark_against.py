"""Compare this checkout with another revision in one interleaved run.

    python training/benchmark_against.py c01287f --rounds 5

It times retrains, decisions and reports. Each round runs both revisions, one after the other, each
in a process of its own; run it on idle cores. It prints the median and the worst of each quantity
for both, and the median over the rounds of the ratio here / there.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

REPO = Path(__file__).resolve().parents[1]
# The measurement, run in each revision. It uses only names that every revision has.
MEASUREMENT = """
import gc, json, tempfile, time
import numpy as np
from dengine import Action, DataEngine, Policy, load_dataset

data = load_dataset("insertion")
policy = Policy(alpha=0.1, lower_bound=0.9)
engine = DataEngine("conv", policy=policy, retrain_every=10**6, budget=30.0)
seconds = {}
for x, y in zip(data.X, data.y):
    decision = engine.decide(x)
    engine.report(decision.id, bool(y))
for name in ("first retrain", "warm retrain", "warm retrain again"):
    begin = time.perf_counter()
    engine.retrain()
    seconds[name] = time.perf_counter() - begin

gc.collect()
gc.freeze()
gc.disable()  # as in a loop that must not wait
durations = []
for k in range(DECISIONS):
    x = data.X[k % len(data.X)] + np.float32(0.01 * (1 + k // len(data.X)))
    begin = time.perf_counter()
    engine.decide(x)
    durations.append(time.perf_counter() - begin)
durations = np.array(durations[100:])
seconds["decide p50"] = np.quantile(durations, 0.5)
seconds["decide p99"] = np.quantile(durations, 0.99)
seconds["decide worst"] = durations.max()

# Each label is on the disk when `report` returns; nothing else starts a retrain.
with tempfile.TemporaryDirectory() as folder:
    engine = DataEngine("pca", store=folder + "/engine.db", retrain_every=10**6)
    durations = []
    for x, y in zip(data.X[:REPORTS], data.y):
        decision = engine.decide(x)
        begin = time.perf_counter()
        engine.report(decision.id, bool(y))
        durations.append(time.perf_counter() - begin)
    engine.close()
seconds["report p50"] = np.quantile(durations, 0.5)
seconds["report p99"] = np.quantile(durations, 0.99)
print(json.dumps({name: float(value) for name, value in seconds.items()}))
"""


def check_out(revision: str, folder: Path) -> None:
    """Write the dengine of a revision into a folder; this checkout stays as it is."""
    command = ["git", "archive", revision, "dengine"]
    archive = subprocess.run(command, cwd=REPO, capture_output=True, check=True).stdout
    subprocess.run(["tar", "-x", "-C", str(folder)], input=archive, check=True)


def measure(root: Path, decisions: int, reports: int) -> dict[str, float]:
    """Measure the dengine in a folder, in a new process; return the seconds of each quantity.

    Raises SystemExit if that process fails.
    """
    code = MEASUREMENT.replace("DECISIONS", str(decisions)).replace("REPORTS", str(reports))
    environment = os.environ | {"PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    process = subprocess.run(
        [sys.executable, "-c", code],
        env=environment,
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
    )
    if process.returncode:
        raise SystemExit(f"The revision at {root} failed: {process.stderr[-2000:]}")
    seconds: dict[str, float] = json.loads(process.stdout.splitlines()[-1])
    return seconds


def main() -> None:
    """Measure both revisions in turn, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("revision", help="what to compare with: a commit, a tag or a branch")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--decisions", type=int, default=5000)
    parser.add_argument("--reports", type=int, default=1000)
    arguments = parser.parse_args()
    here = []
    there = []
    with tempfile.TemporaryDirectory() as folder:
        check_out(arguments.revision, Path(folder))
        for _ in range(arguments.rounds):
            here.append(measure(REPO, arguments.decisions, arguments.reports))
            there.append(measure(Path(folder), arguments.decisions, arguments.reports))
    name = arguments.revision[:9]
    print(f"{'milliseconds':<20} {'here':>9} {'worst':>9} {name:>9} {'worst':>9} {'ratio':>7}")
    for quantity in here[0]:
        ours = [1000 * seconds[quantity] for seconds in here]
        theirs = [1000 * seconds[quantity] for seconds in there]
        ratio = statistics.median(a / b for a, b in zip(ours, theirs, strict=True))
        columns = (statistics.median(ours), max(ours), statistics.median(theirs), max(theirs))
        text = " ".join(f"{milliseconds:9.3f}" for milliseconds in columns)
        print(f"{quantity:<20} {text} {ratio:7.2f}")


if __name__ == "__main__":
    main()
