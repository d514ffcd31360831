"""SIGKILL at random moments: of the cell, served or not, in an outage, of an import, an export, the
C++ journal.

Then, too, what a killed cell leaves is damaged: its write-ahead log is cut, or a bit of its journal
flipped.

The children come from a server of forks that has imported everything, so that a kill costs what it
kills and no start.
"""

import http.client
import json
import multiprocessing
import os
import signal
import sqlite3
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dengine import Action, DataEngine, Reason, Recipe, export_torchscript, load_exported
from dengine.datasets.importing import import_labelled
from dengine.errors import DengineError, ExportError
from dengine.export import import_journal
from dengine.serve.http import create_app
from dengine.serve.retraining import RetrainingProcess
from dengine.serve.service import CellService
from dengine.store.journal import HEADER
from tests.support.serving import served

from .harness import PROBE, RECIPE, Cell, Outcome, Place, missing, stream
from .kinds import flipped

# The server of forks looks for what it loads beforehand along PYTHONPATH, not along this program's
# path.
HERE = str(Path(__file__).resolve().parents[3])
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (HERE, os.environ.get("PYTHONPATH"))))
LOADED = (
    "tests.slow.faults.kills",
    "dengine.store.sql",
    "dengine.datasets.importing",
    "dengine.export.torchscript",
    "dengine.reducers.pca",
    "dengine.serve.http",
    "uvicorn",
)
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload([*LOADED, "sklearn.decomposition", "pandas"])
IN_ONE = 20  # kills of one store, so that opening it takes no longer than the kill
SOON = replace(RECIPE, retrain_every=10)  # versions are swapped in between kills
OFTEN = replace(RECIPE, retrain_every=3)  # a version's commit is under way most of the time


def _for_a_while(seconds: float = 60.0) -> Iterator[None]:
    """Turns until somebody kills this process, but not for ever: its killer may be gone."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        yield


def _acknowledge(path: str, *words: object) -> None:
    with Path(path).open("a") as file:
        file.write(" ".join(map(str, words)) + "\n")


def cell(
    place: Place, told: str, seed: int, recipe: Recipe = SOON, locked_after: int | None = None
) -> None:
    """Decide and report on and on, under ids of its own, and tell of each once it was answered and
    acknowledged.

    After each report it decides on a probe; or, `locked_after` so many parts, its store is locked.
    """
    engine, data, rng = (
        DataEngine.open_or_create(place.store(), recipe=recipe),
        stream(),
        np.random.default_rng(seed),
    )
    other = (
        None
        if locked_after is None
        else sqlite3.connect(place.url, isolation_level=None, timeout=30)
    )
    _acknowledge(told, "began", engine.store.decisions.counts()["labels"], engine.version)
    for n, _ in enumerate(_for_a_while()):
        if other is not None and n == locked_after:
            other.execute("BEGIN IMMEDIATE")
        i = int(rng.integers(len(data) - PROBE))
        decision = engine.decide(data.X[i], decision_id=f"{seed}-{n}")
        if decision.reason is Reason.NO_STORE:
            continue  # recorded under no id, or verified over a slow disk
        _acknowledge(told, "answer", decision.id, i, decision.action, decision.lower)
        if decision.action is Action.VERIFY:
            engine.report(decision.id, bool(data.y[i]))
            _acknowledge(told, "label", decision.id, int(data.y[i]))
        if other is None:
            probe = engine.decide(data.X[-1])
            _acknowledge(
                told,
                "probe",
                engine.version,
                probe.lower,
                probe.upper,
                probe.n_success,
                probe.n_failure,
            )


often = partial(cell, recipe=OFTEN)
in_outage = partial(cell, locked_after=5)


def serving(place: Place, told: str, seed: int) -> None:
    """A served cell, with the process that retrains beside it."""
    with RetrainingProcess() as pool:
        pool.submit(int).result()  # it has begun
        service = CellService(
            lambda: DataEngine.open_or_create(place.store(), recipe=SOON, executor=pool)
        )
        with closing(service), served(create_app(service)) as port:
            _acknowledge(
                told,
                "began",
                service.engine.store.decisions.counts()["labels"],
                service.engine.version,
                port,
            )
            time.sleep(60)


def drive(told: str, seed: int) -> None:
    """Ask a served cell, and tell it, until it is killed."""
    data, rng = stream(), np.random.default_rng(seed)
    port = int(Path(told).read_text().split()[3])
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=30)) as connection:

        def ask(path: str, **body: object) -> dict[str, Any]:
            connection.request("POST", path, json.dumps(body), {"content-type": "application/json"})
            answer = connection.getresponse()
            document: dict[str, Any] = json.loads(answer.read())
            if answer.status != 200:
                raise ConnectionError(document)
            return document

        with suppress(
            OSError, http.client.HTTPException, ValueError
        ):  # it was killed, as it was to be
            for n, _ in enumerate(_for_a_while()):
                i = int(rng.integers(len(data) - PROBE))
                document = ask("/decide", trace=data.X[i].tolist(), request=f"{seed}-{n}")
                if document["late"] or document["reason"] == Reason.NO_STORE:
                    continue
                _acknowledge(
                    told, "answer", document["id"], i, document["action"], document["lower"]
                )
                if document["action"] == Action.VERIFY:
                    ask("/report", id=document["id"], success=bool(data.y[i]))
                    _acknowledge(told, "label", document["id"], int(data.y[i]))


def importing(place: Place, told: str, seed: int) -> None:
    """An import of recorded labels, chunk by chunk."""
    _acknowledge(told, "imported", 0)
    import_labelled(
        place.store(),
        stream(),
        recipe=RECIPE,
        on_traces=lambda n: _acknowledge(told, "imported", n),
    )
    time.sleep(60)


def exporting(place: Place, told: str, seed: int) -> None:
    """An engine that is exported to one file again and again."""
    with DataEngine.open(place.store(), reading=True) as engine:
        for _ in _for_a_while():
            export_torchscript(engine, Path(place.url).with_suffix(".ts"), force=True)
            _acknowledge(told, "exported")


def _at_home(surroundings: dict[str, str], child: Callable[..., None], *words: object) -> None:
    """Run a child where its killer looks for its journal: the server of forks keeps the
    surroundings of its start.
    """
    os.environ.update(surroundings)
    child(*words)


def killed(
    child: Callable[..., None], place: Place, seed: int, most: float = 0.5
) -> list[list[str]]:
    """Run a child until a random moment after its first word, kill it, and return what it, and who
    asked it, told.
    """
    answer = f"{place.url if '://' not in place.url else f'/tmp/dengine-{os.getpid()}-{place.cell}'}.told"
    Path(answer).write_text("")
    process = CONTEXT.Process(target=_at_home, args=(dict(os.environ), child, place, answer, seed))
    process.start()
    end = time.monotonic() + 300
    while "\n" not in Path(answer).read_text() and process.is_alive() and time.monotonic() < end:
        time.sleep(0.005)
    timer = threading.Timer(float(np.random.default_rng(seed).uniform(0.0, most)), process.kill)
    timer.start()
    if child is serving and process.is_alive():
        drive(answer, seed)
    timer.join()
    process.join()
    if process.exitcode != -signal.SIGKILL:
        raise RuntimeError("the process that was to be killed had ended by itself")
    text = Path(answer).read_text()
    Path(answer).unlink()
    return [line.split() for line in text[: text.rfind("\n") + 1].splitlines()]


def cut_wal(place: Place, seed: int) -> str:
    """Cut or remove the write-ahead log."""
    wal, rng = Path(f"{place.url}-wal"), np.random.default_rng(seed)
    Path(f"{place.url}-shm").unlink(missing_ok=True)
    wal.unlink() if seed % 2 else os.truncate(wal, int(rng.integers(wal.stat().st_size + 1)))
    return "the ledger lacks entry"


def flip_journal(place: Place, seed: int) -> str:
    """Flip a bit of a record in the journal."""
    journal = Path(f"{place.url}.{place.cell}.journal")
    written = journal.read_bytes().rstrip(b"\0")
    journal.write_bytes(written)
    if len(written) > HEADER:
        flipped(journal, np.random.default_rng(seed))
    return "the journal"


def check_cell(outcome: Outcome, place: Place, told: list[list[str]], excuse: str = "") -> None:
    """Every acknowledged label is there, every id has its answer; an engine to which nothing came
    decides as before.

    excuse : what an event must say where labels, ids or decisions may differ.
    """
    began = [words[1:3] for words in told if words[0] == "began"]
    labels = {words[1]: words[2] == "1" for words in told if words[0] == "label"}
    with DataEngine.open(place.store()) as engine:
        outcome.labels += len(labels)
        outcome.versions += sum(engine.version - int(version) for _, version in began)
        text = bool(excuse) and any(excuse in event.text for event in engine.store.events.newest())
        loss = engine.status().loss
        outcome.must(bool(excuse) or not loss, f"an alarm though nothing was damaged: {loss}")
        lost, n_stored = missing(engine.store, labels), engine.store.decisions.counts()["labels"]
        probe = engine.decide(stream().X[-1])
        outcome.lost += 0 if text and lost == 1 else lost
        now = [
            str(v)
            for v in (engine.version, probe.lower, probe.upper, probe.n_success, probe.n_failure)
        ]
        if (
            told
            and told[-1][0] == "probe"
            and not text
            and [n_stored - len(labels)] == [int(n) for n, _ in began]
        ):
            outcome.must(now == told[-1][1:], f"decides otherwise: {now}, {told[-1]}")
        for id_, i, *answer in (words[1:] for words in told if words[0] == "answer" and not text):
            again = engine.decide(stream().X[int(i)], decision_id=id_)
            outcome.must(
                [again.action, str(again.lower)] == answer,
                f"{id_} is answered otherwise: {answer}, {again}",
            )


def kill_cells(
    outcome: Outcome,
    place: Place,
    times: int,
    child: Callable[..., None] = cell,
    damage: Callable[[Place, int], str] | None = None,
) -> None:
    """Kill so often; a store is killed `IN_ONE` times in a row, then there is a new one.

    damage : done to what was left, of a store of its own each time; returns what is to be said of
    it.
    """
    for seed in range(times):
        custom = next_place(place, seed if damage else seed - seed % IN_ONE)
        if damage:
            DataEngine(recipe=SOON, store=custom.store()).close()
        answer = killed(child, custom, seed)
        outcome.injected += 1
        try:
            check_cell(outcome, custom, answer, damage(custom, seed) if damage else "")
        except DengineError as error:
            outcome.tell(error)


def next_place(place: Place, seed: int) -> Place:
    """Another file, or another cell of a server."""
    return (
        replace(place, cell=f"{place.cell}-{seed}")
        if "://" in place.url
        else replace(place, url=f"{place.url}.{seed}")
    )


def kill_imports(outcome: Outcome, place: Place, times: int) -> None:
    """Kill imports, each of a new store; each is then repeated, and has every trace once."""
    n = len(stream())
    for seed in range(times):
        custom = next_place(place, seed)
        answer = killed(importing, custom, seed, most=1.5)
        outcome.injected += 1
        done = sum(int(words[1]) for words in answer)
        outcome.labels += done
        try:
            with custom.store() as store:
                outcome.lost += max(0, done - store.decisions.counts()["labels"])
            import_labelled(custom.store(), stream(), recipe=RECIPE)
            with custom.store() as store:
                labels = store.decisions.counts()["labels"]
            outcome.must(labels == n, f"{labels} of {n} labels after the repetition")
        except DengineError as error:
            outcome.tell(error)


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
    decision = load_exported(exported(place)).decide(stream().X[0])
    for seed in range(times):
        killed(exporting, place, seed, most=0.3)
        outcome.injected += 1
        with suppress(
            ExportError
        ):  # killed between the file and its sum: exported again it is whole
            result = load_exported(Path(place.url).with_suffix(".ts")).decide(stream().X[0])
            outcome.must(result.action is decision.action, "a killed export decides otherwise")


def kill_programs(outcome: Outcome, place: Place, times: int, program: Path) -> None:
    """Kill the controller's C++ program at random moments of one journal that grows; its labels are
    imported at the end.
    """
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
        journal.write_bytes(b"".join(journal.read_bytes().splitlines(keepends=True)[:-3]))
        outcome.must(
            "its head knows" in import_journal(place.store(), journal).set_aside,
            "the last lines can be removed",
        )
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
        text = process.stdout.readline()
        return text if text.endswith("\n") else ""

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
