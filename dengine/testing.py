"""The contract of a reducer, as checks that an author can run on one of his own.

    from dengine.testing import check_reducer
    check_reducer(MyReducer())                   # an AssertionError names the clause that is broken

`REDUCER_CHECKS` are the clauses one by one, for pytest's parametrize. Any scikit-learn transformer may be checked, as the
engine would use it: label-free in one space, label-using cross-fitted. Honest counting rests on
`labels_of_a_fold_move_nothing_in_its_space`.
"""

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, clone

from .cells.replay import ReplayCell
from .datasets import Dataset
from .decision.policy import Policy
from .decision.scripting import script
from .engine.engine import DataEngine
from .folds import content_fold
from .recipe import Recipe
from .reducers.base import Floats, Ints, Reducer, StopRule, as_reducer, uses_labels

N, SAMPLES, FOLDS = 100, 120, 2
SHAPES = ((1, 152), (1, 800), (3, 90))  # channels, samples


def toy_traces(
    n: int = N, samples: int = SAMPLES, channels: int = 1, seed: int = 0, failures: float = 0.2, noise: float = 0.5
) -> tuple[Floats, Ints]:
    """Traces (n, C, T) of two shapes with noise, and labels (n,): a success bottoms late, a failure meets the rim early."""
    rng = np.random.default_rng(seed)
    y = (rng.random(n) >= failures).astype(np.int64)
    t = np.linspace(0.0, 1.0, samples)[None, None, :]
    onset = np.where(y == 1, 0.7, 0.35)[:, None, None] + rng.normal(0.0, 0.03, (n, 1, 1))
    height = rng.normal(20.0, 2.0, (n, channels, 1))
    X = height / (1.0 + np.exp(-40.0 * (t - onset))) + rng.normal(0.0, noise, (n, channels, samples))
    return X.astype(np.float32), y


QUERIES = toy_traces(20, seed=5)[0]


def it_embeds_every_trace_in_every_space(reducer: Any) -> None:
    """`embed` gives (n, K, d) finite float32, the same from two clones, `transform` (n, d), `embed_references` each fold's row.

    The caller's traces are not written to.
    """
    assert isinstance(reducer, BaseEstimator), f"{type(reducer).__name__} is no scikit-learn estimator"
    trained, Q = _trained(reducer), QUERIES.copy()
    assert trained.n_spaces >= 1 + trained.uses_labels, "in one space every label would be counted where it was seen"
    Z, fold = trained.embed(Q), np.arange(20) % trained.n_spaces
    np.testing.assert_array_equal(_trained(reducer).embed(Q), Z, err_msg="two fits differ: give it a random_state")
    np.testing.assert_array_equal(trained.embed_references(Q, fold), Z[np.arange(20), fold])
    assert Z.ndim == 3, f"expected (n, K, d), got {Z.shape}"
    assert Z.shape[:2] == (20, trained.n_spaces), f"expected 20 traces in {trained.n_spaces} spaces, got {Z.shape}"
    assert Z.dtype == np.float32, f"expected float32, got {Z.dtype}"
    assert np.isfinite(Z).all(), "a point is not finite"
    flat = np.asarray(trained.transform(Q))
    assert flat.shape == (20, Z.shape[2]), f"expected transform to give (20, {Z.shape[2]}), got {flat.shape}"
    np.testing.assert_array_equal(Q, QUERIES, err_msg="it writes to the caller's traces")


def labels_of_a_fold_move_nothing_in_its_space(reducer: Any) -> None:
    """Honest counting: space k is the same bit for bit whatever the labels of fold k say, over a second training too."""
    X, y = toy_traces()
    honest = _trained(reducer, times=2)
    Q, fold = QUERIES, content_fold(X, honest.n_spaces)
    for k in range(honest.n_spaces):
        other = y.copy()
        other[fold == k] = np.random.default_rng(k).permutation(1 - y[fold == k])
        found = _trained(reducer, times=2, labels=other).embed(Q)[:, k]
        np.testing.assert_array_equal(found, honest.embed(Q)[:, k], err_msg=f"labels of fold {k} moved space {k}")


def labels_come_only_where_it_says_that_it_uses_them(reducer: Any) -> None:
    """`fit` is handed labels with `uses_labels = True` alone: without it, one that needs them fails at every retrain."""
    X, y = toy_traces()
    try:
        _trained(reducer)
    except Exception as error:
        if uses_labels(reducer):
            raise
        clone(reducer).fit(X if isinstance(reducer, Reducer) else X[:, 0], y)  # what it raises then has another reason
        raise AssertionError(f"its fit works with labels alone, got none; set uses_labels = True ({error})") from error


def fit_starts_afresh(reducer: Any) -> None:
    """`fit` on A and then on B is `fit` on B."""
    A, a = toy_traces(seed=1)
    B, b = toy_traces(seed=2)
    once, twice = as_reducer(clone(reducer), FOLDS), as_reducer(clone(reducer), FOLDS)
    found = twice.fit(A, a).fit(B, b).transform(A)
    np.testing.assert_array_equal(np.asarray(found), np.asarray(once.fit(B, b).transform(A)))


def a_trace_alone_lies_where_it_lies_in_a_batch(reducer: Any) -> None:
    """Within a ten-thousandth of the embedding's root mean square radius: a cell embeds one trace at a time."""
    trained, Q = _trained(reducer), QUERIES
    together = trained.embed(Q)
    alone = np.concatenate([trained.embed(x[None]) for x in Q])
    radius = np.sqrt(together.var(axis=0).sum(axis=-1))  # (K,)
    moved = float((np.linalg.norm(alone - together, axis=2) / np.maximum(radius, 1e-12)).max())
    assert moved <= 1e-4, f"embedded alone, a trace moves by {moved:.2g} of the embedding's radius, more than 1e-4"


def any_length_and_several_channels_work(reducer: Any) -> None:
    """Nothing is made for one shape of trace."""
    for channels, samples in SHAPES:
        X, y = toy_traces(70, samples, channels)
        trained = as_reducer(clone(reducer), FOLDS)
        points = trained.train(X, y, content_fold(X, trained.n_spaces))
        found = trained.embed(X[:5])
        assert points.shape == (70, found.shape[2]), f"expected a point a trace, got {points.shape}"
        assert np.isfinite(points).all(), "a reference has no finite place"
        assert np.isfinite(found).all(), f"a point is not finite for {channels} x {samples}"


def a_trace_with_a_nan_is_refused(reducer: Any) -> None:
    """In `fit` and in `transform`, by a ValueError."""
    X, y = toy_traces()
    spoilt = X.copy()
    spoilt[3, 0, 7] = np.nan
    for call in (lambda: as_reducer(clone(reducer), FOLDS).fit(spoilt, y), lambda: _trained(reducer).transform(spoilt)):
        try:
            call()
        except ValueError:
            continue
        raise AssertionError("a NaN was taken without a word")


def its_module_compiles_and_embeds_as_it_does(reducer: Any) -> None:
    """Where there is a module: what is exported is what decides."""
    trained, Q = _trained(reducer), QUERIES
    module = trained.module()
    if module is not None:
        with torch.inference_mode():
            Z = script(module.eval())(torch.from_numpy(Q)).numpy()
        np.testing.assert_allclose(Z, trained.embed(Q), rtol=1e-4, atol=1e-4)


def its_state_restores_it_bit_for_bit(reducer: Any) -> None:
    """Where there is a state: plain arrays, no Python objects."""
    trained, Q = _trained(reducer), QUERIES
    state = trained.get_state()
    if state is not None:
        for name, value in state.items():
            assert isinstance(value, np.ndarray), f"{name} is no array"
            assert not value.dtype.hasobject, f"{name} holds Python objects"
        restored = as_reducer(clone(reducer), FOLDS).set_state(state)
        np.testing.assert_array_equal(restored.embed(Q), trained.embed(Q))


def an_engine_resumes_with_identical_decisions(reducer: Any) -> None:
    """From a database, closed and opened, bit for bit."""
    X, y = toy_traces(110)
    recipe = Recipe(clone(reducer), policy=Policy(0.2, 0.8), retrain_every=70, folds=FOLDS)
    with TemporaryDirectory() as folder:
        url = str(Path(folder) / "engine.db")
        with DataEngine(recipe=recipe, store=url, replaying=True) as engine:
            list(engine.run(ReplayCell(Dataset(X, y.astype(np.int8))), 90))
            first = engine.store.retrains()[0]
            assert first.accepted, f"the first retrain was dropped: {first.reason}"
            before = _decisions(engine, X[90:])
        with DataEngine.open(url, reducer=clone(reducer)) as engine:
            assert _decisions(engine, X[90:]) == before


REDUCER_CHECKS: tuple[Callable[[Any], None], ...] = (
    labels_come_only_where_it_says_that_it_uses_them,
    it_embeds_every_trace_in_every_space,
    labels_of_a_fold_move_nothing_in_its_space,
    fit_starts_afresh,
    a_trace_alone_lies_where_it_lies_in_a_batch,
    any_length_and_several_channels_work,
    a_trace_with_a_nan_is_refused,
    its_module_compiles_and_embeds_as_it_does,
    its_state_restores_it_bit_for_bit,
    an_engine_resumes_with_identical_decisions,
)


def check_reducer(reducer: Any) -> None:
    """Run every clause of the contract on clones of a reducer; AssertionError names the first that is broken."""
    for check in REDUCER_CHECKS:
        try:
            check(reducer)
        except AssertionError as error:
            raise AssertionError(f"{type(reducer).__name__} breaks {check.__name__!r}: {error}") from error


def _trained(reducer: Any, times: int = 1, labels: Ints | None = None) -> Reducer:
    """A clone as the engine trains it, so many times in a row."""
    X, y = toy_traces()
    trained = as_reducer(clone(reducer), FOLDS)
    for _ in range(times):
        trained.train(X, y if labels is None else labels, content_fold(X, trained.n_spaces), StopRule(max_steps=8))
    return trained


def _decisions(engine: DataEngine, X: NDArray[np.float32]) -> list[tuple[Any, ...]]:
    found = [engine.decide(x) for x in X]
    return [(d.action, d.lower, d.upper, d.n_success, d.n_failure, d.embedding, d.model_version) for d in found]
