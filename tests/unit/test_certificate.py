"""Evidence by betting, and what is certified of accepted and rejected parts: the bound, what is
known, the words.
"""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from dengine import Policy
from dengine.decision.certificate import Certificate, Outcomes, certify, failure_bound, log_evidence
from dengine.errors import SettingError

counts = st.tuples(st.integers(0, 20_000), st.floats(0.0, 1.0)).map(
    lambda c: (c[0], int(c[0] * c[1]))
)
alphas = st.floats(0.001, 0.5)
propensities = st.floats(0.005, 1.0)


def certificate(
    stops: str = "all", audit_rate: float = 0.0, alpha: float = 0.05, /, **counts: int
) -> Certificate:
    return certify(Outcomes(**counts), alpha, 0.05, stops, audit_rate)


@given(counts, alphas, propensities)
def test_the_bound_is_the_largest_rate_not_refuted(c, alpha, q):
    upper = failure_bound(*c, alpha, q)
    assert min(1.0, c[1] / (max(1, c[0]) * q)) - 1e-9 <= upper <= 1.0
    assert log_evidence(*c, upper - 1e-6, q) < math.log(1 / alpha)
    assert upper == 1.0 or log_evidence(*c, upper, q) >= math.log(1 / alpha)


@pytest.mark.parametrize(("n", "propensity"), [(0, 1.0), (10_000, 0.0), (10, 0.02)])
def test_where_nothing_is_known_the_bound_is_one(n, propensity):
    assert failure_bound(n, 0, 0.05, propensity) == 1.0


def test_what_cannot_be_is_refused():
    with pytest.raises(SettingError, match=r"0 < alpha < 1, got 1\.5"):
        failure_bound(10, 0, 1.5)
    with pytest.raises(ValueError, match="n_bad = 11 of n = 10"):
        failure_bound(10, 11, 0.05)


def test_what_is_known_one_way_and_the_other_spends_alpha_once():
    audits = certificate("some", 0.02, accepted=980, audited_accepts=20).accepted
    confirmed = certificate("some", 0.02, accepted=980, confirmed=980, audited_accepts=20).accepted
    assert audits.alpha + confirmed.alpha == pytest.approx(0.05)
    assert confirmed.upper < audits.upper


@given(counts.filter(lambda c: c[0] > 5), alphas)
def test_a_sentence_never_promises_more_than_the_bound(c, alpha):
    result = certificate("all", 0.0, alpha, accepted=c[0], false_accepts=c[1])
    if "at most" in result.sentence:
        text = float(result.sentence.split("at most ")[1].split(" %")[0]) / 100
        assert result.accepted.upper - 1e-12 <= text <= result.accepted.upper * 1.11


BETS = (0.05, 0.1, 0.2, 0.4, 0.7, 0.98)
PRICES = (5, 120, 47.5)

tolerances = st.floats(0.001, 0.999)


@given(counts, tolerances, propensities)
def test_it_is_the_log_of_the_capital_as_the_docstring_has_it(c, theta, q):
    n, n_bad = c[0] % 150, c[1] % (c[0] % 150 + 1)  # more would be beyond a float
    capitals = [b * (1 - b) ** n_bad / (1 - b * q * theta) ** n for b in BETS]
    assert log_evidence(n, n_bad, theta, q) == pytest.approx(
        math.log(sum(capitals) / sum(BETS)), abs=1e-9
    )


@pytest.mark.parametrize("p", [0.01, 0.1, 0.5, 0.9])
@pytest.mark.parametrize("q", [1.0, 0.3, 0.02])
@pytest.mark.parametrize("n", [1, 2, 7, 30, 200])
def test_the_mean_capital_is_one_at_the_tolerance_and_less_above_it(n, q, p):
    def mean_capital(truth: float) -> float:
        seen = stats.binom.pmf(range(n + 1), n, q * truth)
        return math.fsum(seen[k] * math.exp(log_evidence(n, k, p, q)) for k in range(n + 1))

    assert mean_capital(p) == pytest.approx(1.0, abs=1e-9)
    assert mean_capital(p + 0.05) < 1.0 < mean_capital(p - 0.005)


@pytest.mark.parametrize(
    ("stops", "audit_rate", "counts", "expected"),
    [
        ("all", 0.0, (1203, 24), (1203, 1203, 24, 1.0)),
        ("some", 0.0, (1203, 24, 1179), (1203, 1203, 24, 1.0)),
        ("some", 0.0, (1203, 24, 1178), (1203, 0, 0, 0.0)),
        ("some", 0.02, (9800, 0, 0, 200, 3), (10_000, 200, 3, 0.02)),
    ],
)
def test_what_is_known_of_accepted_parts(stops, audit_rate, counts, expected):
    """`counts`: accepted, false accepts, confirmed, audited accepts and bad ones of these."""
    accepted = certify(Outcomes(*counts), 0.05, 0.05, stops, audit_rate).accepted
    n, n_known, n_bad, propensity = expected
    assert (accepted.n, accepted.n_with_outcome) == (n, n_known)
    assert accepted.upper == failure_bound(n, n_bad, accepted.alpha, propensity)


@pytest.mark.parametrize(("accepted", "bad", "words"), [(1203, 24, "least"), (60, 2, "most")])
def test_by_prices_it_says_what_was_saved_at_least_or_lost_at_most(accepted, bad, words):
    policy = Policy(0.05, guarantee="cost", stops="all", prices=PRICES)
    result = policy.certificate(Outcomes(accepted, bad, accepted - bad))
    upper = failure_bound(accepted, bad, 0.05)
    assert result.tolerance == pytest.approx(5 / 120)
    assert result.saved == pytest.approx(accepted * 5 - 120 * accepted * upper)
    amount = math.ceil(abs(result.saved)) - (result.saved > 0)
    assert f"at {words} {amount:,} was" in result.sentence


def test_a_part_that_was_audited_saves_no_check():
    shadow = Policy(0.05, guarantee="cost", prices=PRICES, shadow=True)
    result = shadow.certificate(Outcomes(audited_accepts=5000))
    assert (result.accepted.n, result.accepted.n_unchecked, result.saved) == (5000, 0, 0.0)
    audited = Policy(0.05, guarantee="cost", prices=PRICES, audit_rate=0.4)
    result = audited.certificate(Outcomes(accepted=3000, audited_accepts=2000))
    assert result.saved == pytest.approx(3000 * 5 - 120 * 5000 * result.accepted.upper)
    # What is saved is never less than if every unchecked part had escaped.
    lost = audited.certificate(Outcomes(accepted=10, audited_accepts=900, audited_accepts_bad=450))
    assert lost.saved == pytest.approx(10 * 5 - 10 * 120)


def test_the_tolerance_is_kept_where_the_bound_is_below_it():
    kept = certificate("all", accepted=1203, false_accepts=24)
    assert kept.accepted.upper == pytest.approx(0.0349, abs=5e-5)  # golden
    assert kept.kept
    assert kept.saved is None  # without prices
    assert not certificate("all", accepted=1203, false_accepts=60).kept
    audited = certificate("some", 0.1, accepted=9000, audited_accepts=1000, audited_accepts_bad=20)
    assert "Of 10,000 parts that the model would accept, of which 1,000" in audited.sentence


def test_audits_alone_know_of_rejected_parts():
    counts = {"rejected": 3600, "audited_rejects": 400, "audited_rejects_good": 2}
    rejected = certificate("all", 0.1, **counts).rejected
    assert (rejected.n, rejected.n_with_outcome, rejected.n_bad) == (4000, 400, 2)
    unknown = certificate("all", rejected=9)
    assert unknown.rejected.upper == 1.0
    assert "set audit_rate" in unknown.sentence_on_rejects
