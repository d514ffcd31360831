"""The four intervals: the paper's numbers, SciPy and statsmodels as oracles, and the mathematics as
properties.
"""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dengine import INTERVALS, wilson_interval
from dengine.errors import SettingError

COUNTS = [(s, n - s) for n in (1, 2, 7, 100, 1503) for s in sorted({0, 1, n // 3, n - 1, n})]
NAMES = {"normal": "binomial", "beta": "clopper_pearson"}  # theirs: ours

intervals = pytest.mark.parametrize("interval", INTERVALS.values(), ids=INTERVALS)
counts = st.integers(0, 2000)
alphas = st.floats(1e-4, 0.9999)


# "Wilson Formula results" (a) and (b): successes of 100 neighbours, alpha and both bounds, truncated.
PAPER = """\
95 0.2  0.91 0.97
95 0.1  0.90 0.97
95 0.05 0.88 0.97
95 0.01 0.86 0.98
96 0.05 0.901 0.984
97 0.05 0.915 0.989
98 0.05 0.929 0.994
99 0.05 0.945 0.998
100 0.05 0.963 1.0"""


@pytest.mark.parametrize("row", PAPER.splitlines())
def test_wilson_gives_the_papers_two_tables(row):
    n_success, alpha, *printed = row.split()
    bounds = wilson_interval(int(n_success), 100 - int(n_success), float(alpha))
    for bound, digits in zip(bounds, printed, strict=True):
        assert f"{bound + 1e-9:.9f}".startswith(digits)


@pytest.mark.parametrize("alpha", [0.001, 0.05, 0.2, 0.5])
@pytest.mark.parametrize("method", ["wilson", "normal", "beta", "jeffreys"])
def test_interval_equals_statsmodels(method, alpha):
    # Its import takes seconds, for one worker of three.
    from statsmodels.stats.proportion import proportion_confint

    interval = INTERVALS[NAMES.get(method, method)]
    for n_s, n_f in COUNTS:
        expected = proportion_confint(n_s, n_s + n_f, alpha, method=method)
        if method == "jeffreys":  # ours has its ends closed
            expected = (0.0 if n_s == 0 else expected[0], 1.0 if n_f == 0 else expected[1])
        np.testing.assert_allclose(interval(n_s, n_f, alpha), expected, rtol=1e-9, atol=1e-12)


@intervals
@given(n_s=counts, n_f=counts, alpha=alphas)
def test_bounds_enclose_the_observed_rate_and_exchanging_the_labels_mirrors_them(
    interval, n_s, n_f, alpha
):
    lower, upper = interval(n_s, n_f, alpha)
    rate = n_s / (n_s + n_f) if n_s + n_f else 0.5
    assert 0.0 <= lower <= rate <= upper <= 1.0
    mirrored_lower, mirrored_upper = interval(n_f, n_s, alpha)
    assert (lower, upper) == pytest.approx((1.0 - mirrored_upper, 1.0 - mirrored_lower), abs=1e-9)


@intervals
def test_arrays_give_what_scalars_give_one_by_one(interval):
    one_by_one = [interval(*counts, 0.1) for counts in COUNTS]
    np.testing.assert_array_equal(np.transpose(interval(*np.transpose(COUNTS), 0.1)), one_by_one)
    assert interval(0, 0, 0.1) == (0.0, 1.0)  # nothing is known
    assert [type(bound) for bound in interval(np.int64(3), np.int64(1), 0.1)] == [float, float]


@intervals
@pytest.mark.parametrize("alpha", [0.0, 1.0, math.nan])
def test_an_alpha_or_counts_that_cannot_be_are_refused(interval, alpha):
    with pytest.raises(SettingError, match="0 < alpha < 1"):
        interval(3, 1, alpha)
    with pytest.raises(ValueError, match="one shape"):
        interval([1, 2], [1], 0.1)
    with pytest.raises(ValueError, match="negative"):
        interval(-1, 2, 0.1)
