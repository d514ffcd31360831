"""The certificate: an anytime-valid upper bound on how many unchecked parts were decided wrongly.
`certify` computes a `Certificate` from counts of `Outcomes`, by `failure_bound`; its sentences are
what `dengine status` prints. `Policy.certificate` calls it for the engine. `cusum` designs the
drift detectors of `members`.

    >>> failure_bound(1203, 24, alpha=0.05)     # 1,203 parts, 24 of them bad: 2 % were seen
    0.0349...

With probability 1 - alpha the bound is, at all moments together, at or above the mean of the
failure probabilities that the parts so far really had. These may differ and drift, the model may be
retrained, and its rule may learn from every outcome. The one assumption is that audits are drawn
with the stated probability, whatever the part is. An audit that is overdue (`Policy.label_within`)
counts as bad until it is reported, so that a lost one cannot make the bound smaller; a younger one
is left out. The bound is about parts so far, not about those to come.

*Proof.* The evidence is an e-process, the capital of a bettor. It starts at 1, and the same share b
is bet on every part, that it will be good. With x = 1 for a bad part whose outcome is known, else
0,

    capital(theta) = product of (1 - b)^x / (1 - b q theta),  q the propensity, theta the tolerance.

Put each part's own failure probability p_i in the place of theta, whatever it is and however it
depends on the past. Then x has the mean q p_i, so the product M is a martingale that begins at 1,
and by Ville's inequality M ever reaches 1 / alpha with probability at most alpha. The logarithm is
concave, so capital(mean of p_1 ... p_n) <= M at every n at once. Neither stationarity nor a fixed n
is needed, but b must not depend on theta. As a stake, b is l = b q / (1 - b q theta) on 1 + l
(theta - x / q), inverse probability weighting. The capital grows with theta, so the values that are
not refuted are an interval. The best b is not known beforehand (it is 1 - odds(q p) / odds(q theta)
where all parts have one p), so the capital is a mixture of bets, weighted by the bets: large ones
matter while n is small.

References: Ville (1939); Waudby-Smith and Ramdas (2024), JRSS B 86(1); mixtures over bets: Robbins
(1970), Annals of Mathematical Statistics 41(5).
"""

import math
from bisect import bisect_left
from dataclasses import dataclass, replace
from functools import partial

from ..errors import counted, expect, percent

Prices = tuple[float, float, float]  # of a check, a bad accepted part, a good rejected part
OVERDRAFT = 2.0  # false accepts that the priced rule may be behind: the first parts may be unlucky
BETS = (0.05, 0.1, 0.2, 0.4, 0.7, 0.98)  # never 1: after one bad part its capital would stay 0


def log_evidence(n: int, n_bad: int, tolerance: float, propensity: float = 1.0) -> float:
    """Return the logarithm of the evidence that parts fail less often than `tolerance`.

    The evidence is the capital of a bettor who bets on each part being good. It starts at 1, so the
    result is 0 for no parts. It falls with each bad part, unless tolerance and propensity are 1,
    and rises with each other part, unless the tolerance is 0. It is the mean of the capitals of six
    bettors, each of whom always bets the same share of the capital (`BETS`, 0.05 to 0.98), weighted
    by these shares. No argument is checked.

    Parameters
    ----------
    n : int
        Number of parts, of known outcome or not.
    n_bad : int
        Parts among them whose outcome was asked for and is bad.
    tolerance : float
        Mean failure probability, from 0 to 1.
    propensity : float, default 1.0
        Probability, above 0, with which the outcome of each part was asked for. If it changed, the
        smallest value is on the safe side.

    Returns
    -------
    float
        log(1 / alpha) or more refutes, at error level alpha, that the mean failure probability of
        the parts is at the tolerance or above.
    """
    rate = propensity * tolerance
    logs = [n_bad * math.log1p(-bet) - n * math.log1p(-bet * rate) for bet in BETS]
    largest = max(logs)
    capital = sum(bet * math.exp(log - largest) for bet, log in zip(BETS, logs, strict=True))
    return largest + math.log(capital / sum(BETS))


def failure_bound(n: int, n_bad: int, alpha: float, propensity: float = 1.0) -> float:
    """Bound the mean failure probability of n parts from above.

    It may be computed again after every part: with probability 1 - alpha all these bounds hold.
    Whether an outcome is asked for must not depend on how the part is.

    Parameters
    ----------
    n : int
        Number of parts, of known outcome (good or bad) or not.
    n_bad : int
        Parts among them whose outcome was asked for and is bad.
    alpha : float
        Error level, between 0 and 1.
    propensity : float, default 1.0
        Probability with which the outcome of each part was asked for: 1 if every outcome is known,
        0 if none is.

    Returns
    -------
    float
        The largest mean failure probability that the evidence (`log_evidence`) does not refute,
        found by bisection and rounded up. It lies between n_bad / (n propensity), if that is below
        1, and 1. It is 1 if the evidence is too little to refute any, as for n = 0 or
        propensity = 0.

    Raises
    ------
    SettingError
        For an alpha or a propensity out of range.
    ValueError
        If n_bad is not between 0 and n.
    """
    expect(0.0 < alpha < 1.0, "0 < alpha < 1", alpha, "0.05 asks for 95 % confidence")
    expect(
        0.0 <= propensity <= 1.0,
        "0 <= propensity <= 1",
        propensity,
        "0.02 looks at one part in fifty",
    )
    if not 0 <= n_bad <= n:
        raise ValueError(
            f"Expected 0 <= n_bad <= n, got n_bad = {n_bad} of n = {n}; count each part once."
        )
    enough = math.log(1.0 / alpha)
    if log_evidence(n, n_bad, 1.0, propensity) < enough:
        return 1.0
    low = 0.0
    high = 1.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        if log_evidence(n, n_bad, middle, propensity) >= enough:
            high = middle
        else:
            low = middle
    return high  # the refuted end: rounding widens


def cusum(share: float, parts: float) -> tuple[int, int]:
    """Design the CUSUM detector that notices soonest when the share of wrong decisions doubles.

    A wrong decision adds `step` to a sum, a right one takes 1 from it, and the sum restarts at 0 if
    it would fall below. The detector alarms when the sum is `limit` or more. The doubled share is
    taken as 0.99 at most.

    Parameters
    ----------
    share : float
        Probability, above 0 and below 0.5, with which a decision may be wrong. It is not checked.
    parts : float
        So many parts, or more, shall pass on average before a false alarm, as long as each decision
        is wrong with probability `share` or less given the past.

    Returns
    -------
    step : int
        What a wrong decision adds to the sum: its log likelihood ratio, of the doubled share to
        `share`, in units of what a right decision takes from it, rounded to a whole number, and at
        least 1.
    limit : int
        The smallest limit, 1 or more, with which `parts` or more pass on average.

    References
    ----------
    Page (1954), Biometrika 41. Its optimality: Moustakides (1986), Annals of Statistics 14.
    """
    doubled = min(2.0 * share, 0.99)
    odds = math.log((1.0 - share) / (1.0 - doubled))
    step = max(1, round(math.log(doubled / share) / odds))
    limit = 1
    while _run_length(share, step, limit) < parts:
        limit = 2 * limit
    return step, bisect_left(
        range(limit + 1), parts, lo=max(1, limit // 2), key=partial(_run_length, share, step)
    )


def _run_length(share: float, step: int, limit: int) -> float:
    """Return the mean number of parts until a CUSUM that starts at 0 reaches `limit`.

    A CUSUM is a running sum that never falls below 0. Each part is a decision, which is wrong with
    the probability `share` and then adds `step`; a right one takes 1. The mean is exact, not
    simulated (Brook and Evans, 1972, Biometrika 59).
    """
    # The mean from the sum s is a[s] + b[s] t, where t is the mean from the largest sum; it is
    # computed downwards, and the equation at 0 gives t. At and beyond the limit both are 0.
    a = [0.0] * (limit + step)
    b = a.copy()
    b[limit - 1] = 1.0
    for s in range(limit - 1, 0, -1):
        a[s - 1] = (a[s] - 1.0 - share * a[s + step]) / (1.0 - share)
        b[s - 1] = (b[s] - share * b[s + step]) / (1.0 - share)
    t = (1.0 + share * (a[step] - a[0])) / (share * (b[0] - b[step]))
    return a[0] + b[0] * t


@dataclass(frozen=True, slots=True)
class Outcomes:
    """Counts of the parts that the model was certain of, and of their outcomes.

    They begin with the last change of the policy's settings.

    Attributes
    ----------
    accepted, rejected : int
        Decided without a check.
    false_accepts, confirmed : int
        Accepted parts known to be bad, and known to be good.
    audited_accepts, audited_accepts_bad : int
        Parts that were checked although the model would have accepted; the bad ones of these.
    audited_rejects, audited_rejects_good : int
        Parts that were checked although the model would have rejected; the good ones of these.
    forgotten_accepts, forgotten_audited_accepts, forgotten_audited_rejects : int
        Parts whose label was forgotten; they are in none of the counts of labels above.
    overdue_audited_accepts, overdue_audited_rejects : int
        Audits that were not reported in time; they are in none of the counts above.
    false_rejects : int
        Rejected parts that somebody inspected and found good.
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
class OutcomeBound:
    """A group of parts, and the bound on the mean probability that they were decided wrongly.

    Attributes
    ----------
    n : int
        Number of parts that the claim is about.
    n_with_outcome : int
        Parts among them whose outcome is known.
    n_bad : int
        Parts that are known to be decided wrongly.
    n_unchecked : int
        Parts among them that were decided without a check; the others were audited.
    propensity : float
        Probability with which the outcome of each was asked for; 0 if none was, so that nothing is
        known.
    alpha : float
        Error level of this bound: the certificate's, or a share of it.
    upper : float
        The bound; 1 if nothing is known.
    shadowed : bool
        Whether each of the parts was audited, as in shadow mode.
    """

    n: int
    n_with_outcome: int
    n_bad: int
    n_unchecked: int
    propensity: float
    alpha: float
    upper: float
    shadowed: bool = False


@dataclass(frozen=True, slots=True)
class Certificate:
    """The claims about parts that were decided without a check, at confidence 1 - alpha.

    Attributes
    ----------
    alpha : float
        Error level. Each of the two bounds holds at 1 - alpha by itself.
    tolerance : float
        Share of accepted parts that may be bad; 1 - lower_bound unless prices decide.
    accepted : OutcomeBound
        On the mean probability that an accepted part was bad.
    rejected : OutcomeBound
        On the mean probability that a rejected part was good.
    prices : three floats or None
        Prices of a check, of a bad accepted part and of a good rejected part, if the policy decides
        by prices.
    """

    alpha: float
    tolerance: float
    accepted: OutcomeBound
    rejected: OutcomeBound
    prices: Prices | None = None

    @property
    def saved(self) -> float | None:
        """Lower bound on what was saved by not checking accepted parts, in the unit of the prices.

        It is check * n_unchecked - escape * min(n_unchecked, n * upper), where `check` and `escape`
        are the prices of a check and of a bad part that is accepted, and the other names are
        attributes of `accepted`: the parts without a check, all parts that the bound is about
        (audited parts are among them if it comes from audits, checks at random of parts that the
        model would accept), and the bound on their mean failure probability. An audited part saves
        no check, and it cannot escape. The result bounds the expected saving. It may be negative:
        then not checking may have cost money. None without prices.
        """
        if self.prices is None:
            return None
        checks, escapes = self._checks_and_escapes(self.prices)
        return checks - escapes

    def _checks_and_escapes(self, prices: Prices) -> tuple[float, float]:
        """Return the price of the checks left out, and an upper bound on the cost of bad parts.

        Both are about accepted parts and in the unit of `prices`, which are the prices of a check,
        of a bad accepted part and of a good rejected part; the last is not used. The bad parts are
        at most `n * upper` of `accepted`, and at most all parts without a check.
        """
        check, escape, _ = prices
        n_unchecked = self.accepted.n_unchecked
        return n_unchecked * check, escape * min(n_unchecked, self.accepted.n * self.accepted.upper)

    @property
    def kept(self) -> bool:
        """Whether the bound on the accepted parts lies within the tolerance."""
        return self.accepted.upper <= self.tolerance

    @property
    def sentence(self) -> str:
        """The claim about accepted parts in English: "Of 1,203 parts ..., at most 3.5 % were bad".

        It names the confidence and the tolerance, the share of accepted parts that may be bad (if
        the policy decides by prices, the share up to which accepting pays). If nothing can be
        claimed, it says so, and why. With prices it also says what the checks that were left out
        would have cost, what bad parts cost at most, rounded up to a whole number, and the
        difference, rounded down: what was saved at least or, if it is not above 0, lost at most.
        These costs are missing if the bound is 1 or all parts were checked. With prices the last
        sentence says at which loss accepting pauses: parts are then checked instead.
        """
        claim = self._claim(
            self.accepted,
            "that went on without a check",
            "accept",
            "bad",
            "silence is no success: set an audit rate, or stops to all if every bad part stops the "
            "system",
        )
        if self.prices is None:
            return claim
        n_unchecked = self.accepted.n_unchecked
        if self.accepted.upper < 1.0 and n_unchecked:
            checks, escapes = self._checks_and_escapes(self.prices)
            balance = math.floor(checks - escapes)
            result = f"at least {balance:,} was saved"
            if balance <= 0:
                result = f"nothing was saved for certain, and at most {-balance:,} was lost"
            which = "them" if n_unchecked == self.accepted.n else f"{n_unchecked:,} of them"
            claim += (
                f" Not checking {which} spared {checks:,.10g} of checks, and bad parts cost at "
                f"most {math.ceil(escapes):,} on average: {result}."
            )
        return (
            f"{claim} Accepting pauses whenever the parts that the model would accept have, by "
            f"what is known of them, cost {OVERDRAFT * self.prices[1]:,.10g}, {OVERDRAFT:g} times "
            f"the price of a bad part, more than their checks."
        )

    @property
    def sentence_on_rejects(self) -> str:
        """The claim about rejected parts as one sentence: what share of them was good at most.

        It is about all parts that the model would reject, and says how many of them were audited
        (checked at random), or that each was checked. It also names the confidence, and the
        tolerance, the share that may be decided wrongly, or, if the policy decides by prices, the
        share up to which rejecting pays. If nothing can be claimed, it says so, and why.
        """
        return self._claim(
            self.rejected,
            "rejected without a check",
            "reject",
            "good",
            "nobody looks at what is rejected: set audit_rate",
        )

    def _claim(self, group: OutcomeBound, which: str, verb: str, wrong: str, unknown: str) -> str:
        """Return the claim about a group of parts as one sentence.

        It gives the number of parts, the bound on the share decided wrongly, in per cent and
        rounded up, the confidence, and the tolerance or, if the policy decides by prices, the share
        up to which the decision pays. If the group is empty, if no outcome was asked for
        (`propensity` is 0) or if the bound is 1, the sentence says instead that nothing can be
        said, and why. If no outcome was asked for, the reason is `unknown`, and for accepts nothing
        can be said "beyond the known stops", the bad parts that stopped the line. `which` describes
        the parts. If the bound comes from audits (checks at random of parts that the model would
        decide without a check), the sentence says in its place that the model would `verb`
        ("accept", "reject") these parts and how many of them were audited, or, if the group is
        `shadowed`, that each was checked. `wrong` is "bad" or "good", what a wrongly decided part
        was.
        """
        parts = counted(group.n, "part")
        but = " beyond the known stops" if verb == "accept" else ""
        if group.n == 0:
            return f"Nothing can be said yet: no part was {verb}ed without a check."
        if group.propensity == 0.0:
            return f"Of {parts} {which} nothing can be said{but}, for {unknown}."
        if group.shadowed:
            which = f"that the model would {verb}, each of which was checked"
        elif group.propensity < 1.0 or group.n_unchecked < group.n:
            which = f"that the model would {verb}, of which {group.n_with_outcome:,} were audited"
        if group.upper >= 1.0:
            return f"Of {parts} {which}, nothing can be said yet: too few were looked at."
        limit = f"the tolerance is {percent(self.tolerance, '.6g')}"
        if self.prices is not None:
            check, *errors = self.prices
            limit = f"it pays up to {percent(check / errors[verb == 'reject'], '.3g')}"
        return (
            f"Of {parts} {which}, at most {_round_up(group.upper)} were {wrong} on average, with "
            f"{percent(1.0 - self.alpha, '.6g')} confidence, however often one looks; {limit}."
        )


def _round_up(bound: float) -> str:
    """Return a probability in per cent, rounded up, as in "3.5 %": never less than the bound.

    `bound` is the probability, from 0 to 1. The text has at most one digit after the point from 1 %
    on, two from 0.1 % on, and four below.
    """
    digits = 4
    if bound >= 0.01:
        digits = 1
    elif bound >= 0.001:
        digits = 2
    return f"{math.ceil(bound * 10.0 ** (digits + 2)) / 10.0**digits:g} %"


def certify(
    outcomes: Outcomes, alpha: float, tolerance: float, stops: str, audit_rate: float
) -> Certificate:
    """Bound how often accepted parts were bad and rejected parts good, in all certain decisions.

    A decision is certain if the model would accept or reject the part without a check. Audits are
    checks of such parts at random.

    Parameters
    ----------
    outcomes : Outcomes
        Counts of the parts. If `stops` is "all", accepted parts whose outcome is still open must be
        left out of it.
    alpha : float
        Error level.
    tolerance : float
        Share of accepted parts that may be bad, between 0 and 1.
    stops : {"all", "some"}
        As in `Policy`: whether every bad accepted part stops the line and becomes known.
    audit_rate : float
        Probability with which a part is checked although the decision is certain; if it changed,
        the smallest value.

    Returns
    -------
    Certificate
        The two bounds, without prices; its tolerance is rounded to 12 decimals.

    Raises
    ------
    SettingError
        For alpha or the audit rate out of range; `Policy` has checked `stops` and the tolerance.
    ValueError
        If more parts of a group are wrong than are in it.

    Notes
    -----
    If `stops` is "all", or if there are accepted parts and each was confirmed as good, stopped the
    line or had its label withdrawn (forgotten), all outcomes are known, and the bound is about the
    accepted parts. Otherwise it comes from audits and is about all parts that the model would have
    accepted, those that were audited included; it is never below the share known to be bad. Without
    audits it is 1. With audits and `stops` "some", the bound may come from known outcomes now and
    from audits later. The two then share alpha, a tenth for known outcomes and nine tenths for
    audits: whoever sees both is wrong with probability alpha at most. The bound on rejected parts
    comes from audits, and without these it is 1; it is never below the share known to be good. An
    audit without a report in time (overdue), and a label that was withdrawn, count as wrong
    decisions.
    """
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
    # Share of alpha for known outcomes: audits see less and need more.
    share = 1.0 if stops == "all" or audit_rate == 0.0 else 0.1
    if stops == "all" or 0 < o.accepted == o.false_accepts + o.confirmed:
        accepted = _bound_outcomes(
            o.accepted, o.accepted, o.false_accepts, o.accepted, 1.0, share * alpha
        )
    elif audit_rate == 0.0:
        accepted = _bound_outcomes(o.accepted, 0, 0, o.accepted, 0.0, alpha)
    else:
        accepted = _bound_audits(
            o.accepted,
            o.audited_accepts,
            o.audited_accepts_bad,
            o.false_accepts,
            audit_rate,
            (1.0 - share) * alpha,
        )
    rejected = _bound_audits(
        o.rejected, o.audited_rejects, o.audited_rejects_good, o.false_rejects, audit_rate, alpha
    )
    # 1 - 0.95 is 0.05000000000000004.
    return Certificate(alpha, round(tolerance, 12), accepted, rejected)


def _bound_audits(
    n_unchecked: int, n_audited: int, n_bad: int, n_others: int, audit_rate: float, alpha: float
) -> OutcomeBound:
    """Return the bound on wrong decisions that rests on audits, and the counts that it is about.

    Audits are checks at random of parts that the model would decide without a check. The bound is
    about `n_unchecked` parts that were decided without a check and `n_audited` audited ones,
    together; `alpha` is its error level. `n_bad` of the audited parts, and `n_others` of the
    unchecked ones, are known to be decided wrongly: the bound is never below the share of both.
    `audit_rate` is the probability with which such a part is audited. In the result `n_bad` counts
    audited parts alone, and `shadowed` is True if `audit_rate` is 1 and no part went unchecked.
    Raises the errors of `failure_bound`.
    """
    n = n_unchecked + n_audited
    bound = _bound_outcomes(n, n_audited, n_bad, n_unchecked, audit_rate, alpha)
    return replace(
        bound,
        upper=max(bound.upper, (n_bad + n_others) / max(1, n)),
        shadowed=audit_rate == 1.0 and n_unchecked == 0,
    )


def _bound_outcomes(
    n: int, n_with_outcome: int, n_bad: int, n_unchecked: int, propensity: float, alpha: float
) -> OutcomeBound:
    """Return the group of these counts with its `failure_bound`."""
    upper = failure_bound(n, n_bad, alpha, propensity)
    return OutcomeBound(n, n_with_outcome, n_bad, n_unchecked, propensity, alpha, upper)
