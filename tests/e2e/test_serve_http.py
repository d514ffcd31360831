"""The server over HTTP, by a real uvicorn and a real client: what it takes, what it refuses, what
it remembers.
"""

import asyncio
import json
import logging
import re
import socket
import ssl
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("uvicorn", reason='the server is not installed: pip install "dengine[serve]"')
httpx = pytest.importorskip(
    "httpx", reason="the tests' HTTP client is not installed: pip install httpx"
)
jsonschema = pytest.importorskip("jsonschema")

from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from prometheus_client.parser import text_string_to_metric_families
from starlette.routing import Route

from dengine import DataEngine, Dataset, TraceSpec
from dengine.errors import BusyError, log
from dengine.serve.api import as_samples
from dengine.serve.auth import MAX_BODY, RPC, Token
from dengine.serve.http import VIEWS, create_app
from dengine.serve.service import CellService
from tests.support.command_line import dengine
from tests.support.serving import (
    RECIPE,
    WAIT,
    a_service,
    busy_engine,
    certificate,
    served,
    started,
)

TOKEN = "correct-horse-battery-staple"
JSON, PROBLEM = "application/json", "application/problem+json"
RAW = "application/octet-stream"
SAMPLES = 60
COUNTED = "action", "n_success", "n_failure", "lower", "upper"


class Client(httpx.Client):
    """Asks a server as a robot does."""

    def ask(self, path: str, **body: Any) -> Any:
        return self.post(path, json=body)

    def decide(self, x: np.ndarray, request: str | None = None, **body: Any) -> Any:
        return self.ask("/decide", trace=x.tolist(), request=request, **body)

    def listed(self, **query: Any) -> list[str]:
        """The ids of the decisions that a query finds."""
        page = self.get("/decisions", params=query).json()
        return [decision["id"] for decision in page["decisions"]]


@contextmanager
def running(
    service: CellService, tokens: tuple[Token, ...] = (), **options: Any
) -> Iterator[Client]:
    """A client of a server in front of this service."""
    with (
        served(create_app(service, tokens), **options) as port,
        Client(base_url=f"http://127.0.0.1:{port}", timeout=60, trust_env=False) as client,
    ):
        yield client


@contextmanager
def serving(
    tokens: tuple[Token, ...] = (), file: Path | None = None, most: int = 32, **options: Any
) -> Iterator[tuple[CellService, Client]]:
    """A service of its own, in memory or in a file, and a client of it."""
    with (
        a_service(file, max_waiting=most) as service,
        running(service, tokens, **options) as client,
    ):
        yield service, client


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[CellService]:
    with a_service(tmp_path_factory.mktemp("serve") / "cell.db") as created:
        yield created


@pytest.fixture(scope="module")
def client(service: CellService) -> Iterator[Client]:
    with running(service) as client:
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
    text: dict[str, Any] = answer.json()
    assert set(text) == {"type", "title", "status", "detail", "action"}
    assert (text["status"], text["action"]) == (status, "verify")
    assert "Traceback" not in answer.text
    assert text["detail"].isprintable()
    return text


def test_a_cell_over_http_is_the_cell_without_it(client: Client, stream: Dataset) -> None:
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


def forms(trace: np.ndarray, request: str) -> Iterator[dict[str, Any]]:
    """The same trace in JSON, and as raw float32."""
    raw, text = trace.astype("<f4").tobytes(), {"request": request, "part": "P1"}
    yield {"json": {"trace": trace.tolist(), **text}}
    yield typed(raw, RAW, channels=1, **text)


def typed(content: bytes, kind: str, **params: Any) -> dict[str, Any]:
    return {"content": content, "headers": {"content-type": kind}, "params": params}


@given(arrays(np.float32, st.integers(1, 60), elements=st.floats(-1e4, 1e4, width=32)))
def test_no_bytes_of_float32_are_taken_for_float64_unless_every_other_sample_is_nothing(
    x: np.ndarray,
) -> None:
    if x[0::2].any() or len(x) % 2:
        assert np.array_equal(as_samples(x.astype("<f4").tobytes())[0], x)


def test_a_sample_that_is_missing_is_null_and_the_part_is_verified(
    client: Client, stream: Dataset
) -> None:
    trace = [*stream.X[8].tolist()[:-1], None]
    answer = client.post("/decide", json={"trace": trace, "request": "missing/sample ?"}).json()
    assert (answer["action"], answer["reason"]) == ("verify", "not_finite")
    shown = client.get("/decisions/missing%2Fsample%20%3F", params={"trace": "true"}).json()
    validate(shown, "Decision", client)
    assert shown["trace"][0][-1] is None


def test_asked_again_it_answers_the_same(client: Client, stream: Dataset) -> None:
    answers = [client.post("/decide", **form).json() for form in forms(stream.X[0], "order-0")]
    for answer in answers:
        validate(answer, "DecideResponse", client)
        assert answer | {"seconds": 0} == answers[0] | {"seconds": 0}
    problem = must_be_problem(client.decide(stream.X[1], "order-0"), 409)
    assert "got another; give it an id of its own" in problem["detail"]


def test_a_label_is_taken_once_and_not_against_itself(client: Client, stream: Dataset) -> None:
    client.decide(stream.X[2] * 9, "label-0")
    assert client.listed(open=True)[0] == "label-0"
    for repeated in (False, True):
        answer = client.ask("/report", id="label-0", success=True).json()
        validate(answer, "ReportResponse", client)
        assert answer["repeated"] is repeated
    for id_, success, status in (
        ("label-0", False, 409),
        ("nobody", True, 404),
        ("label-0", "OK", 422),
        ("", True, 422),
    ):
        must_be_problem(client.ask("/report", id=id_, success=success), status)
    assert "label-0" not in client.listed(open=True)
    assert client.get("/decisions/label-0").json()["source"] == "verification"


def test_what_can_be_looked_at_is_as_the_document_says(client: Client, stream: Dataset) -> None:
    newest = client.decide(stream.X[9]).json()["id"]
    for path, schema in {
        "status?watch=true&last=7": "Status",
        "healthz": "Health",
        "decisions?limit=3": "Decisions",
        f"explanations/{newest}": "Explanation",
        "course": "Course",
        "embedding": "PartMap",
        "versions": "Versions",
        "me": "Me",
        "events?limit=3": "Events",
    }.items():
        validate(client.get(path).json(), schema, client)
    for path in ["decisions/nobody", "explanations/nobody", "decisions?before=nobody"]:
        must_be_problem(client.get(path), 404)
    paths = client.get("/openapi.json").json()["paths"].items()
    wrong = [path.format(id="nobody") + "?prat=7" for path, how in paths if "get" in how]
    wrong += ["events?limit=0", "status?last=0", "course?hours=5e-324"]
    queries = ["limit=0", "limit=x", "open=yes", "label=fine", "since=monday", "limit=9999"]
    for path in (*wrong, *(f"decisions?{query}" for query in queries)):
        must_be_problem(client.get(path), 422)


@pytest.mark.parametrize("path", ["/report", "/correct"])
def test_a_part_that_comes_back_is_named_by_its_number_unless_it_has_several_decisions(
    path: str, stream: Dataset
) -> None:
    with serving() as (_, client):
        for i, x in enumerate(stream.X[:3]):
            client.decide(x, f"found-{i}", part=f"F{i % 2}")
            if path == "/correct":
                client.ask("/report", id=f"found-{i}", success=True)
        for named, status in (
            ({"part": "F0"}, 409),
            ({"part": "nobody"}, 404),
            ({}, 422),
            ({"id": "found-0", "part": "F0"}, 422),
        ):
            refused = client.ask(path, success=False, author="Kim", **named)
            detail = must_be_problem(refused, status)["detail"]
            assert status != 409 or "found-2, found-0" in detail
        client.ask(path, success=False, author="Kim", part="F1").raise_for_status()
        assert client.get("/decisions/found-1").json()["success"] is False
        assert client.get("/events?limit=1").json()["events"][0]["author"] == "Kim"
        assert client.get("/explanations/F1").json()["decision"]["id"] == "found-1"


CHANGES = [
    ("correct", {"id": "wrong-0", "success": False}),
    ("forget", {"ids": ["wrong-1", "wrong-2"], "reason": "a dirty sensor"}),
    ("policy", {"alpha": 0.2, "audit_rate": 0.1}),
    ("policy", {"force_limits": ["-100:100:-5::along=0"]}),
    ("policy", {"shadow": True}),
]


def test_a_label_and_a_policy_are_put_right_by_name_and_nothing_is_done_twice(
    stream: Dataset,
) -> None:
    with serving() as (service, client):
        for i in range(3):
            client.decide(stream.X[i], f"wrong-{i}")
            client.ask("/report", id=f"wrong-{i}", success=True)
        for path, asked in CHANGES:
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


def test_what_cannot_be_put_right_so_is_refused_and_leaves_no_event() -> None:
    with serving() as (_, client):
        for line in NOT_PUT_RIGHT.strip().splitlines():
            status, path, text = line.split(maxsplit=2)
            asked = {"author": "Kim"} | json.loads(text.replace("LONG", "x" * 300))
            refused = must_be_problem(client.post(path, json=asked), int(status))
            assert "--" not in refused["detail"]  # no option of the command line
            elsewhere = {"origin": "http://evil.example"}
            must_be_problem(client.post(path, json=asked, headers=elsewhere), 403)
        must_be_problem(client.ask("/correct", id="label-0", success=False), 422)  # by nobody
        assert client.get("/events").json()["events"] == []


def test_whoever_listens_is_told_of_changes_and_not_of_looks(
    stream: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dengine.serve.http.TICK", 0.5)
    with serving() as (service, client), client.stream("GET", "/changes") as answer:
        names = (line.partition("event: ")[2] for line in answer.iter_lines())
        events = filter(None, names)
        assert [next(events), next(events)] == ["hello", "changed"]
        for _ in range(3):
            client.get("/status")
            client.get("/decisions")
        assert next(events) == "tick"  # half a second of quiet
        client.decide(stream.X[0])
        while (event := next(events)) == "tick":  # on a busy machine another half second is over
            pass
        assert event == "changed"
        service.end_listening()
        assert {*events} <= {"tick"}


def test_the_page_is_files_that_may_ask_nobody_else(client: Client) -> None:
    for view in ("", "overview", "map", "part?id=nobody", "history", "actions"):
        answer = client.get(f"/{view}")
        assert answer.status_code == 200
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'; script-src 'self'; style-src 'self'" in policy
        assert "unsafe" not in policy
    for path in re.findall(r'(?:src|href)="(page/[^"]+)"', answer.text):
        assert client.get(f"/{path}").status_code == 200
    for unknown in ("/page/static/../__init__.py", "/page/static/%2e%2e/__init__.py", "/how"):
        assert client.get(unknown).status_code == 404


def test_the_document_names_every_route_and_every_example_is_served(
    service: CellService, client: Client
) -> None:
    document = client.get("/openapi.json").json()
    app = create_app(service)
    routes = {
        (route.path.replace(":path", ""), method.lower())
        for route in app.routes
        if isinstance(route, Route) and route.path not in (RPC, *VIEWS)
        for method in route.methods - {"HEAD"}
    }
    named = {(path, method) for path, methods in document["paths"].items() for method in methods}
    assert routes == named
    for path, method in named:
        contents = document["paths"][path][method].get("requestBody", {}).get("content", {})
        for content in contents.values():
            schema = {**content["schema"], "components": document["components"]}
            for example in content.get("examples", {}).values():
                jsonschema.validate(example["value"], schema)
                answer = client.post(path, json=example["value"])
                # Of another contract, or unknown here.
                assert answer.status_code in (200, 404, 422), answer.text
                assert re.search("unknown|does not hold|samples|channel", answer.text)
    assert client.get("/docs").headers["content-type"].startswith("text/html")


def test_prometheus_reads_what_was_answered(stream: Dataset) -> None:
    with serving() as (_, client):
        for i in range(3):
            client.decide(stream.X[i], f"m-{i}")
        client.ask("/report", id="m-0", success=True)
        families = text_string_to_metric_families(client.get("/metrics").text)
    result = {(s.name, *sorted(s.labels.values())): s.value for f in families for s in f.samples}
    expected = {
        ("dengine_decide_seconds_count", "no_model", "verify"): 3,
        ("dengine_report_seconds_count", "false", "true"): 1,
        ("dengine_new_labels",): 1,
        ("dengine_late_total",): 0,
        ("dengine_safe_mode",): 0,
        ("dengine_store_fault",): 0,
    }
    assert expected.items() <= result.items()
    assert 0 <= result["dengine_store_lag_seconds",] < 60


REFUSED = {  # the status, the media type, and the body, in which ONE stands for a trace
    "no type": (415, "", "1"),
    "another type": (415, "text/csv", "1"),
    "nothing": (400, JSON, ""),
    "no UTF-8": (400, JSON, '{"trace": [1], "request": "\xff"}'),
    "NaN": (400, JSON, '{"trace": [NaN]}'),
    "a name twice": (400, JSON, '{"trace": [1], "trace": [2]}'),
    "too deep": (422, JSON, '{"trace": ' + "[" * 100_000),
    "digits": (422, JSON, f'{{"trace": [{"1" * 5000}]}}'),
    "a list": (422, JSON, "[1.0]"),
    "no trace": (422, JSON, '{"request": "a"}'),
    "an unknown name": (422, JSON, '{"trace": ONE, "reqest": "a"}'),
    "an empty trace": (422, JSON, '{"trace": []}'),
    "a bool among numbers": (422, JSON, '{"trace": [1.0, true]}'),
    "unequal channels": (422, JSON, '{"trace": [ONE, [1.0]]}'),
    "another length": (422, JSON, '{"trace": [1.0, 2.0]}'),
    "a text": (422, JSON, '{"trace": "abc"}'),
    "a text in base64": (422, JSON, '{"trace": "abcd"}'),
    "a request that is a number": (422, JSON, '{"trace": ONE, "request": 7}'),
    "a request that ends a line": (422, JSON, '{"trace": ONE, "request": "a\\nb"}'),
    "a request too long": (422, JSON, f'{{"trace": ONE, "request": "{"a" * 201}"}}'),
    "a part that is a bool": (422, JSON, '{"trace": ONE, "part": true}'),
    "half a float": (422, RAW, "12345"),
    "float64": (422, RAW, np.linspace(0.0, 9.0, SAMPLES).tobytes().decode("latin-1")),
    "no channels": (422, RAW, "1234", "channels=0"),
    "an unknown query": (422, RAW, "1234", "path=/etc"),
    "a query twice": (422, RAW, "1234", "part=1&part=2"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_trace_is_refused_and_leaves_nothing(
    client: Client, stream: Dataset, name: str
) -> None:
    client.decide(stream.X[0], "the contract")
    before = client.get("/status").json()["ever"]["decisions"]
    status, kind, body, *query = REFUSED[name]
    content = body.replace("ONE", str([1.0] * SAMPLES)).encode("latin-1")
    path = "?".join(["/decide", *query])
    answer = client.post(path, content=content, headers={"content-type": kind} if kind else {})
    detail = must_be_problem(answer, status)["detail"]
    assert client.get("/status").json()["ever"]["decisions"] == before
    if "text" in name:
        assert re.search("list.? of numbers, or raw float32", detail)
    if name == "another length":  # in the words of who sends it, and of who serves it
        assert f"--fit strict does not allow; resample the trace to {SAMPLES}" in detail


def test_paths_and_methods_that_there_are_not_are_problems_too_with_every_header(
    client: Client,
) -> None:
    for method, path, status in (
        ("GET", "/nothing", 404),
        ("GET", "/decide", 405),
        ("DELETE", "/decisions", 405),
    ):
        answer = client.request(method, path)
        must_be_problem(answer, status)
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["content-security-policy"].startswith("default-src 'none'")
        assert "server" not in answer.headers
    must_be_problem(client.get("/decisions/../../etc/passwd"), 404)


def test_a_full_line_says_verify_and_when_to_come_again(stream: Dataset) -> None:
    with serving(most=1) as (service, client), busy_engine(service):
        service.submit(lambda engine: None)
        answer = client.decide(stream.X[0], "order-0")
        must_be_problem(answer, 503)
        assert int(answer.headers["retry-after"]) >= 1
        assert service.busy == 1
    assert service.read_store.decisions.counts()["decisions"] == 0
    with pytest.raises(BusyError, match="closing"):
        asyncio.run(service.decide(stream.X[0]))


def test_a_token_is_asked_for_says_who_asks_and_a_viewers_only_looks() -> None:
    viewer = Token("a-viewer-s-password", operates=False)
    with serving((Token(TOKEN, name="Kim"), viewer)) as (_, client):
        for text in ("", "Bearer other", "Basic !", f"Bearer {TOKEN}x", TOKEN):
            refused = client.get("/status", headers={"authorization": text} if text else {})
            must_be_problem(refused, 401)
            asked = refused.headers.get_list("www-authenticate")
            kinds = [item.split()[0] for item in asked]
            assert kinds == ["Basic", "Bearer"]  # a line each, or no browser asks for it
        me = client.get("/me", auth=("anybody", TOKEN)).json()
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
        named = client.get("/me", auth=("anybody", TOKEN), headers={"host": "cell.example"})
        assert named.status_code == 200  # who has the token may call it by any name
        must_be_problem(client.get(f"/RPC2/{TOKEN}"), 405)  # let in; but it takes POST alone
        must_be_problem(client.get(f"/RPC2/{TOKEN}/status"), 401)


def test_pages_of_other_sites_are_not_served(client: Client, stream: Dataset) -> None:
    here, body = str(client.base_url).rstrip("/"), {"trace": stream.X[0].tolist()}
    for name, value, status in (
        ("origin", "http://evil.example", 403),
        ("origin", "null", 403),
        ("sec-fetch-site", "cross-site", 403),
        ("origin", here, 200),
        ("sec-fetch-site", "same-origin", 200),
        ("sec-fetch-site", "none", 200),
    ):
        answer = client.post("/decide", headers={name: value}, json=body)
        assert answer.status_code == status
    for host in ("evil.example", "127.0.0.1.evil.example", "a@b", "[", "192.168.0.7"):
        must_be_problem(client.get("/healthz", headers={"host": host}), 421)
    for host in ("localhost", "Localhost:8000", "[::1]:8000", "127.0.0.1"):
        assert client.get("/healthz", headers={"host": host}).status_code == 200


def connected(client: Client) -> socket.socket:
    return socket.create_connection((client.base_url.host, client.base_url.port), timeout=60)


def test_sizes_and_connections_are_limited() -> None:
    with serving(limit_concurrency=3) as (_, client), ExitStack() as others:
        for content in (b"0" * (MAX_BODY + 1), iter([b"0" * (MAX_BODY // 2 + 1)] * 2)):
            must_be_problem(client.post("/decide", **typed(content, RAW)), 413)
        for _ in range(2):
            others.enter_context(connected(client))
        assert client.get("/healthz").status_code == 503
        others.close()
        until(lambda: client.get("/healthz").status_code == 200)


def until(true: Callable[[], bool]) -> None:
    """Wait until this is true."""
    end = time.monotonic() + WAIT
    while not true():
        assert time.monotonic() < end, "it did not come in time"
        time.sleep(0.02)


def test_a_hundred_idle_clients_keep_nobody_out(stream: Dataset) -> None:
    with serving((Token(TOKEN),)) as (_, robot), ExitStack() as others:
        robot.headers["authorization"] = f"Bearer {TOKEN}"
        for _ in range(150):
            other = others.enter_context(connected(robot))
            other.sendall(half("GET /healthz", "\r\n"))
            assert other.recv(1000).startswith(b"HTTP/1.1 200 ")
        for x in stream.X[:20]:
            assert robot.decide(x).json()["reason"] == "no_model"


def half(head: str, body: str) -> bytes:
    return f"{head} HTTP/1.1\r\nhost: localhost\r\n{body}".encode("latin-1")


CHUNKED = f"content-type: {RAW}\r\ntransfer-encoding: chunked\r\n\r\n"
NO_HTTP = {
    "no text": b"\x16\x03\x01 no HTTP\r\n\r\n",
    "no version": b"GET /healthz\r\n\r\n",
    "too long a head": half("GET /healthz", "x: " + "y" * 20_000),
    "a piece of no length": half("POST /decide", f"{CHUNKED}x\r\n"),
}


@pytest.mark.parametrize("name", NO_HTTP)
def test_what_is_no_http_is_answered_before_its_connection_is_closed(
    client: Client, name: str
) -> None:
    text = b""
    with socket.create_connection((client.base_url.host, client.base_url.port), timeout=60) as raw:
        raw.sendall(NO_HTTP[name])
        while piece := raw.recv(65536):
            text += piece
    assert text.startswith(b"HTTP/1.1 400 "), text
    assert b"connection: close" in text.lower()


@pytest.mark.merge  # it starts a process
def test_the_program_serves_until_it_is_told_to_end_and_lets_no_other_have_its_store(
    tmp_path: Path, stream: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
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
            assert client.get("/healthz").json()["status"] == "ok"
            must_be_problem(client.get("/status"), 401)
            client.headers["authorization"] = f"Bearer {TOKEN}"
            body = {"trace": stream.X[:2, :40].tolist(), "request": "order-0"}
            assert client.post("/decide", json=body).json()["action"] == "verify"
            assert client.get("/status").json()["shadow"] is True
            refused_in_a_line("cell.db", "--store", tmp_path / "cell.db", "--port", "0")
            port = process.port
            refused_in_a_line("already in use", "--store", tmp_path / "b.db", "--port", port)
            assert process.end() == 0
    lines = process.output.splitlines()
    assert [line for line in lines if not (" level=" in line and " message=" in line)] == []
    assert TOKEN not in process.output
    with DataEngine.open(tmp_path / "cell.db") as engine:
        assert engine.trace == TraceSpec(40, 100.0, 2, "Nm", fit="pad", columns=("MZ", "FZ"))
        assert engine.find("order-0").decision.action == "verify"


def refused_in_a_line(text: str, *words: object) -> None:
    root, handlers, level = logging.getLogger(), logging.getLogger().handlers[:], log.level
    try:
        done = dengine("serve", *words)
    finally:  # a server leaves its own, as the process ends with it
        root.handlers[:] = handlers
        log.setLevel(level)
    assert (done.exit_code, done.output.count("\n")) == (1, 1), (done.output, done.exc_info)
    assert text in done.output


def make_token(folder: Path, text: str = TOKEN, mode: int = 0o600) -> None:
    (folder / "token").write_text(text, encoding="ascii")
    (folder / "token").chmod(mode)


def test_a_server_that_other_machines_reach_wants_a_token_of_its_owner_alone(
    tmp_path: Path,
) -> None:
    certificate(tmp_path)
    token, locked = (
        ("--token-file", tmp_path / "token"),
        ("--cert", tmp_path / "cert.pem", "--key", tmp_path / "locked.pem"),
    )
    for words, text, mode in (
        ((), "Expected --token-file FILE", 0o600),
        (token, "chmod 600", 0o644),
        (token, "at least 16 ASCII characters", 0o600),
        (("--token-file", tmp_path / "none"), "Cannot read the token file", 0o600),
        ((*locked[:2], "--host", "localhost"), "--cert and --key together", 0o600),
        ((*locked, "--host", "localhost"), "use PEM files, and a key without a password", 0o600),
    ):
        make_token(tmp_path, "short", mode)
        refused_in_a_line(
            text, "--store", tmp_path / "cell.db", "--port", "0", "--host", "0.0.0.0", *words
        )
    assert not (tmp_path / "cell.db").exists()


@pytest.mark.merge  # each start begins with that of the process that retrains
def test_what_runs_beside_has_to_start_too_or_one_line_says_why(tmp_path: Path) -> None:
    pytest.importorskip("asyncua")
    words = ("--store", tmp_path / "cell.db", "--reducer", "pca", "--port", "0")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        refused_in_a_line(port, *words, "--opcua", port)
    refused_in_a_line("127.0.0.1", *words, "--robot", f"127.0.0.1:{port}")
