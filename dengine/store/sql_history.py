"""What a database keeps of an engine's history: versions, events, corrections. No row of it ever changes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import sqlalchemy as sa

from ..errors import StoreError
from . import sql_queries as ask
from .checks import as_data, as_text, check_state, nothing_to_correct, unknown_decision
from .records import Change, Correction, Event, as_label
from .sql_fleet import ProductShare
from .sql_rows import chunks, event_row, read_event, version_row
from .sql_tables import CORRECTION, EVENT, LABEL, RESERVED, SETTING
from .sql_versions import SqlVersions


class SqlHistory(SqlVersions, ProductShare):
    """The part of `SqlStore` that is about its history."""

    def _read(self, query: sa.Select[Any]) -> Sequence[Any]:
        with self._database.transaction(write=False) as connection:
            return connection.execute(query).all()

    # Events

    def put_event(self, kind: str, text: str, data: Mapping[str, Any] | None = None, author: str = "") -> None:
        """Commit what happened to the cell's log."""
        self.record(Change(kind, text, data, author))

    def _note(self, kind: str, text: str) -> None:
        """Commit an event, unless one of these very words is there."""
        if not self._read(ask.said_query(self.cell_id, as_text(kind), as_text(text))):
            self.put_event(kind, text)

    def events(self, limit: int | None = None) -> list[Event]:
        """Return the newest `limit` events, oldest first."""
        return [read_event(row) for row in self._read(ask.event_query(self.cell_id, limit))[::-1]]

    # Corrections

    def record(self, change: Change) -> int:
        """Commit what a person changed, in one transaction with its event, whose number it returns."""
        now, author = self._clock(), as_text(change.author)
        said = (now, as_text(change.kind), as_text(change.text), as_data(change.data), author)
        version: dict[str, Any] | None = None
        if change.version is not None:
            report, last_seq, state = change.version
            version = version_row(self.cell_id, report, int(last_seq), now, check_state(report, state))
        replace = None if change.settings is None else replacing(self.cell_id, change.settings)

        def add(connection: sa.Connection) -> int:
            number = self._database.next_number(connection, EVENT.c.number)
            connection.execute(sa.insert(EVENT), event_row(self.cell_id, number, *said))
            if change.decisions:
                self._correct(connection, change, author, number, now)
            if version is not None:
                self._add_as_numbered(connection, version)
            if change.settings is not None and replace is not None:
                self._refuse_disagreement(connection, change.settings)
                replace(connection)
            return number

        return self._database.write(add)

    def _add_as_numbered(self, connection: sa.Connection, row: dict[str, Any]) -> None:
        number = self._add_version(connection, row)
        if number != row["version"]:
            raise StoreError(
                f"Expected version {row['version']} to be the next, a sister of the product stored {number - 1} meanwhile; "
                "try it again."
            )

    def _correct(self, connection: sa.Connection, change: Change, author: str, event: int, now: float) -> None:
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
        return [Correction(*row) for row in self._read(ask.correction_query(self._database.scope, int(after)))]

    def _corrected(self) -> dict[str, int]:
        """How many decisions count otherwise than they were reported, and how many are forgotten."""
        rows = self._read(ask.corrected_query(self.cell_id))
        forgotten = sum(n for success, n in rows if success is None)
        return {"forgotten": forgotten, "corrected": sum(n for _, n in rows) - forgotten}


def replacing(cell_id: str, settings: Mapping[str, str]) -> Callable[[sa.Connection], None]:
    """What puts these settings in the place of a cell's present ones."""
    for key in sorted(settings.keys() & set(RESERVED)):
        raise StoreError(f"Expected settings of the engine, got {key!r}, which is the store's; rename it.")
    rows = [{"cell_id": cell_id, "key": key, "value": value} for key, value in settings.items()]
    mine = (SETTING.c.cell_id == cell_id) & SETTING.c.key.not_in(RESERVED)

    def replace(connection: sa.Connection) -> None:
        connection.execute(sa.delete(SETTING).where(mine))
        if rows:
            connection.execute(sa.insert(SETTING), rows)

    return replace
