"""One engine owns a cell of a database: the lease, and what its journal held back, written when the database is there."""

from __future__ import annotations

import hashlib
import math
import os
import urllib.parse
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

import sqlalchemy as sa

from ..errors import StoreError
from ..records import Source
from ..wording import shortened
from .journal import Journal, owned_by, owner
from .journal_records import LateEvent, LateLabel, Record
from .records import DecidedTrace
from .sql_queries import held_query
from .sql_queue import SqlDatabase
from .sql_rows import chunks, event_row, label_row
from .sql_tables import EVENT, LABEL

WAIT = 0.4  # seconds that an engine waits for the database
WAIT_VARIABLE = "DENGINE_STORE_WAIT"  # of the environment: other seconds for all stores that are given none
Arrived = tuple[str, int]  # a decision's id, the number of its label


def checked_wait(wait: float | None) -> float:
    """Return the seconds that an engine waits for its store; None: as the environment says, or 0.4. StoreError for less."""
    said = os.environ.get(WAIT_VARIABLE) if wait is None else None
    name = "a wait" if said is None else WAIT_VARIABLE
    try:
        seconds = float(said) if said else WAIT if wait is None else wait
    except ValueError:
        seconds = math.nan
    if not 0.0 < seconds < math.inf:
        raise StoreError(f"Expected {name} above 0 seconds, got {shortened(said or wait)}; {WAIT} is the default.")
    return seconds


def journal_path(url: sa.URL, cell_id: str) -> Path:
    """Return where a cell's journal lies: beside an SQLite file, else in the user's folder of state, `XDG_STATE_HOME`."""
    name = urllib.parse.quote(cell_id, safe="")
    if url.get_backend_name() == "sqlite":
        return Path(f"{Path(str(url.database)).absolute()}.{name}.journal")
    state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "dengine"
    where = hashlib.sha256(f"{url.host}:{url.port}/{url.database}/{cell_id}".encode()).hexdigest()[:12]
    return state / f"{name[:60]}.{where}.journal"


def lease_key(cell_id: str) -> int:
    """Return the number of a cell's advisory lock in a PostgreSQL database."""
    return int.from_bytes(hashlib.sha256(b"dengine " + cell_id.encode()).digest()[:8], "big", signed=True)


def take_lease(connection: sa.Connection, cell_id: str, name: str) -> None:
    """Lock a cell for as long as this PostgreSQL connection lives; StoreError where another engine has it."""
    connection.execute(sa.text("SELECT set_config('application_name', :who, false)"), {"who": f"dengine {owner()}"[:63]})
    key = lease_key(cell_id)
    if connection.execute(sa.text("SELECT pg_try_advisory_lock(:key)"), {"key": key}).scalar():
        return
    asked = sa.text(
        "SELECT a.application_name FROM pg_locks l JOIN pg_stat_activity a USING (pid) WHERE l.locktype = 'advisory' "
        "AND (l.classid::bigint << 32) + l.objid::bigint = :key AND l.objsubid = 1 AND l.granted"
    )
    holder = connection.execute(asked, {"key": key}).scalar()
    raise owned_by(str(holder or "another engine"), f"cell {cell_id!r} of {name}")


class SqlOwning:
    """What a store in a database does for the one engine that owns its cell."""

    cell_id: str
    _database: SqlDatabase
    _journal: Journal | None = None

    @property
    def remote(self) -> bool:
        """Whether the database is on a server, which may be away while this machine's disk is well."""
        return self._database.url.get_backend_name() != "sqlite"

    def committing(self, wanted: Callable[[], bool]) -> AbstractContextManager[None]:
        """Within this, in this thread, a transaction that is not wanted any more when it would commit is rolled back."""
        return self._database.committing(wanted)

    def own(self) -> Journal:
        """Claim the cell for one engine; StoreError where another one has it, on this or another machine."""
        journal = Journal(journal_path(self._database.url, self.cell_id))
        try:
            if self.remote:
                self._database.lease(lambda connection: take_lease(connection, self.cell_id, self._database.name))
        except StoreError:
            journal.close()
            raise
        self._journal = journal
        return journal

    def close(self) -> None:
        """Flush, stop the writer and disconnect; if the flush fails the store stays open, so close it again later."""
        self._database.close()
        if self._journal is not None:
            self._journal.close()

    def let_go(self) -> None:
        """Stop and disconnect without writing or waiting: the journal holds what is missing."""
        self._database.let_go()

    def play_back(self, records: Sequence[Record]) -> tuple[list[Arrived], list[str]]:
        """Write what a journal held, in one transaction; what is stored already counts as written, for its answer got lost.

        Returns the numbers of the labels by their decisions, and what could not be written, in words.
        """
        decisions = [record for record in records if isinstance(record, DecidedTrace)]
        labels = [record for record in records if isinstance(record, LateLabel)]
        events = [record for record in records if isinstance(record, LateEvent)]

        def write(connection: sa.Connection) -> tuple[list[Arrived], list[str]]:
            self._database.insert_new(connection, decisions)
            _write_events(self._database, connection, events)
            return _write_labels(self._database, connection, labels)

        return self._database.write(write)


def _write_events(database: SqlDatabase, connection: sa.Connection, events: Sequence[LateEvent]) -> None:
    number = database.next_number(connection, EVENT.c.number)
    for event in events:
        if _is_new(connection, database.cell_id, event):
            row = event_row(database.cell_id, number, event.time, event.kind, event.text)
            connection.execute(sa.insert(EVENT), row)
            number += 1


def _write_labels(
    database: SqlDatabase, connection: sa.Connection, labels: Sequence[LateLabel]
) -> tuple[list[Arrived], list[str]]:
    number = database.next_number(connection, LABEL.c.seq)
    ids = [late.label.decision_id for late in labels]
    held = {row.id: row for part in chunks(ids) for row in connection.execute(held_query(database.cell_id, part))}
    arrived: list[Arrived] = []
    refused: list[str] = []
    said: dict[str, tuple[bool, str]] = {
        name: (row.success, row.source) for name, row in held.items() if row.source is not None
    }
    for late in labels:
        label, row = late.label, held.get(late.label.decision_id)
        now = (label.success, label.source.value)
        if row is None:
            refused.append(f"a label on {label.decision_id!r}, which the store does not hold: {_words(*now)}")
        elif said.setdefault(label.decision_id, now) != now:
            first = said[label.decision_id]
            refused.append(f"a second label on {label.decision_id!r}: {_words(*now)} after {_words(*first)}")
        elif row.source is not None or label.decision_id in {name for name, _ in arrived}:
            arrived.append((label.decision_id, _number_of(database, connection, label.decision_id)))
        else:
            values = label_row(database.cell_id, label, number, late.time, row.content_hash, row.quarantined)
            connection.execute(sa.insert(LABEL), values)
            arrived.append((label.decision_id, number))
            number += 1
    return arrived, refused


def _words(success: bool, source: str) -> str:
    return f"{'success' if success else 'failure'} from {Source(source).value}"


def _number_of(database: SqlDatabase, connection: sa.Connection, decision_id: str) -> int:
    mine = (LABEL.c.cell_id == database.cell_id) & (LABEL.c.decision_id == decision_id)
    return int(connection.execute(sa.select(LABEL.c.seq).where(mine)).scalar_one())


def _is_new(connection: sa.Connection, cell_id: str, event: LateEvent) -> bool:
    same = (EVENT.c.cell_id == cell_id) & (EVENT.c.time == event.time) & (EVENT.c.kind == event.kind)
    return connection.execute(sa.select(EVENT.c.number).where(same, EVENT.c.text == event.text)).first() is None
