"""Planted truths: streams of which every part's probability of success is known, and can be seen in its trace.

    >>> stream = planted("soft", n=600, lower_bound=0.9, seed=0)
    >>> stream.data.y.mean(), stream.p.mean()            # labels were drawn from p, part by part

A trace is an arch of which the height tells u in [-1, 1], and u tells p; a slope beside it and noise tell nothing. The
hard truths are those with many parts just beyond the tolerance, 1 - lower_bound: what a ball of neighbours, a bound and a
retrain get slightly wrong is then wrong for many.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dengine import Dataset

Floats = NDArray[np.float64]
SAMPLES = 60
REPEATS = 5  # insertions a part, where parts repeat
NEARLY_ALIKE = 0.04  # of the parts of the bad few


@dataclass(frozen=True)
class Stream:
    """A data set in the order it is played, and the true success probability of each of its parts, (n,)."""

    data: Dataset
    p: Floats

    def mirrored(self) -> "Stream":
        """Successes for failures: what was said of accepts is then said of rejects."""
        y = (1 - self.data.y).astype(np.int8)
        return Stream(replace(self.data, y=y, name=f"{self.data.name}, mirrored"), 1.0 - self.p)


Truth = Callable[[Floats, Floats, float], Floats]


def _logistic(x: Floats) -> Floats:
    return np.asarray(1.0 / (1.0 + np.exp(-x)))


def _odds(lb: float) -> float:
    return float(np.log(lb / (1.0 - lb)))


def _good(u: Floats, above: Floats | float, lb: float, else_: float = 0.5) -> Floats:
    """Well within the tolerance above a place, far beyond it elsewhere."""
    return np.where(u > above, 1.0 - 0.3 * (1.0 - lb), else_)


TRUTHS: dict[str, Truth] = {  # u, time in [0, 1), LB -> p
    "sharp": lambda u, _t, _lb: np.where(u > 0.0, 0.995, 0.02),
    "soft": lambda u, _t, lb: _logistic(_odds(lb) + 0.5 + 2.0 * u),  # at u = -0.25 just at the tolerance
    "step": lambda u, _t, lb: np.select([u > 0.2, u > -0.6], [1.0 - 0.3 * (1.0 - lb), 1.0 - 1.4 * (1.0 - lb)], 0.05),
    "mesa": lambda u, _t, lb: np.where(np.abs(u) < 0.5, 1.0 - 0.5 * (1.0 - lb), 0.3),
    "edge": lambda u, _t, lb: np.where(u > -0.2, 1.0 - 1.1 * (1.0 - lb), 0.1),  # all that is good is just beyond
    "trap": lambda u, _t, lb: np.select([u > 0.1, u > -0.6], [1.0 - 0.1 * (1.0 - lb), 1.0 - 3.2 * (1.0 - lb)], 0.05),
    "staircase": lambda u, _t, lb: 1.0 - (1.0 - lb) * np.array([8.0, 4.0, 2.0, 1.2, 0.8, 0.4, 0.2, 0.1])[
        np.clip((4.0 * (u + 1.0)).astype(int), 0, 7)
    ].clip(max=0.98 / (1.0 - lb)),
    "just beyond": lambda u, _t, lb: np.full_like(u, lb - 0.02),  # everywhere: whatever passes breaks the tolerance
    "bad few": lambda u, _t, lb: _good(u, 0.0, lb, 0.3),
    "drifting": lambda u, t, lb: _good(u, t - 0.5, lb),
    "jumping": lambda u, t, lb: _good(u, np.where(t < 0.5, -0.5, 0.3), lb),
    "seasons": lambda u, t, lb: _good(u, 0.4 * np.sin(2.0 * np.pi * 3.0 * t), lb),
}  # fmt: skip


def traces(u: Floats, rng: np.random.Generator) -> Floats:
    """(n,) -> (n, SAMPLES): arches of height 20 + 10 u newtons, with a slope and noise."""
    t = np.linspace(0.0, np.pi, SAMPLES)
    slope = rng.normal(0.0, 1.0, len(u))
    return np.asarray(
        (20.0 + 10.0 * u)[:, None] * np.sin(t)
        + slope[:, None] * np.cos(t)
        + rng.normal(0, 0.3, (len(u), SAMPLES))
    )


def planted(
    truth: str, n: int, lower_bound: float, seed: int, rate: float = 0.5, order: str = "drawn"
) -> Stream:
    """A stream of n traces. truth : a name in `TRUTHS`; "noise" and "parts" have the success rate `rate` everywhere.

    order : "drawn", or by u, "best first" or "worst first".
    """
    rng = np.random.default_rng([seed, 11])
    if truth == "parts":
        return _parts(n, rate, rng)
    u = rng.uniform(-1.0, 1.0, n)
    if order != "drawn":
        u = np.sort(u)[:: -1 if order == "best first" else 1]
    t = np.arange(n) / n
    p = np.full(n, rate) if truth == "noise" else TRUTHS[truth](u, t, lower_bound)
    X = traces(u, rng)
    if truth == "bad few":
        few = rng.random(n) < NEARLY_ALIKE
        p = np.where(few, 0.1, p)
        X[few, SAMPLES // 2 :] += 0.5  # less than two deviations of the noise
    y = (rng.random(n) < p).astype(np.int8)
    return Stream(Dataset(X.astype(np.float32), y, name=truth), p)


def _parts(n: int, rate: float, rng: np.random.Generator) -> Stream:
    """Every part comes `REPEATS` times, in random order; its label is drawn once, at the rate, whatever its trace.

    Its success probability is the rate when it comes first, and what is known of it by then when it comes again.
    """
    m = -(-n // REPEATS)
    number = rng.permutation(np.repeat(np.arange(m), REPEATS))[:n]
    X = traces(rng.uniform(-1.0, 1.0, m), rng)[number] + rng.normal(0.0, 0.1, (n, SAMPLES))
    y = (rng.random(m) < rate).astype(np.int8)[number]
    p = y.astype(np.float64)
    p[np.unique(number, return_index=True)[1]] = rate
    return Stream(Dataset(X.astype(np.float32), y, name="parts", part=number.astype(np.str_)), p)
