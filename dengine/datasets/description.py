"""`Description`: what recordings are, stated once in a TOML file, so that they are read exactly.

    description = describe("cell_3/")        # proposes one; ? stands where nothing proves a value
    description.save("cell_3/recordings.toml")
    data = load_dataset("cell_3/")           # reads by that file, and infers nothing

Each key is a field of a dataclass below, with its sentence in the docstring: the reference page is
made of these.
"""

import difflib
import re
import shlex
import sys
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, fields, replace
from pathlib import Path, PurePath
from typing import Any, Literal, get_args, get_origin

from ..errors import DataError, instead, listed, shortened
from ..files import FilePath, toml_value, write_output
from .dataset import expect_data

UNKNOWN = "?"
ANY = "*"  # in place of a word, any that is not named; in a column, any text
VERSION = 1
FOLDER_FILE = "recordings.toml"  # in a folder; beside a single file it is FILE.toml
MOST_BYTES = 1_000_000
ORDERS = {"name", "path", "time"}  # any other `order` is a column
Words = tuple[str, ...]
Strings = Sequence[str]
Stated = Mapping[str, Any]
Values = dict[str, Any]  # of keys, by name


@dataclass(frozen=True, slots=True)
class TextForm:
    """How text files are written: `[text]`.

    encoding
        Encoding of the files, by a name that Python knows.
    delimiter
        Character between cells; a blank stands for any run of blanks.
    decimal
        Decimal mark of numbers.
    thousands
        Mark between groups of three digits; empty: there is none.
    header
        Line of the columns' names, 0 if there is none; or a text that this line begins with, if it
        stands at another line in each file.
    units
        Line of the columns' units, 0 if there is none; counted like `data`.
    data
        Line of the first samples; counted from the header if that is a text.
    names
        Names of the columns, in place of a header. If the last name is like `x*`, it names all
        remaining columns.
    missing
        Words that stand for a lost sample, which is read as NaN; other words are faults.
    drop
        Beginnings of the lines below the header that are left out.
    """

    encoding: str = "utf-8"
    delimiter: str = ","
    decimal: str = "."
    thousands: str = ""
    header: int | str = 1
    units: int = 0
    data: int = 2
    names: Words = ()
    missing: Words = ()
    drop: Words = ()


@dataclass(frozen=True, slots=True)
class RowWords:
    """What the words of one column mean for their rows: `[rows]`. Other words are faults.

    keep
        Words of rows that are samples; `*` is any other word.
    drop
        Words of rows that are left out; `*` is any other word.
    invalid
        Words of rows whose samples are lost, and read as NaN.
    """

    keep: Words = ()
    drop: Words = ()
    invalid: Words = ()

    def kinds(self, words: Iterable[str]) -> list[str]:
        """Return what each word means, "keep", "drop" or "invalid"; "" if that is not stated.

        Of several meanings the first of these counts. A word that is not stated means what `*`
        does, if that is stated.
        """
        kinds = {word: k for k in ("invalid", "drop", "keep") for word in getattr(self, k)}
        return [kinds.get(word, kinds.get(ANY, "")) for word in words]


RowMeanings = Mapping[str, RowWords]  # by column


@dataclass(frozen=True, slots=True)
class Clock:
    """When the samples were taken: `[time]`.

    column
        Column of times, or several whose times are added: a date, a time of day, milliseconds.
    format
        Unit of each column (`s ms us ns min h d`, or `0.001 ms`), `iso`, or a form with percent
        signs like those of Python's strptime.
    zone
        Time zone of dates that state none, like `Europe/Berlin`; empty: UTC.
    rate_hz
        Sampling rate in hertz, which the times must agree with; 0: unknown. `lengths = "resample"`
        needs it if there is a column of times.
    wrap
        Value at which a counter of times begins again at 0; 0: it never does.
    gap
        Longest step from one sample to the next, in usual steps; 0: any.
    sort
        Whether the samples of a part are put in the order of their times.
    """

    column: Words = ()
    format: Words = ("s",)
    zone: str = ""
    rate_hz: float = 0.0
    wrap: float = 0.0
    gap: float = 1.5
    sort: bool = False


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel of the traces: `COLUMN = "UNIT"` in `[channels]`, or a table of these keys.

    The column may be a pattern of columns with `*`.

    unit
        Unit of the traces; samples are converted to it from the unit in the file's row of units or
        in the column's name.
    factor
        Number by which the samples are multiplied.
    limit
        Range of the sensor, in the unit of the traces; 0: not known.
    """

    unit: str = ""
    factor: float = 1.0
    limit: float = 0.0


def _check_path(path: str, key: str) -> None:
    """Raise DataError unless `path` is "", `?`, or a regular expression with one group.

    key : what the text is the value of, for the message.
    """
    wanted = f"a regular expression with one group in {key}"
    with instead(DataError, f"Expected {wanted}, got {shortened(path)}", re.error):
        expect_data(path in ("", UNKNOWN) or re.compile(path).groups == 1, wanted, path)


@dataclass(frozen=True, slots=True)
class PartSource:
    """Where the number of a part stands: `[part]`. Without it each recording is of another part.

    column
        Column with the part's number, or several columns that identify the part together.
    path
        Regular expression with one group, searched in the path without suffix; the text of the
        group is the value.
    line
        Beginning of a line above the header, in front of the part's number.
    """

    column: Words = ()
    path: str = ""
    line: str = ""

    def __post_init__(self) -> None:
        _check_path(self.path, "part.path")


@dataclass(frozen=True, slots=True)
class LabelSource:
    """Where the label of a part stands, and its words: `[label]`. Other words are faults.

    column
        Column, or array, with the label.
    path
        Regular expression with one group, searched in the path without suffix; the text of the
        group is the value.
    line
        Beginning of a line above the header, in front of the label, which is the rest of the line,
        up to a comma with a blank behind it.
    topic
        Topic of a bag whose messages, between the start of a part and of the next, are the label.
    listing
        File beside the recordings that lists the labels, in its `column`.
    key
        Column of the listing with the part's number or the recording's file. Capital letters do not
        count, nor, in a file, its suffix, leading zeros, and folders that only one of both has.
    at
        Which row, or message of the topic, has the label, if it changes within a recording:
        `same`, `first` or `last`.
    good
        Words for a good part.
    bad
        Words for a bad part.
    unchecked
        Words for a part that was not checked: it is left out.
    """

    column: str = ""
    path: str = ""
    line: str = ""
    topic: str = ""
    listing: str = ""
    key: str = ""
    at: Literal["same", "first", "last"] = "same"
    good: Words = ()
    bad: Words = ()
    unchecked: Words = ()

    def __post_init__(self) -> None:
        _check_path(self.path, "label.path, or path of a check")

    @property
    def meanings(self) -> dict[str, int | None]:
        """What each word means: 1 good, 0 bad, None not checked; of several, the first of these."""
        return (
            dict.fromkeys(self.unchecked) | dict.fromkeys(self.bad, 0) | dict.fromkeys(self.good, 1)
        )


@dataclass(frozen=True, slots=True)
class Windows:
    """How one long recording is cut into parts: `[windows]`.

    trigger
        Condition that begins a part, like `register=1@/phase` or `contact=5`.
    listing
        File beside the recordings with a row for each part.
    key
        Column of the listing with the part's number.
    start
        Column of the listing with the time at which the part began.
    end
        Column of the listing with the time at which the part ended.
    format
        Unit or form of these times, like that of `[time]`.
    """

    trigger: str = ""
    listing: str = ""
    key: str = ""
    start: str = ""
    end: str = ""
    format: str = "s"


@dataclass(frozen=True, slots=True)
class TraceForm:
    """The traces that come out: `[traces]`.

    samples
        Number of samples of each trace.
    lengths
        What happens to a recording of another length. `strict`: it is a fault. `cut`: a longer one
        loses its end. `pad`: like `cut`, and a shorter one repeats its last sample; a recording
        of less than half or more than twice the samples is a fault. `pad-all`: like `pad`, at any
        length. `resample`: it is interpolated.
    """

    samples: int = 0
    lengths: Literal["strict", "cut", "pad", "pad-all", "resample"] = "strict"


@dataclass(frozen=True, slots=True)
class Seen:
    """What the author of the description saw: `[seen]`. A note says if there are fewer now.

    recordings
        Recordings that were found.
    good
        Good parts among them.
    bad
        Bad parts among them.
    """

    recordings: int = 0
    good: int = 0
    bad: int = 0


@dataclass(frozen=True, slots=True)
class Description:
    """What the recordings of a folder, file or table are; `load_dataset` reads exactly by it.

    `?` stands for a value that is not known; it must be replaced before anything is read. The
    fields are the keys and sections of the TOML file, `notes` the comments in it, by key.

    version
        Version of this form of description.
    files
        Patterns of the files, like `*.csv` or `**/*.csv`.
    exclude
        Patterns, like those of `files`, of files that are no recordings.
    format
        What kind of files they are: `text`, `json`, `jsonl`, `parquet`, `npz`, `ts`, `mcap` or
        `frame`.
    layout
        `files`: a file for each part. `long`: a row for each sample. `wide`: a row for each part.
        `columns`: a column for each part. `npz`: arrays with all parts. `mcap`: bags.
    order
        The order in which the parts were made. `name`: by file name, with the numbers in it sorted
        by value, and dates like 31.12.2025 by year. `path`: folder by folder, and by name within a
        folder, apart from the words of `label.path` and of the paths of checks. `time`: by the
        first time of each recording. Or the name of a column.
    """

    version: int = VERSION
    files: Words = ()
    exclude: Words = ()
    format: Literal["text", "json", "jsonl", "parquet", "npz", "ts", "mcap", "frame"] = "text"
    layout: Literal["files", "long", "wide", "columns", "npz", "mcap"] = "files"
    order: str = "name"
    text: TextForm = TextForm()
    rows: RowMeanings = field(default_factory=dict)
    time: Clock = Clock()
    channels: Mapping[str, Channel] = field(default_factory=dict)
    ignored: Mapping[str, str] = field(default_factory=dict)  # column: unit
    part: PartSource = PartSource()
    label: LabelSource = LabelSource()
    check: tuple[LabelSource, ...] = ()
    windows: Windows = Windows()
    traces: TraceForm = TraceForm()
    seen: Seen = Seen()
    notes: Mapping[str, str] = field(default_factory=dict, compare=False)

    @classmethod
    def from_dict(cls, values: Stated, where: str = "description") -> "Description":
        """Return the description of recordings that nested dicts state, like those of a TOML file.

        Keys that are left out get their default values. Any key but `version` may have the value
        `?` (not known yet), but a section may not. A channel named `?` is left out, and so is this
        name in `[rows]` and `[ignored]`. Of a channel, a text in place of a dict is its unit. A
        single value may stand for a list of one, and a number or boolean for a text. The result has
        no `notes`. Raises DataError for an unknown key, such as `notes`, or choice (the message
        names the most similar key, or else all), for a value of the wrong type, for NaN or infinity
        in a key of floats, and for a version that is newer or no integer.

        where : what the description is called in errors.
        """
        version = values.get("version", VERSION)
        is_older = isinstance(version, int) and version <= VERSION
        expect_data(is_older, f"version {VERSION} of {where}", version, "install a newer dengine")
        return _made(cls, values, where)  # type: ignore[no-any-return]

    @classmethod
    def from_toml(cls, text: str, where: str = FOLDER_FILE) -> "Description":
        """Return the description that a TOML text states.

        Raises DataError if it is no TOML, and as `from_dict` does.
        """
        with instead(DataError, f"Expected TOML in {where}", ValueError, RecursionError):
            return cls.from_dict(tomllib.loads(text), where)

    @classmethod
    def load(cls, path: FilePath) -> "Description":
        """Read a description from a TOML file.

        Raises DataError if the file cannot be read, has more than 1 MB or is no TOML, and as
        `from_dict` does. Comments are not read; the result has no `notes`.
        """
        with instead(
            DataError, f"Expected a description in {path}", OSError, ValueError, TypeError
        ):
            path = Path(path)
            size = path.stat().st_size
            expect_data(size <= MOST_BYTES, f"{path} of at most 1 MB", f"{size} bytes")
            return cls.from_toml(path.read_text("utf-8-sig"), str(path))

    def save(self, path: FilePath, force: bool = False) -> Path:
        """Write the TOML file, over an existing one only with `force`; return its path.

        Raises OutputError if the file exists, without `force`, or cannot be written, and for a
        database, folder, link or device also with `force` (`files.check_output`).
        """
        return write_output(path, self.to_toml().encode(errors="replace"), force)

    def to_dict(self) -> Values:
        """Return nested dicts of TOML's types, without the notes and without default values.

        The channels are always there, each with its unit; if there are none, `?` stands for them.
        """
        channels = self.channels or {UNKNOWN: Channel()}
        tables = {column: {"unit": c.unit, **_plain(c)} for column, c in channels.items()}
        return {**_plain(self), "channels": tables}

    def to_toml(self) -> str:
        """Return the text of the TOML file, with `notes` as comments above their keys.

        It has the version of the format, the keys that do not have their default values, and the
        channels, for which `?` stands if there are none. A note on a whole section, like
        `channels`, is not written; a note on a key that is not there, or within a table that stands
        in one line, comes first in its section. Notes on `[[check]]` stand in each of its tables.
        """
        values = {"version": self.version, **self.to_dict()}
        lines = self._lines("", {k: v for k, v in values.items() if k not in SECTIONS})
        for name in SECTIONS:
            if name == "check":
                for source in values.get(name, ()):
                    lines += ["", "[[check]]", *self._lines("check.", source)]
            elif body := self._lines(f"{name}.", values.get(name, {})):
                lines += ["", f"[{name}]", *body]
        return "\n".join(lines) + "\n"

    def _lines(self, prefix: str, table: Stated) -> list[str]:
        """Return the lines of one section of the TOML file, without its heading.

        The note on a key stands above it. Notes on keys that the section does not have come first.
        Empty notes are left out; a control character becomes a blank.

        prefix : the name of the section with a dot, like `label.`, with which the keys of its notes
        begin; "" for the keys outside of all sections. table : the values of the section by key.
        """
        notes = {
            key.removeprefix(prefix): re.sub(r"[\x00-\x1f\x7f]", " ", note)
            for key, note in self.notes.items()
            if note and key.startswith(prefix) and (prefix or key.partition(".")[0] not in SECTIONS)
        }
        lines = [f"# {name}: {note}" for name, note in notes.items() if name not in table]
        for name, value in table.items():
            if name in notes:
                lines.append(f"# {notes[name]}")
            lines.append(f"{_toml_key(name)} = {_toml_value(value)}")
        return lines

    @property
    def labels(self) -> tuple[LabelSource, ...]:
        """The source of labels, `[label]`, and then those that must agree with it, `[[check]]`."""
        return (self.label, *self.check)

    @property
    def listings(self) -> set[str]:
        """The files that list labels or windows, as paths from the folder of the recordings.

        "." is among them if `[label]`, a `[[check]]` or `[windows]` names no such file.
        """
        return {
            PurePath(name).as_posix()  # also ./labels.csv
            for name in (self.windows.listing, *(source.listing for source in self.labels))
        }

    @property
    def is_cut(self) -> bool:
        """Whether long recordings are cut into parts, by the trigger or listing of `[windows]`."""
        return bool(self.windows.trigger or self.windows.listing)

    @property
    def open_keys(self) -> Words:
        """The keys whose value is or contains `?`, like `label.column`.

        `channels` is one of them if there is no channel. A `?` in `[ignored]` or `[[check]]` is not
        counted. In `[[check]]` it is a word that no recording has, and recordings with other words
        become faults.
        """
        values = flat({**self.to_dict(), "ignored": {}})
        keys = [key for key, value in values.items() if is_open(value)]
        return tuple(keys if self.channels else [*keys, "channels"])

    def with_values(self, stated: Stated) -> "Description":
        """Return a description in which the given keys, like `label.column`, have these values.

        The keys `column`, `path`, `line`, `topic` and `listing` (a file with a row for each
        recording or part) in `[label]` say where the label stands: stating one or more clears the
        others, but a listing keeps the `column`; likewise with `column`, `path` and `line` in
        `[part]`. Words for good and bad stay. Stating a channel replaces the channel `?`, which
        stands there while none is known. In `rows.NAME.keep`, `channels.NAME.unit` and keys like
        these (that end in drop, invalid, factor or limit) the name of a column may have dots; any
        other key is split at its first dot. A key without a dot may be a whole section, which its
        value then replaces. The notes stay. Raises DataError for an unknown key or a wrong value,
        as `from_dict` does, if what stands before the dot in a key is no section, and for a key
        like `check.column` if there is a `[[check]]` (a source that must agree with the label)
        already.
        """
        values = self.to_dict()
        for section in ("label", "part"):
            if any(f"{section}.{source}" in stated for source in SOURCES):
                for source in SOURCES:
                    if source != "column" or f"{section}.listing" not in stated:
                        values.get(section, {}).pop(source, None)
        for name, value in deepcopy(stated).items():
            of_column = OF_COLUMN.fullmatch(name)
            *steps, last = of_column.groups() if of_column else name.split(".", 1)
            table = values
            for step in steps:
                table = table.setdefault(step, {})
                expect_data(isinstance(table, dict), f"a section before the dot in {name}", step)
            table[last] = value
        return replace(Description.from_dict(values), notes=self.notes)

    def with_channels(self, columns: Sequence[str]) -> "Description":
        """Return the description with exactly these columns as channels, in this order.

        Channels are the signals that are read. Each column must be in `[channels]`, whose settings
        stay, or else in `[ignored]`, the columns without a use, which gives its unit. `[ignored]`
        stays as it is, so such a column is in both then; a channel that is not among `columns` is
        dropped. Raises DataError for any other column.
        """
        channels = {column: Channel(unit) for column, unit in self.ignored.items()}
        channels |= self.channels
        for column in columns:
            expect_one_of(channels, column, "[channels] and [ignored]")
        return replace(self, channels={column: channels[column] for column in columns})


# The sections, in the order of the file.
SECTIONS = (
    "text", "rows", "time", "channels", "ignored", "part", "label", "check", "windows", "traces",
    "seen",
)  # fmt: skip
# Keys of which one states where a label or part number stands, and the others are cleared.
SOURCES = ("column", "path", "line", "topic", "listing")
# Keys of one column, whose name may have dots in it: `rows.Status of A.1.keep`.
OF_COLUMN = re.compile(r"(rows|channels)\.(.+)\.(keep|drop|invalid|unit|factor|limit)", re.DOTALL)
KINDS: dict[Any, str] = {
    str: "a text",
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    int | str: "a whole number or a text",
}


def _made(kind: Any, value: Any, where: str) -> Any:
    """Return a value of a TOML file, converted to `kind`, the annotated type of its key.

    A table becomes a dataclass (`_made_section`) or a dict, and a list a tuple; so does a single
    value if several are expected. `?` (not known yet) may stand in place of a text, number, boolean
    or choice, and stays `?`; the key `?` of a mapping is left out. A single value in place of a
    `Channel` is its unit. Raises DataError for an unknown key or choice, and for a value of another
    type (see `_as_kind`); `where` is its name in the message.
    """
    origin = get_origin(kind)
    args = get_args(kind)
    if origin is tuple:
        items = value if isinstance(value, list | tuple) else [value]
        return tuple(_made(args[0], item, where) for item in items)
    if origin is Literal:
        if value != UNKNOWN:
            expect_one_of(args, str(value), where)
        return value
    if kind in KINDS:
        return _as_kind(kind, value, where)
    if kind is Channel and not isinstance(value, Mapping):
        value = {"unit": value}
    example = "NAME" if origin is Mapping else fields(kind)[0].name
    name = where.rpartition(", ")[2]
    expect_data(
        isinstance(value, Mapping),
        f"{where} to be a table",
        value,
        f"state keys in it, like {name}.{example}",
    )
    if origin is Mapping:
        return {
            str(name): _made(args[1], item, f"{where}.{name}")
            for name, item in value.items()
            if name != UNKNOWN
        }
    return _made_section(kind, value, where)


def _made_section(kind: Any, value: Stated, where: str) -> Any:
    """Return a table of a TOML file as the dataclass `kind`, whose fields are its keys.

    Raises DataError for an unknown key, and as `_made` does; `where` is its name in the message.
    """
    keys = {about.name: about.type for about in fields(kind) if about.compare}
    for name in value:
        expect_one_of(keys, name, where)
    return kind(**{name: _made(keys[name], value[name], f"{where}, {name}") for name in value})


def _as_kind(kind: Any, value: Any, where: str) -> Any:
    """Return a value of a TOML file in the type of its key, `kind`; `?` is returned as it is.

    The text `?` stands for a value that the user must still state. `kind` is a type in `KINDS`:
    text, whole number, number, boolean, or whole number or text. A number or boolean becomes a
    text, as Python writes it (`True`, `nan`), if only a text is expected, the text `true` or
    `false` a boolean, and a whole number becomes a float if a number is expected. Raises DataError
    for a value of another type; and, if a number is expected, for one that is not finite or too
    large for a float. `where` is the name of the key in the message.
    """
    if value == UNKNOWN:
        return value
    if kind is str and isinstance(value, int | float):
        return str(value)
    if kind is bool and value in ("true", "false"):
        return value == "true"
    wanted = float | int if kind is float else kind
    is_kind = isinstance(value, bool) == (kind is bool) and isinstance(value, wanted)
    is_finite = kind is not float or (is_kind and abs(value) <= sys.float_info.max)
    expect_data(is_kind and is_finite, f"{KINDS[kind]} in {where}", value)
    return float(value) if kind is float else value


def expect_one_of(names: Iterable[str], name: str, where: str) -> None:
    """Raise DataError if a name is not one of these; else return nothing.

    The message has the most similar of `names`, or lists all if none is similar, and says `where`.
    """
    nearest = difflib.get_close_matches(str(name), names, 1)
    wanted = repr(nearest[0]) if nearest else f"one of {listed(names)}"
    expect_data(name in names, f"{wanted} in {where}", name)


def _plain(value: Any) -> Any:
    """Return a value of a description in TOML's types.

    Texts, numbers and booleans stay, a tuple becomes a list, and a mapping a dict. A dataclass
    becomes a dict without the fields that have their default values, and without `notes`.
    """
    if isinstance(value, str | int | float):
        return value
    if isinstance(value, tuple):
        return [*map(_plain, value)]
    if isinstance(value, Mapping):
        return {name: _plain(item) for name, item in value.items()}
    names = [about.name for about in fields(value) if about.compare]
    default = type(value)()
    return {k: _plain(v) for k in names if (v := getattr(value, k)) != getattr(default, k)}


def flat(value: Stated, prefix: str = "") -> Values:
    """Return a nested mapping as one dict: `{"a": {"b": 1}}` becomes `{"a.b": 1}`.

    An empty mapping within it is left out. If two keys become equal, the later one counts.

    value : the mapping. prefix : text that is put before each key; no dot is added.
    """
    items: Values = {}
    for name, item in value.items():
        if isinstance(item, Mapping):
            items |= flat(item, f"{prefix}{name}.")
        else:
            items[f"{prefix}{name}"] = item
    return items


def is_open(value: Any) -> bool:
    """Return whether a value of a description is `?`, or a list with `?` in it."""
    return UNKNOWN in (value if isinstance(value, list | tuple) else [value])


def as_option(key: str, value: Any) -> str:
    """Return how a key is stated on the command line, as a shell takes it: `--set order=name`.

    A text is written as it is if it begins with `(`, or if it begins with a letter or `_`, has no
    quotes and is one line. Any other value is written as TOML. `--set` reads both.
    """
    is_plain = isinstance(value, str) and re.fullmatch(r"[^\W\d][^\"'\n]*|\(.*", value)
    text = value if is_plain else toml_value(value)
    return f"--set {shlex.quote(f'{key}={text}')}"


def _toml_key(name: str) -> str:
    """Return a key as TOML writes it: in quotes unless it has only letters, digits, `_` and `-`.

    The letters are those of ASCII.
    """
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _toml_value(name)


def _toml_value(value: Any) -> str:
    """Return a value of a description as TOML writes it.

    A dict is written in one line, `{ unit = "N", factor = 2.0 }`; but a dict that has only a unit
    is written as the text of the unit, `"N"`. A list of one item is written as that item.
    """
    if isinstance(value, Mapping):
        if {*value} == {"unit"}:
            return _toml_value(value["unit"])
        pairs = (f"{_toml_key(name)} = {_toml_value(item)}" for name, item in value.items())
        return f"{{ {', '.join(pairs)} }}"
    if isinstance(value, list) and len(value) == 1:
        return _toml_value(value[0])
    return toml_value(value)
