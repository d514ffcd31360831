"""What the encoder must give: nothing on noise, whatever it trained on; on traces that oscillate, what others miss."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from dengine import ConvReducer, Dataset, Recipe, replay
from dengine.folds import content_hash
from dengine.recipe import RECIPES
from dengine.reducers.base import StopRule
from dengine.reducers.encoder import ConvEncoder, weights_of

PROOF = int(os.environ.get("DENGINE_PROOF_REPEATS", "2")) >= 20
STEPS = 6000 if PROOF else 200  # 6000 are 60 s as a replay counts them
BY_CHANCE = 8.0  # certain cycles of 1503, on average, as in test_null.py


def resonant(n: int, samples: int, low: float, high: float, *, channels: int = 1, seed: int = 0) -> Dataset:
    """Noise through one of two resonances a little apart, in cycles a sample; the lower one is the success."""
    rng = np.random.default_rng(seed)
    y = (rng.random(n) < 0.6).astype(np.int8)
    X = np.zeros((n, channels, samples), dtype=np.float32)
    for i, c in np.ndindex(n, channels):
        angle = 2 * np.pi * (low if y[i] else high) * (1 + 0.02 * rng.normal())
        ringing = lfilter([1.0], [1.0, -1.94 * np.cos(angle), 0.97**2], rng.normal(size=samples + 200))[200:]
        X[i, c] = ringing / ringing.std() + 0.5 * rng.normal(size=samples)
    return Dataset(X[:, 0] if channels == 1 else X, y, name="two resonances")


def certain(data: Dataset, recipe: Recipe, seeds: int) -> float:
    """Of a replay, the mean; at (0.1, 90 %)."""
    asked = recipe.with_policy(alpha=0.1, lower_bound=0.9)
    return float(np.mean([replay(data, asked, seed).summary()["certain"] for seed in range(seeds)]))


def test_an_encoder_trained_on_the_very_traces_makes_nothing_of_labels_of_noise(
    make_data, proof_repeats: int, tmp_path: Path
) -> None:
    found = []
    for seed in range(proof_repeats):
        data = make_data(1503, samples=100, seed=seed, noise=2.0)
        noise = (np.random.default_rng(seed + 10_000).random(1503) < 0.8).astype(np.int8)
        traces = data.X[:, None].astype(np.float32)
        reducer = ConvReducer(random_state=seed).fit(traces, noise)
        reducer.improve(traces, content_hash(traces), StopRule(max_steps=STEPS))
        assert reducer.training_ is not None
        assert isinstance(reducer.training_.encoder, ConvEncoder)
        np.savez(tmp_path / "start.npz", **weights_of(reducer.training_.encoder))
        recipe = replace(RECIPES["conv"], params={"start": str(tmp_path / "start.npz")}, encoder_budget=0.0)
        found.append(certain(replace(data, y=noise), recipe, seeds=1))
    assert np.mean(found) <= BY_CHANCE


@pytest.mark.parametrize(
    ("samples", "low", "channels", "share"),
    [(400, 0.1, 1, 0.95), (152, 0.1, 1, 0.95), (400, 0.1, 2, 0.95), (5000, 0.01, 1, 0.9)],
)
def test_on_traces_that_oscillate_conv_is_certain_of_about_as_much_as_rocket(samples, low, channels, share) -> None:
    data, seeds = resonant(700, samples, low, 1.2 * low, channels=channels), 3 if PROOF else 1
    conv = certain(data, RECIPES["conv"], seeds)
    assert conv >= share * certain(data, RECIPES["rocket"], seeds)


@pytest.mark.skipif(not PROOF, reason="takes minutes: make proof")
def test_training_pays_on_short_resonances() -> None:
    data = resonant(1000, 152, 0.10, 0.12)
    untrained = replace(RECIPES["conv"], encoder_budget=0.0)
    assert certain(data, RECIPES["conv"], 4) > certain(data, untrained, 4)
