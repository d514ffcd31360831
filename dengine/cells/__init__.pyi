from .base import Cell as Cell
from .replay import ReplayCell as ReplayCell
from .simulation.cell import SimulatedCell as SimulatedCell
from .ur.cell import UrCell as UrCell
from .ur.recorder import RtdeRecorder as RtdeRecorder
