"""What the intervals promise, simulated; and the pooled promise, against planted truths."""

import numpy as np
import pytest
from scipy import stats

from dengine import INTERVALS, Policy, Recipe, replay
from tests.slow.proof.truths import planted

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
        stream = planted("moderate", 1000, 0.9, seed)
        played, p = replay(stream.data, RECIPES[name], seed=seed, shuffle=False), stream.p
        accepted.append(p[played.action == "accept"])
        rejected.append(p[played.action == "reject"])
    p_accepted, p_rejected = np.concatenate(accepted), np.concatenate(rejected)
    assert len(p_accepted) > 100 * proof_repeats
    assert 1.0 - p_accepted.mean() <= 0.1
    assert len(p_rejected) == 0 or p_rejected.mean() <= 0.1
