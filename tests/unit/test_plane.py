"""The plane: neighbours among the features stay neighbours, no label is read, and a training goes on from the last one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from sklearn.decomposition import PCA
from sklearn.manifold import trustworthiness
from sklearn.utils.estimator_checks import parametrize_with_checks

from dengine.decision.rule import script
from dengine.errors import SettingError
from dengine.reducers import PlaneReducer, UmapReducer, make_reducer
from dengine.reducers.base import StopRule
from dengine.reducers.fuzzy_graph import A, B, cross_entropy, fuzzy_graph
from dengine.testing import REDUCER_CHECKS, any_length_and_several_channels_work, the_same_traces_give_the_same_embedding


def traces(n: int = 240, samples: int = 120, seed: int = 0) -> np.ndarray:
    """(n, 1, T) bumps of three kinds; place, height and width of each kind vary: more than a flat plane can hold."""
    rng = np.random.default_rng(seed)
    kind = rng.integers(3, size=(n, 1, 1))
    place = 0.25 + 0.25 * kind + rng.uniform(-0.08, 0.08, size=(n, 1, 1))
    width = rng.uniform(0.02, 0.1, size=(n, 1, 1))
    t = np.linspace(0.0, 1.0, samples)
    X = np.exp(-(((t - place) / width) ** 2)) * rng.uniform(5, 15, size=(n, 1, 1))
    return (X + 0.2 * rng.normal(size=(n, 1, samples))).astype(np.float32)


def train(reducer: PlaneReducer, X: np.ndarray, y: int = 1, stop: StopRule | None = None) -> np.ndarray:
    """The engine's way, every label the same."""
    return reducer.train(X, np.full(len(X), y), np.zeros(len(X), dtype=np.int64), stop)


def features(reducer: PlaneReducer, X: np.ndarray) -> np.ndarray:
    with torch.inference_mode():
        return reducer.net_.encoder(torch.from_numpy(X)).numpy()


@pytest.mark.parametrize("check", REDUCER_CHECKS, ids=lambda check: check.__name__)
def test_it_keeps_the_contract(check) -> None:
    check(PlaneReducer())


@parametrize_with_checks([PlaneReducer()])
def test_scikit_learns_estimator_checks_pass(estimator, check) -> None:
    check(estimator)


def test_a_seed_repeats_exactly_and_another_gives_another_plane() -> None:
    X = traces()
    one, same, other = (PlaneReducer(random_state=seed) for seed in (3, 3, 4))
    for n in (120, 240):
        a, b, c = (train(each, X[:n]) for each in (one, same, other))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)


def test_neighbours_among_the_features_stay_neighbours_better_than_in_a_plane_of_principal_components() -> None:
    X, new = traces(400), traces(300, seed=1)
    reducer = PlaneReducer(n_steps=200).fit(X)
    g = features(reducer, new)
    flat = PCA(2, random_state=0).fit(features(reducer, X)).transform(g)
    laid_out, straight = (1.0 - trustworthiness(g, Z, n_neighbors=10) for Z in (reducer.transform(new), flat))
    assert laid_out < 0.85 * straight


def test_no_label_moves_anything() -> None:
    X = traces()
    one, other = PlaneReducer(), PlaneReducer()
    for n in (120, 240):
        np.testing.assert_array_equal(train(one, X[:n], y=1), train(other, X[:n], y=0))
    np.testing.assert_array_equal(one.embed(X), other.embed(X))


def test_a_restored_one_is_the_same_bit_for_bit_and_goes_on_training_the_same() -> None:
    X = traces()
    reducer = PlaneReducer()
    train(reducer, X[:150])
    restored = PlaneReducer().set_state(reducer.get_state())
    np.testing.assert_array_equal(restored.embed(X), reducer.embed(X))
    np.testing.assert_array_equal(train(restored, X), train(reducer, X))
    assert restored.report == reducer.report


def test_what_is_exported_embeds_as_it_does() -> None:
    X = traces()
    reducer = PlaneReducer().fit(X)
    with torch.inference_mode():
        Z = script(reducer.module())(torch.from_numpy(X)).numpy()
    assert Z.shape == (240, 1, 2)
    np.testing.assert_allclose(Z, reducer.embed(X), rtol=1e-5, atol=1e-5)


def test_a_training_goes_on_where_the_last_one_ended_instead_of_turning_the_picture_around() -> None:
    X = traces()
    reducer = PlaneReducer()
    before = train(reducer, X[:200])
    kernels = reducer.net_.encoder.kernel.clone()
    after = train(reducer, X, stop=StopRule(max_steps=0))[:200]
    assert torch.equal(reducer.net_.encoder.kernel, kernels)
    moved = np.linalg.norm((after - after.mean(0)) - (before - before.mean(0)), axis=1)
    assert np.median(moved) < 0.1 * np.linalg.norm(before - before.mean(0), axis=1).mean()


def test_traces_lie_where_training_said_also_those_that_were_trained_on_before() -> None:
    X = traces()
    reducer = PlaneReducer()
    train(reducer, X[:150])
    points = train(reducer, np.concatenate([X[100:], X[:1], X[:1]]))  # some known, some new, one twice, some gone
    np.testing.assert_allclose(points, reducer.embed(np.concatenate([X[100:], X[:1], X[:1]]))[:, 0], atol=1e-4)


@pytest.mark.parametrize("stop", [StopRule(max_steps=0), StopRule(deadline=0.0)])
def test_without_a_step_it_is_the_plane_of_the_first_principal_components(stop: StopRule) -> None:
    X = traces()
    reducer = PlaneReducer()
    points = train(reducer, X, stop=stop)
    assert reducer.report.n_steps == 0
    g = features(reducer, X)[:, :2]
    np.testing.assert_allclose(points / points.std(), g / g.std(), atol=1e-3)


def test_a_stop_rule_and_its_own_setting_limit_the_steps() -> None:
    X = traces(60)
    for n_steps, most, expected in ((5, None, 5), (5, 3, 3), (3, 5, 3)):
        reducer, stop = PlaneReducer(n_steps=n_steps), StopRule(max_steps=most)
        train(reducer, X, stop=stop)
        assert reducer.report.n_steps == expected
        assert stop.asked_at is not None


@pytest.mark.parametrize("setting", [{"n_components": 0}, {"n_neighbors": 1}, {"n_steps": -1}, {"n_steps": 2.0}])
def test_a_setting_out_of_its_range_is_named(setting: dict[str, float]) -> None:
    with pytest.raises(SettingError, match=next(iter(setting))):
        PlaneReducer(**setting).fit(traces(20))


# ----------------------------------------------------------------------------------------------- the graph and its loss


def test_memberships_of_the_nearest_are_one_and_those_of_all_sum_to_the_logarithm_of_k() -> None:
    g = torch.from_numpy(np.random.default_rng(0).normal(size=(80, 5)).astype(np.float32))
    i, j, membership = fuzzy_graph(g, 8)
    weight = torch.zeros(80, 80)
    weight[i, j] = membership
    torch.testing.assert_close(weight, weight.T)
    assert ((membership > 0) & (membership <= 1 + 1e-6)).all()
    nearest = (torch.cdist(g, g) + 1e9 * torch.eye(80)).argmin(1)
    torch.testing.assert_close(weight[torch.arange(80), nearest], torch.ones(80))
    assert (weight.sum(1) >= np.log2(8) - 1e-3).all()  # its own k sum to that; others may add theirs


def test_the_graph_is_umap_learns() -> None:
    umap_ = pytest.importorskip("umap.umap_")
    X = np.random.default_rng(1).normal(size=(60, 4)).astype(np.float32)
    theirs = umap_.fuzzy_simplicial_set(X, 9, np.random.RandomState(0), "euclidean")[0].toarray()
    i, j, membership = fuzzy_graph(torch.from_numpy(X), 8)  # umap-learn counts a trace as its own neighbour
    ours = np.zeros((60, 60))
    ours[i, j] = membership
    assert ((ours > 0) == (theirs > 0)).mean() > 0.99
    assert np.abs(ours - theirs).max() < 0.1  # theirs sums to log2(9), ours to log2(8)


def test_the_loss_is_the_cross_entropy_of_umaps_similarity() -> None:
    rng = np.random.default_rng(2)
    z, others = rng.normal(size=(7, 2)), rng.normal(size=(3, 7, 2))
    similarity = 1.0 / (1.0 + A * np.square(z - others).sum(2) ** B)
    expected = -(np.log(similarity[0]).sum() + np.log(1.0 - similarity[1:]).sum()) / similarity.size
    assert float(cross_entropy(torch.from_numpy(z), torch.from_numpy(others))) == pytest.approx(expected, rel=1e-2)


# ---------------------------------------------------------------------------------------------------- UMAP's own, encoded


def small_umap(**params) -> UmapReducer:
    return make_reducer("umap", n_epochs=40, n_neighbors=8, **params)


def test_an_encoded_umap_repeats_exactly_and_lays_out_features_instead_of_samples() -> None:
    X = traces(100)
    one, same, raw = small_umap(encoded=True).fit(X), small_umap(encoded=True).fit(X), small_umap().fit(X)
    np.testing.assert_array_equal(one.transform(X[:20]), same.transform(X[:20]))
    assert one.umap_._raw_data.shape[1] == one.encoder_.n_out == 128
    assert raw.umap_._raw_data.shape[1] == X.shape[2]
    assert "encoder_" not in vars(raw)
    assert trustworthiness(one._rows(X), one.umap_.embedding_, n_neighbors=8) > 0.85


@pytest.mark.parametrize(
    "check",
    [any_length_and_several_channels_work, the_same_traces_give_the_same_embedding],
    ids=lambda check: check.__name__,
)
def test_an_encoded_umap_keeps_what_of_the_contract_its_encoder_could_break(check) -> None:
    check(small_umap(encoded=True, random_state=0))
