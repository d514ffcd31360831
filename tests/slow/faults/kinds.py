"""Faults of a running cell's store, disk, server, clock and processes; and what is found changed
when it is opened.
"""

import contextlib
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import sqlalchemy as sa

from dengine import Action, DataEngine, Decision, Reason, ReplayCell, load_dataset
from dengine.engine import trainer
from dengine.errors import DataError, ReportError, StoreError, TraceError
from dengine.store import StoredDecision, journal, recording, verify_history
from dengine.store.journal import HEADER, journal_path
from dengine.store.ledger import row_sum
from tests.support.serving import started

from .harness import Cell, Outcome, Place, bounds, missing, stream

BEFORE, DURING, AFTER = 100, 40, 60  # parts; a version is stored after 40 labels
OUTAGE = 0.5  # seconds that a fault goes on after the parts that met it
AWAY = 1.5  # seconds after which a store is not slow, but away
ODD = "no-database-takes-it"
IDS = 100  # asked for again while the store is away
FLIPS = 40  # of one bit each
SHORT = 1 << 17  # bytes of a journal that is to be cleared
CHANGES = (
    "UPDATE setting SET value = replace(value, 'lower_bound = 0.9', 'lower_bound = 0.8') WHERE key = 'recipe'",
    "UPDATE label SET success = 1 - success WHERE seq = 3",
    "UPDATE correction SET success = 1 - success",
    "UPDATE label SET success = 1 - success WHERE seq = 3; UPDATE label SET sum = sum_of() WHERE seq = 3",
    "DELETE FROM label WHERE seq = 3",
    "UPDATE model_version SET accepted = 0",
)
SYNC = Path(
    os.environ.get("DENGINE_SYNC", os.devnull)
)  # what the library between this process and its disk is told by


def during(cell: Cell, fault: Any, away: bool = False) -> None:
    """Play before, in and after a fault, and look at what became of it."""
    cell.play(BEFORE)
    with fault:
        cell.outcome.injected += 1
        cell.play(DURING)
        time.sleep(AWAY if away else OUTAGE)
        if away:
            decisions = [cell.engine.decide(x) for x in stream().X[:5]]
            cell.outcome.must(
                Reason.NO_STORE not in {d.reason for d in decisions},
                "verified, though the journal is well",
            )
            cell.outcome.must(
                bool(cell.engine.state.store_fault), "nobody was told that the store is away"
            )
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


def away(place: Place) -> contextlib.AbstractContextManager[None]:
    """The store away: its file under another name, or its server's processes frozen."""
    return stopped(place) if "://" in place.url else moved_away(Path(place.url))


def moved(outcome: Outcome, place: Place) -> None:
    """The store's file moved away, and put back."""
    during(Cell(place, outcome), moved_away(Path(place.url)), away=True)


def lost_journal(outcome: Outcome, place: Place) -> None:
    """The journal deleted, moved, or its folder removed, while the store is away."""
    cell = Cell(place, outcome)
    cell.play(BEFORE)
    journal, remote = journal_path(cell.engine.store.database.url, place.cell), "://" in place.url
    ways = [
        Path.unlink,
        lambda file: file.rename(f"{file}.away"),
        *[lambda file: shutil.rmtree(file.parent)] * remote,
    ]
    with stopped(place) if remote else lock(place):
        for lose in ways:
            cell.play(10)
            lose(journal)
            outcome.injected += 1
            cell.play(10)
            outcome.must(journal.exists(), "the journal was not made anew")
    cell.until_back()
    outcome.must(
        any("created again" in event.text for event in cell.engine.store.events.newest()),
        "nobody was told",
    )
    cell.finish()


def unstorable(outcome: Outcome, place: Place) -> None:
    """A row that no database takes."""

    def refuse(connection: Any, cursor: Any, statement: str, parameters: Any, *_: object) -> None:
        if statement.startswith("INSERT INTO decision") and ODD in repr(parameters):
            raise sa.exc.DataError(statement, {}, OverflowError("out of range"))

    cell = Cell(place, outcome)
    cell.play(BEFORE)
    outcome.injected += 1
    sa.event.listen(sa.Engine, "before_cursor_execute", refuse)
    try:
        cell.engine.decide(stream().X[0], decision_id=ODD)
        cell.play(DURING)
        cell.engine.flush()
        cell.until_back()  # a busy machine's store may have been late, too
    finally:
        sa.event.remove(sa.Engine, "before_cursor_execute", refuse)
    texts = [
        event.text for event in cell.engine.store.events.newest() if event.kind == "dead letter"
    ]
    outcome.must(len(texts) == 1 and ODD in texts[0], "the row did not become a dead letter")
    cell.finish()


def lost_file(outcome: Outcome, place: Place) -> None:
    """The store's file deleted, or replaced by a copy of itself, while it is open."""
    ways = (Path.unlink, lambda file: Path(shutil.copy(file, f"{file}.new")).replace(file))
    for i, lose in enumerate(ways):
        cell = Cell(replace(place, url=f"{place.url}.{i}"), outcome)
        cell.play(BEFORE)
        file, copy = Path(cell.place.url), Path(cell.place.url + ".copy")
        shutil.copy(file, copy)
        lose(file)
        outcome.injected += 1
        cell.acknowledged.clear()  # they went with the file; what is acknowledged after must be in the journal
        cell.play(DURING)
        outcome.must(
            "deleted, moved or replaced" in cell.engine.state.store_fault,
            "a lost file was not noticed",
        )
        cell.engine.close()
        copy.replace(file)
        cell.engine = DataEngine.open(cell.place.store())
        cell.finish()


def _backends(url: str, work: Callable[[sa.Connection, int], object]) -> None:
    """Do this with each other connection to this PostgreSQL database."""
    engine = sa.create_engine(url)
    others = "SELECT pid FROM pg_stat_activity WHERE datname = current_database() AND pid <> pg_backend_pid()"
    with engine.connect() as connection:
        for pid in connection.execute(sa.text(others)).scalars().all():
            work(connection, pid)
    engine.dispose()


@contextlib.contextmanager
def stopped(place: Place) -> Iterator[None]:
    """PostgreSQL's processes for these cells frozen."""
    pids: list[int] = []
    _backends(place.url, lambda connection, pid: pids.append(pid) or os.kill(pid, signal.SIGSTOP))
    yield
    for pid in pids:
        os.kill(pid, signal.SIGCONT)


def frozen(outcome: Outcome, place: Place) -> None:
    """PostgreSQL's processes for this cell frozen (SIGSTOP)."""
    during(Cell(place, outcome), stopped(place), away=True)


def closed_while_away(outcome: Outcome, place: Place) -> None:
    """An engine closed while its store is away."""
    before, cell = set(threading.enumerate()), Cell(place, outcome)
    cell.play(60)
    with away(place):
        outcome.injected += 1
        cell.play(30)
        cell.engine.close()
    for thread in set(threading.enumerate()) - before:
        thread.join(15.0)
        outcome.must(not thread.is_alive(), f"{thread.name} goes on")
    end = time.monotonic() + 10.0
    while True:
        with contextlib.suppress(
            StoreError
        ):  # until the server has noticed that the session is over
            cell.engine = DataEngine.open(place.store())
            break
        outcome.must(time.monotonic() < end, "the cell was not given free")
        time.sleep(0.2)
    cell.finish()


def killed_server(outcome: Outcome, place: Place) -> None:
    """PostgreSQL killed (SIGKILL of its process for the cell) at a random moment of its commits."""
    cell, rng, pids = Cell(place, outcome), np.random.default_rng(0), list[int]()
    cell.play(BEFORE)
    for _ in range(5):
        _backends(place.url, lambda connection, pid: pids.append(pid))
        timer = threading.Timer(float(rng.uniform(0.0, 0.2)), os.kill, (pids[-1], signal.SIGKILL))
        timer.start()
        outcome.injected += 1
        cell.play(20)
        timer.join()
        up = False
        while not up:
            time.sleep(OUTAGE)
            with contextlib.suppress(sa.exc.OperationalError):  # it recovers
                up = _backends(place.url, lambda connection, pid: None) is None
        cell.until_back()
    cell.finish()


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


@contextlib.contextmanager
def _syncs(do: str) -> Iterator[None]:
    """What every sync of this process does: "hang" or "fail"."""
    SYNC.write_text(do)
    try:
        yield
    finally:
        SYNC.write_text("")


@contextlib.contextmanager
def _short_journals() -> Iterator[None]:
    """Journals are cleared after SHORT bytes: dengine's own eight megabytes take a minute to fill."""
    before = journal.RESERVE, recording.LONG
    journal.RESERVE = recording.LONG = SHORT
    try:
        yield
    finally:
        journal.RESERVE, recording.LONG = before


def _before_a_disk(outcome: Outcome, place: Place, full: bool = False) -> Cell:
    """A cell that waits as long as a robot's. full : its journal is to begin anew."""
    cell = Cell(replace(place, wait=0.4), outcome)
    file = Path(f"{place.url}.{place.cell}.journal")
    cell.play(60)
    cell.engine.flush()
    while full and file.stat().st_size <= HEADER + SHORT:
        cell.engine.decide(stream().X[0])
        cell.engine.flush()  # so that it is the next record that finds it too long
    outcome.injected += 1
    return cell


def _unsynced(cell: Cell, i: int) -> Decision:
    """Decide and report while nothing is synced: what is not on the disk is verified, and not
    acknowledged.
    """
    engine, outcome, x, good = cell.engine, cell.outcome, stream().X[i], bool(stream().y[i])
    cell.timed(lambda: engine.decide(x))
    earlier: Decision = cell.timed(lambda: engine.decide(x, decision_id=f"part-{i}"))
    outcome.must(
        earlier.action is Action.VERIFY, f"{earlier.id} goes on unchecked, and is on no disk"
    )
    for success, error in ((good, StoreError), (not good, ReportError), (good, StoreError)):
        with contextlib.suppress(error):
            cell.timed(lambda success=success: engine.report(earlier.id, success))
            outcome.must(False, f"the label {success} of {earlier.id} was acknowledged on no disk")
    return earlier


@_short_journals()
def hung_disk(outcome: Outcome, place: Place, do: str = "hang") -> None:
    """A disk whose syncs hang: no call takes long, and what was not taken can be said again."""
    cell, data = _before_a_disk(outcome, place, full=do == "hang"), stream()
    with _syncs(do):
        answer = {i: _unsynced(cell, i) for i in range(60, 63)}
        fault = cell.timed(lambda: cell.engine.state.store_fault)
    outcome.must(bool(fault), "the engine says that its disk is well")
    cell.until_back()
    for i, item in answer.items():
        cell.acknowledged[item.id] = bool(data.y[i])
        cell.engine.report(item.id, cell.acknowledged[item.id])
    cell.play(60)
    cell.finish()
    with DataEngine.open(place.store()) as again:
        for i, item in answer.items():
            outcome.must(
                again.decide(data.X[i], decision_id=item.id) == item,
                f"{item.id} is answered otherwise",
            )


def failing_disk(outcome: Outcome, place: Place) -> None:
    """A disk whose syncs fail."""
    hung_disk(outcome, place, "fail")


def run_over_a_hung_disk(outcome: Outcome, place: Place) -> None:
    """A sync that hangs for two seconds under a cell's loop."""
    cell = _before_a_disk(outcome, place)
    with _syncs("hang"):
        threading.Timer(2.0, SYNC.write_text, [""]).start()
        cycles = list(cell.engine.run(ReplayCell(stream(), np.arange(60, 90)), 30))
    outcome.must(
        any(c.decision.reason is Reason.NO_STORE for c in cycles),
        "a part was decided on over a hung disk",
    )
    cell.acknowledged |= {c.decision.id: c.success for c in cycles if c.success is not None}
    cell.play(60)
    cell.finish()


def end(url: str, hung: bool) -> None:
    """What `closed_while_hung` and `unclosed` have a process of their own do."""
    cell = _before_a_disk(Outcome(), Place(url))
    begin = time.monotonic()
    if hung:
        SYNC.write_text("hang")
        _unsynced(cell, 60)
        with contextlib.suppress(StoreError):
            cell.timed(cell.engine.close)
    print(json.dumps([cell.acknowledged, asdict(cell.outcome), begin]), flush=True)


def closed_while_hung(outcome: Outcome, place: Place, hung: bool = True) -> None:
    """A process that ends while a sync hangs."""
    code = f"from tests.slow.faults.kinds import end; end({place.url!r}, {hung})"
    with _syncs("") if hung else contextlib.nullcontext():
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, timeout=600, check=True
        )
        ended = time.monotonic()
    outcome.must(hung or not done.stderr, f"it said at its end: {done.stderr}")
    acknowledged, seen, begin = json.loads(done.stdout.splitlines()[-1])
    # From when the disk hung: on a busy machine its imports alone may take a minute.
    outcome.must(ended - begin < 60, "a hung disk kept the process from ending")
    with DataEngine.open(place.store()) as again:
        outcome.labels, outcome.lost = (
            outcome.labels + len(acknowledged),
            outcome.lost + missing(again.store, acknowledged),
        )
    for name in ("injected", "wrong", "raised", "told"):
        setattr(outcome, name, getattr(outcome, name) + seen[name])
    outcome.longest = max(outcome.longest, seen["longest"])


def unclosed(outcome: Outcome, place: Place) -> None:
    """A process that ends and does not close its engine."""
    closed_while_hung(outcome, place, hung=False)


def served_over_a_hung_disk(outcome: Outcome, place: Place) -> None:
    """A served cell whose disk's syncs hang."""
    folder, x, good = Path(f"{place.url}.served"), stream().X.tolist(), stream().y.tolist()
    folder.mkdir()
    cell = Cell(replace(place, url=str(folder / "probe.db")), outcome)  # which times what is asked
    with started(folder, "--reducer", "pca") as server:
        first = server.ask("/decide", {"trace": x[0], "request": "first"})
        server.ask("/report", {"id": first["id"], "success": good[0]})
        with _syncs("hang"):
            outcome.injected += 1
            answer = cell.timed(lambda: server.ask("/decide", {"trace": x[1], "request": "second"}))
            outcome.must(
                answer["action"] == Action.VERIFY, "a part goes on unchecked over a hung disk"
            )
            with contextlib.suppress(OSError):
                cell.timed(lambda: server.ask("/report", {"id": answer["id"], "success": good[1]}))
                outcome.must(False, "a label was acknowledged on no disk")
            outcome.must(
                server.ask("/healthz")["status"] == "degraded",
                "the server says that its disk is well",
            )
            with contextlib.suppress(OSError):  # it may say that it does not know, but not wait
                cell.timed(lambda: server.ask("/status"))
            begin = time.monotonic()
            server.end()
            outcome.must(time.monotonic() - begin < 60, "a hung disk kept the server from ending")
    cell.engine.close()
    with DataEngine.open(str(folder / "cell.db")) as again:
        outcome.labels, outcome.lost = (
            outcome.labels + 1,
            outcome.lost + missing(again.store, {first["id"]: bool(good[0])}),
        )


def clock_set_back(outcome: Outcome, place: Place) -> None:
    """The clock set back by an hour."""
    cell, begin = Cell(place, outcome), time.time()
    cell.play(BEFORE)
    with _syncs("back"):
        outcome.must(time.time() < begin, "the clock was not set back")
        outcome.injected += 1
        cell.play(BEFORE)
        cell.engine.retrain()
        cell.finish()


@contextlib.contextmanager
def _on_tmpfs(outcome: Outcome, place: Place) -> Iterator[Cell]:
    folder = Path(f"{place.url}.tmpfs")
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=24m", "tmpfs", folder], check=True)
    try:
        yield Cell(replace(place, url=str(folder / "engine.db")), outcome)
    finally:
        subprocess.run(["umount", folder], check=True)


def full_tmpfs(outcome: Outcome, place: Place) -> None:
    """A tmpfs that is full while the journal is drained."""
    with _on_tmpfs(outcome, place) as cell:
        during(cell, _filled(Path(cell.place.url).with_name("filler")), away=True)


def remade_on_a_full_disk(outcome: Outcome, place: Place) -> None:
    """The journal deleted while the store is away, on a tmpfs with room for a part of it."""
    with _on_tmpfs(outcome, place) as cell:
        journal = journal_path(cell.engine.store.database.url, cell.place.cell)
        with lock(cell.place):
            cell.play(BEFORE)
            cell.engine.flush()
            journal.unlink()
            outcome.injected += 1
            with _filled(journal.with_name("filler"), room=1 << 16):
                decision = cell.timed(lambda: cell.engine.decide(stream().X[0]))
                with contextlib.suppress(StoreError):
                    cell.timed(lambda: cell.engine.report(decision.id, True))
                    outcome.must(False, "a label was acknowledged that had no room")
        cell.until_back()
        cell.finish()


@contextlib.contextmanager
def _filled(filler: Path, room: int = 0) -> Iterator[None]:
    with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
        while file.write(bytes(4096)) == 4096:
            pass
    os.truncate(filler, filler.stat().st_size - room)
    yield
    filler.unlink()


def changed(outcome: Outcome, place: Place) -> None:
    """A setting, a label or a correction changed by SQL while no engine runs."""
    cell = Cell(place, outcome)
    cell.play(60)
    name, good = cell.acknowledged.popitem()
    cell.engine.correct(name, not good)
    cell.finish()
    for i, sql in enumerate(CHANGES):
        other = replace(place, url=f"{place.url}.{i}")
        shutil.copy(place.url, other.url)
        with contextlib.closing(sqlite3.connect(other.url)) as connection:
            connection.row_factory = sqlite3.Row
            row = connection.execute("SELECT * FROM label WHERE seq = 3").fetchone()
            texts = {"success": 1 - row["success"]}
            connection.create_function(
                "sum_of", 0, lambda row=dict(row) | texts: row_sum("label", row)
            )
            connection.executescript(sql)
            outcome.injected += 1
        with DataEngine.open(other.store()) as again:
            texts = [again.decide(x) for x in stream().X[:20]]
            outcome.must(
                {(d.action, d.reason) for d in texts} == {(Action.VERIFY, Reason.NO_STORE)},
                f"decided on: {sql}",
            )
            again.report(texts[0].id, True)
            outcome.must(
                "see `dengine verify`" in again.state.store_fault, f"nobody was told of: {sql}"
            )
            outcome.lost += missing(again.store, {texts[0].id: True})
        outcome.must(not verify_history(other.url).ok, f"verified: {sql}")
        with contextlib.suppress(DataError):
            load_dataset(other.url)
            outcome.must(False, f"a data set was made of it: {sql}")


def changed_long_ago(outcome: Outcome, place: Place) -> None:
    """A label older than those that are read at opening changed by SQL, and one corrected."""
    cell = Cell(place, outcome, window=20)
    cell.play(BEFORE)
    cell.finish()
    with contextlib.closing(sqlite3.connect(place.url)) as connection:
        connection.executescript(CHANGES[1])
        outcome.injected += 1
    with DataEngine.open(place.store()) as again:
        name, good = cell.acknowledged.popitem()
        again.correct(name, not good)
        outcome.must(
            "see `dengine verify`" in again.state.store_fault,
            "the rule was told what was changed",
        )


def flipped(file: Path, rng: np.random.Generator, size: int | None = None) -> None:
    """One bit of a file other than it was; of its first `size` bytes."""
    content = bytearray(file.read_bytes())
    content[int(rng.integers(size or len(content)))] ^= 1 << int(rng.integers(8))
    file.write_bytes(content)


def flipped_store(outcome: Outcome, place: Place) -> None:
    """A bit of the store's file flipped while no engine runs."""
    cell, rng = Cell(place, outcome), np.random.default_rng(0)
    cell.play(BEFORE + AFTER)
    before = bounds(cell.engine)
    cell.finish()
    for i in range(FLIPS):
        other = replace(place, url=f"{place.url}.{i}")
        shutil.copy(place.url, other.url)
        flipped(Path(other.url), rng)
        outcome.injected += 1
        with (
            contextlib.suppress(StoreError),
            DataEngine.open(other.store()) as again,
        ):  # else it is refused, and said
            same = bounds(again) == before and not missing(again.store, cell.acknowledged)
            answer = again.state.store_fault or any(
                event.kind == "damaged" for event in again.store.events.newest()
            )
            outcome.must(same or bool(answer), f"flip {i}: nobody is told of it")


def put_back(outcome: Outcome, place: Place) -> None:
    """The store's file put back from an older copy, and the journal deleted."""
    cell = Cell(place, outcome)
    cell.play(BEFORE)
    cell.engine.flush()
    with contextlib.closing(sqlite3.connect(place.url)) as connection:
        connection.execute("VACUUM INTO ?", (f"{place.url}.copy",))
    kept = dict(cell.acknowledged)
    cell.play(DURING)
    cell.engine.close()
    for suffix in ("-wal", "-shm"):
        Path(place.url + suffix).unlink(missing_ok=True)
    Path(f"{place.url}.copy").replace(place.url)
    Path(f"{place.url}.{place.cell}.journal").unlink()  # its head is enough
    outcome.injected += 1
    outcome.must(
        [fault.table for fault in verify_history(place.url).faults] == ["ledger"],
        "verified, though cut off",
    )
    cell.engine, cell.acknowledged = (
        DataEngine.open(place.store()),
        kept,
    )  # what was told since is lost, and that is said
    cell.play(AFTER)
    cell.finish()
    with DataEngine.open(place.store(), reading=True) as again:
        kinds = [event.kind for event in again.store.events.newest()]
        outcome.must(
            kinds.count("lost") == 1,
            f"it was told {kinds.count('lost')} times that the store was cut off",
        )


def second(outcome: Outcome, place: Place) -> None:
    """A second engine on the cell, in another process."""
    cell = Cell(place, outcome)
    cell.play(BEFORE)
    with DataEngine.open(place.store(), reading=True) as looking, contextlib.suppress(StoreError):
        looking.decide(stream().X[0])
        outcome.must(False, "an engine that was opened for reading decides")
    code = "import sys; from dengine import DataEngine; from dengine.store import SqlStore; "
    command = [sys.executable, "-c", f"{code}DataEngine.open(SqlStore(*sys.argv[1:]))"]
    elsewhere = os.environ | {"XDG_STATE_HOME": f"{SYNC}-elsewhere"}  # as on another machine
    url = place.url
    if "://" not in url:
        Path(url := f"{url}.link").symlink_to(place.url)  # by another name, too
    done = subprocess.run(
        [*command, url, place.cell], capture_output=True, text=True, env=elsewhere, check=False
    )
    outcome.injected += 1
    outcome.must(
        f"process {os.getpid()} on" in done.stderr and " owns " in done.stderr,
        "a second engine was let in",
    )
    cell.play(DURING)
    cell.finish()


def asked_again(outcome: Outcome, place: Place, stored: int = 0) -> None:
    """Ids asked for again with their trace and with another's, and new ones, while the store is away.

    stored : so many other ids are in the store.
    """
    cell, X = Cell(place, outcome), stream().X
    cell.play(BEFORE)
    nothing = cell.engine.decide(np.zeros(X.shape[1]))
    for start in range(0, stored, 5000):
        ids = (f"stored-{i}" for i in range(start, min(start + 5000, stored)))
        cell.engine.store.apply_records(
            [StoredDecision(replace(nothing, id=id_), X[:1], 1, True, 0.0) for id_ in ids]
        )
    earlier = [
        cell.timed(lambda i=i: cell.engine.decide(X[i], decision_id=f"part-{i}"))
        for i in range(IDS)
    ]
    cell.engine.close()
    # It has none of them by heart, and with an executor reads the ids before it returns.
    cell.engine = engine = DataEngine.open(place.store(), executor=ThreadPoolExecutor(1))
    with away(place):
        outcome.injected += 1
        cell.play(1)
        time.sleep(AWAY)
        decisions = [
            cell.timed(lambda i=i: engine.decide(X[IDS + i], decision_id=f"new-{i}"))
            for i in range(IDS)
        ]
        unknown = sum(decision.reason is Reason.NO_STORE for decision in decisions)
        outcome.must(
            unknown <= 2, f"{unknown} of {IDS} new ids were taken for old ones"
        )  # one in 500 at a million is
        for i, decision in enumerate(earlier):
            for j in (i, i + 1):
                answer = cell.timed(lambda i=i, j=j: engine.decide(X[j], decision_id=f"part-{i}"))
                outcome.must(
                    (answer.action, answer.reason) == (Action.VERIFY, Reason.NO_STORE),
                    f"{decision.id} got an answer",
                )
            with contextlib.suppress(StoreError):
                engine.report(decision.id, True)
                outcome.must(
                    False, f"a label was taken on {decision.id}, which nobody could look up"
                )
        for decision in decisions:
            if decision.action is Action.VERIFY and decision.reason is not Reason.NO_STORE:
                cell.timed(lambda decision=decision: engine.report(decision.id, True))
                cell.acknowledged[decision.id] = True
    cell.until_back()
    for i, decision in enumerate(earlier):
        outcome.must(
            engine.decide(X[i], decision_id=decision.id) == decision,
            f"{decision.id} is answered otherwise",
        )
        with contextlib.suppress(TraceError):
            engine.decide(X[i + 1], decision_id=decision.id)
            outcome.must(False, f"{decision.id} was taken for another part")
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
    handler = signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # a job in the background ignores it
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


ON_SQLITE = (
    locked,
    moved,
    lost_file,
    put_back,
    changed,
    changed_long_ago,
    flipped_store,
    unstorable,
)
ON_SQLITE += (
    lost_journal,
    second,
    unclosed,
    closed_while_away,
    killed_executor,
    hung_executor,
    interrupted,
    forked,
)
ON_DISKS = (
    hung_disk,
    failing_disk,
    closed_while_hung,
    run_over_a_hung_disk,
    served_over_a_hung_disk,
)
ON_DISKS += (full_tmpfs, remade_on_a_full_disk, clock_set_back)
ON_POSTGRES = (frozen, closed_while_away, killed_server, cut_off, lost_journal, second, asked_again)
