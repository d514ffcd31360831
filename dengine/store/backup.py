"""Copies an SQLite store into a new file, together with the records still in the cells' journals.
`backup_store` does that, while engines may use the store, and returns a `BackupReport` with the
numbers of decisions and labels. `restore_store` puts such a copy in the place of a store, on this
or another machine. `dengine backup` and `dengine restore` use them; PostgreSQL stores are refused.

    report = backup_store("engine.db", "copy.db")
    report.decisions, report.labels, report.from_journals

A plain copy of the file would lack what is beside it: the newest transactions, in its `-wal` file,
and the newest decisions, labels and events, in the journal of each cell.
"""

import os
import sqlite3
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from ..errors import OutputError, StoreError, expect, instead
from ..files import FilePath, output_file
from .connections import reading
from .journal import Journal, Record, journal_path, read_undrained
from .records import chunks
from .schema import DECISION, LABEL, read_cells
from .sql import SqlStore
from .verification import CellHistory, verify_history


@dataclass(frozen=True, slots=True)
class BackupReport:
    """What `backup_store` copied.

    Attributes
    ----------
    decisions, labels : int
        Numbers in the copy, of all robot cells.
    from_journals : int
        Number of records (decisions, labels, events) in the journals that the store had not taken
        when they were read.
    without_journal : tuple of str
        Cells that have no journal beside the store, sorted.
    """

    decisions: int
    labels: int
    from_journals: int
    without_journal: tuple[str, ...]


def backup_store(url: FilePath, out: FilePath) -> BackupReport:
    """Copy an SQLite store into a new file, and add to the copy what the cells' journals hold.

    A journal is the file to which the engine of a robot cell writes each decision, label and event
    before the store gets it. Engines may run meanwhile: every decision, label and event that was on
    disk when this was called is in the copy. Damaged records of a journal are left out, and a
    record that contradicts the copy, or that its database refuses, becomes an event of kind "dead
    letter" there, which is also logged. The copy is written in full or not at all; it is not in WAL
    mode. The store and the journals are only read, but a store that is not in WAL mode is set to it
    if it can be written.

    Parameters
    ----------
    url : str or path
        A file, or a URL of SQLite.
    out : str or path
        A file that does not exist yet.

    Returns
    -------
    BackupReport
        The numbers of decisions and labels in the copy and of records from journals, and the robot
        cells that have no journal beside the store.

    Raises
    ------
    StoreError
        If `url` is no store or cannot be read, if it is a PostgreSQL store (pg_dump copies that),
        and if a journal cannot be read. If a journal holds records, also if the ledger of its cell
        (the hash chain over its rows) was begun with another key than the one in the file that the
        environment variable DENGINE_LEDGER_KEY names, if that file cannot be read, or if the
        records cannot be written to the copy.
    OutputError
        If `out` exists, or the `-wal` file of an earlier store beside it, or if `out` cannot be
        written, for example on a full disk. Also if SQLite finds damage in the store while it
        copies it or counts the rows of the copy.
    OSError
        If the disk fails while the records of a journal are read.
    """
    log_file = Path(f"{os.fspath(out)}-wal")  # SQLite would take its rows for the copy's
    expect(not log_file.exists(), f"no {log_file}", "one", "move it away", OutputError)
    with reading(os.fspath(url)) as connection:
        dialect = connection.dialect.name
        expect(
            dialect == "sqlite",
            "a store in a file",
            dialect,
            "pg_dump copies it, once the engines have ended: their journals lie on their machines",
            StoreError,
        )
        cells = read_cells(connection)
        paths = {cell: journal_path(connection.engine.url, cell) for cell in cells}
    # Journals first: a record that leaves its journal meanwhile is in the store by then.
    waiting = {cell: read_undrained(path)[0] for cell, path in paths.items() if path.exists()}
    with output_file(out) as partial, reading(os.fspath(url)) as connection:
        try:
            with instead(
                OutputError,
                f"Cannot write {out}",
                sqlite3.Error,
                do="choose a folder that has room",
            ):
                with closing(sqlite3.connect(partial)) as copy:  # by SQLite's own online backup
                    source: Any = connection.connection.driver_connection
                    source.backup(copy)
                for cell, records in waiting.items():
                    _add_records(partial, cell, records)
                decisions, labels = _fold_wal_and_count(partial)
        finally:
            for suffix in ("-wal", "-shm"):
                partial.with_name(partial.name + suffix).unlink(missing_ok=True)
    return BackupReport(
        decisions,
        labels,
        from_journals=sum(map(len, waiting.values())),
        without_journal=tuple(cell for cell in cells if cell not in waiting),
    )


def restore_store(copy: FilePath, store: FilePath) -> tuple[CellHistory, ...]:
    """Copy a backup into a new file `store`, and make a journal beside it for each robot cell.

    A journal is the file to which the engine of a cell writes each decision, label and event before
    the store gets it. The new journal names the newest entry of the cell's ledger (the store's hash
    chain) in `copy`, so that the engine that opens the cell next can tell that nothing is missing.
    A journal that is already beside `store` is not changed: the next engine of its cell takes the
    records from it that the copy lacks. If the journal names a ledger entry that the copy lacks,
    this engine also records an alarm. Records of journals that are beside `copy` are added to
    `store`, as by `backup_store`.

    Parameters
    ----------
    copy : str or path
        What `backup_store` wrote. It is checked in full, and its rows are only read, but the file
        is set to WAL mode if it can be written.
    store : str or path
        A file that does not exist yet, nor its `-wal` file.

    Returns
    -------
    tuple of CellHistory
        For each cell what `verify_history` found in `copy`: its numbers of rows and of ledger
        entries, the digest of its newest entry, and the number of records in its journal beside
        `copy`, which are not among the rows.

    Raises
    ------
    StoreError
        If `copy` is no store, if `verify_history` finds any fault in it (like changed or missing
        rows, or an earlier loss of data that nobody has acknowledged), and for the other reasons of
        `verify_history` and `backup_store`. If a journal cannot be made: the store has been copied
        by then, and stays.
    OutputError
        If `store` or its `-wal` file exists, or it cannot be written, for example on a full disk.
    OSError
        If the disk fails while `backup_store` reads the records of a journal.
    """
    report = verify_history(os.fspath(copy))
    if not report.ok:
        raise StoreError(
            f"Expected a history as it was written in {copy}, found faults; see `dengine verify`, "
            "and take another copy."
        )
    backup_store(copy, store)
    for cell in report.cells:
        path = journal_path(sa.URL.create("sqlite", database=os.fspath(store)), cell.cell_id)
        if not path.exists():
            journal = Journal(path)
            journal.save_newest_entry((cell.entries, cell.digest))
            journal.close()
    return report.cells


def _add_records(file: Path, cell: str, records: list[Record]) -> None:
    """Commit records of a cell's journal to `file`, the copy; without records do not open it.

    A record is a decision, a label or an event. Records that the copy already has change nothing. A
    record that contradicts the copy, or that its database refuses, is stored there as an event of
    kind "dead letter", and logged. Raise StoreError if the cell's ledger (the hash chain over its
    rows) has another key than the file that the environment variable DENGINE_LEDGER_KEY names, if
    that file cannot be read, or if the copy cannot be written; records that were committed before
    stay.
    """
    if not records:
        return
    with SqlStore(str(file), cell) as store:
        for part in chunks(records):
            store.apply_records(part)


def _fold_wal_and_count(file: Path) -> list[int]:
    """Turn off SQLite's write-ahead log in a store's file, so that everything is in this one file.

    Return the numbers of its decisions and labels, over all robot cells. Raise sqlite3.Error if the
    file cannot be read or written.
    """
    with closing(sqlite3.connect(file)) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
        return [
            connection.execute(f'SELECT count(*) FROM "{table.name}"').fetchone()[0]
            for table in (DECISION, LABEL)
        ]
