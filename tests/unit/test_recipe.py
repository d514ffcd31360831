"""Every setting of an engine, from and to TOML."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dengine import INTERVALS, Policy, Recipe
from dengine.errors import SettingError
from dengine.recipe import RECIPES

values = st.one_of(st.booleans(), st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False), st.text())


@st.composite
def recipes(draw) -> Recipe:
    return Recipe(
        reducer=draw(st.sampled_from([*RECIPES, "pca", "other"])),
        params=draw(st.dictionaries(st.from_regex(r"\A[a-z_]{1,12}\Z"), values, max_size=4)),
        policy=Policy(
            draw(st.floats(1e-6, 0.999)),
            draw(st.floats(0.500001, 0.9999)),
            draw(st.sampled_from(list(INTERVALS))),
            draw(st.floats(0.0, 0.999)),
        ),
        radius=draw(st.floats(1e-6, 1e6)),
        folds=draw(st.integers(2, 10)),
        retrain_every=draw(st.integers(1, 10_000)),
        budget=draw(st.floats(1e-3, 1e3)),
        max_steps=draw(st.integers(0, 10_000)),
        window=draw(st.integers(10, 10**7)),
    )


@given(recipes())
def test_toml_gives_back_the_recipe(recipe: Recipe) -> None:
    assert Recipe.from_toml(recipe.to_toml()) == recipe
    rate = np.float64(recipe.policy.alpha)  # NumPy's numbers are written as plain ones
    assert replace(recipe, folds=np.int64(recipe.folds)).with_policy(alpha=rate).to_toml() == recipe.to_toml()


@pytest.mark.parametrize("name", RECIPES)
def test_the_recipe_files_equal_the_defaults_in_the_code(name: str, repo: Path) -> None:
    path = repo / "models" / "recipes" / f"{name}.toml"
    assert Recipe.load(path) == RECIPES[name], "run: python training/write_recipes.py"
    assert path.read_text(encoding="utf-8").endswith(RECIPES[name].to_toml()), "run: python training/write_recipes.py"
    assert set(Recipe.__dataclass_fields__) <= set(tomllib.loads(path.read_text(encoding="utf-8")))


def test_a_recipe_loads_by_name_from_a_file_and_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('reducer = "pca"\nradius = 0.7\n[policy]\nalpha = 0.2\n', encoding="utf-8")
    mine = Recipe.load(path)
    base = RECIPES["pca"]
    assert mine == replace(base, radius=0.7, policy=replace(base.policy, alpha=0.2))
    assert Recipe.load(str(path)) == mine
    assert Recipe.load(mine) is mine
    assert Recipe.load("pca") is base
    with pytest.raises(SettingError, match=r"conv, umap, umap-learn, pca, rocket, paper.*covn is none"):
        Recipe.load("covn")


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
def test_what_is_wrong_with_a_recipe_is_a_setting_error_that_names_it(text: str, message: str) -> None:
    with pytest.raises(SettingError, match=message):
        Recipe.from_toml(text, where="mine")
