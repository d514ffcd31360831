"""All that a controller sends, in order, by a thread that reads and connects again where the connection is lost."""

import socket
import struct
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import chain

from ...errors import CellError, SettingError, instead
from .protocol import CHANNELS, PORT, VERSION, HeldError, Kind, Package, Packages, recipe_of

PIECE = 65536  # bytes asked of the socket at once
Values = Mapping[str, float]  # by column: `timestamp`, `actual_TCP_force[2]`


class RtdeClient:
    """Connects, agrees on the recipes and starts; then every package that comes is given, in its order.

    columns : numbers to receive beside `timestamp`, as `actual_TCP_force[2]`.  inputs : fields to write, set together by
    `send`.  rate_hz : packages a second.  timeout : seconds of silence after which the connection counts as lost.
    CellError where the controller cannot be reached, refuses something, falls silent, hangs up or sends what is no package;
    SettingError for a column that is none.
    """

    def __init__(
        self,
        host: str,
        port: int = PORT,
        columns: Sequence[str] = (),
        inputs: Sequence[str] = (),
        rate_hz: float = 500.0,
        timeout: float = 2.0,
    ) -> None:
        self.where = f"{host}:{port}"
        self._why = ""  # the controller's last text message, as an error ends with it
        outputs = tuple(dict.fromkeys(("timestamp", *(column.partition("[")[0] for column in columns))))
        do = "turn the robot on, and enable RTDE under Settings, Security, Services"
        with instead(CellError, f"Expected an RTDE controller at {self.where}, it cannot be reached", OSError, do=do):
            self._socket = socket.create_connection((host, port), timeout)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._incoming = self._received()
        try:
            if self._ask(Kind.VERSION, struct.pack(">H", VERSION))[:1] != b"\1":
                raise CellError(f"Expected RTDE protocol version {VERSION} at {self.where}, it says no; update it.")
            named = struct.pack(">d", rate_hz) + ",".join(outputs).encode()
            self._outputs = recipe_of(self._ask(Kind.OUTPUTS, named), outputs, "output")
            if unknown := ", ".join(set(columns) - {*self._outputs.columns}):
                number = "a number of the controller, as actual_q[5] or output_double_register_24"
                raise SettingError(f"Expected a channel among {', '.join(CHANNELS)}, or {number}, got {unknown}.")
            if inputs:
                self._inputs = recipe_of(self._ask(Kind.INPUTS, ",".join(inputs).encode()), inputs, "input")
            if self._ask(Kind.START, b"")[:1] != b"\1":
                raise CellError(f"Expected {self.where} to start sending, it refuses to{self._why}.")
        except BaseException:
            self.close()
            raise

    def rows(self) -> Iterator[Values]:
        """Every data package as it comes; once, and for ever."""
        for package in self._incoming:
            if package.kind is Kind.DATA:
                yield self._outputs.unpack(package.payload)

    def send(self, values: Values) -> None:
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
        with instead(CellError, f"Expected {self.where} to take what it is sent, the connection is lost", OSError):
            self._socket.sendall(data)

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


KEPT_S = 60.0  # of packages, for whoever reads them late; what is older is a gap
FRESH_S = 10.0  # an input that is older is not repeated: no controller is off and on again sooner
RELEASE_S = 2.0  # in which a controller notices that an earlier owner has gone
RETRY_S = (0.05, 1.0)  # between attempts to connect: the first, and the longest


@dataclass(frozen=True, slots=True)
class Row:
    """One data package. values : by column.  session : connections before."""

    values: Values
    session: int

    @property
    def timestamp(self) -> float:
        return self.values["timestamp"]  # seconds of the controller's clock


@dataclass(frozen=True, slots=True)
class StreamReport:
    """What came since the stream was opened, by the controller's own timestamps.

    packages : that came.  missing : timestamps without one, reconnections included.
    repeated : with a timestamp that had come before.  reconnects : connections that were lost and made again.
    restarts : the controller's clock began anew.  incomplete : traces with a gap, verified and never learned from.
    """

    packages: int = 0
    missing: int = 0
    repeated: int = 0
    reconnects: int = 0
    restarts: int = 0
    incomplete: int = 0


class RtdeStream(AbstractContextManager["RtdeStream"]):
    """Reads in a thread of its own, so that no package waits for whoever uses them. The arguments are `RtdeClient`'s.

    Connecting for the first time raises CellError; a connection lost later is made again, for as long as it takes, and what
    was written last is written again, unless that was long ago, or the controller itself began anew: it knows nothing of
    what it was told before. clock : seconds, for telling old inputs.
    """

    def __init__(
        self,
        host: str,
        columns: Sequence[str] = (),
        inputs: Sequence[str] = (),
        rate_hz: float = 500.0,
        port: int = PORT,
        timeout: float = 2.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.step = 1.0 / rate_hz
        self.where = f"{host}:{port}"
        self.trouble = ""  # why there is no connection; empty while there is one
        self._open = partial(RtdeClient, host, port, columns, inputs, rate_hz, timeout)
        self._clock = clock
        self._rows = deque[Row](maxlen=int(KEPT_S * rate_hz))  # that nobody has taken
        self._news = threading.Condition()
        self._newest: Row | None = None
        self._written: Values | None = None
        self._written_at = 0.0
        self._session, self._again = 0, False  # connections before; whether this one has not told yet what was written
        self._counts = Counter[str]()
        self._closing = threading.Event()
        self._client = self._connect(time.monotonic() + RELEASE_S)
        self._thread = threading.Thread(target=self._read, name=f"rtde {self.where}", daemon=True)
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

    def report(self) -> StreamReport:
        with self._news:
            return StreamReport(**self._counts)

    def take(self, timeout: float) -> Row | None:
        """The oldest package that nobody has taken; None where none came for `timeout` seconds."""
        with self._news:
            self._news.wait_for(lambda: self._rows or self._closing.is_set(), timeout)
            return self._rows.popleft() if self._rows else None

    def clear(self) -> int:
        """Give up what nobody has taken; the connections before."""
        with self._news:
            self._rows.clear()
            return self._session

    def write(self, values: Values | None) -> None:
        """Set the inputs: now, or as soon as there is a connection again. None: what was written is not to be repeated."""
        with self._news:
            self._written, self._written_at = values, self._clock()
            self._send()

    def _send(self) -> None:
        """What is to be written, with the lock held, so that nothing older comes after it."""
        if self._client is not None and self._written is not None:
            try:
                self._client.send(self._written)
            except CellError as error:  # the reader finds the same, and connects again: then it is written
                self.trouble = str(error)

    def _read(self) -> None:
        while self._client is not None:
            client = self._client
            try:
                for values in client.rows():
                    self._keep(Row(values, self._session))
            except CellError as error:
                client.close()
                with self._news:
                    self._client, self.trouble = None, str(error)
            again = self._connect()
            with self._news:
                self._client = again
                if again is not None:
                    self.trouble, self._again = "", True
                    self._session += 1
                    self._counts["reconnects"] += 1
                    if self._closing.is_set():  # too late for `close`
                        again.close()

    def _keep(self, row: Row) -> None:
        with self._news:
            if self._newest is not None:
                steps = round((row.timestamp - self._newest.timestamp) / self.step)
                self._counts["missing"] += max(steps - 1, 0)
                self._counts["repeated"] += steps == 0
                self._counts["restarts"] += steps < 0
                self._written = None if steps < 0 else self._written  # it began anew: that was meant for before
            self._counts["packages"] += 1
            self._newest = row
            self._rows.append(row)
            if self._again and self._clock() - self._written_at < FRESH_S:
                self._send()
            self._again = False
            self._news.notify_all()

    def _connect(self, until: float = float("inf")) -> RtdeClient | None:
        """Try until there is a connection; None where the stream is closed meanwhile.

        until : of `time.monotonic`; a first connection waits so long for an earlier owner to be noticed as gone.
        """
        wait, longest = RETRY_S
        while not self._closing.is_set():
            try:
                return self._open()
            except CellError as error:
                if until < float("inf") and not (isinstance(error, HeldError) and time.monotonic() < until):
                    raise
                self.trouble = str(error)
            self._closing.wait(wait)
            wait = min(2 * wait, longest)
        return None
