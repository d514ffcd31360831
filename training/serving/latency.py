"""How long a decision takes: over each interface, and by `engine.decide` with nothing between."""

from __future__ import annotations

import http.client
import os
import sys
import time
import xmlrpc.client
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dengine import DataEngine, Dataset, Recipe
from dengine.serve.retraining import retraining_process
from dengine.serve.server import quick_switches

from .process import JSON, Connection, Server

Ask = Callable[[np.ndarray, str], dict[str, Any]]
Tell = Callable[[str, bool], object]
NOISE = 0.01  # newtons, so that no trace comes twice


def stream(data: Dataset, n: int, seed: int = 0) -> Iterator[tuple[np.ndarray, bool]]:
    """So many traces, (T,) float32, each with a little noise of its own, and their labels."""
    rng, order = np.random.default_rng(seed), np.random.default_rng(seed).permutation(len(data))
    for i in range(n):
        k = order[i % len(data)]
        yield (data.X[k] + rng.normal(0.0, NOISE, data.X.shape[-1])).astype(np.float32), bool(data.y[k])


def drive(
    data: Dataset, n: int, asks: dict[str, Ask], tell: Tell, name: str, pace: float
) -> tuple[dict[str, np.ndarray], list[float], int]:
    """Seconds of each decision by each way of asking, taken in turn; of each report; and versions that answered.

    What is not rejected is reported, so that retrains go on all the time.
    """
    seconds: dict[str, list[float]] = {way: [] for way in asks}
    told, versions = [], set()
    for i, (trace, good) in enumerate(stream(data, n * len(asks))):
        way = list(asks)[i % len(asks)]
        begin = time.perf_counter()
        said = asks[way](trace, f"{name}-{i}")
        seconds[way].append(time.perf_counter() - begin)
        versions.add(said.get("model_version"))
        if said["action"] != "reject":
            begin = time.perf_counter()
            tell(said["id"], good)
            told.append(time.perf_counter() - begin)
        time.sleep(pace)
    return {way: np.array(each) for way, each in seconds.items()}, told, len(versions) - 1


def over_the_network(data: Dataset, n: int, recipe: Path, folder: Path, pace: float) -> Iterator[tuple[str, np.ndarray]]:
    """Rows of the table: HTTP in its forms, XML-RPC where it is there."""
    server = Server(folder, "--recipe", str(recipe))
    server.start()
    try:
        http_, asks = Connection(server.port), dict[str, Ask]()
        asks["HTTP, float32, request id"] = lambda x, id_: http_.decide(x, id_)
        asks["HTTP, float32"] = lambda x, id_: http_.decide(x)
        asks["HTTP, JSON, request id"] = lambda x, id_: http_.decide(x, id_, JSON)
        rpc = xmlrpc.client.ServerProxy(f"http://127.0.0.1:{server.port}/RPC2", allow_none=True)
        if speaks_xmlrpc(rpc):
            asks["XML-RPC, request id"] = lambda x, id_: dict(rpc.decide(x.tolist(), id_))  # type: ignore[call-overload]
        warm = drive(data, 100, {"warm": asks["HTTP, float32"]}, http_.report, "warm", pace)
        _settled(lambda: http_.get("/status")["version"] > 0)
        seconds, told, swaps = drive(data, n, asks, http_.report, "timed", pace)
        del warm
        yield from seconds.items()
        yield "HTTP, report", np.array(told)
        print(f"over the network: {swaps} versions swapped in meanwhile", file=sys.stderr)
    finally:
        server.end()


def speaks_xmlrpc(rpc: xmlrpc.client.ServerProxy) -> bool:
    """Whether the server has that interface."""
    try:
        rpc.status()
    except (xmlrpc.client.ProtocolError, http.client.HTTPException):
        return False
    return True


def within(data: Dataset, n: int, recipe: Path, folder: Path, pace: float) -> Iterator[tuple[str, np.ndarray]]:
    """Rows of the table: the engine itself, with the same store, retraining in the same kind of process."""
    with quick_switches(), retraining_process() as executor:
        options = {"recipe": Recipe.load(recipe), "executor": executor}
        with DataEngine.open_or_create(folder / "engine.db", **options) as engine:
            engine.know_ids()

            def ask(trace: np.ndarray, id_: str | None) -> dict[str, Any]:
                decision = engine.decide(trace, decision_id=id_)
                return {"id": decision.id, "action": decision.action.value, "model_version": decision.model_version}

            asks: dict[str, Ask] = {"engine.decide, request id": ask, "engine.decide": lambda x, id_: ask(x, None)}
            drive(data, 100, {"warm": asks["engine.decide"]}, engine.report, "warm", pace)
            _settled(lambda: engine.settle() is not None or engine.version > 0)
            seconds, told, swaps = drive(data, n, asks, engine.report, "timed", pace)
            yield from seconds.items()
            yield "engine.report", np.array(told)
            print(f"within: {swaps} versions swapped in meanwhile", file=sys.stderr)


def syncs(folder: Path, times: int = 500) -> np.ndarray:
    """What the disk takes for 4 kB that are to be safe: a decision under a caller's id waits for one of these."""
    seconds = []
    with (folder / "sync").open("wb", buffering=0) as file:
        for _ in range(times):
            begin = time.perf_counter()
            file.write(bytes(4096))
            os.fdatasync(file.fileno())
            seconds.append(time.perf_counter() - begin)
    return np.array(seconds)


def _settled(done: Callable[[], bool], wait: float = 120.0) -> None:
    until = time.monotonic() + wait
    while not done():
        if time.monotonic() > until:
            raise RuntimeError(f"No first version within {wait:g} s.")
        time.sleep(0.05)
