"""XML-RPC over a real server: what a robot's program calls, and what it is told when something is
wrong.
"""

import asyncio
import http.client
import xmlrpc.client
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("uvicorn", reason="XML-RPC needs the extra `serve`")

from dengine import Dataset
from dengine.errors import BusyError
from dengine.serve import xmlrpc as xml_rpc
from dengine.serve.auth import MAX_BODY
from dengine.serve.http import create_app
from dengine.serve.robot_calls import MAX_SAMPLES, RobotCalls
from dengine.serve.service import CellService
from tests.support.serving import PushedTraces, a_service, busy_engine, served

VERIFY, ACCEPT = 0, 1


class Cell:
    """What is behind a server, and how it is asked."""

    def __init__(self, service: CellService, recorder: PushedTraces, port: int) -> None:
        self.service, self.recorder, self.port = service, recorder, port

    def robot(self) -> xmlrpc.client.ServerProxy:
        return xmlrpc.client.ServerProxy(f"http://127.0.0.1:{self.port}/RPC2")

    def post(
        self, body: bytes, content: str = "text/xml", method: str = "POST", **headers: str
    ) -> tuple[int, bytes]:
        with closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)) as connection:
            connection.request(method, "/RPC2", body, {"Content-Type": content, **headers})
            answer = connection.getresponse()
            return answer.status, answer.read()

    def find(self, id_: str) -> Any:
        return asyncio.run(self.service.find(id_))


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory, stream: Dataset) -> Iterator[Cell]:
    recorder = PushedTraces()
    with a_service(tmp_path_factory.mktemp("cell") / "cell.db") as service:
        app = create_app(service, recorder=recorder)
        with served(app) as port:
            created = Cell(service, recorder, port)
            robot = created.robot()
            for i in range(50):  # it retrains after 40
                answer = robot.decide(stream.X[i].tolist())
                if answer["action"] == VERIFY:
                    assert robot.report(answer["id"], bool(stream.y[i]))
            yield created


def fault_of(answer: tuple[int, bytes]) -> xmlrpc.client.Fault:
    assert answer[0] == 200
    with pytest.raises(xmlrpc.client.Fault) as caught:
        xmlrpc.client.loads(answer[1])
    assert "\n" not in caught.value.faultString
    assert "Traceback" not in caught.value.faultString
    return caught.value


def call(name: str, *arguments: object) -> bytes:
    return xmlrpc.client.dumps(arguments, name, allow_none=True).encode()


def test_a_cell_over_xml_rpc_learns_and_accepts(cell: Cell, stream: Dataset) -> None:
    robot, traces = cell.robot(), stream.X[50:90]
    answers = [robot.decide(x.tolist(), f"order-{i}", f"P{i}") for i, x in enumerate(traces)]
    assert robot.decide(traces[0].tolist(), "order-0", "P0") == answers[0]  # asked again
    with pytest.raises(xmlrpc.client.Fault, match="got another"):
        robot.decide(stream.X[1].tolist(), "order-0", "P0")
    assert cell.service.engine.version >= 1
    assert ACCEPT in {answer["action"] for answer in answers}
    for i, answer in enumerate(answers):
        types = type(answer["action"]), type(answer["lower"])
        assert (answer["id"], *types) == (f"order-{i}", int, float)
        match = cell.find(f"order-{i}")
        assert match.decision.part == f"P{i}"
        assert np.array_equal(match.trace[0], traces[i])


def test_a_trace_in_pieces_is_the_same_trace(cell: Cell, stream: Dataset) -> None:
    robot, x = cell.robot(), stream.X[1]
    id_ = robot.begin()
    pieces = x[:25].tolist(), x[25:50].astype("<f4").tobytes(), x[50:].tolist()
    assert [robot.add(id_, piece) for piece in pieces] == [25, 50, 60]
    assert robot.decide(x.astype("<f4").tobytes(), "whole", "P8")["id"] == "whole"
    answer = robot.decide_added(id_, 7)
    assert answer["id"] == id_
    assert (robot.decide_added(id_, 7), robot.action_added(id_)) == (answer, answer["action"])
    assert cell.find(id_).decision.part == "7"
    for decided in (id_, "whole"):
        assert np.array_equal(cell.find(decided).trace[0], x)
    ids = [robot.begin() for _ in range(9)]  # more than are kept
    assert [robot.add(ids[-1], [0.0] * 2500) for _ in range(80)][-1] == MAX_SAMPLES
    for wrong, call, arguments in (
        ("Expected begin and add", robot.decide_added, ("unheard of",)),
        ("Expected begin before add", robot.add, ("unheard of", [1.0])),
        ("Expected begin before add", robot.add, (ids[0], [1.0])),
        (f"at most {MAX_SAMPLES} samples", robot.add, (ids[-1], [0.0])),
    ):
        with pytest.raises(xmlrpc.client.Fault, match=wrong):
            call(*arguments)


def test_what_a_recorder_cut_is_decided_on(cell: Cell, stream: Dataset) -> None:
    robot = cell.robot()
    id_ = robot.begin()
    assert cell.recorder.armed > 0
    cell.recorder.traces.append(stream.X[2])
    answer = robot.decide_recorded(id_)
    assert (answer["id"], robot.decide_recorded(id_), robot.action_recorded(id_)) == (
        id_,
        answer,
        answer["action"],
    )
    assert np.array_equal(cell.find(id_).trace[0], stream.X[2])
    robot.begin("named")
    cell.recorder.traces.append(stream.X[3])
    assert robot.decide_recorded()["id"] == "named"


@pytest.mark.parametrize("wrong", ["nothing came", "another part", "never begun"])
def test_what_was_not_recorded_is_verified_and_no_fault(
    cell: Cell, stream: Dataset, wrong: str
) -> None:
    robot = cell.robot()
    id_ = robot.begin()
    if wrong == "another part":
        robot.begin()
        cell.recorder.traces.append(stream.X[4])
    answer = robot.decide_recorded("never" if wrong == "never begun" else id_)
    cell.recorder.traces.clear()
    assert (answer["action"], answer["id"], answer["reason"]) == (VERIFY, "", "not_recorded")
    assert robot.report(id_, True) is False  # nothing is known of it, and the robot goes on


def test_a_busy_server_answers_verify_and_keeps_no_report(cell: Cell, stream: Dataset) -> None:
    robot, waiting = cell.robot(), []
    recorded = robot.begin()
    cell.recorder.traces.append(stream.X[5])
    with busy_engine(cell.service):
        with suppress(BusyError):
            while True:
                waiting.append(cell.service.submit(lambda engine: None))
        answer = robot.decide(stream.X[0].tolist(), "too much")
        assert (answer["action"], answer["id"], answer["reason"]) == (VERIFY, "", "busy")
        assert robot.decide_recorded(recorded) == answer
        assert cell.recorder.traces == []  # the part is verified by hand
        assert robot.report("order-1", True) is False
    waiting[-1].result(60)
    assert cell.find("too much") is None
    assert robot.decide_recorded(recorded)["reason"] == "not_recorded"


def test_reports_are_a_bool_and_one_a_decision(cell: Cell, stream: Dataset) -> None:
    robot = cell.robot()
    far = (stream.X[0] * -3.0).tolist()
    assert robot.decide(far, "far")["action"] == VERIFY
    assert robot.report("far", 1) is True
    assert robot.report("far", True) is True
    for text in (False, "OK", -1):
        with pytest.raises(xmlrpc.client.Fault, match=r"Expected|already"):
            robot.report("far", text)
    assert robot.report("unheard of", True) is False


BOMB = b'<?xml version="1.0"?><!DOCTYPE b [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]>'
INSIDE = b"<methodCall><methodName>status</methodName><params>%s</params></methodCall>"
PARAM = b"<param><value>%s</value></param>"
DEEP = b"<param>%s</param>" % (b"<value><array><data>" * 3000 + b"</data></array></value>" * 3000)
NO_CALLS = [
    b"",
    b"<methodResponse><params></params></methodResponse>",
    BOMB + INSIDE % (PARAM % b"&b;"),
    b'<?xml version="1.0"?><!DOCTYPE a SYSTEM "file:///etc/passwd">' + INSIDE % b"",
    b'<?xml version="1.0" encoding="no-such"?>' + INSIDE % b"",
    b'<?xml version="1.0" encoding="utf-8"?>' + INSIDE % (PARAM % b"<string>\xff</string>"),
    INSIDE % (PARAM % (b"<int>" + b"9" * 5000 + b"</int>")),
    INSIDE % b"</array>",
]
NO_LISTS = [
    b"<struct><member><name>a</name><value>1</value></member></struct>",
    b"<dateTime.iso8601>20260101T00:00:00</dateTime.iso8601>",
    b"<array><data><value><bigdecimal>1.5</bigdecimal></value></data></array>",
    b"<nil/>",
]
NO_TRACES = [[], [1.0, "2"], [True, 1.0], [[1.0], [1.0, 2.0]], [[[1.0]]], "1,2,3", 5, [1.0] * 10]
FAULTS = [
    *((body, xml_rpc.NOT_XML) for body in NO_CALLS),
    *((call("decide", trace), xml_rpc.REFUSED) for trace in NO_TRACES),
    (INSIDE.replace(b"status", b"decide") % DEEP, xml_rpc.REFUSED),
    *((INSIDE.replace(b"status", b"decide") % (PARAM % x), xml_rpc.REFUSED) for x in NO_LISTS),
    (call("system.listMethods"), xml_rpc.NO_METHOD),
    (call("__init__"), xml_rpc.NO_METHOD),
    (call("decide"), xml_rpc.WRONG_ARGUMENTS),
    (call("report", "a", True, 1), xml_rpc.WRONG_ARGUMENTS),
    (call("decide", [1.0], "a\nb"), xml_rpc.NO_REPORT),
]


@pytest.mark.parametrize(("body", "code"), FAULTS, ids=range(len(FAULTS)))
def test_what_cannot_be_done_is_a_fault_of_one_line(cell: Cell, body: bytes, code: int) -> None:
    assert fault_of(cell.post(body)).faultCode == code


def test_what_is_no_xml_rpc_at_all_is_refused_before_it_is_read(cell: Cell) -> None:
    body = call("status")
    assert cell.post(body, "application/json")[0] == 415
    assert cell.post(body, method="GET")[0] == 405
    # Announced, and not sent: the server closes while a client still sends.
    assert cell.post(b"", **{"Content-Length": str(MAX_BODY + 1)})[0] == 413
    assert cell.post(body, "text/xml; charset=utf-8")[0] == 200


def test_what_fails_in_the_server_is_a_fault_that_says_nothing_of_it(
    cell: Cell, monkeypatch, caplog
) -> None:
    def broken(*args: object) -> None:
        raise KeyError("secret")

    monkeypatch.setattr(cell.service, "decide", broken)
    fault = fault_of(cell.post(call("decide", [1.0] * 60)))
    assert fault.faultCode == xml_rpc.INTERNAL_ERROR
    assert "secret" not in fault.faultString
    assert "a call failed" in caplog.text


def test_the_page_names_every_call(cell: Cell) -> None:
    page = (Path(__file__).parents[2] / "docs" / "howto" / "plc_and_robot.md").read_text(
        encoding="utf-8"
    )
    for name in RobotCalls(cell.service).table():
        assert f"`{name}" in page
