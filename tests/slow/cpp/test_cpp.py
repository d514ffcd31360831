"""The cell program without Python decides as the engine does, learns, and refuses what it must not use."""

import hashlib
import hmac
import subprocess
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dengine import DataEngine, Dataset, TraceSpec, export_torchscript, load_exported
from dengine.export import import_journal
from dengine.records import Action, Reason
from tests.support.exports import SAMPLES, fitted, trained, wild_traces

BALLS = {"fraction": 0.3, "reject_fraction": 0.08}


@pytest.fixture(scope="module")
def engine(make_data: Callable[..., Dataset]) -> Iterator[DataEngine]:
    with trained(make_data(400, SAMPLES), audit_rate=0.3, **BALLS) as engine:
        yield engine


@pytest.fixture(scope="module")
def file(engine: DataEngine, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export_torchscript(engine, tmp_path_factory.mktemp("cell") / "model.ts")


@pytest.fixture(scope="module")
def many(make_data: Callable[..., Dataset]) -> np.ndarray:
    return wild_traces(make_data(300, SAMPLES, seed=9).X)


def cell(programs: Path, *arguments: Any, stdin: bytes = b"", fails: bool = False) -> tuple[list[list[str]], str]:
    """The program's lines, split at commas, and what it said on stderr."""
    command = [str(programs / "dengine-cell"), *map(str, arguments)]
    done = subprocess.run(command, input=stdin, capture_output=True, check=False, timeout=120)
    assert done.returncode == (1 if fails else 0), done.stderr.decode()
    return [line.split(",") for line in done.stdout.decode().splitlines()], done.stderr.decode()


def csv(X: np.ndarray, labels: Any = None, parts: Any = None) -> bytes:
    rows = [",".join(f"{value:.9g}" for value in x.ravel()) for x in X]
    for column in (labels, parts):
        if column is not None:
            rows = [f"{word},{row}" for word, row in zip(column, rows, strict=True)]
    return "\n".join(rows).encode() + b"\n"


def assert_equal(lines: list[list[str]], decisions: list[Any], width: int) -> None:
    assert len(lines) == len(decisions)
    for line, decision in zip(lines, decisions, strict=True):
        assert len(line) == 6 + width + 1
        assert line[:2] == [str(decision.action), str(decision.reason)]
        assert [float(line[2]), float(line[3])] == pytest.approx([decision.lower, decision.upper], abs=1e-6)
        assert [int(line[4]), int(line[5])] == [decision.n_success, decision.n_failure]
        assert float(line[-1]) > 0.0


def test_the_sum_is_that_of_the_standard(programs: Path) -> None:
    rng = np.random.default_rng(0)
    for size in (0, 1, 3, 55, 56, 63, 64, 65, 119, 120, 1000, 100_000):
        content = rng.bytes(size)
        done = subprocess.run([programs / "sha256sum_check"], input=content, capture_output=True, check=True)
        assert done.stdout.decode().strip() == hashlib.sha256(content).hexdigest()
        key = "k" * max(1, min(size, 130))  # shorter than a block, a block, longer
        done = subprocess.run([programs / "sha256sum_check", key], input=content, capture_output=True, check=True)
        assert done.stdout.decode().strip() == hmac.new(key.encode(), content, hashlib.sha256).hexdigest()


def test_lines_and_blocks_get_the_engines_decisions(
    programs: Path, engine: DataEngine, file: Path, many: np.ndarray
) -> None:
    decisions = [engine.decide(x) for x in many]
    assert_equal(cell(programs, file, stdin=csv(many))[0], decisions, 2)
    lines, _ = cell(programs, file, "--binary", stdin=many.tobytes())
    assert_equal(lines, decisions, 2)
    found = np.array([line[6:8] for line in lines], dtype=np.float32)
    expected = np.array([d.embedding[0] for d in load_exported(file).decide_many(many)])
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    assert {d.action for d in decisions} == set(Action)
    assert {d.reason for d in decisions} >= {Reason.AUDIT, Reason.NOT_FINITE, Reason.CONSTANT, Reason.SATURATED}


def test_several_channels_come_one_after_the_other(
    programs: Path, make_data: Callable[..., Dataset], tmp_path: Path
) -> None:
    data = make_data(150, 40, 3)
    path = export_torchscript(fitted(data), tmp_path / "model.ts")
    lines, _ = cell(programs, path, stdin=csv(data.X))
    assert_equal(lines, load_exported(path).decide_many(data.X), 2)


@pytest.mark.parametrize("fit", ["cut", "pad", "resample"])
def test_traces_of_other_lengths_are_fitted_as_python_does_and_come_back_from_the_journal(
    programs: Path, make_data: Callable[..., Dataset], tmp_path: Path, fit: str
) -> None:
    store, journal = tmp_path / "engine.db", tmp_path / "cell.csv"
    with trained(make_data(200, SAMPLES), store, TraceSpec(SAMPLES, fit=fit), fraction=0.1) as engine:
        path = export_torchscript(engine, tmp_path / "model.ts")
    lengths = [98, 100, 103, 60, 150, 30, 230, 1] * 5
    grown = make_data(40, 240, seed=4).X
    traces = [np.ascontiguousarray(x[:n]) for x, n in zip(grown, lengths, strict=True)]
    exported, expected = load_exported(path), []
    for x in traces:
        expected.append(exported.decide(x))
        if expected[-1].action is Action.VERIFY:
            exported.learn(x, True)
    stdin = b"".join(csv(x[None], [1]) for x in traces)
    for part in (stdin[: stdin.index(b"\n") + 1], stdin[stdin.index(b"\n") + 1 :]):  # the second run reads the journal
        lines, _ = cell(programs, path, "--learn", "--journal", journal, stdin=part)
        assert_equal(lines, expected[: len(lines)], 2)
        expected = expected[len(lines) :]
    assert expected == []
    report = import_journal(store, journal)
    assert report.quarantined == 5 * {"cut": 4, "pad": 3, "resample": 3}[fit]


def live(file: Path, X: np.ndarray, labels: list[str], parts: list[str]) -> tuple[list[Any], int]:
    """What the exported file in Python decides, told as the program tells it; how many journal lines that are."""
    exported, decisions, written = load_exported(file), [], 0
    for x, label, part in zip(X, labels, parts, strict=True):
        decision = exported.decide(x, part or None)
        accepted = decision.action is Action.ACCEPT
        if accepted and label == "0":
            exported.stop(x, part or None)
        elif label and decision.action is not Action.REJECT:
            exported.learn(x, label == "1", part or None)
        written += accepted or (label != "" and decision.action is Action.VERIFY)
        decisions.append(decision)
    return decisions, written


def a_live_stream(make_data: Callable[..., Dataset], n: int) -> tuple[np.ndarray, list[str], list[str]]:
    """Traces, labels and parts: noisy, novel and bad ones, parts that come again, labels that are missing."""
    rng, data = np.random.default_rng(8), make_data(n, SAMPLES, seed=2, noise=3.0)
    X = data.X.copy()
    X[rng.random(n) < 0.04] *= 5.0
    X[rng.random(n) < 0.02, 3] = np.nan
    parts = [f"Ω {rng.integers(2 * n)}" if rng.random() < 0.7 else "" for _ in range(n)]
    y = data.y ^ ((np.arange(n) > 0.75 * n) & (rng.random(n) < 0.5))  # at last the world is another one
    heard = np.where(y == 0, 0.95, 0.6)
    return X, [str(label) if rng.random() < p else "" for label, p in zip(y, heard, strict=True)], parts


@pytest.mark.parametrize(("guarantee", "stops"), [("local", "some"), ("pooled", "some"), ("pooled", "all")])
def test_the_cell_learns_stops_and_silence_as_python_does(
    programs: Path, guarantee: str, stops: str, make_data: Callable[..., Dataset], tmp_path: Path
) -> None:
    settings = {"audit_rate": 0.2, "guarantee": guarantee, "stops": stops}
    with trained(make_data(400, SAMPLES, noise=3.0), fraction=0.1, **settings) as engine:
        learning = export_torchscript(engine, tmp_path / "model.ts")
    X, labels, parts = a_live_stream(make_data, 800)
    decisions, written = live(learning, X, labels, parts)
    options = ["--parts", "--learn", "--journal", tmp_path / "cell.csv"]
    lines, _ = cell(programs, learning, *options, stdin=csv(X, labels, parts))
    assert_equal(lines, decisions, 2)
    head, *journal = (tmp_path / "cell.csv").read_text().splitlines()
    assert head == f"# dengine 3 {hashlib.sha256(learning.read_bytes()).hexdigest()}"
    assert len(journal) == written
    kinds = Counter((line.split(",")[2], line.split(",")[4]) for line in journal)
    assert kinds.keys() == {("1", "verify"), ("0", "verify"), ("1", "accept"), ("0", "accept"), ("", "accept")}
    reasons = {Reason.NOVEL, Reason.AUDIT, Reason.NOT_FINITE, Reason.CERTAIN, Reason.UNCERTAIN}
    assert {d.reason for d in decisions} >= reasons | ({Reason.SAFE_MODE} if stops == "all" else set())

    exported, unlabelled = load_exported(learning), []
    for x in X[:200]:  # where no labels are read, silence counts for nothing
        unlabelled.append(exported.decide(x))
        exported.module.drop()
    assert_equal(cell(programs, learning, "--binary", stdin=X[:200].tobytes())[0], unlabelled, 2)


@pytest.fixture(scope="module")
def written(programs: Path, file: Path, many: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A journal of two parts."""
    journal = tmp_path_factory.mktemp("written") / "cell.csv"
    cell(programs, file, "--learn", "--journal", journal, stdin=csv(many[:2], [1, 0]))
    return journal.read_text()


def with_crc(line: str) -> str:
    return f"{line},{zlib.crc32(line.encode()):08x}"


def test_a_journal_line_that_cannot_be_read_is_named(programs: Path, file: Path, written: str, tmp_path: Path) -> None:
    journal = tmp_path / "cell.csv"
    head, first, second = written.splitlines()
    words = second.rsplit(",", 1)[0].split(",")
    wrong = {
        "shorter": second[:-1],
        "a flipped digit": second[:-30] + str((int(second[-30]) + 1) % 10 if second[-30].isdigit() else 1) + second[-29:],
        "another action": with_crc(",".join([*words[:4], "think", *words[5:]])),
        "plain": second.split(",", 2)[2].rsplit(",", 1)[0],  # without id and checksum
    }
    for line in wrong.values():
        journal.write_text("\n".join([head, first, line, second, ""]))
        _, said = cell(programs, file, "--learn", "--journal", journal, fails=True)
        assert "is damaged in line 3; take its earlier lines in" in said, line


def test_a_line_that_was_cut_while_it_was_written_is_dropped_said_and_cut_off(
    programs: Path, file: Path, written: str, many: np.ndarray, tmp_path: Path
) -> None:
    journal = tmp_path / "cell.csv"
    first = written.rindex("\n", 0, -1) + 1
    for end in (first + 1, first + 40, len(written) - 12, len(written) - 1, 5, 0):  # within the line, then within the head
        journal.write_text(written[:end])
        _, said = cell(programs, file, "--learn", "--journal", journal, stdin=csv(many[:1], [1]))
        kept = written[:first] if end >= first else written[: written.index("\n") + 1]
        assert ("the last line was cut while it was written" in said) == (end > 0)
        assert journal.read_text().startswith(kept)
        assert journal.read_text().count("\n") == kept.count("\n") + 1


def test_a_file_that_is_no_journal_of_this_export_is_left_as_it_is(programs: Path, file: Path, tmp_path: Path) -> None:
    other = tmp_path / "notes.txt"
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    for text in ("no line end", f"# dengine 2 {'0' * 64}\n", f"# dengine {digest}\n"):
        other.write_text(text)
        _, said = cell(programs, file, "--learn", "--journal", other, fails=True)
        assert "belongs to another export" in said
        assert other.read_text() == text


def test_a_malformed_line_label_or_block_is_verified(programs: Path, file: Path, many: np.ndarray) -> None:
    good = csv(many[:1]).decode().strip()
    wrong = {
        good.rsplit(",", 1)[0]: "expected 100 samples, got 99",
        good.replace(",", ";"): "expected a number in column 1",
        good.rsplit(",", 1)[0] + ",12N": 'expected a number in column 100, got "12N"',
    }
    stdin = "\n".join([*wrong, "", "  ", good + "\r"]).encode()
    lines, said = cell(programs, file, stdin=stdin, fails=True)
    assert [line[:6] for line in lines[:-1]] == [["verify", "malformed", "0", "1", "0", "0"]] * len(wrong)
    assert_equal(lines[-1:], [load_exported(file).decide(many[0])], 2)
    for number, expected in enumerate(wrong.values(), start=1):
        assert f"trace {number} is malformed: {expected}" in said
    for option, stdin, malformed, expected in (
        ("--learn", csv(many[:2], ["yes", 1]), [True, False], 'expected a label of 1, 0 or nothing, got "yes"'),
        ("--binary", many[:2].tobytes()[:-5], [False, True], "expected 400 bytes, got 395"),
    ):
        lines, said = cell(programs, file, option, stdin=stdin, fails=True)
        assert [line[1] == "malformed" for line in lines] == malformed
        assert expected in said


@pytest.mark.parametrize(
    ("spoil", "summed", "message"),
    [
        (lambda content: content[:5000] + bytes([content[5000] ^ 1]) + content[5001:], False, "is damaged or truncated"),
        (lambda content: content[:5000], False, "is damaged or truncated"),
        (lambda content: b"garbage" * 1000, True, "no loadable TorchScript"),
        (lambda content: content, None, "holds no SHA-256 sum"),
    ],
    ids=["flip", "truncated", "garbage", "not a sum"],
)
def test_a_file_that_must_not_be_used_is_refused(
    programs: Path, file: Path, tmp_path: Path, spoil: Callable[[bytes], bytes], summed: bool | None, message: str
) -> None:
    path, total = tmp_path / "model.ts", tmp_path / "model.ts.sha256"
    path.write_bytes(spoil(file.read_bytes()))
    of = path if summed else file
    total.write_text("nothing" if summed is None else hashlib.sha256(of.read_bytes()).hexdigest())
    lines, said = cell(programs, path, stdin=csv(np.ones((1, SAMPLES))), fails=True)
    assert lines == []
    assert message in said
    total.unlink()
    assert "cannot read" in cell(programs, path, fails=True)[1]
