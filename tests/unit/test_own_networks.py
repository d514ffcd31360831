"""Networks of users: a version answers as it was trained, can be opened again, or is dropped. What
can never be learned from, such as a tiny window or tiny traces, is told in a sentence.
"""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sklearn.decomposition import PCA
from torch import nn

from dengine import (
    DataEngine,
    ModelPrediction,
    PcaReducer,
    Recipe,
    TorchReducer,
    export_torchscript,
)
from dengine.errors import ExportError, SettingError
from dengine.testing import check_reducer, toy_traces

COUNTER = itertools.count()


class Network(nn.Module):
    """Eight features, which a subclass turns into others."""

    def __init__(self, channels, samples):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv1d(channels, 8, 7, stride=4, padding=3),
            nn.BatchNorm1d(8),
            nn.ReLU(),
            nn.AdaptiveMaxPool1d(1),
            nn.Flatten(),
        )

    def forward(self, x):
        return self.layers(x)


class TiedWeights(Network):
    def __init__(self, *shape):
        super().__init__(*shape)
        self.first, self.second = nn.Linear(8, 8), nn.Linear(8, 8)
        self.second.weight = self.first.weight

    def forward(self, x):
        return self.second(self.first(self.layers(x)).relu())


class Recurrent(nn.Module):
    """torch keeps the weights of a GRU a second time, in a list."""

    def __init__(self, channels, samples):
        super().__init__()
        self.layer = nn.GRU(channels, 8, batch_first=True)

    def forward(self, x):
        return self.layer(x.transpose(1, 2)[:, ::8])[0][:, -1]


class UnsavedBuffer(Network):
    def __init__(self, *shape):
        super().__init__(*shape)
        self.register_buffer("gain", torch.randn(8), persistent=False)

    def forward(self, x):
        return self.layers(x) * self.gain


class ChangedInTraining(Network):
    """Keeps a tensor that torch does not know of."""

    def __init__(self, *shape):
        super().__init__(*shape)
        self.gain = torch.randn(8)

    def forward(self, x):
        if self.training:
            self.gain.mul_(0.99)
        return self.layers(x) * self.gain


class WeightNorm(Network):
    """TorchScript compiles it, and cannot run it."""

    def __init__(self, *shape):
        super().__init__(*shape)
        self.head = nn.utils.parametrizations.weight_norm(nn.Linear(8, 8))

    def forward(self, x):
        return self.head(self.layers(x))


class RandomAnswer(Network):
    def forward(self, x):
        return nn.functional.dropout(self.layers(x), 0.3, True)


class CountsItsCalls(Network):
    def __init__(self, *shape):
        super().__init__(*shape)
        self.register_buffer("calls", torch.zeros(1))

    def forward(self, x):
        self.calls += 1
        return self.layers(x) + 0.01 * self.calls


class NumberOfElsewhere(Network):
    """Another number at each start of a program."""

    def __init__(self, *shape):
        super().__init__(*shape)
        self.gain = 1.0 + next(COUNTER)

    def forward(self, x):
        return self.layers(x) * self.gain


class OtherwiseCompiled(Network):
    def forward(self, x):
        return -self.layers(x) if torch.jit.is_scripting() else self.layers(x)


class FailingModule(nn.Module):
    dim = 2

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if torch.jit.is_scripting():
            raise RuntimeError("not in a script")
        return x[:, :, :2]


class FailsCompiled(PcaReducer):
    """A reducer whose module compiles, and raises when it is asked."""

    def module(self):
        return FailingModule()


def reducer_of(network: Any, random_state: Any = 0) -> TorchReducer:
    return TorchReducer(network=network, folds=2, steps=4, fit_steps=30, random_state=random_state)


def taught(reducer: Any, store: Path | None = None, traces: Any = None) -> DataEngine:
    engine = DataEngine(reducer=reducer, store=store, replaying=True, retrain_every=20)
    for x, good in zip(*(traces or toy_traces(60)), strict=True):
        engine.report(engine.decide(x).id, bool(good))
    return engine


SLOW = [TiedWeights, Recurrent, ChangedInTraining]
SLOW = [pytest.param(network, marks=pytest.mark.slow) for network in SLOW]


@pytest.mark.parametrize("network", [UnsavedBuffer, WeightNorm, *SLOW])
def test_an_engine_decides_by_the_weights_that_it_trained_whatever_tensors_a_network_keeps(
    network, tmp_path
):
    X = toy_traces(10, seed=3)[0]
    for seed in (0, None):  # two engines of one process, each opened again
        store, reducer = tmp_path / f"{seed}.db", reducer_of(network, seed)
        with taught(reducer, store, toy_traces(40)) as engine:
            version, points = engine.version, [engine.decide(x).embedding for x in X]
            np.testing.assert_allclose(points, engine.model.spaces.embed(X), atol=1e-6)
        with DataEngine.open(store, reducer=reducer_of(network, seed)) as engine:
            assert engine.version == version > 0
            np.testing.assert_allclose([engine.decide(x).embedding for x in X], points, atol=1e-6)


RESTORED = "restored, as when its store is opened"
ALONE = "decided on alone lies elsewhere than the reducer embeds it"


@pytest.mark.parametrize(
    ("network", "reason"),
    [
        (RandomAnswer, RESTORED),
        (CountsItsCalls, RESTORED),
        (NumberOfElsewhere, RESTORED),
        (OtherwiseCompiled, ALONE),
    ],
)
def test_a_version_that_could_not_be_opened_or_answers_otherwise_is_dropped_and_the_cell_goes_on(
    network, reason, tmp_path
):
    with taught(reducer_of(network), tmp_path / "cell.db") as engine:
        assert engine.version == 0
        assert all(reason in report.reason for report in engine.store.versions.retrains())
        assert reason in engine.status().alarm
    with DataEngine.open(tmp_path / "cell.db", reducer=reducer_of(network)) as engine:
        assert engine.decide(toy_traces(1)[0][0]).action == "verify"


def test_a_model_that_answers_otherwise_than_it_was_trained_is_neither_exported_nor_in_the_contract(
    tmp_path,
):
    X, y = toy_traces(60)
    model = ModelPrediction(reducer_of(OtherwiseCompiled)).fit(X, y)
    with pytest.raises(ExportError, match="lies elsewhere than the reducer embeds it"):
        export_torchscript(model, tmp_path / "model.ts")
    for network, broken in (
        (OtherwiseCompiled, "a_version_answers_as_it_was_trained"),
        (CountsItsCalls, "it_embeds"),
    ):
        with pytest.raises(AssertionError, match=broken):
            check_reducer(reducer_of(network))


def test_a_module_that_compiles_and_does_not_run_is_told_everywhere_in_a_sentence(tmp_path):
    assert "not in a script" in taught(FailsCompiled()).status().alarm
    model = ModelPrediction(FailsCompiled()).fit(*toy_traces(60))
    with pytest.raises(ExportError, match=r"cannot be exported.*not in a script"):
        export_torchscript(model, tmp_path / "model.ts")
    with pytest.raises(AssertionError, match=r"cannot run it.*not in a script"):
        check_reducer(FailsCompiled())


@pytest.mark.parametrize("reducer", ["conv", "rocket"])
def test_a_window_that_never_holds_enough_for_a_first_training_is_refused(reducer):
    with pytest.raises(SettingError, match=r"a window of at least 20 labelled traces.*got 19"):
        DataEngine(recipe=Recipe(reducer, window=19))


@pytest.mark.parametrize("amplitude", [-1e-8, 1e-45])
@pytest.mark.parametrize("reducer", ["conv", "umap", PCA(2)])
def test_traces_too_small_for_their_unit_raise_an_alarm_that_says_so(reducer, amplitude):
    X, y = toy_traces(60)
    tiny = (amplitude * (np.abs(X) if amplitude < 0.0 else X)).astype(np.float32)
    engine = taught(reducer, traces=(tiny, y))
    alarm = engine.status().alarm
    assert engine.version == 0
    assert "the sensor" in alarm
    assert "unit" in alarm
