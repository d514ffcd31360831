"""What the engine drives: the contracts, our own prediction by reducer and radius neighbours, and a
baseline's adapter.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
