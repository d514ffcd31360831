"""The user's two numbers: a bound becomes an action."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dengine import Action, DataEngine, Policy, Reason, Recipe, TraceSpec
from dengine.errors import SettingError
from dengine.limits import ForceLimits
from dengine.records import ActionCode
from dengine.traces import WITHIN_LIMITS, ForceLimitsGate
from tests.support.driving import Counting
from tests.support.exports import SAMPLES, recipe, trained

policies = st.builds(Policy, alpha=st.floats(0.001, 0.9), lower_bound=st.floats(0.501, 0.999))


def test_both_thresholds_are_met_with_equality() -> None:
    policy = Policy(lower_bound=0.75)  # exact in binary, so is its complement
    assert policy.action(0.75, 1.0) is Action.ACCEPT
    assert policy.action(0.0, 0.25) is Action.REJECT
    assert {policy.action(math.nextafter(0.75, 0), 1.0), policy.action(0.0, 0.2500001)} == {
        Action.VERIFY
    }


@given(policies)
def test_without_evidence_every_policy_verifies(policy: Policy) -> None:
    assert policy.action(*policy.bound(0, 0)) is Action.VERIFY


@given(policies, st.integers(0, 300), st.integers(0, 300))
def test_a_stricter_policy_is_certain_only_where_the_looser_is(
    policy: Policy, n_s: int, n_f: int
) -> None:
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
        ({"force_limits": ["0.2:0.1:0:"]}, "start <= end"),
        ({"force_limits": ["0.1:0.2::1:canal=2"]}, r"START:END:LOW:HIGH, .*canal"),
        ({"force_limits": ["0.1:0.2:30"]}, r"behind it, got '0.1:0.2:30'\.$"),
        ({"force_limits": ["0.1:0.2::1:reject=no"]}, "force_limits with .*reject='no'"),
        ({"force_limits": ["0.1:0.2:1::channel=F Z"]}, "or names"),
    ],
)
def test_a_setting_out_of_range_is_named_with_what_was_expected(
    settings: dict[str, object], message: str
) -> None:
    with pytest.raises(SettingError, match=message):
        Policy(**settings)  # type: ignore[arg-type]


HELD = {  # by seconds, or by channel 1, of samples 0 to 5 ten a second, and of their negatives
    "0.2:0.4:2:4": WITHIN_LIMITS,  # its ends and its limits are within
    "0.2:0.4::3.9": ActionCode.VERIFY,
    "0.2:0.4:2.1::reject": ActionCode.REJECT,
    "5.1:5.9:0::along=0": ActionCode.VERIFY,  # no sample lies there
    "-5:-3::5:along=1": WITHIN_LIMITS,
    "-5:-3::4.9:along=1:reject": ActionCode.REJECT,
    "-7:-6:-6.5::channel=1:along=0": ActionCode.VERIFY,
    "-5:-3::5:along=Z": WITHIN_LIMITS,
    "3:3:-3:-3:channel=Z:along=F:reject": WITHIN_LIMITS,
    "3:3:3:3:channel=Z:along=F:reject": ActionCode.REJECT,
}


@pytest.mark.parametrize(("window", "expected"), HELD.items())
def test_a_window_holds_the_samples_of_its_stretch_of_time_or_path_to_its_limits(
    window: str, expected: int
) -> None:
    x = torch.arange(6, dtype=torch.float32)
    limited = recipe(force_limits=(window,))
    spec = TraceSpec(6, rate_hz=10.0, channels=2, columns=("F", "Z"))
    assert ForceLimitsGate(limited.policy.force_limits, spec)(torch.stack([x, -x])) == expected
    assert Recipe.from_toml(limited.to_toml()) == limited
    assert str(*limited.policy.force_limits) == window


def test_force_limits_under_their_old_name_are_read_in_recipes_and_stores() -> None:
    limits = (ForceLimits(0.1, 0.2, high=30.0),)
    old = Recipe.from_toml('reducer = "pca"\n[policy]\nwindows = ["0.1:0.2::30"]\n').policy
    assert old.force_limits == Policy.from_values({"windows": "0.1:0.2::30"}).force_limits == limits
    assert "windows" not in Policy(force_limits=limits).to_values()


IN_SECONDS = Policy(force_limits=("0.02:0.1::1e6",))
UNSTATED = "Expected the rate of the traces, because force limits are in seconds"


@pytest.mark.parametrize(
    "begin",
    [
        partial(DataEngine, policy=IN_SECONDS),
        partial(DataEngine, policy=IN_SECONDS, trace=TraceSpec(SAMPLES, unit="N")),
        partial(DataEngine.open_or_create, None, policy=IN_SECONDS),
        partial(DataEngine, recipe=Recipe("pca", policy=IN_SECONDS)),
        partial(DataEngine, model=Counting(), policy=IN_SECONDS),
        lambda: DataEngine().set_policy(IN_SECONDS),
        lambda: DataEngine(trace=TraceSpec(SAMPLES)).set_policy(IN_SECONDS),
    ],
)
def test_force_limits_in_seconds_are_refused_at_once_while_the_rate_is_unknown(begin) -> None:
    with pytest.raises(SettingError, match=rf"{UNSTATED} .* TraceSpec\(samples=\.\.\., rate_hz"):
        begin()


def test_force_limits_along_a_path_need_no_rate(make_data) -> None:
    policy = Policy(force_limits=("-1e9:1e9::1e6:along=0",))
    with DataEngine("pca", policy=policy) as engine:
        assert engine.decide(make_data(1).X[0]).reason is Reason.NO_MODEL
        assert engine.trace.rate_hz is None


def test_a_part_outside_a_window_is_no_decision_of_the_model_and_no_claim_counts_it(
    make_data, tmp_path: Path
) -> None:
    store, data = tmp_path / "cell.db", make_data(300, SAMPLES)
    with trained(data, store) as engine:
        x = next(x for x in data.X if engine.decide(x).action is Action.ACCEPT)
        engine.set_policy(
            replace(engine.policy, force_limits=(f"0:0.1::{x[:50].max() - 0.1}:reject",))
        )
        decision = engine.decide(x)
        decided = decision.action, decision.predicted, decision.reason, decision.propensity
        assert decided == (Action.REJECT, Action.VERIFY, Reason.OUTSIDE, 0.0)
        engine.set_shadow(True)
        assert engine.decide(x).action is Action.VERIFY
        for nowhere in ("0.3:0.4:0:", "0.1001:0.1019:0:", "0:1:0::channel=1", "0:1:0::along=FZ"):
            with pytest.raises(SettingError, match="on some of 1 x 100 samples"):
                engine.set_policy(Policy(force_limits=(nowhere,)))
    with DataEngine.open(store) as engine:
        status = engine.status(last=3)
        newest = engine.status().newest
        assert (newest.outside, newest.rejected, status.actions["reject"]) == (2, 0, 1)
        assert (status.certificate.rejected.n, status.certificate.accepted.n) == (0, 0)
        assert status.alarm == "2 of the newest parts leave the force limits."
        assert (
            "leaves the operator's force limits, 0:0.1::"
            in engine.explain(decision.id).sentences[0]
        )
    with pytest.raises(
        SettingError, match=r"\(force_limits 0:0\.1::.*:reject\), got force_limits 0:0\.2:0:;"
    ):
        DataEngine.open_or_create(store, recipe=recipe(force_limits=["0:0.2:0:"]))


@pytest.mark.parametrize("text", ["0.2=9:0.4::60", "0.2:0.4::60=7", "0.2:0.4::60:channel=1=2"])
def test_a_text_behind_an_equals_sign_that_does_not_belong_there_is_refused(text: str) -> None:
    with pytest.raises(SettingError) as error:
        ForceLimits.parse(text)
    assert len(str(error.value).splitlines()) == 1


def test_prices_alone_are_the_cost_guarantee_with_audits_and_what_is_stated_stays() -> None:
    alone = Policy(prices=(0.5, 200, 5))
    assert (alone.guarantee, alone.audit_rate) == ("cost", 0.05)
    assert Policy(prices=(0.5, 200, 5), stops="all", audit_rate=0.0).audit_rate == 0.0
    local = Policy(prices=(0.5, 200, 5), guarantee="local")
    assert (local.guarantee, local.audit_rate) == ("local", 0.0)
    assert (Policy().guarantee, Policy().audit_rate) == ("local", 0.0)
    assert Policy().prices == (5.0, 120.0, 47.5)


def test_prices_change_a_policy_as_they_make_one_and_keep_an_audit_rate() -> None:
    changed = Policy(alpha=0.1).changed(prices=(0.5, 200, 5))
    assert changed == Policy(alpha=0.1, prices=(0.5, 200, 5))
    assert Policy(audit_rate=0.2).changed(prices=(0.5, 200, 5)).audit_rate == 0.2
    again = Policy(prices=(0.5, 200, 5), audit_rate=0.0, stops="all").changed(prices=(1, 200, 5))
    assert (again.guarantee, again.audit_rate) == ("cost", 0.0)
    assert Policy().changed(prices=(1, 200, 5), guarantee="local").guarantee == "local"
    own = Policy(guarantee="my_rules:Rule").changed(prices=(1, 200, 5))
    assert (own.guarantee, own.audit_rate) == ("my_rules:Rule", 0.0)


@pytest.mark.parametrize(
    "policy",
    [Policy(), Policy(guarantee="local", prices=(0.5, 200, 5)), Policy(prices=(0.5, 200, 5))],
    ids=["default", "prices without effect", "by prices"],
)
def test_a_policy_that_was_written_reads_as_it_was(policy: Policy) -> None:
    recipe = Recipe(policy=policy)
    assert Recipe.from_toml(recipe.to_toml()).policy == policy
    assert Policy.from_values(policy.to_values()) == policy
