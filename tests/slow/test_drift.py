"""The comparison under drift: what its numbers mean, and a small run on streams that were made before."""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pandas as pd
import pytest

FOLDER = Path(__file__).resolve().parents[2] / "training"
CYCLES = 240


@pytest.fixture(scope="module")
def drift() -> Iterator[ModuleType]:
    sys.path.insert(0, str(FOLDER))  # as `python training/NAME.py` has it
    yield importlib.import_module("compare_drift")
    sys.path.remove(str(FOLDER))


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


@pytest.mark.parametrize(("scenario", "cycle"), [("nominal", None), ("wear", 2), ("variant", 401), ("bias_jump", 401)])
def test_a_change_is_marked_at_the_first_cycle_that_it_touches(drift, scenario: str, cycle: int | None) -> None:
    # Counted from 1: of 800 cycles the second half begins with the 401st; wear is nought in the first.
    assert drift.first_change(scenario, 800) == cycle


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
