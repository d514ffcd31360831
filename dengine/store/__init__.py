"""The memory of an engine in a database: decisions, traces, labels, model versions, events,
settings. `open_store` opens an SQLite file, a PostgreSQL server or memory as an `SqlStore`. The
files of this package hold the tables, queries and records, the local journal through which a
running engine writes, the ledger (a hash chain over all rows), backup, and the verification of the
history.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
