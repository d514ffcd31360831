"""Models that decide on a trace: their contracts, dengine's own, the adapter of baselines."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
