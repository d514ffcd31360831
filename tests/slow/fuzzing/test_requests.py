"""Malformed requests over every interface: each is answered by what it is refused with, and nothing
else changes.
"""

import json
import re
import socket
import struct
import xmlrpc.client
from collections import Counter
from contextlib import closing, suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("uvicorn", reason="the server needs the extra `serve`")

from dengine import DataEngine, TraceSpec
from dengine.serve.http import create_app
from dengine.serve.service import CellService
from dengine.store.views import HistoryFilter
from tests.support.exports import trained
from tests.support.serving import served

from .damage import SAMPLES, nested, spoilt, tries

JSON, RAW, XML = "application/json", "application/octet-stream", "text/xml"
GOOD = [float(i % 7) for i in range(SAMPLES)]
PATHS = """/decide /report /status /decisions /decisions/x /metrics /healthz /docs /RPC2 /RPC2/wrong /me / /explanations/
/explanations/known-0 /course /embedding /versions /events?limit= /status?watch= /correct /forget /rollback /policy /retrain
/part?id= /map?id= /history?page= /page/static/ // /.env /%ff%fe /../../etc/passwd /decisions/..%2f..%2fetc%2fpasswd
/decisions/%00 /decisions?limit= /decisions?open= /decisions?before= /decisions?since= /RPC2?token="""
ODD = "x %00 -1 1e999 LONG %ff ';-- <script> %0d%0aSet-Cookie:a=b ../../x"  # ends of a path
METHODS = "GET POST POST PUT DELETE PATCH TRACE CONNECT BREW get"
HEADS = """Host:|Host: evil.example|Host: a/b@c|Origin: http://evil.example|Sec-Fetch-Site: cross-site|\
Transfer-Encoding: chunked|Content-Length: -1|Content-Length: x|Content-Length: 99999999999999999999|\
Content-Length: 2000000000|Content-Length: 1e3|Content-Encoding: gzip|Authorization: Basic !"""
QUERIES = "a=b channels=0 channels=3 channels=1&channels=1 request=%00 part=%0a"
CALLS = "decide report add begin system.listMethods __class__ eval decide_recorded"
CALL = "<methodCall><methodName>report</methodName><params><param><value>{}</value></param></params></methodCall>"
ODD_XML = f"""
<!DOCTYPE b [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;">]><a>&b;</a>
<!DOCTYPE a SYSTEM "file:///etc/passwd"><a/>
<?xml version='1.0' encoding='utf-7'?><a/>
{"<array>" * 10_000}
<
<a/>
{CALL.format(f"<int>{'9' * 6000}</int>")}
{CALL.format("<base64>=!</base64>")}
{CALL.format("<nil/>")}
{CALL.format("<int/>")}
"""


def request(body: bytes, path="/decide", content=JSON, method="POST", head="X: y") -> bytes:
    """A request whose frame is right, but for what another head says."""
    heads = f"Content-Type: {content}\r\nContent-Length: {len(body)}\r\nConnection: close\r\n{head}"
    text = f"{method} {path} HTTP/1.1\r\nHost: localhost\r\n{heads}\r\n\r\n"
    return text.encode("utf-8", "replace") + body


def call(name, arguments) -> bytes:
    return xmlrpc.client.dumps(tuple(arguments), name, allow_none=True).encode("utf-8", "replace")


def any_of(words: str) -> st.SearchStrategy[str]:
    return st.sampled_from(words.split())


def as_json(values: st.SearchStrategy) -> st.SearchStrategy[bytes]:
    return values.map(json.dumps).map(str.encode)


fields = st.dictionaries(any_of("trace request part id success a"), nested, max_size=3)
asked = fields.map(lambda result: {"trace": GOOD} | result) | fields
ids = st.uuids().map(str)  # of what is spoilt, and may yet be good
sound = ids.map(lambda id_: {"trace": GOOD, "request": id_})
ends = any_of(ODD).map(lambda odd: odd.replace("LONG", "9" * 5000)) | st.just("")
paths = st.tuples(any_of(PATHS), ends).map("".join)
simple = st.none() | st.booleans() | st.floats() | st.text(max_size=20) | st.binary(max_size=20)
simple = st.recursive(simple | st.integers(-(2**31), 2**31 - 1), st.lists, max_leaves=50)
floats = st.sampled_from([2, 3, 100]).map(lambda n: struct.pack(f"<{SAMPLES}f", *GOOD) * n)
xml = (
    st.builds(call, any_of(CALLS), st.lists(simple, max_size=4))
    | st.sampled_from(ODD_XML.splitlines()).map(str.encode)
    | ids.map(lambda id_: call("decide", (GOOD, id_))).flatmap(spoilt)
)
framed = request(json.dumps({"trace": GOOD}).encode())
KINDS = {
    "JSON": st.builds(request, as_json(asked), any_of("/decide /report")),
    "spoilt JSON": as_json(sound).flatmap(spoilt).map(request),
    "raw": st.builds(
        lambda body, query: request(body, f"/decide?{query}", RAW),
        st.binary(max_size=200) | floats,
        any_of(QUERIES),
    ),
    "XML-RPC": xml.map(lambda body: request(body, "/RPC2", XML)),
    "a head": st.builds(
        request,
        st.just(b"{}\r\n"),
        paths,
        st.sampled_from([JSON, "", "a/b", "\x7f"]),
        any_of(METHODS),
        st.sampled_from(HEADS.split("|")),
    ),
    "no HTTP": st.binary(min_size=1, max_size=3000)
    | st.integers(1, len(framed) - 1).map(lambda n: framed[:n])
    | st.sampled_from([b"GET / HTTX/1.1\r\n\r\n", b"GET / HTTP/1.1\r\nX: " + b"y" * 100_000]),
}


def send(port: int, sent: bytes, ended: bool = False) -> bytes:
    """What it answers until it closes.  ended : no more is sent, so that it waits for no rest."""
    text = b""
    with (
        socket.create_connection(("127.0.0.1", port), timeout=60) as connection,
        suppress(ConnectionError),  # it was refused before all was sent
    ):
        connection.sendall(sent)
        if ended:
            connection.shutdown(socket.SHUT_WR)
        while piece := connection.recv(65536):
            text += piece
    return text


def read_decisions(service: CellService) -> dict[str, str]:
    service.submit(lambda engine, late: engine.flush()).result(60)
    store = service.read_store.decisions
    ids = [item.decision.id for item in store.select(HistoryFilter(), 10**6)]
    return {item.decision.id: f"{item} {item.trace.tolist()}" for item in map(store.get, ids)}


@pytest.fixture(scope="module")
def cell(tmp_path_factory, make_data):
    """A port, and how many were taken and refused. After all that was sent, what was decided before
    is as it was, and the same traces are decided on alike.
    """
    file, data = tmp_path_factory.mktemp("cell") / "cell.db", make_data(150, SAMPLES)
    with trained(data, file, TraceSpec(SAMPLES)) as engine:
        for i, x in enumerate(data.X[:30]):
            engine.decide(x + np.float32(0.01), decision_id=f"known-{i}")
    n = Counter()
    with (
        closing(CellService(lambda: DataEngine.open(file), file, deadline=60.0)) as service,
        served(create_app(service)) as port,
    ):
        before, bounds = read_decisions(service), service.engine.model.predict_interval(data.X)
        yield port, n
        assert b'"ok"' in send(port, request(b"", "/healthz", JSON, "GET"))
        after = read_decisions(service)
        np.testing.assert_array_equal(service.engine.model.predict_interval(data.X), bounds)
    assert {id_: after[id_] for id_ in before} == before
    assert len(after) - len(before) <= n["taken"] < n["refused"]


@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data())
@tries(0.3)
def test_a_malformed_request_is_answered_and_changes_nothing(cell, kind, data):
    port, n = cell
    text = send(port, data.draw(KINDS[kind]), ended=kind == "no HTTP")
    if kind == "no HTTP" and not text:  # it ended in the midst of a request
        return
    status = re.match(rb"HTTP/1\.1 ([24])\d\d ", text)
    assert status is not None, text
    assert b"Traceback" not in text
    n["refused" if status[1] == b"4" or b"<fault>" in text else "taken"] += 1
