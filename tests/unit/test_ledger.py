"""The ledger: whatever is changed, removed or added behind a store's back is found, and named."""

import hashlib
import json
import random
import shutil
import sqlite3
import struct
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dengine.errors import StoreError
from dengine.export import make_key
from dengine.records import Reason, Source
from dengine.store import Change, NewLabel, SqlStore, StoredDecision, verify_history
from dengine.store.ledger import KEY_VARIABLE, START, entry_digest, row_sum, rows_digest
from dengine.store.schema import CHAINED
from tests.support.command_line import dengine, document, succeed
from tests.support.stores import (
    decision,
    execute,
    labelled,
    put_decision,
    put_label,
    put_labels,
    report,
)
from tests.support.tables import rows


def write(store: SqlStore) -> SqlStore:
    """Something in every table, in entries of one row and of many."""
    rng = np.random.default_rng(0)
    traces = rng.normal(size=(12, 1, 200)).astype(np.float32)
    store.settings.save({"recipe": "a = 1", "trace": "{}"})
    for i, x in enumerate(traces):
        put_decision(store, replace(decision(f"d{i}"), part=f"SN-{i}"), x, i - 3, i == 5)
    first, *labels = (
        NewLabel(f"d{i}", i % 2 == 0, Source.AUDIT, 1, x, overdue_to=i)
        for i, x in enumerate(rng.normal(size=(10, 2)).astype(np.float32))
    )
    put_labels(store, replace(first, silent=2))
    put_labels(store, *labels)
    imported = [StoredDecision(decision(f"i{i}"), traces[i], i, False, 1.0) for i in range(4)]
    store.apply_records([record for item in imported for record in labelled(item, True)])
    for version in (1, 2):
        store.versions.put(report(version), 5, {"w": rng.normal(size=40)})
    store.versions.put(report(2, accepted=False), 6, None)
    store.settings.save({"recipe": "a = 2", "trace": "{}"})
    store.events.put("note", "Prüfung wörtlich")
    for kind, name, success in (("correct", "d6", False), ("forget", "d7", None)):
        store.corrections.apply(Change(kind, kind, {"decisions": [name]}, "kim", (name,), success))
    return store


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    file = f"{tmp_path_factory.mktemp('history')}/engine.db"
    write(SqlStore(file)).close()
    execute(file, "PRAGMA wal_checkpoint(TRUNCATE)")
    return file


@pytest.fixture
def file(written, tmp_path):
    return shutil.copy(written, f"{tmp_path}/engine.db")


def faults(file: str) -> list[tuple[str, str]]:
    return [(fault.table, fault.key) for fault in verify_history(file).faults]


def test_what_a_store_wrote_is_whole_in_every_database(place):
    odd = replace(decision("Ünïcode ✓", reason=Reason.CONSTANT), lower=-0.0, part="Stück 7\\0")
    with SqlStore(*place) as store:
        write(store)
    with SqlStore(place[0], "odd " + place[1], clock=lambda: 7) as store:
        put_decision(store, odd, np.array([np.nan, np.inf, -0.0]), -(2**63), True)
        typed = np.bool_(True), Source.VERIFICATION, np.int64(0), np.zeros(2, np.float32)
        put_label(store, np.str_(odd.id), *typed)
        assert verify_history(place[0], store.cell_id).ok
    result = verify_history(*place)
    assert (result.ok, result.faults) == (True, ())
    assert result.cells[0].rows == 2 * 16 + 14 + 3 + 3 + 2


CHANGED = """CASE typeof({0}) WHEN 'text' THEN 'x' || {0} WHEN 'blob' THEN CAST({0} || 'x' AS BLOB)
WHEN 'real' THEN {0} * 1.0000001 + 1e-9 ELSE {0} + 1 END"""


def test_a_value_changed_in_any_column_of_any_table_is_found(written, tmp_path):
    rng, missed, tried, file = random.Random(0), [], 0, f"{tmp_path}/changed.db"
    with closing(sqlite3.connect(written)) as whole:
        query = "SELECT s.name, c.name FROM sqlite_master s, pragma_table_info(s.name) c"
        columns = whole.execute(f"{query} WHERE s.type = 'table'").fetchall()
    for table, column in columns:
        shutil.copy(written, file)
        name, change = f'"{column}"', CHANGED.format(f'"{column}"')
        # A key that is taken is refused by SQLite itself; what is no store any more is found, too.
        with suppress(sqlite3.IntegrityError, StoreError):
            with closing(sqlite3.connect(file)) as connection, connection:
                query = f"SELECT rowid FROM {table} WHERE {name} IS NOT NULL"
                (row,) = rng.choice(connection.execute(query).fetchall())
                connection.execute(f"UPDATE {table} SET {name} = {change} WHERE rowid = {row}")
            tried += 1
            missed += [(table, column)] if verify_history(file).ok else []
    assert missed == []
    assert tried > 60


# A table, the key of the fault that is named there, and a change.
CHANGES = """
label; d2;        UPDATE label SET success = NOT success WHERE seq = 3
decision; d7;     UPDATE decision SET upper = 0.875 WHERE id = 'd7'
model_version; 2; UPDATE model_version SET state = zeroblob(9) WHERE retrain = 2
correction; 2;    UPDATE correction SET success = 1 WHERE number = 2
ledger; entry 22; DELETE FROM correction WHERE number = 1
event; 1;         UPDATE event SET text = 'another' WHERE number = 1
setting; recipe;  UPDATE setting SET value = 'a = 3' WHERE key = 'recipe'
setting; more;    INSERT INTO setting VALUES ('cell', 'more', 'x')
setting; b'\\xff'; INSERT INTO setting VALUES ('cell', x'ff', 'x')
ledger; entry 3;  UPDATE ledger SET added = '[[1, 2], ["a", 3]]'
ledger; entry 15; DELETE FROM label WHERE seq = 4
ledger; entry 21; DELETE FROM event WHERE number = 1
ledger; entry 19; DELETE FROM model_version WHERE retrain = 3
setting; trace;   DELETE FROM setting WHERE key = 'trace'
trace; d7;        DELETE FROM trace WHERE decision_id = 'd7'
decision; d7;     DELETE FROM decision WHERE id = 'd7'
ledger; entry 3;  UPDATE ledger SET time = time + 1 WHERE number = 3
ledger; entry 3;  DELETE FROM ledger WHERE number = 3
event; 4;         INSERT INTO event VALUES ('cell', 4, 1.0, 'note', 'slipped in', NULL, '', NULL, NULL)
label; d2;        UPDATE label SET entry = 2 WHERE seq = 3
label; d2;        UPDATE label SET entry = NULL WHERE seq = 3
ledger; entry 2;  UPDATE ledger SET digest = zeroblob(32) WHERE number = 2
"""


@pytest.mark.parametrize(("table", "key", "statement"), rows(CHANGES, 3, at="; "))
def test_what_is_wrong_is_named(file, table, key, statement):
    execute(file, statement)
    assert (table, key) in faults(file)


def test_a_changed_row_with_a_sum_that_fits_is_found_in_its_entry(file):
    """Whoever changes a row can work out its sum anew, and the entry tells all the same."""
    with sqlite3.connect(file) as connection:
        connection.row_factory = sqlite3.Row
        row = dict(connection.execute("SELECT * FROM label WHERE seq = 2").fetchone())
        row["success"] = 1 - row["success"]
        row["sum"] = row_sum("label", row)
        connection.execute("UPDATE label SET success = :success, sum = :sum WHERE seq = 2", row)
    assert faults(file) == [("ledger", f"entry {row['entry']}")]
    with SqlStore(file) as store:  # as an engine does that opens it, whatever it reads of it
        check = store.database.check_integrity
        assert check(100) == check(10) == "the rows of label are not those of the ledger"
        assert check(3) == check(100, since=10) == ""


def test_entries_that_were_cut_off_are_found_by_a_digest_that_was_kept_elsewhere(
    file,
):
    kept = verify_history(file).cells[0].digest
    with SqlStore(file) as store:
        store.events.put("note", "later")
    assert verify_history(file, expect=kept[:12]).ok
    newest = "(SELECT max(number) FROM ledger)"
    for _ in range(2):  # with all that an entry chains: nothing in the store tells of it
        execute(file, *(f"DELETE FROM {table} WHERE entry = {newest}" for table in CHAINED))
        execute(file, f"DELETE FROM ledger WHERE number = {newest}")
    assert verify_history(file).ok
    (fault,) = verify_history(file, expect=kept).faults
    assert fault.table == "ledger"
    assert "cut off" in fault.problem
    with pytest.raises(StoreError, match="64 hexadecimal digits"):
        verify_history(file, expect="newest")


def test_who_has_no_key_cannot_make_a_keyed_ledger_anew(tmp_path, monkeypatch):
    file, key = f"{tmp_path}/engine.db", str(make_key(tmp_path / "ledger.key"))
    monkeypatch.setenv(KEY_VARIABLE, key)
    write(SqlStore(file)).close()
    assert verify_history(file).ok
    with sqlite3.connect(file) as connection:  # by somebody who may write, and who has our code
        connection.row_factory = sqlite3.Row
        previous = START
        for row in connection.execute("SELECT * FROM ledger ORDER BY number").fetchall():
            entry = {name: row[name] for name in row.keys() if name != "digest"}  # noqa: SIM118
            previous = entry_digest(previous, entry)
            change = "UPDATE ledger SET digest = ? WHERE number = ?"
            connection.execute(change, (previous, entry["number"]))
    assert {table for table, _ in faults(file)} == {"ledger"}
    other = str(make_key(tmp_path / "other.key"))
    for text, named in (("with a key", ""), ("with another key", other), ("without a key", key)):
        if text == "without a key":  # that it ever had one is gone too
            execute(file, "DELETE FROM setting WHERE key = 'ledger_key'")
        monkeypatch.setenv(KEY_VARIABLE, named)
        for use in (SqlStore, verify_history):
            with pytest.raises(StoreError, match=f"was begun, or made anew, {text}"):
                use(file)
    monkeypatch.delenv(KEY_VARIABLE)
    assert verify_history(file).ok  # which is why it has to be keyed


def test_pages_that_sqlite_cannot_read_are_said_and_the_rest_is_checked(file):
    with closing(sqlite3.connect(file)) as connection:
        query = "SELECT (rootpage - 1) * page_size FROM sqlite_master, pragma_page_size"
        (begin,) = connection.execute(f"{query} WHERE name = 'event'").fetchone()
    data = Path(file).read_bytes()
    Path(file).write_bytes(data[:begin] + bytes(100) + data[begin + 100 :])
    assert {("file", ""), ("event", "")} <= {*faults(file)}


def test_another_cells_faults_are_its_own(file):
    with SqlStore(file, "other") as store:
        write(store)
    execute(file, "UPDATE event SET text = 'x' WHERE cell_id = 'other'")
    assert verify_history(file, "cell").ok
    assert {fault.cell_id for fault in verify_history(file).faults} == {"other"}
    with pytest.raises(StoreError, match="cell, other"):
        verify_history(file, "a third")


@pytest.mark.parametrize("statement", ["", "CREATE TABLE t (id)"])
def test_what_is_no_store_is_refused_and_nothing_is_made(statement, tmp_path):
    if statement:
        execute(tmp_path / "a.db", statement)
    with pytest.raises(StoreError, match="Expected a"):
        verify_history(f"{tmp_path}/a.db")
    assert (tmp_path / "a.db").exists() == bool(statement)


def test_a_damaged_trace_is_left_out_of_training_and_an_event_names_it(file):
    with SqlStore(file) as store:
        whole = store.labels.with_traces()
    changed, kept = "UPDATE trace SET data = zeroblob(800)", ~np.isin(whole.seq, [4, 5])
    gone = "DELETE FROM trace WHERE decision_id = 'd4'"
    execute(file, f"{changed} WHERE decision_id = 'd3'", gone)
    with SqlStore(file) as store:
        for _ in range(2):
            result = store.labels.with_traces()
            for name in ("seq", "traces", "labels", "hashes"):
                np.testing.assert_array_equal(getattr(result, name), getattr(whole, name)[kept])
        (answer,) = (event.text for event in store.events.newest() if event.kind == "damaged")
        assert "decision d3, d4" in answer
        with pytest.raises(StoreError, match=r"'d3'.*bytes have changed"):
            store.decisions.get("d3")
    execute(file, changed)
    with SqlStore(file) as store:
        assert len(store.labels.with_traces().traces) == 0


def test_the_verb_shows_the_digest_and_names_what_is_wrong_with_exit_code_1(file):
    result = document("verify", file)
    digest = result["cells"][0]["digest"]
    assert (result["ok"], result["faults"]) == (True, [])
    assert digest in succeed("verify", file, "--expect", digest)
    execute(file, "UPDATE label SET success = NOT success WHERE seq = 3")
    done = dengine("verify", file)
    assert done.exit_code == 1
    assert "cell cell: label d2 was changed." in done.output
    done = dengine("verify", file, "--json", "--cell", "cell")
    assert (done.exit_code, json.loads(done.output)["faults"][0]["key"]) == (1, "d2")


def test_a_sum_is_what_it_was():
    """Stores hold sums that were made years ago: these numbers change never."""
    row = {"cell_id": "cell", "number": 1, "time": 1.5, "kind": "note", "text": "é"}
    row |= {"ok": True, "none": None, "data": b"\0"}
    plain = (
        b"event\ncell_id=s4:celldata=b1:\0kind=s4:notenumber=i1;ok=i1;text=s2:\xc3\xa9time=f"
        + struct.pack(">d", 1.5)
    )
    assert row_sum("event", row) == hashlib.sha256(plain).digest()
    later = row | {"column of a later schema": None, "sum": b"x", "state": b"y"}
    assert row_sum("event", later) == row_sum("event", row)
    head = hashlib.sha256(b"ledger\nnumber=i1;").digest()
    assert (
        entry_digest(START, {"number": 1})
        == hashlib.sha256(b"dengine ledger 2\n" + bytes(32) + head).digest()
    )
    digest = hashlib.sha256(b"event=2;" + b"a" * 32 + b"b" * 32).digest()
    assert rows_digest({"event": [b"b" * 32, b"a" * 32]}) == digest
