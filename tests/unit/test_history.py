"""Looking back: pages, filters and counts of a store, in memory, in SQLite and in PostgreSQL."""

from collections import Counter
from dataclasses import astuple, replace
from itertools import count

import numpy as np
import pytest

import dengine.history
from dengine import SqlStore
from dengine.history.status import history
from dengine.records import Action, Reason, Source
from dengine.store.records import StoredDecision
from dengine.store.views import Stretch
from tests.support.stores import decision, put_decision, put_label, report

N = 60


KINDS = """
verify verify uncertain 0
verify verify novel     0
verify accept audit     1
verify reject audit     1
accept accept certain   0
reject reject certain   0
reject verify outside   0
verify verify outside   0
"""  # action, predicted, reason, audit
KIND = ("action", "predicted", "reason", "audit")


@pytest.fixture
def store(store):
    """60 decisions of all kinds, three of each moment; half of them labelled; a retrain after each
    tenth.
    """
    seconds = count(1000)
    # Each record asks twice: for itself, and for the ledger.
    store.clock = store.database.clock = lambda: float(next(seconds) // 6)
    rng, kinds = np.random.default_rng(0), KINDS.strip().splitlines()
    for i in range(N):
        action, predicted, reason, audit = kinds[rng.integers(len(kinds))].split()
        made = decision(f"d{i:03d}", Action(action), Reason(reason), i // 10)
        made = replace(made, predicted=Action(predicted), audit=audit == "1", part=f"LOT/{i}")
        put_decision(store, made, np.full((1, 5), i), i, quarantined=i % 13 == 5)
        if action != "reject" and rng.random() < 0.6:
            good = action != "accept" and i % 3 > 0
            source = Source.STOP if action == "accept" else Source.VERIFICATION
            put_label(store, made.id, good, source, i // 10, np.ones(2, np.float32))
        if i % 10 == 9:
            store.versions.put(report(i // 10 + 1), i // 2, {"w": np.full(3, i)})
    return store


def everything(store: SqlStore) -> list[StoredDecision]:
    return list(history(store))


def test_all_of_a_history_comes_once_and_in_order_whatever_the_page(store, monkeypatch):
    whole = everything(store)
    assert [past.decision.id for past in whole] == [f"d{i:03d}" for i in range(N)]
    monkeypatch.setattr(dengine.history.status, "PAGE_SIZE", 7)
    assert everything(store) == whole
    for last in (1, 7, 8, 59, 60, 1000):
        assert list(history(store, last=last)) == whole[-last:]


def test_a_clock_that_is_set_back_changes_no_order(place, monkeypatch):
    now = [0.0]
    times, ids = [5.0, 9.0, 2.0, 2.0, 1.0, 7.0], ["d5", "d1", "d4", "d0", "d3", "d2"]
    monkeypatch.setattr(dengine.history.status, "PAGE_SIZE", 2)
    with SqlStore(*place, clock=lambda: now[0]) as store:
        for now[0], name in zip(times, ids, strict=True):
            put_decision(store, decision(name, Action.ACCEPT, Reason.CERTAIN))
        for result in (history(store), history(store, last=6)):
            order = [(past.decision.id, past.time) for past in result]
            assert order == list(zip(ids, times, strict=True))
        assert [past.decision.id for past in history(store, last=2, since=2.0)] == ["d0", "d2"]
        newest = store.decisions.tally(2)
        assert (newest.count(), newest.last) == (2, 7.0)


def test_a_filter_takes_what_it_says_and_the_newest_of_that(store, monkeypatch):
    monkeypatch.setattr(dengine.history.status, "PAGE_SIZE", 4)
    whole = everything(store)
    middle = whole[N // 2].time
    for asked in (
        {"action": "accept"},
        {"reason": "novel"},
        {"label": "good"},
        {"label": "none"},
        {"since": middle},
        {"until": middle},
        {"action": "verify", "label": "bad", "since": middle},
    ):
        expected = [
            past
            for past in whole
            if asked.get("since", 0) <= past.time < asked.get("until", np.inf)
            and asked.get("label", past.label) == past.label
            and asked.get("action", past.decision.action) == past.decision.action
            and asked.get("reason", past.decision.reason) == past.decision.reason
        ]
        assert expected, asked
        assert list(history(store, **asked)) == expected
        assert list(history(store, last=3, **asked)) == expected[-3:]


def test_counts_of_a_store_are_those_of_its_history(store):
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
        assert {astuple(group)[:-1]: group.n for group in result.groups} == kinds
        assert (result.first, result.last) == (some[0].time, some[-1].time)
    n = store.decisions.counts()
    assert n["actions"] == Counter(past.decision.action for past in whole)
    assert n["sources"] | {None: N - n["labels"]} == {
        source: [past.source for past in whole].count(source) for source in (*Source, None)
    }
    assert {name: times for name, times in n["reasons"].items() if times} == Counter(
        past.decision.reason for past in whole
    )
    assert (n["decisions"], n["quarantined"]) == (N, sum(past.quarantined for past in whole))


def counted(some: list[StoredDecision]) -> Stretch:
    actions = Counter(past.decision.action for past in some)
    reasons = Counter((past.decision.action, past.decision.reason) for past in some)
    bad = sum(past.success is False for past in some if past.decision.action is Action.ACCEPT)
    novel, certain = reasons["verify", "novel"], reasons["reject", "certain"]
    outside = reasons["verify", "outside"] + reasons["reject", "outside"]
    counts = actions["verify"], novel, actions["accept"], bad, certain, outside
    return Stretch(len(some), some[-1].time, *counts)


def test_stretches_are_consecutive_and_hold_everything(store):
    whole = everything(store)
    for n in (1, 7, 60, 500):
        length = max(1, -(-N // n))
        expected = [counted(whole[start : start + length]) for start in range(0, N, length)]
        assert store.decisions.stretches(n) == expected
        shifts = [[item for item in whole if item.time // (10.0 * n) == k] for k in range(N)]
        shifts = [counted(items) for items in shifts if items]
        assert store.decisions.stretches(seconds=10.0 * n) == shifts
