"""`training/evidence.py --cluster`: the same rows from dask workers, through a kill of
each part.
"""

import os
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import pandas as pd
import pytest

if find_spec("distributed") is None:  # to import it takes every worker a second
    pytest.skip("needs distributed", allow_module_level=True)

SCRIPT = Path(__file__).resolve().parents[2] / "training" / "evidence.py"
TINY = "--only=pca --sets=drift --cycles=200 --cells=1 --seeds=100:102"
DECISIONS = ["seed", "certain", "accepted", "rejected", "false_positive", "net_s", "bought"]


def evidence(folder: Path, words: str) -> subprocess.Popen[str]:
    """Start the script."""
    options = f"{TINY} {words} --out {folder} --keep {folder}/kept".split()
    command = [sys.executable, str(SCRIPT), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def rows(folder: Path) -> list[list[object]]:
    table = pd.read_csv(folder / "evidence" / "replays.csv")
    return table[DECISIONS].to_numpy().tolist()


def test_evidence_outlives_a_killed_worker_and_a_kill_of_its_own_and_has_the_same_rows(tmp_path):
    import distributed

    local, folder = tmp_path / "local", tmp_path / "cluster"
    assert evidence(local, "--n-jobs=1").wait() == 0
    workers = {"n_workers": 2, "threads_per_worker": 1, "processes": True}
    with distributed.LocalCluster(**workers, dashboard_address=None, silence_logs=50) as cluster:
        words = f"--cluster {cluster.scheduler_address}"
        with distributed.Client(cluster) as client:
            pid, *_ = client.run(os.getpid).values()
        first = evidence(folder, words)
        os.kill(pid, signal.SIGKILL)
        while first.poll() is None and not [*folder.glob("kept/*.npz")]:
            time.sleep(0.005)
        first.kill()
        output, _ = evidence(folder, words).communicate()
    assert output.startswith("1 replays are left, ")
    assert rows(folder) == rows(local)
