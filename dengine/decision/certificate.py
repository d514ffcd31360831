"""What became of the parts that went on without a check: an upper bound on how many were bad, however often one looks.

    >>> failure_bound(1203, 24, alpha=0.05)     # 1,203 parts, 24 of them bad: 2 % were seen, 3.5 % is the bound
    0.0349...

With probability 1 - alpha the bound is, at all moments together (anytime-valid), at or above the mean of the failure
probabilities that the parts so far really had. These may differ and drift; the model may be retrained, and its rule may
learn from every outcome. Assumed: an audit's coin falls with the stated probability whatever the part is. An audit whose
outcome is owed for too long (`Policy.label_within`) counts as bad until it is reported, so that none that is lost makes the
bound smaller; a younger one is left out as yet. It speaks of parts past, not of those to come.

The evidence is an e-process, the capital of a bettor. He starts with 1 and bets the same b on every part, that it will be
good. With x = 1 for a bad part that was looked at, else 0,

    capital(theta) = product of (1 - b)^x / (1 - b q theta),   q the propensity, theta the tolerance.

In place of theta put each part's own failure probability p_i, whatever it is and however it depends on the past: x has the
mean q p_i, so the product M is a martingale that begins at 1, and by Ville's inequality M ever reaches 1 / alpha with
probability alpha at most. The logarithm is concave, so capital(mean of p_1 ... p_n) <= M, at every n at once: no
stationarity, one may look after every part, and the running mean may move. For that b must not depend on theta; as a stake
it is l = b q / (1 - b q theta) on 1 + l (theta - x / q), inverse probability weighting. The capital grows with theta, so
what is not refuted is an interval. Nobody knows the best b beforehand (1 - odds(q p) / odds(q theta), where all parts have
one p), so the capital is a mixture, weighted by the bets: large ones matter while n is small.

Sources: Ville (1939); Waudby-Smith and Ramdas (2024), JRSS B 86(1); mixtures over bets: Robbins (1970), AMS 41(5).
"""

import math
from dataclasses import dataclass, replace

from ..errors import expect, percent

BETS = (0.05, 0.1, 0.2, 0.4, 0.7, 0.98)  # for any rate; never 1, by which one bad part would lose all for ever


def log_evidence(n: int, n_bad: int, tolerance: float, propensity: float = 1.0) -> float:
    """Log capital of a mixture of constant bets that the mean failure probability of n parts is below `tolerance`.

    n : parts, looked at or not.  n_bad : those of them that were looked at and were bad.  tolerance : in [0, 1].
    propensity : in (0, 1], with which each part was looked at. Where it changed, the smallest: that is on the safe side.
    """
    rate = propensity * tolerance
    logs = [n_bad * math.log1p(-bet) - n * math.log1p(-bet * rate) for bet in BETS]
    top = max(logs)
    capital = sum(bet * math.exp(log - top) for bet, log in zip(BETS, logs, strict=True))
    return top + math.log(capital / sum(BETS))


def failure_bound(n: int, n_bad: int, alpha: float, propensity: float = 1.0) -> float:
    """Upper bound on the mean failure probability of n parts, valid at all moments together with probability 1 - alpha.

    n, n_bad, propensity : as in `log_evidence`; propensity 1 where every outcome is known, 0 where nobody looks.
    Returns the largest theta that the evidence does not refute, sup{theta: log_evidence < log(1 / alpha)}, by bisection;
    never less than n_bad / (n propensity). 1 where nothing is known.
    """
    expect(0.0 < alpha < 1.0, "0 < alpha < 1", alpha, "0.05 asks for 95 % confidence")
    expect(0.0 <= propensity <= 1.0, "0 <= propensity <= 1", propensity, "0.02 looks at one part in fifty")
    if not 0 <= n_bad <= n:
        raise ValueError(f"Expected 0 <= n_bad <= n, got n_bad = {n_bad} of n = {n}; count each part once.")
    enough = math.log(1.0 / alpha)
    if propensity == 0.0 or log_evidence(n, n_bad, 1.0, propensity) < enough:
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if log_evidence(n, n_bad, middle, propensity) >= enough else (middle, high)
    return high  # the refuted end: rounding widens


def cusum(share: float, parts: float) -> tuple[int, int]:
    """(step, limit) of the detector that notices twice a share of wrong parts soonest, with few false alarms.

    A wrong part adds `step` to a sum, a right one takes 1 from it, and it begins anew at 0 wherever it falls below (Page,
    1954, Biometrika 41; that this is soonest: Moustakides, 1986, Annals of Statistics 14). At `limit` it alarms: after
    `parts` on average or later, wherever each part is wrong with probability `share`, below 0.5, or less given the past.
    """
    twice = min(2.0 * share, 0.99)
    step = max(1, round(math.log(twice / share) / math.log((1.0 - share) / (1.0 - twice))))
    limit, least = 1, 1
    while _run_length(share, step, limit) < parts:
        least, limit = limit, 2 * limit
    while limit - least > 1:
        middle = (least + limit) // 2
        least, limit = (middle, limit) if _run_length(share, step, middle) < parts else (least, middle)
    return step, limit


def _run_length(share: float, step: int, limit: int) -> float:
    """Mean number of parts until the alarm, from a sum of 0: exact (Brook and Evans, 1972, Biometrika 59)."""
    # From the sum s it is a[s] + b[s] t, where t is that from the largest sum: downwards, and at 0 the equation for t.
    a, b = [0.0] * (limit + step), [0.0] * (limit + step)  # 0 at and beyond the limit
    b[limit - 1] = 1.0
    for s in range(limit - 1, 0, -1):
        a[s - 1] = (a[s] - 1.0 - share * a[s + step]) / (1.0 - share)
        b[s - 1] = (b[s] - share * b[s + step]) / (1.0 - share)
    t = (1.0 + share * (a[step] - a[0])) / (share * (b[0] - b[step]))
    return a[0] + b[0] * t


@dataclass(frozen=True, slots=True)
class Outcomes:
    """How many parts the model was certain of since the policy's settings last changed, and what became of them.

    accepted, rejected : let go without a check.
    false_accepts, confirmed : of the accepted, known to be bad, and to be good.
    audited_accepts, audited_accepts_bad : checked though the model would have accepted, and the bad ones of them.
    false_rejects : of the rejected, those that somebody looked at and found good.
    audited_rejects, audited_rejects_good : checked though the model would have rejected, and the good ones of them.
    forgotten_accepts, forgotten_audited_accepts, forgotten_audited_rejects : those whose label was forgotten, which are in
        none of the counts of labels above.
    overdue_audited_accepts, overdue_audited_rejects : audits that were not reported in time, in none of the counts above.
    """

    accepted: int = 0
    false_accepts: int = 0
    confirmed: int = 0
    audited_accepts: int = 0
    audited_accepts_bad: int = 0
    rejected: int = 0
    audited_rejects: int = 0
    audited_rejects_good: int = 0
    forgotten_accepts: int = 0
    forgotten_audited_accepts: int = 0
    forgotten_audited_rejects: int = 0
    overdue_audited_accepts: int = 0
    overdue_audited_rejects: int = 0
    false_rejects: int = 0


@dataclass(frozen=True, slots=True)
class Bounded:
    """A group of parts and the bound on how many of them were decided wrongly, on average.

    n : parts the claim is about.  n_looked_at : those whose outcome is known.  n_bad : those known to be decided wrongly.
    propensity : probability with which each was looked at; 0 where nobody looked, so that nothing is known.
    alpha : what this bound may spend, the certificate's or a share of it.  upper : the bound, 1 where nothing is known.
    shadowed : none of them was decided without a check, each was audited: the shadow mode.
    """

    n: int
    n_looked_at: int
    n_bad: int
    propensity: float
    alpha: float
    upper: float
    shadowed: bool = False


@dataclass(frozen=True, slots=True)
class Certificate:
    """What can be said, at level 1 - alpha and at any moment, of the parts that the model decided alone.

    accepted : the bound on the mean probability that an accepted part was bad.  rejected : that a rejected one was good.
    tolerance : what is allowed of the accepted, by default 1 - lower_bound. Each bound holds at 1 - alpha by itself.
    prices : of a check, an escape and a false reject where they are what decides, see `Policy`; else None.
    """

    alpha: float
    tolerance: float
    accepted: Bounded
    rejected: Bounded
    prices: tuple[float, float, float] | None = None

    @property
    def saved(self) -> float | None:
        """At least so much, in the unit of the prices, was saved by not checking what is accepted, less what bad ones cost.

        Expected, as the bound is: n check - escape n upper, for all moments together. None where nothing is priced.
        """
        if self.prices is None:
            return None
        check, escape, _ = self.prices
        return self.accepted.n * (check - escape * self.accepted.upper)

    @property
    def kept(self) -> bool:
        """Whether the bound on the accepted parts lies within the tolerance."""
        return self.accepted.upper <= self.tolerance

    @property
    def sentence(self) -> str:
        """What a plant manager may rely on about accepted parts, in one sentence."""
        unknown = "silence is no success: set audit_rate, or stops='all' where every bad part stops the system"
        said = self._sentence(self.accepted, "that went on without a check", "accept", "bad", unknown)
        if self.saved is None or self.accepted.upper >= 1.0:
            return said
        known = f"at least {math.floor(self.saved):,}" if self.saved > 0.0 else "nothing for certain"
        return f"{said} By the prices not checking them saved {known}."

    @property
    def sentence_on_rejects(self) -> str:
        """The same about rejected parts."""
        unknown = "nobody looks at what is rejected: set audit_rate"
        return self._sentence(self.rejected, "rejected without a check", "reject", "good", unknown)

    def _sentence(self, bounded: Bounded, which: str, verb: str, wrong: str, unknown: str) -> str:
        parts = f"{bounded.n:,} part{'s' if bounded.n != 1 else ''}"
        but = " beyond the known stops" if verb == "accept" else ""
        if bounded.n == 0:
            return f"Nothing can be said yet: no part was one {which}."
        if bounded.propensity == 0.0:
            return f"Of {parts} {which} nothing can be said{but}, for {unknown}."
        if bounded.propensity < 1.0:
            which = f"that the model would {verb}, of which {bounded.n_looked_at:,} were audited"
        if bounded.shadowed:
            which = f"that the model would {verb}, each of which was checked"
        if bounded.upper >= 1.0:
            return f"Of {parts} {which}, nothing can be said yet: too few were looked at."
        # A sentence must not promise more than the bound: rounded up.
        digits = 1 if bounded.upper >= 0.01 else 2 if bounded.upper >= 0.001 else 4
        upper = f"{math.ceil(bounded.upper * 10.0 ** (digits + 2)) / 10.0**digits:g} %"
        return (
            f"Of {parts} {which}, at most {upper} were {wrong} on average, with {percent(1.0 - self.alpha, '.6g')} "
            f"confidence, however often one looks; the tolerance is {percent(self.tolerance, '.6g')}."
        )


def certify(outcomes: Outcomes, alpha: float, tolerance: float, stops: str, audit_rate: float) -> Certificate:
    """The certificate of what became of all certain decisions so far; `Policy.certificate` is the engine's way to it.

    stops : as in `Policy`; under "all" leave the newest part out while its outcome is open.
    audit_rate : probability with which a certain decision is verified all the same; where it changed, the smallest.

    Under "some" the bound comes from audits and is about all parts the model would have accepted, let go or audited. It
    never lies below the share known to be bad. A cell that confirmed or stopped every accepted part knows as much as under
    "all". Where both are possible they share alpha: whoever sees now the one and now the other is wrong with probability
    alpha at most. Rejected parts are known by audits; what is found good of them without being asked for is a share that
    the bound never lies below. A label that was forgotten, or is overdue, counts as a wrong
    decision.
    """
    expect(stops in ("all", "some"), "stops among all, some", stops)
    expect(0.0 < tolerance < 1.0, "0 < tolerance < 1", tolerance, "0.05 tolerates 5 % of errors")
    lost_accepts = outcomes.forgotten_audited_accepts + outcomes.overdue_audited_accepts
    lost_rejects = outcomes.forgotten_audited_rejects + outcomes.overdue_audited_rejects
    o = replace(
        outcomes,
        false_accepts=outcomes.false_accepts + outcomes.forgotten_accepts,
        audited_accepts=outcomes.audited_accepts + lost_accepts,
        audited_accepts_bad=outcomes.audited_accepts_bad + lost_accepts,
        audited_rejects=outcomes.audited_rejects + lost_rejects,
        audited_rejects_good=outcomes.audited_rejects_good + lost_rejects,
    )
    share = 1.0 if stops == "all" or audit_rate == 0.0 else 0.1  # of alpha: audits see less and need more
    if stops == "all" or 0 < o.accepted == o.false_accepts + o.confirmed:
        accepted = _bounded(o.accepted, o.accepted, o.false_accepts, 1.0, share * alpha)
    elif audit_rate == 0.0:
        accepted = _bounded(o.accepted, 0, 0, 0.0, alpha)
    else:
        n, n_bad = o.accepted + o.audited_accepts, o.audited_accepts_bad
        accepted = _bounded(n, o.audited_accepts, n_bad, audit_rate, (1.0 - share) * alpha)
        upper = max(accepted.upper, (n_bad + o.false_accepts) / max(1, n))
        accepted = replace(accepted, upper=upper, shadowed=audit_rate == 1.0 and o.accepted == 0)
    n, n_good = o.rejected + o.audited_rejects, o.audited_rejects_good
    rejected = _bounded(n, o.audited_rejects, n_good, audit_rate, alpha)
    rejected = replace(rejected, upper=max(rejected.upper, (n_good + o.false_rejects) / max(1, n)))
    rejected = replace(rejected, shadowed=audit_rate == 1.0 and o.rejected == 0)
    return Certificate(alpha, tolerance, accepted, rejected)


def _bounded(n: int, n_looked_at: int, n_bad: int, propensity: float, alpha: float) -> Bounded:
    return Bounded(n, n_looked_at, n_bad, propensity, alpha, failure_bound(n, n_bad, alpha, propensity))
