"""From an embedding to an action: count, bound, decide. It scripts: the engine and the exported file share it."""

import math
from typing import Any

import torch
from torch import Tensor, nn

from .bounds import INTERVALS, normal_quantile
from .neighbors import ReferenceRing
from .policy import Neighbourhood, Policy
from .records import Action

SCRIPTED_INTERVALS = ("wilson", "binomial")
VERIFY, ACCEPT, REJECT = (list(Action).index(a) for a in (Action.VERIFY, Action.ACCEPT, Action.REJECT))


class Judge(nn.Module):
    """Counts the references around one embedded trace, bounds its success probability, and decides.

    Two looks, one for each tail of the interval: the wide ball may accept; where it does not, the narrow one may reject.
    The counts and the bound that come back are those of the ball that decided, so `decide` follows from them alone.
    """

    def __init__(self, ring: ReferenceRing, neighbourhood: Neighbourhood, policy: Policy) -> None:
        super().__init__()
        self.ring = ring
        self.radius = float(neighbourhood.radius)
        self.fraction = float(neighbourhood.fraction or 0.0)
        self.reject_fraction = float(neighbourhood.reject_fraction or 0.0)
        self.z = float(normal_quantile(policy.alpha))
        self.alpha = float(policy.alpha)
        self.lower_bound = float(policy.lower_bound)
        self.interval = policy.interval

    def forward(self, z: Tensor) -> tuple[int, float, float, int, int]:
        """(K, d) float32 scaled embedding -> action (0 verify, 1 accept, 2 reject), lower, upper, n_success, n_failure."""
        distances = self.ring.squared_distances(z)
        n_success, n_failure = self.ring.count_near(distances, self.radius, self.fraction)
        lower, upper = self.bound(n_success, n_failure)
        action = self.action(lower, upper)
        if action == 0 and self.reject_fraction > 0.0:
            few_success, few_failure = self.ring.count_near(distances, self.radius, self.reject_fraction)
            few_lower, few_upper = self.bound(few_success, few_failure)
            if self.action(few_lower, few_upper) == 2:
                return 2, few_lower, few_upper, few_success, few_failure
        return action, lower, upper, n_success, n_failure

    def action(self, lower: float, upper: float) -> int:
        """0 verify, 1 accept, 2 reject: the position in `Action`."""
        if lower >= self.lower_bound:
            return 1
        return 2 if upper <= 1.0 - self.lower_bound else 0

    def bound(self, n_success: int, n_failure: int) -> tuple[float, float]:
        """`wilson_interval` or `binomial_interval` of two scalars; the same formulas, without NumPy."""
        k = float(n_success + n_failure)
        if k == 0.0:
            return 0.0, 1.0
        rate, z = n_success / k, self.z
        if self.interval == "wilson":
            centre = (n_success + z * z / 2.0) / (k + z * z)
            half = z / (k + z * z) * math.sqrt(n_success * n_failure / k + z * z / 4.0)
        else:
            centre = rate
            half = z / math.sqrt(k) * math.sqrt(n_success * n_failure / (k * k))
        return max(0.0, min(centre - half, rate)), min(1.0, max(centre + half, rate))


class TableJudge(Judge):
    """The same for an interval that needs SciPy's special functions; cannot be scripted."""

    def bound(self, n_success: int, n_failure: int) -> tuple[float, float]:
        """Any of `INTERVALS`."""
        lower, upper = INTERVALS[self.interval](n_success, n_failure, self.alpha)
        return float(lower), float(upper)


def make_judge(ring: ReferenceRing, neighbourhood: Neighbourhood, policy: Policy) -> Judge:
    """A judge for any interval; a scriptable one where the interval allows it."""
    kind = Judge if policy.interval in SCRIPTED_INTERVALS else TableJudge
    return kind(ring, neighbourhood, policy)


def script(module: nn.Module) -> Any:
    """`torch.jit.script` without its deprecation notice: it works in the supported range of torch."""
    import warnings

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r".*torch\.jit\..* is deprecated.*")
        return torch.jit.script(module)
