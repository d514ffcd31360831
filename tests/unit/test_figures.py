"""Tables and figures: what they say of replays that are known by hand."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
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
from tests.support.driving import drive
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


def test_pooled_precision_weighs_parts_not_replays_and_is_none_where_nothing_was_accepted() -> None:
    (row,) = pool(frame_of([MANY_RIGHT, ONE_WRONG]))
    assert row["precision"] == pytest.approx(
        1 - 11 / 301
    )  # the mean of the two ratios would be 0.483
    answers = [
        row[name] for name in ("npv", "accepted", "total_accepted", "replays", "retrain_max_s")
    ]
    assert answers == [0.0, 150.5, 301, 2, 0.3]
    (row,) = pool(frame_of([replay_of(["verify"] * 5, [1] * 5)]))
    assert (math.isnan(row["precision"]), row["promise_kept"]) == (True, None)
    assert promise_lines([row]) == ["pca (local): no part was accepted."]


@pytest.mark.parametrize(("bad", "kept"), [(30, True), (31, False)])
def test_the_promise_is_kept_up_to_the_tolerance(bad: int, kept: bool) -> None:
    (row,) = pool(frame_of([replay_of(["accept"] * 300, [0] * bad + [1] * (300 - bad))]))
    assert row["promise_kept"] is kept


def test_guarantees_and_what_is_known_of_stops_are_rows_of_their_own_with_the_retrains_that_were_dropped() -> (
    None
):
    pooled = replay_of(
        ["accept"] * 300, [1] * 300, recipe=RECIPE.with_policy(guarantee="pooled", stops="all")
    )
    rows = pool(frame_of(replays := [MANY_RIGHT, MANY_RIGHT, pooled]), replays)
    shown = [(row["guarantee"], row["stops"], row["retrains_dropped"]) for row in rows]
    assert shown == [("local", "some", 2), ("pooled", "all", 1)]
    table = pooled_table(rows)
    assert list(table.columns[0].cells) == ["pca\nlocal, some", "pca\npooled, all"]
    assert promise_lines(rows)[1].startswith("pca (pooled): 100.0 % of 300")


def test_window_curves_are_shares_of_what_was_decided_in_all_replays_where_that_is_enough() -> None:
    lines = window_curves(
        [replay_of(["verify", "verify", "accept", "reject"], [1, 1, 0, 1])], window=2
    )
    np.testing.assert_allclose(lines["certain"], [0, 0, 50, 100])
    np.testing.assert_allclose(lines["precision"], [np.nan, np.nan, 0, 0])
    np.testing.assert_allclose(lines["false_positive"], [np.nan, np.nan, 100, 100])
    np.testing.assert_allclose(lines["false_negative"], [np.nan, np.nan, np.nan, 100])
    lines = window_curves([MANY_RIGHT, ONE_WRONG], window=300)
    assert lines["false_positive"].iloc[-1] == pytest.approx(
        100 * 11 / 301
    )  # the mean of the two shares would be 51.7
    some = replay_of(["accept"] * 4 + ["verify"] * 4, [0] + [1] * 7)
    assert np.isfinite(window_curves([some], window=4, fewest=3)["precision"]).tolist() == [
        0,
        0,
        1,
        1,
        1,
        0,
        0,
        0,
    ]


def test_an_axis_that_is_a_probability_says_so_and_the_other_is_the_cycle() -> None:
    left = embedding_map(
        replay_of(["accept"] * 50, [1] * 50, recipe=Recipe("conv", radius=0.05))
    ).axes[0]
    assert left.get_xlabel() == "predicted probability of success"
    assert left.get_ylabel() == "cycle"
    ends = [line.get_xdata()[0] for line in left.lines if len(set(line.get_xdata())) == 1]
    assert ends[1] - ends[0] == pytest.approx(0.1)  # twice the radius
    legend = left.figure.legends[0].get_texts()[0].get_text()
    assert legend == "newest part; its neighbourhood ends at the black line, radius 0.05"
    asked = (
        "rocket",
        ConvReducer(),
        "dengine.reducers.conv:ConvReducer",
        PCA(2),
        "sklearn.decomposition:PCA",
    )
    assert [has_own_unit(reducer) for reducer in asked] == [True, True, True, False, False]


def log_of(clock_s: np.ndarray | None) -> Replay:
    truth = [1.0] * 59 + [0.0] + [1.0] * 29 + [0.0] + [0.0] * 9 + [1.0]
    action = ["verify"] * 60 + ["accept"] * 30 + ["reject"] * 10
    return by_hand(action, truth, stopped=np.arange(100) == 89, clock_s=clock_s)


def test_a_run_is_summed_up_by_stretches_that_add_up_and_by_an_hour_where_there_is_a_clock() -> (
    None
):
    log = log_of(np.cumsum(np.full(100, 36.0)))
    total, parts = log.stretch(), log.stretches(7)
    for name in ("verified", "accepted", "rejected", "false_positive", "false_negative", "stops"):
        assert total[name] == sum(part[name] for part in parts)
    assert (total["false_positive"], total["false_negative"], total["stops"]) == (1, 1, 1)
    assert total["parts_per_hour"] == pytest.approx(
        88.0
    )  # 59 verified good and 29 accepted good in an hour
    assert log_of(None).stretch()["parts_per_hour"] is None


def blank() -> Replay:
    """No model embedded anything."""
    replay = replay_of(["verify"] * 5, [1] * 5)
    replay.position[:] = np.nan
    return replay


PICTURES: dict[str, Callable[[], Figure]] = {
    "curves": lambda: curves({"pca": [MANY_RIGHT], "conv": [ONE_WRONG]}, "a title"),
    "curves of nothing": lambda: curves({"pca": [blank()]}),
    "map": lambda: embedding_map(ONE_WRONG, title="a title"),
    "map of nothing": lambda: embedding_map(blank()),
    "curves of a grid": lambda: curves(
        {f"pca, alpha 0.1, LB {i} %": [MANY_RIGHT] for i in range(20)}
    ),
    "run": lambda: curves({"this run": [log_of(None)]}, "a title"),
}


@pytest.mark.parametrize("name", PICTURES)
def test_every_figure_is_written_as_a_png_without_pyplot_and_no_legend_lies_on_its_data(
    name: str, tmp_path: Path
) -> None:
    figure = PICTURES[name]()
    assert (
        save(figure, tmp_path / "deep" / "figure.png", dpi=40).read_bytes().startswith(b"\x89PNG")
    )
    figure.draw_without_rendering()
    legends = [ax.get_legend() for ax in figure.axes if ax.get_legend()] + figure.legends
    assert legends
    for legend in legends:
        box = legend.get_window_extent()
        assert [box.overlaps(axes.get_window_extent()) for axes in figure.axes] == [False] * len(
            figure.axes
        )
        assert box.x1 <= max(
            axes.get_window_extent().x1 for axes in figure.axes
        )  # or the axes would have to shrink


@pytest.mark.parametrize(
    ("rate_hz", "x_label", "end"), [(None, "sample", 99.0), (50.0, "time [s]", 1.98)]
)
def test_the_axis_of_an_unknown_rate_is_in_samples_and_no_unit_is_made_up(
    data: Dataset, rate_hz: float | None, x_label: str, end: float
) -> None:
    shown = replace(data, rate_hz=rate_hz)
    with DataEngine(recipe=RECIPE, trace=shown.spec) as engine:
        drive(engine, shown, 0, 30)
        explained = explained_picture(engine.explain(engine.decide(shown.X[0] + 50.0).id))
    for figure in (data_picture(shown, "x"), explained):
        axes = figure.axes[0]
        assert (axes.get_xlabel(), axes.get_ylabel()) == (x_label, "trace")
        assert axes.lines[0].get_xdata()[-1] == end


def test_every_channel_is_drawn_in_its_own_unit(data: Dataset) -> None:
    both = np.stack([data.X, data.X[::-1]], axis=1)
    named = Dataset(both, data.y, unit="kN, mm", channels=("FZ", "SZ"))
    assert [axes.get_ylabel() for axes in data_picture(named, "x").axes[:2]] == [
        "FZ [kN]",
        "SZ [mm]",
    ]
    with DataEngine(recipe=RECIPE, trace=named.spec) as engine:
        explained = explained_picture(engine.explain(engine.decide(both[0]).id))
    labels = [axes.get_ylabel() for axes in explained.axes]
    assert [label for label in labels if "[" in label][:2] == ["FZ [kN]", "SZ [mm]"]
