"""The store fails while the cell runs: nothing is lost, nothing raises, nobody waits long, and two never own one cell."""

import contextlib
import os
import sqlite3
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from dengine import DataEngine, Source
from dengine.errors import ReportError, StoreError
from dengine.store import NewLabel
from dengine.store.journal import HEADER, Journal, LateEvent, LateLabel, from_bytes, to_bytes
from tests.slow.faults import kills
from tests.slow.faults.harness import RECIPE, Cell, Outcome, Place, stream
from tests.slow.faults.kinds import ON_SQLITE, Hung, lock, moved_away

KILLS = {
    "cell": partial(kills.kill_cells, times=3),
    "cell, in an outage": partial(kills.kill_cells, times=3, child=kills.in_outage),
    "import": partial(kills.kill_imports, times=1),
    "export": partial(kills.kill_exports, times=2),
}


@pytest.mark.parametrize("fault", [*ON_SQLITE, *KILLS.values()], ids=[*(f.__name__ for f in ON_SQLITE), *KILLS])
def test_a_fault_costs_no_label_raises_nothing_keeps_nobody_waiting_and_changes_no_decision(
    fault: Callable[[Outcome, Place], None], tmp_path: Path
) -> None:
    outcome = Outcome()
    fault(outcome, Place(str(tmp_path / "engine.db")))
    assert (outcome.lost, outcome.wrong, outcome.raised) == (0, 0, 0), outcome.told
    assert outcome.injected > 0
    assert outcome.labels > 0 or fault in KILLS.values()  # it may be killed before its first one
    assert outcome.longest < 20.0  # seconds: a disk that does not answer takes 60


@pytest.fixture
def place(tmp_path: Path) -> Place:
    return Place(str(tmp_path / "engine.db"))


@pytest.fixture
def cell(place: Place) -> Iterator[Cell]:
    made = Cell(place, Outcome())
    yield made
    made.engine.close()


def labels_of(place: Place) -> dict[str, bool]:
    with contextlib.closing(sqlite3.connect(place.url)) as connection:
        return {name: bool(success) for name, success in connection.execute("SELECT decision_id, success FROM label")}


def test_a_version_that_took_too_long_to_store_is_not_stored_later(place: Place, cell: Cell) -> None:
    cell.play(100)
    before = cell.engine.version
    with lock(place):
        report = cell.engine.retrain()
    assert not report.accepted
    assert "not stored" in report.reason
    cell.until_back()
    cell.engine.flush()
    assert cell.engine.version == max(kept.version for kept in cell.engine.store.retrains()) == before
    cell.finish()
    assert cell.outcome.wrong == 0, cell.outcome.told


def test_closing_while_the_store_is_away_leaves_no_thread_and_gives_the_cell_free(place: Place) -> None:
    before = set(threading.enumerate())
    cell = Cell(place, Outcome())
    cell.play(60)
    with moved_away(Path(place.url)):
        decision = cell.engine.decide(stream().X[60])
        cell.engine.report(decision.id, True)
        cell.engine.close()
        for thread in set(threading.enumerate()) - before:
            thread.join(15.0)
        assert not [thread for thread in set(threading.enumerate()) - before if thread.name.startswith("dengine")]
        with pytest.raises(StoreError, match="after close"):
            cell.engine.store.flush()
    with DataEngine.open(place.url) as again:
        assert again.store.get_decision(decision.id).success is True


def test_a_second_report_is_refused_while_the_store_is_away(place: Place, cell: Cell) -> None:
    with lock(place):
        decision = cell.engine.decide(stream().X[0])
        cell.engine.report(decision.id, True)
        with pytest.raises(ReportError, match="success from verification was reported first"):
            cell.engine.report(decision.id, False)
    cell.engine.close()
    assert labels_of(place) == {decision.id: True}


def test_where_nothing_can_be_written_a_report_says_so_and_can_be_repeated(place: Place, cell: Cell) -> None:
    decision = cell.engine.decide(stream().X[0])
    cell.engine.flush()

    def refuse(journal: Journal, records: object) -> list[int]:
        raise StoreError("no room")

    with moved_away(Path(place.url)), pytest.MonkeyPatch.context() as patch:
        patch.setattr(Journal, "append", refuse)
        with pytest.raises(StoreError, match="no room"):
            cell.engine.report(decision.id, True)
        cell.engine.decide(stream().X[1])  # never fails
    cell.until_back()
    cell.engine.report(decision.id, True)
    cell.engine.close()
    assert labels_of(place) == {decision.id: True}


def test_a_second_engine_on_a_cell_is_refused_and_told_who_has_it(place: Place, cell: Cell) -> None:
    cell.play(10)
    with pytest.raises(StoreError, match=f"process {os.getpid()} on .* owns"):
        DataEngine.open(place.url)
    with DataEngine.open(place.url, reading=True) as looking, pytest.raises(StoreError, match="opened for reading"):
        looking.decide(stream().X[0])
    cell.play(10)
    cell.finish()
    assert (cell.outcome.wrong, cell.outcome.raised, cell.outcome.lost) == (0, 0, 0), cell.outcome.told


def test_a_forgotten_engine_gives_its_cell_free(place: Place) -> None:
    engine = DataEngine(recipe=RECIPE, store=place.url)
    del engine
    DataEngine.open(place.url).close()


def test_closing_does_not_wait_for_a_hung_retrain(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dengine.engine.engine.CLOSE", 0.1)
    cell = Cell(place, Outcome(), executor=Hung())
    cell.play(60)
    cell.engine.close()
    assert not cell.engine.retraining


def test_an_executor_that_was_shut_down_is_replaced_by_retrains_in_line(place: Place) -> None:
    pool = ThreadPoolExecutor(1)
    pool.shutdown()
    cell = Cell(place, Outcome(), executor=pool)
    cell.play(100)
    assert cell.engine.version > 0
    cell.finish()
    assert cell.outcome.raised == 0


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


def test_a_label_and_an_event_in_a_journal_return_bit_for_bit(tmp_path: Path) -> None:
    point = np.array([0.1, -7e-30], dtype=np.float32)
    label = LateLabel(NewLabel("part 7", True, Source.CONFIRMED, 3, point, 5), 12.25)
    event = LateEvent("safe mode", "began: ä", 3.5)
    with contextlib.closing(Journal(tmp_path / "a.journal")) as journal:
        journal.append([to_bytes(record) for record in (label, event)])
        (back, event_back) = (from_bytes(blob) for _, blob in journal.records())
        journal.clear()
    np.testing.assert_array_equal(back.label.point, point)
    assert replace(back.label, point=None) == replace(label.label, point=None)
    assert event_back == event
    assert not (tmp_path / "a.journal").exists()
