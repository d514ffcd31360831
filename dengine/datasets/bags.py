"""The insertions of a bag: one long wrench topic in MCAP files, cut by a trigger, and their labels.

The force is a topic of geometry_msgs/WrenchStamped or Wrench; its times are the stamps in its headers, or else those of
the log. Labels are a topic, of which the first message after an insertion has begun counts, or a file of them by number.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, listed
from ..files import check_size, read_errors
from . import labels
from .dataset import Asked, Collected, Dataset, UnreadableError, as_dataset, must
from .tables import natural
from .text import Timed
from .triggers import Active, StartFinder, Trigger, as_trigger, place

if TYPE_CHECKING:
    from mcap.reader import McapReader

BILLION = 10**9  # nanoseconds in a second
SUFFIX = ".mcap"
WRENCHES = ("geometry_msgs/msg/WrenchStamped", "geometry_msgs/msg/Wrench")
AXES = ("FX", "FY", "FZ", "MX", "MY", "MZ")  # in the frame that the topic is in
ALIASES = dict(zip(("FX_Base", "FY_Base", "FZ_Base", "MuX_Base", "MuY_Base", "MuZ_Base"), AXES, strict=True))
SIZE = 8 * (len(AXES) + 4)  # bytes of one message, read
AHEAD = 100  # messages: a burst of so many that come late is no gap
SPAN = 100  # messages that the step is measured over, where single steps do not tell it
ODD = 0.3  # of a step: so far off what they come to, single steps are of bursts
Times = NDArray[np.float64]


class Messages(NamedTuple):
    """What was read. times : (n,) seconds since the first.  logged : (n,) nanoseconds of the log.  wrench : (n, 6).

    others : of each topic asked for, (nanoseconds of the log, value) of its messages.
    """

    times: Times
    logged: NDArray[np.int64]
    wrench: NDArray[np.float64]
    others: dict[str, list[tuple[int, Any]]]

    def signal(self, name: str) -> NDArray[np.float64]:
        """(n,) an axis, or the newest value of a topic when each wrench was logged; NaN before its first."""
        if name not in self.others:
            return self.wrench[:, axis_of(name)]
        known = np.array([np.nan, *(float(value) for _, value in self.others[name])])
        return known[np.searchsorted([time for time, _ in self.others[name]], self.logged, side="right")]


def is_stream(path: Path) -> bool:
    """Whether it is an MCAP file, or a folder that rosbag2 wrote."""
    if not path.is_dir():
        return path.is_file() and path.suffix.lower() == SUFFIX
    return any(path.glob(f"*{SUFFIX}")) or ((path / "metadata.yaml").is_file() and any(path.glob("*.db3")))


def axis_of(name: str) -> int:
    """Which of the six numbers a channel is; -1 for what is none of them."""
    known = ALIASES.get(name, name)
    return AXES.index(known) if known in AXES else -1


@contextmanager
def _reader(path: Path) -> "Iterator[McapReader]":
    """A file's reader; DataError for whatever its libraries raise on a file that is damaged, or is something else."""
    from mcap.exceptions import McapError
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory
    from zstandard import ZstdError

    with read_errors(path, "an MCAP file", also=(McapError, ZstdError)), path.open("rb") as file:
        yield make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])


def _topics(files: Sequence[Path]) -> dict[str, str]:
    """Topic -> the name of its type."""
    found: dict[str, str] = {}
    for path in files:
        with _reader(path) as reader:
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                raise DataError(f"Expected a summary in {path}, there is none: was it cut off? mcap recover mends it.")
            check_size(float(SIZE) * summary.statistics.message_count, path)
            check_size(float(max((chunk.uncompressed_size for chunk in summary.chunk_indexes), default=0)), path)
            types = {number: schema.name for number, schema in summary.schemas.items()}
            found |= {channel.topic: types.get(channel.schema_id, "") for channel in summary.channels.values()}
    return found


def _messages(files: Sequence[Path], wrench: str, topics: Sequence[str]) -> Messages:
    """Every message of the wrench, by its stamp where all have one, and of the other topics, in the order of the log."""
    others: dict[str, list[tuple[int, Any]]] = {topic: [] for topic in topics}
    stamped, logged, forces = [], [], []
    for path in files:
        with _reader(path) as reader:
            for each in reader.iter_decoded_messages(topics=[wrench, *topics]):
                topic, message, time = each.channel.topic, each.decoded_message, each.message.log_time
                if topic == wrench:
                    stamp, said = getattr(message, "header", None), getattr(message, "wrench", message)
                    stamped.append(0 if stamp is None else stamp.stamp.sec * BILLION + stamp.stamp.nanosec)
                    logged.append(time)
                    forces.append([getattr(vector, axis) for vector in (said.force, said.torque) for axis in "xyz"])
                if topic in others:
                    if not hasattr(message, "data"):
                        raise DataError(f"Expected messages with a field data on {topic}, as of std_msgs, got others.")
                    others[topic].append((time, message.data))
    must(len(logged) >= 2, f"messages of {wrench} in {files[0]}", len(logged))
    exact = np.array(logged if 0 in stamped else stamped, dtype=np.int64)
    return Messages((exact - exact[0]) / BILLION, np.array(logged), np.array(forces), others)


def read_bag(path: Path, name: str, asked: Asked) -> Dataset:
    """The insertions of an MCAP file, or of a folder of them."""
    channels = asked.channels or ("FZ",)
    for channel in channels:
        must(axis_of(channel) >= 0, f"a channel among {', '.join(AXES)} of a wrench", channel)
    files = sorted(path.glob(f"*{SUFFIX}"), key=lambda each: natural(each.name)) if path.is_dir() else [path]
    if not files:
        raise DataError(f"Expected MCAP files in the bag {path}, found none; ros2 bag convert makes them of .db3 files.")
    with read_errors(path, "MCAP files", "mcap_ros2", "mcap"):
        have = _topics(files)
    kinds = {kind.rpartition("/")[2]: topic for topic, kind in have.items()}
    told = f"label={kinds['Bool']!r}" if "Bool" in kinds else "a CSV file of them by number, from 1 (labels)"
    if asked.trigger is None:
        phase = next((f"register@{topic}" for kind, topic in kinds.items() if "Int" in kind), "contact=5")
        raise DataError(f"Expected what cuts {path} into insertions, and their labels, as trigger={phase!r} and {told}.")
    if asked.label is None and asked.labels is None:
        raise DataError(f"Expected the labels of the insertions in {path}, as {told}.")
    trigger = as_trigger(asked.trigger)
    wrenches = [topic for topic, kind in have.items() if kind in WRENCHES and asked.topic in (None, topic)]
    found = listed(wrenches or have) or "none"
    must(len(wrenches) == 1, f"a topic of a wrench in {path}, named where there are several (topic='...')", found)
    topics = [signal for signal in trigger.signals if axis_of(signal) < 0] + ([asked.label] if asked.label else [])
    for topic in topics:
        if topic not in have:
            raise DataError(f"Expected the topic {topic} in {path}, found {listed(have) or 'none'}.")
    return _dataset(_messages(files, wrenches[0], topics), trigger, channels, name, asked)


def _dataset(messages: Messages, trigger: Trigger, channels: tuple[str, ...], name: str, asked: Asked) -> Dataset:
    active = trigger.active({signal: messages.signal(signal) for signal in trigger.signals})
    values = messages.wrench[:, [axis_of(channel) for channel in channels]]
    rate = asked.rate_hz or float(f"{1.0 / _usual_step(messages.times):.4g}")
    samples = asked.samples or round(2.0 * rate)  # two seconds
    cuts = list(_cut_stream(messages.times, values, active, samples, trigger.quiet_s, asked.rate_hz))
    if not cuts:
        raise DataError(f"Expected insertions in {name}, where {trigger} goes on; it never does.")
    insertions = {f"{name}/{i}": cut for i, cut in enumerate(cuts, start=1)}
    if asked.labels is not None:
        told = labels.listed(asked.labels, asked.part, list(insertions), asked.words)
    else:
        told = _told(asked, messages, cuts, list(insertions))

    def read(cut: "Insertion") -> Timed:
        if cut.fault:
            raise UnreadableError(cut.fault)
        return Timed(cut.trace, None if asked.rate_hz else rate)

    return as_dataset(labels.collect(insertions, read, told, Collected(name, channels)), asked)


def _told(asked: Asked, messages: Messages, cuts: "Sequence[Insertion]", names: Sequence[str]) -> labels.Labels:
    """Labels from a topic: of each insertion the value that was told next, if it was before another one began."""
    topic = str(asked.label)
    words, begins = dict[str, Any](), messages.logged[[cut.first for cut in cuts]]
    for logged, word in messages.others[topic]:
        if before := int(np.searchsorted(begins, logged, side="right")):
            words.setdefault(names[before - 1], word)

    def find(name: str) -> labels.Known:
        if name not in words:
            raise UnreadableError(f"Expected a message of {topic} before the next insertion begins, found none")
        return labels.label_of(words[name], asked.words), None

    return labels.Labels(find, f"give the topic that tells them, {topic} does not, or a file of labels")


class Insertion(NamedTuple):
    """One, cut out of a stream. trace : (C, T) float32.  first : its first message.  fault : why it is no trace, if any."""

    trace: NDArray[np.float32]
    first: int
    fault: str


def _usual_step(times: Times) -> float:
    """Seconds between two messages, as it is for most of a stream, be it in bursts."""
    span, single = min(SPAN, len(times) - 1), float(np.median(np.diff(times)))
    many = float(np.median((times[span:] - times[:-span]) / span))
    return single if abs(single - many) < ODD * many else many


def _slots(times: Times, step: float) -> NDArray[np.int64]:
    """(n,) the place of each message, in steps: a message that came late keeps its own, one that is lost leaves one.

    After a lost message all others are later by a step, for good; after a late one they are not. So the least lateness of
    the messages that follow tells lost from late.
    """
    n = len(times)
    late = times - times[0] - step * np.arange(n)
    ahead = np.concatenate([late, np.full(AHEAD - 1, np.inf)])
    least = np.lib.stride_tricks.sliding_window_view(ahead, AHEAD).min(axis=1)
    lost = np.maximum(np.rint(np.diff(least, prepend=least[:1]) / step), 0)
    return np.asarray(np.arange(n) + np.cumsum(lost), dtype=np.int64)


def _cut_stream(
    times: Times, values: NDArray[np.float64], active: Active, samples: int, quiet_s: float, rate_hz: float | None
) -> Iterator[Insertion]:
    """Every insertion of a stream, in turn. times, active : (n,).  values : (n, C).

    rate_hz : stated; then the times only say when an insertion was, and no message counts as lost.
    """
    step = 1.0 / rate_hz if rate_hz else _usual_step(times)
    at = np.arange(len(times)) if rate_hz else _slots(times, step)
    finder, free = StartFinder(1.0, quiet_s / step), 0.0
    for i, (slot, on) in enumerate(zip(at.tolist(), active.tolist(), strict=True)):
        start = finder.feed(float(slot), on)
        if start is None or start.time < free:
            continue
        free = start.time + samples
        stop = int(np.searchsorted(at, free))
        placed = place(at[i:stop].tolist(), values[i:stop], start.time, samples, 1.0)
        back = np.flatnonzero(np.diff(times[i:stop]) <= 0)
        fault = ""
        if not start.seen:
            fault = "Expected the message that it begins with, that one fell into a gap"
        elif len(back) and not rate_hz:
            fault = f"Expected later times from message to message, sample {int(back[0]) + 1} is not later"
        elif len(placed.missing):
            lost = f"{len(placed.missing)} of {samples} are missing, the first at sample {placed.missing[0]}"
            fault = f"Expected a message each {step:.3g} s, {lost}"
        yield Insertion(placed.trace, i, fault)
