"""From counts to an action, in one place: intervals, the user's policy, references, the rule, and its scikit-learn face."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
