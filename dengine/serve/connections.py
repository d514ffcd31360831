"""Connections with limits that uvicorn does not set: places, in all and for each address, and a time for a request's head.

Whoever shows the token is not kept out by those who do not: where there is no place, the oldest connection over which
nobody was let in gives way. What ends a connection is answered before: 503 where there is no place, 408 to a head that
takes too long (of a body's time `auth.Guard` takes care), 400 to what is no HTTP, to too long a head, and to half a head of
which no more comes.
"""

import asyncio
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # both have the names that are used here
    from uvicorn.protocols.http.h11_impl import H11Protocol as AutoHTTPProtocol
else:  # that of httptools, where it is installed: a tenth of a millisecond a request less
    from uvicorn.protocols.http.auto import AutoHTTPProtocol

from .api import problem
from .auth import LET_IN

LARGEST_HEAD = 1 << 16  # bytes
HEAD_SECONDS = 10.0  # from a connection, or from the first byte after an answer, to the end of the request's head
FEWEST = 8  # places of one address, where half of all are fewer


class Places:
    """The connections that a server has.  `uvicorn.Config(http=Places(100).connection)` keeps to them."""

    def __init__(self, connections: int, head_seconds: float = HEAD_SECONDS) -> None:
        self.most, self.of_address, self.head_seconds = connections, max(FEWEST, connections // 2), head_seconds
        self.taken: list[Connection] = []  # oldest first

    def take(self, new: "Connection") -> bool:
        """Whether there is a place for a connection; where there is none, one over which nobody was let in gives way."""
        same = [each for each in self.taken if each.address == new.address]
        if len(same) >= self.of_address or len(self.taken) >= self.most:
            among = same if len(same) >= self.of_address else self.taken
            if (idle := next((each for each in among if not (each.let_in or each.asked)), None)) is None:
                return False
            self.taken.remove(idle)
            idle.refuse()
        self.taken.append(new)
        return True

    def connection(self, **options: Any) -> "Connection":
        """A protocol for one connection, made as uvicorn makes its own."""
        return Connection(self, **options)


class Connection(AutoHTTPProtocol):
    """One connection: uvicorn's own protocol, by its public names, within the limits."""

    def __init__(self, places: Places, **options: Any) -> None:
        super().__init__(**options)
        self._places, self.address, self._has_place, self._was_let_in = places, "", False, False
        self._timer: asyncio.TimerHandle | None = None
        self._begun = self._ended = False  # a head; all that the client sends
        self._head = 0  # bytes of it so far

    @property
    def asked(self) -> bool:
        """Whether a request is being answered."""
        return self.cycle is not None and not self.cycle.response_complete

    @property
    def let_in(self) -> bool:
        """Whether a request that came over it was one of somebody who may ask."""
        self._was_let_in = self._was_let_in or (self.cycle is not None and LET_IN in self.cycle.scope)
        return self._was_let_in

    def refuse(self) -> None:
        """Say that there are too many, and close."""
        full = "Expected fewer connections at once (dengine serve --connections); verify the part, and try again."
        self._end(HTTPStatus.SERVICE_UNAVAILABLE, full)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as of uvicorn's
        """Take a connection, or say that there are too many."""
        self.transport = transport
        self.address = str((transport.get_extra_info("peername") or ("",))[0])
        self._has_place = self._places.take(self)
        if not self._has_place:
            self.refuse()
            return
        super().connection_made(transport)
        self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_waiting()
        if self._has_place:
            if self in self._places.taken:  # else it gave way
                self._places.taken.remove(self)
            super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take bytes; those of a head have to become one in time."""
        if not self._has_place or self.transport.is_closing():
            return
        self._begun, self._head = self._begun or not self.asked, self._head + len(data)
        super().data_received(data)
        if self.asked:
            self._begun, self._head = False, 0
            self._stop_waiting()
        elif self._head > LARGEST_HEAD:
            self._end(HTTPStatus.BAD_REQUEST, f"Expected the request's head to be at most {LARGEST_HEAD} bytes.")
        else:
            self._wait()

    def eof_received(self) -> bool:  # type: ignore[override]  # asyncio's may say that the connection stays open
        """The client sends no more: what it asked is answered, half a head is refused."""
        self._ended = True
        if self._begun:
            self._end(HTTPStatus.BAD_REQUEST, "Expected the whole of the request.")
        return self.asked

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._was_let_in = self.let_in
        if self._ended and not self.asked:
            self.transport.close()

    def send_400_response(self, msg: str) -> None:
        self._end(HTTPStatus.BAD_REQUEST, "Expected a request as HTTP/1.1 has it.")

    def _end(self, status: HTTPStatus, detail: str) -> None:
        """Answer outside of HTTP's course, and close."""
        if self.transport.is_closing():
            return
        answer = problem(status, detail, {"connection": "close"})
        head = b"".join(name + b": " + value + b"\r\n" for name, value in answer.raw_headers)
        first = f"HTTP/1.1 {status.value} {status.phrase}\r\n".encode("ascii")
        self.transport.write(first + head + b"\r\n" + bytes(answer.body))
        self.transport.close()

    def _wait(self) -> None:
        if self._timer is None:
            seconds = self._places.head_seconds
            late = HTTPStatus.REQUEST_TIMEOUT, f"Expected the request's head within {seconds:g} s."
            self._timer = self.loop.call_later(seconds, self._end, *late)

    def _stop_waiting(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
