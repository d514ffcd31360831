"""The count-only statistic: are the labels in a ball as many successes as chance says, where the labels are noise?

    >>> mean_square(count_noise(RECIPES["conv"], seed) for seed in range(8))      # honest: about 1

Half of the traces are easy, always failures and far away, so that heads have something to learn and pass their gate. The
others' labels are noise of rate p. A query among them has n such neighbours, n_s of them successes, hence z = (n_s - n p) /
sqrt(n p (1 - p)). Where no label had a say in who became whose neighbour, z^2 is 1 on average, whatever the encoder, the
radius and the rule; an encoder that saw the labels it is counted with gathers like with like, and z^2 grows. No bound, no
tolerance and no rare event is in it: it sees dishonest counting long before decisions go wrong.

    >>> moved(RECIPES["conv"], weak_signal(200, 2.0, seed=1), fold=0, seed=0)
    0.0

And what is counted in space k never read a label of fold k, exactly, through the whole engine: a stream is played twice,
the second time with all labels of one fold turned around. Every decision's place in that fold's space must be the same to
the last bit, through all retrains, however little what the labels chose may be worth.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from dengine import DataEngine, Dataset, ModelPrediction, Recipe, ReplayCell
from dengine.folds import content_fold, content_hash
from dengine.traces import as_traces

FEWEST = 10  # neighbours: with fewer, z is far from normal
RETRAINS = (100, 200, 400)  # labelled traces at each
QUERIES = 100


def squared_deviations(
    n_success: NDArray[np.int64], n: NDArray[np.int64], p: float
) -> NDArray[np.float64]:
    """z^2 of each ball with at least `FEWEST` labels of noise, n_success of n, drawn at rate p."""
    enough = n >= FEWEST
    n, n_success = n[enough], n_success[enough]
    return np.asarray((n_success - n * p) ** 2 / (n * p * (1.0 - p)))


@dataclass(frozen=True)
class Noise:
    """X (n, T) float32, y (n,), and easy (n,) bool: not noise, always failures, and far from the others."""

    X: NDArray[np.float32]
    y: NDArray[np.int8]
    easy: NDArray[np.bool_]
    p: float


def white_noise(n: int, p: float, seed: int, samples: int = 60) -> Noise:
    """Traces of white noise, so that an encoder has everything to learn by heart."""
    rng = np.random.default_rng([seed, 7])
    easy = rng.random(n) < 0.5
    X = rng.normal(20.0, 3.0, (n, samples))
    X[easy] -= 40.0
    return Noise(
        X.astype(np.float32), np.where(easy, 0, rng.random(n) < p).astype(np.int8), easy, p
    )


def relabelled(X: NDArray[np.float32], n: int, p: float, seed: int) -> Noise:
    """N of these traces in random order; half of them turned upside down far below, the others with labels of noise."""
    rng = np.random.default_rng([seed, 8])
    some = X[rng.permutation(len(X))[:n]].copy()
    easy = rng.random(n) < 0.5
    some[easy] = -some[easy] - 3.0 * np.abs(X).max()
    return Noise(some, np.where(easy, 0, rng.random(n) < p).astype(np.int8), easy, p)


def count_noise(recipe: Recipe, noise: Noise, seed: int) -> NDArray[np.float64]:
    """z^2 of the last `QUERIES` traces' balls after each of `RETRAINS`, each from the one before."""
    model = ModelPrediction.from_recipe(replace(recipe, novelty=0.0), seed)
    queries = noise.X[-QUERIES:][~noise.easy[-QUERIES:]]
    results = []
    for n in RETRAINS:
        X = as_traces(noise.X[:n])
        model = model.successor().train(X, noise.y[:n], content_hash(X))
        n_success, n_failure = model.count(queries)
        results.append(
            squared_deviations(
                n_success, n_success + n_failure - _easy(model, noise.easy[:n], queries), noise.p
            )
        )
    return np.concatenate(results)


def _easy(
    model: ModelPrediction, easy: NDArray[np.bool_], queries: NDArray[np.float32]
) -> NDArray[np.int64]:
    """How many of each query's neighbours are easy: the same balls, counted with other labels."""
    labels = model.index.labels[1, : len(easy)]
    kept = labels.clone()
    labels.copy_(torch.from_numpy(easy.astype(np.float32)))
    counted, _ = model.count(queries)
    labels.copy_(kept)
    return counted


def mean_square(runs: Iterable[NDArray[np.float64]]) -> float:
    """Mean z^2 of all balls; NaN where none was full enough."""
    squares = np.concatenate(list(runs))
    return float(squares.mean()) if len(squares) else float("nan")


def weak_signal(n: int, strength: float, seed: int, samples: int = 40) -> Dataset:
    """Traces whose level tells the label now and then: heads do hardly better than the base rate, so that gates matter."""
    rng = np.random.default_rng([seed, 9])
    level = rng.normal(0.0, 1.0, n)
    X = 20.0 + level[:, None] + rng.normal(0.0, 1.0, (n, samples))
    y = rng.random(n) < 1.0 / (1.0 + np.exp(-strength * level))
    return Dataset(X.astype(np.float32), y.astype(np.int8), name="weak signal")


def places(recipe: Recipe, data: Dataset, seed: int) -> NDArray[np.float64]:
    """(n, K, d) where each trace lay in every space when it was decided; NaN before the first retrain."""
    sure_of_nothing = replace(
        recipe.with_policy(alpha=1e-6, lower_bound=0.999), novelty=0.0
    )  # every label becomes known
    engine = DataEngine(recipe=sure_of_nothing, seed=seed, replaying=True)
    results = [cycle.decision.embedding for cycle in engine.run(ReplayCell(data), len(data))]
    shape = np.shape(results[-1])
    return np.array([np.full(shape, np.nan) if item is None else item for item in results])


def moved(recipe: Recipe, data: Dataset, fold: int, seed: int) -> float:
    """Share of the traces whose place in the fold's own space depends on the fold's labels; honest: 0."""
    custom = content_fold(data.X[:, None, :], recipe.folds) == fold
    turned = replace(data, y=np.where(custom, 1 - data.y, data.y).astype(np.int8))
    first, other = (places(recipe, item, seed)[:, fold] for item in (data, turned))
    return float((~np.isclose(first, other, rtol=0.0, atol=0.0, equal_nan=True)).any(axis=1).mean())
