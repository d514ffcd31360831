"""Faults of the store while the cell runs: it is locked, full, slow, moved, replaced, frozen, cut off."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import sqlite3
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from .harness import Cell, Outcome, Place, stream

BEFORE, DURING, AFTER = 100, 40, 60  # parts; a version is stored after 40 labels
OUTAGE = 0.5  # seconds that a fault goes on after the parts that met it


def during(cell: Cell, fault: Any) -> None:
    """Play before, in and after a fault, and look at what became of it."""
    cell.play(BEFORE)
    with fault:
        cell.outcome.injected += 1
        cell.play(DURING)
        time.sleep(OUTAGE)
    cell.until_back()
    cell.play(AFTER)
    cell.finish()


@contextlib.contextmanager
def _locked(place: Place) -> Iterator[None]:
    with contextlib.closing(sqlite3.connect(place.url, isolation_level=None, timeout=30)) as other:
        other.execute("BEGIN IMMEDIATE")
        yield
        other.execute("ROLLBACK")


@contextlib.contextmanager
def _full(cell: Cell) -> Iterator[None]:
    """SQLite's own error for a full disk: the file may not grow by another page."""
    engine = cell.engine.store._database._engine

    def keep_small(connection: Any, *_: object) -> None:
        connection.execute("PRAGMA max_page_count = 1")

    def let_grow(connection: Any, *_: object) -> None:
        connection.execute("PRAGMA max_page_count = 1073741823")

    sa.event.listen(engine, "checkout", keep_small)
    yield
    sa.event.remove(engine, "checkout", keep_small)
    sa.event.listen(engine, "checkout", let_grow)


@contextlib.contextmanager
def _moved(place: Place) -> Iterator[None]:
    file = Path(place.url)
    file.rename(file.with_suffix(".away"))
    yield
    file.with_suffix(".away").rename(file)


@contextlib.contextmanager
def _slow(cell: Cell) -> Iterator[None]:
    database, release = cell.engine.store._database, threading.Event()
    write = database.write

    def wait(work: Any) -> Any:
        release.wait(60)
        return write(work)

    database.write = wait
    yield
    release.set()
    database.write = write


@contextlib.contextmanager
def _no_version(cell: Cell) -> Iterator[None]:
    """A disk that is full whenever a version is stored, and has room for labels."""
    store = cell.engine.store

    def put_version(*_: object) -> None:
        with contextlib.closing(sqlite3.connect(":memory:")) as full:
            full.execute("CREATE TABLE t (x)")
            full.execute("PRAGMA max_page_count = 2")
            store._database.write(lambda connection: full.execute("INSERT INTO t VALUES (zeroblob(100000))"))

    real = store.put_version
    store.put_version = put_version
    yield
    store.put_version = real


def locked(outcome: Outcome, place: Place) -> None:
    """SQLite locked by another process."""
    during(Cell(place, outcome), _locked(place))


def full(outcome: Outcome, place: Place) -> None:
    """The disk full."""
    cell = Cell(place, outcome)
    during(cell, _full(cell))


def no_room_for_versions(outcome: Outcome, place: Place) -> None:
    """The disk full whenever a version is stored."""
    cell = Cell(place, outcome)
    during(cell, _no_version(cell))


def slow(outcome: Outcome, place: Place) -> None:
    """A disk that does not answer."""
    cell = Cell(place, outcome)
    during(cell, _slow(cell))


def moved(outcome: Outcome, place: Place) -> None:
    """The store's file moved away, and put back."""
    during(Cell(place, outcome), _moved(place))


def replaced(outcome: Outcome, place: Place) -> None:
    """The store's file replaced by a copy of itself while it is open."""
    cell = Cell(place, outcome)
    cell.play(BEFORE)
    shutil.copy(place.url, place.url + ".copy")
    Path(place.url + ".copy").replace(place.url)
    _after_a_lost_file(cell, "replaced")


def deleted(outcome: Outcome, place: Place) -> None:
    """The store's file deleted while it is open."""
    cell = Cell(place, outcome)
    cell.play(BEFORE)
    shutil.copy(place.url, place.url + ".copy")
    Path(place.url).unlink()
    _after_a_lost_file(cell, "deleted")


def _after_a_lost_file(cell: Cell, how: str) -> None:
    """What was acknowledged before went with the file; what is acknowledged after must be in the journal."""
    cell.outcome.injected += 1
    cell.acknowledged.clear()
    cell.play(DURING)
    cell.outcome.must(bool(cell.engine._keeper.fault), f"a {how} file was not noticed")
    cell.engine.close()
    copy = Path(cell.place.url + ".copy")
    if copy.exists():
        copy.replace(cell.place.url)
    cell.engine = type(cell.engine).open(cell.place.store())
    cell.finish()


def unstorable(outcome: Outcome, place: Place) -> None:
    """A row that no database takes, past every check, in the queue."""
    cell = Cell(place, outcome)
    cell.play(BEFORE)
    made = cell.engine._maker.decide(stream().X[:1], None, None, 0)
    bad = replace(made, decision=replace(made.decision, id="bad", n_success=2**70))
    cell.engine.store._database._queue["bad"] = bad
    outcome.injected += 1
    cell.play(DURING)
    cell.engine.flush()
    kinds = [event.kind for event in cell.engine.store.events()]
    outcome.must("set aside" in kinds, "the row was not set aside")
    cell.finish()


def frozen(outcome: Outcome, place: Place) -> None:
    """PostgreSQL's process for this cell frozen (SIGSTOP)."""
    cell = Cell(place, outcome)
    during(cell, _frozen(cell))


@contextlib.contextmanager
def _frozen(cell: Cell) -> Iterator[None]:
    pid = _backend(cell)
    os.kill(pid, signal.SIGSTOP)
    yield
    os.kill(pid, signal.SIGCONT)


def cut_off(outcome: Outcome, place: Place) -> None:
    """The connection to PostgreSQL cut."""
    cell = Cell(place, outcome)
    cell.play(BEFORE)
    for _ in range(5):
        admin = sa.create_engine(place.url)
        with admin.connect() as connection:
            connection.execute(sa.text("SELECT pg_terminate_backend(:pid)"), {"pid": _backend(cell)})
        admin.dispose()
        outcome.injected += 1
        cell.play(10)
        cell.until_back()
    cell.finish()


def _backend(cell: Cell) -> int:
    database = cell.engine.store._database
    with database._writing, database._connected(write=True) as connection:
        pid = int(connection.execute(sa.text("SELECT pg_backend_pid()")).scalar())
        connection.rollback()
    return pid


ON_SQLITE = (locked, full, no_room_for_versions, slow, moved, replaced, deleted, unstorable)
ON_POSTGRES = (frozen, cut_off)
