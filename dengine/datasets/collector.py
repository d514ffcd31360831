"""Collects recordings, with their labels and faults, before they become a `Dataset`.

The readers of the family add each `Recording` to a `RecordingCollector`.
"""

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, TraceError, listed, shortened
from .dataset import LABEL_FORMS, Fault, UnknownWordError, UnlabelledError, UnreadableError

MEANINGS = ("bad", "good")  # of the labels 0 and 1
MAX_LABEL_WORDS = 12  # more different words are no labels


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
