"""The user's two numbers: a bound becomes an action."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dengine import Action, Policy
from dengine.errors import SettingError

policies = st.builds(Policy, alpha=st.floats(0.001, 0.9), lower_bound=st.floats(0.501, 0.999))


def test_both_thresholds_are_met_with_equality() -> None:
    policy = Policy(lower_bound=0.75)  # exact in binary, so is its complement
    assert policy.action(0.75, 1.0) is Action.ACCEPT
    assert policy.action(0.0, 0.25) is Action.REJECT
    assert {policy.action(math.nextafter(0.75, 0), 1.0), policy.action(0.0, 0.2500001)} == {Action.VERIFY}


@given(policies)
def test_without_evidence_every_policy_verifies(policy: Policy) -> None:
    assert policy.action(*policy.bound(0, 0)) is Action.VERIFY


@given(policies, st.integers(0, 300), st.integers(0, 300))
def test_a_stricter_policy_is_certain_only_where_the_looser_is(policy: Policy, n_s: int, n_f: int) -> None:
    strict = Policy(policy.alpha / 2, (policy.lower_bound + 1) / 2)
    action = strict.action(*strict.bound(n_s, n_f))
    assert action in (Action.VERIFY, policy.action(*policy.bound(n_s, n_f)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"alpha": 0.0}, "0 < alpha < 1"),
        ({"alpha": math.nan}, "0 < alpha < 1"),
        ({"lower_bound": 0.5}, r"0\.5 < lower_bound < 1"),
        ({"lower_bound": 1.0}, r"0\.5 < lower_bound < 1"),
        ({"lower_bound": math.nan}, r"0\.5 < lower_bound < 1"),
        ({"interval": "wald"}, "wilson, binomial, clopper_pearson, jeffreys"),
        ({"audit_rate": 1.1}, "audit_rate"),
        ({"audit_rate": -0.1}, "audit_rate"),
    ],
)
def test_a_setting_out_of_range_is_named_with_what_was_expected(settings: dict[str, object], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        Policy(**settings)  # type: ignore[arg-type]
