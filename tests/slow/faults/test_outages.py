"""The store fails while the cell runs: nothing is lost, nothing raises, nobody waits long, and two
never own one cell.
"""

import contextlib
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dengine import Action, DataEngine, Decision, Reason, Source
from dengine.errors import StoreError
from dengine.store import Event, NewLabel, StoredDecision
from dengine.store.journal import FRAME, Journal, decode_record, encode_record
from tests.conftest import NO_POSTGRES, POSTGRES
from tests.slow.faults.__main__ import faults, preloaded
from tests.slow.faults.harness import RECIPE, Cell, Outcome, Place
from tests.slow.faults.kinds import ON_DISKS, Hung, killed_server, lock

ASIDE = (*ON_DISKS, killed_server)  # which want a library before the disk, or a server of their own
FAULTS = {(where, words): fault for where, words, fault, _ in faults(1, 3, 2) if fault not in ASIDE}


@pytest.mark.parametrize(("where", "words"), FAULTS)
def test_a_fault_costs_no_label_raises_nothing_keeps_nobody_waiting_and_changes_no_decision(
    where: str, words: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    if where == "PostgreSQL" and not POSTGRES:
        pytest.skip(NO_POSTGRES)
    outcome = Outcome()
    at = (
        request.getfixturevalue("database")
        if where == "PostgreSQL"
        else str(tmp_path / "engine.db")
    )
    FAULTS[where, words](outcome, Place(at))
    assert (outcome.lost, outcome.wrong, outcome.raised) == (0, 0, 0), outcome.told
    assert outcome.injected > 0
    assert outcome.labels > 0 or "SIGKILL" in words  # it may be killed before its first one
    assert outcome.longest < 20.0  # seconds: without a limit it would be a minute


@pytest.mark.merge
@pytest.mark.skipif(
    shutil.which("gcc") is None, reason="the library between this process and its disk needs gcc"
)
def test_a_sync_that_hangs_or_fails_costs_nothing(
    repo: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(
        "DENGINE_STORE_WAIT", raising=False
    )  # as a cell waits for its store: the tests' own wait is long
    words = [sys.executable, "-m", "tests.slow.faults", "--trials", "1", "--only", "sync"]
    done = subprocess.run(
        words, cwd=repo, env=preloaded(), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture
def place(tmp_path: Path) -> Place:
    return Place(str(tmp_path / "engine.db"))


@pytest.fixture
def cell(place: Place) -> Iterator[Cell]:
    created = Cell(place, Outcome())
    yield created
    created.engine.close()


def test_a_version_that_took_too_long_to_store_is_not_stored_later(
    place: Place, cell: Cell
) -> None:
    cell.play(100)
    cell.engine.flush()
    before = cell.engine.version
    with lock(place):
        report = cell.engine.retrain()
    assert not report.accepted
    assert "not stored" in report.reason
    cell.until_back()
    cell.engine.flush()
    assert (
        cell.engine.version
        == max(kept.version for kept in cell.engine.store.versions.retrains())
        == before
    )
    cell.finish()
    assert cell.outcome.wrong == 0, cell.outcome.told


def test_a_forgotten_engine_gives_its_cell_free(place: Place) -> None:
    engine = DataEngine(recipe=RECIPE, store=place.url)
    del engine
    DataEngine.open(place.url).close()


def test_closing_does_not_wait_for_a_hung_retrain(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dengine.engine.engine.CLOSE_SECONDS", 0.1)
    cell = Cell(place, Outcome(), executor=Hung())
    cell.play(60)
    cell.engine.close()
    assert not cell.engine.state.is_retraining


def test_an_executor_that_was_shut_down_is_replaced_by_retrains_in_line(place: Place) -> None:
    pool = ThreadPoolExecutor(1)
    pool.shutdown()
    cell = Cell(place, Outcome(), executor=pool)
    cell.play(100)
    assert cell.engine.version > 0
    cell.finish()
    assert cell.outcome.raised == 0


def left(path: Path) -> tuple[list[bytes], str]:
    """What a journal holds when it is opened again, and what it lost."""
    with contextlib.closing(Journal(path)) as again:
        return [record for _, _, record in again.undrained_records()], again.loss


@pytest.mark.parametrize(
    ("damage", "kept", "loss"),
    [
        (
            lambda content, at: flipped(content, at[1] + FRAME.size + 5),
            "ACDE",
            "1 records",
        ),  # a record
        (lambda content, at: flipped(content, at[1] + 5), "ACDE", "1 records"),  # its length
        (
            lambda content, at: flipped(content, at[1] + FRAME.size - 3),
            "ABCDE",
            "in 2 places",
        ),  # its digest
        (
            lambda content, at: content[: at[1]] + content[at[2] :],
            "ACDE",
            "1 records",
        ),  # one is missing
        (
            lambda content, at: content[: at[4] + 1],
            "ABCD",
            "1 records",
        ),  # the last one is unfinished
        (lambda content, at: content[: at[4] + FRAME.size + 5], "ABCD", "1 records"),
    ],
    ids=["record", "length", "digest", "missing", "mark cut", "record cut"],
)
def test_what_is_damaged_in_a_journal_is_noticed_and_costs_none_behind_it(
    tmp_path: Path, damage: Callable[[bytes, list[int]], bytes], kept: str, loss: str
) -> None:
    path = tmp_path / "a.journal"
    journal = Journal(path)
    offsets = journal.append([bytes([65 + i]) * 50 for i in range(5)], 0.0)
    journal.close()
    path.write_bytes(damage(path.read_bytes(), offsets))
    for _ in range(2):  # and goes on behind what is there
        records, result = left(path)
        assert "".join(chr(record[0]) for record in records) == kept
        assert loss in result
    with contextlib.closing(Journal(path)) as again:
        again.append([b"F" * 50], 0.0)
    assert [record[:1] for record in left(path)[0]][-1] == b"F"


def flipped(content: bytes, place: int) -> bytes:
    changed = bytearray(content)
    changed[place] ^= 1
    return bytes(changed)


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
    label = NewLabel("part 7", True, Source.CONFIRMED, 3, point, 5, 12.25, -(2**63), 0.1)
    event = Event(0, 3.5, "safe mode", "began: ä", {"a": [1, None]})
    back, event_back = (decode_record(encode_record(record)) for record in (label, event))
    np.testing.assert_array_equal(back.point, point)
    assert replace(back, point=None) == replace(label, point=None)
    assert event_back == event


def test_what_a_journal_holds_of_another_decision_of_an_id_is_set_aside_with_its_label(
    place: Place,
) -> None:
    def record(x: np.ndarray, time: float) -> StoredDecision:
        created = Decision(
            "part 7",
            Action.VERIFY,
            Action.VERIFY,
            0.0,
            1.0,
            0,
            0,
            None,
            0,
            Reason.NO_MODEL,
            False,
            1.0,
        )
        return StoredDecision(created, x, 1, False, time)

    first, other = (record(np.full((1, 5), i, dtype=np.float32), float(i)) for i in range(2))
    label = NewLabel("part 7", False, Source.VERIFICATION, 0, None, content_hash=1)
    with place.store() as store:
        for _ in range(2):  # the same again is taken, and counts once
            assert store.apply_records([first]) == []
        assert store.apply_records([other, replace(label, time=5.0, decided=other.time)]) == []
        assert (store.decisions.get("part 7").success, store.decisions.counts()["labels"]) == (
            None,
            0,
        )
        texts = [event.text for event in store.events.newest()]
        assert [event.kind for event in store.events.newest()] == ["dead letter", "dead letter"]
        assert "data" in texts[0]
        assert "another decision" in texts[1]
        for _ in range(2):
            assert store.apply_records([replace(label, time=6.0, decided=first.time)]) == [
                ("part 7", 1)
            ]
        assert (
            store.apply_records([replace(label, time=7.0, decided=first.time, success=True)]) == []
        )
        assert "a second label" in store.events.newest()[-1].text
