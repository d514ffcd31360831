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
from dengine.errors import DataError

WORDS = {0: "NOK", 1: "OK"}
RATE = 500.0
OTHER_COLUMNS = {"time", "verdict", "remark", "part"}
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
    if form.thousands and "e" not in whole + rest:
        whole = f"{int(whole):,}".replace(",", form.thousands) if whole != "-0" else whole
    return whole + point.replace(".", form.decimal) + rest


def write_text(path: Path, columns: Columns, style: Style) -> None:
    """Write a text file, its cells as they are or as numbers."""
    form = style.form
    cells = [[c if isinstance(c, str) else number(c, form) for c in v] for v in columns.values()]
    rows = [*map(list, zip(*cells, strict=True))]
    if form.units:
        rows.insert(0, ["-"] * len(columns))
    if form.header:
        rows.insert(0, [*columns])
    above = [f"# line {i}" for i in range(style.above)]
    lines = [*above, *(form.delimiter.join(row) for row in rows)]
    content = ("\n".join(lines) + "\n").encode(form.encoding)
    path.write_bytes(gzip.compress(content) if style.is_packed else content)


def part_columns(X: np.ndarray, y: np.ndarray, style: Style, names: Cells) -> list[Columns]:
    """Return the columns of each part: a row for each sample."""
    n = X.shape[2]
    time = (np.arange(n) / RATE).round(6).tolist()
    return [
        ({"time": [*time]} if style.has_clock else {})
        | ({"verdict": [WORDS[label]] * n} if style.label_column else {})
        | dict(zip(names, x.tolist(), strict=True))
        | {"remark": ["none"] * n}
        for x, label in zip(X, y.tolist(), strict=True)
    ]


def save_arrays(path: Path, columns: Columns) -> None:
    named: Any = {name: np.array(cells) for name, cells in columns.items()}
    np.savez(path, **named)


def write_parts(folder: Path, kind: str, stems: Cells, parts: list[Columns], style: Style) -> None:
    """Write a file for each part."""
    for stem, columns in zip(stems, parts, strict=True):
        if kind == "text":
            write_text(folder / stem, columns, style)
        elif kind == "npz":
            save_arrays(folder / stem, columns)
        else:
            (folder / stem).write_text(json.dumps(columns))


def table_of(layout: str, objects: list[dict[str, Any]], about: Columns) -> pd.DataFrame:
    """Return the table of all parts in a layout."""
    if layout == "long":
        return pd.concat(map(pd.DataFrame, objects))
    cells = [
        {
            f"{name}_{t}": cell
            for name in {*part} - OTHER_COLUMNS
            for t, cell in enumerate(part[name])
        }
        for part in objects
    ]
    return pd.concat([pd.DataFrame(about), pd.DataFrame(cells)], axis=1).assign(FZ_max=0.5)


def described(layout: str, X: np.ndarray, style: Style, names: Cells, kind: str) -> Description:
    """Return the description of recordings that stand in single files, but for their files."""
    label = replace(LABEL, column="verdict")
    part = PartSource(("part",))
    if layout == "files" and kind != "jsonl":
        part = PartSource(path=r"(\d+)_")
        label = label if style.label_column else replace(LABEL, path="_([A-Z]+)$")
    is_wide = layout == "wide"
    return Description(
        format=kind,
        layout=layout,
        text=style.form if kind == "text" else TextForm(),
        time=Clock(("time",), rate_hz=RATE) if style.has_clock and not is_wide else Clock(),
        channels={f"{name}_*" if is_wide else name: Channel() for name in names},
        traces=TraceForm(X.shape[2]),
        part=part,
        label=label,
    )


def write(
    folder: Path,
    layout: str,
    X: np.ndarray,
    y: np.ndarray,
    style: Style,
    edit: Callable[[Columns], object] = lambda _: None,
) -> Written:
    """Write recordings (n, C, T) with labels (n,) in a layout, the third part edited."""
    layout, kind = layout.split()
    is_blank = kind == "text" and style.form.delimiter == " "
    names = [n.replace(" ", "_") if is_blank else n for n in CHANNELS[: X.shape[1]]]
    parts = part_columns(X, y, style, names)
    edit(parts[2 % len(X)])
    written = [parts[i]["verdict"][0] if style.label_column else WORDS[k] for i, k in enumerate(y)]
    about = {"part": [str(i) for i in range(len(X))], "verdict": written}
    objects: list[dict[str, Any]] = [
        {"verdict": word, **p, "part": i}
        for p, word, i in zip(parts, written, about["part"], strict=True)
    ]
    suffix = "csv.gz" if kind == "text" and style.is_packed else {"text": "csv"}.get(kind, kind)
    single = folder / f"all.{suffix}"
    stems = [f"part_{i}_{WORDS[label]}.{suffix}" for i, label in enumerate(y)]
    is_many = layout == "files" and kind != "jsonl"
    if is_many:
        write_parts(folder, kind, stems, parts, style)
    elif layout == "files":
        single.write_text("\n".join(map(json.dumps, objects)))
    else:
        table = table_of(layout, objects, about)
        if kind == "text":
            write_text(single, table.to_dict("list"), style)
        elif kind == "parquet":
            table.to_parquet(single, index=False)
        else:
            single.write_text("\n".join(map(json.dumps, table.to_dict("records"))))
    files = ("part_*",) if is_many else (single.name,)
    description = replace(described(layout, X, style, names, kind), files=files)
    n_before = {"long": 2 * X.shape[2], "wide": 2}.get(layout, 0)
    row = style.above + 1 + (style.form.units > 0) + n_before
    file = folder / stems[2 % len(X)] if is_many else single
    return Written(folder if is_many else single, description, X, y, file, row)


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
    marks = [mark for mark in (".", ",", "'") if mark not in (delimiter, decimal)]
    above, has_units = draw(st.integers(0, 3)), draw(st.booleans())
    encoding = draw(st.sampled_from(["utf-8", "utf-16", "cp1252", "utf-8-sig"]))
    form = TextForm(encoding, delimiter, decimal, draw(st.sampled_from(["", *marks])))
    places = {"header": above + 1, "units": (above + 2) * has_units, "data": above + 2 + has_units}
    form = replace(form, **places)
    return Style(form, above, *draw(st.tuples(st.booleans(), st.booleans(), st.booleans())))


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
    proposed = None
    with tempfile.TemporaryDirectory() as folder:
        written = write(Path(folder), layout, *drawn, style)
        data = written.read()
        with suppress(DataError):
            proposal = describe(written.source)
            proposed = None if proposal.open_keys else load_dataset(written.source, proposal)
    assert data.faults == ()
    np.testing.assert_array_equal(data.X, squeezed(written.X))
    np.testing.assert_array_equal(data.y, written.y)
    assert words(data.part) == [str(i) for i in range(len(written.X))]
    if proposed is not None:
        places = [words(data.source).index(source) for source in words(proposed.source)]
        np.testing.assert_array_equal(proposed.y, data.y[places])
        if proposed.channels == data.channels:
            np.testing.assert_array_equal(proposed.X, data.X[places])


def squeezed(X: np.ndarray) -> np.ndarray:
    """Return traces (n, C, T) as a data set has them."""
    return (X[:, 0] if X.shape[1] == 1 else X).astype(np.float32)


def words(values: np.ndarray | None) -> list[str]:
    """Return the parts or the sources of a data set."""
    return [] if values is None else values.tolist()


# Damages.

PLAIN = Style(label_column=True)
GERMAN = Style(TextForm("utf-8", ";", ",", ".", 2, 3, 4), above=1, label_column=True)
BAD_PART = 2
N = 20
Edit = Callable[[Columns], object]


def some() -> tuple[np.ndarray, np.ndarray]:
    """Return samples (5, 2, 20) and labels (5,)."""
    X = np.random.default_rng(0).normal(size=(5, 2, N)).astype(np.float32).astype(np.float64)
    return X, np.array([1, 0, 1, 1, 0])


def put(cell: Any, name: str = "FZ") -> Edit:
    """Return an edit that replaces a cell."""
    return lambda columns: columns[name].__setitem__(7, cell)


def move(order: Callable[[list[int]], list[int]]) -> Edit:
    """Return an edit that takes the rows of a part in another order."""

    def edit(columns: Columns) -> None:
        rows = order([*range(N)])
        columns.update({name: [cells[i] for i in rows] for name, cells in columns.items()})

    return edit


def all_words(columns: Columns) -> None:
    columns["verdict"] = ["MAYBE"] * N


CELLS = ("1x", "inf", "-Infinity", "NaN", "1_000", "0x1F", "1e", "--1", "1 2", "٣", "1.04,5")
ROWS: dict[str, Edit] = {
    "swapped": move(lambda rows: [*rows[:7], 8, 7, *rows[9:]]),
    "lost": move(lambda rows: [*rows[:7], *rows[8:]]),
    "doubled": move(lambda rows: [*rows[:8], *rows[7:]]),
    "doubled and lost": move(lambda rows: [*rows[:7], 7, 7, *rows[9:]]),
    "cut": move(lambda rows: rows[:-1]),
    "other word": put("NOK", "verdict"),
    "unknown word": all_words,
}
BY_ROWS = ("files text", "long text", "files json", "files jsonl", "long jsonl", "files npz")


def assert_only_fault(
    written: Written, lines: Sequence[int] = (), column: str = "", part: int = BAD_PART
) -> None:
    """Check that only one part is a fault, with its file, a line among these, and its column."""
    data = written.read()
    np.testing.assert_array_equal(data.X, squeezed(np.delete(written.X, part, axis=0)))
    assert {fault.source.partition(",")[0] for fault in data.faults} == {written.file.name}
    if lines:
        assert {fault.line for fault in data.faults} <= {*lines}, data.faults
    if column:
        assert {fault.column for fault in data.faults} == {column}, data.faults


@pytest.mark.parametrize("layout", [*TEXT_LAYOUTS, "files json", "files jsonl", "long jsonl"])
@pytest.mark.parametrize("cell", [*CELLS, "", "1,,2"])
def test_a_cell_that_is_no_number_is_a_fault(tmp_path: Path, layout: str, cell: str) -> None:
    written = write(tmp_path, layout, *some(), GERMAN, put(cell))
    is_text, is_wide = "text" in layout, layout == "wide text"
    lines = [written.row + 1 + (0 if is_wide else 7)] if is_text else []
    assert_only_fault(written, lines, "FZ_7" if is_wide else "FZ")


@pytest.mark.parametrize("layout", BY_ROWS)
@pytest.mark.parametrize("kind", ROWS)
def test_rows_that_do_not_fit_are_a_fault(tmp_path: Path, layout: str, kind: str) -> None:
    written = write(tmp_path, layout, *some(), PLAIN, ROWS[kind])
    row = written.row + 1
    lines = {"cut": [0], "unknown word": [0, row]}.get(kind, [row + 7, row + 8])
    column = "" if kind == "cut" else "verdict" if "word" in kind else "time"
    assert_only_fault(written, lines if "text" in layout else (), column)


@pytest.mark.parametrize("value", [float("inf"), -float("inf")])
@pytest.mark.parametrize("layout", [*TABLES, "files json", "files npz"])
def test_a_number_that_is_not_finite_is_a_fault(tmp_path: Path, layout: str, value: float) -> None:
    X, y = some()
    X[BAD_PART, 0, 7] = 0
    written = write(tmp_path, layout, X, y, PLAIN, put(value))
    assert_only_fault(written, column="FZ")


LINES: dict[str, Callable[[Cells], Cells]] = {
    "too many": lambda cells: [*cells, "1"],
    "too few": lambda cells: cells[:-1],
    "one": lambda cells: cells[:1],
    "quote": lambda cells: ['"' + cells[0], *cells[1:]],
}


@pytest.mark.parametrize("style", [PLAIN, GERMAN], ids=["plain", "german"])
@pytest.mark.parametrize("layout", ["files text", "long text", "wide text"])
@pytest.mark.parametrize("kind", LINES)
def test_a_line_of_another_number_of_cells_is_a_fault(
    tmp_path: Path, layout: str, kind: str, style: Style
) -> None:
    written = write(tmp_path, layout, *some(), style)
    mark = style.form.delimiter
    lines = written.file.read_text().split("\n")
    at = written.row + (0 if "wide" in layout else 7)
    lines[at] = mark.join(LINES[kind](lines[at].split(mark)))
    written.file.write_text("\n".join(lines))
    assert_only_fault(written, [at + 1])


FILES: dict[str, tuple[Callable[[str], str | bytes], int, str]] = {
    "empty": (lambda _: "", 0, ""),
    "only a header": (lambda text: text.split("\n")[0], 2, ""),
    "other byte": (
        lambda text: text.encode().replace(b"NOK", b"N\xd6K").replace(b"OK", b"\xd6K"),
        2,
        "",
    ),
    "zero byte": (lambda text: text.replace("OK", "O\0"), 2, ""),
    "other delimiter": (lambda text: text.replace(",", ";"), 1, "time"),
    "other header": (lambda text: text.replace("FZ", "FX"), 1, "FZ"),
    "no header": (lambda text: text.partition("\n")[2], 1, "time"),
    "only blanks": (lambda _: " \n \n", 0, ""),
}


@pytest.mark.parametrize("kind", FILES)
def test_a_damaged_file_is_a_fault_and_the_others_are_read(tmp_path: Path, kind: str) -> None:
    written = write(tmp_path, "files text", *some(), PLAIN)
    damage, line, column = FILES[kind]
    text = damage(written.file.read_text())
    written.file.write_bytes(text if isinstance(text, bytes) else text.encode())
    assert_only_fault(written, [line], column)


@pytest.mark.parametrize("kind", ["json", "npz", "text"])
@pytest.mark.parametrize("keep", [0, 0.5, 0.99])
def test_a_cut_file_is_a_fault(tmp_path: Path, kind: str, keep: float) -> None:
    written = write(tmp_path, f"files {kind}", *some(), replace(PLAIN, is_packed=True))
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
    X, y = some()
    X[1], X[4] = X[0], X[3]
    y[4] = y[3]
    data = write(tmp_path, "files text", X, y, PLAIN).read()
    assert words(data.source) == ["part_2_OK.csv", "part_3_OK.csv"]
    assert [fault.source[:6] for fault in data.faults] == ["part_0", "part_1", "part_4"]


# Bad input.


def test_one_sentence_says_what_to_type(tmp_path: Path) -> None:
    """Each way of having no recordings, or no description of them."""
    written = write(tmp_path, "files text", *some(), PLAIN)
    d, empty = written.description, tmp_path / "empty"
    empty.mkdir()
    listed = replace(LABEL, listing="list.csv", key="part", column="verdict")
    (empty / "recordings.toml").write_text(d.to_toml())
    cases: list[tuple[Path, Any, str]] = [
        (tmp_path / "none", None, "does not exist"),
        (tmp_path, None, f"dengine data {re.escape(str(tmp_path))} --save"),
        (empty, None, r"another folder\? See `dengine data"),
        (tmp_path, tmp_path / "none.toml", "Expected a description in .*none.toml"),
    ]
    changes: list[tuple[str, Any, str]] = [
        ("label", LabelSource("?"), "still open: label.column"),
        ("channels", {}, "still open: channels"),
        ("traces", TraceForm(), "traces.samples"),
        ("label", listed, "list.csv"),
        ("part", PartSource(path="part"), "one group"),
        ("time", Clock(("time",), ("parsec",)), "time.format"),
        ("time", Clock(("time",), ("s", "ms")), "a format for each"),
        ("time", Clock(("time",), zone="Mars/X"), "time.zone"),
        ("time", Clock(rate_hz=2e6), "1 Hz to 1 MHz"),
        ("channels", {"FZ": Channel(limit=1.0), "Weg ü": Channel()}, "one limit"),
    ]
    cases += [(tmp_path, replace(d, **{key: value}), text) for key, value, text in changes]
    for source, description, message in cases:
        with pytest.raises(DataError, match=message) as caught:
            load_dataset(source, description)
        assert str(caught.value).count("\n") <= (description is None) * 20, message


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("files = [", "Expected TOML"),
        ("version = 99", "install a newer dengine"),
        ("[txet]", "Expected 'text' in recordings.toml, got 'txet'"),
        ("[time]\ncolum = 't'", "Expected 'column' in recordings.toml, time, got 'colum'"),
        ("layout = 'log'", "Expected 'long' in recordings.toml, layout, got 'log'"),
        ("[time]\ngap = 'far'", "a number in recordings.toml, time, gap"),
        ("[time]\nrate_hz = nan", "a number in recordings.toml, time, rate_hz"),
        ("[text]\nheader = true", "a whole number"),
        ("text = 1", "text to be a table"),
        ("check = 1", "check to be a table"),
        ("version = '?'", "version 1"),
    ],
)
def test_a_damaged_description_is_refused(text: str, message: str) -> None:
    with pytest.raises(DataError, match=re.escape(message)):
        Description.from_toml(text)


def test_a_huge_or_binary_description_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "recordings.toml"
    for content, message in ((b"#" * 1_000_001, "at most 1 MB"), (b"\xff", "a description in")):
        path.write_bytes(content)
        with pytest.raises(DataError, match=message):
            load_dataset(tmp_path)


FORCE = [f"{k * 0.002:.3f},{k * k % 17}.5" for k in range(24)]


def in_files(folder: Path, header: str, name: str = "{}_{}.csv", **cells: str) -> Path:
    """Write five files, with cells behind each row, in which `{}` is the number and the label."""
    for i in range(5):
        label = WORDS[i % 2]
        path = folder / name.format(i, label)
        path.parent.mkdir(parents=True, exist_ok=True)
        behind = cells.get(label, "")
        path.write_text("\n".join([header, *(f"{row}{i}{behind}" for row in FORCE)]))
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
        ("text.delimiter", ";;", "text.delimiter"),
        ("text.header", 9, "none: 0_NOK.csv, line 9: Expected a header"),
        ("text.data", 500, "line 500: Expected rows of samples"),
        ("files", "/x/*.csv", "patterns below a folder"),
    ],
)
def test_a_stated_value_that_cannot_be_is_refused(
    tmp_path: Path, key: str, value: Any, message: str
) -> None:
    with pytest.raises(DataError, match=re.escape(message)):
        describe(in_files(tmp_path, "time,force"), {key: value})


def test_a_cell_that_is_too_long_is_a_fault(tmp_path: Path) -> None:
    in_files(tmp_path, "time,force")
    (tmp_path / "9_OK.csv").write_text("\n".join(["time,force", *FORCE, f"0.048,{'1' * 200_000}"]))
    data = load_dataset(tmp_path, describe(tmp_path))
    assert [fault.source for fault in data.faults] == ["9_OK.csv"]
    assert (data.faults[0].line, data.faults[0].column) == (26, "force")


def test_lines_of_json_under_another_suffix_are_refused_until_that_is_stated(
    tmp_path: Path,
) -> None:
    path = tmp_path / "all.json"
    values = [{"ok": i % 2 == 0, "force": [i, 2, 3 * i, 4]} for i in range(4)]
    path.write_text("\n".join(map(json.dumps, values)))
    with pytest.raises(DataError, match='state format="jsonl"'):
        describe(path)
    assert load_dataset(path, describe(path, {"format": "jsonl"})).y.tolist() == [1, 0, 1, 0]


def test_stated_checks_and_headers_are_kept(tmp_path: Path) -> None:
    folder = in_files(tmp_path, "time,force")
    check = {"path": "^(.)", "good": ["1", "3", "4"], "bad": ["0", "2"]}
    data = load_dataset(folder, describe(folder, {"check": [check], "text.header": "tim"}))
    assert data.X.shape == (4, 24)
    assert [fault.source for fault in data.faults] == ["4_NOK.csv"]


def test_a_listing_names_parts_once_and_is_no_recording(tmp_path: Path) -> None:
    written = write(tmp_path, "files text", *some(), PLAIN)
    rows = ["000,OK", "1,NOK", "2,OK", "2,NOK", "4,NOK", "9,OK"]
    (tmp_path / "part_list.csv").write_text("\n".join(["part,verdict", *rows]))
    label = replace(LABEL, listing="part_list.csv", key="part", column="verdict")
    data = load_dataset(tmp_path, replace(written.description, label=label))
    assert words(data.part) == ["0", "1", "4"]
    assert [fault.source for fault in data.faults] == ["part_2_OK.csv", "part_3_OK.csv"]
    assert "1 of 5 rows of part_list.csv name no recording: 9." in data.notes


# Descriptions.


@pytest.mark.parametrize("rate", [3.0, 700.0])
def test_a_resampled_recording_may_end_one_step_before_the_trace(
    tmp_path: Path, rate: float
) -> None:
    for n in range(3, 60, 4):
        table = pd.DataFrame({"time": np.arange(n) / rate, "FZ": np.arange(n) ** 2.0, "y": 1})
        about = {
            "format": "frame",
            "time": {"column": "time", "rate_hz": rate},
            "channels": {"FZ": "N"},
            "label": {"column": "y", "good": "1", "bad": "0"},
            "traces": {"lengths": "resample", "samples": n + 1},
        }
        data = load_dataset(table, {**about, "layout": "files"})
        np.testing.assert_allclose(data.X[0, :n], np.arange(n) ** 2.0, rtol=1e-5, atol=1e-3)


def test_a_stated_key_replaces_one_and_a_stated_source_the_others() -> None:
    d = Description(channels={"F.z": Channel("N"), "?": Channel()}, label=LabelSource("verdict"))
    stated = d.with_values({"channels.F.z.limit": 100.0, "label.path": "(OK)"})
    assert stated.channels == {"F.z": Channel("N", limit=100.0)}
    assert stated.label == LabelSource(path="(OK)")
    assert d.open_keys == ("channels",)


def of_field(about: Any) -> Any:
    """Return what a key may be."""
    default, choices = about.default, get_args(about.type)
    if get_origin(about.type) is Literal:
        return st.sampled_from(choices)
    if isinstance(default, tuple):
        return st.lists(st.text(max_size=5), max_size=3).map(tuple)
    finite = st.floats(allow_nan=False, allow_infinity=False)
    kinds: dict[type, Any] = {bool: st.booleans(), float: finite, str: st.text(max_size=5)}
    number = st.integers(-(2**53), 2**53)
    return kinds.get(type(default), st.just(1) if about.name == "version" else number)


def of_class(cls: Any) -> Any:
    """Return any instance of a section."""
    names = {f.name: of_field(f) for f in fields(cls)}
    return st.builds(cls, **names)


def of_section(name: str, cls: Any) -> Any:
    """Return what a section may be."""
    one = of_class(cls) if cls else st.text(max_size=5)
    if name == "check":
        return st.lists(one, max_size=3).map(tuple)
    named = st.dictionaries(st.text(max_size=8), one, max_size=3)
    return named if name in ("rows", "channels", "ignored") else one


NAMES = [f for f in fields(Description) if f.compare and f.name not in SECTIONS]
KEYS_ = {f.name: of_field(f) for f in NAMES}


SECTIONS_ = {name: of_section(name, cls) for name, cls in SECTIONS.items()}
NOTES = st.dictionaries(st.sampled_from(["text.names", "channels.?", "files"]), st.text())


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.builds(Description, **KEYS_, **SECTIONS_, notes=NOTES))
def test_a_description_comes_back_from_its_toml(description: Description) -> None:
    assert (
        "?" in description.channels or Description.from_toml(description.to_toml()) == description
    )


def test_two_marks_that_both_stand_twice_in_a_number_are_a_question(tmp_path: Path) -> None:
    rows = "".join(f"1.{i:03d}.000;1,{i:03d},000\n" for i in range(100, 140))
    for name in ("1_OK.csv", "2_NOK.csv"):
        (tmp_path / name).write_text(f"force;path\n{rows}", encoding="utf-8")
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
        text = "\n".join(["s;F", *rows]) + "\n"
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
