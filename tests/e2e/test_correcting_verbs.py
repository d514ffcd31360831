"""The verbs that put things right: correct, forget, rollback, policy, retrain.

Real commands on a small store.
"""

import getpass
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dengine import DataEngine, Policy
from dengine.datasets.importing import import_labelled
from dengine.history.status import history
from tests.support.command_line import dengine, document, line_of, refused


@pytest.fixture(scope="module")
def used(make_data, tmp_path_factory):
    """A store with 60 labels and two versions."""
    path = tmp_path_factory.mktemp("used") / "engine.db"
    import_labelled(path, replace(make_data(60), rate_hz=500.0), "pca", 0)
    with DataEngine.open(path) as engine:
        engine.retrain()
        engine.retrain()
    return path


@pytest.fixture
def store(used, tmp_path):
    """A copy, its journal's head beside it."""
    return Path(shutil.copytree(used.parent, tmp_path / "cell")) / used.name


def labels(store: Path) -> dict[int, tuple[str, int]]:
    """Of each label's number its decision and what it says; without those that were forgotten."""
    with DataEngine.open(store) as engine:
        past = [item for item in history(engine.store) if item.success is not None]
    return {item.label_seq: (item.decision.id, int(item.success)) for item in past}


def test_a_label_is_corrected_and_the_line_says_what_it_was(store):
    first, before = labels(store)[1]
    was, now, counts = ("success", "bad", "failure") if before else ("failure", "good", "success")
    line = line_of("correct", store, first, now, "--author", "kim")
    assert line.startswith(f"Decision {first} counts as a {counts}, was a {was}")
    assert line.endswith("Event 1, by kim.")
    assert labels(store)[1] == (first, 1 - before)
    assert "already; nothing changed." in line_of("correct", store, first, now)
    assert line_of("retrain", store).startswith("Version 3 answers. 1 retrain, the worst in ")
    result = document("retrain", store, "--author", "kim")
    assert (result["retrain"]["version"], result["author"]) == (4, "kim")
    with DataEngine.open(store) as engine:  # and a retrain by hand learns it
        assert engine.store.versions.newest().state["labels"][0] == 1 - before
        assert engine.store.events.newest(1)[0].kind == "retrain"


def test_a_part_is_found_and_reported_by_its_number(store, make_data):
    x = make_data(1).X[0]
    with DataEngine.open(store) as engine:
        engine.decide(np.roll(x, 7), "P-7")
        engine.set_policy(replace(engine.policy, force_limits=("0:0:1000::reject",)))
        engine.decide(np.roll(x, 9), "P-8")
        assert "or its HTTP where it is served" in refused("report", store, "P-7", "bad")
    for part, label, event in (("P-8", "good", 2), ("P-7", "bad", 3)):
        line = line_of("report", store, part, label, "--author", "kim")
        assert line.endswith(f" was {label}. Event {event}, by kim.")
    (reject,) = document("history", store, "--part", "P-8")["decisions"]
    assert [reject[name] for name in ("action", "label", "source")] == [
        "reject",
        "good",
        "inspection",
    ]
    assert "good inspection" in line_of("history", store, "--part", "P-8")
    assert "inspection 1" in line_of("status", store)
    assert "failure" in line_of("correct", store, "P-8", "bad", "--author", "kim")
    assert document("explain", store, "P-8")["decision"]["id"] == reject["id"]
    for words in ("correct P-9 good", "explain P-9", "report P-9 good"):
        verb, *words = words.split()
        assert "'P-9', which is unknown" in refused(verb, store, *words)


def test_several_are_forgotten_at_once_or_none_by_whoever_is_logged_in(store, make_data):
    before = labels(store)
    one, two = before.pop(1)[0], before.pop(2)[0]
    assert "'nobody'" in refused("forget", store, one, "nobody")
    line = line_of("forget", store, one, two, "--reason", "wrong part")
    assert line.startswith(f"The labels of {one}, {two} are forgotten: wrong part. Event 1,")
    assert labels(store) == before
    assert document("status", store)["forgotten"] == 2
    with DataEngine.open(store) as engine:
        (event,) = engine.store.events.newest()
    assert (event.kind, event.author) == ("forget", getpass.getuser())
    assert event.data["reason"] == "wrong part"
    assert import_labelled(store, replace(make_data(60), rate_hz=500.0)).repeated == 60


def test_an_earlier_version_answers_again(store):
    line = line_of("rollback", store, 1, "--author", "kim")
    assert line == "Version 1 answers again, as version 3 after 2, and is pinned. Event 1, by kim."
    assert document("status", store)["pinned"] == 1
    assert line_of("release", store).startswith("Version 3 is pinned no more: ")
    assert line_of("release", store) == "No version is pinned; nothing changed."
    assert "load one of these: 1, 2, 3," in refused("rollback", store, 9)
    line_of("rollback", store, 1)
    line_of("retrain", store)
    assert document("status", store)["pinned"] == 0


LIMITS = "0.05:0.1:-5:60:reject"
POLICIES = f"""
--alpha 0.2 => nothing changed
 => alpha 0.2
--force-limit {LIMITS} => force_limits none -> {LIMITS}. Event 2, by
--shadow on --author kim => shadow False -> True
--guarantee own_rule:Mine --shadow off => guarantee local -> own_rule:Mine
"""


def test_a_policy_is_changed_in_what_is_given_and_stays(store, tmp_path, monkeypatch):
    line_of(*f"policy {store} --alpha 0.2 --lower-bound 0.8 --stops all --audit-rate 0.1".split())
    with DataEngine.open(store) as engine:
        assert engine.policy == Policy(0.2, 0.8, audit_rate=0.1, stops="all")
        assert engine.certificate().alpha == 0.2
    rule = "from dengine.decision.rule import DecisionRule\n\nclass Mine(DecisionRule): ...\n"
    (tmp_path / "own_rule.py").write_text(rule)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*sys.path])
    for line in POLICIES.strip("\n").splitlines():
        words, said = line.split(" => ")
        assert said in line_of("policy", store, *words.split())
    assert document("status", store)["shadow"] is False


def test_a_retrain_that_is_dropped_ends_with_1_and_says_why(make_data, tmp_path):
    import_labelled(tmp_path / "a.db", make_data(40, failures=0.0), "rocket", 0)
    failed = dengine("retrain", tmp_path / "a.db")
    assert failed.exit_code == 1
    assert "No version answers yet." in failed.stdout
    assert "dropped" in failed.stderr
