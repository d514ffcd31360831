"""Universal Robots: record insertions and drive a cell over RTDE (TCP port 30004). `RtdeRecorder`
records traces, and `UrCell` also gives the robot its orders. Below them, and not exported here,
are `stream.RtdeStream`, which receives packages and reconnects, and the protocol's encoding in
`protocol`.

dengine has an RTDE client of its own, since a trace must hold every sample or say which are
missing. The library ur_rtde keeps only the newest package and records at the PC's clock, so that
packages are lost or doubled unnoticed; and after the controller has disconnected it returns the
last values for ever.
"""

from .cell import UrCell
from .recorder import InsertionRecord, RtdeRecorder
from .stream import StreamReport

__all__ = [
    "InsertionRecord",
    "RtdeRecorder",
    "StreamReport",
    "UrCell",
]
