"""The certificate's bound against streams whose true rates go anywhere: in how many is it ever wrong?

>>> ever_wrong("a step up", propensity=0.1, alpha=0.1, streams=2000, parts=2000)
"""

import math
from collections.abc import Callable

import numpy as np

from dengine.decision.certificate import log_evidence

CLAIM = 0.05
PROPENSITIES = (1.0, 0.1, 0.02)
STREAMS: dict[
    str, Callable[[np.ndarray], np.ndarray]
] = {  # part's position in [0, 1) -> its true failure probability
    "at the claim": lambda t: np.full_like(t, CLAIM),
    "below it": lambda t: np.full_like(t, 0.4 * CLAIM),
    "far below it": lambda t: np.full_like(t, 0.1 * CLAIM),
    "slowly up across it": lambda t: CLAIM * 2 * t,
    "slowly down": lambda t: CLAIM * 2 * (1 - t),
    "a step up": lambda t: np.where(t < 0.3, 0.2 * CLAIM, 4 * CLAIM),
    "sinusoidal": lambda t: CLAIM * (1 + 0.95 * np.sin(30 * t)),
    "all in bursts": lambda t: np.where((40 * t) % 1.0 < 0.05, 0.9, 0.002),
}


def most_bad(mean: np.ndarray, alpha: float, propensity: float) -> np.ndarray:
    """By the number of parts: how many bad ones at most let the true running mean be refuted; -1 where none would."""
    allowed, k = np.empty(len(mean), dtype=np.int32), -1
    for i, theta in enumerate(mean):
        while log_evidence(i + 1, k + 1, float(theta), propensity) >= math.log(1 / alpha):
            k += 1
        while k >= 0 and log_evidence(i + 1, k, float(theta), propensity) < math.log(1 / alpha):
            k -= 1
        allowed[i] = k
    return allowed


def ever_wrong(
    name: str, propensity: float, alpha: float, streams: int, parts: int, seed: int = 0
) -> float:
    """Share of streams in which the bound lies, after any part, below the running mean of the true probabilities."""
    rng, p = np.random.default_rng(seed), STREAMS[name](np.arange(parts) / parts)
    allowed = most_bad(np.cumsum(p) / np.arange(1, parts + 1), alpha, propensity)
    wrong = 0
    for _ in range(streams):
        bad = rng.random(parts) < p
        audited = rng.random(parts) < propensity
        wrong += bool((np.cumsum(bad & audited) <= allowed).any())
    return wrong / streams
