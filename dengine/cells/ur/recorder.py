"""Insertions, cut out of what a Universal Robots controller sends 500 times a second.

with RtdeRecorder("192.168.1.10", trigger="bit=0") as recorder:
    while True:
        insertion = recorder.record(timeout=60.0)
        decision = engine.decide(insertion.trace)
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...datasets.triggers import Gaps, Start, StartFinder, Trigger, as_trigger, place
from ...errors import CellError, SettingError
from ...records import TraceSpec
from .protocol import PORT, column_of
from .stream import Row, RtdeStream, StreamReport

BAR_S = 0.5  # at most between two looks at the clock


@dataclass(frozen=True, slots=True)
class InsertionRecord:
    """One recorded insertion. trace : (T,), or (C, T) of several channels, float32; NaN where a sample never came.

    start_s : of its first sample, by the controller's clock; NaN where no start was seen.  samples : T.
    missing : samples that never came; where the start itself fell into a gap all of them, for then no place is known.
    gaps : (first, length) of each stretch of them.  late : samples that came late, and are in their place.
    repeated : samples that came twice; the first counts.  reconnects : connections made again meanwhile.
    """

    trace: NDArray[np.float32]
    start_s: float
    samples: int
    missing: int = 0
    gaps: Gaps = ()
    late: int = 0
    repeated: int = 0
    reconnects: int = 0

    @property
    def complete(self) -> bool:
        return self.missing == 0


class Cutter:
    """Takes a stream's rows in turn, and cuts the insertion out of them that begins first."""

    def __init__(
        self, columns: Sequence[str], channels: Sequence[str], trigger: Trigger, spec: TraceSpec, before: int
    ) -> None:
        self._trigger, self._samples, self._before, self._step = trigger, spec.samples, before, 1.0 / spec.rate_hz
        self._channels = [columns.index(column_of(name)) for name in channels]
        self._signals = {name: columns.index(column_of(name)) for name in trigger.signals}
        self._finder = StartFinder(self._step, trigger.quiet_s)
        self.arm()

    def arm(self) -> None:
        """Forget all rows: look for a start from the next on."""
        self._finder.forget()
        self._rows: list[Row] = []
        self._start: Start | None = None

    @property
    def begun(self) -> bool:
        return self._start is not None

    def feed(self, rows: Sequence[Row]) -> tuple[InsertionRecord | None, int]:
        """The insertion, if it is over; and how many of the rows were looked at."""
        signals = {name: np.array([row.values[c] for row in rows], dtype=np.float64) for name, c in self._signals.items()}
        active = self._trigger.active(signals)
        for i, row in enumerate(rows):
            if self._rows and row.timestamp < self._rows[-1].timestamp - self._step / 2:  # the controller began anew
                if self._start is not None:
                    return self.cut(), i
                self.arm()
            self._rows.append(row)
            if self._start is None:
                self._start = self._finder.feed(row.timestamp, bool(active[i]))
                del self._rows[: -self._before - 2]  # two more: the edge, and the connection that it came by
            if self._start is not None and row.timestamp > self._first(self._start) + (self._samples - 1.5) * self._step:
                return self.cut(), i + 1
        return None, len(rows)

    def cut(self) -> InsertionRecord:
        """What there is of the insertion; all of it NaN where its start was not seen."""
        start, rows = self._start, self._rows
        self.arm()
        if start is None:
            return self._nothing(float("nan"))
        first = self._first(start)
        inside = [row for row in rows if row.timestamp > first - self._step / 2]
        late, reconnects = sum(row.late for row in inside), rows[-1].session - rows[0].session
        if not start.seen:
            return replace(self._nothing(first), late=late, reconnects=reconnects)
        values = np.array([[row.values[c] for c in self._channels] for row in rows], dtype=np.float64)
        placed = place([row.timestamp for row in rows], values, first, self._samples, self._step)
        counts = {"late": late, "repeated": placed.repeated, "reconnects": reconnects}
        return InsertionRecord(self._shaped(placed.trace), first, self._samples, placed.missing, placed.gaps, **counts)

    def _first(self, start: Start) -> float:
        """The time of the trace's first sample."""
        return start.time - self._before * self._step

    def _nothing(self, start_s: float) -> InsertionRecord:
        trace = np.full((len(self._channels), self._samples), np.nan, dtype=np.float32)
        return InsertionRecord(self._shaped(trace), start_s, self._samples, self._samples, ((0, self._samples),))

    def _shaped(self, trace: NDArray[np.float32]) -> NDArray[np.float32]:
        return trace[0] if len(self._channels) == 1 else trace


class RtdeRecorder:
    """Records insertions from a controller's RTDE interface. Opened by `with`, or `open`; it only listens.

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
        if not 0 <= before < samples:
            raise SettingError(f"Expected 0 to {samples - 1} samples from before the trigger, got {before}.")
        self.trigger = as_trigger(trigger)
        self.channels = (channels,) if isinstance(channels, str) else tuple(channels)
        fields = [column_of(name).partition("[")[0] for name in (*self.channels, *self.trigger.signals)]
        forces = set(fields[: len(self.channels)]) == {"actual_TCP_force"}
        unit = "N" if forces and not any(name.startswith("Mu") for name in self.channels) else "mixed units"
        self.spec = TraceSpec(samples, rate_hz, len(self.channels), unit, columns=self.channels)
        self.before = before
        self.stream = RtdeStream(host, tuple(dict.fromkeys(("timestamp", *fields, *also))), inputs, rate_hz, port, timeout)
        self._position = 0

    def open(self) -> RtdeRecorder:
        """Connect; CellError where that cannot be done."""
        self.stream.open()
        self.cutter = Cutter(self.stream.columns, self.channels, self.trigger, self.spec, self.before)
        return self

    def close(self) -> None:
        self.stream.close()

    def __enter__(self) -> RtdeRecorder:
        return self.open()

    def __exit__(self, *raised: object) -> None:
        self.close()

    def arm(self) -> None:
        """Look for an insertion from now on: what came before is given up."""
        self._position = self.stream.position
        self.cutter.arm()

    def report(self) -> StreamReport:
        """Counts of all packages since it was opened."""
        return self.stream.report()

    def rows(self, timeout: float) -> list[Row]:
        """The packages that nobody has looked at, after at most `timeout` seconds; `seen` says how many were."""
        return self.stream.after(self._position, timeout)[0]

    def seen(self, n: int) -> None:
        """So many of the packages are dealt with."""
        self._position += n

    def record(self, timeout: float = 60.0) -> InsertionRecord:
        """Wait for the next insertion, from where the last one ended; `arm` begins later.

        timeout : seconds; where the trigger never went on, CellError; where the insertion began and the controller fell
        silent, what there is of it.
        """
        end = time.monotonic() + timeout
        while (left := end - time.monotonic()) > 0:
            rows = self.rows(min(left, BAR_S))
            record, n = self.cutter.feed(rows) if rows else (None, 0)
            self.seen(n)
            if record is not None:
                return record
        if self.cutter.begun:
            return self.cutter.cut()
        trouble = self.stream.trouble
        why = f"there is no connection: {trouble}" if trouble else f"the trigger never went on: {self.trigger}"
        raise CellError(f"Expected an insertion at {self.stream.where} within {timeout:g} s, {why}.")
