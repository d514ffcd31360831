"""The rules that learn from outcomes: `WatchedRule`, `PooledRule` and `PricedRule`. All three
derive from `MemberRule` and decide by `members.MemberEvidence`, which opens and closes levels of
the score. `policy.RULES` says which one belongs to which guarantee.
"""

from torch import jit

from .members import MemberEvidence
from .rule import DecisionRule

LOWEST_LEVEL = 0.3  # a lower score says little about a part
PRICED_LEVELS = (0.5, 1.0)  # shares of the tolerance that a part of a level may fail with


class MemberRule(DecisionRule):
    """Base class of the rules that decide by `MemberEvidence` in place of LB.

    Parameters
    ----------
    alpha, lower_bound, interval
        As of `DecisionRule`.
    evidence : MemberEvidence
        What opens and closes the levels.
    """

    def __init__(
        self, alpha: float, lower_bound: float, interval: str, evidence: MemberEvidence
    ) -> None:
        super().__init__(alpha, lower_bound, interval)
        self.evidence = evidence

    def action(self, lower: float, upper: float) -> int:
        """Return what a bound allows at present, as its `ActionCode`.

        The part is accepted if `lower` reaches the accept threshold of the evidence, and rejected
        if 1 - `upper` reaches its reject threshold. It is verified if both hold, or neither.
        """
        return self.evidence.action(lower, upper)

    @jit.export
    def update(
        self,
        lower: float,
        upper: float,
        success: bool,
        predicted: int = 0,
        inclusion_probability: float = 1.0,
    ) -> None:
        """Count the outcome of a part, which may move the thresholds, and begin or end a safe mode.

        The parameters are those of `DecisionRule.update`; see `MemberEvidence.update`.
        """
        self.evidence.update(lower, upper, success, predicted, inclusion_probability)

    @jit.export
    def observe(self, n_unreported: int, novel: bool) -> None:
        """Update the drift detectors, which may start the safe mode.

        The parameters are those of `DecisionRule.observe`; see `MemberEvidence.observe`.
        """
        self.evidence.observe(n_unreported, novel)

    @jit.export
    def safe_mode(self) -> int:
        """Return why the safe mode began: a position in `SAFE_MODES`, 0 outside of one."""
        return int(self.evidence.safe_mode.item())

    @jit.unused
    def start_in_safe_mode(self, safe_mode: int) -> None:
        """Accept and reject nothing from the start, like after an alarm, until outcomes allow it.

        `safe_mode` is a `SafeMode`; NONE changes nothing.
        """
        if safe_mode:
            self.evidence.start_safe_mode(safe_mode)


class WatchedRule(MemberRule):
    """The paper's rule with a safe mode, for robot cells where silence after an accept means
    success.

    A part is accepted if lower >= LB and rejected if upper <= 1 - LB. After an alarm of a drift
    detector it does neither, until the outcomes since then show recovery (`MemberEvidence`). The
    tolerance of both sides is 1 - LB.
    """

    def __init__(self, alpha: float, lower_bound: float, interval: str = "wilson") -> None:
        tolerance = 1.0 - float(lower_bound)
        levels = [float(lower_bound)]
        super().__init__(
            alpha,
            lower_bound,
            interval,
            MemberEvidence(alpha, (tolerance, tolerance), [levels, levels], kind="watched"),
        )


class PooledRule(MemberRule):
    """Accept what reaches the target level while the members show that it may be; reject likewise.

    The levels of the score are the same for accepting and rejecting. They go down from LB in steps
    of half the tolerance 1 - LB, and end at 0.3 or above it. Before there is enough evidence every
    part is verified.

    Parameters
    ----------
    alpha, lower_bound, interval
        As of `DecisionRule`. Alpha is the error level of the bet; the interval only sorts parts.
    inclusion_probability : float, default 1.0
        As of `MemberEvidence`.
    """

    sorts = True

    def __init__(
        self,
        alpha: float,
        lower_bound: float,
        interval: str = "wilson",
        inclusion_probability: float = 1.0,
    ) -> None:
        tolerance = 1.0 - float(lower_bound)
        step = 0.5 * tolerance
        n_levels = int((lower_bound - LOWEST_LEVEL) / step + 1e-9) + 1
        levels = [float(lower_bound) - i * step for i in range(n_levels)]
        super().__init__(
            alpha,
            lower_bound,
            interval,
            MemberEvidence(alpha, (tolerance, tolerance), [levels, levels], inclusion_probability),
        )
        self.extra_arguments = (inclusion_probability,)


class PricedRule(MemberRule):
    """Accept what should cost less than its check while the account allows; reject likewise.

    Each side has two levels of the score: 1 minus half of its tolerance, and 1 minus its tolerance.

    Parameters
    ----------
    alpha, lower_bound, interval
        As of `DecisionRule`. The interval only sorts parts; LB decides nothing.
    tolerances : pair of float
        For each side the share of wrong decisions at which they cost as much as checks, see
        `Policy.tolerances`.
    inclusion_probability : float, default 1.0
        As of `MemberEvidence`.
    """

    sorts = True
    prior_labels = 3.0  # its levels are probabilities, so the first escapes come from few labels

    def __init__(
        self,
        alpha: float,
        lower_bound: float,
        interval: str,
        tolerances: tuple[float, float],
        inclusion_probability: float = 1.0,
    ) -> None:
        levels = [[1.0 - share * tolerance for share in PRICED_LEVELS] for tolerance in tolerances]
        super().__init__(
            alpha,
            lower_bound,
            interval,
            MemberEvidence(alpha, tolerances, levels, inclusion_probability, kind="priced"),
        )
        self.extra_arguments = (tolerances, inclusion_probability)
