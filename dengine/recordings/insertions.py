"""The insertions of a bag: one long wrench topic cut by a trigger, and their labels.

Labels are a topic of their own, of which the first message after an insertion has begun counts; or a file of labels that
names the insertions by their numbers, from 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DataError
from .asked import Asked
from .bag import ALIASES, AXES, Messages, axis_of, files_of, must_have, read_messages, topics_of, wrench_topic
from .dataset import Dataset, Fault, UnreadableError
from .labels import Listed, label_of, listed
from .lengths import Collected, as_dataset
from .stream import Insertion, cut_stream, usual_step
from .triggers import Active, Trigger, as_trigger

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
