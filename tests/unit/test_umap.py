"""UMAP in PyTorch agrees with umap-learn, goes on from training to training, and is restored."""

from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sklearn.manifold import trustworthiness
from sklearn.metrics import pairwise_distances
from sklearn.neighbors import NearestNeighbors
from torch import Tensor

from dengine import (
    Action,
    Dataset,
    ModelPrediction,
    UmapLearnReducer,
    UmapReducer,
    WilsonRadiusClassifier,
    load_dataset,
)
from dengine.decision.scripting import script
from dengine.errors import SettingError, StoreError
from dengine.reducers.base import StopRule
from dengine.reducers.umap_graph import (
    Neighbors,
    frames_for,
    fuzzy_simplicial_set,
    membership_strengths,
)
from dengine.reducers.umap_layout import (
    CLOSING_EPOCHS,
    Edges,
    attraction,
    find_ab_params,
    learning_rates,
    negative_samples,
    repulsion,
)
from dengine.testing import toy_traces

N = 400
NUMBERS = np.arange(1, N + 1)
Traces = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def insertion() -> Traces:
    """The first traces of the bundled set, (n, 1, T), and their labels."""
    data = load_dataset("insertion")
    return np.ascontiguousarray(data.X[:N, None], dtype=np.float32), np.asarray(data.y[:N])


@pytest.fixture(scope="module")
def fitted(insertion: Traces) -> UmapReducer:
    return UmapReducer().fit(insertion[0])


def train(reducer: UmapReducer, X: np.ndarray, numbers: np.ndarray, **limits: Any) -> np.ndarray:
    """Train as an engine does, on the traces of these labels' numbers, from 1."""
    labels = np.ones(len(numbers), dtype=np.int64)
    stop = StopRule(**limits)
    return reducer.train(X[numbers - 1], labels, labels, stop, numbers)




@pytest.fixture
def one_thread() -> Iterator[None]:
    """What umap-learn compiles sets the number of torch's threads."""
    yield
    torch.set_num_threads(1)




def test_the_neighbours_are_the_nearest_of_all_traces(fitted: UmapReducer) -> None:
    neighbors = fitted.neighbors_
    expected = NearestNeighbors(n_neighbors=15, algorithm="brute").fit(neighbors.frames)
    distances, indices = expected.kneighbors(neighbors.frames)  # the first is itself
    np.testing.assert_array_equal(neighbors.indices, indices[:, 1:])
    np.testing.assert_allclose(neighbors.distances, distances[:, 1:], rtol=1e-4, atol=1e-4)


# umap-learn compiles for half a minute: these are in `make test-all` alone.


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_the_membership_strengths_are_those_of_umap_learn(fitted: UmapReducer) -> None:
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
def test_the_places_are_as_good_as_those_of_umap_learn(
    insertion: Traces, fitted: UmapReducer
) -> None:
    theirs = quality(UmapLearnReducer().fit(insertion[0]).umap_.embedding_, insertion)
    assert (quality(fitted.embedding_, insertion) > theirs - 0.01).all()


def test_places_that_were_trained_warm_are_as_good_as_those_of_one_fit(
    insertion: Traces, fitted: UmapReducer
) -> None:
    warm, once = UmapReducer(), quality(fitted.embedding_, insertion)
    for n in range(100, N + 1, 100):
        places = train(warm, insertion[0], NUMBERS[:n])
    assert (quality(places, insertion) > once - [0.01, 0.02]).all()


@pytest.mark.parametrize(
    ("samples", "n_frames"), [(1, 1), (99, 99), (101, 101), (250, 125), (404, 101), (1000, 100)]
)
def test_frames_cover_the_whole_trace(samples: int, n_frames: int) -> None:
    X = np.random.default_rng(0).normal(size=(30, 2, 1)).repeat(samples, axis=2).astype(np.float32)
    frames = frames_for(X)
    assert frames.n_frames == n_frames
    # Constant traces: nothing averages out, so that each sample left out would shorten a distance.
    result = pairwise_distances(frames(torch.from_numpy(X)))
    np.testing.assert_allclose(result, pairwise_distances(X.reshape(30, -1)), rtol=1e-3, atol=1e-3)


def test_an_oscillation_is_not_averaged_away() -> None:
    phase = np.random.default_rng(0).uniform(0.0, 6.28, size=(40, 1, 1))
    X = np.sin(2.5 * np.arange(1000) + phase).astype(np.float32)
    assert frames_for(X).n_frames == 1000


def test_kept_neighbours_are_those_of_a_search_among_all(insertion: Traces) -> None:
    X, _ = insertion
    make_frames = frames_for(X)
    none = kept = Neighbors.empty(make_frames.n_features, 14)
    # Some arrive, the oldest or single ones leave.
    for numbers in (NUMBERS[:50], NUMBERS[10:90], NUMBERS[20:130:2], NUMBERS[30:400]):
        kept = kept.update(X[numbers - 1], numbers, make_frames)
        anew = none.update(X[numbers - 1], numbers, make_frames)
        np.testing.assert_array_equal(kept.indices, anew.indices)
        np.testing.assert_allclose(kept.distances, anew.distances, rtol=1e-5)


def test_places_stay_with_their_labels_when_the_oldest_leave(insertion: Traces) -> None:
    X, _ = insertion
    reducer = UmapReducer()
    before = train(reducer, X, NUMBERS[:300])
    after = train(reducer, X, NUMBERS[60:320], max_steps=0)  # no epoch moves a place
    np.testing.assert_array_equal(after[:240], before[60:])
    new = reducer.transform(X[300:320])
    assert np.linalg.norm(after[240:] - new, axis=1).mean() < 0.1 * before.std()


def test_a_training_on_other_traces_starts_anew(insertion: Traces) -> None:
    X, _ = insertion
    reducer = UmapReducer()
    train(reducer, X, NUMBERS[:100])
    places = train(reducer, X, NUMBERS[100:])
    np.testing.assert_array_equal(places, train(UmapReducer(), X, NUMBERS[100:]))


def test_looking_ahead_changes_no_place(insertion: Traces) -> None:
    X, _ = insertion
    plain, ahead = UmapReducer(), UmapReducer()
    for n in (200, 260):
        ahead.precompute(X[:n], NUMBERS[:n])
        result = train(ahead, X, NUMBERS[:n])
        np.testing.assert_array_equal(result, train(plain, X, NUMBERS[:n]))


def test_state_is_restored_bit_for_bit_over_further_trainings(insertion: Traces) -> None:
    X, _ = insertion
    reducer = UmapReducer(random_state=None)
    train(reducer, X, NUMBERS[:90])
    restored = UmapReducer(random_state=None).set_state(reducer.get_state())
    assert restored.report == reducer.report
    np.testing.assert_array_equal(restored.transform(X[::8]), reducer.transform(X[::8]))
    for numbers in (NUMBERS[:110], NUMBERS[40:130]):
        np.testing.assert_array_equal(train(restored, X, numbers), train(reducer, X, numbers))


def test_the_scripted_module_is_the_eager_one_bit_for_bit(
    insertion: Traces,
    fitted: UmapReducer,
) -> None:
    x = torch.from_numpy(insertion[0][::4])
    module = fitted.module()
    scripted = script(module)
    with torch.inference_mode():
        for word in x.split(1):
            assert torch.equal(scripted(word), module(word))
        torch.testing.assert_close(scripted(x), module(x), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("n", [17, 256, 257])
def test_empty_slots_of_the_module_attract_nothing(insertion: Traces, n: int) -> None:
    X, _ = insertion
    reducer = UmapReducer(n_epochs=5).fit(X[:n])
    assert len(reducer.module().references) in (256, 512)
    references = reducer.embedding_.numpy()
    places = reducer.transform(np.concatenate([X[::8], 1e4 - 1e4 * X[::8]]))
    assert (places >= references.min(0) - 1e-3).all()
    assert (places <= references.max(0) + 1e-3).all()


@pytest.mark.merge  # ONNX needs seconds
@pytest.mark.parametrize("form", ["onnx", "torchscript"])
def test_an_export_decides_as_the_model_does(
    form: str, make_data: Callable[..., Dataset], tmp_path: Path
) -> None:
    pytest.importorskip("onnxscript")
    from dengine.export import export_onnx, export_torchscript, load_exported, load_onnx

    data, new = make_data(300), make_data(100, seed=9).X
    model = ModelPrediction("umap", WilsonRadiusClassifier(0.5, 0.2, 0.8)).fit(data.X, data.y)
    export, load = {
        "onnx": (export_onnx, load_onnx),
        "torchscript": (export_torchscript, load_exported),
    }[form]
    exported = load(export(model, tmp_path / "model"))
    expected, decided = model.predict_many(new), [*map(exported.decide, new)]
    assert {Action.ACCEPT, Action.REJECT} <= {item.action for item in expected}
    assert [item.action for item in decided] == [item.action for item in expected]
    places = [[item.embedding for item in items] for items in (decided, expected)]
    np.testing.assert_allclose(*places, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("n_neighbors", 15, "UMAP needs more than 15 traces, got n_samples = 15"),
        ("n_components", 0, "Expected n_components from 1 to 100, got 0"),
        ("n_neighbors", 1, "Expected n_neighbors from 2 to 1000, got 1"),
        ("min_dist", 1.5, "Expected min_dist from 0 to 1, got 1.5"),
        ("n_epochs", 0, "Expected n_epochs of 1 or more, got 0"),
    ],
)
def test_too_few_traces_or_a_parameter_out_of_range_is_a_setting_error(
    name: str, value: Any, message: str
) -> None:
    X, _ = toy_traces(15)
    reducer = UmapReducer(**{name: value})
    with pytest.raises(SettingError, match=message):
        reducer.fit(X)
    with pytest.raises(SettingError, match=message):
        train(reducer, X, NUMBERS[:15])


def test_traces_that_are_all_the_same_have_finite_places() -> None:
    X = np.ones((60, 1, 50), dtype=np.float32)
    reducer = UmapReducer().fit(X)
    assert np.isfinite(reducer.embedding_.numpy()).all()
    assert np.isfinite(reducer.transform(X)).all()


@pytest.mark.parametrize("unit", [1e-12, 1e12])
def test_the_unit_of_the_traces_does_not_matter(
    insertion: Traces, fitted: UmapReducer, unit: float
) -> None:
    X, _ = insertion
    scaled = UmapReducer(n_epochs=50).fit((unit * X).astype(np.float32))
    np.testing.assert_array_equal(scaled.neighbors_.indices, fitted.neighbors_.indices)
    assert trustworthiness(X[:, 0], scaled.embedding_) > 0.97


def test_a_cluster_apart_is_laid_out_as_well_as_the_others() -> None:
    rng = np.random.default_rng(0)
    X = rng.normal(size=(200, 1, 1)) * np.linspace(0.0, 1.0, 60)
    X += 0.02 * rng.normal(size=X.shape)
    X[:80] += 1000.0
    places = UmapReducer().fit(X.astype(np.float32)).embedding_
    for rows in (slice(0, 80), slice(80, 200)):
        assert trustworthiness(X[rows, 0], places[rows], n_neighbors=10) > 0.95




def test_a_clock_that_ends_a_layout_leaves_no_high_rate(insertion: Traces) -> None:
    stop = StopRule(deadline=20.0, clock=count(1.0).__next__)
    rates = list(learning_rates(100, stop))
    assert (stop.late, len(rates)) == (True, 19 + CLOSING_EPOCHS)
    assert (np.diff(rates) < 0.0).all()
    assert 0.0 < rates[-1] < 0.1


@pytest.mark.parametrize(("limits", "n_steps"), [({"deadline": 20.0}, 29), ({"max_steps": 8}, 8)])
def test_what_a_limit_leaves_out_is_done_in_the_next_training(
    insertion: Traces, limits: dict[str, Any], n_steps: int
) -> None:
    reducer = UmapReducer()
    for options, steps in ((limits, n_steps), ({}, 200 - n_steps)):
        train(reducer, insertion[0], NUMBERS[:100], clock=count(1.0).__next__, **options)
        assert reducer.report.n_steps == steps


def test_a_layout_of_many_traces_takes_several_trainings() -> None:
    X, _ = toy_traces(3000, samples=20)
    reducer, steps = UmapReducer(), []
    while not steps or reducer.report.n_steps_left:
        train(reducer, X, np.arange(1, 3001))
        steps.append(reducer.report.n_steps)
    assert steps == [133, 67]
    assert [reducer.n_epochs_due(n) for n in (3000, 10_000, 100)] == [80, 40, 200]




def test_attraction_is_the_gradient_of_the_cross_entropy(fitted: UmapReducer) -> None:
    a, b = find_ab_params(0.1)
    neighbors = fitted.neighbors_
    strengths = membership_strengths(neighbors.distances, 15)
    edges = Edges.from_graph(fuzzy_simplicial_set(neighbors.indices, strengths))
    places = torch.randn(2, N, generator=torch.Generator().manual_seed(0)).requires_grad_()
    squared = (places[:, edges.head] - places[:, edges.tail]).square().sum(0)
    # Of the membership strengths, without pairs that have no edge.
    (edges.strength * torch.log(1.0 + a * squared.pow(b))).sum().backward()
    pull, stiffness = attraction(places.detach(), edges, a, b)
    torch.testing.assert_close(pull, -places.grad, rtol=1e-3, atol=1e-3)
    assert (stiffness > 0.0).all()


def test_repulsion_is_the_gradient_of_the_cross_entropy_of_places_that_are_apart() -> None:
    a, b = find_ab_params(0.1)
    places = torch.zeros(2, 1, requires_grad=True)
    samples = 3.0 * torch.nn.functional.normalize(torch.randn(2, 1, 8), dim=0)
    squared = (places.unsqueeze(2) - samples).square().sum(0)
    (-torch.log(1.0 - 1.0 / (1.0 + a * squared.pow(b)))).mean().backward()
    push = repulsion(places.detach(), samples, a, b)
    torch.testing.assert_close(push, -places.grad, rtol=1e-3, atol=1e-5)


def test_negative_samples_are_other_places_each_drawn_equally_often() -> None:
    places = torch.arange(50.0).unsqueeze(0)
    order, samples = negative_samples(places, 16, torch.Generator().manual_seed(0))
    assert samples.shape == (1, 50, 16)
    assert sorted(order.tolist()) == list(range(50))
    assert (samples != places[:, order].unsqueeze(2)).all()
    assert (torch.bincount(samples.flatten().long()) == 16).all()


def test_points_of_another_umap_are_not_counted_with_this_one() -> None:
    model = ModelPrediction("umap").fit(*toy_traces(60))
    state = {name: v for name, v in model.get_state().items() if not name.startswith("reducer.")}
    with pytest.raises(StoreError, match=r"whose UmapReducer has no state; .*dengine train"):
        model.set_state(state)
