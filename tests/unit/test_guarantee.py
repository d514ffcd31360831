"""The pooled guarantee and the safe mode, as rules that are told what became of parts."""

import math
from functools import partial

import numpy as np
import pytest
import torch

from dengine import Policy
from dengine.decision.member_rules import PooledRule, PricedRule, WatchedRule
from dengine.decision.members import (
    BET,
    FALSE_ALARMS,
)
from dengine.decision.rule import DecisionRule
from dengine.decision.scripting import script
from dengine.errors import SettingError

ACCEPT, REJECT, VERIFY = 1, 2, 0


def pooled(alpha: float = 0.1, lower_bound: float = 0.9) -> PooledRule:
    return PooledRule(alpha, lower_bound)


def tell(rule: DecisionRule, lower: float, *outcomes: bool, upper: float = 1.0) -> None:
    for success in outcomes:
        rule.update(lower, upper, success)


def enough(alpha: float, tolerance: float) -> int:
    """Good parts in a row that are evidence enough."""
    return next(
        n for n in range(1, 1000) if -n * math.log1p(-BET * tolerance) >= math.log(1 / alpha)
    )


def test_what_came_before_a_level_was_aimed_at_is_no_evidence_for_it():
    rule, n = pooled(), enough(0.1, 0.1)
    tell(rule, 0.5, *[True] * (n - 1))
    assert rule.action(0.9, 1.0) == VERIFY
    tell(rule, 0.5, True)  # now that level is aimed at, and it has no members yet
    assert rule.action(0.5, 1.0) == VERIFY
    tell(rule, 0.5, *[True] * n)
    assert rule.action(0.5, 1.0) == ACCEPT
    tell(rule, 0.5, *[False] * 8)
    assert rule.action(0.5, 1.0) == VERIFY


def test_a_pooled_guarantee_of_which_nobody_hears_is_refused():
    with pytest.raises(SettingError, match="Expected audits, or stops='all'"):
        Policy(guarantee="pooled")
    assert Policy(guarantee="pooled", audit_rate=0.02).rule().evidence.inclusion_probability == 0.02


def priced() -> PricedRule:
    return PricedRule(0.1, 0.9, "wilson", (5 / 120, 5 / 47.5), 1.0)


def test_by_costs_nothing_passes_that_is_expected_to_cost_more_than_its_check():
    rule = priced()
    tell(rule, 1.0, *[True] * 100)
    tell(rule, 0.0, *[False] * 100, upper=0.0)
    assert [rule.action(1 - p, 1.0) for p in (0.041, 0.043)] == [ACCEPT, VERIFY]
    assert [rule.action(0.0, p) for p in (0.105, 0.106)] == [REJECT, VERIFY]


@pytest.mark.parametrize("prices", [(5, 120), (0, 120, 47.5), (5, 9, 47.5), (5, 1e12, 9e9), 5])
def test_prices_that_give_no_tolerance_below_one_half_are_refused(prices):
    with pytest.raises(SettingError, match=r"prices of a check, .*errors of 2 to 1,000,000 checks"):
        Policy(prices=prices)


def parts_to_alarm(rate: float) -> float:
    """Mean over 20 rules, where this share of the parts is bad and the tolerance is 0.1."""
    rng, n = np.random.default_rng(1), 0
    for _ in range(20):
        rule = WatchedRule(0.1, 0.9)
        while rule.safe_mode() == 0:
            rule.evidence.count_outcome(0, 0.95, bool(rng.random() < rate), 0, 1.0)
            n += 1
    return n / 20


def test_twice_the_tolerance_starts_safe_mode_soon_and_the_tolerance_hardly_ever():
    assert parts_to_alarm(0.1) > 0.7 * FALSE_ALARMS / 0.1  # of 20; exactly, it is beyond that
    assert parts_to_alarm(0.2) < 106


@pytest.mark.parametrize(
    ("guarantee", "stops"),
    [("local", "some"), ("local", "all"), ("pooled", "all"), ("cost", "all")],
)
def test_the_scripted_rule_is_told_and_asked_as_the_eager_one(guarantee, stops):
    policy = Policy(0.1, 0.9, guarantee=guarantee, stops=stops)
    eager, scripted = policy.rule(), script(policy.rule())
    for lower, gap, *draws in np.random.default_rng(2).random((400, 5)).tolist():
        bad, silent, novel = (draw < 0.04 for draw in draws)
        for rule in (eager, scripted):
            rule.observe(3 * silent, novel)
            rule.update(lower, lower + gap * (1 - lower), not bad)
        assert eager.safe_mode() == scripted.safe_mode()
    for name, value in eager.state_dict().items():
        assert torch.equal(value, scripted.state_dict()[name]), name
    assert eager(60, 1) == scripted(60, 1)


@pytest.mark.parametrize("make", [partial(WatchedRule, 0.1, 0.9), pooled, priced])
def test_what_is_missing_to_the_end_of_a_safe_mode_is_about_what_it_takes(make):
    rule = make()
    rule.start_in_safe_mode(1)
    tell(rule, 0.99, *[True] * 10)
    n_missing, n = rule.evidence.members_to_recovery(0), 0
    while rule.safe_mode() != 0:
        tell(rule, 0.99, True)
        n += 1
    assert n_missing == pytest.approx(n, abs=5)
    rule.start_in_safe_mode(1)
    tell(rule, 0.99, *[False] * 5)
    assert rule.evidence.members_to_recovery(0) > 1e6  # it does not grow
