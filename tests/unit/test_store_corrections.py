"""One contract over every store: a correction is a later row, and the newest one of a decision
counts.
"""

import uuid
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dengine.errors import ReportError, StoreError
from dengine.records import Action, Reason, Source
from dengine.store import Change, Outcomes, SqlStore
from tests.support.stores import decision, put_decision, put_label, report


def fill(store: SqlStore, n: int = 5) -> None:
    """Decisions "0", "1", ... with the labels True, False, True, ..."""
    for i in range(n):
        put_decision(store, str(i))
        put_label(store, str(i), i % 2 == 0)


def correct(store: SqlStore, success: bool | None, *names: str, author: str = "kim") -> int:
    kind = "forget" if success is None else "correct"
    change = Change(kind, f"{kind} some", {"names": list(names)}, author, names, success)
    return store.corrections.apply(change)


def test_a_correction_says_who_when_by_which_event_and_after_which_label(store):
    fill(store, 3)
    store.events.put("note", "before")
    assert correct(store, False, "2", "0") == 2
    put_decision(store, "late")
    put_label(store, "late")
    assert correct(store, None, "late", author="") == 3
    result = [
        (c.number, c.decision_id, c.success, c.author, c.event, c.newest_seq, c.seq, c.was)
        for c in store.corrections.after()
    ]
    assert result[:2] == [
        (1, "2", False, "kim", 2, 3, 3, True),
        (2, "0", False, "kim", 2, 3, 1, True),
    ]
    assert result[2:] == [(3, "late", None, "", 3, 4, 4, True)]
    assert [c.number for c in store.corrections.after(2)] == [3]
    correct(store, False, "late")
    assert store.corrections.after()[-1].was is None
    before, event, *_ = store.events.newest()
    assert (event.kind, event.data, event.author) == ("correct", {"names": ["2", "0"]}, "kim")
    assert (before.data, before.author) == (None, "")


@pytest.mark.parametrize(
    ("name", "text"), [("nobody", "does not hold"), ("open", "report its label")]
)
def test_what_is_unknown_or_has_no_label_is_refused_and_nothing_of_the_change_is_kept(
    store, name, text
):
    fill(store, 2)
    put_decision(store, "open")
    store.settings.save({"a": "1"})
    change = Change("correct", "", decisions=("0", name), success=False, settings={"a": "2"})
    with pytest.raises(ReportError, match=text):
        store.corrections.apply(change)
    assert store.events.newest() == store.corrections.after() == []
    assert store.settings.read() == {"a": "1"}
    assert store.labels.with_traces().labels.tolist() == [1, 0]


def test_an_event_a_version_and_settings_are_kept_together(store):
    version = (report(1), 7, {"w": np.ones(2)})
    store.corrections.apply(Change("rollback", "to 1", version=version, settings={"b": "2"}))
    assert (store.versions.retrains(), store.settings.read()) == ([report(1)], {"b": "2"})
    assert (store.versions.newest().last_seq, len(store.events.newest())) == (7, 1)


def test_an_events_data_that_json_has_not_is_refused(store):
    with pytest.raises(StoreError, match="as JSON has it"):
        store.events.put("note", "", {"x": float("nan")})
    assert store.events.newest() == []


def test_outcomes_count_a_label_as_it_was_corrected_and_a_forgotten_one_by_itself(
    store,
):
    kinds = ("accept", "accept"), ("verify", "accept"), ("verify", "reject")
    for i, (action, predicted) in enumerate(kinds * 2):
        made = decision(str(i), Action(action), Reason.CERTAIN, i // 3)
        put_decision(store, replace(made, predicted=Action(predicted), audit=action != predicted))
        put_label(store, str(i), True, Source.AUDIT)
    correct(store, False, "0", "1", "2")
    correct(store, None, "3", "4", "5")
    accepts = Outcomes(2, 1, 0, audited_accepts=1, audited_accepts_bad=1, audited_rejects=1)
    forgotten = ("forgotten_accepts", "forgotten_audited_accepts", "forgotten_audited_rejects")
    assert store.decisions.tally().outcomes == replace(accepts, **dict.fromkeys(forgotten, 1))
    later = Outcomes(1, **dict.fromkeys(forgotten, 1))
    assert store.decisions.tally(since_version=1).outcomes == later


@settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.lists(st.tuples(st.integers(0, 5), st.sampled_from([True, False, None])), max_size=12))
def test_any_corrections_leave_what_plain_python_would(store, changes):
    counts, before = store.decisions.counts(), len(store.corrections.after())
    begin, now = counts["labels"] + counts["forgotten"], {i: i % 2 == 0 for i in range(6)}
    names = [uuid.uuid4().hex for _ in now]
    for name, success in zip(names, now.values(), strict=True):
        put_decision(store, name)
        put_label(store, name, success)
    for i, success in changes:
        correct(store, success, names[i])
        now[i] = success
    kept = {begin + 1 + i: success for i, success in now.items() if success is not None}
    labelled = store.labels.with_traces(first=begin + 1)
    assert dict(zip(labelled.seq.tolist(), labelled.labels.tolist(), strict=True)) == kept
    assert {item.seq: item.success for item in store.labels.outcomes_since(begin)} == kept
    assert [store.decisions.get(name).success for name in names] == list(now.values())
    as_reported = store.labels.with_traces(first=begin + 1, corrected_to=before)
    assert as_reported.labels.tolist() == [1, 0, 1, 0, 1, 0]


def test_corrections_survive_closing_and_belong_to_their_cell(place):
    with SqlStore(*place) as store:
        fill(store)
        correct(store, None, "0")
    with SqlStore(*place) as store, SqlStore(place[0], uuid.uuid4().hex) as other:
        assert store.labels.with_traces().seq.tolist() == [2, 3, 4, 5]
        assert (other.corrections.after(), other.labels.with_traces().seq.tolist()) == ([], [])
