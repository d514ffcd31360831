"""A client and a server that are killed at random moments: what was acknowledged is kept, what was answered is answered."""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dengine import DataEngine
from dengine.store.base import open_store

from .process import Connection, Server

PATIENCE = 120.0  # seconds that a client asks again while the server is away
LONGEST = 1.5  # seconds between two kills
SAME = ("id", "action", "predicted", "reason", "lower", "upper", "n_success", "n_failure", "model_version", "part")
CROWD = 8  # who asks beside the client, where answers are to be late


def trace(number: int) -> tuple[np.ndarray, bool]:
    """A trace (200,) of a number, and its label; the same in every process."""
    rng = np.random.default_rng(number)
    good = bool(rng.random() < 0.8)
    t, onset = np.linspace(0.0, 1.0, 200), (0.7 if good else 0.35) + rng.normal(0.0, 0.03)
    return (20.0 / (1.0 + np.exp(-40.0 * (t - onset))) + rng.normal(0.0, 0.5, 200)).astype(np.float32), good


class Notes:
    """What a client knows: a line is on the disk before it goes on."""

    def __init__(self, file: Path) -> None:
        self._file = file.open("ab", buffering=0)

    def put(self, **said: Any) -> None:
        """One more line."""
        self._file.write(json.dumps(said).encode() + b"\n")
        os.fsync(self._file.fileno())


def read(file: Path) -> Iterator[dict[str, Any]]:
    """The lines that were written to their end."""
    if file.exists():
        for line in file.read_bytes().split(b"\n")[:-1]:
            try:
                yield json.loads(line)
            except ValueError:  # cut by a kill, and gone on behind
                continue


def client(port: int, file: Path) -> None:
    """Ask and report until killed; what was open when an earlier one was killed comes first."""
    done = list(read(file))
    reported = {each["told"] for each in done if "told" in each}
    answers = {each["answer"]["id"]: each["answer"] for each in done if "answer" in each}
    closed = reported | {id_ for id_, each in answers.items() if each["action"] == "reject"}
    asked = [each["ask"] for each in done if "ask" in each]
    notes, connection = Notes(file), Connection(port, PATIENCE)
    for number in dict.fromkeys(n for n in asked if f"part-{n}" not in closed):
        cycle(number, notes, connection)
    number = max(asked, default=-1) + 1
    while True:
        cycle(number, notes, connection)
        if number % 10 == 9:  # what was answered long ago is answered so still
            again = random.randrange(number)
            notes.put(answer=connection.decide(trace(again)[0], f"part-{again}"))
        number += 1


def cycle(number: int, notes: Notes, connection: Connection) -> None:
    """One part: ask, and report what is not rejected."""
    x, good = trace(number)
    notes.put(ask=number)
    answer = connection.decide(x, f"part-{number}")
    notes.put(answer=answer)
    if answer["action"] != "reject":
        connection.report(answer["id"], good)
        notes.put(told=answer["id"], success=good)


def crowd(port: int) -> None:
    """Ask without a pause and without an id, so that whoever else asks waits in line; until killed."""
    traces = [trace(number)[0] for number in range(50)]

    def ask() -> None:
        connection = Connection(port, PATIENCE)
        while True:
            connection.decide(random.choice(traces))

    for _ in range(CROWD):
        threading.Thread(target=ask).start()


@dataclass
class Kept:
    """What was found when all was over."""

    kills: dict[str, int] = field(default_factory=lambda: {"client": 0, "server": 0})
    asked: int = 0
    answers: int = 0
    acknowledged: int = 0
    late: int = 0
    differently: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    versions: int = 0


def kill(times: int, folder: Path, seed: int, progress: Any, deadline: float | None = None) -> Kept:
    """Kill the client so often, and the server so often, in an order by chance; then compare everything.

    deadline : seconds, of the server, with a crowd in its line, so that many answers are late; None: its own, and no crowd.
    """
    rng, kept = random.Random(seed), Kept()
    victims = ["client"] * times + ["server"] * times
    rng.shuffle(victims)
    words = [] if deadline is None else ["--deadline", str(deadline)]
    server = Server(folder, "--reducer", "pca", "--no-page", "--alpha", "0.1", "--lower-bound", "0.9", *words)
    server.start()
    file, robot, others = folder / "client.jsonl", None, None
    try:
        others = None if deadline is None else begin(f"crowd({server.port})")
        robot = begin_client(server.port, file)
        for victim in victims:
            wait_for_more(file)
            time.sleep(rng.uniform(0.0, LONGEST))
            if victim == "server":
                server.kill()
                time.sleep(rng.uniform(0.0, 0.2))
                server.start()
            else:
                robot.kill()
                robot.wait()
                robot = begin_client(server.port, file)
            kept.kills[victim] += 1
            progress(1)
        wait_for_more(file)
        end(robot, others)
        compare(kept, file, Connection(server.port, PATIENCE))
    finally:
        end(robot, others)
        server.end()
    with DataEngine.open(folder / "cell.db") as engine:  # it opens, with all that waited in the journal
        kept.versions = engine.version
    compare_with_store(kept, file, folder / "cell.db")
    return kept


def begin_client(port: int, file: Path) -> subprocess.Popen[bytes]:
    """A client process."""
    return begin(f"client({port}, Path({str(file)!r}))")


def begin(call: str) -> subprocess.Popen[bytes]:
    """A process that does this."""
    code = f"from serving.kills import *; from pathlib import Path; {call}"
    path = os.pathsep.join([str(Path(__file__).resolve().parents[1]), *filter(None, sys.path)])
    return subprocess.Popen([sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": path})


def end(*processes: subprocess.Popen[bytes] | None) -> None:
    """SIGKILL to all that were begun."""
    for each in filter(None, processes):
        each.kill()
        each.wait()


def wait_for_more(file: Path) -> None:
    """Return once somebody has been answered again, so that no kill hits a process that has not begun."""
    before, until = sum("told" in each for each in read(file)), time.monotonic() + 2 * PATIENCE
    while sum("told" in each for each in read(file)) <= before:
        if time.monotonic() > until:
            raise RuntimeError("The client was not answered any more.")
        time.sleep(0.05)


def said(answer: dict[str, Any]) -> dict[str, Any]:
    """Of an answer what must be the same for ever."""
    return {name: answer.get(name) for name in SAME}


def compare(kept: Kept, file: Path, connection: Connection) -> None:
    """Every answer to an id with every other one, and with what is answered now."""
    answers, told = defaultdict(list), {}
    for each in read(file):
        if "answer" in each:
            answers[each["answer"]["id"]].append(each["answer"])
        if "told" in each:
            told[each["told"]] = each["success"]
    kept.asked, kept.acknowledged = len(answers), len(told)
    for id_, each in answers.items():
        number = int(id_.removeprefix("part-"))
        now = connection.decide(trace(number)[0], id_)
        kept.answers += len(each) + 1
        kept.late += any(one["late"] for one in each)
        if any(said(one) != said(now) for one in each):
            kept.differently.append(id_)
    for id_, success in told.items():
        if connection.get(f"/decisions/{id_}")["success"] is not success:
            kept.lost.append(id_)


def compare_with_store(kept: Kept, file: Path, store: Path) -> None:
    """Answers and acknowledged labels with the store itself, read without a server."""
    opened = open_store(store)
    for each in read(file):
        answer = each.get("answer")
        found = opened.past_decision(each["told"] if "told" in each else answer["id"]) if answer or "told" in each else None
        if answer and (
            found is None or (found.decision.action, found.decision.lower) != (answer["action"], answer["lower"])
        ):
            kept.differently.append(answer["id"])
        if "told" in each and (found is None or found.success is not each["success"]):
            kept.lost.append(each["told"])
    opened.close()
