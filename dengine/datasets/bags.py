"""The insertions of a bag: one long wrench topic in MCAP files, cut by a trigger, and their labels.

The force is a topic of geometry_msgs/WrenchStamped or Wrench; its times are the stamps in its headers, or else those of
the log. Labels are a topic, of which the first message after an insertion has begun counts, or a file of them by number.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, listed
from ..files import must_fit, reading
from . import labels
from .dataset import Asked, Collected, Dataset, Fault, UnreadableError, as_dataset, must
from .tables import natural
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


@dataclass
class Messages:
    """What was read. stamped, logged : (n,) nanoseconds of each wrench, by its stamp and by the log.  wrench : (n, 6).

    others : of each topic asked for, (nanoseconds of the log, value) of its messages.
    """

    others: dict[str, list[tuple[int, Any]]]
    stamped: list[int] = field(default_factory=list)
    logged: list[int] = field(default_factory=list)
    wrench: list[tuple[float, ...]] = field(default_factory=list)

    def add(self, message: Any, logged: int) -> None:
        header, wrench = getattr(message, "header", None), getattr(message, "wrench", message)
        self.stamped.append(0 if header is None else header.stamp.sec * BILLION + header.stamp.nanosec)
        self.logged.append(logged)
        force, torque = wrench.force, wrench.torque
        self.wrench.append((force.x, force.y, force.z, torque.x, torque.y, torque.z))

    def times(self) -> Times:
        """(n,) seconds since the first, by the stamps where every message has one."""
        exact = np.array(self.logged if 0 in self.stamped else self.stamped, dtype=np.int64)
        return np.asarray((exact - exact[0]) / BILLION)

    def signal(self, name: str) -> NDArray[np.float64]:
        """(n,) an axis, or the newest value of a topic when each wrench was logged; NaN before its first."""
        if name not in self.others:
            return np.array(self.wrench)[:, axis_of(name)]
        known = np.array([np.nan, *(float(value) for _, value in self.others[name])])
        return known[np.searchsorted([time for time, _ in self.others[name]], self.logged, side="right")]


def is_stream(source: Any) -> bool:
    """Whether it is an MCAP file, or a folder that rosbag2 wrote."""
    if not isinstance(source, str | os.PathLike):
        return False
    path = Path(source)
    if not path.is_dir():
        return path.is_file() and path.suffix.lower() == SUFFIX
    return any(path.glob(f"*{SUFFIX}")) or ((path / "metadata.yaml").is_file() and any(path.glob("*.db3")))


def axis_of(name: str) -> int:
    """Which of the six numbers a channel is; -1 for what is none of them."""
    known = ALIASES.get(name, name)
    return AXES.index(known) if known in AXES else -1


@contextmanager
def _reader(path: Path) -> Iterator[McapReader]:
    """A file's reader; DataError for whatever its libraries raise on a file that is damaged, or is something else."""
    from mcap.exceptions import McapError
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory
    from zstandard import ZstdError

    with reading(path, "an MCAP file", also=(McapError, ZstdError)), path.open("rb") as file:
        yield make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])


def _topics(files: Sequence[Path]) -> dict[str, str]:
    """Topic -> the name of its type."""
    found: dict[str, str] = {}
    for path in files:
        with _reader(path) as reader:
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                raise DataError(f"Expected a summary in {path}, there is none: was it cut off? mcap recover mends it.")
            must_fit(float(SIZE) * summary.statistics.message_count, path)
            must_fit(float(max((chunk.uncompressed_size for chunk in summary.chunk_indexes), default=0)), path)
            types = {number: schema.name for number, schema in summary.schemas.items()}
            found |= {channel.topic: types.get(channel.schema_id, "") for channel in summary.channels.values()}
    return found


def _wrench(have: dict[str, str], path: Path, asked: str | None) -> str:
    """The topic of the force; DataError where there is none, or several and none was asked for."""
    wrenches = [topic for topic, kind in have.items() if kind in WRENCHES]
    if asked is not None and asked not in wrenches:
        raise DataError(f"Expected a topic of a wrench in {path}, got {asked}; there are {listed(wrenches) or 'none'}.")
    if asked is None and len(wrenches) != 1:
        found = listed(wrenches or have) or "none"
        raise DataError(f"Expected one topic of a wrench in {path}, or the name of one (topic='...'), found {found}.")
    return asked or wrenches[0]


def _messages(files: Sequence[Path], wrench: str, topics: Sequence[str]) -> Messages:
    """Every message of the wrench, and of the other topics, in the order of the log."""
    found = Messages({topic: [] for topic in topics})
    for path in files:
        with _reader(path) as reader:
            for each in reader.iter_decoded_messages(topics=[wrench, *topics]):
                topic, message, logged = each.channel.topic, each.decoded_message, each.message.log_time
                if topic == wrench:
                    found.add(message, logged)
                if topic in found.others:
                    if not hasattr(message, "data"):
                        raise DataError(f"Expected messages with a field data on {topic}, as of std_msgs, got others.")
                    found.others[topic].append((logged, message.data))
    return found


def read_bag(path: Path, name: str, asked: Asked) -> Dataset:
    """The insertions of an MCAP file, or of a folder of them."""
    if asked.trigger is None:
        raise DataError(f"Expected a trigger that cuts {path} into insertions, as 'contact=5' or 'register@/phase'.")
    trigger, channels = as_trigger(asked.trigger), asked.channels or ("FZ",)
    for channel in channels:
        must(axis_of(channel) >= 0, f"a channel among {', '.join(AXES)} of a wrench", channel)
    files = sorted(path.glob(f"*{SUFFIX}"), key=lambda each: natural(each.name)) if path.is_dir() else [path]
    if not files:
        raise DataError(f"Expected MCAP files in the bag {path}, found none; ros2 bag convert makes them of .db3 files.")
    with reading(path, "MCAP files", "mcap_ros2", "mcap"):
        have = _topics(files)
    wrench = _wrench(have, path, asked.topic)
    topics = [signal for signal in trigger.signals if axis_of(signal) < 0] + ([asked.label] if asked.label else [])
    for topic in topics:
        if topic not in have:
            raise DataError(f"Expected the topic {topic} in {path}, found {listed(have) or 'none'}.")
    messages = _messages(files, wrench, topics)
    must(len(messages.logged) >= 2, f"messages of {wrench} in {path}", len(messages.logged))
    return _dataset(messages, trigger, channels, name, asked)


def _dataset(messages: Messages, trigger: Trigger, channels: tuple[str, ...], name: str, asked: Asked) -> Dataset:
    active = trigger.active({signal: messages.signal(signal) for signal in trigger.signals})
    values, times = np.array(messages.wrench)[:, [axis_of(channel) for channel in channels]], messages.times()
    rate = asked.rate_hz or float(f"{1.0 / _usual_step(times):.4g}")
    samples = asked.samples or round(2.0 * rate)  # two seconds
    cuts = list(_cut_stream(times, values, active, samples, trigger.quiet_s, asked.rate_hz))
    if not cuts:
        raise DataError(f"Expected insertions in {name}, where {trigger} goes on; it never does.")
    names = [f"{name}/{i}" for i in range(1, len(cuts) + 1)]
    faults = [Fault(source, 0, cut.fault) for source, cut in zip(names, cuts, strict=True) if cut.fault]
    traces = [None if cut.fault else cut.trace for cut in cuts]
    if asked.labels is not None:
        told = labels.listed(asked.labels, asked.part, names)
    elif asked.label is not None:
        told = _told(asked.label, messages, cuts, names)
    else:
        raise DataError("Expected the labels' topic (label='/height_check/ok'), or a file of them (labels='labels.csv').")
    found = Collected(name, channels, faults)
    labels.collect(zip(names, traces, repeat(None if asked.rate_hz else rate), strict=False), told, found)
    return as_dataset(found, asked)


def _told(topic: str, messages: Messages, cuts: Sequence[Insertion], names: Sequence[str]) -> labels.Labels:
    """Labels from a topic: of each insertion the value that was told next, if it was before another one began."""
    words: dict[str, Any] = {}
    begins = [messages.logged[cut.first] for cut in cuts]
    for logged, word in messages.others[topic]:
        place = int(np.searchsorted(begins, logged, side="right")) - 1
        if place >= 0:
            words.setdefault(names[place], word)

    def find(name: str) -> labels.Known:
        if name not in words:
            raise UnreadableError(f"Expected a message of {topic} before the next insertion begins, found none")
        return labels.label_of(words[name]), None

    return labels.Labels(find, f"give the topic that tells them, {topic} does not, or a file of labels")


@dataclass(frozen=True, slots=True)
class Insertion:
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
        elif placed.missing:
            fault = (
                f"Expected a message each {step:.3g} s, {placed.missing} of {samples} are missing, the first at sample "
                f"{placed.gaps[0][0]}"
            )
        yield Insertion(placed.trace, i, fault)
