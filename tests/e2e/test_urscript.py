"""The robot's program that asks over XML-RPC: its calls are there, and a robot of paper plays it in
Python.

URScript reads nearly as Python: the program is turned into it line by line, and run against a real
server. What only a real controller shows is listed in docs/howto/plc_and_robot.md.
"""

import re
import socket
import threading
import time
import xmlrpc.client
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("uvicorn", reason="XML-RPC needs the extra `serve`")

from dengine import Action
from dengine.serve.http import create_app
from dengine.store.views import HistoryFilter
from tests.support.serving import PushedTraces, a_service, busy_engine, served

SCRIPT = Path(__file__).parents[2] / "dengine" / "cells" / "ur" / "ur_xmlrpc_cell.script"
TEXT = SCRIPT.read_text(encoding="utf-8")
CODE = [line.partition("#")[0].rstrip() for line in TEXT.splitlines()]
SAMPLES = 60
MANUAL = """movel stopl pose_trans sleep force_mode end_force_mode get_actual_tcp_pose
zero_ftsensor set_standard_digital_out get_standard_digital_in set_flag get_flag
write_output_integer_register socket_open socket_close textmsg rpc_factory
"""  # of the script manual of e-Series, version 5


def test_every_block_has_its_end_and_every_function_is_known():
    text = "\n".join(CODE)
    ends = re.findall(r"^ *end$", text, re.M)
    assert len(ends) == len(re.findall(r"^ *(?:def|thread|if|while)\b.*:$", text, re.M))
    names = re.findall(r"(?:def|thread) (\w+)\(", text)
    called = re.findall(r"(?<![.\w])(?!(?:and|or|not|while|if|elif)\()(\w+)\(", text)
    assert {*called} - {*names} == {*MANUAL.split()}


def test_remote_calls_are_made_in_threads_alone():
    inside = ""
    for line in CODE:
        if match := re.match(r"  (def|thread) (\w+)\(", line):
            inside = match[1]
        assert "dengine." not in line or inside == "thread", line


def as_python(code: list[str]) -> str:
    """The program as Python: the outermost function is the module, and every function may set its
    globals.
    """
    names = ", ".join(sorted({*re.findall(r"global (\w+)", "\n".join(code))}))
    text = "\n".join(line[2:] for line in code if line.strip() not in ("", "end"))
    text = text[re.search("^f ", text, re.M).end() :].partition("\n")[2]  # behind the first `def `
    text = re.sub(r"\b(global|local) (\w+) =", r"\2 =", text)
    text = re.sub(r"\b(run|kill) (\w+)(\(\))?", r"\1(\2)", text).replace("p[", "[")
    return re.sub(r"^( *)(?:def|thread) (.+)", rf"\1def \2\n\1  global {names}", text, flags=re.M)


class Handle(xmlrpc.client.ServerProxy):
    """What `rpc_factory` gives."""

    def closeXMLRPCClientConnection(self):  # noqa: N802  # so it is called there
        self("close")()


@pytest.fixture
def cell(tmp_path):
    """A server at a port of its own, its service, and its recorder."""
    recorder = PushedTraces()
    with (
        a_service(tmp_path / "cell.db") as service,
        served(create_app(service, recorder=recorder)) as port,
    ):
        yield SimpleNamespace(service=service, recorder=recorder, port=port)


class EndOfShiftError(Exception):
    """The robot has no more parts."""


class Robot:
    """A robot of paper: its bin is a data set, its height check knows the labels; what it did with
    each part is noted.
    """

    def __init__(self, data, cell, patience=600.0):
        self.data, self.cell, self.patience = data, cell, patience
        self.taken, self.flags = -1, {}
        self.checked, self.said = [], []

    def play(self):
        """Run the program until the shift ends."""
        names = {
            name: getattr(self, name, lambda *args, **named: [0.0] * 6) for name in MANUAL.split()
        }
        names |= {"run": self.run, "kill": lambda thread: None, "next_part": self.next_part}
        source = as_python(CODE)
        for text, instead in (
            ("192.168.1.20:8000/RPC2/TOKEN", f"127.0.0.1:{self.cell.port}/RPC2"),
            ('HOST = "192.168.1.20"', 'HOST = "127.0.0.1"'),
            ("PORT = 8000", f"PORT = {self.cell.port}"),
            ("MAX_S = 3.0", f"MAX_S = {self.patience}"),
            ("while True:", "while next_part():"),
        ):
            assert text in source
            source = source.replace(text, instead)
        with pytest.raises(EndOfShiftError):
            exec(compile(source, str(SCRIPT), "exec"), names)

    def next_part(self):
        self.taken += 1
        if self.taken == len(self.data):
            raise EndOfShiftError
        return True

    def run(self, call):
        thread = threading.Thread(target=call, daemon=True)
        thread.start()
        return thread

    def sleep(self, seconds):
        time.sleep(min(seconds, 0.002))

    def textmsg(self, *text):
        self.said.append("".join(text))

    def write_output_integer_register(self, number, value):
        if value:
            self.cell.recorder.traces.append(self.data.X[self.taken])

    def get_standard_digital_in(self, number):
        good = bool(self.data.y[self.taken])
        if number == 2:
            self.checked.append(self.taken)
            return good
        return not good  # the line stops for a bad part that was passed on

    def set_flag(self, number, value):
        self.flags[number] = value

    def get_flag(self, number):
        return self.flags.get(number, False)

    def socket_open(self, host, port, name):
        with socket.socket() as look:
            return look.connect_ex((host, port)) == 0

    def rpc_factory(self, kind, url):
        assert kind == "xmlrpc"
        return Handle(url)


def test_a_shift_of_the_program_decides_checks_and_reports(cell, make_data):
    data = make_data(90, samples=SAMPLES, seed=3)
    robot = Robot(data, cell)
    robot.play()
    cell.service.submit(lambda engine, late: engine.flush()).result(60)
    result = cell.service.read_store.decisions.select(HistoryFilter(), 1000)
    assert len(result) == len(data)
    actions = [item.decision.action for item in result]
    assert {Action.VERIFY, Action.ACCEPT} <= set(actions)
    assert robot.checked == [i for i, action in enumerate(actions) if action is Action.VERIFY]
    for item, good in zip(result, data.y.astype(bool).tolist(), strict=True):
        if item.decision.action is Action.VERIFY:
            assert item.success is good
        elif item.decision.action is Action.ACCEPT:
            assert item.success is (None if good else False)  # a stop is told, silence is not
    assert robot.said == []


def test_what_is_not_answered_in_time_is_checked(cell, make_data):
    robot = Robot(make_data(2, samples=SAMPLES, seed=3), cell, patience=0.3)
    with busy_engine(cell.service):
        robot.play()
    assert robot.checked == [0, 1]
    said = "\n".join(robot.said)
    assert (said.count("no response"), said.count("a label was not stored")) == (2, 2)


def test_a_part_that_was_left_in_the_fixture_is_checked_first(cell, make_data):
    robot = Robot(make_data(1, samples=SAMPLES, seed=3), cell)
    robot.flags[7] = True
    robot.play()
    assert robot.checked == [-1, 0]
    assert not any(robot.flags.values())
