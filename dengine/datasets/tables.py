"""Tables: a folder of CSV files, one an insertion; one as CSV, Parquet or a DataFrame, wide, a row an insertion, or long.

Columns `FZ_0 … FZ_999` of a wide table are a channel FZ, `0 … 999` or `x1 … x1000` one without need of a name; further
channels have as many. A long table has a row a sample, as historians export it, and a column of parts.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, listed
from ..files import reading
from ..traces import is_time
from . import labels
from .dataset import Asked, Collected, Dataset, Fault, Recorded, UnreadableError, as_dataset
from .text import cells_of, decoded, floats, numbers, rate_of, read_recording, read_table

if TYPE_CHECKING:
    import pandas as pd

FORCE = "FZ_Base"  # what a UR cell calls the force along the insertion
NUMBERED = re.compile(r"(.*?)[_\-. \[]*(\d+)\]?")


def read_folder(folder: Path, name: str, asked: Asked) -> Dataset:
    """The recordings below a folder, `run_2.csv` before `run_10.csv`; DataError where none can be read."""
    skipped = None if asked.labels is None else Path(asked.labels).resolve()
    paths = [p for p in folder.rglob("*") if p.suffix.lower() == ".csv" and (p.is_file() or p.is_symlink())]
    seen = {p.relative_to(folder): p for p in paths if p.resolve() != skipped}
    named = {p.as_posix(): path for p, path in seen.items() if not any(word.startswith(".") for word in p.parts)}
    if not named:
        have = listed(sorted(p.name for p in folder.iterdir()))
        do = f" among {have}; put what they hold into one table" if have else ""
        raise DataError(f"Expected CSV files, one an insertion, in the folder {folder}, found none{do}.")
    if asked.labels is None and asked.part != "part":
        raise DataError(f"Expected a file of labels with a column {asked.part}: a folder's names tell no parts' numbers.")
    if asked.labels is None:
        told = labels.named(asked.label, asked.words)
    else:
        told = labels.listed(asked.labels, asked.part, list(named), asked.words)
    found = Collected(name, asked.channels or _usual_channel(named.values(), folder))
    ordered = {name: named[name] for name in sorted(named, key=natural)}
    read = partial(read_recording, channels=found.channels, timed=asked.rate_hz is None, encodings=found.encodings)
    try:
        labels.collect(ordered, read, told, found)
    except DataError as error:
        if asked.label or asked.labels or (listing := _listing(named)) is None:
            raise
        advice = f"{listing.name} names files; give it, labels={str(listing)!r}"
        raise DataError(f"Expected labels in {folder}: {advice}.") from error
    return as_dataset(found, asked)


def _header(path: Path, lines: int = 1) -> list[list[str]]:
    """The cells of a file's first lines; none where they cannot be read, which is said when the whole file is."""
    with suppress(OSError, UnreadableError), path.open("rb") as file:
        text, _ = decoded(b"\n".join(file.read(2**18).split(b"\n")[:lines]))
        return list(cells_of(text).values())
    return []


def _listing(named: Mapping[str, Path]) -> Path | None:
    """The file whose second line names another one, as a file of labels does."""
    stems = {path.stem.lower() for path in named.values()}
    for path in named.values():
        words = {word.lower().removesuffix(".csv") for row in _header(path, 2)[1:] for word in row}
        if words & (stems - {path.stem.lower()}):
            return path
    return None


def natural(name: str) -> list[tuple[int, int, str]]:
    """A key that sorts numbers in a name by their size."""
    words = re.split(r"(\d+)", name.lower())
    return [(0, int(word), "") if word.isdecimal() else (1, 0, word) for word in words if word]


def _usual_channel(paths: Iterable[Path], folder: Path) -> tuple[str, ...]:
    """The force, or the only channel that there is."""
    headers = [tuple(name for name in row if name and not is_time(name)) for path in paths for row in _header(path)]
    if not any(headers) or FORCE.lower() in {name.lower() for header in headers for name in header}:
        return (FORCE,)
    usual = Counter(headers).most_common(1)[0][0]
    if len(usual) != 1:
        have = ", ".join(usual) or "none"
        first = usual[0] if usual else FORCE
        raise DataError(f"Expected the channel to be named, as in channel={first!r}; the columns of {folder} are {have}.")
    return usual


def read_csv(path: Path, name: str, asked: Asked) -> Dataset:
    """One CSV file with a header."""
    import pandas as pd

    encodings = Counter[str]()
    try:
        frame, faults = read_table(path, encodings)
    except UnreadableError as error:
        raise DataError(f"Cannot read {path}: {Fault(path.name, error.line, str(error))}.") from error
    told = pd.Series([word for word in frame.columns if not word.isdecimal()], dtype=object)
    if 2 * (len(told) - len(floats(told)[1])) > len(frame.columns) > 2:
        raise DataError(f"Expected a header in {path}, its first line is of numbers; call it FZ_0, FZ_1, ..., label.")
    if frame.empty:
        raise DataError(f"Expected rows that can be read in {path}, found none.")
    return from_frame(frame, asked, name, path.name, faults, encodings)


def read_parquet(path: Path, name: str, asked: Asked) -> Dataset:
    """One Parquet file, by pyarrow."""
    import pandas as pd

    with reading(path, "a Parquet file", "pyarrow", "files"):
        frame = pd.read_parquet(path)
    return from_frame(frame, asked, name, path.name)


def from_frame(
    frame: pd.DataFrame,
    asked: Asked,
    name: str = "data",
    source: str = "row",
    faults: Sequence[Fault] | None = None,
    encodings: Counter[str] | None = None,
) -> Dataset:
    """A table in memory. faults, encodings : of its file, whose lines are its index; None: rows count from 1.

    An empty cell before others is a NaN: the engine finds it, and the part is verified. A row whose last cells are empty is
    a shorter trace. A row with text in it, or no label, is a fault.
    """
    import pandas as pd

    frame = frame.set_axis([str(name) for name in frame.columns], axis=1)
    frame = frame.set_axis(range(1, len(frame) + 1)) if faults is None else frame
    twice = frame.columns[frame.columns.duplicated()]
    if len(twice):
        raise DataError(f"Expected each column once in {source}, {twice[0]} is there more often.")
    found = Collected(name, (), list(faults or []), encodings=encodings or Counter())
    if asked.time is not None or asked.labels is not None:
        return _from_long(frame, asked, found, source)
    label = _label_column(frame, asked)
    if asked.part != "part" and asked.part not in frame:
        raise DataError(f"Expected a column {asked.part} of parts' numbers, found {listed(frame.columns)}.")
    columns = _sample_columns([name for name in frame.columns if name not in (label, asked.part)], asked)
    blocks, wrong = [], dict[int, str]()
    for names in columns.values():
        values, odd = numbers(frame[names])
        blocks.append(values)
        wrong = odd | wrong
    found.channels = tuple(filter(None, columns))
    words = frame[label].tolist()
    parts = frame.get(asked.part, pd.Series("", frame.index)).astype(object).fillna("")

    def recorded(line: int, trace: NDArray[np.float32], word: Any, part: Any) -> Recorded:
        if line in wrong:
            raise UnreadableError(wrong[line])
        number = str(part).removesuffix(".0").strip() or None
        return Recorded(_ended(trace), labels.label_of(word, asked.words), f"{source}, line {line}", number)

    for row in zip(frame.index, np.stack(blocks, axis=1), words, parts, strict=True):
        found.take(source, partial(recorded, *row), row[0])
    return as_dataset(found, asked)


def _from_long(frame: pd.DataFrame, asked: Asked, found: Collected, source: str) -> Dataset:
    """A row a sample: the rows of a part, by their times, are one insertion. A label is a column, or in a file of parts."""
    time = asked.time or next((name for name in frame.columns if is_time(name)), "")
    for name in (asked.part, time):
        if name not in frame:
            wanted = f"a row a sample in {source}, with columns of parts (part) and times (time)"
            advice = f"; name {names}" if (names := _long_columns(frame, asked)) else ""
            raise DataError(f"Expected {wanted}, found {listed(frame.columns)}{advice}.")
    label = None if asked.labels is not None else _label_column(frame, asked)
    frame = _row_a_sample(frame, [asked.part, time, *([label] if label else [])], asked)
    left = [name for name in frame.columns if name not in (asked.part, time, label) and not floats(frame[name])[1]]
    found.channels = _chosen(left, asked)
    times, odd = floats(frame[time])
    frame = frame.assign(**{time: frame[time] if odd else times})
    parts = {str(part): rows for part, rows in frame.groupby(asked.part, sort=False)}

    def read(rows: pd.DataFrame) -> tuple[NDArray[np.float32], float | None]:
        values, wrong = numbers((rows := rows.sort_values(time, kind="stable"))[list(found.channels)])
        if wrong:
            raise UnreadableError(wrong[min(wrong)], min(wrong))
        return np.ascontiguousarray(values.T), None if asked.rate_hz else rate_of(rows, time)

    def find(part: str) -> labels.Known:
        words = parts[part][label].dropna().unique().tolist()
        if len(words) != 1:
            raise UnreadableError(f"Expected one label in column {label}, got {listed(words) or 'none'}")
        return labels.label_of(words[0], asked.words), None

    if asked.labels is None:
        told = labels.Labels(find, "name the column of labels (label)")
    else:
        told = labels.listed(asked.labels, "part", list(parts), asked.words)
    labels.collect(parts, read, told, found)
    return as_dataset(found, asked)


def _row_a_sample(frame: pd.DataFrame, known: list[str], asked: Asked) -> pd.DataFrame:
    """Of a table with a row a signal, told apart by tags, one with a column each; known : of parts, times, and labels."""
    apart = [] if not frame.duplicated(known[:2]).any() else [name for name in frame if name not in known]
    tags = [name for name in apart if floats(frame[name])[1] and not frame.duplicated([*known[:2], name]).any()]
    values = [name for name in apart if name not in tags and not floats(frame[name])[1]]
    if not tags or len(values) != 1:
        return frame
    have = frame[tags[0]].unique().tolist()
    if not asked.channels or not set(asked.channels) <= set(have):
        told = f"{listed(have)}, as column {tags[0]} calls them"
        raise DataError(f"Expected the channel to be named, as in channel={have[0]!r}; there are {told}.")
    picked = frame[frame[tags[0]].isin(asked.channels)]
    wide = picked.pivot(index=known, columns=tags[0], values=values[0])  # noqa: PD010 - pivot_table would average
    return wide.reset_index().set_axis(range(1, len(wide) + 1))


def _long_columns(frame: pd.DataFrame, asked: Asked) -> str:
    """How to say which column is what, where a table looks as if it had a row a sample; else nothing."""
    numbered = Counter(found[1] for name in frame.columns if (found := NUMBERED.fullmatch(name)))
    time = next((name for name in frame.columns if is_time(name)), None)
    if time is None or max(numbered.values(), default=0) > 2:
        return ""
    rows = frame.bfill()  # a label may stand in a part's last row alone
    changes = {name: int((rows[name] != rows[name].shift()).sum()) for name in frame.columns if name != time}
    few = [name for name, n in changes.items() if 2 <= n <= len(frame) / 5]
    if not few:
        return ""
    part, label = max(few, key=changes.__getitem__), min(few, key=changes.__getitem__)
    told = f"label={label!r}" if label != part else "labels='labels.csv', a file of parts and labels"
    told = f" and time={time!r}" if asked.labels is not None else f", time={time!r} and {told}"
    return f"the columns that tell which part it is, when, and the label, as in part={part!r}{told}"


def _chosen(have: Sequence[str], asked: Asked) -> tuple[str, ...]:
    """The channels that were asked for, the force, or the only one; DataError for one that is not there, or several."""
    chosen = asked.channels or ((FORCE,) if FORCE in have else tuple(have))
    missing = [name for name in chosen if name not in have]
    if missing or not chosen:
        raise DataError(f"Expected the channel {listed(missing) or 'of the samples'}, found {listed(have) or 'none'}.")
    if not asked.channels and len(chosen) > 1:
        raise DataError(f"Expected the channel to be named, as in channel={chosen[0]!r}; there are {listed(have)}.")
    return chosen


def _ended(trace: NDArray[np.float32]) -> NDArray[np.float32]:
    """(C, T) without the last samples that no channel has; whole where there is none at all."""
    known = np.flatnonzero(~np.isnan(trace).all(axis=0))
    return trace[:, : known[-1] + 1] if len(known) else trace


def _label_column(frame: pd.DataFrame, asked: Asked) -> str:
    if asked.label is not None:
        if asked.label not in frame:
            raise DataError(f"Expected a column {asked.label} of labels, found {listed(frame.columns)}.")
        return asked.label
    found = labels.column_among(list(frame.columns), labels.LABEL_COLUMNS)
    if asked.time is None and (advice := _long_columns(frame, asked)):
        raise DataError(f"Expected a row an insertion, got a row a sample: {listed(frame.columns)}; name {advice}.")
    if found is not None:
        return str(frame.columns[found])
    numbered = Counter(match[1] for name in frame.columns if (match := NUMBERED.fullmatch(name)))
    left = [name for name in frame.columns if (match := NUMBERED.fullmatch(name)) is None or numbered[match[1]] == 1]
    if asked.time is None and len(left) == len(frame.columns) and any(is_time(name) for name in left):
        raise DataError(f"Expected a row an insertion, got {listed(left)}, as in one recording; give its folder.")
    have = listed(left or frame.columns)
    raise DataError(f"Expected a column of labels, y or label, found {have}; name it: label='...'.")


def _sample_columns(names: list[str], asked: Asked) -> dict[str, list[str]]:
    """Channel -> its columns, in the order of their numbers: where one is missing, what comes after it would be shifted."""
    groups: dict[str, list[tuple[int, str]]] = {}
    for name in names:
        found = NUMBERED.fullmatch(name)
        if found:
            groups.setdefault(found[1], []).append((int(found[2]), name))
    several = {name: sorted(those) for name, those in groups.items() if len(those) > 1}
    if not several:
        raise DataError(f"Expected samples in numbered columns, as FZ_0, FZ_1, ..., found {listed(names)}.")
    for those in several.values():
        steps = np.diff([number for number, _ in those])
        for i in np.flatnonzero(steps != np.median(steps))[:1].tolist():
            after = f"after {those[i][1]} comes {those[i + 1][1]}"
            raise DataError(f"Expected columns that are numbered one by one, {after}.")
    chosen = _chosen(list(several), asked)
    if len({len(several[name]) for name in chosen}) > 1:
        each = ", ".join(f"{name} {len(several[name])}" for name in chosen)
        raise DataError(f"Expected as many samples of each channel, got {each}.")
    return {name: [column for _, column in several[name]] for name in chosen}
