"""A folder of CSV files, one an insertion, in the order of their names: `run_2.csv` comes before `run_10.csv`."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..errors import DataError
from ..traces import is_time
from .dataset import Asked, Dataset, Fault, UnreadableError
from .labels import Named, collect, listed
from .lengths import Collected, as_dataset
from .text import read_header, read_recording

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
    labels, faults = (Named(asked.label), []) if asked.labels is None else listed(asked.labels, asked.part, list(names))
    found = Collected(folder.resolve().name, _channels(ordered, asked, folder), faults)
    collect(_read(ordered, found, timed=asked.rate_hz is None), labels, found)
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


def _read(paths: dict[str, Path], found: Collected, timed: bool) -> Iterator[tuple[str, Any, float | None]]:
    for name, path in paths.items():
        try:
            yield name, *read_recording(path, found.channels, timed)
        except (OSError, UnreadableError) as error:
            found.faults.append(Fault(name, getattr(error, "line", 0), str(error)))
            yield name, None, None


def leave_out_other_rates(found: Collected) -> None:
    """A recording at another rate is another trace of the same insertion: it is a fault."""
    known = {i: each.rate_hz for i, each in enumerate(found.read) if each.rate_hz is not None}
    usual = max(known.values(), key=lambda one: sum(abs(rate - one) <= NEAR * one for rate in known.values()), default=0.0)
    off = {i: rate for i, rate in known.items() if abs(rate - usual) > NEAR * usual}
    found.leave_out({i: f"Expected timestamps at {usual:g} Hz, as the others have, got {r:g} Hz" for i, r in off.items()})
