"""The user's two numbers, and what follows from them: which neighbours count, and how a bound becomes an action."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import SettingError, expect
from ..records import ACTIONS, Action, find_class, is_number
from .certificate import Certificate, Outcomes, certify
from .intervals import INTERVALS, Bounds, normal_quantile

if TYPE_CHECKING:
    from .rule import DecisionRule

Stops = Literal["all", "some"]
RULES = {  # classes of `rule`, by guarantee and by what is known of stops
    "local": {"some": "DecisionRule", "all": "WatchedRule"},
    "pooled": {"some": "PooledRule", "all": "PooledRule"},
}


@dataclass(frozen=True, slots=True)
class Policy:
    """How certain the model must be before it may decide.

    alpha : two-sided error level of the interval, in (0, 1).
    lower_bound : the paper's LB, in (0.5, 1): accept where lower >= LB, reject where upper <= 1 - LB.
    interval : a name in `INTERVALS`.
    guarantee : the rule that turns a bound into an action: a name in `RULES`, or `module:Class` of a `DecisionRule` of your
        own. "local", the paper's, speaks of the ball around one trace, "pooled" of all parts together: see `rule`.
    stops : "all" where every bad accepted part stops the system and is reported before the next decision: then silence
        until that decision confirms the part. "some", the default, where silence says nothing.
    audit_rate : share of certain decisions that are verified all the same, in [0, 1]; a guarantee on rejects needs it.
    shadow : the shadow mode: everything is verified, and the model only says what it would have done.
    Raises SettingError for a value out of its range.
    """

    alpha: float = 0.05
    lower_bound: float = 0.95
    interval: str = "wilson"
    audit_rate: float = 0.0
    guarantee: str = "local"
    stops: Stops = "some"
    shadow: bool = False

    def __post_init__(self) -> None:
        for name in ("alpha", "lower_bound", "audit_rate"):
            expect(is_number(getattr(self, name)), f"a number as {name}", getattr(self, name))
        expect(isinstance(self.guarantee, str), "a guarantee's name, or module:Class as text", self.guarantee)
        normal_quantile(self.alpha)
        expect(0.5 < self.lower_bound < 1.0, "0.5 < lower_bound < 1", self.lower_bound, "0.95 tolerates 5 % of errors")
        known = isinstance(self.interval, str) and self.interval in INTERVALS
        expect(known, f"an interval among {', '.join(INTERVALS)}", self.interval)
        expect(0.0 <= self.audit_rate <= 1.0, "0 <= audit_rate <= 1", self.audit_rate, "0.02 checks one part in fifty")
        known = ":" in self.guarantee or self.guarantee in RULES
        expect(known, f"a guarantee among {', '.join(RULES)}, or module:Class", self.guarantee)
        expect(self.stops in get_args(Stops), f"stops {' or '.join(get_args(Stops))}", self.stops)
        expect(isinstance(self.shadow, bool), "shadow to be True or False", self.shadow)

    @property
    def audited_share(self) -> float:
        """Share of certain decisions that are verified all the same: all of them in the shadow mode."""
        return 1.0 if self.shadow else self.audit_rate

    def rule(self) -> DecisionRule:
        """A new rule by these settings, which has been told nothing yet. SettingError where its class cannot be found."""
        from . import rule  # torch is imported where it is used

        own = RULES.get(self.guarantee)
        found = find_class(self.guarantee) if own is None else getattr(rule, own[self.stops])
        if not issubclass(found, rule.DecisionRule):
            raise SettingError(f"Expected a subclass of DecisionRule as guarantee, {self.guarantee} is none.")
        try:
            made: DecisionRule = found(self.alpha, self.lower_bound, self.interval)
        except TypeError as error:
            raise SettingError(f"Expected {self.guarantee} to take alpha, lower_bound and interval: {error}.") from error
        return made

    def certificate(self, outcomes: Outcomes) -> Certificate:
        """What may be said of the parts so far; where all stops are known, a part counts once its silence is over."""
        if self.stops == "all":
            outcomes = replace(outcomes, accepted=outcomes.stops + outcomes.forgotten_accepts + outcomes.confirmed)
        return certify(outcomes, self.alpha, 1.0 - self.lower_bound, self.stops, self.audited_share)

    def bound(self, n_success: ArrayLike, n_failure: ArrayLike) -> Bounds:
        """(lower, upper) of the success probability, by the policy's interval and alpha."""
        return INTERVALS[self.interval](n_success, n_failure, self.alpha)

    def action(self, lower: float, upper: float) -> Action:
        """What one bound allows, by the paper's rule."""
        from .rule import action_of

        return ACTIONS[action_of(float(lower), float(upper), self.lower_bound, 1.0 - self.lower_bound)]

    def actions(self, lower: ArrayLike, upper: ArrayLike) -> NDArray[Any]:
        """What each bound allows, by the paper's rule: an object array of `Action`, of the bounds' shape."""
        return np.asarray(np.frompyfunc(self.action, 2, 1)(lower, upper), dtype=object)


@dataclass(frozen=True, slots=True)
class Neighbourhood:
    """Which references count for a query; chosen without looking at any label.

    radius : the paper's fixed ball, in units of the scaled embedding. Used where `fraction` is None.
    fraction : in (0, 1]: the ball grows until it holds this share of the references, nearest first.
    reject_fraction : a second, smaller share that a rejection is decided by; None: the same ball for both. A ball wide
        enough to certify the many successes blurs the few failures.
    """

    radius: float = 0.3
    fraction: float | None = None
    reject_fraction: float | None = None

    def __post_init__(self) -> None:
        expect(is_number(self.radius) and 0.0 < self.radius < math.inf, "a finite radius > 0", self.radius)
        for name in ("fraction", "reject_fraction"):
            value = getattr(self, name)
            held = value is None or (is_number(value) and 0.0 < value <= 1.0)
            expect(held, f"{name} in (0, 1] or None for the fixed radius", value)
        if self.reject_fraction is not None and self.fraction is None:
            raise SettingError("Expected reject_fraction only together with fraction; set both, or neither.")
