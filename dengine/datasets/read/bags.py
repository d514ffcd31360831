"""Read ROS 2 bags as one table: a row for each message of the channels' topic.

A channel is `TOPIC.FIELD`, like `/ft/wrench.wrench.force.z`. The column `stamp` has the times in
the messages' headers, `log_time` those of the log, both in nanoseconds. A column with the name of
another topic has the newest `data` of it.
"""

import struct
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
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
Events = dict[str, list[tuple[int, Any]]]  # for each topic its messages: nanoseconds, value


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


def read_bag(
    files: Sequence[tuple[Path, str]],
    description: Description,
    notes: list[str],
    faults: list[Fault],
) -> tuple[Table, Events]:
    """Return the table of a bag, and the messages of its other topics.

    Parameters
    ----------
    files : sequence of (Path, str)
        In their order, each with its name for messages.
    description : Description
    notes, faults : list
        Get what users should know, and the files that are damaged.

    Returns
    -------
    Table
        With `stamp` only if all messages have one.
    dict of str to list of (int, value)
        In the order of the log.

    Raises
    ------
    DataError
        If the topic of the channels has no messages, or if a file before the last is not whole and
        a trigger cuts.
    """
    topics = {channel.column.partition(".")[0] for channel in description.channels}
    if len(topics) != 1:
        raise DataError(f"Expected channels of one topic, got {listed(sorted(topics))}.")
    topic = topics.pop()
    fields = [channel.column.partition(".")[2] for channel in description.channels]
    trigger = description.windows.trigger
    sources = (description.label, *description.check)
    others = {source.topic for source in sources} | {*description.part.column, description.order}
    others |= {*signals_of(description)}
    others = {name for name in others if name.startswith("/") and "." not in name}
    rows: list[tuple[int, int, list[Any]]] = []
    events: Events = defaultdict(list)
    for path, name in files:
        if trigger and (notes or faults):
            why = (*notes, *faults)[0]
            raise DataError(f"Expected whole files before {name}, since a trigger cuts: {why}")
        try:
            messages = list(read_messages(path, {topic, *others}, notes))
        except UnreadableError as error:
            faults.append(Fault(name, 0, str(error)))
            continue
        for found, _, logged, message in messages:
            if found in others:
                events[found].append((logged, value_of(message, "data")))
            if found == topic:
                stamp = getattr(getattr(message, "header", None), "stamp", None)
                time = stamp.sec * 10**9 + stamp.nanosec if stamp else 0
                rows.append((logged, time, [value_of(message, field) for field in fields]))
    if not rows:
        why = f" {faults[0]}." if faults else ""
        raise DataError(f"Expected messages of {topic}, found none.{why}")
    rows.sort(key=lambda row: row[0])
    columns = {
        channel.column: as_cells([row[2][i] for row in rows])
        for i, channel in enumerate(description.channels)
    }
    logs = columns[LOG_TIME] = as_cells([logged for logged, *_ in rows])
    stamps = as_cells([stamp for _, stamp, _ in rows])
    columns |= {STAMP: stamps} if stamps.all() else {}
    for name, found_events in events.items():
        found_events.sort(key=lambda event: event[0])
        begins = np.array([time for time, _ in found_events])
        places = np.searchsorted(begins, logs, side="right")
        values = [None, *(value for _, value in found_events)]
        columns[name] = as_cells([values[place] for place in places.tolist()])
    return Table(files[0][1], columns, []), events


def split_bag(
    files: Sequence[tuple[Path, str]],
    description: Description,
    base: Path,
    notes: list[str],
    faults: list[Fault],
) -> Parts:
    """Yield each part of a bag, with the labels of its topics; see `read_bag` and `windows.cut`."""
    table, events = read_bag(files, description, notes, faults)
    name = files[0][1] if len(files) == 1 else base.resolve().name
    parts = cut(table, name, description, base, faults)
    for source in (description.label, *description.check):
        if source.topic:
            parts = label_events(parts, source.topic, events[source.topic], LOG_TIME)
    return parts
