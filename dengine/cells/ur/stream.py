"""All that a controller sends, kept in order by a thread that reads, and connects again where the connection is lost."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

from ...errors import CellError
from .client import RtdeClient
from .protocol import PORT

LATE_S = 0.02  # beyond the quickest package's way: ten packages
CREEP = 0.01  # two clocks drift apart; a controller's is not off by a hundredth
KEPT_S = 60.0  # of packages, for whoever reads them late
FRESH_S = 10.0  # an input that is older is not repeated: no controller is off and on again sooner
RETRY_S = (0.05, 1.0)  # between attempts to connect: the first, and the longest


@dataclass(frozen=True, slots=True)
class Row:
    """One data package. values : a number a column.  late : by its way here.  session : connections before."""

    values: tuple[float, ...]
    late: bool
    session: int

    @property
    def timestamp(self) -> float:
        """Seconds of the controller's clock."""
        return self.values[0]


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
    """Whether a package is late: its way took longer than the quickest one's, which may creep as the clocks drift."""

    def __init__(self) -> None:
        self._last: tuple[float, float] | None = None
        self._quickest = 0.0

    def is_late(self, timestamp: float, arrival: float) -> bool:
        """Timestamp : by the controller's clock.  arrival : by ours."""
        way = arrival - timestamp
        if self._last is None or timestamp < self._last[0]:  # a clock that began anew says nothing of the one before
            self._quickest = way
        else:
            self._quickest = min(way, self._quickest + CREEP * (arrival - self._last[1]))
        self._last = timestamp, arrival
        return way - self._quickest > LATE_S


class RtdeStream:
    """Reads in a thread of its own, so that no package waits for whoever uses them. Opened by `with`, or `open`.

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
        self._session = 0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._read, name=f"rtde {self.where}", daemon=True)
        self._counts = dict.fromkeys(StreamReport.__dataclass_fields__, 0)

    def open(self) -> RtdeStream:
        """Connect and begin to read."""
        self._client = self._connect()
        self.columns = self._client.outputs.columns
        self._thread.start()
        return self

    def close(self) -> None:
        """Hang up, and end the thread."""
        self._closing.set()
        with self._news:
            client = self._client
            self._news.notify_all()
        if client is not None:
            client.close()
        if self._thread.is_alive():
            self._thread.join()

    def __enter__(self) -> RtdeStream:
        return self.open()

    def __exit__(self, *raised: object) -> None:
        self.close()

    @property
    def position(self) -> int:
        """Where the next package will stand."""
        with self._news:
            return self._first + len(self._rows)

    def report(self) -> StreamReport:
        """Counts since it was opened."""
        with self._news:
            return StreamReport(**self._counts)

    def after(self, position: int, timeout: float) -> tuple[list[Row], int]:
        """The packages from a position on, at least one or, after `timeout` seconds, none; and the position after them.

        CellError where they are no longer kept: nobody asked for a minute.
        """
        with self._news:
            self._news.wait_for(lambda: self._first + len(self._rows) > position or self._closing.is_set(), timeout)
            if position < self._first:
                raise CellError(
                    f"Expected to be asked for packages within {KEPT_S:g} s, {self._first - position} were given up; begin "
                    "with the newest, as arm() does."
                )
            return self._rows[position - self._first :], self._first + len(self._rows)

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
        late, again = Lateness(), False
        while not self._closing.is_set():
            client = self._client
            if client is None:
                return
            try:
                rows = client.rows()
            except CellError as error:
                self._again(str(error))
                late, again = Lateness(), True
                continue
            arrival = self._clock()
            self._keep([Row(values, late.is_late(values[0], arrival), self._session) for values in rows])
            if again:
                self._write_again()
            again = False

    def _write_again(self) -> None:
        with self._news:
            if self._clock() - self._written_at < FRESH_S:
                self._send()

    def _keep(self, rows: list[Row]) -> None:
        with self._news:
            before = self._rows[-1:]
            for one, next_ in pairwise([*before, *rows]):
                self._count_step(next_.timestamp - one.timestamp)
            self._counts["packages"] += len(rows)
            self._counts["late"] += sum(row.late for row in rows)
            self._rows += rows
            if len(self._rows) > 2 * self._most:
                self._first += len(self._rows) - self._most
                del self._rows[: -self._most]
            self._news.notify_all()

    def _count_step(self, elapsed: float) -> None:
        steps = round(elapsed / self.step)
        self._counts["missing"] += max(steps - 1, 0)
        self._counts["repeated"] += steps == 0
        self._counts["restarts"] += steps < 0
        self._written = None if steps < 0 else self._written  # it began anew: that was meant for before

    def _again(self, why: str) -> None:
        """Connect again."""
        wait, longest = RETRY_S
        with self._news:
            lost, self._client, self.trouble = self._client, None, why
        if lost is not None:
            lost.close()
        while not self._closing.is_set():
            try:
                client = self._connect()
            except CellError as error:
                self.trouble = str(error)
                self._closing.wait(wait)
                wait = min(2 * wait, longest)
                continue
            with self._news:
                self._client, self.trouble = client, ""
                self._session += 1
                self._counts["reconnects"] += 1
            if self._closing.is_set():
                client.close()
            return
