"""A second implementation of the rules that learn, in numpy, for thousands of replays at once.

    >>> rules = Rules("pooled", n_replays=10_000, alpha=0.1, tolerances=(0.1, 0.1))
    >>> actions = rules.action(lower, upper)            # arrays of shape (10_000,)
    >>> rules.update(is_known, lower, upper, success, predicted, inclusion)

It is written from the documents (`docs/explanation/pooled_proof.md`, `promise.md`, `drift.md`) and
shares no line with `dengine`. `tests/unit/test_rules.py` shows that both take the same steps.
"""

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Rows = Ints | slice  # replays

VERIFY, ACCEPT, REJECT = 0, 1, 2
OUT_OF_REACH = 2.0
BET = 0.55
N_NEWEST = 50
LOWEST_SCORE = 0.3
NOVEL_SHARE = 0.2
CALM = 25.0
ENDINGS = {"local": "likelihood", "pooled": "bet", "cost": "account"}
FEWEST_SINCE_ALARM = 25
OVERDRAFTS = (2.0, 0.0)  # of accepting and of rejecting, in wrong decisions
BET_SHARES = np.array([0.05, 0.1, 0.2, 0.4, 0.7, 0.98])


def alarm_after(share: float, step: int, limit: int) -> float:
    """Return the mean number of parts until a CUSUM from 0 reaches its limit, by linear equations.

    A part is wrong with probability `share` and then adds `step`; a right one takes 1.
    """
    equations = np.eye(limit)
    for total in range(limit):
        equations[total, max(total - 1, 0)] -= 1.0 - share
        if total + step < limit:
            equations[total, total + step] -= share
    return float(np.linalg.solve(equations, np.ones(limit))[0])


@cache
def design_cusum(share: float, parts: float) -> tuple[int, int]:
    """Return step and limit of the CUSUM against twice the share, with a false alarm in `parts`."""
    worse = min(2.0 * share, 0.99)
    step = max(1, round(math.log(worse / share) / math.log((1.0 - share) / (1.0 - worse))))
    limit = 1
    while alarm_after(share, step, limit) < parts:
        limit += 1
    return step, limit


def log_certificate(n: Floats, n_bad: Floats, mean: Floats, propensity: float) -> Floats:
    """Return the log capital of the certificate's mixture of bets against a mean; arrays (R,).

    A value of log(1 / alpha) or more says that the bound lies below this mean.
    """
    bets = BET_SHARES[:, None]
    logs = n_bad * np.log(1.0 - bets) - n * np.log(1.0 - bets * propensity * mean)
    weighted = logs + np.log(bets / BET_SHARES.sum())
    highest = weighted.max(axis=0)
    return np.asarray(highest + np.log(np.exp(weighted - highest).sum(axis=0)))


def rows_of(replays: Bools) -> Rows:
    """Return an index of some replays: a slice if it is all of them, which copies nothing."""
    return slice(None) if replays.all() else np.flatnonzero(replays)


class Counts:
    """Parts and wrong parts of many replays, checked and audited ones apart.

    Attributes
    ----------
    n : array of float64, shape (2 or 4, *shape)
        Checked parts, wrong ones of these, and if audits are the evidence audited parts and wrong
        ones of these.
    """

    def __init__(self, q: float, *shape: int) -> None:
        self.n = np.zeros((2 if q == 1.0 else 4, *shape))

    def add(self, rows: Rows, where: Bools, wrong: Bools, audited: Bools) -> None:
        """Count one part in each place of `where`; the arrays are of the replays `rows`."""
        if len(self.n) == 2:
            self.n[0, rows] += where
            self.n[1, rows] += where & wrong
            return
        self.n[0, rows] += where & ~audited
        self.n[1, rows] += where & ~audited & wrong
        self.n[2, rows] += where & audited
        self.n[3, rows] += where & audited & wrong


class Side:
    """What many replays know of accepting, or of rejecting, at a time.

    Attributes
    ----------
    threshold, cusum : array of float64, shape (R,)
    target : array of int64, shape (R,)
    by_level : Counts
        Parts by level since the alarm, under "cost".
    level_capital : array of float64, shape (R, L)
        The log capital of the same, under "pooled".
    members, members_since : Counts
        Members of all time, and since the alarm.
    n_reached : array of int64, shape (R, L)
        Parts that ever reached each level.
    last_wrong : array of int64, shape (K + 1, R, L)
        Which parts, in the order of `n_reached`, were the newest wrong ones, oldest first. If the
        first is among the newest `N_NEWEST`, more than K of these were wrong.
    """

    def __init__(
        self,
        kind: str,
        n_replays: int,
        alpha: float,
        tolerance: float,
        overdraft: float,
        q: float,
        ending: str,
    ) -> None:
        self.kind = kind
        self.q = q
        self.ending = ending
        if kind == "cost":
            levels = [1.0 - 0.5 * tolerance, 1.0 - tolerance]
        elif kind == "pooled":
            lowest = 1.0 - tolerance - LOWEST_SCORE
            n_levels = math.floor(lowest / (0.5 * tolerance) + 1e-9) + 1
            levels = [1.0 - tolerance - i * (0.5 * tolerance) for i in range(n_levels)]
        else:
            levels = [1.0 - tolerance]
        self.levels = np.array(levels)
        self.tolerance = tolerance
        self.overdraft = overdraft
        self.needed = math.log(1.0 / alpha)
        stakes = [BET / (1.0 - BET * tolerance) * weight for weight in (q, 1.0)]
        self.bet = [
            (math.log(1.0 + s * tolerance), math.log(1.0 - s * (1.0 - tolerance))) for s in stakes
        ]
        self.step, self.limit = design_cusum(tolerance, 100.0 / alpha)
        first = self.levels[0] if kind == "local" else OUT_OF_REACH
        self.threshold = np.full(n_replays, first)
        self.cusum = np.zeros(n_replays)
        self.target = np.zeros(n_replays, dtype=np.int64)
        n_levels = len(levels)
        self.by_level = Counts(q, n_replays, n_levels)
        self.level_capital = np.zeros((n_replays, n_levels))
        self.members = Counts(q, n_replays)
        self.members_since = Counts(q, n_replays)
        n_wrong = int(binom.ppf(0.8, N_NEWEST, tolerance)) + 1
        self.last_wrong = np.full((n_wrong, n_replays, n_levels), -N_NEWEST)
        self.n_reached = np.zeros((n_replays, n_levels), dtype=np.int64)

    def log_capital(self, n: Floats) -> Floats:
        """Return the log capital of the bet that the tolerance is kept, of counts."""
        (good, bad), (good_audited, bad_audited) = self.bet
        capital = n[0] * good + n[1] * (bad - good)
        if len(n) == 2:
            return np.asarray(capital)
        return np.asarray(capital + n[2] * good_audited + n[3] * (bad_audited - good_audited))

    def balance(self, n: Floats) -> Floats:
        """Return what accepting instead of checking saved, in wrong decisions, of counts."""
        checked = n[0] * self.tolerance - n[1]
        if len(n) == 2:
            return np.asarray(checked)
        return np.asarray(checked + n[2] * (self.tolerance / self.q) - n[3] * (1.0 / self.q))

    def likelihood(self, n: Floats) -> Floats:
        """Return the log likelihood ratio of the tolerance against twice the tolerance."""
        worse = min(2.0 * self.tolerance, 0.99)
        right = math.log((1.0 - self.tolerance) / (1.0 - worse))
        return np.asarray(n[0] * right + n[1] * (math.log(self.tolerance / worse) - right))

    def ends(self, n: Floats) -> Bools:
        """Return whether the counts since an alarm let the side open again."""
        if self.ending == "account":
            return np.asarray((n[::2].sum(axis=0) >= FEWEST_SINCE_ALARM) & (self.balance(n) >= 0.0))
        if self.ending == "likelihood":
            return np.asarray(self.likelihood(n) >= self.needed)
        return np.asarray(self.log_capital(n) >= self.needed)

    def choose(self, counted: Bools, in_safe_mode: Bools) -> None:
        """Choose target and threshold anew in the replays in which a part was counted."""
        rows = rows_of(counted)
        since = self.members_since.n[:, rows]
        if self.kind == "local":
            opens = (self.threshold[rows] == OUT_OF_REACH) & self.ends(since)
            self.threshold[rows] = np.where(opens, self.levels[0], self.threshold[rows])
            return
        members = self.members.n[:, rows]
        if self.kind == "cost":
            good = self.balance(self.by_level.n[:, rows]) >= -self.overdraft
            members_keep = self.balance(members) >= -self.overdraft
        else:
            good = self.level_capital[rows] >= self.needed
            good &= self.last_wrong[0, rows] <= self.n_reached[rows] - N_NEWEST
            members_keep = self.log_capital(members) >= self.needed
        any_good = good.any(axis=1)
        lowest = good.shape[1] - 1 - good[:, ::-1].argmax(axis=1)
        alarmed = in_safe_mode[rows] | (since != members).any(axis=0)
        opens = any_good & members_keep & (~alarmed | self.ends(since))
        self.target[rows] = np.where(any_good, lowest, 0)
        self.threshold[rows] = np.where(opens, self.levels[lowest], OUT_OF_REACH)

    def count(
        self, part: Bools, score: Floats, wrong: Bools, sure: Bools, audited: Bools
    ) -> tuple[Bools, Bools]:
        """Count a part in the replays of `part`.

        `sure` says where the model alone would have taken the action of this side. Returns where
        the part is a member, and where it counts at all.
        """
        counted = part & ((score >= self.levels[-1]) | sure)
        member = counted & ((score >= self.levels[self.target]) | sure)
        if not counted.any():
            return member, counted
        rows = rows_of(counted)
        if self.kind == "local":  # its one level is that of its members
            reached = score[rows] >= self.levels[0]
            self.members_since.add(rows, reached, wrong[rows], audited[rows])
            return member, counted
        reached = score[rows, None] >= self.levels
        self.n_reached[rows] += reached
        if self.kind == "cost":
            self.by_level.add(rows, reached, wrong[rows, None], audited[rows, None])
        else:
            gains = np.array(self.bet)[audited.astype(int), wrong.astype(int)]
            self.level_capital[rows] += reached * gains[rows, None]
        for counts in (self.members, self.members_since):
            counts.add(rows, member[rows], wrong[rows], audited[rows])
        failing = np.flatnonzero(counted & wrong)
        last = self.last_wrong[:, failing]
        newer = np.concatenate([last[1:], self.n_reached[None, failing]])
        reaches = score[failing, None] >= self.levels
        self.last_wrong[:, failing] = np.where(reaches, newer, last)
        return member, counted

    def close(self, replays: Bools) -> None:
        """Begin anew in the replays with an alarm."""
        self.cusum[replays] = 0.0
        self.target[replays] = 0
        self.threshold[replays] = OUT_OF_REACH
        self.by_level.n[:, replays] = 0.0
        self.level_capital[replays] = 0.0
        self.members_since.n[:, replays] = 0.0


class Rules:
    """One rule in many replays.

    Parameters
    ----------
    kind : {"local", "pooled", "cost"}
        "local" is the paper's rule with its safe mode, where all line stops are known.
    n_replays : int
    alpha : float
    tolerances : pair of float
        Of accepting and of rejecting.
    q : float, default 1.0
        Audit rate where only audits show the outcome of a certain decision; 1 where all are known.
    ending : {"bet", "account", "likelihood"}, optional
        What ends a safe mode; by default as `ENDINGS` says.

    Attributes
    ----------
    safe_mode : array of int64, shape (R,)
        0 outside; 1 accepted parts, 2 rejected parts, 3 novel traces.
    """

    def __init__(
        self,
        kind: str,
        n_replays: int,
        alpha: float,
        tolerances: tuple[float, float],
        q: float = 1.0,
        ending: str | None = None,
    ) -> None:
        self.kind = kind
        self.q = q
        ending = ending or ENDINGS[kind]
        self.sides = [
            Side(kind, n_replays, alpha, tolerance, overdraft, q, ending)
            for tolerance, overdraft in zip(tolerances, OVERDRAFTS, strict=True)
        ]
        self.safe_mode = np.zeros(n_replays, dtype=np.int64)
        self.novelty = np.zeros(n_replays)
        self.novel_step, self.novel_limit = design_cusum(NOVEL_SHARE, 100.0 / alpha)

    def action(self, lower: Floats, upper: Floats) -> Ints:
        """Return what each replay would do with a part of this bound."""
        accepts = lower >= self.sides[0].threshold
        rejects = upper <= 1.0 - self.sides[1].threshold
        return np.where(accepts == rejects, VERIFY, np.where(accepts, ACCEPT, REJECT))

    def observe(self, known: Bools, n_unreported: Ints, novel: Bools) -> None:
        """Tell of accepted parts without an outcome, and whether the trace at hand was novel."""
        silent = known & (n_unreported > 0)
        before = self.safe_mode.copy()
        accepting = self.sides[0]
        accepting.cusum = np.where(silent, _fall(accepting.cusum, n_unreported), accepting.cusum)
        outside = known & (before == 0)
        self.novelty = np.where(outside & silent, _fall(self.novelty, n_unreported), self.novelty)
        step = np.where(novel, float(self.novel_step), -1.0)
        stepped = np.maximum(self.novelty, 0.0) + step
        calm = np.maximum(self.novelty, 0.0) + np.where(novel, 1.0 - 1.0 / NOVEL_SHARE, 1.0)
        self.novelty = np.where(outside, stepped, self.novelty)
        self.novelty = np.where(known & (before == 3), calm, self.novelty)
        self.begin_safe_mode(outside & (self.novelty >= self.novel_limit), 3)

    def update(
        self,
        known: Bools,
        lower: Floats,
        upper: Floats,
        success: Bools,
        predicted: Ints,
        inclusion: Floats,
    ) -> list[Bools]:
        """Tell the replays of `known` of a part's outcome.

        `predicted` is what the model alone would have done, `inclusion` the probability with which
        the outcome would be asked for: 1 for a check. Returns for each side where the part is a
        member.
        """
        members = []
        for i, (side, score) in enumerate(zip(self.sides, (lower, 1.0 - upper), strict=True)):
            wrong = ~success if i == 0 else success
            passing = known & (score >= side.threshold)
            stepped = np.maximum(side.cusum, 0.0) + np.where(wrong, float(side.step), -1.0)
            side.cusum = np.where(passing, stepped, side.cusum)
            self.begin_safe_mode(passing & (side.cusum >= side.limit), i + 1)
            counted = known
            audited = inclusion < 1.0
            if self.q < 1.0:
                counted = known & (inclusion > 0.0)
            member, counted = side.count(counted, score, wrong, predicted == i + 1, audited)
            members.append(member)
            if counted.any():
                side.choose(counted, self.safe_mode > 0)
        is_open = np.stack([side.threshold < OUT_OF_REACH for side in self.sides])
        novel_ends = (self.novelty >= CALM) & is_open.any(axis=0)
        ends = np.choose(self.safe_mode, [np.zeros_like(known), *is_open, novel_ends]) & known
        self.safe_mode[ends] = 0
        self.novelty[ends] = 0.0
        return members

    def begin_safe_mode(self, replays: Bools, reason: int) -> None:
        """Begin a safe mode in some replays; in one that goes on, the earlier side's reason stays."""
        if not replays.any():
            return
        going_on = (self.safe_mode == 1) | (self.safe_mode == 2)
        reasons = np.where(going_on, np.minimum(self.safe_mode, reason), reason)
        self.safe_mode = np.where(replays, reasons, self.safe_mode)
        self.novelty[replays] = 0.0
        for side in self.sides:
            side.close(replays)


def _fall(total: Floats, times: Ints) -> Floats:
    """Return a CUSUM after so many right parts."""
    return np.asarray(np.maximum(total - (times - 1), 0.0) - 1.0)
