"""Garbage: what no gripper ever felt, shown to a model that learned insertions. How much of it is accepted?

>>> garbage(0, "conv")[0]
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dengine import ModelPrediction, load_dataset
from dengine.recipe import RECIPES
from dengine.records import Action

Traces = NDArray[np.float32]
SCREW_DRIVING = Path(__file__).resolve().parents[4] / "shared" / "data" / "screw_driving.npz"
LEARNED, PER_KIND = 800, 100


def _engine_noise(X: Traces, rng: np.random.Generator) -> NDArray[np.float64]:
    t, n = np.linspace(0.0, 1.0, X.shape[1]), len(X)
    beat = rng.uniform(20.0, 60.0, (n, 1)) * t + rng.uniform(0.0, 1.0, (n, 1))
    return np.asarray(
        X.mean() + X.std() * (1.0 + 0.5 * np.sin(2 * np.pi * 3 * t)) * np.sin(2 * np.pi * beat)
    )


def _spiked(X: Traces, rng: np.random.Generator) -> Traces:
    X, at = X.copy(), rng.integers(X.shape[1], size=len(X))
    X[np.arange(len(X)), at] += 5.0 * np.ptp(X)
    return X


def _hum(X: Traces, rng: np.random.Generator) -> NDArray[np.float64]:
    return np.asarray(
        X
        + 0.5
        * X.std()
        * np.sin(
            2 * np.pi * 50 * np.linspace(0.0, 2.0, X.shape[1]) + rng.uniform(0, 6, (len(X), 1))
        )
    )


Kind = Callable[[Traces, Traces, np.random.Generator], NDArray[Any]]
KINDS: dict[str, Kind] = {  # from good and bad traces (n, T)
    "white noise": lambda good, _bad, rng: rng.normal(good.mean(), good.std(), good.shape),
    "sine": lambda good, _bad, rng: (
        good.mean()
        + good.std() * np.sin(np.linspace(0, 60, good.shape[1]) + rng.uniform(0, 6, (len(good), 1)))
    ),
    "hum on good parts": lambda good, _bad, rng: _hum(good, rng),
    "hum on bad parts": lambda _good, bad, rng: _hum(bad, rng),
    "spike": lambda good, _bad, rng: _spiked(good, rng),
    "bias": lambda good, _bad, _rng: good + good.std(),
    "shifted": lambda good, _bad, _rng: np.roll(good, good.shape[1] // 5, axis=1),
    "reversed": lambda good, _bad, _rng: good[:, ::-1],
    "upside down": lambda good, _bad, _rng: 2 * good.mean() - good,
    "random walk": lambda good, _bad, rng: (
        good.mean() + good.std() / 10 * np.cumsum(rng.normal(size=good.shape), axis=1)
    ),
    "another machine": lambda good, _bad, rng: _engine_noise(good, rng),
    "half the gain": lambda good, _bad, _rng: 0.5 * good,
}


def screws(samples: int, rng: np.random.Generator) -> Traces | None:
    """Recordings of screw driving, stretched to `samples`; None where the set is not at hand."""
    if not SCREW_DRIVING.is_file():
        return None
    X = load_dataset(SCREW_DRIVING).X
    X = X[rng.permutation(len(X))[:PER_KIND]]
    grid = np.linspace(0, X.shape[1] - 1, samples)
    return np.array([np.interp(grid, np.arange(X.shape[1]), x) for x in X], dtype=np.float32)


def garbage(seed: int, reducer: str) -> list[dict[str, Any]]:
    """A row a kind: the share accepted with the novelty gate and without; last, certain decisions on clean parts."""
    rng, data = np.random.default_rng([seed, 13]), load_dataset("insertion")
    order = rng.permutation(len(data))
    X, y, clean = data.X[order[:LEARNED]], data.y[order[:LEARNED]], data.X[order[LEARNED:]]
    good, bad = X[y == 1][:PER_KIND], X[y == 0][:PER_KIND]
    kinds = {
        name: np.asarray(make(good, bad, rng), dtype=np.float32) for name, make in KINDS.items()
    }
    result = screws(X.shape[1], rng)
    if result is not None:
        kinds["screw driving"] = result
    rows = _rows(reducer, seed, X, y, kinds, clean)
    few = slice(0, 300)  # of three channels, one of which dies
    dead = np.repeat(good[:, None], 3, axis=1)
    dead[:, 1] = 0.0
    three, of_three = np.repeat(X[few, None], 3, axis=1), {"dead channel of three": dead}
    return rows + _rows(reducer, seed, three, y[few], of_three, None)


def _rows(
    reducer: str, seed: int, X: Traces, y: Any, kinds: dict[str, Traces], clean: Traces | None
) -> list[dict[str, Any]]:
    recipe = RECIPES[reducer].with_policy(alpha=0.1, lower_bound=0.9)
    gated = ModelPrediction.from_recipe(recipe, seed).fit(X, y)
    open_ = ModelPrediction.from_recipe(replace(recipe, novelty=0.0), seed).fit(X, y)
    share = [
        (name, *(_share(m, x, [Action.ACCEPT]) for m in (gated, open_)))
        for name, x in kinds.items()
    ]
    if clean is not None:
        share.append(
            (
                "clean, certain",
                *(_share(m, clean, [Action.ACCEPT, Action.REJECT]) for m in (gated, open_)),
            )
        )
    return [{"kind": name, "gated": on, "open": off} for name, on, off in share]


def _share(model: ModelPrediction, X: Traces, actions: list[Action]) -> float:
    return float(np.mean([item.action in actions for item in model.predict_many(X)]))
