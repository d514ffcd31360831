"""`Dataset`, labelled traces of one shape in memory, and how recordings become one.

The readers of the family add each recording to a `RecordingCollector`. `as_dataset` brings them to
one unit, one rate and one length; what cannot be brought to them is left out as a `Fault`, not made
up. `LoadOptions` are the options of `load_dataset`.
"""

import codecs
import hashlib
import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from ..errors import DataError, TraceError, expect, instead, listed, shortened
from ..records import FITS, TraceSpec
from ..representation import to_html
from ..traces import as_traces, can_fit_length, fit_length
from . import units
from .scales import COUNTS, scale_of

if TYPE_CHECKING:
    import pandas as pd

RATE_TOLERANCE = 0.03  # of the others' rate: recordings within it have one rate
ZEROS = 10  # that many samples of 0 at the end of a recording may be no measurements
MANY = 10  # recordings, among which both labels are expected
SHORT = 0.7  # of the usual length: recordings below it may be pieces, if they are few
LONG = 0.95  # of a recording: less of it is read with a note
FEW = 0.1  # of all recordings
FAR = 50.0  # times the usual largest value: a recording beyond has another unit or is none
MAX_RATE_RATIO = 2.0  # a recording at a rate further from the others' is not resampled
REFERENCE = re.compile(  # in the name of a part with which the station itself is checked
    r"(?<![^\W\d_])((master|meister|einstell|referen[cz]e?|kalibrier|calibration|grenzmuster|golden)"
    r"(part|teil|sample|stück|muster|ungs?teil)?|ref|dummy|einstellmeister)(?![^\W\d_])",
    re.IGNORECASE,
)
FORCE_AXIS = re.compile(r"f[xyz]([_ ]base)?", re.IGNORECASE)
MAX_REFERENCE_SHARE = 0.25  # of all parts
UNKNOWN_RATE = (
    "The rate is unknown, for nothing tells it: times are in samples until it is stated,"
    " rate_hz=..."
)
LABEL_FORMS = "as True/False, OK/NOK, pass/fail or 1/0"
MEANINGS = ("bad", "good")  # of the labels 0 and 1
# A range of numbered names, as c0..c498.
NAME_RANGE = re.compile(r"(?P<name>[^\W\d]\w*?)(?P<first>\d{1,5})\.\.(?P=name)(?P<last>\d{1,5})")
MARKS_OF_MISSING = [s * m for s in (-1, 1) for m in (999, 9999, 99999, 999999)]
MAX_LABEL_WORDS = 12  # more different words are no labels
PAD_ALL = "pad-all"  # as "pad", for recordings of any length
expect_data = partial(expect, error=DataError)


@dataclass(frozen=True, slots=True)
class Fault:
    """Why a recording was left out.

    source : str
        The file, seen from the folder, or what the rows are of.
    line : int
        In the file, or row of the table, from 1; 0 for the whole.
    message : str
        What was expected, and what came.
    """

    source: str
    line: int
    message: str

    def __str__(self) -> str:
        return (
            f"{self.source}, line {self.line}: {self.message}"
            if self.line
            else f"{self.source}: {self.message}"
        )


class UnreadableError(DataError):
    """One recording cannot be read; the error becomes its `Fault`.

    line : of the file, 0 for the whole.
    """

    def __init__(self, message: str, line: int = 0) -> None:
        super().__init__(message)
        self.line = line


class UnknownWordError(UnreadableError):
    """A label in a word whose meaning is unknown; the user can state it as `label_map`.

    forms : the labels that were expected.
    """

    def __init__(self, word: str, forms: str = LABEL_FORMS) -> None:
        super().__init__(f"Expected a label, {forms}, got {shortened(word)}")
        self.word = word
        self.forms = forms


class UnlabelledError(UnreadableError):
    """A recording whose label is empty or a word as pending: its part was not checked yet."""

    def __init__(self, word: str) -> None:
        super().__init__(f"Expected a label, got {word or 'none'}")
        self.word = word


@dataclass(frozen=True, slots=True, repr=False)
class Dataset:
    """Labelled traces, in the order of their recording.

    Parameters
    ----------
    X : array of float32, shape (n, T) or (n, C, T)
    y : array of int8, shape (n,)
        1 for success, 0 for failure.
    name : str
        For people.
    rate_hz : float, optional
        Sampling rate in hertz. None: unknown.
    unit : str, default "N"
        Unit of the samples, one for all channels or "kN, mm", one for each; "" if it is unknown.
    cause : array of str, shape (n,), optional
        Why a part failed.
    part : array of str, shape (n,), optional
        Number of the part of each trace. None: each trace is of another part.
    faults : tuple of Fault
        What could not be read and was left out.
    channels : tuple of str
        Names of the channels, if they have any.
    notes : tuple of str
        What users should know about the files, in sentences.
    source : array of str, shape (n,), optional
        The file or row of each trace.
    fit : str, default "strict"
        How recordings of other lengths became T samples, as in `TraceSpec`.
    lengths : array of int64, shape (n,), optional
        Samples of each recording, as recorded.
    rates : array of float64, shape (n,), optional
        Rate of each recording in hertz, by its own timestamps; NaN where it has none.
    unlabelled : int
        Recordings that were left out because their part was not checked yet: their label is empty,
        or a word as pending.
    ordered : bool, default True
        Whether the order of the traces is that of the recording. False for files that are ordered
        by their label, as in folders `good/` and `bad/`.
    reading : mapping of str to str
        How the recordings were read, in words: their labels, clock, rows, numbers, order, and the
        first of them. What does not apply is left out.
    """

    X: NDArray[np.float32]
    y: NDArray[np.int8]
    name: str = "data"
    rate_hz: float | None = None
    unit: str = "N"
    cause: NDArray[np.str_] | None = None
    part: NDArray[np.str_] | None = None
    faults: tuple[Fault, ...] = ()
    channels: tuple[str, ...] = ()
    source: NDArray[np.str_] | None = None
    fit: str = "strict"
    lengths: NDArray[np.int64] | None = None
    rates: NDArray[np.float64] | None = None
    notes: tuple[str, ...] = ()
    unlabelled: int = 0
    ordered: bool = True
    reading: Mapping[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.y)

    def __repr__(self) -> str:
        good = int(self.y.sum())
        names = f" of {', '.join(self.channels)}" if self.channels else ""
        rate = "an unknown rate" if self.rate_hz is None else f"{self.rate_hz:g} Hz"
        form = f"{' x '.join(map(str, self.X.shape[1:]))} samples{names} at {rate}"
        labels = f"{good} good, {len(self) - good} bad, {self.unlabelled} unlabelled"
        counts = f"{labels}, {len(self.faults)} left out"
        return f"<Dataset {self.name}: {len(self)} traces, {form}, {counts}>"

    _repr_html_ = to_html

    @property
    def spec(self) -> TraceSpec:
        """The `TraceSpec` of live traces of the same shape, for `DataEngine(trace=data.spec)`.

        If the rate is unknown, it is the default of `TraceSpec`: state `rate_hz` before times
        matter. An unknown unit is called "units".
        """
        n_channels = 1 if self.X.ndim == 2 else self.X.shape[1]
        spec = TraceSpec(
            self.X.shape[-1],
            channels=n_channels,
            unit=", ".join(unit.strip() or "units" for unit in self.unit.split(",")),
            fit=self.fit,
            columns=self.channels,
        )
        return spec if self.rate_hz is None else replace(spec, rate_hz=self.rate_hz)

    def to_frame(self) -> "pd.DataFrame":
        """Return a DataFrame with a row for each trace.

        Its columns are `label`, `part` and `cause` where known, and one for each sample of each
        channel, `FZ_0`, `FZ_1`, ..., or without names `x_0`, of several channels `x0_0`.
        `load_dataset` reads what `data.to_frame().to_parquet("data.parquet")` writes.
        """
        import pandas as pd

        X = self.X if self.X.ndim == 3 else self.X[:, None]
        default = ["x"] if X.shape[1] == 1 else [f"x{c}" for c in range(X.shape[1])]
        names = [f"{name}_{i}" for name in self.channels or default for i in range(X.shape[2])]
        columns = {"label": self.y, "part": self.part, "cause": self.cause}
        columns = {name: values for name, values in columns.items() if values is not None}
        samples = pd.DataFrame(X.reshape(len(X), -1), columns=names)
        return pd.concat([pd.DataFrame(columns), samples], axis=1)

    def cut(self, samples: int) -> "Dataset":
        """Return a data set of the first `samples` samples of every trace, to decide earlier.

        Raises DataError if the traces are shorter, or were resampled, so that their first samples
        are not the first of the recordings.
        """
        have = self.X.shape[-1]
        expect_data(1 <= samples <= have, f"1 to {have} samples of {self.name}", samples)
        can_cut = samples == have or self.fit != "resample"
        expect_data(can_cut, f"{have} samples of {self.name}, which was resampled", samples)
        fit = "cut" if samples < have and self.fit == "pad" else self.fit
        return replace(self, X=np.ascontiguousarray(self.X[..., :samples]), fit=fit)


def make_dataset(
    X: ArrayLike,
    y: ArrayLike,
    *,
    rate_hz: float | None = None,
    channels: tuple[str, ...] = (),
    part: Any = None,
    cause: Any = None,
    **about: Any,
) -> Dataset:
    """Check arrays and make a `Dataset` of them.

    Parameters
    ----------
    X : array, shape (n, T) or (n, C, T)
    y : array, shape (n,)
        1 for success, 0 for failure.
    rate_hz, channels, part, cause
        As in `Dataset`; part's numbers may be integers.
    **about
        Other fields of `Dataset`.

    Raises
    ------
    DataError
        If they do not fit together, there is no trace, a label is neither 1 nor 0, or X has more
        channels than samples.
    """
    try:
        X = as_traces(X)[:, 0] if np.ndim(X) == 2 else as_traces(X)
    except TraceError as error:
        raise DataError(str(error)) from error
    y = np.asarray(y)
    shapes = (X.shape, y.shape)
    expect_data(y.shape == X.shape[:1], "X (n, T) or (n, C, T) with n labels", shapes)
    expect_data(len(y) > 0, "at least one trace", 0)
    is_transposed = X.ndim == 3 and X.shape[1] > X.shape[2]
    do = "it looks transposed; pass X.transpose(0, 2, 1)"
    expect_data(not is_transposed, "X (n, channels, samples)", X.shape, do)
    labels = sorted(set(map(str, y.tolist())))
    expect_data(bool(np.isin(y, (0, 1)).all()), "labels 1 (success) and 0 (failure)", labels)
    expect_data(rate_hz is None or 0 < rate_hz < np.inf, "a rate above 0 Hz", rate_hz)
    n_channels = 1 if X.ndim == 2 else X.shape[1]
    one_each = not channels or len(channels) == n_channels
    expect_data(one_each, f"a name for each of {n_channels} channels", channels)
    if part is not None:
        part = np.asarray(part)
        valid = part.shape == y.shape and part.dtype.kind in "iuUS"
        wanted = f"{len(y)} parts' numbers, texts or integers"
        expect_data(valid, wanted, (part.shape, part.dtype))
        part = part.astype(np.str_)
    valid = cause is None or np.shape(cause) == y.shape
    expect_data(valid, f"{len(y)} causes, one a trace", np.shape(cause))
    return Dataset(
        X,
        y.astype(np.int8),
        rate_hz=rate_hz,
        channels=channels,
        part=part,
        cause=cause,
        **about,
    )


@dataclass(frozen=True, slots=True)
class LoadOptions:
    """The options of `load_dataset`, by the same names.

    `channels` are those of `channel`, `words` is the parsed `label_map`: words in lower case, and
    whether they are good, or None. Raises DataError for values that are out of range or contradict.
    """

    samples: int | None = None
    part: str = "part"
    channels: tuple[str, ...] = ()
    label: str | None = None
    labels: str | os.PathLike[str] | None = None
    fit: str | None = None
    rate_hz: float | None = None
    trigger: Any = None
    topic: str | None = None
    time: str | None = None
    unit: str | None = None
    words: Mapping[str, bool | None] = field(default_factory=dict)
    columns: tuple[str, ...] = ()
    decimal: str | None = None
    thousands: str | None = None
    encoding: str | None = None

    def __post_init__(self) -> None:
        fits = (*FITS, PAD_ALL)
        expect_data(self.fit in (None, *fits), f"fit to be one of {', '.join(fits)}", self.fit)
        expect_data(self.rate_hz is None or self.rate_hz > 0, "a rate above 0 Hz", self.rate_hz)
        expect_data(self.samples is None or self.samples >= 1, "1 or more samples", self.samples)
        for names in (self.channels, self.columns):
            expect_data(len(set(names)) == len(names), "each column once", names)
        expect_data(self.decimal in (None, ".", ","), "a decimal mark, '.' or ','", self.decimal)
        marks = (None, ".", ",", "'", "’", " ", "")
        valid = self.thousands in marks
        valid = valid and (not self.thousands or self.thousands != self.decimal)
        wanted = "a mark of thousands, ',', '.', ' ' or an apostrophe, that is not the decimal one"
        expect_data(valid, wanted, self.thousands)
        with instead(DataError, "Expected the name of an encoding, as 'cp1252'", LookupError):
            codecs.lookup(self.encoding or "utf-8")

    @property
    def part_columns(self) -> tuple[str, ...]:
        """The columns that tell the part: `part`, and those that it joins, as "day,number"."""
        return tuple(dict.fromkeys([self.part, *split_names(self.part)]))

    def has_part(self, columns: Iterable[str]) -> bool:
        """Return whether `part` is one of the columns, or they are all that it joins."""
        names = {*columns}
        return self.part in names or set() < {*split_names(self.part)} <= names


def split_names(names: str | Sequence[str] | None) -> tuple[str, ...]:
    """Return names one by one, of "FZ_Base,FX_Base" or of a list of them, without blanks.

    The range c0..c3 stands for c0, c1, c2 and c3.
    """
    items = names.split(",") if isinstance(names, str) else names or ()
    result = list[str]()
    for name in filter(None, map(str.strip, items)):
        if match := NAME_RANGE.fullmatch(name):
            numbers = range(int(match["first"]), int(match["last"]) + 1)
            result += [f"{match['name']}{i}" for i in numbers]
        else:
            result.append(name)
    return tuple(result)


class Reading(NamedTuple):
    """How one recording was read, in words; "" where that is not known.

    place, word : str
        Where its label stands, and what is there.
    clock : str
        Which column its times are from, and in which unit or form.
    rows : str
        Lines that were left out of it.
    numbers : str
        The marks in its numbers, what stands between cells, and the encoding if it is not UTF-8.
    """

    place: str = ""
    word: str = ""
    clock: str = ""
    rows: str = ""
    numbers: str = ""


def describe_reading(
    readings: Sequence[Reading],
    labels: Sequence[int],
    order: str,
    first: str = "",
    *,
    rate_hz: float | None = None,
) -> dict[str, str]:
    """Return how recordings were read, in words, for `Dataset.reading`.

    The keys are labels, clock, rows, numbers, order and first; empty texts are left out, and rows
    if no line of any recording was left out.

    readings, labels : one for each recording; there is at least one.
    order, first : by what they are ordered, and `describe_ends` of the first.
    rate_hz : that the user stated; it says why there is no clock.
    """
    words = dict[str, Counter[str]]()
    for reading, label in zip(readings, labels, strict=True):
        counts = words.setdefault(reading.place, Counter())
        counts[f"{reading.word} -> {MEANINGS[label]}"] += 1
    about = {"labels": "; ".join(f"{place}: {_with_counts(n)}" for place, n in words.items())}
    no_clock = "none, the rate is stated" if rate_hz else "none"
    for name, default in (("clock", no_clock), ("rows", "all"), ("numbers", "")):
        counts = Counter(getattr(reading, name) or default for reading in readings)
        several = [f"{text} ({n} of {len(labels)})" for text, n in counts.most_common()]
        about[name] = listed(several) if len(counts) > 1 else next(iter(counts))
    about |= {"order": order, "first": first}
    return {name: text for name, text in about.items() if text not in ("", "all")}


def _with_counts(counts: Counter[str]) -> str:
    """Return texts with their counts, the most frequent first: `a 30, b 8`."""
    return listed(f"{text} {n}" for text, n in counts.most_common())


def describe_ends(
    source: str, trace: NDArray[np.float32], channels: Sequence[str], all_units: Sequence[str]
) -> str:
    """Return in words the first and last value of each channel of a trace (C, T), and its length.

    source : the file or row of the trace. all_units : one for each channel.
    """
    rows = zip(channels or [""] * len(trace), trace, all_units, strict=True)
    texts = (f"{name} {row[0]:.6g} to {row[-1]:.6g} {unit}".strip() for name, row, unit in rows)
    return f"{source}: {listed(texts)} in {trace.shape[1]} samples"


def label_map_of(
    words: Counter[str], labels: Collection[int] = (), unlabelled: Mapping[str, int] | None = None
) -> str:
    """Return a label map that users may take, as "heil=good,Riss=bad", for words without meaning.

    The most frequent is good, and all others bad, unless one is another with something before it:
    then this is bad. Beside labels of one side all words are of the other, of whole numbers beside
    bad ones only the most frequent.

    Parameters
    ----------
    words : Counter
        How often each word occurs.
    labels : collection of int
        Those that are known.
    unlabelled : mapping of str to int
        How often each word occurs that marks a part as unchecked. Without known labels a dash, or
        an empty cell, counts as one of `words` if it is more frequent than all of these together:
        then it means that there is no fault. Others are not used.
    """
    no_fault = {word: (unlabelled or {}).get(word, 0) for word in ("-", "") if not labels}
    words = words + Counter({word: n for word, n in no_fault.items() if n > words.total()})
    ordered = [word for word, _ in words.most_common()]
    if 1 in labels and 0 not in labels:
        bad = set(ordered)
    elif 0 in labels and 1 not in labels:  # of codes one means that there is no fault
        bad = set(ordered[1:]) if all(map(str.isdigit, ordered)) else set()
    else:
        bad = {w for w in ordered if any(v and w != v and w.endswith(v) for v in ordered)}
        bad = bad or set(ordered[1:])
    return ",".join(f"{word}={'bad' if word in bad else 'good'}" for word in ordered)


class Recording(NamedTuple):
    """One recording; a reader of traces leaves out its label, source and part.

    trace : array of float32, shape (C, T)
    rate_hz : float or None
        Sampling rate by its own timestamps.
    units : tuple of str
        Unit of each channel, "" where unknown.
    start : float or None
        Its first time in seconds since 1970, if its clock holds dates; in a long table since the
        first row.
    reading : Reading
        How it was read.
    label : int
        1 for success, 0 for failure.
    source : str
        Its file or row.
    part : str or None
        Number of its part.
    length : int
        Samples as recorded, if the trace has others by now; else 0.
    factors : mapping of str to float
        What it states that may make a quantity of counts, by name, as `scales.stated_factors`.
    repeated : int
        Number of its rows that came twice and were left out.
    goes_back : str
        Its column of times that goes back, if the user does not trust it; else "".
    """

    trace: NDArray[np.float32]
    rate_hz: float | None = None
    units: tuple[str, ...] = ()
    start: float | None = None
    reading: Reading = Reading()
    label: int = 0
    source: str = ""
    part: str | None = None
    length: int = 0
    factors: Mapping[str, float] = {}
    repeated: int = 0
    goes_back: str = ""


@dataclass
class RecordingCollector:
    """Collects recordings in order, and the faults of those that cannot be read.

    name : str
        Name of the data set.
    channels : tuple of str
    faults, recordings : list
    notes : Counter
        What users should know, and how many times.
    unknown_words : Counter
        Words in the place of labels whose meaning is unknown.
    label_forms : str
        The labels that were expected instead of the last of them.
    label_file : str
        Path of a file that may list labels, for advice; "" for none.
    unlabelled_words : Counter
        Words of the recordings whose parts were not checked yet; "" for an empty label.
    ordered : bool
        As in `Dataset`.
    order : str
        By what the recordings are ordered, in words.
    """

    name: str
    channels: tuple[str, ...]
    faults: list[Fault] = field(default_factory=list)
    recordings: list[Recording] = field(default_factory=list)
    notes: Counter[str] = field(default_factory=Counter)
    unknown_words: Counter[str] = field(default_factory=Counter)
    label_forms: str = LABEL_FORMS
    label_file: str = ""
    unlabelled_words: Counter[str] = field(default_factory=Counter)
    ordered: bool = True
    order: str = "as the rows"

    @property
    def unlabelled(self) -> int:
        """Number of the recordings whose parts were not checked yet."""
        return self.unlabelled_words.total()

    def unlabelled_text(self, n_all: int, what: str = "recordings") -> str:
        """Return how many of all have no label yet, with their words, for a note or an error.

        what : what is counted.
        """
        counts = self.unlabelled_words.most_common(4)
        words = [f"{shortened(word)} {n} times" for word, n in counts if word]
        text = f"{self.unlabelled} of {n_all} {what} of {self.name} have no label yet"
        return f"{text} ({', '.join(words)})" if words else text

    def add(self, source: str, read: Callable[[], Recording], line: int = 0) -> None:
        """Call `read` and add the recording that it returns, or a fault if it raises.

        Only OSError, TraceError and UnreadableError become faults; an unknown word is counted, too.
        A recording without a label yet is only counted. `line` is that of the source, for the
        fault, if it is known.
        """
        try:
            self.recordings.append(read())
        except UnlabelledError as error:
            self.unlabelled_words[error.word] += 1
        except (OSError, TraceError, UnreadableError) as error:
            if isinstance(error, UnknownWordError):
                self.unknown_words[error.word] += 1
                self.label_forms = error.forms
            line = line or getattr(error, "line", 0)
            self.faults.append(Fault(source, line, str(error).rstrip(".")))

    def order_by_start(self, *, apart: bool = False, has_dates: bool = True) -> None:
        """Put the recordings in the order of their first times, if all are known and differ.

        Then `ordered` is True, and `order` says so; otherwise nothing changes. With `apart` they
        must not overlap. If they do, or the times are no dates (`has_dates`), they stay as they
        are, and `order` says so if their times have another order.
        """
        in_order = sorted(self.recordings, key=lambda recording: recording.start or 0.0)
        starts = [r.start for r in in_order if r.start is not None]
        if len(set(starts)) < len(in_order) and has_dates:
            return
        spans = [(r.trace.shape[1] - 1) / (r.rate_hz or np.inf) for r in in_order]
        if not has_dates or (apart and (np.diff(starts) <= spans[:-1]).any()):
            is_other = any(a is not b for a, b in zip(in_order, self.recordings, strict=True))
            if is_other and self.order == "as the rows":
                self.order = "as the rows, not by their times"
            return
        self.ordered = True
        self.order = "by the dates of their clocks"
        self.recordings = in_order

    def check_label_words(self) -> None:
        """Raise DataError if too many labels are words whose meaning is unknown.

        Too many are more than the known labels, or more than a tenth of all if the known labels
        are all good or all bad. The error proposes a `label_map`.
        """
        labels = {recording.label for recording in self.recordings}
        n_known = len(self.recordings)
        is_one_sided = len(labels) == 1
        if sum(self.unknown_words.values()) <= (n_known / 9 if is_one_sided else n_known):
            return
        words = self.unknown_words
        label_map = label_map_of(words, labels, self.unlabelled_words)
        or_else = "" if is_one_sided else " or the other way round"
        do = f"say what they mean, label_map={label_map!r}{or_else}"
        if len(words) > MAX_LABEL_WORDS:
            where = "say where they are (label), or list them in a CSV file (labels)"
            do = f"so many are no labels: {where}"
        counts = self.unknown_words.most_common(4)
        actual = ", ".join(f"{shortened(word)} {n} times" for word, n in counts)
        if is_one_sided:
            actual += f" beside {n_known} {'good' if 1 in labels else 'bad'} ones"
        if self.unlabelled:
            n_all = n_known + len(self.faults) + self.unlabelled
            actual += f", and {self.unlabelled_text(n_all)}"
        wanted = f"labels in {self.name} {self.label_forms}"
        raise DataError(f"Expected {wanted}, got {actual}; {do}.")

    def leave_out(self, reasons: Mapping[int, str]) -> None:
        """Replace the recordings at these positions by faults with these messages.

        Raises DataError if no recording is left.
        """
        self.faults += [Fault(self.recordings[i].source, 0, why) for i, why in reasons.items()]
        self.recordings = [r for i, r in enumerate(self.recordings) if i not in reasons]
        if not self.recordings:
            n = len(self.faults) + self.unlabelled
            details = [str(fault) for fault in self.faults[:3]]
            if self.unlabelled:
                details.insert(0, self.unlabelled_text(n))
            wanted = f"labelled recordings in {self.name}"
            raise DataError(f"Expected {wanted}, found none of {n}: {'; '.join(details)}.")


def as_dataset(collector: RecordingCollector, options: LoadOptions) -> Dataset:
    """Make one data set of the recordings that were collected.

    They are converted to one unit and one length. A recording at another rate than most is a fault,
    or with `fit="resample"` is interpolated at the rate of the others. One of a length that cannot
    be fitted is a fault, unless `fit="pad-all"`; notes say how many are bad. The collector is
    changed: what does not fit moves to its faults.

    Raises
    ------
    DataError
        If no recording is left, too many labels are unknown words, or lengths differ under
        `fit="strict"`.
    """
    collector.check_label_words()
    _note_rows(collector)
    _note_reference_parts(collector)
    leave_out_repeats(collector)
    _cut_padding(collector)
    _scale_counts(collector)
    unit = _convert_to_one_unit(collector, options)
    whole = {recording.source: recording for recording in collector.recordings}
    _leave_out_overflows(collector)
    options, rate = _bring_to_one_rate(collector, options)
    lengths = np.array([r.trace.shape[1] for r in collector.recordings], dtype=np.int64)
    fit, samples = choose_fit(lengths, options.fit, options.samples)
    stretch = samples / float(np.median(lengths)) if fit == "resample" else 1.0
    _fit_odd_lengths(collector, samples, fit, keeps_all=options.fit == PAD_ALL)
    recordings = collector.recordings
    _note_scales(collector)
    if fit == "resample" and lengths.max() - lengths.min() > RATE_TOLERANCE * samples:
        text = f"{lengths.min()} to {lengths.max()} samples are stretched to {samples}"
        collector.notes[f"Recordings of {text}: the rate is that of their median length"] = 1
    X = np.stack([_fit_array(recording.trace, samples, fit) for recording in recordings])
    rates = np.array([recording.rate_hz or np.nan for recording in recordings])
    texts = [f"{text} ({n} times)" if n > 1 else text for text, n in collector.notes.items()]
    notes = [f"{text.removesuffix('.')}." for text in texts]
    if collector.unlabelled:
        n = len(recordings) + len(collector.faults) + collector.unlabelled
        notes.append(f"{collector.unlabelled_text(n)}: they are left out.")
    if not rate:
        notes.append(UNKNOWN_RATE)
    notes += unknown_unit_note(unit, collector.channels)
    notes += odd_labels_note(sum(recording.label for recording in recordings), len(recordings))
    first = whole[recordings[0].source]
    channel_units = split_unit(unit, len(first.trace))
    # A recording without a number is a part of its own.
    parts = [recording.part or recording.source for recording in recordings]
    has_parts = any(recording.part is not None for recording in recordings)
    if again := [part for part, n in Counter(parts).items() if n > 1]:
        plural = "parts have" if len(again) > 1 else "part has"
        notes.append(f"{len(again)} {plural} several recordings: {listed(again)}.")
    lengths_read = [recording.length or recording.trace.shape[1] for recording in recordings]
    return make_dataset(
        X[:, 0] if X.shape[1] == 1 else X,
        [recording.label for recording in recordings],
        name=collector.name,
        rate_hz=None if rate is None else float(f"{rate * stretch:.4g}"),
        fit=fit,
        part=np.array(parts) if has_parts else None,
        faults=tuple(collector.faults),
        channels=collector.channels,
        unit=unit,
        notes=tuple(notes),
        unlabelled=collector.unlabelled,
        ordered=collector.ordered,
        reading=describe_reading(
            [recording.reading for recording in recordings],
            [recording.label for recording in recordings],
            collector.order,
            describe_ends(first.source, first.trace, collector.channels, channel_units),
            rate_hz=options.rate_hz,
        ),
        source=np.array([recording.source for recording in recordings]),
        lengths=np.array(lengths_read, dtype=np.int64),
        rates=rates if np.isfinite(rates).any() else None,
    )


def _note_rows(collector: RecordingCollector) -> None:
    """Add notes on rows that came twice, and on times that are not used and go back."""
    name_of = {id(r): r.part or r.source for r in collector.recordings}
    repeated = [r for r in collector.recordings if r.repeated]
    if repeated:
        n = sum(r.repeated for r in repeated)
        names = listed(name_of[id(r)] for r in repeated)
        rows = f"{n} rows came twice and are" if n > 1 else "1 row came twice and is"
        parts = f"{len(repeated)} part{'s' if len(repeated) > 1 else ''}"
        collector.notes[f"{rows} read once, in {parts}: {names}"] = 1
    for column in sorted({r.goes_back for r in collector.recordings} - {""}):
        names = listed(name_of[id(r)] for r in collector.recordings if r.goes_back == column)
        text = f"Column {column} goes back, and rows stay as they are: {names}"
        collector.notes[f"{text}; time={column!r} uses it"] = 1


def _note_reference_parts(collector: RecordingCollector) -> None:
    """Add a note on parts that check the press and not the product, by a few words in names."""
    names = [recording.part or recording.source for recording in collector.recordings]
    found = [name for name in names if REFERENCE.search(name)]
    if 0 < len(found) < MAX_REFERENCE_SHARE * len(names):
        text = f"By their names these look like reference parts, and are read: {listed(found)}"
        collector.notes[f"{text}; take them out of the data, if they are"] = 1


def leave_out_repeats(collector: RecordingCollector) -> list[int]:
    """Leave out later recordings with the part, label and samples of another; a note names them.

    Equal samples with different labels are faults, each of which names all of them. Equal samples
    of different parts stay, with a note. Returns the positions of the recordings that stay. Raises
    DataError if none does.
    """
    recordings = collector.recordings
    reasons = dict[int, str]()
    repeats = list[int]()
    pairs = list[str]()
    names = [
        r.source if r.part in (None, r.source) else f"{r.source} ({r.part})" for r in recordings
    ]
    for equal in _equal_recordings(recordings):
        of_label: tuple[list[str], list[str]] = ([], [])
        for i, _ in equal:
            of_label[recordings[i].label].append(names[i])
        if all(of_label):
            actual = f"good in {listed(of_label[1])}, bad in {listed(of_label[0])}"
            why = f"Expected one label for the same samples, got {actual}; keep the right one"
            reasons |= {i: why for i, _ in equal}
            continue
        first_of = dict[str, int]()  # of each part
        repeats += [i for i, part in equal if first_of.setdefault(part, i) != i]
        first, *others = [names[i] for i in first_of.values()]
        pairs += [f"{other} as {first}" for other in others]
    if repeats:
        named = listed(recordings[i].part or recordings[i].source for i in sorted(repeats))
        are = "repeats of a recording are" if len(repeats) > 1 else "repeat of a recording is"
        text = f"{len(repeats)} {are} left out, of the same part, label and samples"
        collector.notes[f"{text}: {named}"] = 1
    if pairs:
        collector.notes[f"Equal to another recording, sample by sample: {listed(pairs)}"] = 1
    collector.leave_out(reasons)
    kept = sorted({*range(len(recordings))} - {*reasons, *repeats})
    collector.recordings = [recordings[i] for i in kept]
    return kept


def _equal_recordings(recordings: Sequence[Recording]) -> list[list[tuple[int, str]]]:
    """Return the groups of recordings with equal samples, by their positions and parts.

    Without a part's number a file's name tells the part, if all recordings of that name are equal.
    Constant recordings are in no group, those of fewer than `MANY` distinct values, as of a switch,
    only in one of their own part: others may be equal by chance.
    """
    contents = [hashlib.blake2b(recording.trace.tobytes()).digest() for recording in recordings]
    names = [PurePosixPath(recording.source).name for recording in recordings]
    n_contents = Counter(name for name, _ in set(zip(names, contents, strict=True)))
    n_equal = Counter(contents)
    groups = dict[tuple[bytes, str], list[tuple[int, str]]]()
    for i, (recording, content, name) in enumerate(zip(recordings, contents, names, strict=True)):
        n_values = len(np.unique(recording.trace)) if n_equal[content] > 1 else 0
        if n_values > 1:
            part = recording.part or (name if n_contents[name] == 1 else recording.source)
            key = "" if n_values >= MANY else part
            groups.setdefault((content, key), []).append((i, part))
    return [equal for equal in groups.values() if len(equal) > 1]


def _fit_odd_lengths(
    collector: RecordingCollector, samples: int, fit: str, *, keeps_all: bool
) -> None:
    """Make faults of the recordings whose length cannot be fitted, or with `keeps_all` fit them.

    A shorter one then repeats its last sample, a longer one is cut. Notes say how many there are,
    which are cut if `fit` is pad, and if most of those left out are bad.
    """
    recordings = collector.recordings
    lengths = [recording.trace.shape[1] for recording in recordings]
    odd = [i for i, n in enumerate(lengths) if not can_fit_length(n, samples, FITS.index(fit))]
    if cut := [
        f"{recordings[i].source} ({n})"
        for i, n in enumerate(lengths)
        if fit == "pad" and samples < SHORT * n and (keeps_all or i not in odd)
    ]:
        collector.notes[f"Of more samples only the first {samples} are read: {listed(cut)}"] = 1
    longer = [n for i, n in enumerate(lengths) if samples < LONG * n and i not in odd]
    if fit == "pad" and longer and not cut:
        text = f"Recordings that lose their ends: {len(longer)}, {max(longer) - samples}"
        text = f"{text} samples of {max(longer)} at most; samples={max(longer)} keeps them"
        collector.notes[text] = 1
    if keeps_all:
        for i in odd:
            positions = np.arange(samples).clip(max=lengths[i] - 1)
            length = recordings[i].length or lengths[i]
            trace = recordings[i].trace[:, positions]
            recordings[i] = recordings[i]._replace(trace=trace, length=length)
        if n_short := sum(lengths[i] < samples for i in odd):
            text = f"{n_short} shorter than half of {samples} samples repeat their last one"
            collector.notes[f"{text}; a live trace as short is verified"] = 1
        return
    n_bad = sum(recordings[i].label == 0 for i in odd)
    if 2 * n_bad > len(odd):
        text = f"{n_bad} of {len(odd)} recordings that are left out for their length are bad"
        collector.notes[f"{text}: fit={PAD_ALL!r} keeps them"] = 1
    wanted = f"Expected {_fit_text(samples, fit)}"
    do = f"fit={PAD_ALL!r} keeps it"
    collector.leave_out({i: f"{wanted}, got {lengths[i]}; {do}" for i in odd})


def _cut_padding(collector: RecordingCollector) -> None:
    """Cut trailing sentinel values, as -9999, off recordings; others make a recording a fault.

    There are two or more, in all channels, and they differ from all samples by at least the
    samples' range.
    """
    reasons = {}
    for i, recording in enumerate(collector.recordings):
        trace = recording.trace
        is_mark = np.asarray(np.isin(trace, MARKS_OF_MISSING).all(axis=0))
        if is_mark.sum() < 2 or is_mark.all():
            continue
        mark = trace[0, is_mark][0]
        samples = trace[:, ~is_mark]
        if np.abs(mark - samples).min() < np.ptp(samples):
            continue
        end = int(np.flatnonzero(~is_mark)[-1]) + 1
        if n_inside := int(is_mark[:end].sum()):
            reasons[i] = f"Expected measured samples, {n_inside} samples are {mark:g}"
        if end < trace.shape[1]:
            text = f"{mark:g} behind the last sample is left out, as what fills up a row"
            collector.notes[text] += 1
        collector.recordings[i] = recording._replace(trace=trace[:, :end])
    collector.leave_out(reasons)


def _leave_out_overflows(collector: RecordingCollector) -> None:
    """Make faults of the recordings in which an overflow mark, as 1000000, stands for samples.

    That is one value in several samples, `FAR` times larger than the peaks of most recordings.
    Recordings as large that are whole numbers where most have decimals are faults too: a
    spreadsheet that expects another decimal mark reads 12.345 as 12345.
    """
    with np.errstate(invalid="ignore"):
        peaks = np.array([np.nan_to_num(np.abs(r.trace)).max() for r in collector.recordings])
        largest = FAR * float(np.median(peaks))
        is_whole = [not (r.trace % 1 > 0).any() for r in collector.recordings]
        reasons = {}
        for i in np.flatnonzero((peaks > largest) & (largest > 0)):
            trace = collector.recordings[i].trace
            marks = trace[np.abs(trace) > largest]
            if len(marks) > 1 and len({*marks.tolist()}) == 1:
                actual = f"{len(marks)} samples are {marks[0]:g}, as of an overflow"
                reasons[int(i)] = f"Expected measured samples, {actual}"
            elif is_whole[i] and np.mean(is_whole) < 0.5:
                actual = f"got whole ones more than {FAR:g} times as large"
                do = "a spreadsheet may have dropped the decimal mark; export the file again"
                reasons[int(i)] = f"Expected numbers with decimals as in most, {actual}; {do}"
    collector.leave_out(reasons)


def _note_scales(collector: RecordingCollector) -> None:
    """Add notes to the collector about recordings that look odd beside the others.

    These are recordings whose largest value is far from that of most, so that their unit may be
    another, a few that are much shorter than most, and those that end in zeros, as a buffer does
    that was not filled. Another note says that all begin with the same sample, larger than all
    others, as a row of rates is.
    """
    with np.errstate(invalid="ignore"):
        peaks = np.array([np.nan_to_num(np.abs(r.trace)).max() for r in collector.recordings])
    firsts = {tuple(recording.trace[:, 0].tolist()) for recording in collector.recordings}
    is_first = all(
        (np.abs(r.trace[:, :1]) > np.abs(r.trace[:, 1:])).all() for r in collector.recordings
    )
    if len(firsts) == 1 and is_first and len(peaks) >= MANY:
        collector.notes["All begin with the same largest sample, which may be no measurement"] = 1
    lengths = np.array([recording.trace.shape[1] for recording in collector.recordings])
    is_short = lengths < SHORT * np.median(lengths)
    ends_in_zeros = np.array([not r.trace[:, -ZEROS:].any() for r in collector.recordings])
    ends_in_zeros &= (lengths > ZEROS) & (peaks > 0)
    usual = float(np.median(peaks))
    is_far = (usual > 0) & (peaks > 0) & ((peaks > FAR * usual) | (peaks * FAR < usual))
    far_text = f"{FAR:g} times larger or smaller than most, in another unit or not measured"
    for text, is_odd in (
        (far_text, is_far),
        ("Much shorter than most", is_short & (is_short.mean() < FEW)),
        ("The last samples are all 0, which may be no measurements", ends_in_zeros),
    ):
        if is_odd.any():
            names = [r.source for r, odd in zip(collector.recordings, is_odd, strict=True) if odd]
            collector.notes[f"{text}: {listed(names)}"] = 1


def _scale_counts(collector: RecordingCollector) -> None:
    """Make quantities of counts, by the factors that recordings state; notes, the first, say so.

    A recording that states none, where others do, becomes a fault.
    """
    recordings = collector.recordings
    stated = [recording.factors for recording in recordings]
    if not any(stated) or len({len(recording.trace) for recording in recordings}) > 1:
        return
    reasons = dict[int, str]()
    notes = Counter[str]()
    n = len(recordings[0].trace)
    for c in range(n):
        rows = [recording.trace[c][np.isfinite(recording.trace[c])] for recording in recordings]
        is_whole = all((row % 1 == 0).all() for row in rows)
        channel = collector.channels[c] if c < len(collector.channels) else "the channel"
        scale = scale_of(stated, channel, n, is_whole)
        if scale is None:
            continue
        notes[scale.note] = 1
        scaled = zip(recordings, scale.factors, scale.offsets, strict=False)
        for i, (recording, factor, offset) in enumerate(scaled):
            if not 0 < abs(factor) < np.inf:
                reasons[i] = f"Expected a factor of the counts of {channel}, got none"
            trace = recording.trace.copy()
            trace[c] = trace[c].astype(np.float64) * factor + offset
            of_channels = list(recording.units)
            if of_channels[c : c + 1] and of_channels[c] in COUNTS:
                of_channels[c] = ""
            recordings[i] = recording._replace(trace=trace, units=tuple(of_channels))
    collector.notes = notes + collector.notes
    collector.leave_out(reasons)


def _convert_to_one_unit(collector: RecordingCollector, options: LoadOptions) -> str:
    """Convert the recordings, channel by channel, and return the unit of all, or one for each.

    It is the unit that the user stated, else the one of most recordings, else a guess by the
    channels' names. A recording whose unit cannot be converted, or that states none although others
    do, becomes a fault. The collector is changed, and gets a note for each conversion.
    """
    recordings = collector.recordings
    n = max((len(recording.units) for recording in recordings), default=0)
    stated = split_unit(options.unit, n)
    targets = []
    for c in range(n):
        counts = Counter(r.units[c] for r in recordings if r.units and r.units[c])
        is_usual = 2 * counts.total() >= len(recordings)
        usual = max(counts, key=counts.__getitem__, default="") if is_usual else ""
        targets.append(stated[c] if units.parse(stated[c]) else usual)
    reasons = dict[int, str]()
    for i, recording in enumerate(recordings):
        factors = np.ones(max(n, 1))
        for c, (unit, target) in enumerate(zip(recording.units or [""] * n, targets, strict=True)):
            if unit == target or (not unit and stated[c]):
                continue
            channels = collector.channels
            name = channels[c] if c < len(channels) else f"channel {c + 1}"
            factor = units.factor(unit, target) if unit else None
            if factor is None:
                why = "as asked" if stated[c] else "as the others are"
                message = (
                    f"Expected {name} in {target or 'no unit'}, {why}, got {unit or 'no unit'}"
                )
                if not (unit and target):
                    do = f"state that of all, unit={unit or target!r}, or write it into each header"
                    message = f"{message}; {do}"
                reasons.setdefault(i, message)
                continue
            factors[c] = factor
            collector.notes[f"{name} is converted from {unit} to {target}, times {factor:g}"] += 1
        if (factors != 1).any():
            trace = (recording.trace * factors[:, None]).astype(np.float32)
            recordings[i] = recording._replace(trace=trace)
    collector.leave_out(reasons)
    if options.unit:
        return options.unit
    return _with_guesses(targets, collector)


def _with_guesses(stated: Sequence[str], collector: RecordingCollector) -> str:
    """Return the unit of all channels, or one for each; by their names where none is stated.

    A note names each channel whose name may tell a unit, or is a word for a force.
    """
    names = [*collector.channels, *[""] * (len(stated) - len(collector.channels))]
    guesses = [units.guess(name) for name in names]
    guesses[: len(stated)] = [unit or guess for unit, guess in zip(stated, guesses, strict=False)]
    for name, unit in zip(names, guesses, strict=True):
        if not unit and (word := units.maybe_unit(name)):
            do = "none is assumed, unit=... states it"
            collector.notes[f"The name {name} may tell a unit, {word}: {do}"] = 1
    given = [*stated, *[""] * len(names)]
    assumed = [name for name, unit in zip(names, given, strict=False) if not unit]
    for note in assumed_unit_notes(assumed):
        collector.notes[note] = 1
    return ", ".join(guesses if len(set(guesses)) > 1 else guesses[:1])


def assumed_unit_notes(channels: Iterable[str]) -> list[str]:
    """Return notes on channels whose unit is a guess by a word for a force, as Force or Kraft.

    The axes of a robot, as FZ_Base, are in newtons.
    """
    return [
        f"The unit N of {name} is assumed: unit='kN' would state another"
        for name in channels
        if units.guess(name) == "N" and not units.split(name)[1] and not FORCE_AXIS.fullmatch(name)
    ]


def unknown_unit_note(unit: str, channels: Sequence[str]) -> list[str]:
    """Return a note if the unit of channels is unknown, and no name may tell it."""
    channel_units = split_unit(unit, max(len(channels), 1))
    if "" not in channel_units or any(map(units.maybe_unit, channels)):
        return []
    names = [
        name for name, of_channel in zip(channels, channel_units, strict=False) if not of_channel
    ]
    of_channels = f" of {listed(names)}" if 0 < len(names) < len(channel_units) else ""
    return [f"The unit{of_channels} is unknown: unit=... states it."]


def odd_labels_note(n_good: int, n: int) -> list[str]:
    """Return a note if all of n labels are alike, or more than half are bad; empty otherwise."""
    if n < MANY or 2 * n_good >= n > n_good:
        return []
    odd = f"{n - n_good} of {n} recordings are bad"
    if n_good in (0, n):
        odd = f"No recording is {'bad' if n_good else 'good'}"
    return [f"{odd}: check how labels are read."]


def split_unit(unit: str | Sequence[str] | None, n: int) -> list[str]:
    """Return the unit of each of n channels.

    "kN, mm" or a list states one for each channel; any other text is the unit of all; None gives
    n times "".
    """
    items = unit.split(",") if isinstance(unit, str) else list(unit or ())
    if len(items) != n:
        items = [str(unit or "")] * n
    return [item.strip() for item in items]


def _bring_to_one_rate(
    collector: RecordingCollector, options: LoadOptions
) -> tuple[LoadOptions, float | None]:
    """Bring the recordings to one rate; return the options to fit them by, and the rate.

    Recordings at another rate than most become faults. With `fit="resample"`, where rates differ,
    only those at more than twice or less than half the median rate become faults, and the others
    are interpolated at one rate. If these last equally long, the returned options stretch them to
    one length, else they pad, so that equal sample numbers mean equal times. A recording without a
    clock is taken to have the rate of the others. If none has one, the rate is the stated one or
    None.
    """
    rates = np.array([recording.rate_hz or np.nan for recording in collector.recordings])
    clocked = rates[~np.isnan(rates)]
    if not len(clocked):
        return options, options.rate_hz
    if n_unknown := len(rates) - len(clocked):
        collector.notes["No clock is known, and the rate of the others is taken for it"] += (
            n_unknown
        )
    usual = float(max(clocked, key=lambda r: (np.abs(clocked - r) <= RATE_TOLERANCE * r).sum()))
    has_one_rate = (np.abs(clocked - usual) <= RATE_TOLERANCE * usual).all()
    lengths = [recording.trace.shape[1] for recording in collector.recordings]
    has_one_length = max(lengths) - min(lengths) <= RATE_TOLERANCE * max(lengths)
    is_strict = options.fit != "resample"
    if is_strict or (has_one_rate and (has_one_length or options.samples is not None)):
        wanted = f"timestamps at {usual:g} Hz, as the others have"
        do = "; fit='resample' puts all on one rate by their own times"
        do = "" if options.fit == "resample" else do
        others = np.flatnonzero(np.abs(rates - usual) > RATE_TOLERANCE * usual).tolist()
        collector.leave_out({i: f"Expected {wanted}, got {rates[i]:g} Hz{do}" for i in others})
        kept = [recording.rate_hz for recording in collector.recordings if recording.rate_hz]
        return options, float(np.median(kept))
    # Two digits, so that recordings that are added change neither the rate nor all samples.
    usual = usual if has_one_rate else float(f"{np.median(clocked):.2g}")
    is_far = (rates > MAX_RATE_RATIO * usual) | (rates * MAX_RATE_RATIO < usual)
    wanted = f"timestamps at about {usual:g} Hz"
    far = np.flatnonzero(is_far).tolist()
    collector.leave_out({i: f"Expected {wanted}, got {rates[i]:g} Hz" for i in far})
    return _resample(collector, options, usual)


def _resample(
    collector: RecordingCollector, options: LoadOptions, usual: float
) -> tuple[LoadOptions, float]:
    """Interpolate all recordings at one rate near `usual`, in the collector.

    Returns the options by which to fit them to one length, and the rate in hertz. With a stated
    number of samples it is the rate at which the median recording has as many.
    """
    recordings = collector.recordings
    rates = [recording.rate_hz or usual for recording in recordings]
    spans = [(r.trace.shape[1] - 1) / rate for r, rate in zip(recordings, rates, strict=True)]
    points = 1 + float(np.median(spans)) * usual
    samples = options.samples or round(points)
    is_near = abs(samples - points) <= RATE_TOLERANCE * points
    target = usual if is_near else usual * samples / points
    for i, (recording, rate, span) in enumerate(zip(recordings, rates, spans, strict=True)):
        length = recording.trace.shape[1]
        positions = np.arange(1 + int(span * target + 1e-6)) * (rate / target)
        rows = [np.interp(positions, np.arange(length), row) for row in recording.trace]
        trace = np.stack(rows).astype(np.float32)
        recordings[i] = recording._replace(trace=trace, length=recording.length or length)
    lengths = [recording.trace.shape[1] for recording in recordings]
    is_even = all(abs(length - samples) <= 1 + RATE_TOLERANCE * samples for length in lengths)
    how = "" if is_even else "; they do not last as long, so they are padded, not stretched"
    range_text = f"{min(rates):g} to {max(rates):g} Hz"
    note = f"Recordings at {range_text} are put on {target:.4g} Hz by their own times{how}"
    collector.notes[note] += 1
    return replace(options, samples=samples, fit="resample" if is_even else "pad"), target


def guess_unit(channels: Sequence[str]) -> str:
    """Return the unit of channels by `units.guess`, for people: one for all, or "N, N·m"; "" if
    it is unknown, as without names.
    """
    guesses = [units.guess(name) for name in channels] or [""]
    return guesses[0] if len(set(guesses)) == 1 else ", ".join(guesses)


def choose_fit(lengths: NDArray[np.int64], fit: str | None, samples: int | None) -> tuple[str, int]:
    """Choose how recordings are brought to one length, where the user did not state it.

    Parameters
    ----------
    lengths : array of int64, shape (n,)
    fit : str or None
        In `FITS`, or `PAD_ALL`, which is returned as "pad", if the user stated it.
    samples : int or None
        The length of all, if the user stated it.

    Returns
    -------
    fit : str
        The stated one. Else strict for equal lengths, unless other samples are stated; cut for
        stated samples that all have; else pad, which leaves each sample at its own time, and takes
        live traces that are a little shorter.
    samples : int
        The stated ones. Else the median length for pad and resample; for cut the shortest that is
        at least half of the median.

    Raises
    ------
    DataError
        If the lengths or the samples contradict a stated "strict".
    """
    low = int(lengths.min())
    high = int(lengths.max())
    median = int(np.median(lengths))
    fit = "pad" if fit == PAD_ALL else fit
    if fit is None:
        if low == high and samples in (None, low):
            fit = "strict"
        else:
            fit = "cut" if samples is not None and samples <= low else "pad"
    if fit == "strict" and low != high:
        do = "choose fit='pad', 'cut' or 'resample'"
        raise DataError(f"Expected recordings of one length, got {low} to {high} samples; {do}.")
    valid = fit != "strict" or samples in (None, low)
    expect_data(
        valid, f"{low} samples, as recorded, with fit='strict'", samples, "choose fit='cut'"
    )
    if samples is None:
        samples = int(lengths[2 * lengths >= median].min()) if fit == "cut" else median
    return fit, samples


def refit(data: Dataset, options: LoadOptions, *, has_unit: bool = True) -> Dataset:
    """Return a data set with the channels, unit, rate and length that the options state.

    The given one is not changed. A stated rate replaces the old one without interpolation.

    Parameters
    ----------
    data : Dataset
    options : LoadOptions
    has_unit : bool, default True
        Whether `data.unit` is known: it is then converted to a stated unit. False: the stated unit
        is that of the samples as they are.

    Raises
    ------
    DataError
        If a channel is not there, the unit cannot be converted, or the length cannot be fitted.
    """
    for name in options.channels:
        if name not in data.channels:
            have = ", ".join(data.channels) or "none that has a name"
            raise DataError(f"Expected the channel {name} in {data.name}, it has {have}.")
    if options.rate_hz is not None:
        data = replace(data, rate_hz=options.rate_hz)
    if options.channels and data.X.ndim == 3:
        data = _select_channels(data, options.channels)
    if options.unit is not None:
        is_known = has_unit and data.unit != ""
        data = _convert_unit(data, options.unit) if is_known else replace(data, unit=options.unit)
    if options.fit is None or options.fit == data.fit == "strict":
        return data if options.samples is None else data.cut(options.samples)
    length = data.X.shape[-1]
    lengths = np.array([length], dtype=np.int64)
    fit, samples = choose_fit(lengths, options.fit, options.samples)
    if not can_fit_length(length, samples, FITS.index(fit)):
        raise DataError(f"Expected {_fit_text(samples, fit)}, {data.name} has {length}.")
    stretch = samples / length if fit == "resample" else 1.0
    rate = None if data.rate_hz is None else data.rate_hz * stretch
    return replace(data, X=_fit_array(data.X, samples, fit), fit=fit, rate_hz=rate)


def _select_channels(data: Dataset, channels: tuple[str, ...]) -> Dataset:
    """Return a data set with the channels of these names alone, in this order, and their units.

    With one channel its X has the shape (n, T).
    """
    places = [data.channels.index(name) for name in channels]
    X = data.X[:, places[0]] if len(places) == 1 else data.X[:, places]
    all_units = split_unit(data.unit, data.X.shape[1])
    unit = data.unit if len(set(all_units)) == 1 else ", ".join(all_units[i] for i in places)
    return replace(data, X=np.ascontiguousarray(X), channels=channels, unit=unit)


def _convert_unit(data: Dataset, unit: str) -> Dataset:
    """Return a data set whose samples are converted to a unit, or to one for each channel.

    A note says so for each channel that changes. Raises DataError if no factor is known.
    """
    n = 1 if data.X.ndim == 2 else data.X.shape[1]
    sources = split_unit(data.unit, n)
    targets = split_unit(unit, n)
    factors = [units.factor(a, b) for a, b in zip(sources, targets, strict=True)]
    scales = [factor for factor in factors if factor is not None]
    if len(scales) < n:
        do = "leave unit out, or convert the samples first"
        raise DataError(f"Expected {data.name} in {unit}, its unit is {data.unit}; {do}.")
    if set(scales) == {1.0}:
        return replace(data, unit=unit)
    names = data.channels or [f"channel {c + 1}" for c in range(n)]
    notes = [
        f"{name} is converted from {source} to {target}, times {scale:g}."
        for name, source, target, scale in zip(names, sources, targets, scales, strict=True)
        if scale != 1.0
    ]
    X = data.X * np.array(scales).reshape(-1, 1)  # in float64
    return replace(data, X=X.astype(np.float32), unit=unit, notes=(*data.notes, *notes))


def _fit_array(x: NDArray[np.float32], samples: int, fit: str) -> NDArray[np.float32]:
    """Fit an array (..., T) to (..., samples) by `traces.fit_length`, as live traces are.

    Returns the same array if it has as many samples already.
    """
    if x.shape[-1] == samples:
        return x
    tensor = torch.from_numpy(np.array(x, order="C"))
    values: NDArray[np.float32] = fit_length(tensor, samples, FITS.index(fit)).numpy()
    return values


def _fit_text(samples: int, fit: str) -> str:
    """Return a text for an error: which lengths `fit` brings to `samples` samples."""
    if fit == "cut":
        return f"at least {samples} samples"
    return f"{(samples + 1) // 2} to {2 * samples} samples, to {fit} them to {samples}"
