"""Evidence by betting: how surely a running mean failure probability lies below a tolerance, at any moment.

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
"""

import math


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
