"""Decisions with the caller's own ids, and the shadow mode."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
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


KILLED = """
import os, signal, sys
import numpy as np
from dengine import DataEngine, Policy, Recipe
X = np.load(sys.argv[1])
engine = DataEngine(recipe=Recipe("pca", radius=0.5, retrain_every=40), store=sys.argv[2])
for i, x in enumerate(X):
    decision = engine.decide(x, decision_id=f"order-{i}")
    print(decision.id, decision.action.value, decision.reason.value, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.merge  # it starts a process
def test_what_was_answered_under_an_id_is_there_after_a_kill_that_follows_at_once(
    stream: Dataset, tmp_path: Path
) -> None:
    np.save(tmp_path / "x.npy", stream.X[:20])
    file = tmp_path / "engine.db"
    command = [sys.executable, "-c", KILLED, str(tmp_path / "x.npy"), str(file)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr
    answers = [line.split() for line in done.stdout.splitlines()]
    assert len(answers) == 20
    with DataEngine.open(file) as engine:
        for x, (id_, action, reason) in zip(stream.X, answers, strict=False):
            again = engine.decide(x, decision_id=id_)
            assert (again.id, again.action, again.reason) == (id_, action, reason)
        assert engine.store.decisions.counts()["decisions"] == 20
