"""Read the recordings of a folder, a file or a DataFrame, exactly as a description says.

Files are split into one table for each part, each table becomes a `Recording`, and the recordings
a `Dataset`. What does not follow the description becomes a `Fault`.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...errors import DataError, instead, listed
from ...records import FITS
from ...traces import can_fit_length, fit_length
from ..checks import Fitted, check_description, finished_notes, without_repeats
from ..dataset import Dataset, Fault
from ..description import ANY, Channel, Description
from ..table import Cells, Floats, Recording, Table, UnreadableError
from ..units import conversion, unit_in
from . import frames
from .bags import read_bag
from .clock import check_steps, times_of
from .files import caught, find_files, natural_key, read_file
from .places import LabelReader, Place, part_of, read_labels
from .split import Parts, split, tables_of
from .windows import cut

FRAME = "table"  # what a DataFrame is called in messages
ROUNDING = 1e-6  # of a step: sums of float64 miss a time by less
WORDS = {1: "good", 0: "bad", None: "not checked"}


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

    def recording(self, source: str, path: str, table: Table) -> Recording:
        """Return the recording of a part; UnreadableError if it does not follow the description.

        source : what it is called. path : by which it is named.
        """
        for line, message in table.damage.items():
            raise UnreadableError(message, line)
        about = self.description
        with instead(UnreadableError, "Expected columns of one length", IndexError):
            table, is_lost = self.kept_rows(table)
        seconds = None
        start = np.nan
        if about.time.column:
            seconds, start = times_of(table, about.time, about.text)
            if about.time.sort:
                order = np.argsort(seconds, kind="stable")
                table = table.take(order)
                is_lost = is_lost[order]
                seconds, start = times_of(table, about.time, about.text)
            check_steps(seconds, about.time, table)
        rows = [self.channel(table, channel) for channel in about.channels]
        lengths = [*map(len, rows if seconds is None else [*rows, seconds])]
        if len({*lengths}) > 1:
            raise UnreadableError(f"Expected channels and times of one length, got {lengths}")
        samples = np.stack(rows)
        if about.rows:
            samples[:, is_lost] = np.nan
        place = Place(path, table)
        is_window = about.windows.trigger or about.windows.listing
        part = part_of(about.part, place) or (path if is_window else "")
        label = self.label_of(place, part)
        rank = "" if about.order in ("name", "time") else table.one_word(about.order, "first")
        return Recording(source, samples, seconds, start, part, label, rank)

    def kept_rows(self, table: Table) -> tuple[Table, Cells]:
        """Return the rows of a table that are samples, and which of these are lost.

        Raises UnreadableError for a word of `[rows]` whose meaning is not stated.
        """
        n = max(map(len, table.columns.values()), default=0)
        is_lost: Cells = np.zeros(n, dtype=bool)
        for column, about in self.description.rows.items():
            kinds = {"keep": about.keep, "drop": about.drop, "invalid": about.invalid}
            kind_of = {word: kind for kind, words in kinds.items() for word in words}
            other = kind_of.get(ANY, "")
            words = table.words(column).tolist()
            rows = np.array([kind_of.get(word, other) for word in words], dtype=object)
            table.refuse(rows == "", f"one of the words {listed(sorted(kind_of))}", column)
            is_kept = rows != "drop"
            is_lost = (is_lost | (rows == "invalid"))[is_kept]
            table = table.take(is_kept)
        return table, is_lost

    def channel(self, table: Table, channel: Channel) -> Floats:
        """Return the samples of a channel in its unit, shape (n,)."""
        form = self.description.text
        column = channel.column
        values = table.numbers(column, form)
        factor = 1.0
        with suppress(DataError):  # a name may have another quantity, as `U [V]` of a force
            factor = conversion(unit_in(column.rstrip(ANY)), channel.unit)
        try:
            if unit := table.units.get(column):
                factor = conversion(unit, channel.unit)
        except DataError as error:
            line = form.units + table.header * isinstance(form.header, str)
            raise UnreadableError(str(error), line, column) from error
        return values * (factor * channel.factor)

    def label_of(self, place: Place, part: str) -> int | None:
        """Return the label of a part; UnreadableError if there is none, or a check disagrees."""
        label = self.label.label(place, part)
        for i, check in enumerate(self.checks, 1):
            other = check.label(place, part)
            if other != label:
                message = f"Expected labels that agree, [label] says {WORDS[label]}"
                message = f"{message}, [[check]] {i} says {WORDS[other]}"
                raise UnreadableError(message, column=check.source.column)
        return label


def read_recordings(
    source: Any, description: Description, progress: Callable[[int], None] | None = None
) -> Dataset:
    """Read the recordings that a description describes.

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
    name = FRAME
    base = Path()
    files: list[tuple[Any, str]] = [(source, FRAME)]
    if isinstance(source, Path):
        is_folder = source.is_dir()
        name = source.resolve().name if is_folder else source.stem
        base = source if is_folder else source.parent
        files = find_files(source, description)
    notes: list[str] = []
    faults: list[Fault] = []
    if description.layout == "mcap":
        title = files[0][1] if len(files) == 1 else name
        files = [(read_bag(files, description, notes, faults), title)]
    sources = (description.label, *description.check)
    labels = [read_labels(base, label, description.text) for label in sources]
    reader = Reader(description, labels[0], labels[1:])
    fitted: list[Fitted] = []
    n_unlabelled = 0
    for file, title in files:
        with caught(faults, title):
            for part in _parts_of(file, title, description, base, faults):
                with caught(faults, part[0]):
                    recording = reader.recording(*part)
                    if recording.label is None:
                        n_unlabelled += 1
                    else:
                        fitted.append((recording, fit(recording, description)))
        if progress is not None:
            progress(1)
    notes += [label.unused_note() for label in labels if label.unused_note()]
    return _joined(fitted, description, name, faults, notes, n_unlabelled)


def _parts_of(
    source: Any, name: str, description: Description, base: Path, faults: list[Fault]
) -> Parts:
    """Yield the parts of a file, a DataFrame or the table of a bag."""
    if isinstance(source, Path):
        tables = tables_of(read_file(source), name, description)
    else:
        tables = [source if isinstance(source, Table) else frames.read_frame(source, name)]
    if description.windows.trigger or description.windows.listing:
        return cut(tables[0], name, description, base)
    return split(tables, name, description, faults)


def _joined(
    fitted: list[Fitted],
    description: Description,
    name: str,
    faults: list[Fault],
    notes: list[str],
    n_unlabelled: int,
) -> Dataset:
    """Return the data set of recordings with their traces, in the order in which they were made.

    Raises DataError if none is left.
    """
    is_timed = description.order == "time"
    fitted.sort(key=lambda item: (item[0].start if is_timed else 0, natural_key(item[0].order)))
    fitted, repeats = without_repeats(fitted)
    faults += repeats
    if not fitted:
        n = f"{len(faults)} have faults, {n_unlabelled} no label"
        why = "".join(f" {fault}." for fault in faults[:1])
        raise DataError(f"Expected recordings in {name}, none is left: {n}.{why}")
    n_found = len(fitted) + len(faults) + n_unlabelled
    n_seen = description.seen.recordings
    if n_found < n_seen:
        notes.append(f"The description was made for {n_seen} recordings, now there are {n_found}.")
    data = _stacked(fitted, description)
    notes += finished_notes(data.cube, [recording.source for recording, _ in fitted])
    return replace(data, name=name, faults=(*faults,), notes=(*notes,), unlabelled=n_unlabelled)


def _stacked(fitted: Sequence[Fitted], description: Description) -> Dataset:
    """Return the data set of the traces, and of what is known of each."""
    recordings, traces = zip(*fitted, strict=True)
    about = {
        key: np.array([getattr(recording, key) for recording in recordings])
        for key in ("label", "part", "source")
    }
    X = np.stack(traces)
    y = about["label"].astype(np.int8)
    part = about["part"]
    channels = description.channels
    clock = description.time
    lengths = description.traces.lengths.removesuffix("-all")
    is_grid = lengths == "resample" and clock.column and clock.rate_hz
    return Dataset(
        X[:, 0] if len(channels) == 1 else X,
        y,
        rate_hz=clock.rate_hz or None,
        unit=", ".join(channel.unit for channel in channels).strip(", "),
        limit=channels[0].limit or None,
        part=part if part.any() else None,
        channels=tuple(channel.column for channel in channels),
        source=about["source"],
        fit="strict" if is_grid else lengths,
        lengths=np.array([recording.samples.shape[1] for recording in recordings]),
        ordered=np.count_nonzero(np.diff(y)) != 1,
    )


def fit(recording: Recording, description: Description) -> NDArray[np.float32]:
    """Return the trace (C, samples) of a recording, as `[traces]` says.

    With `resample` and a clock it is interpolated in time: at the stated rate from the first time
    on, up to one step beyond the last, so that the end of a longer recording is left out; without
    a rate the whole recording, to that number of samples. Otherwise it is fitted like a live trace.

    Raises
    ------
    UnreadableError
        If the recording is too short, or too long, to be fitted without making up data; with
        `pad-all` its last sample is repeated all the same.
    """
    samples = description.traces.samples
    lengths = description.traces.lengths
    rate = description.time.rate_hz
    x = recording.samples
    seconds = recording.seconds
    n = x.shape[1]
    kind = FITS.index(lengths.removesuffix("-all"))
    can_fit = can_fit_length(n, samples, kind) or (lengths == "pad-all" and n > 0)
    times = None
    if lengths == "resample" and seconds is not None:
        step = 1 / rate if rate else float(seconds[-1]) / max(samples - 1, 1)
        times = np.arange(samples) * step
        if rate:
            can_fit = bool(times[-1] <= seconds[-1] + (1 + ROUNDING) * step)
    if not can_fit:
        message = f"Expected {samples} samples, got {n}"
        raise UnreadableError(f"{message}; see traces.lengths, which is {lengths}")
    if times is not None and seconds is not None:
        return np.stack([np.interp(times, seconds, row) for row in x]).astype(np.float32)
    return fit_length(torch.from_numpy(x.astype(np.float32)), samples, kind).numpy()
