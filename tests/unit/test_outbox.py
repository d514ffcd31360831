"""What an engine records is found at once and stored in its order, with a journal and without; what
becomes of records that are damaged in the journal.
"""

import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from dengine.errors import NotTakenError, StoreError
from dengine.records import Action, Reason, Source
from dengine.store import SqlStore, StoredDecision, draining, lookup
from dengine.store.journal import Journal
from dengine.store.journalled import JournalledStore
from dengine.store.memory import MemoryStore
from dengine.store.opening import open_outbox
from dengine.store.outbox import Outbox
from tests.support.stores import decision, label, report, trace


@contextmanager
def opened(folder: Path) -> Iterator[JournalledStore]:
    with closing(JournalledStore(SqlStore(f"{folder}/cell.db", wait=10.0), window=10)) as box:
        yield box


@pytest.fixture
def box(tmp_path, monkeypatch):
    """Its records wait in the journal until somebody asks for them in the store."""
    monkeypatch.setattr(draining, "DRAIN_SECONDS", 1e6)
    with opened(tmp_path) as box:
        for thread in threading.enumerate():
            if thread.name == "dengine-ids":  # it asks the store for what is in it
                thread.join()
        yield box


def stored(name: str, *kind) -> StoredDecision:
    return StoredDecision(decision(name, *kind), trace(), 1, False, time.time())


def record(box: Outbox, name: str, **given) -> StoredDecision:
    """A decision and its label."""
    item = box.record_decision(stored(name))
    box.record_labels([(item, label(name, **given))])
    return item


def damage(folder: Path, *texts: bytes) -> None:
    """Change a bit of each text in the journal."""
    file = folder / "cell.db.cell.journal"
    content = bytearray(file.read_bytes())
    for text in texts:
        content[content.rindex(text)] ^= 1
    file.write_bytes(content)


def events(box: Outbox, kind: str) -> list[str]:
    return [event.text for event in box.store.events.newest() if event.kind == kind]


def test_every_damaged_record_is_stored_from_memory_and_those_beside_it_as_ever(
    box, tmp_path, monkeypatch
):
    monkeypatch.setattr(lookup, "N_RECENT", 1)  # and whether it is among the newest
    items = [record(box, f"part {i}") for i in range(2)]
    for i in (2, 3):
        box.record_decision(stored(f"part {i}"))
    for text in ("the first", "the last"):
        box.record_event("hello", text)
    box.sync()
    damage(tmp_path, b'part 0", "action', b'part 2", "action', b"NewLabel", b"the last")
    assert box.request_label_drain()
    box.drain()
    assert (box.request_label_drain(), box.fault, box.is_drained) == (False, "", True)
    found = [box.store.decisions.get(f"part {i}") for i in range(4)]
    assert [item.success for item in found] == [True, True, None, None]
    np.testing.assert_array_equal(found[0].trace, items[0].trace)
    assert (box.store.labels.newest(), events(box, "hello")) == (2, ["the first", "the last"])
    (text,) = events(box, "journal")
    assert text.startswith("4 records of the journal were damaged on disk")


def test_a_journal_that_was_damaged_while_its_engine_ran_is_no_fault_at_the_next_start(
    box, tmp_path
):
    box.record_decision(stored("part 1"))
    box.sync()
    damage(tmp_path, b'part 1", "action')
    box.close()
    with opened(tmp_path) as again:
        assert again.find_decision("part 1") is not None
        assert len(events(again, "journal")) == 1
        assert again.verify_all_reason == ""


def test_a_journal_that_cannot_be_written_is_tried_again_and_says_why(box, monkeypatch):
    box.record_decision(stored("a"))
    with monkeypatch.context() as patch:
        patch.setattr(Journal, "append", Mock(side_effect=StoreError("the disk is full")))
        with pytest.raises(NotTakenError, match="the disk is full"):
            box.sync()
    assert box.fault == "the disk is full"
    box.sync()
    assert box.fault == ""


def test_a_journal_that_is_made_again_has_all_its_records_and_no_other(tmp_path):
    path, other = tmp_path / "cell.journal", tmp_path / "other.journal"
    with closing(Journal(path)) as journal, closing(Journal(other)) as longer:
        journal.append([b"a record"], 0.0)
        longer.append([b"of another time"] * 9, 0.0)
        path.unlink()
        path.write_bytes(other.read_bytes())
        journal.recreate()
        with closing(Journal(path, owning=False)) as found:  # as after a crash
            records = [record for _, _, record in found.undrained_records()]
            assert (found.loss, records) == ("", [b"a record"])
        path.rename(other).write_bytes(b"")
        with pytest.raises(StoreError, match="was cut off"):
            journal.recreate()
        journal.drained_to = journal.end  # the store has it
        journal.recreate()


def test_a_host_whose_name_is_not_ascii_has_a_journal_with_a_whole_header(tmp_path, monkeypatch):
    monkeypatch.setattr("socket.gethostname", lambda: "Ж" * 60)
    with closing(Journal(tmp_path / "cell.journal")) as journal:
        journal.append([b"a record"], 0.0)
        with closing(Journal(journal.path, owning=False)) as found:
            assert (found.loss, len([*found.undrained_records()])) == ("", 1)


@pytest.fixture(params=["memory", "file"])
def either(request, tmp_path):
    """An outbox of each kind."""
    url = None if request.param == "memory" else f"{tmp_path}/cell.db"
    with closing(open_outbox(SqlStore(url, wait=10.0), window=10)) as box:
        assert isinstance(box, MemoryStore if url is None else JournalledStore)
        yield box


def test_what_is_recorded_is_found_at_once_and_stored_in_its_order(either):
    assert either.find_decision("a") is None
    items = [either.record_decision(stored(name)) for name in "abc"]
    assert [item.number for item in items] == [1, 2, 3]
    assert (either.n_decisions, either.find_decision("b").decision.id) == (3, "b")
    assert [either.number_label() for _ in range(3)] == [1, 2, 3]
    labels = replace(label("b", False), seq=2), replace(label("a"), seq=3)  # whatever was before
    either.record_labels(zip((items[1], items[0]), labels, strict=True))
    assert either.find_decision("b", unsynced=True).success is False
    either.record_event("hello", "there")
    either.drain()
    labelled = either.store.labels.with_traces()
    assert (labelled.seq.tolist(), labelled.labels.tolist()) == ([2, 3], [0, 1])
    assert (either.pop_label_numbers(), events(either, "hello")) == ([], ["there"])
    assert (either.find_earlier("c").decision.id, either.find_earlier("d")) == ("c", None)
    assert (either.is_drained, either.request_label_drain()) == (True, False)
    assert (either.lag, either.fault, either.verify_all_reason) == (0.0, "", "")


def test_a_late_stop_corrects_its_confirmation_and_takes_no_number(either):
    item = either.record_decision(stored("a", Action.ACCEPT, Reason.CERTAIN))
    either.record_labels([(item, label("a", True, source=Source.CONFIRMED))])
    either.drain()
    either.record_labels([(either.find_decision("a"), label("a", False, source=Source.STOP))])
    record(either, "b")
    either.drain()
    assert either.store.decisions.get("b").label_seq == 2
    assert either.store.decisions.get("a").success is False
    assert either.find_decision("a", unsynced=True).success is False
    assert [event.kind for event in either.store.events.newest()] == ["late stop"]


def test_a_version_is_stored_with_its_arrays_as_they_were(either):
    weights = np.zeros(3)
    assert either.wait_for_result(either.store_version(report(1), 7, {"w": weights})) == 1
    weights += 1.0
    version = either.store.versions.newest()
    assert (version.version, version.last_seq, version.state["w"].tolist()) == (1, 7, [0.0] * 3)


def test_a_closed_outbox_takes_nothing_and_what_it_took_can_be_read(either, tmp_path):
    either.check_usable()
    record(either, "a")
    for _ in range(2):
        either.close()
    with pytest.raises(StoreError, match="after close"):
        either.check_usable()
    again = either.store
    if isinstance(either, JournalledStore):
        again = SqlStore(f"{tmp_path}/cell.db")
    assert again.decisions.get("a").success is True
    with closing(open_outbox(again, window=10)) as other:
        assert (other.n_decisions, other.number_label()) == (1, 2)


def test_labels_of_a_product_are_numbered_by_the_store(tmp_path):
    store = SqlStore(f"{tmp_path}/cell.db", product="gear", wait=10.0)
    with closing(open_outbox(store, window=10)) as box:
        for name, number in (("a", -1), ("b", -2)):
            assert box.number_label() == number
            box.record_labels(
                [(box.record_decision(stored(name)), replace(label(name), seq=number))]
            )
        box.drain()
        assert box.pop_label_numbers() == [("a", 1), ("b", 2)]
        assert box.pop_label_numbers() == []
    with pytest.raises(StoreError, match="no product of a store in memory"):
        SqlStore(product="gear")


def test_an_outbox_that_only_reads_says_so_and_stores_a_note(tmp_path):
    with opened(tmp_path) as owner:
        owner.record_decision(stored("a"))
        owner.drain()
        with closing(open_outbox(SqlStore(f"{tmp_path}/cell.db"), 10, reading=True)) as reader:
            with pytest.raises(StoreError, match="opened for reading"):
                reader.check_usable()
            assert reader.find_decision("a").decision.id == "a"
            reader.record_event("export", "a file")
        assert [event.text for event in owner.store.events.newest()] == ["a file"]
