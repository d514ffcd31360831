"""An encoder that starts from another one's weights: exactly from them, or not at all."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dengine import ConvReducer, DataEngine, Recipe
from dengine.errors import SettingError
from dengine.reducers.base import StopRule
from dengine.reducers.encoder import weights_of

SHIPPED = Path(__file__).parents[2] / "models" / "encoder" / "encoder.npz"
SIZES: dict[str, Any] = {"kernels": 6, "dilations": 3, "regions": 2, "width": 8}


def traces(n: int = 80, channels: int = 1, seed: int = 0) -> tuple[Any, Any]:
    """Traces (n, C, 120) in two easy shapes, and labels."""
    rng = np.random.default_rng(seed)
    y = (np.arange(n) % 5 < 3).astype(np.int64)
    x = np.linspace(0, 5, 120)
    X = np.where(y[:, None], x, x[::-1])[:, None] + rng.normal(0, 0.3, (n, channels, 120))
    return X.astype(np.float32), y


def fitted(start: str | None = None, channels: int = 1, seed: int = 0, **sizes: int) -> ConvReducer:
    return ConvReducer(start=start, **(SIZES | sizes)).fit(*traces(80, channels, seed))


def learned(reducer: ConvReducer) -> dict[str, Any]:
    encoder: Any = reducer.net_.features
    return weights_of(encoder)


@pytest.fixture
def trained(tmp_path: Path) -> str:
    """The weights of an encoder that took ten steps, as a file."""
    X, y = traces()
    reducer = fitted()
    reducer.improve(X, np.arange(80), StopRule(max_steps=10))
    reducer.train(X, y, np.arange(80) % 5)
    path = tmp_path / "encoder.npz"
    np.savez(path, **learned(reducer))
    return str(path)


def test_an_encoder_starts_exactly_from_the_weights(trained: str) -> None:
    found, untrained = learned(fitted(trained, seed=1)), learned(fitted(seed=1))
    with np.load(trained) as stored:
        assert all(np.array_equal(found[name], stored[name]) for name in stored.files)
    assert not np.array_equal(found["kernel"], untrained["kernel"])


def test_the_scale_of_its_channel_is_of_its_own_traces(trained: str) -> None:
    own, untrained = fitted(trained, seed=1).net_.features, fitted(seed=1).net_.features
    assert own.scale.equal(untrained.scale)
    assert own.shift.equal(untrained.shift)


def test_training_goes_on_from_the_weights(trained: str) -> None:
    X, _ = traces()
    reducer = fitted(trained)
    assert reducer.improve(X, np.arange(80), StopRule(max_steps=2)) == 2
    assert reducer.training_ is not None
    with np.load(trained) as stored:
        moved = np.abs(reducer.training_.encoder.kernel.detach().numpy() - stored["kernel"]).max()
    assert 0.0 < moved < 0.01


@pytest.mark.parametrize(
    ("sizes", "said"),
    [
        ({"kernels": 7}, "kernels 6 instead of 7"),
        ({"dilations": 2}, "dilations 3 instead of 2"),
        ({"regions": 3}, "regions 2 instead of 3"),
        ({"width": 9, "kernels": 7}, "kernels 6 instead of 7, width 8 instead of 9"),
    ],
)
def test_weights_of_other_sizes_are_refused_by_name(trained: str, sizes: dict[str, int], said: str) -> None:
    with pytest.raises(SettingError, match=said):
        fitted(trained, **sizes)


def test_several_channels_do_not_start_from_weights(trained: str) -> None:
    with pytest.raises(SettingError, match="1 channel to start from weights, got 2"):
        fitted(trained, channels=2)


@pytest.mark.parametrize("content", [None, b"", b"no archive", b"PK\x03\x04 and no more"])
def test_a_file_that_is_missing_or_broken_is_refused_by_its_name(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "broken.npz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SettingError, match=r"Cannot read start .*broken\.npz"):
        fitted(str(path))


@pytest.mark.parametrize(
    "change",
    [
        {"mix": np.zeros((3, 3), np.float32)},
        {"mix": np.zeros((36, 8), np.float64)},
        {"kernel": np.full((9, 6), np.nan, np.float32)},
        {"unit": np.array([None, "pickled"])},
        {"width": np.zeros(2)},
    ],
    ids=["shape", "dtype", "NaN", "pickle", "sizes"],
)
def test_an_archive_of_something_else_is_refused(trained: str, change: dict[str, Any]) -> None:
    with np.load(trained) as stored:
        arrays: dict[str, Any] = dict(stored) | change
    np.savez(trained, **arrays)
    with pytest.raises(SettingError, match=r"encoder\.npz"):
        fitted(trained)


def test_an_archive_without_an_array_is_refused(trained: str) -> None:
    with np.load(trained) as stored:
        arrays: dict[str, Any] = {name: stored[name] for name in stored.files if name != "slope"}
    np.savez(trained, **arrays)
    with pytest.raises(SettingError, match="slope"):
        fitted(trained)


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
