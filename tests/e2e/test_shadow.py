"""Decisions with the caller's own ids, and the shadow mode."""

import shutil
from pathlib import Path

import pytest

from dengine import Action, DataEngine, Dataset
from dengine.errors import ReportError
from dengine.store.lookup import BloomFilter
from tests.support.driving import RECIPE, drive


def test_taken_ids_are_never_taken_for_new_ones() -> None:
    taken = BloomFilter(f"order-{i}" for i in range(20_000))
    assert all(taken.may_contain(f"order-{i}") for i in range(20_000))
    assert not any(taken.may_contain(f"part-{i}") for i in range(1_000))


@pytest.mark.parametrize("stored", [False, True])
def test_the_same_id_and_trace_have_the_same_decision_however_much_was_learned_since(
    stream, tmp_path, stored
) -> None:
    with DataEngine(recipe=RECIPE, store=tmp_path / "engine.db" if stored else None) as engine:
        for none in ("", "two\nlines", 7, "x" * 1000):
            with pytest.raises(ReportError, match="Expected the id"):
                engine.decide(stream.X[0], decision_id=none)
        first = engine.decide(stream.X[0], part="P1", decision_id="order-7")
        assert first.id == "order-7"
        assert first.action is Action.VERIFY
        drive(engine, stream, 1, 200)
        assert engine.decide(stream.X[0]).model_version > 0
        assert engine.decide(stream.X[0], part="P1", decision_id="order-7") == first
        assert engine.store.decisions.counts()["decisions"] == 201


def test_what_was_answered_under_an_id_is_there_after_a_kill_that_follows_at_once(
    stream: Dataset, tmp_path: Path
) -> None:
    (tmp_path / "cell").mkdir()
    with DataEngine(recipe=RECIPE, store=tmp_path / "cell" / "engine.db") as engine:
        answers = [engine.decide(x, decision_id=f"order-{i}") for i, x in enumerate(stream.X[:20])]
        # As a process that is killed now leaves it; faults/kills.py kills some.
        killed = shutil.copytree(tmp_path / "cell", tmp_path / "killed")
    with DataEngine.open(killed / "engine.db") as engine:
        for x, answer in zip(stream.X, answers, strict=False):
            assert engine.decide(x, decision_id=answer.id) == answer
        assert engine.store.decisions.counts()["decisions"] == 20
