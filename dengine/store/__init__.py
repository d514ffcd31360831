"""The memory of an engine in a database: a file, a server, or in memory; with a local journal."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
