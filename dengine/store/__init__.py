"""Where an engine remembers: a database: a file, a server, or one in memory."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
