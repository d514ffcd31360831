"""Opening what a user names as a store: nothing, a file, a URL, or a store as it is.

    store = open_store("engine.db")      # SqlStore; `open_store(None)` is a MemoryStore, which forgets

The database behind `SqlStore` is imported where it is used, so that importing this module costs numpy and no more.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import StoreError
from .base import Store
from .memory import MemoryStore
from .records import CellAddress

UNHURRIED = 10.0  # seconds to wait for a store where no cell waits, as its wait


def open_store(
    store: str | os.PathLike[str] | Store | None, *, must_exist: bool = False, wait: float | None = None
) -> Store:
    """Return the store that a user named: nothing (memory), a file or URL (database), or a store as it is.

    A file or URL may say whose rows it means, and what that cell makes: `address`.
    must_exist : a file or a cell that is not there is a StoreError; by default it is made.
    wait : as `SqlStore` takes it; `UNHURRIED` where no cell waits.
    """
    if store is None:
        return MemoryStore()
    if isinstance(store, str | os.PathLike):
        if must_exist:
            must_be_there(store)
        cell_id, product = (store.cell_id, store.product) if isinstance(store, CellAddress) else ("cell", None)
        from .peers import must_have_cell  # SQLAlchemy is imported where it is used
        from .sql import SqlStore

        if must_exist:
            must_have_cell(os.fspath(store), cell_id)
        return SqlStore(os.fspath(store), cell_id, product=product, wait=wait)
    if not isinstance(store, Store):
        raise StoreError(f"Expected None, a file, a URL or a Store, got {type(store).__name__}; see `Store`.")
    return store


def must_be_there(store: str | os.PathLike[str]) -> None:
    """StoreError for a file that is not there; of a database behind a URL nothing is asked."""
    if "://" not in str(store) and not Path(store).is_file():
        raise StoreError(
            f"Expected a store that an engine has used, found no file {store}; "
            "make a DataEngine with it, or let `dengine train` or `dengine run` make one."
        )


@contextmanager
def opening(
    store: str | os.PathLike[str] | Store | None, *, must_exist: bool = False, wait: float | None = None
) -> Iterator[Store]:
    """`open_store`; where what follows fails, a store that was opened here is closed again."""
    opened = open_store(store, must_exist=must_exist, wait=wait)
    try:
        yield opened
    except BaseException:
        if opened is not store:
            opened.close()
        raise
