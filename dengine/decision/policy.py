"""The user's settings of a decision: error level, lower bound LB, guarantee, audits, force limits.
`Policy` is the frozen record of them. It makes the decision rule, the interval and the certificate
that follow from them. The recipe, the store's settings and the verb `dengine policy` all hold one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Literal, Self, get_args

from numpy.typing import ArrayLike

from ..errors import SettingError, expect, instead
from ..imports import import_class
from ..limits import ForceLimits
from ..records import ACTIONS, Action, is_number, is_whole
from .certificate import Certificate, Outcomes, Prices, certify
from .intervals import INTERVALS, SORTING_GUARANTEES, Bounds, interval_error_level, normal_quantile

if TYPE_CHECKING:
    from .rule import DecisionRule

Stops = Literal["all", "some"]
Settings = dict[str, Any]  # of a policy, by name
RULES = {  # names in `member_rules`, by guarantee and by which line stops are known
    "local": {"some": "DecisionRule", "all": "WatchedRule"},
    "pooled": {"some": "PooledRule", "all": "PooledRule"},
    "cost": {"some": "PricedRule", "all": "PricedRule"},
}

NO_LIMITS = "none"
OLD_NAME = "windows"  # of the force limits, in recipes and stores of before
# Squared, it is finite in float32, so that a query's own part, infinitely far, is never within it.
LARGEST_RADIUS = 1e18
PRICES = (5.0, 120.0, 47.5)  # seconds: the paper's check, a line stop, and the paper's cycle
MOST_CHECKS = 1e6  # that an error may cost
AUDIT_RATE = 0.05  # that prices without a guarantee imply


@dataclass(frozen=True, slots=True)
class Policy:
    """How certain the model must be before it may decide.

    Parameters
    ----------
    alpha : float, default 0.05
        Two-sided error level of the interval, between 0 and 1.
    lower_bound : float, default 0.95
        The paper's LB, between 0.5 and 1: accept if lower >= LB, reject if upper <= 1 - LB.
    interval : str, default "wilson"
        A name in `INTERVALS`.
    audit_rate : float, optional
        Share of certain decisions that are verified all the same, from 0 to 1. "pooled" and "cost"
        need it if not all line stops are known; "pooled" then covers rejected parts as well. None:
        0, or 0.05 if `prices` are given without a guarantee.
    guarantee : str, optional
        The rule that turns a bound into an action: a name in `RULES`, or `module:Class` of a
        subclass of `DecisionRule`. "local", the paper's rule, is about the neighbourhood of one
        trace. "pooled" is about all members together. "cost" is about what all members cost by
        `prices`, as far as their outcomes are known; then `lower_bound` does not influence
        decisions, and `alpha` influences only the safe mode. None: "local", or "cost" if `prices`
        are given.
    stops : {"some", "all"}, default "some"
        "all": every bad accepted part stops the line and is reported before the next decision. If
        nothing is reported until then, the part is confirmed. "some": a missing report says
        nothing.
    shadow : bool, default False
        Shadow mode: every part is verified, and the model only says what it would have done.
    label_within : int, default 1000
        A check, or an audit, is overdue if it has no report within this number of later decisions.
        Until it is reported it counts as a wrong decision, in the certificate and in the rule. The
        unit is decisions, not seconds: a robot cell may stand still, and a replay gives the same
        result.
    force_limits : tuple of ForceLimits or str, default ()
        The operator's limits beside the model. A trace that leaves one of them is verified or
        rejected, whatever the model says (`Reason.OUTSIDE`). No claim counts this trace.
    prices : three floats, optional
        The prices of a check, of a bad part that is accepted (an escape), and of a good part that
        is rejected, in one unit. "cost" decides by them. It accepts a part that fails with a
        probability below check / escape, and rejects a part that succeeds with a probability below
        check / false reject. An error must cost more than two checks, and at most a million. None:
        `PRICES`, 5, 120 and 47.5.

    Raises
    ------
    SettingError
        For a value out of its range.

    Examples
    --------
    >>> policy = Policy(prices=(0.5, 200, 5))
    >>> policy.guarantee, policy.audit_rate
    ('cost', 0.05)
    """

    alpha: float = 0.05
    lower_bound: float = 0.95
    interval: str = "wilson"
    # None is replaced when the policy is made: what prices imply depends on all three.
    audit_rate: float = None  # type: ignore[assignment]
    guarantee: str = None  # type: ignore[assignment]
    stops: Stops = "some"
    shadow: bool = False
    label_within: int = 1000
    force_limits: tuple[ForceLimits, ...] = ()
    prices: Prices = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        by_prices = self.prices is not None and self.guarantee is None
        defaults = {
            "audit_rate": AUDIT_RATE if by_prices else 0.0,
            "guarantee": "cost" if by_prices else "local",
            "prices": PRICES,
        }
        for name, default in defaults.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, default)
        for name in ("alpha", "lower_bound", "audit_rate"):
            expect(is_number(getattr(self, name)), f"a number as {name}", getattr(self, name))
        expect(
            isinstance(self.guarantee, str),
            "a guarantee's name, or module:Class as text",
            self.guarantee,
        )
        normal_quantile(self.alpha)
        expect(
            0.5 < self.lower_bound < 1.0,
            "0.5 < lower_bound < 1",
            self.lower_bound,
            "0.95 tolerates 5 % of errors",
        )
        expect(
            isinstance(self.interval, str) and self.interval in INTERVALS,
            f"an interval among {', '.join(INTERVALS)}",
            self.interval,
        )
        expect(
            0.0 <= self.audit_rate <= 1.0,
            "0 <= audit_rate <= 1",
            self.audit_rate,
            "0.02 checks one part in fifty",
        )
        expect(
            ":" in self.guarantee or self.guarantee in RULES,
            f"a guarantee among {', '.join(RULES)}, or module:Class",
            self.guarantee,
        )
        choices = get_args(Stops)
        expect(self.stops in choices, f"stops {' or '.join(choices)}", self.stops)
        expect(isinstance(self.shadow, bool), "shadow to be True or False", self.shadow)
        expect(
            is_whole(self.label_within, 1, 10**9),
            "label_within of at least one decision",
            self.label_within,
        )
        object.__setattr__(self, "force_limits", self._checked_limits())
        object.__setattr__(self, "prices", self._checked_prices())
        if (
            self.guarantee in SORTING_GUARANTEES
            and self.stops == "some"
            and self.audited_share == 0.0
        ):
            raise SettingError(
                f"Expected audits, or stops='all', beside the {self.guarantee} guarantee, which "
                "can claim nothing of parts that nobody hears of; set audit_rate=0.1, or "
                "stops='all' where every bad accepted part stops the system."
            )

    def _checked_limits(self) -> tuple[ForceLimits, ...]:
        """Return the force limits as a tuple of `ForceLimits`, parsing texts.

        They are an operator's limits of the signal. Raises SettingError if they are no tuple or
        list, or one of them is neither a text of limits nor a `ForceLimits`.
        """
        given = self.force_limits if isinstance(self.force_limits, tuple | list) else (None,)
        limits: Any = tuple(
            ForceLimits.parse(item) if isinstance(item, str) else item for item in given
        )
        expect(
            all(isinstance(item, ForceLimits) for item in limits),
            "force_limits, a list of ForceLimits or of their texts",
            self.force_limits,
        )
        return limits  # type: ignore[no-any-return]

    def _checked_prices(self) -> Prices:
        """Return the prices of a check, a bad accepted part and a good rejected part, as floats.

        Raises SettingError if `prices` is no tuple or list of three finite numbers above 0, or if
        one of the two errors costs no more than two checks, or more than a million.
        """
        given = self.prices if isinstance(self.prices, tuple | list) else ()
        prices = [float(price) for price in given if is_number(price)]
        is_valid = len(prices) == len(given) == 3 and (
            0.0 < 2.0 * prices[0] < min(prices[1:]) <= max(prices) <= MOST_CHECKS * prices[0]
        )
        expect(
            is_valid,
            "prices of a check, an escape and a false reject, errors of 2 to 1,000,000 checks",
            self.prices,
            "as in 5,120,47.5",
        )
        return tuple(prices)  # type: ignore[return-value]  # three, as was checked

    def to_values(self) -> Settings:
        """Return every setting by its name; the force limits are one text, "none" without any.

        In this text a space separates two limits. All other values stay as they are, so `prices` is
        a tuple.
        """
        return asdict(self) | {"force_limits": " ".join(map(str, self.force_limits)) or NO_LIMITS}

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> Self:
        """Return the policy whose settings `to_values` returned; missing ones have their defaults.

        `values` holds the settings by name. The force limits (an operator's limits of the signal)
        are one text, separated by spaces, or "none"; in older stores their name is "windows". Names
        that are no settings are ignored. A missing guarantee (the rule that decides) is "local",
        and a missing audit rate (share of the parts to be accepted or rejected that are checked all
        the same) is 0; with `prices` (of a check and of the two errors) and no guarantee they are
        "cost" and 0.05. Raises SettingError for a value out of its range, and for an audit rate of
        0 with a guarantee that needs audits.
        """
        settings = {f.name: values[f.name] for f in fields(cls) if f.name in values}
        limits = values.get("force_limits", values.get(OLD_NAME, NO_LIMITS))
        settings["force_limits"] = [] if limits == NO_LIMITS else limits.split()
        return cls(**settings)

    def changed(self, **settings: Any) -> Self:
        """Return a copy with these settings changed.

        If `prices` are among them, but no guarantee (the rule that decides), and this policy has
        the guarantee "local" or "pooled", which ignore prices, then the guarantee becomes "cost",
        and an audit rate (share of the parts to be accepted or rejected that are checked all the
        same) of 0 becomes 0.05, unless the settings have an audit rate. Raises SettingError for a
        value out of its range, and for an audit rate of 0 with a guarantee that needs audits;
        TypeError for a name that is no setting.
        """
        implied: Settings = {}
        has_prices_alone = settings.keys() & {"prices", "guarantee"} == {"prices"}
        if has_prices_alone and self.guarantee in ("local", "pooled"):
            implied = {"guarantee": "cost", "audit_rate": self.audit_rate or AUDIT_RATE}
        return replace(self, **(implied | settings))

    @property
    def summary(self) -> str:
        """The two numbers and the guarantee: "alpha 0.05, LB 95 %, local"."""
        return f"alpha {self.alpha:g}, LB {100 * self.lower_bound:g} %, {self.guarantee}"

    @property
    def tolerances(self) -> tuple[float, float]:
        """Share of accepted parts that may be bad, and share of rejected parts that may be good.

        Both are 1 - `lower_bound`. Under the guarantee "cost" they are ratios of `prices`: the
        price of a check divided by that of a bad accepted part, and by that of a good rejected
        part.
        """
        if self.guarantee != "cost":
            return 1.0 - self.lower_bound, 1.0 - self.lower_bound
        check, escape, false_reject = self.prices
        return check / escape, check / false_reject

    @property
    def audited_share(self) -> float:
        """Share of certain decisions that are verified all the same; 1 in shadow mode."""
        return 1.0 if self.shadow else self.audit_rate

    @property
    def limits(self) -> tuple[ForceLimits, ...]:
        """The force limits as they act: in shadow mode none rejects, but the part is verified."""
        return tuple(
            replace(item, reject=item.reject and not self.shadow) for item in self.force_limits
        )

    @property
    def inclusion_probability(self) -> float:
        """Probability that the outcome of a certain decision is known; it is an argument of rules.

        It is 1 if all line stops are known, for rejects, too: nothing is claimed of rejects then,
        because few audits would keep them closed for hundreds of parts. Otherwise it is
        `audit_rate`, or 1 if that is 0: without audits it says nothing.
        """
        return 1.0 if self.stops == "all" else self.audit_rate or 1.0

    def rule(self) -> DecisionRule:
        """Make the decision rule, which turns bounds of a success probability into actions.

        It has learned nothing yet. Its class is the one that `RULES` names for `guarantee` (what is
        promised about decisions) and `stops` (whether every bad accepted part is reported), or the
        user's own if `guarantee` is `module:Class`, which is imported. The class gets alpha,
        lower_bound and interval. `PooledRule`, `PricedRule` and their subclasses also get
        `inclusion_probability` (the probability that an outcome is known), priced ones `tolerances`
        (the shares of wrong accepts and rejects that are allowed) as well.

        Returns
        -------
        DecisionRule

        Raises
        ------
        SettingError
            If the class cannot be imported, is no `DecisionRule`, is the user's own and does not
            compile to TorchScript, or its constructor raises TypeError, since it takes other
            arguments. Any other error of the constructor is raised as it is.
        """
        from . import member_rules  # torch is imported where it is used
        from .rule import DecisionRule
        from .scripting import script

        if self.guarantee in RULES:
            rule_class = getattr(member_rules, RULES[self.guarantee][self.stops])
        else:
            rule_class = import_class(self.guarantee)
        if not issubclass(rule_class, DecisionRule):
            raise SettingError(
                f"Expected a subclass of DecisionRule as guarantee, {self.guarantee} is none."
            )
        options: Settings = {}
        if issubclass(rule_class, member_rules.PricedRule):
            options["tolerances"] = self.tolerances
        if issubclass(rule_class, member_rules.PooledRule | member_rules.PricedRule):
            options["inclusion_probability"] = self.inclusion_probability
        try:
            rule: DecisionRule = rule_class(self.alpha, self.lower_bound, self.interval, **options)
        except TypeError as error:
            raise SettingError(
                f"Expected {self.guarantee} to take alpha, lower_bound and interval: {error}."
            ) from error
        if self.guarantee not in RULES:
            wanted = f"Expected {self.guarantee} to compile, with a type for each argument"
            with instead(SettingError, wanted, Exception):
                script(rule)
        return rule

    def certificate(self, outcomes: Outcomes) -> Certificate:
        """Return the bounds on how often parts decided without a check were decided wrongly.

        The bound on rejected parts comes from audits (checks at random), and so does that on
        accepted parts, unless all their outcomes are known; without audits such a bound is 1. With
        `stops="all"` (every bad accepted part is reported), accepted parts that got no report are
        left out. An accepted or audited part whose label was withdrawn, and an audit that is not
        reported in time, count as decided wrongly. Raises ValueError if `outcomes` counts more
        parts of a group as wrong than are in it.

        Parameters
        ----------
        outcomes : Outcomes
            Counts of the parts decided under this policy, and of their outcomes.

        Returns
        -------
        Certificate
            Two bounds, for accepted and for rejected parts, at confidence 1 - alpha (the policy's
            error level) each, as `certify` returns them; with the policy's prices (of a check and
            of wrong decisions) if its guarantee is "cost", the rule that decides by them.
        """
        if self.stops == "all":
            outcomes = replace(
                outcomes,
                accepted=outcomes.false_accepts + outcomes.forgotten_accepts + outcomes.confirmed,
            )
        certificate = certify(
            outcomes, self.alpha, self.tolerances[0], self.stops, self.audited_share
        )
        if self.guarantee == "cost":
            certificate = replace(certificate, prices=self.prices)
        return certificate

    def bound(self, n_success: ArrayLike, n_failure: ArrayLike) -> Bounds:
        """Return (lower, upper) of the success probability by the policy's interval.

        The counts are integers or arrays of one shape. The ends are floats or arrays of that
        shape. ValueError for other shapes and negative counts. The error level is alpha. Under
        the guarantees "pooled" and "cost", where the interval only sorts parts, it is 0.5.
        """
        return INTERVALS[self.interval](
            n_success, n_failure, interval_error_level(self.alpha, self.guarantee)
        )

    def action(self, lower: float, upper: float) -> Action:
        """Return the action that bounds (lower, upper) of the success probability allow.

        It is ACCEPT if lower >= `lower_bound`, otherwise REJECT if upper <= 1 - `lower_bound`,
        otherwise VERIFY, also for NaN. Which decision rule `guarantee` names, the shadow mode
        (every part is verified) and force limits have no effect here.
        """
        from .rule import action_of

        return ACTIONS[action_of(lower, upper, self.lower_bound, 1.0 - self.lower_bound)]


def check_radius(radius: float) -> None:
    """Raise SettingError unless a radius is a number above 0, at most `LARGEST_RADIUS` (1e18).

    It is the distance, in units of the scaled embedding, within which labels count.
    """
    expect(
        is_number(radius) and 0.0 < radius <= LARGEST_RADIUS,
        f"a radius > 0 of at most {LARGEST_RADIUS:g}",
        radius,
    )
