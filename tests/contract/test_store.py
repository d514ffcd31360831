"""One contract over every store: in memory, SQLite in a file, PostgreSQL where
DENGINE_TEST_POSTGRES names one.
"""

import hashlib
import sqlite3
import uuid
import zipfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from dengine.errors import StoreError
from dengine.records import Action, Decision, Reason, Source
from dengine.store import Event, NewLabel, Outcomes, SqlStore, StoredDecision, verify_history
from tests.support.plans import plans
from tests.support.stores import (
    decision,
    execute,
    label,
    labelled,
    put_decision,
    put_label,
    put_labels,
    report,
    trace,
)


def put(
    store: SqlStore, name: str, seed: int = 0, content_hash: int = 7, quarantined: bool = False
) -> np.ndarray:
    values = trace(seed)
    put_decision(store, decision(name), values, content_hash, quarantined)
    return values


def test_a_decision_is_found_as_it_was_put(store: SqlStore) -> None:
    assert store.decisions.get("a") is None
    values = trace()
    given = Decision(
        "a",
        Action.VERIFY,
        Action.ACCEPT,
        0.9,
        1.0,
        40,
        0,
        None,
        3,
        Reason.AUDIT,
        True,
        0.02,
        "Stück 7\\0",
    )
    put_decision(store, given, values, -(2**63), False)
    put_decision(store, decision("flat"), values[0], 1, False)
    result = store.decisions.get("a")
    assert (result.decision, result.content_hash, result.quarantined) == (given, -(2**63), False)
    assert (result.success, result.source) == (None, None)
    np.testing.assert_array_equal(result.trace, values)
    assert store.decisions.get("flat").trace.shape == (1, 30)


@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    values=hnp.arrays(
        np.float32, st.tuples(st.integers(1, 3), st.integers(1, 40)), elements=st.floats(width=32)
    ),
    content_hash=st.integers(-(2**63), 2**63 - 1),
    quarantined=st.booleans(),
)
def test_any_trace_returns_bit_for_bit(
    store: SqlStore, values: np.ndarray, content_hash: int, quarantined: bool
) -> None:
    name = uuid.uuid4().hex
    put_decision(store, decision(name), values, content_hash, quarantined)
    store.flush()
    result = store.decisions.get(name)
    assert result.trace.tobytes() == values.tobytes()
    assert result.trace.shape == values.shape
    assert (result.content_hash, result.quarantined) == (content_hash, quarantined)


def test_labels_in_one_batch_are_numbered_in_the_order_given(store: SqlStore) -> None:
    for name in "abcd":
        put(store, name)
    assert put_label(store, "d", True, Source.VERIFICATION, 0, None) == 1
    point = np.array([0.5, 1.5], dtype=np.float32)
    batch = [NewLabel("c", False, Source.STOP, 3, point, 4), label("a"), label("b", False)]
    assert put_labels(store, *batch) == [2, 3, 4]
    assert store.labels.with_traces().labels.tolist() == [1, 0, 1, 0]
    assert (store.decisions.get("c").success, store.decisions.get("c").source) == (
        False,
        Source.STOP,
    )
    (added,) = (past_label for past_label in store.labels.past(0) if past_label.point is not None)
    assert (added.seq, added.model_version, added.point.tolist()) == (2, 3, [0.5, 1.5])


def test_a_batch_longer_than_a_chunk_is_taken_whole(store: SqlStore) -> None:
    names = [str(i) for i in range(503)]
    store.apply_records(
        [
            StoredDecision(decision(name), np.zeros((1, 2), np.float32), int(name), False, 1.0)
            for name in names
        ]
    )
    assert put_labels(store, *(label(name, silent=1) for name in names)) == list(range(1, 504))
    assert store.labels.with_traces().hashes.tolist() == list(range(503))
    assert store.labels.unreported_total() == 503


def test_labelled_are_the_newest_in_label_order_without_the_quarantined(store: SqlStore) -> None:
    traces = {
        name: put(store, name, seed, 100 + seed, name == "c") for seed, name in enumerate("abcde")
    }
    for name in "ecbad":
        put_label(store, name, name != "b", Source.VERIFICATION, 0, None)
    every = store.labels.with_traces()
    assert every.seq.tolist() == [1, 3, 4, 5]
    assert every.labels.tolist() == [1, 0, 1, 1]
    assert every.hashes.tolist() == [104, 101, 100, 103]
    np.testing.assert_array_equal(every.traces, np.stack([traces[name] for name in "ebad"]))
    assert len(store.labels.with_traces(0).seq) == 0
    newest = store.labels.with_traces(2)
    assert newest.seq.tolist() == [4, 5]
    np.testing.assert_array_equal(newest.traces, every.traces[2:])
    assert [a.dtype for a in (every.seq, every.traces, every.labels, every.hashes)] == [
        "i8",
        "f4",
        "i1",
        "i8",
    ]


@pytest.mark.parametrize("limit", [None, 0, 5])
def test_an_empty_store_has_empty_arrays(store: SqlStore, limit: int | None) -> None:
    result = store.labels.with_traces(limit)
    assert (result.seq.shape, result.traces.shape) == ((0,), (0, 0, 0))
    assert (store.versions.newest(), store.versions.retrains()) == (None, [])
    assert (
        store.decisions.unreported_accepts(),
        store.labels.unreported_total(),
        store.decisions.tally().outcomes,
    ) == (
        [],
        0,
        Outcomes(),
    )


def test_traces_of_two_shapes_are_an_error_that_names_both(store: SqlStore) -> None:
    for name, samples in (("a", 10), ("b", 20)):
        put_decision(store, decision(name), trace(0, (1, samples)), 1, False)
        put_label(store, name, True, Source.VERIFICATION, 0, None)
    with pytest.raises(StoreError, match=r"\(1, 10\), \(1, 20\)"):
        store.labels.with_traces()
    assert store.labels.with_traces(1).traces.shape == (1, 1, 20)


def test_what_is_imported_is_labelled_and_numbered_after_what_was_there(store: SqlStore) -> None:
    put(store, "a")
    put_label(store, "a", True, Source.VERIFICATION, 0, None)
    traces, hashes, labels = trace(1, (3, 2, 30)), [5, -5, 6], [1, 0, 1]
    decisions = [
        replace(decision(name), part=part)
        for name, part in zip("bcd", ["x", None, "z"], strict=True)
    ]
    for created, x, hash_, good in zip(decisions, traces, hashes, labels, strict=True):
        assert (
            len(store.apply_records(labelled(StoredDecision(created, x, hash_, False, 1.0), good)))
            == 1
        )
    assert [store.decisions.get(name).decision for name in "bcd"] == decisions
    result = store.labels.with_traces(3)
    np.testing.assert_array_equal(result.traces, traces)
    assert (result.seq.tolist(), result.hashes.tolist(), result.labels.tolist()) == (
        [2, 3, 4],
        hashes,
        labels,
    )


def test_evidence_is_what_each_decision_was_made_by_and_its_label_without_the_quarantined(
    store: SqlStore,
) -> None:
    for i, quarantined in enumerate([False, True, False, False]):
        created = decision(str(i), reason=Reason.NOVEL if i == 3 else Reason.CERTAIN)
        put_decision(
            store, replace(created, lower=0.1 * i, upper=0.2 * i), trace(i), i, quarantined
        )
        put_label(store, str(i), i % 2 == 0, Source.VERIFICATION, 1, None, silent=i)
    result = store.labels.outcomes_since(1)
    assert result == [
        (3, 0.2, 0.4, True, False, 2, 0, 1.0),
        (4, 0.1 * 3, 0.2 * 3, False, True, 3, 0, 1.0),
    ]
    assert [type(item) for item in result[0]] == [
        int,
        float,
        float,
        bool,
        bool,
        int,
        int,
        float,
    ]  # for compiled code
    assert store.labels.unreported_total() == 0 + 2 + 3
    assert store.labels.outcomes_since(4) == []


def test_unreported_accepts_are_those_without_a_label_oldest_first_whatever_the_clock_said(
    store: SqlStore,
) -> None:
    names = ["zoe", "amy", "kim", "eve", "bob", "ann"]  # neither sorted, nor by hash
    store.clock = iter([5.0, 5.0, 5.0, 2.0, 2.0, 1.0, *range(8, 20)]).__next__
    for name in names:
        put_decision(
            store, decision(name, Action.ACCEPT, Reason.CERTAIN), trace(), 1, name == "eve"
        )
    put_decision(store, decision("verified"), trace(), 1, False)
    put_decision(store, decision("rejected", Action.REJECT, Reason.CERTAIN), trace(), 1, False)
    assert store.decisions.unreported_accepts() == ["zoe", "amy", "kim", "bob", "ann"]
    put_labels(
        store, label("bob", False, source=Source.STOP), label("zoe", source=Source.CONFIRMED)
    )
    assert store.decisions.unreported_accepts() == ["amy", "kim", "ann"]
    assert sorted(name for some in store.decisions.ids() for name in some) == sorted(
        [*names, "verified", "rejected"]
    )


def test_outcomes_count_what_became_of_what_was_certain(store: SqlStore) -> None:
    for i, (action, predicted, success) in enumerate(
        [
            (Action.ACCEPT, Action.ACCEPT, success)
            for success in (None, None, None, False, False, True)
        ]
        + [(Action.REJECT, Action.REJECT, None)] * 2
        + [(Action.VERIFY, Action.ACCEPT, success) for success in (True, True, False, None)]
        + [(Action.VERIFY, Action.REJECT, success) for success in (True, True, True, False, None)]
        + [(Action.VERIFY, Action.VERIFY, success) for success in (True, False, None)]
    ):
        audit = action != predicted
        put_decision(
            store,
            replace(decision(str(i), action), predicted=predicted, audit=audit),
            trace(),
            i,
            False,
        )
        if success is not None:
            put_label(store, str(i), success, Source.AUDIT, 0, None)
    assert store.decisions.tally().outcomes == Outcomes(
        accepted=6,
        false_accepts=2,
        confirmed=1,
        audited_accepts=3,
        audited_accepts_bad=1,
        rejected=2,
        audited_rejects=4,
        audited_rejects_good=3,
    )


def test_events_are_numbered_from_one_and_returned_oldest_first(store: SqlStore) -> None:
    store.database.clock = iter([1.5, 1.5, 2.5, 2.5, 3.5, 3.5]).__next__  # the ledger asks, too
    for kind in ("started", "safe_mode", "left"):
        store.events.put(kind, f"was {kind}: ±")
    every = store.events.newest()
    assert every[1] == Event(2, 2.5, "safe_mode", "was safe_mode: ±")
    assert [event.number for event in every] == [1, 2, 3]
    assert store.events.newest(2) == every[1:]
    assert (store.events.newest(0), store.events.newest(9)) == ([], every)


def test_an_event_writes_what_every_database_refuses_with_escapes(store: SqlStore) -> None:
    store.events.put(Reason.MODEL_ERROR, "read \0 and \ud800")
    (event,) = store.events.newest()
    assert (event.kind, event.text) == ("model_error", "read \\0 and \\ud800")
    assert type(event.kind) is str


def test_the_newest_accepted_version_returns_bit_for_bit(store: SqlStore) -> None:
    state = {
        "encoder.stem.weight": trace(3, (4, 1, 5)),
        "references/0": np.asfortranarray(trace(4, (6, 2))),
        "labels": np.array([1, 0], dtype=np.int8),
        "ids": np.array(["a", "bc"]),
        "file": np.array(2.5),
        "empty": np.zeros((0, 3), dtype=np.float32),
    }
    store.versions.put(report(1), 10, {"w": np.zeros(2)})
    store.versions.put(report(2), 20, state)
    store.versions.put(report(2, accepted=False), 30, None)
    last = store.versions.newest()
    assert (last.version, last.last_seq, last.state.keys()) == (2, 20, state.keys())
    for name, values in state.items():
        assert last.state[name].dtype == values.dtype
        np.testing.assert_array_equal(last.state[name], values)
    assert store.versions.retrains() == [report(1), report(2), report(2, accepted=False)]


@pytest.mark.parametrize(
    ("state", "named"), [({"w": np.array([{}], dtype=object)}, "'w'"), (None, "version 1")]
)
def test_an_accepted_version_needs_a_state_of_plain_arrays(
    store: SqlStore, state: dict | None, named: str
) -> None:
    with pytest.raises(StoreError, match=named):
        store.versions.put(report(1), 0, state)


def test_settings_are_replaced_as_a_whole(store: SqlStore) -> None:
    assert store.settings.read() == {}
    store.settings.save({"recipe": "a = 1\n", "spec": "é"})
    store.settings.save({"recipe": "a = 2"})
    assert store.settings.read() == {"recipe": "a = 2"}


def test_status_counts_what_was_put(store: SqlStore) -> None:
    put_decision(store, decision("a", Action.ACCEPT, Reason.CERTAIN), trace(), 1, False)
    put_decision(store, decision("b"), trace(), 2, False)
    put_decision(store, decision("c", Action.VERIFY, Reason.CONSTANT), trace(), 3, True)
    put_label(store, "a", False, Source.STOP, 0, None)
    put_label(store, "c", True, Source.VERIFICATION, 0, None)
    status = store.decisions.counts()
    assert (status["decisions"], status["labels"], status["quarantined"]) == (3, 2, 1)
    assert status["actions"] == {"verify": 2, "accept": 1, "reject": 0}
    assert (
        status["reasons"]["certain"],
        status["reasons"]["constant"],
        status["reasons"]["audit"],
    ) == (1, 1, 0)
    assert status["sources"] == {
        "verification": 1,
        "audit": 0,
        "stop": 1,
        "confirmed": 0,
        "inspection": 0,
    }
    assert (
        store.decisions.tally().first
        <= store.decisions.tally().last
        <= store.decisions.tally().last_label
    )


def test_everything_is_there_after_opening_again(place: tuple[str, str]) -> None:
    with SqlStore(*place) as store:
        values = put(store, "a")
        store.settings.save({"k": "v"})
        put_label(store, "a", True, Source.VERIFICATION, 1, np.array([0.5], dtype=np.float32))
        store.versions.put(report(1), 1, {"w": values})
        put_decision(
            store, replace(decision("accepted", Action.ACCEPT), part="SN-1"), trace(), 1, False
        )
        put_decision(store, decision("silent"), trace(), 1, False)
        put_label(store, "silent", True, Source.VERIFICATION, 0, None, silent=4)
        store.events.put("started", "for the first time")
        put(store, "unreported")
    with SqlStore(*place) as store:
        assert store.settings.read() == {"k": "v"}
        np.testing.assert_array_equal(store.decisions.get("a").trace, values)
        np.testing.assert_array_equal(store.versions.newest().state["w"], values)
        assert store.labels.past(0, 1)[0].point.tolist() == [0.5]
        assert store.decisions.get("unreported") is not None
        assert (
            store.decisions.unreported_accepts(),
            store.labels.unreported_total(),
            store.decisions.tally().outcomes.accepted,
        ) == (["accepted"], 4, 1)
        assert store.decisions.get("accepted").decision.part == "SN-1"
        assert [event.text for event in store.events.newest()] == ["for the first time"]
        store.events.put("started", "again")
        assert [event.number for event in store.events.newest()] == [1, 2]
        assert put_label(store, "unreported", True, Source.VERIFICATION, 0, None) == 3


def test_two_cells_in_one_database_do_not_see_each_other(place: tuple[str, str]) -> None:
    url, cell_id = place
    with SqlStore(url, cell_id) as ours, SqlStore(url, cell_id + "-other") as other:
        put(ours, "a", seed=1)
        put(other, "a", seed=2)
        assert put_label(ours, "a", True, Source.VERIFICATION, 1, np.zeros(2, np.float32)) == 1
        assert put_label(other, "a", False, Source.STOP, 1, np.ones(2, np.float32)) == 1
        ours.versions.put(report(1), 1, {"w": np.zeros(1)})
        ours.settings.save({"k": "v"})
        ours.events.put("note", "ours")
        put_decision(ours, decision("b", Action.ACCEPT), trace(), 1, False)
        put_decision(ours, decision("c"), trace(), 1, False)
        put_label(ours, "c", True, Source.VERIFICATION, 0, None, silent=3)
        assert (
            other.events.newest(),
            other.decisions.unreported_accepts(),
            other.labels.unreported_total(),
        ) == ([], [], 0)
        assert other.decisions.tally().outcomes.accepted == 0
        other.events.put("note", "other's")
        assert [(event.number, event.text) for event in other.events.newest()] == [(1, "other's")]
        assert (other.settings.read(), other.versions.newest(), other.versions.retrains()) == (
            {},
            None,
            [],
        )
        assert other.labels.with_traces().labels.tolist() == [0]
        assert [past_label.point.tolist() for past_label in other.labels.past(0)] == [[1.0, 1.0]]
        assert other.decisions.counts()["labels"] == 1
        np.testing.assert_array_equal(other.decisions.get("a").trace, trace(2))


def test_numbers_stay_unique_with_two_stores_on_one_cell_and_each_sees_what_the_other_committed(
    place,
) -> None:
    seqs: list[int] = []

    def label(store: SqlStore, prefix: str) -> None:
        for i in range(15):
            put(store, f"{prefix}{i}")
            seqs.append(put_label(store, f"{prefix}{i}", True, Source.VERIFICATION, 0, None))
            store.events.put("note", f"{prefix}{i}")

    with SqlStore(*place) as first, SqlStore(*place) as two:
        with ThreadPoolExecutor(2) as pool:
            list(pool.map(label, (first, two), "xy"))
        assert sorted(seqs) == list(range(1, 31))
        assert first.labels.with_traces().seq.tolist() == list(range(1, 31))
        assert [event.number for event in two.events.newest()] == list(range(1, 31))
        read: list[int] = []
        result = verify_history(*place, on_rows=read.append)
        assert (result.ok, result.cells[0].rows) == (True, 120)  # one chain
        assert sum(read) == 120


def test_a_closed_store_says_so_and_closes_twice(place: tuple[str, str]) -> None:
    store = SqlStore(*place)
    store.close()
    store.close()
    for call in (lambda: put(store, "a"), store.settings.read, store.flush):
        with pytest.raises(StoreError, match="after close"):
            call()


def test_reads_of_labels_use_an_index(tmp_path: Path) -> None:
    with SqlStore(str(tmp_path / "a.db")) as store:
        put(store, "a")
        put_label(store, "a", True, Source.VERIFICATION, 0, None)
        with plans(tmp_path / "a.db") as result:
            store.labels.with_traces(100)
            store.decisions.get("a")
            store.labels.outcomes_since(0)
            store.labels.unreported_total()
            store.events.newest(5)
            put_label(store, "a", True, Source.VERIFICATION, 0, None)
    assert len(result) >= 7
    for statement, plan in result:
        assert plan
        assert not [step for step in plan if "SCAN" in step or "TEMP B-TREE" in step], (
            statement,
            plan,
        )


def test_sqlite_syncs_every_commit_in_wal_mode(tmp_path: Path) -> None:
    asked: list[tuple[object, ...]] = []

    def ask(connection: object, *_: object) -> None:
        asked.append(
            tuple(
                connection.execute(f"PRAGMA {name}").fetchone()[0]
                for name in ("journal_mode", "synchronous")
            )
        )

    sa.event.listen(sa.pool.Pool, "checkout", ask)
    try:
        with SqlStore(str(tmp_path / "a.db")) as store:
            put(store, "a")
    finally:
        sa.event.remove(sa.pool.Pool, "checkout", ask)
    assert asked
    assert set(asked) == {("wal", 2)}


def test_a_newer_schema_is_refused_and_both_are_named(tmp_path: Path) -> None:
    file = tmp_path / "a.db"
    SqlStore(str(file)).close()
    with sqlite3.connect(file) as connection:
        connection.execute("UPDATE setting SET value = '99' WHERE key = 'schema_version'")
    connection.close()  # and the last one to close empties the journal into the file
    before = file.read_bytes()
    with pytest.raises(StoreError, match="schema 1 with all its columns, found schema 99"):
        SqlStore(str(file), "another cell")
    assert file.read_bytes() == before


def test_a_store_that_lacks_a_column_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.db"
    SqlStore(str(file)).close()
    execute(file, "ALTER TABLE label DROP COLUMN silent")
    with pytest.raises(StoreError, match="open it with the dengine that wrote it"):
        SqlStore(str(file))


@pytest.mark.parametrize("table", ["trials (id)", "setting (name)", "label (id)"])
def test_another_programs_database_is_refused_and_left_alone(tmp_path: Path, table: str) -> None:
    file = tmp_path / "a.db"
    execute(file, f"CREATE TABLE {table}")
    before = file.read_bytes()
    with pytest.raises(StoreError, match="schema 1 with all its columns, found other tables"):
        SqlStore(str(file))
    assert file.read_bytes() == before
    assert list(tmp_path.iterdir()) == [file]


def test_a_file_that_is_no_database_is_refused_and_left_alone(tmp_path: Path) -> None:
    file = tmp_path / "notes.txt"
    file.write_text("not a database\n" * 100)
    with pytest.raises(StoreError, match="name a new file"):
        SqlStore(str(file))
    assert file.read_text() == "not a database\n" * 100


@pytest.mark.parametrize("name", ["missing/engine.db", "."])
def test_a_place_that_cannot_be_written_says_what_to_do(tmp_path: Path, name: str) -> None:
    with pytest.raises(StoreError, match="Create the directory"):
        SqlStore(str(tmp_path / name))


def test_a_pickle_in_the_database_is_never_loaded(tmp_path: Path) -> None:
    file = tmp_path / "a.db"
    with SqlStore(str(file)) as store:
        store.versions.put(report(1), 0, {"w": np.zeros(1)})
    evil = tmp_path / "evil.npz"
    np.savez(evil, w=np.array([{}], dtype=object))
    assert zipfile.is_zipfile(evil)
    with sqlite3.connect(file) as connection:
        sum_ = hashlib.sha256(evil.read_bytes()).digest()
        connection.execute(
            "UPDATE model_version SET state = ?, state_sum = ?", (evil.read_bytes(), sum_)
        )
    with SqlStore(str(file)) as store:
        with pytest.raises(StoreError, match="plain arrays"):
            store.versions.load(1)
        assert store.versions.newest() is None
        assert "plain arrays" in store.events.newest()[0].text


def test_a_store_in_memory_does_not_depend_on_a_file_called_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "None").touch()
    with SqlStore() as store:
        (tmp_path / "None").unlink()
        store.events.put("note", "still written")
        assert [event.text for event in store.events.newest()] == ["still written"]
