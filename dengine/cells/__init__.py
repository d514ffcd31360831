"""Cells that an engine drives: the protocol, recordings, a simulation, Universal Robots."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
