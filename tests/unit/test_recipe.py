"""Every setting of an engine, from and to TOML."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sklearn.decomposition import PCA

from dengine import INTERVALS, ConvReducer, DataEngine, Policy, Recipe, Reducer, TorchReducer
from dengine.errors import SettingError, StoreError
from dengine.experiments.replay import Contender
from dengine.model.neighbours import ModelPrediction
from dengine.recipe import RECIPES

scalars = st.one_of(
    st.booleans(),
    st.integers(-(2**63), 2**63 - 1),
    st.floats(allow_nan=False),
    st.text().filter(lambda text: text != "none"),
)
numpys = st.floats(allow_nan=False, width=32).map(np.float32)
values = st.one_of(scalars, numpys)


names = st.from_regex(r"\A[a-z_]{1,12}\Z")
policies = st.builds(
    Policy,
    st.floats(1e-6, 0.999),
    st.floats(0.500001, 0.9999),
    st.sampled_from(list(INTERVALS)),
    st.floats(0.0, 0.999),
)
recipes = st.builds(
    Recipe,
    st.sampled_from([*RECIPES, "other"]),
    st.dictionaries(names, values, max_size=4),
    policy=policies,
    radius=st.floats(1e-6, 1e6),
    folds=st.integers(2, 10),
    retrain_every=st.integers(1, 10_000),
    budget=st.floats(1e-3, 1e3),
    window=st.integers(10, 10**7),
)


@settings(suppress_health_check=[HealthCheck.too_slow])
@given(recipes)
def test_toml_gives_back_the_recipe(recipe):
    assert Recipe.from_toml(recipe.to_toml()) == recipe


def test_a_text_that_would_be_read_as_none_is_no_parameter():
    with pytest.raises(SettingError, match="plain names and values"):
        Recipe("conv", {"kind": "none"})


def test_the_page_of_the_recipes_shows_them_as_they_are(repo):
    page = (repo / "docs" / "reference" / "recipes.md").read_text("utf-8")
    (shown,) = re.findall(r"^```toml [^\n]*\n(.*?\n)```$", page, flags=re.M | re.S)
    assert shown.strip() == Recipe.load("conv").to_toml().strip()
    table = [line.replace("`", "").strip("| ").split(" | ") for line in page.splitlines()]
    _, _, *rows = [cells for cells in table if len(cells) == 7]
    assert {name for name, *_ in rows} == set(RECIPES)
    form = (
        'reducer = "{}"\nradius = {}\nretrain_every = {}\n'
        "policy = {{alpha = {}, lower_bound = {}}}\nnovelty = {}\n"
    )
    for name, *cells in rows:
        assert Recipe.from_toml(form.format(*cells)) == RECIPES[name]


def test_a_recipe_loads_by_name_from_a_file_and_as_it_is(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('reducer = "pca"\nradius = 0.7\n[policy]\nalpha = 0.2\n', encoding="utf-8")
    loaded = Recipe.load(path)
    assert loaded == replace(RECIPES["pca"], radius=0.7).with_policy(alpha=0.2)
    assert Recipe.load(str(path)) == loaded
    with pytest.raises(SettingError, match=r"conv, umap, .*covn is none"):
        Recipe.load("covn")


class Wide(Reducer):
    """A reducer of a user's, with numbers of its own."""

    default_radius = 0.9
    default_retrain_every = 17

    def fit(self, X, y=None):
        return self

    def transform(self, X):
        return np.asarray(X)[:, :2]


OWN = [  # a reducer, its radius, its retrain_every
    ("conv", 0.07, 10),
    ("umap", 0.3, 50),
    ("pca", 0.2, 50),
    ("rocket", 0.07, 50),
    (TorchReducer(network=ConvReducer().network), 0.07, 10),
    (PCA(2), 0.3, 50),
    (Wide(), 0.9, 17),
]


@pytest.mark.parametrize(("reducer", "radius", "retrain_every"), OWN)
def test_radius_and_retrain_every_are_the_reducers_own_wherever_none_is_given(
    reducer, radius, retrain_every
):
    ways = [
        Recipe(reducer),
        Recipe(reducer, radius=None, retrain_every=None).with_policy(alpha=0.2),
        Contender.load(reducer).recipe,
        DataEngine(reducer).recipe,
        DataEngine(recipe=Recipe(reducer), radius=None).recipe,
    ]
    if isinstance(reducer, str):
        ways.append(Recipe.from_toml(f'reducer = "{reducer}"'))
    assert {(recipe.radius, recipe.retrain_every) for recipe in ways} == {(radius, retrain_every)}
    assert ModelPrediction(reducer).classifier.radius == radius
    assert Recipe(reducer, radius=0.5).radius == 0.5


def test_a_stored_recipe_imports_nothing_to_learn_a_radius():
    text = 'reducer = "nobody_has_this:Class"\n'
    with pytest.raises(StoreError, match="radius, retrain_every; restore the store"):
        Recipe.from_store({"recipe": text})
    assert Recipe.from_store({"recipe": text + "radius = 0.3\nretrain_every = 50\n"}).radius == 0.3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("raduis = 0.3", r"mine has an unknown key raduis; known are .*radius"),
        ("[policy]\nalhpa = 0.3", r"mine.*alhpa"),
        ("radius = ", "mine is not TOML"),
        ("policy = 3", "mine"),
        ("params = 3", "params"),
        ("radius = -1.0", "radius > 0"),
        ("folds = 1", "folds to be an integer of at least 2, got 1"),
        ("retrain_every = 0", "retrain_every"),
        ("window = 9", "window"),
        ("budget = 0", "budget > 0"),
    ],
)
def test_what_is_wrong_with_a_recipe_is_a_setting_error_that_names_it(text, message):
    with pytest.raises(SettingError, match=message):
        Recipe.from_toml(text, where="mine")
