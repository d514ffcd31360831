"""The trainer of PyTorch networks, with the shipped network and with a user's own."""

from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.special import expit, logit
from sklearn.base import clone
from torch import nn

from dengine import (
    ConvReducer,
    DataEngine,
    Dataset,
    ModelPrediction,
    Recipe,
    RocketReducer,
    TorchReducer,
)
from dengine.datasets.importing import import_labelled
from dengine.decision.scripting import script
from dengine.errors import SettingError, StoreError
from dengine.folds import content_fold
from dengine.reducers.base import StopRule
from dengine.reducers.checkpoints import load_checkpoint, save_checkpoint
from dengine.reducers.conv import HEAD_STEPS, ConvNetwork
from dengine.reducers.encoder import Members
from dengine.reducers.torch_reducer import Augmentation, draw_batches
from dengine.testing import toy_traces
from tests.support.command_line import dengine
from tests.support.driving import learn


class SmallNetwork(nn.Sequential):
    """A user's own network, in plain PyTorch."""

    def __init__(self, channels, samples):
        super().__init__(
            nn.Conv1d(channels, 6, 7, stride=4, padding=3),
            nn.BatchNorm1d(6),
            nn.ReLU(),
            nn.AdaptiveAvgPool1d(4),
            nn.Flatten(),
        )


class PythonNetwork(SmallNetwork):
    """One that TorchScript does not take."""

    def forward(self, x):
        return super().forward(torch.from_numpy(np.asarray(x.detach()))) + 0.0 * x.sum()


X, Y = toy_traces(60)
FOLDS = content_fold(X, 3)
DATA = Dataset(X[:, 0], Y.astype(np.int8))
SHARED = SmallNetwork(2, 120)


def quick(**params: Any) -> ConvReducer:
    return ConvReducer(**{"folds": 3, "steps": 4, "fit_steps": 30} | params)


def own_reducer(network=SmallNetwork) -> TorchReducer:
    return TorchReducer(network=network, folds=2, steps=4, fit_steps=30)


either_network = pytest.mark.parametrize("make", [quick, own_reducer], ids=["conv", "own network"])


def noise(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(0))


@either_network
def test_labels_of_fold_k_move_nothing_in_space_k_over_warm_starts_weights_averages_and_statistics(
    make,
):
    X, y = toy_traces(120)
    reducer, other = make(), make()
    folds = content_fold(X, reducer.folds)
    labels = np.where(folds == 1, np.random.default_rng(1).integers(2, size=120), y)
    for n in (40, 80, 120):
        reducer.train(X[:n], y[:n], folds[:n])
        other.train(X[:n], labels[:n], folds[:n])
        first, two = reducer.embed(X), other.embed(X)
        np.testing.assert_array_equal(first[:, 1], two[:, 1])
        assert not np.array_equal(first, two)  # the other members did see these labels


def test_from_its_state_a_reducer_trains_on_bit_for_bit():
    reducer = quick()
    reducer.train(X[:40], Y[:40], FOLDS[:40])
    restored = clone(reducer).set_state(reducer.get_state())
    points = reducer.train(X, Y, FOLDS)
    np.testing.assert_array_equal(restored.train(X, Y, FOLDS), points)
    np.testing.assert_array_equal(restored.embed(X), reducer.embed(X))
    np.testing.assert_allclose(points, reducer.embed_references(X, FOLDS), atol=1e-5)


def test_a_retrain_goes_on_with_the_moments_of_the_optimizer():
    reducer = quick()
    reducer.train(X, Y, FOLDS)
    state = reducer.get_state()
    kept = {name: state[name] for name in state if not name.startswith("optimizer.")}
    assert len(kept) < len(state)
    without = clone(reducer).set_state(kept)
    assert not np.array_equal(without.train(X, Y, FOLDS), reducer.train(X, Y, FOLDS))


def test_no_step_begins_after_the_deadline_and_the_reducer_answers_all_the_same():
    reducer = own_reducer()
    reducer.train(X, Y, content_fold(X, 2), StopRule(deadline=2.0, clock=count(0.0).__next__))
    assert reducer.report.n_steps == 2
    assert np.isfinite(reducer.embed(X)).all()


@either_network
def test_without_time_for_a_step_known_traces_keep_their_points_and_new_ones_are_embedded(make):
    reducer = make()
    folds = content_fold(X, reducer.folds)
    numbers = np.arange(60) * 2
    reducer.train(X[:40], Y[:40], folds[:40], numbers=numbers[:40])
    points = reducer.train(X[10:], Y[10:], folds[10:], StopRule(deadline=0.0), numbers[10:])
    assert reducer.report.n_steps == 0
    np.testing.assert_allclose(points, reducer.embed_references(X[10:], folds[10:]), atol=1e-5)
    trained = reducer.train(X, Y, folds, numbers=numbers)
    np.testing.assert_allclose(trained, reducer.embed_references(X, folds), atol=1e-5)
    assert not np.allclose(trained[10:], points)


def test_a_conv_that_was_stored_without_rocket_is_refused_with_what_to_do():
    state = quick().fit(X, Y).get_state()
    old = {name: array for name, array in state.items() if not name.startswith("rocket.")}
    with pytest.raises(StoreError, match="learn from them anew, by `dengine train"):
        quick().set_state(old)


def test_a_checkpoint_that_is_missing_is_named():
    with pytest.raises(SettingError, match="missing"):
        quick(checkpoint="missing.pt").fit(X, Y)


def test_conv_averages_the_logits_of_its_network_and_of_rocket():
    network = TorchReducer(network=ConvNetwork, folds=3, steps=4, fit_steps=30, random_state=3)
    rocket = RocketReducer(folds=3, random_state=3, max_iter=HEAD_STEPS)
    reducers = (network, rocket, quick(random_state=3))
    first, other, both = (reducer.fit(X, Y, folds=FOLDS).embed(X) for reducer in reducers)
    mean = expit((logit(first[:, :, 0]) + logit(other[:, :, 0])) / 2)
    np.testing.assert_allclose(both[:, :, 0], mean, atol=1e-5)
    np.testing.assert_array_equal(both[:, :, 1], first[:, :, 1])


def test_an_engine_waits_for_enough_labels_and_drops_no_retrain():
    recipe = Recipe("conv", {"folds": 2, "steps": 4, "fit_steps": 8}, radius=0.07, retrain_every=10)
    engine = DataEngine(recipe=recipe, replaying=True)
    reports = [engine.report(engine.decide(x).id, bool(y)) for x, y in zip(X[:40], Y, strict=False)]
    retrains = [(report.n_traces, report.accepted) for report in reports if report is not None]
    assert retrains == [(20, True), (30, True), (40, True)]


@pytest.mark.parametrize(("samples", "channels"), [(2, 3), (3, 1), (64, 1), (5000, 1)])
def test_traces_of_any_shape_are_embedded_finitely_and_alike_when_scripted(samples, channels):
    x = noise(24, channels, samples)
    reducer = quick(steps=1)
    reducer.train(x.numpy(), np.arange(24) % 2, np.arange(24) % 3)
    assert np.isfinite(reducer.embed(x.numpy())).all()
    scripted = script(reducer.module())
    for trace in x[:3, None]:
        with torch.inference_mode():
            expected = reducer.module()(trace)
            torch.testing.assert_close(scripted(trace), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("k", [0, 4])
def test_batches_hold_each_row_outside_the_fold_as_often_as_any_other(k):
    folds = np.arange(50) % 5
    batches = torch.stack([*draw_batches(folds, 5, 8, 10, np.random.default_rng(0))]).numpy()
    times = np.bincount(batches[:, :, k].flatten(), minlength=50)  # of (steps, B, K)
    assert times.tolist() == np.where(folds == k, 0, 2).tolist()


def test_mixed_traces_and_labels_lie_between_those_of_the_same_member():
    x = torch.arange(4.0)[:, None, None].repeat(2, 1, 1, 5)  # member k has traces of k
    y = torch.tensor([[0.0] * 4, [1.0] * 4])
    mixed, labels = Augmentation(0, 0.0, 0.0, 0.5)(x, y, np.random.default_rng(0))
    assert torch.equal(mixed, x)  # nothing of another member comes in
    assert ((labels >= 0.0) & (labels <= 1.0)).all()
    assert ((labels[0] <= 0.5) & (labels[1] >= 0.5)).all()


@pytest.mark.parametrize("network", [ConvNetwork, SmallNetwork])
def test_every_member_starts_from_the_weights_of_a_checkpoint(network, tmp_path):
    single, several = (Members(network, 2, 120, n).eval() for n in (1, 3))
    save_checkpoint(single, tmp_path / "encoder.pt")
    load_checkpoint(several, tmp_path / "encoder.pt")
    x = noise(4, 1, 2, 120)
    torch.testing.assert_close(several(x.expand(-1, 3, -1, -1)), single(x).expand(-1, 3))


@pytest.mark.parametrize(
    ("bias", "message"),
    [
        (None, "cannot be read"),
        (b"\x80\x02a.", "of named dense tensors alone"),  # a pickle whose stack is empty
        (3, "of named dense tensors alone"),
        (torch.zeros(1, 6), "finite weights of this network"),
        (torch.full((1, 2), np.nan), "finite weights of this network"),
        (torch.zeros(1, 2, device="meta"), "of named dense tensors alone"),
    ],
)
def test_a_file_that_is_no_checkpoint_of_this_network_is_refused(tmp_path, bias, message):
    path, members = tmp_path / "encoder.pt", Members(ConvNetwork, 2, 120, 1)
    if isinstance(bias, bytes):
        path.write_bytes(bias)
    elif bias is not None:
        torch.save(members.state_dict() | {"bias": bias}, path)
    with pytest.raises(SettingError, match=message):
        load_checkpoint(members, path)


class LayersInAnotherOrder(SmallNetwork):
    """Calls the layers of a Sequential one by one, and batch normalisation after the ReLU."""

    def forward(self, x):
        convolution, norm, relu, pool, flatten = self
        return flatten(pool(norm(relu(convolution(x)))))


def test_a_users_network_answers_as_its_own_forward_says():
    reducer = own_reducer(LayersInAnotherOrder).fit(X, Y)
    x = reducer.preprocessor_(torch.from_numpy(X)).unsqueeze(1).expand(-1, 2, -1, -1)
    with torch.no_grad():
        expected = reducer.averaged_members_(x).sigmoid()  # trained, and never compiled
    np.testing.assert_allclose(reducer.embed(X)[:, :, 0], expected, atol=1e-5)


def test_another_network_with_weights_of_the_same_sizes_is_not_restored():
    state = own_reducer().fit(X, Y).get_state()
    with pytest.raises(StoreError, match="the same sizes and is another one"):
        own_reducer(LayersInAnotherOrder).set_state(state)


def gives(output: Any) -> Any:
    """A network whose output is a function of its input."""

    class Network(nn.Module):
        def __init__(self, channels, samples):
            super().__init__()

        def forward(self, x):
            return output(x)

    return Network


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (gives(lambda x: x), r"for three traces it gives \(3, 2, 120\); flatten its output"),
        (gives(lambda x: (x, x)), "got tuple"),
        (gives(lambda x: x[:, 0, :0]), r"it gives \(3, 0\)"),
        (gives(lambda x: x[:, 0].long()), "it gives torch.int64, expected floats"),
        (lambda channels, samples: None, "NoneType"),
        (SHARED, "an instance of SmallNetwork.*pass its class"),
        (lambda channels, samples, members=1: SmallNetwork(channels, samples), "by `members`"),
        # or each member would see every label
        (lambda channels, samples: SHARED, "for each member, with weights of its own"),
    ],
)
def test_what_is_no_network_of_features_is_refused_in_a_sentence(network, message):
    with pytest.raises(SettingError, match=message):
        own_reducer(network).fit(X, Y)


def imported(folder: Path, **settings: Any) -> str:
    """A store with 40 labels that were imported, for a network of 24 steps."""
    params = {"folds": 2, "steps": 4, "fit_steps": 20}
    recipe, url = Recipe("conv", params, retrain_every=1000, **settings), f"{folder}/cell.db"
    import_labelled(url, Dataset(DATA.X[:40], DATA.y[:40]), recipe)
    return url


def test_a_retrain_without_time_for_a_step_is_not_repeated_at_every_part(tmp_path):
    with DataEngine.open(imported(tmp_path, budget=1e-3)) as engine:
        assert engine.retrain().n_steps == 0
        learn(engine, DATA, range(40, 60))
        assert engine.version == 1


def test_a_network_that_does_not_compile_answers_in_python_and_says_so(caplog):
    reducer = own_reducer(PythonNetwork).fit(X, Y)
    assert reducer.module() is None
    assert "PythonNetwork cannot be compiled by TorchScript" in caplog.text
    assert reducer.embed(X).shape == (60, 2, 2)


def network_of(sign: float) -> type:
    """A class as a notebook cell defines it that is run again: another one of the same name."""

    class Network(SmallNetwork):
        factor = sign

        def forward(self, x):
            return self.factor * super().forward(x)

    return Network


def test_two_networks_of_one_name_in_one_process_answer_each_for_itself():
    points = []
    for sign in (1.0, -1.0):
        model = ModelPrediction(own_reducer(network_of(sign)), folds=2).fit(X, Y)
        points.append([prediction.embedding for prediction in model.predict_many(X[:5])])
        np.testing.assert_allclose(points[-1], model.spaces.embed(X[:5]), atol=1e-6)
    assert not np.allclose(*points)


def test_an_engine_trains_on_after_an_import_a_retrain_per_cycle_until_its_steps_are_complete(
    tmp_path,
):
    url, left = imported(tmp_path), []
    with DataEngine.open(url, replaying=True) as engine:
        assert engine.retrain().accepted
        assert "12 steps to go" in dengine("status", url, "--json").output
        for i in range(40, 44):
            left.append(engine.model.report.n_steps_left)
            learn(engine, DATA, [i])
            engine.poll()
    assert left == [12, 4, 0, 0]
