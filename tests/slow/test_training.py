"""The scripts in training/: what they say of themselves is so, and small data does not break them."""

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

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
    rng = np.random.default_rng(0)
    y = rng.random(60) < 0.6
    X = np.where(y[:, None], np.linspace(0, 5, 40), np.linspace(5, 0, 40)) + rng.normal(0, 0.3, (60, 40))
    path = tmp_path_factory.mktemp("data") / "tiny.npz"
    np.savez(path, X=X.astype(np.float32), y=y.astype(np.int8))
    return path


def load(name: str) -> ModuleType:
    return importlib.import_module(name)


def test_a_comparison_of_60_cycles_has_a_table_and_a_csv(run: Run, tiny: Path, tmp_path: Path) -> None:
    words = ["report", "--data", tiny, "--reducers", "pca", "--seeds", "0:2", "--n-jobs", 1, "--out", tmp_path]
    out = run("compare_reducers", *words)
    assert "pca" in out
    assert len((tmp_path / "report_tiny.csv").read_text().splitlines()) == 1 + 2 * 2


def test_a_comparison_plays_nothing_twice_that_it_kept(run: Run, tiny: Path, tmp_path: Path) -> None:
    words = ["report", "--data", tiny, "--reducers", "pca,never", "--seeds", "0:2", "--policies", "0.1:0.9", "--n-jobs", 1]
    first, second = (run("compare_reducers", *words, "--out", tmp_path, "--keep", tmp_path / "kept") for _ in range(2))
    assert "4 of 4" in first
    assert "of 4" not in second
    assert first[first.index("report:") :] == second[second.index("report:") :]  # times and all


def test_a_rival_without_a_bound_says_so_in_its_row(run: Run, tiny: Path, tmp_path: Path) -> None:
    words = ["report", "--data", tiny, "--reducers", "pca,never,always,river", "--seeds", "0:1", "--policies", "0.1:0.9"]
    table = (line for line in run("compare_reducers", *words, "--n-jobs", 1, "--out", tmp_path).splitlines() if "|" in line)
    bounds = {line.split("|")[1].strip().split(":")[0]: line.split("|")[2].strip() for line in table}
    assert bounds["never"] == "none"
    assert bounds["river"] == "none: threshold swept"
    assert bounds["pca"] == "Wilson, at one look"
    assert bounds["always"].startswith("no error")


def test_a_retrain_is_timed_until_it_is_committed(tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import time

    from dengine import Recipe, SqlStore, load_dataset

    put_version = SqlStore.put_version

    def slow(*words: Any) -> Any:
        time.sleep(0.4)
        return put_version(*words)

    monkeypatch.setattr(SqlStore, "put_version", slow)
    row = load("benchmark_scale").measure_store(load_dataset(tiny), Recipe.load("pca"), 60, 2, tmp_path)
    assert row["retrain_p50_s"] >= 0.4
