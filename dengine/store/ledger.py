"""The ledger of a cell: every transaction that adds rows, or changes settings, ends with an entry that chains them.

A statement that inserts into a table of CHAINED is met on its way to the database: its rows get the number of the entry
and a sum of their own, whoever sends it. So no writer has to remember the ledger, and none can go around it.

An entry also holds, of each table that an engine learns from or answers by, one digest over all its rows so far: what an
engine reads is held to the ledger by these rows alone, from any of them on, and by the newest entry.

Where the environment names a key's file, the entries of a ledger that is begun are keyed: who has no key can change a
store, and make its chain anew, but not so that it fits.

What a row's sum is must never change. So a column without a value is not in it, and columns are taken by name: a later
schema may add columns that are empty in earlier rows.
"""

import hashlib
import hmac
import json
import os
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from itertools import groupby
from typing import Any

import sqlalchemy as sa

from ..errors import StoreError
from ..files import read_key
from .schema import CHAINED, CORRECTION, LABEL, LEDGER, LEDGER_KEY, RESERVED, SETTING, VERSION

KEY_VARIABLE = "DENGINE_LEDGER_KEY"  # of the environment: the file of the key of all ledgers
IN_FORCE = {LABEL.name: LABEL.c.seq, CORRECTION.name: CORRECTION.c.number, VERSION.name: VERSION.c.retrain}
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


def ledger_key() -> bytes:
    """The key that the environment names, b"" where it names none; StoreError for a file that holds none."""
    file = os.environ.get(KEY_VARIABLE)
    return read_key(file, StoreError) if file else b""


def must_have_key(connection: sa.Connection, cell_id: str, key: bytes, begin: bool = False) -> None:
    """StoreError unless a cell's ledger was begun with this key, or, for b"", without.  begin : note it in a new cell."""
    tag = hmac.new(key, b"dengine ledger", "sha256").hexdigest() if key else None
    mine = (SETTING.c.cell_id == cell_id) & (SETTING.c.key == LEDGER_KEY)
    held = connection.execute(sa.select(SETTING.c.value).where(mine)).scalar()
    if begin and held is None and tag and newest_entry(connection, cell_id) is None:
        connection.execute(sa.insert(SETTING), {"cell_id": cell_id, "key": LEDGER_KEY, "value": tag})
    elif held != tag:
        begun = "without a key" if held is None else "with a key" if tag is None else "with another key"
        wanted = f"a ledger of cell {cell_id!r} by the key that {KEY_VARIABLE} names{'' if key else ', none'}"
        do = "have it name the file of the ledger's own key, or none"
        raise StoreError(f"Expected {wanted}; it was begun, or made anew, {begun}: {do}.")


def newest_entry(connection: sa.Connection, cell_id: str) -> Any:
    """Number, digest and what is held of a cell's newest entry; None where there is none."""
    query = sa.select(*LEDGER.c["number", "digest", "held"]).where(LEDGER.c.cell_id == cell_id)
    return connection.execute(query.order_by(LEDGER.c.number.desc()).limit(1)).first()


def rows_digest(sums: Mapping[str, Iterable[bytes]]) -> bytes:
    """Return the SHA-256 over the sums of rows, by table, in any order."""
    digest = hashlib.sha256()
    for table in sorted(sums):
        ordered = sorted(sums[table])
        digest.update(b"%s=%d;%s" % (table.encode(), len(ordered), b"".join(ordered)))
    return digest.digest()


def entry_digest(previous: bytes, head: Mapping[str, Any], key: bytes = b"") -> bytes:
    """Return the digest of a ledger entry, 32 bytes: over the one before, and all columns of the entry but its digest.

    key : of a keyed ledger: then it is the HMAC-SHA-256 (RFC 2104).
    """
    begin = b"dengine ledger 2\n" + previous + row_sum("ledger", head)
    return hmac.digest(key, begin, "sha256") if key else hashlib.sha256(begin).digest()


def _onward(chained: str, sums: Iterable[bytes]) -> str:
    """The chain of a table's rows, with those of another entry."""
    return hashlib.sha256(chained.encode() + b"".join(sorted(sums))).hexdigest()


def _of_settings(settings: Mapping[str, str]) -> str:
    return _onward("", [json.dumps(settings, sort_keys=True).encode()])


def _loaded(held: str) -> dict[str, str]:
    with suppress(ValueError, TypeError):  # damaged: it fits no rows
        return dict(json.loads(held))
    return {}


class LedgerEntry:
    """The entry that a transaction under way will end with. The cell is locked: two processes may write to it.

    key : of a keyed ledger.  settings : whether they change.
    """

    def __init__(self, connection: sa.Connection, cell_id: str, key: bytes = b"") -> None:
        self._connection, self._cell_id, self._key = connection, cell_id, key
        last = newest_entry(connection, cell_id)
        self._number: int = 1 if last is None else last.number + 1
        self._previous: bytes = START if last is None else last.digest
        self._held = {} if last is None else _loaded(last.held)
        self._sums: dict[str, list[bytes]] = {}
        self.settings = False

    def take(self, table: str, rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Return rows on their way into a table with the number of the entry, and each with its sum."""
        taken = [{**row, "entry": self._number} for row in rows]
        for row in taken:
            row["sum"] = row_sum(table, row)
        self._sums.setdefault(table, []).extend(row["sum"] for row in taken)
        return taken

    def append(self, clock: Callable[[], float]) -> tuple[int, str] | None:
        """Write the entry, as the last of the transaction; its number and digest, None where there is nothing to chain.

        clock : the time in seconds that it is stamped with.
        """
        if not (self._sums or self.settings):
            return None
        settings = held_settings(self._connection, self._cell_id) if self.settings else None
        held = {name: _onward(self._held.get(name, ""), self._sums[name]) for name in IN_FORCE if name in self._sums}
        held |= {} if settings is None else {SETTING.name: _of_settings(settings)}
        head = {
            "cell_id": self._cell_id,
            "number": self._number,
            "time": float(clock()),
            "added": json.dumps({table: len(sums) for table, sums in sorted(self._sums.items())}),
            "rows": rows_digest(self._sums),
            "held": json.dumps(self._held | held, sort_keys=True),
            "settings": None if settings is None else json.dumps(settings, sort_keys=True),
        }
        digest = entry_digest(self._previous, head, self._key)
        self._connection.execute(sa.insert(LEDGER), head | {"digest": digest})
        return self._number, digest.hex()


def held_settings(connection: sa.Connection, cell_id: str) -> dict[str, str]:
    """Return a cell's settings, without the store's own."""
    query = sa.select(SETTING.c.key, SETTING.c.value).where(SETTING.c.cell_id == cell_id, SETTING.c.key.not_in(RESERVED))
    return {row.key: row.value for row in connection.execute(query)}


def settings_faults(connection: sa.Connection, cell_id: str) -> dict[str, str]:
    """What of a cell's settings is not as the newest entry that changed them has it: by key, in words."""
    held, chained = held_settings(connection, cell_id), dict[str, str]()
    newest = sa.select(LEDGER.c.settings).where(LEDGER.c.cell_id == cell_id, LEDGER.c.settings.is_not(None))
    with suppress(ValueError, TypeError):  # the entry itself was changed: of that the chain tells
        chained = dict(json.loads(connection.execute(newest.order_by(LEDGER.c.number.desc()).limit(1)).scalar() or "{}"))
    return {
        key: "is not chained" if key not in chained else "is missing" if key not in held else "was changed"
        for key in sorted(held.keys() | chained.keys(), key=str)
        if held.get(key) != chained.get(key)
    }


def doubt_of(connection: sa.Connection, cell_id: str, key: bytes, first: int) -> str:
    """What a cell's engine reads that is not as its ledger has it, in words; "" where all is.

    first : number of the oldest label that is read.  Settings, corrections and versions are held to it from the first on.
    """
    try:
        must_have_key(connection, cell_id, key)
    except StoreError as error:
        return f"{error}"
    entries = sa.select(LEDGER).where(LEDGER.c.cell_id == cell_id).order_by(LEDGER.c.number.desc()).limit(2)
    head, before = [*(dict(row._mapping) for row in connection.execute(entries)), {}, {}][:2]
    if head and entry_digest(before.get("digest", START), head | {"digest": None}, key) != head["digest"]:
        return "the newest entry of the ledger is not as it was written"
    held = _loaded(head.get("held", ""))
    if held.get(SETTING.name, _of_settings({})) != _of_settings(held_settings(connection, cell_id)):
        return "the settings are not those of the ledger"
    newest = head.get("number", 0)
    for name in IN_FORCE:
        begin = first if name == LABEL.name else 1
        if said := _table_doubt(connection, cell_id, name, begin, newest, held.get(name, "")):
            return said
    return ""


def _table_doubt(connection: sa.Connection, cell_id: str, name: str, first: int, newest: int, chained: str) -> str:
    """What of a table in force is not as its ledger has it, in words, from row `first` on, or from the first of its entry.

    newest : entry up to which rows count; others may write meanwhile.  chained : what it holds of this table.
    """
    number = IN_FORCE[name]
    table, mine = number.table, number.table.c.cell_id == cell_id
    entry = sa.select(table.c.entry).where(mine, number >= first).order_by(number).limit(1).scalar_subquery()
    earlier = sa.select(table.c.entry, number).where(mine, number < first, table.c.entry < sa.func.coalesce(entry, 2**62))
    before = connection.execute(earlier.order_by(number.desc()).limit(1)).first()
    chain = ""
    if before is not None:
        held = sa.select(LEDGER.c.held).where(LEDGER.c.cell_id == cell_id, LEDGER.c.number == before.entry)
        chain, mine = _loaded(connection.execute(held).scalar() or "").get(name, ""), mine & (number > before[1])
    mine &= table.c.entry.is_(None) | (table.c.entry <= newest)
    rows = connection.execute(sa.select(*(c for c in table.c if c.name != "state")).where(mine).order_by(number))
    for _, some in groupby(rows, lambda row: row.entry):
        each = [dict(zip(rows.keys(), row, strict=True)) for row in some]
        if other := [row for row in each if not is_sound(name, row)]:
            return f"the {name} {other[0][number.name]} is not as it was written"
        chain = _onward(chain, [row["sum"] for row in each])
    return "" if chain == chained else f"the rows of {name} are not those of the ledger"


def chain_writes(engine: sa.Engine) -> None:
    """Let all that is written through an engine, in transactions with an entry, be chained."""
    sa.event.listen(engine, "before_execute", _meet, retval=True)


def _meet(connection: sa.Connection, statement: Any, many: Any, one: Any, options: Any) -> tuple[Any, Any, Any]:
    """See what is about to be executed: rows for a chained table are taken into the entry of the transaction."""
    entry: LedgerEntry | None = connection.get_execution_options().get("dengine_entry")
    if entry is None or not isinstance(statement, sa.Insert | sa.Update | sa.Delete):
        return statement, many, one
    table = statement.table.name if isinstance(statement.table, sa.Table) else ""
    entry.settings |= table == SETTING.name
    if table not in CHAINED or not isinstance(statement, sa.Insert):
        return statement, many, one
    if not (many or one):
        raise StoreError(f"Expected the rows of {table} beside the statement, got none; execute(insert(table), rows).")
    return statement, entry.take(table, many or [one]), {}
