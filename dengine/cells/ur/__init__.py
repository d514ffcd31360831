"""A Universal Robots controller: its forces recorded, and a cell of its own driven, over RTDE (TCP port 30004).

The client is our own: a trace must be every sample, or say which are missing. ur_rtde keeps the newest package only, and
records at the PC's clock: some packages are lost and others are there twice, unnoticed; when the controller hangs up, its
getters answer with the last values for ever. Ours keeps every package, goes by the controller's own timestamps, connects
again, and writes orders over the connection that answers them.
"""

from .cell import UrCell
from .controller import FakeController, RobotProgram, Trouble
from .recorder import InsertionRecord, RtdeRecorder
from .stream import StreamReport

__all__ = ["FakeController", "InsertionRecord", "RobotProgram", "RtdeRecorder", "StreamReport", "Trouble", "UrCell"]
