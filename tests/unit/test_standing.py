"""What status says of the shadow mode: what the model would have done, against what every check said."""

import json
import re
from pathlib import Path

import pytest
from click.testing import CliRunner

from dengine import Action, DataEngine, Dataset, Policy, Recipe, wilson_interval
from dengine.cli import main
from dengine.history.status import status
from tests.support.driving import drive

POLICY = Policy(alpha=0.1, lower_bound=0.9)
RECIPE = Recipe("pca", radius=0.5, retrain_every=40, policy=POLICY)


def test_status_counts_what_the_shadow_mode_would_have_done_against_what_was_true(stream: Dataset, tmp_path: Path) -> None:
    store = str(tmp_path / "engine.db")
    with DataEngine(recipe=RECIPE, store=store) as engine:
        engine.set_shadow(True)
        cycles = drive(engine, stream, 0, 300)
    certain = [cycle for cycle in cycles if cycle.decision.audit]
    said = {
        action: [cycle.success for cycle in certain if cycle.decision.predicted is action]
        for action in (Action.ACCEPT, Action.REJECT)
    }
    bad, good = said[Action.ACCEPT].count(False), said[Action.REJECT].count(True)
    told = json.loads(CliRunner().invoke(main, ["status", store, "--json"]).stdout)
    accept, reject = told["ever"]["would_accept"], told["ever"]["would_reject"]
    assert told["shadow"] is True
    assert (accept["n"], accept["wrong"]) == (len(said[Action.ACCEPT]), bad)
    assert (reject["n"], reject["wrong"]) == (len(said[Action.REJECT]), good)
    assert accept["n"] > 50
    lower, upper = wilson_interval(accept["n"] - bad, bad, 0.05)  # whatever the policy's alpha
    assert (accept["lower"], accept["upper"]) == pytest.approx((1 - upper, 1 - lower))
    assert accept["verdict"] == "kept"
    certified = told["certificate"]
    assert certified["accepted"]["shadowed"] is True
    assert f"Of {accept['n']} parts that the model would accept, each of which was checked," in certified["sentence"]
    assert f"Of {reject['n']} parts that the model would reject, each of which was" in certified["sentence_on_rejects"]
    shown = " ".join(CliRunner().invoke(main, ["status", store]).stdout.split())
    assert "would accept" in shown
    assert "the shadow mode, in which it only says what" in re.sub(r"[│┃] *", "", shown)


def test_without_audits_status_says_that_none_was_checked(stream: Dataset, tmp_path: Path) -> None:
    with DataEngine(recipe=RECIPE, store=tmp_path / "engine.db") as engine:
        drive(engine, stream, 0, 60)
        found = status(engine.store).ever
    assert (found.would_accept.n, found.would_accept.upper, found.would_accept.verdict) == (0, 1.0, "open")
    assert "none was checked" in CliRunner().invoke(main, ["status", str(tmp_path / "engine.db")]).stdout
