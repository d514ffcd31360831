"""What is PostgreSQL's alone; its contract is in test_store.py, its faults in faults/.

Needs DENGINE_TEST_POSTGRES.
"""

from concurrent.futures import ThreadPoolExecutor

import pytest
import sqlalchemy as sa

from dengine.store import SqlStore, verify_history
from tests.conftest import NO_POSTGRES, POSTGRES

pytestmark = pytest.mark.skipif(not POSTGRES, reason=NO_POSTGRES)


def execute(database: str, *statements: str) -> None:
    admin = sa.create_engine(database)
    with admin.begin() as connection:
        for statement in statements:
            connection.execute(sa.text(statement))
    admin.dispose()


def test_cells_that_open_an_empty_database_at_once_all_succeed(database):
    with ThreadPoolExecutor(4) as pool:
        opened = list(pool.map(lambda i: SqlStore(database, f"cell-{i}"), range(4)))
    for store in opened:
        store.close()
    assert len(opened) == 4


def test_a_table_that_cannot_be_read_is_a_fault_and_the_others_are_read(database):
    SqlStore(database).close()
    execute(
        database,
        "ALTER TABLE trace RENAME TO damaged",
        "CREATE VIEW trace AS SELECT *, 1 / 0 FROM damaged",
    )
    (fault,) = verify_history(database).faults
    assert f"{fault.table} {fault.problem}" == "trace cannot be read to its end: division by zero"


def test_the_short_url_uses_psycopg_3(database):
    with SqlStore(database.replace("postgresql+psycopg", "postgresql")) as store:
        assert store.settings.read() == {}


def test_other_programs_tables_may_stand_beside_ours(database):
    execute(database, "CREATE TABLE someone_elses (id int)")
    SqlStore(database).close()
