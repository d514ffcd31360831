"""Opens what a user names as a store: None (in memory), a file, a URL, or a store that is open
already. `open_store` returns it as an `SqlStore`; `opening` does so for a block, and closes it if
that raises. The engine, the data sets and the command line use them.

    store = open_store("engine.db")      # an SqlStore; open_store(None) is one in memory

`open_outbox` returns an engine's way to such a store while it runs.

SQLAlchemy is imported only when a store is opened, so that importing this module is fast.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from ..errors import StoreError, expect
from ..files import FilePath
from .journalled import JournalledStore
from .memory import MemoryStore
from .outbox import Outbox
from .records import CellAddress

if TYPE_CHECKING:
    from .sql import SqlStore

    StoreLike = FilePath | SqlStore

LONG_WAIT = 10.0  # seconds to wait for a store while no cell runs: the parameter `wait`


def open_store(
    store: StoreLike | None, *, must_exist: bool = False, wait: float | None = None
) -> SqlStore:
    """Open the store that a user named, and create it if need be.

    Parameters
    ----------
    store : None, str, path or SqlStore
        None: a store in memory. A file or URL: a database; a `CellAddress`, a text that `address`
        returns, also names the robot cell and its product (what the cell makes; cells of one
        product share labels and versions), otherwise the cell is "cell". A file is created if need
        be, but not its folder. An open store is returned unchanged.
    must_exist : bool, default False
        Raise a StoreError for a file or cell that does not exist, instead of creating it. Without
        effect on None and on an open store.
    wait : float or None
        Seconds that an engine on this store waits for the disk or database at most. None: the
        environment's DENGINE_STORE_WAIT, or 0.4. Pass `LONG_WAIT` (10) if no cell runs meanwhile.
        Not used for a store in memory or an open one.

    Returns
    -------
    SqlStore

    Raises
    ------
    StoreError
        For an argument of another type, and for a database that cannot be used or is another
        program's. For a ledger (the cell's hash chain) with another key than the one in the file
        that DENGINE_LEDGER_KEY names, and if that file cannot be read or holds fewer than 16 bytes.
        For a cell of another product, a product whose name is blank or not printable, and a product
        for a cell that has worked without one. For a time limit that is not above 0 or not finite
        (that of the environment also for a store in memory).
    """
    from .peers import check_cell_exists  # SQLAlchemy is imported where it is used
    from .sql import SqlStore

    if isinstance(store, SqlStore):
        return store
    if store is None:
        return SqlStore()
    expect(
        isinstance(store, str | os.PathLike),
        "None, a file, a URL or an SqlStore",
        store,
        error=StoreError,
    )
    url = store if isinstance(store, CellAddress) else CellAddress(os.fspath(store), "cell")
    if must_exist:
        check_cell_exists(url, url.cell_id)
    return SqlStore(url, url.cell_id, product=url.product, wait=wait)


@contextmanager
def opening(
    store: StoreLike | None, *, must_exist: bool = False, wait: float | None = None
) -> Iterator[SqlStore]:
    """Context manager that opens a store by `open_store`, with the same arguments, and yields it.

    The store stays open after the block. Only if the block raises, a store that was opened here is
    closed; a store that was passed open is never closed. Raises what `open_store` raises.
    """
    opened = open_store(store, must_exist=must_exist, wait=wait)
    try:
        yield opened
    except BaseException:
        if opened is not store:
            opened.close()
        raise


def open_outbox(
    store: SqlStore, window: int, *, reading: bool = False, patient: bool = False
) -> Outbox:
    """Open the outbox by which an engine records and looks up, in the way that fits its store.

    A `JournalledStore` claims the robot cell, drains what an earlier process left in the journal,
    and starts its threads. Either outbox checks the store; what is not as it was written becomes
    its `integrity_error`, and is not raised. Closing the outbox closes the store, unless that is in
    memory.

    Parameters
    ----------
    store : SqlStore
    window : int
        Number of newest labels that the engine reads.
    reading : bool, default False
        The engine only reads, so it does not own the cell.
    patient : bool, default False
        Wait for disk and database without a time limit, as a `MemoryStore` always does.

    Returns
    -------
    Outbox
        A `MemoryStore` for a store in memory, and for an engine that only reads; else a
        `JournalledStore`.

    Raises
    ------
    StoreError
        If another engine owns the cell, and if the store cannot be read or written.
    """
    if reading or store.database.is_in_memory:
        return MemoryStore(store, window, reading)
    return JournalledStore(store, window, patient)
