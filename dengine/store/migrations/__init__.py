"""How stores of earlier schemas become one of the present: Alembic's migrations, in the transaction that opens a store.

A change of the tables in `sql_tables.py` is a new SCHEMA there and a new module in `versions/`. What stands in a migration
is what the tables were then: it never names the tables of today.
"""

from __future__ import annotations

import logging
import threading
from pathlib import Path

import sqlalchemy as sa
from alembic import command
from alembic.config import Config

log = logging.getLogger("dengine")
ONE = threading.Lock()  # Alembic's `context` is one for the whole process; two databases may be opened at once


def migrate(connection: sa.Connection, held: str | None, wanted: str) -> None:
    """Change the tables of revision `held` (None: an empty database) to those of `wanted`, as "0003".

    All of it is in the transaction that is under way: whatever ends it halfway leaves the store as it was.
    """
    config = Config(attributes={"connection": connection})
    config.set_main_option("script_location", str(Path(__file__).parent).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    with ONE:
        _run(config, held, wanted)


def _run(config: Config, held: str | None, wanted: str) -> None:
    if held is not None:  # earlier dengines kept no account of migrations: the schema says which were done
        log.info("bringing a store of revision %s to %s", held, wanted)
        command.stamp(config, held)
    command.upgrade(config, wanted)
