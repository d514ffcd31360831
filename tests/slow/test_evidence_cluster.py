"""`training/evidence.py --cluster`: the same rows from dask workers, through a kill of
each part.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

import pandas as pd
import pytest

if find_spec("distributed") is None:  # to import it takes every worker a second
    pytest.skip("needs distributed", allow_module_level=True)

SCRIPT = Path(__file__).resolve().parents[2] / "training" / "evidence.py"
TINY = ["--only=pca", "--sets=drift", "--cycles=200", "--cells=1", "--seeds=100:102"]
T = TypeVar("T")
DECISIONS = ["seed", "certain", "accepted", "rejected", "false_positive", "net_s", "bought"]


@contextmanager
def cluster() -> Iterator[Any]:
    """Start two worker processes; the client of their scheduler."""
    import distributed

    workers = {"n_workers": 2, "threads_per_worker": 1, "processes": True}
    with (
        distributed.LocalCluster(**workers, dashboard_address=None, silence_logs=50) as local,
        distributed.Client(local) as client,
    ):
        yield client


@contextmanager
def evidence(folder: Path, *words: str) -> Iterator[subprocess.Popen[str]]:
    """Start the script; it is killed where the block ends before it."""
    command = [sys.executable, str(SCRIPT), *TINY, *words]
    command += ["--out", str(folder), "--keep", str(folder / "kept")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def wait_for(find: Callable[[], T], process: subprocess.Popen[str]) -> T:
    """Return the first true result, as long as the process runs."""
    while process.poll() is None:
        if result := find():
            return result
        time.sleep(0.005)
    raise AssertionError("The script has ended.")


def rows(folder: Path) -> list[list[object]]:
    table = pd.read_csv(folder / "evidence" / "replays.csv")
    return table[DECISIONS].to_numpy().tolist()


def test_evidence_outlives_a_killed_worker_and_a_killed_cluster(tmp_path: Path) -> None:
    with evidence(tmp_path / "local", "--n-jobs", "1") as alone:
        assert alone.wait() == 0
    folder = tmp_path / "cluster"

    with cluster() as client:
        pids = client.run(os.getpid)
        address = client.scheduler.address
        with evidence(folder, "--cluster", address) as script:

            def busy_worker() -> str | None:
                return next((name for name, tasks in client.processing().items() if tasks), None)

            os.kill(pids[wait_for(busy_worker, script)], signal.SIGKILL)
            wait_for(lambda: list(folder.glob("kept/*.npz")), script)
            script.kill()

    with cluster() as client, evidence(folder, "--cluster", client.scheduler.address) as script:
        output, _ = script.communicate()
        assert script.returncode == 0
    assert output.startswith("1 replays are left, ")
    assert "at 2 at a time" in output
    assert rows(folder) == rows(tmp_path / "local")
