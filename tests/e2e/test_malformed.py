"""Malformed files: recipes, archives, tables, settings; each an error of ours, and nothing large is
unpacked.
"""

import gc
import io
import re
import sqlite3
import struct
import zipfile
from dataclasses import fields
from inspect import signature

import numpy as np
import pytest

from dengine import DataEngine, Policy, Reason, Recipe, load_dataset
from dengine.errors import DataError, DengineError, SettingError
from dengine.files import read_archive
from dengine.reducers import reducer_class
from tests.support.command_line import dengine
from tests.support.driving import learn
from tests.support.tables import rows

VALUES = """0 -1 true nan inf 1e400 0.5 NINES -NINES 2147483648 "" "x" "\\u0000" "LONG" [] ["a"] {a=1}
1979-05-27 07:32:00 ":" ".a:b" "dengine:Recipe" "json:JSONDecoder"
"""
SETTINGS = {f.name: f"{f.name} = {{}}\n" for f in fields(Recipe)}
SETTINGS |= {f.name: f"[policy]\n{f.name} = {{}}\n" for f in fields(Policy)}


def refusal(text: str) -> str:
    """What is said of a recipe, up to the engine that is made by it; "" where it is taken."""
    try:
        DataEngine(recipe=Recipe.from_toml(text, "mine")).close()
    except SettingError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("key", SETTINGS)
def test_a_setting_of_any_type_is_taken_or_refused_by_its_name(key):
    values = VALUES.replace("NINES", "9" * 400).replace("LONG", "x" * 5000).split()
    refused = [*filter(None, (refusal(SETTINGS[key].replace("{}", value)) for value in values))]
    for output in refused:
        assert len(output) < 2000
        assert re.search(f"{key}|not TOML|module:Class|has no parameter", output), output
    assert len(refused) > len(values) // 3


@pytest.fixture
def no_collection():
    """Collect no garbage during the test: a finalizer that runs where the parser is too deep fails
    by it, and pytest, which reports that in the same place, fails too.
    """
    gc.collect()
    gc.disable()
    yield
    gc.enable()


@pytest.mark.usefixtures("no_collection")
def test_a_setting_that_is_nested_too_deeply_is_refused():
    assert "not TOML" in refusal("[policy]\nalpha = " + "[" * 500 + "]" * 500)


@pytest.mark.parametrize("key", signature(reducer_class("conv")).parameters)
def test_a_parameter_of_another_type_is_refused_before_any_retrain_fails_by_it(key):
    default = signature(reducer_class("conv")).parameters[key].default
    wrong = '"x"' if not isinstance(default, str) else "7"
    assert default is None or key in refusal(f'reducer = "conv"\n[params]\n{key} = {wrong}\n')


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"radius = 0.3 # \xe9", r"mine\.toml is not UTF-8 text"),
        (b"#" * (2**20 + 1), "at most 1 MB"),
    ],
    ids=["no text", "too much"],
)
def test_a_recipe_that_is_no_text_or_too_much_says_so(tmp_path, content, text):
    (tmp_path / "mine.toml").write_bytes(content)
    with pytest.raises(SettingError, match=text):
        Recipe.load(tmp_path / "mine.toml")


def npz(**arrays: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def claiming(shape: str) -> bytes:
    """An archive whose X says that it has this shape, and has nothing."""
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}}}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    magic = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header))
    buffer = io.BytesIO(npz(y=np.ones(3)))
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.writestr("X.npy", magic + header)
    return buffer.getvalue()


CLAIMS = f"(10**6,) (1000000000000,) (-1,) (3,-3) 'x' (2.5,) {'9' * 4400} {'(' * 300}"


@pytest.mark.parametrize("shape", CLAIMS.split(), ids=range(8))
def test_an_archive_that_cannot_be_what_it_says_is_a_data_error(tmp_path, shape):
    (tmp_path / "data.npz").write_bytes(claiming(shape))
    with pytest.raises(DataError, match="Cannot read"):
        load_dataset(tmp_path / "data.npz")


def test_where_every_version_is_damaged_the_engine_opens_without_one_and_says_so(
    tmp_path, make_data
):
    data, path = make_data(70), tmp_path / "engine.db"
    with DataEngine("pca", retrain_every=60, store=path) as engine:
        learn(engine, data, range(len(data)))
    for state in (b"", b"PK", claiming("(1000000000000,)"), npz(a=np.zeros(1))[:-9]):
        with sqlite3.connect(path) as connection:
            connection.execute("UPDATE model_version SET state = ?", (state,))
        with DataEngine.open(path) as engine:
            assert engine.decide(data.X[0]).reason is Reason.NO_MODEL
            assert "damaged" in [event.kind for event in engine.store.events.newest()]


JUNK = """
recipe x = [
recipe radius = 'x'
recipe LONG
seed x
seed -1
seed NINES
seed 4294967296
trace 3
trace {}
trace {"samples": 1e999}
trace DEEP
trace null
"""


@pytest.mark.usefixtures("no_collection")
def test_junk_in_a_stores_settings_is_an_error_of_ours_in_every_verb(tmp_path, make_data):
    path = tmp_path / "engine.db"
    with DataEngine("pca", store=path) as engine:
        learn(engine, make_data(3), range(3))
    kept = path.read_bytes()
    for key, word in rows(JUNK, 2):
        junk = {"LONG": "a" * 10**5, "NINES": "9" * 5000, "DEEP": "[" * 10**5}.get(word, word)
        path.write_bytes(kept)
        with sqlite3.connect(path) as connection:
            connection.execute("UPDATE setting SET value = ? WHERE key = ?", (junk, key))
        with pytest.raises(DengineError):
            DataEngine.open(path)
        for words in (f"status {path}", f"export {path} --out {tmp_path}/m.ts"):
            done = dengine(*words.split())
            assert done.exit_code in (0, 1), (words, junk)
            assert done.exception is None or isinstance(done.exception, SystemExit), (words, junk)


def test_a_bomb_is_refused_by_what_it_claims_and_only_what_is_wanted_counts(monkeypatch):
    bomb = npz(X=np.zeros((3, 9)), big=np.zeros(2**20))
    assert len(bomb) < 2**17
    monkeypatch.setattr("dengine.files.MAX_BYTES", 2**20)
    assert set(read_archive(bomb, ["X"])[0]) == {"X"}
    with pytest.raises(DataError, match=r"at most 1 MB of arrays in .*, got 8 MB"):
        read_archive(bomb)
