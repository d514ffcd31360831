"""Read ROS 2 bags as one table: a row for each message of the channels' topic.

A channel is `TOPIC.FIELD`, like `/ft/wrench.wrench.force.z`. The column `stamp` has the times in
the messages' headers, `log_time` those of the log, both in nanoseconds. A column with the name of
another topic has the newest `data` of it.
"""

import struct
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import DataError, instead, listed
from ...files import UNREADABLE, check_size, read_errors
from ..dataset import Fault
from ..description import Description
from ..table import Table, UnreadableError
from .files import caught
from .frames import as_cells
from .split import Parts, signals_of
from .windows import cut

SUFFIX = ".mcap"
STAMP, LOG_TIME = "stamp", "log_time"
MESSAGE_BYTES = 1000.0  # in memory
RECOVER = "mcap recover or ros2 bag reindex may save what is whole"
Message = tuple[str, str, int, Any]  # topic, type, nanoseconds of the log, message
Events = dict[str, list[tuple[int, Any]]]  # by topic: nanoseconds of the log, data


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


def split_bag(
    files: Sequence[tuple[Path, str]],
    description: Description,
    base: Path,
    notes: list[str],
    faults: list[Fault],
) -> Parts:
    """Yield each part of a bag, with the labels of its topics; see `windows.cut`.

    The label is the first message of its topic after the part began, and before the next one did.

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
    verdicts = {source.topic for source in (description.label, *description.check)} - {""}
    others = verdicts.union(description.part.column, signals_of(description), [description.order])
    events: Events = {name: [] for name in others if name.startswith("/") and "." not in name}
    table = _joined(files, description, events, notes, faults)
    parts = [
        *cut(table, files[0][1] if len(files) == 1 else base.resolve().name, description, base)
    ]
    begins = np.array([part.columns[LOG_TIME][0] for *_, part in parts])
    for source, key, part in parts:
        begin = part.columns[LOG_TIME][0]
        end = min(begins[begins > begin], default=2**63)
        words = {
            topic: [word for time, word in events[topic] if begin <= time < end][:1]
            for topic in verdicts
        }
        labels = {topic: np.array(some, dtype=object) for topic, some in words.items()}
        yield source, key, replace(part, columns={**part.columns, **labels})


def _joined(
    files: Sequence[tuple[Path, str]],
    description: Description,
    events: Events,
    notes: list[str],
    faults: list[Fault],
) -> Table:
    """Return a table with a row for each message of the channels, in the order of the log.

    The messages of other topics are put into `events`, and the newest of each is a column.
    """
    columns = [channel.column for channel in description.channels]
    fields = [attrgetter(column.partition(".")[2]) for column in columns]
    topics = {column.partition(".")[0] for column in columns}
    if len(topics) > 1:
        raise DataError(f"Expected channels of one topic, got {listed(sorted(topics))}.")
    rows: list[Any] = []
    for path, name in files:
        if description.windows.trigger and (notes or faults):
            why = (*notes, *faults)[0]
            raise DataError(f"Expected whole files before {name}, since a trigger cuts: {why}")
        with caught(faults, name), instead(UnreadableError, "Expected a field", AttributeError):
            for topic, _, logged, message in [*read_messages(path, {*topics, *events}, notes)]:
                if topic in events:
                    events[topic].append((logged, message.data))
                if topic in topics:
                    stamp = message.header.stamp if hasattr(message, "header") else None
                    time = stamp.sec * 10**9 + stamp.nanosec if stamp else 0
                    rows.append((logged, time, *(field(message) for field in fields)))
    if not rows:
        why = f" {faults[0]}." if faults else ""
        raise DataError(f"Expected messages of {listed(topics)}, found none.{why}")
    rows.sort(key=itemgetter(0))
    cells = map(as_cells, zip(*rows, strict=True))
    table = dict(zip((LOG_TIME, STAMP, *columns), cells, strict=True))
    for topic, messages in events.items():
        messages.sort(key=itemgetter(0))
        newest = [None, *(word for _, word in messages)]
        places = np.searchsorted([time for time, _ in messages], table[LOG_TIME], side="right")
        table[topic] = as_cells([newest[place] for place in places])
    return Table(files[0][1], table, [])
