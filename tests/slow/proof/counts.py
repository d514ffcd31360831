"""Two checks of honest counting: a statistic of label counts, and the blindness of a fold's space.

    >>> mean_square(count_noise(RECIPES["conv"], white_noise(500, 0.8, s), s) for s in range(8))

**The statistic.** Half of the traces are easy: always failures and far away, so that heads have
something to learn and pass their gate. The labels of the others are noise of rate p. Such a query
has n neighbours with noise labels, of which n_s are successes, and z = (n_s - n p) / sqrt(n p (1 -
p)). If no label influenced whose neighbour it became, z^2 is 1 on average, whatever the encoder,
the radius and the rule are. An encoder that saw the labels which are counted in it gathers equal
labels, and z^2 grows. No bound, no tolerance and no rare event is involved, so dishonest counting
shows long before decisions go wrong.

    >>> share_moved(RECIPES["conv"], weak_signal(200, 2.0, seed=1), fold=0, seed=0)
    0.0

**Blindness.** What is counted in space k never read a label of fold k, through the whole engine. A
stream is played twice, the second time with all labels of one fold inverted. The embedding of every
decision in that fold's space must be the same to the last bit, through all retrains.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from dengine import DataEngine, Dataset, ModelPrediction, Recipe, ReplayCell
from dengine.folds import content_fold, content_hash
from dengine.traces import as_traces

Counts = NDArray[np.int64]
Floats = NDArray[np.float64]
Labels = NDArray[np.int8]
Traces = NDArray[np.float32]

FEWEST = 10  # neighbours: with fewer, z is far from normal
RETRAINS = (100, 200, 400)  # labelled traces at each retrain
N_QUERIES = 100


def squared_deviations(n_success: Counts, n: Counts, p: float) -> Floats:
    """Return z^2 of each neighbourhood that has at least `FEWEST` noise labels.

    Parameters
    ----------
    n_success, n : array of int, shape (m,)
        Successes among the noise labels of a neighbourhood, and all of these.
    p : float
        Rate that the labels were drawn with.
    """
    is_enough = n >= FEWEST
    n = n[is_enough]
    deviations = n_success[is_enough] - n * p
    return np.asarray(deviations**2 / (n * p * (1.0 - p)))


@dataclass(frozen=True)
class Noise:
    """Traces of which some have labels of noise.

    Attributes
    ----------
    X : array of float32, shape (n, T)
    y : array of int8, shape (n,)
    is_easy : array of bool, shape (n,)
        The label is no noise: the trace is always a failure, and far from the others.
    p : float
        Success rate of the noise.
    """

    X: Traces
    y: Labels
    is_easy: NDArray[np.bool_]
    p: float


def white_noise(n: int, p: float, seed: int, samples: int = 60) -> Noise:
    """Draw traces of white noise, which an encoder can only learn by heart."""
    rng = np.random.default_rng([seed, 7])
    is_easy = rng.random(n) < 0.5
    X = rng.normal(20.0, 3.0, (n, samples))
    X[is_easy] -= 40.0
    y = np.where(is_easy, 0, rng.random(n) < p).astype(np.int8)
    return Noise(X.astype(np.float32), y, is_easy, p)


def relabel(X: Traces, n: int, p: float, seed: int) -> Noise:
    """Give noise labels to n of the traces, in random order.

    Half of them become easy: they are turned upside down and shifted far below.
    """
    rng = np.random.default_rng([seed, 8])
    traces = X[rng.permutation(len(X))[:n]].copy()
    is_easy = rng.random(n) < 0.5
    traces[is_easy] = -traces[is_easy] - 3.0 * np.abs(X).max()
    y = np.where(is_easy, 0, rng.random(n) < p).astype(np.int8)
    return Noise(traces, y, is_easy, p)


def count_noise(recipe: Recipe, noise: Noise, seed: int) -> Floats:
    """Return z^2 of the neighbourhoods of the last `N_QUERIES` traces after each retrain.

    The model is trained at each of `RETRAINS`, each time from the state before.
    """
    model = ModelPrediction.from_recipe(replace(recipe, novelty=0.0), seed)
    is_query_easy = noise.is_easy[-N_QUERIES:]
    queries = noise.X[-N_QUERIES:][~is_query_easy]
    results = []
    for n in RETRAINS:
        X = as_traces(noise.X[:n])
        model = model.successor().train(X, noise.y[:n], content_hash(X))
        n_success, n_failure = model.count(queries)
        n_noise = n_success + n_failure - _count_easy(model, noise.is_easy[:n], queries)
        results.append(squared_deviations(n_success, n_noise, noise.p))
    return np.concatenate(results)


def _count_easy(model: ModelPrediction, is_easy: NDArray[np.bool_], queries: Traces) -> Counts:
    """Return how many of each query's neighbours are easy.

    The same neighbourhoods are counted with other labels, which are put back afterwards.
    """
    labels = model.index.labels[1, : len(is_easy)]
    original = labels.clone()
    labels.copy_(torch.from_numpy(is_easy.astype(np.float32)))
    n_easy, _ = model.count(queries)
    labels.copy_(original)
    return n_easy


def mean_square(runs: Iterable[Floats]) -> float:
    """Return the mean z^2 of all neighbourhoods; NaN if there were none with enough labels."""
    squares = np.concatenate(list(runs))
    return float(squares.mean()) if len(squares) else float("nan")


def weak_signal(n: int, strength: float, seed: int, samples: int = 40) -> Dataset:
    """Draw traces whose level tells little about the label.

    Heads are hardly better than the base rate, so that their gates matter.
    """
    rng = np.random.default_rng([seed, 9])
    level = rng.normal(0.0, 1.0, n)
    X = 20.0 + level[:, None] + rng.normal(0.0, 1.0, (n, samples))
    y = rng.random(n) < 1.0 / (1.0 + np.exp(-strength * level))
    return Dataset(X.astype(np.float32), y.astype(np.int8), name="weak signal")


def decision_embeddings(recipe: Recipe, data: Dataset, seed: int) -> Floats:
    """Play a data set; return each trace's embedding in every space when it was decided.

    Returns
    -------
    embeddings : array of float, shape (n, K, d)
        NaN before the first retrain.
    """
    # A policy that is never certain, so that every label becomes known.
    policy_recipe = recipe.with_policy(alpha=1e-6, lower_bound=0.999)
    engine = DataEngine(recipe=replace(policy_recipe, novelty=0.0), seed=seed, replaying=True)
    embeddings = [cycle.decision.embedding for cycle in engine.run(ReplayCell(data), len(data))]
    missing = np.full(np.shape(embeddings[-1]), np.nan)
    return np.array([missing if embedding is None else embedding for embedding in embeddings])


def share_moved(recipe: Recipe, data: Dataset, fold: int, seed: int) -> float:
    """Return the share of traces whose embedding in a fold's space depends on the fold's labels.

    0 if the engine is honest.
    """
    is_in_fold = content_fold(data.X[:, None, :], recipe.folds) == fold
    inverted_labels = np.where(is_in_fold, 1 - data.y, data.y).astype(np.int8)
    inverted = replace(data, y=inverted_labels)
    first = decision_embeddings(recipe, data, seed)[:, fold]
    second = decision_embeddings(recipe, inverted, seed)[:, fold]
    is_equal = np.isclose(first, second, rtol=0.0, atol=0.0, equal_nan=True)
    return float((~is_equal).any(axis=1).mean())
