"""Recorded streams through the same loop: exact under a seed, and counted right."""

from dataclasses import replace

import numpy as np
import pytest

from dengine import DataEngine, Dataset, Outcome, Recipe, ReplayCell, replay
from dengine.errors import SettingError
from dengine.experiments.replay import watch
from tests.support.driving import RECIPE, drive
from tests.support.replays import same

KNOWN = RECIPE.with_policy(guarantee="pooled", stops="all")


@pytest.fixture(scope="module")
def played(data):
    return replay(data, RECIPE, seed=1)


@pytest.mark.parametrize("recipe", [RECIPE.with_policy(audit_rate=0.3), KNOWN])
def test_a_seed_repeats_exactly(data, recipe):
    first, other = (replay(data, recipe, seed=1) for _ in range(2))
    assert first.accepted.sum() > 20
    same(first, other)


def test_a_stream_is_played_as_recorded_or_in_its_seeds_order(data, played):
    other = replay(data, RECIPE, seed=2)
    assert not np.array_equal(other.truth, played.truth)
    assert other.truth.sum() == played.truth.sum()
    recorded = replay(data, RECIPE, seed=2, shuffle=False)
    np.testing.assert_array_equal(recorded.truth, data.y.astype(bool))


def test_a_budget_of_wall_time_changes_nothing_in_a_replay(data, played):
    same(replay(data, replace(RECIPE, budget=1e-9), seed=1), played, "recipe")


def test_a_frame_of_a_history_has_times_with_a_zone(data):
    engine = DataEngine("pca")
    drive(engine, data, last=5)
    frame = engine.history_frame()
    assert len(frame) == 5
    assert frame["time"].dt.tz is not None


def test_fewer_cycles_are_the_beginning_of_the_same_pass_told_one_by_one(data, played):
    seen: list[int] = []
    short = replay(data, RECIPE, seed=1, cycles=90, on_cycle=seen.append)
    assert seen == list(range(1, 91))
    np.testing.assert_array_equal(short.lower, played.lower[:90])
    with pytest.raises(SettingError, match="Expected 1 to 200 cycles"):
        replay(data, RECIPE, cycles=201)


def test_a_replays_repr_shows_its_policy_whose_two_numbers_may_be_given_directly(data):
    run = replay(data, "pca", cycles=30, alpha=0.3, lower_bound=0.7)
    assert run.recipe == Recipe.load("pca").with_policy(alpha=0.3, lower_bound=0.7)
    assert "alpha 0.3, LB 70 %" in repr(run)
    with pytest.raises(SettingError, match="alpha beside an engine"):
        replay(data, DataEngine("pca"), cycles=30, alpha=0.3)


def engine() -> DataEngine:
    return DataEngine(recipe=RECIPE, seed=1, replaying=True)


def cell(data: Dataset) -> ReplayCell:
    """The parts in the order of a replay of seed 1."""
    return ReplayCell(data, np.random.default_rng(1).permutation(len(data)))


def test_a_live_run_and_a_replay_by_recipe_or_engine_keep_the_same_record(data, played):
    log = watch(engine(), cell(data), 200)
    same(log, played, "index", "dataset", "seed")
    assert played.stretches(4) == log.stretches(4)
    same(replay(data, engine(), seed=1), played)


class Silent:
    """A cell as real ones are: it tells nothing but what it is asked for."""

    def __init__(self, cell: ReplayCell) -> None:
        for name in ("insert", "verify", "proceed", "reject"):
            setattr(self, name, getattr(cell, name))


def test_what_a_cell_does_not_tell_stays_unknown(data, played):
    log = watch(engine(), Silent(cell(data)), 200)
    answer = log.verified | log.stopped
    assert 0 < answer.sum() < 200
    np.testing.assert_array_equal(log.truth[answer], played.truth[answer])
    assert np.isnan(log.truth[~answer]).all()


def test_a_replay_as_a_frame_has_a_row_a_cycle_that_adds_up_to_its_summary(played):
    frame, row = played.to_frame(), played.summary()
    accepted, rejected = frame["action"] == "accept", frame["action"] == "reject"
    assert row["accepted"] == accepted.sum()
    assert row["rejected"] == rejected.sum()
    assert row["false_positive"] == (accepted & ~frame["truth"]).sum()
    assert row["false_negative"] == (rejected & frame["truth"]).sum()
    assert row["saved_s"] == 5.0 * (frame["reason"] == "certain").sum()
    assert row["certain"] == row["accepted"] + row["rejected"] > 50
    assert frame.loc[row["first_certain"], "action"] != "verify"
    np.testing.assert_array_equal(frame[["embedding_1", "embedding_2"]], played.position)


def test_a_window_decides_in_the_models_place_where_it_is_left_and_nowhere_else(data):
    highest = data.X.max(axis=1)
    limit = np.quantile(highest, 0.8)
    tight = RECIPE.with_policy(force_limits=[f"0:1:-1e9:{limit}:reject"])
    log = replay(replace(data, rate_hz=500.0), tight, seed=1)
    out, row = highest[log.index] > limit, log.summary()
    np.testing.assert_array_equal(log.outside, out)
    assert set(log.action[out]) == {"reject"}
    assert row["outside"] == out.sum()
    assert row["certain"] == (log.action[~out] != "verify").sum() > 20
    assert row["false_negative"] == (log.truth & (log.action == "reject"))[~out].sum()


@pytest.mark.parametrize(
    ("label", "confirm", "outcome"),
    [
        (0, False, Outcome.STOPPED),
        (0, True, Outcome.STOPPED),
        (1, False, Outcome.UNKNOWN),
        (1, True, Outcome.CONFIRMED),
    ],
)
def test_after_an_accept_a_failure_stops_and_a_success_is_silent_unless_confirmed(
    data, label, confirm, outcome
):
    cell = ReplayCell(data, np.flatnonzero(data.y == label), confirm)
    cell.insert()
    assert cell.proceed() is outcome
