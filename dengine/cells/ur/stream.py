"""`RtdeStream`, which receives all packages of a controller in a thread, and reconnects.
`RtdeClient` is one connection; the stream makes a new one when it is lost, buffers the packages as
`Row`s, and counts what was missing in a `StreamReport`. `RtdeRecorder` reads from it, and `UrCell`
writes inputs through it.
"""

import math
import socket
import struct
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain

from ...errors import CellError, SettingError, expect, instead
from .protocol import (
    CHANNELS,
    VERSION,
    HeldError,
    Package,
    PackageReader,
    PackageType,
    read_recipe,
)

RECEIVE_BYTES = 65536  # at once
Values = Mapping[str, float]  # by column: `timestamp`, `actual_TCP_force[2]`


class RtdeClient:
    """One connection to a controller, which sends data packages from its creation on.

    Parameters
    ----------
    host : str
    port : int
        Of RTDE, 30004 on a robot.
    columns : sequence of str
        Values to receive beside `timestamp`, for example `actual_TCP_force[2]`. Of a vector all
        elements come.
    inputs : sequence of str
        Fields that `send` writes.
    rate_hz : float, default 500
        Packages per second.
    timeout : float, default 2
        Seconds of silence after which the connection counts as lost, also while it is made.

    Raises
    ------
    CellError
        If the controller cannot be reached or refuses something; later, if the connection is lost
        or something else than RTDE is received.
    HeldError
        A CellError: another client writes one of `inputs`.
    SettingError
        If the controller has no such column.
    """

    def __init__(
        self,
        host: str,
        port: int,
        columns: Sequence[str] = (),
        inputs: Sequence[str] = (),
        rate_hz: float = 500.0,
        timeout: float = 2.0,
    ) -> None:
        self.where = f"{host}:{port}"
        self._last_text = ""  # the controller's newest text message, for errors
        outputs = tuple(
            dict.fromkeys(("timestamp", *(column.partition("[")[0] for column in columns)))
        )
        with instead(
            CellError,
            f"Expected an RTDE controller at {self.where}, it cannot be reached",
            OSError,
            do="turn the robot on, and enable RTDE under Settings, Security, Services",
        ):
            self._socket = socket.create_connection((host, port), timeout)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._incoming = self._receive_packages()
        try:
            if self._request(PackageType.VERSION, struct.pack(">H", VERSION))[:1] != b"\1":
                raise CellError(
                    f"Expected RTDE protocol version {VERSION} at {self.where}, "
                    "which refuses it; update it."
                )
            self._outputs = read_recipe(
                self._request(
                    PackageType.OUTPUTS, struct.pack(">d", rate_hz) + ",".join(outputs).encode()
                ),
                outputs,
                "output",
            )
            if unknown := ", ".join(set(columns) - {*self._outputs.columns}):
                raise SettingError(
                    f"Expected a channel among {', '.join(CHANNELS)}, or a number of the "
                    f"controller, as actual_q[5] or output_double_register_24, got {unknown}."
                )
            if inputs:
                self._inputs = read_recipe(
                    self._request(PackageType.INPUTS, ",".join(inputs).encode()), inputs, "input"
                )
            if self._request(PackageType.START, b"")[:1] != b"\1":
                raise CellError(
                    f"Expected {self.where} to start sending, it refuses to{self._last_text}."
                )
        except BaseException:
            self.close()
            raise

    def rows(self) -> Iterator[Values]:
        """Yield the values of every data package by column, as they arrive, without an end.

        They are `timestamp` and all elements of each field that has a requested column. Raise
        CellError if the connection is lost or silent for `timeout` seconds, or for bytes that are
        no RTDE or no package with these columns.
        """
        for package in self._incoming:
            if package.type is PackageType.DATA:
                yield self._outputs.unpack(package.payload)

    def send(self, values: Values) -> None:
        """Write all input fields in one package; a column that is left out is written as 0.

        Names that are no columns are ignored. The client must have been made with `inputs`. Raise
        CellError if the connection is lost, and the errors of `RtdeRecipe.pack`.
        """
        self._send(self._inputs.pack(values))

    def close(self) -> None:
        """Close the connection, also one that is lost; whoever reads `rows` gets a CellError."""
        with suppress(OSError):  # the controller may have closed it first
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _request(self, type_: PackageType, payload: bytes) -> bytes:
        """Send a request, wait for its response, and return the payload of the response.

        The response has the type of the request, `type_`. Packages of another type (RTDE, the
        controller's protocol, calls every message a package) that arrive before it are dropped. But
        if the request is START, a data package that arrives first counts as the response "accepted"
        (the byte 1), and is kept for `rows`. Raise CellError if the connection is lost or silent
        for `timeout` seconds, or for bytes that are no RTDE.
        """
        self._send(Package(type_, payload).to_bytes())
        while (package := next(self._incoming)).type is not type_:
            if type_ is PackageType.START and package.type is PackageType.DATA:
                # The first data may arrive before the response.
                self._incoming = chain([package], self._incoming)
                return b"\1"
        return package.payload

    def _send(self, data: bytes) -> None:
        """Send all of these bytes to the controller.

        Raise CellError if the connection is lost, or if this takes longer than the client's
        `timeout`; some of the bytes may have been sent then.
        """
        with instead(
            CellError,
            f"Expected {self.where} to take what it is sent, the connection is lost",
            OSError,
        ):
            self._socket.sendall(data)

    def _receive_packages(self) -> Iterator[Package]:
        """Yield packages as they arrive, without an end, but no text messages of the controller.

        The newest text message is kept, for errors to quote. Raise CellError if the connection is
        lost or silent for the `timeout` of the client, or for bytes that are no RTDE, the protocol
        of the controller.
        """
        packages = PackageReader()
        while True:
            piece = b""
            reason = "it hung up"
            try:
                piece = self._socket.recv(RECEIVE_BYTES)
            except TimeoutError:
                reason = f"it was silent for {self._socket.gettimeout():g} s"
            except OSError as error:
                reason = f"the connection is lost: {error}"
            if not piece:
                raise CellError(f"Expected packages from {self.where}, {reason}{self._last_text}.")
            for package in packages.feed(piece):
                if package.type is PackageType.TEXT:
                    text = package.payload[1 : 1 + int.from_bytes(package.payload[:1])].decode(
                        "utf-8", "replace"
                    )
                    self._last_text = f' (it said: "{text[:200]}")'
                else:
                    yield package


BUFFER_S = 60.0  # of packages that nobody has taken; older ones are lost
RELEASE_S = 2.0  # within which a controller notices that an earlier client has gone
RETRY_S = (0.05, 1.0)  # between attempts to connect: the shortest and the longest


@dataclass(frozen=True, slots=True)
class Row:
    """One data package: its values by column, and the number of connections before its own."""

    values: Values
    session: int

    @property
    def timestamp(self) -> float:
        """Time of the package by the controller's clock, in seconds."""
        return self.values["timestamp"]


@dataclass(frozen=True, slots=True)
class StreamReport:
    """Counts since the stream was opened, by the controller's own timestamps.

    Attributes
    ----------
    packages : int
        Packages received.
    missing : int
        Timestamps without a package, those during a reconnection included.
    repeated : int
        Packages with the timestamp of an earlier one.
    reconnects : int
        Connections that were lost and made again.
    restarts : int
        Times that the controller's clock started anew.
    incomplete : int
        Traces with missing samples.
    """

    packages: int = 0
    missing: int = 0
    repeated: int = 0
    reconnects: int = 0
    restarts: int = 0
    incomplete: int = 0


class RtdeStream:
    """Receives packages in a thread and buffers them for `rows`.

    If the first connection fails, CellError is raised, or SettingError for an unknown column; if
    another client still writes an input, only after further attempts for 2 s. If a connection is
    lost later, the thread reconnects, with as many attempts as that takes. The buffer holds 60 s of
    packages; older packages are dropped.

    Parameters
    ----------
    connect : callable
        Returns a new `RtdeClient`, or raises its errors.
    rate_hz : float
        Packages per second, as the client requests them.

    Attributes
    ----------
    trouble : str
        Why there is no connection at present; "" if there is one.
    """

    def __init__(self, connect: Callable[[], RtdeClient], rate_hz: float) -> None:
        self.step = 1.0 / rate_hz
        self._open = connect
        self._rows = deque[Row](maxlen=int(BUFFER_S * rate_hz))  # not taken yet
        self._news = threading.Condition()
        self._newest: Row | None = None
        self._session = 0  # number of earlier connections
        self._counts = Counter[str]()
        self._closing = threading.Event()
        self._client = self._connect(time.monotonic() + RELEASE_S)
        self.trouble = ""  # of the first attempts
        self._thread = threading.Thread(target=self._read_loop, name="rtde", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Close the connection, and wait until the receiving thread has ended; safe to call again.

        Buffered packages stay, and `rows` yields them before it ends.
        """
        self._closing.set()
        with self._news:
            client = self._client
            self._news.notify_all()
        if client is not None:
            client.close()
        self._thread.join()

    def report(self) -> StreamReport:
        """Return the counts so far; `incomplete` is 0, which a `UrCell` fills in."""
        with self._news:
            return StreamReport(**self._counts)

    def rows(self, seconds: float) -> Iterator[Row]:
        """Yield the packages of the robot, each removed from the buffer, for this many seconds.

        Packages that are buffered already come first. The time runs from the first call of `next`
        on the iterator; with 0 s or less nothing comes. A lost connection raises nothing: the
        iterator waits while the thread reconnects. If the stream is closed, the iteration ends when
        the buffer is empty or the time is over.
        """
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            with self._news:
                self._news.wait_for(lambda: self._rows or self._closing.is_set(), left)
                if not self._rows:  # the time is over, or the stream closed
                    return
                row = self._rows.popleft()
            yield row

    def clear(self) -> Row | None:
        """Discard the packages that are buffered and not taken yet; the counts stay.

        Returns the newest package so far, None before the first.
        """
        with self._news:
            self._rows.clear()
            return self._newest

    def write(self, values: Values) -> None:
        """Write inputs of the controller; without a connection nothing is written or raised.

        All input fields of the client are written: those that are left out become 0, and other
        names are ignored. A connection may be lost unnoticed, so write again what must arrive when
        a package of a later connection comes (`Row.session`). `values` are numbers by the name of
        the value, such as `input_int_register_24`. While there is a connection, raises the errors
        of `RtdeRecipe.pack` for a number that its field cannot hold.
        """
        with self._news, suppress(CellError):  # the reading thread reconnects
            if self._client is not None:
                self._client.send(values)

    def _read_loop(self) -> None:
        """Receive packages and buffer them until the stream is closed: the body of the thread.

        If the connection is lost or silent for the client's `timeout`, or a package cannot be used
        (it is no RTDE, the protocol of the controller, lacks a column, or its time is not finite),
        the thread reconnects, as often as that takes, and counts each new connection. While there
        is no connection, the attribute `trouble` says why.
        """
        while self._client is not None:
            client = self._client
            try:
                for values in client.rows():
                    self._count_and_buffer(Row(values, self._session))
            except CellError as error:
                client.close()
                with self._news:
                    self._client = None
                    self.trouble = str(error)
            new_client = self._connect()
            with self._news:
                self._client = new_client
                if new_client is not None:
                    self.trouble = ""
                    self._session += 1
                    self._counts["reconnects"] += 1
                    if self._closing.is_set():  # `close` did not see this client
                        new_client.close()

    def _count_and_buffer(self, row: Row) -> None:
        """Count a package and those missing before it, buffer it, and wake whoever waits in `rows`.

        `row` is the package. Raises CellError, and changes nothing, if its time is not finite.
        Times are compared in steps of 1 / rate, rounded to whole steps; each step without a package
        counts as missing. A package with the same time as the package before also counts as
        repeated, and a package with an earlier time counts as a restart of the controller; both are
        buffered, too. If the buffer is full, its oldest package is dropped, which is not counted.
        """
        expect(
            math.isfinite(row.timestamp / self.step),
            "a time of the controller that is finite",
            row.timestamp,
            error=CellError,
        )
        with self._news:
            if self._newest is not None:
                steps = round((row.timestamp - self._newest.timestamp) / self.step)
                self._counts["missing"] += max(steps - 1, 0)
                self._counts["repeated"] += steps == 0
                self._counts["restarts"] += steps < 0
            self._counts["packages"] += 1
            self._newest = row
            self._rows.append(row)
            self._news.notify_all()

    def _connect(self, until: float = float("inf")) -> RtdeClient | None:
        """Try to connect until that succeeds; return the connection, None if the stream is closed.

        A CellError or SettingError of an attempt is noted in the attribute `trouble`, and the
        attempts go on, at intervals that double from 0.05 to 1 s. For the first connection of the
        stream `until` is given, a time of `time.monotonic`: then the error is raised at once. Only
        a HeldError (another client of the controller still writes an input) is raised no earlier
        than at that time, and the attempts go on until then.
        """
        wait, longest_wait = RETRY_S
        while not self._closing.is_set():
            try:
                return self._open()
            # A controller may change while it is unavailable.
            except (CellError, SettingError) as error:
                if until < float("inf") and not (
                    isinstance(error, HeldError) and time.monotonic() < until
                ):
                    raise
                self.trouble = str(error)
            self._closing.wait(wait)
            wait = min(2 * wait, longest_wait)
        return None
