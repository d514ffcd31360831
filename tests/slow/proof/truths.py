"""Planted truths: streams in which each part's probability of success is known.

    >>> stream = planted("soft", n=600, lower_bound=0.9, seed=0)
    >>> stream.data.y.mean(), stream.p.mean()     # each label was drawn with its probability p

A trace is an arch whose height shows u in [-1, 1], and p depends on u; a slope and noise say
nothing. The hard truths have many parts just beyond the tolerance, 1 - lower_bound: if a
neighbourhood, a bound or a retrain is slightly wrong there, it is wrong for many parts.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dengine import Dataset

Floats = NDArray[np.float64]
N_SAMPLES = 60
N_REPEATS = 5  # insertions of each part, where parts repeat
FEW = 0.04  # share of the parts of "bad few" that look nearly like the others; 90 % of them fail


@dataclass(frozen=True)
class Stream:
    """A data set in the order in which it is played, and its truth.

    Attributes
    ----------
    data : Dataset
    p : array of float, shape (n,)
        True success probability of each part.
    """

    data: Dataset
    p: Floats

    def mirrored(self) -> "Stream":
        """Return the stream with successes for failures, so that rejects are like accepts."""
        y = (1 - self.data.y).astype(np.int8)
        name = f"{self.data.name}, mirrored"
        return Stream(replace(self.data, y=y, name=name), 1.0 - self.p)


def sharp(u: Floats, _time: Floats, _lb: float) -> Floats:
    """Good and bad parts are clearly different."""
    return np.where(u > 0.0, 0.995, 0.02)


def soft(u: Floats, _time: Floats, lb: float) -> Floats:
    """Change p gradually; at u = -0.25 it is just at the tolerance."""
    log_odds = float(np.log(lb / (1.0 - lb))) + 0.5 + 2.0 * u
    return np.asarray(1.0 / (1.0 + np.exp(-log_odds)))


def step(u: Floats, _time: Floats, lb: float) -> Floats:
    """Have parts within the tolerance, slightly beyond it and far beyond it."""
    return np.select([u > 0.2, u > -0.6], [1.0 - 0.3 * (1.0 - lb), 1.0 - 1.4 * (1.0 - lb)], 0.05)


def mesa(u: Floats, _time: Floats, lb: float) -> Floats:
    """Have good parts in the middle."""
    return np.where(np.abs(u) < 0.5, 1.0 - 0.5 * (1.0 - lb), 0.3)


def edge(u: Floats, _time: Floats, lb: float) -> Floats:
    """Have the best parts slightly beyond the tolerance."""
    return np.where(u > -0.2, 1.0 - 1.1 * (1.0 - lb), 0.1)


def trap(u: Floats, _time: Floats, lb: float) -> Floats:
    """Have many parts far beyond the tolerance beside the good ones."""
    return np.select([u > 0.1, u > -0.6], [1.0 - 0.1 * (1.0 - lb), 1.0 - 3.2 * (1.0 - lb)], 0.05)


def staircase(u: Floats, _time: Floats, lb: float) -> Floats:
    """Have eight steps of p, on both sides of the tolerance."""
    multiples = np.array([8.0, 4.0, 2.0, 1.2, 0.8, 0.4, 0.2, 0.1])  # of the tolerance
    steps = np.clip((4.0 * (u + 1.0)).astype(int), 0, 7)
    return 1.0 - (1.0 - lb) * multiples[steps].clip(max=0.98 / (1.0 - lb))


def just_beyond(u: Floats, _time: Floats, lb: float) -> Floats:
    """Have all parts slightly beyond the tolerance, so that whatever passes breaks it."""
    return np.full_like(u, lb - 0.02)


def bad_few(u: Floats, _time: Floats, lb: float) -> Floats:
    """Have good parts above u = 0; `planted` adds the few."""
    return _good_above(u, 0.0, lb, otherwise=0.3)


def drifting(u: Floats, time: Floats, lb: float) -> Floats:
    """Have good parts above a place that moves up."""
    return _good_above(u, time - 0.5, lb)


def jumping(u: Floats, time: Floats, lb: float) -> Floats:
    """Have good parts above a place that jumps up half way."""
    return _good_above(u, np.where(time < 0.5, -0.5, 0.3), lb)


def seasons(u: Floats, time: Floats, lb: float) -> Floats:
    """Have good parts above a place that moves up and down three times."""
    return _good_above(u, 0.4 * np.sin(2.0 * np.pi * 3.0 * time), lb)


def _good_above(u: Floats, place: Floats | float, lb: float, otherwise: float = 0.5) -> Floats:
    """Return p well within the tolerance above a place of u, and far beyond it elsewhere."""
    return np.where(u > place, 1.0 - 0.3 * (1.0 - lb), otherwise)


# Name -> p (n,) of u (n,), time (n,) in [0, 1), and the lower bound.
TRUTHS: dict[str, Callable[[Floats, Floats, float], Floats]] = {
    "sharp": sharp,
    "soft": soft,
    "step": step,
    "mesa": mesa,
    "edge": edge,
    "trap": trap,
    "staircase": staircase,
    "just beyond": just_beyond,
    "bad few": bad_few,
    "drifting": drifting,
    "jumping": jumping,
    "seasons": seasons,
}


def draw_traces(u: Floats, rng: np.random.Generator) -> Floats:
    """Return arches of height 20 + 10 u newtons, with a slope and noise, shape (n, N_SAMPLES)."""
    t = np.linspace(0.0, np.pi, N_SAMPLES)
    slope = rng.normal(0.0, 1.0, len(u))
    arches = (20.0 + 10.0 * u)[:, None] * np.sin(t)
    noise = rng.normal(0, 0.3, (len(u), N_SAMPLES))
    return np.asarray(arches + slope[:, None] * np.cos(t) + noise)


def planted(
    truth: str, n: int, lower_bound: float, seed: int, rate: float = 0.5, order: str = "drawn"
) -> Stream:
    """Generate a stream of n traces.

    Parameters
    ----------
    truth : str
        A name in `TRUTHS`; "noise" and "parts" have the same success rate everywhere.
    n : int
    lower_bound : float
    seed : int
    rate : float, default 0.5
        Success rate of "noise" and "parts".
    order : {"drawn", "best first", "worst first"}, default "drawn"
        Order of the parts by u.
    """
    rng = np.random.default_rng([seed, 11])
    if truth == "parts":
        return _repeated_parts(n, rate, rng)
    u = rng.uniform(-1.0, 1.0, n)
    if order == "best first":
        u = np.sort(u)[::-1]
    elif order == "worst first":
        u = np.sort(u)
    time = np.arange(n) / n
    p = np.full(n, rate) if truth == "noise" else TRUTHS[truth](u, time, lower_bound)
    X = draw_traces(u, rng)
    if truth == "bad few":
        is_few = rng.random(n) < FEW
        p = np.where(is_few, 0.1, p)
        X[is_few, N_SAMPLES // 2 :] += 0.5  # less than two deviations of the noise
    y = (rng.random(n) < p).astype(np.int8)
    return Stream(Dataset(X.astype(np.float32), y, name=truth), p)


def _repeated_parts(n: int, rate: float, rng: np.random.Generator) -> Stream:
    """Return a stream in which every part comes `N_REPEATS` times, in random order.

    A part's label is drawn once, with the rate, whatever its trace. Its success probability is the
    rate when it comes first, and its label, which may be known by then, when it comes again.
    """
    n_parts = -(-n // N_REPEATS)
    part = rng.permutation(np.repeat(np.arange(n_parts), N_REPEATS))[:n]
    X = draw_traces(rng.uniform(-1.0, 1.0, n_parts), rng)[part]
    X = X + rng.normal(0.0, 0.1, (n, N_SAMPLES))
    y = (rng.random(n_parts) < rate).astype(np.int8)[part]
    p = y.astype(np.float64)
    first_rows = np.unique(part, return_index=True)[1]
    p[first_rows] = rate
    return Stream(Dataset(X.astype(np.float32), y, name="parts", part=part.astype(np.str_)), p)
