"""XML-RPC over a real server: what a robot's program calls, and what it is told when something is
wrong.
"""

import asyncio
import http.client
import xmlrpc.client
from contextlib import closing, suppress
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("uvicorn", reason="XML-RPC needs the extra `serve`")

from dengine.errors import BusyError
from dengine.serve import xmlrpc as xml_rpc
from dengine.serve.http import create_app
from dengine.serve.robot_calls import CALLS, MAX_SAMPLES
from tests.support.serving import PushedTraces, a_service, busy_engine, served
from tests.support.tables import rows

VERIFY, ACCEPT = 0, 1


@pytest.fixture(scope="module")
def cell(tmp_path_factory, stream):
    """A service, its recorder, its port, and a robot that calls it."""
    recorder = PushedTraces()
    with (
        a_service(tmp_path_factory.mktemp("cell") / "cell.db") as service,
        served(create_app(service, recorder=recorder)) as port,
    ):
        robot = xmlrpc.client.ServerProxy(f"http://127.0.0.1:{port}/RPC2")
        for x, good in zip(stream.X[:50].tolist(), stream.y, strict=False):  # retrains after 40
            answer = robot.decide(x)
            if answer["action"] == VERIFY:
                assert robot.report(answer["id"], bool(good))
        yield SimpleNamespace(service=service, recorder=recorder, port=port, robot=robot)


def find(cell: SimpleNamespace, id_: str):
    return asyncio.run(cell.service.find(id_))


def post(cell: SimpleNamespace, body: bytes, content: str = "text/xml") -> tuple[int, bytes]:
    with closing(http.client.HTTPConnection("127.0.0.1", cell.port, timeout=60)) as connection:
        connection.request("POST", "/RPC2", body, {"Content-Type": content})
        answer = connection.getresponse()
        return answer.status, answer.read()


def fault_of(cell: SimpleNamespace, body: bytes) -> xmlrpc.client.Fault:
    with pytest.raises(xmlrpc.client.Fault) as caught:
        xmlrpc.client.loads(post(cell, body)[1])
    assert "\n" not in caught.value.faultString
    assert "Traceback" not in caught.value.faultString
    return caught.value


def test_a_cell_over_xml_rpc_learns_and_accepts(cell, stream):
    actions = []
    for i, x in enumerate(stream.X[50:90]):
        answer = cell.robot.decide(x.tolist(), f"order-{i}", f"P{i}")
        types = type(answer["action"]), type(answer["lower"])
        assert (answer["id"], *types) == (f"order-{i}", int, float)
        actions.append(answer["action"])
        match = find(cell, f"order-{i}")
        assert match.decision.part == f"P{i}"
        assert np.array_equal(match.trace[0], x)
    assert ACCEPT in actions


def test_a_trace_in_pieces_is_the_same_trace(cell, stream):
    robot, x = cell.robot, stream.X[1]
    id_ = robot.begin()
    pieces = x[:25].tolist(), x[25:50].astype("<f4").tobytes(), x[50:].tolist()
    assert [robot.add(id_, piece) for piece in pieces] == [25, 50, 60]
    answer = robot.decide_added(id_, 7)
    assert answer["id"] == id_
    assert (robot.decide_added(id_, 7), robot.action_added(id_)) == (answer, answer["action"])
    match = find(cell, id_)
    assert match.decision.part == "7"
    assert np.array_equal(match.trace[0], x)


def test_pieces_of_no_part_that_was_begun_or_too_many_are_refused(cell):
    robot = cell.robot
    forgotten, *_, id_ = [robot.begin() for _ in range(9)]  # more than are kept
    assert [robot.add(id_, [0.0] * 2500) for _ in range(80)][-1] == MAX_SAMPLES
    with pytest.raises(xmlrpc.client.Fault, match=f"at most {MAX_SAMPLES} samples"):
        robot.add(id_, [0.0])
    with pytest.raises(xmlrpc.client.Fault, match="Expected begin before add"):
        robot.add(forgotten, [1.0])
    with pytest.raises(xmlrpc.client.Fault, match="Expected begin and add"):
        robot.decide_added(forgotten)


def test_what_a_recorder_cut_is_decided_on(cell, stream):
    robot = cell.robot
    id_ = robot.begin()
    assert cell.recorder.armed > 0
    cell.recorder.traces.append(stream.X[2])
    answer = robot.decide_recorded(id_)
    assert answer["id"] == id_
    assert (robot.decide_recorded(id_), robot.action_recorded(id_)) == (answer, answer["action"])
    assert np.array_equal(find(cell, id_).trace[0], stream.X[2])
    robot.begin("named")
    cell.recorder.traces.append(stream.X[3])
    assert robot.decide_recorded()["id"] == "named"


def test_what_was_not_recorded_is_verified_and_no_fault(cell, stream):
    robot = cell.robot
    id_, other = robot.begin(), robot.begin()
    # Another part was recorded; one was never begun; nothing came.
    for asked, traces in ((id_, [stream.X[4]]), ("never", []), (other, [])):
        cell.recorder.traces[:] = traces
        answer = robot.decide_recorded(asked)
        assert (answer["action"], answer["id"], answer["reason"]) == (VERIFY, "", "not_recorded")
    assert robot.report(id_, True) is False  # nothing is known of it, and the robot goes on


def test_a_busy_server_answers_verify_and_keeps_no_report(cell, stream):
    robot, waiting = cell.robot, []
    recorded = robot.begin()
    cell.recorder.traces.append(stream.X[5])
    with busy_engine(cell.service):
        with suppress(BusyError):
            while True:
                waiting.append(cell.service.submit(lambda engine, late: None))
        answer = robot.decide(stream.X[0].tolist(), "too much")
        assert (answer["action"], answer["id"], answer["reason"]) == (VERIFY, "", "busy")
        assert robot.decide_recorded(recorded) == answer
        assert cell.recorder.traces == []  # the part is verified by hand
        assert robot.report("order-1", True) is False
    waiting[-1].result(60)
    assert find(cell, "too much") is None


def test_reports_are_a_bool_and_one_a_decision(cell, stream):
    robot = cell.robot
    assert robot.decide((stream.X[0] * -3.0).tolist(), "far")["action"] == VERIFY
    assert robot.report("far", 1) is True
    assert robot.report("far", True) is True
    for label in (False, "OK", -1):
        with pytest.raises(xmlrpc.client.Fault, match=r"Expected|already"):
            robot.report("far", label)


CALL = "<methodCall><methodName>decide</methodName><params><param>%s</param></params></methodCall>"
NO_CALLS = """
-
<methodResponse><params></params></methodResponse>
<!DOCTYPE b [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]>CALL<value>&b;</value>
<!DOCTYPE a SYSTEM "file:///etc/passwd">CALL<value>1</value>
<?xml version="1.0" encoding="no-such"?>CALL<value>1</value>
<?xml version="1.0" encoding="utf-8"?>CALL<value><string>\xff</string></value>
CALL<value><int>NINES</int></value>
CALL</array>
"""
NO_TRACES = """
<struct><member><name>a</name><value>1</value></member></struct>
<dateTime.iso8601>20260101T00:00:00</dateTime.iso8601>
<array><data><value><bigdecimal>1.5</bigdecimal></value></data></array>
<nil/>
<array><data></data></array>
<array><data><value><double>1</double></value><value><string>2</string></value></data></array>
<array><data><value><boolean>1</boolean></value><value><double>1</double></value></data></array>
<array><data><value><double>1</double></value></data></array>
<string>1,2,3</string>
<int>5</int>
DEEP
"""
DEEP = "<array><data><value>" * 3000 + "</value></data></array>" * 3000


def test_what_is_no_call_no_trace_or_no_method_is_a_fault_of_one_line(cell):
    for (line,) in rows(NO_CALLS, 1):
        prolog, _, value = line.replace("NINES", "9" * 5000).partition("CALL")
        body = prolog + CALL % value if value else prolog
        assert fault_of(cell, body.encode("latin-1")).faultCode == xml_rpc.NOT_XML, line
    for (value,) in rows(NO_TRACES, 1):
        body = CALL % f"<value>{value.replace('DEEP', DEEP)}</value>"
        assert fault_of(cell, body.encode()).faultCode == xml_rpc.REFUSED, value
    for code, *names in (
        (xml_rpc.NO_METHOD, "system.listMethods", "__init__"),
        (xml_rpc.WRONG_ARGUMENTS, "decide", "report"),
    ):
        for name in names:
            assert fault_of(cell, xmlrpc.client.dumps((), name).encode()).faultCode == code


def test_what_fails_in_the_server_is_a_fault_that_says_nothing_of_it(cell, monkeypatch, caplog):
    def broken(*args):
        raise KeyError("secret")

    monkeypatch.setattr(cell.service, "decide", broken)
    fault = fault_of(cell, xmlrpc.client.dumps(([1.0] * 60,), "decide").encode())
    assert fault.faultCode == xml_rpc.INTERNAL_ERROR
    assert "secret" not in fault.faultString
    assert "a call failed" in caplog.text


def test_another_media_type_is_refused_and_the_page_names_every_call(cell, repo):
    body = xmlrpc.client.dumps((), "status").encode()
    assert post(cell, body, "application/json")[0] == 415
    assert post(cell, body, "text/xml; charset=utf-8")[0] == 200
    page = (repo / "docs" / "howto" / "plc_and_robot.md").read_text(encoding="utf-8")
    for name in CALLS:
        assert f"`{name}" in page
