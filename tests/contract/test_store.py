"""One contract over every store: in memory, SQLite in a file, PostgreSQL where
DENGINE_TEST_POSTGRES names one.
"""

import hashlib
import itertools
import sqlite3
import uuid
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
import sqlalchemy as sa
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from dengine.errors import StoreError
from dengine.history.status import history
from dengine.records import Action, Decision, Reason, Source
from dengine.store import (
    Change,
    Event,
    NewLabel,
    Outcomes,
    SqlStore,
    StoredDecision,
    verify_history,
)
from dengine.store.views import HistoryFilter
from tests.support.plans import along_indexes
from tests.support.stores import (
    decision,
    label,
    put_decision,
    put_label,
    put_labels,
    report,
    trace,
)


@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    hnp.arrays(
        "f4", st.tuples(st.integers(1, 3), st.integers(1, 40)), elements=st.floats(width=32)
    ),
    st.integers(-(2**63), 2**63 - 1),
    st.booleans(),
)
def test_a_decision_returns_as_it_was_put_and_any_trace_bit_for_bit(
    store, values, content_hash, quarantined
):
    name, numbers = uuid.uuid4().hex, (0.9, 1.0, 40, 0, None, 3, Reason.AUDIT, True, 0.02)
    given = Decision(name, Action.VERIFY, Action.ACCEPT, *numbers, "Stück 7\\0")
    assert store.decisions.get(name) is None
    put_decision(store, given, values, content_hash, quarantined)
    result = store.decisions.get(name)
    assert (result.decision, result.success, result.source) == (given, None, None)
    assert (result.trace.shape, result.trace.tobytes()) == (values.shape, values.tobytes())
    assert (result.content_hash, result.quarantined) == (content_hash, quarantined)


def test_labels_in_one_batch_are_numbered_in_the_order_given(store):
    for name in "abcd":
        put_decision(store, name)
    assert put_label(store, "d") == 1
    point = np.array([0.5, 1.5], dtype=np.float32)
    batch = [NewLabel("c", False, Source.STOP, 3, point, 4), label("a"), label("b", False)]
    assert put_labels(store, *batch) == [2, 3, 4]
    assert store.labels.with_traces().labels.tolist() == [1, 0, 1, 0]
    stored = store.decisions.get("c")
    assert (stored.success, stored.source) == (False, Source.STOP)
    (added,) = (past for past in store.labels.past(0) if past.point is not None)
    assert (added.seq, added.model_version, added.point.tolist()) == (2, 3, [0.5, 1.5])


def test_a_batch_longer_than_a_chunk_is_taken_whole(store):
    names, x = [str(i) for i in range(503)], np.zeros((1, 2), np.float32)
    store.apply_records([StoredDecision(decision(n), x, int(n), False, 1.0) for n in names])
    assert put_labels(store, *(label(n, silent=1) for n in names)) == list(range(1, 504))
    assert store.labels.with_traces().hashes.tolist() == list(range(503))
    assert store.labels.unreported_total() == 503


def test_labelled_are_the_newest_in_label_order_without_the_quarantined(store):
    x = {n: put_decision(store, n, trace(i), 100 + i, n == "c") for i, n in enumerate("abcde")}
    for name in "ecbad":
        put_label(store, name, name != "b")
    every = store.labels.with_traces()
    assert every.seq.tolist() == [1, 3, 4, 5]
    assert every.labels.tolist() == [1, 0, 1, 1]
    assert every.hashes.tolist() == [104, 101, 100, 103]
    np.testing.assert_array_equal(every.traces, np.stack([x[name] for name in "ebad"]))
    assert len(store.labels.with_traces(0).seq) == 0
    newest = store.labels.with_traces(2)
    assert newest.seq.tolist() == [4, 5]
    np.testing.assert_array_equal(newest.traces, every.traces[2:])
    arrays = every.seq, every.traces, every.labels, every.hashes
    assert [a.dtype for a in arrays] == ["i8", "f4", "i1", "i8"]


@pytest.mark.parametrize("limit", [None, 0, 5])
def test_an_empty_store_has_empty_arrays(store, limit):
    result, decisions = store.labels.with_traces(limit), store.decisions
    assert (result.seq.shape, result.traces.shape) == ((0,), (0, 0, 0))
    assert (store.versions.newest(), store.labels.unreported_total()) == (None, 0)
    assert store.versions.retrains() == decisions.unreported_accepts() == store.labels.past(0) == []
    assert [*history(store)] == [*history(store, last=5)] == decisions.stretches(10) == []
    tally = decisions.tally()
    assert (tally.outcomes, tally.count(), tally.first) == (Outcomes(), 0, None)


def test_traces_of_two_shapes_are_an_error_that_names_both(store):
    for name, samples in (("a", 10), ("b", 20)):
        put_decision(store, name, trace(0, (1, samples)))
        put_label(store, name)
    with pytest.raises(StoreError, match=r"\(1, 10\), \(1, 20\)"):
        store.labels.with_traces()
    assert store.labels.with_traces(1).traces.shape == (1, 1, 20)


def test_evidence_is_what_each_decision_was_made_by_and_its_label_without_the_quarantined(
    store,
):
    for i, quarantined in enumerate([False, True, False, False]):
        created = decision(str(i), reason=Reason.NOVEL if i == 3 else Reason.CERTAIN)
        created = replace(created, lower=0.1 * i, upper=0.2 * i)
        put_decision(store, created, None, i, quarantined)
        put_label(store, str(i), i % 2 == 0, version=1, silent=i)
    result = store.labels.outcomes_since(1)
    third, fourth = (
        (3, 0.2, 0.4, True, False, 2, 0, 1.0),
        (4, 0.1 * 3, 0.2 * 3, False, True, 3, 0, 1.0),
    )
    assert result == [third, fourth]
    assert [type(item) for item in result[0]] == [type(item) for item in third]  # for compiled code
    assert store.labels.unreported_total() == 0 + 2 + 3
    assert store.labels.outcomes_since(4) == []


def test_unreported_accepts_are_those_without_a_label_oldest_first_whatever_the_clock_said(
    store,
):
    names = ["zoe", "amy", "kim", "eve", "bob", "ann"]  # neither sorted, nor by hash
    store.clock = iter([5.0, 5.0, 5.0, 2.0, 2.0, 1.0, *range(8, 20)]).__next__
    for name in names:
        accept = decision(name, Action.ACCEPT, Reason.CERTAIN)
        put_decision(store, accept, quarantined=name == "eve")
    put_decision(store, "verified")
    put_decision(store, decision("rejected", Action.REJECT, Reason.CERTAIN))
    assert store.decisions.unreported_accepts() == ["zoe", "amy", "kim", "bob", "ann"]
    put_labels(store, label("bob", False), label("zoe", source=Source.CONFIRMED))
    assert store.decisions.unreported_accepts() == ["amy", "kim", "ann"]
    ids = {name for some in store.decisions.ids() for name in some}
    assert ids == {*names, "verified", "rejected"}


CERTAIN = """
accept accept  None None None False False True
reject reject  None None
verify accept  True True False None
verify reject  True True True False None
verify verify  True False None
"""  # action, predicted, and the labels of such decisions


def test_outcomes_count_what_became_of_what_was_certain(store):
    for line in CERTAIN.strip().splitlines():
        action, predicted, *labels = line.split()
        for i, text in enumerate(labels):
            made = decision(f"{action} {predicted} {i}", Action(action))
            audit = action != predicted
            put_decision(store, replace(made, predicted=Action(predicted), audit=audit))
            if text != "None":
                put_label(store, made.id, text == "True", Source.AUDIT)
    outcomes = store.decisions.tally().outcomes
    accepts = Outcomes(6, 2, 1, audited_accepts=3, audited_accepts_bad=1)
    assert outcomes == replace(accepts, rejected=2, audited_rejects=4, audited_rejects_good=3)


def test_events_are_numbered_from_one_and_keep_any_text(store):
    store.database.clock = iter([1.5, 1.5, 2.5, 2.5, 3.5, 3.5]).__next__  # the ledger asks, too
    for kind in ("started", "safe_mode", Reason.MODEL_ERROR):
        store.events.put(kind, f"was {kind}: ± \0 \ud800")  # which databases refuse
    every = store.events.newest()
    assert every[1] == Event(2, 2.5, "safe_mode", "was safe_mode: ± \\0 \\ud800")
    assert [event.number for event in every] == [1, 2, 3]
    assert type(every[2].kind) is str
    assert store.events.newest(2) == every[1:]
    assert (store.events.newest(0), store.events.newest(9)) == ([], every)


def test_the_newest_accepted_version_returns_bit_for_bit(store):
    state = {
        "encoder.stem.weight": np.asfortranarray(trace(3, (4, 1, 5))),
        "ids": np.array(["a", "bc"]),
        "file": np.array(2.5),
        "empty": np.zeros((0, 3), dtype=np.int8),
    }
    store.versions.put(report(1), 10, {"w": np.zeros(2)})
    store.versions.put(report(2), 20, state)
    store.versions.put(report(2, accepted=False), 30, None)
    last = store.versions.newest()
    assert (last.version, last.last_seq, last.state.keys()) == (2, 20, state.keys())
    for name, values in state.items():
        np.testing.assert_array_equal(last.state[name], values, strict=True)
    assert store.versions.retrains() == [report(1), report(2), report(2, accepted=False)]


@pytest.mark.parametrize(
    ("state", "named"), [({"w": np.array([{}], dtype=object)}, "'w'"), (None, "version 1")]
)
def test_an_accepted_version_needs_a_state_of_plain_arrays(store, state, named):
    with pytest.raises(StoreError, match=named):
        store.versions.put(report(1), 0, state)


def test_settings_are_replaced_as_a_whole(store):
    assert store.settings.read() == {}
    store.settings.save({"recipe": "a = 1\n", "spec": "é"})
    store.settings.save({"recipe": "a = 2"})
    assert store.settings.read() == {"recipe": "a = 2"}


def test_two_cells_in_one_database_do_not_see_each_other(place):
    url, cell_id = place
    with SqlStore(url, cell_id) as ours, SqlStore(url, cell_id + "-other") as other:
        for store, seed in ((ours, 1), (other, 2)):
            put_decision(store, "a", trace(seed))
            assert put_label(store, "a", seed == 1, point=np.full(2, seed, np.float32)) == 1
        ours.versions.put(report(1), 1, {"w": np.zeros(1)})
        ours.settings.save({"k": "v"})
        ours.events.put("note", "ours")
        put_decision(ours, decision("b", Action.ACCEPT))
        put_decision(ours, "c")
        put_label(ours, "c", silent=3)
        assert other.events.newest() == other.decisions.unreported_accepts() == []
        assert other.labels.unreported_total() == other.decisions.tally().outcomes.accepted == 0
        other.events.put("note", "other's")
        assert [(event.number, event.text) for event in other.events.newest()] == [(1, "other's")]
        assert (other.settings.read(), other.versions.newest()) == ({}, None)
        assert other.versions.retrains() == []
        assert other.labels.with_traces().labels.tolist() == [0]
        assert [past.point.tolist() for past in other.labels.past(0)] == [[2.0, 2.0]]
        assert other.decisions.counts()["labels"] == 1
        np.testing.assert_array_equal(other.decisions.get("a").trace, trace(2))


def test_numbers_stay_unique_with_two_stores_on_one_cell_and_each_sees_what_the_other_committed(
    place,
):
    def put(store: SqlStore, prefix: str):
        seqs = []
        for name in (f"{prefix}{i}" for i in range(15)):
            put_decision(store, name)
            seqs.append(put_label(store, name))
            store.events.put("note", name)
        return seqs

    numbers = list(range(1, 31))
    with SqlStore(*place) as first, SqlStore(*place) as two:
        with ThreadPoolExecutor(2) as pool:
            seqs = pool.map(put, (first, two), "xy")
        assert sorted(itertools.chain(*seqs)) == numbers
        assert first.labels.with_traces().seq.tolist() == numbers
        assert [event.number for event in two.events.newest()] == numbers
        read: list[int] = []
        result = verify_history(*place, on_rows=read.append)
        assert (result.ok, result.cells[0].rows, sum(read)) == (True, 120, 120)  # one chain


# The cells of a product are looked up among a few settings, and their labels are sorted.
PRODUCT = "SCAN (label|trace|decision|model_version|correction)"


@pytest.mark.parametrize(("product", "never"), [(None, "SCAN|TEMP B-TREE"), ("gear", PRODUCT)])
def test_questions_go_down_an_index_also_of_a_product_and_where_there_are_corrections(
    product, never, tmp_path
):
    with SqlStore(f"{tmp_path}/a.db", product=product) as store:
        for name in "ab":
            put_decision(store, name)
            put_label(store, name)
        store.versions.put(report(1), 0, {"w": np.ones(3)})
        store.corrections.apply(Change("forget", "", {}, "", ("a",), None))
        with along_indexes(tmp_path / "a.db", never) as sent:
            for cell_only in (True, False):
                store.labels.with_traces(100, first=1, cell_only=cell_only)
            store.labels.with_traces(100)
            store.labels.outcomes_since(0)
            store.labels.unreported_total()
            store.decisions.get("a")
            for newest in (True, False):
                store.decisions.select(HistoryFilter(action=Action.ACCEPT), 50, "a", newest)
            store.events.newest(5)
            store.versions.newest_number()
            store.versions.load(1)
            store.corrections.newest_number()
            store.corrections.after(1)
            put_label(store, "b")
    assert len(sent) >= 14


def test_sqlite_syncs_every_commit_in_wal_mode(tmp_path):
    asked = set()

    def ask(connection, *_):
        for name in ("journal_mode", "synchronous"):
            asked.add(connection.execute(f"PRAGMA {name}").fetchone()[0])

    sa.event.listen(sa.pool.Pool, "checkout", ask)
    try:
        with SqlStore(f"{tmp_path}/a.db") as store:
            put_decision(store, "a")
    finally:
        sa.event.remove(sa.pool.Pool, "checkout", ask)
    assert asked == {"wal", 2}


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        (
            "UPDATE setting SET value = '99' WHERE key = 'schema_version'",
            "schema 1 with all its columns, found schema 99",
        ),
        ("ALTER TABLE label DROP COLUMN silent", "open it with the dengine that wrote it"),
        ("CREATE TABLE trials (id)", "schema 1 with all its columns, found other tables"),
        ("CREATE TABLE setting (name)", "found other tables"),
        ("CREATE TABLE label (id)", "found other tables"),
        ("not a database\n" * 100, "name a new file"),
    ],
)
def test_what_is_no_store_of_this_dengine_is_refused_and_left_alone(statement, message, tmp_path):
    file = tmp_path / "a.db"
    if statement.startswith("not"):
        file.write_text(statement)
    else:
        if not statement.startswith("CREATE"):
            SqlStore(str(file)).close()
        with closing(sqlite3.connect(file)) as connection, connection:
            connection.execute(statement)
    before = file.read_bytes()
    with pytest.raises(StoreError, match=message):
        SqlStore(str(file), "another cell")
    assert file.read_bytes() == before
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("name", ["missing/engine.db", "."])
def test_a_place_that_cannot_be_written_says_what_to_do(tmp_path, name):
    with pytest.raises(StoreError, match="Create the directory"):
        SqlStore(f"{tmp_path}/{name}")


def test_a_pickle_in_the_database_is_never_loaded(tmp_path):
    file, evil = f"{tmp_path}/a.db", tmp_path / "evil.npz"
    with SqlStore(file) as store:
        store.versions.put(report(1), 0, {"w": np.zeros(1)})
    np.savez(evil, w=np.array([{}], dtype=object))
    content = evil.read_bytes()
    with sqlite3.connect(file) as connection:
        changed = content, hashlib.sha256(content).digest()
        connection.execute("UPDATE model_version SET state = ?, state_sum = ?", changed)
    with SqlStore(file) as store:
        with pytest.raises(StoreError, match="plain arrays"):
            store.versions.load(1)
        assert store.versions.newest() is None
        assert "plain arrays" in store.events.newest()[0].text
