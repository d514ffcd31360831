"""The role of each column: of rows, of the clock, of parts, labels and channels, or ignored."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from ...errors import DataError, listed
from ..description import ANY, UNKNOWN, Channel, Description, LabelSource, RowWords, split_key
from ..read.files import natural_key
from ..read.places import LabelReader, Place, part_of
from ..read.recordings import Reader
from ..table import Table
from ..units import quantity_of, unit_in
from . import labels
from .cells import NUMBER, Column, Notes, Stated, Values, columns_of
from .clock import NAME as CLOCK_NAME
from .clock import describe_clock, describe_rate, is_rising
from .layout import PART_NAME

FEW_WORDS = 12  # of a column that qualifies rows
MOST_FREQUENT = 0.9  # of the rows, if the others are of another signal
SPARSE = 0.1
PART_LINE = re.compile(r"(?i)serial|barcode|dmc|part ?(no|num|id)|teilenummer|werkst.ck|serien")
QUALIFIER_NAME = re.compile(r"(?i)status|valid|quality|flag|error|state")
COUNTER_NAME = re.compile(r"(?i)(index|row|sample|n|i|punkt|point|count|nr|no|line)s?")
LOST = ("nan", "null", "none", "n/a", "na", "-", "--", "---", "#n/a", "")
FORCES = (
    re.compile(r"(?i)(^|[^a-z])f_?z(?![a-z])|(force|kraft|wrench)[^a-z]*z|force_2$"),
    re.compile(r"(?i)force|kraft|fuerza|forza|load|torque|drehmoment|thrust|effort|last\b|力|荷重"),
)
VALUE = re.compile(r"(?i)_?f\b.*|_?value")
Units = Mapping[str, str]


@dataclass
class Roles:
    """Gives each column a role, one after the other; what is stated stays.

    places : where each recording stands that was looked at, by its source. names : of all files, if
    each is a recording. others : files beside them, in the folder `base`.
    """

    description: Description
    stated: Stated
    places: Mapping[str, Place]
    names: Sequence[str]
    base: Path
    others: Sequence[str]
    notes: Notes

    def assign(self) -> Description:
        """Return the description with all roles."""
        self.qualify_rows()
        columns = self.kept
        clock = self.description.time.column
        self.put(describe_clock(columns, self.notes, clock))
        self.find_part()
        self.find_label()
        description = self.description
        rising = [name for name, c in columns.items() if CLOCK_NAME.search(name) and is_rising(c)]
        sources = [s.column for s in (description.label, *description.check) if not s.listing]
        clock = description.time.column
        taken = {*rising, *clock, *description.part.column, *description.rows, *sources}
        units = {
            name: column.unit or unit_in(name.rstrip(ANY))
            for name, column in columns.items()
            if name not in taken and self.may_be_channel(column)
        }
        self.find_channels(units)
        self.find_rate()
        self.find_lengths()
        self.list_others(units)
        return replace(self.description, notes=self.notes)

    def put(self, values: Values) -> None:
        """Set keys like `time.column`, where the user did not state them."""
        values = {name: value for name, value in values.items() if name not in self.stated}
        self.description = self.description.with_values(values)

    @property
    def tables(self) -> list[Table]:
        """The table of each recording that was looked at."""
        return [place.table for place in self.places.values()]

    @cached_property
    def columns(self) -> dict[str, Column]:
        """The columns with all their rows."""
        return columns_of(self.tables, self.description.text)

    @property
    def kept(self) -> dict[str, Column]:
        """The columns, of the rows that are samples."""
        return columns_of([*map(self.kept_rows, self.tables)], self.description.text)

    def kept_rows(self, table: Table) -> Table:
        """Return the rows of a table that are samples, as far as their words are known.

        Of a column whose words are not known yet, and of which none is in most rows, the rows of
        the most frequent word are taken: it may tell signals apart.
        """
        rows = dict[str, RowWords]()
        for name, about in self.description.rows.items():
            if UNKNOWN not in about.keep:
                rows[name] = about
                continue
            counts = self.columns[name].counts
            (word, n), *_ = counts.most_common(1)
            if n < MOST_FREQUENT * counts.total():
                rows[name] = RowWords(keep=(word,), drop=(ANY,))
        plain = replace(self.description, rows=rows, channels=())
        with suppress(DataError):
            return Reader(plain, LabelReader(LabelSource())).kept_rows(table)[0]
        return table

    def qualify_rows(self) -> None:
        """Find the columns that qualify rows: few words that change within a recording.

        Numbers do so only in a column with the name of a qualifier, and a label does not. Where the
        user states some words, the others are kept, or dropped if those to keep are stated.
        """
        rows = dict(self.description.rows)
        stated = {split_key(key)[1] for key in self.stated if key.startswith("rows.")}
        for name, column in self.columns.items():
            words = tuple(sorted(column.counts)) if name in stated or self.qualifies(column) else ()
            if name in stated:
                about = rows[name]
                named = {*about.keep, *about.drop, *about.invalid}
                rest = tuple(w for w in words if w not in named and ANY not in named)
                key = "drop" if about.keep else "keep"
                rows[name] = replace(about, **{key: (*getattr(about, key), *rest)})
            elif len(words) == 1:
                rows[name] = RowWords(keep=words)
                self.notes[f"rows.{name}.keep"] = "the only word; others will be faults"
            elif words:
                rows[name] = RowWords(keep=(UNKNOWN,))
                counts = labels.counts_of(column.counts.elements())
                text = f"which rows are samples? {counts}; others drop or invalid"
                self.notes[f"rows.{name}.keep"] = text
        self.description = replace(self.description, rows=rows)

    def qualifies(self, column: Column) -> bool:
        """Return whether the few words of a column tell which rows are samples.

        `Status` does, also if it has only one word; `TagName` does if it changes within a
        recording.
        """
        is_named = QUALIFIER_NAME.search(column.name) is not None
        is_text = column.is_text and not column.are_numbers and not CLOCK_NAME.search(column.name)
        is_taken = column.name in (*self.description.part.column, self.description.label.column)
        if not (is_named or is_text) or is_taken or len(column.counts) > FEW_WORDS:
            return False
        has_rows = all(len(words) > 1 for words in column.words)
        varies = not column.fixed or (is_named and len(column.counts) == 1)
        sources = [labels.with_meanings(s, column.counts) for s in labels.in_columns([column])]
        return has_rows and varies and not any(source.good + source.bad for source in sources)

    def find_part(self) -> None:
        """Find the column or line with the part's number, if exactly one has its name."""
        is_stated = any(key.startswith("part.") for key in self.stated)
        if is_stated or self.description.layout in ("long", "columns"):
            return
        n = len(self.places)
        clock = self.description.time.column
        found = [
            name
            for name, column in self.columns.items()
            if PART_NAME.search(name) and name not in clock and len({*column.fixed} - {""}) > n / 2
        ]
        if len(found) > 1:
            self.notes["part.column"] = f"may be one of {listed(found)}"
        if len(found) == 1:
            self.put({"part.column": found[0]})
        keys = labels.line_keys(self.tables[0].above)
        for key in keys if not found else ():
            words = (
                self.labels.candidate(LabelSource(line=key)).words if PART_LINE.search(key) else {}
            )
            if len({*words.values()} - {""}) > n / 2:
                self.put({"part.line": key})
                return

    @property
    def labels(self) -> labels.Labels:
        """What finds the sources of labels, of all files if each is a recording."""
        places = {name: Place(name, Table(name, {}, [])) for name in self.names} | {**self.places}
        parts = dict[str, str]()
        for name, place in places.items():
            with suppress(DataError):
                parts[name] = part_of(self.description.part, place)
        return labels.Labels(self.base, places, parts, self.description.text)

    def find_label(self) -> None:
        """Find the source of the labels, and those that must agree with it."""
        own = self.description.label
        finder = self.labels
        taken = {*self.description.time.column, *self.description.part.column}
        columns = [
            c for name, c in self.columns.items() if name not in {*taken, *self.description.rows}
        ]
        is_stated = any(getattr(own, kind) for kind in labels.KINDS)
        sources = [own]
        if not is_stated:
            sources = finder.in_listings(self.others)
            if self.description.layout in ("files", "columns"):
                sources += labels.in_paths(place.path for place in finder.places.values())
            sources += labels.in_columns(columns) + labels.in_lines(self.tables[0].above)
        candidates = [finder.candidate(source) for source in sources]
        candidates = [candidate for candidate in candidates if candidate.words or is_stated]
        hints = [
            f"{column.name} ({labels.counts_of(column.fixed)})"
            for column in columns
            if 1 < len({*column.fixed}) <= FEW_WORDS
        ]
        label, checks = labels.choose(candidates, self.notes, hints, len(finder.places))
        self.description = replace(self.description, label=label, check=tuple(checks))
        stated = {key: value for key, value in self.stated.items() if key.startswith("label.")}
        self.description = self.description.with_values(stated)

    def may_be_channel(self, column: Column) -> bool:
        """Return whether a column has numbers that change, and few words that are none."""
        numbers = [word for word in column.counts if NUMBER.fullmatch(word)]
        odd = {word: n for word, n in column.counts.items() if word not in numbers}
        n = column.counts.total()
        strange = any(word.lower() not in LOST and count > 0.01 * n for word, count in odd.items())
        is_counter = COUNTER_NAME.fullmatch(column.name)
        changes = len(numbers) > 1 and not (column.fixed and len(column.words[0]) > 1)
        return changes and not strange and sum(odd.values()) <= MOST_FREQUENT * n and not is_counter

    def find_channels(self, units: Units) -> None:
        """Choose the channel: the only column, or the only one that a rule for forces fits."""
        if not self.description.channels:
            best = [*units] if len(units) == 1 else likely_channels(units)
            texts = {name: f"{name} [{unit}]" if unit else name for name, unit in units.items()}
            if len(best) == 1:
                channel = Channel(best[0], units[best[0]])
                self.description = replace(self.description, channels=(channel,))
                others = listed(text for name, text in texts.items() if name != best[0])
                self.notes |= {f"channels.{best[0]}": f"others: {others}"} if others else {}
            else:
                text = f"one or several of: {listed(texts.values())}"
                text = text if units else "no column has numbers that change"
                self.notes |= {"channels": text, f"channels.{UNKNOWN}": text}
        rows = dict(self.description.rows)
        missing = {*self.description.text.missing}
        columns = self.kept
        for name in (channel.column for channel in self.description.channels):
            counts = columns[name].counts if name in columns else Counter[str]()
            odd = {word for word in counts if word.lower() in LOST and not NUMBER.fullmatch(word)}
            if counts[""] > SPARSE * counts.total() and name not in rows:
                rows[name] = RowWords(keep=(ANY,), drop=("",))
                self.notes[f"rows.{name}.drop"] = "rows without a value are no samples of it"
                odd -= {""}
            missing |= odd
        self.description = replace(self.description, rows=rows)
        self.put({"text.missing": sorted(missing)} if missing else {})

    def find_rate(self) -> None:
        """Find the rate of the clock, and the longest step that is allowed."""
        clock, form = self.description.time, self.description.text
        if clock.column and UNKNOWN not in clock.format:
            tables = [*map(self.kept_rows, self.tables)]
            self.put(describe_rate(tables, clock, form, self.notes))

    def find_lengths(self) -> None:
        """Find how many samples the traces have, and what happens to those of other lengths."""
        channels = self.description.channels
        first = self.kept.get(channels[0].column) if channels else None
        lengths = [len(words) for words in first.words if len(words)] if first else []
        if not lengths:
            return
        usual = int(np.median(lengths))
        n_other = sum(n != usual for n in lengths)
        how = self.description.traces.lengths
        if n_other and how == "strict":
            if n_other > SPARSE * len(lengths) and "traces.lengths" not in self.stated:
                how = "pad"
                text = f"{min(lengths)} to {max(lengths)} samples; or cut, pad-all, resample"
                self.notes["traces.lengths"] = text
            else:
                text = f"{n_other} of {len(lengths)} have other lengths: faults"
                self.notes["traces.samples"] = text
        samples = min(lengths) if how == "cut" else usual
        self.put({"traces.lengths": how, "traces.samples": samples})

    def list_others(self, units: Units) -> None:
        """List the columns without a role, and the files beside the recordings."""
        description = self.description
        roles = {*description.rows, *(channel.column for channel in description.channels)}
        roles |= {*description.part.column, *description.time.column}
        sources = (description.label, *description.check)
        roles |= {source.column for source in sources if not source.listing}
        others = [name for name in self.columns if name not in roles]
        ignored = {name: units.get(name, "") for name in others if description.layout != "columns"}
        exclude = sorted({*self.others} - {source.listing for source in sources}, key=natural_key)
        if exclude:
            self.notes["exclude"] = "files of another form, which are not read"
        exclude = [*description.exclude, *exclude]
        self.description = replace(description, ignored=ignored, exclude=tuple(exclude))


def likely_channels(units: Units) -> list[str]:
    """Return the columns of the first rule that any fits: a force along z, then any force.

    A column is a force by its name, or by a unit of force or torque.
    """
    for pattern in FORCES:
        if found := [name for name in units if pattern.search(name)]:
            return found
    forces = ("force", "torque")
    found = [name for name, unit in units.items() if (quantity_of(unit) or [""])[0] in forces]
    return found or [name for name in units if VALUE.fullmatch(name)]
