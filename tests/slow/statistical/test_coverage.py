"""What the intervals promise, simulated; and the pooled promise, against planted truths."""

import numpy as np
import pytest
from scipy import stats

from dengine import INTERVALS, Dataset, Policy, Recipe, replay

RATES = (0.5, 0.8, 0.9, 0.95, 0.99)
SIZES = (10, 50, 200)


def coverage(name: str, n: int, p: float, alpha: float) -> float:
    """Probability, exact, that the interval of Binomial(n, p) holds p."""
    s = np.arange(n + 1)
    lower, upper = INTERVALS[name](s, n - s, alpha)
    return float(stats.binom.pmf(s, n, p)[(lower <= p) & (p <= upper)].sum())


@pytest.mark.parametrize("alpha", [0.05, 0.1, 0.2])
def test_clopper_pearson_never_covers_less_than_it_says(alpha: float) -> None:
    for n in SIZES:
        for p in np.linspace(0.001, 0.999, 101):
            assert coverage("clopper_pearson", n, p, alpha) >= 1 - alpha - 1e-12


@pytest.mark.parametrize("name", ["wilson", "jeffreys"])
@pytest.mark.parametrize("alpha", [0.05, 0.1])
def test_wilson_and_jeffreys_cover_what_they_say_on_average(name: str, alpha: float) -> None:
    for n in SIZES:
        mean = np.mean([coverage(name, n, p, alpha) for p in np.linspace(0.005, 0.995, 199)])
        assert mean == pytest.approx(1 - alpha, abs=0.02)


def test_the_binomial_interval_falls_far_short_where_the_engine_works() -> None:
    assert coverage("binomial", 10, 0.95, 0.05) < 0.5
    assert coverage("wilson", 10, 0.95, 0.05) > 0.9


@pytest.mark.parametrize("name", INTERVALS)
def test_drawn_counts_are_covered_as_often_as_computed(name: str) -> None:
    rng, draws = np.random.default_rng(0), 4000
    for p in RATES:
        s = rng.binomial(50, p, draws)
        lower, upper = INTERVALS[name](s, 50 - s, 0.1)
        inside = int(((lower <= p) & (p <= upper)).sum())
        assert stats.binomtest(inside, draws, coverage(name, 50, p, 0.1)).pvalue > 1e-4


# ---------------------------------------------------------------------------------------------- planted truths


def planted(n: int, seed: int) -> tuple[Dataset, np.ndarray]:
    """Traces of which the height tells how probable a success is; labels drawn from that probability, which is known."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1.0, 1.0, n)
    p = np.where(u > 0.0, 0.97, np.where(u > -0.5, 0.75, 0.02))
    t = np.linspace(0.0, np.pi, 60)
    X = (20.0 + 10.0 * u)[:, None] * np.sin(t) + rng.normal(0.0, 1.0, n)[:, None] * np.cos(t) + rng.normal(0, 0.3, (n, 60))
    y = (rng.random(n) < p).astype(np.int8)
    return Dataset(X.astype(np.float32), y, name="planted"), p


RECIPES = {
    "radius": Recipe("pca", radius=0.3, policy=Policy(0.1, 0.9)),
    "fraction": Recipe("pca", fraction=0.15, reject_fraction=0.1, policy=Policy(0.1, 0.9)),
    "clopper_pearson": Recipe("pca", radius=0.3, policy=Policy(0.1, 0.9, "clopper_pearson")),
    "audited": Recipe("pca", radius=0.3, policy=Policy(0.1, 0.9, audit_rate=0.1)),
}


@pytest.mark.parametrize("name", RECIPES)
def test_the_pooled_failure_probability_of_accepted_parts_keeps_the_tolerance(name: str, proof_repeats: int) -> None:
    accepted, rejected = [], []
    for seed in range(proof_repeats):
        data, p = planted(1000, 100 + seed)
        played = replay(data, RECIPES[name], seed=seed)
        p = p[np.random.default_rng(seed).permutation(1000)]
        accepted.append(p[played.action == "accept"])
        rejected.append(p[played.action == "reject"])
    p_accepted, p_rejected = np.concatenate(accepted), np.concatenate(rejected)
    assert len(p_accepted) > 100 * proof_repeats
    assert 1.0 - p_accepted.mean() <= 0.1
    assert len(p_rejected) == 0 or p_rejected.mean() <= 0.1


def test_the_planted_order_is_the_order_that_was_played() -> None:
    data, p = planted(300, 0)
    played = replay(data, RECIPES["radius"], seed=4)
    np.testing.assert_array_equal(played.truth, data.y[np.random.default_rng(4).permutation(300)].astype(bool))
    assert len(p) == 300
