"""Opening what a user names as a store: nothing, a file, a URL, or a store as it is.

    store = open_store("engine.db")      # SqlStore; `open_store(None)` is one in memory

The database behind `SqlStore` is imported where it is used, so that importing this module costs numpy and no more.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from ..errors import StoreError, expect
from .records import CellAddress

if TYPE_CHECKING:
    from .sql import SqlStore

    StoreLike = str | os.PathLike[str] | SqlStore

UNHURRIED = 10.0  # seconds to wait for a store where no cell waits, as its wait


def open_store(store: StoreLike | None, *, must_exist: bool = False, wait: float | None = None) -> SqlStore:
    """Return the store that a user named: nothing (memory), a file or URL (database), or a store as it is.

    A file or URL may say whose rows it means, and what that cell makes: `address`.
    must_exist : a file or a cell that is not there is a StoreError; by default it is made.
    wait : as `SqlStore` takes it; `UNHURRIED` where no cell waits.
    """
    from .peers import must_have_cell  # SQLAlchemy is imported where it is used
    from .sql import SqlStore

    if isinstance(store, SqlStore):
        return store
    named = store is None or isinstance(store, str | os.PathLike)
    expect(named, "None, a file, a URL or an SqlStore", store, error=StoreError)
    if store is None:
        return SqlStore()
    cell_id, product = (store.cell_id, store.product) if isinstance(store, CellAddress) else ("cell", None)
    if must_exist:
        must_have_cell(os.fspath(store), cell_id)
    return SqlStore(os.fspath(store), cell_id, product=product, wait=wait)


@contextmanager
def opening(store: StoreLike | None, *, must_exist: bool = False, wait: float | None = None) -> Iterator[SqlStore]:
    """`open_store`; where what follows fails, a store that was opened here is closed again."""
    opened = open_store(store, must_exist=must_exist, wait=wait)
    try:
        yield opened
    except BaseException:
        if opened is not store:
            opened.close()
        raise
