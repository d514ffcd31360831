"""`Connection` limits what uvicorn does not: the number of connections, and the size and time of a
request's head. uvicorn makes one for each client, as `server.UVICORN_OPTIONS` tells it.

So a slow client uses up neither memory nor files that the engine needs. A connection is closed only
after a response: 503 if there are too many, 408 if a request's head takes too long (the time of the
body is limited by `auth.Guard`), 400 if the request is not HTTP, its head is too long, or the
client stops in the middle of it. Whatever else a network needs, as a limit for each address, is the
work of a proxy before the server.
"""

import asyncio
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # both implementations have the names that are used here
    from uvicorn.protocols.http.h11_impl import H11Protocol as AutoHTTPProtocol
else:  # uses httptools if it is installed, which saves 0.1 ms per request
    from uvicorn.protocols.http.auto import AutoHTTPProtocol

from .api import problem_response

MAX_CONNECTIONS = 500  # a process may usually have 1,024 open files
MAX_HEAD_BYTES = 1 << 16
HEAD_SECONDS = 10.0  # from connecting, or the first byte after a response, to the end of the head


class Connection(AutoHTTPProtocol):
    """One connection: uvicorn's own protocol with the limits of this module.

    Parameters
    ----------
    head_seconds : float, default 10
        Seconds within which the head of a request must arrive.
    **options
        As uvicorn passes them.
    """

    def __init__(self, head_seconds: float = HEAD_SECONDS, **options: Any) -> None:
        super().__init__(**options)
        self._head_seconds = head_seconds
        self._head_bytes = 0  # received so far
        self._timer: asyncio.TimerHandle | None = None  # of a head that has not arrived
        self._client_finished = False  # sends no more

    @property
    def is_answering(self) -> bool:
        """Whether a request is being answered."""
        return self.cycle is not None and not self.cycle.response_complete

    def connection_made(  # type: ignore[override]  # as of uvicorn's
        self, transport: asyncio.Transport
    ) -> None:
        """Start the time of the first head; or respond 503 and close if there are more than
        `MAX_CONNECTIONS`.
        """
        super().connection_made(transport)
        self._start_timer()
        if len(self.connections) > MAX_CONNECTIONS:
            self._respond_and_close(
                HTTPStatus.SERVICE_UNAVAILABLE,
                f"Expected at most {MAX_CONNECTIONS} connections at once; verify the part.",
            )

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timer of the head, since the connection has ended."""
        self._stop_timer()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Pass bytes on to uvicorn, and limit the size and the time of a request's head.

        A head of more than `MAX_HEAD_BYTES` bytes is answered with 400, and the connection closed.
        Bytes on a connection that is being closed are dropped.
        """
        if self.transport.is_closing():
            return
        self._head_bytes += len(data)
        super().data_received(data)
        if self.is_answering:
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
        for the response; False lets asyncio close it.
        """
        self._client_finished = True
        if self._head_bytes:
            self._respond_and_close(HTTPStatus.BAD_REQUEST, "Expected the whole of the request.")
        return self.is_answering

    def on_response_complete(self) -> None:
        """Close the connection after the last response if the client sends no more."""
        super().on_response_complete()
        if self._client_finished and not self.is_answering:
            self.transport.close()

    def send_400_response(self, msg: str) -> None:
        """Respond 400 to bytes that are not HTTP, and close the connection; uvicorn's `msg` is not
        sent.
        """
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
        """Start a timer that answers 408 and closes after `head_seconds`, unless one runs."""
        if self._timer is None:
            detail = f"Expected the request's head within {self._head_seconds:g} s."
            self._timer = self.loop.call_later(
                self._head_seconds, self._respond_and_close, HTTPStatus.REQUEST_TIMEOUT, detail
            )

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
