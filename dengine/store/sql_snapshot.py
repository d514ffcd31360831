"""A store read as it is at one moment: of all cells, changing nothing, while engines go on writing to it."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from ..errors import StoreError
from .sql_engine import advice, make_engine
from .sql_tables import METADATA, MIGRATION, SCHEMA, held_schema

TABLES = {name: table for name, table in METADATA.tables.items() if name != MIGRATION.name}  # of cells
CHUNK = 500  # rows fetched at a time


@contextmanager
def snapshot(url: str) -> Iterator[sa.Connection]:
    """Connect to a store of the present schema, and see it as it is now. StoreError where there is none."""
    engine = make_engine(url)
    name = engine.url.render_as_string(hide_password=True)
    sqlite = engine.dialect.name == "sqlite"
    if sqlite and not Path(str(engine.url.database)).is_file():
        engine.dispose()
        raise StoreError(f"Expected a store that an engine has used, found no file {engine.url.database}; name another.")
    if sqlite:
        sa.event.listen(engine, "connect", _take_any_text)
    options = {} if sqlite else {"isolation_level": "REPEATABLE READ", "postgresql_readonly": True}
    try:
        with engine.connect() as connection:  # rolled back at its end: there is nothing to commit
            connection.execution_options(**options)
            _check(connection, name)
            yield connection
    except (sa.exc.SQLAlchemyError, sqlite3.Error, OSError, UnicodeDecodeError) as error:  # the last of damaged names
        raise StoreError(f"Could not read {name}: {getattr(error, 'orig', None) or error}. {advice(error)}") from error
    finally:
        engine.dispose()


def _take_any_text(connection: Any, record: Any) -> None:
    """Read a text of which a byte was damaged too, so that it can be named."""
    connection.text_factory = lambda text: text.decode("utf-8", "backslashreplace")


def _check(connection: sa.Connection, name: str) -> None:
    held = held_schema(connection, set(sa.inspect(connection).get_table_names()))
    if held != f"schema {SCHEMA}":
        raise StoreError(
            f"Expected a dengine store of schema {SCHEMA}, found {held} in {name}; "
            "open an older one once, as `dengine status` does, to bring it up to date."
        )
    for table in TABLES.values():
        missing = set(table.c.keys()) - {column["name"] for column in sa.inspect(connection).get_columns(table.name)}
        if missing:
            raise StoreError(f"Expected columns {sorted(missing)} of {table.name} in {name}; restore it from a copy.")


def cells_of(connection: sa.Connection) -> list[str]:
    """Return the cells that any table names, in order; of a table that is damaged nothing is asked."""
    cells: set[str] = set()
    for table in TABLES.values():
        with _damage_aside(connection):
            cells |= {str(cell) for cell in connection.execute(sa.select(table.c.cell_id).distinct()).scalars()}
    return sorted(cells)


@contextmanager
def _damage_aside(connection: sa.Connection) -> Iterator[None]:
    """Go on after a table of a file that cannot be read; on PostgreSQL the whole transaction is over then."""
    try:
        yield
    except sa.exc.DatabaseError:
        if connection.dialect.name != "sqlite":
            raise


def chosen_cells(connection: sa.Connection, cell_id: str | None) -> list[str]:
    """Return the cells that are asked for, None: all. StoreError for one that the store does not know."""
    cells = cells_of(connection)
    if cell_id is not None and cell_id not in cells:
        raise StoreError(f"Expected a cell of the store ({', '.join(cells) or 'none'}), got {cell_id!r}; name one of them.")
    return cells if cell_id is None else [cell_id]


def raw_rows(connection: sa.Connection, table: str, cell_id: str) -> Iterator[dict[str, Any]]:
    """Yield a cell's rows of a table as the database holds them, without what SQLAlchemy makes of them."""
    found = connection.execute(  # text: no type is known, none is converted
        sa.text(f'SELECT * FROM "{table}" WHERE cell_id = :cell').execution_options(yield_per=CHUNK), {"cell": cell_id}
    )
    for row in found:
        yield dict(row._mapping)


def count_rows(url: str, cell_id: str | None = None) -> int:
    """Return how many rows a store holds, of one cell or of all; those of a damaged table are not counted."""
    n = 0
    with snapshot(url) as connection:
        chosen_cells(connection, cell_id)
        for table in TABLES.values():
            query = sa.select(sa.func.count()).select_from(table)
            with _damage_aside(connection):
                n += connection.execute(query if cell_id is None else query.where(table.c.cell_id == cell_id)).scalar_one()
    return n
