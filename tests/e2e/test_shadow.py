"""Decisions with the caller's own ids, and the shadow mode."""

import shutil

import pytest

from dengine import Action, DataEngine
from dengine.errors import ReportError
from tests.support.driving import RECIPE, drive


@pytest.mark.parametrize("name", ["", "two\nlines", 7, "x" * 1000])
def test_what_is_no_id_is_refused(name, stream):
    with DataEngine(recipe=RECIPE) as engine, pytest.raises(ReportError, match="Expected the id"):
        engine.decide(stream.X[0], decision_id=name)


def test_the_same_id_and_trace_have_the_same_decision_however_much_was_learned_since(stream):
    with DataEngine(recipe=RECIPE) as engine:
        first = engine.decide(stream.X[0], part="P1", decision_id="order-7")
        assert (first.id, first.action) == ("order-7", Action.VERIFY)
        drive(engine, stream, 1, 100)
        assert engine.version > 0
        assert engine.decide(stream.X[0], part="P1", decision_id="order-7") == first
        assert engine.store.decisions.counts()["decisions"] == 100


def test_what_was_answered_under_an_id_is_there_after_a_kill_that_follows_at_once(stream, tmp_path):
    (tmp_path / "cell").mkdir()
    with DataEngine(recipe=RECIPE, store=tmp_path / "cell" / "engine.db") as engine:
        answers = [engine.decide(x, decision_id=f"order-{i}") for i, x in enumerate(stream.X[:20])]
        # As a process that is killed now leaves it; faults/kills.py kills some.
        killed = shutil.copytree(tmp_path / "cell", tmp_path / "killed")
    with DataEngine.open(killed / "engine.db") as engine:
        for x, answer in zip(stream.X, answers, strict=False):
            assert engine.decide(x, decision_id=answer.id) == answer
        assert engine.store.decisions.counts()["decisions"] == 20
