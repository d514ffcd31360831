"""Looking back: pages, filters and counts of a store, in memory, in SQLite and in PostgreSQL."""

from collections import Counter
from dataclasses import astuple
from itertools import count
from pathlib import Path

import numpy as np
import pytest

import dengine.history
from dengine import SqlStore
from dengine.history.status import history
from dengine.records import Action, Decision, Reason, RetrainReport, Source
from dengine.store.records import StoredDecision
from dengine.store.views import HistoryFilter, Stretch
from tests.support.plans import plans
from tests.support.stores import put_decision, put_label

KINDS = (  # action, predicted, reason, audit
    (Action.VERIFY, Action.VERIFY, Reason.UNCERTAIN, False),
    (Action.VERIFY, Action.VERIFY, Reason.NOVEL, False),
    (Action.VERIFY, Action.ACCEPT, Reason.AUDIT, True),
    (Action.VERIFY, Action.REJECT, Reason.AUDIT, True),
    (Action.ACCEPT, Action.ACCEPT, Reason.CERTAIN, False),
    (Action.REJECT, Action.REJECT, Reason.CERTAIN, False),
    (Action.REJECT, Action.VERIFY, Reason.OUTSIDE, False),
    (Action.VERIFY, Action.VERIFY, Reason.OUTSIDE, False),
)
KIND = ("action", "predicted", "reason", "audit")
N = 60


@pytest.fixture
def store(store: SqlStore) -> SqlStore:
    """60 decisions of all kinds, three of each moment; half of them labelled; a retrain after each
    tenth; two events.
    """
    seconds = count(1000)
    # Each record asks twice: for itself, and for the ledger.
    store.clock = store.database.clock = lambda: float(next(seconds) // 6)
    rng = np.random.default_rng(0)
    for i in range(N):
        action, predicted, reason, audit = KINDS[int(rng.integers(len(KINDS)))]
        decision = Decision(
            f"d{i:03d}",
            action,
            predicted,
            0.2,
            0.9,
            i,
            1,
            ((0.1, 0.2),),
            i // 10,
            reason,
            audit,
            0.1,
            f"LOT/{i // 5}-{i}",
        )
        put_decision(store, decision, np.full((1, 5), i, np.float32), i, quarantined=i % 13 == 5)
        if action is not Action.REJECT and rng.random() < 0.6:
            source = (
                Source.STOP
                if action is Action.ACCEPT
                else Source.AUDIT
                if audit
                else Source.VERIFICATION
            )
            put_label(
                store,
                decision.id,
                action is not Action.ACCEPT and i % 3 > 0,
                source,
                i // 10,
                np.ones(2, np.float32),
            )
        if i % 10 == 9:
            store.versions.put(
                RetrainReport(i // 10 + 1, 0.1, i, 3, True, "accepted"),
                i // 2,
                {"w": np.full(3, i)},
            )
    store.events.put("safe mode", "too many traces were novel")
    store.events.put("safe mode ended", "fresh evidence keeps the tolerance")
    return store


def everything(store: SqlStore) -> list[StoredDecision]:
    return list(history(store))


def test_all_of_a_history_comes_once_and_in_order_whatever_the_page(
    store: SqlStore, monkeypatch
) -> None:
    whole = everything(store)
    assert [past.decision.id for past in whole] == [f"d{i:03d}" for i in range(N)]
    monkeypatch.setattr(dengine.history.status, "PAGE_SIZE", 7)
    assert everything(store) == whole
    for last in (1, 7, 8, 59, 60, 1000):
        assert list(history(store, last=last)) == whole[-last:]


def test_a_clock_that_is_set_back_changes_no_order(place, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    store, kind = (
        SqlStore(*place, clock=lambda: now[0]),
        (0.9, 1.0, 40, 0, ((0.1, 0.2),), 0, Reason.CERTAIN, False, 1.0),
    )
    times, ids = [5.0, 9.0, 2.0, 2.0, 1.0, 7.0], ["d5", "d1", "d4", "d0", "d3", "d2"]
    for now[0], id_ in zip(times, ids, strict=True):
        put_decision(store, Decision(id_, Action.ACCEPT, Action.ACCEPT, *kind), np.ones(5))
    monkeypatch.setattr(dengine.history.status, "PAGE_SIZE", 2)
    for result in (history(store), history(store, last=6)):
        assert [(past.decision.id, past.time) for past in result] == list(
            zip(ids, times, strict=True)
        )
    assert [past.decision.id for past in history(store, last=2, since=2.0)] == ["d0", "d2"]
    assert (
        store.decisions.unreported_accepts(),
        store.decisions.tally(2).count(),
        store.decisions.tally(2).last,
    ) == (
        ids,
        2,
        7.0,
    )
    store.close()


def test_a_filter_takes_what_it_says_and_the_newest_of_that(
    store: SqlStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dengine.history.status, "PAGE_SIZE", 4)
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
            lambda past: (
                (past.decision.action, past.label) == (Action.VERIFY, "bad") and past.time >= middle
            ),
        ),
    ):
        expected = [past for past in whole if takes(past)]
        assert expected, asked
        assert list(history(store, **asked)) == expected
        assert list(history(store, last=3, **asked)) == expected[-3:]


def test_counts_of_a_store_are_those_of_its_history(store: SqlStore) -> None:
    whole = everything(store)
    for last in (None, 1, 10, 59, 500):
        some = whole if last is None else whole[-last:]
        result = store.decisions.tally(last)
        kinds = Counter(
            (
                *(getattr(p.decision, name) for name in KIND),
                p.quarantined,
                False,
                p.success,
                p.source,
            )
            for p in some
        )
        assert {astuple(group) for group in result.groups} == {
            (*kind, n) for kind, n in kinds.items()
        }
        assert (result.first, result.last) == (some[0].time, some[-1].time)


def counted(some: list[StoredDecision]) -> Stretch:
    actions = [past.decision.action for past in some]
    bad = sum(past.success is False and past.decision.action is Action.ACCEPT for past in some)
    novel, outside = (
        sum(past.decision.reason is item for past in some)
        for item in (Reason.NOVEL, Reason.OUTSIDE)
    )
    total = sum(
        (past.decision.action, past.decision.reason) == (Action.REJECT, Reason.CERTAIN)
        for past in some
    )
    verified, accepted = (actions.count(item) for item in (Action.VERIFY, Action.ACCEPT))
    return Stretch(len(some), some[-1].time, verified, novel, accepted, bad, total, outside)


@pytest.mark.parametrize("n", [1, 7, 60, 500])
def test_stretches_are_consecutive_and_hold_everything(store: SqlStore, n: int) -> None:
    whole = everything(store)
    length = max(1, -(-N // n))
    expected = [counted(whole[start : start + length]) for start in range(0, N, length)]
    assert store.decisions.stretches(n) == expected
    shifts = [[item for item in whole if item.time // (10.0 * n) == k] for k in range(N)]
    assert store.decisions.stretches(seconds=10.0 * n) == [counted(item) for item in shifts if item]


def test_an_empty_store_has_no_past() -> None:
    empty = SqlStore()
    assert (
        everything(empty)
        == list(history(empty, last=5))
        == empty.decisions.stretches(10)
        == empty.labels.past(0)
        == []
    )
    assert (empty.decisions.tally().count(), empty.decisions.tally().first) == (0, None)


def test_labels_come_along_their_numbers_with_what_the_rule_was_told(store: SqlStore) -> None:
    every = store.labels.past(0)
    assert [label.seq for label in every] == list(range(1, len(every) + 1))
    assert [label.seq for label in store.labels.past(3, 7)] == [4, 5, 6, 7]
    assert all(label.point == pytest.approx(np.ones(2)) for label in every)
    expected = store.labels.outcomes_since(0)
    answers = [label for label in every if not label.quarantined]
    assert [(label.seq, label.novel) for label in answers] == [
        (item.seq, item.novel) for item in expected
    ]
    by_id = {past.decision.id: past for past in everything(store)}
    assert all(label.decided == by_id[label.decision_id].time for label in every)


def test_a_page_is_read_along_the_index_and_no_trace_is(tmp_path: Path) -> None:
    with SqlStore(str(tmp_path / "engine.db")) as opened, plans(tmp_path / "engine.db") as result:
        for newest in (True, False):
            opened.decisions.select(HistoryFilter(action=Action.ACCEPT), 50, "d1", newest)
    assert len(result) == 2
    for statement, plan in result:
        assert "trace" not in statement
        assert any("decision USING INDEX decision_number" in step for step in plan), plan
        assert not any("TEMP B-TREE" in step for step in plan), plan
