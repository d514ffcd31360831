"""The insertions of a bag: one long wrench topic cut by a trigger, and their labels.

Labels are a topic of their own, of which the first message after an insertion has begun counts; or a file of labels that
names the insertions by their numbers, from 1.

MCAP files, and rosbag2 folders of them: their topics, and the messages of a wrench and of what goes with it.

The force is a topic of geometry_msgs/WrenchStamped or Wrench. Its times are the stamps in its headers, or where it has none
those of the log.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from ..errors import listed as in_words
from ..files import UNREADABLE, must_fit
from .cutting import Insertion, cut_stream, usual_step
from .dataset import Asked, Dataset, Fault, UnreadableError
from .folders import natural
from .labels import Listed, label_of, listed
from .lengths import Collected, as_dataset
from .triggers import Active, Trigger, as_trigger

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
        """One more wrench."""
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
    return (path.is_file() and path.suffix.lower() == SUFFIX) or (path.is_dir() and _is_bag(path))


def _is_bag(folder: Path) -> bool:
    return any(folder.glob(f"*{SUFFIX}")) or ((folder / "metadata.yaml").is_file() and any(folder.glob("*.db3")))


def axis_of(name: str) -> int | None:
    """Which of the six numbers a channel is; None for what is none of them."""
    known = ALIASES.get(name, name)
    return AXES.index(known) if known in AXES else None


def files_of(path: Path) -> list[Path]:
    """The MCAP files of a bag, in order, or the one that it is."""
    if not path.is_dir():
        return [path]
    files = sorted(path.glob(f"*{SUFFIX}"), key=lambda each: natural(each.name))
    if not files:
        raise DataError(
            f"Expected MCAP files in the bag {path}, found none; ros2 bag convert makes them of another storage (.db3)."
        )
    return files


def _open(file: IO[bytes]) -> McapReader:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    return make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])


@contextmanager
def _readable(path: Path) -> Iterator[McapReader]:
    """A file's reader; DataError for whatever its libraries raise on a file that is damaged, or is something else."""
    from mcap.exceptions import McapError
    from zstandard import ZstdError

    damaged = (McapError, ZstdError, *UNREADABLE)
    try:
        with path.open("rb") as file:
            yield _open(file)
    except damaged as error:
        if isinstance(error, DataError):
            raise
        raise DataError(
            f"Cannot read {path} as an MCAP file: {' '.join(str(error).split()) or type(error).__name__}."
        ) from error


def topics_of(files: Iterable[Path]) -> dict[str, str]:
    """Topic -> the name of its type."""
    found: dict[str, str] = {}
    for path in files:
        with _readable(path) as reader:
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                raise DataError(f"Expected a summary in {path}, there is none: was it cut off? mcap recover mends it.")
            must_fit(float(SIZE) * summary.statistics.message_count, path)
            must_fit(float(max((chunk.uncompressed_size for chunk in summary.chunk_indexes), default=0)), path)
            types = {number: schema.name for number, schema in summary.schemas.items()}
            found |= {channel.topic: types.get(channel.schema_id, "") for channel in summary.channels.values()}
    return found


def must_have(topics: Sequence[str], have: Mapping[str, str], path: Path) -> None:
    """DataError for a topic that is not there."""
    missing = [topic for topic in topics if topic not in have]
    if missing:
        raise DataError(f"Expected the topic {missing[0]} in {path}, found {in_words(have) or 'none'}.")


def wrench_topic(have: Mapping[str, str], path: Path, asked: str | None) -> str:
    """The topic of the force; DataError where there is none, or several and none was asked for."""
    wrenches = [topic for topic, kind in have.items() if kind in WRENCHES]
    if asked is not None and asked not in wrenches:
        raise DataError(f"Expected a topic of a wrench in {path}, got {asked}; there are {in_words(wrenches) or 'none'}.")
    if asked is None and len(wrenches) != 1:
        found = in_words(wrenches or have) or "none"
        raise DataError(f"Expected one topic of a wrench in {path}, or the name of one (topic='...'), found {found}.")
    return asked or wrenches[0]


def read_messages(files: Iterable[Path], wrench: str, topics: Sequence[str]) -> Messages:
    """Every message of the wrench, and of the other topics, in the order of the log."""
    found = Messages(others={topic: [] for topic in topics})
    for path in files:
        with _readable(path) as reader:
            for each in reader.iter_decoded_messages(topics=[wrench, *topics]):
                message, logged = each.decoded_message, each.message.log_time
                if each.channel.topic == wrench:
                    found.add(message, logged)
                if each.channel.topic in found.others:
                    found.others[each.channel.topic].append((logged, _value(message, each.channel.topic)))
    return found


def _value(message: Any, topic: str) -> Any:
    """What a message of one value says, as std_msgs' do."""
    if not hasattr(message, "data"):
        raise DataError(f"Expected messages with a field data on {topic}, as those of std_msgs, got another type.")
    return message.data


SECONDS = 2.0  # of an insertion, where no number of samples was asked for


def read_bag(path: Path, name: str, asked: Asked) -> Dataset:
    """The insertions of an MCAP file, or of a folder of them."""
    if find_spec("mcap") is None or find_spec("mcap_ros2") is None:
        raise DataError('Expected mcap for MCAP files, it is not installed: pip install "dengine[mcap]".')
    if asked.trigger is None:
        raise DataError(
            f"Expected a trigger that cuts {path} into insertions, as trigger='contact=5' or 'register@/phase', got none."
        )
    trigger, channels = as_trigger(asked.trigger), _channels(asked)
    files = files_of(path)
    have = topics_of(files)
    wrench = wrench_topic(have, path, asked.topic)
    topics = [signal for signal in trigger.signals if axis_of(signal) is None] + ([asked.label] if asked.label else [])
    must_have(topics, have, path)
    messages = read_messages(files, wrench, topics)
    if len(messages.logged) < 2:
        raise DataError(f"Expected messages of {wrench} in {path}, found {len(messages.logged)}.")
    return _dataset(messages, trigger, channels, name, asked)


def _channels(asked: Asked) -> tuple[str, ...]:
    unknown = [name for name in asked.channels if axis_of(name) is None]
    if unknown:
        raise DataError(f"Expected a channel among {', '.join(AXES)} of a wrench, got {unknown[0]}.")
    return asked.channels or ("FZ",)


def _active(messages: Messages, trigger: Trigger) -> Active:
    wrench, signals = np.array(messages.wrench), {}
    for name in trigger.signals:
        axis = axis_of(name)
        signals[name] = messages.held(name) if axis is None else wrench[:, axis]
    return trigger.active(signals)


def _dataset(messages: Messages, trigger: Trigger, channels: tuple[str, ...], name: str, asked: Asked) -> Dataset:
    times, axes = messages.times, [AXES.index(ALIASES.get(channel, channel)) for channel in channels]
    rate = asked.rate_hz or float(f"{1.0 / usual_step(times):.4g}")
    samples = asked.samples or round(SECONDS * rate)
    values, active = np.array(messages.wrench)[:, axes], _active(messages, trigger)
    cuts = list(cut_stream(times, values, active, samples, trigger.quiet_s, asked.rate_hz))
    if not cuts:
        raise DataError(f"Expected insertions in {name}, where {trigger} goes on; it never does.")
    names = [f"{name}/{i}" for i in range(1, len(cuts) + 1)]
    labels, faults = _labels(messages, cuts, names, asked)
    found = Collected(name, channels, faults)
    _collect(cuts, names, labels, found, None if asked.rate_hz else rate)
    if isinstance(labels, Listed):
        found.faults.extend(labels.unused())
    return as_dataset(found, asked)


def _collect(
    cuts: Sequence[Insertion], names: Sequence[str], labels: Told | Listed, found: Collected, rate: float | None
) -> None:
    """Insertions with their labels; what is no trace, or has no label, is a fault."""
    unlabelled = 0
    for insertion, source in zip(cuts, names, strict=True):
        try:
            label, part = labels.label(source)
        except UnreadableError as error:
            unlabelled += 1
            found.faults.append(error.fault(source))
            continue
        if insertion.fault:
            found.faults.append(Fault(source, 0, insertion.fault))
        else:
            found.add(insertion.trace, label, source, part, rate)
    if unlabelled > len(cuts) / 2:
        raise DataError(f"Expected a label for each insertion, {unlabelled} of {len(cuts)} have none; {labels.advice()}.")


@dataclass(frozen=True)
class Told:
    """Labels from a topic: of each insertion's name the value that was told next, if it was before another one began."""

    topic: str
    words: dict[str, Any]

    def label(self, name: str) -> tuple[int, str | None]:
        """Of the insertion with this name; a topic tells no part's number."""
        if name not in self.words:
            raise UnreadableError(f"Expected a message of {self.topic} before the next insertion begins, found none")
        return label_of(self.words[name]), None

    def advice(self) -> str:
        """What to do where most insertions have no label."""
        return f"give the topic that tells them, {self.topic} does not, or a file of labels"


def _labels(
    messages: Messages, cuts: Sequence[Insertion], names: Sequence[str], asked: Asked
) -> tuple[Told | Listed, list[Fault]]:
    if asked.labels is not None:
        return listed(asked.labels, asked.part, names)
    if asked.label is None:
        raise DataError(
            "Expected the labels' topic (label='/height_check/ok'), or a file of them by number (labels='labels.csv')."
        )
    begins = [messages.logged[cut.first] for cut in cuts]
    words: dict[str, Any] = {}
    for logged, word in messages.others[asked.label]:
        place = int(np.searchsorted(begins, logged, side="right")) - 1
        if place >= 0:
            words.setdefault(names[place], word)
    return Told(asked.label, words), []
