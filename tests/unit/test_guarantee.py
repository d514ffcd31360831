"""The pooled guarantee and the safe mode, as rules that are told what became of parts."""

import math

import numpy as np
import pytest
import torch
from scipy import stats

from dengine import Policy
from dengine.decision.member_rules import LOWEST_LEVEL, PooledRule, PricedRule, WatchedRule
from dengine.decision.members import (
    BET,
    FALSE_ALARMS,
    MemberEvidence,
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


@pytest.mark.parametrize(("alpha", "lower_bound"), [(0.1, 0.9), (0.05, 0.95), (0.2, 0.8)])
def test_a_level_opens_with_the_part_that_makes_the_evidence_enough(
    alpha: float, lower_bound: float
) -> None:
    rule, n = pooled(alpha, lower_bound), enough(alpha, 1 - lower_bound)
    assert rule(1000, 0)[0] == rule.action(1.0, 1.0) == VERIFY  # however good the ball looks
    tell(rule, lower_bound, *[True] * (n - 1))
    assert rule.action(lower_bound, 1.0) == VERIFY
    tell(rule, lower_bound, True)
    assert rule.action(lower_bound, 1.0) == ACCEPT
    # Each is a member of all looser levels too, so the loosest holds as well: what looks worse was
    # never seen to fail.
    assert rule.action(LOWEST_LEVEL + 0.05, 1.0) == ACCEPT


def test_what_came_before_a_level_was_aimed_at_is_no_evidence_for_it() -> None:
    rule, n = pooled(), enough(0.1, 0.1)
    tell(rule, 0.5, *[True] * (n - 1))
    assert rule.action(0.9, 1.0) == VERIFY
    tell(rule, 0.5, True)  # now that level is aimed at, and it has no members yet
    assert rule.action(0.5, 1.0) == VERIFY
    tell(rule, 0.5, *[True] * n)
    assert rule.action(0.5, 1.0) == ACCEPT
    tell(rule, 0.5, *[False] * 8)
    assert rule.action(0.5, 1.0) == VERIFY


def test_a_pooled_guarantee_of_which_nobody_hears_is_refused() -> None:
    with pytest.raises(
        SettingError, match="Expected audits, or stops='all', beside the pooled guarantee"
    ):
        Policy(guarantee="pooled")
    assert Policy(guarantee="pooled", audit_rate=0.02).rule().evidence.inclusion_probability == 0.02
    assert (
        Policy(guarantee="pooled", stops="all", audit_rate=0.02)
        .rule()
        .evidence.inclusion_probability
        == 1.0
    )


def adversary(rule: PooledRule, rng: np.random.Generator, tolerance: float) -> bool:
    """Whether anything ever passes, where every part is beyond the tolerance: who sees the levels
    tries one by one.
    """
    for level in reversed(rule.evidence.levels[0]):
        for _ in range(60):
            rule.update(level, 1.0, bool(rng.random() >= 1.02 * tolerance))
            if rule.action(level, 1.0) == ACCEPT:
                return True
    return False


def test_an_adversary_who_sees_the_levels_makes_a_false_claim_no_more_often_than_alpha() -> None:
    def false_claims() -> int:
        return sum(adversary(pooled(0.2, 0.8), np.random.default_rng(i), 0.2) for i in range(40))

    def each_level_by_itself(self: MemberEvidence, side: int) -> None:
        choose_threshold(self, side)
        target = int(self.target_level[side])
        counts = self.level_counts_since_alarm[side, target].flatten().tolist()
        if self.allows_more(side, counts):
            self.thresholds[side].fill_(self.levels[side][target])

    choose_threshold = MemberEvidence.choose_threshold
    honest = false_claims()
    assert stats.binomtest(honest, 40, 0.2, alternative="greater").pvalue > 1e-3
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MemberEvidence, "choose_threshold", each_level_by_itself)
        assert (
            stats.binomtest(false_claims(), 40, 0.2, alternative="greater").pvalue < 1e-3
        )  # it is an adversary


def priced(inclusion_probability: float = 1.0) -> PricedRule:
    return PricedRule(0.1, 0.9, "wilson", (5 / 120, 5 / 47.5), inclusion_probability)


@pytest.mark.parametrize("share_bad", [0.02, 0.06, 0.3])
def test_by_costs_a_part_passes_only_while_the_members_had_cost_at_most_three_escapes_beyond_their_checks(
    share_bad,
) -> None:
    for seed in range(20):
        rule, rng, cost, passed = priced(), np.random.default_rng(seed), 0.0, 0
        for _ in range(400):
            if rule.action(1.0, 1.0) == ACCEPT:
                passed += 1
                assert cost <= 360 + 1e-6
            good = bool(rng.random() >= share_bad)
            rule.update(1.0, 1.0, good)
            cost += 0 if good else 120
            cost -= 5
        assert passed > 0


def test_by_costs_nothing_passes_that_is_expected_to_cost_more_than_its_check() -> None:
    rule = priced()
    tell(rule, 1.0, *[True] * 100)
    tell(rule, 0.0, *[False] * 100, upper=0.0)
    assert [rule.action(1 - p, 1.0) for p in (0.041, 0.043)] == [ACCEPT, VERIFY]
    assert [rule.action(0.0, p) for p in (0.105, 0.106)] == [REJECT, VERIFY]


def test_a_doubled_share_of_bad_parts_ends_a_safe_mode_of_the_local_rule_in_at_most_alpha() -> None:
    n_ended = {0.1: 0, 0.2: 0}
    for rate in n_ended:
        for seed in range(40):
            rule = WatchedRule(0.1, 0.9)
            rule.start_in_safe_mode(1)
            for bad in np.random.default_rng(seed).random(250) < rate:
                tell(rule, 0.95, not bad)
                if rule.safe_mode() == 0:
                    n_ended[rate] += 1
                    break
    assert n_ended[0.1] >= 38  # at the tolerance it ends
    assert stats.binomtest(n_ended[0.2], 40, 0.1, alternative="greater").pvalue > 1e-3


@pytest.mark.parametrize(
    "prices", [(5, 120), (0, 120, 47.5), (5, 9, 47.5), (5, 120, math.inf), ("5", 120, 47.5), 5]
)
def test_prices_that_give_no_tolerance_below_one_half_are_refused(prices: object) -> None:
    with pytest.raises(
        SettingError,
        match="prices of a check, an escape and a false reject, errors above two checks",
    ):
        Policy(prices=prices)


def test_twice_the_tolerance_starts_safe_mode_soon_and_the_tolerance_hardly_ever() -> None:
    rng, mean = np.random.default_rng(1), []
    for rate in (0.1, 0.2):
        n, rules = 0, [WatchedRule(0.1, 0.9) for _ in range(20)]
        for rule in rules:
            while rule.safe_mode() == 0:
                rule.evidence.count_outcome(0, 0.95, bool(rng.random() < rate), 0, 1.0)
                n += 1
        mean.append(n / len(rules))
    assert mean[0] > 0.7 * FALSE_ALARMS / 0.1  # of 20; exactly, it is beyond that
    assert mean[1] < 106


@pytest.mark.parametrize(
    ("guarantee", "stops"),
    [("local", "some"), ("local", "all"), ("pooled", "all"), ("cost", "all")],
)
def test_the_scripted_rule_is_told_and_asked_as_the_eager_one(guarantee: str, stops: str) -> None:
    policy = Policy(0.1, 0.9, guarantee=guarantee, stops=stops)
    eager, scripted = policy.rule(), script(policy.rule())
    rng = np.random.default_rng(2)
    for _ in range(400):
        lower = float(rng.random())
        upper = float(rng.uniform(lower, 1.0))
        success, silent, novel = (
            bool(rng.random() < 0.97),
            int(rng.integers(0, 3)),
            bool(rng.random() < 0.05),
        )
        for rule in (eager, scripted):
            rule.observe(silent, novel)
            rule.update(lower, upper, success)
        assert eager.safe_mode() == scripted.safe_mode()
    for name, value in eager.state_dict().items():
        assert torch.equal(value, scripted.state_dict()[name]), name
    counts = [(n, k) for n in range(0, 60, 7) for k in range(0, 10, 3)]
    assert [eager(*count) for count in counts] == [scripted(*count) for count in counts]


@pytest.mark.parametrize("kind", ["watched", "pooled", "priced"])
def test_what_is_missing_to_the_end_of_a_safe_mode_is_about_what_it_takes(kind: str) -> None:
    rule = {"watched": WatchedRule(0.1, 0.9), "pooled": pooled(), "priced": priced()}[kind]
    rule.start_in_safe_mode(1)
    assert rule.evidence.members_to_recovery(0) > 20
    tell(rule, 0.99, *[True] * 10)
    n_missing = rule.evidence.members_to_recovery(0)
    n = 0
    while rule.safe_mode() != 0:
        tell(rule, 0.99, True)
        n += 1
    assert n_missing == pytest.approx(n, abs=5)
    assert rule.evidence.members_to_recovery(0) <= 0.0
    rule.start_in_safe_mode(1)
    tell(rule, 0.99, *[False] * 5)
    assert rule.evidence.members_to_recovery(0) > 1e6  # it does not grow
