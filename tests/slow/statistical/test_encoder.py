"""What the encoder must give: on traces that oscillate, about as much as the drawn kernels."""

import os

import numpy as np
import pytest
from scipy.signal import lfilter

from dengine import Dataset, Recipe, replay
from dengine.recipe import RECIPES

PROOF = int(os.environ.get("DENGINE_PROOF_REPEATS", "2")) >= 20


def resonant(
    n: int, samples: int, low: float, high: float, *, channels: int = 1, seed: int = 0
) -> Dataset:
    """Noise through one of two resonances a little apart, in cycles a sample; the lower one is the
    success.
    """
    rng = np.random.default_rng(seed)
    y = (rng.random(n) < 0.6).astype(np.int8)
    X = np.zeros((n, channels, samples), dtype=np.float32)
    for i, c in np.ndindex(n, channels):
        angle = 2 * np.pi * (low if y[i] else high) * (1 + 0.02 * rng.normal())
        ringing = lfilter(
            [1.0], [1.0, -1.94 * np.cos(angle), 0.97**2], rng.normal(size=samples + 200)
        )[200:]
        X[i, c] = ringing / ringing.std() + 0.5 * rng.normal(size=samples)
    return Dataset(X[:, 0] if channels == 1 else X, y, name="two resonances")


def certain(data: Dataset, recipe: Recipe, seeds: int) -> float:
    """Of a replay, the mean; at (0.1, 90 %)."""
    asked = recipe.with_policy(alpha=0.1, lower_bound=0.9)
    return float(np.mean([replay(data, asked, seed).summary()["certain"] for seed in range(seeds)]))


@pytest.mark.parametrize(
    ("samples", "low", "channels", "share"),
    [(400, 0.1, 1, 0.95), (152, 0.1, 1, 0.95), (400, 0.1, 2, 0.95), (5000, 0.01, 1, 0.9)],
)
def test_on_traces_that_oscillate_conv_is_certain_of_about_as_much_as_rocket(
    samples, low, channels, share
) -> None:
    data, seeds = resonant(700, samples, low, 1.2 * low, channels=channels), 3 if PROOF else 1
    conv = certain(data, RECIPES["conv"], seeds)
    assert conv >= share * certain(data, RECIPES["rocket"], seeds)
