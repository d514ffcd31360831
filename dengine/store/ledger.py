"""The ledger of a cell: every transaction that adds rows, or changes settings, ends with an entry that chains them.

A statement that inserts into a table of CHAINED is met on its way to the database: its rows get the number of the entry
and a sum of their own, whoever sends it. So no writer has to remember the ledger, and none can go around it.

What a row's sum is must never change. So a column without a value is not in it, and columns are taken by name: a later
schema may add columns that are empty in earlier rows.
"""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import sqlalchemy as sa

from ..errors import StoreError
from .queries import Scope
from .schema import CHAINED, LEDGER, RESERVED, SETTING

START = bytes(32)  # what the first entry of a cell follows
APART = {"sum", "state"}  # columns that a row's sum leaves out: itself, and a state, which may go: `state_sum` covers it


def row_sum(table: str, row: Mapping[str, Any]) -> bytes:
    """Return the SHA-256 of a row, 32 bytes: of the table's name, and name, type and bytes of every value.

    The same on SQLite and PostgreSQL, as written and as read: true is 1 (SQLite has no booleans), NaN is nothing and -0.0
    is 0.0 (SQLite keeps neither).
    """
    pieces = [table.encode(), b"\n"]
    for name, begin in _columns(tuple(row)):  # the commonest kinds in line: a thousand rows a second pass here
        value = row[name]
        kind = type(value)
        if value is None or value != value:
            continue
        if kind is int or kind is bool:
            pieces.append(b"%bi%d;" % (begin, value))
        elif kind is str:
            data = value.encode("utf-8", "surrogatepass")  # never raises; two texts never share their bytes
            pieces += (b"%bs%d:" % (begin, len(data)), data)
        elif kind is float:
            pieces += (begin, b"f", _DOUBLE(value + 0.0))
        elif kind is bytes:
            pieces += (b"%bb%d:" % (begin, len(value)), value)
        else:
            raise TypeError(f"Expected a plain value of column {name!r}, got {kind.__name__}; see `to_row`.")
    return hashlib.sha256(b"".join(pieces)).digest()


@lru_cache(256)
def _columns(names: tuple[str, ...]) -> list[tuple[str, bytes]]:
    return [(name, name.encode() + b"=") for name in sorted(names) if name not in APART]


_DOUBLE = struct.Struct(">d").pack


def is_sound(table: str, row: Mapping[str, Any]) -> bool:
    """Whether a row, its sum among its columns, is as it was stored."""
    return bool(row_sum(table, row) == row["sum"])


def state_sum(state: bytes | None) -> bytes | None:
    """Return the SHA-256 of a version's state as it is stored; None without one."""
    return None if state is None else hashlib.sha256(state).digest()


def entry_digest(previous: bytes, head: Mapping[str, Any], sums: Mapping[str, Iterable[bytes]]) -> bytes:
    """Return the digest of a ledger entry, 32 bytes: over the one before, the entry's own columns, and its rows.

    head : cell_id, number, time, added and settings of the entry.  sums : of its rows, by table, in any order.
    """
    digest = hashlib.sha256(b"dengine ledger 1\n" + previous + row_sum("ledger", head))
    for table in sorted(sums):
        ordered = sorted(sums[table])
        digest.update(b"%s=%d;%s" % (table.encode(), len(ordered), b"".join(ordered)))
    return digest.digest()


DOUBLES = {
    name: tuple(column.name for column in table.c if isinstance(column.type, sa.Double)) for name, table in CHAINED.items()
}
Row = Mapping[str, Any]


class LedgerEntry:
    """The entry that a transaction under way will end with; nothing is asked or written where it adds no row.

    scope : whose ledger.  clock : the time in seconds that the entry is stamped with.
    """

    def __init__(self, scope: Scope, clock: Callable[[], float]) -> None:
        self._scope, self.cell_id = scope, scope.cell_id
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
        return full | {"sum": row_sum(table, full)}

    def take_settings(self, connection: sa.Connection) -> None:
        """Note that the settings change."""
        self._begin(connection)
        self._settings = True

    def _begin(self, connection: sa.Connection) -> None:
        """Lock the cell, before the newest entry is read: two processes may write to it."""
        if self._number:
            return
        self._scope.lock_cell(connection)
        newest = sa.select(LEDGER.c.number, LEDGER.c.digest).where(LEDGER.c.cell_id == self.cell_id)
        last = connection.execute(newest.order_by(LEDGER.c.number.desc()).limit(1)).first()
        self._number, self._previous = (1, START) if last is None else (last.number + 1, last.digest)

    def append(self, connection: sa.Connection) -> tuple[int, str] | None:
        """Write the entry, as the last of the transaction; returns its number and digest, None where there is none."""
        if not self._number:
            return None
        held = held_settings(connection, self.cell_id) if self._settings else None
        head = {
            "cell_id": self.cell_id,
            "number": self._number,
            "time": float(self._clock()),
            "added": json.dumps({table: len(sums) for table, sums in sorted(self._sums.items())}),
            "settings": None if held is None else json.dumps(held, sort_keys=True),
        }
        digest = entry_digest(self._previous, head, self._sums)
        connection.execute(sa.insert(LEDGER), head | {"digest": digest})
        return self._number, digest.hex()


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
