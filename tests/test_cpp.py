"""The cell program without Python decides as the engine does, learns, and refuses what it must not use."""

import hashlib
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dengine import (
    Dataset,
    ModelPrediction,
    Policy,
    Recipe,
    TraceSpec,
    WilsonRadiusClassifier,
    export_torchscript,
    load_exported,
)
from dengine.engine import DataEngine
from dengine.records import Action, Reason

SAMPLES = 100


@pytest.fixture(scope="session")
def programs(repo: Path) -> Path:
    """The folder of the built programs; kept, so that only the first run compiles."""
    missing = [tool for tool in ("cmake", "g++") if shutil.which(tool) is None]
    if missing:
        message = f"building the cell program needs {' and '.join(missing)}"
        if os.environ.get("DENGINE_REQUIRE_CPP") == "1":
            pytest.fail(message)
        pytest.skip(message)
    build = repo / "build" / "cpp"
    prefix = f"-DCMAKE_PREFIX_PATH={torch.utils.cmake_prefix_path}"
    for command in (
        ["cmake", "-S", str(repo / "tests" / "cpp"), "-B", str(build), prefix],
        ["cmake", "--build", str(build)],
    ):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return build


@pytest.fixture(scope="module")
def engine(make_data: Callable[..., Dataset]) -> Iterator[DataEngine]:
    data = make_data(400, SAMPLES)
    policy = Policy(alpha=0.1, lower_bound=0.9, audit_rate=0.3)
    recipe = Recipe(reducer="pca", policy=policy, retrain_every=1000, window=2000, fraction=0.3, reject_fraction=0.08)
    with DataEngine.from_recipe(recipe, trace=TraceSpec(SAMPLES, limit=500.0), seed=3, replaying=True) as engine:
        for x, y in zip(data.X, data.y, strict=True):
            engine.report(engine.decide(x).id, bool(y))
        engine.retrain()
        yield engine


@pytest.fixture(scope="module")
def file(engine: DataEngine, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export_torchscript(engine, tmp_path_factory.mktemp("cell") / "model.ts")


@pytest.fixture(scope="module")
def many(make_data: Callable[..., Dataset]) -> np.ndarray:
    rng = np.random.default_rng(5)
    known = make_data(300, SAMPLES, seed=9).X
    wild = rng.normal(size=(200, SAMPLES)) * 10.0 ** rng.uniform(-3, 6, (200, 1))
    bad = known[:4].copy()
    bad[0, 3], bad[1, 5], bad[2, 0], bad[3] = np.nan, -np.inf, 1e30, 2.5
    return np.concatenate([known, wild, bad]).astype(np.float32)


def cell(programs: Path, *arguments: Any, stdin: bytes = b"", fails: bool = False) -> tuple[list[list[str]], str]:
    """The program's lines, split at commas, and what it said on stderr."""
    command = [str(programs / "dengine_cell"), *map(str, arguments)]
    done = subprocess.run(command, input=stdin, capture_output=True, check=False, timeout=120)
    assert done.returncode == (1 if fails else 0), done.stderr.decode()
    return [line.split(",") for line in done.stdout.decode().splitlines()], done.stderr.decode()


def csv(X: np.ndarray, labels: Any = None) -> bytes:
    rows = [",".join(f"{value:.9g}" for value in x.ravel()) for x in X]
    if labels is not None:
        rows = [f"{label},{row}" for label, row in zip(labels, rows, strict=True)]
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


def test_csv_lines_get_the_engines_decisions(programs: Path, engine: DataEngine, file: Path, many: np.ndarray) -> None:
    lines, _ = cell(programs, file, stdin=csv(many))
    decisions = [engine.decide(x) for x in many]
    assert_equal(lines, decisions, 2)
    assert {d.action for d in decisions} == set(Action)
    assert {d.reason for d in decisions} >= {Reason.AUDIT, Reason.NOT_FINITE, Reason.CONSTANT, Reason.SATURATED}


def test_binary_blocks_get_what_python_says(programs: Path, file: Path, many: np.ndarray) -> None:
    lines, _ = cell(programs, file, "--binary", stdin=many.tobytes())
    decisions = load_exported(file).decide_many(many)
    assert_equal(lines, decisions, 2)
    found = np.array([line[6:8] for line in lines], dtype=np.float32)
    expected = np.array([d.embedding[0] for d in decisions])
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_several_channels_come_one_after_the_other(
    programs: Path, make_data: Callable[..., Dataset], tmp_path: Path
) -> None:
    data = make_data(150, 40, 3)
    model = ModelPrediction("pca", WilsonRadiusClassifier(alpha=0.1, lower_bound=0.9)).fit(data.X, data.y)
    path = export_torchscript(model, tmp_path / "model.ts")
    lines, _ = cell(programs, path, stdin=csv(data.X))
    assert_equal(lines, load_exported(path).decide_many(data.X), 2)


def test_the_cell_learns_where_it_verified_and_nowhere_else(
    programs: Path, file: Path, make_data: Callable[..., Dataset], tmp_path: Path
) -> None:
    new = make_data(150, SAMPLES, seed=2, noise=4.0)
    labels = ["" if i % 10 == 0 else str(y) for i, y in enumerate(new.y)]
    lines, _ = cell(programs, file, "--learn", "--journal", tmp_path / "cell.csv", stdin=csv(new.X, labels))
    exported, decisions, learned = load_exported(file), [], []
    for x, label in zip(new.X, labels, strict=True):
        decisions.append(exported.decide(x))
        if decisions[-1].action is Action.VERIFY and label:
            exported.learn(x, label == "1")
            learned.append((label, x))
    assert_equal(lines, decisions, 2)
    assert 20 < len(learned) < 150
    head, *journal = (tmp_path / "cell.csv").read_text().splitlines()
    assert head == f"# dengine {hashlib.sha256(file.read_bytes()).hexdigest()}"
    assert journal == [csv(x[None], [label]).decode().strip() for label, x in learned]


def test_a_restarted_cell_learns_its_journal_again(
    programs: Path, file: Path, make_data: Callable[..., Dataset], tmp_path: Path
) -> None:
    new = make_data(150, SAMPLES, seed=2, noise=4.0)
    whole, _ = cell(programs, file, "--learn", "--journal", tmp_path / "one.csv", stdin=csv(new.X, new.y))
    parts = []
    for half in (slice(0, 75), slice(75, 150)):
        stdin = csv(new.X[half], new.y[half])
        parts += cell(programs, file, "--learn", "--journal", tmp_path / "two.csv", stdin=stdin)[0]
    assert [line[:-1] for line in parts] == [line[:-1] for line in whole]
    assert (tmp_path / "one.csv").read_text() == (tmp_path / "two.csv").read_text()


def test_a_journal_of_another_export_is_not_counted_again(programs: Path, file: Path, tmp_path: Path) -> None:
    journal = tmp_path / "cell.csv"
    journal.write_text(f"# dengine {'0' * 64}\n")
    _, said = cell(programs, file, "--learn", "--journal", journal, fails=True)
    assert "belongs to another export; import it and name a new journal" in said


def test_a_journal_line_that_was_cut_is_named(programs: Path, file: Path, many: np.ndarray, tmp_path: Path) -> None:
    journal = tmp_path / "cell.csv"
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    journal.write_bytes(f"# dengine {digest}\n".encode() + csv(many[:2], [1, 0])[:-1])
    _, said = cell(programs, file, "--learn", "--journal", journal, fails=True)
    assert "has a line that was not finished" in said


def test_a_malformed_line_is_verified_and_the_cell_goes_on(programs: Path, file: Path, many: np.ndarray) -> None:
    good = csv(many[:1]).decode().strip()
    wrong = {
        good.rsplit(",", 1)[0]: "expected 100 samples, got 99",
        good + ",1": "expected 100 samples, got 101",
        good.replace(",", ";"): "expected a number in column 1",
        good.rsplit(",", 1)[0] + ",12N": 'expected a number in column 100, got "12N"',
        good.rsplit(",", 1)[0] + ",": 'expected a number in column 100, got ""',
    }
    stdin = "\n".join([*wrong, "", "  ", good + "\r"]).encode()
    lines, said = cell(programs, file, stdin=stdin, fails=True)
    assert [line[:6] for line in lines[:-1]] == [["verify", "malformed", "0", "1", "0", "0"]] * len(wrong)
    assert_equal(lines[-1:], [load_exported(file).decide(many[0])], 2)
    for number, expected in enumerate(wrong.values(), start=1):
        assert f"trace {number} is malformed: {expected}" in said


def test_a_label_that_is_none_is_malformed(programs: Path, file: Path, many: np.ndarray) -> None:
    lines, said = cell(programs, file, "--learn", stdin=csv(many[:2], ["yes", 1]), fails=True)
    assert [line[1] == "malformed" for line in lines] == [True, False]
    assert 'expected a label of 1, 0 or nothing, got "yes"' in said


def test_a_cut_binary_block_is_malformed(programs: Path, file: Path, many: np.ndarray) -> None:
    lines, said = cell(programs, file, "--binary", stdin=many[:2].tobytes()[:-5], fails=True)
    assert [line[1] == "malformed" for line in lines] == [False, True]
    assert "expected 400 bytes, got 395" in said


@pytest.mark.parametrize("kind", ["flip", "truncated", "empty", "no sum", "not a sum", "missing", "garbage", "foreign"])
def test_a_file_that_must_not_be_used_is_refused(programs: Path, file: Path, tmp_path: Path, kind: str) -> None:
    path, content = tmp_path / "model.ts", file.read_bytes()
    middle = len(content) // 2
    path.write_bytes(
        {
            "flip": content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :],
            "truncated": content[:middle],
            "empty": b"",
            "garbage": b"garbage" * 1000,
        }.get(kind, content)
    )
    if kind == "foreign":
        torch.jit.save(torch.jit.script(torch.nn.ReLU()), str(path))
    signed = path if kind in ("garbage", "foreign") else file
    digest = "nothing" if kind == "not a sum" else hashlib.sha256(signed.read_bytes()).hexdigest()
    path.with_name("model.ts.sha256").write_text(digest)
    if kind in ("no sum", "missing"):
        (path.with_name("model.ts.sha256") if kind == "no sum" else path).unlink()
    lines, said = cell(programs, path, stdin=csv(np.ones((1, SAMPLES))), fails=True)
    expected = {
        "flip": "it is damaged or truncated",
        "truncated": "it is damaged or truncated",
        "empty": "it is damaged or truncated",
        "no sum": "cannot read",
        "missing": "cannot read",
        "not a sum": "holds no SHA-256 sum",
        "garbage": "no loadable TorchScript",
        "foreign": "it is not a dengine export",
    }
    assert lines == []
    assert expected[kind] in said


def test_wrong_arguments_show_the_usage(programs: Path, file: Path) -> None:
    for arguments in ([], [str(file), "--fast"], [str(file), "--learn", "--binary"], [str(file), "--journal", "x"]):
        done = subprocess.run([programs / "dengine_cell", *arguments], capture_output=True, text=True, check=False)
        assert done.returncode == 2
        assert done.stderr.startswith("usage: dengine_cell MODEL.ts")
