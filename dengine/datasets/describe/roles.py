"""The role of each column: of rows, of the clock, of parts, labels and channels, or ignored."""

import fnmatch
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ...errors import DataError, listed
from ..description import ANY, UNKNOWN, Channel, Description, LabelSource, RowWords
from ..read.files import natural_key
from ..read.places import LabelReader, Place, part_of
from ..read.recordings import Reader
from ..read.split import column_kinds
from ..table import Table, UnreadableError
from ..units import quantity_of, unit_in
from . import labels
from .cells import Column, Notes, Stated, Values, columns_of, counts_of
from .clock import NAME as CLOCK_NAME
from .clock import describe_clock, describe_rate, is_rising
from .layout import PART_NAME

FEW_WORDS = 12  # of a column that qualifies rows
MOST_FREQUENT = 0.9  # of the rows, if the others are of another signal
SPARSE = 0.1
STRANGE = 0.01
PART_LINE = re.compile(r"(?i)serial|barcode|dmc|part ?(no|num|id)|teilenummer|werkst.ck|serien")
QUALIFIER_NAME = re.compile(r"(?i)status|valid|quality|flag|error|state")
COUNTER_NAME = re.compile(r"(?i)(index|row|sample|n|i|punkt|point|count|nr|no|line)s?")
LOST = ("nan", "null", "none", "n/a", "na", "-", "--", "---", "#n/a", "")
FORCES = (
    re.compile(r"(?i)(^|[^a-z])f_?z(?![a-z])|(force|kraft|wrench)[^a-z]*z|force_2$"),
    re.compile(r"(?i)force|kraft|fuerza|forza|load|torque|drehmoment|thrust|effort|last\b|力|荷重"),
)
VALUE = re.compile(r"(?i)(.*\.)?_?(f\b.*|value)")
Units = Mapping[str, str]


@dataclass
class Roles:
    """Gives each column a role, one after the other; what is stated stays.

    places : where each recording stands that was looked at, by its source. names : of all files, if
    each is a recording. others : files beside them, in the folder `base`. columns : of the rows
    that are samples, as far as that is known.
    """

    description: Description
    stated: Stated
    places: Mapping[str, Place]
    names: Sequence[str]
    base: Path
    others: Sequence[str]
    notes: Notes
    columns: Mapping[str, Column] = field(default_factory=dict)

    def assign(self) -> Description:
        """Return the description with all roles."""
        self.columns = columns_of(self.tables, self.description.text)
        if UNKNOWN not in self.description.part.column:
            self.qualify_rows()
        self.put(describe_clock(self.columns, self.notes, self.description.time.column))
        self.find_part()
        self.find_label()
        self.find_channels()
        clock = self.description.time
        needed = clock.column + clock.format + self.description.part.column
        if clock.column and UNKNOWN not in needed:
            tables = [*map(self.kept_rows, self.tables)]
            self.put(describe_rate(tables, clock, self.description.text, self.notes))
        self.find_lengths()
        self.list_others()
        return replace(self.description, notes=self.notes)

    def put(self, values: Values) -> None:
        """Set keys like `time.column`, where the user did not state them."""
        values = {name: value for name, value in values.items() if name not in self.stated}
        self.description = self.description.with_values(values)

    @property
    def tables(self) -> list[Table]:
        """The table of each recording that was looked at."""
        return [place.table for place in self.places.values()]

    @property
    def is_used(self) -> Callable[[str], bool]:
        """Whether a column has a role already."""
        is_number, is_word = column_kinds(self.description)
        return lambda name: is_number(name) or is_word(name)

    def kept_rows(self, table: Table) -> Table:
        """Return the rows of a table that are samples, as far as their words are known.

        Of a column whose words are not known yet, and of which none is in most rows, the rows of
        the most frequent word are taken: it may tell signals apart.
        """
        rows = dict[str, RowWords]()
        for name, about in self.description.rows.items():
            rows[name] = about
            if UNKNOWN in about.keep:
                counts = self.columns[name].counts
                (word, n), *_ = counts.most_common(1)
                is_signal = n < MOST_FREQUENT * counts.total()
                rows[name] = RowWords((word,), (ANY,)) if is_signal else RowWords((ANY,))
        plain = replace(self.description, rows=rows, channels=())
        with suppress(DataError):
            return Reader(plain, LabelReader(LabelSource())).kept_rows(table)[0]
        return table

    def set_rows(self, rows: Mapping[str, RowWords]) -> None:
        """Set what the words of columns mean for their rows, and leave out those that are none."""
        if rows:
            self.description = replace(self.description, rows=rows)
            kept = [*map(self.kept_rows, self.tables)]
            self.columns = columns_of(kept, self.description.text)

    def qualify_rows(self) -> None:
        """Find the columns that qualify rows: few words that change within a recording.

        Where the user states some words, the others are kept, or dropped if those to keep are
        stated.
        """
        rows = dict(self.description.rows)
        for name, column in self.columns.items():
            words = tuple(sorted(column.counts))
            if name in rows:
                about = rows[name]
                named = {*about.keep, *about.drop, *about.invalid}
                rest = tuple(word for word in words if not named & {word, ANY})
                rest = rest if len(rest) <= FEW_WORDS else (ANY,)
                key = "drop" if about.keep else "keep"
                rows[name] = replace(about, **{key: getattr(about, key) + rest})
            elif self.qualifies(column):
                is_single = len(words) == 1
                rows[name] = RowWords(words if is_single else (UNKNOWN,))
                text = f"which rows are samples? {column.title}; others drop or invalid"
                text = "the only word; others will be faults" if is_single else text
                self.notes[f"rows.{name}.keep"] = text
        self.set_rows(rows)

    def qualifies(self, column: Column) -> bool:
        """Return whether the few words of a column tell which rows are samples.

        `Status` does, also if it has only one word; `TagName` does if it changes within a
        recording. Numbers do so only in a column with such a name, and labels do not.
        """
        name, words = column.name, column.counts
        is_named = QUALIFIER_NAME.search(name) is not None
        is_text = any(column.odd) and not CLOCK_NAME.search(name)
        varies = not column.fixed or (is_named and len(words) == 1)
        has_rows = all(len(cells) > 1 for cells in column.words)
        if self.is_used(name) or not ((is_named or is_text) and varies and has_rows):
            return False
        sources = [labels.with_meanings(source, words) for source in labels.in_columns([column])]
        verdicts = {word for source in sources for word in source.good + source.bad} - {UNKNOWN}
        return len(words) <= FEW_WORDS and not verdicts

    def find_part(self) -> None:
        """Find the column or line with the part's number, if exactly one has its name."""
        is_stated = any(key.startswith("part.") for key in self.stated)
        if is_stated or self.description.layout in ("long", "columns"):
            return
        named = [c for c in self.columns.values() if PART_NAME.search(c.name)]
        words = {column.name: column.fixed for column in named if not self.is_used(column.name)}
        for key in filter(PART_LINE.search, labels.line_keys(self.tables[0].above)):
            with suppress(UnreadableError):
                words[key] = [place.line_word(key) for place in self.places.values()]
        least = len(self.places) / 2
        names = [name for name, values in words.items() if len({*values} - {""}) > least]
        if len(names) == 1:
            key = "part.column" if names[0] in self.columns else "part.line"
            self.put({key: names[0]})
        elif names:
            self.notes["part.column"] = f"may be one of {listed(names)}"

    def find_label(self) -> None:
        """Find the source of the labels, and those that must agree with it."""
        label, is_used, finder = self.description.label, self.is_used, self.label_finder()
        columns = [column for name, column in self.columns.items() if not is_used(name)]
        is_stated = any(getattr(label, kind) for kind in labels.KINDS)
        sources = [label]
        if not is_stated:
            sources = finder.in_listings(self.others)
            if self.description.layout in ("files", "columns"):
                sources += labels.in_paths(place.path for place in finder.places.values())
            sources += labels.in_columns(columns) + labels.in_lines(self.tables[0].above)
        candidates = [finder.candidate(source) for source in sources]
        candidates = [candidate for candidate in candidates if candidate.words or is_stated]
        few = [column for column in columns if 1 < len({*column.fixed}) <= FEW_WORDS]
        hints = [f"{column.name} ({counts_of(column.fixed)})" for column in few]
        source, checks = labels.choose(candidates, self.notes, hints, len(finder.places))
        self.description = replace(self.description, label=source, check=tuple(checks))
        stated = {key: value for key, value in self.stated.items() if key.startswith("label.")}
        self.description = self.description.with_values(stated)

    def label_finder(self) -> labels.Labels:
        """Return what finds the sources of labels, of all files if each is a recording."""
        places = {name: Place(name, Table(name, {}, [])) for name in self.names} | {**self.places}
        parts = dict[str, str]()
        for name, place in places.items():
            with suppress(DataError):
                parts[name] = part_of(self.description.part, place)
        return labels.Labels(self.base, places, parts, self.description.text)

    def find_channels(self) -> None:
        """Choose the channel: the only column, or the only one that a rule for forces fits."""
        units = self.units()
        if not self.description.channels:
            best = [*units] if len(units) == 1 else likely_channels(units)
            name = best[0] if len(best) == 1 else UNKNOWN
            texts = [f"{n} [{unit}]" if unit else n for n, unit in units.items() if n != name]
            others = listed(texts)
            note = f"one or several of: {others}" if units else "no column has numbers that change"
            if name != UNKNOWN:
                self.description = replace(self.description, channels=(Channel(name, units[name]),))
                note = f"others: {others}" if others else ""
            self.notes |= {f"channels.{name}": note, "channels": note}
        self.find_lost()

    def find_lost(self) -> None:
        """Find the words for lost samples of the channels, and rows that have none of them."""
        rows = dict(self.description.rows)
        missing = {*self.description.text.missing}
        names = {channel.column for channel in self.description.channels} & {*self.columns}
        for name in names:
            column = self.columns[name]
            odd = {word for word in column.odd if word.lower() in LOST}
            is_sparse = column.counts[""] > SPARSE * column.counts.total()
            if is_sparse:
                rows.setdefault(name, RowWords((ANY,), ("",)))
                self.notes[f"rows.{name}.drop"] = "rows without a value are no samples of it"
            missing |= odd - ({""} if is_sparse else set())
        self.set_rows(rows)
        self.put({"text.missing": sorted(missing)} if missing else {})

    def units(self) -> dict[str, str]:
        """Return the columns that may be channels, with their units.

        Their numbers change, few of their words are none, and they are neither clocks nor counters.
        """
        is_used = self.is_used
        units = dict[str, str]()
        for name, column in self.columns.items():
            counts, odd = column.counts, column.odd
            n = counts.total()
            strange = [w for w, k in odd.items() if w.lower() not in LOST and k > STRANGE * n]
            is_clock = CLOCK_NAME.search(name) and is_rising(column)
            is_number = len(counts) - len(odd) > 1 and odd.total() <= MOST_FREQUENT * n
            is_other = is_used(name) or COUNTER_NAME.fullmatch(name) or is_clock or column.fixed
            if is_number and not strange and not is_other:
                units[name] = column.unit or unit_in(name.rstrip(ANY))
        return units

    def find_lengths(self) -> None:
        """Find how many samples the traces have, and what happens to those of other lengths."""
        names = [channel.column for channel in self.description.channels]
        columns = [self.columns[name] for name in names[:1] if name in self.columns]
        lengths = [len(words) for column in columns for words in column.words if len(words)]
        if not lengths:
            return
        usual = int(np.median(lengths))
        n_other = sum(n != usual for n in lengths)
        how = self.description.traces.lengths
        text = f"{n_other} of {len(lengths)} have other lengths, {min(lengths)} to {max(lengths)}"
        if n_other and how == "strict":
            is_common = n_other > SPARSE * len(lengths) and "traces.lengths" not in self.stated
            how = "pad" if is_common else how
            self.notes["traces.lengths"] = f"{text}; or cut, pad-all, resample, strict"
        samples = min(lengths) if how == "cut" else usual
        self.put({"traces.lengths": how, "traces.samples": samples})

    def list_others(self) -> None:
        """List the columns without a role, and the files beside the recordings."""
        description, is_used = self.description, self.is_used
        columns = {name: c for name, c in self.columns.items() if not is_used(name)}
        units = {name: unit_in(name) or column.unit for name, column in columns.items()}
        listings = {source.listing for source in (description.label, *description.check)}
        names = {*self.others} - listings
        for pattern in description.exclude:
            names -= {*fnmatch.filter(names, pattern)}
        others = sorted(names, key=natural_key)
        text = f"not read, for they are of another form: {listed(others)}"
        is_open = UNKNOWN in description.exclude
        text = f"{text}; are these recordings? State files or exclude" if is_open else text
        self.notes |= {"exclude": text} if others else {}
        exclude = [*description.exclude, *([] if is_open else others)]
        ignored = units if description.layout != "columns" else {}
        self.description = replace(description, ignored=ignored, exclude=tuple(exclude))


def likely_channels(units: Units) -> list[str]:
    """Return the columns of the first rule that any fits: a force along z, then any force.

    A column is a force by its name, or by a unit of force or torque.
    """
    by_name = [[*filter(pattern.search, units)] for pattern in FORCES]
    quantities = {name: quantity_of(unit) for name, unit in units.items()}
    by_unit = [n for n, pair in quantities.items() if pair and pair[0] in ("force", "torque")]
    rules = (*by_name, by_unit, [*filter(VALUE.fullmatch, units)])
    return next(filter(None, rules), [])
