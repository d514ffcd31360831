"""The decision rule: counts -> interval -> action. The one place where a bound meets the user's tolerance.

    >>> rule = Policy(alpha=0.1, lower_bound=0.9).rule()
    >>> rule(40, 0)                      # 40 successes, no failure: (1, 0.93..., 1.0), accept

The functions and the modules here compile to TorchScript: the engine, the scikit-learn classifier and the exported file
run the same lines. A rule can be asked (`forward`), told what became of a decision (`tell`) and restored (its buffers,
by `state_dict`); the paper's rule learns nothing from being told. `guarantee.py` has those that do.
"""

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from ..records import REASONS, Reason
from .bounds import INTERVALS, normal_quantile
from .neighbors import ReferenceRing


def action_of(lower: float, upper: float, accept_at: float, reject_at: float) -> int:
    """The position in `Action` that a bound allows: 1 accept, 2 reject, else 0 verify."""
    if lower >= accept_at:
        return 1
    return 2 if upper <= reject_at else 0


def wilson_bound(n_success: int, n_failure: int, z: float) -> tuple[float, float]:
    """`bounds.wilson_interval` of two scalars, at the normal quantile z."""
    k = float(n_success + n_failure)
    if k == 0.0:
        return 0.0, 1.0
    rate = n_success / k
    centre = (n_success + z * z / 2.0) / (k + z * z)
    half = z / (k + z * z) * math.sqrt(n_success * n_failure / k + z * z / 4.0)
    return max(0.0, min(centre - half, rate)), min(1.0, max(centre + half, rate))


def binomial_bound(n_success: int, n_failure: int, z: float) -> tuple[float, float]:
    """`bounds.binomial_interval` of two scalars, at the normal quantile z."""
    k = float(n_success + n_failure)
    if k == 0.0:
        return 0.0, 1.0
    rate = n_success / k
    half = z / math.sqrt(k) * math.sqrt(n_success * n_failure / (k * k))
    return max(0.0, min(rate - half, rate)), min(1.0, max(rate + half, rate))


@dataclass(frozen=True)
class TableBound:
    """Any of `INTERVALS` on two scalars, for those that need SciPy's special functions; it does not compile."""

    interval: str
    alpha: float

    def __call__(self, n_success: int, n_failure: int, z: float) -> tuple[float, float]:
        """(lower, upper); z is not used."""
        lower, upper = INTERVALS[self.interval](n_success, n_failure, self.alpha)
        return float(lower), float(upper)


Bound = Callable[[int, int, float], tuple[float, float]]
SCALAR_BOUNDS: dict[str, Bound] = {"wilson": wilson_bound, "binomial": binomial_bound}


CERTAIN, UNCERTAIN, SAFE = (REASONS.index(r) for r in (Reason.CERTAIN, Reason.UNCERTAIN, Reason.SAFE_MODE))
SAFE_MODE = (  # why everything is verified, by position: the integers of exported files
    "",
    "accepted parts failed more often than the tolerance",
    "rejected parts were good more often than the tolerance",
    "too many traces were novel",
)


class DecisionRule(nn.Module):
    """The paper's rule, and the base of any other: accept where lower >= LB, reject where upper <= 1 - LB.

    alpha, lower_bound, interval : as in `Policy`.
    compiles : whether TorchScript can compile the class; one that says False answers in Python and is not exported.

    A rule that learns overrides `tell` and `action`, and keeps all that it learned in buffers of a fixed shape: the
    compiled module shares them, a store keeps them with each version, and `DataEngine.open` restores them and tells what
    came afterwards. A rule whose `tell` raises is not asked any more: every part is verified until the engine is opened
    again, which tells it everything from the beginning.
    """

    compiles = True

    def __init__(self, alpha: float, lower_bound: float, interval: str = "wilson") -> None:
        super().__init__()
        self.alpha = float(alpha)
        self.accept_at = float(lower_bound)
        self.reject_at = 1.0 - float(lower_bound)
        self.interval = interval
        self.z = float(normal_quantile(alpha))
        self.scriptable = self.compiles and interval in SCALAR_BOUNDS  # what an export needs
        self.bound: Bound = SCALAR_BOUNDS.get(interval, TableBound(interval, float(alpha)))

    def forward(self, n_success: int, n_failure: int) -> tuple[int, float, float]:
        """Counts in a ball -> action (0 verify, 1 accept, 2 reject), lower, upper."""
        lower, upper = self.bound(n_success, n_failure, self.z)
        return self.action(lower, upper), lower, upper

    def action(self, lower: float, upper: float) -> int:
        """What a bound allows at this moment: the position in `Action`."""
        return action_of(lower, upper, self.accept_at, self.reject_at)

    @torch.jit.export
    def tell(self, lower: float, upper: float, success: bool) -> None:
        """What became of a part: the bound that it was decided by, before its label was known, and the label."""

    @torch.jit.export
    def note(self, silent: int, novel: bool) -> None:
        """What is known beside, before each `tell`: accepted parts that went on since the last one and of which nothing was
        heard, and whether this part was like nothing learned from.
        """

    @torch.jit.export
    def safe_mode(self) -> int:
        """Why everything is verified at present: the position in `SAFE_MODE`, 0 where it is not."""
        return 0

    @torch.jit.unused
    def begin_in(self, mode: int) -> None:
        """Begin in a safe mode, where the rule has one, as after its alarm."""


def learns(rule: DecisionRule) -> bool:
    """Whether a rule can learn from what it is told: it has a buffer, or a `tell` of its own."""
    kind = type(rule)
    return bool(rule.state_dict()) or (kind.tell, kind.note) != (DecisionRule.tell, DecisionRule.note)


class RadiusNeighbours(nn.Module):
    """Counts the references around one embedded trace and asks the rule.

    Two looks, one for each tail of the interval: the wide ball may accept; where it does not, the narrow one may reject.
    The counts and the bound that come back are those of the ball that decided, so the action follows from them alone.

    radius, fraction, reject_fraction : as in `Neighbourhood`, 0 for None.
    """

    def __init__(
        self, ring: ReferenceRing, rule: DecisionRule, radius: float, fraction: float = 0.0, reject_fraction: float = 0.0
    ) -> None:
        super().__init__()
        self.ring: ReferenceRing = ring
        self.rule: DecisionRule = rule
        self.radius, self.fraction, self.reject_fraction = float(radius), float(fraction), float(reject_fraction)
        self.certain, self.uncertain, self.safe = CERTAIN, UNCERTAIN, SAFE

    @torch.jit.export
    def reason(self, action: int) -> int:
        """Why the action is what it is: the position in `Reason`."""
        if action != 0:
            return self.certain
        return self.uncertain if self.rule.safe_mode() == 0 else self.safe

    def forward(self, z: Tensor, part: int = 0) -> tuple[int, float, float, int, int]:
        """(K, d) float32 scaled embedding -> action (0 verify, 1 accept, 2 reject), lower, upper, n_success, n_failure.

        part : the hash of its part, which has no vote; 0 for an unknown one.
        """
        distances = self.ring.squared_distances(z, part)
        n_success, n_failure = self.ring.count_near(distances, self.radius, self.fraction)
        action, lower, upper = self.rule(n_success, n_failure)
        if action == 0 and self.reject_fraction > 0.0:
            few_success, few_failure = self.ring.count_near(distances, self.radius, self.reject_fraction)
            few_action, few_lower, few_upper = self.rule(few_success, few_failure)
            if few_action == 2:
                return 2, few_lower, few_upper, few_success, few_failure
        return action, lower, upper, n_success, n_failure


_SCRIPTING = threading.Lock()


def script(module: nn.Module) -> Any:
    """`torch.jit.script` without its deprecation notice: it works in the supported range of torch.

    One at a time: two threads that parse at once, as two replays or an engine and its executor may, made Python's parser
    raise "AST constructor recursion depth mismatch".
    """
    import warnings

    with _SCRIPTING, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r".*torch\.jit\..* is deprecated.*")
        return torch.jit.script(module)
