"""Propose how a ROS 2 bag is cut into parts, and where their labels are."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import DataError, listed
from ..description import UNKNOWN, Clock, Description, LabelSource
from ..read.bags import LOG_TIME, STAMP, read_messages
from ..read.clock import column_times
from ..read.places import listing_table
from . import labels
from .cells import MOST_WORDS, counts_of
from .clock import round_rate
from .roles import likely_channels

MOST_MESSAGES = 50_000
SECONDS = 2.0  # of a part, if nothing else is known
UNITS = {"force": "N", "torque": "Nm"}
STARTS = ("start", "begin", "beginn", "von")
ENDS = ("end", "ende", "stop", "bis")


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
    times: dict[str, list[int]] = {}
    fields: dict[str, str] = {}
    words: dict[str, list[str]] = {}
    is_stamped = True
    for topic, _, logged, message in islice(read_messages(paths[0], None, []), MOST_MESSAGES):
        times.setdefault(topic, []).append(logged)
        if hasattr(message, "data"):
            words.setdefault(topic, []).append(str(message.data))
        else:
            fields |= dict(_fields(message, topic)) if len(times[topic]) == 1 else {}
            is_stamped &= hasattr(message, "header") and message.header.stamp.sec > 0
    units = {name: unit for name, unit in fields.items() if len(times[name.partition(".")[0]]) > 2}
    best = likely_channels(units)
    channels = {best[0]: units[best[0]]} if len(best) == 1 else {}
    if not channels:
        notes |= {"channels": f"one or several of {listed(units)}", f"channels.{UNKNOWN}": ""}
    values: dict[str, Any] = {"format": "mcap", "layout": "mcap"}
    topic = next(iter(stated.get("channels", channels) or units), "").partition(".")[0]
    steps = np.diff(times.get(topic, [0])) / 1e9
    rate = round_rate(1 / float(np.median(steps))) if len(steps) and np.median(steps) > 0 else 0.0
    column = STAMP if is_stamped else LOG_TIME
    values |= {"time.column": column, "time.format": "ns", "time.rate_hz": rate}
    values["traces.samples"] = round(SECONDS * rate)
    notes["traces.samples"] = f"{SECONDS:g} s from where a part begins"
    values |= _windows(paths[0].parent, words, stated, notes)
    if "seconds" in values:
        values["traces.samples"] = round(values.pop("seconds") * rate)
        del notes["traces.samples"]
    ignored = {name: unit for name, unit in units.items() if name not in channels}
    start = Description.from_dict({"channels": channels, "ignored": ignored})
    own = {key: value for key, value in stated.items() if key not in ("files",)}
    description = start.with_values({**values, **own, "files": stated.get("files", paths[0].name)})
    return description.__class__(
        **{f: getattr(description, f) for f in description.__dataclass_fields__ if f != "notes"},
        notes=notes,
    )


def _fields(message: Any, path: str) -> Iterator[tuple[str, str]]:
    """Yield the fields of a message that hold numbers, `TOPIC.FIELD`, with their units."""
    for name in getattr(message, "__slots__", ()):
        value = getattr(message, name)
        if hasattr(value, "__slots__") and name != "header":
            yield from _fields(value, f"{path}.{name}")
        elif isinstance(value, int | float):
            yield f"{path}.{name}", UNITS.get(path.rpartition(".")[2], "")


def _windows(
    base: Path, words: Mapping[str, Sequence[str]], stated: Mapping[str, Any], notes: dict[str, str]
) -> dict[str, Any]:
    """Return the keys of `[windows]` and `[label]`: a listing, or a trigger and a topic."""
    for path in sorted(base.glob("*.csv")):
        values = _listing(path)
        if values and not any(key.startswith("windows.trigger") for key in stated):
            notes["windows.listing"] = "its columns say when each part began and ended"
            return values
    found_sources = {topic: _known(topic, cells) for topic, cells in words.items()}
    verdicts = {topic: source for topic, source in found_sources.items() if source is not None}
    signals = [t for t, cells in words.items() if t not in verdicts and len({*cells}) == 2]
    values = {}
    for key, found in (("label.topic", [*verdicts]), ("windows.trigger", signals)):
        counts = "; ".join(f"{topic} ({counts_of(words[topic])})" for topic in found or words)
        notes[key] = counts if len(found) == 1 else f"one of {counts}"
        values[key] = found[0] if len(found) == 1 else UNKNOWN
    if len(verdicts) == 1:
        (source,) = verdicts.values()
        values |= {"label.good": source.good, "label.bad": source.bad}
    if len(signals) == 1:
        value = max({*words[signals[0]]})
        values["windows.trigger"] = f"register={value}@{signals[0]}"
    return values


def _listing(path: Path) -> dict[str, Any]:
    """Return the keys for a file with windows and labels; none if it is no such listing."""
    form = Description().text
    try:
        table = listing_table(path, (), form)
    except DataError:
        return {}
    names = {name.lower(): name for name in table.columns}
    start, end = (next((names[n] for n in some if n in names), "") for some in (STARTS, ENDS))
    words = {name: table.words(name) for name in table.columns if name not in (start, end)}
    sources = [_known(name, cells) for name, cells in words.items()]
    source = next(filter(None, sources), None)
    key = next((name for name, cells in words.items() if len({*cells}) == len(cells)), "")
    if not (start and end and source and key):
        return {}
    is_number = all(cell.replace(".", "", 1).isdigit() for cell in table.words(start))
    unit = "s" if is_number else "iso"
    times = [column_times(table, name, unit, Clock(), form) for name in (start, end)]
    seconds = np.median(times[1][0] + times[1][1] - times[0][0] - times[0][1])
    listing = {"listing": path.name, "key": key}
    windows = {**listing, "start": start, "end": end, "format": unit}
    label = {**listing, "column": source.column, "good": source.good, "bad": source.bad}
    values: dict[str, Any] = {f"windows.{name}": value for name, value in windows.items()}
    values |= {f"label.{name}": value for name, value in label.items()}
    return values | {"traces.lengths": "pad", "seconds": float(seconds)}


def _known(name: str, words: Any) -> LabelSource | None:
    """Return a column or topic as a source of labels, if all its words are plain verdicts."""
    source = labels.with_meanings(LabelSource(column=name), words)
    is_label = bool(source.good or source.bad) and UNKNOWN not in source.good + source.bad
    return source if is_label and len({*words}) < MOST_WORDS else None
