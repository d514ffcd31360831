"""Whether a store's history is what was written: every row against its sum, every entry of the ledger against its rows.

    report = verify_history("engine.db")
    report.ok, report.faults, report.cells[0].digest      # keep the digest elsewhere: `expect` asks for it again

A chain that is whole says that nothing in it was changed, added or removed since it was written, but for its newest
entries: those can be cut off without a trace in the store, which is what `expect` is for. Nor can it tell a history that
somebody with the right to write has made anew from its beginning; a digest that was kept elsewhere does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import sqlalchemy as sa

from ..errors import StoreError
from .cell_history import CellCheck, CellHistory, HistoryFault
from .sql_snapshot import chosen_cells, snapshot

__all__ = ["CellHistory", "HistoryFault", "HistoryReport", "verify_history"]


@dataclass(frozen=True, slots=True)
class HistoryReport:
    """What `verify_history` found; faults : nothing where all is as it was written."""

    cells: tuple[CellHistory, ...]
    faults: tuple[HistoryFault, ...]

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.faults


def verify_history(
    url: str, cell_id: str | None = None, expect: str | None = None, on_rows: Callable[[int], None] | None = None
) -> HistoryReport:
    """Check a store, of one cell or of all; nothing is written, and engines may go on meanwhile.

    url : a file or URL.  expect : a digest that an earlier check gave, or its first 8 digits or more: the history must
    hold it still.  on_rows : called with the number of rows that were just read.
    Takes about 50 bytes of memory a row. Raises StoreError for what is no store of the present schema.
    """
    wanted = _hexadecimal(expect)
    with snapshot(str(url)) as connection:
        faults = list(_pages(connection))
        checks = [CellCheck(connection, cell, on_rows or _nobody) for cell in chosen_cells(connection, cell_id)]
        for check in checks:
            faults += check.run()
    if wanted and not any(digest.startswith(wanted) for check in checks for digest in check.digests):
        what = "is in no entry: the history was cut off before it, or made anew"
        faults.append(HistoryFault(cell_id or "", "ledger", f"digest {wanted}", what))
    return HistoryReport(tuple(check.history() for check in checks), tuple(faults))


def _nobody(rows: int) -> None:
    """Nobody asks how far it is."""


def _hexadecimal(digest: str | None) -> str:
    wanted = "" if digest is None else digest.strip().lower()
    if digest is not None and (not 8 <= len(wanted) <= 64 or set(wanted) - set("0123456789abcdef")):
        raise StoreError(f"Expected a digest of 64 hexadecimal digits, or its first 8 or more, got {digest!r}.")
    return wanted


def _pages(connection: sa.Connection) -> Iterator[HistoryFault]:
    """What SQLite itself finds wrong in its file."""
    if connection.dialect.name != "sqlite":
        return
    try:
        said = [str(line) for line in connection.execute(sa.text("PRAGMA integrity_check")).scalars()]
    except sa.exc.DatabaseError as error:
        said = [str(error.orig)]
    yield from (HistoryFault("", "file", "", line) for line in said if line != "ok")
