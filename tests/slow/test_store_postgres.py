"""What is PostgreSQL's alone; the contract itself runs on it in test_store.py. Needs DENGINE_TEST_POSTGRES."""

import os
import signal
import threading
import time
import uuid
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa

from dengine import DataEngine, Policy, Recipe, ReplayCell
from dengine.errors import StoreError
from dengine.records import Action, Decision, Reason, Source
from dengine.store import SqlStore

URL = os.environ.get("DENGINE_TEST_POSTGRES", "")
pytestmark = pytest.mark.skipif(not URL, reason="DENGINE_TEST_POSTGRES is unset: . .ci/postgres.sh")


def decision(name: str) -> Decision:
    return Decision(name, Action.VERIFY, Action.VERIFY, 0.0, 1.0, 0, 0, None, 0, Reason.NO_MODEL, False, 1.0)


def test_cells_that_open_an_empty_database_at_once_all_succeed() -> None:
    admin = sa.create_engine(URL, isolation_level="AUTOCOMMIT")
    name = f"fresh_{uuid.uuid4().hex}"
    with admin.connect() as connection:
        connection.execute(sa.text(f"CREATE DATABASE {name}"))
    fresh = sa.make_url(URL).set(database=name).render_as_string(hide_password=False)
    opened: list[SqlStore] = []
    threads = [threading.Thread(target=lambda i=i: opened.append(SqlStore(fresh, f"cell-{i}"))) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for store in opened:
        store.close()
    with admin.connect() as connection:
        connection.execute(sa.text(f"DROP DATABASE {name}"))
    admin.dispose()
    assert len(opened) == 4


def test_a_lost_connection_loses_nothing() -> None:
    name = uuid.uuid4().hex
    with SqlStore(f"{URL}?application_name={name}", name) as store:
        assert store.settings() == {}
        assert cut(name)
        store.put_decision(decision("a"), np.zeros((1, 5), np.float32), 1, False)
        assert store.put_label("a", True, Source.VERIFICATION, 0, None) == 1


def test_the_short_url_uses_psycopg_3() -> None:
    with SqlStore(URL.replace("postgresql+psycopg", "postgresql"), uuid.uuid4().hex) as store:
        assert store.settings() == {}


def test_a_server_that_is_not_there_is_a_store_error_without_the_password() -> None:
    with pytest.raises(StoreError, match="Could not open") as caught:
        SqlStore("postgresql+psycopg://u:secret@127.0.0.1:1/db")
    assert "secret" not in str(caught.value)


def test_other_programs_tables_may_stand_beside_ours() -> None:
    admin = sa.create_engine(URL)
    with admin.begin() as connection:
        connection.execute(sa.text("CREATE TABLE IF NOT EXISTS someone_elses (id int)"))
    admin.dispose()
    SqlStore(URL, uuid.uuid4().hex).close()


def cut(name: str) -> list[bool]:
    """End the server's processes for a program."""
    admin = sa.create_engine(URL)
    with admin.connect() as connection:
        named = sa.text("SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE application_name LIKE :name")
        ended = list(connection.execute(named, {"name": f"{name}%"}).scalars())
    admin.dispose()
    return ended


# ---------------------------------------------------------------------------------------------- an engine on a server


OWN = f"dengine process {os.getpid()} on"  # what an engine of this process writes through is called


@pytest.fixture
def cell() -> str:
    return f"cell-{uuid.uuid4().hex[:8]}"


@pytest.fixture(autouse=True)
def own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


def engine_of(cell: str) -> DataEngine:
    recipe = Recipe("pca", radius=0.5, retrain_every=40, policy=Policy(alpha=0.1, lower_bound=0.9))
    return DataEngine(recipe=recipe, store=SqlStore(URL, cell, wait=0.3))


def until_back(engine: DataEngine) -> None:
    end = time.monotonic() + 30
    while engine.store_fault:
        assert time.monotonic() < end, engine.store_fault
        time.sleep(0.05)


def backend() -> int:
    """The server's process that the engine writes through."""
    admin = sa.create_engine(URL)
    with admin.connect() as connection:
        named = sa.text("SELECT pid FROM pg_stat_activity WHERE application_name LIKE :name")
        (pid,) = connection.execute(named, {"name": f"{OWN}%"}).scalars()
    admin.dispose()
    return int(pid)


def test_one_engine_owns_a_cell_on_a_server_also_without_its_journal(cell: str, tmp_path: Path) -> None:
    with engine_of(cell):
        with pytest.raises(StoreError, match="owns"):
            DataEngine.open(SqlStore(URL, cell))
        os.environ["XDG_STATE_HOME"] = str(tmp_path / "another machine")
        with pytest.raises(StoreError, match=f"dengine process {os.getpid()} .*owns cell '{cell}'"):
            DataEngine.open(SqlStore(URL, cell))
        with engine_of(cell + "-2"):
            pass
    DataEngine.open(SqlStore(URL, cell)).close()


def test_a_frozen_server_makes_nobody_wait_and_each_cell_goes_on_deciding(make_data, cell: str) -> None:
    data = make_data(400, samples=60, seed=3)
    with engine_of(cell) as engine:
        list(engine.run(ReplayCell(data, np.arange(200)), 200))
        pid = backend()
        try:
            os.kill(pid, signal.SIGSTOP)
        except PermissionError:
            pytest.skip("the server's processes are somebody else's")
        try:
            begin = time.monotonic()
            cycles = list(engine.run(ReplayCell(data, np.arange(200, 260)), 60))
            seconds = time.monotonic() - begin
        finally:
            os.kill(pid, signal.SIGCONT)
        assert seconds < 10  # without a limit: for ever
        assert any(cycle.decision.action is Action.ACCEPT for cycle in cycles)
        assert Reason.NO_STORE not in {cycle.decision.reason for cycle in cycles}
        until_back(engine)
        for each in cycles:
            if each.success is not None:
                assert engine.store.get_decision(each.decision.id).success is each.success


def test_a_lost_connection_is_made_again_with_its_lease_and_loses_no_label(make_data, cell: str) -> None:
    data = make_data(400, samples=60, seed=3)
    with engine_of(cell) as engine:
        cycles = list(engine.run(ReplayCell(data, np.arange(100)), 100))
        for first in range(100, 200, 25):
            assert cut(OWN)
            cycles += engine.run(ReplayCell(data, np.arange(first, first + 25)), 25)
            until_back(engine)
        expected = [engine.decide(x).lower for x in data.X[-20:]]
    with DataEngine.open(SqlStore(URL, cell)) as again:
        assert [again.decide(x).lower for x in data.X[-20:]] == expected
        said = {each.decision.id: each.success for each in cycles if each.success is not None}
        assert {name: again.store.get_decision(name).success for name in said} == said


def test_an_engine_closed_while_its_server_was_frozen_leaves_the_cell_to_the_next_one(make_data, cell: str) -> None:
    data = make_data(400, samples=60, seed=3)
    engine = engine_of(cell)
    cycles = list(engine.run(ReplayCell(data, np.arange(60)), 60))
    pid = backend()
    try:
        os.kill(pid, signal.SIGSTOP)
    except PermissionError:
        pytest.skip("the server's processes are somebody else's")
    try:
        cycles += engine.run(ReplayCell(data, np.arange(60, 90)), 30)
        engine.close()
    finally:
        os.kill(pid, signal.SIGCONT)
    for thread in threading.enumerate():
        if thread.name == "dengine-store":
            thread.join(20.0)
            assert not thread.is_alive()
    end = time.monotonic() + 10.0
    while True:
        try:
            again = DataEngine.open(SqlStore(URL, cell))
            break
        except StoreError:  # the server has not noticed yet that the session is over
            assert time.monotonic() < end
            time.sleep(0.2)
    with again:
        said = {each.decision.id: each.success for each in cycles if each.success is not None}
        assert {name: again.store.get_decision(name).success for name in said} == said
