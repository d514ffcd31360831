"""Thousands of replays of one rule on one stream, judged by the true failure probabilities.

    >>> play(Case("pooled", "constant", "all"), n_replays=1000, seed=0)["broke"]

What is judged at each moment at which the rule would accept a part:

- **pooled**: the mean failure probability of all members so far is at most the tolerance.
- **cost**, all outcomes known: accepting the members whose outcomes were reported has cost at most
  two false accepts more than checking them. This follows from the rule itself, so no replay may
  break it.
- **cost**, audited: the rule's account is an estimate. With A the estimate and B the account of
  all outcomes, exp(s (B - A)) divided by the product of its conditional means is a martingale for
  every fixed s. By Ville's inequality it reaches 1 / alpha with a probability of at most alpha,
  which is what is judged, with s = `SLOPE`. Where it stays below, B is at most 2 plus the margin
  (log(1 / alpha) + the sum of the logarithms of these means) / s.
- **local** promises nothing about many parts. Its rows show safe modes only.

The **certificate** is judged after every part: its bound lies above the true mean.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from .implementation import (
    ACCEPT,
    OVERDRAFTS,
    REJECT,
    VERIFY,
    Bools,
    Floats,
    Ints,
    Rules,
    Side,
    log_certificate,
)
from .streams import STREAMS

ALPHA = 0.1
TOLERANCES = {"local": (0.1, 0.1), "pooled": (0.1, 0.1), "cost": (5 / 120, 5 / 47.5)}
AUDIT_RATE = 0.3
SHARE_LATE, DELAY = 0.3, 20
SHARE_MISSING, LABEL_WITHIN = 0.02, 100
SHARE_STOPS = 0.5  # of the bad accepted parts, where not all stops are known
SLOPE = 0.2  # of the audited account
LONG = 300  # parts of a safe mode
OUTCOMES = {  # name -> (audited, late, missing)
    "all": (False, False, False),
    "late": (False, True, False),
    "missing": (False, False, True),
    "audited": (True, False, False),
    "audited, late, missing": (True, True, True),
}


class AfterLabel(Side):
    """A planted fault: a threshold that moves, by up to a tolerance, after a bad part's label."""

    def count(
        self, part: Bools, score: Floats, wrong: Bools, sure: Bools, audited: Bools
    ) -> tuple[Bools, Bools]:
        moves = wrong & (score < self.levels[self.target] + self.tolerance)
        return super().count(part & ~moves, score, wrong, sure & ~moves, audited)


@dataclass(frozen=True)
class Case:
    """One row of the proof.

    Parameters
    ----------
    rule : {"local", "pooled", "cost"}
    stream : str
        A name in `STREAMS`.
    outcomes : str
        A name in `OUTCOMES`.
    fault : {"", "peeks", "moves", "unweighted"}
        A planted fault.
    ending : str or None
        What ends a safe mode; None as the rule has it.
    n_parts : int
    """

    rule: str
    stream: str
    outcomes: str = "all"
    fault: str = ""
    ending: str | None = None
    n_parts: int = 600

    @property
    def allowed(self) -> float | None:
        """Share of the replays that may break the promise; None: nothing is promised."""
        if self.rule == "local":
            return None
        is_certain = self.rule == "cost" and not OUTCOMES[self.outcomes][0]
        return 0.0 if is_certain else ALPHA


@dataclass
class Report:
    """One part in all replays, and whether its outcome comes late or never."""

    p: Floats
    score: Floats
    good: Bools
    predicted: Ints
    asked: Bools
    inclusion: Floats
    late: Bools
    missing: Bools


class JudgedReplays:
    """Replays of a case, see `play`."""

    def __init__(self, case: Case, n_replays: int, seed: int) -> None:
        self.case = case
        self.n_replays = n_replays
        self.n_parts = case.n_parts
        tolerances = TOLERANCES[case.rule]
        self.tolerance = tolerances[0]
        self.is_audited, self.is_late, self.is_missing = OUTCOMES[case.outcomes]
        self.q = AUDIT_RATE if self.is_audited else 1.0
        self.rng = np.random.default_rng([seed, *case.stream.encode(), *case.rule.encode()])
        self.stream = STREAMS[case.stream](self.tolerance, n_replays, case.n_parts, self.rng)
        self.rules = Rules(case.rule, n_replays, ALPHA, tolerances, self.q, case.ending)
        if case.fault == "moves":
            self.rules.sides[0].__class__ = AfterLabel
        if case.fault == "unweighted":
            side = self.rules.sides[0]
            side.bet = [side.bet[1], side.bet[1]]
        zeros = np.zeros(n_replays)
        self.n_members = zeros.copy()
        self.sum_members = zeros.copy()
        self.account = zeros.copy()
        self.log_martingale = zeros.copy()
        self.broke = zeros.astype(bool)
        self.over_account = zeros.astype(bool)
        self.n_certified = zeros.copy()
        self.n_bad_certified = zeros.copy()
        self.sum_certified = zeros.copy()
        self.certificate_broke = zeros.astype(bool)
        self.n_unreported = zeros.astype(np.int64)
        self.n_accepted = zeros.copy()
        self.history: list[Report] = []

    def play(self) -> dict[str, float]:
        """Play all parts and return sums over the replays."""
        levels = self.rules.sides[0].levels
        n_by_level = np.zeros(len(levels))
        p_by_level = np.zeros(len(levels))
        safe = np.zeros((self.n_parts, self.n_replays), dtype=bool)
        for t in range(self.n_parts):
            safe[t] = self.rules.safe_mode > 0
            report = self._decide(t)
            reached = report.score[:, None] >= levels
            n_by_level += reached.sum(axis=0)
            p_by_level += (reached * report.p[:, None]).sum(axis=0)
            self._judge(report.predicted == ACCEPT)
            self._report(t, report)
            self._judge_certificate()
        lengths = mode_lengths(safe)
        return {
            "replays": self.n_replays,
            "broke": int(self.broke.sum()),
            "over_account": int(self.over_account.sum()),
            "certificate_broke": int(self.certificate_broke.sum()),
            "accepted": float(self.n_accepted.sum()),
            "perfect": self.n_replays
            * perfect_bet(
                n_by_level / self.n_replays,
                p_by_level / np.maximum(n_by_level, 1),
                self.tolerance,
                self.q,
                needs_evidence=self.case.rule != "cost",
            ),
            "safe_modes": len(lengths),
            "safe_parts": int(safe.sum()),
            "long_safe_modes": int((lengths > LONG).sum()),
            "parts": self.n_parts * self.n_replays,
        }

    def _decide(self, t: int) -> Report:
        """Decide on part t and draw its outcome, its audit coin and how it is reported."""
        p, score = self.stream.next(t, self.rules)
        predicted = self.rules.action(score, score)
        good = self.rng.random(self.n_replays) >= p
        self.stream.learn(good)
        score = self.stream.final_score(score, good)
        if self.case.fault == "peeks":
            predicted = self.rules.action(score, score)
        is_certain = predicted != VERIFY
        coin = self.rng.random(self.n_replays) < self.q
        asked = ~is_certain | coin if self.is_audited else np.ones_like(coin)
        inclusion = np.where(is_certain, self.q, 1.0)
        checked = asked if self.is_audited else ~is_certain
        late = checked & (self.rng.random(self.n_replays) < SHARE_LATE * self.is_late)
        missing = checked & (self.rng.random(self.n_replays) < SHARE_MISSING * self.is_missing)
        report = Report(p, score, good, predicted, asked, inclusion, late & ~missing, missing)
        self.history.append(report)
        return report

    def _report(self, t: int, report: Report) -> None:
        """Tell the rule what becomes known at part t: of it, of late ones and of overdue ones."""
        accepts = report.predicted == ACCEPT
        self.n_accepted += accepts
        silent = accepts & ~report.asked
        if self.is_audited:
            self._count_unreported(report, silent)
            stops = silent & ~report.good & (self.rng.random(self.n_replays) < SHARE_STOPS)
            self.n_unreported += silent & ~stops
            known = (report.asked & ~report.late & ~report.missing) | stops
            inclusion = np.where(stops, 0.0, report.inclusion)
            self._update(known, report, report.good, inclusion)
        else:
            self._update(~report.late & ~report.missing, report, report.good, report.inclusion)
        if self.is_late and t >= DELAY:
            past = self.history[t - DELAY]
            self._update(past.late, past, past.good, past.inclusion)
        if self.is_missing and t >= LABEL_WITHIN:
            past = self.history[t - LABEL_WITHIN]
            self._update_overdue(past)

    def _update_overdue(self, past: Report) -> None:
        """Count the overdue outcomes of a part as errors of either side, one after the other."""
        everyone = np.ones(self.n_replays, dtype=bool)
        nobody = np.zeros(self.n_replays)
        bad = replace(past, predicted=np.where(past.predicted == ACCEPT, ACCEPT, VERIFY))
        self._update(past.missing, bad, ~everyone, past.inclusion, upper=nobody + 1.0)
        good = replace(past, predicted=np.where(past.predicted == REJECT, REJECT, VERIFY))
        self._update(past.missing, good, everyone, past.inclusion, lower=nobody)

    def _update(
        self,
        known: Bools,
        report: Report,
        good: Bools,
        inclusion: Floats,
        lower: Floats | None = None,
        upper: Floats | None = None,
    ) -> None:
        """Give the rules one report, and count the members and the certified parts of it.

        The bounds are the score, unless they are given.
        """
        lower = report.score if lower is None else lower
        upper = report.score if upper is None else upper
        self.rules.observe(known, self.n_unreported, np.zeros(self.n_replays, dtype=bool))
        self.n_unreported[known] = 0
        members = self.rules.update(known, lower, upper, good, report.predicted, inclusion)[0]
        self._count_members(members, report, asked=True)
        certified = known & (report.predicted == ACCEPT) & (inclusion > 0.0)
        self.n_certified += certified
        self.n_bad_certified += certified & ~good
        self.sum_certified += np.where(certified, report.p, 0.0)

    def _count_unreported(self, report: Report, silent: Bools) -> None:
        """Count accepted parts that nobody asks for: members, and parts of the certificate."""
        self._count_members(silent, report, asked=False)
        self.n_certified += silent
        self.sum_certified += np.where(silent, report.p, 0.0)

    def _count_members(self, members: Bools, report: Report, asked: bool) -> None:
        """Count members by their true probabilities and true outcomes."""
        self.n_members += members
        self.sum_members += np.where(members, report.p, 0.0)
        cost = np.where(report.good, 0.0, 1.0) - self.tolerance
        self.account += np.where(members, cost, 0.0)
        if not self.is_audited or self.case.rule != "cost":
            return
        q = report.inclusion
        error = cost * (1.0 - asked / q)
        mean = q * np.exp(SLOPE * cost * (1.0 - 1.0 / q)) + (1.0 - q) * np.exp(SLOPE * cost)
        self.log_martingale += np.where(members, SLOPE * error - np.log(mean), 0.0)

    def _judge(self, accepts: Bools) -> None:
        """Judge the promise in the replays that accept at this moment."""
        self.over_account |= accepts & (self.account > OVERDRAFTS[0] + 1e-9)
        if self.case.rule == "pooled":
            excess = self.sum_members - self.tolerance * self.n_members
            self.broke |= accepts & (excess > 1e-9)
        elif self.case.rule == "cost":
            if self.is_audited:
                self.broke |= accepts & (self.log_martingale >= math.log(1.0 / ALPHA))
            else:
                self.broke = self.over_account

    def _judge_certificate(self) -> None:
        """Judge the certificate's bound on the accepted parts."""
        some = self.n_certified > 0
        if not some.any():
            return
        mean = self.sum_certified / np.maximum(self.n_certified, 1)
        evidence = log_certificate(self.n_certified, self.n_bad_certified, mean, self.q)
        self.certificate_broke |= some & (evidence >= math.log(1.0 / ALPHA))


def mode_lengths(safe: Bools) -> Ints:
    """Return the length in parts of each safe mode, of shape (T, R) whether each part was in one."""
    padded = np.pad(safe, ((1, 1), (0, 0))).T.astype(np.int8)
    edges = np.diff(padded, axis=1)
    return np.asarray(np.nonzero(edges < 0)[1] - np.nonzero(edges > 0)[1])


def perfect_bet(
    n: Floats, p: Floats, tolerance: float, q: float, needs_evidence: bool = True
) -> float:
    """Return how many certain decisions the best level would have, with the best bet on it.

    Parameters
    ----------
    n, p : array of float, shape (L,)
        For each level the parts of a replay that reach it, and their mean failure probability.
    tolerance, q : float
    needs_evidence : bool, default True
        False: without a bet, like the account.

    Returns
    -------
    float
        The largest n - log(1 / alpha) / gain, where the gain is what a checked member adds to the
        log capital on average at the best stake. With all outcomes known it is the divergence
        KL(p || tolerance). With audits a stake is at most q / (1 - tolerance).
    """
    best = 0.0
    for n_level, p_level in zip(n, p, strict=True):
        if p_level >= tolerance:
            continue
        needed = 0.0
        if needs_evidence:
            needed = math.log(1.0 / ALPHA) / best_gain(float(p_level), tolerance, q)
        best = max(best, float(n_level) - needed)
    return best


def best_gain(p: float, tolerance: float, q: float) -> float:
    """Return the largest mean gain of log capital of a member that fails with probability p."""

    def loss(share: float) -> float:
        stake = share * q / (1.0 - tolerance)
        gain = (1.0 - p) * math.log1p(stake * tolerance)
        return -gain - p * math.log1p(-stake * (1.0 - tolerance))

    return -float(minimize_scalar(loss, bounds=(0.0, 1.0 - 1e-9), method="bounded").fun)


def play(case: Case, n_replays: int, seed: int) -> dict[str, float]:
    """Play replays of a case, and return counts over all of them."""
    return JudgedReplays(case, n_replays, seed).play()
