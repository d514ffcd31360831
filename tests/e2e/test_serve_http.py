"""The server over HTTP, by a real uvicorn and a real client: what it takes, what it refuses, what
it remembers.
"""

import asyncio
import json
import logging
import re
import socket
import ssl
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

pytest.importorskip("uvicorn", reason='the server is not installed: pip install "dengine[serve]"')
httpx = pytest.importorskip(
    "httpx", reason="the tests' HTTP client is not installed: pip install httpx"
)
jsonschema = pytest.importorskip("jsonschema")

from prometheus_client.parser import text_string_to_metric_families
from starlette.routing import Route

from dengine import DataEngine, TraceSpec
from dengine.errors import BusyError, log
from dengine.serve.auth import MAX_BODY, RPC, Token
from dengine.serve.http import VIEWS, create_app
from dengine.serve.service import CellService
from tests.support.command_line import dengine
from tests.support.serving import (
    RECIPE,
    a_service,
    busy_engine,
    certificate,
    served,
    started,
)
from tests.support.tables import rows

TOKEN = "correct-horse-battery-staple"
JSON, PROBLEM = "application/json", "application/problem+json"
RAW = "application/octet-stream"
COUNTED = "action", "n_success", "n_failure", "lower", "upper"


class Client(httpx.Client):
    """Asks a server as a robot does."""

    def ask(self, path, **body):
        return self.post(path, json=body)

    def decide(self, x, request=None, **body):
        return self.ask("/decide", trace=x.tolist(), request=request, **body)


@contextmanager
def serving(tokens=(), file=None, most=32) -> Iterator[tuple[CellService, Client]]:
    """A service of its own, in memory or in a file, and a client of it."""
    with (
        a_service(file, max_waiting=most) as service,
        served(create_app(service, tokens)) as port,
        Client(base_url=f"http://127.0.0.1:{port}", timeout=60, trust_env=False) as client,
    ):
        yield service, client


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    with serving(file=tmp_path_factory.mktemp("serve") / "cell.db") as (_, client):
        yield client


def validate(value: Any, schema: str, client: Client) -> None:
    """Hold an answer to the document that the server itself gives."""
    document = client.get("/openapi.json").json()
    jsonschema.validate(
        value, {"$ref": f"#/components/schemas/{schema}", "components": document["components"]}
    )


def must_be_problem(answer: Any, status: int) -> dict[str, Any]:
    """A problem as RFC 9457 has it, with what the cell does all the same, and nothing of the
    server's inside.
    """
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == PROBLEM
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert "server" not in answer.headers
    text: dict[str, Any] = answer.json()
    assert set(text) == {"type", "title", "status", "detail", "action"}
    assert (text["status"], text["action"]) == (status, "verify")
    assert "Traceback" not in answer.text
    assert text["detail"].isprintable()
    return text


def test_a_cell_over_http_is_the_cell_without_it(client, stream):
    with DataEngine(recipe=RECIPE) as engine:
        for x, good in zip(stream.X[:60], stream.y.astype(bool).tolist(), strict=False):
            here, there = engine.decide(x), client.decide(x).json()
            assert [there[name] for name in COUNTED] == [getattr(here, name) for name in COUNTED]
            if here.action == "verify":
                engine.report(here.id, good)
                assert client.ask("/report", id=there["id"], success=good).json()["success"] is good
        status = client.get("/status").json()
        assert engine.version == status["version"] == 1
        assert status["claim"] == engine.certificate().sentence


def post_raw(client: Client, content: Any, **query: Any) -> Any:
    """Ask for a decision on what is float32."""
    return client.post("/decide", content=content, headers={"content-type": RAW}, params=query)


def test_asked_again_it_answers_the_same(client, stream):
    x, asked = stream.X[0], {"request": "order-0", "part": "P1"}
    first = client.decide(x, **asked).json()
    validate(first, "DecideResponse", client)
    again = post_raw(client, x.astype("<f4").tobytes(), channels=1, **asked).json()
    assert again | {"seconds": 0} == first | {"seconds": 0}
    assert "got another" in must_be_problem(client.decide(stream.X[1], "order-0"), 409)["detail"]


def test_a_label_is_taken_once_and_not_against_itself(client, stream):
    client.decide(stream.X[2] * 9, "label-0")
    assert client.get("/decisions?open=true").json()["decisions"][0]["id"] == "label-0"
    for repeated in (False, True):
        answer = client.ask("/report", id="label-0", success=True).json()
        validate(answer, "ReportResponse", client)
        assert answer["repeated"] is repeated
    for id_, success, status in (
        ("label-0", False, 409),
        ("nobody", True, 404),
        ("label-0", "OK", 422),
    ):
        must_be_problem(client.ask("/report", id=id_, success=success), status)
    assert "label-0" not in client.get("/decisions?open=true").text
    assert client.get("/decisions/label-0").json()["source"] == "verification"


LOOKS = """
status?watch=true                Status
healthz                          Health
decisions?limit=3                Decisions
decisions/missing%2Fsample%20%3F Decision
explanations/missing%2Fsample%20%3F Explanation
course                           Course
embedding                        PartMap
versions                         Versions
me                               Me
events?limit=3                   Events
"""
WRONG_LOOKS = """events?limit=0 status?watch=2 course?hours=5e-324 decisions?limit=0 decisions?limit=x
decisions?open=yes decisions?label=fine decisions?since=monday decisions?limit=9999"""


def test_what_can_be_looked_at_is_as_the_document_says_also_of_a_trace_that_lacks_a_sample(
    client, stream
):
    trace = [*stream.X[8].tolist()[:-1], None]
    answer = client.ask("/decide", trace=trace, request="missing/sample ?").json()
    assert (answer["action"], answer["reason"]) == ("verify", "not_finite")
    assert client.get("/explanations/missing%2Fsample%20%3F").json()["trace"][0][-1] is None
    for path, schema in rows(LOOKS):
        validate(client.get(path).json(), schema, client)
    for path in ("nothing", "decisions/nobody", "explanations/nobody", "decisions?before=nobody"):
        must_be_problem(client.get(path), 404)
    paths = client.get("/openapi.json").json()["paths"].items()
    unknown = [path.format(id="nobody") + "?prat=7" for path, how in paths if "get" in how]
    for path in (*unknown, *WRONG_LOOKS.split()):
        must_be_problem(client.get(path), 422)


@pytest.mark.parametrize("path", ["/report", "/correct"])
def test_a_part_that_comes_back_is_named_by_its_number_unless_it_has_several_decisions(
    path, stream
):
    with serving() as (_, client):
        for i, x in enumerate(stream.X[:3]):
            client.decide(x, f"found-{i}", part=f"F{i % 2}")
            if path == "/correct":
                client.ask("/report", id=f"found-{i}", success=True)
        ask = partial(client.ask, path, success=False, author="Kim")
        assert "found-2, found-0" in must_be_problem(ask(part="F0"), 409)["detail"]
        must_be_problem(ask(part="nobody"), 404)
        must_be_problem(ask(), 422)
        must_be_problem(ask(id="found-0", part="F0"), 422)
        ask(part="F1").raise_for_status()
        assert client.get("/decisions/found-1").json()["success"] is False
        assert client.get("/events?limit=1").json()["events"][0]["author"] == "Kim"
        assert client.get("/explanations/F1").json()["decision"]["id"] == "found-1"


CHANGES = """
correct {"id": "wrong-0", "success": false}
forget  {"ids": ["wrong-1", "wrong-2"], "reason": "a dirty sensor"}
policy  {"alpha": 0.2, "audit_rate": 0.1}
policy  {"force_limits": ["-100:100:-5::along=0"]}
policy  {"shadow": true}
"""


def test_a_label_and_a_policy_are_put_right_by_name_and_nothing_is_done_twice(stream):
    with serving() as (service, client):
        for i in range(3):
            client.decide(stream.X[i], f"wrong-{i}")
            client.ask("/report", id=f"wrong-{i}", success=True)
        for path, text in rows(CHANGES, 2):
            asked = json.loads(text)
            changed = client.ask(path, **asked, author=" Kim  Lee ").json()
            validate(changed, "Changed", client)
            assert changed["event"] is not None
            assert client.ask(path, **asked, author="Kim Lee").json()["event"] is None
        events = client.get("/events").json()["events"]
        kinds = [item["kind"] for item in events if item["author"] == "Kim Lee"]
        assert kinds == ["policy", "policy", "policy", "forget", "correct"]
        assert (service.engine.policy.alpha, service.engine.policy.shadow) == (0.2, True)
        labels = [client.get(f"/decisions/wrong-{i}").json()["success"] for i in range(3)]
        assert labels == [False, None, None]


# Where no author is named, it is Kim.
NOT_PUT_RIGHT = """
422 correct  {"id": "label-0", "success": false, "author": "  "}
422 correct  {"id": "label-0", "success": false, "author": null}
422 correct  {"id": "label-0", "success": "bad"}
422 forget   {"ids": []}
422 retrain  {"author": "LONG"}
422 retrain  {"author": "Kim\\u202e"}
404 correct  {"id": "nobody", "success": false}
404 rollback {"version": 7}
422 rollback {"version": "../1"}
422 release  {"version": 7}
422 policy   {"alpha": 7}
422 policy   {"guarantee": "os:system"}
422 policy   {"force_limits": ["0.1:0.2:high"]}
"""  # a rule is not imported since a request names it


def test_what_cannot_be_put_right_so_is_refused_and_leaves_no_event():
    with serving() as (_, client):
        for status, path, text in rows(NOT_PUT_RIGHT, 3):
            asked = {"author": "Kim"} | json.loads(text.replace("LONG", "x" * 300))
            refused = must_be_problem(client.post(path, json=asked), int(status))
            assert "--" not in refused["detail"]  # no option of the command line
            elsewhere = {"origin": "http://evil.example"}
            must_be_problem(client.post(path, json=asked, headers=elsewhere), 403)
        assert client.get("/events").json()["events"] == []


def test_the_page_is_files_that_may_ask_nobody_else(client):
    for view in ("", "overview", "map", "part?id=nobody", "history", "actions", "docs"):
        answer = client.get(f"/{view}")
        assert answer.status_code == 200
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'; script-src 'self'; style-src 'self'" in policy
        assert "unsafe" not in policy
    for unknown in ("/page/static/../__init__.py", "/page/static/%2e%2e/__init__.py", "/how"):
        assert client.get(unknown).status_code == 404


def test_the_document_names_every_route(client):
    document = client.get("/openapi.json").json()
    with a_service() as service:
        app = create_app(service)
    routes = {
        (route.path.replace(":path", ""), method.lower())
        for route in app.routes
        if isinstance(route, Route) and route.path not in (RPC, *VIEWS)
        for method in route.methods - {"HEAD"}
    }
    named = {(path, method) for path, methods in document["paths"].items() for method in methods}
    assert routes == named


METRICS = """
dengine_decide_seconds_count no_model verify 3
dengine_report_seconds_count false true      1
dengine_new_labels                           1
dengine_late_total                           0
dengine_safe_mode                            0
dengine_store_fault                          0
"""  # name, the values of its labels by their order, value


def test_prometheus_reads_what_was_answered(stream):
    with serving() as (_, client):
        for i in range(3):
            client.decide(stream.X[i], f"m-{i}")
        client.ask("/report", id="m-0", success=True)
        families = text_string_to_metric_families(client.get("/metrics").text)
    lines = {
        " ".join([s.name, *sorted(s.labels.values()), f"{s.value:g}"])
        for family in families
        for s in family.samples
    }
    assert set(map(" ".join, rows(METRICS))) <= lines


# The status, the media type and the body, in which ONE stands for a trace.
REFUSED = """
415 -    1
415 text/csv 1
400 JSON {"trace": [1], "request": "\xff"}
400 JSON {"trace": [NaN]}
400 JSON {"trace": [1], "trace": [2]}
422 JSON {"trace": DEEP
422 JSON {"trace": [DIGITS]}
422 JSON [1.0]
422 JSON {"request": "a"}
422 JSON {"trace": ONE, "reqest": "a"}
422 JSON {"trace": []}
422 JSON {"trace": [1.0, true]}
422 JSON {"trace": [ONE, [1.0]]}
422 JSON {"trace": [1.0, 2.0]}
422 JSON {"trace": "abcd"}
422 JSON {"trace": ONE, "request": 7}
422 JSON {"trace": ONE, "request": "a\\nb"}
422 JSON {"trace": ONE, "request": "LONG"}
422 JSON {"trace": ONE, "part": true}
422 RAW  12345
"""
STANDS_FOR = {
    "ONE": str([1.0] * 60),
    "DEEP": "[" * 100_000,
    "DIGITS": "1" * 5000,
    "LONG": "a" * 201,
}


def test_what_is_no_trace_is_refused_and_leaves_nothing(client, stream):
    client.decide(stream.X[0], "the contract")
    before = client.get("/status").json()["ever"]["decisions"]
    for status, kind, body in rows(REFUSED, 3):
        content = re.sub("ONE|DEEP|DIGITS|LONG", lambda word: STANDS_FOR[word[0]], body)
        headers = {"content-type": kind.replace("JSON", JSON).replace("RAW", RAW)}
        answer = client.post("/decide", content=content.encode("latin-1"), headers=headers)
        must_be_problem(answer, int(status))
    float64 = np.linspace(0.0, 9.0, 60).tobytes()
    for content, query in (
        (float64, {}),
        (b"1234", {"channels": 0}),
        (b"1234", {"path": "/etc"}),
        (b"1234", {"part": ["1", "2"]}),
    ):
        must_be_problem(post_raw(client, content, **query), 422)
    assert client.get("/status").json()["ever"]["decisions"] == before


def test_a_full_line_says_verify_and_when_to_come_again(stream):
    with serving(most=1) as (service, client), busy_engine(service):
        service.submit(lambda engine, late: None)
        answer = client.decide(stream.X[0], "order-0")
        must_be_problem(answer, 503)
        assert int(answer.headers["retry-after"]) >= 1
        assert service.busy == 1
    assert service.read_store.decisions.counts()["decisions"] == 0
    with pytest.raises(BusyError, match="closing"):
        asyncio.run(service.decide(stream.X[0]))


def test_a_token_is_asked_for_says_who_asks_and_a_viewers_only_looks():
    viewer = Token("a-viewer-s-password", operates=False)
    with serving((Token(TOKEN, name="Kim"), viewer)) as (_, client):
        for text in ("", "Bearer other", "Basic !", f"Bearer {TOKEN}x", TOKEN):
            refused = client.get("/status", headers={"authorization": text} if text else {})
            must_be_problem(refused, 401)
            asked = refused.headers.get_list("www-authenticate")
            # A line each, or no browser asks for it.
            assert [item.split()[0] for item in asked] == ["Basic", "Bearer"]
        # Who has the token may call it by any name.
        me = client.get("/me", auth=("anybody", TOKEN), headers={"host": "cell.example"}).json()
        assert me == {"name": "Kim", "operates": True}
        for asked, secret, status in (
            ({}, TOKEN, 200),
            ({"author": "Robin"}, TOKEN, 422),
            ({"author": "Kim"}, viewer.secret, 403),
        ):
            client.headers["authorization"] = f"Bearer {secret}"
            assert client.ask("/policy", shadow=True, **asked).status_code == status
        (event,) = client.get("/events").json()["events"]
        assert (event["kind"], event["author"]) == ("policy", "Kim")
        del client.headers["authorization"]
        assert client.get("/healthz").status_code == 200
        must_be_problem(client.get(f"/RPC2/{TOKEN}"), 405)  # let in; but it takes POST alone
        must_be_problem(client.get(f"/RPC2/{TOKEN}/status"), 401)


ASKED_FROM = """
403 origin http://evil.example
403 origin null
403 sec-fetch-site cross-site
200 origin HERE
200 sec-fetch-site same-origin
200 sec-fetch-site none
421 host evil.example
421 host 127.0.0.1.evil.example
421 host a@b
421 host [
421 host 192.168.0.7
200 host Localhost:8000
200 host [::1]:8000
"""


def test_pages_of_other_sites_are_not_served(client, stream):
    body, here = {"trace": stream.X[0].tolist()}, str(client.base_url).rstrip("/")
    for status, name, value in rows(ASKED_FROM.replace("HERE", here)):
        answer = client.post("/decide", headers={name: value}, json=body)
        assert answer.status_code == int(status), value


def test_a_body_beyond_the_limit_is_refused_announced_or_in_pieces(client):
    for content in (b"0" * (MAX_BODY + 1), iter([b"0" * (MAX_BODY // 2 + 1)] * 2)):
        must_be_problem(post_raw(client, content), 413)


def connected(client: Client) -> socket.socket:
    return socket.create_connection((client.base_url.host, client.base_url.port), timeout=60)


def test_a_hundred_idle_clients_keep_nobody_out(client, stream):
    with ExitStack() as others:
        for _ in range(150):
            other = others.enter_context(connected(client))
            other.sendall(b"GET /healthz HTTP/1.1\r\nhost: localhost\r\n\r\n")
            assert other.recv(1000).startswith(b"HTTP/1.1 200 ")
        for x in stream.X[:20]:
            assert client.decide(x).status_code == 200


def test_what_is_no_http_is_answered_before_its_connection_is_closed(client):
    answer = b""
    with connected(client) as raw:
        raw.sendall(b"GET /healthz HTTP/1.1\r\nx: " + b"y" * 20_000)  # too long a head
        while piece := raw.recv(65536):
            answer += piece
    assert answer.startswith(b"HTTP/1.1 400 "), answer


@pytest.mark.merge  # it starts a process
def test_the_program_serves_until_it_is_told_to_end_and_lets_no_other_have_its_store(
    tmp_path, stream, monkeypatch
):
    certificate(tmp_path)
    make_token(tmp_path)
    # As a cell waits for its store: the tests' own wait is long.
    monkeypatch.delenv("DENGINE_STORE_WAIT", raising=False)
    words = "--shadow --host 0.0.0.0 --token-file token --cert cert.pem --key key.pem"
    form = "--samples 40 --rate-hz 100 --unit Nm --channels MZ,FZ --fit pad --reducer pca"
    with started(tmp_path, *f"{words} {form}".split()) as process:
        trusted = ssl.create_default_context(cafile=str(tmp_path / "cert.pem"))
        here = {"base_url": f"https://localhost:{process.port}", "timeout": 60}
        with httpx.Client(**here, verify=trusted, trust_env=False) as client:
            must_be_problem(client.get("/status"), 401)
            client.headers["authorization"] = f"Bearer {TOKEN}"
            body = {"trace": stream.X[:2, :40].tolist(), "request": "order-0"}
            assert client.post("/decide", json=body).json()["action"] == "verify"
            assert client.get("/status").json()["shadow"] is True
            refused_in_a_line("cell.db", f"--store {tmp_path}/cell.db --port 0")
            refused_in_a_line("already in use", f"--store {tmp_path}/b.db --port {process.port}")
            assert process.end() == 0
    lines = process.output.splitlines()
    assert [line for line in lines if not (" level=" in line and " message=" in line)] == []
    assert TOKEN not in process.output
    with DataEngine.open(tmp_path / "cell.db") as engine:
        assert engine.trace == TraceSpec(40, 100.0, 2, "Nm", fit="pad", columns=("MZ", "FZ"))
        assert engine.find("order-0").decision.action == "verify"


def refused_in_a_line(text: str, words: str) -> None:
    # A server leaves its own log, as the process ends with it.
    with patch.object(logging.getLogger(), "handlers", []), patch.object(log, "level", log.level):
        done = dengine("serve", *words.split())
    assert (done.exit_code, done.output.count("\n")) == (1, 1), (done.output, done.exc_info)
    assert text in done.output


def make_token(folder: Path, text: str = TOKEN, mode: int = 0o600) -> None:
    (folder / "token").write_text(text, encoding="ascii")
    (folder / "token").chmod(mode)


# The token file's mode, the options, and what is said.
NOT_STARTED = """
600; ; Expected --token-file FILE
644; --token-file DIR/token; chmod 600
600; --token-file DIR/token; at least 16 ASCII characters
600; --token-file DIR/none; Cannot read the token file
600; --cert DIR/cert.pem --host localhost; a certificate and its key together
600; --cert DIR/cert.pem --key DIR/locked.pem --host localhost; a key without a password
"""


def test_a_server_that_other_machines_reach_wants_a_token_of_its_owner_alone(tmp_path):
    certificate(tmp_path)
    always = f"--store {tmp_path}/cell.db --port 0 --host 0.0.0.0 "
    for mode, words, text in rows(NOT_STARTED, at="; "):
        make_token(tmp_path, "short", int(mode, 8))
        refused_in_a_line(text, always + words.replace("DIR", str(tmp_path)))
    assert not (tmp_path / "cell.db").exists()


@pytest.mark.merge  # each start begins with that of the process that retrains
def test_what_runs_beside_has_to_start_too_or_one_line_says_why(tmp_path):
    pytest.importorskip("asyncua")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        words = f"--store {tmp_path}/cell.db --reducer pca --port 0 --opcua {port}"
        refused_in_a_line(port, words)
    refused_in_a_line("127.0.0.1", f"{words} --robot 127.0.0.1:{port}")
