"""`dengine serve` as a process of its own: how it ends, and a robot whose force it records."""

import http.client
import re
import signal
import socket
import threading
import time
import xmlrpc.client
from collections.abc import Callable
from contextlib import closing
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("uvicorn", reason='the server is not installed: pip install "dengine[serve]"')

from dengine import Action, DataEngine, Recipe
from dengine.serve.auth import Token
from dengine.serve.http import create_app
from dengine.serve.service import CellService
from tests.support.exports import trained
from tests.support.robots import FakeController, Signals
from tests.support.serving import REPO, WAIT, served, started

SAMPLES = 80
NAMES = "action", "reason", "lower"


@pytest.fixture(scope="module")
def parts(make_data):
    return make_data(200, samples=SAMPLES)


def until(true: Callable[[], Any], wait: float = WAIT) -> Any:
    """What this returns, once it is anything."""
    end = time.monotonic() + wait
    while not (result := true()):
        assert time.monotonic() < end, "it did not come in time"
        time.sleep(0.02)
    return result


def children(pid: int) -> list[int]:
    """Processes below this one."""
    below = [*map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split())]
    return [*below, *(deeper for child in below for deeper in children(child))]


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


class Robots:
    """Several that ask and report until the server is gone; what they were answered, and which
    labels were acknowledged.
    """

    def __init__(self, process, parts, n=3):
        self.ask, self.parts = process.ask, parts
        self.answers, self.labels = {}, {}
        self.threads = [threading.Thread(target=self.work, args=(item,)) for item in range(n)]
        for item in self.threads:
            item.start()
        until(lambda: process.ask("/status")["retraining"])

    def work(self, robot):
        for cycle in count():
            i = cycle % len(self.parts)
            id_, good = f"{robot}-{cycle}", bool(self.parts.y[i])
            try:
                asked = {"trace": self.parts.X[i].tolist(), "request": id_}
                self.answers[id_] = self.ask("/decide", asked)
                if self.answers[id_]["action"] != "reject":
                    self.ask("/report", {"id": id_, "success": good})
                    self.labels[id_] = good
            except (OSError, http.client.HTTPException):  # it ends
                return

    def join(self):
        for item in self.threads:
            item.join(WAIT)


def write_recipe(folder: Path, **settings: Any) -> None:
    recipe = Recipe("conv", retrain_every=20, **settings)
    (folder / "recipe.toml").write_text(recipe.to_toml(), encoding="utf-8")


# The end by Ctrl-C is the same once more, sent to the whole group.
@pytest.mark.parametrize("name", [pytest.param("SIGINT", marks=pytest.mark.slow), "SIGTERM"])
def test_it_records_a_robot_and_a_signal_ends_it_in_the_midst_of_work_and_nothing_is_lost(
    tmp_path, parts, name
):
    write_recipe(tmp_path, radius=0.05, budget=1.5)  # so many seconds that a retrain is met
    rest, x = np.zeros(SAMPLES), parts.X[0]
    phase = np.concatenate([rest, np.ones(SAMPLES)])
    force = Signals(FZ_Base=np.concatenate([rest, x]), output_int_register_25=phase)
    words = f"--recipe recipe.toml --samples {SAMPLES} --robot 127.0.0.1:"
    with (
        FakeController(force) as fake,
        started(tmp_path, *f"{words}{fake.port}".split()) as process,
    ):
        robot = xmlrpc.client.ServerProxy(f"http://127.0.0.1:{process.port}/RPC2")
        # On a busy machine it may be late.
        recorded = until(lambda: robot.decide_recorded(robot.begin())["id"])
        assert robot.report(recorded, True) is True
        robots = Robots(process, parts)
        below = until(lambda: children(process.process.pid))
        code = process.end(getattr(signal, name), group=name == "SIGINT")
        robots.join()
    assert code == 0
    assert "Traceback" not in process.output
    lines = process.output.splitlines()
    assert all(" level=" in line and " message=" in line for line in lines), lines
    assert any(f"{name}: ending" in line for line in lines)
    until(lambda: not any(map(is_alive, below)))
    assert len(robots.labels) >= 20
    with DataEngine.open(tmp_path / "cell.db") as engine:
        assert engine.find(recorded).success is True
        assert engine.find(recorded).trace.ravel().tolist() == x.tolist()
        assert {id_: engine.find(id_).success for id_ in robots.labels} == robots.labels
        for id_, answer in robots.answers.items():
            decision = engine.find(id_).decision
            assert [getattr(decision, name) for name in NAMES] == [answer[name] for name in NAMES]


def test_a_server_that_is_killed_in_a_retrain_leaves_no_process_behind(tmp_path, parts):
    write_recipe(tmp_path, budget=300.0, max_steps=10**6)
    with started(tmp_path, "--recipe", "recipe.toml") as process:
        robots = Robots(process, parts, 1)
        below = until(lambda: children(process.process.pid))
        process.process.kill()
        until(lambda: not any(map(is_alive, below)), WAIT / 4)
    robots.join()


def test_a_controllers_socket_and_a_ros_node_are_answered_as_the_page_says(tmp_path, make_data):
    page = (REPO / "docs/howto/plc_and_robot.md").read_text("utf-8")
    (head,) = re.findall(r"```text\n(POST /decide.+?\n\n)```", page, flags=re.DOTALL)
    (node,) = re.findall(r"```python\n(from http.+?)```", page, flags=re.DOTALL)
    file, token, data = tmp_path / "cell.db", "t" * 24, make_data(200, samples=1000)
    with trained(data, file) as engine:
        x = next(x for x in data.X if engine.decide(x).action is Action.ACCEPT).astype("<f4")
    head = head.replace("TOKEN", token).replace("\n", "\r\n").encode()
    scope: dict[str, Any] = {}
    exec(node, scope)
    with (
        closing(CellService(lambda: DataEngine.open(file), file, WAIT)) as service,
        served(create_app(service, (Token(token),))) as port,
        socket.create_connection(("127.0.0.1", port), WAIT) as robot,
    ):
        for piece in (head, x[:250].tobytes(), x[250:].tobytes()):
            robot.sendall(piece)
        answer = b""
        while not re.search(rb'"action":"accept"', answer):
            answer += robot.recv(100)
        url = f"http://127.0.0.1:{port}"
        asked = (url, token), (url, "another"), ("http://127.0.0.1:1", token)
        decided = [scope["decide"](x, "P-1", *item) for item in asked]
        assert decided == ["accept", "verify", "verify"]
