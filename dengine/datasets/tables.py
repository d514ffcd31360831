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
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, listed
from ..files import read_errors
from ..traces import is_time_column
from . import labels, units
from .clocks import floats, place_of_clock, seconds_of
from .dataset import (
    MOST_WORDS,
    Asked,
    Collected,
    Dataset,
    Fault,
    Recorded,
    UnknownWordError,
    UnlabelledError,
    UnreadableError,
    as_dataset,
)
from .numerals import UndecidedError
from .text import SUFFIXES as TEXTS
from .text import Sheet, Timed, cells_of, decoded, numbers, read_recording, read_table, recording_of

if TYPE_CHECKING:
    import pandas as pd

FORCE = "FZ_Base"  # what a UR cell calls the force along the insertion
NUMBERED = re.compile(r"(?P<channel>.*?)[_\-. \[]*(?P<number>\d+)\]?")  # FZ_0
FIRST = re.compile(r"[A-Za-z]{0,6}[_\-. ]?(?P<number>\d+)[_\-. ]+(?P<channel>\D.*)")  # s000_fz
ORDER = "\0order"  # a column of a long table's times in seconds, whose name no file has
MANY = 8  # numbered columns of a channel, which a single recording has none of
FEWEST = 0.75  # of a wide table's columns that are numbered
FEW = 20  # recordings that advice on a column is tried on
SUFFIXES = (*TEXTS, ".parquet", ".pq", ".npz")


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
    others = [name for name, path in named.items() if path.suffix.lower() not in TEXTS]  # beside a list of labels
    times = Counter(path.suffix.lower() for path in named.values())
    texts = [name for name, path in named.items() if times[path.suffix.lower()] == max(times.values())]
    return {name: named[name] for name in sorted(others or texts, key=natural)}


def hold_many(named: Mapping[str, Path], asked: Asked) -> bool:
    """Whether a folder's files hold many insertions each, as tables and archives do; CSV files may be one each."""
    path = next(iter(named.values()))
    if path.suffix.lower() not in TEXTS:
        return True
    header = _top(path, asked)[0]
    if asked.time is not None and asked.part in header:
        return True
    if sum(len(names) for names in _numbered(header).values() if len(names) >= MANY) > FEWEST * len(header):
        return True
    with suppress(DataError):
        return asked.labels is None and not [labels.named(asked.label, asked.words).find(name) for name in named]
    if len(named) > 1 and asked.part not in header and _one_label_each(named, asked):
        return False
    known = asked.part in header or labels.column_among(header, labels.LABEL_COLUMNS) is not None
    if len(named) == 1 or asked.time is not None:
        return True
    return known and bool(_long_columns(read_table(path, asked).frame, asked, ""))


def read_folder(folder: Path, named: Mapping[str, Path], name: str, asked: Asked) -> Dataset:
    """The recordings of a folder, a file each, as `recordings_in` names them; DataError where none can be read."""
    if asked.labels is None and asked.part != "part":
        raise DataError(f"Expected a file of labels with a column {asked.part}: a folder's names tell no parts' numbers.")
    label_source, column = _labels_of(named, asked)
    found = Collected(name, asked.channels or _usual_channel(named.values(), asked, column))
    if column is not None:
        found.notes[f"The labels are those in column {column} of each file"] += 1
    found.ordered = sorted(named, key=natural) == sorted(named, key=lambda name: natural(label_source.rest(name)))
    found.notes.update(_left_aside(folder, named, asked))
    mark = cache(partial(_mark_of, list(named.values()), asked))

    def read(path: Path) -> Timed:
        notes = Counter[str]()
        try:
            recording = read_recording(path, found.channels, asked, notes)
        except UndecidedError:
            notes.clear()
            if mark() is None:
                raise
            recording = read_recording(path, found.channels, asked, notes, mark())
        found.notes.update(notes)
        return recording

    try:
        labels.collect(named, read, label_source, found).must_mean_something()
    except DataError as error:
        advice = None
        if not (asked.label or asked.labels):
            advice = _listing(folder, named, asked) or (None if found.unknown else _advice(named, asked))
        if advice is None:
            raise
        raise DataError(f"{str(error).rpartition(';')[0]}; {advice}.") from error
    return as_dataset(found, asked)


def _labels_of(named: Mapping[str, Path], asked: Asked) -> tuple[labels.Labels, str | None]:
    """Where a folder's labels are; and in which column of its files, if there.

    A column is looked at where it is asked for, or where it has a label's name and no file's name tells a label.
    """
    if asked.labels is not None:
        return labels.listed(asked.labels, asked.part, list(named), asked.words), None
    header = _top(next(iter(named.values())), asked)[0]
    if asked.label is not None:
        column = asked.label if asked.label in header else None
    else:
        usual = [known for known in labels.LABEL_COLUMNS if known not in labels.SIGNALS]
        place = labels.column_among(header, usual)
        column = (
            None if place is None or set(_count_labels(named, labels.named(None, asked.words))) != {None} else header[place]
        )
    if column is not None:
        return labels.in_column(named, column, asked), column
    return labels.named(asked.label, asked.words), None


def _one_label_each(named: Mapping[str, Path], asked: Asked) -> bool:
    """Whether a column of the files tells labels, and the first file has one in it, as a recording has."""
    with suppress(DataError):
        source, column = _labels_of(named, asked)
        return column is not None and _count_labels([next(iter(named))], source)[None] == 0
    return False


def _count_labels(names: Iterable[str], source: labels.Labels) -> Counter[Any]:
    """Count the labels of names, the words that may be labels, "" for an empty one, and None for no label at all."""
    counts = Counter[Any]()
    for name in names:
        try:
            counts[source.find(name)[0]] += 1
        except UnknownWordError as error:
            counts[error.word] += 1
        except (UnreadableError, OSError) as error:
            counts["" if isinstance(error, UnlabelledError) else None] += 1
    return counts


def _look_like_labels(found: Counter[Any]) -> bool:
    """Whether most are labels, or words so few that a person can say their meaning."""
    words = set(+found) - {None, ""}
    return found.total() > 2 * found[None] and (words <= {0, 1} or 2 <= len(words) <= MOST_WORDS)


def _listing(folder: Path, named: Mapping[str, Path], asked: Asked) -> str | None:
    """How to name the file of labels that is in the folder: its last line names a recording, and it has most of them."""
    stems = {path.stem.lower() for path in named.values()}
    for path in sorted(path for path in folder.rglob("*") if path.suffix.lower() in TEXTS):
        words = {word.lower().removesuffix(path.suffix) for word in _top(path, Asked())[-1]}
        if words.isdisjoint(stems - {path.stem.lower()}):
            continue
        with suppress(DataError):
            if _look_like_labels(_count_labels(named, labels.listed(path, asked.part, list(named), asked.words))):
                return f"{path.name} names files: give it, labels={str(path)!r}"
    return None


def _advice(named: Mapping[str, Path], asked: Asked) -> str | None:
    """How to say where the labels of recordings are, if that was tried on them and tells most; else None."""
    likely = [
        (_count_labels(named, source), f"{why}, say so: {do}")
        for why, do, source in labels.likely(list(named), asked.words)
    ]
    found, advice = max(likely, key=lambda each: -each[0][None])
    if _look_like_labels(found) and found[0] and found[1]:
        return advice
    some = dict(list(named.items())[:: max(len(named) // FEW, 1)])
    columns = [name for name in _top(next(iter(named.values())), asked)[0] if name and not is_time_column(name)]
    known = {name: _count_labels(some, labels.in_column(some, name, asked)) for name in columns}
    telling = [name for name, found in known.items() if not found[None] and _look_like_labels(found) and len(+found) > 1]
    if telling:
        column = min(telling, key=lambda name: len(set(known[name]) - {0, 1, ""}))
        return f"if column {column} tells them, name it: label={column!r}"
    return None


def _mark_of(paths: Sequence[Path], asked: Asked) -> str | None:
    """The decimal mark of all files of a folder whose cells tell theirs; None where they have several, or none."""
    marks = set[str]()
    for path in paths:
        with suppress(UnreadableError, OSError):
            marks |= {read_table(path, asked).decimal} - {""}
    return marks.pop() if len(marks) == 1 else None


def _left_aside(folder: Path, named: Mapping[str, Path], asked: Asked) -> list[str]:
    """What to know of text files that are none of the recordings, for most files have another suffix."""
    suffix = next(iter(named.values())).suffix.lower()
    skipped = None if asked.labels is None else Path(asked.labels).resolve()
    paths = (path for path in folder.rglob("*") if path.suffix.lower() in TEXTS and path.is_file())
    aside = sorted(p.name for p in paths if p.suffix.lower() != suffix and p.resolve() != skipped)
    return [f"Not read, for most files are {suffix}: {listed(aside)}"] if aside else []


def _top(path: Path, asked: Asked) -> list[list[str]]:
    """The cells of a text file's first lines; none where they cannot be read, which is said when the whole file is."""
    with suppress(UnreadableError, OSError), path.open("rb") as file:
        text, _ = decoded(b"\n".join(file.read(2**18).split(b"\n")[:100]))
        cells = cells_of(text, asked.columns)
        return [cells.header, *cells.rows.values()]
    return [[]]


def natural(name: str) -> list[tuple[int, int, str]]:
    """A key that sorts numbers in a name by their size."""
    words = re.split(r"(\d+)", name.lower())
    return [(0, int(word), "") if word.isdecimal() else (1, 0, word) for word in words if word]


def _usual_channel(paths: Iterable[Path], asked: Asked, label: str | None = None) -> tuple[str, ...]:
    """The force, or the only channel that there is. label : a column that is none."""
    headers = [tuple(name for name in _channels_in(_top(path, asked), asked) if name != label) for path in paths]
    if not any(headers) or FORCE.lower() in {name.lower() for header in headers for name in header}:
        return (FORCE,)
    return _chosen(Counter(headers).most_common(1)[0][0], asked)


def _channels_in(top: list[list[str]], asked: Asked) -> list[str]:
    """The names of a header that are no clock's. top : the header, and some rows."""
    import pandas as pd

    header, *rows = top
    whole = [row for row in rows if len(row) == len(header)]
    clock = None
    with suppress(UnreadableError):
        frame = pd.DataFrame(whole, columns=header, dtype=object)
        clock = place_of_clock(frame, asked.time)
    return [name for i, name in enumerate(header) if name and i != clock and not is_time_column(name)]


def read_tables(named: Mapping[str, Path], name: str, asked: Asked) -> Dataset:
    """CSV and Parquet files of one form, one after the other. DataError where their columns are not the same."""
    found = Collected(name, ())
    tables: dict[str, pd.DataFrame] = {}
    units_by = dict[str, list[str]]()
    for source, path in named.items():
        try:
            is_text = path.suffix.lower() in TEXTS
            frame, faults, _, units_row, _ = read_table(path, asked, found.notes) if is_text else _parquet(path)
        except UnreadableError as error:
            raise DataError(f"Cannot read {path}: {Fault(path.name, error.line, str(error))}.") from error
        if frame.empty:
            raise DataError(f"Expected rows that can be read in {path}, found none.")
        found.faults += [replace(fault, source=source) for fault in faults]
        tables[source] = frame
        units_by[source] = units_row
        found.beside = next((str(p) for p in path.parent.glob("*.csv") if p not in named.values()), found.beside)
    first, *others = units_by
    for source in others:
        if units_by[source] != units_by[first]:
            one, two = (", ".join(units_by[name]) or "none" for name in (first, source))
            raise DataError(f"Expected the same units in {first} and in {source}, got {one} and {two}; convert one.")
    return _from_tables(tables, asked, found, units_by[first])


def _parquet(path: Path) -> Sheet:
    import pandas as pd

    with read_errors(path, "a Parquet file", "pyarrow", "files"):
        return Sheet(_with_row_numbers(pd.read_parquet(path)), [], 0, [], "")


def _with_row_numbers(frame: pd.DataFrame) -> pd.DataFrame:
    """With names that are texts, and rows from 1."""
    return frame.set_axis(list(map(str, frame.columns)), axis=1).set_axis(range(1, len(frame) + 1))


def from_frame(frame: pd.DataFrame, asked: Asked) -> Dataset:
    """A table in memory, whose rows count from 1."""
    return _from_tables({"row": _with_row_numbers(frame)}, asked, Collected("data", ()))


def _from_tables(
    tables: Mapping[str, pd.DataFrame], asked: Asked, found: Collected, units_row: Sequence[str] = ()
) -> Dataset:
    """Check tables of one form, and read them as wide or as long ones.

    tables : by the names of their files, or "row" for a frame in memory; their index numbers the lines.
    units_row : the units of their columns.
    """
    first, *_ = tables
    for source, frame in tables.items():
        for name in frame.columns:
            cell = frame[name].iloc[0] if (frame.columns == name).sum() == 1 and len(frame) else None
            if isinstance(cell, list | tuple | np.ndarray):
                do = "give a trace a row, its samples a column each, or load_dataset((X, y)) with the lists as X"
                raise DataError(f"Expected a number or a text a cell in {source}, column {name} holds lists; {do}.")
        twice = frame.columns[frame.columns.duplicated()]
        if len(twice):
            raise DataError(f"Expected each column once in {source}, {twice[0]} is there more often.")
        if apart := listed(sorted(_form(frame) ^ _form(tables[first]))):
            raise DataError(f"Expected the same columns in {first} and in {source}, only one of them has {apart}.")
    if asked.time is not None or asked.labels is not None:
        return _from_long(
            _one_long(tables, asked), asked, found, first, dict(zip(tables[first].columns, units_row, strict=False))
        )
    if advice := _long_columns(tables[first], asked, found.beside):
        have = listed(tables[first].columns)
        raise DataError(f"Expected a row an insertion, got a row a sample: {have}; a long table needs {advice}.")
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
    label = _label_column(frame, asked)
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
        return Recorded(_without_trailing_nan(trace), labels.label_of(word, asked.words), f"{source}, line {line}", number)

    for row in zip(frame.index, values.reshape(len(frame), len(columns), -1), frame[label].tolist(), parts, strict=True):
        found.take(source, partial(recorded, *row), row[0])


def _one_long(tables: Mapping[str, pd.DataFrame], asked: Asked) -> pd.DataFrame:
    """Concatenate long tables.

    The same part's number in two files means two parts: the file's name is then put before it. Exception: a part that ends
    one file and begins the next is one part.
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


def _from_long(frame: pd.DataFrame, asked: Asked, found: Collected, source: str, written: Mapping[str, str]) -> Dataset:
    """A row a sample: the rows of a part, by their times, are one insertion. A label is a column, or in a file of parts.

    written : the units of columns.
    """
    time = asked.time or next((name for name in frame.columns if is_time_column(name)), "")
    for name in (asked.part, time):
        if name not in frame:
            wanted = f"a row a sample in {source}, with columns of parts (part) and times (time)"
            advice = f"; name {names}" if (names := _long_columns(frame, asked, found.beside)) else ""
            raise DataError(f"Expected {wanted}, found {listed(frame.columns)}{advice}.")
    label = None if asked.labels is not None else _label_column(frame, asked)
    frame = _row_a_sample(frame, [asked.part, time, *([label] if label else [])], asked)
    left = [name for name in frame.columns if name not in (asked.part, time, label) and not floats(frame[name])[1]]
    found.channels = _chosen(left, asked)
    order, *_ = seconds_of(frame[time], time, written.get(time, ""))
    parts = {str(part): rows for part, rows in frame.assign(**{ORDER: order}).groupby(asked.part, sort=False)}

    places = [frame.columns.get_loc(name) for name in found.channels]
    how = replace(asked, time=time)

    def read(rows: pd.DataFrame) -> Timed:
        rows = rows.sort_values(ORDER, kind="stable").drop(columns=ORDER)
        timed = recording_of(rows, places, how, found.notes, [written.get(name, "") for name in rows.columns])
        return timed._replace(units=tuple(written.get(name) or units.split(name)[1] for name in found.channels))

    def find(part: str) -> labels.Known:
        return labels.agreed(parts[part][label], str(label), asked.words), None

    source_of_labels = labels.Labels(find, "name the column of labels (label)")
    if asked.labels is not None:
        source_of_labels = labels.listed(asked.labels, "part", list(parts), asked.words)
    return as_dataset(labels.collect(parts, read, source_of_labels, found), asked)


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
    """How to say which column is what, where that was not said, if a table looks as if it had a row a sample."""
    frame = frame.loc[:, ~frame.columns.duplicated(keep=False)]
    if max(map(len, _numbered(frame.columns).values()), default=0) > 2:
        return ""
    part = asked.part if asked.part in frame and frame[asked.part].duplicated().any() else ""
    time = asked.time or next((name for name in frame.columns if is_time_column(name)), "")
    time = time or next(
        (name for name in frame.columns if part and name != part and _rises_within_parts(frame, part, name)), ""
    )
    if not (time or part):
        return ""
    rows = frame.mask(frame == "").bfill()  # a label may stand in a part's last row alone
    others = [name for name in frame.columns if name not in (time, part)]
    changes = {name: int((rows[name] != rows[name].shift()).sum()) for name in others}
    few = [name for name, n in changes.items() if 2 <= n <= len(frame) / 5]
    if not (part or few):
        return ""
    hints = [] if part else [f"part={(part := max(few, key=changes.__getitem__))!r}"]
    if not asked.time:
        hints.append(f"time={time!r}" if time else "the column of times (time)")
    if not (asked.label or asked.labels):
        label = min(few, key=lambda name: (name.lower() not in labels.LABEL_COLUMNS, changes[name]), default=part)
        hints.append(f"label={label!r}" if label != part else _parts_listing(frame[part], beside, asked))
    return f"the columns that tell which part it is, when, and the label, as in {', '.join(hints)}" if hints else ""


def _rises_within_parts(frame: pd.DataFrame, part: str, name: str) -> bool:
    """Whether a column's numbers, or times as text, rise from row to row of each part."""
    with suppress(ValueError, TypeError):
        values, odd, _ = seconds_of(frame[name], name)
        same = (frame[part] == frame[part].shift()).to_numpy()
        return not odd and bool(same.any()) and bool((np.diff(values)[same[1:]] > 0).all())
    return False


def _parts_listing(parts: pd.Series, beside: str, asked: Asked) -> str:
    """How to name a file of parts and labels: the one beside the table, if it has most of them."""
    named = [str(part) for part in parts.unique()]
    with suppress(DataError):
        if _look_like_labels(_count_labels(named, labels.listed(beside, "part", named, asked.words))):
            return f"labels={beside!r}, a file of parts and labels"
    return "and a CSV file of parts and labels (labels)"


def _chosen(have: Sequence[str], asked: Asked) -> tuple[str, ...]:
    """The channels that were asked for, the force, or the only one; DataError for one that is not there, or several."""
    chosen = asked.channels or ((FORCE,) if FORCE in have else tuple(have))
    missing = [name for name in chosen if name not in have]
    if missing or not chosen:
        raise DataError(f"Expected the channel {listed(missing) or 'of the samples'}, found {listed(have) or 'none'}.")
    if not asked.channels and len(chosen) > 1:
        one = min(chosen, key=chosen.count)  # a name that is there twice is none
        raise DataError(f"Expected the channel to be named, as in channel={one!r}; there are {listed(have)}.")
    return chosen


def _without_trailing_nan(trace: NDArray[np.float32]) -> NDArray[np.float32]:
    """(C, T) without the last samples that no channel has; whole where there is none at all."""
    known = np.flatnonzero(~np.isnan(trace).all(axis=0))
    return trace[:, : known[-1] + 1] if len(known) else trace


def _label_column(frame: pd.DataFrame, asked: Asked) -> str:
    if asked.label is not None:
        if asked.label not in frame:
            raise DataError(f"Expected a column {asked.label} of labels, found {listed(frame.columns)}.")
        return asked.label
    if (known := labels.column_among(list(frame.columns), labels.LABEL_COLUMNS)) is not None:
        return str(frame.columns[known])
    several = {name for names in _numbered(frame.columns).values() if len(names) > 1 for _, name in names}
    left = [name for name in frame.columns if name not in several]
    if asked.time is None and len(left) == len(frame.columns) and any(is_time_column(name) for name in left):
        do = "as in one recording; give a folder of such CSV files"
        raise DataError(f"Expected a row an insertion, got {listed(left)}, {do}.")
    likely = [name for name in left if 2 <= frame[name].nunique() <= MOST_WORDS]
    do = (
        f"name it: label={min(likely, key=lambda name: frame[name].nunique())!r}" if likely else "add one that is called so"
    )
    raise DataError(f"Expected a column of labels, y or label, found {listed(left or frame.columns)}; {do}.")


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
        odd = np.flatnonzero(steps != np.median(steps))
        if len(odd):
            i = int(odd[0])
            after = f"after {those[i][1]} comes {those[i + 1][1]}"
            raise DataError(f"Expected columns that are numbered one by one, {after}.")
    chosen = _chosen(list(several), asked)
    if len({len(several[name]) for name in chosen}) > 1:
        counts = ", ".join(f"{name} {len(several[name])}" for name in chosen)
        raise DataError(f"Expected as many samples of each channel, got {counts}.")
    return {name: [column for _, column in several[name]] for name in chosen}
