"""Propose how a ROS 2 bag is cut into parts, and where their labels are."""

import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import DataError, listed
from ..description import UNKNOWN, Clock, LabelSource, TextForm
from ..read.bags import LOG_TIME, STAMP, read_messages
from ..read.clock import column_times
from ..read.places import listing_table
from ..table import Table
from .clock import propose_rate
from .columns import Column, Proposal, columns_of, counts_of
from .labels import is_plain, is_verdict, with_meanings
from .roles import propose_channels

MOST_MESSAGES = 50_000
SECONDS = 2.0  # of a part, if nothing else is known
UNITS = {"force": "N", "torque": "Nm"}
START = re.compile(r"(?i)start|begin|beginn|von")
END = re.compile(r"(?i)end|ende|stop|bis")


def propose_bag(p: Proposal) -> None:
    """Find the channels, clock, parts and labels of a bag by its first messages.

    Raises DataError if no message can be read.
    """
    times = defaultdict[str, list[int]](list)
    words = defaultdict[str, list[str]](list)
    units = dict[str, str]()
    is_stamped = True
    messages = read_messages(p.base / p.names[0], None, [])
    for topic, _, logged, message in islice(messages, MOST_MESSAGES):
        times[topic].append(logged)
        if hasattr(message, "data"):
            words[topic].append(str(message.data))
        elif len(times[topic]) == 1:
            units |= dict(_fields(message, topic))
            is_stamped &= hasattr(message, "header") and message.header.stamp.sec > 0
    propose_channels(p, units)
    channels = [channel.column for channel in p.description.channels]
    ignored = {name: unit for name, unit in units.items() if name not in channels}
    p.description = replace(p.description, ignored=ignored)
    p.put("time.column", STAMP if is_stamped else LOG_TIME)
    p.put("time.format", "ns")
    topic = (channels or [*units, ""])[0].partition(".")[0]
    clock = {name: np.array(times[topic]) for name in p.description.time.column}
    propose_rate(p, [Table(topic, clock, [])])
    listings = [] if "windows.trigger" in p.stated else sorted(p.base.glob("*.csv"))
    if not any(_propose_windows(p, path) for path in listings):
        _propose_trigger(p, words)
        _propose_samples(p, SECONDS, f"{SECONDS:g} s from where a part begins")


def _fields(message: Any, path: str) -> Iterator[tuple[str, str]]:
    """Yield the fields of a message that hold numbers, `TOPIC.FIELD`, with their units."""
    for name in getattr(message, "__slots__", ()):
        value = getattr(message, name)
        if hasattr(value, "__slots__") and name != "header":
            yield from _fields(value, f"{path}.{name}")
        elif isinstance(value, int | float):
            yield f"{path}.{name}", UNITS.get(path.rpartition(".")[2], "")


def _propose_samples(p: Proposal, seconds: float, note: str) -> None:
    """Set how many samples a part of so many seconds has, if the rate is known."""
    if "time.rate_hz" not in p.description.open_keys:
        p.put("traces.samples", round(seconds * p.description.time.rate_hz), note)


def _propose_trigger(p: Proposal, words: dict[str, list[str]]) -> None:
    """Find the topics of a trigger and of labels, `?` unless exactly one may be each."""
    sources = [with_meanings(LabelSource(topic=topic), cells) for topic, cells in words.items()]
    verdicts = {source.topic: source for source in sources if is_plain(source)}
    signals = {t: max(w) for t, w in words.items() if t not in verdicts and len({*w}) == 2}
    counts = {topic: f"{topic} ({counts_of(cells)})" for topic, cells in words.items()}
    everything = f"one of {'; '.join(counts.values())}"
    triggers = [f"register={on}@{topic}" for topic, on in signals.items()]
    trigger = triggers[0] if len(triggers) == 1 else UNKNOWN
    p.put("windows.trigger", trigger, everything)
    label = LabelSource(topic=UNKNOWN)
    if len(verdicts) == 1:
        label = next(iter(verdicts.values()))
    if not any(key.startswith("label.") for key in p.stated):
        p.description = replace(p.description, label=label)
        p.notes["label.topic"] = counts.get(label.topic, everything)


def _propose_windows(p: Proposal, path: Path) -> bool:
    """Take the windows and labels of a listing; return whether it has their columns."""
    columns: Sequence[Column] = ()
    with suppress(DataError):
        table = listing_table(path, (), TextForm())
        columns = [*columns_of([table], TextForm()).values()]
    bounds = [c for test in (START, END) for c in columns if test.fullmatch(c.name)]
    verdicts = [c for c in columns if is_verdict(c.name, c.counts)]
    keys = [c.name for c in columns if len(c.counts) == c.counts.total() and c not in bounds]
    if len(bounds) != 2 or not verdicts or not keys:
        return False
    start, end = bounds
    forms = start.forms or ["s"]
    unit = forms[0] if len(forms) == 1 else UNKNOWN
    names = {"listing": path.name, "key": keys[0], "start": start.name, "end": end.name}
    for key, value in names.items():
        p.put(f"windows.{key}", value, "its columns say when each part began and ended")
    p.put("windows.format", unit, f"one of {listed(forms)}" if unit == UNKNOWN else "")
    label = LabelSource(column=verdicts[0].name, listing=path.name, key=keys[0])
    p.description = replace(p.description, label=with_meanings(label, verdicts[0].counts))
    p.put("traces.lengths", "pad")
    with suppress(DataError):
        times = [column_times(table, c.name, unit, Clock(), TextForm()) for c in bounds]
        begins, ends = (relative + first for relative, first in times)
        _propose_samples(p, float(np.median(ends - begins)), "the usual length of a window")
    return True
