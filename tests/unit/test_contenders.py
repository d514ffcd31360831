"""Who plays: recipes and rivals by name, each under a name of its own."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sklearn.decomposition import PCA
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer

from dengine import Dataset, Policy, Recipe
from dengine.errors import SettingError
from dengine.experiments.contenders import Contender, contenders
from dengine.experiments.rivals import RIVALS

PLAIN = Recipe("pca", radius=0.5)


def names(asked: list) -> list[str]:
    return [one.name for one in contenders(asked)]


def test_two_recipes_of_one_reducer_are_named_by_the_settings_in_which_they_differ() -> None:
    assert names([PLAIN, replace(PLAIN, radius=0.3)]) == ["pca radius=0.5", "pca radius=0.3"]
    other = replace(PLAIN, radius=0.3, params={"n_components": 1})
    assert names([PLAIN, other, "conv"]) == ["pca radius=0.5", "pca radius=0.3 n_components=1", "conv"]


def test_transformers_of_one_class_are_told_apart_by_their_own_settings() -> None:
    assert names([PCA(1), PCA(2)]) != names([PCA(2), PCA(2, whiten=True)])
    assert len(set(names([PCA(1), PCA(2)]))) == 2


def test_transformers_are_named_by_their_settings_and_numbered_where_these_read_alike() -> None:
    assert names([PCA(1), PCA(2)]) == ["PCA n_components=1", "PCA n_components=2"]
    absolute, root = (make_pipeline(FunctionTransformer(f), PCA(2)) for f in (np.abs, np.sqrt))
    assert len(set(names([absolute, root]))) == 2
    assert len(set(names([PCA(2), PCA(2)]))) == 2
    one = Recipe(absolute)
    assert names([one, one.with_policy(stops="all")]) == ["Pipeline", "Pipeline"]


def test_recipes_that_differ_in_what_tables_have_columns_for_keep_one_name() -> None:
    pooled = PLAIN.with_policy(guarantee="pooled", stops="all")
    assert names([PLAIN, pooled]) == ["pca", "pca"]


def test_one_name_is_a_list_of_one() -> None:
    assert names("conv") == ["conv"]


def test_the_same_recipe_twice_is_refused() -> None:
    with pytest.raises(SettingError, match="pca twice"):
        contenders([PLAIN, replace(PLAIN)])


def test_a_rivals_name_is_a_contender_under_the_policy_that_is_set() -> None:
    never = Contender.load("never").with_policy(alpha=0.2, lower_bound=0.8)
    assert (never.name, never.rival) == ("never", "never")
    engine = never.engine(seed=3)
    assert engine.recipe.policy == Policy(0.2, 0.8)
    assert engine.seed == 3


@pytest.mark.parametrize("unknown", ["nearest", "no_such_file.toml", 3])
def test_what_is_neither_recipe_nor_rival_is_refused(unknown: object) -> None:
    with pytest.raises(SettingError, match="recipe"):
        Contender.load(unknown)


def test_no_rival_has_the_name_of_a_recipe() -> None:
    from dengine.recipe import RECIPES

    assert set(RIVALS) & set(RECIPES) == set()


def test_the_description_changes_with_every_setting_that_decides(data: Dataset, tmp_path: Path) -> None:
    one = Contender.load(PLAIN)
    others = [
        Contender.load(replace(PLAIN, radius=0.4)),
        one.with_policy(alpha=0.2),
        Contender.load(Recipe(PCA(2), radius=0.5)),
        Contender.load(Recipe(PCA(2, whiten=True), radius=0.5)),
        Contender.load(FunctionTransformer(np.abs)),
        Contender.load(FunctionTransformer(np.sqrt)),
        Contender.load(FunctionTransformer(np.add, kw_args={"x2": np.zeros(3)})),
        Contender.load(FunctionTransformer(np.add, kw_args={"x2": np.ones(3)})),
        Contender.load("knn"),
        replace(Contender.load("knn"), params={"k": 3}),
    ]
    said = [each.description for each in [one, *others]]
    assert len(set(said)) == len(said)
    assert replace(one, name="another").description == one.description
    alike = [Contender.load(make_pipeline(FunctionTransformer(np.abs), PCA(2))) for _ in range(2)]
    assert alike[0].description == alike[1].description


def test_a_function_without_a_name_cannot_be_told_apart() -> None:
    with pytest.raises(SettingError, match="define it in a module"):
        _ = Contender.load(FunctionTransformer(lambda x: x)).description
