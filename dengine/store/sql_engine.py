"""Connections to SQLite and PostgreSQL: how they are made, and what to do about their errors."""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from ..errors import StoreError
from ..wording import shortened
from .checks import as_text

# Of a server that answers no more, libpq says so after some seconds, not hours.
PATIENCE = {
    "connect_timeout": 5,
    "keepalives_idle": 5,
    "keepalives_interval": 2,
    "keepalives_count": 3,
    "tcp_user_timeout": 10000,
}
BUSY = 10.0  # seconds to wait for another process that writes to the same SQLite file


def make_engine(url: str) -> sa.Engine:
    """Return an engine for a file or URL; refuses what this store was never tested on."""
    if as_text(url) != url:
        raise StoreError(
            f"Expected a file or a database URL of UTF-8 characters without a NUL, got {shortened(url)}; rename it."
        )
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
            return sa.create_engine(parsed, pool_pre_ping=True, connect_args=PATIENCE)
        engine = sa.create_engine(parsed, connect_args={"timeout": BUSY})
    except (sa.exc.ArgumentError, ImportError) as error:
        raise _unusable(url, f"{error}") from error
    except ValueError as error:
        if "@" not in url:
            raise _unusable(url, f"{error}") from error
        # What it quotes, and takes for a port, may be half of a password.
        raise _unusable(url, "it cannot be read; write @, : and / in a password as %40, %3A and %2F") from None
    sa.event.listen(engine, "connect", _set_pragmas)
    sa.event.listen(engine, "begin", _begin)
    return engine


class WatchedFile:
    """The file of an SQLite database, by device and inode: a deleted or replaced one still takes writes, for nobody."""

    def __init__(self, url: sa.URL) -> None:
        self.path = Path(str(url.database)) if url.get_backend_name() == "sqlite" else None
        if self.path is not None and not self.path.is_file():
            self.path = None  # named by an URI of SQLite's own
        self._opened = None if self.path is None else self.path.stat()

    def check(self) -> None:
        """Raise an OSError where the file at the path is no longer the one that was opened."""
        if self.path is None or self._opened is None:
            return
        try:
            same = os.path.samestat(self.path.stat(), self._opened)
        except OSError:
            same = False
        if not same:
            raise FileNotFoundError("the file was deleted, moved or replaced while it was open")


def _unusable(url: str, said: str) -> StoreError:
    return StoreError(
        f"Expected a file or a database URL that can be used here, got {url.split('@')[-1]!r}: {said}. "
        "For PostgreSQL: pip install 'dengine[postgres]'."
    )


def _set_pragmas(connection: Any, record: Any) -> None:
    connection.isolation_level = None  # `_begin` says when a transaction starts, not the driver
    try:
        tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master")}
        if not tables or {"setting", "decision"} <= tables:  # another program's file is refused, and left as it is
            connection.execute("PRAGMA journal_mode = WAL")
    except UnicodeDecodeError as error:  # SQLite quotes a damaged table's name in what it says
        raise sqlite3.DatabaseError("the database is malformed") from error
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
        ("while it was open", "Put it back, or close this store and open the new one."),
        ("malformed", "The file is damaged; restore it from a copy."),
    ):
        if text in said:
            return what_to_do
    return "Check that the database is there and can be written."
