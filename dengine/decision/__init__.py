"""From a trace to an action: policy, intervals, references, rules, novelty and the decider. The
model and the engine are built on this family; what users import is listed in `__init__.pyi`:
`Policy`, the intervals, `WilsonRadiusClassifier`, `RadiusIndex` and `DecisionRule`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
