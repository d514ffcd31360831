"""The ledger of a cell: a hash chain by which a changed or missing row of the store is noticed. The
file has the sum of a row (`row_sum`), the class `LedgerEntry` that ends a transaction with an
entry, the hook that gives every inserted row its sum (`chain_writes`), the check of the ledger's
key, and `find_integrity_error`, which compares rows with the ledger. `Database` uses it for every
write and when an engine starts; `verify_history` checks the whole chain.

Every transaction that adds rows or changes settings ends with a ledger entry. The entry has a
digest over the entry before, over the sums (SHA-256) of the rows that the transaction added, and,
for each table that an engine reads at its start (`IN_FORCE`), over all its rows so far (`chains`).
By the latter an engine checks what it reads from the newest entry and these rows alone.

Rows are chained where a statement is sent to the database: inserts into the tables of CHAINED are
intercepted (`chain_writes`), and each row is given the number of the entry and its own sum. So no
writer has to think of the ledger, and none can go around it.

If the environment names a key file, the entries of a new ledger are keyed (HMAC): without the key
nobody can change a store and compute a chain that fits.

What a row's sum is must never change. Therefore a column without a value is left out of it and
columns are taken by name: a later schema may add columns that are empty in earlier rows.
"""

import hashlib
import hmac
import json
import os
import struct
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from itertools import groupby
from typing import Any

import sqlalchemy as sa

from ..errors import StoreError
from ..files import read_key
from .records import Clock, EntryName, Row
from .schema import (
    CHAINED,
    CORRECTION,
    LABEL,
    LEDGER,
    LEDGER_KEY,
    SETTING,
    VERSION,
    Query,
    insert_settings,
    read_setting,
    read_settings,
)

KEY_VARIABLE = "DENGINE_LEDGER_KEY"  # of the environment: the file of the key of all ledgers
# The column by which the rows of each table that an engine reads are numbered.
IN_FORCE = {
    LABEL.name: LABEL.c.seq,
    CORRECTION.name: CORRECTION.c.number,
    VERSION.name: VERSION.c.retrain,
}
START = bytes(32)  # the digest before a cell's first entry
# Columns that a row's sum leaves out: itself, and a state, which `state_sum` covers: it may be
# deleted.
NOT_SUMMED = {"sum", "state"}


def row_sum(table: str, row: Row) -> bytes:
    """Return the checksum of a row: SHA-256 over the names of table and columns, and the values.

    It is the same on SQLite and PostgreSQL, before a row is written and after it is read: True
    counts as the integer 1 (SQLite has no booleans), None and NaN are left out and -0.0 counts as
    0.0 (SQLite keeps neither). Otherwise the type of a value counts, too. The order of the columns
    does not matter. The columns `sum` (the stored checksum) and `state` (which has a checksum of
    its own) are left out.

    Parameters
    ----------
    table : str
    row : mapping of str to int, bool, float, str, bytes or None

    Returns
    -------
    bytes
        32 bytes.

    Raises
    ------
    TypeError
        For a value of another type, also of a subclass of these.
    """
    pieces = [table.encode(), b"\n"]
    for name, begin in _summed_columns(
        tuple(row)
    ):  # inline, since a thousand rows a second pass here
        value = row[name]
        kind = type(value)
        if value is None or value != value:
            continue
        if kind is int or kind is bool:
            pieces.append(b"%bi%d;" % (begin, value))
        elif kind is str:
            # This never raises, and two texts never share their bytes.
            data = value.encode("utf-8", "surrogatepass")
            pieces += (b"%bs%d:" % (begin, len(data)), data)
        elif kind is float:
            pieces += (begin, b"f", _DOUBLE(value + 0.0))
        elif kind is bytes:
            pieces += (b"%bb%d:" % (begin, len(value)), value)
        else:
            raise TypeError(
                f"Expected a plain value of column {name!r}, got {kind.__name__}; see `to_row`."
            )
    return hashlib.sha256(b"".join(pieces)).digest()


@lru_cache(256)
def _summed_columns(names: tuple[str, ...]) -> list[tuple[str, bytes]]:
    """Return the columns that a row's sum includes, sorted, each with its name in bytes and "="."""
    return [(name, name.encode() + b"=") for name in sorted(names) if name not in NOT_SUMMED]


_DOUBLE = struct.Struct(">d").pack


def is_intact(table: sa.Table, values: Sequence[Any]) -> bool:
    """Return whether the stored sum of a row is the one that its values have now.

    `values` are those of the table's columns, in their order; what follows them is ignored. False
    for a row of None alone, like that of an outer join without a match. Raise TypeError for a value
    that `row_sum` refuses.
    """
    row = dict(zip(table.c.keys(), values, strict=False))
    return bool(row_sum(table.name, row) == row["sum"])


def state_sum(state: bytes | None) -> bytes | None:
    """Return the SHA-256 of a version's stored state; None without a state."""
    return None if state is None else hashlib.sha256(state).digest()


def ledger_key() -> bytes:
    """Return the key from the file that DENGINE_LEDGER_KEY names; b"" if it is not set or empty.

    Raise StoreError if the file cannot be read or holds fewer than 16 bytes.
    """
    file = os.environ.get(KEY_VARIABLE)
    return read_key(file, StoreError) if file else b""


def check_key(connection: sa.Connection, cell_id: str, key: bytes, begin: bool = False) -> None:
    """Check that a cell's ledger (a hash chain) was begun with this key, or without a key.

    With a key, the digest of each ledger entry (one for each transaction) is an HMAC that nobody
    can compute without it.

    Parameters
    ----------
    connection : sqlalchemy.Connection
    cell_id : str
    key : bytes
        b"" for a ledger without a key.
    begin : bool, default False
        If the robot cell has no ledger entry and no key yet, store a setting by which this key is
        recognized later (a keyed digest, not the key), without a commit. For b"" nothing is stored.

    Raises
    ------
    StoreError
        If the ledger was begun with another key than `key`, with a key although `key` is b"", or
        without one although `key` is not b"". Without `begin` a cell that has neither an entry nor
        a key counts as begun without a key.
    """
    tag = hmac.new(key, b"dengine ledger", "sha256").hexdigest() if key else None
    stored = read_setting(connection, cell_id, LEDGER_KEY)
    if begin and stored is None and tag and not newest_entry(connection, cell_id):
        insert_settings(connection, cell_id, {LEDGER_KEY: tag})
    elif stored != tag:
        begun = "with another key"
        if stored is None:
            begun = "without a key"
        elif tag is None:
            begun = "with a key"
        raise StoreError(
            f"Expected a ledger of cell {cell_id!r} by the key that {KEY_VARIABLE} "
            f"names{'' if key else ', none'}; it was begun, or made anew, {begun}: have it name "
            "the file of the ledger's own key, or none."
        )


def newest_entry(connection: sa.Connection, cell_id: str) -> Any:
    """Return number, digest and chains of a cell's newest ledger entry, by name; {} without one.

    The ledger is the cell's hash chain, with an entry for each transaction. `digest` is 32 bytes.
    `chains` is JSON: by the name of the table (label, correction, model_version or setting) a
    digest over all rows that it has so far, for settings over the present ones. A table that never
    had a row is missing there.
    """
    rows = connection.execute(
        _entries_query(cell_id).with_only_columns(*LEDGER.c["number", "digest", "chains"]).limit(1)
    )
    return rows.mappings().first() or {}


def _entries_query(cell_id: str) -> Query:
    """Return the query for the entries of a cell's ledger, newest first; it is not run."""
    return sa.select(LEDGER).where(LEDGER.c.cell_id == cell_id).order_by(LEDGER.c.number.desc())


def rows_digest(sums: Mapping[str, Iterable[bytes]]) -> bytes:
    """Return the SHA-256 (32 bytes) over the checksums of rows (`row_sum`), given by table.

    Neither the order of the tables nor that of the rows matters. A table that is given without rows
    counts, too: if it is left out, the digest is another one.
    """
    digest = hashlib.sha256()
    for table in sorted(sums):
        ordered = sorted(sums[table])
        digest.update(b"%s=%d;%s" % (table.encode(), len(ordered), b"".join(ordered)))
    return digest.digest()


def entry_digest(previous: bytes, head: Row, key: bytes = b"") -> bytes:
    """Return the digest of a ledger entry over all its columns and the digest of the entry before.

    Parameters
    ----------
    previous : bytes
        Digest of the entry before; START for the first.
    head : mapping
        All columns of the entry but its digest.
    key : bytes, default b""
        Key of a keyed ledger.

    Returns
    -------
    bytes
        32 bytes: SHA-256, or HMAC-SHA-256 (RFC 2104) with a key.
    """
    message = b"dengine ledger 2\n" + previous + row_sum("ledger", head)
    return hmac.digest(key, message, "sha256") if key else hashlib.sha256(message).digest()


def _extend_chain(chained: str, sums: Iterable[bytes]) -> str:
    """Return a table's chain, a digest over all its rows so far, extended by the next entry's rows.

    `sums` are the checksums of these rows; their order does not matter. Both chains are SHA-256,
    hexadecimal; the first entry of a table extends "".
    """
    return hashlib.sha256(chained.encode() + b"".join(sorted(sums))).hexdigest()


def _settings_chain(settings: str) -> str:
    """Return a SHA-256 over a cell's settings, hexadecimal; `settings` is their JSON, sorted."""
    return _extend_chain("", [settings.encode()])


def _settings_text(connection: sa.Connection, cell_id: str) -> str:
    """Return a cell's settings, without those that the store itself keeps, as JSON, sorted."""
    return json.dumps(read_settings(connection, cell_id), sort_keys=True)


def parse_object(text: Any) -> dict[str, Any]:
    """Return the fields of a JSON object from a ledger (a hash chain); {} if it is damaged.

    `text` is as the database driver returned it, so it may be anything: {} also for None, and for
    JSON that is no object. Nothing is raised.
    """
    with suppress(ValueError, TypeError, RecursionError):
        fields = json.loads(text)
        if isinstance(fields, dict):
            return fields
    return {}


class LedgerEntry:
    """The ledger entry that an open write transaction will end with. The robot cell must be locked.

    Parameters
    ----------
    connection : sqlalchemy.Connection
        Of the transaction. The cell's newest entry is read from it.
    cell_id : str
    key : bytes
        Key of a keyed ledger; b"" for a ledger without a key.

    Attributes
    ----------
    settings : bool
        Whether the transaction changes settings; set by `chain_writes`.
    """

    def __init__(self, connection: sa.Connection, cell_id: str, key: bytes) -> None:
        self._connection = connection
        self._cell_id = cell_id
        self._key = key
        last = newest_entry(connection, cell_id)
        self._number = last.get("number", 0) + 1
        self._previous = last.get("digest", START)
        self._chains = parse_object(last.get("chains"))
        self._sums: dict[str, list[bytes]] = {}
        self.settings = False

    def add_rows(self, table: str, rows: Sequence[Row]) -> list[Row]:
        """Add the checksums of rows, which are about to be inserted into a table, to this entry.

        The entry will stand for this transaction in the ledger, the store's hash chain. Return
        copies of the rows with two more columns: `entry`, the number of this entry, and `sum`, the
        checksum (`row_sum`). Nothing is inserted here. Raise TypeError for a value that `row_sum`
        refuses.
        """
        chained = [{**row, "entry": self._number} for row in rows]
        for row in chained:
            row["sum"] = row_sum(table, row)
        self._sums.setdefault(table, []).extend(row["sum"] for row in chained)
        return chained

    def append(self, clock: Clock) -> EntryName | None:
        """Insert the entry into the ledger, as the transaction's last step; this does not commit.

        The ledger is the store's hash chain. The entry says how many rows the transaction added to
        each table. It has a digest over the checksums of these rows, and for each table that an
        engine reads at its start (`IN_FORCE`) a digest over all its rows so far. If settings were
        written, it also has a copy of all settings of the engine. Its own digest is over all this
        and the digest of the entry before.

        Parameters
        ----------
        clock : callable
            Returns the entry's time, in seconds since 1970.

        Returns
        -------
        (int, str) or None
            Number and hexadecimal digest of the entry. None if no rows were added and no statement
            wrote to the settings; then no entry is inserted.
        """
        if not (self._sums or self.settings):
            return None
        chains = self._chains
        for name in IN_FORCE:
            if name in self._sums:
                chains[name] = _extend_chain(chains.get(name, ""), self._sums[name])
        settings = None
        if self.settings:
            settings = _settings_text(self._connection, self._cell_id)
            chains[SETTING.name] = _settings_chain(settings)
        head = {
            "cell_id": self._cell_id,
            "number": self._number,
            "time": float(clock()),
            "added": json.dumps({table: len(sums) for table, sums in sorted(self._sums.items())}),
            "rows": rows_digest(self._sums),
            "chains": json.dumps(chains, sort_keys=True),
            "settings": settings,
        }
        digest = entry_digest(self._previous, head, self._key)
        self._connection.execute(sa.insert(LEDGER), head | {"digest": digest})
        return self._number, digest.hex()


def find_integrity_error(connection: sa.Connection, cell_id: str, key: bytes, first: int) -> str:
    """Compare the rows of a robot cell that an engine reads with the cell's ledger.

    The ledger is a hash chain with an entry for each transaction. The rows are the settings,
    corrections of labels, model versions and newest labels. Of the ledger itself only the newest
    entry is checked. Rows that name a later entry are not read, because another connection may
    write meanwhile. A cell without any entry must have no settings (except those that the store
    itself keeps) and none of the other rows.

    Parameters
    ----------
    connection : sqlalchemy.Connection
    cell_id : str
    key : bytes
        Key of the ledger, b"" without one. Another key than the ledger's is a difference.
    first : int
        Number of the first label that is checked; earlier labels that belong to the same ledger
        entry are checked, too. Settings, corrections and versions are checked in full, but for the
        versions' stored states (their arrays).

    Returns
    -------
    str
        The first difference, in words; "" if there is none. It is returned and not raised.
    """
    try:
        check_key(connection, cell_id, key)
    except StoreError as error:
        return f"{error}"
    rows = connection.execute(_entries_query(cell_id).limit(2)).mappings()
    newest, before = [*rows, {}, {}][:2]
    previous = before.get("digest", START)
    if newest and newest["digest"] != entry_digest(previous, {**newest, "digest": None}, key):
        return "the newest entry of the ledger is not as it was written"
    chains = parse_object(newest.get("chains"))
    settings = _settings_chain(_settings_text(connection, cell_id))
    if chains.get(SETTING.name, _settings_chain("{}")) != settings:
        return "the settings are not those of the ledger"
    last_entry = newest.get("number", 0)
    for name in IN_FORCE:
        begin = first if name == LABEL.name else 1
        difference = _find_table_error(
            connection, cell_id, name, begin, last_entry, chains.get(name, "")
        )
        if difference:
            return difference
    return ""


def _find_table_error(
    connection: sa.Connection, cell_id: str, name: str, first: int, last_entry: int, chained: str
) -> str:
    """Compare a robot cell's rows of the table `name` with the ledger.

    The ledger is a hash chain with an entry for each transaction. Return the first difference in
    words, or "". A difference is a row whose values do not fit its stored checksum, or rows that
    were removed, added or replaced. `name` is that of a table in IN_FORCE: labels, corrections
    (changes of labels) or versions (trained models); the stored states of versions (their arrays)
    are not read. `chained` is the digest over all rows of the table so far that ledger entry
    `last_entry` has. Rows of later entries are not read, since another connection may write
    meanwhile. Reading begins at the row with number `first`, or at an earlier row that belongs to
    the same ledger entry; rows before it are not checked.
    """
    number = IN_FORCE[name]
    table = number.table
    entry = table.c.entry
    selected = table.c.cell_id == cell_id
    is_earlier = entry < sa.func.coalesce(
        sa.select(entry)
        .where(selected, number >= first)
        .order_by(number)
        .limit(1)
        .scalar_subquery(),
        2**62,
    )
    before = connection.execute(
        sa.select(entry, number)
        .where(selected, number < first, is_earlier)
        .order_by(number.desc())
        .limit(1)
    ).first()
    chain = ""
    if before is not None:
        query = sa.select(LEDGER.c.chains).where(
            LEDGER.c.cell_id == cell_id, LEDGER.c.number == before.entry
        )
        chain = parse_object(connection.execute(query).scalar()).get(name, "")
        selected &= number > before[1]
    selected &= entry.is_(None) | (entry <= last_entry)
    rows = connection.execute(
        sa.select(*(column for column in table.c if column.name != "state"))
        .where(selected)
        .order_by(number)
    )
    for _, group in groupby(rows, lambda row: row.entry):
        entry_rows = [row._asdict() for row in group]
        if changed := [row for row in entry_rows if row_sum(name, row) != row["sum"]]:
            return f"the {name} {changed[0][number.name]} is not as it was written"
        chain = _extend_chain(chain, [row["sum"] for row in entry_rows])
    return "" if chain == chained else f"the rows of {name} are not those of the ledger"


def chain_writes(engine: sa.Engine) -> None:
    """Have an SQLAlchemy engine call `_chain_statement` before every statement.

    That gives inserted rows their sums, and adds these to the ledger entry of the transaction.
    """
    sa.event.listen(engine, "before_execute", _chain_statement, retval=True)


def _chain_statement(
    connection: sa.Connection, statement: Any, many: Any, single: Any, options: Any
) -> tuple[Any, Any, Any]:
    """Add the checksums of rows that are about to be inserted to the transaction's ledger entry.

    The ledger is the store's hash chain. SQLAlchemy calls this before it executes a statement. The
    parameters are in `many`, a list of rows, or in `single`, one row; `options` are not used.
    Return the statement with its parameters. For an insert into a table of CHAINED, whose rows the
    ledger covers, these are copies of the rows, with the number of the entry and their checksum.
    All other statements, and all those outside a write transaction of `Database`, are returned
    unchanged; if settings are written, the entry will have a copy of them all. Raise StoreError for
    an insert into a table of CHAINED whose rows are inside the statement instead of its parameters,
    and TypeError for a value of such a row that `row_sum` refuses.
    """
    entry: LedgerEntry | None = connection.get_execution_options().get("dengine_entry")
    if entry is None or not isinstance(statement, sa.Insert | sa.Update | sa.Delete):
        return statement, many, single
    table = statement.table.name if isinstance(statement.table, sa.Table) else ""
    entry.settings |= table == SETTING.name
    if table not in CHAINED or not isinstance(statement, sa.Insert):
        return statement, many, single
    if not (many or single):
        raise StoreError(
            f"Expected the rows of {table} beside the statement, got none; "
            "execute(insert(table), rows)."
        )
    return statement, entry.add_rows(table, many or [single]), {}
