"""One contract over every store: a correction is a later row, and the newest one of a decision
counts.
"""

import uuid
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dengine.errors import ReportError, StoreError
from dengine.records import Action, Decision, Reason, RetrainReport, Source
from dengine.store import Change, NewLabel, SqlStore
from tests.support.plans import plans
from tests.support.stores import decision, label, put_decision, put_labels, trace


def put(store: SqlStore, name: str, seed: int = 0, content_hash: int = 7) -> None:
    put_decision(store, decision(name), trace(seed), content_hash, False)


def fill(store: SqlStore, n: int = 5) -> None:
    """Decisions "0", "1", ... with the labels True, False, True, ..."""
    for i in range(n):
        put(store, str(i), seed=i, content_hash=100 + i)
        put_labels(store, label(str(i), i % 2 == 0))


def correct(store: SqlStore, success: bool | None, *names: str, author: str = "kim") -> int:
    kind = "forget" if success is None else "correct"
    return store.corrections.apply(
        Change(kind, f"{kind} {', '.join(names)}", {"names": list(names)}, author, names, success)
    )


def test_a_correction_says_who_when_by_which_event_and_after_which_label(store: SqlStore) -> None:
    fill(store, 3)
    store.events.put("note", "before")
    assert correct(store, False, "2", "0", author="kim") == 2
    put(store, "late")
    put_labels(store, label("late"))
    assert correct(store, None, "late", author="") == 3
    result = store.corrections.after()
    assert [
        (c.number, c.decision_id, c.success, c.author, c.event, c.newest_seq, c.seq) for c in result
    ] == [
        (1, "2", False, "kim", 2, 3, 3),
        (2, "0", False, "kim", 2, 3, 1),
        (3, "late", None, "", 3, 4, 4),
    ]
    assert [c.number for c in store.corrections.after(2)] == [3]
    correct(store, False, "late")
    assert [c.was for c in store.corrections.after()] == [True, True, True, None]
    event = store.events.newest()[1]
    assert (event.kind, event.data, event.author) == ("correct", {"names": ["2", "0"]}, "kim")
    assert (store.events.newest()[0].data, store.events.newest()[0].author) == (None, "")


@pytest.mark.parametrize(
    ("name", "text"), [("nobody", "does not hold"), ("open", "report its label")]
)
def test_what_is_unknown_or_has_no_label_is_refused_and_nothing_of_the_change_is_kept(
    store, name: str, text: str
) -> None:
    fill(store, 2)
    put(store, "open")
    store.settings.save({"a": "1"})
    with pytest.raises(ReportError, match=text):
        store.corrections.apply(
            Change("correct", "", decisions=("0", name), success=False, settings={"a": "2"})
        )
    assert (store.events.newest(), store.corrections.after(), store.settings.read()) == (
        [],
        [],
        {"a": "1"},
    )
    assert store.labels.with_traces().labels.tolist() == [1, 0]


def test_an_event_a_version_and_settings_are_kept_together(store: SqlStore) -> None:
    report = RetrainReport(1, 0.0, 2, 0, True, "rolled back")
    store.corrections.apply(
        Change("rollback", "to 1", version=(report, 7, {"w": np.ones(2)}), settings={"b": "2"})
    )
    assert (store.versions.retrains(), store.settings.read(), store.versions.newest().last_seq) == (
        [report],
        {"b": "2"},
        7,
    )


def test_an_events_data_that_json_has_not_is_refused(store: SqlStore) -> None:
    with pytest.raises(StoreError, match="as JSON has it"):
        store.events.put("note", "", {"x": float("nan")})
    assert store.events.newest() == []


def test_outcomes_count_a_label_as_it_was_corrected_and_a_forgotten_one_by_itself(
    store: SqlStore,
) -> None:
    kinds = [
        (Action.ACCEPT, Action.ACCEPT, False),
        (Action.VERIFY, Action.ACCEPT, True),
        (Action.VERIFY, Action.REJECT, True),
    ]
    for i, (action, predicted, audit) in enumerate(kinds * 2):
        created = Decision(
            str(i), action, predicted, 0.9, 1.0, 9, 0, None, i // 3, Reason.CERTAIN, audit, 0.1
        )
        put_decision(store, created, trace(i), i, False)
        put_labels(store, NewLabel(str(i), True, Source.AUDIT, 0, None))
    correct(store, False, "0", "1", "2")
    correct(store, None, "3", "4", "5")
    o = store.decisions.tally().outcomes
    assert (o.accepted, o.false_accepts, o.confirmed, o.forgotten_accepts) == (2, 1, 0, 1)
    assert (o.audited_accepts, o.audited_accepts_bad, o.forgotten_audited_accepts) == (1, 1, 1)
    assert (o.audited_rejects, o.audited_rejects_good, o.forgotten_audited_rejects) == (1, 0, 1)
    later = store.decisions.tally(since_version=1).outcomes
    assert (
        later.accepted,
        later.false_accepts,
        later.forgotten_accepts,
        later.audited_accepts,
    ) == (1, 0, 1, 0)


@settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    changes=st.lists(
        st.tuples(st.integers(0, 5), st.sampled_from([True, False, None])), max_size=12
    )
)
def test_any_corrections_leave_what_plain_python_would(
    store: SqlStore, changes: list[tuple[int, bool | None]]
) -> None:
    run = uuid.uuid4().hex[:8]
    begin = store.decisions.counts()["labels"] + store.decisions.counts()["forgotten"]
    before = len(store.corrections.after())
    for i in range(6):
        put(store, f"{run}-{i}")
        put_labels(store, label(f"{run}-{i}", i % 2 == 0))
    now: dict[int, bool | None] = {i: i % 2 == 0 for i in range(6)}
    for i, success in changes:
        correct(store, success, f"{run}-{i}")
        now[i] = success
    kept = {begin + 1 + i: success for i, success in now.items() if success is not None}
    labelled = store.labels.with_traces(first=begin + 1)
    assert dict(zip(labelled.seq.tolist(), labelled.labels.tolist(), strict=True)) == kept
    assert {item.seq: item.success for item in store.labels.outcomes_since(begin)} == kept
    assert [store.decisions.get(f"{run}-{i}").success for i in range(6)] == list(now.values())
    as_reported = store.labels.with_traces(first=begin + 1, corrected_to=before)
    assert as_reported.labels.tolist() == [1, 0, 1, 0, 1, 0]


def test_corrections_survive_closing_and_belong_to_their_cell(place: tuple[str, str]) -> None:
    with SqlStore(*place) as store:
        fill(store)
        correct(store, None, "0")
    with SqlStore(*place) as store, SqlStore(place[0], uuid.uuid4().hex) as other:
        assert store.labels.with_traces().seq.tolist() == [2, 3, 4, 5]
        assert (other.corrections.after(), other.labels.with_traces().seq.tolist()) == ([], [])


def test_the_newest_labels_are_found_along_indexes_where_there_are_corrections(
    tmp_path: Path,
) -> None:
    with SqlStore(str(tmp_path / "a.db"), "cell") as store:
        fill(store)
        correct(store, None, "0")
        with plans(tmp_path / "a.db") as result:
            store.labels.with_traces(3)
    plan = " | ".join(result[0][1])
    assert "USING INDEX label_training" in plan
    assert "USING INDEX correction_of" in plan or "USING COVERING INDEX correction_of" in plan
    assert "SCAN" not in plan
    assert "TEMP B-TREE" not in plan
