"""Where an engine remembers: the contract, a store in memory, and one in a database."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .._lazy import lazy_names

if TYPE_CHECKING:
    from .base import Store, open_store
    from .memory import MemoryStore
    from .records import (
        AddedPoints,
        Change,
        Correction,
        Event,
        Evidence,
        Labelled,
        ModelVersion,
        NewLabel,
        Outcomes,
        StoredDecision,
    )
    from .sql import SqlStore

_WHERE = {
    "base": (
        "Store",
        "open_store",
    ),
    "memory": ("MemoryStore",),
    "records": (
        "AddedPoints",
        "Change",
        "Correction",
        "Event",
        "Evidence",
        "Labelled",
        "ModelVersion",
        "NewLabel",
        "Outcomes",
        "StoredDecision",
    ),
    "sql": ("SqlStore",),
}

__all__ = [
    "AddedPoints",
    "Change",
    "Correction",
    "Event",
    "Evidence",
    "Labelled",
    "MemoryStore",
    "ModelVersion",
    "NewLabel",
    "Outcomes",
    "SqlStore",
    "Store",
    "StoredDecision",
    "open_store",
]

__getattr__, __dir__ = lazy_names(__name__, _WHERE)
