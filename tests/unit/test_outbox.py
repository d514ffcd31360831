"""What an engine records is found at once and stored in its order, with a journal and without; what
becomes of records that are damaged in the journal; recorder, drainer and index each alone.
"""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dengine.errors import NotTakenError, StoreError
from dengine.records import Action, Reason, Source
from dengine.store import NewLabel, SqlStore, StoredDecision, draining, lookup
from dengine.store.draining import Drainer
from dengine.store.journal import Journal
from dengine.store.journalled import JournalledStore
from dengine.store.lookup import DecisionIndex
from dengine.store.memory import MemoryStore
from dengine.store.opening import open_outbox
from dengine.store.outbox import Outbox
from dengine.store.recording import Recorder
from tests.support.stores import decision, label, report, trace


@contextmanager
def opened(folder: Path) -> Iterator[JournalledStore]:
    box = JournalledStore(SqlStore(str(folder / "cell.db"), wait=10.0), window=10)
    try:
        yield box
    finally:
        box.close()


@pytest.fixture
def box(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[JournalledStore]:
    """Its records wait in the journal until somebody asks for them in the store."""
    monkeypatch.setattr(draining, "DRAIN_SECONDS", 1e6)
    with opened(tmp_path) as box:
        for thread in threading.enumerate():
            if thread.name == "dengine-ids":  # it asks the store for what is in it
                thread.join()
        yield box


def stored(name: str) -> StoredDecision:
    return StoredDecision(decision(name), trace(), 1, False, time.time())


def damage(folder: Path, *texts: bytes) -> None:
    """Change a bit of each text in the journal."""
    file = folder / "cell.db.cell.journal"
    content = bytearray(file.read_bytes())
    for text in texts:
        content[content.rindex(text)] ^= 1
    file.write_bytes(content)


def journal_events(box: Outbox) -> list[str]:
    return [event.text for event in box.store.events.newest() if event.kind == "journal"]


def test_a_damaged_label_that_waits_alone_is_stored_from_memory(
    box: Outbox, tmp_path: Path
) -> None:
    item = box.record_decision(stored("part 1"))
    box.flush()
    box.record_labels([(item, label("part 1"))])
    box.sync()
    damage(tmp_path, b"NewLabel")
    assert box.request_label_drain()
    box.drain()
    assert not box.request_label_drain()
    assert box.fault == ""
    assert box.is_drained
    assert box.store.decisions.get("part 1").success is True
    assert box.store.labels.newest() == 1
    (text,) = journal_events(box)
    assert text.startswith("1 records of ")
    assert text.endswith("are stored from memory; decisions that are lost: none.")


def test_every_damaged_record_is_stored_from_memory_and_those_beside_it_as_ever(
    box: Outbox, tmp_path: Path
) -> None:
    items = [box.record_decision(stored(f"part {i}")) for i in range(4)]
    box.record_labels([(item, label(item.decision.id)) for item in items[:2]])
    box.record_event("hello", "the first")
    box.record_event("hello", "the last")
    box.sync()
    damage(tmp_path, b'part 0", "action', b'part 2", "action', b"NewLabel", b"the last")
    box.drain()
    assert box.store.decisions.newest_number() == 4
    assert [box.store.decisions.get(f"part {i}").success for i in range(4)] == [
        True,
        True,
        None,
        None,
    ]
    np.testing.assert_array_equal(box.store.decisions.get("part 0").trace, items[0].trace)
    assert [event.text for event in box.store.events.newest() if event.kind == "hello"] == [
        "the first",
        "the last",
    ]
    (text,) = journal_events(box)
    assert text.startswith("4 records of ")


def test_a_damaged_decision_that_is_not_in_memory_any_more_is_named_in_an_event(
    box: Outbox, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lookup, "N_RECENT", 1)
    lost = box.record_decision(stored("part 1"))
    box.record_labels([(lost, label("part 1"))])
    kept = box.record_decision(stored("part 2"))
    box.record_labels([(kept, label("part 2"))])
    box.sync()
    damage(tmp_path, b'part 1", "action')
    box.drain()
    assert box.fault == ""
    assert not box.request_label_drain()
    assert box.store.decisions.get("part 1") is None
    assert box.find_decision("part 1") is None
    assert box.store.decisions.get("part 2").success is True
    (text,) = (event.text for event in box.store.events.newest() if event.kind == "lost")
    assert text.endswith("decisions that are lost: part 1.")
    (letter,) = (event.text for event in box.store.events.newest() if event.kind == "dead letter")
    assert "a label, success from verification, on 'part 1'" in letter


def test_a_journal_that_was_damaged_while_its_engine_ran_is_no_fault_at_the_next_start(
    box: Outbox, tmp_path: Path
) -> None:
    box.record_decision(stored("part 1"))
    box.sync()
    damage(tmp_path, b'part 1", "action')
    box.close()
    with opened(tmp_path) as again:
        assert again.find_decision("part 1") is not None
        assert len(journal_events(again)) == 1
        assert again.verify_all_reason == ""


@pytest.fixture(params=["memory", "file"])
def either(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Outbox]:
    """An outbox of each kind."""
    url = None if request.param == "memory" else str(tmp_path / "cell.db")
    box = open_outbox(SqlStore(url, wait=10.0), window=10)
    assert isinstance(box, MemoryStore if url is None else JournalledStore)
    yield box
    box.close()


def numbered(box: Outbox, *labels: NewLabel) -> list[NewLabel]:
    """Labels with the next numbers of a cell."""
    return [replace(label, seq=box.number_label()) for label in labels]


def test_what_is_recorded_is_found_at_once_and_stored_in_its_order(either: Outbox) -> None:
    assert either.find_decision("a") is None
    items = [either.record_decision(stored(name)) for name in "abc"]
    assert [item.number for item in items] == [1, 2, 3]
    assert either.n_decisions == 3
    assert either.find_decision("b").decision.id == "b"
    labels = numbered(either, label("b", False), label("a"))
    assert [label.seq for label in labels] == [1, 2]
    either.record_labels(zip((items[1], items[0]), labels, strict=True))
    assert either.find_decision("b", unsynced=True).success is False
    either.record_event("hello", "there")
    either.drain()
    labelled = either.store.labels.with_traces()
    assert (labelled.seq.tolist(), labelled.labels.tolist()) == ([1, 2], [0, 1])
    assert either.pop_label_numbers() == []
    assert [event.text for event in either.store.events.newest()] == ["there"]
    assert either.find_earlier("c").decision.id == "c"
    assert either.find_earlier("d") is None
    assert (either.is_drained, either.request_label_drain()) == (True, False)
    assert (either.lag, either.fault, either.verify_all_reason) == (0.0, "", "")


def test_a_late_stop_corrects_its_confirmation_and_takes_no_number(either: Outbox) -> None:
    accepted = StoredDecision(
        decision("a", Action.ACCEPT, Reason.CERTAIN), trace(), 1, False, time.time()
    )
    item = either.record_decision(accepted)
    either.record_labels([(item, label("a", True, source=Source.CONFIRMED))])
    either.drain()
    confirmed = either.find_decision("a")
    either.record_labels([(confirmed, label("a", False, source=Source.STOP))])
    either.record_labels([(either.record_decision(stored("b")), label("b"))])
    either.drain()
    assert either.store.decisions.get("b").label_seq == 2
    assert either.store.decisions.get("a").success is False
    assert either.find_decision("a", unsynced=True).success is False
    assert [event.kind for event in either.store.events.newest()] == ["late stop"]


def test_a_version_is_stored_with_its_arrays_as_they_were(either: Outbox) -> None:
    weights = np.zeros(3)
    future = either.store_version(report(1), 7, {"w": weights})
    assert either.wait_for_result(future) == 1
    weights += 1.0
    version = either.store.versions.newest()
    assert (version.version, version.last_seq, version.state["w"].tolist()) == (1, 7, [0.0] * 3)


def test_a_closed_outbox_takes_nothing_and_what_it_took_can_be_read(
    either: Outbox, tmp_path: Path
) -> None:
    either.check_usable()
    item = either.record_decision(stored("a"))
    either.record_labels([(item, *numbered(either, label("a")))])
    either.close()
    either.close()
    with pytest.raises(StoreError, match="after close"):
        either.check_usable()
    again = either.store
    if isinstance(either, JournalledStore):
        again = SqlStore(str(tmp_path / "cell.db"))
    assert again.decisions.get("a").success is True
    other = open_outbox(again, window=10)
    assert (other.n_decisions, other.number_label()) == (1, 2)
    other.close()


def test_a_label_keeps_its_number_whatever_the_one_before_was(either: Outbox) -> None:
    skipped, kept = numbered(either, label("a"), label("a"))
    assert (skipped.seq, kept.seq) == (1, 2)
    either.record_labels([(either.record_decision(stored("a")), kept)])
    either.record_labels([(either.record_decision(stored("b")), label("b"))])  # as of before
    either.drain()
    assert [either.store.decisions.get(name).label_seq for name in "ab"] == [2, 3]


def test_labels_of_a_product_are_numbered_by_the_store(tmp_path: Path) -> None:
    store = SqlStore(str(tmp_path / "cell.db"), product="gear", wait=10.0)
    box = open_outbox(store, window=10)
    labels = numbered(box, label("a"), label("b"))
    assert [label.seq for label in labels] == [-1, -2]
    box.record_labels((box.record_decision(stored(one.decision_id)), one) for one in labels)
    box.drain()
    assert box.pop_label_numbers() == [("a", 1), ("b", 2)]
    assert box.pop_label_numbers() == []
    box.close()
    with pytest.raises(StoreError, match="no product of a store in memory"):
        SqlStore(product="gear")


def test_an_outbox_that_only_reads_says_so_and_stores_a_note(tmp_path: Path) -> None:
    file = str(tmp_path / "cell.db")
    SqlStore(file).close()
    with opened(tmp_path) as owner:
        owner.record_decision(stored("a"))
        owner.drain()
        reader = open_outbox(SqlStore(file), window=10, reading=True)
        with pytest.raises(StoreError, match="opened for reading"):
            reader.check_usable()
        assert reader.find_decision("a").decision.id == "a"
        reader.record_event("export", "a file")
        reader.close()
        assert [event.text for event in owner.store.events.newest()] == ["a file"]


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[Journal]:
    created = Journal(tmp_path / "cell.journal")
    yield created
    created.close()


@pytest.fixture
def recorder(journal: Journal) -> Recorder:
    return Recorder(journal, time.time, 10.0)


def test_a_recorder_alone_syncs_records_in_their_order(recorder: Recorder) -> None:
    recorder.record(stored("a"))
    with pytest.raises(NotTakenError, match="no answer within 0 s"):
        recorder.sync(0.0)  # nobody writes
    assert (recorder.n_recorded, recorder.n_synced, recorder.oldest is None) == (1, 0, False)
    recorder.start()
    recorder.record_event("hello", "there")
    recorder.sync()
    assert recorder.n_synced == 2
    first, second = recorder.synced
    assert (first.decision_id, first.record, second.decision_id) == ("a", None, "")
    assert 0 < first.offset < first.end <= second.offset < second.end
    assert recorder.stop(10.0)


def test_a_recorder_tries_again_after_a_failure_and_says_why(
    recorder: Recorder, journal: Journal, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(records: list[bytes], time: float) -> list[int]:
        raise StoreError("the disk is full")

    monkeypatch.setattr(journal, "append", fail)
    recorder.start()
    recorder.record(stored("a"))
    with pytest.raises(NotTakenError, match="the disk is full"):
        recorder.sync()
    assert recorder.fault == "the disk is full"
    monkeypatch.undo()
    recorder.sync()
    assert (recorder.fault, recorder.n_synced) == ("", 1)
    assert recorder.stop(10.0)


def test_a_drainer_alone_stores_what_is_synced_and_makes_calls(
    recorder: Recorder, journal: Journal, tmp_path: Path
) -> None:
    store, index = SqlStore(str(tmp_path / "other.db")), DecisionIndex(journal)
    drainer = Drainer(store, journal, recorder, index, 10.0)
    records = [stored("a"), NewLabel("a", True, Source.VERIFICATION, 0, None)]
    for record in records:
        index.add(record, recorder.record(record))
    assert (drainer.is_drained, index.has_undrained_labels) == (False, True)
    recorder.start()
    drainer.start()
    drainer.drain()
    assert (drainer.is_drained, index.has_undrained_labels, drainer.n_drained) == (True, False, 2)
    assert drainer.wait_for_result(drainer.submit(store.decisions.newest_number)) == 1
    with pytest.raises(ZeroDivisionError):
        drainer.wait_for_result(drainer.submit(lambda: 1 // 0))
    assert recorder.stop(10.0)
    assert drainer.stop(10.0)
    store.close()


def test_an_index_finds_decisions_in_memory_and_in_the_journal_until_they_are_drained(
    journal: Journal, recorder: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lookup, "N_RECENT", 1)
    index = DecisionIndex(journal)
    first, second = stored("a"), stored("b")
    entry = recorder.record(first)
    index.add(first, entry)
    recorder.start()
    recorder.sync()
    index.add(second, recorder.record(second))
    assert "a" not in index.recent
    np.testing.assert_array_equal(index.find("a")[0].trace, first.trace)
    assert (index.is_unsynced("a"), index.find("b")[0] is second) == (False, True)
    index.remove_drained(entry)
    assert index.find("a") == (None, None)
    assert not index.is_new("c")  # not all ids are known
    index.has_all_ids = True
    assert [index.is_new(name) for name in "abc"] == [False, False, True]
    assert recorder.stop(10.0)
