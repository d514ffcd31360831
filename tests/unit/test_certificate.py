"""What is certified of accepted and rejected parts: the bound, what counts as known, and the words."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from dengine.decision.certificate import Certificate, Outcomes, certify, failure_bound, log_evidence
from dengine.errors import SettingError

counts = st.tuples(st.integers(0, 20_000), st.floats(0.0, 1.0)).map(lambda c: (c[0], int(c[0] * c[1])))
alphas = st.floats(0.001, 0.5)
propensities = st.floats(0.005, 1.0)


def certificate(stops: str = "all", audit_rate: float = 0.0, alpha: float = 0.05, /, **counts: int) -> Certificate:
    return certify(Outcomes(**counts), alpha, 0.05, stops, audit_rate)


# --------------------------------------------------------------------------------------------------- the bound


@given(counts, alphas, propensities)
def test_the_bound_is_the_largest_rate_not_refuted(c: tuple[int, int], alpha: float, q: float) -> None:
    upper = failure_bound(*c, alpha, q)
    assert min(1.0, c[1] / (max(1, c[0]) * q)) - 1e-9 <= upper <= 1.0
    assert log_evidence(*c, upper - 1e-6, q) < math.log(1 / alpha)
    assert upper == 1.0 or log_evidence(*c, upper, q) >= math.log(1 / alpha)


@given(counts, alphas, propensities)
def test_the_bound_rises_with_a_bad_part_and_falls_with_a_good_one(c: tuple[int, int], alpha: float, q: float) -> None:
    n, n_bad = c
    upper = failure_bound(n, n_bad, alpha, q)
    assert failure_bound(n + 1, n_bad, alpha, q) <= upper <= failure_bound(n + 1, n_bad + 1, alpha, q)
    assert failure_bound(n, n_bad, alpha / 2, q) >= upper


@pytest.mark.parametrize("n_bad", [0, 5, 40])
def test_looking_at_any_time_costs_more_than_looking_once(n_bad: int) -> None:
    once = stats.beta.ppf(0.95, n_bad + 1, 2000 - n_bad)  # Clopper-Pearson, one-sided
    assert once < failure_bound(2000, n_bad, 0.05) < 1.8 * once


def test_the_same_number_of_audits_says_nearly_the_same_at_any_rate() -> None:
    uppers = [failure_bound(round(400 / q), 4, 0.05, q) for q in (1.0, 0.1, 0.02)]
    assert max(uppers) < 1.05 * min(uppers)


def test_where_nothing_is_known_the_bound_is_one() -> None:
    assert failure_bound(0, 0, 0.05) == failure_bound(10_000, 0, 0.05, 0.0) == failure_bound(10, 0, 0.05, 0.02) == 1.0


def test_settings_and_counts_out_of_range_are_named() -> None:
    with pytest.raises(SettingError, match=r"0 < alpha < 1, got 1\.5"):
        failure_bound(10, 0, 1.5)
    with pytest.raises(SettingError, match="propensity <= 1, got 2"):
        failure_bound(10, 0, 0.05, 2.0)
    with pytest.raises(ValueError, match="n_bad = 11 of n = 10"):
        failure_bound(10, 11, 0.05)
    with pytest.raises(SettingError, match="among all, some, got 'none'"):
        certificate("none")
    with pytest.raises(SettingError, match="0 < tolerance < 1, got 0"):
        certify(Outcomes(), 0.05, 0.0, "all", 0.0)


# --------------------------------------------------------------------------------------------- what counts as known


def test_where_every_bad_part_stops_the_system_all_accepted_are_known() -> None:
    found = certificate("all", accepted=1203, stops=24).accepted
    assert (found.n, found.n_looked_at, found.n_bad, found.propensity) == (1203, 1203, 24, 1.0)
    assert found.upper == failure_bound(1203, 24, 0.05) == pytest.approx(0.0349, abs=5e-5)  # golden


def test_silence_is_no_success() -> None:
    found = certificate("some", accepted=1203, stops=24, confirmed=1178).accepted
    assert (found.upper, found.propensity, found.n_looked_at) == (1.0, 0.0, 0)


def test_parts_that_were_all_confirmed_or_stopped_are_known() -> None:
    known = certificate("some", accepted=1203, stops=24, confirmed=1179).accepted
    assert known == certificate("all", accepted=1203, stops=24).accepted


def test_audits_speak_for_all_the_model_was_certain_of() -> None:
    found = certificate("some", 0.02, accepted=9800, audited_accepts=200, audited_accepts_bad=3).accepted
    assert (found.n, found.n_looked_at, found.n_bad, found.propensity) == (10_000, 200, 3, 0.02)
    assert found.upper == failure_bound(10_000, 3, found.alpha, 0.02)


def test_what_is_known_one_way_and_the_other_spends_alpha_once() -> None:
    audits = certificate("some", 0.02, accepted=980, audited_accepts=20).accepted
    confirmed = certificate("some", 0.02, accepted=980, confirmed=980, audited_accepts=20).accepted
    assert audits.alpha + confirmed.alpha == pytest.approx(0.05)
    assert confirmed.upper < audits.upper


def test_audits_do_not_certify_less_than_the_share_known_to_be_bad() -> None:
    assert certificate("some", 0.1, accepted=900, stops=450, audited_accepts=100).accepted.upper == 0.45


def test_rejected_parts_are_known_by_audits_alone() -> None:
    assert certificate("all", rejected=400).rejected.upper == 1.0
    found = certificate("all", 0.1, rejected=3600, audited_rejects=400, audited_rejects_good=2).rejected
    assert (found.n, found.n_looked_at, found.n_bad) == (4000, 400, 2)
    assert found.upper == failure_bound(4000, 2, 0.05, 0.1)


# ------------------------------------------------------------------------------------------------------ the words


def test_one_sentence_says_what_was_kept() -> None:
    assert certificate("all", accepted=1203, stops=24).sentence == (
        "Of 1,203 parts that went on without a check, at most 3.5 % were bad on average, with 95 % confidence, "
        "however often one looks; the tolerance is 5 %."
    )


def test_one_sentence_says_what_audits_tell() -> None:
    assert certificate("some", 0.1, accepted=9000, audited_accepts=1000, audited_accepts_bad=20).sentence == (
        "Of 10,000 parts that the model would accept, of which 1,000 were audited, at most 3.8 % were bad on average, with "
        "95 % confidence, however often one looks; the tolerance is 5 %."
    )


def test_where_nothing_can_be_said_the_sentence_says_what_to_set() -> None:
    assert certificate("some", accepted=1203).sentence == (
        "Of 1,203 parts that went on without a check nothing can be said, for silence is no success: "
        "set audit_rate, or stops='all' where every bad part stops the system."
    )
    assert certificate("all", rejected=7).sentence_on_rejects.endswith("nobody looks at what is rejected: set audit_rate.")
    assert certificate("all").sentence.startswith("Nothing can be said yet")
    assert certificate("some", 0.02, accepted=10, audited_accepts=1).sentence.endswith("too few were looked at.")


@given(counts.filter(lambda c: c[0] > 5), alphas)
def test_a_sentence_never_promises_more_than_the_bound(c: tuple[int, int], alpha: float) -> None:
    found = certificate("all", 0.0, alpha, accepted=c[0], stops=c[1])
    if "at most" in found.sentence:
        said = float(found.sentence.split("at most ")[1].split(" %")[0]) / 100
        assert found.accepted.upper - 1e-12 <= said <= found.accepted.upper * 1.11


def test_kept_means_the_bound_lies_within_the_tolerance() -> None:
    assert certificate("all", accepted=1203, stops=24).kept
    assert not certificate("all", accepted=1203, stops=60).kept
    assert not certificate("some", accepted=1203).kept


# -------------------------------------------------------------------------------------------- how many audits more


@pytest.mark.parametrize("target", [0.05, 0.025, 0.01])
def test_as_many_more_audits_as_are_asked_for_bring_the_bound_to_the_target(target: float) -> None:
    found = certificate("some", 0.1, accepted=900, audited_accepts=100, audited_accepts_bad=1).accepted
    more = found.audits_needed(target)
    assert more is not None
    assert failure_bound(found.n + more * 10, found.n_bad, found.alpha, 0.1) <= target + 1e-12
    assert failure_bound(found.n + (more - 1) * 10, found.n_bad, found.alpha, 0.1) > target


def test_at_the_present_rate_it_takes_more_audits_or_no_number_would_do() -> None:
    found = certificate("all", accepted=500, stops=10)
    assert found.audits_needed(0.03) < found.audits_needed(0.03, 0.02)
    assert found.audits_needed(0.02, 0.02) is None
    assert found.audits_needed(0.9) == 0


def test_without_audits_it_counts_those_from_now_on() -> None:
    assert certificate("some", accepted=5000).audits_needed() == pytest.approx(73, abs=3)


def test_the_advice_says_how_many() -> None:
    assert certificate("some", 0.1, accepted=900, audited_accepts=100, audited_accepts_bad=4).advice.startswith(
        "To show 5 % "
    )
    assert certificate("all", accepted=1203, stops=24).advice.startswith("To show 2.5 % takes about ")
    assert certificate("all", accepted=1203, stops=60).advice.endswith("at the present rate no number would do.")
    assert certificate("all", accepted=1203, stops=0).advice == "Even 2.5 % is shown."
    with pytest.raises(SettingError, match="0 < target < 1"):
        certificate().audits_needed(1.0)
