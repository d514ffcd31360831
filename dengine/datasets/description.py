"""`Description`: what recordings are, stated once in a TOML file, so that they are read exactly.

    description = describe("cell_3/")        # proposes one; ? stands where nothing proves a value
    description.save("cell_3/recordings.toml")
    data = load_dataset("cell_3/")           # reads by that file, and infers nothing

Each key is a field of a dataclass below, with one sentence on it in its metadata: the reference
page is made of these.
"""

import difflib
import json
import math
import os
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from ..errors import DataError, expect, instead, listed
from ..files import write_output

UNKNOWN = "?"
ANY = "*"  # in place of a word, any that is not named; in a column, any text
VERSION = 1
FOLDER_FILE = "recordings.toml"  # in a folder; beside a single file it is FILE.toml
MOST_BYTES = 1_000_000
MOST_LINE = 100  # characters of a line of the file with its comment
FORMATS = ("text", "json", "jsonl", "parquet", "npz", "ts", "mcap", "frame")
LAYOUTS = ("files", "long", "wide", "columns", "npz", "mcap")
LENGTHS = ("strict", "cut", "pad", "pad-all", "resample")
PLACES = ("same", "first", "last")  # of a label in a recording's rows
Words = tuple[str, ...]
TYPES: dict[type, tuple[Any, str]] = {
    float: (int | float, "a number"),
    int: (int, "a whole number"),
    bool: (bool, "true or false"),
    str: (str, "a text"),
}
Stated = Mapping[str, Any]


def setting(default: Any, doc: str, *choices: str, may_be_text: bool = False) -> Any:
    """Return a dataclass field for one key, with its sentence and what it may be."""
    about = {"doc": doc, "choices": choices, "may_be_text": may_be_text}
    return field(default=default, metadata=about)


@dataclass(frozen=True, slots=True)
class TextForm:
    """How text files are written: `[text]`."""

    encoding: str = setting("utf-8", "Encoding of the files, by a name that Python knows.")
    delimiter: str = setting(",", "Character between cells; a blank stands for any run of blanks.")
    decimal: str = setting(".", "Decimal mark of numbers.")
    thousands: str = setting("", "Mark between groups of three digits; empty: there is none.")
    header: Any = setting(
        1,
        "Line of the columns' names, 0 if there is none; or a text that this line begins with, if "
        "it stands at another line in each file.",
        may_be_text=True,
    )
    units: int = setting(0, "Line of the columns' units, 0 if there is none; counted like `data`.")
    data: int = setting(2, "Line of the first samples; counted from the header if that is a text.")
    names: Words = setting(
        (), "Names of the columns, in place of a header; a last `x*` names all that remain."
    )
    missing: Words = setting(
        (), "Words that stand for a lost sample, which is read as NaN; other words are faults."
    )
    drop: Words = setting((), "Beginnings of the lines below the header that are left out.")


@dataclass(frozen=True, slots=True)
class RowWords:
    """What the words of one column mean for their rows: `[rows.COLUMN]`. Other words are faults."""

    keep: Words = setting((), "Words of rows that are samples; `*` is any other word.")
    drop: Words = setting((), "Words of rows that are left out; `*` is any other word.")
    invalid: Words = setting((), "Words of rows whose samples are lost, and read as NaN.")


@dataclass(frozen=True, slots=True)
class Clock:
    """When the samples were taken: `[time]`."""

    column: Words = setting(
        (),
        "Column of times, or several whose times are added: a date, a time of day, milliseconds.",
    )
    format: Words = setting(
        ("s",),
        "Unit of each column (`s ms us ns min h d`, or `0.001 ms`), `iso`, or a form with percent "
        "signs like those of Python's strptime.",
    )
    zone: str = setting("", "Time zone of dates that state none, like `Europe/Berlin`; empty: UTC.")
    rate_hz: float = setting(
        0.0, "Sampling rate in hertz, which the times must agree with; 0: unknown."
    )
    wrap: float = setting(
        0.0, "Value at which a counter of times begins again at 0; 0: it never does."
    )
    gap: float = setting(1.5, "Longest step from one sample to the next, in usual steps; 0: any.")
    sort: bool = setting(
        False, "Whether the samples of a part are put in the order of their times."
    )


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel of the traces: `COLUMN = "UNIT"` in `[channels]`, or a table of these keys."""

    column: str = setting("", "Column, or a pattern of columns with `*`.")
    unit: str = setting(
        "", "Unit of the traces; samples whose own unit is stated are converted to it."
    )
    factor: float = setting(1.0, "Number by which the samples are multiplied.")
    limit: float = setting(0.0, "Range of the sensor, in the unit of the traces; 0: not known.")


@dataclass(frozen=True, slots=True)
class PartSource:
    """Where the number of a part stands: `[part]`. Without it each recording is of another part."""

    column: Words = setting((), "Column, or columns that tell the part together.")
    path: str = setting(
        "", "Regular expression, whose one group is found in the path without suffix."
    )
    line: str = setting("", "Beginning of a line above the header, in front of the part's number.")


@dataclass(frozen=True, slots=True)
class LabelSource:
    """Where the label of a part stands, and its words: `[label]`. Other words are faults."""

    column: str = setting("", "Column, or array, with the label.")
    path: str = setting(
        "", "Regular expression, whose one group is found in the path without suffix."
    )
    line: str = setting("", "Beginning of a line above the header, in front of the label.")
    topic: str = setting("", "Topic of a bag whose next message is the label.")
    listing: str = setting("", "File beside the recordings that lists the labels, in its `column`.")
    key: str = setting("", "Column of the listing with the part's number or the recording's file.")
    at: str = setting("same", "Which row has the label, if it changes within a recording.", *PLACES)
    good: Words = setting((), "Words for a good part.")
    bad: Words = setting((), "Words for a bad part.")
    unchecked: Words = setting((), "Words for a part that was not checked: it is left out.")


@dataclass(frozen=True, slots=True)
class Windows:
    """How one long recording is cut into parts: `[windows]`."""

    trigger: str = setting(
        "", "Condition that begins a part, like `register=1@/phase` or `contact=5`."
    )
    listing: str = setting("", "File beside the recordings with a row for each part.")
    key: str = setting("", "Column of the listing with the part's number.")
    start: str = setting("", "Column of the listing with the time at which the part began.")
    end: str = setting("", "Column of the listing with the time at which the part ended.")
    format: str = setting("s", "Unit or form of these times, like that of `[time]`.")


@dataclass(frozen=True, slots=True)
class TraceForm:
    """The traces that come out: `[traces]`."""

    samples: int = setting(0, "Samples of each trace.")
    lengths: str = setting(
        "strict",
        "What happens to a recording of another length. `strict`: it is a fault. `cut`: it loses "
        "its end. `pad`: like `cut`, or its last sample is repeated, up to twice its length. "
        "`pad-all`: like `pad`, at any length. `resample`: it is interpolated.",
        *LENGTHS,
    )


@dataclass(frozen=True, slots=True)
class Seen:
    """What the author of the description saw: `[seen]`. Fewer recordings are noted later."""

    recordings: int = setting(0, "Recordings that were read.")
    good: int = setting(0, "Good parts among them.")
    bad: int = setting(0, "Bad parts among them.")


@dataclass(frozen=True, slots=True)
class Description:
    """What the recordings of a folder, file or table are; `load_dataset` reads exactly by it.

    `?` stands for a value that is not known; it must be replaced before anything is read. The
    fields are the keys and sections of the TOML file, `notes` the comments in it, by key.
    """

    version: int = setting(VERSION, "Version of this form of description.")
    files: Words = setting((), "Patterns of the files, like `*.csv` or `**/*.csv`.")
    exclude: Words = setting((), "Patterns of files that are no recordings.")
    format: str = setting("text", "What kind of files they are.", *FORMATS)
    layout: str = setting(
        "files",
        "`files`: a file for each part. `long`: a row for each sample. `wide`: a row for each "
        "part. `columns`: a column for each part. `npz`: arrays with all parts. `mcap`: bags.",
        *LAYOUTS,
    )
    order: str = setting(
        "name",
        "The order in which the parts were made: `name`, by file name, with numbers by their size; "
        "`time`, by the first time of each; or the name of a column.",
    )
    text: TextForm = field(default_factory=TextForm)
    rows: Mapping[str, RowWords] = field(default_factory=dict)
    time: Clock = field(default_factory=Clock)
    channels: tuple[Channel, ...] = ()
    ignored: Mapping[str, str] = field(default_factory=dict)  # column: unit
    part: PartSource = field(default_factory=PartSource)
    label: LabelSource = field(default_factory=LabelSource)
    check: tuple[LabelSource, ...] = ()
    windows: Windows = field(default_factory=Windows)
    traces: TraceForm = field(default_factory=TraceForm)
    seen: Seen = field(default_factory=Seen)
    notes: Mapping[str, str] = field(default_factory=dict, compare=False)

    @classmethod
    def from_dict(cls, values: Stated, where: str = "description") -> "Description":
        """Return the description that nested dicts of TOML's types state.

        Raises DataError for a key that does not exist, with the nearest that does, and for a value
        of the wrong type.
        """
        version = values.get("version", VERSION)
        is_older = isinstance(version, int) and version <= VERSION
        do = "install a newer dengine"
        expect(is_older, f"version {VERSION} of {where}", version, do, DataError)
        return _made(cls, values, where)  # type: ignore[no-any-return]

    @classmethod
    def from_toml(cls, text: str, where: str = FOLDER_FILE) -> "Description":
        """Return the description that a TOML text states; raise DataError if it is damaged."""
        with instead(DataError, f"Expected TOML in {where}", ValueError, RecursionError):
            values = tomllib.loads(text)
        return cls.from_dict(values, where)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Description":
        """Read a description from a TOML file; raise DataError if it cannot be read."""
        path = Path(path)
        with instead(DataError, f"Expected a description in {path}", OSError, UnicodeDecodeError):
            size = path.stat().st_size
            expect(size <= MOST_BYTES, f"{path} of at most 1 MB", f"{size} bytes", "", DataError)
            return cls.from_toml(path.read_text("utf-8-sig"), str(path))

    def save(self, path: str | os.PathLike[str], force: bool = False) -> Path:
        """Write the TOML file, over an existing one only with `force`; return its path."""
        return write_output(path, self.to_toml().encode(), force)

    def to_dict(self) -> dict[str, Any]:
        """Return nested dicts of TOML's types, without what has its default."""
        values: dict[str, Any] = _plain(self)
        if self.channels:
            values["channels"] = {table.pop("column", ""): table for table in values["channels"]}
        return values

    def to_toml(self) -> str:
        """Return the text of the TOML file, with `notes` as comments."""
        values: dict[str, Any] = {"version": self.version, "channels": {UNKNOWN: {}}}
        values |= self.to_dict()
        only_unit = {"unit"}
        values["channels"] = {
            column: table.get("unit", "") if {*table} <= only_unit else table
            for column, table in values["channels"].items()
        }
        lines = self._lines("", values, KEYS[""])
        for name in SECTIONS:
            table = values.get(name, {})
            if name == "rows":
                for column, words in table.items():
                    lines += ["", f"[rows.{_toml_key(column)}]"]
                    lines += self._lines(f"rows.{column}.", words, KEYS["rows"])
            elif name == "check":
                for i, source in enumerate(table):
                    lines += ["", "[[check]]", *self._lines(f"check.{i}.", source, KEYS["check"])]
            else:
                names = table if name in NAMED else KEYS[name]
                body = self._lines(f"{name}.", table, names)
                lines += ["", f"[{name}]", *body] if body else []
        return "\n".join(lines) + "\n"

    def _lines(self, prefix: str, table: Stated, names: Iterable[str]) -> list[str]:
        """Return a line for each key that is stated or has a note, with the note as a comment."""
        result = []
        for name in names:
            note = self.notes.get(prefix + name, "")
            note = "".join(c if c.isprintable() else " " for c in note)
            line = f"{_toml_key(name)} = {_toml_value(table[name])}" if name in table else ""
            if not line:
                result += [f"# {name}: {note}"] if note else []
            elif note and len(line) + len(note) + 4 <= MOST_LINE:
                result.append(f"{line}  # {note}")
            else:
                result += [f"# {note}", line] if note else [line]
        return result

    @property
    def open_keys(self) -> Words:
        """The keys whose value is still `?`, like `label.column`; `channels` if there is none.

        A word `?` of a check is none of them: it fits no recording, so others are its faults.
        """
        values = {k: v for k, v in self.to_dict().items() if k not in ("ignored", "check")}
        found = tuple(name for name, value in _leaves(values) if value == UNKNOWN)
        columns = [channel.column for channel in self.channels]
        return found if columns and UNKNOWN not in columns else (*found, "channels")

    def with_values(self, stated: Stated) -> "Description":
        """Return a description in which keys, like `label.column`, have other values.

        Stating a source of labels, or of parts, clears the other sources of the same section. A
        channel that is stated replaces `?`. Raises DataError like `from_dict`.
        """
        values = self.to_dict()
        for name, value in stated.items():
            section, *path = split_key(name)
            if path and path[0] in SOURCES.get(section, ()):
                for other in SOURCES[section]:
                    if f"{section}.{other}" not in stated:
                        values.get(section, {}).pop(other, None)
            table = values
            for step in [section, *path][:-1]:
                table = table.setdefault(step, {})
                wanted = f"a section before the dot in {name}"
                expect(isinstance(table, dict), wanted, step, "", DataError)
            table[[section, *path][-1]] = value
        return replace(Description.from_dict(values), notes=self.notes)

    def with_channels(self, columns: Sequence[str]) -> "Description":
        """Return the description with those channels, or columns that it ignores, as channels.

        Raises DataError for a column that it does not name.
        """
        known = {column: Channel(column, unit) for column, unit in self.ignored.items()}
        known |= {channel.column: channel for channel in self.channels}
        for column in columns:
            wanted = f"one of the columns {listed(known)} as a channel"
            expect(column in known, wanted, column, "see [channels] and [ignored]", DataError)
        return replace(self, channels=tuple(known[column] for column in columns))


# The sections, in the order of the file, and what their tables are made of; None: texts.
SECTIONS: dict[str, Any] = {
    "text": TextForm,
    "rows": RowWords,
    "time": Clock,
    "channels": Channel,
    "ignored": None,
    "part": PartSource,
    "label": LabelSource,
    "check": LabelSource,
    "windows": Windows,
    "traces": TraceForm,
    "seen": Seen,
}
KEYS = {name: tuple(f.name for f in fields(s)) for name, s in SECTIONS.items() if s is not None}
KEYS[""] = tuple(f.name for f in fields(Description) if f.name not in ("notes", *SECTIONS))
# Keys of which one states where something stands, and the others are cleared.
SOURCES = {
    "label": ("column", "path", "line", "topic", "listing"),
    "part": ("column", "path", "line"),
}


# Sections of any columns, each with its unit or its table.
NAMED = ("channels", "ignored")


def _made(cls: Any, values: Any, where: str) -> Any:
    """Return a dataclass of nested dicts; raise DataError for an unknown key or a wrong type."""
    known = {about.name: about for about in fields(cls) if about.compare}
    for name in _table(values, where):
        if name not in known:
            raise DataError(f"Expected {_one_of(known, name)} in {where}, got {name!r}.")
    return cls(**{name: _value(known[name], v, f"{where}, {name}") for name, v in values.items()})


def _table(values: Any, where: str) -> Stated:
    """Return a table; raise DataError for something else."""
    expect(isinstance(values, Mapping), f"{where} to be a table", values, "", DataError)
    return values  # type: ignore[no-any-return]


def _value(about: Any, value: Any, where: str) -> Any:
    """Return the value of a field in its type; raise DataError for another one."""
    name, section = about.name, SECTIONS.get(about.name)
    if name not in SECTIONS:
        return _as_type(about, value, where)
    if name == "check":
        expect(isinstance(value, list), f"tables in {where}", value, "", DataError)
        return tuple(_made(section, table, where) for table in value)
    items = _table(value, where).items()
    if name == "rows":
        return {key: _made(section, table, f"{where}.{key}") for key, table in items}
    if name not in NAMED:
        return _made(section, value, where)
    tables = {key: item if isinstance(item, Mapping) else {"unit": item} for key, item in items}
    channels = [
        _made(Channel, {"column": key, **table}, f"{where}.{key}")
        for key, table in tables.items()
        if (name, key) != ("channels", UNKNOWN)
    ]
    is_ignored = name == "ignored"
    return {c.column: c.unit for c in channels} if is_ignored else tuple(channels)


def _as_type(about: Any, value: Any, where: str) -> Any:
    """Return a value in the type of the key's default; a lone text for several is one of them.

    `?` passes for every key.
    """
    default, choices = about.default, about.metadata["choices"]
    items = value if isinstance(value, list | tuple) else [value]
    if isinstance(default, tuple):
        valid = all(isinstance(item, str | int | float) for item in items)
        expect(valid, f"texts in {where}", value, "", DataError)
        return tuple(map(str, items))
    if value == UNKNOWN:
        return value
    kind, wanted = TYPES[type(default)]
    kind = int | str if about.metadata["may_be_text"] else kind
    valid = isinstance(value, kind) and isinstance(value, bool) == isinstance(default, bool)
    valid = valid and (not isinstance(value, float) or math.isfinite(value))
    expect(valid, f"{wanted} in {where}", value, "", DataError)
    if choices and value not in choices:
        raise DataError(f"Expected {_one_of(choices, value)} in {where}, got {value!r}.")
    return float(value) if isinstance(default, float) else value


def _one_of(known: Iterable[str], name: str) -> str:
    """Return the known name that is nearest, or all of them."""
    nearest = difflib.get_close_matches(name, [*known], 1)
    return f"{nearest[0]!r}" if nearest else f"one of {', '.join(known)}"


def _plain(value: Any) -> Any:
    """Return dataclasses, and what they hold, in TOML's types, without fields of their defaults."""
    if isinstance(value, Mapping):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, tuple):
        items = [*map(_plain, value)]
        return items[0] if len(items) == 1 and isinstance(items[0], str) else items
    if not is_dataclass(value) or isinstance(value, type):
        return value
    default = type(value)()
    names = [about.name for about in fields(value) if about.compare]
    values = {name: getattr(value, name) for name in names}
    return {k: _plain(v) for k, v in values.items() if v != getattr(default, k)}


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each key of nested dicts, like `label.column`, with its values."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _leaves(item, f"{name}.{key}" if name else key)
    elif isinstance(value, list):
        for item in value:
            yield from _leaves(item, name)
    else:
        yield name, value


def split_key(name: str) -> list[str]:
    """Return the parts of a key: `rows.Status of A.1.keep` -> rows, Status of A.1, keep.

    The column of a channel, or of rows, may have dots in its name.
    """
    section, _, rest = name.partition(".")
    column, _, last = rest.rpartition(".")
    if section in ("rows", "channels") and column and last in KEYS[section]:
        return [section, column, last]
    return [section, rest] if rest else [section]


def _toml_key(name: str) -> str:
    """Return a key as TOML writes it, in quotes if it needs them."""
    plain = name.isascii() and name.replace("_", "").replace("-", "").isalnum()
    return name if plain else _toml_value(name)


def _toml_value(value: Any) -> str:
    """Return a value as TOML writes it."""
    if isinstance(value, Mapping):
        pairs = (f"{_toml_key(name)} = {_toml_value(item)}" for name, item in value.items())
        return f"{{ {', '.join(pairs)} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml_value, value))}]"
    if isinstance(value, float):
        return repr(value)
    # JSON's texts and booleans are TOML's, but for DEL, which TOML wants escaped.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
