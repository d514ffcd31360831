"""`dengine backup`: a copy that holds what the store and its journals hold, and a plain copy that
is not taken for one.
"""

import shutil
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from dengine import DataEngine, SqlStore
from dengine.store import backup_store, verify_history
from tests.support.command_line import document, line_of, refused
from tests.support.driving import learn
from tests.support.stores import execute, held

IN_STORE, IN_JOURNAL = 40, 25  # parts


@pytest.fixture
def in_use(tmp_path, data):
    """An engine whose newest labels are in its journal alone."""
    with DataEngine("pca", retrain_every=1000, store=tmp_path / "engine.db") as engine:
        learn(engine, data, range(IN_STORE))
        engine.flush()
        with held(tmp_path / "engine.db"):
            learn(engine, data, range(IN_STORE, IN_STORE + IN_JOURNAL))
            yield engine


def labels_of(file: Path, cell: str = "cell") -> list[int]:
    with SqlStore(str(file), cell) as store:
        return store.labels.with_traces().labels.tolist()


def test_a_backup_of_a_store_in_use_holds_the_labels_of_its_journal_opens_and_verifies(
    tmp_path, in_use, data
):
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


def test_what_was_acknowledged_before_a_backup_is_in_it_though_the_engine_goes_on(tmp_path, data):
    acknowledged, ended = list[str](), threading.Event()

    def work():
        with DataEngine("pca", retrain_every=10**6, store=tmp_path / "engine.db") as engine:
            while not ended.is_set():
                i = len(acknowledged)
                decision = engine.decide(data.X[i % len(data)] + np.float32(1e-6 * i))
                engine.report(decision.id, True)
                acknowledged.append(decision.id)

    with ThreadPoolExecutor(1) as pool:
        working = pool.submit(work)
        try:
            for n in range(1, 5):
                while len(acknowledged) < 20 * n and working.running():
                    time.sleep(0.01)
                before, copy = set(acknowledged), f"{tmp_path}/{n}.db"
                backup_store(tmp_path / "engine.db", copy)
                assert verify_history(copy).ok
                with SqlStore(copy) as copied:
                    assert before <= {label.decision_id for label in copied.labels.past(0)}
                    kinds = [event.kind for event in copied.events.newest()]
                assert "dead letter" not in kinds
        finally:
            ended.set()
        working.result()
        assert len(before) >= 80


def test_a_label_is_in_the_backup_once_though_store_and_journal_both_hold_it(tmp_path, in_use):
    file, once, twice = (tmp_path / name for name in ("engine.db", "first.db", "second.db"))
    first = backup_store(file, once)
    # What the journal holds is in the first copy by now.
    shutil.copy(f"{file}.cell.journal", f"{once}.cell.journal")
    second = backup_store(once, twice)
    assert (second.decisions, second.labels) == (first.decisions, first.labels)
    assert labels_of(twice) == labels_of(once)
    with SqlStore(str(twice)) as store:
        assert "dead letter" not in [event.kind for event in store.events.newest()]


def test_verify_says_what_waits_in_a_journal_and_of_a_plain_copy_that_there_is_none(
    tmp_path, in_use
):
    store, copy, n = tmp_path / "engine.db", tmp_path / "plain.db", 2 * IN_JOURNAL
    for suffix in ("", "-wal"):
        shutil.copyfile(f"{store}{suffix}", f"{copy}{suffix}")
    for file, text, waiting in ((store, f"holds {n} records", n), (copy, "is not here", None)):
        assert f"The journal of cell cell {text}" in line_of("verify", file)
        assert document("verify", file)["cells"][0]["waiting"] == waiting
    alone = shutil.copyfile(store, tmp_path / "alone.db")  # without the log, which has its tables
    assert "dengine backup" in refused("verify", alone)


def test_a_cell_moves_to_another_machine_by_backup_and_restore_unless_its_history_was_changed(
    tmp_path, in_use, data, caplog
):
    copy, there = tmp_path / "copy.db", tmp_path / "elsewhere" / "engine.db"
    there.parent.mkdir()
    line_of("backup", tmp_path / "engine.db", "--out", copy)
    restored, verified = document("restore", copy, "--store", there), document("verify", there)
    assert (verified["ok"], verified["cells"]) == (True, [restored["cells"][0] | {"waiting": 0}])
    caplog.clear()
    with DataEngine.open(there) as engine:
        assert engine.status().labels == IN_STORE + IN_JOURNAL
        assert (engine.status().alarm, engine.store.events.newest()) == ("", [])
        learn(engine, data, range(70, 80))
    assert caplog.messages == []
    assert document("verify", there)["ok"]
    assert "name another file" in refused("restore", copy, "--store", there)
    execute(copy, "UPDATE label SET success = 1 - success WHERE seq = 3")
    assert "found faults" in refused("restore", copy, "--store", tmp_path / "third.db")
    assert not (tmp_path / "third.db").exists()


# The store, the copy and the reason. Of a journal that cannot be read no backup is made.
REFUSED = """
engine.db   engine.db        is a database
engine.db   other.db         is a database
engine.db   notes.txt        exists
engine.db   missing/copy.db  choose a folder that exists
nothing.db  copy.db          found no file
notes.txt   copy.db          something else
other.db    copy.db          found another file
"""


def test_a_backup_that_cannot_be_made_says_why_and_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("engine.db", "other.db"):
        DataEngine("pca", store=name).close()
    for name in ("notes.txt", "other.db.cell.journal"):
        Path(name).write_text("mine\n" * 100, encoding="utf-8")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    for line in REFUSED.strip().splitlines():
        store, out, words = line.split(maxsplit=2)
        assert words in refused("backup", store, "--out", out), line
        assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of the size of a file there")
def test_a_backup_that_has_no_room_names_the_copy_and_leaves_nothing_behind(tmp_path, in_use):
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


def test_every_cell_of_a_file_is_in_its_backup(tmp_path, data):
    file, parts = f"{tmp_path}/line.db", {"A": range(10), "B": range(10, 30)}
    with ExitStack() as cells:
        engines = {}
        for name, rows in parts.items():
            engine = DataEngine("pca", retrain_every=1000, store=SqlStore(file, name))
            engines[name] = cells.enter_context(engine)
            learn(engine, data, rows[:1])  # it sets the TraceSpec, which waits for the store
            engine.flush()
        cells.enter_context(held(file))
        for name, engine in engines.items():
            learn(engine, data, parts[name][1:])
        report = backup_store(file, tmp_path / "copy.db")
    assert (report.decisions, report.labels, report.without_journal) == (30, 30, ())
    assert [len(labels_of(tmp_path / "copy.db", name)) for name in parts] == [10, 20]
