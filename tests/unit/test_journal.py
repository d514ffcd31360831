"""A cell's journal comes back into the store once, bad traces into quarantine."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dengine import DataEngine, Dataset, TraceSpec
from dengine.errors import DataError
from dengine.export import import_journal
from dengine.export.cell_journal import read_journal
from dengine.folds import part_hash
from dengine.records import Reason
from dengine.store.opening import open_store
from tests.support.command_line import line_of
from tests.support.exports import cell_journal, trained

DECIDED = "verify,verify,uncertain,0,1,0,0"


def new_store(data: Dataset, path: Path, **policy: Any) -> str:
    """An engine's store, after its first retrain."""
    trained(data, path, **policy).close()
    return str(path)


@pytest.fixture
def store(data: Dataset, tmp_path: Path) -> str:
    return new_store(data, tmp_path / "engine.db")


def write_lines(path: Path, X: np.ndarray, lines: list[str]) -> Path:
    """A journal: `part` lines without their samples, of one trace after the other, and `label`
    lines.
    """
    traces = iter(X.reshape(len(X), -1))
    whole = [
        f"{line},{','.join(f'{v:.9g}' for v in next(traces))}"
        if line.startswith("part,") and ",reject," not in line
        else line
        for line in lines
    ]
    path.write_bytes(cell_journal(*whole))
    Path(f"{path}.head").write_bytes(b"%d %s\n" % (len(whole) + 1, path.read_bytes()[-9:-1]))
    return path


def write(path: Path, X: np.ndarray, y: np.ndarray) -> Path:
    """A journal of verified parts."""
    return write_lines(
        path,
        X,
        [f"part,a-{i},{label},,verify,verify,no_model,0,1,0,0" for i, label in enumerate(y)],
    )


def test_each_line_counts_once(
    store: str, make_data: Callable[..., Dataset], tmp_path: Path
) -> None:
    new = make_data(30, seed=4)
    new.X[3, 5] = np.nan
    part = write(tmp_path / "cell.csv", new.X[:20], new.y[:20])
    first = import_journal(store, part)
    whole = import_journal(store, write(part, new.X, new.y))
    assert (first.imported, first.quarantined, first.repeated) == (19, 1, 0)
    assert (whole.imported, whole.quarantined, whole.repeated) == (10, 0, 20)
    with DataEngine.open(store) as engine:
        assert engine.retrain().n_traces == 200 + 29


def test_a_store_that_was_passed_open_stays_open_and_gives_the_cell_up(
    store: str, data: Dataset, tmp_path: Path
) -> None:
    journal = write(tmp_path / "cell.csv", data.X[:20] + 1.0, data.y[:20])
    (tmp_path / "none.csv").write_text("no journal")
    with open_store(store) as opened:
        with pytest.raises(DataError, match="Expected a journal"):
            import_journal(opened, tmp_path / "none.csv")
        assert import_journal(opened, journal).imported == 20
        assert import_journal(opened, journal).repeated == 20
        assert len(opened.labels.with_traces().labels) == 220
        with DataEngine.open(opened) as engine:
            assert engine.retrain().n_traces == 220


def test_a_journal_reads_as_it_was_written(
    make_data: Callable[..., Dataset], tmp_path: Path
) -> None:
    new = make_data(10, 40, 3)
    back = read_journal(write(tmp_path / "cell.csv", new.X, new.y), TraceSpec(40, channels=3)).lines
    np.testing.assert_array_equal([line.trace for line in back], new.X)
    assert [line.label for line in back] == new.y.astype(bool).tolist()
    assert {line.decision.reason for line in back} == {Reason.NO_MODEL}


CELL = [
    "part,a-1,1,P1,verify,verify,uncertain,0.25,0.75,5,5",
    "part,a-2,,P2,accept,accept,certain,0.925,1,30,0",
    "part,a-3,0,P3,accept,accept,certain,0.9375,1,31,0",
    "part,a-4,1,P6,accept,accept,certain,0.9375,1,31,0",
    "part,a-5,0,P4,verify,accept,audit,0.9375,1,31,0",
    "part,a-6,0,P1,verify,verify,novel,0,1,0,0",
    "part,a-7,,P5,accept,accept,certain,0.95,1,40,0",
]


@pytest.mark.parametrize("stops", ["some", "all"])
def test_a_journal_brings_bounds_parts_and_sources(
    data: Dataset, make_data, tmp_path: Path, stops: Any
) -> None:
    path = new_store(data, tmp_path / "engine.db", stops=stops, guarantee="pooled", audit_rate=0.1)
    journal = write_lines(tmp_path / "cell.csv", make_data(7, seed=4).X, CELL)
    for again in (False, True):  # the same file twice counts nothing twice
        report = import_journal(path, journal)
        n = 6 if stops == "all" else 5
        assert (report.imported, report.quarantined, report.repeated) == (
            (0, 0, n) if again else (n, 0, 0)
        )
        with DataEngine.open(path) as engine:
            records, last = (
                engine.store.labels.outcomes_since(200),
                engine.store.labels.with_traces(n),
            )
            outcomes, sources = (
                engine.store.decisions.tally().outcomes,
                engine.store.decisions.counts()["sources"],
            )
            members = engine.model.rule.state_dict()["evidence.level_totals"].clone()
        lower, success = (
            [0.25, 0.925, 0.9375, 0.9375, 0.9375, 0.0],
            [True, True, False, True, False, False],
        )
        hashes = [part_hash(p) for p in ("P1", "P2", "P3", "P6", "P4", "P1")]
        silent = [0, 0, 0, 0, 0, 0]
        if stops == "some":  # of the second nothing is known
            lower, success, hashes = (
                values[:1] + values[2:] for values in (lower, success, hashes)
            )
            silent = [0, 1, 0, 0, 0]
        answers = [(item.lower, item.success, item.silent, item.novel) for item in records]
        assert answers == list(zip(lower, success, silent, [False] * (n - 1) + [True], strict=True))
        assert last.hashes.tolist() == hashes
        assert (outcomes.false_accepts, outcomes.audited_accepts, outcomes.audited_accepts_bad) == (
            1,
            1,
            1,
        )
        assert (outcomes.accepted, outcomes.confirmed) == ((3, 2) if stops == "all" else (4, 1))
        assert sources == {
            "verification": 202,
            "audit": 1,
            "stop": 1,
            "confirmed": outcomes.confirmed,
            "inspection": 0,
        }
        assert int(members.sum()) > 0


@pytest.mark.parametrize("stops", ["some", "all"])
def test_a_journal_that_grew_adds_what_is_new(
    data: Dataset, make_data, tmp_path: Path, stops: Any
) -> None:
    X, result = make_data(7, seed=4).X, {}
    new = new_store(data, tmp_path / "new.db", stops=stops, audit_rate=0.1)
    for cuts in ([7], range(1, 8)):
        path = shutil.copy(new, str(tmp_path / f"{len(cuts)}.db"))
        for n in cuts:
            import_journal(path, write_lines(tmp_path / "cell.csv", X, CELL[:n]))
        with DataEngine.open(path) as engine:
            records = engine.store.labels.outcomes_since(200)
            result[len(cuts)] = (
                [(item.lower, item.silent) for item in records],
                engine.store.decisions.tally().outcomes,
            )
            engine.decide(X[0])
            engine.report(
                engine.decide(make_data(1, seed=8, noise=9.0).X[0]).id, True
            )  # silence adds up: no StoreError
    assert result[1] == result[7]


LATE = [
    "part,a-1,,P1,verify,verify,uncertain,0.25,0.75,5,5",
    "part,a-2,,P2,accept,accept,certain,0.925,1,30,0",
    "label,a-1,1",
    "part,a-3,,,reject,reject,certain,0,0.07,0,31",
    "label,a-2,0",
    "part,a-4,,P4,accept,accept,certain,0.9375,1,31,0",
    "part,a-5,,P5,accept,accept,certain,0.95,1,40,0",
    "label,a-5,1",
    "label,a-4,1",
    "part,a-6,,P6,verify,verify,uncertain,0.5,1,3,0",
]


def test_labels_that_came_late_stand_where_they_came(
    make_data: Callable[..., Dataset], tmp_path: Path
) -> None:
    journal = read_journal(
        write_lines(tmp_path / "cell.csv", make_data(9, seed=4).X, LATE), TraceSpec(100)
    )
    results = [(line.decision.id, line.label, line.late) for line in journal.lines]
    assert results == [
        ("a-1", True, True),
        ("a-2", None, False),  # went on, when the next part came
        ("a-2", False, True),  # its stop
        ("a-4", None, False),
        ("a-5", True, False),
        ("a-4", True, True),
    ]
    assert (journal.sum, journal.cut, journal.pending) == ("0123", 0, None)


@pytest.mark.parametrize("stops", ["some", "all"])
def test_late_labels_are_imported_once_by_their_own_ids(
    data: Dataset, make_data, tmp_path: Path, stops: Any
) -> None:
    path, X = new_store(data, tmp_path / "engine.db", stops=stops), make_data(9, seed=4).X
    for again in (False, True):
        report = import_journal(path, write_lines(tmp_path / "cell.csv", X, LATE))
        assert (report.imported, report.repeated, report.contradicted) == (
            (0, 4, 0) if again else (4, 0, 0)
        )
    with DataEngine.open(path) as engine:
        stored = [engine.store.decisions.get(f"a-{i}") for i in range(1, 7)]
        assert [records and records.success for records in stored] == [
            True,
            False,
            None,
            True,
            True,
            None,
        ]
        outcomes = engine.store.decisions.tally().outcomes
        assert (outcomes.accepted, outcomes.false_accepts, outcomes.confirmed) == (3, 1, 2)
    contrary = write_lines(
        tmp_path / "contrary.csv", X, [line.replace("label,a-5,1", "label,a-5,0") for line in LATE]
    )
    assert import_journal(path, contrary).contradicted == 1


def test_a_last_line_that_was_cut_anywhere_is_left_out_and_said(
    store: str, make_data, tmp_path: Path
) -> None:
    path = write_lines(tmp_path / "cell.csv", make_data(9, seed=4).X, LATE[:9])
    text = path.read_text()
    write_lines(path, make_data(9, seed=4).X, LATE[:8])  # the head is written after its line
    begin = text.rindex("\n", 0, -1) + 1
    for end in range(begin, len(text)):
        path.write_text(text[:end])
        journal = read_journal(path, TraceSpec(100))
        assert (len(journal.lines), journal.cut) == (5, end - begin)
    assert f"cut {journal.cut:,} " in line_of(
        "import-labels", path, "--store", store, "--any-model"
    )


def test_a_changed_missing_moved_or_doubled_line_is_named_and_those_before_are_taken(
    make_data, tmp_path: Path
) -> None:
    path = write_lines(tmp_path / "cell.csv", make_data(9, seed=4).X, LATE)
    lines, rng = path.read_bytes().splitlines(), np.random.default_rng(0)

    def must_take(changed: list[bytes], number: int) -> None:
        results = []
        for some in (changed[: number - 1], changed):
            path.write_bytes(b"\n".join([*some, b""]))
            results.append(read_journal(path, TraceSpec(100)))
        assert f"line {number} of" in results[1].set_aside
        assert "does not hold line 11, which its head knows" in results[0].set_aside
        answers = [
            [(line.decision.id, line.label, line.late) for line in journal.lines]
            for journal in results
        ]
        assert answers[0] == answers[1]

    for i in range(4, len(lines) - 1):  # before the fourth line nothing is labelled
        must_take([*lines[:i], *lines[i:][::-1]], i + 1)
        must_take([*lines[:i], *lines[i + 1 :]], i + 1)
        must_take([*lines[: i + 1], *lines[i:]], i + 2)
        for place in rng.integers(0, len(lines[i]), 20):
            changed = bytearray(lines[i])
            changed[place] ^= 1 << int(rng.integers(5))
            if b"\n" not in changed:
                must_take([*lines[:i], bytes(changed), *lines[i + 1 :]], i + 1)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            f"part,a-1,1,P1,{DECIDED},7",
            "line 2 of .* is no line of this store's cell.* 100 samples",
        ),
        ("part,a-1,1,P1,think", "line 2 of .* is no line"),
        ("label,a-1,1", "line 2 of .* is no line"),
        (b"# dengine 3 0123\n1,P1,verify\n", "begins with '# dengine 4 SUM'"),
        (b"", "begins with '# dengine 4 SUM'"),
        (cell_journal(), "holds no labels"),
        (cell_journal() + b"label,a-1,1\n", "The checksum of line 2"),
    ],
)
def test_what_is_no_journal_or_a_line_that_does_not_fit_is_named(
    tmp_path: Path, line: str | bytes, message: str
) -> None:
    path = tmp_path / "cell.csv"
    path.write_bytes(line if isinstance(line, bytes) else cell_journal(line))
    with pytest.raises(DataError, match=message):
        read_journal(path, TraceSpec(100))
