"""The user's two numbers: a bound becomes an action."""

import math
from dataclasses import replace
from functools import partial

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


@pytest.mark.parametrize(
    ("lower", "upper", "action"),
    [
        (0.75, 1.0, Action.ACCEPT),
        (math.nextafter(0.75, 0), 1.0, Action.VERIFY),
        (0.0, 0.25, Action.REJECT),
        (0.0, math.nextafter(0.25, 1), Action.VERIFY),
    ],
)
def test_both_thresholds_are_met_with_equality(lower, upper, action):
    assert Policy(lower_bound=0.75).action(lower, upper) is action  # exact in binary


@given(policies)
def test_without_evidence_every_policy_verifies(policy):
    assert policy.action(*policy.bound(0, 0)) is Action.VERIFY


@given(policies, st.integers(0, 300), st.integers(0, 300))
def test_a_stricter_policy_is_certain_only_where_the_looser_is(policy, n_s, n_f):
    strict = Policy(policy.alpha / 2, (policy.lower_bound + 1) / 2)
    action = strict.action(*strict.bound(n_s, n_f))
    assert action in (Action.VERIFY, policy.action(*policy.bound(n_s, n_f)))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("alpha", 0.0, "0 < alpha < 1"),
        ("alpha", math.nan, "0 < alpha < 1"),
        ("lower_bound", 0.5, r"0\.5 < lower_bound < 1"),
        ("lower_bound", 1.0, r"0\.5 < lower_bound < 1"),
        ("interval", "wald", "wilson, binomial, clopper_pearson, jeffreys"),
        ("audit_rate", 1.1, "audit_rate"),
        ("force_limits", ["0.2:0.1:0:"], "start <= end"),
        ("force_limits", ["0.1:0.2::1:canal=2"], r"START:END:LOW:HIGH, .*canal"),
        ("force_limits", ["0.1:0.2:30"], "got '0.1:0.2:30'"),
        ("force_limits", ["0.1:0.2::1:reject=no"], "reject='no'"),
        ("force_limits", ["0.1:0.2:1::channel=F Z"], "or names"),
        ("force_limits", ["0.2=9:0.4::60"], "0.2=9"),
    ],
)
def test_a_setting_out_of_range_is_named_with_what_was_expected(name, value, message):
    with pytest.raises(SettingError, match=message):
        Policy(**{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("window", "expected"),
    [  # by seconds, or by channel 1, of samples 0 to 5 ten a second, and of their negatives
        ("0.2:0.4:2:4", WITHIN_LIMITS),  # its ends and its limits are within
        ("0.2:0.4::3.9", ActionCode.VERIFY),
        ("0.2:0.4:2.1::reject", ActionCode.REJECT),
        ("5.1:5.9:0::along=0", ActionCode.VERIFY),  # no sample lies there
        ("-5:-3::5:along=Z", WITHIN_LIMITS),
        ("-5:-3::4.9:along=1:reject", ActionCode.REJECT),
        ("3:3:-3:-3:channel=Z:along=F:reject", WITHIN_LIMITS),
        ("3:3:3:3:channel=Z:along=F:reject", ActionCode.REJECT),
    ],
)
def test_a_window_holds_the_samples_of_its_stretch_of_time_or_path_to_its_limits(window, expected):
    x = torch.arange(6, dtype=torch.float32)
    limited = recipe(force_limits=(window,))
    spec = TraceSpec(6, rate_hz=10.0, channels=2, columns=("F", "Z"))
    assert ForceLimitsGate(limited.policy.force_limits, spec)(torch.stack([x, -x])) == expected
    assert Recipe.from_toml(limited.to_toml()) == limited


def test_force_limits_under_their_old_name_are_read_in_recipes_and_stores():
    limits = (ForceLimits(0.1, 0.2, high=30.0),)
    old = Recipe.from_toml('reducer = "pca"\n[policy]\nwindows = ["0.1:0.2::30"]\n').policy
    assert old.force_limits == Policy.from_values({"windows": "0.1:0.2::30"}).force_limits == limits
    assert "windows" not in Policy(force_limits=limits).to_values()


IN_SECONDS = Policy(force_limits=("0.02:0.1::1e6",))


@pytest.mark.parametrize(
    "begin",
    [
        partial(DataEngine, policy=IN_SECONDS, trace=TraceSpec(SAMPLES, unit="N")),
        partial(DataEngine, model=Counting(), policy=IN_SECONDS),
        lambda: DataEngine().set_policy(IN_SECONDS),
    ],
)
def test_force_limits_in_seconds_are_refused_at_once_while_the_rate_is_unknown(begin):
    with pytest.raises(SettingError, match=r"Expected the rate of the traces.* TraceSpec\(samples"):
        begin()


def test_force_limits_along_a_path_need_no_rate(make_data):
    with DataEngine("pca", policy=Policy(force_limits=("-1e9:1e9::1e6:along=0",))) as engine:
        assert engine.decide(make_data(1).X[0]).reason is Reason.NO_MODEL
        assert engine.trace.rate_hz is None


def test_a_part_outside_a_window_is_no_decision_of_the_model_and_no_claim_counts_it(
    make_data, tmp_path
):
    store, data = tmp_path / "cell.db", make_data(300, SAMPLES)
    with trained(data, store) as engine:
        x = next(x for x in data.X if engine.decide(x).action is Action.ACCEPT)
        limits = f"0:0.1::{x[:50].max() - 0.1}:reject"
        engine.set_policy(replace(engine.policy, force_limits=(limits,)))
        decision = engine.decide(x)
        decided = decision.action, decision.predicted, decision.reason, decision.propensity
        assert decided == (Action.REJECT, Action.VERIFY, Reason.OUTSIDE, 0.0)
        engine.set_shadow(True)
        assert engine.decide(x).action is Action.VERIFY
    with DataEngine.open(store) as engine:
        newest, certificate = engine.status().newest, engine.status().certificate
        assert (newest.outside, newest.rejected) == (2, 0)
        assert (certificate.rejected.n, certificate.accepted.n) == (0, 0)
        assert engine.status(last=3).alarm == "2 of the newest parts leave the force limits."
        assert f"force limits, {limits[:6]}" in engine.explain(decision.id).sentences[0]


@pytest.mark.parametrize("limits", ["0.3:0.4:0:", "0:1:0::channel=1", "0:1:0::along=FZ"])
def test_force_limits_that_hold_no_sample_are_refused(limits):
    engine = DataEngine(trace=TraceSpec(SAMPLES, rate_hz=500.0))
    with pytest.raises(SettingError, match="on some of 1 x 100 samples"):
        engine.set_policy(Policy(force_limits=(limits,)))


@pytest.mark.parametrize(
    ("stated", "expected"),
    [
        ({}, ("cost", 0.05)),
        ({"audit_rate": 0.2}, ("cost", 0.2)),
        ({"audit_rate": 0.0, "stops": "all", "prices": (1, 200, 5)}, ("cost", 0.0)),
        ({"guarantee": "my_rules:Rule"}, ("my_rules:Rule", 0.0)),
    ],
)
def test_prices_alone_are_the_cost_guarantee_with_audits_and_what_is_stated_stays(stated, expected):
    settings = stated | {"prices": (0.5, 200, 5)}
    policy = Policy(**settings)
    assert (policy.guarantee, policy.audit_rate) == expected
    assert Policy().changed(**settings) == policy
    assert Policy(**stated).changed(prices=(0.5, 200, 5)) == policy


@pytest.mark.parametrize("stated", [{"guarantee": "local"}, {}])
def test_a_policy_that_was_written_reads_as_it_was(stated):
    policy = Policy(prices=(0.5, 200, 5), **stated)
    assert Recipe.from_toml(Recipe(policy=policy).to_toml()).policy == policy
    assert Policy.from_values(policy.to_values()) == policy
