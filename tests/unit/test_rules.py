"""The rules of the package take the same steps as a second implementation, and the proof that is
played with that one finds faults.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from dengine import Policy
from dengine.decision.certificate import cusum, log_evidence
from dengine.decision.member_rules import MemberRule
from tests.slow.proof.rules.__main__ import FAULTS, verdict
from tests.slow.proof.rules.implementation import Rules, design_cusum, log_certificate
from tests.slow.proof.rules.replays import ALPHA, Case, play

ALL = {"stops": "all"}
AUDITED = {"stops": "some", "audit_rate": 0.3}
LOOSE = {"alpha": 0.2, "lower_bound": 0.8}
CASES: dict[str, dict[str, Any]] = {
    "local": {"guarantee": "local", **ALL},
    "pooled": {"guarantee": "pooled", **ALL},
    "pooled, audited": {"guarantee": "pooled", **LOOSE, **AUDITED},
    "cost": {"guarantee": "cost", **ALL},
    "cost, audited": {"guarantee": "cost", "prices": (5.0, 50.0, 20.0), **AUDITED},
}
N_REPLAYS = 4
N_PARTS = 1600
SHARES_BAD = np.array([0.1, 0.3, 0.7, 0.9])  # of the replays


def random_parts(rng: np.random.Generator, levels: list[float]) -> dict[str, Any]:
    """Parts of all replays at one moment: bounds, often on a level, and how they come to be known."""
    lower = np.where(
        rng.random(N_REPLAYS) < SHARES_BAD,
        rng.uniform(0.0, 0.03, N_REPLAYS),
        rng.uniform(0.85, 1.0, N_REPLAYS),
    )
    lower = np.where(rng.random(N_REPLAYS) < 0.1, rng.random(N_REPLAYS), lower)
    lower = np.where(rng.random(N_REPLAYS) < 0.2, rng.choice(levels, N_REPLAYS), lower)
    gap = np.where(rng.random(N_REPLAYS) < 0.5, 0.0, 0.3 * rng.random(N_REPLAYS))
    return {"lower": lower, "upper": np.minimum(1.0, lower + gap)}


def outcomes(
    rng: np.random.Generator, t: int, parts: dict[str, Any], actions: Any, q: float
) -> tuple[Any, ...]:
    """Whose outcome becomes known, of what part and outcome, and how it was asked for.

    A line stop is heard of though nobody asked: it is no evidence where audits are.
    """
    p_good = np.where(parts["lower"] > 0.5, 0.99, 0.01)
    if t % 400 > 340:  # the one side fails, or the other
        p_good = np.full(N_REPLAYS, [0.3, 0.9][t // 400 % 2])
    success = rng.random(N_REPLAYS) < p_good
    asked = (actions == 0) | (rng.random(N_REPLAYS) < q)
    inclusion = np.where(asked, np.where(actions == 0, 1.0, q), 0.0)
    return asked | ((actions == 1) & ~success), parts, success, actions, inclusion


def state_of(rule: MemberRule) -> list[Any]:
    """What the rule of the package holds: safe mode, thresholds, targets and detectors."""
    evidence = rule.evidence
    names = ("thresholds", "target_level", "detector_sums")
    return [rule.safe_mode(), *(getattr(evidence, name).tolist() for name in names)]


def second_state(rules: Rules, i: int) -> list[Any]:
    """The same of replay i of the second implementation."""
    sums = [*(side.cusum[i] for side in rules.sides), rules.novelty[i]]
    thresholds = [side.threshold[i] for side in rules.sides]
    return [rules.safe_mode[i], thresholds, [side.target[i] for side in rules.sides], sums]


@pytest.mark.parametrize("name", CASES)
def test_the_rule_takes_the_steps_of_a_second_implementation(name):
    policy = Policy(**{"alpha": 0.1, "lower_bound": 0.9} | CASES[name])
    products = [policy.rule() for _ in range(N_REPLAYS)]
    q = policy.inclusion_probability
    second = Rules(policy.guarantee, N_REPLAYS, policy.alpha, policy.tolerances, q)
    levels = [float(level) for side in second.sides for level in side.levels]
    rng = np.random.default_rng(sum(map(ord, name)))
    late: list[tuple[int, Any]] = []
    seen = set()
    for t in range(N_PARTS):
        parts = random_parts(rng, levels)
        actions = second.action(parts["lower"], parts["upper"])
        bounds = list(zip(parts["lower"].tolist(), parts["upper"].tolist(), strict=True))
        assert actions.tolist() == [
            rule.action(*bound) for rule, bound in zip(products, bounds, strict=True)
        ]
        reports = [outcomes(rng, t, parts, actions, q)]
        if rng.random() < 0.2:  # it comes late: by then other thresholds are in force
            late.append((t + int(rng.integers(1, 60)), reports.pop()))
        reports += [report for due, report in late if due == t]
        for known, part, good, predicted, inclusion in reports:
            silent = rng.integers(0, 4, N_REPLAYS) * (rng.random(N_REPLAYS) < 0.1)
            novel = rng.random(N_REPLAYS) < (0.8 if t % 500 > 460 else 0.03)
            second.observe(known, silent, novel)
            second.update(known, part["lower"], part["upper"], good, predicted, inclusion)
            for i in np.flatnonzero(known):
                products[i].observe(int(silent[i]), bool(novel[i]))
                outcome = (values[i].item() for values in (good, predicted, inclusion))
                products[i].update(part["lower"][i].item(), part["upper"][i].item(), *outcome)
        for i, rule in enumerate(products):
            assert state_of(rule) == second_state(second, i), (t, i)
            thresholds = rule.evidence.thresholds.tolist()
            seen.add((rule.safe_mode(), *(level < 2.0 for level in thresholds)))
    assert {mode for mode, _, _ in seen} == {0, 1, 2, 3}  # the stream reaches every state
    assert len(seen) >= 6


@pytest.mark.parametrize("q", [1.0, 0.1])
def test_the_second_certificate_is_that_of_the_package(q):
    rng = np.random.default_rng(3)
    n = rng.integers(1, 3000, 200)
    columns = n, rng.binomial(n, 0.05), rng.uniform(0.001, 0.999, 200)
    expected = [log_evidence(*row, q) for row in zip(*map(np.ndarray.tolist, columns), strict=True)]
    np.testing.assert_allclose(log_certificate(*columns, q), expected, atol=1e-8)


@pytest.mark.parametrize("share", [0.2, 0.1, 0.05, 5 / 120])
def test_the_second_detector_is_that_of_the_package(share):
    assert design_cusum(share, 1000.0) == cusum(share, 1000.0)


@pytest.mark.parametrize("case", FAULTS, ids=lambda case: case.fault)
def test_a_planted_fault_is_found_and_without_it_the_promise_is_kept(case):
    n = 400
    faulty = play(case, n, seed=1)["broke"]
    stream = "constant" if case.fault == "peeks" else case.stream
    honest = play(replace(case, fault="", stream=stream), n, seed=1)["broke"]
    assert verdict(faulty, n, ALPHA) == "BROKEN"
    assert stats.binomtest(int(honest), n, ALPHA, alternative="greater").pvalue > 1e-3


def test_by_costs_no_replay_of_an_adversary_is_ever_more_than_one_false_accept_behind():
    row = play(Case("cost", "adversary"), 200, seed=2)
    assert row["accepted"] > 0
    assert row["broke"] == row["over_account"] == 0
