"""Confidence intervals of a success probability, from counts of successes and failures: Wilson,
Wald (the paper's "binomial"), Clopper-Pearson and Jeffreys. `INTERVALS` lists them by name for the
policy and the rules; an export can have the first two alone. `normal_quantile` turns an error level
into z.

    >>> from dengine import wilson_interval
    >>> wilson_interval(96, 4, alpha=0.05)  # the paper's "Wilson Formula results" (b), first row
    (0.901..., 0.984...)

The public functions take integer arrays and return `(lower, upper)` with `0 <= lower <= n_success /
n <= upper <= 1`. Each interval is two-sided at error level alpha: z is the 1 - alpha / 2 quantile
of the normal distribution, and each tail holds alpha / 2. If nothing was counted, the interval is
(0, 1).

The Wilson and the Wald formula stand here twice, and nowhere else. `wilson_limits` and
`wald_limits` are written for NumPy arrays and for PyTorch tensors alike (they are given the library
as `xp`): the public functions and the ONNX export share them. `wilson_bound` and `wald_bound` take
two integers: TorchScript compiles only functions with fixed scalar types, and a tensor operation
for each of the dozen steps would slow down every decision.
"""

import math
from collections.abc import Callable
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..errors import expect
from ..records import Floats

SORTING_GUARANTEES = ("pooled", "cost")  # under these the interval around a trace only sorts parts
SORTING_ERROR_LEVEL = 0.5  # of an interval that only sorts: z = 0.67
Bounds = tuple[Any, Any]  # two floats for scalar counts, two float64 arrays otherwise
ScalarBounds = tuple[float, float]  # lower, upper
Interval = Callable[[ArrayLike, ArrayLike, float], Bounds]
ScalarBound = Callable[[int, int, float], ScalarBounds]


def interval_error_level(alpha: float, guarantee: str) -> float:
    """Return the error level of the interval around one trace under a policy's guarantee.

    Parameters
    ----------
    alpha : float
        The policy's error level.
    guarantee : str
        A name in `policy.RULES`, or `module:Class`.

    Returns
    -------
    float
        `SORTING_ERROR_LEVEL` if the interval only sorts parts, else `alpha`.
    """
    return SORTING_ERROR_LEVEL if guarantee in SORTING_GUARANTEES else alpha


def normal_quantile(alpha: float) -> float:
    """Return z of a two-sided interval: the 1 - alpha / 2 quantile of the normal distribution.

    Raises
    ------
    SettingError
        If alpha is not between 0 and 1, or so small that 1 - alpha / 2 rounds to 1.
    """
    expect(
        0.0 < alpha / 2.0 < 1.0 - alpha / 2.0 < 1.0,
        "0 < alpha < 1",
        alpha,
        "0.05 asks for a 95 % interval",
    )
    return NormalDist().inv_cdf(1.0 - alpha / 2.0)


def wilson_interval(n_success: ArrayLike, n_failure: ArrayLike, alpha: float = 0.05) -> Bounds:
    """Compute the Wilson score interval of a success probability.

    Parameters
    ----------
    n_success, n_failure : array of int, of one shape
        Labels of each kind within the radius.
    alpha : float, default 0.05
        Error level; the interval is two-sided, with z at 1 - alpha / 2.

    Returns
    -------
    lower, upper : float64 array of that shape, or float for scalar counts
        (0, 1) if nothing was counted.

    Raises
    ------
    SettingError
        If alpha is not between 0 and 1, or so small that 1 - alpha / 2 rounds to 1.
    ValueError
        If the shapes differ or a count is negative.

    References
    ----------
    Wilson (1927), JASA 22(158); the paper's equation for the Wilson score interval.
    """
    return _normal_interval(wilson_limits, n_success, n_failure, alpha)


def wald_interval(n_success: ArrayLike, n_failure: ArrayLike, alpha: float = 0.05) -> Bounds:
    """Compute the Wald interval, the normal approximation; the paper's baseline, Eq. 1.

    A single neighbour already gives [1, 1], so it is not a bound to rely on. The paper calls it the
    binomial interval; `binomial_interval` and the setting "binomial" are the same function. Raises
    the errors of `wilson_interval`.

    Parameters
    ----------
    n_success, n_failure : array of int, of one shape
        Labels of each kind within the radius.
    alpha : float, default 0.05
        Error level; the interval is two-sided, with z at 1 - alpha / 2.

    Returns
    -------
    lower, upper : float64 array of that shape, or float for scalar counts
        (0, 1) if nothing was counted.

    References
    ----------
    Brown, Cai and DasGupta (2001), Statistical Science 16(2).
    """
    return _normal_interval(wald_limits, n_success, n_failure, alpha)


binomial_interval = wald_interval
"""The paper's name of `wald_interval`."""


def clopper_pearson_interval(
    n_success: ArrayLike, n_failure: ArrayLike, alpha: float = 0.05
) -> Bounds:
    """Compute the Clopper-Pearson interval, which never covers with less than 1 - alpha.

    Raises the errors of `wilson_interval`.

    Parameters
    ----------
    n_success, n_failure : array of int, of one shape
        Labels of each kind within the radius.
    alpha : float, default 0.05
        Error level; the interval is two-sided.

    Returns
    -------
    lower, upper : float64 array of that shape, or float for scalar counts
        (0, 1) if nothing was counted.

    References
    ----------
    Clopper and Pearson (1934), Biometrika 26(4).
    """
    return _beta_interval(n_success, n_failure, alpha, 0.0, 1.0)


def jeffreys_interval(n_success: ArrayLike, n_failure: ArrayLike, alpha: float = 0.05) -> Bounds:
    """Compute the Jeffreys interval: equal-tailed credible interval under a Beta(1/2, 1/2) prior.

    The lower end is 0 without a success, the upper end 1 without a failure. Raises the errors of
    `wilson_interval`.

    Parameters
    ----------
    n_success, n_failure : array of int, of one shape
        Labels of each kind within the radius.
    alpha : float, default 0.05
        Error level; the interval is two-sided.

    Returns
    -------
    lower, upper : float64 array of that shape, or float for scalar counts
        (0, 1) if nothing was counted.

    References
    ----------
    Brown, Cai and DasGupta (2001), Statistical Science 16(2), section 4.1.1.
    """
    return _beta_interval(n_success, n_failure, alpha, 0.5, 0.5)


INTERVALS: dict[str, Interval] = {
    "wilson": wilson_interval,
    "binomial": wald_interval,
    "clopper_pearson": clopper_pearson_interval,
    "jeffreys": jeffreys_interval,
}


def wilson_limits(xp: Any, n_success: Any, n_failure: Any, z: float) -> Bounds:
    """Compute Wilson intervals from counts, float64 arrays (`xp` is numpy) or tensors (torch).

    Parameters
    ----------
    xp : module
        `numpy` or `torch`, whose functions are used.
    n_success, n_failure : float64 array or tensor, of one shape
        Counts of successes and of failures, 0 or more; not checked.
    z : float
        Quantile of the normal distribution at 1 - alpha / 2 (`normal_quantile`).

    Returns
    -------
    lower, upper : float64 array or tensor of that shape
        Ends of the interval of each success probability, cut to [0, 1], and moved to enclose the
        observed rate if rounding left it outside; (0, 1) if nothing was counted.
    """
    n = xp.where(n_success + n_failure > 0.0, n_success + n_failure, 1.0)
    centre = (n_success + z * z / 2.0) / (n + z * z)
    half_width = z / (n + z * z) * xp.sqrt(n_success * n_failure / n + z * z / 4.0)
    return _clip_limits(xp, centre - half_width, centre + half_width, n_success, n_failure)


def wald_limits(xp: Any, n_success: Any, n_failure: Any, z: float) -> Bounds:
    """Compute Wald intervals from counts, float64 arrays (`xp` is numpy) or tensors (torch).

    Parameters
    ----------
    xp : module
        `numpy` or `torch`, whose functions are used.
    n_success, n_failure : float64 array or tensor, of one shape
        Counts of successes and of failures, 0 or more; not checked.
    z : float
        Quantile of the normal distribution at 1 - alpha / 2 (`normal_quantile`).

    Returns
    -------
    lower, upper : float64 array or tensor of that shape
        Ends of the interval of each success probability, cut to [0, 1], and moved to enclose the
        observed rate if rounding left it outside; (0, 1) if nothing was counted.
    """
    n = xp.where(n_success + n_failure > 0.0, n_success + n_failure, 1.0)
    half_width = z / xp.sqrt(n) * xp.sqrt(n_success * n_failure / (n * n))
    rate = n_success / n
    return _clip_limits(xp, rate - half_width, rate + half_width, n_success, n_failure)


def wilson_bound(n_success: int, n_failure: int, z: float) -> ScalarBounds:
    """Compute the Wilson interval of a success probability from two integer counts.

    `z` is the normal quantile of the interval (`normal_quantile`). Returns (lower, upper) within
    [0, 1], which encloses the observed rate, and is (0, 1) if both counts are 0. The counts are not
    checked. TorchScript compiles it.
    """
    total = float(n_success + n_failure)
    if total == 0.0:
        return 0.0, 1.0
    rate = n_success / total
    centre = (n_success + z * z / 2.0) / (total + z * z)
    half_width = z / (total + z * z) * math.sqrt(n_success * n_failure / total + z * z / 4.0)
    return max(0.0, min(centre - half_width, rate)), min(1.0, max(centre + half_width, rate))


def wald_bound(n_success: int, n_failure: int, z: float) -> ScalarBounds:
    """Compute the Wald interval of a success probability from two integer counts.

    `z` is the normal quantile of the interval (`normal_quantile`). Returns (lower, upper) within
    [0, 1], which encloses the observed rate, and is (0, 1) if both counts are 0. The counts are not
    checked. TorchScript compiles it.
    """
    total = float(n_success + n_failure)
    if total == 0.0:
        return 0.0, 1.0
    rate = n_success / total
    half_width = z / math.sqrt(total) * math.sqrt(n_success * n_failure / (total * total))
    return max(0.0, rate - half_width), min(1.0, rate + half_width)


SCALAR_BOUNDS: dict[str, ScalarBound] = {"wilson": wilson_bound, "binomial": wald_bound}
ARRAY_LIMITS = {"wilson": wilson_limits, "binomial": wald_limits}  # of the same intervals


def scalar_interval(
    interval: str, alpha: float, n_success: int, n_failure: int, z: float
) -> ScalarBounds:
    """Evaluate any interval of `INTERVALS` on two integers; TorchScript cannot compile it.

    It has the parameters of a `ScalarBound` behind `interval` and `alpha`; z is not used. Returns
    lower and upper as floats. Raises ValueError for a negative count, SettingError for an alpha out
    of range.
    """
    return INTERVALS[interval](n_success, n_failure, alpha)


def _normal_interval(
    limits: Callable[..., Bounds], n_success: ArrayLike, n_failure: ArrayLike, alpha: float
) -> Bounds:
    """Return (lower, upper) by `wilson_limits` or `wald_limits`, at the error level alpha."""
    z = normal_quantile(alpha)
    return _as_floats(*limits(np, *_as_counts(n_success, n_failure), z))


def _beta_interval(
    n_success: ArrayLike, n_failure: ArrayLike, alpha: float, prior: float, other_prior: float
) -> Bounds:
    """Return quantiles of Beta distributions, at alpha / 2 and 1 - alpha / 2, as (lower, upper).

    For the lower end, `prior` is added to the successes and `other_prior` to the failures; for the
    upper end it is the other way round. `alpha` is the error level. The lower end is 0 without a
    success, the upper end 1 without a failure. An end that would leave out the observed rate, as
    for an alpha near 1, is moved to it. The ends are arrays of the counts' shape, or floats for
    scalar counts. Raises SettingError for an alpha out of range, ValueError for negative counts and
    for counts of different shapes.
    """
    from scipy.special import betaincinv

    normal_quantile(alpha)  # checks alpha
    successes, failures = _as_counts(n_success, n_failure)
    a = np.maximum(successes + prior, 0.5)
    b = failures + other_prior
    lower = np.where(successes > 0, betaincinv(a, b, alpha / 2.0), 0.0)
    a = successes + other_prior
    b = np.maximum(failures + prior, 0.5)
    upper = np.where(failures > 0, betaincinv(a, b, 1.0 - alpha / 2.0), 1.0)
    return _as_floats(*_clip_limits(np, lower, upper, successes, failures))


def _as_counts(n_success: ArrayLike, n_failure: ArrayLike) -> tuple[Floats, Floats]:
    """Return both counts as float64 arrays; ValueError if negative or of different shapes."""
    successes = np.asarray(n_success, dtype=np.float64)
    failures = np.asarray(n_failure, dtype=np.float64)
    if successes.shape != failures.shape:
        raise ValueError(
            f"Expected counts of one shape, got {successes.shape} successes and {failures.shape} "
            "failures."
        )
    if np.any(successes < 0) or np.any(failures < 0):
        raise ValueError("Expected counts of zero or more, got a negative one.")
    return successes, failures


def _clip_limits(xp: Any, lower: Any, upper: Any, n_success: Any, n_failure: Any) -> Bounds:
    """Return interval limits, clipped to [0, 1] and moved to enclose the observed success rate.

    The result is (lower, upper), which is (0, 1) if nothing was counted. `lower` and `upper` are
    the computed limits, `n_success` and `n_failure` the counts. All are float64 arrays (`xp` is
    numpy) or tensors (`xp` is torch). A Wald limit may be out of [0, 1]; rounding, or an alpha near
    1, may push a limit past the rate.
    """
    total = n_success + n_failure
    rate = n_success / xp.where(total > 0.0, total, 1.0)
    lower = xp.clip(xp.minimum(lower, rate), 0.0, 1.0)
    upper = xp.clip(xp.maximum(upper, rate), 0.0, 1.0)
    return xp.where(total > 0.0, lower, 0.0), xp.where(total > 0.0, upper, 1.0)


def _as_floats(lower: Floats, upper: Floats) -> Bounds:
    """Return arrays as they are, and arrays without a dimension as two floats."""
    return (float(lower), float(upper)) if lower.ndim == 0 else (lower, upper)
