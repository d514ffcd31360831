"""UMAP in PyTorch agrees with umap-learn, goes on from training to training, and is restored."""

from itertools import count
from typing import Any

import numpy as np
import pytest
import torch
from sklearn.manifold import trustworthiness
from sklearn.metrics import pairwise_distances
from sklearn.neighbors import NearestNeighbors

from dengine import (
    Action,
    ModelPrediction,
    UmapLearnReducer,
    UmapReducer,
    WilsonRadiusClassifier,
    load_dataset,
)
from dengine.errors import SettingError, StoreError
from dengine.reducers.base import StopRule
from dengine.reducers.umap_graph import (
    Neighbors,
    frames_for,
    fuzzy_simplicial_set,
    membership_strengths,
)
from dengine.reducers.umap_layout import (
    find_ab_params,
)
from dengine.testing import toy_traces

N = 400
NUMBERS = np.arange(1, N + 1)
Traces = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def insertion():
    """The first traces of the bundled set, (n, 1, T), and their labels."""
    data = load_dataset("insertion")
    return np.ascontiguousarray(data.X[:N, None], dtype=np.float32), np.asarray(data.y[:N])


@pytest.fixture(scope="module")
def fitted(insertion):
    return UmapReducer().fit(insertion[0])


def train(reducer: UmapReducer, X: np.ndarray, numbers: np.ndarray, **limits: Any) -> np.ndarray:
    """Train as an engine does, on the traces of these labels' numbers, from 1."""
    labels = np.ones(len(numbers), dtype=np.int64)
    return reducer.train(X[numbers - 1], labels, labels, StopRule(**limits), numbers)


@pytest.fixture
def one_thread():
    """What umap-learn compiles sets the number of torch's threads."""
    yield
    torch.set_num_threads(1)


def test_the_neighbours_are_the_nearest_of_all_traces(fitted):
    neighbors = fitted.neighbors_
    expected = NearestNeighbors(n_neighbors=15, algorithm="brute").fit(neighbors.frames)
    distances, indices = expected.kneighbors(neighbors.frames)  # the first is itself
    np.testing.assert_array_equal(neighbors.indices, indices[:, 1:])
    np.testing.assert_allclose(neighbors.distances, distances[:, 1:], rtol=1e-4, atol=1e-4)


# umap-learn compiles for half a minute: these are in `make test-all` alone.


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_the_membership_strengths_are_those_of_umap_learn(fitted):
    from umap import umap_

    neighbors = fitted.neighbors_
    distances = pairwise_distances(neighbors.frames).astype(np.float32)
    expected, _, _ = umap_.fuzzy_simplicial_set(distances, 15, None, "precomputed")
    strengths = membership_strengths(neighbors.distances, 15)
    assert abs(fuzzy_simplicial_set(neighbors.indices, strengths) - expected).max() < 1e-4
    assert find_ab_params(0.1) == pytest.approx(umap_.find_ab_params(1.0, 0.1), rel=1e-6)


def quality(places: Any, traces: Traces) -> np.ndarray:
    """Trustworthiness, and the share of traces whose label most of the 15 nearest others have."""
    X, labels = traces
    nearest = NearestNeighbors(n_neighbors=15).fit(places).kneighbors()[1]
    agreement = ((labels[nearest].mean(1) > 0.5) == labels).mean()
    return np.array([trustworthiness(X[:, 0], places, n_neighbors=15), agreement])


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_the_places_are_as_good_as_those_of_umap_learn(insertion, fitted):
    theirs = quality(UmapLearnReducer().fit(insertion[0]).umap_.embedding_, insertion)
    assert (quality(fitted.embedding_, insertion) > theirs - 0.01).all()


def test_places_that_were_trained_warm_are_as_good_as_those_of_one_fit(insertion, fitted):
    warm, once = UmapReducer(), quality(fitted.embedding_, insertion)
    for n in range(100, N + 1, 100):
        places = train(warm, insertion[0], NUMBERS[:n])
    assert (quality(places, insertion) > once - [0.01, 0.02]).all()


@pytest.mark.parametrize(
    ("samples", "n_frames"), [(1, 1), (99, 99), (101, 101), (250, 125), (404, 101), (1000, 100)]
)
def test_frames_cover_the_whole_trace(samples, n_frames):
    X = np.random.default_rng(0).normal(size=(30, 2, 1)).repeat(samples, axis=2).astype(np.float32)
    frames = frames_for(X)
    assert frames.n_frames == n_frames
    # Constant traces: nothing averages out, so that each sample left out would shorten a distance.
    result = pairwise_distances(frames(torch.from_numpy(X)))
    np.testing.assert_allclose(result, pairwise_distances(X.reshape(30, -1)), rtol=1e-3, atol=1e-3)


def test_an_oscillation_is_not_averaged_away():
    phase = np.random.default_rng(0).uniform(0.0, 6.28, size=(40, 1, 1))
    assert frames_for(np.sin(2.5 * np.arange(1000) + phase).astype(np.float32)).n_frames == 1000


def test_kept_neighbours_are_those_of_a_search_among_all(insertion):
    X, _ = insertion
    make_frames = frames_for(X)
    none = kept = Neighbors.empty(make_frames.n_features, 14)
    # Some arrive, the oldest or single ones leave.
    for numbers in (NUMBERS[:50], NUMBERS[10:90], NUMBERS[20:130:2], NUMBERS[30:400]):
        kept = kept.update(X[numbers - 1], numbers, make_frames)
        anew = none.update(X[numbers - 1], numbers, make_frames)
        np.testing.assert_array_equal(kept.indices, anew.indices)
        np.testing.assert_allclose(kept.distances, anew.distances, rtol=1e-5)


def test_places_stay_with_their_labels_when_the_oldest_leave(insertion):
    X, _ = insertion
    reducer = UmapReducer()
    before = train(reducer, X, NUMBERS[:300])
    after = train(reducer, X, NUMBERS[60:320], max_steps=0)  # no epoch moves a place
    np.testing.assert_array_equal(after[:240], before[60:])
    new = reducer.transform(X[300:320])
    assert np.linalg.norm(after[240:] - new, axis=1).mean() < 0.1 * before.std()


def test_looking_ahead_changes_no_place(insertion):
    X, _ = insertion
    plain, ahead = UmapReducer(), UmapReducer()
    for n in (200, 260):
        ahead.precompute(X[:n], NUMBERS[:n])
        np.testing.assert_array_equal(train(ahead, X, NUMBERS[:n]), train(plain, X, NUMBERS[:n]))


def test_state_is_restored_bit_for_bit_over_further_trainings(insertion):
    X, _ = insertion
    reducer = UmapReducer(random_state=None)
    train(reducer, X, NUMBERS[:90])
    restored = UmapReducer(random_state=None).set_state(reducer.get_state())
    assert restored.report == reducer.report
    np.testing.assert_array_equal(restored.transform(X[::8]), reducer.transform(X[::8]))
    for numbers in (NUMBERS[:110], NUMBERS[40:130]):
        np.testing.assert_array_equal(train(restored, X, numbers), train(reducer, X, numbers))


@pytest.mark.parametrize("n", [17, 256, 257])
def test_empty_slots_of_the_module_attract_nothing(insertion, n):
    X, _ = insertion
    reducer = UmapReducer(n_epochs=5).fit(X[:n])
    assert len(reducer.module().references) in (256, 512)
    references = reducer.embedding_.numpy()
    places = reducer.transform(np.concatenate([X[::8], 1e4 - 1e4 * X[::8]]))
    assert (places >= references.min(0) - 1e-3).all()
    assert (places <= references.max(0) + 1e-3).all()


@pytest.mark.merge  # ONNX needs seconds
def test_an_onnx_file_decides_as_the_model_does(make_data, tmp_path):
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    from dengine.export import export_onnx, load_onnx

    data, new = make_data(300), make_data(100, seed=9).X
    model = ModelPrediction("umap", WilsonRadiusClassifier(0.5, 0.2, 0.8)).fit(data.X, data.y)
    exported = load_onnx(export_onnx(model, tmp_path / "model.onnx"))
    expected, decided = model.predict_many(new), [*map(exported.decide, new)]
    assert {Action.ACCEPT, Action.REJECT} <= {item.action for item in expected}
    assert [item.action for item in decided] == [item.action for item in expected]
    places = [[item.embedding for item in items] for items in (decided, expected)]
    np.testing.assert_allclose(*places, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("n_neighbors", 15, "UMAP needs more than 15 traces, got n_samples = 15"),
        ("n_components", 0, "Expected n_components from 1 to 100, an integer, got 0"),
        ("n_neighbors", 1, "Expected n_neighbors from 2 to 1000, an integer, got 1"),
        ("min_dist", 1.5, "Expected min_dist from 0 to 1, got 1.5"),
        ("n_epochs", 0, "Expected n_epochs of 1 or more, got 0"),
    ],
)
def test_too_few_traces_or_a_parameter_out_of_range_is_a_setting_error(name, value, message):
    X, _ = toy_traces(15)
    reducer = UmapReducer(**{name: value})
    with pytest.raises(SettingError, match=message):
        reducer.fit(X)
    with pytest.raises(SettingError, match=message):
        train(reducer, X, NUMBERS[:15])


def test_traces_that_are_all_the_same_have_finite_places():
    X = np.ones((60, 1, 50), dtype=np.float32)
    reducer = UmapReducer().fit(X)
    assert np.isfinite(reducer.embedding_.numpy()).all()
    assert np.isfinite(reducer.transform(X)).all()


@pytest.mark.parametrize("unit", [1e-12, 1e12])
def test_the_unit_of_the_traces_does_not_matter(insertion, fitted, unit):
    X, _ = insertion
    scaled = UmapReducer(n_epochs=50).fit((unit * X).astype(np.float32))
    np.testing.assert_array_equal(scaled.neighbors_.indices, fitted.neighbors_.indices)
    assert trustworthiness(X[:, 0], scaled.embedding_) > 0.97


@pytest.mark.parametrize(("limits", "n_steps"), [({"deadline": 20.0}, 29), ({"max_steps": 8}, 8)])
def test_what_a_limit_leaves_out_is_done_in_the_next_training(insertion, limits, n_steps):
    reducer = UmapReducer()
    for options, steps in ((limits, n_steps), ({}, 200 - n_steps)):
        train(reducer, insertion[0], NUMBERS[:100], clock=count(1.0).__next__, **options)
        assert reducer.report.n_steps == steps


def test_a_layout_of_many_traces_takes_several_trainings():
    X, _ = toy_traces(3000, samples=20)
    reducer, steps = UmapReducer(), []
    while not steps or reducer.report.n_steps_left:
        train(reducer, X, np.arange(1, 3001))
        steps.append(reducer.report.n_steps)
    assert steps == [133, 67]


def test_points_of_another_umap_are_not_counted_with_this_one():
    model = ModelPrediction("umap").fit(*toy_traces(60))
    state = {name: v for name, v in model.get_state().items() if not name.startswith("reducer.")}
    with pytest.raises(StoreError, match=r"whose UmapReducer has no state; .*dengine train"):
        model.set_state(state)
