"""The four intervals: the paper's numbers, SciPy and statsmodels as oracles, and the mathematics as
properties.
"""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dengine import (
    INTERVALS,
    binomial_interval,
    clopper_pearson_interval,
    jeffreys_interval,
    wilson_interval,
)
from dengine.errors import SettingError

ALPHAS = (0.001, 0.01, 0.05, 0.1, 0.2, 0.5)
COUNTS = [
    (s, n - s)
    for n in (1, 2, 3, 7, 30, 100, 1503)
    for s in sorted({0, 1, n // 3, n // 2, n - 1, n})
]

intervals = pytest.mark.parametrize("interval", INTERVALS.values(), ids=INTERVALS)
counts = st.integers(0, 2000)
alphas = st.floats(1e-4, 0.9999)


def truncated(value: float, digits: int) -> float:
    return math.floor(value * 10**digits + 1e-9) / 10**digits


TABLE_A = {
    0.2: (0.91, 0.97),
    0.1: (0.90, 0.97),
    0.05: (0.88, 0.97),
    0.01: (0.86, 0.98),
}  # alpha: 95 of 100
TABLE_B = {
    96: (0.901, 0.984),
    97: (0.915, 0.989),
    98: (0.929, 0.994),
    99: (0.945, 0.998),
    100: (0.963, 1.0),
}  # at 0.05


@pytest.mark.parametrize(
    ("n_success", "alpha", "digits", "bounds"),
    [(95, alpha, 2, bounds) for alpha, bounds in TABLE_A.items()]
    + [(n, 0.05, 3, bounds) for n, bounds in TABLE_B.items()],
)
def test_wilson_gives_the_papers_two_tables(
    n_success: int, alpha: float, digits: int, bounds: tuple[float, float]
) -> None:
    # "Wilson Formula results" (a) and (b), of 100 neighbours; truncated.
    assert (
        tuple(
            truncated(bound, digits) for bound in wilson_interval(n_success, 100 - n_success, alpha)
        )
        == bounds
    )


@pytest.mark.parametrize("alpha", ALPHAS)
@pytest.mark.parametrize(
    ("interval", "method"),
    [
        (wilson_interval, "wilson"),
        (binomial_interval, "normal"),
        (clopper_pearson_interval, "beta"),
        (jeffreys_interval, "jeffreys"),
    ],
)
def test_interval_equals_statsmodels(interval, method: str, alpha: float) -> None:
    # Its import takes seconds, for one worker of three.
    from statsmodels.stats.proportion import proportion_confint

    for n_s, n_f in COUNTS:
        expected = proportion_confint(n_s, n_s + n_f, alpha, method=method)
        if method == "jeffreys":  # ours has its ends closed
            expected = (0.0 if n_s == 0 else expected[0], 1.0 if n_f == 0 else expected[1])
        np.testing.assert_allclose(interval(n_s, n_f, alpha), expected, rtol=1e-9, atol=1e-12)


@intervals
@given(n_s=counts, n_f=counts, alpha=alphas)
def test_bounds_enclose_the_observed_rate_and_exchanging_the_labels_mirrors_them(
    interval, n_s, n_f: int, alpha
) -> None:
    lower, upper = interval(n_s, n_f, alpha)
    rate = n_s / (n_s + n_f) if n_s + n_f else 0.5
    assert 0.0 <= lower <= rate <= upper <= 1.0
    mirrored_lower, mirrored_upper = interval(n_f, n_s, alpha)
    assert (lower, upper) == pytest.approx((1.0 - mirrored_upper, 1.0 - mirrored_lower), abs=1e-9)


@intervals
@given(n=st.integers(1, 300), alpha=alphas)
def test_both_bounds_grow_with_the_number_of_successes(interval, n: int, alpha: float) -> None:
    n_s = np.arange(n + 1)
    lower, upper = interval(n_s, n - n_s, alpha)
    assert (np.diff(lower) >= -1e-12).all()
    assert (np.diff(upper) >= -1e-12).all()


@intervals
@given(n_s=counts, n_f=counts, first=alphas, other=alphas)
def test_a_smaller_alpha_never_narrows_the_interval(
    interval, n_s: int, n_f: int, first: float, other: float
) -> None:
    wide, narrow = interval(n_s, n_f, min(first, other)), interval(n_s, n_f, max(first, other))
    assert wide[0] <= narrow[0] + 1e-12
    assert narrow[1] <= wide[1] + 1e-12


@intervals
def test_arrays_give_what_scalars_give_one_by_one(interval) -> None:
    n_s, n_f = np.array(COUNTS).T
    lower, upper = interval(n_s, n_f, 0.1)
    one_by_one = np.array([interval(s, f, 0.1) for s, f in COUNTS])
    assert lower.dtype == upper.dtype == np.float64
    np.testing.assert_array_equal(np.stack([lower, upper], axis=1), one_by_one)
    assert interval(0, 0, 0.1) == (0.0, 1.0)  # nothing is known
    assert [b.shape for b in interval(np.ones((2, 3)), np.ones((2, 3)), 0.1)] == [(2, 3), (2, 3)]
    assert [type(b) for b in interval(np.int64(3), np.int64(1), 0.1)] == [float, float]


@intervals
def test_an_alpha_or_counts_that_cannot_be_are_refused(interval) -> None:
    for alpha in (0.0, 1.0, -0.1, 1.5, math.nan):
        with pytest.raises(SettingError, match="0 < alpha < 1"):
            interval(3, 1, alpha)
    with pytest.raises(ValueError, match="one shape"):
        interval([1, 2], [1], 0.1)
    with pytest.raises(ValueError, match="negative"):
        interval(-1, 2, 0.1)
