"""`dengine serve` over loopback: how long a decision takes; `benchmark_cycle.py` has `engine.decide` itself.

    python training/benchmark_serve.py --n 10000
    python training/benchmark_serve.py --only "HTTP, float32" --n 5000    # two ways of asking

Run it on an idle machine. Every part that is not rejected is reported, so that retrains go on in the background all the
time. --folder is where the stores are: a decision under a caller's own id is on the disk before it is answered, so its
disk counts. What kills take back, `python -m tests.slow.faults` counts.
"""

import http.client
import json
import os
import select
import subprocess
import sys
import tempfile
import time
import xmlrpc.client
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from common import POLICY, options, print_table, quantiles, wall_time

from dengine import Dataset, Recipe, load_dataset
from dengine.records import ACTIONS

RAW, JSON = "application/octet-stream", "application/json"
NOISE = 0.01  # newtons, so that no trace comes twice
PATIENCE = 120.0  # seconds for a server to start, and for a first version
Ask = Callable[[np.ndarray, str], dict[str, Any]]
Timed = tuple[dict[str, list[float]], list[float], int]


class Server:
    """A `dengine serve` process."""

    def __init__(self, folder: Path, *words: str) -> None:
        """Start it, and return once it listens."""
        command = [
            sys.executable,
            "-m",
            "dengine",
            "serve",
            "--store",
            "cell.db",
            "--port",
            "0",
            "--rate",
            "0",
            *words,
        ]
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(filter(None, [str(Path.cwd()), *sys.path]))
        }
        log = folder / "server.log"
        with log.open("a", encoding="utf-8") as errors:
            pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": errors, "text": True}
            self.process = subprocess.Popen(command, cwd=folder, env=environment, **pipes)
        assert self.process.stdout is not None
        ready, _, _ = select.select([self.process.stdout], [], [], PATIENCE)
        line = self.process.stdout.readline() if ready else ""
        if " served at " not in line:
            raise RuntimeError(f"The server did not start: {log.read_text()[-2000:]}")
        self.port = int(line.partition("127.0.0.1:")[2].partition(",")[0])

    def end(self) -> None:
        """SIGTERM."""
        self.process.terminate()
        self.process.communicate()


class Connection:
    """A connection that is kept."""

    def __init__(self, port: int) -> None:
        self._http = http.client.HTTPConnection("127.0.0.1", port, timeout=60)

    def decide(
        self, trace: np.ndarray, request: str | None = None, form: str = RAW
    ) -> dict[str, Any]:
        """Ask for a decision on a trace (T,)."""
        if form == JSON:
            return self.ask(
                "/decide", json.dumps({"trace": trace.tolist(), "request": request}), JSON
            )
        return self.ask(
            f"/decide?request={request}" if request else "/decide",
            trace.astype("<f4").tobytes(),
            RAW,
        )

    def report(self, decision_id: str, success: bool) -> dict[str, Any]:
        """Report a label."""
        return self.ask("/report", json.dumps({"id": decision_id, "success": success}), JSON)

    def ask(self, path: str, body: bytes | str | None = None, kind: str = JSON) -> dict[str, Any]:
        """GET, or POST where there is a body."""
        self._http.request("GET" if body is None else "POST", path, body, {"content-type": kind})
        answer = self._http.getresponse()
        said: dict[str, Any] = json.loads(answer.read())
        if answer.status != 200:
            raise RuntimeError(f"{path}: {answer.status} {said['detail']}")
        return said


def drive(
    data: Dataset, n: int, asks: dict[str, Ask], told_by: Any, name: str, pace: float
) -> Timed:
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


def timed(
    data: Dataset,
    n: int,
    asks: dict[str, Ask],
    told_by: Any,
    trained: Callable[[], bool],
    pace: float,
) -> Timed:
    """`drive` once the first version answers."""
    drive(data, 100, {"warm": next(iter(asks.values()))}, told_by, "warm", pace)
    until = time.monotonic() + PATIENCE
    while not trained():
        if time.monotonic() > until:
            raise RuntimeError(f"No first version within {PATIENCE:g} s.")
        time.sleep(0.05)
    return drive(data, n, asks, told_by, "timed", pace)


def over_the_network(
    data: Dataset, n: int, recipe: Path, folder: Path, pace: float, only: str
) -> dict[str, list[float]]:
    """HTTP in its forms, and XML-RPC.  only : those whose name begins so."""
    server = Server(folder, "--recipe", str(recipe))
    try:
        web = Connection(server.port)
        rpc = xmlrpc.client.ServerProxy(f"http://127.0.0.1:{server.port}/RPC2", allow_none=True)

        def call(trace: Any, id_: str) -> dict[str, Any]:
            answer: Any = rpc.decide(trace, id_)
            return {
                "id": answer["id"],
                "action": ACTIONS[answer["action"]].value,
                "model_version": answer["version"],
            }

        asks: dict[str, Ask] = {
            "HTTP, float32, request id": web.decide,
            "HTTP, float32": lambda x, id_: web.decide(x),
            "HTTP, JSON, request id": lambda x, id_: web.decide(x, id_, JSON),
            "XML-RPC, doubles, request id": lambda x, id_: call(x.tolist(), id_),
            "XML-RPC, base64, request id": lambda x, id_: call(
                xmlrpc.client.Binary(x.astype("<f4").tobytes()), id_
            ),
        }
        asks = {way: ask for way, ask in asks.items() if way.startswith(only)}
        seconds, told, swaps = timed(
            data, n, asks, web.report, lambda: web.ask("/status")["version"] > 0, pace
        )
    finally:
        server.end()
    print(f"{swaps} versions swapped in meanwhile", file=sys.stderr)
    return seconds | {"HTTP, report": told}


def syncs(folder: Path, times: int = 500) -> list[float]:
    """What the disk takes for 4 kB that are to be safe: a decision under a caller's id waits for one of these."""
    with (folder / "sync").open("wb", buffering=0) as file:

        def sync() -> None:
            file.write(bytes(4096))
            getattr(os, "fdatasync", os.fsync)(file.fileno())

        return [wall_time(sync)[0] for _ in range(times)]


def main() -> None:
    """Parse, measure, print."""
    parser = options(__doc__, data="insertion", samples=None, recipe="conv", folder=None)
    parser.add_argument("--n", type=int, default=10_000, help="decisions by each way of asking")
    parser.add_argument("--only", default="", help="ways of asking whose name begins so")
    parser.add_argument("--pace", type=float, default=0.002, help="seconds between two parts")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=args.folder) as name:
        folder, recipe = Path(name), Path(name) / "recipe.toml"
        data = load_dataset(args.data, args.samples)
        recipe.write_text(
            Recipe.load(args.recipe).with_policy(**POLICY).to_toml(), encoding="utf-8"
        )
        found = {"fdatasync of 4 kB": syncs(folder)}
        found |= over_the_network(data, args.n, recipe, folder, args.pace, args.only)
        rows = [{"what": way, **quantiles(seconds)} for way, seconds in found.items()]
        print_table(rows, "dengine serve over loopback")


if __name__ == "__main__":
    main()
