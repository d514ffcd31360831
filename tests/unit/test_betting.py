"""Evidence by betting: the mathematics as properties, by exact enumeration."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from dengine.decision.certificate import log_evidence

BETS = (0.05, 0.1, 0.2, 0.4, 0.7, 0.98)

counts = st.tuples(st.integers(0, 5000), st.floats(0.0, 1.0)).map(lambda c: (c[0], int(c[0] * c[1])))
tolerances = st.floats(0.001, 0.999)
propensities = st.floats(0.001, 1.0)


@pytest.mark.parametrize(("n", "tolerance", "alpha"), [(28, 0.1, 0.1), (73, 0.05, 0.05)])
def test_parts_that_were_all_good_are_soon_enough(n: int, tolerance: float, alpha: float) -> None:
    assert log_evidence(n - 1, 0, tolerance) < math.log(1 / alpha) <= log_evidence(n, 0, tolerance)


def test_no_parts_are_no_evidence() -> None:
    assert log_evidence(0, 0, 0.1) == 0.0
    assert log_evidence(0, 0, 0.1, 0.02) == 0.0


@given(counts, tolerances, propensities)
def test_it_is_the_log_of_the_capital_as_the_docstring_has_it(c: tuple[int, int], theta: float, q: float) -> None:
    n, n_bad = c[0] % 200, c[1] % (c[0] % 200 + 1)
    capitals = [b * (1 - b) ** n_bad / (1 - b * q * theta) ** n for b in BETS]
    assert log_evidence(n, n_bad, theta, q) == pytest.approx(math.log(sum(capitals) / sum(BETS)), abs=1e-9)


@given(counts, tolerances, propensities)
def test_each_bet_is_one_on_the_inverse_probability_weighted_outcome(c: tuple[int, int], theta: float, q: float) -> None:
    n, n_bad = c[0] % 200, c[1] % (c[0] % 200 + 1)
    stakes = [b * q / (1 - b * q * theta) for b in BETS]
    capitals = [
        b * (1 + s * theta) ** (n - n_bad) * (1 + s * (theta - 1 / q)) ** n_bad for b, s in zip(BETS, stakes, strict=True)
    ]
    assert log_evidence(n, n_bad, theta, q) == pytest.approx(math.log(sum(capitals) / sum(BETS)), abs=1e-6)


@given(counts, tolerances, propensities)
def test_a_bad_part_lowers_the_evidence_and_a_good_one_raises_it(c: tuple[int, int], theta: float, q: float) -> None:
    n, n_bad = c
    assert (
        log_evidence(n + 1, n_bad + 1, theta, q) < log_evidence(n, n_bad, theta, q) < log_evidence(n + 1, n_bad, theta, q)
    )


@given(counts.filter(lambda c: c[0] > 0), tolerances, tolerances, propensities)
def test_evidence_grows_with_the_tolerance(c: tuple[int, int], one: float, other: float, q: float) -> None:
    low, high = sorted((one, other))
    assert log_evidence(*c, low, q) <= log_evidence(*c, high, q)


@given(counts, propensities)
def test_at_the_rate_that_was_seen_there_is_no_evidence(c: tuple[int, int], q: float) -> None:
    n, n_bad = c
    assert log_evidence(n, n_bad, min(1.0, n_bad / (max(1, n) * q)), q) <= 1e-9 or n_bad > n * q


@pytest.mark.parametrize("p", [0.01, 0.1, 0.5, 0.9])
@pytest.mark.parametrize("q", [1.0, 0.3, 0.02])
@pytest.mark.parametrize("n", [1, 2, 7, 30, 200])
def test_the_mean_capital_is_one_at_the_tolerance_and_less_above_it(n: int, q: float, p: float) -> None:
    def mean_capital(truth: float) -> float:
        seen = stats.binom.pmf(range(n + 1), n, q * truth)
        return math.fsum(seen[k] * math.exp(log_evidence(n, k, p, q)) for k in range(n + 1))

    assert mean_capital(p) == pytest.approx(1.0, abs=1e-9)
    assert mean_capital(p + 0.05) < 1.0 < mean_capital(p - 0.005)


def ever_refuted(alpha: float, rates: list[float], q: float) -> float:
    """Probability, exact, that the running mean of these rates is ever refuted."""
    alive, ever = {0: 1.0}, 0.0
    for n, p in enumerate(rates, 1):
        after: dict[int, float] = {}
        for n_bad, mass in alive.items():
            for k, chance in ((n_bad, 1 - q * p), (n_bad + 1, q * p)):
                after[k] = after.get(k, 0.0) + mass * chance
        mean = sum(rates[:n]) / n
        wrong = {k for k in after if log_evidence(n, k, mean, q) >= math.log(1 / alpha)}
        ever += sum(after.pop(k) for k in wrong)
        alive = after
    return ever


STREAMS = {
    "constant": [0.3] * 150,
    "rising": [0.02 + 0.004 * i for i in range(150)],
    "falling": [0.6 - 0.004 * i for i in range(150)],
    "first bad, then good": [0.9] * 10 + [0.0] * 140,
    "to and fro": [0.5 + 0.4 * math.sin(i / 5) for i in range(150)],
}


@pytest.mark.parametrize("q", [1.0, 0.3])
@pytest.mark.parametrize("name", STREAMS)
def test_a_running_mean_that_moves_is_ever_refuted_with_probability_alpha_at_most(name: str, q: float) -> None:
    for alpha in (0.05, 0.1, 0.3):
        assert 0.0 < ever_refuted(alpha, STREAMS[name], q) <= alpha or STREAMS[name][-1] == 0.0


@pytest.mark.filterwarnings("ignore:.*torch.jit.*")
def test_scripted_it_is_the_same_bit_for_bit() -> None:
    scripted = torch.jit.script(log_evidence)
    for n in (0, 1, 2, 17, 300, 1503, 100_000, 10_000_000):
        for n_bad in {0, n // 1000, n // 50, n // 3, n}:
            for tolerance in (0.001, 0.02, 0.05, 0.1, 0.5, 0.999):
                for propensity in (1.0, 0.1, 0.02, 1 / 3):
                    assert scripted(n, n_bad, tolerance, propensity) == log_evidence(n, n_bad, tolerance, propensity)
