"""The certificate's bound is ever wrong in at most alpha of the streams, wherever the true rates go; its width, its price.

PYTHONPATH=training OMP_NUM_THREADS=1 python tests/slow/statistical/test_certificate.py    # the tables
"""

import math

import numpy as np
import pytest
from scipy import stats

from dengine.decision.certificate import failure_bound, log_evidence
from tests.slow.proof.certificate import CLAIM, PROPENSITIES, STREAMS, ever_wrong, most_bad


@pytest.mark.parametrize("propensity", PROPENSITIES)
@pytest.mark.parametrize("name", STREAMS)
def test_the_bound_is_ever_wrong_in_at_most_alpha_of_the_streams(name: str, propensity: float, proof_repeats: int) -> None:
    streams, alpha = min(2000, 100 * proof_repeats), 0.1
    share = ever_wrong(name, propensity, alpha, streams, parts=2000)
    assert stats.binomtest(round(share * streams), streams, alpha, alternative="greater").pvalue > 1e-4


def test_an_adversary_who_reacts_to_every_outcome_gains_nothing(proof_repeats: int) -> None:
    """Each part's true probability depends on the past: as bad as can be once luck has made the evidence large."""
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
    for n, k in enumerate(most_bad(mean, 0.1, 1.0), 1):
        assert k < 0 or failure_bound(n, int(k), 0.1) <= mean[n - 1]
        assert failure_bound(n, min(n, int(k) + 1), 0.1) > mean[n - 1] or k == n


def test_a_bound_for_one_look_is_wrong_far_more_often_if_one_looks_after_every_part() -> None:
    rng, n, streams = np.random.default_rng(0), np.arange(1, 1001), 200
    least = stats.beta.ppf(
        0.9, np.arange(1001)[None] + 1, np.maximum(n[:, None] - np.arange(1001), 1e-9)
    )  # Clopper-Pearson
    bad = np.cumsum(rng.random((streams, 1000)) < CLAIM, axis=1)
    assert (least[n - 1, bad] < CLAIM).any(axis=1).mean() > 0.2


def tables() -> None:
    """Ever-wrong shares, widths beside a bound for one look, and how many parts a tolerance takes."""
    print(
        "ever wrong, of 2,000 streams of 10,000 parts:",
        *[f"q={q:g} alpha={a:g}" for q in PROPENSITIES for a in (0.05, 0.1)],
    )
    for i, name in enumerate(STREAMS):
        shares = [ever_wrong(name, q, a, 2000, 10_000, seed=i) for q in PROPENSITIES for a in (0.05, 0.1)]
        print(f"{name:22s}", *[f"{share:7.4f}" for share in shares])
    for alpha in (0.05, 0.1):
        print(f"bound in %, alpha {alpha:g}: n, rate seen | at any time, propensity {PROPENSITIES} | once, Clopper-Pearson")
        for n in (500, 2000, 10_000):
            for rate in (0.0, 0.005, 0.01, 0.02, 0.05):
                seen = [(round(n * q), round(n * q * rate)) for q in PROPENSITIES]
                anytime = [failure_bound(n, k, alpha, q) for (_, k), q in zip(seen, PROPENSITIES, strict=True)]
                once = [stats.beta.ppf(1 - alpha, k + 1, m - k) for m, k in seen]
                print(
                    f"{n:6d} {100 * rate:4.1f} |",
                    *[f"{100 * u:6.2f}" for u in anytime],
                    "|",
                    *[f"{100 * u:6.2f}" for u in once],
                )


if __name__ == "__main__":
    tables()
