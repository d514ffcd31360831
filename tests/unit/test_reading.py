"""Recordings are read back as they were written, and damage is a named fault; the corpus of
test_recordings_corpus.py has more layouts.
"""

import gzip
import json
import re
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dengine import Dataset, Description, describe, load_dataset
from dengine.cli.options import parse_stated
from dengine.datasets.description import (
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
CHANNELS = ("FZ", "Weg ü", "M [x]")
LABEL = LabelSource("verdict", good=("OK",), bad=("NOK",))
Edit = Callable[[pd.DataFrame], pd.DataFrame]


@dataclass(frozen=True)
class Style:
    """How a test writes its recordings."""

    form: TextForm = TextForm()  # noqa: RUF009 -- it is frozen
    is_packed: bool = False
    has_clock: bool = True


@dataclass(frozen=True)
class Written:
    """Recordings as a test wrote them."""

    source: Path
    description: Description
    X: np.ndarray
    y: np.ndarray
    file: Path  # the one that has the third part
    line: int  # of its first sample in the file

    def read(self) -> Dataset:
        return load_dataset(self.source, self.description)


def text_of(table: pd.DataFrame, style: Style) -> bytes:
    """Return the content of a text file, its cells as they are or as numbers."""
    form = style.form
    marks = str.maketrans({",": form.thousands, ".": form.decimal})
    cells = table.map(lambda cell: cell if isinstance(cell, str) else f"{cell:,}".translate(marks))
    units = [["-"] * len(table.columns)] * (form.units > 0)
    above = [f"# line {i}" for i in range(1, form.header)]
    lines = [*above, *map(form.delimiter.join, [[*table], *units, *cells.to_numpy()])]
    content = ("\n".join(lines) + "\n").encode(form.encoding)
    return gzip.compress(content) if style.is_packed else content


def content_of(kind: str, table: pd.DataFrame, style: Style) -> bytes:
    """Return the content of a file with these columns."""
    if kind == "text":
        return text_of(table, style)
    if kind == "parquet":
        return table.to_parquet(index=False)
    if kind == "json":
        return json.dumps(table.to_dict("list")).encode()
    if kind == "jsonl":
        return "\n".join(map(json.dumps, table.to_dict("records"))).encode()
    file = BytesIO()
    np.savez(file, **table.to_dict("list"))
    return file.getvalue()


def one_table(layout: str, parts: list[pd.DataFrame], names: list[str]) -> pd.DataFrame:
    """Return all parts in one table: a row for each sample, or for each part."""
    if layout == "long":
        return pd.concat(parts)
    rows = []
    for part in parts:
        if layout == "files":  # lines with arrays of samples
            rows.append(part.to_dict("list") | {"part": part["part"].iloc[0]})
        else:
            samples = {f"{name}_{t}": x for name in names for t, x in enumerate(part[name])}
            rows.append(part.iloc[0][["part", "verdict"]].to_dict() | samples | {"FZ_max": 0.5})
    return pd.DataFrame(rows)


def write(
    folder: Path, layout: str, X: np.ndarray, y: np.ndarray, style: Style, edit: Edit = pd.DataFrame
) -> Written:
    """Write recordings (n, C, T) with labels (n,) in a layout, the third part edited."""
    layout, kind = layout.split()
    blank = "_" if style.form.delimiter == " " else " "
    names = [name.replace(" ", blank) for name in CHANNELS[: X.shape[1]]]
    clock = {"time": (np.arange(X.shape[2]) / RATE).round(6)} if style.has_clock else {}
    parts = []
    for i, (x, label) in enumerate(zip(X, y, strict=True)):
        about = {"part": str(i), "verdict": WORDS[label], "remark": "none"}
        parts.append(pd.DataFrame(clock | dict(zip(names, x, strict=True))).assign(**about))
    third = 2 % len(parts)
    parts[third] = edit(parts[third])
    suffix = {"text": "csv" + ".gz" * style.is_packed}.get(kind, kind)
    if layout == "files" and kind != "jsonl":
        files = [folder / f"part_{i}.{suffix}" for i in range(len(parts))]
        for file, table in zip(files, parts, strict=True):
            file.write_bytes(content_of(kind, table.drop(columns="part"), style))
        file, source, part = files[third], folder, PartSource(path=r"(\d+)")
    else:
        file = source = folder / f"all.{suffix}"
        file.write_bytes(content_of(kind, one_table(layout, parts, names), style))
        part = PartSource(("part",))
    is_wide = layout == "wide"
    description = Description(
        files=(f"*.{suffix}",),
        format=kind,
        layout=layout,
        text=style.form if kind == "text" else TextForm(),
        time=Clock(("time",), rate_hz=RATE) if style.has_clock and not is_wide else Clock(),
        channels={f"{name}_*" if is_wide else name: Channel() for name in names},
        traces=TraceForm(X.shape[2]),
        part=part,
        label=LABEL,
    )
    line = style.form.data + {"long": 2 * X.shape[2], "wide": 2}.get(layout, 0)
    return Written(source, description, X, y, file, line)


# Round trips.

TEXT_LAYOUTS = ("files text", "long text", "wide text")
TABLES = ("long parquet", "long jsonl")
LAYOUTS = (*TEXT_LAYOUTS, "files npz", "files json", "files jsonl", *TABLES)
QUICK = settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@st.composite
def styles(draw):
    """Draw a way of writing."""
    delimiter = draw(st.sampled_from(",;\t| "))
    decimal = draw(st.sampled_from([mark for mark in ".," if mark != delimiter]))
    marks = [mark for mark in ".,'" if mark not in (delimiter, decimal)]
    thousands = draw(st.sampled_from(["", *marks]))
    header, has_units = draw(st.integers(1, 4)), draw(st.booleans())
    encoding = draw(st.sampled_from(["utf-8", "utf-16", "cp1252", "utf-8-sig"]))
    lines = header, (header + 1) * has_units, header + 1 + has_units
    form = TextForm(encoding, delimiter, decimal, thousands, *lines)
    return Style(form, draw(st.booleans()), draw(st.booleans()))


@st.composite
def recordings(draw):
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
    layout, drawn, style
):
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

PLAIN, GERMAN = Style(), Style(TextForm("utf-8", ";", ",", ".", 2, 3, 4))
X = np.random.default_rng(0).normal(size=(5, 2, 20)).astype(np.float32).astype(np.float64)
y = np.array([1, 0, 1, 1, 0])


def put(cell: Any, name: str = "FZ") -> Edit:
    """Return an edit that replaces a cell."""
    return lambda table: table.assign(**{name: [*table[name][:7], cell, *table[name][8:]]})


def assert_only_fault(written: Written, lines: Sequence[int] = (), column: str = "") -> None:
    """Check that only the third part is a fault, with its file, a line among these, and its column."""
    data = written.read()
    np.testing.assert_array_equal(data.X, squeezed(np.delete(written.X, 2, axis=0)))
    assert data.faults
    for fault in data.faults:
        assert fault.source.partition(",")[0] == written.file.name
        assert not lines or fault.line in lines, fault
        assert not column or fault.column == column, fault


CELLS = ["1x", "inf", "-Infinity", "NaN", "1_000", "0x1F", "1e", "--1", "1 2", "٣", "1.04,5"]
NO_NUMBERS = [
    *product([*TEXT_LAYOUTS, "files json", "files jsonl", "long jsonl"], [*CELLS, "", "1,,2"]),
    *product([*TABLES, "files json", "files npz"], [float("inf"), -float("inf")]),
]


@pytest.mark.parametrize(("layout", "cell"), NO_NUMBERS)
def test_a_cell_that_is_no_finite_number_is_a_fault(tmp_path, layout, cell):
    written = write(tmp_path, layout, X, y, GERMAN, put(cell))
    is_wide = layout == "wide text"
    lines = [written.line + 7 * (not is_wide)] if "text" in layout else []
    assert_only_fault(written, lines, "FZ_7" if is_wide else "FZ")


ROWS = {
    "swapped": lambda table: table.iloc[np.r_[:7, 8, 7, 9:20]],
    "lost": lambda table: table.drop(7),
    "doubled": lambda table: table.iloc[np.r_[:8, 7:20]],
    "cut": lambda table: table[:-1],
    "other word": put("NOK", "verdict"),
    "unknown word": lambda table: table.assign(verdict="MAYBE"),
}


@pytest.mark.parametrize("layout", [layout for layout in LAYOUTS if layout[:4] != "wide"])
@pytest.mark.parametrize("kind", ROWS)
def test_rows_that_do_not_fit_are_a_fault(tmp_path, layout, kind):
    written = write(tmp_path, layout, X, y, PLAIN, ROWS[kind])
    lines = {"cut": [0], "unknown word": [0, written.line]}
    column = "" if kind == "cut" else "verdict" if "word" in kind else "time"
    expected = lines.get(kind, [written.line + 7, written.line + 8])
    assert_only_fault(written, expected if "text" in layout else (), column)


FILES = {  # what is replaced in a file, by what; the line and the column of its fault
    "empty": (b".*", b"", 0, ""),
    "only a header": (b"\n.*", b"", 2, ""),
    "other byte": (b"OK", b"\xd6K", 2, ""),
    "zero byte": (b"OK", b"O\0", 2, ""),
    "long cell": (b"OK", b"1" * 200_000, 2, "verdict"),
    "other delimiter": (b",", b";", 1, "time"),
    "other header": (b"FZ", b"FX", 1, "FZ"),
    "no header": (rb"\A[^\n]*\n", b"", 1, "time"),
    "only blanks": (b".+", b" \n \n", 0, ""),
    "too many cells": (rb"(\n0\.014[^\n]*)", rb"\1,1", 9, ""),
    "too few cells": (rb"(\n0\.014[^\n]*),none", rb"\1", 9, ""),
    "one cell": (rb"\n0\.014[^\n]*", b"\n0.014", 9, ""),
    "open quote": (rb"\n0\.014", b'\n"0.014', 9, ""),
}


@pytest.mark.parametrize(("old", "new", "line", "column"), FILES.values(), ids=FILES)
def test_a_damaged_file_is_a_fault_and_the_others_are_read(tmp_path, old, new, line, column):
    written = write(tmp_path, "files text", X, y, PLAIN)
    written.file.write_bytes(re.sub(b"(?s)" + old, new, written.file.read_bytes()))
    assert_only_fault(written, [line], column)


def test_a_file_without_a_part_is_a_fault(tmp_path):
    written = write(tmp_path, "long parquet", X, y, PLAIN)
    pd.read_parquet(written.file)[:0].to_parquet(tmp_path / "empty.parquet")
    data = load_dataset(tmp_path, written.description)
    assert [fault.source for fault in data.faults] == ["empty.parquet"]


@pytest.mark.parametrize("kind", ["json", "npz", "text"])
@pytest.mark.parametrize("keep", [0, 0.5, 0.99])
def test_a_cut_file_is_a_fault(tmp_path, kind, keep):
    written = write(tmp_path, f"files {kind}", X, y, Style(is_packed=True))
    content = written.file.read_bytes()
    written.file.write_bytes(content[: int(keep * len(content))])
    assert_only_fault(written)


def test_a_file_that_changes_while_it_is_read_is_a_fault(tmp_path, monkeypatch):
    written = write(tmp_path, "files text", X, y, PLAIN)
    read = Path.read_bytes

    def grow(path):
        content = read(path)
        if path == written.file:
            path.write_bytes(content + b"1")
        return content

    monkeypatch.setattr(Path, "read_bytes", grow)
    assert_only_fault(written)


@pytest.mark.parametrize("rate", [3.0, 700.0])
@pytest.mark.parametrize("n", range(3, 60, 4))
def test_a_resampled_recording_may_end_one_step_before_the_trace(rate, n):
    squares = np.arange(n) ** 2.0
    table = pd.DataFrame({"time": np.arange(n) / rate, "FZ": squares, "y": 1})
    stated = f'format=frame layout=files time.column=time time.rate_hz={rate} channels.FZ="" '
    stated += f"label.column=y label.good=1 label.bad=0 traces.samples={n + 1} "
    stated += "traces.lengths=resample"
    data = load_dataset(table, Description().with_values(parse_stated(stated.split())))
    np.testing.assert_allclose(data.X[0, :n], squares, rtol=1e-5, atol=1e-3)


# Bad input.


def test_one_sentence_says_what_to_type_if_there_are_no_recordings_or_no_description(tmp_path):
    (tmp_path / "1_OK.csv").write_text("t,F\n0,1\n")
    stated = "files=none channels.F=N label.column=y label.good=1 label.bad=0 traces.samples=3"
    other = Description().with_values(parse_stated(stated.split()))
    for source, description, message in (
        (tmp_path / "none", None, "Expected a file, a folder or"),
        (tmp_path, None, f"dengine data {tmp_path} --save"),
        (tmp_path, other, "another folder? See `dengine data"),
        (tmp_path, tmp_path / "none.toml", f"Expected a description in {tmp_path}/none.toml"),
    ):
        with pytest.raises(DataError, match=re.escape(message)):
            load_dataset(source, description)


NO_DESCRIPTION = """
files = [           Expected TOML
version = 99        install a newer dengine
txet.header = 1     Expected 'text' in .*, got 'txet'
time.colum = 't'    Expected 'column' in .*, time, got 'colum'
layout = 'log'      Expected 'long' in .*, layout, got 'log'
time.gap = 'far'    a number in .*, time, gap
time.rate_hz = nan  a number in .*, time, rate_hz
text.header = true  a whole number
text = 1            text to be a table
check = 1           check to be a table
version = '?'       version 1
\xff                a description in
"""


@pytest.mark.parametrize(
    "line", [*NO_DESCRIPTION.strip().splitlines(), f"#{' ' * 10**6}at most 1 MB"]
)
def test_a_damaged_description_is_refused(line, tmp_path):
    text, message = re.split("  +", line) if len(line) < 99 else (line, "at most 1 MB")
    (tmp_path / "recordings.toml").write_bytes(text.encode("latin-1"))
    with pytest.raises(DataError, match=message):
        load_dataset(tmp_path)


STATED = """
channels.forc=N                in the columns, got 'forc'
time.column=tmie               Expected 'time' in the columns
channels=FZ                    keys in it, like channels.NAME
rows.tmie.keep=*               in the columns, got 'tmie'
label.column=other             where [label] says they stand
label.path=(                   a regular expression with one group
part.path=part                 a regular expression with one group
check=[{path="("}]              a regular expression with one group
label.listing=x.csv            label.key
text.encoding=utf-99           text.encoding
text.encoding=undefined        text.encoding
text.encoding=a\0b             text.encoding
text.delimiter=;;              text.delimiter
text.thousands=.               two marks in text.decimal and text.thousands
text.thousands=0               two marks in text.decimal and text.thousands
time.format=["s", "ms"]        a format for each of 1 columns
time.zone=Foo/Bar              time.zone
text.header=9                  none: part_0.csv, line 9: Expected a header
text.data=500                  line 500: Expected rows of samples
files=/x/*.csv                 patterns below a folder
files=.                        patterns below a folder
"""
SAVED = """
label.column=?                 still open: label.column
channels={}                    still open: channels
traces.samples=0               traces.samples
label={listing="list.csv", key="part", column="verdict", good="OK", bad="NOK"}  list.csv
time.format=parsec             time.format
time.rate_hz=2e6               1 Hz to 1 MHz
channels={FZ={limit=1.0}, "Weg ü"=""}  one limit
part={column="part", path="(1)"}  one place each of the label
label={column="verdict", path="(1)", good="OK", bad="NOK"}  one place each of the label
label={column="verdict", good=["OK", "NOK"], bad="NOK"}  one meaning of each word
"""


@pytest.mark.parametrize("line", [*STATED.strip().splitlines(), *SAVED.strip().splitlines()])
def test_a_stated_value_that_cannot_be_is_refused(tmp_path, line):
    written = write(tmp_path, "files text", X, y, PLAIN)
    text, message = re.split("  +", line)
    stated = parse_stated([text])
    saved = written.description.with_values(stated) if line in SAVED else None
    with pytest.raises(DataError, match=re.escape(message)):
        load_dataset(tmp_path, saved or describe(tmp_path, stated))


def test_another_listing_that_is_stated_keeps_the_column():
    description = Description(label=LabelSource("verdict", listing="list.csv"))
    assert description.with_values({"label.listing": "other.csv"}).label.column == "verdict"


@QUICK
@given(*[st.text(min_size=1)] * 5)
def test_a_description_comes_back_from_its_toml(name, unit, word, pattern, note):
    description = Description(
        channels={name: Channel(unit, limit=0.1), "other": Channel()},
        label=LabelSource(word, good=(word, "1"), path=f"({re.escape(pattern)})"),
        notes={"channels.?": note, "files": note},
    )
    assert name == "?" or Description.from_toml(description.to_toml()) == description
