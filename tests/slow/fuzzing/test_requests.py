"""Malformed requests over every interface: each is answered by what it is refused with, and nothing
else changes.
"""

import json
import re
import socket
import struct
import xmlrpc.client
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("uvicorn", reason="the server needs the extra `serve`")

from dengine import DataEngine, TraceSpec
from dengine.serve.http import create_app
from dengine.serve.service import CellService
from dengine.store.views import HistoryFilter
from dengine.testing import toy_traces
from tests.support.serving import served

from .damage import SAMPLES, nested, spoilt, tries

JSON, RAW, XML = "application/json", "application/octet-stream", "text/xml"
GOOD = [float(i % 7) for i in range(SAMPLES)]
PATHS = """/decide /report /status /decisions /decisions/x /metrics /healthz /docs /RPC2 /RPC2/wrong /me / /explanations/
/explanations/known-0 /course /embedding /versions /events?limit= /status?last= /correct /forget /rollback /policy /retrain
/part?id= /map?id= /history?page= /page/static/ // /.env /%ff%fe /../../etc/passwd /decisions/..%2f..%2fetc%2fpasswd
/decisions/%00 /decisions?limit= /decisions?open= /decisions?before= /decisions?since= /RPC2?token="""
ODD = [
    "",
    "x",
    "%00",
    "-1",
    "1e999",
    "9" * 5000,
    "x" * 900,
    "%ff",
    "';--",
    "<script>",
    "%0d%0aSet-Cookie:a=b",
    "../../x",
]
METHODS = ["GET", "POST", "POST", "PUT", "DELETE", "PATCH", "TRACE", "CONNECT", "BREW", "get"]
HEADS = """Host:|Host: evil.example|Host: a/b@c|Origin: http://evil.example|Sec-Fetch-Site: cross-site|\
Transfer-Encoding: chunked|Content-Length: -1|Content-Length: x|Content-Length: 99999999999999999999|\
Content-Length: 2000000000|Content-Length: 1e3|Content-Encoding: gzip|Authorization: Basic !"""
BOMB = '<!DOCTYPE b [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;">]><a>&b;</a>'
CALL = "<methodCall><methodName>report</methodName><params><param><value>{}</value></param></params></methodCall>"
ODD_XML = [
    *(
        BOMB,
        '<!DOCTYPE a SYSTEM "file:///etc/passwd"><a/>',
        "<?xml version='1.0' encoding='utf-7'?><a/>",
        "<array>" * 10_000,
    ),
    *("", "<", "<a/>", "\0"),
    *map(CALL.format, (f"<int>{'9' * 6000}</int>", "<base64>=!</base64>", "<nil/>", "<int/>")),
]


def request(
    body: bytes, path: str = "/decide", content: str = JSON, method: str = "POST", *heads: str
) -> bytes:
    """A request whose frame is right, but for what heads say."""
    lines = (
        f"{method} {path} HTTP/1.1",
        "Host: localhost",
        f"Content-Type: {content}",
        f"Content-Length: {len(body)}",
        "Connection: close",
    )
    return "\r\n".join([*lines, *heads, "", ""]).encode("utf-8", "replace") + body


def call(name: str, arguments: Any) -> bytes:
    return xmlrpc.client.dumps(tuple(arguments), name, allow_none=True).encode("utf-8", "replace")


def only(
    body: st.SearchStrategy[bytes], content: str, path: str = "/decide"
) -> st.SearchStrategy[bytes]:
    return body.map(lambda result: request(result, path, content))


fields = st.dictionaries(
    st.sampled_from(["trace", "request", "part", "id", "success", "a"]), nested, max_size=3
)
asked = fields.map(lambda result: {"trace": GOOD} | result) | fields
ids = st.uuids().map(str)  # of what is spoilt, and may yet be good
sound = ids.map(lambda id_: {"trace": GOOD, "request": id_})
paths = st.tuples(st.sampled_from(PATHS.split()), st.sampled_from(ODD)).map("".join)
simple = (
    st.none()
    | st.booleans()
    | st.integers(-(2**31), 2**31 - 1)
    | st.floats()
    | st.text(max_size=20)
)
simple = st.recursive(simple | st.binary(max_size=20), st.lists, max_leaves=50)
names = st.sampled_from(
    [
        "decide",
        "report",
        "add",
        "begin",
        "system.listMethods",
        "__class__",
        "eval",
        "decide_recorded",
    ]
)
framed = request(json.dumps({"trace": GOOD}).encode())
KINDS = {
    "JSON": only(asked.map(json.dumps).map(str.encode), JSON)
    | only(fields.map(json.dumps).map(str.encode), JSON, "/report"),
    "spoilt JSON": only(sound.map(json.dumps).map(str.encode).flatmap(spoilt), JSON),
    "raw": st.builds(
        lambda body, query: request(body, f"/decide?{query}", RAW),
        st.binary(max_size=200)
        | st.sampled_from([2, 3, 100]).map(lambda n: struct.pack(f"<{SAMPLES}f", *GOOD) * n),
        st.sampled_from(
            [
                "",
                "channels=0",
                "channels=3",
                "channels=1&channels=1",
                "a=b",
                "request=%00",
                "part=%0a",
            ]
        ),
    ),
    "XML-RPC": only(st.builds(call, names, st.lists(simple, max_size=4)), XML, "/RPC2")
    | only(st.sampled_from(ODD_XML).map(str.encode), XML, "/RPC2")
    | only(ids.map(lambda id_: call("decide", (GOOD, id_))).flatmap(spoilt), XML, "/RPC2"),
    "an action": st.builds(
        lambda path, body: request(body, path, JSON, "POST", "Origin: http://localhost"),
        st.sampled_from(["/correct", "/forget", "/rollback", "/policy", "/retrain"]),
        st.dictionaries(
            st.sampled_from(["id", "ids", "success", "version", "alpha", "guarantee"]),
            nested,
            max_size=3,
        )
        .map(lambda result: result | {"author": " "})
        .map(json.dumps)
        .map(str.encode),
    ),
    "a head": st.builds(
        request,
        st.just(b"{}"),
        paths,
        st.sampled_from([JSON, "", "a/b", "\x7f"]),
        st.sampled_from(METHODS),
    )
    | st.sampled_from(HEADS.split("|")).map(
        lambda head: request(b"{}\r\n", "/decide", JSON, "POST", head)
    ),
    "no HTTP": st.binary(min_size=1, max_size=3000)
    | st.integers(1, len(framed) - 1).map(lambda n: framed[:n])
    | st.sampled_from(
        [b"GET / HTTX/1.1\r\n\r\n", b"\x16\x03\x01", b"GET / HTTP/1.1\r\nX: " + b"y" * 100_000]
    ),
}


class Cell:
    """A server, what it was sent, and what was decided before."""

    def __init__(self, service: CellService, port: int) -> None:
        self.service, self.port, self.found = service, port, Counter[str]()
        self.before = self.decisions()
        self.probes = self.probed("before")

    def send(self, sent: bytes, ended: bool = False) -> bytes:
        """What it answers until it closes.  ended : no more is sent, so that it waits for no rest."""
        with socket.create_connection(("127.0.0.1", self.port), timeout=60) as connection:
            text = b""
            try:
                connection.sendall(sent)
                if ended:
                    connection.shutdown(socket.SHUT_WR)
                while piece := connection.recv(65536):
                    text += piece
            except ConnectionError:  # it was refused before all was sent
                pass
        return text

    def decisions(self) -> dict[str, str]:
        store = self.service.submit(lambda engine: (engine.flush(), engine.store)[1]).result(60)
        results = [
            store.decisions.get(decision.decision.id)
            for decision in store.decisions.select(HistoryFilter(), 10**6)
        ]
        return {
            decision.decision.id: repr(decision) + decision.trace.tobytes().hex()
            for decision in results
        }

    def probed(self, run: str) -> list[Any]:
        """What it decides on the same few traces."""
        X, _ = toy_traces(20, SAMPLES)
        bodies = [
            {"trace": (x + np.float32(0.02)).tolist(), "request": f"{run}-{i}"}
            for i, x in enumerate(X[:, 0])
        ]
        texts = [
            json.loads(self.send(request(json.dumps(body).encode())).partition(b"\r\n\r\n")[2])
            for body in bodies
        ]
        return [body | {"id": "", "time": 0, "seconds": 0} for body in texts]


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    """After all that was sent, what was decided before is as it was, and the same traces are
    decided on alike.
    """
    file = tmp_path_factory.mktemp("cell") / "cell.db"
    learned(file)
    with (
        closing(CellService(lambda: DataEngine.open(file), file, deadline=60.0)) as service,
        served(create_app(service)) as port,
    ):
        created = Cell(service, port)
        yield created
        assert b'"ok"' in created.send(request(b"", "/healthz", JSON, "GET"))
        assert created.probed("after") == created.probes
        after = created.decisions()
        assert {id_: after[id_] for id_ in created.before} == created.before
        probes = 2 * len(created.probes)
        assert len(after) - len(created.before) - probes <= created.found["taken"]
        assert created.found["refused"] > created.found["taken"]


def learned(file: Path) -> None:
    """A store whose model decides, and some decisions in it."""
    X, y = toy_traces(150, SAMPLES)
    with DataEngine("pca", retrain_every=10**9, store=file, trace=TraceSpec(SAMPLES)) as engine:
        for x, good in zip(X[:, 0], y, strict=True):
            engine.report(engine.decide(x).id, bool(good))
        engine.retrain()
        for i, x in enumerate(X[:30, 0]):
            engine.decide(x + np.float32(0.01), decision_id=f"known-{i}")


@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data())
@tries(0.3)
def test_a_malformed_request_is_answered_and_changes_nothing(
    cell: Cell, kind: str, data: st.DataObject
) -> None:
    sent = data.draw(KINDS[kind])
    text = cell.send(sent, ended=kind == "no HTTP")
    if kind == "no HTTP" and not text:  # it ended in the midst of a request
        return
    status = re.match(rb"HTTP/1\.1 (\d{3}) ", text)
    assert status is not None, "the connection was closed without an answer"
    assert status[1][:1] in b"24", text
    assert b"Traceback" not in text
    cell.found["refused" if status[1][:1] == b"4" or b"<fault>" in text else "taken"] += 1
