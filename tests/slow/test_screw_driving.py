"""The public recordings, converted: what a file says lands in the row where it belongs."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from dengine import load_dataset


def write_run(folder: Path, cycle: int, part: str, result: str, steps: list[tuple[list[float], list[float]]]) -> None:
    """A file as the station writes it, cut down to what is read."""
    graphs = [{"graph": {"time values": t, "torque values": torque}} for t, torque in steps]
    run = {"cycle": cycle, "id code": part, "result": result, "tightening steps": graphs}
    (folder / f"Ch_{cycle:012d}.json").write_text(json.dumps(run), encoding="utf-8")


def convert(repo: Path, folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(repo / "training" / "make_screw_driving.py"), str(folder), *options]
    return subprocess.run(command, capture_output=True, text=True)


def test_steps_are_joined_on_one_grid_and_the_last_value_is_repeated(repo: Path, tmp_path: Path) -> None:
    steps = [([0.0, 0.0024, 0.0036], [0.0, 0.2, 0.3]), ([0.0036, 0.0048], [0.3, 0.5])]
    write_run(tmp_path, 7, "a", "NOK", steps)
    write_run(tmp_path, 5, "a", "OK", steps)
    write_run(tmp_path, 6, "b", "OK", steps)
    done = convert(repo, tmp_path, "--samples", "7", "--out", str(tmp_path / "out.npz"))
    assert done.returncode == 0, done.stderr
    assert "3 runs of 2 workpieces, 2 OK and 1 NOK" in done.stdout
    data = load_dataset(tmp_path / "out.npz")
    np.testing.assert_allclose(data.X, [[0.0, 0.1, 0.2, 0.3, 0.5, 0.5, 0.5]] * 3, atol=1e-6)
    assert (data.y.tolist(), data.unit, round(data.rate_hz)) == ([1, 1, 0], "N·m", 833)
    with np.load(tmp_path / "out.npz") as stored:
        assert (stored["workpiece"].tolist(), stored["nth_run"].tolist()) == (["a", "b", "a"], [0, 0, 1])


def test_a_folder_without_recordings_says_what_was_expected(repo: Path, tmp_path: Path) -> None:
    done = convert(repo, tmp_path)
    assert done.returncode == 1
    assert "Expected files Ch_*.json" in done.stderr
