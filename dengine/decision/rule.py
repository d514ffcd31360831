"""The decision rule: counts -> interval -> action. The one place where a bound meets the user's tolerance.

    >>> rule = Policy(alpha=0.1, lower_bound=0.9).rule()
    >>> rule(40, 0)                      # 40 successes, no failure: (1, 0.93..., 1.0), accept

It compiles to TorchScript: the engine, the scikit-learn classifier and the exported file run the same lines. A rule is
asked (`forward`), told what became of a decision (`tell`) and restored (its buffers, by `state_dict`).

*Local.* The paper's rule, about the neighbourhood of one trace. It learns nothing.

*Pooled.* With confidence 1 - alpha, whenever the rule accepts a part, the members so far (the parts whose score reached the
level aimed at, accepted or checked) have failed with a mean probability of at most 1 - LB. The rule accepts only while the
capital of a bet against the opposite is at least 1 / alpha. Statement, assumptions, proof and references:
docs/explanation/pooled_proof.md.

*Priced.* An account of the members, in false accepts, replaces the bet: what accepting them all would have cost beyond
checking them all. The rule accepts while it stands at `ADVANCE` or less; see the same page.

*Safe mode.* A mean over all members reacts late to drift. So a restarting test, a CUSUM against twice the tolerance
(`certificate.cusum`), watches what is accepted and what is rejected, and another one the share of novel traces. After an
alarm everything is verified until members decided since show again that the tolerance is kept, each side for itself. The
safe mode ends when the side that alarmed has shown it; after too many novel traces, when these are few again and either
side has.
"""

import math
import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ..errors import StoreError
from ..records import REASONS, Reason
from .certificate import cusum
from .code import remember_code
from .intervals import INTERVALS, SORTING, normal_quantile
from .references import RadiusIndex

CERTAIN, UNCERTAIN, SAFE = (REASONS.index(r) for r in (Reason.CERTAIN, Reason.UNCERTAIN, Reason.SAFE_MODE))
SAFE_MODE = (  # why everything is verified, by position: the integers of exported files
    "",
    "accepted parts failed more often than the tolerance",
    "rejected parts were good more often than the tolerance",
    "too many traces were novel",
)
LOWEST = 0.3  # no level below: such a ball says little of a part
BET = 0.55  # of the largest; best for failure rates of nearly half of the tolerance
NEWEST = 50  # told parts of a level that are tested by themselves
RARE = 0.2  # probability of so many wrong ones among them at the tolerance itself, at most
NOBODY = 2.0  # a level that no bound reaches
ADVANCE = 1.0  # escapes that the account of the priced rule may stand at: the first accepted parts may be so unlucky
STRICTER = (0.5, 1.0)  # of the tolerance: what a part of a level of the priced rule may fail with
FALSE_ALARMS = 100.0  # at the tolerance itself, one in 100 / alpha watched parts on average at most
NOVEL_SHARE = 0.2  # of the traces of a stream that may be novel
FEW_NOVEL = 25.0  # traces in a row that are not; one that is takes back as many as come with it at that share


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


def table_bound(interval: str, alpha: float, n_success: int, n_failure: int, z: float) -> tuple[float, float]:
    """Any of `INTERVALS` on two scalars, for those that need SciPy's special functions, without z; it does not compile."""
    lower, upper = INTERVALS[interval](n_success, n_failure, alpha)
    return float(lower), float(upper)


Bound = Callable[[int, int, float], tuple[float, float]]
Pair = tuple[float, float]  # by side: of accepts, of rejects
SCALAR_BOUNDS: dict[str, Bound] = {"wilson": wilson_bound, "binomial": binomial_bound}


def most_wrong(tolerance: float) -> int:
    """How many of `NEWEST` may be wrong: more are so with probability `RARE` at most, where each is so by the tolerance."""
    tail, k = 1.0, -1
    while tail > RARE:
        k += 1
        tail -= math.comb(NEWEST, k) * tolerance**k * (1.0 - tolerance) ** (NEWEST - k)
    return k


def log_steps(tolerance: float, rate: float) -> list[float]:
    """Log capital that a checked part adds, and a wrong one besides; then an audited one, of propensity `rate`."""
    stake = BET / (1.0 - BET * tolerance)
    pairs = [(math.log1p(each * tolerance), math.log1p(each * (tolerance - 1.0))) for each in (stake * rate, stake)]
    return [step for good, wrong in pairs for step in (good, wrong - good)]


def weighed(told: list[int], steps: list[float]) -> float:
    """The sum of what so many parts of each kind count for."""
    total = 0.0
    for n, step in zip(told, steps):  # noqa: B905  strict is not TorchScript
        total += n * step
    return total


class Evidence(nn.Module):
    """What a rule has seen: members, what its levels are worth, drift detectors, and the level that each side must reach.

    tolerances : by side, the largest share of wrong decisions.
    levels : by side, of the score, the strictest first; as many on each.
    rate : probability with which the outcome of a certain decision is asked for; 1 where all are known.
    rule : "watched": the first level holds until an alarm, as the paper's does; "pooled": all must be shown, by the bet;
        "priced": by the account.

    Side 0 accepts, side 1 rejects; novelty is watched besides, as 2. The score of an accept is the lower bound, of a reject
    1 - upper.  open (2,) float64: the level that a part's score must reach, by side.  aim (2,) int64: position of the
    level aimed at.  told (2, 2, L + 1, 2, 2) int64: by side, ever and since the last alarm, of the members and then of each
    level, checked and audited, parts and the wrong ones.  newest (2, L, NEWEST) int64: which of its newest were wrong.
    watch (3,) float64: sums of the detectors.  mode () int64: position in `SAFE_MODE`.
    """

    open: Tensor
    aim: Tensor
    told: Tensor
    newest: Tensor
    watch: Tensor
    mode: Tensor

    def __init__(
        self, alpha: float, tolerances: Pair, levels: list[list[float]], rate: float = 1.0, *, rule: str = "pooled"
    ) -> None:
        super().__init__()
        self.levels, self.assumed, self.priced, self.rate = levels, rule == "watched", rule == "priced", rate
        self.enough = math.log(1.0 / alpha)
        self.most, self.span, self.nobody = [most_wrong(each) for each in tolerances], NEWEST, NOBODY
        # By side what counts for it: of a part that was checked, and of a wrong one besides; then of an audited one.
        self.steps = [log_steps(each, rate) for each in tolerances]
        self.least = [-ADVANCE, 0.0]
        self.account = [[each, -1.0, each / rate, -1.0 / rate] for each in tolerances]
        # Of a detector, what a wrong part adds, where a right one takes 1, and the sum that is an alarm.
        detectors = [cusum(share, FALSE_ALARMS / alpha) for share in (*tolerances, NOVEL_SHARE)]
        self.worse, self.alarm_at = [float(step) for step, _ in detectors], [float(limit) for _, limit in detectors]
        self.better, self.few, self.back = -1.0, FEW_NOVEL, 1.0 / NOVEL_SHARE - 1.0
        self.register_buffer("told", torch.zeros(2, 2, len(levels[0]) + 1, 2, 2, dtype=torch.int64))
        self.register_buffer("newest", torch.zeros(2, len(levels[0]), NEWEST, dtype=torch.int64))
        self.register_buffer("watch", torch.zeros(3, dtype=torch.float64))
        self.register_buffer("mode", torch.zeros((), dtype=torch.int64))
        self.register_buffer("aim", torch.zeros(2, dtype=torch.int64))
        first = [each[0] if self.assumed else NOBODY for each in levels]
        self.register_buffer("open", torch.tensor(first, dtype=torch.float64))

    def action(self, lower: float, upper: float) -> int:
        """What a bound allows at this moment; a part that could as well be accepted as rejected is verified."""
        at: list[float] = self.open.tolist()
        if lower >= at[0] and upper <= 1.0 - at[1]:
            return 0
        return action_of(lower, upper, at[0], 1.0 - at[1])

    def observe(self, silent: int, novel: bool) -> None:
        """Update the detectors: parts of unknown outcome did not fail as far as is known; they and this may be novel."""
        self.step(0, self.better, silent)
        mode = int(self.mode.item())
        if mode == 0:
            self.step(2, self.better, silent)
            self.step(2, self.worse[2] if novel else self.better, 1)
        elif mode == 3:  # the other way round
            self.watch[2].fill_(max(float(self.watch[2].item()), 0.0) + (-self.back if novel else 1.0))

    def tell(self, lower: float, upper: float, success: bool, predicted: int, looked: float) -> None:
        """Count a part among the members and in the levels that its scores reach, and ask them anew."""
        self.count(0, lower, not success, predicted, looked)
        self.count(1, 1.0 - upper, success, predicted, looked)
        mode = int(self.mode.item())
        shown = self.open.min() if mode == 3 else self.open[max(0, mode - 1)]
        calm = mode != 3 or float(self.watch[2].item()) >= self.few
        if mode != 0 and calm and float(shown.item()) < self.nobody:
            self.mode.zero_()
            self.watch[2].zero_()

    def count(self, side: int, score: float, wrong: bool, predicted: int, looked: float) -> None:
        """One more part of known outcome, of the levels that its score reaches."""
        if score >= float(self.open[side].item()):
            self.step(side, self.worse[side] if wrong else self.better, 1)
        kind = 0
        if self.rate < 1.0:
            if looked == 0.0:  # it came unasked
                return
            kind = int(looked < 1.0)
        reached, levels = 0, self.levels[side]
        for level in levels:
            reached += int(level <= score)
        # Whatever was certain is a member, where its label came late, too.
        member = reached > len(levels) - 1 - int(self.aim[side].item()) or predicted == side + 1
        if reached == 0 and not member:
            return
        first = len(levels) - reached
        n = self.told[side, 0, 1 + first :, :, 0].sum(1, keepdim=True)  # before it: it takes the place of the oldest
        self.newest[side, first:].scatter_(1, n % self.span, int(wrong))
        counts = self.told[side, :, :, kind]
        for i in range(1 + int(wrong)):
            counts[:, 1 + first :, i].add_(1)
            if member:
                counts[:, 0, i].add_(1)
        self.ask(side)

    def step(self, watched: int, step: float, times: int) -> None:
        """Equal steps of a detector, which restarts from 0 wherever it falls below; its alarm starts the safe mode."""
        if times <= 0:
            return
        before = float(self.watch[watched].item())
        capital = max(before + (times - 1) * step, 0.0) + step  # of equal steps down, none but the last can start from 0
        self.watch[watched].fill_(capital)
        if capital >= self.alarm_at[watched]:
            mode = int(self.mode.item())  # a side that was not shown yet stays the reason
            self.alarm(watched + 1 if mode == 0 or mode == 3 else min(mode, watched + 1))

    def alarm(self, mode: int) -> None:
        """Let nothing pass until what held is shown anew; mode : the position in `SAFE_MODE`."""
        self.watch.zero_()
        self.told[:, 1].zero_()
        self.aim.zero_()
        self.open.fill_(self.nobody)
        self.mode.fill_(mode)

    def ask(self, side: int) -> None:
        """Aim at the lowest level that is good enough, and open it if the members show as much."""
        since: list[list[int]] = self.told[side, 1].flatten(1).tolist()
        ever: list[int] = self.told[side, 0, 0].flatten().tolist()
        if self.assumed:  # only an alarm closes it
            if float(self.open[side].item()) >= self.nobody and self.shown(side, since[1]):
                self.open[side].fill_(self.levels[side][0])  # assigned, a scripted float goes through float32
            return
        wrong: list[int] = self.newest[side].sum(1).tolist()
        lowest = len(wrong) - 1
        while lowest >= 0 and not (wrong[lowest] <= self.most[side] and self.passes(side, since[lowest + 1])):
            lowest -= 1
        self.aim[side].fill_(max(0, lowest))
        anew = since[0] != ever or int(self.mode.item()) != 0
        held = lowest >= 0 and self.passes(side, ever) and (not anew or self.shown(side, since[0]))
        self.open[side].fill_(self.levels[side][lowest] if held else self.nobody)

    def passes(self, side: int, told: list[int]) -> bool:
        """Whether parts, checked and audited, allow more of their kind: by the bet, or by the account."""
        if self.priced:
            return weighed(told, self.account[side]) >= self.least[side]
        return self.shown(side, told)

    def shown(self, side: int, told: list[int]) -> bool:
        """Whether parts, checked and audited, say that their mean failure probability keeps the tolerance."""
        return weighed(told, self.steps[side]) >= self.enough


class DecisionRule(nn.Module):
    """The paper's rule, and the base of any other: accept where lower >= LB, reject where upper <= 1 - LB.

    alpha, lower_bound, interval : as in `Policy`.  evidence : what opens and closes levels in place of LB; None: nothing.
    compiles : whether TorchScript can compile the class; one that says False answers in Python and is not exported.
    sorts : whether its bound only sorts, so that any score would do.

    A rule that learns overrides `tell` and `action`, and keeps all that it learned in buffers of a fixed shape, which a
    store keeps with each version. A rule whose `tell` raises is not asked any more: every part is verified until the engine
    is opened again, which tells it everything from the beginning.
    """

    compiles = True
    sorts = False

    def __init__(self, alpha: float, lower_bound: float, interval: str = "wilson", evidence: Evidence | None = None):
        super().__init__()
        self.alpha = float(alpha)
        self.accept_at = float(lower_bound)
        self.reject_at = 1.0 - float(lower_bound)
        self.interval = interval
        own = SORTING if self.sorts else float(alpha)
        self.z = float(normal_quantile(own))
        self.scriptable = self.compiles and interval in SCALAR_BOUNDS  # what an export needs
        self.bound: Bound = SCALAR_BOUNDS.get(interval, partial(table_bound, interval, own))
        self.evidence = evidence
        self.more: tuple[Any, ...] = ()  # that a rule of ours is made by, behind its interval

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
    def tell(self, lower: float, upper: float, success: bool, predicted: int = 0, looked: float = 1.0) -> None:
        """What became of a part: the bound that it was decided by, before its label was known, and the label.

        predicted : the action that the model alone would have taken.  looked : probability with which its outcome was asked
        for, beforehand: 1 of what was checked, the audits' of an audit, 0 of a stop or a confirmation.
        """
        if self.evidence is not None:
            self.evidence.tell(lower, upper, success, predicted, looked)

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
    def anew(self) -> "DecisionRule":
        """The same rule before it was told anything."""
        return type(self)(self.alpha, self.accept_at, self.interval, *self.more)

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
        tolerance, levels = 1.0 - float(lower_bound), [float(lower_bound)]
        evidence = Evidence(alpha, (tolerance, tolerance), [levels, levels], rule="watched")
        super().__init__(alpha, lower_bound, interval, evidence)


class PooledRule(DecisionRule):
    """Accept what reaches the level aimed at while the members show that it may be; reject likewise.

    rate : as in `Evidence`.
    """

    sorts = True

    def __init__(self, alpha: float, lower_bound: float, interval: str = "wilson", rate: float = 1.0) -> None:
        tolerance = 1.0 - float(lower_bound)
        step = 0.5 * tolerance
        levels = [float(lower_bound) - i * step for i in range(int((lower_bound - LOWEST) / step + 1e-9) + 1)]
        evidence = Evidence(alpha, (tolerance, tolerance), [levels, levels], rate)
        super().__init__(alpha, lower_bound, interval, evidence)
        self.rate, self.more = rate, (rate,)


class PricedRule(DecisionRule):
    """Accept what is expected to cost less than its check while the members' account stands for it; reject likewise.

    tolerances : by side, the share of wrong decisions at which they cost as much as checks, `Policy.tolerances`.
    rate : as in `Evidence`.
    """

    sorts = True

    def __init__(self, alpha: float, lower_bound: float, interval: str, tolerances: Pair, rate: float = 1.0) -> None:
        levels = [[1.0 - share * each for share in STRICTER] for each in tolerances]
        super().__init__(alpha, lower_bound, interval, Evidence(alpha, tolerances, levels, rate, rule="priced"))
        self.more = tolerances, rate


class RadiusNeighbours(nn.Module):
    """Counts the references around one embedded trace and asks the rule.

    radius : of the ball whose labels count, in units of the scaled embedding.
    scored : whether the first axis is each space's probability of success. Where the rule needs but a score, their mean,
        which knows of all labels but the part's own, stands for both ends of the interval; the counts are shown.
    """

    def __init__(self, ring: RadiusIndex, rule: DecisionRule, radius: float, scored: bool = False) -> None:
        super().__init__()
        self.scored = scored
        self.ring: RadiusIndex = ring
        self.rule: DecisionRule = rule
        self.radius = float(radius)
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
        n_success, n_failure = self.ring.count_near(self.ring.squared_distances(z, part), self.radius)
        if self.scored:
            score = float(z.select(1, 0).mean().item())
            return self.rule.action(score, score), score, score, n_success, n_failure
        action, lower, upper = self.rule(n_success, n_failure)
        return action, lower, upper, n_success, n_failure


def part(state: Mapping[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    """The arrays of a state whose names begin so, by the rest of their names."""
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


def model_of_another_version(defect: str) -> StoreError:
    """What is said of a stored model that this version of dengine cannot restore."""
    got = f"one whose {defect}; its labels are whole"
    do = "learn from them anew, by `dengine train --data OLD.db --store NEW.db`"
    return StoreError(f"Expected a model of this version of dengine, got {got}: {do}.")


def restore(module: nn.Module, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Copy arrays into a module's parameters and buffers by name; StoreError where these have other names or sizes."""
    own = module.state_dict()  # shares its tensors with the module
    if {name: value.shape for name, value in arrays.items()} != {name: tuple(v.shape) for name, v in own.items()}:
        raise model_of_another_version(f"{type(module).__name__} has other sizes")
    for name, value in arrays.items():
        own[name].copy_(torch.from_numpy(np.array(value)))


_SCRIPTING = threading.Lock()


def script(module: nn.Module) -> Any:
    """`torch.jit.script` without its deprecation notice: it works in the supported range of torch.

    One at a time: two threads that parse at once made Python's parser raise "AST constructor recursion depth mismatch".
    """
    import warnings

    with _SCRIPTING, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r".*torch\.jit\..* is deprecated.*")
        scripted = torch.jit.script(module)
    remember_code(module)
    return scripted
