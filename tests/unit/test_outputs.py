"""Outputs: whole or not at all, and never over something else; an export that is killed is loadable all the same."""

import hashlib
import os
import signal
import sqlite3
import stat
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from matplotlib.figure import Figure

from dengine import DataEngine, export_torchscript, load_exported
from dengine.cli import main
from dengine.errors import DengineError, ExportError, OutputError
from dengine.experiments.figures import save
from dengine.experiments.tables import write_csv
from dengine.export import read_metadata, sum_file
from dengine.files import DATABASES, ONNX, PICTURE, SUMS, TABLES, TORCHSCRIPT, TRACES, check_output, table_of, write_output

KINDS = (TORCHSCRIPT, ONNX, SUMS, PICTURE, TABLES, TRACES, table_of(["seed", "certain"]))
TEXT = b"my notes\n"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory, make_data) -> Path:
    path, data = tmp_path_factory.mktemp("outputs") / "engine.db", make_data(70)
    with DataEngine("pca", retrain_every=60, store=path) as engine:
        for x, y in zip(data.X, data.y, strict=True):
            engine.report(engine.decide(x).id, y)
    return path


@pytest.fixture
def model(store: Path, tmp_path: Path) -> Path:
    with DataEngine.open(store) as engine:
        return export_torchscript(engine, tmp_path / "model.ts")


def dengine(*words: object):
    return CliRunner().invoke(main, [str(word) for word in words])


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_a_file_of_somebody_elses_is_refused_and_left_and_replaced_by_force(kind, tmp_path: Path) -> None:
    target = tmp_path / "file"
    target.write_bytes(TEXT)
    with pytest.raises(OutputError, match=r"was left as it was; name another file, or replace it with --force"):
        write_output(target, b"new", kind)
    assert target.read_bytes() == TEXT
    assert write_output(target, b"new", kind, force=True).read_bytes() == b"new"
    assert [each.name for each in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    "junk", [b"PK\x03\x04", b"PK\x05\x06" + bytes(18), b"\x80" * 99, b"\x08dengine", b"\x89PNG\r\n\x1a\n", b"\0"]
)
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_what_only_begins_like_an_output_is_refused(kind, junk: bytes, tmp_path: Path) -> None:
    target = tmp_path / "file"
    target.write_bytes(junk)
    with pytest.raises(OutputError, match="left as it was"):
        write_output(target, b"new", kind)


def test_an_empty_file_holds_nothing_and_is_replaced(tmp_path: Path) -> None:
    target = tmp_path / "file"
    target.touch()
    assert write_output(target, b"new", SUMS).read_bytes() == b"new"


def test_an_earlier_output_of_the_same_kind_is_replaced(store: Path, tmp_path: Path) -> None:
    with DataEngine.open(store) as engine:
        for _ in range(2):
            export_torchscript(engine, tmp_path / "model.ts")
    figure = Figure()
    for _ in range(2):
        for suffix in ("png", "pdf", "svg"):
            save(figure, tmp_path / f"picture.{suffix}", dpi=20)
    write_csv(pd.DataFrame({"seed": [1], "certain": [2], "older": [3]}), tmp_path / "table.csv")
    write_csv(pd.DataFrame({"seed": [1], "certain": [2]}), tmp_path / "table.csv")
    assert (tmp_path / "table.csv").read_text() == "seed,certain\n1,2\n"
    (tmp_path / "results.png").write_text("a,b\n1,2\n")
    with pytest.raises(OutputError):
        save(figure, tmp_path / "results.png")


def test_a_table_of_other_columns_is_refused(tmp_path: Path) -> None:
    recorded = tmp_path / "run.csv"
    recorded.write_text("timestamp,FZ_Base\n0.0,1.0\n")
    with pytest.raises(OutputError, match="no table with these columns"):
        write_csv(pd.DataFrame({"cycle": [1], "action": ["verify"]}), recorded)
    assert recorded.read_text().startswith("timestamp")


def test_recorded_traces_are_never_taken_for_simulated_ones(tmp_path: Path) -> None:
    recorded = tmp_path / "recorded.npz"
    np.savez(recorded, X=np.zeros((3, 5)), y=np.zeros(3))
    before = recorded.read_bytes()
    pytest.importorskip("mujoco")
    done = dengine("simulate", "--n", 2, "--out", recorded, "--n-jobs", 1)
    assert (done.exit_code, recorded.read_bytes()) == (1, before)
    assert "--force" in done.output
    assert dengine("simulate", "--n", 2, "--out", recorded, "--n-jobs", 1, "--force").exit_code == 0
    assert dengine("simulate", "--n", 2, "--out", recorded, "--n-jobs", 1).exit_code == 0  # its own


@pytest.mark.parametrize("force", [False, True])
def test_no_folder_device_pipe_or_link_is_written_to_even_by_force(tmp_path: Path, force: bool) -> None:
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "mine").write_bytes(TEXT)
    (tmp_path / "link").symlink_to(tmp_path / "mine")
    (tmp_path / "dangling").symlink_to(tmp_path / "nothing")
    places = {name: tmp_path / name for name in ("folder", "pipe", "link", "dangling")} | {"device": Path("/dev/null")}
    for name, target in places.items():
        with pytest.raises(OutputError, match=f"is a {'link' if name == 'dangling' else name}; name another one"):
            write_output(target, b"new", SUMS, force)
    assert (tmp_path / "mine").read_bytes() == TEXT
    assert not (tmp_path / "nothing").exists()
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)


def test_a_planted_partial_link_is_not_followed(store: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.write_bytes(TEXT)
    for name in ("model.ts.partial", "model.ts.sha256.partial", ".dengine-0000000000000000.partial"):
        (tmp_path / name).symlink_to(mine)
    with DataEngine.open(store) as engine:
        export_torchscript(engine, tmp_path / "model.ts")
    assert mine.read_bytes() == TEXT


@pytest.mark.parametrize("force", [[], ["--force"]])
@pytest.mark.parametrize("form", ["torchscript", "onnx"])
def test_an_export_onto_its_own_store_is_refused_and_the_store_untouched(store: Path, force: list, form: str) -> None:
    before = hashlib.sha256(store.read_bytes()).hexdigest()
    done = dengine("export", store, "--out", store, "--format", form, *force)
    assert (done.exit_code, len(done.output.splitlines())) == (1, 1)
    assert "is a database, as a store is, and was left as it was" in done.output
    assert hashlib.sha256(store.read_bytes()).hexdigest() == before
    assert not sum_file(store).exists()


@pytest.mark.parametrize("head", DATABASES)
def test_no_part_of_a_database_is_replaced_even_by_force(head: bytes, tmp_path: Path) -> None:
    target = tmp_path / "engine.db-wal"
    target.write_bytes(head + bytes(100))
    with pytest.raises(OutputError, match="is a database"):
        check_output(target, TORCHSCRIPT, force=True)


def test_those_are_the_first_bytes_of_sqlites_files(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "a.db") as connection:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("CREATE TABLE t (x)")
        connection.commit()
        for name in ("a.db", "a.db-wal"):
            assert (tmp_path / name).read_bytes().startswith(DATABASES)


def test_a_sum_file_of_somebody_elses_stops_the_export_before_anything_is_written(store: Path, tmp_path: Path) -> None:
    (tmp_path / "model.ts.sha256").write_bytes(TEXT)
    with DataEngine.open(store) as engine, pytest.raises(ExportError, match="no file of SHA-256 sums"):
        export_torchscript(engine, tmp_path / "model.ts")
    assert [each.name for each in tmp_path.iterdir()] == ["model.ts.sha256"]


def test_export_replaces_by_force_from_the_command_line(store: Path, tmp_path: Path) -> None:
    target = tmp_path / "model.ts"
    target.write_bytes(TEXT)
    assert dengine("export", store, "--out", target).exit_code == 1
    assert target.read_bytes() == TEXT
    assert dengine("export", store, "--out", target, "--force").exit_code == 0
    assert load_exported(target).trace.samples == 100


@pytest.mark.parametrize("name", ["a\0b", "x" * 300, "missing/model.ts"])
def test_a_name_that_no_file_can_have_is_an_error_of_ours(name: str, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="choose a folder that exists, is writable and has room"):
        write_output(tmp_path / name, b"new", SUMS)


FULL = """
import resource, signal, sys
from dengine import DataEngine, export_torchscript
from dengine.errors import DengineError
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
with DataEngine.open(sys.argv[1]) as engine:
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))  # as a disk that fills up
    try:
        export_torchscript(engine, sys.argv[2])
    except DengineError as error:
        print(type(error).__name__, error)
"""


def test_a_full_disk_is_an_error_of_ours_and_the_earlier_export_stays(store: Path, model: Path, tmp_path: Path) -> None:
    before = model.read_bytes()
    done = subprocess.run([sys.executable, "-c", FULL, store, model], capture_output=True, text=True, check=False)
    assert done.stdout.startswith(f"ExportError Cannot write {model}: File too large; choose a folder"), done.stderr
    assert model.read_bytes() == before
    load_exported(model)
    assert {each.name for each in tmp_path.iterdir()} == {"model.ts", "model.ts.sha256"}


def test_while_an_export_is_replaced_both_sums_are_accepted(model: Path) -> None:
    digest = sum_file(model).read_text()
    assert digest == f"{hashlib.sha256(model.read_bytes()).hexdigest()}  model.ts\n"
    sum_file(model).write_text("0" * 64 + "  model.ts\n" + digest)  # as a kill between the two renames leaves it
    load_exported(model)
    sum_file(model).write_text("0" * 64 + "  model.ts\n" + "1" * 64 + "  model.ts\n")
    with pytest.raises(ExportError, match=r"expected 000000000000… or 111111111111…"):
        load_exported(model)


EXPORTING = """
import os, sys
from dengine.export.file import write_checked
from dengine.outputs import TORCHSCRIPT
contents = [open(name, "rb").read() for name in sys.argv[2:]]
for _ in sys.stdin:  # a line asks for a process: thirty would each wait for torch
    child = os.fork()
    for i in range(10**9 if child == 0 else 0):  # as an export, without what comes before it is written
        write_checked(sys.argv[1], contents[i % 2], TORCHSCRIPT)
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


def kill_one(starter: subprocess.Popen[str], target: Path, seconds: float) -> None:
    """Let a process export onto `target`, and kill it at some moment."""
    starter.stdin.write("\n")
    starter.stdin.flush()
    child = int(starter.stdout.readline())
    try:
        while not target.exists():
            time.sleep(0.001)
        time.sleep(seconds)
    finally:
        os.kill(child, signal.SIGKILL)
    assert int(starter.stdout.readline()) == -signal.SIGKILL


def test_a_killed_export_leaves_a_file_that_loads(store: Path, tmp_path: Path) -> None:
    target, versions = tmp_path / "out" / "model.ts", [tmp_path / "a.ts", tmp_path / "b.ts"]
    target.parent.mkdir()
    with DataEngine.open(store) as engine:
        for version in versions:
            export_torchscript(engine, version)
            engine.report(engine.decide(np.random.default_rng(1).normal(size=100)).id, True)
    known, found = {version.read_bytes() for version in versions}, set()
    assert len(known) == 2
    rng, both = np.random.default_rng(0), 0
    command = [sys.executable, "-c", EXPORTING, target, *versions]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as starter:
        for _ in range(30):
            kill_one(starter, target, float(rng.uniform(0.0, 0.03)))
            assert read_metadata(target)["references"] >= 60  # its sum is right
            found.add(target.read_bytes())
            both += len(sum_file(target).read_text().splitlines()) == 2
    assert found <= known
    load_exported(target)
    assert both > 0, "no kill came between the two renames: the test shows nothing"


@pytest.mark.parametrize(
    "words", [["data", "insertion"], ["replay", "--repeats", "1", "--cycles", "60", "--reducer", "pca"]]
)
def test_a_folder_with_somebody_elses_picture_keeps_it_and_the_tables_are_shown(words: list, tmp_path: Path) -> None:
    for name in ("data.png", "curves.png", "replays.csv"):
        (tmp_path / name).write_bytes(TEXT)
    done = dengine(*words, "--out", tmp_path)
    assert done.exit_code == 1
    assert "Error: " in done.output
    assert "was left as it was" in " ".join(done.output.split())
    assert all((tmp_path / name).read_bytes() == TEXT for name in ("data.png", "curves.png", "replays.csv"))
    assert words[0] == "data" or "certain" in done.output  # what took long is shown all the same
    assert dengine(*words, "--out", tmp_path, "--force").exit_code == 0


def test_every_output_error_is_an_error_of_dengines() -> None:
    assert issubclass(OutputError, DengineError)
