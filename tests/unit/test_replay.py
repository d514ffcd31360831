"""Recorded streams through the same loop: exact under a seed, and counted right."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.decomposition import PCA

from dengine import DataEngine, Dataset, Outcome, Recipe, Replay, ReplayCell, replay
from dengine.errors import SettingError
from dengine.experiments.replay import Contender, watch
from tests.support.driving import RECIPE
from tests.support.replays import same

KNOWN = RECIPE.with_policy(guarantee="pooled", stops="all")


@pytest.fixture(scope="module")
def played(data: Dataset) -> Replay:
    return replay(data, RECIPE, seed=1)


@pytest.mark.parametrize(
    "recipe", [RECIPE, RECIPE.with_policy(audit_rate=0.3), KNOWN], ids=["plain", "audited", "known"]
)
def test_a_seed_repeats_exactly(data: Dataset, recipe: Recipe) -> None:
    first, other = (replay(data, recipe, seed=1) for _ in range(2))
    assert first.accepted.sum() > 20
    same(first, other)


def test_a_budget_of_wall_time_changes_nothing_in_a_replay(data: Dataset, played: Replay) -> None:
    same(replay(data, replace(RECIPE, budget=1e-9), seed=1), played, "recipe")


def test_a_stream_is_played_as_recorded_or_in_its_seeds_order(
    data: Dataset, played: Replay
) -> None:
    other = replay(data, RECIPE, seed=2)
    assert not np.array_equal(other.truth, played.truth)
    assert other.truth.sum() == played.truth.sum()
    for seed in (0, 1):
        np.testing.assert_array_equal(
            replay(data, RECIPE, seed, shuffle=False).truth, data.y.astype(bool)
        )


def test_fewer_cycles_are_the_beginning_of_the_same_pass_told_one_by_one(
    data: Dataset, played: Replay
) -> None:
    seen: list[int] = []
    short = replay(data, RECIPE, seed=1, cycles=90, on_cycle=seen.append)
    assert seen == list(range(1, 91))
    np.testing.assert_array_equal(short.action, played.action[:90])
    np.testing.assert_array_equal(short.lower, played.lower[:90])
    for cycles in (0, 201):
        with pytest.raises(SettingError, match="Expected 1 to 200 cycles"):
            replay(data, RECIPE, cycles=cycles)


def test_a_replays_repr_shows_its_policy_whose_two_numbers_may_be_given_directly(
    data: Dataset,
) -> None:
    plain = replay(data, "pca", cycles=30)
    assert "alpha 0.05, LB 95 %, local" in repr(plain)
    run = replay(data, "pca", cycles=30, alpha=0.3, lower_bound=0.7)
    same(run, replay(data, Recipe.load("pca").with_policy(alpha=0.3, lower_bound=0.7), cycles=30))
    assert "alpha 0.3, LB 70 %" in repr(run)
    assert "alpha 0.3, LB 95 %" in repr(replay(data, "knn", cycles=30, alpha=0.3))
    with pytest.raises(SettingError, match="alpha beside an engine"):
        replay(data, DataEngine("pca"), cycles=30, alpha=0.3)


class Silent:
    """A cell as real ones are: it tells nothing but what it is asked for."""

    def __init__(self, cell: ReplayCell) -> None:
        self.insert, self.verify, self.proceed, self.reject = (
            cell.insert,
            cell.verify,
            cell.proceed,
            cell.reject,
        )


def test_a_live_run_and_a_replay_by_recipe_or_engine_keep_the_same_record(
    data: Dataset, played: Replay
) -> None:
    def engine() -> DataEngine:
        return DataEngine(recipe=RECIPE, seed=1, replaying=True)

    order = np.random.default_rng(1).permutation(len(data))  # as in a replay of seed 1
    log = watch(engine(), ReplayCell(data, order), 200)
    same(log, played, "index", "dataset", "seed")
    assert played.stretches(4) == log.stretches(4)
    same(replay(data, engine(), seed=1), played)
    log = watch(
        engine(), Silent(ReplayCell(data, order)), 200
    )  # what the cell does not tell stays unknown
    answer = log.verified | log.stopped
    assert 0 < answer.sum() < 200
    np.testing.assert_array_equal(log.truth[answer], played.truth[answer])
    assert np.isnan(log.truth[~answer]).all()
    assert log.clock_s is None


def test_a_replay_as_a_frame_has_a_row_a_cycle_that_adds_up_to_its_summary(played: Replay) -> None:
    frame, row = played.to_frame(), played.summary()
    accepted, rejected = frame["action"] == "accept", frame["action"] == "reject"
    sums = {
        "accepted": accepted.sum(),
        "rejected": rejected.sum(),
        "certain": (accepted | rejected).sum(),
        "false_positive": (accepted & ~frame["truth"]).sum(),
        "false_negative": (rejected & frame["truth"]).sum(),
        "saved_s": 5.0 * (frame["reason"] == "certain").sum(),
        "cycles": 200,
        "retrains": len(played.retrains),
    }
    assert {name: row[name] for name in sums} == sums
    assert row["certain"] > 50
    assert frame.index.tolist() == list(range(1, 201))
    assert frame.loc[row["first_certain"], "action"] != "verify"
    assert frame["reason"].eq("no_model").tolist() == frame["version"].eq(0).tolist()
    assert np.isnan(played.position).any(axis=1).tolist() == [True] * 40 + [False] * 160
    np.testing.assert_array_equal(frame[["embedding_1", "embedding_2"]].to_numpy(), played.position)


def test_a_window_decides_in_the_models_place_where_it_is_left_and_nowhere_else(
    data: Dataset, played: Replay
) -> None:
    highest = data.X.max(axis=1)
    limit = np.quantile(highest, 0.8)
    tight, wide = (
        RECIPE.with_policy(force_limits=[window])
        for window in (f"0:1:-1e9:{limit}:reject", "0:1:-1e9:")
    )
    with pytest.raises(SettingError, match="Expected the rate of the traces"):
        replay(data, tight)
    data = replace(data, rate_hz=500.0)
    same(replay(data, wide, seed=1), played, "recipe")
    log = replay(data, tight, seed=1)
    out, row = highest[log.index] > limit, log.summary()
    np.testing.assert_array_equal(log.outside, out)
    assert set(log.action[out]) == {"reject"}
    assert row["outside"] == out.sum()
    assert row["certain"] == (log.action[~out] != "verify").sum() > 20
    assert row["false_negative"] == (log.truth & (log.action == "reject"))[~out].sum()
    assert not log.finished[out].any()


def test_a_notebook_sees_short_records_the_status_and_times_as_datetimes(
    data: Dataset, played: Replay
) -> None:
    engine = DataEngine("pca")
    decision = [cycle.decision for cycle in engine.run(ReplayCell(data), 80)][-1]
    frame = engine.history_frame(last=5)
    assert (frame["time"].dt.tz is not None, frame.index[-1], engine.status().ever.decisions) == (
        True,
        decision.id,
        80,
    )
    for item in (data, played):
        assert len(repr(item)) < 240


def test_a_recipe_is_named_as_it_was_asked_for_or_after_its_reducer(
    data: Dataset, tmp_path
) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(RECIPE.to_toml(), encoding="utf-8")
    asked = ["paper", str(path), path, RECIPE, PCA(2), "sklearn.decomposition:PCA", Recipe(PCA(2))]
    names = ["paper", "mine", "mine", "pca", "PCA", "sklearn.decomposition:PCA", "PCA"]
    assert [Contender.load(recipe).name for recipe in asked] == names
    assert replay(data, PCA(2), cycles=30).summary()["recipe"] == "PCA"


@pytest.mark.parametrize("confirm", [False, True])
def test_after_an_accept_a_failure_stops_and_a_success_is_silent_unless_confirmed(
    data: Dataset, confirm: bool
) -> None:
    for label, outcome in (
        (0, Outcome.STOPPED),
        (1, Outcome.CONFIRMED if confirm else Outcome.UNKNOWN),
    ):
        cell = ReplayCell(data, np.flatnonzero(data.y == label), confirm)
        cell.insert()
        assert cell.proceed() is outcome
