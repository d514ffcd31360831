"""Cells that an engine drives: the protocol `Cell`, recordings (`ReplayCell`), a simulation in
MuJoCo (`SimulatedCell`), and Universal Robots over RTDE (`UrCell`, with a recorder).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
