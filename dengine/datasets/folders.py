"""A folder of CSV files, one an insertion, in the order of their names: `run_2.csv` comes before `run_10.csv`."""

from __future__ import annotations

import os
import re
from collections import Counter
from pathlib import Path

from ..errors import DataError
from ..traces import is_time
from .dataset import Asked, Dataset, Fault, UnreadableError
from .labels import Listed, Named, listed, named
from .lengths import Collected, as_dataset
from .text import Recording, read_header, read_recording

FORCE = "FZ_Base"  # what a UR cell calls the force along the insertion
NEAR = 0.03  # of the others' rate


def read_folder(folder: Path, asked: Asked) -> Dataset:
    """The recordings below a folder; DataError where there are none, or none that can be read."""
    skipped = None if asked.labels is None else Path(asked.labels).resolve()
    paths = [p for p in folder.rglob("*") if p.suffix.lower() == ".csv" and (p.is_file() or p.is_symlink())]
    seen = {p.relative_to(folder): p for p in paths if p.resolve() != skipped}
    names = {p.as_posix(): path for p, path in seen.items() if not any(word.startswith(".") for word in p.parts)}
    if not names:
        raise DataError(f"Expected CSV files, one an insertion, in the folder {folder}, found none.")
    ordered = {name: names[name] for name in sorted(names, key=natural)}
    if asked.labels is None and asked.part != "part":
        raise DataError(f"Expected a file of labels with a column {asked.part}: a folder's names tell no parts' numbers.")
    labels, faults = (named(asked.label), []) if asked.labels is None else listed(asked.labels, asked.part, list(names))
    found = Collected(folder.resolve().name, _channels(ordered, asked, folder), faults)
    _read_all(ordered, labels, found, asked)
    if isinstance(labels, Listed):
        found.faults.extend(labels.unused())
    leave_out_other_rates(found)
    return as_dataset(found, asked)


def natural(name: str) -> list[tuple[int, int, str]]:
    """A key that sorts numbers in a name by their size."""
    words = re.split(r"(\d+)", name.lower())
    return [(0, int(word), "") if word.isdecimal() else (1, 0, word) for word in words if word]


def _channels(paths: dict[str, Path], asked: Asked, folder: Path) -> tuple[str, ...]:
    """Those that were asked for; else the force, or the only one there is."""
    if asked.channels:
        return asked.channels
    readable = [path for path in paths.values() if os.access(path, os.R_OK)]
    headers = Counter(tuple(n for n in read_header(path) if n and not is_time(n)) for path in readable)
    if not headers or any(FORCE.lower() in map(str.lower, header) for header in headers):
        return (FORCE,)
    usual = headers.most_common(1)[0][0]
    if len(usual) != 1:
        have = ", ".join(usual) or "none"
        raise DataError(f"Expected the channel to be named, as in channel={FORCE!r}; the columns of {folder} are {have}.")
    return usual


def _read_all(paths: dict[str, Path], labels: Named | Listed, found: Collected, asked: Asked) -> None:
    unlabelled = 0
    for name, path in paths.items():
        try:
            recording: Recording | None = read_recording(path, found.channels, timed=asked.rate_hz is None)
        except (OSError, UnreadableError) as error:
            recording = None
            found.faults.append(Fault(name, getattr(error, "line", 0), str(error)))
        try:
            label, part = labels.label(name)
        except UnreadableError as error:
            unlabelled += 1
            if recording is not None:  # one reason a file is enough
                found.faults.append(error.fault(name))
                recording = None
        if recording is not None:
            found.add(recording.values, label, name, part, recording.rate_hz)
    if unlabelled > len(paths) / 2:
        raise DataError(
            f"Expected a label for each recording, {unlabelled} of {len(paths)} have none, {found.faults[-1].source} for "
            f"one; {labels.advice()}."
        )


def leave_out_other_rates(found: Collected) -> None:
    """A recording at another rate is another trace of the same insertion: it is a fault."""
    known = [rate for rate in found.rates if rate is not None]
    if not known:
        return
    usual = max(known, key=lambda rate: sum(abs(other - rate) <= NEAR * rate for other in known))
    off = [i for i, rate in enumerate(found.rates) if rate is not None and abs(rate - usual) > NEAR * usual]
    found.leave_out({i: f"Expected timestamps at {usual:g} Hz, as the others have, got {found.rates[i]:g} Hz" for i in off})
