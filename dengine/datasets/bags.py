"""Insertions in a bag: one long recording of a wrench in MCAP files, cut by a trigger or by the
windows of a listing.

The force is a topic of geometry_msgs/WrenchStamped or Wrench. Its times are the stamps in the
headers, or else those of the log. Labels are a topic, of which the first message after an insertion
has begun counts, or a file of labels by the insertions' numbers. `load_dataset` calls `read_bag`.
"""

import re
import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, listed
from ..files import UNREADABLE, check_size, read_errors
from . import labels, listings
from .assembly import as_dataset
from .collector import Reading, Recording, RecordingCollector
from .columns import natural_key
from .dataset import Dataset, Fault, LoadOptions, UnreadableError, expect_data
from .triggers import MAX_STEP, Active, Start, StartFinder, Trigger, as_trigger, place
from .windows import Windows, read_windows

if TYPE_CHECKING:
    from mcap.reader import DecodedMessageTuple

NANOSECONDS = 10**9  # in a second
SUFFIX = ".mcap"
WRENCH_TYPES = ("geometry_msgs/msg/WrenchStamped", "geometry_msgs/msg/Wrench")
AXES = ("FX", "FY", "FZ", "MX", "MY", "MZ")  # in the frame that the topic is in
UR_NAMES = ("FX_Base", "FY_Base", "FZ_Base", "MuX_Base", "MuY_Base", "MuZ_Base")
ALIASES = dict(zip(UR_NAMES, AXES, strict=True))
FIELD = re.compile(r"(?:wrench[./])?(force|torque)[./_]([xyz])")  # of a ROS message
RECOVER = "mcap recover or ros2 bag reindex may save what is whole"
MESSAGE_BYTES = 8 * (len(AXES) + 4)  # in memory
LOG_CLOCK = "times of the log"
LATE_LOG = 0.1  # seconds from stamp to log that users should know
LATE_MESSAGES = 100  # that come in one burst are no gap
SPAN = 100  # messages over which the step is measured, if they come in bursts
MEAN_TOLERANCE = 0.1  # of a step: a mean one that is further off is no step, as of a clock set back
BURST_TOLERANCE = 0.3  # of a step: single steps that are further off it are those of bursts
Times = NDArray[np.float64]


class Messages(NamedTuple):
    """The messages of a bag.

    dated : array of int64, shape (n,)
        The time of each wrench, in nanoseconds since 1970 or since another start.
    logged : array of int64, shape (n,)
        When each wrench was logged, in nanoseconds.
    wrench : array of float64, shape (n, 6)
    others : dict
        For each other topic its messages, as (nanoseconds of the log, value).
    clock : str
        Which times `dated` are, in words.
    begin : int
        When the bag begins, in nanoseconds of the log.
    """

    dated: NDArray[np.int64]
    logged: NDArray[np.int64]
    wrench: NDArray[np.float64]
    others: dict[str, list[tuple[int, Any]]]
    clock: str
    begin: int

    @property
    def times(self) -> Times:
        """Seconds since the first wrench, shape (n,)."""
        return np.asarray((self.dated - self.dated[0]) / NANOSECONDS)

    def signal(self, name: str) -> NDArray[np.float64]:
        """Return an axis of the wrench, or the value of a topic at each wrench, shape (n,).

        The value of a topic is its newest one when the wrench was logged, NaN before its first. The
        name is not checked: one that is neither gives MZ. Raises DataError for texts.
        """
        if name not in self.others:
            return self.wrench[:, axis_of(name)]
        texts = [value for _, value in self.others[name] if isinstance(value, str)]
        do = "name a topic of numbers, or a CSV file with columns start, end and result (labels)"
        expect_data(not texts, f"numbers on topic {name}", texts[0] if texts else "", do)
        values = np.array([np.nan, *(float(value) for _, value in self.others[name])])
        logged = [time for time, _ in self.others[name]]
        return values[np.searchsorted(logged, self.logged, side="right")]


def is_stream(path: Path) -> bool:
    """Return whether a path is for `read_bag`: an MCAP file or a folder with such files.

    So is a rosbag2 folder of .db3 files, which `read_bag` refuses with advice to convert it.
    """
    if not path.is_dir():
        return path.is_file() and path.suffix.lower() == SUFFIX
    has_files = any(path.glob(f"*{SUFFIX}"))
    return has_files or ((path / "metadata.yaml").is_file() and any(path.glob("*.db3")))


def axis_of(name: str) -> int:
    """Return which of the six numbers of a wrench a channel is; -1 if it is none."""
    axis = ALIASES.get(name, name.upper())
    if field := FIELD.fullmatch(name.lower()):
        axis = f"{'F' if field[1] == 'force' else 'M'}{field[2].upper()}"
    return AXES.index(axis) if axis in AXES else -1


class Contents(NamedTuple):
    """What an MCAP file holds.

    types : dict
        The name of the message type of each topic.
    counts : Counter
        Messages of each topic that are whole; empty for a file that was closed.
    begin : int or None
        Time of the log of the first message, in nanoseconds; None without messages.
    cut : str
        How a file ends that was not closed, for a note; "" if it was.
    """

    types: dict[str, str]
    counts: Counter[str]
    begin: int | None
    cut: str


def _damages() -> tuple[type[Exception], ...]:
    """Return what the libraries raise on damaged files."""
    from mcap.exceptions import McapError
    from zstandard import ZstdError

    return (*UNREADABLE, McapError, ZstdError, struct.error)


def _read_contents(path: Path) -> Contents:
    """Return what a file holds, by its summary, or if it has none by all of its messages.

    Raises UnreadableError if no message can be read, and DataError if the file is too large for the
    memory.
    """
    from mcap.reader import make_reader

    summary = None
    with suppress(*_damages()), path.open("rb") as file:
        summary = make_reader(file).get_summary()
    if summary is None or summary.statistics is None:
        return _scan(path)
    check_size(float(MESSAGE_BYTES) * summary.statistics.message_count, path)
    chunk_sizes = (chunk.uncompressed_size for chunk in summary.chunk_indexes)
    check_size(float(max(chunk_sizes, default=0)), path)
    schemas = {number: schema.name for number, schema in summary.schemas.items()}
    types = {c.topic: schemas.get(c.schema_id, "") for c in summary.channels.values()}
    has_messages = summary.statistics.message_count > 0
    begin = summary.statistics.message_start_time if has_messages else None
    return Contents(types, Counter(), begin, "")


def _scan(path: Path) -> Contents:
    """Return what a file without a summary holds, up to its end or where it is damaged.

    Raises UnreadableError if no message can be read.
    """
    from mcap.exceptions import EndOfFile, InvalidMagic
    from mcap.reader import NonSeekingReader

    types = dict[str, str]()
    counts = Counter[str]()
    begin = end = None
    n_read = 0
    damage: Exception | None = None
    with path.open("rb") as file:
        reader = NonSeekingReader(file, validate_crcs=True)
        try:
            for schema, channel, message in reader.iter_messages(log_time_order=False):
                types[channel.topic] = schema.name if schema else ""
                counts[channel.topic] += 1
                begin = min(message.log_time, begin or message.log_time)
                end = max(message.log_time, end or 0)
                n_read = file.tell()
        except _damages() as error:
            damage = error
    if damage is None:
        return Contents(types, counts, begin, "")
    is_end = isinstance(damage, EndOfFile | struct.error)
    if begin is None or end is None:
        why = "it ends before its first chunk of messages does" if is_end else str(damage)
        if isinstance(damage, InvalidMagic | struct.error):
            why = "it does not begin as one: it is of another kind, or its beginning is damaged"
        why = why if path.stat().st_size else "it is empty"
        raise UnreadableError(f"Cannot read {path} as an MCAP file: {why}; {RECOVER}.")
    share = f"{counts.total()} messages, in {n_read} of {path.stat().st_size} bytes, are read"
    until = f"{np.datetime64(end // 10**6, 'ms')}Z, {(end - begin) / NANOSECONDS:.6g} s after"
    text = f"{path.name} ends early, it was not closed: {share}, up to {until} the first one."
    if not is_end:
        text = f"{text.replace('ends early', 'is damaged')[:-1]}; mcap recover may save more."
    return Contents(types, counts, begin, text)


def _iter_messages(
    path: Path, contents: Contents, topics: Sequence[str]
) -> "Iterator[DecodedMessageTuple]":
    """Yield the messages of some topics that are whole; DataError if the file is damaged."""
    from mcap.reader import NonSeekingReader, make_reader
    from mcap_ros2.decoder import DecoderFactory

    factories = [DecoderFactory()]
    errors = read_errors(path, "an MCAP file", also=_damages(), do=RECOVER)
    with errors, path.open("rb") as file:
        if not contents.counts:
            yield from make_reader(file, True, factories).iter_decoded_messages(topics)
            return
        messages = NonSeekingReader(file, True, factories).iter_decoded_messages(
            topics, log_time_order=False
        )
        yield from islice(messages, sum(contents.counts[topic] for topic in set(topics)))


def _read_messages(files: Mapping[Path, Contents], wrench: str, topics: Sequence[str]) -> Messages:
    """Read all messages of the wrench's topic and of other topics, in the order of the log.

    Times are the stamps of the wrench if all of its messages have one, else those of the log.
    Raises DataError if there are fewer than two wrenches, or another topic's messages have no field
    `data`.
    """
    others: dict[str, list[tuple[int, Any]]] = {topic: [] for topic in topics}
    stamped = []
    logged = []
    forces = []
    for path, contents in files.items():
        for _, channel, record, message in _iter_messages(path, contents, [wrench, *topics]):
            topic = channel.topic
            if topic == wrench:
                header = getattr(message, "header", None)
                vectors = getattr(message, "wrench", message)
                stamped.append(0 if header is None else _nanoseconds_of(header.stamp))
                logged.append(record.log_time)
                both = (vectors.force, vectors.torque)
                forces.append([getattr(vector, axis) for vector in both for axis in "xyz"])
            if topic in others:
                if not hasattr(message, "data"):
                    wanted = f"messages with a field data on {topic}, as of std_msgs"
                    raise DataError(f"Expected {wanted}, got others.")
                others[topic].append((record.log_time, message.data))
    expect_data(len(logged) >= 2, f"messages of {wrench} in {next(iter(files))}", len(logged))
    exact = np.array(logged if 0 in stamped else stamped, dtype=np.int64)
    clock = LOG_CLOCK if 0 in stamped else "stamps of the headers"
    begin = min(contents.begin for contents in files.values() if contents.begin is not None)
    order = np.argsort(logged, kind="stable")
    for messages in others.values():
        messages.sort(key=lambda message: message[0])
    arrays = (exact[order], np.array(logged)[order], np.array(forces)[order])
    return Messages(*arrays, others, clock, begin)


def _nanoseconds_of(stamp: Any) -> int:
    """Return a ROS stamp in nanoseconds."""
    return int(stamp.sec * NANOSECONDS + stamp.nanosec)


def read_bag(path: Path, name: str, options: LoadOptions) -> Dataset:
    """Read the insertions of an MCAP file, or of a folder of them.

    Parameters
    ----------
    path : Path
    name : str
        Name of the data set.
    options : LoadOptions
        A trigger and labels must be stated, or a listing with windows and labels.

    Returns
    -------
    Dataset

    Raises
    ------
    DataError
        If options are missing or name topics that are not there, a file is damaged, or no insertion
        is found.
    SettingError
        For a trigger that is none.
    """
    channels = options.channels or ("FZ",)
    for channel in channels:
        wanted = f"a channel among {', '.join(AXES)} of a wrench"
        expect_data(axis_of(channel) >= 0, wanted, channel)
    files = [path]
    if path.is_dir():
        files = sorted(path.glob(f"*{SUFFIX}"), key=lambda file: natural_key(file.name))
    if not files:
        do = "ros2 bag convert makes them of .db3 files"
        raise DataError(f"Expected MCAP files in the bag {path}, found none; {do}.")
    with read_errors(path, "MCAP files", "mcap_ros2", "mcap"):
        contents, faults = _read_all_contents(files)
    windows = read_windows(name, options)
    if windows is not None and options.trigger is not None:
        actual = f"{windows.file} says from when to when each part ran"
        do = "leave one out: the trigger, or the columns of times in the file"
        raise DataError(
            f"Expected a trigger or windows, got {options.trigger}, and {actual}; {do}."
        )
    notes = [file_contents.cut for file_contents in contents.values() if file_contents.cut]
    gaps = [file.name for file in files[:-1] if file not in contents or contents[file].cut]
    if gaps and windows is None:
        wanted = f"whole files before the last one of {path}, which a trigger cuts"
        do = "read the files before it and those behind it alone, or give a listing of windows"
        why = " ".join([*(f"{fault.message}." for fault in faults), *notes])
        raise DataError(f"Expected {wanted}, {gaps[0]} is none; {do}. {why}")
    try:
        wrench, topics = _find_topics(path, contents.values(), options, has_trigger=windows is None)
        messages = _read_messages(contents, wrench, topics)
        if windows is not None:
            data = _cut_windows(messages, windows, channels, name, options)
        else:
            data = _cut_dataset(messages, as_trigger(options.trigger), channels, name, options)
    except DataError as error:
        if not notes:
            raise
        raise DataError(f"{error} {' '.join(notes)}") from error
    return replace(data, notes=(*notes, *data.notes), faults=(*faults, *data.faults))


def _find_topics(
    path: Path, contents: Iterable[Contents], options: LoadOptions, *, has_trigger: bool
) -> tuple[str, list[str]]:
    """Return the topic of the wrench and the others that are to be read.

    Raises DataError if one is missing, there are several wrenches and none is stated, or the
    trigger or the labels are not stated where it is to be cut by a trigger.
    """
    types = {topic: kind for in_file in contents for topic, kind in in_file.types.items()}
    signals: tuple[str, ...] = ()
    if has_trigger:
        _check_cutting_options(path, types, options)
        signals = as_trigger(options.trigger).signals
    wrenches = [
        topic
        for topic, message_type in types.items()
        if message_type in WRENCH_TYPES and options.topic in (None, topic)
    ]
    wanted = f"a topic of a wrench in {path}, named where there are several (topic='...')"
    expect_data(len(wrenches) == 1, wanted, listed(wrenches or types) or "none")
    topics = [signal for signal in signals if axis_of(signal) < 0]
    topics += [options.label] if options.label and options.labels is None else []
    topics += [options.part] if options.part in types else []
    for topic in topics:
        if topic not in types:
            actual = listed(types) or "none"
            raise DataError(f"Expected the topic {topic} in {path}, found {actual}.")
    return wrenches[0], topics


def _read_all_contents(files: Sequence[Path]) -> tuple[dict[Path, Contents], list[Fault]]:
    """Return what the files of a bag hold, and the faults of those that cannot be read.

    Raises DataError if the first cannot be read, with which the bag begins.
    """
    contents = dict[Path, Contents]()
    faults = list[Fault]()
    for file in files:
        try:
            contents[file] = _read_contents(file)
        except UnreadableError as error:
            if not contents:
                raise DataError(str(error)) from error
            faults.append(Fault(file.name, 0, str(error).rstrip(".")))
    return contents, faults


def _check_cutting_options(path: Path, types: Mapping[str, str], options: LoadOptions) -> None:
    """Raise DataError if the trigger or the labels were not stated, with an example of them.

    types : message type of each topic, by which the example is chosen.
    """
    topic_of = {message_type.rpartition("/")[2]: topic for topic, message_type in types.items()}
    label = "a CSV file of them by number, from 1 (labels)"
    if "Bool" in topic_of:
        label = f"label={topic_of['Bool']!r}"
    if options.trigger is None:
        registers = (f"register@{topic}" for kind, topic in topic_of.items() if "Int" in kind)
        trigger = f"trigger={next(registers, 'contact=5')!r}"
        wanted = f"what cuts {path} into insertions, and their labels"
        listing = "a CSV file with columns start, end and result (labels)"
        if options.labels is not None:
            listing = f"columns start and end, of dates, in {options.labels}"
        raise DataError(f"Expected {wanted}, as {trigger} and {label}, or {listing}.")
    if options.label is None and options.labels is None:
        raise DataError(f"Expected the labels of the insertions in {path}, as {label}.")


def _cut_dataset(
    messages: Messages,
    trigger: Trigger,
    channels: tuple[str, ...],
    name: str,
    options: LoadOptions,
) -> Dataset:
    """Cut a stream into insertions by its trigger, and return them with their labels as a data set.

    Insertions are named NAME/1, NAME/2, ..., or by the topic of parts. By default each lasts two
    seconds. Those with missing messages become faults. Raises DataError if the trigger never
    starts.
    """
    active = trigger.active({signal: messages.signal(signal) for signal in trigger.signals})
    values = messages.wrench[:, [axis_of(channel) for channel in channels]]
    rate = options.rate_hz or _rate_of(messages.times)
    samples = options.samples or round(2.0 * rate)  # two seconds
    cuts = list(_cut_stream(messages.times, values, active, samples, trigger.quiet_s, options))
    if not cuts:
        message = f"Expected insertions in {name}, where {trigger} goes on; it never does."
        raise DataError(message)
    names = [f"{name}/{i}" for i in range(1, len(cuts) + 1)]
    if options.part in messages.others:
        names = _parts_in_topic(options.part, messages, cuts)
        options = replace(options, part="part")
    insertions = dict(zip(names, cuts, strict=True))
    if options.labels is not None:
        source = listings.labels_in_file(options.labels, names, options)
    else:
        source = _labels_in_topic(options, messages, cuts, names)
    collector = RecordingCollector(name, channels, order="as in the bag")
    _collect_insertions(insertions, messages, rate, source, collector, options)
    ends = np.append(np.flatnonzero(~active), len(active))  # where the trigger is off
    lengths = [int(ends[np.searchsorted(ends, cut.first)]) - cut.first for cut in cuts]
    if options.samples is None and np.median(lengths) > samples:
        goes_on = f"The trigger goes on for {min(lengths)} to {max(lengths)} samples"
        collector.notes[f"{goes_on}: the first {samples}, two seconds, are used (samples)"] = 1
    return as_dataset(collector, options)


def _collect_insertions(
    insertions: "Mapping[str, RecordedInsertion]",
    messages: Messages,
    rate: float,
    source: labels.LabelSource,
    collector: RecordingCollector,
    options: LoadOptions,
) -> None:
    """Collect insertions with their labels; `rate` is the one by their clock, or the stated one."""
    reading = Reading(clock="" if options.rate_hz else messages.clock)

    def read(insertion: "RecordedInsertion") -> Recording:
        if insertion.fault:
            raise UnreadableError(insertion.fault)
        return Recording(insertion.trace, None if options.rate_hz else rate, reading=reading)

    labels.collect_recordings(insertions, read, source, collector)


def _cut_windows(
    messages: Messages,
    windows: Windows,
    channels: tuple[str, ...],
    name: str,
    options: LoadOptions,
) -> Dataset:
    """Cut a stream by the windows of a listing, and return them with its labels as a data set.

    The windows are compared with the stamps of the headers, or with the times of the log if no
    window lies within the stamps, or if they count from the start of the bag; a note says which.
    Raises DataError if no window lies within the bag.
    """
    collector = RecordingCollector(name, channels, order="by the starts of the windows")
    begin = 0.0 if windows.since_1970 else messages.begin / NANOSECONDS
    if not windows.since_1970 or not windows.n_inside(messages.dated / NANOSECONDS):
        messages = messages._replace(dated=messages.logged, clock=LOG_CLOCK)
        windows.check_inside(messages.dated / NANOSECONDS - begin, name)
    counts = (
        "dates, UTC without a zone," if windows.since_1970 else "seconds from the start of the bag"
    )
    note = f"{windows.file} is read as {counts} and compared with the {messages.clock}"
    late_s = float(np.median(messages.logged - messages.dated)) / NANOSECONDS
    if messages.clock == LOG_CLOCK and windows.since_1970:
        note = f"{note}: no stamps of the headers are of its times"
    elif abs(late_s) > LATE_LOG:
        note = f"{note}; the times of the log are {late_s:.3g} s later"
    collector.notes[note] = 1
    times = messages.times
    rate = options.rate_hz or _rate_of(times)
    step = 1.0 / _rate_of(times)
    places = np.arange(len(times)) if options.rate_hz else _place_messages(times, step)
    values = messages.wrench[:, [axis_of(channel) for channel in channels]]
    insertions = {}
    cuts = windows.cut(messages.dated / NANOSECONDS - begin, step)
    for part, window in zip(windows.names, cuts, strict=True):
        if window.fault:
            insertions[part] = RecordedInsertion(
                np.empty((len(channels), 0), dtype=np.float32), 0, window.fault
            )
            continue
        first = int(window.positions[0])
        samples = round(window.seconds * rate)
        n_left = int(places[-1] - places[first]) + 1
        if options.rate_hz:
            samples = len(window.positions)
        elif n_left == samples - 1:  # the last message of the bag came early
            samples = n_left
        is_behind_gap = first > 0 and places[first] - places[first - 1] > 1
        is_late = window.late > MAX_STEP * step
        start = Start(float(places[first]), seen=not (is_behind_gap and is_late))
        insertions[part] = _take(times, places, values, first, start, samples, step, options)
    source = windows.label_source()
    _collect_insertions(insertions, messages, rate, source, collector, options)
    return as_dataset(collector, options)


def _parts_in_topic(
    topic: str, messages: Messages, cuts: "Sequence[RecordedInsertion]"
) -> list[str]:
    """Return the part of each insertion: the newest message of a topic when it began, as a text.

    Raises DataError if an insertion has none, or two have the same.
    """
    logged = [time for time, _ in messages.others[topic]]
    texts = [str(word) for _, word in messages.others[topic]]
    places = np.searchsorted(logged, messages.logged[[cut.first for cut in cuts]], side="right")
    expect_data(all(places > 0), f"a message of {topic} before each insertion", "none before one")
    parts = [texts[i - 1] for i in places]
    repeated = [part for part, n in Counter(parts).items() if n > 1]
    expect_data(not repeated, f"another part on {topic} for each insertion", listed(repeated))
    return parts


def _labels_in_topic(
    options: LoadOptions,
    messages: Messages,
    cuts: "Sequence[RecordedInsertion]",
    names: Sequence[str],
) -> labels.LabelSource:
    """Return a source of labels in a topic.

    The label of an insertion is the first message after it has begun, if that comes before the next
    insertion begins; else its `find` raises UnreadableError.
    """
    topic = str(options.label)
    words = dict[str, Any]()
    notes = Counter[str]()
    label_messages = labels.LabelColumn(topic, options.words, notes)
    begins = messages.logged[[cut.first for cut in cuts]]
    for logged, word in messages.others[topic]:
        n_begun = int(np.searchsorted(begins, logged, side="right"))
        if n_begun:
            words.setdefault(names[n_begun - 1], word)

    def find(name: str) -> labels.SourcedLabel:
        """Return the label of an insertion."""
        if name not in words:
            wanted = f"a message of {topic} before the next insertion begins"
            raise UnreadableError(f"Expected {wanted}, found none")
        return label_messages.find([words[name]], f"topic {topic}")

    advice = f"give the topic that tells them, {topic} does not, or a file of labels"
    return labels.LabelSource(find, advice, f"topic {topic}", notes=notes)


class RecordedInsertion(NamedTuple):
    """An insertion that was cut out of a stream.

    trace : array of float32, shape (C, T)
    first : int
        Position of its first message.
    fault : str
        Why the trace cannot be used; "" if it can.
    """

    trace: NDArray[np.float32]
    first: int
    fault: str


def _usual_step(times: Times) -> float:
    """Return the seconds between two messages: the median step, or in bursts the mean one."""
    span = min(SPAN, len(times) - 1)
    single = float(np.median(np.diff(times)))
    many = float(np.median((times[span:] - times[:-span]) / span))
    return single if abs(single - many) < BURST_TOLERANCE * many else many


def _rate_of(times: Times) -> float:
    """Return the rate of messages in hertz, to four digits: that of most, lost ones counted."""
    step = _usual_step(times)
    n = max(len(times) - LATE_MESSAGES, 2)  # of the last ones lost and late are not told apart
    mean, _ = np.polyfit(_place_messages(times, step)[:n], times[:n], 1)
    return float(f"{1.0 / (mean if abs(mean - step) < MEAN_TOLERANCE * step else step):.4g}")


def _place_messages(times: Times, step: float) -> NDArray[np.int64]:
    """Return the place of each message on a grid of steps, shape (n,).

    A late message keeps its own place; a lost one leaves its place empty. After a lost message all
    others are later by a step, for good; after a late one they are not. So the least lateness of
    the messages that follow tells lost from late.
    """
    n = len(times)
    late = times - times[0] - step * np.arange(n)
    padded = np.concatenate([late, np.full(LATE_MESSAGES - 1, np.inf)])
    windows = np.lib.stride_tricks.sliding_window_view(padded, LATE_MESSAGES)
    least = windows.min(axis=1)
    lost = np.maximum(np.rint(np.diff(least, prepend=least[:1]) / step), 0)
    return np.asarray(np.arange(n) + np.cumsum(lost), dtype=np.int64)


def _cut_stream(
    times: Times,
    values: NDArray[np.float64],
    active: Active,
    samples: int,
    quiet_s: float,
    options: LoadOptions,
) -> Iterator[RecordedInsertion]:
    """Cut a stream where its trigger starts, and yield each insertion with its trace, or its fault.

    An insertion with missing messages, or times that turn back, has a fault. While one lasts, the
    trigger starts no other.

    Parameters
    ----------
    times, active : array, shape (n,)
        Seconds, and whether the trigger is on.
    values : array of float64, shape (n, C)
    samples : int
        Of each insertion.
    quiet_s : float
        Seconds that the trigger must have been off before it starts an insertion.
    options : LoadOptions
        With a stated rate the times are not looked at, and no message counts as lost.
    """
    step = 1.0 / options.rate_hz if options.rate_hz else _usual_step(times)
    places = np.arange(len(times)) if options.rate_hz else _place_messages(times, step)
    finder = StartFinder(1.0, quiet_s / step)
    next_free = 0.0
    for i, (position, is_on) in enumerate(zip(places.tolist(), active.tolist(), strict=True)):
        start = finder.feed(float(position), is_on)
        if start is None or start.time < next_free:
            continue
        next_free = start.time + samples
        yield _take(times, places, values, i, start, samples, step, options)


def _take(
    times: Times,
    places: NDArray[np.int64],
    values: NDArray[np.float64],
    first: int,
    start: Start,
    samples: int,
    step: float,
    options: LoadOptions,
) -> RecordedInsertion:
    """Return the insertion whose first message is at position `first`, with its trace or its fault.

    Its messages are put at their `places` (n,), from that of `start` on, whose time is a place.
    With a stated rate their times are not looked at.
    """
    stop = int(np.searchsorted(places, start.time + samples))
    placed = place(places[first:stop].tolist(), values[first:stop], start.time, samples, 1.0)
    backwards = np.flatnonzero(np.diff(times[first:stop]) <= 0)
    fault = ""
    if not start.seen:
        fault = "Expected the message that it begins with, that one fell into a gap"
    elif len(backwards) and not options.rate_hz:
        sample = int(backwards[0]) + 1
        fault = f"Expected later times from message to message, sample {sample} is not later"
    elif len(placed.missing):
        lost = f"{len(placed.missing)} of {samples} are missing"
        lost = f"{lost}, the first at sample {placed.missing[0]}"
        fault = f"Expected a message each {step:.3g} s, {lost}"
    return RecordedInsertion(placed.trace, first, fault)
