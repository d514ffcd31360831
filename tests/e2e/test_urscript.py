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
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("uvicorn", reason="XML-RPC needs the extra `serve`")

from dengine import Action, Dataset
from dengine.serve.http import create_app
from dengine.store.views import HistoryFilter
from tests.support.serving import PushedTraces, a_service, busy_engine, served

SCRIPT = Path(__file__).parents[2] / "dengine" / "cells" / "ur" / "ur_xmlrpc_cell.script"
TEXT = SCRIPT.read_text(encoding="utf-8")
CODE = [line.partition("#")[0].rstrip() for line in TEXT.splitlines()]
SAMPLES = 60
BLOCK = re.compile(r"^\s*(def|thread|if|while)\b.*:$")
MANUAL = {  # of the script manual of e-Series, version 5
    *(
        "movel",
        "stopl",
        "pose_trans",
        "sleep",
        "force_mode",
        "end_force_mode",
        "get_actual_tcp_pose",
        "zero_ftsensor",
    ),
    *(
        "set_standard_digital_out",
        "get_standard_digital_in",
        "set_flag",
        "get_flag",
        "write_output_integer_register",
    ),
    *("socket_open", "socket_close", "textmsg", "rpc_factory"),
}


def test_every_block_has_its_end_and_every_function_is_known() -> None:
    assert sum(bool(BLOCK.match(line)) for line in CODE) == sum(
        line.strip() == "end" for line in CODE
    )
    names = set(re.findall(r"(?:def|thread) (\w+)\(", "\n".join(CODE)))
    called = set(re.findall(r"(?<![.\w])(\w+)\(", "\n".join(CODE))) - {
        "and",
        "or",
        "not",
        "while",
        "if",
        "elif",
    }
    assert called - names == MANUAL


def test_remote_calls_are_made_in_threads_alone() -> None:
    inside = ""
    for line in CODE:
        if match := re.match(r"  (def|thread) (\w+)\(", line):
            inside = match[1]
        assert "dengine." not in line or inside == "thread", line


def as_python(code: list[str]) -> str:
    """The program as Python: the outermost function is the module, and every function may set its
    globals.
    """
    names = sorted({*re.findall(r"global (\w+)", "\n".join(code))})
    lines = []
    for line in code[next(i for i, line in enumerate(code) if line.startswith("def ")) + 1 :]:
        line = re.sub(r"\b(global|local) (\w+) =", r"\2 =", line[2:])
        line = re.sub(r"^(\s*)thread ", r"\1def ", line)
        line = re.sub(
            r"\brun (\w+)\(\)", r"run(\1)", re.sub(r"\bkill (\w+)", r"kill(\1)", line)
        ).replace("p[", "[")
        if line.strip() == "end" or not line.strip():
            continue
        lines.append(line)
        if match := re.match(r"^(\s*)def ", line):
            lines.append(f"{match[1]}  global {', '.join(names)}")
    return "\n".join(lines)


class Handle(xmlrpc.client.ServerProxy):
    """What `rpc_factory` gives."""

    def closeXMLRPCClientConnection(self) -> None:  # noqa: N802  # so it is called there
        self("close")()


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[SimpleNamespace]:
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

    def __init__(
        self, data: Dataset, parts: int, cell: SimpleNamespace, patience: float = 600.0
    ) -> None:
        self.data, self.parts, self.port, self.recorder, self.patience = (
            data,
            parts,
            cell.port,
            cell.recorder,
            patience,
        )
        self.taken, self.outputs, self.flags = -1, dict[int, bool](), dict[int, bool]()
        self.checked: list[int] = []
        self.said: list[str] = []

    def play(self) -> None:
        """Run the program until the shift ends."""
        names: dict[str, Any] = {
            name: getattr(self, name, lambda *args, **named: [0.0] * 6) for name in MANUAL
        }
        names |= {
            "run": self.run,
            "kill": lambda thread: None,
            "textmsg": lambda *text: self.said.append("".join(text)),
        }
        source = as_python(CODE).replace(
            "192.168.1.20:8000/RPC2/TOKEN", f"127.0.0.1:{self.port}/RPC2"
        )
        source = source.replace('HOST = "192.168.1.20"', 'HOST = "127.0.0.1"').replace(
            "PORT = 8000", f"PORT = {self.port}"
        )
        source = source.replace("MAX_S = 3.0", f"MAX_S = {self.patience}").replace(
            "while True:", "while next_part():"
        )
        with pytest.raises(EndOfShiftError):
            exec(compile(source, str(SCRIPT), "exec"), names | {"next_part": self.next_part})

    def next_part(self) -> bool:
        if self.taken + 1 == self.parts:
            raise EndOfShiftError
        self.taken += 1
        return True

    def run(self, call: Callable[[], object]) -> threading.Thread:
        thread = threading.Thread(target=call, daemon=True)
        thread.start()
        return thread

    def sleep(self, seconds: float) -> None:
        time.sleep(min(seconds, 0.002))

    def write_output_integer_register(self, number: int, value: int) -> None:
        if value:
            self.recorder.traces.append(self.data.X[self.taken])

    def get_standard_digital_in(self, number: int) -> bool:
        good = bool(self.data.y[self.taken])
        if number == 2:
            self.checked.append(self.taken)
            return good
        return not good  # the line stops for a bad part that was passed on

    def set_flag(self, number: int, value: bool) -> None:
        self.flags[number] = value

    def get_flag(self, number: int) -> bool:
        return self.flags.get(number, False)

    def socket_open(self, host: str, port: int, name: str) -> bool:
        with socket.socket() as look:
            return look.connect_ex((host, port)) == 0

    def rpc_factory(self, kind: str, url: str) -> Handle:
        assert kind == "xmlrpc"
        return Handle(url)


def test_a_shift_of_the_program_decides_checks_and_reports(
    cell: SimpleNamespace, make_data
) -> None:
    data = make_data(90, samples=SAMPLES, seed=3)
    robot = Robot(data, len(data), cell)
    robot.play()
    asked = cell.service.submit(
        lambda engine: (engine.flush(), engine.store.decisions.select(HistoryFilter(), 1000))[1]
    )
    result = asked.result(60)
    assert len(result) == len(data)
    actions = [item.decision.action for item in result]
    assert {Action.VERIFY, Action.ACCEPT} <= set(actions)
    assert robot.checked == [i for i, action in enumerate(actions) if action is Action.VERIFY]
    for i, item in enumerate(result):
        if item.decision.action is Action.VERIFY:
            assert item.success is bool(data.y[i])
        elif item.decision.action is Action.ACCEPT:
            assert item.success is (None if data.y[i] else False)  # a stop is told, silence is not
    assert robot.said == []


def test_what_is_not_answered_in_time_is_checked(cell: SimpleNamespace, make_data) -> None:
    robot = Robot(make_data(2, samples=SAMPLES, seed=3), 2, cell, patience=0.3)
    with busy_engine(cell.service):
        robot.play()
    assert robot.checked == [0, 1]
    assert sum("no response" in text for text in robot.said) == 2
    assert sum("a label was not stored" in text for text in robot.said) == 2


def test_a_part_that_was_left_in_the_fixture_is_checked_first(
    cell: SimpleNamespace, make_data
) -> None:
    robot = Robot(make_data(2, samples=SAMPLES, seed=3), 1, cell)
    robot.flags[7] = True
    robot.play()
    assert robot.checked == [-1, 0]
    assert not any(robot.flags.values())
