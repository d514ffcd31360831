"""`ConnectionPool` and its `Connection`s limit what uvicorn does not: the number of connections,
and the time of a request's head. uvicorn makes a `Connection` for each client, as
`server.uvicorn_options` tells it.

If all places are taken, a new connection replaces the oldest one that is idle and was never
authorized, so that clients without a token cannot keep out one that has it. A connection is closed
only after a response: 503 if there is no place, 408 if a request's head takes too long (the time of
the body is limited by `auth.Guard`), 400 if the request is not HTTP, its head is too long, or the
client stops in the middle of it.
"""

import asyncio
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # both implementations have the names that are used here
    from uvicorn.protocols.http.h11_impl import H11Protocol as AutoHTTPProtocol
else:  # uses httptools if it is installed, which saves 0.1 ms per request
    from uvicorn.protocols.http.auto import AutoHTTPProtocol

from .api import problem_response
from .auth import LET_IN

CONNECTIONS = 100  # default size of a pool
MAX_HEAD_BYTES = 1 << 16
HEAD_SECONDS = 10.0  # from connecting, or the first byte after a response, to the end of the head
MIN_PER_ADDRESS = 8  # places that one IP address may have, even if that is more than half


class ConnectionPool:
    """The open connections of a server, limited in number; half of them for one IP address.

    Use it as ``uvicorn.Config(app, http=ConnectionPool(100).new_connection)``.

    Parameters
    ----------
    size : int
        Most open connections.
    head_seconds : float, default 10
        Seconds within which the head of a request must arrive.
    """

    def __init__(self, size: int, head_seconds: float = HEAD_SECONDS) -> None:
        self.size = size
        self.per_address = max(MIN_PER_ADDRESS, size // 2)
        self.head_seconds = head_seconds
        self.open: list[Connection] = []  # oldest first

    def add(self, connection: "Connection") -> bool:
        """Add a connection; return False, and do not add it, if no place can be made for it.

        If all places of its IP address are taken, or else all of the pool, the oldest connection
        among these that is idle and was never authorized is sent 503 and closed to make room.
        """
        same_address = [other for other in self.open if other.address == connection.address]
        is_address_full = len(same_address) >= self.per_address
        if is_address_full or len(self.open) >= self.size:
            candidates = same_address if is_address_full else self.open
            idle = [
                other for other in candidates if not (other.was_authorized or other.is_answering)
            ]
            if not idle:
                return False
            self.open.remove(idle[0])
            idle[0].refuse()
        self.open.append(connection)
        return True

    def new_connection(self, **options: Any) -> "Connection":
        """Return a protocol for one connection, with the options that uvicorn passes.

        It takes its place in the pool when the client connects.
        """
        return Connection(self, **options)


class Connection(AutoHTTPProtocol):
    """One connection: uvicorn's own protocol with the limits of this module."""

    def __init__(self, pool: ConnectionPool, **options: Any) -> None:
        super().__init__(**options)
        self._pool = pool
        self.address = ""
        self._has_place = False
        self._was_authorized = False
        self._timer: asyncio.TimerHandle | None = None
        self._head_began = False
        self._client_finished = False  # sends no more
        self._head_bytes = 0  # received so far

    @property
    def is_answering(self) -> bool:
        """Whether a request is being answered."""
        return self.cycle is not None and not self.cycle.response_complete

    @property
    def was_authorized(self) -> bool:
        """Whether any request on this connection was authorized by `auth.Guard`."""
        if self.cycle is not None and LET_IN in self.cycle.scope:
            self._was_authorized = True
        return self._was_authorized

    def refuse(self) -> None:
        """Respond 503, too many connections, and close."""
        self._respond_and_close(
            HTTPStatus.SERVICE_UNAVAILABLE,
            "Expected fewer connections at once (dengine serve --connections); "
            "verify the part, and try again.",
        )

    def connection_made(  # type: ignore[override]  # as of uvicorn's
        self, transport: asyncio.Transport
    ) -> None:
        """Take a place in the pool and start the time of the first head; or respond 503 and close.

        A full pool may close another connection for it (`ConnectionPool.add`).
        """
        self.transport = transport
        self.address = str((transport.get_extra_info("peername") or ("",))[0])
        self._has_place = self._pool.add(self)
        if not self._has_place:
            self.refuse()
            return
        super().connection_made(transport)
        self._start_timer()

    def connection_lost(self, exc: Exception | None) -> None:
        """Give the place in the pool back, and stop the timer."""
        self._stop_timer()
        if self._has_place:
            if self in self._pool.open:  # else it was closed to make room
                self._pool.open.remove(self)
            super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Pass bytes on to uvicorn, and limit the size and the time of a request's head.

        A head of more than `MAX_HEAD_BYTES` bytes is answered with 400, and the connection closed.
        Bytes on a connection that is being closed are dropped.
        """
        if not self._has_place or self.transport.is_closing():
            return
        self._head_began = self._head_began or not self.is_answering
        self._head_bytes += len(data)
        super().data_received(data)
        if self.is_answering:
            self._head_began = False
            self._head_bytes = 0
            self._stop_timer()
        elif self._head_bytes > MAX_HEAD_BYTES:
            self._respond_and_close(
                HTTPStatus.BAD_REQUEST,
                f"Expected the request's head to be at most {MAX_HEAD_BYTES} bytes.",
            )
        else:
            self._start_timer()

    def eof_received(self) -> bool:  # type: ignore[override]  # asyncio allows a bool
        """Note that the client sends no more; respond 400 if it stopped in the middle of a head.

        Returns True while a request is being answered, so that asyncio keeps the connection open
        for the response.
        """
        self._client_finished = True
        if self._head_began:
            self._respond_and_close(HTTPStatus.BAD_REQUEST, "Expected the whole of the request.")
        return self.is_answering

    def on_response_complete(self) -> None:
        """Close the connection after the last response if the client sends no more."""
        super().on_response_complete()
        self._was_authorized = self.was_authorized
        if self._client_finished and not self.is_answering:
            self.transport.close()

    def send_400_response(self, msg: str) -> None:
        """Respond to bytes that are not HTTP."""
        self._respond_and_close(HTTPStatus.BAD_REQUEST, "Expected an HTTP/1.1 request.")

    def _respond_and_close(self, status: HTTPStatus, detail: str) -> None:
        """Write a `Problem` response past uvicorn, and close the connection; nothing if it is
        closing.
        """
        if self.transport.is_closing():
            return
        response = problem_response(status, detail, {"connection": "close"})
        head = b"".join(name + b": " + value + b"\r\n" for name, value in response.raw_headers)
        status_line = f"HTTP/1.1 {status.value} {status.phrase}\r\n".encode("ascii")
        self.transport.write(status_line + head + b"\r\n" + bytes(response.body))
        self.transport.close()

    def _start_timer(self) -> None:
        """Start a timer that answers 408 and closes after the pool's `head_seconds`, unless one
        runs.
        """
        if self._timer is None:
            seconds = self._pool.head_seconds
            detail = f"Expected the request's head within {seconds:g} s."
            self._timer = self.loop.call_later(
                seconds, self._respond_and_close, HTTPStatus.REQUEST_TIMEOUT, detail
            )

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
