"""Connections with limits that uvicorn does not set: places, in all and for each address, and a time for a request's head.

What ends a connection is answered before: 503 where there is no place, 408 to a head that takes too long (of a body's time
`auth.Guard` takes care), 400 to what is no HTTP and to half a head of which no more comes. `Connection` stands between the
socket and uvicorn's own protocol; `auth.Guard` tells it when a request has come and when it is answered.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from http import HTTPStatus
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

from .api import problem

HEAD_SECONDS = 10.0  # from a connection, or from the first byte after an answer, to the end of the request's head
FEWEST = 8  # places of one address, where half of all are fewer


class Places:
    """The connections that a server has.  `uvicorn.Config(http=Places(100).connection)` keeps to them."""

    def __init__(self, connections: int, head_seconds: float = HEAD_SECONDS) -> None:
        self.most, self.of_address, self.head_seconds = connections, max(FEWEST, connections // 2), head_seconds
        self.taken: Counter[str] = Counter()  # by address

    def connection(self, app_state: dict[str, Any], **options: Any) -> Connection:
        """A protocol for one connection, made as uvicorn makes its own."""
        made = Connection(self)
        made.inner = H11Protocol(app_state=app_state | {"connection": made}, **options)
        return made


class Connection(asyncio.Protocol):
    """One connection, handed on to uvicorn's protocol; it is that protocol's transport as well.

    asked : whether a request is being answered.
    """

    inner: asyncio.Protocol

    def __init__(self, places: Places) -> None:
        self._places, self._address, self._has_place = places, "", False
        self._transport: Any = None  # before `connection_made`, TLS asks what a protocol has
        self._timer: asyncio.TimerHandle | None = None
        self.asked = self._begun = self._ended = self._reading = False

    def __getattr__(self, name: str) -> Any:
        """What a transport has, and is not changed here."""
        return getattr(self._transport, name)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take a connection, or say that there are too many."""
        assert isinstance(transport, asyncio.Transport)  # uvicorn listens for streams alone
        self._transport, places = transport, self._places
        self._address = str((transport.get_extra_info("peername") or ("",))[0])
        self._has_place = places.taken.total() < places.most and places.taken[self._address] < places.of_address
        if not self._has_place:
            full = "Expected fewer connections at once (dengine serve --connections); verify the part, and try again."
            self._end(HTTPStatus.SERVICE_UNAVAILABLE, full)
            return
        places.taken[self._address] += 1
        self.inner.connection_made(self)  # type: ignore[arg-type]  # it is one by what it can do
        self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        """Let go."""
        self._stop_waiting()
        if self._has_place:
            self._places.taken -= Counter([self._address])  # an address without one is forgotten
            self.inner.connection_lost(exc)

    def pause_writing(self) -> None:
        """The client reads more slowly than it is answered."""
        self.inner.pause_writing()

    def resume_writing(self) -> None:
        """It has caught up."""
        self.inner.resume_writing()

    def data_received(self, data: bytes) -> None:
        """Hand bytes on; those of a head have to become one in time."""
        if not self._has_place:
            return
        if not self.asked:
            self._begun = True
            self._wait()
        self._reading = True
        try:
            self.inner.data_received(data)
        finally:
            self._reading = False

    def eof_received(self) -> bool:
        """The client sends no more: what it asked is answered, half a head is refused."""
        self._ended = True
        if self._begun and not self.asked:  # a head that is whole is told of by then, or within this turn of the loop
            asyncio.get_running_loop().call_soon(self._refuse_half)
        return self._begun or self.asked

    def write(self, data: bytes) -> None:
        """Write an answer; what uvicorn says to bytes as it reads them is that they are no HTTP, which is said here."""
        if not self._reading:
            self._transport.write(data)
        else:
            self._end(HTTPStatus.BAD_REQUEST, "Expected a request as HTTP/1.1 has it.")

    def begin_request(self) -> None:
        """A request's head has come."""
        self.asked, self._begun = True, False
        self._stop_waiting()

    def end_request(self) -> None:
        """It is answered."""
        self.asked = False
        if self._ended:
            self._transport.close()

    def _refuse_half(self) -> None:
        if not self.asked:
            self._end(HTTPStatus.BAD_REQUEST, "Expected the whole of the request.")

    def _end(self, status: HTTPStatus, detail: str) -> None:
        """Answer outside of HTTP's course, and close."""
        if self._transport.is_closing():
            return
        answer = problem(status, detail, {"connection": "close"})
        head = b"".join(name + b": " + value + b"\r\n" for name, value in answer.raw_headers)
        first = f"HTTP/1.1 {status.value} {status.phrase}\r\n".encode("ascii")
        self._transport.write(first + head + b"\r\n" + bytes(answer.body))
        self._transport.close()

    def _wait(self) -> None:
        if self._timer is None:
            seconds = self._places.head_seconds
            late = HTTPStatus.REQUEST_TIMEOUT, f"Expected the request's head within {seconds:g} s."
            self._timer = asyncio.get_running_loop().call_later(seconds, self._end, *late)

    def _stop_waiting(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
