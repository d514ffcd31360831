"""The evidence that a learning rule keeps: `MemberEvidence` counts the outcomes of parts, opens and
closes levels of the score by a bet or an account, and runs the drift detectors that start the safe
mode. It is a module with one buffer for each quantity. `member_rules` builds the pooled, the priced
and the watched rule on it; TorchScript compiles it into the exported file, where it goes on
learning.

*Members* are the parts whose score reached the target level when they were decided, accepted or
checked. The score for accepting is the lower bound, the score for rejecting 1 - upper bound. Each
side has *levels* of the score, possible thresholds, the strictest first; the rule accepts (rejects)
a part whose score reaches the threshold of that side, which is one of the levels, or out of reach.

*The bet.* A bettor who stakes the same share on every member, against the claim "the mean failure
probability is above the tolerance", has a capital of 1 / alpha or more with a probability of at
most alpha while that claim is true. So the pooled rule opens a level while the capital is at least
1 / alpha. Statement, assumptions, proof and references: docs/explanation/pooled_proof.md.

*The account.* The priced rule counts what accepting all members would have cost beyond checking
them, in units of one false accept, and opens a level while the balance is at least -`OVERDRAFT`.

*Safe mode.* A mean over all members reacts late to drift. So CUSUM detectors (`certificate.cusum`)
watch the accepted parts, the rejected parts, and the share of novel traces. After an alarm both
sides are closed: nothing is accepted or rejected. A side opens again when its members since the
alarm show recovery: under the pooled rule by the bet, under the priced rule by the account, and
under the watched rule by the likelihood ratio of the detector's two hypotheses, the tolerance and
twice the tolerance.
"""

import math
from enum import IntEnum

import torch
from torch import Tensor, nn

from ..records import ActionCode
from .certificate import OVERDRAFT, cusum

SAFE_MODES = (  # why the safe mode began, by `SafeMode`
    "",
    "accepted parts failed more often than the tolerance",
    "rejected parts were good more often than the tolerance",
    "too many traces were novel",
)
BET = 0.55  # share of the largest stake; best for failure rates of nearly half of the tolerance
N_RECENT = 50  # newest outcomes of a level that are tested by themselves
TAIL_PROBABILITY = 0.2  # at most, of the allowed number of errors among them at the tolerance
CLOSED = 2.0  # a threshold that no score reaches
FALSE_ALARMS = 100.0  # at the tolerance itself one alarm in 100 / alpha parts on average, or fewer
NOVEL_SHARE = 0.2  # of the traces of a stream that may be novel
FEWEST_SINCE_ALARM = 25.0  # members: an account over fewer says little
FEW_NOVEL = 25.0  # traces in a row that are not novel; a novel one takes back 1 / NOVEL_SHARE - 1


class Detector(IntEnum):
    """What a drift detector watches; the first two are also the rule's sides, accept and reject.

    The value is the detector's position in `detector_sums`, and its `SafeMode` minus 1.
    """

    ACCEPTED_PARTS = 0
    REJECTED_PARTS = 1
    NOVEL_TRACES = 2


class SafeMode(IntEnum):
    """The detector whose alarm began the safe mode; NONE outside of a safe mode.

    An alarm during a safe mode keeps the smaller of the two values. Exported files give the value.
    """

    NONE = 0
    ACCEPTED_PARTS = 1
    REJECTED_PARTS = 2
    NOVEL_TRACES = 3


def max_recent_errors(tolerance: float) -> int:
    """Return how many of the newest `N_RECENT` (50) outcomes of a level may be wrong.

    A level is a possible threshold of a score, and its outcomes are those of parts whose score
    reached it. The number is the smallest k for which more than k are wrong with a probability of
    at most `TAIL_PROBABILITY` (0.2), if each outcome is wrong with the probability `tolerance`,
    independently.
    """
    tail = 1.0
    k = -1
    while tail > TAIL_PROBABILITY:
        k += 1
        tail -= math.comb(N_RECENT, k) * tolerance**k * (1.0 - tolerance) ** (N_RECENT - k)
    return k


def log_capital_steps(tolerance: float, inclusion_probability: float) -> list[float]:
    """Return what an outcome adds to the logarithm of the capital of a bet on the tolerance.

    The bet is that the share of wrong parts (bad if accepted, good if rejected) is below
    `tolerance`, and its capital is the evidence for this: 1 / alpha or more refutes, at error level
    alpha, that the share of wrong parts is above the tolerance. Each part multiplies the capital by
    1 + stake * (tolerance - w), where w is 1 for a wrong part and else 0. The stake is `BET` / (1 -
    `BET` * tolerance), where `BET` is 0.55. A checked part's outcome was asked for with certainty,
    an audited part's with the probability `inclusion_probability`; the stake on a checked part is
    multiplied by this probability.

    Returns
    -------
    list of 4 floats
        What a checked part adds, above 0; what a wrong checked part adds on top of that, below 0;
        the same two for an audited part.
    """
    stake = BET / (1.0 - BET * tolerance)
    steps: list[float] = []
    for scale in (stake * inclusion_probability, stake):
        good = math.log1p(scale * tolerance)
        wrong = math.log1p(scale * (tolerance - 1.0))
        steps += [good, wrong - good]
    return steps


def weighted_sum(counts: list[int], weights: list[float]) -> float:
    """Return the sum of counts[i] * weights[i] over two lists of equal length."""
    total = 0.0
    for count, weight in zip(counts, weights):  # noqa: B905  strict is not TorchScript
        total += count * weight
    return total


class MemberEvidence(nn.Module):
    """Outcomes of members and levels, drift detectors, and the threshold of each side.

    Side 0 accepts, side 1 rejects. Counts are held apart for *checked* parts (outcome asked for
    with certainty) and *audited* parts (asked for with the probability `inclusion_probability`).

    Parameters
    ----------
    alpha : float
        Error level of the bet.
    tolerances : pair of float
        For each side, the largest share of wrong decisions.
    levels : two lists of float
        For each side the levels of the score, strictest first; as many on each side.
    inclusion_probability : float, default 1.0
        Probability, fixed beforehand, that the outcome of a certain decision is asked for; 1 if all
        outcomes are known.
    kind : {"watched", "pooled", "priced"}, default "pooled"
        "watched": the first level is open from the start and closes at an alarm. "pooled": a level
        opens by the bet. "priced": a level opens by the account.

    Attributes
    ----------
    member_counts : Tensor of int64, shape (2, 2, 2)
        [side, checked or audited, parts or wrong parts], of all members so far.
    member_counts_since_alarm : Tensor of int64, shape (2, 2, 2)
        The same since the last alarm.
    level_counts_since_alarm : Tensor of int64, shape (2, L, 2, 2)
        [side, level, checked or audited, parts or wrong parts]: parts whose score reached the
        level.
    level_totals : Tensor of int64, shape (2, L)
        Parts that ever reached each level.
    recent_errors : Tensor of int64, shape (2, L, N_RECENT)
        1 for each of the newest parts of a level that was wrong; the oldest is overwritten.
    detector_sums : Tensor of float64, shape (3,)
        CUSUM of accepted parts, of rejected parts, and of novel traces; may be one step below 0.
    thresholds : Tensor of float64, shape (2,)
        Score that a part must reach to be accepted, and to be rejected; `CLOSED` if nothing may
        pass.
    target_level : Tensor of int64, shape (2,)
        For each side the position of the level whose parts are members.
    safe_mode : Tensor of int64, shape ()
        Position in `SAFE_MODES`; 0 outside of the safe mode.
    """

    member_counts: Tensor
    member_counts_since_alarm: Tensor
    level_counts_since_alarm: Tensor
    level_totals: Tensor
    recent_errors: Tensor
    detector_sums: Tensor
    thresholds: Tensor
    target_level: Tensor
    safe_mode: Tensor

    def __init__(
        self,
        alpha: float,
        tolerances: tuple[float, float],
        levels: list[list[float]],
        inclusion_probability: float = 1.0,
        *,
        kind: str = "pooled",
    ) -> None:
        super().__init__()
        self.levels = levels
        self.is_watched = kind == "watched"
        self.inclusion_probability = inclusion_probability
        self.n_recent = N_RECENT
        self.closed = CLOSED
        self.max_recent_errors = [max_recent_errors(tolerance) for tolerance in tolerances]
        # What each kind of part adds to the evidence for a level (see `log_capital_steps`), how
        # much is enough, and the same of the evidence for recovery, the members since an alarm.
        self.recovery_minimum = math.log(1.0 / alpha)
        self.level_steps = [log_capital_steps(t, inclusion_probability) for t in tolerances]
        self.level_minimum = [self.recovery_minimum] * 2
        self.fewest_since_alarm = 0.0
        if kind == "priced":
            self.level_steps = [
                [t, -1.0, t / inclusion_probability, -1.0 / inclusion_probability]
                for t in tolerances
            ]
            self.level_minimum = [-OVERDRAFT, 0.0]
            self.max_recent_errors = [N_RECENT] * 2  # the account and the detectors are enough
            self.recovery_minimum = 0.0
            self.fewest_since_alarm = FEWEST_SINCE_ALARM
        self.recovery_steps = self.level_steps
        if self.is_watched:
            # Of the log likelihood ratio of the tolerance to its double. If the share of wrong
            # parts is doubled, it ever reaches log(1 / alpha) with a probability of at most alpha.
            right_steps = [math.log((1.0 - t) / (1.0 - 2.0 * t)) for t in tolerances]
            self.recovery_steps = [[step, -math.log(2.0) - step] * 2 for step in right_steps]
        # Of a detector, what a wrong part adds, where a right one takes 1, and the alarm's limit.
        detectors = [cusum(share, FALSE_ALARMS / alpha) for share in (*tolerances, NOVEL_SHARE)]
        self.error_steps = [float(step) for step, _ in detectors]
        self.alarm_limits = [float(limit) for _, limit in detectors]
        self.correct_step = -1.0
        self.few_novel = FEW_NOVEL
        self.novel_setback = 1.0 / NOVEL_SHARE - 1.0
        n_levels = len(levels[0])
        counts = {
            "member_counts": (2, 2, 2),
            "member_counts_since_alarm": (2, 2, 2),
            "level_counts_since_alarm": (2, n_levels, 2, 2),
            "level_totals": (2, n_levels),
            "recent_errors": (2, n_levels, N_RECENT),
            "target_level": (2,),
            "safe_mode": (),
        }
        for name, shape in counts.items():
            self.register_buffer(name, torch.zeros(shape, dtype=torch.int64))
        first = [side[0] if self.is_watched else CLOSED for side in levels]
        self.register_buffer("thresholds", torch.tensor(first, dtype=torch.float64))
        self.register_buffer("detector_sums", torch.zeros(3, dtype=torch.float64))

    def action(self, lower: float, upper: float) -> int:
        """Return the `ActionCode` (0 verify, 1 accept, 2 reject) that a bound allows at present.

        The bound, `lower` and `upper`, is on the success probability. The part is accepted if
        `lower` reaches the accept threshold, and rejected if 1 - `upper` reaches the reject
        threshold, both from `thresholds`. If both hold, or neither, it is verified.
        """
        thresholds: list[float] = self.thresholds.tolist()
        accepts = lower >= thresholds[0]
        rejects = upper <= 1.0 - thresholds[1]
        if accepts == rejects:
            return ActionCode.VERIFY.value
        return ActionCode.ACCEPT.value if accepts else ActionCode.REJECT.value

    def observe(self, n_unreported: int, novel: bool) -> None:
        """Step the drift detectors with parts of unknown outcome and the novelty of one trace.

        It is called just before `update`, for the same part. A detector is a running sum of errors;
        when the sum reaches a limit, it raises an alarm, which starts the safe mode (nothing is
        accepted or rejected). `n_unreported` is the number of accepted parts of unknown outcome
        since the last label. Each lowers the sum of the detector of accepted parts like a part that
        was good, and, outside of a safe mode, the sum of the detector of novel traces like a trace
        that was not novel.

        `novel` says whether the trace of this part was novel (unlike all labelled traces). Outside
        of a safe mode it steps the detector of novel traces. In a safe mode that began because of
        novel traces, the sum of that detector counts how long few traces have been novel, by which
        `update` ends the safe mode: a sum below 0 is first taken as 0, then a trace that was not
        novel adds 1, a novel one takes 4. In any other safe mode `novel` has no effect.
        """
        self.step_detector(Detector.ACCEPTED_PARTS.value, self.correct_step, n_unreported)
        safe_mode = int(self.safe_mode.item())
        novelty = Detector.NOVEL_TRACES.value
        if safe_mode == SafeMode.NONE.value:
            self.step_detector(novelty, self.correct_step, n_unreported)
            self.step_detector(
                novelty, self.error_steps[novelty] if novel else self.correct_step, 1
            )
        elif safe_mode == SafeMode.NOVEL_TRACES.value:  # the sum counts how long few were novel
            step = -self.novel_setback if novel else 1.0
            total = self.detector_sums[novelty]
            total.fill_(max(float(total.item()), 0.0) + step)

    def update(
        self,
        lower: float,
        upper: float,
        success: bool,
        predicted: int,
        inclusion_probability: float,
    ) -> None:
        """Count the outcome of a part, choose thresholds anew, and end a safe mode if it is due.

        The outcome is offered to both sides, accepting and rejecting (`count_outcome`). The score
        of the part is `lower` for accepting and 1 - `upper` for rejecting; `lower` and `upper` are
        the bound on the success probability that the part was decided by. A side counts the outcome
        if the score reaches one of its levels (possible thresholds), or if its action is
        `predicted` (an `ActionCode`: 0 verify, 1 accept, 2 reject), which is what the model alone
        would have done. The drift detector of a side (a running sum of its errors) takes a step if
        the score reaches the side's present threshold. `success` is the label.

        If the decision rule knows all outcomes (its own inclusion probability is 1), every part
        counts as checked. Otherwise `inclusion_probability`, with which this outcome would be asked
        for, says how it counts: 1 as checked, above 0 as audited (drawn at random), and at 0 only
        the drift detectors see it. An outcome that is wrong for a side (a bad part for accepting, a
        good one for rejecting) may raise an alarm, which starts the safe mode: both thresholds are
        then `CLOSED`, which no score reaches, so parts are verified until a side has another
        threshold.

        A safe mode ends only here. After an alarm about accepted or rejected parts it ends when
        that side has another threshold than `CLOSED`; the other side may have one earlier, and then
        decides again. After too many novel traces it ends when few traces are novel again (the sum
        of their detector, to which `observe` then adds 1 for a trace that is not novel and -4 for a
        novel one, is 25 or more) and one of the two thresholds is not `CLOSED`. At the end of any
        safe mode this sum restarts at 0.
        """
        self.count_outcome(
            Detector.ACCEPTED_PARTS.value, lower, not success, predicted, inclusion_probability
        )
        self.count_outcome(
            Detector.REJECTED_PARTS.value, 1.0 - upper, success, predicted, inclusion_probability
        )
        safe_mode = int(self.safe_mode.item())
        if safe_mode == SafeMode.NONE.value:
            return
        novelty = self.detector_sums[Detector.NOVEL_TRACES.value]
        if safe_mode == SafeMode.NOVEL_TRACES.value:
            threshold = self.thresholds.min()
            calm = float(novelty.item()) >= self.few_novel
        else:
            threshold = self.thresholds[safe_mode - 1]  # of the side that raised the alarm
            calm = True
        if calm and float(threshold.item()) < self.closed:
            self.safe_mode.zero_()
            novelty.zero_()

    def count_outcome(
        self, side: int, score: float, wrong: bool, predicted: int, inclusion_probability: float
    ) -> None:
        """Count one part of known outcome on one side, then choose the threshold of that side.

        Side 0 is accepting, and its `score` is the lower bound of the success probability; side 1
        is rejecting, and its score is 1 - upper bound. `wrong` says whether this action would have
        been wrong for the part. A side has levels (possible thresholds), one of which, the target,
        is tested at a time. If the score reaches the threshold of the side, the side's drift
        detector (a running sum of its errors) takes a step first, which may start the safe mode
        (nothing is accepted or rejected); all that follows then uses the strictest level as target.

        If the decision rule knows all outcomes, the part counts as checked; otherwise
        `inclusion_probability`, with which its outcome would be asked for, says how: 1 as checked,
        above 0 as audited (drawn at random), which is counted apart, and 0 not at all. Each level
        that the score reaches counts the part, and keeps whether it was wrong among its newest 50.
        The counts of members (the parts over which the rule bounds the share or cost of errors) get
        the part, too, if its score reaches the target, or if `predicted`, the `ActionCode` of what
        the model alone would have done, is the action of this side. No threshold is chosen if
        neither a level nor the members count the part.
        """
        if score >= float(self.thresholds[side].item()):
            self.step_detector(side, self.error_steps[side] if wrong else self.correct_step, 1)
        audited = 0
        if self.inclusion_probability < 1.0:
            if inclusion_probability == 0.0:
                return
            audited = int(inclusion_probability < 1.0)
        n_levels = len(self.levels[side])
        n_reached = 0
        for level in self.levels[side]:
            n_reached += int(level <= score)
        # A part that the model was certain of is a member even where its label came late.
        target = int(self.target_level[side].item())
        is_member = n_reached > n_levels - 1 - target or predicted == ActionCode.ACCEPT.value + side
        if n_reached == 0 and not is_member:
            return
        first = n_levels - n_reached
        totals = self.level_totals[side, first:]
        slots = totals.unsqueeze(1) % self.n_recent  # of the oldest
        self.recent_errors[side, first:].scatter_(1, slots, int(wrong))
        totals.add_(1)
        n_columns = 1 + int(wrong)  # parts, and wrong parts
        self.level_counts_since_alarm[side, first:, audited, :n_columns].add_(1)
        if is_member:
            self.member_counts[side, audited, :n_columns].add_(1)
            self.member_counts_since_alarm[side, audited, :n_columns].add_(1)
        self.choose_threshold(side)

    def step_detector(self, detector: int, step: float, times: int) -> None:
        """Add `step` to a CUSUM `times` times; start the safe mode if the sum reaches its limit.

        A CUSUM is the running sum of a drift detector; `detector` is its position in
        `detector_sums`, which is changed in place. Before each step a sum below 0 is taken as 0, so
        the new sum may be one step below 0. If `times` is above 1, `step` must be negative: only
        the new sum is compared with the limit. Nothing happens if `times` is 0 or less.

        An alarm starts the safe mode (nothing is accepted or rejected), or starts it anew during
        one. It sets the sums of all detectors and the counts since the last alarm to 0
        (`start_safe_mode`). During a safe mode the reason becomes the one of the old and the new
        that stands first in `SafeMode`: too many errors in accepting or rejecting stay the reason
        if an alarm of novel traces follows.
        """
        if times <= 0:
            return
        before = float(self.detector_sums[detector].item())
        total = max(before + (times - 1) * step, 0.0) + step
        self.detector_sums[detector].fill_(total)
        if total >= self.alarm_limits[detector]:
            safe_mode = int(self.safe_mode.item())
            reason = SafeMode.ACCEPTED_PARTS.value + detector
            is_first = safe_mode == SafeMode.NONE.value
            self.start_safe_mode(reason if is_first else min(safe_mode, reason))

    def start_safe_mode(self, safe_mode: int) -> None:
        """Accept and reject nothing until the outcomes of parts from now on show recovery.

        `safe_mode`, a `SafeMode` other than NONE, says which alarm began it. Both thresholds become
        `CLOSED`, which no score reaches. The sums of the drift detectors and the counts since the
        last alarm restart at 0, and the target level (the possible threshold that is tested) of
        both sides, accepting and rejecting, is the strictest again. The counts over all time, and
        the newest errors of each level, stay.
        """
        self.detector_sums.zero_()
        self.member_counts_since_alarm.zero_()
        self.level_counts_since_alarm.zero_()
        self.target_level.zero_()
        self.thresholds.fill_(self.closed)
        self.safe_mode.fill_(safe_mode)

    def choose_threshold(self, side: int) -> None:
        """Set target level and threshold of one side (0 accepting, 1 rejecting) from the counts.

        Each side has levels (possible thresholds), and the target is the level that it tests. It is
        the lowest level whose parts since the last alarm give enough evidence. The evidence is the
        log capital of a bet that the share of wrong parts is below the tolerance; log(1 / alpha) is
        enough. Under the priced rule (guarantee `cost`) it is what was saved minus what errors
        cost, in units of one error; -2 (-`OVERDRAFT`) is enough for accepting and 0 for rejecting.
        Under the pooled rule it is also required that few of the newest 50 parts of the level were
        wrong (`max_recent_errors`). If no level meets this, the target is the strictest level.

        The threshold is the score of the target if such a level was found, all members (parts that
        reached the target of their time) so far give enough evidence, and the members since an
        alarm, if there was one, show recovery (`members_to_recovery` is 0 or less); otherwise it is
        `CLOSED`, which no score reaches. Recovery is not asked for outside of a safe mode if the
        side had no member before the alarm.

        The watched rule (the paper's rule with a safe mode) has no target. Only an alarm closes its
        threshold, which becomes the first level again once the members since the alarm show
        recovery.
        """
        threshold = self.thresholds[side]
        is_recovered = self.members_to_recovery(side) <= 0.0
        if self.is_watched:  # only an alarm closes it
            if is_recovered and float(threshold.item()) >= self.closed:
                # Assigned to an element, a float of TorchScript would go through float32.
                threshold.fill_(self.levels[side][0])
            return
        members: list[int] = self.member_counts[side].flatten().tolist()
        since: list[int] = self.member_counts_since_alarm[side].flatten().tolist()
        levels: list[list[int]] = self.level_counts_since_alarm[side].flatten(1).tolist()
        n_wrong: list[int] = self.recent_errors[side].sum(1).tolist()
        target = len(n_wrong) - 1
        while target >= 0:
            few_errors = n_wrong[target] <= self.max_recent_errors[side]
            if few_errors and self.allows_more(side, levels[target]):
                break
            target -= 1
        self.target_level[side].fill_(max(0, target))
        may_open = is_recovered or (
            since == members and int(self.safe_mode.item()) == SafeMode.NONE.value
        )
        opens = target >= 0 and may_open and self.allows_more(side, members)
        threshold.fill_(self.levels[side][target] if opens else self.closed)

    def allows_more(self, side: int, counts: list[int]) -> bool:
        """Return whether the evidence of these counts suffices to let more such parts pass.

        It is the log capital of a bet, or under the priced rule the balance of costs. `counts`
        holds checked parts, wrong ones of these, audited parts, wrong ones of these.
        """
        return weighted_sum(counts, self.level_steps[side]) >= self.level_minimum[side]

    def members_to_recovery(self, side: int) -> float:
        """Return how many more members one side needs until it shows recovery from an alarm.

        `side` is 0 for accepting, 1 for rejecting. An alarm says that too many parts were wrong, or
        novel. Members are the parts whose score reached the threshold that the side tested at the
        time. The number supposes that their outcomes go on as they were since the alarm. It is 0 or
        less if they show recovery now, so that the side may open again. It is huge, of the order of
        1e12, while their evidence is not enough and not above 0. The evidence is the log capital of
        a bet that the share of wrong members is below the tolerance. Under the priced rule, which
        decides by what checks and errors cost (guarantee `cost`), it is what was saved minus what
        errors cost, and at least 25 members since the alarm (`FEWEST_SINCE_ALARM`) are needed.
        Under the watched rule, whose threshold is fixed but for alarms (guarantee `local` with
        stops="all"), it is the log likelihood ratio of the tolerance to its double. Nothing is
        changed.
        """
        counts: list[int] = self.member_counts_since_alarm[side].flatten().tolist()
        n = counts[0] + counts[2]
        evidence = weighted_sum(counts, self.recovery_steps[side])
        missing = (self.recovery_minimum - evidence) * (n + 1)
        return max(self.fewest_since_alarm - n, missing / max(evidence, 1e-12))
