"""The insertions of a bag: one long wrench topic in MCAP files, cut by a trigger, and their labels.

The force is a topic of geometry_msgs/WrenchStamped or Wrench; its times are the stamps in its headers, or else those of
the log. Labels are a topic, of which the first message after an insertion has begun counts, or a file of them by number.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from ..errors import listed as in_words
from ..files import UNREADABLE, must_fit
from .cutting import Insertion, cut_stream, usual_step
from .dataset import Asked, Dataset, Fault, UnreadableError
from .folders import natural
from .labels import Labels, collect, label_of, listed
from .lengths import Collected, as_dataset
from .triggers import Trigger, as_trigger

if TYPE_CHECKING:
    from mcap.reader import McapReader

BILLION = 10**9  # nanoseconds in a second
SUFFIX = ".mcap"
WRENCHES = ("geometry_msgs/msg/WrenchStamped", "geometry_msgs/msg/Wrench")
AXES = ("FX", "FY", "FZ", "MX", "MY", "MZ")  # in the frame that the topic is in
ALIASES = dict(zip(("FX_Base", "FY_Base", "FZ_Base", "MuX_Base", "MuY_Base", "MuZ_Base"), AXES, strict=True))
SIZE = 8 * (len(AXES) + 4)  # bytes of one message, read


@dataclass
class Messages:
    """What was read. stamped, logged : (n,) nanoseconds of each wrench, by its stamp and by the log.  wrench : (n, 6).

    others : of each topic asked for, (nanoseconds of the log, value) of its messages.
    """

    stamped: list[int] = field(default_factory=list)
    logged: list[int] = field(default_factory=list)
    wrench: list[tuple[float, ...]] = field(default_factory=list)
    others: dict[str, list[tuple[int, Any]]] = field(default_factory=dict)

    def add(self, message: Any, logged: int) -> None:
        header, wrench = getattr(message, "header", None), getattr(message, "wrench", message)
        self.stamped.append(0 if header is None else header.stamp.sec * BILLION + header.stamp.nanosec)
        self.logged.append(logged)
        force, torque = wrench.force, wrench.torque
        self.wrench.append((force.x, force.y, force.z, torque.x, torque.y, torque.z))

    @property
    def times(self) -> NDArray[np.float64]:
        """(n,) seconds since the first, by the stamps where every message has one."""
        exact = np.array(self.logged if 0 in self.stamped else self.stamped, dtype=np.int64)
        return np.asarray((exact - exact[0]) / BILLION)

    def held(self, topic: str) -> NDArray[np.float64]:
        """(n,) the newest value of a topic when each wrench was logged; NaN before its first."""
        found = self.others[topic]
        known = np.array([np.nan, *(float(value) for _, value in found)])
        return known[np.searchsorted([time for time, _ in found], self.logged, side="right")]


def is_stream(source: Any) -> bool:
    """Whether it is an MCAP file, or a folder that rosbag2 wrote."""
    if not isinstance(source, str | os.PathLike):
        return False
    path = Path(source)
    if not path.is_dir():
        return path.is_file() and path.suffix.lower() == SUFFIX
    return any(path.glob(f"*{SUFFIX}")) or ((path / "metadata.yaml").is_file() and any(path.glob("*.db3")))


def axis_of(name: str) -> int | None:
    """Which of the six numbers a channel is; None for what is none of them."""
    known = ALIASES.get(name, name)
    return AXES.index(known) if known in AXES else None


@contextmanager
def _reader(path: Path) -> Iterator[McapReader]:
    """A file's reader; DataError for whatever its libraries raise on a file that is damaged, or is something else."""
    from mcap.exceptions import McapError
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory
    from zstandard import ZstdError

    damaged = (McapError, ZstdError, *UNREADABLE)
    try:
        with path.open("rb") as file:
            yield make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
    except damaged as error:
        if isinstance(error, DataError):
            raise
        said = " ".join(str(error).split()) or type(error).__name__
        raise DataError(f"Cannot read {path} as an MCAP file: {said}.") from error


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
        raise DataError(f"Expected a topic of a wrench in {path}, got {asked}; there are {in_words(wrenches) or 'none'}.")
    if asked is None and len(wrenches) != 1:
        found = in_words(wrenches or have) or "none"
        raise DataError(f"Expected one topic of a wrench in {path}, or the name of one (topic='...'), found {found}.")
    return asked or wrenches[0]


def _messages(files: Sequence[Path], wrench: str, topics: Sequence[str]) -> Messages:
    """Every message of the wrench, and of the other topics, in the order of the log."""
    found = Messages(others={topic: [] for topic in topics})
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
    if find_spec("mcap") is None or find_spec("mcap_ros2") is None:
        raise DataError('Expected mcap for MCAP files, it is not installed: pip install "dengine[mcap]".')
    if asked.trigger is None:
        raise DataError(f"Expected a trigger that cuts {path} into insertions, as 'contact=5' or 'register@/phase'.")
    trigger, channels = as_trigger(asked.trigger), asked.channels or ("FZ",)
    for channel in channels:
        if axis_of(channel) is None:
            raise DataError(f"Expected a channel among {', '.join(AXES)} of a wrench, got {channel}.")
    files = sorted(path.glob(f"*{SUFFIX}"), key=lambda each: natural(each.name)) if path.is_dir() else [path]
    if not files:
        raise DataError(f"Expected MCAP files in the bag {path}, found none; ros2 bag convert makes them of .db3 files.")
    have = _topics(files)
    wrench = _wrench(have, path, asked.topic)
    topics = [signal for signal in trigger.signals if axis_of(signal) is None] + ([asked.label] if asked.label else [])
    for topic in topics:
        if topic not in have:
            raise DataError(f"Expected the topic {topic} in {path}, found {in_words(have) or 'none'}.")
    messages = _messages(files, wrench, topics)
    if len(messages.logged) < 2:
        raise DataError(f"Expected messages of {wrench} in {path}, found {len(messages.logged)}.")
    return _dataset(messages, trigger, channels, name, asked)


def _dataset(messages: Messages, trigger: Trigger, channels: tuple[str, ...], name: str, asked: Asked) -> Dataset:
    axes = [AXES.index(ALIASES.get(channel, channel)) for channel in channels]
    values, places = np.array(messages.wrench), {signal: axis_of(signal) for signal in trigger.signals}
    active = trigger.active({n: messages.held(n) if axis is None else values[:, axis] for n, axis in places.items()})
    rate = asked.rate_hz or float(f"{1.0 / usual_step(messages.times):.4g}")
    samples = asked.samples or round(2.0 * rate)  # two seconds
    cuts = list(cut_stream(messages.times, values[:, axes], active, samples, trigger.quiet_s, asked.rate_hz))
    if not cuts:
        raise DataError(f"Expected insertions in {name}, where {trigger} goes on; it never does.")
    names = [f"{name}/{i}" for i in range(1, len(cuts) + 1)]
    labels: Labels
    if asked.labels is not None:
        labels, faults = listed(asked.labels, asked.part, names)
    elif asked.label is not None:
        labels, faults = Told(asked.label, messages, cuts, names), []
    else:
        raise DataError("Expected the labels' topic (label='/height_check/ok'), or a file of them (labels='labels.csv').")
    found = Collected(name, channels, faults)
    found.faults.extend(Fault(source, 0, cut.fault) for source, cut in zip(names, cuts, strict=True) if cut.fault)
    traces = [None if cut.fault else cut.trace for cut in cuts]
    collect(zip(names, traces, repeat(None if asked.rate_hz else rate), strict=False), labels, found)
    return as_dataset(found, asked)


class Told:
    """Labels from a topic: of each insertion the value that was told next, if it was before another one began."""

    def __init__(self, topic: str, messages: Messages, cuts: Sequence[Insertion], names: Sequence[str]) -> None:
        self.topic, self.words = topic, dict[str, Any]()
        begins = [messages.logged[cut.first] for cut in cuts]
        for logged, word in messages.others[topic]:
            place = int(np.searchsorted(begins, logged, side="right")) - 1
            if place >= 0:
                self.words.setdefault(names[place], word)

    def label(self, name: str) -> tuple[int, str | None]:
        if name not in self.words:
            raise UnreadableError(f"Expected a message of {self.topic} before the next insertion begins, found none")
        return label_of(self.words[name]), None

    def advice(self) -> str:
        return f"give the topic that tells them, {self.topic} does not, or a file of labels"
