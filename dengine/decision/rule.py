"""The decision rule: counts -> interval -> action. The one place where a bound meets the user's tolerance.

    >>> rule = Policy(alpha=0.1, lower_bound=0.9).rule()
    >>> rule(40, 0)                      # 40 successes, no failure: (1, 0.93..., 1.0), accept

It compiles to TorchScript: the engine, the scikit-learn classifier and the exported file run the same lines. A rule is
asked (`forward`), told what became of a decision (`tell`) and restored (its buffers, by `state_dict`).

*Local.* The paper's rule, of the ball around one trace; it learns nothing.

*Pooled.* Levels of the local lower bound go down from LB in steps of half the tolerance. The members of a level are all
traces whose lower bound reached it when they were decided, before their label was known. A level holds while its members'
known outcomes say, at level alpha however often one looks, that their mean failure probability is at most the tolerance
(`certificate.log_evidence`). Levels are asked in order, the strictest first, each only while the stricter ones hold: alpha
is spent once (fixed-sequence testing: Maurer, Hothorn and Lehmacher, 1995). A part is accepted where its lower bound
reaches the lowest level that holds. Rejections are the mirror image, on 1 - upper, and a guarantee as far as audits go.

*Safe mode.* A claim on the mean of all members is slow to notice drift. So what is accepted is watched by a restarting
test (an e-detector of the CUSUM kind: Shin, Ramdas and Rinaldo, 2023, arXiv:2203.03532), and so is the share of novel
traces. At an alarm everything is verified, and what held must be shown anew, by members decided since.
"""

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from ..records import REASONS, Reason
from .certificate import log_evidence
from .intervals import INTERVALS, normal_quantile
from .references import ReferenceRing

CERTAIN, UNCERTAIN, SAFE = (REASONS.index(r) for r in (Reason.CERTAIN, Reason.UNCERTAIN, Reason.SAFE_MODE))
SAFE_MODE = (  # why everything is verified, by position: the integers of exported files
    "",
    "accepted parts failed more often than the tolerance",
    "rejected parts were good more often than the tolerance",
    "too many traces were novel",
)
LOWEST = 0.3  # no level below: such a ball says little of a part
BETS = [0.37, 0.72]  # best for failure rates of two thirds and of a third of the tolerance; few, since each costs evidence
NOBODY = 2.0  # a level that no bound reaches
FALSE_ALARMS = 100.0  # at the tolerance itself, one in 100 / alpha watched parts on average at most
WATCH_BET = 0.5  # of the largest


def action_of(lower: float, upper: float, accept_at: float, reject_at: float) -> int:
    """The position in `Action` that a bound allows: 1 accept, 2 reject, else 0 verify."""
    if lower >= accept_at:
        return 1
    return 2 if upper <= reject_at else 0


def wilson_bound(n_success: int, n_failure: int, z: float) -> tuple[float, float]:
    """`intervals.wilson_interval` of two scalars, at the normal quantile z."""
    k = float(n_success + n_failure)
    if k == 0.0:
        return 0.0, 1.0
    rate = n_success / k
    centre = (n_success + z * z / 2.0) / (k + z * z)
    half = z / (k + z * z) * math.sqrt(n_success * n_failure / k + z * z / 4.0)
    return max(0.0, min(centre - half, rate)), min(1.0, max(centre + half, rate))


def binomial_bound(n_success: int, n_failure: int, z: float) -> tuple[float, float]:
    """`intervals.binomial_interval` of two scalars, at the normal quantile z."""
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


class Evidence(nn.Module):
    """What a rule has seen: members of its levels, drift detectors, and the level that each side must reach.

    levels : of evidence, the strictest first.
    assumed : whether the first level holds until an alarm, as the paper's does; else each must be shown.

    Side 0 accepts, side 1 rejects; novelty is watched besides, as 2. The score of an accept is the lower bound, of a reject
    1 - upper.  open (2,) float64: the level that a part's score must reach, by side.  members (2, 2, L, 2) int64: by side,
    ever and since the last alarm, of each level, parts of known outcome and the wrong ones among them.  watch (3,) float64:
    log capital of the detectors.  mode () int64: position in `SAFE_MODE`.
    """

    open: Tensor
    members: Tensor
    watch: Tensor
    mode: Tensor

    def __init__(self, alpha: float, tolerance: float, levels: list[float], assumed: bool) -> None:
        super().__init__()
        self.tolerance, self.levels, self.assumed = tolerance, levels, assumed
        self.enough = math.log(1.0 / alpha)
        self.alarm_at = math.log(FALSE_ALARMS / alpha)
        self.bets = BETS
        self.nobody = NOBODY
        # A detector bets on too many: steps of its log capital for a wrong part, and for a right one.
        shares = [tolerance, tolerance, 0.2]  # the share of novel traces that a stream may have
        self.worse = [math.log1p(WATCH_BET / share * (1.0 - share)) for share in shares]
        self.better = math.log1p(-WATCH_BET)
        self.register_buffer("members", torch.zeros(2, 2, len(levels), 2, dtype=torch.int64))
        self.register_buffer("watch", torch.zeros(3, dtype=torch.float64))
        self.register_buffer("mode", torch.zeros((), dtype=torch.int64))
        self.register_buffer("open", torch.full((2,), levels[0] if assumed else NOBODY, dtype=torch.float64))

    def action(self, lower: float, upper: float) -> int:
        """What a bound allows at this moment; a part that could as well be accepted as rejected is verified."""
        accept_at, reject_at = float(self.open[0].item()), 1.0 - float(self.open[1].item())
        if lower >= accept_at and upper <= reject_at:
            return 0
        return action_of(lower, upper, accept_at, reject_at)

    def observe(self, silent: int, novel: bool) -> None:
        """Update the detectors: parts of unknown outcome did not fail as far as is known; they and this may be novel."""
        self.step(0, self.better, silent)
        self.step(2, self.better, silent)
        self.step(2, self.worse[2] if novel else self.better, 1)

    def tell(self, lower: float, upper: float, success: bool) -> None:
        """Count a part among the members of every level that its scores reach, and ask the levels anew."""
        self.count(0, lower, not success)
        self.count(1, 1.0 - upper, success)
        if int(self.mode.item()) != 0 and float(self.open.min().item()) < self.nobody:
            self.mode.zero_()

    def count(self, side: int, score: float, wrong: bool) -> None:
        """One more member of known outcome, of the levels that its score reaches."""
        if score >= float(self.open[side].item()):
            self.step(side, self.worse[side] if wrong else self.better, 1)
        above = 0
        for level in self.levels:
            above += int(level > score)
        if above == len(self.levels):
            return
        reached = self.members[side, :, above:]
        reached[:, :, 0].add_(1)
        if wrong:
            reached[:, :, 1].add_(1)
        self.ask(side)

    def step(self, watched: int, step: float, times: int) -> None:
        """Equal steps of a detector, which restarts from 0 wherever it falls below; its alarm starts the safe mode."""
        if times <= 0 or int(self.mode.item()) != 0:
            return
        before = float(self.watch[watched].item())
        capital = max(before + (times - 1) * step, 0.0) + step  # of equal steps down, none but the last can start from 0
        self.watch[watched].fill_(capital)
        if capital >= self.alarm_at:
            self.alarm(watched + 1)

    def alarm(self, mode: int) -> None:
        """Let nothing pass until what held is shown anew; mode : the position in `SAFE_MODE`."""
        self.watch.zero_()
        self.members[:, 1].zero_()
        self.open.fill_(self.nobody)
        self.mode.fill_(mode)

    def ask(self, side: int) -> None:
        """Open the lowest level that holds; an assumed one only closes by an alarm, and is shown by members since."""
        ever: list[list[int]] = self.members[side, 0].tolist()
        since: list[list[int]] = self.members[side, 1].tolist()
        if self.assumed:
            if float(self.open[side].item()) >= self.nobody and self.shown(since[0]):
                self.open[side].fill_(self.levels[0])  # assigned, a scripted float goes through float32
            return
        lowest = self.nobody
        for i, level in enumerate(self.levels):
            if not (self.shown(ever[i]) and (since[i] == ever[i] or self.shown(since[i]))):
                break
            lowest = level
        self.open[side].fill_(lowest)

    def shown(self, members: list[int]) -> bool:
        """Whether a level's members say that their mean failure probability keeps the tolerance."""
        return log_evidence(members[0], members[1], self.tolerance, 1.0, self.bets) >= self.enough


class DecisionRule(nn.Module):
    """The paper's rule, and the base of any other: accept where lower >= LB, reject where upper <= 1 - LB.

    alpha, lower_bound, interval : as in `Policy`.  evidence : what opens and closes levels in place of LB; None: nothing.
    compiles : whether TorchScript can compile the class; one that says False answers in Python and is not exported.

    A rule that learns overrides `tell` and `action`, and keeps all that it learned in buffers of a fixed shape, which a
    store keeps with each version. A rule whose `tell` raises is not asked any more: every part is verified until the engine
    is opened again, which tells it everything from the beginning.
    """

    compiles = True

    def __init__(
        self, alpha: float, lower_bound: float, interval: str = "wilson", evidence: Evidence | None = None
    ) -> None:
        super().__init__()
        self.alpha = float(alpha)
        self.accept_at = float(lower_bound)
        self.reject_at = 1.0 - float(lower_bound)
        self.interval = interval
        self.z = float(normal_quantile(alpha))
        self.scriptable = self.compiles and interval in SCALAR_BOUNDS  # what an export needs
        self.bound: Bound = SCALAR_BOUNDS.get(interval, TableBound(interval, float(alpha)))
        self.evidence = evidence

    def forward(self, n_success: int, n_failure: int) -> tuple[int, float, float]:
        """Counts in a ball -> action (0 verify, 1 accept, 2 reject), lower, upper."""
        lower, upper = self.bound(n_success, n_failure, self.z)
        return self.action(lower, upper), lower, upper

    def action(self, lower: float, upper: float) -> int:
        """What a bound allows at this moment: the position in `Action`."""
        if self.evidence is not None:
            return self.evidence.action(lower, upper)
        return action_of(lower, upper, self.accept_at, self.reject_at)

    @torch.jit.export
    def tell(self, lower: float, upper: float, success: bool) -> None:
        """What became of a part: the bound that it was decided by, before its label was known, and the label."""
        if self.evidence is not None:
            self.evidence.tell(lower, upper, success)

    @torch.jit.export
    def observe(self, silent: int, novel: bool) -> None:
        """Before each `tell`: accepted parts of unknown outcome since the last label; was this trace novel?"""
        if self.evidence is not None:
            self.evidence.observe(silent, novel)

    @torch.jit.export
    def safe_mode(self) -> int:
        """Why everything is verified at present: the position in `SAFE_MODE`, 0 where it is not."""
        return 0 if self.evidence is None else int(self.evidence.mode.item())

    @torch.jit.unused
    def begin_in(self, mode: int) -> None:
        """Begin in a safe mode, where the rule has one, as after its alarm; 0: as it is."""
        if self.evidence is not None and mode:
            self.evidence.alarm(mode)

    @torch.jit.unused
    def learns(self) -> bool:
        """Whether it can learn from what it is told: it has a buffer, or a `tell` or `observe` of its own."""
        kind = type(self)
        return bool(self.state_dict()) or (kind.tell, kind.observe) != (DecisionRule.tell, DecisionRule.observe)


class WatchedRule(DecisionRule):
    """The paper's rule with a safe mode: for cells in which silence after an accept counts as a success."""

    def __init__(self, alpha: float, lower_bound: float, interval: str = "wilson") -> None:
        levels = [float(lower_bound)]
        super().__init__(alpha, lower_bound, interval, Evidence(alpha, 1.0 - float(lower_bound), levels, assumed=True))


class PooledRule(DecisionRule):
    """Accept where the local lower bound reaches the lowest level that holds; reject likewise, on 1 - upper."""

    def __init__(self, alpha: float, lower_bound: float, interval: str = "wilson") -> None:
        tolerance = 1.0 - float(lower_bound)
        step = 0.5 * tolerance
        levels = [float(lower_bound) - i * step for i in range(int((lower_bound - LOWEST) / step + 1e-9) + 1)]
        super().__init__(alpha, lower_bound, interval, Evidence(alpha, tolerance, levels, assumed=False))


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

    One at a time: two threads that parse at once made Python's parser raise "AST constructor recursion depth mismatch".
    """
    import warnings

    with _SCRIPTING, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r".*torch\.jit\..* is deprecated.*")
        return torch.jit.script(module)
