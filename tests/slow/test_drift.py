"""The comparison under drift: what its numbers mean, and a small run on streams that were made before."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pandas as pd
import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "training" / "compare_drift.py"
CYCLES = 240


@pytest.fixture(scope="module")
def drift() -> ModuleType:
    spec = importlib.util.spec_from_file_location("compare_drift", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules["compare_drift"] = module  # where its dataclass looks for its own names
    spec.loader.exec_module(module)
    return module


def log_of(action: list[str], good: list[int]) -> SimpleNamespace:
    accepted, truth = np.array(action) == "accept", np.array(good) == 1
    counts = {"accepted": accepted.sum(), "rejected": action.count("reject"), "stops": (accepted & ~truth).sum()}
    counts |= {"false_negative": ((np.array(action) == "reject") & truth).sum()}
    return SimpleNamespace(
        false_positive=accepted & ~truth,
        finished=(np.array(action) != "reject") & truth,
        stretch=lambda part: counts,
    )


@pytest.mark.parametrize(
    ("on", "change", "expected"),
    [
        ([0, 0, 0, 1, 1, 0], 2, (2, 2)),
        ([0, 0, 1, 1, 0, 0], 2, (1, 2)),
        ([1, 0, 0, 0, 0, 0], 2, (None, None)),  # a false alarm before the change is none of it
        ([0, 0, 0, 0, 1, 1], 2, (3, None)),
    ],
)
def test_an_alarm_is_counted_from_the_change_and_lasts_until_it_is_off(drift, on, change, expected) -> None:
    assert drift.alarm_and_back(np.array(on, dtype=bool), change) == expected


def test_escapes_are_shares_of_the_parts_that_were_passed_on(drift: ModuleType) -> None:
    log = log_of(["verify", "verify", "accept", "accept", "reject"], [1, 0, 1, 0, 1])
    assert drift.escapes(log, slice(None)) == pytest.approx(1000 / 3)
    assert np.isnan(drift.escapes(log, slice(1, 2)))


def test_what_was_saved_has_stops_and_good_parts_sent_back_taken_off(drift: ModuleType) -> None:
    log = log_of(["verify", "accept", "accept", "reject"], [1, 1, 0, 1])
    assert drift.seconds_saved(log) == 5.0 * 3 - 120.0 - (47.0 + 5.0)


@pytest.fixture
def folder(tmp_path: Path, make_data) -> Path:
    """A stream whose sensor's offset jumps half way, where the script looks for one of 240 cycles."""
    data = make_data(CYCLES, noise=0.2)
    data.X[CYCLES // 2 :] += np.float32(30.0)
    (tmp_path / "streams").mkdir()
    np.savez(tmp_path / "streams" / f"bias_jump_{CYCLES}_7.npz", X=data.X, y=data.y)
    return tmp_path


def run(drift: ModuleType, monkeypatch: pytest.MonkeyPatch, folder: Path, *words: object) -> None:
    asked = ["--cycles", CYCLES, "--scenarios", "bias_jump", "--seed", 7, "--n-jobs", 1, "--out", folder, *words]
    monkeypatch.setattr(sys, "argv", ["compare_drift.py", *map(str, asked)])
    monkeypatch.chdir(folder)
    drift.main()


def test_a_stream_that_is_there_is_compared_without_a_simulator(
    drift: ModuleType, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    run(drift, monkeypatch, folder, "--methods", "dengine,paper-conv", "--docs")
    table = pd.read_csv(folder / "drift.csv").set_index("method")
    assert list(table.index) == ["dengine", "paper-conv"]
    assert table.loc["dengine", "novel_after"] > 0 == table.loc["paper-conv", "novel_after"]
    assert 1 <= table.loc["dengine", "alarm"] < 40
    assert np.isnan(table.loc["paper-conv", "alarm"])
    assert (table["cycles"] == CYCLES).all()
    assert (folder / "docs" / "drift.png").read_bytes() == (folder / "drift.png").read_bytes()
    assert "bias_jump" in capsys.readouterr().out


def test_a_method_that_is_not_known_is_named(drift, folder, monkeypatch, capsys) -> None:
    with pytest.raises(SystemExit):
        run(drift, monkeypatch, folder, "--methods", "dengine,luck")
    assert "not luck" in capsys.readouterr().err


def test_a_stream_is_simulated_once(drift: ModuleType, tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    path = drift.stream("variant", 4, 3, 1, tmp_path)
    written = path.stat().st_mtime_ns
    assert drift.stream("variant", 4, 3, 1, tmp_path).stat().st_mtime_ns == written
    with np.load(path) as file:
        assert (file["X"].shape, str(file["scenario"])) == ((4, 1000), "variant")
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
