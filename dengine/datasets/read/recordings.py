"""Read the recordings of a folder, a file or a DataFrame, exactly as a description says.

Each layout is one function, from what a file holds to the recordings in it. A recording that does
not follow the description becomes a `Fault`; the others become a `Dataset`.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...errors import DataError, listed, shortened
from ...records import FITS
from ...traces import can_fit_length, fit_length
from ..checks import without_repeats
from ..dataset import Dataset, Fault
from ..description import Channel, Description
from ..table import ANY, Recording, Table, UnreadableError
from ..units import conversion
from . import bags, frames, windows
from .clock import check_steps, times_of
from .files import find_files, natural_key, read_file
from .places import LabelReader, Listing, Place, joined, part_of, read_listing
from .text import read_text

Found = Iterator[Recording | Fault]
Progress = Callable[[int], None]
FRAME = "table"  # what a DataFrame is called in messages


@dataclass
class Reader:
    """Reads recordings by one description.

    Parameters
    ----------
    description : Description
    label, checks : LabelReader, sequence of LabelReader
        Of its source of labels, and of those that must agree with it.
    """

    description: Description
    label: LabelReader
    checks: Sequence[LabelReader] = ()
    matchers: Sequence[re.Pattern[str]] = field(init=False)

    def __post_init__(self) -> None:
        self.matchers = [_matcher(channel.column) for channel in self.description.channels]

    # What a file holds.

    def tables(self, content: bytes, name: str) -> list[Table]:
        """Return the tables of a file: of JSON and `.ts` files one for each object or series."""
        form = self.description.format
        text = self.description.text
        if form in ("json", "jsonl"):
            return frames.read_objects(content, name, text)
        if form == "ts":
            return frames.read_ts(content, name, text)
        if form == "parquet":
            return [frames.read_parquet(content, name)]
        if form == "npz":
            return [frames.read_npz(content, name)]
        return [read_text(content, name, text, self.is_numeric, self.word_columns.__contains__)]

    def is_numeric(self, column: str) -> bool:
        """Return whether a column of a text file holds numbers: of a channel or a numeric clock."""
        description = self.description
        clock = dict(zip(description.time.column, description.time.format, strict=False))
        if column in clock:
            return clock[column] != "iso" and "%" not in clock[column]
        return any(matcher.fullmatch(column) for matcher in self.matchers)

    @property
    def word_columns(self) -> set[str]:
        """The columns whose cells are words: of labels, parts, rows, the order and dated clocks."""
        description = self.description
        sources = (description.label, *description.check)
        columns = {source.column for source in sources if not source.listing}
        columns |= {*description.part.column, *description.rows}
        columns |= {description.order} - {"name", "time"}
        dated = zip(description.time.column, description.time.format, strict=False)
        columns |= {column for column, form in dated if form == "iso" or "%" in form}
        return columns - {""}

    # One recording.

    def recording(self, table: Table, path: str, source: str) -> Recording:
        """Return the recording of a table that holds one part.

        Raises UnreadableError if it does not follow the description.
        """
        description = self.description
        table, lost = self.kept_rows(table)
        rows = [self.channel(table, channel) for channel in description.channels]
        if len({len(row) for row in rows}) > 1:
            lengths = zip((channel.column for channel in description.channels), rows, strict=True)
            text = ", ".join(f"{column} has {len(row)}" for column, row in lengths)
            raise UnreadableError(f"Expected channels of one length, {text} samples")
        samples = np.stack(rows)
        if lost is not None:
            samples[:, lost] = np.nan
        seconds, start = None, np.nan
        if description.time.column:
            seconds, start = times_of(table, description.time, description.text)
            if len(seconds) != samples.shape[1]:
                message = f"Expected a time for each of {samples.shape[1]} samples"
                raise UnreadableError(f"{message}, got {len(seconds)}")
        lines = table.lines if len(table.lines) == samples.shape[1] else ()
        recording = Recording(source, samples, seconds, start, lines=lines)
        if description.time.sort and seconds is not None:
            self.sort(recording)
        place = Place(path, table)
        self.name(recording, place)
        return recording

    def name(self, recording: Recording, place: Place, word: str | None = None) -> None:
        """Set the part, the label and the word for the order of a recording.

        Raises UnreadableError if one is missing, or the sources of its label disagree.
        """
        description = self.description
        if not recording.part:
            recording.part = part_of(description.part, place)
        recording.label = self.label.label(place, recording.part, word)
        for other in self.checks:
            label = other.label(place, recording.part)
            if label != recording.label:
                words = {1: "good", 0: "bad", None: "not checked"}
                message = f"Expected labels that agree, {title_of(self.label.source)} says "
                message += f"{words[recording.label]}, {title_of(other.source)} {words[label]}"
                raise UnreadableError(message, column=other.source.column)
        if description.order not in ("name", "time"):
            recording.order = place.table.one_word(description.order, "first")

    def channel(self, table: Table, channel: Channel) -> NDArray[np.float64]:
        """Return the samples of a channel in its unit, shape (n,)."""
        values = table.numbers(channel.column, self.description.text)
        return values * self.factor(table, channel, channel.column)

    def factor(self, table: Table, channel: Channel, column: str) -> float:
        """Return what the samples of a column are multiplied by."""
        unit = table.units.get(column, "")
        try:
            return channel.factor * conversion(unit, channel.unit)
        except DataError as error:
            units = self.description.text.units
            raise UnreadableError(str(error), units or 0, column) from error

    def kept_rows(self, table: Table) -> tuple[Table, NDArray[np.bool_] | None]:
        """Return the rows that are samples, and which of them are lost.

        Raises UnreadableError for a word of `[rows]` whose meaning is not stated.
        """
        lost = None
        for column, about in self.description.rows.items():
            words = table.words(column)
            known = {*about.keep, *about.drop, *about.invalid}
            if ANY not in known:
                other = np.flatnonzero(~np.isin(words, [*known]))
                if len(other):
                    i = int(other[0])
                    message = f"Expected one of the words {listed(sorted(known))}"
                    raise UnreadableError(f"{message}, got {words[i]!r}", table.line(i), column)
            is_lost = _is_among(words, about.invalid, known)
            keep = ~_is_among(words, about.drop, known)
            lost = is_lost if lost is None else lost | is_lost
            table, lost = table.take(keep), lost[keep]
        return table, lost

    def sort(self, recording: Recording) -> None:
        """Put the samples of a recording in the order of their times, in place."""
        seconds = recording.seconds
        assert seconds is not None
        order = np.argsort(seconds, kind="stable")
        if len(recording.lines):
            recording.lines = np.asarray(recording.lines)[order].tolist()
        recording.start += float(seconds[order[0]])
        recording.seconds = seconds[order] - seconds[order[0]]
        recording.samples = recording.samples[:, order]

    # The layouts.

    def from_objects(self, tables: Sequence[Table], name: str) -> Found:
        """Yield the recording of each table."""
        for i, table in enumerate(tables, 1):
            line = table.line(0) if len(table.lines) == 1 else 0
            source = f"{name}, row {line or i}" if len(tables) > 1 else name
            yield from self.attempt(lambda t=table, s=source: self.recording(t, name, s), source)

    def from_long(self, table: Table, name: str) -> Found:
        """Yield the recordings of a table with a row for each sample.

        The rows of a part must stand together, unless they are sorted by their times.
        """
        import pandas as pd

        description = self.description
        columns = description.part.column
        if not columns:
            raise DataError("Expected part.column, the column that tells the parts apart.")
        table, lost = self.kept_rows(table)
        words = [table.words(column) for column in columns]
        keys = words[0] if len(words) == 1 else pd.MultiIndex.from_arrays(words)
        codes, _ = pd.factorize(keys)
        order = np.argsort(codes, kind="stable")
        bounds = np.flatnonzero(np.diff(codes[order], prepend=-1, append=codes.max() + 1))
        plain = Reader(replace(description, rows={}), self.label, self.checks)
        for begin, end in zip(bounds[:-1], bounds[1:], strict=True):
            rows = order[begin:end]
            is_together = rows[-1] - rows[0] == len(rows) - 1
            part = " ".join(str(word[rows[0]]) for word in words)
            source = f"{name}, {part}"
            if not is_together and not description.time.sort:
                gap = int(np.argmax(np.diff(rows) > 1)) + 1
                message = "Expected the rows of a part together; it comes again behind another one"
                yield Fault(source, table.line(int(rows[gap])), message, columns[0])
                continue
            chosen = table.take(slice(rows[0], rows[-1] + 1) if is_together else rows)

            def read(chosen: Table = chosen, rows: Any = rows, source: str = source) -> Recording:
                recording = plain.recording(chosen, name, source)
                if lost is not None:
                    recording.samples[:, lost[rows]] = np.nan
                return recording

            yield from self.attempt(read, source)

    def from_wide(self, table: Table, name: str) -> Found:
        """Yield the recordings of a table with a row for each part.

        The samples of a channel are lists in its cells, or the cells of the columns that its
        pattern with `*` matches, in the order of their numbers. Cells at the end of a row that are
        empty are no samples.
        """
        channels = self.description.channels
        if not any(ANY in channel.column for channel in channels):
            yield from self.from_objects([*frames.rows_of(table)], name)
            return
        cube = []
        for channel, matcher in zip(channels, self.matchers, strict=True):
            columns = [column for column in table.columns if matcher.fullmatch(column)]
            columns.sort(key=natural_key)
            if not columns:
                raise UnreadableError(f"Expected columns {channel.column}", column=channel.column)
            form = self.description.text
            cells = [table.numbers(c, form) * self.factor(table, channel, c) for c in columns]
            cube.append(np.stack(cells, axis=1))
        for i in range(len(table.lines)):
            row = table.take(slice(i, i + 1))
            source = f"{name}, row {table.line(i)}"

            def read(row: Table = row, i: int = i, source: str = source) -> Recording:
                rows = [without_empty_end(cells[i]) for cells in cube]
                if len({*map(len, rows)}) > 1:
                    raise UnreadableError("Expected channels of one length in this row")
                recording = Recording(source, np.stack(rows), lines=[row.line(0)])
                self.name(recording, Place(name, row))
                return recording

            yield from self.attempt(read, source)

    def from_columns(self, table: Table, name: str) -> Found:
        """Yield the recordings of a table with a column for each part, by the column's name.

        Cells at the end of a column that are empty are no samples.
        """
        (channel,) = self.description.channels
        clock = {*self.description.time.column}
        for column in table.columns:
            if column in clock or not self.matchers[0].fullmatch(column):
                continue

            def read(column: str = column) -> Recording:
                values = table.numbers(column, self.description.text)
                values = without_empty_end(values * self.factor(table, channel, column))
                part = table.take(slice(0, len(values)))
                seconds, start = None, np.nan
                if clock:
                    seconds, start = times_of(part, self.description.time, self.description.text)
                found = Recording(column, values[None], seconds, start, lines=part.lines)
                self.name(found, Place(column, part))
                return found

            yield from self.attempt(read, f"{name}, column {column}")

    def from_npz(self, content: bytes, name: str) -> Found:
        """Yield the recordings of an archive whose arrays hold all parts along their first axis."""
        arrays, _ = frames.read_archive(content, name=name)
        first = self.description.channels[0].column
        stem = first if first in arrays else first.rpartition(".")[0]
        if stem not in arrays:
            raise UnreadableError(f"Expected an array {first}, got {listed(arrays)}", column=first)
        n = len(np.atleast_1d(arrays[stem]))
        yield from self.from_objects(frames.part_tables(arrays, n, name), name)

    def from_file(self, path: Path, name: str) -> Found:
        """Yield the recordings of a file, and its faults."""
        description = self.description
        try:
            content = read_file(path)
            if description.layout == "npz":
                yield from self.from_npz(content, name)
                return
            yield from self.from_tables(self.tables(content, name), name)
        except (UnreadableError, DataError) as error:
            yield fault_of(error, name)

    def from_tables(self, tables: Sequence[Table], name: str) -> Found:
        """Yield the recordings of the tables of one file."""
        description = self.description
        if description.windows.trigger or description.windows.listing:
            yield from windows.cut_table(self, joined_if_several(tables, name), name)
        elif description.layout == "files" or (len(tables) > 1 and description.layout == "wide"):
            yield from self.from_objects(tables, name)
        elif description.layout == "long":
            yield from self.from_long(joined_if_several(tables, name), name)
        elif description.layout == "wide":
            yield from self.from_wide(tables[0], name)
        else:
            yield from self.from_columns(tables[0], name)

    def attempt(self, read: Callable[[], Recording], source: str) -> Found:
        """Yield the recording that `read` returns, or the fault that it raises."""
        try:
            yield read()
        except UnreadableError as error:
            yield fault_of(error, source)


def title_of(source: Any) -> str:
    """Return what a source of labels is called in messages."""
    for kind in ("listing", "column", "path", "line", "topic"):
        if value := getattr(source, kind):
            return f"the {kind} {shortened(value)}"
    return "no source"


def fault_of(error: DataError, source: str) -> Fault:
    """Return the fault of an error."""
    line = getattr(error, "line", 0)
    return Fault(source, line, str(error).rstrip("."), getattr(error, "column", ""))


def joined_if_several(tables: Sequence[Table], name: str) -> Table:
    """Return the only table, or one table of many with a row each."""
    return tables[0] if len(tables) == 1 else joined(tables, name)


def without_empty_end(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return values (n,) without those at the end that are NaN."""
    filled = np.flatnonzero(~np.isnan(values))
    return values[: filled[-1] + 1] if len(filled) else values[:0]


def _matcher(column: str) -> re.Pattern[str]:
    """Return the pattern of a channel's columns, in which `*` stands for any text."""
    return re.compile(".*".join(map(re.escape, column.split(ANY))))


def _is_among(words: NDArray[Any], some: Sequence[str], known: Iterable[str]) -> NDArray[np.bool_]:
    """Return which words are among some, where `*` stands for all that are not known."""
    result = np.isin(words, [*some])
    return result | ~np.isin(words, [*known]) if ANY in some else result


# From recordings to a data set.


def read_recordings(
    source: Any, description: Description, progress: Progress | None = None
) -> Dataset:
    """Read recordings exactly as a description says.

    Parameters
    ----------
    source : Path or DataFrame
        A folder, a file or a table.
    description : Description
    progress : callable, optional
        Called with 1 after each file.

    Returns
    -------
    Dataset
        What does not follow the description is one of its `faults`.

    Raises
    ------
    DataError
        If a key is still open, no file is found, a listing cannot be read, or no recording is left.
    """
    open_keys = description.open_keys
    if open_keys:
        raise DataError(f"Expected a description without ?, still open: {listed(open_keys)}.")
    is_path = isinstance(source, Path)
    base = (source if source.is_dir() else source.parent) if is_path else Path()
    sources = (description.label, *description.check)
    readers = [LabelReader(s, _listing_of(s, base, description), set()) for s in sources]
    reader = Reader(description, readers[0], readers[1:])
    found: list[Recording | Fault] = []
    notes: list[str] = []
    if not is_path:
        found += reader.from_tables([frames.read_frame(source, FRAME)], FRAME)
    elif description.layout == "mcap":
        found += bags.read_bag(reader, find_files(source, description), base, notes)
    else:
        for path, name in find_files(source, description):
            found += reader.from_file(path, name)
            if progress is not None:
                progress(1)
    for other in readers:
        if other.listing is not None and (unused := [*set(other.listing.rows) - other.used]):
            n = f"{len(unused)} of {len(other.listing.rows)}"
            names = listed(sorted(unused, key=natural_key))
            notes.append(f"{n} rows of {other.listing.name} name no recording: {names}.")
    name = FRAME if not is_path else source.name if source.is_dir() else source.stem
    return to_dataset(found, description, name, notes)


def _listing_of(source: Any, base: Path, description: Description) -> Listing | None:
    """Return the listing of a source of labels; None if it has none."""
    if not source.listing:
        return None
    if not source.key or not source.column:
        raise DataError("Expected label.key and label.column, two columns of label.listing.")
    return read_listing(base, source.listing, source.key, [source.column], description.text)


def to_dataset(
    found: Iterable[Recording | Fault], description: Description, name: str, notes: list[str]
) -> Dataset:
    """Return the data set of recordings, in the order in which they were made.

    Raises DataError if none is left.
    """
    faults = [item for item in found if isinstance(item, Fault)]
    recordings = [item for item in found if isinstance(item, Recording)]
    n_unlabelled = sum(recording.label is None for recording in recordings)
    fitted: list[tuple[Recording, NDArray[np.float32]]] = []
    for recording in recordings:
        try:
            check_steps(recording, description.time)
            if recording.label is not None:
                fitted.append((recording, fit(recording, description)))
        except UnreadableError as error:
            faults.append(fault_of(error, recording.source))
    if description.order == "time":
        fitted.sort(key=lambda item: item[0].start)
    elif description.order != "name":
        fitted.sort(key=lambda item: natural_key(item[0].order))
    fitted, repeats = without_repeats(fitted)
    faults += repeats
    if not fitted:
        why = f" {faults[0]}." if faults else ""
        n = f"{len(faults)} have faults, {n_unlabelled} no label"
        raise DataError(f"Expected recordings in {name}, none is left: {n}.{why}")
    notes += _seen_notes(description, len(fitted) + len(faults) + n_unlabelled, faults)
    traces = np.stack([trace for _, trace in fitted])
    labels = np.array([recording.label for recording, _ in fitted], dtype=np.int8)
    parts = np.array([recording.part for recording, _ in fitted])
    channels = description.channels
    return Dataset(
        traces[:, 0] if len(channels) == 1 else traces,
        labels,
        name=name,
        rate_hz=description.time.rate_hz or None,
        unit=", ".join(channel.unit for channel in channels),
        limit=limit_of(channels),
        part=parts if (parts != "").any() else None,
        faults=tuple(faults),
        channels=tuple(channel.column for channel in channels),
        source=np.array([recording.source for recording, _ in fitted]),
        fit=live_fit(description),
        lengths=np.array([recording.samples.shape[1] for recording, _ in fitted]),
        notes=tuple(notes),
        unlabelled=n_unlabelled,
        ordered=not is_sorted_by_label(labels),
    )


def is_sorted_by_label(labels: NDArray[np.int8]) -> bool:
    """Return whether all parts of one label come before those of the other."""
    return len({*labels.tolist()}) > 1 and int((np.diff(labels) != 0).sum()) == 1


def limit_of(channels: Sequence[Channel]) -> float | None:
    """Return the range of the sensor; None if it is not stated. DataError for several."""
    limits = {channel.limit for channel in channels}
    if len(limits) > 1:
        raise DataError(f"Expected one limit for all channels, got {listed(sorted(limits))}.")
    return limits.pop() or None


def live_fit(description: Description) -> str:
    """Return what a live trace of another length needs, one of `FITS`."""
    lengths = description.traces.lengths.replace("-all", "")
    has_rate = description.time.column and description.time.rate_hz
    return "strict" if lengths == "resample" and has_rate else lengths


def fit(recording: Recording, description: Description) -> NDArray[np.float32]:
    """Return the trace (C, samples) of a recording, as `[traces]` says.

    With `resample`, a clock and a stated rate, the trace begins at the first time, and is
    interpolated at that rate; without them the whole recording is.

    Raises
    ------
    UnreadableError
        If the recording is too short, or too long, to be fitted without making up data.
    """
    samples, lengths = description.traces.samples, description.traces.lengths
    n = recording.samples.shape[1]
    seconds, rate = recording.seconds, description.time.rate_hz
    if not samples:
        raise DataError("Expected traces.samples, the samples of each trace.")
    if lengths == "resample" and seconds is not None:
        step = 1 / rate if rate else float(seconds[-1]) / max(samples - 1, 1)
        grid = np.arange(samples) * step
        if n < 2 or grid[-1] > seconds[-1] + step:
            message = f"Expected {grid[-1]:.6g} s, got {seconds[-1]:.6g} s"
            raise UnreadableError(f"{message}; traces.samples or time.rate_hz is too large")
        return np.stack([np.interp(grid, seconds, row) for row in recording.samples]).astype(
            np.float32
        )
    kind = "pad" if lengths == "pad-all" else lengths
    can_fit = can_fit_length(n, samples, FITS.index(kind)) or (lengths == "pad-all" and n > 0)
    if not can_fit:
        message = f"Expected {samples} samples, got {n}"
        raise UnreadableError(f"{message}; see traces.lengths, which is {lengths}")
    x = recording.samples.astype(np.float32)
    if n == samples:
        return x
    if kind == "resample":
        return fit_length(torch.from_numpy(x), samples, FITS.index(kind)).numpy()
    return x[:, np.minimum(np.arange(samples), n - 1)]


def _seen_notes(description: Description, n: int, faults: Sequence[Fault]) -> list[str]:
    """Return a note if there are fewer recordings than the description saw."""
    seen = description.seen.recordings
    if n >= seen:
        return []
    return [f"The description was made for {seen} recordings, now there are {n}."]
