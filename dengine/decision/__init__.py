"""From counts to an action, in one place: intervals, the user's policy, references, the rule, and its scikit-learn face."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .._lazy import lazy_names

if TYPE_CHECKING:
    from .bounds import INTERVALS, binomial_interval, clopper_pearson_interval, jeffreys_interval, wilson_interval
    from .classifier import WilsonRadiusClassifier
    from .neighbors import RadiusIndex
    from .policy import RULES, Neighbourhood, Policy
    from .rule import DecisionRule

_WHERE = {
    "bounds": (
        "INTERVALS",
        "binomial_interval",
        "clopper_pearson_interval",
        "jeffreys_interval",
        "wilson_interval",
    ),
    "classifier": ("WilsonRadiusClassifier",),
    "neighbors": ("RadiusIndex",),
    "policy": (
        "RULES",
        "Neighbourhood",
        "Policy",
    ),
    "rule": ("DecisionRule",),
}

__all__ = [
    "INTERVALS",
    "RULES",
    "DecisionRule",
    "Neighbourhood",
    "Policy",
    "RadiusIndex",
    "WilsonRadiusClassifier",
    "binomial_interval",
    "clopper_pearson_interval",
    "jeffreys_interval",
    "wilson_interval",
]

__getattr__, __dir__ = lazy_names(__name__, _WHERE)
