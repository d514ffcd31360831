"""The store fails while the cell runs: nothing is lost, nothing raises, nobody waits long, and two never own one cell."""

import contextlib
import os
import shutil
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from dengine import Action, DataEngine, Decision, Reason, Source
from dengine.errors import ReportError, StoreError, TraceError
from dengine.store import Event, NewLabel, StoredDecision, verify_history
from dengine.store.journal import FRAME, Journal, LostJournalError, TakenLabel, from_bytes, to_bytes
from tests.slow.faults import kills
from tests.slow.faults.harness import RECIPE, Cell, Outcome, Place, stream
from tests.slow.faults.kinds import ON_DISKS, ON_SQLITE, Hung, lock, moved_away

KILLS = {
    "cell": partial(kills.kill_cells, times=3),
    "cell, in an outage": partial(kills.kill_cells, times=3, child=kills.in_outage),
    "import": partial(kills.kill_imports, times=1),
    "export": partial(kills.kill_exports, times=2),
}


def must_cost_nothing(fault: Callable[[Outcome, Place], None], place: Place) -> None:
    outcome = Outcome()
    fault(outcome, place)
    assert (outcome.lost, outcome.wrong, outcome.raised) == (0, 0, 0), outcome.told
    assert outcome.injected > 0
    assert outcome.labels > 0 or fault in KILLS.values()  # it may be killed before its first one
    assert outcome.longest < 20.0  # seconds: without a limit it would be a minute


@pytest.mark.parametrize("fault", [*ON_SQLITE, *KILLS.values()], ids=[*(f.__name__ for f in ON_SQLITE), *KILLS])
def test_a_fault_costs_no_label_raises_nothing_keeps_nobody_waiting_and_changes_no_decision(
    fault: Callable[[Outcome, Place], None], tmp_path: Path
) -> None:
    must_cost_nothing(fault, Place(str(tmp_path / "engine.db")))


@pytest.mark.merge
@pytest.mark.skipif(shutil.which("gcc") is None, reason="the library between this process and its disk needs gcc")
@pytest.mark.parametrize("fault", ON_DISKS, ids=lambda fault: fault.__name__)
def test_a_sync_that_hangs_or_fails_costs_nothing(fault: Callable[[Outcome, Place], None], tmp_path: Path) -> None:
    must_cost_nothing(fault, Place(str(tmp_path / "engine.db")))


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
    cell.engine.flush()
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


def left(path: Path) -> tuple[list[bytes], int, bool]:
    """What a journal holds when it is opened again, how much of it is damaged, and whether its end was dropped."""
    with contextlib.closing(Journal(path)) as again:
        return [record for _, _, record in again.records()], again.damaged, again.dropped > 0


@pytest.mark.parametrize(
    ("damage", "kept", "damaged"),
    [
        (lambda content, at: flipped(content, at[1] + FRAME.size + 5), "ACDE", 1),  # a record
        (lambda content, at: flipped(content, at[1] + 5), "ACDE", 1),  # its length
        (lambda content, at: flipped(content, at[1] + FRAME.size - 3), "ABCDE", 2),  # its digest
        (lambda content, at: content[: at[1]] + content[at[2] :], "ACDE", 1),  # one is missing
    ],
    ids=["record", "length", "digest", "missing"],
)
def test_what_is_damaged_in_a_journal_is_noticed_and_costs_none_behind_it(
    tmp_path: Path, damage: Callable[[bytes, list[int]], bytes], kept: str, damaged: int
) -> None:
    path = tmp_path / "a.journal"
    journal = Journal(path)
    offsets = journal.append([bytes([65 + i]) * 50 for i in range(5)])
    journal.let_go()
    path.write_bytes(damage(path.read_bytes(), offsets))
    for _ in range(2):  # and goes on behind what is there
        records, found, dropped = left(path)
        assert ("".join(chr(record[0]) for record in records), found, dropped) == (kept, damaged, False)
    with contextlib.closing(Journal(path)) as again:
        again.append([b"F" * 50])
    assert [record[:1] for record in left(path)[0]][-1] == b"F"


def flipped(content: bytes, place: int) -> bytes:
    changed = bytearray(content)
    changed[place] ^= 1
    return bytes(changed)


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
    assert left(path) == ([b"first", b"second record"], 0, True)


@pytest.mark.parametrize("lose", [Path.unlink, lambda file: file.rename(f"{file}.away")], ids=["deleted", "moved"])
def test_a_journal_that_is_lost_is_noticed_by_the_next_append_and_made_anew(
    tmp_path: Path, lose: Callable[[Path], object]
) -> None:
    path = tmp_path / "a.journal"
    with contextlib.closing(Journal(path)) as journal:
        behind = journal.append([b"stored", b"not stored"])[1]
        journal.mark(behind, (7, "ab"))
        lose(path)
        with pytest.raises(LostJournalError, match="deleted, moved or replaced"):
            journal.append([b"new"])
        journal.remake()
        journal.append([b"new"])
        assert journal.read(behind) == b"not stored"
    with contextlib.closing(Journal(path)) as again:
        assert ([record for _, _, record in again.records()], again.newest) == ([b"not stored", b"new"], (7, "ab"))


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
    label = TakenLabel(NewLabel("part 7", True, Source.CONFIRMED, 3, point, 5), 12.25, -(2**63), 0.1)
    event = Event(0, 3.5, "safe mode", "began: ä", {"a": [1, None]})
    back, event_back = (from_bytes(to_bytes(record)) for record in (label, event))
    np.testing.assert_array_equal(back.label.point, point)
    assert replace(back, label=replace(back.label, point=None)) == replace(label, label=replace(label.label, point=None))
    assert event_back == event


def test_what_a_journal_holds_of_another_decision_of_an_id_is_set_aside_with_its_label(place: Place) -> None:
    def record(x: np.ndarray, time: float) -> StoredDecision:
        made = Decision("part 7", Action.VERIFY, Action.VERIFY, 0.0, 1.0, 0, 0, None, 0, Reason.NO_MODEL, False, 1.0)
        return StoredDecision(made, x, 1, False, time)

    first, other = (record(np.full((1, 5), i, dtype=np.float32), float(i)) for i in range(2))
    label = NewLabel("part 7", False, Source.VERIFICATION, 0, None)
    with place.store() as store:
        for _ in range(2):  # the same again is taken, and counts once
            assert store.take([first]) == []
        assert store.take([other, TakenLabel(label, 5.0, 1, other.time)]) == []
        assert (store.get_decision("part 7").success, store.status()["labels"]) == (None, 0)
        texts = [event.text for event in store.events()]
        assert [event.kind for event in store.events()] == ["dead letter", "dead letter"]
        assert "data" in texts[0]
        assert "another decision" in texts[1]
        for _ in range(2):
            assert store.take([TakenLabel(label, 6.0, 1, first.time)]) == [("part 7", 1)]
        assert store.take([TakenLabel(replace(label, success=True), 7.0, 1, first.time)]) == []
        assert "a second label" in store.events()[-1].text


def test_a_store_that_was_put_back_from_a_copy_is_told_from_its_journal(place: Place, cell: Cell) -> None:
    cell.play(30)
    cell.engine.flush()
    with contextlib.closing(sqlite3.connect(place.url)) as connection:
        connection.execute("VACUUM INTO ?", (f"{place.url}.copy",))
    cell.play(30)
    cell.engine.close()
    Path(f"{place.url}.copy").replace(place.url)
    for suffix in ("-wal", "-shm"):
        Path(place.url + suffix).unlink(missing_ok=True)
    assert [fault.table for fault in verify_history(place.url).faults] == ["ledger"]
    with contextlib.closing(Journal(Path(f"{place.url}.cell.journal"))) as journal:
        journal.append([to_bytes(Event(0, 1.0, "note", "not in the store yet"))])
    for _ in range(2):  # said once
        with DataEngine.open(place.store()) as again:
            kinds = [event.kind for event in again.store.events()]
            assert (kinds.count("lost"), kinds.count("note")) == (1, 1)


@pytest.mark.parametrize(
    "changed",
    [
        "UPDATE setting SET value = replace(value, 'lower_bound = 0.9', 'lower_bound = 0.8') WHERE key = 'recipe'",
        "UPDATE label SET success = 1 - success WHERE seq = 3",
        "UPDATE correction SET success = 1 - success",
    ],
    ids=["setting", "label", "correction"],
)
def test_where_what_is_in_force_is_not_what_was_written_every_part_is_verified(
    place: Place, cell: Cell, changed: str
) -> None:
    cell.play(60)
    cell.engine.correct(next(iter(cell.acknowledged)), not next(iter(cell.acknowledged.values())))
    cell.engine.close()
    with contextlib.closing(sqlite3.connect(place.url)) as connection, connection:
        assert connection.execute(changed).rowcount == 1
    with DataEngine.open(place.store()) as again:
        assert "see `dengine verify`" in again.store_fault
        decision = again.decide(stream().X[0])
        assert (decision.action, decision.reason) == (Action.VERIFY, Reason.NO_STORE)
        again.report(decision.id, True)
        assert again.find(decision.id).success is True


def until(held: Callable[[], object]) -> None:
    end = time.monotonic() + 30
    while not held():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_an_id_that_cannot_be_looked_up_is_verified_unrecorded_and_a_new_one_is_decided(place: Place, cell: Cell) -> None:
    x = stream().X
    cell.engine.decide(x[0], decision_id="old")
    cell.engine.close()
    cell.engine = DataEngine.open(place.store())
    with moved_away(Path(place.url)):
        cell.engine.report(cell.engine.decide(x[1]).id, True)
        until(lambda: cell.engine.store_fault)
        assert cell.engine.decide(x[2], decision_id="unknown").reason is Reason.NO_STORE
        with pytest.raises(StoreError, match="unknown"):
            cell.engine.report("unknown", True)
    cell.until_back()
    cell.engine.know_ids()
    with moved_away(Path(place.url)):
        cell.engine.report(cell.engine.decide(x[3]).id, True)
        until(lambda: cell.engine.store_fault)
        again = cell.engine.decide(x[2], decision_id="old")  # on another part: whether it is, nobody can say
        assert again.reason is Reason.NO_STORE
        with pytest.raises(StoreError, match="old"):
            cell.engine.report("old", True)
        fresh = cell.engine.decide(x[4], decision_id="fresh")
        assert fresh.reason is not Reason.NO_STORE
        cell.engine.report("fresh", True)
    cell.until_back()
    with pytest.raises(TraceError):
        cell.engine.decide(x[2], decision_id="old")
    assert (cell.engine.find("old").success, cell.engine.find("fresh").success) == (None, True)
