"""`dengine data`, and the other verbs on recordings as people have them."""

import runpy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from dengine import DataEngine, Dataset
from dengine.cli.output import WIDE
from dengine.experiments.figures import data_picture
from dengine.experiments.survey import survey
from tests.support.command_line import dengine, document, well


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, repo: Path) -> Path:
    """80 recordings as UR cells make them, three of them broken."""
    path = tmp_path_factory.mktemp("recordings") / "cell_3"
    runpy.run_path(str(repo / "training" / "make_recordings.py"))["write_recordings"](path, 80, 3, 0)
    return path


def test_data_says_what_a_folder_is_and_what_is_wrong_with_it(folder: Path, tmp_path: Path) -> None:
    result = well("data", folder, "--channel", "FZ_Base,FX_Base", "--out", tmp_path / "out")
    said = " ".join(result.stdout.replace("│", " ").split())
    for words in (
        "77, 3 left out",
        "2 channels (FZ_Base, FX_Base)",
        "500 Hz each, by the timestamps",
        "FX_Base by tenths",
        "Expected 13 columns, got 12",
    ):
        assert words in said, words
    assert max(map(len, result.stdout.splitlines())) <= max(WIDE, len(f"Wrote {tmp_path / 'out' / 'data.png'}"))
    assert (tmp_path / "out" / "data.png").stat().st_size > 10_000


def test_data_as_json_is_one_document_and_replay_says_once_what_was_left_out(folder: Path) -> None:
    found = document("data", folder)["survey"]
    assert (found["traces"], len(found["faults"]), found["rate_hz"], found["fit"]) == (77, 3, 500.0, "pad")
    assert found["good"] + found["bad"] == 77
    assert found["lengths"]["low"] < found["lengths"]["high"]
    played = well("replay", "--data", folder, "--channel", "FZ_Base", "--reducer", "pca", "--cycles", 60, "--repeats", 1)
    assert "pca on cell_3" in played.stdout
    assert played.stderr.count("Left out 3 of 80 recordings of cell_3:") == 1


def test_an_engine_trained_from_a_folder_decides_on_a_raw_recording_of_another_length(folder: Path, tmp_path: Path) -> None:
    store = tmp_path / "engine.db"
    result = well("train", "--data", folder, "--store", store, "--reducer", "pca")
    assert "Imported 77 labelled traces" in result.stdout
    again = well("train", "--data", folder, "--store", store)
    assert "all 77 traces were there from an earlier import" in again.stdout
    with DataEngine.open(store) as engine:
        assert (engine.trace.fit, engine.trace.columns) == ("pad", ("FZ_Base",))
        frames = [pd.read_csv(path) for path in sorted(folder.iterdir()) if len(path.read_bytes()) > 10**5][:3]
        assert all(engine.decide(frame).embedding is not None for frame in frames)
        assert len({len(frame) for frame in frames}) > 1
    other = dengine("train", "--data", folder, "--channel", "FX_Base", "--store", store)
    assert other.exit_code == 1
    assert "Expected the channels FZ_Base, got FX_Base" in other.stderr


def test_what_is_wrong_with_traces_is_counted(make_data: Callable[..., Dataset]) -> None:
    data = make_data(120, samples=60)
    X, y = data.X.copy(), data.y.copy()
    X[3, 5], X[4] = np.nan, 2.0
    X[50], y[50] = X[10], y[10]
    X[51], y[51] = X[11], 1 - y[11]
    X[52:60] = X[20:28] + np.float32(1e-3)
    found = survey(replace(data, X=X, y=y))
    assert (found.not_finite, found.constant) == (1, 1)
    assert (found.duplicates, found.contradicting) == (2, 1)
    assert 14 <= found.near_repeats <= 20
    assert found.looked_at == 118
    assert (found.good + found.bad, found.lengths) == (120, None)
    assert survey(make_data(120, samples=60)).near_repeats <= 3


def test_drift_is_seen_where_there_is_some_and_only_there(make_data: Callable[..., Dataset]) -> None:
    data = make_data(300, samples=60)
    still = {each.name: each for each in survey(data).drift}
    assert still["good"].p > 0.01
    assert still["channel 1"].p > 0.01
    rng = np.random.default_rng(1)
    y = (rng.random(300) < np.linspace(1.0, 0.3, 300)).astype(np.int8)
    moved = {each.name: each for each in survey(replace(data, X=data.X + np.linspace(0, 9, 300)[:, None], y=y)).drift}
    assert moved["good"].p < 1e-4 > moved["channel 1"].p
    assert moved["good"].rho < -0.2 < 0.3 < moved["channel 1"].rho
    flat = survey(replace(data, y=np.ones(300, dtype=np.int8))).drift[0]
    assert np.isnan([flat.rho, flat.p]).all()
    assert flat.tenths == (1.0,) * 10


@pytest.mark.parametrize(("n", "channels"), [(1, 1), (6, 4), (60, 4)])
def test_a_picture_is_drawn_of_any_data(make_data: Callable[..., Dataset], n: int, channels: int) -> None:
    data = make_data(n, samples=40, channels=channels)
    data.X[0, ..., 3] = np.nan
    assert len(data_picture(data, "x").axes) == min(channels, 3) + 2
