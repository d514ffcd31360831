"""What is given to an engine counts, or it is an error: recipes with settings beside them, own
reducers, models, stores.
"""

import sys
from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.decomposition import PCA
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from dengine import (
    DataEngine,
    ModelPrediction,
    Policy,
    Recipe,
    TraceSpec,
)
from dengine.engine.settings import EngineSettings
from dengine.errors import ImportRefusedError, SettingError, StoreError
from dengine.recipe import RECIPES
from dengine.store.records import address
from tests.support.command_line import dengine
from tests.support.driving import Counting, drive, learn

POLICY = Policy(alpha=0.2, lower_bound=0.8, audit_rate=0.05)


def test_what_is_given_beside_a_recipe_takes_its_place():
    given = {"policy": POLICY, "radius": 0.07, "folds": 3, "retrain_every": 20, "budget": 0.3}
    engine, expected = DataEngine(recipe="conv", **given), replace(RECIPES["conv"], **given)
    assert engine.recipe == expected
    assert engine.policy is engine.recipe.policy
    assert engine.store.settings.read()["recipe"] == expected.to_toml()


class Halves:
    """Looks like a transformer, and cannot be copied as one."""

    def fit(self, X: np.ndarray, y: None = None) -> "Halves":
        return self

    def transform(self, X: np.ndarray) -> np.ndarray:
        return X[:, 0, :2]


REFUSED = [  # settings, and the words that say why not
    ({"reducer": "conv", "recipe": "pca"}, "The recipe names its reducer, pca; got reducer 'conv' beside it"),
    *(({"model": Counting(), **given}, f"decides by its own rule, so {next(iter(given))} would have no effect")
      for given in ({"policy": POLICY}, {"radius": 0.1}, {"folds": 3}, {"reducer": "pca"})),
    *(({"model": model}, "Expected a model with fit, add, count") for model in (PCA(2), ModelPrediction, 3)),
    *(({"reducer": "pca", "seed": seed}, "seed of 0 or more") for seed in ("x", 1.5, -1, True)),
    ({"model": ModelPrediction()}, "Expected a baseline, got a ModelPrediction"),
    ({"reducer": "nowhere:Reducer"}, "can be imported here"),
    ({"reducer": "dengine.recipe:Recipe"}, "has no fit and no transform"),
    ({"reducer": f"{__name__}:Halves"}, "has no get_params"),
    ({"reducer": Halves()}, "a scikit-learn transformer with fit and get_params, got"),
    ({"reducer": "numpy:pi"}, "is a float and no class"),
    ({"recipe": Recipe("pca", {"dims": 3})}, "dims"),
]  # fmt: skip


@pytest.mark.parametrize(("given", "words"), REFUSED)
def test_what_contradicts_itself_or_has_no_effect_is_refused_and_spoils_no_store(
    given, words, tmp_path
):
    with pytest.raises(SettingError, match=words):
        DataEngine.open_or_create(store=tmp_path / "engine.db", **given)
    assert DataEngine("pca", store=tmp_path / "engine.db").store.settings.read()


def test_the_loops_settings_and_those_of_a_policy_that_are_no_rule_count_for_a_baseline_too(
    tmp_path,
):
    policy = Policy(audit_rate=0.3, label_within=200)
    given = {"model": Counting(), "store": tmp_path / "e.db", "retrain_every": 7, "budget": 0.2}
    with DataEngine(policy=policy, **given) as engine:
        assert engine.policy == policy
        assert (engine.recipe.retrain_every, engine.recipe.budget) == (7, 0.2)
    with pytest.raises(SettingError, match=r"\(label_within 200\), got label_within 300"):
        DataEngine.open_or_create(policy=replace(policy, label_within=300), **given)
    # The shadow mode is an operator's.
    DataEngine.open_or_create(policy=replace(policy, shadow=True), **given).close()


OTHERS = {
    "policy": Policy(0.1, 0.9),
    "radius": 0.3,
    "reducer": "conv",
    "recipe": "umap",
    "seed": 4,
    "trace": TraceSpec(99),
}


def test_the_same_line_begins_and_goes_on_and_another_is_an_error_that_names_both(data, tmp_path):
    url, given = tmp_path / "engine.db", {"reducer": "pca", "policy": POLICY, "retrain_every": 30}
    for start in (0, 20, 40):
        with DataEngine.open_or_create(url, **given) as engine:
            assert engine.resumed is (start > 0)
            assert engine.store.decisions.counts()["decisions"] == start
            drive(engine, data, start, start + 20)
    assert engine.version > 0
    names = {"policy": "lower_bound", "recipe": "reducer"}
    for name, other in OTHERS.items():
        named = names.get(name, name)
        match = rf"the store's own settings \(.*{named} .*\), got .*{named} "
        with pytest.raises(SettingError, match=match):
            DataEngine.open_or_create(url, **{name: other})
    for name, value in (given | {"seed": 0}).items():  # the rest is not asked for
        DataEngine.open_or_create(url, **{name: value}).close()


FIRST = TraceSpec(100, channels=2)
STATED = TraceSpec(100, 1000.0, 2, ("N", "mm"), columns=("force", "path"))


@pytest.mark.parametrize("columns", ["a", "aa", "aab"])
def test_columns_are_a_different_name_for_each_channel(columns):
    with pytest.raises(SettingError, match="2 different columns, one a channel"):
        TraceSpec(5, channels=2, columns=tuple(columns))


@pytest.mark.parametrize("first", [FIRST, None], ids=["a contract", "the first trace"])
def test_a_rate_is_stated_later_and_contradicted_never(first, make_data, tmp_path):
    url = tmp_path / "engine.db"
    with DataEngine("pca", store=url, trace=first) as engine:
        engine.decide(make_data(1, channels=2).X[0])
        assert engine.trace == FIRST
    for asked in (STATED, None, FIRST, replace(FIRST, unit="N, ")):  # the others ask for nothing
        with DataEngine.open_or_create(url, trace=asked) as engine:
            assert engine.trace == STATED
    for other in ({"rate_hz": 500.0}, {"unit": "N"}, {"samples": 99}, {"columns": ("a", "b")}):
        with pytest.raises(SettingError, match=r"the store's own settings \(trace TraceSpec"):
            DataEngine.open(url, trace=replace(STATED, **other))


def test_a_store_keeps_the_rate_that_an_older_version_wrote(make_data, tmp_path):
    old = '{"samples": 100, "rate_hz": 500.0, "channels": 1, "unit": "N", "limit": null, "columns": []}'
    url = tmp_path / "engine.db"
    with DataEngine("pca", store=url) as engine:
        settings = engine.store.settings
        settings.save(settings.read() | {"trace": old, "inferred": "true"})
    with DataEngine.open_or_create(url, trace=TraceSpec(100)) as engine:
        engine.decide(make_data(1).X[0])
        assert engine.trace == TraceSpec(100, 500.0, unit="N")
    with pytest.raises(SettingError, match=r"rate_hz=500\.0"):
        DataEngine.open_or_create(url, trace=TraceSpec(100, 1000.0))


LIMITED = Policy(force_limits=("0.02:0.1::1e9",))


def test_a_new_cell_with_limits_in_seconds_has_the_rate_of_its_product(tmp_path):
    for cell, trace in (("a", STATED), ("b", None)):
        store = address(tmp_path / "line.db", cell, "nut")
        with DataEngine("pca", LIMITED, store=store, trace=trace) as engine:
            assert engine.trace == STATED
    with DataEngine.open(store) as engine:
        assert engine.trace == STATED
    with pytest.raises(SettingError, match="Expected the rate of the traces"):
        DataEngine("pca", LIMITED)


class Other(Counting):
    """Another baseline."""


@pytest.mark.parametrize(
    ("first", "then"),
    [
        ({"model": Counting(), "policy": Policy(audit_rate=0.1)}, {"model": Other()}),
        ({"reducer": "pca"}, {"model": Counting()}),
        ({"recipe": Recipe(PCA(2), policy=POLICY)}, {"reducer": PCA(3)}),
    ],
)
def test_a_used_store_takes_the_object_it_was_made_with_and_no_other(first, then, data, tmp_path):
    url, given = tmp_path / "engine.db", first | {"retrain_every": 20}
    with DataEngine.open_or_create(url, **given) as engine:
        drive(engine, data, 0, 21)
    with pytest.raises(SettingError):
        DataEngine.open_or_create(url, **then)
    with DataEngine.open_or_create(url, **given) as engine:
        assert (engine.resumed, engine.version) == (True, 1)


OUTSIDE = """
from sklearn.decomposition import PCA
from dengine.decision.rule import DecisionRule

class Own(PCA): ...
class Rule(DecisionRule): ...
"""


@pytest.mark.parametrize(
    "mine", [{"reducer": "theirs:Own"}, {"policy": replace(POLICY, guarantee="theirs:Rule")}]
)
def test_what_a_store_names_is_imported_only_where_its_caller_says_so(
    mine, data, tmp_path, monkeypatch
):
    module, url = tmp_path / "theirs.py", f"{tmp_path}/engine.db"
    module.write_text(OUTSIDE)
    monkeypatch.syspath_prepend(str(tmp_path))
    a, b = (address(url, cell, "nut") for cell in "ab")
    with DataEngine(store=a, **{"reducer": "pca", "retrain_every": 20, **mine}) as engine:
        drive(engine, data, 0, 21)
    monkeypatch.delitem(sys.modules, "theirs")

    def exit_codes(*calls):
        return [dengine(*call.format(url).split(), "--cell", "a").exit_code for call in calls]

    assert exit_codes("status {}", "verify {}", "history {}", "explain {} last") == [0] * 4
    assert exit_codes("retrain {}", "policy {}") == [2] * 2
    match = r"theirs:.*, which .* names: allow it, .*allow_import=True"
    with pytest.raises(ImportRefusedError, match=match):
        DataEngine.open(address(url, "a"))
    with pytest.raises(ImportRefusedError, match=r"theirs:.*, which a peer"):
        DataEngine.open_or_create(b)
    assert "theirs" not in sys.modules
    assert exit_codes("policy {} --allow-import") == [0]
    monkeypatch.delitem(sys.modules, "theirs")
    DataEngine.open_or_create(address(url, "a"), **mine).close()
    DataEngine.open_or_create(b, allow_import=True).close()
    monkeypatch.delitem(sys.modules, "theirs")


def test_an_object_is_taken_by_any_name_of_its_class_in_the_store():
    settings = EngineSettings(Recipe("sklearn.decomposition:PCA"))
    assert EngineSettings.from_store(settings.to_store(), "cell.db", PCA()) == settings


def test_an_object_without_a_name_runs_and_is_handed_in_again(data, tmp_path):
    for params in ({"segments": [1]}, {"a b": 1}, {"inner": PCA(2)}):  # that TOML cannot say
        with pytest.raises(SettingError, match="params of plain names and values"):
            Recipe("conv", params)
    store = tmp_path / "engine.db"
    pipeline = make_pipeline(StandardScaler(), PCA(2, random_state=0))
    with DataEngine(pipeline, POLICY, store=store) as engine:
        drive(engine, data, 0, 100)
        before = engine.decide(data.X[170])
    with pytest.raises(SettingError, match=r"object Pipeline, has no name in TOML: hand it in"):
        DataEngine.open(store)
    with DataEngine.open(store, reducer=clone(pipeline)) as engine:
        assert engine.decide(data.X[170]).embedding == before.embedding is not None


def test_a_retrain_stops_on_its_steps_in_a_replay_and_else_on_the_clock_that_was_handed_in(data):
    for steps in (1, 3):
        engine = DataEngine(recipe=replace(RECIPES["conv"], max_steps=steps), replaying=True)
        drive(engine, data, 0, 31)
        assert {r.n_steps for r in engine.store.versions.retrains()} == {steps}
    ticks = count()
    # A second a look.
    engine = DataEngine("conv", POLICY, retrain_every=1000, clock=lambda: float(next(ticks)))
    learn(engine, data, range(30))
    before = next(ticks)
    report = engine.retrain()
    assert report.n_steps == 0  # its budget is over before the first step
    assert report.seconds in range(2, next(ticks) - before)  # whole seconds: of no other clock


def test_a_damaged_number_among_the_stores_settings_is_named():
    texts = EngineSettings(Recipe("pca")).to_store() | {"policy_since": "3x"}
    with pytest.raises(
        StoreError, match="Expected a policy_since in the store's settings, got '3x'"
    ):
        EngineSettings.from_store(texts, "cell.db")
