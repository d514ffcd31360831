"""Confidence intervals of a success probability, from counts of successes and failures.

    >>> from dengine import wilson_interval
    >>> wilson_interval(96, 4, alpha=0.05)  # the paper's "Wilson Formula results" (b), first row
    (0.901..., 0.984...)

All are two-sided at error level alpha: z is the 1 - alpha/2 normal quantile, each tail holds alpha/2.
All take integer arrays of one shape and return `(lower, upper)`, float64 of that shape (floats for scalars),
with `0 <= lower <= n_success / n <= upper <= 1`. Without neighbours nothing is known: (0, 1).
"""

from collections.abc import Callable
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import expect

SORTED = ("pooled", "cost")  # guarantees under which the interval around a trace only sorts
SORTING = 0.5  # two-sided error level of an interval that only sorts: z = 0.67
Bounds = tuple[Any, Any]  # two floats for scalar counts, two float64 arrays otherwise
Interval = Callable[[ArrayLike, ArrayLike, float], Bounds]
FloatArray = NDArray[np.float64]


def level_of(alpha: float, guarantee: str) -> float:
    """Error level of the interval around a trace, for each guarantee."""
    return SORTING if guarantee in SORTED else alpha


def normal_quantile(alpha: float) -> float:
    """Z of a two-sided interval: the 1 - alpha/2 quantile of the standard normal distribution."""
    told = 0.0 < alpha / 2.0 < 1.0 - alpha / 2.0 < 1.0  # one that is too small to be told from 0 is none either
    expect(told, "0 < alpha < 1", alpha, "0.05 asks for a 95 % interval")
    return NormalDist().inv_cdf(1.0 - alpha / 2.0)


def wilson_interval(n_success: ArrayLike, n_failure: ArrayLike, alpha: float = 0.05) -> Bounds:
    """Wilson score interval of a success probability.

    n_success, n_failure : int arrays of one shape, counts within the radius.
    alpha : two-sided error level; z is the 1 - alpha/2 normal quantile.
    Returns (lower, upper), float64, same shape. No neighbours: (0, 1), nothing is known yet.
    Source: Wilson (1927), JASA 22(158); the paper's equation for the Wilson score interval.
    """
    z = normal_quantile(alpha)
    n_s, n_f, k = _counts(n_success, n_failure)
    k_safe = np.maximum(k, 1.0)
    centre = (n_s + z * z / 2.0) / (k + z * z)
    half = z / (k + z * z) * np.sqrt(n_s * n_f / k_safe + z * z / 4.0)
    return _tidy(centre - half, centre + half, n_s, k)


def binomial_interval(n_success: ArrayLike, n_failure: ArrayLike, alpha: float = 0.05) -> Bounds:
    """Binomial (Wald) interval: the paper's baseline, Eq. 1. One neighbour already gives [1, 1]: not a bound to rely on.

    Arguments and result as `wilson_interval`. Source: Brown, Cai and DasGupta (2001), Statistical Science 16(2).
    """
    z = normal_quantile(alpha)
    n_s, n_f, k = _counts(n_success, n_failure)
    k_safe = np.maximum(k, 1.0)
    half = z / np.sqrt(k_safe) * np.sqrt(n_s * n_f / k_safe**2)
    return _tidy(n_s / k_safe - half, n_s / k_safe + half, n_s, k)


def clopper_pearson_interval(n_success: ArrayLike, n_failure: ArrayLike, alpha: float = 0.05) -> Bounds:
    """Clopper-Pearson interval: never covers less than 1 - alpha, for any probability and any count.

    Arguments and result as `wilson_interval`. Source: Clopper and Pearson (1934), Biometrika 26(4).
    """
    return _beta_interval(n_success, n_failure, alpha, 0.0, 1.0)


def jeffreys_interval(n_success: ArrayLike, n_failure: ArrayLike, alpha: float = 0.05) -> Bounds:
    """Jeffreys interval: equal-tailed credible interval under the Beta(1/2, 1/2) prior, ends closed at 0 and n successes.

    Arguments and result as `wilson_interval`. Source: Brown, Cai and DasGupta (2001), Statistical Science 16(2), 4.1.1.
    """
    return _beta_interval(n_success, n_failure, alpha, 0.5, 0.5)


INTERVALS: dict[str, Interval] = {
    "wilson": wilson_interval,
    "binomial": binomial_interval,
    "clopper_pearson": clopper_pearson_interval,
    "jeffreys": jeffreys_interval,
}


def _beta_interval(n_success: ArrayLike, n_failure: ArrayLike, alpha: float, own: float, other: float) -> Bounds:
    """Quantiles of a Beta distribution; own, other : what is added to the counts of its side and of the other one."""
    from scipy.special import betaincinv

    normal_quantile(alpha)  # one place checks alpha
    n_s, n_f, k = _counts(n_success, n_failure)
    lower = np.where(n_s > 0, betaincinv(np.maximum(n_s + own, 0.5), n_f + other, alpha / 2.0), 0.0)
    upper = np.where(n_f > 0, betaincinv(n_s + other, np.maximum(n_f + own, 0.5), 1.0 - alpha / 2.0), 1.0)
    return _tidy(lower, upper, n_s, k)


def _counts(n_success: ArrayLike, n_failure: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    n_s, n_f = np.asarray(n_success, dtype=np.float64), np.asarray(n_failure, dtype=np.float64)
    if n_s.shape != n_f.shape:
        raise ValueError(f"Expected counts of one shape, got {n_s.shape} successes and {n_f.shape} failures.")
    if np.any(n_s < 0) or np.any(n_f < 0):
        raise ValueError("Expected counts of zero or more, got a negative one.")
    return n_s, n_f, n_s + n_f


def _tidy(lower: FloatArray, upper: FloatArray, n_s: FloatArray, k: FloatArray) -> Bounds:
    # Rounding must not push a bound past the observed rate or out of [0, 1].
    rate = n_s / np.maximum(k, 1.0)
    lower = np.where(k > 0, np.clip(np.minimum(lower, rate), 0.0, 1.0), 0.0)
    upper = np.where(k > 0, np.clip(np.maximum(upper, rate), 0.0, 1.0), 1.0)
    return (float(lower), float(upper)) if lower.ndim == 0 else (lower, upper)
