"""Connections to SQLite and PostgreSQL: how they are made, and what to do about their errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import sqlalchemy as sa

from ..errors import StoreError

BUSY = 10.0  # seconds to wait for another process that writes to the same SQLite file


def make_engine(url: str) -> sa.Engine:
    """Return an engine for a file or URL; refuses what this store was never tested on."""
    try:
        parsed = sa.make_url(url) if "://" in url else sa.URL.create("sqlite", database=str(Path(url)))
        if parsed.drivername in ("postgres", "postgresql"):
            parsed = parsed.set(drivername="postgresql+psycopg")
        backend = parsed.get_backend_name()
        forgets = backend == "sqlite" and parsed.database in (None, "", ":memory:")
        if forgets or backend not in ("sqlite", "postgresql"):
            raise StoreError(
                f"Expected a file, an SQLite file URL or a PostgreSQL URL, got {parsed.render_as_string()}; "
                "for a store that forgets use store=None."
            )
        if backend == "postgresql":
            return sa.create_engine(parsed, pool_pre_ping=True)
        engine = sa.create_engine(parsed, connect_args={"timeout": BUSY})
    except (sa.exc.ArgumentError, ImportError, ValueError) as error:
        raise StoreError(
            f"Expected a file or a database URL that can be used here, got {url.split('@')[-1]!r}: {error}. "
            "For PostgreSQL: pip install 'dengine[postgres]'."
        ) from error
    sa.event.listen(engine, "connect", _set_pragmas)
    sa.event.listen(engine, "begin", _begin)
    return engine


def _set_pragmas(connection: Any, record: Any) -> None:
    connection.isolation_level = None  # `_begin` says when a transaction starts, not the driver
    tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master")}
    if not tables or {"setting", "decision"} <= tables:  # another program's file is refused, and left as it is
        connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = FULL")  # a returned commit survives lost power; NORMAL would not


def _begin(connection: sa.Connection) -> None:
    # busy_timeout does not cover a read that turns into a write, so a writer takes its lock at once.
    write = connection.get_execution_options().get("dengine_write", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")


def advice(error: BaseException) -> str:
    """Say what to do about a database error, as far as its text tells."""
    said = str(error).lower()
    for text, what_to_do in (
        ("not a database", "The file is something else; name a new file, or a store that dengine wrote."),
        ("unable to open", "Create the directory, or name one that can be written."),
        ("readonly", "Make the file and its directory writable."),
        ("full", "Free some space on the disk."),
        ("locked", "Another process holds the database; close it, or wait."),
        ("malformed", "The file is damaged; restore it from a copy."),
    ):
        if text in said:
            return what_to_do
    return "Check that the database is there and can be written."
