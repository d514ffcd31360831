"""Models that decide on a trace: their interfaces, dengine's own, the adapter of baselines. `Model`
is what a user's baseline implements, `EngineModel` what the engine drives, and `ModelPrediction` is
dengine's own.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
