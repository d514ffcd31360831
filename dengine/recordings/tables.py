"""Wide tables, a row an insertion: CSV, Parquet, or a DataFrame; samples in numbered columns, and one column of labels.

Columns `FZ_0 … FZ_999` are a channel FZ, `0 … 999` or `x1 … x1000` one without need of a name; further channels have
as many.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from .asked import Asked
from .dataset import Dataset, Fault, UnreadableError, make_dataset
from .folder import FORCE
from .labels import LABEL_COLUMNS, label_of
from .lengths import refit
from .text import NOTHING, read_lines

if TYPE_CHECKING:
    import pandas as pd

NUMBERED = re.compile(r"(.*?)[_\-. \[]*(\d+)\]?")


def read_csv(path: Path, name: str, asked: Asked) -> Dataset:
    """One CSV file with a header."""
    import pandas as pd

    try:
        header, lines, delimiter = read_lines(path)
    except UnreadableError as error:
        raise DataError(f"Cannot read {path}: {error.fault(path.name)}.") from error
    faults, rows = [], []
    for number, line in lines:
        columns = line.count(delimiter) + 1
        if columns == len(header) or '"' in line:
            rows.append((number, line))
        else:
            faults.append(Fault(path.name, number, f"Expected {len(header)} columns, got {columns}"))
    if not rows:
        raise DataError(f"Expected rows that can be read in {path}, found none.")
    comma = delimiter != "," and any("," in line for _, line in rows)
    body = io.StringIO("\n".join(line for _, line in rows))
    how: dict[str, Any] = {"sep": delimiter, "decimal": "," if comma else ".", "float_precision": "round_trip"}
    try:
        frame = pd.read_csv(body, header=None, names=header, index_col=False, low_memory=False, **how)
    except (ValueError, pd.errors.ParserError) as error:
        raise DataError(f"Cannot read {path} as CSV: {' '.join(str(error).split())}.") from error
    return from_frame(frame, asked, name, path.name, faults, [number for number, _ in rows])


def read_parquet(path: Path, name: str, asked: Asked) -> Dataset:
    """One Parquet file, by pyarrow."""
    import pandas as pd

    if find_spec("pyarrow") is None:
        raise DataError('Expected pyarrow for Parquet files, it is not installed: pip install "dengine[files]".')
    try:
        frame = pd.read_parquet(path)
    except (OSError, ValueError) as error:
        raise DataError(f"Cannot read {path} as a Parquet file: {error}.") from error
    return from_frame(frame, asked, name, path.name)


def from_frame(
    frame: pd.DataFrame,
    asked: Asked,
    name: str = "data",
    source: str = "row",
    faults: list[Fault] | None = None,
    lines: list[int] | None = None,
) -> Dataset:
    """A table in memory. lines : where each row stands in its file; None: rows count from 1.

    An empty cell is a NaN: the engine finds it, and the part is verified. A row with text in it, or no label, is a fault.
    """
    frame = frame.rename(columns=str)
    lines = lines or list(range(1, len(frame) + 1))
    label = _label_column(frame, asked)
    if asked.part != "part" and asked.part not in frame:
        raise DataError(f"Expected a column {asked.part} of parts' numbers, found {_few(frame.columns)}.")
    columns = _sample_columns([c for c in frame.columns if c not in (label, asked.part)], asked)
    wrong: dict[int, str] = {}
    block = np.stack([_numbers(frame, names, wrong) for names in columns.values()], axis=1)
    y = _labels(frame[label], wrong)
    left_out = [Fault(source, lines[i], what) for i, what in sorted(wrong.items())]
    kept = np.array([i not in wrong for i in range(len(frame))], dtype=bool)
    if not kept.any():
        few = "; ".join(map(str, left_out[:3]))
        raise DataError(f"Expected rows that can be read in {source}, found none of {len(frame)}: {few}.")
    about: dict[str, Any] = {"faults": (*(faults or []), *left_out), "channels": tuple(n for n in columns if n)}
    about["source"] = np.array([f"{source}, line {lines[i]}" for i in np.flatnonzero(kept)])
    part = frame[asked.part].astype(str).to_numpy(dtype=np.str_)[kept] if asked.part in frame else None
    X = (block[:, 0] if block.shape[1] == 1 else block)[kept]
    picked = Asked(asked.samples, fit=asked.fit, rate_hz=asked.rate_hz)  # its channels are those that were asked for
    return refit(make_dataset(X, y[kept], name=name, part=part, **about), picked)


def _label_column(frame: pd.DataFrame, asked: Asked) -> str:
    if asked.label is not None:
        if asked.label not in frame:
            raise DataError(f"Expected a column {asked.label} of labels, found {_few(frame.columns)}.")
        return asked.label
    lower = {c.lower(): c for c in frame.columns}
    for known in LABEL_COLUMNS:
        if known in lower:
            return str(lower[known])
    raise DataError(f"Expected a column of labels, y or label, found {_few(frame.columns)}; name it: label='...'.")


def _sample_columns(names: list[str], asked: Asked) -> dict[str, list[str]]:
    """Channel -> its columns, in the order of their numbers."""
    groups: dict[str, list[tuple[int, str]]] = {}
    for name in names:
        found = NUMBERED.fullmatch(name)
        if found:
            groups.setdefault(found[1], []).append((int(found[2]), name))
    several = {name: [column for _, column in sorted(those)] for name, those in groups.items() if len(those) > 1}
    if not several:
        raise DataError(f"Expected samples in numbered columns, as FZ_0, FZ_1, ..., found {_few(names)}.")
    chosen = _chosen(several, asked)
    sizes = {len(several[name]) for name in chosen}
    if len(sizes) > 1:
        each = ", ".join(f"{name} {len(several[name])}" for name in chosen)
        raise DataError(f"Expected as many samples of each channel, got {each}.")
    return {name: several[name] for name in chosen}


def _chosen(have: Mapping[str, list[str]], asked: Asked) -> tuple[str, ...]:
    missing = [name for name in asked.channels if name not in have]
    if missing:
        raise DataError(f"Expected the channel {missing[0]}, in columns {missing[0]}_0 and so on, found {_few(have)}.")
    if asked.channels:
        return asked.channels
    if FORCE in have or len(have) == 1:
        return (FORCE,) if FORCE in have else tuple(have)
    raise DataError(f"Expected the channel to be named, as in channel={next(iter(have))!r}; there are {_few(have)}.")


def _numbers(frame: pd.DataFrame, names: list[str], wrong: dict[int, str]) -> NDArray[np.float32]:
    """(n, T); a row with what is no number is named in `wrong`."""
    import pandas as pd

    block = frame[names]
    for column in [c for c in names if not pd.api.types.is_numeric_dtype(block[c])]:
        words = block[column]
        numbers = pd.to_numeric(words, errors="coerce")
        empty = words.isna() | words.astype(str).str.strip().str.lower().isin(NOTHING)
        for i in np.flatnonzero(numbers.isna() & ~empty):
            wrong.setdefault(int(i), f"Expected a number in column {column}, got {str(words.iloc[i])[:20]!r}")
        block = block.assign(**{column: numbers})
    with np.errstate(over="ignore"):
        return np.asarray(block.to_numpy(dtype=np.float64, na_value=np.nan), dtype=np.float32)


def _labels(column: pd.Series, wrong: dict[int, str]) -> NDArray[np.int8]:
    y = np.zeros(len(column), dtype=np.int8)
    for i, word in enumerate(column.tolist()):
        try:
            y[i] = label_of(word)
        except UnreadableError as error:
            wrong.setdefault(i, error.what)
    return y


def _few(names: Any) -> str:
    listed = [str(name) for name in names]
    return ", ".join(listed[:8]) + (f" and {len(listed) - 8} more" if len(listed) > 8 else "")
