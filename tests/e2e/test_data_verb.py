"""`dengine data`, which describes recordings, and the other verbs, which read by that."""

from dataclasses import replace

import numpy as np
import pytest

from dengine import DataEngine, Description, load_dataset
from dengine.datasets.sample import write_sample
from dengine.experiments.survey import survey_dataset
from tests.support.command_line import dengine, document, refused, well


def shown(*words: object) -> str:
    """Return what a command prints that must succeed, its lines joined."""
    result = dengine(*words)
    assert result.exit_code == 0, result.output
    return " ".join(result.stdout.split())


@pytest.fixture
def folder(tmp_path):
    """24 recordings as UR cells make them, one of them broken."""
    write_sample(tmp_path / "cell_3", 24)
    return tmp_path / "cell_3"


def test_a_proposal_is_shown_read_and_drawn_but_written_only_when_asked(folder, tmp_path):
    text = shown("data", folder, "--out", tmp_path / "out")
    assert 'FZ_Base = ""' in text
    assert "write the description with --save" in text
    assert (tmp_path / "out" / "data.png").stat().st_size > 10_000
    assert not (folder / "recordings.toml").exists()
    shown("data", folder, "--set", "channels.FZ_Base=N", "--save")
    saved, data = Description.load(folder / "recordings.toml"), load_dataset(folder)
    assert saved.channels["FZ_Base"].unit == "N"
    assert saved.seen.recordings == len(data) + len(data.faults)
    assert (data.unit, data.rate_hz, data.channels) == ("N", 500.0, ("FZ_Base",))
    assert "--force" in refused("data", folder, "--save")


def test_every_other_verb_asks_for_the_description_and_then_reads_by_it(folder, tmp_path):
    words = f"replay --data {folder} --reducer pca --repeats 1 --cycles 15".split()
    assert f"dengine data {folder} --save" in refused(*words)
    shown("data", folder, "--save")
    assert document(*words, "--samples", 400)["rows"][0]["cycles"] == 15
    assert "Expected a label among" in refused(*words, "--set", "label.good=yes")
    for _ in range(2):  # nothing is imported twice
        well("train", "--data", folder, "--store", tmp_path / "cell.db", "--reducer", "pca")
    with DataEngine.open(tmp_path / "cell.db") as engine:
        assert engine.status().labels == len(load_dataset(folder))
        assert engine.decide(np.linspace(0.0, 30.0, 998)).reason != "not_finite"


def test_sample_recordings_are_written_into_a_new_or_an_empty_folder_alone(folder):
    before = sorted(folder.iterdir())
    assert "Expected a new or an empty folder" in refused("data", "--sample", folder)
    assert sorted(folder.iterdir()) == before


def test_open_keys_are_listed_a_check_fails_and_a_saved_answer_has_its_consequences(tmp_path):
    for last, name in enumerate(("1_OK.csv", "2_NOK.csv")):
        (tmp_path / name).write_text(f"t,F\n0,5\n2,7\n4,3\n6,{last}\n")
    assert "time.format: " in shown("data", tmp_path, "--save")
    refused("data", tmp_path, "--check")
    assert "found one with ?" in refused("replay", "--data", tmp_path)
    assert "rate_hz = 500.0" in shown("data", tmp_path, "--set", "time.format=ms")


def test_a_check_ends_with_1_if_there_is_a_fault_and_names_it(folder):
    shown("data", folder, "--save")
    refused("data", folder, "--check", "--json")
    (fault,) = load_dataset(folder).faults
    (folder / fault.source).unlink()
    assert "made for" in shown("data", folder, "--check")


def test_what_is_wrong_with_traces_is_counted(make_data):
    data = make_data(120, samples=60)
    X, y = data.X.copy(), data.y.copy()
    X[3, 5], X[4], X[5, 5] = np.nan, 2.0, -3e38
    X[50:52], y[50:52] = X[10:12], (y[10], 1 - y[11])
    X[52:60] = X[20:28] + np.float32(1e-3)
    survey = survey_dataset(replace(data, X=X, y=y))
    assert (survey.not_finite, survey.constant, survey.too_large) == (1, 1, 1)
    assert survey.duplicates == 2
    assert 14 <= survey.near_repeats <= 20
    assert survey_dataset(data).near_repeats <= 3
