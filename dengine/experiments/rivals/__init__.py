"""Rival methods for the same loop, by name; each decides by its own rule, on the same traces and the same feedback.

>>> DataEngine.from_recipe("conv", model=make_rival("knn", Policy(alpha=0.1, lower_bound=0.9), seed=0))
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from inspect import Parameter, signature
from typing import TYPE_CHECKING, Any

import lazy_loader

from ...decision.policy import Policy
from ...errors import SettingError
from ...records import find_class

if TYPE_CHECKING:
    from .base import Rival

__all__ = ["RIVALS", "Rival", "RivalKind", "make_rival", "require"]

Params = Mapping[str, Any]


@dataclass(frozen=True)
class RivalKind:
    """A rival method, before it is made; looking at it imports nothing.

    where : module in this package and class.
    title : for a table.  source : the paper, or the library.
    bound : what bound its decisions keep; "" where it has none, and its threshold is swept.
    tries : four sets of parameters, as many as ours, to choose among on other seeds than those reported.
    chosen : the parameters that were chosen.
    needs : the library that it is made with, beyond what dengine needs.
    """

    where: str
    title: str
    source: str
    bound: str
    tries: tuple[Params, ...]
    chosen: Params = field(default_factory=dict)
    needs: str = ""

    @property
    def rival(self) -> type[Rival]:
        """Its class."""
        return find_class(f"{__name__}.{self.where}")


RIVALS: dict[str, RivalKind] = {
    "knn": RivalKind(
        "baselines:AgreeingNeighbours",
        title="k-NN, all k agree",
        source="Duan et al. (2025), the authors' predecessor",
        bound="",
        tries=({"k": 5}, {"k": 10}, {"k": 20}, {"k": 40}),
        chosen={"k": 5},
    ),
    "wskde": RivalKind(
        "densities:WilsonKernelDensity",
        title="Wilson-score kernel density",
        source="Iversen, Duan and Hagelskjær (2026), arXiv:2602.20947",
        bound="Wilson interval of kernel-weighted counts, at one look",
        tries=({"bandwidth": None}, {"bandwidth": 0.1}, {"bandwidth": 0.2}, {"bandwidth": 0.4}),
        chosen={"bandwidth": None},
    ),
    "gp": RivalKind(
        "densities:GaussianProcess",
        title="Gaussian process",
        source="Rasmussen and Williams (2006), scikit-learn",
        bound="credible interval under the prior, at one look",
        tries=(
            {"n_components": 2, "amplitude": 2.0},
            {"n_components": 2, "amplitude": 3.0},
            {"n_components": 5, "amplitude": 3.0},
            {"n_components": 2, "amplitude": 10.0},
        ),
        chosen={"n_components": 5, "amplitude": 3.0},
    ),
    "minirocket": RivalKind(
        "selective:RocketSelective",
        title="MiniRocket, logistic, SGR",
        source="Dempster et al. (2021), aeon; Geifman and El-Yaniv (2017)",
        bound="SGR risk bound, each side and each training by itself",
        tries=(
            {"C": 0.001, "holdout": 0.5},
            {"C": 0.01, "holdout": 0.5},
            {"C": 0.001, "holdout": 0.3},
            {"C": 0.01, "holdout": 0.3},
        ),
        chosen={"C": 0.01, "holdout": 0.5},
        needs="aeon",
    ),
    "mapie": RivalKind(
        "selective:ControlledRisk",
        title="logistic, MAPIE risk control",
        source="Angelopoulos et al. (2021), MAPIE",
        bound="learn-then-test, each side and each training by itself",
        tries=(
            {"thresholds": 5, "fwer": "bonferroni_holm"},
            {"thresholds": 20, "fwer": "bonferroni_holm"},
            {"thresholds": 5, "fwer": "fixed_sequence"},
            {"thresholds": 20, "fwer": "fixed_sequence"},
        ),
        chosen={"thresholds": 20, "fwer": "fixed_sequence"},
        needs="mapie",
    ),
    "river": RivalKind(
        "baselines:StreamForest",
        title="adaptive random forest",
        source="Gomes et al. (2017), river",
        bound="",
        tries=({"threshold": 0.8}, {"threshold": 0.9}, {"threshold": 0.95}, {"threshold": 0.99}),
        chosen={"threshold": 0.8},
        needs="river",
    ),
    "always": RivalKind(
        "baselines:AlwaysVerify",
        title="always verify",
        source="the cell as it is",
        bound="no error: every part is verified",
        tries=({},) * 4,  # nothing to choose
    ),
    "never": RivalKind(
        "baselines:NeverVerify",
        title="never verify",
        source="the cell without its check",
        bound="",
        tries=({},) * 4,  # nothing to choose
    ),
}


def make_rival(name: str, policy: Policy, seed: int = 0, **params: Any) -> Rival:
    """A rival by its name in `RIVALS`, untrained, for `DataEngine(model=...)`.

    policy : its alpha and lower_bound are the rival's; what it has beside them belongs to the engine.
    seed : of all that it draws.  params : its own settings; those left out have the class's defaults.
    Its library is imported and compiled here, so that no training is timed with that: aeon takes some ten seconds, and a
    minute when it is used for the first time.
    SettingError for an unknown name, an unknown parameter, a value out of range, or a library that is missing.
    """
    require(name)
    kind = RIVALS[name]
    allowed = [each.name for each in signature(kind.rival).parameters.values() if each.kind is Parameter.KEYWORD_ONLY]
    unknown = sorted(set(params) - set(allowed))
    if unknown:
        raise SettingError(
            f"The rival {name} has no parameter {', '.join(unknown)}; it has {', '.join(allowed) or 'none'}."
        )
    return kind.rival(policy.alpha, policy.lower_bound, seed, **params)


def require(name: str) -> None:
    """SettingError where there is no rival of this name, or the library that it is made with is missing."""
    if name not in RIVALS:
        raise SettingError(f"Expected a rival among {', '.join(RIVALS)}, got {name!r}.")
    needs = RIVALS[name].needs
    if needs and find_spec(needs) is None:
        raise SettingError(f'The rival {name} needs {needs}, which is missing; pip install "dengine[rivals]".')


__getattr__, __dir__, _ = lazy_loader.attach(__name__, submod_attrs={"base": ["Rival"]})
