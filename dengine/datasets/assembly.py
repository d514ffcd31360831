"""Makes a `Dataset` of the recordings that were collected: `as_dataset`.

It brings them to one unit, one rate and one length. What cannot be brought to them is left out as a
`Fault`, not made up. `refit` does the same for a `Dataset`.
"""

import hashlib
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import PurePosixPath

import numpy as np
import torch
from numpy.typing import NDArray

from ..errors import DataError, listed
from ..records import FITS
from ..traces import can_fit_length, fit_length
from . import units
from .clocks import MAX_LOST
from .collector import Recording, RecordingCollector, describe_reading
from .dataset import PAD_ALL, Dataset, LoadOptions, expect_data, make_dataset, split_unit
from .scales import COUNTS, scale_of

RATE_TOLERANCE = 0.03  # of the others' rate: recordings within it have one rate
ZEROS = 10  # that many samples of 0 at the end of a recording may be no measurements
MANY = 10  # recordings, among which both labels are expected
SHORT = 0.7  # of the usual length: recordings below it may be pieces, if they are few
LONG = 0.95  # of a recording: a note says if less of one is read
FEW = 0.1  # of all recordings
FAR = 50.0  # times the usual largest value: a recording beyond has another unit or is none
MAX_RATE_RATIO = 5.0  # a recording at a rate further from the others' is not resampled
REFERENCE = re.compile(  # in the name of a part with which the station itself is checked
    r"(?<![^\W\d_])((master|meister|einstell|referen[cz]e?|kalibrier|calibration|grenzmuster"
    r"|golden)(part|teil|sample|stück|muster|ungs?teil)?|ref|dummy|einstellmeister)(?![^\W\d_])",
    re.IGNORECASE,
)
MAX_REFERENCE_SHARE = 0.25  # of all parts
UNKNOWN_RATE = (
    "The rate is unknown, for nothing tells it: times are in samples until it is stated,"
    " rate_hz=..."
)
MARKS_OF_MISSING = [s * m for s in (-1, 1) for m in (999, 9999, 99999, 999999)]


def describe_ends(
    source: str, trace: NDArray[np.float32], channels: Sequence[str], all_units: Sequence[str]
) -> str:
    """Return in words the first and last value of each channel of a trace (C, T), and its length.

    source : the file or row of the trace. all_units : one for each channel.
    """
    rows = zip(channels or [""] * len(trace), trace, all_units, strict=True)
    texts = (f"{name} {row[0]:.6g} to {row[-1]:.6g} {unit}".strip() for name, row, unit in rows)
    return f"{source}: {listed(texts)} in {trace.shape[1]} samples"


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
    _interpolate_gaps(collector, options)
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
    references = [name for name in names if REFERENCE.search(name)]
    if 0 < len(references) < MAX_REFERENCE_SHARE * len(names):
        text = f"By their names these look like reference parts, and are read: {listed(references)}"
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
    longer = [n for i, n in enumerate(lengths) if samples < n and i not in odd]
    if fit == "pad" and not cut and samples < LONG * max(longer, default=0):
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


def _interpolate_gaps(collector: RecordingCollector, options: LoadOptions) -> None:
    """Interpolate gaps of up to `MAX_LOST` consecutive NaN linearly, if `fit="resample"`.

    Each channel is filled by itself. Longer gaps, and those at an end, stay NaN. The recordings of
    the collector are replaced, and a note counts the filled values.
    """
    if options.fit != "resample":
        return
    n_filled = 0
    for i, recording in enumerate(collector.recordings):
        if not np.isnan(recording.trace).any():
            continue
        trace = recording.trace.copy()
        for row in trace:
            edges = np.diff(np.isnan(row), prepend=False, append=False)
            for begin, end in np.flatnonzero(edges).reshape(-1, 2):
                if begin > 0 and end < len(row) and end - begin <= MAX_LOST:
                    row[begin:end] = np.linspace(row[begin - 1], row[end], end - begin + 2)[1:-1]
                    n_filled += int(end - begin)
        collector.recordings[i] = recording._replace(trace=trace)
    if n_filled:
        text = f"{n_filled} missing samples are interpolated, up to {MAX_LOST} on end"
        collector.notes[text] = 1


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
    assumed = [name for name, unit in zip_longest(names, stated) if not unit]
    for note in assumed_unit_notes(assumed):
        collector.notes[note] = 1
    return ", ".join(guesses if len(set(guesses)) > 1 else guesses[:1])


def assumed_unit_notes(channels: Iterable[str]) -> list[str]:
    """Return a note for each channel whose unit N is assumed from a word, as Force or Kraft.

    There is none for a channel that states its unit, nor for a robot's axis, as FZ_Base or
    wrench.force.z: these are in newtons.
    """
    return [
        f"The unit N of {name} is assumed: unit='kN' would state another."
        for name in channels
        if units.guess(name) == "N"
        and not units.split(name)[1]
        and not units.FORCE_AXIS.fullmatch(name)
    ]


def unknown_unit_note(unit: str, channels: Sequence[str]) -> list[str]:
    """Return a note that names the channels without a unit, as a list; empty if there is none.

    It is empty too if the name of any channel has a word that may be a unit, as kN_force.
    """
    channel_units = split_unit(unit, max(len(channels), 1))
    if "" not in channel_units or any(map(units.maybe_unit, channels)):
        return []
    names = [
        name for name, of_channel in zip(channels, channel_units, strict=False) if not of_channel
    ]
    of_channels = f" of {listed(names)}" if len(names) < len(channels) else ""
    return [f"The unit{of_channels} is unknown: unit=... states it."]


def odd_labels_note(n_good: int, n: int) -> list[str]:
    """Return a note if all of n labels are alike, or more than half are bad; empty otherwise."""
    if n < MANY or 2 * n_good >= n > n_good:
        return []
    odd = f"{n - n_good} of {n} recordings are bad"
    if n_good in (0, n):
        odd = f"No recording is {'bad' if n_good else 'good'}"
    return [f"{odd}: check how labels are read."]


def _bring_to_one_rate(
    collector: RecordingCollector, options: LoadOptions
) -> tuple[LoadOptions, float | None]:
    """Bring the recordings to one rate; return the options to fit them by, and the rate.

    Recordings at another rate than most become faults. With `fit="resample"`, where rates differ,
    only those at more than five times or less than a fifth of the median rate become faults, and
    the others are interpolated at one rate. If these last equally long, the returned options
    stretch them to one length, else they pad, so that equal sample numbers mean equal times. A
    recording without a clock is taken to have the rate of the others. If none has one, the rate is
    the stated one or None.
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
        is_helped = is_strict & ~_is_far(rates, usual)
        others = np.flatnonzero(np.abs(rates - usual) > RATE_TOLERANCE * usual).tolist()
        reasons = {i: f"Expected {wanted}, got {rates[i]:g} Hz" for i in others}
        collector.leave_out({i: why + (do if is_helped[i] else "") for i, why in reasons.items()})
        kept = [recording.rate_hz for recording in collector.recordings if recording.rate_hz]
        return options, float(np.median(kept))
    # Two digits, so that recordings that are added change neither the rate nor all samples.
    usual = usual if has_one_rate else float(f"{np.median(clocked):.2g}")
    wanted = f"timestamps at {usual / MAX_RATE_RATIO:g} to {usual * MAX_RATE_RATIO:g} Hz"
    far = np.flatnonzero(_is_far(rates, usual)).tolist()
    collector.leave_out({i: f"Expected {wanted}, got {rates[i]:g} Hz" for i in far})
    return _resample(collector, options, usual)


def _is_far(rates: NDArray[np.float64], usual: float) -> NDArray[np.bool_]:
    """Return which recordings are at a rate too different from the usual one to be resampled."""
    return (rates > MAX_RATE_RATIO * usual) | (rates * MAX_RATE_RATIO < usual)


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
