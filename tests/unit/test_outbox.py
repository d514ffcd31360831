"""What becomes of records that are damaged in the journal before the store has taken them."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from dengine.store import SqlStore, StoredDecision, outbox
from dengine.store.outbox import Outbox
from tests.support.stores import decision, label, trace


@contextmanager
def opened(folder: Path) -> Iterator[Outbox]:
    box = Outbox(SqlStore(str(folder / "cell.db"), wait=10.0), window=10)
    try:
        yield box
    finally:
        box.close()


@pytest.fixture
def box(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Outbox]:
    """Its records wait in the journal until somebody asks for them in the store."""
    monkeypatch.setattr(outbox, "DRAIN_SECONDS", 1e6)
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
    return [event.text for event in box.store.events() if event.kind == "journal"]


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
    assert box.store.get_decision("part 1").success is True
    assert box.pop_label_numbers() == [("part 1", 1)]
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
    assert box.store.n_decisions() == 4
    assert [box.store.get_decision(f"part {i}").success for i in range(4)] == [
        True,
        True,
        None,
        None,
    ]
    np.testing.assert_array_equal(box.store.get_decision("part 0").trace, items[0].trace)
    assert [event.text for event in box.store.events() if event.kind == "hello"] == [
        "the first",
        "the last",
    ]
    (text,) = journal_events(box)
    assert text.startswith("4 records of ")


def test_a_damaged_decision_that_is_not_in_memory_any_more_is_named_in_an_event(
    box: Outbox, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outbox, "N_RECENT", 1)
    lost = box.record_decision(stored("part 1"))
    box.record_labels([(lost, label("part 1"))])
    kept = box.record_decision(stored("part 2"))
    box.record_labels([(kept, label("part 2"))])
    box.sync()
    damage(tmp_path, b'part 1", "action')
    box.drain()
    assert box.fault == ""
    assert not box.request_label_drain()
    assert box.store.get_decision("part 1") is None
    assert box.find_decision("part 1") is None
    assert box.store.get_decision("part 2").success is True
    (text,) = (event.text for event in box.store.events() if event.kind == "lost")
    assert text.endswith("decisions that are lost: part 1.")
    (letter,) = (event.text for event in box.store.events() if event.kind == "dead letter")
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
