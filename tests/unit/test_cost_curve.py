"""What a part costs under each policy: sums by hand, candidates, halving, the choice, what it says,
its picture and its verb.
"""

import math
import shlex
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from dengine import DataEngine, Policy, Recipe
from dengine.errors import SettingError
from dengine.experiments.costs import (
    CostCurve,
    candidates,
    cost_curve,
    curve_of,
    find_policy,
    needed_parts,
    part_costs,
    policy_name,
    settings_of,
)
from dengine.experiments.grid import Task
from dengine.experiments.metrics import Costs
from dengine.experiments.replay import Contender, Replay, replay, replay_policy
from tests.support.command_line import document, succeed
from tests.support.replays import replay_of

COSTS = Costs(check=5, escape=100, false_reject=20)
STRICT, LAX = Policy(0.05, 0.95), Policy(0.5, 0.8)
BY_COST = Policy(prices=(5, 100, 20))
RECIPE = Recipe.load("pca").with_policy(stops="all")
PRICES = {"check": 5, "escape": 20, "false_reject": 11}


def played(
    policy: Policy, seed: int, verified: int, accepted: int, bad: int, rejected: int = 0
) -> Replay:
    """A replay with so many decisions of each kind, of which so many accepts are bad; the parts of
    each kind are the same in every shuffle.
    """
    action = ["verify"] * verified + ["accept"] * accepted + ["reject"] * rejected
    truth = [1] * verified + [0] * bad + [1] * (accepted - bad) + [0] * rejected
    return replay_of(action, truth, recipe=Recipe("pca", policy=policy), seed=seed)


def four(policy: Policy, *counts: int) -> dict[Policy, list[Replay]]:
    """Four shuffles of the same."""
    return {policy: [played(policy, seed, *counts) for seed in range(4)]}


def curve(
    lax: Sequence[tuple[int, int]],
    strict: Sequence[tuple[int, int]] = ((100, 0),) * 4,
    first: Policy = LAX,
) -> CostCurve:
    """Of two policies; for each shuffle of 100 parts, how many were verified, and how many of the
    others were bad.
    """
    groups = {
        policy: [played(policy, seed, n, 100 - n, bad) for seed, (n, bad) in enumerate(item)]
        for policy, item in ((first, lax), (STRICT, strict))
    }
    return curve_of(groups, COSTS)


def test_a_parts_cost_is_its_check_or_its_wrong_decision():
    action = ["verify", "verify", "accept", "accept", "reject", "reject"]
    assert part_costs(replay_of(action, [1, 0] * 3), COSTS).tolist() == [5, 5, 0, 100, 20, 0]


def test_a_part_that_an_operators_limits_reject_was_not_checked_and_pays_for_no_policy():
    reason = np.array(["certain"] * 80 + ["outside"] * 20)
    (replays,) = four(LAX, 60, 15, 0, 25).values()
    (row,) = curve_of({LAX: [replace(item, reason=reason) for item in replays]}, COSTS).rows
    assert (row.verified, row.cost) == pytest.approx((0.6, 5 * 0.8))


def test_no_row_is_cheaper_than_the_marked_one_unless_a_sentence_says_that_this_is_chance():
    result = curve(lax=[(40, 0), (50, 0), (50, 0), (60, 0)], strict=[(90, 0), (80, 0)] * 2)
    assert (result.policy, result.marked.cost) == (LAX, 2.5)
    assert "beyond chance" not in result.sentence
    close = curve(lax=[(20, 1), (20, 0), (20, 3), (20, 0)], strict=[(45, 0)] * 4)
    assert close.rows[0].cost < close.marked.cost
    assert close.policy == STRICT
    assert "Alpha 0.5, LB 80 % costs 2, which is not cheaper beyond chance" in close.sentence


def test_the_guarantee_by_cost_may_let_more_bad_parts_through_if_it_is_cheaper_than_all_else():
    chosen = [
        curve([(n, 1), (n, 0), (n, 1), (n, 0)], [(strict, 0)] * 4, first).policy
        for first, n, strict in (
            (BY_COST, 39, 50), (LAX, 39, 50), (BY_COST, 90, 50), (BY_COST, 95, 100)
        )
    ]  # fmt: skip
    assert chosen == [BY_COST, STRICT, STRICT, None]


def test_the_interval_moves_the_errors_to_their_ends_and_adds_the_luck_of_the_order():
    row = curve([(50, 0), (50, 0), (50, 1), (50, 0)]).rows[0]
    assert (row.bad.decided, row.bad.wrong) == (200, 1)
    assert row.lower < row.cost < row.upper
    errors = 5 * 0.5 + 100 * 0.5 * row.bad.upper - row.cost
    luck = 3.182446 * np.std([2.5, 2.5, 3.5, 2.5], ddof=1) / 2  # Student's t of 3 degrees
    assert row.upper == pytest.approx(row.cost + math.hypot(errors, luck), rel=1e-5)


@pytest.mark.parametrize(
    ("counts", "verdict"), [((100, 2900, 10), "pays"), ((50, 50, 0), "may pay")]
)
def test_a_policy_pays_only_where_its_whole_interval_is_below_verifying_everything(counts, verdict):
    assert curve_of(four(LAX, *counts), COSTS).verdict == verdict


def alone(
    accepted: int, verified: int = 50, bad: int = 0, rejected: int = 0, stops: str = "all"
) -> CostCurve:
    """The curve of one policy, whose accepted parts are the same in each of four shuffles."""
    return curve_of(four(replace(LAX, stops=stops), verified, accepted, bad, rejected), COSTS)


@pytest.mark.parametrize(
    ("accepted", "bad", "rejected"),
    [(50, 0, 0), (50, 1, 0), (5, 0, 20)],
    ids=["no error", "an error", "rejects"],
)
def test_as_many_parts_as_are_missing_turn_may_pay_into_pays(accepted, bad, rejected):
    def times(n: int) -> CostCurve:
        return alone(accepted * n, 50 * n, bad * n, rejected * n)

    result = times(1)
    scale = 1 + result.missing.recordings / result.cycles
    n = math.ceil(scale)
    assert (times(n).verdict, times(n - 1).verdict) == ("pays", "may pay")
    assert result.missing.accepted == pytest.approx(accepted * scale, rel=0.03, abs=1)


def test_what_audits_alone_tell_takes_as_many_more_parts_as_they_are_rare():
    watched, audited = (alone(50, stops=stops).missing for stops in ("all", "some"))
    # Wilson's end z^2 / (n + z^2) of no bad one among n parts is 5 % at n = 19 z^2, z = 2.2414.
    assert (watched.accepted, watched.recordings) == (math.ceil(19 * 2.241403**2), 91)
    assert (watched.production, audited.production) == (191, 191 * 20)


@pytest.mark.parametrize("lax", [(50, 5), (100, 0)])
def test_where_nothing_pays_it_says_so_and_names_no_policy(lax):
    result = curve([lax] * 4)
    assert (result.verdict, result.policy) == ("does not pay", None)
    assert result.sentence.startswith("Nothing pays: verifying everything costs 5 a part")
    assert not result.to_frame()["chosen"].any()


@pytest.mark.parametrize(("escape", "verdict"), [(25, "does not pay"), (15, "may pay")])
def test_a_few_accepts_without_an_error_do_not_look_free_where_an_error_is_dear(escape, verdict):
    result = curve_of(four(LAX, 99, 1, 0), replace(COSTS, escape=escape))
    assert (result.marked.cost, result.verdict) == (4.95, verdict)
    assert ("half an error more" in result.sentence) == (verdict == "does not pay")


def test_needed_neighbours_are_those_of_the_interval_and_needed_members_those_of_the_bet():
    assert needed_parts(Policy(0.1, 0.9)) == 25
    assert needed_parts(Policy(0.05, 0.95, interval="clopper_pearson")) == 72
    pooled = Policy(0.05, 0.95, guarantee="pooled", stops="all")
    rule, n = pooled.rule(), 0
    while rule.action(0.99, 0.99) == 0:
        rule.update(0.99, 0.99, True, 0, 1.0)
        n += 1
    assert needed_parts(pooled) == n
    assert needed_parts(Policy(prices=(5, 120, 47.5))) == 0


def test_candidates_lie_around_break_even_and_have_the_audits_that_they_need():
    changes = list(candidates(Contender.load("pca"), Costs(0.5, 200, 5), (0.1,), ()))
    levels = [change["lower_bound"] for change in changes if change["guarantee"] == "local"]
    assert levels == [0.96, 0.98, 0.99, 0.995, 0.9975, 0.9987]  # break-even is 99.75 %
    assert {change.get("audit_rate", 0.05) for change in changes} == {0.05}
    assert changes[-1] == {"guarantee": "cost", "prices": (0.5, 200, 5), "audit_rate": 0.05}


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("check", 100, "a check below an escape"),
        ("check", 0, "a check that costs something"),
        ("false_reject", 0, "a false reject that costs something"),
        ("escape", "200 EUR", "a finite cost of 0 or more as escape, got '200 EUR'"),
        ("repeats", 1, "2 or more repeats"),
        ("lower_bounds", (0.999,), "recordings enough for one policy"),
        ("data", np.ones(30), r"good and bad recordings, got .* good and"),
    ],
)
def test_what_decides_nothing_is_refused(name, value, text, make_data):
    data, settings = make_data(30), PRICES | {"false_reject": 6}  # no guarantee by cost
    if name == "data":
        data = replace(data, y=value)
    else:
        settings |= {name: value}
    with pytest.raises(SettingError, match=text):
        cost_curve(data, recipe=RECIPE, **settings)


def cheaper_by_level(tasks: Sequence[Task]) -> list[Replay]:
    """Replays in which a stricter policy accepts less, and none is wrong."""
    return [
        played(policy, task.seed, n, 200 - n, 0)
        for task in tasks
        for policy in [task.contender.recipe.policy]
        for n in [round(100 * policy.lower_bound)]
    ]


BOUNDS = (0.6, 0.7, 0.8, 0.85, 0.88, 0.9)


def test_the_cheaper_half_plays_on_and_the_last_two_report_on_shuffles_that_chose_nothing(data):
    seeds = []

    def play(tasks: Sequence[Task]) -> list[Replay]:
        seeds.append([task.seed for task in tasks])
        return cheaper_by_level(tasks)

    # The search turns the shadow mode off, without which this guarantee would need audits.
    contender = Contender.load("knn").with_policy(shadow=True, guarantee="pooled")
    settings = {"lower_bounds": BOUNDS, "alphas": (0.2,), "repeats": 3, "seed": 7}
    result = find_policy(data, contender, COSTS, play, **settings)
    assert [(len(item), {*item}) for item in seeds] == [
        (12, {7, 8}),
        (6, {9, 10}),
        (6, {11, 12, 13}),
    ]
    assert [row.policy.lower_bound for row in result.rows] == [0.6, 0.7]
    assert len(result.left_behind) == 4
    assert (result.shuffles, result.fresh) == (3, True)
    assert result.to_frame()["reported"].sum() == 2


@pytest.mark.parametrize(("n_rounds", "fresh"), [(0, None), (1, False), (2, False)])
def test_a_search_that_is_interrupted_shows_what_was_finished(n_rounds, fresh, data):
    rounds = []

    def play(tasks: Sequence[Task]) -> list[Replay]:
        rounds.append(tasks)
        return cheaper_by_level(tasks if len(rounds) <= n_rounds else tasks[:1])

    result = find_policy(data, Contender.load("knn"), COSTS, play, lower_bounds=BOUNDS)
    assert (result and result.fresh) is fresh
    assert not result or "these shuffles also chose the policy" in result.sentence


@pytest.mark.parametrize(
    "policy",
    [
        Policy(0.5, 0.8, stops="all"),
        Policy(0.05, 0.7, stops="all", guarantee="pooled"),
        Policy(stops="all", prices=(5, 20, 11), audit_rate=0.0),
    ],
    ids=policy_name,
)
def test_a_policy_on_shared_scores_decides_like_a_replay_until_a_part_is_rejected(
    policy, make_data
):
    data, recipe = make_data(110), Recipe("rocket", {"kernels": 6, "width": 8}, retrain_every=40)
    scores = replay(data, replace(recipe, policy=Policy(shadow=True)), 3)
    shared, whole = replay_policy(scores, policy), replay(data, replace(recipe, policy=policy), 3)
    first = int(np.argmax(np.append(whole.action == "reject", True)))
    assert (whole.action[:first] != "verify").any()
    np.testing.assert_array_equal(shared.action[: first + 1], whole.action[: first + 1])
    assert shared.recipe.policy == policy


def test_the_curve_is_that_of_replays_under_the_recipes_other_settings(make_data):
    data, options = make_data(120), {"alphas": (0.5,), "lower_bounds": (0.8,)}
    result = cost_curve(data, recipe=RECIPE, cycles=90, repeats=2, **options, **PRICES)
    for row in result.rows:  # the first two shuffles chose
        again = [replay(data, replace(RECIPE, policy=row.policy), seed, 90) for seed in (2, 3)]
        assert row.policy.stops == "all"
        assert row.cost == pytest.approx(np.mean([part_costs(r, result.costs) for r in again]))
    assert (result.cycles, result.shuffles) == (90, 2)
    kinds = {row.policy.guarantee for row in (*result.rows, *result.left_behind)}
    assert kinds == {"local", "pooled", "cost"}
    assert "cost" in {row.policy.guarantee for row in result.rows}


@pytest.mark.parametrize(
    "policy",
    [
        Policy(0.1, 0.98, stops="all", guarantee="pooled", audit_rate=0.02),
        Policy(prices=(0.5, 200, 5)),
    ],
    ids=policy_name,
)
def test_the_lines_that_are_shown_set_the_policy(policy):
    assert Policy(**settings_of(policy)) == policy


WORDS = shlex.split(
    "costs --data mine.npz --reducer pca --cycles 90 --repeats 2 --alphas 0.5,0.1"
    " --lower-bounds 0.8 --n-jobs 1 --escape 20 --false-reject 10 --keep kept"
)


@pytest.fixture
def recordings(data, tmp_path, monkeypatch):
    np.savez(tmp_path / "mine.npz", X=data.X, y=data.y)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_verb_shows_a_table_and_writes_the_curve(recordings):
    shown = " ".join(succeed(*WORDS, "--out", "out").split())
    assert (recordings / "out" / "costs.png").stat().st_size > 10_000
    lines = (recordings / "out" / "costs.csv").read_text(encoding="utf-8").splitlines()
    result = document(*WORDS)
    assert len(result["rows"]) == len(lines) - 1
    assert result["sentence"] in shown
    assert "check all" in shown
    assert result["python"] in shown
    stricter = Policy(0.05, 0.95, audit_rate=0.2, stops="all")
    DataEngine("pca", store="cell.db", policy=stricter).close()
    succeed(*shlex.split(result["command"])[1:])  # it also sets what a new policy would have
    with DataEngine.open("cell.db", reading=True) as engine:
        assert engine.policy == eval(result["python"], {"Policy": Policy})
    # Other prices, the same replays.
    assert document(*WORDS, "--escape", "21")["costs"]["escape"] == 21
