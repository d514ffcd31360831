"""Read the recordings of a folder, a file or a DataFrame, exactly as a description says.

Files are split into one table for each part, each table becomes a `Recording`, and the recordings
a `Dataset`. What does not follow the description becomes a `Fault`.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...errors import DataError, listed, shortened
from ...records import FITS
from ...traces import can_fit_length, fit_length
from ..checks import Fitted, check_description, finished_notes, without_repeats
from ..dataset import Dataset, Fault
from ..description import ANY, Channel, Description, LabelSource
from ..table import Cells, Floats, Recording, Table, UnreadableError
from ..units import conversion
from . import bags, frames, windows
from .clock import check_steps, times_of
from .files import find_files, natural_key, read_file
from .places import LabelReader, Place, part_of, read_labels
from .split import Parts, split, tables_of

Found = Iterator[Recording | Fault]
Progress = Callable[[int], None]
FRAME = "table"  # what a DataFrame is called in messages
WORDS = {1: "good", 0: "bad", None: "not checked"}
KINDS = ("listing", "column", "path", "line", "topic")  # of sources of labels


@dataclass
class Reader:
    """Reads recordings by one description.

    Parameters
    ----------
    description : Description
    label, checks : LabelReader, sequence of LabelReader
        Of its source of labels, and of those that must agree with it.
    base : Path
        The folder of the recordings, in which their listings stand.
    """

    description: Description
    label: LabelReader
    checks: Sequence[LabelReader] = ()
    base: Path = Path()

    def file(self, path: Path, name: str) -> Found:
        """Yield the recordings of a file, and its faults."""
        try:
            tables = tables_of(read_file(path), name, self.description)
            yield from self.recordings(tables, name)
        except DataError as error:
            yield fault_of(error, name)

    def recordings(self, tables: Sequence[Table], name: str) -> Found:
        """Yield the recordings of the tables of a file, and its faults."""
        faults: list[Fault] = []
        about = self.description.windows
        if about.trigger or about.listing:
            parts = windows.cut(tables[0], name, self.description, self.base, faults)
        else:
            parts = split(tables, name, self.description, faults)
        yield from self.parts(parts)
        yield from faults

    def parts(self, parts: Parts) -> Found:
        """Yield the recording of each part, or its fault."""
        for source, path, table in parts:
            try:
                yield self.recording(table, path, source)
            except UnreadableError as error:
                yield fault_of(error, source)

    def recording(self, table: Table, path: str, source: str) -> Recording:
        """Return the recording of a table; UnreadableError if it does not follow the description.

        path : by which the part is named. source : what it is called.
        """
        clock = self.description.time
        table, lost = self.kept_rows(table)
        seconds, start = None, np.nan
        if clock.column:
            seconds, start = times_of(table, clock, self.description.text)
        rows = [self.channel(table, channel) for channel in self.description.channels]
        lengths = [*map(len, rows if seconds is None else [*rows, seconds])]
        if len({*lengths}) > 1:
            raise UnreadableError(f"Expected channels and times of one length, got {lengths}")
        samples = np.stack(rows)
        if len(lost):
            samples[:, lost] = np.nan
        if clock.sort and seconds is not None:
            order = np.argsort(seconds, kind="stable")
            table, samples = table.take(order), samples[:, order]
            start += float(seconds[order[0]])
            seconds = seconds[order] - seconds[order[0]]
        lines = table.lines if len(table.lines) == samples.shape[1] else ()
        recording = Recording(source, samples, seconds, start, lines=lines)
        self.name(recording, Place(path, table))
        return recording

    def kept_rows(self, table: Table) -> tuple[Table, Cells]:
        """Return the rows of a table that are samples, and which of these are lost; () for none.

        Raises UnreadableError for a word of `[rows]` whose meaning is not stated.
        """
        lost = np.empty(0, dtype=bool)
        for column, about in self.description.rows.items():
            words = table.words(column)
            known = {*about.keep, *about.drop, *about.invalid}
            is_other = ~np.isin(words, [*known])
            if ANY not in known:
                table.refuse(is_other, f"one of the words {listed(sorted(known))}", column)
            invalid, drop = (
                np.isin(words, [*some]) | (is_other & (ANY in some))
                for some in (about.invalid, about.drop)
            )
            lost = (invalid | lost if len(lost) else invalid)[~drop]
            table = table.take(~drop)
        return table, lost

    def channel(self, table: Table, channel: Channel) -> Floats:
        """Return the samples of a channel in its unit, shape (n,)."""
        form, column = self.description.text, channel.column
        values = table.numbers(column, form)
        try:
            factor = conversion(table.units.get(column, ""), channel.unit)
        except DataError as error:
            line = form.units + table.header * isinstance(form.header, str)
            raise UnreadableError(str(error), line, column) from error
        return values * (factor * channel.factor)

    def name(self, recording: Recording, place: Place) -> None:
        """Set the part, the label and the word for the order of a recording.

        Raises UnreadableError if one is missing, or the sources of its label disagree. A part of a
        long recording has the key of its window, if no number is stated.
        """
        recording.part = part_of(self.description.part, place)
        if not recording.part and windows.KEY in place.table.columns:
            recording.part = place.table.one_word(windows.KEY)
        recording.label = self.label.label(place, recording.part)
        for other in self.checks:
            label = other.label(place, recording.part)
            if label != recording.label:
                message = f"Expected labels that agree, {title_of(self.label.source)} says "
                message += f"{WORDS[recording.label]}, {title_of(other.source)} {WORDS[label]}"
                raise UnreadableError(message, column=other.source.column)
        if self.description.order not in ("name", "time"):
            recording.order = place.table.one_word(self.description.order, "first")


def title_of(source: LabelSource) -> str:
    """Return what a source of labels is called in messages."""
    kind = next((kind for kind in KINDS if getattr(source, kind)), "column")
    return f"the {kind} {shortened(getattr(source, kind))}"


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
    check_description(description)
    is_path = isinstance(source, Path)
    base = (source if source.is_dir() else source.parent) if is_path else Path()
    sources = (description.label, *description.check)
    labels = [read_labels(base, one, description.text) for one in sources]
    reader = Reader(description, labels[0], labels[1:], base)
    files = find_files(source, description) if is_path else []
    notes: list[str] = []
    found: list[Recording | Fault] = []
    if description.layout == "mcap":
        faults: list[Fault] = []
        found += reader.parts(bags.split_bag(files, description, base, notes, faults))
        found += faults
    elif not is_path:
        found += reader.recordings([frames.read_frame(source, FRAME)], FRAME)
    else:
        for path, name in files:
            found += reader.file(path, name)
            if progress is not None:
                progress(1)
    notes += [note for label in labels if (note := label.unused_note())]
    name = FRAME if not is_path else source.name if source.is_dir() else source.stem
    return to_dataset(found, description, name, notes)


def fault_of(error: DataError, source: str) -> Fault:
    """Return the fault of an error."""
    line, column = getattr(error, "line", 0), getattr(error, "column", "")
    return Fault(source, line, str(error).rstrip("."), column)


def to_dataset(
    found: Iterable[Recording | Fault], description: Description, name: str, notes: Sequence[str]
) -> Dataset:
    """Return the data set of recordings, in the order in which they were made.

    Raises DataError if none is left.
    """
    fitted, faults, n_unlabelled = _fitted(found, description)
    orders: Mapping[str, Callable[[Fitted], Any]] = {
        "time": lambda item: item[0].start,
        "name": lambda _: 0,  # as they were found
    }
    fitted.sort(key=orders.get(description.order, lambda item: natural_key(item[0].order)))
    fitted, repeats = without_repeats(fitted)
    faults += repeats
    if not fitted:
        n = f"{len(faults)} have faults, {n_unlabelled} no label"
        why = "".join(f" {fault}." for fault in faults[:1])
        raise DataError(f"Expected recordings in {name}, none is left: {n}.{why}")
    n_found, n_seen = len(fitted) + len(faults) + n_unlabelled, description.seen.recordings
    if n_found < n_seen:
        seen = f"The description was made for {n_seen} recordings, now there are {n_found}."
        notes = [*notes, seen]
    return _joined(
        fitted, description, name=name, faults=(*faults,), unlabelled=n_unlabelled, notes=notes
    )


def _joined(
    fitted: Sequence[Fitted], description: Description, notes: Sequence[str], **others: Any
) -> Dataset:
    """Return the data set of recordings with their traces."""
    traces = np.stack([trace for _, trace in fitted])
    about = {
        key: np.array([getattr(recording, key) for recording, _ in fitted])
        for key in ("source", "part", "label")
    }
    channels, clock = description.channels, description.time
    names, units = zip(*((channel.column, channel.unit) for channel in channels), strict=True)
    lengths = description.traces.lengths.removesuffix("-all")
    is_grid = lengths == "resample" and clock.column and clock.rate_hz
    return Dataset(
        traces[:, 0] if len(channels) == 1 else traces,
        about["label"].astype(np.int8),
        rate_hz=clock.rate_hz or None,
        unit=", ".join(units).strip(", "),
        limit=channels[0].limit or None,
        part=about["part"] if (about["part"] != "").any() else None,
        channels=names,
        source=about["source"],
        fit="strict" if is_grid else lengths,
        lengths=np.array([recording.samples.shape[1] for recording, _ in fitted]),
        notes=(*notes, *finished_notes(traces, about["source"].tolist())),
        ordered=np.count_nonzero(np.diff(about["label"])) != 1,
        **others,
    )


def _fitted(
    found: Iterable[Recording | Fault], description: Description
) -> tuple[list[Fitted], list[Fault], int]:
    """Return the labelled recordings with their traces, the faults, and the number of others."""
    fitted: list[Fitted] = []
    faults: list[Fault] = []
    n_unlabelled = 0
    for item in found:
        if isinstance(item, Fault):
            faults.append(item)
            continue
        try:
            check_steps(item, description.time)
            if item.label is None:
                n_unlabelled += 1
            else:
                fitted.append((item, fit(item, description)))
        except UnreadableError as error:
            faults.append(fault_of(error, item.source))
    return fitted, faults, n_unlabelled


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
    if lengths == "resample" and seconds is not None and n > 1:
        step = 1 / rate if rate else float(seconds[-1]) / max(samples - 1, 1)
        times = np.arange(samples) * step
        if times[-1] > seconds[-1] + step:
            message = f"Expected {times[-1]:.6g} s, got {seconds[-1]:.6g} s"
            raise UnreadableError(f"{message}; traces.samples or time.rate_hz is too large")
        rows = [np.interp(times, seconds, row) for row in recording.samples]
        return np.stack(rows).astype(np.float32)
    kind = FITS.index(lengths.removesuffix("-all"))
    if not (can_fit_length(n, samples, kind) or (lengths == "pad-all" and n)):
        message = f"Expected {samples} samples, got {n}"
        raise UnreadableError(f"{message}; see traces.lengths, which is {lengths}")
    x = recording.samples.astype(np.float32)
    if lengths == "resample":
        return np.asarray(fit_length(torch.from_numpy(x), samples, kind))
    return np.asarray(x[:, np.minimum(np.arange(samples), n - 1)])
