"""The hash chain over a cell's history: how a row, and a transaction's rows, become 32 bytes.

What a row's sum is must never change: stores hold sums that were made years ago. So a column without a value is not in it,
and columns are taken by name: a later schema may add columns that are empty in earlier rows.
"""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any

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
            raise TypeError(f"Expected a plain value of column {name!r}, got {kind.__name__}; see `plain_row`.")
    return hashlib.sha256(b"".join(pieces)).digest()


@lru_cache(256)
def _columns(names: tuple[str, ...]) -> list[tuple[str, bytes]]:
    return [(name, name.encode() + b"=") for name in sorted(names) if name not in APART]


_DOUBLE = struct.Struct(">d").pack
PLAIN = (int, float, str, bytes)


def plain_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row whose values are Python's own: a NumPy number, an enum's text, a view of bytes are made so."""
    return {name: _plain(value) for name, value in row.items()}


def _plain(value: Any) -> Any:
    if value is None or type(value) in PLAIN:
        return value
    kind = next((kind for kind in (str, float, bytes) if isinstance(value, kind)), None)
    return kind(value) if kind else bytes(value) if isinstance(value, bytearray | memoryview) else int(value)


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


def settings_text(settings: Mapping[str, str]) -> str:
    """Return settings as an entry keeps them: JSON, keys in order."""
    return json.dumps(dict(settings), sort_keys=True)


def added_text(sums: Mapping[str, Iterable[bytes]]) -> str:
    """Return how many rows of each table an entry chains, as JSON."""
    return json.dumps({table: len(list(sums[table])) for table in sorted(sums)})
