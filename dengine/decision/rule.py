"""What a rule remembers: the pooled guarantee, and the safe mode.

    Policy(alpha=0.1, lower_bound=0.9, guarantee="pooled", stops="all")

*Pooled.* One scale serves every reducer and interval: the local lower bound. Levels go down from LB in steps of half the
tolerance. The members of a level are all traces whose lower bound reached it when they were decided, before their label was
known: predict, then learn, which is honest under any model. A level holds while its members' known outcomes say, at level
alpha however often one looks, that their mean failure probability is at most the tolerance (`betting.log_evidence`).
Levels are asked in order, the strictest first, each only while the stricter ones hold, so that the first untrue claim
ends the search and alpha is spent once (fixed-sequence testing: Maurer, Hothorn and Lehmacher, 1995). A part is accepted
where its lower bound reaches the lowest level that holds, and nowhere else. Rejections are the mirror image, on 1 -
upper; since a rejected part tells nothing of itself, theirs is a guarantee only as far as audits go.

*Safe mode.* A claim on the mean of all members is slow to notice that the world has changed. So what is accepted is
watched by a restarting test (an e-detector of the CUSUM kind: Shin, Ramdas and Rinaldo, 2023, arXiv:2203.03532), and so
is the share of novel traces. At an alarm everything is verified, and what held must be shown anew, by members decided
since.

Evidence by betting: how surely a running mean failure probability lies below a tolerance, at any moment.

    >>> log_evidence(60, 1, 0.1) >= math.log(1 / 0.1)     # 60 parts, one of them bad: surely below 10 %, at level 0.1

A gambler with 1 bets the same b on every part, that it will be good. With x = 1 for a bad part that was looked at, else 0:

    capital(theta) = product of (1 - b)^x / (1 - b q theta),   q the propensity, theta the tolerance.

In place of theta put each part's own failure probability p_i, whatever it is and however it depends on the past: x has the
mean q p_i, so the product M is a martingale that begins at 1, and by Ville's inequality M ever reaches 1 / alpha with
probability alpha at most. The logarithm is concave, so capital(mean of p_1 ... p_n) <= M, at every n at once. Hence
"ever capital(running mean) >= 1 / alpha" has probability alpha at most: no stationarity, one may look after every part, and
the running mean may move. For that last one b must not depend on theta; as a stake it is l = b q / (1 - b q theta) on
1 + l (theta - x / q), inverse probability weighting. The capital grows with theta, so what is not refuted is an interval.

Nobody knows the best b beforehand (1 - odds(q p) / odds(q theta), where all parts have one p), so the capital is a mixture.
Its weights are as the bets: large bets matter while n is small, where a constant factor costs most.

Sources: Ville (1939); Waudby-Smith and Ramdas (2024), JRSS B 86(1); mixtures over bets: Robbins (1970), AMS 41(5).

The decision rule: counts -> interval -> action. The one place where a bound meets the user's tolerance.

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
from .intervals import INTERVALS, normal_quantile
from .references import ReferenceRing


def log_evidence(n: int, n_bad: int, tolerance: float, propensity: float = 1.0, bets: list[float] | None = None) -> float:
    """Log capital of a mixture of constant bets that the mean failure probability of n parts is below `tolerance`.

    n : parts, looked at or not.  n_bad : those of them that were looked at and were bad.  tolerance : in [0, 1].
    propensity : in (0, 1], the probability with which each part was looked at, whatever it is; a bad one that was looked at
        then stands for 1 / propensity. Where it changed, the smallest: that is on the safe side.
    bets : in (0, 1), fixed beforehand; None: a grid for any rate. Few are sharper where the rate is about known.
    It grows with `tolerance` and falls with `n_bad`. Compiles to TorchScript.
    """
    if bets is None:
        bets = [0.05, 0.1, 0.2, 0.4, 0.7, 0.98]  # never 1: one bad part would lose all for ever
    rate = propensity * tolerance
    logs = [n_bad * math.log1p(-bet) - n * math.log1p(-bet * rate) for bet in bets]
    top = max(logs)
    capital = 0.0
    weights = 0.0  # summed in the same order, so that no parts are no evidence, exactly
    for bet, log in zip(bets, logs):  # noqa: B905  strict is not TorchScript
        capital += bet * math.exp(log - top)
        weights += bet
    return top + math.log(capital / weights)


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


LOWEST = 0.3  # no level below: such a ball says little of a part
BETS = [0.37, 0.72]  # best for failure rates of two thirds and of a third of the tolerance; few, since each costs evidence
NOBODY = 2.0  # a level that no bound reaches
FALSE_ALARMS = 100.0  # at the tolerance itself, one in 100 / alpha watched parts on average at most
NOVEL_SHARE = 0.2  # that a stream may have
WATCH_BET = 0.5  # of the largest


class WatchedRule(DecisionRule):
    """The paper's rule with a safe mode: for cells in which silence after an accept counts as a success.

    Side 0 accepts, side 1 rejects; novelty is watched besides, as 2.

    open (2,) float64: the level that a part's score must reach, by side; the score of an accept is the lower bound, of a
    reject 1 - upper.  members (2, 2, L, 2) int64: by side, ever and since the last alarm, of each level, parts of known
    outcome and the wrong ones among them.  watch (3,) float64: log capital of the detectors.  mode () int64: position in
    `SAFE_MODE`.
    """

    open: Tensor
    members: Tensor
    watch: Tensor
    mode: Tensor

    def __init__(self, alpha: float, lower_bound: float, interval: str = "wilson") -> None:
        super().__init__(alpha, lower_bound, interval)
        self.tolerance = 1.0 - float(lower_bound)
        self.enough = math.log(1.0 / alpha)
        self.alarm_at = math.log(FALSE_ALARMS / alpha)
        self.bets = BETS
        self.nobody = NOBODY
        # A detector bets on too many: steps of its log capital for a wrong part, and for a right one.
        shares = [self.tolerance, self.tolerance, NOVEL_SHARE]
        self.worse = [math.log1p(WATCH_BET / share * (1.0 - share)) for share in shares]
        self.better = math.log1p(-WATCH_BET)
        self.levels = self.make_levels()
        self.register_buffer("members", torch.zeros(2, 2, len(self.levels), 2, dtype=torch.int64))
        self.register_buffer("watch", torch.zeros(3, dtype=torch.float64))
        self.register_buffer("mode", torch.zeros((), dtype=torch.int64))
        self.register_buffer("open", torch.full((2,), self.at_first(), dtype=torch.float64))

    def make_levels(self) -> list[float]:
        """The levels of evidence, the strictest first."""
        return [self.accept_at]

    def at_first(self) -> float:
        """The level that holds before anything is known."""
        return self.accept_at

    def action(self, lower: float, upper: float) -> int:
        """What a bound allows at this moment; a part that could as well be accepted as rejected is verified."""
        accept_at, reject_at = float(self.open[0].item()), 1.0 - float(self.open[1].item())
        if lower >= accept_at and upper <= reject_at:
            return 0
        return action_of(lower, upper, accept_at, reject_at)

    @torch.jit.export
    def safe_mode(self) -> int:
        """Position in `SAFE_MODE`; 0: parts may pass."""
        return int(self.mode.item())

    @torch.jit.export
    def note(self, silent: int, novel: bool) -> None:
        """Accepted parts of which nothing was heard did not fail as far as is known; they and this part may be novel."""
        self.step(0, self.better, silent)
        self.step(2, self.better, silent)
        self.step(2, self.worse[2] if novel else self.better, 1)

    @torch.jit.export
    def tell(self, lower: float, upper: float, success: bool) -> None:
        """Count a part among the members of every level that its scores reach, and ask the levels anew."""
        self.count(0, lower, not success)
        self.count(1, 1.0 - upper, success)
        if int(self.mode.item()) != 0 and (self.holds(0) or self.holds(1)):
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

    @torch.jit.unused
    def begin_in(self, mode: int) -> None:
        """As after the alarm of that mode; 0: as it is."""
        if mode:
            self.alarm(mode)

    def holds(self, side: int) -> bool:
        """Whether any level of a side holds."""
        return float(self.open[side].item()) < self.nobody

    def ask(self, side: int) -> None:
        """After an alarm: whether the paper's level was shown to hold since, by each side for itself."""
        if not self.holds(side) and self.shown(self.counts(side, 1)[0]):
            self.open[side].fill_(self.accept_at)  # assigned, a scripted float goes through float32

    def counts(self, side: int, since: int) -> list[list[int]]:
        """(n, wrong) of each level's members, ever (0) or since the last alarm (1)."""
        found: list[list[int]] = self.members[side, since].tolist()
        return found

    def shown(self, members: list[int]) -> bool:
        """Whether a level's members say that their mean failure probability keeps the tolerance."""
        return log_evidence(members[0], members[1], self.tolerance, 1.0, self.bets) >= self.enough


class PooledRule(WatchedRule):
    """Accept where the local lower bound reaches the lowest level that holds; reject likewise, on 1 - upper."""

    def make_levels(self) -> list[float]:
        """LB, and down in steps of half the tolerance."""
        step = 0.5 * self.tolerance
        n = int((self.accept_at - LOWEST) / step + 1e-9) + 1
        return [self.accept_at - i * step for i in range(n)]

    def at_first(self) -> float:
        """None holds."""
        return NOBODY

    def ask(self, side: int) -> None:
        """The lowest level that holds, for all members and for those since the last alarm."""
        lowest, ever, since = self.nobody, self.counts(side, 0), self.counts(side, 1)
        for i, level in enumerate(self.levels):
            if not (self.shown(ever[i]) and (since[i] == ever[i] or self.shown(since[i]))):
                break
            lowest = level
        self.open[side].fill_(lowest)
