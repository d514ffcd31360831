"""`dengine serve` over loopback: how long a decision takes beside `engine.decide`, and what kills take back.

    python training/benchmark_serve.py --n 10000 --kills 50

Run it on an idle machine. Every part that is not rejected is reported, so that retrains go on in the background all the
time. With --kills the client and the server are killed so often each, at random moments; each client writes what it was
answered to the disk before it goes on. At the end all of it is compared: with what is answered then, and with the store.
Exit code 1 if an acknowledged label was lost, or an id was answered twice differently. --folder is where the stores are: a
decision under a caller's own id is on the disk before it is answered, so its disk counts.
"""

from __future__ import annotations

import http.client
import json
import os
import random
import select
import subprocess
import sys
import tempfile
import time
import xmlrpc.client
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from common import POLICY, options, quantiles, tell, wall_time

from dengine import DataEngine, Dataset, Recipe, load_dataset
from dengine.cli.output import progress
from dengine.records import ACTIONS
from dengine.serve.retraining import RetrainingProcess
from dengine.serve.server import quick_switches
from dengine.store import open_store

RAW, JSON = "application/octet-stream", "application/json"
NOISE = 0.01  # newtons, so that no trace comes twice
PATIENCE = 120.0  # seconds for a server to start, and for a client to ask again while it is away
LONGEST = 1.5  # seconds between two kills
SAME = ("id", "action", "predicted", "reason", "lower", "upper", "n_success", "n_failure", "model_version", "part")
Ask = Callable[[np.ndarray, str], dict[str, Any]]


class Server:
    """One `dengine serve` process at a time, at one port."""

    def __init__(self, folder: Path, *words: str) -> None:
        self.folder, self.words, self.port = folder, words, 0
        self.process: subprocess.Popen[str]

    def start(self) -> None:
        """Start it, and return once it listens; the first time at any port, then at that one."""
        command = [sys.executable, "-m", "dengine", "serve", "--store", "cell.db", "--port", str(self.port), "--rate", "0"]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [str(Path.cwd()), *sys.path]))}
        log = self.folder / "server.log"
        with log.open("a", encoding="utf-8") as errors:
            pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": errors, "text": True}
            self.process = subprocess.Popen([*command, *self.words], cwd=self.folder, env=environment, **pipes)
        assert self.process.stdout is not None
        ready, _, _ = select.select([self.process.stdout], [], [], PATIENCE)
        line = self.process.stdout.readline() if ready else ""
        if " served at " not in line:
            raise RuntimeError(f"The server did not start: {log.read_text()[-2000:]}")
        self.port = int(line.partition("127.0.0.1:")[2].partition(",")[0])

    def end(self, kill: bool = False) -> None:
        """SIGTERM, or SIGKILL."""
        self.process.kill() if kill else self.process.terminate()
        self.process.communicate()


class Connection:
    """A connection that is kept, and made anew where it breaks."""

    def __init__(self, port: int, patience: float = 0.0) -> None:
        self.patience, self._http = patience, http.client.HTTPConnection("127.0.0.1", port, timeout=60)

    def decide(self, trace: np.ndarray, request: str | None = None, form: str = RAW) -> dict[str, Any]:
        """Ask for a decision on a trace (T,)."""
        if form == JSON:
            return self.ask("/decide", json.dumps({"trace": trace.tolist(), "request": request}), JSON)
        return self.ask(f"/decide?request={request}" if request else "/decide", trace.astype("<f4").tobytes(), RAW)

    def report(self, decision_id: str, success: bool) -> dict[str, Any]:
        """Report a label."""
        return self.ask("/report", json.dumps({"id": decision_id, "success": success}), JSON)

    def ask(self, path: str, body: bytes | str | None = None, kind: str = JSON) -> dict[str, Any]:
        """GET, or POST where there is a body; asked again while the server is away or has no room."""
        until = time.monotonic() + self.patience
        while True:
            try:
                self._http.request("GET" if body is None else "POST", path, body, {"content-type": kind})
                answer = self._http.getresponse()
                said: dict[str, Any] = json.loads(answer.read())
                if answer.status == 200:
                    return said
                if answer.status != 503 or time.monotonic() > until:
                    raise RuntimeError(f"{path}: {answer.status} {said['detail']}")
            except (OSError, http.client.HTTPException):
                self._http.close()  # the next request opens it again
                if time.monotonic() > until:
                    raise
            time.sleep(0.02)


# ------------------------------------------------------------------------------------------------- how long it takes


def drive(data: Dataset, n: int, asks: dict[str, Ask], told_by: Any, name: str, pace: float) -> Any:
    """Seconds of each decision by each way of asking, taken in turn; of each report; and versions that answered."""
    seconds: dict[str, list[float]] = {way: [] for way in asks}
    rng, order = np.random.default_rng(0), np.random.default_rng(0).permutation(len(data))
    told, versions = [], set()
    for i in range(n * len(asks)):
        way, k = list(asks)[i % len(asks)], order[i % len(data)]
        trace = (data.X[k] + rng.normal(0.0, NOISE, data.X.shape[-1])).astype(np.float32)
        took, said = wall_time(asks[way], trace, f"{name}-{i}")
        seconds[way].append(took)
        versions.add(said.get("model_version"))
        if said["action"] != "reject":
            told.append(wall_time(told_by, said["id"], bool(data.y[k]))[0])
        time.sleep(pace)
    return seconds, told, len(versions) - 1


def timed(data: Dataset, n: int, asks: dict[str, Ask], told_by: Any, trained: Callable[[], bool], pace: float) -> Any:
    """`drive` once the first version answers."""
    drive(data, 100, {"warm": next(iter(asks.values()))}, told_by, "warm", pace)
    until = time.monotonic() + PATIENCE
    while not trained():
        if time.monotonic() > until:
            raise RuntimeError(f"No first version within {PATIENCE:g} s.")
        time.sleep(0.05)
    return drive(data, n, asks, told_by, "timed", pace)


def over_the_network(data: Dataset, n: int, recipe: Path, folder: Path, pace: float) -> dict[str, list[float]]:
    """HTTP in its forms, and XML-RPC."""
    server = Server(folder, "--recipe", str(recipe))
    server.start()
    try:
        web = Connection(server.port)
        rpc = xmlrpc.client.ServerProxy(f"http://127.0.0.1:{server.port}/RPC2", allow_none=True)

        def call(trace: np.ndarray, id_: str) -> dict[str, Any]:
            answer: Any = rpc.decide(trace.tolist(), id_)
            return {"id": answer["id"], "action": ACTIONS[answer["action"]].value, "model_version": answer["version"]}

        asks: dict[str, Ask] = {
            "HTTP, float32, request id": web.decide,
            "HTTP, float32": lambda x, id_: web.decide(x),
            "HTTP, JSON, request id": lambda x, id_: web.decide(x, id_, JSON),
            "XML-RPC, request id": call,
        }
        seconds, told, swaps = timed(data, n, asks, web.report, lambda: web.ask("/status")["version"] > 0, pace)
    finally:
        server.end()
    print(f"over the network: {swaps} versions swapped in meanwhile", file=sys.stderr)
    return seconds | {"HTTP, report": told}


def within(data: Dataset, n: int, recipe: Path, folder: Path, pace: float) -> dict[str, list[float]]:
    """The engine itself, with the same store, retraining in the same kind of process."""
    with quick_switches(), RetrainingProcess() as executor:
        options = {"recipe": Recipe.load(recipe), "executor": executor}
        with DataEngine.open_or_create(folder / "engine.db", **options) as engine:
            engine.know_ids()

            def ask(trace: np.ndarray, id_: str | None) -> dict[str, Any]:
                decision = engine.decide(trace, decision_id=id_)
                return {"id": decision.id, "action": decision.action.value, "model_version": decision.model_version}

            asks: dict[str, Ask] = {"engine.decide, request id": ask, "engine.decide": lambda x, id_: ask(x, None)}
            trained = lambda: engine.settle() is not None or engine.version > 0  # noqa: E731  # asked again and again
            seconds, told, swaps = timed(data, n, asks, engine.report, trained, pace)
    print(f"within: {swaps} versions swapped in meanwhile", file=sys.stderr)
    return seconds | {"engine.report": told}


def syncs(folder: Path, times: int = 500) -> list[float]:
    """What the disk takes for 4 kB that are to be safe: a decision under a caller's id waits for one of these."""
    with (folder / "sync").open("wb", buffering=0) as file:

        def sync() -> None:
            file.write(bytes(4096))
            os.fdatasync(file.fileno())

        return [wall_time(sync)[0] for _ in range(times)]


def rows_of(found: dict[str, list[float]]) -> list[dict[str, Any]]:
    """A row a way of asking, with the ratio to the engine itself."""
    rows = {name: {"what": name, **quantiles(seconds)} for name, seconds in found.items()}
    for name, row in rows.items():
        base = rows["engine.decide, request id" if "request id" in name else "engine.decide"]
        for q in ("p50", "p99"):
            row[f"{q} to engine.decide's"] = None if "report" in name else round(row[f"{q}_s"] / base[f"{q}_s"], 1)
    return list(rows.values())


# ------------------------------------------------------------------------------------------- client and server killed


def numbered(number: int) -> tuple[np.ndarray, bool]:
    """A trace (200,) of a number, and its label; the same in every process."""
    rng = np.random.default_rng(number)
    good = bool(rng.random() < 0.8)
    t, onset = np.linspace(0.0, 1.0, 200), (0.7 if good else 0.35) + rng.normal(0.0, 0.03)
    return (20.0 / (1.0 + np.exp(-40.0 * (t - onset))) + rng.normal(0.0, 0.5, 200)).astype(np.float32), good


def read(file: Path) -> Iterator[dict[str, Any]]:
    """What a client wrote down, as far as its lines are whole."""
    for line in file.read_bytes().split(b"\n")[:-1] if file.exists() else ():
        try:
            yield json.loads(line)
        except ValueError:  # cut by a kill, and gone on behind
            continue


def client(port: int, file: Path) -> None:
    """Ask and report until killed; what was open when an earlier one was killed comes first."""
    done, connection, notes = list(read(file)), Connection(port, PATIENCE), file.open("ab", buffering=0)
    rejected = {each["answer"]["id"] for each in done if "answer" in each and each["answer"]["action"] == "reject"}
    closed = rejected | {each["told"] for each in done if "told" in each}
    asked = [each["ask"] for each in done if "ask" in each]

    def note(**said: Any) -> None:
        notes.write(json.dumps(said).encode() + b"\n")
        os.fsync(notes.fileno())  # on the disk before it goes on

    def cycle(number: int) -> None:
        x, good = numbered(number)
        note(ask=number)
        answer = connection.decide(x, f"part-{number}")
        note(answer=answer)
        if answer["action"] != "reject":
            connection.report(answer["id"], good)
            note(told=answer["id"], success=good)

    for number in dict.fromkeys(n for n in asked if f"part-{n}" not in closed):
        cycle(number)
    number = max(asked, default=-1) + 1
    while True:
        cycle(number)
        if number % 10 == 9:  # what was answered long ago is answered so still
            again = random.randrange(number)
            note(answer=connection.decide(numbered(again)[0], f"part-{again}"))
        number += 1


def begin(call: str) -> subprocess.Popen[bytes]:
    """A process that does this with what is in this file."""
    path = os.pathsep.join([str(Path(__file__).resolve().parent), *filter(None, sys.path)])
    code = f"from benchmark_serve import *; {call}"
    return subprocess.Popen([sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": path})


def wait_for_more(file: Path) -> None:
    """Return once somebody has been answered again, so that no kill hits a process that has not begun."""
    before, until = sum("told" in each for each in read(file)), time.monotonic() + 2 * PATIENCE
    while sum("told" in each for each in read(file)) <= before:
        if time.monotonic() > until:
            raise RuntimeError("The client was not answered any more.")
        time.sleep(0.05)


def kill(times: int, folder: Path, seed: int) -> bool:
    """Kill client and server so often each, in an order by chance; then compare everything. Whether all was kept."""
    rng, victims, file = random.Random(seed), ["client"] * times + ["server"] * times, folder / "client.jsonl"
    rng.shuffle(victims)
    server = Server(folder, "--reducer", "pca", "--no-page", "--alpha", "0.1", "--lower-bound", "0.9")
    server.start()
    asking = f"client({server.port}, Path({str(file)!r}))"
    asker = begin(asking)
    try:
        with progress("kills", 2 * times) as advance:
            for victim in victims:
                wait_for_more(file)
                time.sleep(rng.uniform(0.0, LONGEST))
                if victim == "server":
                    server.end(kill=True)
                    time.sleep(rng.uniform(0.0, 0.2))
                    server.start()
                else:
                    end(asker)
                    asker = begin(asking)
                advance(1)
        wait_for_more(file)
        end(asker)
        said, differently, lost = compare(file, Connection(server.port, PATIENCE))
    finally:
        end(asker)
        server.end()
    with DataEngine.open(folder / "cell.db") as engine:  # it opens, with all that waited in the journal
        said += f", {engine.version} versions"
    compare_with_store(file, folder / "cell.db", differently, lost)
    print(f"{times} kills of the client, {times} of the server: {said}.")
    print(f"Answered twice differently: {len(differently)}. Lost: {len(lost)}.")
    return not differently and not lost


def end(asker: subprocess.Popen[bytes]) -> None:
    """SIGKILL."""
    asker.kill()
    asker.wait()


def compare(file: Path, connection: Connection) -> tuple[str, set[str], set[str]]:
    """Every answer to an id with every other one, and with what is answered now."""
    answers, told = defaultdict(list), {each["told"]: each["success"] for each in read(file) if "told" in each}
    for each in read(file):
        if "answer" in each:
            answers[each["answer"]["id"]].append(each["answer"])
    said = f"{len(answers):,} ids, {sum(map(len, answers.values())):,} answers, {len(told):,} acknowledged labels"
    differently = set()
    for id_, given in answers.items():
        now = connection.decide(numbered(int(id_.removeprefix("part-")))[0], id_)
        if any(one.get(name) != now.get(name) for one in given for name in SAME):
            differently.add(id_)
    lost = {id_ for id_, good in told.items() if connection.ask(f"/decisions/{id_}")["success"] is not good}
    return said, differently, lost


def compare_with_store(file: Path, store: Path, differently: set[str], lost: set[str]) -> None:
    """Answers and acknowledged labels with the store itself, read without a server."""
    opened = open_store(store)
    for each in read(file):
        if answer := each.get("answer"):
            found = opened.get_decision(answer["id"], trace=False)
            if found is None or (found.decision.action, found.decision.lower) != (answer["action"], answer["lower"]):
                differently.add(answer["id"])
        if "told" in each:
            found = opened.get_decision(each["told"], trace=False)
            if found is None or found.success is not each["success"]:
                lost.add(each["told"])
    opened.close()


def main() -> None:
    """Parse, measure, kill, print."""
    parser = options(__doc__, data="insertion", samples=None, recipe="conv", folder=None)
    parser.add_argument("--n", type=int, default=10_000, help="decisions by each way of asking; 0: none")
    parser.add_argument("--kills", type=int, default=0, help="of the client, and as many of the server")
    parser.add_argument("--pace", type=float, default=0.002, help="seconds between two parts")
    parser.add_argument("--seed", type=int, default=0, help="of the kills' moments")
    args = parser.parse_args()
    well = True
    with tempfile.TemporaryDirectory(dir=args.folder) as name:
        folder, recipe = Path(name), Path(name) / "recipe.toml"
        if args.n:
            data = load_dataset(args.data, args.samples)
            recipe.write_text(Recipe.load(args.recipe).with_policy(**POLICY).to_toml(), encoding="utf-8")
            found = {"fdatasync of 4 kB": syncs(folder)} | within(data, args.n, recipe, folder, args.pace)
            found |= over_the_network(data, args.n, recipe, folder, args.pace)
            tell(rows_of(found), "dengine serve over loopback; HTTP's p99 is to be at most 5 ms")
        if args.kills:
            (folder / "kills").mkdir()
            well = kill(args.kills, folder / "kills", args.seed)
    sys.exit(0 if well else 1)


if __name__ == "__main__":
    main()
