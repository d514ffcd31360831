"""The encoder: it reads no label, trains apart from what answers, goes on where it ended, and may be refused."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dengine import ConvReducer, DataEngine, Dataset, Recipe
from dengine.datasets.importing import import_labelled
from dengine.decision.rule import script
from dengine.engine.trainer import STEP_SECONDS, EncoderTime
from dengine.errors import SettingError
from dengine.folds import content_fold, content_hash
from dengine.reducers.base import StopRule
from dengine.reducers.encoder import ConvEncoder, averaging, weights_of
from dengine.reducers.features import KeptFeatures
from dengine.reducers.training import Adam, vicreg_loss

SMALL = {"kernels": 6, "dilations": 3, "width": 8}


def resonances(n: int = 160, samples: int = 250, channels: int = 1, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Noise through one of two resonances, 0.06 and 0.09 cycles a sample; the lower one is the success."""
    rng = np.random.default_rng(seed)
    y = (rng.random(n) < 0.6).astype(np.int64)
    t = np.arange(samples)
    X = np.zeros((n, channels, samples), dtype=np.float32)
    for i in range(n):
        for c in range(channels):
            frequency = np.where(y[i] == 1, 0.06, 0.09) * (1 + 0.02 * rng.normal())
            X[i, c] = np.sin(2 * np.pi * (frequency * t + rng.random())) + 0.3 * rng.normal(size=samples)
    return X, y


def fitted(**params: object) -> tuple[ConvReducer, np.ndarray, np.ndarray]:
    X, y = resonances()
    return ConvReducer(**{**SMALL, **params}).fit(X, y), X, y


def improved(reducer: ConvReducer, X: np.ndarray, steps: int) -> int:
    return reducer.improve(X, content_hash(X), StopRule(max_steps=steps))


def test_the_features_are_the_same_whatever_the_labels_also_after_training() -> None:
    X, y = resonances()
    one, two = (ConvReducer(**SMALL).fit(X, labels) for labels in (y, 1 - np.roll(y, 3)))
    for reducer, labels in ((one, y), (two, 1 - np.roll(y, 3))):
        improved(reducer, X, 5)
        reducer.train(X, labels, content_fold(X, 5))
    own, other = one.net_.features.state_dict(), two.net_.features.state_dict()
    assert all(torch.equal(own[name], other[name]) for name in own)


def test_what_answers_stays_until_the_next_training_takes_the_encoder_over() -> None:
    reducer, X, y = fitted()
    before, kernel = reducer.embed(X), reducer.net_.features.kernel.clone()
    assert improved(reducer, X, 8) == 8
    np.testing.assert_array_equal(reducer.embed(X), before)
    reducer.train(X, y, content_fold(X, 5))
    assert not torch.equal(reducer.net_.features.kernel, kernel)
    assert "encoder after 8 steps" in reducer.report.note
    reducer.train(X, y, content_fold(X, 5))
    assert "encoder" not in reducer.report.note  # nothing was trained since


@pytest.mark.parametrize(
    "spoil", [lambda mix: mix.fill_(float("nan")), lambda mix: mix.copy_(torch.randn(mix.shape))], ids=["nan", "noise"]
)
def test_an_encoder_that_does_worse_on_held_out_traces_is_given_up(spoil) -> None:  # of a tensor
    reducer, X, y = fitted()
    improved(reducer, X, 80)
    reducer.train(X, y, content_fold(X, 5))
    improved(reducer, X, 3)
    training, kernel = reducer.training_, reducer.net_.features.kernel.clone()
    assert training is not None
    with torch.no_grad():
        spoil(training.encoder.mix)
    reducer.train(X, y, content_fold(X, 5))
    assert "kept the earlier encoder" in reducer.report.note
    assert torch.equal(reducer.net_.features.kernel, kernel)
    assert torch.equal(training.encoder.kernel, kernel)  # it goes on from what answers
    assert improved(reducer, X, 3) == 3


def test_a_training_that_was_stored_goes_on_as_one_that_never_stopped() -> None:
    whole, X, y = fitted()
    first, _, _ = fitted()
    improved(whole, X, 6)
    improved(first, X, 6)
    for reducer in (whole, first):
        reducer.train(X, y, content_fold(X, 5))
    again = ConvReducer(**SMALL).set_state(first.get_state())
    for reducer in (whole, again):
        improved(reducer, X, 6)
        reducer.train(X, y, content_fold(X, 5))
    np.testing.assert_array_equal(again.embed(X), whole.embed(X))
    assert again.training_ is not None
    assert again.training_.steps == 12


@pytest.mark.parametrize("channels", [1, 3])
def test_windows_times_kernels_are_torchs_dilated_convolutions_at_the_places(channels: int) -> None:
    samples, dilations, kernels = 60, 3, 4
    encoder = ConvEncoder(channels, samples, 1, kernels, dilations, 3, 2)
    a = torch.randn(5, channels, samples, generator=torch.Generator().manual_seed(0))
    encoder.learn_filters(a, np.random.default_rng(0))
    found = torch.matmul(encoder.windows(a, encoder.taps), encoder.kernel).view(dilations, 5, -1, kernels)
    middle = encoder.taps.view(dilations, -1, 9)[:, :, 4]
    weight = encoder.kernel.T.reshape(kernels, channels, 9)
    for d, spread in enumerate((1, 2, 7)):  # 2 ** 0, and up to the length over 8
        whole = torch.nn.functional.conv1d(a, weight, padding=4 * spread, dilation=spread)  # (5, kernels, samples)
        torch.testing.assert_close(found[d], whole[:, :, middle[d]].transpose(1, 2))


def test_adam_steps_as_torchs_does() -> None:
    rng = torch.Generator().manual_seed(0)
    own, other = ([torch.zeros(4, 3, requires_grad=True), torch.ones(5, requires_grad=True)] for _ in range(2))
    ours = Adam([([own[0]], 1e-2), ([own[1]], 1e-3)])
    theirs = torch.optim.Adam([{"params": [other[0]], "lr": 1e-2}, {"params": [other[1]], "lr": 1e-3}])
    for _ in range(20):
        for a, b in zip(own, other, strict=True):
            a.grad = torch.randn(a.shape, generator=rng)
            b.grad = a.grad.clone()
        ours.step()
        theirs.step()
    for a, b in zip(own, other, strict=True):
        torch.testing.assert_close(a, b)


def test_training_loads_no_compiler_in_the_middle_of_a_cycle() -> None:
    program = """
import sys, numpy as np
from dengine import ConvReducer
from dengine.folds import content_hash
from dengine.reducers.base import StopRule
X = np.random.default_rng(0).normal(size=(40, 1, 100)).astype(np.float32)
reducer = ConvReducer(kernels=4, width=4).fit(X, np.arange(40) % 2)
assert reducer.improve(X, content_hash(X), StopRule(max_steps=1)) == 1
print("torch._dynamo" in sys.modules)
"""
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout == "False\n"


def test_the_loss_of_a_collapsed_embedding_is_its_missing_variance() -> None:
    z = torch.ones(32, 8)
    assert float(vicreg_loss(z, z)) == pytest.approx(25.0 * (1.0 - 0.01), rel=1e-5)  # the deviation is sqrt(1e-4)


def test_the_loss_of_equal_views_with_independent_dimensions_of_deviation_one_is_none() -> None:
    z = torch.from_numpy(np.linalg.qr(np.random.default_rng(0).normal(size=(64, 9)))[0]).float()
    z = (z - z.mean(0)) @ torch.linalg.inv(torch.linalg.cholesky(torch.cov(z.T)).T)
    assert float(vicreg_loss(z, z)) < 1e-3
    assert float(vicreg_loss(z, z + 1.0)) == pytest.approx(25.0, rel=1e-3)  # the mean squared distance of the pairs


@pytest.mark.parametrize("samples", [400, 1000, 5000])
def test_traces_are_averaged_to_two_hundred_samples_but_not_where_that_loses_an_oscillation(samples: int) -> None:
    t = np.arange(samples)
    rng = np.random.default_rng(0)
    slow = np.sin(2 * np.pi * (3 * t / samples + rng.random((20, 1, 1)))).astype(np.float32)
    fast = np.sin(2 * np.pi * (0.3 * t + rng.random((20, 1, 1)))).astype(np.float32)
    assert averaging(torch.from_numpy(slow)) == samples // 200
    assert averaging(torch.from_numpy(fast)) == 1


@pytest.mark.parametrize("channels", [1, 3, 12])
@pytest.mark.parametrize("samples", [2, 3, 9, 64, 152, 5000])
def test_traces_of_any_shape_have_finite_features_the_same_when_scripted(samples: int, channels: int) -> None:
    rng = np.random.default_rng(0)
    X = torch.from_numpy(rng.normal(size=(24, channels, samples)).cumsum(2).astype(np.float32))
    encoder = ConvEncoder(channels, samples, averaging(X), 28, 5, 3, 64).eval()
    with torch.no_grad():
        encoder.learn(X, rng)
        standard, _ = encoder.standardise(encoder.raw(X))
        np.testing.assert_allclose(encoder(X), standard, atol=1e-4)
        assert torch.isfinite(standard).all()
        np.testing.assert_allclose(script(encoder)(X[:1]), encoder(X[:1]), atol=1e-6)


def test_time_is_saved_up_cycle_by_cycle_and_taken_in_slices() -> None:
    time = EncoderTime(0.01, in_steps=True)
    assert time.take(0.2, 0.2) is None
    for _ in range(20):
        time.cycles += 1
    piece = time.take(0.2, 0.2)
    assert piece is not None
    assert (piece.seconds, piece.steps) == (None, round(0.2 / STEP_SECONDS))
    time.spend(piece.steps or 0, seconds=99.0)
    assert time.seconds == pytest.approx((piece.steps or 0) * STEP_SECONDS)  # in steps: whatever they took
    assert time.take(0.2, 0.2) is None
    for _ in range(100_000):
        time.cycles += 1
    assert time.saved <= 2.0  # a long idle time is not made up for at once


def engine_after(cycles: int, **options: object) -> DataEngine:
    X, y = resonances(cycles)
    recipe = Recipe("conv", params=SMALL, radius=0.05, encoder_budget=0.05, retrain_every=40)
    engine = DataEngine(recipe=recipe, **options)  # type: ignore[arg-type]
    for x, good in zip(X, y, strict=True):
        decision = engine.decide(x)
        if decision.action == "verify":
            engine.report(decision.id, bool(good))
        engine.settle()
    return engine


def test_the_encoder_trains_between_two_cycles_and_the_next_version_has_it() -> None:
    with engine_after(120, replaying=True) as engine:
        assert engine.encoder_time.steps > 50
        assert engine.encoder_time.seconds == pytest.approx(engine.encoder_time.steps * STEP_SECONDS)
        assert any("encoder after" in report.reason for report in engine.store.retrains())


def test_a_live_engine_ends_a_slice_by_the_clock() -> None:
    with engine_after(90) as engine:
        assert engine.encoder_time.steps > 0
        assert 0.0 < engine.encoder_time.longest < 0.45


@pytest.mark.parametrize("retrained_before", [True, False])
def test_an_opened_engine_has_the_features_that_its_next_retrain_needs(tmp_path, monkeypatch, retrained_before) -> None:
    url, (X, y) = str(tmp_path / "cell.sqlite"), resonances(120 if retrained_before else 520)
    if retrained_before:
        engine_after(len(X), store=url, replaying=True).close()
    else:
        import_labelled(url, Dataset(X[:, 0], y), Recipe("conv", params=SMALL, radius=0.05))

    def too_late(*_: object) -> torch.Tensor:
        raise AssertionError("computed in the retrain")

    with DataEngine.open(url, replaying=True) as engine:
        add = KeptFeatures.add
        monkeypatch.setattr(KeptFeatures, "add", lambda self, x, keys, most, _: add(self, x, keys, most, too_late))
        assert engine.retrain().accepted


def test_an_encoder_that_fails_at_training_costs_no_decision(monkeypatch, caplog) -> None:
    def fail(*_: object) -> int:
        raise RuntimeError("no memory")

    monkeypatch.setattr(ConvReducer, "improve", fail)
    with engine_after(120, replaying=True) as engine:
        assert engine.version >= 1
        assert engine.encoder_time.steps == 0
    assert "cannot be trained further" in caplog.text


def test_where_there_are_many_references_an_encoder_waits_until_all_are_embedded_with_it(monkeypatch) -> None:
    reducer, X, y = fitted()
    monkeypatch.setattr("dengine.reducers.conv.AT_ONCE", 70 * reducer.net_.features.n_places)
    kernel = reducer.net_.features.kernel.clone()
    improved(reducer, X, 4)
    for left in (90, 20):
        reducer.train(X, y, content_fold(X, 5))
        assert f"waits until {left} more traces" in reducer.report.note
        assert torch.equal(reducer.net_.features.kernel, kernel)
    reducer.train(X, y, content_fold(X, 5))
    assert "encoder after 4 steps" in reducer.report.note
    assert not torch.equal(reducer.net_.features.kernel, kernel)
    fresh = reducer.net_.features.raw(torch.from_numpy(X))
    np.testing.assert_allclose(reducer.raw_features(X), fresh, atol=1e-5)


SHIPPED = Path(__file__).parents[2] / "models" / "encoder" / "encoder.npz"
SIZES: dict[str, Any] = {**SMALL, "regions": 2}


def traces(n: int = 80, channels: int = 1, seed: int = 0) -> tuple[Any, Any]:
    """Traces (n, C, 120) in two easy shapes, and labels."""
    rng = np.random.default_rng(seed)
    y = (np.arange(n) % 5 < 3).astype(np.int64)
    x = np.linspace(0, 5, 120)
    X = np.where(y[:, None], x, x[::-1])[:, None] + rng.normal(0, 0.3, (n, channels, 120))
    return X.astype(np.float32), y


def started(start: str | None = None, channels: int = 1, seed: int = 0, **sizes: int) -> ConvReducer:
    return ConvReducer(start=start, **(SIZES | sizes)).fit(*traces(80, channels, seed))


def learned(reducer: ConvReducer) -> dict[str, Any]:
    return weights_of(reducer.encoder_)


@pytest.fixture
def trained(tmp_path: Path) -> str:
    """The weights of an encoder that took ten steps, as a file."""
    X, y = traces()
    reducer = started()
    reducer.improve(X, np.arange(80), StopRule(max_steps=10))
    reducer.train(X, y, np.arange(80) % 5)
    path = tmp_path / "encoder.npz"
    np.savez(path, **learned(reducer))
    return str(path)


def test_an_encoder_starts_exactly_from_the_weights(trained: str) -> None:
    found, untrained = learned(started(trained, seed=1)), learned(started(seed=1))
    with np.load(trained) as stored:
        assert all(np.array_equal(found[name], stored[name]) for name in stored.files)
    assert not np.array_equal(found["kernel"], untrained["kernel"])


@pytest.mark.parametrize(
    ("own", "said"),
    [
        ({"width": 9, "kernels": 7}, "kernels 6 instead of 7, width 8 instead of 9"),
        ({"dilations": 2}, "dilations 3 instead of 2"),
        ({"channels": 2}, "1 channel to start from weights, got 2"),
    ],
)
def test_weights_of_other_sizes_are_refused_by_name(trained: str, own: dict[str, int], said: str) -> None:
    with pytest.raises(SettingError, match=said):
        started(trained, **own)


@pytest.mark.parametrize(
    "change",
    [
        {"mix": np.zeros((3, 3), np.float32)},
        {"mix": np.zeros((36, 8), np.float64)},
        {"kernel": np.full((9, 6), np.nan, np.float32)},
        {"unit": np.array([None, "pickled"])},
        {"width": np.zeros(2)},
        {"slope": None},
    ],
    ids=["shape", "dtype", "NaN", "pickle", "sizes", "missing"],
)
def test_an_archive_of_something_else_is_refused(trained: str, change: dict[str, Any]) -> None:
    with np.load(trained) as stored:
        arrays = {name: value for name, value in (dict(stored) | change).items() if value is not None}
    np.savez(trained, **arrays)
    with pytest.raises(SettingError, match=r"encoder\.npz"):
        started(trained)


@pytest.mark.parametrize("content", [None, b"", b"no archive", b"PK\x03\x04 and no more"])
def test_a_file_that_is_missing_or_broken_is_refused_by_its_name(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "broken.npz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SettingError, match=r"Cannot read start .*broken\.npz"):
        started(str(path))


def test_a_stored_engine_opens_without_the_file_and_decides_alike(trained: str, tmp_path: Path) -> None:
    X, y = traces(120)
    recipe = replace(Recipe.load("conv"), params={**SIZES, "start": trained}, retrain_every=30)
    with DataEngine.from_recipe(recipe, store=str(tmp_path / "engine.db")) as engine:
        for x, good in zip(X[:100], y[:100], strict=True):
            engine.report(engine.decide(x[0]).id, success=bool(good))
        engine.retrain()
        before = [engine.decide(x[0]).embedding for x in X[100:]]
    Path(trained).unlink()
    with DataEngine.open(str(tmp_path / "engine.db")) as engine:
        assert [engine.decide(x[0]).embedding for x in X[100:]] == before
        assert engine.retrain().accepted


def test_the_shipped_weights_start_an_encoder_of_the_defaults() -> None:
    rng = np.random.default_rng(0)
    X = rng.normal(size=(40, 1000)).cumsum(1).astype(np.float32)
    found = learned(ConvReducer(start=str(SHIPPED)).fit(X, np.arange(40) % 2))
    with np.load(SHIPPED) as stored:
        assert all(np.array_equal(found[name], stored[name]) for name in stored.files)
