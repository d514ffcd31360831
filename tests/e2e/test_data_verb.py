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
from dengine.errors import DataError
from dengine.experiments.figures import data_picture
from dengine.experiments.survey import survey_dataset
from tests.support.command_line import dengine, document, well
from tests.support.recording_forms import NOT_CHECKED
from training.make_recordings import write_plants, write_recordings


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """40 recordings as UR cells make them, three of them broken; beside them those of
    five plants.
    """
    path = tmp_path_factory.mktemp("recordings") / "cell_3"
    write_recordings(path, 40, 3, 0)
    write_plants(path.parent, 60, 0)
    return path


def test_data_says_what_a_folder_is_and_what_is_wrong_with_it(folder: Path, tmp_path: Path) -> None:
    result = well("data", folder, "--channel", "FZ_Base,FX_Base", "--out", tmp_path / "out")
    words = " ".join(result.stdout.replace("│", " ").split())
    text = (
        "traces 38|names FZ_Base, FX_Base|rates low 500,|Left out 2 of 40|The last row is cut off"
    )
    assert [word for word in text.split("|") if word not in words] == []
    assert (tmp_path / "out" / "data.png").stat().st_size > 10_000
    played = well(
        "replay",
        "--data",
        folder,
        "--channel",
        "FZ_Base",
        "--reducer",
        "pca",
        "--cycles",
        30,
        "--repeats",
        1,
    )
    assert played.stderr.count("Left out 2 of 40 recordings of cell_3:") == 1


def test_an_engine_trained_from_a_folder_decides_on_a_raw_recording_of_another_length(
    folder: Path, tmp_path: Path
) -> None:
    store = tmp_path / "engine.db"
    assert (
        document("train", "--data", folder, "--store", store, "--reducer", "pca")["import"][
            "imported"
        ]
        == 38
    )
    assert document("train", "--data", folder, "--store", store)["import"]["repeated"] == 38
    with DataEngine.open(store) as engine:
        assert (engine.trace.fit, engine.trace.columns) == ("pad", ("FZ_Base",))
        frames = [
            pd.read_csv(path) for path in sorted(folder.iterdir()) if len(path.read_bytes()) > 10**5
        ][:3]
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
    survey = document("data", source, *shlex.split(PLANTS[source]))["survey"]
    good = int(load_dataset("insertion").y[np.random.default_rng(0).permutation(1503)[:60]].sum())
    assert (survey["traces"], survey["samples"], survey["good"], survey["faults"]) == (
        60,
        200,
        good,
        [],
    )
    assert survey["rate_hz"] == (None if source in ("wide", "lab") else 100.0)
    done, _ = as_advised(
        "replay", "--data", source, "--reducer", "pca", "--repeats", "1", "--cycles", "60"
    )
    assert "pca on" in done.stdout
    assert (", Windows-1252" in done.stderr) == (source == "latin")


def as_advised(*asked: str) -> tuple[Result, dict[str, str]]:
    """What a command comes to where one types what its errors say, one by one; and what
    that was.
    """
    answer = dict[str, str]()
    while (done := dengine(*asked, *(word for pair in answer.items() for word in pair))).exit_code:
        advice = re.findall(r"(--[a-z-]+) ('[^']*'|\S+?)(?=[.,;]?(?:\s|$))", done.stderr)
        assert set(dict(advice)) - set(answer), done.stderr
        answer |= {name: shlex.split(value)[0] for name, value in advice}
    return done, {name.strip("-").replace("-", "_"): value for name, value in answer.items()}


def long(X: np.ndarray, good: np.ndarray) -> pd.DataFrame:
    """A row a sample; the numbers of parts begin anew in each file."""
    rows = {
        "time": (np.arange(len(X))[:, None] + np.arange(40) / 100).ravel(),
        "serial": np.repeat(np.arange(len(X)), 40),
    }
    return pd.DataFrame(
        rows
        | {"force": X.ravel().astype(float), "verdict": np.repeat(np.where(good, "OK", "NOK"), 40)}
    )


def at_last(table: pd.DataFrame) -> pd.DataFrame:
    """With a verdict in the last row of each part alone."""
    return table.assign(verdict=table["verdict"].where(~table["serial"].duplicated(keep="last")))


def wide(X: np.ndarray, good: np.ndarray, name: str = "s{:03d}_fz") -> pd.DataFrame:
    return pd.DataFrame(X.astype(float), columns=[name.format(i) for i in range(40)]).assign(
        day=1, Urteil=good
    )


FORMS: dict[str, Callable[..., Any]] = {  # what writes a day's file
    "long.parquet": lambda X, good, path: long(X, good).to_parquet(path),
    "long.csv": lambda X, good, path: long(X, good).to_csv(path, index=False),
    "last.csv": lambda X, good, path: at_last(long(X, good)).to_csv(path, index=False),
    "last.parquet": lambda X, good, path: at_last(long(X, good)).to_parquet(path),
    "tags.csv": lambda X, good, path: pd.concat(
        [long(item, good).assign(tag=tag) for tag, item in (("FZ", X), ("MX", -X))]
    ).to_csv(path, index=False),
    "wide.parquet": lambda X, good, path: wide(X, good).to_parquet(path),
    "wide.csv": lambda X, good, path: wide(X, good, "FZ [{}]").to_csv(path, index=False),
    "plain.npz": lambda X, good, path: np.savez(path, X=X, y=good, rate_hz=100.0),
    "named.npz": lambda X, good, path: np.savez(path, force=X, torque=-X, accepted=good),
    "turned.npz": lambda X, good, path: np.savez(path, force=X.T, accepted=good),
}
DAYS = {"day_2": slice(0, 7), "day_10": slice(7, 21), "day_11": slice(21, 30)}


@pytest.mark.parametrize("form", FORMS)
def test_a_folder_of_several_files_of_one_form_is_one_set(
    form: str, make_data, tmp_path: Path
) -> None:
    data = make_data(30, samples=40)
    for day, rows in DAYS.items():
        FORMS[form](data.X[rows], data.y[rows] == 1, tmp_path / f"{day}{Path(form).suffix}")
    dataset = load_dataset(tmp_path, **as_advised("data", str(tmp_path))[1])
    np.testing.assert_array_equal(dataset.X, data.X)
    assert (dataset.y.tolist(), dataset.faults) == (data.y.tolist(), ())


@pytest.mark.parametrize("form", ["wide.csv", "plain.npz"])
def test_files_of_other_forms_in_a_folder_are_both_named(
    form: str, make_data, tmp_path: Path
) -> None:
    data = make_data(30, samples=40)
    good, suffix = data.y == 1, Path(form).suffix
    FORMS[form](data.X, good, tmp_path / f"one{suffix}")
    if suffix == ".npz":
        np.savez(tmp_path / "two.npz", X=data.X[:, :30], y=good)
    else:
        wide(data.X, good, "FX [{}]").to_csv(tmp_path / "two.csv", index=False)
    assert re.search(
        rf"Expected .* in one\{suffix} and (in )?two\{suffix}", dengine("data", tmp_path).stderr
    )


@pytest.mark.parametrize(
    "above", ["{}", "Presse 3\nTeil;7\n\n{}", "[s];[N]\n{}", "{}\ns;N", "a;b\nTeil;7\n{}\n[s];[N]"]
)
def test_what_a_recorder_writes_around_the_header_is_no_data(
    above: str, make_data, tmp_path: Path
) -> None:
    data = make_data(12, samples=40)
    for i, (x, ok) in enumerate(zip(data.X, data.y, strict=True)):
        rows = [f"{t / 100};{value}" for t, value in enumerate(x.tolist())]
        text = "\n".join([above.format("Zeit;Kraft"), *rows]).replace(".", ",")
        (tmp_path / f"{i:02d}_{'OK' if ok else 'NOK'}.csv").write_text(text)
    dataset = load_dataset(tmp_path)
    np.testing.assert_array_equal(dataset.X, data.X)
    assert (dataset.rate_hz, dataset.channels, dataset.faults) == (100.0, ("Kraft",), ())


def test_labels_apart_are_advised_and_given_to_arrays_in_their_order(
    make_data, tmp_path: Path
) -> None:
    data = make_data(30, samples=40)
    np.savez(tmp_path / "force.npz", force=data.X.T)
    table = pd.DataFrame({"row": range(30), "verdict": np.where(data.y == 1, "heil", "Riss")})
    table.to_csv(tmp_path / "checks.csv", index=False)
    dataset = load_dataset(tmp_path, **as_advised("data", str(tmp_path))[1])
    np.testing.assert_array_equal(dataset.X, data.X)
    assert abs(dataset.y.mean() - 0.5) == abs(
        data.y.mean() - 0.5
    )  # which word is the good one, a person has to say
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
    dataset = load_dataset("runs.csv")
    assert (dataset.y.tolist(), dataset.lengths.tolist()) == (
        data.y.tolist(),
        [30 + i % 10 for i in range(30)],
    )


@pytest.mark.parametrize(
    ("good", "bad"),
    [
        ("OK", "Ausschuss"),
        ("in Ordnung", "Riss"),
        ("Gutteil", "kein Gutteil"),
        ("gut, heil", "is a=b"),
    ],
)
def test_words_are_told_apart_by_the_map_that_the_error_says(
    good: str, bad: str, make_data, tmp_path: Path
) -> None:
    data = make_data(41, samples=40)
    wide(data.X, np.array([bad, good])[data.y]).to_csv(tmp_path / "table.csv", index=False)
    for i, x in enumerate(data.X):
        (folder := tmp_path / "files" / (good if data.y[i] else bad)).mkdir(
            parents=True, exist_ok=True
        )
        pd.DataFrame({"FZ": x}).to_csv(folder / f"p{i}.csv", index=False)
    for source in (tmp_path / "files", tmp_path / "table.csv"):
        dataset = load_dataset(source, **as_advised("data", str(source))[1])
        assert {int(dataset.y.sum()), 41 - int(dataset.y.sum())} == {
            int(data.y.sum()),
            41 - int(data.y.sum()),
        }
        assert dataset.faults == ()


def file_each(folder: Path, data: Dataset, name: str, **columns: Callable[[int], Any]) -> None:
    """A file an insertion. name : with i, y, ok, own and k, a number of an attempt, in it.  columns
    : by label.
    """
    for i, (x, y) in enumerate(zip(data.X, data.y.tolist(), strict=True)):
        path = folder / name.format(
            i=i, y=y, ok="OK" if y else "NOK", own="heil" if y else "Riss", k=i // 3 % 2
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        frame = pd.DataFrame({"time": np.arange(len(x)) / 100, "FZ": x})
        frame.assign(**{column: cell(y) for column, cell in columns.items()}).to_csv(
            path, index=False
        )


def listing(
    path: Path, data: Dataset, word: Callable[[int], str], file: str = "insertion_{}.csv"
) -> None:
    rows = [f"{file.format(i)},{word(y)}" for i, y in enumerate(data.y.tolist())]
    path.write_text("\n".join(["file,verdict", *rows]))


def with_listing(folder: Path, data: Dataset, word: Callable[[int], str] = str) -> None:
    file_each(folder, data, "insertion_{i}.csv")
    (folder / "a_sizes.csv").write_text(
        "file,bytes\n" + "\n".join(f"insertion_{i}.csv,{i}" for i in range(30))
    )
    listing(folder / "labels.csv", data, word)


MISTAKES: dict[str, Callable[[Path, Dataset], Any]] = {  # what a person may have in a folder
    "a verdict, then an attempt": lambda path, data: file_each(
        path, data, "part_{i:04d}_{ok}_{k}.csv"
    ),
    "a 1 or a 0 at the end": lambda path, data: file_each(path, data, "part_{i}_{y}.csv"),
    "folders 1 and 0": lambda path, data: file_each(path, data, "{y}/run_{i}.csv"),
    "folders 1 and 0, and attempts": lambda path, data: file_each(
        path, data, "{y}/part_{i}_{k}.csv"
    ),
    "words for all in front": lambda path, data: file_each(
        path, data, "pass_fail_log_{i}_{ok}.csv"
    ),
    "folders with numbers, a verdict in them": lambda path, data: file_each(
        path, data, "part_{i}_{ok}/run_{k}.csv"
    ),
    "words of one's own in a folder": lambda path, data: file_each(
        path, data, "{own}/x/insertion_{i}.csv"
    ),
    "a column of verdicts": lambda path, data: file_each(
        path, data, "data/run_{i}.csv", success=bool
    ),
    "a column of verdicts, and attempts": lambda path, data: file_each(
        path, data, "{i}/run_{k}.csv", Verdict=bool
    ),
    "a column of states": lambda path, data: file_each(
        path, data, "run_{i}.csv", status=int, program=lambda y: 7
    ),
    "a column of words of one's own": lambda path, data: file_each(
        path, data, "run_{i}.csv", crack=["ja", "nix"].__getitem__
    ),
    "a list of files, and another that tells none": with_listing,
    "a list of words of one's own": lambda path, data: with_listing(
        path, data, ["Riss", "heil"].__getitem__
    ),
    "a list of words, some not checked": lambda path, data: with_listing(
        path, data, ["n.i.O.", "i.O."].__getitem__
    ),
    "a long table": lambda path, data: long(data.X, data.y == 1).to_csv(
        path / "t.csv", index=False
    ),
    "a long table whose clock has another name": lambda path, data: (
        long(data.X, data.y == 1)
        .rename(columns={"time": "counter"})
        .to_csv(path / "t.csv", index=False)
    ),
}
ASKED = {"a long table whose clock has another name": ["--part", "serial", "--label", "verdict"]}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_what_an_error_advises_gets_further_as_it_stands_and_no_label_is_wrong(
    mistake: str, make_data, tmp_path: Path
) -> None:
    data = make_data(30, samples=40)
    MISTAKES[mistake](tmp_path, data)
    asked = ASKED.get(mistake, [])
    _, answer = as_advised("data", str(tmp_path), *asked)
    given = {name.strip("-"): value for name, value in zip(asked[::2], asked[1::2], strict=True)}
    dataset = load_dataset(tmp_path, **answer, **given)
    by_trace = {x.tobytes(): y for x, y in zip(data.X, data.y.tolist(), strict=True)}
    agree = [by_trace[x.tobytes()] == y for x, y in zip(dataset.X, dataset.y.tolist(), strict=True)]
    assert (len(dataset), len(set(agree))) == (
        30,
        1,
    )  # which of two words is the good one a person has to say
    assert agree[0] or "label_map" in answer


@pytest.mark.parametrize(
    "options",
    [[], ["--time", "time"], ["--label", "success"], ["--time", "time", "--label", "success"]],
)
def test_a_column_tells_the_labels_of_a_folders_files_whatever_else_is_said(
    options: list[str], make_data, tmp_path: Path
) -> None:
    data = make_data(30, samples=40)
    file_each(tmp_path, data, "{i}/run_{k}.csv", success=bool)
    result = document("data", tmp_path, *options)
    assert (result["survey"]["traces"], result["survey"]["good"]) == (30, int(data.y.sum()))
    assert result["survey"]["names"] == ["FZ"]
    assert result["reading"]["labels"].startswith("column success: ")


def test_without_labels_nothing_is_advised_that_cannot_be_typed(make_data, tmp_path: Path) -> None:
    data = make_data(30, samples=40)
    file_each(tmp_path / "cell" / "data", data, "insertion_{i}.csv")
    (tmp_path / "cell" / "sizes.csv").write_text(
        "name\n" + "\n".join(f"insertion_{i}" for i in range(30))
    )
    long(data.X, data.y == 1).drop(columns="verdict").to_csv(tmp_path / "long.csv", index=False)
    text = " ".join(dengine("data", tmp_path / "cell").stderr.split())
    assert "of 31 have none" in text
    assert re.findall(r"--[a-z-]+ ?[\w'./]*", text) == ["--label", "--labels"]
    wide(data.X, data.y == 1).drop(columns=["day", "Urteil"]).to_csv(
        tmp_path / "wide.csv", index=False
    )
    assert "--label" not in dengine("data", tmp_path / "wide.csv").stderr
    np.savez(tmp_path / "cell.npz", force=data.X)
    (tmp_path / "sizes.csv").write_text("trace,bytes\n0,7\n1,9\n")
    assert "sizes.csv" not in dengine("data", tmp_path / "cell.npz").stderr
    done = dengine("data", tmp_path / "long.csv")
    assert re.search(
        r"--part serial, --time time, and a CSV file of parts and labels \(--labels\)", done.stderr
    ), done.stderr


def test_a_long_table_whose_times_are_not_named_is_told_to_name_them(
    make_data, tmp_path: Path
) -> None:
    data = make_data(30, samples=40)
    long(data.X, data.y == 1).to_csv(tmp_path / "t.csv", index=False)
    done = dengine("data", tmp_path / "t.csv", "--part", "serial", "--label", "verdict")
    assert "a long table needs" in done.stderr
    assert "--time time" in done.stderr
    assert "--part serial" not in done.stderr
    assert "a long one, with a row for each sample, read by --part, --time" in " ".join(
        well("data", "--help").stdout.split()
    )


@pytest.mark.parametrize("empty", NOT_CHECKED, ids=repr)
def test_a_part_without_a_verdict_is_counted_as_unlabelled_and_left_out(
    empty: str, make_data, tmp_path: Path
) -> None:
    data = make_data(15, samples=40)
    words = [("OK" if y else "NOK") if i % 3 == 0 else empty for i, y in enumerate(data.y.tolist())]
    table = pd.DataFrame(data.X.astype(float), columns=[f"FZ_{i}" for i in range(40)]).assign(
        verdict=words
    )
    table.to_csv(tmp_path / "wide.csv", index=False)
    rows = long(data.X, data.y == 1).assign(verdict=np.repeat(words, 40))
    rows.to_csv(tmp_path / "long.csv", index=False)
    for i, x in enumerate(data.X):
        (tmp_path / "column").mkdir(exist_ok=True)
        (tmp_path / "plain").mkdir(exist_ok=True)
        pd.DataFrame({"FZ": x, "verdict": words[i]}).to_csv(
            tmp_path / "column" / f"run_{i}.csv", index=False
        )
        pd.DataFrame({"FZ": x}).to_csv(tmp_path / "plain" / f"run_{i}.csv", index=False)
    (tmp_path / "labels.csv").write_text(
        "file,label\n" + "\n".join(f"run_{i}.csv,{word}" for i, word in enumerate(words))
    )
    np.savez(tmp_path / "x.npz", X=data.X, y=np.array(words), part=np.arange(15))
    sources = {
        "wide.csv": [],
        "long.csv": ["--part", "serial", "--time", "time"],
        "column": [],
        "x.npz": [],
    }
    sources["plain"] = ["--labels", tmp_path / "labels.csv"]
    for source, options in sources.items():
        survey = document("data", tmp_path / source, *options)["survey"]
        assert (survey["traces"], survey["unlabelled"], survey["faults"]) == (5, 10, []), source
        assert survey["good"] == int(data.y[::3].sum())
        assert "10 of 15" in well("data", tmp_path / source, *options).stdout
    played = well(
        "replay",
        "--data",
        tmp_path / "wide.csv",
        "--reducer",
        "pca",
        "--cycles",
        5,
        "--repeats",
        1,
    )
    note = (
        r"10 of 15 recordings of wide have no label yet( \('.*' 10 times\))?: they are left out\."
    )
    assert re.search(note, played.stderr)


def test_numbers_that_are_missing_in_an_array_of_labels_are_unlabelled_and_other_numbers_are_refused(
    make_data,
) -> None:
    data = make_data(30, samples=40)
    y = np.where(np.arange(30) % 3 == 0, data.y, np.nan)
    for labels in (y, pd.Series(y), [None if np.isnan(item) else bool(item) for item in y]):
        dataset = load_dataset((data.X, labels))
        assert (dataset.y.tolist(), dataset.unlabelled) == (data.y[::3].tolist(), 20)
    with pytest.raises(DataError, match=r"Expected labels in data .*, got '-1' 7 times"):
        load_dataset((data.X, 2 * data.y - 1))


@pytest.mark.parametrize(
    ("name", "ordered"),
    [
        ("{ok}/{i}.csv", False),
        ("{ok}_{i}.csv", False),
        ("day_1/{ok}/{i}.csv", False),
        ("{i}_{ok}.csv", True),
    ],
)
def test_files_that_their_labels_put_in_order_have_no_recorded_order_and_no_drift(
    name: str, ordered: bool, make_data, tmp_path: Path
) -> None:
    file_each(tmp_path, make_data(60, samples=40), name)
    result = well("data", tmp_path)
    assert ("with the order" not in result.stdout) or ordered
    assert ("in the order of their labels, not of their recording" in result.stdout) is not ordered
    assert bool(document("data", tmp_path)["survey"]["drift"]) is ordered


@pytest.mark.parametrize(
    ("cell", "shown"),
    [
        ("1234567.8901234567890123N", "123N'"),
        ("0" * 100 + "x" + "0" * 100, "00x00"),
        (
            "0.0123456789012345678901234567\u041e",
            "CYRILLIC CAPITAL LETTER O (U+041E) at character 31",
        ),
        ("10\u200b43.5", "ZERO WIDTH SPACE (U+200B) at character 3"),
    ],
)
def test_an_error_shows_the_character_that_is_wrong(
    cell: str, shown: str, make_data, tmp_path: Path
) -> None:
    data = make_data(12, samples=40)
    file_each(tmp_path, data, "{i}_{ok}.csv")
    path = next(tmp_path.glob("3_*.csv"))
    lines = path.read_text().splitlines()
    lines[5] = f"{lines[5].partition(',')[0]},{cell}"
    path.write_text("\n".join(lines), encoding="utf-8")
    (fault,) = load_dataset(tmp_path).faults
    assert (fault.line, shown in fault.message, len(fault.message) < 200) == (6, True, True), (
        fault.message
    )


def test_a_row_a_signal_and_an_array_of_channels_are_the_traces_that_they_were(
    make_data, tmp_path: Path
) -> None:
    data = make_data(30, samples=40)
    text, times = (
        np.where(data.y, "heil", "ab"),
        [f"02.03.2026 06:00:00,{t:03d}" for t in range(0, 400, 10)] * 30,
    )
    rows = {
        "zeitstempel": times,
        "teil": np.repeat(np.arange(30), 40),
        "urteil": np.repeat(text, 40),
    }
    tags = [
        pd.DataFrame(rows | {"tag": tag, "value": scale * data.X.ravel()})
        for tag, scale in (("Z", 1), ("X", -2))
    ]
    asked = {"label": "urteil", "label_map": "heil=good,ab=bad"}
    table = load_dataset(pd.concat(tags), part="teil", time="zeitstempel", channel="Z,X", **asked)
    np.savez(tmp_path / "lab.npz", data=table.X, urteil=text)
    lab, X = (
        load_dataset(tmp_path, channel="data", **asked),
        np.stack([data.X, -2 * data.X], axis=1),
    )
    np.testing.assert_array_equal(lab.X, X)
    assert (table.rate_hz, table.y.tolist()) == (100.0, data.y.tolist())


def test_what_is_wrong_with_traces_is_counted(make_data: Callable[..., Dataset]) -> None:
    data = make_data(120, samples=60)
    X, y = data.X.copy(), data.y.copy()
    X[3, 5], X[4], X[5, 5] = np.nan, 2.0, -3e38
    X[50], y[50] = X[10], y[10]
    X[51], y[51] = X[11], 1 - y[11]
    X[52:60] = X[20:28] + np.float32(1e-3)
    survey = survey_dataset(replace(data, X=X, y=y))
    assert (survey.not_finite, survey.constant, survey.too_large) == (1, 1, 1)
    assert (survey.duplicates, survey.contradicting) == (2, 1)
    assert 14 <= survey.near_repeats <= 20
    assert survey.looked_at == 117
    assert (survey.good + survey.bad, survey.lengths) == (120, None)
    assert survey_dataset(make_data(120, samples=60)).near_repeats <= 3


def test_drift_is_seen_where_there_is_some_and_only_there(
    make_data: Callable[..., Dataset],
) -> None:
    data = make_data(300, samples=60)
    still = {item.name: item for item in survey_dataset(data).drift}
    assert still["good"].p > 0.01
    assert still["channel 1"].p > 0.01
    rng = np.random.default_rng(1)
    y = (rng.random(300) < np.linspace(1.0, 0.3, 300)).astype(np.int8)
    drifting = replace(data, X=data.X + np.linspace(0, 9, 300)[:, None], y=y)
    moved = {drift.name: drift for drift in survey_dataset(drifting).drift}
    assert moved["good"].p < 1e-4 > moved["channel 1"].p
    assert moved["good"].rho < -0.2 < 0.3 < moved["channel 1"].rho
    flat = survey_dataset(replace(data, y=np.ones(300, dtype=np.int8))).drift[0]
    assert np.isnan([flat.rho, flat.p]).all()
    assert flat.tenths == (1.0,) * 10


@pytest.mark.parametrize(("n", "channels"), [(1, 1), (6, 4), (60, 4)])
def test_a_picture_is_drawn_of_any_data(
    make_data: Callable[..., Dataset], n: int, channels: int
) -> None:
    data = make_data(n, samples=40, channels=channels)
    data.X[0, ..., 3] = np.nan
    assert len(data_picture(data, "x").axes) == min(channels, 3) + 2
