"""Insertions, cut out of what a Universal Robots controller sends 500 times a second.

with RtdeRecorder("192.168.1.10", trigger="bit=0") as recorder:
    while True:
        insertion = recorder.record(timeout=60.0)
        decision = engine.decide(insertion.trace)
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...datasets.triggers import Start, StartFinder, Trigger, as_trigger, place
from ...errors import CellError, expect
from ...records import TraceSpec
from .protocol import CHANNELS, PORT
from .stream import Row, RtdeStream, StreamReport


@dataclass(frozen=True, slots=True)
class InsertionRecord:
    """One recorded insertion. trace : (T,), or (C, T) of several channels, float32; NaN where a sample never came.

    missing : samples that never came; where the start itself fell into a gap all of them, for then no place is known.
    repeated : samples that came twice; the first counts.  reconnects : connections made again meanwhile.
    """

    trace: NDArray[np.float32]
    missing: int
    repeated: int
    reconnects: int


class RtdeRecorder(AbstractContextManager["RtdeRecorder"]):
    """Records insertions from a controller's RTDE interface; it only listens. CellError where it cannot be reached.

    host : the controller's name or address.  trigger : when an insertion begins, a `Trigger` or its text (`as_trigger`).
    samples, rate_hz : of a trace; CB3 controllers send at most 125 a second.  channels : names of CHANNELS, or numbers of
    the controller such as `actual_q[5]`; several give (C, T).  before : samples of a trace from before the trigger.
    timeout : seconds of silence after which the connection is made again.  also, inputs : further fields, for a cell.

    A sample that never came is a NaN at its place, and counted: an engine verifies such a part, and never learns from it.
    An insertion that begins and ends within one gap is not seen; `report().missing` tells of the gap.
    """

    def __init__(
        self,
        host: str,
        trigger: Trigger | str = "register@output_int_register_25",
        samples: int = 1000,
        channels: Sequence[str] = ("FZ_Base",),
        rate_hz: float = 500.0,
        before: int = 0,
        port: int = PORT,
        timeout: float = 2.0,
        also: Sequence[str] = (),
        inputs: Sequence[str] = (),
    ) -> None:
        expect(0 <= before < samples, f"0 to {samples - 1} samples from before the trigger", before)
        self.trigger = as_trigger(trigger)
        self.channels = (channels,) if isinstance(channels, str) else tuple(channels)
        self._columns = [CHANNELS.get(name, name) for name in self.channels]
        self._signals = {name: CHANNELS.get(name, name) for name in self.trigger.signals}
        forces = {f"actual_TCP_force[{i}]" for i in range(3)}.issuperset(self._columns)
        self.spec = TraceSpec(samples, rate_hz, len(self.channels), "N" if forces else "mixed units", columns=self.channels)
        self._before = before
        self.stream = RtdeStream(host, (*self._columns, *self._signals.values(), *also), inputs, rate_hz, port, timeout)
        self._step = self.stream.step
        self._finder = StartFinder(self._step, self.trigger.quiet_s)
        self._rows: list[Row] = []
        self._start: Start | None = None
        self._armed: int | None = None  # connections before, when an insertion was waited for

    def close(self) -> None:
        self.stream.close()

    def __exit__(self, *raised: object) -> None:
        self.close()

    def arm(self) -> None:
        """Look for an insertion from now on: what came before is given up."""
        self._forget()
        self._armed = self.stream.clear()

    def report(self) -> StreamReport:
        """Counts of all packages since it was opened."""
        return self.stream.report()

    def record(self, timeout: float = 60.0) -> InsertionRecord:
        """Wait for the next insertion, from where the last one ended; `arm` begins later.

        timeout : seconds; where the trigger never went on, CellError; where the insertion began and the controller fell
        silent, what there is of it.
        """
        for row in self.rows(timeout):
            if (record := self.feed(row)) is not None:
                return record
        if self.begun:
            return self.cut()
        trouble = self.stream.trouble
        why = f"there is no connection: {trouble}" if trouble else f"the trigger never went on: {self.trigger}"
        raise CellError(f"Expected an insertion at {self.stream.where} within {timeout:g} s, {why}.")

    def rows(self, seconds: float) -> Iterator[Row]:
        """The packages that nobody has looked at, as they come, for so long."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            if (row := self.stream.take(left)) is not None:
                yield row

    @property
    def begun(self) -> bool:
        """Whether an insertion has begun and is not over."""
        return self._start is not None

    def feed(self, row: Row) -> InsertionRecord | None:
        """Take the next package; the insertion that is over by it, if one is."""
        record = None
        if self._rows and row.timestamp < self._rows[-1].timestamp - self._step / 2:  # the controller began anew
            if self.begun:
                record = self.cut()
            self._forget()
        self._rows.append(row)
        if self._start is None:
            active = self.trigger.active({name: np.array([row.values[c]]) for name, c in self._signals.items()})
            self._start = self._finder.feed(row.timestamp, bool(active[0]))
            del self._rows[: -self._before - 2]  # two more: the edge, and the connection that it came by
        last = self._first() + (self.spec.samples - 1.5) * self._step
        return self.cut() if row.timestamp > last else record

    def cut(self) -> InsertionRecord:
        """What there is of the insertion; all of it NaN where its start was not seen."""
        start, first, rows, armed = self._start, self._first(), self._rows, self._armed
        self._forget()
        reconnects = 0 if start is None else rows[-1].session - (rows[0].session if armed is None else armed)
        rows = rows if start is not None and start.seen else []
        values = np.array([[row.values[c] for c in self._columns] for row in rows], dtype=np.float64)
        values = values.reshape(len(rows), len(self._columns))
        placed = place([row.timestamp for row in rows], values, first, self.spec.samples, self._step)
        trace = placed.trace[0] if len(self._columns) == 1 else placed.trace
        return InsertionRecord(trace, len(placed.missing), placed.repeated, reconnects)

    def _first(self) -> float:
        """The time of the trace's first sample; NaN while there is none."""
        return float("nan") if self._start is None else self._start.time - self._before * self._step

    def _forget(self) -> None:
        self._finder.forget()
        self._rows, self._start, self._armed = [], None, None
