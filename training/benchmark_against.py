"""Compare this checkout with another revision in one interleaved run: retrains, decisions and reports as ratios.

    python training/benchmark_against.py c01287f --rounds 5

Each round runs both revisions, one after the other, each in a process of its own, on idle cores. Printed are the median and
the worst of each quantity on both sides, and the median ratio, round by round.
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
# Only names that every revision has.
MEASURED = """
import gc, json, tempfile, time
import numpy as np
from dengine import Action, DataEngine, Policy, load_dataset
data = load_dataset("insertion")
engine = DataEngine("conv", policy=Policy(alpha=0.1, lower_bound=0.9), retrain_every=10**6, budget=30.0)
seconds = {}
for x, y in zip(data.X, data.y):
    decision = engine.decide(x)
    engine.report(decision.id, bool(y))
for name in ("first retrain", "warm retrain", "warm retrain again"):
    began = time.perf_counter()
    engine.retrain()
    seconds[name] = time.perf_counter() - began
gc.collect()
gc.freeze()
gc.disable()  # as a loop that must not wait has it
taken = []
for k in range(DECISIONS):
    x = data.X[k % len(data.X)] + np.float32(0.01 * (1 + k // len(data.X)))
    began = time.perf_counter()
    engine.decide(x)
    taken.append(time.perf_counter() - began)
taken = np.array(taken[100:])
seconds |= {"decide p50": np.quantile(taken, 0.5), "decide p99": np.quantile(taken, 0.99), "decide worst": taken.max()}
with tempfile.TemporaryDirectory() as folder:  # each label on the disk as this returns; nothing else sets off a retrain
    engine, taken = DataEngine("pca", store=folder + "/engine.db", retrain_every=10**6), []
    for x, y in zip(data.X[:REPORTS], data.y):
        decision = engine.decide(x)
        began = time.perf_counter()
        engine.report(decision.id, bool(y))
        taken.append(time.perf_counter() - began)
    engine.close()
seconds |= {"report p50": np.quantile(taken, 0.5), "report p99": np.quantile(taken, 0.99)}
print(json.dumps({name: float(value) for name, value in seconds.items()}))
"""


def checked_out(revision: str, folder: Path) -> Path:
    """The revision's files, without touching this checkout."""
    archive = subprocess.run(
        ["git", "archive", revision, "dengine"], cwd=REPO, capture_output=True, check=True
    ).stdout
    subprocess.run(["tar", "-x", "-C", str(folder)], input=archive, check=True)
    return folder


def measured(root: Path, decisions: int, reports: int) -> dict[str, float]:
    """Seconds of each quantity, in a new process that imports dengine from `root`."""
    code = MEASURED.replace("DECISIONS", str(decisions)).replace("REPORTS", str(reports))
    environment = os.environ | {"PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=environment,
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"The revision at {root} failed: {done.stderr[-2000:]}")
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("revision", help="what to compare with: a commit, a tag or a branch")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--decisions", type=int, default=5000)
    parser.add_argument("--reports", type=int, default=1000)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        other = checked_out(args.revision, Path(folder))
        how = args.decisions, args.reports
        rounds = [(measured(REPO, *how), measured(other, *how)) for _ in range(args.rounds)]
    print(
        f"{'milliseconds':<20} {'here':>9} {'worst':>9} {args.revision[:9]:>9} {'worst':>9} {'ratio':>7}"
    )
    for name in rounds[0][0]:
        here, there = ([1000 * sides[k][name] for sides in rounds] for k in (0, 1))
        ratio = statistics.median(a / b for a, b in zip(here, there, strict=True))
        figures = (statistics.median(here), max(here), statistics.median(there), max(there))
        print(f"{name:<20} " + " ".join(f"{each:9.3f}" for each in figures) + f" {ratio:7.2f}")


if __name__ == "__main__":
    main()
