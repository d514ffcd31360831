"""The store fails while the cell runs: nothing is lost, nothing raises, nobody waits long, and two never own one cell."""

import contextlib
import itertools
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa

from dengine import Action, DataEngine, Dataset, Policy, Reason, Recipe, ReplayCell, Source
from dengine.errors import ReportError, StoreError
from dengine.store import NewLabel, SqlStore
from dengine.store.journal import HEADER, Journal, LateEvent, LateLabel, from_bytes, to_bytes

ALWAYS = Recipe("pca", radius=0.5, retrain_every=40, policy=Policy(alpha=0.1, lower_bound=0.9))
PROBE = 60  # decisions by which two engines are compared


@pytest.fixture(scope="module")
def stream(make_data) -> Dataset:
    return make_data(500, samples=60, seed=3)


def engine_on(file: Path, wait: float = 0.2, **options) -> DataEngine:
    return DataEngine(recipe=ALWAYS, store=SqlStore(str(file), wait=wait), **options)


def go_on(engine: DataEngine, data: Dataset, first: int, last: int) -> list:
    order = np.arange(first, last)
    return list(engine.run(ReplayCell(data, order), len(order)))


def wait_for(what: Callable[[], object], seconds: float = 30.0, late: Callable[[], str] = lambda: "it never came") -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, late()
        time.sleep(0.05)


def until_back(engine: DataEngine) -> None:
    wait_for(lambda: not engine._keeper.fault, late=lambda: f"the store is still away: {engine._keeper.fault}")


def labels_of(file: Path) -> dict[str, bool]:
    with contextlib.closing(sqlite3.connect(file)) as connection:
        return {name: bool(success) for name, success in connection.execute("SELECT decision_id, success FROM label")}


def told(cycles: list) -> dict[str, bool]:
    return {cycle.decision.id: cycle.success for cycle in cycles if cycle.success is not None}


def bounds(engine: DataEngine, data: Dataset) -> list[tuple]:
    seen = [engine.decide(x) for x in data.X[-PROBE:]]
    return [(d.action, d.lower, d.upper, d.n_success, d.n_failure, d.embedding, d.model_version) for d in seen]


@contextlib.contextmanager
def locked(file: Path) -> Iterator[None]:
    with contextlib.closing(sqlite3.connect(file, isolation_level=None, timeout=30)) as other:
        other.execute("BEGIN IMMEDIATE")
        yield
        other.execute("ROLLBACK")


@contextlib.contextmanager
def full(engine: DataEngine) -> Iterator[None]:
    """SQLite's own error for a full disk: the file may not grow by another page."""
    database = engine.store._database
    engine.flush()
    with contextlib.closing(sqlite3.connect(database.url.database)) as connection:
        connection.isolation_level = None
        connection.execute("VACUUM")  # states of versions that are not kept any more left free pages
        connection.execute("PRAGMA max_page_count = 1")
        with contextlib.suppress(sqlite3.OperationalError):  # every write ends with a row here: not one more fits
            for number in itertools.count():
                connection.execute("INSERT INTO ledger VALUES ('filler', ?, 0, '', NULL, x'')", (number,))

    def keep_small(connection, *_: object) -> None:
        connection.execute("PRAGMA max_page_count = 1")

    def let_grow(connection, *_: object) -> None:
        connection.execute("PRAGMA max_page_count = 1073741823")

    sa.event.listen(database._engine, "checkout", keep_small)
    yield
    sa.event.remove(database._engine, "checkout", keep_small)
    sa.event.listen(database._engine, "checkout", let_grow)


@contextlib.contextmanager
def moved_away(file: Path) -> Iterator[None]:
    away = file.with_suffix(".away")
    file.rename(away)
    yield
    away.rename(file)


# ---------------------------------------------------------------------------------------------- outages


@pytest.mark.parametrize("fault", ["locked", "full", "moved"])
def test_a_fault_of_the_store_costs_no_label_and_raises_nothing_and_the_cell_verifies_meanwhile(
    stream: Dataset, tmp_path: Path, fault: str
) -> None:
    file = tmp_path / "engine.db"
    engine = engine_on(file)
    cycles = go_on(engine, stream, 0, 200)
    outage = {"locked": locked(file), "full": full(engine), "moved": moved_away(file)}[fault]
    with outage:
        first = stream.X[200]
        engine.report(engine.decide(first).id, False) if engine.decide(first).action is Action.VERIFY else engine.flush()
        time.sleep(2.1)  # a store that is only slow is given this long
        during = go_on(engine, stream, 201, 260)
    assert {cycle.decision.reason for cycle in during} == {Reason.NO_STORE}
    until_back(engine)
    after = go_on(engine, stream, 260, 400)
    assert any(cycle.decision.action is Action.ACCEPT for cycle in after)
    assert any(cycle.retrain is not None and cycle.retrain.accepted for cycle in after)
    expected = bounds(engine, stream)
    engine.close()
    kept = labels_of(file)
    assert told(cycles + during + after).items() <= kept.items()
    with DataEngine.open(str(file)) as again:
        assert bounds(again, stream) == expected
    assert not list(tmp_path.glob("*.journal"))


def test_a_version_that_took_too_long_to_store_is_not_stored_later_and_a_reopened_engine_decides_as_the_one_that_went_on(
    stream: Dataset, tmp_path: Path
) -> None:
    file = tmp_path / "engine.db"
    engine = engine_on(file)
    go_on(engine, stream, 0, 100)
    before, put_version = engine.version, engine.store.put_version
    asked = threading.Event()

    def store_it(*row):
        asked.set()
        return put_version(*row)

    engine.store.put_version = store_it
    with locked(file):
        report = engine.retrain()
    assert asked.is_set()
    assert not report.accepted
    assert "not stored" in report.reason
    until_back(engine)
    engine.flush()
    assert engine.version == before
    assert max(kept.version for kept in engine.store.retrains()) == before
    expected = bounds(engine, stream)
    engine.close()
    with DataEngine.open(str(file)) as again:
        assert bounds(again, stream) == expected


def test_closing_while_the_store_is_away_leaves_neither_threads_nor_its_lease(stream: Dataset, tmp_path: Path) -> None:
    file = tmp_path / "engine.db"
    engine = engine_on(file)
    go_on(engine, stream, 0, 60)
    with moved_away(file):
        decision = engine.decide(stream.X[60])
        engine.report(decision.id, True)
        engine.close()
        engine.store._database._writer.join(15.0)
        engine._keeper._thread.join(15.0)
        assert not engine.store._database._writer.is_alive()
        assert not engine._keeper._thread.is_alive()
        assert engine.store._database._engine.pool.checkedout() == 0
        with pytest.raises(StoreError, match="after close"):
            engine.store.flush()
    with DataEngine.open(str(file)) as again:
        assert again.store.get_decision(decision.id).success is True


def test_labels_of_an_outage_survive_a_killed_process(stream: Dataset, tmp_path: Path) -> None:
    file = tmp_path / "engine.db"
    child = """
import sys, numpy as np
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_outages import *
from tests.conftest import insertion_like
file, stream = Path(sys.argv[1]), insertion_like(500, samples=60, seed=3)
engine = engine_on(file)
go_on(engine, stream, 0, 60)
with locked(file):
    for x in stream.X[60:90]:
        decision = engine.decide(x)
        if decision.action is Action.VERIFY:
            engine.report(decision.id, True)
            print(decision.id, flush=True)
    os.kill(os.getpid(), 9)
"""
    done = subprocess.run(
        [sys.executable, "-c", child, str(file), str(Path(__file__).parent)], capture_output=True, text=True, check=False
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    promised = done.stdout.split()
    assert len(promised) >= 10
    assert not set(promised) & set(labels_of(file))  # they are in the journal alone
    with DataEngine.open(str(file)) as engine:
        assert set(promised) <= set(labels_of(file))
        assert all(engine.store.get_decision(name).success for name in promised)


def test_a_replaced_file_takes_no_labels_of_the_old_one(stream: Dataset, tmp_path: Path) -> None:
    file = tmp_path / "engine.db"
    engine = engine_on(file)
    go_on(engine, stream, 0, 50)
    shutil.copy(file, tmp_path / "copy.db")
    (tmp_path / "copy.db").replace(file)
    said = told(go_on(engine, stream, 50, 80))
    assert "deleted, moved or replaced" in engine._keeper.fault
    engine.close()
    assert not set(said) & set(labels_of(file))
    with DataEngine.open(str(file)):
        assert set(said) <= set(labels_of(file))  # from the journal, decisions and all


def test_no_call_waits_longer_than_the_limit_and_the_journal_takes(stream: Dataset, tmp_path: Path) -> None:
    engine = engine_on(tmp_path / "engine.db", wait=0.1)
    go_on(engine, stream, 0, 30)
    release = threading.Event()
    real = engine.store._database.write
    engine.store._database.write = lambda work: (release.wait(60), real(work))[1]  # a disk that does not answer
    cycles = go_on(engine, stream, 30, 60)
    assert not release.is_set()  # nobody waited for it
    release.set()
    until_back(engine)
    engine.close()
    assert told(cycles).items() <= labels_of(tmp_path / "engine.db").items()


def test_a_second_report_is_refused_while_the_store_is_away(stream: Dataset, tmp_path: Path) -> None:
    file = tmp_path / "engine.db"
    with engine_on(file) as engine, locked(file):
        decision = engine.decide(stream.X[0])
        engine.report(decision.id, True)
        with pytest.raises(ReportError, match="success from verification was reported first"):
            engine.report(decision.id, False)
    assert labels_of(file) == {decision.id: True}


def test_where_nothing_can_be_written_a_report_says_so_and_can_be_repeated(stream: Dataset, tmp_path: Path) -> None:
    file = tmp_path / "engine.db"
    with engine_on(file) as engine:
        decision = engine.decide(stream.X[0])
        engine.flush()
        with moved_away(file), pytest.MonkeyPatch.context() as patch:
            patch.setattr(Journal, "append", refuse)
            with pytest.raises(StoreError, match="no room"):
                engine.report(decision.id, True)
            engine.decide(stream.X[1])  # never fails
        until_back(engine)
        engine.report(decision.id, True)
    assert labels_of(file) == {decision.id: True}


def refuse(journal: Journal, records: object) -> list[int]:
    raise StoreError("no room")


def test_a_row_that_no_database_takes_is_set_aside_with_its_reason(tmp_path: Path, stream: Dataset) -> None:
    with engine_on(tmp_path / "engine.db") as engine:
        decision = engine.decide(stream.X[0])
        engine.flush()
        bad = replace(decision, id="bad", n_success=2**70)
        item = replace(engine.store._database.queued(decision.id) or stored_item(engine, stream), decision=bad)
        engine.store._database._queue["bad"] = item  # past every check
        engine.report(decision.id, True)
        later = engine.decide(stream.X[1])
        engine.report(later.id, False)
        assert [event.kind for event in engine.store.events()] == ["set aside"]
        assert "'bad'" in engine.store.events()[0].text
    assert labels_of(tmp_path / "engine.db") == {decision.id: True, later.id: False}


def stored_item(engine: DataEngine, stream: Dataset):
    return engine._maker.decide(np.float32(stream.X[:1]), None, None, 0)


# ---------------------------------------------------------------------------------------------- owners


def test_a_second_engine_on_a_cell_is_refused_and_told_who_has_it(stream: Dataset, tmp_path: Path) -> None:
    file = str(tmp_path / "engine.db")
    with DataEngine(recipe=ALWAYS, store=file) as engine:
        go_on(engine, stream, 0, 30)
        with pytest.raises(StoreError, match=f"process {os.getpid()} on .* owns"):
            DataEngine.open(file)
        with DataEngine.open(file, reading=True) as looking, pytest.raises(StoreError, match="opened for reading"):
            looking.decide(stream.X[0])
        go_on(engine, stream, 30, 60)
    with DataEngine.open(file) as again:
        assert again.decide(stream.X[0]).id


def test_a_forgotten_engine_gives_its_cell_free(tmp_path: Path) -> None:
    file = str(tmp_path / "engine.db")
    engine = DataEngine(recipe=ALWAYS, store=file)
    del engine
    DataEngine.open(file).close()


def test_a_fork_of_an_engine_is_refused_and_disturbs_nothing(stream: Dataset, tmp_path: Path) -> None:
    file = tmp_path / "engine.db"
    child = """
import os, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_outages import *
from tests.conftest import insertion_like
engine, stream = engine_on(Path(sys.argv[1])), insertion_like(100, samples=60, seed=3)
decision = engine.decide(stream.X[0])
pid = os.fork()
if not pid:
    for call in (lambda: engine.decide(stream.X[1]), lambda: engine.report(decision.id, True)):
        try:
            call()
        except StoreError as error:
            assert "got its fork" in str(error)
        else:
            os._exit(1)
    engine.close()
    sys.exit(0)  # by way of everything that runs at the end of a program
assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
engine.report(decision.id, True)
engine.close()
"""
    done = subprocess.run(
        [sys.executable, "-c", child, str(file), str(Path(__file__).parent)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert list(labels_of(file).values()) == [True]


# ---------------------------------------------------------------------------------------------- Ctrl-C


def test_ctrl_c_at_any_moment_leaves_engine_and_store_agreed(stream: Dataset, tmp_path: Path) -> None:
    file, interrupted, rng = tmp_path / "engine.db", 0, np.random.default_rng(0)
    engine = engine_on(file)
    acknowledged: dict[str, bool] = {}
    armed = False

    def interrupt(*_: object) -> None:
        nonlocal armed
        if armed:
            armed = False
            signal.raise_signal(signal.SIGINT)

    before = signal.signal(signal.SIGALRM, interrupt)
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
    for x, y in zip(stream.X[:300], stream.y[:300], strict=True):
        try:
            armed = True
            signal.setitimer(signal.ITIMER_REAL, float(rng.uniform(1e-4, 4e-3)))
            decision = engine.decide(x)
            if decision.action is Action.VERIFY:
                engine.report(decision.id, bool(y))
                acknowledged[decision.id] = bool(y)
            armed = False
        except KeyboardInterrupt:
            interrupted += 1
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    signal.signal(signal.SIGALRM, before)
    signal.signal(signal.SIGINT, handler)
    assert interrupted > 50
    expected = bounds(engine, stream)
    engine.close()
    assert acknowledged.items() <= labels_of(file).items()
    with DataEngine.open(str(file)) as again:
        assert bounds(again, stream) == expected


# ---------------------------------------------------------------------------------------------- executors


class HungExecutor(Executor):
    """Takes work and never does it."""

    def submit(self, fn, /, *args, **kwargs) -> Future:
        return Future()


def test_a_killed_executor_is_given_up_and_retrains_go_on_in_line(stream: Dataset) -> None:
    with ProcessPoolExecutor(1) as pool, DataEngine(recipe=ALWAYS, executor=pool) as engine:
        pool.submit(abs, 1).result()
        (worker,) = pool._processes
        os.kill(worker, signal.SIGKILL)
        for first in range(0, 450, 50):  # the pool is told of its worker's death by a thread of its own, some time later
            go_on(engine, stream, first, first + 50)
            if engine._versions.retrainer.executor is None:
                break
            wait_for(lambda: pool._broken)
        assert engine._versions.retrainer.executor is None  # given up, whether it was asked or answered for
        assert engine.version > 0


def test_a_hung_executor_is_given_up_after_its_deadline_and_close_returns(
    stream: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dengine.engine.trainer.HUNG", 0.2)
    engine = DataEngine(recipe=ALWAYS, executor=HungExecutor())
    go_on(engine, stream, 0, 60)
    assert engine.version == 0
    time.sleep(0.3)
    cycles = go_on(engine, stream, 60, 200)
    assert any("not done after" in cycle.retrain.reason for cycle in cycles if cycle.retrain is not None)
    assert engine.version > 0
    engine.close()


def test_closing_does_not_wait_for_a_hung_retrain(stream: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dengine.engine.engine.CLOSE", 0.1)
    engine = DataEngine(recipe=ALWAYS, executor=HungExecutor())
    go_on(engine, stream, 0, 60)
    engine.close()
    assert not engine.retraining


def test_an_executor_that_was_shut_down_is_replaced_by_retrains_in_line(stream: Dataset) -> None:
    pool = ThreadPoolExecutor(1)
    pool.shutdown()
    with DataEngine(recipe=ALWAYS, executor=pool) as engine:
        go_on(engine, stream, 0, 100)
        assert engine.version > 0


# ---------------------------------------------------------------------------------------------- the journal


def test_what_a_journal_is_given_returns_bit_for_bit(stream: Dataset, tmp_path: Path) -> None:
    engine = DataEngine(recipe=ALWAYS)
    item = engine._maker.decide if engine.trace else None
    assert item is None
    engine.decide(stream.X[0])
    made = engine._maker.decide(np.float32(stream.X[:1]), "part 7", None, 0)
    label = LateLabel(label_of(made.decision.id), 12.25)
    event = LateEvent("safe mode", "began: ä", 3.5)
    with contextlib.closing(Journal(tmp_path / "a.journal")) as journal:
        journal.append([to_bytes(record) for record in (made, label, event)])
        (back, label_back, event_back) = (from_bytes(blob) for _, blob in journal.records())
        journal.clear()
    assert (back.decision, back.content_hash, back.decision.part, back.quarantined) == (
        made.decision,
        made.content_hash,
        "part 7",
        made.quarantined,
    )
    np.testing.assert_array_equal(back.trace, made.trace)
    np.testing.assert_array_equal(label_back.label.point, label.label.point)
    assert replace(label_back.label, point=None) == replace(label.label, point=None)
    assert event_back == event
    assert not (tmp_path / "a.journal").exists()


def label_of(name: str):
    return NewLabel(name, True, Source.CONFIRMED, 3, np.array([0.1, -7e-30], dtype=np.float32), 5)


def test_a_changed_byte_in_a_journal_costs_its_record_and_none_behind_it(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    journal = Journal(path)
    offsets = journal.append([bytes([65 + i]) * 50 for i in range(5)])
    journal.let_go()
    content = bytearray(path.read_bytes())
    content[offsets[1] + 20] ^= 1
    path.write_bytes(content)
    with contextlib.closing(Journal(path)) as again:
        assert again.damaged == [offsets[1]]
        assert again.dropped == 0
        assert [record[:1] for _, record in again.records()] == [b"A", b"C", b"D", b"E"]
        again.append([b"F" * 50])
        assert [record[:1] for _, record in again.records()] == [b"A", b"C", b"D", b"E", b"F"]
        again.clear()
        assert again.empty
        assert not again.damaged


@pytest.mark.parametrize("cut", [1, 5, 9, 30])
def test_an_unfinished_record_at_the_end_is_dropped_and_counted(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "a.journal"
    journal = Journal(path)
    journal.append([b"first", b"second record"])
    end = journal.end
    journal.append([b"x" * 40])
    journal.let_go()
    with path.open("r+b") as file:
        file.truncate(end + cut)
    with contextlib.closing(Journal(path)) as again:
        assert [blob for _, blob in again.records()] == [b"first", b"second record"]
        assert again.dropped > 0
        assert again.end == end > HEADER


def test_another_file_is_not_taken_for_a_journal(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    path.write_text("my notes\n" * 50)
    with pytest.raises(StoreError, match="found another file"):
        Journal(path)
    assert path.read_text() == "my notes\n" * 50
    path.unlink()
    path.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(StoreError, match="Could not use"):
        Journal(path)
