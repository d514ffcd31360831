"""The cell program without Python decides as the engine does, learns, and refuses what it must not
use.
"""

import hashlib
import hmac
import subprocess

import pytest

from dengine import TraceSpec, export_torchscript, load_exported
from dengine.export import import_journal
from dengine.records import Action
from tests.support.exports import SAMPLES, cell_journal, trained
from tests.support.programs import Program, must_agree


@pytest.fixture(scope="module")
def file(make_data, tmp_path_factory):
    with trained(make_data(400, SAMPLES), audit_rate=0.3) as engine:
        return export_torchscript(engine, tmp_path_factory.mktemp("cell") / "model.ts")


@pytest.fixture(scope="module")
def X(make_data):  # noqa: N802  # as everywhere
    return make_data(2, SAMPLES, seed=9).X


def test_the_sum_is_that_of_the_standard(programs):
    def sum_of(content, *key):
        command = [programs / "sha256sum_check", *key]
        done = subprocess.run(command, input=content, capture_output=True, check=True)
        return done.stdout.decode().strip()

    for size in (0, 1, 55, 56, 63, 64, 65, 119, 120, 100_000):
        content = (b"content " * size)[:size]
        key = "k" * max(1, min(size, 130))  # up to more than a block
        assert sum_of(content) == hashlib.sha256(content).hexdigest()
        assert sum_of(content, key) == hmac.digest(key.encode(), content, "sha256").hex()


@pytest.mark.parametrize(
    ("fit", "lengths"),
    [
        ("cut", [100, 103, 150, 230]),
        ("pad", [98, 100, 103, 60, 150]),
        ("resample", [98, 100, 103, 60, 150]),
    ],
)
def test_traces_of_other_lengths_are_fitted_as_python_does_and_come_back_from_the_journal(
    programs, make_data, tmp_path, fit, lengths
):
    store, journal = tmp_path / "engine.db", tmp_path / "cell.csv"
    with trained(make_data(200, SAMPLES), store, TraceSpec(SAMPLES, fit=fit)) as engine:
        path = export_torchscript(engine, tmp_path / "model.ts")
    traces = [x[:n] for x, n in zip(make_data(50, 240, seed=4).X, lengths * 10, strict=False)]
    exported = load_exported(path)
    for part in (traces[:1], traces[1:]):  # the second run reads the journal
        with Program(programs, path, "--journal", journal) as cell:
            for x in part:
                expected, answer = exported.decide(x), cell.decide(x)
                must_agree([answer], [expected])
                if expected.action is Action.VERIFY:
                    exported.learn(x, True)
                    assert cell.ask(f"label {answer[0]} 1").startswith("ok")
    assert import_journal(store, journal).quarantined == 0


@pytest.fixture(scope="module")
def written(programs, file, X, tmp_path_factory):
    """A journal of two parts."""
    journal = tmp_path_factory.mktemp("written") / "cell.csv"
    with Program(programs, file, "--journal", journal) as cell:
        for x in X:
            cell.decide(x)
    return journal.read_text()


def test_a_journal_that_is_damaged_anywhere_but_at_its_end_is_refused_with_the_line(
    programs, file, written, tmp_path
):
    head, first, second = written.splitlines()
    words = second.split(",")[:-1]
    texts = [
        ",".join(words[:-1]),  # a sample less
        ",".join([*words[:-1], "1.5x"]),
        ",".join([*words[:2], "2", *words[3:]]),  # a label of 2
        ",".join([*words[:4], "think", *words[5:]]),  # another action
    ]
    lines = [
        cell_journal(first.rsplit(",", 1)[0], text, head=head).decode().splitlines()[2]
        for text in texts
    ]
    lines.append(second[:30] + chr(ord(second[30]) ^ 1) + second[31:])
    for line in lines:
        (tmp_path / "cell.csv").write_text("\n".join([head, first, line, second, ""]))
        with Program(programs, file, "--journal", tmp_path / "cell.csv") as cell:
            cell.must_refuse("is damaged in line 3, or a line before it is missing")


def test_a_line_that_was_cut_while_it_was_written_is_dropped_said_and_cut_off(
    programs, file, written, X, tmp_path
):
    journal, head = tmp_path / "cell.csv", written.splitlines()[0]
    first = written.rindex("\n", 0, -1) + 1
    for end, kept in ((len(written) - 1, written[:first]), (5, f"{head}\n")):
        journal.write_text(written[:end])
        with Program(programs, file, "--journal", journal) as cell:
            cell.decide(X[0])
            code, text = cell.end()
        assert code == 0
        assert "the last line was cut while it was written" in text
        assert journal.read_text().startswith(kept)
        assert journal.read_text().count("\n") == kept.count("\n") + 1


def test_a_file_that_is_no_journal_of_this_export_is_left_as_it_is(programs, file, tmp_path):
    other = tmp_path / "notes.txt"
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    for text in ("no line end", f"# dengine 3 {digest}\n"):
        other.write_text(text)
        with Program(programs, file, "--journal", other) as cell:
            cell.must_refuse("belongs to another export")
        assert other.read_text() == text


@pytest.mark.parametrize(
    ("content", "summed", "message"),
    [
        (b"garbage", b"garbage", "no loadable TorchScript"),
        (b"garbage", b"another", "is damaged or truncated"),
        (b"garbage", None, "cannot read"),
    ],
)
def test_a_file_that_must_not_be_used_is_refused(programs, tmp_path, content, summed, message):
    (tmp_path / "model.ts").write_bytes(content)
    if summed is not None:
        (tmp_path / "model.ts.sha256").write_text(hashlib.sha256(summed).hexdigest())
    with Program(programs, tmp_path / "model.ts") as cell:
        cell.must_refuse(message)
