"""Cells that an engine drives: the contract, a recording played back, a simulated cell, and a UR robot's."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
