import threading
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from scipy.special import expit
from sklearn.base import clone
from sklearn.linear_model import LogisticRegression

from dengine import DataEngine, Dataset, Recipe, RocketReducer
from dengine.datasets.importing import import_labelled
from dengine.errors import SettingError, StoreError
from dengine.folds import content_fold
from dengine.model.base import N_EXAMPLES
from dengine.reducers.base import StopRule
from dengine.reducers.logistic_heads import fit_heads, masked_loss
from dengine.reducers.preprocessing import averaging
from dengine.reducers.rocket import (
    MIN_FIRST_STEPS,
    N_LEADING,
    N_SHARES,
    PRODUCT_VARIANCE,
    TOWER_VARIANCES,
    pairwise_products,
)
from dengine.reducers.rocket_features import RocketEncoder


def traces(n=160, channels=1, samples=152, seed=0):
    """Bumps at a random place; a late bump is a failure, with some noise in the labels."""
    rng = np.random.default_rng(seed)
    place = rng.uniform(0.2, 0.9, size=(n, 1, 1))
    t = np.linspace(0.0, 1.0, samples)
    X = np.exp(-(((t - place) / 0.05) ** 2)) * rng.uniform(5, 15, size=(n, channels, 1))
    X = (X + 0.3 * rng.normal(size=(n, channels, samples))).astype(np.float32)
    y = (place[:, 0, 0] + 0.05 * rng.normal(size=n) < 0.7).astype(np.int64)
    return X, y


def fitted(**params):
    X, y = traces()
    return RocketReducer(**params).fit(X, y), X, y


def train(reducer, X, y):
    """The engine's warm start; returns the reducer."""
    reducer.train(X, y, content_fold(X, reducer.folds))
    return reducer


@pytest.mark.parametrize("k", [0, 1, 2])
def test_space_k_is_the_same_bit_for_bit_whatever_the_labels_of_fold_k_also_over_warm_starts(k):
    X, y = traces()
    folds, rng = content_fold(X, 3), np.random.default_rng(1)
    other = y.copy()
    other[folds == k] = 1 - y[folds == k]
    first, two = RocketReducer(folds=3), RocketReducer(folds=3)
    for n in (60, 110, 160):
        first.train(X[:n], y[:n], folds[:n])
        two.train(X[:n], other[:n], folds[:n])
        other[folds == k] = rng.permutation(
            other[folds == k]
        )  # other labels again at the next warm start
        a, b = first.embed(X), two.embed(X)
        assert np.array_equal(a[:, k], b[:, k])
        assert first.holdout_losses_[k] == two.holdout_losses_[k]
        assert not np.array_equal(a, b)  # the other spaces did see them


def test_a_warm_start_ends_where_a_cold_start_does():
    X, y = traces(300)
    cold = RocketReducer().fit(X, y)
    warm = train(train(clone(cold).set_state(cold.get_state()), X[:100], y[:100]), X, y)
    for first, other in zip(warm.towers_, cold.towers_, strict=True):
        assert (first.w - other.w).abs().max() < 5e-3
    # A share is a tenth, and two of them may say labels equally well.
    assert np.abs(warm.embed(X)[:, :, 0] - cold.embed(X)[:, :, 0]).max() < 0.1


def test_no_step_begins_after_the_deadline():
    X, y = traces()
    ticks = iter(range(1000))
    reducer = RocketReducer()
    reducer.train(
        X, y, content_fold(X, 5), StopRule(deadline=5.0, clock=lambda: float(next(ticks)))
    )
    assert reducer.n_iter_ == 5
    before = reducer.embed(X)
    reducer.train(X, y, content_fold(X, 5), stop := StopRule(deadline=-1.0, clock=lambda: 0.0))
    assert reducer.n_iter_ == 0
    assert stop.late
    np.testing.assert_allclose(reducer.embed(X)[..., 0], before[..., 0], atol=1e-3)


def test_a_first_model_that_comes_too_late_has_learned_something_all_the_same():
    X, y = traces()
    late = RocketReducer()
    late.train(X, y, content_fold(X, 5), StopRule(deadline=-1.0, clock=lambda: 0.0))
    assert late.n_iter_ == MIN_FIRST_STEPS
    apart = late.embed(X)[..., 0].mean(1)
    assert apart[y == 1].mean() > apart[y == 0].mean() + 0.5


def test_too_little_to_learn_from_is_said_clearly():
    X, y = traces()
    with pytest.raises(SettingError, match="at least 20 traces, got 12"):
        train(RocketReducer(), X[:12], y[:12])
    with pytest.raises(SettingError, match="both classes outside fold 0"):
        RocketReducer(folds=2).fit(X, np.ones(len(X), dtype=int))
    folds = np.zeros(len(X), dtype=np.int64)
    with pytest.raises(SettingError, match="both classes outside fold 0, got 0"):
        RocketReducer(folds=2).fit(X, y, folds=folds)
    with pytest.raises(SettingError, match="uses labels"):
        RocketReducer().fit(X)
    with pytest.raises(SettingError, match="at least 2 samples, got 1"):
        RocketReducer().fit(np.arange(30.0)[:, None], np.arange(30) % 2)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"n_components": 3}, "n_components 1 or 2"),
        ({"folds": 1}, "folds >= 2"),
        ({"max_iter": 0}, "max_iter >= 1"),
        ({"l2": 0.0}, "l2 > 0"),
        ({"kernels": 0}, "kernels >= 1"),
        ({"width": 0}, "width >= 1"),
        ({"regions": 40}, "regions <= 16"),
    ],
)
def test_a_setting_out_of_range_is_named(params, message):
    X, y = traces()
    with pytest.raises(SettingError, match=message):
        RocketReducer(**params).fit(X, y)


def test_a_head_that_would_do_worse_than_the_base_rate_says_it_and_the_others_do_not():
    rng = np.random.default_rng(0)
    g = torch.from_numpy(rng.normal(size=(940, 50)).astype(np.float32))
    y = torch.from_numpy(
        (rng.random(940) < 1 / (1 + np.exp(-2 * g[:, 0].numpy()))).astype(np.int64)
    )
    outside = torch.arange(940) < torch.tensor(
        [[900], [40]]
    )  # head 1 learns from forty rows, head 0 from enough
    w, left_out, unsure, steps = fit_heads(
        g, y, outside, torch.zeros(2, 51, dtype=torch.float64), 0.01, 30, None
    )
    assert unsure == [1]
    assert not w[1, :-1].any()
    assert torch.sigmoid(w[1, -1]) == pytest.approx(float(y[:40].double().mean()))
    loss = masked_loss(left_out, y, outside.double())
    assert loss[0] < 0.5 < loss[1]
    assert steps < 30


def test_heads_end_where_scikit_learns_logistic_regression_does():
    rng = np.random.default_rng(0)
    g = rng.normal(size=(400, 12)).astype(np.float32)
    y = (rng.random(400) < 1 / (1 + np.exp(-g[:, 0] - 0.5))).astype(np.int64)
    folds = rng.integers(0, 3, 400)
    outside = folds != np.arange(3)[:, None]
    w, *_ = fit_heads(
        torch.from_numpy(g),
        torch.from_numpy(y),
        torch.from_numpy(outside),
        torch.zeros(3, 13).double(),
        1.0,
        30,
        None,
    )
    for k in range(3):
        theirs = LogisticRegression(C=1.0, tol=1e-8).fit(g[folds != k], y[folds != k])
        np.testing.assert_allclose(w[k, :-1], theirs.coef_[0], atol=2e-3)


def test_the_components_are_found_anew_where_the_traces_grew_by_half_and_the_second_axis_keeps_its_direction():
    X, y = traces(160)
    reducer = train(RocketReducer(), X[:60], y[:60])
    results = []
    for n in (80, 100, 160):
        before = reducer.towers_[0].axes, reducer.embed(X)
        train(reducer, X[:n], y[:n])
        results.append(reducer.towers_[0].axes is not before[0])
        assert np.corrcoef(before[1][:, 0, 1], reducer.embed(X)[:, 0, 1])[0, 1] > 0.5
    assert results == [False, True, True]


@pytest.mark.parametrize("kind", [partial(RocketReducer, groups=0), RocketReducer])
def test_what_answers_is_the_components_then_the_heads_then_the_share_of_each_tower(
    kind: Any,
) -> None:
    X, y = traces(100)
    reducer = kind(folds=3).fit(X, y)
    with torch.no_grad():
        f, logits = reducer.net_.encoder(torch.from_numpy(X)), []
        seen = [f[:, columns] for columns in reducer.net_.encoder.towers]
        seen.append(pairwise_products(reducer.towers_[0].components(seen[0])[:, :N_LEADING]))
        variances = (*TOWER_VARIANCES[: len(reducer.net_.encoder.towers)], PRODUCT_VARIANCE)
        for tower, custom, variance in zip(reducer.towers_, seen, variances, strict=False):
            g = custom.double() @ tower.axes.double() + tower.centre
            logits.append((g @ tower.w[:, :-1].T + tower.w[:, -1]).numpy())
            assert g.var(0).sum() == pytest.approx(
                variance, rel=0.05
            )  # what a ridge of 1 is weighed against
    for k, text in enumerate(reducer.embed(X)[..., 0].T):
        mixed = [logits[0][:, k]]
        for logit in logits[1:]:
            mixed = [
                logit[:, k] + share * (first - logit[:, k])
                for first in mixed
                for share in np.linspace(0.0, 1.0, N_SHARES)
            ]
        assert min(np.abs(expit(first) - text).max() for first in mixed) < 1e-5


def test_where_a_trace_is_flat_every_kernel_of_a_group_counts_alike() -> None:
    X, _ = traces(64)
    encoder = RocketEncoder(1, X.shape[-1], 1, 28, 5, 3, 2).eval()
    encoder.learn(torch.from_numpy(X), np.random.default_rng(0))
    flat = torch.full((1, 1, X.shape[-1]), float(X.mean()))
    flat[..., 0] += 1e-6  # as rounding would have it
    assert encoder.raw_features(flat)[0, encoder.towers[1]].reshape(-1, 8).min() > 0.7


def test_features_of_a_trace_are_computed_once_until_it_leaves_the_window(monkeypatch) -> None:
    X, y = traces(90)
    reducer, folds, computed, results = RocketReducer(), content_fold(X, 5), [], []
    raw = RocketEncoder.raw_features
    monkeypatch.setattr(
        RocketEncoder, "raw_features", lambda self, x: (computed.append(len(x)), raw(self, x))[1]
    )
    for first, last in ((0, 60), (30, 90), (30, 90), (0, 60)):
        reducer.train(
            X[first:last], y[first:last], folds[first:last], numbers=np.arange(1 + first, 1 + last)
        )
        results.append(sum(computed))
        computed.clear()
    assert results == [64, 32, 0, 32]  # whole chunks


def test_features_of_many_traces_are_those_of_each_to_the_bit() -> None:
    X, _ = traces(100)
    features = RocketReducer(folds=2).fit(*traces(100)).raw_features
    pieces = [features(X[i : i + 7]) for i in range(0, len(X), 7)]
    assert torch.equal(features(X), torch.cat(pieces))


@pytest.mark.parametrize("channels", [1, 3])
def test_windows_times_kernels_are_torchs_dilated_convolutions_at_the_places(channels: int) -> None:
    samples, dilations, kernels = 60, 3, 4
    encoder = RocketEncoder(channels, samples, 1, kernels, dilations, 3, 0)
    a = torch.randn(5, channels, samples, generator=torch.Generator().manual_seed(0))
    encoder.learn_filters(a, np.random.default_rng(0))
    result = torch.bmm(encoder.kernel, encoder.as_windows(encoder.read_taps(a), dilations)).view(
        dilations, kernels, -1, 5
    )
    middle = encoder.taps.view(dilations, 9, -1)[:, 4]
    for d, spread in enumerate((1, 2, 7)):  # 2 ** 0, and up to the length over 8
        weight = encoder.kernel[d].reshape(kernels, channels, 9)
        whole = torch.nn.functional.conv1d(
            a, weight, padding=4 * spread, dilation=spread
        )  # (5, kernels, samples)
        torch.testing.assert_close(result[d], whole[:, :, middle[d]].permute(1, 2, 0))


@pytest.mark.parametrize("samples", [400, 1000, 5000])
def test_traces_are_averaged_to_two_hundred_samples_but_not_where_that_loses_an_oscillation(
    samples: int,
) -> None:
    t = np.arange(samples)
    rng = np.random.default_rng(0)
    slow = np.sin(2 * np.pi * (3 * t / samples + rng.random((20, 1, 1)))).astype(np.float32)
    fast = np.sin(2 * np.pi * (0.3 * t + rng.random((20, 1, 1)))).astype(np.float32)
    assert averaging(torch.from_numpy(slow)) == samples // 200
    assert averaging(torch.from_numpy(fast)) == 1


@pytest.mark.parametrize("retrained_before", [True, False])
def test_an_opened_engine_has_the_features_that_its_next_retrain_needs(
    tmp_path, monkeypatch, retrained_before
) -> None:
    url, recipe = (
        str(tmp_path / "cell.sqlite"),
        Recipe("rocket", params={"kernels": 6, "width": 8}, retrain_every=40),
    )
    X, y = traces(120 if retrained_before else 520)
    if retrained_before:
        with DataEngine(recipe=recipe, store=url, replaying=True) as engine:
            for x, good in zip(X, y, strict=True):
                engine.report(engine.decide(x).id, bool(good))
                engine.poll()
    else:
        import_labelled(url, Dataset(X[:, 0], y), recipe)
    where, raw = set(), RocketEncoder.raw_features

    def told(self, x):
        if len(x) > N_EXAMPLES:  # so many are embedded to check a version
            where.add(threading.current_thread().name)
        return raw(self, x)

    monkeypatch.setattr(RocketEncoder, "raw_features", told)
    with DataEngine.open(url, replaying=True) as engine:
        assert engine.retrain().accepted
    assert where == {"dengine-precompute_0"}  # neither in the opening nor in the retrain


def test_a_model_of_other_sizes_is_refused_in_a_sentence_that_says_how_to_go_on() -> None:
    state = fitted(groups=0)[0].get_state()
    with pytest.raises(StoreError, match="other sizes; its labels are whole"):
        RocketReducer().set_state(state)
