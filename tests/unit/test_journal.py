"""A cell's journal comes back into the store once, bad traces into quarantine."""

import shutil
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from dengine import DataEngine, Dataset, TraceSpec
from dengine.errors import DataError
from dengine.export import import_journal
from dengine.export.cell_journal import read_journal
from dengine.folds import part_hash
from dengine.store.opening import open_store
from tests.support.command_line import line_of
from tests.support.exports import cell_journal, trained

DECIDED = "verify,verify,uncertain,0,1,0,0"


@pytest.fixture(scope="module")
def new_store(data, tmp_path_factory):
    """Copies an engine's store, after its first retrain, to a path."""

    @cache
    def made(stops: str):
        path = tmp_path_factory.mktemp("stores") / "engine.db"
        trained(data, path, stops=stops, guarantee="pooled", audit_rate=0.1).close()
        return path

    return lambda path, stops="all": str(shutil.copy(made(stops), path))


@pytest.fixture
def store(new_store, tmp_path):
    return new_store(tmp_path / "engine.db")


@pytest.fixture(scope="module", name="X")
def traces_of_parts(make_data):
    return make_data(9, seed=4).X


def write_lines(path: Path, X: np.ndarray, lines: Iterable[str]) -> Path:
    """A journal: `part` lines without their samples, of one trace after the other, and `label`
    lines.
    """
    traces, whole = iter(X.reshape(len(X), -1)), []
    for line in lines:
        has_trace = line.startswith("part,") and ",reject," not in line
        whole.append(line + "".join(f",{v:.9g}" for v in next(traces)) if has_trace else line)
    path.write_bytes(cell_journal(*whole))
    Path(f"{path}.head").write_bytes(b"%d %s\n" % (len(whole) + 1, path.read_bytes()[-9:-1]))
    return path


def write(path: Path, data: Dataset, n: int | None = None) -> Path:
    """A journal of verified parts, of the first n."""
    lines = [f"part,a-{i},{y},,verify,verify,no_model,0,1,0,0" for i, y in enumerate(data.y[:n])]
    return write_lines(path, data.X, lines)


def test_each_line_counts_once_also_in_a_store_that_was_passed_open_and_stays_so(
    store, make_data, tmp_path
):
    new, counts, empty = make_data(30, seed=4), [], tmp_path / "none.csv"
    new.X[3, 5] = np.nan
    empty.write_text("no journal")
    with open_store(store) as opened:
        with pytest.raises(DataError, match="Expected a journal"):
            import_journal(opened, empty)
        for n, target in ((20, opened), (30, opened)):
            report = import_journal(target, write(tmp_path / "cell.csv", new, n))
            counts.append((report.imported, report.quarantined, report.repeated))
        assert counts == [(19, 1, 0), (10, 0, 20)]
        with DataEngine.open(opened) as engine:
            assert engine.retrain().n_traces == 200 + 29


def test_a_part_that_comes_twice_in_one_import_counts_once(store, X, tmp_path):
    lines = [f"part,a-1,{label},,verify,verify,no_model,0,1,0,0" for label in (1, 1, 0)]
    report = import_journal(store, write_lines(tmp_path / "cell.csv", X[[0, 0, 0]], lines))
    assert (report.imported, report.repeated, report.contradicted) == (1, 1, 1)


# Of each line: the part, and its label's bound, success and novelty; none is known of the last, and
# of the second only where all stops are reported.
CELL = """
part,a-1,1,P1,verify,verify,uncertain,0.25,0.75,5,5  0.25 True False
part,a-2,,P2,accept,accept,certain,0.925,1,30,0      0.925 True False
part,a-3,0,P3,accept,accept,certain,0.9375,1,31,0    0.9375 False False
part,a-4,1,P6,accept,accept,certain,0.9375,1,31,0    0.9375 True False
part,a-5,0,P4,verify,accept,audit,0.9375,1,31,0      0.9375 False False
part,a-6,0,P1,verify,verify,novel,0,1,0,0            0.0 False True
part,a-7,,P5,accept,accept,certain,0.95,1,40,0
"""


@pytest.mark.parametrize(("stops", "cuts"), [("some", [7, 7]), ("all", [1, 2, 3, 4, 5, 6, 7, 7])])
def test_a_journal_brings_bounds_parts_and_sources_at_once_or_as_it_grew(
    new_store, make_data, X, tmp_path, stops, cuts
):
    path, journal = new_store(tmp_path / "engine.db", stops), tmp_path / "cell.csv"
    rows = [line.split() for line in CELL.strip().splitlines()]
    known = [row for row in rows[:-1] if stops == "all" or ",a-2," not in row[0]]
    n, reports = len(known), []
    for cut in cuts:  # the same file twice counts nothing twice
        write_lines(journal, X, [row[0] for row in rows[:cut]])
        reports.append(import_journal(path, journal))
    assert sum(report.imported for report in reports) == reports[-1].repeated == n
    with DataEngine.open(path) as engine:
        records = engine.store.labels.outcomes_since(200)
        hashes = engine.store.labels.with_traces(n).hashes
        outcomes = engine.store.decisions.tally().outcomes
        assert engine.model.rule.state_dict()["evidence.level_totals"].sum() > 0
        engine.decide(X[0])
        unlike = engine.decide(make_data(1, seed=8, noise=9.0).X[0])
        engine.report(unlike.id, True)  # silence adds up: no StoreError
    answers = [[str(r.lower), str(r.success), str(r.novel)] for r in records]
    assert answers == [row[1:] for row in known]
    assert [r.silent for r in records] == [0, 0 if stops == "all" else 1, *[0] * (n - 2)]
    assert hashes.tolist() == [part_hash(row[0].split(",")[3]) for row in known]
    assert (outcomes.accepted, outcomes.confirmed) == ((3, 2) if stops == "all" else (4, 1))
    assert (outcomes.false_accepts, outcomes.audited_accepts) == (1, 1)
    assert outcomes.audited_accepts_bad == 1


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


@pytest.mark.parametrize("stops", ["some", "all"])
def test_late_labels_are_imported_once_by_their_own_ids(new_store, X, tmp_path, stops):
    path, journal, counts = new_store(tmp_path / "engine.db", stops), tmp_path / "cell.csv", []
    for lines in (
        [*LATE, "label,a-2,1"],
        LATE,
        [line.replace("label,a-5,1", "label,a-5,0") for line in LATE],
    ):
        report = import_journal(path, write_lines(journal, X, lines))
        counts.append((report.imported, report.repeated, report.contradicted))
    # Where all stops are known, a good label cannot take a stop back.
    assert counts == [(4, 0, stops == "some"), (0, 4, 0), (0, 3, 1)]
    with DataEngine.open(path) as engine:
        stored = [engine.store.decisions.get(f"a-{i}") for i in range(1, 7)]
        outcomes = engine.store.decisions.tally().outcomes
    assert [item and item.success for item in stored] == [True, False, None, True, True, None]
    assert (outcomes.accepted, outcomes.false_accepts, outcomes.confirmed) == (3, 1, 2)


def test_a_last_line_that_was_cut_anywhere_is_left_out_and_said(store, X, tmp_path):
    path = write_lines(tmp_path / "cell.csv", X, LATE[:9])
    text = path.read_text()
    write_lines(path, X, LATE[:8])  # the head is written after its line
    begin = text.rindex("\n", 0, -1) + 1
    for end in range(begin, len(text)):
        path.write_text(text[:end])
        journal = read_journal(path, TraceSpec(100))
        assert (len(journal.lines), journal.cut) == (5, end - begin)
    said = line_of("import-labels", path, "--store", store, "--any-model")
    assert f"cut {journal.cut:,} " in said


def test_a_changed_missing_moved_or_doubled_line_is_named_and_those_before_are_taken(X, tmp_path):
    path = write_lines(tmp_path / "cell.csv", X, LATE)
    lines, rng = path.read_bytes().splitlines(), np.random.default_rng(0)

    def take(said: str, *changed: bytes):
        path.write_bytes(b"\n".join([*changed, b""]))
        journal = read_journal(path, TraceSpec(100))
        assert said in journal.set_aside
        return [(line.decision.id, line.label, line.late) for line in journal.lines]

    def must_take(number: int, *changed: bytes):
        before = take("does not hold line 11, which its head knows", *changed[: number - 1])
        assert take(f"line {number} of", *changed) == before

    for i in range(4, len(lines) - 1):  # before the fourth line nothing is labelled
        before, line, rest = lines[:i], lines[i], lines[i + 1 :]
        must_take(i + 1, *before, *rest[::-1], line)
        must_take(i + 1, *before, *rest)
        must_take(i + 2, *before, line, line, *rest)
        for place in rng.integers(0, len(line), 20):
            changed = bytearray(line)
            changed[place] ^= 1 << int(rng.integers(5))
            if b"\n" not in changed:
                must_take(i + 1, *before, bytes(changed), *rest)


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
def test_what_is_no_journal_or_a_line_that_does_not_fit_is_named(tmp_path, line, message):
    path = tmp_path / "cell.csv"
    path.write_bytes(line if isinstance(line, bytes) else cell_journal(line))
    with pytest.raises(DataError, match=message):
        read_journal(path, TraceSpec(100))
