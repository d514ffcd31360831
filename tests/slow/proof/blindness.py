"""What is counted in space k never read a label of fold k: exactly, through the whole engine.

    >>> moved(RECIPES["conv"], noise, fold=0, seed=0)
    0.0

A stream is played twice, the second time with all labels of one fold turned around. Every decision's place in that fold's
space must be the same to the last bit, through all retrains. What is chosen by labels, a head, a feature, a gate, a stop,
or by folds that are dealt anew, gives itself away, however little it may be worth.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dengine import DataEngine, Dataset, Recipe, ReplayCell
from dengine.folds import content_fold


def weak_signal(n: int, strength: float, seed: int, samples: int = 40) -> Dataset:
    """Traces whose level tells the label now and then: heads do hardly better than the base rate, so that gates matter."""
    rng = np.random.default_rng([seed, 9])
    level = rng.normal(0.0, 1.0, n)
    X = 20.0 + level[:, None] + rng.normal(0.0, 1.0, (n, samples))
    y = rng.random(n) < 1.0 / (1.0 + np.exp(-strength * level))
    return Dataset(X.astype(np.float32), y.astype(np.int8), name="weak signal")


def places(recipe: Recipe, data: Dataset, seed: int) -> NDArray[np.float64]:
    """(n, K, d) where each trace lay in every space when it was decided; NaN before the first retrain."""
    sure_of_nothing = replace(recipe.with_policy(alpha=1e-6, lower_bound=0.999), novelty=0.0)  # every label becomes known
    engine = DataEngine.from_recipe(sure_of_nothing, seed=seed, replaying=True)
    found = [cycle.decision.embedding for cycle in engine.run(ReplayCell(data), len(data))]
    shape = np.shape(found[-1])
    return np.array([np.full(shape, np.nan) if each is None else each for each in found])


def moved(recipe: Recipe, data: Dataset, fold: int, seed: int) -> float:
    """Share of the traces whose place in the fold's own space depends on the fold's labels; honest: 0."""
    own = content_fold(data.X[:, None, :], recipe.folds) == fold
    turned = replace(data, y=np.where(own, 1 - data.y, data.y).astype(np.int8))
    one, other = (places(recipe, each, seed)[:, fold] for each in (data, turned))
    return float((~np.isclose(one, other, rtol=0.0, atol=0.0, equal_nan=True)).any(axis=1).mean())
