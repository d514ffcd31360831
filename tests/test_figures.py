"""Tables and figures: what they say of replays that are known by hand."""

import math

import numpy as np
import pytest

from dengine import Policy, Recipe
from dengine.experiments.figures import curves, embedding_map, run_picture, save, sliding_sum, window_curves
from dengine.experiments.live import RunLog
from dengine.experiments.replay import Replay
from dengine.experiments.tables import frame_of, pool, pooled_table, promise_kept, promise_line, write_csv

RECIPE = Recipe("pca", policy=Policy(alpha=0.1, lower_bound=0.9))


def replay_of(action: list[str], truth: list[int], seed: int = 0) -> Replay:
    n, zeros = len(action), np.zeros(len(action), dtype=np.int64)
    return Replay(
        recipe=RECIPE,
        dataset="by hand",
        seed=seed,
        action=np.array(action),
        truth=np.array(truth, dtype=bool),
        lower=np.zeros(n),
        upper=np.ones(n),
        n_success=zeros,
        n_failure=zeros,
        position=np.random.default_rng(seed).normal(size=(n, 2)),
        decide_seconds=np.full(n, 1e-4),
        retrain_seconds=np.array([0.1, 0.3]),
    )


MANY_RIGHT = replay_of(["accept"] * 300, [1] * 290 + [0] * 10)
ONE_WRONG = replay_of(["accept"] + ["verify"] * 298 + ["reject"], [0] + [1] * 299, seed=1)


def test_pooled_precision_weighs_parts_not_replays() -> None:
    (row,) = pool(frame_of([MANY_RIGHT, ONE_WRONG]))
    assert row["precision"] == pytest.approx(1 - 11 / 301)  # the mean of the two ratios would be 0.483
    assert row["npv"] == 0.0
    assert (row["accepted"], row["total_accepted"], row["replays"]) == (150.5, 301, 2)
    assert row["retrain_max_s"] == 0.3


def test_nothing_accepted_has_no_precision_and_no_verdict() -> None:
    (row,) = pool(frame_of([replay_of(["verify"] * 5, [1] * 5)]))
    assert math.isnan(row["precision"])
    assert promise_kept(row) is None
    assert "too few to say" in promise_line(row)


@pytest.mark.parametrize(("bad", "kept"), [(30, True), (31, False)])
def test_the_promise_is_kept_up_to_the_tolerance(bad: int, kept: bool) -> None:
    (row,) = pool(frame_of([replay_of(["accept"] * 300, [0] * bad + [1] * (300 - bad))]))
    assert promise_kept(row) is kept


def test_names_keep_recipes_of_one_reducer_apart() -> None:
    rows = pool(frame_of([MANY_RIGHT, ONE_WRONG], ["mine", "yours"]))
    assert [row["recipe"] for row in rows] == ["mine", "yours"]


def test_the_table_says_which_promise_it_shows() -> None:
    table = pooled_table(pool(frame_of([MANY_RIGHT])))
    assert "pooled" in str(table.caption)
    assert table.row_count == 1


def test_the_csv_has_a_row_a_replay(tmp_path) -> None:
    path = write_csv(frame_of([MANY_RIGHT, ONE_WRONG]), tmp_path / "deep" / "replays.csv")
    header, *rows = path.read_text().splitlines()
    assert header.startswith("recipe,interval,alpha,lower_bound,seed")
    assert len(rows) == 2


@pytest.mark.parametrize("window", [1, 3, 10, 50])
def test_a_sliding_sum_equals_the_sum_of_each_window(window: int) -> None:
    values = np.random.default_rng(0).random((2, 20))
    expected = [[row[max(0, i - window + 1) : i + 1].sum() for i in range(20)] for row in values]
    np.testing.assert_allclose(sliding_sum(values, window), expected)


def test_window_curves_are_percentages_of_the_cycles_in_the_window() -> None:
    lines = window_curves([replay_of(["verify", "verify", "accept", "reject"], [1, 1, 0, 1])], window=2)
    np.testing.assert_allclose(lines["certain"], [0, 0, 50, 100])
    np.testing.assert_allclose(lines["false_positive"], [0, 0, 50, 50])
    np.testing.assert_allclose(lines["false_negative"], [0, 0, 0, 50])
    np.testing.assert_allclose(lines["precision"], [np.nan, np.nan, 0, 0])


def test_the_curves_draw_the_lower_bound_and_the_tolerance() -> None:
    top, bottom = curves({"a": [MANY_RIGHT], "b": [ONE_WRONG]}).axes
    assert any(np.allclose(line.get_ydata(), 90.0) and line.get_linestyle() == ":" for line in top.lines)
    assert any(np.allclose(line.get_ydata(), 10.0) and line.get_linestyle() == ":" for line in bottom.lines)
    assert {"a: certain, of all cycles", "b: certain, of all cycles"} <= {line.get_label() for line in top.lines}


def log_of(clock_s: np.ndarray | None) -> RunLog:
    action = np.array(["verify"] * 60 + ["accept"] * 30 + ["reject"] * 10)
    truth = np.array([1.0] * 59 + [0.0] + [1.0] * 29 + [0.0] + [0.0] * 9 + [1.0])
    return RunLog(action, truth, np.arange(100) == 89, clock_s, ())


def test_a_run_is_summed_up_by_stretches_that_add_up() -> None:
    log = log_of(np.cumsum(np.full(100, 36.0)))
    total, parts = log.summary(), log.stretches(7)
    for name in ("verified", "accepted", "rejected", "false_positive", "false_negative", "stops"):
        assert total[name] == sum(part[name] for part in parts)
    assert (total["false_positive"], total["false_negative"], total["stops"]) == (1, 1, 1)
    assert total["parts_per_hour"] == pytest.approx(88.0)  # 59 verified good and 29 accepted good in an hour


def test_a_cell_without_a_clock_has_no_rate_and_one_panel_less() -> None:
    log = log_of(None)
    assert log.summary()["parts_per_hour"] is None
    assert len(run_picture(log).axes) == 2
    assert len(run_picture(log_of(np.arange(1.0, 101.0))).axes) == 3


def test_a_run_that_verified_every_part_lies_on_its_own_baseline() -> None:
    log = RunLog(np.array(["verify"] * 50), np.ones(50), np.zeros(50, dtype=bool), 52.0 * np.arange(1, 51), ())
    run, baseline = run_picture(log).axes[2].lines
    np.testing.assert_allclose(run.get_ydata(), baseline.get_ydata())


def test_every_figure_is_written_as_a_png_without_pyplot(tmp_path) -> None:
    blank = replay_of(["verify"] * 5, [1] * 5)
    blank.position[:] = np.nan  # no model embedded anything
    figures = [curves({"pca": [blank]}), embedding_map(ONE_WRONG), embedding_map(blank), run_picture(log_of(None))]
    for i, figure in enumerate(figures):
        path = save(figure, tmp_path / f"{i}.png", dpi=40)
        assert path.read_bytes().startswith(b"\x89PNG")
