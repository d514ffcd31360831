"""Requests as bytes over real connections, and what comes of each: an answer at once, an answer in time, or none."""

from __future__ import annotations

import selectors
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

WAIT = 30.0  # seconds in which an answer has to come
PATIENCE = 120.0  # and that to half a request: the server's limit is 10 s, but a busy machine stands still for longer
QUIET = 0.1  # seconds without an answer, after which the server waits for the rest of half a request
MOST = 40  # half requests at once; the server takes 100 connections


@dataclass
class Call:
    """Bytes that were sent, and what came.

    whole : whether an answer is all there.  judge : an answer's outcome.  ended : the server has ended the connection.
    """

    connection: socket.socket
    sent: bytes
    whole: Callable[[bytes], bool]
    judge: Callable[[bytes], str]
    said: bytes = b""
    ended: bool = False

    def __post_init__(self) -> None:
        with suppress(ConnectionError):  # where it is refused before all was sent, the answer is there to be read
            self.connection.sendall(self.sent)

    @property
    def done(self) -> bool:
        """Whether nothing more is to come."""
        return self.ended or self.whole(self.said)

    def take(self) -> None:
        """Take in what comes next."""
        try:
            piece = self.connection.recv(65536)
        except ConnectionError:
            piece = b""
        self.said += piece
        self.ended = not piece

    def wait(self, seconds: float) -> bool:
        """Wait for the answer; False where it has not come in time."""
        self.connection.settimeout(seconds)
        try:
            while not self.done:
                self.take()
        except TimeoutError:
            pass
        return self.done

    def close(self) -> str:
        """Its outcome: closed is a connection that ended without an answer, silent one that did not even end."""
        self.connection.close()
        if not self.done:
            return "silent"
        return self.judge(self.said) if self.whole(self.said) else "closed"


class Halves:
    """Calls that the server waits for the rest of: their answers are waited for, while others are made."""

    def __init__(self, most: int = MOST) -> None:
        self._most = most
        self._selector = selectors.DefaultSelector()

    def keep(self, call: Call, tell: Callable[[Call], object]) -> None:
        """Wait for an answer; `tell` hears of it, or that there is none."""
        self._selector.register(call.connection, selectors.EVENT_READ, (call, tell, time.monotonic() + PATIENCE))
        self._look(0.0)
        self._until(self._most)

    def finish(self) -> None:
        """Wait for all of them."""
        self._until(0)
        self._selector.close()

    def _until(self, left: int) -> None:
        while len(self._selector.get_map()) > left:
            self._look(0.5)

    def _look(self, seconds: float) -> None:
        for key, _ in self._selector.select(seconds):
            key.data[0].take()
        for each in list(self._selector.get_map().values()):
            call, tell, until = each.data
            if call.done or time.monotonic() > until:
                self._selector.unregister(each.fileobj)
                tell(call)


def over_http(port: int, sent: bytes) -> Call:
    """Bytes over a connection of their own, and what HTTP has as an answer to them."""
    return Call(socket.create_connection(("127.0.0.1", port), timeout=WAIT), sent, _is_whole, _judged)


def exchange(port: int, sent: bytes) -> tuple[int, bytes]:
    """The status, and all of the answer; 0 where there is none."""
    call = over_http(port, sent)
    call.wait(WAIT)
    call.connection.close()
    return _status(call.said), call.said


def _is_whole(said: bytes) -> bool:
    head, end, body = said.partition(b"\r\n\r\n")
    if not end or b"content-length: " not in head.lower():
        return False
    return len(body) >= int(head.lower().partition(b"content-length: ")[2].partition(b"\r\n")[0])


def _status(said: bytes) -> int:
    status = said[9:12]
    return int(status) if said.startswith(b"HTTP/1.") and status.isdigit() else 0


def _judged(said: bytes) -> str:
    status = _status(said)
    if 300 <= status < 400 or status >= 500:
        return "failed"
    if status == 408:
        return "late"
    return "refused" if 400 <= status < 500 or b"<fault>" in said else "taken"
