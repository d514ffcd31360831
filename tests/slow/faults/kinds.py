"""Faults while the cell runs: its store locked, full, slow, moved, replaced, cut off; its executor, Ctrl-C, a fork."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import sqlite3
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import sqlalchemy as sa

from dengine import Reason
from dengine.engine import trainer
from dengine.errors import StoreError

from .disk import closed_while_hung, failing_disk, hung_disk, run_over_a_hung_disk
from .harness import Cell, Outcome, Place, stream

BEFORE, DURING, AFTER = 100, 40, 60  # parts; a version is stored after 40 labels
OUTAGE = 0.5  # seconds that a fault goes on after the parts that met it
AWAY = 1.5  # seconds after which a store is not slow, but away
ODD = "no-database-takes-it"


def during(cell: Cell, fault: Any, away: bool = False) -> None:
    """Play before, in and after a fault, and look at what became of it."""
    cell.play(BEFORE)
    with fault:
        cell.outcome.injected += 1
        cell.play(DURING)
        time.sleep(AWAY if away else OUTAGE)
        if away:
            decisions = [cell.engine.decide(x) for x in stream().X[:5]]
            cell.outcome.must(Reason.NO_STORE not in {d.reason for d in decisions}, "verified, though the journal is well")
            cell.outcome.must(bool(cell.engine.store_fault), "nobody was told that the store is away")
    cell.until_back()
    cell.play(AFTER)
    cell.finish()


def locked(outcome: Outcome, place: Place) -> None:
    """SQLite locked by another process."""
    during(Cell(place, outcome), lock(place), away=True)


@contextlib.contextmanager
def lock(place: Place) -> Iterator[None]:
    """Another connection's write transaction."""
    with contextlib.closing(sqlite3.connect(place.url, isolation_level=None, timeout=30)) as other:
        other.execute("BEGIN IMMEDIATE")
        yield
        other.execute("ROLLBACK")


@contextlib.contextmanager
def moved_away(file: Path) -> Iterator[None]:
    """The file under another name."""
    away = file.with_suffix(".away")
    file.rename(away)
    yield
    away.rename(file)


def moved(outcome: Outcome, place: Place) -> None:
    """The store's file moved away, and put back."""
    during(Cell(place, outcome), moved_away(Path(place.url)), away=True)


def full(outcome: Outcome, place: Place) -> None:
    """The disk full: SQLite may not grow its file by another page."""
    during(Cell(place, outcome), _full())


@contextlib.contextmanager
def _full() -> Iterator[None]:
    most = 1

    def bound(connection: Any, *_: object) -> None:
        if isinstance(connection, sqlite3.Connection):
            connection.execute(f"PRAGMA max_page_count = {most}")

    sa.event.listen(sa.pool.Pool, "checkout", bound)  # it stays, so that every connection may grow again
    yield
    most = 1073741823


@contextlib.contextmanager
def _statements(react: Callable[[str, Any], None]) -> Iterator[None]:
    """Do this before each statement of any store in this process."""

    def before(connection: Any, cursor: Any, statement: str, parameters: Any, *_: object) -> None:
        react(statement, parameters)

    sa.event.listen(sa.Engine, "before_cursor_execute", before)
    try:
        yield
    finally:
        sa.event.remove(sa.Engine, "before_cursor_execute", before)


def lost_journal(outcome: Outcome, place: Place) -> None:
    """The journal deleted, moved, or its folder removed, while the store is locked."""
    cell = Cell(place, outcome)
    cell.play(BEFORE)
    journal = Path(f"{place.url}.{place.cell}.journal")
    with lock(place):
        for lose in (Path.unlink, lambda file: file.rename(f"{file}.away")):
            cell.play(10)
            lose(journal)
            outcome.injected += 1
            cell.play(10)
            outcome.must(journal.exists(), "the journal was not made anew")
    cell.until_back()
    outcome.must(any("made anew" in event.text for event in cell.engine.store.events()), "nobody was told")
    cell.finish()


def no_room_for_versions(outcome: Outcome, place: Place) -> None:
    """The disk full whenever a version is stored."""

    def refuse(statement: str, parameters: Any) -> None:
        if statement.startswith("INSERT INTO model_version"):
            raise sa.exc.OperationalError(statement, {}, sqlite3.OperationalError("database or disk is full"))

    during(Cell(place, outcome), _statements(refuse))


def unstorable(outcome: Outcome, place: Place) -> None:
    """A row that no database takes."""

    def refuse(statement: str, parameters: Any) -> None:
        if statement.startswith("INSERT INTO decision") and ODD in repr(parameters):
            raise sa.exc.DataError(statement, {}, OverflowError("out of range"))

    cell = Cell(place, outcome)
    cell.play(BEFORE)
    outcome.injected += 1
    with _statements(refuse):
        cell.engine.decide(stream().X[0], decision_id=ODD)
        cell.play(DURING)
        cell.engine.flush()
        cell.until_back()  # a busy machine's store may have been late, too
    texts = [event.text for event in cell.engine.store.events() if event.kind == "dead letter"]
    outcome.must(len(texts) == 1 and ODD in texts[0], "the row did not become a dead letter")
    cell.finish()


def replaced(outcome: Outcome, place: Place) -> None:
    """The store's file replaced by a copy of itself while it is open."""

    def replace(file: Path) -> None:
        shutil.copy(file, f"{file}.new")
        Path(f"{file}.new").replace(file)

    _lost_file(Cell(place, outcome), replace)


def deleted(outcome: Outcome, place: Place) -> None:
    """The store's file deleted while it is open."""
    _lost_file(Cell(place, outcome), Path.unlink)


def _lost_file(cell: Cell, lose: Callable[[Path], object]) -> None:
    """What was acknowledged before went with the file; what is acknowledged after must be in the journal."""
    cell.play(BEFORE)
    file, copy = Path(cell.place.url), Path(cell.place.url + ".copy")
    shutil.copy(file, copy)
    lose(file)
    cell.outcome.injected += 1
    cell.acknowledged.clear()
    cell.play(DURING)
    cell.outcome.must("deleted, moved or replaced" in cell.engine.store_fault, "a lost file was not noticed")
    cell.engine.close()
    copy.replace(file)
    cell.engine = type(cell.engine).open(cell.place.store())
    cell.finish()


def _backends(url: str, work: Callable[[sa.Connection, int], object]) -> None:
    """Do this with each other connection to this PostgreSQL database."""
    engine = sa.create_engine(url)
    others = "SELECT pid FROM pg_stat_activity WHERE datname = current_database() AND pid <> pg_backend_pid()"
    with engine.connect() as connection:
        for pid in connection.execute(sa.text(others)).scalars().all():
            work(connection, pid)
    engine.dispose()


def frozen(outcome: Outcome, place: Place) -> None:
    """PostgreSQL's processes for this cell frozen (SIGSTOP)."""
    pids: list[int] = []

    @contextlib.contextmanager
    def stopped() -> Iterator[None]:
        _backends(place.url, lambda connection, pid: pids.append(pid) or os.kill(pid, signal.SIGSTOP))
        yield
        for pid in pids:
            os.kill(pid, signal.SIGCONT)

    during(Cell(place, outcome), stopped())


def cut_off(outcome: Outcome, place: Place) -> None:
    """The connection to PostgreSQL cut."""
    cell, cut = Cell(place, outcome), sa.text("SELECT pg_terminate_backend(:pid)")
    cell.play(BEFORE)
    for _ in range(5):
        _backends(place.url, lambda connection, pid: connection.execute(cut, {"pid": pid}))
        outcome.injected += 1
        cell.play(10)
        cell.until_back()
    cell.finish()


class Hung(Executor):
    """Takes work and never does it."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Return what is never done."""
        return Future()


def killed_executor(outcome: Outcome, place: Place) -> None:
    """The process that retrains killed."""
    with ProcessPoolExecutor(1) as pool:
        cell = Cell(place, outcome, executor=pool)
        os.kill(pool.submit(os.getpid).result(), signal.SIGKILL)
        outcome.injected += 1
        cell.play(200)
        cell.outcome.must(cell.engine.version > 0, "there was never another version")
        cell.finish()


def hung_executor(outcome: Outcome, place: Place) -> None:
    """An executor that never finishes; its deadline, a minute, is a second here."""
    before, trainer.HUNG = trainer.HUNG, 1.0
    try:
        cell = Cell(place, outcome, executor=Hung())
        outcome.injected += 1
        cell.play(60)
        time.sleep(1.1)
        cell.play(100)
        outcome.must(cell.engine.version > 0, "there was never another version")
        cell.finish()
    finally:
        trainer.HUNG = before


def interrupted(outcome: Outcome, place: Place) -> None:
    """Ctrl-C at a random moment of a decision, a report or a retrain."""
    cell, rng, armed = Cell(place, outcome), np.random.default_rng(0), False

    def interrupt(*_: object) -> None:
        nonlocal armed
        if armed:
            armed = False
            signal.raise_signal(signal.SIGINT)

    before = signal.signal(signal.SIGALRM, interrupt)
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
    for _ in range(300):
        try:
            armed = True
            signal.setitimer(signal.ITIMER_REAL, float(rng.uniform(1e-4, 0.02)))
            cell.play(1)
            armed = False
        except KeyboardInterrupt:
            outcome.injected += 1
            cell.next += 1
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    signal.signal(signal.SIGALRM, before)
    signal.signal(signal.SIGINT, handler)
    outcome.must(outcome.injected > 0, "nothing was interrupted")
    cell.finish()


def forked(outcome: Outcome, place: Place) -> None:
    """A fork of the engine's process that decides and reports on."""
    cell = Cell(place, outcome)
    for _ in range(5):
        cell.play(25)
        outcome.injected += 1
        pid = os.fork()
        if not pid:
            try:
                cell.engine.decide(stream().X[0])
            except StoreError:
                os._exit(0)
            os._exit(1)
        outcome.must(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0, "a fork could decide")
    cell.finish()


OF_STORES = (locked, full, no_room_for_versions, moved, replaced, deleted, unstorable, lost_journal)
ON_DISKS = (hung_disk, failing_disk, closed_while_hung, run_over_a_hung_disk)
ON_SQLITE = (*OF_STORES, killed_executor, hung_executor, interrupted, forked)
ON_POSTGRES = (frozen, cut_off)
