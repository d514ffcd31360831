"""dengine-cell answers lines: labels that come late, stops that count, nothing acknowledged lost,
whatever kills it.
"""

import random
import resource
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from dengine import DataEngine, Dataset, TraceSpec, export_torchscript
from dengine.export import import_journal, make_key
from dengine.export.cell_journal import read_journal
from dengine.records import Action
from tests.support.exports import FORCE_LIMITS, SAMPLES, trained
from tests.support.programs import Program, asked, must_agree


class Learned(NamedTuple):
    """A store after its engine's first retrain, and the exported file."""

    store: Path
    file: Path
    key: Path
    guarantee: str


POLICIES = {
    "local": {"guarantee": "local", "stops": "some", "force_limits": FORCE_LIMITS},
    "pooled": {"guarantee": "pooled", "stops": "some", "audit_rate": 0.6},  # its only evidence
    "all": {"guarantee": "pooled", "stops": "all"},
}


@pytest.fixture(scope="module", params=POLICIES)
def learned(request, make_data: Callable[..., Dataset], tmp_path_factory) -> Learned:
    folder, data = tmp_path_factory.mktemp(request.param), make_data(400, SAMPLES, noise=1.5)
    settings = {"audit_rate": 0.2} | POLICIES[request.param]
    key = make_key(folder / "cell.key")
    with trained(data, folder / "engine.db", **settings) as engine:
        return Learned(
            folder / "engine.db",
            export_torchscript(engine, folder / "model.ts", key=key),
            key,
            settings["guarantee"],
        )


ONE = pytest.mark.parametrize("learned", ["local"], indirect=True)


@pytest.fixture
def start(programs: Path, learned: Learned, tmp_path: Path) -> Callable[..., Program]:
    """Starts the program, which writes cell.csv."""
    return partial(Program, programs, learned.file, "--journal", tmp_path / "cell.csv")


@pytest.fixture(scope="module")
def X(make_data: Callable[..., Dataset]) -> np.ndarray:  # noqa: N802  # as everywhere
    return make_data(60, SAMPLES, seed=9, noise=1.5).X


def stream(
    make_data: Callable[..., Dataset], n: int
) -> tuple[np.ndarray, np.ndarray, list[str | None], list[list[int]]]:
    """Traces, labels, parts, and after each trace the indices of the parts whose label comes then:
    late, or never.
    """
    rng, data = np.random.default_rng(8), make_data(n, SAMPLES, seed=2, noise=1.5)
    X = data.X.copy()
    X[rng.random(n) < 0.04] *= 5.0
    X[rng.random(n) < 0.03, 3] = np.nan
    parts = [f"P{rng.integers(n)}" if rng.random() < 0.7 else None for _ in range(n)]
    due: list[list[int]] = [[] for _ in range(n)]
    for i in range(n):
        when = i + (0 if rng.random() < 0.5 else int(rng.integers(1, 12)))
        if rng.random() < 0.8 and when < n:
            due[when].append(i)
    return X, data.y, parts, due


@pytest.mark.merge  # it is what notices that the program and the module in the file part
def test_late_labels_and_stops_count_as_in_the_engine_and_come_into_the_store_as_its_own(
    start: Callable[..., Program],
    learned: Learned,
    make_data: Callable[..., Dataset],
    tmp_path: Path,
) -> None:
    X, y, parts, due = stream(make_data, 160)
    journal, ids, decisions, told_of = tmp_path / "cell.csv", [], [], 0
    for name in ("own", "imported"):
        shutil.copy(learned.store, tmp_path / f"{name}.db")
    with (
        DataEngine.open(tmp_path / "own.db", replaying=True) as engine,
        start("--key", learned.key) as cell,
    ):
        stops_all = (
            engine.policy.stops == "all"
        )  # there the engine wants no late label of a confirmed part
        for i, (x, part) in enumerate(zip(X, parts, strict=True)):
            decisions.append(engine.decide(x, part))
            must_agree([answer := cell.decide(x, part)], decisions[-1:])
            ids.append(answer[0])
            for k in due[i]:
                if decisions[k].action is Action.REJECT or (
                    stops_all and k != i and decisions[k].action is Action.ACCEPT
                ):
                    continue
                engine.report(decisions[k].id, bool(y[k]))
                stop = decisions[k].action is Action.ACCEPT and not y[k]
                text = cell.ask(f"stop {ids[k]}" if stop else f"label {ids[k]} {y[k]}")
                assert text == f"ok {ids[k]}"
                told_of += k != i
        assert cell.end() == (0, "")
    assert told_of > 20
    rejects = [Action.REJECT] if learned.guarantee == "local" else []
    assert {d.action for d in decisions} >= {Action.VERIFY, Action.ACCEPT, *rejects}
    report = import_journal(tmp_path / "imported.db", journal)
    assert report.contradicted == report.cut == report.repeated == 0
    results = []
    for name in ("imported", "own"):
        with DataEngine.open(tmp_path / f"{name}.db") as engine:
            records, outcomes = (
                engine.store.labels.outcomes_since(400),
                engine.store.decisions.tally().outcomes,
            )
            rule = {key: value.tolist() for key, value in engine.model.rule.state_dict().items()}
            evidence = [
                (item.lower, item.upper, item.success, item.novel, item.silent) for item in records
            ]
            certain = (
                outcomes.false_accepts,
                outcomes.confirmed,
                outcomes.audited_accepts,
                outcomes.audited_accepts_bad,
            )
            hashes = engine.store.labels.with_traces().hashes.tolist()
            results.append(
                [evidence, rule, engine.store.decisions.counts()["sources"], hashes, certain]
            )
    assert results[0] == results[1]
    with DataEngine.open(tmp_path / "imported.db") as engine:
        labelled = next(
            k for k, d in enumerate(decisions) if k in due[k] and d.action is Action.VERIFY
        )
        assert engine.store.decisions.get(ids[labelled]).success is bool(
            y[labelled]
        )  # by the id that the cell answered


def test_a_program_killed_at_any_moment_loses_no_label_that_it_acknowledged_and_decides_on_as_if_it_had_not_been(
    programs: Path,
    start: Callable[..., Program],
    learned: Learned,
    make_data: Callable[..., Dataset],
    tmp_path: Path,
) -> None:
    X, y, parts, due = stream(make_data, 100)
    rng = random.Random(4)
    lines: list[tuple[str, int]] = []  # what is said: a part, or a label of one
    for i in range(len(X)):
        lines += [("decide", i), *(("label", k) for k in due[i])]
    ids: dict[int, str] = {}
    acknowledged: dict[str, bool] = {}

    def play(cell: Program, first: int, last: int, decided: dict[int, list[str]]) -> None:
        for kind, k in lines[first:last]:
            if kind == "decide":
                ids[k], *decided[k], _ = cell.decide(X[k], parts[k])
            elif decided[k][0] != "reject":
                assert cell.ask(f"label {ids[k]} {y[k]}") == f"ok {ids[k]}"
                acknowledged[ids[k]] = bool(y[k])

    whole: dict[int, list[str]] = {}
    with Program(programs, learned.file) as cell:
        play(cell, 0, len(lines), whole)
    acknowledged.clear()
    decided: dict[int, list[str]] = {}
    kills = done = 0
    while done < len(lines):
        until = min(len(lines), done + rng.randrange(10, 60))
        with start() as cell:
            play(cell, done, until, decided)
            if (
                until < len(lines) and lines[until][0] == "label"
            ):  # not acknowledged: said again after the restart
                k = lines[until][1]
                cell.process.stdin.write(f"label {ids[k]} {y[k]}\n")
        kills, done = kills + 1, until
    assert kills > 3
    assert decided == whole
    stored = read_journal(tmp_path / "cell.csv", TraceSpec(SAMPLES)).lines
    assert (
        acknowledged.items()
        <= {line.decision.id: line.label for line in stored if line.label is not None}.items()
    )


@ONE
def test_a_label_is_taken_once_and_never_changed(
    start: Callable[..., Program], X: np.ndarray, tmp_path: Path
) -> None:
    journal, ids = tmp_path / "cell.csv", {}
    with start() as cell:
        for x in X:
            id_, action = cell.decide(x)[:2]
            ids.setdefault(action, id_)
        assert set(ids) == {"verify", "accept", "reject"}
        assert cell.ask(f"label {ids['verify']} 1") == f"ok {ids['verify']}"
        assert cell.ask(f"stop {ids['accept']}") == f"ok {ids['accept']}"
        n = journal.read_text().count("\n")
        for again in (
            f"label {ids['verify']} 1",
            f"stop {ids['accept']}",
            f"label {ids['accept']} 0",
        ):
            assert cell.ask(again).startswith("ok ")  # an answer that was lost is asked for again
        wrong = {
            f"label {ids['verify']} 0": "has the other label already",
            f"label {ids['reject']} 1": "was rejected",
            f"stop {ids['verify']}": "was to be verified and cannot stop the system",
            "label nobody 1": 'expected the id of one of the last 10000 decisions, got "nobody"',
            f"label {ids['verify']} 100": "expected label ID 0|1",
            "stop": "expected stop ID",
            "1,2,3": "expected decide, label or stop",
        }
        for line, message in wrong.items():
            answer = cell.ask(line)
            assert answer.startswith("error ")
            assert message in answer
        assert journal.read_text().count("\n") == n
        assert cell.end()[0] == 1
    with start() as cell:  # after a restart, too
        assert "has the other label already" in cell.ask(f"label {ids['verify']} 0")
        with start() as second:  # two do not write one journal
            second.must_refuse("is being written by another program")


@ONE
def test_traces_come_from_files_too_and_one_that_cannot_be_read_is_verified(
    programs, learned, X, tmp_path: Path
) -> None:
    X[0].tofile(tmp_path / "trace.f32")
    (tmp_path / "column.txt").write_text("\n".join(map(str, X[0])))
    (tmp_path / "short.f32").write_bytes(X[0].tobytes()[:-3])
    good = asked(X[0], "P1")
    wrong = {
        "decide": "expected decide [PART] TRACE",
        "decide a b c": "expected decide [PART] TRACE",
        "decide P1, 1,2": "without commas",
        "decide 1;2": "cannot read 1;2",
        good.replace("P1", "P\x01"): "expected a part's number in UTF-8",
        f"decide {tmp_path / 'short.f32'}": "expected 400 bytes, got 397",
        f"decide {tmp_path}": "no trace's file",
        good.rsplit(",", 1)[0]: "expected 100 samples, got 99",
        good.rsplit(",", 1)[0] + ",12N": 'expected a number in column 100, got "12N"',
    }
    with Program(programs, learned.file) as cell:
        texts = [f"decide P1 {tmp_path / name}" for name in ("trace.f32", "column.txt")]
        answers = [cell.ask(line) for line in (good, good + "\r", *texts)]
        assert len({answer.split(",", 1)[1].rsplit(",", 1)[0] for answer in answers}) == 1
        for line in wrong:
            assert cell.ask(line).startswith("-,verify,malformed,0,1,0,0,")
        code, texts = cell.end()
    assert code == 1
    for line, why in zip(texts.splitlines(), wrong.values(), strict=True):
        assert "is malformed: " in line
        assert why in line


@ONE
def test_a_full_disk_costs_no_label_that_was_acknowledged_and_no_decision(
    start, X: np.ndarray, tmp_path: Path
) -> None:
    acknowledged, refused = [], 0
    full = partial(
        resource.setrlimit, resource.RLIMIT_FSIZE, (20_000, 20_000)
    )  # bytes that the journal may have
    with start(preexec_fn=full) as cell:
        for x in X:
            id_, action, reason = cell.decide(x)[:3]
            if id_ == "-":
                assert (action, reason) == ("verify", "journal_error")
                refused += 1
            elif action == "verify" and (answer := cell.ask(f"label {id_} 1")).startswith("ok"):
                acknowledged.append(id_)
            elif action == "verify":
                assert "cannot be written: File too large" in answer
        assert cell.end()[0] == 1
    assert refused > 10
    journal = read_journal(tmp_path / "cell.csv", TraceSpec(SAMPLES))  # no half line is left
    assert journal.cut == 0
    assert set(acknowledged) <= {line.decision.id for line in journal.lines if line.label}
    with start() as cell:  # there is room again
        assert cell.decide(X[0])[0] != "-"
