"""Where an engine remembers: the contract, a store in memory, and one in a database."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .._lazy import lazy_names

if TYPE_CHECKING:
    from .base import Store, open_store
    from .dump import Dump, dump_store
    from .history import HistoryReport, verify_history
    from .kept_versions import StoredVersion
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
    "dump": ("Dump", "dump_store"),
    "history": ("HistoryReport", "verify_history"),
    "kept_versions": ("StoredVersion",),
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
    "Dump",
    "Event",
    "Evidence",
    "HistoryReport",
    "Labelled",
    "MemoryStore",
    "ModelVersion",
    "NewLabel",
    "Outcomes",
    "SqlStore",
    "Store",
    "StoredDecision",
    "StoredVersion",
    "dump_store",
    "open_store",
    "verify_history",
]

__getattr__, __dir__ = lazy_names(__name__, _WHERE)
