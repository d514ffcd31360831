"""Read ROS 2 bags as one table: a row for each message of the channels' topic.

A channel is `TOPIC.FIELD`, like `/ft/wrench.wrench.force.z`. The column `stamp` has the times in
the messages' headers, `log_time` those of the log, both in nanoseconds. A column with the name of
another topic has the newest `data` of it.
"""

import struct
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import DataError, listed
from ...files import UNREADABLE, check_size, read_errors
from ..dataset import Fault
from ..description import Description
from ..table import Table, UnreadableError
from .frames import as_cells
from .split import Parts, signals_of
from .windows import cut, label_events

SUFFIX = ".mcap"
STAMP, LOG_TIME = "stamp", "log_time"
MESSAGE_BYTES = 1000.0  # in memory
RECOVER = "mcap recover or ros2 bag reindex may save what is whole"
Message = tuple[str, str, int, Any]  # topic, type, nanoseconds of the log, message


def read_messages(
    path: Path, topics: Collection[str] | None, notes: list[str]
) -> Iterator[Message]:
    """Yield the messages of some topics, or of all for None, in their order in the file.

    A file that was not closed is read up to where it ends, with a note. Raises DataError if it is
    no MCAP file, and UnreadableError if it is damaged.
    """
    if path.suffix.lower() != SUFFIX:
        do = "`ros2 bag convert` makes them of .db3 files"
        raise DataError(f"Expected MCAP files in a bag, got {path.name}; {do}.")
    with read_errors(path, "an MCAP file", "mcap_ros2", "mcap"):
        from mcap.exceptions import McapError
        from mcap.reader import NonSeekingReader, make_reader
        from mcap_ros2.decoder import DecoderFactory
        from zstandard import ZstdError
    damages: tuple[type[Exception], ...] = (*UNREADABLE, McapError, ZstdError, struct.error)
    statistics = None
    with suppress(*damages), path.open("rb") as file:
        summary = make_reader(file).get_summary()
        statistics = summary.statistics if summary else None
    check_size(MESSAGE_BYTES * (statistics.message_count if statistics else 0), path)
    n = 0
    try:
        with path.open("rb") as file:
            reader = NonSeekingReader(file, True, [DecoderFactory()])
            messages = reader.iter_decoded_messages(topics, log_time_order=False)
            for n, (schema, channel, record, message) in enumerate(messages, 1):  # noqa: B007
                yield channel.topic, schema.name if schema else "", record.log_time, message
    except damages as error:
        if statistics or not n:
            raise UnreadableError(f"Expected a whole MCAP file: {error}; {RECOVER}") from error
    if not statistics:
        notes.append(f"{path.name} was not closed: {n} messages before its end are read.")


def value_of(message: Any, path: str) -> Any:
    """Return a field of a message, like `wrench.force.z`; UnreadableError if it has none such."""
    for name in path.split("."):
        if not hasattr(message, name):
            fields = listed(getattr(message, "__slots__", ()))
            raise UnreadableError(f"Expected a field {path}, got {fields}", column=path)
        message = getattr(message, name)
    return message


@dataclass
class Bag:
    """The messages of a bag that a description needs.

    topic : that of the channels. others : topics whose `data` is read. rows : for each message of
    the channels the times of the log and of its header, in nanoseconds, and their values. events :
    for each other topic its messages, as (nanoseconds of the log, value).
    """

    topic: str
    fields: Sequence[str]
    others: Collection[str]
    rows: list[tuple[int, int, list[Any]]] = field(default_factory=list)
    events: dict[str, list[tuple[int, Any]]] = field(default_factory=lambda: defaultdict(list))

    def add(self, messages: Iterable[Message]) -> None:
        """Add messages; raise UnreadableError if one lacks a field."""
        for topic, _, logged, message in messages:
            if topic in self.others:
                self.events[topic].append((logged, value_of(message, "data")))
            if topic == self.topic:
                stamp = getattr(getattr(message, "header", None), "stamp", None)
                time = stamp.sec * 10**9 + stamp.nanosec if stamp else 0
                values = [value_of(message, name) for name in self.fields]
                self.rows.append((logged, time, values))

    def table(self, name: str, columns: Sequence[str]) -> Table:
        """Return a table with a row for each message of the channels, in the order of the log.

        It has the column `stamp` only if all messages have one.
        """
        self.rows.sort(key=lambda row: row[0])
        logs, stamps, values = zip(*self.rows, strict=True)
        cells = dict(zip(columns, map(as_cells, zip(*values, strict=True)), strict=True))
        cells |= {LOG_TIME: as_cells(logs)} | ({STAMP: as_cells(stamps)} if all(stamps) else {})
        for topic, events in self.events.items():
            events.sort(key=lambda event: event[0])
            begins = np.array([time for time, _ in events])
            newest = [None, *(value for _, value in events)]
            places = np.searchsorted(begins, cells[LOG_TIME], side="right")
            cells[topic] = as_cells([newest[place] for place in places.tolist()])
        return Table(name, cells, [])


def bag_of(description: Description) -> Bag:
    """Return an empty bag for a description; DataError if its channels are of several topics."""
    pairs = [channel.column.partition(".") for channel in description.channels]
    topics = sorted({topic for topic, _, _ in pairs})
    if len(topics) != 1:
        raise DataError(f"Expected channels of one topic, got {listed(topics)}.")
    sources = (description.label, *description.check)
    others = {source.topic for source in sources} | {*description.part.column, description.order}
    others |= {*signals_of(description)}
    others = {name for name in others if name.startswith("/") and "." not in name}
    return Bag(topics[0], [name for _, _, name in pairs], others)


def split_bag(
    files: Sequence[tuple[Path, str]],
    description: Description,
    base: Path,
    notes: list[str],
    faults: list[Fault],
) -> Parts:
    """Yield each part of a bag, with the labels of its topics; see `windows.cut`.

    Parameters
    ----------
    files : sequence of (Path, str)
        In their order, each with its name for messages.
    description : Description
    base : Path
        Their folder.
    notes, faults : list
        Get what users should know, and the files that are damaged.

    Raises
    ------
    DataError
        If the topic of the channels has no messages, or if a file before the last is not whole and
        a trigger cuts.
    """
    bag = bag_of(description)
    for path, name in files:
        if description.windows.trigger and (notes or faults):
            why = (*notes, *faults)[0]
            raise DataError(f"Expected whole files before {name}, since a trigger cuts: {why}")
        try:
            bag.add(list(read_messages(path, {bag.topic, *bag.others}, notes)))
        except UnreadableError as error:
            faults.append(Fault(name, 0, str(error), error.column))
    if not bag.rows:
        why = f" {faults[0]}." if faults else ""
        raise DataError(f"Expected messages of {bag.topic}, found none.{why}")
    name = files[0][1] if len(files) == 1 else base.resolve().name
    table = bag.table(name, [channel.column for channel in description.channels])
    parts = cut(table, name, description, base, faults)
    for topic in {source.topic for source in (description.label, *description.check)} - {""}:
        parts = label_events(parts, topic, bag.events[topic], LOG_TIME)
    return parts
