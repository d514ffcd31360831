"""The pooled guarantee and the safe mode, as rules that are told what became of parts."""

import math

import numpy as np
import pytest
import torch

from dengine.decision.certificate import log_evidence
from dengine.decision.rule import BETS, FALSE_ALARMS, LOWEST, SAFE_MODE, DecisionRule, PooledRule, WatchedRule, script

ACCEPT, REJECT, VERIFY = 1, 2, 0


def pooled(alpha: float = 0.1, lower_bound: float = 0.9) -> PooledRule:
    return PooledRule(alpha, lower_bound)


def tell(rule: DecisionRule, lower: float, *outcomes: bool, upper: float = 1.0) -> None:
    for success in outcomes:
        rule.tell(lower, upper, success)


def enough(alpha: float, tolerance: float) -> int:
    """Good parts in a row that are evidence enough."""
    return next(n for n in range(1, 1000) if log_evidence(n, 0, tolerance, 1.0, BETS) >= math.log(1 / alpha))


@pytest.mark.parametrize(("alpha", "lower_bound"), [(0.1, 0.9), (0.05, 0.95), (0.2, 0.8)])
def test_a_level_opens_with_the_part_that_makes_the_evidence_enough(alpha: float, lower_bound: float) -> None:
    rule, n = pooled(alpha, lower_bound), enough(alpha, 1 - lower_bound)
    assert rule(1000, 0)[0] == rule.action(1.0, 1.0) == VERIFY  # however good the ball looks
    tell(rule, lower_bound, *[True] * (n - 1))
    assert rule.action(lower_bound, 1.0) == VERIFY
    tell(rule, lower_bound, True)
    assert rule.action(lower_bound, 1.0) == ACCEPT
    # Each is a member of all looser levels too, so the loosest holds as well: what looks worse was never seen to fail.
    assert rule.action(LOWEST + 0.05, 1.0) == ACCEPT


def test_a_looser_level_holds_only_while_the_stricter_ones_do() -> None:
    rule = pooled()
    tell(rule, 0.5, *[True] * 200)
    assert rule.action(0.5, 1.0) == VERIFY  # no member of LB's own level is known
    tell(rule, 0.95, *[True] * enough(0.1, 0.1))
    assert rule.action(0.5, 1.0) == ACCEPT
    tell(rule, 0.95, *[False] * 4)
    assert rule.action(0.5, 1.0) == VERIFY


def test_a_level_that_its_members_contradict_stays_shut_below_the_ones_that_hold() -> None:
    rule = pooled()
    tell(rule, 0.9, *[True] * 60)
    tell(rule, 0.7, *[True, False] * 20)
    assert rule.action(0.9, 1.0) == ACCEPT
    assert rule.action(0.7, 1.0) == VERIFY


def test_a_part_that_both_sides_claim_is_verified() -> None:
    rule = pooled()
    tell(rule, 0.9, *[True] * 60)
    tell(rule, 0.0, *[False] * 60, upper=0.1)
    assert rule.action(0.95, 1.0) == ACCEPT
    assert rule.action(0.0, 0.05) == REJECT
    assert rule.action(0.4, 0.6) == VERIFY


@pytest.mark.parametrize("kind", [PooledRule, WatchedRule])
def test_a_collapse_of_what_is_accepted_is_noticed_within_six_parts_and_verified_until_fresh_evidence(kind) -> None:
    rule = kind(0.1, 0.9)
    tell(rule, 0.95, *[True] * 500)
    bad = fresh = 0
    while rule.action(0.95, 1.0) == ACCEPT:
        tell(rule, 0.95, False)
        bad += 1
    assert bad <= 6
    assert SAFE_MODE[rule.safe_mode()] == "accepted parts failed more often than the tolerance"
    while rule.safe_mode() != 0:
        assert rule.action(1.0, 1.0) == VERIFY
        assert rule.action(0.0, 0.0) == VERIFY
        tell(rule, 0.95, True)
        fresh += 1
    assert fresh >= enough(0.1, 0.1)  # what was known before the alarm does not count
    assert rule.action(0.95, 1.0) == ACCEPT


def test_a_rate_within_the_tolerance_hardly_ever_starts_safe_mode() -> None:
    rng, alarms, parts = np.random.default_rng(1), 0, 0
    for _ in range(20):
        rule = WatchedRule(0.1, 0.9)
        for success in rng.random(600) < 0.92:
            tell(rule, 0.95, bool(success))
            parts += 1
            if rule.safe_mode():
                alarms += 1
                break
    assert alarms <= parts * 0.1 / FALSE_ALARMS + 3


def test_silence_is_no_success_for_a_level_and_no_failure_for_the_watch() -> None:
    silent, told = pooled(), pooled()
    for rule in (silent, told):
        tell(rule, 0.95, *[True] * 100)
    before = silent.evidence.members.clone()
    silent.observe(50, False)
    assert torch.equal(silent.evidence.members, before)
    for _ in range(50):
        told.observe(1, False)
    torch.testing.assert_close(silent.evidence.watch[0], told.evidence.watch[0])  # fifty at once, or one by one
    # Every twentieth accepted part stops the system: within the tolerance, though no success is ever heard of.
    watched = WatchedRule(0.1, 0.9)
    for _ in range(30):
        watched.observe(19, False)
        watched.tell(0.95, 1.0, False)
    assert watched.safe_mode() == 0


def test_too_many_novel_traces_start_safe_mode_and_a_few_do_not() -> None:
    few, many = pooled(), pooled()
    for i in range(300):
        few.observe(0, i % 10 == 0)
        many.observe(0, i % 2 == 0)
    assert few.safe_mode() == 0
    assert SAFE_MODE[many.safe_mode()] == "too many traces were novel"


@pytest.mark.parametrize("kind", [DecisionRule, PooledRule, WatchedRule])
def test_the_scripted_rule_is_told_and_asked_as_the_eager_one(kind: type[DecisionRule]) -> None:
    eager, scripted = kind(0.1, 0.9), script(kind(0.1, 0.9))
    rng = np.random.default_rng(2)
    for _ in range(400):
        lower = float(rng.random())
        upper = float(rng.uniform(lower, 1.0))
        success, silent, novel = bool(rng.random() < 0.97), int(rng.integers(0, 3)), bool(rng.random() < 0.05)
        for rule in (eager, scripted):
            rule.observe(silent, novel)
            rule.tell(lower, upper, success)
        assert eager.safe_mode() == scripted.safe_mode()
    for name, value in eager.state_dict().items():
        assert torch.equal(value, scripted.state_dict()[name]), name
    counts = [(n, k) for n in range(0, 60, 7) for k in range(0, 10, 3)]
    assert [eager(*each) for each in counts] == [scripted(*each) for each in counts]


@pytest.mark.parametrize("first", [0, 1])
def test_after_safe_mode_each_side_opens_by_its_own_evidence(first: int) -> None:
    rule = WatchedRule(0.1, 0.9)
    shown = [lambda n: tell(rule, 0.95, *[True] * n), lambda n: tell(rule, 0.0, *[False] * n, upper=0.02)]
    tell(rule, 0.95, *[True] * 100, *[False] * 6)
    assert rule.safe_mode() != 0
    shown[first](100)
    assert rule.safe_mode() == 0
    assert rule.action(*[(0.95, 1.0), (0.0, 0.02)][1 - first]) == VERIFY
    shown[1 - first](100)
    assert rule.action(0.95, 1.0) == ACCEPT
    assert rule.action(0.0, 0.02) == REJECT
