"""The store in a database: SQLite in a file, or PostgreSQL by URL for a fleet.

    store = SqlStore("engine.db", cell_id="cell-7")
    store = SqlStore("postgresql+psycopg://user:password@host/database", cell_id="cell-7")

What a returned call promises, given a disk that keeps what it synced: all that is put is committed, but for `put_decision`:
its row is queued, and committed within about 50 ms by a writer thread, by `flush`, or together with the next label.

One engine owns a cell of a database: the lease, and what its journal held back, written when the database is there.

The model versions of a store in a database: stored, checked when they are loaded, and thinned out.

What a database keeps of an engine's history: versions, events, corrections. No row of it ever changes.

Traces as they are read from a database: checked against the sum that each was stored with.
"""

from __future__ import annotations

import hashlib
import math
import os
import time
import urllib.parse
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import sqlalchemy as sa
from numpy.typing import NDArray

from ..errors import StoreError, shortened
from ..records import Decision, Reason, RetrainReport, Source
from . import queries as ask
from .connections import SqlDatabase
from .journal import Journal, LateEvent, LateLabel, Record, owned_by, owner
from .ledger import row_sum, state_sum
from .peers import News, ProductShare, without_rule
from .queries import Scope, held_query, newest_of
from .records import (
    KEEP,
    STATUS_EVENTS,
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
    StoredVersion,
    VersionError,
    as_data,
    as_hash,
    as_label,
    as_text,
    check_decision,
    check_import,
    check_keep,
    check_state,
    checked_decision,
    checked_label,
    duplicate_id,
    from_row,
    imported_labels,
    keeps_state,
    mixed_shapes,
    not_kept,
    nothing_to_correct,
    refuse_repeats,
    stack,
    to_row,
    unknown_decision,
    unpack,
)
from .schema import (
    CHUNK,
    CORRECTION,
    EVENT,
    LABEL,
    RESERVED,
    SETTING,
    TRACE,
    VERSION,
    chunks,
    from_npz,
    label_row,
    read_decision,
    version_row,
)
from .view_queries import SqlViews
from .views import count_outcomes, summary

if TYPE_CHECKING:
    from .verification import HistoryReport

WAIT = 0.4  # seconds that an engine waits for the database
WAIT_VARIABLE = "DENGINE_STORE_WAIT"  # of the environment: other seconds for all stores that are given none
Arrived = tuple[str, int]  # a decision's id, the number of its label


def checked_wait(wait: float | None) -> float:
    """Return the seconds that an engine waits for its store; None: as the environment says, or 0.4. StoreError for less."""
    said = os.environ.get(WAIT_VARIABLE) if wait is None else None
    name = "a wait" if said is None else WAIT_VARIABLE
    try:
        seconds = float(said) if said else WAIT if wait is None else wait
    except ValueError:
        seconds = math.nan
    if not 0.0 < seconds < math.inf:
        raise StoreError(f"Expected {name} above 0 seconds, got {shortened(said or wait)}; {WAIT} is the default.")
    return seconds


def journal_path(url: sa.URL, cell_id: str) -> Path:
    """Return where a cell's journal lies: beside an SQLite file, else in the user's folder of state, `XDG_STATE_HOME`."""
    name = urllib.parse.quote(cell_id, safe="")
    if url.get_backend_name() == "sqlite":
        return Path(f"{Path(str(url.database)).absolute()}.{name}.journal")
    state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "dengine"
    where = hashlib.sha256(f"{url.host}:{url.port}/{url.database}/{cell_id}".encode()).hexdigest()[:12]
    return state / f"{name[:60]}.{where}.journal"


def lease_key(cell_id: str) -> int:
    """Return the number of a cell's advisory lock in a PostgreSQL database."""
    return int.from_bytes(hashlib.sha256(b"dengine " + cell_id.encode()).digest()[:8], "big", signed=True)


def take_lease(connection: sa.Connection, cell_id: str, name: str) -> None:
    """Lock a cell for as long as this PostgreSQL connection lives; StoreError where another engine has it."""
    connection.execute(sa.text("SELECT set_config('application_name', :who, false)"), {"who": f"dengine {owner()}"[:63]})
    key = lease_key(cell_id)
    if connection.execute(sa.text("SELECT pg_try_advisory_lock(:key)"), {"key": key}).scalar():
        return
    asked = sa.text(
        "SELECT a.application_name FROM pg_locks l JOIN pg_stat_activity a USING (pid) WHERE l.locktype = 'advisory' "
        "AND (l.classid::bigint << 32) + l.objid::bigint = :key AND l.objsubid = 1 AND l.granted"
    )
    holder = connection.execute(asked, {"key": key}).scalar()
    raise owned_by(str(holder or "another engine"), f"cell {cell_id!r} of {name}")


class SqlOwning:
    """What a store in a database does for the one engine that owns its cell."""

    cell_id: str
    _database: SqlDatabase
    _journal: Journal | None = None

    @property
    def remote(self) -> bool:
        """Whether the database is on a server, which may be away while this machine's disk is well."""
        return self._database.url.get_backend_name() != "sqlite"

    def committing(self, wanted: Callable[[], bool]) -> AbstractContextManager[None]:
        """Within this, in this thread, a transaction that is not wanted any more when it would commit is rolled back."""
        return self._database.committing(wanted)

    def own(self) -> Journal:
        """Claim the cell for one engine; StoreError where another one has it, on this or another machine."""
        journal = Journal(journal_path(self._database.url, self.cell_id))
        try:
            if self.remote:
                self._database.lease(lambda connection: take_lease(connection, self.cell_id, self._database.name))
        except StoreError:
            journal.close()
            raise
        self._journal = journal
        return journal

    def close(self) -> None:
        """Flush, stop the writer and disconnect; if the flush fails the store stays open, so close it again later."""
        self._database.close()
        if self._journal is not None:
            self._journal.close()

    def let_go(self) -> None:
        """Stop and disconnect without writing or waiting: the journal holds what is missing."""
        self._database.let_go()

    def play_back(self, records: Sequence[Record]) -> tuple[list[Arrived], list[str]]:
        """Write what a journal held, in one transaction; what is stored already counts as written, for its answer got lost.

        Returns the numbers of the labels by their decisions, and what could not be written, in words.
        """
        decisions = [record for record in records if isinstance(record, StoredDecision)]
        labels = [record for record in records if isinstance(record, LateLabel)]
        events = [record for record in records if isinstance(record, LateEvent)]

        def write(connection: sa.Connection) -> tuple[list[Arrived], list[str]]:
            self._database.insert_new(connection, decisions)
            _write_events(self._database, connection, events)
            return _write_labels(self._database, connection, labels)

        return self._database.write(write)


def _write_events(database: SqlDatabase, connection: sa.Connection, events: Sequence[LateEvent]) -> None:
    number = database.next_number(connection, EVENT.c.number)
    for event in events:
        if _is_new(connection, database.cell_id, event):
            row = {"cell_id": database.cell_id} | to_row(Event(number, event.time, event.kind, event.text))
            connection.execute(sa.insert(EVENT), row)
            number += 1


def _write_labels(
    database: SqlDatabase, connection: sa.Connection, labels: Sequence[LateLabel]
) -> tuple[list[Arrived], list[str]]:
    number = database.next_number(connection, LABEL.c.seq)
    ids = [late.label.decision_id for late in labels]
    held = {row.id: row for part in chunks(ids) for row in connection.execute(held_query(database.cell_id, part))}
    arrived: list[Arrived] = []
    refused: list[str] = []
    said: dict[str, tuple[bool, str]] = {
        name: (row.success, row.source) for name, row in held.items() if row.source is not None
    }
    for late in labels:
        label, row = late.label, held.get(late.label.decision_id)
        now = (label.success, label.source.value)
        if row is None:
            refused.append(f"a label on {label.decision_id!r}, which the store does not hold: {_words(*now)}")
        elif said.setdefault(label.decision_id, now) != now:
            first = said[label.decision_id]
            refused.append(f"a second label on {label.decision_id!r}: {_words(*now)} after {_words(*first)}")
        elif row.source is not None or label.decision_id in {name for name, _ in arrived}:
            arrived.append((label.decision_id, _number_of(database, connection, label.decision_id)))
        else:
            values = label_row(database.cell_id, label, number, late.time, row.content_hash, row.quarantined)
            connection.execute(sa.insert(LABEL), values)
            arrived.append((label.decision_id, number))
            number += 1
    return arrived, refused


def _words(success: bool, source: str) -> str:
    return f"{'success' if success else 'failure'} from {Source(source).value}"


def _number_of(database: SqlDatabase, connection: sa.Connection, decision_id: str) -> int:
    mine = (LABEL.c.cell_id == database.cell_id) & (LABEL.c.decision_id == decision_id)
    return int(connection.execute(sa.select(LABEL.c.seq).where(mine)).scalar_one())


def _is_new(connection: sa.Connection, cell_id: str, event: LateEvent) -> bool:
    same = (EVENT.c.cell_id == cell_id) & (EVENT.c.time == event.time) & (EVENT.c.kind == event.kind)
    return connection.execute(sa.select(EVENT.c.number).where(same, EVENT.c.text == event.text)).first() is None


class SqlVersions:
    """What `SqlStore` does with versions; a class of its own, so that each file is one idea."""

    cell_id: str
    keep_versions: int | None
    _clock: Callable[[], float]
    _database: SqlDatabase
    _read: Callable[[sa.Select[Any]], Sequence[Any]]
    _note: Callable[[str, str], None]

    def put_version(self, report: RetrainReport, last_seq: int, state: Mapping[str, NDArray[Any]] | None) -> int:
        """Commit a retrain, and let go of states that `keeps_state` does not keep; returns the version's number."""
        row = version_row(self.cell_id, report, int(last_seq), self._clock(), check_state(report, state))

        return self._database.write(lambda connection: self._add_version(connection, row))

    def _add_version(self, connection: sa.Connection, row: dict[str, Any]) -> int:
        retrain = self._database.next_number(connection, VERSION.c.retrain)
        number = self._database.scope.next_version(connection, row["version"], row["accepted"])
        connection.execute(sa.insert(VERSION), row | {"retrain": retrain, "version": number})
        if row["accepted"]:
            self._thin_out(connection, number)
        return number

    def _thin_out(self, connection: sa.Connection, newest: int) -> None:
        held = connection.execute(ask.held_states_query(self._database.scope)).all()
        gone = [row.retrain for row in held if not keeps_state(row.version, newest, self.keep_versions)]
        if gone:
            mine = self._database.scope.shared(VERSION.c.cell_id) & VERSION.c.retrain.in_(gone)
            connection.execute(sa.update(VERSION).where(mine).values(state=None))

    def last_version(self) -> ModelVersion | None:
        """Return the newest accepted version whose state is as it was stored; of a damaged one an event tells."""
        for i, row in enumerate(self._read(ask.accepted_query(self._database.scope))):
            if not row.kept and i > 0:
                continue  # thinned out, which the newest never is
            try:
                return self._loaded(row.retrain)
            except VersionError as error:
                self._note("damaged", f"{error} The accepted version before it answers.")
        return None

    def load_version(self, version: int) -> ModelVersion:
        """Return an accepted version by its number. StoreError where its state is not kept, or is damaged."""
        held = [row for row in self._read(ask.accepted_query(self._database.scope)) if row.kept]
        found = [row.retrain for row in held if row.version == version]
        if not found:
            raise not_kept(version, [row.version for row in held])
        return self._loaded(found[0])

    def kept_version(self, version: int) -> ModelVersion | None:
        """Return an accepted version; None where it is not kept, or is damaged."""
        try:
            return self.load_version(version)
        except VersionError:
            return None

    def _loaded(self, retrain: int) -> ModelVersion:
        row = self._read(ask.version_query(self._database.scope, retrain))[0]
        if row.state is None or (row.state_sum is not None and state_sum(row.state) != row.state_sum):
            raise VersionError(
                f"Expected the state of version {row.version} as it was stored in {self._database.name}, "
                "its bytes have changed; restore the store from a copy."
            )
        try:
            state = from_npz(row.state, self._database.name)
        except StoreError as error:
            raise VersionError(str(error)) from error
        if row.cell_id != self.cell_id:  # what a sister's parts taught its rule says nothing certain of this cell
            state = without_rule(state) | {"told_to": np.array(0)}
        return ModelVersion(row.version, row.last_seq, state)

    def versions(self) -> list[StoredVersion]:
        """Return every retrain, oldest first, and whether its state is kept."""
        rows = self._read(ask.versions_query(self._database.scope))
        return [
            StoredVersion(row.version, row.time, row.accepted, row.reason, row.n_bytes or 0, row.n_bytes is not None)
            for row in rows
        ]

    def retrains(self) -> list[RetrainReport]:
        """Return every retrain, oldest first."""
        return [RetrainReport(*row) for row in self._read(ask.retrain_query(self._database.scope))]


class SqlHistory(SqlVersions, ProductShare):
    """The part of `SqlStore` that is about its history."""

    def _read(self, query: sa.Select[Any]) -> Sequence[Any]:
        with self._database.transaction(write=False) as connection:
            return connection.execute(query).all()

    # Events

    def put_event(self, kind: str, text: str, data: Mapping[str, Any] | None = None, author: str = "") -> None:
        """Commit what happened to the cell's log."""
        self.record(Change(kind, text, data, author))

    def _note(self, kind: str, text: str) -> None:
        """Commit an event, unless one of these very words is there."""
        if not self._read(ask.said_query(self.cell_id, as_text(kind), as_text(text))):
            self.put_event(kind, text)

    def events(self, limit: int | None = None) -> list[Event]:
        """Return the newest `limit` events, oldest first."""
        return [from_row(Event, row._mapping) for row in self._read(ask.event_query(self.cell_id, limit))[::-1]]

    # Corrections

    def record(self, change: Change) -> int:
        """Commit what a person changed, in one transaction with its event, whose number it returns."""
        now, author = self._clock(), as_text(change.author)
        said = Event(0, now, as_text(change.kind), as_text(change.text), as_data(change.data), author)
        version: dict[str, Any] | None = None
        if change.version is not None:
            report, last_seq, state = change.version
            version = version_row(self.cell_id, report, int(last_seq), now, check_state(report, state))
        settle = None if change.settings is None else replacing(self.cell_id, change.settings)

        def add(connection: sa.Connection) -> int:
            number = self._database.next_number(connection, EVENT.c.number)
            connection.execute(sa.insert(EVENT), {"cell_id": self.cell_id} | to_row(said) | {"number": number})
            if change.decisions:
                self._correct(connection, change, author, number, now)
            if version is not None:
                self._add_as_numbered(connection, version)
            if change.settings is not None and settle is not None:
                self._refuse_disagreement(connection, change.settings)
                settle(connection)
            return number

        return self._database.write(add)

    def _add_as_numbered(self, connection: sa.Connection, row: dict[str, Any]) -> None:
        number = self._add_version(connection, row)
        if number != row["version"]:
            raise StoreError(
                f"Expected version {row['version']} to be the next, a sister of the product stored {number - 1} meanwhile; "
                "try it again."
            )

    def _correct(self, connection: sa.Connection, change: Change, author: str, event: int, now: float) -> None:
        found = [row for part in chunks(change.decisions) for row in connection.execute(ask.held_query(self.cell_id, part))]
        was = {row.id: row.counted for row in found}
        for name in change.decisions:
            if name not in was:
                raise unknown_decision(name)
            if was[name] is None:
                raise nothing_to_correct(name)
        first = self._database.next_number(connection, CORRECTION.c.number)
        newest = self._database.next_number(connection, LABEL.c.seq) - 1
        said = {"success": change.success, "author": author, "event": event, "newest_seq": newest, "time": now}
        rows = [
            said | {"cell_id": self.cell_id, "number": first + i, "decision_id": name, "was": as_label(was[name])}
            for i, name in enumerate(change.decisions)
        ]
        for part in chunks(rows):
            connection.execute(sa.insert(CORRECTION), part)

    def corrections(self, after: int = 0) -> list[Correction]:
        """Return the corrections after number `after`, oldest first."""
        return [Correction(*row) for row in self._read(ask.correction_query(self._database.scope, int(after)))]

    def _corrected(self) -> dict[str, int]:
        """How many decisions count otherwise than they were reported, and how many are forgotten."""
        rows = self._read(ask.corrected_query(self.cell_id))
        forgotten = sum(n for success, n in rows if success is None)
        return {"forgotten": forgotten, "corrected": sum(n for _, n in rows) - forgotten}


def replacing(cell_id: str, settings: Mapping[str, str]) -> Callable[[sa.Connection], None]:
    """What puts these settings in the place of a cell's present ones."""
    for key in sorted(settings.keys() & set(RESERVED)):
        raise StoreError(f"Expected settings of the engine, got {key!r}, which is the store's; rename it.")
    rows = [{"cell_id": cell_id, "key": key, "value": value} for key, value in settings.items()]
    mine = (SETTING.c.cell_id == cell_id) & SETTING.c.key.not_in(RESERVED)

    def replace(connection: sa.Connection) -> None:
        connection.execute(sa.delete(SETTING).where(mine))
        if rows:
            connection.execute(sa.insert(SETTING), rows)

    return replace


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
        traces[at[row.seq]], kept[at[row.seq]] = unpack(row.data).reshape(row.channels, row.samples), True
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


class SqlStore(SqlOwning, SqlHistory, SqlTraces, SqlViews):
    """The contract of `Store` in a database.

    url : a file (SQLite), or a SQLAlchemy URL of SQLite or PostgreSQL.
    cell_id : whose rows these are; several cells share one database without seeing each other.
    clock : the time in seconds that rows are stamped with.
    product : what the cell makes; cells of one product share labels and versions. None: as a known cell has it, or
        nothing is shared.
    wait : seconds that a cell's engine waits for the database at most; what takes longer goes to the journal beside it.
        None: as the environment's DENGINE_STORE_WAIT says, or 0.4.
    keep_versions : newest model versions that keep their states, beside the first and a few older ones (`keeps_state`);
        None: all keep them. A retrain itself stays listed for ever.

    SQLite runs in WAL mode with synchronous=FULL; WAL needs a local disk, not a network drive. Two processes may open one
    cell: label numbers stay unique and increasing. Engines own their cell (`own`): a second one is refused.

    A write that fails leaves its decisions in the queue; it is tried again every second and by each following
    `flush` or report, which raises `StoreError` if it fails again. `status()["write_failures"]` counts failures.
    The queue holds 64 MB of traces; beyond that `put_decision` writes them itself, or says that it cannot.
    """

    def __init__(
        self,
        url: str,
        cell_id: str = "cell",
        clock: Callable[[], float] = time.time,
        *,
        product: str | None = None,
        wait: float | None = None,
        keep_versions: int | None = KEEP,
    ) -> None:
        """Open or create the store, and start its writer thread."""
        if not cell_id:
            raise StoreError("Expected a cell_id that names the cell, got an empty one; use for example 'cell'.")
        self.cell_id = cell_id
        self.keep_versions = check_keep(keep_versions)
        self._clock, self.wait = clock, checked_wait(wait)
        self._database = SqlDatabase(str(url), cell_id, clock, product)

    def settings(self) -> dict[str, str]:
        """What `save_settings` was given; {} for a new store."""
        query = sa.select(SETTING).where(SETTING.c.cell_id == self.cell_id, SETTING.c.key.not_in(RESERVED))
        return {row.key: row.value for row in self._read(query)}

    def save_settings(self, settings: Mapping[str, str]) -> None:
        """Replace the settings by these."""
        replace = replacing(self.cell_id, settings)

        def save(connection: sa.Connection) -> None:
            self._refuse_disagreement(connection, settings)
            replace(connection)

        self._database.write(save)

    # Decisions

    def put_decision(
        self,
        decision: Decision,
        trace: NDArray[np.float32],
        content_hash: int,
        quarantined: bool,
    ) -> None:
        """Queue a decision and its trace for the writer thread."""
        self._database.put(checked_decision(decision, trace, content_hash, quarantined, self._clock()))

    def flush(self) -> None:
        """Return when every decision so far is committed."""
        self._database.flush()

    def get_decision(self, decision_id: str) -> StoredDecision | None:
        """Return the decision with its trace, queued ones included; None where it is unknown.

        StoreError where the trace is not as it was stored.
        """
        item = self._database.queued(decision_id)
        if item is not None:
            return replace(item, trace=item.trace.copy())
        rows = self._read(ask.decision_query(self.cell_id, decision_id))
        if not rows:
            return None
        check_trace(rows[0], self._database.name)
        return read_decision(rows[0])

    def decision_ids(self) -> list[str]:
        """Return the ids of every decision, in any order; what is queued is written first."""
        self.flush()
        with self._database.transaction(write=False) as connection:
            return list(connection.execute(ask.ids_query(self.cell_id)).scalars())

    # Labels

    def put_label(
        self,
        decision_id: str,
        success: bool,
        source: Source,
        model_version: int,
        point: NDArray[np.float32] | None,
        *,
        silent: int = 0,
    ) -> int:
        """Commit a label, in one transaction with its decision where that still waits; returns its number."""
        return int(self.put_labels([NewLabel(decision_id, success, source, model_version, point, silent)])[0])

    def put_labels(self, labels: Sequence[NewLabel]) -> NDArray[np.int64]:
        """Commit labels in one transaction, all or none, with decisions that still wait; returns their numbers."""
        given, now = [checked_label(label) for label in labels], self._clock()

        def add(connection: sa.Connection) -> NDArray[np.int64]:
            first = self._database.next_number(connection, LABEL.c.seq)
            held = self._held_of(connection, given)
            for part in chunks(range(len(given))):
                rows = [label_row(self.cell_id, given[i], first + i, now, *held[given[i].decision_id]) for i in part]
                connection.execute(sa.insert(LABEL), rows)
            return np.arange(first, first + len(given), dtype=np.int64)

        return self._database.write(add)

    def _held_of(self, connection: sa.Connection, labels: Sequence[NewLabel]) -> dict[str, tuple[int, bool]]:
        """Return what labels repeat of their decisions; a ReportError where one is unknown, or labelled already."""
        parts = chunks([label.decision_id for label in labels])
        found = [row for part in parts for row in connection.execute(ask.held_query(self.cell_id, part))]
        held = {row.id: (row.content_hash, row.quarantined) for row in found}
        refuse_repeats(labels, held, {row.id: (row.success, Source(row.source)) for row in found if row.source is not None})
        return held

    def put_labelled(
        self,
        decisions: Sequence[Decision],
        traces: NDArray[np.float32],
        hashes: NDArray[np.int64],
        labels: NDArray[np.int8],
        source: Source,
    ) -> NDArray[np.int64]:
        """Import labelled traces in one transaction, all or none; returns their sequence numbers."""
        traces, now = check_import(decisions, traces, hashes, labels), self._clock()
        given = imported_labels(decisions, labels, source)
        for decision in decisions:
            check_decision(decision)
            if self._database.queued(decision.id) is not None:
                raise duplicate_id(decision.id)

        def load(connection: sa.Connection) -> NDArray[np.int64]:
            first = self._database.next_number(connection, LABEL.c.seq)
            self._refuse_known(connection, [decision.id for decision in decisions])
            for part in chunks(range(len(decisions))):
                items = [StoredDecision(decisions[i], traces[i], as_hash(hashes[i]), False, now) for i in part]
                self._database.insert(connection, items)
                rows = [label_row(self.cell_id, given[i], first + i, now, as_hash(hashes[i]), False) for i in part]
                connection.execute(sa.insert(LABEL), rows)
            return np.arange(first, first + len(decisions), dtype=np.int64)

        return self._database.write(load)

    def _refuse_known(self, connection: sa.Connection, ids: Sequence[str]) -> None:
        for part in chunks(ids):
            known = connection.execute(ask.held_query(self.cell_id, part)).first()
            if known is not None:
                raise duplicate_id(known.id)

    def points_since(self, seq: int, model_version: int) -> AddedPoints:
        """Return the points of `model_version` that came with labels after `seq`."""
        rows = self._read(ask.points_query(self.cell_id, int(seq), int(model_version)))
        seqs = np.array([row.seq for row in rows], dtype=np.int64)
        return AddedPoints(seqs, stack([unpack(row.point) for row in rows], (0, 0)))

    def evidence_since(self, seq: int, since_version: int = 0) -> Evidence:
        """Return what became of this cell's decisions whose labels came after `seq`, without the quarantined and forgotten.

        A product's other cells are left out: a level that their streams certify says nothing certain of this one's, and
        a watch that counts them would notice too late that this cell has changed.
        """
        rows = self._read(ask.evidence_query(self.cell_id, int(seq), int(since_version)))
        return Evidence(
            seq=np.array([row.seq for row in rows], dtype=np.int64),
            lower=np.array([row.lower for row in rows], dtype=np.float64),
            upper=np.array([row.upper for row in rows], dtype=np.float64),
            success=np.array([row.success for row in rows], dtype=bool),
            novel=np.array([row.reason == Reason.NOVEL for row in rows], dtype=bool),
            silent=np.array([row.silent for row in rows], dtype=np.int64),
        )

    def unreported_accepts(self, since_version: int = 0) -> list[str]:
        """Return the ids of accepted decisions without a label, oldest first; what is queued is written first."""
        self.flush()
        query = partial(ask.unreported_query, self.cell_id, since=int(since_version))
        with self._database.transaction(write=False) as connection:
            return list(connection.execute(query(connection.dialect.name)).scalars())

    def silent_total(self, since_version: int = 0) -> int:
        """Return how many accepted parts went on unheard of, over all labels but the quarantined ones."""
        return int(self._read(ask.silent_query(self.cell_id, int(since_version)))[0][0])

    def outcomes(self, since_version: int = 0) -> Outcomes:
        """Count what became of what the model was certain of; what is queued is written first."""
        self.flush()
        return count_outcomes(tuple(row) for row in self._read(ask.outcome_query(self.cell_id, int(since_version))))

    # Overview

    def verify(self, expect: str | None = None) -> HistoryReport:
        """Check this cell's history against its ledger; what is queued is written first. See `verify_history`."""
        from .verification import verify_history

        self.flush()
        return verify_history(self._database.url.render_as_string(hide_password=False), self.cell_id, expect)

    def status(self) -> dict[str, Any]:
        """Count decisions, labels and versions, and show the newest events; what is queued is written first."""
        self.flush()
        kinds, sources = self._read(ask.kind_query(self.cell_id)), self._read(ask.source_query(self.cell_id))
        return summary(
            self.cell_id,
            [(row[0], row[1], row[2], row[3]) for row in kinds],
            {row.source: row.n for row in sources},
            self.retrains(),
            (min((row.first for row in kinds), default=None), max((row.last for row in kinds), default=None)),
            max((row.last for row in sources), default=None),
            self.events(STATUS_EVENTS),
            self._database.failures,
            self._corrected(),
        ) | ({} if self.product is None else {"product": self.product})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
