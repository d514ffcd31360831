"""SIGKILL at random moments: of the cell, in an outage, of an import, an export, a version's commit, the C++ journal.

The children come from a server of forks that has imported everything, so that a kill costs what it kills and no start.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sqlite3
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from dengine import Action, DataEngine, Recipe, export_torchscript, load_exported
from dengine.datasets.importing import import_labelled
from dengine.errors import DengineError, ExportError
from dengine.export import import_journal

from .harness import PROBE, RECIPE, Cell, Outcome, Place, missing, stream

# The server of forks looks for what it loads beforehand along PYTHONPATH, not along this program's path.
HERE = str(Path(__file__).resolve().parents[3])
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (HERE, os.environ.get("PYTHONPATH"))))
LOADED = (
    "tests.slow.faults.kills",
    "dengine.store.sql",
    "dengine.datasets.importing",
    "dengine.export.torchscript",
    "dengine.reducers.pca",
)
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload([*LOADED, "sklearn.decomposition", "pandas"])
IN_ONE = 20  # kills of one store, so that opening it takes no longer than the kill
OFTEN = replace(RECIPE, retrain_every=3)  # a version's commit is under way most of the time


def _for_a_while(seconds: float = 60.0) -> Iterator[None]:
    """Turns until somebody kills this process, but not for ever: its killer may be gone."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        yield


def _acknowledge(path: str, *words: object) -> None:
    with Path(path).open("a") as file:
        file.write(" ".join(map(str, words)) + "\n")


def cell(place: Place, told: str, seed: int, recipe: Recipe = RECIPE, locked_after: int | None = None) -> None:
    """Decide and report on and on, and tell of each once it was acknowledged.

    After each report it decides on a probe; or, `locked_after` so many parts, its store is locked.
    """
    engine, data, rng = DataEngine.open_or_create(place.store(), recipe=recipe), stream(), np.random.default_rng(seed)
    other = None if locked_after is None else sqlite3.connect(place.url, isolation_level=None, timeout=30)
    for n, _ in enumerate(_for_a_while()):
        if other is not None and n == locked_after:
            other.execute("BEGIN IMMEDIATE")
        i = int(rng.integers(len(data) - PROBE))
        decision = engine.decide(data.X[i])
        if decision.action is Action.VERIFY:
            engine.report(decision.id, bool(data.y[i]))
            _acknowledge(told, "label", decision.id, int(data.y[i]))
        if other is None:
            probe = engine.decide(data.X[-1])
            _acknowledge(told, "probe", engine.version, probe.lower, probe.upper, probe.n_success, probe.n_failure)


often = partial(cell, recipe=OFTEN)
in_outage = partial(cell, locked_after=20)


def importing(place: Place, told: str, seed: int) -> None:
    """An import of recorded labels, chunk by chunk."""
    data = stream()
    done = 0

    def on_traces(n: int) -> None:
        nonlocal done
        done += n
        _acknowledge(told, "imported", done)

    _acknowledge(told, "imported", 0)
    import_labelled(place.store(), data, recipe=RECIPE, on_traces=on_traces)
    time.sleep(60)


def exporting(place: Place, told: str, seed: int) -> None:
    """An engine that is exported to one file again and again."""
    with DataEngine.open(place.store(), reading=True) as engine:
        for _ in _for_a_while():
            export_torchscript(engine, Path(place.url).with_suffix(".ts"), force=True)
            _acknowledge(told, "exported")


def killed(child: Callable[..., None], place: Place, seed: int, most: float = 0.5) -> list[list[str]]:
    """Run a child until a random moment after its first word, kill it, and return what it told."""
    told = f"{place.url if '://' not in place.url else f'/tmp/dengine-{place.cell}'}.told"
    Path(told).unlink(missing_ok=True)
    process = CONTEXT.Process(target=child, args=(place, told, seed), daemon=True)
    process.start()
    end = time.monotonic() + 60
    while not Path(told).exists() and process.is_alive() and time.monotonic() < end:
        time.sleep(0.005)
    time.sleep(float(np.random.default_rng(seed).uniform(0.0, most)))
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    text = Path(told).read_text() if Path(told).exists() else ""
    Path(told).unlink(missing_ok=True)
    return [line.split() for line in text[: text.rfind("\n") + 1].splitlines()]


def check_cell(outcome: Outcome, place: Place, told: list[list[str]]) -> None:
    """Every acknowledged label is there; where nothing came after the last probe, the engine says the same of it."""
    labels = {words[1]: words[2] == "1" for words in told if words[0] == "label"}
    probes = [words[1:] for words in told if words[0] == "probe"]
    with DataEngine.open(place.store()) as engine:
        outcome.labels += len(labels)
        outcome.lost += missing(engine.store, labels)
        n_stored = engine.store.status()["labels"]
        probe = engine.decide(stream().X[-1])
        now = [str(v) for v in (engine.version, probe.lower, probe.upper, probe.n_success, probe.n_failure)]
        if probes and told[-1][0] == "probe" and n_stored == check_cell.stored + len(labels):
            outcome.wrong += now != probes[-1]
            check_cell.compared += 1
        check_cell.stored = n_stored


check_cell.stored = 0  # labels in the store when it was last looked at
check_cell.compared = 0


def kill_cells(outcome: Outcome, place: Place, times: int, child: Callable[..., None] = cell) -> None:
    """Kill so often; a store is killed `IN_ONE` times in a row, then there is a new one."""
    for seed in range(times):
        if seed % IN_ONE == 0:
            check_cell.stored = 0
            own = next_place(place, seed)
        told = killed(child, own, seed)
        outcome.injected += 1
        try:
            check_cell(outcome, own, told)
        except DengineError as error:
            outcome.tell(error)


def next_place(place: Place, seed: int) -> Place:
    """Another file, or another cell of a server."""
    return replace(place, cell=f"{place.cell}-{seed}") if "://" in place.url else replace(place, url=f"{place.url}.{seed}")


def kill_imports(outcome: Outcome, place: Place, times: int) -> None:
    """Kill imports, each of a new store; each is then repeated, and has every trace once."""
    n = len(stream())
    for seed in range(times):
        own = next_place(place, seed)
        told = killed(importing, own, seed, most=1.5)
        outcome.injected += 1
        done = max((int(words[1]) for words in told), default=0)
        outcome.labels += done
        try:
            with own.store() as store:
                outcome.lost += max(0, done - store.status()["labels"])
            import_labelled(own.store(), stream(), recipe=RECIPE)
            with own.store() as store:
                outcome.must(
                    store.status()["labels"] == n, f"{store.status()['labels']} of {n} labels after the repetition"
                )
        except DengineError as error:
            outcome.tell(error)
        for file in Path(own.url).parent.glob(Path(own.url).name + "*"):
            file.unlink()


def exported(place: Place) -> Path:
    """The file of an engine that was told of 100 parts."""
    cell = Cell(place, Outcome())
    cell.play(100)
    cell.engine.close()
    with DataEngine.open(place.url) as engine:  # which waits longer for its store than a cell does
        if engine.version == 0:
            engine.retrain()
        return export_torchscript(engine, Path(place.url).with_suffix(".ts"))


def kill_exports(outcome: Outcome, place: Place, times: int) -> None:
    """Kill exports; after each the file decides as the engine does, or is refused as damaged."""
    known = load_exported(exported(place)).decide(stream().X[0])
    for seed in range(times):
        killed(exporting, place, seed, most=0.3)
        outcome.injected += 1
        with suppress(ExportError):  # killed between the file and its sum: exported again it is whole
            found = load_exported(Path(place.url).with_suffix(".ts")).decide(stream().X[0])
            outcome.must(found.action is known.action, "a killed export decides otherwise")


def kill_programs(outcome: Outcome, place: Place, times: int, program: Path) -> None:
    """Kill the controller's C++ program at random moments of one journal that grows; its labels are imported at the end."""
    model = exported(place)
    journal, acknowledged = Path(place.url).with_suffix(".csv"), {}
    for seed in range(times):
        acknowledged |= killed_program([str(program), str(model), "--journal", str(journal)], seed)
        outcome.injected += 1
    outcome.labels += len(acknowledged)
    try:
        import_journal(place.store(), journal)
        with place.store() as store:
            outcome.lost += missing(store, acknowledged)
    except DengineError as error:
        outcome.tell(error)


def killed_program(command: list[str], seed: int) -> dict[str, bool]:
    data, rng, acknowledged = stream(), np.random.default_rng(seed), {}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen(command, text=True, bufsize=1, **pipes)
    timer = threading.Timer(0.4 + float(rng.uniform(0.0, 0.6)), process.kill)
    timer.start()

    def ask(line: str) -> str:
        process.stdin.write(line + "\n")
        said = process.stdout.readline()
        return said if said.endswith("\n") else ""

    try:
        while True:
            i = int(rng.integers(len(data)))
            words = ask("decide " + ",".join(f"{v:.9g}" for v in data.X[i])).strip().split(",")
            if len(words) < 2:
                break
            if words[1] == Action.VERIFY and ask(f"label {words[0]} {int(data.y[i])}"):
                acknowledged[words[0]] = bool(data.y[i])
    except BrokenPipeError:
        pass  # it was killed, as it was to be
    finally:
        timer.cancel()
        process.kill()
        process.communicate()
    return acknowledged
