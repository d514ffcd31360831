"""What a database keeps of an engine's history: versions, events, corrections. No row of it ever changes."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import sqlalchemy as sa
from numpy.typing import NDArray

from ..errors import StoreError
from ..records import RetrainReport
from . import sql_queries as ask
from .checks import as_data, as_text, check_state, no_such_version, nothing_to_correct, unknown_decision
from .records import Change, Correction, Event, ModelVersion, as_label
from .sql_queue import SqlDatabase
from .sql_rows import chunks, from_npz, read_event, version_row
from .sql_tables import CORRECTION, EVENT, LABEL, SCHEMA_KEY, SETTING, VERSION


class SqlHistory:
    """The part of `SqlStore` that is about its history."""

    cell_id: str
    _clock: Callable[[], float]
    _database: SqlDatabase

    def _read(self, query: sa.Select[Any]) -> Sequence[Any]:
        with self._database.transaction(write=False) as connection:
            return connection.execute(query).all()

    # Model versions

    def put_version(self, report: RetrainReport, last_seq: int, state: Mapping[str, NDArray[Any]] | None) -> None:
        """Commit a retrain; a dropped candidate has no state."""
        row = version_row(self.cell_id, report, int(last_seq), self._clock(), check_state(report, state))
        self._database.write(lambda connection: self._add_version(connection, row))

    def _add_version(self, connection: sa.Connection, row: dict[str, Any]) -> None:
        retrain = self._database.next_number(connection, VERSION.c.retrain)
        connection.execute(sa.insert(VERSION), row | {"retrain": retrain})

    def last_version(self) -> ModelVersion | None:
        """Return the newest accepted version."""
        rows = self._read(ask.version_query(self.cell_id))
        return self._version(rows[0]) if rows else None

    def load_version(self, number: int) -> ModelVersion:
        """Return the accepted version of this number; StoreError where none is kept."""
        rows = self._read(ask.version_query(self.cell_id, int(number)))
        if not rows or rows[0].state is None:
            kept = sa.select(VERSION.c.version).where(VERSION.c.cell_id == self.cell_id, VERSION.c.accepted == sa.true())
            kept = kept.where(VERSION.c.state.is_not(None)).order_by(VERSION.c.version)
            raise no_such_version(number, [row.version for row in self._read(kept)])
        return self._version(rows[0])

    def _version(self, row: Any) -> ModelVersion:
        return ModelVersion(row.version, row.last_seq, from_npz(row.state, self._database.name))

    def retrains(self) -> list[RetrainReport]:
        """Return every retrain, oldest first."""
        return [RetrainReport(*row) for row in self._read(ask.retrain_query(self.cell_id))]

    # Events

    def put_event(self, kind: str, text: str, data: Mapping[str, Any] | None = None, author: str = "") -> None:
        """Commit what happened to the cell's log."""
        self.record(Change(kind, text, data, author))

    def events(self, limit: int | None = None) -> list[Event]:
        """Return the newest `limit` events, oldest first."""
        return [read_event(row) for row in self._read(ask.event_query(self.cell_id, limit))[::-1]]

    # Corrections

    def record(self, change: Change) -> int:
        """Commit what a person changed, in one transaction with its event, whose number it returns."""
        data, now = as_data(change.data), self._clock()
        event: dict[str, Any] = {
            "cell_id": self.cell_id,
            "time": now,
            "kind": as_text(change.kind),
            "text": as_text(change.text),
            "data": None if data is None else json.dumps(data),
            "author": as_text(change.author),
        }
        version: dict[str, Any] | None = None
        if change.version is not None:
            report, last_seq, state = change.version
            version = version_row(self.cell_id, report, int(last_seq), now, check_state(report, state))
        replace = None if change.settings is None else replacing(self.cell_id, change.settings)

        def add(connection: sa.Connection) -> int:
            number = self._database.next_number(connection, EVENT.c.number)
            connection.execute(sa.insert(EVENT), event | {"number": number})
            if change.decisions:
                self._correct(connection, change, event["author"], number, now)
            if version is not None:
                self._add_version(connection, version)
            if replace is not None:
                replace(connection)
            return number

        return self._database.write(add)

    def _correct(self, connection: sa.Connection, change: Change, author: str | None, event: int, now: float) -> None:
        found = [row for part in chunks(change.decisions) for row in connection.execute(ask.held_query(self.cell_id, part))]
        was = {row.id: row.counted for row in found}
        for name in change.decisions:
            if name not in was:
                raise unknown_decision(name)
            if was[name] is None:
                raise nothing_to_correct(name)
        first = self._database.next_number(connection, CORRECTION.c.number)
        newest = self._database.next_number(connection, LABEL.c.seq) - 1
        said = {"success": change.success, "author": author, "event": event, "newest_seq": newest, "time": now}
        rows = [
            said | {"cell_id": self.cell_id, "number": first + i, "decision_id": name, "was": as_label(was[name])}
            for i, name in enumerate(change.decisions)
        ]
        for part in chunks(rows):
            connection.execute(sa.insert(CORRECTION), part)

    def corrections(self, after: int = 0) -> list[Correction]:
        """Return the corrections after number `after`, oldest first."""
        return [Correction(*row) for row in self._read(ask.correction_query(self.cell_id, int(after)))]

    def _corrected(self) -> dict[str, int]:
        """How many decisions count otherwise than they were reported, and how many are forgotten."""
        rows = self._read(ask.corrected_query(self.cell_id))
        forgotten = sum(n for success, n in rows if success is None)
        return {"forgotten": forgotten, "corrected": sum(n for _, n in rows) - forgotten}


def replacing(cell_id: str, settings: Mapping[str, str]) -> Callable[[sa.Connection], None]:
    """What puts these settings in the place of a cell's present ones."""
    if SCHEMA_KEY in settings:
        raise StoreError(f"Expected settings of the engine, got {SCHEMA_KEY!r}, which is the store's; rename it.")
    rows = [{"cell_id": cell_id, "key": key, "value": value} for key, value in settings.items()]
    mine = (SETTING.c.cell_id == cell_id) & (SETTING.c.key != SCHEMA_KEY)

    def replace(connection: sa.Connection) -> None:
        connection.execute(sa.delete(SETTING).where(mine))
        if rows:
            connection.execute(sa.insert(SETTING), rows)

    return replace
