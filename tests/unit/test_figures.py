"""Tables and figures: what they say of replays that are known by hand."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from sklearn.decomposition import PCA

from dengine import ConvReducer, DataEngine, Dataset, Policy, Recipe, RetrainReport
from dengine.experiments.figures import (
    curves,
    data_picture,
    embedding_map,
    explained_picture,
    save,
    window_curves,
)
from dengine.experiments.replay import Replay
from dengine.experiments.tables import frame_of, pool, pooled_table, promise_lines
from dengine.reducers import has_own_unit
from tests.support.replays import replay_of as by_hand

RECIPE = Recipe("pca", policy=Policy(alpha=0.1, lower_bound=0.9))


RETRAINS = tuple(
    RetrainReport(i, seconds, 50, 0, seconds > 0.2, "") for i, seconds in enumerate((0.1, 0.3))
)


def replay_of(
    action: list[str], truth: list[int], recipe: Recipe = RECIPE, **fields: Any
) -> Replay:
    good = np.array(truth, dtype=bool)
    stopped = (np.array(action) == "accept") & ~good
    return by_hand(
        action, good, recipe=recipe, name=recipe.name, stopped=stopped, retrains=RETRAINS, **fields
    )


MANY_RIGHT = replay_of(["accept"] * 300, [1] * 290 + [0] * 10)
ONE_WRONG = replay_of(["accept"] + ["verify"] * 298 + ["reject"], [0] + [1] * 299, seed=1)


def pooled(replays: list[Replay]) -> list[dict[str, Any]]:
    return pool(frame_of(replays), replays)


def test_pooled_precision_weighs_parts_not_replays_and_is_none_where_nothing_was_accepted():
    (row,) = pooled([MANY_RIGHT, ONE_WRONG])
    assert row["precision"] == pytest.approx(1 - 11 / 301)  # not the mean of the ratios, 0.483
    assert (row["npv"], row["accepted"], row["total_accepted"]) == (0.0, 150.5, 301)
    (row,) = pooled([replay_of(["verify"] * 5, [1] * 5)])
    assert (math.isnan(row["precision"]), row["promise_kept"]) == (True, None)
    assert promise_lines([row]) == ["pca (local): no part was accepted."]


@pytest.mark.parametrize(("bad", "kept"), [(30, True), (31, False)])
def test_the_promise_is_kept_up_to_the_tolerance(bad, kept):
    (row,) = pooled([replay_of(["accept"] * 300, [0] * bad + [1] * (300 - bad))])
    assert row["promise_kept"] is kept


def test_guarantees_and_what_is_known_of_stops_are_rows_of_their_own():
    recipe = RECIPE.with_policy(guarantee="pooled", stops="all")
    rows = pooled([MANY_RIGHT, MANY_RIGHT, replay_of(["accept"] * 300, [1] * 300, recipe)])
    shown = [(row["guarantee"], row["stops"], row["retrains_dropped"]) for row in rows]
    assert shown == [("local", "some", 2), ("pooled", "all", 1)]
    assert list(pooled_table(rows, "", "").columns[0].cells) == [
        "pca\nlocal, some",
        "pca\npooled, all",
    ]


def test_window_curves_are_shares_of_what_was_decided_in_all_replays():
    nan = np.nan
    lines = window_curves(
        [replay_of(["verify", "verify", "accept", "reject"], [1, 1, 0, 1])], window=2
    )
    np.testing.assert_allclose(lines["certain"], [0, 0, 50, 100])
    np.testing.assert_allclose(lines["precision"], [nan, nan, 0, 0])
    np.testing.assert_allclose(lines["false_negative"], [nan, nan, nan, 100])
    lines = window_curves([MANY_RIGHT, ONE_WRONG], window=300)
    assert lines["false_positive"].iloc[-1] == pytest.approx(100 * 11 / 301)  # not the mean, 51.7


@pytest.mark.parametrize(
    ("reducer", "expected"),
    [
        ("rocket", True),
        (ConvReducer(), True),
        (PCA(2), False),
        ("sklearn.decomposition:PCA", False),
    ],
)
def test_a_reducer_that_says_probabilities_has_a_unit_of_its_own(reducer, expected):
    assert has_own_unit(reducer) is expected


ACTIONS = ["verify"] * 60 + ["accept"] * 30 + ["reject"] * 10
TRUTH = [1.0] * 59 + [0.0] + [1.0] * 29 + [0.0] * 10 + [1.0]
LOG = by_hand(ACTIONS, TRUTH, stopped=np.arange(100) == 89)


def test_a_run_is_summed_up_by_stretches_that_add_up():
    total, parts = LOG.stretch(), LOG.stretches(7)
    for name in ("verified", "accepted", "rejected", "false_positive", "false_negative", "stops"):
        assert total[name] == sum(part[name] for part in parts)
    assert (total["false_positive"], total["false_negative"], total["stops"]) == (1, 1, 1)


UNTRAINED = replay_of(["verify"] * 5, [1] * 5, position=np.full((5, 2), np.nan))
PICTURES: dict[str, Callable[[], Figure]] = {
    "curves": lambda: curves({"pca": [MANY_RIGHT], "conv": [ONE_WRONG]}, "a title"),
    "map": lambda: embedding_map(ONE_WRONG, title="a title"),
    "map of nothing": lambda: embedding_map(UNTRAINED),
    "map of probabilities": lambda: embedding_map(replace(ONE_WRONG, recipe=Recipe("conv"))),
    "curves of a grid": lambda: curves({f"pca, LB {i} %": [UNTRAINED] for i in range(20)}),
    "run": lambda: curves({"this run": [LOG]}, "a title"),
}


@pytest.mark.parametrize("name", PICTURES)
def test_every_figure_is_written_as_a_png_and_no_legend_lies_on_its_data(name, tmp_path):
    figure = PICTURES[name]()
    path = save(figure, tmp_path / "deep" / "figure.png", dpi=40)
    assert path.read_bytes().startswith(b"\x89PNG")
    legends = [ax.get_legend() for ax in figure.axes if ax.get_legend()] + figure.legends
    assert legends
    for legend in legends:
        box = legend.get_window_extent()
        assert not any(box.overlaps(axes.get_window_extent()) for axes in figure.axes)


@pytest.mark.parametrize(("rate_hz", "end"), [(None, 99.0), (50.0, 1.98)])  # samples, seconds
def test_every_channel_is_drawn_in_its_own_unit_over_time_or_samples(data, rate_hz, end):
    both = np.stack([data.X, data.X[::-1]], axis=1)
    named = Dataset(both, data.y, rate_hz=rate_hz, unit="kN, mm", channels=("FZ", "SZ"))
    with DataEngine(recipe=RECIPE, trace=named.spec) as engine:
        explained = explained_picture(engine.explain(engine.decide(both[0]).id))
    for figure in (data_picture(named, "x"), explained):
        assert {"FZ [kN]", "SZ [mm]"} <= {axes.get_ylabel() for axes in figure.axes}
        assert figure.axes[0].lines[0].get_xdata()[-1] == end
