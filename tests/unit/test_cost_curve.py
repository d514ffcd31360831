"""What a part costs under each policy: sums by hand, candidates, halving, the choice, what it says,
its picture and its verb.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dengine import Dataset, Policy, Recipe
from dengine.cli.replay import _as_flags
from dengine.errors import SettingError
from dengine.experiments.costs import (
    CostCurve,
    PolicySearch,
    candidates,
    cost_curve,
    curve_of,
    needed_parts,
    part_costs,
    policy_name,
    settings_of,
)
from dengine.experiments.figures import cost_picture
from dengine.experiments.grid import Task
from dengine.experiments.metrics import Costs
from dengine.experiments.replay import Contender, Replay, replay, replay_policy
from tests.support.command_line import dengine, document, succeed
from tests.support.replays import replay_of

COSTS = Costs(check=5, escape=100, false_reject=20)
STRICT, LAX = Policy(0.05, 0.95), Policy(0.5, 0.8)
RECIPE = Recipe.load("pca").with_policy(stops="all")
PRICES = {"check": 5, "escape": 20, "false_reject": 11}


def played(
    policy: Policy,
    seed: int,
    verified: int,
    accepted: int,
    bad: int,
    rejected: int = 0,
    good: int = 0,
) -> Replay:
    """A replay with so many decisions of each kind, of which so many are wrong; the parts of each
    kind are the same in every shuffle.
    """
    action = ["verify"] * verified + ["accept"] * accepted + ["reject"] * rejected
    truth = [1] * verified + [0] * bad + [1] * (accepted - bad + good) + [0] * (rejected - good)
    return replay_of(action, truth, recipe=Recipe("pca", policy=policy), seed=seed)


def four(policy: Policy, *counts: int, **others: int) -> dict[Policy, list[Replay]]:
    """Four shuffles of the same."""
    return {policy: [played(policy, seed, *counts, **others) for seed in range(4)]}


def curve(
    lax: Sequence[tuple[int, int]], strict: Sequence[tuple[int, int]] = ((100, 0),) * 4
) -> CostCurve:
    """Of two policies; for each shuffle of 100 parts, how many were verified, and how many of the
    others were bad.
    """
    groups = {
        policy: [played(policy, seed, n, 100 - n, bad) for seed, (n, bad) in enumerate(item)]
        for policy, item in ((LAX, lax), (STRICT, strict))
    }
    return curve_of(groups, COSTS)


def test_a_parts_cost_is_its_check_or_its_wrong_decision() -> None:
    first = played(LAX, 0, verified=60, accepted=25, bad=2, rejected=15, good=3)
    costs = part_costs(first, COSTS)
    assert costs.mean() == pytest.approx((60 * 5 + 2 * 100 + 3 * 20) / 100)
    assert costs[60:85].mean() == pytest.approx(2 * 100 / 25)


def test_a_part_that_an_operators_limits_reject_was_not_checked_and_pays_for_no_policy() -> None:
    reason = np.array(["certain"] * 80 + ["outside"] * 20)
    (replays,) = four(LAX, 60, 15, 0, rejected=25).values()
    (row,) = curve_of({LAX: [replace(item, reason=reason) for item in replays]}, COSTS).rows
    assert (row.verified, row.accepted + row.rejected) == pytest.approx((0.6, 0.2))
    assert row.cost == pytest.approx(5 * 0.8)


def test_no_row_is_cheaper_than_the_marked_one_unless_a_sentence_says_that_this_is_chance() -> None:
    result = curve(lax=[(40, 0), (50, 0), (50, 0), (60, 0)], strict=[(90, 0), (80, 0)] * 2)
    assert result.marked is result.rows[0]
    assert (result.policy, result.rows[0].cost) == (LAX, 2.5)
    assert "beyond chance" not in result.sentence
    close = curve(lax=[(20, 1), (20, 0), (20, 3), (20, 0)], strict=[(45, 0)] * 4)
    assert close.rows[0].cost < close.marked.cost
    assert close.policy == STRICT
    assert "alpha 0.5, LB 80 % costs 2, which is not cheaper beyond chance" in close.sentence
    assert "lets more bad parts through: of 1,000 parts 10, not 0." in close.sentence


def test_the_interval_moves_the_errors_to_their_ends_and_adds_the_luck_of_the_order() -> None:
    row = next(row for row in curve([(50, 0), (50, 0), (50, 1), (50, 0)]).rows if row.accepted)
    assert row.lower < row.cost < row.upper
    errors = 5 * 0.5 + 100 * 0.5 * row.bad.upper - row.cost
    luck = 3.182446 * np.std([2.5, 2.5, 3.5, 2.5], ddof=1) / 2  # Student's t of 3 degrees
    assert row.upper == pytest.approx(row.cost + math.hypot(errors, luck), rel=1e-5)
    assert (row.bad.decided, row.bad.wrong, row.verified, row.accepted) == (200, 1, 0.5, 0.5)


def test_a_policy_pays_only_where_its_whole_interval_is_below_verifying_everything() -> None:
    clear = curve_of(four(LAX, 100, 2900, 10), COSTS)
    assert (clear.verdict, clear.missing) == ("pays", None)
    doubtful = curve(lax=[(50, 0)] * 4)
    assert (doubtful.verdict, doubtful.policy) == ("may pay", LAX)
    assert "may be bad, and accepting pays up to 5 %" in doubtful.sentence


def alone(
    accepted: int, verified: int = 50, stops: str = "all", bad: int = 0, rejected: int = 0
) -> CostCurve:
    """The curve of one policy, whose accepted parts are the same in each of two shuffles."""
    policy = replace(LAX, stops=stops)
    replays = [played(policy, seed, verified, accepted, bad, rejected) for seed in range(2)]
    return curve_of({policy: replays}, COSTS)


@pytest.mark.parametrize(
    "kinds",
    [{"accepted": 50}, {"accepted": 50, "bad": 1}, {"accepted": 5, "rejected": 20}],
    ids=["no error", "an error", "rejects"],
)
def test_as_many_parts_as_are_missing_turn_may_pay_into_pays(kinds: dict[str, int]) -> None:
    result = alone(**kinds)
    missing = result.missing
    scale = 1 + missing.recordings / result.cycles

    def verdict(n: int) -> str:
        return alone(verified=50 * n, **{kind: n * m for kind, m in kinds.items()}).verdict

    n = math.ceil(scale)
    assert (verdict(n), verdict(n - 1)) == ("pays", "may pay")
    assert missing.accepted == pytest.approx(kinds["accepted"] * scale, rel=0.03, abs=1)


def test_a_policy_whose_every_reject_was_wrong_has_a_verdict_and_a_sentence() -> None:
    result = curve_of(four(LAX, 74, 75, 0, rejected=1, good=1), Costs(5, 600, 30))
    assert (result.verdict, result.rows[0].good.upper) == ("may pay", 1.0)
    assert result.missing is not None
    assert "Not certainly" in result.sentence


def test_what_is_missing_is_stated_in_parts_recordings_and_production() -> None:
    result = alone(50)
    missing = result.missing
    # Wilson's end z^2 / (n + z^2) of no bad one among n parts is 5 % at n = 19 z^2, z = 2.2414.
    assert (missing.accepted, missing.seen) == (math.ceil(19 * 2.241403**2), 50)
    assert (missing.recordings, missing.production, missing.audit_rate) == (91, 191, 1.0)
    assert (
        "of the accepted parts up to 9.13 % may be bad, and accepting pays up to 5 %. To show that "
        "it pays takes about 96 different accepted parts with no bad one, and these recordings "
        "count as 50: 91 more recordings, or 191 parts of production where every bad accepted part "
        "stops the line."
    ) in result.sentence
    by_audits = alone(50, stops="some")
    assert by_audits.missing.production == 191 * 20
    assert by_audits.missing.audit_rate == 0.05
    assert "parts of production at an audit rate of 5 %" in by_audits.sentence


@pytest.mark.parametrize("lax", [[(50, 5)] * 4, [(50, 3), (50, 2)] * 2, [(100, 0)] * 4])
def test_where_nothing_pays_it_says_so_and_names_no_policy(lax: list[tuple[int, int]]) -> None:
    result = curve(lax)
    assert (result.verdict, result.policy) == ("does not pay", None)
    nothing = "Nothing pays: verifying everything costs 5 a part, and everything was verified."
    assert result.sentence == f"{nothing} Record more."
    assert not result.to_frame()["chosen"].any()


def test_a_few_accepts_without_an_error_do_not_look_free_where_an_error_is_dear() -> None:
    dear, cheap = (
        curve_of(four(LAX, 99, 1, 0), Costs(5, escape, false_reject=20)) for escape in (25, 15)
    )
    assert dear.marked.cost == cheap.marked.cost == 4.95
    assert (dear.verdict, cheap.verdict) == ("does not pay", "may pay")
    assert "or 5.01 with half an error more" in dear.sentence


def test_it_says_which_price_would_change_the_choice() -> None:
    result = curve_of(four(LAX, 200, 800, 12) | four(STRICT, 600, 400, 0), COSTS)
    assert result.policy == LAX  # 2.2, where the stricter one costs 3.0
    assert "with escape at 200, alpha 0.05, LB 95 %" in result.price_changes
    assert result.price_sentence.startswith("The choice depends on the prices: with ")
    assert not any("escape at 50," in change for change in result.price_changes)
    assert "the choice stays" in curve(lax=[(20, 0)] * 4).price_sentence


def test_needed_neighbours_are_those_of_the_interval_and_needed_members_those_of_the_bet() -> None:
    assert needed_parts(Policy(0.1, 0.9)) == 25
    assert needed_parts(Policy(0.05, 0.95)) == 73
    assert needed_parts(Policy(0.05, 0.95, interval="clopper_pearson")) == 72
    pooled = Policy(0.05, 0.95, guarantee="pooled", stops="all")
    rule, n = pooled.rule(), 0
    while rule.action(0.99, 0.99) == 0:
        rule.update(0.99, 0.99, True, 0, 1.0)
        n += 1
    assert needed_parts(pooled) == n
    assert needed_parts(Policy(prices=(5, 120, 47.5))) == 0


def test_candidates_lie_around_break_even_and_have_the_audits_that_they_need() -> None:
    costs = Costs(0.5, 200, 5)

    def tried(recipe: Any, alphas: Any = (), bounds: Any = ()) -> list[dict[str, Any]]:
        return list(candidates(Contender.load(recipe), costs, alphas, bounds))

    found = tried("pca")
    levels = [change["lower_bound"] for change in found if change["guarantee"] == "local"]
    assert levels == [0.96, 0.98, 0.99, 0.995, 0.9975, 0.9987]  # break-even is 99.75 %
    assert {change["audit_rate"] for change in found if "audit_rate" in change} == {0.05}
    assert found[-1] == {"guarantee": "cost", "prices": (0.5, 200, 5), "audit_rate": 0.05}
    assert tried(RECIPE)[-1]["audit_rate"] == 0.0
    assert tried("knn", (0.2, 0.05), (0.9,)) == [
        {"guarantee": "local", "alpha": alpha, "lower_bound": 0.9} for alpha in (0.2, 0.05)
    ]


def test_a_policy_that_the_recordings_cannot_support_is_named_with_what_it_needs(data) -> None:
    search, n_good = PolicySearch(data, "pca", Costs(0.5, 200, 0.9)), int(data.y.sum())
    needed = needed_parts(Policy(0.1, 0.9975))
    note = f"alpha 0.1, LB 99.75 % needs {needed:,} good neighbours, {n_good} good parts are played"
    assert note in search.out_of_reach
    (refused,) = [text for text in search.out_of_reach if text.startswith("guarantee cost: ")]
    assert "errors above two checks" in refused
    assert all(needed_parts(item.recipe.policy) <= n_good for item in search.remaining)


@pytest.mark.parametrize(
    ("prices", "text"),
    [
        ({"check": 5, "escape": 4}, "a check below an escape"),
        ({"check": 0}, "a check that costs something"),
        ({"check": -1}, "a finite cost of 0 or more as check"),
        ({"escape": 0}, "a check below an escape"),
        ({"false_reject": 0}, "a false reject that costs something"),
        ({"escape": "200 EUR"}, "a finite cost of 0 or more as escape, got '200 EUR'"),
        ({"repeats": 1}, "2 or more repeats"),
        ({"lower_bounds": (0.999,)}, "recordings enough for one policy"),
    ],
)
def test_prices_that_decide_nothing_are_refused_in_one_sentence(
    prices: dict[str, Any], text: str, make_data: Callable[..., Dataset]
) -> None:
    few = {"false_reject": 6} if "lower_bounds" in prices else {}  # no guarantee by cost
    with pytest.raises(SettingError, match=text) as caught:
        cost_curve(make_data(30), recipe=RECIPE, **(PRICES | few | prices))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("label", [0, 1])
def test_recordings_of_one_kind_are_refused(label: int, data: Dataset) -> None:
    one_kind = replace(data, y=np.full(len(data), label))
    with pytest.raises(SettingError, match=r"good and bad recordings, got .* good and"):
        cost_curve(one_kind, recipe="pca", **PRICES)


def cheaper_by_level(tasks: Sequence[Task]) -> list[Replay]:
    """Replays in which a stricter policy accepts less, and none is wrong."""
    return [
        played(policy, task.seed, round(100 * policy.lower_bound), 100, 0)
        for task in tasks
        for policy in [task.contender.recipe.policy]
    ]


BOUNDS = (0.6, 0.7, 0.8, 0.85, 0.88, 0.9)


def test_the_cheaper_half_plays_on_and_the_last_two_report_on_shuffles_that_chose_nothing(
    data: Dataset,
) -> None:
    rounds = []

    def play(tasks: Sequence[Task]) -> list[Replay]:
        policies = {task.contender.recipe.policy for task in tasks}
        rounds.append((len(policies), sorted({task.seed for task in tasks})))
        return cheaper_by_level(tasks)

    search = PolicySearch(data, "knn", COSTS, lower_bounds=BOUNDS, alphas=(0.2,), repeats=3, seed=7)
    search.run(play)
    assert rounds == [(6, [7, 8]), (3, [9, 10]), (2, [11, 12, 13])]
    result = search.curve()
    rows = (*result.rows, *result.left_behind)
    assert [row.policy.lower_bound for row in rows[:2]] == [0.6, 0.7]
    assert sorted(row.policy.lower_bound for row in rows[2:]) == [0.8, 0.85, 0.88, 0.9]
    assert (result.shuffles, result.fresh) == (3, True)
    frame = result.to_frame()
    assert list(frame["reported"]) == [True] * 2 + [False] * 4
    assert frame["chosen"].sum() == 1


@pytest.mark.parametrize(("n_rounds", "fresh"), [(0, None), (1, False), (2, False), (3, True)])
def test_a_search_that_is_interrupted_shows_what_was_finished(
    n_rounds: int, fresh: bool | None, data: Dataset
) -> None:
    rounds = []

    def play(tasks: Sequence[Task]) -> list[Replay]:
        rounds.append(tasks)
        return cheaper_by_level(tasks if len(rounds) <= n_rounds else tasks[:1])

    search = PolicySearch(data, "knn", COSTS, lower_bounds=BOUNDS)
    search.run(play)
    result = search.curve()
    assert len(rounds) == min(3, n_rounds + 1)
    assert (result and result.fresh) is fresh
    assert not result or ("these shuffles also chose the policy" in result.sentence) != fresh


@pytest.mark.parametrize(
    "changes",
    [
        {"guarantee": "local", "alpha": 0.5, "lower_bound": 0.8},
        {"guarantee": "pooled", "lower_bound": 0.7},
        {"prices": (5, 20, 11), "audit_rate": 0.0},
    ],
)
def test_a_policy_on_shared_scores_decides_like_a_replay_until_a_part_is_rejected(
    changes: dict[str, Any], make_data: Callable[..., Dataset]
) -> None:
    data, recipe = make_data(110), Recipe("rocket", {"kernels": 6, "width": 8}, retrain_every=40)
    policy = Policy(stops="all").changed(**changes)
    shadow, whole = (replace(recipe, policy=item) for item in (Policy(shadow=True), policy))
    shared, alone_ = replay_policy(replay(data, shadow, 3), policy), replay(data, whole, 3)
    first = int(np.argmax(np.append(alone_.action == "reject", True)))
    assert (alone_.action[:first] != "verify").any()
    np.testing.assert_array_equal(shared.action[: first + 1], alone_.action[: first + 1])
    assert shared.recipe.policy == policy


def test_the_curve_is_that_of_replays_under_the_recipes_other_settings(make_data) -> None:
    data = make_data(120)
    found = cost_curve(
        data, recipe=RECIPE, alphas=(0.5,), lower_bounds=(0.8,), cycles=90, repeats=2, **PRICES
    )
    seeds = (2, 3)  # the first two shuffles chose
    for row in found.rows:
        again = [replay(data, replace(RECIPE, policy=row.policy), seed, 90) for seed in seeds]
        assert row.policy.stops == "all"
        assert row.cost == pytest.approx(np.mean([part_costs(r, found.costs) for r in again]))
    assert (found.cycles, found.shuffles, found.dataset) == (90, 2, "insertion-like")
    kinds = {row.policy.guarantee for row in (*found.rows, *found.left_behind)}
    assert kinds == {"local", "pooled", "cost"}


@pytest.mark.parametrize(
    "policy",
    [
        Policy(0.1, 0.9917),
        Policy(0.1, 0.98, stops="all", guarantee="pooled", audit_rate=0.02),
        Policy(prices=(0.5, 200, 5)),
        Policy(prices=(0.5, 200, 5), audit_rate=0.0, stops="all"),
    ],
    ids=policy_name,
)
def test_the_lines_that_are_shown_set_the_policy(policy: Policy) -> None:
    settings = settings_of(policy)
    assert Policy(**settings) == policy
    words = _as_flags(settings)
    assert ("--prices 0.5,200,5" in words) == (policy.guarantee == "cost")
    assert ("--audit-rate" in words) == ("audit_rate" in settings)


def test_the_picture_names_every_policy_and_marks_what_leaves_its_axes() -> None:
    lucky = replace(alone(50).marked, upper=80.0)
    result = replace(curve(lax=[(50, 0)] * 4), left_behind=(lucky,))
    left, rows = cost_picture(result, unit="EUR").axes[0], (*result.rows, lucky)
    assert left.get_xlabel() == "cost a part [EUR]"
    names = [text.get_text() for text in left.get_yticklabels()]
    assert names == [policy_name(row.policy) for row in rows]
    end = left.get_xlim()[1]
    cut = [f"to {row.upper:.3g} \u2192" for row in rows if row.upper > end]
    assert [text.get_text() for text in left.texts] == cut
    assert "to 80 \u2192" in cut


WORDS = [
    "costs",
    "--data",
    "mine.npz",
    "--reducer",
    "pca",
    "--cycles",
    "90",
    "--repeats",
    "2",
    "--alphas",
    "0.5,0.1",
    "--lower-bounds",
    "0.8",
    "--n-jobs",
    "1",
    "--escape",
    "20",
    "--false-reject",
    "10",
    "--keep",
    "kept",
]


@pytest.fixture
def recordings(data: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    np.savez(tmp_path / "mine.npz", X=data.X, y=data.y)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_verb_shows_a_table_and_writes_the_curve(recordings: Path) -> None:
    shown = succeed(*WORDS, "--out", "out")
    assert (recordings / "out" / "costs.png").stat().st_size > 10_000
    n_rows = (recordings / "out" / "costs.csv").read_text(encoding="utf-8").count("\n") - 1
    result, text = document(*WORDS), " ".join(shown.split())
    assert len(result["rows"]) == n_rows
    for words in ("what a part costs, in s", "check all", result["sentence"], "Not tried: "):
        assert words in text
    if result["policy"]:
        assert result["python"] in text
        assert result["command"].startswith("dengine policy cell.db --")
    again = document(*WORDS, "--escape", "21")  # other prices, the same replays
    assert again["costs"]["escape"] == 21


def test_the_verb_names_a_price_that_is_no_number(recordings: Path) -> None:
    result = dengine(*WORDS, "--check", "0.5 EUR")
    assert result.exit_code == 2
    assert "'0.5 EUR' is not a valid float" in " ".join(result.output.split())
    refused = " ".join(dengine(*WORDS, "--alpha", "0.1").output.split())
    assert "but a list is tried here: use --alphas" in refused
