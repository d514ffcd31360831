"""Read ROS 2 bags as one table: a row for each message of the channels' topic.

A channel is `TOPIC.FIELD`, like `/ft/wrench.wrench.force.z`. The column `stamp` has the times in
the messages' headers, `log_time` those of the log, both in nanoseconds. A column that is named like
another topic has in each row the newest `data` of that topic.
"""

import re
import struct
from collections.abc import Collection, Iterator
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any

from ...errors import DataError, instead, listed
from ...files import UNREADABLE, read_errors
from ..dataset import Faults, expect_all
from ..description import Description, Strings
from ..table import Table, UnreadableError
from .files import caught, first_of
from .frames import read_frame
from .split import signals_of, verdicts_of

BAG = ".mcap"  # suffix
STAMP = "stamp"
LOG_TIME = "log_time"
SECOND = 1_000_000_000  # in nanoseconds
PLACE = "place"
TOPIC = re.compile("/[^.]*")  # with a field behind a point it is a channel


def read_messages(path: Path, topics: Collection[str] | None) -> Iterator[tuple[str, int, Any]]:
    """Yield (topic, time in ns, message) for each message of some topics, in the file's order.

    `path` is an MCAP file of a ROS 2 bag. The time is when the bag's recorder got the message
    (`log_time`). `topics` None means all topics. Raises DataError if the file is not a .mcap file,
    or if a package that reads such files is not installed. If the file is damaged, was not closed
    or cannot be read, the whole messages are yielded first; then UnreadableError is raised.
    """
    if path.suffix.lower() != BAG:
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
    base: Path, names: Strings, title: str, description: Description, faults: Faults
) -> Table:
    """Return a table with a row for each message that has the channels, in the order of `log_time`.

    The table is that of a ROS 2 bag. Its columns are the channels (numbers of one topic's
    messages), `log_time`, when the bag's recorder got the message, and `stamp`, the time in the
    message's header, 0 without one; both are in nanoseconds. Topics that are labels, or that
    `part.column`, the trigger (the condition at which a part begins) or `order` names, are columns,
    too; a cell is the field `data` of a message. If a topic is a label, each of its messages stands
    in the last row that is not later, other rows have NaN; of several messages for one row the
    first stands there, and those before the first row are left out. Any other topic has its newest
    message in each row, NaN before the first.

    Parameters
    ----------
    base : Path
        The folder of the bag.
    names : sequence of str
        The files of the bag in their order.
    title : str
        The bag's name in error messages.
    description : Description
        How the bag is read: its channels, labels and so on.
    faults : list
        Gets a fault, which says what could not be read, for each file that is damaged or no MCAP
        file, or has a message without a field that is read; its messages before that are read.

    Raises
    ------
    DataError
        If the channels are of several topics, if no message of their topic can be read (also
        because the package that reads bags is not installed), or if `windows.trigger`, which cuts
        the bag into parts, is stated and there is a fault before its last file.
    SettingError
        If the trigger is malformed.
    """
    import pandas as pd

    topics = {column.partition(".")[0] for column in description.channels}
    expect_all({f"channels of one topic, got {listed(sorted(topics))}": len(topics) < 2})
    verdicts = verdicts_of(description)
    others = {*description.part.column, *signals_of(description), description.order}
    # Of messages at one time, a label counts for the row before it, any other for the row itself.
    places = dict.fromkeys(filter(TOPIC.fullmatch, others), 0) | dict.fromkeys(verdicts, 2)
    fields = {column: attrgetter(column.partition(".")[2]) for column in description.channels}
    rows = list[dict[str, Any]]()
    for name in names:
        if description.windows.trigger and faults:
            raise DataError(
                f"Expected whole files before {name}, since a trigger cuts: {faults[0]}"
            )
        with caught(faults, name), instead(UnreadableError, "Expected a field", AttributeError):
            for topic, logged, message in read_messages(base / name, {*topics, *places}):
                if topic in places:
                    rows.append({LOG_TIME: logged, PLACE: places[topic], topic: message.data})
                if topic in topics:
                    cells = {column: field(message) for column, field in fields.items()}
                    rows.append({LOG_TIME: logged, PLACE: 1, STAMP: stamp_of(message), **cells})
    frame = pd.DataFrame(  # of objects: whole numbers stay whole
        rows, columns=[LOG_TIME, PLACE, STAMP, *fields, *places], dtype=object
    )
    frame = frame.sort_values([LOG_TIME, PLACE])
    is_row = frame.pop(PLACE) == 1
    if not is_row.any():
        raise DataError(f"Expected messages of {listed(topics)}, found none.{first_of(faults)}")
    for topic in places:
        frame[topic] = (
            frame.groupby(is_row.cumsum())[topic].transform("first")
            if topic in verdicts
            else frame[topic].ffill()
        )
    return replace(read_frame(frame[is_row], title), lines=[])


def stamp_of(message: Any) -> int:
    """Return the time in a message's header, in nanoseconds; 0 without a header."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return stamp.sec * SECOND + stamp.nanosec if stamp else 0
