"""A store of schema 1 or 2, as earlier dengines wrote it, is brought to schema 3 when it is opened; nothing is lost."""

import io
import os
import signal
import subprocess
import sys
import threading
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa

from dengine.errors import StoreError
from dengine.records import Action, Decision, Reason, RetrainReport, Source
from dengine.store import SqlStore, verify_history
from dengine.store import ledger as chain
from dengine.store.migrations import migrate

POSTGRES = os.environ.get("DENGINE_TEST_POSTGRES")

# What dengine 0.2 executed on an empty SQLite file; on PostgreSQL two types have other names.
SCHEMA_1 = """
CREATE TABLE setting (
    cell_id VARCHAR NOT NULL, "key" VARCHAR NOT NULL, value VARCHAR NOT NULL,
    PRIMARY KEY (cell_id, "key")
);
CREATE TABLE decision (
    cell_id VARCHAR NOT NULL, id VARCHAR NOT NULL, time DOUBLE NOT NULL, action VARCHAR NOT NULL,
    predicted VARCHAR NOT NULL, lower DOUBLE, upper DOUBLE, n_success BIGINT NOT NULL, n_failure BIGINT NOT NULL,
    embedding TEXT, model_version BIGINT NOT NULL, reason VARCHAR NOT NULL, audit BOOLEAN NOT NULL,
    propensity DOUBLE, content_hash BIGINT NOT NULL, quarantined BOOLEAN NOT NULL,
    PRIMARY KEY (cell_id, id)
);
CREATE TABLE trace (
    cell_id VARCHAR NOT NULL, decision_id VARCHAR NOT NULL, channels INTEGER NOT NULL, samples INTEGER NOT NULL,
    data BLOB NOT NULL,
    PRIMARY KEY (cell_id, decision_id)
);
CREATE TABLE label (
    cell_id VARCHAR NOT NULL, decision_id VARCHAR NOT NULL, seq BIGINT NOT NULL, time DOUBLE NOT NULL,
    success BOOLEAN NOT NULL, source VARCHAR NOT NULL, model_version BIGINT NOT NULL, point BLOB,
    content_hash BIGINT NOT NULL, quarantined BOOLEAN NOT NULL,
    PRIMARY KEY (cell_id, decision_id),
    CONSTRAINT label_seq UNIQUE (cell_id, seq)
);
CREATE INDEX label_training ON label (cell_id, quarantined, seq);
CREATE TABLE model_version (
    cell_id VARCHAR NOT NULL, retrain BIGINT NOT NULL, version BIGINT NOT NULL, time DOUBLE NOT NULL,
    seconds DOUBLE NOT NULL, n_traces BIGINT NOT NULL, n_steps BIGINT NOT NULL, accepted BOOLEAN NOT NULL,
    reason TEXT NOT NULL, last_seq BIGINT NOT NULL, state BLOB,
    PRIMARY KEY (cell_id, retrain)
);
CREATE INDEX version_accepted ON model_version (cell_id, accepted, retrain)
"""
CELLS = ("cell", "other")
TRACE = np.arange(12, dtype="<f4").reshape(2, 6)
ROWS = (  # of each cell: a verified success, an accept that was never heard of, a quarantined failure
    "INSERT INTO setting VALUES (:cell, 'schema_version', '1'), (:cell, 'recipe', 'a = 1')",
    "INSERT INTO decision VALUES"
    " (:cell, 'a', 1.5, 'verify', 'accept', 0.25, 1.0, 3, 1, '[[0.5, 0.25]]', 1, 'audit', true, 0.02, -7, false),"
    " (:cell, 'b', 2.5, 'accept', 'accept', 0.75, 1.0, 9, 0, NULL, 1, 'certain', false, 0.02, 8, false),"
    " (:cell, 'c', 3.5, 'verify', 'verify', 0.0, 1.0, 0, 0, NULL, 1, 'constant', false, 1.0, 9, true)",
    "INSERT INTO trace VALUES (:cell, 'a', 2, 6, :trace), (:cell, 'b', 2, 6, :trace), (:cell, 'c', 2, 6, :trace)",
    "INSERT INTO label VALUES (:cell, 'a', 1, 1.75, true, 'audit', 1, :point, -7, false),"
    " (:cell, 'c', 2, 3.75, false, 'verification', 1, NULL, 9, true)",
    "INSERT INTO model_version VALUES (:cell, 1, 1, 1.0, 0.5, 100, 60, true, 'improved', 0, :state)",
)


def write_schema_1(url: str) -> None:
    """Execute what dengine 0.2 did, and add two cells."""
    engine = sa.create_engine(url)
    text = SCHEMA_1
    if engine.dialect.name == "postgresql":
        text = text.replace("DOUBLE", "DOUBLE PRECISION").replace("BLOB", "BYTEA")
    state = io.BytesIO()
    np.savez(state, w=np.array([1.0, 2.0]))
    values = {"trace": TRACE.tobytes(), "point": np.array([0.5], "<f4").tobytes(), "state": state.getvalue()}
    with engine.begin() as connection:
        for statement in text.split(";"):
            connection.execute(sa.text(statement))
        for cell in CELLS:
            for statement in ROWS:
                sent = sa.text(statement)
                connection.execute(
                    sent, {name: v for name, v in (values | {"cell": cell}).items() if f":{name}" in statement}
                )
    engine.dispose()


@pytest.fixture(
    params=[
        "sqlite",
        pytest.param(
            "postgres", marks=pytest.mark.skipif(not POSTGRES, reason="DENGINE_TEST_POSTGRES is unset: . .ci/postgres.sh")
        ),
    ]
)
def empty(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """The URL of an empty database of its own: a schema belongs to all cells of one."""
    if request.param == "sqlite":
        yield f"sqlite:///{tmp_path / 'old.db'}"
        return
    admin, name = sa.create_engine(str(POSTGRES), isolation_level="AUTOCOMMIT"), f"old_{uuid.uuid4().hex}"
    with admin.connect() as connection:
        connection.execute(sa.text(f"CREATE DATABASE {name}"))
    yield sa.make_url(str(POSTGRES)).set(database=name).render_as_string(hide_password=False)
    with admin.connect() as connection:
        connection.execute(sa.text(f"DROP DATABASE {name} WITH (FORCE)"))
    admin.dispose()


@pytest.fixture
def old(empty: str) -> str:
    write_schema_1(empty)
    return empty


@pytest.fixture
def second(old: str) -> str:
    return to_schema_2(old)


def to_schema_2(old: str) -> str:
    """What dengine 0.3 made of a store of schema 1, and an event."""
    real = "DOUBLE PRECISION" if old.startswith("postgresql") else "DOUBLE"
    execute(
        old,
        "ALTER TABLE decision ADD COLUMN part VARCHAR",
        "ALTER TABLE label ADD COLUMN silent BIGINT DEFAULT 0 NOT NULL",
        f"CREATE TABLE event (cell_id VARCHAR NOT NULL, number BIGINT NOT NULL, time {real} NOT NULL,"
        " kind VARCHAR NOT NULL, text TEXT NOT NULL, PRIMARY KEY (cell_id, number))",
        "UPDATE setting SET value = '2' WHERE key = 'schema_version'",
        "INSERT INTO event VALUES ('other', 1, 5.5, 'note', 'of schema 2')",
        "UPDATE decision SET part = 'SN-7' WHERE id = 'c'",
    )
    return old


def execute(url: str, *statements: str) -> None:
    engine = sa.create_engine(url)
    with engine.begin() as connection:
        for statement in statements:
            connection.execute(sa.text(statement))
    engine.dispose()


def schemas(url: str) -> dict[str, str]:
    """The schema that each cell names."""
    engine = sa.create_engine(url)
    with engine.connect() as connection:
        rows = connection.execute(sa.text("SELECT cell_id, value FROM setting WHERE key = 'schema_version'")).all()
    engine.dispose()
    return {row[0]: row[1] for row in rows}


def shape(url: str) -> dict[str, object]:
    """Columns, keys and indexes of every table."""
    engine = sa.create_engine(url)
    inspector = sa.inspect(engine)
    found = {
        table: (
            [(c["name"], str(c["type"]), c["nullable"], c["default"]) for c in inspector.get_columns(table)],
            inspector.get_pk_constraint(table)["constrained_columns"],
            sorted(i["name"] for i in inspector.get_indexes(table)),
            sorted(u["name"] for u in inspector.get_unique_constraints(table)),
        )
        for table in inspector.get_table_names()
    }
    engine.dispose()
    return found


@pytest.mark.parametrize("cell", CELLS)
def test_all_that_a_store_of_schema_1_held_is_read_back(old: str, cell: str) -> None:
    with SqlStore(old, "other") as store, SqlStore(old, cell) as again:
        assert store.settings() == again.settings() == {"recipe": "a = 1"}
        found = again.get_decision("a")
        assert (found.action, found.predicted, found.audit, found.reason) == (
            Action.VERIFY,
            Action.ACCEPT,
            True,
            Reason.AUDIT,
        )
        assert (found.embedding, found.content_hash, found.success, found.source) == (
            ((0.5, 0.25),),
            -7,
            True,
            Source.AUDIT,
        )
        np.testing.assert_array_equal(found.trace, TRACE)
        assert again.get_decision("c").quarantined
        assert (again.labelled().seq.tolist(), again.labelled().hashes.tolist()) == ([1], [-7])
        assert again.points_since(0, 1).points.tolist() == [[0.5]]
        assert again.last_version().state["w"].tolist() == [1.0, 2.0]
        assert again.retrains() == [RetrainReport(1, 0.5, 100, 60, True, "improved")]
        assert (again.status()["decisions"], again.status()["labels"], again.status()["last_label_time"]) == (3, 2, 3.75)


def test_what_schema_1_did_not_know_is_nothing(old: str) -> None:
    with SqlStore(old) as store:
        assert [store.get_decision(name).part for name in "abc"] == [None, None, None]
        evidence = store.evidence_since(0)
        assert (evidence.novel.tolist(), evidence.silent.tolist(), store.silent_total()) == ([False], [0], 0)
        assert (store.events(), store.unreported_accepts()) == ([], ["b"])
        assert (store.outcomes().accepted, store.outcomes().audited_accepts) == (1, 1)


def test_what_is_new_is_written_and_read_after_opening_again(old: str) -> None:
    d = Decision("d", Action.VERIFY, Action.VERIFY, 0.0, 1.0, 0, 0, None, 1, Reason.NOVEL, False, 1.0)
    with SqlStore(old) as store:
        store.put_decision(d, TRACE, 5, False, "SN-4")
        assert store.put_label("d", True, Source.VERIFICATION, 1, None, silent=6) == 3
        store.put_event("note", "brought to schema 3")
    with SqlStore(old) as store:
        assert store.get_decision("d").part == "SN-4"
        assert (store.evidence_since(2).novel.tolist(), store.silent_total()) == ([True], 6)
        assert [(event.number, event.text) for event in store.events()] == [(1, "brought to schema 3")]


def test_tables_brought_up_to_date_are_those_of_a_new_store_and_every_cell_names_the_schema(
    old: str, tmp_path: Path
) -> None:
    SqlStore(old, "a third").close()
    assert schemas(old) == {"cell": "3", "other": "3", "a third": "3"}
    changed = shape(old)
    execute(old, *(f"DROP TABLE {table}" for table in changed))
    SqlStore(old).close()
    assert changed == shape(old)


def test_stores_that_open_schema_1_at_once_all_succeed(old: str) -> None:
    opened: list[SqlStore] = []
    threads = [threading.Thread(target=lambda i=i: opened.append(SqlStore(old, f"cell-{i}"))) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for store in opened:
        store.close()
    assert len(opened) == 4
    assert set(schemas(old).values()) == {"3"}


def test_processes_that_open_schema_1_at_once_all_succeed(old: str) -> None:
    code = (
        "import sys\nfrom dengine.store import SqlStore\nprint('ready', flush=True)\nsys.stdin.readline()\n"
        "with SqlStore(sys.argv[1], sys.argv[2]) as store: store.put_event('opened', sys.argv[2])"
    )
    children = [
        subprocess.Popen(
            [sys.executable, "-c", code, old, f"cell-{i}"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        for i in range(3)
    ]
    for child in children:
        assert child.stdout.readline() == "ready\n"
    for child in children:
        child.stdin.write("go\n")
        child.stdin.flush()
    for child in children:
        child.communicate(timeout=60)
    assert [child.returncode for child in children] == [0, 0, 0]
    for i in range(3):
        with SqlStore(old, f"cell-{i}") as store:
            assert [event.text for event in store.events()] == [f"cell-{i}"]


def test_a_change_that_fails_halfway_leaves_schema_1_as_it_was(old: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*chained: object) -> None:
        raise sa.exc.OperationalError("INSERT INTO ledger", {}, OSError("database or disk is full"))

    before = shape(old)
    with monkeypatch.context() as patch:
        patch.setattr(chain, "entry_digest", fail)  # after all tables are changed, before the first entry is written
        with pytest.raises(StoreError, match=r"disk is full.*Free some space"):
            SqlStore(old)
    assert (shape(old), schemas(old)) == (before, {"cell": "1", "other": "1"})
    with SqlStore(old) as store:
        assert len(store.labelled().seq) == 1


def test_a_process_that_is_killed_halfway_leaves_schema_1_as_it_was(old: str) -> None:
    code = (
        "import os, signal, sys\nfrom dengine.store import SqlStore, chain\n"
        "chain.entry_digest = lambda *chained: os.kill(os.getpid(), signal.SIGKILL)\nSqlStore(sys.argv[1])"
    )
    before = shape(old)
    assert subprocess.run([sys.executable, "-c", code, old], timeout=60).returncode == -signal.SIGKILL
    assert (shape(old), schemas(old)) == (before, {"cell": "1", "other": "1"})
    with SqlStore(old) as store:
        assert store.verify().ok


def test_schema_1_beside_another_programs_event_table_is_refused_and_left_alone(old: str) -> None:
    execute(old, "CREATE TABLE event (id INTEGER)")
    before = shape(old)
    with pytest.raises(StoreError, match="schema 3, found schema 1 and a table 'event' of another program"):
        SqlStore(old)
    assert shape(old) == before


def test_cells_of_two_schemas_are_refused(old: str) -> None:
    execute(old, "UPDATE setting SET value = '4' WHERE key = 'schema_version' AND cell_id = 'other'")
    with pytest.raises(StoreError, match="schema 3, found schema 1, 4"):
        SqlStore(old)


def test_an_engine_of_schema_1_that_still_runs_may_go_on_writing(old: str) -> None:
    """It names its columns; those that it does not know take what they had in schema 1: nothing."""
    with SqlStore(old) as store:
        execute(
            old,
            "INSERT INTO label (cell_id, decision_id, seq, time, success, source, model_version, content_hash, quarantined)"
            " VALUES ('cell', 'b', 3, 4.5, false, 'stop', 1, 8, false)",
        )
        assert store.evidence_since(2).silent.tolist() == [0]
        assert (store.get_decision("b").success, store.outcomes().stops) == (False, 1)
        (fault,) = store.verify().faults
        assert (fault.table, fault.key, "not chained" in fault.what) == ("label", "b", True)


def test_a_store_of_schema_2_is_read_back_and_gets_the_tables_of_a_new_one(second: str) -> None:
    with SqlStore(second, "other") as store:
        assert (store.get_decision("c").part, store.get_decision("a").part) == ("SN-7", None)
        assert [event.text for event in store.events()] == ["of schema 2"]
        np.testing.assert_array_equal(store.get_decision("a").trace, TRACE)
        assert (store.labelled().seq.tolist(), store.last_version().version) == ([1], 1)
    assert schemas(second) == {"cell": "3", "other": "3"}
    changed = shape(second)
    execute(second, *(f"DROP TABLE {table}" for table in changed))
    SqlStore(second).close()
    assert changed == shape(second)


@pytest.mark.parametrize("brought", [str, to_schema_2], ids=["schema 1", "schema 2"])
def test_all_that_was_there_is_the_first_entry_and_what_follows_is_chained_to_it(
    brought: Callable[[str], str], old: str
) -> None:
    url = brought(old)
    for cell in CELLS:
        with SqlStore(url, cell) as store:
            store.put_event("note", "after")
    report = verify_history(url)
    assert report.ok
    assert [(cell.cell_id, cell.entries) for cell in report.cells] == [("cell", 2), ("other", 2)]
    for change in (
        "UPDATE decision SET upper = 0.99 WHERE id = 'b' AND cell_id = 'other'",
        "DELETE FROM label WHERE decision_id = 'c' AND cell_id = 'other'",
        "UPDATE setting SET value = 'a = 2' WHERE key = 'recipe' AND cell_id = 'other'",
    ):
        execute(url, change)
        found = verify_history(url)
        assert {fault.cell_id for fault in found.faults} == {"other"}


def test_the_migrations_from_nothing_make_the_tables_of_a_new_store(empty: str) -> None:
    engine = sa.create_engine(empty)
    with engine.begin() as connection:
        migrate(connection, None, "0003")
    engine.dispose()
    made = shape(empty)
    execute(empty, *(f"DROP TABLE {table}" for table in made))
    SqlStore(empty).close()
    assert made == shape(empty)


def test_alembic_is_imported_for_a_migration_alone(tmp_path: Path) -> None:
    code = (
        "import sys\nfrom dengine.store import SqlStore\n"
        "for _ in range(2): SqlStore(sys.argv[1]).close()\nprint('alembic' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "a.db")], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
