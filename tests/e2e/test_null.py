"""The null test, which stays for ever: labels that are independent of the trace yield next to
nothing certain.

Beside it a deliberately dishonest configuration, which the same test catches.
"""

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

from dengine import (
    DataEngine,
    Dataset,
    Policy,
    Recipe,
    Replay,
    replay,
)
from dengine.recipe import RECIPES
from dengine.reducers.base import LabelFree, as_points

POLICY = Policy(alpha=0.1, lower_bound=0.9)
CYCLES = 300
# Certain cycles of these, on average: of 1503 0.1 to 0.8 were measured, in rare bursts.
BY_CHANCE = 2.0


def noise_labels(make_data, seed: int) -> Dataset:
    """Traces of two shapes, as real ones; labels, 80 % successes, that have nothing to do with
    them.
    """
    data = make_data(CYCLES, samples=100, seed=seed, noise=2.0)
    labels = np.random.default_rng(seed + 10_000).random(CYCLES) < 0.8
    return Dataset(data.X, labels.astype(np.int8), name="noise labels")


def certain(played: Replay) -> int:
    return int((played.action != "verify").sum())


def error_rate(*played: Replay) -> float:
    """Share of the certain that were wrong."""
    right = sum(int((p.action == np.where(p.truth, "accept", "reject")).sum()) for p in played)
    return 1.0 - right / max(1, sum(map(certain, played)))


@pytest.mark.parametrize("name", ["conv", "pca", "umap"])
def test_labels_of_noise_yield_next_to_nothing_certain(name, make_data, proof_repeats):
    recipe = RECIPES[name].with_policy(alpha=0.1, lower_bound=0.9).with_settings(retrain_every=30)
    repeats = proof_repeats // 2 if name == "conv" else proof_repeats  # it takes ten times as long
    played = [
        replay(noise_labels(make_data, seed), recipe, seed=seed) for seed in range(max(1, repeats))
    ]
    assert np.mean([certain(p) for p in played]) <= BY_CHANCE


class SeesEverything(LabelFree):
    """Dishonest on purpose: one space, fitted on the very labels that are then counted in it."""

    def train(self, X, y, folds, stop=None, numbers=None):
        self.reducer_ = clone(self.reducer).fit(X.reshape(len(X), -1), y)
        return self.embed_references(X, folds)

    def embed(self, X):
        return as_points(self.reducer_.transform(X.reshape(len(X), -1)))[:, None, :]


def with_lda(honest: bool, data: Dataset, seed: int) -> Replay:
    """The loop around LDA on 100 samples: cross-fitted, or fitted on all labels at once."""
    reducer = (
        LinearDiscriminantAnalysis() if honest else SeesEverything(LinearDiscriminantAnalysis())
    )
    recipe = Recipe(reducer, radius=0.3, folds=2, policy=POLICY)
    return replay(data, DataEngine(recipe=recipe, seed=seed, replaying=True), seed)


def test_the_same_labels_counted_where_they_were_fitted_are_caught(make_data, proof_repeats):
    streams = [noise_labels(make_data, seed) for seed in range(proof_repeats)]
    honest = [with_lda(True, data, seed) for seed, data in enumerate(streams)]
    dishonest = [with_lda(False, data, seed) for seed, data in enumerate(streams)]
    assert np.mean([certain(p) for p in honest]) <= BY_CHANCE
    assert np.mean([certain(p) for p in dishonest]) > 5 * BY_CHANCE
    assert error_rate(*dishonest) > 1.5 * (1.0 - POLICY.lower_bound)


def test_an_honest_engine_does_become_certain_where_the_trace_tells(make_data):
    # Or silence would pass the null test.
    played = with_lda(True, make_data(CYCLES, samples=100, noise=2.0), 0)
    assert certain(played) > CYCLES / 4
    assert error_rate(played) <= 0.1
