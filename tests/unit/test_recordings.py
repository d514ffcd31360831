"""Recordings as people have them: every form gives the same traces, and what cannot be read is
named and alone is lost.
"""

import itertools
import json
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from dengine import DataEngine, Dataset, TraceSpec, load_dataset
from dengine.datasets.importing import import_labelled
from dengine.datasets.label_names import labels_in_names
from dengine.datasets.labels import means_bad, parse_label_map
from dengine.errors import DataError, TraceError, as_options
from tests.support.command_line import document, line_of
from tests.support.recording_forms import LABEL_FORMS, NOT_CHECKED_NAMES


def write_csv(
    path: Path,
    values: np.ndarray,
    names: tuple[str, ...] = ("FZ_Base",),
    rate_hz: float = 500.0,
    **how: Any,
) -> Path:
    """(C, T) as a file with timestamps."""
    path.parent.mkdir(parents=True, exist_ok=True)
    frame = pd.DataFrame(np.atleast_2d(values).T.astype(np.float64), columns=list(names))
    frame.insert(0, "Timestamp", 17.0 + np.arange(len(frame)) / rate_hz)
    frame.to_csv(path, index=False, **how)
    return path


def write_folder(folder: Path, data: Dataset, **how: Any) -> Path:
    for i, (x, y) in enumerate(zip(data.X, data.y, strict=True)):
        write_csv(
            folder / f"insertion_{i + 1}_{bool(y)}.csv", x, data.channels or ("FZ_Base",), **how
        )
    return folder


def wide(data: Dataset) -> pd.DataFrame:
    names = [f"FZ_{i}" for i in range(data.X.shape[1])]
    return pd.DataFrame(data.X.astype(np.float64), columns=names).assign(label=words(data))


@pytest.fixture(scope="module")
def small(make_data: Callable[..., Dataset]) -> Dataset:
    return make_data(24, samples=50)


def words(data: Dataset) -> np.ndarray:
    return np.where(data.y == 1, "OK", "NOK")


def written(path: Path, write: Callable[[Path], Any]) -> Path:
    write(path)
    return path


EXCEL = {"sep": ";", "decimal": ",", "encoding": "utf-8-sig", "lineterminator": "\r\n"}
FORMS: dict[str, Callable[[Dataset, Path], Any]] = {
    "folder": lambda data, tmp: write_folder(tmp / "cell", data),
    "semicolons": lambda data, tmp: write_folder(tmp / "excel", data, **EXCEL),
    "tabs": lambda data, tmp: write_folder(tmp / "tabs", data, sep="\t"),
    "wide csv": lambda data, tmp: written(
        tmp / "wide.csv", lambda path: wide(data).to_csv(path, index=False)
    ),
    "wide excel": lambda data, tmp: written(
        tmp / "wide.csv", lambda path: wide(data).to_csv(path, index=False, **EXCEL)
    ),
    "parquet": lambda data, tmp: written(tmp / "wide.parquet", wide(data).to_parquet),
    "frame": lambda data, tmp: wide(data),
    "npz": lambda data, tmp: written(
        tmp / "data.npz", lambda path: np.savez(path, X=data.X, y=data.y)
    ),
    "words": lambda data, tmp: (data.X, words(data)),
    "npz of words": lambda data, tmp: written(
        tmp / "data.npz", lambda path: np.savez(path, X=data.X, y=words(data))
    ),
    "list": lambda data, tmp: (list(data.X), [bool(y) for y in data.y]),
    "series": lambda data, tmp: ([pd.Series(x) for x in data.X], data.y),
    "frames": lambda data, tmp: (
        [pd.DataFrame({"Timestamp": np.arange(x.size) / 500, "FZ_Base": x}) for x in data.X],
        ["ok" if y else "nok" for y in data.y],
    ),
}


HERTZ = dict.fromkeys(("folder", "semicolons", "tabs", "frames"), 500.0)  # of those that have times


@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_the_same_traces_and_labels(
    form: str, small: Dataset, tmp_path: Path
) -> None:
    data = load_dataset(source := FORMS[form](small, tmp_path))
    np.testing.assert_array_equal(data.X, small.X)
    np.testing.assert_array_equal(data.y, small.y)
    assert (data.X.dtype, data.y.dtype, data.fit, data.faults) == (
        np.float32,
        np.int8,
        "strict",
        (),
    )
    assert data.rate_hz == HERTZ.get(form)
    assert data.spec.samples == 50
    np.testing.assert_array_equal(load_dataset(source, samples=30).X, small.X[:, :30])


def test_several_channels_are_picked_by_name_in_any_order(
    make_data: Callable[..., Dataset], tmp_path: Path
) -> None:
    data = make_data(6, samples=40, channels=3)
    names = ("FX_Base", "FY_Base", "FZ_Base")
    folder = write_folder(tmp_path / "cell", Dataset(data.X, data.y, channels=names))
    both = load_dataset(folder, channel="FZ_Base,FX_Base")
    np.testing.assert_array_equal(both.X, data.X[:, [2, 0]])
    assert (both.channels, both.spec.channels, both.spec.columns) == (
        ("FZ_Base", "FX_Base"),
        2,
        ("FZ_Base", "FX_Base"),
    )
    np.testing.assert_array_equal(
        load_dataset(folder).X, data.X[:, 2]
    )  # the force along the insertion
    np.testing.assert_array_equal(load_dataset(both, channel="FX_Base").X, data.X[:, 0])
    columns = {f"{name}_{i}": data.X[:, c, i] for c, name in enumerate(names) for i in range(40)}
    table = pd.DataFrame(columns).assign(y=data.y)
    np.testing.assert_array_equal(load_dataset(table, channel="FZ_Base,FX_Base").X, both.X)


ROWS = (
    write_csv(Path(tempfile.mkdtemp()) / "x.csv", np.linspace(0.0, 20.0, 40))
    .read_text()
    .splitlines()
)
TIME, CELL = ROWS[7].split(",")
# file -> its lines among good ones, the fault's line and words
BROKEN: dict[str, tuple[list[str], int, str]] = {
    "text_True.csv": (
        [*ROWS[:7], f"{TIME},12N", *ROWS[8:]],
        8,
        "Expected a number in column FZ_Base, got '12N'",
    ),
    "short_row_True.csv": ([*ROWS[:-2], "17.0", ROWS[-1]], 40, "Expected 2 columns, got 1"),
    "long_row_True.csv": ([*ROWS[:5], ROWS[5] + ",1", *ROWS[6:]], 6, "Expected 2 columns, got 3"),
    "header_False.csv": (ROWS[:1], 1, "Expected samples below the header, found none"),
    "aborted_False.csv": (
        ["Device,Press 4", "Status,Aborted", "", "Timestamp,FZ_Base", "s,N"],
        *(4, "Expected samples below the header, found none"),
    ),
    "back_True.csv": (
        [*ROWS[:20], "", ROWS[19].split(",")[0] + ",7", *ROWS[20:]],
        22,
        "Expected a later time than that of the row before, or a stated rate (rate_hz); "
        "lines 20 and 22 have the same time, and 9.23077 and 7",
    ),
    "gap_True.csv": (
        [*ROWS[:10], *ROWS[25:]],
        11,
        "Expected a step of 0.002 s in time, got a gap of 0.032 s",
    ),
    "too_short_True.csv": (ROWS[:12], 0, "Expected 20 to 80 samples, to pad them to 40, got 11"),
    "no_word.csv": (ROWS, 0, "Expected a label at the end of the name"),
    "twice_True.csv": (
        [f"{row},{row.split(',')[1]}" for row in ROWS],
        1,
        "Expected a column FZ_Base, got it twice or more",
    ),
    "late_True.csv": (
        [*ROWS[:8], f"late,{CELL}", *ROWS[9:]],
        9,
        "Expected a time in column Timestamp, in seconds or",
    ),
    "empty_True.csv": ([], 0, "Expected a header and rows, it is empty"),
    "no_force_True.csv": (
        [row.replace("FZ", "FX") for row in ROWS],
        1,
        "Expected a column FZ_Base, got Timestamp, FX",
    ),
    "latin_OK.csv": (
        [*ROWS[:3], "0,1 \xb5m", *ROWS[3:]],
        4,
        "Expected a number in column FZ_Base, got '1 µm'",
    ),
    "slow_True.csv": (
        [ROWS[0], *(f"{i / 250},{CELL}" for i in range(40))],
        *(0, "Expected timestamps at 500 Hz, as the others have, got 250 Hz"),
    ),
}


def test_each_fault_is_named_with_file_and_line_and_nothing_else_is_lost(
    make_data, tmp_path: Path
) -> None:
    data = make_data(30, samples=40)
    write_folder(tmp_path, data)
    for name, (rows, *_) in BROKEN.items():
        (tmp_path / name).write_bytes("\n".join([*rows, ""]).encode("latin-1"))
    loaded = load_dataset(tmp_path)
    assert {f.source for f in loaded.faults} == set(BROKEN)
    for fault in loaded.faults:
        assert fault.line == BROKEN[fault.source][1], fault
        assert fault.message.startswith(BROKEN[fault.source][2]), fault
    np.testing.assert_array_equal(loaded.X, data.X)


NO_LABELS = (
    "insertion_0001.csv, run_10.csv, run_1.csv, part_003/run_0.csv, 1/7.csv, token.csv, smoke_3.csv, okuma.csv, "
    "Broken.csv, ok_then.csv, maybe.csv, part_no_7.csv, io_link.csv, nation.csv, badge_1.csv, gutter.csv, "
    "compass.csv, passage_0.csv"
)
CONTRADICTIONS = (
    "good/x_NOK.csv, bad/1/x_ok_2.csv, x_OK_NOK.csv, x_NOK_OK_1.csv, pass_fail_log_7_OK.csv, ok_not_ok.csv, "
    "good/bad/7.csv, good/nok_sensor.csv, NOK_7/OK/x_true_NG.csv"
)


@pytest.mark.parametrize("form", LABEL_FORMS)
def test_a_label_is_read_from_a_name_or_its_folder_as_people_write_them(form: str) -> None:
    good, bad = LABEL_FORMS[form]
    assert [name for name in good if labels_in_names().find(name).label != 1] == []
    assert [name for name in bad if labels_in_names().find(name).label != 0] == []


@pytest.mark.parametrize("name", NO_LABELS.split(", "))
def test_a_number_or_a_part_of_another_word_is_no_label(name: str) -> None:
    with pytest.raises(DataError, match="Expected a label at the end of the name"):
        labels_in_names().find(name)


@pytest.mark.parametrize("name", CONTRADICTIONS.split(", "))
def test_two_labels_in_a_name_that_contradict_each_other_are_an_error(name: str) -> None:
    with pytest.raises(DataError, match=r"Expected one label.*contradict each other.*\(label\)"):
        labels_in_names().find(name)


def as_folder(cells: list[object], column: str, tmp: Path) -> tuple[Path, dict[str, str]]:
    for i, cell in enumerate(cells):
        path = write_csv(tmp / f"{i}.csv", np.arange(30.0) + i)
        pd.read_csv(path).assign(**{column: cell}).to_csv(path, index=False)
    return tmp, {"label": column}


def as_wide(cells: list[object], column: str) -> pd.DataFrame:
    return pd.DataFrame(
        {f"FZ_{i}": np.arange(len(cells)) + i + 0.0 for i in range(30)}, range(len(cells))
    ).assign(**{column: cells})


def as_long(cells: list[object], column: str) -> pd.DataFrame:
    rows = [
        (part, i / 100, 1.0 * i + part, cell) for part, cell in enumerate(cells) for i in range(30)
    ]
    return pd.DataFrame(rows, columns=["part", "time", "FZ", column])


def as_listing(cells: list[object], column: str, tmp: Path) -> tuple[Path, dict[str, Any]]:
    for i in range(len(cells)):
        write_csv(tmp / "data" / f"{i}.csv", np.arange(30.0) + i)
    rows: dict[str, Any] = {"file": range(len(cells)), column: cells}
    if means_bad(column):  # it is found among others
        rows["operator"] = "Jim"
    path = written(tmp / "l.csv", lambda path: pd.DataFrame(rows).to_csv(path, index=False))
    return tmp / "data", {"labels": path}


# A form of recordings -> writes them with a label in each cell, and returns the source and options.
IN_COLUMN: dict[str, Callable[[list[object], str, Path], tuple[Any, dict[str, Any]]]] = {
    "folder": as_folder,
    "listing": as_listing,
    "frame": lambda cells, column, tmp: (as_wide(cells, column), {"label": column}),
    "wide": lambda cells, column, tmp: (
        written(tmp / "a.csv", lambda path: as_wide(cells, column).to_csv(path, index=False)),
        {"label": column},
    ),
    "parquet": lambda cells, column, tmp: (
        written(tmp / "a.parquet", as_wide(cells, column).to_parquet),
        {"label": column},
    ),
    "long": lambda cells, column, tmp: (
        written(tmp / "a.csv", lambda path: as_long(cells, column).to_csv(path, index=False)),
        {"label": column, "time": "time"},
    ),
    "npz": lambda cells, column, tmp: (
        written(
            tmp / "a.npz",
            lambda path: np.savez(path, X=np.ones((len(cells), 30)), **{column: np.array(cells)}),
        ),
        {"label": column},
    ),
}
AMBIGUOUS = {  # the name of a column that means no outcome -> its cells
    "error_code": [1, 0, 0],
    "crack": ["yes", "no", "no"],
    "leak": [True, False, False],
    "pass_fail": [1, 0, 0],
    "割れ": [1.0, 0.0, 0.0],
}


@pytest.mark.parametrize("form", IN_COLUMN)
@pytest.mark.parametrize("column", AMBIGUOUS)
def test_true_in_a_column_that_means_neither_outcome_is_asked_for(
    form: str, column: str, tmp_path: Path
) -> None:
    source, options = IN_COLUMN[form](AMBIGUOUS[column], column, tmp_path)
    text = f"of known meaning, which the name of column {column} does not tell"
    with pytest.raises(DataError, match=text) as caught:
        load_dataset(source, **options)
    label_map = re.search(r"label_map='([^']*)' or the other way round", str(caught.value))[1]
    first, second = load_dataset(source, **options, label_map=label_map).y[:2].tolist()
    assert {first, second} == {0, 1}
    assert dict(pair.split("=") for pair in label_map.split(","))[str(AMBIGUOUS[column][0])] == (
        "good" if first else "bad"
    )


# The name of a column -> cells of it that mean bad, good, good.
FLAGS: dict[str, tuple[list[object], bool]] = {
    "failed": ([True, False, False], True),
    "Defect": ([1, 0, 0], True),
    "reject": (["yes", "no", "no"], True),
    "NG": (["y", "n", "n"], True),
    "is_scrap": ([1.0, 0.0, 0.0], True),
    "part fault": (["TRUE", "FALSE", "FALSE"], True),
    "error": ([1, 0, 0], True),
    "Ausschuss": (["ja", "nein", "nein"], True),
    "n.i.O.": ([1, 0, 0], True),
    "fehler": (["Ja", "Nein", "Nein"], True),
    "rebut": (["oui", "non", "non"], True),
    "Failed": (["NOK", "OK", "OK"], False),
    "reject_flag": (["bad", "good", "good"], False),
    "fault": (["fail", "pass", "pass"], False),
    "passed": ([False, True, True], False),
    "not_failed": ([0, 1, 1], False),
    "error_free": (["no", "yes", "yes"], False),
}


@pytest.mark.parametrize("form", IN_COLUMN)
@pytest.mark.parametrize("column", FLAGS)
def test_true_is_bad_in_a_column_that_tells_what_is_bad(
    form: str, column: str, tmp_path: Path
) -> None:
    cells, is_inverted = FLAGS[column]
    source, options = IN_COLUMN[form](cells, column, tmp_path)
    data = load_dataset(source, **options)
    assert (data.y.tolist(), data.faults) == ([0, 1, 1], ())
    assert any(f"Column {column} tells what is bad" in note for note in data.notes) == is_inverted


def test_a_label_map_is_taken_as_typed_whatever_the_column_is_called(tmp_path: Path) -> None:
    source, options = as_folder(["yes", "no"], "reject", tmp_path)
    data = load_dataset(source, **options, label_map="yes=good,no=bad")
    assert data.y.tolist() == [1, 0]
    assert not any("tells what is bad" in note for note in data.notes)


# File -> what its column `verdict` says, its label, and what the fault says if both contradict.
NAMES_AND_COLUMNS: dict[str, tuple[str, int | None, str]] = {
    "joint00_pass1.csv": (
        "NOK",
        None,
        "its name says good (pass), its column verdict says bad (NOK)",
    ),
    "03_first_pass.csv": (
        "nok",
        None,
        "its name says good (pass), its column verdict says bad (nok)",
    ),
    "IO_007.csv": ("n.i.O.", None, "its name says good (IO), its column verdict says bad (n.i.O.)"),
    "007_OK.csv": ("NOK", None, "its name says good (OK), its column verdict says bad (NOK)"),
    "007_NOK.csv": ("OK", None, "its name says bad (NOK), its column verdict says good (OK)"),
    "good/007.csv": ("NOK", None, "its folder says good (good), its column verdict says bad (NOK)"),
    "1_OK.csv": ("OK", 1, ""),
    "2_NOK.csv": ("nok", 0, ""),
    "3_OK.csv": ("pending", 1, ""),
    "4_OK.csv": (
        "rework",
        None,
        "got 'rework' in its column verdict, where its name says good (OK); say what it means, or",
    ),
    "5.csv": ("OK", 1, ""),
    "6.csv": ("NOK", 0, ""),
    "8_OK.csv": ("OK", 1, ""),
    "9_OK.csv": ("OK", 1, ""),
}


def write_verdicts(folder: Path) -> None:
    for i, (name, (verdict, *_)) in enumerate(NAMES_AND_COLUMNS.items()):
        path = write_csv(folder / name, np.arange(30.0) + i)
        pd.read_csv(path).assign(verdict=verdict).to_csv(path, index=False)


def test_a_name_and_a_column_that_contradict_each_other_are_a_fault_that_names_both(
    tmp_path: Path,
) -> None:
    write_verdicts(tmp_path)
    data = load_dataset(tmp_path)
    faults = {fault.source: fault.message for fault in data.faults}
    labels = dict(zip(map(str, data.source), data.y.tolist(), strict=True))
    for name, (_, label, message) in NAMES_AND_COLUMNS.items():
        assert labels.get(name) == label, name
        assert message in faults.get(name, ""), name
        assert (label is None) == ("to trust: label='verdict'" in faults.get(name, "")), name
    assert "Its name tells no label: that of its column verdict is taken (2 times)." in data.notes
    assert "Its column verdict tells no label: that of its name is taken." in data.notes


@pytest.mark.parametrize(
    ("label", "expected"), [("verdict", (5, 7)), (r"(NOK|OK|pass|IO|good)[\d_]*(?:[.]|/)", (10, 2))]
)
def test_the_user_says_whether_a_name_or_its_column_is_to_be_trusted(
    label: str, expected: tuple[int, int], tmp_path: Path
) -> None:
    write_verdicts(tmp_path)
    data = load_dataset(tmp_path, label=label, channel="FZ_Base")
    assert (data.y.sum(), (data.y == 0).sum()) == expected


def test_a_column_without_labels_is_a_channel_beside_names_that_state_them(tmp_path: Path) -> None:
    for i, name in enumerate(("1_OK.csv", "2_NOK.csv")):
        write_csv(tmp_path / name, np.arange(30.0) + i, ("result",))
    data = load_dataset(tmp_path)
    assert (data.channels, data.y.tolist()) == (("result",), [1, 0])


def test_a_number_is_a_label_of_a_name_where_somebody_says_so_and_never_against_a_word() -> None:
    source_of_labels = labels_in_names(None, {"1": True, "0": False})
    assert [
        source_of_labels.find(name).label
        for name in ("run_1.csv", "part_003/run_0.csv", "1/7.csv", "0/a.csv", "x-1.csv")
    ] == [
        1,
        0,
        1,
        0,
        1,
    ]
    assert source_of_labels.find("part_0001_OK_1.csv").label == 1
    with pytest.raises(DataError, match="contradict"):
        source_of_labels.find("part_0001_NOK_1.csv")
    with pytest.raises(DataError, match="at the end of the name"):
        source_of_labels.find("run_11.csv")


@pytest.mark.parametrize(
    "label_map",
    [
        "conforme=good,non conforme=bad",
        "conforme=good,non_conforme=bad",
        "non-conforme=bad,conforme=good",
        "conforme=good",
    ],
)
@pytest.mark.parametrize("form", ["{}_non_conforme.csv", "non conforme/{}.csv"])
def test_a_word_of_the_user_is_found_with_any_marks_in_it_and_a_not_reverses_it(
    label_map: str, form: str
) -> None:
    source = labels_in_names(None, parse_label_map(label_map))
    assert source.find("piece_7_conforme.csv").label == 1
    assert source.find(form.format("piece_7")).label == 0


def test_labels_come_from_folders_a_pattern_or_a_file(small: Dataset, tmp_path: Path) -> None:
    names = []
    rows = []
    for i, (x, y) in enumerate(zip(small.X, small.y, strict=True)):
        write_csv(tmp_path / "sorted" / ("good" if y else "bad") / f"{i}.csv", x)
        write_csv(tmp_path / "coded" / f"{i}_{'q1' if y else 'q0'}_cell3.csv", x)
        names.append(write_csv(tmp_path / "plain" / f"{i}.csv", x).name)
        rows.append(
            {
                "file": names[-1],
                "operator": "a",
                "result": "pass" if y else "fail",
                "part": f"P{i // 2}",
            }
        )
    pd.DataFrame(rows).to_csv(tmp_path / "plain" / "labels.csv", index=False)
    order = [int(p.split("/")[1][:-4]) for p in load_dataset(tmp_path / "sorted").source]
    assert load_dataset(tmp_path / "sorted").y.tolist() == small.y[order].tolist()
    assert load_dataset(tmp_path / "coded", label="_q([01])_").y.tolist() == small.y.tolist()
    listed = load_dataset(tmp_path / "plain", labels=tmp_path / "plain" / "labels.csv")
    assert listed.y.tolist() == small.y.tolist()
    assert listed.part.tolist() == [f"P{i // 2}" for i in range(24)]
    assert listed.faults == ()


def test_a_labels_file_that_does_not_fit_is_named_line_by_line(
    small: Dataset, tmp_path: Path
) -> None:
    for i, x in enumerate(small.X[:8]):
        write_csv(tmp_path / "cell" / f"{i}.csv", x)
    rows = [
        "0.csv,OK",
        "1,NOK",
        "2.csv,perhaps",
        "3.csv",
        "ghost.csv,OK",
        "4.csv,OK",
        "4.csv,NOK",
        "5.csv,1",
        "6.csv,0",
    ]
    (tmp_path / "labels.csv").write_text("\n".join(["file,label", *rows]) + "\n")
    data = load_dataset(tmp_path / "cell", labels=tmp_path / "labels.csv")
    assert (data.source.tolist(), data.y.tolist()) == (
        [f"{i}.csv" for i in (0, 1, 5, 6)],
        [1, 0, 1, 0],
    )
    places = [(f.source, f.line) for f in data.faults]
    assert places == [
        ("labels.csv", 5),
        ("labels.csv", 6),
        ("2.csv", 0),
        ("3.csv", 0),
        ("4.csv", 0),
        ("7.csv", 0),
    ]
    assert "in labels.csv, line 4" in data.faults[2].message
    assert "Expected one label in labels.csv, lines 7, 8, got OK, NOK" in data.faults[4].message


def test_a_listing_with_a_row_for_each_characteristic_is_read_if_its_rows_agree(
    small: Dataset, tmp_path: Path
) -> None:
    rows = []
    for i, y in enumerate(small.y[:6]):
        write_csv(tmp_path / "cell" / f"{i}.csv", small.X[i])
        word = "i.O." if y else "n.i.O."
        rows += [f"{i}.csv,Kraft,{word}", f"{i}.csv,Weg,{'n.i.O.' if i == 2 else word}"]
        rows.append(f"{i}.csv,Maß,{'i.O.' if i == 2 else ''}")
    (tmp_path / "l.csv").write_text("\n".join(["Datei,Merkmal,Ergebnis", *rows]), "utf-8")
    data = load_dataset(tmp_path / "cell", labels=tmp_path / "l.csv")
    assert data.y.tolist() == small.y[[0, 1, 3, 4, 5]].tolist()
    assert [f.source for f in data.faults] == ["2.csv"]
    assert "lines 8, 9, 10, got" in data.faults[0].message
    assert "l.csv names recordings more than once: their labels must be equal." in data.notes


PATHS = [
    "run_0.csv",
    "./sub/Run_1.csv",
    "C:\\data\\sub\\Run_2.CSV",
    "/old/cell/sub/Run_3.csv",
    "Run_4",
    '"sub/Run_5.csv"',
]
NAMED = [f"{file},{'nok' if i % 2 else 'ok'}" for i, file in enumerate(PATHS)]
LISTS = {
    "a header": ["note,path,verdict", *(f'"a, b",{row}' for row in NAMED)],
    "no header": NAMED,
    "names of its own": ["Prüfer,Seriennummer,Urteil", *(f"Kim,{row}" for row in NAMED)],
    "one known name": ["verdict,Datei", *(f"{'nok' if i % 2 else 'ok'},run_{i}" for i in range(6))],
}


@pytest.mark.parametrize("form", LISTS)
def test_a_labels_file_names_recordings_as_people_write_paths(
    form: str, small: Dataset, tmp_path: Path
) -> None:
    for i, x in enumerate(small.X[:6]):
        write_csv(tmp_path / "cell" / "sub" / f"Run_{i}.CSV", x)
    (tmp_path / "labels.csv").write_text("\n".join(LISTS[form]))
    data = load_dataset(tmp_path / "cell", labels=tmp_path / "labels.csv")
    assert (data.y.tolist(), data.faults) == ([1, 0] * 3, ())


@pytest.fixture(scope="module")
def uneven() -> tuple[list[np.ndarray], list[int]]:
    rng = np.random.default_rng(0)
    return [np.linspace(0.0, 20.0, n) + rng.normal(0, 0.1, n) for n in rng.integers(90, 111, 15)], [
        1,
        0,
        1,
    ] * 5


@pytest.mark.parametrize("fit", ["cut", "pad", "resample"])
def test_lengths_are_fitted_in_a_file_as_they_are_live(
    fit: str, uneven: tuple[list[np.ndarray], list[int]]
) -> None:
    data = load_dataset(uneven, fit=fit)
    lengths = [len(x) for x in uneven[0]]
    assert data.X.shape == (15, min(lengths) if fit == "cut" else int(np.median(lengths)))
    assert data.lengths.tolist() == lengths
    with DataEngine("pca", trace=data.spec) as engine:
        for i, x in enumerate(uneven[0]):
            kept = engine.store.get_decision(engine.decide(x).id).trace
            np.testing.assert_array_equal(kept, data.X[i : i + 1])


def test_unasked_lengths_that_differ_are_padded_and_never_resampled(
    uneven: tuple[list[np.ndarray], list[int]],
) -> None:
    assert load_dataset(uneven).fit == "pad"
    short = load_dataset(uneven, samples=60)
    assert (short.spec, short.X.shape) == (TraceSpec(60, fit="cut", unit="units"), (15, 60))
    with pytest.raises(
        DataError,
        match=r"Expected recordings of one length, got 9\d to 110 samples; choose fit='pad'",
    ):
        load_dataset(uneven, fit="strict")


def test_what_cannot_honestly_be_fitted_is_a_fault(
    uneven: tuple[list[np.ndarray], list[int]],
) -> None:
    X = [*uneven[0], np.ones(20), np.ones(300), np.array([])]
    y = [*uneven[1], 1, 1, 1]
    data = load_dataset((X, y))
    assert len(data) == 15
    assert [(f.source, f.line) for f in data.faults] == [
        ("data", 18),
        ("trace 16", 0),
        ("trace 17", 0),
    ]
    assert np.isfinite(data.X).all()
    with pytest.raises(DataError, match="found none of 18"):
        load_dataset((X, y), samples=5000)


DAY = pd.Timestamp("2026-03-01 12:00:00")
STEPS = np.arange(50)
CLOCKS = {  # name -> its times, and hertz
    "Timestamp": (1000 + STEPS * 0.004, 250.0),
    "time_ms": (STEPS * 4, 250.0),
    "time [us]": (STEPS * 4000.0, 250.0),
    "t": (1.7e12 + STEPS * 4.0, 250.0),  # milliseconds of the day's clock
    "Time": (DAY + pd.to_timedelta(STEPS * 4, unit="ms"), 250.0),
    **{"Time." + str(i): (STEPS * step, 1 / (step * unit)) for i, (step, unit) in enumerate(
        ((2, 1e-3), (8, 1e-3), (2000, 1e-6), (2_000_000, 1e-9), (0.02, 1)))},  # no unit: what a recorder may count
}  # fmt: skip


@pytest.mark.parametrize("name", CLOCKS)
def test_timestamps_tell_the_rate_whatever_their_unit(name: str, tmp_path: Path) -> None:
    pd.DataFrame({name: CLOCKS[name][0], "FZ_Base": np.sin(STEPS)}).to_csv(
        tmp_path / "a_OK.csv", index=False
    )
    data = load_dataset(tmp_path)
    assert (data.rate_hz, data.channels) == (pytest.approx(CLOCKS[name][1]), ("FZ_Base",))
    assert load_dataset(tmp_path, rate_hz=100.0).rate_hz == 100.0


def test_rows_of_a_table_that_cannot_be_read_are_named(small: Dataset, tmp_path: Path) -> None:
    path = FORMS["wide csv"](small, tmp_path)
    lines = path.read_text().splitlines()
    lines[3] = lines[3].rsplit(",", 5)[0]  # truncated
    lines[6] = "abc," + lines[6].split(",", 1)[1]
    lines[9] = lines[9].rsplit(",", 1)[0] + ",perhaps"
    lines[12] = "," + lines[12].split(",", 1)[1]  # an empty cell is a NaN, for the engine to find
    path.write_text("\n".join(lines) + "\n")
    data = load_dataset(path)
    assert [(f.source, f.line) for f in data.faults] == [
        ("wide.csv", 4),
        ("wide.csv", 7),
        ("wide.csv", 10),
    ]
    assert "Expected 51 columns, got 46" in data.faults[0].message
    assert "Expected a number in column FZ_0, got 'abc'" in data.faults[1].message
    kept = [i for i in range(24) if i not in (2, 5, 8)]
    np.testing.assert_array_equal(data.y, small.y[kept])
    expected = small.X[kept].copy()
    expected[kept.index(11), 0] = np.nan
    np.testing.assert_array_equal(data.X, expected)
    assert data.source[kept.index(11)] == "wide.csv, line 13"


@pytest.fixture
def few(small: Dataset, tmp_path: Path) -> Path:
    """Four recordings of one channel."""
    return write_folder(tmp_path / "cell", Dataset(small.X[:4], small.y[:4]))


def test_a_header_is_found_in_any_case_and_a_comma_at_the_end_of_lines_is_no_column(
    few: Path, small: Dataset
) -> None:
    for path, (head, row) in zip(
        sorted(few.iterdir()), (("", ""), (",", ","), ("", ","), (",", "")), strict=True
    ):
        first, *lines = path.read_text(encoding="utf-8").splitlines()
        path.write_text("\n".join([first.lower() + head, *(line + row for line in lines)]) + "\n")
    data = load_dataset(few)
    np.testing.assert_array_equal(data.X, small.X[:4])
    assert data.faults == ()
    np.testing.assert_array_equal(load_dataset(few, channel="fz_base").X, small.X[:4])


def test_hidden_folders_are_not_looked_into_and_a_link_to_nothing_is_a_fault(
    few: Path, small: Dataset
) -> None:
    write_csv(few / ".ipynb_checkpoints" / "x_True.csv", small.X[5])
    write_csv(few / "__MACOSX" / "._x_True.csv", small.X[5])
    (few / "readme.txt").write_text("of cell 3")
    (few / "y_True.csv").mkdir()
    (few / "z_True.csv").symlink_to(few / "gone.csv")
    data = load_dataset(few)
    np.testing.assert_array_equal(data.X, small.X[:4])
    assert [f.source for f in data.faults] == ["z_True.csv"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, r"4 of 4 have none.*give the pattern of it in the path \(label\), or list the files"),
        ({"label": "("}, "regular expression"),
        ({"label": "ok"}, "one group"),
        (
            {"labels": True},
            r"4 of 4 have none.*labels\.csv names OK, NOK: call its columns file and label",
        ),
        ({"labels": True, "part": "workpiece"}, "Expected a column workpiece of parts' numbers in"),
        (
            {"labels": True, "label": "_(OK)_"},
            r"a column _\(OK\)_ of labels in .*, got a, b; leave it out \(label\)",
        ),
        ({"part": "workpiece"}, "Expected a file of labels with a column workpiece"),
    ],
)
def test_where_a_folders_labels_are_not_is_said(
    small: Dataset, tmp_path: Path, options: dict, words: str
) -> None:
    for i, x in enumerate(small.X[2:6], start=2):
        write_csv(tmp_path / "cell" / f"run_{i}.csv", x)
    (tmp_path / "labels.csv").write_text("a,b\nOK,1\nNOK,2\n")
    with pytest.raises(DataError, match=words):
        load_dataset(
            tmp_path / "cell",
            **(options | ({"labels": tmp_path / "labels.csv"} if "labels" in options else {})),
        )


def test_parts_keep_their_whole_names_and_a_row_without_one_is_a_part_of_its_own(
    small: Dataset,
) -> None:
    names = [None, *(f"P{i // 2}" for i in range(1, 24))]
    table = wide(small).rename(columns={"label": "Height check"}).assign(workpiece=names)
    data = load_dataset(table, part="workpiece", label="Height check")
    np.testing.assert_array_equal(data.X, small.X)
    assert data.part.tolist() == ["row, line 1", *names[1:]]
    numbers = [np.nan, *(float(i) for i in range(1, 24))]
    assert load_dataset(wide(small).assign(part=numbers)).part.tolist() == [
        "row, line 1",
        *map(str, range(1, 24)),
    ]


def test_a_row_whose_last_cells_are_empty_is_a_shorter_trace(
    small: Dataset, tmp_path: Path
) -> None:
    table = wide(small)
    lengths = [45 + i % 6 for i in range(24)]
    for i, length in enumerate(lengths):
        table.iloc[i, length:50] = np.nan
    table.to_csv(tmp_path / "wide.csv", index=False)
    for source in (table, tmp_path / "wide.csv"):
        data = load_dataset(source)
        assert (data.fit, data.lengths.tolist(), data.X.shape) == ("pad", lengths, (24, 47))
        assert np.isfinite(data.X).all()
        np.testing.assert_array_equal(
            data.X,
            load_dataset(([x[:n] for x, n in zip(small.X, lengths, strict=True)], small.y)).X,
        )


REFUSED: dict[str, tuple[Callable[[Dataset, Path], Any], str]] = {
    "a sample left out": (
        lambda data, tmp: wide(data).drop(columns="FZ_5"),
        "after FZ_4 comes FZ_6",
    ),
    "columns twice": (
        lambda data, tmp: pd.concat([wide(data), wide(data)], axis=1),
        "Expected each column once",
    ),
    "no header": (
        lambda data, tmp: written(
            tmp / "bare.csv", lambda path: wide(data).to_csv(path, index=False, header=False)
        ),
        "its first line is of numbers",
    ),
    "recordings without a header": (
        lambda data, tmp: (
            write_folder(tmp / "bare", Dataset(data.X[:3], data.y[:3]), header=False).parent
            / "bare"
        ),
        "found none of 3.*its first line is of numbers",
    ),
    "one recording": (
        lambda data, tmp: write_csv(tmp / "one_True.csv", data.X[0]),
        "as in one recording; give a folder of such CSV files",
    ),
    "no labels": (
        lambda data, tmp: wide(data).drop(columns="label"),
        "a column of labels, y or label, found FZ_0",
    ),
    "no samples": (
        lambda data, tmp: pd.DataFrame({"FZ": [1.0], "label": [1]}),
        "Expected samples in numbered columns",
    ),
    "transposed": (
        lambda data, tmp: (np.zeros((5, 100, 2)), [1] * 5),
        r"looks transposed; pass X\.transpose",
    ),
    "transposed in a list": (
        lambda data, tmp: ([np.zeros((100, 2))] * 3, [1, 0, 1]),
        "looks transposed",
    ),
    "a word that is no label": (
        lambda data, tmp: (data.X[:2], ["OK", "perhaps"]),
        r"as True/False.*got 'perhaps'",
    ),
    "no label at all": (
        lambda data, tmp: (data.X[:2], ["", None]),
        "labelled traces in data, got .2 that have no label yet",
    ),
    "an empty folder": (lambda data, tmp: tmp, "Expected CSV files, one an insertion"),
}


@pytest.mark.parametrize("form", REFUSED)
def test_what_would_be_misread_is_refused(form: str, small: Dataset, tmp_path: Path) -> None:
    source, words = REFUSED[form]
    with pytest.raises(DataError, match=words):
        load_dataset(source(small, tmp_path))


def test_recordings_that_are_added_do_not_make_those_before_count_again(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    store = tmp_path / "cell.db"
    for i in range(9):
        write_csv(tmp_path / "cell" / f"{i}_OK.csv", rng.normal(size=100 + i))
    first = import_labelled(store, tmp_path / "cell", "pca")
    for i in range(9, 29):
        write_csv(tmp_path / "cell" / f"{i}_NOK.csv", rng.normal(size=96))
    again = import_labelled(store, tmp_path / "cell")
    assert (first.imported, again.imported, again.repeated) == (9, 20, 9)
    with pytest.raises(
        TraceError, match="to 104 samples by pad, cell was to 96 by pad; load it with samples=104"
    ):
        import_labelled(store, load_dataset(tmp_path / "cell"))
    with pytest.raises(TraceError, match="was to 104 by resample"):
        import_labelled(store, load_dataset(tmp_path / "cell", samples=104, fit="resample"))


def long_table(small: Dataset, start: Callable[[int], Any], step: Any = 0.004) -> pd.DataFrame:
    """Return a table with a row for each sample, of parts 1 to 24."""
    return pd.DataFrame(
        {"part": i + 1, "time": start(i) + step * j, "FZ": float(x[j]), "label": label}
        for i, (x, label) in enumerate(zip(small.X, words(small), strict=True))
        for j in range(len(x))
    )


@pytest.mark.parametrize("offset", [0.0, 0.002, 0.0013])
@pytest.mark.parametrize("order", ["blocks", "interleaved"])
def test_two_stations_with_the_same_parts_are_refused(
    offset: float, order: str, small: Dataset
) -> None:
    stations = [
        long_table(small, lambda i, late=late: late).assign(station=number)
        for number, late in enumerate((0.0, offset), start=1)
    ]
    table = pd.concat(stations)
    if order == "interleaved":
        table = table.sort_values(["part", "time"], kind="stable")
    for rate_hz in (None, 250.0):
        with pytest.raises(DataError, match=r"part 1 has several values of station \(1, 2\)"):
            load_dataset(table, time="time", channel="FZ", rate_hz=rate_hz)
    table["part"] = table["station"].astype(str) + "-" + table["part"].astype(str)
    assert len(load_dataset(table, time="time", channel="FZ").y) == 48


def test_a_table_in_another_order_or_with_a_state_in_a_column_is_read(small: Dataset) -> None:
    table = long_table(small, lambda i: 10.0 * i)
    expected = load_dataset(table, time="time").X
    half = np.arange(len(table)) % 50 // 25
    tables = {
        "newest first": table[::-1],
        "by value": table.sort_values("FZ"),
        "by phase": table.assign(phase=np.where(half, "a", "b")).sort_values("phase"),
        "a heartbeat": table.assign(beat=np.arange(len(table)) % 2),
        "few that are uncertain": table.assign(
            quality=np.where(np.arange(len(table)) % 50 // 3 == 7, "uncertain", "good")
        ).sort_values("quality"),
    }
    for name, other in tables.items():
        data = load_dataset(other, time="time", channel="FZ")
        order = [int(part) - 1 for part in other["part"].unique()]
        np.testing.assert_array_equal(data.X, expected[order], err_msg=name)


def test_parts_with_dates_are_in_the_order_of_their_times(small: Dataset) -> None:
    stamp = pd.Timestamp("2026-03-01 06:00")
    minute, step = pd.Timedelta(minutes=1), pd.Timedelta(milliseconds=4)
    table = long_table(small, lambda i: stamp + i * minute, step)
    expected = load_dataset(table, time="time")
    newest_first = load_dataset(table[::-1], time="time")
    np.testing.assert_array_equal(newest_first.X, expected.X)
    np.testing.assert_array_equal(newest_first.y, expected.y)
    assert newest_first.reading["order"] == "by the dates of their clocks"
    # Parts that overlap, and times that are no dates, leave the order of the file.
    overlapping = long_table(small, lambda i: stamp + i * 10 * step, step)[::-1]
    no_dates = long_table(small, lambda i: 60.0 * i)[::-1]
    for other in (overlapping, no_dates):
        data = load_dataset(other, time="time")
        np.testing.assert_array_equal(data.X, expected.X[::-1])
        assert data.reading["order"] == "as the rows, not by their times"


def test_a_word_of_an_undecided_part_is_unlabelled_and_never_proposed_as_a_label(
    small: Dataset,
) -> None:
    verdicts = np.where(small.y == 1, "conforme", "no conforme").astype(object)
    verdicts[[2, 7]] = "pendiente"
    with pytest.raises(DataError, match="label_map='conforme=good,no conforme=bad' or") as caught:
        load_dataset((list(small.X), list(verdicts)))
    assert "2 of 24 recordings of data have no label yet ('pendiente' 2 times)" in str(caught.value)
    label_map = "conforme=good,no conforme=bad"
    data = load_dataset((list(small.X), list(verdicts)), label_map=label_map)
    assert (len(data.y), data.unlabelled, data.faults) == (22, 2, ())
    note = "2 of 24 recordings of data have no label yet ('pendiente' 2 times): they are left out."
    assert note in data.notes
    data = load_dataset((small.X, verdicts), label_map=label_map)
    assert (len(data.y), data.unlabelled) == (22, 2)
    assert "2 of 24 traces of data have no label yet ('pendiente' 2 times)" in data.notes[0]
    # Who states what such a word means has a label, in cells as in a listing.
    data = load_dataset((list(small.X), list(verdicts)), label_map=f"{label_map},pendiente=bad")
    assert (len(data.y), data.unlabelled) == (24, 0)


@pytest.mark.parametrize("name", NOT_CHECKED_NAMES)
def test_a_name_that_says_pending_is_an_unlabelled_recording(
    name: str, few: Path, small: Dataset
) -> None:
    write_csv(few / name, small.X[5])
    data = load_dataset(few)
    assert (len(data), data.unlabelled, data.faults) == (4, 1, ())
    assert re.search("1 of 5 recordings of cell have no label yet .'.*' 1 times", data.notes[0])


def test_a_column_labels_what_a_name_calls_pending(few: Path, small: Dataset) -> None:
    for path in few.iterdir():
        path.rename(path.with_name(f"{path.name.split('_')[1]}_pending.csv"))
    for path in few.iterdir():
        frame = pd.read_csv(path)
        number = int(path.name.split("_")[0]) - 1
        frame.assign(verdict=words(small)[number]).to_csv(path, index=False)
    data = load_dataset(few)
    np.testing.assert_array_equal(data.y, small.y[:4])


def write_listing(folder: Path, words: list[str]) -> Path:
    """Four recordings whose names say good, bad, good, bad, and a listing of other words."""
    for i in range(4):
        write_csv(folder / "cell" / f"{i}_{'NOK' if i % 2 else 'OK'}.csv", np.arange(30.0) + i)
    rows = [f"{i}_{'NOK' if i % 2 else 'OK'},{word}" for i, word in enumerate(words)]
    (folder / "list.csv").write_text("\n".join(["file,final", *rows]) + "\n")
    return folder / "list.csv"


def test_a_listing_that_contradicts_a_name_is_a_fault_that_says_how_to_choose(
    tmp_path: Path,
) -> None:
    path = write_listing(tmp_path, ["OK", "OK", "pending", "NOK"])
    data = load_dataset(tmp_path / "cell", labels=path)
    assert (data.y.tolist(), data.unlabelled) == ([1, 0], 1)
    text = "list.csv, line 3 says good (OK), its name says bad (NOK); name the column to trust"
    assert [(f.source, text in f.message) for f in data.faults] == [("1_NOK.csv", True)]
    assert "label='final' of list.csv, or leave it out (labels)" in data.faults[0].message
    trusted = load_dataset(tmp_path / "cell", labels=path, label="final")
    assert (trusted.y.tolist(), trusted.faults) == ([1, 1, 0], ())
    assert load_dataset(tmp_path / "cell").y.tolist() == [1, 0, 1, 0]
    write_listing(tmp_path, ["NOK", "OK", "NOK", "OK"])
    with pytest.raises(DataError, match=r"4 of 4 have labels that differ, as .*label='final'"):
        load_dataset(tmp_path / "cell", labels=path)


def test_a_listing_that_contradicts_a_column_is_a_fault_too(tmp_path: Path) -> None:
    path = write_listing(tmp_path, ["OK", "NOK", "NOK", "NOK"])
    for i, file in enumerate(sorted((tmp_path / "cell").iterdir())):
        verdict = "OK" if i % 2 == 0 else "NOK"
        pd.read_csv(file).assign(verdict=verdict).to_csv(file.with_name(f"{i}.csv"), index=False)
        file.unlink()
    path.write_text(path.read_text().replace("_NOK,", ",").replace("_OK,", ","))
    data = load_dataset(tmp_path / "cell", labels=path)
    assert (data.y.tolist(), [f.source for f in data.faults]) == ([1, 0, 0], ["2.csv"])
    assert "line 4 says bad (NOK), its column verdict says good (OK)" in data.faults[0].message
    assert load_dataset(tmp_path / "cell", labels=path, label="final").y.tolist() == [1, 0, 0, 0]


@pytest.mark.parametrize(
    ("column", "good", "bad"),
    [("Endkontrolle", "i.O.", "n.i.O."), ("failed", 0, 1), ("Ausschuss", "nein", "ja")],
)
def test_a_verdict_in_any_column_is_compared_with_the_names(
    column: str, good: object, bad: object, tmp_path: Path
) -> None:
    verdicts = [good, bad, bad, bad]
    for i, verdict in enumerate(verdicts):
        values = np.arange(30.0) + i
        path = write_csv(tmp_path / f"{i}_{'NOK' if i % 2 else 'OK'}.csv", values, ("F",))
        pd.read_csv(path).assign(**{column: verdict}).to_csv(path, index=False)
    data = load_dataset(tmp_path)
    assert (data.y.tolist(), data.channels) == ([1, 0, 0], ("F",))
    assert [f.source for f in data.faults] == ["2_OK.csv"]
    assert f"its column {column} says bad ({bad}); name the one to trust" in data.faults[0].message
    assert load_dataset(tmp_path, label=column, channel="F").y.tolist() == [1, 0, 0, 0]


def test_a_column_that_is_no_verdict_does_not_contradict_names(tmp_path: Path) -> None:
    for i in range(4):
        values = np.arange(30.0) + i
        path = write_csv(tmp_path / f"{i}_{'NOK' if i % 2 else 'OK'}.csv", values, ("F",))
        frame = pd.read_csv(path).assign(sensor="OK", status=i % 3 // 2, yes=["no", "yes"][i // 2])
        frame.to_csv(path, index=False)
    data = load_dataset(tmp_path, channel="F")
    assert (data.y.tolist(), data.faults) == ([1, 0, 1, 0], ())


def test_two_columns_of_a_table_that_contradict_each_other_are_a_fault(small: Dataset) -> None:
    verdicts = words(small).astype(object)
    verdicts[3] = "NOK" if small.y[3] else "OK"
    verdicts[5] = "pending"
    data = load_dataset(wide(small).assign(verdict=verdicts))
    assert (len(data), [f.line for f in data.faults]) == (23, [4])
    assert "name the column to trust: label='label'" in data.faults[0].message
    assert "Column verdict tells no label: that of column label is taken." in data.notes
    assert len(load_dataset(wide(small).assign(verdict=verdicts), label="label")) == 24
    table = long_table(small, lambda i: 10.0 * i)
    table["verdict"] = np.repeat(verdicts, 50)
    data = load_dataset(table, time="time")
    assert (len(data), [f.source for f in data.faults]) == (23, ["4"])
    assert len(load_dataset(table, time="time", label="label", channel="FZ")) == 24


def test_a_listing_that_contradicts_a_table_or_an_archive_is_named(
    small: Dataset, tmp_path: Path
) -> None:
    verdicts = words(small).astype(object)
    verdicts[3] = "NOK" if small.y[3] else "OK"
    listing = tmp_path / "l.csv"
    pd.DataFrame({"file": range(1, 25), "final": verdicts}).to_csv(listing, index=False)
    np.savez(tmp_path / "x.npz", X=small.X, y=small.y)
    with pytest.raises(DataError, match="traces 4 have others; name the column to trust, label='f"):
        load_dataset(tmp_path / "x.npz", labels=listing)
    assert len(load_dataset(tmp_path / "x.npz", labels=listing, label="final")) == 24
    long_table(small, lambda i: 10.0 * i).to_csv(tmp_path / "long.csv", index=False)
    data = load_dataset(tmp_path / "long.csv", time="time", labels=listing)
    assert (len(data), [f.source for f in data.faults]) == (23, ["4"])
    stated = load_dataset(tmp_path / "long.csv", time="time", labels=listing, label="final")
    assert len(stated) == 24


@pytest.mark.parametrize("rate_hz", [None, 250.0])
def test_a_part_that_was_made_twice_at_other_times_is_not_joined(
    rate_hz: float | None, small: Dataset
) -> None:
    stations = [
        long_table(small, lambda i, late=late: 10.0 * i + late).assign(station=number)
        for number, late in enumerate((0.0, 1000.0), start=1)
    ]
    with pytest.raises(DataError, match="24 of 24 numbers come again later, as 1 in line 1201"):
        load_dataset(pd.concat(stations), time="time", channel="FZ", rate_hz=rate_hz)


def test_a_stated_rate_hides_neither_lost_rows_nor_their_order(few: Path, small: Dataset) -> None:
    def write_times(name: str, rows: np.ndarray, times: np.ndarray) -> None:
        frame = pd.DataFrame({"time [ms]": times, "FZ_Base": small.X[0][rows]})
        frame.to_csv(few / name, index=False)

    rows = np.arange(50)
    kept = np.r_[:20, 30:50]
    rotated = np.r_[35:50, :35]
    write_times("lost_OK.csv", kept, 4 * kept)
    write_times("rotated_OK.csv", rotated, 4 * rotated)
    write_times("coarse_OK.csv", rows, 1000 * (rows // 25))
    write_times(
        "burst_OK.csv", rows, np.where((rows > 20) & (rows < 40), 159 + rows / 40, 4 * rows)
    )
    write_times("full_OK.csv", rows, (2**32 - 60 + 4 * rows) % 2**32)
    data = load_dataset(few, rate_hz=250.0)
    faults = {fault.source: fault.message for fault in data.faults}
    assert set(faults) == {"lost_OK.csv", "rotated_OK.csv"}
    assert "Expected a step of 0.004 s in time, got a gap of 0.044 s" in faults["lost_OK.csv"]
    assert "got 0.196 s earlier; time='time [ms]' puts rows in" in faults["rotated_OK.csv"]
    for path in few.iterdir():
        if path.name != "rotated_OK.csv":
            path.unlink()
    for stated in (None, 250.0):
        data = load_dataset(few, time="time [ms]", rate_hz=stated)
        np.testing.assert_array_equal(data.X, small.X[:1])
        assert (data.rate_hz, data.notes[0]) == (250.0, "Rows are put in the order of their times.")


@pytest.mark.parametrize("rate_hz", [None, 500.0])
@pytest.mark.parametrize("summary", [["Max,48.2", "Min,1.3", "", "Mittel,9"], [",48.2", ",1.3"]])
def test_a_summary_below_the_samples_is_no_sample(
    summary: list[str], rate_hz: float | None, few: Path, small: Dataset
) -> None:
    for path in few.iterdir():
        path.write_text(path.read_text("utf-8") + "\n".join(summary) + "\n")
    data = load_dataset(few, rate_hz=rate_hz)
    np.testing.assert_array_equal(data.X, small.X[:4])
    n = len([row for row in summary if row])
    assert f"The last {n} rows have no time: they are no samples, and left out (4 times)." in (
        data.notes
    )


def test_channels_is_another_name_of_channel_and_a_string_is_one(few: Path, small: Dataset) -> None:
    np.testing.assert_array_equal(load_dataset(few, channels="FZ_Base").X, small.X[:4])
    np.testing.assert_array_equal(load_dataset(few, channels=["FZ_Base"]).X, small.X[:4])
    with pytest.raises(DataError, match="channel or channels"):
        load_dataset(few, channel="FZ_Base", channels="FZ_Base")


def test_an_archive_says_what_of_it_is_not_read_and_that_its_rate_is_unknown(
    small: Dataset, tmp_path: Path
) -> None:
    X = small.X.copy()
    X[3:5, 40:] = 0.0
    np.savez(tmp_path / "x.npz", X=X, y=small.y, gain=500.0, length=np.full(24, 50))
    notes = " ".join(load_dataset(tmp_path / "x.npz").notes)
    assert "Not read: the arrays gain, length." in notes
    assert "2 of 24 traces end in up to 10 zeros" in notes
    assert "The rate is unknown" in notes
    assert "rate_hz=..." in notes
    notes = load_dataset(tmp_path / "x.npz", rate_hz=500).notes
    assert not any("The rate is unknown" in note for note in notes)


ENCODINGS = {  # header and labels in other scripts, and the encoding
    "cp932": ("時間(ms),荷重(N),判定", "正常", "不正常"),
    "gb18030": ("时间(ms),力(N),结果", "正常", "不正常"),
    "big5": ("時間(ms),力(N),結果", "正常", "不正常"),
    "cp949": ("시간(ms),힘(N),판정", "정상", "비정상"),
    "cp1251": ("Время(ms),Сила(N),Результат", "годен", "брак"),
}


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_text_in_another_encoding_is_refused_until_it_is_stated(
    encoding: str, tmp_path: Path
) -> None:
    header, good, bad = ENCODINGS[encoding]
    channel = header.split(",")[1]
    for i in range(4):
        word = bad if i % 2 else good
        rows = [f"{4 * t},{t + i}.5,{word}" for t in range(50)]
        (tmp_path / f"{i}.csv").write_bytes("\n".join([header, *rows]).encode(encoding))
    with pytest.raises(DataError, match=r"UTF-8 or Windows-1252, got another encoding") as caught:
        load_dataset(tmp_path)
    assert f"encoding={encoding!r} if '{header[:24]}' is right" in str(caught.value)
    assert f"--encoding {encoding} if" in as_options(str(caught.value))
    options = {"encoding": encoding, "channel": channel, "label": header.split(",")[2]}
    with pytest.raises(DataError) as caught:
        load_dataset(tmp_path, **options)
    assert f"{bad}=bad" in str(caught.value)
    data = load_dataset(tmp_path, **options, label_map={good: True, bad: False})
    assert (data.y.tolist(), data.channels) == ([1, 0, 1, 0], (channel,))
    assert data.X[0, :2].tolist() == [0.5, 1.5]
    with pytest.raises(DataError, match="Expected text in ascii, as stated, or UTF-8, got another"):
        load_dataset(tmp_path, encoding="ascii")
    with pytest.raises(DataError, match="Expected the name of an encoding"):
        load_dataset(tmp_path, encoding="no such")


@pytest.mark.parametrize(
    "text", ["Größe;Prüfer °C", "Température;créée à 20 °C", "Kraft – „Prüfung“ ±5 µm²", "Año ¿y?"]
)
def test_western_texts_are_read_as_windows_1252(text: str, few: Path, small: Dataset) -> None:
    for path in few.iterdir():
        path.write_bytes(f"{text}\n\n".encode("cp1252") + path.read_bytes())
    data = load_dataset(few)
    np.testing.assert_array_equal(data.X, small.X[:4])
    assert data.reading["numbers"].endswith("Windows-1252")


def test_words_of_the_user_are_found_in_capitals_and_in_marks_that_are_characters() -> None:
    source = labels_in_names(None, parse_label_map("conforme=good,non conforme=bad"))
    assert source.find("p1_Conforme.csv").label == 1
    assert source.find("p1_NonConforme.csv").label == 0
    source = labels_in_names(None, parse_label_map("conforme=good"))
    assert source.find("p1_NonConforme.csv").label == 0
    words_read = parse_label_map("godk\u00e4nd=good,ej_godk\u00e4nd=bad")
    assert words_read == parse_label_map("godka\u0308nd=good,ej_godka\u0308nd=bad")


def test_a_file_name_of_macos_is_the_same_text(small: Dataset, tmp_path: Path) -> None:
    for i, word in enumerate(["godka\u0308nd", "ej_godka\u0308nd"]):
        write_csv(tmp_path / f"{i}_{word}.csv", small.X[i])
    data = load_dataset(tmp_path, label_map="godk\u00e4nd=good,ej_godk\u00e4nd=bad")
    assert data.y.tolist() == [1, 0]


@pytest.mark.parametrize("rate_hz", [None, 250.0])
@pytest.mark.parametrize("offset", [0.0, 0.001])
def test_a_part_whose_times_begin_again_is_refused(
    rate_hz: float | None, offset: float, small: Dataset
) -> None:
    table = long_table(small, lambda i: offset * (i // 12))
    table["part"] = (table["part"] - 1) % 12 + 1
    with pytest.raises(
        DataError, match=r"part 1 begins in lines 1, 601, at the same times; .*make"
    ):
        load_dataset(table, time="time", rate_hz=rate_hz)


@pytest.mark.parametrize("form", ["equal", "cut", "rounded", "contradicting", "two stations"])
def test_a_part_in_two_exports_counts_once(form: str, small: Dataset, tmp_path: Path) -> None:
    stamp = pd.Timestamp("2026-03-01 06:00")
    table = long_table(
        small, lambda i: stamp + i * pd.Timedelta(minutes=1), pd.Timedelta(milliseconds=4)
    )
    first = table[table["part"] <= 15]
    second = table[table["part"] > 10]
    if form == "cut":
        second = second.iloc[20:]
    elif form == "rounded":
        second = second.round({"FZ": 1})
    elif form == "contradicting":
        second = second.assign(label=second["label"].where(second["part"] > 12, "pass"))
    elif form == "two stations":
        second = second.assign(FZ=200.0 - second["FZ"])
    first.to_csv(tmp_path / "a.csv", index=False)
    second.to_csv(tmp_path / "b.csv", index=False)
    data = load_dataset(tmp_path, time="time")
    text = "Parts are in two files at the same times: they count once (5 times)."
    assert (text in data.notes) is (form != "two stations")
    if form == "two stations":
        assert len(data) == 24 + 5
        return
    failed = np.flatnonzero(small.y[10:12] == 0) + 10 if form == "contradicting" else []
    assert [fault.source for fault in data.faults] == [str(i + 1) for i in failed]
    np.testing.assert_allclose(data.X, np.delete(small.X, failed, axis=0), atol=0.051)


def test_labels_of_an_archive_are_joined_by_its_serial_numbers(
    small: Dataset, tmp_path: Path
) -> None:
    serial = np.array([f"SN{7 * i % 24:02d}" for i in range(24)])
    np.savez(tmp_path / "x.npz", X=small.X, serial=serial)
    table = pd.DataFrame({"serial": serial, "label": words(small)}).sort_values("label")
    table.to_csv(tmp_path / "l.csv", index=False)
    data = load_dataset(tmp_path / "x.npz", labels=tmp_path / "l.csv")
    np.testing.assert_array_equal(data.y, small.y)
    np.savez(tmp_path / "x.npz", X=small.X)
    with pytest.raises(DataError, match=r"numbered in their order, got \[SN"):
        load_dataset(tmp_path / "x.npz", labels=tmp_path / "l.csv")


def test_a_wide_table_with_a_row_for_each_signal_is_refused(small: Dataset) -> None:
    table = wide(small).assign(part=np.arange(24))
    both = pd.concat([table.assign(axis="FX"), table.assign(axis="FZ")])
    with pytest.raises(DataError, match=r"a part has one for each axis \(FX, FZ\); keep the rows"):
        load_dataset(both)
    again = pd.concat([table, table.iloc[:5].assign(FZ_0=9.0)]).assign(
        shift=["a", "b"] * 14 + ["a"]
    )
    assert len(load_dataset(again)) == 29


@pytest.mark.parametrize("form", ["1-D", "one row", "channels", "label inside", "listing"])
def test_a_folder_of_archives_one_for_each_part_is_read(
    form: str, small: Dataset, tmp_path: Path
) -> None:
    folder = tmp_path / "cell"
    folder.mkdir()
    options: dict[str, Any] = {}
    for i, (x, y) in enumerate(zip(small.X[:6], small.y[:6], strict=True)):
        arrays: dict[str, Any] = {"force": x, "time": np.arange(50) / 250.0}
        name = f"{i}_{'OK' if y else 'NOK'}"
        if form == "one row":
            arrays = {"X": x[None], "rate_hz": 250.0, "unit": "kN"}
        if form == "channels":
            arrays = {"X": np.stack([x, -x]), "y": y, "rate_hz": 250.0}
            name = str(i)
        if form == "label inside":
            arrays |= {"accepted": bool(y)}
            name = str(i)
            options = {"label": "accepted"}
        if form == "listing":
            arrays |= {"way": -x}
            name = str(i)
            options = {"labels": tmp_path / "l.csv", "channel": "force"}
        np.savez(folder / f"{name}.npz", **arrays)
    pd.DataFrame({"file": range(6), "label": words(small)[:6]}).to_csv(
        tmp_path / "l.csv", index=False
    )
    if form == "channels":
        options = {"channel": "X"}
    data = load_dataset(folder, **options)
    X = small.X[:6]
    np.testing.assert_array_equal(data.X, np.stack([X, -X], axis=1) if form == "channels" else X)
    assert (data.y.tolist(), data.rate_hz, data.faults) == (small.y[:6].tolist(), 250.0, ())
    assert data.unit == {"one row": "kN", "channels": ""}.get(form, "N")


def test_an_archive_of_a_part_that_contradicts_its_name_is_a_fault(
    small: Dataset, tmp_path: Path
) -> None:
    for i in range(4):
        np.savez(tmp_path / f"{i}_{'NOK' if i % 2 else 'OK'}.npz", X=small.X[i], y=int(i in (0, 3)))
    data = load_dataset(tmp_path, rate_hz=250)
    assert [f.source for f in data.faults] == ["2_OK.npz", "3_NOK.npz"]
    assert "its array y says bad (0), its name says good (OK)" in data.faults[0].message
    assert len(load_dataset(tmp_path, label="y")) == 4


@pytest.mark.parametrize("rate_hz", [None, 500.0])
@pytest.mark.parametrize("form", ["each row", "a block", "the whole file"])
def test_rows_of_a_file_that_came_twice_are_read_once_with_a_note(
    rate_hz: float | None, form: str, few: Path, small: Dataset
) -> None:
    path = min(few.iterdir())
    expected = load_dataset(few, rate_hz=rate_hz)
    header, *rows = path.read_text("utf-8").splitlines()
    twice = {
        "each row": [row for row in rows for _ in range(2)],
        "a block": [*rows[:30], *rows[20:30], *rows[30:]],
        "the whole file": rows * 2,
    }[form]
    path.write_text("\n".join([header, *twice]) + "\n")
    for time in (None, "none") if rate_hz else (None,):
        data = load_dataset(few, rate_hz=rate_hz, time=time)
        np.testing.assert_array_equal(data.X, expected.X)
        n = len(twice) - len(rows)
        assert f"{n} rows came twice and are read once, in 1 part: {path.name}." in data.notes


def test_equal_rows_without_a_clock_are_samples(tmp_path: Path) -> None:
    trace = np.repeat(np.random.default_rng(0).normal(size=20).round(3), 2)
    for i in range(4):
        text = "N\n" + "\n".join(map(str, trace + i))
        (tmp_path / f"{i}_{'NOK' if i % 2 else 'OK'}.csv").write_text(text + "\n")
    data = load_dataset(tmp_path, rate_hz=250)
    assert data.X.shape == (4, 40)
    assert not any("came twice" in note for note in data.notes)


def test_a_wide_table_says_which_columns_are_not_read(small: Dataset) -> None:
    table = pd.concat([wide(small).assign(serial=np.arange(24), axis=axis) for axis in ("X", "Z")])
    notes = load_dataset(table).notes
    assert "Not read: the columns serial, axis (X, Z, 24 times each)." in notes


def test_recordings_of_another_scale_are_named_in_a_note(few: Path, small: Dataset) -> None:
    write_csv(few / "small_OK.csv", small.X[5] / 1000)
    data = load_dataset(few)
    text = "50 times larger or smaller than most, in another unit or not measured"
    assert f"{text}: small_OK.csv." in data.notes
    (few / "small_OK.csv").unlink()
    assert load_dataset(few).notes == ()


@pytest.mark.parametrize("pair", ["WAHR,FALSCH", "VRAI,FAUX", "VERDADERO,FALSO", "VERO,FALSO"])
def test_booleans_of_excel_are_labels_in_any_language(pair: str, tmp_path: Path) -> None:
    good, bad = pair.split(",")
    source, options = as_folder([good, bad], "bestanden", tmp_path)
    assert load_dataset(source, **options).y.tolist() == [1, 0]
    source, options = as_folder([good, bad], "Ausschuss", tmp_path)
    assert load_dataset(source, **options).y.tolist() == [0, 1]


@pytest.mark.parametrize("word", ["ikke", "pas", "niet", "não", "ei", "ohne", "не", "never"])
def test_a_not_in_another_language_is_asked_for(word: str, small: Dataset, tmp_path: Path) -> None:
    for i in range(15):
        write_csv(tmp_path / f"{i}_{f'{word}_ok' if i % 3 == 0 else 'ok'}.csv", small.X[i])
    with pytest.raises(DataError, match=f"label_map='{word}_ok=bad'"):
        load_dataset(tmp_path)
    data = load_dataset(tmp_path, label_map=f"{word}_ok=bad")
    assert data.y.tolist() == [int(i % 3 > 0) for i in range(15)]


def test_that_no_recording_is_bad_is_said(small: Dataset, tmp_path: Path) -> None:
    for i in range(12):
        write_csv(tmp_path / f"{i}_ok.csv", small.X[i])
    assert "No recording is bad: check how labels are read." in load_dataset(tmp_path).notes


@pytest.mark.parametrize("rate_hz", [None, 250.0])
def test_a_summary_above_the_samples_is_no_sample_also_with_a_stated_rate(
    rate_hz: float | None, few: Path, small: Dataset
) -> None:
    path = min(few.iterdir())
    header, *rows = path.read_text("utf-8").splitlines()
    path.write_text("\n".join([header, "Max,9.0", "Min,0.0", *rows]) + "\n")
    data = load_dataset(few, rate_hz=rate_hz)
    np.testing.assert_array_equal(data.X, small.X[:4])
    assert "The first 2 rows have no time: they are no samples, and left out." in data.notes
    stated = load_dataset(few, rate_hz=250.0, time="none")
    np.testing.assert_array_equal(stated.X, small.X[:4])


def test_a_row_that_is_cut_off_at_the_end_of_a_file_is_left_out_with_a_note(tmp_path: Path) -> None:
    for i, end in enumerate(("30.62\n", "3", "30.62", None)):
        rows = [f"{0.004 * k:.3f},{30 + 0.01 * k:.2f}" for k in range(50)]
        text = "\n".join(["time,FZ", *rows, "0.2" if end is None else f"0.200,{end}"])
        (tmp_path / f"{i}_OK.csv").write_text(text)
    data = load_dataset(tmp_path)
    assert (data.faults, data.lengths.tolist()) == ((), [51, 50, 51, 50])
    for name in ("1_OK.csv", "3_OK.csv"):
        assert f"The last row is cut off, and left out: {name}, line 52." in data.notes


@pytest.mark.parametrize("end", ["", ";12", ";12.5;O", "\n"])
def test_the_last_row_of_a_long_table_that_is_cut_off_is_left_out_with_a_note(
    end: str, small: Dataset, tmp_path: Path
) -> None:
    rows = long_rows(small, lambda v, i, k: f"{v}")
    path = write_rows(tmp_path / "long.csv", rows[:-1])
    with path.open("a") as file:
        file.write(f"\nP23;{0.49}{end}")
    data = load_dataset(path, **LONG)
    np.testing.assert_array_equal(data.X[:, :49], small.X[:, :49])
    assert (data.faults, data.lengths[-1]) == ((), 49)
    assert "The last row is cut off, and left out: long.csv, line 1201." in data.notes


def test_columns_of_a_listing_that_contradict_each_other_are_faults(few: Path) -> None:
    names = sorted(path.name for path in few.iterdir())
    for path in few.iterdir():
        path.rename(path.with_name(path.name.replace("True", "a").replace("False", "b")))
    names = sorted(path.name for path in few.iterdir())
    rows = [f"{name},OK,{'NOK' if i == 1 else 'OK'}" for i, name in enumerate(names)]
    path = few.parent / "list.csv"
    path.write_text("\n".join(["file,label,verdict", *rows]))
    data = load_dataset(few, labels=path)
    assert [fault.source for fault in data.faults] == [names[1]]
    assert "name the column to trust" in data.faults[0].message
    assert len(load_dataset(few, labels=path, label="verdict")) == len(names)


def test_recordings_of_one_rate_and_several_lengths_are_not_stretched(tmp_path: Path) -> None:
    for i in range(6):
        t = 0.001 * np.arange(380 + 10 * i)
        frame = pd.DataFrame({"time": t, "FZ": np.sin(20 * t)})
        frame.to_csv(tmp_path / f"{i}_{'NOK' if i % 2 else 'OK'}.csv", index=False)
    data = load_dataset(tmp_path, fit="resample")
    assert data.rate_hz == 1000.0
    np.testing.assert_allclose(
        data.X[:, :380], np.tile(np.sin(0.02 * np.arange(380)), (6, 1)), atol=1e-5
    )


def test_few_recordings_that_are_shorter_than_most_are_noted(tmp_path: Path) -> None:
    for i in range(20):
        frame = pd.DataFrame({"FZ": np.sin(0.1 * i + 0.1 * np.arange(70 if i == 3 else 120))})
        frame.to_csv(tmp_path / f"{i}_{'NOK' if i % 2 else 'OK'}.csv", index=False)
    notes = load_dataset(tmp_path).notes
    assert "Much shorter than most: 3_NOK.csv." in notes


def test_a_row_of_rates_above_the_samples_is_noted(small: Dataset, tmp_path: Path) -> None:
    for i in range(12):
        frame = pd.DataFrame({"Kraft": [500.0, *small.X[i].tolist()]})
        frame.to_csv(tmp_path / f"{i}_{'ok' if i % 3 else 'nok'}.csv", index=False)
    notes = load_dataset(tmp_path).notes
    assert "All begin with the same largest sample, which may be no measurement." in notes


def test_recordings_that_are_stretched_are_noted(
    uneven: tuple[list[np.ndarray], list[int]],
) -> None:
    notes = load_dataset(uneven, fit="resample").notes
    assert any("samples are stretched to" in note for note in notes)
    assert not any("stretched" in note for note in load_dataset(uneven).notes)


@pytest.mark.parametrize("form", ["%d.%m.%Y %H:%M:%S.%f", "%Y-%m-%dT%H:%M:%S.%fZ", "epoch"])
def test_recordings_with_dates_are_in_the_order_of_their_times(
    form: str, small: Dataset, tmp_path: Path
) -> None:
    for i, (x, y) in enumerate(zip(small.X[:6], small.y, strict=False)):
        start = pd.Timestamp("2026-03-02 06:00") + pd.Timedelta(hours=4 * i)
        stamps = start + pd.to_timedelta(4 * np.arange(50), unit="ms")
        clock = (
            stamps.as_unit("ns").astype("int64") / 1e9 if form == "epoch" else stamps.strftime(form)
        )
        folder = tmp_path / ["b_early", "c_late", "a_night"][i // 2]
        folder.mkdir(exist_ok=True)
        frame = pd.DataFrame({"time": clock, "FZ_Base": x})
        frame.to_csv(folder / f"{i}_{'OK' if y else 'NOK'}.csv", index=False)
    data = load_dataset(tmp_path)
    np.testing.assert_array_equal(data.X, small.X[:6])
    assert (data.ordered, data.reading["order"]) == (True, "by the dates of their clocks")


def test_clocks_of_two_epochs_are_in_one_order(small: Dataset, tmp_path: Path) -> None:
    """A logger of Windows counts 100 ns since 1601, another one seconds since 1970."""
    for i, (x, y) in enumerate(zip(small.X[:6], small.y, strict=False)):
        start = 1_772_431_200 + 600 * i
        seconds = [f"{start}.{4 * sample:03d}" for sample in range(50)]
        filetimes = [(start + 11_644_473_600) * 10**7 + 40_000 * sample for sample in range(50)]
        frame = pd.DataFrame({"time": filetimes if i % 2 == 0 else seconds, "FZ_Base": x})
        logger = "a" if i % 2 else "b"
        frame.to_csv(tmp_path / f"{logger}_{i}_{'OK' if y else 'NOK'}.csv", index=False)
    data = load_dataset(tmp_path)
    np.testing.assert_array_equal(data.X, small.X[:6])
    assert (data.ordered, data.rate_hz) == (True, 250.0)


def test_data_says_how_a_folder_was_read(small: Dataset, tmp_path: Path) -> None:
    for i, x in enumerate(small.X[:5]):
        rows = [f"{4 * k};{1000 + value:.2f}".replace(".", ",") for k, value in enumerate(x)]
        text = "\n".join(["Presse 3", "Zeit [ms];Kraft [N]", *rows, "Max;12,5"])
        (tmp_path / f"Teil_{i}_{'NOK' if i in (1, 3) else 'OK'}.csv").write_text(text + "\n")
    expected = {
        "labels": "file name: OK -> good 3, NOK -> bad 2",
        "clock": "column Zeit [ms] (ms)",
        "rows": "header in line 2, 1 left out",
        "numbers": "decimal mark ',', ';' between cells",
        "order": "by name, numbers by size",
        "first": f"Teil_0_OK.csv: Kraft [N] {round(1000 + float(small.X[0, 0]), 2):.6g} to "
        f"{round(1000 + float(small.X[0, -1]), 2):.6g} N in 50 samples",
    }
    assert load_dataset(tmp_path).reading == expected
    assert document("data", tmp_path)["reading"] == expected
    text = line_of("data", tmp_path)
    assert "How it was read" in text
    assert expected["labels"] in text


def test_data_says_how_each_form_was_read(small: Dataset, tmp_path: Path) -> None:
    verdicts = np.where(small.y == 1, "OK", "NOK")
    n_good = int(small.y.sum())
    counted = f"OK -> good {n_good}, NOK -> bad {len(small) - n_good}"
    step = pd.Timedelta(milliseconds=4)
    start = pd.Timestamp("2026-03-01")
    long = long_table(small, lambda i: start + i * pd.Timedelta(hours=1), step)
    wide = small.to_frame().assign(verdict=verdicts).drop(columns=["label"])
    wide.to_parquet(tmp_path / "wide.parquet")
    np.savez(tmp_path / "a.npz", X=small.X, y=verdicts, rate_hz=250.0)
    folder = tmp_path / "archives"
    folder.mkdir()
    for i, x in enumerate(small.X[:4]):
        np.savez(folder / f"{i}_{verdicts[i]}.npz", force=x, time=0.004 * np.arange(len(x)))
    readings = {
        "wide": load_dataset(tmp_path / "wide.parquet").reading,
        "array": load_dataset(tmp_path / "a.npz").reading,
        "archives": load_dataset(folder).reading,
        "pair": load_dataset((small.X, verdicts)).reading,
        "list": load_dataset((list(small.X), verdicts.tolist()), rate_hz=250.0).reading,
    }
    by_name = "by name, numbers by size"
    for name, labels, clock, order in (
        ("wide", f"column verdict: {counted}", "none", "as the rows"),
        ("array", f"array y: {counted}", "none, an array tells the rate", "as the rows"),
        ("archives", "file name: ", "column time (s)", by_name),
        ("pair", f"array y: {counted}", "none", "as the rows"),
        ("list", f"array y: {counted}", "none, the rate is stated", "as the rows"),
    ):
        reading = readings[name]
        assert reading["labels"].startswith(labels), name
        assert (reading["clock"], reading["order"]) == (clock, order), name
        assert f"{float(small.X[0, 0]):.6g} to {float(small.X[0, -1]):.6g}" in reading["first"]
    dates = load_dataset(long, time="time").reading
    assert (dates["clock"], dates["order"]) == (
        "column time (dates)",
        "by the dates of their clocks",
    )


def test_a_listing_with_other_columns_is_one_error_that_says_what_each_needs(
    few: Path, tmp_path: Path
) -> None:
    (tmp_path / "mes.csv").write_text("DMC,Line,Finding\nA1,L3,x\n")
    with pytest.raises(
        DataError, match=r"got DMC, Line, Finding; write their names into a column file"
    ):
        load_dataset(few, labels=tmp_path / "mes.csv")


@pytest.mark.parametrize(
    ("words", "label_map"),
    [
        (["-", "-", "-", "jammed", "tilted"], "-=good,jammed=bad,tilted=bad"),
        (["heil", "heil", "heil", "Riss", "-"], "heil=good,Riss=bad"),
    ],
)
def test_a_suggested_label_map_has_a_dash_only_if_it_is_more_frequent_than_the_words(
    words: list[str], label_map: str, tmp_path: Path
) -> None:
    for i, word in enumerate(words):
        frame = pd.DataFrame({"FZ_Base": np.arange(30.0), "Fault": word})
        frame.to_csv(tmp_path / f"{i}.csv", index=False)
    with pytest.raises(DataError, match=f"label_map='{label_map}'"):
        load_dataset(tmp_path, label="Fault")


def test_rows_of_zeros_with_a_time_of_zero_behind_the_last_sample_are_left_out(
    tmp_path: Path,
) -> None:
    cells = {"time": np.r_[np.arange(30) / 500, np.zeros(9)], "FZ_Base": np.r_[1:31, np.zeros(9)]}
    pd.DataFrame(cells).to_csv(tmp_path / "1_OK.csv", index=False)
    data = load_dataset(tmp_path)
    np.testing.assert_array_equal(data.X, [np.arange(1, 31)])
    assert any("The last rows are 0, and so is their time" in note for note in data.notes)
    pd.DataFrame(cells | {"FZ_Base": np.r_[1:40]}).to_csv(tmp_path / "1_OK.csv", index=False)
    with pytest.raises(DataError, match="as zeros behind the last one, are to be deleted"):
        load_dataset(tmp_path, time="time")


def test_a_listing_by_serial_numbers_finds_the_files_that_have_them_in_their_names(
    small: Dataset, tmp_path: Path
) -> None:
    numbers = [f"DMC93{i:03d}A" for i in (0, 11, 7, 5)]
    for number, x in zip(numbers, small.X, strict=False):
        write_csv(tmp_path / "cell" / f"20260301_{number}.csv", x)
    path = tmp_path / "mes.csv"

    def write_rows(*rows: str) -> None:
        path.write_text("\n".join(["DMC;Line;Prüfurteil;Shift", *rows]) + "\n", "utf-8")

    words = ("gut", "schlecht", "gut", "schlecht")
    write_rows(*(f"{n};L3;{word};2" for n, word in zip(numbers, words, strict=True)))
    data = load_dataset(tmp_path / "cell", labels=path)
    assert data.source is not None
    verdicts = dict(zip(data.source.tolist(), data.y.tolist(), strict=True))
    assert verdicts == {
        f"20260301_{n}.csv": int(w == "gut") for n, w in zip(numbers, words, strict=True)
    }
    assert "Prüfurteil: gut -> good 2, schlecht -> bad 2" in data.reading["labels"]
    # Several files have the words of a row, and no column holds labels alone: one error says all.
    write_rows(*(f"20260301;L3;{word};2" for word in ("Riss", "gut", "heil", "gut")))
    with pytest.raises(
        DataError, match="got DMC, Line, Prüfurteil, Shift; write their names into a column file"
    ):
        load_dataset(tmp_path / "cell", labels=path)


def test_samples_of_zero_behind_the_last_one_are_noted(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for i in range(4):
        force = np.r_[rng.normal(20.0, 5.0, 60), np.zeros(20 if i < 2 else 0)]
        pd.DataFrame({"FZ_Base": force}).to_csv(tmp_path / f"{i}_OK.csv", index=False)
    notes = load_dataset(tmp_path, rate_hz=500.0, fit="pad").notes
    expected = "The last samples are all 0, which may be no measurements: 0_OK.csv, 1_OK.csv."
    assert expected in notes, notes


@pytest.mark.parametrize(
    "line", ["Result total;{}", "# Verdict: {}", "Prüfung = {}", "Part;Check\nA;{}"]
)
@pytest.mark.parametrize("place", ["above", "below"])
def test_a_verdict_in_a_line_outside_the_samples_is_the_label(
    line: str, place: str, small: Dataset, tmp_path: Path
) -> None:
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        rows = "".join(f"{k * 2},{x[k % 50]},{k}\n" for k in range(150))
        table = f"Time [ms],FZ,WZ\n{rows}"
        text = line.format(word)
        above = f"Press 4\nDate;2026-03-01\n{text}\n\n"
        (tmp_path / f"SN{i:03}.csv").write_text(above + table if place == "above" else table + text)
    data = load_dataset(tmp_path, channel="FZ")
    np.testing.assert_array_equal(data.y, small.y)
    np.testing.assert_array_equal(data.X, np.tile(small.X, 3))
    label = re.split(r" ?[;:=\n]", line.removeprefix("# "))["Part" in line]
    np.testing.assert_array_equal(load_dataset(tmp_path, channel="FZ", label=label).y, small.y)


def test_annotations_repeated_headers_and_end_marks_are_no_rows(
    small: Dataset, tmp_path: Path
) -> None:
    blocks = []
    for number, scale in enumerate((0.5, 1.0)):
        header = ",result,table,_time,_value,_field,serial,verdict"
        rows = [
            f",,{number},2026-03-02T06:{i:02}:00.{2 * k:03}Z,{scale * v},F{'XZ'[number]},S{i},{word}"
            for i, (x, word) in enumerate(zip(small.X, words(small), strict=True))
            for k, v in enumerate(x)
        ]
        blocks += ["#datatype,string,long,dateTime,double,string,string,string", header, *rows, ""]
    path = tmp_path / "influx.csv"
    path.write_text("\n".join([*blocks, "//END,,,,,,,"]))
    data = load_dataset(path, channel="FZ", part="serial", time="_time", label="verdict")
    np.testing.assert_array_equal(data.y, small.y)
    np.testing.assert_array_equal(data.X, small.X)
    assert not data.unlabelled


def test_the_word_of_a_part_that_is_not_checked_yet_is_proposed_for_a_long_table(
    small: Dataset,
) -> None:
    frame = long_table(small, lambda i: 10.0 * i)
    is_end = frame.groupby("part").cumcount() > 45
    codes = frame.pop("label").map({"OK": 1, "NOK": 2})
    frame["register"] = codes.where(is_end, 0)
    options = {"time": "time", "channel": "FZ", "label": "register"}
    with pytest.raises(DataError) as error:
        load_dataset(frame, **options)
    label_map = re.search(r"label_map='([^']*,0=)'", str(error.value))
    assert label_map is not None, error.value
    data = load_dataset(frame, **options, label_map="1=good,2=bad,0=")
    np.testing.assert_array_equal(data.y, small.y)


def test_a_register_that_is_0_until_the_part_is_checked_counts_at_its_end(
    small: Dataset, tmp_path: Path
) -> None:
    for i, (x, y) in enumerate(zip(small.X, small.y, strict=True)):
        rows = [f"{k * 2},{v},{0 if k < 45 else 2 - y}" for k, v in enumerate(x)]
        text = "\n".join(["time_ms,FZ,register", *rows])
        (tmp_path / f"{i:03}.csv").write_text(text)
    with pytest.raises(DataError) as error:
        load_dataset(tmp_path, channel="FZ", label="register")
    label_map = re.search(r"label_map='(1=good,2=bad)'", str(error.value))
    assert label_map is not None, error.value
    for stated in (label_map[1], "1=good,2=bad,0="):
        data = load_dataset(tmp_path, channel="FZ", label="register", label_map=stated)
        np.testing.assert_array_equal(data.y, small.y)
    (tmp_path / "025_waits.csv").write_text("time_ms,FZ,verdict\n" + "2,1,\n" * 5)
    assert parse_label_map({"0": None, "ok": 1}) == {"0": None, "ok": True}


def test_an_empty_cell_is_the_good_one_where_the_user_says_so(
    small: Dataset, tmp_path: Path
) -> None:
    causes = np.where(small.y == 1, "", "E12 force too high")
    table = wide(small).drop(columns="label").assign(fault_text=causes)
    table.to_csv(tmp_path / "wide.csv", index=False)
    with pytest.raises(DataError, match="=good,E12 force too high=bad"):
        load_dataset(tmp_path / "wide.csv", label="fault_text")
    label_map = "=good,E12 force too high=bad"
    data = load_dataset(tmp_path / "wide.csv", label="fault_text", label_map=label_map)
    np.testing.assert_array_equal(data.y, small.y)


@pytest.mark.parametrize(
    ("form", "own"),
    [
        *itertools.product(["column", "names", "a listing"], ["0=good", "0=good,99=", {0: True}]),
        *itertools.product(["column", "a listing"], ["14=bad,21=bad"]),
    ],
)
def test_the_label_map_that_an_error_prints_begins_with_the_users_own_and_works_as_it_stands(
    form: str, own: Any, make_data, tmp_path: Path
) -> None:
    data = make_data(24, samples=50)
    codes = [0 if good else (14, 21, 33)[i % 3] for i, good in enumerate(data.y)]
    how: dict[str, Any] = {"rate_hz": 500}
    rows = pd.DataFrame(data.X).add_prefix("F_")
    if form == "column":
        rows.assign(errorCode=codes).to_csv(tmp_path / "rows.csv", index=False)
        source, how["label"] = tmp_path / "rows.csv", "errorCode"
    elif form == "names":
        source, how["label"] = tmp_path / "parts", r"_(\d+)\.csv"
        for i, (trace, code) in enumerate(zip(data.X, codes, strict=True)):
            write_csv(source / f"{i:03}_{code}.csv", trace)
        how = {"label": how["label"]}
    else:
        rows.assign(serial=range(24)).to_csv(tmp_path / "rows.csv", index=False)
        listing = pd.DataFrame({"serial": range(24), "errorCode": codes})
        listing.to_csv(tmp_path / "listing.csv", index=False)
        source, how["part"] = tmp_path / "rows.csv", "serial"
        how |= {"labels": tmp_path / "listing.csv", "label": "errorCode"}
    with pytest.raises(DataError) as raised:
        load_dataset(source, label_map=own, **how)
    label_map = re.search("label_map='(.*?)'", str(raised.value))[1]
    assert label_map.startswith("0=good," if isinstance(own, dict) else f"{own},")
    np.testing.assert_array_equal(load_dataset(source, label_map=label_map, **how).y, data.y)


@pytest.mark.parametrize(
    ("field", "unit"), [("force_N", "N"), ("Presse_Kraft_kN", "kN"), ("force", "N"), ("y2", "")]
)
@pytest.mark.parametrize("form", ["long", "folder"])
def test_the_name_of_a_signal_in_a_column_tells_the_unit(
    form: str, field: str, unit: str, small: Dataset, tmp_path: Path
) -> None:
    head = ["_time", "_value", "_field", "part_id", "verdict"]
    parts = [
        [[str(k / 100), str(v), field, f"B{i}", word] for k, v in enumerate(x)]
        for i, (x, word) in enumerate(zip(small.X, words(small), strict=True))
    ]
    how = {"channel": "_value", "label": "verdict", "time": "_time"}
    if form == "long":
        source = write_rows(tmp_path / "query.csv", [head, *itertools.chain(*parts)])
        how["part"] = "part_id"
    else:
        source = tmp_path
        for i, rows in enumerate(parts):
            write_rows(tmp_path / f"part_{i:02}.csv", [head, *rows])
    data = load_dataset(source, **how)
    np.testing.assert_allclose(data.X, small.X)
    assert data.unit == unit
    assert ("The unit is unknown: unit=... states it." in data.notes) == (not unit)
    assert (
        "The unit is unknown: unit=... states it."
        not in load_dataset(source, **how, unit="N").notes
    )


def test_the_note_on_unknown_units_names_the_channels_that_have_none(
    small: Dataset, tmp_path: Path
) -> None:
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        write_csv(tmp_path / f"{i:02}_{word}.csv", np.stack([x, -x]), ("Force", "aux"))
    notes = load_dataset(tmp_path, channels=["Force", "aux"]).notes
    assert "The unit of aux is unknown: unit=... states it." in notes
    np.savez(tmp_path / "set.npz", X=small.X, y=small.y, rate_hz=100)
    notes = load_dataset(tmp_path / "set.npz").notes
    assert notes == ("The unit is unknown: unit=... states it.",)


@pytest.mark.parametrize("is_turned", [True, False])
@pytest.mark.parametrize("form", ["force", "channels", "listing"])
def test_a_note_says_that_the_axis_of_the_parts_is_found_by_the_number_of_labels(
    form: str, is_turned: bool, small: Dataset, tmp_path: Path
) -> None:
    X = np.stack([small.X, -small.X], axis=2) if form == "channels" else small.X
    X = X.swapaxes(0, 1) if is_turned else X
    how: dict[str, Any] = {"channel": "fx" if form == "channels" else "force", "label": "ok"}
    arrays = {"ok": small.y, "names": np.array(["fx", "fy"])}
    if form == "listing":
        arrays = {"serial": np.array([f"S{i}" for i in range(24)])}
        listing = pd.DataFrame({"serial": arrays["serial"], "ok": words(small)})
        listing.to_csv(tmp_path / "labels.csv", index=False)
        how |= {"labels": tmp_path / "labels.csv"}
    np.savez(tmp_path / "run.npz", force=X, fs=500, **arrays)
    data = load_dataset(tmp_path / "run.npz", **how)
    np.testing.assert_array_equal(data.X, small.X)
    shape = ", ".join(map(str, X.shape))
    text = f"Array force ({shape}) is read as 24 traces of 50 samples, for there are 24 labels."
    assert (text in data.notes) == is_turned


@pytest.mark.parametrize("axes", [(0, 1, 2), (0, 2, 1)])
def test_an_archive_names_its_channels_in_an_array_of_texts(
    axes: tuple[int, ...], small: Dataset, tmp_path: Path
) -> None:
    wrench = np.stack([-small.X, small.X, 0.1 * small.X], axis=1).transpose(axes)
    path = tmp_path / "session.npz"
    np.savez(path, wrench=wrench, ok=small.y, fs=250, names=np.array(["fx", "fz", "tz"]))
    with pytest.raises(DataError, match=r"channel='fz' and label='ok'; found .*fx, fz, tz"):
        load_dataset(path, channel="fz")
    data = load_dataset(path, channel="fz", label="ok")
    np.testing.assert_array_equal(data.X, small.X)
    assert (data.rate_hz, data.channels, data.unit) == (250.0, ("fz",), "N")
    whole = load_dataset(path, channel="wrench", label="ok")
    assert (whole.X.shape[1], whole.channels, whole.unit) == (3, ("fx", "fz", "tz"), "N, N, N·m")
    assert not whole.notes


@pytest.mark.parametrize(
    "form", ["words in names", "a row of verdicts", "rows of serials and words", "a listing"]
)
def test_a_table_with_a_column_for_each_part_is_read(
    form: str, small: Dataset, tmp_path: Path
) -> None:
    names = [f"P{i:03}" for i in range(24)]
    rows = [[f"{k * 2}", *map(str, column)] for k, column in enumerate(small.X.T)]
    how = {}
    if form == "words in names":
        names = [f"{name} {word}" for name, word in zip(names, words(small), strict=True)]
    elif form == "a row of verdicts":
        rows.insert(0, ["Verdict", *words(small)])
    elif form == "a listing":
        pairs = list(map(list, zip(names, words(small), strict=True)))
        how = {"labels": str(write_rows(tmp_path / "list.csv", [["sample", "result"], *pairs]))}
    else:
        rows.insert(0, ["Bewertung", *np.where(small.y == 1, "heil", "Riss")])
        rows.insert(0, ["Serial", *(f"A{i}" for i in range(24))])
        with pytest.raises(DataError, match=r"(heil|Riss)=good,(heil|Riss)=bad"):
            load_dataset(write_rows(tmp_path / "a.csv", [["t [ms]", *names], *rows]))
        how = {"label_map": "heil=good,Riss=bad"}
    path = write_rows(tmp_path / "a.csv", [["t [ms]", *names], *rows])
    data = load_dataset(path, **how)
    np.testing.assert_array_equal(data.X, small.X)
    np.testing.assert_array_equal(data.y, small.y)
    assert data.rate_hz == 500.0
    parts = data.source if form == "a listing" else data.part
    assert parts is not None
    assert list(parts) == names


def test_statistics_below_a_column_for_each_part_are_rows_that_are_not_read(
    small: Dataset, tmp_path: Path
) -> None:
    names = [f"P{i:03} {word}" for i, word in enumerate(words(small))]
    rows = [[f"{k * 2}", *map(str, column)] for k, column in enumerate(small.X.T)]
    statistics = {"Minimum": np.min, "Mean": np.mean, "Std. dev.": np.std}
    rows += [[name, *map(str, of(small.X, axis=1))] for name, of in statistics.items()]
    data = load_dataset(write_rows(tmp_path / "a.csv", [["t [ms]", *names], *rows]))
    np.testing.assert_array_equal(data.X, small.X)
    assert "Not read: the rows Minimum, Mean, Std. dev." in data.notes


def test_serials_that_rise_evenly_are_no_clock_of_a_table_with_a_listing(
    small: Dataset, tmp_path: Path
) -> None:
    serials = [f"{i:05}" for i in range(24)]
    table = wide(small).drop(columns="label")
    table.insert(0, "serial", serials)
    table.to_csv(tmp_path / "wide.csv", index=False)
    pairs = map(list, zip(serials, words(small), strict=True))
    listing = write_rows(tmp_path / "list.csv", [["Serial", "Verdict"], *pairs])
    with pytest.raises(DataError, match="as in part='serial'"):
        load_dataset(tmp_path / "wide.csv", labels=str(listing))
    data = load_dataset(tmp_path / "wide.csv", labels=str(listing), part="serial")
    np.testing.assert_allclose(data.X, small.X)
    np.testing.assert_array_equal(data.y, small.y)


def test_files_whose_decimal_mark_a_spreadsheet_dropped_are_left_out(tmp_path: Path) -> None:
    clean = np.linspace(0.125, 9.875, 40)
    for i in range(12):
        rows = [["Force"], *([f"{value:.3f}"] for value in clean + i / 8)]
        if i in (3, 7):
            rows = [[cell.replace(".", "") for cell in row] for row in rows]
        write_rows(tmp_path / f"{i:03}_{'NOK' if i % 4 == 2 else 'OK'}.csv", rows)
    data = load_dataset(tmp_path, channel="Force", rate_hz=100)
    assert len(data.X) == 10
    assert [fault.source[:3] for fault in data.faults] == ["003", "007"]
    assert "dropped the decimal mark" in str(data.faults[0])


def write_rows(path: Path, rows: list[list[str]]) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text("\n".join(map(";".join, rows)))
    return path


def test_a_file_in_another_unit_is_named_with_the_column(small: Dataset, tmp_path: Path) -> None:
    table = wide(small)
    for name, unit in (("a", "N"), ("b", "kN")):
        rows = [list(table), [*[unit] * 50, ""], *table.astype(str).to_numpy().tolist()]
        write_rows(tmp_path / f"{name}.csv", rows)
    with pytest.raises(DataError, match=r"same unit of FZ_0 in a.csv and in b.csv, got N and kN"):
        load_dataset(tmp_path)


@pytest.mark.parametrize("form", ["folder", "long"])
def test_one_error_names_channel_label_and_map(form: str, small: Dataset, tmp_path: Path) -> None:
    frames = [
        pd.DataFrame(
            {"t_ms": 2 * np.arange(50), "X": x, "Kraft": x, "Urteil": word, "Teil": f"T{i}"}
        )
        for i, (x, word) in enumerate(zip(small.X, np.where(small.y, "heil", "Riss"), strict=True))
    ]
    path = tmp_path
    if form == "folder":
        for i, frame in enumerate(frames):
            frame.drop(columns="Teil").to_csv(tmp_path / f"{i:03}.csv", index=False)
    else:
        path = tmp_path / "long.csv"
        pd.concat(frames).to_csv(path, index=False)
    with pytest.raises(DataError) as error:
        load_dataset(path)
    text = as_options(str(error.value))
    options = dict(re.findall(r"--([a-z-]+) '?([^' ]*\w)", text))
    how = {name.replace("-", "_"): value for name, value in options.items()}
    good = "heil=good,Riss=bad"
    assert how.pop("label_map") in (good, "Riss=good,heil=bad")
    data = load_dataset(path, **how, label_map=good)
    np.testing.assert_array_equal(data.y, small.y)
    np.testing.assert_array_equal(data.X, small.X)


@pytest.mark.parametrize("form", ["two columns", "whole seconds and ms", "times alone"])
def test_a_recording_over_midnight_is_one(form: str, small: Dataset, tmp_path: Path) -> None:
    start = pd.Timestamp("2026-03-01T23:59:59.900")
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        stamps = start + pd.Timedelta(days=24 - i) + pd.to_timedelta(np.arange(50) * 4, unit="ms")
        clock = {"Date": stamps.strftime("%d.%m.%Y"), "UTC Time": stamps.strftime("%H:%M:%S.%f")}
        if form == "whole seconds and ms":
            clock |= {"UTC Time": stamps.strftime("%H:%M:%S"), "ms": stamps.microsecond // 1000}
        elif form == "times alone":
            clock.pop("Date")
        pd.DataFrame({**clock, "FZ": x}).to_csv(tmp_path / f"{i:03}_{word}.csv", index=False)
    data = load_dataset(tmp_path, channel="FZ")
    by_date = slice(None, None, 1 if form == "times alone" else -1)
    np.testing.assert_array_equal(data.X, small.X[by_date])
    assert not data.faults
    assert data.rate_hz == 250.0


def test_the_clock_says_whether_the_day_or_the_month_comes_first(
    small: Dataset, tmp_path: Path
) -> None:
    for order in ("%d/%m/%Y", "%m/%d/%Y"):
        stamps = pd.Timestamp("2026-02-25") + pd.to_timedelta(np.arange(50) * 4, unit="ms")
        for i, word in enumerate(("OK", "NOK")):
            clock = stamps.strftime(f"{order} %H:%M:%S.%f")
            frame = pd.DataFrame({"time": clock, "FZ": small.X[i]})
            frame.to_csv(tmp_path / f"{i}_{word}.csv", index=False)
        first = "day" if order.startswith("%d") else "month"
        assert f"dates, {first} first" in load_dataset(tmp_path).reading["clock"]


def table_of_parts(data: Dataset, starts: np.ndarray, number: np.ndarray) -> pd.DataFrame:
    """A row for each sample: trace i is of part number[i] and begins at starts[i]."""
    frames = [
        pd.DataFrame({"part": part, "time": start + np.arange(50) * 0.004, "FZ": x, "label": word})
        for x, word, start, part in zip(data.X, words(data), starts, number, strict=True)
    ]
    return pd.concat(frames)


def test_a_part_whose_rows_stand_apart_is_refused_also_if_its_times_go_on(small: Dataset) -> None:
    good = Dataset(small.X, np.ones(24, dtype=np.int8))
    table = table_of_parts(good, np.repeat([0.0, 0.2], 12), np.tile(np.arange(12), 2))
    with pytest.raises(DataError, match=r"part 0 begins in lines 1, 601, other parts between"):
        load_dataset(table, time="time")


def test_a_part_that_cannot_be_read_leaves_the_others_in_the_order_of_their_dates(
    small: Dataset,
) -> None:
    starts = 1_772_344_800.0 + 10.0 * np.arange(24)[::-1]
    table = table_of_parts(small, starts, np.arange(24)).reset_index(drop=True)
    table.loc[25:49, "time"] += 500.0  # a gap: this part seems to last as long as all others
    data = load_dataset(table, time="time")
    assert len(data.faults) == 1
    assert data.reading["order"] == "by the dates of their clocks"
    np.testing.assert_array_equal(data.X, small.X[:0:-1])


def scope_rows(x: np.ndarray, _word: str) -> list[list[str]]:
    """A file of TwinCAT Scope: pairs of a word and a channel's attribute above pairs of samples."""
    pairs = [("Name", "fForce", "fPos"), ("Data-Type", "REAL64", "REAL64"), ("Unit", "N", "mm")]
    above = [[key, first, key, second] for key, first, second in pairs]
    return [["File", "a.tcs"], *above, *([f"{k}", f"{v}", f"{k}", "0.5"] for k, v in enumerate(x))]


def horizontal_rows(x: np.ndarray, _word: str) -> list[list[str]]:
    """A line of times and one of samples."""
    return [["time [ms]", *map(str, range(50))], ["fForce", *map(str, x)]]


def bit_rows(x: np.ndarray, word: str) -> list[list[str]]:
    """A bit of a controller that is set in the last rows of good parts."""
    rows = [[f"{k}", f"{v}", str(k > 45 and word == "OK")] for k, v in enumerate(x)]
    return [["time [ms]", "fForce", "bOK"], *rows]


@pytest.mark.parametrize("make_rows", [scope_rows, horizontal_rows, bit_rows])
def test_a_file_of_a_controller_is_read_without_more_than_its_channel(
    make_rows: Callable[[np.ndarray, str], list[list[str]]], small: Dataset, tmp_path: Path
) -> None:
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        end = "" if make_rows is bit_rows else f"_{word}"
        write_rows(tmp_path / f"{i:03}{end}.csv", make_rows(x, word))
    label = "bOK" if make_rows is bit_rows else None
    data = load_dataset(tmp_path, channel="fForce", label=label)
    np.testing.assert_array_equal(data.X, small.X)
    np.testing.assert_array_equal(data.y, small.y)
    assert data.rate_hz == 1000.0
    has_note = any("in the last rows alone" in note for note in data.notes)
    assert has_note == (make_rows is bit_rows)


def test_a_listing_of_other_files_and_words_is_asked_for_the_words_alone(
    small: Dataset, tmp_path: Path
) -> None:
    table = pd.DataFrame({"time": np.arange(50) / 500, "FZ": small.X[0]})
    for i in range(6):
        table.assign(FZ=small.X[i]).to_csv(tmp_path / f"rec_{i:02}_wrench.csv", index=False)
    rows = [[f"rec_{i:02}.bag", "AB", "inserted" if i % 2 else "jammed"] for i in range(6)]
    listing = write_rows(tmp_path.parent / "runs.csv", [["bag", "who", "outcome_of_it"], *rows])
    with pytest.raises(DataError, match=r"label_map='(inserted|jammed)=good"):
        load_dataset(tmp_path, labels=listing)
    data = load_dataset(tmp_path, labels=listing, label_map="inserted=good,jammed=bad")
    np.testing.assert_array_equal(data.y, [0, 1] * 3)


def test_channels_of_one_name_are_told_apart_by_the_groups_above(
    small: Dataset, tmp_path: Path
) -> None:
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        above = [["", "Sensor A", "", "Sensor B", ""], ["t [ms]", "Fx", "Fz", "Fx", "Fz"]]
        rows = [[f"{2 * k}", "0.1", "0.2", "0.3", f"{v}"] for k, v in enumerate(x)]
        write_rows(tmp_path / f"{i}_{word}.csv", [*above, ["", "N", "N", "N", "N"], *rows])
    with pytest.raises(DataError, match="Sensor A Fx, Sensor A Fz, Sensor B Fx, Sensor B Fz"):
        load_dataset(tmp_path)
    np.testing.assert_array_equal(load_dataset(tmp_path, channel="Sensor B Fz").X, small.X)


@pytest.mark.parametrize("form", ["in its folder", "of its name", "in one line"])
def test_a_verdict_in_a_small_file_beside_the_recording_is_the_label(
    form: str, small: Dataset, tmp_path: Path
) -> None:
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        folder = tmp_path / f"SN{i:03}" if form == "in its folder" else tmp_path
        write_csv(folder / f"SN{i:03}.csv", x)
        name = "result.txt" if form == "in its folder" else f"SN{i:03}.json"
        text = f"Operator: A\nResult: {word}\n"
        if name.endswith(".json"):
            fields = {"part": i, "check": {"verdict": word, "by": "camera"}, "program": 7}
            text = json.dumps(fields, indent=None if form == "in one line" else 2)
        (folder / name).write_text(text)
    data = load_dataset(tmp_path)
    np.testing.assert_array_equal(data.X, small.X)
    np.testing.assert_array_equal(data.y, small.y)


@pytest.mark.parametrize("form", ["{} - Copy", "{} (2)", "Kopie von {}", "Copy of {}"])
def test_a_copy_of_a_file_manager_counts_once(form: str, few: Path) -> None:
    n = len(load_dataset(few))
    first = min(few.iterdir())
    first.with_stem(form.format(first.stem)).write_bytes(first.read_bytes())
    data = load_dataset(few)
    assert len(data) == n
    assert "it is a copy of" in data.faults[0].message


def test_labels_behind_the_numbers_of_files_that_are_named_as_copies_leave_their_order(
    small: Dataset, tmp_path: Path
) -> None:
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        write_csv(tmp_path / f"Copy of part_{i}_{word}.csv", x)
    data = load_dataset(tmp_path)
    np.testing.assert_array_equal(data.X, small.X)
    assert data.ordered


def test_a_signal_in_rows_of_a_file_is_chosen_by_its_name(small: Dataset, tmp_path: Path) -> None:
    """As WinCC exports an archive, with times in millionths of days."""
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        rows = [
            [name, f"{value}", "1", f"{46082.25e6 + k * 0.01 / 86400 * 1e6:.4f}"]
            for k, v in enumerate(x)
            for name, value in (("Kraft", v), ("Weg", 0.1 * k))
        ]
        header = ["VarName", "VarValue", "Validity", "Time_ms"]
        write_rows(tmp_path / f"{i:03}_{word}.csv", [header, *rows, ["$RT_OFF$", "0", "2", "0\n"]])
    data = load_dataset(tmp_path, channel="Kraft")
    np.testing.assert_array_equal(data.X, small.X)
    assert data.rate_hz == 100.0


def test_archives_of_several_channels_with_the_label_in_their_names(
    small: Dataset, tmp_path: Path
) -> None:
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        path = tmp_path / f"{i:03}_{word}.npz"
        t = np.arange(50) / 500
        np.savez(path, t=t, force=np.stack([-x, x], axis=1), names=np.array(["fx", "fz"]))
    data = load_dataset(tmp_path, channel="fz")
    np.testing.assert_array_equal(data.X, small.X)
    np.testing.assert_array_equal(data.y, small.y)
    assert data.rate_hz == 500.0


def test_a_verdict_in_a_comment_with_a_semicolon_is_found(small: Dataset, tmp_path: Path) -> None:
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        rows = "\n".join(f"{4 * k} 0.1 {v}" for k, v in enumerate(x))
        text = f"; FANUC log\n; State: {word}\nTick Fx Fz\n{rows}\n; end of log\n"
        (tmp_path / f"{i:03}.dat").write_text(text)
    data = load_dataset(tmp_path, channel="Fz")
    np.testing.assert_array_equal(data.X, small.X)
    np.testing.assert_array_equal(data.y, small.y)


def test_a_counter_of_16_bits_that_starts_anew_is_a_clock(small: Dataset, tmp_path: Path) -> None:
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        first = 65_500 if i == 3 else 100 * i
        rows = [[str((first + 2 * k) % 65_536), str(v)] for k, v in enumerate(x)]
        write_rows(tmp_path / f"{i:03}_{word}.csv", [["tick_ms", "rForce"], *rows])
    data = load_dataset(tmp_path, channel="rForce", time="tick_ms")
    np.testing.assert_array_equal(data.X, small.X)
    assert data.rate_hz == 500.0
    assert "The clock tick_ms counts from 0 again: its times go on there." in data.notes


@pytest.mark.parametrize(
    "line",
    [
        "Sample rate: 500 Hz",
        "# fs = 500",
        "Sampling interval;0,002;s",
        "Abtastrate [kHz];0,5",
        "dt\t2 ms",
        "# sampling_hz: 500",
        "rate_hz=500",
        "Fréquence d'échantillonnage: 0.5 kHz",
        "samples per second;500",
    ],
)
def test_a_line_above_the_header_tells_the_rate_of_samples_without_a_clock(
    line: str, small: Dataset, tmp_path: Path
) -> None:
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        rows = "\n".join(f"{k};{v}".replace(".", ",") for k, v in enumerate(x))
        text = f"Machine: 4\n{line}\n\nSample;Force [N]\n{rows}\n"
        (tmp_path / f"{i:03}_{word}.csv").write_text(text)
    data = load_dataset(tmp_path, channel="Force")
    np.testing.assert_allclose(data.X, small.X, rtol=1e-6)
    assert data.rate_hz == 500.0
    assert data.reading["clock"] == "none, a line above the header states the rate"
    assert load_dataset(tmp_path, channel="Force", rate_hz=250.0).rate_hz == 250.0


def test_columns_of_a_database_in_capitals_tell_rate_and_unit(
    small: Dataset, tmp_path: Path
) -> None:
    lists = pd.DataFrame({"FORCE_KN": [list(map(float, x)) for x in small.X]})
    lists["SAMPLE_INTERVAL_MS"] = 2.5
    lists["RESULT"] = words(small)
    lists.to_parquet(tmp_path / "curves.parquet")
    data = load_dataset(tmp_path / "curves.parquet", label="RESULT", channel="FORCE_KN")
    assert (data.rate_hz, data.unit) == (400.0, "kN")


@pytest.mark.parametrize("mark", [-9999, 999.0])
def test_marks_that_fill_up_rows_are_no_samples_and_inside_a_trace_they_are_a_fault(
    mark: float, small: Dataset
) -> None:
    table = wide(small)
    lengths = 40 + np.arange(len(small)) % 10
    for i, n in enumerate(lengths):
        table.iloc[i, n:-1] = mark
    data = load_dataset(table, fit="pad")
    width = data.X.shape[1]
    for i, n in enumerate(lengths):
        np.testing.assert_allclose(data.X[i, :n], small.X[i, : min(n, width)])
        assert (data.X[i, n:] == data.X[i, min(n, width) - 1]).all()
    assert f"{mark:g} behind the last sample is left out" in " ".join(data.notes)
    table.iloc[3, 10:12] = mark
    faults = load_dataset(table, fit="pad").faults
    inside = wide(small)
    inside.iloc[3, 10:12] = mark
    assert not any("behind the last sample" in note for note in load_dataset(inside).notes)
    assert [fault.message for fault in faults] == [
        f"Expected measured samples, 2 samples are {mark:g}"
    ]


@pytest.mark.parametrize("size", [1, 13])
@pytest.mark.parametrize("is_sorted", [False, True])
def test_parts_whose_rows_lie_here_and_there_in_several_files_are_one_each(
    size: int, is_sorted: bool, small: Dataset, tmp_path: Path
) -> None:
    """The rows lie in blocks of one size, and may be in order in each file."""
    rng = np.random.default_rng(0)
    rows = pd.concat(
        pd.DataFrame({"serial": f"S{i:02}", "t_ms": np.arange(50) * 4, "force": x, "ok": word})
        for i, (x, word) in enumerate(zip(small.X, words(small), strict=True))
    )
    blocks = np.arange(len(rows)) // size
    file_of_block = rng.integers(4, size=len(rows))
    for k in range(4):
        own = rows[file_of_block[blocks] == k]
        if not is_sorted:
            own = own.sample(frac=1, random_state=k)
        own.to_parquet(tmp_path / f"part-{k:05}.parquet")
    data = load_dataset(tmp_path, part="serial", time="t_ms", channel="Force", label="ok")
    order = np.argsort(data.source)
    np.testing.assert_allclose(data.X[order], small.X)
    np.testing.assert_array_equal(data.y[order], small.y)


def test_parts_measured_again_in_another_file_stay_apart(small: Dataset, tmp_path: Path) -> None:
    for k in range(2):
        begins = pd.Timestamp("2026-03-01") + pd.Timedelta(days=k)
        clock = begins + pd.to_timedelta(np.arange(len(small.X) * 60) * 4, unit="ms")
        rows = [
            pd.DataFrame(
                {"serial": f"S{i:02}", "at": clock[60 * i :][:50], "force": x + k, "ok": w}
            )
            for i, (x, w) in enumerate(zip(small.X, words(small), strict=True))
        ]
        pd.concat(rows).to_parquet(tmp_path / f"day-{k}.parquet")
    data = load_dataset(tmp_path, part="serial", time="at", channel="Force", label="ok")
    assert data.X.shape == (2 * len(small.X), 50)


@pytest.mark.parametrize(
    "line",
    [
        "Counts per Unit Force:,1000",
        "countsPerN:,1000.0",
        "Force Units:,N,Counts per Unit Force:,1000.0,Counts per Unit Torque:,5",
    ],
)
def test_counts_per_unit_above_the_header_are_those_of_the_channels_quantity(
    line: str, small: Dataset, tmp_path: Path
) -> None:
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        rows = "\n".join(f"{k},{round(v * 1000)}" for k, v in enumerate(x))
        text = f"RDT Sample Rate:,500\n{line}\nRDT Sequence,Fz\n{rows}\n"
        (tmp_path / f"{i:03}_{word}.csv").write_text(text)
    data = load_dataset(tmp_path, channel="Fz")
    np.testing.assert_allclose(data.X, small.X, atol=6e-4)
    assert data.rate_hz == 500.0
    assert "(1000)" in data.notes[0]


def test_a_row_of_channel_numbers_is_no_first_row_of_samples(
    small: Dataset, tmp_path: Path
) -> None:
    above = "Device,GM10\nSampling Interval,5ms\nCH,,0001,0002\nTag,,FORCE,STROKE\nUnit,,N,mm\n"
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        rows = "\n".join(f"2024/06/20,08:{i:02}:12.{5 * k:03},{v},{k}" for k, v in enumerate(x))
        text = f"{above}Date,Time,FORCE,STROKE\n{rows}\n"
        (tmp_path / f"{i:03}_{word}.csv").write_text(text)
    data = load_dataset(tmp_path, channel="FORCE")
    np.testing.assert_allclose(data.X, small.X, rtol=1e-6)
    assert data.rate_hz == 200.0


def test_times_and_numbers_above_the_like_are_no_header(small: Dataset, tmp_path: Path) -> None:
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        lines = [f"10:15:{k / 80:06.3f} -> {v:.2f}" for k, v in enumerate(x, start=80)]
        (tmp_path / f"{i:03}_{word}.txt").write_text("\n".join(lines))
    with pytest.raises(DataError, match="name its 3 columns, columns='c0,c1,c2'"):
        load_dataset(tmp_path)
    data = load_dataset(tmp_path, columns=["time", "arrow", "force"], channel="force")
    np.testing.assert_allclose(data.X, small.X, atol=0.0051)
    assert data.rate_hz == pytest.approx(80.0, abs=0.2)


def test_a_listing_of_dates_and_words_is_split_at_its_commas(
    small: Dataset, tmp_path: Path
) -> None:
    folder = tmp_path / "parts"
    lines = ["time,part_id,status"]
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        write_csv(folder / f"B{i:03}.csv", x)
        lines.append(f"2024-09-04 06:{i:02}:11,B{i:03},{word}")
    (tmp_path / "results.csv").write_text("\n".join(lines))
    for label in ("status", None):
        data = load_dataset(folder, labels=tmp_path / "results.csv", label=label)
        np.testing.assert_array_equal(data.y, small.y)


def test_how_rows_were_read_is_told_with_the_number_of_recordings(
    small: Dataset, tmp_path: Path
) -> None:
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        above = "Machine: 4\n" * (1 if i else 2)
        rows = "\n".join(f"{k},{v}" for k, v in enumerate(x))
        (tmp_path / f"{i:03}_{word}.csv").write_text(f"{above}\nSample,Force\n{rows}\n")
    data = load_dataset(tmp_path, channel="Force")
    n = len(small) - 1
    told = f"header in line 3 ({n} of {n + 1}), header in line 4 (1 of {n + 1})"
    assert data.reading["rows"] == told


@pytest.mark.parametrize("line", ["dt: 2", "Rate: 3 parts/min", "Sample rate: fast"])
def test_a_line_that_states_no_rate_leaves_it_unknown(
    line: str, small: Dataset, tmp_path: Path
) -> None:
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        rows = "\n".join(f"{k};{v}" for k, v in enumerate(x))
        text = f"Machine: 4\n{line}\n\nSample;Force [N]\n{rows}\n"
        (tmp_path / f"{i:03}_{word}.csv").write_text(text)
    data = load_dataset(tmp_path, channel="Force")
    assert data.rate_hz is None
    assert not any("time='Sample'" in note for note in data.notes)  # it counts samples


@pytest.mark.parametrize("n_again", [2, 6])
def test_a_listing_by_serial_number_and_run_finds_the_file_of_each_run(
    n_again: int, small: Dataset, tmp_path: Path
) -> None:
    """Some parts, or all, were measured twice."""
    rows = []
    for i, (x, word) in enumerate(zip(small.X[:12], words(small), strict=False)):
        n_parts = 12 - n_again
        serial, run = (4700 + i, 1) if i < n_parts else (4700 + i - n_parts, 2)
        write_csv(tmp_path / f"SN{serial}_{run}.csv", x)
        rows.append([f"SN{serial}", str(run), word, "14.03.2026"])
    listing = write_rows(tmp_path.parent / "runs.csv", [["serial", "run", "result", "date"], *rows])
    data = load_dataset(tmp_path, labels=listing)
    assert not data.faults
    assert len(data) == 12
    by_name = sorted(range(12), key=lambda i: (rows[i][0], rows[i][1]))
    np.testing.assert_array_equal(data.y, small.y[:12][by_name])
    np.testing.assert_array_equal(data.X, small.X[:12][by_name])


def test_numbers_of_parts_that_start_anew_each_day_are_refused_with_advice(
    small: Dataset, tmp_path: Path
) -> None:
    times = pd.date_range("2026-03-14 06:00", periods=50, freq="2ms")
    frames = [
        pd.DataFrame(
            {"time": times + pd.Timedelta(hours=24 * (i // 6), seconds=30 * (i % 6))}
        ).assign(part=i % 6 + 1, day=14 + i // 6, force=x, verdict=word)
        for i, (x, word) in enumerate(zip(small.X[:12], words(small), strict=False))
    ]
    frame = pd.concat(frames)
    path = tmp_path / "week.csv"
    frame.to_csv(path, index=False)
    again = "6 of 6 numbers come again later, as 1 in line 302; make them unique, part='day,part'"
    options = {"time": "time", "label": "verdict", "channel": "force"}
    with pytest.raises(DataError, match=again.replace("day", "time")):
        load_dataset(path, **options)
    for source in (path, frame):
        for part, day in (("day,part", ""), ("time,part", "2026-03-")):
            data = load_dataset(source, **options, part=part)
            np.testing.assert_array_equal(data.X, small.X[:12])
            assert (data.source == [f"{day}{14 + i // 6}_{i % 6 + 1}" for i in range(12)]).all()


@pytest.mark.parametrize("date", ["%d.%m.%Y", "%m/%d/%Y", "%Y-%m-%d"])
@pytest.mark.parametrize("has_listing", [False, True])
def test_a_date_and_a_number_tell_the_part_also_where_the_time_of_day_has_its_own_column(
    date: str, has_listing: bool, small: Dataset, tmp_path: Path
) -> None:
    frames = list[pd.DataFrame]()
    for i, (x, word) in enumerate(zip(small.X[:12], words(small), strict=False)):
        start = pd.Timestamp("2026-03-14 06:00") + pd.Timedelta(days=i // 6, minutes=i % 6)
        times = pd.date_range(start, periods=50, freq="2ms")
        about = {"Datum": times.strftime(date), "Uhrzeit": times.strftime("%H:%M:%S.%f").str[:-3]}
        frames.append(pd.DataFrame({**about, "Nr": i % 6 + 1, "Kraft_N": x, "Bewertung": word}))
    frame = pd.concat(frames)
    path = tmp_path / "press.csv"
    frame.to_csv(path, index=False)
    options: dict[str, Any] = {"time": "Uhrzeit", "channel": "Kraft_N", "label": "Bewertung"}
    with pytest.raises(DataError, match=r"6 of 6 .* make them unique, part='Datum,Nr'"):
        load_dataset(path, **options, part="Nr")
    with pytest.raises(DataError, match=r"press.csv, No is none of Datum, Uhrzeit, Nr, Kraft_N"):
        load_dataset(path, **options, part="Datum,No")
    if has_listing:
        listing = frame[["Datum", "Nr", "Bewertung"]].drop_duplicates()
        listing.to_csv(tmp_path.parent / "l.csv", index=False)
        frame.drop(columns="Bewertung").to_csv(path, index=False)
        options["labels"] = tmp_path.parent / "l.csv"
    data = load_dataset(path, **options, part="Datum,Nr")
    np.testing.assert_allclose(data.X, small.X[:12], rtol=1e-6)
    np.testing.assert_array_equal(data.y, small.y[:12])
    assert data.rate_hz == 500


def test_several_columns_tell_the_part_of_a_wide_table_and_of_a_listing(
    few: Path, small: Dataset, tmp_path: Path
) -> None:
    columns = {"day": np.repeat(["14.03.2026", "15.03.2026"], 12), "nr": [*range(1, 13)] * 2}
    parts = [f"{day}_{nr}" for day, nr in zip(*columns.values(), strict=True)]
    table = small.to_frame().assign(**columns)
    table.to_csv(tmp_path / "wide.csv", index=False)
    table.to_parquet(tmp_path / "wide.parquet")
    for source in (table, tmp_path / "wide.csv", tmp_path / "wide.parquet"):
        data = load_dataset(source, part="day,nr")
        assert data.part is not None
        assert data.part.tolist() == parts
        assert not any(note.startswith("Not read") for note in data.notes)
    files = sorted(few.glob("*.csv"))
    listing = tmp_path / "listing.csv"
    rows = {
        "file": [file.name for file in files],
        "label": "ok",
        **{k: v[: len(files)] for k, v in columns.items()},
    }
    pd.DataFrame(rows).to_csv(listing, index=False)
    data = load_dataset(few, labels=listing, label="label", part="day,nr")
    assert data.part is not None
    assert data.part.tolist() == parts[: len(files)]


def test_parts_of_two_stations_at_the_same_time_are_told_apart_by_the_columns_of_the_error(
    small: Dataset,
) -> None:
    tables = [long_table(small, lambda i: 10.0 * i).assign(station=name) for name in "AB"]
    table = pd.concat(tables).sort_values("time", kind="stable")
    table.loc[table["station"] == "B", "FZ"] += 1
    with pytest.raises(DataError, match="make them unique, part='station,part'"):
        load_dataset(table, time="time", channel="FZ")
    assert len(load_dataset(table, time="time", channel="FZ", part="station,part")) == 48


def test_names_above_values_are_read_as_such(small: Dataset, tmp_path: Path) -> None:
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        rows = "\n".join(f"{k};{v};0" for k, v in enumerate(x))
        text = f"Result;Operator;Tool\n{word};Anna;T1\n\ntime [ms];Force [N];Way [mm]\n{rows}\n"
        (tmp_path / f"{i:03}.csv").write_text(text)
    data = load_dataset(tmp_path, channel="Force", label="Result")
    np.testing.assert_array_equal(data.y, small.y)


def test_a_result_that_is_that_of_the_part_before_until_the_end_counts_at_the_end(
    small: Dataset, tmp_path: Path
) -> None:
    before = "OK"
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        rows = [[f"{2 * k}", f"{v}", word if k > 45 else before] for k, v in enumerate(x)]
        write_rows(tmp_path / f"{i:03}.csv", [["time [ms]", "FZ", "result"], *rows])
        before = word
    data = load_dataset(tmp_path, channel="FZ")
    np.testing.assert_array_equal(data.y, small.y)
    assert not data.faults
    assert any("there its last value counts" in note for note in data.notes)
    rows = [[f"{2 * k}", f"{v}", "OK" if k % 2 else "NOK"] for k, v in enumerate(small.X[0])]
    write_rows(tmp_path / "999.csv", [["time [ms]", "FZ", "result"], *rows])
    assert "Expected one label" in load_dataset(tmp_path, channel="FZ").faults[0].message


def long_rows(data: Dataset, cell: Callable[[float, int, int], str]) -> list[list[str]]:
    """A row for each sample; `cell` writes it by its value, its part and its number."""
    rows = [["part", "time", "Kraft", "label"]]
    for i, (x, word) in enumerate(zip(data.X, words(data), strict=True)):
        rows += [[f"P{i}", f"{k / 100}", cell(v, i, k), word] for k, v in enumerate(x.tolist())]
    return rows


LONG = {"part": "part", "time": "time"}


@pytest.mark.parametrize("blank", ["", " "])
def test_units_in_the_cells_of_a_long_table_are_converted_and_noted(
    blank: str, small: Dataset, tmp_path: Path
) -> None:
    path = tmp_path / "long.csv"
    write_rows(path, long_rows(small, lambda v, i, k: f"{v}{blank}N"))
    data = load_dataset(path, **LONG)
    np.testing.assert_array_equal(data.X, small.X)
    assert (data.unit, data.notes) == ("N", ())
    write_rows(
        path, long_rows(small, lambda v, i, k: f"{v}{blank}N" if i % 3 else f"{v / 1e3}{blank}kN")
    )
    data = load_dataset(path, **LONG)
    np.testing.assert_allclose(data.X, small.X, rtol=1e-5)
    assert data.notes == ("Column Kraft has kN, N in its cells: all are N now.",)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ("{} Nm", "line 52: .*cells of Kraft, got Nm, and N in line 2"),
        ("{} kp", "line 52: .*cells of Kraft, got kp, and N in line 2"),
        ("{}", "line 52: .*cells of Kraft, got no unit, and N in line 2"),
    ],
)
def test_units_of_several_quantities_in_the_cells_are_refused_with_both_lines(
    other: str, message: str, small: Dataset, tmp_path: Path
) -> None:
    path = tmp_path / "long.csv"
    write_rows(path, long_rows(small, lambda v, i, k: other.format(v) if i % 2 else f"{v} N"))
    with pytest.raises(DataError, match=message):
        load_dataset(path, **LONG)


@pytest.mark.parametrize(
    "status", ["Bad Input", "I/O Timeout", "#N/A", "-", "[-11059] No Data", "1.#QNAN"]
)
def test_a_status_in_place_of_a_number_is_a_lost_sample_that_is_noted(
    status: str, small: Dataset, tmp_path: Path
) -> None:
    path = tmp_path / "long.csv"
    rows = long_rows(
        small, lambda v, i, k: status if (i, k) == (3, 7) or (i == 5 and k > 20) else str(v)
    )
    write_rows(path, rows)
    data = load_dataset(path, **LONG)
    assert [fault.source for fault in data.faults] == ["P5"]
    assert "29 of 50 rows" in data.faults[0].message
    expected = np.delete(small.X, 5, axis=0)
    expected[3, 7] = np.nan
    np.testing.assert_array_equal(data.X, expected)
    assert any(repr(status) in note and "they are NaN" in note for note in data.notes)
    evenly = load_dataset(path, **LONG, fit="resample").X
    np.testing.assert_allclose(evenly[3, 7], (small.X[3, 6] + small.X[3, 8]) / 2, rtol=1e-3)


def lose_samples(folder: Path, data: Dataset, lost: dict[int, tuple[str, int]]) -> Path:
    """Recordings with a text in some samples on end from the 21st on: the text and their number."""
    for i, (trace, label) in enumerate(zip(data.X, data.y, strict=True)):
        cells = [str(v) for v in trace]
        text, n = lost.get(i, ("", 0))
        cells[20 : 20 + n] = [text] * n
        path = folder / f"{i:02}_{'OK' if label else 'NOK'}.csv"
        path.parent.mkdir(exist_ok=True)
        rows = [f"{k / 500};{cell}" for k, cell in enumerate(cells)]
        path.write_text("\n".join(["Time (s);Force (N)", *rows, ""]))
    return folder


def test_the_advice_to_interpolate_counts_the_samples_that_it_would_repair(
    make_data, tmp_path: Path
) -> None:
    data = make_data(20, samples=400)
    lost = {1: ("Bad Input", 3), 2: ("Bad Input", 5), 3: ("OVERFLOW", 11), 4: ("+++++++", 2)}
    folder = lose_samples(tmp_path / "parts", data, lost)
    notes = load_dataset(folder).notes
    by_word = {key: [n for n in notes if key in n] for key in ("'Bad", "'OVER", "'+++")}
    short, long = by_word["'Bad"]
    assert short.endswith("fit='resample' interpolates these, 4 on end at most (3 times).")
    assert long.endswith("more on end than fit='resample' interpolates (5 times).")
    for key in ("'OVER", "'+++"):
        assert "the range of the sensor was exceeded: they are NaN" in by_word[key][0]
        assert "resample" not in by_word[key][0]


@pytest.mark.parametrize("rate_hz", [None, 500])
def test_few_lost_samples_on_end_are_interpolated_and_more_are_a_fault_that_names_the_word(
    rate_hz: float | None, make_data, tmp_path: Path
) -> None:
    data = make_data(20, samples=400)
    lost = {1: ("Bad Input", 4), 2: ("Bad Input", 5), 3: ("OVERFLOW", 11)}
    folder = lose_samples(tmp_path / "parts", data, lost)
    loaded = load_dataset(folder, fit="resample", rate_hz=rate_hz)
    expected = data.X.copy()
    expected[1, 20:24] = np.interp(np.arange(20, 24), [19, 24], data.X[1, [19, 24]])
    np.testing.assert_allclose(loaded.X, np.delete(expected, [2, 3], axis=0), rtol=1e-4)
    texts = [fault.message for fault in loaded.faults]
    assert "got 'Bad Input', in 5 rows on end; fit='resample' interpolates 4" in texts[0]
    assert "got 'OVERFLOW', in 11 rows on end" in texts[1]


@pytest.mark.parametrize("unit", ["N", "kN", None])
def test_the_first_recording_is_described_in_the_unit_of_the_set(
    unit: str | None, small: Dataset, tmp_path: Path
) -> None:
    for i, trace in enumerate(small.X):  # most are in newtons, but the first is in kN
        name = "Force [kN]" if i < 3 else "Force [N]"
        write_csv(tmp_path / f"{i:02}_OK.csv", trace / (1000 if i < 3 else 1), (name,))
    data = load_dataset(tmp_path, channel="Force", unit=unit)
    first, last = data.X[0, [0, -1]]
    assert data.unit == (unit or "N")
    text = f"Force {first:.6g} to {last:.6g} {data.unit} in 50 samples"
    assert data.reading["first"].endswith(text)


def test_a_damaged_number_is_no_status(small: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "long.csv"
    write_rows(path, long_rows(small, lambda v, i, k: "1x2.5" if (i, k) == (3, 7) else str(v)))
    assert [fault.source for fault in load_dataset(path, **LONG).faults] == ["P3"]


@pytest.mark.parametrize(
    "form",
    [
        "%d-%b-%y %H:%M:%S.%f",
        "%d-%b-%Y %H:%M:%S.%f",
        "%b %d %Y %H:%M:%S.%f",
        "%d-Mär-%y %H:%M:%S.%f",
        "%d.%m.%y %H:%M:%S.%f",
    ],
)
def test_dates_of_historians_are_times(form: str, small: Dataset, tmp_path: Path) -> None:
    rows = long_rows(small, lambda v, i, k: str(v))
    start = pd.Timestamp("2026-03-11 23:59:00")
    for i, row in enumerate(rows[1:]):  # the parts are backwards in the file
        part, k = divmod(i, 50)
        time = start + pd.Timedelta(seconds=30 * (23 - part) + k / 100)
        row[1] = time.strftime(form.replace("%d-Mär", f"{time.day}-Mär"))
    data = load_dataset(write_rows(tmp_path / "long.csv", rows), **LONG)
    np.testing.assert_array_equal(data.X, small.X[::-1])
    assert (data.rate_hz, data.ordered) == (100.0, True)


def test_a_long_table_whose_times_cannot_be_read_is_read_without_them(
    small: Dataset, tmp_path: Path
) -> None:
    rows = long_rows(small, lambda v, i, k: str(v))
    for row in rows[1:]:
        row[1] = f"tick {row[1]}"
    path = write_rows(tmp_path / "long.csv", rows)
    with pytest.raises(DataError, match="time='none' and a stated rate"):
        load_dataset(path, **LONG)
    data = load_dataset(path, part="part", time="none", rate_hz=100, unit="N")
    np.testing.assert_array_equal(data.X, small.X)
    assert data.notes == ()


@pytest.mark.parametrize("is_annotated", [True, False])
@pytest.mark.parametrize("n_first", [24, 10])
def test_tables_of_influxdb_are_one_long_table_of_their_signals(
    is_annotated: bool, n_first: int, small: Dataset, tmp_path: Path
) -> None:
    """Behind `n_first` parts a table with another order of columns and one column more begins."""
    lines: list[str] = []
    names = ["_time", "_value", "_field", "_measurement", "serial", "verdict"]
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        if i in (0, n_first):
            header = names if i == 0 else [*names[:4], "verdict", "serial", "line"]
            notes = [f"#{name}" + "," * (len(header) + 4) for name in ("group", "datatype")]
            header_line = ",".join(["", "result", "table", "_start", "_stop", *header])
            lines += ["", *(notes if is_annotated else []), header_line]
        for table, field in enumerate(("force", "way", "state")):
            for k, v in enumerate(x.tolist()):
                value = {"force": f"{v}", "way": f"{k / 10}", "state": "RUN"}[field]
                time = pd.Timestamp("2026-03-11T06:00:00Z") + pd.Timedelta(seconds=9 * i + k / 100)
                cells = dict(zip(names, [time.isoformat(), value, field, "press"], strict=False))
                cells |= {"serial": f"P{i}", "verdict": word, "line": "L2"}
                row = [cells[name] for name in header]
                span = ["2026-03-11T00:00:00Z", "2026-03-12T00:00:00Z"]
                lines.append(",".join(["", "", str(3 * i + table), *span, *row]))
    path = tmp_path / "influx.csv"
    path.write_text("\r\n".join(lines[1:]) + "\r\n")
    options = {"part": "serial", "label": "verdict"}
    with pytest.raises(DataError, match="time='_time', channel='force'"):
        load_dataset(path, **options)
    data = load_dataset(path, **options, time="_time", channel="force")
    np.testing.assert_array_equal(data.X, small.X)
    np.testing.assert_array_equal(data.y, small.y)
    assert (data.rate_hz, data.faults) == (100.0, ())


CURVES: dict[str, tuple[str, Callable[[list[str]], str]]] = {
    "JSON in quotes": (",", lambda items: f'"[{", ".join(items)}]"'),
    "JSON without quotes": (",", lambda items: f"[{','.join(items)}]"),
    "PostgreSQL": (";", lambda items: f"{{{','.join(items)}}}"),
    "semicolons": (",", lambda items: f'"{";".join(items)}"'),
    "semicolons without quotes": (",", lambda items: ";".join(items)),
    "blanks": ("\t", lambda items: " ".join(items)),
    "decimal commas": (";", lambda items: " ".join(items).replace(".", ",")),
    "bars": (";", lambda items: "|".join(items).replace(".", ",")),
}


@pytest.mark.parametrize("form", CURVES)
def test_a_curve_in_one_cell_of_a_text_is_a_trace(
    form: str, small: Dataset, tmp_path: Path
) -> None:
    delimiter, write = CURVES[form]
    rows = [["serial", "Kraft [kN]", "verdict"]]
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        rows.append([f"{100 + i}", write([f"{v:.9f}" for v in x]), word])
    path = tmp_path / "curves.csv"
    path.write_text("\n".join(map(delimiter.join, rows)) + "\n")
    data = load_dataset(path, part="serial")
    np.testing.assert_allclose(data.X, small.X, atol=1e-7)
    np.testing.assert_array_equal(data.y, small.y)
    assert (data.unit, data.faults) == ("kN", ())
    assert data.part is not None
    assert data.part[0] == "100"


@pytest.mark.parametrize("form", ["parquet", "json", "jsonl", "frame"])
def test_lists_in_cells_are_traces_with_the_rate_of_the_times_beside_them(
    form: str, small: Dataset, tmp_path: Path
) -> None:
    """One part has a shorter curve, one none, and one an item that is no number."""
    rows = [
        {"serial": f"P{i}", "t": [k / 100 for k in range(50)], "force": x.tolist(), "verdict": word}
        for i, (x, word) in enumerate(zip(small.X, words(small), strict=True))
    ]
    rows[2] |= {"t": rows[2]["t"][:45], "force": rows[2]["force"][:45]}
    rows[3] |= {"t": None, "force": None}
    path = tmp_path / f"curves.{form}"
    source: Any = path
    if form == "json":
        path.write_text(json.dumps(rows))
    elif form == "jsonl":
        path.write_text("\n".join(map(json.dumps, rows)))
    elif form == "parquet":
        pd.DataFrame(rows).to_parquet(path)
    else:
        source = pd.DataFrame(rows)
    data = load_dataset(source, part="serial")
    np.testing.assert_array_equal(data.X[3:], small.X[4:])
    assert (data.rate_hz, data.lengths[2]) == (100.0, 45)
    place = f"{'row' if form == 'frame' else path.name}, part P3, line 4"
    texts = [str(fault) for fault in data.faults]
    assert texts == [f"{place}: Expected a curve in column force, it is empty"]
    frame = pd.DataFrame(rows)
    frame[["serial", "verdict"]][6:].to_csv(tmp_path / "results.csv", index=False)
    listed = load_dataset(
        frame.drop(columns="verdict"), part="serial", labels=str(tmp_path / "results.csv")
    )
    np.testing.assert_array_equal(listed.X, small.X[6:])
    np.testing.assert_array_equal(listed.y, small.y[6:])
    rows[5]["t"] = [k / 50 for k in range(50)]
    data = load_dataset(pd.DataFrame(rows), part="serial")
    (fault, _) = data.faults
    assert re.match(
        r"row, part P5, line 6: Expected times in column t at 100 Hz.*got 50 Hz", str(fault)
    )
    np.testing.assert_array_equal(data.X[3:], small.X[[4, *range(6, len(small))]])


@pytest.mark.parametrize("empty", [[], None])
def test_a_file_whose_curve_is_empty_is_a_fault_among_others(
    empty: Any, small: Dataset, tmp_path: Path
) -> None:
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        row = {"id": f"P{i}", "fs_hz": 100, "verdict": word, "force": empty if i == 4 else [*x]}
        (tmp_path / f"{i:02}.json").write_text(json.dumps(row, default=float))
    data = load_dataset(tmp_path, channel="force", label="verdict")
    np.testing.assert_array_equal(data.X, np.delete(small.X, 4, axis=0))
    (fault,) = data.faults
    assert fault.source == "04.json"
    assert "empty" in fault.message


def test_an_item_of_a_curve_that_is_no_number_is_named_as_the_file_has_it(small: Dataset) -> None:
    frame = pd.DataFrame({"force_N": [*small.X.tolist()], "verdict": words(small), "part": "A"})
    frame["part"] = [f"A{i}" for i in range(len(frame))]
    frame.loc[3, "force_N"][7] = "ERR"
    (fault,) = load_dataset(frame, rate_hz=100).faults
    text = "row, part A3, line 4: Expected a number as item 8 of the curve in column force_N"
    assert str(fault) == f"{text}, got 'ERR'"


def test_a_curve_whose_name_changed_by_its_unit_is_one_channel(
    small: Dataset, tmp_path: Path
) -> None:
    rows = [
        {"serial": f"P{i}", "torque" if i < 15 else "torque_Nm": x.tolist(), "verdict": word}
        for i, (x, word) in enumerate(zip(small.X, words(small), strict=True))
    ]
    path = tmp_path / "curves.jsonl"
    path.write_text("\n".join(map(json.dumps, rows)))
    data = load_dataset(path, part="serial", channel="torque", rate_hz=100)
    np.testing.assert_array_equal(data.X, small.X)
    assert (data.channels, data.unit) == (("torque_Nm",), "Nm")
    assert "torque (15 rows) and torque_Nm (9) are read as one channel" in data.notes[0]
    rows[0]["torque_Nm"] = rows[1]["torque"]
    path.write_text("\n".join(map(json.dumps, rows)))
    assert len(load_dataset(path, part="serial", channel="torque", rate_hz=100).X) == 15


def pieces_of(data: Dataset, **names: str) -> list[dict[str, Any]]:
    """Each trace in four rows of 17, 17, 13 and 3 samples, those of two parts interleaved."""
    rows = []
    for i, (x, word) in enumerate(zip(data.X, words(data), strict=True)):
        for n, start, end in ((0, 0, 17), (1, 17, 34), (2, 34, 47), (3, 47, 50)):
            counters = {"chunk": n, "chunks": 4, "seq": n + 1, "offset": start}
            row = {"ts": 60 * (i // 2) + 2 * n + i % 2, "serial": f"P{i:02}", "sample_ms": 2}
            row |= {names[name]: value for name, value in counters.items() if name in names}
            rows.append(row | {"verdict": word if n == 3 else None, "force": x[start:end].tolist()})
    # Pieces 1 and 2 of the first part came in the other order.
    rows[1]["ts"], rows[2]["ts"] = rows[2]["ts"], rows[1]["ts"]
    return sorted(rows, key=lambda row: row["ts"])


def write_pieces(rows: list[dict[str, Any]], form: str, folder: Path) -> Any:
    path = folder / f"curves.{form}"
    if form == "jsonl":
        path.write_text("\n".join(map(json.dumps, rows)))
    elif form == "json":
        (folder / "messages").mkdir()
        for i, row in enumerate(rows):
            row = {name: cell for name, cell in row.items() if cell is not None}
            (folder / "messages" / f"{i:04}.json").write_text(json.dumps(row))
        return folder / "messages"
    elif form == "parquet":
        pd.DataFrame(rows).to_parquet(path)
    else:
        frame = pd.DataFrame(rows)
        frame["force"] = [";".join(map(repr, cell)).replace(".", ",") for cell in frame["force"]]
        frame.to_csv(path, index=False)
    return path


@pytest.mark.parametrize(
    ("form", "names"),
    [
        ("jsonl", {"chunk": "chunk", "chunks": "chunks"}),
        ("json", {"seq": "blockNo"}),
        ("parquet", {"offset": "offset"}),
        ("csv", {"seq": "segment_index", "chunks": "n_segments"}),
    ],
)
def test_curves_in_pieces_are_joined_in_the_order_of_their_counter(
    form: str, names: dict[str, str], small: Dataset, tmp_path: Path
) -> None:
    rows = pieces_of(small, **names)
    data = load_dataset(write_pieces(rows, form, tmp_path), part="serial")
    np.testing.assert_array_equal(data.X, small.X)
    np.testing.assert_array_equal(data.y, small.y)
    assert (data.rate_hz, data.faults) == (500.0, ())
    counter = next(iter(names.values()))
    text = f"24 curves are joined of 96 pieces, in the order of column {counter}"
    assert f"{text}." in data.notes
    with pytest.raises(DataError, match=r"whose pieces column \w+ counts, as in part='serial'"):
        load_dataset(pd.DataFrame(pieces_of(small, chunk="chunk", chunks="chunks")))
    del rows[9]
    rows.append(rows[20])
    data = load_dataset(pd.DataFrame(rows), part="serial")
    assert (len(data), len(data.faults)) == (23, 1)
    assert "Expected all 4 pieces of serial P03, got " in data.faults[0].message
    assert any("92 pieces" in note and note.endswith("; 1 came twice.") for note in data.notes)


def test_rows_of_a_part_that_are_whole_curves_are_not_joined(small: Dataset) -> None:
    rows = [
        {"vin": f"V{i // 4}", "seq": i % 4 + 1, "torque": x.tolist(), "result": "OK"}
        for i, x in enumerate(small.X)
    ]
    data = load_dataset(pd.DataFrame(rows), part="vin")
    np.testing.assert_array_equal(data.X, small.X)
    note = "Rows of one vin are read as a curve each; if they are pieces of one curve, call"
    assert any(text.startswith(note) for text in data.notes)
    rows[5]["result"] = rows[10]["result"] = rows[12]["result"] = rows[16]["result"] = "NOK"
    assert len(load_dataset(pd.DataFrame(rows).rename(columns={"seq": "block"}), part="vin")) == 24


def counts_of(data: Dataset) -> tuple[np.ndarray, list[float]]:
    """Each trace in counts, and what one of them is, by turns 0.001 and 0.004."""
    factors = [0.001 if i % 3 else 0.004 for i in range(len(data))]
    return np.round(data.X / np.array(factors)[:, None]), factors


def write_counts(data: Dataset, form: str, folder: Path) -> tuple[Any, dict[str, Any]]:
    counts, factors = counts_of(data)
    rows = [
        {"vin": f"V{i:02}", "status": word, "unit": "Nm", "samples": x.astype(int).tolist()}
        for i, (x, word) in enumerate(zip(counts, words(data), strict=True))
    ]
    folder = folder / "data"
    folder.mkdir()
    for row, factor in zip(rows, factors, strict=True):
        if form == "json":
            row["coefficient_multiply"] = factor
        if form == "parquet":
            row["countsPerNm"] = round(1 / factor)
        if form in ("json", "parquet"):
            (folder / f"{row['vin']}.json").write_text(json.dumps(row))
            continue
        mark = "," if form == "header" else "."
        above = f"Skalierungsfaktor [Nm/digit];{factor}\n".replace(".", mark)
        lines = ["raw", *map(str, row["samples"])]
        if form == "column":
            above = ""
            lines = ["raw;lsb", *(f"{x};{factor}" for x in row["samples"])]
        (folder / f"{row['vin']}_{row['status']}.csv").write_text(above + "\n".join(lines) + "\n")
    if form == "parquet":
        pd.DataFrame(rows).to_parquet(folder / "all.parquet")
        return folder / "all.parquet", {"part": "vin", "channel": "samples"}
    if form == "json":
        return folder, {"part": "vin", "channel": "samples"}
    return folder, {"channel": "raw", "unit": "Nm"}


@pytest.mark.parametrize("form", ["json", "parquet", "header", "column"])
def test_counts_are_multiplied_by_the_factor_that_each_part_states(
    form: str, small: Dataset, tmp_path: Path
) -> None:
    source, options = write_counts(small, form, tmp_path)
    data = load_dataset(source, **options)
    np.testing.assert_allclose(data.X, small.X, atol=0.0021)
    np.testing.assert_array_equal(data.y, small.y)
    assert (data.unit, data.faults) == ("Nm", ())
    range_of = "(250 to 1000)" if form == "parquet" else "(0.001 to 0.004)"
    assert " is in counts, " in data.notes[0]
    assert range_of in data.notes[0]
    assert not any("Not read" in note and "oefficient" in note for note in data.notes)


@pytest.mark.parametrize(
    ("channel", "others", "scale", "note"),
    [
        ("a", {"gain": [1, 2]}, (1, 0), "gain (1 to 2) may scale the whole numbers of a, which is"),
        ("a", {"angle_factor": [0.1, 0.2]}, (1, 0), "Not read: the columns angle_factor"),
        (
            "a [N]",
            {"lsb": [0.1, 0.1]},
            (1, 0),
            "lsb (0.1) is not applied, for the samples of a [N]",
        ),
        ("a", {"lsb": [0.1, 0.1], "offset": [0, 5]}, (0.1, 0), "; offset (0 to 5) is not applied"),
        ("a", {"factor": [2, 2], "add_offset": [1, 1]}, (2, 1), "plus add_offset (1)."),
        ("a", {"a_divisor": [4, 4], "b_divisor": [3, 5]}, (0.25, 0), "over a_divisor (4)."),
        ("a", {"factor": [0.5, None]}, (0.5, 0), "a is in counts, times factor (0.5)."),
        ("a", {"scale": [0.5, 0.5], "factor": [2, 2]}, (1, 0), "scale (0.5), factor (2) may scale"),
    ],
)
def test_only_a_plain_factor_of_whole_numbers_is_applied(
    channel: str,
    others: dict[str, list[float]],
    scale: tuple[float, float],
    note: str,
    small: Dataset,
) -> None:
    counts, _ = counts_of(small)
    frame = pd.DataFrame({channel: counts.tolist(), "verdict": words(small)})
    frame = frame.assign(**{name: cells * 12 for name, cells in others.items()})
    data = load_dataset(frame, channel=channel)
    assert note in data.notes[0]
    is_kept = frame.notna().all(axis=1).to_numpy()
    np.testing.assert_allclose(data.X, counts[is_kept] * scale[0] + scale[1], rtol=1e-6)
    messages = [fault.message for fault in data.faults]
    assert messages == ["Expected a factor of the counts of a, got none"] * int((~is_kept).sum())
    frame[channel] = (counts + 0.5).tolist()
    data = load_dataset(frame, channel=channel)
    np.testing.assert_allclose(data.X, counts + 0.5, rtol=1e-6)


def test_each_of_two_channels_has_the_factor_that_names_it(small: Dataset) -> None:
    counts, _ = counts_of(small)
    frame = pd.DataFrame({"torque_raw": counts.tolist(), "angle_raw": (counts + 1).tolist()})
    frame = frame.assign(torque_factor=0.5, angle_factor=0.25, factor=3, verdict=words(small))
    data = load_dataset(frame, channel="torque_raw,angle_raw")
    np.testing.assert_allclose(data.X, np.stack([counts / 2, (counts + 1) / 4], axis=1))
    data = load_dataset(frame, channel="angle_raw")
    np.testing.assert_allclose(data.X, (counts + 1) / 4)


def test_a_wide_table_whose_cells_have_several_units_is_refused_or_converted(
    small: Dataset, tmp_path: Path
) -> None:
    texts = wide(small).astype(str)
    samples = texts.columns[:50]
    texts[samples] = texts[samples] + " N"
    texts.to_csv(tmp_path / "wide.csv", index=False)
    data = load_dataset(tmp_path / "wide.csv")
    np.testing.assert_array_equal(data.X, small.X)
    assert data.unit == "N"
    texts["FZ_7"] = texts["FZ_7"].str.replace("N", "kN")
    texts.to_csv(tmp_path / "wide.csv", index=False)
    with pytest.raises(DataError, match=r"one unit of the columns of FZ, got .*FZ_7 in kN"):
        load_dataset(tmp_path / "wide.csv")


TELL_LABELS = {  # the columns of a listing beside the files' names -> what the error proposes
    "one has labels": ({"Inspector": ["Anna", "Bob"], "Decision": ["OK", "rework"]}, "Decision"),
    "two have labels": (
        {"Inspector": ["Anna", "Bob"], "Visual": ["NOK", "OK"], "Height": ["OK", "NOK"]},
        "Visual (NOK, OK) or --label Height (OK, NOK)",
    ),
    "none has labels": (
        {"Inspector": ["Anna", "Bob"], "Decision": ["heil", "Riss"]},
        "Inspector (Anna, Bob) or --label Decision (heil, Riss)",
    ),
}


@pytest.mark.parametrize("form", TELL_LABELS)
def test_the_error_proposes_the_column_whose_words_are_labels_or_shows_all(
    form: str, small: Dataset, tmp_path: Path
) -> None:
    columns, proposal = TELL_LABELS[form]
    cells = {name: [words[i % 2] for i in range(24)] for name, words in columns.items()}
    for i, trace in enumerate(small.X):
        write_csv(tmp_path / "cell" / f"part_{i}.csv", trace)
    files = {"file": [f"part_{i}.csv" for i in range(24)]}
    pd.DataFrame({**files, **cells}).to_csv(tmp_path / "l.csv", index=False)
    wide(small).drop(columns="label").assign(**cells).to_csv(tmp_path / "wide.csv", index=False)
    for source, listing in ((tmp_path / "cell", tmp_path / "l.csv"), (tmp_path / "wide.csv", None)):
        with pytest.raises(DataError) as caught:
            load_dataset(source, labels=listing)
        assert f"--label {proposal}" in as_options(str(caught.value))


@pytest.mark.parametrize(
    ("good", "bad"), [("合格", "不合格"), ("良品", "不良"), ("합격", "불합격")]
)
def test_verdicts_of_east_asian_listings_are_labels(
    good: str, bad: str, small: Dataset, tmp_path: Path
) -> None:
    for i, trace in enumerate(small.X):
        write_csv(tmp_path / "cell" / f"part_{i}.csv", trace)
    rows = [
        f"part_{i}.csv,{'田中' if i % 2 else '鈴木'},{good if y else bad}"
        for i, y in enumerate(small.y)
    ]
    (tmp_path / "l.csv").write_text("\n".join(["ファイル,検査者,判定", *rows]), "utf-8")
    data = load_dataset(tmp_path / "cell", labels=tmp_path / "l.csv")
    np.testing.assert_array_equal(data.y, small.y)


def test_short_recordings_of_stopped_parts_are_kept_if_the_user_says_so(
    small: Dataset, tmp_path: Path
) -> None:
    for i, trace in enumerate(small.X[:12]):
        write_csv(tmp_path / f"part_{i}_OK.csv", trace)
    write_csv(tmp_path / "stop_1_NOK.csv", small.X[0][:20])
    write_csv(tmp_path / "stop_2_NOK.csv", small.X[1][:12])
    write_csv(tmp_path / "long_OK.csv", np.tile(small.X[0], 3))
    data = load_dataset(tmp_path)
    text = "2 of 3 recordings that are left out for their length are bad: --fit pad-all keeps them."
    assert text in [as_options(note) for note in data.notes]
    assert len(data) == 12
    assert all("--fit pad-all keeps it" in as_options(fault.message) for fault in data.faults)
    kept = load_dataset(tmp_path, fit="pad-all")
    assert (len(kept), kept.faults, kept.fit, kept.spec.fit) == (15, (), "pad", "pad")
    assert "2 shorter than half of 50 samples repeat their last one" in " ".join(kept.notes)
    np.testing.assert_array_equal(kept.X[-2], np.r_[small.X[0][:20], np.full(30, small.X[0][19])])
    assert sorted(kept.lengths.tolist()) == [12, 20, *[50] * 12, 150]
    survey = document("data", tmp_path, "--fit", "pad-all")["survey"]
    assert (survey["good"], survey["bad"]) == (13, 2)


def write_below(line: str, folder: Path, columns: str = "FX,FZ", step: int = 0) -> Path:
    """Two recordings of 60 samples below a line; the first of two columns rises by `step`."""
    folder.mkdir()
    for name, phase in (("a_OK.csv", 0), ("b_NOK.csv", 1)):
        rows = [
            f"{i * step},{np.sin(i + phase):.3f}"[-6 if columns == "FZ" else 0 :] for i in range(60)
        ]
        rows = [row.strip(",") for row in rows]
        (folder / name).write_text("\n".join([*filter(None, [line]), columns, *rows, ""]))
    return folder


RATES_ABOVE = {
    **dict.fromkeys(("Sample rate: 500", "fs;500", "Rate: 500 Hz", "Abtastrate [kHz];0.5"), 500.0),
    **dict.fromkeys(("Rate: 5", "Data rate: 115200", "Frequency: 50 Hz", "dt: 2", "rate = 2,5")),
}


@pytest.mark.parametrize("line", RATES_ABOVE)
def test_a_line_states_the_rate_only_if_it_is_that_of_samples_else_it_is_offered(
    line: str, tmp_path: Path
) -> None:
    folder = write_below(line, tmp_path / "cell")
    data = load_dataset(folder, channel="FZ")
    assert data.rate_hz == RATES_ABOVE[line]
    offers = [as_options(note) for note in data.notes if f"A line says {line!r}" in note]
    assert [("--rate-hz" in offer) for offer in offers] == ([True] if data.rate_hz is None else [])
    lone = write_below(line, tmp_path / "lone", columns="FZ")
    assert (load_dataset(lone).channels, load_dataset(lone).rate_hz) == (("FZ",), data.rate_hz)
    stated = load_dataset(folder, channel="FZ", rate_hz=100.0)
    assert not any("A line says" in note for note in stated.notes)


@pytest.mark.parametrize("form", ["line", "column", "column beside a label", "file beside"])
def test_what_a_recording_states_of_its_part_tells_parts_with_several_recordings(
    form: str, small: Dataset, tmp_path: Path
) -> None:
    parts = [f"SN{min(i, 22)}" for i in range(24)]
    for i, (x, part, word) in enumerate(zip(small.X, parts, words(small), strict=True)):
        rows = pd.DataFrame({"time": np.arange(50) / 500, "force": x})
        path = tmp_path / f"{i:02}_{word}.csv"
        if form == "column beside a label":
            path = tmp_path / f"{i:02}.csv"
            rows = rows.assign(Status=word)
        if form.startswith("column"):
            rows = rows.assign(Identifier=part)
        text = rows.to_csv(index=False)
        path.write_text(f"# Identifier: {part}\n{text}" if form == "line" else text)
        if form == "file beside":
            path.with_suffix(".txt").write_text(f"Identifier: {part}\nLine: 3\n")
    data = load_dataset(tmp_path, channel="force", part="Identifier")
    assert data.part is not None
    assert data.part.tolist() == parts
    np.testing.assert_array_equal(data.X, small.X)
    np.testing.assert_array_equal(data.y, small.y)
    assert "1 part has several recordings: SN22." in data.notes


def test_a_recording_that_states_no_part_or_two_is_named(few: Path, small: Dataset) -> None:
    for i, path in enumerate(sorted(few.iterdir())):
        parts = [f"# Nr: {i}", "# Nr:"][i == 2]
        path.write_text(f"# Line: 7\n{parts}\n{path.read_text()}")
    data = load_dataset(few, part="Nr")
    assert data.part is not None
    assert data.part.tolist() == ["0", "1", str(data.source[2]), "3"]
    assert "No Nr is stated: the recording is a part of its own." in data.notes
    joined = load_dataset(few, part="Line,Nr").part
    assert joined is not None
    assert joined[3] == "7_3"
    with pytest.raises(DataError, match="column No, or such a column or line in each file, found"):
        load_dataset(few, part="Line,No")
    first = min(few.iterdir())
    rows = pd.read_csv(first, comment="#").assign(Nr=["A", *"B" * 49])
    rows.to_csv(first, index=False)
    (fault,) = load_dataset(few, part="Nr").faults
    assert "Expected one part in column Nr, got A, B" in str(fault)


RATE_COLUMNS = (
    *("sampling_hz", "sample_rate", "sampling_rate_hz", "SampleRate", "fs", "fs_hz", "rate_hz"),
    *("Abtastrate", "freq_hz", "meta.samplingRateHz", "acq_rate_hz", "Abtastfrequenz [Hz]"),
)


def two_rates(name: str, small: Dataset) -> pd.DataFrame:
    """A row for each of 24 curves; the last eight were recorded at twice the rate."""
    curves = [np.repeat(x, 1 + (i > 15)).tolist() for i, x in enumerate(small.X)]
    rates = np.where(np.arange(24) > 15, 1000, 500)
    return pd.DataFrame({"serial": range(24), name: rates, "force": curves, "ok": small.y})


@pytest.mark.parametrize("name", RATE_COLUMNS)
def test_a_column_whose_name_states_a_rate_tells_that_of_each_row(
    name: str, small: Dataset
) -> None:
    table = two_rates(name, small)
    data = load_dataset(table, label="ok")
    assert (len(data), data.rate_hz) == (16, 500.0)
    assert "Expected timestamps at 500 Hz, as the others have, got 1000 Hz" in str(data.faults[0])
    for time in (None, name):
        data = load_dataset(table, label="ok", fit="resample", time=time, samples=50)
        assert (len(data), data.rate_hz) == (24, 500.0)
        np.testing.assert_array_equal(data.X, small.X)
        assert data.reading["clock"] == f"none, column {name} states the rate"


def test_a_stated_column_of_times_is_not_ignored_in_a_table_of_curves(small: Dataset) -> None:
    table = two_rates("frequency", small)
    with pytest.raises(DataError, match="Expected a column t of times in row, found serial, freq"):
        load_dataset(table, label="ok", time="t")
    data = load_dataset(table, label="ok", time="frequency")
    note = "Column frequency has one value for each curve, and is no clock of samples."
    assert note in data.notes
    assert data.rate_hz is None


@pytest.mark.parametrize("form", ["wide", "recordings", "long", "archive", "archives"])
def test_each_form_states_the_rate_of_each_recording_by_a_name(
    form: str, small: Dataset, tmp_path: Path
) -> None:
    table = two_rates("sampling_hz", small)
    options: dict[str, Any] = {}
    source: Any = tmp_path / "x.npz"
    X = np.stack([np.pad(x, (0, 100 - len(x)), constant_values=np.nan) for x in table["force"]])
    if form in ("recordings", "archives"):
        source = tmp_path / "cell"
        source.mkdir()
        for i, row in enumerate(table.itertuples()):
            path = source / f"{i:02}_{'OK' if row.ok else 'NOK'}"
            if form == "archives":
                np.savez(path.with_suffix(".npz"), force=row.force, sampling_hz=row.sampling_hz)
            else:
                rows = pd.DataFrame({"force": row.force, "sampling_hz": row.sampling_hz})
                rows.to_csv(path.with_suffix(".csv"), index=False)
    elif form == "archive":
        np.savez(source, X=X, y=small.y, sampling_hz=table["sampling_hz"])
    elif form == "wide":
        source = (
            pd.DataFrame(X).add_prefix("F_").assign(sampling_hz=table["sampling_hz"], y=small.y)
        )
        options = {"time": "sampling_hz"}
    else:
        source = table.explode("force").astype({"force": float}).reset_index(drop=True)
        options = {"part": "serial", "label": "ok", "time": "none"}
    data = load_dataset(source, **options)
    assert (len(data), len(data.faults), data.rate_hz) == (16, 8, 500.0)
    data = load_dataset(source, **options, fit="resample")
    assert (len(data), data.rate_hz) == (24, 500.0)
    np.testing.assert_array_equal(data.X, small.X)
    assert load_dataset(source, **options, rate_hz=250.0, fit="pad-all").rate_hz == 250.0


@pytest.mark.parametrize(
    ("name", "is_offered"),
    [
        ("i_ms", True),
        ("n_us", True),
        ("no_s", True),
        ("Index", False),
        ("sample_no", False),
        ("Samples", False),
        ("Nr.", False),
        ("i2", False),
        ("idx", False),
        ("Counter", False),
    ],
)
def test_a_column_that_counts_in_a_unit_of_time_is_offered_as_the_clock(
    name: str, is_offered: bool, tmp_path: Path
) -> None:
    data = load_dataset(write_below("", tmp_path / "cell", f"{name},FZ", step=1), channel="FZ")
    assert any(f"time={name!r}" in note for note in data.notes) is is_offered


UNITS_BY_NAME = {
    **dict.fromkeys(("Torque", "Drehmoment", "Md", "load_torque", "Moment_1", "Weg"), ""),
    **dict.fromkeys(("FZ_Base", "force", "Kraft"), "N"),
    **dict.fromkeys(("Mz", "MuX_Base"), "N·m"),
}


@pytest.mark.parametrize("name", UNITS_BY_NAME)
def test_a_unit_that_nothing_states_is_unknown_unless_the_name_is_that_of_a_force(
    name: str, small: Dataset, tmp_path: Path
) -> None:
    np.savez(tmp_path / "a.npz", **{name: small.X, "y": small.y})
    wide(small).rename(columns=lambda old: old.replace("FZ_", f"{name}_")).to_parquet(
        tmp_path / "a.parquet"
    )
    unit = UNITS_BY_NAME[name]
    for source in (tmp_path / "a.npz", tmp_path / "a.parquet"):
        data = load_dataset(source, channel=name)
        assert (data.unit, data.spec.unit) == (unit, unit or "units")
        ends = f"{data.X[0, 0]:.6g} to {data.X[0, -1]:.6g} {unit}".strip()
        assert f"{ends} in 50 samples" in data.reading["first"]
        assert ("unit unknown" in line_of("data", source, "--channel", name)) is (unit == "")
        assert load_dataset(source, channel=name, unit="N·cm").unit == "N·cm"


UNITS_AT_ENDS = {
    **dict.fromkeys(("force_kn", "FORCE_KN", "FZ_kN", "forcekN", "ForceKN", "load.kn"), "kN"),
    **dict.fromkeys(("torque_nm", "TorqueNm", "M_NM", "Torque [nm]"), "Nm"),
    "torque_ncm": "Ncm",
    "torque_cnm": "cNm",
    "weg_nm": "nm",
    "F_rad": "N",
    "F_n": "N",
    "f_lbf": "lbf",
    "kraft_dan": "daN",
    "druck_mbar": "mbar",
    "force_MN": "MN",
    **dict.fromkeys(("FORCE_MN", "force_mn", "force_kn_1x", "kN_force", "force_mv"), ""),
}


@pytest.mark.parametrize("name", UNITS_AT_ENDS)
def test_a_unit_in_a_name_is_read_in_any_case_and_one_that_may_be_another_is_not_guessed(
    name: str, small: Dataset, tmp_path: Path
) -> None:
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        write_csv(tmp_path / f"{i:03}_{word}.csv", x, (name,))
    data = load_dataset(tmp_path, channel=name)
    assert data.unit == UNITS_AT_ENDS[name]
    notes = [note for note in data.notes if f"The name {name} may tell a unit" in note]
    assert len(notes) == (data.unit == "")
    assert load_dataset(tmp_path, channel=name, unit=data.unit or "kN").notes == ()


HEADS = {
    "channels and rates below": "Zeit;Kraft_U9C;Weg\ns;kN;mm\nKanal 0;CH 1;CH 2\n"
    "SR: 400 Hz;SR: 400 Hz;SR: 400 Hz",
    "sensors below": "Zeit;Kraft_U9C;Weg\n[s];[kN];[mm]\nUhr;U9C/10kN;WA50",
    "rates below": "Zeit;Kraft_U9C;Weg\ns;kN;mm\n400 Hz;400 Hz;400 Hz",
    "a line below": "Zeit;Kraft_U9C;Weg\ns;kN;mm\n---",
    "descriptions above units": "Zeit;Kraft_U9C;Weg\nclock;upper sensor;sensor of way\ns;kN;mm",
    "units in the header": "Zeit [s];Kraft_U9C [kN];Weg [mm]\nKanal 0;CH 1;CH 2",
}


def write_heads(head: str, folder: Path, preamble: str = "Job: 7\nMessrate: 400 Hz\n\n") -> Path:
    """Two recordings of 60 samples at 400 Hz below a head of several lines."""
    folder.mkdir(exist_ok=True)
    for scale, name in enumerate(("a_OK.csv", "b_NOK.csv"), start=1):
        values = [(i / 400, scale * np.sin(i), scale * i / 7) for i in range(60)]
        rows = [f"{t:.4f};{f:.5f};{x:.4f}".replace(".", ",") for t, f, x in values]
        (folder / name).write_text("\n".join([preamble + head, "", *rows, ""]))
    return folder


@pytest.mark.parametrize("head", HEADS)
def test_of_several_lines_above_the_samples_that_with_the_channel_is_the_header(
    head: str, tmp_path: Path
) -> None:
    source = write_heads(HEADS[head], tmp_path / "cell")
    by_name = load_dataset(source, channel="Kraft_U9C")
    assert (by_name.unit, by_name.rate_hz) == ("kN", 400.0)
    assert "header in line 4" in by_name.reading["rows"]
    by_columns = load_dataset(source, columns=["Zeit", "Kraft_U9C", "Weg"], channel="Kraft_U9C")
    assert (by_columns.unit, by_columns.rate_hz) == ("kN", 400.0)
    np.testing.assert_array_equal(by_columns.X, by_name.X)
    if "below" in head:
        with pytest.raises(DataError, match="channel='Kraft_U9C'; there are Kraft_U9C, Weg"):
            load_dataset(source)


def test_a_rate_in_a_name_is_no_unit_of_the_channel(tmp_path: Path) -> None:
    source = write_heads("Zeit;CH 1 SR: 400 Hz;Force 10 Hz", tmp_path / "cell")
    assert load_dataset(source, channel="CH 1 SR: 400 Hz").unit == ""
    assert load_dataset(source, channel="Force 10 Hz").unit == "N"


def test_named_columns_have_the_unit_of_a_line_above_the_samples(tmp_path: Path) -> None:
    source = write_heads("A;B;C", tmp_path / "cell", "Force unit: kN\n")
    assert load_dataset(source, columns=["time", "force", "x"], channel="force").unit == "kN"


def test_the_error_on_a_channel_says_in_which_line_above_the_samples_it_stands(
    tmp_path: Path,
) -> None:
    source = write_heads("Kraft;7\nzeit;CH 1;CH 2", tmp_path / "cell")
    with pytest.raises(DataError, match=r"line 5: .*column Kraft, got .*; Kraft stands in line 4"):
        load_dataset(source, channel="Kraft")


def test_a_damaged_first_row_is_a_fault_and_no_header(tmp_path: Path) -> None:
    source = write_heads("Zeit;Kraft;Weg\n0,0;x12;0,0", tmp_path / "cell", "")
    with pytest.raises(DataError, match="line 2: Expected a number in column Kraft, got"):
        load_dataset(source, channel="Kraft")


def columns_of_parts(cell: Callable[[int, int], str]) -> list[list[str]]:
    """A table with a column for each of 12 parts, with times in steps of 5 ms."""
    header = ["t_ms", *(f"{'NIO' if i % 3 == 0 else 'IO'}_{i}" for i in range(12))]
    return [header, *([f"{5 * k}", *(cell(i, k) for i in range(12))] for k in range(40))]


@pytest.mark.parametrize(
    "month", ["01. Mrz", "Mrz 75", "1-Mar", "Mar-75", "01-mars", "3. lut", "3月1日"]
)
def test_the_error_on_numbers_that_a_spreadsheet_turned_into_dates_says_so_and_counts(
    month: str, small: Dataset, tmp_path: Path
) -> None:
    why = r"cells are dates, a spreadsheet turned numbers such as 1.3 into dates; export again"
    rows = columns_of_parts(lambda i, k: month if k > 20 and i > 3 else f"{0.01 * k:.2f}")
    path = write_rows(tmp_path / "parts.csv", rows)
    where = f"parts.csv, line 23: Expected a number in column IO_4, got '{month}'.*: 152 of 480"
    with pytest.raises(DataError, match=f"{where} {why}"):
        load_dataset(path, unit="kN")
    for i, word in enumerate(words(small)):
        rows = [
            ["time", "FZ"],
            *([f"{k / 100:.2f}", month if k == 7 else "0.5"] for k in range(50)),
        ]
        write_rows(tmp_path / "cell" / f"{i:03}_{word}.csv", rows)
    with pytest.raises(DataError, match=f"000_.*, line 9: Expected .* '{month}'.*: 1 of 50 {why}"):
        load_dataset(tmp_path / "cell")


def test_a_fault_in_a_table_with_a_column_for_each_part_names_line_and_column_of_the_file(
    tmp_path: Path,
) -> None:
    rows = columns_of_parts(lambda i, k: "0x5" if (i, k) == (4, 9) else f"{0.01 * k + i:.2f}")
    path = write_rows(tmp_path / "parts.csv", rows)
    data = load_dataset(path)
    assert len(data) == 11
    assert [str(fault) for fault in data.faults] == [
        "parts.csv, column IO_4, line 11: Expected a number in column IO_4, got '0x5'"
    ]


@pytest.mark.parametrize(
    ("names", "likely"),
    [
        (["位移(mm)", "压力(kN)"], "压力(kN)"),
        (["変位[mm]", "荷重[N]"], "荷重[N]"),
        (["Droga", "Siła"], "Siła"),
        (["Kraftweg [mm]", "CH2", "Presskraft"], "Presskraft"),
        (["Winkel (deg)", "CH1 (Nm)"], "CH1 (Nm)"),
        (["Pos [mm]", "CH1"], "CH1"),
    ],
)
def test_the_error_on_several_channels_proposes_the_force_by_its_name_or_unit(
    names: list[str], likely: str, small: Dataset, tmp_path: Path
) -> None:
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        write_csv(tmp_path / f"{i:03}_{word}.csv", np.stack([x] * len(names)), tuple(names))
    with pytest.raises(DataError, match=re.escape(f"as in channel={likely!r}; there are")):
        load_dataset(tmp_path)


@pytest.mark.parametrize(("sample_time", "is_noted"), [("1", False), ("2", True), ("", True)])
def test_a_header_that_confirms_the_unit_of_a_clock_spares_the_note_on_it(
    sample_time: str, is_noted: bool, small: Dataset, tmp_path: Path
) -> None:
    for i, (x, word) in enumerate(zip(small.X, words(small), strict=True)):
        rows = scope_rows(x, word)
        if sample_time:
            rows.insert(3, ["SampleTime[ms]", sample_time, "SampleTime[ms]", "1"])
        write_rows(tmp_path / "scope" / f"{i:03}_{word}.csv", rows)
        rate = f"Sample rate: {1000 / float(sample_time or 4):g} Hz"
        above = [[rate], ["Time", "fForce"], *([f"{k}", f"{v}"] for k, v in enumerate(x))]
        write_rows(tmp_path / "rate" / f"{i:03}_{word}.csv", above)
    for form in ("scope", "rate"):
        data = load_dataset(tmp_path / form, channel="fForce")
        assert data.rate_hz == 1000.0
        assert any("names no unit and is read as milli" in note for note in data.notes) == is_noted


def test_of_two_channels_each_has_its_own_unit_or_none(small: Dataset, tmp_path: Path) -> None:
    X = np.stack([small.X, small.X], axis=1)
    np.savez(tmp_path / "a.npz", X=X, y=small.y, channels=np.array(["FZ", "Torque"]))
    data = load_dataset(tmp_path / "a.npz")
    assert data.spec.unit == ("N", "units")
    assert load_dataset(tmp_path / "a.npz", channel="Torque").spec.unit == "units"
    assert load_dataset(tmp_path / "a.npz", unit="N, Nm").spec.unit == ("N", "Nm")


GRAPHTEC_ABOVE = '"Vendor","GRAPHTEC Corporation"\n"Sampling interval","1ms"\n"Data"\n'


@pytest.mark.parametrize(
    ("names", "units_row", "clock"),
    [
        ("NO,Date&Time,ms,CH1,Alarm", "NO.,Time,ms,N,A1234", "column Date&Time (dates)"),
        ("NO,Date,Time,ms,CH1", "NO.,,,ms,N", "column Date (dates)"),
        (
            f"NO,Date&Time,ms,{','.join(f'CH{i}' for i in range(1, 11))},Alarm",
            "NO.,Time,ms,N,mm,degC,V,V,V,mV,V,V,V,A1234",
            "column Date&Time (dates)",
        ),
        (
            "NO,Date&Time,CH1,Alarm",
            "NO.,Time,N,A1234",
            "none, a line above the header states the rate; "
            "column Date&Time is too coarse to show lost rows",
        ),
    ],
)
def test_a_second_header_of_units_and_blanks_behind_signs_are_read(
    names: str, units_row: str, clock: str, tmp_path: Path
) -> None:
    values = np.round(40 * np.sin(np.arange(1500) / 200), 2)
    cells = {"Alarm": "LLLL", "Date": "2024/07/02", **{f"CH{i}": "+   7.00" for i in range(2, 11)}}
    for part, name in enumerate(("1_OK", "2_NOK")):
        text = GRAPHTEC_ABOVE + f"{names}\n{units_row}\n"
        for i, value in enumerate(values + part):
            sign = "-" if value < 0 else "+"
            row = {"NO": i + 1, "ms": i % 1000, "CH1": f"{sign} {abs(value):6.2f}", **cells}
            row["Time"] = f"09:13:{2 + i // 1000:02d}"
            row["Date&Time"] = f"2024/07/02 {row['Time']}"
            text += ",".join(f'"{row[column]}"' for column in names.split(",")) + "\n"
        (tmp_path / f"{name}.csv").write_text(text)
    data = load_dataset(tmp_path, channel="CH1")
    assert (data.rate_hz, data.unit, data.reading["clock"], data.notes) == (1000.0, "N", clock, ())
    np.testing.assert_allclose(data.X, [values, values + 1], rtol=1e-4)


def test_a_column_of_milliseconds_since_the_start_is_not_joined_to_seconds(tmp_path: Path) -> None:
    for name in ("1_OK", "2_NOK"):
        rows = [f"2024/07/02 09:13:{i // 1000:02d},{i},{i % 7}.5" for i in range(1500)]
        (tmp_path / f"{name}.csv").write_text("\n".join(["Date&Time,ms,Force", *rows]))
    data = load_dataset(tmp_path, channel="Force")
    assert (data.rate_hz, data.reading["clock"]) == (1000.0, "column ms (ms)")


@pytest.mark.parametrize("clock", ["dates", "seconds", "milliseconds", "a late start", "Parquet"])
def test_windows_of_a_listing_cut_one_long_table(tmp_path: Path, clock: str) -> None:
    force = np.random.default_rng(0).normal(size=2000).round(3)
    seconds = 0.004 * np.arange(2000) + (12.5 if clock == "a late start" else 0.0)
    dates = [f"2024-06-10T07:10:{second:06.3f}" for second in seconds]
    times = {"dates": dates, "Parquet": dates, "milliseconds": (1000 * seconds).round()}
    frame = pd.DataFrame({"time": times.get(clock, seconds), "Fz": force})
    lost = [*range(420, 425), *range(700, 710), *range(999, 1009)]
    frame = frame.drop(index=lost)
    path = tmp_path / "press.csv"
    if clock == "Parquet":
        path = tmp_path / "press.parquet"
        frame.assign(time=pd.to_datetime(frame["time"])).to_parquet(path)
    else:
        frame.to_csv(path, index=False, float_format="%.3f")
    texts = [f"{date}Z" for date in dates] if times.get(clock) is dates else seconds.round(3)
    starts = [*range(100, 1900, 150), 1950]
    rows = [
        f"{texts[i]},{texts[min(i + 100, 1999)]},P{i},{'NOK' if i % 4 else 'OK'}" for i in starts
    ]
    rows.append(rows[2].replace("P400", "P401").replace(str(texts[500]), str(texts[510])))
    listing = tmp_path / "cycles.csv"
    listing.write_text("\n".join(["von,bis,Serial,result", *rows]), encoding="utf-8")
    data = load_dataset(path, labels=listing, fit="pad-all")
    left_out = {fault.source: fault.message for fault in data.faults}
    used = [i for i in starts if i not in (400, 700, 1000)]
    assert data.source.tolist() == [f"P{i}" for i in used]
    assert left_out["P400"].endswith("overlaps that of P401")
    assert left_out["P401"].endswith("overlaps that of P400")
    assert "Expected rows from the start of its window" in left_out["P700"]
    assert "Expected rows from the start of its window" in left_out["P1000"]
    X = np.stack([force[i : i + 100] for i in used[:-1]])
    np.testing.assert_allclose(data.X[:-1], X, rtol=1e-6)
    assert data.y.tolist() == [int(i % 4 == 0) for i in used]
    assert data.rate_hz == 250.0


def test_windows_of_dates_do_not_cut_a_table_without_dates(tmp_path: Path) -> None:
    rows = [f"{0.004 * i:.3f},{i % 7}" for i in range(500)]
    (tmp_path / "press.csv").write_text("\n".join(["time,Fz", *rows]), encoding="utf-8")
    listing = tmp_path / "cycles.csv"
    listing.write_text(
        "part,start,end,result\nA,2024-06-10T07:10:00Z,2024-06-10T07:10:01Z,OK\n", encoding="utf-8"
    )
    with pytest.raises(DataError, match="Expected dates in column time, as cycles"):
        load_dataset(tmp_path / "press.csv", labels=listing)


def write_numbered(tmp_path: Path) -> Path:
    folder = tmp_path / "runs"
    folder.mkdir()
    for i in range(1, 7):
        rows = "\n".join(f"{0.002 * k:.3f},{i + k}" for k in range(30))
        (folder / f"{i}.csv").write_text(f"time,FZ\n{rows}\n", encoding="utf-8")
    return folder


def write_columns(tmp_path: Path, header: str, *columns: list[object]) -> Path:
    rows = [",".join(map(str, row)) for row in zip(*columns, strict=True)]
    listing = tmp_path / "listing.csv"
    listing.write_text("\n".join([header, *rows]), encoding="utf-8")
    return listing


FIRST_NUMBERS = list(range(1, 7))
VERDICTS = ["OK", "NOK"] * 3


@pytest.mark.parametrize("name", ["part", "trial", "cycle", "nr", "Versuch"])
def test_the_column_in_which_most_recordings_are_named_names_them(
    tmp_path: Path, name: str
) -> None:
    stations = [1, 2, 1, 2, 1, 2]
    header = f"station,{name},name,result"
    listing = write_columns(tmp_path, header, stations, FIRST_NUMBERS, ["Ann"] * 6, VERDICTS)
    data = load_dataset(write_numbered(tmp_path), labels=listing)
    assert data.y.tolist() == [1, 0] * 3


def test_of_two_columns_that_name_recordings_the_one_of_parts_is_asked_for(tmp_path: Path) -> None:
    folder = write_numbered(tmp_path)
    listing = write_columns(
        tmp_path, "nr,trial,result", FIRST_NUMBERS[::-1], FIRST_NUMBERS, VERDICTS
    )
    message = "got nr, trial, result; name that of recordings, part='nr' or part='trial'"
    with pytest.raises(DataError, match=message):
        load_dataset(folder, labels=listing)
    assert load_dataset(folder, labels=listing, part="trial").y.tolist() == [1, 0] * 3
    assert load_dataset(folder, labels=listing, part="nr").y.tolist() == [0, 1] * 3


def test_a_listing_that_names_no_recording_is_refused_with_their_names(tmp_path: Path) -> None:
    folder = write_numbered(tmp_path)
    pegs = [f"peg_{i}" for i in "abcdef"]
    listing = write_columns(tmp_path, "trial,who,result", pegs, ["Ann", "Bo"] * 3, VERDICTS)
    message = r"got trial, who, result; write their names into a column file, as 1\.csv, 2\.csv"
    with pytest.raises(DataError, match=message):
        load_dataset(folder, labels=listing)
    with pytest.raises(
        DataError, match=r"names peg_a, peg_b, peg_c: .*write the files as they are"
    ):
        load_dataset(folder, labels=listing, part="trial")


def write_night(path: Path, small: Dataset, start: str, form: str, pause: float) -> pd.DataFrame:
    """A long table in local time that goes back at 3:00, in the order of its rows."""
    times = pd.Timestamp(start) + pd.to_timedelta(np.arange(24 * 50) // 50 * pause, unit="s")
    times += pd.to_timedelta(np.tile(np.arange(50), 24) * 10, unit="ms")
    is_later = times >= times.normalize() + pd.Timedelta(hours=3)
    times = times.where(~is_later, times - pd.Timedelta(hours=1))
    frame = pd.DataFrame({"t_stamp": times.strftime(form)}).assign(
        station="ST40",
        serial=np.repeat([f"H{i}" for i in range(24)], 50),
        force=small.X.ravel().astype(np.float64),
        result=np.repeat(words(small), 50),
    )
    frame.to_csv(path, index=False)
    return frame


NIGHT = {"part": "serial", "time": "t_stamp", "label": "result", "channel": "force"}


@pytest.mark.parametrize("form", ["%Y-%m-%d %H:%M:%S.%f", "%d.%m.%Y %H:%M:%S.%f"])
@pytest.mark.parametrize("start", ["2024-10-27 02:59:50.0", "2024-10-27 02:59:50.25"])
def test_parts_stay_in_order_where_summer_time_ends_within_or_between_them(
    start: str, form: str, small: Dataset, tmp_path: Path
) -> None:
    frame = write_night(tmp_path / "a.csv", small, start, form, pause=0.75)
    for source in (
        tmp_path / "a.csv",
        frame.assign(t_stamp=pd.to_datetime(frame.t_stamp, format=form)),
    ):
        data = load_dataset(source, **NIGHT)
        assert (data.rate_hz, data.faults) == (100.0, ())
        np.testing.assert_allclose(data.X, small.X)
        assert len(data.notes) == 2  # the other says that newtons are assumed
        assert re.search(r"an hour later from line \d+ on, where summer time ends", data.notes[0])


@pytest.mark.parametrize("start", ["2024-10-28 02:59:50.0", "2024-06-30 02:59:50.0"])
def test_a_clock_that_goes_back_an_hour_on_another_day_is_a_fault_of_that_part(
    start: str, small: Dataset, tmp_path: Path
) -> None:
    write_night(tmp_path / "a.csv", small, start, "%Y-%m-%d %H:%M:%S.%f", pause=0.75)
    data = load_dataset(tmp_path / "a.csv", **NIGHT)
    assert [fault.source for fault in data.faults] == ["H13"]
    assert not any("summer" in note for note in data.notes)


def test_a_table_of_which_no_row_can_be_read_says_why(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("time,serial\n" + "".join(f"{i / 10},{i},OK,1.5\n" for i in range(20)))
    with pytest.raises(DataError, match=r"found none: a\.csv, line 2: Expected 2 columns, got 4"):
        load_dataset(path, part="serial", time="time", label="result")
    path.write_text("time,serial,result\n")
    with pytest.raises(DataError, match="found none: the header in line 1 is its last row"):
        load_dataset(path, part="serial", time="time", label="result")


def changes(x: np.ndarray, deadband: float) -> list[int]:
    """The samples of a signal that a historian stores: the last, and those that have changed."""
    rows = [0]
    for i, value in enumerate(x[:-1]):
        if abs(value - x[rows[-1]]) > deadband:
            rows.append(i)
    return [*rows, len(x) - 1]


@pytest.mark.parametrize("form", ["folder", "long"])
def test_values_that_are_stored_on_a_change_are_put_at_even_times_if_that_is_asked_for(
    form: str, tmp_path: Path
) -> None:
    t = np.arange(400) / 100
    X = np.stack([100 * np.sin((3 + 0.1 * i) * t) + 20 * np.sin(17 * t) for i in range(8)])
    source = tmp_path / "rows"
    how = {"channel": "Value"}
    frames = []
    for i, x in enumerate(X):
        rows = changes(x, 6.0)
        frame = pd.DataFrame({"time": t[rows], "Value": x[rows]})
        frames.append(frame.assign(frame_id=f"P{i}", result="NOK" if i % 2 else "OK"))
    if form == "folder":
        for i, frame in enumerate(frames):
            source.mkdir(exist_ok=True)
            frame.to_csv(source / f"{i}_{frame.result[0]}.csv", index=False)
    else:
        source = tmp_path / "long.csv"
        pd.concat(frames).to_csv(source, index=False)
        how |= {"part": "frame_id", "time": "time", "label": "result"}
    data = load_dataset(source, **how, fit="resample", rate_hz=100.0)
    assert (data.rate_hz, data.faults) == (100.0, ())
    assert data.lengths is not None
    assert data.lengths.tolist() == [len(frame) for frame in frames]
    expected = [np.interp(t, frame.time, frame.Value) for frame in frames]
    np.testing.assert_allclose(data.X, np.stack(expected), atol=1e-4)
    assert any("Rows come when values change, by column time" in note for note in data.notes)
    for stated in ({}, {"fit": "resample"}, {"rate_hz": 100.0}):
        with pytest.raises(DataError, match=r"all along.*: fit='resample' with rate_hz=\d+ puts"):
            load_dataset(source, **how, **stated)


@pytest.mark.parametrize("jitter", [0.0, 0.003])
def test_a_regular_clock_with_a_hole_is_a_fault_also_if_it_is_resampled(
    jitter: float, tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    for i in range(6):
        t = 1.0 + np.arange(300) / 100 + rng.normal(0, jitter, 300)
        kept = np.delete(np.sort(t), slice(100, 130)) if i == 0 else np.sort(t)
        frame = pd.DataFrame({"time": kept, "FZ": np.sin(kept + i)})
        frame.to_csv(tmp_path / f"{i}_{'NOK' if i % 2 else 'OK'}.csv", index=False)
    data = load_dataset(tmp_path, fit="resample", rate_hz=100.0)
    assert [fault.source for fault in data.faults] == ["0_OK.csv"]
    assert "got a gap of 0.3" in data.faults[0].message


# A form of recordings -> writes (name, word, samples), and returns the source and options.
NAMED: dict[
    str, Callable[[list[tuple[str, str, np.ndarray]], Path], tuple[Any, dict[str, Any]]]
] = {
    "folders": lambda rows, tmp: (
        [write_csv(tmp / "d" / word / f"{name}.csv", x) for name, word, x in rows] and tmp / "d",
        {},
    ),
    "json lines": lambda rows, tmp: (
        written(
            tmp / "a.jsonl",
            lambda path: path.write_text(
                "\n".join(
                    json.dumps({"serial": name, "result": word, "force": x.tolist()})
                    for name, word, x in rows
                )
            ),
        ),
        {"part": "serial"},
    ),
    "parquet": lambda rows, tmp: (
        written(
            tmp / "a.parquet",
            pd.DataFrame(rows, columns=["serial", "result", "force"]).to_parquet,
        ),
        {"part": "serial"},
    ),
    "wide": lambda rows, tmp: (
        pd.DataFrame([x for *_, x in rows])
        .add_prefix("FZ_")
        .assign(serial=[name for name, *_ in rows], result=[word for _, word, _ in rows]),
        {"part": "serial"},
    ),
    "npz": lambda rows, tmp: (
        written(
            tmp / "a.npz",
            lambda path: np.savez(
                path,
                X=np.stack([x for *_, x in rows]),
                y=[word for _, word, _ in rows],
                part=[name for name, *_ in rows],
            ),
        ),
        {},
    ),
}


def some_parts(n: int = 8) -> list[tuple[str, str, np.ndarray]]:
    rng = np.random.default_rng(5)
    return [(f"C{i}", "NOK" if i % 4 == 3 else "OK", rng.normal(size=60)) for i in range(n)]


@pytest.mark.parametrize("form", NAMED)
@pytest.mark.parametrize("name", ["C2", "renamed"])
def test_equal_samples_whose_labels_contradict_each_other_are_faults_that_name_both(
    form: str, name: str, tmp_path: Path
) -> None:
    rows = some_parts()
    source, options = NAMED[form]([*rows, (name, "NOK", rows[2][2])], tmp_path)
    data = load_dataset(source, **options)
    assert (len(data), int(data.y.sum())) == (7, 5)
    first, second = data.faults
    assert first.message == second.message
    assert "one label for the same samples, got good in" in first.message
    for fault in data.faults:
        assert fault.source in first.message


def test_long_tables_whose_parts_have_equal_samples_and_other_labels_leave_both_out() -> None:
    rows = [*some_parts(), ("D1", "NOK", some_parts()[2][2])]
    frame = pd.DataFrame(
        [(name, i / 100, v, word) for name, word, x in rows for i, v in enumerate(x)],
        columns=["part", "time", "FZ", "result"],
    )
    data = load_dataset(frame, time="time", label="result")
    assert {fault.source for fault in data.faults} == {"C2", "D1"}
    assert "good in C2, bad in D1" in data.faults[0].message


@pytest.mark.parametrize("form", [form for form in NAMED if form != "folders"])
def test_a_repeat_of_part_label_and_samples_is_left_out_with_a_note(
    form: str, tmp_path: Path
) -> None:
    rows = some_parts()
    again = ("C4", "OK", rows[4][2] + 1.0)  # measured again
    source, options = NAMED[form]([*rows, rows[1], rows[3], again], tmp_path)
    data = load_dataset(source, **options)
    assert (len(data), data.faults) == (9, ())
    note = "2 repeats of a recording are left out, of the same part, label and samples: C1, C3."
    assert note in data.notes
    report = import_labelled(tmp_path / "a.db", data, recipe="pca")
    assert (report.imported, report.repeated) == (9, 0)


def test_a_file_of_the_same_name_and_samples_in_another_folder_is_a_repeat(tmp_path: Path) -> None:
    for name, word, x in some_parts():
        write_csv(tmp_path / "d" / "day1" / word / f"{name}.csv", x)
        write_csv(tmp_path / "d" / "day1" / word / f"{name}_x" / "curve.csv", x + 9.0)
    name, word, x = some_parts()[1]
    write_csv(tmp_path / "d" / "day2" / word / f"{name}.csv", x)
    write_csv(tmp_path / "d" / "day2" / word / f"{name}_x" / "curve.csv", x + 9.0)
    data = load_dataset(tmp_path / "d")
    assert len(data) == 17
    assert any(note.startswith("1 repeat of a recording is left out") for note in data.notes)
    pair = "day2/OK/C1_x/curve.csv as day1/OK/C1_x/curve.csv"
    assert f"Equal to another recording, sample by sample: {pair}." in data.notes


def test_equal_samples_of_different_parts_stay_and_a_note_names_both(tmp_path: Path) -> None:
    rows = some_parts()
    source, options = NAMED["json lines"]([*rows, ("D1", "OK", rows[1][2])], tmp_path)
    data = load_dataset(source, **options)
    assert len(data) == 9
    pair = "a.jsonl, line 9 (D1) as a.jsonl, line 2 (C1)"
    assert f"Equal to another recording, sample by sample: {pair}." in data.notes


def test_signals_of_few_values_may_be_equal_by_chance() -> None:
    switch = np.repeat([0.0, 1.0], 30)
    X = [*(x for *_, x in some_parts()), switch, switch, np.zeros(60), np.zeros(60)]
    y = [1, 1, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0]
    data = load_dataset((np.array(X), y))
    assert (data.y.tolist(), data.faults) == (y, ())


def test_a_copy_that_a_listing_calls_bad_contradicts_its_original(tmp_path: Path) -> None:
    for name, _, x in some_parts():
        write_csv(tmp_path / "d" / f"{name}.csv", x)
    write_csv(tmp_path / "d" / "C0 - Copy.csv", some_parts()[0][2])
    rows = ["file,result", *(f"{name},{word}" for name, word, _ in some_parts()), "C0 - Copy,NOK"]
    (tmp_path / "list.csv").write_text("\n".join(rows))
    data = load_dataset(tmp_path / "d", labels=tmp_path / "list.csv")
    assert {fault.source for fault in data.faults} == {"C0.csv", "C0 - Copy.csv"}


def ring(n_parts: int = 8, samples: int = 40, oldest: int = 130) -> pd.DataFrame:
    """The log of a PLC whose newest row is followed by its oldest; part 3 is in two pieces."""
    rng = np.random.default_rng(6)
    n = n_parts * samples
    frame = pd.DataFrame(
        {
            "Record": 7000 + np.arange(n),
            "Stamp": pd.date_range("2026-03-01 05:59:58", periods=n, freq="10ms").astype(str),
            "PartNo": np.repeat(np.arange(n_parts), samples),
            "t_ms": np.tile(10 * np.arange(samples), n_parts),
            "Force": np.round(rng.normal(size=n), 3),
            "Result": np.repeat(["OK", "NOK"] * (n_parts // 2), samples),
        }
    )
    return pd.concat([frame.iloc[oldest:], frame.iloc[:oldest]])


@pytest.mark.parametrize("proof", ["Record", "Stamp"])
@pytest.mark.parametrize("time", ["t_ms", "Stamp", "Record", "none"])
def test_the_rows_of_a_ring_buffer_that_wrapped_are_put_in_order_with_a_note(
    proof: str, time: str, tmp_path: Path
) -> None:
    log = ring().drop(columns={"Record", "Stamp"} - {proof, time})
    if proof != "Record" and time == "Record":
        log = log.drop(columns="Stamp")
    log.to_csv(tmp_path / "log.csv", index=False)
    rate = {} if time in ("t_ms", "Stamp") else {"rate_hz": 100.0}
    data = load_dataset(
        tmp_path / "log.csv", part="PartNo", label="Result", channel="Force", time=time, **rate
    )
    in_order = ring().sort_values("Record")["Force"].to_numpy().reshape(8, 40)
    np.testing.assert_allclose(data.X, in_order, rtol=1e-5)
    assert data.y.tolist() == [1, 0] * 4
    note = next(note for note in data.notes if "ring buffer" in note)
    assert "goes back in line 192" in note
    assert "part 3 is joined of its two pieces; the beginning of part 0 may be" in note
    assert "line 192 on" in data.reading["order"] or "by the dates" in data.reading["order"]


def test_a_counter_that_starts_anew_is_no_ring_buffer() -> None:
    log = ring(oldest=0).drop(columns="Stamp")
    log["Record"] = (np.arange(320) + 50_000) % 50_100
    data = load_dataset(log, part="PartNo", label="Result", channel="Force", time="t_ms")
    in_order = ring().sort_values("Record")["Force"].to_numpy().reshape(8, 40)
    np.testing.assert_allclose(data.X, in_order, rtol=1e-5)
    assert not any("ring buffer" in note for note in data.notes)


def test_a_part_at_both_ends_of_a_table_that_counts_no_rows_may_be_of_a_ring_buffer() -> None:
    log = ring().drop(columns=["Record", "Stamp"])
    do = "put the rows in order if the file is a ring buffer that wrapped, else make the parts' num"
    with pytest.raises(DataError, match=do):
        load_dataset(log, part="PartNo", label="Result", channel="Force", time="t_ms")


def delivered(form: str) -> pd.DataFrame:
    """A long table of MQTT in which ten rows of parts 1 and 3 came again, later."""
    rng = np.random.default_rng(4)
    frame = pd.DataFrame(
        {
            "part": np.repeat([f"H{i}" for i in range(6)], 40),
            "time": np.tile(np.arange(40) / 500, 6).round(3),
            "force": rng.normal(size=240).round(3),
            "verdict": np.repeat(["ok", "nok"] * 3, 40),
        }
    )
    if form == "dates":
        frame["time"] = pd.date_range("2026-03-01 06:00", periods=240, freq="2ms", tz="UTC")
    again = [frame.iloc[start + 10 : start + 20] for start in (40, 120)]
    pieces = [frame.iloc[:70], again[0], frame.iloc[70:170], again[1], frame.iloc[170:]]
    frame = pd.concat(pieces, ignore_index=True)
    if form == "rows of a database":
        frame.insert(0, "id", np.arange(len(frame)) + 5000)
        frame["received"] = pd.date_range("2026-03-01", periods=len(frame), freq="3ms").astype(str)
    return frame


OF_MQTT: dict[str, Any] = {"part": "part", "label": "verdict", "channel": "force"}


@pytest.mark.parametrize("form", ["seconds", "dates", "rows of a database", "lines"])
@pytest.mark.parametrize("time", ["time", "none"])
def test_rows_of_a_long_table_that_came_twice_are_read_once_with_a_note(
    form: str, time: str, tmp_path: Path
) -> None:
    source: Any = delivered(form)
    expected = source["force"][~source.duplicated(["part", "time"])].to_numpy().reshape(6, 40)
    if form == "lines":
        source.to_json(tmp_path / "s.jsonl", orient="records", lines=True)
        source = tmp_path / "s.jsonl"
    data = load_dataset(source, **OF_MQTT, time=time, rate_hz=500 if time == "none" else None)
    np.testing.assert_allclose(data.X, expected, rtol=1e-6)
    assert "20 rows came twice and are read once, in 2 parts: H1, H3." in data.notes


def test_equal_rows_of_a_long_table_stay_if_its_clock_is_coarse() -> None:
    table = delivered("seconds").drop_duplicates()
    table["time"] = table["time"] // 0.01
    table.loc[table["part"] == "H2", "force"] = 0.5
    data = load_dataset(table, **OF_MQTT, time="time", rate_hz=500)
    assert set(data.lengths) == {40}


def test_rows_of_the_same_times_with_other_values_are_refused_with_both() -> None:
    table = delivered("seconds")
    is_again = table.duplicated().to_numpy()
    table.loc[is_again, "force"] = np.arange(20) + 7.0
    first = table["force"][50]
    match = f"same times; lines 51 and 71 have the same time, and {first:.6g} and 7; make"
    with pytest.raises(DataError, match=match):
        load_dataset(table, **OF_MQTT, time="time")


def test_without_a_clock_a_note_names_parts_in_several_places_and_times_that_go_back() -> None:
    table = delivered("seconds").drop_duplicates()
    table = pd.concat([table.iloc[60:], table.iloc[:60]])
    notes = load_dataset(table, **OF_MQTT, time="none", rate_hz=500).notes
    text = "Rows of a part are in several places of the file, and are joined in this order"
    assert f"{text}: H1 (2 places)." in notes
    text = "Column time goes back, and rows stay as they are: H1; time='time' uses it."
    assert text in notes


def test_a_reading_claims_no_lost_rows() -> None:
    log = ring(oldest=0).drop(columns="Stamp")
    options: dict[str, Any] = {
        "part": "PartNo",
        "label": "Result",
        "channel": "Force",
        "time": "Record",
    }
    data = load_dataset(log, **options, rate_hz=100)
    assert "shows lost rows" not in data.reading["clock"]


def test_data_in_quotes_are_not_written_as_options() -> None:
    message = (
        "Expected numbers, got 'start part=1 label=x'; name parts' numbers, as in part='my nr'"
    )
    assert as_options(message) == message.replace("part='my nr'", "--part 'my nr'")


def test_a_row_of_a_listing_judges_no_part_that_was_measured_twice(
    make_data, tmp_path: Path
) -> None:
    data = make_data(21, samples=50)
    serials = [f"SN{i:02}" for i in range(20)]
    serials.insert(5, "SN04")
    listing = tmp_path / "listing.csv"
    verdicts = {serial: "OK" if i % 3 else "NOK" for i, serial in enumerate(serials)}
    pd.DataFrame(verdicts.items(), columns=["serial", "verdict"]).to_csv(listing, index=False)
    rows = pd.DataFrame(data.X).add_prefix("s")
    rows.assign(serial=serials).to_csv(tmp_path / "rows.csv", index=False)
    columns = rows.T.set_axis([*serials[:5], "SN04.1", *serials[6:]], axis=1)  # as pandas writes
    columns.insert(0, "time_s", np.arange(50) / 500)
    columns.to_csv(tmp_path / "columns.csv", index=False)
    for file, again in (("rows", "SN04 (2)"), ("columns", "SN04.1")):
        how = {"part": "serial"} if file == "rows" else {}
        loaded = load_dataset(tmp_path / f"{file}.csv", labels=listing, rate_hz=500, **how)
        message = f"Expected a row of listing.csv for each of SN04, {again}, found one"
        assert [fault.source for fault in loaded.faults] == ["SN04", again]
        assert all(fault.message.startswith(message) for fault in loaded.faults)
        np.testing.assert_allclose(loaded.X, np.delete(data.X, [4, 5], axis=0), rtol=1e-6)


def test_parts_that_are_called_reference_parts_are_named(make_data, tmp_path: Path) -> None:
    data = make_data(30, samples=40)
    for i, (trace, label) in enumerate(zip(data.X, data.y, strict=True)):
        name = "MASTER-A" if i % 15 == 0 else f"SN{i}"
        write_csv(tmp_path / f"{i:02}_{name}_{'OK' if label else 'NOK'}.csv", trace)
    notes = " ".join(load_dataset(tmp_path).notes)
    assert "look like reference parts, and are read: 00_MASTER-A_" in notes
    assert "15_MASTER-A_" in notes
    assert "SN" not in notes


@pytest.mark.parametrize(("longest", "is_said"), [(52, False), (54, True)])
def test_a_note_says_how_many_samples_are_cut_at_the_ends(
    longest: int, is_said: bool, make_data
) -> None:
    data = make_data(30, samples=60)
    traces = [trace[: longest if i < 3 else 50] for i, trace in enumerate(data.X)]
    notes = " ".join(load_dataset((traces, data.y)).notes)
    text = "Recordings that lose their ends: 3, 4 samples of 54 at most; samples=54 keeps them"
    assert (text in notes) == is_said
    assert ("lose their ends" in notes) == is_said


def write_fixed_width(folder: Path, forces: np.ndarray, head: str, form: str) -> Path:
    """A file for each part: number, time, a stroke near -40, and force by a format as of Fortran."""
    folder.mkdir(exist_ok=True)
    for k, force in enumerate(forces):
        rows = [
            form.format(i + 1, 0.004 * i, -40 - i / 100, f)
            for i, f in enumerate(np.round(force, 2))
        ]
        label = "OK" if k % 2 else "NOK"
        (folder / f"run_{k}_{label}.dat").write_text("\n".join([head, *rows, ""]))
    return folder


FORTRAN = "{:5d}{:9.4f}{:8.3f}{:8.2f}"


@pytest.mark.parametrize(
    "head",
    [
        "   NO  TIME(S)  STROKE(MM) FORCE OF THE RAM(N)",
        "NO,TIME,STROKE,FORCE(N)".replace(",", " "),
        " RUN : 7\n STATUS : ACCEPT\n COLUMNS : NO 1-5  TIME(S) 6-14  STROKE(MM) 15-22  FORCE 23-30",
    ],
)
@pytest.mark.parametrize("peak", [14000.0, -3000.0])
def test_numbers_that_touch_in_columns_of_fixed_width_are_cut_with_a_note(
    head: str, peak: float, tmp_path: Path
) -> None:
    forces = peak * np.sin(np.linspace(0, np.pi, 200)) + np.arange(4)[:, None]
    write_fixed_width(tmp_path / "runs", forces, head, FORTRAN)
    data = load_dataset(
        tmp_path / "runs", columns="no,time,stroke,force", channel="force", unit="N"
    )
    np.testing.assert_allclose(data.X, np.round(forces, 2), rtol=1e-6)
    width = np.char.str_len(np.char.mod("%.2f", forces))
    text = f"cut where the columns end ({(width == 8).sum()} times)"
    assert any(text in note for note in data.notes)


def test_a_cell_of_stars_that_touches_is_a_lost_sample_and_a_blank_one_is_empty(
    tmp_path: Path,
) -> None:
    forces = np.sin(np.arange(4)[:, None] + np.arange(200) / 9)
    folder = write_fixed_width(tmp_path / "runs", forces, "no time stroke force", FORTRAN)
    path = folder / "run_0_NOK.dat"
    lines = path.read_text().split("\n")
    lines[51] = f"{lines[51][:-8]}{8 * '*'}"
    lines[61] = lines[61][:14] + 8 * " " + lines[61][22:]
    lines[71] = lines[71][:-8] + 8 * " "
    path.write_text("\n".join(lines))
    data = load_dataset(folder, channel="force")
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(data.X[0])), [50, 70])
    assert any("********" in note for note in data.notes)
    assert any("cut where the columns end (3 times)" in note for note in data.notes)


@pytest.mark.parametrize("columns", ["", "no,time,stroke,force"])
def test_numbers_that_touch_and_cannot_be_cut_are_a_fault_that_says_so(
    columns: str, tmp_path: Path
) -> None:
    forces = np.sin(np.arange(4)[:, None] + np.arange(200) / 9)
    forces[0, 100] = -123456.78
    folder = write_fixed_width(tmp_path / "runs", forces, "no time stroke force", FORTRAN)
    data = load_dataset(folder, channel="force", columns=columns or None)
    assert "numbers touch in -41.000-123456.78" in data.faults[0].message
    path = folder / "run_0_NOK.dat"
    text = path.read_text().replace(" -41.000-123456.78", "  41.0123456.789")
    path.write_text(text)  # as wide as the others, but the point is elsewhere
    data = load_dataset(folder, channel="force", columns=columns or None)
    assert "numbers touch in 41.0123456.789" in data.faults[0].message
    forces[:] = -100
    write_fixed_width(folder, forces, "no time stroke force", "{:5d}{:9.4f}{:8.3f}{:7.2f}")
    with pytest.raises(DataError, match=r"numbers touch in -40.000-100.00"):
        load_dataset(folder, channel="force", columns=columns or None)


@pytest.mark.parametrize("n_lost", [2, 4, 9, 10, 25])
def test_a_last_row_that_is_cut_off_is_not_taken_for_a_cell_that_is_empty(
    n_lost: int, tmp_path: Path
) -> None:
    forces = np.arange(4)[:, None] + 5000 + 50.0 * np.arange(200)
    folder = write_fixed_width(tmp_path / "runs", forces, "no time stroke force", FORTRAN)
    path = folder / "run_0_NOK.dat"
    path.write_text(path.read_text()[:-n_lost])
    data = load_dataset(folder, channel="force", samples=199, fit="cut")
    np.testing.assert_allclose(data.X, forces[:, :199])
    assert any("cut off" in note for note in data.notes)


def test_files_with_one_number_in_their_names_are_named_and_may_be_one_part(
    make_data, tmp_path: Path
) -> None:
    data = make_data(20, samples=40)
    for i, (trace, label) in enumerate(zip(data.X, data.y, strict=True)):
        serial = 7 if i == 8 else i
        write_csv(tmp_path / f"SN{serial:04}_08{i:02}_{'OK' if label else 'NOK'}.csv", trace)
    notes = " ".join(load_dataset(tmp_path).notes)
    assert "One number stands in the names of SN0007_0807_" in notes
    assert r"part='SN(\d+)' takes them as of one part" in notes
    loaded = load_dataset(tmp_path, part=r"SN(\d+)")
    assert loaded.part is not None
    assert (loaded.part == "0007").sum() == 2
    assert "1 part has several recordings: 0007." in loaded.notes


@pytest.mark.parametrize(
    ("channel", "is_assumed"),
    [("Kraft", True), ("FZ_Base", False), ("actual_TCP_force_2", False), ("wrench.force.z", False)],
)
def test_a_note_says_that_newtons_are_assumed_for_a_word_for_a_force(
    channel: str, is_assumed: bool, make_data, tmp_path: Path
) -> None:
    data = make_data(8, samples=40)
    for i, (trace, label) in enumerate(zip(data.X, data.y, strict=True)):
        path = write_csv(tmp_path / f"{i}_{bool(label)}.csv", trace)
        path.write_text(path.read_text().replace("FZ_Base", channel))
    loaded = load_dataset(tmp_path)
    assert loaded.unit == "N"
    assert any("N of Kraft is assumed" in note for note in loaded.notes) == is_assumed
    assert not any("assumed" in note for note in load_dataset(tmp_path, unit="kN").notes)


def write_json(folder: Path, data: Dataset, **fields: Any) -> None:
    for i, (trace, label) in enumerate(zip(data.X, data.y, strict=True)):
        record = {
            "serial": f"T{i:03}",
            "torque": trace.tolist(),
            "result": "OK" if label else "NOK",
        }
        for key, values in fields.items():
            record[key] = values[i % len(values)]
        (folder / f"{i:03}.json").write_text(json.dumps(record))


def test_a_torque_in_pounds_is_converted_and_one_in_an_unknown_unit_is_left_out(
    make_data, tmp_path: Path
) -> None:
    data = make_data(20, samples=40)
    write_json(tmp_path, data, torqueUnit=["Nm", "Nm", "lbf.in", "Nm"], rate_hz=[500])
    loaded = load_dataset(tmp_path, channel="torque")
    of_pounds = np.arange(20) % 4 == 2
    assert loaded.unit == "Nm"
    np.testing.assert_allclose(loaded.X[of_pounds], data.X[of_pounds] * 0.1129848, rtol=1e-5)
    np.testing.assert_array_equal(loaded.X[~of_pounds], data.X[~of_pounds])
    write_json(tmp_path, data, torqueUnit=["Nm", "Nm", "foo", "Nm"], rate_hz=[500])
    for unit in (None, "Nm"):
        loaded = load_dataset(tmp_path, channel="torque", unit=unit)
        assert len(loaded) == 15
        assert all(re.search("in Nm, as .*, got foo$", fault.message) for fault in loaded.faults)


def test_recordings_at_half_the_rate_of_the_others_are_put_on_it(make_data, tmp_path: Path) -> None:
    data = make_data(12, samples=80)
    for i, (trace, label) in enumerate(zip(data.X, data.y, strict=True)):
        step = 2 if i % 3 == 0 else 1
        # 1 / 600 with six decimals is a bit more: less than half of 1,200 Hz
        rows = [f"{k / 1200:.6f},{trace[k]}" for k in range(0, 80, step)]
        name = f"{i:02}_{bool(label)}.csv"
        (tmp_path / name).write_text("\n".join(["Timestamp,FZ_Base", *rows]) + "\n")
    loaded = load_dataset(tmp_path, fit="resample")
    assert (len(loaded), loaded.rate_hz, loaded.faults) == (12, 1200.0, ())
    faults = load_dataset(tmp_path).faults
    assert len(faults) == 4
    assert all("fit='resample' puts all on one rate" in fault.message for fault in faults)


def test_resampling_fills_short_gaps_between_samples_and_no_long_ones(make_data) -> None:
    data = make_data(6, samples=60)
    X = data.X.copy()
    X[0, 10:14] = X[1, 10:15] = X[2, :3] = np.nan
    frame = pd.DataFrame(X).add_prefix("FZ_").assign(y=data.y)
    loaded = load_dataset(frame, fit="resample")
    line = np.interp(np.arange(10, 14), [9, 14], X[0, [9, 14]])
    np.testing.assert_allclose(loaded.X[0, 10:14], line, rtol=1e-6)
    assert np.isnan(loaded.X).sum(axis=1).tolist() == [0, 5, 3, 0, 0, 0]
    assert "4 missing samples are interpolated, up to 4 on end." in loaded.notes
    assert np.isnan(load_dataset(frame).X).sum() == 12


def test_patterns_of_labels_and_parts_search_the_name_without_its_suffix(
    make_data, tmp_path: Path
) -> None:
    data = make_data(8, samples=40)
    for i, (trace, label) in enumerate(zip(data.X, data.y, strict=True)):
        write_csv(tmp_path / f"A{i // 2}_{i}_{'OK' if label else 'NOK'}.csv", trace)
    loaded = load_dataset(tmp_path, label="_(OK|NOK)$", part=r"^(A\d)_")
    assert loaded.part is not None
    assert loaded.part.tolist() == [f"A{i // 2}" for i in range(8)]
    np.testing.assert_array_equal(loaded.y, data.y)


@pytest.mark.parametrize(("rate_hz", "digits"), [(600, 5), (450, 4), (1200, 6), (300, 3), (500, 3)])
def test_the_rate_of_a_clock_with_rounded_times_is_that_of_the_whole_recording(
    rate_hz: int, digits: int, make_data, tmp_path: Path
) -> None:
    data = make_data(4, samples=200)
    for i, (trace, label) in enumerate(zip(data.X, data.y, strict=True)):
        rows = [f"{k / rate_hz:.{digits}f},{sample}" for k, sample in enumerate(trace)]
        text = "\n".join(["Timestamp,FZ_Base", *rows]) + "\n"
        (tmp_path / f"{i}_{bool(label)}.csv").write_text(text)
    assert load_dataset(tmp_path).rate_hz == pytest.approx(rate_hz, rel=1e-3)


def test_a_header_that_comes_again_in_a_long_table_is_left_out_with_a_note(
    small: Dataset, tmp_path: Path
) -> None:
    rows = long_rows(small, lambda v, i, k: str(v))
    rows.insert(101, rows[0])
    data = load_dataset(write_rows(tmp_path / "long.csv", rows), **LONG)
    np.testing.assert_array_equal(data.X, small.X)
    assert "The header of long.csv comes again, and is left out there: line 102." in data.notes


@pytest.mark.parametrize("is_row", [True, False])
def test_the_unit_of_a_table_with_a_column_per_part_is_in_its_header(
    is_row: bool, make_data, tmp_path: Path
) -> None:
    data = make_data(20, samples=50)
    names = [f"P{i:02}_{'OK' if label else 'NOK'}" for i, label in enumerate(data.y)]
    header = ["time_s", *(names if is_row else [f"{name} (kN)" for name in names])]
    rows = [header, *([["s", *["kN"] * 20]] if is_row else [])]
    rows += [[str(k / 500), *map(str, data.X[:, k])] for k in range(50)]
    loaded = load_dataset(write_rows(tmp_path / "columns.csv", rows))
    assert (loaded.unit, loaded.rate_hz) == ("kN", 500.0)
    assert loaded.part is not None
    assert loaded.part.tolist() == names
    np.testing.assert_array_equal(loaded.X, data.X)


def test_a_column_of_parts_may_have_brackets_in_its_name(make_data, tmp_path: Path) -> None:
    data = make_data(8, samples=40)
    for i, (trace, label) in enumerate(zip(data.X, data.y, strict=True)):
        path = write_csv(tmp_path / f"{i}_{bool(label)}.csv", trace)
        header, *rows = path.read_text().splitlines()
        cells = [f"{header},Part (ID)", *(f"{row},P{i // 2}" for row in rows)]
        path.write_text("\n".join(cells) + "\n")
    loaded = load_dataset(tmp_path, channel="FZ_Base", part="Part (ID)")
    assert loaded.part is not None
    assert loaded.part.tolist() == [f"P{i // 2}" for i in range(8)]
