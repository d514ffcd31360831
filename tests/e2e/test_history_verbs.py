"""`dengine history`, `explain` and `status`: what they print, of a store that has seen a little of
everything.
"""

from pathlib import Path

import numpy as np
import pytest

from dengine import Action, DataEngine, Dataset, Policy, ReplayCell
from dengine.cli.history import TABLE_WIDTH
from dengine.decision.intervals import wilson_interval
from dengine.history.status import bad_accepts
from dengine.store.records import Outcomes
from tests.support.command_line import dengine, document, line_of, succeed
from tests.support.driving import RECIPE, drive, easy_parts


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """700 parts; from the 301st to the 400th the sensor is hit by a wave, which puts the engine
    into safe mode.
    """
    data = easy_parts(700, 1, wave=slice(300, 400))
    data.X[650, 3] = np.nan
    data.y[np.random.default_rng(2).random(700) < 0.02] ^= 1
    path = tmp_path_factory.mktemp("store") / "engine.db"
    policy = Policy(alpha=0.2, lower_bound=0.8, guarantee="pooled", stops="all", audit_rate=0.05)
    with DataEngine("pca", policy, store=str(path), replaying=True) as engine:
        for _ in engine.run(ReplayCell(data), 700):
            pass
    return path


def test_a_history_fits_120_columns_and_its_newest_line_is_the_newest_decision(store: Path) -> None:
    shown = succeed("history", store, "--last", 400, "--events").splitlines()
    assert max(map(len, shown)) <= TABLE_WIDTH == 120
    newest = document("history", store, "--last", 1)["decisions"][0]
    assert newest["id"] in shown[-1]
    assert sum("  * retrain to version" in line for line in shown) >= 5
    assert any("  * safe mode ended:" in line for line in shown)
    assert len([line for line in shown if newest["id"][:12] in line]) == 400


def test_a_historys_filters_are_those_of_the_document(store: Path) -> None:
    asked = {"action": "accept", "reason": "certain", "label": "bad", "predicted": "accept"}
    words = [
        word
        for name, value in asked.items()
        for word in (f"--{name.replace('predicted', 'model')}", value)
    ]
    decisions = document("history", store, "--last", 1000, *words)["decisions"]
    assert {tuple(item[name] for name in asked) for item in decisions} == {tuple(asked.values())}
    assert document("history", store, "--since", "1h", "--last", 1000)["decisions"]
    assert document("history", store, "--since", "2100-01-01")["decisions"] == []
    assert succeed("history", store, "--since", "2100-01-01") == "No decision of that kind.\n"
    assert document("history", store, "--until", "2001-01-01T10:00")["decisions"] == []


@pytest.mark.parametrize(
    ("verb", "words", "expected"),
    [
        (
            "history",
            "--since yesterday",
            "expected 30m, 12h, 7d or 2026-03-01T14:30, got 'yesterday'",
        ),
        ("history", "--action pass", "'pass' is not one of"),
        ("history", "--reason why", "'why' is not one of"),
        ("history", "--last 0", "0 is not in the range"),
        (
            "explain",
            "nonsense",
            "or a decision's id, got 'nonsense', which is unknown; `dengine history STORE`",
        ),
    ],
)
def test_a_wrong_word_is_a_wrong_call(verb: str, words: str, expected: str, store: Path) -> None:
    result = dengine(verb, store, *words.split())
    assert result.exit_code == (1 if verb == "explain" else 2)
    assert expected in result.stderr


def ids(store: Path) -> dict[str, str]:
    """The newest decision of each reason."""
    return {
        decision["reason"]: decision["id"]
        for decision in document("history", store, "--last", 1000)["decisions"]
    }


def test_every_reason_is_explained_in_80_columns_with_a_picture(
    store: Path, tmp_path: Path
) -> None:
    ids_by_reason = ids(store)
    assert {"certain", "uncertain", "audit", "novel", "safe_mode", "no_model", "not_finite"} <= set(
        ids_by_reason
    )
    for reason, id_ in ids_by_reason.items():
        out = tmp_path / f"{reason}.png"
        shown = succeed("explain", store, id_, "--out", out)
        assert id_ in shown
        assert out.read_bytes().startswith(b"\x89PNG")
        assert out.stat().st_size > 20_000


def test_an_explanations_document_is_its_record(store: Path) -> None:
    result = document("explain", store, ids(store)["certain"], "--neighbours", 4)
    assert result["decision"]["id"] == ids(store)["certain"]
    assert len(result["neighbours"]) == 4
    assert all(item["decision_id"] and "trace" not in item for item in result["neighbours"])
    assert result["bound"]["n_success"] == result["decision"]["n_success"]
    assert 0.0 <= result["envelope"]["outside"] <= 1.0
    assert result["sentences"][0].endswith("the bound meets the policy.")
    newest = document("history", store, "--last", 1)["decisions"][0]
    assert document("explain", store, "last")["decision"] | {"label": newest["label"]} == newest


def test_status_counts_the_newest_apart_from_all(store: Path) -> None:
    result = document("status", store, "--last", 200)
    decisions = document("history", store, "--last", 1000)["decisions"]
    for name, some in (("newest", decisions[-200:]), ("ever", decisions)):
        span = result[name]
        counts = {
            "decisions": len(some),
            "novel": sum(item["reason"] == "novel" for item in some),
            "audits": sum(item["audit"] for item in some),
            "quarantined": 1,
        }
        for action, counted in {"accept": "accepted", "reject": "rejected"}.items():
            counts[counted] = sum(item["action"] == action for item in some)
        counts["verified"] = len(some) - counts["accepted"] - counts["rejected"]
        assert {key: span[key] for key in counts} == counts
        labels = [item["label"] for item in some if item["action"] == "accept"]
        bad, known = labels.count("bad"), labels.count("bad") + labels.count("good")
        lower, upper = wilson_interval(known - bad, bad, 0.2)
        accepts = span["bad_accepts"]
        assert (accepts["n_known"], accepts["n_wrong"]) == (known, bad)
        assert (accepts["lower"], accepts["upper"]) == pytest.approx((1 - upper, 1 - lower))
    assert result["newest"]["retrains"] < result["ever"]["retrains"] == len(result["retrains"])
    assert set(result["watch"]) == {"recovery", "accepts", "rejects", "novelty"}
    assert 0 <= result["new_labels"] <= result["recipe"]["retrain_every"] == 50


def test_a_store_without_decisions_is_shown_and_dropped_retrains_have_their_reasons(
    tmp_path: Path,
) -> None:
    file = tmp_path / "new.db"
    DataEngine("pca", store=file).close()
    assert "none is known" in succeed("status", file)
    assert document("status", file)["ever"]["verified_share"] is None
    assert dengine("explain", file, "last").exit_code == 1
    with DataEngine.open(file) as engine:
        engine.decide(np.arange(30.0))
        engine.retrain()
        dropped = engine.retrain()
    ever = document("status", file)["ever"]
    assert (ever["dropped"], ever["unlabelled"]) == ({dropped.reason: 2}, 1)


def test_known_escapes_stand_first_in_status_which_never_says_that_none_is_known(
    stream: Dataset, tmp_path: Path
) -> None:
    with DataEngine(recipe=RECIPE, store=(store := tmp_path / "engine.db")) as engine:
        cycles = drive(engine, stream, 0, 300)
        accepted = next(
            cycle
            for cycle in reversed(cycles)
            if cycle.decision.action is Action.ACCEPT and cycle.success is None
        )
        engine.report(accepted.decision.id, False)
    words = " ".join(succeed("status", store).split())
    assert (words.split("│")[1].strip(), document("status", store)["ever"]["false_accepts"]) == (
        "accepted, and bad",
        1,
    )
    assert "1 stop; else unknown" in words


def test_what_is_known_of_bad_accepts_depends_on_who_tells() -> None:
    some, every = (
        Policy(alpha=0.1, lower_bound=0.9),
        Policy(alpha=0.1, lower_bound=0.9, stops="all"),
    )
    silent = Outcomes(50, 3, 0, 0, 0, 0, 0, 0)
    assert (bad_accepts(silent, some).basis, bad_accepts(silent, some).upper) == ("", 1.0)
    confirmed = Outcomes(50, 3, 47, 0, 0, 0, 0, 0)
    assert bad_accepts(confirmed, some) == bad_accepts(confirmed, every)
    assert (bad_accepts(confirmed, every).n_known, bad_accepts(confirmed, every).n_wrong) == (50, 3)
    audited = Outcomes(50, 3, 0, 40, 0, 0, 0, 0)
    assert (bad_accepts(audited, some).basis, bad_accepts(audited, some).n_known) == ("audits", 40)
    assert bad_accepts(audited, some).verdict == "kept"
    assert (
        bad_accepts(Outcomes(50, 6, 0, 40, 0, 0, 0, 0), some).verdict == "open"
    )  # as many as 6 of 50 are known to be bad
    assert bad_accepts(Outcomes(50, 20, 0, 40, 0, 0, 0, 0), some).verdict == "broken"
    assert bad_accepts(Outcomes(50, 30, 20, 0, 0, 0, 0, 0), every).verdict == "broken"
    assert bad_accepts(Outcomes(10, 1, 9, 0, 0, 0, 0, 0), every).verdict == "open"
    assert bad_accepts(Outcomes(*[0] * 8), every).upper == 1.0


def test_status_counts_what_the_shadow_mode_would_have_done_against_what_was_true(
    stream: Dataset, tmp_path: Path
) -> None:
    store = tmp_path / "engine.db"
    with DataEngine(recipe=RECIPE, store=store) as engine:
        drive(engine, stream, 0, 30)
        assert "would accept │ none is known" in " ".join(succeed("status", store).split())
        engine.set_shadow(True)
        cycles = drive(engine, stream, 30, 300)
    certain = [cycle for cycle in cycles if cycle.decision.audit]
    result = document("status", store)
    assert result["shadow"] is True
    for name, action in (("would_accept", Action.ACCEPT), ("would_reject", Action.REJECT)):
        true = [cycle.success for cycle in certain if cycle.decision.predicted is action]
        wrong = true.count(action is Action.REJECT)
        span = result["ever"][name]
        lower, upper = wilson_interval(len(true) - wrong, wrong, 0.05)  # whatever the policy's
        assert (span["n"], span["n_wrong"]) == (len(true), wrong)
        assert (span["lower"], span["upper"]) == pytest.approx((1 - upper, 1 - lower))
    accept = result["ever"]["would_accept"]
    assert (accept["n"] > 50, accept["verdict"]) == (True, "kept")
    assert result["certificate"]["accepted"]["shadowed"]
    assert result["ever"]["bad_accepts"]["n_known"] == 0  # nothing was accepted
    n, words = len(certain), line_of("status", store, "--check-seconds", "60")
    assert f"decided {n} of the {result['ever']['verified']} parts" in words
    assert f": {60 * n} s of" in words
