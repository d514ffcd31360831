"""`Description`: what recordings are, stated once in a TOML file, so that they are read exactly.

    description = describe("cell_3/")        # proposes one; ? stands where nothing proves a value
    description.save("cell_3/recordings.toml")
    data = load_dataset("cell_3/")           # reads by that file, and infers nothing

Each key is a field of a dataclass below, with one sentence on it in its metadata: the reference
page is made of these.
"""

import difflib
import json
import os
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from ..errors import DataError, expect, instead, listed
from ..files import write_output

UNKNOWN = "?"
VERSION = 1
FOLDER_FILE = "recordings.toml"  # in a folder; beside a single file it is FILE.toml
MOST_BYTES = 1_000_000
FORMATS = ("text", "json", "jsonl", "parquet", "npz", "ts", "mcap", "frame")
LAYOUTS = ("files", "long", "wide", "columns", "npz", "mcap")
LENGTHS = ("strict", "cut", "pad", "pad-all", "resample")
PLACES = ("same", "first", "last")  # of a label in a recording's rows
MOST_LINE = 100  # characters of a line of the file with its comment


def setting(
    default: Any, doc: str, choices: tuple[str, ...] = (), may_be_text: bool = False
) -> Any:
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
    names: tuple[str, ...] = setting(
        (), "Names of the columns, in place of a header; a last `x*` names all that remain."
    )
    missing: tuple[str, ...] = setting(
        (), "Words that stand for a lost sample, which is read as NaN; other words are faults."
    )
    drop: tuple[str, ...] = setting(
        (), "Beginnings of the lines below the header that are left out."
    )


@dataclass(frozen=True, slots=True)
class RowWords:
    """What the words of one column mean for their rows: `[rows.COLUMN]`. Other words are faults."""

    keep: tuple[str, ...] = setting((), "Words of rows that are samples; `*` is any other word.")
    drop: tuple[str, ...] = setting((), "Words of rows that are left out; `*` is any other word.")
    invalid: tuple[str, ...] = setting((), "Words of rows whose samples are lost, and read as NaN.")


@dataclass(frozen=True, slots=True)
class Clock:
    """When the samples were taken: `[time]`."""

    column: tuple[str, ...] = setting(
        (),
        "Column of times, or several whose times are added: a date, a time of day, milliseconds.",
    )
    format: tuple[str, ...] = setting(
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

    column: str
    unit: str = setting(
        "", "Unit of the traces; samples whose own unit is stated are converted to it."
    )
    factor: float = setting(1.0, "Number by which the samples are multiplied.")
    limit: float = setting(0.0, "Range of the sensor, in the unit of the traces; 0: not known.")


@dataclass(frozen=True, slots=True)
class PartSource:
    """Where the number of a part stands: `[part]`. Without it each recording is of another part."""

    column: tuple[str, ...] = setting((), "Column, or columns that tell the part together.")
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
    at: str = setting("same", "Which row has the label, if it changes within a recording.", PLACES)
    good: tuple[str, ...] = setting((), "Words for a good part.")
    bad: tuple[str, ...] = setting((), "Words for a bad part.")
    unchecked: tuple[str, ...] = setting(
        (), "Words for a part that was not checked: it is left out."
    )


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
        LENGTHS,
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
    files: tuple[str, ...] = setting((), "Patterns of the files, like `*.csv` or `**/*.csv`.")
    exclude: tuple[str, ...] = setting((), "Patterns of files that are no recordings.")
    format: str = setting("text", "What kind of files they are.", FORMATS)
    layout: str = setting(
        "files",
        "`files`: a file for each part. `long`: a row for each sample. `wide`: a row for each "
        "part. `columns`: a column for each part. `npz`: arrays with all parts. `mcap`: bags.",
        LAYOUTS,
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
    def from_dict(cls, values: Mapping[str, Any], where: str = "description") -> "Description":
        """Return the description that nested dicts of TOML's types state.

        Raises DataError for a key that does not exist, with the nearest that does, and for a value
        of the wrong type.
        """
        version = values.get("version", VERSION)
        is_known = not isinstance(version, int) or version <= VERSION
        wanted = f"{where} of version {VERSION}"
        expect(is_known, wanted, version, "install a newer dengine", DataError)
        _check_keys(values, (*TOP, *ORDER), where)
        top = {name: value for name, value in values.items() if name in TOP}
        made = _checked_fields(cls, top, where)
        for name, section in SECTIONS.items():
            table = _as_table(values.get(name, {}), f"{where}: [{name}]")
            made[name] = section(**_checked_fields(section, table, f"{where}: [{name}]"))
        rows = _as_table(values.get("rows", {}), f"{where}: [rows]")
        made["rows"] = {
            column: RowWords(**_checked_fields(RowWords, words, f"{where}: [rows.{column}]"))
            for column, words in rows.items()
        }
        channels = _as_table(values.get("channels", {}), f"{where}: [channels]")
        made["channels"] = tuple(
            _as_channel(column, about, where) for column, about in channels.items()
        )
        ignored = _as_table(values.get("ignored", {}), f"{where}: [ignored]")
        made["ignored"] = {column: str(unit) for column, unit in ignored.items()}
        check = values.get("check", [])
        expect(isinstance(check, list | tuple), f"{where}: tables [[check]]", check, "", DataError)
        made["check"] = tuple(
            LabelSource(**_checked_fields(LabelSource, table, f"{where}: [[check]]"))
            for table in check
        )
        return cls(**made)

    @classmethod
    def from_toml(cls, text: str, where: str = FOLDER_FILE) -> "Description":
        """Return the description that a TOML text states; raise DataError if it is damaged."""
        with instead(DataError, f"Expected TOML in {where}", tomllib.TOMLDecodeError):
            values = tomllib.loads(text)
        return cls.from_dict(values, where)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Description":
        """Read a description from a TOML file; raise DataError if it cannot be read."""
        path = Path(path)
        with instead(DataError, f"Expected a description in {path}", OSError, UnicodeDecodeError):
            size = path.stat().st_size
            expect(size <= MOST_BYTES, f"{path} of at most 1 MB", f"{size} bytes", "", DataError)
            text = path.read_text("utf-8")
        return cls.from_toml(text, str(path))

    def save(self, path: str | os.PathLike[str], force: bool = False) -> Path:
        """Write the TOML file, over an existing one only with `force`; return its path."""
        return write_output(path, self.to_toml().encode(), force)

    def to_dict(self) -> dict[str, Any]:
        """Return nested dicts of TOML's types, without what has its default."""
        result: dict[str, Any] = _stated(self, TOP)
        for name, section in SECTIONS.items():
            result[name] = _stated(getattr(self, name), [f.name for f in fields(section)])
        result["rows"] = {
            column: _stated(words, [f.name for f in fields(RowWords)])
            for column, words in self.rows.items()
        }
        result["channels"] = {channel.column: _unit_or_table(channel) for channel in self.channels}
        result["ignored"] = dict(self.ignored)
        names = [f.name for f in fields(LabelSource)]
        result["check"] = [_stated(source, names) for source in self.check]
        return {name: value for name, value in result.items() if value not in ({}, [])}

    def to_toml(self) -> str:
        """Return the text of the TOML file, with `notes` as comments."""
        values = self.to_dict()
        lines = [f"version = {self.version}"]
        lines += self._lines(values, TOP[1:], "")
        for name in ORDER:
            table = values.get(name, {})
            if name == "check":
                for i, source in enumerate(self.check):
                    lines += [
                        "",
                        "[[check]]",
                        *self._lines(values["check"][i], None, f"check.{i}."),
                    ]
            elif name == "rows":
                for column in table:
                    lines += ["", f"[rows.{_toml_key(column)}]"]
                    lines += self._lines(table[column], [*WORDS], f"rows.{column}.")
            elif name == "channels" and not table:
                lines += ["", "[channels]", *self._lines({UNKNOWN: ""}, None, "channels.")]
            else:
                section = self._lines(
                    table, None if name not in SECTIONS else KEYS[name], f"{name}."
                )
                lines += ["", f"[{name}]", *section] if section else []
        return "\n".join(lines) + "\n"

    def _lines(
        self, table: Mapping[str, Any], names: Sequence[str] | None, prefix: str
    ) -> list[str]:
        """Return a line for each key that is stated or has a note, with the note as a comment."""
        result = []
        for name in table if names is None else names:
            note = self.notes.get(prefix + name, "")
            if name not in table:
                result += [f"# {name}: {note}"] if note else []
                continue
            line = f"{_toml_key(name)} = {_toml_value(table[name])}"
            if note and len(line) + len(note) + 4 <= MOST_LINE:
                line = f"{line}  # {note}"
            elif note:
                result.append(f"# {note}")
            result.append(line)
        return result

    @property
    def open_keys(self) -> tuple[str, ...]:
        """The keys whose value is still `?`, like `label.column`; `channels` without any channel."""
        values = {name: table for name, table in self.to_dict().items() if name != "ignored"}
        found = tuple(name for name, value in _leaves(values) if UNKNOWN in (value, [*name][-1:]))
        return found if self.channels else (*found, "channels")

    def with_values(self, stated: Mapping[str, Any]) -> "Description":
        """Return a description in which keys, like `label.column`, have other values.

        Stating a source of labels, or of parts, clears the other sources of the same section. A
        channel that is stated replaces `?`. Raises DataError like `from_dict`.
        """
        values = self.to_dict()
        for name, value in stated.items():
            section, *path = _split_key(name)
            if path and path[0] in SOURCES.get(section, ()):
                others = {f"{section}.{other}" for other in SOURCES[section]} - {*stated}
                for other in others:
                    values.get(section, {}).pop(other.partition(".")[2], None)
            table = values
            for step in [section, *path][:-1]:
                table = table.setdefault(step, {})
                is_section = isinstance(table, dict) and step not in TOP
                expect(is_section, f"a section before the dot in {name}", step, "", DataError)
            table[[section, *path][-1]] = value
            if section == "channels" and len(path) == 1:
                table.pop(UNKNOWN, None)
        return replace(Description.from_dict(values), notes=self.notes)

    def with_channels(self, columns: Sequence[str]) -> "Description":
        """Return the description with those channels, or columns that it ignores, as channels.

        Raises DataError for a column that it does not name.
        """
        known = {channel.column: channel for channel in self.channels}
        known |= {c: Channel(c, unit) for c, unit in self.ignored.items() if c not in known}
        for column in columns:
            wanted = f"one of the columns {listed(known)} as a channel"
            expect(column in known, wanted, column, "see [channels] and [ignored]", DataError)
        return replace(self, channels=tuple(known[column] for column in columns))


SECTIONS = {
    "text": TextForm,
    "time": Clock,
    "part": PartSource,
    "label": LabelSource,
    "windows": Windows,
    "traces": TraceForm,
    "seen": Seen,
}
KEYS = {name: tuple(f.name for f in fields(section)) for name, section in SECTIONS.items()}
TOP = ("version", "files", "exclude", "format", "layout", "order")
WORDS = tuple(f.name for f in fields(RowWords))
ORDER = (
    *("text", "rows", "time", "channels", "ignored"),
    *("part", "label", "check", "windows", "traces", "seen"),
)
# Keys of which one states where something stands, and the others are cleared.
SOURCES = {
    "label": ("column", "path", "line", "topic", "listing"),
    "part": ("column", "path", "line"),
}


def _checked_fields(section: type, values: Any, where: str) -> dict[str, Any]:
    """Return the stated keys of a section with their types; raise DataError for a wrong one."""
    table = _as_table(values, where)
    known = {f.name: f for f in fields(section) if "doc" in f.metadata}
    _check_keys(table, known, where)
    return {name: _as_type(known[name], value, f"{where} {name}") for name, value in table.items()}


def _as_type(about: Any, value: Any, where: str) -> Any:
    """Return the value of a key in the type of its default; a lone text for a tuple is one of it.

    `?` passes for every key.
    """
    default = about.default
    if value == UNKNOWN:
        return (UNKNOWN,) if isinstance(default, tuple) else UNKNOWN
    kinds: dict[type, tuple[type, ...]] = {
        tuple: (list, tuple, str, int, float),
        float: (int, float),
        int: (int, str) if about.metadata["may_be_text"] else (int,),
    }
    kind = type(default)
    is_bool = isinstance(value, bool) and kind not in (bool, tuple)
    valid = isinstance(value, kinds.get(kind, (kind,))) and not is_bool
    names = {tuple: "a list of texts", float: "a number", int: "a whole number", str: "a text"}
    expect(valid, f"{where} to be {names.get(kind, 'true or false')}", value, "", DataError)
    choices = about.metadata["choices"]
    if choices and value not in choices:
        raise DataError(f"Expected {where} to be {_one_of(choices, str(value))}, got {value!r}.")
    if kind is tuple:
        return tuple(map(str, value)) if isinstance(value, list | tuple) else (str(value),)
    return float(value) if kind is float else value


def _as_table(value: Any, where: str) -> Mapping[str, Any]:
    """Return a table of TOML; raise DataError for anything else."""
    expect(isinstance(value, Mapping), f"{where} to be a table", value, "", DataError)
    return value  # type: ignore[no-any-return]


def _as_channel(column: str, about: Any, where: str) -> Channel:
    """Return the channel that a unit, or a table of its keys, states."""
    table = about if isinstance(about, Mapping) else {"unit": about}
    return Channel(column, **_checked_fields(Channel, table, f"{where}: [channels] {column}"))


def _check_keys(table: Mapping[str, Any], known: Any, where: str) -> None:
    """Raise DataError for a key that is not known, with the nearest that is."""
    for name in table:
        if name not in known:
            raise DataError(f"Expected {where}: {_one_of([*known], name)}, got {name!r}.")


def _one_of(known: Sequence[str], name: str) -> str:
    """Return the known name that is nearest, or all of them."""
    nearest = difflib.get_close_matches(name, known, 1)
    return f"{nearest[0]!r}" if nearest else f"one of {', '.join(known)}"


def _stated(section: Any, names: Sequence[str]) -> dict[str, Any]:
    """Return the fields of a section that differ from their defaults, in TOML's types."""
    defaults = {f.name: f.default for f in fields(section) if f.default is not MISSING}
    values = {name: getattr(section, name) for name in names}
    return {
        name: (list(value) if len(value) != 1 else value[0]) if isinstance(value, tuple) else value
        for name, value in values.items()
        if value != defaults[name]
    }


def _unit_or_table(channel: Channel) -> Any:
    """Return what TOML states of a channel: its unit, or a table if there is more."""
    table = _stated(channel, ("unit", "factor", "limit"))
    return table if {*table} - {"unit"} else channel.unit


def _leaves(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each key of nested dicts, like `label.column`, with its value."""
    for name, value in table.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name}.")
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            for i, item in enumerate(value):
                yield from _leaves(item, f"{prefix}{name}.{i}.")
        else:
            yield f"{prefix}{name}", value


def _split_key(name: str) -> list[str]:
    """Return the parts of a key: `rows.Status of A.1.keep` -> rows, Status of A.1, keep.

    The column of a channel, or of rows, may have dots in its name.
    """
    section, _, rest = name.partition(".")
    if section == "rows" and "." in rest:
        return [section, *rest.rsplit(".", 1)]
    if section in ("channels", "ignored"):
        column, _, last = rest.rpartition(".")
        is_key = column and last in ("unit", "factor", "limit")
        return [section, *([column, last] if is_key else [rest])]
    return [section, *rest.split(".")] if rest else [section]


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
    # JSON's numbers, booleans and texts are TOML's, but for DEL, which TOML wants escaped.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
