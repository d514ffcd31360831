"""Rocket keeps the features of the traces it was trained on: never stale, never another's, never too many."""

import pickle

import numpy as np
import torch

from dengine import RocketReducer
from dengine.folds import content_fold


def traces(n: int = 80) -> tuple[np.ndarray, np.ndarray]:
    """(n, 1, 30) float32 ramps with noise, of two heights; y (n,): the higher ones are the successes."""
    rng = np.random.default_rng(0)
    y = (np.arange(n) % 3 > 0).astype(np.int64)
    ramp = np.linspace(0.0, 1.0, 30) * (5.0 + 3.0 * y)[:, None, None]
    return (ramp + rng.normal(0.0, 1.0, (n, 1, 30))).astype(np.float32), y


def test_features_kept_under_other_biases_are_not_read_again() -> None:
    X, y = traces()
    reducer = RocketReducer(random_state=0).fit(X, y)
    first = reducer.net_.features.bias.clone()
    reducer.set_params(random_state=5).fit(X, y)
    assert not np.array_equal(reducer.net_.features.bias, first)
    fresh = RocketReducer(random_state=5).fit(X, y)
    np.testing.assert_array_equal(reducer.raw_features(X), fresh.net_.features.raw(torch.from_numpy(X)))
    np.testing.assert_array_equal(reducer.embed(X), fresh.embed(X))


def test_features_of_a_trace_are_kept_until_it_leaves_the_window() -> None:
    X, y = traces(90)
    reducer, folds = RocketReducer(), content_fold(X, 5)
    reducer.train(X[:60], y[:60], folds[:60])
    reducer.train(X[30:], y[30:], folds[30:])
    assert len(reducer.kept_.places) == len(reducer.kept_) == 60
    kept = reducer.kept_.features.clone()
    np.testing.assert_array_equal(reducer.raw_features(X[30:]), kept)
    np.testing.assert_allclose(kept, reducer.net_.features.raw(torch.from_numpy(X[30:])), atol=0.05)


def test_traces_in_small_units_are_not_taken_for_one_another() -> None:
    X, y = traces()
    small, folds = X * np.float32(2.0**-30), content_fold(X, 5)  # a power of two: the same digits, another exponent
    fitted = RocketReducer().fit(X, y, folds=folds)
    np.testing.assert_array_equal(RocketReducer().fit(small, y, folds=folds).embed(small), fitted.embed(X))


def test_a_pickled_rocket_grows_as_its_traces_do_and_not_as_their_square() -> None:
    sizes = [len(pickle.dumps(RocketReducer().fit(*traces(n)))) for n in (100, 400)]
    assert sizes[1] < 4 * sizes[0]
