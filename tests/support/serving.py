"""Servers for tests: a service, an application at a port of its own, `dengine serve` as it is
typed, and a certificate.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.request import ProxyHandler, Request, build_opener

import pytest

from dengine import DataEngine, Recipe, TraceSpec
from dengine.errors import DataError
from dengine.serve.service import CellService
from tests.support.command_line import example_of
from tests.support.driving import RECIPE

REPO = Path(__file__).resolve().parents[2]
WAIT = 60.0  # seconds, for what takes a fraction of one: a machine may be busy


def a_service(
    file: Path | None = None,
    recipe: Recipe = RECIPE,
    deadline: float = WAIT,
    trace: TraceSpec | None = None,
    **options: Any,
) -> Any:
    """A service in memory, or in a file, as long as the context lasts."""
    return closing(
        CellService(
            lambda: DataEngine.open_or_create(file, recipe=recipe, trace=trace),
            file,
            deadline,
            **options,
        )
    )


@contextmanager
def served(app: Any, port: int = 0, **options: Any) -> Iterator[int]:
    """An application in a thread of this process, as `dengine serve` has it; gives its port.

    options : of uvicorn, in place of those of `dengine serve`.
    """
    import uvicorn

    from dengine.serve.server import UVICORN_OPTIONS, listening_socket

    own = UVICORN_OPTIONS | {"timeout_graceful_shutdown": 1}
    server = uvicorn.Server(uvicorn.Config(app, **own | options))
    with listening_socket("127.0.0.1", port) as listening:
        thread = threading.Thread(target=server.run, args=([listening],))
        thread.start()
        while thread.is_alive() and not server.started:
            thread.join(0.01)
        try:
            yield listening.getsockname()[1]
        finally:
            server.should_exit = True
            thread.join()


@dataclass
class Process:
    """A server that runs, and what it said."""

    process: subprocess.Popen[str]
    port: int
    output: str = ""

    def ask(self, path: str, body: Any = None) -> dict[str, Any]:
        """The answer to a GET, or to a POST of a body; OSError for any status but 200."""
        data = None if body is None else json.dumps(body).encode()
        heads = {"content-type": "application/json"}
        asked = Request(f"http://127.0.0.1:{self.port}{path}", data, heads)
        with build_opener(ProxyHandler({})).open(asked, timeout=WAIT) as answer:
            return json.load(answer)

    def end(self, number: int = signal.SIGTERM, group: bool = False) -> int:
        """Send a signal, to its whole group as a terminal does where asked, and return its exit
        code.
        """
        (os.killpg if group else os.kill)(self.process.pid, number)
        self.output, _ = self.process.communicate(timeout=WAIT)
        return self.process.returncode


@contextmanager
def started(folder: Path, *words: str) -> Iterator[Process]:
    """The example of `dengine serve --help` at a free port, and words, as they are typed in a
    folder; it listens.
    """
    command = [sys.executable, "-m", *example_of("serve"), "--port", "0", *words]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    environment = os.environ | {"PYTHONPATH": str(REPO)}
    process = subprocess.Popen(
        command, cwd=folder, env=environment, start_new_session=True, **pipes
    )
    try:
        lines, match = [], None
        while match is None and (line := process.stdout.readline()):
            lines, match = [*lines, line], re.search(r"is served at \S+:(\d+)", line)
        assert match is not None, "".join(lines)
        yield Process(process, int(match[1]))
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()


class PushedTraces:
    """A recorder of traces that are at hand: what a robot sends is tested where it is recorded."""

    def __init__(self) -> None:
        self.traces: list[Any] = []
        self.armed = 0

    def arm(self) -> None:
        self.traces.clear()
        self.armed += 1

    def record(self, timeout: float) -> SimpleNamespace:
        if not self.traces:
            raise DataError(f"Expected an insertion within {timeout:g} s, none came.")
        return SimpleNamespace(trace=self.traces.pop(0))


@contextmanager
def busy_engine(service: Any) -> Iterator[None]:
    """The engine's thread, busy with something else."""
    begun, free = threading.Event(), threading.Event()
    service.submit(lambda engine, late: (begun.set(), free.wait(60)))
    assert begun.wait(60)
    try:
        yield
    finally:
        free.set()


def certificate(folder: Path, *names: str) -> None:
    """Files for TLS by the name of localhost, and other names: cert.pem, key.pem, and locked.pem
    with a password.
    """
    if shutil.which("openssl") is None:
        pytest.skip("the test's certificate needs openssl")
    names = ",".join(("DNS:localhost", *names))
    for words in (
        "req -x509 -newkey rsa:2048 -nodes -days 2 -keyout key.pem -out cert.pem "
        f"-subj /CN=localhost -addext subjectAltName={names}",
        "rsa -aes256 -in key.pem -out locked.pem -passout pass:none",
    ):
        command = ["openssl", *words.split()]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
