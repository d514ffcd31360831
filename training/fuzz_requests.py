"""Malformed requests over every interface of a real server process: each is refused, and nothing else changes.

    python training/fuzz_requests.py --n 20000 --seed 1

Over HTTP (JSON, raw float32, MessagePack, heads, the page), XML-RPC, OPC UA and bare TCP. Prints a table by kind: tried;
refused (a 4xx, a fault, a Bad status); closed (the connection ended, for what is no request at all); waiting (half a
message: the server waits for the rest); taken (what was only spoilt can still be good). Failed is a 5xx, a redirect or a
traceback. Afterwards the decisions from before must be what they were, the same traces must be decided on as before, the
memory must be as it was after the first fifth, and connections that send nothing must have been ended. Exit code 1 if
anything is not so.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import selectors
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from fuzzing.opc import Conversation
from fuzzing.web import MAKERS, SAMPLES

from dengine import DataEngine, TraceSpec, open_store
from dengine.checks import toy_traces
from dengine.store.views import HistoryFilter

SHARES = {  # of all attempts
    "json": 0.22,
    "raw": 0.08,
    "msgpack": 0.12,
    "head": 0.13,
    "xmlrpc": 0.18,
    "page": 0.05,
    "bytes": 0.10,
    "opcua": 0.12,
}
OUTCOMES = ("refused", "closed", "waiting", "taken", "failed")
SLOW = 20  # connections that send half a head, and nothing more
WAIT = 30.0  # seconds in which an answer has to come
QUIET = 0.1  # seconds without an answer to half a request
GROWTH = 24.0  # MB that the server may have grown by, over the last four fifths
SHOWN = 5  # failures of a kind that are printed


def serve(store: str) -> None:
    """The server's process: HTTP, XML-RPC, OPC UA and the page, at ports of its own."""
    from dengine.serve.opcua import opcua_server
    from dengine.serve.server import Serving
    from dengine.serve.server import serve as serve_cell
    from dengine.serve.service import CellService

    @asynccontextmanager
    async def beside(service: CellService) -> AsyncIterator[None]:
        async with opcua_server(service, port=0) as server:
            print(f"opcua {server.port}", flush=True)
            yield

    serving = Serving(port=0, rate=0.0, deadline=WAIT, beside=(beside,))
    serve_cell(
        lambda executor: DataEngine.open(store, executor=executor), store, serving, lambda text: print(text, flush=True)
    )


@dataclass
class Server:
    """A server's process. web, opc : its ports."""

    process: subprocess.Popen[str]
    web: int
    opc: int
    log: Path

    def memory(self) -> float:
        """Its resident memory, in MB."""
        pages = int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


@contextmanager
def server(store: Path) -> Iterator[Server]:
    """A server over a store; ended by SIGTERM, with exit code 0."""
    log = store.with_suffix(".log")
    with log.open("wb") as errors:
        command = [sys.executable, __file__, "--serve", str(store)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)
        assert process.stdout is not None
        try:
            ports = dict(_port(process.stdout.readline()) for _ in range(2))
            yield Server(process, ports["web"], ports["opcua"], log)
            process.send_signal(signal.SIGTERM)
            assert process.wait(60) == 0, f"it ended with exit code {process.returncode}"
        finally:
            process.kill()
            process.wait()


def _port(line: str) -> tuple[str, int]:
    """What listens where, by a line of the server's."""
    found = re.search(r"^opcua (\d+)|http://[^ ]*:(\d+)", line)
    assert found is not None, f"the server did not say where it listens, but {line!r}"
    return ("opcua", int(found[1])) if found[1] else ("web", int(found[2]))


def trained(file: Path) -> None:
    """A store whose model decides, and some decisions in it."""
    X, y = toy_traces(150, SAMPLES)
    with DataEngine("pca", retrain_every=10**9, store=file, trace=TraceSpec(SAMPLES)) as engine:
        for x, good in zip(X[:, 0], y, strict=True):
            engine.report(engine.decide(x).id, bool(good))
        engine.retrain()
        for i, x in enumerate(X[:30, 0]):
            engine.decide(x + np.float32(0.01), decision_id=f"known-{i}")


def decisions(file: Path) -> dict[str, str]:
    """Every decision of a store, with its trace and its label, as text."""
    store = open_store(file)
    try:
        found = {}
        for each in store.decisions(HistoryFilter(), 10**6):
            known = store.get_decision(each.id)
            assert known is not None
            found[each.id] = repr(known) + known.trace.tobytes().hex()
        return found
    finally:
        store.close()


def probed(web: int, run: str) -> list[Any]:
    """What the server decides on the same few traces."""
    X, _ = toy_traces(20, SAMPLES)
    said = []
    for i, x in enumerate(X[:, 0]):
        body = json.dumps({"trace": (x + np.float32(0.02)).tolist(), "request": f"probe-{run}-{i}"}).encode()
        status, answer = exchange(web, _posted(body))
        assert status == 200, answer
        record = json.loads(answer.partition(b"\r\n\r\n")[2])
        said.append([record[name] for name in ("action", "reason", "lower", "upper", "model_version", "embedding")])
    return said


def _posted(body: bytes) -> bytes:
    head = (
        f"POST /decide HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
    )
    return head.encode() + body


def exchange(port: int, sent: bytes, whole: bool = True) -> tuple[int, bytes]:
    """Send bytes; the answer's status and text. 0: the connection ended without one; -1: nothing came.

    whole : an answer has to come; else the server may wait for the rest.
    """
    with socket.create_connection(("127.0.0.1", port), timeout=WAIT if whole else QUIET) as connection:
        said = b""
        try:
            connection.sendall(sent)
            while not _complete(said):
                piece = connection.recv(65536)
                if not piece:
                    break
                said += piece
        except TimeoutError:
            return -1, said
        except ConnectionError:  # it was refused before all was sent
            pass
    status = said[9:12]
    return (int(status) if said.startswith(b"HTTP/1.") and status.isdigit() else 0), said


def _complete(said: bytes) -> bool:
    head, end, body = said.partition(b"\r\n\r\n")
    if not end or b"content-length: " not in head.lower():
        return False
    return len(body) >= int(head.lower().partition(b"content-length: ")[2].partition(b"\r\n")[0])


def over_web(kind: str, port: int, rng: random.Random) -> tuple[str, bytes]:
    """An attempt over HTTP, XML-RPC or TCP."""
    status, said = exchange(port, MAKERS[kind](rng), whole=kind != "bytes" and kind != "head")
    if 300 <= status < 400 or status >= 500 or b"Traceback" in said:
        return "failed", said
    if status in (0, -1):
        return ("closed" if status == 0 else "waiting"), said
    if 400 <= status < 500 or b"<fault>" in said:
        return "refused", said
    return "taken", said


def over_opcua(conversation: Conversation, rng: random.Random) -> tuple[str, bytes]:
    """An attempt over OPC UA."""
    outcome, said = conversation.play(rng)
    return ("failed" if b"Traceback" in said else outcome), said


def attempt(kind: str, at: Server, conversation: Conversation, rng: random.Random) -> tuple[str, bytes]:
    """One malformed request; its outcome, and what was answered."""
    return over_opcua(conversation, rng) if kind == "opcua" else over_web(kind, at.web, rng)


def slow_ones(port: int) -> list[socket.socket]:
    """Connections that send half a head, and nothing more."""
    begun = []
    for _ in range(SLOW):
        connection = socket.create_connection(("127.0.0.1", port), timeout=WAIT)
        connection.sendall(b"POST /decide HTTP/1.1\r\nHost: localhost\r\n")
        begun.append(connection)
    return begun


def still_open(connections: list[socket.socket]) -> int:
    """How many of them the server has not ended within WAIT."""
    end, left = time.monotonic() + WAIT, set(connections)
    with selectors.DefaultSelector() as selector:
        for each in connections:
            selector.register(each, selectors.EVENT_READ)
        while left and (seconds := end - time.monotonic()) > 0:
            for key, _ in selector.select(seconds):
                connection: Any = key.fileobj
                if not _more(connection):
                    selector.unregister(connection)
                    left.discard(connection)
    for each in connections:
        each.close()
    return len(left)


def _more(connection: socket.socket) -> bool:
    try:
        return bool(connection.recv(65536))
    except ConnectionError:
        return False


def fuzz(n: int, seed: int, folder: Path) -> tuple[dict[str, Counter[str]], list[str]]:
    """Try n requests; outcomes by kind, and what is not as it must be."""
    file, wrong = folder / "cell.db", list[str]()
    trained(file)
    before, order = decisions(file), _order(n, seed)
    found = {kind: Counter[str]() for kind in SHARES}
    with server(file) as at:
        conversation, probes, slow = Conversation(at.opc), probed(at.web, "before"), slow_ones(at.web)
        memory = 0.0
        for i, kind in enumerate(order):
            if i == n // 5:
                memory = at.memory()
            outcome, said = attempt(kind, at, conversation, random.Random(f"{seed} {i}"))
            found[kind][outcome] += 1
            if outcome == "failed" and found[kind]["failed"] <= SHOWN:
                print(f"{kind} {i}: {said[:600]!r}", file=sys.stderr)
        grown = at.memory() - memory
        print(f"memory: {memory:.1f} MB after {n // 5}, {memory + grown:.1f} MB after {n}", file=sys.stderr)
        status, said = exchange(at.web, b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        wrong += [f"the server is not well: {said!r}"] if status != 200 or b'"ok"' not in said else []
        wrong += ["the same traces are decided on differently"] if probed(at.web, "after") != probes else []
        wrong += [f"the server has grown by {grown:.1f} MB"] if grown > GROWTH else []
        wrong += [f"{left} slow connections were not ended"] if (left := still_open(slow)) else []
    return found, wrong + _changed(before, decisions(file), found, at.log)


def _order(n: int, seed: int) -> list[str]:
    order = [kind for kind, share in SHARES.items() for _ in range(round(share * n))]
    random.Random(seed).shuffle(order)
    return order


def _changed(before: dict[str, str], after: dict[str, str], found: dict[str, Counter[str]], log: Path) -> list[str]:
    """What became of the decisions that were there, and of those that came."""
    counts, wrong = sum(found.values(), Counter[str]()), list[str]()
    if changed := [id_ for id_, text in before.items() if after.get(id_) != text]:
        wrong.append(f"decisions are changed: {changed[:5]}")
    came = len([id_ for id_ in after if id_ not in before and not id_.startswith("probe-")])
    if came > counts["taken"]:
        wrong.append(f"{came} decisions were recorded, {counts['taken']} requests taken")
    if counts["failed"]:
        wrong.append(f"{counts['failed']} requests failed")
    if "Traceback" in log.read_text(errors="replace"):
        wrong.append(f"there are tracebacks in the log: {log.read_text(errors='replace')[-3000:]}")
    return wrong


def main() -> None:
    """Parse, try, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=20_000, help="requests to try")
    parser.add_argument("--seed", type=int, default=1, help="the same seed, the same requests")
    parser.add_argument("--serve", metavar="STORE", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.serve:
        serve(args.serve)
        return
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        found, wrong = fuzz(args.n, args.seed, Path(folder))
    print(f"{'kind':8} {'tried':>7} " + " ".join(f"{name:>8}" for name in OUTCOMES))
    for kind, counts in (*found.items(), ("all", sum(found.values(), Counter[str]()))):
        print(f"{kind:8} {sum(counts.values()):7} " + " ".join(f"{counts[name]:8}" for name in OUTCOMES))
    print(*wrong, sep="\n") if wrong else print(f"As it must be; {time.perf_counter() - begin:.0f} s.")
    raise SystemExit(bool(wrong))


if __name__ == "__main__":
    main()
