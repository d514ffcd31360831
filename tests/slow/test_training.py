"""The scripts in training/: what they say of themselves is so, and small data does not break them."""

import importlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from dengine import load_dataset
from tests.support.driving import easy_parts

FOLDER = Path(__file__).resolve().parents[2] / "training"
Run = Callable[..., str]


@pytest.fixture(autouse=True)
def _beside_the_scripts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))  # as `python training/NAME.py` has it


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs a script's main in this process; what it printed."""

    def run_script(name: str, *words: object) -> str:
        monkeypatch.setattr(sys, "argv", [f"training/{name}.py", *map(str, words)])
        load(name).main()
        return capsys.readouterr().out

    return run_script


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """60 traces of 40 samples in two easy shapes."""
    data = easy_parts(60, 0)
    path = tmp_path_factory.mktemp("data") / "tiny.npz"
    np.savez(path, X=data.X, y=data.y)
    return path


def load(name: str) -> ModuleType:
    return importlib.import_module(name)


def test_a_comparison_has_a_table_and_a_csv_and_plays_nothing_twice_that_it_kept(run: Run, tiny, tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    words = ["report", "--data", tiny, "--reducers", "pca,never", "--seeds", "0:2", "--policies", "0.1:0.9", "--n-jobs", 1]
    first, second = (run("compare_reducers", *words, "--out", tmp_path, "--keep", kept) for _ in range(2))
    assert first[first.index("report:") :] == second[second.index("report:") :]  # times and all
    assert len(list(kept.iterdir())) == 4
    assert len((tmp_path / "report_tiny.csv").read_text().splitlines()) == 1 + 2 * 2


def test_a_rival_without_a_bound_says_so_in_its_row(run: Run, tiny: Path, tmp_path: Path) -> None:
    words = ["report", "--data", tiny, "--reducers", "pca,never,always,knn", "--seeds", "0:1", "--policies", "0.1:0.9"]
    table = (line for line in run("compare_reducers", *words, "--n-jobs", 1, "--out", tmp_path).splitlines() if "|" in line)
    bounds = {line.split("|")[1].strip().split(":")[0]: line.split("|")[2].strip() for line in table}
    assert bounds["never"] == "none"
    assert bounds["knn"] == "none: threshold swept"
    assert bounds["pca"] == "Wilson, at one look"
    assert bounds["always"].startswith("no error")


def test_screw_driving_steps_are_joined_on_one_grid_and_the_last_value_is_repeated(run: Run, tmp_path: Path) -> None:
    steps = [([0.0, 0.0024, 0.0036], [0.0, 0.2, 0.3]), ([0.0036, 0.0048], [0.3, 0.5])]
    graphs = [{"graph": {"time values": time, "torque values": torque}} for time, torque in steps]
    with pytest.raises(SystemExit, match=r"Expected files Ch_\*.json"):
        run("make_screw_driving", tmp_path)
    for cycle, part, result in ((7, "a", "NOK"), (5, "a", "OK"), (6, "b", "OK")):
        written = {"cycle": cycle, "id code": part, "result": result, "tightening steps": graphs}
        (tmp_path / f"Ch_{cycle:012d}.json").write_text(json.dumps(written), encoding="utf-8")
    said = run("make_screw_driving", tmp_path, "--samples", 7, "--out", tmp_path / "out.npz")
    assert "3 runs of 2 workpieces, 2 OK and 1 NOK" in said
    data = load_dataset(tmp_path / "out.npz")
    np.testing.assert_allclose(data.X, [[0.0, 0.1, 0.2, 0.3, 0.5, 0.5, 0.5]] * 3, atol=1e-6)
    assert (data.y.tolist(), data.unit, round(data.rate_hz)) == ([1, 1, 0], "N·m", 833)
    with np.load(tmp_path / "out.npz") as stored:
        assert (stored["workpiece"].tolist(), stored["nth_run"].tolist()) == (["a", "b", "a"], [0, 0, 1])
