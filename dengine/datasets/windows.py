"""Windows of a long recording: a listing that says from when to when each part ran.

`read_windows` finds the columns of times in it; `Windows.cut` tells which samples are in which
window. The reader of bags and that of long tables use both.
"""

import re
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, listed
from .clocks import DATE, HOUR, TIME_OF_DAY, join_date_and_time, times_of
from .dataset import LoadOptions, UnreadableError
from .labels import LISTS, LabelSource, normalized
from .listings import labels_in_file
from .text import read_table

if TYPE_CHECKING:
    import pandas as pd

TOLERANCE = 1e-5  # seconds: float64 rounds dates to less
ZONES = range(-14, 15)  # hours from UTC
Times = NDArray[np.float64]


class Window(NamedTuple):
    """The samples in a window.

    positions : array of int64
        Of the samples in the recording.
    seconds, late, early : float
        How long it is, how long after its start the first sample comes, and before its end the
        last one.
    fault : str
        Why it cannot be used; "" if it can.
    """

    positions: NDArray[np.int64]
    seconds: float
    late: float
    early: float
    fault: str


class Windows(NamedTuple):
    """The windows of a listing.

    file : str
        Name of the listing.
    names : list of str
        Of the n parts in the order of their starts; a duplicate gets its line number
        appended.
    starts, ends : array of float64, shape (n,)
        In seconds; NaN where the listing states no time.
    since_1970 : bool
        Whether they count since 1970, else since the start of the recording.
    frame : DataFrame
        The listing without its times, and with the column `file` of the names.
    options : LoadOptions
        Those to read the labels with.
    """

    file: str
    names: list[str]
    starts: Times
    ends: Times
    since_1970: bool
    frame: "pd.DataFrame"
    options: LoadOptions

    def label_source(self) -> LabelSource:
        """Return the source of the labels of the parts, which the listing tells, too."""
        return labels_in_file(str(self.options.labels), self.names, self.options, self.frame)

    def n_inside(self, times: Times, shift: float = 0.0) -> int:
        """Return how many windows, later by `shift` seconds, begin and end within times."""
        is_inside = (self.starts + shift >= times.min() - 1.0) & (
            self.ends + shift <= times.max() + 1.0
        )
        return int(is_inside.sum())

    def check_inside(self, times: Times, source: str) -> None:
        """Raise DataError, with advice, if no window is within the times of a recording.

        If they count from its start, most must be within.
        """
        n = self.n_inside(times)
        if n and (self.since_1970 or 2 * n > len(self.names)):
            return
        do = "if they count from its start, write their unit into the columns' names: start [ms]"
        if self.since_1970:
            zones = [zone for zone in ZONES if self.n_inside(times, zone * HOUR) > 0]
            zone = min(zones, key=abs, default=0)
            do = "is it another recording, or a clock that was not set?"
            if zone:
                local = self.text(float(self.starts[0])).replace("Z", f"{-zone:+03d}:00")
                do = f"{abs(zone)} h {'later' if zone > 0 else 'earlier'} they would be: "
                do += f"if they are local times, write them with their zone, as {local}"
        first, last = (self.text(float(time)) for time in (times.min(), times.max()))
        begin, end = np.nanmin(self.starts), np.nanmax(self.ends)
        wanted = f"windows in {source}, which is from {first} to {last}"
        actual = f"those of {self.file} are from {self.text(begin)} to {self.text(end)}"
        raise DataError(f"Expected {wanted}; {actual}; {do}.")

    def text(self, time: float) -> str:
        """Return a time as a text: in UTC, or in seconds since the start."""
        if np.isnan(time):
            return "none"
        if self.since_1970:
            return f"{np.datetime64(round(time * 1e3), 'ms')}Z"
        return f"{time:.6g} s"

    def cut(self, times: Times, step: float) -> list[Window]:
        """Return the samples in each window.

        A window that ends before it starts, overlaps another, leaves the recording by more than 1.5
        steps, or has no sample gets a `fault`. It includes its start and excludes its end.

        Parameters
        ----------
        times : array of float64, shape (m,)
            As `starts`.
        step : float
            Seconds between two samples.
        """
        overlapped = self._overlaps()
        begin, end = times.min() - 1.5 * step, times.max() + 1.5 * step
        span = f"from {self.text(float(times.min()))} to {self.text(float(times.max()))}"
        cuts = []
        for i, (first, last) in enumerate(zip(self.starts, self.ends, strict=True)):
            is_inside = (times >= first - TOLERANCE) & (times < last - TOLERANCE)
            window = f"{self.text(first)} to {self.text(last)}"
            fault = ""
            if not first < last:
                fault = f"Expected times of its start and, later, of its end, got {window}"
            elif i in overlapped:
                fault = f"Expected windows apart, {window} overlaps that of {overlapped[i]}"
            elif first < begin or last > end:
                fault = f"Expected a window in the recording, {span}, got {window}"
            elif not is_inside.any():
                fault = f"Expected samples in the window {window}, found none"
            late = float(times[is_inside].min(initial=np.inf) - first)
            early = float(last - times[is_inside].max(initial=-np.inf))
            positions = np.flatnonzero(is_inside)
            cuts.append(Window(positions, float(last - first), late, early, fault))
        return cuts

    def _overlaps(self) -> dict[int, str]:
        """Return for each window that overlaps others the name of one of these."""
        others = dict[int, str]()
        latest = -1  # the window that ends last so far
        for i in np.argsort(self.starts).tolist():
            if not self.starts[i] < self.ends[i]:
                continue
            if latest >= 0 and self.starts[i] < self.ends[latest] - TOLERANCE:
                others |= {i: self.names[latest], latest: self.names[i]}
            if latest < 0 or self.ends[i] > self.ends[latest]:
                latest = i
        return others


def read_windows(name: str, options: LoadOptions) -> Windows | None:
    """Read the windows in the file of labels; None if it lists no windows.

    It lists windows if it has a column of starts, and one of ends or of durations. Parts are named
    by the column `part`, by one with a usual name or by a first column without duplicates, else
    `name`/1, `name`/2, ... Raises DataError for ambiguous dates, times of day without a date, and
    if a stated column, or one that may hold labels, is missing.
    """
    if options.labels is None:
        return None
    path = Path(options.labels)
    try:
        frame = read_table(path, replace(options, columns=()), as_text=True).frame
    except (OSError, UnreadableError):
        return None  # the reader of labels says what is wrong
    frame = frame[(frame != "").any(axis=1)]
    columns = {
        role: [column for column in frame if _is_named(column, f"window_{role}s")]
        for role in ("start", "end", "duration")
    }
    if not columns["start"] or not (columns["end"] or columns["duration"]) or frame.empty:
        return None
    of_start = columns["start"][0]
    of_end = (columns["end"] or columns["duration"])[0]
    try:
        starts, ends, since_1970 = _times_of_both(frame, of_start, of_end, not columns["end"])
    except UnreadableError as error:
        raise DataError(f"{error} in {path}.") from error
    if np.isnan(starts).all() or np.isnan(ends).all():
        is_of_day = frame[of_start].str.strip().str.fullmatch(TIME_OF_DAY.pattern).all()
        if not is_of_day:
            return None
        wanted = f"dates with the times of day in {of_start} and {of_end} of {path}"
        raise DataError(f"Expected {wanted}, got {frame[of_start].iloc[0]}; write both in one.")
    of_times = {column for names in columns.values() for column in names}
    _check_header(frame, of_times, path, options)
    frame = frame.drop(columns=list(of_times))
    texts, options = _name_parts(frame, name, options)
    frame = frame.drop(columns=[column for column in frame if column.lower() == "file"])
    frame.insert(0, "file", texts)
    order = np.argsort(starts, kind="stable")
    times = (starts[order], ends[order])
    names = [texts[i] for i in order.tolist()]
    return Windows(path.name, names, *times, since_1970, frame, options)


def _check_header(
    frame: "pd.DataFrame", of_times: Collection[str], path: Path, options: LoadOptions
) -> None:
    """Raise DataError if a listing of windows has no stated column, or none that may be labels."""
    header = listed(frame.columns)
    stated = {"part": None if options.part == "part" else options.part, "label": options.label}
    for option, column in stated.items():
        if column is not None and column.lower() not in map(str.lower, frame):
            raise DataError(
                f"Expected a column {column} in {path}, got {header}; leave it out ({option})."
            )
    others = frame.drop(columns=list(of_times))
    if set(others.columns) <= {_part_column(others, options.part)}:
        do = "add one, as result with OK and NOK"
        raise DataError(f"Expected a column of labels in {path}, got {header}; {do}.")


def _name_parts(
    frame: "pd.DataFrame", name: str, options: LoadOptions
) -> tuple[list[str], LoadOptions]:
    """Return a name for each row of a listing without its times, and the options for its labels.

    It is that of the part, with its line behind if it is there twice, or a number behind `name`.
    """
    part = _part_column(frame, options.part)
    texts = [f"{name}/{i}" for i in range(1, len(frame) + 1)]
    if part is None:
        return texts, options
    cells = zip(frame[part].str.strip(), texts, strict=True)
    texts = [cell or text for cell, text in cells]
    counts = Counter(text.lower() for text in texts)
    if max(counts.values()) > 1:
        options = replace(options, part=part)
    lines = zip(texts, frame.index, strict=True)
    return [f"{t}, line {line}" if counts[t.lower()] > 1 else t for t, line in lines], options


def _times_of_both(
    frame: "pd.DataFrame", of_start: str, of_end: str, is_duration: bool
) -> tuple[Times, Times, bool]:
    """Return the starts and ends in columns of a listing, and whether they are since 1970."""
    import pandas as pd

    columns = [frame[of_start], frame[of_end]]
    dates = [name for name in frame if frame[name].str.strip().str.fullmatch(DATE.pattern).all()]
    if len(dates) == 1:
        for i, column in enumerate(columns):
            pair = pd.DataFrame({"date": frame[dates[0]].str.strip(), "time": column.str.strip()})
            join_date_and_time(pair)
            columns[i] = pair["time"].rename(column.name)
    if is_duration:
        starts, since_1970 = times_of(columns[0])
        return starts, starts + times_of(columns[1])[0], since_1970
    both = pd.concat(columns).rename(of_start)  # one order of day and month
    times, since_1970 = times_of(both)
    return times[: len(frame)], times[len(frame) :], since_1970


def _is_named(column: str, role: str) -> bool:
    """Return whether the name of a column is one of the words of `role`, with others around it."""
    others = "|".join(LISTS["window_others"])
    text = re.sub(r"[\W_]", "", normalized(column)).lower()
    words = "|".join(LISTS[role])
    return re.fullmatch(f"(?:{others})*(?:{words})(?:{others})*", text) is not None


def _part_column(frame: "pd.DataFrame", stated: str) -> str | None:
    """Return the column that names the parts: the stated one, or one with a usual name, or the
    first column if its cells are all different; None without one.
    """
    columns = list(map(str, frame.columns))
    if stated in columns or not columns:
        return stated if columns else None
    bare: Sequence[str] = [re.sub(r"[\W_]", "", column).lower() for column in columns]
    for name in LISTS["part_columns"]:
        if name in bare:
            return columns[bare.index(name)]
    return columns[0] if frame[columns[0]].is_unique else None
