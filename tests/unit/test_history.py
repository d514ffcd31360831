"""Looking back: pages, filters and counts of a store, in memory, in SQLite and in PostgreSQL."""

import os
import uuid
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import numpy as np
import pytest

import dengine.history
from dengine import SqlStore
from dengine.errors import SettingError, StoreError
from dengine.history.status import beside, history, interleaved
from dengine.records import Action, Decision, Reason, RetrainReport, Source
from dengine.store import MemoryStore, Store
from dengine.store.records import Event, StoredDecision, StoredVersion
from dengine.store.views import HistoryFilter, stretch_of, tally_of
from tests.support.plans import plans

POSTGRES = os.environ.get("DENGINE_TEST_POSTGRES")
KINDS = (  # action, predicted, reason, audit
    (Action.VERIFY, Action.VERIFY, Reason.UNCERTAIN, False),
    (Action.VERIFY, Action.VERIFY, Reason.NOVEL, False),
    (Action.VERIFY, Action.ACCEPT, Reason.AUDIT, True),
    (Action.VERIFY, Action.REJECT, Reason.AUDIT, True),
    (Action.ACCEPT, Action.ACCEPT, Reason.CERTAIN, False),
    (Action.REJECT, Action.REJECT, Reason.CERTAIN, False),
)
N = 60


@pytest.fixture(
    params=[
        "memory",
        "sqlite",
        pytest.param("postgres", marks=pytest.mark.skipif(not POSTGRES, reason="DENGINE_TEST_POSTGRES is unset")),
    ]
)
def make(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Callable[[Callable[[], float]], Store]]:
    """Opens a store of a cell of its own, with a clock."""
    opened: list[Store] = []

    def open_one(clock: Callable[[], float]) -> Store:
        cell = uuid.uuid4().hex
        url = str(tmp_path / "engine.db") if request.param == "sqlite" else str(POSTGRES)
        opened.append(MemoryStore(cell, clock) if request.param == "memory" else SqlStore(url, cell, clock))
        return opened[-1]

    yield open_one
    for store in opened:
        store.close()


@pytest.fixture
def store(make: Callable[[Callable[[], float]], Store]) -> Store:
    """60 decisions of all kinds, three of each moment; half of them labelled; a retrain after each tenth; two events."""
    seconds = count(1000)
    made = make(lambda: float(next(seconds) // 3))
    rng = np.random.default_rng(0)
    for i in range(N):
        action, predicted, reason, audit = KINDS[int(rng.integers(len(KINDS)))]
        decision = Decision(
            f"d{i:03d}", action, predicted, 0.2, 0.9, i, 1, ((0.1, 0.2),), i // 10, reason, audit, 0.1, f"p{i}"
        )
        made.put_decision(decision, np.full((1, 5), i, np.float32), i, quarantined=i % 13 == 5)
        if action is not Action.REJECT and rng.random() < 0.6:
            source = Source.STOP if action is Action.ACCEPT else Source.AUDIT if audit else Source.VERIFICATION
            made.put_label(decision.id, action is not Action.ACCEPT and i % 3 > 0, source, i // 10, np.ones(2, np.float32))
        if i % 10 == 9:
            made.put_version(RetrainReport(i // 10 + 1, 0.1, i, 3, True, "accepted"), i // 2, {"w": np.full(3, i)})
    made.put_event("safe mode", "too many traces were novel")
    made.put_event("safe mode ended", "fresh evidence keeps the tolerance")
    return made


def everything(store: Store) -> list[StoredDecision]:
    return list(history(store))


def test_all_of_a_history_comes_once_and_in_order_whatever_the_page(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = everything(store)
    assert sorted(past.decision.id for past in whole) == [f"d{i:03d}" for i in range(N)]
    assert [past.key for past in whole] == sorted(past.key for past in whole)
    monkeypatch.setattr(dengine.history.status, "PAGE", 7)
    assert everything(store) == whole
    for last in (1, 7, 8, 59, 60, 1000):
        assert list(history(store, last=last)) == whole[-last:]


def test_a_filter_takes_what_it_says_and_the_newest_of_that(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dengine.history.status, "PAGE", 4)
    whole = everything(store)
    middle = whole[N // 2].time
    for asked, takes in (
        ({"action": "accept"}, lambda past: past.decision.action is Action.ACCEPT),
        ({"reason": Reason.NOVEL}, lambda past: past.decision.reason is Reason.NOVEL),
        ({"label": "good"}, lambda past: past.success is True),
        ({"label": "bad"}, lambda past: past.success is False),
        ({"label": "none"}, lambda past: past.success is None),
        ({"since": middle}, lambda past: past.time >= middle),
        ({"until": middle}, lambda past: past.time < middle),
        (
            {"action": "verify", "label": "bad", "since": middle},
            lambda past: (past.decision.action, past.label) == (Action.VERIFY, "bad") and past.time >= middle,
        ),
    ):
        expected = [past for past in whole if takes(past)]
        assert expected, asked
        assert list(history(store, **asked)) == expected
        assert list(history(store, last=3, **asked)) == expected[-3:]


def test_a_past_decision_has_its_part_its_evidence_and_its_label(store: Store) -> None:
    labelled = next(past for past in everything(store) if past.label == "good")
    stored = store.get_decision(labelled.decision.id)
    assert stored == labelled
    assert (stored.trace.size, labelled.trace.size) == (5, 0)
    assert store.get_decision(labelled.decision.id, trace=False) == labelled
    assert labelled.label_time is not None
    assert labelled.label_time >= labelled.time
    assert store.get_decision("unknown", trace=False) is None


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"action": "pass"}, "Expected action to be one of verify, accept, reject, got 'pass'"),
        ({"reason": "why"}, "Expected reason to be one of certain"),
        ({"label": "ok"}, "Expected label to be one of good, bad, none, got 'ok'"),
        ({"last": 0}, "Expected last to be 1 or more, got 0"),
    ],
)
def test_a_filter_that_is_none_is_refused_with_those_there_are(asked: dict, said: str) -> None:
    with pytest.raises(SettingError, match=said):
        history(MemoryStore(), **asked)
    if "label" in asked:
        with pytest.raises(StoreError, match="Expected label"):
            HistoryFilter(label=asked["label"])


def test_counts_of_a_store_are_those_of_its_history(store: Store) -> None:
    whole = everything(store)
    for last in (None, 1, 10, 59, 500):
        some = whole if last is None else whole[-last:]
        found, expected = store.tally(last), tally_of(some)
        assert set(found.kinds) == set(expected.kinds)
        assert (found.first, found.last) == (some[0].time, some[-1].time)
    assert store.tally().outcomes == store.outcomes()


@pytest.mark.parametrize("n", [1, 7, 60, 500])
def test_stretches_are_consecutive_and_hold_everything(store: Store, n: int) -> None:
    whole = everything(store)
    length = max(1, -(-N // n))
    expected = [stretch_of(whole[start : start + length]) for start in range(0, N, length)]
    assert store.stretches(n) == expected


def test_an_empty_store_has_no_past(make: Callable[[Callable[[], float]], Store]) -> None:
    empty = make(lambda: 1.0)
    assert everything(empty) == list(history(empty, last=5)) == empty.stretches(10) == empty.past_labels(0) == []
    assert (empty.tally().count(), empty.tally().first) == (0, None)


def test_labels_come_along_their_numbers_with_what_the_rule_was_told(store: Store) -> None:
    every = store.past_labels(0)
    assert [label.seq for label in every] == list(range(1, len(every) + 1))
    assert store.past_labels(3, 7) == every[3:7]
    assert all(label.point is None for label in every)
    assert store.past_labels(0, points=True)[0].point == pytest.approx(np.ones(2))
    known = store.evidence_since(0)
    told = [label for label in every if not label.quarantined]
    assert [label.seq for label in told] == known.seq.tolist()
    assert [label.novel for label in told] == known.novel.tolist()
    by_id = {past.decision.id: past for past in everything(store)}
    assert all(label.decided == by_id[label.decision_id].time for label in every)


def test_retrains_have_their_times_and_newer_versions_are_kept(store: Store) -> None:
    retrains = store.versions(own=True)
    assert [each.report for each in retrains] == store.retrains()
    assert [each.number for each in retrains] == list(range(1, 7))
    assert [each.time for each in retrains] == sorted(each.time for each in retrains)
    for version in (2, 6):
        np.testing.assert_array_equal(store.load_version(version).state["w"], np.full(3, 10 * version - 1))
    with pytest.raises(StoreError, match="got 7, which is not kept"):
        store.load_version(7)


def test_retrains_and_events_stand_where_they_happened(store: Store) -> None:
    whole = everything(store)
    merged = list(interleaved(whole, beside(store)))
    assert [each.time for each in merged] == sorted(each.time for each in merged)
    assert [each for each in merged if isinstance(each, StoredDecision)] == whole
    assert sum(isinstance(each, StoredVersion) for each in merged) == 6
    assert [each.text[:5] for each in merged if isinstance(each, Event)] == ["too m", "fresh"]
    late = beside(store, since=whole[-1].time)
    assert [len(each) for each in late.values()] == [1, 2]
    assert beside(store, until=whole[0].time)["retrains"] == []


def test_a_page_is_read_along_the_index_and_no_trace_is(tmp_path: Path) -> None:
    with SqlStore(str(tmp_path / "engine.db")) as opened, plans(tmp_path / "engine.db") as found:
        for newest in (True, False):
            opened.decisions(HistoryFilter(action=Action.ACCEPT), 50, (5.0, "d1"), newest)
    assert len(found) == 2
    for statement, plan in found:
        assert "trace" not in statement
        assert any("decision USING INDEX decision_time" in step for step in plan), plan
        assert not any("TEMP B-TREE" in step for step in plan), plan
