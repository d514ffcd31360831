"""Errors and costs of replays: the pooled error rate with its interval, and `Costs`, the prices of
checks and errors. `costs`, `tables` and `Replay.summary` compute with them.

>>> pooled_error(replays).rate, pooled_error(replays).upper     # of the accepted parts, bad ones
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..decision.intervals import wilson_interval
from ..decision.policy import PRICES
from ..errors import expect
from ..records import Floats, is_number

# What was decided -> the field of `Replay` that marks the wrong ones among them.
SIDES = {"accepted": "false_positive", "rejected": "false_negative"}
# What a height check adds to a cycle in the paper's cell; a line stop of the simulated cell,
# operator included, since the paper gives none; and the paper's cycle, 45 to 50 s: a good part that
# was rejected takes one more.
VERIFY_SECONDS, STOP_SECONDS, CYCLE_SECONDS = PRICES


@dataclass(frozen=True, slots=True)
class ErrorRate:
    """The share of wrong decisions over many replays, with its interval.

    Attributes
    ----------
    decided, wrong : int
        Decisions in all replays, and the wrong ones among them.
    traces : int
        Different traces among those that were decided.
    rate : float
        wrong / decided; NaN without decisions.
    lower, upper : float
        Interval of the rate; (0, 1) without decisions.
    """

    decided: int
    wrong: int
    traces: int
    rate: float
    lower: float
    upper: float


def pooled_error(replays: Sequence[Any], side: str = "accepted", alpha: float = 0.05) -> ErrorRate:
    """Compute the share of wrong decisions over many replays of one data set.

    An accepted part that was bad, and a rejected part that was good, are wrong decisions. Thirty
    shuffles of one set play the same traces thirty times, so they are not thirty independent
    samples. The unit is therefore the trace: the variance of the share is estimated from the
    differences between traces, by linearisation (the error of a ratio of two sums, to first order).
    The interval is Wilson's, for the number of independent decisions that would have this variance.
    If the variance is 0, for example because no decision or each was wrong, it is Wilson's for the
    number of different traces among these decisions. The interval holds for other parts of the same
    kind, not for another robot cell.

    Parameters
    ----------
    replays : sequence of Replay
        All of one data set; may be empty. No replay may be of a live run on a robot cell, which
        does not record which traces it had.
    side : {"accepted", "rejected"}, default "accepted"
        Which decisions are judged.
    alpha : float, default 0.05
        Error level of the interval.

    Returns
    -------
    error_rate : ErrorRate
        Without decisions of that side the rate is NaN and its interval (0, 1).

    Raises
    ------
    SettingError
        An unknown side; with decisions of that side also an alpha that is not between 0 and 1.
    IndexError
        A replay of a live run with one cycle or more.

    References
    ----------
    Cochran (1977), Sampling Techniques, section 6.3.
    """
    expect(side in SIDES, f"side {' or '.join(SIDES)}", side)
    size = 1 + max((int(replay.index.max()) for replay in replays if len(replay.index)), default=0)

    def count_per_trace(name: str) -> Floats:
        """Return for each trace of the data set in how many cycles of all replays a field was True.

        The result is float64, shape (size,), by the index of the trace in the data set. `name` is a
        field of `Replay` with a bool for each cycle; its field `index` says which trace a cycle
        had.
        """
        counts = np.zeros(size)
        for replay in replays:
            counts += np.bincount(replay.index[getattr(replay, name)], minlength=size)
        return counts

    decided = count_per_trace(side)
    wrong = count_per_trace(SIDES[side])
    n_decided = int(decided.sum())
    n_wrong = int(wrong.sum())
    n_traces = int((decided > 0).sum())
    if not n_decided:
        return ErrorRate(0, 0, 0, math.nan, 0.0, 1.0)
    rate = n_wrong / n_decided
    residuals = wrong - rate * decided
    correction = n_traces / max(n_traces - 1, 1)
    variance = correction * float((residuals**2).sum()) / n_decided**2
    n_effective = float(n_traces)
    if variance > 0.0:  # so the rate is neither 0 nor 1
        n_effective = rate * (1.0 - rate) / variance
    lower, upper = wilson_interval(n_effective * rate, n_effective * (1.0 - rate), alpha)
    return ErrorRate(n_decided, n_wrong, n_traces, rate, lower, upper)


def share_right(n_wrong: int, n_decided: int) -> float:
    """Return the share of right decisions, from 0 to 1; NaN if nothing was decided."""
    return 1.0 - n_wrong / n_decided if n_decided else math.nan


@dataclass(frozen=True, slots=True)
class Costs:
    """What a part can cost beyond its cycle, in one unit of the user's: seconds, or money.

    The defaults are seconds: the paper's check, the simulated cell's stop and the paper's cycle.

    Parameters
    ----------
    check : float, default 5.0
        Of an expensive verification. It must be above 0: a free check would never be left out.
    escape : float, default 120.0
        Of a bad part that was accepted: a line stop, or worse.
    false_reject : float, default 47.5
        Of a good part that was rejected.

    Raises
    ------
    SettingError
        A cost below 0 or not finite, or a check that costs nothing.
    """

    check: float = VERIFY_SECONDS
    escape: float = STOP_SECONDS
    false_reject: float = CYCLE_SECONDS

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            expect(
                is_number(value) and 0.0 <= value < math.inf,
                f"a finite cost of 0 or more as {field.name}",
                value,
            )
        expect(
            self.check > 0.0,
            "a check that costs something",
            0,
            "where it is free, verify everything",
        )

    @property
    def worst_accept(self) -> float:
        """Largest probability of being bad at which accepting a part pays: check / escape.

        It is 1 if an escape costs nothing, or no more than a check.
        """
        return min(1.0, self.check / self.escape) if self.escape else 1.0

    def saved(
        self, certain: float, false_positive: float = 0.0, false_negative: float = 0.0
    ) -> float:
        """Return what decisions without a check saved, less what the wrong ones cost.

        Parameters
        ----------
        certain : float
            Number of decisions without a check.
        false_positive, false_negative : float, default 0.0
            Bad parts accepted and good parts rejected among them.

        Returns
        -------
        saved : float
            In the unit of the costs; negative if the errors cost more than the checks.
        """
        return (
            self.check * certain - self.escape * false_positive - self.false_reject * false_negative
        )

    def of_part(self, accepted: float, rejected: float, bad: float, good: float) -> float:
        """Return the mean cost of a part if the model accepts and rejects these shares of parts.

        `bad` is the share of bad parts among the accepted ones, `good` that of good parts among the
        rejected ones. All other parts are checked. Shares are from 0 to 1, and none may be NaN. The
        result is in the unit of the costs.
        """
        return self.check - self.saved(accepted + rejected, accepted * bad, rejected * good)
