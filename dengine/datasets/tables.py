"""Tables: a folder of CSV files, one an insertion; one as CSV, Parquet or a DataFrame, wide, a row an insertion, or long.

Columns `FZ_0 … FZ_999` of a wide table are a channel FZ, `0 … 999` or `x1 … x1000` one without need of a name; further
channels have as many. A long table has a row a sample, as historians export it, and a column of parts.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
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
from .text import NOTHING, Timed, cells_of, decoded, floats, numbers, read_recording, read_table, recording_of

if TYPE_CHECKING:
    import pandas as pd

FORCE = "FZ_Base"  # what a UR cell calls the force along the insertion
NUMBERED = re.compile(r"(?P<channel>.*?)[_\-. \[]*(?P<number>\d+)\]?")  # FZ_0
FIRST = re.compile(r"[A-Za-z]{0,6}[_\-. ]?(?P<number>\d+)[_\-. ]+(?P<channel>\D.*)")  # s000_fz
MANY = 8  # numbered columns of a channel, which a single recording has none of
FEWEST = 0.75  # of a wide table's columns that are numbered
SUFFIXES = (".csv", ".parquet", ".pq", ".npz")


def recordings_in(folder: Path, asked: Asked) -> dict[str, Path]:
    """A folder's files by their path in it, `run_2.csv` before `run_10.csv`; of CSV files, where others are, none."""
    skipped = None if asked.labels is None else Path(asked.labels).resolve()
    paths = [p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES and (p.is_file() or p.is_symlink())]
    seen = {p.relative_to(folder): p for p in paths if p.resolve() != skipped}
    named = {p.as_posix(): path for p, path in seen.items() if not any(word.startswith(".") for word in p.parts)}
    if not named:
        have = listed(sorted(p.name for p in folder.iterdir()))
        wanted = f"CSV files, one an insertion, or tables ({', '.join(SUFFIXES)}), in the folder {folder}"
        raise DataError(f"Expected {wanted}, found none{f' among {have}; save them as such' if have else ''}.")
    others = [name for name, path in named.items() if path.suffix.lower() != ".csv"]  # beside a list of labels
    return {name: named[name] for name in sorted(others or named, key=natural)}


def hold_many(named: Mapping[str, Path], asked: Asked) -> bool:
    """Whether a folder's files hold many insertions each, as tables and archives do; CSV files may be one each."""
    path = next(iter(named.values()))
    if asked.time is not None or path.suffix.lower() != ".csv":
        return True
    header = _top(path)[0]
    if sum(len(names) for names in _numbered(header).values() if len(names) >= MANY) > FEWEST * len(header):
        return True
    with suppress(DataError):
        return asked.labels is None and not [labels.named(asked.label, asked.words).find(name) for name in named]
    known = asked.part in header or labels.column_among(header, labels.LABEL_COLUMNS) is not None
    return len(named) == 1 or (known and bool(_long_columns(read_table(path)[0], asked, "")))


def read_folder(folder: Path, named: Mapping[str, Path], name: str, asked: Asked) -> Dataset:
    """The recordings of a folder, a file each, as `recordings_in` names them; DataError where none can be read."""
    if asked.labels is None and asked.part != "part":
        raise DataError(f"Expected a file of labels with a column {asked.part}: a folder's names tell no parts' numbers.")
    if asked.labels is None:
        told = labels.named(asked.label, asked.words)
    else:
        told = labels.listed(asked.labels, asked.part, list(named), asked.words)
    found = Collected(name, asked.channels or _usual_channel(named.values(), asked))
    read = partial(read_recording, channels=found.channels, timed=asked.rate_hz is None, encodings=found.encodings)
    try:
        labels.collect(named, read, told, found).must_mean_something()
    except DataError as error:
        if asked.label or asked.labels or (listing := _listing(folder, named)) is None:
            raise
        advice = f"{listing.name} names files; give it, labels={str(listing)!r}"
        raise DataError(f"Expected labels in {folder}: {advice}.") from error
    return as_dataset(found, asked)


def _top(path: Path) -> list[list[str]]:
    """The cells of a CSV file's first lines; none where they cannot be read, which is said when the whole file is."""
    with suppress(UnreadableError, OSError), path.open("rb") as file:
        text, _ = decoded(b"\n".join(file.read(2**18).split(b"\n")[:100]))
        return list(cells_of(text).values()) or [[]]
    return [[]]


def _listing(folder: Path, named: Mapping[str, Path]) -> Path | None:
    """The file whose second line names another one, as a file of labels does."""
    stems = {path.stem.lower() for path in named.values()}
    words = {path: {word.lower().removesuffix(".csv") for word in _top(path)[-1]} for path in folder.rglob("*.csv")}
    return next((path for path, said in words.items() if said & (stems - {path.stem.lower()})), None)


def natural(name: str) -> list[tuple[int, int, str]]:
    """A key that sorts numbers in a name by their size."""
    words = re.split(r"(\d+)", name.lower())
    return [(0, int(word), "") if word.isdecimal() else (1, 0, word) for word in words if word]


def _usual_channel(paths: Iterable[Path], asked: Asked) -> tuple[str, ...]:
    """The force, or the only channel that there is."""
    headers = [tuple(name for name in _top(path)[0] if name and not is_time(name)) for path in paths]
    if not any(headers) or FORCE.lower() in {name.lower() for header in headers for name in header}:
        return (FORCE,)
    return _chosen(Counter(headers).most_common(1)[0][0], asked)


def read_tables(named: Mapping[str, Path], name: str, asked: Asked) -> Dataset:
    """CSV and Parquet files of one form, one after the other. DataError where their columns are not the same."""
    found = Collected(name, ())
    tables: dict[str, pd.DataFrame] = {}
    for source, path in named.items():
        try:
            frame, faults = read_table(path, found.encodings) if path.suffix.lower() == ".csv" else _parquet(path)
        except UnreadableError as error:
            raise DataError(f"Cannot read {path}: {Fault(path.name, error.line, str(error))}.") from error
        if frame.empty:
            raise DataError(f"Expected rows that can be read in {path}, found none.")
        found.faults += [replace(fault, source=source) for fault in faults]
        tables[source] = frame
        found.beside = next((str(p) for p in path.parent.glob("*.csv") if p not in named.values()), found.beside)
    return _from_tables(tables, asked, found)


def _parquet(path: Path) -> tuple[pd.DataFrame, list[Fault]]:
    import pandas as pd

    with reading(path, "a Parquet file", "pyarrow", "files"):
        return _counted(pd.read_parquet(path)), []


def _counted(frame: pd.DataFrame) -> pd.DataFrame:
    """With names that are texts, and rows from 1."""
    return frame.set_axis(list(map(str, frame.columns)), axis=1).set_axis(range(1, len(frame) + 1))


def from_frame(frame: pd.DataFrame, asked: Asked) -> Dataset:
    """A table in memory, whose rows count from 1."""
    return _from_tables({"row": _counted(frame)}, asked, Collected("data", ()))


def _from_tables(tables: Mapping[str, pd.DataFrame], asked: Asked, found: Collected) -> Dataset:
    """Tables of one form, by the names of their files, whose lines are their index."""
    first, *_ = tables
    for source, frame in tables.items():
        twice = frame.columns[frame.columns.duplicated()]
        if len(twice):
            raise DataError(f"Expected each column once in {source}, {twice[0]} is there more often.")
        if apart := listed(sorted(_form(frame) ^ _form(tables[first]))):
            raise DataError(f"Expected the same columns in {first} and in {source}, only one of them has {apart}.")
    if asked.time is not None or asked.labels is not None:
        return _from_long(_one_long(tables, asked), asked, found, first)
    for source, frame in tables.items():
        _take_rows(frame, asked, found, source)
    return as_dataset(found, asked)


def _form(frame: pd.DataFrame) -> set[str]:
    """The columns of a table, without regard to how many samples it has of a channel."""
    several = {name: channel for channel, names in _numbered(frame.columns).items() if len(names) > 1 for _, name in names}
    return {several.get(name, name) for name in frame.columns}


def _take_rows(frame: pd.DataFrame, asked: Asked, found: Collected, source: str) -> None:
    """A row an insertion.

    An empty cell before others is a NaN: the engine finds it, and the part is verified. A row whose last cells are empty is
    a shorter trace. A row with text in it, or no label, is a fault.
    """
    label = _label_column(frame, asked, found)
    if asked.part != "part" and asked.part not in frame:
        raise DataError(f"Expected a column {asked.part} of parts' numbers, found {listed(frame.columns)}.")
    columns = _sample_columns([name for name in frame.columns if name not in (label, asked.part)], asked)
    values, wrong = numbers(frame[[name for names in columns.values() for name in names]])
    found.channels = tuple(filter(None, columns))
    parts = [""] * len(frame) if asked.part not in frame else frame[asked.part].astype(object).fillna("").tolist()

    def recorded(line: int, trace: NDArray[np.float32], word: Any, part: Any) -> Recorded:
        if line in wrong:
            raise UnreadableError(wrong[line])
        number = str(part).removesuffix(".0").strip() or None
        return Recorded(_ended(trace), labels.label_of(word, asked.words), f"{source}, line {line}", number)

    for row in zip(frame.index, values.reshape(len(frame), len(columns), -1), frame[label].tolist(), parts, strict=True):
        found.take(source, partial(recorded, *row), row[0])


def _one_long(tables: Mapping[str, pd.DataFrame], asked: Asked) -> pd.DataFrame:
    """Long tables as one. A number that comes again in another file is another part's, called by its file too.

    Only the last of a file, if the next one begins with it, goes on there.
    """
    import pandas as pd

    frame = pd.concat(tables.values())
    if len(tables) == 1 or asked.part not in frame:
        return frame
    at, last, homes = dict[str, str](), "", list[str]()
    for source, table in tables.items():
        part = table[asked.part].astype(str).tolist()
        at = {number: at[last] if number == last == part[0] else source for number in part}
        homes, last = homes + [f"{at[number]}/{number}" for number in part], part[-1]
    number, home = frame[asked.part].astype(str).where(frame[asked.part].notna()), pd.Series(homes, frame.index)
    twice = home.groupby(number.to_numpy()).transform("nunique") > 1
    return frame.assign(**{asked.part: number.where(~twice, home)})


def _from_long(frame: pd.DataFrame, asked: Asked, found: Collected, source: str) -> Dataset:
    """A row a sample: the rows of a part, by their times, are one insertion. A label is a column, or in a file of parts."""
    time = asked.time or next((name for name in frame.columns if is_time(name)), "")
    for name in (asked.part, time):
        if name not in frame:
            wanted = f"a row a sample in {source}, with columns of parts (part) and times (time)"
            advice = f"; name {names}" if (names := _long_columns(frame, asked, found.beside)) else ""
            raise DataError(f"Expected {wanted}, found {listed(frame.columns)}{advice}.")
    label = None if asked.labels is not None else _label_column(frame, asked, found)
    frame = _row_a_sample(frame, [asked.part, time, *([label] if label else [])], asked)
    left = [name for name in frame.columns if name not in (asked.part, time, label) and not floats(frame[name])[1]]
    found.channels = _chosen(left, asked)
    times, odd = floats(frame[time])
    frame = frame.assign(**{time: frame[time] if odd else times})
    parts = {str(part): rows for part, rows in frame.groupby(asked.part, sort=False)}

    places = [frame.columns.get_loc(name) for name in found.channels]

    def read(rows: pd.DataFrame) -> Timed:
        return recording_of(rows.sort_values(time, kind="stable"), places, asked.rate_hz is None, time)

    def find(part: str) -> labels.Known:
        words = [word for word in parts[part][label].unique().tolist() if str(word).strip().lower() not in NOTHING]
        if len(words) != 1:
            raise UnreadableError(f"Expected one label in column {label}, got {listed(words) or 'none'}")
        return labels.label_of(words[0], asked.words), None

    told = labels.Labels(find, "name the column of labels (label)")
    if asked.labels is not None:
        told = labels.listed(asked.labels, "part", list(parts), asked.words)
    return as_dataset(labels.collect(parts, read, told, found), asked)


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
    came = {part: i for i, part in enumerate(picked[known[0]].unique())}  # a pivot sorts S10 before S9
    wide = wide.reset_index().sort_values(known[0], key=lambda parts: parts.map(came), kind="stable")
    return wide.set_axis(range(1, len(wide) + 1))


def _long_columns(frame: pd.DataFrame, asked: Asked, beside: str) -> str:
    """How to say which column is what, where a table looks as if it had a row a sample; else nothing."""
    time = next((name for name in frame.columns if is_time(name)), None)
    if time is None or max(map(len, _numbered(frame.columns).values()), default=0) > 2:
        return ""
    rows = frame.mask(frame == "").bfill()  # a label may stand in a part's last row alone
    changes = {name: int((rows[name] != rows[name].shift()).sum()) for name in frame.columns if name != time}
    few = [name for name, n in changes.items() if 2 <= n <= len(frame) / 5]
    if not few:
        return ""
    part = max(few, key=changes.__getitem__)
    label = min(few, key=lambda name: (name.lower() not in labels.LABEL_COLUMNS, changes[name]))
    told = f"label={label!r}" if label != part else f"labels={beside!r}, a file of parts and labels"
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


def _label_column(frame: pd.DataFrame, asked: Asked, found: Collected) -> str:
    if asked.label is not None:
        if asked.label not in frame:
            raise DataError(f"Expected a column {asked.label} of labels, found {listed(frame.columns)}.")
        return asked.label
    if asked.time is None and (advice := _long_columns(frame, asked, found.beside)):
        raise DataError(f"Expected a row an insertion, got a row a sample: {listed(frame.columns)}; name {advice}.")
    if (known := labels.column_among(list(frame.columns), labels.LABEL_COLUMNS)) is not None:
        return str(frame.columns[known])
    several = {name for names in _numbered(frame.columns).values() if len(names) > 1 for _, name in names}
    left = [name for name in frame.columns if name not in several]
    if asked.time is None and len(left) == len(frame.columns) and any(is_time(name) for name in left):
        do = "as in one recording; give a folder of such CSV files"
        raise DataError(f"Expected a row an insertion, got {listed(left)}, {do}.")
    likely = min(left, key=lambda name: (frame[name].nunique() < 2, frame[name].nunique()), default="...")
    have = listed(left or frame.columns)
    raise DataError(f"Expected a column of labels, y or label, found {have}; name it: label={likely!r}.")


def _numbered(names: Iterable[str]) -> dict[str, list[tuple[int, str]]]:
    """Channel -> the numbers that its columns have, and these columns, by the pattern that most of one channel have."""
    found: list[dict[str, list[tuple[int, str]]]] = [{}, {}]
    for groups, pattern in zip(found, (NUMBERED, FIRST), strict=True):
        for match in filter(None, map(pattern.fullmatch, names)):
            groups.setdefault(match["channel"], []).append((int(match["number"]), match[0]))
    return max(found, key=lambda groups: max(map(len, groups.values()), default=0))


def _sample_columns(names: list[str], asked: Asked) -> dict[str, list[str]]:
    """Channel -> its columns, in the order of their numbers: where one is missing, what comes after it would be shifted."""
    several = {name: sorted(those) for name, those in _numbered(names).items() if len(those) > 1}
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
