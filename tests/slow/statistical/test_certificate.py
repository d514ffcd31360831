"""The certificate's bound is ever wrong in at most alpha of the streams, wherever the true rates
go.
"""

import math

import numpy as np
import pytest
from scipy import stats

from dengine.decision.certificate import failure_bound, log_evidence
from tests.slow.proof.certificate import PROPENSITIES, STREAMS, refuting_counts, share_ever_wrong


@pytest.mark.parametrize("propensity", PROPENSITIES)
@pytest.mark.parametrize("name", STREAMS)
def test_the_bound_is_ever_wrong_in_at_most_alpha_of_the_streams(
    name: str, propensity: float, proof_repeats: int
) -> None:
    streams, alpha = min(2000, 100 * proof_repeats), 0.1
    share = share_ever_wrong(name, propensity, alpha, streams, n_parts=2000)
    assert (
        stats.binomtest(round(share * streams), streams, alpha, alternative="greater").pvalue > 1e-4
    )


def test_an_adversary_who_reacts_to_every_outcome_gains_nothing(proof_repeats: int) -> None:
    """Each part's true probability depends on the past: as bad as can be once luck has made the
    evidence large.
    """
    rng, alpha, parts, streams = np.random.default_rng(0), 0.1, 300, 100 * min(proof_repeats, 20)
    wrong = 0
    for _ in range(streams):
        n_bad, total = 0, 0.0
        for n in range(1, parts + 1):
            lucky = n > 1 and log_evidence(n - 1, n_bad, total / (n - 1)) > 1.0
            p = 0.3 if lucky else 0.08
            total, n_bad = total + p, n_bad + int(rng.random() < p)
            if log_evidence(n, n_bad, total / n) >= math.log(1 / alpha):
                wrong += 1
                break
    assert stats.binomtest(wrong, streams, alpha, alternative="greater").pvalue > 1e-4


def test_the_simulated_count_is_the_bound_itself() -> None:
    mean = STREAMS["sinusoidal"](np.arange(400) / 400).cumsum() / np.arange(1, 401)
    for n, k in enumerate(refuting_counts(mean, 0.1, 1.0), 1):
        assert k < 0 or failure_bound(n, int(k), 0.1) <= mean[n - 1]
        assert failure_bound(n, min(n, int(k) + 1), 0.1) > mean[n - 1] or k == n
