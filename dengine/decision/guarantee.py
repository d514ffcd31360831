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
"""

import math

import torch
from torch import Tensor

from .betting import log_evidence
from .rule import DecisionRule, action_of

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
