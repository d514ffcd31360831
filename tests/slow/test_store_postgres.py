"""What is PostgreSQL's alone; its contract is in test_store.py, its faults in faults/.

Needs DENGINE_TEST_POSTGRES.
"""

import os
import uuid
from concurrent.futures import ThreadPoolExecutor

import pytest
import sqlalchemy as sa

from dengine.store import SqlStore, verify_history

URL = os.environ.get("DENGINE_TEST_POSTGRES", "")
pytestmark = pytest.mark.skipif(not URL, reason="DENGINE_TEST_POSTGRES is unset: . .ci/postgres.sh")


def test_cells_that_open_an_empty_database_at_once_all_succeed(database):
    with ThreadPoolExecutor(4) as pool:
        opened = list(pool.map(lambda i: SqlStore(database, f"cell-{i}"), range(4)))
    for store in opened:
        store.close()
    assert len(opened) == 4


def test_a_table_that_cannot_be_read_is_a_fault_and_the_others_are_read(database):
    SqlStore(database).close()
    admin = sa.create_engine(database)
    with admin.begin() as connection:
        connection.execute(sa.text("ALTER TABLE trace RENAME TO damaged"))
        connection.execute(sa.text("CREATE VIEW trace AS SELECT *, 1 / 0 FROM damaged"))
    admin.dispose()
    (fault,) = verify_history(database).faults
    assert (fault.table, "by zero" in fault.problem) == ("trace", True)


def test_the_short_url_uses_psycopg_3():
    with SqlStore(URL.replace("postgresql+psycopg", "postgresql"), uuid.uuid4().hex) as store:
        assert store.settings.read() == {}


def test_other_programs_tables_may_stand_beside_ours():
    admin = sa.create_engine(URL)
    with admin.begin() as connection:
        connection.execute(sa.text("CREATE TABLE IF NOT EXISTS someone_elses (id int)"))
    admin.dispose()
    SqlStore(URL, uuid.uuid4().hex).close()
