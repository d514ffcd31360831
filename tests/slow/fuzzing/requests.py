"""Malformed requests over every interface of a real server process: each is refused, and nothing else changes.

    python -m tests.slow.fuzzing.requests --n 20000 --seed 1

Over HTTP (JSON, raw float32, MessagePack, heads, the page), XML-RPC and bare TCP. Prints a table by kind: tried;
refused (a 4xx, a fault); late (half a request: refused once its time was over, by
408); taken (what was only spoilt can still be good, and a view of the page takes any query); closed (the connection
ended without an answer); silent (there was no answer, and no end); failed (a 5xx, a redirect, a traceback). None may be
closed, silent or failed. Afterwards the decisions from before must be what they were, the same traces must be decided on as
before, and the memory must be as it was after the first fifth. Exit code 1 if anything is not so.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dengine import DataEngine, TraceSpec, open_store
from dengine.store.views import HistoryFilter
from dengine.testing import toy_traces

from .web import MAKERS, SAMPLES, TOKEN
from .wire import QUIET, WAIT, Call, Halves, exchange, over_http

SHARES = {  # of all attempts
    "json": 0.22,
    "raw": 0.08,
    "msgpack": 0.12,
    "head": 0.13,
    "xmlrpc": 0.18,
    "page": 0.05,
    "bytes": 0.22,
}
HALF = ("head", "bytes")  # kinds of which some are half a request
OUTCOMES = ("refused", "late", "taken", "closed", "silent", "failed")
WRONG = {
    "closed": "connections were closed without an answer",
    "silent": "requests had no answer",
    "failed": "requests failed",
}
REPO = Path(__file__).parents[3]
GROWTH = 24.0  # MB that the server may have grown by, over the last four fifths
SHOWN = 5  # of a kind that are wrong, and are printed

os.environ.setdefault("DENGINE_STORE_WAIT", "30")  # a disk that others use stalls for longer than a cell would wait


def serve(store: str) -> None:
    """The server's process: HTTP, XML-RPC and the page, at a port of its own."""
    from dengine.serve.server import Serving
    from dengine.serve.server import serve as serve_cell

    serving = Serving(port=0, rate=0.0, deadline=WAIT)
    serve_cell(
        lambda executor: DataEngine.open(store, executor=executor), store, serving, lambda text: print(text, flush=True)
    )


@dataclass
class Server:
    """A server's process. web : its port.  token : what the page's own forms carry."""

    process: subprocess.Popen[str]
    web: int
    log: Path
    token: bytes = b""

    def memory(self) -> float:
        """Its resident memory, in MB."""
        pages = int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


@contextmanager
def server(store: Path) -> Iterator[Server]:
    """A server over a store; ended by SIGTERM, with exit code 0."""
    log = store.with_suffix(".log")
    with log.open("wb") as errors:
        command = [sys.executable, "-m", "tests.slow.fuzzing.requests", "--serve", str(store)]
        process = subprocess.Popen(command, cwd=REPO, stdout=subprocess.PIPE, stderr=errors, text=True)
        assert process.stdout is not None
        try:
            said = process.stdout.readline()
            found = re.search(r"http://[^ ]*:(\d+)", said)
            assert found is not None, f"the server did not say where it listens, but {said!r}"
            yield Server(process, int(found[1]), log, _page_token(int(found[1])))
            process.send_signal(signal.SIGTERM)
            assert process.wait(60) == 0, f"it ended with exit code {process.returncode}"
        finally:
            process.kill()
            process.wait()


def _page_token(web: int) -> bytes:
    _, page = exchange(web, b"GET /acts HTTP/1.1\r\nHost: localhost\r\n\r\n")
    found = re.search(rb'data-token="([\w-]{43})"', page)
    assert found is not None, "the page's forms carry no token"
    return found[1]


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
            known = store.get_decision(each.decision.id)
            assert known is not None
            found[each.decision.id] = repr(known) + known.trace.tobytes().hex()
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


def attempt(kind: str, at: Server, rng: random.Random) -> Call:
    """One malformed request."""
    return over_http(at.web, MAKERS[kind](rng).replace(TOKEN.encode(), at.token))


@dataclass
class Tally:
    """Outcomes by kind; what is wrong is printed, the first few of each kind."""

    found: dict[str, Counter[str]]

    def count(self, kind: str, i: int, call: Call) -> None:
        """Count a call that has its answer, or has none."""
        outcome = call.close()
        outcome = "failed" if b"Traceback" in call.said else outcome
        self.found[kind][outcome] += 1
        if outcome in WRONG and self.found[kind][outcome] <= SHOWN:
            print(f"{kind} {i} {outcome}: {call.sent[:300]!r} was answered by {call.said[:600]!r}", file=sys.stderr)


def try_all(order: list[str], seed: int, at: Server) -> tuple[dict[str, Counter[str]], float]:
    """Try requests of these kinds; outcomes by kind, and how the memory has grown, MB, since the first fifth."""
    halves, memory = Halves(), 0.0
    tally = Tally({kind: Counter() for kind in SHARES})
    for i, kind in enumerate(order):
        if i == len(order) // 5:
            memory = at.memory()
        call, tell = attempt(kind, at, random.Random(f"{seed} {i}")), partial(tally.count, kind, i)
        if call.wait(QUIET if kind in HALF else WAIT):
            tell(call)
        else:
            halves.keep(call, tell)
    halves.finish()
    grown = at.memory() - memory
    print(f"memory: {memory:.1f} MB after {len(order) // 5}, {memory + grown:.1f} MB after {len(order)}", file=sys.stderr)
    return tally.found, grown


def fuzz(n: int, seed: int, folder: Path) -> tuple[dict[str, Counter[str]], list[str]]:
    """Try n requests; outcomes by kind, and what is not as it must be."""
    file, wrong = folder / "cell.db", list[str]()
    trained(file)
    before = decisions(file)
    with server(file) as at:
        probes = probed(at.web, "before")
        found, grown = try_all(_order(n, seed), seed, at)
        status, said = exchange(at.web, b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        wrong += [f"the server is not well: {said!r}"] if status != 200 or b'"ok"' not in said else []
        wrong += ["the same traces are decided on differently"] if probed(at.web, "after") != probes else []
        wrong += [f"the server has grown by {grown:.1f} MB"] if grown > GROWTH else []
    return found, wrong + changed(before, decisions(file), found, at.log)


def _order(n: int, seed: int) -> list[str]:
    order = [kind for kind, share in SHARES.items() for _ in range(round(share * n))]
    random.Random(seed).shuffle(order)
    return order


def changed(before: dict[str, str], after: dict[str, str], found: dict[str, Counter[str]], log: Path) -> list[str]:
    """What became of the decisions that were there, and of those that came."""
    counts, wrong = sum(found.values(), Counter[str]()), list[str]()
    if changed := [id_ for id_, text in before.items() if after.get(id_) != text]:
        wrong.append(f"decisions are changed: {changed[:5]}")
    came = len([id_ for id_ in after if id_ not in before and not id_.startswith("probe-")])
    if came > counts["taken"]:
        wrong.append(f"{came} decisions were recorded, {counts['taken']} requests taken")
    wrong += [f"{counts[outcome]} {text}" for outcome, text in WRONG.items() if counts[outcome]]
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
