from .base import Cell as Cell
from .replay import ReplayCell as ReplayCell
from .simulation.cell import SimulatedCell as SimulatedCell
from .ur.cell import UrCell as UrCell
from .ur.controller import FakeController as FakeController
from .ur.recorder import RtdeRecorder as RtdeRecorder
