"""`dengine backup`: a copy that holds what the store and its journals hold, and a plain copy that
is not taken for one.
"""

import itertools
import shutil
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np
import pytest

from dengine import DataEngine, Dataset, SqlStore
from dengine.store import backup_store, verify_history
from tests.support.command_line import dengine, document, line_of
from tests.support.driving import learn

IN_STORE, IN_JOURNAL = 40, 25  # parts


@pytest.fixture
def in_use(tmp_path: Path, data: Dataset) -> Iterator[DataEngine]:
    """An engine whose newest labels are in its journal alone: another process holds the
    database.
    """
    with DataEngine("pca", retrain_every=1000, store=str(tmp_path / "engine.db")) as engine:
        learn(engine, data, range(IN_STORE))
        engine.store.flush()
        with closing(sqlite3.connect(tmp_path / "engine.db", isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            learn(engine, data, range(IN_STORE, IN_STORE + IN_JOURNAL))
            yield engine
            other.execute("ROLLBACK")


def labels_of(file: Path, cell: str = "cell") -> list[int]:
    with SqlStore(str(file), cell) as store:
        return store.labels.with_traces().labels.tolist()


def test_a_backup_of_a_store_in_use_holds_the_labels_of_its_journal_opens_and_verifies(
    tmp_path: Path, in_use: DataEngine, data: Dataset
) -> None:
    copy, n = tmp_path / "elsewhere" / "copy.db", IN_STORE + IN_JOURNAL
    copy.parent.mkdir()
    result = document("backup", tmp_path / "engine.db", "--out", copy)
    assert (result["decisions"], result["labels"], result["without_journal"]) == (n, n, [])
    assert result["from_journals"] >= 2 * IN_JOURNAL
    assert list(copy.parent.iterdir()) == [copy]  # one file, and nothing beside it
    assert labels_of(copy) == data.y[:n].tolist()
    assert verify_history(str(copy)).ok
    text = line_of("backup", copy, "--out", tmp_path / "again.db")
    assert "No journal of cell cell lies beside" in text
    learn(in_use, data, range(n, n + 1))  # it goes on meanwhile
    with DataEngine.open(copy) as engine:
        assert engine.status().labels == n


def test_what_was_acknowledged_before_a_backup_is_in_it_though_the_engine_goes_on(
    tmp_path: Path, data: Dataset
) -> None:
    acknowledged, ended = list[str](), threading.Event()

    def work() -> None:
        with DataEngine("pca", retrain_every=10**6, store=tmp_path / "engine.db") as engine:
            for i in itertools.count():
                decision = engine.decide(data.X[i % len(data)] + np.float32(1e-6 * i))
                engine.report(decision.id, True)
                acknowledged.append(decision.id)
                if ended.is_set():
                    return

    with ThreadPoolExecutor(1) as pool:
        working = pool.submit(work)
        try:
            for n in range(1, 5):
                while len(acknowledged) < 20 * n and working.running():
                    time.sleep(0.01)
                before, copy = set(acknowledged), str(tmp_path / f"{n}.db")
                assert len(before) >= 20 * n
                backup_store(tmp_path / "engine.db", copy)
                assert verify_history(copy).ok
                with SqlStore(copy) as copied:
                    assert before <= {label.decision_id for label in copied.labels.past(0)}
                    kinds = [event.kind for event in copied.events.newest()]
                assert "dead letter" not in kinds
        finally:
            ended.set()
        working.result()


def test_a_label_is_in_the_backup_once_though_store_and_journal_both_hold_it(
    tmp_path: Path, in_use: DataEngine
) -> None:
    names = [tmp_path / name for name in ("engine.db", "first.db", "second.db")]
    first = backup_store(*names[:2])
    # What the journal holds is in the first copy by now.
    shutil.copy(f"{names[0]}.cell.journal", f"{names[1]}.cell.journal")
    second = backup_store(*names[1:])
    assert (second.decisions, second.labels) == (first.decisions, first.labels)
    assert labels_of(names[2]) == labels_of(names[1])
    with SqlStore(str(names[2])) as store:
        assert "dead letter" not in [event.kind for event in store.events.newest()]


def test_verify_says_what_waits_in_a_journal_and_of_a_plain_copy_that_there_is_none(
    tmp_path: Path, in_use: DataEngine
) -> None:
    store, copy = tmp_path / "engine.db", tmp_path / "plain.db"
    for suffix in ("", "-wal"):
        shutil.copyfile(f"{store}{suffix}", f"{copy}{suffix}")
    for file, text, n in (
        (store, f"The journal of cell cell holds {2 * IN_JOURNAL} records", 2 * IN_JOURNAL),
        (copy, "The journal of cell cell is not here", None),
    ):
        assert text in line_of("verify", file)
        assert document("verify", file)["cells"][0]["waiting"] == n
    alone = shutil.copyfile(store, tmp_path / "alone.db")  # without the log, which has its tables
    assert "dengine backup" in dengine("verify", alone).stderr


def test_a_cell_moves_to_another_machine_by_backup_and_restore(
    tmp_path: Path, in_use: DataEngine, data: Dataset, caplog: pytest.LogCaptureFixture
) -> None:
    copy, there = tmp_path / "copy.db", tmp_path / "elsewhere" / "engine.db"
    there.parent.mkdir()
    line_of("backup", tmp_path / "engine.db", "--out", copy)
    restored = document("restore", copy, "--store", there)
    verified = document("verify", there)
    assert (verified["ok"], verified["cells"]) == (True, [restored["cells"][0] | {"waiting": 0}])
    caplog.clear()
    with DataEngine.open(there) as engine:
        assert engine.status().labels == IN_STORE + IN_JOURNAL
        assert (engine.status().alarm, engine.store.events.newest()) == ("", [])
        learn(engine, data, range(70, 80))
    assert caplog.messages == []
    assert document("verify", there)["ok"]
    assert "name another file" in dengine("restore", copy, "--store", there).output


def test_a_copy_whose_history_was_changed_is_not_restored(
    tmp_path: Path, in_use: DataEngine
) -> None:
    copy, there = tmp_path / "copy.db", tmp_path / "there.db"
    backup_store(tmp_path / "engine.db", copy)
    with closing(sqlite3.connect(copy)) as connection, connection:
        connection.execute("UPDATE label SET success = 1 - success WHERE seq = 3")
    result = dengine("restore", copy, "--store", there)
    assert (result.exit_code, "found faults" in result.output) == (1, True)
    assert not there.exists()


# Of a journal that cannot be read no backup is made.
@pytest.mark.parametrize(
    ("store", "out", "words"),
    [
        ("engine.db", "engine.db", "is a database"),
        ("engine.db", "other.db", "is a database"),
        ("engine.db", "notes.txt", "exists"),
        ("engine.db", "missing/copy.db", "choose a folder that exists"),
        ("nothing.db", "copy.db", "found no file"),
        ("notes.txt", "copy.db", "something else"),
        ("other.db", "copy.db", "found another file"),
    ],
)
def test_a_backup_that_cannot_be_made_says_why_and_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, store: str, out: str, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("engine.db", "other.db"):
        DataEngine("pca", store=name).close()
    for name in ("notes.txt", "other.db.cell.journal"):
        Path(name).write_text("mine\n" * 100, encoding="utf-8")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    result = dengine("backup", store, "--out", out)
    assert result.exit_code == 1
    assert words in result.output
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of the size of a file there")
def test_a_backup_that_has_no_room_names_the_copy_and_leaves_nothing_behind(
    tmp_path: Path, in_use: DataEngine
) -> None:
    program = """
import resource, signal, sys
from dengine.cli import main
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))  # a disk that becomes full
main()
"""
    words = [sys.executable, "-c", program, "backup", "engine.db", "--out", "copy.db"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "Cannot write copy.db" in done.stderr
    assert "choose a folder that has room" in " ".join(done.stderr.split())
    assert list(tmp_path.glob("*copy*")) == []


def test_every_cell_of_a_file_is_in_its_backup(tmp_path: Path, data: Dataset) -> None:
    file, copy = str(tmp_path / "line.db"), tmp_path / "copy.db"
    parts = {"A": range(10), "B": range(10, 30)}
    with ExitStack() as cells:
        engines = [
            cells.enter_context(DataEngine("pca", retrain_every=1000, store=SqlStore(file, name)))
            for name in parts
        ]
        for engine, rows in zip(engines, parts.values(), strict=True):
            learn(engine, data, rows[:1])  # it sets the TraceSpec, which waits for the store
            engine.store.flush()
        other = cells.enter_context(closing(sqlite3.connect(file, isolation_level=None)))
        other.execute("BEGIN IMMEDIATE")
        for engine, rows in zip(engines, parts.values(), strict=True):
            learn(engine, data, rows[1:])
        report = backup_store(file, copy)
    assert (report.decisions, report.labels, report.without_journal) == (30, 30, ())
    assert {name: len(labels_of(copy, name)) for name in parts} == {"A": 10, "B": 20}
