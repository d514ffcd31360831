"""Recordings are read back as they were written, and damage is a named fault; the corpus of
test_recordings_corpus.py has more layouts.
"""

import gzip
import json
import re
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from io import BytesIO
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dengine import Dataset, Description, describe, load_dataset
from dengine.datasets.description import (
    SECTIONS,
    Channel,
    Clock,
    LabelSource,
    PartSource,
    TextForm,
    TraceForm,
)
from dengine.errors import DataError, DengineError

WORDS = {0: "NOK", 1: "OK"}
RATE = 500.0
CHANNELS = ("FZ", "Weg ü", "M [x]")
LABEL = LabelSource(good=("OK",), bad=("NOK",))
FORM = TextForm()
Columns = dict[str, list[Any]]
Cells = list[str]


@dataclass(frozen=True)
class Style:
    """How a test writes its recordings."""

    form: TextForm = FORM
    above: int = 0
    is_packed: bool = False
    has_clock: bool = True
    label_column: bool = True


@dataclass(frozen=True)
class Written:
    """Recordings as a test wrote them."""

    source: Path
    description: Description
    X: np.ndarray
    y: np.ndarray
    file: Path  # the one that has the third part
    row: int = 0  # of its first sample in the file, from 0

    def read(self) -> Dataset:
        return load_dataset(self.source, self.description)


def number(value: float, form: TextForm) -> str:
    """Return a number as a file of this form has it."""
    whole, point, rest = repr(float(value)).partition(".")
    if form.thousands and "e" not in whole + rest and whole != "-0":
        whole = f"{int(whole):,}".replace(",", form.thousands)
    return whole + point.replace(".", form.decimal) + rest


def text_of(columns: Columns, style: Style) -> bytes:
    """Return the content of a text file, its cells as they are or as numbers."""
    form = style.form
    cells = [[c if isinstance(c, str) else number(c, form) for c in v] for v in columns.values()]
    rows = [[*columns], *[["-"] * len(columns)] * (form.units > 0), *zip(*cells, strict=True)]
    lines = [f"# line {i}" for i in range(style.above)] + [*map(form.delimiter.join, rows)]
    content = ("\n".join(lines) + "\n").encode(form.encoding)
    return gzip.compress(content) if style.is_packed else content


def columns_of(x: np.ndarray, label: int, i: int, names: Cells, style: Style) -> Columns:
    """Return all columns that a file may have of part i: a cell for each sample."""
    n = x.shape[1]
    time = {"time": (np.arange(n) / RATE).round(6).tolist()} if style.has_clock else {}
    about = {"part": [str(i)] * n, "verdict": [WORDS[label]] * n, "remark": ["none"] * n}
    return time | about | dict(zip(names, x.tolist(), strict=True))


def content_of(kind: str, columns: Columns, style: Style) -> bytes:
    """Return the content of a file with these columns."""
    if kind == "text":
        return text_of(columns, style)
    if kind == "parquet":
        return pd.DataFrame(columns).to_parquet(index=False)
    if kind == "json":
        return json.dumps(columns).encode()
    if kind == "jsonl":
        rows = zip(*columns.values(), strict=True)
        return "\n".join(json.dumps(dict(zip(columns, row, strict=True))) for row in rows).encode()
    file = BytesIO()
    np.savez(file, **{name: np.array(cells) for name, cells in columns.items()})
    return file.getvalue()


def table_of(layout: str, parts: list[Columns], samples: Cells) -> Columns:
    """Return the columns of all parts in one file: a row for each sample, or for each part."""
    if layout == "long":
        return {name: [cell for part in parts for cell in part[name]] for name in parts[0]}
    table = {name: [part[name][0] for part in parts] for name in ("part", "verdict")}
    if layout == "files":  # lines with arrays of samples
        return {name: [part[name] for part in parts] for name in parts[0]} | {"part": table["part"]}
    for name in samples:
        for t in range(len(parts[0][name])):
            table[f"{name}_{t}"] = [part[name][t] for part in parts]
    return table | {"FZ_max": [0.5] * len(parts)}


def write(
    folder: Path,
    layout: str,
    X: np.ndarray,
    y: np.ndarray,
    style: Style,
    edit: Callable[[Columns], object] = id,
) -> Written:
    """Write recordings (n, C, T) with labels (n,) in a layout, the third part edited."""
    layout, kind = layout.split()
    is_many, is_wide = layout == "files" and kind != "jsonl", layout == "wide"
    blank = "_" if style.form.delimiter == " " else " "
    names = [name.replace(" ", blank) for name in CHANNELS[: X.shape[1]]]
    parts = [columns_of(x, y[i], i, names, style) for i, x in enumerate(X)]
    edit(parts[2 % len(X)])
    suffix = {"text": "csv" + ".gz" * style.is_packed}.get(kind, kind)
    part, label = PartSource(("part",)), replace(LABEL, column="verdict")
    files = {f"all.{suffix}": parts}
    if is_many:
        files = {f"part_{i}_{WORDS[k]}.{suffix}": [parts[i]] for i, k in enumerate(y)}
        part = PartSource(path=r"(\d+)_")
        if not style.label_column:
            label = replace(LABEL, path="_([A-Z]+)$")
    for name, some in files.items():
        if is_many:
            left_out = {"part"} if style.label_column else {"part", "verdict"}
            columns = {key: cells for key, cells in some[0].items() if key not in left_out}
        else:
            columns = table_of(layout, some, names)
        (folder / name).write_bytes(content_of(kind, columns, style))
    description = Description(
        files=("part_*",) if is_many else (*files,),
        format=kind,
        layout=layout,
        text=style.form if kind == "text" else FORM,
        time=Clock(("time",), rate_hz=RATE) if style.has_clock and not is_wide else Clock(),
        channels={f"{name}_*" if is_wide else name: Channel() for name in names},
        traces=TraceForm(X.shape[2]),
        part=part,
        label=label,
    )
    file = folder / [*files][2 % len(files)]
    n_before = {"long": 2 * X.shape[2], "wide": 2}.get(layout, 0)
    row = style.above + 1 + (style.form.units > 0) + n_before
    return Written(folder if is_many else file, description, X, y, file, row)


# Round trips.

TEXT_LAYOUTS = ("files text", "long text", "wide text")
OTHERS = ("files npz", "files json", "files jsonl")
TABLES = ("long parquet", "long jsonl")
LAYOUTS = (*TEXT_LAYOUTS, *OTHERS, *TABLES)
QUICK = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@st.composite
def styles(draw: Callable[..., Any]) -> Style:
    """Draw a way of writing."""
    delimiter = draw(st.sampled_from(",;\t| "))
    decimal = draw(st.sampled_from([mark for mark in ".," if mark != delimiter]))
    marks = [mark for mark in ".,'" if mark not in (delimiter, decimal)]
    thousands = draw(st.sampled_from(["", *marks]))
    above, has_units = draw(st.integers(0, 3)), draw(st.booleans())
    encoding = draw(st.sampled_from(["utf-8", "utf-16", "cp1252", "utf-8-sig"]))
    lines = above + 1, (above + 2) * has_units, above + 2 + has_units
    form = TextForm(encoding, delimiter, decimal, thousands, *lines)
    return Style(form, above, *draw(st.tuples(*[st.booleans()] * 3)))


@st.composite
def recordings(draw: Callable[..., Any]) -> tuple[np.ndarray, np.ndarray]:
    """Draw samples (n, C, T), no two parts alike, and labels (n,)."""
    n, c = draw(st.integers(2, 12)), draw(st.integers(1, 3))
    shape = (n, c, draw(st.integers(max(c, 2), 9)))
    numbers = st.floats(width=32, allow_nan=False, allow_infinity=False)
    X = draw(arrays(np.float32, shape, elements=numbers)).astype(np.float64)
    X[:, 0, 0], X[:, 0, 1] = np.arange(n), -0.5
    return X, draw(arrays(np.int8, n, elements=st.integers(0, 1)))


@pytest.mark.parametrize("layout", LAYOUTS)
@QUICK
@given(recordings(), styles())
def test_recordings_are_read_as_they_were_written_and_a_proposal_is_right_or_open(
    layout: str, drawn: tuple[np.ndarray, np.ndarray], style: Style
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        written = write(Path(folder), layout, *drawn, style)
        data = proposed = written.read()
        with suppress(DataError):
            proposal = describe(written.source)
            if not proposal.open_keys:
                proposed = load_dataset(written.source, proposal)
    assert data.faults == ()
    np.testing.assert_array_equal(data.X, squeezed(written.X))
    np.testing.assert_array_equal(data.y, written.y)
    assert data.part.tolist() == [str(i) for i in range(len(written.X))]
    places = [data.source.tolist().index(source) for source in proposed.source]
    np.testing.assert_array_equal(proposed.y, data.y[places])
    if proposed.channels == data.channels:
        np.testing.assert_array_equal(proposed.X, data.X[places])


def squeezed(X: np.ndarray) -> np.ndarray:
    """Return traces (n, C, T) as a data set has them."""
    return (X[:, 0] if X.shape[1] == 1 else X).astype(np.float32)


# Damages.

PLAIN, GERMAN = Style(), Style(TextForm("utf-8", ";", ",", ".", 2, 3, 4), above=1)
N = 20
Edit = Callable[[Columns], object]


def some() -> tuple[np.ndarray, np.ndarray]:
    """Return samples (5, 2, 20) and labels (5,)."""
    X = np.random.default_rng(0).normal(size=(5, 2, N)).astype(np.float32)
    return X.astype(np.float64), np.array([1, 0, 1, 1, 0])


def put(cell: Any, name: str = "FZ") -> Edit:
    """Return an edit that replaces a cell."""
    return lambda columns: columns[name].__setitem__(7, cell)


def move(rows: np.ndarray) -> Edit:
    """Return an edit that takes the rows of a part in another order."""
    return lambda columns: columns.update(
        {name: [cells[i] for i in rows] for name, cells in columns.items()}
    )


CELLS = ("1x", "inf", "-Infinity", "NaN", "1_000", "0x1F", "1e", "--1", "1 2", "٣", "1.04,5")
ROWS: dict[str, Edit] = {
    "swapped": move(np.r_[:7, 8, 7, 9:N]),
    "lost": move(np.r_[:7, 8:N]),
    "doubled": move(np.r_[:8, 7:N]),
    "doubled and lost": move(np.r_[:7, 7, 7, 9:N]),
    "cut": move(np.r_[: N - 1]),
    "other word": put("NOK", "verdict"),
    "unknown word": lambda columns: columns.update(verdict=["MAYBE"] * N),
}
BY_ROWS = ("files text", "long text", "files json", "files jsonl", "long jsonl", "files npz")


def assert_only_fault(written: Written, lines: Sequence[int] = (), column: str = "") -> None:
    """Check that only the third part is a fault, with its file, a line among these, and its column."""
    data = written.read()
    np.testing.assert_array_equal(data.X, squeezed(np.delete(written.X, 2, axis=0)))
    assert data.faults
    for fault in data.faults:
        assert fault.source.partition(",")[0] == written.file.name
        assert not lines or fault.line in lines, fault
        assert not column or fault.column == column, fault


NO_NUMBERS = [
    *product([*TEXT_LAYOUTS, "files json", "files jsonl", "long jsonl"], [*CELLS, "", "1,,2"]),
    *product([*TABLES, "files json", "files npz"], [float("inf"), -float("inf")]),
]


@pytest.mark.parametrize(("layout", "cell"), NO_NUMBERS)
def test_a_cell_that_is_no_finite_number_is_a_fault(tmp_path: Path, layout: str, cell: Any) -> None:
    written = write(tmp_path, layout, *some(), GERMAN, put(cell))
    is_wide = layout == "wide text"
    lines = [written.row + 1 + (0 if is_wide else 7)] if "text" in layout else []
    assert_only_fault(written, lines, "FZ_7" if is_wide else "FZ")


@pytest.mark.parametrize("layout", BY_ROWS)
@pytest.mark.parametrize("kind", ROWS)
def test_rows_that_do_not_fit_are_a_fault(tmp_path: Path, layout: str, kind: str) -> None:
    written = write(tmp_path, layout, *some(), PLAIN, ROWS[kind])
    row = written.row + 1
    lines = {"cut": [0], "unknown word": [0, row]}.get(kind, [row + 7, row + 8])
    column = "" if kind == "cut" else "verdict" if "word" in kind else "time"
    assert_only_fault(written, lines if "text" in layout else (), column)


LINES: dict[str, Callable[[Cells], Cells]] = {
    "too many": lambda cells: [*cells, "1"],
    "too few": lambda cells: cells[:-1],
    "one": lambda cells: cells[:1],
    "quote": lambda cells: ['"' + cells[0], *cells[1:]],
}


@pytest.mark.parametrize("style", [PLAIN, GERMAN], ids=["plain", "german"])
@pytest.mark.parametrize("layout", TEXT_LAYOUTS)
@pytest.mark.parametrize("kind", LINES)
def test_a_line_of_another_number_of_cells_is_a_fault(
    tmp_path: Path, layout: str, kind: str, style: Style
) -> None:
    written = write(tmp_path, layout, *some(), style)
    at = written.row + (0 if "wide" in layout else 7)
    lines = written.file.read_text().split("\n")
    mark = style.form.delimiter
    lines[at] = mark.join(LINES[kind](lines[at].split(mark)))
    written.file.write_text("\n".join(lines))
    assert_only_fault(written, [at + 1])


FILES = {  # what is replaced in a file, by what; the line and the column of its fault
    "empty": (b".*", b"", 0, ""),
    "only a header": (b"\n.*", b"", 2, ""),
    "other byte": (b"OK", b"\xd6K", 2, ""),
    "zero byte": (b"OK", b"O\0", 2, ""),
    "other delimiter": (b",", b";", 1, "time"),
    "other header": (b"FZ", b"FX", 1, "FZ"),
    "no header": (rb"\A[^\n]*\n", b"", 1, "time"),
    "only blanks": (b".+", b" \n \n", 0, ""),
}


@pytest.mark.parametrize(("old", "new", "line", "column"), FILES.values(), ids=FILES)
def test_a_damaged_file_is_a_fault_and_the_others_are_read(
    tmp_path: Path, old: bytes, new: bytes, line: int, column: str
) -> None:
    written = write(tmp_path, "files text", *some(), PLAIN)
    written.file.write_bytes(re.sub(b"(?s)" + old, new, written.file.read_bytes()))
    assert_only_fault(written, [line], column)


@pytest.mark.parametrize("kind", ["json", "npz", "text"])
@pytest.mark.parametrize("keep", [0, 0.5, 0.99])
def test_a_cut_file_is_a_fault(tmp_path: Path, kind: str, keep: float) -> None:
    written = write(tmp_path, f"files {kind}", *some(), Style(is_packed=True))
    content = written.file.read_bytes()
    written.file.write_bytes(content[: int(keep * len(content))])
    assert_only_fault(written)


def test_a_file_that_changes_while_it_is_read_is_a_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = write(tmp_path, "files text", *some(), PLAIN)
    read = Path.read_bytes

    def grow(path: Path) -> bytes:
        content = read(path)
        if path == written.file:
            path.write_bytes(content + b"1")
        return content

    monkeypatch.setattr(Path, "read_bytes", grow)
    assert_only_fault(written)


def test_equal_samples_under_two_labels_are_faults_and_repeats_are_left_out(tmp_path: Path) -> None:
    X = some()[0][[0, 0, 2, 3, 3]]
    data = write(tmp_path, "files text", X, np.array([1, 0, 1, 1, 1]), PLAIN).read()
    assert data.source.tolist() == ["part_2_OK.csv", "part_3_OK.csv"]
    assert [fault.source[:6] for fault in data.faults] == ["part_0", "part_1", "part_4"]


def test_a_channel_of_an_unknown_unit_does_not_get_that_of_another(tmp_path: Path) -> None:
    written = write(tmp_path, "files text", *some(), PLAIN)
    channels = dict(zip(written.description.channels, (Channel("N"), Channel()), strict=True))
    data = load_dataset(tmp_path, replace(written.description, channels=channels))
    assert data.spec.units == ("N", "")


# Bad input.


def test_one_sentence_says_what_to_type(tmp_path: Path) -> None:
    """Each way of having no recordings, or no description of them."""
    d, empty = write(tmp_path, "files text", *some(), PLAIN).description, tmp_path / "empty"
    empty.mkdir()
    listed = replace(LABEL, listing="list.csv", key="part", column="verdict")
    (empty / "recordings.toml").write_text(d.to_toml())
    cases = {
        "Expected a file, a folder or": (tmp_path / "none", None),
        f"dengine data {re.escape(str(tmp_path))} --save": (tmp_path, None),
        r"another folder\? See `dengine data": (empty, None),
        "Expected a description in .*none.toml": (tmp_path, tmp_path / "none.toml"),
    }
    changes = {
        "still open: label.column": {"label": LabelSource("?")},
        "still open: channels": {"channels": {}},
        "traces.samples": {"traces": TraceForm()},
        "list.csv": {"label": listed},
        "one group": {"part": PartSource(path="part")},
        "time.format": {"time": Clock(("time",), ("parsec",))},
        "a format for each": {"time": Clock(("time",), ("s", "ms"))},
        "time.zone": {"time": Clock(("time",), zone="Mars/X")},
        "1 Hz to 1 MHz": {"time": Clock(rate_hz=2e6)},
        "one limit": {"channels": {"FZ": Channel(limit=1.0), "Weg ü": Channel()}},
    }
    cases |= {text: (tmp_path, replace(d, **change)) for text, change in changes.items()}
    for message, (source, description) in cases.items():
        with pytest.raises(DataError, match=message) as caught:
            load_dataset(source, description)
        assert str(caught.value).count("\n") <= (description is None) * 20, message


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"files = [", "Expected TOML"),
        (b"version = 99", "install a newer dengine"),
        (b"[txet]", "Expected 'text' in .*, got 'txet'"),
        (b"[time]\ncolum = 't'", "Expected 'column' in .*, time, got 'colum'"),
        (b"layout = 'log'", "Expected 'long' in .*, layout, got 'log'"),
        (b"[time]\ngap = 'far'", "a number in .*, time, gap"),
        (b"[time]\nrate_hz = nan", "a number in .*, time, rate_hz"),
        (b"[text]\nheader = true", "a whole number"),
        (b"text = 1", "text to be a table"),
        (b"check = 1", "check to be a table"),
        (b"version = '?'", "version 1"),
        (b"#" * 1_000_001, "at most 1 MB"),
        (b"\xff", "a description in"),
    ],
    ids=lambda value: value[:20],
)
def test_a_damaged_description_is_refused(text: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "recordings.toml").write_bytes(text)
    with pytest.raises(DataError, match=message):
        load_dataset(tmp_path)


FORCE = [f"{k * 0.002:.3f},{k * k % 17}.5" for k in range(24)]


def in_files(folder: Path) -> Path:
    """Write five files of time and force."""
    for i in range(5):
        rows = "\n".join(["time,force", *(f"{row}{i}" for row in FORCE)])
        (folder / f"{i}_{WORDS[i % 2]}.csv").write_text(rows)
    return folder


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("channels.forc", "N", "Expected 'force' in the columns"),
        ("time.column", "tmie", "Expected 'time' in the columns"),
        ("label.column", "verdict", "where [label] says they stand"),
        ("label.path", "(", "a regular expression with one group"),
        ("label.listing", "x.csv", "label.key"),
        ("text.encoding", "utf-99", "text.encoding"),
        ("text.encoding", "undefined", "text.encoding"),
        ("text.encoding", "a\0b", "text.encoding"),
        ("text.delimiter", ";;", "text.delimiter"),
        ("text.thousands", ".", "two marks in text.decimal and text.thousands"),
        ("text.thousands", 0, "two marks in text.decimal and text.thousands"),
        ("time.format", ["s", "ms"], "a format for each of 1 columns"),
        ("time.zone", "Foo/Bar", "time.zone"),
        ("text.header", 9, "none: 0_NOK.csv, line 9: Expected a header"),
        ("text.data", 500, "line 500: Expected rows of samples"),
        ("files", "/x/*.csv", "patterns below a folder"),
        ("files", ".", "patterns below a folder"),
    ],
)
def test_a_stated_value_that_cannot_be_is_refused(
    tmp_path: Path, key: str, value: Any, message: str
) -> None:
    with pytest.raises(DataError, match=re.escape(message)):
        describe(in_files(tmp_path), {key: value})


def test_stated_sections_are_kept_and_a_question_mark_is_answered(tmp_path: Path) -> None:
    proposal = describe(in_files(tmp_path), {"traces": {"samples": 7}, "time.rate_hz": "?"})
    assert (proposal.traces.samples, proposal.time.rate_hz) == (7, 500.0)


VALUES = ["?", "\0", "%Y%Y", 0, -1, 1e308, True, None, [], ["a", "b"], {1: 2}, "punycode", "force"]
STATED = [f"{name}.{f.name}" for name, cls in SECTIONS.items() if cls for f in fields(cls)]
TOP = [f.name for f in fields(Description)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = in_files(tmp_path_factory.mktemp("stated"))
    describe(folder).save(folder / "recordings.toml")
    return folder


@settings(QUICK, max_examples=50, derandomize=True)
@given(st.sampled_from([*TOP, *STATED, "rows.force.keep"]), st.sampled_from(VALUES))
def test_any_stated_value_is_read_or_refused(folder: Path, key: str, value: Any) -> None:
    with suppress(DengineError):
        describe(folder, {key: value})
    with suppress(DengineError):
        saved = Description.load(folder / "recordings.toml")
        load_dataset(folder, saved.with_values({key: value}))


@pytest.mark.parametrize("time", ["{:.3f}", "2024-05-01 10:00:00.{:03d}"])
def test_a_first_row_that_lost_a_sample_is_no_header(tmp_path: Path, time: str) -> None:
    for i in range(6):
        times = [time.format(j / 500 if "f" in time else 2 * j) for j in range(40)]
        rows = [f"{t},{j % 10 and i + j % 7 + 1},k" for j, t in enumerate(times)]
        text = "\n".join(["time,force,remark", *rows]).replace(",0,", ",,")
        (tmp_path / f"{i}_{WORDS[i % 2]}.csv").write_text(text)
    data = load_dataset(tmp_path, describe(tmp_path))
    assert (data.channels, data.X.shape) == (("force",), (6, 40))
    assert np.isnan(data.X[:, ::10]).all()


def test_a_long_text_of_wide_characters_is_cut_between_lines(tmp_path: Path) -> None:
    rows = "".join(f"{i / 500:.3f},{i % 17}.5\n" for i in range(90_000))
    for word in WORDS.values():
        (tmp_path / f"1_{word}.csv").write_bytes(f"\ufefftime,force\n{rows}".encode("utf-16-be"))
    assert "force" in describe(tmp_path, {"layout": "files"}).channels


def test_a_cell_that_is_too_long_is_a_fault(tmp_path: Path) -> None:
    (in_files(tmp_path) / "9_OK.csv").write_text(
        "\n".join(["time,force", *FORCE, f"0.048,{'1' * 200_000}"])
    )
    (fault,) = load_dataset(tmp_path, describe(tmp_path)).faults
    assert (fault.source, fault.line, fault.column) == ("9_OK.csv", 26, "force")


def test_lines_of_json_under_another_suffix_are_refused_until_that_is_stated(
    tmp_path: Path,
) -> None:
    path = tmp_path / "all.json"
    path.write_text('{"ok": true, "force": [0, 2, 4]}\n{"ok": false, "force": [1, 2, 7]}')
    with pytest.raises(DataError, match='state format="jsonl"'):
        describe(path)
    assert load_dataset(path, describe(path, {"format": "jsonl"})).y.tolist() == [1, 0]


@pytest.mark.parametrize("state", ["k", ["k"] * 2])
def test_a_column_of_rows_that_is_shorter_than_the_samples_is_a_fault(
    tmp_path: Path, state: str | list[str]
) -> None:
    path = tmp_path / "all.jsonl"
    parts = [{"ok": ok, "force": [ok, 2, 4], "state": state} for ok in (0, 1)]
    path.write_text("\n".join(map(json.dumps, parts)))
    proposal = describe(path, {"rows.state.keep": "k", "label.good": 1, "label.bad": 0})
    with pytest.raises(DataError, match="Expected columns of one length"):
        load_dataset(path, proposal.with_values({"channels.force": "N", "traces.samples": 3}))


def test_stated_checks_and_headers_are_kept(tmp_path: Path) -> None:
    check = {"path": "^(.)", "good": [*"134"], "bad": [*"02"]}
    stated = describe(in_files(tmp_path), {"check": [check], "text.header": "tim"})
    data = load_dataset(tmp_path, stated)
    assert data.X.shape == (4, 24)
    assert [fault.source for fault in data.faults] == ["4_NOK.csv"]


def test_a_listing_names_parts_once_and_is_no_recording(tmp_path: Path) -> None:
    written = write(tmp_path, "files text", *some(), PLAIN)
    (tmp_path / "part_list.csv").write_text("part,verdict\n000,OK\n1,NOK\n2,OK\n2,NOK\n4,NOK\n9,OK")
    label = replace(LABEL, listing="part_list.csv", key="part", column="verdict")
    data = load_dataset(tmp_path, replace(written.description, label=label))
    assert data.part.tolist() == ["0", "1", "4"]
    assert [fault.source for fault in data.faults] == ["part_2_OK.csv", "part_3_OK.csv"]
    assert "1 of 5 rows of part_list.csv name no recording that was read: 9." in data.notes


# Descriptions.


@pytest.mark.parametrize("rate", [3.0, 700.0])
def test_a_resampled_recording_may_end_one_step_before_the_trace(rate: float) -> None:
    for n in range(3, 60, 4):
        table = pd.DataFrame({"time": np.arange(n) / rate, "FZ": np.arange(n) ** 2.0, "y": 1})
        description = Description(
            format="frame",
            layout="files",
            time=Clock(("time",), rate_hz=rate),
            channels={"FZ": Channel("N")},
            label=LabelSource("y", good=("1",), bad=("0",)),
            traces=TraceForm(n + 1, "resample"),
        )
        X = load_dataset(table, description).X
        np.testing.assert_allclose(X[0, :n], np.arange(n) ** 2.0, rtol=1e-5, atol=1e-3)


def test_a_stated_key_replaces_one_and_a_stated_source_the_others() -> None:
    d = Description(channels={"F.z": Channel("N"), "?": Channel()}, label=LabelSource("verdict"))
    stated = d.with_values({"channels.F.z.limit": 100.0, "label.path": "(OK)"})
    assert stated.channels == {"F.z": Channel("N", limit=100.0)}
    assert stated.label == LabelSource(path="(OK)")
    assert d.open_keys == ("channels",)


def of_field(about: Any) -> Any:
    """Return what a key may be."""
    words = st.text(max_size=5)
    if get_origin(about.type) is Literal:
        return st.sampled_from(get_args(about.type))
    if about.name == "version":
        return st.just(1)
    finite = st.floats(allow_nan=False, allow_infinity=False)
    kinds: dict[type, Any] = {bool: st.booleans(), float: finite, str: words}
    kinds[tuple] = st.lists(words, max_size=3).map(tuple)
    return kinds.get(type(about.default), st.integers(-(2**53), 2**53))


def of_section(name: str, cls: Any) -> Any:
    """Return what a section may be."""
    one = st.text(max_size=5)
    if cls:
        one = st.builds(cls, **{f.name: of_field(f) for f in fields(cls)})
    if name == "check":
        return st.lists(one, max_size=3).map(tuple)
    named = st.dictionaries(st.text(max_size=8), one, max_size=3)
    return named if name in ("rows", "channels", "ignored") else one


KEYS = {f.name: of_field(f) for f in fields(Description) if f.compare and f.name not in SECTIONS}


SECTIONS_ = {name: of_section(name, cls) for name, cls in SECTIONS.items()}
NOTES = st.dictionaries(st.sampled_from(["text.names", "channels.?", "files"]), st.text())


@QUICK
@given(st.builds(Description, **KEYS, **SECTIONS_, notes=NOTES))
def test_a_description_comes_back_from_its_toml(description: Description) -> None:
    assert (
        "?" in description.channels or Description.from_toml(description.to_toml()) == description
    )


def test_two_marks_that_both_stand_twice_in_a_number_are_a_question(tmp_path: Path) -> None:
    rows = "".join(f"1.{i}.000;1,{i},000\n" for i in range(100, 140))
    for name in ("1_OK.csv", "2_NOK.csv"):
        (tmp_path / name).write_text(f"force;path\n{rows}")
    assert "text.decimal" in describe(tmp_path).open_keys


def test_results_without_curves_are_refused_although_most_are_good(tmp_path: Path) -> None:
    rows = [f"{i},{40 + i % 7 / 10},{'NOK' if i % 40 == 3 else 'OK'}" for i in range(400)]
    path = tmp_path / "results.csv"
    path.write_text("\n".join(["serial,torque,report", *rows]) + "\n", encoding="utf-8")
    with pytest.raises(DataError, match="with its verdict in report, and no curve"):
        describe(path)


def test_a_clock_that_no_header_names_is_asked_for(tmp_path: Path) -> None:
    for i in range(4):
        table = np.c_[1.7e9 + 10 * i + np.arange(60) * 0.004, np.sin(np.arange(60.0) + i)]
        np.savetxt(tmp_path / f"{i}_{WORDS[i % 2]}.csv", table, delimiter=",")
    proposal = describe(tmp_path)
    assert "time.column" in proposal.open_keys
    assert "of c0, c1: " in proposal.notes["time.column"]


@pytest.mark.parametrize(("digits", "is_open"), [(2, False), (3, True)])
def test_one_number_with_another_decimal_mark_is_a_fault_or_asked_for_if_it_may_be_a_thousand(
    tmp_path: Path, digits: int, is_open: bool
) -> None:
    for i in range(10):
        rows = [f"{j / 100:.2f};{1 + i + j / 7:.{digits}f}" for j in range(60)]
        rows[30] = rows[30].replace(".", "," if i == 3 else ".")
        text = "\n".join(["t;F", *rows]) + "\n"
        (tmp_path / f"{i}_{WORDS[i % 2]}.csv").write_text(text, encoding="utf-8")
    proposal = describe(tmp_path, {"channels.F": "N"})
    assert ("text.thousands" in proposal.open_keys) == is_open
    data = load_dataset(tmp_path, proposal.with_values({"text.thousands": ""}))
    assert [(fault.source, fault.line) for fault in data.faults] == [("3_OK.csv", 32)]


@pytest.mark.parametrize(("name", "is_open"), [("part_no", False), ("charge", True)])
def test_a_column_with_a_run_for_each_part_is_asked_for_unless_it_is_named_like_one(
    tmp_path: Path, name: str, is_open: bool
) -> None:
    for word in WORDS.values():
        rows = [f"{word}{i // 20},{i % 7}" for i in range(200)]
        (tmp_path / f"{word}.csv").write_text("\n".join([f"{name},F", *rows]) + "\n")
    proposal = describe(tmp_path)
    assert proposal.layout == "long"
    assert ("part.column" in proposal.open_keys) == is_open
    assert name in proposal.notes.get("part.column", name)


@pytest.mark.parametrize("name", ["failed", "not_ok", "result"])
def test_true_and_false_are_asked_for_in_a_column_whose_name_does_not_say_good(
    tmp_path: Path, name: str
) -> None:
    for i in range(8):
        rows = "".join(f"{j / 100},{i + j % 5},{i % 2 == 0}\n" for j in range(30))
        (tmp_path / f"{i}.csv").write_text(f"t,F,{name}\n{rows}", encoding="utf-8")
    proposal = describe(tmp_path)
    open_labels = [key for key in proposal.open_keys if key.startswith("label.")]
    assert open_labels
    notes = [proposal.notes[key] for key in open_labels]
    assert all("False: 4" in note and "True: 4" in note for note in notes), notes
