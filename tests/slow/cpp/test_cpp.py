"""The cell program without Python decides as the engine does, learns, and refuses what it must not
use.
"""

import hashlib
import hmac
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from dengine import DataEngine, Dataset, TraceSpec, export_torchscript, load_exported
from dengine.export import import_journal
from dengine.records import Action, Reason
from tests.support.exports import SAMPLES, cell_journal, trained, wild_traces
from tests.support.programs import Program, must_agree


@pytest.fixture(scope="module")
def engine(make_data: Callable[..., Dataset]) -> Iterator[DataEngine]:
    with trained(make_data(400, SAMPLES), audit_rate=0.3) as engine:
        yield engine


@pytest.fixture(scope="module")
def file(engine: DataEngine, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export_torchscript(engine, tmp_path_factory.mktemp("cell") / "model.ts")


@pytest.fixture(scope="module")
def many(make_data: Callable[..., Dataset]) -> np.ndarray:
    return wild_traces(make_data(300, SAMPLES, seed=9).X)


def test_the_sum_is_that_of_the_standard(programs: Path) -> None:
    rng = np.random.default_rng(0)
    for size in (0, 1, 3, 55, 56, 63, 64, 65, 119, 120, 1000, 100_000):
        content = rng.bytes(size)
        done = subprocess.run(
            [programs / "sha256sum_check"], input=content, capture_output=True, check=True
        )
        assert done.stdout.decode().strip() == hashlib.sha256(content).hexdigest()
        key = "k" * max(1, min(size, 130))  # shorter than a block, a block, longer
        done = subprocess.run(
            [programs / "sha256sum_check", key], input=content, capture_output=True, check=True
        )
        assert (
            done.stdout.decode().strip()
            == hmac.new(key.encode(), content, hashlib.sha256).hexdigest()
        )


def test_it_takes_the_engines_decisions(
    programs: Path, engine: DataEngine, file: Path, many: np.ndarray
) -> None:
    decisions = [engine.decide(x) for x in many]
    with Program(programs, file) as cell:
        must_agree([cell.decide(x) for x in many], decisions)
        assert cell.end() == (0, "")
    assert {d.action for d in decisions} == set(Action)
    assert {d.reason for d in decisions} >= {
        Reason.AUDIT,
        Reason.NOT_FINITE,
        Reason.CONSTANT,
        Reason.SATURATED,
    }


@pytest.mark.parametrize("fit", ["cut", "pad", "resample"])
def test_traces_of_other_lengths_are_fitted_as_python_does_and_come_back_from_the_journal(
    programs: Path, make_data: Callable[..., Dataset], tmp_path: Path, fit: str
) -> None:
    store, journal = tmp_path / "engine.db", tmp_path / "cell.csv"
    with trained(make_data(200, SAMPLES), store, TraceSpec(SAMPLES, fit=fit)) as engine:
        path = export_torchscript(engine, tmp_path / "model.ts")
    lengths = {"cut": [100, 103, 150, 230]}.get(fit, [98, 100, 103, 60, 150]) * 10
    traces = [x[:n] for x, n in zip(make_data(50, 240, seed=4).X, lengths, strict=False)]
    exported, expected, answers = load_exported(path), [], []
    for x in traces:
        expected.append(exported.decide(x))
        if expected[-1].action is Action.VERIFY:
            exported.learn(x, True)
    for part in (traces[:1], traces[1:]):  # the second run reads the journal
        with Program(programs, path, "--journal", journal) as cell:
            for x in part:
                answers.append(cell.decide(x))
                if answers[-1][1] == Action.VERIFY:
                    assert cell.ask(f"label {answers[-1][0]} 1").startswith("ok")
    must_agree(answers, expected)
    assert import_journal(store, journal).quarantined == 0


@pytest.fixture(scope="module")
def written(
    programs: Path, file: Path, many: np.ndarray, tmp_path_factory: pytest.TempPathFactory
) -> str:
    """A journal of two parts."""
    journal = tmp_path_factory.mktemp("written") / "cell.csv"
    with Program(programs, file, "--journal", journal) as cell:
        for x in many[:2]:
            cell.decide(x)
    return journal.read_text()


def test_a_journal_that_is_damaged_anywhere_but_at_its_end_is_refused_with_the_line(
    programs: Path, file: Path, written: str, tmp_path: Path
) -> None:
    journal = tmp_path / "cell.csv"
    head, first, second = written.splitlines()
    words = second.rsplit(",", 1)[0].split(",")

    def with_crc(line: str) -> str:  # as the third line
        return cell_journal(first.rsplit(",", 1)[0], line, head=head).decode().splitlines()[2]

    assert with_crc(",".join(words)) == second
    wrong = {
        "flipped": second[:30] + chr(ord(second[30]) ^ 1) + second[31:],
        "a sample less": with_crc(",".join(words[:-1])),
        "no number": with_crc(",".join([*words[:-1], "1.5x"])),
        "a label of 2": with_crc(",".join([*words[:2], "2", *words[3:]])),
        "another action": with_crc(",".join([*words[:4], "think", *words[5:]])),
        "plain": second.split(",", 2)[2].rsplit(",", 1)[0],  # without id and checksum
    }
    for line in wrong.values():
        journal.write_text("\n".join([head, first, line, second, ""]))
        with Program(programs, file, "--journal", journal) as cell:
            cell.must_refuse(
                "is damaged in line 3, or a line before it is missing; take its earlier lines in"
            )


def test_a_line_that_was_cut_while_it_was_written_is_dropped_said_and_cut_off(
    programs: Path, file: Path, written: str, many: np.ndarray, tmp_path: Path
) -> None:
    journal = tmp_path / "cell.csv"
    first = written.rindex("\n", 0, -1) + 1
    for end in (first + 1, len(written) - 1, 5, 0):  # within the line, then within the head
        journal.write_text(written[:end])
        with Program(programs, file, "--journal", journal) as cell:
            cell.decide(many[0])
            code, text = cell.end()
        kept = written[:first] if end >= first else written[: written.index("\n") + 1]
        assert (code, "the last line was cut while it was written" in text) == (0, end > 0)
        assert journal.read_text().startswith(kept)
        assert journal.read_text().count("\n") == kept.count("\n") + 1


def test_a_file_that_is_no_journal_of_this_export_is_left_as_it_is(
    programs: Path, file: Path, tmp_path: Path
) -> None:
    other = tmp_path / "notes.txt"
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    for text in ("no line end", f"# dengine 3 {digest}\n", f"# dengine {digest}\n"):
        other.write_text(text)
        with Program(programs, file, "--journal", other) as cell:
            cell.must_refuse("belongs to another export")
        assert other.read_text() == text


@pytest.mark.parametrize(
    ("spoil", "summed", "message"),
    [
        (
            lambda content: content[:5000] + bytes([content[5000] ^ 1]) + content[5001:],
            False,
            "is damaged or truncated",
        ),
        (lambda content: content[:5000], False, "is damaged or truncated"),
        (lambda content: b"garbage" * 1000, True, "no loadable TorchScript"),
        (lambda content: content, None, "holds no SHA-256 sum"),
        (lambda content: content, "missing", "cannot read"),
    ],
    ids=["flip", "truncated", "garbage", "not a sum", "no sum"],
)
def test_a_file_that_must_not_be_used_is_refused(
    programs, file: Path, tmp_path: Path, spoil, summed, message: str
) -> None:
    path, total = tmp_path / "model.ts", tmp_path / "model.ts.sha256"
    path.write_bytes(spoil(file.read_bytes()))
    of = path if summed else file
    total.write_text("nothing" if summed is None else hashlib.sha256(of.read_bytes()).hexdigest())
    if summed == "missing":
        total.unlink()
    with Program(programs, path) as cell:
        cell.must_refuse(message)
