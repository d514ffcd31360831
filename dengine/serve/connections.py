"""Connections of uvicorn with limits that it does not set: how many at once, and how long a request's head may take.

Whatever ends a connection is answered before: 400 to what is no HTTP, and to half a request whose client says that no more
comes; 408 to a head that takes too long (a body's time is `guard.Body`'s), and so to a new connection on which nothing was
sent. Only a connection that waits for a further request ends without a word, and whatever is left when the server ends.
"""

from __future__ import annotations

import asyncio
import socket
from http import HTTPStatus
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from .api import PROBLEM, problem

HEAD_SECONDS = 10.0  # from a connection, or from the first byte after an answer, to the end of the request's head
FULL = "Expected fewer connections at once (dengine serve --connections); verify the part, and try again."


def limited(connections: int, head_seconds: float = HEAD_SECONDS) -> type[H11Protocol]:
    """A protocol for `uvicorn.Config(http=...)` that keeps to these limits."""
    return type("LimitedProtocol", (Limited,), {"most": connections, "head_seconds": head_seconds})


class Limited(H11Protocol):
    """HTTP/1.1 over one connection."""

    most = 100
    head_seconds = HEAD_SECONDS

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._head: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn's own
        """Take a connection, or say that there are too many."""
        super().connection_made(transport)
        raw = transport.get_extra_info("socket")
        if raw is not None and raw.family in (socket.AF_INET, socket.AF_INET6):
            # Else an answer's second piece waits 40 ms for word that its first has come; asyncio sets it on some sockets.
            raw.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if len(self.connections) > self.most:
            transport.write(_whole(HTTPStatus.SERVICE_UNAVAILABLE, FULL))
            transport.close()
            return
        self._wait_for_head()

    def data_received(self, data: bytes) -> None:
        """Take bytes; those of a head have to become one in time."""
        super().data_received(data)
        if self.cycle is not None and not self.cycle.response_complete:
            self._stop_waiting()
        elif self._head is None and not self.transport.is_closing():
            self._wait_for_head()

    def on_response_complete(self) -> None:
        """Go on; where half of the next request's head is there already, the rest has to come in time too."""
        super().on_response_complete()
        if self._head is None and self._is_begun():
            self._wait_for_head()

    def eof_received(self) -> None:
        """Answer half a request, of which no more comes."""
        if self._is_begun() or (self.conn.our_state is h11.SEND_RESPONSE and self.conn.their_state is h11.SEND_BODY):
            self._end(HTTPStatus.BAD_REQUEST, "Expected the whole of the request.")

    def connection_lost(self, exc: Exception | None) -> None:
        """Let go."""
        self._stop_waiting()
        super().connection_lost(exc)

    def send_400_response(self, msg: str) -> None:
        """Answer what is no HTTP, and close."""
        self._end(HTTPStatus.BAD_REQUEST, "Expected a request as HTTP/1.1 has it.")

    def _end(self, status: HTTPStatus, detail: str) -> None:
        """Answer, if nothing was answered yet, and close."""
        if not self.transport.is_closing():
            if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
                self.transport.write(_whole(status, detail))
            self.transport.close()

    def _is_begun(self) -> bool:
        """Whether there is half a head."""
        return self.conn.our_state is h11.IDLE and bool(self.conn.trailing_data[0]) and not self.transport.is_closing()

    def _wait_for_head(self) -> None:
        self._head = self.loop.call_later(self.head_seconds, self._give_up)

    def _stop_waiting(self) -> None:
        if self._head is not None:
            self._head.cancel()
            self._head = None

    def _give_up(self) -> None:
        self._head = None
        self._end(HTTPStatus.REQUEST_TIMEOUT, f"Expected the request's head within {self.head_seconds:g} s.")


def _whole(status: HTTPStatus, detail: str) -> bytes:
    """An answer outside of HTTP's course, after which the connection is closed."""
    body = problem(status, detail).body
    head = f"HTTP/1.1 {status.value} {status.phrase}\r\ncontent-type: {PROBLEM}\r\ncontent-length: {len(body)}\r\n"
    later = "retry-after: 1\r\n" if status is HTTPStatus.SERVICE_UNAVAILABLE else ""
    return f"{head}{later}connection: close\r\n\r\n".encode("ascii") + bytes(body)
