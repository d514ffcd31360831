"""dengine: a data engine that lets a robot cell start on the slow check and earn its way off it.

Public names are imported when they are first used, so that `import dengine` costs next to nothing.
"""

import lazy_loader

__version__ = "1.0.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
