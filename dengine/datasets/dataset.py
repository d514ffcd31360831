"""A data set in memory: labelled traces of one form, what is known of them, and what could not be read.

Recordings of whatever length become one block of traces honestly: what cannot be fitted is a fault, not made up.
"""

import os
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from ..errors import DataError, TraceError, expect, shortened
from ..records import FITS, TraceSpec
from ..representation import to_html
from ..traces import as_traces, can_fit_length, fit_length
from . import units

if TYPE_CHECKING:
    import pandas as pd

NEAR = 0.03  # of the others' rate
MOST_APART = 2.0  # times the others' rate: so far a recording is resampled
UNKNOWN_RATE = "The rate is unknown, for nothing tells it: times are in samples until it is stated, rate_hz=..."
MOST_WORDS = 12  # that somebody says the meaning of
must = partial(expect, error=DataError)


@dataclass(frozen=True, slots=True)
class Fault:
    """A recording that was left out.

    source : the file, as seen from the folder; or what the rows are of.  line : in the file, or row of a table, from 1;
    0 where it is the whole.  what : what was expected, and what came.
    """

    source: str
    line: int
    what: str

    def __str__(self) -> str:
        return f"{self.source}, line {self.line}: {self.what}" if self.line else f"{self.source}: {self.what}"


class UnreadableError(DataError):
    """Why one recording is left out; becomes its `Fault`. line : of its file, 0 where it is the whole."""

    def __init__(self, what: str, line: int = 0) -> None:
        super().__init__(what)
        self.line = line


class UnknownWordError(UnreadableError):
    """A label in a word that nobody said the meaning of."""

    def __init__(self, word: str) -> None:
        super().__init__(f"Expected a label, as True/False, OK/NOK, pass/fail or 1/0, got {shortened(word)}")
        self.word = word


class UnlabelledError(UnreadableError):
    """A recording that nobody has checked yet: it is counted, and left out."""


@dataclass(frozen=True, slots=True, repr=False)
class Dataset:
    """Labelled traces in the order they were recorded.

    X : (n, T) or (n, C, T) float32.  y : (n,) int8, 1 = success, 0 = failure.
    name, unit : for people.  rate_hz : of the samples; None: nothing tells it.
    cause : (n,) why a part failed, where that is known.
    part : (n,) the number of the part that each trace was recorded on; None: every trace is a part of its own.
    faults : what could not be read and was left out.  channels : the channels' names, where they have any.
    notes : what was found about the files, and is no fault.
    source : (n,) the file, or row, that each trace came from.  fit : how other lengths became T, as in `TraceSpec`.
    lengths : (n,) samples as recorded.  rates : (n,) hertz, from each recording's own timestamps.
    unlabelled : recordings that were left out since nobody has checked them yet: their label is empty.
    ordered : whether the order says what was recorded first; that of the files in `good/` and `bad/` does not.
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

    def __len__(self) -> int:
        return len(self.y)

    def __repr__(self) -> str:
        good, names = int(self.y.sum()), f" of {', '.join(self.channels)}" if self.channels else ""
        rate = "an unknown rate" if self.rate_hz is None else f"{self.rate_hz:g} Hz"
        form = f"{' x '.join(map(str, self.X.shape[1:]))} samples{names} at {rate}"
        known = f"{good} good, {len(self) - good} bad, {self.unlabelled} unlabelled, {len(self.faults)} left out"
        return f"<Dataset {self.name}: {len(self)} traces, {form}, {known}>"

    _repr_html_ = to_html

    @property
    def spec(self) -> TraceSpec:
        """The contract by which a live engine takes traces of the same form, `DataEngine(trace=data.spec)`.

        Where the rate is unknown, it has that of a `TraceSpec` by default: state `rate_hz` before times matter.
        """
        n_channels = 1 if self.X.ndim == 2 else self.X.shape[1]
        spec = TraceSpec(self.X.shape[-1], channels=n_channels, unit=self.unit, fit=self.fit, columns=self.channels)
        return spec if self.rate_hz is None else replace(spec, rate_hz=self.rate_hz)

    def to_frame(self) -> "pd.DataFrame":
        """A row a trace: `label`, `part` and `cause` where known, and `FZ_0 ...`, a column a sample of each channel.

        `data.to_frame().to_parquet("data.parquet")` writes what `load_dataset` reads.
        """
        import pandas as pd

        X = self.X if self.X.ndim == 3 else self.X[:, None]
        channels = self.channels or ("x",) if X.shape[1] == 1 else self.channels or [f"x{c}" for c in range(X.shape[1])]
        names = [f"{name}_{i}" for name in channels for i in range(X.shape[2])]
        known = {"label": self.y, "part": self.part, "cause": self.cause}
        about = pd.DataFrame({name: values for name, values in known.items() if values is not None})
        return pd.concat([about, pd.DataFrame(X.reshape(len(X), -1), columns=names)], axis=1)

    def cut(self, samples: int) -> "Dataset":
        """The first `samples` samples of every trace: an earlier, harder moment to decide at."""
        have = self.X.shape[-1]
        must(1 <= samples <= have, f"1 to {have} samples of {self.name}", samples)
        must(samples == have or self.fit != "resample", f"{have} samples of {self.name}, which was resampled", samples)
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
    """A `Dataset` from arrays; DataError where they do not fit together."""
    try:
        X, y = as_traces(X)[:, 0] if np.ndim(X) == 2 else as_traces(X), np.asarray(y)
    except TraceError as error:
        raise DataError(str(error)) from error
    must(y.shape == X.shape[:1], "X (n, T) or (n, C, T) with n labels", (X.shape, y.shape))
    must(len(y) > 0, "at least one trace", 0)
    turned = X.ndim == 3 and X.shape[1] > X.shape[2]
    must(not turned, "X (n, channels, samples)", X.shape, "it looks transposed; pass X.transpose(0, 2, 1)")
    must(bool(np.isin(y, (0, 1)).all()), "labels 1 (success) and 0 (failure)", sorted(set(map(str, y.tolist()))))
    must(rate_hz is None or 0 < rate_hz < np.inf, "a rate above 0 Hz", rate_hz)
    n_channels = 1 if X.ndim == 2 else X.shape[1]
    must(not channels or len(channels) == n_channels, f"a name for each of {n_channels} channels", channels)
    if part is not None:
        part = np.asarray(part)
        fit = part.shape == y.shape and part.dtype.kind in "iuUS"
        must(fit, f"{len(y)} parts' numbers, texts or integers", (part.shape, part.dtype))
        part = part.astype(np.str_)
    must(cause is None or np.shape(cause) == y.shape, f"{len(y)} causes, one a trace", np.shape(cause))
    return Dataset(X, y.astype(np.int8), rate_hz=rate_hz, channels=channels, part=part, cause=cause, **about)


@dataclass(frozen=True, slots=True)
class Asked:
    """The options of `load_dataset`, under their names; `channels` are those of `channel`, taken apart."""

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
    words: Mapping[str, bool] = field(default_factory=dict)
    columns: tuple[str, ...] = ()
    decimal: str | None = None
    thousands: str | None = None

    def __post_init__(self) -> None:
        if self.label is not None and self.labels is not None:
            raise DataError("Expected a pattern of the labels (label) or a file of them (labels), got both; leave one out.")
        must(self.fit in (None, *FITS), f"fit to be one of {', '.join(FITS)}", self.fit)
        must(self.rate_hz is None or self.rate_hz > 0, "a rate above 0 Hz", self.rate_hz)
        must(self.samples is None or self.samples >= 1, "1 or more samples", self.samples)
        must(len(set(self.channels)) == len(self.channels), "each channel once", self.channels)
        must(len(set(self.columns)) == len(self.columns), "each of the columns once", self.columns)
        must(self.decimal in (None, ".", ","), "a decimal mark, '.' or ','", self.decimal)
        marks = (None, ".", ",", "'", "’", " ", "")
        apart = self.thousands in marks and (not self.thousands or self.thousands != self.decimal)
        must(apart, "a mark of thousands, ',', '.', ' ' or an apostrophe, that is not the decimal one", self.thousands)


def names_of(channel: str | Sequence[str] | None) -> tuple[str, ...]:
    """`"FZ_Base,FX_Base"`, or a list of names, one by one."""
    listed = channel.split(",") if isinstance(channel, str) else channel or ()
    return tuple(name.strip() for name in listed if name.strip())


class Recorded(NamedTuple):
    """One recording as it was read.

    trace : (C, T) float32.  rate_hz : by its own timestamps, where it has any.  units : of its channels, "" where one's is
    not told.  length : samples as recorded, where the trace has others by now.
    """

    trace: NDArray[np.float32]
    label: int
    source: str
    part: str | None = None
    rate_hz: float | None = None
    units: tuple[str, ...] = ()
    length: int = 0


@dataclass
class Collected:
    """Recordings, in order, and what could not be read."""

    name: str
    channels: tuple[str, ...]
    faults: list[Fault] = field(default_factory=list)
    read: list[Recorded] = field(default_factory=list)
    notes: Counter[str] = field(default_factory=Counter)  # what was found that is no fault, and how many times
    unknown: Counter[str] = field(default_factory=Counter)  # words for labels
    beside: str = ""  # a file that may list labels, as an error advises
    unlabelled: int = 0
    ordered: bool = True

    def take(self, source: str, read: Callable[[], Recorded], line: int = 0) -> None:
        """Add what is read, or the fault for which it is left out. line : of the source, where it is known before."""
        try:
            self.read.append(read())
        except UnlabelledError:
            self.unlabelled += 1
        except (OSError, TraceError, UnreadableError) as error:
            if isinstance(error, UnknownWordError):
                self.unknown[error.word] += 1
            self.faults.append(Fault(source, line or getattr(error, "line", 0), str(error).rstrip(".")))

    def must_mean_something(self) -> None:
        """Raise DataError if more labels are unknown words than known labels, or if all known labels are of one kind and
        more than a tenth of all are unknown words.
        """
        kinds, n = {each.label for each in self.read}, sum(self.unknown.values())
        if n <= (len(self.read) / 9 if len(kinds) == 1 else len(self.read)):
            return
        words = [word for word, _ in self.unknown.most_common()]
        # The one with a syllable before it is more often the bad one; a person has to say so.
        bad = {word for word in words if any(word != other and word.endswith(other) for other in words)} or {*words[1:]}
        bad = bad if len(kinds) != 1 else {*words} if 1 in kinds else set()
        said = ",".join(f"{word}={'bad' if word in bad else 'good'}" for word in words)
        do = f"say what they mean, label_map={said!r}{'' if len(kinds) == 1 else ' or the other way round'}"
        if len(words) > MOST_WORDS:
            do = "so many are no labels: say where they are (label), or list them in a CSV file (labels)"
        got = ", ".join(f"{shortened(word)} {times} times" for word, times in self.unknown.most_common(4))
        beside = f" beside {len(self.read)} {'good' if 1 in kinds else 'bad'} ones" if len(kinds) == 1 else ""
        raise DataError(f"Expected labels in {self.name} as True/False, OK/NOK, pass/fail or 1/0, got {got}{beside}; {do}.")

    def leave_out(self, why: Mapping[int, str]) -> None:
        """Make faults of those at these places; DataError where nothing is left."""
        self.faults.extend(Fault(self.read[i].source, 0, what) for i, what in why.items())
        self.read = [each for i, each in enumerate(self.read) if i not in why]
        if not self.read:
            n, few = len(self.faults), "; ".join(map(str, self.faults[:3]))
            if self.unlabelled:
                few = f"{self.unlabelled} have no label yet{few and '; '}{few}"
            raise DataError(f"Expected labelled recordings in {self.name}, found none of {n + self.unlabelled}: {few}.")


def as_dataset(found: Collected, asked: Asked) -> Dataset:
    """One data set of all that can be fitted; DataError where nothing can.

    A recording at another rate than the others is another trace of the same insertion: it is a fault, or with
    `fit="resample"` is put on the others' rate.  One in another unit is converted, or a fault.
    """
    found.must_mean_something()
    unit = _in_one_unit(found, asked)
    asked, rate = _at_one_rate(found, asked)
    lengths = np.array([each.trace.shape[1] for each in found.read], dtype=np.int64)
    fit, samples = form_of(lengths, asked.fit, asked.samples)
    stretch = samples / float(np.median(lengths)) if fit == "resample" else 1.0
    unfit = [i for i, have in enumerate(lengths.tolist()) if not can_fit_length(have, samples, FITS.index(fit))]
    found.leave_out({i: f"Expected {_wanted(samples, fit)}, got {lengths[i]}" for i in unfit})
    block = np.stack([_fitted(each.trace, samples, fit) for each in found.read])
    rates = np.array([each.rate_hz or np.nan for each in found.read])
    notes = [f"{text}{f' ({n} times)' if n > 1 else ''}." for text, n in found.notes.items()]
    if found.unlabelled:
        seen = len(found.read) + len(found.faults) + found.unlabelled
        notes.append(f"{found.unlabelled} of {seen} recordings of {found.name} have no label yet: they are left out.")
    parts = [each.part or each.source for each in found.read]  # without a number it is a part of its own
    return make_dataset(
        block[:, 0] if block.shape[1] == 1 else block,
        [each.label for each in found.read],
        name=found.name,
        rate_hz=None if rate is None else float(f"{rate * stretch:.4g}"),
        fit=fit,
        part=np.array(parts) if any(each.part is not None for each in found.read) else None,
        faults=tuple(found.faults),
        channels=found.channels,
        unit=unit,
        notes=tuple(notes if rate else [*notes, UNKNOWN_RATE]),
        unlabelled=found.unlabelled,
        ordered=found.ordered,
        source=np.array([each.source for each in found.read]),
        lengths=np.array([each.length or each.trace.shape[1] for each in found.read], dtype=np.int64),
        rates=rates if np.isfinite(rates).any() else None,
    )


def _in_one_unit(found: Collected, asked: Asked) -> str:
    """Convert recordings to the unit of most, or to the one that was asked for, a channel at a time; returns the units.

    A recording whose unit cannot be converted, or that states none although others do, becomes a fault.
    """
    n = max((len(each.units) for each in found.read), default=0)
    stated = asked.unit.split(",") if asked.unit and len(asked.unit.split(",")) == n else [asked.unit or ""] * n
    wanted = [Counter(filter(None, (each.units[c] for each in found.read if each.units))) for c in range(n)]
    most = [counts if 2 * counts.total() >= len(found.read) else Counter[str]() for counts in wanted]
    usual = [max(counts, key=counts.__getitem__, default="") for counts in most]
    usual = [told.strip() if units.parse(told.strip()) else most for told, most in zip(stated, usual, strict=True)]
    why = dict[int, str]()
    for i, recording in enumerate(found.read):
        factors = np.ones(max(n, 1))
        for c, (unit, want) in enumerate(zip(recording.units or [""] * n, usual, strict=True)):
            name = found.channels[c] if c < len(found.channels) else f"channel {c + 1}"
            if unit == want or (not unit and stated[c]):
                continue
            factor = units.factor(unit, want) if unit else None
            if factor is None:
                got = f"as {'asked' if stated[c] else 'the others are'}, got {unit or 'no unit'}"
                do = "" if unit and want else f"; state that of all, unit={unit or want!r}, or write it into each header"
                why.setdefault(i, f"Expected {name} in {want or 'no unit'}, {got}{do}")
                continue
            factors[c] = factor
            found.notes[f"{name} is converted from {unit} to {want}, times {factor:g}"] += 1
        if (factors != 1).any():
            trace = (recording.trace * factors[:, None]).astype(np.float32)
            found.read[i] = recording._replace(trace=trace)
    found.leave_out(why)
    if asked.unit or not any(usual):
        return asked.unit or _unit_of(found.channels)
    known = [want or _unit_of(found.channels[c : c + 1]) for c, want in enumerate(usual)]
    return known[0] if len(set(known)) == 1 else ", ".join(known)


def _at_one_rate(found: Collected, asked: Asked) -> tuple[Asked, float | None]:
    """Leave out recordings at another rate than the others, or resample all; returns how to fit them, and the rate.

    If all resampled recordings last equally long, they are stretched to one length. Otherwise they are padded, so that
    equal sample numbers mean equal times.
    """
    rates = np.array([each.rate_hz or np.nan for each in found.read])
    known = rates[~np.isnan(rates)]
    if not len(known):
        return asked, asked.rate_hz
    if silent := len(rates) - len(known):
        found.notes["No clock is known, and the rate of the others is taken for it"] += silent
    usual = float(max(known, key=lambda one: (np.abs(known - one) <= NEAR * one).sum()))
    if asked.fit != "resample" or not (np.abs(known - usual) > NEAR * usual).any():
        off = np.flatnonzero(np.abs(rates - usual) > NEAR * usual).tolist()
        do = "" if asked.fit == "resample" else "; fit='resample' puts all on one rate by their own times"
        wanted = f"Expected timestamps at {usual:g} Hz, as the others have"
        found.leave_out({i: f"{wanted}, got {rates[i]:g} Hz{do}" for i in off})
        kept = [each.rate_hz for each in found.read if each.rate_hz]
        return asked, float(np.median(kept))
    usual = float(f"{np.median(known):.2g}")  # two digits: recordings that are added do not move it, nor all samples
    off = np.flatnonzero((rates > MOST_APART * usual) | (rates * MOST_APART < usual)).tolist()
    found.leave_out({i: f"Expected timestamps at about {usual:g} Hz, got {rates[i]:g} Hz" for i in off})
    have = [each.rate_hz or usual for each in found.read]
    spans = [(each.trace.shape[1] - 1) / rate for each, rate in zip(found.read, have, strict=True)]
    points = 1 + float(np.median(spans)) * usual
    samples = asked.samples or round(points)
    rate = usual if abs(samples - points) <= NEAR * points else usual * samples / points
    for i, (each, own, span) in enumerate(zip(found.read, have, spans, strict=True)):
        at = np.arange(1 + int(span * rate + 1e-6)) * (own / rate)
        trace = np.stack([np.interp(at, np.arange(len(x)), x) for x in each.trace]).astype(np.float32)
        found.read[i] = each._replace(trace=trace, length=each.trace.shape[1])
    alike = all(abs(each.trace.shape[1] - samples) <= 1 + NEAR * samples for each in found.read)
    low, high = min(have), max(have)
    how = "" if alike else "; they do not last as long, so they are padded, not stretched"
    found.notes[f"Recordings at {low:g} to {high:g} Hz are put on {rate:.4g} Hz by their own times{how}"] += 1
    return replace(asked, samples=samples, fit="resample" if alike else "pad"), rate


def _unit_of(channels: Sequence[str]) -> str:
    """For people: newtons, newton metres by the names that UR cells give torques, or both."""
    units = {"N·m" if re.match(r"(mu?|t)[xyz](_|$)", name.lower()) else "N" for name in channels} or {"N"}
    return units.pop() if len(units) == 1 else "mixed units"


def form_of(lengths: NDArray[np.int64], fit: str | None, samples: int | None) -> tuple[str, int]:
    """The fit and the samples that lengths (n,) are brought to, where they were not both asked for.

    Of one length: strict. With `samples` that all have: cut. Else pad to the median: what was measured stays as it was, at
    its own time, and a live trace that is a little shorter is taken too. Cut goes to the shortest that is not half of the
    others.
    """
    low, high, median = int(lengths.min()), int(lengths.max()), int(np.median(lengths))
    if fit is None:
        alike = low == high and samples in (None, low)
        fit = "strict" if alike else "cut" if samples is not None and samples <= low else "pad"
    if fit == "strict" and low != high:
        choose = "choose fit='pad', 'cut' or 'resample'"
        raise DataError(f"Expected recordings of one length, got {low} to {high} samples; {choose}.")
    as_recorded = fit != "strict" or samples in (None, low)
    must(as_recorded, f"{low} samples, as recorded, with fit='strict'", samples, "choose fit='cut'")
    if samples is None:
        samples = int(lengths[2 * lengths >= median].min()) if fit == "cut" else median
    return fit, samples


def refit(data: Dataset, asked: Asked) -> Dataset:
    """A data set whose traces have one length already, as it was asked for: its channels by name, its length, its rate."""
    for name in (name for name in asked.channels if name not in data.channels):
        have = ", ".join(data.channels) or "none that has a name"
        raise DataError(f"Expected the channel {name} in {data.name}, it has {have}.")
    if asked.rate_hz is not None or asked.unit is not None:
        data = replace(data, rate_hz=asked.rate_hz or data.rate_hz, unit=asked.unit or data.unit)
    if asked.channels and data.X.ndim == 3:
        places = [data.channels.index(name) for name in asked.channels]
        X = np.ascontiguousarray(data.X[:, places[0]] if len(places) == 1 else data.X[:, places])
        data = replace(data, X=X, channels=asked.channels)
    if asked.fit is None or asked.fit == data.fit == "strict":
        return data if asked.samples is None else data.cut(asked.samples)
    have = data.X.shape[-1]
    fit, samples = form_of(np.array([have], dtype=np.int64), asked.fit, asked.samples)
    if not can_fit_length(have, samples, FITS.index(fit)):
        raise DataError(f"Expected {_wanted(samples, fit)}, {data.name} has {have}.")
    stretch = samples / have if fit == "resample" else 1.0
    rate = None if data.rate_hz is None else data.rate_hz * stretch
    return replace(data, X=_fitted(data.X, samples, fit), fit=fit, rate_hz=rate)


def _fitted(x: NDArray[np.float32], samples: int, fit: str) -> NDArray[np.float32]:
    """(..., T) -> (..., samples), by what fits live traces too."""
    if x.shape[-1] == samples:
        return x
    values: NDArray[np.float32] = fit_length(torch.from_numpy(np.array(x, order="C")), samples, FITS.index(fit)).numpy()
    return values


def _wanted(samples: int, fit: str) -> str:
    if fit == "cut":
        return f"at least {samples} samples"
    return f"{(samples + 1) // 2} to {2 * samples} samples, to {fit} them to {samples}"
