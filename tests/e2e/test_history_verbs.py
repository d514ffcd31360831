"""`dengine history`, `explain` and `status`: what they print, of a store that has seen a little of
everything.
"""

import re
from collections import Counter
from typing import Any

import numpy as np
import pytest

from dengine import Action, DataEngine, Policy
from dengine.cli.history import TABLE_WIDTH
from dengine.decision.intervals import wilson_interval
from dengine.errors import outward
from dengine.history.status import bad_accepts
from dengine.store.records import Outcomes
from tests.support.command_line import dengine, document, line_of, succeed
from tests.support.driving import RECIPE, drive, easy_parts


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """700 parts; from the 301st to the 400th the sensor is hit by a wave, which puts the engine
    into safe mode.
    """
    data = easy_parts(700, 1, wave=slice(300, 400))
    data.X[650, 3] = np.nan
    data.y[np.random.default_rng(2).random(700) < 0.02] ^= 1
    path = tmp_path_factory.mktemp("store") / "engine.db"
    policy = Policy(alpha=0.2, lower_bound=0.8, guarantee="pooled", stops="all", audit_rate=0.05)
    with DataEngine("pca", policy, store=path, replaying=True) as engine:
        drive(engine, data)
    return path


def test_a_history_fits_120_columns_and_shows_no_bound_as_a_threshold_that_it_misses(
    store, decisions
):
    shown = succeed("history", store, "--last", 700, "--events").splitlines()
    assert max(map(len, shown)) <= TABLE_WIDTH == 120
    assert sum("  * retrain to version" in line for line in shown) >= 5
    assert any("  * safe mode ended:" in line for line in shown)
    rows = [line.split() for line in shown if decisions[0]["id"][:12] in line]
    n_rounded = 0
    for decision, words in zip(decisions, rows, strict=True):
        assert decision["id"] in words
        ends = next(filter(re.compile(r"\d\.\d\d-\d\.\d\d").fullmatch, words), None)
        if ends is not None:
            lower, upper = map(float, ends.split("-"))
            assert decision["lower"] - 0.01 < lower <= decision["lower"] + 1e-9
            assert decision["upper"] - 1e-9 <= upper < decision["upper"] + 0.01
            n_rounded += lower != decision["lower"]
    assert n_rounded > 100
    assert outward(0.07, 0.29, 2) == (0.07, 0.29)  # 100 times these is not a whole number


def test_a_historys_filters_are_those_of_the_document(store):
    words = "--last 1000 --since 1h --action accept --reason certain --label bad --model accept"
    names = ("action", "reason", "label", "predicted")
    found = document("history", store, *words.split())["decisions"]
    assert {tuple(item[name] for name in names) for item in found} == {
        ("accept", "certain", "bad", "accept")
    }
    for words in ("--since 2100-01-01", "--until 2001-01-01T10:00"):
        assert succeed("history", store, *words.split()) == "No decision of that kind.\n"


def test_an_explanations_document_is_its_record(store, decisions, tmp_path):
    certain = next(item["id"] for item in decisions[::-1] if item["reason"] == "certain")
    out = tmp_path / "picture.png"
    result = document("explain", store, certain, "--neighbours", 4, "--out", out)
    assert out.read_bytes().startswith(b"\x89PNG")
    assert result["decision"]["id"] == certain
    assert len({item["decision_id"] for item in result["neighbours"]}) == 4
    assert result["bound"]["n_success"] == result["decision"]["n_success"]
    assert result["sentences"][0].endswith("the bound meets the policy.")
    last = document("explain", store, "last")["decision"]
    assert last | {"label": decisions[-1]["label"]} == decisions[-1]


def test_status_counts_the_newest_apart_from_all(store, decisions):
    result = document("status", store, "--last", 200)
    for name, some in (("newest", decisions[-200:]), ("ever", decisions)):
        span, actions = result[name], Counter(item["action"] for item in some)
        assert span["decisions"] == len(some)
        for count, action in (
            ("accepted", "accept"),
            ("rejected", "reject"),
            ("verified", "verify"),
        ):
            assert span[count] == actions[action]
        labels = [item["label"] for item in some if item["action"] == "accept" and item["label"]]
        bad = labels.count("bad")
        assert shares(span["bad_accepts"], "n_known") == share_of(bad, len(labels), 0.2)
    assert result["newest"]["retrains"] < result["ever"]["retrains"] == len(result["retrains"])
    assert set(result["watch"]) == {"recovery", "accepts", "rejects", "novelty"}
    assert 0 <= result["new_labels"] <= result["recipe"]["retrain_every"] == 50


def test_a_store_without_decisions_is_shown_and_dropped_retrains_have_their_reasons(
    tmp_path,
):
    file = tmp_path / "new.db"
    DataEngine("pca", store=file).close()
    assert "none is known" in succeed("status", file)
    assert document("status", file)["ever"]["verified_share"] is None
    assert dengine("explain", file, "last").exit_code == 1
    with DataEngine.open(file) as engine:
        engine.decide(np.arange(30.0))
        dropped = engine.retrain()
    ever = document("status", file)["ever"]
    assert (ever["dropped"], ever["unlabelled"]) == ({dropped.reason: 1}, 1)


def test_what_is_known_of_bad_accepts_depends_on_who_tells():
    for line in KNOWN.strip().splitlines():
        stops, *counts = line[:16].split()
        n_known, verdict = line[30:].split()
        policy = Policy(alpha=0.1, lower_bound=0.9, stops=stops)
        known = bad_accepts(Outcomes(*map(int, counts)), policy)
        assert (known.basis, known.n_known) == (line[16:30].strip(), int(n_known)), line
        assert known.verdict == verdict, line
    assert bad_accepts(Outcomes(50, 3), policy).upper == bad_accepts(Outcomes(), policy).upper == 1


def test_status_counts_what_the_shadow_mode_would_have_done_against_what_was_true(stream, tmp_path):
    store = tmp_path / "engine.db"
    with DataEngine(recipe=RECIPE, store=store) as engine:
        drive(engine, stream, 0, 30)
        assert "would accept none is known" in line_of("status", store)
        engine.set_shadow(True)
        certain = [cycle for cycle in drive(engine, stream, 30, 300) if cycle.decision.audit]
    result = document("status", store)
    for name, good in (("would_accept", True), ("would_reject", False)):
        predicted = Action.ACCEPT if good else Action.REJECT
        true = [cycle.success for cycle in certain if cycle.decision.predicted is predicted]
        share = share_of(true.count(not good), len(true), 0.05)  # whatever the policy's alpha is
        assert shares(result["ever"][name], "n") == share
    ever, certified = result["ever"], result["certificate"]["accepted"]
    assert ever["would_accept"]["n"] > 50
    assert ever["would_accept"]["verdict"] == "kept"
    assert result["shadow"] is certified["shadowed"] is True
    assert ever["bad_accepts"]["n_known"] == 0  # nothing was accepted
    words = line_of("status", store, "--check-seconds", "60")
    assert f"decided {len(certain)} of the {ever['verified']} parts" in words
    assert f": {60 * len(certain)} s of" in words


# Who tells of stops; parts that were accepted, bad ones among them, confirmed good ones, and audited ones; what is known.
KNOWN = """
some 50  3  0  0               0 open
some 50  3 47  0 every outcome 50 open
all  50  3 47  0 every outcome 50 open
some 50  3  0 40 audits        40 kept
some 50  6  0 40 audits        40 open
some 50 20  0 40 audits        40 broken
all  50 30 20  0 every outcome 50 broken
all  10  1  9  0 every outcome 10 open
"""


def shares(row: dict, n: str) -> list:
    """A share with its interval, as a document has them."""
    return [row[name] for name in (n, "n_wrong", "lower", "upper")]


def share_of(wrong: int, n: int, alpha: float) -> Any:
    """A share with Wilson's interval."""
    lower, upper = wilson_interval(n - wrong, wrong, alpha)
    return pytest.approx([n, wrong, 1 - upper, 1 - lower])


@pytest.fixture(scope="module")
def decisions(store):
    """All decisions of the store, oldest first."""
    return document("history", store, "--last", 1000)["decisions"]
