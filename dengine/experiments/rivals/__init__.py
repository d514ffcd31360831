"""Rival methods for the same loop, by name; each decides by its own rule, on the same traces and the same feedback.

>>> DataEngine.from_recipe("conv", model=make_rival("knn", Policy(alpha=0.1, lower_bound=0.9), seed=0))
"""

from __future__ import annotations

from importlib.util import find_spec
from inspect import Parameter, signature
from typing import Any

from ...decision.policy import Policy
from ...errors import SettingError
from .base import Rival
from .baselines import AgreeingNeighbours, AlwaysVerify, NeverVerify, StreamForest
from .bounded import ControlledRisk, GaussianProcess, RocketSelective, WilsonKernelDensity

__all__ = ["RIVALS", "Rival", "make_rival", "require"]

RIVALS: dict[str, type[Rival]] = {  # their libraries are imported where they are made
    "knn": AgreeingNeighbours,
    "wskde": WilsonKernelDensity,
    "gp": GaussianProcess,
    "minirocket": RocketSelective,
    "mapie": ControlledRisk,
    "river": StreamForest,
    "always": AlwaysVerify,
    "never": NeverVerify,
}


def make_rival(name: str, policy: Policy, seed: int = 0, **params: Any) -> Rival:
    """A rival by its name in `RIVALS`, untrained, for `DataEngine(model=...)`.

    policy : its alpha and lower_bound are the rival's; what it has beside them belongs to the engine.
    seed : of all that it draws.  params : its own settings; those left out have the class's defaults.
    Its library is imported and compiled here, so that no training is timed with that: aeon takes a minute at first.
    SettingError for an unknown name, an unknown parameter, a value out of range, or a library that is missing.
    """
    require(name)
    rival = RIVALS[name]
    allowed = [each.name for each in signature(rival).parameters.values() if each.kind is Parameter.KEYWORD_ONLY]
    unknown = sorted(set(params) - set(allowed))
    if unknown:
        raise SettingError(
            f"The rival {name} has no parameter {', '.join(unknown)}; it has {', '.join(allowed) or 'none'}."
        )
    return rival(policy.alpha, policy.lower_bound, seed, **params)


def require(name: str) -> None:
    """SettingError where there is no rival of this name, or the library that it is made with is missing."""
    if name not in RIVALS:
        raise SettingError(f"Expected a rival among {', '.join(RIVALS)}, got {name!r}.")
    needs = RIVALS[name].needs
    if needs and find_spec(needs) is None:
        raise SettingError(f'The rival {name} needs {needs}, which is missing; pip install "dengine[rivals]".')
