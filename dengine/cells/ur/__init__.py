"""A Universal Robots controller: its forces recorded, and a cell of its own driven, over RTDE (TCP port 30004).

RTDE is spoken here by a small client of our own (`client`, `protocol`), and not by ur_rtde's, for one reason: a trace must
be every sample, or say which are missing. ur_rtde's `RTDEReceiveInterface` keeps the newest package only; Python polls it,
and its `startFileRecording` writes whatever is newest at the ticks of the PC's clock: some packages are lost and others are
there twice, unnoticed. When the controller hangs up, its thread ends, and the getters answer with the last values for ever.
`training/benchmark_recording.py --ur-rtde` measures that. Ours reads in a thread, keeps every package, goes by the
controller's own timestamps, and connects again. It writes its inputs over the same connection, so that an order and its
answer are in one stream, in one order. ur_rtde's client is what the tests hold the controller without a robot to.

    protocol    the wire, and which number of it is which channel
    stream      a connection, and the thread that keeps it
    recorder    one insertion cut out of the stream
    cell        the handshake with the robot's program; a `Cell`
    controller  a controller that speaks RTDE without a robot, for tests and for trying out
"""

from __future__ import annotations

from .cell import UrCell
from .controller import FakeController, RobotProgram, Trouble
from .recorder import InsertionRecord, RtdeRecorder
from .stream import StreamReport

__all__ = ["FakeController", "InsertionRecord", "RobotProgram", "RtdeRecorder", "StreamReport", "Trouble", "UrCell"]
