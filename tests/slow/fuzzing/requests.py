"""Malformed requests over every interface of a real server process: each is refused, and nothing else changes.

    python -m tests.slow.fuzzing.requests --n 20000 --seed 1

Over HTTP (JSON, raw float32, MessagePack, heads, the page), XML-RPC and bare TCP. Prints a table by kind: tried; refused (a
4xx, a fault); late (half a request: refused once its time was over, by 408); taken (what was only spoilt can still be good,
and a view of the page takes any query); closed (the connection ended without an answer); silent (neither answer nor end);
failed (a 5xx, a redirect, a traceback). None may be closed, silent or failed. Afterwards the decisions from before
must be what they were, the same traces must be decided on as before, and the memory must be as it was after the first
fifth. Exit code 1 if anything is not so.
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
import struct
import subprocess
import sys
import tempfile
import time
import xmlrpc.client
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dengine import DataEngine, TraceSpec, open_store
from dengine.store.views import HistoryFilter
from dengine.testing import toy_traces

from .inputs import spoilt

SHARES = {"json": 0.22, "raw": 0.08, "msgpack": 0.12, "head": 0.13, "xmlrpc": 0.18, "page": 0.05, "bytes": 0.22}
HALF = ("head", "bytes")  # kinds of which some are half a request
OUTCOMES = ("refused", "late", "taken", "closed", "silent", "failed")
SAMPLES = 40
WAIT = 30.0  # seconds in which an answer has to come
PATIENCE = 120.0  # and that to half a request: the server's limit is 10 s, but a busy machine stands still for longer
QUIET = 0.1  # seconds without an answer, after which the server waits for the rest of half a request
MOST = 40  # half requests at once; the server takes 100 connections
JSON, RAW, PACK, XML = "application/json", "application/octet-stream", "application/msgpack", "text/xml"
GOOD = [float(i % 7) for i in range(SAMPLES)]
TRACES: list[Any] = [
    *(None, True, 1, -1.5, "", "1,2", "NaN", {}, {"a": 1}, [], [[]], [[], []], [None, "x"], [1, True], [[1], [1, 2]]),
    *([1.0], GOOD[:-1], [*GOOD, 1.0], [GOOD, GOOD], [[GOOD]], [10**400] * SAMPLES, ["1"] * SAMPLES, [[1.0]] * SAMPLES),
]
IDS: list[Any] = ["", "a\nb", "\0", "x" * 500, "\x1b[31m", "é" * 201, 5, 1.5, True, [], {}, ["a"], "\u202e\n"]
PATHS = [
    *("/", "//", "/../../etc/passwd", "/decisions/..%2f..%2fetc%2fpasswd", "/decisions/%00", "/decisions/" + "x" * 3000),
    *("/decisions/';DROP TABLE decision;--", "/decide/", "/DECIDE", "/report?x=" + "y" * 5000, "/%ff%fe", "/api/none"),
    *("/page/static/../../acts.py", "/page/static/%2e%2e/%2e%2e/x", "/RPC2/wrong", "/RPC2?token=wrong", "/.env"),
    *("/decisions?limit=-1", "/decisions?limit=1e9", "/decisions?open=maybe", "/decisions?limit=%00"),
]
TOKEN = "@" * 43  # in the place of the token that the page's own forms carry
ACTS = ["correct", "rollback", "shadow-on", "shadow-off", "retrain", "export", "none", "..%2f", "%00"]
FIELDS = [  # of a form: none of them is whole
    *("", "author=", "author=%00", "author=" + "x" * 300, "a=b&" * 50, "author=%E2%80%AE"),
    *("author=kim&id=unknown&label=good", "author=kim&id=&label=good", "author=kim&version=-1", "author=kim&version=x"),
    *("author=kim&version=" + "9" * 6000, "author=kim&version=%D9%A1", "author=kim&id=known-0&label=maybe"),
]
VIEWS = "/part?id= /map?id= /history?id= /history?from= /history?page= /history?action= /how?last= /?x="
ODD = ["", "%00", "x" * 900, "%ff", "';--", "<script>", "-1", "1e999", "9" * 5000, "%0d%0aSet-Cookie:a=b", "../../x"]
METHODS = ["PUT", "DELETE", "PATCH", "TRACE", "CONNECT", "BREW", "get", "PROPFIND"]
WRONG = {
    "closed": "connections were closed without an answer",
    "silent": "requests had no answer",
    "failed": "requests failed",
}
REPO = Path(__file__).parents[3]
GROWTH = 24.0  # MB that the server may have grown by, over the last four fifths
SHOWN = 5  # of a kind that are wrong, and are printed

os.environ.setdefault("DENGINE_STORE_WAIT", "30")  # a disk that others use stalls for longer than a cell would wait


def request(
    body: bytes, path: str = "/decide", content: str = JSON, method: str = "POST", heads: tuple[str, ...] = ()
) -> bytes:
    """A request whose frame is right."""
    lines = [f"{method} {path} HTTP/1.1", "Host: localhost", f"Content-Type: {content}", f"Content-Length: {len(body)}"]
    return "\r\n".join([*lines, *heads, "", ""]).encode("utf-8", "replace") + body


def as_json(rng: random.Random) -> bytes:
    """JSON with wrong values, wrong names, or that is none."""
    match rng.randrange(8):
        case 0 | 1:
            return request(json.dumps({"trace": rng.choice(TRACES)}).encode())
        case 2:
            return request(json.dumps({"trace": GOOD, rng.choice(("request", "part")): rng.choice(IDS[:5])}).encode())
        case 3:
            label = rng.choice((None, "OK", -1, 2, 0.5, [], {}, "true"))
            return request(json.dumps({"id": rng.choice(("known", "x", 5, None)), "success": label}).encode(), "/report")
        case 4:
            doubled = '{"trace": [1], "trace": ' + json.dumps(GOOD) + "}"
            odd = ("NaN", "[NaN]", "{", "", "\ufeff{}", "[" * 50_000, '{"trace": [Infinity]}', doubled, '{"a": 1}', "nul")
            return request(rng.choice(odd).encode())
        case 5:
            whole = json.dumps({"trace": GOOD, "request": f"spoilt-{rng.randrange(10**12)}"}).encode()
            return request(spoilt(rng, whole))
        case 6:
            return request(json.dumps({"trace": GOOD}).encode(rng.choice(("utf-16", "utf-32"))))
        case _:
            return request(json.dumps({"trace": GOOD}).encode(), content=rng.choice(("text/plain", "", "a/b", XML, "\x7f")))


def as_raw(rng: random.Random) -> bytes:
    """Raw samples of a wrong number, or with a wrong query."""
    whole = struct.pack(f"<{SAMPLES}f", *GOOD)
    queries = ("channels=0", "channels=-1", "channels=3", "channels=x", "channels=1&channels=1", "a=b", "request=%00")
    queries += ("request=" + "x" * 500, "part=%0a", "channels=99999999999999999999", "channels=%D9%A1")
    match rng.randrange(3):
        case 0:
            return request(rng.randbytes(rng.choice((0, 1, 3, 4, 159, 161, 1000))), content=RAW)
        case 1:
            return request(whole, f"/decide?{rng.choice(queries)}", RAW)
        case _:
            return request(whole * rng.choice((2, 3, 100)), content=RAW)


def as_msgpack(rng: random.Random) -> bytes:
    """MessagePack with wrong values, endless lengths, other types, or that is none."""
    from msgspec.msgpack import encode

    def table(**values: Any) -> bytes:
        return bytes(encode(values))

    match rng.randrange(5):
        case 0:
            trace = rng.choice([each for each in TRACES if "10000" not in str(each)[:8]] + [b"", b"abc", b"1234"])
            return request(table(trace=trace), content=PACK)
        case 1:
            lengths = (b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff")
            return request(rng.choice(lengths) + rng.randbytes(4), content=PACK)
        case 2:
            odd = (b"", b"\xc1", b"\x91" * 5000, b"\x81\x01\x02", b"\xd6\xff\0\0\0\0", b"\xc7\x04\x05abcd", b"\x80\x80")
            return request(rng.choice(odd), content=PACK)
        case 3:
            return request(table(id=rng.choice(("x", 5, None)), success=rng.choice((None, "OK", -1, 2))), "/report", PACK)
        case _:
            return request(spoilt(rng, table(trace=GOOD, request=f"spoilt-{rng.randrange(10**12)}")), content=PACK)


def as_head(rng: random.Random) -> bytes:
    """Wrong methods, paths and headers."""
    body = json.dumps({"trace": GOOD}).encode()
    match rng.randrange(6):
        case 0:
            return request(b"", rng.choice(("/decide", "/report", "/status", "/RPC2")), method=rng.choice(METHODS))
        case 1:
            good = request(b"", rng.choice(PATHS), method=rng.choice(("GET", "POST")))
            return good if rng.random() < 0.9 else b"GET\r\n\r\n"
        case 2:
            heads = ("Origin: http://evil.example", "Sec-Fetch-Site: cross-site", "Origin: null")
            return request(body, heads=(rng.choice(heads),))
        case 3:
            hosts = (b"Host: evil.example", b"X: y", b"Host: a/b@c", b"Host:")
            return request(body).replace(b"Host: localhost", rng.choice(hosts))
        case 4:
            length = rng.choice((b"-1", b"x", b"99999999999999999999", b"1e3", b"+5", b"2000000000", b""))
            return request(body).replace(f"Content-Length: {len(body)}".encode(), b"Content-Length: " + length)
        case _:
            return request(b"", rng.choice(("/decide", "/report")), method="GET")


def as_xml(rng: random.Random) -> bytes:
    """XML-RPC that is none, that wants too much, or that calls what there is not."""

    def call(name: str, *arguments: Any) -> bytes:
        return xmlrpc.client.dumps(arguments, name, allow_none=True).encode("utf-8", "replace")

    small = [each for each in TRACES if "10000" not in str(each)[:8]]
    match rng.randrange(6):
        case 0:
            return request(call("decide", rng.choice(small)), "/RPC2", XML)
        case 1:
            names = ("system.listMethods", "__class__", "", "decide.x", "report", "add", "eval", "decide_recorded")
            name = rng.choice(names)
            return request(call(name, *rng.choice(((), (1,), ("a", "b", "c", "d")))), "/RPC2", XML)
        case 2:
            bomb = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 10))
            odd = (f'<!DOCTYPE b [<!ENTITY a0 "ha">{bomb}]><a>&a9;</a>', '<!DOCTYPE a SYSTEM "file:///etc/passwd"><a/>')
            odd += ("", "<", "<a/>", "<?xml version='1.0' encoding='utf-7'?><a/>", "<array>" * 10_000, "\0")
            return request(rng.choice(odd).encode(), "/RPC2", XML)
        case 3:
            long = "<int>" + "9" * 6000 + "</int>"
            values = (long, "<base64>=!</base64>", "<nil/>", "<struct><member/></struct>", "<int/>")
            param = f"<params><param><value>{rng.choice(values)}</value></param></params>"
            xml = f"<methodCall><methodName>report</methodName>{param}</methodCall>"
            return request(xml.encode(), "/RPC2", XML)
        case 4:
            return request(spoilt(rng, call("decide", GOOD, f"spoilt-{rng.randrange(10**12)}")), "/RPC2", XML)
        case _:
            return request(call("status"), "/RPC2", rng.choice((JSON, "text/plain", "")))


def as_page(rng: random.Random) -> bytes:
    """What the page's own requests are not: acts with wrong forms, of others, without the token; views of nothing."""
    form, act = rng.choice(FIELDS), rng.choice(ACTS)
    kind, own = "application/x-www-form-urlencoded", "Origin: http://localhost"
    match rng.randrange(5):
        case 0 | 1:
            wrong = act if "author=kim" not in form or act in ("correct", "rollback") else "none"
            return request(f"token={TOKEN}&{form}".encode(), f"/acts/{wrong}", kind, heads=(own,))
        case 2:
            heads = ("Origin: http://evil.example", "Sec-Fetch-Site: cross-site", "Cookie: " + "a=b;" * 200)
            return request(b"author=kim", f"/acts/{act}", kind, heads=(rng.choice(heads),))
        case 3:
            body = rng.choice((b"token=x&author=kim", b"{}", rng.randbytes(60), b"&" * 5000, b"author=kim&" * 40))
            return request(body, f"/acts/{act}", kind, heads=(own,))
        case _:
            return request(b"", rng.choice(VIEWS.split()) + rng.choice(ODD), kind, "GET")


def as_bytes(rng: random.Random) -> bytes:
    """No HTTP, half of it, or too much of it."""
    good = request(json.dumps({"trace": GOOD}).encode(), heads=("Connection: close",))
    match rng.randrange(6):
        case 0:
            return rng.randbytes(rng.choice((1, 10, 100, 3000)))
        case 1:
            return good[: rng.randrange(1, len(good) - 1)]
        case 2:
            return b"GET /status HTTP/1.1\r\n" + b"X: " + b"y" * 100_000 + b"\r\n\r\n"
        case 3:
            return rng.choice((b"GET /status HTTX/1.1\r\nHost: localhost\r\n\r\n", b"\x16\x03\x01\x02\x00\x01\x00"))
        case 4:
            chunks = rng.choice((b"zz\r\n", b"-1\r\n", b"FFFFFFFFFFFFFFFF\r\n", b"5\r\nabc"))
            head = b"POST /decide HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\nContent-Type: a/b\r\n\r\n"
            return head + chunks
        case _:
            both = ("Transfer-Encoding: chunked", "Connection: close")
            return request(b"0\r\n\r\n", heads=both)


MAKERS = dict(zip(SHARES, (as_json, as_raw, as_msgpack, as_head, as_xml, as_page, as_bytes), strict=True))


@dataclass
class Call:
    """Bytes that were sent, and what came.

    whole : whether an answer is all there.  judge : an answer's outcome.  ended : the server has ended the connection.
    """

    connection: socket.socket
    sent: bytes
    whole: Callable[[bytes], bool]
    judge: Callable[[bytes], str]
    said: bytes = b""
    ended: bool = False

    def __post_init__(self) -> None:
        with suppress(ConnectionError):  # where it is refused before all was sent, the answer is there to be read
            self.connection.sendall(self.sent)

    @property
    def done(self) -> bool:
        """Whether nothing more is to come."""
        return self.ended or self.whole(self.said)

    def take(self) -> None:
        """Take in what comes next."""
        try:
            piece = self.connection.recv(65536)
        except ConnectionError:
            piece = b""
        self.said += piece
        self.ended = not piece

    def wait(self, seconds: float) -> bool:
        """Wait for the answer; False where it has not come in time."""
        self.connection.settimeout(seconds)
        try:
            while not self.done:
                self.take()
        except TimeoutError:
            pass
        return self.done

    def close(self) -> str:
        """Its outcome: closed is a connection that ended without an answer, silent one that did not even end."""
        self.connection.close()
        if not self.done:
            return "silent"
        return self.judge(self.said) if self.whole(self.said) else "closed"


class Halves:
    """Calls that the server waits for the rest of: their answers are waited for, while others are made."""

    def __init__(self, most: int = MOST) -> None:
        self._most = most
        self._selector = selectors.DefaultSelector()

    def keep(self, call: Call, tell: Callable[[Call], object]) -> None:
        """Wait for an answer; `tell` hears of it, or that there is none."""
        self._selector.register(call.connection, selectors.EVENT_READ, (call, tell, time.monotonic() + PATIENCE))
        self._look(0.0)
        self._until(self._most)

    def finish(self) -> None:
        """Wait for all of them."""
        self._until(0)
        self._selector.close()

    def _until(self, left: int) -> None:
        while len(self._selector.get_map()) > left:
            self._look(0.5)

    def _look(self, seconds: float) -> None:
        for key, _ in self._selector.select(seconds):
            key.data[0].take()
        for each in list(self._selector.get_map().values()):
            call, tell, until = each.data
            if call.done or time.monotonic() > until:
                self._selector.unregister(each.fileobj)
                tell(call)


def over_http(port: int, sent: bytes) -> Call:
    """Bytes over a connection of their own, and what HTTP has as an answer to them."""
    return Call(socket.create_connection(("127.0.0.1", port), timeout=WAIT), sent, _is_whole, _judged)


def exchange(port: int, sent: bytes) -> tuple[int, bytes]:
    """The status, and all of the answer; 0 where there is none."""
    call = over_http(port, sent)
    call.wait(WAIT)
    call.connection.close()
    return _status(call.said), call.said


def _is_whole(said: bytes) -> bool:
    head, end, body = said.partition(b"\r\n\r\n")
    if not end or b"content-length: " not in head.lower():
        return False
    return len(body) >= int(head.lower().partition(b"content-length: ")[2].partition(b"\r\n")[0])


def _status(said: bytes) -> int:
    status = said[9:12]
    return int(status) if said.startswith(b"HTTP/1.") and status.isdigit() else 0


def _judged(said: bytes) -> str:
    status = _status(said)
    if 300 <= status < 400 or status >= 500:
        return "failed"
    if status == 408:
        return "late"
    return "refused" if 400 <= status < 500 or b"<fault>" in said else "taken"


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
        status, answer = exchange(web, request(body))
        assert status == 200, answer
        record = json.loads(answer.partition(b"\r\n\r\n")[2])
        said.append([record[name] for name in ("action", "reason", "lower", "upper", "model_version", "embedding")])
    return said


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
        sent = MAKERS[kind](random.Random(f"{seed} {i}")).replace(TOKEN.encode(), at.token)
        call, tell = over_http(at.web, sent), partial(tally.count, kind, i)
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
        order = [kind for kind, share in SHARES.items() for _ in range(round(share * n))]
        random.Random(seed).shuffle(order)
        found, grown = try_all(order, seed, at)
        status, said = exchange(at.web, b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        wrong += [f"the server is not well: {said!r}"] if status != 200 or b'"ok"' not in said else []
        wrong += ["the same traces are decided on differently"] if probed(at.web, "after") != probes else []
        wrong += [f"the server has grown by {grown:.1f} MB"] if grown > GROWTH else []
    return found, wrong + changed(before, decisions(file), found, at.log)


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
