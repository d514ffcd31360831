"""Propose how a ROS 2 bag is cut into parts, and where their labels are."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np

from ..description import UNKNOWN, LabelSource
from ..read.bags import LOG_TIME, SECOND, STAMP, read_messages, stamp_of
from ..table import Table, UnreadableError
from .clock import propose_rate
from .columns import Proposal, counts_of
from .labels import with_meanings
from .roles import propose_channels

MOST_MESSAGES = 50_000
UNITS = {"force": "N", "torque": "Nm"}
LISTING = "windows={listing=FILE, key=COLUMN, start=COLUMN, end=COLUMN}"


def propose_bag(p: Proposal) -> None:
    """Set in `p` the channels, the clock and the source of labels of a ROS 2 bag.

    `p` is the description so far. Only the first 50,000 messages of the first file are looked at.
    Keys that the user stated stay, except `ignored`. `propose_channels` chooses a channel (a signal
    of the traces), or none, among the numbers in the first message of each topic without a field
    `data`; the other numbers become `ignored`. Whether stated channels are in the bag is not
    checked.

    The clock, the times of the samples, is the time in the messages' headers if the first message
    of each of these topics has it, else the time at which the bag's recorder got them, both in ns;
    a time in a header below 1 s counts as none. The rate, `order` (of the parts) and `time.gap`
    (the longest step allowed) follow from the recorder's times in any case (`propose_rate`), those
    of the first channel's topic, or of the first number's if there is no channel.

    `traces.samples`, the length of a trace, becomes `?` (the user must answer). So does
    `windows.trigger`, the condition at which a part begins, unless `windows.listing`, a file with
    the parts' starts and ends, is stated. So does `label.topic`, the topic whose messages are
    labels, unless anything in `[label]` is stated. The notes on these two list the topics with a
    field `data`, and their words (values of `data`). If anything in `[label]` is stated, the words
    of its topic are sorted into good, bad and unchecked (`with_meanings`). A list of good or bad
    words that is not stated and gets no word becomes `?`; a label that is in no topic gives no
    words.

    Raises DataError if the file is no bag or is damaged before its first message, if the package
    that reads bags is missing, or if a setting in `[time]` is wrong; a later damage only ends the
    reading. Raises SettingError for a malformed `windows.trigger`, unless channels are stated.
    """
    times = defaultdict[str, list[int]](list)
    words = defaultdict[str, list[str]](list)
    units = dict[str, str]()
    is_stamped = True
    messages = read_messages(p.base / p.names[0], None)
    try:
        for topic, logged, message in islice(messages, MOST_MESSAGES):
            times[topic].append(logged)
            if hasattr(message, "data"):
                words[topic].append(str(message.data))
            elif len(times[topic]) == 1:
                units |= _fields(message, topic)
                is_stamped &= stamp_of(message) >= SECOND
    except UnreadableError:  # the messages before the damage are enough
        if not times:
            raise
    propose_channels(p, units)
    channels = p.description.channels
    p.put("ignored", {name: unit for name, unit in units.items() if name not in channels})
    p.put("time.column", STAMP if is_stamped else LOG_TIME)
    p.put("time.format", "ns")
    topic = [*channels, *units, ""][0].partition(".")[0]
    clock = dict.fromkeys(p.description.time.column, np.array(times[topic]))
    propose_rate(p, [Table(topic, clock)])
    p.put("traces.samples", UNKNOWN, "how many samples has a part from where it begins?")
    topics = f"one of {'; '.join(f'{t} ({counts_of(cells)})' for t, cells in words.items())}"
    if not p.description.windows.listing:
        p.put("windows.trigger", UNKNOWN, f"register=WORD@TOPIC, {topics}; or state {LISTING}")
    label = p.description.label
    if label == LabelSource():
        p.put("label.topic", UNKNOWN, topics)
    else:
        p.description = replace(p.description, label=with_meanings(label, words[label.topic]))


def _fields(message: Any, path: str) -> Iterator[tuple[str, str]]:
    """Yield (name, unit) for each number in a message of a ROS bag, also in nested fields.

    `path` is the topic; the name is the topic and the fields, joined by dots. The unit is N or Nm
    if the number stands directly in a field named `force` or `torque`, else "". True and False are
    numbers, too. Headers and numbers in arrays are left out.
    """
    for name in getattr(message, "__slots__", ()):
        value = getattr(message, name)
        if hasattr(value, "__slots__") and name != "header":
            yield from _fields(value, f"{path}.{name}")
        elif isinstance(value, int | float):
            yield f"{path}.{name}", UNITS.get(path.rpartition(".")[2], "")
