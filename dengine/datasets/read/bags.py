"""Read ROS 2 bags as one table: a row for each message of the channels' topic.

A channel is `TOPIC.FIELD`, like `/ft/wrench.wrench.force.z`. The column `stamp` has the times in
the messages' headers, `log_time` those of the log, both in nanoseconds. A column that is named like
another topic has in each row the newest `data` of that topic.
"""

import struct
from collections.abc import Collection, Iterator, Sequence
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import DataError, instead, listed
from ...files import UNREADABLE, read_errors
from ..dataset import Fault
from ..description import Description
from ..table import Cells, Table, UnreadableError
from .files import caught
from .frames import as_cells
from .split import signals_of, verdicts_of

SUFFIX = ".mcap"
STAMP = "stamp"
LOG_TIME = "log_time"


def read_messages(path: Path, topics: Collection[str] | None) -> Iterator[tuple[str, int, Any]]:
    """Yield (topic, time in ns, message) for each message of some topics, in the file's order.

    The time is that of the bag's log. `topics` None means all topics. Raises DataError if the file
    is not a .mcap file, or if a package that reads such files is not installed. If the file is
    damaged, was not closed or cannot be read, the whole messages are yielded first; then
    UnreadableError is raised.
    """
    if path.suffix.lower() != SUFFIX:
        raise DataError(
            f"Expected MCAP files in a bag, got {path.name}; `ros2 bag convert` makes them of .db3 "
            "files."
        )
    with read_errors(path, "an MCAP file", "mcap_ros2", "mcap"):
        from mcap.exceptions import McapError
        from mcap.reader import NonSeekingReader
        from mcap_ros2.decoder import DecoderFactory
        from zstandard import ZstdError
    n = 0
    try:
        with path.open("rb") as file:
            reader = NonSeekingReader(file, True, [DecoderFactory()])
            messages = reader.iter_decoded_messages(topics, log_time_order=False)
            for n, (_, channel, record, message) in enumerate(messages, 1):  # noqa: B007
                yield channel.topic, record.log_time, message
    except (*UNREADABLE, McapError, ZstdError, struct.error) as error:  # type: ignore[misc]
        raise UnreadableError(
            f"Expected a whole MCAP file, that was closed, {n} messages are read: {error}; "
            "mcap recover or ros2 bag reindex may save what is whole"
        ) from error


def read_bag(
    base: Path, names: Sequence[str], title: str, description: Description, faults: list[Fault]
) -> Table:
    """Return a table with a row for each message that has the channels, in the order of `log_time`.

    Its columns are the channels, `log_time`, the time of the log, and `stamp`, that in the
    message's header, 0 without one; both are in nanoseconds. Other topics that the description
    names are columns, too; a cell is the field `data` of a message. If a topic is a label, each of
    its messages stands in the last row that is not later, other rows have None; of several messages
    for one row the first stands there, and those before the first row are left out. Any other topic
    has its newest message in each row, None before the first.

    Parameters
    ----------
    base : Path
        The folder of the bag.
    names : sequence of str
        The files of the bag in their order.
    title : str
        The bag's name in error messages.
    description : Description
        Of the bag.
    faults : list
        Gets a fault for each file that is damaged or no MCAP file, or has a message without a field
        that is read; its messages before that are read.

    Raises
    ------
    DataError
        If the channels are of several topics, if no message of their topic can be read (also
        because the package that reads bags is not installed), or if a trigger cuts the bag and
        there is a fault before its last file.
    SettingError
        If the trigger is malformed.
    """
    columns = [*description.channels]
    topics = {column.partition(".")[0] for column in columns}
    if len(topics) > 1:
        raise DataError(f"Expected channels of one topic, got {listed(sorted(topics))}.")
    verdicts = verdicts_of(description)
    others = verdicts.union(description.part.column, signals_of(description), [description.order])
    # by topic: nanoseconds of the log, data
    events: dict[str, list[tuple[int, Any]]] = {
        name: [] for name in others if name.startswith("/") and "." not in name
    }
    fields = [attrgetter(column.partition(".")[2]) for column in columns]
    rows: list[Any] = []
    for name in names:
        if description.windows.trigger and faults:
            raise DataError(
                f"Expected whole files before {name}, since a trigger cuts: {faults[0]}"
            )
        with caught(faults, name), instead(UnreadableError, "Expected a field", AttributeError):
            for topic, logged, message in read_messages(base / name, {*topics, *events}):
                if topic in events:
                    events[topic].append((logged, message.data))
                if topic in topics:
                    rows.append((logged, _stamp_of(message), *(field(message) for field in fields)))
    if not rows:
        why = f" {faults[0]}." if faults else ""
        raise DataError(f"Expected messages of {listed(topics)}, found none.{why}")
    rows.sort(key=itemgetter(0))
    cells = map(as_cells, zip(*rows, strict=True))
    table = dict(zip((LOG_TIME, STAMP, *columns), cells, strict=True))
    for topic, messages in events.items():
        table[topic] = _cells_of(messages, table[LOG_TIME], topic in verdicts)
    return Table(title, table, [])


def _stamp_of(message: Any) -> int:
    """Return the time in a message's header, in nanoseconds; 0 without a header."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return stamp.sec * 10**9 + stamp.nanosec if stamp else 0


def _cells_of(messages: list[tuple[int, Any]], logs: Cells, is_verdict: bool) -> Cells:
    """Return the column of a topic, which has the data of a message or None for each row.

    In each row stands the newest message so far, None before the first. But if `is_verdict`, the
    messages are labels, and each stands only in the last row that is not later than it; of several
    for one row the first stands there, and those before all rows are left out.

    messages : (time in ns, data) of each message; they are sorted in place. logs : the times of the
    rows in ns, increasing.
    """
    messages.sort(key=itemgetter(0))
    times = [time for time, _ in messages]
    words = [None, *(word for _, word in messages)]
    places = np.searchsorted(times, logs, side="left" if is_verdict else "right")
    if is_verdict:
        places = np.where(np.diff(places, append=len(times)) > 0, places + 1, 0)
    return as_cells([words[place] for place in places])
