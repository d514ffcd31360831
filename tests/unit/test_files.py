"""Outputs: whole or not at all, and never over what is there."""

import errno
import os
import signal
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dengine import DataEngine, export_torchscript, load_exported
from dengine.errors import DataError, ExportError, OutputError
from dengine.export.bundle import sibling_path
from dengine.files import check_output, output_file, write_output
from tests.support.command_line import dengine, refused
from tests.support.driving import learn

TEXT = b"my notes\n"


@pytest.fixture(scope="module")
def store(tmp_path_factory, make_data):
    path = tmp_path_factory.mktemp("outputs") / "engine.db"
    data = make_data(70)
    with DataEngine("pca", retrain_every=60, store=path) as engine:
        learn(engine, data, range(len(data)))
    return path


@pytest.mark.parametrize("force", [False, True])
def test_no_folder_device_pipe_or_link_is_written_to_even_by_force(tmp_path, monkeypatch, force):
    monkeypatch.chdir(tmp_path)
    Path("folder").mkdir()
    os.mkfifo("pipe")
    Path("mine").write_bytes(TEXT)
    Path("link").symlink_to("mine")
    Path("dangling").symlink_to("nothing")
    places = {"/dev/null": "device", "dangling": "link"}
    for name in ("folder", "pipe", "link", *places):
        with pytest.raises(OutputError, match=f"is a {places.get(name, name)}; name another one"):
            write_output(Path(name), b"new", force)
    assert Path("mine").read_bytes() == TEXT
    assert not Path("nothing").exists()


def test_no_part_of_a_database_is_replaced_even_by_force(tmp_path):
    with sqlite3.connect(tmp_path / "a.db") as connection:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("CREATE TABLE t (x)")
        connection.commit()
        for name in ("a.db", "a.db-wal"):
            with pytest.raises(OutputError, match="is a database"):
                check_output(tmp_path / name, force=True)


@pytest.mark.parametrize("name", ["a\0b", "x" * 300, "missing/model.ts"])
def test_a_name_that_no_file_can_have_is_an_error_of_ours(name, tmp_path):
    with pytest.raises(OutputError, match="choose a folder that exists, is writable and has room"):
        write_output(tmp_path / name, b"new")


def test_an_error_of_what_is_written_stays_what_it_is_and_leaves_nothing(tmp_path):
    with pytest.raises(DataError, match="no labels"), output_file(tmp_path / "a.csv"):
        raise DataError("Expected labels, got no labels.")
    with pytest.raises(OutputError, match="No space left"), output_file(tmp_path / "a.csv"):
        raise OSError(errno.ENOSPC, "No space left")
    assert not list(tmp_path.iterdir())


def test_an_export_with_its_sum_is_replaced_by_force_alone(store, tmp_path):
    target = tmp_path / "model.ts"
    total = sibling_path(target, "sha256")
    for present in (target, total):
        present.write_bytes(TEXT)
        assert dengine("export", store, "--out", target).exit_code == 1
        assert present.read_bytes() == TEXT
        assert [file.name for file in tmp_path.iterdir()] == [present.name]
        present.unlink()
    target.write_bytes(TEXT)
    (tmp_path / ".dengine-0000000000000000.partial").symlink_to(store)
    assert dengine("export", store, "--out", target, "--force").exit_code == 0
    load_exported(target)
    total.write_text("0" * 64 + "  model.ts\n")  # as if killed between the file and its sum
    with pytest.raises(ExportError, match="is damaged or truncated"):
        load_exported(target)


@pytest.mark.parametrize("form", ["torchscript", "onnx"])
def test_an_export_onto_its_own_store_is_refused_even_by_force(store, form):
    before = store.read_bytes()
    said = refused("export", store, "--out", store, "--format", form, "--force")
    assert "is a database, as a store is, and was left as it was" in said
    assert store.read_bytes() == before


@contextmanager
def full_disk() -> Iterator[None]:
    """No file of this process grows beyond 20 kB in the block, as on a disk that fills up."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)


def test_a_full_disk_is_an_error_of_ours_and_the_earlier_export_stays(store, tmp_path):
    with DataEngine.open(store) as engine:
        model = export_torchscript(engine, tmp_path / "model.ts")
        before = model.read_bytes()
        with full_disk(), pytest.raises(OutputError, match="ts: File too large; choose a folder"):
            export_torchscript(engine, model, force=True)
    assert model.read_bytes() == before
    load_exported(model)
    assert {file.name for file in tmp_path.iterdir()} == {"model.ts", "model.ts.sha256"}


def test_a_folder_with_somebody_elses_picture_keeps_it_and_the_tables_are_shown(tmp_path):
    # Pictures are named after the recipes, and only those that are drawn are in the way.
    for name in ("data.png", "map_pca.png"):
        (tmp_path / name).write_bytes(TEXT)
    words = f"replay --repeats 1 --cycles 60 --reducer pca --out {tmp_path}".split()
    done = dengine(*words)
    assert done.exit_code == 1
    assert (tmp_path / "map_pca.png").read_bytes() == TEXT
    assert "certain" in done.output  # what took long is shown all the same
    assert dengine(*words, "--force").exit_code == 0
    written = {file.name for file in tmp_path.iterdir() if file.read_bytes() != TEXT}
    assert {file.name for file in tmp_path.iterdir()} - written == {"data.png"}
