"""`RtdeRecorder`, which records insertions from a Universal Robots controller. It waits for a
trigger in the stream of packages, places each sample by the controller's clock, and returns an
`InsertionRecord`: the trace and what is missing in it. `UrCell` and users who only record use it.

with RtdeRecorder("192.168.1.10", trigger="bit=0") as recorder:
    while True:
        insertion = recorder.record(timeout=60.0)
        decision = engine.decide(insertion.trace)
"""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial

import numpy as np

from ...datasets.triggers import Start, StartFinder, Trigger, as_trigger, place
from ...errors import CellError, expect
from ...records import TraceArray, TraceSpec
from .protocol import CHANNELS, PORT
from .stream import Row, RtdeClient, RtdeStream, StreamReport


@dataclass(frozen=True, slots=True)
class InsertionRecord:
    """One recorded insertion.

    Attributes
    ----------
    trace : array of float32, shape (T,) or (C, T)
        NaN for samples that were lost.
    missing : int
        Number of lost samples; all of them if the start was lost, since no time is known then.
    reconnects : int
        Reconnections during the insertion.
    """

    trace: TraceArray
    missing: int
    reconnects: int


def spec_of_recording(
    samples: int = 1000, channels: Sequence[str] = ("FZ_Base",), rate_hz: float = 500.0
) -> TraceSpec:
    """Return the `TraceSpec` of the traces that an `RtdeRecorder` with these settings records.

    The unit of a force is N; any other unit, also that of a torque, is unknown. The `columns` are
    the names of the channels. Raises SettingError for values that no trace can have.
    """
    forces = {f"actual_TCP_force[{i}]" for i in range(3)}
    unit = tuple("N" if CHANNELS.get(name, name) in forces else "" for name in channels)
    return TraceSpec(samples, rate_hz, len(channels), unit, columns=tuple(channels))


class RtdeRecorder(AbstractContextManager["RtdeRecorder"]):
    """Records insertions over RTDE; by itself it only reads.

    A lost sample is NaN in the trace, so that an engine verifies the part and does not learn from
    it. An insertion that lies entirely within a gap is not recorded; `report().missing` counts the
    gap.

    Parameters
    ----------
    host : str
        Name or address of the controller.
    trigger : Trigger or str
        What begins an insertion; see `as_trigger` for the text form.
    samples : int, default 1000
    channels : sequence of str, default ("FZ_Base",)
        Names in `CHANNELS`, or values of the controller such as `actual_q[5]`. Several give traces
        (C, T).
    rate_hz : float, default 500
        Samples per second. CB3 controllers send at most 125.
    before : int, default 0
        Samples of a trace from before the trigger.
    port : int, default 30004
    timeout : float, default 2
        Seconds of silence after which the connection is made again.
    also, inputs : sequence of str
        Further values to receive, and fields to write, for `UrCell`.

    Raises
    ------
    CellError
        If the controller cannot be reached or refuses something, for example because another client
        still writes one of `inputs` after 2 s.
    SettingError
        For a text that is no trigger, for a channel that the controller does not have, and if
        `before` or `samples` is out of range.
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
        self.spec = spec_of_recording(samples, self.channels, rate_hz)
        self._before = before
        self.where = f"{host}:{port}"
        values = (*self._columns, *self._signals.values(), *also)
        self.stream = RtdeStream(
            partial(RtdeClient, host, port, values, inputs, rate_hz, timeout), rate_hz
        )
        self._step = self.stream.step
        self._reset()

    def _reset(self) -> None:
        """Discard the recorder's packages and the start of an insertion; look for the next.

        Packages that the stream has buffered stay. A trigger that is on begins nothing until it was
        off.
        """
        self._finder = StartFinder(self._step, self.trigger.quiet_s)
        self._rows: list[Row] = []
        self._start: Start | None = None

    def close(self) -> None:
        """Close the connection and end its thread."""
        self.stream.close()

    def __exit__(self, *raised: object) -> None:
        """Close the connection like `close`; an exception of the block passes."""
        self.close()

    def arm(self) -> Row | None:
        """Discard what was received so far, also an insertion that has begun.

        What begins from now on is recorded; a trigger that is on already begins nothing until it
        was off. Returns the newest package so far, None before the first.
        """
        self._reset()
        return self.stream.clear()

    def report(self) -> StreamReport:
        """Return the counts of all packages since the recorder was made, reconnections included.

        `incomplete` is 0.
        """
        return self.stream.report()

    def record(self, timeout: float = 60.0) -> InsertionRecord:
        """Wait for the next insertion after the last one, or after a call of `arm`, and return it.

        An insertion (the robot inserts one part) begins when the trigger, a condition on the values
        that the controller sends, is met after it was not met for its `quiet_s` seconds. It may
        have begun before this call: the packages (the values sent at once) of the last 60 s are
        buffered. What came earlier and was not read is lost, and `arm` discards what has come.

        An insertion that is not complete after `timeout` seconds, for example because the
        controller fell silent, is returned with NaN for the missing samples. If packages are
        missing where it began, so that its start is unknown, all samples are NaN. If the controller
        was restarted during an insertion, what came before is returned at once.

        Parameters
        ----------
        timeout : float, default 60
            Seconds from the call to the end of the insertion. If the recorder is closed, only the
            packages that were received before are read, and nothing is waited for.

        Returns
        -------
        InsertionRecord

        Raises
        ------
        CellError
            If no insertion begins within `timeout`, or before the recorder is closed.
        """
        for row in self.stream.rows(timeout):
            if (record := self.feed(row)) is not None:
                return record
        if self.begun:
            return self.cut()
        why = f"the trigger never went on: {self.trigger}"
        if self.stream.trouble:
            why = f"there is no connection: {self.stream.trouble}"
        raise CellError(f"Expected an insertion at {self.where} within {timeout:g} s, {why}.")

    @property
    def begun(self) -> bool:
        """Whether an insertion has begun and is not complete."""
        return self._start is not None

    def feed(self, row: Row) -> InsertionRecord | None:
        """Add a package of the stream, `row`; return the insertion that it completes, else None.

        An insertion begins when the trigger (a condition on the values of a package) is met after
        it was not met for `quiet_s` seconds. It is complete with the first package whose time is
        that of its last sample, less half the time between two samples, or later.

        Samples that were lost are NaN in the trace; all samples are NaN if packages are missing
        where the insertion began, so that its start is unknown. If the clock of the controller went
        back, because it was restarted, an insertion that has begun is returned as far as it was
        received, and all earlier packages are discarded.
        """
        record = None
        # An earlier time: the controller was restarted.
        if self._rows and row.timestamp < self._rows[-1].timestamp - self._step / 2:
            if self.begun:
                record = self.cut()
            self._reset()
        self._rows.append(row)
        if self._start is None:
            active = self.trigger.active(
                {name: np.array([row.values[c]]) for name, c in self._signals.items()}
            )
            self._start = self._finder.feed(row.timestamp, bool(active[0]))
            # Two more are kept: the edge, and the connection before it.
            del self._rows[: -self._before - 2]
        last = self._first_time() + (self.spec.samples - 1.5) * self._step
        return self.cut() if row.timestamp > last else record

    def cut(self) -> InsertionRecord:
        """Return the insertion as far as it was received, and discard its packages.

        Samples that did not come are NaN. All samples are NaN if packages are missing where the
        insertion began, so that its start is unknown, or if no insertion has begun. The recorder
        then looks for the next one; a trigger (the condition that begins an insertion) that is on
        begins none until it was off.
        """
        start = self._start
        first = self._first_time()
        rows = self._rows
        self._reset()
        reconnects = 0 if start is None else rows[-1].session - rows[0].session
        rows = rows if start is not None and start.seen else []
        values = np.array(
            [[row.values[c] for c in self._columns] for row in rows], dtype=np.float64
        ).reshape(-1, len(self._columns))
        trace, n_missing = place(
            [row.timestamp for row in rows], values, first, self.spec.samples, self._step
        )
        trace = trace[0] if len(self._columns) == 1 else trace
        return InsertionRecord(trace, n_missing, reconnects)

    def _first_time(self) -> float:
        """Return the time of the trace's first sample, in seconds of the controller's clock.

        NaN before an insertion begins.
        """
        return float("nan") if self._start is None else self._start.time - self._before * self._step
