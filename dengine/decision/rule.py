"""The decision rule: label counts around a trace -> confidence bound -> action. `DecisionRule` is
the paper's rule and the base class of all others, a user's own included; `action_of` compares a
bound with two thresholds. The rules that learn from outcomes are in another file,
`member_rules.py`; `Policy.rule`, in `policy.py`, makes the one that a policy asks for.

    >>> rule = Policy(alpha=0.1, lower_bound=0.9).rule()
    >>> rule(40, 0)                      # 40 successes, no failure: (1, 0.93..., 1.0), accept

A rule is an `nn.Module` that compiles to TorchScript, so the engine, the scikit-learn classifier
and the exported file run the same lines.
"""

from functools import partial
from typing import Any, Self

from torch import jit, nn

from ..records import ActionCode
from .intervals import SCALAR_BOUNDS, SORTING_ERROR_LEVEL, normal_quantile, scalar_interval


def action_of(lower: float, upper: float, accept_threshold: float, reject_threshold: float) -> int:
    """Return the action that a bound allows, as its `ActionCode`.

    Parameters
    ----------
    lower, upper : float
        Bound on the success probability.
    accept_threshold, reject_threshold : float
        Accept if lower >= accept_threshold, reject if upper <= reject_threshold.

    Returns
    -------
    int
        The `ActionCode`; VERIFY if neither threshold is reached, ACCEPT if both are.
    """
    if lower >= accept_threshold:
        return ActionCode.ACCEPT.value
    return ActionCode.REJECT.value if upper <= reject_threshold else ActionCode.VERIFY.value


class DecisionRule(nn.Module):
    """The paper's rule: accept if lower >= LB, reject if upper <= 1 - LB.

    A rule that learns from outcomes is a subclass. It overrides `update` and `action`, perhaps
    `observe`, and keeps what it learned in buffers of fixed shape: a store keeps these with each
    model version. If its `update` raises, the engine verifies every part until the store is opened
    again, and then updates a fresh rule with all outcomes.

    Parameters
    ----------
    alpha : float
        Error level of the interval.
    lower_bound : float
        The paper's LB.
    interval : str, default "wilson"
        A name in `INTERVALS`.

    Attributes
    ----------
    compiles : bool
        Class attribute: whether TorchScript can compile the class. If False, the rule answers in
        Python and cannot be exported.
    sorts : bool
        Class attribute: whether the bound only sorts parts, so that any score could take its place.
    prior_labels : float
        Class attribute: how strongly a predicted probability is drawn towards 1/2 while labels are
        few, as a number of labels (`neighbours.fade`); 0: not at all.
    scriptable : bool
        Whether this rule with its interval can be compiled.
    accept_threshold, reject_threshold : float
        LB and 1 - LB.
    bound : callable
        (n_success, n_failure, z) -> lower, upper.
    z : float
        Normal quantile of the interval.
    extra_arguments : tuple
        Further positional arguments that `clone` passes to the class.
    """

    compiles = True
    sorts = False
    prior_labels = 0.0

    def __init__(self, alpha: float, lower_bound: float, interval: str = "wilson") -> None:
        super().__init__()
        self.alpha = float(alpha)
        self.accept_threshold = float(lower_bound)
        self.reject_threshold = 1.0 - self.accept_threshold
        self.interval = interval
        error_level = SORTING_ERROR_LEVEL if self.sorts else self.alpha
        self.z = normal_quantile(error_level)
        self.scriptable = self.compiles and interval in SCALAR_BOUNDS
        self.bound = SCALAR_BOUNDS.get(interval, partial(scalar_interval, interval, error_level))
        self.extra_arguments: tuple[Any, ...] = ()

    def forward(self, n_success: int, n_failure: int) -> tuple[int, float, float]:
        """Return (`ActionCode`, lower, upper) for label counts, 0 or more.

        The two ends bound the success probability by the rule's interval; `action` chooses the
        action. Nothing is learned.
        """
        lower, upper = self.bound(n_success, n_failure, self.z)
        return self.action(lower, upper), lower, upper

    def action(self, lower: float, upper: float) -> int:
        """Return what a bound allows at present, as its `ActionCode`.

        The paper's rule accepts if `lower` is at least the accept threshold, otherwise rejects if
        `upper` is at most the reject threshold, and otherwise verifies.
        """
        return action_of(lower, upper, self.accept_threshold, self.reject_threshold)

    @jit.export
    def update(
        self,
        lower: float,
        upper: float,
        success: bool,
        predicted: int = 0,
        inclusion_probability: float = 1.0,
    ) -> None:
        """Learn the outcome of a part; the paper's rule learns nothing.

        Parameters
        ----------
        lower, upper : float
            The bound by which the part was decided, from before its label was known.
        success : bool
            Its label.
        predicted : int, default 0
            `ActionCode` of what the model alone would have done.
        inclusion_probability : float, default 1.0
            Probability, fixed beforehand, that the outcome of this part would be asked for: 1 for a
            check, the audit rate for an audit, 0 for a line stop or a confirmation.
        """

    @jit.export
    def observe(self, n_unreported: int, novel: bool) -> None:
        """Take note of what is known without a label; called before each `update`.

        The paper's rule does nothing.

        Parameters
        ----------
        n_unreported : int
            Number of accepted parts since the last label; their outcomes stay unknown.
        novel : bool
            Whether the trace of the part at hand was novel.
        """

    @jit.export
    def safe_mode(self) -> int:
        """Return why the safe mode began: a position in `SAFE_MODES`, 0 outside of one.

        The paper's rule has no safe mode: it always returns 0.
        """
        return 0

    @jit.unused
    def start_in_safe_mode(self, safe_mode: int) -> None:
        """Start in a safe mode, like after an alarm; here it does nothing.

        `safe_mode` is a `SafeMode`. A rule without a safe mode, like the paper's, ignores it.
        """

    @jit.unused
    def clone(self) -> Self:
        """Return a rule with the same settings that has learned nothing."""
        return type(self)(self.alpha, self.accept_threshold, self.interval, *self.extra_arguments)

    @jit.unused
    def learns(self) -> bool:
        """Return whether the rule can learn: it has buffers, or its own `update` or `observe`."""
        methods = (type(self).update, type(self).observe)
        return bool(self.state_dict()) or methods != (DecisionRule.update, DecisionRule.observe)
