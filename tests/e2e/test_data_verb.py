"""`dengine data`, and the other verbs on recordings as people have them."""

import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from click.testing import Result

from dengine import DataEngine, Dataset, load_dataset
from dengine.experiments.figures import data_picture
from dengine.experiments.survey import survey
from tests.support.command_line import dengine, document, well
from training.make_recordings import write_plants, write_recordings


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """80 recordings as UR cells make them, three of them broken; beside them those of five plants."""
    path = tmp_path_factory.mktemp("recordings") / "cell_3"
    write_recordings(path, 80, 3, 0)
    write_plants(path.parent, 60, 0)
    return path


def test_data_says_what_a_folder_is_and_what_is_wrong_with_it(folder: Path, tmp_path: Path) -> None:
    result = well("data", folder, "--channel", "FZ_Base,FX_Base", "--out", tmp_path / "out")
    words = " ".join(result.stdout.replace("│", " ").split())
    said = "traces 77|names FZ_Base, FX_Base|rates low 500,|Left out 3 of 80|Expected 13 columns, got 12"
    assert [word for word in said.split("|") if word not in words] == []
    assert (tmp_path / "out" / "data.png").stat().st_size > 10_000
    played = well("replay", "--data", folder, "--channel", "FZ_Base", "--reducer", "pca", "--cycles", 60, "--repeats", 1)
    assert played.stderr.count("Left out 3 of 80 recordings of cell_3:") == 1


def test_an_engine_trained_from_a_folder_decides_on_a_raw_recording_of_another_length(folder: Path, tmp_path: Path) -> None:
    store = tmp_path / "engine.db"
    assert document("train", "--data", folder, "--store", store, "--reducer", "pca")["import"]["imported"] == 77
    assert document("train", "--data", folder, "--store", store)["import"]["known"] == 77
    with DataEngine.open(store) as engine:
        assert (engine.trace.fit, engine.trace.columns) == ("pad", ("FZ_Base",))
        frames = [pd.read_csv(path) for path in sorted(folder.iterdir()) if len(path.read_bytes()) > 10**5][:3]
        assert all(engine.decide(frame).embedding is not None for frame in frames)
        assert len({len(frame) for frame in frames}) > 1
    other = dengine("train", "--data", folder, "--channel", "FX_Base", "--store", store)
    assert other.exit_code == 1
    assert "Expected the channels FZ_Base, got FX_Base" in other.stderr


PLANTS = {  # what is given of five plants' recordings, as their errors say one by one
    "latin": "--labels 'latin/Prüfung.csv' --label-map i.O.=good,n.i.O.=bad",
    "historian": "--part serial --time timestamp --label verdict",
    "wide": "--channels FZ",
    "bag": "--trigger register@/phase --label /height_check/ok",
    "lab": "--channels force --label accepted",
}


@pytest.mark.parametrize("source", PLANTS)
def test_each_plants_recordings_are_replayed_by_one_command_or_as_the_errors_say(
    source: str, folder: Path, monkeypatch
) -> None:
    monkeypatch.chdir(folder.parent)
    found = document("data", source, *shlex.split(PLANTS[source]))["survey"]
    good = int(load_dataset("insertion").y[np.random.default_rng(0).permutation(1503)[:60]].sum())
    assert (found["traces"], found["samples"], found["good"], found["faults"]) == (60, 200, good, [])
    assert found["rate_hz"] == (None if source in ("wide", "lab") else 100.0)
    done, _ = as_advised("replay", "--data", source, "--reducer", "pca", "--repeats", "1", "--cycles", "60")
    assert "pca on" in done.stdout
    assert ("read as Windows-1252" in done.stderr) == (source == "latin")


def as_advised(*asked: str) -> tuple[Result, dict[str, str]]:
    """What a command comes to where one types what its errors say, one by one; and what that was."""
    told = dict[str, str]()
    while (done := dengine(*asked, *(word for pair in told.items() for word in pair))).exit_code:
        advice = re.findall(r"(--[a-z-]+) ('[^']*'|\S+?)(?=[.,;]?(?:\s|$))", done.stderr)
        assert set(dict(advice)) - set(told), done.stderr
        told |= {name: shlex.split(value)[0] for name, value in advice}
    return done, {name.strip("-").replace("-", "_"): value for name, value in told.items()}


def long(X: np.ndarray, good: np.ndarray) -> pd.DataFrame:
    """A row a sample; the numbers of parts begin anew in each file."""
    rows = {"time": (np.arange(len(X))[:, None] + np.arange(40) / 100).ravel(), "serial": np.repeat(np.arange(len(X)), 40)}
    return pd.DataFrame(rows | {"force": X.ravel().astype(float), "verdict": np.repeat(np.where(good, "OK", "NOK"), 40)})


def at_last(table: pd.DataFrame) -> pd.DataFrame:
    """With a verdict in the last row of each part alone."""
    return table.assign(verdict=table["verdict"].where(~table["serial"].duplicated(keep="last")))


def wide(X: np.ndarray, good: np.ndarray, name: str = "s{:03d}_fz") -> pd.DataFrame:
    return pd.DataFrame(X.astype(float), columns=[name.format(i) for i in range(40)]).assign(day=1, Urteil=good)


FORMS: dict[str, Callable[..., Any]] = {  # what writes a day's file
    "long.parquet": lambda X, good, path: long(X, good).to_parquet(path),
    "long.csv": lambda X, good, path: long(X, good).to_csv(path, index=False),
    "last.csv": lambda X, good, path: at_last(long(X, good)).to_csv(path, index=False),
    "last.parquet": lambda X, good, path: at_last(long(X, good)).to_parquet(path),
    "tags.csv": lambda X, good, path: pd.concat(
        [long(each, good).assign(tag=tag) for tag, each in (("FZ", X), ("MX", -X))]
    ).to_csv(path, index=False),
    "wide.parquet": lambda X, good, path: wide(X, good).to_parquet(path),
    "wide.csv": lambda X, good, path: wide(X, good, "FZ [{}]").to_csv(path, index=False),
    "plain.npz": lambda X, good, path: np.savez(path, X=X, y=good, rate_hz=100.0),
    "named.npz": lambda X, good, path: np.savez(path, force=X, torque=-X, accepted=good),
    "turned.npz": lambda X, good, path: np.savez(path, force=X.T, accepted=good),
}
DAYS = {"day_2": slice(0, 7), "day_10": slice(7, 21), "day_11": slice(21, 30)}


@pytest.mark.parametrize("form", FORMS)
def test_a_folder_of_several_files_of_one_form_is_one_set(form: str, make_data, tmp_path: Path) -> None:
    data = make_data(30, samples=40)
    for day, rows in DAYS.items():
        FORMS[form](data.X[rows], data.y[rows] == 1, tmp_path / f"{day}{Path(form).suffix}")
    found = load_dataset(tmp_path, **as_advised("data", str(tmp_path))[1])
    np.testing.assert_array_equal(found.X, data.X)
    assert (found.y.tolist(), found.faults) == (data.y.tolist(), ())


@pytest.mark.parametrize("form", ["wide.csv", "plain.npz"])
def test_files_of_other_forms_in_a_folder_are_both_named(form: str, make_data, tmp_path: Path) -> None:
    data = make_data(30, samples=40)
    good, suffix = data.y == 1, Path(form).suffix
    FORMS[form](data.X, good, tmp_path / f"one{suffix}")
    if suffix == ".npz":
        np.savez(tmp_path / "two.npz", X=data.X[:, :30], y=good)
    else:
        wide(data.X, good, "FX [{}]").to_csv(tmp_path / "two.csv", index=False)
    assert re.search(rf"Expected .* in one\{suffix} and (in )?two\{suffix}", dengine("data", tmp_path).stderr)


@pytest.mark.parametrize("above", ["{}", "Presse 3\nTeil;7\n\n{}", "[s];[N]\n{}", "{}\ns;N", "a;b\nTeil;7\n{}\n[s];[N]"])
def test_what_a_recorder_writes_around_the_header_is_no_data(above: str, make_data, tmp_path: Path) -> None:
    data = make_data(12, samples=40)
    for i, (x, ok) in enumerate(zip(data.X, data.y, strict=True)):
        rows = [f"{t / 100};{value}" for t, value in enumerate(x.tolist())]
        text = "\n".join([above.format("Zeit;Kraft"), *rows]).replace(".", ",")
        (tmp_path / f"{i:02d}_{'OK' if ok else 'NOK'}.csv").write_text(text)
    found = load_dataset(tmp_path)
    np.testing.assert_array_equal(found.X, data.X)
    assert (found.rate_hz, found.channels, found.faults) == (100.0, ("Kraft",), ())


def test_labels_apart_are_advised_and_given_to_arrays_in_their_order(make_data, tmp_path: Path) -> None:
    data = make_data(30, samples=40)
    np.savez(tmp_path / "force.npz", force=data.X.T)
    table = pd.DataFrame({"row": range(30), "verdict": np.where(data.y == 1, "heil", "Riss")})
    table.to_csv(tmp_path / "checks.csv", index=False)
    found = load_dataset(tmp_path, **as_advised("data", str(tmp_path))[1])
    np.testing.assert_array_equal(found.X, data.X)
    assert abs(found.y.mean() - 0.5) == abs(data.y.mean() - 0.5)  # which word is the good one, a person has to say
    table.iloc[::-1].to_csv(tmp_path / "checks.csv", index=False)
    refused = dengine("data", tmp_path, "--channel", "force", "--labels", tmp_path / "checks.csv")
    assert "in their order, got [29, 28" in refused.stderr


class Told:
    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (Path("run"),)


def test_python_objects_are_not_read_unasked_and_the_error_says_what_to_type(
    make_data, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    np.savez("evil.npz", X=np.array([Told()]), y=[1])
    assert "can run code" in dengine("data", "evil.npz").stderr
    assert not Path("run").exists()
    data, X = make_data(30, samples=40), np.empty(30, object)
    X[:] = [x[: 30 + i % 10] for i, x in enumerate(data.X)]
    np.savez("runs.npz", X=X, y=np.where(data.y == 1, "OK", "NOK").astype(object))
    command = shlex.split(re.findall(r"python -c \".*\"", dengine("data", "runs.npz").stderr)[0])
    subprocess.run([sys.executable, *command[1:]], check=True)
    found = load_dataset("runs.csv")
    assert (found.y.tolist(), found.lengths.tolist()) == (data.y.tolist(), [30 + i % 10 for i in range(30)])


@pytest.mark.parametrize(("good", "bad"), [("OK", "Ausschuss"), ("in Ordnung", "Riss"), ("Gutteil", "kein Gutteil")])
def test_words_are_told_apart_by_the_map_that_the_error_says(good: str, bad: str, make_data, tmp_path: Path) -> None:
    data = make_data(41, samples=40)
    wide(data.X, np.array([bad, good])[data.y]).to_csv(tmp_path / "table.csv", index=False)
    for i, x in enumerate(data.X):
        (folder := tmp_path / "files" / (good if data.y[i] else bad)).mkdir(parents=True, exist_ok=True)
        pd.DataFrame({"FZ": x}).to_csv(folder / f"p{i}.csv", index=False)
    for source in (tmp_path / "files", tmp_path / "table.csv"):
        found = load_dataset(source, **as_advised("data", str(source))[1])
        assert {int(found.y.sum()), 41 - int(found.y.sum())} == {int(data.y.sum()), 41 - int(data.y.sum())}
        assert found.faults == ()


def test_a_row_a_signal_and_an_array_of_channels_are_the_traces_that_they_were(make_data, tmp_path: Path) -> None:
    data = make_data(30, samples=40)
    said, times = np.where(data.y, "heil", "ab"), [f"02.03.2026 06:00:00,{t:03d}" for t in range(0, 400, 10)] * 30
    rows = {"zeitstempel": times, "teil": np.repeat(np.arange(30), 40), "urteil": np.repeat(said, 40)}
    tags = [pd.DataFrame(rows | {"tag": tag, "value": scale * data.X.ravel()}) for tag, scale in (("Z", 1), ("X", -2))]
    asked = {"label": "urteil", "label_map": "heil=good,ab=bad"}
    table = load_dataset(pd.concat(tags), part="teil", time="zeitstempel", channel="Z,X", **asked)
    np.savez(tmp_path / "lab.npz", data=table.X, urteil=said)
    lab, X = load_dataset(tmp_path, channel="data", **asked), np.stack([data.X, -2 * data.X], axis=1)
    np.testing.assert_array_equal(lab.X, X)
    assert (table.rate_hz, table.y.tolist()) == (100.0, data.y.tolist())


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
