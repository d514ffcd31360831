"""Propose how a ROS 2 bag is cut into parts, and where their labels are."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import DataError, listed
from ..description import UNKNOWN, Clock, Description, LabelSource, TextForm
from ..read.bags import LOG_TIME, STAMP, read_messages
from ..read.clock import column_times
from ..read.places import listing_table
from ..table import Table
from . import labels
from .cells import MOST_WORDS, counts_of
from .clock import round_rate
from .roles import likely_channels

MOST_MESSAGES = 50_000
SECONDS = 2.0  # of a part, if nothing else is known
UNITS = {"force": "N", "torque": "Nm"}
STARTS = ("start", "begin", "beginn", "von")
ENDS = ("end", "ende", "stop", "bis")


@dataclass
class BagLook:
    """What the first messages of a bag show.

    times : of the log, in nanoseconds, by topic. units : of each field that holds numbers,
    `TOPIC.FIELD`. words : of the field `data`, by topic. is_stamped : whether headers have times.
    """

    times: dict[str, list[int]] = field(default_factory=lambda: defaultdict(list))
    units: dict[str, str] = field(default_factory=dict)
    words: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    is_stamped: bool = True

    def add(self, topic: str, logged: int, message: Any) -> None:
        """Add a message."""
        self.times[topic].append(logged)
        if hasattr(message, "data"):
            self.words[topic].append(str(message.data))
        elif len(self.times[topic]) == 1:
            self.units |= dict(_fields(message, topic))
            self.is_stamped &= hasattr(message, "header") and message.header.stamp.sec > 0

    def rate_of(self, topic: str) -> float:
        """Return the rate of a topic in hertz, by its usual step; 0 if it has none."""
        steps = np.diff(self.times.get(topic, [0])) / 1e9
        usual = float(np.median(steps)) if len(steps) else 0.0
        return round_rate(1 / usual) if usual > 0 else 0.0


def describe_bag(paths: Sequence[Path], stated: Mapping[str, Any]) -> Description:
    """Return the proposed description of a bag.

    Parameters
    ----------
    paths : sequence of Path
        Its files, in their order.
    stated : mapping
        Keys that are known.

    Raises
    ------
    DataError
        If no message can be read.
    """
    notes: dict[str, str] = {}
    bag = BagLook()
    for topic, _, logged, message in islice(read_messages(paths[0], None, []), MOST_MESSAGES):
        bag.add(topic, logged, message)
    best = likely_channels(bag.units)
    channels = {best[0]: bag.units[best[0]]} if len(best) == 1 else {}
    if not channels:
        notes |= {"channels": f"one or several of {listed(bag.units)}"}
    first = next(iter(stated.get("channels", channels) or bag.units), "")
    rate = bag.rate_of(first.partition(".")[0])
    values: dict[str, Any] = {"time.column": STAMP if bag.is_stamped else LOG_TIME}
    values |= {"time.format": "ns", "time.rate_hz": rate}
    seconds, found = _listed_windows(paths[0].parent, stated)
    if found:
        notes["windows.listing"] = "its columns say when each part began and ended"
    else:
        found = _triggered(bag.words, notes)
        notes["traces.samples"] = f"{SECONDS:g} s from where a part begins"
    values |= {**found, "traces.samples": round(seconds * rate)}
    ignored = {name: unit for name, unit in bag.units.items() if name not in channels}
    start = {"format": "mcap", "layout": "mcap", "channels": channels, "ignored": ignored}
    description = Description.from_dict(start).with_values({**values, **stated})
    return replace(description, notes=notes)


def _fields(message: Any, path: str) -> Iterator[tuple[str, str]]:
    """Yield the fields of a message that hold numbers, `TOPIC.FIELD`, with their units."""
    for name in getattr(message, "__slots__", ()):
        value = getattr(message, name)
        if hasattr(value, "__slots__") and name != "header":
            yield from _fields(value, f"{path}.{name}")
        elif isinstance(value, int | float):
            yield f"{path}.{name}", UNITS.get(path.rpartition(".")[2], "")


def _triggered(words: Mapping[str, Sequence[str]], notes: dict[str, str]) -> dict[str, Any]:
    """Return the keys for a trigger and a topic of labels, `?` unless exactly one may be each."""
    known = {topic: _known(topic, cells) for topic, cells in words.items()}
    verdicts = [topic for topic, source in known.items() if source]
    signals = [t for t, cells in words.items() if t not in verdicts and len({*cells}) == 2]
    values: dict[str, Any] = {"label.topic": UNKNOWN, "windows.trigger": UNKNOWN}
    for key, found in (("label.topic", verdicts), ("windows.trigger", signals)):
        counts = "; ".join(f"{topic} ({counts_of(words[topic])})" for topic in found or words)
        notes[key] = counts if len(found) == 1 else f"one of {counts}"
    if len(signals) == 1:
        on = max({*words[signals[0]]})
        values["windows.trigger"] = f"register={on}@{signals[0]}"
    source = known[verdicts[0]] if len(verdicts) == 1 else None
    if source is None:
        return values
    return values | {"label.topic": verdicts[0], "label.good": source.good, "label.bad": source.bad}


def _listed_windows(base: Path, stated: Mapping[str, Any]) -> tuple[float, dict[str, Any]]:
    """Return the usual seconds of a part, and the keys for a file with its windows and labels.

    Without such a file, or with a stated trigger, there are no keys.
    """
    for path in sorted(base.glob("*.csv")) if "windows.trigger" not in stated else ():
        try:
            table = listing_table(path, (), TextForm())
        except DataError:
            continue
        names = {name.lower(): name for name in table.columns}
        start, end = (next((names[n] for n in some if n in names), "") for some in (STARTS, ENDS))
        words = {name: table.words(name) for name in table.columns if name not in (start, end)}
        source = next(filter(None, (_known(name, cells) for name, cells in words.items())), None)
        keys = [name for name, cells in words.items() if len({*cells}) == len(cells)]
        if start and end and source and keys:
            return _windows(table, path.name, keys[0], (start, end), source)
    return SECONDS, {}


def _windows(
    table: Table, name: str, key: str, bounds: tuple[str, str], source: LabelSource
) -> tuple[float, dict[str, Any]]:
    """Return the usual seconds of a window in a listing, and the keys for it and its labels."""
    is_number = all(cell.replace(".", "", 1).isdigit() for cell in table.words(bounds[0]))
    unit = "s" if is_number else "iso"
    starts, ends = (
        relative + first
        for relative, first in (
            column_times(table, column, unit, Clock(), TextForm()) for column in bounds
        )
    )
    start, end = bounds
    windows = {"listing": name, "key": key, "start": start, "end": end, "format": unit}
    values: dict[str, Any] = {f"windows.{part}": value for part, value in windows.items()}
    values |= {"label.listing": name, "label.key": key, "label.column": source.column}
    values |= {"label.good": source.good, "label.bad": source.bad, "traces.lengths": "pad"}
    return float(np.median(ends - starts)), values


def _known(name: str, words: Any) -> LabelSource | None:
    """Return a column or topic as a source of labels, if all its words are plain verdicts."""
    source = labels.with_meanings(LabelSource(column=name), words)
    is_label = bool(source.good or source.bad) and UNKNOWN not in source.good + source.bad
    return source if is_label and len({*words}) < MOST_WORDS else None
