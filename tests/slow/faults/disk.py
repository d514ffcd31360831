"""A disk whose syncs hang, or fail: a library between this process and the system does so, when a file says it.

python -m tests.slow.faults.disk STORE FILE hang        # in a process with LD_PRELOAD; prints the outcome as JSON
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import asdict
from pathlib import Path

import numpy as np

from dengine import Action, DataEngine, Decision, Reason, ReplayCell
from dengine.errors import ReportError, StoreError

from .harness import Cell, Outcome, Place, stream

HERE = Path(__file__).resolve().parent
IDS = 3


def injected(outcome: Outcome, place: Place, mode: str) -> None:
    """Play a cell in a process whose syncs can be made to hang, or to fail."""
    library, said = Path(place.url).with_suffix(".so"), Path(place.url).with_suffix(".sync")
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", library, HERE / "sync.c", "-ldl"], check=True)
    words = [sys.executable, "-m", "tests.slow.faults.disk", place.url, str(said), mode]
    around = os.environ | {"LD_PRELOAD": str(library), "DENGINE_SYNC": str(said)}
    begin = time.monotonic()
    done = subprocess.run(words, env=around, capture_output=True, text=True, timeout=120, check=False)
    if done.returncode:
        outcome.must(False, done.stderr[-300:])
        return
    for name, value in json.loads(done.stdout.splitlines()[-1]).items():
        before = getattr(outcome, name)
        setattr(outcome, name, max(before, value) if name == "longest" else before + value)
    if mode == "close":
        outcome.must(time.monotonic() - begin < 60, "a hung disk kept the process from ending")
        with DataEngine.open(place.store()) as again:
            outcome.lost += max(0, outcome.labels - again.store.status()["labels"])


def hung_disk(outcome: Outcome, place: Place) -> None:
    """A disk that does not answer: a sync hangs."""
    injected(outcome, place, "hang")


def failing_disk(outcome: Outcome, place: Place) -> None:
    """A disk whose syncs fail."""
    injected(outcome, place, "fail")


def closed_while_hung(outcome: Outcome, place: Place) -> None:
    """A process that ends while a sync hangs."""
    injected(outcome, place, "close")


def run_over_a_hung_disk(outcome: Outcome, place: Place) -> None:
    """A sync hangs for two seconds under a cell's loop."""
    injected(outcome, place, "run")


def without_a_disk(cell: Cell, i: int, timed: Callable[[], AbstractContextManager[None]]) -> Decision:
    """Decide and report while nothing is synced: what is not on the disk is verified, and not acknowledged."""
    engine, outcome, x, good = cell.engine, cell.outcome, stream().X[i], bool(stream().y[i])
    with timed():
        engine.decide(x)
    with timed():
        known = engine.decide(x, decision_id=f"part-{i}")
    outcome.must(known.action is Action.VERIFY, f"{known.id} goes on unchecked, and is on no disk")
    for success, error in ((good, StoreError), (not good, ReportError), (good, StoreError)):
        with timed():
            try:
                engine.report(known.id, success)
                outcome.must(False, f"the label {success} of {known.id} was acknowledged on no disk")
            except error:
                pass
    return known


def play(place: Place, said: Path, mode: str) -> Outcome:
    """Parts before, in and after the fault: no call takes long, and what was not taken can be said again."""
    outcome, data = Outcome(), stream()
    cell = Cell(place, outcome)
    engine = cell.engine
    cell.play(60)
    engine.flush()

    @contextlib.contextmanager
    def timed() -> Iterator[None]:
        begin = time.perf_counter()
        yield
        outcome.longest = max(outcome.longest, time.perf_counter() - begin)

    said.write_text("fail" if mode == "fail" else "hang")
    outcome.injected += 1
    if mode == "run":
        threading.Timer(2.0, said.write_text, [""]).start()
        cycles = list(engine.run(ReplayCell(data, np.arange(60, 90)), 30))
        outcome.must(any(c.decision.reason is Reason.NO_STORE for c in cycles), "a part was decided on over a hung disk")
        cell.acknowledged |= {c.decision.id: c.success for c in cycles if c.success is not None}
        cell.play(60)
        cell.finish()
        return outcome
    told = {f"part-{i}": without_a_disk(cell, i, timed) for i in range(60, 60 + IDS)}
    with timed():
        outcome.must(bool(engine.store_fault), "the engine says that its disk is well")
    if mode == "close":
        with timed(), contextlib.suppress(StoreError):
            engine.close()
        outcome.labels = len(cell.acknowledged)
        return outcome
    said.write_text("")
    cell.until_back()
    for id_ in told:
        cell.acknowledged[id_] = bool(data.y[int(id_.removeprefix("part-"))])
        engine.report(id_, cell.acknowledged[id_])
    cell.play(60)
    cell.finish()
    with type(engine).open(place.store()) as again:
        for id_, known in told.items():
            i = int(id_.removeprefix("part-"))
            outcome.must(again.decide(data.X[i], decision_id=id_) == known, f"{id_} is answered otherwise")
    return outcome


if __name__ == "__main__":
    seen = play(Place(sys.argv[1], wait=0.4), Path(sys.argv[2]), sys.argv[3])
    print(json.dumps(asdict(seen)), flush=True)
