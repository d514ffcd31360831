"""How much garbage is accepted: traces that no gripper felt, shown to a model of insertions.

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
Floats = NDArray[np.float64]
SCREW_DRIVING = Path(__file__).resolve().parents[4] / "shared" / "data" / "screw_driving.npz"
N_LEARNED = 800  # insertions that the model learns
N_PER_KIND = 100
N_THREE_CHANNELS = 300  # insertions that the model of three channels learns


def white_noise(X: Traces, rng: np.random.Generator) -> Floats:
    """Return white noise with the mean and deviation of the traces."""
    return rng.normal(X.mean(), X.std(), X.shape)


def sine(X: Traces, rng: np.random.Generator) -> Floats:
    """Return sine waves of random phase with the mean and deviation of the traces."""
    phase = rng.uniform(0, 6, (len(X), 1))
    return np.asarray(X.mean() + X.std() * np.sin(np.linspace(0, 60, X.shape[1]) + phase))


def add_hum(X: Traces, rng: np.random.Generator) -> Floats:
    """Add a hum of 50 Hz and random phase."""
    time = np.linspace(0.0, 2.0, X.shape[1])
    phase = rng.uniform(0, 6, (len(X), 1))
    return np.asarray(X + 0.5 * X.std() * np.sin(2 * np.pi * 50 * time + phase))


def add_spike(X: Traces, rng: np.random.Generator) -> Traces:
    """Add a spike to one sample of each trace, five times as high as the range of all."""
    X = X.copy()
    samples = rng.integers(X.shape[1], size=len(X))
    X[np.arange(len(X)), samples] += 5.0 * np.ptp(X)
    return X


def random_walk(X: Traces, rng: np.random.Generator) -> Floats:
    """Return random walks that start at the mean of the traces."""
    return np.asarray(X.mean() + X.std() / 10 * np.cumsum(rng.normal(size=X.shape), axis=1))


def engine_noise(X: Traces, rng: np.random.Generator) -> Floats:
    """Return oscillations of another machine, of random frequency, with a slow beat."""
    time = np.linspace(0.0, 1.0, X.shape[1])
    frequency = rng.uniform(20.0, 60.0, (len(X), 1))
    angle = frequency * time + rng.uniform(0.0, 1.0, (len(X), 1))
    beat = 1.0 + 0.5 * np.sin(2 * np.pi * 3 * time)
    return np.asarray(X.mean() + X.std() * beat * np.sin(2 * np.pi * angle))


# Kind -> a function of good and of bad traces (n, T).
GarbageMaker = Callable[[Traces, Traces, np.random.Generator], NDArray[Any]]
KINDS: dict[str, GarbageMaker] = {
    "white noise": lambda good, _bad, rng: white_noise(good, rng),
    "sine": lambda good, _bad, rng: sine(good, rng),
    "hum on good parts": lambda good, _bad, rng: add_hum(good, rng),
    "hum on bad parts": lambda _good, bad, rng: add_hum(bad, rng),
    "spike": lambda good, _bad, rng: add_spike(good, rng),
    "bias": lambda good, _bad, _rng: good + good.std(),
    "shifted": lambda good, _bad, _rng: np.roll(good, good.shape[1] // 5, axis=1),
    "reversed": lambda good, _bad, _rng: good[:, ::-1],
    "upside down": lambda good, _bad, _rng: 2 * good.mean() - good,
    "random walk": lambda good, _bad, rng: random_walk(good, rng),
    "another machine": lambda good, _bad, rng: engine_noise(good, rng),
    "half the gain": lambda good, _bad, _rng: 0.5 * good,
}


def load_screw_driving(n_samples: int, rng: np.random.Generator) -> Traces | None:
    """Return recordings of screw driving, stretched to n_samples; None if there is no file."""
    if not SCREW_DRIVING.is_file():
        return None
    X = load_dataset(SCREW_DRIVING).X
    X = X[rng.permutation(len(X))[:N_PER_KIND]]
    samples = np.arange(X.shape[1])
    grid = np.linspace(0, X.shape[1] - 1, n_samples)
    return np.array([np.interp(grid, samples, trace) for trace in X], dtype=np.float32)


def garbage(seed: int, reducer: str) -> list[dict[str, Any]]:
    """Show every kind of garbage to a model that has learned insertions.

    Parameters
    ----------
    seed : int
    reducer : str
        A name in `RECIPES`.

    Returns
    -------
    rows : list of dict
        kind; gated and ungated: the share that is accepted with the novelty gate and without it.
        The kind "clean, certain" has the share of certain decisions on insertions instead.
    """
    rng = np.random.default_rng([seed, 13])
    data = load_dataset("insertion")
    order = rng.permutation(len(data))
    X = data.X[order[:N_LEARNED]]
    y = data.y[order[:N_LEARNED]]
    clean = data.X[order[N_LEARNED:]]
    good = X[y == 1][:N_PER_KIND]
    bad = X[y == 0][:N_PER_KIND]
    kinds = {
        name: np.asarray(make(good, bad, rng), dtype=np.float32) for name, make in KINDS.items()
    }
    screw_driving = load_screw_driving(X.shape[1], rng)
    if screw_driving is not None:
        kinds["screw driving"] = screw_driving
    models = TrainedModels(reducer, seed, X, y)
    rows = [models.row(name, traces, [Action.ACCEPT]) for name, traces in kinds.items()]
    rows.append(models.row("clean, certain", clean, [Action.ACCEPT, Action.REJECT]))

    three_channels = np.repeat(X[:N_THREE_CHANNELS, None], 3, axis=1)
    dead_channel = np.repeat(good[:, None], 3, axis=1)
    dead_channel[:, 1] = 0.0
    models = TrainedModels(reducer, seed, three_channels, y[:N_THREE_CHANNELS])
    rows.append(models.row("dead channel of three", dead_channel, [Action.ACCEPT]))
    return rows


class TrainedModels:
    """A model with the novelty gate and one without it, trained on the same traces."""

    def __init__(self, reducer: str, seed: int, X: Traces, y: NDArray[np.int8]) -> None:
        recipe = RECIPES[reducer].with_policy(alpha=0.1, lower_bound=0.9)
        self.gated = ModelPrediction.from_recipe(recipe, seed).fit(X, y)
        self.ungated = ModelPrediction.from_recipe(replace(recipe, novelty=0.0), seed).fit(X, y)

    def row(self, kind: str, X: Traces, actions: list[Action]) -> dict[str, Any]:
        """Return the row of a kind of traces: the share that gets one of the actions."""
        gated = _share_with_action(self.gated, X, actions)
        ungated = _share_with_action(self.ungated, X, actions)
        return {"kind": kind, "gated": gated, "ungated": ungated}


def _share_with_action(model: ModelPrediction, X: Traces, actions: list[Action]) -> float:
    """Return the share of traces for which the model predicts one of the actions."""
    return float(np.mean([prediction.action in actions for prediction in model.predict_many(X)]))
