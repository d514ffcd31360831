"""How SQLite finds what a store asks for, by the plan of every query on its way to the database."""

import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import sqlalchemy as sa


@contextmanager
def along_indexes(database: Path, never: str) -> Iterator[list[str]]:
    """Assert that the plan of no SELECT of the block has a step with one of these words; gives the
    list that the SELECTs fill.
    """
    sent: list[str] = []
    parameters: list[object] = []

    def catch(connection, cursor, statement, values, *_) -> None:
        if statement.startswith("SELECT"):
            sent.append(statement)
            parameters.append(values)

    sa.event.listen(sa.Engine, "before_cursor_execute", catch)
    try:
        yield sent
    finally:
        sa.event.remove(sa.Engine, "before_cursor_execute", catch)
    with closing(sqlite3.connect(database)) as plain:
        for query in zip(sent, parameters, strict=True):
            plan = [row[-1] for row in plain.execute("EXPLAIN QUERY PLAN " + query[0], query[1])]
            assert plan, query
            assert not re.search(never, str(plan)), (query, plan)
