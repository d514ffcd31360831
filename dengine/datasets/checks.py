"""Checks on a description before anything is read, and on the recordings that were read.

Recordings with equal samples and different labels are faults, and so is each repeat of a recording.
`tolerance_note` compares the tolerance of a policy with the share of bad parts.
"""

from collections import defaultdict
from collections.abc import Sequence
from zoneinfo import ZoneInfo

import numpy as np

from ..errors import DataError, instead, listed, percent
from ..folds import content_hash
from .dataset import LEAST_RATE_HZ, MOST_RATE_HZ, Dataset, Fault, Faults, expect_all
from .description import SOURCES, Clock, Description, TextForm
from .table import Recording


def check_description(description: Description) -> None:
    """Raise DataError unless recordings can be read by a description; no file is looked at.

    A description says how recordings are read. No key may have the value `?` (not known yet),
    except in `[ignored]` and `[[check]]`. The number of samples of a trace must be 1 or more. There
    must be a channel, and all channels must have the same `limit`, the range of the sensor. If the
    `order` of the parts is "time", there must be a column of times. If recordings with a column of
    times are resampled, there must be a rate. The part's number and each source of labels may state
    at most one place (`has_one_place`). Each word of a source of labels may be stated only once.
    The settings in `[time]` and `[text]` must be valid, for example name an encoding that Python
    knows (`check_forms`). Nothing else is checked: neither a trigger (the condition at which a part
    begins), nor whether columns exist.
    """
    if open_keys := description.open_keys:
        raise DataError(f"Expected a description without ?, still open: {listed(open_keys)}.")
    limits = {channel.limit for channel in description.channels.values()}
    expect_all(
        {
            "traces.samples, the samples of each trace": description.traces.samples > 0,
            "time.column, since the order is time": (
                description.order != "time" or description.time.column
            ),
            "time.rate_hz, at which times are resampled": (
                description.traces.lengths != "resample"
                or description.time.rate_hz
                or not description.time.column
            ),
            "one limit for all channels": len(limits) == 1,
            "one place each of the label and of the part's number": all(
                map(has_one_place, (*description.labels, description.part))
            ),
            "one meaning of each word in [label] and [[check]]": all(
                len(source.meanings) == len(source.good + source.bad + source.unchecked)
                for source in description.labels
            ),
        }
    )
    check_forms(description.time, description.text)


def has_one_place(source: object) -> bool:
    """Return whether a source states at most one place: a column, path, line, topic or listing.

    A listing, a file with a row for each part, and its column are one place. With no place stated
    the result is True. `source` is the `LabelSource` of labels or the `PartSource` of part numbers.
    """
    places = {key for key in SOURCES if getattr(source, key, "")}
    return len(places) < 2 or places == {"column", "listing"}


def check_forms(clock: Clock, text: TextForm) -> None:
    """Raise DataError unless files can be read with the settings in `[time]` and `[text]`.

    `clock` has the settings in `[time]`, `text` those in `[text]`. A time zone, if stated, must
    have a known name, and a rate, if stated, must be between 1 Hz and 1 MHz, both included. If
    there are columns of times, there must be as many formats; what these say is not checked. Python
    must know the encoding. The delimiter and the decimal mark must be one character each. The
    decimal mark and the mark of thousands, which may be "", must differ, and be no digit, sign, e
    or E; the delimiter is not compared with them. `text.data`, the line of the first samples, must
    be 1 or more.
    """
    with instead(DataError, "Expected a time zone in time.zone", LookupError, ValueError, OSError):
        ZoneInfo(clock.zone or "UTC")
    with instead(DataError, "Expected an encoding in text.encoding", LookupError, ValueError):
        "".encode(text.encoding)  # also refuses codecs that are of no text
    n = len(clock.column)
    marks = (text.delimiter, text.decimal)
    expect_all(
        {
            "a rate of 1 Hz to 1 MHz in time.rate_hz": (
                not clock.rate_hz or LEAST_RATE_HZ <= clock.rate_hz <= MOST_RATE_HZ
            ),
            f"a format for each of {n} columns in [time]": n in (0, len(clock.format)),
            f"one character each in text.delimiter and text.decimal, got {marks}": (
                [*map(len, marks)] == [1, 1]
            ),
            "two marks in text.decimal and text.thousands, that are no digit, sign or e": (
                len({*"0123456789+-eE", text.decimal, text.thousands}) == 16
            ),
            "text.data, the line of the first samples, of 1 or more": text.data > 0,
        }
    )


def without_repeats(recordings: Sequence[Recording]) -> tuple[list[Recording], Faults]:
    """Return the recordings without repeated traces, and a fault for each recording left out.

    The recordings kept stay in their order. All traces must have the same shape (C, T). Two traces
    are equal if they have the same `content_hash`, which rounds samples down to 1/65,536 of their
    unit, and counts lost samples (NaN) as 0. If equal traces have the same label, the one with the
    shortest `source` is kept, the first if there are several. If their labels differ, none is kept.
    This also holds for traces of a dead sensor (all samples are equal), although the engine never
    trains on them.
    """
    hashes = content_hash(np.array([recording.trace for recording in recordings]))
    groups = defaultdict[int, list[int]](list)
    for i, hash_ in enumerate(hashes.tolist()):
        groups[hash_].append(i)
    faults = dict[int, Fault]()
    for group in groups.values():
        # `x.csv`, not `Copy of x.csv`
        first = min(group, key=lambda i: len(recordings[i].source))
        source = recordings[first].source
        message = f"Expected one label for the samples of {source}, got two"
        if len({recordings[i].label for i in group}) == 1:
            message = f"Expected other samples than those of {source}, it repeats them"
            group.remove(first)
        faults |= {i: Fault(recordings[i].source, 0, message) for i in group}
    return [item for i, item in enumerate(recordings) if i not in faults], [*faults.values()]


def tolerance_note(data: Dataset, lower_bound: float) -> str:
    """Return a warning if the tolerance of a policy is too wide for these parts; "" if it is not.

    The tolerance, 1 - `lower_bound`, is the share of accepted parts that may be bad. It is too wide
    if the share of bad parts in the data set is at most as large: accepting every part would meet
    it. The data set must have a trace.
    """
    share = 1 - data.y.mean()
    tolerance = 1 - lower_bound
    if share > tolerance:
        return ""
    return (
        f"{percent(share)} of the parts are bad, and LB {percent(lower_bound, '.4g')} tolerates "
        f"{percent(tolerance, '.4g')} among the accepted ones: accepting every part would meet it. "
        f"Choose a higher lower bound."
    )
