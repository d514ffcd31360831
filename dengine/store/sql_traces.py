"""Traces as they are read from a database: checked against the sum that each was stored with."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import StoreError
from . import sql_queries as ask
from .chain import row_sum
from .checks import mixed_shapes
from .records import Labelled
from .sql_queue import SqlDatabase
from .sql_rows import CHUNK, unpack_trace
from .sql_tables import TRACE

COLUMNS = tuple(TRACE.c.keys())
NAMED = 20  # decisions that an event names


class SqlTraces:
    """What `SqlStore` reads for training; a class of its own, so that each file is one idea."""

    cell_id: str
    _database: SqlDatabase
    _note: Callable[[str, str], None]

    def labelled(
        self, limit: int | None = None, *, first: int = 1, last: int | None = None, corrected_to: int | None = None
    ) -> Labelled:
        """Return the newest `limit` labelled traces, oldest first; read along the index `label_training`.

        A trace that is not as it was stored is left out; an event names its decision.
        """
        query = ask.newest_query(self.cell_id, limit, int(first), last, corrected_to)
        with self._database.transaction(write=False) as connection:
            newest = connection.execute(query).all()[::-1]
            begin, end = (newest[0].seq, newest[-1].seq) if newest else (1, 0)
            rows = connection.execute(ask.trace_query(self.cell_id, begin, end).execution_options(yield_per=CHUNK))
            sound = sound_traces(rows, [row.seq for row in newest])  # the forgotten are not among them
        if not sound.kept.all():
            self._note("damaged", damage_text([newest[i].decision_id for i in np.flatnonzero(~sound.kept)]))
        return Labelled(
            seq=np.array([row.seq for row in newest], dtype=np.int64)[sound.kept],
            traces=sound.traces,
            labels=_labels(newest)[sound.kept],
            hashes=np.array([row.content_hash for row in newest], dtype=np.int64)[sound.kept],
        )

    def labelled_upto(self, seq: int, limit: int) -> Labelled:
        """Return the newest `limit` labelled traces among the labels up to number `seq`."""
        return self.labelled(limit, last=int(seq))


@dataclass(frozen=True, slots=True)
class SoundTraces:
    """Traces of labels; kept : (n,) which of the labels have theirs as it was stored.  traces : (kept.sum(), C, T)."""

    traces: NDArray[np.float32]
    kept: NDArray[np.bool_]


def sound_traces(rows: Iterable[Any], seqs: Sequence[int]) -> SoundTraces:
    """Read the traces of labels `seqs`, oldest first, one at a time; rows : `trace_query`'s, where some may be missing."""
    traces, kept = np.zeros((0, 0, 0), dtype=np.float32), np.zeros(len(seqs), dtype=bool)
    at = {seq: i for i, seq in enumerate(seqs)}
    first = True
    for row in rows:
        if row.seq not in at or not is_sound(dict(zip(COLUMNS, row, strict=False))):
            continue
        if first:
            traces, first = np.empty((len(seqs), row.channels, row.samples), dtype=np.float32), False
        if (row.channels, row.samples) != traces.shape[1:]:
            raise mixed_shapes({traces.shape[1:], (row.channels, row.samples)})
        traces[at[row.seq]], kept[at[row.seq]] = unpack_trace(row), True
    return SoundTraces(traces if kept.all() else traces[kept[: len(traces)]], kept)


def is_sound(row: dict[str, Any]) -> bool:
    """Whether a row of `trace` is as it was stored; one that an earlier dengine wrote has no sum, and passes."""
    return row["sum"] is None or row_sum(TRACE.name, row) == row["sum"]


def check_trace(row: Any, name: str) -> None:
    """Raise a StoreError where a decision is read with a trace that is not as it was stored."""
    values = {"cell_id": row.cell_id, "decision_id": row.id, "channels": row.channels, "samples": row.samples}
    if not is_sound(values | {"data": row.data, "entry": row.trace_entry, "sum": row.trace_sum}):
        raise StoreError(
            f"Expected the trace of decision {row.id!r} as it was stored in {name}, its bytes have changed; "
            "see `dengine verify`, and restore the store from a copy."
        )


def damage_text(ids: Sequence[str]) -> str:
    """What an event says of decisions whose traces are not as they were stored."""
    more = f" and {len(ids) - NAMED} more" if len(ids) > NAMED else ""
    named = ", ".join(ids[:NAMED])
    return f"left out of training, since the trace is not as it was stored: decision {named}{more}; see dengine verify"


def _labels(rows: Sequence[Any]) -> NDArray[np.int8]:
    """Labels as they count. StoreError for one that a damaged file has made."""
    labels = [row.success for row in rows]
    if not all(label in (0, 1) for label in labels):
        raise StoreError("Expected labels that are True or False, found another: the store is damaged; restore a copy.")
    return np.array(labels, dtype=np.int8)
