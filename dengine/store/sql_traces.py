"""Traces as they are read from a database: checked against the sum that each was stored with."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sqlalchemy as sa
from numpy.typing import NDArray

from ..errors import StoreError
from . import sql_queries as ask
from .chain import row_sum
from .checks import mixed_shapes
from .fleet import News
from .records import Labelled
from .sql_queue import SqlDatabase
from .sql_rows import CHUNK, unpack_trace
from .sql_scope import Scope, newest_of
from .sql_tables import CORRECTION, LABEL, TRACE, VERSION

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
        scope = self._database.scope
        query = ask.newest_query(scope, limit, int(first), last, corrected_to)
        with self._database.transaction(write=False) as connection:
            rows = self._newest(connection, query, limit, last)[::-1]
            sound = self._sound(connection, rows, scope)
        return self._labelled(rows, sound)

    def _newest(self, connection: sa.Connection, query: ask.Query, limit: int | None, last: int | None) -> Sequence[Any]:
        """The newest labels, newest first. Of a product: by their numbers, or all would be read to be sorted."""
        scope = self._database.scope
        if scope.product is not None and limit is not None:
            newest = connection.execute(newest_of(scope.product, LABEL.c.seq)).scalar() or 0
            newest = newest if last is None else min(newest, last)
            rows = connection.execute(query.where(LABEL.c.seq > newest - 2 * limit)).all()
            if len(rows) == limit or newest <= 2 * limit:
                return rows
        return connection.execute(query).all()  # more than every second is quarantined or forgotten

    def _sound(self, connection: sa.Connection, rows: Sequence[Any], scope: Scope) -> SoundTraces:
        """The traces of labels, oldest first, read one after the other."""
        first, last = (rows[0].seq, rows[-1].seq) if rows else (1, 0)
        found = connection.execute(ask.trace_query(scope, first, last).execution_options(yield_per=CHUNK))
        return sound_traces(found, [row.seq for row in rows])  # the forgotten are not among them

    def _labelled(self, rows: Sequence[Any], sound: SoundTraces) -> Labelled:
        """What was read, once its transaction is over: damage is an event."""
        if not sound.kept.all():
            self._note("damaged", damage_text([rows[i].decision_id for i in np.flatnonzero(~sound.kept)]))
        return Labelled(
            seq=np.array([row.seq for row in rows], dtype=np.int64)[sound.kept],
            traces=sound.traces,
            labels=_labels(rows)[sound.kept],
            hashes=np.array([row.content_hash for row in rows], dtype=np.int64)[sound.kept],
        )

    def news_since(self, seq: int, limit: int) -> News:
        """Labels of the product after `seq`, at most `limit`, its newest version's number, and its newest correction's."""
        scope = self._database.scope
        with self._database.transaction(write=False) as connection:
            rows = connection.execute(ask.news_query(scope, int(seq), limit)).all()
            sound, version, correction = self._sound(connection, rows, scope), 0, 0
            if scope.product is not None:
                accepted = newest_of(scope.product, VERSION.c.version, VERSION.c.accepted == sa.true())
                version = connection.execute(accepted).scalar() or 0
                correction = connection.execute(newest_of(scope.product, CORRECTION.c.number)).scalar() or 0
        return News(self._labelled(rows, sound), version, correction)

    def own_labelled(self) -> Labelled:
        """Return this cell's own labelled traces, all of them, oldest first."""
        own = Scope(self.cell_id)
        with self._database.transaction(write=False) as connection:
            rows = connection.execute(ask.newest_query(own, None)).all()[::-1]
            sound = self._sound(connection, rows, own)
        return self._labelled(rows, sound)

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
