"""How often is the certificate's bound ever wrong, on streams whose true rates are known?

>>> share_ever_wrong("a step up", propensity=0.1, alpha=0.1, n_streams=2000, n_parts=2000)
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dengine.decision.certificate import log_evidence

Floats = NDArray[np.float64]

CLAIM = 0.05  # failure probability that the certificate is about
PROPENSITIES = (1.0, 0.1, 0.02)
# Name -> true failure probability by the part's position in [0, 1).
STREAMS: dict[str, Callable[[Floats], Floats]] = {
    "at the claim": lambda t: np.full_like(t, CLAIM),
    "below it": lambda t: np.full_like(t, 0.4 * CLAIM),
    "far below it": lambda t: np.full_like(t, 0.1 * CLAIM),
    "slowly up across it": lambda t: CLAIM * 2 * t,
    "slowly down": lambda t: CLAIM * 2 * (1 - t),
    "a step up": lambda t: np.where(t < 0.3, 0.2 * CLAIM, 4 * CLAIM),
    "sinusoidal": lambda t: CLAIM * (1 + 0.95 * np.sin(30 * t)),
    "all in bursts": lambda t: np.where((40 * t) % 1.0 < 0.05, 0.9, 0.002),
}


def refuting_counts(means: Floats, alpha: float, propensity: float) -> NDArray[np.int32]:
    """Return how many bad parts at most refute the true running mean, for each number of parts.

    Parameters
    ----------
    means : array of float, shape (n,)
        Running means of the true failure probabilities.
    alpha : float
    propensity : float

    Returns
    -------
    counts : array of int32, shape (n,)
        With so many bad parts or fewer the bound lies below the true mean; -1 if it never does.
    """
    threshold = math.log(1 / alpha)
    counts = np.empty(len(means), dtype=np.int32)
    k = -1
    for i, mean in enumerate(means):
        n = i + 1
        while log_evidence(n, k + 1, float(mean), propensity) >= threshold:
            k += 1
        while k >= 0 and log_evidence(n, k, float(mean), propensity) < threshold:
            k -= 1
        counts[i] = k
    return counts


def share_ever_wrong(
    name: str, propensity: float, alpha: float, n_streams: int, n_parts: int, seed: int = 0
) -> float:
    """Return the share of streams in which the bound is wrong at any moment.

    It is wrong if it lies below the running mean of the true failure probabilities.

    Parameters
    ----------
    name : str
        A name in `STREAMS`.
    propensity : float
        Probability with which a part is audited.
    alpha : float
    n_streams, n_parts : int
    seed : int, default 0
    """
    rng = np.random.default_rng(seed)
    p = STREAMS[name](np.arange(n_parts) / n_parts)
    means = np.cumsum(p) / np.arange(1, n_parts + 1)
    counts = refuting_counts(means, alpha, propensity)
    n_wrong = 0
    for _ in range(n_streams):
        is_bad = rng.random(n_parts) < p
        is_audited = rng.random(n_parts) < propensity
        n_wrong += bool((np.cumsum(is_bad & is_audited) <= counts).any())
    return n_wrong / n_streams
