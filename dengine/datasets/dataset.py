"""`Dataset`, labelled traces of one shape in memory, and `LoadOptions`, those of `load_dataset`.

What is wrong with a recording that is left out is a `Fault`.
"""

import codecs
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import DataError, TraceError, expect, instead, shortened
from ..records import FITS, TraceSpec
from ..representation import to_html
from ..traces import as_traces

if TYPE_CHECKING:
    import pandas as pd

LABEL_FORMS = "as True/False, OK/NOK, pass/fail or 1/0"
# A range of numbered names, as c0..c498.
NAME_RANGE = re.compile(r"(?P<name>[^\W\d]\w*?)(?P<first>\d{1,5})\.\.(?P=name)(?P<last>\d{1,5})")
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
    unit : str, default ""
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
    unit: str = ""
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

        Its rate and units are unknown where those of the data set are.
        """
        return TraceSpec(
            self.X.shape[-1],
            self.rate_hz,
            channels=1 if self.X.ndim == 2 else self.X.shape[1],
            unit=self.unit,
            fit=self.fit,
            columns=self.channels,
        )

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


def split_unit(unit: str | Sequence[str] | None, n: int) -> list[str]:
    """Return the unit of each of n channels.

    "kN, mm" or a list states one for each channel; any other text is the unit of all; None gives
    n times "".
    """
    items = unit.split(",") if isinstance(unit, str) else list(unit or ())
    if len(items) != n:
        items = [str(unit or "")] * n
    return [item.strip() for item in items]
