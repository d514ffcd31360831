"""What is PostgreSQL's alone; the contract itself runs on it in test_store.py. Needs DENGINE_TEST_POSTGRES."""

import os
import threading
import uuid

import numpy as np
import pytest
import sqlalchemy as sa

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
    with SqlStore(URL, uuid.uuid4().hex) as store:
        with store._database.transaction(write=False) as connection:
            victims = connection.execute(sa.text("SELECT pg_backend_pid()")).scalar_one()
        admin = sa.create_engine(URL)
        with admin.connect() as connection:
            connection.execute(sa.text("SELECT pg_terminate_backend(:pid)"), {"pid": victims})
        admin.dispose()
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
