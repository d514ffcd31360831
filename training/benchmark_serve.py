"""Measure how long `dengine serve` takes to answer over loopback.

    python training/benchmark_serve.py --n 10000
    python training/benchmark_serve.py --only "HTTP, float32" --n 5000    # two kinds of requests

Run it on an idle machine. Every part that is not rejected is reported, so retrains run in the
background all the time. --folder is where the stores are: a decision under a caller's own id is on
the disk before it is answered, so the disk counts. `benchmark_cycle.py` measures `engine.decide`
itself, and `python -m tests.slow.faults` counts what is lost when a server is killed.
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
from typing import Any, NamedTuple

import numpy as np
from common import POLICY, options, print_table, quantiles, wall_time

from dengine import Dataset, Recipe, load_dataset
from dengine.records import ACTIONS

RAW = "application/octet-stream"
JSON = "application/json"
NOISE = 0.01  # newtons, so that no trace comes twice
WAIT_SECONDS = 120.0  # for a server to start, and for a first version
N_WARM_UP = 100  # decisions before the first version
N_SYNCS = 500
Decide = Callable[[np.ndarray, str], dict[str, Any]]  # of a trace and a request id
Report = Callable[[str, bool], Any]  # of a decision id and an outcome


class Server:
    """A `dengine serve` process.

    It has started when the constructor returns.

    Parameters
    ----------
    folder : Path
        For its store and its log.
    *words : str
        Further options of `dengine serve`.
    """

    def __init__(self, folder: Path, *words: str) -> None:
        command = [sys.executable, "-m", "dengine", "serve"]
        command += ["--store", "cell.db", "--port", "0", *words]
        path = os.pathsep.join(filter(None, [str(Path.cwd()), *sys.path]))
        log = folder / "server.log"
        with log.open("a", encoding="utf-8") as errors:
            self.process = subprocess.Popen(
                command,
                cwd=folder,
                env=os.environ | {"PYTHONPATH": path},
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
            )
        assert self.process.stdout is not None
        ready, _, _ = select.select([self.process.stdout], [], [], WAIT_SECONDS)
        line = self.process.stdout.readline() if ready else ""
        if " served at " not in line:
            raise RuntimeError(f"The server did not start: {log.read_text()[-2000:]}")
        self.port = int(line.partition("127.0.0.1:")[2].partition(",")[0])

    def end(self) -> None:
        """Send SIGTERM and wait for the end of the process."""
        self.process.terminate()
        self.process.communicate()


class Connection:
    """An HTTP connection that stays open."""

    def __init__(self, port: int) -> None:
        self._http = http.client.HTTPConnection("127.0.0.1", port, timeout=60)

    def decide(self, trace: np.ndarray, request_id: str | None = None) -> dict[str, Any]:
        """Ask for a decision on a trace (T,), which is sent as float32."""
        path = f"/decide?request={request_id}" if request_id else "/decide"
        return self.request(path, trace.astype("<f4").tobytes(), RAW)

    def decide_json(self, trace: np.ndarray, request_id: str | None = None) -> dict[str, Any]:
        """Ask for a decision on a trace (T,), which is sent as JSON."""
        return self.request(
            "/decide", json.dumps({"trace": trace.tolist(), "request": request_id}), JSON
        )

    def report(self, decision_id: str, success: bool) -> dict[str, Any]:
        """Report an outcome."""
        return self.request("/report", json.dumps({"id": decision_id, "success": success}), JSON)

    def request(
        self, path: str, body: bytes | str | None = None, content_type: str = JSON
    ) -> dict[str, Any]:
        """Send GET, or POST if there is a body; return the answer.

        Raises
        ------
        RuntimeError
            The status is not 200.
        """
        method = "GET" if body is None else "POST"
        self._http.request(method, path, body, {"content-type": content_type})
        response = self._http.getresponse()
        content: dict[str, Any] = json.loads(response.read())
        if response.status != 200:
            raise RuntimeError(f"{path}: {response.status} {content['detail']}")
        return content


class XmlRpc:
    """The same decisions over XML-RPC."""

    def __init__(self, port: int) -> None:
        url = f"http://127.0.0.1:{port}/RPC2"
        self._proxy = xmlrpc.client.ServerProxy(url, allow_none=True)

    def decide_doubles(self, trace: np.ndarray, request_id: str) -> dict[str, Any]:
        """Ask for a decision on a trace (T,), which is sent as a list of doubles."""
        return self._decide(trace.tolist(), request_id)

    def decide_base64(self, trace: np.ndarray, request_id: str) -> dict[str, Any]:
        """Ask for a decision on a trace (T,), which is sent as float32 in base64."""
        return self._decide(xmlrpc.client.Binary(trace.astype("<f4").tobytes()), request_id)

    def _decide(self, trace: Any, request_id: str) -> dict[str, Any]:
        """Call the server; return id, action and model_version, named as the HTTP API does."""
        answer: Any = self._proxy.decide(trace, request_id)
        return {
            "id": answer["id"],
            "action": ACTIONS[answer["action"]].value,
            "model_version": answer["version"],
        }


class ServedTimes(NamedTuple):
    """Wall times in seconds.

    Attributes
    ----------
    decisions : dict of str to list of float
        By the kind of request.
    reports : list of float
    n_swaps : int
        How many new versions decided meanwhile.
    """

    decisions: dict[str, list[float]]
    reports: list[float]
    n_swaps: int


def time_requests(
    data: Dataset, n: int, kinds: dict[str, Decide], report: Report, prefix: str, pace: float
) -> ServedTimes:
    """Time n decisions by each kind of request, in turn, and the reports of the outcomes.

    A rejected part is not reported.

    Parameters
    ----------
    data : Dataset
        Its traces are sent with a little noise.
    n : int
    kinds : dict of str to Decide
        Kinds of requests by name.
    report : Report
    prefix : str
        Of the request ids.
    pace : float
        Seconds between two parts.
    """
    decisions: dict[str, list[float]] = {kind: [] for kind in kinds}
    reports = []
    versions = set()
    rng = np.random.default_rng(0)
    order = np.random.default_rng(0).permutation(len(data))
    names = list(kinds)
    for i in range(n * len(names)):
        kind = names[i % len(names)]
        row = order[i % len(data)]
        noise = rng.normal(0.0, NOISE, data.X.shape[-1])
        trace = (data.X[row] + noise).astype(np.float32)
        seconds, decision = wall_time(kinds[kind], trace, f"{prefix}-{i}")
        decisions[kind].append(seconds)
        versions.add(decision.get("model_version"))
        if decision["action"] != "reject":
            reports.append(wall_time(report, decision["id"], bool(data.y[row]))[0])
        time.sleep(pace)
    return ServedTimes(decisions, reports, len(versions) - 1)


def wait_for_version(connection: Connection) -> None:
    """Return when the first version decides.

    Raises
    ------
    RuntimeError
        After `WAIT_SECONDS`.
    """
    deadline = time.monotonic() + WAIT_SECONDS
    while connection.request("/status")["version"] == 0:
        if time.monotonic() > deadline:
            raise RuntimeError(f"No first version within {WAIT_SECONDS:g} s.")
        time.sleep(0.05)


def measure(
    data: Dataset, n: int, recipe: Path, folder: Path, pace: float, only: str
) -> dict[str, list[float]]:
    """Start a server, time decisions over HTTP and XML-RPC, and reports, and end the server.

    It prints the number of new versions on standard error.

    Parameters
    ----------
    data : Dataset
    n : int
        Decisions by each kind of request.
    recipe : Path
        A TOML file.
    folder : Path
        For the store.
    pace : float
        Seconds between two parts.
    only : str
        Kinds of requests whose names begin with it; "" for all.

    Returns
    -------
    times : dict of str to list of float
        Wall times in seconds by kind of request, and those of "HTTP, report".
    """
    server = Server(folder, "--recipe", str(recipe))
    try:
        web = Connection(server.port)
        rpc = XmlRpc(server.port)
        all_kinds: dict[str, Decide] = {
            "HTTP, float32, request id": web.decide,
            "HTTP, float32": lambda trace, _: web.decide(trace),
            "HTTP, JSON, request id": web.decide_json,
            "XML-RPC, doubles, request id": rpc.decide_doubles,
            "XML-RPC, base64, request id": rpc.decide_base64,
        }
        kinds = {name: decide for name, decide in all_kinds.items() if name.startswith(only)}
        first_kind = {"warm": next(iter(kinds.values()))}
        time_requests(data, N_WARM_UP, first_kind, web.report, "warm", pace)
        wait_for_version(web)
        times = time_requests(data, n, kinds, web.report, "timed", pace)
    finally:
        server.end()
    print(f"{times.n_swaps} versions swapped in meanwhile", file=sys.stderr)
    return times.decisions | {"HTTP, report": times.reports}


def time_syncs(folder: Path) -> list[float]:
    """Return the times, in seconds, that the disk takes to make 4 kB durable.

    A decision under a caller's own id waits for one of these.
    """
    with (folder / "sync").open("wb", buffering=0) as file:

        def sync() -> None:
            file.write(bytes(4096))
            getattr(os, "fdatasync", os.fsync)(file.fileno())

        return [wall_time(sync)[0] for _ in range(N_SYNCS)]


def main() -> None:
    """Measure and print the table."""
    parser = options(__doc__, data="insertion", samples=None, recipe="conv", folder=None)
    parser.add_argument("--n", type=int, default=10_000, help="decisions by each kind of request")
    parser.add_argument("--only", default="", help="kinds of requests whose names begin so")
    parser.add_argument("--pace", type=float, default=0.002, help="seconds between two parts")
    arguments = parser.parse_args()
    data = load_dataset(arguments.data, samples=arguments.samples)
    recipe = Recipe.load(arguments.recipe).with_policy(**POLICY)
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
        folder = Path(name)
        recipe_file = folder / "recipe.toml"
        recipe_file.write_text(recipe.to_toml(), encoding="utf-8")
        times = {"fdatasync of 4 kB": time_syncs(folder)}
        times |= measure(data, arguments.n, recipe_file, folder, arguments.pace, arguments.only)
    rows = [{"what": kind, **quantiles(seconds)} for kind, seconds in times.items()]
    print_table(rows, "dengine serve over loopback")


if __name__ == "__main__":
    main()
