"""The user's two numbers, and what follows from them: how a bound becomes an action."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Literal, Self, get_args

from numpy.typing import ArrayLike

from ..errors import SettingError, expect
from ..imports import import_class
from ..limits import ForceLimits
from ..records import ACTIONS, Action, is_number, is_whole
from .certificate import Certificate, Outcomes, certify
from .intervals import INTERVALS, SORTING_GUARANTEES, Bounds, interval_error_level, normal_quantile

if TYPE_CHECKING:
    from .rule import DecisionRule

Stops = Literal["all", "some"]
RULES = {  # classes of `rule`, by guarantee and by what is known of stops
    "local": {"some": "DecisionRule", "all": "WatchedRule"},
    "pooled": {"some": "PooledRule", "all": "PooledRule"},
    "cost": {"some": "PricedRule", "all": "PricedRule"},
}

NO_WINDOWS = "none"
LARGEST_RADIUS = 1e18  # radius: squared it is finite in float32, so that a query's own part, infinitely far, is in no ball


@dataclass(frozen=True, slots=True)
class Policy:
    """How certain the model must be before it may decide.

    alpha : two-sided error level of the interval, in (0, 1).
    lower_bound : the paper's LB, in (0.5, 1): accept where lower >= LB, reject where upper <= 1 - LB.
    interval : a name in `INTERVALS`.
    guarantee : the rule that turns a bound into an action: a name in `RULES`, or `module:Class` of a `DecisionRule` of your
        own. "local", the paper's, speaks of the neighbourhood of one trace, "pooled" of all parts together, "cost" of what
        they cost by `prices`: then `lower_bound` has no effect, and `alpha` only on the safe mode.
    stops : "all" where every bad accepted part stops the system and is reported before the next decision: then silence
        until that decision confirms the part. "some", the default, where silence says nothing.
    audit_rate : share of certain decisions that are verified all the same, in [0, 1]; a guarantee on rejects needs it, and
        so does "pooled" where not all stops are known.
    shadow : the shadow mode: everything is verified, and the model only says what it would have done.
    label_within : decisions within which a verification or an audit is reported, at least 1; what is owed for longer counts
        as a wrong decision, in the certificate and in the evidence of a rule, until it is reported. Decisions, and not
        seconds: a cell that stands still owes nothing by that, and a replay repeats.
    prices : of a check, of a bad part that is accepted, and of a good one that is rejected, in one unit, by which "cost"
        decides: accept what fails with less than check / escape, reject what succeeds with less than check / false reject.
        An error costs more than two checks.
    windows : an operator's limits beside the model, each a `ForceLimits`, or its text. A trace that leaves one is verified,
        or rejected, whatever the model says (`Reason.OUTSIDE`), and no claim counts it.
    Raises SettingError for a value out of its range.
    """

    alpha: float = 0.05
    lower_bound: float = 0.95
    interval: str = "wilson"
    audit_rate: float = 0.0
    guarantee: str = "local"
    stops: Stops = "some"
    shadow: bool = False
    label_within: int = 1000
    windows: tuple[ForceLimits, ...] = ()
    prices: tuple[float, float, float] = (5.0, 120.0, 47.5)

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
        expect(is_whole(self.label_within, 1, 10**9), "label_within of at least one decision", self.label_within)
        listed = self.windows if isinstance(self.windows, tuple | list) else (None,)
        windows = tuple(ForceLimits.parse(each) if isinstance(each, str) else each for each in listed)
        known = all(isinstance(each, ForceLimits) for each in windows)
        expect(known, "a list of windows, each a ForceLimits, or its text", self.windows)
        object.__setattr__(self, "windows", windows)
        known = isinstance(self.prices, tuple | list) and len(self.prices) == 3 and all(map(is_number, self.prices))
        prices = tuple(float(each) for each in self.prices) if known else (0.0, 0.0, 0.0)
        known = 0.0 < 2.0 * prices[0] < min(prices[1:]) and max(prices) < math.inf
        wanted = "prices of a check, an escape and a false reject, errors above two checks"
        expect(known, wanted, self.prices, "as in 5,120,47.5")
        object.__setattr__(self, "prices", prices)
        if self.guarantee in SORTING_GUARANTEES and self.stops == "some" and self.audited_share == 0.0:
            raise SettingError(
                f"Expected audits, or stops='all', beside the {self.guarantee} guarantee, which can claim nothing of parts "
                "that nobody hears of; set audit_rate=0.1, or stops='all' where every bad accepted part stops the system."
            )

    def to_values(self) -> dict[str, Any]:
        """Return every setting by its name, windows as their text: "none" where there are none."""
        return asdict(self) | {"windows": " ".join(map(str, self.windows)) or NO_WINDOWS}

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> Self:
        """Return the policy of which `to_values` gave these; settings that are missing have their defaults."""
        known = {each.name: values[each.name] for each in fields(cls) if each.name in values}
        windows = known.get("windows", NO_WINDOWS)
        return cls(**known | {"windows": () if windows == NO_WINDOWS else tuple(windows.split())})

    @property
    def summary(self) -> str:
        """Its two numbers and its guarantee: "alpha 0.05, LB 95 %, local"."""
        return f"alpha {self.alpha:g}, LB {100 * self.lower_bound:g} %, {self.guarantee}"

    @property
    def tolerances(self) -> tuple[float, float]:
        """The share of the accepted that may be bad, and of the rejected that may be good."""
        if self.guarantee != "cost":
            return 1.0 - self.lower_bound, 1.0 - self.lower_bound
        check, *errors = self.prices
        return check / errors[0], check / errors[1]

    @property
    def audited_share(self) -> float:
        """Share of certain decisions that are verified all the same: all of them in the shadow mode."""
        return 1.0 if self.shadow else self.audit_rate

    @property
    def limits(self) -> tuple[ForceLimits, ...]:
        """The windows as they act: in the shadow mode none rejects."""
        return tuple(replace(each, reject=each.reject and not self.shadow) for each in self.windows)

    @property
    def known_share(self) -> float:
        """Probability with which the outcome of a certain decision is known; 1 of rejects, too, where all stops are.

        Nothing is claimed of rejects there: few audits would keep them shut for hundreds of parts.
        """
        return 1.0 if self.stops == "all" else self.audit_rate or 1.0

    def rule(self) -> DecisionRule:
        """A new rule by these settings, which has been told nothing yet. SettingError where its class cannot be found."""
        from . import member_rules  # torch is imported where it is used
        from .rule import DecisionRule

        own = RULES.get(self.guarantee)
        found = import_class(self.guarantee) if own is None else getattr(member_rules, own[self.stops])
        if not issubclass(found, DecisionRule):
            raise SettingError(f"Expected a subclass of DecisionRule as guarantee, {self.guarantee} is none.")
        more: dict[str, Any] = {"tolerances": self.tolerances} if issubclass(found, member_rules.PricedRule) else {}
        if issubclass(found, member_rules.PooledRule | member_rules.PricedRule):
            more["inclusion_probability"] = self.known_share
        try:
            made: DecisionRule = found(self.alpha, self.lower_bound, self.interval, **more)
        except TypeError as error:
            raise SettingError(f"Expected {self.guarantee} to take alpha, lower_bound and interval: {error}.") from error
        return made

    def certificate(self, outcomes: Outcomes) -> Certificate:
        """What may be said of the parts so far; where all stops are known, a part counts once its silence is over."""
        if self.stops == "all":
            outcomes = replace(outcomes, accepted=outcomes.false_accepts + outcomes.forgotten_accepts + outcomes.confirmed)
        said = certify(outcomes, self.alpha, self.tolerances[0], self.stops, self.audited_share)
        return replace(said, prices=self.prices) if self.guarantee == "cost" else said

    def bound(self, n_success: ArrayLike, n_failure: ArrayLike) -> Bounds:
        """(lower, upper) of the success probability, by the policy's interval."""
        return INTERVALS[self.interval](n_success, n_failure, interval_error_level(self.alpha, self.guarantee))

    def action(self, lower: float, upper: float) -> Action:
        """What one bound allows, by the paper's rule."""
        from .rule import action_of

        return ACTIONS[action_of(float(lower), float(upper), self.lower_bound, 1.0 - self.lower_bound)]


def check_radius(radius: float) -> None:
    """SettingError for a radius out of range: of the ball whose labels count, in units of the scaled embedding."""
    expect(is_number(radius) and 0.0 < radius <= LARGEST_RADIUS, f"a radius > 0 of at most {LARGEST_RADIUS:g}", radius)
