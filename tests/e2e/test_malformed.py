"""Malformed files: recipes, archives, tables, settings; each an error of ours, and nothing large is unpacked."""

import bz2
import io
import json
import math
import random
import sqlite3
import struct
import zipfile
from dataclasses import fields
from inspect import signature
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from dengine import DataEngine, Policy, Reason, Recipe, TraceSpec, load_dataset
from dengine.cli import main
from dengine.errors import DataError, DengineError, SettingError
from dengine.files import must_fit, read_archive
from dengine.records import is_number, is_whole
from dengine.reducers import reducer_class

VALUES = [
    *("0", "1", "-1", "3", "true", "false", "nan", "inf", "-inf", "1e400", "0.5", "-0.5", "1e-320"),
    *("9" * 30, "9" * 400, "-" + "9" * 400, "9" * 5000, "2147483648", "9223372036854775808"),
    *('""', '"x"', '"none"', '"nan"', '"é"', '"\\u0000"', '"' + "x" * 5000 + '"', "'\\u0000'"),
    *("[]", "[1]", "[[1]]", '["a"]', "{}", "{a = 1}", "[" * 500 + "]" * 500),
    *("1979-05-27", "07:32:00", "1979-05-27T07:32:00Z"),
    *('"a:b"', '":"', '".a:b"', '"a..b:c"', '"dengine:Recipe"', '"json:JSONDecoder"'),
]
SETTINGS = [
    *((f.name, f"{f.name} = {{}}\n") for f in fields(Recipe)),
    *((f.name, f"[policy]\n{f.name} = {{}}\n") for f in fields(Policy)),
]
PARAMS = [(key, name) for name in ("conv", "pca", "rocket") for key in signature(reducer_class(name)).parameters]


def refusal(text: str) -> str:
    """What is said of a recipe, up to the engine that is made by it; "" where it is taken."""
    try:
        DataEngine(recipe=Recipe.from_toml(text, "mine")).close()
    except SettingError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(("key", "text"), SETTINGS, ids=lambda value: value.split()[0] if value else value)
def test_a_setting_of_any_type_is_taken_or_refused_by_its_name(key: str, text: str) -> None:
    refused = 0
    for value in VALUES:
        said = refusal(text.replace("{}", value, 1))
        assert len(said) < 2000
        assert not said or key in said or "not TOML" in said or "module:Class" in said or "has no parameter" in said, said
        refused += said != ""
    assert refused > len(VALUES) // 3


@pytest.mark.parametrize(("key", "name"), PARAMS, ids=lambda value: value)
def test_a_parameter_of_another_type_is_refused_before_any_retrain_fails_by_it(key: str, name: str) -> None:
    default = signature(reducer_class(name)).parameters[key].default
    for value in VALUES:
        said = refusal(f'reducer = "{name}"\n[params]\n{key} = {value}\n')
        assert not said or key in said or "not TOML" in said or "params" in said, said
    wrong = '"x"' if not isinstance(default, str) else "7"
    assert default is None or key in refusal(f'reducer = "{name}"\n[params]\n{key} = {wrong}\n')


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"alpha = \x80", "radius = 0.3 # \xe9".encode("latin-1")])
def test_a_recipe_that_is_no_utf8_says_so(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "mine.toml"
    path.write_bytes(content)
    with pytest.raises(SettingError, match=r"mine\.toml is not UTF-8 text: .* at byte \d+; save it as UTF-8"):
        Recipe.load(path)


@pytest.mark.parametrize("name", ["x" * 300, "a\0b", "/", ".", "", "\ud800"])
def test_a_recipe_of_an_impossible_name_is_a_setting_error(name: str) -> None:
    with pytest.raises(SettingError):
        Recipe.load(name)


def test_a_recipe_of_many_megabytes_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("#" * (2**20 + 1))
    with pytest.raises(SettingError, match="at most 1 MB"):
        Recipe.load(path)


@pytest.mark.parametrize("seed", [-1, 2**32, 10**400, 1.5, True, "7", None, float("nan")])
def test_a_seed_that_no_generator_takes_is_refused(seed) -> None:
    with pytest.raises(SettingError, match="seed"):
        DataEngine("pca", seed=seed)


JUNK = [None, True, "x", "", -1, 0, 2.5, float("nan"), float("inf"), 10**400, [], ["a"], {}, b"a", object()]


@pytest.mark.parametrize("field", [f.name for f in fields(TraceSpec)])
def test_a_contract_of_any_types_is_taken_or_refused(field: str) -> None:
    for value in JUNK:
        try:
            TraceSpec(**({"samples": 30} | {field: value}))
        except SettingError:
            continue
        assert value is None or field in ("unit", "columns") or is_number(value), value


# Archives


def npz(**arrays) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def claiming(shape: str, content: bytes = b"", dtype: str = "<f8") -> bytes:
    """An archive whose X says that it has this shape."""
    header = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}}}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("X.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + content)
        archive.writestr("y.npy", npy(np.ones(3)))
    return buffer.getvalue()


def npy(values: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, values)
    return buffer.getvalue()


def with_compression(method: int) -> bytes:
    """An archive whose members say that they are packed by this method."""
    content = bytearray(npz(X=np.zeros((3, 9)), y=np.ones(3)))
    for magic, place in ((b"PK\x03\x04", 8), (b"PK\x01\x02", 10)):
        at = content.find(magic)
        while at >= 0:
            content[at + place : at + place + 2] = struct.pack("<H", method)
            at = content.find(magic, at + 4)
    return bytes(content)


CLAIMS = ["(10**6,)", "(1000000000000,)", "(10000000, 1000000)", "(-1,)", "(3, -3)", "'x'", "(2.5,)", "9" * 4400, "(" * 300]


@pytest.mark.parametrize("shape", CLAIMS, ids=lambda shape: shape[:20])
def test_an_array_that_claims_more_than_its_bytes_is_refused_before_memory_is_taken(tmp_path: Path, shape: str) -> None:
    path = tmp_path / "claim.npz"
    path.write_bytes(claiming(shape))
    with pytest.raises(DataError, match="Cannot read"):
        load_dataset(path)


def test_a_bomb_is_refused_by_what_it_claims(tmp_path: Path) -> None:
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("X.npy", "w") as member:
        member.write(npy(np.zeros(1))[:-8])
        for _ in range(64):
            member.write(bytes(2**20))
    assert path.stat().st_size < 2**17
    with pytest.raises(DataError, match=r"at most 1\.0 MB of arrays in .*, got 64\.0 MB"):
        read_archive(path, limit=2**20)
    with pytest.raises(DataError, match="has another size"):
        load_dataset(path)


def test_only_what_is_wanted_counts() -> None:
    content = npz(X=np.zeros((3, 9)), big=np.zeros(10**6))
    assert set(read_archive(content, ["X"], limit=2**16)[0]) == {"X"}
    with pytest.raises(DataError, match="of arrays in"):
        read_archive(content, limit=2**16)


def test_no_more_than_half_of_the_memory_is_taken_and_never_over_eight_gigabytes() -> None:
    with pytest.raises(DataError, match="GB of arrays in it, got"):
        must_fit(8.1 * 2**30, "it")


@pytest.mark.parametrize("method", [1, 6, 9, 12, 14, 93, 99, 65535])
def test_a_compression_that_is_unknown_or_wrong_is_a_data_error(tmp_path: Path, method: int) -> None:
    path = tmp_path / "packed.npz"
    path.write_bytes(with_compression(method))
    with pytest.raises(DataError, match="Cannot read"):
        load_dataset(path)


def test_a_password_in_an_archive_is_a_data_error(tmp_path: Path) -> None:
    content = bytearray(npz(X=np.zeros((3, 9)), y=np.ones(3)))
    for magic, place in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        content[content.find(magic) + place] |= 1
    path = tmp_path / "locked.npz"
    path.write_bytes(content)
    with pytest.raises(DataError, match="is encrypted"):
        load_dataset(path)


def test_a_file_that_is_damaged_anywhere_is_read_rightly_or_a_data_error(tmp_path: Path) -> None:
    rng = random.Random(0)
    good = npz(X=np.arange(27.0).reshape(3, 9), y=np.array([0, 1, 1]))
    path, refused = tmp_path / "damaged.npz", 0
    for i in range(400):
        content = bytearray(good)
        if i % 3 == 0:
            content = content[: rng.randrange(len(content))]
        else:
            for _ in range(rng.randrange(1, 4)):
                content[rng.randrange(len(content))] = rng.randrange(256)
        path.write_bytes(content)
        try:
            data = load_dataset(path)
        except DataError:
            refused += 1
            continue
        assert data.X.shape == (3, 9)
    assert refused > 300


def test_where_every_version_is_damaged_the_engine_opens_without_one_and_says_so(tmp_path: Path, make_data) -> None:
    data, path = make_data(70), tmp_path / "engine.db"
    with DataEngine("pca", retrain_every=60, store=path) as engine:
        for x, y in zip(data.X, data.y, strict=True):
            engine.report(engine.decide(x).id, y)
    for state in (
        b"",
        b"PK",
        claiming("(1000000000000,)"),
        with_compression(99),
        bz2.compress(b"x"),
        npz(a=np.zeros(1))[:-9],
    ):
        with sqlite3.connect(path) as connection:
            connection.execute("UPDATE model_version SET state = ?", (state,))
        with DataEngine.open(path) as engine:
            assert engine.decide(data.X[0]).reason is Reason.NO_MODEL
            assert "damaged" in [event.kind for event in engine.store.events()]


@pytest.mark.parametrize(
    "content",
    [
        *(
            b"\0" * 50,
            b"FZ_0,FZ_1,label\n\0,\0,\0\n",
            b"\xff\xfe",
            b"FZ_0,FZ_1,label\n1,\xe9,OK\n",
            b'"' * 99,
            b"," * 99,
            b"\n\n",
        ),
        *(b"FZ_0,FZ_1,label\n" + field + b",2,OK\n" for field in (b"1" * 200_000, b'"' + b"x" * 200_000 + b'"')),
    ],
    ids=lambda content: repr(content[:20]),
)
@pytest.mark.parametrize("form", ["table", "folder", "labels"])
def test_a_table_of_nonsense_is_a_data_error(tmp_path: Path, content: bytes, form: str) -> None:
    (tmp_path / "data").mkdir()
    if form == "labels":
        (tmp_path / "data" / "1.csv").write_text("FZ_Base\n1.0\n2.0\n")
        (tmp_path / "labels.csv").write_bytes(content)
        how = {"labels": tmp_path / "labels.csv"}
    else:
        (tmp_path / "data" / "1_OK.csv").write_bytes(content)
        how = {}
    source = tmp_path / "data" / "1_OK.csv" if form == "table" else tmp_path / "data"
    try:
        data = load_dataset(source, **how)
    except DataError:
        return
    assert not np.isfinite(data.X).all()  # an infinity, which the engine finds


@pytest.mark.parametrize("suffix", [".parquet", ".h5"])
def test_a_damaged_table_of_another_format_is_a_data_error(tmp_path: Path, suffix: str) -> None:
    pd = pytest.importorskip("pandas")
    rng, path = random.Random(0), tmp_path / f"data{suffix}"
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
        pd.DataFrame({"x0": [1.0, 2.0], "x1": [1.0, 2.5], "y": [0, 1]}).to_parquet(path)
    else:
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w") as file:
            file["X"], file["y"] = np.zeros((3, 9)), np.ones(3)
    good = path.read_bytes()
    for i in range(60):
        content = bytearray(good[: rng.randrange(len(good))] if i % 3 == 0 else good)
        for _ in range(3 if i % 3 and content else 0):
            content[rng.randrange(len(content))] = rng.randrange(256)
        path.write_bytes(content)
        try:
            load_dataset(path)
        except DataError:
            continue


# Settings of stores


SETTINGS_OF_STORES = {
    "recipe": ["x = [", "reducer = 5", "radius = 'x'", "\ud7ff", "a" * 10**5],
    "seed": ["", "x", "-1", "1.5", "9" * 5000, "٣", str(2**32)],
    "trace": ["", "x", "[]", "3", "{}", '{"samples": "x"}', '{"samples": 1e999}', '{"a": 1}', "[" * 10**5, "null"],
}


@pytest.mark.parametrize("key", SETTINGS_OF_STORES)
def test_junk_in_a_stores_settings_is_an_error_of_ours_in_every_verb(tmp_path: Path, key: str, make_data) -> None:
    path, data = tmp_path / "engine.db", make_data(3)
    with DataEngine("pca", store=path) as engine:
        for x, y in zip(data.X, data.y, strict=True):
            engine.report(engine.decide(x).id, y)
    journal = tmp_path / "journal.csv"
    journal.write_text("1," + ",".join(["0.5"] * 99 + ["1"]) + "\n")
    verbs = (["status", path], ["export", path, "--out", tmp_path / "m.ts"], ["import-labels", journal, "--store", path])
    for junk in SETTINGS_OF_STORES[key]:
        with sqlite3.connect(path) as connection:
            connection.execute("UPDATE setting SET value = ? WHERE key = ?", (junk, key))
        with pytest.raises(DengineError):
            DataEngine.open(path)
        for words in verbs:
            done = CliRunner().invoke(main, list(map(str, words)))
            assert done.exit_code in (0, 1), (words, junk, done.exception)
            assert done.exception is None or isinstance(done.exception, SystemExit), (words, junk, done.exception)


def test_what_a_number_is() -> None:
    assert all(map(is_number, (1, 0.5, np.float32(2), math.inf, np.nan, 10**300)))
    assert not any(map(is_number, (True, "1", None, 10**400, 1j, np.True_)))
    assert is_whole(np.int8(3), 0, 3)
    assert not any(is_whole(value, 0, 3) for value in (True, 1.0, 4, -1, "1", None, np.float64(1)))
    assert json.loads("1e999") == math.inf
