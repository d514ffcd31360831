"""The decision rule: one formula in every form it takes, and an object that is asked, told and
restored.
"""

import linecache
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dengine import (
    INTERVALS,
    Action,
    DataEngine,
    Policy,
    Recipe,
    export_torchscript,
)
from dengine.decision.intervals import SCALAR_BOUNDS
from dengine.decision.rule import DecisionRule, action_of
from dengine.errors import ExportError, SettingError
from dengine.model.neighbours import ModelPrediction
from tests.support.driving import drive, learn

counts = st.integers(0, 5000)
alphas = st.sampled_from([0.01, 0.05, 0.1, 0.2, 0.5])
bounds = st.sampled_from([0.6, 0.8, 0.9, 0.95, 0.99])
ACTIONS = tuple(Action)


@pytest.mark.parametrize("interval", SCALAR_BOUNDS)
@given(n_success=counts, n_failure=counts, alpha=alphas, lower_bound=bounds)
def test_the_scalar_rule_is_the_interval_and_the_policy(
    interval, n_success, n_failure, alpha, lower_bound
):
    policy = Policy(alpha, lower_bound, interval)
    action, lower, upper = policy.rule()(n_success, n_failure)
    assert (lower, upper) == pytest.approx(
        INTERVALS[interval](n_success, n_failure, alpha), abs=1e-12
    )
    assert ACTIONS[action] is policy.action(lower, upper)
    assert 0.0 <= lower <= upper <= 1.0


class FuseRule(DecisionRule):
    """Accepts nothing for a while after a part that looked good enough to accept turned out bad."""

    pause: torch.Tensor

    def __init__(self, alpha: float, lower_bound: float, interval: str = "wilson") -> None:
        super().__init__(alpha, lower_bound, interval)
        self.register_buffer("pause", torch.zeros((), dtype=torch.int64))

    def action(self, lower: float, upper: float) -> int:
        """The paper's action, but for a pause."""
        result = action_of(lower, upper, self.accept_threshold, self.reject_threshold)
        return 0 if result == 1 and int(self.pause.item()) > 0 else result

    @torch.jit.export
    def update(
        self,
        lower: float,
        upper: float,
        success: bool,
        predicted: int = 0,
        inclusion_probability: float = 1.0,
    ) -> None:
        """A stop sets the fuse; each label after it burns a little of it."""
        if not success and lower >= self.accept_threshold:
            self.pause.fill_(5)
        else:
            self.pause.fill_(max(0, int(self.pause.item()) - 1))


class SpokenRule(DecisionRule):
    """A rule that stays in Python."""

    compiles = False

    def action(self, lower: float, upper: float) -> int:
        return {True: 1, False: 0}[lower >= self.accept_threshold]


class FailingRule(SpokenRule):
    """Cannot be told anything."""

    def update(self, *outcome) -> None:
        raise RuntimeError("update failed")


@pytest.fixture
def outside(tmp_path, monkeypatch):
    """The module `fuse` of an outside author, by which a recipe names his rule."""
    source = Path(__file__).read_text(encoding="utf-8")
    rules = source[source.index("class FuseRule") : source.index("@pytest.fixture")]
    head = "import torch\nfrom dengine.decision.rule import DecisionRule, action_of\n\n\n"
    (tmp_path / "fuse.py").write_text(head + rules, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "fuse", raising=False)


def recipe_with(guarantee: str) -> Recipe:
    return Recipe("pca", radius=0.5, policy=Policy(0.1, 0.9, guarantee=guarantee), retrain_every=40)


@pytest.fixture
def good(data):
    """A part of the kind that is accepted."""
    return data.X[np.flatnonzero(data.y == 1)[-1]]


@pytest.mark.usefixtures("outside")
def test_a_rule_from_outside_is_named_by_a_recipe_told_of_a_stop_and_restored(data, good, tmp_path):
    recipe = Recipe.from_toml(recipe_with("fuse:FuseRule").to_toml())
    file = tmp_path / "engine.db"
    with DataEngine(recipe=recipe, store=file, replaying=True) as engine:
        drive(engine, data, last=150, confirm=True)
        accepted = engine.decide(good)
        assert accepted.action is Action.ACCEPT
        engine.report(accepted.id, success=False)  # the system stopped
        paused = engine.decide(good)
        assert paused.lower >= 0.9  # only the rule holds it back
        assert paused.action is Action.VERIFY
    with DataEngine.open(file, allow_import=True) as engine:
        assert engine.decide(good).action is Action.VERIFY
        engine.retrain()
    with DataEngine.open(file, allow_import=True) as engine:  # now from the version's own state
        assert engine.decide(good).action is Action.VERIFY
        learn(engine, replace(data, X=np.roll(data.X, 1, axis=1)), range(60))
        assert engine.decide(good).action is Action.ACCEPT


@pytest.mark.usefixtures("outside")
def test_a_rule_that_does_not_compile_decides_and_is_not_exported(data, tmp_path):
    with DataEngine(recipe=recipe_with("fuse:SpokenRule"), replaying=True) as engine:
        assert [cycle.decision.action for cycle in drive(engine, data)].count(Action.ACCEPT) > 50
        with pytest.raises(ExportError, match=r"SpokenRule .*does not compile"):
            export_torchscript(engine, tmp_path / "model.ts")


@pytest.mark.usefixtures("outside")
def test_a_rule_that_cannot_be_told_verifies_every_part_and_loses_no_label(data, good, tmp_path):
    file = tmp_path / "engine.db"
    with DataEngine(recipe=recipe_with("fuse:FailingRule"), store=file, replaying=True) as engine:
        decisions = [cycle.decision for cycle in drive(engine, data, last=100)]
        assert {decision.action for decision in decisions} == {Action.VERIFY}
        assert {decision.reason for decision in decisions[41:]} == {"model_error"}
        assert len(engine.store.labels.with_traces().labels) == 100
    with DataEngine.open(file, allow_import=True) as engine:
        assert engine.decide(good).action is Action.VERIFY


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("globl", "a guarantee among local"),
        ("nowhere:Rule", "can be imported here"),
        ("dengine.recipe:Recipe", "subclass"),
    ],
)
def test_a_rule_that_cannot_be_had_is_named(name, message):
    with pytest.raises(SettingError, match=message):
        DataEngine(recipe=recipe_with("local").with_policy(guarantee=name))


RULE = """
from dengine.decision.rule import DecisionRule


class MyRule(DecisionRule):
    def action(self, lower: float, upper: float) -> int:
        return {action}
"""


def notebook_rule(number: int, action: int, monkeypatch) -> type[DecisionRule]:
    """The class that a notebook cell of this number defines."""
    cell, name = RULE.format(action=action), f"<cell {number}>"
    lines = cell.splitlines(keepends=True)
    monkeypatch.setitem(linecache.cache, name, (len(cell), None, lines, name))
    notebook: dict[str, type[DecisionRule]] = {"__name__": "__main__"}
    exec(compile(cell, name, "exec"), notebook)  # as a notebook does
    return notebook["MyRule"]


def test_a_notebook_cell_that_is_run_again_defines_a_rule_that_is_asked_for_itself(
    data, good, monkeypatch
):
    for number, action in enumerate((1, 2, 0)):
        rule = notebook_rule(number, action, monkeypatch)(0.2, 0.8)
        model = ModelPrediction("pca", rule=rule, novelty=0.0).fit(data.X, np.ones(len(data)))
        assert model.decide(good[None])[0] is ACTIONS[action]
        assert isinstance(model.decider(None), torch.jit.ScriptModule)
