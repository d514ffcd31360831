"""What a part costs under each policy: sums by hand, the choice, what it says, its picture and its
verb.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dengine import Dataset, Policy, Recipe
from dengine.errors import SettingError
from dengine.experiments.costs import CostCurve, cost_curve, cost_per_part, curve_of
from dengine.experiments.figures import cost_picture
from dengine.experiments.metrics import Costs
from dengine.experiments.replay import Replay, replay
from tests.support.command_line import dengine, document, succeed
from tests.support.replays import replay_of

COSTS = Costs(check=5, escape=100, false_reject=20)
STRICT, LAX = Policy(0.05, 0.95), Policy(0.5, 0.8)
RECIPE = Recipe.load("pca").with_policy(stops="all")
HOW = {"recipe": RECIPE, "alphas": (0.5,), "lower_bounds": (0.8, 0.95), "repeats": 4, "cycles": 120}


def played(
    policy: Policy,
    seed: int,
    verified: int,
    accepted: int,
    bad: int,
    rejected: int = 0,
    good: int = 0,
) -> Replay:
    """A replay with so many decisions of each kind, in that order, of which so many are wrong."""
    action = ["verify"] * verified + ["accept"] * accepted + ["reject"] * rejected
    truth = np.ones(len(action), dtype=bool)
    truth[verified : verified + bad] = False
    truth[verified + accepted + good :] = False
    index = np.random.default_rng(seed).permutation(len(action))
    return replay_of(action, truth, index=index, recipe=Recipe("pca", policy=policy), seed=seed)


def curve(
    lax: Sequence[tuple[int, int]], strict: Sequence[tuple[int, int]] = ((100, 0),) * 4
) -> CostCurve:
    """Of two policies; for each shuffle of 100 parts, how many were verified, and how many of the
    others were bad.
    """
    replays = [
        played(policy, seed, verified, 100 - verified, bad)
        for policy, item in ((LAX, lax), (STRICT, strict))
        for seed, (verified, bad) in enumerate(item)
    ]
    return curve_of(replays, COSTS)


def test_a_parts_cost_is_checks_and_errors_over_all_parts() -> None:
    first = played(LAX, 0, verified=60, accepted=25, bad=2, rejected=15, good=3)
    assert cost_per_part(first, COSTS) == pytest.approx((60 * 5 + 2 * 100 + 3 * 20) / 100)
    assert cost_per_part(first, COSTS, slice(60, 85)) == pytest.approx(2 * 100 / 25)


def test_a_part_that_an_operators_limits_reject_was_not_checked_and_pays_for_no_policy() -> None:
    reason = np.array(["certain"] * 80 + ["outside"] * 20)
    replays = [
        replace(played(policy, seed, 60, 15, 0, rejected=25), reason=reason)
        for policy in (LAX, STRICT)
        for seed in range(4)
    ]
    for row in curve_of(replays, COSTS).rows:
        assert (row.verified, row.certain) == pytest.approx((0.6, 0.2))
        assert row.cost == pytest.approx(5 * 0.8)


def test_one_half_of_the_shuffles_chooses_and_the_other_reports() -> None:
    result = curve(
        lax=[(50, 0), (50, 0), (50, 1), (60, 1)], strict=[(90, 0), (80, 0), (70, 0), (70, 0)]
    )
    lax, strict = result.rows
    assert (result.choosing, result.reporting) == (2, 2)
    assert (lax.expected_cost, lax.cost) == (pytest.approx(2.5 + 50 * 0.5 / 51), (3.5 + 4.0) / 2)
    assert curve(lax=[(50, 0)] * 4, strict=[(50, 0)] * 4).policy == STRICT  # of equal ones
    assert (strict.expected_cost, strict.cost) == (pytest.approx(4.25 + 15 * 0.5 / 16), 3.5)
    assert result.policy == LAX  # cheaper where it was chosen, though not where it is reported
    assert f"{lax.cost:.3g} a part" in result.sentence


def test_the_interval_moves_the_errors_to_their_ends_and_is_wider_than_the_luck_of_the_order() -> (
    None
):
    (row, _) = curve(lax=[(50, 0), (50, 0), (50, 1), (50, 0)]).rows
    assert row.lower < row.cost < row.upper
    assert row.upper == pytest.approx(5 * 0.5 + 100 * 0.5 * row.bad.upper)
    assert (row.bad.decided, row.bad.wrong, row.verified, row.certain) == (100, 1, 0.5, 0.5)


def test_a_policy_pays_only_where_its_whole_interval_is_below_verifying_everything() -> None:
    clear = [played(LAX, seed, 100, 2900, 10) for seed in range(4)]
    assert curve_of(clear, COSTS).verdict == "pays"
    doubtful = curve(lax=[(50, 0)] * 4)
    assert doubtful.verdict == "may pay"
    assert doubtful.policy == LAX
    assert "may be bad, and accepting pays up to 5 %" in doubtful.sentence


@pytest.mark.parametrize(
    "lax",
    [[(50, 5)] * 4, [(50, 0), (50, 0), (50, 5), (50, 5)]],
    ids=["never cheaper", "cheaper only where chosen"],
)
def test_where_nothing_pays_it_says_so_and_names_no_policy(lax: list[tuple[int, int]]) -> None:
    result = curve(lax)
    assert (result.verdict, result.policy) == ("does not pay", None)
    assert result.sentence.startswith("Nothing pays: verifying everything costs 5 a part")
    assert not result.to_frame()["chosen"].any()
    assert "everything was verified. Record more." in curve(lax=[(100, 0)] * 4).sentence


def test_a_few_accepts_without_an_error_do_not_look_free_where_an_error_is_dear() -> None:
    replays = [played(policy, seed, 99, 1, 0) for policy in (LAX, STRICT) for seed in range(4)]
    dear, cheap = (
        curve_of(replays, Costs(check=5, escape=escape, false_reject=20)) for escape in (25, 15)
    )
    assert dear.cheapest.cost == cheap.cheapest.cost == 4.95
    assert (dear.verdict, cheap.verdict) == ("does not pay", "may pay")
    assert "is expected to cost 5.01 and cost 4.95 in other shuffles" in dear.sentence


def test_a_shuffle_that_not_every_policy_has_played_is_left_out() -> None:
    result = curve(lax=[(50, 0), (50, 0), (0, 50)], strict=[(100, 0)] * 2)
    assert (result.choosing, result.reporting, result.rows[0].cost) == (1, 1, 2.5)
    with pytest.raises(SettingError, match="2 or more shuffles"):
        curve(lax=[(50, 0)], strict=[(100, 0)])


@pytest.fixture(scope="module")
def found(make_data: Callable[..., Dataset]) -> CostCurve:
    return cost_curve(make_data(160), check=5, escape=20, false_reject=11, **HOW)


def test_the_curve_is_that_of_replays_under_the_recipes_other_settings(
    found: CostCurve, make_data
) -> None:
    asked = RECIPE.with_policy(alpha=0.5, lower_bound=0.8)
    again = [replay(make_data(160), asked, seed, 120) for seed in (2, 3)]
    assert (found.rows[0].policy, asked.policy.stops) == (asked.policy, "all")
    assert found.rows[0].cost == pytest.approx(
        np.mean([cost_per_part(first, found.costs) for first in again])
    )
    by_cost = found.rows[-1]
    assert (by_cost.policy.guarantee, by_cost.policy.prices) == ("cost", (5.0, 20.0, 11.0))
    assert (found.cycles, found.choosing, found.reporting, found.dataset) == (
        120,
        2,
        2,
        "insertion-like",
    )


def test_the_picture_names_what_it_shows_and_in_which_unit(found: CostCurve) -> None:
    figure = cost_picture(found, unit="EUR")
    top, bottom = figure.axes
    assert top.get_ylabel() == "cost a part [EUR]"
    assert [text.get_text() for text in bottom.get_xticklabels()] == ["80", "95", "by cost"]
    labels = [text.get_text() for text in top.get_legend().get_texts()]
    assert "verify everything" in labels
    assert "alpha 0.5" in labels
    assert any(label.startswith("the choice: ") for label in labels) == (found.policy is not None)
    assert "check 5 EUR, escape 20 EUR, false reject 11 EUR" in figure.get_suptitle()


def test_the_verb_shows_a_table_and_writes_the_curve(
    data: Dataset, tmp_path: Path, monkeypatch
) -> None:
    np.savez(tmp_path / "mine.npz", X=data.X, y=data.y)
    monkeypatch.chdir(tmp_path)
    words = "costs --data mine.npz --reducer pca --cycles 90 --repeats 2 --alphas 0.5,0.1 --lower-bounds 0.8 --n-jobs 1"
    words += " --escape 20 --false-reject 10 --keep kept"
    shown = succeed(*words.split(), "--out", "out")
    assert "what a part costs, in s, by alpha and LB" in " ".join(shown.split())
    assert max(map(len, shown.splitlines())) <= 80
    assert (tmp_path / "out" / "costs.png").stat().st_size > 10_000
    assert (tmp_path / "out" / "costs.csv").read_text(encoding="utf-8").count("\n") == 3
    result = document(*words.split())
    assert result["verdict"] in ("pays", "may pay", "does not pay")
    assert [row["alpha"] for row in result["rows"]] == [0.5, 0.1]
    assert result["sentence"] in " ".join(shown.split())
    assert len(list((tmp_path / "kept").iterdir())) == 4  # played once
    assert "by cost" in succeed(*words.replace("reject 10", "reject 11").split(), "--stops", "all")
    assert "but a list is tried here: use --alphas" in " ".join(
        dengine(*words.split(), "--alpha", "0.1").output.split()
    )
