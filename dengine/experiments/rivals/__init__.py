"""Rival methods for the same loop, by name; each decides by its own rule, on the same traces and the same feedback.

>>> DataEngine.from_recipe("conv", model=make_rival("knn", Policy(alpha=0.1, lower_bound=0.9), seed=0))
"""

from .base import Rival
from .methods import RIVALS, make_rival, require

__all__ = ["RIVALS", "Rival", "make_rival", "require"]
