"""The contract of a reducer, as checks that its author can run. The project's own tests run them on
the built-in reducers.

    from dengine.testing import check_reducer
    check_reducer(MyReducer())  # an AssertionError names the clause that is broken

`REDUCER_CHECKS` holds the clauses one by one, for pytest's parametrize. Each takes a reducer, works
on clones of it, returns None and raises AssertionError if its clause is broken. Any transformer of
sklearn may be checked. It is used as in an engine: in one space if it uses no labels; if it does,
in its own spaces, or cross-fitted in two folds where it has but one. Honest counting rests on the
clause `labels_of_a_fold_move_nothing_in_its_space`. `toy_traces` makes the traces of these checks,
and of examples.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.testing import assert_array_equal
from sklearn.base import BaseEstimator, clone

from .cells.replay import ReplayCell
from .datasets import Dataset
from .decision.policy import Policy
from .decision.scripting import reason_of
from .engine.engine import DataEngine
from .folds import content_fold
from .model import ModelPrediction
from .recipe import Recipe
from .records import Decision
from .reducers.base import Floats, Ints, Reducer, StopRule, as_reducer, uses_labels

N_TRACES = 100
N_SAMPLES = 120
FOLDS = 2
SHAPES = ((1, 152), (1, 800), (3, 90))  # channels, samples


def toy_traces(
    n: int = N_TRACES,
    samples: int = N_SAMPLES,
    channels: int = 1,
    seed: int = 0,
    failures: float = 0.2,
    noise: float = 0.5,
) -> tuple[Floats, Ints]:
    """Make traces of two curve shapes with noise, and their labels.

    The force of a success rises late, when the part reaches the bottom of the hole: about 70 % of
    the way through the trace. The force of a failure rises early, at the edge of the hole: at about
    35 %. It rises from 0 to about 20 N, at the same time in all channels.

    Parameters
    ----------
    n, samples, channels : int
        Number of traces, samples per channel, channels.
    seed : int
        Of the random numbers; equal arguments give equal traces.
    failures : float
        Probability of a failure.
    noise : float
        Standard deviation of the noise, in newtons.

    Returns
    -------
    X : array of float32, shape (n, channels, samples)
        Forces in newtons.
    y : array of int64, shape (n,)
        1 success, 0 failure.
    """
    rng = np.random.default_rng(seed)
    y = (rng.random(n) >= failures).astype(np.int64)
    t = np.linspace(0.0, 1.0, samples)
    onset = np.where(y == 1, 0.7, 0.35)[:, None, None] + rng.normal(0.0, 0.03, (n, 1, 1))
    height = rng.normal(20.0, 2.0, (n, channels, 1))
    X = height / (1.0 + np.exp(-40.0 * (t - onset)))
    X += rng.normal(0.0, noise, (n, channels, samples))
    return X.astype(np.float32), y


QUERIES = toy_traces(20, seed=5)[0]


def it_embeds_every_trace_in_every_space(reducer: Any) -> None:
    """Assert that `embed`, `transform` and `embed_references` of a trained clone fit together.

    A reducer maps a trace to a point in each of K embedding spaces; space k is trained without the
    labels of fold k, one of K groups of traces. `reducer` must be a scikit-learn estimator. `embed`
    must return the points of n traces, with d coordinates each: finite float32 of shape (n, K, d),
    equal for two clones with the same training, with K of 2 or more if labels are used. `transform`
    must return shape (n, d). `embed_references(X, fold)` must return, for trace i with fold k, the
    point `embed(X)[i, k]`. None of them may write to the given traces. A `transform` of another
    number of axes raises SettingError instead. `reducer` may be unfitted and stays unchanged.
    """
    assert isinstance(reducer, BaseEstimator), (
        f"{type(reducer).__name__} is no scikit-learn estimator"
    )
    trained = _train_clone(reducer)
    Q = QUERIES.copy()
    assert trained.n_spaces >= 1 + trained.uses_labels, (
        "in one space every label would be counted where it was seen"
    )
    Z = trained.embed(Q)
    is_shaped = Z.ndim == 3 and Z.shape[:2] == (20, trained.n_spaces)
    assert is_shaped, f"expected (n, K, d), 20 traces in {trained.n_spaces} spaces, got {Z.shape}"
    fold = np.arange(20) % trained.n_spaces
    assert_array_equal(
        _train_clone(reducer).embed(Q), Z, err_msg="two fits differ: give it a random_state"
    )
    assert_array_equal(trained.embed_references(Q, fold), Z[np.arange(20), fold])
    assert Z.dtype == np.float32, f"expected float32, got {Z.dtype}"
    assert np.isfinite(Z).all(), "a point is not finite"
    shape = np.asarray(trained.transform(Q)).shape
    assert shape == (20, Z.shape[2]), f"expected transform to give (20, {Z.shape[2]}), got {shape}"
    assert_array_equal(Q, QUERIES, err_msg="it writes to the caller's traces")


def labels_of_a_fold_move_nothing_in_its_space(reducer: Any) -> None:
    """Assert honest counting: the labels of fold k do not influence embedding space k.

    Each trace belongs to one of K folds, and its label is counted only in the embedding space of
    its fold, so this space must not have learned from it. For each k a clone is trained on test
    traces, twice in a row, with the labels of fold k inverted and shuffled. It must map new traces
    to the same points of space k, bit for bit, as a clone that was trained in the same way with the
    true labels. `reducer` may be unfitted and stays unchanged.
    """
    X, y = toy_traces()
    trained = _train_clone(reducer, times=2)
    Z = trained.embed(QUERIES)
    fold = content_fold(X, trained.n_spaces)
    for k in range(trained.n_spaces):
        labels = y.copy()
        labels[fold == k] = np.random.default_rng(k).permutation(1 - y[fold == k])
        assert_array_equal(
            _train_clone(reducer, times=2, labels=labels).embed(QUERIES)[:, k],
            Z[:, k],
            err_msg=f"labels of fold {k} moved space {k}",
        )


def labels_come_only_where_it_says_that_it_uses_them(reducer: Any) -> None:
    """Assert that a reducer whose `fit` needs labels has `uses_labels = True`.

    A transformer that is no `Reducer` must have scikit-learn's tag `target_tags.required` instead.
    Otherwise an engine would pass no labels, and every retrain would fail. Clones are fitted to
    test traces, so `reducer` stays unchanged. A reducer that says that it uses labels passes. If
    the `fit` of any other fails with labels as well, its error is raised unchanged.
    """
    X, y = toy_traces()
    traces = X if isinstance(reducer, Reducer) else X[:, 0]
    try:
        clone(reducer).fit(traces)
    except Exception as error:
        if uses_labels(reducer):
            return
        clone(reducer).fit(traces, y)  # if this fails as well, labels are not the reason
        raise AssertionError(
            f"its fit works with labels alone, got none; set uses_labels = True ({error})"
        ) from error


def fit_starts_afresh(reducer: Any) -> None:
    """Assert that `fit` forgets what an earlier `fit` learned.

    One clone is fitted to test traces A and then B, another to B alone. `transform` of A must give
    the same points with both, bit for bit. `reducer` may be unfitted and stays unchanged.
    """
    A, labels_a = toy_traces(seed=1)
    B, labels_b = toy_traces(seed=2)
    once = as_reducer(clone(reducer), FOLDS).fit(B, labels_b)
    twice = as_reducer(clone(reducer), FOLDS).fit(A, labels_a).fit(B, labels_b)
    assert_array_equal(twice.transform(A), once.transform(A))


def any_length_and_several_channels_work(reducer: Any) -> None:
    """Assert that traces of other lengths, and of three channels, can be trained on and embedded.

    A reducer maps traces to points. The shapes (channels x samples) are 1 x 152, 1 x 800 and 3 x
    90. `train` must return a point for each trace, and these and the points of `embed` must be
    finite. For each shape a clone is trained on test traces, so `reducer` may be unfitted and stays
    unchanged.
    """
    for channels, samples in SHAPES:
        X, y = toy_traces(70, samples, channels)
        trained = as_reducer(clone(reducer), FOLDS)
        points = trained.train(X, y, content_fold(X, trained.n_spaces))
        Z = trained.embed(X[:5])
        assert points.shape == (70, Z.shape[2]), f"expected a point per trace, got {points.shape}"
        assert np.isfinite(points).all(), "a reference point is not finite"
        assert np.isfinite(Z).all(), f"a point is not finite for {channels} x {samples}"


def a_trace_with_a_nan_is_refused(reducer: Any) -> None:
    """Assert that `fit` and `transform` raise ValueError for a trace with a NaN.

    `fit` is called on an unfitted clone, `transform` on a clone that was trained on test traces, so
    `reducer` may be unfitted and stays unchanged. An error of another type is raised unchanged.
    """
    X, y = toy_traces()
    X[3, 0, 7] = np.nan
    unfitted = as_reducer(clone(reducer), FOLDS)
    trained = _train_clone(reducer)
    for call in (lambda: unfitted.fit(X, y), lambda: trained.transform(X)):
        try:
            call()
        except ValueError:
            continue
        raise AssertionError("expected a ValueError for a NaN, got none")


def a_version_answers_as_it_was_trained(reducer: Any) -> None:
    """Assert that a version, a trained model, embeds equally when it is restored or compiled.

    Two models with clones of `reducer` are trained from scratch on test traces, the second with
    opposite labels. The reference points, which are the embeddings of these traces, must be finite.
    Then eight of the traces are embedded again. A reducer that is restored from the trained one's
    state, or without a state the trained one itself, must give the same points, two times, within
    1e-5 times (1 + the coordinate's absolute value). The decider, the module by which an engine
    decides, must give them within 1e-3 in place of 1e-5, for each trace alone, unless it finds a
    fault in the trace. Its points are compared after division by one number for each embedding
    space, the scale of the space. The decider runs the reducer's `module()`, compiled to
    TorchScript, or `embed` if that is None. As in a retrain, the decider of the second model may be
    a copy of the one that was compiled for the first, with weights of its own. If the module does
    not compile or run, TorchScript's own error is raised. `reducer` may be unfitted and stays
    unchanged.
    """
    X, y = toy_traces()
    for labels in (y, 1 - y):
        model = ModelPrediction(clone(reducer), folds=FOLDS).fit(X, labels)
        defect = model.defect() or model.check_answers()
        assert not defect, defect


def an_engine_resumes_with_identical_decisions(reducer: Any) -> None:
    """Assert that an engine that is closed and opened again decides the same, bit for bit.

    It runs 90 cycles (one part each) on test traces, with a clone of `reducer` and a store in a
    temporary folder. Its first retrain must be accepted (the model put in force); if there is none,
    since `min_traces` of the reducer is above 90, IndexError is raised. Its decisions on 20 further
    traces, made before the closing and again after it, must be equal but for their ids. So a
    reducer whose `get_state` returns arrays must be restored from them exactly. `reducer` may be
    unfitted and stays unchanged. The engine limits this thread to one torch thread.
    """
    X, y = toy_traces(110)
    recipe = Recipe(clone(reducer), policy=Policy(0.2, 0.8), retrain_every=70, folds=FOLDS)
    with TemporaryDirectory() as folder:
        url = Path(folder) / "engine.db"
        with DataEngine(recipe=recipe, store=url, replaying=True) as engine:
            list(engine.run(ReplayCell(Dataset(X, y.astype(np.int8))), 90))
            first = engine.store.versions.retrains()[0]
            assert first.accepted, f"the first retrain was dropped: {first.reason}"
            decisions = _decide_all(engine, X[90:])
        with DataEngine.open(url, reducer=clone(reducer)) as engine:
            assert _decide_all(engine, X[90:]) == decisions


REDUCER_CHECKS: tuple[Callable[[Any], None], ...] = (
    labels_come_only_where_it_says_that_it_uses_them,
    it_embeds_every_trace_in_every_space,
    labels_of_a_fold_move_nothing_in_its_space,
    fit_starts_afresh,
    any_length_and_several_channels_work,
    a_trace_with_a_nan_is_refused,
    a_version_answers_as_it_was_trained,
    an_engine_resumes_with_identical_decisions,
)


def check_reducer(reducer: Any) -> None:
    """Run the checks in `REDUCER_CHECKS`, the contract of a reducer, one after another.

    A reducer maps traces to points. The checks work on clones of it. The last one limits this
    thread to one torch thread.

    Parameters
    ----------
    reducer : Reducer, or another scikit-learn transformer
        May be unfitted; it stays unchanged.

    Raises
    ------
    AssertionError
        For the first check that fails; the message names it. It is raised as well if TorchScript
        compiles the reducer's module and cannot run it. Any other error is raised unchanged.
    """
    for check in REDUCER_CHECKS:
        try:
            check(reducer)
        except (AssertionError, torch.jit.Error) as error:
            problem = str(error)
            if isinstance(error, torch.jit.Error):
                problem = f"TorchScript compiles its module and cannot run it: {reason_of(error)}"
            raise AssertionError(
                f"{type(reducer).__name__} breaks {check.__name__!r}: {problem}"
            ) from error


def _train_clone(reducer: Any, times: int = 1, labels: Ints | None = None) -> Reducer:
    """Return a clone of a reducer, trained `times` times in a row on the 100 `toy_traces()`.

    It is trained like in an engine: the fold of a trace follows from its content. There are as many
    folds as embedding spaces. A transformer that uses labels and has but one space is cross-fitted
    in 2 folds, so it has two. A transformer that is no `Reducer` comes in the wrapper that
    `as_reducer` chooses. Each training gets a `StopRule` of 8 steps, which a `train` without steps
    ignores. `reducer` stays unchanged. `labels`, shape (100,), replace those of the traces; None
    keeps them.
    """
    X, y = toy_traces()
    trained = as_reducer(clone(reducer), FOLDS)
    labels = y if labels is None else labels
    folds = content_fold(X, trained.n_spaces)
    for _ in range(times):
        trained.train(X, labels, folds, StopRule(max_steps=8))
    return trained


def _decide_all(engine: DataEngine, X: Floats) -> list[Decision]:
    """Let an engine decide on each trace of X, (n, C, T); return the decisions without their ids.

    The engine records the decisions, so they also count in its status and its store.
    """
    return [replace(engine.decide(x), id="") for x in X]
