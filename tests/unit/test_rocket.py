from functools import partial
from itertools import count

import numpy as np
import pytest
import torch
from scipy.special import expit
from sklearn.base import clone
from sklearn.linear_model import LogisticRegression

from dengine import RocketReducer
from dengine.errors import SettingError, StoreError
from dengine.folds import content_fold
from dengine.reducers.base import StopRule
from dengine.reducers.logistic_heads import fit_heads
from dengine.reducers.preprocessing import averaging
from dengine.reducers.rocket import (
    MIN_FIRST_STEPS,
    N_LEADING,
    N_SHARES,
    pairwise_products,
)


def traces(n=160):
    """Bumps at a random place; a late bump is a failure, with some noise in the labels."""
    rng = np.random.default_rng(0)
    place = rng.uniform(0.2, 0.9, size=(n, 1, 1))
    X = np.exp(-(((np.linspace(0.0, 1.0, 152) - place) / 0.05) ** 2))
    X = X * rng.uniform(5, 15, size=(n, 1, 1)) + 0.3 * rng.normal(size=(n, 1, 152))
    y = place[:, 0, 0] + 0.05 * rng.normal(size=n) < 0.7
    return X.astype(np.float32), y.astype(np.int64)


def train(reducer, X, y, **limits):
    """The engine's warm start; returns the reducer."""
    reducer.train(X, y, content_fold(X, reducer.folds), StopRule(**limits))
    return reducer


@pytest.mark.parametrize("k", [0, 1, 2])
def test_space_k_is_the_same_bit_for_bit_whatever_the_labels_of_fold_k_also_over_warm_starts(k):
    X, y = traces()
    folds, rng = content_fold(X, 3), np.random.default_rng(1)
    first, two = RocketReducer(folds=3), RocketReducer(folds=3)
    other = np.where(folds == k, 1 - y, y)
    for n in (60, 110, 160):
        first.train(X[:n], y[:n], folds[:n])
        two.train(X[:n], other[:n], folds[:n])
        other[folds == k] = rng.permutation(other[folds == k])  # others at the next warm start
        a, b = first.embed(X), two.embed(X)
        np.testing.assert_array_equal(a[:, k], b[:, k])
        assert first.holdout_losses_[k] == two.holdout_losses_[k]
        assert not np.array_equal(a, b)  # the other spaces did see them


def test_a_warm_start_ends_where_a_cold_start_does():
    X, y = traces(300)
    cold = RocketReducer().fit(X, y)
    warm = train(clone(cold).set_state(cold.get_state()), X[:100], y[:100])
    first, other = cold.embed(X), train(warm, X, y).embed(X)
    # A share is a tenth, and two of them may say labels equally well.
    np.testing.assert_allclose(first[:, :, 0], other[:, :, 0], atol=0.1)


def test_no_step_begins_after_the_deadline():
    reducer = train(RocketReducer(), *traces(), deadline=5.0, clock=count(0.0).__next__)
    assert reducer.n_iter_ == 5
    before = reducer.embed(traces()[0])
    train(reducer, *traces(), deadline=-1.0, clock=lambda: 0.0)
    assert reducer.n_iter_ == 0
    np.testing.assert_allclose(reducer.embed(traces()[0])[..., 0], before[..., 0], atol=1e-3)


def test_a_first_model_that_comes_too_late_has_learned_something_all_the_same():
    X, y = traces()
    late = train(RocketReducer(), X, y, deadline=-1.0, clock=lambda: 0.0)
    assert late.n_iter_ == MIN_FIRST_STEPS
    apart = late.embed(X)[..., 0].mean(1)
    assert apart[y == 1].mean() > apart[y == 0].mean() + 0.5


@pytest.mark.parametrize(
    ("X", "y", "message"),
    [
        (np.arange(6000.0).reshape(40, 1, 150), np.ones(40), "both classes outside fold 0"),
        (np.ones((40, 1, 150)), None, "uses labels"),
        (np.ones((40, 1, 150)), np.arange(40) % 2, "all are in one fold"),
        (np.arange(30.0)[:, None], np.arange(30) % 2, "at least 2 samples, got 1"),
    ],
)
def test_too_little_to_learn_from_is_said_clearly(X, y, message):
    with pytest.raises(SettingError, match=message):
        RocketReducer(folds=2).fit(X, y)


def test_a_first_training_on_few_traces_is_refused():
    with pytest.raises(SettingError, match="at least 20 traces, got 12"):
        train(RocketReducer(), *traces(12))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("n_components", 3, "n_components from 1 to 2"),
        ("folds", 1, "folds from 2 to 1000"),
        ("max_iter", 0, "max_iter from 1 to"),
        ("l2", 0.0, "l2 > 0"),
        ("kernels", 0, "kernels from 1 to"),
        ("width", 0, "width from 1 to"),
        ("regions", 40, "regions from 1 to 16"),
    ],
)
def test_a_setting_out_of_range_is_named(name, value, message):
    with pytest.raises(SettingError, match=message):
        RocketReducer(**{name: value}).fit(*traces())


def problem(n, width, seed=0):
    """Features of which the first makes a label likely, and the labels."""
    rng = np.random.default_rng(seed)
    g = rng.normal(size=(n, width)).astype(np.float32)
    y = rng.random(n) < expit(2.0 * g[:, 0])
    return torch.from_numpy(g), torch.from_numpy(y.astype(np.int64))


def test_a_head_that_would_do_worse_than_the_base_rate_predicts_it_and_the_others_do_not():
    g, y = problem(940, 50)
    # Head 1 learns from forty rows, head 0 from enough.
    outside = torch.arange(940) < torch.tensor([[900], [40]])
    w = fit_heads(g, y, outside, torch.zeros(2, 51, dtype=torch.float64), 0.01, 30, StopRule()).w
    assert w[:, :-1].any(1).tolist() == [True, False]
    assert torch.sigmoid(w[1, -1]) == pytest.approx(float(y[:40].double().mean()))


def test_heads_end_where_scikit_learns_logistic_regression_does():
    g, y = problem(400, 12)
    outside = torch.arange(400) % 3 != torch.arange(3)[:, None]
    w = fit_heads(g, y, outside, torch.zeros(3, 13).double(), 1.0, 30, StopRule()).w
    for k in range(3):
        theirs = LogisticRegression(C=1.0, tol=1e-8).fit(g[outside[k]], y[outside[k]])
        np.testing.assert_allclose(w[k, :-1], theirs.coef_[0], atol=2e-3)


@pytest.mark.parametrize("kind", [partial(RocketReducer, groups=0), RocketReducer])
def test_what_answers_is_the_components_then_the_heads_then_the_share_of_each_tower(kind):
    X, y = traces(100)
    reducer = kind(folds=3).fit(X, y)
    towers, encoder, logits = reducer.towers_, reducer.net_.encoder, []
    with torch.no_grad():
        f = encoder(torch.from_numpy(X))
        features = [f[:, columns] for columns in encoder.towers]
        features.append(pairwise_products(towers[0].components(features[0])[:, :N_LEADING]))
        for tower, of_tower in zip(towers, features, strict=False):
            g = of_tower.double() @ tower.axes.double() + tower.centre
            logits.append((g @ tower.w[:, :-1].T + tower.w[:, -1]).numpy())
    shares = np.linspace(0.0, 1.0, N_SHARES)[:, None]
    for k, answers in enumerate(reducer.embed(X)[..., 0].T):
        mixed = logits[0][:, k][None]  # (combinations of shares, n)
        for logit in logits[1:]:
            mixed = np.concatenate([logit[:, k] + shares * (m - logit[:, k]) for m in mixed])
        assert np.abs(expit(mixed) - answers).max(1).min() < 1e-5


def test_features_of_many_traces_are_those_of_each_to_the_bit():
    X, y = traces(100)
    features = RocketReducer(folds=2).fit(X, y).raw_features
    assert torch.equal(features(X), torch.cat([features(piece) for piece in np.array_split(X, 15)]))


def test_features_that_are_kept_while_the_window_moves_change_nothing():
    X, y = traces(90)
    folds, numbers = content_fold(X, 5), np.arange(1, 91)
    kept, anew = RocketReducer(), RocketReducer()
    for rows in (numbers[:60] - 1, numbers[30:] - 1, numbers[40::2] - 1):
        kept.train(X[rows], y[rows], folds[rows], numbers=numbers[rows])
        anew.train(X[rows], y[rows], folds[rows])
        np.testing.assert_array_equal(kept.embed(X), anew.embed(X))


@pytest.mark.parametrize(("period", "expected"), [(1000 / 3, 5), (1 / 0.3, 1)])
def test_traces_are_averaged_to_two_hundred_samples_but_not_where_that_loses_an_oscillation(
    period, expected
):
    phase = np.random.default_rng(0).random((20, 1, 1))
    X = np.sin(2 * np.pi * (np.arange(1000) / period + phase)).astype(np.float32)
    assert averaging(torch.from_numpy(X)) == expected


def test_a_model_of_other_sizes_is_refused_in_a_sentence_that_says_how_to_go_on():
    state = RocketReducer(groups=0).fit(*traces()).get_state()
    with pytest.raises(StoreError, match="other sizes; its labels are whole"):
        RocketReducer().set_state(state)
