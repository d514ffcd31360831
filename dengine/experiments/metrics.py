"""What a replay's decisions were worth: errors of many replays with an interval, and costs.

>>> pooled_error(replays).rate, pooled_error(replays).upper     # of the accepted parts, the share of bad ones
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..decision.intervals import wilson_interval
from ..errors import expect
from ..records import is_number

SIDES = {"accepted": "false_positive", "rejected": "false_negative"}  # and which of them are wrong
VERIFY_SECONDS = 5.0  # what a height check costs a cycle, in the paper's cell
CYCLE_SECONDS = 47.5  # the paper: an insertion takes 45 to 50 s; a good part that was rejected takes one more
STOP_SECONDS = 120.0  # a system stop, operator included: of the simulated cell, the paper gives none


@dataclass(frozen=True, slots=True)
class ErrorRate:
    """A share of wrong decisions over many replays, and its interval at level `alpha`.

    decided, wrong : decisions in all replays.  traces : different traces among them.  rate : wrong / decided, or NaN.
    """

    decided: int
    wrong: int
    traces: int
    rate: float
    lower: float
    upper: float


def pooled_error(replays: Sequence[Any], side: str = "accepted", alpha: float = 0.05) -> ErrorRate:
    """Share of wrong ones among all parts that were accepted (or rejected), with an interval that is honest of shuffles.

    Thirty shuffles of one set play the same traces thirty times, so they are no thirty samples of the world. A trace is
    the unit: the variance of the ratio is that between traces (linearised, Cochran 1977, Sampling Techniques, 6.3), and
    the interval is Wilson's at the number of independent decisions that has this variance, at most the number of
    different traces where no decision was wrong. It speaks of other parts of the same kind, not of another cell.

    replays : of one data set, each a `Replay`.  side : "accepted" or "rejected"; SettingError for another.
    """
    expect(side in SIDES, f"side {' or '.join(SIDES)}", side)
    size = 1 + max((int(r.index.max()) for r in replays if len(r.index)), default=0)
    decided, wrong = (  # (size,) of each trace
        np.sum([np.zeros(size), *(np.bincount(r.index[getattr(r, name)], minlength=size) for r in replays)], axis=0)
        for name in (side, SIDES[side])
    )
    total, errors, traces = int(decided.sum()), int(wrong.sum()), int((decided > 0).sum())
    if not total:
        return ErrorRate(0, 0, 0, math.nan, 0.0, 1.0)
    rate = errors / total
    variance = traces / max(traces - 1, 1) * float(((wrong - rate * decided) ** 2).sum()) / total**2
    n = rate * (1.0 - rate) / variance if variance > 0.0 and 0.0 < rate < 1.0 else float(traces)
    lower, upper = wilson_interval(n * rate, n * (1.0 - rate), alpha)
    return ErrorRate(total, errors, traces, rate, float(lower), float(upper))


@dataclass(frozen=True, slots=True)
class Costs:
    """What a part can cost beyond its cycle, in one unit of the user's: seconds of production, or money.

    check : an expensive verification.  escape : a bad part that was accepted: a stop, or worse.  false_reject : a good part
    that was sent back. By default the paper's check, the simulated cell's stop and the paper's cycle, in seconds.
    SettingError for a check that costs nothing, which would never be worth leaving out, or a cost below 0.
    """

    check: float = VERIFY_SECONDS
    escape: float = STOP_SECONDS
    false_reject: float = CYCLE_SECONDS

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            expect(is_number(value) and 0.0 <= value < math.inf, f"a finite cost of 0 or more as {each.name}", value)
        expect(self.check > 0.0, "a check that costs something", 0, "where it is free, verify everything")

    @property
    def worst_accept(self) -> float:
        """An accepted part is worth its risk where it is bad with at most this probability: check / escape, at most 1."""
        return min(1.0, self.check / self.escape) if self.escape else 1.0

    def saved(self, certain: float, false_positive: float = 0.0, false_negative: float = 0.0) -> float:
        """What so many decisions without a check saved, less what the wrong ones among them cost."""
        return self.check * certain - self.escape * false_positive - self.false_reject * false_negative
