"""One contract over every entry of `REDUCERS`: whoever joins the table keeps it."""

from collections.abc import Callable
from dataclasses import replace
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sklearn.base import BaseEstimator, TransformerMixin, clone

from dengine import REDUCERS, DataEngine, Dataset, ModelPrediction, Policy, Recipe, ReplayCell, make_reducer
from dengine.errors import SettingError
from dengine.folds import content_fold
from dengine.recipe import RECIPES
from dengine.reducers import reducer_class
from dengine.reducers.base import StopRule
from dengine.reducers.cross_fitting import as_reducer, uses_labels

STEPS = 8
QUICK: dict[str, dict[str, Any]] = {"umap": {"n_epochs": 40, "n_neighbors": 8}}

every_reducer = pytest.mark.parametrize("name", REDUCERS)
SHAPES = [(152, 1), (800, 1), (90, 3)]


def new(name: str, seed: int = 0) -> Any:
    own = {"folds": 2} if "folds" in signature(reducer_class(name)).parameters else {}
    return make_reducer(name, seed=seed, **own, **QUICK.get(name, {}))


def fit(name: str, data: Dataset, seed: int = 0) -> Any:
    X = data.X if data.X.ndim == 3 else data.X[:, None, :]
    spaces = as_reducer(new(name, seed), 2)
    return spaces.fit(X, data.y, content_fold(X, spaces.n_spaces), StopRule(max_steps=STEPS))


def channels_first(data: Dataset) -> np.ndarray:
    return data.X if data.X.ndim == 3 else data.X[:, None, :]


@pytest.fixture(scope="module")
def fitted(make_data: Callable[..., Dataset]) -> Callable[[str], Any]:
    known: dict[str, Any] = {}
    data = make_data(100, samples=120)

    def of(name: str) -> Any:
        if name not in known:
            known[name] = fit(name, data)
        return known[name]

    return of


@pytest.fixture(scope="module")
def queries(make_data: Callable[..., Dataset]) -> np.ndarray:
    return make_data(20, samples=120, seed=5).X[:, None, :]


@every_reducer
def test_it_is_a_scikit_learn_transformer_that_clones(name: str) -> None:
    reducer = new(name, seed=7)
    assert isinstance(reducer, BaseEstimator)
    assert isinstance(reducer, TransformerMixin)
    assert clone(reducer).get_params() == reducer.get_params()
    assert reducer.get_params()["seed"] == 7
    assert isinstance(uses_labels(reducer), bool)


@every_reducer
def test_it_embeds_every_trace_in_every_space_as_finite_float32(name: str, fitted, queries) -> None:
    spaces = fitted(name)
    Z = spaces.embed(queries)
    assert Z.shape[:2] == (20, spaces.n_spaces)
    assert Z.dtype == np.float32
    assert np.isfinite(Z).all()
    assert spaces.transform(queries).shape == (20, Z.shape[2])
    assert spaces.transform(queries).dtype == np.float32


@every_reducer
def test_a_label_using_reducer_has_two_spaces_or_more(name: str, fitted) -> None:
    assert fitted(name).n_spaces >= (2 if uses_labels(new(name)) else 1)


@every_reducer
def test_references_live_in_the_space_of_their_own_fold(name: str, fitted, queries) -> None:
    spaces = fitted(name)
    fold = np.arange(20) % spaces.n_spaces
    np.testing.assert_array_equal(spaces.embed_own(queries, fold), spaces.embed(queries)[np.arange(20), fold])


@every_reducer
def test_a_seed_repeats_exactly(name: str, make_data, queries, fitted) -> None:
    again = fit(name, make_data(100, samples=120))
    np.testing.assert_array_equal(again.embed(queries), fitted(name).embed(queries))


@every_reducer
def test_labels_of_fold_k_move_nothing_in_space_k(name: str, make_data, queries, fitted) -> None:
    data = make_data(100, samples=120)
    spaces = fitted(name)
    fold = content_fold(channels_first(data), spaces.n_spaces)
    for k in range(spaces.n_spaces):
        y = data.y.copy()
        y[fold == k] = np.random.default_rng(k).permutation(1 - y[fold == k])
        other = fit(name, replace(data, y=y))
        np.testing.assert_array_equal(other.embed(queries)[:, k], spaces.embed(queries)[:, k])


@every_reducer
def test_a_trace_alone_lies_where_it_lies_in_a_batch(name: str, fitted, queries) -> None:
    spaces = fitted(name)
    together = spaces.embed(queries)
    alone = np.concatenate([spaces.embed(x[None]) for x in queries])
    scale = np.sqrt(together.var(axis=0).sum(axis=-1))  # (K,) root mean square radius, as ModelPrediction scales
    moved = np.linalg.norm(alone - together, axis=2) / scale
    assert moved.max() <= reducer_class(name).single_tolerance


@every_reducer
def test_embedding_does_not_change_the_traces(name: str, fitted, queries) -> None:
    before = queries.copy()
    fitted(name).embed(queries)
    np.testing.assert_array_equal(queries, before)


@every_reducer
def test_its_module_scripts_and_embeds_as_it_does(name: str, fitted, queries) -> None:
    import torch

    from dengine.decision.rule import script

    module = fitted(name).module()
    if module is None:
        assert name == "umap", f"{name} has no module: it cannot be exported"
        return
    with torch.inference_mode():
        Z = script(module.eval())(torch.from_numpy(queries)).numpy()
    np.testing.assert_allclose(Z, fitted(name).embed(queries), rtol=1e-4, atol=1e-4)


@every_reducer
def test_its_state_is_plain_arrays_that_restore_it_bit_for_bit(name: str, fitted, queries) -> None:
    state = fitted(name).get_state()
    if state is None:
        assert name == "umap", f"{name} has no state: it would have to be refitted at every start"
        return
    assert all(isinstance(v, np.ndarray) and not v.dtype.hasobject for v in state.values())
    restored = as_reducer(new(name), 2).set_state(state)
    np.testing.assert_array_equal(restored.embed(queries), fitted(name).embed(queries))


@every_reducer
def test_an_engine_resumes_from_its_store_with_identical_decisions(name: str, make_data, tmp_path: Path) -> None:
    data, url = make_data(110, samples=100), str(tmp_path / "engine.db")
    recipe = replace(
        RECIPES.get(name, Recipe(name)),
        params=QUICK.get(name, {}),
        policy=Policy(0.2, 0.8),
        retrain_every=70,
        max_steps=STEPS,
    )

    def asked(engine: DataEngine) -> list[tuple]:
        decided = [engine.decide(x) for x in data.X[90:]]
        return [(d.action, d.lower, d.upper, d.n_success, d.n_failure, d.embedding, d.model_version) for d in decided]

    with DataEngine(recipe=recipe, store=url, replaying=True) as engine:
        list(engine.run(ReplayCell(data), 90))
        assert engine.version == 1
        before = asked(engine)
    with DataEngine.open(url) as engine:
        assert asked(engine) == before


@every_reducer
@pytest.mark.parametrize(("samples", "channels"), SHAPES)
def test_any_length_and_several_channels_work(name: str, samples: int, channels: int, make_data) -> None:
    data = make_data(70, samples=samples, channels=channels)
    model = ModelPrediction(new(name)).fit(data.X, data.y, stop=StopRule(max_steps=STEPS))
    n_success, n_failure = model.count(data.X[:5])
    assert (n_success + n_failure >= 0).all()
    assert np.isfinite(model.predict_interval(data.X[:5])).all()
    assert model.index.ring.size() == 70


@every_reducer
def test_too_little_to_learn_from_is_a_setting_error(name: str, make_data) -> None:
    data = make_data(2, samples=100)
    with pytest.raises(SettingError):
        ModelPrediction(new(name)).fit(data.X, np.ones(2))


@every_reducer
def test_an_unknown_setting_is_an_error_that_lists_the_known(name: str) -> None:
    with pytest.raises(SettingError, match=r"no parameter dimm; it has .*seed"):
        make_reducer(name, dimm=2)


def test_an_unknown_reducer_lists_the_known() -> None:
    with pytest.raises(SettingError, match="conv, umap, pca"):
        make_reducer("pac")
