"""A file is read by what it holds: text of any suffix, packed text, Parquet and JSON; what is none
of these is refused by its kind.
"""

import gzip
import json
import re
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from dengine import load_dataset
from dengine.errors import DataError

N = 12
WORDS = ["OK" if i % 3 else "NOK" for i in range(N)]
LABELS = [int(word == "OK") for word in WORDS]
LISTING = pd.DataFrame(
    {"file": [f"rec_{i:03d}.csv" for i in range(N)], "verdict": WORDS, "serial": range(N)}
)
ROWS = json.loads(LISTING.to_json(orient="records"))


def write_recordings(folder: Path, suffix: str = ".csv", *, with_labels: bool = True) -> Path:
    folder.mkdir()
    for i, word in enumerate(WORDS):
        name = f"rec_{i:03d}_{word}{suffix}" if with_labels else f"rec_{i:03d}{suffix}"
        rows = [f"{k / 500:.3f}\t{np.sin(k + i):.3f}" for k in range(30)]
        text = "\n".join(["time\tFZ", *rows, ""]).encode()
        (folder / name).write_bytes(gzip.compress(text) if suffix.endswith(".gz") else text)
    return folder


LISTINGS: dict[str, Callable[[Path], object]] = {
    "l.parquet": LISTING.to_parquet,
    "index.parquet": LISTING.set_index("file").to_parquet,
    "l.json": lambda path: LISTING.to_json(path, orient="records"),
    "l.jsonl": lambda path: LISTING.to_json(path, orient="records", lines=True),
    "named.json": lambda path: path.write_text(
        json.dumps(dict(zip(LISTING.file, WORDS, strict=True)))
    ),
    "inside.json": lambda path: path.write_text(json.dumps({"cell": 3, "parts": ROWS})),
    "l.csv.gz": lambda path: LISTING.to_csv(path, index=False),
    "numbers.parquet": lambda path: LISTING.assign(
        file=np.arange(float(N)), verdict=np.array(LABELS, dtype=bool)
    ).to_parquet(path),
}


@pytest.mark.parametrize("name", LISTINGS)
def test_a_listing_is_read_from_every_table_that_recordings_are_read_from(
    name: str, tmp_path: Path
) -> None:
    LISTINGS[name](tmp_path / name)
    folder = write_recordings(tmp_path / "cell", with_labels=False)
    data = load_dataset(folder, labels=tmp_path / name)
    assert (data.y.tolist(), data.faults) == (LABELS, ())
    assert data.reading["labels"].startswith(name)


def write_workbook(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("xl/workbook.xml", "<workbook/>")


REFUSED: dict[str, tuple[Callable[[Path], object], str]] = {
    "l.xlsx": (write_workbook, "a workbook or a zip archive; save the sheet as CSV"),
    "l.feather": (LISTING.to_feather, "an Arrow file .Feather.; save it as Parquet or CSV"),
    "l.csv": (LISTING.to_parquet, "a Parquet file; name it .parquet"),
    "l.bin": (lambda path: path.write_bytes(bytes(range(256)) * 20), "a binary file of an unknown"),
    "l.npy": (
        lambda path: np.save(path, np.zeros((3, 4))),
        "a single NumPy array; save it as .npz",
    ),
    "l.h5": (lambda path: path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(99)), "an HDF5 file; save"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_file_that_is_no_table_is_refused_by_its_kind_in_one_line(
    name: str, tmp_path: Path
) -> None:
    write, kind = REFUSED[name]
    write(tmp_path / name)
    folder = write_recordings(tmp_path / "cell", with_labels=False)
    for source, options in ((folder, {"labels": tmp_path / name}), (tmp_path / name, {})):
        with pytest.raises(DataError, match=kind) as caught:
            load_dataset(source, **options)
        assert str(caught.value).isprintable()


SUFFIXES = (".asc", ".log", ".prn", ".trc", ".CSV.gz", ".txt.gz", "")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_text_is_read_whatever_its_suffix_where_most_files_have_it(
    suffix: str, tmp_path: Path
) -> None:
    folder = write_recordings(tmp_path / "cell", suffix)
    for i in range(N):  # what an editor leaves beside each of them
        (folder / f"rec_{i}.json").write_text("[\n1.0,\n2.0,\n3.0,\n4.0,\n5.0,\n6.0,\n7.0\n]")
    (folder / "readme.dat").write_text("of cell 3")
    data = load_dataset(folder)
    assert (data.y.tolist(), data.rate_hz, data.faults) == (LABELS, 500.0, ())
    assert any("readme.dat" in note for note in data.notes)
    wide = pd.DataFrame(data.X, columns=[f"FZ_{i}" for i in range(30)]).assign(label=WORDS)
    how = "gzip" if suffix.endswith(".gz") else None
    wide.to_csv(tmp_path / f"wide{suffix}", index=False, sep="\t", compression=how)
    named = load_dataset(tmp_path / f"wide{suffix}")
    np.testing.assert_array_equal(named.X, data.X)


def test_tables_of_a_rarer_suffix_are_named_in_a_note(tmp_path: Path) -> None:
    folder = write_recordings(tmp_path / "cell")
    (folder / "late_OK.asc").write_bytes((folder / "rec_001_OK.csv").read_bytes())
    data = load_dataset(folder)
    assert len(data) == N
    assert data.notes == ("Not read, for most files are .csv: late_OK.asc.",)


FORCES = np.random.default_rng(0).normal(10.0, 1.0, (N, 30)).round(3)
SECONDS = np.arange(30) / 500


def as_rows(i: int) -> pd.DataFrame:
    rows = {"part": f"S{i}", "time": SECONDS, "FZ": FORCES[i], "result": WORDS[i]}
    return pd.DataFrame(rows)


def as_object(i: int) -> dict[str, object]:
    return {"serial": f"S{i}", "result": WORDS[i], "FZ": FORCES[i].tolist()}


def as_wide(i: int) -> pd.DataFrame:
    columns = [f"FZ_{k}" for k in range(30)]
    return pd.DataFrame(FORCES[[i]], columns=columns).assign(result=WORDS[i])


LONG = {"part": "part", "time": "time"}
# Name of a file of one recording -> how it is written, and the options to read a folder of them.
KINDS: dict[str, tuple[Callable[[Path, int], object], dict[str, str]]] = {
    "object.json": (lambda path, i: path.write_text(json.dumps(as_object(i))), {}),
    "list.json": (lambda path, i: path.write_text(json.dumps([as_object(i)], indent=1)), {}),
    "line.jsonl": (lambda path, i: path.write_text(json.dumps(as_object(i)) + "\n"), {}),
    "list.parquet": (lambda path, i: pd.DataFrame([as_object(i)]).to_parquet(path), {}),
    "wide.parquet": (lambda path, i: as_wide(i).to_parquet(path), {}),
    "wide.csv.gz": (lambda path, i: as_wide(i).to_csv(path, index=False), {}),
    "long.parquet": (lambda path, i: as_rows(i).to_parquet(path), LONG),
    "long.csv.gz": (lambda path, i: as_rows(i).to_csv(path, index=False), LONG),
    "each.csv.gz": (lambda path, i: as_rows(i).drop(columns="part").to_csv(path, index=False), {}),
    "each.npz": (lambda path, i: np.savez(path, FZ=FORCES[i], y=LABELS[i], rate_hz=500.0), {}),
    "set.npz": (
        lambda path, i: np.savez(path, FZ=FORCES[[i, i]], y=[LABELS[i]] * 2, rate_hz=500.0),
        {"label": "y"},
    ),
}
BINARY = bytes(np.random.default_rng(1).integers(0, 256, 500, dtype=np.uint8))
DAMAGES: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "cut": (lambda content: content[: len(content) // 2], "the file is cut off"),
    "empty": (lambda _: b"", "it is empty"),
    "binary": (lambda _: BINARY, "it is (none|a binary file)"),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("place", [0, N // 2, N - 1])
def test_a_file_of_a_folder_that_is_damaged_is_a_fault_and_the_others_are_read(
    kind: str, damage: str, place: int, tmp_path: Path
) -> None:
    write, options = KINDS[kind]
    stem, _, suffix = kind.partition(".")
    paths = [tmp_path / f"{stem}_{i:02d}.{suffix}" for i in range(N)]
    for i, path in enumerate(paths):
        write(path, i)
    change, why = DAMAGES[damage]
    paths[place].write_bytes(change(paths[place].read_bytes()))
    data = load_dataset(tmp_path, channel="FZ", **options)
    rows = np.repeat(np.arange(N), 2 if kind == "set.npz" else 1)
    rows = rows[rows != place]
    np.testing.assert_array_equal(data.X, FORCES[rows].astype(np.float32))
    np.testing.assert_array_equal(data.y, np.array(LABELS)[rows])
    (fault,) = data.faults
    assert fault.source == paths[place].name.removesuffix(".gz")
    assert re.search(why, fault.message)


@pytest.mark.parametrize(
    ("name", "value"),
    [("SampleTimeMs", 2), ("dt_ms", 2), ("samplingIntervalUs", 2000), ("SampleRateHz", 500)],
)
def test_a_value_beside_the_list_of_samples_states_the_rate(
    name: str, value: int, tmp_path: Path
) -> None:
    for i in range(N):
        (tmp_path / f"part_{i:02d}.json").write_text(json.dumps(as_object(i) | {name: value}))
    assert load_dataset(tmp_path, channel="FZ").rate_hz == 500


def test_a_folder_of_damaged_files_is_refused_with_the_first_of_them(tmp_path: Path) -> None:
    for i in range(3):
        (tmp_path / f"part_{i}.json").write_text(json.dumps(as_object(i))[:200])
    with pytest.raises(DataError, match=r"part_0\.json: Expected JSON, an object .* is cut off"):
        load_dataset(tmp_path, channel="FZ")


@pytest.mark.parametrize("n_files", [2, 5])
def test_parts_that_may_have_rows_in_a_damaged_file_are_not_read(
    n_files: int, tmp_path: Path
) -> None:
    rows = pd.concat(map(as_rows, range(N)))
    for i, places in enumerate(np.array_split(np.arange(len(rows)), n_files)):
        rows.iloc[places].to_parquet(tmp_path / f"part-{i}.parquet")
    broken = tmp_path / f"part-{n_files // 2}.parquet"
    broken.write_bytes(broken.read_bytes()[:-9])
    with pytest.raises(DataError, match=f"{broken.name}.* is cut off; parts .* in several files"):
        load_dataset(tmp_path, channel="FZ", **LONG)


def test_a_line_of_json_that_is_cut_off_is_a_fault_and_the_others_are_read(tmp_path: Path) -> None:
    lines = [json.dumps(as_object(i)) for i in range(N)]
    lines[4] = lines[4][:80] + "\0" * 20
    path = tmp_path / "parts.jsonl"
    path.write_text("\n".join(lines)[:-50], encoding="utf-8")
    data = load_dataset(path, channel="FZ", part="serial")
    np.testing.assert_array_equal(data.X, np.delete(FORCES, [4, N - 1], axis=0).astype("f4"))
    assert [(fault.line, fault.message) for fault in data.faults] == [
        (5, "Expected an object in JSON, it is cut off"),
        (N, "Expected an object in JSON, it is cut off"),
    ]


@pytest.mark.parametrize(
    ("changed", "rows"),
    [
        ({"result": LABELS[:-2]}, f"FZ has {N}, result has {N - 2}"),
        ({"part": range(N - 1)}, f"FZ has {N}, result has {N}, part has {N - 1}"),
        ({"FX": FORCES[:-3]}, f"FZ has {N}, FX has {N - 3}, result has {N}"),
    ],
)
def test_arrays_of_other_rows_are_refused_with_the_rows_of_each(
    changed: dict[str, object], rows: str, tmp_path: Path
) -> None:
    serials = [f"B{220 + i}" for i in range(N)]
    arrays = {"FZ": FORCES, "FX": FORCES, "result": LABELS, "serial": serials} | changed
    path = tmp_path / "run.npz"
    np.savez(path, **arrays)
    channel = "FZ,FX" if "FX" in changed else "FZ"
    by_serial = "list the labels by serial in a CSV file, labels='labels.csv'"
    with pytest.raises(DataError, match=f"{rows}: nobody can tell which .* or {by_serial}"):
        load_dataset(path, channel=channel, label="result")


def test_a_listing_by_serial_may_leave_traces_of_an_archive_out(tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    serials = np.array([f"B{220 + i}" for i in range(N)])
    np.savez(path, FZ=FORCES, result=LABELS[:-2], serial=serials)
    kept = [i for i in range(N) if i not in (3, 7)]
    listing = pd.DataFrame({"serial": serials[kept], "result": np.array(WORDS)[kept]})
    listing[::-1].to_csv(tmp_path / "labels.csv", index=False)
    data = load_dataset(path, channel="FZ", labels=tmp_path / "labels.csv", part="serial")
    np.testing.assert_array_equal(data.X, FORCES[kept].astype(np.float32))
    assert (data.y.tolist(), data.unlabelled) == ([LABELS[i] for i in kept], 2)
    counted = pd.DataFrame({"nr": range(1, N - 1), "result": WORDS[:-2]})
    counted.to_csv(tmp_path / "counted.csv", index=False)
    with pytest.raises(DataError, match=f"FZ has {N}, counted.csv has {N - 2}"):
        load_dataset(path, channel="FZ", labels=tmp_path / "counted.csv")


@pytest.mark.parametrize("form", ["json", "jsonl", "parquet", "npz"])
@pytest.mark.parametrize("short", ["FZ", "time"])
def test_lists_of_other_lengths_in_a_recording_are_a_fault_that_names_them(
    form: str, short: str, tmp_path: Path
) -> None:
    rows = []
    for i, word in enumerate(WORDS):
        row = {"FZ": FORCES[i].tolist(), "time": SECONDS.tolist(), "result": word}
        row[short] = row[short][: 28 if i == 4 else None]
        rows.append(row)
        if form == "json":
            (tmp_path / f"r_{i:02d}.json").write_text(json.dumps(row))
        if form == "npz":
            np.savez(tmp_path / f"r_{i:02d}_{word}.npz", FZ=row["FZ"], time=row["time"])
    if form == "jsonl":
        (tmp_path / "all.jsonl").write_text("\n".join(map(json.dumps, rows)))
    if form == "parquet":
        pd.DataFrame(rows).to_parquet(tmp_path / "all.parquet")
    data = load_dataset(tmp_path, channel="FZ")
    np.testing.assert_array_equal(data.X, np.delete(FORCES, 4, axis=0).astype(np.float32))
    assert data.rate_hz == 500
    (fault,) = data.faults
    lengths = {"FZ": 30, "time": 30} | {short: 28}
    assert "of one length" in fault.message
    assert all(f"{name} has {n}" in fault.message for name, n in lengths.items())


def test_a_folder_of_binary_files_is_refused_by_their_kind(tmp_path: Path) -> None:
    for name in ("a_OK.tdms", "b_NOK.tdms"):
        (tmp_path / name).write_bytes(b"TDSm" + bytes(200))
    with pytest.raises(DataError, match=r"a_OK\.tdms is a TDMS file; export it as text"):
        load_dataset(tmp_path)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "cp1251"])
def test_a_text_of_wide_characters_is_no_binary_file(encoding: str, tmp_path: Path) -> None:
    for phase, name in enumerate(("a_OK.asc", "b_NOK.asc")):
        rows = [f"{k / 500:.3f};{np.sin(k + phase):.3f}" for k in range(30)]
        content = "\n".join(["# Оператор Иванов", "Время;Сила", *rows, ""]).encode(encoding)
        (tmp_path / name).write_bytes(content)
    data = load_dataset(tmp_path, channel="Сила", time="Время", encoding="cp1251")
    assert (len(data), data.faults) == (2, ())


@pytest.mark.parametrize("name", ["labels.parquet", "labels.json"])
def test_a_listing_in_the_folder_is_no_recording_and_the_error_says_to_give_it(
    name: str, tmp_path: Path
) -> None:
    folder = write_recordings(tmp_path / "cell", with_labels=False)
    LISTINGS[f"l{Path(name).suffix}"](folder / name)
    with pytest.raises(DataError, match=f"{name} names files: give it, labels=") as caught:
        load_dataset(folder)
    path = str(caught.value).partition("labels='")[2].partition("'")[0]
    assert load_dataset(folder, labels=path).y.tolist() == LABELS
