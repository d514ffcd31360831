"""The role of each column: of rows, of the clock, of parts, labels and channels, or ignored."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError, listed
from ..description import ANY, UNKNOWN, Channel, Description, LabelSource, RowWords, split_key
from ..read.files import natural_key
from ..read.places import LabelReader, Place, part_of
from ..read.recordings import Reader
from ..table import Table, as_word
from ..units import bare, quantity_of, unit_in
from . import labels
from .clock import NAME as CLOCK_NAME
from .clock import describe_clock
from .text_form import NUMBER

FEW_WORDS = 6  # of a column that qualifies rows
SPARSE = 0.1
PART_NAME = re.compile(
    r"(?i)part|serial|episode|teil|werkst|barcode|dmc|trial|piece|sample_?id"
    r"|^(id|run|sn|cycle|shot|nr|no)$|_(id|run|cycle|sn|nr)$"
)
PART_LINE = re.compile(r"(?i)serial|barcode|dmc|part ?(no|num|id)|teilenummer")
QUALIFIER_NAME = re.compile(r"(?i)status|valid|quality|flag|error|state")
COUNTER_NAME = re.compile(r"(?i)(index|row|sample|n|i|punkt|point|count|nr|no|line)s?")
LOST = ("nan", "null", "none", "n/a", "na", "-", "--", "---", "#n/a", "")
FORCES = (
    re.compile(r"(?i)(^|[^a-z])f_?z(?![a-z])|(force|kraft|wrench)[^a-z]*z|force_2$"),
    re.compile(r"(?i)force|kraft|fuerza|forza|load|torque|drehmoment|thrust|effort|last\b|力|荷重"),
)
VALUE = re.compile(r"(?i)f\b.*|value")
Notes = dict[str, str]


@dataclass
class Roles:
    """Gives each column a role, one after the other; what is stated stays.

    views : the table of each recording that was looked at, by its source. paths : by which it is
    named. names : of all files, if each is a recording. others : files beside them.
    """

    description: Description
    stated: Mapping[str, Any]
    views: Mapping[str, Table]
    paths: Mapping[str, str]
    names: Sequence[str]
    base: Path
    others: Sequence[str]
    notes: Notes = field(default_factory=dict)
    odd: dict[str, list[str]] = field(default_factory=dict)

    def assign(self) -> Description:
        """Return the description with all roles."""
        self.qualify_rows()
        kept = [self.kept(table) for table in self.views.values()]
        form = self.description.text
        clock, times = describe_clock(kept, form, self.stated, self.notes)
        self.put(clock)
        self.find_part(times)
        taken = times | {*self.description.part.column, *self.description.rows}
        self.find_label(taken)
        sources = [
            one for one in (self.description.label, *self.description.check) if not one.listing
        ]
        taken |= {source.column for source in sources}
        units = {
            name: unit
            for name in self.columns
            if name not in taken and (unit := self.unit(name, kept)) is not None
        }
        self.find_channels(units)
        self.find_lengths()
        self.list_others(units, taken)
        return replace(self.description, notes=self.notes)

    @property
    def columns(self) -> list[str]:
        """The columns of the first recording."""
        return [*next(iter(self.views.values())).columns]

    def put(self, values: Mapping[str, Any]) -> None:
        """Set keys like `time.column`, where the user did not state them."""
        values = {name: value for name, value in values.items() if name not in self.stated}
        self.description = self.description.with_values(values)

    def kept(self, table: Table) -> Table:
        """Return the rows of a table that are samples, as far as their words are known."""
        rows = {
            name: about
            for name, about in self.description.rows.items()
            if UNKNOWN not in about.keep
        }
        plain = replace(self.description, rows=rows, channels=())
        try:
            return Reader(plain, LabelReader(LabelSource())).kept_rows(table)[0]
        except DataError:
            return table

    def words(self, name: str) -> list[NDArray[Any]]:
        """Return the words of a column in each recording that has it."""
        return [table.words(name) for table in self.views.values() if name in table.columns]

    def qualify_rows(self) -> None:
        """Find the columns that qualify rows: few words that change within a recording.

        Numbers do so only in a column with the name of a qualifier, and a label does not. Where the
        user states some words, the others are kept, or dropped if those to keep are stated.
        """
        rows = dict[str, RowWords]()
        stated = {tuple(split_key(key))[1] for key in self.stated if key.startswith("rows.")}
        for name in self.columns:
            is_text = any(
                table.columns[name].dtype.kind in "OU"
                for table in self.views.values()
                if name in table.columns
            )
            may_be = (is_text and not CLOCK_NAME.search(name)) or QUALIFIER_NAME.search(name)
            if name not in stated and (not may_be or name in self.description.part.column):
                continue
            words = self.words(name)
            different = sorted({str(word) for cells in words for word in cells})
            if name in stated:
                about = self.description.rows[name]
                named = {*about.keep, *about.drop, *about.invalid}
                rest = tuple(word for word in different if word not in named and ANY not in named)
                rest_key = "drop" if about.keep else "keep"
                rows[name] = replace(about, **{rest_key: (*getattr(about, rest_key), *rest)})
                continue
            changes = any(len({*cells}) > 1 for cells in words)
            are_numbers = all(NUMBER.fullmatch(word) for word in different if word)
            is_label = any(
                s.good + s.bad
                for s in (
                    labels.with_meanings(s, different)
                    for s in labels.column_sources(self.views, [name])
                )
            )
            if (
                changes
                and len(different) <= FEW_WORDS
                and not is_label
                and (not are_numbers or QUALIFIER_NAME.search(name))
            ):
                rows[name] = RowWords(keep=(UNKNOWN,))
                counts = labels.counts_of(str(word) for cells in words for word in cells)
                self.notes[f"rows.{name}.keep"] = (
                    f"which rows are samples? {counts}; others drop or invalid"
                )
        self.description = replace(self.description, rows=rows)

    def find_part(self, times: set[str]) -> None:
        """Find the column or line with the part's number, if exactly one has its name."""
        layout = self.description.layout
        if any(key.startswith("part.") for key in self.stated) or layout in ("long", "columns"):
            return
        found = []
        for name in self.columns:
            words = [{*cells} for cells in self.words(name)]
            is_one = len(words) == len(self.views) and all(len(some) == 1 for some in words)
            different = set[str]().union(*words) if is_one else set()
            is_part = PART_NAME.search(name) and name not in times and "" not in different
            if is_part and len(different) > len(words) / 2:
                found.append(name)
        if len(found) > 1:
            self.notes["part.column"] = f"may be one of {listed(found)}"
        if len(found) == 1:
            self.put({"part.column": found[0]})
        lines = {s.line: s for s in labels.line_sources([])}
        above = next(iter(self.views.values())).above
        for line in above if not found else ():
            key = re.split(r"[;:=\t,]", line.lstrip("#%* \t\"'"))[0].strip(" \"'")
            if PART_LINE.search(key) and key not in lines:
                words = self.candidate(LabelSource(line=key)).words
                if len({*words.values()}) > len(self.views) / 2:
                    self.put({"part.line": key})
                    return

    @property
    def places(self) -> dict[str, Place]:
        """The place of each recording, of all files if each is one."""
        some = {name: Place(self.paths[name], table) for name, table in self.views.items()}
        return {name: Place(name, Table(name, {}, [])) for name in self.names} | some

    def candidate(self, source: LabelSource) -> labels.Candidate:
        """Return a source of labels with its words."""
        parts = dict[str, str]()
        for name, place in self.places.items():
            try:
                parts[name] = part_of(self.description.part, place)
            except DataError:
                continue
        return labels.candidate(self.base, source, self.places, parts, self.description.text)

    def find_label(self, taken: set[str]) -> None:
        """Find the source of the labels, and those that must agree with it."""
        own = self.description.label
        is_stated = own.column or own.path or own.line or own.listing
        if is_stated:
            sources = [own]
        else:
            columns = [name for name in self.columns if name not in taken]
            parts = {name: self._part(place) for name, place in self.places.items()}
            sources = labels.listing_sources(
                self.base, self.others, self.places, parts, self.description.text
            )
            if self.description.layout in ("files", "columns"):
                sources += labels.path_sources(place.path for place in self.places.values())
            sources += labels.column_sources(self.views, columns)
            sources += labels.line_sources(next(iter(self.views.values())).above)
        candidates = [self.candidate(source) for source in sources]
        candidates = [one for one in candidates if one.words or is_stated]
        label, checks = labels.choose(candidates, self.notes, self.hints(taken), len(self.places))
        stated = {key: value for key, value in self.stated.items() if key.startswith("label.")}
        self.description = replace(self.description, label=label, check=tuple(checks))
        self.description = self.description.with_values(stated)

    def _part(self, place: Place) -> str:
        """Return the number of a part; "" if it is not stated."""
        try:
            return part_of(self.description.part, place)
        except DataError:
            return ""

    def hints(self, taken: set[str]) -> list[str]:
        """Return the columns of few words that stay the same within each recording."""
        hints = []
        for name in self.columns:
            words = [{*cells} for cells in self.words(name)] if name not in taken else []
            different = set[str]().union(*words)
            if 1 < len(different) <= FEW_WORDS and all(len(some) == 1 for some in words):
                hints.append(name)
        return hints

    def unit(self, name: str, kept: Sequence[Table]) -> str | None:
        """Return the unit of a column of numbers that change, "" if unknown; None for another."""
        odd = Counter[str]()
        n = 0
        changes = False
        for table in kept:
            cells = table.columns.get(name, np.empty(0))
            n += len(cells)
            if cells.dtype.kind in "iuf":
                values = cells[np.isfinite(cells)]
                changes |= len(values) > 1 and bool(values.min() < values.max())
            else:
                words = [as_word(cell) for cell in cells.tolist()]
                numbers = {word for word in words if NUMBER.fullmatch(word)}
                odd.update(word for word in words if word not in numbers)
                changes |= len(numbers) > 1
        strange = [
            word for word, count in odd.items() if word.lower() not in LOST and count > 0.01 * n
        ]
        if not changes or strange or odd.total() > 0.9 * n or COUNTER_NAME.fullmatch(name):
            return None
        self.odd[name] = [word for word in odd if word.lower() in LOST]
        if odd[""] > SPARSE * n:
            self.odd[name].append(ANY)
        units = Counter(bare(table.units.get(name, "")) for table in kept)
        return units.most_common(1)[0][0] or unit_in(name.rstrip(ANY))

    def find_channels(self, units: Mapping[str, str]) -> None:
        """Choose the channel: the only column, or the only one that a rule for forces fits."""
        channels = self.description.channels
        if not channels:
            best = [*units] if len(units) == 1 else likely_channels(units)
            texts = [f"{name} [{unit}]" if unit else name for name, unit in units.items()]
            if len(best) == 1:
                channels = (Channel(best[0], units[best[0]]),)
                others = [text for name, text in zip(units, texts, strict=True) if name != best[0]]
                self.notes |= {f"channels.{best[0]}": f"others: {listed(others)}"} if others else {}
            else:
                text = f"one or several of: {listed(texts)}" if units else "no column has numbers"
                self.notes |= {"channels": text, f"channels.{UNKNOWN}": text}
        self.description = replace(self.description, channels=channels)
        rows = dict(self.description.rows)
        missing = {*self.description.text.missing}
        for channel in channels:
            odd = {*self.odd.get(channel.column, [])}
            if ANY in odd and channel.column not in rows:
                rows[channel.column] = RowWords(keep=(ANY,), drop=("",))
                self.notes[f"rows.{channel.column}.drop"] = (
                    "rows without a value are no samples of it"
                )
                odd -= {""}
            missing |= odd - {ANY}
        self.description = replace(self.description, rows=rows)
        self.put({"text.missing": sorted(missing)} if missing else {})

    def find_lengths(self) -> None:
        """Find how many samples the traces have, and what happens to those of other lengths."""
        lengths = []
        if self.description.channels:
            first = self.description.channels[0].column
            for table in self.views.values():
                lengths.append(len(self.kept(table).columns.get(first, ())))
        lengths = [n for n in lengths if n]
        if not lengths:
            return
        usual = int(np.median(lengths))
        n_other = sum(n != usual for n in lengths)
        how = self.description.traces.lengths
        if (
            n_other > SPARSE * len(lengths)
            and how == "strict"
            and "traces.lengths" not in self.stated
        ):
            how = "pad"
            text = f"{min(lengths)} to {max(lengths)} samples; or cut, pad-all, resample"
            self.notes["traces.lengths"] = text
        elif n_other and how == "strict":
            self.notes["traces.samples"] = f"{n_other} of {len(lengths)} have other lengths: faults"
        samples = min(lengths) if how == "cut" else usual
        self.put({"traces.lengths": how, "traces.samples": samples})

    def list_others(self, units: Mapping[str, str], taken: set[str]) -> None:
        """List the columns without a role, and the files beside the recordings."""
        description = self.description
        roles = {*description.rows, *(channel.column for channel in description.channels)}
        roles |= {*description.part.column, *description.time.column, description.label.column}
        others = [name for name in self.columns if name not in roles]
        ignored = {name: units.get(name, "") for name in others if description.layout != "columns"}
        used = {source.listing for source in (description.label, *description.check)}
        exclude = sorted({*self.others} - used, key=natural_key)
        if exclude:
            self.notes["exclude"] = "files of another form, which are not read"
        self.description = replace(
            description, ignored=ignored, exclude=(*description.exclude, *exclude)
        )


def likely_channels(units: Mapping[str, str]) -> list[str]:
    """Return the columns of the first rule that any fits: a force along z, then any force.

    A column is a force by its name, or by a unit of force or torque.
    """
    for pattern in FORCES:
        if found := [name for name in units if pattern.search(name)]:
            return found
    forces = ("force", "torque")
    found = [name for name, unit in units.items() if (quantity_of(unit) or [""])[0] in forces]
    return found or [name for name in units if VALUE.fullmatch(name)]
