"""All that a controller sends, in order, by a thread that reads and connects again where the connection is lost."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import chain

from ...errors import CellError
from .protocol import PORT, VERSION, HeldError, Kind, Package, Packages, recipe_of

PIECE = 65536  # bytes asked of the socket at once


class RtdeClient:
    """Connects, agrees on the recipes and starts; then every package that comes is given, in its order.

    outputs : fields to receive, `timestamp` first.  inputs : fields to write, set together by `send`.
    rate_hz : packages a second.  timeout : seconds of silence after which the connection counts as lost.
    CellError where the controller cannot be reached, refuses something, falls silent, hangs up or sends what is no package.
    """

    def __init__(
        self,
        host: str,
        port: int = PORT,
        outputs: Sequence[str] = ("timestamp",),
        inputs: Sequence[str] = (),
        rate_hz: float = 500.0,
        timeout: float = 2.0,
    ) -> None:
        self.where = f"{host}:{port}"
        self._why = ""  # the controller's last text message, as an error ends with it
        try:
            self._socket = socket.create_connection((host, port), timeout)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except OSError as error:
            raise CellError(
                f"Expected an RTDE controller at {self.where}, it cannot be reached: {error}; is the robot on, and "
                "RTDE enabled under Settings, Security, Services?"
            ) from error
        self._incoming = self._received()
        try:
            if self._ask(Kind.VERSION, struct.pack(">H", VERSION))[:1] != b"\1":
                raise CellError(
                    f"Expected RTDE protocol version {VERSION} at {self.where}, it says no; update the controller."
                )
            named = struct.pack(">d", rate_hz) + ",".join(outputs).encode()
            self.outputs = recipe_of(self._ask(Kind.OUTPUTS, named), outputs, "output")
            if inputs:
                self._inputs = recipe_of(self._ask(Kind.INPUTS, ",".join(inputs).encode()), inputs, "input")
            if self._ask(Kind.START, b"")[:1] != b"\1":
                raise CellError(f"Expected {self.where} to start sending, it refuses to{self._why}.")
        except BaseException:
            self.close()
            raise

    def rows(self) -> Iterator[tuple[float, ...]]:
        """Every data package as it comes, a value a column of `outputs`; once, and for ever."""
        for package in self._incoming:
            if package.kind is Kind.DATA:
                yield self.outputs.unpack(package.payload)

    def send(self, values: Sequence[float]) -> None:
        """Write the input fields, in one package."""
        self._send(self._inputs.pack(values))

    def close(self) -> None:
        with suppress(OSError):  # it may have hung up first
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _ask(self, kind: Kind, payload: bytes) -> bytes:
        """Send a request and wait for its answer; text messages may come between."""
        self._send(Package(kind, payload).packed())
        while (package := next(self._incoming)).kind is not kind:
            if kind is Kind.START and package.kind is Kind.DATA:  # its first data can overtake its yes
                self._incoming = chain([package], self._incoming)
                return b"\1"
        return package.payload

    def _send(self, data: bytes) -> None:
        try:
            self._socket.sendall(data)
        except OSError as error:
            raise CellError(f"Expected {self.where} to take what it is sent, the connection is lost: {error}.") from error

    def _received(self) -> Iterator[Package]:
        packages = Packages()
        while True:
            try:
                piece = self._socket.recv(PIECE)
            except OSError as error:
                silent = f"it was silent for {self._socket.gettimeout():g} s"
                what = silent if isinstance(error, TimeoutError) else f"the connection is lost: {error}"
                raise CellError(f"Expected packages from {self.where}, {what}{self._why}.") from error
            if not piece:
                raise CellError(f"Expected packages from {self.where}, it hung up{self._why}.")
            for package in packages.feed(piece):
                if package.kind is Kind.TEXT:
                    said = package.payload[1 : 1 + package.payload[0]].decode("utf-8", "replace")
                    self._why = f' (it said: "{said[:200]}")'
                else:
                    yield package


LATE_S = 0.02  # beyond the quickest package's way: ten packages
CREEP = 0.01  # two clocks drift apart; a controller's is not off by a hundredth
KEPT_S = 60.0  # of packages, for whoever reads them late
FRESH_S = 10.0  # an input that is older is not repeated: no controller is off and on again sooner
RELEASE_S = 2.0  # in which a controller notices that an earlier owner has gone
RETRY_S = (0.05, 1.0)  # between attempts to connect: the first, and the longest


@dataclass(frozen=True, slots=True)
class Row:
    """One data package. values : a number a column.  late : by its way here.  session : connections before."""

    values: tuple[float, ...]
    late: bool
    session: int

    @property
    def timestamp(self) -> float:
        return self.values[0]  # seconds of the controller's clock


@dataclass(frozen=True, slots=True)
class StreamReport:
    """What came since the stream was opened, by the controller's own timestamps.

    packages : that came.  missing : timestamps without one, reconnections included.  late : later than LATE_S.
    repeated : with a timestamp that had come before.  reconnects : connections that were lost and made again.
    restarts : the controller's clock began anew.
    """

    packages: int = 0
    missing: int = 0
    late: int = 0
    repeated: int = 0
    reconnects: int = 0
    restarts: int = 0


class Lateness:
    """Whether a package is late: its way took longer than the quickest one's, which may creep as the clocks drift.

    timestamp : seconds, by the controller's clock.  arrival : by ours.
    """

    def __init__(self) -> None:
        self._last: tuple[float, float] | None = None
        self._quickest = 0.0

    def is_late(self, timestamp: float, arrival: float) -> bool:
        way = arrival - timestamp
        if self._last is None or timestamp < self._last[0]:  # a clock that began anew says nothing of the one before
            self._quickest = way
        else:
            self._quickest = min(way, self._quickest + CREEP * (arrival - self._last[1]))
        self._last = timestamp, arrival
        return way - self._quickest > LATE_S


class RtdeStream(AbstractContextManager["RtdeStream"]):
    """Reads in a thread of its own, so that no package waits for whoever uses them.

    Connecting for the first time raises CellError; a connection lost later is made again, for as long as it takes, and what
    was written last is written again, unless that was long ago, or the controller itself began anew: it knows nothing of
    what it was told before. clock : seconds, for telling late packages, and old inputs.
    """

    def __init__(
        self,
        host: str,
        outputs: Sequence[str],
        inputs: Sequence[str] = (),
        rate_hz: float = 500.0,
        port: int = PORT,
        timeout: float = 2.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.step = 1.0 / rate_hz
        self.where = f"{host}:{port}"
        self.trouble = ""  # why there is no connection; empty while there is one
        self._connect: Callable[[], RtdeClient] = partial(RtdeClient, host, port, outputs, inputs, rate_hz, timeout)
        self._clock = clock
        self._most = int(KEPT_S * rate_hz)
        self._rows: list[Row] = []
        self._first = 0  # the position of the first row that is kept
        self._news = threading.Condition()
        self._written: tuple[float, ...] | None = None
        self._written_at = 0.0
        self._client: RtdeClient | None = None
        self._session, self._again = 0, False  # connections before; whether this one has not told yet what was written
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._read, name=f"rtde {self.where}", daemon=True)
        self._counts = Counter[str]()
        for left in reversed(range(int(RELEASE_S / RETRY_S[0]) + 1)):
            try:
                self._client = self._connect()
                break
            except HeldError:  # an owner that has just gone is given time to be noticed as gone
                if not left:
                    raise
                self._closing.wait(RETRY_S[0])
        assert self._client is not None  # it has raised
        self.columns = self._client.outputs.columns
        self._thread.start()

    def close(self) -> None:
        """Hang up, and end the thread."""
        self._closing.set()
        with self._news:
            client = self._client
            self._news.notify_all()
        if client is not None:
            client.close()
        self._thread.join()

    def __exit__(self, *raised: object) -> None:
        self.close()

    @property
    def position(self) -> int:
        """Where the next package will stand."""
        with self._news:
            return self._first + len(self._rows)

    def report(self) -> StreamReport:
        with self._news:
            return StreamReport(**self._counts)

    def after(self, position: int, timeout: float) -> list[Row]:
        """The packages from a position on, at least one or, after `timeout` seconds, none.

        CellError where they are no longer kept: nobody asked for a minute.
        """
        with self._news:
            self._news.wait_for(lambda: self._first + len(self._rows) > position or self._closing.is_set(), timeout)
            if (lost := self._first - position) > 0:
                raise CellError(f"Expected to be asked within {KEPT_S:g} s, {lost} packages are lost; arm() begins anew.")
            return self._rows[position - self._first :]

    def write(self, values: Sequence[float] | None) -> None:
        """Set the inputs: now, or as soon as there is a connection again. None: what was written is not to be repeated."""
        with self._news:
            self._written, self._written_at = None if values is None else tuple(values), self._clock()
            self._send()

    def _send(self) -> None:
        """What is to be written, with the lock held, so that nothing older comes after it."""
        if self._client is not None and self._written is not None:
            try:
                self._client.send(self._written)
            except CellError as error:  # the reader finds the same, and connects again: then it is written
                self.trouble = str(error)

    def _read(self) -> None:
        while (client := self._client) is not None:
            late = Lateness()
            try:
                for values in client.rows():
                    self._keep(Row(values, late.is_late(values[0], self._clock()), self._session))
            except CellError as error:
                client.close()
                self._connect_again(str(error))

    def _keep(self, row: Row) -> None:
        with self._news:
            for last in self._rows[-1:]:
                steps = round((row.timestamp - last.timestamp) / self.step)
                self._counts["missing"] += max(steps - 1, 0)
                self._counts["repeated"] += steps == 0
                self._counts["restarts"] += steps < 0
                self._written = None if steps < 0 else self._written  # it began anew: that was meant for before
            self._counts["packages"] += 1
            self._counts["late"] += row.late
            self._rows.append(row)
            if len(self._rows) > 2 * self._most:
                self._first += len(self._rows) - self._most
                del self._rows[: -self._most]
            if self._again and self._clock() - self._written_at < FRESH_S:
                self._send()
            self._again = False
            self._news.notify_all()

    def _connect_again(self, why: str) -> None:
        """Connect, for as long as it takes; there is no connection where it is closed meanwhile."""
        wait, longest = RETRY_S
        with self._news:
            self._client, self.trouble = None, why
        while not self._closing.is_set():
            try:
                client = self._connect()
            except CellError as error:
                self.trouble = str(error)
                self._closing.wait(wait)
                wait = min(2 * wait, longest)
                continue
            with self._news:
                if self._closing.is_set():
                    client.close()
                else:
                    self._client, self.trouble, self._again = client, "", True
                    self._session += 1
                    self._counts["reconnects"] += 1
            return
