"""How SQLite finds what a store asks for: the plan of every query, caught on its way to the
database.
"""

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa


@contextmanager
def plans(database: Path) -> Iterator[list[tuple[str, list[str]]]]:
    """Fill a list, once its block has ended, with the SELECTs that were sent in it and the steps of
    their plans.
    """
    sent: list[tuple[str, Any]] = []
    results: list[tuple[str, list[str]]] = []

    def catch(
        connection: Any, cursor: Any, statement: str, parameters: Any, context: Any, many: bool
    ) -> None:
        if statement.startswith("SELECT"):
            sent.append((statement, parameters))

    sa.event.listen(sa.Engine, "before_cursor_execute", catch)
    try:
        yield results
    finally:
        sa.event.remove(sa.Engine, "before_cursor_execute", catch)
    plain = sqlite3.connect(database)
    for statement, parameters in sent:
        rows = plain.execute(f"EXPLAIN QUERY PLAN {statement}", parameters).fetchall()
        results.append((statement, [row[-1] for row in rows]))
    plain.close()
