"""`SqlStore`, an engine's memory in a database: SQLite in a file, or PostgreSQL for a fleet. It has
a table object for each subject, by which the engine, the history and the command line read and
write:

    store = SqlStore("engine.db", cell_id="cell-7")
    store = SqlStore("postgresql+psycopg://user:password@host/database", cell_id="cell-7")
    store.decisions.get("part 7"), store.versions.newest(), store.events.newest(10)

When a call that writes returns, its rows are committed, and survive a power failure if the disk
keeps what it synced. The decisions and labels of a running engine do not come in by these objects:
they go into the journal first, and from there, by `apply_records`, into the database.
"""

import math
import os
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, suppress

from ..errors import StoreError, expect
from .connections import Database
from .corrections import CorrectionTable
from .decisions import DecisionTable
from .events import EventTable
from .insertion import RecordInsertion
from .journal import Journal, Record, journal_path
from .labels import LabelTable
from .records import KEEP, Clock, LabelNumbers
from .settings import SettingTable
from .versions import VersionTable

WAIT = 0.4  # seconds that an engine waits for its disk and for the database
# Of the environment: seconds for all stores that are given none.
WAIT_VARIABLE = "DENGINE_STORE_WAIT"


class SqlStore(AbstractContextManager["SqlStore"]):
    """An engine's memory in a database: settings, decisions, labels, versions, events of one robot
    cell.

    Parameters
    ----------
    url : str or None
        A file (SQLite), or an SQLAlchemy URL of SQLite or PostgreSQL. None: SQLite in memory, for
        replays and trials; such a store stays open after `close`, and is used by one thread at a
        time. As soon as a second engine is opened on it, decisions and labels of the first are not
        kept any more.
    cell_id : str, default "cell"
        Whose rows these are. Several cells share one database without seeing each other.
    clock : callable
        Returns the time, in seconds since 1970, with which rows are stamped.
    product : str or None
        What the cell makes. None: for a known cell, as the store says; a new cell shares nothing.
        Cells of one product share labelled traces for training, versions and corrections, and
        number them together. Decisions and their outcomes stay the cell's own.
    wait : float or None
        Seconds that an engine waits for the disk and the database at most. None: the environment's
        DENGINE_STORE_WAIT, or 0.4.
    keep_versions : int or None
        Number of newest model versions that keep their states, beside the first and a few older
        ones (`keeps_state`). None: all. A retrain itself stays listed for ever.

    Attributes
    ----------
    database : Database
    settings : SettingTable
    decisions : DecisionTable
    labels : LabelTable
    events : EventTable
    versions : VersionTable
    corrections : CorrectionTable

    Raises
    ------
    StoreError
        For an empty `cell_id`, a `keep_versions` below 2, a `wait` that is not above 0 or not
        finite, a `product` of a store in memory, and for what `Database` refuses. Every method
        raises it if the database fails.

    Notes
    -----
    SQLite runs in WAL mode with synchronous=FULL; WAL needs a local disk, no network drive. Two
    processes may open one cell, and the numbers of labels stay unique and increasing. An engine
    owns its cell (`claim_cell`): a second engine is refused.
    """

    def __init__(
        self,
        url: str | None = None,
        cell_id: str = "cell",
        clock: Clock = time.time,
        *,
        product: str | None = None,
        wait: float | None = None,
        keep_versions: int | None = KEEP,
    ) -> None:
        expect(
            bool(cell_id),
            "a cell_id that names the cell",
            cell_id,
            "use for example 'cell'",
            StoreError,
        )
        self.cell_id = cell_id
        expect(
            keep_versions is None or (type(keep_versions) is int and keep_versions >= 2),
            "keep_versions of 2 or more, or None for all",
            keep_versions,
            f"leave it at {KEEP}",
            StoreError,
        )
        expect(
            product is None or url is not None,
            "no product of a store in memory",
            product,
            "name a file or a server, which its cells share",
            StoreError,
        )
        self.wait = _checked_wait(wait)
        self.clock = clock
        database = Database(url if url is None else str(url), cell_id, clock, product)
        self.database = database
        self.product = database.scope.product
        self.settings = SettingTable(database)
        self.decisions = DecisionTable(database)
        self.events = EventTable(database)
        self.labels = LabelTable(database, self.decisions, self.events)
        self.versions = VersionTable(database, self.events, keep_versions)
        self.corrections = CorrectionTable(database, self.settings, self.versions)
        self._insertion = RecordInsertion(database, self.corrections)
        self._journal: Journal | None = None

    def claim_cell(self) -> Journal:
        """Lock the robot cell for this engine, and open its journal; `close` gives both up.

        As long as it is locked, no other engine can run on the cell: the file of its journal, a log
        on the local disk, is locked, and on a PostgreSQL server also the cell. Do not call this for
        a store in memory, which is not checked.

        Returns
        -------
        Journal
            The cell's journal, created if need be.

        Raises
        ------
        StoreError
            If another engine has locked the cell, if the file of its journal is no journal, or if
            the store or its journal cannot be written; nothing stays locked. Records that are
            missing or damaged in the journal are not raised: `Journal.loss` has them.
        """
        in_file = self.database.url.get_backend_name() == "sqlite"
        if in_file:
            self.database.check_writable()
        journal = Journal(journal_path(self.database.url, self.cell_id))
        try:
            if not in_file:
                self.database.acquire_lease()
        except StoreError:
            journal.close()
            raise
        self._journal = journal
        return journal

    def apply_records(self, records: Sequence[Record]) -> LabelNumbers:
        """Commit records of a journal, in one transaction unless the database refuses a record.

        A record that repeats a stored one changes nothing. A line stop that is reported after its
        part was confirmed as good corrects the label of the part. Another decision with the same
        id, a label without its decision, and any other second label become an event, "dead letter":
        the store never guesses which of two is right. A record that the database refuses becomes a
        dead letter, too.

        Each dead letter is also logged as an error.

        Returns
        -------
        list of (str, int)
            A pair (decision id, number of its first label) for each decision with a label among the
            records, also with one that was stored before. A dead letter has no pair.

        Raises
        ------
        StoreError
            If the database fails; records that were committed before stay.
        """
        return self._insertion.commit(records)

    def close(self) -> None:
        """Disconnect from the database; a store in memory stays open.

        It waits until another thread has finished writing. Then reads and writes raise StoreError.
        If an engine locked the robot cell (`claim_cell`), its journal (a log on the local disk) is
        closed, too, and keeps the records that the database lacks; another engine can then own the
        cell. A second call changes nothing.
        """
        if not self.database.is_in_memory:
            self.database.close()
        if self._journal is not None:
            self._journal.close()

    def __exit__(self, *exception: object) -> None:
        """Close the store (`close`); an exception of the block passes unchanged."""
        self.close()


def _checked_wait(wait: float | None) -> float:
    """Return a store's time limit in seconds; raise StoreError unless it is above 0 and finite.

    It is `wait`, or if that is None the environment's DENGINE_STORE_WAIT, or 0.4 if that is not set
    or empty. A value that is no number is refused like 0, and so is an int too large for a float.
    """
    value = (os.environ.get(WAIT_VARIABLE) or WAIT) if wait is None else wait
    seconds = math.nan
    with suppress(ValueError, TypeError, OverflowError):
        seconds = float(value)
    expect(
        0.0 < seconds < math.inf,
        f"{WAIT_VARIABLE if wait is None else 'a wait'} above 0 seconds",
        value,
        f"{WAIT} is the default",
        StoreError,
    )
    return seconds
