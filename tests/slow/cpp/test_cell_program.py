"""dengine-cell answers lines: labels that come late, stops that count, nothing acknowledged lost,
whatever kills it.
"""

import random
import re
import resource
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from dengine import DataEngine, Dataset, TraceSpec, export_torchscript
from dengine.export import import_journal, make_key
from dengine.export.cell_journal import read_journal
from dengine.records import Action
from tests.support.driving import rule_state
from tests.support.exports import FORCE_LIMITS, SAMPLES, trained
from tests.support.programs import Program, asked, must_agree
from tests.support.tables import rows


class Learned(NamedTuple):
    """A store after its engine's first retrain, and the exported file."""

    store: Path
    file: Path
    key: Path


POLICIES = {
    "local": {"guarantee": "local", "stops": "some", "force_limits": FORCE_LIMITS},
    "pooled": {"guarantee": "pooled", "stops": "some", "audit_rate": 0.6},  # its only evidence
    "all": {"guarantee": "pooled", "stops": "all"},
}


@pytest.fixture(scope="module", params=POLICIES)
def learned(request, make_data, tmp_path_factory):
    folder, data = tmp_path_factory.mktemp(request.param), make_data(400, SAMPLES, noise=1.5)
    settings = {"audit_rate": 0.2} | POLICIES[request.param]
    store, key = folder / "engine.db", make_key(folder / "cell.key")
    with trained(data, store, **settings) as engine:
        return Learned(store, export_torchscript(engine, folder / "model.ts", key=key), key)


ONE = pytest.mark.parametrize("learned", ["local"], indirect=True)


@pytest.fixture
def start(programs, learned, tmp_path):
    """Starts the program, which writes cell.csv."""
    return partial(Program, programs, learned.file, "--journal", tmp_path / "cell.csv")


@pytest.fixture(scope="module")
def X(make_data):  # noqa: N802  # as everywhere
    return make_data(60, SAMPLES, seed=9, noise=1.5).X


def shift(make_data: Callable[..., Dataset], n: int) -> tuple[Dataset, list[tuple[str, int]]]:
    """Parts, some with a number, and what is said in order: to decide on a part, or the label of an
    earlier one; labels come late, or never.
    """
    rng, data = np.random.default_rng(8), make_data(n, SAMPLES, seed=2, noise=1.5)
    X = data.X.copy()
    X[rng.random(n) < 0.04] *= 5.0
    X[rng.random(n) < 0.03, 3] = np.nan
    parts = [f"P{rng.integers(n)}" if rng.random() < 0.7 else None for _ in range(n)]
    late = np.where(rng.random(n) < 0.5, 0, rng.integers(1, 12, n))
    when = np.where(rng.random(n) < 0.8, np.arange(n) + late, n)
    lines = []
    for i in range(n):
        lines += [("decide", i), *(("label", int(k)) for k in np.flatnonzero(when == i))]
    return Dataset(X, data.y, part=np.array(parts)), lines


def state_of(store: Path) -> list[Any]:
    """What a store has learned since its first retrain: evidence, the rule, and what counts."""
    with DataEngine.open(store) as engine:
        outcomes = engine.store.decisions.tally().outcomes
        return [
            [
                (item.lower, item.upper, item.success, item.novel, item.silent)
                for item in engine.store.labels.outcomes_since(400)
            ],
            rule_state(engine),
            engine.store.decisions.counts()["sources"],
            engine.store.labels.with_traces().hashes.tolist(),
            (outcomes.false_accepts, outcomes.confirmed),
            (outcomes.audited_accepts, outcomes.audited_accepts_bad),
        ]


@pytest.mark.merge  # it is what notices that the program and the module in the file part
def test_late_labels_and_stops_count_as_in_the_engine_and_come_into_the_store_as_its_own(
    start, learned, make_data, tmp_path
):
    data, lines = shift(make_data, 160)
    own, imported = (
        Path(shutil.copy(learned.store, tmp_path / name)) for name in ("own.db", "imported.db")
    )
    ids, decisions = [], []
    with DataEngine.open(own, replaying=True) as engine, start("--key", learned.key) as cell:
        # There the engine wants no late label of a confirmed part.
        stops_all = engine.policy.stops == "all"
        for verb, k in lines:
            if verb == "decide":
                decisions.append(engine.decide(data.X[k], data.part[k]))
                answer = cell.decide(data.X[k], data.part[k])
                must_agree([answer], decisions[-1:])
                ids.append(answer[0])
                continue
            is_accepted = decisions[k].action is Action.ACCEPT
            is_confirmed = stops_all and is_accepted and k + 1 < len(decisions)
            if decisions[k].action is Action.REJECT or is_confirmed:
                continue
            engine.report(decisions[k].id, bool(data.y[k]))
            is_stop = is_accepted and not data.y[k]
            text = f"stop {ids[k]}" if is_stop else f"label {ids[k]} {data.y[k]}"
            assert cell.ask(text) == f"ok {ids[k]}"
        rejects = {Action.REJECT} if engine.policy.guarantee == "local" else set()
        assert cell.end() == (0, "")
    assert {d.action for d in decisions} >= {Action.VERIFY, Action.ACCEPT} | rejects
    report = import_journal(imported, tmp_path / "cell.csv")
    assert report.contradicted == report.cut == report.repeated == 0
    assert state_of(imported) == state_of(own)
    k = next(k for verb, k in lines if verb == "label" and decisions[k].action is Action.VERIFY)
    with DataEngine.open(imported) as engine:  # by the id that the cell answered
        assert engine.store.decisions.get(ids[k]).success is bool(data.y[k])


@ONE
def test_a_program_killed_at_any_moment_loses_no_label_that_it_acknowledged_and_decides_on_as_if_it_had_not_been(
    programs, start, learned, make_data, tmp_path
):
    data, lines = shift(make_data, 100)
    rng, ids = random.Random(4), {}

    def play(cell, lines, decided, labels):
        for verb, k in lines:
            if verb == "decide":
                ids[k], *decided[k], _ = cell.decide(data.X[k], data.part[k])
            elif decided[k][0] != "reject":
                assert cell.ask(f"label {ids[k]} {data.y[k]}") == f"ok {ids[k]}"
                labels[ids[k]] = bool(data.y[k])

    whole, decided, acknowledged = {}, {}, {}
    with Program(programs, learned.file) as cell:
        play(cell, lines, whole, {})
    kills = done = 0
    while done < len(lines):
        until = done + rng.randrange(10, 60)
        with start() as cell:
            play(cell, lines[done:until], decided, acknowledged)
            for verb, k in lines[until : until + 1]:
                if verb == "label":  # not acknowledged: said again after the restart
                    cell.process.stdin.write(f"label {ids[k]} {data.y[k]}\n")
        kills, done = kills + 1, until
    assert kills > 3
    assert decided == whole
    stored = read_journal(tmp_path / "cell.csv", TraceSpec(SAMPLES)).lines
    labels = {line.decision.id: line.label for line in stored if line.label is not None}
    assert acknowledged.items() <= labels.items()


WRONG = """
label VERIFY 0; has the other label already
label REJECT 1; was rejected
stop VERIFY; was to be verified and cannot stop the system
label nobody 1; expected the id of one of the last 10000 decisions, got "nobody"
label VERIFY 100; expected label ID 0|1
stop; expected stop ID
1,2,3; expected decide, label or stop
"""


@ONE
def test_a_label_is_taken_once_and_never_changed(start, X, tmp_path):
    journal, ids = tmp_path / "cell.csv", {}

    def say(cell, line):
        return cell.ask(re.sub("VERIFY|ACCEPT|REJECT", lambda word: ids[word[0]], line))

    with start() as cell:
        for x in X:
            id_, action = cell.decide(x)[:2]
            ids.setdefault(action.upper(), id_)
        for line in ("label VERIFY 1", "stop ACCEPT"):
            assert say(cell, line).startswith("ok ")
        n = journal.read_text().count("\n")
        # An answer that was lost is asked for again.
        for line in ("label VERIFY 1", "stop ACCEPT", "label ACCEPT 0"):
            assert say(cell, line).startswith("ok ")
        for line, message in rows(WRONG, at="; "):
            answer = say(cell, line)
            assert answer.startswith("error ")
            assert message in answer
        assert journal.read_text().count("\n") == n
        assert cell.end()[0] == 1
    with start() as cell:  # after a restart, too
        assert "has the other label already" in say(cell, "label VERIFY 0")
        with start() as second:  # two do not write one journal
            second.must_refuse("is being written by another program")


MALFORMED = """
decide a b c; expected decide [PART] TRACE
decide P1, 1,2; without commas
decide 1;2; cannot read 1;2
decide /; no trace's file
decide 1,2; expected 100 samples, got 2
"""


@ONE
def test_traces_come_from_files_too_and_one_that_cannot_be_read_is_verified(
    programs, learned, X, tmp_path
):
    X[0].tofile(tmp_path / "trace.f32")
    (tmp_path / "column.txt").write_text("\n".join(map(str, X[0])))
    (tmp_path / "short.f32").write_bytes(X[0].tobytes()[:-3])
    good = asked(X[0], "P1")
    wrong = [line.rpartition("; ")[::2] for (line,) in rows(MALFORMED, 1)]
    wrong += [
        (f"decide {tmp_path / 'short.f32'}", "expected 400 bytes, got 397"),
        (good + "N", "expected a number in column 100, got"),
        (good.replace("P1", "P\x01"), "expected a part's number in UTF-8"),
    ]
    with Program(programs, learned.file) as cell:
        texts = [f"decide P1 {tmp_path / name}" for name in ("trace.f32", "column.txt")]
        answers = [cell.ask(line).split(",")[1:-1] for line in (good, good + "\r", *texts)]
        assert answers == answers[:1] * 4
        for line, _ in wrong:
            assert cell.ask(line).startswith("-,verify,malformed,0,1,0,0,")
        code, text = cell.end()
    assert code == 1
    for line, (_, why) in zip(text.splitlines(), wrong, strict=True):
        assert why in line


@ONE
def test_a_full_disk_costs_no_label_that_was_acknowledged_and_no_decision(start, X, tmp_path):
    acknowledged, refused, limit = set(), 0, (20_000, 20_000)  # bytes that the journal may have
    with start(preexec_fn=partial(resource.setrlimit, resource.RLIMIT_FSIZE, limit)) as cell:
        for x in X:
            id_, action, reason = cell.decide(x)[:3]
            if id_ == "-":
                assert (action, reason) == ("verify", "journal_error")
                refused += 1
            elif action == "verify" and cell.ask(f"label {id_} 1").startswith("ok"):
                acknowledged.add(id_)
        assert cell.end()[0] == 1
    assert refused > 10
    journal = read_journal(tmp_path / "cell.csv", TraceSpec(SAMPLES))  # no half line is left
    assert journal.cut == 0
    assert acknowledged <= {line.decision.id for line in journal.lines if line.label}
    with start() as cell:  # there is room again
        assert cell.decide(X[0])[0] != "-"
