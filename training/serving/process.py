"""A `dengine serve` process, and a connection that asks it."""

from __future__ import annotations

import http.client
import json
import os
import select
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

RAW, JSON = "application/octet-stream", "application/json"
STARTS = 120.0  # seconds


class Server:
    """One `dengine serve` process at a time, at one port."""

    def __init__(self, folder: Path, *words: str) -> None:
        self.folder, self.words, self.port = folder, words, 0
        self.process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Start it, and return once it listens; the first time at any port, then at that one."""
        command = [sys.executable, "-m", "dengine", "serve", "--store", "cell.db", "--port", str(self.port), "--rate", "0"]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [str(Path.cwd()), *sys.path]))}
        with (self.folder / "server.log").open("a", encoding="utf-8") as log:
            pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": log, "text": True}
            self.process = subprocess.Popen([*command, *self.words], cwd=self.folder, env=environment, **pipes)
        assert self.process.stdout is not None
        ready, _, _ = select.select([self.process.stdout], [], [], STARTS)
        line = self.process.stdout.readline() if ready else ""
        if " served at " not in line:
            raise RuntimeError(f"The server did not start: {(self.folder / 'server.log').read_text()[-2000:]}")
        self.port = int(line.partition("127.0.0.1:")[2].partition(",")[0])

    def kill(self) -> None:
        """SIGKILL."""
        assert self.process is not None
        self.process.kill()
        self.process.communicate()

    def end(self) -> int:
        """SIGTERM; returns its exit code."""
        assert self.process is not None
        self.process.terminate()
        self.process.communicate()
        return self.process.returncode


class Connection:
    """A connection that is kept, and made anew where it breaks."""

    def __init__(self, port: int, patience: float = 0.0) -> None:
        self.port, self.patience = port, patience
        self._http = self._made()

    def decide(self, trace: np.ndarray, request: str | None = None, form: str = RAW) -> dict[str, Any]:
        """Ask for a decision on a trace (T,)."""
        if form == JSON:
            return self._post("/decide", json.dumps({"trace": trace.tolist(), "request": request}), JSON)
        return self._post(f"/decide?request={request}" if request else "/decide", trace.astype("<f4").tobytes(), RAW)

    def report(self, decision_id: str, success: bool) -> dict[str, Any]:
        """Report a label."""
        return self._post("/report", json.dumps({"id": decision_id, "success": success}), JSON)

    def get(self, path: str) -> dict[str, Any]:
        """Look at something."""
        return self._asked("GET", path, None, {})

    def _post(self, path: str, body: bytes | str, kind: str) -> dict[str, Any]:
        return self._asked("POST", path, body, {"content-type": kind})

    def _asked(self, method: str, path: str, body: Any, headers: dict[str, str]) -> dict[str, Any]:
        until = time.monotonic() + self.patience
        while True:
            try:
                self._http.request(method, path, body, headers)
                answer = self._http.getresponse()
                said, status = json.loads(answer.read()), answer.status
            except (OSError, http.client.HTTPException):
                self._http.close()
                if time.monotonic() > until:
                    raise
                self._http = self._made()
                time.sleep(0.02)
                continue
            if status == 200:
                return said
            if status != 503 or time.monotonic() > until:
                raise RuntimeError(f"{method} {path}: {status} {said['detail']}")
            time.sleep(0.02)

    def _made(self) -> http.client.HTTPConnection:
        return http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
