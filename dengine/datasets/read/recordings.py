"""Read the recordings of a folder, a file or a DataFrame, exactly as a description says.

Files are split into one table for each part, each table becomes a `Recording`, and the recordings
a `Dataset`. What does not follow the description becomes a `Fault`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...errors import DataError, listed, shortened
from ...records import FITS
from ...traces import can_fit_length, fit_length
from ..checks import finished_notes, without_repeats
from ..dataset import Dataset, Fault
from ..description import ANY, Channel, Description, LabelSource
from ..table import Recording, Table, UnreadableError
from ..units import conversion
from . import bags, frames, windows
from .clock import check_steps, times_of
from .files import find_files, natural_key, read_file
from .places import LabelReader, Place, part_of, read_labels
from .split import Parts, split, tables_of

FRAME = "table"  # what a DataFrame is called in messages
WORDS = {1: "good", 0: "bad", None: "not checked"}
Floats = NDArray[np.float64]


@dataclass
class Reader:
    """Makes a `Recording` of the table of one part, by a description.

    label, checks : the source of labels, and those that must agree with it.
    """

    description: Description
    label: LabelReader
    checks: Sequence[LabelReader] = ()

    def recording(self, table: Table, path: str, source: str) -> Recording:
        """Return the recording of a table; UnreadableError if it does not follow the description.

        path : by which the part is named. source : what it is called.
        """
        clock = self.description.time
        samples, table = self.samples(table)
        seconds, start = None, np.nan
        if clock.column:
            seconds, start = times_of(table, clock, self.description.text)
            if len(seconds) != samples.shape[1]:
                message = f"Expected a time for each of {samples.shape[1]} samples"
                raise UnreadableError(f"{message}, got {len(seconds)}")
        lines = table.lines if len(table.lines) == samples.shape[1] else ()
        recording = Recording(source, samples, seconds, start, lines=lines)
        if clock.sort:
            recording.sort()
        self.name(recording, Place(path, table))
        return recording

    def samples(self, table: Table) -> tuple[Floats, Table]:
        """Return the samples (C, n) of a table, NaN where they are lost, and its rows with samples.

        Raises UnreadableError for a cell that is no number, a unit that cannot be converted, and
        channels of different lengths, and like `kept_rows`.
        """
        table, lost = self.kept_rows(table)
        rows = [self.channel(table, channel) for channel in self.description.channels]
        if len({*map(len, rows)}) > 1:
            lengths = ", ".join(str(len(row)) for row in rows)
            raise UnreadableError(f"Expected channels of one length, got {lengths} samples")
        samples = np.stack(rows)
        if len(lost):
            samples[:, lost] = np.nan
        return samples, table

    def kept_rows(self, table: Table) -> tuple[Table, Any]:
        """Return the rows of a table that are samples, and which of these are lost; () for none.

        Raises UnreadableError for a word of `[rows]` whose meaning is not stated.
        """
        lost: Any = ()
        for column, about in self.description.rows.items():
            words = table.words(column)
            known = {*about.keep, *about.drop, *about.invalid}
            is_other = ~np.isin(words, [*known])
            if ANY not in known and is_other.any():
                i = int(is_other.argmax())
                message = f"Expected one of the words {listed(sorted(known))}, got {words[i]!r}"
                raise UnreadableError(message, table.line(i), column)
            invalid, drop = (
                np.isin(words, [*some]) | (is_other & (ANY in some))
                for some in (about.invalid, about.drop)
            )
            lost = (invalid | lost if len(lost) else invalid)[~drop]
            table = table.take(~drop)
        return table, lost

    def channel(self, table: Table, channel: Channel) -> Floats:
        """Return the samples of a channel in its unit, shape (n,)."""
        values = table.numbers(channel.column, self.description.text)
        try:
            factor = conversion(table.units.get(channel.column, ""), channel.unit)
        except DataError as error:
            raise UnreadableError(str(error), 0, channel.column) from error
        return values * (factor * channel.factor)

    def name(self, recording: Recording, place: Place) -> None:
        """Set the part, the label and the word for the order of a recording.

        Raises UnreadableError if one is missing, or the sources of its label disagree. A part of a
        long recording has the key of its window, if no number is stated.
        """
        recording.part = part_of(self.description.part, place)
        if not recording.part and "window" in place.table.columns:
            recording.part = place.table.one_word("window")
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
    kinds = ("listing", "column", "path", "line", "topic")
    kind = next((kind for kind in kinds if getattr(source, kind)), "column")
    return f"the {kind} {shortened(getattr(source, kind))}"


def read_recordings(
    source: Any, description: Description, progress: Callable[[int], None] | None = None
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
    if open_keys := description.open_keys:
        raise DataError(f"Expected a description without ?, still open: {listed(open_keys)}.")
    is_path = isinstance(source, Path)
    base = (source if source.is_dir() else source.parent) if is_path else Path()
    sources = (description.label, *description.check)
    labels = [read_labels(base, one, description.text) for one in sources]
    reader = Reader(description, labels[0], labels[1:])
    recordings: list[Recording] = []
    faults: list[Fault] = []
    notes: list[str] = []
    files = find_files(source, description) if is_path else []
    if description.layout == "mcap":
        _add(reader, bags.split_bag(files, description, base, notes, faults), recordings, faults)
        files = []
    for path, name in files:
        try:
            tables = tables_of(read_file(path), name, description)
            _add(reader, split_all(tables, name, description, base, faults), recordings, faults)
        except DataError as error:
            faults.append(fault_of(error, name))
        if progress is not None:
            progress(1)
    if not is_path:
        tables = [frames.read_frame(source, FRAME)]
        _add(reader, split(tables, FRAME, description, faults), recordings, faults)
    notes += [note for label in labels if (note := label.unused_note())]
    name = FRAME if not is_path else source.name if source.is_dir() else source.stem
    return to_dataset(recordings, faults, description, name, notes)


def split_all(
    tables: Sequence[Table], name: str, description: Description, base: Path, faults: list[Fault]
) -> Parts:
    """Return the parts of a file, which may be one long recording."""
    if description.windows.trigger or description.windows.listing:
        return windows.cut(tables[0], name, description, base, faults)
    return split(tables, name, description, faults)


def _add(reader: Reader, parts: Parts, recordings: list[Recording], faults: list[Fault]) -> None:
    """Add the recordings of parts, and the faults among them, to two lists."""
    for source, path, table in parts:
        try:
            recordings.append(reader.recording(table, path, source))
        except UnreadableError as error:
            faults.append(fault_of(error, source))


def fault_of(error: DataError, source: str) -> Fault:
    """Return the fault of an error."""
    line, column = getattr(error, "line", 0), getattr(error, "column", "")
    return Fault(source, line, str(error).rstrip("."), column)


def to_dataset(
    recordings: Sequence[Recording],
    faults: list[Fault],
    description: Description,
    name: str,
    notes: list[str],
) -> Dataset:
    """Return the data set of recordings, in the order in which they were made.

    Raises DataError if none is left.
    """
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
    faults = faults + repeats
    n_unlabelled = sum(recording.label is None for recording in recordings)
    if not fitted:
        why = f" {faults[0]}." if faults else ""
        n = f"{len(faults)} have faults, {n_unlabelled} no label"
        raise DataError(f"Expected recordings in {name}, none is left: {n}.{why}")
    n_found = len(fitted) + len(faults) + n_unlabelled
    if n_found < description.seen.recordings:
        seen = f"The description was made for {description.seen.recordings} recordings"
        notes = [*notes, f"{seen}, now there are {n_found}."]
    traces = np.stack([trace for _, trace in fitted])
    labels = np.array([recording.label for recording, _ in fitted], dtype=np.int8)
    parts = np.array([recording.part for recording, _ in fitted])
    sources = np.array([recording.source for recording, _ in fitted])
    channels = description.channels
    is_grid = description.time.column and description.time.rate_hz
    lengths = description.traces.lengths.removesuffix("-all")
    return Dataset(
        traces[:, 0] if len(channels) == 1 else traces,
        labels,
        name=name,
        rate_hz=description.time.rate_hz or None,
        unit=", ".join(channel.unit for channel in channels).strip(", "),
        limit=max((channel.limit for channel in channels), default=0) or None,
        part=parts if (parts != "").any() else None,
        faults=tuple(faults),
        channels=tuple(channel.column for channel in channels),
        source=sources,
        fit="strict" if lengths == "resample" and is_grid else lengths,
        lengths=np.array([recording.samples.shape[1] for recording, _ in fitted]),
        notes=(*notes, *finished_notes(traces, sources)),
        unlabelled=n_unlabelled,
        ordered=int((np.diff(labels) != 0).sum()) != 1,
    )


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
