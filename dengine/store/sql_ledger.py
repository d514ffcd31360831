"""The ledger of a cell: every transaction that adds rows, or changes settings, ends with an entry that chains them.

A statement that inserts into a table of CHAINED is met on its way to the database: its rows get the number of the entry
and a sum of their own, whoever sends it. So no writer has to remember the ledger, and none can go around it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import sqlalchemy as sa

from ..errors import StoreError
from .chain import START, added_text, entry_digest, plain_row, row_sum, settings_text, state_sum
from .sql_tables import CHAINED, LEDGER, RESERVED, SCHEMA_KEY, SETTING

DOUBLES = {
    name: tuple(column.name for column in table.c if isinstance(column.type, sa.Double)) for name, table in CHAINED.items()
}
Row = Mapping[str, Any]


class LedgerEntry:
    """The entry that a transaction under way will end with; nothing is asked or written where it adds no row.

    cell_id : whose ledger.  clock : the time in seconds that the entry is stamped with.
    """

    def __init__(self, cell_id: str, clock: Callable[[], float]) -> None:
        self.cell_id = cell_id
        self._clock = clock
        self._number = 0  # 0: not begun
        self._previous = START
        self._sums: dict[str, list[bytes]] = {}
        self._settings = False

    def take(self, connection: sa.Connection, table: str, rows: Sequence[Row]) -> list[dict[str, Any]]:
        """Return rows on their way into a table with the number of the entry, and each with its sum."""
        self._begin(connection)
        taken = [self._summed(table, row) for row in rows]
        self._sums.setdefault(table, []).extend(row["sum"] for row in taken)
        return taken

    def _summed(self, table: str, row: Row) -> dict[str, Any]:
        full = {**row, "entry": self._number}
        for name in DOUBLES[table]:  # an integer comes back as a float
            if name in full and type(full[name]) is not float:
                full[name] = None if full[name] is None else float(full[name])
        if "state" in row:
            full["state_sum"] = state_sum(row["state"])
        try:
            full["sum"] = row_sum(table, full)
        except TypeError:
            full = plain_row(full)
            full["sum"] = row_sum(table, full)
        return full

    def take_settings(self, connection: sa.Connection) -> None:
        """Note that the settings change."""
        self._begin(connection)
        self._settings = True

    def _begin(self, connection: sa.Connection) -> None:
        """Lock the cell, before the newest entry is read: two processes may write to it."""
        if self._number:
            return
        if connection.dialect.name == "postgresql":  # SQLite's BEGIN IMMEDIATE did it already
            mine = (SETTING.c.cell_id == self.cell_id) & (SETTING.c.key == SCHEMA_KEY)
            connection.execute(sa.select(SETTING.c.key).where(mine).with_for_update())
        newest = sa.select(LEDGER.c.number, LEDGER.c.digest).where(LEDGER.c.cell_id == self.cell_id)
        last = connection.execute(newest.order_by(LEDGER.c.number.desc()).limit(1)).first()
        self._number, self._previous = (1, START) if last is None else (last.number + 1, last.digest)

    def append(self, connection: sa.Connection) -> None:
        """Write the entry, as the last of the transaction."""
        if self._number:
            settings = settings_text(held_settings(connection, self.cell_id)) if self._settings else None
            row = new_entry(self.cell_id, self._number, self._previous, self._clock(), self._sums, settings)
            connection.execute(sa.insert(LEDGER), row)


def new_entry(
    cell_id: str, number: int, previous: bytes, time: float, sums: Mapping[str, Sequence[bytes]], settings: str | None
) -> dict[str, Any]:
    """Return the row of an entry: it follows `previous`, and chains the rows that `sums` are of."""
    head = {"cell_id": cell_id, "number": number, "time": float(time), "added": added_text(sums), "settings": settings}
    return head | {"digest": entry_digest(previous, head, sums)}


def held_settings(connection: sa.Connection, cell_id: str) -> dict[str, str]:
    """Return a cell's settings, without the store's own."""
    query = sa.select(SETTING.c.key, SETTING.c.value).where(SETTING.c.cell_id == cell_id, SETTING.c.key.not_in(RESERVED))
    return {row.key: row.value for row in connection.execute(query)}


def chain_writes(engine: sa.Engine) -> None:
    """Let all that is written through an engine, in transactions with an entry, be chained."""
    sa.event.listen(engine, "before_execute", _meet, retval=True)


Met = tuple[Any, Sequence[Row], Row]


def _meet(connection: sa.Connection, statement: Any, many: Sequence[Row], one: Row, options: Mapping[str, Any]) -> Met:
    """See what is about to be executed: rows for a chained table are taken into the entry of the transaction."""
    entry = connection.get_execution_options().get("dengine_entry")
    if entry is None or not isinstance(statement, sa.Insert | sa.Update | sa.Delete):
        return statement, many, one
    table = statement.table.name if isinstance(statement.table, sa.Table) else ""
    if table == SETTING.name:
        entry.take_settings(connection)
    if table not in CHAINED or not isinstance(statement, sa.Insert):
        return statement, many, one
    if not (many or one):
        raise StoreError(f"Expected the rows of {table} beside the statement, got none; execute(insert(table), rows).")
    taken = entry.take(connection, table, many or [one])
    return (statement, taken, {}) if many else (statement, (), taken[0])
